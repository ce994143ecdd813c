"""What every test shares: no window opens, no run differs from the last."""

import os
import random
import zlib

os.environ["MPLBACKEND"] = "Agg"  # before anything can import matplotlib

import hypothesis
import numpy as np
import pytest
import scripts

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


def pytest_collection_modifyitems(items):
    """What looks at examples comes last: by then they have run beside the other tests."""
    items.sort(key=lambda item: item.path.name.startswith("test_examples"))


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session):
    """Begin the examples at the last one, so that those who wait at the end meet them half-way.

    The very first is the one with the most to compile: when the tests need it, it is on the disk.
    """
    if not session.config.option.collectonly:
        chosen = [item for item in session.items if getattr(item, "originalname", None) == "test_it_runs"]
        for name in sorted((item.callspec.params["name"] for item in chosen[::-1]), key="poisson_adjoint.py".__ne__):
            scripts.begun(name)


def pytest_sessionfinish():
    """After an interruption or with -x the examples that wait are not begun."""
    scripts.BESIDE.shutdown(wait=False, cancel_futures=True)
