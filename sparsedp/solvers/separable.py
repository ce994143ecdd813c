"""Kronecker sums solved by transforms along their axes: two transforms an axis, no iteration.

Notes
-----
A Kronecker sum and its functions are diagonalised by the eigenvectors of its 1-D factors::

    A = sum over axes of (I x F_a x I) + shift,    F_a = S_a^-1 Q_a diag(e_a) Q_a^-1 S_a
    f(A) = (product of S_a^-1 Q_a) diag f(sum e_a + shift) (product of Q_a^-1 S_a)

so one diagonalisation gives the inverse (1 / e, and 0 for the null space), powers and exponentials. S_a is diagonal,
on a stretched grid the square root of the cell widths. Q_a is orthogonal, a sine or cosine transform where the axis
is uniform and a matrix of eigenvectors elsewhere; or it is the discrete Fourier transform.

The inverse needs no transform along a bounded first axis where elimination along it is as accurate and faster: one
tridiagonal system T + e for each sum e of the eigenvalues of the other axes, T the factor of the first axis (see
`Elimination`). Elimination along a periodic axis would be at most 1.7 times as fast as the transform, and is omitted.

References
----------
R. E. Lynch, J. R. Rice, D. H. Thomas, Direct solution of partial difference equations by tensor product methods,
Numer. Math. 6 (1964) 185-199.
G. Strang, The discrete cosine transform, SIAM Review 41 (1999) 135-147.
R. W. Hockney, A fast direct solution of Poisson's equation using Fourier analysis, J. ACM 12 (1965) 95-113:
transforms along one axis and elimination along the other.
W. K. Grassmann, M. I. Taksar, D. P. Heyman, Regenerative analysis and steady state distributions for Markov chains,
Operations Research 33 (1985) 1107-1116: pivots without subtractions.
"""

from __future__ import annotations

from functools import partial, reduce
from math import prod
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy.fft as fft
import scipy.fftpack as fftpack
import scipy.linalg

from sparsedp import kernels
from sparsedp._utils.validation import EPS, check_type
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Transposable
from sparsedp.operators.structure.kronecker import Kronecker
from sparsedp.operators.structure.lazy import Chain, Diagonal, Sum
from sparsedp.solvers.engine import Engine
from sparsedp.solvers.nullspace import NullSpace
from sparsedp.solvers.scaling import inverted

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike, NDArray

    from sparsedp.operators.structure.base import Structure
    from sparsedp.operators.structure.factor import Factor
    from sparsedp.solvers.system import System

    Transform = Callable[[NDArray[Any]], NDArray[Any]]

__all__ = [
    "AxisBasis",
    "Eigenbasis",
    "Elimination",
    "Separable",
    "SpectralFunction",
    "Spectrum",
    "compute_spectrum",
    "diagonalise",
    "find_eigenbasis",
    "require_eigenbasis",
    "separable_engine",
    "transform_engine",
]

THREADED_FROM = 131072  # unknowns below which a second thread costs more time than it saves
# Number of tridiagonal systems from which elimination along the first axis is faster than transforms.
ELIMINATION_FROM_COMPILED = 16
ELIMINATION_FROM_NUMPY = 1024
ZERO_EIGENVALUE = 4 * EPS  # a sum of eigenvalues below this share of the largest one is 0
ROUNDING = 16 * EPS  # relative difference of entries that counts as rounding
LARGEST_SCALING_RATIO = 1e4  # of the scaling S_a: beyond it eigenvectors lose digits

# To the coefficients, and from them. `scipy.fftpack` calls the same loops as `scipy.fft`, without a choice of backends,
# which takes longer than a small transform; it has no threads.
TRANSFORMS = {"dct": (fft.dct, fft.idct), "dst": (fft.dst, fft.idst)}
TRANSFORMS_ON_ONE_THREAD = {"dct": (fftpack.dct, fftpack.idct), "dst": (fftpack.dst, fftpack.idst)}
# Boundary conditions at the lower and the upper end -> the transform, and the shift of its frequencies.
TRANSFORM_OF_ENDS = {
    ("neumann", "neumann"): ("dct-2", 0.0),
    ("dirichlet", "dirichlet"): ("dst-2", 1.0),
    ("neumann", "dirichlet"): ("dct-4", 0.5),
    ("dirichlet", "neumann"): ("dst-4", 0.5),
}


