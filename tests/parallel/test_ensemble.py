"""Sums over scenes: the bits, derivatives and errors that one process has, from every executor."""

import multiprocessing
import os
import pickle
import subprocess
import sys
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor

import autograd.numpy as np
import numpy as onp
import pytest
from pages import blocks
from sources import ROOT

import sparsedp as dp
from sparsedp._utils.pytree import leaves
from sparsedp.parallel import scenes

GRID = dp.Grid((6, 5), size=1.0)
SOLVE = dp.elliptic_solver(dp.divergence(GRID), dp.gradient(GRID, dp.dirichlet))
RNG = onp.random.default_rng(3)
SCENES = [RNG.random(GRID.shape) for _ in range(5)]
WEIGHTS = RNG.random(5)
X = {"k": 0.1 * RNG.random(GRID.faces.size), "s": 2.0, "n": 3, "few": RNG.random(4).astype(onp.float32)}
T = {"k": RNG.random(GRID.faces.size), "s": 1.0, "n": None, "few": RNG.random(4).astype(onp.float32)}
SET_UP = []  # in a worker: one entry for each loss that it has unpacked


def loss(x, b):
    u = SOLVE(np.exp(x["k"]), b)
    return 100 * np.sum(u**2) + x["s"] ** 3 * x["n"] * np.mean(u) + np.sum(x["few"] ** 3) * np.sum(b)


def by_hand(x):
    return sum(weight * loss(x, scene) for weight, scene in zip(WEIGHTS, SCENES, strict=True))


def close(actual, expected, rtol=1e-12):
    pairs = zip(leaves(actual), leaves(expected), strict=True)
    return all(a is b is None or onp.allclose(a, b, rtol, 1e-6 * rtol * onp.max(onp.abs(b))) for a, b in pairs)


def bits(total, x=X):
    value, gradient = dp.value_and_grad(total)(x)
    return [onp.asarray(part).tobytes() for part in leaves((value, gradient, dp.hvp(total, x, T))) if part is not None]


class Reversed:
    """An executor that does its tasks when they are asked for, the last one first; what it unpacks is its own."""

    def __init__(self, forgets=False):
        self.tasks = []
        self.forgets = forgets
        self.sizes = []

    def submit(self, *task):
        future = Future()
        self.tasks.append((future, pickle.dumps(task)))
        self.sizes.append(len(self.tasks[-1][1]))
        future.result = lambda: self.all_done() or Future.result(future)
        return future

    def all_done(self):
        while self.tasks:
            future, task = self.tasks.pop()
            act, *args = pickle.loads(task)
            if self.forgets:
                scenes._cache.clear()
            try:
                future.set_result(act(*args))
            except Exception as error:
                future.set_exception(error)


def test_derivatives_are_those_of_the_sum():
    total = dp.ensemble(loss, SCENES, weights=WEIGHTS)
    expected, gradient = dp.value_and_grad(by_hand)(X)
    value, actual = dp.value_and_grad(total)(X)
    assert total(X) == value and abs(value / expected - 1) <= 1e-13
    assert close({**actual, "few": 0}, {**gradient, "few": 0}) and close(actual["few"], gradient["few"], 1e-6)
    assert actual["few"].dtype == onp.float32 and type(actual["s"]) is float and actual["n"] is None
    assert abs(dp.jvp(total, X, T)[1] / dp.jvp(by_hand, X, T)[1] - 1) <= 1e-6
    assert close(dp.hvp(total, X, T), dp.hvp(by_hand, X, T), 1e-6)


def test_second_order_in_reverse_alone():
    total = dp.ensemble(loss, SCENES, weights=WEIGHTS)
    slopes = [dp.grad(lambda x, f=f: np.sum(np.sin(dp.grad(f)(x)["k"]) * T["k"]) * x["s"])(X) for f in (total, by_hand)]
    assert close(*({**one, "few": 0} for one in slopes), 1e-10)


