"""The projection: divergence-free, symmetric, idempotent, one node on the tape, and what it refuses."""

import pickle
import re
from itertools import product

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp.autodiff.derivative import pushforward, value_and_grad

SHAPES = [(7,), (1,), (8, 6), (1, 5), (2, 2), (1, 1), (5, 4, 3), (1, 2, 1), (20, 17)]
OPEN = {"x": (dp.inflow, dp.outflow)}


def grids(shape):
    rng = np.random.default_rng(3)
    for periodic in product((False, True), repeat=len(shape)):
        yield dp.Grid(shape, spacing=0.3, periodic=periodic)
        yield dp.Grid(shape, spacing=[rng.uniform(0.5, 2.0, n) for n in shape], periodic=periodic)


def obstacles(grid):
    """None, about a quarter of the cells, and three quarters: islands, single cells, enclosed regions."""
    rng = np.random.default_rng(4)
    return [None, rng.random(grid.shape) < 0.25, rng.random(grid.shape) < 0.75]


def velocity(grid, seed=0):
    return np.random.default_rng(seed).standard_normal(grid.faces.size)


def dense(grid, solid, boundary):
    """Return the same map by dense algebra: P = K - G (D G)^+ D K on the faces that are not closed."""
    keep = np.diag(np.ones(grid.faces.size))
    conditions = {}
    for axis, name in enumerate(grid.axes):
        words = boundary.get(name, (dp.no_slip, dp.no_slip))
        if not grid.periodic[axis]:
            conditions[name] = tuple(dp.dirichlet if word == dp.outflow else dp.neumann for word in words)
            for side, word in zip((0, -1), words):
                flags = [np.ones(part) for part in grid.faces.parts]
                np.moveaxis(flags[axis], axis, 0)[side] = word in (dp.inflow, dp.outflow)
                keep = keep @ np.diag(grid.join(*flags))
    if solid is not None:
        keep = keep @ np.diag(dp.average(grid)(solid.astype(float)) == 0.0)
    D = dp.divergence(grid).matrix.toarray()
    G = dp.gradient(grid, conditions or dp.neumann, solid).matrix.toarray()
    return keep - G @ np.linalg.pinv(D @ G, rcond=1e-12) @ D @ keep


@pytest.fixture
def scenes(shape, drawn):
    """(grid, obstacle): every choice of periodic axes, uniform and stretched, and every obstacle; or a sample."""
    many = {(*grid.periodic, k % 2, n): (grid, n) for k, grid in enumerate(grids(shape)) for n in range(3)}
    return [(grid, obstacles(grid)[n]) for grid, n in map(many.get, drawn(list(many)))]


@pytest.mark.sampled(0)
@pytest.mark.parametrize("shape", SHAPES[:-1])
def test_agrees_with_the_dense_projection_and_its_transpose(shape, scenes):
    for grid, solid in scenes:
        P = dp.projection(grid, solid)
        matrix = dense(grid, solid, {})
        v = velocity(grid)
        np.testing.assert_allclose(P(v), matrix @ v, atol=1e-9)
        np.testing.assert_allclose(P.T(v), matrix.T @ v, atol=1e-9)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("shape", SHAPES)
def test_divergence_idempotence_and_symmetry(shape, scenes):
    for grid, solid in scenes:
        D = dp.divergence(grid)
        W = grid.faces.volumes
        P = dp.projection(grid, solid)
        v = velocity(grid)
        w = velocity(grid, 1)
        once = P(v)
        size = np.linalg.norm(v)
        assert np.linalg.norm(D(once)) <= 1e-8 * size
        np.testing.assert_allclose(P(once), once, atol=1e-8)
        assert abs((W * w) @ once - (W * P(w)) @ v) <= 1e-8 * size**2
        assert np.array_equal(dp.interior(grid, solid)(once), once)
        if all(grid.uniform):
            assert np.array_equal(P.T(v), once)


