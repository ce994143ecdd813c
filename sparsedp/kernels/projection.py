"""Compiled passes of the projection: the net flow out of cells, and a pressure pushed onto faces. Serial, row by row:
beside the transforms they are short.

x0, x1, x2 are the components of a face field, in three axes; a component is empty where there is no such axis. On a
periodic axis the last cell and the first face meet round the end.
"""

from sparsedp.kernels.team import kernel

__all__ = ["net_flow", "push"]


@kernel("read1 read3 read3 read3 read2 read2 read2 write3", fastmath={"reassoc"})  # sums of squares in any order
def net_flow(x, x0, x1, x2, lines0, lines1, lines2, b, start, stop):
    """b = lower v[i] + upper v[i + 1] summed over the axes; the rows of `lines` hold lower and upper of the cells.

    Returns the sums of the squares of b and of x, all components in one array.
    """
    last, lower, upper, total, whole = b.shape[2] - 1, lines2[0], lines2[1], 0.0, 0.0
    for i in range(start, stop):
        for k in range(b.shape[1]):
            row, here = b[i, k], x2[i, k]
            ahead = here[1:]
            for j in range(last):
                row[j] = lower[j] * here[j] + upper[j] * ahead[j]
            row[last] = lower[last] * here[last] + upper[last] * here[(last + 1) % here.size]
            for faces, lines, place, after in ((x1, lines1, k, (0, 1)), (x0, lines0, i, (1, 0))):
                if faces.size:
                    n0, n1, here = faces.shape[0], faces.shape[1], faces[i, k]
                    ahead = faces[(i + after[0]) % n0, (k + after[1]) % n1]
                    low, high = lines[0, place], lines[1, place]
                    for j in range(row.size):
                        row[j] += low * here[j] + high * ahead[j]
            for j in range(row.size):
                total += row[j] * row[j]
    for j in range(x.size):
        whole += x[j] * x[j]
    return total, whole


@kernel("read3 read3 read3 read3 read2 read2 read2 write3 write3 write3")
def push(x0, x1, x2, p, lines0, lines1, lines2, out0, out1, out2, start, stop):
    """out = keep x + below p[f - 1] + above p[f]; the rows of `lines` hold keep, below and above of the faces."""
    n0, n1, n2 = p.shape
    plate = 1, len(out0), n1 * n2
    first = x0.reshape(plate), p.reshape(1, n0, n1 * n2), lines0, out0.reshape(plate)  # as if the axis were the second
    for faces, cells, lines, out in (first, (x1, p, lines1, out1)):
        n = cells.shape[1]
        for i in range(out.shape[0]):
            for f in range(out.shape[1]):
                a, b, c = lines[0, f], lines[1, f], lines[2, f]
                given, result, low, high = faces[i, f], out[i, f], cells[i, (f - 1) % n], cells[i, f % n]
                for j in range(result.size):
                    result[j] = a * given[j] + b * low[j] + c * high[j]
    for i in range(n0):
        for k in range(n1):
            x, out, here = x2[i, k], out2[i, k], p[i, k]
            keep, below, above, ahead = lines2[0], lines2[1], lines2[2], here[1:]
            inner, given, low, high, stay = out[1:], x[1:], below[1:], above[1:], keep[1:]
            for j in range(n2 - 1):
                inner[j] = stay[j] * given[j] + low[j] * here[j] + high[j] * ahead[j]
            for f in range(0, out.size, n2):  # the walls, or the face at both ends
                out[f] = keep[f] * x[f] + below[f] * here[(f - 1) % n2] + above[f] * here[f % n2]
