"""Foreign code without derivatives: sparsity, colours, differences and the checks on first use."""

import re

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.ledger import recording


def reaction(x):
    """One step of Gray and Scott's reaction on a periodic square, in plain NumPy."""
    u, v = x
    spread = lambda a: sum(np.roll(a, s, axis) for axis in (0, 1) for s in (-1, 1)) - 4 * a
    eaten = u * v * v
    return np.stack([u + 0.16 * spread(u) - eaten + 0.04 * (1 - u), v + 0.08 * spread(v) + eaten - 0.1 * v])


def real_only(x):
    """The same, through code that loses an imaginary part."""
    return reaction(np.asarray(x.real, dtype=float))


def traced(x):
    """The same in autograd.numpy."""
    u, v = x[0], x[1]
    spread = lambda a: sum(anp.roll(a, s, axis) for axis in (0, 1) for s in (-1, 1)) - 4 * a
    eaten = u * v * v
    return anp.stack([u + 0.16 * spread(u) - eaten + 0.04 * (1 - u), v + 0.08 * spread(v) + eaten - 0.1 * v])


@pytest.mark.parametrize(
    "f, way, runs, digits", [(reaction, "complex step", 10, 1e-13), (real_only, "central", 20, 1e-8)]
)
def test_a_step_of_foreign_code(rng, f, way, runs, digits):
    x, g = rng.random((2, 64, 64)), rng.standard_normal((2, 64, 64))
    step = dp.adopt(f)
    slope = dp.value_and_grad(lambda x: anp.sum(g * step(x)))(x)[1]
    known = dp.value_and_grad(lambda x: anp.sum(g * traced(x)))(x)[1]
    assert np.linalg.norm(slope - known) <= digits * np.linalg.norm(known)
    assert step.way.startswith(way) and step.jacobian(x).nnz == 6 * 8192
    before = step.runs
    step.jacobian(x + 1)
    assert step.runs - before <= runs + 1
    assert re.search(r"Jacobian 8192 x 8192 with 49152 entries from \d+ runs instead of 8192, by " + way, str(step))


def test_the_audit_agrees_and_jvps_fit(rng):
    x = rng.random((2, 6, 7))
    step = dp.adopt(reaction)
    assert dp.check.gradient(lambda x: anp.sum(anp.sin(3 * step(x))), x).verdict == "agrees"
    v, g = rng.standard_normal((2, *x.shape))
    forward = dp.derivative.pushforward(step, x, v)[1]
    assert np.sum(forward * g) == pytest.approx(np.sum(dp.derivative.pullback(step, x)[1](g) * v), rel=1e-12)


def test_runs_are_counted_and_kept_for_the_last_two_points(rng):
    x, y = rng.random((2, 2, 4, 4))
    step = dp.adopt(reaction)
    both = dp.value_and_grad(lambda x: anp.sum(step(x) ** 2))
    both(x), both(y)
    with recording() as calls:
        both(x), both(y)
    assert calls["reaction.run", "forward"] == 2
    assert str(dp.adopt(reaction)) == "reaction: no derivative asked for yet, 0 runs"


def test_as_the_jacobian_of_implicit(rng):
    """A backward step of foreign code."""
    step = dp.adopt(reaction)
    start = rng.random((2, 5, 5))
    root = dp.implicit(lambda x, b: 1.1 * x - 0.1 * step(x) - b)
    x = root(start, start)
    assert np.allclose(1.1 * x - 0.1 * reaction(x), start)
    assert dp.check.gradient(lambda b: anp.sum(root(start, b) ** 2), start).verdict == "agrees"


def test_a_given_sparsity_saves_the_probing(rng):
    x = rng.standard_normal(50)
    pattern = np.eye(50) + np.eye(50, k=1) + np.eye(50, k=-49)
    f = dp.adopt(lambda x: x * np.roll(x, -1), sparsity=pattern, name="pairs")
    jacobian = f.jacobian(x)
    assert np.allclose(jacobian.toarray(), np.diag(np.roll(x, -1)) + np.diag(x[:-1], 1) + np.diag(x[-1:], -49))
    assert f.runs < 12


@pytest.mark.parametrize("shape", [(1,), (0,), (3, 1)])
def test_small_and_empty(shape):
    x = np.full(shape, 2.0)
    f = dp.adopt(lambda x: x**3)
    assert np.allclose(dp.value_and_grad(lambda x: anp.sum(f(x)))(x)[1], 12.0)


def test_outputs_of_another_shape_and_a_full_jacobian(rng):
    matrix = rng.standard_normal((3, 30))
    f = dp.adopt(lambda x: matrix @ np.sin(x), name="sensors")
    x = rng.standard_normal(30)
    assert np.allclose(f.jacobian(x).toarray(), matrix * np.cos(x), rtol=1e-12)
    assert f(x.astype(np.float32)).shape == (3,)
