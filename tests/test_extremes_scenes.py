"""Extreme cases of composed scenes: Poisson solves, the projection of a velocity, steps in time with gradients.

The projection is v -> inside(v) + G(pressure(D(inside(v)))); the steps are implicit diffusion in a Python loop.
Left out: CFL numbers and growing steps (transport), dt <= 0 (steppers), 10^4 steps within a memory budget and
chaotic horizons (rollouts).
"""

import re

import autograd
import autograd.numpy as anp
import numpy as np
import pytest

from extremes import (  # isort: skip
    CLOSED,
    COEFFICIENTS,
    COLUMNS,
    EVERY,
    STRONG,
    GEOMETRIES,
    KINDS,
    OPTIONS,
    agree,
    check_gradient_of_kind,
    check_kind,
    coefficient,
    dense,
    elliptic,
    exact,
    march,
    projection,
    same_bits,
    solver,
    speeds,
    stretched,
)

import sparsedp as dp
from sparsedp._utils.validation import place
from sparsedp.autodiff.derivative import pullback

NONFINITE = dp.errors.NonFiniteError
SHAPE = dp.errors.ShapeError
DERIVATIVE = dp.errors.DerivativeError

HARD = {name: (grid, coefficient(name, grid)) for name in COEFFICIENTS for grid in [dp.Grid((16, 14))]}
for name, spacing in {"flat cells": (1.0, 1e-4), "high cells": (1e-4, 1.0)}.items():
    HARD[name] = (grid := dp.Grid((15, 14), spacing=spacing), speeds(grid))
IN_HARD = pytest.mark.parametrize("name", HARD)
IN_COLUMNS = pytest.mark.parametrize("column", COLUMNS)


def pull(run, x, g):
    return pullback(run, x)[1](g)


@EVERY
@IN_COLUMNS
def test_against_dense_algebra(column, method, rng):
    run, shape, matrix, _, _ = COLUMNS[column](method)
    x, g = rng.standard_normal((2, *shape))
    agree(run(x).ravel(), matrix @ x.ravel())
    agree(pull(run, x, g).ravel(), matrix.T @ g.ravel())
    slope = dp.value_and_grad(lambda x: anp.sum(run(x) ** 2))(x)[1]
    agree(slope.ravel(), 2 * matrix.T @ (matrix @ x.ravel()))


@pytest.mark.sampled(1)
@EVERY
@IN_COLUMNS
def test_field_zero(column, method, rng):
    """Exactly 0 without a solve; the gradient is the one of the linear map, which is not 0."""
    run, shape, matrix, infos, _ = COLUMNS[column](method)
    x, g = rng.standard_normal((2, *shape))
    same_bits(run(zeros := np.zeros(shape)), zeros)
    assert all((info.forward.status, info.forward.iterations) == ("exact_zero_rhs", 0) for info in infos)
    same_bits(pull(run, x, zeros), zeros)
    assert all((info.adjoint.status, info.adjoint.iterations) == ("exact_zero_rhs", 0) for info in infos)
    slopes = [dp.value_and_grad(lambda x: anp.sum(g * run(x)))(start)[1] for start in (zeros, x)]
    same_bits(*slopes)
    agree(slopes[0].ravel(), matrix.T @ g.ravel())
    assert np.any(slopes[0])


