"""Who is at fault: the audit names the call whose own derivative is wrong; and what it knows about ripples."""

import json
import os
import subprocess
import sys
from collections import Counter

import autograd.numpy as anp
import numpy as np
import pytest
from autograd.test_util import check_grads
from planted import call, rule, scene

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp.check.nodes import calls_seen, in_order

AUDIT = dp.check.gradient
GRID = dp.Grid((5, 4), spacing=0.7)
X = np.linspace(1.0, 2.0, 20).reshape(5, 4)


def named(seeds, error, **options):
    """How often the verdict is right, and the culprit the planted one (none without an error)."""
    found = Counter()
    for seed in seeds:
        loss, x, planted = scene(seed, error, **options)
        result = AUDIT(loss, x, directions=1)
        found[result.verdict, result.culprit == (planted if error else None)] += 1
    return found


@pytest.mark.sampled(1)
@pytest.mark.parametrize("seeds", [(1, 3), (5, 7), pytest.param((0, 2), marks=pytest.mark.whole)])
@pytest.mark.parametrize("error", [1e-3, 1e-4])
def test_the_culprit_of_random_scenes(error, seeds):
    assert named(seeds, error) == {("disagrees", True): 2}


@pytest.mark.parametrize("seeds", [(8, 9), pytest.param((10, 11, 12, 13), marks=pytest.mark.whole)])
def test_right_scenes_have_no_culprit(seeds):
    assert named(seeds, 0.0) == {("agrees", True): len(seeds)}


@pytest.mark.slow
@pytest.mark.parametrize("error", [1e-3, 1e-4])
def test_the_culprit_of_200_random_scenes(error):
    assert named(range(200), error)["disagrees", True] >= 198


@pytest.mark.slow
def test_200_right_scenes():
    found = named(range(200), 0.0)
    assert found["agrees", True] >= 190 and not any(verdict == "disagrees" for verdict, _ in found)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("kind", ["rule", "operator", "inverse", "elliptic", "matrix", "function", "operator given"])
def test_every_kind_of_call(kind, rng):
    act, name = call(kind, "guilty", GRID, rng, 1e-3, False)
    result = AUDIT(lambda u: anp.sum(anp.sin(act(u)) ** 2 * X), X, directions=1)
    assert result.verdict == "disagrees" and result.culprit == name
    assert f"culprit: {name}, its" in str(result) and result.to_dict()["culprit"] == name


def test_the_note_says_what_is_wrong(rng):
    act = call("inverse", "diffusion", GRID, rng, 1e-3, False)[0]
    assert "which it inverts" in str(AUDIT(lambda u: anp.sum(act(u) ** 2), X))
    act = rule("law", rng, 1e-3, jvp=True)
    result = AUDIT(lambda u: anp.sum(act(u) ** 2), X)
    assert result.culprit == "law" and "its JVP differs from its VJP by" in str(result)
    bent = dp.from_functions(lambda u: u + 1e-3 * u**2, lambda g: g, GRID.cells, GRID.cells, name="bent")
    assert AUDIT(lambda u: anp.sum(bent(u) ** 2), X).culprit == "bent"
    blind = dp.from_functions(lambda u: 2 * u, lambda g: g[::-1] + g, GRID.cells, GRID.cells, name="blind")
    assert "its transpose is off by" in str(AUDIT(lambda u: anp.sum(blind(u) ** 3), X))


@pytest.mark.whole
def test_a_fault_inside_a_root_or_a_loop(rng):
    """A rule that runs other rules is named only when none of those is at fault."""
    cube = dp.differentiable("cube", lambda u: u**3, lambda nums, ans, u: lambda g: (3.003 * u**2 * g,))
    root = dp.implicit(lambda u, p: u + cube(u) - p)
    found = AUDIT(lambda p: anp.sum(root(p, p) ** 2), X[0], directions=1)
    assert found.verdict == "disagrees" and found.culprit == "cube"

    def steps(u):
        for _ in range(3):
            u = cube(u) + u
        return u

    def vjp(nums, ans, u):
        return lambda g: (dp.value_and_grad(lambda v: anp.sum(g * steps(v)))(u)[1],)

    loop = dp.differentiable("loop", steps, vjp)
    assert AUDIT(lambda u: anp.sum(loop(u) ** 2), 0.1 * X).culprit == "cube"


