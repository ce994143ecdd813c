"""Properties that hold for any field: symmetry, homogeneity, layout. hypothesis picks the cases."""

import numpy as np
import pytest
from catalogue import CATALOGUE
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import sparsedp as dp

FINITE = st.floats(-1e3, 1e3, allow_subnormal=False)
entries = st.sampled_from(CATALOGUE)


@st.composite
def operators(draw, **fixed):
    """An operator of the catalogue on a small 2-D grid, in one of its forms."""
    shape = draw(st.tuples(st.integers(1, 6), st.integers(1, 6)))
    grid = dp.Grid(shape, spacing=draw(st.sampled_from([1.0, 0.37])), **fixed)
    boundary = draw(st.sampled_from([dp.neumann, dp.dirichlet, dp.robin(1, 2)]))
    op = draw(entries).make(grid, boundary)
    return draw(st.sampled_from([op.explicit, op.matrix_free]))()


@given(operators(), st.data())
def test_linear(op, data):
    u, v = (data.draw(arrays(float, op.domain.shape, elements=FINITE)) for _ in range(2))
    a = data.draw(FINITE)
    scale = abs(op.matrix) @ (abs(a * u) + abs(v)).ravel()
    gap = abs(op(a * u + v) - (a * op(u) + op(v))).ravel()
    assert np.all(gap <= 50 * np.finfo(float).eps * scale)


@given(operators(), st.data(), st.integers(-900, 900))
def test_powers_of_two_go_through_exactly(op, data, power):
    """Scaling a field by 2^k scales the result by exactly 2^k: the bits of the digits stay."""
    u = data.draw(arrays(float, op.domain.shape, elements=st.floats(-1.0, 1.0).map(lambda x: round(x, 3))))
    np.testing.assert_array_equal(op(np.ldexp(u, power)), np.ldexp(op(u), power))


@given(operators(), st.data())
def test_layout_and_dtype_do_not_matter(op, data):
    u = data.draw(arrays(float, op.domain.shape, elements=st.integers(-50, 50).map(float)))
    wanted = op(u)
    strided = np.zeros([2 * n for n in u.shape])[tuple(slice(None, None, 2) for _ in u.shape)]
    strided[...] = u
    frozen = u.copy()
    frozen.flags.writeable = False
    same = [np.asfortranarray(u), strided, u[::-1].copy()[::-1], frozen, u.astype(int), u.astype(">f8")]
    for other in same:
        kept = other.copy()
        np.testing.assert_array_equal(op(other), wanted)
        np.testing.assert_array_equal(other, kept)
        assert op(other).dtype == np.float64
    np.testing.assert_allclose(
        op(u.astype(np.float32)), wanted, rtol=1e-4, atol=1e-4 * (1 + abs(wanted).max(initial=0))
    )
    flags = u > 0
    np.testing.assert_array_equal(op(flags), op(flags.astype(float)))


@given(
    st.sampled_from([dp.gradient, dp.laplacian, dp.average]),
    arrays(float, (4, 5), elements=FINITE),
    st.integers(0, 4),
    st.integers(0, 5),
)
def test_translation_equivariant_on_periodic_grids(builder, u, right, up):
    grid = dp.Grid((4, 5), spacing=0.5, periodic=True)
    op = builder(grid)
    shift = lambda space, v: np.stack([np.roll(p, (right, up), (0, 1)) for p in space.split(v)])
    there = shift(op.codomain, op(u))
    here = np.stack(op.codomain.split(op(np.roll(u, (right, up), (0, 1)))))
    scale = 50 * np.finfo(float).eps * (abs(op.matrix) @ abs(u).ravel()).max(initial=0)
    np.testing.assert_allclose(here, there, rtol=0, atol=scale)  # a row may add its entries in another order


@given(arrays(float, (4, 4), elements=FINITE), st.sampled_from([dp.neumann, dp.dirichlet, dp.robin(1, 1)]))
def test_rotations_and_mirrors(u, boundary):
    """The Laplacian commutes with the symmetries of the square; the slope changes sign in a mirror."""
    op = dp.laplacian(dp.Grid((4, 4), spacing=0.5), boundary)
    scale = 50 * np.finfo(float).eps * (abs(op.matrix) @ abs(u).ravel()).max(initial=0)
    for turn in (np.rot90, np.flipud, np.fliplr, np.transpose):
        np.testing.assert_allclose(op(turn(u)), turn(op(u)), rtol=0, atol=scale)
    slope = dp.gradient(dp.Grid(4), boundary)
    np.testing.assert_array_equal(slope(u[::-1, 0]), -slope(u[:, 0])[::-1])


@given(st.data())
def test_axes_mean_what_they_say(data):
    """Swapping x and y on a grid that is not square swaps the result."""
    nx = data.draw(st.integers(1, 5))
    ny = data.draw(st.integers(1, 5))
    hx = data.draw(arrays(float, nx, elements=st.floats(0.5, 2)))
    hy = data.draw(arrays(float, ny, elements=st.floats(0.5, 2)))
    u = data.draw(arrays(float, (nx, ny), elements=FINITE))
    one = dp.Grid((nx, ny), spacing=[hx, hy])
    other = dp.Grid((ny, nx), spacing=[hy, hx])
    for builder in (dp.gradient, dp.average):
        x, y = one.split(builder(one, dp.dirichlet)(u))
        y_too, x_too = other.split(builder(other, dp.dirichlet)(u.T))
        np.testing.assert_array_equal(x, x_too.T)
        np.testing.assert_array_equal(y, y_too.T)


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("a, b", [(1.0, 0.0), (0.0, 1.0), (0.7, 1.3)])
def test_lift_knows_the_cell_at_its_own_wall(a, b, side):
    """A linear field with its wall values: one slope on all faces, though both ends have cells of other widths."""
    grid = dp.Grid((4, 2), spacing=(np.array([0.5, 1.0, 2.0, 3.0]), np.array([1.5, 0.25])))
    for axis in range(2):
        condition = [dp.neumann, dp.neumann]
        condition[side] = dp.robin(a, b)
        boundary = {"xy"[axis]: tuple(condition)}
        lift = dp.lift(grid, boundary)
        wall = (0.0, grid.size[axis])[side]
        values = [np.zeros(part) for part in lift.domain.parts]
        values[2 * axis + side] += a * (2.0 * wall + 1.0) + b * (2.0 if side else -2.0)
        u = 2.0 * grid.centres()[axis] + 1.0
        slopes = dp.gradient(grid, boundary)(u) + lift(np.concatenate([part.ravel() for part in values]))
        found = np.moveaxis(grid.split(slopes)[axis], axis, 0)
        assert np.allclose(found[1:] if side else found[:-1], 2.0, rtol=1e-13)
