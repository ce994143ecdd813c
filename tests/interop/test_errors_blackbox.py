"""Errors of functions of `from_blackbox`: each message, whole."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.errors import DerivativeError, NonFiniteError, ShapeError

CALLS = {"n": 0}


def drifting(x):
    CALLS["n"] += 1
    return x + 1e-3 * CALLS["n"]


def first(f, x=(1.0, 2.0), **options):
    """The first derivative of an adopted function."""
    return lambda: dp.value_and_grad(lambda x: anp.sum(dp.from_blackbox(f, **options)(x)))(np.array(x))


def other_shape():
    f = dp.from_blackbox(np.sin)
    f.jacobian(np.ones(2)), f.jacobian(np.ones(3))


def second():
    f = dp.from_blackbox(np.sin)
    slope = lambda x: anp.sum(dp.value_and_grad(lambda y: anp.sum(f(y) ** 2))(x)[1])
    return dp.value_and_grad(slope)(np.ones(2))


WRONG = [
    (
        lambda: dp.from_blackbox(3.0),
        TypeError,
        r"from_blackbox takes a function, got float; write dp.from_blackbox\(lambda x: ...\)",
    ),
    (first(np.sin, derivative="exact"), ValueError, "derivative must be one of auto, complex, difference, got 'exact'"),
    (first(drifting), DerivativeError, "drifting gives two results for one argument; fix its random state first"),
    (first(np.sin, sparsity=np.eye(3)), ShapeError, r"the sparsity of sin must have shape \(2, 2\), got \(3, 3\)"),
    (
        first(lambda x: x * x[::-1], sparsity=np.eye(2), name="swap"),
        DerivativeError,
        "row 0 of the Jacobian of swap by complex step does not agree with a difference along a random direction; its "
        "sparsity lacks entries, or it has a kink at x: leave sparsity and derivative out, or move x a little",
    ),
    (first(np.sin, (np.nan, 1.0)), NonFiniteError, "the argument of sin must be finite, got 1 that are NaN"),
    (first(lambda x: x / 0.0, name="f"), NonFiniteError, "f near x must be finite to be differentiated, got 2"),
    (
        first(np.sqrt, (0.0, 1.0), derivative="difference"),
        NonFiniteError,
        "the differences of sqrt near x must be finite, got .*; move x a little",
    ),
    (
        first(lambda x: x * 1j, name="turn"),
        TypeError,
        "turn must return real numbers, got dtype complex128; take the real part",
    ),
    (
        other_shape,
        ShapeError,
        r"sin maps \(2,\) to \(2,\), got \(3,\) to \(3,\); call from_blackbox again for other shapes",
    ),
    (
        second,
        DerivativeError,
        "sin is a black box without second derivatives; use a method with first derivatives, or write the function "
        "with autograd.numpy",
    ),
]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("call, error, message", WRONG)
def test_errors_of_adopted_code(call, error, message):
    with np.errstate(all="ignore"), pytest.raises(error, match="^" + message):
        call()
