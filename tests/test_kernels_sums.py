"""Fused sums and elimination along an axis: against NumPy and dense algebra, compiled and not."""

import numpy as np
import pytest

from sparsedp import kernels
from sparsedp.kernels import team
from sparsedp.kernels.reference import Tridiagonal
from sparsedp.solvers.separable import Sweep

NUMBA = pytest.mark.skipif(not kernels.compiled(), reason="numba is not installed")
SIZES = (0, 1, 4097, 40_000)


@pytest.mark.parametrize("size", SIZES)
def test_sums_on_the_way(size, rng):
    x, b = rng.standard_normal((2, size))
    total, square = kernels.totals(x)
    assert np.isclose(total, x.sum(), atol=1e-10) and np.isclose(square, x @ x) and kernels.squares(x) == square
    fresh, same = np.empty(size), x.copy()
    assert np.isclose(kernels.lowered(x, 0.3, fresh), fresh @ fresh) and np.array_equal(fresh, x - 0.3)
    assert np.isclose(kernels.lowered(same, 0.3, same), fresh @ fresh) and np.array_equal(same, fresh)
    rest = fresh.copy()
    assert np.allclose(kernels.remainder(b, rest, x), (x @ x, rest @ rest)) and np.array_equal(rest, b - fresh)


def test_what_is_not_finite_stays_so():
    x = np.zeros(40_000)
    x[20_000] = np.nan
    assert np.isnan(kernels.squares(x))
    x[20_000] = -np.inf
    assert kernels.totals(x) == (-np.inf, np.inf)


@NUMBA
def test_compiled_sums_do_not_depend_on_the_threads(rng, monkeypatch):
    monkeypatch.setattr(team, "SERIAL", 0)
    x, found = rng.standard_normal(70_001), []
    for threads in (1, None):
        kernels.set_threads(threads)
        found.append(kernels.totals(x))
    assert found[0] == found[1] and np.allclose(found[0], (x.sum(), x @ x), rtol=1e-12)


def bands(rng, n, periodic, uniform):
    """Off-diagonal entries of one sign, rows that sum to 0: (Tridiagonal, dense matrix)."""
    lower, upper = (np.ones((2, n)) if uniform else rng.uniform(0.5, 2.0, (2, n))) * -1.0
    if not periodic:
        lower[0] = upper[-1] = 0.0
    dense, i = np.diag(-lower - upper), np.arange(n)
    np.add.at(dense, (i, i - 1), lower)
    np.add.at(dense, (i, (i + 1) % n), upper)
    return Tridiagonal(lower, -lower - upper, upper), dense


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=NUMBA)])
@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("n", [3, 4, 50])
def test_elimination_solves_every_mode(n, periodic, transposed, compiled, rng, monkeypatch):
    monkeypatch.setattr(kernels, "compiled", lambda: compiled)
    for uniform in (True, False):
        line, dense = bands(rng, n, periodic, uniform)
        modes = np.array([1e-9, 0.3, 7.0, 1e4] * 10)
        b = rng.standard_normal((n, modes.size))
        Sweep(line, np.zeros(n), modes, 1.0).solve(x := b.copy(), transposed)
        for j, mode in enumerate(modes):
            matrix = (dense.T if transposed else dense) + mode * np.eye(n)
            rest = np.abs(matrix @ x[:, j] - b[:, j])
            assert np.max(rest) <= 1e-14 * n * (1 + np.max(np.abs(matrix)) * np.max(np.abs(x[:, j])))


def test_a_singular_mode_is_solved_up_to_its_null_vector(rng):
    for periodic in (False, True):
        line, dense = bands(rng, 40, periodic, True)
        b = rng.standard_normal((40, 16))
        b = b - b.mean(axis=0)
        Sweep(line, np.zeros(40), np.zeros(16), 1.0).solve(x := b.copy(), False)
        assert np.max(np.abs(dense @ x - b)) <= 1e-12 * np.max(np.abs(x))
