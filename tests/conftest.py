"""For all laws: one hypothesis profile, and the network's shapes are checked, whoever imports it first."""

from hypothesis import HealthCheck, settings
from jaxtyping import install_import_hook

install_import_hook("gnn_policy.network", "beartype.beartype")

# The machine's load never fails a test.
settings.register_profile("laws", deadline=None, max_examples=100, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("laws")
