"""Checkpoints of minimize: runs that are stopped, interrupted or killed, and resumed."""

import signal
import subprocess
import sys
import time
from functools import partial

import autograd.numpy as anp
import numpy as np
import pytest
from checkpoints_0_2 import CHECKPOINTS, write_checkpoint_0_2

import sparsedp as dp
from sparsedp._utils.pytree import leaves
from sparsedp.io.fingerprint import fingerprint


def valley(x):
    return anp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)


def residuals(x, batch=0.0):
    return anp.concatenate([10 * (x[1:] - x[:-1] ** 2), 1 - x[:-1]]) + batch


START = np.array([-1.2, 1.0, 0.3, 0.8])
RUNS = [
    ("lbfgs", valley, {}),
    ("lbfgs", valley, {"bounds": (-2.0, 0.9)}),
    ("gd", valley, {"rate": 1e-4, "momentum": 0.5}),
    ("gd", valley, {}),
    ("adam", valley, {"rate": 0.05}),
    ("newton_cg", valley, {}),
    ("gauss_newton", residuals, {}),
    ("levenberg_marquardt", residuals, {}),
    ("half_inverse", residuals, {"rate": 0.1, "batches": [1e-3 * i for i in range(5)]}),
]


def same(a, b):
    return (
        all(np.array_equal(p, q) for p, q in zip(leaves(a.x), leaves(b.x), strict=True))
        and a.value == b.value
        and a.evaluations == b.evaluations
        and a.message == b.message
        and [record[:3] + record[4:] for record in a.history] == [record[:3] + record[4:] for record in b.history]
    )


@pytest.mark.parametrize("method, loss, options", RUNS)
def test_a_run_in_pieces_has_the_bits_of_an_uninterrupted_run(tmp_path, monkeypatch, method, loss, options):
    monkeypatch.setattr("sparsedp.optimize.checkpoint.SHARE", np.inf)  # every state is written
    whole = dp.minimize(loss, START, method, maxiter=12, tolerance=0, **options)
    for stop in (3, 4, 9, 12):
        part = dp.minimize(loss, START, method, maxiter=stop, tolerance=0, checkpoint=tmp_path, **options)
    assert same(part, whole)
    assert part.resumed.startswith("resumed from iteration ")
    assert len(list(tmp_path.iterdir())) == 2  # the last two states
    again = dp.minimize(loss, START, method, maxiter=12, tolerance=0, checkpoint=tmp_path, **options)
    assert same(again, whole)


def test_a_finished_run_called_again(tmp_path):
    first = dp.minimize(valley, START, checkpoint=tmp_path)
    assert first.converged and first.resumed == f"nothing to resume in {tmp_path}"
    again = dp.minimize(valley, START, checkpoint=tmp_path)
    assert same(again, first) and again.resumed in str(again)


def test_a_run_stopped_by_its_callback_continues(tmp_path):
    """The next call continues with more iterations and a smaller tolerance, to the same bits."""
    options = {"maxiter": 30, "tolerance": 1e-6}
    whole = dp.minimize(valley, START, **options)
    stopped = dp.minimize(
        valley, START, checkpoint=tmp_path, callback=lambda record, x: record.iteration == 5, **options
    )
    assert stopped.message == "stopped by the callback" and len(stopped.history) == 6
    assert same(dp.minimize(valley, START, checkpoint=tmp_path, **options), whole)
    finer = {"maxiter": 200, "tolerance": 1e-12}
    assert same(dp.minimize(valley, START, checkpoint=tmp_path, **finer), dp.minimize(valley, START, **finer))


