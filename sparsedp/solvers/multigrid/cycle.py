"""The levels of the structured multigrid: their matrices, Galerkin's coarse ones, and the cycle through them.

Black-box interpolation: weights from the equations of the cells themselves, so that jumps of coefficients are met.

A cell between two coarse ones takes from them what its equation says when everything across the line between them is
summed up; a cell between four, when everything across the plane is; a cell between eight takes what its own equation
says, given the values of all cells around. Sources: J. E. Dendy, Black box multigrid, J. Comput. Phys. 48 (1982)
366-386; Two multigrid methods for three-dimensional problems with discontinuous and anisotropic coefficients, SIAM J.
Sci. Stat. Comput. 8 (1987) 673-685.
"""

from itertools import product
from math import prod
from typing import Any

import numpy as np
from scipy.sparse.linalg import LinearOperator, eigsh

from sparsedp.solvers.multigrid import loops
from sparsedp.solvers.multigrid.loops import steps_around

__all__ = ["Level", "Transfer", "hierarchy", "interpolated"]

COARSEST = 100  # cells that are solved by a dense matrix
RANK = 1e-14  # eigenvalues below, of a matrix with a unit diagonal, are 0
ROUNDING = 1e-10  # share of the diagonal below which an extra is rounding
CARRIED = 1e-12  # what weights may miss to 1 by rounding
SMOOTHED = 4.0  # the smoother damps the eigenvalues from the largest one to this part of it
NEAR = 2.5  # a bound of the eigenvalues that is good enough; without links below 0 it is at most 2
MARGIN = 1.05  # what Lanczos may miss; the smoother converges up to 1.25
WEAK = 0.1  # a cell is weak along an axis that holds it with less than this share of another one
UNHELD = 1e-10  # a cell held by less than this share of its diagonal is not interpolated
EXAMINED = 1000  # cells of the smallest level that is examined