@pytest.mark.sampled(0)
@pytest.mark.parametrize(
    "weight",
    [lambda u: anp.where(u > 0, 1.0, 2.0), anp.sign, anp.floor, anp.zeros_like, lambda u: anp.size(u) + anp.argmax(u)],
)
def test_functions_without_a_derivative_do_not_stop_the_search(weight):
    """Comparisons, shapes and rounding are plain values on the tape, and for those who look at it."""
    cube = dp.differentiable("cube", lambda u: u**3, lambda nums, ans, u: lambda g: (3.003 * u**2 * g,))
    x = np.linspace(-1.3, 1.6, 6)
    assert AUDIT(lambda u: anp.sum(weight(u) * u + cube(u)), x).culprit == "cube"
    assert AUDIT(lambda u: anp.sum(weight(u) * u + u**3), x)


def test_a_value_beside_the_tape_has_no_culprit():
    frozen = lambda u: anp.sum(u * np.sin(getattr(u, "_value", u)))
    found = AUDIT(frozen, X)
    assert found.verdict == "disagrees" and found.culprit is None
    assert "a value may bypass the tape" in str(found)
    assert AUDIT(lambda u: np.sum(u**2), X, gradient=lambda u: u).culprit is None


def test_a_gradient_that_was_given():
    assert AUDIT(lambda u: np.sum(u**3), X, gradient=lambda u: 3 * u**2)
    assert AUDIT(lambda u: np.sum(u**3), X, gradient=3 * X**2)
    assert AUDIT(lambda u: np.sum(u**3), X, gradient=lambda u: 3.003 * u**2).verdict == "disagrees"


# ---- a wrong rule behind every kind of call --------------------------------------------------------------------------


WRONG_CUBE = dp.differentiable("cube", lambda u: u**3, lambda nums, ans, u: lambda g: (3.03 * u**2 * g,))
LINE = np.linspace(1.0, 2.0, 5)
ROWS = np.linspace(1.0, 2.0, 12).reshape(4, 3)


def slow_down(u, p):
    return 0.9 * u + 0.01 * u**2


def run_of(u, step=slow_down, params=None, n=3, **options):
    return dp.rollout(step, u, params, n, **options)


def stepped(scheme, **options):
    return lambda u: run_of(u, dp.stepper(scheme, lambda u, p: -p * u, 0.1, **options), 0.3)


def swapped(state, params):
    return {"a": 0.9 * state["a"] + 0.1 * state["b"], "b": 0.5 * state["b"]}


def waves(u):
    step = dp.stepper("leapfrog", (lambda v, c: v, lambda p, c: -p), 0.1)
    return dp.rollout(step, (u, u), None, 5, memory="reverse")[0]


def root_of_a_tree(u):
    root = dp.implicit(
        lambda x, p: {"a": x["a"] + 0.1 * x["b"] ** 3 - p["a"], "b": x["b"] + 0.1 * x["a"] - p["b"]}, method="direct"
    )
    return root({"a": u, "b": u}, {"a": u, "b": u})["a"]