# ---------------------------------------------------------------- one axis


class AxisBasis:
    """The eigenvectors and eigenvalues of the factor along one axis.

    Parameters
    ----------
    kind : str
        "identity", "dct-2", "dst-2", "dct-4", "dst-4", "fourier" or "eigenvectors".
    eigenvalues : array, shape (n,)
    matrices : tuple of two arrays of shape (n, n), optional
        Q^-1 S and S^-1 Q, of kind "eigenvectors".
    """

    def __init__(
        self,
        kind: str,
        eigenvalues: NDArray[Any],
        matrices: tuple[NDArray[Any], NDArray[Any]] | None = None,
    ) -> None:
        self.kind = kind
        self.eigenvalues = eigenvalues
        self.matrices = matrices

    def transform(self, axis: int, backward: bool, transposed: bool, workers: int, overwrite: bool) -> Transform | None:
        """Return the function that transforms a field along `axis`; None for axes that need none, as Fourier axes.

        Parameters
        ----------
        axis : int
        backward : bool
            Whether to transform from the coefficients, instead of to them.
        transposed : bool
            Whether the coefficients are those of the transposed factor.
        workers : int
            Number of threads.
        overwrite : bool
            Whether the memory of the argument may be reused.
        """
        if self.matrices is not None:
            if transposed:
                return partial(_multiply_along, self.matrices[1 - backward].T, axis)
            return partial(_multiply_along, self.matrices[backward], axis)
        if self.kind in ("identity", "fourier"):
            return None
        name = self.kind[:3]
        options: dict[str, Any] = dict(type=int(self.kind[-1]), axis=axis, norm="ortho", overwrite_x=overwrite)
        if workers == 1:
            return partial(TRANSFORMS_ON_ONE_THREAD[name][backward], **options)
        return partial(TRANSFORMS[name][backward], **options, workers=workers)

    def diagonal(self, values: NDArray[Any], axis: int, length: int, is_halved: bool) -> NDArray[Any]:
        """Return the diagonal along one axis of the matrix with these eigenvalues: see `Spectrum.diagonal`.

        Parameters
        ----------
        values : array
            Eigenvalues along `axis`; along other axes eigenvalues or entries of the diagonal.
        axis : int
        length : int
            Number of entries along the axis.
        is_halved : bool
            Whether only the first half of the values of a Fourier axis is given; the others are equal to these.
        """
        if self.kind == "identity":
            return values
        if self.matrices is not None:
            return _multiply_along(self.matrices[1] * self.matrices[0].T, axis, np.ascontiguousarray(values))
        values = np.moveaxis(values, axis, -1)
        if self.kind == "fourier":  # all entries of an eigenvector have the same magnitude
            counts = np.ones(values.shape[-1])
            if is_halved:
                counts[1 : (length + 1) // 2] = 2.0
            return np.moveaxis(values @ counts[:, None] / length, -1, axis)
        return np.moveaxis(self._diagonal_of_waves(values), -1, axis)

    def _diagonal_of_waves(self, values):
        """Return the diagonal along the last axis, for eigenvectors that are cosines or sines.

        The square of cos(t) or sin(t) is (1 + cos(2 t)) / 2 or (1 - cos(2 t)) / 2. The frequencies 2 t above the
        largest of a cosine transform are reflected.
        """
        n = values.shape[-1]
        shift = {"dct-2": 0, "dst-2": 2, "dct-4": 1, "dst-4": 1}[self.kind]
        doubled = 2 * np.arange(n) + shift
        weights = np.where(doubled % (2 * n) == 0, 0.5, 1.0) * values / n
        coefficients = np.zeros((*values.shape[:-1], n + 1))
        coefficients[..., doubled[doubled <= n]] += weights[..., doubled <= n]
        coefficients[..., 2 * n - doubled[doubled > n]] -= weights[..., doubled > n]
        coefficients = coefficients[..., :n]
        waves = 0.5 * (fft.dct(coefficients, type=3, axis=-1) + coefficients[..., :1])
        sign = 1.0 if self.kind.startswith("dct") else -1.0
        return np.sum(weights, axis=-1, keepdims=True) + sign * waves


def _multiply_along(matrix, axis, x):
    """Multiply the lines of a field along one axis with a matrix."""
    n = x.shape[axis]
    if axis == x.ndim - 1:
        return (x.reshape(-1, n) @ matrix.T).reshape(x.shape)
    return np.matmul(matrix, x.reshape(-1, n, prod(x.shape[axis + 1 :]))).reshape(x.shape)


def diagonalise(factor: Factor) -> AxisBasis | None:
    """Diagonalise a square 1-D factor.

    Parameters
    ----------
    factor : Factor

    Returns
    -------
    AxisBasis or None
        None where the factor cannot be diagonalised to full accuracy.
    """
    if factor.shape[0] == 1:
        return AxisBasis("identity", np.array([factor.matrix[0, 0]]))
    basis = None
    if factor.tridiagonal:
        basis = _basis_of_transform(factor.tridiagonal)
    if basis is None:
        basis = _basis_of_eigenvectors(factor)
    return basis


def _basis_of_transform(bands):
    """Return a sine, cosine or Fourier basis if the entries are those of a uniform axis, else None."""
    n = bands.centre.size
    if n < 3:
        return None
    side = bands.lower[1]
    middle = bands.centre[n // 2]
    differences = [bands.lower[1:] - side, bands.upper[:-1] - side, bands.centre[1:-1] - middle]
    if side == 0 or np.any(np.abs(np.concatenate(differences)) > ROUNDING * np.abs(side)):
        return None
    lower_end = _condition_at_end(bands.centre[0] - middle, side, bands.lower[0])
    upper_end = _condition_at_end(bands.centre[-1] - middle, side, bands.upper[-1])
    frequency = np.arange(n)
    if lower_end == upper_end == "periodic":
        return AxisBasis("fourier", _cosine_eigenvalues(middle, side, 2 * frequency / n))
    if (lower_end, upper_end) not in TRANSFORM_OF_ENDS:
        return None
    kind, shift = TRANSFORM_OF_ENDS[lower_end, upper_end]
    return AxisBasis(kind, _cosine_eigenvalues(middle, side, (frequency + shift) / n))


def _cosine_eigenvalues(middle, side, angle):
    """Return middle + 2 side cos(pi angle), in a form that loses no digits where middle = -2 side."""
    return (middle + 2 * side) - 4 * side * np.sin(0.5 * np.pi * angle) ** 2


def _condition_at_end(extra, side, link):
    """Name the boundary condition at one end of a uniform axis, or return None.

    Parameters
    ----------
    extra : float
        What the boundary condition adds to the diagonal: `side` for Neumann, -`side` for Dirichlet.
    side : float
        The off-diagonal entry inside.
    link : float
        The entry that links this end to the other one.
    """
    tolerance = ROUNDING * abs(side)
    if link != 0:
        is_uniform = abs(link - side) + abs(extra) <= tolerance
        return "periodic" if is_uniform else None
    if abs(extra - side) <= tolerance:
        return "neumann"
    if abs(extra + side) <= tolerance:
        return "dirichlet"
    return None


def _basis_of_eigenvectors(factor):
    """Return the eigenvectors of a factor that is symmetric, a tridiagonal one after scaling its rows, else None."""
    exponent = np.frexp(factor.largest)[1]  # products of the entries stay in the range of floats in any unit of length
    dense = np.ldexp(factor.matrix.toarray(), -exponent)
    scaling = np.ones(len(dense)) if factor.tridiagonal is None else _symmetrising_scaling(dense)
    if scaling is None:
        return None
    dense = dense * scaling[:, None] / scaling
    if not np.allclose(dense, dense.T, rtol=1e-13, atol=1e-14 * np.max(np.abs(dense))):
        return None  # not symmetric, or the link of a periodic axis does not fit the weights
    dense = 0.5 * (dense + dense.T)
    if len(dense) <= 2 or np.any(np.triu(dense, 2)):
        eigenvalues, vectors = scipy.linalg.eigh(dense, driver="evd")
    else:
        eigenvalues, vectors = scipy.linalg.eigh_tridiagonal(np.diag(dense), np.diag(dense, 1))
    row_sums = factor.matrix.sum(axis=1)
    magnitudes = abs(factor.matrix).sum(axis=1)
    if np.all(np.abs(row_sums) <= 8 * EPS * magnitudes):  # constants have the eigenvalue 0; rounding gives 1e-10
        eigenvalues[np.argmin(np.abs(eigenvalues))] = 0.0
    to_coefficients = vectors.T * scaling
    from_coefficients = (1 / scaling)[:, None] * vectors
    return AxisBasis("eigenvectors", np.ldexp(eigenvalues, exponent), (to_coefficients, from_coefficients))


def _symmetrising_scaling(dense):
    """Return the square roots of the weights w with w[i] F[i, i+1] = w[i+1] F[i+1, i], or None."""
    up = dense.diagonal(1)
    down = dense.diagonal(-1)
    linked = up != 0
    if np.any(linked != (down != 0)) or np.any(up * down < 0):
        return None
    ratios = np.where(linked, up / np.where(linked, down, 1.0), 1.0)
    weights = np.cumprod(np.concatenate([[1.0], ratios]))
    if not np.all(np.isfinite(weights)) or weights.max() > LARGEST_SCALING_RATIO**2 * weights.min():
        return None
    return np.sqrt(weights / weights.max())


# ---------------------------------------------------------------- all axes


class Spectrum:
    """A Kronecker sum in the eigenvectors of its factors.

    Parameters
    ----------
    shape : tuple of int
        Of the field.
    axes : sequence of AxisBasis
    shift : float
        Multiple of the identity.

    Attributes
    ----------
    eigenvalues : array
        Sums over the axes, in the shape of the coefficients: the last Fourier axis is halved, and the first axis has
        length 1 where its factor is 0.
    """

    def __init__(self, shape: tuple[int, ...], axes: tuple[AxisBasis, ...] | list[AxisBasis], shift: float) -> None:
        self.shape = shape
        self.axes = axes
        self.shift = shift
        self.fourier_axes = tuple(a for a, axis in enumerate(axes) if axis.kind == "fourier")
        self.eigenvalues = self._sums_of_eigenvalues()
        self.workers = kernels.threads() if prod(shape) >= THREADED_FROM else 1
        # The transforms along the axes, for the operator and for its transpose.
        self._to_coefficients = [self._transforms(False, transposed) for transposed in (False, True)]
        self._from_coefficients = [self._transforms(True, transposed) for transposed in (False, True)]

    def _sums_of_eigenvalues(self):
        along_axes = [axis.eigenvalues for axis in self.axes]
        if self.fourier_axes:
            last = self.fourier_axes[-1]
            along_axes[last] = along_axes[last][: self.shape[last] // 2 + 1]
        if len(self.axes) > 1 and not np.any(along_axes[0]):
            along_axes[0] = along_axes[0][:1]
        sums = reduce(np.add.outer, along_axes, np.full((), float(self.shift)))
        largest = sum(np.max(np.abs(axis.eigenvalues), initial=0.0) for axis in self.axes) + abs(self.shift)
        tolerance = ZERO_EIGENVALUE
        if not any(axis.kind == "eigenvectors" for axis in self.axes):
            tolerance *= 0.25  # eigenvalues by a formula are more accurate than computed ones
        sums[np.abs(sums) <= tolerance * largest] = 0.0
        return sums

    def _transforms(self, backward, transposed):
        """Return the functions that transform a field along the axes, in this order."""
        numbers = range(len(self.axes))
        transforms: list[Transform] = []
        for number in reversed(numbers) if backward else numbers:
            overwrite = backward or bool(transforms)  # the first one to the coefficients gets the caller's array
            transform = self.axes[number].transform(number, backward, transposed, self.workers, overwrite)
            if transform is not None:
                transforms.append(transform)
        return transforms

    def apply(self, weights: NDArray[Any], x: NDArray[Any], transposed: bool = False) -> NDArray[Any]:
        """Return f(A) x or f(A)^T x as a fresh flat array, given the values of f at the eigenvalues."""
        y = self.to_coefficients(x, transposed)
        y *= weights
        return self.from_coefficients(y, transposed)

    def to_coefficients(self, x: NDArray[Any], transposed: bool) -> NDArray[Any]:
        """Transform a flat field along all axes, into a fresh array."""
        field = x.reshape(self.shape)
        y = field
        for transform in self._to_coefficients[transposed]:
            y = transform(y)
        if self.fourier_axes:  # transformed together
            return fft.rfftn(y, axes=self.fourier_axes, workers=self.workers)
        return y.copy() if y is field else y

    def from_coefficients(self, y: NDArray[Any], transposed: bool) -> NDArray[Any]:
        """Transform coefficients to a flat field. May overwrite y."""
        if self.fourier_axes:
            lengths = [self.shape[number] for number in self.fourier_axes]
            y = fft.irfftn(y, s=lengths, axes=self.fourier_axes, overwrite_x=True, workers=self.workers)
        for transform in self._from_coefficients[transposed]:
            y = transform(y)
        return y.reshape(-1)

    def diagonal(self, weights: NDArray[Any]) -> NDArray[Any]:
        """Return the diagonal of f(A) as a flat array, given the values of f at the eigenvalues.

        Along each axis, entry i of the diagonal is the sum over k of V[i, k] V^-1[k, i] f(e_k).
        """
        first_length = len(self.axes[0].eigenvalues) if 0 not in self.fourier_axes else weights.shape[0]
        values = np.broadcast_to(weights, (first_length, *weights.shape[1:]))
        for number, axis in enumerate(self.axes):
            is_halved = bool(self.fourier_axes) and number == self.fourier_axes[-1]
            values = axis.diagonal(values, number, self.shape[number], is_halved)
        return np.array(np.broadcast_to(values, self.shape)).reshape(-1)

    def has_same_basis(self, other: Spectrum) -> bool:
        """Whether another spectrum has the same eigenvectors."""
        if self is other:
            return True
        if self.description != other.description:
            return False
        for axis, other_axis in zip(self.axes, other.axes, strict=True):
            if axis.matrices is None or other_axis.matrices is None:  # transforms of the same kind and length
                continue
            if not np.array_equal(axis.matrices, other_axis.matrices):
                return False
        return True

    @property
    def description(self) -> str:
        """The kind and length of each axis, in one line."""
        return " x ".join(f"{axis.kind}({n})" for axis, n in zip(self.axes, self.shape, strict=True))


def compute_spectrum(structure: Kronecker) -> Spectrum | None:
    """Diagonalise a Kronecker sum.

    Parameters
    ----------
    structure : Kronecker
        With `separable` true.

    Returns
    -------
    Spectrum or None
        None where an axis cannot be diagonalised to full accuracy.
    """
    shape = structure.out_parts[0]
    axes = [AxisBasis("identity", np.zeros(n)) for n in shape]
    for term in structure.terms:
        for number in term.axes:
            # The factor without its scale: multiples of an operator have the same eigenvectors, bit for bit.
            basis = diagonalise(term.factors[number])
            if basis is None:
                return None
            basis.eigenvalues = term.scale * basis.eigenvalues
            axes[number] = basis
    return Spectrum(shape, axes, structure.shift)


# ---------------------------------------------------------------- elimination along the first axis


class Elimination:
    """Elimination for (T + mode) x = b, for all modes at once, T a tridiagonal factor along a bounded first axis.

    The off-diagonal entries have one sign, and the rows sum to the other sign. Then the pivots are sums of numbers of
    one sign: no digit of a small row sum is lost. The transpose has the same pivots.

    Parameters
    ----------
    bands : Tridiagonal
    row_sums : array, shape (n,)
        Sums of the rows of T times `sign`, >= 0.
    modes : array, shape (m,)
        Numbers added to the diagonal, times `sign`, >= 0.
    sign : 1.0 or -1.0
        Sign of the diagonal.
    """

    def __init__(self, bands: Any, row_sums: NDArray[Any], modes: NDArray[Any], sign: float) -> None:
        self.lower = bands.lower
        self.upper = bands.upper
        self.inverse_pivots = np.zeros((len(row_sums), modes.size))  # 0 where the system is singular
        remainder: Any = 0.0  # of the pivot, without the upper off-diagonal entry
        for i, line in enumerate(self.inverse_pivots):
            remainder = row_sums[i] + modes + abs(self.lower[i]) * remainder * self.inverse_pivots[i - 1]
            inverted(abs(self.upper[i]) + remainder, line)
        self.inverse_pivots *= sign
        self._bands = (self.lower, self.upper), (np.roll(self.upper, 1), np.roll(self.lower, -1))

    def solve(self, x: NDArray[Any], transposed: bool) -> None:
        """Overwrite x, of shape (n, ...) with m numbers along the other axes, with the solution."""
        lower, upper = self._bands[transposed]
        kernels.sweep(x.view(float).reshape(len(x), -1), lower, upper, self.inverse_pivots)


def _find_elimination(factor, modes):
    """Return the Elimination for a square 1-D factor plus each mode, or None where it could lose digits.

    It needs a tridiagonal factor without a periodic link, off-diagonal entries of one sign, and row sums and modes of
    the other sign.
    """
    bands = factor.tridiagonal
    if bands is None or bands.lower[0] or bands.upper[-1] or not np.any(bands.centre):
        return None
    sign = float(np.sign(bands.centre[np.argmax(np.abs(bands.centre))]))
    off_diagonal = np.abs(bands.lower) + np.abs(bands.upper)
    row_sums = sign * bands.centre - off_diagonal
    row_sums[np.abs(row_sums) <= ROUNDING * off_diagonal] = 0.0
    if np.any(sign * bands.lower > 0) or np.any(sign * bands.upper > 0):
        return None
    if np.any(row_sums < 0) or np.any(sign * modes < 0):
        return None
    return Elimination(bands, row_sums, sign * modes, sign)


# ---------------------------------------------------------------- the engine


class Separable(Engine):
    """The engine of method "separable": forward transforms, division by the eigenvalues, backward transforms.

    Parameters
    ----------
    spectrum : Spectrum
        Of all axes; where elimination replaces the division, of all but the first.
    divide : callable
        ``divide(y, transposed)`` overwrites the coefficients y with those of the solution.
    hierarchy : str
    """

    method = "separable"
    unit = "refinements"

    def __init__(self, spectrum: Spectrum, divide: Callable[[NDArray[Any], bool], Any], hierarchy: str) -> None:
        self.spectrum = spectrum
        self.divide = divide
        self.hierarchy = hierarchy

    def solve(self, b: NDArray[Any], goal: float, transposed: bool) -> tuple[NDArray[Any], int, str]:
        """Solve A x = b or A^T x = b: see `Engine`."""
        y = self.spectrum.to_coefficients(b, transposed)
        self.divide(y, transposed)
        return self.spectrum.from_coefficients(y, transposed), 0, ""


def transform_engine(system: System, spectrum: Spectrum, eigenvalues: NDArray[Any]) -> Separable:
    """Build the engine from the eigenbasis of a system's operator.

    Elimination replaces the transforms along the first axis where it is as accurate and faster.

    Parameters
    ----------
    system : System
    spectrum : Spectrum
    eigenvalues : array
        Of the operator, in the basis of the spectrum.

    Returns
    -------
    Separable
    """
    structure = system.op.structure
    if not structure.separable and np.all(eigenvalues):  # an eigenvalue of 1 beside 1e16 would count as 0 in products
        system.null_space = NullSpace.none(system.size)
    if structure.separable:
        engine = _elimination_engine(structure, spectrum)
        if engine is not None:
            return engine
    reciprocals = inverted(eigenvalues)

    def divide(y, transposed):
        np.multiply(y, reciprocals, out=y)

    return Separable(spectrum, divide, spectrum.description)


def _elimination_engine(structure, spectrum):
    """Return the engine with elimination along the first axis, or None where transforms are as good or better."""
    first_length = spectrum.shape[0]
    smallest_width = ELIMINATION_FROM_COMPILED if kernels.compiled() else ELIMINATION_FROM_NUMPY
    if 0 not in structure.lines or first_length < 3 or spectrum.eigenvalues[0].size < smallest_width:
        return None
    first_axis = AxisBasis("identity", np.zeros(first_length))
    other_axes = Spectrum(spectrum.shape, (first_axis, *spectrum.axes[1:]), spectrum.shift)
    modes = other_axes.eigenvalues[0].reshape(-1)
    if other_axes.fourier_axes:  # coefficients are complex: real and imaginary parts are separate systems
        modes = np.repeat(modes, 2)
    elimination = _find_elimination(structure.lines[0], modes)
    if elimination is None:
        return None
    description = f"elimination({first_length}) x {spectrum.description.split(' x ', 1)[1]}"
    return Separable(other_axes, elimination.solve, description)


def separable_engine(system: System) -> Separable:
    """Set up transforms along the axes, for Kronecker sums whose factors can be diagonalised, and their functions.

    Parameters
    ----------
    system : System

    Returns
    -------
    Separable

    Raises
    ------
    ValueError
        If the operator is not such a sum.
    """
    basis = None
    if system.active is None:
        basis = find_eigenbasis(system.op.structure)
    if basis is None:
        raise ValueError(f"separable needs a sum of 1-D factors that can be diagonalised, got {system.unscaled}")
    return transform_engine(system, *basis)


# ---------------------------------------------------------------- functions of a Kronecker sum


class Eigenbasis(NamedTuple):
    """The eigenvectors of a Kronecker sum, and the eigenvalues of one of its functions.

    Attributes
    ----------
    spectrum : Spectrum
    eigenvalues : array
        Of the function, in the shape of `spectrum.eigenvalues`.
    """

    spectrum: Spectrum
    eigenvalues: NDArray[Any]


class SpectralFunction(Transposable):
    """The structure of a function f(A) of a Kronecker sum A: one pair of transforms.

    Parameters
    ----------
    inner : Eigenbasis
        The basis of A, and the values of f at its eigenvalues.
    shape : tuple of int
    transposed : bool
    """

    @property
    def is_symmetric(self) -> bool:
        """Whether f(A) is its own transpose: its eigenvectors are orthonormal and its eigenvalues real."""
        spectrum, weights = self.inner
        return not np.iscomplexobj(weights) and all(axis.matrices is None for axis in spectrum.axes)

    def act(self, x: NDArray[Any], out: NDArray[Any]) -> None:
        """Set out = f(A) x, or the transpose of f(A) times x."""
        spectrum, weights = self.inner
        out[...] = spectrum.apply(weights, x, self.transposed)

    def scaled(self, factor: ArrayLike) -> SpectralFunction | None:
        """Return the structure times a real factor; None for a complex one."""
        if np.iscomplexobj(factor):
            return None
        spectrum, weights = self.inner
        return SpectralFunction(Eigenbasis(spectrum, weights * factor), self.shape, self.transposed)


def find_eigenbasis(structure: Structure) -> Eigenbasis | None:
    """Return the eigenbasis of a diagonal, a Kronecker sum, or a function of one; None of other structures.

    Sums and products of functions of one Kronecker sum are such functions too.
    """
    if isinstance(structure, Diagonal) and structure.dtype == float:
        size = structure.shape[0]
        identity = AxisBasis("identity", np.zeros(size))
        return Eigenbasis(Spectrum((size,), (identity,), 0.0), structure.values)
    if isinstance(structure, SpectralFunction) and (structure.is_symmetric or not structure.transposed):
        return structure.inner
    if isinstance(structure, Sum):
        return _combine_eigenbases(structure.members, np.add)
    if isinstance(structure, Chain):
        return _combine_eigenbases(structure.members, np.multiply)
    if isinstance(structure, Kronecker) and structure.separable:
        spectrum = compute_spectrum(structure)
        if spectrum is not None:
            return Eigenbasis(spectrum, spectrum.eigenvalues)
    return None


def _combine_eigenbases(members, operation):
    """Return the eigenbasis of a sum or a product of structures with a common basis, else None."""
    spectrum = None
    eigenvalues: list = []
    for member in members:
        if isinstance(member, Kronecker) and member.separable and not member.lines:  # a multiple of the identity
            eigenvalues.append(float(member.shift))
            continue
        basis = find_eigenbasis(member)
        if basis is None or (spectrum is not None and not spectrum.has_same_basis(basis.spectrum)):
            return None
        spectrum = basis.spectrum
        eigenvalues.append(basis.eigenvalues)
    if spectrum is None:
        return None
    return Eigenbasis(spectrum, reduce(operation, eigenvalues))


def require_eigenbasis(op: Operator, name: str, advice: str = "") -> Eigenbasis:
    """Return the eigenbasis of an operator.

    Parameters
    ----------
    op : Operator
    name : str
        Of the function that needs it, for messages.
    advice : str
        Appended to the message: what to write instead.

    Returns
    -------
    Eigenbasis

    Raises
    ------
    TypeError
        If `op` is not an Operator.
    ValueError
        If it is neither separable nor a function of a separable operator, or cannot be diagonalised.
    """
    check_type(name, op, Operator, "an Operator", "dp.from_matrix(...) first")
    basis = find_eigenbasis(op.structure)
    if basis is None:
        raise ValueError(f"{name} needs a separable operator that can be diagonalised, got {op}{advice}")
    return basis
