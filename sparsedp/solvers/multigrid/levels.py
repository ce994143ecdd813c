"""The levels of the structured multigrid: their matrices, Galerkin's coarse ones, and the cycle through them."""

from itertools import product
from math import prod

import numpy as np

from sparsedp.solvers.contract import norm
from sparsedp.solvers.multigrid import loops
from sparsedp.solvers.multigrid.interpolation import Transfer, interpolated
from sparsedp.solvers.multigrid.layout import axis_steps, steps_around

__all__ = ["COARSEST", "Level", "hierarchy"]

COARSEST = 100  # cells that are solved by a dense matrix
RANK = 1e-14  # eigenvalues below, of a matrix with a unit diagonal, are 0
ROUNDING = 1e-10  # share of the diagonal below which an extra is rounding
SMOOTHED = 4.0  # the smoother damps the eigenvalues from the largest one to this part of it
POWERS, MARGIN = 10, 1.1  # steps of power iteration, and what they may miss: the smoother converges up to 1.25
WEAK = 0.1  # a cell is weak along an axis that holds it with less than this share of another one
EXAMINED = 1000  # cells of the smallest level that is examined


class Level:
    """A matrix: x.A x = sum of a (x_i - x_j)^2 over pairs of linked cells + sum of extra x_i^2.

    Parameters
    ----------
    layout : Layout
    links : array
        For each of the steps a field of a. Ghost cells are filled here.
    extra : field
    free : field of bool
        Cells of singular components, which nothing holds.
    dtype : float32 or float64
        Type of the cycle.
    threads : int

    Attributes
    ----------
    root, scale : fields
        Root of the diagonal, and one over it; 0 where there is no unknown.
    coupling : array
        The links of the matrix scaled to a unit diagonal, in double precision.
    weak : field of bool
        Cells that are held much weaker along one axis than along another.
    """

    def __init__(self, layout, links, extra, free, dtype, threads):
        self.layout, self.dtype, self.threads = layout, dtype, threads
        self.links, self.free = layout.wrap(links), free
        self.steps = axis_steps(layout.dim) if len(links) == layout.dim else steps_around(layout.dim)
        self.pitches = np.array(self.steps) @ layout.pitch
        held, self.root, self.scale = layout.zeros(layout.dim), layout.zeros(), layout.zeros()
        self.extra, middle = np.where(free, 0.0, extra), layout.middle
        total = self.extra.copy()
        for link, step in zip(self.links, self.steps):
            for a in (link.reshape(-1)[middle], layout.beside(link, [-d for d in step])):
                total.reshape(-1)[middle] += a
                for axis in np.flatnonzero(step):
                    held[axis].reshape(-1)[middle] += a
        layout.cells(self.root)[...] = np.sqrt(np.maximum(layout.cells(total), 0.0))
        np.divide(1.0, self.root, out=self.scale, where=self.root > 0.0)
        layout.wrap(self.root), layout.wrap(self.scale)
        self.weak = layout.cells(held.min(axis=0) < WEAK * held.max(axis=0))
        self.coupling = np.zeros((len(links), self.root.size))
        for out, link, step in zip(self.coupling, self.links, self.steps):
            out[middle] = link.reshape(-1)[middle] * self.scale.reshape(-1)[middle] * layout.beside(self.scale, step)
        layout.wrap(self.coupling.reshape(links.shape))

    @property
    def weak_share(self):
        """Share of the cells that are weak; of few cells 0."""
        return np.count_nonzero(self.weak) / self.weak.size if self.weak.size >= EXAMINED else 0.0

    def apply(self, x, out, sums=None):
        """out = A x with a unit diagonal, in double precision; x has its ghost cells filled. x . out to sums."""
        sums = np.zeros(self.layout.shape[0]) if sums is None else sums
        image = loops.image.single if x.dtype == np.float32 else loops.image
        arrays = self.coupling, x.reshape(-1), out.reshape(-1)
        image.run(self.layout.shape[0], x.size, self.threads, *arrays, self.pitches, self.layout.sizes, sums)
        return self.layout.wrap(out)

    def largest(self):
        """The largest eigenvalue of A with a unit diagonal, by power iteration; on the finest level it is at most 2."""
        x, y, size = *self.layout.zeros(2), 2.0
        self.layout.cells(x)[...] = np.random.default_rng(0).standard_normal(self.layout.shape)
        for _ in range(POWERS if len(self.links) > self.layout.dim else 0):
            self.apply(self.layout.wrap(x), y)
            size = MARGIN * norm(self.layout.cells(y).reshape(-1))
            x, y = y * (MARGIN / (size or 1.0)), x
        return size or 1.0

    def coarsened(self):
        """The next level: Galerkin's P^T A P."""
        layout, coarse = self.layout, self.layout.coarse()
        weights, missing = interpolated(self)
        for weight, step in zip(weights, product((-1, 0, 1), repeat=layout.dim)):
            coarse.cells(weight)[...] *= layout.every_second(self.root, (0,) * layout.dim, step)
        coarse.wrap(weights)
        transfer = Transfer(layout, coarse, weights, self.threads)
        # the image of the constant: of its missing part only, so that nothing is added up that cancels
        y = self.scale * self.extra - self.apply(self.root * missing, layout.zeros())
        extra = transfer.restrict(layout.wrap(y), coarse.zeros())
        links = self._probed(transfer)
        inside = [(flags & (self.root > 0.0)).astype(float) for flags in (self.free, ~self.free)]
        sizes = Transfer(layout, coarse, np.abs(weights), self.threads)
        free, tied = (sizes.restrict(flags, coarse.zeros()) > 0.0 for flags in inside)
        free &= ~tied
        _without_negative(coarse, links, extra, free)
        level = Level(coarse, links, extra, free, self.dtype, self.threads)
        return level, Transfer(layout, coarse, (weights * level.scale).astype(self.dtype), self.threads)

    def _probed(self, transfer):
        """The links of P^T A P, from its action on cells that are three apart."""
        layout, coarse = self.layout, transfer.coarse
        lines = [numbered(n, flag) for n, flag in zip(coarse.shape, coarse.periodic)]
        counts = [int(line.max()) + 1 for line in lines]
        colours, steps = np.full(coarse.padded, -1), steps_around(coarse.dim)
        coarse.cells(colours)[...] = np.ravel_multi_index(np.ix_(*lines), counts)
        coarse.wrap(colours)
        links, x, y, z = coarse.zeros(len(steps)), layout.zeros(), layout.zeros(), coarse.zeros()
        flat, middle = links.reshape(len(steps), -1), coarse.middle
        held = layout.wrap(self.extra * self.scale**2)  # extras are summed up by rows: they stay on the diagonal
        for colour in range(prod(counts)):
            x[...] = 0.0
            transfer.prolong((colours == colour).astype(float), x)
            y = self.apply(x, y)
            y -= np.multiply(held, x, out=x)
            transfer.restrict(y, z)
            for link, step in zip(flat, steps):
                np.copyto(link[middle], -z.reshape(-1)[middle], where=coarse.beside(colours, step) == colour)
        for link, step in zip(links, steps):
            around = [n for d, n, flag in zip(step, coarse.shape, coarse.periodic) if d and flag]
            link *= 0.0 if 1 in around else 0.5 ** around.count(2)  # a cell itself; a cell on both sides
        return links


