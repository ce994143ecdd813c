"""The entries of the matrix of a semi-Lagrangian step, from the weights that its kernels use."""

import numpy as np
import scipy.sparse as sp

from sparsedp.kernels.sampling_plain import corners

__all__ = ["block"]


def block(law, number, look):
    """Semi-Lagrangian law, component, look -> csr_array of that component."""
    points, solid, (speeds, scale) = law.points[number], law.solids[number], look
    n = speeds[0].size
    origin = np.full(points.size, n)
    origin[points.targets] = points.sources
    at = np.arange(n).reshape(points.shape)
    i, j, k = np.indices(points.shape)
    origin[points.corner + i * points.strides[0] + j * points.strides[1] + k] = at
    found = sp.csr_array((n, n))
    for index, weight in corners(speeds, scale, points.shape, points.strides, points.wraps, points.like):
        columns, values = (np.broadcast_to(x, points.shape).ravel() for x in (origin[index], weight))
        inside = columns < n  # the rest comes from outside
        found = found + sp.csr_array((values[inside], (at.ravel()[inside], columns[inside])), (n, n))
    if law.fill is not None:
        found = found @ law.fill[0]
    if solid is not None:
        found = sp.diags_array((~solid).astype(float)) @ found + sp.diags_array(solid.astype(float))
    return found
