"""separable: any Kronecker sum solved by transforms along its axes. Two transforms an axis, no iteration.

    A = sum over axes of (1 x F_a x 1) + shift,    F_a = S_a^-1 Q_a diag(e_a) Q_a^-1 S_a
    f(A) = (product of S_a^-1 Q_a) diag f(sum e_a + shift) (product of Q_a^-1 S_a)

so one diagonalisation gives the inverse (1 / e, 0 for the null space), powers and exponentials. S_a is diagonal (on a
stretched grid the square root of the cell widths) and Q_a orthogonal: a sine or cosine transform where the axis is
uniform, else eigenvectors; or the discrete Fourier transform. The inverse
needs no transform along a bounded first axis where elimination along it is as accurate and takes less time:
T + e for each sum e of the eigenvalues of the other axes, T the factor of the first (see `Sweep`). Round a periodic
one elimination is possible too, and only 1.1 to 1.7 times as fast as the transform: it is left out.
Sources: Lynch, Rice, Thomas, Numer. Math. 6 (1964), direct solution by tensor products;
Strang, SIAM Review 41 (1999), the discrete cosine transform; Hockney, J. ACM 12 (1965), transforms along one
axis and elimination along the other; Grassmann, Taksar, Heyman, Operations Research 33 (1985), pivots without
subtractions.
"""

from functools import reduce
from math import prod

import numpy as np
import scipy.fft as fft
import scipy.linalg

from sparsedp import kernels
from sparsedp._utils.validation import EPS, check_type
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Turning
from sparsedp.operators.structure.kronecker import Kronecker
from sparsedp.operators.structure.lazy import Chain, Diagonal, Sum
from sparsedp.solvers.engine import Engine
from sparsedp.solvers.nullspace import NullSpace
from sparsedp.solvers.scaling import inverted

__all__ = [
    "Separable",
    "SpectralFunction",
    "Spectrum",
    "diagonalised",
    "eigenbasis",
    "separable_engine",
    "spectrum",
    "transforming",
]

WORTH_THREADS = 131072  # unknowns below which a second thread costs more than it brings
WIDE_COMPILED, WIDE_PLAIN = 16, 1024  # modes from which elimination along the first axis beats transforms
ZERO = 4 * EPS  # a sum of eigenvalues below this share of the largest one is 0
ROUNDING = 16 * EPS  # entries that should be equal may differ by this share
WIDEST = 1e4  # largest ratio of scalings that keeps the digits of the eigenvectors

TRANSFORMS = {"dct": (fft.dct, fft.idct), "dst": (fft.dst, fft.idst)}  # to the coefficients, and back
# What the walls do to a wave at its lower and upper end -> its transform, and the shift of the frequencies.
WAVES = {
    ("neumann", "neumann"): ("dct-2", 0.0),
    ("dirichlet", "dirichlet"): ("dst-2", 1.0),
    ("neumann", "dirichlet"): ("dct-4", 0.5),
    ("dirichlet", "neumann"): ("dst-4", 0.5),
}


# ---------------------------------------------------------------- one axis


class Axis:
    """One axis of a separable operator in its eigenvectors.

    Parameters
    ----------
    kind : str
        "identity", "dct-2", "dst-2", "dct-4", "dst-4", "fourier" or "eigenvectors".
    eigenvalues : array, shape (n,)
    matrices : (Q^-1 S, S^-1 Q), optional
        Of eigenvectors.
    """

    def __init__(self, kind, eigenvalues, matrices=None):
        self.kind, self.eigenvalues, self.matrices = kind, eigenvalues, matrices

    def turned(self, back, x, axis, transposed, workers, overwrite):
        """Field along `axis` -> coefficients, or `back`; a Fourier axis is left as it is.

        `overwrite`: whether the memory of x may be used.
        """
        if self.matrices is not None:
            matrix, n = self.matrices[1 - back].T if transposed else self.matrices[back], x.shape[axis]
            if axis == x.ndim - 1:
                return (x.reshape(-1, n) @ matrix.T).reshape(x.shape)
            return np.matmul(matrix, x.reshape(-1, n, prod(x.shape[axis + 1 :]))).reshape(x.shape)
        if self.kind in ("identity", "fourier"):
            return x
        transform, number = TRANSFORMS[self.kind[:3]][back], int(self.kind[-1])
        return transform(x, number, axis=axis, norm="ortho", overwrite_x=overwrite, workers=workers)


