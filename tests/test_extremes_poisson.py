"""Extreme cases of Poisson problems: what every method promises, forward, adjoint and in gradients.

What holds for every linear scene (scales of the data, kinds of arrays, shapes) is in test_extremes_scenes.py.
"""

import autograd.numpy as anp
import numpy as np
import pytest

from extremes import (  # isort: skip
    ANISOTROPIC,
    BOUNDARIES,
    COEFFICIENTS,
    EVERY,
    IN_SCENES,
    METHODS,
    NONE,
    OPTIONS,
    SCENES,
    SMALL,
    STRONG,
    agree,
    coefficient,
    dense,
    elliptic,
    exact,
    neumann,
    regions,
    same_bits,
    solver,
    stretched,
    unfit,
    weak,
)

import sparsedp as dp

INCOMPATIBLE = dp.errors.IncompatibleError
NONFINITE = dp.errors.NonFiniteError
SHAPE = dp.errors.ShapeError


def solved(matrix, b):
    """Dense solve, refined with residuals in long double: right digits for condition numbers up to 1e14."""
    inverse = np.linalg.inv(matrix)
    x = np.zeros(b.shape, dtype=np.longdouble)
    for _ in range(8):
        x = x + inverse @ (b - matrix.astype(np.longdouble) @ x).astype(float)
    return x.astype(float)


def regular(op):
    """(matrix, projection of data). Singular pure Neumann problems get the mean added, which makes them regular."""
    matrix = dense(op)
    w = op.domain.volumes.ravel()
    if np.max(np.abs(matrix.sum(axis=1)) / np.abs(matrix).sum(axis=1)) > 1e-10:
        return matrix, np.eye(w.size)
    mean = np.broadcast_to(w / w.sum(), matrix.shape)
    return matrix + np.median(np.diag(matrix)) * mean, np.eye(w.size) - mean


def slope_of(inv, b, g):
    """Gradient in b of the sum of g x + x^2 / 2, with x = inv(b): it is inv.T(g + x)."""
    return dp.value_and_grad(lambda b: anp.sum(g * inv(b)) + 0.5 * anp.sum(inv(b) ** 2))(b)[1]


def check_all(inv, inverse, b, g, rel=1e-8):
    """Solution, adjoint solution and gradient against a dense inverse."""
    x = inverse @ b.ravel()
    agree(inv(b), x.reshape(b.shape), rel)
    agree(inv.T(g), (inverse.T @ g.ravel()).reshape(b.shape), rel)
    agree(slope_of(inv, b, g), (inverse.T @ (g.ravel() + x)).reshape(b.shape), rel)


def data(op, rng):
    return rng.standard_normal((2, *op.domain.shape))


def refuse_to_solve(*arguments):
    raise AssertionError("the engine was called")


@pytest.mark.sampled(1)
@EVERY
@IN_SCENES
@pytest.mark.parametrize("zero", [0.0, -0.0])
def test_rhs_zero_is_not_solved(scene, method, zero):
    op = SCENES[scene]()
    inv = solver(op, method)
    inv.solver.engine.solve = refuse_to_solve
    for solve in (inv, inv.T):
        same_bits(solve(np.full(op.domain.shape, zero)), np.zeros(op.domain.shape))
    for record in (inv.info.forward, inv.info.adjoint):
        assert (record.status, record.iterations, record.residual) == ("exact_zero_rhs", 0, 0.0)
    value, slope = dp.value_and_grad(lambda b: anp.sum(inv(b) ** 2))(np.full(op.domain.shape, zero))
    assert value == 0.0
    same_bits(slope, np.zeros(op.domain.shape))


@EVERY
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_parameters_that_are_not_finite_or_negative(method, bad):
    grid = stretched(9, 8)
    solve = elliptic(dp.divergence(grid), dp.gradient(grid, dp.dirichlet), method)
    k = np.ones(grid.faces.size)
    b = np.ones(grid.shape)
    k[[17, 23]] = bad
    slope = dp.value_and_grad(lambda k: anp.sum(solve(k, b)))
    for call in (lambda k: solve(k, b), slope):
        with pytest.raises(NONFINITE, match="^k must be finite, got 2 that are NaN or infinite, the first at 17$"):
            call(k)
        with pytest.raises(ValueError, match="^k must be >= 0, got -2 at 17$"):
            call(np.where(k == 1, k, -2.0))
    with pytest.raises(NONFINITE, match=f"^shift must be finite, got {bad}; write a finite number$"):
        solve(1.0, b, bad)
    with pytest.raises(NONFINITE, match=f"^k must be finite, got {bad}; write a finite number$"):
        solve(bad, b)


