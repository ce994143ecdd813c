"""The messages of `sparsedp.testing`."""

import re
import sys

import numpy as np
import pytest

from sparsedp.errors import DerivativeError
from sparsedp.testing import assert_gradient, assert_transpose, fields, grids

X = np.linspace(1.0, 2.0, 5)
SLOPE = np.ones(5)


def total(u):
    return np.sum(u)


MESSAGES = [
    (
        lambda: assert_gradient(total, X, gradient=SLOPE, vjp=lambda u, g: g * SLOPE),
        TypeError,
        "one derivative is checked at a time, got gradient and vjp; write one call for each",
    ),
    (
        lambda: assert_gradient(total, X, vpj=lambda u, g: g * SLOPE),
        TypeError,
        "no check of a derivative has the argument 'vpj'; write 'vjp'",
    ),
    (
        lambda: assert_gradient(total, X, gradient=SLOPE, convention="adjoint"),
        TypeError,
        "check.gradient has no argument 'convention'; it takes steps, directions, rng",
    ),
    (
        lambda: assert_gradient(total, X, jacobian=SLOPE, stages=[total]),
        TypeError,
        "check.jacobian has no argument 'stages'; it takes directions, steps, rng, grid, noise, beside",
    ),
    (
        lambda: assert_gradient(np.float64, X),
        TypeError,
        "check.vjp takes a function or an object, got the class float64; write float64(...), or one of its functions",
    ),
    (
        lambda: assert_gradient(lambda u: np.sum(np.pad(u, 1)[2:] * u), X),
        DerivativeError,
        "f cannot be differentiated without gradient: its code is for NumPy arrays only; give a function gradient(x), "
        "or write f with autograd.numpy",
    ),
    (
        lambda: assert_gradient(total),
        TypeError,
        "check.vjp needs the point x at which the derivative is checked; write x=...",
    ),
    (
        lambda: assert_transpose(lambda u: u, lambda g: g),
        TypeError,
        "assert_transpose takes an Operator, a LinearOperator, or two functions and the shape of the argument; got "
        "function; write assert_transpose(apply, transpose, shape=u.shape)",
    ),
    (
        lambda: fields(3, np.int64),
        TypeError,
        "dtype of testing.fields must be a floating dtype, got int64; write float or complex",
    ),
    (
        lambda: fields(3, max_magnitude=0.0),
        ValueError,
        "max_magnitude of testing.fields must be > 0, got 0",
    ),
    (
        lambda: grids(max_dimensions=4),
        ValueError,
        "max_dimensions of testing.grids must be one of 1, 2, 3, got 4",
    ),
    (
        lambda: grids(max_cells=0),
        ValueError,
        "max_cells of testing.grids must be a whole number >= 1, got 0; the default is 6",
    ),
    (
        lambda: assert_gradient(total, lambda u, g: g, X),
        TypeError,
        "dp.testing.assert_gradient takes 2 arguments by position, got 3; "
        "write dp.testing.assert_gradient(f, x, vjp=vjp)",
    ),
    (
        lambda: assert_gradient(total, X, gradient=2 * SLOPE),
        AssertionError,
        "the gradient disagrees: along ",
    ),
    (
        lambda: assert_gradient(lambda u: np.sum(np.abs(u)), np.zeros(3), gradient=np.sign),
        AssertionError,
        "the gradient is inconclusive: along random 1: a kink: ",
    ),
]


@pytest.mark.parametrize("call, kind, message", MESSAGES)
def test_messages(call, kind, message):
    with pytest.raises(kind, match="^" + re.escape(message)):
        call()


@pytest.mark.parametrize("strategy", [grids, lambda: fields(3)])
def test_hypothesis_is_not_installed(strategy, monkeypatch):
    monkeypatch.setitem(sys.modules, "hypothesis", None)
    message = "dp.testing.grids and dp.testing.fields need hypothesis; pip install hypothesis"
    with pytest.raises(ImportError, match=message):
        strategy()
