"""Compiled passes of the projection: the net flow out of cells, and the addition of a pressure gradient on faces.

The loops run on one thread, because they take little time compared with the transforms of the pressure solve. x0, x1
and x2 are the components of a face field with three axes; a component is empty if the grid lacks the axis. On a
periodic axis the first face is also the upper face of the last cell.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sparsedp.kernels.team import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["net_flow", "push"]


@kernel("read1 read3 read3 read3 read2 read2 read2 write3", fastmath={"reassoc"})  # lets sums of squares be vectorised
def net_flow(
    x: NDArray,
    x0: NDArray,
    x1: NDArray,
    x2: NDArray,
    lines0: NDArray,
    lines1: NDArray,
    lines2: NDArray,
    b: NDArray,
    start: int,
    stop: int,
) -> tuple[float, float]:
    """Set b = lower v[i] + upper v[i + 1] summed over the axes; return the sums of squares of b and of x.

    The two rows of `lines` of an axis hold `lower` and `upper` for each cell along it. x is the flat array of all
    components.
    """
    last = b.shape[2] - 1
    lower = lines2[0]
    upper = lines2[1]
    of_flow = 0.0
    of_velocity = 0.0
    for i in range(start, stop):
        for k in range(b.shape[1]):
            row = b[i, k]
            near = x2[i, k]
            ahead = near[1:]
            for j in range(last):
                row[j] = lower[j] * near[j] + upper[j] * ahead[j]
            row[last] = lower[last] * near[last] + upper[last] * near[(last + 1) % near.size]
            for faces, lines, place, after in ((x1, lines1, k, (0, 1)), (x0, lines0, i, (1, 0))):
                if faces.size:
                    n0 = faces.shape[0]
                    n1 = faces.shape[1]
                    near = faces[i, k]
                    ahead = faces[(i + after[0]) % n0, (k + after[1]) % n1]
                    low = lines[0, place]
                    high = lines[1, place]
                    for j in range(row.size):
                        row[j] += low * near[j] + high * ahead[j]
            for j in range(row.size):
                of_flow += row[j] * row[j]
    for j in range(x.size):
        of_velocity += x[j] * x[j]
    return of_flow, of_velocity


@kernel("read3 read3 read3 read3 read2 read2 read2 write3 write3 write3")
def push(
    x0: NDArray,
    x1: NDArray,
    x2: NDArray,
    p: NDArray,
    lines0: NDArray,
    lines1: NDArray,
    lines2: NDArray,
    out0: NDArray,
    out1: NDArray,
    out2: NDArray,
    start: int,
    stop: int,
) -> None:
    """Set out = keep x + below p[f - 1] + above p[f] on each face f; the rows of `lines` are keep, below and above."""
    n0, n1, n2 = p.shape
    flat_shape = 1, len(out0), n1 * n2
    first = (
        x0.reshape(flat_shape),
        p.reshape(1, n0, n1 * n2),
        lines0,
        out0.reshape(flat_shape),
    )  # reshaped, so that axis 0 is the middle axis of three
    for faces, cells, lines, out in (first, (x1, p, lines1, out1)):
        n = cells.shape[1]
        for i in range(out.shape[0]):
            for f in range(out.shape[1]):
                a = lines[0, f]
                b = lines[1, f]
                c = lines[2, f]
                old = faces[i, f]
                result = out[i, f]
                low = cells[i, (f - 1) % n]
                high = cells[i, f % n]
                for j in range(result.size):
                    result[j] = a * old[j] + b * low[j] + c * high[j]
    for i in range(n0):
        for k in range(n1):
            x = x2[i, k]
            out = out2[i, k]
            near = p[i, k]
            keep = lines2[0]
            below = lines2[1]
            above = lines2[2]
            ahead = near[1:]
            inner = out[1:]
            old = x[1:]
            low = below[1:]
            high = above[1:]
            inner_keep = keep[1:]
            for j in range(n2 - 1):
                inner[j] = inner_keep[j] * old[j] + low[j] * near[j] + high[j] * ahead[j]
            for f in range(0, out.size, n2):  # the faces on the walls; on a periodic axis the one at both ends
                out[f] = keep[f] * x[f] + below[f] * near[(f - 1) % n2] + above[f] * near[f % n2]