def test_damaged_and_foreign_files_are_named_and_skipped(tmp_path, monkeypatch):
    monkeypatch.setattr("sparsedp.optimize.checkpoint.SHARE", np.inf)
    whole = dp.minimize(valley, START, maxiter=8, tolerance=0)
    dp.minimize(valley, START, maxiter=6, tolerance=0, checkpoint=tmp_path)
    last = tmp_path / "state-000000006.npz"
    last.write_bytes(last.read_bytes()[:-7])
    (tmp_path / "state-000000009.npz").write_text("{}")
    dp.network.save(tmp_path / "state-000000008.npz", {"iteration": 8})
    (tmp_path / "state-000000007.npz.part").write_bytes(b"half")
    best = dp.minimize(valley, START, maxiter=8, tolerance=0, checkpoint=tmp_path)
    assert same(best, whole)
    assert "resumed from iteration 5" in best.resumed
    for number in (6, 8, 9):
        assert f"state-00000000{number}.npz: damaged, or not a state of sparsedp" in best.resumed
    assert "state-000000007.npz.part: an unfinished write" in best.resumed


def test_a_new_state_stays_beside_damaged_newer_ones(tmp_path, monkeypatch):
    monkeypatch.setattr("sparsedp.optimize.checkpoint.SHARE", np.inf)
    dp.minimize(valley, START, maxiter=5, tolerance=0, checkpoint=tmp_path)
    for number in (7, 8, 9):
        (tmp_path / f"state-00000000{number}.npz").write_text("{}")
    for last, begin in ((6, 5), (6, 6)):
        best = dp.minimize(valley, START, maxiter=last, tolerance=0, checkpoint=tmp_path)
        assert best.resumed.startswith(f"resumed from iteration {begin} in")


def test_a_single_changed_byte_is_detected(tmp_path):
    """The state is skipped, or the changed byte has no effect."""
    whole = dp.minimize(valley, START, maxiter=3, tolerance=0, checkpoint=tmp_path)
    [state] = tmp_path.glob("state-*3.npz")
    [path.unlink() for path in tmp_path.glob("state-*") if path != state]
    content = state.read_bytes()
    for place in range(0, len(content), 61):
        state.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        best = dp.minimize(valley, START, maxiter=3, tolerance=0, checkpoint=tmp_path)
        assert same(best, whole)
        assert "resumed from iteration 3" in best.resumed or "damaged, or not a state" in best.resumed
        [path.unlink() for path in tmp_path.glob("state-*")]


@pytest.mark.parametrize(
    "change, name",
    [
        ({"method": "gd"}, "method"),
        ({"memory": 3}, "set of options"),
        ({"bounds": (-3.0, None)}, "pair of bounds"),
        ({"start": START + 1}, "start"),
        ({"start": START.astype(np.float32)}, "start"),
        ({"loss": lambda x: 2 * valley(x)}, "loss at the start"),
    ],
)
def test_another_run_is_refused(tmp_path, change, name):
    run = {"loss": valley, "start": START, "maxiter": 2, "checkpoint": tmp_path}
    dp.minimize(**run)
    with pytest.raises(
        ValueError,
        match=".* holds a run with another .*; call minimize as that run began, or write another checkpoint folder",
    ) as refused:
        dp.minimize(**{**run, **change})
    assert f"another {name};" in str(refused.value)


def refused(tmp_path, name, first_arguments, other_arguments, **both):
    """Check that a folder refuses other arguments, and that the run continues with its own."""
    both = {"maxiter": 6, "tolerance": 0, "checkpoint": tmp_path, **both}
    dp.minimize(**first_arguments, **{**both, "maxiter": 3})
    with pytest.raises(ValueError, match=f"holds a run with another {name}; call minimize as that run began"):
        dp.minimize(**other_arguments, **both)
    whole = dp.minimize(**first_arguments, **{**both, "checkpoint": None})
    assert same(dp.minimize(**first_arguments, **both), whole)


TREE = {"x": START, "n": 2, "word": "a", "none": None, "flag": True, "pair": (1.0, np.arange(3))}


@pytest.mark.parametrize(
    "leaf",
    [
        {"n": 3},
        {"n": 2.0},
        {"word": "b"},
        {"none": 0},
        {"flag": False},
        {"pair": [1.0, np.arange(3)]},
        {"pair": (1.0, np.arange(3) + 1)},
        {"pair": (np.float64(1.0), np.arange(3))},
        {"pair": (1.0, np.arange(3, dtype=np.int32))},
        {"more": 1},
    ],
)
def test_other_static_leaves_are_refused(tmp_path, leaf):
    """Also where the loss at the start is the same, because it depends on the unknowns alone."""
    loss = lambda tree: valley(tree["x"]) + tree["pair"][0] ** 2
    refused(tmp_path, "start", {"start": TREE}, {"start": {**TREE, **leaf}}, loss=loss)


