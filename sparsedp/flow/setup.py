"""What a projection is made of, set up once: closed faces, divergence, gradient, and the inverse of -D G."""

from functools import cached_property

import numpy as np

from sparsedp.conditions import inflow, no_slip, resolve
from sparsedp.flow.passes import Passes
from sparsedp.grid import Grid
from sparsedp.operators.boundary import check_solid, solid_faces
from sparsedp.operators.difference import divergence, gradient
from sparsedp.recipe import Remade
from sparsedp.solvers.choose import build
from sparsedp.solvers.scaling import largest

__all__ = ["Setup"]

EPS = np.finfo(float).eps
FEW = 1024  # cells below which transforms are tried even where `inverse` would factor


class Setup(Remade):
    """What a projection needs: the faces that are closed, D, G, and the inverse of A = -D G.

    The grid is one of lengths near 1: P does not depend on the unit of length, while squares of
    lengths may leave the range of floats.
    """

    def __init__(self, grid, solid, boundary, settings):
        self.grid, self.sides = grid, resolve(grid, boundary, no_slip)
        self.solid = None if solid is None else check_solid(grid, solid).copy()
        named = {axis: pair for axis, pair in zip(grid.axes, self.sides, strict=True) if pair}
        self.made = grid, self.solid, named, settings  # nothing that the caller may change
        self.exponent = int(np.frexp(max((float(h.max(initial=0.0)) for h in grid.widths), default=1.0))[1])
        near = Grid(grid.shape, spacing=[np.ldexp(h, -self.exponent) for h in grid.widths], periodic=grid.periodic)
        self.D = divergence(near)
        self.G = gradient(near, self.pressure_conditions, self.solid)
        self.closed = np.flatnonzero(~self.open)
        self.inverse = _inverse(-self.D @ self.G, *settings)
        self.solver = self.inverse.solver
        self._refuse_lost_inflow()
        forward = self.D.structure, self.G.structure
        self.firsts, self.seconds = zip(
            forward,
            forward if self.symmetric else (self.G.structure.transpose(), self.D.structure.transpose()),
            strict=True,
        )
        self.reach = tuple(largest(first.magnitude()(np.ones(grid.faces.size))) for first in self.firsts)
        fast = self.solver.engine.method == "separable" and self.grid.cells.size > 0
        self.passes = self._make_passes() if fast else None

    def recipe(self):
        """The call that makes it again: see recipe.py."""
        return Setup, self.made

    def _make_passes(self):
        """The forward pair of passes, and the transposed one; None where they are not what the operators do."""
        free = []
        for axis, pair in enumerate(self.sides):
            line = np.ones(self.grid.node_count(axis), dtype=bool)
            if pair:
                line[[0, -1]] = [not condition.closed for condition in pair]
            free.append(line)
        directions = (False,) if self.symmetric else (False, True)
        found = [Passes(self.grid, self.D, self.G, free, transposed) for transposed in directions]
        return (found[0], found[-1]) if all(map(self._agree, found, self.firsts, self.seconds)) else None

    def _agree(self, passes, first, second):
        """Whether passes act as the operators D and G do, to rounding.

        Linear maps that agree on random fields agree everywhere: the residual of a solve, which the passes take, is
        then that of the operators themselves.
        """
        generator = np.random.default_rng(0)
        x, p = generator.random(self.grid.faces.size), generator.random(self.grid.cells.size)
        inner, flow, whole = self.open * x, np.empty(p.size), np.empty(x.size)
        passes.net_flow(x, flow)
        passes.push(x, p, whole)
        return _equal(flow, first.product(inner)) and _equal(whole, inner + self.open * second.product(p))

    @cached_property
    def still(self):
        """Whether nothing can flow without divergence: one closed line of cells. P is 0, beside rounding."""
        shut = all(pair and all(condition.closed for condition in pair) for pair in self.sides)
        return shut and sum(n > 1 for n in self.grid.shape) <= 1

    @cached_property
    def open(self):
        """Which faces are not closed."""
        found = []
        for axis, part in enumerate(self.grid.faces.parts):
            keep = np.ones(part, dtype=bool)
            for side, condition in zip((0, -1), self.sides[axis] or (), strict=False):
                np.moveaxis(keep, axis, 0)[side] = not condition.closed
            found.append(keep.ravel())
        flat = np.concatenate(found)
        if self.solid is not None:
            below, above = solid_faces(self.grid, self.solid)
            flat &= ~(below | above)
        return flat

    @property
    def pressure_conditions(self):
        """Conditions of the pressure: 0 at an outflow, no slope elsewhere."""
        pairs = zip(self.grid.axes, self.sides, strict=True)
        return {axis: tuple(condition.pressure for condition in pair) for axis, pair in pairs if pair}

    @cached_property
    def symmetric(self):
        """Whether P is its own transpose."""
        return all(self.grid.uniform) and all(condition.closed for pair in self.sides if pair for condition in pair)

    def _refuse_lost_inflow(self):
        """What enters must be able to leave, in every region apart."""
        labels = self.solver.system.null_space.labels if self.solver.system.size else None
        closed = np.zeros(self.grid.shape, dtype=bool)
        if self.solver.system.size and self.solver.system.null_space.count:
            closed = np.ones(self.grid.shape, dtype=bool) if labels is None else (labels >= 0).reshape(self.grid.shape)
        if self.solver.system.active is not None:  # a cell with no free face at all
            closed |= ~self.solver.system.active.reshape(self.grid.shape)
        if self.solid is not None:
            closed &= ~self.solid
        for axis, pair in enumerate(self.sides):
            for side, condition in zip((0, -1), pair or (), strict=False):
                cells = np.moveaxis(closed, axis, 0)
                if condition == inflow and cells.size and cells[side].any():
                    where = f"{('lower', 'upper')[side]} {self.grid.axes[axis]} side"
                    raise ValueError(f"the inflow on the {where} enters a region without an outflow; open a side of it")


def _inverse(op, method, rtol, maxiter, options):
    """The inverse for the pressure. Transforms are preferred on small grids too: they skip the contract's passes."""
    settings = rtol, maxiter, "project", options, "pressure solve"
    if method == "auto" and op.domain.size < FEW and op.separable:
        try:
            return build(op, "separable", *settings)
        except ValueError:  # an axis that cannot be diagonalised with all its digits
            pass
    return build(op, method, *settings)


def _equal(found, wanted):
    """Whether two results of the same few products are the same but for rounding."""
    return largest(found - wanted) <= 256 * EPS * (1.0 + largest(wanted))
