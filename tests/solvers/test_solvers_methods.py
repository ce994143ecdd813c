"""Each method by itself: the cycle and its transpose, hard coefficients, options, the rule of auto."""

import autograd.numpy as anp
import numpy as np
import pytest
from test_solvers import EVERY, PROBLEMS, stretched

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp.autodiff.derivative import value_and_grad
from sparsedp.kernels import compiled
from sparsedp.solvers.algebraic_multigrid import coarse_solver

SWEEPS = {
    "forward, backward": (("forward",), ("backward",)),
    "forward, forward": (("forward",), ("forward",)),
    "unequal": (("forward", "backward"), ("forward",)),
    "only before": (("forward", "forward"), ()),
}


def wind(n, strength=20.0):
    grid = dp.Grid((n, n), size=1.0)
    flow = strength * (dp.upwind(grid, 0, 1, dp.dirichlet) - 0.5 * dp.upwind(grid, 1, -1, dp.dirichlet))
    return flow - dp.laplacian(grid, dp.dirichlet)


def heterogeneous(k, boundary=dp.dirichlet):
    """-div(k grad) with the harmonic averages of a coefficient on cells."""
    grid = dp.Grid(k.shape, size=1.0)
    faces = dp.diagonal(grid.faces, dp.harmonic_average(grid)(k))
    return -dp.divergence(grid) @ faces @ dp.gradient(grid, boundary)


# ---------------------------------------------------------------- multigrid


@pytest.mark.parametrize("cycle", ["V", "W"])
@pytest.mark.parametrize("sweeps", SWEEPS)
def test_the_transposed_cycle_is_the_transpose(cycle, sweeps, rng):
    inv = dp.inverse(wind(50), "multigrid", cycle=cycle, sweeps=SWEEPS[sweeps])
    forward = inv.solver.engine.forward
    backward = forward.T
    assert len(forward.levels) >= 4
    b, g = rng.standard_normal((2, 2500))
    x = forward.cycle(b)
    y = backward.cycle(g)
    assert abs(x @ g - b @ y) <= 1e-14 * np.linalg.norm(x) * np.linalg.norm(g)


@pytest.mark.parametrize("sweeps", SWEEPS)
def test_the_adjoint_needs_as_many_cycles_and_no_second_set_up(sweeps, rng):
    op = wind(60)
    with recording() as calls:
        inv = dp.inverse(op, "multigrid", rtol=1e-8, sweeps=SWEEPS[sweeps])
        b, g = rng.standard_normal((2, 60, 60))
        inv(b), inv.T(g)
    assert calls[inv.name, "setup"] == 1
    assert inv.info.forward.iterations <= 30
    assert inv.info.adjoint.iterations <= 1.2 * inv.info.forward.iterations + 1


def test_builds_are_deterministic_and_leave_the_random_state():
    np.random.seed(7)  # noqa: NPY002
    wanted = np.random.random(3)  # noqa: NPY002
    np.random.seed(7)  # noqa: NPY002
    one, other = (dp.inverse(wind(40), "multigrid") for _ in range(2))
    assert np.array_equal(np.random.random(3), wanted)  # noqa: NPY002
    b = np.sin(np.arange(1600.0)).reshape(40, 40)
    assert np.array_equal(one(b), other(b)) and one.info.hierarchy == other.info.hierarchy


def test_the_coarse_solve_drops_the_constants_and_nothing_else(rng):
    """With an anisotropy of 1e-12 true modes lie below any threshold that a pseudo-inverse could use."""
    grid = dp.Grid((8, 8))
    weights = dp.diagonal(grid.faces, grid.join(1.0, 1e-12))
    op = -dp.divergence(grid) @ weights @ dp.gradient(grid)
    solve = coarse_solver(op.matrix)
    x = rng.standard_normal(64)
    x -= x.mean()
    for transposed, turned in ((False, op), (True, op.T)):
        assert solve(turned @ x, transposed) == pytest.approx(x, abs=1e-2)


def coefficients(name, n=64):
    rng = np.random.default_rng(0)
    x, y = dp.Grid((n, n), size=1.0).centres()
    return {
        "inclusion": np.where((x - 0.5) ** 2 + (y - 0.5) ** 2 < 0.04, 1e8, 1.0),
        "checkerboard": np.where((np.floor(8 * x) + np.floor(8 * y)) % 2, 1e8, 1.0),
        "layers": np.where(np.arange(n)[:, None] % 7, 1.0, 1e-8) * np.ones((n, n)),
        "random decades": 10.0 ** rng.uniform(-4, 4, (n, n)),
    }[name]


