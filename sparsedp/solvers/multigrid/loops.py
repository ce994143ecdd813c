"""Compiled loops of the structured multigrid over long rows; see `Layout` for the order of the cells.

Matrices have a unit diagonal: A = 1 - c, and c has a field of links for each of the `steps`, to the cell at that
distance; the links of the other direction are those of the other cell. `sizes` are those of `Layout`, `start` and
`stop` are planes; threads have planes of their own. Sums are kept plane by plane: the bits are the same for every
number of threads.
"""

import itertools

import numpy as np
from numba import njit

from sparsedp.kernels.team import INNER, kernel

__all__ = ["GHOST", "Layout", "direct", "image", "prolong", "restrict", "smooth", "steps_around", "update"]

GHOST = 3  # ghost planes in front and behind; along the other axes there is one ghost cell


def steps_around(dim):
    """Steps to a cell itself, in the middle of the list, and to all around it."""
    return list(itertools.product((-1, 0, 1), repeat=dim))


class Layout:
    """A grid in natural order with ghost cells around, so that every loop over it is one long row.

    A neighbour of a cell lies at a distance in the flat array that is the same for all cells. So a product with a
    matrix, of 5 points or of 27, in 2-D or in 3-D, is a sum of products of shifted flat arrays, whole planes at a time.
    Ghost cells hold zeros, or what a periodic axis repeats there. A plane is what has the same first index: a row in
    2-D.

    Parameters
    ----------
    shape : tuple of 2 or 3
    periodic : tuple of bool
    threads : int
        Of the loops.

    Attributes
    ----------
    pitch : int64 array
        Distance of neighbours along each axis in the flat array.
    sizes : int64 array
        What the compiled loops need to know: length of a plane, and of a line in it; planes; lines of a plane, and
        where the first begins; cells of a line; which axes are periodic. In 2-D a plane is one line.
    """

    def __init__(self, shape, periodic, threads=1):
        self.shape, self.periodic, self.dim, self.threads = tuple(shape), tuple(periodic), len(shape), threads
        self.before = (GHOST,) + (1,) * (self.dim - 1)  # ghost cells of each axis
        self.padded = tuple(n + 2 * ghosts for n, ghosts in zip(self.shape, self.before))
        plane, width = int(np.prod(self.padded[1:])), self.padded[-1]
        self.pitch = np.array([plane, width, 1] if self.dim == 3 else [plane, 1])
        lines, flag, lead = (shape[1], periodic[1], width) if self.dim == 3 else (1, False, 0)
        self.sizes = np.array(
            [plane, width, shape[0], lines, lead, shape[-1], periodic[0], flag, periodic[-1]], np.int64
        )

    def zeros(self, *count, dtype=float):
        """Fields."""
        return np.zeros((*count, *self.padded), dtype)

    def cells(self, fields, step=(0, 0, 0), every=1):
        """Fields -> their values at a step from the cells of the grid, or from those with even indices. A view."""
        places = zip(self.before, step, self.shape)
        return fields[(..., *(slice(ghosts + d, ghosts + d + n, every) for ghosts, d, n in places))]

    def coarse(self):
        """The layout of the cells with even indices."""
        return Layout([(n + 1) // 2 for n in self.shape], self.periodic, self.threads)

    def wrap(self, fields):
        """Fill the ghost cells of fields along periodic axes. The fields themselves."""
        for axis, (n, ghosts, flag) in enumerate(zip(self.shape, self.before, self.periodic)):
            lines = np.moveaxis(fields, fields.ndim - self.dim + axis, 0)
            if flag:
                lines[:ghosts] = lines[ghosts + np.arange(-ghosts, 0) % n]
                lines[ghosts + n :] = lines[ghosts + np.arange(ghosts) % n]
        return fields

    def fill(self, field):
        """Fill the ghost cells of a field of numbers along periodic axes, as far as a product with a matrix reads."""
        if any(self.periodic):
            self.run(fill, self.sizes, field)

    def run(self, loop, *given):
        """A loop over all planes, in the precision of its second array. Fields are long rows to it."""
        loop = loop.single if given[1].dtype == np.float32 else loop
        rows = (a.reshape(*a.shape[: -self.dim], -1) if getattr(a, "ndim", 0) >= self.dim else a for a in given)
        loop.run(self.shape[0], given[0].size, self.threads, *rows)


TILE, WINDOW = 2048, 16384  # cells that are worked on together: what is written is in cache for what follows
FAST = {"reassoc", "contract", "nsz"}  # a sum may be taken in any order; NaN and infinity stay what they are

helper = njit(cache=True, **INNER)


@helper
def ghosts(field, place, planes, sizes):
    """Fill the ghost cells of planes along periodic axes but the first."""
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
def add_up(sums, a, b, start, stop, sizes):
    """The scalar products of the cells of planes."""
    _, width, _, lines, lead, n = sizes[:6]
    for g in range(start, stop):
        first, total = (GHOST + g) * sizes[0] + lead + 1, 0.0
        for at in range(first, first + lines * width, width):
            left, right = a[at : at + n], b[at : at + n]
            for k in range(n):
                total += left[k] * right[k]
        sums[g] = total


@helper
def combine(out, there, n, c, at, x, place, b, steps, own, rest, share):
    """out = own x + rest b + share c x on n cells. Where they begin: `there` in out, `at` in c and b, `place` in x."""
    odd = steps.size % 2
    for left in range(0, n, TILE):
        row = out[there + left : there + min(left + TILE, n)]
        f, h = at + left, place + left  # the first cell in c and b, and in x
        for k in range(row.size):  # a slice would not be vectorised
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
        given, right = x[h : h + row.size], b[f : f + row.size]
        for k in range(row.size):
            row[k] = own * given[k] + rest * right[k] + share * row[k]


# ---- the loops -----------------------------------------------------------------------------------------------------
#
# Their arrays are the package's own. Those that are only read are declared as written too: the functions above are
# compiled once for each kind of arguments, and an array that may not be written is another kind.

# ---- conjugate gradients -------------------------------------------------------------------------------------------


@kernel("write2 ~write1 write1 index1 index1 write1")
def image(c, x, out, steps, sizes, sums, start, stop):
    """out = A x; x . out to sums."""
    at = (GHOST + start) * sizes[0]
    combine(out, at, (stop - start) * sizes[0], c, at, x, at, x, steps, 1.0, 0.0, -1.0)
    add_up(sums, x, out, start, stop, sizes)


@kernel("~write1 ~write1 index1 real")
def direct(p, z, sizes, beta, start, stop):
    """p = z + beta p."""
    at, end = (GHOST + start) * sizes[0], (GHOST + stop) * sizes[0]
    row, given = p[at:end], z[at:end]
    for k in range(row.size):
        row[k] = given[k] + beta * row[k]


@kernel("write1 ~write1 write1 write1 ~write1 ~write1 index1 write1 real", fastmath=FAST)
def update(x, p, r, q, light, gauge, sizes, sums, alpha, start, stop):
    """x += alpha p; r -= alpha q, and the same in the precision of the cycle; the sum of (gauge r)^2 to sums."""
    plane = sizes[0]
    for g in range(start, stop):
        at, total = (GHOST + g) * plane, 0.0
        solution, direction = x[at : at + plane], p[at : at + plane]
        row, change = r[at : at + plane], q[at : at + plane]
        short, weight = light[at : at + plane], gauge[at : at + plane]
        for k in range(plane):
            solution[k] += alpha * direction[k]
            value = row[k] - alpha * change[k]
            row[k] = value
            short[k] = value
            total += (weight[k] * value) ** 2
        sums[g] = total


@kernel("index1 ~write1")
def fill(sizes, field, start, stop):
    """Fill the ghost cells of planes, and the two planes beyond a periodic axis that repeat them."""
    plane, n = sizes[0], sizes[2]
    ghosts(field, (GHOST + start) * plane, stop - start, sizes)
    for g in (-2, -1, n, n + 1):
        if sizes[6] and start <= g % n < stop:
            for k in range(plane):
                field[(GHOST + g) * plane + k] = field[(GHOST + g % n) * plane + k]


# ---- levels --------------------------------------------------------------------------------------------------------


@kernel("~write2 ~write1 ~write1 ~write1 ~write1 ~write1 index1 index1 write1")
def smooth(c, x, b, between, out, factors, steps, sizes, sums, start, stop):
    """y = f x + g b + h c x, out = f y + g b + h c y with f, g, h twice in factors; b . out to sums if there are any.

    y is made one plane ahead, in a window that begins two planes before `first`, and kept if `between` has room.
    """
    plane = sizes[0]
    step = max(2, WINDOW // plane)
    y = np.empty((step + 4) * plane, out.dtype)
    for k in range(y.size):  # what ghost cells hold must be finite
        y[k] = 0.0
    for first in range(start, stop, step):
        last, begin = min(first + step, stop), first - 1
        if first > start:
            begin = first + 1
            for k in range(plane, 3 * plane):
                y[k] = y[step * plane + k]
        at, there, planes = (GHOST + begin) * plane, (begin - first + 2) * plane, last + 1 - begin
        combine(y, there, planes * plane, c, at, x, at, b, steps, factors[0], factors[1], factors[2])
        ghosts(y, there, planes, sizes)
        at, n = (GHOST + first) * plane, (last - first) * plane
        for k in range(n if between.size else 0):
            between[at + k] = y[2 * plane + k]
        combine(out, at, n, c, at, y, 2 * plane, b, steps, factors[3], factors[4], factors[5])
        if sums.size:
            add_up(sums, b, out, first, last, sizes)


@kernel("~write2 ~write1 ~write1 index1 index1 index1")
def restrict(weights, r, out, steps, fine, coarse, start, stop):
    """out = the weighted sum of the fine cells around each coarse one, which are that many steps away."""
    n = coarse[5]
    for g in range(start, stop):
        for j in range(coarse[3]):
            at = (GHOST + g) * coarse[0] + coarse[4] + j * coarse[1] + 1
            place = (GHOST + 2 * g) * fine[0] + fine[4] + 2 * j * fine[1] + 1
            row = out[at : at + n]
            for k in range(n):
                row[k] = 0.0
            for m in range(0, steps.size, 3):  # those of a fine line
                below, same, above = weights[m, at:], weights[m + 1, at:], weights[m + 2, at:]
                line = r[place + steps[m] :]
                for k in range(n):
                    row[k] += below[k] * line[2 * k] + same[k] * line[2 * k + 1] + above[k] * line[2 * k + 2]


@kernel("~write2 ~write1 ~write1 index1 index1")
def prolong(weights, e, x, fine, coarse, start, stop):
    """x += the transpose of `restrict`. Between two coarse lines, or planes, a line takes from both."""
    half, rows = coarse[5], weights.shape[0] // 3
    for g in range(start, stop):
        for j in range(fine[3]):
            first = (GHOST + g) * fine[0] + fine[4] + j * fine[1] + 1
            line = x[first : first + 2 * half]  # the last may be a ghost cell
            for a in range(g // 2, (g + 1) // 2 + 1):
                for b in range(j // 2, (j + 1) // 2 + 1):
                    at = (GHOST + a) * coarse[0] + coarse[4] + b * coarse[1] + 1
                    m = (g - 2 * a + 1) * rows + (j - 2 * b + rows // 9) * 3
                    same, above, below = weights[m + 1, at:], weights[m + 2, at:], weights[m, at + 1 :]
                    here, there = e[at : at + half], e[at + 1 :]
                    for k in range(half):
                        line[2 * k] += same[k] * here[k]
                        line[2 * k + 1] += above[k] * here[k] + below[k] * there[k]