def test_complex_unknowns(rng):
    f = lambda z, b: np.real(np.sum(z**3 * b)) + np.sum(np.abs(z) ** 4)
    scenes, z, t = rng.standard_normal((3, 4)), *(rng.standard_normal((2, 4)) + 1j * rng.standard_normal((2, 4)))
    total = dp.ensemble(f, scenes)
    expected = lambda z: sum(f(z, b) for b in scenes)
    assert close(dp.grad(total)(z), dp.grad(expected)(z))
    assert close(dp.jvp(total, z, t)[1], dp.jvp(expected, z, t)[1])
    assert close(dp.hvp(total, z, t), dp.hvp(expected, z, t))
    pair = lambda f: lambda z: np.real(np.sum(dp.grad(f)(z) ** 2 * t))
    assert close(dp.grad(pair(total))(z), dp.grad(pair(expected))(z))


def test_the_check_agrees():
    assert dp.check.gradient(dp.ensemble(loss, SCENES[:2]), {**X, "few": 0}, quick=True).verdict == "agrees"


@pytest.mark.parametrize("chunk", [None, 2, 9])
def test_the_same_bits_in_any_order_of_work(chunk):
    expected = bits(dp.ensemble(loss, SCENES, weights=WEIGHTS, chunk=chunk))
    assert bits(dp.ensemble(loss, SCENES, Reversed(), WEIGHTS, chunk)) == expected
    with ThreadPoolExecutor(3) as pool:
        assert bits(dp.ensemble(loss, SCENES, pool, WEIGHTS, chunk)) == expected


@pytest.mark.whole
@pytest.mark.parametrize("workers", [1, 2, 3])
def test_the_same_bits_from_other_processes(workers):
    expected = bits(dp.ensemble(loss, SCENES, weights=WEIGHTS))
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        assert bits(dp.ensemble(loss, SCENES, pool, WEIGHTS)) == expected


@pytest.mark.whole
def test_the_file_of_the_guide(tmp_path):
    page = (ROOT / "docs" / "guides" / "ranks_and_ensembles.md").read_text(encoding="utf-8")
    [code] = [block.text for block in blocks(page) if "with ProcessPoolExecutor" in block.text]
    (tmp_path / "experiments.py").write_text(code, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "experiments.py"]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.stdout == "the same bits: True\n", done.stderr


def test_dask():
    distributed = pytest.importorskip("distributed", reason="dask is not installed")
    with distributed.Client(processes=False, n_workers=1, threads_per_worker=2, dashboard_address=None) as client:
        total = dp.ensemble(loss, SCENES, client.get_executor(), WEIGHTS)
        assert bits(total) == bits(dp.ensemble(loss, SCENES, weights=WEIGHTS))


class Counted:
    """A loss that notes each time that it is unpacked."""

    def __reduce__(self):
        return counted, ()

    def __call__(self, x, scene):
        return x * scene


def counted():
    SET_UP.append(1)
    return Counted()


def test_a_worker_keeps_what_it_has_unpacked():
    SET_UP.clear()
    total = dp.ensemble(Counted(), [1.0, 2.0, 3.0], Reversed())
    assert [total(2.0), *dp.value_and_grad(total)(3.0)] == [12.0, 18.0, 6.0] and len(SET_UP) == 1


def test_a_worker_that_forgets_unpacks_again():
    expected, total = (dp.ensemble(loss, SCENES, some, WEIGHTS, 2) for some in (None, Reversed(forgets=True)))
    assert [bits(total) for _ in range(2)] == [bits(expected)] * 2


def summed(x, scene):
    return x * np.sum(scene)


def test_what_every_worker_has_is_not_sent_again():
    large = [onp.full(10_000, float(number)) for number in range(3)]
    executor = Reversed()
    total = dp.ensemble(summed, large, executor)
    assert [total(2.0), total(2.0)] == [60_000.0] * 2
    assert min(executor.sizes[:3]) > 80_000 and max(executor.sizes[3:]) < 2_000
    scenes._cache.clear()  # as in a worker that was started anew: it gets all that it lacks
    assert total(2.0) == 60_000.0 and sum(size > 80_000 for size in executor.sizes[6:]) == 3