@pytest.mark.parametrize("method", ["direct", "multigrid"])
@pytest.mark.parametrize("name", ["inclusion", "checkerboard", "layers", "random decades"])
def test_jumps_of_the_coefficient(name, method, rng):
    inv = dp.inverse(heterogeneous(coefficients(name)), method)
    b = rng.standard_normal((64, 64))
    for solve in (inv, inv.T):
        solve(b)
    for record in (inv.info.forward, inv.info.adjoint):
        assert record.backward_error <= 1e-12 and record.iterations <= 30


@pytest.mark.parametrize("boundary", [dp.dirichlet, dp.neumann])
def test_anisotropy_and_aspect(boundary, rng):
    grid = dp.Grid((64, 64), size=1.0)
    weights = dp.diagonal(grid.faces, grid.join(1.0, 1e-6))
    thin = dp.Grid((64, 64), size=(1.0, 1e-4))
    b = rng.standard_normal((64, 64))
    for op in (dp.divergence(grid) @ weights @ dp.gradient(grid, boundary), dp.laplacian(thin, boundary)):
        inv = dp.inverse(op, "multigrid", nullspace="project")
        x = inv(b)
        assert inv.info.forward.iterations <= 30 and inv.info.forward.backward_error <= 1e-12
        if boundary == dp.neumann:
            assert abs(x.mean()) <= 1e-10 * np.max(np.abs(x))


# ---------------------------------------------------------------- krylov


def test_an_operator_without_entries(rng):
    op = PROBLEMS["robin, stretched"]()
    bare = dp.from_functions(op, op.T, op.domain, op.codomain, name="black box")
    inv = dp.inverse(bare)
    other = dp.inverse(op)
    assert inv.method == "krylov" and "conjugate gradients" in inv.info.hierarchy
    b = rng.standard_normal(op.domain.shape)
    assert inv(b) == pytest.approx(other(b), rel=1e-7, abs=1e-9)
    assert inv.T(b) == pytest.approx(other.T(b), rel=1e-7, abs=1e-9)


def test_preconditioners(rng):
    grid = stretched(20, 20)
    op = dp.laplacian(grid, dp.dirichlet)
    b = rng.standard_normal(grid.shape)
    near = dp.inverse(1.1 * op - 0.01 * dp.identity(grid.cells))
    counts = {}
    for name, option in dict(none=None, jacobi="jacobi", operator=near, function=lambda u: near(u)).items():
        inv = dp.inverse(op, "krylov", preconditioner=option)
        assert inv(b) == pytest.approx(dp.inverse(op)(b), rel=1e-7)
        inv.T(b)
        counts[name] = (inv.info.forward.iterations, inv.info.adjoint.iterations)
    assert counts["operator"] == counts["function"]
    assert max(counts["operator"]) < 20 < min(counts["jacobi"]) and max(counts["jacobi"]) <= max(counts["none"])
    windy = dp.inverse(wind(16), "krylov", preconditioner=dp.inverse(1.05 * wind(16)))
    windy(np.ones((16, 16))), windy.T(np.ones((16, 16)))
    assert windy.info.forward.iterations <= 5 and windy.info.adjoint.iterations <= 5


def test_a_stale_preconditioner_costs_iterations_but_no_digits(rng):
    """The hierarchy is of other coefficients; the residual is computed with the operator itself."""
    k = coefficients("inclusion", 32)
    old = heterogeneous(np.ones((32, 32)))
    new = heterogeneous(k)
    b = rng.standard_normal((32, 32))
    inv = dp.inverse(new, "krylov", preconditioner=dp.inverse(old))
    assert inv(b) == pytest.approx(dp.inverse(new)(b), rel=1e-6, abs=1e-9)


def test_an_indefinite_operator_is_named():
    op = dp.from_matrix(np.array([[1.0, 2.0], [2.0, 1.0]]))  # eigenvalues 3 and -1
    for method in ("krylov", "multigrid"):
        inv = dp.inverse(op, method)
        for solve in (inv, inv.T):
            with pytest.raises(dp.errors.ConvergenceError, match="indefinite_operator"):
                solve(np.array([1.0, -1.0]))
    assert dp.inverse(op, "direct")(np.array([1.0, -1.0])) == pytest.approx([-1.0, 1.0])


