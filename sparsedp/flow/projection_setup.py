"""What a projection is made of, set up once, and the solve itself: forward and transposed.

With K the mask of the faces that are not closed, D the divergence, G the gradient of the pressure
(0 on closed and on given faces), and A = -D G,

    A p   = D K x,      w = K x + G p,
    A^T q = G^T g,      z = K (g + D^T q).

The second line is the transpose of x -> w; that of x -> p takes a source s on cells in the place of G^T g, and g = 0.
"""

from functools import cached_property

import numpy as np

from sparsedp._utils.reconstruction import Remade
from sparsedp._utils.validation import check_finite, place
from sparsedp.errors import NonFiniteError
from sparsedp.flow.passes import Products, compiled
from sparsedp.grid.boundary_conditions import inflow, no_slip, resolve
from sparsedp.grid.grid import Grid
from sparsedp.operators.difference import divergence, gradient
from sparsedp.operators.masks_and_lift import check_solid, diagonal, solid_faces
from sparsedp.solvers.inverse import build
from sparsedp.solvers.scaling import exponent_of, in_range, largest, shifted

__all__ = ["Setup", "faces_that", "pressure_conditions"]

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
        self.made = Setup, (grid, self.solid, named, settings)  # nothing that the caller may change
        self.pressure_conditions = pressure_conditions(grid, self.sides)
        self.open = faces_that(grid, self.sides, self.solid, lambda condition: not condition.closed)
        self.exponent = exponent_of(max((float(h.max(initial=0.0)) for h in grid.widths), default=1.0))
        near = Grid(grid.shape, spacing=[np.ldexp(h, -self.exponent) for h in grid.widths], periodic=grid.periodic)
        near = grid.backend.place(near)
        self._maps = D, G = divergence(near), gradient(near, self.pressure_conditions, self.solid)
        self.inverse = _inverse(-D @ G, settings)
        self._refuse_lost_inflow()
        if not grid.backend.whole_fields:
            return
        maps = (D.structure, G.structure), (G.T.structure, D.T.structure)
        self._reach = [largest(first.magnitude()(np.ones(grid.faces.size))) for first, _ in maps]
        # Of the forward solve, and of the adjoint one.
        self.products = self.passes = [Products(*pair, self.open.astype(float)) for pair in maps]
        if self._exact:
            passes = [compiled(grid, products) for products in self.products]
            self.passes = passes if all(passes) else self.products

    @property
    def info(self):
        """SolveLog of the pressure solves."""
        return self.inverse.info

    def operators(self):
        """(P, its pressure) as products: so they act on ranks, where no pass sees the whole field."""
        D, G = self._maps
        K = diagonal(G.codomain, self.open)  # 0 times NaN is NaN: the solve refuses it
        p = self.inverse @ D @ K
        P = K + G @ p
        return 0.0 * P if self.still else P, 2.0**self.exponent * p

    @property
    def _exact(self):
        return self.inverse.method == "separable" and self.grid.cells.size > 0

    def split(self, x, out, transposed=False):
        """Flat face field -> p (q); w (z) is written into `out`."""
        p = self._split(x, out, transposed)
        if self.still:
            out[:] = 0.0
        return p

    def _split(self, x, out, transposed):
        turned, solver = transposed and not self.symmetric, self.inverse.solver
        passes, reach, b = self.passes[transposed], self._reach[transposed], np.empty(self.grid.cells.size)

        def residual(p):
            """The net flow of the result is what the solve left: the contract need not look for it."""
            passes.push(x, p, out)
            return passes.net_flow(out, b)[0]

        data, size = passes.net_flow(x, b)
        if in_range(reach * size):
            p = solver.solve_once(b, data, reach * size, residual, transposed, turned) if self._exact else None
            if p is not None:
                return p
            passes.net_flow(x, b)
        elif 0 < (top := largest(x)) < np.inf and not in_range(top):  # beyond the middle of the range of floats
            exponent = exponent_of(top)
            p = self._split(shifted(x, -exponent), out, transposed)
            out[:] = shifted(out, exponent)
            return shifted(p, exponent)
        try:
            before = self.info.forward
            p = solver.solve(b, turned, checked=False)
        except NonFiniteError:
            self._refuse(x, transposed)
            raise
        if transposed and self.symmetric:
            self.info.adjoint, self.info.forward = self.info.forward, before
        passes.push(x, p, out)
        return p

    def pressed(self, source, out):
        """The transpose of x -> p: a flat source s on cells gives z = K D^T q with A^T q = s, written into `out`."""
        q = self.inverse.solver.solve(source, True, checked=False)
        self.passes[True].push(np.zeros(out.size), q, out)

    def _refuse(self, x, transposed):
        """Name the face whose velocity, or cotangent, is not finite."""
        space = self.grid.faces

        def where(index):
            axis = int(np.searchsorted(space.offsets, index, side="right")) - 1
            return f"{self.grid.axes[axis]}-face {place(index - space.offsets[axis], space.parts[axis])}"

        check_finite(f"{'the cotangent of' if transposed else 'the velocity in'} projection", x, where=where)

    @cached_property
    def still(self):
        """Whether nothing can flow without divergence: one closed line of cells. P is 0, beside rounding."""
        shut = all(pair and all(condition.closed for condition in pair) for pair in self.sides)
        return shut and sum(n > 1 for n in self.grid.shape) <= 1

    @cached_property
    def symmetric(self):
        """Whether P is its own transpose."""
        return all(self.grid.uniform) and all(condition.closed for pair in self.sides if pair for condition in pair)

    def _refuse_lost_inflow(self):
        """What enters must be able to leave, in every region apart."""
        system = self.inverse.solver.system
        if not system.size:
            return
        closed = system.null_space.right != 0
        if system.active is not None:  # a cell with no free face at all
            closed = closed | ~system.active
        closed = system.whole(closed).reshape(self.grid.shape) & (True if self.solid is None else ~self.solid)
        for axis, pair in enumerate(self.sides):
            for side, condition in zip((0, -1), pair or (), strict=False):
                if condition == inflow and np.take(closed, side, axis).any():
                    where = f"{('lower', 'upper')[side]} {self.grid.axes[axis]} side"
                    raise ValueError(f"the inflow on the {where} enters a region without an outflow; open a side of it")


def _inverse(op, settings):
    """The inverse for the pressure. Transforms are preferred on small grids too: the passes go with them."""
    if settings["method"] == "auto" and op.domain.size < FEW and op.separable and op.backend.whole_fields:
        try:
            return _inverse(op, settings | {"method": "separable"})
        except ValueError:  # an axis that cannot be diagonalised with all its digits
            pass
    return build(op, name="pressure solve", **settings)


def pressure_conditions(grid, sides):
    """Conditions of the pressure as `gradient` takes them: 0 at an outflow, no slope elsewhere."""
    pairs = zip(grid.axes, sides, strict=True)
    return {axis: tuple(condition.pressure for condition in pair) for axis, pair in pairs if pair}


def faces_that(grid, sides, solid, open_side):
    """Flat face mask: inside, and on the sides whose condition is open; not beside an obstacle."""
    flat = np.ones(grid.faces.size, dtype=bool)
    for axis, (pair, part) in enumerate(zip(sides, grid.split(flat), strict=True)):
        for side, condition in zip((0, -1), pair or (), strict=False):
            np.moveaxis(part, axis, 0)[side] = open_side(condition)  # a view of the flat mask
    return flat if solid is None else flat & ~np.logical_or(*solid_faces(grid, check_solid(grid, solid)))
