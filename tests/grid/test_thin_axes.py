"""Axes of one cell, bounded and periodic, alone and beside others: every operator and solve against dense loops."""

from itertools import product

import autograd.numpy as anp
import numpy as np
import pytest
from dense import Dense
from pairwise import sample

import sparsedp as dp
from sparsedp.grid.boundary_conditions import resolve

SHAPES = [(1,), (1, 4), (4, 1), (1, 1), (2, 1), (3, 1, 3), (1, 2, 1)]
SHAPES += [pytest.param(shape, marks=pytest.mark.whole) for shape in ((3,), (3, 2), (2, 2, 3))]  # no thin ones
WORDS = (dp.no_slip, dp.free_slip, dp.inflow, dp.outflow)


@pytest.fixture
def grids(shape, drawn):
    """Uniform and stretched, with every choice of periodic axes, of three of these in 3-D; or a sample."""
    rng = np.random.default_rng(3)
    rows = list(product((False, True), repeat=len(shape) + 1))
    return [
        dp.Grid(shape, spacing=[rng.uniform(0.5, 2.0, n) for n in shape] if stretched else 0.3, periodic=periodic)
        for *periodic, stretched in (sample(rows, 3) if drawn is list else drawn(rows))
    ]


@pytest.fixture
def most(shape, drawn):
    """How many choices of walls a grid is tried with: on a line, that is all of them; fewer by default."""
    if drawn is list:
        return {1: 16, 2: 4, 3: 1}[len(shape)]
    return {1: 5, 2: 2, 3: 1}[len(shape)]


def flows(grid, most, rng):
    """Words for the walls of the bounded axes: all of them, or a sample of n."""
    names = [name for name, flag in zip(grid.axes, grid.periodic) if not flag]
    found = list(product(product(WORDS, repeat=2), repeat=len(names)))
    chosen = found if len(found) <= most else [found[i] for i in rng.choice(len(found), most, replace=False)]
    return [dict(zip(names, pairs)) for pairs in chosen]


def words(grid, boundary):
    return [None if flag else boundary[name] for name, flag in zip(grid.axes, grid.periodic)]


def near(found, wanted):
    np.testing.assert_allclose(found, wanted, rtol=0, atol=2e-9 * (1 + np.abs(wanted).max(initial=0.0)))


def scenes(grid, rng, most):
    """(boundary, solid, dense twin): walls drawn, with an obstacle now and then."""
    for boundary in flows(grid, most, rng):
        solid = rng.random(grid.shape) < 0.3 if grid.cells.size > 3 and rng.random() < 0.4 else None
        yield boundary, solid, Dense(grid, words(grid, boundary), solid)


def projections(grid, rng, most):
    """What is legal: an inflow has an outflow."""
    for boundary, solid, dense in scenes(grid, rng, most):
        for method in ("auto", "direct"):
            try:
                yield dp.projection(grid, solid, boundary, method=method), solid, dense
            except ValueError as error:
                assert "enters a region without an outflow" in str(error)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("shape", SHAPES)
def test_projection(shape, grids, most, rng):
    """P, its transpose, the pressure, and their transposes; D as the user makes it finds nothing."""
    for grid in grids:
        for P, solid, dense in projections(grid, rng, most):
            matrix, pressure = dense.projection()
            v, w, q = *rng.standard_normal((2, grid.faces.size)), rng.standard_normal(shape)
            found = P(v)
            near(found, matrix @ v)
            assert np.abs(dp.divergence(grid)(found)[... if solid is None else ~solid]).max(initial=0.0) < 1e-8
            near(P.pressure(v).ravel(), pressure @ v)
            near(P.T(w), matrix.T @ w)
            near(P.pressure.T(q), pressure.T @ q.ravel())


@pytest.mark.parametrize("shape", SHAPES)
def test_what_acts_on_a_velocity(shape, grids, most, rng):
    for grid in grids:
        for boundary, solid, dense in scenes(grid, rng, most):
            v, w = rng.standard_normal((2, grid.faces.size))
            near(dp.convection(grid, boundary, solid)(v, w), dense.convection(v, w))
            for along in (dp.no_slip, dp.free_slip):
                near(dp.face_laplacian(grid, boundary, solid, along)(v), dense.viscous(along) @ v)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("shape", [(1,), (2,), (1, 3), (3, 1), (1, 1), (1, 2, 1), (2, 1, 2)])
def test_flow_step(shape, grids, most, rng):
    """Value, and gradient against the step written with dense matrices."""
    dt = 0.01
    nu = 0.05
    for grid in grids:
        for boundary, solid, dense in scenes(grid, rng, most):
            try:
                step = dp.flow_step(grid, dt, nu, boundary=boundary, solid=solid)
            except ValueError:
                continue
            P, q = dense.projection()
            L = dense.viscous()
            G = dense.pressure().gradient()
            v, before = (P @ u for u in rng.standard_normal((2, grid.faces.size)))
            p = rng.standard_normal(shape)

            def by_hand(v, p, before):
                a = nu * L @ v - dense.convection(v, v)
                ahead = v + dt * (1.5 * a - 0.5 * before - G @ p.ravel())
                return np.concatenate([P @ ahead, p.ravel() - q @ ahead / dt, a])

            state = {"v": v, "p": p, "a": before}
            weights = rng.standard_normal(by_hand(v, p, before).size)
            flat = lambda s: anp.concatenate([s["v"], anp.ravel(s["p"]), s["a"]])
            near(flat(step(state, None)), by_hand(v, p, before))
            slopes = dp.value_and_grad(lambda s: anp.sum(weights * flat(dp.rollout(step, s, None, 1))))(state)[1]
            along = {name: rng.standard_normal(np.shape(part)) for name, part in state.items()}
            h = 1e-3  # the step is a polynomial of degree 2: this difference is exact
            ends = [by_hand(*(state[k] + sign * h * along[k] for k in "vpa")) for sign in (1, -1)]
            wanted = weights @ (ends[0] - ends[1]) / (2 * h)
            assert sum(np.vdot(slopes[k], along[k]) for k in "vpa") == pytest.approx(wanted, rel=1e-8, abs=1e-7)