def test_the_order_of_names_is_part_of_the_start(tmp_path):
    loss = lambda tree: anp.sum(tree["a"] ** 2) + anp.sum(tree["b"] ** 2)
    a = {"a": START, "b": START}
    b = {"b": START, "a": START}
    refused(tmp_path, "start", {"start": a}, {"start": b}, loss=loss)


BATCHES = [np.full(1, 1e-3 * i) for i in range(5)]


@pytest.mark.parametrize(
    "other_arguments",
    [
        [BATCHES[0], BATCHES[1], BATCHES[1], BATCHES[3], BATCHES[4]],
        BATCHES[:2],
        lambda i: BATCHES[(2 * i) % 5],
    ],
)
@pytest.mark.parametrize("first_arguments", [BATCHES, lambda i: BATCHES[i % 5]])
def test_other_batches_are_refused(tmp_path, first_arguments, other_arguments):
    run = {"loss": residuals, "start": START, "method": "half_inverse", "rate": 0.1}
    refused(tmp_path, "list of batches", {"batches": first_arguments}, {"batches": other_arguments}, **run)


def test_batches_of_later_iterations_may_change(tmp_path):
    run = {"loss": residuals, "start": START, "method": "half_inverse", "rate": 0.1, "tolerance": 0}
    dp.minimize(**run, batches=BATCHES, maxiter=2, checkpoint=tmp_path)
    other = [*BATCHES[:3], BATCHES[0]]
    again = dp.minimize(**run, batches=other, maxiter=6, checkpoint=tmp_path)
    assert again.resumed.startswith("resumed") and same(again, dp.minimize(**run, batches=other, maxiter=6))


def test_each_batch_is_computed_once():
    asked = []
    run = {"loss": residuals, "start": START, "method": "half_inverse", "rate": 0.1, "tolerance": 0, "maxiter": 4}
    dp.minimize(**run, batches=lambda i: asked.append(i) or BATCHES[i])
    assert asked == [0, 1, 2, 3, 4]


def test_bounds_with_equal_text_are_distinguished(tmp_path):
    """NumPy prints the ends of a long array only, and eight digits."""
    start = np.full(2000, 0.5)
    lower = np.full(2000, -1.0)
    for place, change in ((1000, 0.5), (0, 1e-12)):
        other = lower.copy()
        other[place] += change
        assert repr(other) == repr(lower)
        folder = tmp_path / str(place)
        first_arguments = {"bounds": (lower, None)}
        other_arguments = {"bounds": (other, None)}
        refused(folder, "pair of bounds", first_arguments, other_arguments, loss=valley, start=start)


def test_a_loss_that_differs_away_from_the_start_is_refused(tmp_path):
    """The value and gradient are equal at the start and differ at the last point."""
    other = lambda x: valley(x) + anp.sum((x - START) ** 4)
    assert other(START) == valley(START)
    refused(tmp_path, "loss at the last point", {"loss": valley}, {"loss": other}, start=START)


def test_a_run_with_functions_as_options_is_resumed(tmp_path):
    """Their addresses differ in the next process and must not be stored."""
    run = lambda maxiter, **more: dp.minimize(
        lambda y: anp.sum((y - 2.0) ** 2),
        START,
        "physical_gradient",
        maxiter,
        0,
        rate=0.3,
        physics=lambda x: 2 * x,
        inverse=lambda y, x: y / 2,
        **more,
    )
    run(3, checkpoint=tmp_path)
    assert same(run(6, checkpoint=tmp_path), run(6))


def test_certified_takes_no_checkpoint(tmp_path):
    with pytest.raises(
        ValueError,
        match="checkpoint cannot be used with a tolerance of dp.certified, whose solutions are not saved; leave "
        "checkpoint out, or write a number as tolerance",
    ):
        dp.minimize(valley, START, tolerance=dp.certified(), checkpoint=tmp_path)