@pytest.mark.parametrize("method", ["multigrid", *(["structured"] if compiled() else [])])
@pytest.mark.parametrize("nu", [1e-3, 1.0, 1e3])
def test_obstacles_held_at_zero_are_found_by_substitution(method, nu, rng):
    """Rows of 1 - nu L in obstacles use values of the fluid, and no row of the fluid uses theirs."""
    grid = dp.Grid((12, 15), size=(1.0, 2.0))
    solid = np.hypot(*(x - 0.4 for x in grid.centres())) < 0.25
    L = dp.laplacian(grid, {"x": (dp.dirichlet, dp.neumann)}, solid, dp.dirichlet)
    A = dp.identity(grid.cells) - nu * L
    inv = dp.inverse(A, method)
    dense = A.matrix.toarray()
    b = rng.standard_normal(grid.shape)
    for solve, matrix in ((inv, dense), (inv.T, dense.T)):
        for data in (b, np.where(solid, b, 0.0), np.where(solid, 0.0, 1e-300 * b)):
            wanted = np.linalg.solve(matrix, data.ravel()).reshape(grid.shape)
            np.testing.assert_allclose(solve(data), wanted, rtol=1e-8, atol=1e-8 * np.max(np.abs(wanted)))
    assert inv.info.forward.iterations <= 12 and inv.info.adjoint.iterations <= 12
    assert repr(inv) and method in str(inv)


def test_implicit_diffusion_around_held_obstacles_converges_by_itself(rng):
    """It stagnated under algebraic multigrid: the rows of the obstacles cannot be smoothed."""
    grid = dp.Grid((16, 16, 16), size=1.0)
    solid = sum((x - 0.5) ** 2 for x in grid.centres()) < 0.04
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, solid=solid, solid_boundary=dp.dirichlet))
    b = rng.standard_normal(grid.shape)
    x = solve(1.0, b, 1.0)
    L = dp.laplacian(grid, solid=solid, solid_boundary=dp.dirichlet)
    assert np.linalg.norm(x - L(x) - b) <= 1e-9 * np.linalg.norm(b)
    assert solve.info.forward.iterations <= 12


def test_a_diagonal_of_mixed_signs_is_solved_by_gmres(rng):
    matrix = rng.standard_normal((25, 25))
    inv = dp.inverse(dp.from_matrix(matrix + matrix.T), "krylov")
    assert "GMRES" in inv.info.hierarchy
    assert inv(np.ones(25)) == pytest.approx(np.linalg.solve(matrix + matrix.T, np.ones(25)), rel=1e-6)


def test_a_warm_start_saves_iterations_and_changes_nothing_else(rng):
    op = PROBLEMS["dirichlet"]()
    inv = dp.inverse(op, "krylov")
    b = rng.standard_normal(op.domain.shape)
    x = inv(b)
    cold = inv.info.forward.iterations
    warm = inv(b, start=x * (1 + 1e-6 * rng.standard_normal(x.shape)))
    assert 0 < inv.info.forward.iterations < 0.6 * cold and warm == pytest.approx(x, rel=1e-7)
    assert np.array_equal(inv(b, start=x), x) and inv.info.forward.iterations == 0
    gradient = value_and_grad(lambda t: anp.sum(inv(t[0], start=t[1]) ** 2))((b, 0.9 * x))[1]
    assert gradient[0] == pytest.approx(inv.T(2 * x), rel=1e-6) and not np.any(gradient[1])
    scaled = inv(np.ldexp(b, 700), start=np.ldexp(x, 700))
    assert np.array_equal(scaled, np.ldexp(x, 700))


def test_truncated_solves():
    op = PROBLEMS["dirichlet"]()
    inv = dp.inverse(op, "krylov", iterations=7)
    inv(np.ones(op.domain.shape))
    assert inv.info.forward.iterations == 7 and inv.info.forward.status == "max_iterations"
    inv.T(np.ones(op.domain.shape))
    assert inv.info.adjoint.iterations == 7 and inv.info.adjoint.residual > 1e-6
    many = dp.inverse(op, "krylov", iterations=2000)  # it stops when rounding errors stop the residual from decreasing
    many(np.ones(op.domain.shape))
    assert 20 < many.info.forward.iterations < 2000 and many.info.forward.status == "converged"


@pytest.mark.parametrize("problem", ["negative", "robin, stretched"])
def test_unrolled_and_implicit_gradients_agree(problem, rng):
    op = PROBLEMS[problem]()
    b = rng.standard_normal(op.domain.shape)
    implicit = dp.inverse(op, "krylov", rtol=1e-12)
    unrolled = dp.inverse(op, "krylov", rtol=1e-12, diff="unrolled")
    assert unrolled(b) == pytest.approx(implicit(b), rel=1e-9)
    assert unrolled.T(b) == pytest.approx(implicit.T(b), rel=1e-9)
    gradients = [value_and_grad(lambda b, inv=inv: anp.sum(inv(b) ** 2))(b)[1] for inv in (implicit, unrolled)]
    assert gradients[1] == pytest.approx(gradients[0], rel=1e-6)


def test_a_start_can_be_trained_through_a_few_iterations(rng):
    op = PROBLEMS["dirichlet"]()
    inv = dp.inverse(op, "krylov", diff="unrolled", iterations=5)
    b, start = rng.standard_normal((2, *op.domain.shape))
    loss = lambda s: anp.sum((op(inv(b, start=s)) - b) ** 2)
    value, gradient = value_and_grad(loss)(start)
    d = rng.standard_normal(start.shape)
    h = 1e-5
    slope = (loss(start + h * d) - loss(start - h * d)) / (2 * h)
    assert np.sum(gradient * d) == pytest.approx(slope, rel=1e-5) and slope != 0


