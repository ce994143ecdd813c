"""What `ensemble` refuses: each message, whole."""

import autograd.numpy as np
import pytest

import sparsedp as dp


@pytest.mark.parametrize(
    "call, error, message",
    [
        (lambda: dp.ensemble(1.0, [1]), TypeError, "ensemble takes a function, got float; write lambda x, scene: ..."),
        (lambda: dp.ensemble(np.add, []), ValueError, "ensemble needs a scene, got none"),
        (lambda: dp.ensemble(np.add, [1])(1.0, []), ValueError, "ensemble needs a scene, got none"),
        (
            lambda: dp.ensemble(np.add, [1], 2),
            TypeError,
            r"ensemble takes an executor, got int; write concurrent.futures.ProcessPoolExecutor\(2\)",
        ),
        (
            lambda: dp.ensemble(np.add, [1], chunk=0),
            ValueError,
            "chunk of ensemble must be a whole number >= 1, got 0; the default is 1",
        ),
        (
            lambda: dp.ensemble(np.add, [1], chunk=1.5),
            ValueError,
            "chunk of ensemble must be a whole number >= 1, got 1.5; the default is 1",
        ),
        (
            lambda: dp.ensemble(np.add, [1], weights=[1, 2]),
            dp.errors.ShapeError,
            r"weights of ensemble must have shape \(1,\), got \(2,\); give one number for each scene",
        ),
        (
            lambda: dp.ensemble(np.add, [1, 2], weights=[1, np.nan]),
            dp.errors.NonFiniteError,
            r"weights must be finite, got 1 that are NaN or infinite, the first at 1",
        ),
        (lambda: dp.ensemble(np.add, [1, 2])(1.0, [0, 2]), IndexError, "ensemble has scenes 0 to 1, got 2"),
        (lambda: dp.ensemble(np.add, [1, 2])(1.0, [-1]), IndexError, "ensemble has scenes 0 to 1, got -1"),
        (
            lambda: dp.ensemble(np.add, [np.ones(2)])(1.0),
            dp.errors.ShapeError,
            r"scene 0 of 1: the loss must be a scalar, got an array of shape \(2,\); sum it",
        ),
        (
            lambda: dp.ensemble(np.add, [1j])(1.0),
            dp.errors.DerivativeError,
            "scene 0 of 1: the loss must be real, got a complex number; take its real part or its absolute value",
        ),
    ],
)
def test_errors_of_ensembles(call, error, message):
    with pytest.raises(error, match=f"^{message}$"):
        call()


def test_an_error_that_has_no_words():
    with pytest.raises(RuntimeError, match="scene 0 of 1 raised KeyError: 1.0"):
        dp.ensemble(lambda x, scene: {}[x], [1])(1.0)
