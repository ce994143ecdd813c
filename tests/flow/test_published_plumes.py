"""Cases B4 and B5: smoke plumes whose published figures fix what lies around the walls.

Around the faces of a closed box the velocity is 0, one spacing beyond the last sample (dirichlet, inflow
0); smoke goes on with its value at the wall (neumann). The components are then averaged to each other's places.
"""

import numpy as np
import pytest

import sparsedp as dp

PUBLISHED = [0.1558497, 0.46300, 0.89665, 1.40989, 2.04113, 2.92796, 3.83948, 4.52694, 4.86798, 5.13108, 5.48387]


def plume(grid, source, dt, steps, scheme, viscosity=0.0):
    """Smoke and velocity after each step: carried, lifted by the smoke, slowed down, projected."""
    smoke_moves = dp.transport(grid, scheme)
    wind_moves = dp.transport(grid, "semi_lagrangian", boundary=dp.dirichlet, of="faces")
    lift = dp.average(grid)
    project = dp.projection(grid)
    upwards = grid.join(np.zeros(grid.face_shape(0)), np.ones(grid.face_shape(1)))
    smoke = np.zeros(grid.shape)
    v = np.zeros(grid.faces.size)
    for _ in range(steps):
        smoke = smoke_moves(smoke, v, dt) + source
        v = wind_moves(v, v, dt) + dt * upwards * lift(smoke)
        v = project(dp.interior(grid)(v) + viscosity * dt * bends(grid, dp.interior(grid)(v)))
        yield smoke, v


def bends(grid, v):
    """Five-point Laplacian of each component, 0 around its samples."""
    h2 = [widths[0] ** 2 for widths in grid.widths]
    parts = []
    for part in grid.split(v):
        p = np.pad(part, 1)
        parts.append((p[2:, 1:-1] + p[:-2, 1:-1] - 2 * part) / h2[0] + (p[1:-1, 2:] + p[1:-1, :-2] - 2 * part) / h2[1])
    return grid.join(*parts)


@pytest.mark.slow
def test_plume_forward():
    """B4: the published maximum of the velocity in every step, to 5 digits."""
    grid = dp.Grid((32, 40), size=(80.0, 100.0))
    x, y = grid.centres()
    source = 0.2 * ((x - 30) ** 2 + (y - 15) ** 2 <= 100)
    found = list(plume(grid, source, 1.5, len(PUBLISHED), "semi_lagrangian", viscosity=0.01))
    assert [np.max(np.abs(v)) for _, v in found] == pytest.approx(PUBLISHED, rel=1e-5)
    assert np.mean(found[0][0]) == pytest.approx(0.008125, rel=1e-12)


@pytest.mark.whole
def test_plume_inverse_at_zero():
    """B5: the three losses before anything is learned, MacCormack clamped to the cell of the back-trace."""
    grid = dp.Grid((32, 40))
    x, y = grid.centres()
    last = []
    for cx, cy in ((12, 4), (13, 6), (14, 5), (16, 5)):
        source = ((x - cx) ** 2 + (y - cy) ** 2 <= 9) / 3.0
        last.append([smoke for smoke, _ in plume(grid, source, 1.0, 20, "maccormack")][-1])
    losses = [0.5 * np.sum((smoke - last[3]) ** 2) for smoke in last[:3]]
    assert losses == pytest.approx([120.57, 98.69, 79.02], abs=0.005)
    assert sum(losses) == pytest.approx(298.286, abs=5e-4)
