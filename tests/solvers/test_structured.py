"""Structured multigrid against LU, on every kind of grid; its rate, its refusals, the same bits."""

import pickle
from itertools import product

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp import kernels
from sparsedp.autodiff.derivative import value_and_grad
from sparsedp.solvers.structured_multigrid.engine import WEAK_SHARE
from sparsedp.solvers.system import System

pytestmark = pytest.mark.skipif(not kernels.compiled(), reason="structured multigrid needs numba")

SHAPES = [(1, 1), (1, 5), (3, 2), (16, 17), (31, 9)]
SHAPES += [(1, 1, 1), (2, 2, 2), (1, 4, 3), (5, 1, 7), (9, 8, 11)]
CONDITIONS = [dp.neumann, dp.dirichlet, dp.robin(1, 2)]


def conductance(grid, k, boundary=dp.dirichlet):
    """-div k grad with the harmonic average of k on the faces."""
    faces = dp.diagonal(grid.faces, dp.harmonic_average(grid)(k))
    return -dp.divergence(grid) @ faces @ dp.gradient(grid, boundary)


def smooth(grid):
    return 1 + 0.9 * np.prod([np.sin(3 * x) for x in grid.centres()], axis=0)


def operators(grid, boundary, rng):
    """By every way in which a stencil is read: factors, lines, probes, entries."""
    solid = rng.random(grid.shape) < 0.3
    lap = -dp.laplacian(grid, boundary)
    D = dp.divergence(grid)
    G = dp.gradient(grid, boundary)
    k = dp.diagonal(grid.faces, rng.uniform(0.1, 9.0, grid.faces.size))
    matrix = lap.matrix
    return {
        "factors": lap,
        "shift": lap + 0.3 * dp.identity(grid.cells),
        "lines": -D @ k @ G,
        "solid": -dp.laplacian(grid, boundary, solid),
        "cold solid": -dp.laplacian(grid, boundary, solid, dp.dirichlet),
        "chain with a solid": (-D @ k @ dp.gradient(grid, boundary, solid)).matrix_free(),
        "entries": dp.from_matrix(matrix, grid.cells, grid.cells),
        "negative": dp.laplacian(grid, boundary),
    }


