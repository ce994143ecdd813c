"""Stencils of order 4: dispersion on periodic axes, order next to walls, boundary values, and waves by leapfrog."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp


@pytest.mark.parametrize("n", [1, 2, 3, 4, 9])
def test_waves_on_a_periodic_axis_have_the_known_symbol(n):
    grid = dp.Grid(n, size=2.0, periodic=True)
    h = 2.0 / n
    (x,) = grid.centres()
    for mode in range(n):
        wave = np.exp(1j * np.pi * mode * x)
        half = 0.5 * np.pi * mode * h
        symbol = -(((27 * np.sin(half) - np.sin(3 * half)) / (12 * h)) ** 2)
        np.testing.assert_allclose(dp.laplacian(grid, order=4)(wave), symbol * wave, atol=3e-14 * (n / 2.0) ** 2)


def test_one_periodic_cell_has_no_slope():
    assert dp.laplacian(dp.Grid(1, periodic=True), order=4).matrix.nnz == 0


def test_gradient_and_divergence_are_adjoint_on_periodic_axes():
    grid = dp.Grid((5, 6), spacing=(0.5, 0.25), periodic=True)
    G = dp.gradient(grid, order=4).matrix
    D = dp.divergence(grid, order=4).matrix
    assert abs(D + G.T).max() < 1e-15


def test_cubic_polynomials_have_exact_slopes_next_to_walls():
    grid = dp.Grid(4, size=2.0, origin=1.0)
    polynomial = np.polynomial.Polynomial([3.0, -1.0, 2.0, 0.5])
    slope = polynomial.deriv()
    for conditions in (
        (dp.dirichlet, dp.robin(2.0, 0.5)),
        (dp.neumann, dp.dirichlet),
        (dp.robin(0.3, 1.0), dp.neumann),
    ):
        B = dp.lift(grid, conditions, order=4)
        walls = [
            condition.a * polynomial(x) + sign * condition.b * slope(x)
            for condition, x, sign in zip(conditions, (1.0, 3.0), (-1, 1), strict=True)
        ]
        slopes = dp.gradient(grid, conditions, order=4)(polynomial(grid.centres()[0])) + B(B.domain.join(*walls))
        np.testing.assert_allclose(slopes, slope(grid.face_centres(0)[0]), rtol=1e-13)
        outflow = dp.divergence(grid, order=4)(polynomial(grid.face_centres(0)[0]))
        np.testing.assert_allclose(outflow, slope(grid.centres()[0]), rtol=1e-13)


def largest_error(n, conditions):
    """Error of u - u'' = b in the maximum norm, with a solution that satisfies no condition of the walls at 0."""
    grid = dp.Grid(n, size=1.0)
    u = lambda x: np.exp(x) * np.cos(2 * x + 0.3)
    slope = lambda x: np.exp(x) * (np.cos(2 * x + 0.3) - 2 * np.sin(2 * x + 0.3))
    second = lambda x: np.exp(x) * (-3 * np.cos(2 * x + 0.3) - 4 * np.sin(2 * x + 0.3))
    B = dp.lift(grid, conditions, order=4)
    walls = [c.a * u(x) + sign * c.b * slope(x) for c, x, sign in zip(conditions, (0.0, 1.0), (-1, 1), strict=True)]
    (x,) = grid.centres()
    b = u(x) - second(x) + dp.divergence(grid, order=4)(B(B.domain.join(*walls)))
    solve = dp.inverse(dp.identity(grid.cells) - dp.laplacian(grid, conditions, order=4))
    return np.max(np.abs(solve(b) - u(x)))


@pytest.mark.parametrize(
    "conditions", [(dp.dirichlet, dp.dirichlet), (dp.neumann, dp.neumann), (dp.robin(1.0, 0.5), dp.neumann)]
)
def test_solutions_keep_their_order_at_walls(conditions):
    errors = [largest_error(n, conditions) for n in (20, 40, 80)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all((orders > 3.85) & (orders < 4.3)), orders


def test_the_terms_of_a_divergence():
    grid = dp.Grid((4, 5), periodic=(True, False))
    v = np.random.default_rng(0).standard_normal(grid.faces.size)
    for order in (2, 4):
        terms = [dp.divergence(grid, order, axis)(v) for axis in ("x", 1)]
        np.testing.assert_allclose(sum(terms), dp.divergence(grid, order)(v), rtol=1e-13, atol=1e-13)


def test_the_constant_between_neumann_walls_has_order_4():
    """Of u = exp(cos(pi x)) minus its integral, for both solvers; the integral is a Bessel function."""
    errors = []
    for n in (16, 32):
        grid = dp.Grid(n, size=1.0)
        (x,) = grid.centres()
        u = np.exp(np.cos(np.pi * x))
        source = np.pi**2 * u * (np.cos(np.pi * x) - np.sin(np.pi * x) ** 2)
        solution = dp.inverse(-dp.laplacian(grid, dp.neumann, order=4), nullspace="project")(source)
        operators = dp.divergence(grid, order=4), dp.gradient(grid, dp.neumann, order=4)
        other = dp.elliptic_solver(*operators, nullspace="project")(np.ones(n + 1), source, 0.0)
        np.testing.assert_allclose(other, solution, atol=1e-12)
        errors.append(abs(np.mean(solution - u) + np.i0(1.0)))
    assert errors[0] < 1e-3 and errors[0] / errors[1] > 2**3.8


@pytest.mark.parametrize("boundary", [dp.dirichlet, dp.neumann])
def test_leapfrog_refuses_steps_beyond_the_stability_limit(boundary):
    """c dt / h <= 6 / 7 / sqrt(dim) inside, 2.42 dt <= 2 at a fixed end; the state stays bounded at the limit."""
    grid = dp.Grid(40)
    D = dp.divergence(grid, order=4)
    G = dp.gradient(grid, boundary, order=4)
    rates = (lambda v, c: -c * D(v)), (lambda p, c: -G(p))
    start = np.eye(40)[17], np.zeros(41)
    p, _ = dp.rollout(dp.stepper("leapfrog", rates, 0.82), start, 1.0, 2000)
    assert np.max(np.abs(p)) < 3
    with pytest.raises(dp.errors.UnstableStepError, match="leapfrog is unstable with dt = 0.88"):
        dp.stepper("leapfrog", rates, 0.88)(start, 1.0)


def test_derivatives_in_a_coefficient_on_faces():
    grid = dp.Grid((4, 5), periodic=(False, True))
    solve = dp.elliptic_solver(dp.divergence(grid, order=4), dp.gradient(grid, dp.dirichlet, order=4))
    rng = np.random.default_rng(3)
    b = rng.standard_normal(grid.shape)
    loss = lambda k: anp.sum(anp.abs(solve(k, b, -0.3 - 0.2j)) ** 2)
    assert dp.check.gradient(loss, 1 + rng.random(grid.faces.size), quick=True).verdict == "agrees"
