"""Functions of a separable operator: exponentials and powers from its diagonalisation, exact to rounding."""

import numpy as np

from sparsedp.errors import NonFiniteError
from sparsedp.fields import is_number
from sparsedp.operator import Operator
from sparsedp.solvers.separable import spectrum
from sparsedp.structure.base import Structure

__all__ = ["exponential", "power"]


class SpectralFunction(Structure):
    """f(A) for a Kronecker sum A, as a structure: one pair of transforms."""

    has_entries = False

    def __init__(self, found, weights, transposed=False):
        self.found, self.weights, self.transposed = found, weights, transposed
        size = int(np.prod(found.shape))
        self.shape = (size, size)

    def apply(self, x, out):
        if x.dtype.kind == "c":
            real, imaginary = (self._real(np.ascontiguousarray(part)) for part in (x.real, x.imag))
            np.copyto(out, real + 1j * imaginary, casting="same_kind")
        else:
            np.copyto(out, self._real(x), casting="same_kind")

    def _real(self, x):
        return self.found.apply(self.weights, x.astype(float), self.transposed)

    def transpose(self):
        return SpectralFunction(self.found, self.weights, not self.transposed)


def exponential(op, time=1.0):
    """Separable operator -> the operator exp(time * op): exact diffusion over a time, at any size of step.

    Parameters
    ----------
    op : Operator
        A Kronecker sum from a space to itself (``op.separable``), such as a laplacian.
    time : float
        Finite [1 / unit of the operator].

    Returns
    -------
    Operator
        Matrix-free: two transforms for each application.

    Raises
    ------
    ValueError
        If the operator is not separable or cannot be diagonalised.
    TypeError
        If `time` is not one real number.
    NonFiniteError
        If `time` is not finite, or the exponential leaves the range of floats.

    Notes
    -----
    With A = V diag(e) V^-1: exp(t A) = V diag(exp(t e)) V^-1. Transpose: exp(t A^T).

    Examples
    --------
    >>> from sparsedp import Grid, laplacian
    >>> spread = exponential(laplacian(Grid(2)), 1e9)
    >>> print(np.round(spread(np.array([1.0, 3.0])), 6))
    [2. 2.]
    """
    found = _spectrum(op, "exponential")
    if not is_number(time):
        raise TypeError(f"exponential needs one real number as time, got {time!r}; write for example 0.1")
    if not np.isfinite(time):
        raise NonFiniteError(f"exponential needs a finite time, got {time}")
    with np.errstate(over="ignore"):
        weights = np.exp(time * found.eigenvalues)
    if not np.all(np.isfinite(weights)):
        raise NonFiniteError(f"exp({time:g} * {op.name}) is beyond 1.8e308; take a shorter time or the other sign")
    return Operator(SpectralFunction(found, weights), op.domain, op.codomain, f"exp({time:g} * {op.name})")


def power(op, exponent):
    """Separable operator -> the operator op^exponent, such as a square root or a smoothing power.

    Parameters
    ----------
    op : Operator
        A Kronecker sum from a space to itself (``op.separable``).
    exponent : float
        Whole, or any number when no eigenvalue is negative. On the null space a negative exponent
        gives 0: the generalised inverse.

    Returns
    -------
    Operator

    Raises
    ------
    ValueError
        If the operator is not separable, or a fractional power of a negative eigenvalue is asked for.
    TypeError
        If `exponent` is not one real number.
    NonFiniteError
        If `exponent` is not finite, or the power leaves the range of floats.

    Examples
    --------
    >>> from sparsedp import Grid, laplacian
    >>> root = power(-laplacian(Grid(3)), 0.5)
    >>> print(np.round(root(root(np.array([1.0, 2.0, 4.0]))), 6))
    [-1. -1.  2.]
    """
    found = _spectrum(op, "power")
    if not is_number(exponent):
        raise TypeError(f"power needs one real number as exponent, got {exponent!r}; write for example 0.5")
    if not np.isfinite(exponent):
        raise NonFiniteError(f"power needs a finite exponent, got {exponent}")
    values = found.eigenvalues
    if exponent != int(exponent) and np.any(values < 0):
        raise ValueError(f"{op.name} has eigenvalues down to {values.min():.1e}; a fractional power needs them >= 0")
    zero = values == 0
    with np.errstate(over="ignore"):
        weights = np.where(zero, 1.0 if exponent == 0 else 0.0, np.where(zero, 1.0, values) ** float(exponent))
    if not np.all(np.isfinite(weights)):
        raise NonFiniteError(f"{op.name} to the power {exponent:g} is beyond 1.8e308; rescale the operator")
    return Operator(SpectralFunction(found, weights), op.domain, op.codomain, f"({op.name})^{exponent:g}")


def _spectrum(op, name):
    found = spectrum(op.structure) if op.separable else None
    if found is None:
        raise ValueError(f"{name} needs a separable operator that can be diagonalised, got {op}")
    return found
