"""minimize(): every method, trees, scales, refused trial points, history and messages."""

import sys
from collections import namedtuple

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.flattening import Packing
from sparsedp.autodiff.tape import plain
from sparsedp.errors import ConvergenceError, NonFiniteError, UnstableStepError
from sparsedp.optimize.batches import Batches
from sparsedp.optimize.box import Box
from sparsedp.optimize.first_order import Adam, GradientDescent
from sparsedp.optimize.objective import Objective

Rest = namedtuple("Rest", "b nothing")


def valley(x):
    """Rosenbrock's function; its minimum is 0 at ones."""
    return anp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)


def bowl(x):
    return anp.sum((x - 3.0) ** 2)


def start():
    return {"a": np.array([-1.2, 1.0, -1.2]), "n": 3, "rest": Rest([np.float32(1.0), -1.2], None), "word": "x"}


def nested(tree):
    assert tree["n"] == 3 and tree["word"] == "x" and tree["rest"].nothing is None
    b = tree["rest"].b
    return valley(anp.concatenate([tree["a"], anp.array([b[0] * 1.0, b[1]])]))


def walled(loss, reach, error=UnstableStepError):
    """Return a loss that refuses points with an entry beyond `reach`."""

    def inside(x):
        if np.max(np.abs(plain(x))) > reach:
            raise error(f"beyond {reach}")
        return loss(x)

    return inside


def refused(result):
    return [failure for record in result.history for failure in record.failed]


# ---- results -------------------------------------------------------------------------------------------------------


def test_nested_leaves_keep_their_kinds():
    initial = start()
    best = dp.minimize(nested, initial)
    assert best.converged and best.method == "lbfgs"
    assert np.allclose(best.x["a"], 1, atol=1e-4)
    assert best.x["n"] == 3 and best.x["word"] == "x" and best.x["rest"].nothing is None
    assert isinstance(best.x["rest"], Rest) and isinstance(best.x["rest"].b[0], np.float32)
    assert isinstance(best.x["rest"].b[1], float)
    assert np.array_equal(initial["a"], start()["a"])
    assert best.value == pytest.approx(float(nested(best.x)), abs=1e-12)


METHODS = [
    ("lbfgs", {}, 1e-10),
    ("lbfgs", {"memory": 3, "line_search": 10}, 1e-10),
    ("gd", {"momentum": 0.9}, 1e-1),
    ("gd", {"rate": 1e-3, "momentum": 0.9}, 1e-2),
    ("gd", {"rate": 1e-3, "line_search": "backtracking"}, 2e-1),
    ("adam", {"rate": 0.05}, 2e-1),
]


@pytest.mark.parametrize("method, options, reached", METHODS)
def test_methods(method, options, reached):
    best = dp.minimize(valley, np.array([-1.2, 1.0]), method, maxiter=500, **options)
    assert best.value < reached
    assert best.value == min(record.value for record in best.history)


def test_first_step_of_gradient_descent_and_adam_against_the_formula():
    x = np.array([1.0, 2.0])
    best = dp.minimize(bowl, x, "gd", maxiter=1, rate=0.1, tolerance=0)
    assert np.array_equal(best.x, x - 0.1 * (2 * (x - 3.0)))
    best = dp.minimize(bowl, x, "adam", maxiter=1, rate=0.1)
    assert np.allclose(best.x, x + 0.1, rtol=1e-7)


def adam_in_numpy(gradient, x, rate, max_norm, steps):
    """Return the points of Adam with b1 = 0.9 and b2 = 0.999, written from its formula."""
    mean = mean_square = 0.0
    points = [x]
    for step in range(steps):
        g = gradient(x, step)
        g = g * min(1.0, max_norm / np.sqrt(np.sum(g**2)))
        mean = 0.9 * mean + 0.1 * g
        mean_square = 0.999 * mean_square + 0.001 * g**2
        scale = np.sqrt(1.0 - 0.999 ** (step + 1)) / (1.0 - 0.9 ** (step + 1))
        x = x - rate(step) * scale * mean / np.sqrt(mean_square)
        points.append(x)
    return points


