"""Coefficients times a power of two: the same bits, iterations and words at every size, by every method."""

import ctypes

import numpy as np
import pytest
import scipy.sparse as sp

import sparsedp as dp
from sparsedp import kernels
from sparsedp.kernels.team import NOTICE

SHAPES = {1: (40,), 2: (12, 11), 3: (8, 7, 6)}
METHODS = ["direct", "separable", "multigrid", "structured", "krylov"]
# 2^-664 is about 1e-200; from 2^+-200 on set-ups scale
EXPONENTS = [600, -600, 664, -664, 150, -150, 198, -198, 206, -206, -900]


def scene(dim, coefficients):
    """(D, G, k on faces, data)."""
    grid = dp.Grid(SHAPES[dim], size=1.0)
    rng = np.random.default_rng(dim)
    k = np.ones(grid.faces.size) if coefficients == "equal" else np.exp(rng.standard_normal(grid.faces.size))
    return dp.divergence(grid), dp.gradient(grid, dp.dirichlet), k, rng.standard_normal(grid.shape)


def inverse(method, D, G, k):
    K = dp.diagonal(D.domain, k)
    return dp.inverse(-k[0] * (D @ G) if method == "separable" else -D @ K @ G, method)


def elliptic(method, D, G, k):
    return dp.elliptic_solver(D, G, method)._inverse(k, 0.0)


def entries(method, D, G, k):
    matrix = (-D @ G).matrix if method == "separable" else (-D @ dp.diagonal(D.domain, k / k.max()) @ G).matrix
    return dp.inverse(dp.from_matrix(matrix * k.max(), G.domain, G.domain), method)


def solved(how, method, D, G, k, b):
    solve = how(method, D, G, k)
    x = solve(b)
    y = solve.T(b)
    return x, y, [(info.iterations, info.status) for info in (solve.info.forward, solve.info.adjoint)]


@pytest.mark.sampled(0)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("dim", SHAPES)
@pytest.mark.parametrize("how", [inverse, elliptic, entries])
def test_bits_follow_the_coefficients(how, dim, method, capfd):
    if method == "separable" and how is entries:
        pytest.skip("a matrix is no sum of factors")
    if method == "structured" and (dim == 1 or not kernels.compiled()):
        pytest.skip("structured is for 2-D and 3-D, with numba")
    D, G, k, b = scene(dim, "equal" if method == "separable" else "smooth")
    *wanted, words = solved(how, method, D, G, k, b)
    dense = (-D @ dp.diagonal(D.domain, k) @ G).matrix.toarray()
    np.testing.assert_allclose(wanted[0].ravel(), np.linalg.solve(dense, b.ravel()), rtol=1e-7)
    for exponent in EXPONENTS:
        *found, told = solved(how, method, D, G, np.ldexp(k, exponent), b)
        assert told == words, exponent
        for x, same in zip(found, wanted, strict=True):
            np.testing.assert_array_equal(np.ldexp(x, exponent), same, err_msg=f"2^{exponent}")
    for factor in (1e-200, 1e200):  # no power of two: the last digits differ
        x = solved(how, method, D, G, k * factor, b)[0] * factor
        np.testing.assert_allclose(x, wanted[0], rtol=1e-7)
    ctypes.CDLL(None).fflush(None)
    printed, told = capfd.readouterr()
    assert (printed, told.replace(NOTICE, "")) == ("", "")  # PyAMG prints, in C++, where entries are far from 1


@pytest.mark.parametrize("method", ["krylov", "multigrid"])
def test_many_faint_regions_leave_the_whole_its_tolerance(method):
    """The residual is relative to the data as given, not to the data of 3000 regions scaled up to their size."""
    chain = sp.diags_array([-np.ones(199), np.full(200, 2.01), -np.ones(199)], offsets=[-1, 0, 1])
    pair = np.array([[2.5, -1.0], [-1.0, 2.5]])
    op = dp.from_matrix(sp.csr_array(sp.block_diag([chain, *[pair] * 3000])))
    b = np.random.default_rng(0).standard_normal(6200) * np.repeat([1.0, 1e-6], [200, 6000])
    inv = dp.inverse(op, method)
    x = inv(b)
    assert np.linalg.norm(b - op(x)) <= 1e-10 * np.linalg.norm(b) and inv.info.forward.residual <= 1e-10
    assert np.linalg.norm((b - op(x))[200:]) <= 1e-9 * np.linalg.norm(b[200:])


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("method", ["direct", "multigrid", "structured", "krylov"])
def test_a_region_with_faint_data_has_digits_of_its_own(method, closed):
    """Two regions without links, with data of 1e-30 in one of them, forward and adjoint."""
    if method == "structured" and not kernels.compiled():
        pytest.skip("structured needs numba")
    grid = dp.Grid((12, 11), size=1.0)
    rng = np.random.default_rng(3)
    wall = np.zeros(grid.shape, dtype=bool)
    wall[6] = True
    op = -dp.laplacian(grid, dp.neumann if closed else {"x": dp.dirichlet}, wall)
    b = rng.standard_normal(grid.shape) * np.where(np.arange(12) < 6, 1e-30, 1.0)[:, None]
    b[wall] = 0.0
    for room in (slice(6), slice(7, 12)):
        b[room] -= np.mean(b[room]) * closed
    inv = dp.inverse(op, method, nullspace="project")
    wanted = np.linalg.lstsq(op.matrix.toarray() * 1e30, 1e30 * b.ravel(), rcond=None)[0].reshape(grid.shape)
    faint = np.linalg.lstsq(op.matrix.toarray(), np.where(wall.cumsum(0) > 0, 0.0, 1e30 * b).ravel(), rcond=None)[0]
    for x in (inv(b), inv.T(b)):
        np.testing.assert_allclose(x[7:], wanted[7:], rtol=1e-7, atol=1e-8)
        np.testing.assert_allclose(1e30 * x[:6], faint.reshape(grid.shape)[:6], rtol=1e-7, atol=1e-8)
