"""What every test shares: no window opens, no run differs from the last."""

import gc
import os
import random
import signal
import sys
import zlib
from collections import Counter
from functools import cached_property
from pathlib import Path

os.environ["MPLBACKEND"] = "Agg"  # before anything can import matplotlib
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # BLAS threads of two workers compete for the same cores

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell did that which started the run in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)  # or tests of Ctrl-C, and their processes, never end

if sys.dont_write_bytecode:  # then not beside the sources; but a third of a run's start is compiling, each time again
    sys.dont_write_bytecode = False
    sys.pycache_prefix = str(Path(__file__).resolve().parent.parent / ".pytest_cache" / "bytecode")
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix  # of the processes that tests start
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

import hypothesis
import numpy as np
import pairwise
import pytest
from _pytest.doctest import DoctestModule

hypothesis.settings.register_profile(
    "house",
    deadline=None,
    derandomize=True,
    max_examples=25,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("house")


TESTS_OF_A_UNIT = 16  # tests of one file that a worker gets at a time

gc.disable()  # until all tests are collected: hundreds of thousands of objects that stay


def pytest_collection_finish():
    """No collection of garbage looks at the tests again: that took a seventh of a run."""
    gc.freeze()
    gc.enable()


@pytest.fixture(autouse=True)
def seeds():
    """The global generators start every test in the same state (third-party code draws from them)."""
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002


@pytest.fixture
def rng(request):
    """A generator of its own for each test: the same in every run, and wherever the file lies among the tests."""
    name = request.node.nodeid.split("@")[0]  # a worker writes the group of a test behind an @
    file, separator, test = name.partition("::")
    return np.random.default_rng(zlib.crc32(f"tests/{Path(file).name}{separator}{test}".encode()))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Give tests that are not in a sample the marker `whole`, before -m selects by markers."""
    for item in pairwise.skipped_items(items):
        item.add_marker(pytest.mark.whole)


@pytest.hookimpl(wrapper=True)
def pytest_collect_file():
    """Look for no doctests in the files of this folder: they have none."""
    collectors = yield
    return [collector for collector in collectors if not isinstance(collector, DoctestModule)]


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Send neighbouring tests of a file to the same worker, which then makes their fixtures and caches once.

    Test by test, the scheduler of xdist takes a time that is quadratic in their number: a tenth of that of the tests.
    """
    if config.getoption("dist") != "loadgroup":
        return None
    from xdist.scheduler import LoadGroupScheduling

    class NeighbourScheduling(LoadGroupScheduling):
        @cached_property
        def unit_of_test(self):
            """Units of neighbouring tests, by the name of the test."""
            counts = Counter()
            units = {}
            for name in self.collection:
                file = name.partition("::")[0]
                units[name] = f"{file} {counts[file] // TESTS_OF_A_UNIT}"
                counts[file] += 1
            return units

        def _split_scope(self, nodeid):
            """Return the group of a test that has one, or its unit."""
            group = super()._split_scope(nodeid)
            return self.unit_of_test[nodeid] if group == nodeid else group

    return NeighbourScheduling(config, log)


@pytest.fixture(
    scope="session", params=[pairwise.sample, pytest.param(list, marks=pytest.mark.whole)], ids=["sample", "whole"]
)
def drawn(request):
    """For loops inside a test: a sample of a list of scenes, tuples of what they are made of, or all of it."""
    return request.param


def pytest_terminal_summary(terminalreporter):
    """Print the totals of a campaign of random scenes: scenes, comparisons, and refusals by reason."""
    total = Counter()
    reasons = Counter()
    for report in terminalreporter.getreports("passed"):
        for name, tally in report.user_properties:
            if name == "campaign" and report.when == "call":
                reasons.update(tally["reasons"])
                total.update({key: count for key, count in tally.items() if key != "reasons"})
    if total:
        share = (total["refused"] + total["discarded"]) / max(1, total["scenes"] + total["discarded"])
        counts = ", ".join(f"{count} {key}" for key, count in total.items())
        terminalreporter.write_line(f"campaign: {counts}; {share:.1%} refused as a whole or out of range")
        for reason, count in reasons.most_common():
            terminalreporter.write_line(f"  {count} times {reason}")