@pytest.mark.parametrize("max_norm", [3.0, 1e-6, 1e6])
def test_adam_with_a_schedule_and_clipping_against_the_formula(max_norm):
    """The gradients have norms from 1 to 40, and are scaled over both leaves together. The first step is number 0."""
    factors = [1.0, 10.0, 0.5]
    schedule = lambda step: np.float32(0.5 ** (step + 2)) if step < 3 else 0.0
    loss = lambda x, factor: factor * (anp.sum((x["a"] - 3.0) ** 2) + 2 * (x["b"] + 1.0) ** 2)
    run = {"method": "adam", "maxiter": 5, "batches": factors, "tolerance": 0, "epsilon": 1e-14}
    points = []
    dp.minimize(
        loss,
        {"a": np.array([1.0, 2.5]), "b": 0.3},
        rate=schedule,
        max_norm=max_norm,
        callback=lambda record, x: points.append([*x["a"], x["b"]]) or False,
        **run,
    )
    gradient = lambda x, step: factors[step % 3] * np.array([2, 2, 4]) * (x - np.array([3.0, 3.0, -1.0]))
    expected = adam_in_numpy(gradient, np.array([1.0, 2.5, 0.3]), schedule, max_norm, 5)
    assert np.allclose(points, expected[-len(points) :], rtol=1e-9) and len(points) >= 5
    assert np.array_equal(expected[4], expected[3]) and not np.allclose(expected[3], expected[2])


def test_adam_with_an_infinite_norm_does_not_clip():
    run = lambda **options: dp.minimize(valley, np.array([-1.2, 1.0]), "adam", 5, 0, rate=0.1, **options).x
    assert np.array_equal(run(max_norm=np.inf), run()) and not np.array_equal(run(max_norm=1e-3), run())


@pytest.mark.parametrize("scale", [2.0**-660, 1e-12, 1e12, 2.0**660])
@pytest.mark.parametrize("method, options", [("lbfgs", {}), ("gd", {}), ("adam", {"rate": 0.1})])
def test_methods_are_invariant_to_the_scale_of_the_loss(scale, method, options):
    x = np.array([-1.2, 1.0, 0.5])
    plain_run = dp.minimize(valley, x, method, maxiter=20, **options)
    scaled = dp.minimize(lambda u: scale * valley(u), x, method, maxiter=20, **options)
    same = np.log2(scale) % 1 == 0
    assert np.array_equal(scaled.x, plain_run.x) if same else np.allclose(scaled.x, plain_run.x, rtol=1e-4)


@pytest.mark.parametrize("scale", [1e-12, 1e-3, 1e6])
def test_lbfgs_is_invariant_to_the_scale_of_x(scale):
    best = dp.minimize(lambda u: valley(u / scale), scale * np.array([-1.2, 1.0, 0.5]))
    assert best.converged and np.allclose(best.x / scale, 1, atol=1e-5)


def test_single_precision_and_complex_leaves():
    best = dp.minimize(bowl, np.ones(5, np.float32))
    assert best.x.dtype == np.float32 and np.array_equal(best.x, np.full(5, 3, np.float32))
    assert dp.minimize(valley, np.array([-1.2, 1.0], np.float32)).value < 1e-6
    target = np.array([3 + 4j, -1j])
    best = dp.minimize(lambda z: anp.sum(anp.abs(z - target) ** 2), np.array([1 + 1j, 2 - 1j]))
    assert np.allclose(best.x, target)
    assert dp.minimize(lambda z: anp.abs(z - 1j) ** 2, 0.5 + 0j).x == pytest.approx(1j)
    best = dp.minimize(
        lambda z: np.sum(np.abs(z - target) ** 2), 0 * target, gradient=lambda z: 2 * np.conj(z - target)
    )
    assert np.allclose(best.x, target)