def agree(op, b):
    """Forward and adjoint solve against LU."""
    one, other = (dp.inverse(op, method, nullspace="project") for method in ("structured", "direct"))
    for mine, theirs in ((one, other), (one.T, other.T)):
        wanted = theirs(b)
        assert np.max(np.abs(mine(b) - wanted), initial=0) <= 1e-8 * np.max(np.abs(wanted), initial=0)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("stretched", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
def test_every_grid_against_lu(shape, stretched, drawn, rng):
    for number, periodic in enumerate(drawn(list(product((False, True), repeat=len(shape))))):
        spacing = [rng.uniform(0.5, 2, n) for n in shape] if stretched else 0.3
        grid = dp.Grid(shape, spacing=spacing, periodic=periodic)
        boundary = CONDITIONS[rng.integers(3)]
        ops = list(operators(grid, boundary, rng).values())
        step = 2 if drawn is list else 4  # a half on a grid or a quarter, the next part on the next grid
        for op in ops[number % step :: step]:
            agree(op, rng.standard_normal(shape))


def test_the_null_space_equals_the_one_from_the_entries(rng):
    for periodic in product((False, True), repeat=2):
        grid = dp.Grid((14, 11), periodic=periodic)
        for op in operators(grid, dp.neumann, rng).values():
            mine = dp.inverse(op, "structured", nullspace="project").structure.solver.system
            known = System(op)
            assert mine.null_space.count == known.null_space.count


@pytest.mark.sampled(0)
@pytest.mark.parametrize("shape", [(64, 64), (257, 100), (33, 32, 31)])
@pytest.mark.parametrize("boundary", [dp.dirichlet, dp.neumann])
def test_at_most_12_iterations_for_smooth_coefficients(shape, boundary, rng):
    grid = dp.Grid(shape, spacing=0.01)
    inv = dp.inverse(conductance(grid, smooth(grid), boundary), "structured", nullspace="project")
    b = rng.standard_normal(shape)
    inv(b), inv.T(b)
    assert inv.info.forward.iterations <= 12 and inv.info.adjoint.iterations <= 12
    assert inv.info.forward.status == "converged"


@pytest.mark.whole
@pytest.mark.parametrize("shape", [(96, 96), (28, 28, 28)])
def test_inclusions_with_jumps_of_a_million(shape, rng):
    grid = dp.Grid(shape, size=1.0)
    k = np.ones(shape)
    for _ in range(8):
        middle = rng.random(grid.dim)
        radius = rng.uniform(0.05, 0.12)
        k[sum((x - c) ** 2 for x, c in zip(grid.centres(), middle, strict=True)) < radius**2] = 1e6
    inv = dp.inverse(conductance(grid, k), "structured")
    inv(rng.standard_normal(shape))
    assert inv.info.forward.iterations <= 30 and inv.info.forward.backward_error <= 1e-12


@pytest.mark.whole
@pytest.mark.parametrize("jump, precision", [(1e4, "single"), (1e6, "double"), (1e10, "double")])
def test_the_precision_of_the_cycle_follows_the_jumps(jump, precision, rng):
    """Twelve balls: in single precision 1e6 takes twice as many iterations, and 1e10 ends far off."""
    grid = dp.Grid((256, 256), size=1.0)
    k = np.ones(grid.shape)
    places = np.random.default_rng(1)
    for _ in range(12):
        middle = places.random(2)
        radius = places.uniform(0.04, 0.1)
        k[sum((x - c) ** 2 for x, c in zip(grid.centres(), middle, strict=True)) < radius**2] = jump
    op = conductance(grid, k)
    b = rng.standard_normal(grid.shape)
    inv = dp.inverse(op)
    inv(b), inv.T(b)
    assert inv.method == "structured" and ("double precision" in str(inv)) is (precision == "double")
    for record in (inv.info.forward, inv.info.adjoint):
        assert record.iterations <= 12 and record.backward_error <= 1e-15
    as_asked = dp.inverse(op, "structured", precision=precision)
    assert np.array_equal(as_asked(b), inv(b))


def test_rough_coefficients_are_solved_to_tolerance_or_raise(rng):
    grid = dp.Grid((96, 96), size=1.0)
    op = conductance(grid, 10 ** (8 * rng.random(grid.shape)))
    b = rng.standard_normal(grid.shape)
    inv = dp.inverse(op, "structured")
    try:
        x = inv(b)
    except dp.errors.ConvergenceError as error:
        assert error.info.status in ("stagnated", "max_iterations")
    else:
        assert np.linalg.norm(op(x) - b) <= 1e-9 * np.linalg.norm(b)
    assert inv.structure.solver.engine.weak_share > WEAK_SHARE
    assert dp.inverse(op).method == "direct"


def test_the_same_bits_with_one_thread_and_two(rng):
    grid = dp.Grid((400, 300), size=1.0)
    op = conductance(grid, smooth(grid))
    b = rng.standard_normal((400, 300))
    found = []
    for threads in (1, 2):
        dp.set_threads(threads)
        inv = dp.inverse(op, "structured")
        found += [inv(b), inv(b)]
    dp.set_threads(None)
    assert all(np.array_equal(found[0], x) for x in found[1:])


@pytest.mark.parametrize("k", [-960, -300, 300, 960])
def test_scaling_by_a_power_of_two_changes_no_bit(k, rng):
    grid = dp.Grid((40, 30), size=1.0)
    inv = dp.inverse(conductance(grid, smooth(grid)), "structured")
    b = rng.standard_normal(grid.shape)
    assert np.array_equal(inv(b * 2.0**k), inv(b) * 2.0**k)
    assert np.array_equal(inv.T(b * 2.0**k), inv.T(b) * 2.0**k)


def test_the_gradient_through_an_elliptic_solver(rng):
    grid = dp.Grid((72, 70), size=1.0)
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
    k = rng.uniform(1, 2, grid.faces.size)
    b = rng.standard_normal(grid.shape)
    loss = value_and_grad(lambda k: anp.sum(solve(k, b) ** 2))
    value, slope = loss(k)
    assert "structured" in str(solve)
    step = rng.standard_normal(k.shape) * 1e-6
    assert loss(k + step)[0] - loss(k - step)[0] == pytest.approx(2 * np.sum(slope * step), rel=1e-6)
    reference = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet), "direct")
    expected = value_and_grad(lambda k: anp.sum(reference(k, b) ** 2))(k)[1]
    assert np.max(np.abs(slope - expected)) <= 1e-8 * np.max(np.abs(expected))


