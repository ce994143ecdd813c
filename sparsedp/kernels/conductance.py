"""Compiled L diag(k) R in one pass, R from cells to faces and L back: what a face carries is not kept in memory.

Along an axis R and L have two entries for each face, one for the cell below it and one for the cell above:
a face f between the cells f - 1 and f carries k_f (r_below_f u_(f-1) + r_above_f u_f), and the cells get
l_below_f and l_above_f times that. Arrays of faces have one more entry than the axis has cells; where the axis is
periodic the last is the first again: `lines`, r_below, r_above, l_below and l_above of axis 0, then of the others.
Fields have three axes; one that is not there has one cell, and no faces.
"""

import functools

from numba import njit, prange, types

from sparsedp.kernels.native import _kept, _run
from sparsedp.kernels.unable import warn_unable

__all__ = ["through_faces"]

_inner = njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)


@_inner
def _carried(flux, k, u, below, above, closed):
    """What the faces of a row along the last axis carry. `closed`: nothing that is 0 times k may be read."""
    n = u.size
    ahead, inside = u[1:], flux[1:n]
    a, b, c = below[1:n], above[1:n], k[1:n]
    for f in range(n - 1):
        inside[f] = c[f] * (a[f] * u[f] + b[f] * ahead[f])
    if k.size == n:  # periodic
        flux[0] = flux[n] = k[0] * (below[0] * u[n - 1] + above[0] * u[0])
    else:
        flux[0], flux[n] = k[0] * above[0] * u[0], k[n] * below[n] * u[n - 1]
    if closed:
        for f in range(k.size):
            flux[f] = flux[f] if k[f] != 0.0 else 0.0
        flux[n] = flux[0] if k.size == n else flux[n]


@_inner
def _across(out, k, low, high, below, above, weight, closed):
    """out += weight times what the faces between two rows carry."""
    if closed:
        for c in range(out.size):
            out[c] += weight * (k[c] * (below * low[c] + above * high[c])) if k[c] != 0.0 else 0.0
    else:
        for c in range(out.size):
            out[c] += weight * (k[c] * (below * low[c] + above * high[c]))


@_inner
def _row(i, j, u, k, lines, out, flux, closed):
    n0, n1, n2 = u.shape
    row, here = out[i, j], u[i, j]
    below, above, to_below, to_above = lines[8:]
    _carried(flux, k[2][i, j], here, below, above, closed)
    ahead, toward = flux[1:], to_below[1:]
    for c in range(n2):
        row[c] = to_above[c] * flux[c] + toward[c] * ahead[c]
    if n1 > 1:
        below, above, to_below, to_above = lines[4:8]
        low, high = u[i, j - 1 if j > 0 else (n1 - 1 if k[1].shape[1] == n1 else 0)], u[i, (j + 1) % n1]
        high = high if j + 1 < n1 or k[1].shape[1] == n1 else here
        _across(row, k[1][i, j], low, here, below[j], above[j], to_above[j], closed)
        _across(row, k[1][i, (j + 1) % k[1].shape[1]], here, high, below[j + 1], above[j + 1], to_below[j + 1], closed)
    below, above, to_below, to_above = lines[:4]
    low, high = u[i - 1 if i > 0 else (n0 - 1 if k[0].shape[0] == n0 else 0), j], u[(i + 1) % n0, j]
    high = high if i + 1 < n0 or k[0].shape[0] == n0 else here
    _across(row, k[0][i, j], low, here, below[i], above[i], to_above[i], closed)
    _across(row, k[0][(i + 1) % k[0].shape[0], j], here, high, below[i + 1], above[i + 1], to_below[i + 1], closed)


@_inner
def _share(part, parts, u, k, lines, out, flux, closed):
    n = u.shape[0]
    for i in range(n * part // parts, n * (part + 1) // parts):
        for j in range(u.shape[1]):
            _row(i, j, u, k, lines, out, flux[part], closed)


def _team(u, k, lines, out, flux, closed, parts):
    if parts == 1:
        _share(types.int64(0), parts, u, k, lines, out, flux, closed)
    else:
        for part in prange(parts):
            _share(types.int64(part), parts, u, k, lines, out, flux, closed)


_given = types.Array(types.float64, 3, "C", readonly=True)
_lines = types.UniTuple(types.Array(types.float64, 1, "C", readonly=True), 12)
_out, _flux = types.Array(types.float64, 3, "C"), types.Array(types.float64, 2, "C")
_SIGNATURE = types.void(_given, types.UniTuple(_given, 3), _lines, _out, _flux, types.boolean, types.int64)


@functools.cache
def _kernel():
    try:
        return (_kept(functools.partial(njit, [_SIGNATURE]), _team, nogil=True, parallel=True),)
    except Exception as error:  # whatever LLVM or numba object to on this machine
        return warn_unable(error, 5)


def through_faces(u, k, lines, out, flux, closed, threads):
    """See `sparsedp.kernels.through_faces` -> whether it was done."""
    kernel = _kernel()
    if kernel is None:
        return False
    _run(kernel, (u, k, lines, out, flux, closed), u.size, threads)
    return True