# ---- singular ----------------------------------------------------------------------------------------------------


@pytest.mark.sampled(1)
@EVERY
@pytest.mark.parametrize("defect", [1e-14, 1e-7, 1.0])
def test_neumann_defect(method, defect, rng):
    """Rounding passes, a small defect is recorded, a large one refused; the adjoint is projected in any case."""
    op = SCENES["neumann"]()
    inv = solver(op, method)
    inverse = exact(op)
    w = op.domain.volumes
    b, g = data(op, rng)
    b -= np.sum(w * b) / np.sum(w)
    b += defect * np.linalg.norm(b) * w / np.linalg.norm(w)
    measured = abs(np.sum(w * b)) / np.linalg.norm(w) / np.linalg.norm(b)
    if defect < 1:
        check_all(inv, inverse, b, g)
        assert inv.info.forward.defect == pytest.approx(measured, rel=1e-6, abs=1e-15)
    else:
        for call in (inv, lambda b: slope_of(inv, b, g)):
            with pytest.raises(INCOMPATIBLE, match=r"on component 1 of 1 \(182 cells from \(0, 0\)\) the defect is 7"):
                call(b)
        assert inv.info.forward.status == "incompatible_rhs"
        assert inv.info.forward.defect == pytest.approx(measured, rel=1e-9)
        check_all(solver(op, method, nullspace="project"), inverse, b, g)
    agree(inv.T(defect + g), (inverse.T @ (defect + g).ravel()).reshape(b.shape))
    same_bits(inv.T(w), np.zeros(b.shape))  # only null space
    assert inv.info.adjoint.defect == pytest.approx(np.sum(w) / np.linalg.norm(w) / np.sqrt(w.size))


@EVERY
def test_cotangents_of_singular_solves_are_projected(method, rng):
    """Data that are compatible, nullspace="raise", and a cotangent that is not."""
    grid = stretched(12, 11)
    D = dp.divergence(grid)
    G = dp.gradient(grid)
    inside = dp.interior(grid)
    inv = solver(-D @ G, method)
    inverse = exact(-D @ G)
    v = rng.standard_normal(grid.faces.size)
    slope = dp.value_and_grad(lambda v: anp.sum(inv(inv(D(inside(v))))))(v)[1]
    agree(slope, (inverse @ inverse @ dense(D) @ dense(inside)).T @ np.ones(grid.cells.size))
    assert inv.info.adjoint.status == "converged" and inv.info.forward.defect <= 1e-9


@pytest.mark.sampled(1)
@EVERY
@pytest.mark.parametrize("count", [1, 2, 50])
def test_isolated_regions_and_islands(method, count, rng):
    solid = regions(count)
    grid = stretched(*solid.shape)
    op = neumann(grid, solid)
    inv = solver(op, method, nullspace="project")
    inverse = exact(op)
    b, g = data(op, rng)
    check_all(inv, inverse, b, g)
    x = inv(b)
    w = grid.volumes
    blocks = [np.s_[3 * n : 3 * n + 2, :2] for n in range(count)]
    for block in blocks:
        assert abs(np.sum((w * x)[block])) <= 1e-13 * np.sum((w * np.abs(x))[block])
    assert not np.any(x[solid]) and not np.any(x[::3, 3]) and not np.any(inv.T(g)[::3, 3])
    strict = solver(op, method)
    fit = op(rng.standard_normal(grid.shape))
    check_all(strict, inverse, fit, g)
    fit[blocks[-1]] += 1.0
    with pytest.raises(INCOMPATIBLE, match=rf"on component {count} of {count} \(4 cells from \({3 * count - 3}, 0\)\)"):
        strict(fit)


