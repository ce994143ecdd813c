"""Ctrl-C in a time loop: KeyboardInterrupt at once, and everything works as before, to the bit."""

import signal
import subprocess
import sys
import time

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils import counters
from sparsedp._utils.pytree import leaves
from sparsedp.autodiff import tape
from sparsedp.autodiff.derivative import pullback, pushforward

pytestmark = pytest.mark.filterwarnings("ignore::sparsedp.errors.BudgetWarning")
N = 9
GRID = dp.Grid((6, 5), size=1.0, periodic=True)
MOVE = dp.transport(GRID, velocity="cells")
U = np.random.default_rng(0).random((6, 5))
V = 0.1 * np.random.default_rng(1).random((2, 6, 5))
WIDE = np.array(V[0])


class Stops:
    """A step that is interrupted at one of its calls."""

    def __init__(self, step, at=None):
        self.step = step
        self.at = at
        self.calls = 0

    def __call__(self, u, p):
        self.calls += 1
        if self.calls == self.at:
            raise KeyboardInterrupt
        return self.step(u, p)


def bend(u, p):
    return u + 0.1 * anp.sin(p * u) * anp.roll(u, 1)


LOOPS = {  # step, state, params, options
    "transport": (lambda u, v: MOVE(u, v, 0.02), U, V, {}),
    "transport again": (lambda u, v: MOVE(u, v, 0.02), U, V, {"memory": (4 + 3) * U.nbytes + 2 * V.nbytes}),
    "taped": (bend, U, WIDE, {"memory": (4 + 3 + 2) * U.nbytes}),
    "taped once": (bend, U, WIDE, {"memory": "1 MB"}),
    "linked": (bend, U, WIDE, {}),
    "tree": (lambda s, p: (bend(s[0], p), s[1] + 1), (U, 0), WIDE, {}),
    "all": (bend, U, WIDE, {"keep": "all"}),
    "each": (bend, U, WIDE, {"keep": lambda i, u: anp.sum(u**2)}),
}


def loss(name, step):
    _, u, p, options = LOOPS[name]
    return lambda x: sum(anp.sum(leaf**2) for leaf in leaves(dp.rollout(step, x[0], x[1], N, **options))), (u, p)


def gradient(name, step):
    f, x = loss(name, step)
    return dp.value_and_grad(f)(x)


def product(name, step):
    f, (u, p) = loss(name, step)
    return pushforward(lambda p: dp.value_and_grad(lambda p: f((u, p)))(p)[1], p, np.ones_like(p))


def twice(name, step):
    """A pullback that is used again after it was interrupted."""
    f, x = loss(name, step)
    value, pull = pullback(f, x)
    try:
        return value, pull(1.0)
    except KeyboardInterrupt:
        return value, pull(1.0)


def told(found):
    return [np.asarray(leaf).tobytes() for leaf in leaves(found) if leaf is not None]


def left_over():
    mine = counters.thread
    kept = len(mine.calls), len(mine.solve_hooks), len(mine.loop_hooks), len(mine.inner), len(mine.node_hooks)
    return len(counters.active), *kept, set(tape.untraced)


@pytest.mark.whole
@pytest.mark.parametrize("job", [gradient, product, twice])
@pytest.mark.parametrize("name", LOOPS)
def test_interrupted_at_any_call_of_the_step(name, job):
    step = Stops(LOOPS[name][0])
    wanted = told(job(name, step))
    before = left_over()
    calls = step.calls
    assert calls >= N
    for at in range(1, calls + 1, 5 if job is product else 1):
        step.calls = 0
        step.at = at
        try:
            assert told(job(name, step)) == wanted and job is twice
        except KeyboardInterrupt:
            assert step.calls == at
        assert left_over() == before
        step.at = None
        assert told(job(name, step)) == wanted


LONG = """
import sys, time
import numpy as np, autograd.numpy as anp, sparsedp as dp
grid = dp.Grid(40, size=1.0, periodic=True)
move = dp.transport(grid)
step = lambda u, v: move(u, v, 1e-3)
u, v = np.sin(np.arange(40.0)), np.cos(np.arange(40.0))
loss = lambda n: lambda u: anp.sum(dp.rollout(step, u, v, n) ** 2)
wanted = dp.value_and_grad(loss(50))(u)[1].tobytes()
print("ready", flush=True)
try:
    while True:
        dp.value_and_grad(loss(100_000))(u)
except KeyboardInterrupt:
    same = dp.value_and_grad(loss(50))(u)[1].tobytes() == wanted
    print("the same" if same else "other bits", flush=True)
"""


@pytest.mark.whole
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for one process")
def test_a_real_signal():
    child = subprocess.Popen([sys.executable, "-c", LONG], stdout=subprocess.PIPE, text=True)
    try:
        assert child.stdout.readline() == "ready\n"
        time.sleep(0.5)
        start = time.perf_counter()
        child.send_signal(signal.SIGINT)
        assert child.stdout.readline() == "the same\n"
        assert time.perf_counter() - start < 20  # a second at most on a quiet machine
        assert child.wait(60) == 0
    finally:
        child.kill()
        child.stdout.close()
        child.wait()
