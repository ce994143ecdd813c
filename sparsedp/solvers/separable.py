"""separable: any Kronecker sum solved by transforms along its axes. Two transforms an axis, no iteration.

    A = sum over axes of (1 x F_a x 1) + shift,    F_a = S_a^-1 Q_a diag(e_a) Q_a^-1 S_a
    f(A) = (product of S_a^-1 Q_a) diag f(sum e_a + shift) (product of Q_a^-1 S_a)

so one diagonalisation gives the inverse (1 / e, 0 for the null space), powers and exponentials.
"""

from math import prod

import numpy as np
import scipy.fft as fft

from sparsedp import kernels
from sparsedp.solvers.axes import Axis, diagonalise
from sparsedp.solvers.contract import Engine

__all__ = ["Separable", "Spectrum", "separable_engine", "spectrum"]

WORTH_THREADS = 65536  # unknowns below which a second thread costs more than it brings
ZERO = 4 * np.finfo(float).eps  # a sum of eigenvalues below this share of the largest one is 0


class Spectrum:
    """A Kronecker sum in the eigenvectors of its factors.

    Attributes
    ----------
    shape : tuple
    axes : tuple of Axis
    eigenvalues : array
        Sum over the axes, in the shape of the coefficients (the last Fourier axis is halved).
    """

    def __init__(self, shape, axes, shift):
        self.shape, self.axes, self.shift = shape, axes, shift
        self.fourier = tuple(a for a, axis in enumerate(axes) if axis.kind == "fourier")
        total = np.full((1,) * len(shape), float(shift))
        for a, axis in enumerate(axes):
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
        """f(A) x for the given values of f on the eigenvalues. x may be overwritten."""
        x = x.reshape(self.shape)
        for a, axis in enumerate(self.axes):
            x = axis.forward(x, a, transposed, self.workers)
        if self.fourier:
            x = fft.rfftn(x, axes=self.fourier, overwrite_x=True, workers=self.workers)
        x *= weights
        if self.fourier:
            lengths = [self.shape[a] for a in self.fourier]
            x = fft.irfftn(x, s=lengths, axes=self.fourier, overwrite_x=True, workers=self.workers)
        for a in reversed(range(len(self.axes))):
            x = self.axes[a].backward(x, a, transposed, self.workers)
        return x.reshape(-1)

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
    axes, shift = [Axis("identity", np.zeros(n)) for n in shape], 0.0
    for term in structure.blocks.get((0, 0), ()):
        if not term.axes:
            shift += term.scale
        for a in term.axes:
            found = diagonalise(term.factors[a].scaled(term.scale))
            if found is None:
                return None
            axes[a] = found
    return Spectrum(shape, tuple(axes), shift)


class Separable(Engine):
    """The engine: forward transforms, division by the eigenvalues, backward transforms."""

    method = "separable"
    unit = "refinements"

    def __init__(self, found):
        self.spectrum = found
        self.weights = found.inverse_weights()
        self.hierarchy = found.words

    def solve(self, b, goal, transposed):
        return self.spectrum.apply(self.weights, b, transposed), 0, ""


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
    found = spectrum(structure) if getattr(structure, "separable", False) and system.active is None else None
    if found is None:
        raise ValueError(f"separable needs a sum of 1-D factors that can be diagonalised, got {system.given}")
    return Separable(found)