OPTIONS_0_2 = {
    "lbfgs": {"bounds": (-2.0, 0.9)},
    "adam": {"rate": 0.05},
    "half_inverse": {"rate": 0.1, "batches": [0.0, 1e-3, 2e-3]},
}
LOSSES_0_2 = {
    "levenberg_marquardt": residuals,
    "levenberg_marquardt, large": lambda x: 1e70 * residuals(x),
    "half_inverse": residuals,
}


@pytest.mark.parametrize("name", CHECKPOINTS)
def test_resumes_a_checkpoint_of_version_0_2(tmp_path, name):
    """The resumed run takes the same iterations as a run from the start."""
    write_checkpoint_0_2(tmp_path, name)
    loss = LOSSES_0_2.get(name, valley)
    method = name.partition(",")[0]
    run = {"method": method, "maxiter": 6, "tolerance": 0, **OPTIONS_0_2.get(name, {})}
    whole = dp.minimize(loss, np.array([-1.2, 1.0]), **run)
    best = dp.minimize(loss, np.array([-1.2, 1.0]), checkpoint=tmp_path, **run)
    assert best.resumed == f"resumed from iteration 2 in {tmp_path}"
    assert best.evaluations == whole.evaluations
    values, expected = ([record.value for record in run.history] for run in (best, whole))
    np.testing.assert_allclose(values, expected, rtol=1e-9)


def test_a_checkpoint_of_version_0_2_with_another_loss_is_refused(tmp_path):
    write_checkpoint_0_2(tmp_path, "gd")
    with pytest.raises(ValueError, match="another loss at the start"):
        dp.minimize(lambda x: 1.001 * valley(x), np.array([-1.2, 1.0]), "gd", checkpoint=tmp_path)


SCRIPT = """
import sys
import autograd.numpy as anp, numpy as np, time
import sparsedp as dp
from sparsedp._utils.pytree import leaves
from sparsedp.io.fingerprint import fingerprint
import sparsedp.optimize.checkpoint as checkpoint
checkpoint.SHARE = np.inf
def valley(x):
    time.sleep(1e-3)
    return anp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)
bounds = (-2.0, np.where(np.arange(60) % 7, 2.0, 0.9)) if sys.argv[3:] else None
start = np.linspace(-1.2, 1.0, 60)
best = dp.minimize(valley, start, maxiter=150, tolerance=0, bounds=bounds, checkpoint=sys.argv[1])
np.save(sys.argv[2], best.x)
np.save(sys.argv[2] + ".values", [record.value for record in best.history])
"""


def newest(folder):
    """Return the number of the last iteration in a folder; -1 without any."""
    return max((int(path.stem[6:]) for path in folder.glob("state-*.npz")), default=-1)


def killed_on_its_way(run, folder, delay):
    """Kill a run some seconds after its first new state; return whether that was before its end."""
    process = subprocess.Popen(run)
    before = newest(folder)
    while process.poll() is None and newest(folder) == before:
        time.sleep(1e-3)
    time.sleep(delay)
    process.send_signal(signal.SIGKILL)
    return process.wait() == -signal.SIGKILL and newest(folder) > before


@pytest.mark.slow
@pytest.mark.parametrize("bounds", [[], ["bounds"]])
def test_a_run_killed_at_ten_random_times(tmp_path, rng, bounds):
    """The result and all values in the history have the bits of an undisturbed run."""
    run = [sys.executable, "-c", SCRIPT]
    subprocess.run([*run, str(tmp_path / "whole"), str(tmp_path / "whole.npy"), *bounds], check=True)
    parts = [*run, str(tmp_path / "parts"), str(tmp_path / "parts.npy"), *bounds]
    kills = [killed_on_its_way(parts, tmp_path / "parts", rng.uniform(0, 0.02)) for _ in range(10)]
    assert kills == [True] * 10 and 10 <= newest(tmp_path / "parts") < newest(tmp_path / "whole")
    subprocess.run(parts, check=True)
    for name in ("npy", "npy.values.npy"):
        whole, resumed = (np.load(tmp_path / f"{part}.{name}") for part in ("whole", "parts"))
        assert np.array_equal(whole, resumed) and len(whole) > 50


