"""`assert_gradient`, `assert_transpose` and the strategies, used by functions that know nothing of this library."""

import autograd.numpy as anp
import hypothesis
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import LinearOperator, aslinearoperator

import sparsedp as dp
from sparsedp.testing import assert_gradient, assert_transpose, fields, grids

X = np.linspace(1.0, 2.0, 5)


def cube(u):
    return np.sum(u**3)


RIGHT = {
    "loss on the tape": (lambda u: anp.sum(u**3), {}),
    "gradient": (cube, {"gradient": lambda u: 3 * u**2}),
    "value of the gradient": (cube, {"gradient": 3 * X**2}),
    "vector function on the tape": (lambda u: u**3, {}),
    "vjp": (np.exp, {"vjp": lambda u, g: np.exp(u) * g}),
    "jvp": (np.exp, {"jvp": lambda u, t: np.exp(u) * t}),
    "vjp and jvp": (np.exp, {"vjp": lambda u, g: np.exp(u) * g, "jvp": lambda u, t: np.exp(u) * t}),
    "jacobian": (np.exp, {"jacobian": sp.diags_array(np.exp(X))}),
    "hessian": (cube, {"hessian": np.diag(6 * X)}),
    "gradient and hessian": (cube, {"gradient": lambda u: 3 * u**2, "hessian": lambda u, v: 6 * u * v}),
}


@pytest.mark.parametrize("name", RIGHT)
def test_right_derivatives_pass(name):
    f, derivatives = RIGHT[name]
    assert assert_gradient(f, X, **derivatives)


class Outer:
    """An object that is called, with a tree as its result."""

    def __call__(self, p):
        return {"y": p["A"] @ p["b"]}

    def vjp(self, p, g):
        return {"A": np.outer(g["y"], p["b"]), "b": p["A"].T @ g["y"]}


class Cumulative:
    """An object whose VJP is right, and whose JVP is wrong."""

    def apply(self, u):
        return np.cumsum(u**2)

    def vjp(self, u, g):
        return 2 * u * np.cumsum(g[::-1])[::-1]

    def jvp(self, u, t):
        return np.cumsum(2.2 * u * t)


def test_objects():
    assert assert_gradient(Outer(), {"A": np.eye(3) + 0.1, "b": np.arange(3.0)})
    words = "^the vjp disagrees: vjp is not the transpose of jvp: .*\n  culprit: jvp, as vjp agrees with differences$"
    with pytest.raises(AssertionError, match=words):
        assert_gradient(Cumulative(), X)