def test_batches_of_scenes():
    total = dp.ensemble(lambda x, scene: (x - scene) ** 2, [1.0, 2.0, 6.0, 7.0], weights=[1, 1, 2, 1], chunk=2)
    assert dp.value_and_grad(total)(3.0, [2, 0, 0]) == (26.0, -4.0)
    batches = [[0, 3], [1, 2]]
    actual = dp.minimize(total, 0.0, "adam", 200, batches=batches, rate=0.1)
    assert 3.0 < actual.x < 5.0


@pytest.mark.parametrize("executor", [None, Reversed()], ids=["here", "elsewhere"])
def test_a_loss_cannot_write_into_what_it_is_given(executor):
    """The next evaluation would see another scene, and the next scene another unknown."""
    for x, scene in ((onp.zeros(3), onp.ones(3)), ({"start": onp.ones(3)}, 0.0)):
        with pytest.raises(ValueError, match="scene 0 of 1: .*read-only"):
            dp.ensemble(writing, [scene], executor)(x)


def writing(x, scene):
    (x["start"] if isinstance(x, dict) else scene)[...] *= 2
    return 1.0


def test_minimize_steps_back_where_a_scene_breaks():
    def broken(x, scene):
        if x > 2.5:
            raise dp.errors.UnstableStepError("too fast")
        return (x - scene) ** 2

    best = dp.minimize(dp.ensemble(broken, [1.0, 2.0]), 0.0)
    assert abs(best.x - 1.5) <= 1e-6


ERRORS = {
    "typed": (dp.errors.NonFiniteError("planted"), dp.errors.NonFiniteError, "scene 2 of 4: planted"),
    "solve": (dp.errors.ConvergenceError("slow"), dp.errors.ConvergenceError, "scene 2 of 4: slow"),
    "empty": (ZeroDivisionError(), ZeroDivisionError, "scene 2 of 4: ZeroDivisionError"),
    "no words": (KeyError(7), RuntimeError, "scene 2 of 4 raised KeyError: 7"),
}


class Raising:
    """A loss that fails in one scene."""

    def __init__(self, kind):
        self.kind = kind

    def __call__(self, x, scene):
        if scene == 2:
            raise type(ERRORS[self.kind][0])(*ERRORS[self.kind][0].args)
        return x


@pytest.mark.parametrize("make", [lambda: None, Reversed], ids=["here", "elsewhere"])
@pytest.mark.parametrize("kind", ERRORS)
def test_an_error_names_the_scene(kind, make):
    total = dp.ensemble(Raising(kind), range(4), make(), chunk=3)
    for use in (total, dp.value_and_grad(total)):
        with pytest.raises(ERRORS[kind][1], match=f"^'?{ERRORS[kind][2]}'?$"):
            use(1.0)


class Stopped(Reversed):
    """Ctrl-C is pressed before the first scene."""

    def all_done(self):
        raise KeyboardInterrupt


def test_tasks_that_have_not_begun_are_cancelled():
    stopped = Stopped()
    with pytest.raises(KeyboardInterrupt):
        dp.ensemble(loss, SCENES, stopped)(X)
    assert len(stopped.tasks) == 5 and all(future.cancelled() for future, _ in stopped.tasks)


def test_progress(capsys):
    pytest.importorskip("tqdm")
    assert dp.ensemble(np.add, [1.0, 2.0], progress="sum of")(1.0) == 5.0
    assert "sum of scenes:" in capsys.readouterr().err


def test_what_cannot_travel(monkeypatch):
    """A function without a name, where cloudpickle is not there."""
    monkeypatch.setitem(sys.modules, "cloudpickle", None)
    with pytest.raises(
        TypeError,
        match=r"^ensemble cannot send function to another process \(.*\); write functions as a def at the top level of "
        "a module, or install cloudpickle$",
    ):
        dp.ensemble(lambda x, scene: x, [1], Reversed())