def test_an_untraced_loss_with_a_user_gradient():
    best = dp.minimize(lambda x: float(np.sum((x - 3.0) ** 2)), np.ones(4), gradient=lambda x: 2 * (x - 3.0))
    assert best.converged and np.allclose(best.x, 3)


def test_start_at_the_minimum_and_no_iterations():
    best = dp.minimize(bowl, np.full(3, 3.0))
    assert best.converged and best.message == "converged: the gradient is 0" and best.evaluations == 1
    best = dp.minimize(bowl, np.ones(3), maxiter=0)
    assert best.value == 12 and len(best.history) == 1 and not best.converged
    assert best.message == "stopped after 0 iterations, the limit maxiter"


def test_a_large_offset_ends_in_rounding():
    best = dp.minimize(lambda x: 1e8 + valley(x), np.array([-1.2, 1.0]), tolerance=0)
    assert best.converged and "cannot fall further" in best.message
    assert np.allclose(best.x, 1, atol=1e-3)
    descent = dp.minimize(lambda x: 1e8 + bowl(x), np.ones(2), "gd", rate=0.4, line_search="backtracking", tolerance=0)
    assert descent.converged and np.allclose(descent.x, 3, atol=1e-3)


# ---- refused trial points ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [UnstableStepError, ConvergenceError, NonFiniteError])
def test_refused_trial_points_are_avoided(error):
    best = dp.minimize(walled(valley, 1.0005, error), np.zeros(5))
    assert best.converged and np.allclose(best.x, 1, atol=1e-4)
    assert refused(best) and set(refused(best)) == {(error.__name__, "beyond 1.0005")}
    assert "refused: " + error.__name__ in str(best) or len(best.history) > 13


def test_random_barriers(rng):
    for _ in range(5):
        reach = 1 + 10 ** rng.uniform(-3, -0.5)
        best = dp.minimize(walled(valley, reach), rng.uniform(-0.9, 0.9, 6), maxiter=300)
        assert best.converged and np.max(np.abs(best.x)) <= reach


@pytest.mark.parametrize("method, options", [("lbfgs", {}), ("gd", {}), ("gd", {"rate": 0.3}), ("adam", {"rate": 0.1})])
def test_a_minimum_in_a_refused_region(method, options):
    best = dp.minimize(walled(bowl, 1.0), np.zeros(3), method, maxiter=60, **options)
    assert np.all(best.x <= 1.0) and np.allclose(best.x, 1, atol=1e-3)
    assert not best.converged and refused(best)
    assert all(np.isfinite(record.value) for record in best.history)


def test_nan_without_an_error_is_refused_too():
    with np.errstate(all="ignore"):
        best = dp.minimize(lambda x: anp.sum(x) - 1e-3 * anp.sum(anp.log(x)), np.ones(5))
    assert np.allclose(best.x, 1e-3, rtol=1e-4)
    assert {failure.error for failure in refused(best)} == {"NonFiniteError"}


@pytest.mark.parametrize("method", ["lbfgs", "gd"])
def test_message_of_a_wrong_gradient(method):
    best = dp.minimize(bowl, np.ones(5), method, gradient=lambda x: -2 * (x - 3.0))
    assert not best.converged and np.array_equal(best.x, np.ones(5))
    assert "dp.check.gradient(loss, x) tells whether the gradient is right" in best.message


# ---- history, tolerance, callback, progress ------------------------------------------------------------------------


def test_history_and_text():
    best = dp.minimize(valley, np.array([-1.2, 1.0]))
    assert [record.iteration for record in best.history] == list(range(len(best.history)))
    assert best.history[0].value == valley(np.array([-1.2, 1.0]))
    assert best.history[-1].evaluations == best.evaluations
    assert best.history[-1].gradient_norm <= 1e-8 * best.history[0].gradient_norm
    assert all(a.seconds <= b.seconds for a, b in zip(best.history, best.history[1:]))
    text = str(best)
    assert text.startswith("lbfgs: loss ") and text.endswith(best.message) and "..." in text
    assert repr(best) == text


