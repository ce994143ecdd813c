"""The messages of `check.vjp`, `check.jvp`, `check.jacobian` and `check.hessian`: what is wrong, and what to write."""

import re

import numpy as np
import pytest
from scipy.sparse.linalg import LinearOperator

import sparsedp as dp

VJP = dp.check.vjp
X = np.linspace(1.0, 2.0, 5)
BROKEN = LinearOperator((5, 5), matvec=lambda u: 2 * u, dtype=float)  # without rmatvec


def cube(u):
    return u**3


def cube_vjp(u, g):
    return 3 * u**2 * g


def total(u):
    return np.sum(u**3)


def list_vjp(u, g):
    return 3 * np.asarray(u) ** 2 * g


def listed(u):
    return np.asarray(u) ** 3


def loop(u):
    values = np.zeros(5)
    for i in range(5):
        values[i] = u[i] ** 2
    return values


def gathered(u):
    """NumPy stores the traced numbers of this function in an array of objects."""
    return np.array([value**2 for value in u])


class Model:
    def apply(self, x):
        return x**3

    def vjp(self, x, g):
        return 3 * x**2 * g


class Rateless:
    vjp = staticmethod(cube_vjp)


MESSAGES = [
    (
        lambda: VJP(cube, cube_vjp, X, grid=3),
        TypeError,
        "grid takes a Grid, a Space, or a list of them, got int; write grid=dp.Grid(...)",
    ),
    (
        lambda: VJP(cube, cube_vjp),
        TypeError,
        "check.vjp needs the point x at which the derivative is checked; write x=...",
    ),
    (
        lambda: dp.check.hessian(total, np.eye(5), None),
        TypeError,
        "check.hessian needs the point x at which the derivative is checked; write x=...",
    ),
    (
        lambda: VJP(Model, x=X),
        TypeError,
        "check.vjp takes a function or an object, got the class Model; write Model(...), or one of its functions",
    ),
    (
        lambda: VJP(Rateless(), x=X),
        TypeError,
        "check.vjp takes a function, got Rateless; write dp.check.vjp(f, x=x) with a function or an object with apply "
        "and vjp",
    ),
    (
        lambda: VJP(BROKEN),
        dp.errors.DerivativeError,
        "the LinearOperator has no rmatvec, the product with its conjugate transpose; write LinearOperator(shape, "
        "matvec=..., rmatvec=...)",
    ),
    (
        lambda: dp.check.jacobian(lambda u: 2 * u, BROKEN, X),
        dp.errors.DerivativeError,
        "the LinearOperator has no rmatvec, the product with its conjugate transpose; write LinearOperator(shape, "
        "matvec=..., rmatvec=...)",
    ),
    (
        lambda: VJP(cube, cube_vjp, [1.0, 2.0]),
        TypeError,
        "unsupported operand type(s) for ** or pow(): 'list' and 'int'; write np.asarray(x) for an array: a list is a "
        "tree of numbers",
    ),
    (
        lambda: VJP(listed, list_vjp, [1.0, 2.0]),
        TypeError,
        "vjp(x, g) returns an array, but x is a list of numbers; write x=np.asarray(x), or return a list",
    ),
    (
        lambda: VJP(lambda u: dp.Grid(3), cube_vjp, X),
        TypeError,
        "f(x) must be an array or a tree of arrays, got Grid; return arrays of numbers",
    ),
    (
        lambda: VJP(lambda u: np.array([None, 1.0]), cube_vjp, X),
        TypeError,
        "f(x) must be an array or a tree of arrays, got an array of objects; return arrays of numbers",
    ),
    (
        lambda: VJP(loop, x=X),
        dp.errors.DerivativeError,
        "f cannot be differentiated without vjp: its code is for NumPy arrays only; give a function vjp(x, g), "
        "or write f with autograd.numpy",
    ),
    (
        lambda: VJP(gathered, x=X),
        dp.errors.DerivativeError,
        "f cannot be differentiated without vjp: its code is for NumPy arrays only; give a function vjp(x, g), "
        "or write f with autograd.numpy",
    ),
    (
        lambda: dp.check.jvp(gathered, x=X),
        dp.errors.DerivativeError,
        "f cannot be differentiated without jvp: its code is for NumPy arrays only; give a function jvp(x, t), "
        "or write f with autograd.numpy",
    ),
    (
        lambda: VJP(cube_vjp, cube_vjp, (X, X)),
        TypeError,
        "cube_vjp() missing 1 required positional argument: 'g'; write lambda x: f(*x), because f(x) is called with "
        "the whole tuple",
    ),
    (
        lambda: VJP(None, x=X, stages=cube),
        TypeError,
        "stages takes a list of stages, got function; write stages=[(f, vjp)]",
    ),
    (
        lambda: dp.check.hessian(lambda u: abs(u), 1.0, 1j),
        TypeError,
        "check.hessian takes real x, got complex numbers; split them into real and imaginary parts",
    ),
    (
        lambda: dp.check.hessian(cube, lambda u, v: v, X),
        ValueError,
        "check.hessian needs a loss f(x) with one value, got several; give gradient=f instead",
    ),
    (
        lambda: dp.check.jacobian(cube, "J", X),
        TypeError,
        "the Jacobian takes an array, a sparse matrix, an operator, or a function of x that returns one, got str; "
        "write an array with one column for each entry of x",
    ),
    (
        lambda: VJP(cube, cube_vjp, X, steps=1e-3),
        ValueError,
        "a sweep needs at least 8 different positive steps, got 0.001; omit steps, or write "
        "steps=np.logspace(-1, -8, 8)",
    ),
    (
        lambda: VJP(cube, cube_vjp, X, steps="small"),
        ValueError,
        "a sweep needs at least 8 different positive steps, got 'small'; omit steps, or write "
        "steps=np.logspace(-1, -8, 8)",
    ),
    (
        lambda: dp.check.gradient(total, X, steps=[-0.1] * 9),
        ValueError,
        "a sweep needs at least 8 different positive steps, got [-0.1, -0.1, -0.1, -0.1, -0.1, -0.1, -0.1, -0.1, -0.1]"
        "; omit steps, or write steps=np.logspace(-1, -8, 8)",
    ),
]


