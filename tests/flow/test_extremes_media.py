"""Extreme cases of media that vary: contrasts of 1e6, solids, few cells, batches, single precision."""

import autograd.numpy as anp
import numpy as np
import pytest
from extremes import agree, dense, exact, stretched, walled

import sparsedp as dp

CONTRASTS = pytest.mark.parametrize("contrast", ["inclusion", "checkerboard", "random"])
FEW = [(1,), (2,), (1, 1), (1, 7), (2, 2), (2, 1, 3)]


def medium(contrast, grid):
    """One value for each cell, of which the largest is about 1e6 times the smallest."""
    rng = np.random.default_rng(5)
    place = sum(np.indices(grid.shape))
    return {
        "inclusion": np.where(np.abs(place - np.median(place)) < 3, 1e6, 1.0),
        "checkerboard": np.where(place % 2, 1e6, 1.0),
        "random": 10.0 ** rng.uniform(-3, 3, grid.shape),
    }[contrast]


def scene(solids):
    """Return a stretched grid, its solid cells or None, and a random velocity."""
    grid = stretched(12, 11)
    return grid, (walled() if solids else None), np.random.default_rng(6).standard_normal(grid.faces.size)


def dense_projection(grid, solid, density):
    """The matrix of v + G q / rho without divergence, in a box."""
    inside = dense(dp.interior(grid, solid))
    D, G = dp.divergence(grid), dp.gradient(grid, solid=solid)
    weight = dp.diagonal(grid.faces, 1 / face_density(grid, density))
    return (np.eye(grid.faces.size) + dense(weight @ G) @ exact(-D @ weight @ G) @ dense(D)) @ inside


def face_density(grid, density):
    """The means of two cells, weighted by their widths."""
    faces = []
    for axis in range(grid.dim):
        cells = np.moveaxis(density, axis, -1)
        mass = cells * grid.widths[axis]
        sums = [np.concatenate([x[..., :1], x[..., 1:] + x[..., :-1], x[..., -1:]], -1) for x in (mass, mass / cells)]
        faces.append(np.moveaxis(sums[0] / sums[1], -1, axis))
    return grid.join(*faces)


def dense_viscosity(step, viscosity):
    """The matrix of div(mu (grad v + grad v^T))."""
    form = step.viscous.form
    return dense(form.divergence) @ (form.at_sites(viscosity)[:, None] * dense(form.slopes))


@CONTRASTS
@pytest.mark.parametrize("solids", [False, True])
def test_projection(contrast, solids):
    """The velocity, and the cotangent of it by the transposed matrix."""
    grid, solid, v = scene(solids)
    density = medium(contrast, grid)
    matrix = dense_projection(grid, solid, density)
    project = dp.projection(grid, solid)
    agree(project(v, density), matrix @ v)
    found = dp.grad(lambda x: anp.sum(v * project(x, density)))(np.zeros_like(v))
    agree(found, matrix.T @ v)
    if solid is not None:
        agree(project(v, np.where(solid, 1e-300, density)), matrix @ v)


@pytest.mark.sampled(0)
@CONTRASTS
@pytest.mark.parametrize("solids", [False, True])
def test_a_step(contrast, solids):
    """An implicit step with both contrasts, after which nothing has a divergence."""
    grid, solid, v = scene(solids)
    density = medium(contrast, grid)
    viscosity = medium("random", grid)
    step = dp.flow_step(grid, 0.1, viscosity, density=density, solid=solid, implicit=True, convective=False)
    start = step.start(v)
    end = step(start)
    project = dense_projection(grid, solid, density)
    stress = dense_viscosity(step, viscosity)
    weight = 2 * face_density(grid, density) / 0.1
    predicted = np.linalg.solve(np.diag(weight) - stress, weight * start["v"] + stress @ start["v"])
    agree(end["v"], project @ predicted, rel=1e-7)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("shape", FEW)
def test_few_cells(shape):
    """As one number, where all cells are of one kind; with a contrast, without divergence."""
    grid = dp.Grid(shape, periodic=(True,) + (False,) * (len(shape) - 1))
    v = np.random.default_rng(7).standard_normal(grid.faces.size)
    density = medium("checkerboard", grid)
    steps = [dp.flow_step(grid, 0.01, mu * density, density=rho * density) for mu, rho in ((1e-8, 1.0), (1e-6, 1e2))]
    ends = [dp.rollout(step, step.start(v), None, 2)["v"] for step in steps]
    agree(ends[0], ends[1], rel=1e-9)
    assert np.max(np.abs(dp.divergence(grid)(ends[0]))) < 1e-9
    same = dp.projection(grid)(v, np.full(shape, 1e6))
    agree(same, dp.projection(grid)(v), rel=1e-9, size=1e-3)


def test_single_precision():
    """The dtype of the velocity, and close to double precision; the state holds a pressure in single precision."""
    grid, solid, v = scene(True)
    density = medium("inclusion", grid)
    step = dp.flow_step(grid, 0.1, density, density=density, solid=solid, implicit=True, convective=False)
    run = lambda v: dp.rollout(step, step.start(v), None, 2)["v"]
    found = run(v.astype(np.float32))
    assert found.dtype == np.float32
    agree(found, run(v), rel=2e-4)
    loss = lambda v: anp.sum(run(v) ** 2)
    slope = dp.grad(loss)(v.astype(np.float32))
    assert slope.dtype == np.float32
    agree(slope, dp.grad(loss)(v), rel=2e-4)
    project = dp.projection(grid, solid)
    agree(project(v.astype(np.float32), density), project(v, density), rel=2e-6)


def test_a_batch():
    """Each entry has a contrast of its own."""
    grid, solid, v = scene(True)
    densities = np.stack([medium(contrast, grid) for contrast in ("inclusion", "checkerboard", "random")])
    project = dp.projection(grid, solid)
    velocities = np.stack([v, 2 * v, -v])
    agree(project(velocities, densities), np.stack(list(map(project, velocities, densities))))


@pytest.mark.whole
@CONTRASTS
def test_gradients(contrast):
    """Relative to each entry, gradients in viscosity and density agree with differences."""
    grid = stretched(4, 3)
    v = np.random.default_rng(8).standard_normal(grid.faces.size)
    step = dp.flow_step(grid, 0.1, lambda p: anp.exp(p["mu"]), density=lambda p: anp.exp(p["rho"]), implicit=True)
    params = {"mu": np.log(1e-3 * medium("random", grid)), "rho": np.log(medium(contrast, grid))}
    loss = lambda p: anp.sum(step(step.start(v, p), p)["v"] ** 2)
    assert dp.check.gradient(loss, params, quick=True).verdict == "agrees"
