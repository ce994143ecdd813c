"""Norms taken on the way, and elimination along an axis: against NumPy and dense algebra, compiled and not."""

import numpy as np
import pytest

from sparsedp import kernels
from sparsedp.kernels.reference import Tridiagonal
from sparsedp.solvers.scaling import norm, remainder
from sparsedp.solvers.separable import Elimination

NUMBA = pytest.mark.skipif(not kernels.compiled(), reason="numba is not installed")
SIZES = (0, 1, 4097, 40_000)


@pytest.mark.parametrize("size", SIZES)
def test_norms_of_the_fused_pass(size, rng):
    x, b = rng.standard_normal((2, size))
    fresh = x - 0.3
    rest = fresh.copy()
    assert np.allclose(remainder(b, rest, x), (np.linalg.norm(b - fresh), np.linalg.norm(x)))
    assert np.array_equal(rest, b - fresh)
    z = x + 1j * b
    rest = b + 1j * x
    assert np.isclose(norm(z), np.linalg.norm(z))
    assert np.allclose(remainder(z, rest, z), (np.linalg.norm(z - (b + 1j * x)), np.linalg.norm(z)))


def test_nonfinite_values_propagate():
    for value in (np.nan, np.inf):
        x = np.zeros(40_000)
        x[20_000] = value
        assert not np.isfinite(norm(x))
    assert norm(np.full(9, 1e200)) == np.inf


def bands(rng, n, uniform):
    """Off-diagonal entries of one sign, rows that sum to 0: (Tridiagonal, dense matrix)."""
    lower, upper = (np.ones((2, n)) if uniform else rng.uniform(0.5, 2.0, (2, n))) * -1.0
    lower[0] = upper[-1] = 0.0
    dense = np.diag(-lower - upper) + np.diag(lower[1:], -1) + np.diag(upper[:-1], 1)
    return Tridiagonal(lower, -lower - upper, upper), dense


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=NUMBA)])
@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize("n", [3, 4, 50])
def test_elimination_solves_every_mode(n, transposed, compiled, rng, monkeypatch):
    monkeypatch.setattr(kernels, "compiled", lambda: compiled)
    for uniform in (True, False):
        line, dense = bands(rng, n, uniform)
        modes = np.array([1e-9, 0.3, 7.0, 1e4] * 10)
        b = rng.standard_normal((n, modes.size))
        x = b.copy()
        Elimination(line, np.zeros(n), modes, 1.0).solve(x, transposed)
        for j, mode in enumerate(modes):
            matrix = (dense.T if transposed else dense) + mode * np.eye(n)
            rest = np.abs(matrix @ x[:, j] - b[:, j])
            assert np.max(rest) <= 1e-14 * n * (1 + np.max(np.abs(matrix)) * np.max(np.abs(x[:, j])))


def test_a_singular_mode_is_solved_up_to_its_null_vector(rng):
    line, dense = bands(rng, 40, True)
    b = rng.standard_normal((40, 16))
    b = b - b.mean(axis=0)
    x = b.copy()
    Elimination(line, np.zeros(40), np.zeros(16), 1.0).solve(x, False)
    assert np.max(np.abs(dense @ x - b)) <= 1e-12 * np.max(np.abs(x))