GRID_OF_ROWS = dp.Grid((4, 3))
DECAY = dp.identity(GRID_OF_ROWS.cells) - 0.1 * dp.laplacian(GRID_OF_ROWS, dp.dirichlet)
IN_FRONT = {  # what stands before the wrong rule, and where it is examined
    "rollout": (run_of, LINE),
    "rollout, memory": (lambda u: run_of(u, n=12, memory=300), LINE),
    "rollout, dict": (lambda u: run_of({"a": u, "b": 2 * u}, swapped)["a"], LINE),
    "rk4": (stepped("rk4"), LINE),
    "inverse": (dp.inverse(DECAY), ROWS),
}
MORE = {
    "rollout, all states": (lambda u: run_of(u, keep="all"), LINE),
    "rollout, inputs": (lambda u: dp.rollout(lambda v, p, x: 0.9 * v + x, u[0], None, 5, inputs=u), LINE),
    "ensemble": (lambda u: dp.ensemble(lambda p, scale: anp.sum(p**2) * scale, [1.0, 2.0])(u), LINE),
    "rollout, some states": (lambda u: run_of(u, keep=[1, 3]), LINE),
    "rollout, a function of states": (lambda u: run_of(u, keep=lambda i, v: anp.sum(v**2))[2], LINE),
    "rollout, params": (lambda u: run_of(u, lambda v, p: 0.9 * v + p, u), LINE),
    "rollout, number": (run_of, 1.3),
    "rollout in rollout": (lambda u: run_of(u, lambda v, p: run_of(v, n=2)), LINE),
    "leapfrog, reversed": (waves, LINE),
    "euler": (stepped("euler"), LINE),
    "adopt": (dp.from_blackbox(np.sin), LINE),
    "transport": (lambda u: dp.transport(GRID_OF_ROWS)(u, np.full(GRID_OF_ROWS.faces.size, 0.1), 0.1), ROWS),
    "implicit": (lambda u: dp.implicit(lambda x, p: x + x**3 - p)(u, u), LINE),
    "implicit, dict": (root_of_a_tree, LINE),
    "steady": (lambda u: dp.steady(lambda x, p: p - x - x**3, LINE, u), LINE),
    "krylov": (dp.inverse(DECAY, "krylov"), ROWS),
    "backward_euler": (stepped("backward_euler"), LINE),
    "radau, tolerance": (stepped("radau", tolerance=1e-6), LINE),
    "rk4, tolerance": (stepped("rk4", tolerance=1e-6), LINE),
}


@pytest.mark.sampled(0)
@pytest.mark.parametrize("name", [*IN_FRONT, *(pytest.param(name, marks=pytest.mark.whole) for name in MORE)])
def test_a_wrong_rule_behind(name):
    act, x = (IN_FRONT | MORE)[name]
    found = AUDIT(lambda u: anp.sum(WRONG_CUBE(act(u))), x, directions=1, quick=True)
    assert found.verdict == "disagrees" and found.culprit == "cube"
    assert "was not examined" not in str(found)


def test_a_rule_with_several_results_is_examined():
    def wrong(nums, ans, u):
        return lambda g: (2.02 * u * g[0] + anp.cos(u) * g[1],)

    pair = dp.differentiable("pair", lambda u: (u**2, np.sin(u)), wrong)
    assert AUDIT(lambda u: anp.sum(pair(u)[0]) + anp.sum(pair(u)[1]), LINE, quick=True).culprit == "pair"


def test_a_rollout_whose_derivative_is_cut():
    found = AUDIT(lambda u: anp.sum(run_of(u, n=4, truncate=2)), LINE, quick=True)
    assert found.verdict == "disagrees" and found.culprit == "rollout"
    assert "its derivative is cut by truncate=2" in str(found)


def test_a_call_that_cannot_be_examined_ends_no_search():
    def once(u):
        if np.any(u != LINE):
            raise KeyError("only there")
        return 1.0 * u

    shy = dp.differentiable("shy", once, lambda nums, ans, u: lambda g: (g,))
    beside = lambda u: anp.sum(shy(LINE + 0.0 * u)) + anp.sum(u * np.sin(getattr(u, "_value", u)))
    found = AUDIT(beside, LINE, quick=True)
    assert found.verdict == "disagrees" and "shy was not examined (KeyError" in str(found)


# ---- what others get wrong -----------------------------------------------------------------------------------------


def rule_of(name, forward, slope):
    return dp.differentiable(name, forward, lambda nums, ans, u: lambda g: (g * slope(u),))


SIZES = (1.0, 1e-200, 1e200)  # the verdict does not depend on it


@pytest.mark.parametrize("size", SIZES)
def test_check_grads_accepts_a_small_gradient_three_times_too_large(size):
    small = rule_of("small", lambda u: 1e-9 * u**2, lambda u: 3 * 2e-9 * u)
    check_grads(lambda u: anp.sum(small(u)), modes=["rev"], order=1)(X)  # passes
    found = AUDIT(lambda u: size * anp.sum(small(u)), X)
    assert found.verdict == "disagrees" and found.culprit == "small"


