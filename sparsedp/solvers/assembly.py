"""Assembly: from a coefficient k to the entries of shift - D diag(k) G, on a fixed pattern."""

from functools import cached_property

import numpy as np
import scipy.sparse as sp

from sparsedp.solvers import facts

__all__ = ["Assembly"]


class Assembly:
    """The sparse map from k to the entries: entry (i, j) is -sum over faces f of D[i, f] k[f] G[f, j].

    One product with it gives the matrix for a new k; the pattern, with its diagonal, is found once.

    Parameters
    ----------
    D, G : Operator
    """

    def __init__(self, D, G):
        self.D, self.G = D, G
        self.has_entries = D.structure.has_entries and G.structure.has_entries

    @cached_property
    def magnitudes(self):
        """x -> |G| x, |D| x, and those of the transposes in the order in which they act."""
        D, G = self.D.structure, self.G.structure
        plain, turned = (G, D), (D.transpose(), G.transpose())
        return tuple(map(facts.magnitude, plain)), tuple(map(facts.magnitude, turned))

    @cached_property
    def _plan(self):
        """(map, indices, indptr, positions of the diagonal)."""
        size = self.G.domain.size
        rows, columns, faces, values = self._contributions()
        own = np.arange(size, dtype=np.int64) * (size + 1)
        keys, place = np.unique(np.concatenate([rows.astype(np.int64) * size + columns, own]), return_inverse=True)
        place = place.astype(np.int32)
        coefficients = sp.csr_array((values, (place[: rows.size], faces)), shape=(keys.size, self.D.domain.size))
        indptr = np.searchsorted(keys, np.arange(size + 1, dtype=np.int64) * size).astype(np.int32)
        return coefficients, (keys % max(size, 1)).astype(np.int32), indptr, place[rows.size :]

    def _contributions(self):
        """Row, column, face and value of every product -D[i, f] G[f, j]."""
        D, G = self.D.structure.explicit().tocsc(), self.G.structure.explicit()
        face = np.repeat(np.arange(G.shape[0]), np.diff(D.indptr))  # of each entry of D
        many = np.diff(G.indptr)[face]  # entries of G that it meets
        mine = np.repeat(np.arange(face.size), many)
        first = np.cumsum(many) - many
        theirs = G.indptr[face[mine]] + np.arange(mine.size) - first[mine]
        return D.indices[mine], G.indices[theirs], face[mine].astype(np.int32), -D.data[mine] * G.data[theirs]

    def matrix(self, k, shift):
        """csr_array of shift - D diag(k) G; its pattern does not depend on k."""
        coefficients, indices, indptr, own = self._plan
        data = coefficients @ k
        data[own] += shift
        matrix = sp.csr_array((data, indices, indptr), shape=(self.G.domain.size,) * 2)
        matrix.has_canonical_format = True
        return matrix