# ---------------------------------------------------------------- direct


def test_dense_and_sparse_factors(rng):
    for op, words in (
        (dp.laplacian(dp.Grid(60), dp.dirichlet), "dense LU"),
        (dp.laplacian(dp.Grid(300), dp.neumann), "sparse LU"),
        (dp.laplacian(dp.Grid(300, periodic=True)), "sparse LU"),  # once one unknown is pinned
        (dp.laplacian(dp.Grid(300, periodic=True)) - dp.identity(dp.Grid(300, periodic=True).cells), "sparse LU"),
        (wind(20), "sparse LU"),
    ):
        inv = dp.inverse(op, "direct", nullspace="project")
        assert words in inv.info.hierarchy
        x = rng.standard_normal(op.domain.shape)
        assert op(inv(op(x))) == pytest.approx(op(x), rel=1e-8, abs=1e-8)
        assert op.T(inv.T(op.T(x))) == pytest.approx(op.T(x), rel=1e-8, abs=1e-8)


def test_a_symmetric_matrix_without_a_diagonal(rng):
    """Pivots on the diagonal would be 0."""
    block = rng.standard_normal((50, 50))
    matrix = np.block([[np.zeros((50, 50)), block], [block.T, np.zeros((50, 50))]])
    inv = dp.inverse(dp.from_matrix(matrix))
    assert inv.method == "direct"
    assert inv(np.ones(100)) == pytest.approx(np.linalg.solve(matrix, np.ones(100)))


# ---------------------------------------------------------------- the choice

CUBE = dp.Grid((25, 25, 23))
LAYERS = dp.harmonic_average(CUBE)(np.where(np.arange(23) % 2, 1e6, 1.0) * np.ones(CUBE.shape))
WIND = dp.from_matrix((dp.upwind(CUBE, 0, 1.0) - dp.laplacian(CUBE, dp.dirichlet)).matrix, CUBE.cells, CUBE.cells)
CHOICES = [
    (lambda: PROBLEMS["dirichlet"](), "direct", "572 unknowns in 2-D"),
    (
        lambda: -dp.laplacian(dp.Grid((25, 25, 23)), dp.dirichlet),
        "separable",
        "14375 unknowns in 3-D, a sum of 1-D factors",
    ),
    (
        lambda: dp.from_matrix((-dp.laplacian(CUBE, dp.dirichlet)).matrix, CUBE.cells, CUBE.cells),
        "structured" if compiled() else "multigrid",
        "multigrid on the grid itself"
        if compiled()
        else "structured multigrid needs numba, which is not installed or switched off",
    ),
    (
        lambda: -dp.divergence(CUBE) @ dp.diagonal(CUBE.faces, LAYERS) @ dp.gradient(CUBE),
        "multigrid",
        "held 10 times weaker along one axis" if compiled() else "needs numba",
    ),
    (lambda: WIND + dp.identity(CUBE.cells), "multigrid", "not a symmetric 5- or 7-point" if compiled() else "numba"),
    (lambda: dp.from_matrix(np.eye(3)), "direct", "3 unknowns without a grid"),
    (lambda: dp.from_functions(lambda u: u, lambda u: u, 3, 3), "krylov", "only products"),
]


@pytest.mark.parametrize("make, method, reason", CHOICES)
def test_the_choice_and_its_reason(make, method, reason):
    inv = dp.inverse(make())
    assert inv.method == method and reason in inv.reason and inv.reason in str(inv)


@pytest.mark.parametrize("shape", [(31, 33), (32, 33), (11, 10, 12)])
def test_multiples_of_the_identity(shape, rng):
    """They are triangular, and sums of 1-D factors too."""
    cells = dp.Grid(shape).cells
    b = rng.standard_normal(shape)
    for op in (dp.identity(cells), 4.0 * dp.identity(cells), dp.identity(cells) + 0.0 * dp.laplacian(cells.grid)):
        inv = dp.inverse(op)
        scale = op(np.ones(shape)).flat[0]
        assert inv(b) == pytest.approx(b / scale, rel=1e-14)
        assert inv.T(b) == pytest.approx(b / scale, rel=1e-14)


@EVERY
def test_vjp_run_twice_gives_identical_bits(method, rng):
    inv = dp.inverse(PROBLEMS["wind"](), method)
    b = rng.standard_normal((24, 25))
    one, other = (value_and_grad(lambda b: anp.sum(inv(b) ** 2))(b)[1] for _ in range(2))
    assert np.array_equal(one, other)