def test_double_precision_and_pickles(rng):
    grid = dp.Grid((30, 31), size=1.0)
    inv = dp.inverse(conductance(grid, smooth(grid)), "structured", precision="double")
    b = rng.standard_normal(grid.shape)
    wanted = dp.inverse(conductance(grid, smooth(grid)), "direct")(b)
    assert np.max(np.abs(inv(b) - wanted)) <= 1e-8 * np.max(np.abs(wanted))
    assert np.array_equal(pickle.loads(pickle.dumps(inv))(b), inv(b))


# ---------------------------------------------------------------- refusals

SQUARE = dp.Grid((6, 5))
PLUS = dp.identity(SQUARE.cells)
FAR = np.eye(30) + np.eye(30, k=2) * 0.1 + np.eye(30, k=-2) * 0.1
UNSUITABLE = [  # operator, reason, method that solves it
    (lambda: dp.from_matrix(np.eye(3) + np.ones((3, 3))), "it does not act on the cells of a grid", "multigrid"),
    (lambda: -dp.laplacian(dp.Grid(9), dp.dirichlet), "the grid is 1-D", "multigrid"),
    (
        lambda: dp.upwind(SQUARE, 0, 1.0) - dp.laplacian(SQUARE),
        "it is not a symmetric 5- or 7-point stencil",
        "multigrid",
    ),
    (
        lambda: dp.from_functions(lambda u: u, lambda u: u, SQUARE.cells, SQUARE.cells),
        "it is not a sum of differences between neighbouring cells",
        "krylov",
    ),
    (lambda: dp.from_matrix(FAR, SQUARE.cells, SQUARE.cells), "a row reaches beyond the neighbours", "multigrid"),
    (
        lambda: -dp.divergence(SQUARE) @ dp.diagonal(SQUARE.faces, np.resize([1.0, -1.0], 71)) @ dp.gradient(SQUARE),
        "a face has a coefficient of the wrong sign",
        "direct",
    ),
    (lambda: -dp.laplacian(SQUARE) - 0.1 * PLUS, "a row sums to less than 0: a shift of the wrong sign", "multigrid"),
]


@pytest.mark.parametrize("make, reason, method", UNSUITABLE)
def test_unsuitable_operators_raise(make, reason, method):
    op = make()
    with pytest.raises(ValueError, match="structured cannot solve .*: .*; write method='.*'") as caught:
        dp.inverse(op, "structured")
    assert str(caught.value) == f"structured cannot solve {op}: {reason}; write method={method!r}"
    dp.inverse(op, method)


def test_an_unknown_precision_raises():
    with pytest.raises(ValueError, match="^precision must be one of auto, single, double, got 'half'$"):
        dp.inverse(PLUS, "structured", precision="half")


def test_without_numba(monkeypatch):
    monkeypatch.setattr(kernels, "compiled", lambda: False)
    with pytest.raises(
        ValueError, match="^structured needs numba, which is not installed or switched off; write method='multigrid'$"
    ):
        dp.inverse(PLUS - dp.laplacian(SQUARE), "structured")
    grid = dp.Grid((30, 30, 30))
    assert "structured multigrid needs numba" in dp.inverse(conductance(grid, smooth(grid))).reason


