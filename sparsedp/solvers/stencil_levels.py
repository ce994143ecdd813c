"""The levels of the structured multigrid: coarsening, scaling to a unit diagonal, packing for the kernels."""

from itertools import product
from math import prod
from typing import NamedTuple

import numpy as np

from sparsedp.kernels import multigrid_pack as pack
from sparsedp.kernels import multigrid_setup, multigrid_setup3d
from sparsedp.kernels.multigrid_cycle import AGAIN, DENSE, DOWN, SUM, UP
from sparsedp.kernels.multigrid_diagonal import diagonal
from sparsedp.kernels.multigrid_pack import packed, padded, repeat, width
from sparsedp.solvers.stencil_coarsest import Natural, dense_inverse, merged, own_steps, steps
from sparsedp.solvers.stencil_free import free_below, without_negative

__all__ = ["Coarse", "Fine", "Levels", "Size", "half_shape"]

TWICE = 1  # in 2-D a second visit to a sixteenth of the cells takes a fifth of the iterations off
STRETCH = {2: 1.0, 3: 1.08}  # of the correction of the finest level: in 3-D it does what a second visit would
COARSEST = 100  # cells that are solved by a dense matrix
WEAK = 0.1  # a cell is weak along an axis that holds it with less than this share of another one
EXAMINED = 1000  # cells of the smallest level that is examined


