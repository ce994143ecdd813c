"""Every message of the foundation, printed once. A message says what was given and what to write instead."""

import math

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


TABLE = [
    # grid
    (lambda: dp.Grid(()), SHAPE, "a grid needs one to three whole lengths >= 0, got shape (); write Grid((8, 6))"),
    (
        lambda: dp.Grid((2, 2, 2, 2)),
        SHAPE,
        "a grid needs one to three whole lengths >= 0, got shape (2, 2, 2, 2); write Grid((8, 6))",
    ),
    (lambda: dp.Grid(2.5), SHAPE, "a grid needs one to three whole lengths >= 0, got shape 2.5; write Grid((8, 6))"),
    (
        lambda: dp.Grid((2.5,)),
        SHAPE,
        "a grid needs one to three whole lengths >= 0, got shape (2.5,); write Grid((8, 6))",
    ),
    (
        lambda: dp.Grid((-1,)),
        SHAPE,
        "a grid needs one to three whole lengths >= 0, got shape (-1,); write Grid((8, 6))",
    ),
    (
        lambda: dp.Grid((True,)),
        SHAPE,
        "a grid needs one to three whole lengths >= 0, got shape (True,); write Grid((8, 6))",
    ),
    (lambda: dp.Grid(4, size=1.0, spacing=1.0), VALUE, "a grid takes size or spacing, not both; leave one out"),
    (lambda: dp.Grid(4, spacing=-1.0), VALUE, "spacing must be positive and finite, got -1.0"),
    (lambda: dp.Grid(4, spacing=0.0), VALUE, "spacing must be positive and finite, got 0.0"),
    (lambda: dp.Grid(4, spacing=np.nan), VALUE, "spacing must be positive and finite, got nan"),
    (
        lambda: dp.Grid(4, size=np.inf),
        VALUE,
        "size must be finite, got inf",
    ),
    (lambda: dp.Grid(4, size=-2.0), VALUE, "size must be > 0, got -2"),
    (
        lambda: dp.Grid(4, origin=np.nan),
        VALUE,
        "origin must be finite, got nan",
    ),
    (lambda: dp.Grid((4, 4), size=(1.0,)), SHAPE, "size needs one entry for each of 2 axes, got 1"),
    (lambda: dp.Grid((4, 4), periodic=[True]), SHAPE, "periodic needs one entry for each of 2 axes, got 1"),
    (
        lambda: dp.Grid((2, 2), periodic="x"),
        TYPE,
        "periodic needs True or False for each axis, got 'x'; write periodic=(True, False)",
    ),
    (lambda: dp.Grid(2, periodic=1), TYPE, "periodic needs True or False for each axis, got 1; write periodic=True"),
    (lambda: dp.Grid(2, spacing="a"), TYPE, "spacing needs real numbers, got 'a'; write for example spacing=0.5"),
    (
        lambda: dp.Grid(2, size="a"),
        TYPE,
        "size must be one real number, got 'a'; write one number for each axis, or one for all",
    ),
    (
        lambda: dp.Grid(2, origin="a"),
        TYPE,
        "origin must be one real number, got 'a'; write one number for each axis, or one for all",
    ),
    (
        lambda: dp.Grid(2, origin=1j),
        TYPE,
        "origin must be one real number, got 1j; write one number for each axis, or one for all",
    ),
    (lambda: dp.Grid(4, spacing=np.ones(3)), SHAPE, "spacing along x needs 4 cell widths, got an array of shape (3,)"),
    (
        lambda: BOX.axis("z"),
        VALUE,
        "Grid(2 x 2 cells, size 2 x 2) has axes 0 to 1, got 'z'; write a number or a name of x, y",
    ),
    (
        lambda: BOX.face_centres(2),
        VALUE,
        "Grid(2 x 2 cells, size 2 x 2) has axes 0 to 1, got 2; write a number or a name of x, y",
    ),
    (
        lambda: LINE.split(np.ones(3)),
        SHAPE,
        "split takes a field on faces(3) of shape (4,), got an array of shape (3,)",
    ),
    (
        lambda: BOX.join(np.ones(3)),
        SHAPE,
        "join on faces(2, 2) takes 2 components, got 1; their shapes are (3, 2), (2, 3)",
    ),
    (
        lambda: BOX.join(np.ones(7), 1.0),
        SHAPE,
        "join on faces(2, 2) needs components ((3, 2), (2, 3)), got one of shape (7,)",
    ),
    (
        lambda: dp.Space(7).component(0),
        TYPE,
        "component takes faces or edges of a grid, got space(7); write grid.faces.component(0)",
    ),
    (
        lambda: BOX.cells.component(0),
        TYPE,
        "component takes faces or edges of a grid, got cells(2, 2); write grid.faces.component(0)",
    ),
    (
        lambda: BOX.faces.component(2),
        VALUE,
        "Grid(2 x 2 cells, size 2 x 2) has axes 0 to 1, got 2; write a number or a name of x, y",
    ),
    (lambda: dp.Space(-1), SHAPE, "a space needs whole lengths >= 0, got -1; write Space(7) or Space((2, 3))"),
    (
        lambda: dp.Space(2.5),
        SHAPE,
        "a space needs whole lengths >= 0, got 2.5; write Space(7) or Space((2, 3))",
    ),
    (lambda: setattr(LINE, "dim", 2), AttributeError, "Grid is frozen; make a new one instead of setting dim"),
    (lambda: setattr(LINE.cells, "x", 2), AttributeError, "Space is frozen; make a new one instead of setting x"),
    (lambda: setattr(dp.neumann, "a", 2), AttributeError, "Condition is frozen; make a new one instead of setting a"),
    (
        lambda: setattr(dp.laplacian(LINE), "form", 2),
        AttributeError,
        "Operator is frozen; make a new one instead of setting form",
    ),
    # boundary conditions
    (lambda: dp.robin(-1, 1), VALUE, "a of robin must be >= 0, got -1; write for example robin(1.0, 0.5)"),
    (lambda: dp.robin(0, 0), VALUE, "a and b of robin must not both be 0; write for example robin(1.0, 0.5)"),
    (lambda: dp.robin(np.nan, 1), VALUE, "a of robin must be finite, got nan"),
    (lambda: dp.robin("a", 1), TYPE, "a of robin must be one real number, got 'a'; write for example robin(1.0, 0.5)"),
    (
        lambda: dp.gradient(LINE, solid_boundary="dirichlet"),
        TYPE,
        "solid_boundary needs one condition, dirichlet, neumann or robin(a, b), got 'dirichlet'",
    ),
    (
        lambda: dp.laplacian(LINE, solid=np.zeros(3, bool), solid_boundary={"x": dp.neumann}),
        TYPE,
        "solid_boundary needs one condition, dirichlet, neumann or robin(a, b), got {'x': neumann}",
    ),
    (
        lambda: dp.gradient(LINE, {"y": dp.neumann}),
        VALUE,
        "boundary names axis 'y', but Grid(3 cells, size 3) has x; give the two sides of an axis as "
        "{'x': (lower, upper)}",
    ),
    (
        lambda: dp.gradient(RING, {"x": dp.neumann}),
        VALUE,
        "axis x is periodic and takes no boundary condition; leave it out",
    ),
    (
        lambda: dp.gradient(LINE, "dirichlet"),
        TYPE,
        "boundary on x needs dirichlet, neumann, robin(a, b) or a pair of them, got 'dirichlet'; write dp.dirichlet",
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
        lambda: dp.gradient(LINE).apply(np.ones(3), out=[1]),
        TYPE,
        "gradient, as out, takes an array, got list; write out=np.empty((4,), 'float64')",
    ),
    (
        lambda: dp.gradient(LINE).apply(np.ones(3), out=np.ones(3)),
        SHAPE,
        "gradient gives a field on faces(3), got out of shape (3,); write out=np.empty((4,), 'float64')",
    ),
    (
        lambda: dp.gradient(LINE).apply(np.ones(3), out=np.ones(4, np.float32)),
        TYPE,
        "gradient gives float64 here, got out of dtype float32; write out=np.empty((4,), 'float64')",
    ),
    (
        lambda: (lambda u: dp.laplacian(LINE).apply(u, out=u))(np.ones(3)),
        VALUE,
        "laplacian needs an out that is contiguous, writeable and apart from u; write out=np.empty((3,), 'float64')",
    ),
    (
        lambda: dp.laplacian(BOX) @ np.ones((2, 2)),
        SHAPE,
        "x of laplacian @ x must have shape (4,), got (2, 2); for a field write op(u)",
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
        "a traced number cannot scale an operator; write nu * laplacian(u), and to solve a system with it "
        "dp.implicit(residual)",
    ),
    (
        traced(lambda u: (dp.laplacian(LINE) * u[0])(u)),
        DERIVATIVE,
        "a traced number cannot scale an operator; write nu * laplacian(u), and to solve a system with it "
        "dp.implicit(residual)",
    ),
    (lambda: dp.laplacian(LINE) / 0, FINITE, "laplacian can be divided by a finite number other than 0 only, got 0"),
    (
        lambda: dp.laplacian(LINE) / np.float64(0),
        FINITE,
        "laplacian can be divided by a finite number other than 0 only, got 0.0",
    ),
    (
        lambda: dp.laplacian(LINE) * np.nan,
        FINITE,
        "a factor of laplacian must be finite, got nan; write a finite number",
    ),
    (
        lambda: dp.laplacian(LINE) / np.inf,
        FINITE,
        "laplacian can be divided by a finite number other than 0 only, got inf",
    ),
    (
        lambda: np.ones(3) @ dp.laplacian(LINE),
        TYPE,
        "laplacian stands on the left of @; for x @ A write laplacian.T @ x",
    ),
    (
        lambda: np.asarray(dp.laplacian(LINE)),
        TYPE,
        "laplacian is no array; write op.matrix, op.to_scipy() or laplacian(u)",
    ),
    (
        lambda: dp.inverse(dp.from_matrix(np.diag([1e300, 1e-300]))),
        FINITE,
        "the entries of <matrix: space(2) -> space(2), explicit> span more than 1e308; rescale its rows or columns",
    ),
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
]