def test_gradients_that_overflow_raise():
    grid = dp.Grid((4, 4))
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
    b = 1e300 * np.ones(grid.shape)
    with (
        np.errstate(over="ignore"),
        pytest.raises(
            dp.errors.NonFiniteError,
            match="a gradient of elliptic_solver must be finite, got .*; scale the loss or the right-hand side",
        ),
    ):
        dp.value_and_grad(lambda k: 1e100 * anp.sum(solve(k, b)))(np.linspace(1.0, 2.0, grid.faces.size))


@pytest.mark.whole
@pytest.mark.parametrize("n", [16, 20, 24])
def test_cells_linked_along_one_axis_do_not_count_as_weak(n, rng):
    """An axis of 16 to 32 cells gets one that is linked along it only; nearly all others are held equally."""
    grid = dp.Grid((n, n, n), size=1.0)
    D = dp.divergence(grid)
    G = dp.gradient(grid, dp.dirichlet)
    k = np.exp(rng.uniform(-1, 1, grid.faces.size))
    solve = dp.elliptic_solver(D, G)
    b = rng.standard_normal(grid.shape)
    x = solve(k, b)
    assert "multigrid on the grid itself" in str(solve) and solve.info.forward.iterations <= 12
    residual = b.ravel() + (D @ dp.diagonal(grid.faces, k) @ G).matrix @ x.ravel()
    assert np.linalg.norm(residual) <= 1e-10 * np.linalg.norm(b)
    assert dp.inverse(-D @ dp.diagonal(grid.faces, k) @ G, "structured").solver.engine.weak_share < 0.01
    along = np.concatenate([np.full(n * n * (n + 1), weight) for weight in (1.0, 1.0, 0.01)])
    flat = dp.elliptic_solver(D, G)  # what is weak along one axis is still left to others
    flat(k * along, b)
    assert "held 10 times weaker along one axis" in str(flat)


def test_anisotropy_raises_and_auto_chooses_another_method(rng):
    grid = dp.Grid((128, 128), size=(1.0, 1e4))
    op = conductance(grid, 1 + rng.random(grid.shape))
    b = rng.standard_normal(grid.shape)
    with pytest.raises(dp.errors.ConvergenceError) as caught:
        dp.inverse(op, "structured")(b)
    assert caught.value.info.residual > 1e-10 and caught.value.info.status in ("stagnated", "max_iterations")
    assert dp.inverse(op).method == "direct"


@pytest.mark.parametrize("shape, seeds", [((64, 64), (7, 37, 43)), ((33, 40), (0, 4, 18, 44)), ((9, 8, 7), (3,))])
def test_many_regions_between_random_obstacles(shape, seeds):
    """Coarse cells without a fine cell of their own, and fine ones without weights: seeds that once failed."""
    for seed in seeds:
        rng = np.random.default_rng(seed)
        if len(shape) == 2:
            grid = dp.Grid(shape, size=1.0, periodic=(seed % 3 == 0, False))
        else:
            spacing = tuple(rng.uniform(0.5, 2, n) for n in shape)
            grid = dp.Grid(shape, spacing=spacing, periodic=(seed % 3 == 0, False, seed % 4 == 0))
        solid = rng.random(shape) < 0.5
        lower_y = dp.neumann if seed % 5 else dp.dirichlet
        sides = {"y": (lower_y, dp.neumann)}
        op = -dp.laplacian(grid, sides, solid=solid)
        inv = dp.inverse(op, "structured", nullspace="project")
        b = op(rng.standard_normal(shape))
        assert np.linalg.norm(op(inv(b)) - b) <= 1e-9 * np.linalg.norm(b) and inv.info.forward.iterations <= 110
