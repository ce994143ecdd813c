"""Method "schur": flows in 3-D, their adjoint, the transposed preconditioner, what is refused."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.errors import ConvergenceError


class Cavity:
    """A cavity whose upper wall in y moves along x: its equations, its state at rest, one figure."""

    def __init__(self, shape, **options):
        self.grid = grid = dp.Grid(shape, **options)
        self.D, self.G, self.L = dp.divergence(grid), dp.gradient(grid), dp.face_laplacian(grid)
        self.convect, self.inside = dp.convection(grid), dp.interior(grid)
        lid = dp.face_lift(grid)
        speeds = [0.0] * len(lid.domain.parts)
        speeds[6 if grid.dim == 3 else 3] = 1.0
        self.moving = lid(lid.domain.join(*speeds))
        self.pin = np.zeros(grid.shape)
        self.pin[(0,) * grid.dim] = 1.0
        self.rest = {"v": np.zeros(grid.faces.size), "p": np.zeros(grid.shape)}

    def __call__(self, x, reynolds):
        v = x["v"]
        momentum = (self.L(v) + self.moving) / reynolds - self.convect(v, v) - self.G(x["p"])
        return {"v": self.inside(momentum) + v - self.inside(v), "p": self.D(v) + self.pin * x["p"]}

    def energy(self, x):
        return anp.sum(x["v"] ** 2)


def peak(line):
    """The largest value, by a parabola through the points around it."""
    low, top, high = line[np.argmax(line) - 1 :][:3]
    return top + (high - low) ** 2 / (8 * (2 * top - low - high))


def extremes(grid, v):
    """Least u on the line x = z = 1/2, largest and least v on y = z = 1/2."""
    middle = grid.shape[0] // 2
    u, w, _ = grid.split(v)
    on_x = 0.5 * (u[middle, :, middle - 1] + u[middle, :, middle])
    on_y = 0.5 * (w[:, middle, middle - 1] + w[:, middle, middle])
    return np.array([-peak(-on_x), peak(on_y), -peak(-on_y)])


@pytest.mark.whole
def test_flow_and_adjoint_are_those_of_lu():
    cavity = Cavity((4, 3, 5), size=1.0)
    values = []
    for method in ("direct", "schur"):
        root = dp.implicit(cavity, method=method, rtol=1e-12)
        values.append(dp.value_and_grad(lambda re, root=root: cavity.energy(root(cavity.rest, re)))(20.0))
    np.testing.assert_allclose(values[1], values[0], rtol=1e-9)


def jacobian(cavity, reynolds):
    """The solver of the Jacobian at rest by method "schur"."""
    root = dp.implicit(cavity, method="schur")
    root(cavity.rest, reynolds)
    return root._default_jacobians._points.last.solver


@pytest.mark.whole
def test_the_transposed_step_is_the_transpose():
    spacing = [[1.0, 2.0, 2.0, 1.0, 0.5], 1.0, [1.0, 1.5, 2.0, 3.0]]
    solver = jacobian(Cavity((5, 3, 4), spacing=spacing), 10.0)
    engine = solver.engine
    rng = np.random.default_rng(0)
    r, s = rng.standard_normal((2, solver.system.size))
    forward = engine.precondition(r, False)
    backward = engine.precondition(s, True)
    assert forward @ s == pytest.approx(r @ backward, rel=1e-10)
    assert engine.constants is not None
    # A e has only the pinned entry, w A as well
    e = engine.constants.vector(np.ones(1), False, s.size)
    w = engine.constants.vector(np.ones(1), True, s.size)
    system = solver.system
    assert np.count_nonzero(np.abs(system.product(e)) > 1e-12 * system.norm(False)) == 1
    is_free = np.abs(system.matrix.diagonal()) != 1.0
    assert np.max(np.abs(system.product(w, True)[is_free])) <= 1e-12 * system.norm(True) * np.max(w)


@pytest.mark.slow
def test_iterations_grow_less_than_the_cells_of_an_axis():
    counts = []
    for n in (8, 16):
        solver = jacobian(Cavity((n, n, n), size=1.0), 100.0)
        b = np.random.default_rng(0).standard_normal(solver.system.size)
        solver.solve(b, rtol=1e-8)
        solver.solve(b)
        counts.append(solver.log.forward.iterations)
    assert counts[1] <= 1.5 * counts[0]


@pytest.mark.slow
def test_the_cavity_in_3d():
    """The extremes at Re 100 on 16^3 cells."""
    cavity = Cavity((16, 16, 16), size=1.0)
    x = dp.steady(cavity, cavity.rest, 100.0, method="schur")
    np.testing.assert_allclose(extremes(cavity.grid, x["v"]), [-0.19938761, 0.14008652, -0.23690822], rtol=1e-6)


@pytest.mark.slow
def test_auto_takes_schur_for_large_flows():
    cavity = Cavity((22, 22, 22), size=1.0)
    root = dp.implicit(cavity, rtol=0.1)
    root(cavity.rest, 1.0)
    assert "multipliers" in root.info.hierarchy


@pytest.mark.slow
def test_openings_obstacles_and_strong_convection():
    """A channel with a block at 15 diffusion lengths a cell: the cycles need an upwind form of the blocks."""
    n = 6
    grid = dp.Grid((2 * n, n, n), size=(2.0, 1.0, 1.0))
    sides = {"x": (dp.inflow, dp.outflow)}
    x, y, _ = grid.centres()
    solid = (abs(x - 0.7) < 0.2) & (abs(y - 0.5) < 0.2)
    D, G = dp.divergence(grid), dp.gradient(grid, {"x": (dp.neumann, dp.dirichlet)})
    L, convect = dp.face_laplacian(grid, sides, solid), dp.convection(grid, sides, solid)
    free = dp.free_faces(grid, sides, solid)
    at, height, depth = grid.face_centres(0)
    entering = grid.join(np.where(at == 0, 36 * height * (1 - height) * depth * (1 - depth), 0.0), 0.0, 0.0)

    def flow(state, reynolds):
        v, p = state["v"], state["p"]
        momentum = L(v) / reynolds - convect(v, v) - G(p)
        return {"v": free(momentum) + v - entering - free(v - entering), "p": D(v) + solid * p}

    rest = {"v": entering, "p": np.zeros(grid.shape)}
    values = []
    for method in ("direct", "schur"):
        root = dp.implicit(flow, method=method)
        values.append(dp.value_and_grad(lambda re, root=root: anp.sum(root(rest, re)["v"] ** 2))(40.0))
    np.testing.assert_allclose(values[1], values[0], rtol=1e-8)


def test_a_matrix_with_zeros_on_its_diagonal():
    A = np.diag([4.0, 4.0, 4.0, 0.0]) + np.diag([-1.0, -1.0, 0.0], 1) + np.diag([-1.0, -1.0, 0.0], -1)
    A[0, 3] = A[3, 0] = 1.0
    op = dp.from_matrix(A)
    b = np.arange(4.0)
    inv = dp.inverse(op, "schur")
    np.testing.assert_allclose(inv(b), np.linalg.solve(A, b), rtol=1e-9)
    np.testing.assert_allclose(inv.T(b), np.linalg.solve(A.T, b), rtol=1e-9)
    assert "1 multipliers" in inv.info.hierarchy


def test_what_schur_does_not_solve():
    line = dp.from_matrix(np.diag(np.full(5, 2.0)) - np.diag(np.ones(4), 1) - np.diag(np.ones(4), -1))
    with pytest.raises(
        ValueError,
        match="schur needs multipliers, such as a pressure, whose diagonal entries are 0; .* has none; "
        "write method='direct' or 'multigrid'",
    ):
        dp.inverse(line, "schur")
    with pytest.raises(
        ValueError, match="schur needs the entries of a matrix, but .* is matrix-free; write method='krylov'"
    ):
        dp.inverse(dp.from_functions(lambda x: x, lambda x: x, 3, 3), "schur")


def test_an_estimate_that_cancels_is_no_missing_constraint():
    """D diag(A)^-1 G is 0, or nearly so, but D A^-1 G is not; without the entry 0.5 the first is singular."""
    disjoint = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 1.0], [1.0, 0.0, 0.0]])
    opposite = np.array([[1.0, 0.5, 1.0], [0.0, 1.0, -1.0], [1.0, 1.0, 0.0]])
    nearly = opposite + 1e-14 * np.outer([0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
    b = np.arange(1.0, 4.0)
    for A in (disjoint, opposite, nearly):
        inv = dp.inverse(dp.from_matrix(A), "schur")
        np.testing.assert_allclose(inv(b), np.linalg.solve(A, b), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(inv.T(b), np.linalg.solve(A.T, b), rtol=1e-9, atol=1e-9)
    disjoint[0, 1] = 0.0
    with pytest.raises(ConvergenceError, match="stagnated"):
        dp.inverse(dp.from_matrix(disjoint), "schur")(b)


@pytest.mark.whole
def test_cells_of_many_diffusion_lengths():
    """A cavity at up to 125 diffusion lengths a cell: convection dominates the Schur complement."""
    cavity = Cavity((8, 8), size=1.0)
    x = cavity.rest
    for reynolds in (100.0, 1000.0):
        x = dp.steady(cavity, x, reynolds, method="direct")
    slopes = []
    for method in ("direct", "schur"):
        root = dp.implicit(cavity, method=method)
        slopes.append(dp.grad(lambda re, root=root: cavity.energy(root(x, re)))(1000.0))
    assert slopes[1] == pytest.approx(slopes[0], rel=1e-7)
    assert root.info.adjoint.iterations <= 200


def test_a_field_that_cannot_be_coarsened_is_refused(monkeypatch):
    monkeypatch.setattr("sparsedp.solvers.saddle_point.DENSE_UP_TO", 2)
    A = np.diag([4.0, 4.0, 4.0, 0.0])
    A[0, 3] = A[3, 0] = 1.0
    with pytest.raises(
        ConvergenceError,
        match="the coarsest level of schur on .* has 3 unknowns, the limit is 2; write method='direct'",
    ):
        dp.inverse(dp.from_matrix(A), "schur")
