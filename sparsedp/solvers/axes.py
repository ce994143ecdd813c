"""1-D factors for separable solves: diagonalised, or eliminated for all modes of the other axes at once.

Diagonalised by a sine, cosine or Fourier transform when uniform, by eigenvectors when not: a factor F of
n cells is written F = S^-1 Q diag(eigenvalues) Q^-1 S with S diagonal and Q orthogonal (or the discrete
Fourier transform). For a stretched grid S is the square root of the cell widths.
Sources: Lynch, Rice, Thomas, Numer. Math. 6 (1964), direct solution by tensor products;
Strang, SIAM Review 41 (1999), the discrete cosine transform; Hockney, J. ACM 12 (1965), transforms along one
axis and elimination along the other; Grassmann, Taksar, Heyman, Operations Research 33 (1985), pivots without
subtractions; Bracewell, J. Opt. Soc. Am. 73 (1983), the real form of the Fourier transform.
"""

from functools import cached_property
from math import prod

import numpy as np
import scipy.fft as fft
import scipy.linalg

from sparsedp import kernels

__all__ = ["Axis", "Sweep", "diagonalise", "sweep"]

ROUNDING = 16 * np.finfo(float).eps  # entries that should be equal may differ by this share
TINY = 1e-40  # share of a link below which what is left of it in a filled row is dropped: it costs time only
WIDEST = 1e4  # largest ratio of scalings that keeps the digits of the eigenvectors


class Axis:
    """One axis of a separable operator in its eigenvectors.

    Attributes
    ----------
    kind : str
        "identity", "dct-2", "dst-2", "dct-4", "dst-4", "fourier" or "eigenvectors".
    eigenvalues : array, shape (n,)
    """

    def __init__(self, kind, eigenvalues, scaling=None, vectors=None):
        self.kind = kind
        self.eigenvalues = eigenvalues
        self.scaling = scaling
        self.vectors = vectors

    def dense(self):
        """The same axis, its transform written as a matrix: on a short axis one product is less than one call."""
        n = self.eigenvalues.size
        if self.kind == "fourier":  # the real form of it: both modes of a pair have the same eigenvalue
            angle = 2 * np.pi / n * (np.outer(np.arange(n), np.arange(n)) % n)
            return Axis(self.kind, self.eigenvalues, vectors=(np.cos(angle) + np.sin(angle)) / np.sqrt(n))
        if self.kind in ("identity", "eigenvectors"):
            return self
        _, back, number = self._transforms
        return Axis(self.kind, self.eigenvalues, vectors=back(np.eye(n), number, axis=0, norm="ortho"))

    @cached_property
    def _transforms(self):
        function = {"c": (fft.dct, fft.idct), "s": (fft.dst, fft.idst)}[self.kind[1]]
        return *function, int(self.kind[-1])

    def forward(self, x, axis, transposed, workers, overwrite):
        """Field along `axis` -> coefficients. `overwrite`: the memory of x may be used."""
        if self.vectors is not None:
            return self._turn(x, axis, self._scale(transposed), self.vectors.T, None)
        there, _, number = self._transforms
        return there(x, number, axis=axis, norm="ortho", overwrite_x=overwrite, workers=workers)

    def backward(self, y, axis, transposed, workers):
        """Coefficients along `axis` -> field. May overwrite y."""
        if self.vectors is not None:
            return self._turn(y, axis, None, self.vectors, self._scale(not transposed))
        if self.kind in ("identity", "fourier"):
            return y
        _, back, number = self._transforms
        return back(y, number, axis=axis, norm="ortho", overwrite_x=True, workers=workers)

    def _scale(self, inverse):
        if self.scaling is None:
            return None
        return 1 / self.scaling if inverse else self.scaling

    @staticmethod
    def _turn(x, axis, before, matrix, after):
        if before is not None:
            matrix = matrix * before
        if after is not None:
            matrix = after[:, None] * matrix
        n = x.shape[axis]
        if axis == x.ndim - 1:
            return (x.reshape(-1, n) @ matrix.T).reshape(x.shape)
        flat = x.reshape(n, -1) if axis == 0 else x.reshape(-1, n, prod(x.shape[axis + 1 :]))
        return np.matmul(matrix, flat).reshape(x.shape)