@pytest.mark.parametrize("size", SIZES)
def test_check_grads_accepts_any_error_below_a_millionth(size):
    offset = rule_of("offset", lambda u: 1e-8 * np.sin(u), lambda u: 1e-8 * np.cos(u) + 1e-8)
    check_grads(lambda u: anp.sum(offset(u)), modes=["rev"], order=1)(X)  # passes
    found = AUDIT(lambda u: size * anp.sum(offset(u)), X)
    assert found.verdict == "disagrees" and found.culprit == "offset"


@pytest.mark.parametrize("size", SIZES)
def test_check_grads_does_not_see_a_captured_parameter(size):
    """It moves the arguments that a rule has; the audit moves the parameter: 12 is right, 6 comes back."""

    def step(u, p):  # a checkpoint that captured p: its derivative in p is lost
        kept = getattr(p, "_value", p)
        return rule_of("checkpoint", lambda v: v * kept, lambda v: kept)(u)

    check_grads(lambda u: anp.sum(step(u, np.array([2.0]))), modes=["rev"], order=1)(np.array([2.0]))  # passes
    loss = lambda p: size * anp.sum(1.5 * step(p, p) * p)  # 1.5 p^3 with the slope 4.5 p^2 = 18: 12 is found
    assert AUDIT(loss, np.array([2.0])).verdict == "disagrees"


@pytest.mark.parametrize("size", SIZES)
def test_check_grads_accepts_a_random_function(rng, size):
    random = lambda u: anp.sum(u**2) + 1e-13 * rng.standard_normal()
    check_grads(random, modes=["rev"], order=1)(X)  # passes
    found = AUDIT(lambda u: size * random(u), X)
    assert found.verdict == "inconclusive" and "not deterministic" in found.reason


@pytest.mark.parametrize("frequency", [1e6, 1e7, 1e8])
def test_a_ripple_is_inconclusive(frequency):
    """The right gradient of a loss with a ripple differs from what coarse steps see."""
    x = np.linspace(1.0, 2.0, 20)
    found = AUDIT(lambda u: anp.sum(u**2) + anp.sum(anp.sin(frequency * u)) / frequency, x)
    assert found.verdict == "inconclusive" and "a ripple" in found.reason
    smooth = AUDIT(lambda u: np.sum(u**2), x, gradient=lambda u: 2.2 * u)
    assert smooth.verdict == "disagrees"


def test_a_call_that_refuses_other_cotangents_is_skipped():
    """As a step with error control may: it ends no search, the call at fault comes after it."""

    def pull(nums, ans, u):
        def back(g):
            if np.any(g != 2.1):
                raise dp.errors.DerivativeError("shy takes 2.1 only")
            return (g,)

        return back

    shy = dp.differentiable("shy", lambda u: 1.0 * u, pull)
    double = dp.differentiable("double", lambda u: 2.0 * u, lambda nums, ans, u: lambda g: (2.1 * g,))
    found = AUDIT(lambda u: anp.sum(double(shy(u))), np.ones(3), directions=1)
    assert found.verdict == "disagrees" and found.culprit == "double"


# ---- the result as data, in pytest, as a picture --------------------------------------------------------------------


def test_complex_step():
    assert "complex step: agrees to" in str(AUDIT(lambda u: anp.sum(anp.sin(u) * u**2), X))
    assert "complex step" not in str(AUDIT(lambda u: anp.sum(anp.abs(u) ** 2), X))


@pytest.mark.whole
def test_in_pytest(tmp_path):
    """A failing assertion shows the table and the culprit."""
    test = tmp_path / "test_it.py"
    test.write_text(
        "import numpy as np, autograd.numpy as anp, sparsedp as dp\n"
        "law = dp.differentiable('law', lambda u: u**2, lambda nums, ans, u: lambda g: (2.01 * u * g,))\n"
        "def test_gradient():\n    assert dp.check.gradient(lambda u: anp.sum(law(u)), np.ones(3) + np.arange(3.0))\n"
    )
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(test)],
        env={**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},  # they take longer than the test
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 1
    assert "culprit: law, its VJP is off by" in run.stdout and "<gradient disagrees: along" in run.stdout


