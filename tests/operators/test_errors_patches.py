"""Every message of `patch`, printed once."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.grid.boundary_conditions import dirichlet, neumann, patch, resolve, robin

BOX = dp.Grid((3, 4), spacing=[[0.5, 0.3, 0.2], [0.1, 0.4, 0.3, 0.2]], origin=(1.0, -0.5))
WALL = patch((0.0, 0.3), dirichlet)
LIFT = dp.lift(BOX, {"x": (WALL, neumann)})
SHAPE = dp.errors.ShapeError
FINITE = dp.errors.NonFiniteError
DERIVATIVE = dp.errors.DerivativeError
TYPE = TypeError
VALUE = ValueError


def used(wall, grid=BOX):
    return lambda: dp.gradient(grid, {"x": (wall, neumann)})


TABLE = [
    (
        lambda: patch((0, 1), "dirichlet"),
        TYPE,
        "patch needs a condition such as dp.dirichlet or dp.outflow, got 'dirichlet'; write dp.patch((0.2, "
        "0.4), dp.dirichlet, elsewhere=dp.neumann)",
    ),
    (
        lambda: patch((0, 1), dirichlet, dp.no_slip),
        TYPE,
        "patch of dirichlet needs dirichlet, neumann, robin(a, b) or a patch of them as elsewhere=, got no_slip",
    ),
    (
        lambda: WALL(3.0),
        TYPE,
        "a patch takes no value here; write G(u) + B(values), B = dp.lift(grid, boundary)",
    ),
    (
        lambda: patch("left", dirichlet),
        TYPE,
        "where of patch needs (start, stop) or a bool array, got 'left'; write (0.2, 0.4)",
    ),
    (
        lambda: patch(np.arange(4), dirichlet),
        TYPE,
        "an interval of patch needs (start, stop), got 0; write for example (0.2, 0.4)",
    ),
    (
        lambda: patch((0, "1"), dirichlet),
        TYPE,
        "an interval of patch needs two real numbers, got (0, '1'); write for example (0.2, 0.4)",
    ),
    (
        lambda: patch((0, 1j), dirichlet),
        TYPE,
        "an interval of patch needs two real numbers, got (0, 1j); write for example (0.2, 0.4)",
    ),
    (
        lambda: patch((0, 1, 2), dirichlet),
        TYPE,
        "an interval of patch needs (start, stop), got 0; write for example (0.2, 0.4)",
    ),
    (
        lambda: patch((0, None), dirichlet),
        TYPE,
        "an interval of patch needs (start, stop), got 0; write for example (0.2, 0.4)",
    ),
    (
        lambda: patch((0, np.nan), dirichlet),
        FINITE,
        "an interval of patch needs finite coordinates, got (0, nan)",
    ),
    (
        lambda: patch((1, 0), dirichlet),
        VALUE,
        "an interval of patch needs start < stop, got (1, 0)",
    ),
    (
        lambda: dp.grad(lambda end: anp.sum(used(patch((0.0, end), dirichlet))()(np.ones((3, 4)))))(0.3),
        DERIVATIVE,
        "where of patch must be constant, not traced; the values of lift on it have derivatives",
    ),
    (
        used(patch((-0.6, 0.1), dirichlet)),
        VALUE,
        "a patch of x-lower reaches from -0.6 to 0.1 along y, but the wall from -0.5 to 0.5; give "
        "coordinates on the wall",
    ),
    (
        used(patch((0.0, 0.1), dirichlet)),
        VALUE,
        "patch((0.0, 0.1), dirichlet, elsewhere=neumann) covers no face of x-lower; a face belongs to a "
        "patch if its centre lies inside, so make the patch larger or the cells smaller",
    ),
    (
        used(patch([False] * 4, dirichlet)),
        VALUE,
        "patch(<mask of 0 faces>, dirichlet, elsewhere=neumann) covers no face of x-lower; a face belongs to "
        "a patch if its centre lies inside, so make the patch larger or the cells smaller",
    ),
    (
        used(patch([True] * 3, dirichlet)),
        SHAPE,
        "x-lower has faces of shape (4,), but the mask of patch(<mask of 3 faces>, dirichlet, "
        "elsewhere=neumann) has shape (3,); give one entry for each face",
    ),
    (
        used(patch(((0, 1), (0, 1)), dirichlet)),
        SHAPE,
        "x-lower of a grid in 2-D takes one interval for each of y, got patch(((0.0, 1.0), (0.0, 1.0)), "
        "dirichlet, elsewhere=neumann)",
    ),
    (
        used(patch((0, 1), dirichlet), dp.Grid(3)),
        SHAPE,
        "x-lower of a grid in 1-D takes a mask of one entry, because it is one face, got patch((0.0, 1.0), "
        "dirichlet, elsewhere=neumann)",
    ),
    (
        used(patch((-0.5, 0.2), dirichlet, patch((0.0, 0.5), robin(1, 1)))),
        VALUE,
        "two patches overlap on 1 faces of x-lower; give each face to one patch",
    ),
    (
        used(patch((0, 0.3), dp.no_slip)),
        TYPE,
        "boundary on x needs dirichlet, neumann, robin(a, b) or a pair of them, got (patch((0.0, 0.3), "
        "no_slip, elsewhere=no_slip), neumann); no_slip belongs to dp.projection and dp.flow_step, write "
        "dp.dirichlet here",
    ),
    (
        used(WALL, dp.Grid((3, 4), periodic=(True, False))),
        VALUE,
        "axis x is periodic and takes no boundary condition; leave it out",
    ),
    (
        used(resolve(BOX, {"x": WALL}, patches=True)[0][0], dp.Grid((3, 5))),
        SHAPE,
        "x-lower of Grid(3 x 5 cells, size 3 x 5) has faces of shape (5,), but the conditions are for (4,)",
    ),
    (
        lambda: WALL.values(BOX, "x", np.ones(3)),
        SHAPE,
        "values of a patch takes inside as a number or an array of shape (4,), one entry for each face of "
        "the wall, got shape (3,)",
    ),
    (
        lambda: WALL.values(BOX, "x", None),
        TYPE,
        "inside of patch.values must hold numbers, got dtype object",
    ),
    *(
        (
            call,
            VALUE,
            "x-lower has several conditions, and one number does not say which of them it belongs to; write "
            "patch.values(grid, 'x', number), or one entry for each face",
        )
        for call in (
            lambda: LIFT.domain.join(np.array([20.0]), 0.0, 0.0, 0.0),
            lambda: dp.grad(lambda value: anp.sum(LIFT.domain.join(value, 0.0, 0.0, 0.0)))(np.zeros((1, 1))),
        )
    ),
    (
        lambda: LIFT.domain.join(20.0, 0.0, 0.0, 0.0),
        VALUE,
        "x-lower has several conditions, and one number does not say which of them it belongs to; write "
        "patch.values(grid, 'x', number), or one entry for each face",
    ),
    (
        lambda: dp.conservation_law(
            BOX, lambda u, p, a: u, lambda u, p, a: (u, u), boundary={"x": patch((0.0, 0.3), dp.outflow)}
        ),
        TYPE,
        "conservation_law takes one condition for each wall, but x-lower has a patch; write one condition, "
        "such as dp.outflow",
    ),
]


@pytest.mark.parametrize("number", range(len(TABLE)))
def test_messages(number):
    call, kind, message = TABLE[number]
    with pytest.raises(kind) as refused:
        call()
    assert str(refused.value) == message
