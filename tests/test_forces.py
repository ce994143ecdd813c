"""flux, forces and brinkman: sums that telescope, the drag of a cylinder, derivatives in its shape, refusals."""

import numpy as np
import pytest
from catalogue import SHAPES, grids, solid

import sparsedp as dp

BOX = {1: np.s_[1:3], 2: np.s_[1:3, 2:], 3: np.s_[1:3, :2, :]}


@pytest.mark.parametrize("shape", SHAPES)
def test_flux_is_the_divergence_in_the_box(shape, rng):
    for grid in grids(shape, rng):
        D, v = dp.divergence(grid), rng.standard_normal(grid.faces.size)
        cells = np.zeros(shape, bool)
        cells[BOX[len(shape)]] = True
        for box, inside in ((BOX[len(shape)], cells), (solid(grid), solid(grid))):
            out, terms = dp.flux(grid, box), grid.volumes * D(v)
            assert np.isclose(out(v), np.sum(terms[inside]), rtol=0, atol=1e-14 * np.sum(abs(terms)))
    everywhere = dp.flux(dp.Grid(shape, periodic=True), np.ones(shape, bool))
    assert not everywhere.matrix.count_nonzero()
