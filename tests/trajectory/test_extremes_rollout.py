"""Extreme cases of `rollout` and `projection` themselves; test_extremes_scenes.py has the same rows with plain loops.

Every rollout runs with all states kept and with room for two or three: the bits must not differ.
"""

import autograd.numpy as anp
import numpy as np
import pytest

from extremes import (  # isort: skip
    GEOMETRIES,
    KINDS,
    OPTIONS,
    agree,
    check_gradient_of_kind,
    check_kind,
    coefficient,
    dense,
    exact,
    neumann,
    projection,
    same_bits,
    stretched,
    walled,
)

import sparsedp as dp
from sparsedp.autodiff.derivative import pullback

NONFINITE = dp.errors.NonFiniteError
SHAPE = dp.errors.ShapeError
GRID = stretched(13, 11)
STEPS = 5
IMPLICIT = dp.identity(GRID.cells) - 0.3 * dp.laplacian(GRID, {"x": dp.dirichlet})
D = dp.divergence(GRID)
G = dp.gradient(GRID)
INSIDE = dp.interior(GRID)
PRESSURE = dp.inverse(neumann(GRID))  # refuses data out of its range


def half_closed(v):
    """Half of the divergence goes, by a singular solve; its data are compatible, the cotangents are not."""
    v = INSIDE(v)
    return v + 0.5 * G(PRESSURE(D(v)))


SCENES = {
    "implicit diffusion": (dp.inverse(IMPLICIT), GRID.shape, exact(IMPLICIT)),
    "projection": (dp.projection(GRID), (GRID.faces.size,), projection("direct", GRID).matrix),
    "singular solves": (half_closed, (GRID.faces.size,), (dense(INSIDE) + projection("direct", GRID).matrix) / 2),
}
IN_SCENES = pytest.mark.parametrize("scene", SCENES)
FEW = pytest.mark.parametrize("few", [False, True])


def loop(scene, few=False):
    """Return (rollout of some steps, shape, dense matrix). `few`: with memory for two more states."""
    step, shape, matrix = SCENES[scene]
    memory = 48 * int(np.prod(shape)) + 16 if few else None
    run = lambda u: dp.rollout(lambda u, _: 0.9 * step(u), u, None, STEPS, memory=memory)
    return run, shape, np.linalg.matrix_power(0.9 * matrix, STEPS)


@FEW
@IN_SCENES
def test_against_dense_algebra(scene, few, rng):
    """Also: the cotangents of a singular solve are projected, never refused."""
    run, shape, matrix = loop(scene, few)
    u, g = rng.standard_normal((2, *shape))
    value, pull = pullback(run, u)
    agree(value.ravel(), matrix @ u.ravel())
    agree(pull(g).ravel(), matrix.T @ g.ravel())
    same_bits(pull(g), pullback(loop(scene)[0], u)[1](g))
    slope = dp.value_and_grad(lambda u: anp.sum(run(u) ** 2))(u)[1]
    agree(slope.ravel(), 2 * matrix.T @ (matrix @ u.ravel()))


@FEW
@IN_SCENES
def test_field_zero_and_scales(scene, few, rng):
    """0 stays exactly 0, with the gradient of the linear map; everything times 2^+-900 gives the same bits."""
    run, shape, matrix = loop(scene, few)
    u, g = rng.standard_normal((2, *shape))
    zeros = np.zeros(shape)
    same_bits(run(zeros), zeros)
    slope = dp.value_and_grad(lambda u: anp.sum(g * run(u)))(zeros)[1]
    agree(slope.ravel(), matrix.T @ g.ravel())
    assert np.any(slope)
    for exponent in (-900, 900):
        same_bits(run(np.ldexp(u, exponent)), np.ldexp(run(u), exponent))
        same_bits(pullback(run, u)[1](np.ldexp(g, exponent)), np.ldexp(slope, exponent))


@IN_SCENES
def test_field_not_finite_or_of_another_shape(scene, rng):
    run, shape, _ = loop(scene)
    u = rng.standard_normal(shape)
    bad = u.copy()
    bad.flat[[u.size // 2, u.size // 2 + 1]] = np.nan, np.inf
    for call in (run, dp.value_and_grad(lambda u: anp.sum(run(u)))):
        with np.errstate(invalid="ignore"), pytest.raises(NONFINITE, match=r"got \d+ that are NaN or infinite, the f"):
            call(bad)
        for wrong in (u[..., None], u[:-1]):
            with pytest.raises(SHAPE):
                call(wrong)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "other byte order"])
@IN_SCENES
def test_kinds_of_arrays(scene, kind, rng):
    run, shape, _ = loop(scene)
    given = KINDS[kind](rng.standard_normal(shape))
    if given.dtype.kind in "biu":
        given = given.astype(float)  # a state keeps its dtype: tests/trajectory/test_rollout_kinds.py
    check_kind(run, given)
    check_gradient_of_kind(lambda u: anp.sum(run(u) ** 2), given)


@pytest.mark.parametrize("where", GEOMETRIES)
def test_the_projection_everywhere(where, rng):
    """Regions, islands, solids, no cells, sizes: against dense algebra; twice is once; closed faces rest."""
    shape, solid = GEOMETRIES[where]
    grid = stretched(*shape)
    P = dp.projection(grid, solid)
    matrix = projection("direct", grid, solid).matrix
    v, g = rng.standard_normal((2, grid.faces.size))
    u = P(v)
    agree(u, matrix @ v, size=1.0)
    agree(P.T(g), matrix.T @ g, size=1.0)
    agree(P(u), u, size=1.0)
    assert not np.any(u[~np.any(matrix, axis=0)])


@pytest.mark.sampled(0)
@FEW
@pytest.mark.parametrize("name", ["inclusion 1e8", "random 8 decades"])
def test_jumps_within_their_certificate(name, few, rng):
    """The true error of a gradient through loose solves is the one that `certify` estimates."""
    grid = dp.Grid((16, 14))
    k = coefficient(name, grid)
    D = dp.divergence(grid)
    G = dp.gradient(grid, dp.dirichlet)
    u, w = rng.standard_normal((2, *grid.shape))
    memory = 48 * u.size + 24 * k.size if few else None

    def loss(method, rtol):
        solve = dp.elliptic_solver(D, G, method, rtol=rtol, **OPTIONS.get(method, {}))
        return lambda u: anp.sum(w * dp.rollout(lambda u, k: solve(k, u, 1.0), u, k, 3, memory=memory))

    wanted = dp.value_and_grad(loss("direct", 1e-13))(u)[1]
    for rtol in (1e-2, 1e-4):
        found = dp.certify(loss("krylov", rtol), u)
        true = np.linalg.norm(found.gradient - wanted) / np.linalg.norm(wanted)
        assert true > 1e-7  # rounding, which certificates do not see, is 1e-8
        assert 0.5 * found.gradient_error <= true <= 2 * found.gradient_error


@pytest.mark.slow
def test_ten_thousand_steps_of_a_projection(rng):
    """Within the memory of a hundred states nothing drifts, forward or backward."""
    grid = stretched(8, 7)
    P = dp.projection(grid, walled()[:8, :7])
    v = rng.standard_normal(stretched(8, 7).faces.size)
    run = lambda v: dp.rollout(lambda v, _: P(v), v, None, 10_000, memory=800 * v.size)
    value, pull = pullback(run, v)
    agree(value, P(v), 1e-10)
    agree(pull(v), P.T(v), 1e-10)
