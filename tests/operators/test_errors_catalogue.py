"""Every message of the catalogue and of operators that the user brings, printed once."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.derivative import value_and_grad

LINE = dp.Grid(3)
BOX = dp.Grid((2, 2))
RING = dp.Grid(3, periodic=True)
SHAPE = dp.errors.ShapeError
TYPE = TypeError
VALUE = ValueError
FINITE = dp.errors.NonFiniteError
DERIVATIVE = dp.errors.DerivativeError


def traced(use):
    """Call `use` with a traced array."""
    return lambda: value_and_grad(lambda u: anp.sum(use(u)))(np.ones(3))


class Broken:
    """A linear operator that lacks its adjoint."""

    shape = (3, 3)
    dtype = np.dtype(float)

    def matvec(self, x):
        return x


def forward_only():
    return dp.from_functions(lambda u: u, None, 3, 3)


TABLE = [
    # what a user brings
    (
        lambda: dp.from_matrix(np.ones(3)),
        SHAPE,
        "matrix needs a 2-D matrix, got an array of shape (3,); write matrix[None] for a row",
    ),
    (
        lambda: dp.from_matrix([["a"]]),
        TYPE,
        "matrix must hold numbers, got dtype <U1; write matrix.astype(float)",
    ),
    (
        lambda: dp.from_matrix([[1.0, 0.0], [2.0, np.nan], [np.inf, 0.0]]),
        FINITE,
        "matrix needs finite entries, got 2 that are NaN or infinite, the first at (1, 1)",
    ),
    (
        lambda: dp.from_functions(lambda u: u, lambda u: u, None, None),
        TYPE,
        "from_functions needs a domain and a codomain, got None; write from_functions(f, t, 3, 2)",
    ),
    (
        lambda: dp.from_functions(lambda u: u, "T", 3, 3),
        TYPE,
        "from_functions, as transpose, takes a function, got str; write None for a missing one",
    ),
    (
        lambda: dp.from_linear_operator(Broken()).T(np.ones(3)),
        DERIVATIVE,
        "operator has no transpose: its LinearOperator lacks rmatvec; give it one",
    ),
    (
        lambda: forward_only().T(np.ones(3)),
        DERIVATIVE,
        "this operator has no transpose; give from_functions its second function",
    ),
    (
        lambda: dp.from_functions(lambda u: u[1:], None, 3, 3)(np.ones(3)),
        SHAPE,
        "what the function returns must have shape (3,), got (2,)",
    ),
    (
        lambda: dp.from_functions(lambda u: 1j * u, None, 3, 3)(np.ones(3)),
        DERIVATIVE,
        "the function returned complex values for a real field; give its operator dtype=complex",
    ),
    # catalogue
    (
        lambda: dp.curl(LINE),
        VALUE,
        "curl needs a 2-D or 3-D grid, got Grid(3 cells, size 3); a 1-D slope is gradient(grid)",
    ),
    (lambda: dp.upwind(LINE, direction=0), VALUE, "upwind needs direction 1 or -1, got 0"),
    (
        lambda: dp.upwind(LINE, direction=np.ones(3)),
        VALUE,
        "upwind needs direction 1 or -1, got an array of shape (3,); for a wind w write "
        "np.maximum(w, 0) * upwind(grid, axis, 1)(u) + np.minimum(w, 0) * upwind(grid, axis, -1)(u)",
    ),
    (lambda: dp.diagonal(LINE.cells, np.ones(2)), SHAPE, "diagonal on cells(3) needs values of shape (3,), got (2,)"),
    (
        lambda: dp.diagonal(LINE.cells, [1.0, np.nan, np.inf]),
        FINITE,
        "diagonal on cells(3) needs finite values, got 2 that are NaN or infinite, the first at 1",
    ),
    (
        lambda: dp.diagonal(LINE.cells, "a"),
        TYPE,
        "diagonal on cells(3) must hold numbers, got dtype <U1; write values.astype(float)",
    ),
    (lambda: dp.diagonal(LINE, 1.0), TYPE, "diagonal takes a Space, got Grid; write grid.cells or grid.faces"),
    (lambda: dp.identity(LINE), TYPE, "identity takes a Space, got Grid; write grid.cells or grid.faces"),
    (lambda: dp.mask(3, [True]), TYPE, "mask takes a Space, got int; write grid.cells or grid.faces"),
    (
        traced(lambda u: dp.diagonal(LINE.cells, u)(u)),
        DERIVATIVE,
        "diagonal needs constant values, got traced ones; write values * u instead, and to solve a system with them "
        "dp.implicit(residual)",
    ),
    (
        traced(lambda u: dp.mask(LINE.cells, u)(u)),
        DERIVATIVE,
        "keep needs a constant boolean array, got a traced one; take it from plain numbers",
    ),
    (
        lambda: dp.mask(LINE.cells, np.ones(3)),
        TYPE,
        "keep must hold True or False, got dtype float64; write keep.astype(bool)",
    ),
    (
        lambda: dp.gradient(LINE, solid=np.zeros(3)),
        TYPE,
        "solid must hold True or False, got dtype float64; write solid.astype(bool)",
    ),
    (
        lambda: dp.interior(LINE, np.zeros(4, bool)),
        SHAPE,
        "solid takes a field on cells(3), got an array of shape (4,)",
    ),
    (
        lambda: dp.flux(BOX, np.s_[0.5:1, :]),
        VALUE,
        "a box on Grid(2 x 2 cells, size 2 x 2) needs one slice of cells for each axis, got "
        "(slice(0.5, 1, None), slice(None, None, None)); write (slice(4, 8), slice(2, 6))",
    ),
    (
        lambda: dp.flux(BOX, np.s_[0:1]),
        VALUE,
        "a box on Grid(2 x 2 cells, size 2 x 2) needs one slice of cells for each axis, got slice(0, 1, None); write "
        "(slice(4, 8), slice(2, 6))",
    ),
    (
        lambda: dp.flux(BOX, np.zeros(4, bool)),
        SHAPE,
        "cells takes a field on cells(2, 2), got an array of shape (4,)",
    ),
    (
        lambda: dp.brinkman(LINE)(np.ones(3)),
        SHAPE,
        "brinkman takes a field on faces(3) of shape (4,), got an array of shape (3,)",
    ),
    (
        lambda: dp.brinkman(BOX)([np.ones((3, 2)), np.ones((2, 3))]),
        SHAPE,
        "brinkman takes one array on faces(2, 2) of shape (12,), got 2 parts; write grid.join(*parts)",
    ),
    (
        lambda: dp.forces(BOX, cells=(slice(1), slice(1)))(np.ones((2, 2)), np.ones(12), 1.0),
        SHAPE,
        "forces @ stresses takes a field on faces(2, 2) of shape (12,), got an array of shape (2, 2)",
    ),
    (
        lambda: dp.brinkman(LINE)(np.ones(4, complex)),
        TYPE,
        "the level of brinkman must hold real numbers, got dtype complex128; write level.real",
    ),
    (
        lambda: dp.brinkman(LINE)([1.0, np.nan, 1.0, 1.0]),
        FINITE,
        "brinkman takes a finite level, got 1 that are NaN or infinite, the first at 1",
    ),
    (
        lambda: dp.forces(BOX, cells=np.s_[:, :])(np.ones((3, 24)), np.ones((3, *BOX.shape)), [0.1, 0.2, 0.3]),
        TYPE,
        "the viscosity of forces must be one real number, got [0.1, 0.2, 0.3]",
    ),
    (
        lambda: dp.forces(BOX, cells=np.s_[:, :])(np.ones((3, 24)), np.ones((3, *BOX.shape)), -0.1),
        VALUE,
        "the viscosity of forces must be >= 0, got -0.1",
    ),
    (
        lambda: dp.forces(BOX),
        VALUE,
        "forces needs an obstacle or a set of cells, got neither; write cells=(slice(4, 8), slice(2, 6))",
    ),
    (
        lambda: dp.forces(BOX, cells=np.s_[:, :], about=np.nan),
        VALUE,
        "about must be finite, got nan",
    ),
    (lambda: dp.sample(BOX, np.ones(3)), SHAPE, "sample needs points of shape (m, 2), got an array of shape (3,)"),
    (lambda: dp.sample(dp.Grid(0), [0.0]), SHAPE, "sample needs a grid with cells, got Grid(0 cells, size 0)"),
    (
        lambda: dp.sample(BOX, [[0.5, 1.0], [1.0, np.nan]]),
        FINITE,
        "points need finite coordinates, got 1 that are NaN or infinite, the first at (1, 1)",
    ),
    (
        lambda: dp.sample(LINE, ["a"]),
        TYPE,
        "points needs real numbers, got ['a']; write for example points=[[0.5, 1.0]]",
    ),
    (lambda: dp.sample(LINE, [3.5]), VALUE, "points need x from 0 to 3, got x = 3.5"),
    (
        lambda: dp.prolong(LINE, 3, "cubic"),
        VALUE,
        "interpolation of prolong must be one of constant, linear, got 'cubic'",
    ),
    (lambda: dp.restrict(LINE, 2), SHAPE, "a factor must be a whole number >= 1 that divides (3,), got 2"),
    (lambda: dp.restrict(LINE, 0), SHAPE, "a factor must be a whole number >= 1 that divides (3,), got 0"),
    (lambda: dp.restrict(LINE, 1.5), SHAPE, "a factor must be a whole number >= 1 that divides (3,), got 1.5"),
    (lambda: dp.restrict(LINE, None), SHAPE, "a factor must be a whole number >= 1 that divides (3,), got None"),
    (
        lambda: dp.harmonic_average(LINE)(np.ones(2)),
        SHAPE,
        "harmonic_average takes a field on cells(3), got an array of shape (2,)",
    ),
    (
        lambda: dp.harmonic_average(LINE)(np.ones(3, complex)),
        TYPE,
        "k of harmonic_average must hold real numbers, got dtype complex128; write k.real",
    ),
    (lambda: dp.harmonic_average(LINE)(-np.ones(3)), VALUE, "harmonic_average needs a coefficient >= 0, got -1"),
    (
        lambda: dp.harmonic_average(BOX)([[1.0, 1.0], [np.inf, np.nan]]),
        FINITE,
        "harmonic_average takes a finite coefficient, got 2 that are NaN or infinite, the first at (1, 0)",
    ),
    (
        lambda: dp.laplacian(dp.Grid(3, spacing=1e-200)),
        FINITE,
        "coefficients on a grid must be finite, got 7 that are NaN or infinite, the first at 0; its spacing "
        "is too small, rescale its lengths",
    ),
    (
        lambda: dp.laplacian(dp.Grid(3, spacing=1e200)),
        FINITE,
        "coefficients underflow: the spacing is too large; rescale the lengths of the grid",
    ),
    # stencils of order 4
    (lambda: dp.laplacian(RING, order=3), VALUE, "order of laplacian must be 2 or 4, got 3"),
    (lambda: dp.gradient(RING, order=True), VALUE, "order of gradient must be 2 or 4, got True"),
    (lambda: dp.divergence(RING, order="4"), VALUE, "order of divergence must be 2 or 4, got '4'"),
    (lambda: dp.gradient(RING, order=np.array([2, 4])), VALUE, "order of gradient must be 2 or 4, got array([2, 4])"),
    (
        lambda: dp.lift(dp.Grid((4, 4)), {"x": dp.patch((1, 3), dp.dirichlet)}, order=3),
        VALUE,
        "order of lift must be 2 or 4, got 3",
    ),
    (
        lambda: dp.lift(5, dp.dirichlet, order=4),
        TYPE,
        "lift takes a Grid, got int; write dp.Grid((64, 64), size=1.0)",
    ),
    (
        lambda: dp.gradient(dp.Grid(4), solid=np.zeros(4, bool), order=4),
        VALUE,
        "gradient with order=4 takes no solid cells; leave solid out or take order=2",
    ),
    (
        lambda: dp.divergence(dp.Grid(4, spacing=[np.arange(1.0, 5.0)]), order=4),
        VALUE,
        "divergence with order=4 needs cells of one width, but x is stretched; take order=2",
    ),
    (
        lambda: dp.laplacian(BOX, order=4),
        VALUE,
        "laplacian with order=4 needs at least 4 cells between two walls, got 2 along x; take order=2",
    ),
    (
        lambda: dp.lift(LINE, dp.dirichlet, order=4),
        VALUE,
        "lift with order=4 needs at least 4 cells between two walls, got 3 along x; take order=2",
    ),
    (
        lambda: dp.lift(dp.Grid((4, 4)), {"x": dp.patch((1, 3), dp.dirichlet)}, order=4),
        TYPE,
        "lift with order=4 takes one condition for each wall, but x-lower has a patch; write one condition, such as "
        "dp.dirichlet",
    ),
]


@pytest.mark.parametrize(("call", "error", "message"), TABLE, ids=[row[2][:50] for row in TABLE])
def test_message(call, error, message):
    with pytest.raises(error) as caught:
        call()
    assert str(caught.value) == message
    assert caught.type is error or error in (TYPE, VALUE, AttributeError)
