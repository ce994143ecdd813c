"""Which cells of the coarse levels are part of a singular component: one where nothing is left of the diagonal.

A coarse cell of the second level and below can stand for fine cells around it without having one of its own: the
links across a corner give it weights. So the flags follow the weights; only on the finest level, whose links
run along the axes, a coarse cell with weights is linked to its own fine cell, and the flag is that of this cell.
"""

from itertools import product

import numpy as np

from sparsedp.kernels.multigrid_pack import inside

__all__ = ["free_below", "without_negative"]

ROUNDING = 1e-10  # share of the links of a cell below which an extra is rounding


def free_below(level, weights, root, first):
    """Level, its weights, the root of its diagonal -> flags of the next level, bool array.

    A coarse cell is free when all it stands for are; with one that something holds, it may be held itself.
    """
    if first or level.free.all() or not level.free.any():
        return level.free[(slice(None, None, 2),) * level.free.ndim]
    unknown = root[inside(level.shape)] > 0.0
    coarse = tuple((n + 1) // 2 for n in level.shape)
    free, held = (_carried(flags & unknown, weights, coarse, level.periodic) for flags in (level.free, ~level.free))
    return free & ~held


def _carried(flags, weights, coarse, periodic):
    """Whether a coarse cell has a weight in a fine cell that is flagged."""
    found = np.zeros(coarse, bool)
    for kind in product((0, 1), repeat=flags.ndim):
        own = flags[tuple(slice(odd, None, 2) for odd in kind)]
        for weight, corner in zip(weights[kind], product(*(range(1 + odd) for odd in kind)), strict=False):
            used = own & (weight[inside(own.shape)] != 0.0)
            index = [
                np.arange(n) if not step else (np.arange(n) + 1) % whole if flag else np.arange(n) + 1
                for n, whole, step, flag in zip(own.shape, coarse, corner, periodic)
            ]
            there = [at < whole for at, whole in zip(index, coarse)]
            place = np.ix_(*(at[keep] for at, keep in zip(index, there)))
            found[place] |= used[np.ix_(*there)]
    return found


def without_negative(links, extra, free, known):
    """Coarse links, extras and flags: no link below 0 at a free cell that loses an extra of its own.

    A fine cell beside an obstacle that cannot be interpolated along its axis has no weights, and the constant is
    then not carried exactly: Galerkin's product has an extra where the matrix has none. It is left out, so that the
    coarse matrix has the same null vector; with links >= 0 around it, it stays without negative eigenvalues.
    """
    own = inside(free.shape)
    lost = np.zeros(extra.shape, bool)
    lost[own] = free & (np.abs(extra[own]) > ROUNDING * np.abs(links[(slice(None), *own)]).sum(axis=0))
    if not lost.any():
        return
    for step, link in zip(known, links, strict=True):
        there = tuple(slice(1 + d, 1 + d + n) for d, n in zip(step, free.shape, strict=True))
        link[own][(link[own] < 0.0) & (lost[own] | lost[there])] = 0.0