def diagonalise(factor):
    """Square 1-D factor -> Axis, or None when it cannot be diagonalised with all its digits.

    Parameters
    ----------
    factor : Factor

    Returns
    -------
    Axis or None
    """
    if factor.shape[0] == 1:
        return Axis("identity", np.array([factor.matrix[0, 0]]))
    return (factor.tridiagonal and _by_transform(factor.tridiagonal)) or _by_eigenvectors(factor)


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
    if ends not in WAVES:
        return None
    kind, shift = WAVES[ends]
    return Axis(kind, _cosines(middle, side, (angle + shift) / n))


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


def _by_eigenvectors(factor):
    """The eigenvectors of a factor that is symmetric, after scaling its rows where it has three points a row."""
    exponent = np.frexp(factor.largest)[1]  # products of entries stay within floats, whatever the unit of length
    dense = np.ldexp(factor.matrix.toarray(), -exponent)
    scaling = np.ones(len(dense)) if factor.tridiagonal is None else _scaling(dense)
    if scaling is None:
        return None
    dense = dense * scaling[:, None] / scaling
    if not np.allclose(dense, dense.T, rtol=1e-13, atol=1e-14 * np.max(np.abs(dense))):
        return None  # or the link around a periodic axis does not fit the weights
    dense = 0.5 * (dense + dense.T)
    if len(dense) <= 2 or np.any(np.triu(dense, 2)):
        values, vectors = scipy.linalg.eigh(dense, driver="evd")
    else:
        values, vectors = scipy.linalg.eigh_tridiagonal(np.diag(dense), np.diag(dense, 1))
    rows, sizes = factor.matrix.sum(axis=1), abs(factor.matrix).sum(axis=1)
    if np.all(np.abs(rows) <= 8 * EPS * sizes):  # constants have the eigenvalue 0, where round-off gives 1e-10
        values[np.argmin(np.abs(values))] = 0.0
    return Axis("eigenvectors", np.ldexp(values, exponent), (vectors.T * scaling, (1 / scaling)[:, None] * vectors))


def _scaling(dense):
    """Square roots of the weights w with w[i] F[i, i+1] = w[i+1] F[i+1, i], or None."""
    up, down = dense.diagonal(1), dense.diagonal(-1)
    linked = up != 0
    if np.any(linked != (down != 0)) or np.any(up * down < 0):
        return None
    ratio = np.where(linked, up / np.where(linked, down, 1.0), 1.0)
    weights = np.cumprod(np.concatenate([[1.0], ratio]))
    if not np.all(np.isfinite(weights)) or weights.max() > WIDEST**2 * weights.min():
        return None
    return np.sqrt(weights / weights.max())


