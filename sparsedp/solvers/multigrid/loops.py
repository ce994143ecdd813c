"""Compiled loops of the structured multigrid over long rows; see `layout` for the order of the cells.

A field is an array (colours, size). A sum over neighbours is written down in a table; a row of it says which row of an
array of coefficients, shifted by how much, times which row of a field, shifted by how much. Tables have an even number
of rows, so that sums go two products at a time. `sizes` are those of `Layout`, `start` and `stop` are planes; threads
have planes of their own. Sums are kept plane by plane: the bits are the same for every number of threads.

On the finest level cells are red or black, like a chess board; red ones have an even sum of indices. With a unit
diagonal A = 1 - c, and c links cells of different colours only, so that the red cells alone have the equation
(1 - c c) x = b_red + c b_black: half of the numbers. A red-black sweep from zero is then z = r, and its residual c c r.
The cycle goes further, z = over r, which leaves (1 - over) r + over c c r: of rough fields c c leaves between 0 and 1/4
(3-D: 4/9), and with over = 1.2 that is at most 1/5 (1/3) in size. Source: I. Yavneh, On red-black SOR smoothing in
multigrid, SIAM J. Sci. Comput. 17 (1996) 180-192.

On the others a cell is linked to all cells around, and a colour is relaxed at a time. The first sweep starts from zero,
so it reads colours of lower numbers only, and its residual those of higher numbers. The last colour is relaxed last
going down and first going up: it has no residual, needs no correction, and no weights.
"""

import numpy as np
from numba import njit

from sparsedp.kernels.team import kernel
from sparsedp.solvers.multigrid.layout import GHOST

__all__ = ["advance", "couple", "galerkin", "image", "smooth", "update", "visit"]

CHUNK, MOST = 512, 9  # coarse cells that are linked together, and what a link of the level above adds to
TILE = 4096  # cells of a colour that are worked on together: what is written is in cache for what follows
SWEEP, RESIDUAL, COLLECT, PROLONG, RELAX, NATURAL, AGAIN = range(7)  # tasks of `visit`
FAST = {"reassoc", "contract", "nsz"}  # a sum may be taken in any order; NaN and infinity stay what they are

inner = njit(nogil=True, error_model="numpy", cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)


# ---- rows ----------------------------------------------------------------------------------------------------------


@inner
def copy(out, a):
    for k in range(out.size):
        out[k] = a[k]


@inner
def clear(out):
    for k in range(out.size):
        out[k] = 0.0


@inner
def add_two(out, a, x, b, y):
    """out += a x + b y."""
    for k in range(out.size):
        out[k] += a[k] * x[k] + b[k] * y[k]


@inner
def add_products(out, table, c, x, at, place):
    """out += the sum of a table, `at` being the place of `out` in the rows of c, `place` in those of x."""
    n = out.size
    for m in range(0, table.shape[0], 2):
        a, i, u, k = table[m]
        b, j, v, l = table[m + 1]
        one, other = c[a, at + i : at + i + n], c[b, at + j : at + j + n]
        add_two(out, one, x[u, place + k : place + k + n], other, x[v, place + l : place + l + n])


@inner
def ghosts(row, place, planes, sizes, keep):
    """Ghost cells of planes along periodic axes 1 and 2: what is at the other end, or (not `keep`) 0."""
    plane, width, rows, _, h1, h2, _, around, along = sizes
    for first in range(place, place + planes * plane, plane):
        if around:
            last = first + h1 * width
            for k in range(width):
                row[first + k] = row[last + k] if keep else 0.0
                row[last + width + k] = row[first + width + k] if keep else 0.0
        if along:
            for j in range(first, first + rows * width, width):
                row[j] = row[j + h2] if keep else 0.0
                row[j + h2 + 1] = row[j + 1] if keep else 0.0


@inner
def ghost_planes(row, start, stop, sizes):
    """Two planes beyond each end of a periodic axis 0, by who has those at the other end."""
    plane, n = sizes[0], sizes[3]
    for g in (-2, -1, n, n + 1):
        there = g % n
        if sizes[6] and start <= there < stop:
            copy(row[(GHOST + g) * plane : (GHOST + g + 1) * plane], row[(GHOST + there) * plane :])


# ---- conjugate gradients on the red cells --------------------------------------------------------------------------


@inner
def sum_around(out, tables, c, x, at, place, there, n):
    """out = c x for all colours. Where rows begin: `at` in c, `place` in x, `there` in out."""
    for q in range(out.shape[0]):
        for k in range(0, n, TILE):
            row = out[q, there + k : there + min(k + TILE, n)]
            clear(row)
            add_products(row, tables[q], c, x, at + k, place + k)