def test_to_dict_and_picture():
    result = AUDIT(lambda u: anp.sum(anp.sin(u)), X)
    data = json.loads(json.dumps(result.to_dict()))
    assert data["verdict"] == "agrees" and data["culprit"] is None and len(data["rows"]) >= 30
    pytest.importorskip("matplotlib")
    from sparsedp.report.plots import figure

    ax = figure().add_subplot()
    assert dp.v_curve(result, ax) is ax
    assert len(ax.lines) == len(result.lines) and ax.get_xscale() == ax.get_yscale() == "log"
    assert "agrees" in ax.get_title()


def test_loose_solves_are_inconclusive():
    solve = dp.inverse(-dp.laplacian(dp.Grid((12, 12)), dp.dirichlet), "krylov", rtol=1e-3)
    b = np.sin(np.arange(144.0)).reshape(12, 12)
    found = AUDIT(lambda u: anp.sum(solve(u) ** 3), b, directions=1)
    assert found.verdict == "inconclusive" and "tighten" in found.reason
    assert (
        AUDIT(lambda u: anp.sum(solve(-u) * u) * 0.0 + anp.sum(u**2), b, gradient=lambda u: 3 * u).verdict
        == "disagrees"
    )
    law = rule_of("law", lambda u: u**3, lambda u: 4 * u**2)
    assert AUDIT(lambda u: anp.sum(law(solve(u))), b, directions=1).culprit == "law"


def test_a_fault_inside_rollout_transport_and_steps():
    grid = dp.Grid((6, 5), size=1.0)
    L = dp.laplacian(grid, dp.dirichlet)
    move = dp.transport(grid, "upwind")
    ink = np.cos(np.arange(30.0)).reshape(6, 5)
    wind = 0.1 * np.sin(np.arange(float(grid.faces.size)))
    cube = dp.differentiable(
        "cube", lambda u: u**3, lambda nums, ans, u: lambda g: (3.003 * u**2 * g,), lambda n, t, ans, u: 3 * u**2 * t[0]
    )
    bent = dp.from_functions(L.apply, lambda g: 1.001 * L.T.apply(g), grid.cells, grid.cells, "bent")
    step = dp.stepper("rk4", lambda u, p: p * bent(u), 1e-3)
    scenes = (
        (lambda v: anp.sum(dp.rollout(lambda u, w: move(cube(u), w, 0.02) + 0.1 * u, ink, v, 3) ** 2), wind, "cube"),
        (lambda p: anp.sum(dp.rollout(step, ink, p, 3) ** 2), 0.05, "bent"),
    )
    for loss, x, name in scenes:
        found = AUDIT(loss, x, directions=1)
        assert found.verdict == "disagrees" and found.culprit == name
    assert AUDIT(lambda v: anp.sum(dp.rollout(lambda u, w: move(u, w, 0.02), ink, v, 3) ** 2), wind, directions=1)


@pytest.mark.parametrize("memory", [None, 2000])
def test_the_search_looks_at_the_tape_that_a_loop_keeps(memory):
    """Whatever a rollout keeps, or runs again: those who look at the nodes change nothing."""
    cube = dp.differentiable("cube", lambda u: u**3, lambda nums, ans, u: lambda g: (3.003 * u**2 * g,))
    loss = lambda u: anp.sum(dp.rollout(lambda u, p: 0.01 * cube(u) + u, u, None, 5, memory=memory) ** 2)
    plain, seen = (dp.explain(loss, X).counts["rollout.step", "recomputed"] for _ in range(2))
    with calls_seen() as nodes, recording() as calls:
        dp.value_and_grad(loss)(X)
    assert plain == seen == calls["rollout.step", "recomputed"]
    assert sum(node.name == "cube" for node in in_order(nodes)) >= 5
    assert AUDIT(loss, X).culprit == "cube"
