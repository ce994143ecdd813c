"""The levels of the structured multigrid: a matrix as links between cells, and its scaling to a unit diagonal."""

from math import prod
from typing import Any

import numpy as np

from sparsedp.solvers.multigrid.coarsening import coarsened
from sparsedp.solvers.multigrid.cycle import Coarse, Coarsest, Finest
from sparsedp.solvers.multigrid.interpolation import interpolated
from sparsedp.solvers.multigrid.layout import Layout
from sparsedp.solvers.multigrid.smoother import links_around

__all__ = ["Level", "hierarchy"]

STRETCH = {2: 1.0, 3: 1.08}  # of the correction of the finest level: in 3-D it does what a second visit would
WEAK = 0.1  # a cell is weak along an axis that holds it with less than this share of another one
EXAMINED = 1000  # cells of the smallest level that is examined


class Level:
    """A matrix: x.A x = sum of a (x_i - x_j)^2 over pairs of linked cells + sum of extra x_i^2.

    Parameters
    ----------
    natural : Natural
    finest : bool

    Attributes
    ----------
    near, ends, steps_of
        See `links_around`.
    root, scale : arrays
        Root of the diagonal, and one over it; 0 where there is no unknown.
    weak : int
        Number of cells that are held much weaker along one axis than along another.
    """

    def __init__(self, natural, finest=False):
        self.layout = layout = Layout(natural.shape, natural.periodic)
        count = len(layout.colours)
        self.links = layout.zeros((len(natural.links) + 1) * count)
        links, self.extra = self.links[:-count], self.links[-count:]
        self.finest, self.free = finest, layout.zeros(count, dtype=bool)
        for m, part in enumerate(natural.links):
            layout.split(part, links[m * count : (m + 1) * count], range(count))
        layout.split(np.where(natural.free, 0.0, natural.extra), self.extra, range(count))
        layout.split(natural.free, self.free, range(count))
        layout.wrap(links)
        self.near, self.ends, self.steps = links_around(layout, natural.steps)
        self.root, self.scale = layout.zeros(count), layout.zeros(count)
        self.weak = 0
        for q, (first, _, last) in enumerate(self.ends):
            rows = layout.zeros(1 + layout.dim)
            total, *held = layout.body(rows)
            total += layout.body(self.extra[q])
            for (link, shift, _, _), step in zip(self.near[first:last], self.steps[first:last]):
                a = layout.body(links[link], shift)
                total += a
                for own, d in zip(held, step):
                    if d:
                        own += a
            total, *held = (layout.cells(row, q) for row in rows)
            self.weak += int(np.count_nonzero(np.minimum.reduce(held) < WEAK * np.maximum.reduce(held)))
            root = layout.cells(self.root[q], q)
            np.sqrt(np.maximum(total, 0.0), out=root)
            np.divide(1.0, root, out=layout.cells(self.scale[q], q), where=root > 0.0)
        layout.wrap(self.root), layout.wrap(self.scale)

    def coupling(self, q, at):
        """Row `at` of `near`, of the cells of colour q, in the matrix with a unit diagonal."""
        link, shift, other, far = self.near[at]
        body = self.layout.body
        return body(self.links[link], shift) * body(self.scale[q]) * body(self.scale[other], far)

    def in_order(self, rows):
        """A field in natural order."""
        out = np.empty(self.layout.shape)
        self.layout.merge(rows, range(len(rows)), out)
        return out

    @property
    def weak_share(self):
        """Share of the cells that are held much weaker along one axis than along another; of few cells 0."""
        cells = prod(self.layout.shape)
        return self.weak / cells if cells >= EXAMINED else 0.0


def hierarchy(level, coarsenings, dtype, threads):
    """The finest level -> Finest, which knows the level below it, and so on; largest share of weak cells; words.

    Parameters
    ----------
    level : Level
    coarsenings : int
        Number of levels below.
    dtype : float32 or float64
        Type of the cycle.
    threads : int
    """
    layout, share = level.layout, level.weak_share
    first = Finest(level, dtype, threads)
    above: Any = first
    for number in range(coarsenings):
        weights = interpolated(level)
        natural = coarsened(level, weights)
        stretch = 1.0 if number else STRETCH[layout.dim] ** 0.5  # there and back
        if number + 1 == coarsenings:
            above.connect(level, weights, Coarsest(natural, above.layout, dtype), stretch)
        else:
            held, level = level, Level(natural)
            above.connect(held, weights, Coarse(level, above.layout, dtype, threads), stretch)
            above, share = above.below, max(share, level.weak_share)
    top, bottom = (" x ".join(map(str, shape)) for shape in (layout.shape, natural.shape))
    return first, share, f"{coarsenings + 1} levels, {top} to {bottom}"