# ---- Ctrl-C --------------------------------------------------------------------------------------------------------

PRESSED = """
import sys, time
import autograd.numpy as anp, numpy as np
import sparsedp as dp
def valley(x):
    time.sleep(2e-3)
    return anp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)
def slow_end(x):
    if sys.argv[2:] and running and isinstance(x, np.ndarray):  # not traced: the result
        print("waiting", flush=True)
        time.sleep(60)
    return x
def seen(record, x):
    if record.iteration == 10:
        running.append(True)
        print("running", flush=True)
running = []
start = np.linspace(-1.2, 1.0, 60)
best = dp.minimize(valley, start, maxiter=150, tolerance=0, callback=seen, project=slow_end, checkpoint=sys.argv[1])
print(best.message, best.converged, len(best.history), best.value, valley(best.x) == best.value)
"""


def pressed(words, *arguments):
    """Run a script, send SIGINT each time it prints one of the words; return its output, errors and exit code."""
    run = [sys.executable, "-c", PRESSED, *map(str, arguments)]
    with subprocess.Popen(run, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        for word in words:
            assert process.stdout.readline().strip() == word
            process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=100)
    return out, err, process.returncode


def test_an_interrupted_run_returns_its_best_point_and_is_resumed(tmp_path):
    out, err, code = pressed(["running"], tmp_path / "parts")
    message, converged, many, value, right = out.split()
    assert (code, err) == (0, "") and (message, converged, right) == ("interrupted", "False", "True")
    last = newest(tmp_path / "parts")  # one less where the signal came before an iteration was written down
    assert 11 <= int(many) < 150 and last in (int(many) - 2, int(many) - 1)
    assert float(value) < valley(np.linspace(-1.2, 1.0, 60))
    again, whole = (
        dp.minimize(valley, np.linspace(-1.2, 1.0, 60), maxiter=150, tolerance=0, checkpoint=folder)
        for folder in (tmp_path / "parts", None)
    )
    assert again.resumed.startswith(f"resumed from iteration {last} in") and same(again, whole)


@pytest.mark.whole
def test_a_second_interrupt_stops_at_once(tmp_path):
    clock = time.perf_counter()
    out, err, code = pressed(["running", "waiting"], tmp_path, "slow")
    assert out == "" and err.strip().endswith("KeyboardInterrupt") and code != 0
    assert time.perf_counter() - clock < 50


@pytest.mark.parametrize("method, loss", [("adam", valley), ("levenberg_marquardt", residuals), ("lbfgs", valley)])
@pytest.mark.parametrize("at", [1, 8, 12])
def test_interrupted_inside_an_evaluation(tmp_path, monkeypatch, method, loss, at):
    """The interrupted evaluation is repeated: the resumed run has the bits and counts of an uninterrupted run."""
    monkeypatch.setattr("sparsedp.optimize.checkpoint.SHARE", 0.0)  # no state is written before the end
    calls = []

    def cut(x):
        calls.append(1)
        if len(calls) == at:
            raise KeyboardInterrupt
        return loss(x)

    run = {"start": START, "method": method, "maxiter": 12, "tolerance": 0}
    if at == 1:
        with pytest.raises(KeyboardInterrupt):
            dp.minimize(cut, **run, checkpoint=tmp_path)
        return
    best = dp.minimize(cut, **run, checkpoint=tmp_path)
    assert best.message == "interrupted" and not best.converged
    reason = "minimize was interrupted" if method == "levenberg_marquardt" else "only least-squares problems have one"
    with pytest.raises(ValueError, match=reason):
        best.covariance
    whole = dp.minimize(loss, **run)
    assert [record.value for record in best.history] == [r.value for r in whole.history[: len(best.history)]]
    assert same(dp.minimize(loss, **run, checkpoint=tmp_path), whole)


def test_interrupted_in_the_callback():
    def callback(record, x):
        if record.iteration == 4:
            raise KeyboardInterrupt

    best = dp.minimize(valley, START, callback=callback)
    assert best.message == "interrupted" and len(best.history) == 5 and str(best).endswith("interrupted")


