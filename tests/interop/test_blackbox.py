"""Foreign code without derivatives: sparsity, colours, differences and the checks on first use."""

import re

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp.autodiff import derivative


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
    u = x[0]
    v = x[1]
    spread = lambda a: sum(anp.roll(a, s, axis) for axis in (0, 1) for s in (-1, 1)) - 4 * a
    eaten = u * v * v
    return anp.stack([u + 0.16 * spread(u) - eaten + 0.04 * (1 - u), v + 0.08 * spread(v) + eaten - 0.1 * v])


@pytest.mark.parametrize(
    "f, way, runs, digits", [(reaction, "complex step", 10, 1e-13), (real_only, "central", 20, 1e-8)]
)
def test_a_step_of_foreign_code(rng, f, way, runs, digits):
    x = rng.random((2, 64, 64))
    g = rng.standard_normal((2, 64, 64))
    step = dp.from_blackbox(f)
    slope = dp.value_and_grad(lambda x: anp.sum(g * step(x)))(x)[1]
    known = dp.value_and_grad(lambda x: anp.sum(g * traced(x)))(x)[1]
    assert np.linalg.norm(slope - known) <= digits * np.linalg.norm(known)
    assert step.way.startswith(way) and step.jacobian(x).nnz == 6 * 8192
    before = step.runs
    step.jacobian(x + 1)
    assert step.runs - before <= runs + 4  # itself, and the probes
    assert re.search(r"Jacobian 8192 x 8192 with 49152 entries from \d+ runs instead of 8192, by " + way, str(step))


def test_the_audit_agrees_and_jvps_fit(rng):
    x = rng.random((2, 6, 7))
    step = dp.from_blackbox(reaction)
    assert dp.check.gradient(lambda x: anp.sum(anp.sin(3 * step(x))), x, quick=True).verdict == "agrees"
    v, g = rng.standard_normal((2, *x.shape))
    forward = derivative.pushforward(step, x, v)[1]
    assert np.sum(forward * g) == pytest.approx(np.sum(derivative.pullback(step, x)[1](g) * v), rel=1e-12)


def test_runs_are_counted_and_kept_for_the_last_two_points(rng):
    x, y = rng.random((2, 2, 4, 4))
    step = dp.from_blackbox(reaction)
    both = dp.value_and_grad(lambda x: anp.sum(step(x) ** 2))
    both(x), both(y)
    with recording() as calls:
        both(x), both(y)
    assert calls["reaction.run", "forward"] == 2
    assert str(dp.from_blackbox(reaction)) == "reaction: no derivative asked for yet, 0 runs"


@pytest.mark.whole
def test_as_the_jacobian_of_implicit(rng):
    """A backward step of foreign code."""
    step = dp.from_blackbox(reaction)
    start = rng.random((2, 3, 3))
    root = dp.implicit(lambda x, b: 1.1 * x - 0.1 * step(x) - b)
    x = root(start, start)
    assert np.allclose(1.1 * x - 0.1 * reaction(x), start)
    assert dp.check.gradient(lambda b: anp.sum(root(start, b) ** 2), start, quick=True).verdict == "agrees"


def test_a_given_sparsity_saves_the_probing(rng):
    x = rng.standard_normal(50)
    pattern = np.eye(50) + np.eye(50, k=1) + np.eye(50, k=-49)
    f = dp.from_blackbox(lambda x: x * np.roll(x, -1), sparsity=pattern, name="pairs")
    jacobian = f.jacobian(x)
    assert np.allclose(jacobian.toarray(), np.diag(np.roll(x, -1)) + np.diag(x[:-1], 1) + np.diag(x[-1:], -49))
    assert f.runs < 12


@pytest.mark.parametrize("shape", [(1,), (0,), (3, 1)])
def test_small_and_empty(shape):
    x = np.full(shape, 2.0)
    f = dp.from_blackbox(lambda x: x**3)
    assert np.allclose(dp.value_and_grad(lambda x: anp.sum(f(x)))(x)[1], 12.0)


def test_outputs_of_another_shape_and_a_full_jacobian(rng):
    matrix = rng.standard_normal((3, 30))
    f = dp.from_blackbox(lambda x: matrix @ np.sin(x), name="sensors")
    x = rng.standard_normal(30)
    assert np.allclose(f.jacobian(x).toarray(), matrix * np.cos(x), rtol=1e-12)
    assert f(x.astype(np.float32)).shape == (3,)


def walls(x):
    """Diffusion and upwind differences in a box: bounded, and entries that come and go with the sign of x."""
    v = np.pad(x, 1, mode="edge")
    spread = v[2:, 1:-1] + v[:-2, 1:-1] + v[1:-1, 2:] + v[1:-1, :-2] - 4 * x
    return x + 0.1 * spread - 0.1 * np.where(x > 0, x * (x - v[:-2, 1:-1]), x * (v[2:, 1:-1] - x))


def far(x):
    """The reaction, with one cell that sees another far away."""
    y = reaction(x)
    y[0, 3, 3] += 1e-3 * x[1, 40, 50]
    return y


@pytest.mark.parametrize(
    "f, shape, most",
    [(reaction, (2, 64, 64), 100), (real_only, (2, 64, 64), 130), (walls, (64, 63), 100), (far, (2, 64, 64), 700)],
)
def test_a_stencil_is_found_from_a_few_cells(rng, f, shape, most):
    """And where the field is not the same everywhere the whole pattern is searched for."""
    x = rng.standard_normal(shape)
    step = dp.from_blackbox(f)
    jacobian = step.jacobian(x)
    assert step.runs <= most
    v = 1e-6 * rng.standard_normal(shape)
    change = (f(x + v) - f(x - v)).reshape(-1) / 2
    assert np.linalg.norm(jacobian @ v.reshape(-1) - change) <= 1e-7 * np.linalg.norm(change)
    if f is far:
        row, column = (np.ravel_multi_index(place, shape) for place in ((0, 3, 3), (1, 40, 50)))
        assert jacobian[row, column] == pytest.approx(1e-3) and step.runs > 200
    if f is walls:
        assert jacobian.nnz == 5 * 64 * 63 - 2 * (64 + 63)  # nothing reaches round a wall


@pytest.mark.parametrize("size", [1e-6, 1e-10, 1e-30, 1e-100])
def test_small_rows_keep_what_no_stencil_has(rng, size):
    """A row of other units is not lost in the rounding of the largest, where differences are taken."""
    sizes = np.ones(300)
    x = rng.standard_normal(300)
    sizes[[37, 101]] = size

    def f(x):
        x = np.asarray(x).real
        return sizes * (np.roll(x, 1) - 2 * x + 0.1 * x**2 + np.where(sizes < 1, np.sum(x), 0.0))

    small = dp.from_blackbox(f, derivative="difference").jacobian(x).toarray()[[37, 101]]
    assert np.all(small != 0) and np.max(np.abs(small[0, 200:] / size - 1)) < 1e-6


@pytest.mark.parametrize("limit", [1.0001, 1.15, 1.2, 1.25, 1.4])
@pytest.mark.parametrize("answer", ["raises", "is not finite"])
def test_code_that_refuses_what_is_near(limit, answer):
    def picky(x):
        if np.max(np.abs(x)) > limit and answer == "raises":
            raise ValueError("too large")
        return np.where(np.max(np.abs(x)) > limit, np.nan, x * np.roll(x, 1))

    jacobian = dp.from_blackbox(picky).jacobian(np.full(300, 1.0))
    assert jacobian.nnz == 600 and np.allclose(jacobian.sum(axis=1), 2.0)