def diagonalise(factor):
    """Square 1-D factor -> Axis, or None when it cannot be diagonalised with all its digits.

    Parameters
    ----------
    factor : Factor

    Returns
    -------
    Axis or None
    """
    n = factor.shape[0]
    bands = factor.tridiagonal
    if n == 1:
        return Axis("identity", np.array([factor.matrix[0, 0]]))
    if bands is None:
        return _by_eigenvectors(factor.matrix.toarray(), np.ones(n)) if _symmetric(factor.matrix) else None
    return _by_transform(bands) or _by_scaling(factor)


def _by_transform(bands):
    """A sine, cosine or Fourier transform, if the entries are those of a uniform axis."""
    n = bands.centre.size
    if n < 3:
        return None
    lower, upper, side, middle = bands.lower, bands.upper, bands.lower[1], bands.centre[n // 2]
    inner = np.concatenate([lower[1:] - side, upper[:-1] - side, bands.centre[1:-1] - middle])
    if side == 0 or np.any(np.abs(inner) > ROUNDING * np.abs(side)):
        return None
    angle = np.arange(n)
    ends = tuple(_end(bands.centre[i] - middle, side, link) for i, link in ((0, lower[0]), (-1, upper[-1])))
    if ends == ("linked", "linked"):
        return Axis("fourier", _cosines(middle, side, 2 * angle / n))
    kind, shift = {
        ("neumann", "neumann"): ("dct-2", 0.0),
        ("dirichlet", "dirichlet"): ("dst-2", 1.0),
        ("neumann", "dirichlet"): ("dct-4", 0.5),
        ("dirichlet", "neumann"): ("dst-4", 0.5),
    }.get(ends, (None, 0.0))
    return None if kind is None else Axis(kind, _cosines(middle, side, (angle + shift) / n))


def _cosines(middle, side, turns):
    """middle + 2 side cos(pi turns), written so that no digits cancel where middle = -2 side."""
    return (middle + 2 * side) - 4 * side * np.sin(0.5 * np.pi * turns) ** 2


def _end(extra, side, link):
    """What the wall adds to the diagonal: side mirrors the neighbour, -side mirrors it with its sign changed."""
    if link != 0:
        return "linked" if abs(link - side) + abs(extra) <= ROUNDING * abs(side) else None
    for kind, wanted in (("neumann", side), ("dirichlet", -side)):
        if abs(extra - wanted) <= ROUNDING * abs(side):
            return kind
    return None


def _by_scaling(factor):
    """Symmetric after scaling the rows by weights w, w[i] F[i, i+1] = w[i+1] F[i+1, i]."""
    up, down = factor.matrix.diagonal(1), factor.matrix.diagonal(-1)
    linked = up != 0
    if np.any(linked != (down != 0)) or np.any(up * down < 0):
        return None
    ratio = np.where(linked, up / np.where(linked, down, 1.0), 1.0)
    weights = np.cumprod(np.concatenate([[1.0], ratio]))
    if not np.all(np.isfinite(weights)) or weights.max() > WIDEST**2 * weights.min():
        return None
    scaling = np.sqrt(weights / weights.max())
    dense = factor.matrix.toarray() * scaling[:, None] / scaling
    if not np.allclose(dense, dense.T, rtol=1e-13, atol=0):
        return None  # the link around a periodic axis does not fit the weights
    return _by_eigenvectors(dense, scaling, factor)


def _by_eigenvectors(dense, scaling, factor=None):
    dense = 0.5 * (dense + dense.T)
    n = len(dense)
    cyclic = n > 2 and (dense[0, -1] != 0 or np.count_nonzero(dense) > 3 * n - 2)
    if cyclic or n <= 2:
        values, vectors = scipy.linalg.eigh(dense, driver="evd")
    else:
        values, vectors = scipy.linalg.eigh_tridiagonal(np.diag(dense), np.diag(dense, 1))
    if factor is not None:
        values = _exact_zero(factor, values)
    return Axis("eigenvectors", values, scaling, vectors)


def _exact_zero(factor, values):
    """Round-off gives 1e-10 for the eigenvalue 0 of constants; a factor that drops constants has 0."""
    rows, sizes = factor.matrix.sum(axis=1), abs(factor.matrix).sum(axis=1)
    if np.all(np.abs(rows) <= 8 * np.finfo(float).eps * sizes):
        values[np.argmin(np.abs(values))] = 0.0
    return values


def _symmetric(matrix):
    difference = abs(matrix - matrix.T)
    return difference.nnz == 0 or difference.max() <= 1e-14 * abs(matrix).max()


# ---------------------------------------------------------------- elimination along the first axis


class Sweep:
    """(T + mode) x = b for all modes at once, T a three-point factor along the first axis: elimination.

    Rows are eliminated from the first to the last. On a periodic axis the last unknown is linked to the
    first, so that the last column and the last row fill up. With off-diagonal entries of one sign and
    rows that sum to the other, no pivot takes a subtraction: every digit of a small sum is kept. The
    transpose has the same pivots.

    Parameters
    ----------
    bands : Tridiagonal
    excess : array, shape (n,)
        What the rows sum to, times `sign`; >= 0.
    modes : array, shape (m,)
        Numbers on the diagonal, times `sign`; >= 0.
    sign : 1.0 or -1.0
        Sign of the diagonal.
    """

    def __init__(self, bands, excess, modes, sign):
        n = bands.centre.size
        self.lower, self.upper = bands.lower, bands.upper
        lower, upper = np.abs(bands.lower), np.abs(bands.upper)
        self.inverses = np.empty((n, modes.size))  # of the pivots; 0 where the system is singular
        self.column = self.row = np.empty((0, modes.size))
        if lower[0] == 0 and upper[-1] == 0:
            rest = 0.0
            for i in range(n):
                rest = excess[i] + modes + (lower[i] * rest * self.inverses[i - 1] if i else 0.0)
                _invert(upper[i] + rest, self.inverses[i])
        else:
            self.column, self.row = np.empty((2, n, modes.size))
            self._fill(lower, upper, excess, modes)
            if np.array_equal(self.column, self.row):
                self.row = self.column
        rows = np.arange(1, len(self.row) - 1)[:, None]  # of the last but one, the link is never dropped
        self.ends = np.max(rows * ((self.column != 0) | (self.row != 0))[:-2], axis=0, initial=0)
        self.inverses *= sign
        for filled in {id(fill): fill for fill in (self.column, self.row)}.values():
            filled *= -sign

    def _fill(self, lower, upper, excess, modes):
        """Pivots of a periodic axis, and the magnitudes of the filled last column and row."""
        n = len(excess)
        column, row = np.full((2, modes.size), [[lower[0]], [upper[-1]]])
        rest, last = excess[0] + modes, excess[-1] + modes
        for i in range(n - 1):
            onwards = upper[i]
            if i == n - 2:
                column, row, onwards = column + upper[i], row + lower[-1], 0.0
            inverse = _invert(onwards + column + rest, self.inverses[i])
            self.column[i], self.row[i] = column, row
            last = last + row * inverse * rest
            row = _dropped(row * inverse * onwards, upper[-1])
            column = _dropped(lower[i + 1] * inverse * column, lower[0])
            rest = excess[i + 1] + modes + lower[i + 1] * inverse * rest
        self.column[-1] = self.row[-1] = 0.0
        _invert(last, self.inverses[-1])

    def solve(self, x, transposed):
        """x, shape (n, m), is overwritten with the solution."""
        if transposed:
            lower, upper = np.roll(self.upper, 1), np.roll(self.lower, -1)
            kernels.sweep(x, lower, upper, self.inverses, self.row, self.column, self.ends)
        else:
            kernels.sweep(x, self.lower, self.upper, self.inverses, self.column, self.row, self.ends)


def _invert(pivots, out):
    out[...] = 0.0
    return np.divide(1.0, pivots, out=out, where=pivots != 0)


def _dropped(fill, link):
    fill[fill < TINY * link] = 0.0
    return fill


def sweep(factor, modes):
    """Square 1-D factor, numbers that are added to its diagonal -> Sweep, or None when it might lose digits.

    Needed are three points a row, off-diagonal entries of one sign, and rows that sum to the other one.
    """
    bands = factor.tridiagonal
    if bands is None or bands.centre.size < 3 or not np.any(bands.centre):
        return None
    sign = float(np.sign(bands.centre[np.argmax(np.abs(bands.centre))]))
    links = np.abs(bands.lower) + np.abs(bands.upper)
    excess = sign * bands.centre - links
    excess[np.abs(excess) <= ROUNDING * links] = 0.0
    against = np.concatenate([sign * bands.lower, sign * bands.upper])
    if np.any(against > 0) or np.any(excess < 0) or np.any(sign * modes < 0):
        return None
    return Sweep(bands, excess, sign * modes, sign)
