"""A face field taken apart: the part without divergence and the potential of the rest, forward and transposed.

With K, D, G and A = -D G as in pressure.py, and a source s on cells that may be added,

    A p   = D K x + s,      w = K x + G p,
    A^T q = G^T g + s,      z = K (g + D^T q).

The second line is the transpose of the first: cotangents g of w and s of p give z, that of x, by one solve.
"""

from math import hypot
from typing import Any

import numpy as np

from sparsedp.fields import check_finite, place
from sparsedp.solvers.scaling import in_range, largest, norm, shifted
from sparsedp.solvers.solve import Run
from sparsedp.structure.base import Structure

__all__ = ["Potential", "Projected"]


class Splitting:
    """One of the two lines above.

    Parameters
    ----------
    setup : Setup
    transposed : bool
    """

    def __init__(self, setup, transposed):
        self.setup, self.transposed = setup, transposed

    def __call__(self, x, out, source=None):
        """Flat float64 face field, and source on cells -> p (q), as it comes; w (z) is written into `out`."""
        setup, turned, p = self.setup, self.transposed, None
        if source is not None:
            source = self.levelled(source)
            source = -source if turned and setup.symmetric else source  # the lines are one then, with q = -p
        if setup.passes is not None:
            p = self._by_transforms(x, out, source)
        if p is None:
            p = self._with_care(x, out, source)
        if setup.still and source is None:  # P; the transposed pressure alone makes something of a source
            out[:] = 0.0
        return p

    def levelled(self, p):
        """What is known of p, and what may be asked of it: without the null space."""
        space = self.setup.solver.system.null_space
        if self.setup.symmetric and space.count and space.labels is None:  # constants, on both sides
            return p - p.sum() / p.size
        return space.project(p, self.transposed)

    def _by_transforms(self, x, out, source):
        """The solve without the contract's own passes: the divergence of the result is its true residual.

        None when that is not below the tolerance, or the data are near an end of the range of floats.
        """
        setup, turned = self.setup, self.transposed
        run = Run(turned)
        passes, b = setup.passes[turned], np.empty(setup.grid.cells.size)
        flow, length = passes.net_flow(x, b)
        reached = setup.reach[turned] * length
        if source is not None:
            b += source
            flow, added = norm(b), norm(source)
            length, reached = hypot(length, added), reached + added
        if not in_range(length):
            return None
        p = setup.solver.engine.solve(b, 0.0, turned and not setup.symmetric)[0]
        passes.push(x, p, out)
        residual, _ = passes.net_flow(out, b)
        if source is not None:
            b += source
            residual = norm(b)
        return p if setup.solver.accepts(run, residual, flow, reached) else None

    def _with_care(self, x, out, source):
        """The same in the middle of the range of floats, and by the contract, which refines or raises."""
        added = np.zeros(1) if source is None else source
        top = largest(np.concatenate([x, added]))
        if not np.isfinite(top):
            self._refuse(x, added)
        setup, p = self.setup, None
        exponent = 0 if in_range(hypot(norm(x), norm(added))) else int(np.frexp(top)[1])
        if exponent:
            x, source = shifted(x, -exponent), None if source is None else shifted(source, -exponent)
            p = None if setup.passes is None else self._by_transforms(x, out, source)
        if p is None:
            p = self._by_contract(x, out, source)
        if exponent:
            out[:] = shifted(out, exponent)
        return shifted(p, exponent) if exponent else p

    def _refuse(self, x, source):
        space, kind = self.setup.grid.faces, "the cotangent of" if self.transposed else "the velocity in"

        def where(index):
            axis = int(np.searchsorted(space.offsets, index, side="right")) - 1
            return f"{space.grid.axes[axis]}-face {place(index - space.offsets[axis], space.parts[axis])}"

        check_finite(f"{kind} projection", x, where=where)
        check_finite("the cotangent of pressure", source.reshape(self.setup.grid.shape))

    def _by_contract(self, x, out, source):
        """The solve inside the contract; the transposed one with the true transpose, unless that is the same."""
        setup, turned, log = self.setup, self.transposed, self.setup.solver.log
        np.copyto(out, x)
        out[setup.closed] = 0.0
        b = setup.firsts[turned].product(out)
        if source is not None:
            b += source
        if turned and setup.symmetric:
            before = log.forward
            p = setup.solver.solve(b, False, checked=False)
            log.adjoint, log.forward = log.forward, before
        else:
            p = setup.solver.solve(b, turned, checked=False)
        out += setup.seconds[turned].product(p)
        if turned and not setup.symmetric:  # D^T reaches the walls, G does not
            out[setup.closed] = 0.0
        return p


class Solved(Structure):
    """A map that solves in double precision, and rounds once."""

    has_entries = False
    solve: Any  # solve(x, out) on flat float64 arrays

    def __init__(self, setup, transposed=False):
        self.setup, self.transposed = setup, transposed
        self.splitting = Splitting(setup, transposed)

    def transpose(self):
        return type(self)(self.setup, not self.transposed)

    def apply(self, x, out):
        if x.dtype.kind == "c":
            for part, target in ((x.real, out.real), (x.imag, out.imag)):
                np.copyto(target, self._fresh(part), casting="same_kind")
        elif x.dtype == out.dtype == np.float64:
            self.solve(x, out)
        else:
            np.copyto(out, self._fresh(x), casting="same_kind")

    def _fresh(self, x):
        out = np.empty(self.shape[0])
        self.solve(np.ascontiguousarray(x, dtype=np.float64), out)
        return out


class Projected(Solved):
    """P or P^T on flat face fields."""

    def __init__(self, setup, transposed=False):
        super().__init__(setup, transposed)
        self.shape = (setup.grid.faces.size,) * 2

    def solve(self, x, out):
        self.splitting(x, out)


class Potential(Solved):
    """Face field -> the p with P v = v + G p, one of average 0 where only its slope is known; or the transpose."""

    def __init__(self, setup, transposed=False):
        super().__init__(setup, transposed)
        sizes = setup.grid.cells.size, setup.grid.faces.size
        self.shape = sizes[::-1] if transposed else sizes

    def solve(self, x, out):
        scale = 2.0**self.setup.exponent
        if self.transposed:
            self.splitting(np.zeros(out.size), out, scale * x)
        else:
            p = self.splitting.levelled(self.splitting(x, np.empty(x.size)))
            np.multiply(scale, p, out=out)
