"""Black-box interpolation: weights from the equations of the cells themselves, so that jumps of coefficients are met.

A cell between two coarse ones takes from them what its equation says when everything across the line between them is
summed up; a cell between four, when everything across the plane is; a cell between eight takes what its own equation
says, given the values of all cells around. Sources: J. E. Dendy, Black box multigrid, J. Comput. Phys. 48 (1982)
366-386; Two multigrid methods for three-dimensional problems with discontinuous and anisotropic coefficients, SIAM J.
Sci. Stat. Comput. 8 (1987) 673-685.
"""

import numpy as np

from sparsedp.solvers.multigrid import loops
from sparsedp.solvers.multigrid.loops import steps_around

__all__ = ["Transfer", "interpolated"]

WEAK = 1e-10  # a cell held by less than this share of its diagonal is not interpolated


class Transfer:
    """Interpolation from a coarse grid, and restriction, its transpose.

    Parameters
    ----------
    fine, coarse : Layout
    weights : array
        For each of the steps around a coarse cell a field of coarse cells: their weights on the fine cells there.
    """

    def __init__(self, fine, coarse, weights):
        self.fine, self.coarse, self.weights = fine, coarse, weights
        self.pitches = np.array(steps_around(fine.dim)) @ fine.pitch

    def restrict(self, r, out):
        """out = P^T r; r has its ghost cells filled."""
        self.coarse.run(loops.restrict, self.weights, r, out, self.pitches, self.fine.sizes, self.coarse.sizes)
        return out

    def prolong(self, e, x):
        """x += P e; e has its ghost cells filled."""
        self.fine.run(loops.prolong, self.weights, e, x, self.fine.sizes, self.coarse.sizes)
        return x


def interpolated(level):
    """Level -> the weights of `Transfer`; those in ghost cells are seen from where the cell is repeated."""
    layout, coarse = level.layout, level.layout.coarse()
    odd = layout.zeros(layout.dim, dtype=bool)  # around the end of a periodic axis of odd length two cells are even
    layout.cells(odd)[...] = np.indices(layout.shape) % 2
    layout.wrap(odd)
    steps = steps_around(layout.dim)
    weights, number = coarse.zeros(len(steps)), {step: m for m, step in enumerate(steps)}
    views, done = coarse.cells(weights), {(0,) * layout.dim}
    views[len(steps) // 2] = 1.0
    for side in sorted(steps, key=np.count_nonzero)[1:]:
        total, weight = layout.cells(level.extra, side, 2).copy(), views[number[side]]
        for step, link in level.around.items():
            offset = tuple(d * abs(s) for d, s in zip(step, side))  # links along even axes are summed up
            near = tuple(s + d for s, d in zip(side, offset))
            share = layout.cells(link, side, 2) if any(offset) else 0.0
            total += share
            if near in done and near != side:
                weight += share * views[number[near]]
        kind = np.array(side, bool).reshape(-1, *(1,) * layout.dim)
        held = np.all(layout.cells(odd, side, 2) == kind, axis=0)
        held &= total > WEAK * layout.cells(level.root, side, 2) ** 2
        weight *= np.divide(1.0, total, out=np.zeros_like(total), where=held)
        done.add(side)
    coarse.wrap(weights)
    for axis, (n, ghosts, m) in enumerate(zip(layout.shape, coarse.before, coarse.shape)):
        if layout.periodic[axis] and n % 2:  # the first coarse cell is one fine cell behind the last one, not two
            lines = weights.reshape(*(3,) * layout.dim, *coarse.padded)
            lines = np.moveaxis(lines, (axis, layout.dim + axis), (0, 1))
            lines[:2, ghosts + m], lines[2, ghosts + m] = lines[1:, ghosts], 0.0
            lines[1:, ghosts - 1], lines[0, ghosts - 1] = lines[:2, ghosts + m - 1], 0.0
    return weights