def _without_negative(layout, links, extra, free):
    """No link below 0 at a free cell that loses an extra of its own.

    A fine cell beside an obstacle that cannot be interpolated along its axis has no weights, and the constant is
    then not carried exactly: Galerkin's product has an extra where the matrix has none. It is left out, so that the
    coarse matrix has the same null vector; with links >= 0 around it, it stays without negative eigenvalues.
    """
    lost = layout.wrap(free & (np.abs(extra) > ROUNDING * np.abs(links).sum(axis=0)))
    for link, step in zip(links if lost.any() else (), steps_around(layout.dim)):
        flat = link.reshape(-1)[layout.middle]
        touched = lost.reshape(-1)[layout.middle] | layout.beside(lost, step)
        flat[touched & (flat < 0.0)] = 0.0


def numbered(n, periodic):
    """Numbers for the cells of an axis so that any three in a row differ, around the end of a periodic one too."""
    if not periodic or n % 3 == 0:
        return np.arange(n) % 3
    fours = min(4 * (n % 3), n)
    return np.concatenate([np.arange(fours) % 4, np.arange(n - fours) % 3]) if fours < n else np.arange(n)


class Smoothed:
    """A level in the cycle, with a smoother: Chebyshev's polynomial of degree 2.

    Attributes
    ----------
    b, x : fields
        Right-hand side and solution, with ghost cells filled.
    """

    def __init__(self, level):
        self.layout, self.threads, self.pitches = level.layout, level.threads, level.pitches
        self.coupling = level.coupling.astype(level.dtype, copy=False)
        self.b, self.x, self.r = self.layout.zeros(3, dtype=level.dtype)
        self.sums = np.zeros(self.layout.shape[0])
        middle, radius = (level.largest() / 2.0) * (1.0 + np.array([1.0, -1.0]) / SMOOTHED)
        one, two = 1.0 / (middle + np.array([1.0, -1.0]) * np.sqrt(0.5) * radius)
        # x = two steps of damped Jacobi from zero, of which the first is a number times b; then its residual
        self.down = np.array([(0.0, one + two - one * two, one * two), (-1.0, 1.0, 1.0)], level.dtype)
        self.up = np.array([(1.0 - one, one, one), (1.0 - two, two, two)], level.dtype)

    def _smooth(self, x, between, out, factors):
        smooth = loops.smooth.single if out.dtype == np.float32 else loops.smooth
        arrays = (field.reshape(-1) for field in (x, self.b, between, out))
        tables = factors, self.pitches, self.layout.sizes, self.sums
        smooth.run(self.layout.shape[0], out.size, self.threads, self.coupling, *arrays, *tables)

    def cycle(self):
        """x = what a V-cycle makes of b; b . x to sums."""
        self._smooth(self.b, self.x, self.r, self.down)
        self.layout.wrap(self.x)
        self.transfer.restrict(self.r, self.below.b)
        self.below.cycle()
        self.transfer.prolong(self.below.x, self.x)
        self._smooth(self.x, self.x[:0], self.r, self.up)
        self.x, self.r = self.r, self.x