# ---------------------------------------------------------------- all axes


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
        self.shape, self.axes, self.shift = shape, axes, shift
        self.fourier = tuple(a for a, axis in enumerate(axes) if axis.kind == "fourier")
        lines = [axis.eigenvalues for axis in axes]
        for last in self.fourier[-1:]:
            lines[last] = lines[last][: shape[last] // 2 + 1]
        if len(axes) > 1 and not np.any(lines[0]):
            lines[0] = lines[0][:1]  # one line of sums serves all
        total = reduce(np.add.outer, lines, np.full((), float(shift)))
        largest = sum(np.max(np.abs(axis.eigenvalues), initial=0.0) for axis in axes) + abs(shift)
        # Eigenvalues that were computed, not written down, are only known to some rounding.
        uncertain = 1.0 if any(axis.kind == "eigenvectors" for axis in axes) else 0.25
        total[np.abs(total) <= ZERO * largest * uncertain] = 0.0
        self.eigenvalues = total
        self.workers = kernels.threads() if prod(shape) >= WORTH_THREADS else 1

    def apply(self, weights, x, transposed=False):
        """f(A) x for the given values of f on the eigenvalues, as a fresh array."""
        y = self.forward(x, transposed)
        y *= weights
        return self.backward(y, transposed)

    def forward(self, x, transposed):
        """Flat field -> its coefficients, as a fresh array."""
        x = y = x.reshape(self.shape)
        for a, axis in enumerate(self.axes):
            y = axis.turned(0, y, a, transposed, self.workers, y is not x)
        if self.fourier:  # these axes are transformed together
            return fft.rfftn(y, axes=self.fourier, workers=self.workers)
        return y.copy() if y is x else y

    def backward(self, y, transposed):
        """Coefficients -> flat field. May overwrite y."""
        if self.fourier:
            lengths = [self.shape[a] for a in self.fourier]
            y = fft.irfftn(y, s=lengths, axes=self.fourier, overwrite_x=True, workers=self.workers)
        for a in reversed(range(len(self.axes))):
            y = self.axes[a].turned(1, y, a, transposed, self.workers, True)
        return y.reshape(-1)

    def same_basis(self, other):
        """Whether the other one has the same eigenvectors."""
        if self is other or self.words != other.words:
            return self is other
        pairs = zip(self.axes, other.axes, strict=True)
        return all(np.array_equal(a.matrices, b.matrices) for a, b in pairs if a.matrices is not None)

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
    axes = [Axis("identity", np.zeros(n)) for n in shape]
    for term in structure.terms:
        for a in term.axes:  # without its scale: multiples have the same eigenvectors, to the same bits
            axes[a] = axis = diagonalise(term.factors[a])
            if axis is None:
                return None
            axis.eigenvalues = term.scale * axis.eigenvalues
    return Spectrum(shape, axes, structure.shift)


# ---------------------------------------------------------------- elimination along the first axis


class Sweep:
    """(T + mode) x = b for all modes at once, T a three-point factor along a bounded first axis: elimination.

    With off-diagonal entries of one sign and rows that sum to the other, no pivot takes a subtraction: every digit of
    a small sum is kept. The transpose has the same pivots.

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
        self.lower, self.upper, rest = bands.lower, bands.upper, 0.0
        self.inverses = np.zeros((len(excess), modes.size))  # of the pivots; 0 where the system is singular
        for i, line in enumerate(self.inverses):
            rest = excess[i] + modes + abs(self.lower[i]) * rest * self.inverses[i - 1]
            inverted(abs(self.upper[i]) + rest, line)
        self.inverses *= sign

    def solve(self, x, transposed):
        """x, shape (n, ...) with m numbers for each of the n, is overwritten with the solution."""
        bands = (np.roll(self.upper, 1), np.roll(self.lower, -1)) if transposed else (self.lower, self.upper)
        kernels.sweep(x.view(float).reshape(len(x), -1), *bands, self.inverses)


def sweep(factor, modes):
    """Square 1-D factor, numbers that are added to its diagonal -> Sweep, or None when it might lose digits.

    Needed are three points a row, no link round the end, off-diagonal entries of one sign, and rows that sum to the
    other one.
    """
    bands = factor.tridiagonal
    if bands is None or bands.lower[0] or bands.upper[-1] or not np.any(bands.centre):
        return None
    sign = float(np.sign(bands.centre[np.argmax(np.abs(bands.centre))]))
    links = np.abs(bands.lower) + np.abs(bands.upper)
    excess = sign * bands.centre - links
    excess[np.abs(excess) <= ROUNDING * links] = 0.0
    against = np.concatenate([sign * bands.lower, sign * bands.upper])
    if np.any(against > 0) or np.any(excess < 0) or np.any(sign * modes < 0):
        return None
    return Sweep(bands, excess, sign * modes, sign)


# ---------------------------------------------------------------- the engine


class Separable(Engine):
    """The engine: forward transforms, division by the eigenvalues, backward transforms.

    Parameters
    ----------
    spectrum : Spectrum
        Of all axes; where elimination takes the place of division, of all but the first.
    divide : callable
        ``divide(y, transposed)``: coefficients, which are overwritten.
    hierarchy : str
    """

    method = "separable"
    unit = "refinements"

    def __init__(self, spectrum, divide, hierarchy):
        self.spectrum, self.divide, self.hierarchy = spectrum, divide, hierarchy

    def solve(self, b, goal, transposed):
        y = self.spectrum.forward(b, transposed)
        self.divide(y, transposed)
        return self.spectrum.backward(y, transposed), 0, ""


def transforming(system, found, eigenvalues):
    """System and its `eigenbasis` -> Separable, without transforms along the first axis unless they are as good."""
    structure, first, wide = system.op.structure, found.shape[0], WIDE_COMPILED if kernels.compiled() else WIDE_PLAIN
    if not structure.separable and np.all(eigenvalues):  # an eigenvalue 1 beside 1e16 would count as 0 in products
        system.null_space = NullSpace.none(system.size)
    if structure.separable and 0 in structure.lines and first >= 3 and found.eigenvalues[0].size >= wide:
        rest = Spectrum(found.shape, (Axis("identity", np.zeros(first)), *found.axes[1:]), found.shift)
        sums = rest.eigenvalues[0].reshape(-1)
        elimination = sweep(structure.lines[0], np.repeat(sums, 2) if rest.fourier else sums)  # both parts of complex
        if elimination is not None:
            words = f"elimination({first}) x {found.words.split(' x ', 1)[1]}"
            return Separable(rest, elimination.solve, words)
    weights = inverted(eigenvalues)
    return Separable(found, lambda y, transposed: np.multiply(y, weights, out=y), found.words)


def separable_engine(system):
    """Engine: transforms along the axes. For Kronecker sums whose factors can be diagonalised, and what is made of one.

    Parameters
    ----------
    system : System

    Raises
    ------
    ValueError
        If the operator is not such a sum.
    """
    found = eigenbasis(system.op.structure) if system.active is None else None
    if found is None:
        raise ValueError(f"separable needs a sum of 1-D factors that can be diagonalised, got {system.given}")
    return transforming(system, *found)


# ---------------------------------------------------------------- functions of a Kronecker sum


class SpectralFunction(Turning):
    """f(A) for a Kronecker sum A, as a structure: one pair of transforms. `inner`: (Spectrum, f on the eigenvalues)."""

    def act(self, x, out):
        spectrum, weights = self.inner
        out[...] = spectrum.apply(weights, x, self.transposed)

    def scaled(self, factor):
        spectrum, weights = self.inner
        real = not np.iscomplexobj(factor)
        return SpectralFunction((spectrum, weights * factor), self.shape, self.transposed) if real else None


def eigenbasis(structure):
    """(Spectrum, eigenvalues) of a diagonal, a Kronecker sum, and what is made of one; None of others.

    Made of one are its functions, and sums and products of these.
    """
    if isinstance(structure, Diagonal) and structure.dtype == float:
        size = structure.shape[0]
        return Spectrum((size,), (Axis("identity", np.zeros(size)),), 0.0), structure.values
    if isinstance(structure, SpectralFunction) and not structure.transposed:
        return structure.inner
    if isinstance(structure, (Sum, Chain)):
        return _together(structure.members, np.add if isinstance(structure, Sum) else np.multiply)
    found = spectrum(structure) if isinstance(structure, Kronecker) and structure.separable else None
    return None if found is None else (found, found.eigenvalues)


def _together(members, combined):
    """The same of a sum or a product of structures, where one basis is that of all of them."""
    basis, values = None, []
    for member in members:
        if isinstance(member, Kronecker) and member.separable and not member.lines:  # a number times the identity
            values.append(float(member.shift))
            continue
        found = eigenbasis(member)
        if found is None or not (basis is None or basis.same_basis(found[0])):
            return None
        basis = found[0]
        values.append(found[1])
    return None if basis is None else (basis, reduce(combined, values))


def diagonalised(op, name, advice=""):
    """(Spectrum, eigenvalues) of an operator that is separable, or made of such ones; `name` needs them."""
    check_type(name, op, Operator, "an Operator", "dp.from_matrix(...) first")
    found = eigenbasis(op.structure)
    if found is None:
        raise ValueError(f"{name} needs a separable operator that can be diagonalised, got {op}{advice}")
    return found