@EVERY
@pytest.mark.parametrize("boundary", [dp.neumann, dp.dirichlet], ids=str)
def test_all_cells_solid(method, boundary):
    grid = stretched(4, 3)
    op = -dp.laplacian(grid, boundary, np.ones(grid.shape, dtype=bool))
    zeros = np.zeros(grid.shape)
    ones = np.ones(grid.shape)
    inv = solver(op, method)
    lenient = solver(op, method, nullspace="project")
    for x in (inv(zeros), inv.T(ones), lenient(ones), slope_of(lenient, ones, ones), slope_of(inv, zeros, ones)):
        same_bits(x, zeros)
    with pytest.raises(INCOMPATIBLE, match=r"must be 0 where there is no unknown .*, but is not in cell \(0, 0\)"):
        inv(ones)


@pytest.mark.sampled(1)
@EVERY
@pytest.mark.parametrize("shape", NONE)
@pytest.mark.parametrize("boundary", [dp.neumann, dp.dirichlet], ids=str)
def test_no_cells(method, shape, boundary):
    inv = solver(-dp.laplacian(dp.Grid(shape), boundary), method)
    nothing = np.zeros(shape)
    for x in (inv(nothing), inv.T(nothing), slope_of(inv, nothing, nothing)):
        same_bits(x, nothing)
    with pytest.raises(SHAPE):
        inv(np.zeros(1))


# ---- coefficients ------------------------------------------------------------------------------------------------


@pytest.mark.sampled(1)
@STRONG
@pytest.mark.parametrize("boundary", [dp.dirichlet, dp.neumann], ids=str)
@pytest.mark.parametrize("name", COEFFICIENTS)
def test_coefficients_that_jump(name, boundary, method, rng):
    """Backward errors as recorded; solutions and gradients against dense algebra in long double."""
    grid = dp.Grid((16, 14))
    op = -dp.divergence(grid) @ dp.diagonal(grid.faces, coefficient(name, grid)) @ dp.gradient(grid, boundary)
    options = OPTIONS.get(method, {})
    inv = solver(op, method, nullspace="project", **options)
    (matrix, projection), (b, g) = regular(op), data(op, rng)
    results = inv(b), inv.T(g), slope_of(inv, b, g)
    for record in (inv.info.forward, inv.info.adjoint):
        assert record.status.startswith("converged") and record.backward_error <= 1e-12
    x = solved(matrix, projection @ b.ravel())
    y = solved(matrix.T, projection.T @ g.ravel())
    z = y + solved(matrix.T, projection.T @ x)
    for got, wanted in zip(results, (x, y, z)):
        agree(got.ravel(), wanted, rel=3e-6)
    check_backward_error(op, inv, projection, b, g)


def check_backward_error(op, inv, projection, b, g):
    """At most 1e-12, measured apart from the solver."""
    for solve, A, data in ((inv, dense(op), projection @ b.ravel()), (inv.T, dense(op).T, projection.T @ g.ravel())):
        x = solve(data.reshape(b.shape)).ravel()
        size = np.max(np.sum(np.abs(A), axis=1)) * np.linalg.norm(x) + np.linalg.norm(data)
        assert np.linalg.norm(data - A @ x) <= 1e-12 * size


@pytest.mark.sampled(1)
@STRONG
@pytest.mark.parametrize("boundary", [dp.dirichlet, dp.neumann], ids=str)
@pytest.mark.parametrize("name", ANISOTROPIC)
def test_anisotropy_and_aspect(name, boundary, method, rng):
    op = ANISOTROPIC[name](boundary)
    options = OPTIONS.get(method, {})
    inv = solver(op, method, nullspace="project", **options)
    (matrix, projection), (b, g) = regular(op), data(op, rng)
    x = solved(matrix, projection @ b.ravel())
    y = solved(matrix.T, projection.T @ g.ravel())
    agree(inv(b).ravel(), x, rel=1e-5)
    agree(inv.T(g).ravel(), y, rel=1e-5)
    for record in (inv.info.forward, inv.info.adjoint):
        assert record.iterations <= (5000 if method == "krylov" else 30)
    agree(slope_of(inv, b, g).ravel(), y + solved(matrix.T, projection.T @ x), rel=1e-5)


