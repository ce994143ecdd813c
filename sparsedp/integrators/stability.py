"""How large an explicit step may be, where the spectrum of the operator is known."""

import numpy as np

from sparsedp.errors import ConvergenceError, UnstableStepError
from sparsedp.fields import rounded_down
from sparsedp.solvers.separable import spectrum
from sparsedp.tape import plain

__all__ = ["Limit"]

ROUNDING = 1e-12  # a step at the limit may lie beyond it by rounding
DENSE_UP_TO = 64


class Limit:
    """The largest stable h c of an explicit step for u' = c L u.

    From the eigenvalues of a sum of 1-D factors, else, where L has symmetric entries, from its least
    eigenvalue. Of other operators nothing is known, and any step is taken.

    Parameters
    ----------
    op : Operator
    reach : float
        Length of the stable interval on the negative real axis.
    name : str
        The method, for the message.
    """

    def __init__(self, op, reach, name):
        self.op, self.name = op, name
        least = least_eigenvalue(op)
        self.largest = reach / -least if least is not None and least < 0 else np.inf

    def check(self, h, c):
        """Refuse a step that would grow without bound."""
        h, c = float(plain(h)), float(plain(c))
        if h * c > self.largest * (1 + ROUNDING):
            raise UnstableStepError(
                f"{self.name} is unstable for {self.op.name} with dt = {h:.12g}: the largest stable dt is "
                f"{rounded_down(self.largest / c)}; take smaller steps or an implicit method, or write unstable='allow'"
            )


def least_eigenvalue(op):
    """The most negative eigenvalue of an operator with real ones, or None when that is not known."""
    if op.dtype.kind == "c":
        return None
    found = spectrum(op.structure) if op.separable else None
    if found is not None:
        return float(np.min(found.eigenvalues))
    if not op.structure.has_entries:
        return None
    matrix = op.matrix
    different = abs(matrix - matrix.T)
    if different.nnz and different.max() > 1e-14 * abs(matrix).max():
        return None
    return _least_of_symmetric(matrix)


def _least_of_symmetric(matrix):
    from scipy.sparse.linalg import ArpackError, eigsh

    n = matrix.shape[0]
    if n <= DENSE_UP_TO:
        return float(np.min(np.linalg.eigvalsh(matrix.toarray()), initial=0.0))
    start = np.random.default_rng(0).standard_normal(n)  # the same bits in every run
    try:
        return float(eigsh(matrix, 1, which="SA", v0=start, tol=1e-3, return_eigenvectors=False)[0])
    except (ArpackError, ConvergenceError):
        return None
