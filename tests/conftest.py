"""One hypothesis profile for all tests, and runtime checks of the network's shapes from the first import on."""

from hypothesis import HealthCheck, settings
from jaxtyping import install_import_hook

install_import_hook("gnn_policy.network", "beartype.beartype")

# The machine's load never fails a test.
settings.register_profile("tests", deadline=None, max_examples=100, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("tests")
