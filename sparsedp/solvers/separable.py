"""separable: any Kronecker sum solved by transforms along its axes. Two transforms an axis, no iteration.

    A = sum over axes of (1 x F_a x 1) + shift,    F_a = S_a^-1 Q_a diag(e_a) Q_a^-1 S_a
    f(A) = (product of S_a^-1 Q_a) diag f(sum e_a + shift) (product of Q_a^-1 S_a)

so one diagonalisation gives the inverse (1 / e, 0 for the null space), powers and exponentials. The inverse
needs no transform along the first axis where elimination along it is as accurate and takes less time:
T + e for each sum e of the eigenvalues of the other axes, T the factor of the first (see `Sweep`).
"""

from math import prod

import numpy as np
import scipy.fft as fft

from sparsedp import kernels
from sparsedp.errors import NonFiniteError
from sparsedp.fields import is_number
from sparsedp.operator import Operator
from sparsedp.solvers.axes import Axis, diagonalise, sweep
from sparsedp.solvers.contract import Engine
from sparsedp.structure.base import Structure

__all__ = ["Separable", "SpectralFunction", "Spectrum", "exponential", "power", "separable_engine", "spectrum"]

WORTH_THREADS = 131072  # unknowns below which a second thread costs more than it brings
WIDE_COMPILED, WIDE_PLAIN = 16, 1024  # modes from which elimination along the first axis beats transforms
SHORT, WORK = 64, 2**18  # points of an axis, and its points times all unknowns, up to which a transform is a matrix
ZERO = 4 * np.finfo(float).eps  # a sum of eigenvalues below this share of the largest one is 0


class Spectrum:
    """A Kronecker sum in the eigenvectors of its factors.

    Attributes
    ----------
    shape : tuple
    axes : tuple of Axis
    eigenvalues : array
        Sum over the axes, in the shape of the coefficients (the last Fourier axis is halved), or one line of it.
    """

    def __init__(self, shape, axes, shift):
        short = [n <= SHORT and n * prod(shape) <= WORK for n in shape]
        axes = tuple(axis.dense() if few else axis for axis, few in zip(axes, short, strict=True))
        self.shape, self.axes, self.shift = shape, axes, shift
        self.fourier = tuple(a for a, axis in enumerate(axes) if axis.kind == "fourier" and axis.vectors is None)
        total = np.full((1,) * len(shape), float(shift))
        for a, axis in enumerate(axes):
            if a == 0 and len(axes) > 1 and not np.any(axis.eigenvalues):
                continue  # one line of sums serves all
            values = axis.eigenvalues[: shape[a] // 2 + 1] if self.fourier[-1:] == (a,) else axis.eigenvalues
            total = total + values.reshape([-1 if b == a else 1 for b in range(len(shape))])
        largest = sum(np.max(np.abs(axis.eigenvalues)) for axis in axes) + abs(shift)
        total[np.abs(total) <= ZERO * largest * self._uncertain] = 0.0
        self.eigenvalues = total
        self.workers = kernels.threads() if prod(shape) >= WORTH_THREADS else 1

    @property
    def _uncertain(self):
        """Eigenvalues that were computed, not written down, are only known to some rounding."""
        return 1.0 if any(axis.kind == "eigenvectors" for axis in self.axes) else 0.25

    def apply(self, weights, x, transposed=False):
        """f(A) x for the given values of f on the eigenvalues, as a fresh array."""
        y = self.forward(x, transposed)
        y *= weights
        return self.backward(y, transposed)

    def forward(self, x, transposed):
        """Flat field -> its coefficients, as a fresh array."""
        x, fresh = x.reshape(self.shape), False
        for a, axis in enumerate(self.axes):
            if a not in self.fourier and axis.kind != "identity":  # Fourier axes are transformed together
                x, fresh = axis.forward(x, a, transposed, self.workers, fresh), True
        if self.fourier:
            return fft.rfftn(x, axes=self.fourier, workers=self.workers)
        return x if fresh else x.copy()

    def backward(self, y, transposed):
        """Coefficients -> flat field. May overwrite y."""
        if self.fourier:
            lengths = [self.shape[a] for a in self.fourier]
            y = fft.irfftn(y, s=lengths, axes=self.fourier, overwrite_x=True, workers=self.workers)
        for a in reversed(range(len(self.axes))):
            y = self.axes[a].backward(y, a, transposed, self.workers)
        return y.reshape(-1)

    def inverse_weights(self):
        """1 / eigenvalues, and 0 for the null space."""
        zero = self.eigenvalues == 0
        return np.where(zero, 0.0, 1.0 / np.where(zero, 1.0, self.eigenvalues))

    @property
    def words(self):
        """One line: what each axis is."""
        return " x ".join(f"{axis.kind}({n})" for axis, n in zip(self.axes, self.shape, strict=True))


def spectrum(structure):
    """Kronecker sum -> Spectrum, or None when an axis cannot be diagonalised with all its digits.

    Parameters
    ----------
    structure : Kronecker
        With `separable` true.

    Returns
    -------
    Spectrum or None
    """
    shape = structure.out_parts[0]
    axes: list = [Axis("identity", np.zeros(n)) for n in shape]
    for a, line in structure.lines.items():
        axes[a] = diagonalise(line)
    return None if None in axes else Spectrum(shape, tuple(axes), structure.shift)


class Separable(Engine):
    """The engine: forward transforms, division by the eigenvalues, backward transforms.

    With an `elimination`, the spectrum is that of all axes but the first, and elimination takes the place of division.
    """

    method = "separable"
    unit = "refinements"
    overwrites = False

    def __init__(self, found, elimination=None):
        self.spectrum, self.elimination = found, elimination
        self.weights = found.inverse_weights() if elimination is None else None
        self.hierarchy = found.words
        if elimination is not None:
            self.hierarchy = f"elimination({found.shape[0]}) x {found.words.split(' x ', 1)[1]}"

    def solve(self, b, goal, transposed):
        y = self.spectrum.forward(b, transposed)
        if self.elimination is None:
            y *= self.weights
        else:
            self.elimination.solve(y.view(float).reshape(len(y), -1), transposed)
        return self.spectrum.backward(y, transposed), 0, ""


def _swept(structure, found):
    """The engine that spares the transforms along the first axis, or None when they are as good."""
    first, modes = found.shape[0], found.eigenvalues[0].size
    if 0 not in structure.lines or first < 3 or modes < (WIDE_COMPILED if kernels.compiled() else WIDE_PLAIN):
        return None
    rest = Spectrum(found.shape, (Axis("identity", np.zeros(first)), *found.axes[1:]), found.shift)
    sums = rest.eigenvalues[0].reshape(-1)
    elimination = sweep(structure.lines[0], np.repeat(sums, 2) if rest.fourier else sums)  # real and imaginary parts
    return None if elimination is None else Separable(rest, elimination)


def separable_engine(system):
    """Engine: transforms along the axes. For Kronecker sums whose factors can be diagonalised.

    Parameters
    ----------
    system : System

    Raises
    ------
    ValueError
        If the operator is not such a sum.
    """
    structure = system.op.structure
    found = spectrum(structure) if structure.separable and system.active is None else None
    if found is None:
        raise ValueError(f"separable needs a sum of 1-D factors that can be diagonalised, got {system.given}")
    return _swept(structure, found) or Separable(found)


# ---------------------------------------------------------------- functions of a separable operator


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
