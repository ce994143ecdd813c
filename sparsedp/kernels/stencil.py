"""Compiled loops of the matrix-free operators: tridiagonal sums, a matrix along an axis, fluxes through faces.

A field has three axes; a row lies along the last one. Every loop first takes views of rows and then iterates over them,
so that the compiler can vectorise the inner loops. A value with the coefficient 0 is not read, because 0 * NaN is NaN.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sparsedp.kernels.team import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["across_rows", "along_rows", "kronecker_sum", "through_faces"]

TILE = 1024  # number of values of a row that are processed at a time: they stay in the L1 cache for all diagonals


@kernel("read3 write3 read2 read2 read2 flag real", fastmath={"contract"})  # fused multiply-add
def kronecker_sum(
    u: NDArray,
    out: NDArray,
    far: NDArray,
    middle: NDArray,
    along: NDArray,
    uniform: bool,
    shift: float,
    start: int,
    stop: int,
) -> None:
    """Set out = shift u + sum over a of T_a u, where T_a is tridiagonal and cyclic along axis a.

    `far`, `middle` and `along` hold T_0, T_1 and T_2, each as the rows lower, centre and upper. `uniform` states that
    the entries of T_2 are equal for all cells except the first and the last.
    """
    n0, n1, n = u.shape
    rows = n0 * n1
    last = n - 1
    cells = u.reshape(rows, n)
    totals = out.reshape(rows, n)
    lower = along[0]
    centre = along[1]
    upper = along[2]
    for row in range(start, stop):
        i = row // n1
        k = row % n1
        a = middle[0, k]
        b = middle[2, k]
        c = far[0, i]
        d = far[2, i]
        weight = shift + far[1, i] + middle[1, k]
        line = cells[row]
        result = totals[row]
        # A missing neighbour has the coefficient 0; the row itself is read in its place.
        row_below1 = row
        row_above1 = row
        row_below0 = row
        row_above0 = row
        if a != 0.0:
            row_below1 = row + (k - 1) % n1 - k
        if b != 0.0:
            row_above1 = row + (k + 1) % n1 - k
        if c != 0.0:
            row_below0 = (row - n1) % rows
        if d != 0.0:
            row_above0 = (row + n1) % rows
        below1 = cells[row_below1]
        above1 = cells[row_above1]
        below0 = cells[row_below0]
        above0 = cells[row_above0]
        # On uniform cells three numbers replace three rows of coefficients, which would occupy the cache. In 2-D there
        # are no neighbours along axis 0. There are three loops, because only loops without a branch are vectorised.
        one = min(1, last)
        low = lower[one]
        mid = weight + centre[one]
        high = upper[one]
        if uniform and n0 == 1:
            for j in range(1, last):
                total = mid * line[j] + (low * line[j - 1] + high * line[j + 1])
                result[j] = total + (a * below1[j] + b * above1[j])
        elif uniform:
            for j in range(1, last):
                total = mid * line[j] + (low * line[j - 1] + high * line[j + 1])
                total += c * below0[j] + d * above0[j]
                result[j] = total + (a * below1[j] + b * above1[j])
        else:
            for j in range(1, last):
                total = (weight + centre[j]) * line[j] + (lower[j] * line[j - 1] + upper[j] * line[j + 1])
                if n0 > 1:
                    total += c * below0[j] + d * above0[j]
                result[j] = total + (a * below1[j] + b * above1[j])
        for j in (0, last):
            total = (weight + centre[j]) * line[j] + (a * below1[j] + b * above1[j]) + (c * below0[j] + d * above0[j])
            total += lower[j] * line[(j - 1) % n] if lower[j] != 0.0 else 0.0
            result[j] = total + (upper[j] * line[(j + 1) % n] if upper[j] != 0.0 else 0.0)


@kernel("read3 write3 index1 index1 read1 real flag")
def across_rows(
    u: NDArray,
    out: NDArray,
    indptr: NDArray,
    indices: NDArray,
    data: NDArray,
    scale: float,
    add: bool,
    start: int,
    stop: int,
) -> None:
    """Set out = scale M u or, if `add`, add it, for a sparse M (CSR) along the middle axis.

    `start` and `stop` are a range of rows of `out`.
    """
    lines = out.shape[1]
    for row in range(start, stop):
        i = row // lines
        k = row % lines
        result = out[i, k]
        first = indptr[k]
        last = indptr[k + 1]
        if first == last and not add:
            result[:] = 0.0
        for entry in range(first, last, 2):  # two at a time, because most rows of M have two entries
            more = min(entry + 1, last - 1)
            one = scale * data[entry]
            values = u[i, indices[entry]]
            if more > entry:
                two = scale * data[more]
            else:
                two = 0.0
            others = u[i, indices[more]]
            if entry > first or add:
                for j in range(result.size):
                    result[j] += one * values[j] + two * others[j]
            else:
                for j in range(result.size):
                    result[j] = one * values[j] + two * others[j]


@kernel("read2 write2 index1 index1 index1 read2 real flag")
def along_rows(
    u: NDArray,
    out: NDArray,
    offsets: NDArray,
    first: NDArray,
    last: NDArray,
    values: NDArray,
    scale: float,
    add: bool,
    start: int,
    stop: int,
) -> None:
    """Set out = scale M u or, if `add`, add it, for M along the last axis, stored by diagonals.

    `start` and `stop` are a range of entries of `out`.
    """
    n = out.shape[1]
    for row in range(start // n, -(-stop // n)):
        for left in range(max(start - row * n, 0), min(stop - row * n, n), TILE):
            right = min(left + TILE, stop - row * n, n)
            if not add:
                out[row, left:right] = 0.0
            for d in range(offsets.size):
                a = max(left, first[d])
                b = min(right, last[d])
                if a < b:
                    result = out[row, a:b]
                    weights = values[d, a:b]
                    values_in_row = u[row, a + offsets[d] : b + offsets[d]]
                    for j in range(result.size):
                        result[j] += scale * weights[j] * values_in_row[j]


@kernel("read3 read3 read3 read3 read2 read2 read2 write3 flag")
def through_faces(
    u: NDArray,
    k0: NDArray,
    k1: NDArray,
    k2: NDArray,
    lines0: NDArray,
    lines1: NDArray,
    lines2: NDArray,
    out: NDArray,
    closed: bool,
    start: int,
    stop: int,
) -> None:
    """Set out = L diag(k) R u in one pass, with R from cells to faces and L from faces to cells.

    The array of fluxes on all faces is not stored. The flux through face f, between the cells f - 1 and f, is
    k_f (r_below_f u_(f-1) + r_above_f u_f). It is added to these cells with the factors l_below_f and l_above_f. The
    four rows of `lines` of an axis are r_below, r_above, l_below and l_above, with one more entry than there are cells
    along the axis. k has one value for each face. On a periodic axis the last face is the first one, so that k has as
    many values as there are cells. If `closed`, the flux through faces with k = 0 is 0 even if a cell holds NaN.
    """
    n0, n1, n = u.shape
    cells = u.reshape(n0 * n1, n)
    totals = out.reshape(n0 * n1, n)
    carried = np.empty(n + 1)
    for row in range(start, stop):
        i = row // n1
        k = row % n1
        line = cells[row]
        result = totals[row]
        inside = carried[1:n]
        faces = k2[i, k]
        below = lines2[0, 1:n]
        above = lines2[1, 1:n]
        conduct = faces[1:n]
        ahead = line[1:]
        for f in range(n - 1):
            inside[f] = conduct[f] * (below[f] * line[f] + above[f] * ahead[f])
        for f in (0, n):  # the faces at both ends: walls or, on a periodic axis, the same face
            if lines2[0, f] != 0.0:
                low = lines2[0, f] * line[(f - 1) % n]
            else:
                low = 0.0
            if lines2[1, f] != 0.0:
                high = lines2[1, f] * line[f % n]
            else:
                high = 0.0
            carried[f] = faces[f % faces.size] * (low + high)
        if closed:
            for f in range(faces.size):
                if faces[f] != 0.0:
                    carried[f] = carried[f]
                else:
                    carried[f] = 0.0
            if faces[n % faces.size] != 0.0:
                carried[n] = carried[n]
            else:
                carried[n] = 0.0
        to_below = lines2[2, 1:]
        to_above = lines2[3, :n]
        next_ones = carried[1:]
        for j in range(n):
            result[j] = to_above[j] * carried[j] + to_below[j] * next_ones[j]
        for side in range(4):  # lower and upper face along axis 1, then along axis 0
            upper = side % 2
            if side < 2:
                count = n1
                stride = 1
                line = lines1
            else:
                count = n0
                stride = n1
                line = lines0
            if count == 1:
                continue
            place = row // stride % count
            f = place + upper
            weight = line[3 - upper, f]
            below_f = line[0, f]
            above_f = line[1, f]
            # A missing cell beyond a wall has the coefficient 0; the row itself is read in its place.
            row_low = row
            row_high = row
            if below_f != 0.0:
                row_low = row + ((f - 1) % count - place) * stride
            if above_f != 0.0:
                row_high = row + (f % count - place) * stride
            low = cells[row_low]
            high = cells[row_high]
            if side < 2:
                faces = k1[i, f % k1.shape[1]]
            else:
                faces = k0[f % k0.shape[0], k]
            for j in range(n):
                flux = weight * (faces[j] * (below_f * low[j] + above_f * high[j]))
                result[j] += 0.0 if closed and faces[j] == 0.0 else flux
