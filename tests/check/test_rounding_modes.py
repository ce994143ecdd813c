"""Rounding errors that other rounding modes of the processor show, and derivatives of ill-conditioned solves."""

import numpy as np
import pytest
import scipy.linalg

import sparsedp as dp
from sparsedp.check.rounding_modes import _available_modes, rounding_error

needs_modes = pytest.mark.skipif(not _available_modes(), reason="this computer has no other rounding modes")
B = np.cos(1.0 + np.arange(12.0))


def graded(decades):
    """Return a nonsymmetric matrix with singular values of 1 to 10^-decades."""
    rng = np.random.default_rng(5)
    left, _ = np.linalg.qr(rng.normal(size=(12, 12)))
    right, _ = np.linalg.qr(rng.normal(size=(12, 12)))
    return left * np.logspace(0.0, -decades, 12) @ right


MATRICES = {
    "Hilbert": scipy.linalg.hilbert(12),
    "Vandermonde": np.vander(np.linspace(1.0, 2.0, 12)),
    "graded": graded(13),
}


def check(A, transposed=True, factor=1.0, **options):
    matrix = A.T if transposed else A
    return dp.check.vjp(lambda b: np.linalg.solve(A, b), lambda b, g: factor * np.linalg.solve(matrix, g), B, **options)


@needs_modes
def test_the_rounding_error_of_a_number():
    ones = np.full(1000, 0.1)
    error = rounding_error(lambda: float(np.cumsum(ones)[-1]))
    assert 1e-14 < error < 1e-11
    assert rounding_error(lambda: float(np.sum(np.ones(1000)))) == 0.0
    A = MATRICES["Hilbert"]
    assert rounding_error(lambda: np.linalg.solve(A, A @ np.ones(12))[5]) > 1e-4


@needs_modes
def test_the_usual_rounding_mode_returns():
    tenth = np.array([1.0, -1.0]) / 10.0
    runs = []

    def interrupted():
        if np.divide(1.0, 10.0) + np.divide(-1.0, 10.0) or runs:  # in another mode
            raise KeyboardInterrupt
        runs.append(1)
        return 0.0

    with pytest.raises(KeyboardInterrupt):
        rounding_error(interrupted)
    np.testing.assert_array_equal(np.array([1.0, -1.0]) / 10.0, tenth)


def is_rounded_in_another_way():
    return bool(np.any(np.array([1.0, -1.0]) / 10.0 != np.array([0.1, -0.1])))


def nan_elsewhere(x):
    """Return NaN in other rounding modes."""
    if is_rounded_in_another_way():
        return x * np.nan
    return x


def exception_elsewhere(x):
    """Raise an exception in other rounding modes, as a solver that does not converge there."""
    if is_rounded_in_another_way():
        raise AssertionError("not converged")
    return x


@needs_modes
@pytest.mark.parametrize("elsewhere", [nan_elsewhere, exception_elsewhere])
def test_programs_that_work_in_the_usual_mode_only(elsewhere):
    """Their rounding errors have no bound: a gap of f, of vjp beside jvp, or of symmetry shows nothing."""
    assert rounding_error(lambda: elsewhere(1.0)) == np.inf
    f = lambda x: elsewhere(x**2)
    result = dp.check.vjp(f, lambda x, g: 2.2 * x * g, B, rng=0)
    assert result.verdict == "inconclusive" and "in another rounding mode the program fails" in result.reason
    # A derivative that is at fault alone.
    wrong = dp.check.vjp(lambda x: x**2, lambda x, g: elsewhere(2.2 * x * g), B, rng=0)
    assert wrong.verdict == "disagrees", wrong
    # The identities are tested after the differences, which agree here.
    jvp = lambda x, t: elsewhere(2.2 * x * t)
    both = dp.check.vjp(lambda x: x**2, lambda x, g: 2 * x * g, B, jvp=jvp, rng=0)
    assert both.verdict == "inconclusive" and "vjp is not the transpose of jvp" in both.reason, both
    skewed = np.eye(12)
    skewed[0, 1] = 1e-3
    gradient = lambda x: skewed @ x
    hessian = dp.check.hessian(gradient, lambda x, v: elsewhere(skewed @ v), B, gradient=gradient, rng=0)
    assert hessian.verdict == "inconclusive" and "the Hessian is not symmetric" in hessian.reason, hessian
    plain = dp.check.hessian(gradient, lambda x, v: skewed @ v, B, gradient=gradient, rng=0)
    assert plain.verdict == "disagrees" and "the Hessian is not symmetric" in plain.reason, plain


@needs_modes
def test_modes_in_which_functions_of_single_precision_are_wrong():
    """The sine of NumPy may assume the usual mode: its errors in others are no rounding errors of a program."""
    angles = np.linspace(1.0, 30.0, 30, dtype=np.float32)
    assert rounding_error(lambda: float(np.sin(angles) @ np.ones(30, np.float32)), single=True) < 1e-4
    wrong = dp.check.vjp(np.sin, lambda x, g: np.float32(1.003) * np.cos(x) * g, angles, rng=0)
    assert "another rounding mode" not in wrong.reason, wrong


@needs_modes
@pytest.mark.parametrize("name", MATRICES)
def test_right_derivatives_of_ill_conditioned_solves_are_no_error(name):
    """The error of a factorization is the same at all points, so that differences show it as a smooth gap."""
    result = check(MATRICES[name])
    assert result.verdict == "inconclusive" and "f amplifies rounding errors" in result.reason, result
    A = MATRICES[name]
    both = check(A, jvp=lambda b, t: np.linalg.solve(A, t))
    assert both.verdict == "inconclusive" and "amplifies rounding errors" in both.reason, both


@needs_modes
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.whole)])
def test_a_stage_with_an_ill_conditioned_matrix(seed):
    """Here the gap along the last direction is visible after extrapolation only."""
    A = MATRICES["Hilbert"]
    x = np.random.default_rng(0).normal(size=12)
    for factor, verdict in ((1.0, "inconclusive"), (2.0, "disagrees")):
        stages = [
            (np.sin, lambda u, g, factor=factor: factor * np.cos(u) * g),
            (lambda b: np.linalg.solve(A, b), lambda b, g: np.linalg.solve(A.T, g)),
        ]
        assert dp.check.vjp(None, x=x, stages=stages, rng=seed).verdict == verdict


@needs_modes
def test_a_staircase_of_rounding_errors():
    """With partial pivoting the entries of this matrix grow to 2^39, and the last digits of x are lost."""
    A = np.eye(40) - np.tril(np.ones((40, 40)), -1)
    A[:, -1] = 1.0
    x = np.random.default_rng(11).normal(size=40)
    result = dp.check.vjp(lambda b: np.linalg.solve(A, b), lambda b, g: np.linalg.solve(A.T, g), x, rng=0)
    assert result.verdict == "inconclusive", result


@pytest.mark.parametrize("wrong", [{"factor": 1.1}, {"transposed": False}])
def test_wrong_derivatives_of_ill_conditioned_solves_disagree(wrong):
    assert check(graded(12), **wrong).verdict == "disagrees"
