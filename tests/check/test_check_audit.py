"""The audit of a gradient: nested leaves, dtypes, the table, and what it refuses."""

import json
from collections import Counter, namedtuple

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils.counters import thread

AUDIT = dp.check.gradient
X = np.linspace(1.0, 2.0, 20)
GRID = dp.Grid((6, 5), size=(1.0, 2.0))


def smooth(u):
    return anp.sum(anp.sin(u) * u**2)


def slope(u):
    return np.cos(u) * u**2 + 2 * u * np.sin(u)


Pair = namedtuple("Pair", "k n")


def test_nested_leaves_of_different_sizes():
    tree = {"k": 1e-12 * X, "u": (1e5 * X, 3), "s": 2.0, "pair": Pair(np.float64(0.5), None)}

    def loss(t):
        first = anp.sum(anp.sin(1e12 * t["k"])) * t["s"]
        return first + t["u"][1] * anp.sum((1e-5 * t["u"][0]) ** 2) + anp.exp(t["pair"].k)

    def wrong(t):
        grad = dp.value_and_grad(loss)(t)[1]
        return {**grad, "s": 1.001 * grad["s"]}

    before = {"k": tree["k"].copy(), "u": tree["u"][0].copy()}
    result = AUDIT(loss, tree)
    assert result and result.size == 42
    assert "random in x['u'][0]" in {line.direction for line in result.lines}
    assert "random in x['pair'].k" in {line.direction for line in result.lines}
    found = AUDIT(loss, tree, gradient=wrong)
    assert found.verdict == "disagrees"
    assert np.array_equal(before["k"], tree["k"]) and np.array_equal(before["u"], tree["u"][0])


def test_leaves_that_do_not_matter():
    assert AUDIT(lambda t: anp.sum(t[0] ** 2), (X, X))
    assert (
        AUDIT(lambda t: np.sum(t[0] ** 2), (X, X), gradient=lambda t: (2 * t[0], 1 + 0 * t[1])).verdict == "disagrees"
    )


def test_single_precision():
    x = X.astype(np.float32)
    result = AUDIT(smooth, x)
    assert result and result.digits >= 3
    assert AUDIT(smooth, x, gradient=lambda u: (1.001 * slope(u)).astype(np.float32)).verdict == "disagrees"


def test_complex_leaves(rng):
    z = rng.standard_normal(5) + 1j * rng.standard_normal(5)
    assert AUDIT(lambda u: anp.sum(anp.abs(u) ** 2) + anp.real(anp.sum(u**3)), z)
    assert AUDIT(lambda u: np.sum(np.abs(u) ** 2), z, gradient=lambda u: 2 * np.conj(u))
    assert AUDIT(lambda u: np.sum(np.abs(u) ** 2), z, gradient=lambda u: 2 * u).verdict == "disagrees"


def test_numbers_linear_losses_and_solves():
    assert AUDIT(lambda u: u**3, 2.0)
    assert AUDIT(lambda u: anp.sum(u * X), X).digits >= 10
    solve = dp.inverse(-dp.laplacian(GRID, dp.dirichlet))
    assert AUDIT(lambda b: anp.sum(solve(anp.exp(b)) ** 2), np.sin(np.arange(30.0)).reshape(6, 5)).digits >= 6


def test_the_audited_loss_is_not_recorded():
    """A ledger that is open may change how things are called; one run on its own tells which solves there are."""
    solve = dp.inverse(-dp.laplacian(GRID, dp.dirichlet), "krylov", rtol=1e-9)
    seen = []

    def loss(b):
        seen.append(bool(thread.calls))
        return anp.sum(solve(b) ** 2)

    assert AUDIT(loss, np.sin(np.arange(30.0)).reshape(6, 5)) and seen.count(True) == 1
    del seen[:]
    assert AUDIT(lambda u: seen.append(bool(thread.calls)) or smooth(u), X) and not any(seen)


def test_rules_without_a_jvp_and_losses_that_write_into_their_argument():
    cube = dp.differentiable("cube", lambda u: u**3, lambda nums, ans, u: lambda g: (3 * u**2 * g,))
    assert "forward mode: not available" in str(AUDIT(lambda u: anp.sum(cube(u)), X))

    def greedy(u):
        u *= 2
        return np.sum(u**2)

    x = X.copy()
    assert AUDIT(greedy, x, gradient=8 * x)
    assert np.array_equal(x, X)


def test_table_and_data():
    result = AUDIT(smooth, X, directions=1)
    text = str(result)
    assert repr(result) == f"<gradient agrees: {result.digits} digits>" and "DirectionResult" in str(result.lines[0])
    assert text.splitlines()[-1].startswith("verdict: agrees to ")
    assert "order 2" in text and "largest entry" in text
    data = json.loads(json.dumps(result.to_dict()))
    assert data["verdict"] == "agrees" and len(data["rows"]) == len(result.rows) == 40
    steps = [row["step"] for row in result.rows if row["direction"] == "random 1"]
    assert len(steps) >= 8 and max(steps) / min(steps) >= 1e8


def test_the_table_omits_steps_of_single_directions():
    """One direction of six needs finer steps; they are in `rows`. The step of each plateau is in the table."""
    result = AUDIT(lambda u: anp.sum(anp.cos(30 * u)), 0.1 * np.arange(9.0))
    counts = Counter(row["step"] for row in result.rows)
    assert len(result.lines) == 6 and sorted(set(counts.values())) == [1, 6]
    table = str(result).partition("largest entry\n")[2].partition("  direction ")[0]
    printed = [line.split()[0] for line in table.splitlines()]
    shown = {step for step, count in counts.items() if count == 6} | {direction.step for direction in result.lines}
    assert printed == [f"{step:.2g}" for step in sorted(shown, reverse=True)] and len(shown) < len(counts)


def test_own_steps_and_bad_arguments():
    steps = np.logspace(-9, -1, 9)
    assert AUDIT(smooth, X, steps=steps).evaluations == 3 + 2 * 8 + 6 * 18  # two tables of differences for the noise
    with pytest.raises(ValueError, match=r"a sweep needs at least 8 different positive steps, got \[0.1\]; omit"):
        AUDIT(smooth, X, steps=[0.1])
    with pytest.raises(
        dp.errors.DerivativeError,
        match=r"floating values are needed, and x holds none; write np.asarray\(x, float\)",
    ):
        AUDIT(smooth, np.arange(3))
    with pytest.raises(
        dp.errors.NonFiniteError,
        match="x must be finite where a gradient is checked, got 20 that are NaN or infinite, the first at ",
    ):
        AUDIT(smooth, X * np.nan)
    with pytest.raises(dp.errors.DerivativeError, match="gradient: expected one array or number, got a tuple"):
        AUDIT(smooth, X, gradient=lambda u: (u, u))
    with pytest.raises(dp.errors.DerivativeError, match=r"gradient: expected shape \(20,\), got \(1,\)"):
        AUDIT(smooth, X, gradient=lambda u: u[:1])
    with pytest.raises(dp.errors.ShapeError, match="the loss must be a scalar"):
        AUDIT(lambda u: u, X, gradient=lambda u: u)
    with pytest.raises(dp.errors.DerivativeError, match="the loss must be real"):
        AUDIT(lambda u: 1j * np.sum(u), X, gradient=lambda u: u)
    with pytest.raises(AttributeError, match="Audit is frozen; make a new one instead of setting verdict"):
        AUDIT(smooth, X).verdict = "agrees"
