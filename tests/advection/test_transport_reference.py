"""Every scheme of transport against slices in autograd.numpy: values and derivatives in all four arguments."""

from itertools import product

import autograd.numpy as anp
import numpy as np
import pytest
from eulerian_reference import twin

import sparsedp as dp
from sparsedp._utils.pytree import leaves
from sparsedp.autodiff.derivative import pushforward, value_and_grad

SHAPES = {1: (6,), 2: (4, 3), 3: (2, 3, 4)}
FORMS = list(product(("faces", "cells"), ("flux", "advective")))


def grids(dim):
    """Uniform and stretched; bounded, periodic and mixed."""
    rng = np.random.default_rng(dim)
    shape = SHAPES[dim]
    mixed = tuple(a % 2 == 0 for a in range(dim)) if dim > 1 else (True,)
    yield dp.Grid(shape, spacing=0.5)
    yield dp.Grid(shape, spacing=[rng.uniform(0.5, 1.5, n) for n in shape])
    yield dp.Grid(shape, spacing=[rng.uniform(0.5, 1.5, n) for n in shape], periodic=mixed)
    yield dp.Grid(shape, spacing=0.4, periodic=True)


def boundaries(grid):
    """Both conditions, and both on one axis."""
    yield dp.neumann
    if not all(grid.periodic):
        yield dp.dirichlet
        yield {grid.axes[grid.periodic.index(False)]: (dp.dirichlet, dp.neumann)}


def arguments(move, rng):
    shape = move.settings.velocity_shapes[0]
    return rng.normal(size=move.space.shape), rng.normal(size=shape), 0.015, rng.normal(size=move.walls.shape)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("dim", SHAPES)
@pytest.mark.parametrize("velocity, form", FORMS)
@pytest.mark.parametrize("of", ["cells", "faces"])
@pytest.mark.parametrize("scheme", ["upwind", "van_leer"])
def test_agrees_with_the_reference(scheme, of, velocity, form, dim):
    rng = np.random.default_rng(0)
    for grid in grids(dim):
        for boundary in boundaries(grid):
            move = dp.transport(grid, scheme, boundary, velocity, of, form=form)
            slow = twin(grid, scheme, boundary, velocity, of, form)
            args = arguments(move, rng)
            move = move._rule  # the object itself refuses an inflow that no side uses
            np.testing.assert_allclose(move(*args), slow(*args), rtol=0, atol=2e-14)
            g = rng.normal(size=args[0].shape)
            found = value_and_grad(lambda p: anp.sum(g * move(*p)))(args)[1]
            wanted = value_and_grad(lambda p: anp.sum(g * slow(*p)))(args)[1]
            for one, other in zip(leaves(found), leaves(wanted)):
                np.testing.assert_allclose(one, other, rtol=0, atol=2e-13)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("dim", SHAPES)
@pytest.mark.parametrize("scheme", ["upwind", "van_leer"])
def test_forward_and_reverse_mode_agree(scheme, dim):
    rng = np.random.default_rng(1)
    for grid, (velocity, form), of in product(grids(dim), FORMS, ("cells", "faces")):
        move = dp.transport(
            grid, scheme, dp.dirichlet if not any(grid.periodic) else dp.neumann, velocity, of, form=form
        )
        args = arguments(move, rng)
        along = tuple(rng.normal(size=np.shape(arg))[()] for arg in args)
        g = rng.normal(size=move.space.shape)
        move = move._rule  # the object itself refuses an inflow that no side uses
        back = value_and_grad(lambda p: anp.sum(g * move(*p)))(args)[1]
        ahead = np.sum(g * pushforward(lambda p: move(*p), args, along)[1])
        total = sum(np.sum(np.abs(a * b)) for a, b in zip(back, along))
        assert abs(ahead - sum(np.sum(a * b) for a, b in zip(back, along))) <= 1e-13 * (1 + total)
