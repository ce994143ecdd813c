"""What those who begin write wrongly: each message, whole, and what is taken because it can mean one thing only."""

import re

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.errors import DerivativeError, ShapeError

GRID = dp.Grid((3, 2))
SIDES = {"x": dp.dirichlet, "y": dp.robin(1.0, 0.5)}
LIFT = dp.lift(GRID, SIDES)
SOLVE = dp.elliptic_solver(dp.divergence(GRID), dp.gradient(GRID, dp.dirichlet))
MINIMUM = dp.minimize(lambda x: (x - 1.0) ** 2, 0.0)
LAYERS = {"first": dp.network.dense_weights(np.random.default_rng(0), 2, 3)}
RNG = np.random.default_rng(0)

WRONG = [
    (
        lambda: dp.curl(GRID)(np.zeros((3, 2))),
        ShapeError,
        "curl takes a field on nodes(3, 2) of shape (4, 3), got an array of shape (3, 2)",
    ),
    (
        lambda: LIFT(0.0),
        ShapeError,
        "lift takes a field on walls(3, 2) of shape (10,), got an array of shape (); write np.full((10,), 0.0)",
    ),
    (
        lambda: LIFT([np.zeros(2), np.zeros(2), np.zeros(3), np.zeros(3)]),
        ShapeError,
        "lift takes one array on walls(3, 2) of shape (10,), got 4 parts; write op.domain.join(*parts)",
    ),
    (
        lambda: dp.divergence(GRID)(GRID.split(np.zeros(17))),
        ShapeError,
        "divergence takes one array on faces(3, 2) of shape (17,), got 2 parts; write grid.join(*parts)",
    ),
    (
        lambda: SOLVE(np.ones((3, 2)), np.ones((3, 2))),
        ShapeError,
        "k takes a number or a field on faces(3, 2) of shape (17,), got an array of shape (3, 2); "
        "write harmonic_average(grid)(k)",
    ),
    (
        lambda: dp.network.dense(LAYERS, np.ones((1, 2))),
        TypeError,
        "dense takes the dict of one layer, with weight and bias, got first; write p['name'] of that layer",
    ),
    (
        lambda: dp.network.convolution(LAYERS["first"]["weight"], np.ones((1, 2, 5))),
        TypeError,
        "convolution takes the dict of one layer, with weight and bias, got ndarray; write p['name'] of that layer",
    ),
    (
        lambda: dp.network.dense_weights(0, 2, 3),
        TypeError,
        "weights are drawn from a numpy Generator, got 0; write np.random.default_rng(0)",
    ),
    (
        lambda: dp.minimize(lambda x: anp.sum(x**2), np.ones(4), bounds=(np.zeros(3), None)),
        ShapeError,
        "bounds[0]: shape (3,) does not fit start, of shape (4,)",
    ),
    (
        lambda: dp.divergence(GRID) * dp.gradient(GRID),
        TypeError,
        "divergence * gradient is not defined; write A @ B to compose operators",
    ),
    (
        lambda: dp.laplacian(GRID) + 1,
        TypeError,
        "a number cannot be added to laplacian; write laplacian + c * dp.identity(space)",
    ),
    (
        lambda: dp.gradient((4, 4)),
        TypeError,
        "an operator, as its first argument, takes a Grid, got tuple; write dp.Grid((8, 6), size=1.0)",
    ),
    (
        lambda: dp.check.gradient(lambda x: anp.sum(x**2), np.ones(3), directions=-1),
        ValueError,
        "directions of check.gradient must be a whole number >= 0, got -1; the default is 3",
    ),
    (
        lambda: dp.laplacian(GRID, (dp.dirichlet, dp.neumann)),
        TypeError,
        "a pair of conditions belongs to one axis of Grid(3 x 2 cells, size 3 x 2); name it: "
        "{'x': (dirichlet, neumann)}",
    ),
    (
        lambda: dp.dirichlet(1.0),
        TypeError,
        "dirichlet takes no value here; write G(u) + B(values), B = dp.lift(grid, dp.dirichlet)",
    ),
    (
        lambda: dp.lapacian,
        AttributeError,
        "module 'sparsedp' has no attribute 'lapacian'; write 'laplacian'",
    ),
    (lambda: dp.banana, AttributeError, "module 'sparsedp' has no attribute 'banana'"),
    (lambda: MINIMUM.fun, AttributeError, "Minimum has no attribute 'fun'; write best.value"),
    (lambda: MINIMUM.nit, AttributeError, "Minimum has no attribute 'nit'; write best.history[-1].iteration"),
    (lambda: MINIMUM.gain, AttributeError, "'Minimum' object has no attribute 'gain'"),
    (lambda: GRID.dx, AttributeError, "Grid has no attribute 'dx'; write grid.widths"),
    (lambda: GRID.x, AttributeError, "Grid has no attribute 'x'; write grid.centres()[0]"),
    (lambda: LIFT.dot, AttributeError, "Operator has no attribute 'dot'; write op(u), or A @ B"),
    (lambda: LIFT.toarray(), AttributeError, "Operator has no attribute 'toarray'; write op.matrix.toarray()"),
    (
        lambda: dp.minimize(lambda x: x**2, 1.0, tol=1e-3),
        TypeError,
        "lbfgs has no option 'tol'; it has memory, line_search; write tolerance=...",
    ),
    (
        lambda: dp.minimize(lambda x: x**2, 1.0, jac=True),
        TypeError,
        "lbfgs has no option 'jac'; it has memory, line_search; write gradient=function, or omit it: it is "
        "computed in reverse mode",
    ),
    (
        lambda: dp.minimize(lambda x: x**2, 1.0, method="L-BFGS-B"),
        ValueError,
        "method must be one of lbfgs, gd, adam, newton_cg, gauss_newton, levenberg_marquardt, half_inverse, "
        "physical_gradient, admm, augmented_lagrangian, mma, slsqp, trust_constr, ipopt, got 'L-BFGS-B'; write 'lbfgs'",
    ),
    (
        lambda: dp.inverse(dp.laplacian(GRID), method="cg"),
        ValueError,
        "method must be one of auto, separable, direct, structured, multigrid, krylov, schur, got 'cg'; write 'krylov'",
    ),
    (
        lambda: dp.inverse(dp.laplacian(GRID), tol=1e-3),
        TypeError,
        "method auto takes the options rtol, maxiter, nullspace, precision, cycle, strength, sweeps, levels, "
        "preconditioner, diff, iterations, got 'tol'; write 'rtol'",
    ),
    (
        lambda: dp.stepper("tr_bdf2", lambda u, p: -u, 0.1, nullspace="project"),
        TypeError,
        "method auto takes the options rtol, maxiter, sparsity, precision, cycle, strength, sweeps, levels, "
        "preconditioner, diff, iterations, got 'nullspace'",
    ),
    (
        lambda: dp.grad(lambda p: p["a"] ** 2)({"a": 1}),
        DerivativeError,
        "a gradient needs floating values, got int; write 1.0 instead of 1",
    ),
    (
        lambda: dp.stepper("tr_bdf2", dp.laplacian(GRID), 0.1)(np.ones(GRID.shape), {"nu": 1.0}),
        TypeError,
        "the coefficient of laplacian must be one real number, got {'nu': 1.0}; write linear=(op, lambda params: ...) "
        "with a function that returns the number",
    ),
    (
        lambda: dp.value_and_grad(lambda x: anp.sum(x**2), np.ones(2)),
        ValueError,
        "argnum of value_and_grad must be a whole number >= 0, got an array of shape (2,); write 0 for the first "
        "argument, and value_and_grad(loss)(x) for the gradient at x",
    ),
    (
        lambda: dp.check.gradient(dp.value_and_grad(lambda x: anp.sum(x**2)), np.ones(2)),
        ShapeError,
        "the loss must be a scalar, got a tuple; return one number",
    ),
    (
        lambda: dp.steady(lambda x: x, 1.0, 2.0),
        TypeError,
        "implicit(<lambda>) calls a function with 2 arguments, got one that takes 1; "
        "write lambda x, p: ..., and root(guess, p)",
    ),
    (
        lambda: dp.minimize(lambda x: anp.sum(x**2), np.ones(9), bounds=[(0, 1)] * 9),
        ValueError,
        "bounds must be a pair (lower, upper), each a number, None or a tree like start, got [(0, 1), (0, 1), (0, 1), "
        "(0, 1), (0, 1), (0, 1), ...]; write tuple(map(np.array, zip(*bounds))), with -np.inf or np.inf in place of "
        "None",
    ),
]

