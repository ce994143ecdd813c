"""What those who begin write wrongly: each message, whole, and what is taken because it can mean one thing only."""

import re

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.errors import ShapeError

GRID = dp.Grid((3, 2))
SIDES = {"x": dp.dirichlet, "y": dp.robin(1.0, 0.5)}
LIFT, SOLVE = dp.lift(GRID, SIDES), dp.elliptic_solver(dp.divergence(GRID), dp.gradient(GRID, dp.dirichlet))
LAYERS = {"first": dp.network.dense_weights(np.random.default_rng(0), 2, 3)}
RNG = np.random.default_rng(0)

WRONG = [
    (
        lambda: dp.curl(GRID)(np.zeros((3, 2))), ShapeError,
        "curl takes a field on nodes(3, 2) of shape (4, 3), got an array of shape (3, 2)",
    ),
    (lambda: LIFT(0.0), ShapeError, "lift takes a field on walls(3, 2) of shape (10,), got an array of shape ()"),
    (
        lambda: LIFT([np.zeros(2), np.zeros(2), np.zeros(3), np.zeros(3)]), ShapeError,
        "lift takes one array on walls(3, 2) of shape (10,), got 4 parts; write op.domain.join(*parts)",
    ),
    (
        lambda: dp.divergence(GRID)(GRID.split(np.zeros(17))), ShapeError,
        "divergence takes one array on faces(3, 2) of shape (17,), got 2 parts; write grid.join(*parts)",
    ),
    (
        lambda: SOLVE(np.ones((3, 2)), np.ones((3, 2))), ShapeError,
        "k takes a number or a field on faces(3, 2) of shape (17,), got an array of shape (3, 2); "
        "write harmonic_average(grid)(k)",
    ),
    (
        lambda: dp.network.dense(LAYERS, np.ones((1, 2))), TypeError,
        "dense takes the dict of one layer, with weight and bias, got first; write p['name'] of that layer",
    ),
    (
        lambda: dp.network.convolution(LAYERS["first"]["weight"], np.ones((1, 2, 5))), TypeError,
        "convolution takes the dict of one layer, with weight and bias, got ndarray; write p['name'] of that layer",
    ),
    (
        lambda: dp.network.dense_weights(0, 2, 3), TypeError,
        "weights are drawn from a numpy Generator, got 0; write np.random.default_rng(0)",
    ),
    (
        lambda: dp.minimize(lambda x: anp.sum(x**2), np.ones(4), bounds=(np.zeros(3), None)), ShapeError,
        "a bound of shape (3,) does not fit start, of shape (4,)",
    ),
    (
        lambda: dp.divergence(GRID) * dp.gradient(GRID), TypeError,
        "divergence * gradient is not defined; write A @ B to compose operators",
    ),
    (
        lambda: dp.laplacian(GRID) + 1, TypeError,
        "a number cannot be added to laplacian; write laplacian + c * dp.identity(space)",
    ),
    (
        lambda: dp.gradient((4, 4)), TypeError,
        "an operator, as its first argument, takes a Grid, got tuple; write dp.Grid((8, 6), size=1.0)",
    ),
    (
        lambda: dp.check.gradient(lambda x: anp.sum(x**2), np.ones(3), directions=-1), ValueError,
        "directions of check.gradient must be a whole number >= 0, got -1; the default is 3",
    ),
]  # fmt: skip


@pytest.mark.parametrize("call, error, message", WRONG, ids=[row[2][:40] for row in WRONG])
def test_message(call, error, message):
    with pytest.raises(error, match="^" + re.escape(message) + "$"):
        call()


def test_the_values_along_a_wall():
    """In 2-D the values along a wall are one row of numbers, whichever way the wall stands."""
    known = LIFT.domain.join(
        *(np.arange(n).reshape(shape) for n, shape in ((2, (1, 2)), (2, (1, 2)), (3, (3, 1)))), 7.0
    )
    assert np.array_equal(LIFT.domain.join(np.arange(2), np.arange(2), np.arange(3), 7.0), known)
    loss = lambda v: anp.sum(LIFT(LIFT.domain.join(0.0, 0.0, v, 0.0)) ** 2)
    assert dp.value_and_grad(loss)(np.ones(3))[1].shape == (3,)
    with pytest.raises(ShapeError, match=re.escape("((1, 2), (1, 2), (3, 1), (3, 1)), got one of shape (4,)")):
        LIFT.domain.join(0.0, 0.0, np.ones(4), 0.0)


def test_code_that_drops_the_imaginary_part_is_no_reason_to_warn(recwarn):
    def squares(x):
        y = np.empty(x.shape)
        y[:] = x**2
        return y

    adopted = dp.adopt(squares)
    slope = dp.value_and_grad(lambda x: anp.sum(adopted(x)))(np.arange(4.0))[1]
    assert np.allclose(slope, 2 * np.arange(4.0)) and adopted.way == "central differences" and not recwarn.list