@pytest.mark.parametrize("call, kind, message", MESSAGES)
def test_messages(call, kind, message):
    with pytest.raises(kind, match="^" + re.escape(message) + "$"):
        call()


def test_a_rule_with_a_wrong_derivative_keeps_its_message():
    rule = dp.differentiable("half", lambda u: u / 2, lambda nums, ans, u: lambda g: (g[:2],))
    words = r"^half returned a derivative of shape \(2,\) where \(5,\) is needed"
    with pytest.raises(dp.errors.ShapeError, match=words):
        VJP(rule, x=X)


@pytest.mark.whole
def test_a_module_of_another_dtype():
    torch = pytest.importorskip("torch")
    words = (
        r"^f does not take x of dtype float32 and float64: .* must have the same dtype, but got .*; "
        r"convert x by x.float\(\), or f by f.double\(\)$"
    )
    with pytest.raises(TypeError, match=words):
        VJP(torch.nn.Linear(5, 2), x=X)
    assert VJP(torch.nn.Linear(5, 2), x=X.astype(np.float32))


REASONS = [
    (
        lambda: dp.check.jacobian(cube, np.eye(4), X),
        "the Jacobian has shape (4, 4), expected (5, 5); write one row for each entry of f(x), and one column for each "
        "entry of x",
    ),
    (
        lambda: dp.check.hessian(total, np.eye(4), X),
        "the Hessian has shape (4, 4), expected (5, 5); write one row for each entry of x, and one column for each "
        "entry of x",
    ),
    (
        lambda: VJP(cube, lambda u, g: cube_vjp(u, g) * (1 + 1e-3j), X),
        "vjp(x, g): expected real numbers, got imaginary parts of up to ",
    ),
    (
        lambda: dp.check.jacobian(np.sin, np.diag(np.cos(X)) * (1 + 1e-3j), X),
        "the product of the Jacobian with t: expected real numbers, got imaginary parts of up to ",
    ),
    (
        lambda: VJP(cube, lambda u, g: cube_vjp(u, g)[:, None], X),
        "vjp(x, g): expected shape (5,), got (5, 1); return a tree like x",
    ),
]


@pytest.mark.parametrize("call, reason", REASONS)
def test_reasons(call, reason):
    result = call()
    assert result.verdict == "disagrees" and result.reason.startswith(reason), result.reason


def test_traced_numbers_in_an_array():
    from sparsedp.check.programs import NUMPY

    for derivative in (NUMPY.vjp, NUMPY.jvp):
        with pytest.raises(TypeError, match="^NumPy has stored traced numbers in an array$"):
            derivative(gathered, X, X)


def test_imaginary_parts_name_the_remedy():
    from sparsedp.check.programs import real_part
    from sparsedp.errors import ShapeError

    words = r"^g: expected real numbers, got imaginary parts of up to 2.0e\+00; return the real part$"
    with pytest.raises(ShapeError, match=words):
        real_part("g", np.array([1.0, 2j]))


# ---- cotangents in forms that other libraries return ---------------------------------------------------------------


def blur(u):
    return np.fft.ifft(np.fft.fft(u) * SYMBOL).real


def blur_vjp(u, g):
    """Return the adjoint without `.real`: its imaginary parts are rounding errors."""
    return np.fft.ifft(np.fft.fft(g) * np.conj(SYMBOL))


SYMBOL = np.exp(-0.3j * np.fft.fftfreq(5, 0.2))


def test_complex_cotangents_with_imaginary_parts_of_rounding_errors():
    assert np.iscomplexobj(blur_vjp(X, X)) and VJP(blur, blur_vjp, X)
    assert dp.check.jvp(blur, lambda u, t: np.fft.ifft(np.fft.fft(t) * SYMBOL), X)


def test_a_tuple_with_one_cotangent():
    """JAX and autograd return a tuple with one entry for each argument."""
    assert VJP(cube, lambda u, g: (cube_vjp(u, g),), X)
    assert VJP(cube, lambda u, g: [1.001 * cube_vjp(u, g)], X).verdict == "disagrees"


def test_the_dtype_of_a_cotangent_is_named():
    result = VJP(cube, lambda u, g: cube_vjp(u, g).astype(np.float32), X)
    assert result.verdict == "disagrees" and result.culprit == "vjp(x, g) returns float32, but x has float64"
    single = X.astype(np.float32)
    assert VJP(cube, lambda u, g: cube_vjp(u, g).astype(np.float32), single).culprit is None


# ---- exceptions at trial points ------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [ValueError, RuntimeError, ZeroDivisionError])
def test_exceptions_at_trial_points(error):
    """The solvers of SciPy raise RuntimeError if they do not converge. Other exceptions are mistakes."""

    def near(u):
        if np.max(np.abs(u - X)) > 0.01:
            raise error("no convergence")
        return u**3

    assert VJP(near, cube_vjp, X)
    with pytest.raises(error, match="^no convergence$"):
        VJP(near, cube_vjp, X + 1)


def test_other_exceptions_end_the_check():
    def near(u):
        if np.max(np.abs(u - X)) > 0.01:
            raise KeyError("table")
        return u**3

    with pytest.raises(KeyError, match="^'table'$"):
        VJP(near, cube_vjp, X)
