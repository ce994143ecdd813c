"""Compiled diagonal of the levels of the structured multigrid, in 2-D and 3-D; see `multigrid_boxes` for the matrix."""

import numpy as np

from sparsedp.kernels.multigrid_rows import entry, inner

__all__ = ["diagonal"]


@inner
def _add(total, held, front, back, step):
    """Add what a link and the one behind give to the diagonal, and to how the cell is held along each axis."""
    for c in range(total.size):
        total[c] += front[c] + back[c]
    for axis in range(3):
        if step[axis] != 0:
            out = held[axis]
            for c in range(total.size):
                out[c] += front[c] + back[c]


@inner
def _count_weak(held, share, deep):
    """How many cells are held along one axis with less than a share of another one."""
    zero, one, two = held[0], held[1 if deep else 0], held[2]
    count = 0
    for c in range(zero.size):
        least, most = min(min(zero[c], one[c]), two[c]), max(max(zero[c], one[c]), two[c])
        count += 1 if least < share * most else 0
    return count


@entry
def diagonal(links, steps, extra, scale, root, share, deep):
    """Fill one over the root of the diagonal, and the root; 0 where there is no unknown -> number of weak cells."""
    n0, n1, n = extra.shape[0] - 3, extra.shape[1] - 3 * deep, extra.shape[2] - 3
    held, weak = np.zeros((3, n)), 0
    for i in range(1, n0 + 1):
        for j in range(deep, n1 + deep):
            total, out, line = root[i, j, 1 : 1 + n], scale[i, j, 1 : 1 + n], extra[i, j, 1 : 1 + n]
            held[:] = 0.0
            for c in range(n):
                total[c] = line[c]
            for m in range(steps.shape[0]):
                d0, d1, d2 = steps[m]
                front, back = links[m, i, j, 1 : 1 + n], links[m, i - d0, j - d1, 1 - d2 : 1 - d2 + n]
                _add(total, held, front, back, steps[m])
            for c in range(n):
                total[c] = np.sqrt(max(total[c], 0.0))
                out[c] = 1.0 / total[c] if total[c] > 0.0 else 0.0
            weak += _count_weak(held, share, deep)
    return weak
