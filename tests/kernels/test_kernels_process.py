"""Kernels and the process they run in: threads, forks, and an environment without numba."""

import gc
import importlib
import os
import subprocess
import sys

import numpy as np
import pytest
from sources import PACKAGE, jitted, modules

from sparsedp import kernels

NUMBA = pytest.mark.skipif(not kernels.compiled(), reason="numba is not installed")


def test_too_many_threads_are_refused(monkeypatch):
    monkeypatch.setattr(kernels, "_available_threads", lambda: 2)
    with pytest.raises(
        ValueError,
        match="set_threads got 3; it needs 1 to 2, the processors this process may use; write None for the default",
    ):
        kernels.set_threads(3)


def test_set_threads():
    most = kernels.threads()
    kernels.set_threads(1)
    assert kernels.threads() == 1
    kernels.set_threads(np.int64(most))
    assert kernels.threads() == most
    for bad in (0, -1, most + 1):
        with pytest.raises(ValueError, match=f"it needs 1 to {most}, the processors this process may use") as caught:
            kernels.set_threads(bad)
        assert str(caught.value).startswith(f"set_threads got {bad};")
    with pytest.raises(TypeError, match="needs an integer"):
        kernels.set_threads(1.5)
    kernels.set_threads(None)
    assert kernels.threads() == most


SCRIPT = """
import os, sys
import numpy as np
from sparsedp import kernels
from sparsedp.kernels.reference import Tridiagonal
n = 200
axis = Tridiagonal(np.r_[0, np.ones(n - 1)], -2 * np.ones(n), np.r_[np.ones(n - 1), 0])
u, out = np.ones((1, n, n)), np.zeros((1, n, n))
kernels.summed(u.shape, (None, axis, axis), 0.0)(u, out)
assert out.sum() == -4 * n
"""


def run(code, **environment):
    return subprocess.run([sys.executable, "-c", SCRIPT + code], env=os.environ | environment, check=False, timeout=120)


def test_environment_variable_disables_numba():
    assert run("assert 'numba' not in sys.modules and not kernels.compiled()", SPARSEDP_NUMBA="0").returncode == 0


@pytest.mark.whole
@NUMBA
@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
def test_kernels_in_a_forked_process():
    code = """
child = os.fork()
kernels.summed(u.shape, (None, axis, axis), 1.0)(u, out)
if not child:
    os._exit(int(out.sum() != n * n - 4 * n))
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    assert run(code).returncode == 0


@NUMBA
@pytest.mark.whole
def test_numba_compiles_the_functions_counted_by_the_house_test():
    """When all loops are compiled, numba holds exactly the functions that test_house.py counts."""
    from numba.core.dispatcher import Dispatcher

    from sparsedp.kernels import team

    counted = {(str(module.path), name) for module in modules() for name in jitted(module)}
    for module in modules():
        if jitted(module):
            importlib.import_module(module.name)
    assert all(loop.compiled for loop in team.loops if loop.loop.__code__.co_filename.startswith(str(PACKAGE)))
    gc.unfreeze()  # what was collected as tests is out of sight of the collector: see conftest.py
    functions = (thing.py_func for thing in gc.get_objects() if isinstance(thing, Dispatcher))
    seen = {(f.__code__.co_filename, f.__code__.co_name) for f in functions}
    seen = {(path, name) for path, name in seen if path.startswith(str(PACKAGE))}
    assert seen == counted
