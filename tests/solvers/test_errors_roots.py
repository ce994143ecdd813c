"""Every message of implicit and matrix_solver, printed once."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.derivative import value_and_grad

SHAPE = dp.errors.ShapeError
TYPE = TypeError
VALUE = ValueError
FINITE = dp.errors.NonFiniteError
DERIVATIVE = dp.errors.DerivativeError
FAILED = dp.errors.ConvergenceError
TWO = np.ones(2)
BAND = np.diag(np.full(12, 3.0)) - np.diag(np.ones(11), 1)
WRONG = BAND.copy()
WRONG[5, 6] = -1.25
OP = dp.from_matrix(BAND)


def square(x, p):
    return x**2 - p


def slope(root, guess, p):
    """The gradient of the sum of a root in its parameter."""
    return lambda: value_and_grad(lambda p: anp.sum(root(guess, p)))(p)


def traced_jacobian():
    def loss(q):
        return anp.sum(dp.implicit(square, lambda x, p: anp.diag(2 * x) * q)(TWO, 4 * TWO))

    return value_and_grad(loss)(1.0)


def not_linear():
    """A rule whose JVP is not linear in its direction."""
    bent = dp.differentiable("bent", lambda x: x + 0.0, None, lambda nums, ts, ans, x: ts[0] + 0.01 * ts[0] ** 3)
    root = dp.implicit(lambda x, p: bent(x) - p)
    return value_and_grad(lambda p: anp.sum(root(np.zeros(5), p)))(np.ones(5))


SOLVE = dp.matrix_solver(np.eye(3))

TABLE = [
    (
        lambda: dp.implicit(square, maxiter=None),
        VALUE,
        "maxiter must be a whole number >= 1, got None; the default is 50",
    ),
    (
        lambda: dp.implicit(square)(1j, 4.0),
        TYPE,
        "implicit(square) solves for real unknowns; give real and imaginary part as two fields",
    ),
    (lambda: dp.implicit(square)("a", 4.0), TYPE, "implicit(square) takes a guess of numbers, got str"),
    (
        lambda: value_and_grad(lambda q: dp.implicit(lambda x: x - q)(1.0))(3.0),
        DERIVATIVE,
        "the residual of implicit(<lambda>) uses a traced value that is not an argument; "
        "make it a parameter of the residual and pass it to the root",
    ),
    (
        lambda: dp.implicit(lambda x: x[:1])(TWO),
        SHAPE,
        "the residual of implicit(<lambda>) must hold 2 numbers, as many as x, got 1",
    ),
    (
        lambda: dp.steady(lambda x: {"v": x["u"] - x["w"], "w": x["w"]}, {"u": 1.0, "w": 2.0}),
        SHAPE,
        "residual of implicit(<lambda>): unknown key 'v'; expected 'u', 'w'; return a tree like x",
    ),
    (
        lambda: dp.steady(lambda x: {"s": {"b": x["s"]["u"], "a": x["s"]["w"]}}, {"s": {"u": 1.0, "w": 2.0}}),
        SHAPE,
        "residual['s'] of implicit(<lambda>): unknown keys 'b', 'a'; expected 'u', 'w'; return a tree like x",
    ),
    (
        lambda: dp.implicit(lambda x: 1j * x)(TWO),
        TYPE,
        "the residual of implicit(<lambda>) must be real; give real and imaginary part as two fields",
    ),
    (
        slope(dp.implicit(lambda u, f: OP(u) - f, lambda u, f: WRONG), np.zeros(12), np.ones(12)),
        DERIVATIVE,
        "the jacobian given for implicit(<lambda>) differs from the derivative of the residual "
        "by 4.9e-02 (relative) in row 5; correct it or leave it out",
    ),
    (
        slope(dp.implicit(lambda u, f: OP(u) - f, sparsity=np.eye(12)), np.zeros(12), np.ones(12)),
        DERIVATIVE,
        "the sparsity given for implicit(<lambda>) lacks entries in row 3; add them or leave it out",
    ),
    (traced_jacobian, DERIVATIVE, "the jacobian of implicit(square) uses a traced value that is not an argument"),
    (
        lambda: dp.implicit(square, lambda x, p: np.eye(3))(TWO, 4 * TWO),
        SHAPE,
        "the jacobian of implicit(square) must have shape (2, 2), got (3, 3)",
    ),
    (
        lambda: dp.implicit(square, lambda x, p: 1j * np.eye(2))(TWO, 4 * TWO),
        TYPE,
        "the jacobian of implicit(square) must hold real numbers, got dtype complex128",
    ),
    (
        lambda: dp.implicit(square, sparsity=np.eye(3))(TWO, 4 * TWO),
        SHAPE,
        "the sparsity of implicit(square) must have shape (2, 2), got (3, 3)",
    ),
    (not_linear, DERIVATIVE, "the derivative of implicit(<lambda>) is not linear in its direction in row 3"),
    (
        slope(dp.implicit(lambda x, p: x**3 - p), 0.0, 0.0),
        FAILED,
        "the Jacobian <implicit(<lambda>).jacobian: space(1) -> space(1), explicit> is singular at the solution: "
        "the root is not isolated and has no derivative; add an equation that fixes it or write nullspace='project'",
    ),
    (
        lambda: dp.implicit(square, maxiter=1)(1.0, 1e6),
        FAILED,
        "implicit(square) after 1 Newton steps: relative residual 9.6e-01, wanted 1e-10 (max_iterations); start from "
        "the solution for nearby parameters, or raise maxiter",
    ),
    (
        lambda: dp.matrix_solver(np.ones((2, 3))),
        SHAPE,
        "the pattern of matrix_solver must have shape (2, 2), got (2, 3)",
    ),
    (lambda: dp.matrix_solver(np.ones(3)), SHAPE, "matrix_solver takes a 2-D pattern, got an array of shape (3,)"),
    (lambda: SOLVE(TWO, np.ones(3)), SHAPE, "data must have shape (3,), got (2,); give one value for each entry"),
    (lambda: SOLVE(np.array(["a"] * 3), np.ones(3)), TYPE, "data must hold numbers, got dtype <U1"),
    (
        lambda: SOLVE(np.array([1, np.nan, 1]), np.ones(3)),
        FINITE,
        "data must be finite, got 1 that are NaN or infinite, the first at row 1, column 1",
    ),
    (lambda: SOLVE(np.ones(3), TWO), SHAPE, "matrix_solver takes a field on space(3), got an array of shape (2,)"),
]


@pytest.mark.parametrize(("call", "error", "message"), TABLE, ids=[row[2][:50] for row in TABLE])
def test_message(call, error, message):
    with pytest.raises(error) as caught:
        call()
    assert str(caught.value) == message
