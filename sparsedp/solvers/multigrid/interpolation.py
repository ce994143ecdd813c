"""Black-box interpolation: weights from the equations of the cells themselves, so that jumps of coefficients are met.

A cell between two coarse ones takes from them what its equation says when everything across the line between them is
summed up; a cell between four, when everything across the plane is; a cell between eight takes what its own equation
says, given the values of all cells around. Sources: J. E. Dendy, Black box multigrid, J. Comput. Phys. 48 (1982)
366-386; Two multigrid methods for three-dimensional problems with discontinuous and anisotropic coefficients, SIAM J.
Sci. Stat. Comput. 8 (1987) 673-685.
"""

from itertools import product

import numpy as np

from sparsedp.solvers.multigrid import loops

__all__ = ["Transfer", "interpolated"]

WEAK = 1e-10  # a cell held by less than this share of its diagonal is not interpolated


class Transfer:
    """Interpolation from a coarse grid, and restriction, its transpose.

    Parameters
    ----------
    fine, coarse : Layout
    weights : array
        For each of the steps around a coarse cell a field of coarse cells: their weights on the fine cells there.
    threads : int
    """

    def __init__(self, fine, coarse, weights, threads):
        self.fine, self.coarse, self.threads = fine, coarse, threads
        self.weights = weights.reshape(len(weights), -1)
        steps, rows = _around(fine.dim), []
        self.steps = np.array(steps) @ fine.pitch
        self.ends = np.zeros(9, np.int64)
        for kind, parities in enumerate(product((0, 1), repeat=3)):
            parities = parities[:: 4 - fine.dim]  # the loop has three axes; in 2-D there are no odd lines in a plane
            for number, step in enumerate(steps):
                if tuple(np.abs(step)) == parities:
                    corner = (np.array(parities) - step) // 2
                    rows.append((number, corner @ coarse.pitch))
            self.ends[kind + 1] = len(rows)
        self.table = np.array(rows)

    def _run(self, loop, layout, *arguments):
        loop = loop.single if self.weights.dtype == np.float32 else loop
        sizes = self.fine.sizes, self.coarse.sizes
        loop.run(layout.shape[0], self.fine.sizes[0] * self.fine.shape[0], self.threads, *arguments, *sizes)

    def restrict(self, r, out):
        """out = P^T r; r has its ghost cells filled."""
        self._run(loops.restrict, self.coarse, self.weights, r.reshape(-1), out.reshape(-1), self.steps)
        return out

    def prolong(self, e, x):
        """x += P e; e has its ghost cells filled."""
        self._run(loops.prolong, self.fine, self.weights, e.reshape(-1), x.reshape(-1), self.table, self.ends)
        return x


def _around(dim):
    """A cell and all around it, as steps."""
    return list(product((-1, 0, 1), repeat=dim))


def interpolated(level):
    """Level -> the weights of `Transfer`, and a field: what their sums miss to 1, exactly 0 where nothing is held."""
    layout, coarse = level.layout, level.layout.coarse()
    steps = _around(layout.dim)
    weights, missing = coarse.zeros(len(steps)), layout.zeros()
    number = {step: m for m, step in enumerate(steps)}
    coarse.cells(weights[number[(0,) * layout.dim]])[...] = 1.0
    coarse.wrap(weights)
    for kind in sorted(product((0, 1), repeat=layout.dim), key=sum)[1:]:
        sides = [step for step in steps if tuple(map(abs, step)) == kind]  # of the coarse cells around
        shares = _shares(level, kind)
        lost = layout.every_second(level.extra, kind)
        total = sum(shares.values(), lost)
        held = total > WEAK * layout.every_second(level.root, kind) ** 2
        factor = np.divide(1.0, total, out=np.zeros_like(total), where=held)
        lost = np.where(held, lost * factor, 1.0)
        for offset, share in shares.items():
            share *= factor
            lost += share * layout.every_second(missing, kind, offset)
            for side in sides:
                if all(d in (0, -s) for d, s in zip(offset, side)):
                    near = tuple(0 if d else s for d, s in zip(offset, side))  # seen from the neighbour
                    # the coarse cells on this side of the cells
                    corner = tuple(
                        slice(ghosts + (s < 0), ghosts + (s < 0) + n)
                        for ghosts, s, n in zip(coarse.before, side, share.shape)
                    )
                    weights[(number[side], *corner)] += share * weights[(number[near], *corner)]
        layout.every_second(missing, kind)[...] = lost
        layout.wrap(missing)
        for side in sides:
            _fold(coarse, weights[number[side]], side)
    return weights, missing


def _fold(layout, weight, side):
    """Weights on cells below a coarse one were written one line too far at the end of periodic axes."""
    for axis, (ghosts, n, flag) in enumerate(zip(layout.before, layout.shape, layout.periodic)):
        lines = np.moveaxis(weight, axis, 0)
        if flag and side[axis] < 0:
            lines[ghosts] = lines[ghosts + n]
    layout.wrap(weight)


def _shares(level, kind):
    """The links of the cells of a kind, those along even axes summed up: by the offset that is left."""
    shares: dict = {}
    for link, step in zip(level.links, level.steps):
        back = tuple(-d for d in step)
        for there, place in ((step, (0,) * len(step)), (back, back)):
            offset = tuple(d * p for d, p in zip(there, kind))
            if any(offset):
                a = level.layout.every_second(link, kind, place)
                shares[offset] = shares[offset] + a if offset in shares else a.copy()
    return shares