def half_shape(shape):
    """Shape of the next level."""
    return tuple((n + 1) // 2 for n in shape)


def deep(shape):
    """Shape in 2-D or 3-D -> (n0, n1, n2)."""
    return (shape[0], 1, shape[1]) if len(shape) == 2 else tuple(shape)


def schedule(count, dim):
    """What the cycle does, on which coarse level: a V-cycle; in 2-D with two visits to the levels from TWICE on."""
    done = [(DENSE, count - 1)]
    for k in range(count - 2, -1, -1):
        done = [(DOWN, k), *done, (UP, k)]
        if k == TWICE and dim == 2:
            done = [*done, (AGAIN, k), *done, (SUM, k)]
    return np.array(done)


class Fine(NamedTuple):
    """What the passes over the finest level need."""

    shape: tuple
    periodic: tuple
    half: int
    links: np.ndarray
    light: np.ndarray
    scale: np.ndarray
    weights: np.ndarray
    starts: np.ndarray


class Coarse(NamedTuple):
    """What `kernels.multigrid_cycle.cycle` needs, in its order."""

    schedule: np.ndarray
    levels: np.ndarray
    x: np.ndarray
    b: np.ndarray
    r: np.ndarray
    kept: np.ndarray
    links: np.ndarray
    weights: np.ndarray
    starts: np.ndarray
    natural: np.ndarray
    around: int
    matrix: np.ndarray
    vector: np.ndarray


class Size(NamedTuple):
    """How the scaled residual r measures in the user's cells: factor * gauge * r, for A and for its transpose."""

    gauge: tuple
    factor: tuple
    exponent: tuple
    norm: float


class Levels:
    """All levels of a matrix.

    Parameters
    ----------
    finest : Natural
    widths : three arrays
        Their outer product is the volume of each cell, 0 where there is none of the user's.
    coarsenings : int
    dtype : float32 or float64
        Type of the cycle.
    unit : float
        What the user's matrix was multiplied with.

    Attributes
    ----------
    fine, coarse, size
    words : str
    """

    def __init__(self, finest, widths, coarsenings, dtype, unit=1.0):
        self.dim, self.dtype = len(finest.shape), dtype
        self.setup = multigrid_setup if self.dim == 2 else multigrid_setup3d
        self.shapes = [finest.shape, half_shape(finest.shape)]
        while len(self.shapes) <= coarsenings:
            self.shapes.append(half_shape(self.shapes[-1]))
        self.table, self.parts = self._allocate(finest.periodic)
        self.weak_share = 0.0  # largest share of cells that are held much weaker along one axis than another
        scale, root = self._scales(finest, False, widths[:: 4 - self.dim])
        self.size = self._size(self._deep(root), widths, unit)
        fine = self._finest(finest, scale)
        level = finest
        for number in range(len(self.shapes) - 1):
            target = (fine.weights, fine.starts) if number == 0 else self._weights_of(number - 1)
            level, scale, root = self._next(level, scale, root, number, target)
        self.fine = fine
        dense = dense_inverse(level, scale)
        rest = dict(around=len(steps(self.dim, True)) // 3, matrix=dense, vector=np.zeros(len(dense)))
        self.coarse = Coarse(schedule(len(self.shapes) - 1, self.dim), self.table, **rest, **self.parts)
        first, last = (" x ".join(map(str, shape)) for shape in (self.shapes[0], self.shapes[-1]))
        self.words = f"{len(self.shapes)} levels, {first} to {last}"

    def _flags(self, periodic):
        return (periodic[0], False, periodic[1]) if self.dim == 2 else tuple(periodic)

    def _deep(self, array):
        """Natural array -> 3-D."""
        return np.expand_dims(array, -2) if self.dim == 2 else array

    # ------------------------------------------------------------ sizes

    def _starts(self, out, shape, nine):
        """Where the weights of each row begin -> how many there are."""
        n0, n1, _ = deep(shape)
        i, j = np.arange(n0)[:, None] & 1, np.arange(n1) & 1
        corners = (1 + i) * (1 + j)
        if nine:
            counts = corners * np.where((i == 1) & ((j == 1) | (self.dim == 2)), 1, 3)
        else:
            counts = corners * (1 + ((i + j) & 1))
        ends = np.cumsum(counts.reshape(-1))
        out[1:] = ends - counts.reshape(-1)
        return int(ends[-1])

    def _allocate(self, periodic):
        """The table of the coarse levels, and zeros for all of them together."""
        directions = len(steps(self.dim, True))
        table, all_starts = np.zeros((len(self.shapes) - 1, 15), np.int64), []
        vectors = weights = starts = natural = 0
        for row, shape in zip(table, self.shapes[1:]):
            n0, n1, n2 = deep(shape)
            rows, w, wide = 1 + n0 * n1, width((n2 + 1) // 2), width(n2, split=False)
            own = np.zeros(rows, np.int64)
            count = self._starts(own, shape, True)
            row[:11] = n0, n1, n2, rows, w, vectors, weights, starts, natural, wide, count
            row[11:14] = self._flags([flag and n > 1 for flag, n in zip(periodic, shape)])
            row[14] = directions * vectors
            all_starts.append(own)
            vectors, weights = vectors + 2 * rows * w, weights + count * w
            starts, natural = starts + rows, natural + rows * wide
        sizes = dict.fromkeys(("x", "b", "r", "kept"), vectors)
        sizes |= dict(links=directions * vectors, weights=weights, natural=natural)
        parts = {name: packed(size, dtype=self.dtype) for name, size in sizes.items()}
        parts["starts"] = np.concatenate(all_starts)
        return table, parts

    def _weights_of(self, k):
        row = self.table[k]
        flat = self.parts["weights"][row[6] : row[6] + row[10] * row[4]]
        return flat.reshape(row[10], row[4]), self.parts["starts"][row[7] : row[7] + row[3]]

    def _size(self, root, widths, unit):
        """Where all volumes are equal, A and its transpose have one gauge."""
        transposed = self._gauge(root, widths[2].size)
        largest = [w.max(initial=0.0) for w in widths]
        if all(np.all((w == top) | (w == 0)) for w, top in zip(widths, largest)):
            top, volume = float(transposed.max(initial=0.0)) or 1.0, float(np.prod(largest))
            gauges, factors, norm = (transposed, transposed), [top / volume, top], 2 * top**2 / volume
        else:
            volumes = self._deep(padded(self.shapes[0]))
            lead = self.dim - 2
            filled = (np.where(w > 0, w, np.minimum(np.roll(w, 1), np.roll(w, -1))) for w in widths)
            volumes[1:-2, lead : volumes.shape[1] - 2 * lead, 1:-2] = np.einsum("i,j,k->ijk", *filled)
            real = np.divide(1.0, volumes, out=np.zeros_like(volumes), where=volumes > 0)
            gauges = self._gauge(root * real, widths[2].size), transposed
            factors = [float(gauge.max(initial=0.0)) or 1.0 for gauge in gauges]
            norm = 2.0 * float(np.max(root**2 * real, initial=0.0))
        for gauge in {id(gauge): gauge for gauge in gauges}.values():
            gauge /= gauge.max(initial=0.0) or 1.0
        gauges, factors = tuple(map(self._narrow, gauges)), [factor / unit for factor in factors]
        return Size(gauges, tuple(factors), tuple(-int(np.frexp(factor)[1]) for factor in factors), norm / unit)

    def _gauge(self, values, count):
        shape = values.shape[0] - 3, values.shape[1] - 3 * (self.dim - 2), count
        out = packed(1 + shape[0] * shape[1], width((count + 1) // 2))
        pack.pack_red(out, values, shape, self.dim - 2)
        return out

    def _narrow(self, array):
        if array.dtype == self.dtype:
            return array
        out = packed(*array.shape, dtype=self.dtype)
        out[...] = array
        return out

    # ------------------------------------------------------------ levels

    def _scales(self, level, nine, widths=()):
        """One over the root of the diagonal, and the root; 0 where there is no unknown.

        Cells of width 0 (see `Spread`) are linked along that axis only, which slows nothing down: they are not weak.
        """
        scale, root = padded(level.shape), padded(level.shape)
        arrays = map(self._deep, (level.links, level.extra, scale, root))
        links, *cells = arrays
        weak = diagonal(links, np.array(steps(self.dim, nine)), *cells, WEAK, self.dim - 2)
        for axis, w in enumerate(widths):
            weak -= np.count_nonzero(np.compress(w == 0, root[pack.inside(level.shape)], axis))
        if prod(level.shape) >= EXAMINED:
            self.weak_share = max(self.weak_share, weak / prod(level.shape))
        return repeat(scale, level.shape, level.periodic), root

    def _finest(self, level, scale):
        """The finest level but for its weights."""
        n0, n1, n2 = shape = deep(level.shape)
        half, flags = (n2 + 1) // 2, self._flags(level.periodic)
        links = packed(2 * self.dim, 1 + n0 * n1, width(half))
        for m, (step, a) in enumerate(zip(steps(self.dim, False), level.links)):
            pack.pack_fine_links(
                links[2 * m], links[2 * m + 1], self._deep(a), self._deep(scale), step, shape, flags, self.dim - 2
            )
        light = self._narrow(links)
        starts = np.zeros(1 + n0 * n1, np.int64)
        weights = packed(self._starts(starts, level.shape, False), width(half), dtype=self.dtype)
        return Fine(shape, flags, half, links, light, self._deep(scale), weights, starts)

    def _next(self, level, scale, root, number, target):
        """Level -> the next one with its scales; links and weights are packed."""
        weights = self.setup.weights(level.links, level.extra, scale, root, level.shape, level.periodic, number > 0)
        shape = half_shape(level.shape)
        links, extra = padded(shape, len(steps(self.dim, True))), padded(shape)
        self.setup.coarsen(level.links, level.extra, weights, links, extra, level.periodic, number > 0)
        free = free_below(level, weights, root, number == 0)
        without_negative(links, extra, free, own_steps(self.dim, True))
        coarse = merged(Natural(shape, level.periodic, links, extra, free))
        coarse_scale, coarse_root = self._scales(coarse, True)
        out, starts = target
        self._pack_weights(out, starts, weights, coarse_scale, root, level, number > 0)
        self._pack_links(coarse, coarse_scale, self.table[number])
        return coarse, coarse_scale, coarse_root

    def _pack_links(self, level, scale, row):
        first, size = row[14], 2 * row[3] * row[4]
        for m, (step, a) in enumerate(zip(steps(self.dim, True), level.links)):
            out = self.parts["links"][first + m * size : first + (m + 1) * size].reshape(row[3], 2, row[4])
            flags = self._flags(level.periodic)
            pack.pack_coarse_links(out, self._deep(a), self._deep(scale), step, deep(level.shape), flags, self.dim - 2)

    def _pack_weights(self, target, starts, weights, coarse, root, level, nine):
        shape, flags = deep(level.shape), self._flags(level.periodic)
        coarse, root = self._deep(coarse), self._deep(root)
        coarse = coarse if nine or STRETCH[self.dim] == 1.0 else coarse * STRETCH[self.dim] ** 0.5  # there and back
        groups = list(product((0, 1), (0,) if self.dim == 2 else (0, 1)))
        for group in groups:
            final = group == groups[-1]
            for column in ([0] if final else [0, 1]) if nine else [sum(group) & 1]:
                stride = (1 if final else 3) if nine else 1 + column
                kind = (*group, column) if self.dim == 3 else (group[0], column)
                for number, corner in enumerate(product(*(range(1 + a) for a in (*group, column)))):
                    slot = number // (1 + column) * stride + corner[2] + (column if nine else 0)
                    weight = self._deep(weights[kind][number])
                    pack.pack_weights(
                        target, starts, slot, weight, coarse, root, group, corner, column, shape, flags, self.dim - 2
                    )