def decay(start, factor):
    return lambda step: start * factor**step


def halved(step, start=0.1, every=5):
    return start * 0.5 ** (step // every)


class Cosine:
    """A schedule as an object with attributes, as flax, equinox or a user writes it."""

    def __init__(self, start, steps):
        self.start = start
        self.steps = np.array(steps)

    def __call__(self, step):
        return self.start * (1.0 + np.cos(np.pi * min(1.0, step / self.steps))) / 2


class Slotted:
    __slots__ = ("start",)

    def __init__(self, start):
        self.start = start

    def __call__(self, step):
        return self.start


class OfLibrary:
    """A function that another library compiles, or an array of another library."""

    def __init__(self, start):
        self.__wrapped__ = lambda step: start
        self.__call__ = self.__wrapped__

    def __call__(self, step):
        return self.__wrapped__(step)


class Number:
    def __init__(self, value):
        self.value = value

    def __array__(self, dtype=None, copy=None):
        return np.array(self.value, dtype)

    def __repr__(self):
        return "Number"


def of_number(value):
    number = Number(value)
    return lambda step: float(np.asarray(number))


def joined(*schedules, boundary=3):
    """Return schedules one after the other, as optax.join_schedules builds them."""

    def schedule(step):
        return schedules[step >= boundary](step)

    return schedule


def scaled(factor):
    return eval("lambda step: 0.1 * factor", {"factor": factor})  # a global variable of the function


SCHEDULES = [  # a schedule, and others that must not continue its run
    (lambda: decay(0.1, 0.9), [lambda: decay(0.1, 0.8), lambda: decay(0.2, 0.9)]),
    (lambda: partial(halved, every=5), [lambda: partial(halved, every=4), lambda: partial(halved, start=0.2)]),
    (lambda: Cosine(0.1, 20), [lambda: Cosine(0.2, 20), lambda: Cosine(0.1, 10)]),
    (lambda: Slotted(0.1), [lambda: Slotted(0.2)]),
    (lambda: Cosine(0.1, 20).__call__, [lambda: Cosine(0.1, 21).__call__]),
    (lambda: OfLibrary(0.1), [lambda: OfLibrary(0.2)]),
    (lambda: of_number(0.1), [lambda: of_number(0.2)]),
    (
        lambda: joined(decay(0.1, 0.9), Slotted(0.1)),
        [lambda: joined(decay(0.1, 0.9), Slotted(0.2)), lambda: joined(decay(0.1, 0.9), Slotted(0.1), boundary=4)],
    ),
    (lambda: scaled(1.0), [lambda: scaled(2.0)]),
]


@pytest.mark.parametrize("schedule, others", SCHEDULES)
def test_a_schedule_continues_its_own_run_only(tmp_path, schedule, others):
    """A function created again continues; one with other code, closure, defaults, arguments or attributes does not."""
    run = {"method": "adam", "tolerance": 0}
    whole = dp.minimize(valley, START, maxiter=8, rate=schedule(), **run)
    dp.minimize(valley, START, maxiter=4, rate=schedule(), checkpoint=tmp_path, **run)
    for other in others:
        with pytest.raises(ValueError, match="holds a run with another set of options"):
            dp.minimize(valley, START, maxiter=8, rate=other(), checkpoint=tmp_path, **run)
    again = dp.minimize(valley, START, maxiter=8, rate=schedule(), checkpoint=tmp_path, **run)
    assert same(again, whole) and again.resumed.startswith("resumed from iteration 4")


def test_functions_with_other_code_or_defaults_are_distinguished():
    first, second, third = (eval(text) for text in ("lambda s: 0.1", "lambda s: 0.2", "lambda s, a=0.1: a"))
    fourth = eval("lambda s, a=0.2: a")
    fifth = eval("lambda s, *, a=0.2: a")
    marks = {fingerprint(function) for function in (first, second, third, fourth, fifth, max, np.cos, np.sin)}
    assert len(marks) == 8
    assert fingerprint(first) == fingerprint(eval("lambda s: 0.1"))
