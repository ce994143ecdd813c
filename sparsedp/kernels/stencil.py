"""Compiled loops of the matrix-free operators: three-point sums, a matrix along an axis, differences through faces.

A field has three axes; rows run along the last one. Every loop takes views of rows first and then runs over them:
that is what fills the vector units. What has the coefficient 0 is not read, for 0 times NaN is NaN.
"""

import numpy as np

from sparsedp.kernels.team import kernel

__all__ = ["across_rows", "along_rows", "kronecker_sum", "through_faces"]

TILE = 1024  # numbers of a row that are worked on at a time: all of its diagonals find them in the L1 cache


@kernel("read3 write3 read2 read2 read2 flag real", fastmath={"contract"})  # a product and a sum are one instruction
def kronecker_sum(u, out, far, middle, along, uniform, shift, start, stop):
    """out = shift u + sum of T_a u, T_a tridiagonal and cyclic along axis a: rows lower, centre, upper.

    `uniform`: the rows are the same for all cells but the first and the last of the last axis.
    """
    n0, n1, n = u.shape
    rows, last = n0 * n1, n - 1
    cells, totals = u.reshape(rows, n), out.reshape(rows, n)
    lower, centre, upper = along[0], along[1], along[2]
    for row in range(start, stop):
        i, k = row // n1, row % n1
        a, b, c, d = middle[0, k], middle[2, k], far[0, i], far[2, i]
        weight, here, result = shift + far[1, i] + middle[1, k], cells[row], totals[row]
        # where there is no neighbour the cell itself is read, times 0
        before1 = cells[row + (k - 1) % n1 - k if a != 0.0 else row]
        after1 = cells[row + (k + 1) % n1 - k if b != 0.0 else row]
        before0 = cells[(row - n1) % rows if c != 0.0 else row]
        after0 = cells[(row + n1) % rows if d != 0.0 else row]
        # Of even cells three numbers stand for three rows that would fill the cache; in 2-D there is nothing to read
        # along axis 0. The compiler fills the vector units of loops without a choice: three of them.
        one = min(1, last)
        low, mid, high = lower[one], weight + centre[one], upper[one]
        for j in range(1, last if uniform and n0 == 1 else 1):
            total = mid * here[j] + (low * here[j - 1] + high * here[j + 1])
            result[j] = total + (a * before1[j] + b * after1[j])
        for j in range(1, last if uniform and n0 > 1 else 1):
            total = mid * here[j] + (low * here[j - 1] + high * here[j + 1])
            total += c * before0[j] + d * after0[j]
            result[j] = total + (a * before1[j] + b * after1[j])
        for j in range(1, 1 if uniform else last):
            total = (weight + centre[j]) * here[j] + (lower[j] * here[j - 1] + upper[j] * here[j + 1])
            if n0 > 1:
                total += c * before0[j] + d * after0[j]
            result[j] = total + (a * before1[j] + b * after1[j])
        for j in (0, last):
            total = (weight + centre[j]) * here[j] + (a * before1[j] + b * after1[j]) + (c * before0[j] + d * after0[j])
            total += lower[j] * here[(j - 1) % n] if lower[j] != 0.0 else 0.0
            result[j] = total + (upper[j] * here[(j + 1) % n] if upper[j] != 0.0 else 0.0)


@kernel("read3 write3 index1 index1 read1 real flag")
def across_rows(u, out, indptr, indices, data, scale, add, start, stop):
    """out = scale M u, or added to it: M sparse along the middle axis, row for row of the field."""
    lines = out.shape[1]
    for row in range(start, stop):
        i, k = row // lines, row % lines
        result, first, last = out[i, k], indptr[k], indptr[k + 1]
        if first == last and not add:
            result[:] = 0.0
        for entry in range(first, last, 2):  # two at a time: most rows of an operator have two
            more = min(entry + 1, last - 1)
            one, values = scale * data[entry], u[i, indices[entry]]
            two, others = scale * data[more] if more > entry else 0.0, u[i, indices[more]]
            if entry > first or add:
                for j in range(result.size):
                    result[j] += one * values[j] + two * others[j]
            else:
                for j in range(result.size):
                    result[j] = one * values[j] + two * others[j]