def filled(u):
    v = np.zeros(3)
    v[0] = u[0]
    return anp.sum(v)


REFUSE = (
    "a traced value was refused ({}); write the function with autograd.numpy, without float(), item() and "
    "u[i] = ..., or take foreign code in by dp.from_blackbox or dp.differentiable"
)


@pytest.mark.parametrize("loss", [lambda u: float(anp.sum(u)), lambda u: math.sin(u[0]), lambda u: u[0].item(), filled])
def test_a_loss_that_leaves_the_tape(loss):
    for run in (dp.value_and_grad(loss), lambda x: dp.check.gradient(loss, x), lambda x: dp.minimize(loss, x)):
        with pytest.raises(DERIVATIVE) as caught:
            run(np.ones(3))
        said = str(caught.value)
        assert said == REFUSE.format(caught.value.__cause__) and isinstance(caught.value, TypeError)
    assert dp.check.gradient(lambda u: float(np.sum(u**2)), np.ones(3), gradient=lambda u: 2 * u)


@pytest.mark.parametrize(("call", "error", "message"), TABLE, ids=[row[2][:50] for row in TABLE])
def test_message(call, error, message):
    with pytest.raises(error) as caught:
        call()
    assert str(caught.value) == message
    assert caught.type is error or error in (TYPE, VALUE, AttributeError)
