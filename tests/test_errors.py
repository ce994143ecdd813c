"""Every message of the foundation, printed once. A message says what was given and what to write instead."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.derivative import value_and_grad

LINE, BOX, RING = dp.Grid(3), dp.Grid((2, 2)), dp.Grid(3, periodic=True)
SHAPE, TYPE, VALUE = dp.errors.ShapeError, TypeError, ValueError
FINITE, DERIVATIVE = dp.errors.NonFiniteError, dp.errors.DerivativeError


def traced(use):
    """Call `use` with a traced array."""
    return lambda: value_and_grad(lambda u: anp.sum(use(u)))(np.ones(3))


class Broken:
    """A linear operator that lacks its adjoint."""

    shape, dtype = (3, 3), np.dtype(float)

    def matvec(self, x):
        return x


def forward_only():
    return dp.from_functions(lambda u: u, None, 3, 3)


TABLE = [
    # grid
    (lambda: dp.Grid(()), SHAPE, "a grid needs one to three whole lengths >= 0, got shape ()"),
    (lambda: dp.Grid((2, 2, 2, 2)), SHAPE, "a grid needs one to three whole lengths >= 0, got shape (2, 2, 2, 2)"),
    (lambda: dp.Grid(2.5), SHAPE, "a grid needs one to three whole lengths >= 0, got shape (2.5,)"),
    (lambda: dp.Grid((2.5,)), SHAPE, "a grid needs one to three whole lengths >= 0, got shape (2.5,)"),
    (lambda: dp.Grid((-1,)), SHAPE, "a grid needs one to three whole lengths >= 0, got shape (-1,)"),
    (lambda: dp.Grid((True,)), SHAPE, "a grid needs one to three whole lengths >= 0, got shape (True,)"),
    (lambda: dp.Grid(4, size=1.0, spacing=1.0), VALUE, "a grid takes size or spacing, not both; leave one out"),
    (lambda: dp.Grid(4, spacing=-1.0), VALUE, "spacing must be positive and finite, got -1.0"),
    (lambda: dp.Grid(4, spacing=0.0), VALUE, "spacing must be positive and finite, got 0.0"),
    (lambda: dp.Grid(4, spacing=np.nan), VALUE, "spacing must be positive and finite, got nan"),
    (lambda: dp.Grid(4, size=np.inf), VALUE, "size needs finite numbers, got inf"),
    (lambda: dp.Grid(4, size=-2.0), VALUE, "size must be positive and finite, got -2.0"),
    (lambda: dp.Grid(4, origin=np.nan), VALUE, "origin needs finite numbers, got nan"),
    (lambda: dp.Grid((4, 4), size=(1.0,)), SHAPE, "size needs one entry for each of 2 axes, got 1"),
    (lambda: dp.Grid((4, 4), periodic=[True]), SHAPE, "periodic needs one entry for each of 2 axes, got 1"),
    (lambda: dp.Grid(4, spacing=np.ones(3)), SHAPE, "spacing along x needs 4 cell widths, got an array of shape (3,)"),
    (lambda: BOX.axis("z"), VALUE, "Grid(2 x 2 cells, size 2 x 2) has axes 0 to 1, got 'z'"),
    (lambda: BOX.face_centres(2), VALUE, "Grid(2 x 2 cells, size 2 x 2) has axes 0 to 1, got 2"),
    (lambda: LINE.split(np.ones(3)), SHAPE, "split takes a field on faces(3), got an array of shape (3,)"),
    (lambda: BOX.join(np.ones(3)), SHAPE, "join on faces(2, 2) takes 2 components, got 1"),
    (
        lambda: BOX.join(np.ones(7), 1.0),
        SHAPE,
        "join on faces(2, 2) needs components ((3, 2), (2, 3)), got one of shape (7,)",
    ),
    (lambda: dp.Space(-1), SHAPE, "a space needs lengths >= 0, got (-1,)"),
    (lambda: setattr(LINE, "dim", 2), AttributeError, "Grid is frozen; make a new one instead of setting dim"),
    (lambda: setattr(LINE.cells, "x", 2), AttributeError, "Space is frozen; make a new one instead of setting x"),
    (lambda: setattr(dp.neumann, "a", 2), AttributeError, "Condition is frozen; make a new one instead of setting a"),
    (
        lambda: setattr(dp.laplacian(LINE), "form", 2),
        AttributeError,
        "Operator is frozen; make a new one instead of setting form",
    ),
    # boundary conditions
    (lambda: dp.robin(-1, 1), VALUE, "robin needs finite a, b >= 0, not both 0, got a = -1, b = 1"),
    (lambda: dp.robin(0, 0), VALUE, "robin needs finite a, b >= 0, not both 0, got a = 0, b = 0"),
    (lambda: dp.robin(np.nan, 1), VALUE, "robin needs finite a, b >= 0, not both 0, got a = nan, b = 1"),
    (lambda: dp.gradient(LINE, {"y": dp.neumann}), VALUE, "boundary names axis 'y', but Grid(3 cells, size 3) has x"),
    (
        lambda: dp.gradient(RING, {"x": dp.neumann}),
        VALUE,
        "axis x is periodic and takes no boundary condition; leave it out",
    ),
    (
        lambda: dp.gradient(LINE, "dirichlet"),
        TYPE,
        "boundary on x needs dirichlet, neumann, robin(a, b) or a pair of them, got 'dirichlet'",
    ),
    # fields
    (
        lambda: dp.gradient(BOX)(np.ones(5)),
        SHAPE,
        "gradient takes a field on cells(2, 2), got an array of shape (5,)",
    ),
    (
        lambda: dp.laplacian(LINE)(np.array(["a", "b", "c"])),
        TYPE,
        "laplacian takes float or complex numbers, got dtype <U1; write u.astype(float)",
    ),
    (
        lambda: dp.laplacian(LINE)(np.ones(3, np.longdouble)),
        TYPE,
        f"laplacian takes float or complex numbers, got dtype {np.dtype(np.longdouble)}; write u.astype(float)",
    ),
    (
        lambda: dp.laplacian(LINE)(np.ma.ones(3)),
        TYPE,
        "laplacian takes plain arrays, got a masked array; fill it first",
    ),
    (
        lambda: dp.gradient(LINE).apply(np.ones(3), out=np.ones(3)),
        SHAPE,
        "gradient gives a field on faces(3), got out of shape (3,)",
    ),
    (
        lambda: dp.gradient(LINE).apply(np.ones(3), out=np.ones(4, np.float32)),
        TYPE,
        "gradient gives float64 here, got out of dtype float32",
    ),
    (
        lambda: (lambda u: dp.laplacian(LINE).apply(u, out=u))(np.ones(3)),
        VALUE,
        "laplacian needs an out that is contiguous, writeable and apart from u",
    ),
    (
        lambda: dp.laplacian(BOX) @ np.ones((2, 2)),
        SHAPE,
        "laplacian @ x takes a flat x of shape (4,); for a field write op(u)",
    ),
    (lambda: np.sin(dp.laplacian(LINE)), TYPE, "numpy.sin does not take an operator; write laplacian(u) for a field u"),
    (
        lambda: np.ones(3) * dp.laplacian(LINE),
        TYPE,
        "numpy.multiply does not take an operator; write laplacian(u) for a field u",
    ),
    # algebra
    (
        traced(lambda u: (u[0] * dp.laplacian(LINE))(u)),
        DERIVATIVE,
        "a traced number cannot scale an operator; write nu * laplacian(u)",
    ),
    (
        traced(lambda u: (dp.laplacian(LINE) * u[0])(u)),
        DERIVATIVE,
        "a traced number cannot scale an operator; write nu * laplacian(u)",
    ),
    (lambda: dp.laplacian(LINE) * np.nan, FINITE, "laplacian can be scaled by a finite number only, got nan"),
    (
        lambda: dp.gradient(LINE) @ dp.gradient(LINE),
        SHAPE,
        "gradient takes cells(3), but gradient gives faces(3)",
    ),
    (
        lambda: dp.gradient(LINE) + dp.laplacian(LINE),
        SHAPE,
        "gradient maps cells(3) to faces(3), but laplacian maps cells(3) to cells(3)",
    ),
    (
        lambda: dp.Operator(dp.laplacian(LINE).structure, BOX.cells, BOX.cells, "odd"),
        SHAPE,
        "odd maps cells(2, 2) to cells(2, 2), but its matrix has shape (3, 3)",
    ),
    # what a user brings
    (lambda: dp.from_matrix(np.ones(3)), SHAPE, "matrix needs a 2-D matrix, got an array of shape (3,)"),
    (lambda: dp.from_matrix([["a"]]), TYPE, "matrix needs a matrix of numbers, got dtype <U1"),
    (lambda: dp.from_matrix([[np.nan]]), FINITE, "matrix needs finite entries, got NaN or infinity"),
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
        "the function must return an array of shape (3,), got (2,)",
    ),
    (
        lambda: dp.from_functions(lambda u: 1j * u, None, 3, 3)(np.ones(3)),
        DERIVATIVE,
        "the function returned complex values for a real field; give its operator dtype=complex",
    ),
    # catalogue
    (lambda: dp.curl(LINE), VALUE, "curl needs a 2-D or 3-D grid, got Grid(3 cells, size 3)"),
    (lambda: dp.upwind(LINE, direction=0), VALUE, "upwind needs direction 1 or -1, got 0"),
    (lambda: dp.diagonal(LINE.cells, np.ones(2)), SHAPE, "diagonal on cells(3) needs values of shape (3,), got (2,)"),
    (
        lambda: dp.diagonal(LINE.cells, [1.0, np.nan, np.inf]),
        FINITE,
        "diagonal on cells(3) needs finite values, got 2 others",
    ),
    (
        traced(lambda u: dp.diagonal(LINE.cells, u)(u)),
        DERIVATIVE,
        "diagonal needs constant values, got traced ones; write values * u instead",
    ),
    (traced(lambda u: dp.mask(LINE.cells, u)(u)), DERIVATIVE, "keep needs a constant boolean array, got a traced one"),
    (
        lambda: dp.mask(LINE.cells, np.ones(3)),
        TYPE,
        "keep needs a boolean array, got dtype float64; write keep.astype(bool)",
    ),
    (
        lambda: dp.gradient(LINE, solid=np.zeros(3)),
        TYPE,
        "solid needs a boolean array, got dtype float64; write solid.astype(bool)",
    ),
    (
        lambda: dp.interior(LINE, np.zeros(4, bool)),
        SHAPE,
        "solid needs one flag for each value on cells(3), got an array of shape (4,)",
    ),
    (lambda: dp.sample(BOX, np.ones(3)), SHAPE, "sample needs points of shape (m, 2), got an array of shape (3,)"),
    (lambda: dp.sample(dp.Grid(0), [0.0]), SHAPE, "sample needs a grid with cells, got Grid(0 cells, size 0)"),
    (lambda: dp.sample(LINE, [np.nan]), FINITE, "points need finite coordinates, got nan along x"),
    (lambda: dp.sample(LINE, [3.5]), VALUE, "points need x from 0 to 3, got x = 3.5"),
    (
        lambda: dp.prolong(LINE, 3, "cubic"),
        VALUE,
        "prolong needs interpolation 'constant' or 'linear', got 'cubic'",
    ),
    (lambda: dp.restrict(LINE, 2), SHAPE, "a factor must be a whole number >= 1 that divides (3,), got 2"),
    (lambda: dp.restrict(LINE, 0), SHAPE, "a factor must be a whole number >= 1 that divides (3,), got 0"),
    (lambda: dp.harmonic_average(LINE)(-np.ones(3)), VALUE, "harmonic_average needs a coefficient >= 0, got -1"),
    (
        lambda: dp.harmonic_average(LINE)(np.full(3, np.nan)),
        FINITE,
        "harmonic_average needs a finite coefficient, got NaN or infinity",
    ),
    (
        lambda: dp.laplacian(dp.Grid(3, spacing=1e-200)),
        FINITE,
        "coefficients overflow: the spacing is too small; rescale the lengths of the grid",
    ),
    (
        lambda: dp.laplacian(dp.Grid(3, spacing=1e200)),
        FINITE,
        "coefficients underflow: the spacing is too large; rescale the lengths of the grid",
    ),
]


@pytest.mark.parametrize(("call", "error", "message"), TABLE, ids=[row[2][:50] for row in TABLE])
def test_message(call, error, message):
    with pytest.raises(error) as caught:
        call()
    assert str(caught.value) == message
    assert caught.type is error or error in (TYPE, VALUE, AttributeError)