@kernel("read2 write2 index1 index1 index1 read2 real flag")
def along_rows(u, out, offsets, first, last, values, scale, add, start, stop):
    """out = scale M u, or added to it: M along the rows, by its diagonals; `start` and `stop` count entries of out."""
    n = out.shape[1]
    for row in range(start // n, -(-stop // n)):
        for left in range(max(start - row * n, 0), min(stop - row * n, n), TILE):
            right = min(left + TILE, stop - row * n, n)
            if not add:
                out[row, left:right] = 0.0
            for d in range(offsets.size):
                a, b = max(left, first[d]), min(right, last[d])
                if a < b:
                    result, weights, given = out[row, a:b], values[d, a:b], u[row, a + offsets[d] : b + offsets[d]]
                    for j in range(result.size):
                        result[j] += scale * weights[j] * given[j]


@kernel("read3 read3 read3 read3 read2 read2 read2 write3 flag")
def through_faces(u, k0, k1, k2, lines0, lines1, lines2, out, closed, start, stop):
    """out = L diag(k) R u in one pass, R from cells to faces and L back; what a face carries is not kept in memory.

    A face f between the cells f - 1 and f carries k_f (r_below_f u_(f-1) + r_above_f u_f), and the cells get l_below_f
    and l_above_f times that: the four rows of `lines` of each axis, with one more entry than the axis has cells.
    k has as many faces as that, or as many as cells where the axis is periodic: the last face is then the first.
    `closed`: faces with k = 0 carry 0, whatever the cells hold.
    """
    n0, n1, n = u.shape
    cells, totals, carried = u.reshape(n0 * n1, n), out.reshape(n0 * n1, n), np.empty(n + 1)
    for row in range(start, stop):
        i, k = row // n1, row % n1
        here, result, inside, faces = cells[row], totals[row], carried[1:n], k2[i, k]
        below, above, conduct, ahead = lines2[0, 1:n], lines2[1, 1:n], faces[1:n], here[1:]
        for f in range(n - 1):
            inside[f] = conduct[f] * (below[f] * here[f] + above[f] * ahead[f])
        for f in (0, n):  # the walls, or the face at both ends
            low = lines2[0, f] * here[(f - 1) % n] if lines2[0, f] != 0.0 else 0.0
            high = lines2[1, f] * here[f % n] if lines2[1, f] != 0.0 else 0.0
            carried[f] = faces[f % faces.size] * (low + high)
        if closed:
            for f in range(faces.size):
                carried[f] = carried[f] if faces[f] != 0.0 else 0.0
            carried[n] = carried[n] if faces[n % faces.size] != 0.0 else 0.0
        to_below, to_above, next_ones = lines2[2, 1:], lines2[3, :n], carried[1:]
        for j in range(n):
            result[j] = to_above[j] * carried[j] + to_below[j] * next_ones[j]
        for side in range(4):  # across rows: the face below and above in axis 1, then in axis 0
            upper, (count, stride, line) = side % 2, (n1, 1, lines1) if side < 2 else (n0, n1, lines0)
            if count == 1:
                continue
            place = row // stride % count
            f = place + upper
            weight, below_f, above_f = line[3 - upper, f], line[0, f], line[1, f]
            # beyond a wall there is no cell: the cell itself is read, times 0
            low = cells[row + ((f - 1) % count - place) * stride if below_f != 0.0 else row]
            high = cells[row + (f % count - place) * stride if above_f != 0.0 else row]
            faces = k1[i, f % k1.shape[1]] if side < 2 else k0[f % k0.shape[0], k]
            for j in range(n):
                flux = weight * (faces[j] * (below_f * low[j] + above_f * high[j]))
                result[j] += 0.0 if closed and faces[j] == 0.0 else flux