class Level:
    """A matrix: x.A x = sum of a (x_i - x_j)^2 over pairs of linked cells + sum of extra x_i^2.

    Parameters
    ----------
    layout : Layout
    steps : list of tuples
        To the cells that a cell is linked to, of each pair of opposite ones the step forward.
    links : array
        For each of the steps a field of a. Ghost cells are filled here.
    extra : field
    free : field of bool
        Cells of singular components, which nothing holds.
    dtype : float32 or float64
        Type of the cycle.

    Attributes
    ----------
    around : dict
        Step forward or back -> field of the links there.
    root, scale : fields
        Root of the diagonal, and one over it; 0 where there is no unknown.
    coupling : array
        The links of the matrix scaled to a unit diagonal, in double precision.
    sums : array
        What the last product gave for each plane.
    bound : float
        Of the eigenvalues with a unit diagonal: each row has a disc of Gershgorin.
    weak_share : float
        Share of the cells that are held much weaker along one axis than along another; of few cells 0.
    """

    def __init__(self, layout, steps, links, extra, free, dtype):
        self.layout, self.steps, self.dtype, self.sums = layout, steps, dtype, np.zeros(layout.shape[0])
        self.links, self.free, self.extra = map(layout.wrap, (links, free, np.where(free, 0.0, extra)))
        self.pitches = np.array(steps) @ layout.pitch
        self.around, cells = dict(zip(steps, self.links)), layout.cells
        for step, link in zip(steps, self.links):
            back, other = tuple(-d for d in step), layout.zeros()
            cells(other)[...] = cells(link, back)
            self.around[back] = layout.wrap(other)
        held = [sum(a for step, a in self.around.items() if step[axis]) for axis in range(layout.dim)]
        weak = cells(np.min(held, axis=0) < WEAK * np.max(held, axis=0))
        self.weak_share = np.count_nonzero(weak) / weak.size if weak.size >= EXAMINED else 0.0
        self.root = np.sqrt(np.maximum(sum(self.around.values(), self.extra), 0.0))
        self.scale = np.divide(1.0, self.root, out=layout.zeros(), where=self.root > 0.0)
        self.bound = 1.0 + float(np.max(sum(map(abs, self.around.values())) * self.scale**2))
        self.coupling = layout.zeros(len(steps))
        for out, link, step in zip(cells(self.coupling), self.links, steps):
            out[...] = cells(link) * cells(self.scale) * cells(self.scale, step)
        layout.wrap(self.coupling)

    def apply(self, x, out):
        """out = A x with a unit diagonal, in double precision; x has its ghost cells filled. x . out to sums."""
        self.layout.run(loops.image, self.coupling, x, out, self.pitches, self.layout.sizes, self.sums)
        return out

    def operator(self):
        """A with a unit diagonal, for flat vectors of the cells in natural order."""
        x, y = self.layout.zeros(2)
        size = prod(self.layout.shape)

        def image(vector):
            self.layout.cells(x)[...] = vector.reshape(self.layout.shape)
            return self.layout.cells(self.apply(self.layout.wrap(x), y)).flatten()

        return LinearOperator((size, size), matvec=image, dtype=float)

    def largest(self):
        """An upper bound of the eigenvalues of A with a unit diagonal, not far above them."""
        if self.bound <= NEAR:
            return self.bound
        start = np.random.default_rng(0).standard_normal(prod(self.layout.shape))
        value = eigsh(self.operator(), 1, which="LA", v0=start, tol=MARGIN - 1.0, return_eigenvectors=False)
        return min(self.bound, MARGIN * float(value[0]))

    def coarsened(self):
        """The next level: Galerkin's P^T A P."""
        layout, coarse = self.layout, self.layout.coarse()
        steps, weights = steps_around(layout.dim), interpolated(self)
        forward, links = self._galerkin(coarse, dict(zip(steps, weights)))
        free, tied = (
            sum(
                layout.cells(flags & (self.root > 0.0), step, 2) & (coarse.cells(w) != 0)
                for w, step in zip(weights, steps)
            )
            for flags in (self.free, ~self.free)
        )
        nothing = coarse.zeros(dtype=bool)
        coarse.cells(nothing)[...] = (free > 0) & ~(tied > 0)
        for weight, step in zip(coarse.cells(weights), steps):
            weight *= layout.cells(self.root, step, 2)
        transfer = Transfer(layout, coarse, coarse.wrap(weights))
        # the image of the constant: of what P misses of it only, so that nothing is added up that cancels
        missing = self.root - transfer.prolong(np.ones(coarse.padded), layout.zeros())
        missing[np.abs(missing) <= CARRIED * self.root] = 0.0
        y = self.scale * self.extra - self.apply(layout.wrap(missing), layout.zeros())
        extra = transfer.restrict(layout.wrap(y), coarse.zeros())
        _without_negative(coarse, forward, links, nothing & (np.abs(extra) > ROUNDING * np.abs(links).sum(axis=0)))
        level = Level(coarse, forward, links, extra, nothing, self.dtype)
        return level, Transfer(layout, coarse, (weights * level.scale).astype(self.dtype))

    def _galerkin(self, coarse, weights):
        """The steps and links of P^T A P: for each pair of coarse cells the entries of fine cells around them."""
        steps = steps_around(coarse.dim)
        forward = steps[len(steps) // 2 + 1 :]
        links, entries = coarse.zeros(len(forward)), self.around | {(0,) * coarse.dim: -sum(self.around.values())}
        for out, step in zip(coarse.cells(links), forward):
            if not any(d and (n > 1 or not flag) for d, n, flag in zip(step, coarse.shape, coarse.periodic)):
                continue  # a cell is not linked to itself
            for (side, weight), (there, entry) in product(weights.items(), entries.items()):
                other = tuple(s + d - 2 * t for s, d, t in zip(side, there, step))  # seen from the other coarse cell
                if other in weights:
                    far = coarse.cells(weights[other], step)
                    out += coarse.cells(weight) * self.layout.cells(entry, side, 2) * far
        return forward, links


def _without_negative(layout, steps, links, lost):
    """No link below 0 at a free cell that loses an extra of its own.

    A fine cell beside an obstacle that cannot be interpolated along its axis has no weights, and the constant is
    then not carried exactly: Galerkin's product has an extra where the matrix has none. It is left out, so that the
    coarse matrix has the same null vector; with links >= 0 around it, it stays without negative eigenvalues.
    """
    layout.wrap(lost)
    for link, step in zip(layout.cells(links), steps):
        touched = layout.cells(lost) | layout.cells(lost, step)
        link[touched & (link < 0.0)] = 0.0


# ---- black-box interpolation ----------------------------------------------------------------------------------------


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
        self.coarse.fill(out)
        return out

    def prolong(self, e, x):
        """x += P e; e has its ghost cells filled."""
        self.fine.run(loops.prolong, self.weights, e, x, self.fine.sizes, self.coarse.sizes)
        self.fine.fill(x)
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
        held &= total > UNHELD * layout.cells(level.root, side, 2) ** 2
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


# ---- the cycle ------------------------------------------------------------------------------------------------------


class Smoothed:
    """A level in the cycle, with a smoother: Chebyshev's polynomial of degree 2.

    Attributes
    ----------
    b, x : fields
        Right-hand side and solution, with ghost cells filled.
    """

    transfer: Transfer
    below: Any

    def __init__(self, level):
        self.layout, self.pitches = level.layout, level.pitches
        self.coupling = level.coupling.astype(level.dtype, copy=False)
        self.b, self.x, self.r = self.layout.zeros(3, dtype=level.dtype)
        self.sums = np.zeros(self.layout.shape[0])
        middle, radius = (level.largest() / 2.0) * (1.0 + np.array([1.0, -1.0]) / SMOOTHED)
        one, two = 1.0 / (middle + np.array([1.0, -1.0]) * np.sqrt(0.5) * radius)
        # x = two steps of damped Jacobi from zero, of which the first is a number times b; then its residual
        self.down = np.array([0.0, one + two - one * two, one * two, -1.0, 1.0, 1.0], level.dtype)
        self.up = np.array([1.0 - one, one, one, 1.0 - two, two, two], level.dtype)

    def _smooth(self, x, between, factors, sums):
        fields = x, self.b, between, self.r
        self.layout.run(loops.smooth, self.coupling, *fields, factors, self.pitches, self.layout.sizes, sums)
        self.layout.fill(self.r)

    def cycle(self):
        """x = what a V-cycle makes of b -> b . x."""
        self._smooth(self.b, self.x, self.down, self.sums[:0])
        self.transfer.restrict(self.r, self.below.b)
        self.below.cycle()
        self.transfer.prolong(self.below.x, self.x)
        self._smooth(self.x, self.x[:0], self.up, self.sums)
        self.x, self.r = self.r, self.x
        return float(self.sums.sum())


class Coarsest:
    """The level that is solved by a dense matrix."""

    def __init__(self, level):
        self.layout, operator = level.layout, level.operator()
        self.b, self.x = self.layout.zeros(2, dtype=level.dtype)
        values, vectors = np.linalg.eigh([operator.matvec(unit) for unit in np.eye(operator.shape[0])])
        kept = np.abs(values) > RANK  # not the null vectors, nor those of cells whose weights depend on each other
        self.inverse = ((vectors[:, kept] / values[kept]) @ vectors[:, kept].T).astype(level.dtype)

    def cycle(self):
        """x = what solves b."""
        b, x = self.layout.cells(self.b), self.layout.cells(self.x)
        x[...] = (self.inverse * b.reshape(-1)).sum(axis=1).reshape(x.shape)
        self.layout.wrap(self.x)


def hierarchy(level):
    """The finest level -> (Smoothed, which knows the level below it, and so on; largest share of weak cells; text)."""
    first = above = Smoothed(level)
    levels = [level]
    while len(levels) == 1 or prod(level.layout.shape) > COARSEST:
        level, above.transfer = level.coarsened()
        above.below = Smoothed(level) if prod(level.layout.shape) > COARSEST else Coarsest(level)
        above = above.below
        levels.append(level)
    top, bottom = (" x ".join(map(str, end.layout.shape)) for end in (first, above))
    return first, max(each.weak_share for each in levels), f"{len(levels)} levels, {top} to {bottom}"
