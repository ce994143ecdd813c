"""Separable operators diagonalised: transforms, eigenvectors, exponentials and powers, against dense algebra."""

from itertools import product

import autograd.numpy as anp
import numpy as np
import pytest
import scipy.linalg

import sparsedp as dp
from sparsedp.autodiff.derivative import value_and_grad
from sparsedp.operators.structure.factor import Factor
from sparsedp.operators.structure.kronecker import Kronecker, Term
from sparsedp.solvers.separable import compute_spectrum, diagonalise, find_eigenbasis

SIDES = [
    dp.neumann,
    dp.dirichlet,
    dp.robin(1.0, 2.0),
    {"x": (dp.neumann, dp.dirichlet)},
    {"x": (dp.dirichlet, dp.neumann)},
]


def grids(shape):
    rng = np.random.default_rng(5)
    for periodic in product((False, True), repeat=len(shape)):
        yield dp.Grid(shape, spacing=0.3, periodic=periodic)
        yield dp.Grid(shape, spacing=[rng.uniform(0.5, 2, n) for n in shape], periodic=periodic)


def conditions(grid):
    return [side for side in SIDES if not (isinstance(side, dict) and grid.periodic[0])]


@pytest.mark.whole
@pytest.mark.parametrize("shape", [(7,), (1,), (2,), (3,), (8,), (4, 5), (1, 3), (2, 2), (3, 4, 5), (4, 1, 6)])
def test_every_boundary_is_diagonalised(shape):
    """f(A) by transforms equals f of the dense matrix, forward and transposed, for f = 1 / x and exp."""
    for grid in grids(shape):
        for boundary in conditions(grid):
            op = -dp.divergence(grid) @ dp.gradient(grid, boundary) + 0.7 * dp.identity(grid.cells)
            dense = op.matrix.toarray()
            found = compute_spectrum(op.structure)
            x = np.random.default_rng(6).standard_normal(grid.cells.size)
            for matrix, transposed in ((dense, False), (dense.T, True)):
                solved = found.apply(1 / found.eigenvalues, x.copy(), transposed)
                np.testing.assert_allclose(solved, np.linalg.solve(matrix, x), rtol=1e-11, atol=1e-12)
            heat = dp.matrix_exponential(op, -0.2)
            np.testing.assert_allclose(heat @ x, scipy.linalg.expm(-0.2 * dense) @ x, rtol=1e-11, atol=1e-12)
            np.testing.assert_allclose(heat.T @ x, scipy.linalg.expm(-0.2 * dense).T @ x, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize(
    ("boundary", "periodic", "kind"),
    [
        (dp.neumann, False, "dct-2"),
        (dp.dirichlet, False, "dst-2"),
        ({"x": (dp.neumann, dp.dirichlet)}, False, "dct-4"),
        ({"x": (dp.dirichlet, dp.neumann)}, False, "dst-4"),
        (dp.neumann, True, "fourier"),
        (dp.robin(1, 2), False, "eigenvectors"),
    ],
)
@pytest.mark.parametrize("n", [3, 64])
def test_uniform_axes_use_a_transform(boundary, periodic, kind, n):
    op = dp.laplacian(dp.Grid(n, spacing=0.1, periodic=periodic), boundary)
    (term,) = op.structure.blocks[0, 0]
    assert diagonalise(term.factors[0]).kind == kind


def test_null_space_is_exact():
    """The eigenvalue of constants is 0, not 1e-10, on stretched grids too."""
    for grid in grids((6, 5)):
        values = compute_spectrum(dp.laplacian(grid).structure).eigenvalues
        assert np.count_nonzero(values == 0) == 1 and np.all(values <= 0)


@pytest.mark.parametrize("dt", [1e-3, 1.0, 1e4])
def test_exact_diffusion_of_a_mode(dt):
    """Case A4: a sine mode decays by exp(-dt lambda_h) to round-off at any dt."""
    n = 64
    grid = dp.Grid((n, n), size=1.0)
    x, y = grid.centres()
    mode = np.sin(np.pi * x) * np.sin(np.pi * y)
    rate = 2 * 4 * n**2 * np.sin(np.pi / n / 2) ** 2
    assert rate / 2 == pytest.approx(9.867622767227759, rel=1e-14)
    spread = dp.matrix_exponential(dp.laplacian(grid, dp.dirichlet), dt)
    factor = np.exp(-dt * rate)
    np.testing.assert_allclose(spread(mode), factor * mode, rtol=1e-9 if dt == 1.0 else 1e-12, atol=1e-15)


def test_powers():
    op = -dp.laplacian(dp.Grid((4, 3), spacing=0.5), dp.dirichlet)
    x = np.random.default_rng(0).standard_normal((4, 3))
    root = dp.matrix_power(op, 0.5)
    np.testing.assert_allclose(root(root(x)), op(x), rtol=1e-12)
    np.testing.assert_allclose(dp.matrix_power(op, -1)(op(x)), x, rtol=1e-12)
    np.testing.assert_allclose(dp.matrix_power(op, 0)(x), x, rtol=1e-12)
    matrix = op.matrix.toarray()  # functions of functions of it
    u = x.reshape(-1)
    spread = dp.matrix_exponential(dp.matrix_power(op, 2), -1e-3)
    back = dp.matrix_power(dp.matrix_exponential(op, -0.1), -1)
    np.testing.assert_allclose(spread @ u, scipy.linalg.expm(-1e-3 * matrix @ matrix) @ u, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(back @ u, scipy.linalg.expm(0.1 * matrix) @ u, rtol=1e-11)
    mean_free = x - x.mean()
    pure = -dp.laplacian(dp.Grid((4, 3)))
    np.testing.assert_allclose(dp.matrix_power(pure, -1)(pure(x)), mean_free, rtol=1e-12, atol=1e-13)


def test_derivatives_and_dtypes():
    spread = dp.matrix_exponential(dp.laplacian(dp.Grid((4, 3), spacing=[np.arange(1.0, 5), np.ones(3)])), 0.3)
    u = np.random.default_rng(1).standard_normal((4, 3))
    value, gradient = value_and_grad(lambda u: 0.5 * anp.sum(spread(u) ** 2))(u)
    np.testing.assert_allclose(gradient, spread.T(spread(u)), rtol=1e-13)
    assert spread(u.astype(np.float32)).dtype == np.float32
    np.testing.assert_allclose(spread(u + 2j * u), spread(u) + 2j * spread(u), rtol=1e-14)
    assert dp.check.operator(spread).ok


# ---- any function ----


@pytest.mark.parametrize("grid", [dp.Grid((5, 4), size=(1.0, 2.0)), dp.Grid((6, 5), periodic=True), dp.Grid((2, 3, 4))])
def test_a_polynomial_of_a_laplacian(grid):
    L = dp.laplacian(grid, dp.dirichlet)
    op = dp.matrix_function(L, lambda e: e**3 - 2 * e + 1)
    u = np.cos(np.arange(grid.cells.size)).reshape(grid.shape)
    wanted = L(L(L(u))) - 2 * L(u) + u
    np.testing.assert_allclose(op(u), wanted, rtol=0, atol=1e-12 * np.max(np.abs(wanted)))
    np.testing.assert_allclose(op.matrix.toarray(), op.T.matrix.toarray().T, rtol=0, atol=1e-9)
    both = dp.matrix_function(dp.matrix_exponential(L, 0.1), np.log)(u)
    np.testing.assert_allclose(both, 0.1 * L(u), rtol=0, atol=1e-9 * np.max(np.abs(L(u))))


WIDE = np.linspace(1.0, 2.0, 33)
LONG = np.linspace(2.0, 1.0, 32)
BOXES = [dp.Grid((33, 32), size=(1.0, 2.0)), dp.Grid((33, 32), periodic=True), dp.Grid((33, 32), spacing=[WIDE, LONG])]


@pytest.mark.parametrize("grid", BOXES, ids=["box", "periodic", "stretched"])
@pytest.mark.parametrize("boundary", [dp.neumann, dp.dirichlet])
def test_functions_of_one_laplacian_are_inverted_by_transforms(grid, boundary):
    """Powers, functions, and their sums: one pair of transforms, and the eigenvalues of the whole."""
    L = dp.laplacian(grid, boundary)
    I = dp.identity(grid.cells)
    f = dp.matrix_function(L, lambda e: 0.3 - (1 + e) ** 2)
    u = np.cos(np.arange(grid.cells.size)).reshape(grid.shape)
    for op in (
        L @ L,
        -2 * L @ L - L,
        L @ (L @ L - L),
        0.3 * I - (I + L) @ (I + L),
        f,
        -0.5 * f + f - I,
        f @ f,
        dp.matrix_power(f, 2) + f,
    ):
        found, values = find_eigenbasis(op.structure)
        wanted = op(u)
        y = found.apply(values, u.reshape(-1)).reshape(grid.shape)
        np.testing.assert_allclose(y, wanted, rtol=0, atol=2e-14 * np.max(np.abs(wanted)))
        inv = dp.inverse(I + 0.7 / np.max(np.abs(values)) * op)
        assert inv.method == "separable" and "a function of a sum of 1-D factors" in inv.reason
        np.testing.assert_allclose(inv(u + 0.7 / np.max(np.abs(values)) * wanted), u, rtol=0, atol=1e-11)
    np.testing.assert_allclose(
        dp.matrix_exponential(L @ L, -1e-9)(u), dp.matrix_function(L, lambda e: np.exp(-1e-9 * e**2))(u)
    )


def test_squares_where_an_axis_has_no_fast_transform():
    grid = dp.Grid((66, 65), size=1.0)
    L = dp.laplacian(grid, dp.dirichlet)
    u = np.cos(np.arange(grid.cells.size)).reshape(grid.shape)
    inv = dp.inverse(L @ L)
    assert inv.method == "separable"
    np.testing.assert_allclose(inv(L(L(u))), u, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        dp.matrix_exponential(L @ L, -1e-9)(u), dp.matrix_function(L, lambda e: np.exp(-1e-9 * e**2))(u)
    )
    assert find_eigenbasis((L @ L + dp.laplacian(grid)).structure) is None


def test_squares_in_space():
    grid = dp.Grid((6, 5, 7), size=1.0)
    L = dp.laplacian(grid, {"x": dp.dirichlet})
    found, values = find_eigenbasis((3 * L - L @ L).structure)
    u = np.sin(np.arange(grid.cells.size))
    wanted = (3 * L - L @ L) @ u
    np.testing.assert_allclose(found.apply(values, u), wanted, rtol=0, atol=1e-13 * np.max(np.abs(wanted)))


def test_combinations_of_different_operators_have_no_eigenbasis():
    """Near misses: other walls, other widths, a line that bends along one axis."""
    grid = dp.Grid((33, 32), spacing=(1e-3, 1.0))
    L = dp.laplacian(grid)
    M = dp.laplacian(grid, dp.dirichlet)
    bent = np.diag(1e-6 * np.arange(32.0))  # far below the squares along x
    along_y = dp.from_matrix(np.kron(np.eye(33), bent), grid.cells, grid.cells)
    factor = Kronecker(grid.cells.parts, grid.cells.parts, {(0, 0): (Term(1.0, (None, Factor(bent))),)})
    bend = dp.Operator(factor, grid.cells, grid.cells, "bend")
    np.testing.assert_array_equal(bend.matrix.toarray(), along_y.matrix.toarray())
    N, W = (dp.laplacian(dp.Grid((33, 32), spacing=[WIDE, width])) for width in (LONG, LONG[::-1] ** 2))
    N = dp.Operator(N.structure, grid.cells, grid.cells, "other widths")
    W = dp.Operator(W.structure, grid.cells, grid.cells, "others")
    for op in (
        N @ W,
        N @ N + W,
        L @ M,
        L @ L + M,
        L @ L + bend,
        dp.matrix_function(L, np.exp) + M,
        dp.matrix_function(L, np.exp) @ bend,
    ):
        assert find_eigenbasis(op.structure) is None, op
    assert find_eigenbasis((L @ L + L).structure) is not None and find_eigenbasis((N @ N + N).structure) is not None
    assert find_eigenbasis(dp.diagonal(grid.cells, 1j * np.ones(grid.shape)).structure) is None


@pytest.mark.whole
def test_kuramoto_sivashinsky_in_a_plane():
    """u_t = -lap u - lap^2 u - |grad u|^2 / 2: waves grow as they should, and stay bounded where they meet."""
    grid = dp.Grid((32, 32), size=12 * np.pi, periodic=True)
    L = dp.laplacian(grid)
    G = dp.gradient(grid)
    mean = dp.average(grid).T
    linear = dp.matrix_function(L, lambda e: -e - e**2)
    step = dp.stepper("etdrk4", lambda u, p: -0.5 * p * mean(G(u) ** 2), 0.1, linear=linear)
    x, y = grid.centres()
    wave = 1e-6 * np.cos(x / 2)
    rate = linear(wave)[3, 4] / wave[3, 4]
    np.testing.assert_allclose(dp.rollout(step, wave, 0.0, 20), wave * np.exp(2.0 * rate), rtol=0, atol=1e-17)
    assert 0.1 < rate < 0.2
    start = 0.1 * (np.cos(x / 3) + np.cos(y / 2) * np.sin(x / 6))
    end = dp.rollout(step, start, 1.0, 300)
    assert 1 < np.ptp(end) < 30 and np.mean(end) < np.mean(start)
    assert dp.check.gradient(lambda p: anp.sum(dp.rollout(step, start, p, 5) ** 2), 1.0, quick=True).verdict == "agrees"


def test_invalid_functions_raise():
    L = dp.laplacian(dp.Grid(4))
    with pytest.raises(ValueError, match="matrix_function needs a separable operator that can be diagonalised"):
        dp.matrix_function(dp.from_matrix(np.triu(np.ones((3, 3)))), np.exp)
    with pytest.raises(
        dp.errors.ShapeError,
        match=r"f\(e\) of matrix_function must have shape \(4,\), got \(\); give a number for each eigenvalue",
    ):
        dp.matrix_function(L, lambda e: 1.0)
    with pytest.raises(TypeError, match="f.e. of matrix_function must hold real numbers, got dtype complex128"):
        dp.matrix_function(L, lambda e: e * 1j)
    with pytest.raises(
        dp.errors.NonFiniteError, match=r"f\(laplacian\) must be finite at the eigenvalues, got .*; check f there"
    ):
        dp.matrix_function(L, lambda e: np.log(e - 1))
    with pytest.raises(TypeError):
        dp.matrix_function(L, 3)