def test_tolerance_as_number_and_as_function():
    loose, tight = (dp.minimize(valley, np.array([-1.2, 1.0]), tolerance=t) for t in (1e-2, 1e-10))
    assert loose.converged and tight.converged and loose.evaluations < tight.evaluations
    rule = dp.minimize(valley, np.array([-1.2, 1.0]), tolerance=lambda record, first: record.value < 0.1 * first.value)
    assert rule.converged and len(rule.history) < len(tight.history)


def test_callback_stops():
    seen = []

    def callback(record, x):
        seen.append((record.iteration, valley(x) == record.value))
        return record.iteration == 3

    best = dp.minimize(valley, np.array([-1.2, 1.0]), callback=callback)
    assert seen == [(1, True), (2, True), (3, True)]
    assert best.message == "stopped by the callback" and not best.converged


def test_progress_bar(capsys, monkeypatch):
    pytest.importorskip("tqdm")
    dp.minimize(walled(valley, 1.3), np.array([-1.2, 1.0]), maxiter=3, progress="fit")
    shown = capsys.readouterr()
    assert "fit" in shown.err and "loss" in shown.err and shown.out == ""
    monkeypatch.setitem(sys.modules, "tqdm.auto", None)
    with pytest.raises(
        ImportError, match=r"a progress bar needs tqdm; install sparsedp\[plot\], or leave progress out"
    ):
        dp.minimize(bowl, np.ones(2), progress=True)


def test_states_are_values_that_can_be_resumed():
    """Every step depends on its state alone: continuing from a stored state gives the same bits."""
    for method in (Adam(rate=0.05), GradientDescent(rate=1e-3, momentum=0.9), GradientDescent()):
        packing = Packing(np.array([-1.2, 1.0]))
        objective = Objective(valley, None, packing, Box(), Batches())
        state = method.begin(objective.evaluate_start(np.array([-1.2, 1.0])))
        states = [state]
        for _ in range(6):
            states.append(method.advance(states[-1], objective))
        again = method.advance(states[3], objective)
        assert all(np.array_equal(a, b) for a, b in zip(again[1:], states[4][1:]))
        assert np.array_equal(again.current.point, states[4].current.point)


def test_history_counts_forward_and_adjoint_solves(tmp_path):
    solve = dp.inverse(-dp.laplacian(dp.Grid((6, 5)), dp.dirichlet))
    target = np.arange(30.0).reshape(6, 5)

    def run(maxiter, **options):
        return dp.minimize(lambda b: anp.sum((solve(b) - target) ** 2), 0 * target, maxiter=maxiter, **options)

    best = run(6)
    assert [record.solves for record in best.history] == [2 * record.evaluations for record in best.history]
    assert dp.minimize(lambda x: anp.sum(x**2), np.ones(2)).history[-1].solves == 0
    run(3, checkpoint=tmp_path)
    again = run(6, checkpoint=tmp_path)
    assert again.resumed.startswith("resumed") and again.history[-1].solves == best.history[-1].solves


def test_convergence_plot():
    pytest.importorskip("matplotlib")
    from sparsedp.report.plots import figure

    best = dp.minimize(lambda x: anp.sum((x - 1.0) ** 2) - 2.0, np.zeros(2), "gd", rate=0.25, maxiter=4)
    ax = dp.report.convergence(best, figure().add_subplot(), against="evaluations")
    assert [line.get_label() for line in ax.lines] == ["loss - least loss", "gradient norm"]
    assert list(ax.lines[1].get_ydata()) == [record.gradient_norm for record in best.history]
    assert ax.get_yscale() == "log" and ax.get_xlabel() == "evaluations"
    with pytest.raises(
        ValueError, match="against of convergence must be one of iteration, seconds, evaluations, solves, got 'time'"
    ):
        dp.convergence(best, against="time")
