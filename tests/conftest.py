"""What every test shares: no window opens, no run differs from the last."""

import os
import random
import zlib

os.environ["MPLBACKEND"] = "Agg"  # before anything can import matplotlib

import hypothesis
import numpy as np
import pytest

hypothesis.settings.register_profile(
    "house",
    deadline=None,
    derandomize=True,
    max_examples=25,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("house")


@pytest.fixture(autouse=True)
def seeds():
    """The global generators start every test in the same state (third-party code draws from them)."""
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002


@pytest.fixture
def rng(request):
    """A generator of its own for each test, the same in every run."""
    return np.random.default_rng(zlib.crc32(request.node.nodeid.encode()))