@pytest.mark.parametrize("shape", [(9,), (6, 5), (36, 40), (4, 3, 5)])
@pytest.mark.parametrize("stretched", [False, True])
def test_openings(shape, stretched):
    """The inflow keeps its values, inflow and outflow balance, and the transpose is exact."""
    grid = list(grids(shape))[int(stretched)]
    solid = np.zeros(shape, bool)
    solid[(slice(3, 5), slice(2, 3))[: len(shape)]] = len(shape) > 1
    P = dp.projection(grid, solid, OPEN)
    v = velocity(grid)
    result = P(v)
    np.testing.assert_allclose(dp.divergence(grid)(result)[~solid], 0, atol=1e-8)
    assert np.array_equal(dp.component(grid, 0)(result)[0], dp.component(grid, 0)(v)[0])
    np.testing.assert_allclose(P(result), result, atol=1e-9)
    if grid.cells.size < 200:
        matrix = dense(grid, solid, OPEN)
        np.testing.assert_allclose(result, matrix @ v, atol=1e-9)
        np.testing.assert_allclose(P.T(v), matrix.T @ v, atol=1e-9)
    g = velocity(grid, 2)
    assert abs(g @ P(v) - P.T(g) @ v) <= 1e-9 * np.linalg.norm(v) * np.linalg.norm(g)


def test_pressure_is_the_potential():
    grid = dp.Grid((12, 9), size=(2.0, 1.0))
    for boundary in (dp.free_slip, OPEN):
        P = dp.projection(grid, None, boundary)
        v = velocity(grid)
        G = dp.gradient(grid, {"x": (dp.neumann, dp.dirichlet)} if boundary is OPEN else dp.neumann)
        kept = dp.mask(grid.faces, P.setup.open)
        np.testing.assert_allclose(P(v), kept(v) + G(P.pressure(v)), atol=1e-10)
        g = np.random.default_rng(1).standard_normal(grid.shape)
        assert abs(np.sum(g * P.pressure(v)) - P.pressure.T(g) @ v) < 1e-9


def test_one_node_and_two_solves():
    grid = dp.Grid((32, 40))
    P = dp.projection(grid)
    target = velocity(grid, 1)
    with recording() as calls:
        value_and_grad(lambda v: 0.5 * anp.sum((P(v) - target) ** 2))(velocity(grid))
    assert calls == {
        ("projection", "forward"): 1,
        ("projection", "vjp"): 1,
        ("pressure solve", "solve"): 1,
        ("pressure solve", "adjoint"): 1,
    }
    assert P.info.forward.status == "converged" and P.info.adjoint.residual <= 1e-10
    assert P.method == "separable" and "dct-2" in str(P)


@pytest.mark.parametrize("solid", [False, True])
def test_all_derivative_modes(solid):
    grid = dp.Grid((6, 5), spacing=[np.linspace(1, 2, 6), np.linspace(2, 1, 5)])
    mask = np.zeros(grid.shape, bool)
    mask[2:4, 1:3] = solid
    P = dp.projection(grid, mask)
    loss = lambda v: anp.sum(P(v) ** 4)
    v = velocity(grid)
    assert dp.check.gradient(loss, v, quick=True).verdict == "agrees"
    tangent = velocity(grid, 5)
    np.testing.assert_allclose(pushforward(P, v, tangent)[1], P(tangent), atol=1e-12)
    slope = lambda v: anp.sum(value_and_grad(loss)(v)[1] * tangent)
    _, second = value_and_grad(slope)(v)
    np.testing.assert_allclose(second, P.T(12 * P(v) ** 2 * P(tangent)), atol=1e-8)


def test_nan_anywhere_is_refused():
    """A NaN on a closed wall is refused too, although its value is not used."""
    grid = dp.Grid((4, 3))
    P = dp.projection(grid)
    for index in range(grid.faces.size):
        v = velocity(grid)
        v[index] = np.nan
        with pytest.raises(dp.errors.NonFiniteError, match="the velocity in projection must be finite, got 1 that are"):
            P(v)
    v[:] = 1.0
    v[16] = np.inf
    with pytest.raises(dp.errors.NonFiniteError, match=r"the first at y-face \(0, 1\)"):
        P(v)
    with pytest.raises(dp.errors.NonFiniteError, match="the cotangent of projection must be finite"):
        P.T(v)


