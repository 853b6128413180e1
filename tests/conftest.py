"""Puts tests/ on the import path (for strategies.py) and gives Hypothesis one profile without deadlines."""

from hypothesis import HealthCheck, settings

settings.register_profile("pd4dgs", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("pd4dgs")
