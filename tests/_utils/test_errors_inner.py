"""Every message of the inner rooms (tape, structures, functions of separable operators), printed once."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.derivative import pullback, pushforward, value_and_grad
from sparsedp.operators.structure.base import Structure, compact

LINE = dp.Grid(3)
SHAPE = dp.errors.ShapeError
TYPE = TypeError
VALUE = ValueError
FINITE = dp.errors.NonFiniteError
DERIVATIVE = dp.errors.DerivativeError


def wrong(pulled):
    """A rule whose pullback is `pulled`, in use."""
    bad = dp.differentiable("bad", lambda x: x * 1.0, lambda nums, ans, x: pulled)
    return lambda: value_and_grad(lambda x: anp.sum(bad(x)))(np.ones(2))


class Mute(Structure):
    """A structure that says nothing."""

    shape = (3, 3)


class Crowd:
    """As many entries as no 32-bit index can count."""

    nnz = 2**31
    shape = (3, 3)


MUTE = dp.Operator(Mute(), LINE.cells, LINE.cells, "mute", "matrix-free")

TABLE = [
    # structures
    (lambda: MUTE(np.ones(3)), TYPE, "Mute does not say how it acts"),
    (lambda: MUTE.T, TYPE, "Mute has no transpose"),
    (
        lambda: compact(Crowd()),
        VALUE,
        "an explicit matrix of 2147483648 entries needs 64-bit indices; use the matrix-free form",
    ),
    (
        lambda: dp.set_threads(1.5),
        TYPE,
        "set_threads got 1.5; it needs an integer, for example 1, or None for the default",
    ),
    (
        lambda: value_and_grad(lambda x: np.sum(x, where=np.array([True, False])))(np.ones(2)),
        DERIVATIVE,
        "autograd's derivative of sum does not know where= and initial=; choose entries by x[mask] or "
        "anp.where(mask, x, 0.0), and add the initial value to the result",
    ),
    # functions of separable operators
    (
        lambda: dp.inverse(dp.from_matrix(np.eye(3)), "separable"),
        VALUE,
        "separable needs a sum of 1-D factors that can be diagonalised, got <matrix: space(3) -> space(3), explicit>",
    ),
    (
        lambda: dp.matrix_exponential(dp.laplacian(LINE), np.nan),
        FINITE,
        "time of matrix_exponential must be finite, got nan",
    ),
    (
        lambda: dp.matrix_exponential(-dp.laplacian(LINE), 1e4),
        FINITE,
        "exp(10000 * -laplacian) must be finite at the eigenvalues, got 2 that are NaN or infinite, the first "
        "at 1; take a shorter time or the other sign",
    ),
    (
        lambda: dp.matrix_exponential(dp.gradient(LINE)),
        VALUE,
        "matrix_exponential needs a separable operator that can be diagonalised, "
        "got <gradient: cells(3) -> faces(3), explicit>",
    ),
    (lambda: dp.matrix_power(dp.laplacian(LINE), np.inf), FINITE, "exponent of matrix_power must be finite, got inf"),
    (
        lambda: dp.matrix_power(dp.laplacian(LINE), 0.5),
        VALUE,
        "laplacian has eigenvalues down to -3.0e+00; a fractional power needs them >= 0",
    ),
    (
        lambda: dp.matrix_power(-dp.laplacian(LINE), 1000),
        FINITE,
        "(-laplacian)^1000 must be finite at the eigenvalues, got 1 that are NaN or infinite, the first at 2; "
        "rescale the operator",
    ),
    # the tape
    (wrong(lambda g: (g[:1],)), SHAPE, "bad returned a derivative of shape (1,) where (2,) is needed"),
    (
        wrong(lambda g: (g * 1j,)),
        DERIVATIVE,
        "bad returned a complex derivative of a real value; take its real part",
    ),
    (
        wrong(lambda g: (g, g)),
        DERIVATIVE,
        "bad must return one derivative for each of the 1 values asked for, got 2; return a tuple",
    ),
    (
        wrong(lambda g: g),
        DERIVATIVE,
        "bad must return one derivative for each of the 1 values asked for, got ndarray; return a tuple",
    ),
    (
        wrong(lambda g: (g.astype(np.float32),)),
        DERIVATIVE,
        "bad returned a derivative of dtype float32 where float64 is needed",
    ),
    (
        wrong(lambda g: (g.astype(int),)),
        DERIVATIVE,
        "bad returned a derivative of dtype int64 where float64 is needed",
    ),
    (
        lambda: value_and_grad(lambda x: 1.0)(np.ones(2, dtype=int)),
        DERIVATIVE,
        "a gradient needs floating values, got int64; write np.asarray(x, float)",
    ),
    (
        lambda: value_and_grad(lambda x: x)(np.ones(2)),
        SHAPE,
        "the loss must be a scalar, got an array of shape (2,); sum it",
    ),
    (
        lambda: value_and_grad(anp.sum)(np.ones(2, complex)),
        DERIVATIVE,
        "the loss must be real, got a complex number; take its real part or its absolute value",
    ),
    (
        lambda: pullback(lambda x: (x, x), np.ones(2)),
        DERIVATIVE,
        "the function must return one array or number, got tuple; sum or join it",
    ),
    (
        lambda: value_and_grad(lambda x: None)(np.ones(2)),
        DERIVATIVE,
        "the function must return one array or number, got NoneType; sum or join it",
    ),
    (
        lambda: pullback(lambda x: 2 * x, np.ones(3))[1](np.ones(2)),
        SHAPE,
        "the cotangent must have shape (3,), got (2,); give one like the value",
    ),
    (
        lambda: pushforward(lambda x: x[0] * x[1], (1.0, 2.0), (1.0,)),
        SHAPE,
        "tangent: expected a tuple of length 2, got a tuple of length 1; give a tangent like x",
    ),
    (
        lambda: pushforward(lambda x: x["a"] * x["b"], {"a": 1.0, "b": 2.0}, [1.0, 2.0]),
        SHAPE,
        "tangent: expected a dict of a, b, got a list of length 2; give a tangent like x",
    ),
    (
        lambda: pushforward(lambda x: 2 * x, np.ones(3), np.ones(2)),
        SHAPE,
        "tangent: expected an array of shape (3,), got an array of shape (2,); give a tangent like x",
    ),
    (
        lambda: pushforward(lambda x: 2 * x, 1.0, None),
        SHAPE,
        "tangent: expected an array of shape (), got NoneType; give a tangent like x",
    ),
]


@pytest.mark.parametrize(("call", "error", "message"), TABLE, ids=[row[2][:50] for row in TABLE])
def test_message(call, error, message):
    with pytest.raises(error) as caught:
        call()
    assert str(caught.value) == message
    assert caught.type is error or error in (TYPE, VALUE, AttributeError)


def test_tangents_of_dicts_are_paired_by_name():
    assert pushforward(lambda x: x["a"] - x["b"], {"a": 1.0, "b": 1.0}, {"b": 1.0, "a": 5.0})[1] == 4.0


def test_forces_and_walls_of_another_shape_are_refused():
    grid = dp.Grid((2, 2))
    rest = np.zeros(12)
    with pytest.raises(TypeError, match="flow_step takes a function, got str; write force=lambda v, params: ..."):
        dp.flow_step(grid, 0.1, force="up")
    with pytest.raises(
        dp.errors.ShapeError,
        match="flow_step, as force, takes a "
        r"field on faces\(2, 2\) of shape \(12,\), got an array of shape \(2, 2\); join its components with grid\.join",
    ):
        dp.flow_step(grid, 0.1, force=lambda v, params: np.ones((2, 2))).start(rest)
    with pytest.raises(
        dp.errors.ShapeError,
        match="flow_step, as walls, takes a "
        r"field on faces\(2, 2\) of shape \(12,\), got an array of shape \(3,\); "
        r"write walls=lambda params: values, or face_lift\(grid, boundary\)\(values\)",
    ):
        dp.flow_step(grid, 0.1, walls=np.zeros(3))
    by_number, by_field = (dp.flow_step(grid, 0.1, force=lambda v, g: g).start(rest, g) for g in (1.0, np.ones(12)))
    assert np.array_equal(by_number["a"], by_field["a"])