NO_PARAMS = "; write rollout(step, start, params, n): the params given are None"
NO_KEY = "; write params[key]: the params given are a dict with the keys 'nu', 'k'"
NO_ARRAY = "; write np.asarray(x) for an array: a list is a tree of numbers"


@pytest.mark.parametrize(
    "call, advice",
    [
        (lambda: dp.rollout(lambda u, p: u * p, np.ones(2), None, 3), NO_PARAMS),
        (lambda: dp.rollout(lambda u, p: u * p["k"], np.ones(2), None, 3), NO_PARAMS),
        (lambda: dp.grad(lambda u: anp.sum(dp.rollout(lambda u, p: u * p[0], u, None, 3)))(np.ones(2)), NO_PARAMS),
        (lambda: dp.rollout(lambda u, p: u * p, np.ones(2), {"nu": 1.0, "k": 2.0}, 3), NO_KEY),
        (lambda: dp.stepper("rk4", lambda u, p: -p * u, 0.1)(np.ones(2), {"nu": 1.0, "k": 2.0}), NO_KEY),
        (lambda: dp.rollout(lambda u, p: u * 0.5, [1.0, 2.0], None, 3), NO_ARRAY),
        (lambda: dp.grad(lambda x: anp.sum(x**2))([1.0, 2.0]), NO_ARRAY),
        (lambda: dp.minimize(lambda x: anp.sum(x**2), [1.0, 2.0]), NO_ARRAY),
        (lambda: dp.check.gradient(lambda x: anp.sum(x**2), [[1.0, 2.0]]), NO_ARRAY),
    ],
)
def test_an_error_of_arithmetic_says_what_was_given(call, advice):
    """Python's words, and what to write; once, also through several loops."""
    with pytest.raises(TypeError) as caught:
        call()
    assert str(caught.value).endswith(advice) and str(caught.value).count("; write") == 1


def test_other_errors_of_a_step_are_left_alone():
    """None that is no matter of the params."""
    with pytest.raises(TypeError, match="^unsupported operand type.s. for .: 'float' and 'NoneType'$"):
        dp.rollout(lambda u, p: u * 0.5 + (0.5 * None), np.ones(2), 2.0, 3)


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

    adopted = dp.from_blackbox(squares)
    slope = dp.value_and_grad(lambda x: anp.sum(adopted(x)))(np.arange(4.0))[1]
    assert np.allclose(slope, 2 * np.arange(4.0)) and adopted.way == "central differences" and not recwarn.list
