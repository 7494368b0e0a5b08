"""One hypothesis profile for all laws: the machine's load never fails a test."""

from hypothesis import HealthCheck, settings

settings.register_profile("laws", deadline=None, max_examples=100, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("laws")