CONDITIONS = (dp.neumann, dp.dirichlet, dp.robin(2.0, 0.5))


def walls(grid, rng):
    """Conditions for the bounded axes, drawn."""
    names = [name for name, flag in zip(grid.axes, grid.periodic) if not flag]
    for _ in range(4 - grid.dim if names else 1):
        boundary = {name: tuple(CONDITIONS[i] for i in rng.integers(3, size=2)) for name in names}
        solid = rng.random(grid.shape) < 0.3 if rng.random() < 0.3 else None
        yield boundary, solid, Dense(grid, resolve(grid, boundary), solid)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("shape", SHAPES)
def test_catalogue(shape, grids, rng):
    """Both forms of every operator between cells and faces."""
    for grid in grids:
        for boundary, solid, dense in walls(grid, rng):
            empty = Dense(grid, dense.sides)
            D = dense.divergence()
            G = dense.gradient(dp.dirichlet)
            pairs = [
                (dp.divergence(grid), D),
                (dp.gradient(grid, boundary, solid, dp.dirichlet), G),
                (dp.laplacian(grid, boundary, solid, dp.dirichlet), D @ G),
                (dp.laplacian(grid, boundary), D @ empty.gradient()),
                (dp.average(grid, boundary), empty.average()),
                (dp.lift(grid, boundary), empty.lift()),
            ]
            for op, matrix in pairs:
                u = rng.standard_normal(op.domain.shape)
                g = rng.standard_normal(op.codomain.shape)
                for form in (op, op.explicit()):
                    near(form(u).ravel(), matrix @ u.ravel())
                    near(form.T(g).ravel(), matrix.T @ g.ravel())
            k = rng.uniform(0.1, 2.0, shape)
            closed = Dense(grid, [pair and (dp.neumann, dp.neumann) for pair in dense.sides])
            near(dp.harmonic_average(grid)(k), 1.0 / (layers(closed.average()) @ (1 / k.ravel())))


def layers(average):
    """The means with the widths of the cells themselves as weights, not of the other cells: layers in series."""
    found = average.copy()
    for row in found:
        (place,) = np.nonzero(row)
        row[place] = row[place][::-1]
    return found


METHODS = ("auto", "direct", "multigrid", "structured", "separable", "krylov")


@pytest.mark.whole
@pytest.mark.parametrize("shape", SHAPES)
def test_inverses(shape, grids, drawn, rng):
    """Every method that takes the operator: A x = b with the dense A, for the transpose too."""
    systems = [(grid, *wall) for grid in grids for wall in walls(grid, rng)]
    rows = list(product(range(len(systems)), (False, True), METHODS))
    tried = rows if drawn is list else sample(rows, 1)
    for number, (grid, boundary, solid, dense) in enumerate(systems):
        A = -dense.divergence() @ dense.gradient()
        k = rng.uniform(0.5, 2.0, grid.faces.size)
        scaled = -dense.divergence() @ (k[:, None] * dense.gradient())
        D = dp.divergence(grid)
        G = dp.gradient(grid, boundary, solid)
        b, g = rng.standard_normal((2, grid.cells.size))
        for matrix, method in ((scaled if varied else A, method) for n, varied, method in tried if n == number):
            right, left = (m @ (np.linalg.pinv(m, rcond=1e-12) @ x) for m, x in ((matrix, b), (matrix.T, g)))
            op = -D @ G if matrix is A else -D @ dp.diagonal(grid.faces, k) @ G
            try:
                inv = dp.inverse(op, method, nullspace="project")
            except (ValueError, TypeError):  # not for this method
                assert method not in ("auto", "direct")
                continue
            x = inv(right.reshape(shape))
            near(matrix @ x.ravel(), right)
            near(op.apply(x).ravel(), right)
            near(matrix.T @ inv.T(left.reshape(shape)).ravel(), left)
        solve = dp.elliptic_solver(D, G)
        full = lambda c: 0.7 * np.eye(b.size) + c
        near(solve(k, b.reshape(shape), 0.7).ravel(), np.linalg.solve(full(scaled), b))
        near(solve(1.3, b.reshape(shape), 0.7).ravel(), np.linalg.solve(full(1.3 * A), b))


@pytest.mark.parametrize("scheme", ["upwind", "van_leer", "semi_lagrangian", "maccormack"])
@pytest.mark.parametrize("condition", [dp.neumann, dp.dirichlet, None], ids=str)
def test_transport(scheme, condition, rng):
    """A further axis of one cell, bounded or periodic, along which nothing flows, changes nothing."""
    for n, also in product((1, 2, 5), (False, True)):
        line = dp.Grid(n, spacing=[rng.uniform(0.5, 1.0, n)], periodic=condition is None)
        wide = dp.Grid((1, n), spacing=[0.7, line.widths[0]], periodic=(also, condition is None))
        u = rng.standard_normal(n)
        v = rng.standard_normal(line.faces.size)
        sides = {} if condition is None else {"y": condition}
        found = dp.transport(wide, scheme, sides)(u[None], wide.join(0.0, v[None]), 0.05)[0]
        wanted = dp.transport(line, scheme, condition or dp.neumann)(u, v, 0.05)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12)