class Coarsest:
    """The level that is solved by a dense matrix."""

    def __init__(self, level):
        self.layout, cells = level.layout, level.layout.cells
        self.b, self.x = self.layout.zeros(2, dtype=level.dtype)
        columns, unit, image = [], *self.layout.zeros(2)
        for number in np.ndindex(*self.layout.shape):
            cells(unit)[...] = 0.0
            cells(unit)[number] = 1.0
            columns.append(cells(level.apply(self.layout.wrap(unit), image)).flatten())
        values, vectors = np.linalg.eigh(np.array(columns))
        kept = np.abs(values) > RANK  # not the null vectors, nor those of cells whose weights depend on each other
        self.inverse = ((vectors[:, kept] / values[kept]) @ vectors[:, kept].T).astype(level.dtype)

    def cycle(self):
        """x = what solves b."""
        b, x = self.layout.cells(self.b), self.layout.cells(self.x)
        x[...] = (self.inverse * b.reshape(-1)).sum(axis=1).reshape(x.shape)
        self.layout.wrap(self.x)


def hierarchy(level, coarsenings):
    """The finest level, number of those below -> (Smoothed, which knows the level below it, and so on; shapes)."""
    first = above = Smoothed(level)
    shares = [level.weak_share]
    for number in range(coarsenings, 0, -1):
        level, above.transfer = level.coarsened()
        above.below = Smoothed(level) if number > 1 else Coarsest(level)
        above = above.below
        shares.append(level.weak_share)
    top, bottom = (" x ".join(map(str, layout.shape)) for layout in (first.layout, above.layout))
    return first, max(shares), f"{coarsenings + 1} levels, {top} to {bottom}"
