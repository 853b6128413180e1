"""What all tests share: a Hypothesis profile without deadlines, and interrupts that arrive.

The shell of a background job ignores SIGINT, and its children with it; tests that send it need it heeded.
"""

import signal
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))  # no package: its commands put it on the path too
settings.register_profile("pd4dgs", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("pd4dgs")


@pytest.fixture(autouse=True, scope="session")
def _heed_interrupts():
    before = signal.getsignal(signal.SIGINT)
    if before is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