@pytest.mark.whole
def test_losses_and_modules_of_torch():
    torch = pytest.importorskip("torch")
    x = torch.tensor(X)

    class Net(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.layer = torch.nn.Linear(5, 2).double()

        def forward(self, u):
            return torch.tanh(self.layer(u))

    assert assert_gradient(Net(), x)
    assert assert_gradient(lambda u: torch.sum(u**3), x, gradient=lambda u: 3 * u**2)
    assert assert_gradient(lambda u: torch.sum(u**3), x, gradient=3 * x**2)
    with pytest.raises(AssertionError, match="^the gradient disagrees: "):
        assert_gradient(lambda u: torch.sum(u**3), x, gradient=lambda u: 3.01 * u**2)
    with pytest.raises(AssertionError, match=r"^the gradient disagrees: gradient\(x\) holds NaN or infinity in x"):
        assert_gradient(lambda u: torch.sum(u**3), x, gradient=lambda u: np.nan * u)
    with pytest.raises(AssertionError, match=r"by differences, \S+ by gradient\(x\)"):
        assert_gradient(lambda u: torch.sum(u**3), x, gradient=lambda u: 3 * u)


WRONG = {
    "gradient": (cube, {"gradient": lambda u: 3.01 * u**2}),
    "vjp": (np.exp, {"vjp": lambda u, g: u * g}),
    "jvp": (np.exp, {"jvp": lambda u, t: u * t}),
    "jacobian": (np.exp, {"jacobian": np.diag(X)}),
    "hessian": (cube, {"hessian": np.diag(X)}),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_derivatives_are_named(name):
    f, derivatives = WRONG[name]
    with pytest.raises(AssertionError, match=f"^the {name} disagrees: "):
        assert_gradient(f, X, **derivatives)


def test_a_wrong_entry_is_named():
    def gradient(u):
        return np.where(np.arange(5) == 2, 0.9, 1.0) * 3 * u**2

    with pytest.raises(AssertionError, match=r"\n  largest gap: x\[2\]: 6\.75 by differences, 6\.075 by the gradient$"):
        assert_gradient(cube, X, gradient=gradient)
    with pytest.raises(AssertionError, match="\n  direction .*\n(.*\n)*verdict: disagrees"):  # with the tables
        assert_gradient(cube, X, gradient=gradient, quick=False)


def test_the_point_is_not_changed_by_a_function_that_changes_its_argument():
    def square(u):
        u *= 2
        return u**2

    x = X.copy()
    with pytest.raises(AssertionError, match=r"^the vjp disagrees: f\(x\) changes x in place"):
        assert_gradient(square, x)
    np.testing.assert_array_equal(x, X)


def test_an_inconclusive_check_fails_unless_it_is_allowed():
    def loss(u):
        return np.sum(np.abs(u))

    with pytest.raises(AssertionError, match="^the gradient is inconclusive: along random 1: a kink: "):
        assert_gradient(loss, np.zeros(3), gradient=np.sign)
    result = assert_gradient(loss, np.zeros(3), gradient=np.sign, allow_inconclusive=True)
    assert result.verdict == "inconclusive"
    with pytest.raises(AssertionError, match="^the gradient disagrees"):  # a wrong one is not excused
        assert_gradient(loss, X, gradient=lambda u: 2 * np.sign(u), allow_inconclusive=True)


# ---- transposes ------------------------------------------------------------------------------------------------------


def test_transposes_of_operators_and_functions():
    matrix = np.arange(12.0).reshape(3, 4)
    assert assert_transpose(dp.gradient(dp.Grid((3, 4)), dp.dirichlet))
    assert assert_transpose(aslinearoperator(matrix))
    assert assert_transpose(lambda u: matrix @ u, lambda g: matrix.T @ g, shape=4)
    assert assert_transpose(np.fft.fft, np.fft.fft, shape=4)


def test_a_wrong_transpose_is_named_with_its_entries():
    """The message has the dtypes once, and the entries."""
    matrix = np.arange(12.0).reshape(3, 4)
    words = (
        r"^the transpose disagrees: <g, A u> and <A\^T g, u> differ by .* rounding errors, in float64, float32"
        r"\n  largest gap: every entry of x: the transpose is too large, by a factor of 1.001"
    )
    with pytest.raises(AssertionError, match=words):
        assert_transpose(lambda u: matrix @ u, lambda g: 1.001 * (matrix.T @ g), shape=4)
    wall = np.array([1.0, 1.0, 0.0, 1.0])
    with pytest.raises(AssertionError, match=r"\n  largest gap: x\[2\]: .* by differences, 0 by the transpose"):
        assert_transpose(lambda u: matrix @ u, lambda g: wall * (matrix.T @ g), shape=4)
    shift = np.eye(4) + np.eye(4, k=1)
    with pytest.raises(AssertionError, match="\n  culprit: it multiplies by the operator instead of its transpose"):
        assert_transpose(lambda u: shift @ u, lambda g: shift @ g, shape=4)


def test_a_transpose_for_real_numbers_only():
    """Code with buffers of real numbers discards imaginary parts."""

    def differences(u):
        buffer = np.empty(5)
        buffer[:] = u[1:] - u[:-1]
        return buffer

    def transposed(g):
        buffer = np.zeros(6)
        buffer[1:] += np.real(g)
        buffer[:-1] -= np.real(g)
        return buffer

    assert [row.ok for row in assert_transpose(differences, transposed, shape=6).rows] == [True, None, True, None]
    with pytest.raises(AssertionError, match="^the transpose disagrees: .* in float64, float32\n"):
        assert_transpose(differences, lambda g: -transposed(g), shape=6)
    with pytest.raises(AssertionError, match="\n  culprit: A is not linear: it does not map zeros to zeros$"):
        assert_transpose(lambda u: u + 1, lambda g: g, shape=3)


def test_a_transpose_of_another_shape_or_without_one():
    words = r"^the transpose disagrees: transpose\(g\) has shape \(3,\), expected \(4,\), the shape of u$"
    with pytest.raises(AssertionError, match=words):
        assert_transpose(np.diff, lambda g: g, shape=4)
    with pytest.raises(AssertionError, match="^the transpose disagrees: DerivativeError: operator has no transpose: "):
        assert_transpose(LinearOperator((3, 3), matvec=lambda u: u, dtype=float))


# ---- strategies ------------------------------------------------------------------------------------------------------


@hypothesis.settings(max_examples=10)
@hypothesis.given(grids(max_dimensions=2, max_cells=4, periodic=False), hypothesis.strategies.data())
def test_strategies_with_an_operator(grid, data):
    assert grid.periodic == (False,) * grid.dim and max(grid.shape) <= 4
    field = data.draw(fields(grid.cells, max_magnitude=3.0))
    assert field.shape == grid.shape and field.dtype == float and np.max(np.abs(field)) <= 3.0
    constant = dp.gradient(grid, dp.neumann)(np.ones(grid.shape))
    assert not np.any(constant)


@pytest.mark.whole
def test_simple_examples_come_first():
    assert hypothesis.find(grids(), lambda grid: True) == dp.Grid(1, size=1.0)
    assert not np.any(hypothesis.find(fields((2, 3)), lambda field: True))
    field = hypothesis.find(fields(4, complex), lambda field: np.any(field.imag))
    assert field.shape == (4,) and field.dtype == complex