def test_refused_arguments():
    grid = dp.Grid((4, 3), periodic=(False, True))
    with pytest.raises(ValueError, match="boundary names axis 'z', but .* has x, y; give the two sides of an axis"):
        dp.projection(grid, boundary={"z": dp.inflow})
    with pytest.raises(ValueError, match="axis y is periodic and takes no boundary condition; leave it out"):
        dp.projection(grid, boundary={"y": dp.inflow})
    needs = "boundary on x needs no_slip, free_slip, inflow, outflow or a pair of them, got "
    given = {"glue": "'glue'$", dp.neumann: "neumann$", "free_slip": "'free_slip'; write dp.free_slip"}
    given[("inflow", dp.outflow)] = re.escape("('inflow', outflow); write dp.inflow")
    for entry, words in given.items():
        with pytest.raises(TypeError, match=needs + words):
            dp.projection(grid, boundary={"x": entry})
    with pytest.raises(TypeError, match="got 'no_slip'; write dp.no_slip"):  # a word of the first edition
        dp.face_laplacian(grid, "no_slip")
    with pytest.raises(TypeError, match=r"boundary on x needs dirichlet, neumann, robin\(a, b\) .*, got no_slip"):
        dp.laplacian(grid, dp.no_slip)
    with pytest.raises(
        ValueError, match="the inflow on the lower x side enters a region without an outflow; open a side of it"
    ):
        dp.projection(grid, boundary={"x": (dp.inflow, dp.no_slip)})
    barrier = np.zeros(grid.shape, bool)
    barrier[2] = True
    with pytest.raises(ValueError, match="enters a region without an outflow"):
        dp.projection(grid, barrier, OPEN)
    with pytest.raises(dp.errors.ShapeError, match="projection takes a field on faces"):
        dp.projection(grid)(np.zeros(3))
    with pytest.raises(TypeError, match="method separable takes the options"):
        dp.projection(grid, cycle="W")


def test_extremes():
    for shape in ((0,), (0, 3), (3, 0, 2)):
        P = dp.projection(dp.Grid(shape))
        v = velocity(P.domain.grid)
        assert np.array_equal(P(v), 0 * v)
    grid = dp.Grid((6, 5))
    v = velocity(grid)
    full = dp.projection(grid, np.ones(grid.shape, bool))
    assert np.array_equal(full(v), np.zeros_like(v))
    P = dp.projection(grid)
    assert np.array_equal(P(0 * v), 0 * v)
    for power in (-900, 900):
        assert np.array_equal(np.ldexp(P(np.ldexp(v, power)), -power), P(v))
        tiny = dp.Grid((6, 5), spacing=2.0**power)
        assert np.array_equal(dp.projection(tiny)(v), P(v))
        assert np.array_equal(dp.projection(tiny).pressure(v), np.ldexp(P.pressure(v), power))


def test_array_layouts_and_dtypes():
    grid = dp.Grid((6, 5))
    P = dp.projection(grid)
    v = velocity(grid)
    w = P(v)
    assert P(v.astype(np.float32)).dtype == np.float32
    np.testing.assert_allclose(P(v.astype(np.float32)), w, atol=1e-6)
    z = P(v + 1j * v[::-1])
    np.testing.assert_allclose(z, w + 1j * P(v[::-1]), atol=1e-14)
    whole = np.arange(grid.faces.size)
    assert np.array_equal(P(whole), P(whole.astype(float)))
    kept = v.copy()
    v.flags.writeable = False
    P(v)
    assert np.array_equal(kept, v)
    again = pickle.loads(pickle.dumps(P))
    assert np.array_equal(again(v), w)


@pytest.mark.parametrize("method", ["separable", "direct", "structured", "multigrid", "krylov"])
def test_every_method(method):
    if method == "structured":
        pytest.importorskip("numba")
    grid = dp.Grid((24, 20))
    v = velocity(grid)
    try:
        P = dp.projection(grid, method=method)
    except ValueError as error:
        pytest.skip(str(error))
    np.testing.assert_allclose(P(v), dp.projection(grid)(v), atol=1e-8)
    assert P.method == method
