"""The compiled passes of the projection against the operators themselves."""

from itertools import product

import numpy as np
import pytest

import sparsedp as dp
from sparsedp import kernels

SHAPES = [(5,), (1,), (4, 6), (2, 2), (1, 7), (3, 4, 2)]


def projections(shape):
    """Every choice of periodic axes; walls, an outflow, widths that differ."""
    rng = np.random.default_rng(0)
    for periodic in product((False, True), repeat=len(shape)):
        for spacing in (0.5, [rng.uniform(0.5, 1.5, n) for n in shape]):
            grid = dp.Grid(shape, spacing=spacing, periodic=periodic)
            bounded = [name for name, flag in zip(grid.axes, periodic) if not flag]
            for boundary in ({}, dict.fromkeys(bounded[-1:], (dp.inflow, dp.outflow))):
                P = dp.projection(grid, boundary=boundary, method="auto")
                if P.method == "separable":
                    yield grid, P.setup


@pytest.mark.sampled(0)
@pytest.mark.skipif(not kernels.compiled(), reason="numba is not installed")
@pytest.mark.parametrize("shape", SHAPES)
def test_compiled_passes_agree_with_the_operators(shape):
    rng = np.random.default_rng(1)
    many = 0
    for grid, setup in projections(shape):
        assert setup.passes is not setup.products or min(shape) == 1
        for passes, products in zip(setup.passes, setup.products):
            x = rng.standard_normal(grid.faces.size)
            p = rng.standard_normal(grid.cells.size)
            many = many + 1
            b = np.full(p.size, np.nan)
            out = np.full(x.size, np.nan)
            inner = setup.open * x
            norms = passes.net_flow(x, b)
            passes.push(x, p, out)
            np.testing.assert_allclose(b, products.first.product(inner), rtol=0, atol=1e-11)
            np.testing.assert_allclose(out, inner + setup.open * products.second.product(p), rtol=0, atol=1e-11)
            np.testing.assert_allclose(norms, (np.linalg.norm(b), np.linalg.norm(x)), rtol=1e-13)
    assert many