def chess(c, red, given, out, to_black, to_red, sizes, sums, own, share, rest, start, stop):
    """out = own red + share c c red + rest given; given . out to sums.

    The black field c red is made one plane ahead, in a window that begins two planes before `first`.
    """
    plane, kind = sizes[0], out.dtype.type
    step, f, g, h = max(4, TILE // plane), kind(own), kind(share), kind(rest)
    black = np.zeros((red.shape[0], (step + 4) * plane), out.dtype)
    for first in range(start, stop, step):
        last, begin = min(first + step, stop), first - 1
        if first > start:
            begin = first + 1
            for q in range(black.shape[0]):
                copy(black[q, plane : 3 * plane], black[q, (step + 1) * plane :])
        at, there = (GHOST + begin) * plane, (begin - first + 2) * plane
        sum_around(black, to_black, c, red, at, at, there, (last + 1 - begin) * plane)
        for q in range(black.shape[0]):
            ghosts(black[q], there, last + 1 - begin, sizes, True)
        at, n = (GHOST + first) * plane, (last - first) * plane
        sum_around(out, to_red, c, black, at, 2 * plane, at, n)
        for q in range(red.shape[0]):
            row, x, y = out[q, at : at + n], red[q, at : at + n], given[q, at : at + n]
            for k in range(n):
                row[k] = f * x[k] + g * row[k] + h * kind(y[k])
            ghosts(out[q], at, last - first, sizes, False)
        for p in range(first, last):
            at, sums[p] = (GHOST + p) * plane, 0.0
            for q in range(red.shape[0]):
                sums[p] += product(out[q, at : at + plane], given[q, at : at + plane])
        for q in range(red.shape[0]):
            ghosts(out[q], (GHOST + first) * plane, last - first, sizes, True)
    for q in range(red.shape[0]):
        ghost_planes(out[q], start, stop, sizes)


@njit(nogil=True, error_model="numpy", cache=True, fastmath=FAST, no_cfunc_wrapper=True)
def product(a, b):
    """The scalar product of two rows."""
    total = 0.0
    for k in range(a.size):
        total += a[k] * b[k]
    return total


TYPES = "index3 index3 index1 write1 real real real"
image = kernel("read2 ~write2 ~write2 write2 " + TYPES)(chess)  # in double precision
smooth = kernel("~read2 ~write2 write2 ~write2 " + TYPES)(chess)  # in that of the cycle


@kernel("write2 ~write2 ~write2 ~write2 index1 real real")
def advance(x, new, old, z, sizes, alpha, beta, start, stop):
    """x += alpha old; new = z + beta old."""
    at, end = (GHOST + start) * sizes[0], (GHOST + stop) * sizes[0]
    for q in range(x.shape[0]):
        solution, row, past, given = x[q, at:end], new[q, at:end], old[q, at:end], z[q, at:end]
        for k in range(end - at):
            solution[k] += alpha * past[k]
            row[k] = given[k] + beta * past[k]
        ghost_planes(new[q], start, stop, sizes)


@kernel("write2 write2 ~write2 ~read2 index1 write1 real real", fastmath=FAST)
def update(r, q, red, gauge, sizes, sums, alpha, over, start, stop):
    """r -= alpha q; red = over r; the sum of (gauge r)^2 to sums."""
    plane = sizes[0]
    for g in range(start, stop):
        at, total = (GHOST + g) * plane, 0.0
        for m in range(r.shape[0]):
            row, change = r[m, at : at + plane], q[m, at : at + plane]
            light, weight = red[m, at : at + plane], gauge[m, at : at + plane]
            for k in range(plane):
                value = row[k] - alpha * change[k]
                row[k] = value
                light[k] = over * value
                total += (weight[k] * value) ** 2
        sums[g] = total
    for m in range(r.shape[0]):
        ghost_planes(red[m], start, stop, sizes)


# ---- levels --------------------------------------------------------------------------------------------------------


@inner
def onto(out, base, table, c, x, start, stop, sizes):
    """out = base + the sum of a table on some planes, ghost cells filled. No base: 0."""
    begin, end = (GHOST + start) * sizes[0], (GHOST + stop) * sizes[0]
    for at in range(begin, end, TILE):
        row = out[at : min(at + TILE, end)]
        if base.size:
            copy(row, base[at:])
        else:
            clear(row)
        add_products(row, table, c, x, at, at)
    ghosts(out, begin, stop - start, sizes, True)
    ghost_planes(out, start, stop, sizes)


@inner
def places(g, j, field, own, natural):
    """Row (g, j) of a grid -> where it begins in natural order; colour of its even cells, and where they begin."""
    lead = (own[2] - own[4]) // 2
    at = (GHOST + g) * natural[0] + (j + (natural[2] - natural[4]) // 2) * natural[1] + 1
    place = (GHOST + g // 2) * own[0] + (j // 2 + lead) * own[1] + 1
    return at, field.shape[0] // 2 * (g & 1) + 2 * (j & 1), place


@inner
def in_order(x, natural, start, stop, sizes, above):
    """The colours of x -> natural order, which has the layout of the level above."""
    end = min(2 * stop, above[3])
    for g in range(2 * start, end):
        for j in range(above[4]):
            at, colour, place = places(g, j, x, sizes, above)
            for p in range(2):
                own, row = x[colour + p, place:], natural[at + p :]
                for k in range((above[5] + 1 - p) // 2):
                    row[2 * k] = own[k]
        ghosts(natural, (GHOST + g) * above[0], 1, above, True)
    ghost_planes(natural, 2 * start, end, above)


@inner
def collect(b, table, weights, r, start, stop, sizes, below):
    """The weighted residuals of the cells around -> the right-hand side of the next level."""
    plane = sizes[0]
    step = max(1, TILE // plane)
    line = np.zeros((2 * GHOST + step) * plane, b.dtype)
    for first in range(start, stop, step):
        last = min(first + step, stop)
        row = line[GHOST * plane : (GHOST + last - first) * plane]
        clear(row)
        add_products(row, table, weights, r, (GHOST + first) * plane, (GHOST + first) * plane)
        for g in range(first, last):
            for j in range(sizes[4]):
                at, colour, place = places(g, j, b, below, sizes)
                for p in range(2):
                    own, out = line[at - first * plane + p :], b[colour + p, place:]
                    for k in range((sizes[5] + 1 - p) // 2):
                        out[k] = own[2 * k]


@kernel(
    "index2 ~read2 ~write2 ~write2 ~write2 ~read2 ~write2 ~write2 ~write2 index2 index2 index2 index2 index2 "
    "index1 index1 index1"
)
def visit(
    tasks,
    c,
    x,
    b,
    r,
    weights,
    coarse,
    b_below,
    natural,
    near,
    ends,
    down,
    up,
    up_ends,
    sizes,
    below,
    above,
    start,
    stop,
):
    """Tasks on a level, rows of (task, colour)."""
    for m in range(tasks.shape[0]):
        task, q = tasks[m]
        first, later, last = ends[q]
        if task == SWEEP:
            onto(x[q], b[q], near[first:later], c, x, start, stop, sizes)
        elif task == RELAX:
            onto(x[q], b[q], near[first:last], c, x, start, stop, sizes)
        elif task == RESIDUAL:
            onto(r[q], x[q, :0], near[later:last], c, x, start, stop, sizes)
        elif task == PROLONG:
            onto(x[q], x[q], up[up_ends[q, 0] : up_ends[q, 1]], weights, coarse, start, stop, sizes)
        elif task == COLLECT:
            collect(b_below, down, weights, r, start, stop, sizes, below)
        elif task == NATURAL:
            in_order(x, natural[0], start, stop, sizes, above)
        else:  # AGAIN: the residual of what the first visit found
            own, out = x[q], b[q]
            for k in range((GHOST + start) * sizes[0], (GHOST + stop) * sizes[0]):
                out[k] -= own[k]
            onto(out, out, near[first:last], c, x, start, stop, sizes)


# ---- set-up --------------------------------------------------------------------------------------------------------


@kernel("read2 write2 write2 index2 index2 index1")
def couple(c, x, out, table, ends, sizes, start, stop):
    """out += sums of a table, for each of its rows; x has its ghost cells filled."""
    end = (GHOST + stop) * sizes[0]
    for at in range((GHOST + start) * sizes[0], end, TILE):
        for q in range(out.shape[0]):
            add_products(out[q, at : min(at + TILE, end)], table[ends[q, 0] : ends[q, 1]], c, x, at, at)


@kernel("read2 read2 write2 index2 index2 index2 index1")
def galerkin(links, weights, out, found, terms, pairs, sizes, start, stop):
    """Add up the links of the next level; see `coarsening` for the tables."""
    d, scaled = np.zeros((MOST, CHUNK)), np.zeros(CHUNK)
    end = (GHOST + stop) * sizes[0]
    for at in range((GHOST + start) * sizes[0], end, CHUNK):
        n = min(CHUNK, end - at)
        for m in range(found.shape[0]):
            link, begin, after, first, last = found[m]
            for t in range(begin, after):
                u, i, v, j = terms[t]
                one, other, row = weights[u, at + i : at + i + n], weights[v, at + j : at + j + n], d[t - begin]
                for k in range(n):
                    row[k] = one[k] - other[k]
            a, before = links[link, at : at + n], -1
            for t in range(first, last):
                p, q, u, i = pairs[t]
                if p != before:
                    one, before = d[p], p
                    for k in range(n):
                        scaled[k] = a[k] * one[k]
                row, other = out[u, at + i : at + i + n], d[q]
                for k in range(n):
                    row[k] -= scaled[k] * other[k]
