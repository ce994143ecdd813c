"""Separable operators diagonalised: transforms, eigenvectors, exponentials and powers, against dense algebra."""

from itertools import product

import autograd.numpy as anp
import numpy as np
import pytest
import scipy.linalg

import sparsedp as dp
from sparsedp.derivative import value_and_grad
from sparsedp.solvers.separable import diagonalise, spectrum

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


@pytest.mark.parametrize("shape", [(7,), (1,), (2,), (3,), (8,), (4, 5), (1, 3), (2, 2), (3, 4, 5), (4, 1, 6)])
def test_every_boundary_is_diagonalised(shape):
    """f(A) by transforms equals f of the dense matrix, forward and transposed, for f = 1 / x and exp."""
    for grid in grids(shape):
        for boundary in conditions(grid):
            op = -dp.divergence(grid) @ dp.gradient(grid, boundary) + 0.7 * dp.identity(grid.cells)
            dense, found = op.matrix.toarray(), spectrum(op.structure)
            x = np.random.default_rng(6).standard_normal(grid.cells.size)
            for matrix, transposed in ((dense, False), (dense.T, True)):
                solved = found.apply(1 / found.eigenvalues, x.copy(), transposed)
                np.testing.assert_allclose(solved, np.linalg.solve(matrix, x), rtol=1e-11, atol=1e-12)
            heat = dp.exponential(op, -0.2)
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
        values = spectrum(dp.laplacian(grid).structure).eigenvalues
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
    spread = dp.exponential(dp.laplacian(grid, dp.dirichlet), dt)
    factor = np.exp(-dt * rate)
    np.testing.assert_allclose(spread(mode), factor * mode, rtol=1e-9 if dt == 1.0 else 1e-12, atol=1e-15)


def test_powers():
    op = -dp.laplacian(dp.Grid((4, 3), spacing=0.5), dp.dirichlet)
    x = np.random.default_rng(0).standard_normal((4, 3))
    root = dp.power(op, 0.5)
    np.testing.assert_allclose(root(root(x)), op(x), rtol=1e-12)
    np.testing.assert_allclose(dp.power(op, -1)(op(x)), x, rtol=1e-12)
    np.testing.assert_allclose(dp.power(op, 0)(x), x, rtol=1e-12)
    matrix, u = op.matrix.toarray(), x.reshape(-1)  # functions of functions of it
    spread, back = dp.exponential(dp.power(op, 2), -1e-3), dp.power(dp.exponential(op, -0.1), -1)
    np.testing.assert_allclose(spread @ u, scipy.linalg.expm(-1e-3 * matrix @ matrix) @ u, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(back @ u, scipy.linalg.expm(0.1 * matrix) @ u, rtol=1e-11)
    mean_free = x - x.mean()
    pure = -dp.laplacian(dp.Grid((4, 3)))
    np.testing.assert_allclose(dp.power(pure, -1)(pure(x)), mean_free, rtol=1e-12, atol=1e-13)


def test_derivatives_and_dtypes():
    spread = dp.exponential(dp.laplacian(dp.Grid((4, 3), spacing=[np.arange(1.0, 5), np.ones(3)])), 0.3)
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
    op, u = dp.function(L, lambda e: e**3 - 2 * e + 1), np.cos(np.arange(grid.cells.size)).reshape(grid.shape)
    wanted = L(L(L(u))) - 2 * L(u) + u
    np.testing.assert_allclose(op(u), wanted, rtol=0, atol=1e-12 * np.max(np.abs(wanted)))
    np.testing.assert_allclose(op.matrix.toarray(), op.T.matrix.toarray().T, rtol=0, atol=1e-9)
    both = dp.function(dp.exponential(L, 0.1), np.log)(u)
    np.testing.assert_allclose(both, 0.1 * L(u), rtol=0, atol=1e-9 * np.max(np.abs(L(u))))


def test_kuramoto_sivashinsky_in_a_plane():
    """u_t = -lap u - lap^2 u - |grad u|^2 / 2: waves grow as they should, and stay bounded where they meet."""
    grid = dp.Grid((32, 32), size=12 * np.pi, periodic=True)
    L, G, mean = dp.laplacian(grid), dp.gradient(grid), dp.average(grid).T
    linear = dp.function(L, lambda e: -e - e**2)
    step = dp.stepper("etdrk4", lambda u, p: -0.5 * p * mean(G(u) ** 2), 0.1, linear=linear)
    x, y = grid.centres()
    wave = 1e-6 * np.cos(x / 2)
    rate = linear(wave)[3, 4] / wave[3, 4]
    np.testing.assert_allclose(dp.rollout(step, wave, 0.0, 20), wave * np.exp(2.0 * rate), rtol=0, atol=1e-17)
    assert 0.1 < rate < 0.2
    start = 0.1 * (np.cos(x / 3) + np.cos(y / 2) * np.sin(x / 6))
    end = dp.rollout(step, start, 1.0, 300)
    assert 1 < np.ptp(end) < 30 and np.mean(end) < np.mean(start)
    assert dp.check.gradient(lambda p: anp.sum(dp.rollout(step, start, p, 5) ** 2), 1.0).verdict == "agrees"


def test_functions_that_are_refused():
    L = dp.laplacian(dp.Grid(4))
    with pytest.raises(ValueError, match="function needs a separable operator that can be diagonalised"):
        dp.function(dp.from_matrix(np.triu(np.ones((3, 3)))), np.exp)
    with pytest.raises(
        dp.errors.ShapeError, match=r"function needs f to give shape \(4,\), a number an eigenvalue, got \(\)"
    ):
        dp.function(L, lambda e: 1.0)
    with pytest.raises(TypeError, match="function needs f to give real numbers, got dtype complex128"):
        dp.function(L, lambda e: e * 1j)
    with pytest.raises(
        dp.errors.NonFiniteError, match=r"f\(laplacian\) holds NaN or infinity; check f at its eigenvalues"
    ):
        dp.function(L, lambda e: np.log(e - 1))
    with pytest.raises(TypeError):
        dp.function(L, 3)
