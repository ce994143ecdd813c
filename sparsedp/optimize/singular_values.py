"""Singular values of a wide matrix and their vectors, by products of matrices: what dense directions rest on."""

from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dsyevd

from sparsedp.errors import NonFiniteError
from sparsedp.optimize.trials import power_of_two

__all__ = ["Singular", "decomposed", "singular"]

GRADE = 1e-4  # singular values below this share of the largest wait for a Gram matrix of their own
PLAIN = 2.0**-500, 2.0**500  # entries of a Gram matrix that need no scaling


class Group(NamedTuple):
    """Some singular values of W: rows (j, n) made of those of W, vectors (j, i) with right = vectors^T rows / s."""

    rows: np.ndarray
    vectors: np.ndarray


class Singular(NamedTuple):
    """W = left diag(s) right, W k x n: left (k, k) orthogonal, s (k,) falling, right (k, n) in groups."""

    left: np.ndarray
    s: np.ndarray
    groups: tuple

    def _apart(self, y):
        return np.split(y, np.cumsum([group.vectors.shape[1] for group in self.groups])[:-1])

    def across(self, x):
        """(n,) -> right x."""
        parts = np.concatenate([group.vectors.T @ (group.rows @ x) for group in self.groups])
        return np.divide(parts, self.s, out=np.zeros_like(parts), where=self.s > 0)

    def along(self, y):
        """(k,) -> right^T y."""
        shares = np.divide(y, self.s, out=np.zeros_like(self.s), where=self.s > 0)
        return sum((group.vectors @ part) @ group.rows for group, part in zip(self.groups, self._apart(shares)))


def decomposed(jacobian, r):
    """Jacobian (m, n), r (m,) -> weights -> the right singular vectors with these weights, added up; s; parts of r.

    The parts are those along the left singular vectors; there are min(m, n) of each. A tall Jacobian is the
    transpose of a wide one.
    """
    if len(jacobian) <= jacobian.shape[1]:
        found = singular(jacobian)
        return found.along, found.s, found.left.T @ r
    found = singular(jacobian.T)
    return found.left.__matmul__, found.s, found.across(r)


def singular(matrix):
    r"""Wide matrix W (k, n), k <= n -> Singular.

    The Gram matrix W W^T squares the singular values: what is above 1e-4 of the largest keeps eight digits and more,
    what is below 1e-8 is lost in rounding. So those above are taken, and the others get a Gram matrix of their own.
    With the eigenvectors E1 (squares q1) and E2 of the two groups, rounding has left a part of E1 in E2,

        C = q1^-1 E1^T W (E2^T W)^T,    E2 <- E2 - E1 C,    E1 <- E1 + E2 C^T,

    and without it E2^T W has no more of the first group than after Householder's reflections. The same again for
    W <- E2^T W, until no group is left: one to four times, for an SVD of W that costs five times as much.
    Raises NonFiniteError if W is not finite.
    """
    scale = 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        gram = matrix @ matrix.T
    if not PLAIN[0] < np.max(np.diag(gram), initial=0.0) < PLAIN[1]:
        scale = power_of_two(np.max(np.abs(matrix), initial=0.0))  # squares do not overflow, nor vanish
        matrix = matrix / scale
        gram = matrix @ matrix.T
    levels, rows, basis = [], matrix, None
    while True:
        squares, vectors, failed = dsyevd(gram.T, overwrite_a=True)  # symmetric: .T only says in which order it lies
        if failed or not np.all(np.isfinite(squares)):
            raise NonFiniteError("the Jacobian is not finite; start where every output has a finite derivative")
        few = int(np.count_nonzero(squares <= GRADE**2 * squares[-1]))  # for later; they come first
        few = 0 if few == len(squares) else few
        small, large = vectors[:, :few], vectors[:, few:]
        if few:
            leak = (large.T @ (rows @ (small.T @ rows).T)) / squares[few:, None]
            small, large = small - large @ leak, large + small @ leak.T
        left = large if basis is None else basis @ large
        levels.append((left[:, ::-1], squares[few:][::-1], Group(scale * rows if scale != 1 else rows, large[:, ::-1])))
        if not few:
            lefts, squares, groups = zip(*levels)
            s = scale * np.sqrt(np.maximum(np.concatenate(squares), 0.0))
            return Singular(np.concatenate(lefts, axis=1), s, groups)
        basis = small if basis is None else basis @ small
        rows = small.T @ rows
        gram = rows @ rows.T
