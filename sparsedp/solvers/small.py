"""Small full systems: dense LU inside the adjoint contract, without the facts that only a large set-up is worth.

A x = b with up to 64 unknowns takes microseconds to factor; finding its components, signs and symmetries takes a
thousand times longer. What needs them (a singular matrix, a solve that does not meet its tolerance) is left to the
general path: then `sound` is False, or `solve` returns None.
"""

import numpy as np
import scipy.linalg as la

from sparsedp.solvers.direct import DENSE_UP_TO
from sparsedp.solvers.record import Run
from sparsedp.solvers.scaling import in_range, largest, shifted

__all__ = ["Small", "size_of"]

LEAST = 2.0**-40  # 1 / (|A^-1| |A|): below this the matrix may be a singular one
ROUNDS = 3  # refinements
GETRF, GETRS, GECON = la.lapack.get_lapack_funcs(("getrf", "getrs", "gecon"), dtype=np.float64)


class Small:
    """A full matrix and its LU factors.

    Parameters
    ----------
    matrix : array, shape (n, n)

    Attributes
    ----------
    sound : bool
        Whether the factors can be used.
    norm : float
        |A|_inf.
    """

    most = DENSE_UP_TO

    def __init__(self, matrix):
        run, self.sound = Run(), False
        top = largest(matrix.reshape(-1))
        self.exponent = 0 if not np.isfinite(top) or in_range(top) else int(np.frexp(top)[1])
        self.matrix = shifted(matrix, -self.exponent) if self.exponent else matrix
        if top > 0 and np.isfinite(top):
            self._norm = float(np.abs(self.matrix).sum(1).max())
            self.norm = float(np.ldexp(self._norm, self.exponent))
            self._factors = GETRF(self.matrix)
            self.sound = self._factors[2] == 0 and GECON(self._factors[0], self._norm, norm="I")[0] > LEAST
        self.seconds = run.info().seconds

    def product(self, x):
        """A x."""
        return shifted(self.matrix @ x, self.exponent) if self.exponent else self.matrix @ x

    def terms(self, x):
        """The 2-norm of |A| |x|, entry by entry."""
        return float(np.ldexp(size_of(np.abs(self.matrix) @ np.abs(x)), self.exponent))

    def _solved(self, b, transposed):
        return GETRS(self._factors[0], self._factors[1].copy(), b, trans=int(transposed))[0]

    def solve(self, b, rtol, transposed=False):
        """(x of A x = b or A^T x = b, SolveInfo), judged by the true residual; None: the general path must do it."""
        run, size, exponent = Run(), size_of(b), 0
        if not in_range(size):
            top = largest(b)
            if top == 0 or not np.isfinite(top):
                return None
            exponent = int(np.frexp(top)[1])
            b = shifted(b, -exponent)
            size = size_of(b)
        x, A = self._solved(b, transposed), self.matrix.T if transposed else self.matrix
        for _ in range(ROUNDS):
            r = b - A @ x
            rest = size_of(r)
            if rest <= rtol * size:
                return self._accepted(x, rest, size, exponent - self.exponent, run)
            x += self._solved(r, transposed)
        return None

    def _accepted(self, x, rest, size, exponent, run):
        run.status, run.residual = "converged", rest / size
        run.backward_error = rest / (self._norm * size_of(x) + size)
        x = shifted(x, exponent) if exponent else x
        return (x, run.info()) if np.isfinite(largest(x)) else None

    def __str__(self):
        return f"dense LU, {len(self.matrix)} rows"


def size_of(v):
    """2-norm of a short array."""
    with np.errstate(over="ignore"):  # the caller asks `in_range`, and scales
        return float(np.sqrt(v.dot(v)))
