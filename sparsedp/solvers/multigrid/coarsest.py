"""The coarsest level: the inverse of a dense matrix."""

import numpy as np
from scipy.sparse.csgraph import connected_components

__all__ = ["COARSEST", "dense_inverse"]

COARSEST = 100  # cells that are solved by a dense matrix
ACCURATE, RANK = 1e-3, 1e-14  # residual of an inverse that will do; eigenvalues below, of a diagonal of 1, are 0


def dense_inverse(natural):
    """Natural -> inverse of its matrix with a unit diagonal, null vectors to 0; one over the root of the diagonal."""
    shape, free = natural.shape, natural.free.reshape(-1)
    count = free.size
    number = np.arange(count).reshape(shape)
    matrix = np.diag(np.where(free, 0.0, natural.extra.reshape(-1)))
    for links, step in zip(natural.links, natural.steps):
        a = links.reshape(-1)
        i, j = (
            number.reshape(-1)[a != 0.0],
            np.roll(number, [-d for d in step], range(len(shape))).reshape(-1)[a != 0.0],
        )
        for one, two, value in ((i, j, -1.0), (j, i, -1.0), (i, i, 1.0), (j, j, 1.0)):
            np.add.at(matrix, (one, two), value * a[a != 0.0])
    diagonal = np.maximum(matrix.diagonal(), 0.0)
    root = np.sqrt(diagonal)
    scale = np.divide(1.0, root, out=np.zeros(count), where=root > 0.0)
    _, labels = connected_components(matrix != 0, directed=False)
    matrix *= scale[:, None] * scale
    matrix[np.diag_indices(count)] = 1.0
    nothing = np.zeros_like(matrix)
    for label in np.unique(labels[free]):
        vector = np.where(labels == label, root, 0.0)
        if np.count_nonzero(vector) > 1 and np.all(free[vector > 0.0]):
            nothing += np.outer(vector, vector) / (vector @ vector)
    return _inverse(matrix + nothing) - nothing, scale.reshape(shape)


def _inverse(matrix):
    """Inverse of a symmetric matrix; cells whose weights depend on each other give modes of 0, which are left out."""
    try:
        found = np.linalg.inv(matrix)
        if np.max(np.abs(matrix @ found - np.eye(len(matrix))), initial=0.0) < ACCURATE:
            return found
    except np.linalg.LinAlgError:
        pass
    values, vectors = np.linalg.eigh(matrix)
    kept = np.abs(values) > RANK
    return (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