@pytest.mark.sampled(1)
@EVERY
@IN_COLUMNS
@pytest.mark.parametrize("bad", [np.nan, -np.inf])
def test_field_not_finite(column, method, bad, rng):
    run, shape, matrix, infos, reaches = COLUMNS[column](method)
    x, g = rng.standard_normal((2, *shape))
    at = np.flatnonzero(np.any(matrix, axis=0))[x.size // 4]  # a wall or a solid would not let it in
    x.flat[at] = g.flat[at] = bad
    with np.errstate(invalid="ignore"):
        wrong = ~np.isfinite(reaches(x))
        count = np.count_nonzero(wrong)
        first = place(np.argmax(wrong), wrong.shape)
        words = re.escape(f"got {count} that are NaN or infinite, the first at {first}")
        for call in (run, dp.value_and_grad(lambda x: anp.sum(run(x)))):
            with pytest.raises(NONFINITE, match=rf"^(inverse|elliptic_solver).* numbers, {words}$"):
                call(x)
        assert infos[0].forward.status == "nonfinite_input"
        with pytest.raises(NONFINITE, match=r"takes finite numbers, got \d+ that are NaN or infinite, the first at"):
            pull(run, np.ones(shape), g)


@pytest.mark.sampled(1)
@EVERY
@IN_COLUMNS
@pytest.mark.parametrize("exponent", [-963, -301, 900, 963])
def test_scale_of_the_data(column, method, exponent, rng):
    """Fields and cotangents from 1e-290 to 1e290: the same bits, scaled."""
    run, shape, *_ = COLUMNS[column](method)
    x, g = rng.standard_normal((2, *shape))
    same_bits(run(np.ldexp(x, exponent)), np.ldexp(run(x), exponent))
    wanted = np.ldexp(pull(run, x, g), exponent)
    same_bits(pull(run, x, np.ldexp(g, exponent)), wanted)
    same_bits(pull(run, np.ldexp(x, -exponent), np.ldexp(g, exponent)), wanted)
    value, slope = dp.value_and_grad(lambda x: 2.0**exponent * anp.sum(g * run(x)))(x)
    same_bits(slope, wanted)
    assert value == np.ldexp(np.sum(g * run(x)), exponent)


@pytest.mark.sampled(1)
@EVERY
@IN_COLUMNS
@pytest.mark.parametrize("kind", KINDS)
def test_kinds_of_arrays(column, method, kind, rng):
    run, shape, *_ = COLUMNS[column](method)
    x = KINDS[kind](rng.standard_normal(shape))
    check_kind(run, x)
    check_gradient_of_kind(lambda x: anp.sum(run(x) ** 2), x)
    g = KINDS[kind](rng.standard_normal(shape))
    before = g.copy()
    wanted = pull(run, np.ones(shape), g.astype(float))
    agree(pull(run, np.ones(shape), g), wanted, 2e-6 * (kind == "float32"))
    assert np.array_equal(g, before)


@pytest.mark.sampled(1)
@EVERY
@IN_COLUMNS
def test_wrong_shapes_and_complex_numbers(column, method, rng):
    run, shape, *_ = COLUMNS[column](method)
    x, y = rng.standard_normal((2, *shape))
    agree(run(np.stack([x, y])), np.stack([run(x), run(y)]))  # leading axes are a batch
    for wrong in (x[None], x[:-1], x[..., None], 1.0, x.sum(axis=-1), np.zeros(0)):
        for call in (run, lambda g: pull(run, x, g)):
            if not (call is run and np.shape(wrong)[1:] == x.shape):
                with pytest.raises(SHAPE):
                    call(wrong)
    agree(run(x + 1j * y), run(x) + 1j * run(y), 1e-13)
    with pytest.raises(DERIVATIVE):
        dp.value_and_grad(lambda x: anp.sum(run(x)))(x + 1j * y)


@pytest.mark.sampled(1)
@EVERY
@pytest.mark.parametrize("where", GEOMETRIES)
def test_projection_everywhere(method, where, rng):
    """Regions, islands, solids and sizes: against dense algebra; twice is once; nothing that is closed flows."""
    shape, solid = GEOMETRIES[where]
    run, shape, matrix, infos, reaches = projection(method, stretched(*shape), solid)
    v, g = rng.standard_normal((2, *shape))
    u = run(v)
    agree(u, matrix @ v, size=1.0)
    agree(pull(run, v, g), matrix.T @ g, size=1.0)
    agree(run(u), u, size=1.0)
    assert np.max(np.abs(reaches(u)), initial=0.0) <= 1e-8 * np.max(np.abs(reaches(v)), initial=0.0)
    assert not np.any(u[~np.any(matrix, axis=0)])
    assert np.any(matrix) or infos[0].forward.status == infos[0].adjoint.status == "exact_zero_rhs"


@EVERY
@pytest.mark.parametrize("defect", [1e-14, 1e-7, 1.0])
def test_projection_of_a_flow_through_the_walls(method, defect, rng):
    """Without closed walls the divergence has a mean: it is taken out and recorded, and never refused."""
    grid = stretched(12, 11)
    G = dp.gradient(grid)
    D = dp.divergence(grid)
    w = grid.volumes
    pressure = solver(-D @ G, method, nullspace="project")
    v, g = rng.standard_normal((2, grid.faces.size)) * dp.interior(grid)(np.ones(grid.faces.size))
    size = np.linalg.norm(w) * np.linalg.norm(D(v)) / np.sum(w)
    v = v + defect * size * grid.join(grid.face_centres(0)[0], 0.0)  # of divergence 1
    matrix = np.eye(v.size) + dense(G) @ exact(-D @ G) @ dense(D)
    run = lambda v: v + G(pressure(D(v)))
    agree(run(v), matrix @ v)
    measured = abs(np.sum(w * D(v))) / np.linalg.norm(w) / np.linalg.norm(D(v))
    assert pressure.info.forward.defect == pytest.approx(measured, rel=1e-6, abs=1e-14)
    agree(pull(run, v, g), matrix.T @ g)


@pytest.mark.sampled(1)
@STRONG
@IN_HARD
def test_projection_with_jumps_and_flat_cells(method, name, rng):
    """The remaining divergence is rounding of k p, and p is up to v / k; in flat cells, the tolerance."""
    grid, k = HARD[name]
    flat = name not in COEFFICIENTS
    column = projection(method, grid, None, k, rtol=1e-10 if flat else 1e-13, **OPTIONS.get(method, {}))
    v, g = rng.standard_normal((2, *column.shape))
    u = column.run(v)
    y = pull(column.run, v, g)
    for record in (column.infos[0].forward, column.infos[0].adjoint):
        assert record.backward_error <= (1e-10 if flat else 1e-12)
        assert record.iterations <= (30 if flat and method != "krylov" else 5000)
    left = 1e-8 * np.max(np.abs(column.reaches(v))) if flat else 1e-15 * np.max(k) / np.min(k) * np.linalg.norm(v)
    assert np.max(np.abs(column.reaches(u))) <= left
    assert abs(np.sum(u * g) - np.sum(v * y)) <= 1e-7 * np.linalg.norm(v) * np.linalg.norm(g)
    agree(column.run(u), u, 1e-6)


def check_rollout(grid, method, k, shift, rng, boundary=dp.neumann, solid=None, rel=1e-7):
    """Loss of three steps and its gradient in (u, k, shift), against autograd through dense solves."""
    D = dp.divergence(grid)
    G = dp.gradient(grid, boundary, solid)
    solve = elliptic(D, G, method, **OPTIONS.get(method, {}))
    d = dense(D)
    gr = dense(G)
    n = grid.cells.size
    u, w = rng.standard_normal((2, *grid.shape))

    def reference(x):
        state = anp.reshape(x[0], n)
        k = x[1]
        shift = x[2]
        for _ in range(3):
            state = anp.linalg.solve(shift * np.eye(n) - anp.dot(d * k, gr), shift * state)
        return anp.sum(w.ravel() * state) + anp.sum(state**2)

    value, slopes = dp.value_and_grad(lambda x: anp.sum(march(solve, *x) * (w + march(solve, *x))))((u, k, shift))
    wanted, others = autograd.value_and_grad(reference)((u, k, shift))
    assert value == pytest.approx(wanted, rel=rel, abs=rel * np.linalg.norm(w) * np.linalg.norm(u))
    size = np.max(np.abs(others[0]), initial=0.0)
    for got, other, scale in zip(slopes, others, (1.0, k, shift)):
        agree(got * scale, other * scale, rel, size)  # in k and shift: of the logarithm, so that every decade counts
    return slopes, solve


@pytest.mark.sampled
@EVERY
@pytest.mark.parametrize("boundary", [dp.dirichlet, dp.neumann], ids=str)
@pytest.mark.parametrize("number", [1e-8, 1.0, 1e8])
def test_rollout_for_all_diffusion_numbers(method, number, boundary, rng):
    grid = stretched(12, 10)
    check_rollout(grid, method, speeds(grid), 1.0 / number, rng, boundary, rel=1e-6)


@pytest.mark.sampled(1)
@EVERY
@IN_HARD
def test_rollout_with_jumps_and_flat_cells(method, name, rng):
    grid, k = HARD[name]
    solve = check_rollout(grid, method, k, 1.0, rng, dp.dirichlet, rel=1e-6)[1]
    for record in (solve.info.forward, solve.info.adjoint):
        assert record.backward_error <= 1e-10
        assert record.iterations <= (5000 if method == "krylov" or name in COEFFICIENTS else 30)


@pytest.mark.sampled(1)
@EVERY
@pytest.mark.parametrize("where", GEOMETRIES)
def test_rollout_everywhere(method, where, rng):
    """Regions, islands, solids and sizes. Where nothing diffuses, the gradient in k is exactly 0."""
    shape, solid = GEOMETRIES[where]
    grid = stretched(*shape)
    slopes, _ = check_rollout(grid, method, speeds(grid), 1.0, rng, solid=solid)
    if where in CLOSED:
        same_bits(slopes[1], np.zeros(grid.faces.size))


@EVERY
def test_rollout_at_velocity_zero(method, rng):
    """Central advection of a state: at rest it is the diffusion alone, and the gradient in v is not 0."""
    grid = stretched(12, 11)
    D = dp.divergence(grid)
    A = dp.average(grid)
    op = dp.identity(grid.cells) - 0.3 * dp.laplacian(grid)
    inv = solver(op, method)
    rest = np.zeros(grid.faces.size)
    u, w = rng.standard_normal((2, *grid.shape))

    def run(v, inv, D, A, u):
        for _ in range(3):
            u = inv(u - 0.1 * D(v * A(u)))
        return u

    flat = [lambda x, m=m: anp.dot(m, x) for m in (exact(op), dense(D), dense(A))]
    same_bits(run(rest, inv, D, A, u), inv(inv(inv(u))))
    slope = dp.value_and_grad(lambda v: anp.sum(w * run(v, inv, D, A, u)))(rest)[1]
    agree(slope, autograd.grad(lambda v: anp.sum(w.ravel() * run(v, *flat, u.ravel())))(rest))
    assert np.linalg.norm(slope) > 0.01


@pytest.mark.sampled(1)
@EVERY
@pytest.mark.parametrize("exponent", [-960, -900, 900, 960])
def test_scale_of_gradients_in_coefficients(method, exponent, rng):
    """Of the cotangent, of the state, and of both: beyond the range of floats it is an error, not infinity."""
    grid = stretched(12, 11)
    solve = elliptic(dp.divergence(grid), dp.gradient(grid, dp.dirichlet), method)
    (u, g), point = rng.standard_normal((2, *grid.shape)), (speeds(grid), 2.0)

    def slopes(of_cotangent, of_state):
        start = np.ldexp(u, of_state)
        return pull(lambda x: march(solve, start, *x), point, np.ldexp(g, of_cotangent))

    wanted = slopes(0, 0)
    for found in (slopes(exponent, 0), slopes(0, exponent)):
        same_bits(found[0], np.ldexp(wanted[0], exponent))
        assert found[1] == np.ldexp(wanted[1], exponent)
    if exponent > 0:
        with np.errstate(over="ignore"), pytest.raises(NONFINITE):
            slopes(exponent, exponent)


@EVERY
def test_parameters_of_a_rollout(method, rng):
    """NaN, overflow on the way, negative numbers, whole numbers, single precision, shapes."""
    grid = stretched(9, 8)
    solve = elliptic(dp.divergence(grid), dp.gradient(grid, dp.dirichlet), method)
    u = rng.standard_normal(grid.shape)
    k = np.round(1.0 + speeds(grid))
    slope = dp.value_and_grad(lambda x: anp.sum(march(solve, *x) ** 2))
    wrong = np.where(np.arange(k.size) % 13 == 4, np.nan, k)
    for bad, shift, error, words in (
        (wrong, 1.0, NONFINITE, "k must be finite, got 13 that are NaN or infinite, the first at 4$"),
        (k, np.nan, NONFINITE, "shift must be finite, got nan; write a finite number$"),
        (-k, 1.0, ValueError, "k must be >= 0, got -"),
        (k[1:], 1.0, SHAPE, "k takes a number or a field on faces"),
        (1e-300 * k, 1e200, NONFINITE, "elliptic_solver takes finite numbers, got 72 .*, the first at"),
    ):
        with np.errstate(over="ignore"), pytest.raises(error, match=f"^{words}"):
            slope((u + 1e200 * (shift == 1e200), bad, shift))
    value, (du, dk, _) = slope((u, k, 1.0))
    for whole in (k.astype(int), k.astype(np.int8)):
        found, slopes = slope((u, whole, 1.0))
        assert found == value and slopes[1] is None
        same_bits(slopes[0], du)
        with pytest.raises(DERIVATIVE, match="a gradient needs floating values"):
            dp.value_and_grad(lambda k: anp.sum(march(solve, u, k, 1.0)))(whole)
    single = slope((u, k.astype(np.float32), 1.0))[1][1]
    assert single.dtype == np.float32
    agree(single, dk, 1e-6)