@pytest.mark.parametrize("method", [word for word in METHODS if word not in ("krylov", "structured")])
@pytest.mark.parametrize("boundary", [dp.dirichlet, dp.neumann], ids=str)
def test_anisotropy_on_a_larger_grid(boundary, method, rng):
    """The number of iterations does not grow with the grid."""
    for op in (weak(dp.Grid((64, 64)), boundary, 1), -dp.laplacian(dp.Grid((64, 64), spacing=(1e-4, 1.0)), boundary)):
        if unfit(op, method):
            continue
        inv = dp.inverse(op, method, nullspace="project")
        b, g = data(op, rng)
        assert abs(np.sum(inv(b) * g) - np.sum(b * inv.T(g))) <= 1e-6 * np.linalg.norm(inv(b)) * np.linalg.norm(g)
        assert max(inv.info.forward.iterations, inv.info.adjoint.iterations) <= 30


# ---- scale of the operator ---------------------------------------------------------------------------------------


@pytest.mark.sampled
@EVERY
@IN_SCENES
@pytest.mark.parametrize("exponent", [-900, 900])
def test_scale_of_the_operator(scene, method, exponent, rng):
    op = SCENES[scene]()
    b, g = data(op, rng)
    inv, far = (solver(scale * op, method, nullspace="project") for scale in (1.0, 2.0**exponent))
    same_bits(far(b), np.ldexp(inv(b), -exponent))
    same_bits(far.T(g), np.ldexp(inv.T(g), -exponent))
    same_bits(far(np.ldexp(b, exponent)), inv(b))
    same_bits(far.T(np.ldexp(g, exponent)), inv.T(g))
    for solve in (far, far.T):
        if exponent > 0:  # 2^-1800: nothing is left, as in the exact result rounded
            same_bits(solve(np.ldexp(b, -exponent)), np.zeros(b.shape))
            continue
        with pytest.raises(NONFINITE, match=r"^the solution of .* is beyond 1.8e308; scale the right-hand side down$"):
            solve(np.ldexp(b, -exponent))
        assert (far.info.forward if solve is far else far.info.adjoint).status == "not_representable"


@pytest.mark.sampled(1)
@EVERY
@pytest.mark.parametrize("boundary", [dp.dirichlet, dp.neumann], ids=str)
@pytest.mark.parametrize(
    "shape, exponent",
    [
        ((14, 13), -450),
        ((14, 13), -300),
        ((14, 13), 300),
        ((14, 13), 450),
        ((5, 4, 6), -300),
        ((5, 4, 6), 300),
        ((5, 4, 6), 450),
    ],
)
def test_scale_of_lengths(shape, exponent, boundary, method, rng):
    """The same bits whatever the unit of length, cells of 2^-450 to 2^450; else a typed error."""
    near, far = (-dp.laplacian(stretched(*shape, unit=unit), boundary) for unit in (1.0, 2.0**exponent))
    b, g = data(near, rng)
    inv = solver(near, method, nullspace="project")
    try:
        other = solver(far, method, nullspace="project")
        results = other(b), other.T(g)
    except NONFINITE:
        assert exponent * len(shape) > 1023  # cell volumes beyond floats may be refused
        return
    same_bits(results[0], np.ldexp(inv(b), 2 * exponent))
    same_bits(results[1], np.ldexp(inv.T(g), 2 * exponent))
    assert other.info.forward.defect == inv.info.forward.defect


# ---- sizes -------------------------------------------------------------------------------------------------------


@pytest.mark.sampled
@EVERY
@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("shape", SMALL)
def test_small_and_prime_sizes(shape, boundary, method, rng):
    op = -dp.laplacian(stretched(*shape, periodic=boundary == "periodic"), BOUNDARIES[boundary])
    inv = solver(op, method, nullspace="project")
    check_all(inv, exact(op), *data(op, rng))
    for wrong in (np.ones((*shape, shape[-1] + 1)), np.ones(op.domain.size + 1), np.ones(()), 1.0):
        with pytest.raises(SHAPE, match="takes a field on cells"):
            inv(wrong)
        with pytest.raises(SHAPE, match="takes a field on cells"):
            inv.T(wrong)
