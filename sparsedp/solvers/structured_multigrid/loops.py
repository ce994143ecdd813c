"""Compiled loops of the structured multigrid; see `PaddedGrid` for the order of the cells.

Matrices have a unit diagonal, A = I - C. The array `links` holds one field of entries of C for each of the steps
from a cell to a neighbour; C is symmetric, so the entry in the opposite direction is read at the neighbour.
`steps` holds the distances of these neighbours in a flat field, and `sizes` is `PaddedGrid.sizes`. Each loop works on
the planes from `start` to `stop`, so that threads can share it. Sums are stored plane by plane: the result has the
same bits for every number of threads.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

from sparsedp.kernels.team import INNER, kernel

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import DTypeLike, NDArray

    from sparsedp.kernels.team import Kernel

    Reals = NDArray[Any]
    Numbers = NDArray[np.int64]

__all__ = [
    "GHOST_PLANES",
    "PaddedGrid",
    "apply_matrix",
    "neighbour_steps",
    "prolong",
    "restrict",
    "smooth",
    "update_direction",
    "update_solution",
]

GHOST_PLANES = 3  # before and after the planes of the grid; along the other axes there is one ghost cell at each end


def neighbour_steps(dim: int) -> list[tuple[int, ...]]:
    """List the steps from a cell to all cells of the 3^dim block around it; the zero step is in the middle."""
    return list(itertools.product((-1, 0, 1), repeat=dim))


class PaddedGrid:
    """A grid in natural order with ghost cells around it, so that every loop runs along contiguous memory.

    The neighbour of a cell in a given direction lies at the same distance in the flat array for all cells. Hence a
    product with a matrix of 5 to 27 points, in 2-D or in 3-D, is a sum of products of shifted flat arrays.
    Ghost cells hold zeros, or the values of the opposite end of a periodic axis. A *plane* is the set of cells with
    the same first index; in 2-D it is one line.

    Parameters
    ----------
    shape : tuple of 2 or 3 int
    periodic : tuple of bool
    threads : int
        Number of threads of the loops.

    Attributes
    ----------
    ghosts : tuple of int
        Number of ghost cells at each end of each axis.
    padded_shape : tuple of int
        Shape of a field with its ghost cells.
    strides : int64 array, shape (dim,)
        Distance in the flat array of neighbours along each axis.
    sizes : int64 array, shape (9,)
        What the compiled loops need: length of a plane, length of a line, number of planes, lines of a plane, offset
        of the first line in its plane, cells of a line, and for the first, middle and last axis whether it is periodic.
    """

    def __init__(self, shape: Sequence[int], periodic: Sequence[bool], threads: int = 1) -> None:
        self.shape = tuple(shape)
        self.periodic = periodic
        self.dim = len(shape)
        self.threads = threads
        self.ghosts = (GHOST_PLANES,) + (1,) * (self.dim - 1)
        self.padded_shape = tuple(n + 2 * ghosts for n, ghosts in zip(self.shape, self.ghosts))
        line_length = self.padded_shape[-1]
        plane_length = int(np.prod(self.padded_shape[1:]))
        if self.dim == 3:
            self.strides = np.array([plane_length, line_length, 1])
            lines, middle_periodic, first_line = shape[1], periodic[1], line_length
        else:
            self.strides = np.array([plane_length, 1])
            lines, middle_periodic, first_line = 1, False, 0
        lengths = [plane_length, line_length, shape[0], lines, first_line, shape[-1]]
        self.sizes = np.array([*lengths, periodic[0], middle_periodic, periodic[-1]], np.int64)

    def zeros(self, *count: int, dtype: DTypeLike = float) -> NDArray[Any]:
        """Return an array of zeros for one field, or for as many as `count` says."""
        return np.zeros((*count, *self.padded_shape), dtype)

    def cells(self, fields: NDArray[Any], step: Sequence[int] = (0, 0, 0), every: int = 1) -> NDArray[Any]:
        """Return a view of the values at `step` from the cells of the grid, or from each `every`-th cell of an axis."""
        index: list[Any] = [...]
        for ghosts, d, n in zip(self.ghosts, step, self.shape):
            index.append(slice(ghosts + d, ghosts + d + n, every))
        return fields[tuple(index)]

    def coarse(self) -> PaddedGrid:
        """Return the grid of the cells whose indices are all even."""
        return PaddedGrid([(n + 1) // 2 for n in self.shape], self.periodic, self.threads)

    def fill_ghosts(self, fields: NDArray[Any]) -> NDArray[Any]:
        """Fill all ghost cells of fields along periodic axes in place, and return the fields."""
        for axis, (n, ghosts, periodic) in enumerate(zip(self.shape, self.ghosts, self.periodic)):
            if not periodic:
                continue
            planes = np.moveaxis(fields, fields.ndim - self.dim + axis, 0)
            planes[:ghosts] = planes[ghosts + np.arange(-ghosts, 0) % n]
            planes[ghosts + n :] = planes[ghosts + np.arange(ghosts) % n]
        return fields

    def fill_ghosts_compiled(self, field: NDArray[Any]) -> None:
        """Fill those ghost cells of one field of floats that a product with a matrix reads."""
        if any(self.periodic):
            self.run(fill_ghost_cells, self.sizes, field)

    def run(self, loop: Kernel, *arguments: Any) -> None:
        """Run a compiled loop over all planes, in the precision of its second array, on flattened fields."""
        if arguments[1].dtype == np.float32:
            loop = loop.single
        flattened = []
        for argument in arguments:
            if getattr(argument, "ndim", 0) >= self.dim:
                argument = argument.reshape(*argument.shape[: -self.dim], -1)
            flattened.append(argument)
        loop.run(self.shape[0], arguments[0].size, self.threads, *flattened)


TILE = 2048  # cells of a row that `combine` works on together: its sums stay in the first-level cache
WINDOW = 16384  # cells that `smooth` works on together: the first step is in cache when the second one reads it
FAST = {"reassoc", "contract", "nsz"}  # a sum may be taken in any order; NaN and infinity are preserved

helper = njit(cache=True, **INNER)


@helper
def fill_ghost_lines(field: Reals, place: int, planes: int, sizes: Numbers) -> None:
    """Fill the ghost cells of planes along all periodic axes but the first."""
    plane, width, _, lines, lead, n, _, around, along = sizes
    for first in range(place, place + planes * plane, plane):
        if around:
            last = first + lines * width
            for k in range(width):
                field[first + k] = field[last + k]
                field[last + width + k] = field[first + width + k]
        if along:
            for j in range(first, first + plane, width):
                field[j] = field[j + n]
                field[j + n + 1] = field[j + 1]


@njit(cache=True, fastmath=FAST, **INNER)
def plane_products(sums: Reals, a: Reals, b: Reals, start: int, stop: int, sizes: Numbers) -> None:
    """Store the scalar product of the cells of a and b in `sums`, plane by plane."""
    _, width, _, lines, lead, n = sizes[:6]
    for g in range(start, stop):
        first = (GHOST_PLANES + g) * sizes[0] + lead + 1
        total = 0.0
        for at in range(first, first + lines * width, width):
            left, right = a[at : at + n], b[at : at + n]
            for k in range(n):
                total += left[k] * right[k]
        sums[g] = total


@helper
def combine(
    out: Reals,
    out_start: int,
    n: int,
    c: Reals,
    start: int,
    x: Reals,
    x_start: int,
    b: Reals,
    steps: Numbers,
    x_factor: float,
    b_factor: float,
    product_factor: float,
) -> None:
    """Set out = x_factor x + b_factor b + product_factor C x on n cells, C given by the links c.

    The first of these cells has the number `out_start` in out, `start` in c and b, and `x_start` in x.
    """
    odd = steps.size % 2
    for left in range(0, n, TILE):
        row = out[out_start + left : out_start + min(left + TILE, n)]
        f, h = start + left, x_start + left  # numbers of the first cell in c and b, and in x
        for k in range(row.size):  # a slice assignment would not be vectorised
            row[k] = 0.0
        for m in range(odd):
            d = steps[m]
            forward, ahead, backward, behind = c[m, f:], x[h + d :], c[m, f - d :], x[h - d :]
            for k in range(row.size):
                row[k] += forward[k] * ahead[k] + backward[k] * behind[k]
        for m in range(odd, steps.size, 2):  # two at a time: the sums are read and written half as often
            d, e = steps[m], steps[m + 1]
            forward, ahead, backward, behind = c[m, f:], x[h + d :], c[m, f - d :], x[h - d :]
            upward, above, downward, below = c[m + 1, f:], x[h + e :], c[m + 1, f - e :], x[h - e :]
            for k in range(row.size):
                one = forward[k] * ahead[k] + backward[k] * behind[k]
                row[k] += one + (upward[k] * above[k] + downward[k] * below[k])
        x_row, b_row = x[h : h + row.size], b[f : f + row.size]
        for k in range(row.size):
            row[k] = x_factor * x_row[k] + b_factor * b_row[k] + product_factor * row[k]


# ---- the loops -----------------------------------------------------------------------------------------------------
#
# All their arrays belong to the package. Arrays that are only read are declared as "write" too: the functions above
# are compiled for each type of their arguments, and a read-only array is another type.

# ---- conjugate gradients -------------------------------------------------------------------------------------------


@kernel("write1 ~write1 write1 write1 read1 read1 index1 real")
def set_residual(
    x: Reals,
    p: Reals,
    r: Reals,
    q: Reals,
    factors: Reals,
    b: Reals,
    sizes: Numbers,
    scale: float,
    start: int,
    stop: int,
) -> None:
    """Set x, p and q to 0, and r to scale * factors * b; factors and b are fields without ghost cells."""
    plane, width, _, lines, lead, n = sizes[:6]
    for g in range(start, stop):
        at = (GHOST_PLANES + g) * plane
        solution, direction = x[at : at + plane], p[at : at + plane]
        residual, image = r[at : at + plane], q[at : at + plane]
        for k in range(plane):
            solution[k] = 0.0
            direction[k] = 0.0
            residual[k] = 0.0
            image[k] = 0.0
        for j in range(lines):
            first, place = lead + j * width + 1, (g * lines + j) * n
            row, factor, data = residual[first : first + n], factors[place : place + n], b[place : place + n]
            for k in range(n):
                row[k] = scale * (factor[k] * data[k])


@kernel("write1 write1 read1 index1 real")
def copy_solution(out: Reals, x: Reals, factors: Reals, sizes: Numbers, unit: float, start: int, stop: int) -> None:
    """Set out = unit * factors * x; out and factors are fields without ghost cells."""
    plane, width, _, lines, lead, n = sizes[:6]
    for g in range(start, stop):
        for j in range(lines):
            first, place = (GHOST_PLANES + g) * plane + lead + j * width + 1, (g * lines + j) * n
            row, factor, solution = out[place : place + n], factors[place : place + n], x[first : first + n]
            for k in range(n):
                row[k] = unit * (factor[k] * solution[k])


@kernel("write2 ~write1 write1 index1 index1 write1")
def apply_matrix(
    c: Reals, x: Reals, out: Reals, steps: Numbers, sizes: Numbers, sums: Reals, start: int, stop: int
) -> None:
    """Set out = A x, and store the scalar products x . out in `sums`."""
    at = (GHOST_PLANES + start) * sizes[0]
    combine(out, at, (stop - start) * sizes[0], c, at, x, at, x, steps, 1.0, 0.0, -1.0)
    plane_products(sums, x, out, start, stop, sizes)


@kernel("~write1 ~write1 index1 real")
def update_direction(p: Reals, z: Reals, sizes: Numbers, beta: float, start: int, stop: int) -> None:
    """Set p = z + beta p."""
    at, end = (GHOST_PLANES + start) * sizes[0], (GHOST_PLANES + stop) * sizes[0]
    direction, preconditioned = p[at:end], z[at:end]
    for k in range(direction.size):
        direction[k] = preconditioned[k] + beta * direction[k]


@kernel("write1 ~write1 write1 write1 ~write1 ~write1 index1 write1 real", fastmath=FAST)
def update_solution(
    x: Reals,
    p: Reals,
    r: Reals,
    q: Reals,
    rounded: Reals,
    gauge: Reals,
    sizes: Numbers,
    sums: Reals,
    alpha: float,
    start: int,
    stop: int,
) -> None:
    """Set x += alpha p and r -= alpha q; store r in the precision of the cycle, and |gauge r|^2 in `sums`."""
    plane = sizes[0]
    for g in range(start, stop):
        at = (GHOST_PLANES + g) * plane
        total = 0.0
        solution, direction = x[at : at + plane], p[at : at + plane]
        residual, change = r[at : at + plane], q[at : at + plane]
        rounded_residual, weight = rounded[at : at + plane], gauge[at : at + plane]
        for k in range(plane):
            solution[k] += alpha * direction[k]
            value = residual[k] - alpha * change[k]
            residual[k] = value
            rounded_residual[k] = value
            total += (weight[k] * value) ** 2
        sums[g] = total


@kernel("index1 ~write1")
def fill_ghost_cells(sizes: Numbers, field: Reals, start: int, stop: int) -> None:
    """Fill the ghost cells of planes, and the two ghost planes at each end of a periodic first axis."""
    plane, n = sizes[0], sizes[2]
    fill_ghost_lines(field, (GHOST_PLANES + start) * plane, stop - start, sizes)
    for g in (-2, -1, n, n + 1):
        if sizes[6] and start <= g % n < stop:
            for k in range(plane):
                field[(GHOST_PLANES + g) * plane + k] = field[(GHOST_PLANES + g % n) * plane + k]


# ---- levels --------------------------------------------------------------------------------------------------------


@kernel("~write2 ~write1 ~write1 ~write1 ~write1 ~write1 index1 index1 write1")
def smooth(
    c: Reals,
    x: Reals,
    b: Reals,
    between: Reals,
    out: Reals,
    factors: Reals,
    steps: Numbers,
    sizes: Numbers,
    sums: Reals,
    start: int,
    stop: int,
) -> None:
    """Set y = f0 x + f1 b + f2 C x and out = f3 y + f4 b + f5 C y, with the factors f.

    Store the scalar products b . out in `sums` if it has room, and y in `between` if that has.

    y is computed one plane ahead, in a window whose first plane lies two planes before `first`.
    """
    plane = sizes[0]
    step = max(2, WINDOW // plane)
    y = np.empty((step + 4) * plane, out.dtype)
    for k in range(y.size):  # ghost cells must hold finite numbers
        y[k] = 0.0
    for first in range(start, stop, step):
        last, begin = min(first + step, stop), first - 1
        if first > start:
            begin = first + 1
            for k in range(plane, 3 * plane):
                y[k] = y[step * plane + k]
        at, there, planes = (GHOST_PLANES + begin) * plane, (begin - first + 2) * plane, last + 1 - begin
        combine(y, there, planes * plane, c, at, x, at, b, steps, factors[0], factors[1], factors[2])
        fill_ghost_lines(y, there, planes, sizes)
        at, n = (GHOST_PLANES + first) * plane, (last - first) * plane
        for k in range(n if between.size else 0):
            between[at + k] = y[2 * plane + k]
        combine(out, at, n, c, at, y, 2 * plane, b, steps, factors[3], factors[4], factors[5])
        if sums.size:
            plane_products(sums, b, out, first, last, sizes)


@kernel("~write2 ~write1 ~write1 index1 index1 index1")
def restrict(
    weights: Reals, r: Reals, out: Reals, steps: Numbers, fine: Numbers, coarse: Numbers, start: int, stop: int
) -> None:
    """Set out to the weighted sum of r over the fine cells around each coarse cell; `steps` lead to them."""
    n = coarse[5]
    for g in range(start, stop):
        for j in range(coarse[3]):
            at = (GHOST_PLANES + g) * coarse[0] + coarse[4] + j * coarse[1] + 1
            place = (GHOST_PLANES + 2 * g) * fine[0] + fine[4] + 2 * j * fine[1] + 1
            row = out[at : at + n]
            for k in range(n):
                row[k] = 0.0
            for m in range(0, steps.size, 3):  # three neighbours on one fine line
                below, same, above = weights[m, at:], weights[m + 1, at:], weights[m + 2, at:]
                line = r[place + steps[m] :]
                for k in range(n):
                    row[k] += below[k] * line[2 * k] + same[k] * line[2 * k + 1] + above[k] * line[2 * k + 2]


@kernel("~write2 ~write1 ~write1 index1 index1")
def prolong(weights: Reals, e: Reals, x: Reals, fine: Numbers, coarse: Numbers, start: int, stop: int) -> None:
    """Add P e to x, P the transpose of `restrict`; a fine line between two coarse lines or planes takes from both."""
    half, rows = coarse[5], weights.shape[0] // 3
    for g in range(start, stop):
        for j in range(fine[3]):
            first = (GHOST_PLANES + g) * fine[0] + fine[4] + j * fine[1] + 1
            line = x[first : first + 2 * half]  # the last cell may be a ghost cell
            for a in range(g // 2, (g + 1) // 2 + 1):
                for b in range(j // 2, (j + 1) // 2 + 1):
                    at = (GHOST_PLANES + a) * coarse[0] + coarse[4] + b * coarse[1] + 1
                    m = (g - 2 * a + 1) * rows + (j - 2 * b + rows // 9) * 3
                    same, above, below = weights[m + 1, at:], weights[m + 2, at:], weights[m, at + 1 :]
                    current, following = e[at : at + half], e[at + 1 :]
                    for k in range(half):
                        line[2 * k] += same[k] * current[k]
                        line[2 * k + 1] += above[k] * current[k] + below[k] * following[k]
