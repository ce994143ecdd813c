"""A viscosity, density or diffusivity beside obstacles: its values in solid cells have no effect."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

SOLID = np.zeros((5, 6), bool)  # a step at a wall, a block that meets it at a corner, and a single cell
SOLID[:2, 0] = SOLID[2:4, 1:3] = SOLID[1, 4] = True
IN_SOLIDS = pytest.mark.parametrize("in_solids", [0.0, 1e9, -1.0, np.nan, np.inf])


def channel():
    """Four rows of fluid between two solid ones."""
    grid = dp.Grid((3, 6), spacing=0.25, periodic=(True, False))
    solid = np.zeros(grid.shape, bool)
    solid[:, [0, -1]] = True
    return grid, solid


def test_speeds_in_a_channel_between_solid_rows():
    """They equal the results for one number as viscosity: the fluid determines the friction beside a solid row."""
    grid, solid = channel()
    push = grid.join(1.0, 0.0)
    options = {"force": lambda v, p: push, "solid": solid, "convective": False}
    step = dp.flow_step(grid, 0.002, np.where(solid, 0.0, 0.5), **options)
    end = dp.rollout(step, step.start(np.zeros(grid.faces.size)), None, 200)
    speeds = grid.split(end["v"])[0][0]
    np.testing.assert_allclose(speeds, [0, 0.10862927, 0.2104785, 0.2104785, 0.10862927, 0], rtol=1e-7)


@pytest.mark.sampled(0)
@IN_SOLIDS
@pytest.mark.parametrize("implicit", [False, True])
def test_viscosity_in_solids(in_solids, implicit, rng):
    """Its values there do not change a step, in whichever way it is given."""
    grid, solid = channel()
    v = rng.standard_normal(grid.faces.size)

    def steps(field):
        for viscosity in (field, lambda p: field, lambda rate, p: field):
            step = dp.flow_step(grid, 0.002, viscosity, solid=solid, implicit=implicit)
            yield step(step.start(v))["v"]

    found = list(steps(np.where(solid, in_solids, 0.5)))
    np.testing.assert_allclose(found, list(steps(np.full(grid.shape, 0.5))), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("implicit", [False, True])
def test_a_law_that_is_infinite_at_rest(implicit):
    """A solid cell has no shear rate: the law gets the rate of a fluid cell, and all derivatives are finite."""
    grid, solid = channel()
    profile = np.array([0, 1.0, 2.0, 2.5, 1.5, 0])[None] * np.ones((3, 1))
    law = lambda rate, m: 0.01 * rate ** (m - 1)
    solid_rows = dp.flow_step(grid, 0.01, law, solid=solid, implicit=implicit)
    inner = dp.Grid((3, 4), spacing=0.25, periodic=(True, False))
    walls = dp.flow_step(inner, 0.01, law, implicit=implicit)

    def energy(step, grid, profile):
        def loss(m):
            end = dp.rollout(step, step.start(grid.join(profile, 0.0), m), m, 3)
            return anp.sum(end["v"] ** 2)

        return dp.value_and_grad(loss)(0.5)

    found = energy(solid_rows, grid, profile)
    np.testing.assert_allclose(found, energy(walls, inner, profile[:, 1:-1]), rtol=1e-9)


def viscous_twin(mu, u, v, solid, h):
    """Return div(mu (grad v + grad v^T)) in a box without slip, on the faces of x and of y, by loops over faces."""
    nx, ny = solid.shape
    fluid = lambda i, j: 0 <= i < nx and 0 <= j < ny and not solid[i, j]

    def on_edge(i, j):
        around = [(i - 1, j - 1), (i, j - 1), (i - 1, j), (i, j)]
        around = [(min(max(a, 0), nx - 1), min(max(b, 0), ny - 1)) for a, b in around]
        inside = [mu[cell] for cell in around if not solid[cell]]
        return len(inside) / sum(1 / k for k in inside)

    def slope(w, lower, upper, is_free):
        """Difference across an edge; a face that is not free holds the speed 0 of a wall halfway."""
        if is_free(lower) and is_free(upper):
            return (w[upper] - w[lower]) / h
        return w[upper] / (h / 2) if is_free(upper) else -w[lower] / (h / 2)

    free_u = lambda face: fluid(face[0] - 1, face[1]) and fluid(face[0], face[1])
    free_v = lambda face: fluid(face[0], face[1] - 1) and fluid(face[0], face[1])
    across_u = lambda i, j: (v[i, j] - v[i - 1, j]) / h if 0 < i < nx else 0.0
    across_v = lambda i, j: (u[i, j] - u[i, j - 1]) / h if 0 < j < ny else 0.0
    push_u = np.zeros(u.shape).tolist()
    push_v = np.zeros(v.shape).tolist()
    for i, j in np.ndindex(*u.shape):
        if free_u((i, j)):
            edge = lambda k, i=i: on_edge(i, k) * (slope(u, (i, k - 1), (i, k), free_u) + across_u(i, k))
            stretch = lambda k, j=j: 2 * mu[k, j] * (u[k + 1, j] - u[k, j]) / h
            push_u[i][j] = (stretch(i) - stretch(i - 1) + edge(j + 1) - edge(j)) / h
    for i, j in np.ndindex(*v.shape):
        if free_v((i, j)):
            edge = lambda k, j=j: on_edge(k, j) * (slope(v, (k - 1, j), (k, j), free_v) + across_v(k, j))
            stretch = lambda k, i=i: 2 * mu[i, k] * (v[i, k + 1] - v[i, k]) / h
            push_v[i][j] = (stretch(j) - stretch(j - 1) + edge(i + 1) - edge(i)) / h
    join = lambda rows: anp.array([entry for row in rows for entry in row])
    return anp.concatenate([join(push_u), join(push_v)])


def around_obstacles(rng):
    """Return a box with obstacles, a velocity without divergence, a viscosity, and weights of a loss."""
    grid = dp.Grid(SOLID.shape, spacing=0.5)
    v = dp.projection(grid, SOLID)(rng.standard_normal(grid.faces.size))
    viscosity = np.where(SOLID, np.nan, 10.0 ** rng.uniform(-2, 0, SOLID.shape))
    return grid, v, viscosity, rng.standard_normal(grid.faces.size)


def test_the_stress_has_a_twin(rng):
    """Around corners the viscosity is the harmonic mean of 1, 2 or 3 fluid cells; with derivatives of all kinds."""
    grid, v, viscosity, weights = around_obstacles(rng)
    options = {"solid": SOLID, "convective": False, "unstable": "allow"}
    step = dp.flow_step(grid, 1e-3, lambda p: p, **options)
    ours = lambda mu, v: step.acceleration(v, mu)
    twin = lambda mu, v: viscous_twin(mu, *grid.split(v), SOLID, 0.5)
    np.testing.assert_allclose(ours(viscosity, v), twin(viscosity, v), rtol=1e-12, atol=1e-13)
    loss = lambda rule: lambda mu, v: anp.sum(weights * rule(mu, v) ** 2)
    for argnum in (0, 1):
        gradient = dp.grad(loss(ours), argnum)(viscosity, v)
        wanted = np.nan_to_num(dp.grad(loss(twin), argnum)(viscosity, v))
        np.testing.assert_allclose(gradient, wanted, rtol=1e-11, atol=1e-11 * np.max(np.abs(wanted)))
    assert np.all(dp.grad(loss(ours))(viscosity, v)[SOLID] == 0)
    direction = rng.standard_normal(SOLID.shape)
    _, tangent = dp.jvp(lambda mu: ours(mu, v), viscosity, direction)
    clean = np.where(SOLID, 1.0, viscosity)
    moved = lambda t: twin(clean + t * clean * direction, v)
    _, tangent_of_clean = dp.jvp(lambda mu: ours(mu, v), clean, clean * direction)
    np.testing.assert_allclose(tangent_of_clean, (moved(1e-5) - moved(-1e-5)) / 2e-5, rtol=1e-6, atol=1e-8)
    assert np.all(np.isfinite(tangent))


@pytest.mark.sampled(0)
@pytest.mark.parametrize("where", ["cells", "faces"])
@IN_SOLIDS
def test_density_in_solids(where, in_solids, rng):
    """Neither the projection nor a step depends on the density of solid cells, or of faces that touch one."""
    grid, v, _, _ = around_obstacles(rng)
    weights = rng.standard_normal(grid.faces.size)
    density = 10.0 ** rng.uniform(-1, 1, grid.shape)
    hidden = SOLID
    if where == "faces":
        density = 10.0 ** rng.uniform(-1, 1, grid.faces.size)
        fluid = ~SOLID
        hidden = dp.average(grid, dp.neumann)(1.0 * fluid) < 1
    project = dp.projection(grid, SOLID)
    loss = lambda density: anp.sum(weights * project(weights, density) ** 2)
    value, gradient = dp.value_and_grad(loss)(np.where(hidden, in_solids, density))
    wanted, wanted_gradient = dp.value_and_grad(loss)(density)
    assert value == pytest.approx(wanted, rel=1e-10)
    np.testing.assert_allclose(gradient, wanted_gradient, rtol=1e-7, atol=1e-9)
    assert np.all(gradient[hidden] == 0)
    if where == "cells":
        steps = [
            dp.flow_step(grid, 0.01, 0.1, solid=SOLID, density=values)
            for values in (density, np.where(SOLID, in_solids, density))
        ]
        ends = [dp.rollout(step, step.start(v), None, 2)["v"] for step in steps]
        np.testing.assert_allclose(ends[1], ends[0], rtol=1e-9, atol=1e-12)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("implicit", [False, True])
@IN_SOLIDS
def test_diffusivity_in_solids(implicit, in_solids, rng):
    """The diffusion of a scalar does not depend on the diffusivity of solid cells."""
    grid, v, _, _ = around_obstacles(rng)
    heat = rng.standard_normal(grid.shape)
    step = dp.flow_step(grid, 0.01, solid=SOLID, implicit=implicit, scalars={"heat": {"diffusivity": lambda k: k}})

    def loss(k):
        end = step(step.start(v, k, {"heat": heat}), k)["s"]["heat"]
        return anp.sum(end**3)

    k = rng.uniform(0.1, 0.5, grid.shape)
    value, gradient = dp.value_and_grad(loss)(np.where(SOLID, in_solids, k))
    wanted, wanted_gradient = dp.value_and_grad(loss)(k)
    assert value == pytest.approx(wanted, rel=1e-12)
    np.testing.assert_allclose(gradient, wanted_gradient, rtol=1e-9, atol=1e-14)
    assert np.all(gradient[SOLID] == 0)


def test_only_solid_cells():
    """Nothing flows, and no value of a medium is refused."""
    grid = dp.Grid((2, 2))
    solid = np.ones(grid.shape, bool)
    nothing = np.full(grid.shape, np.nan)
    for implicit in (False, True):
        step = dp.flow_step(grid, 0.1, nothing, density=nothing, solid=solid, implicit=implicit)
        assert np.all(step(step.start(np.ones(grid.faces.size)))["v"] == 0)
    assert np.all(dp.projection(grid, solid)(np.ones(grid.faces.size), nothing) == 0)


def test_values_of_the_fluid_are_checked():
    """Messages name a cell of the fluid."""
    grid, solid = channel()
    bad = np.where(solid, np.nan, 1.0)
    bad[1, 2] = -2.0
    with pytest.raises(ValueError, match=r"^viscosity of flow_step must be >= 0, got -2 in cell \(1, 2\)$"):
        dp.flow_step(grid, 0.1, bad, solid=solid)
    with pytest.raises(ValueError, match=r"^density of projection must be > 0, got -2 in cell \(1, 2\)$"):
        dp.projection(grid, solid)(np.ones(grid.faces.size), bad)
    large = np.where(solid, 1e9, 3.0)
    with pytest.raises(dp.errors.UnstableStepError, match="unstable for the largest viscosity = 3 with dt = 0.1"):
        step = dp.flow_step(grid, 0.1, large, solid=solid)
        step.start(np.zeros(grid.faces.size))


@pytest.mark.whole
@pytest.mark.parametrize("implicit", [False, True])
def test_audit_of_all_media(implicit, rng):
    """Viscosity, density and diffusivity beside obstacles: gradient and Hessian agree with differences."""
    grid, v, _, weights = around_obstacles(rng)
    step = dp.flow_step(
        grid,
        0.01,
        lambda rate, s, p: p["mu"] * (0.1 + rate**2) ** -0.2 * anp.exp(-s["c"]),
        solid=SOLID,
        density=lambda s, p: p["rho"] + s["c"],
        scalars={"c": {"diffusivity": lambda p: p["k"]}},
        implicit=implicit,
    )
    c = rng.uniform(size=grid.shape)
    params = {name: rng.uniform(0.1, 0.3, grid.shape) for name in ("mu", "rho", "k")}

    def loss(params):
        end = dp.rollout(step, step.start(v, params, {"c": c}), params, 2)
        return anp.sum(weights * end["v"]) + anp.sum(end["v"] ** 2)

    audit = dp.check.gradient(loss, params)
    assert audit.verdict == audit.hessian == "agrees"
