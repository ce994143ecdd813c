"""Eigenvalues and eigenvectors of plain operators: the pairs of A v = lambda M v nearest to an end or to a number.

Notes
-----
Three methods: LAPACK on the full matrix, ARPACK in shift-invert mode, whose solves are those of `inverse`, and LOBPCG,
whose preconditioner is an approximate solve. ARPACK and LOBPCG start from a fixed vector, so that results are
reproducible. The results are completed and tested:

1. Missing copies: a Krylov space that starts from one vector contains one copy of a multiple eigenvalue; others enter
   by rounding errors, or never. So ARPACK is repeated in the complement of the known vectors, until it finds no nearer
   eigenvalue. After LOBPCG, the negative pivots of A - sigma M count the eigenvalues below the last one.
2. Steps of inverse iteration with a Rayleigh-Ritz projection bring residuals of ARPACK and LOBPCG to the level of
   rounding errors. ARPACK follows LAPACK if the residuals of LAPACK are too large.
3. The residual of every pair is computed and tested.
4. The sign of a vector is fixed: its first large entry is positive.

References
----------
B. N. Parlett, The symmetric eigenvalue problem, SIAM, 1998: shift-invert, inertia counts, Rayleigh-Ritz projections.
"""

from __future__ import annotations

from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from sparsedp._utils.validation import EPS, check_finite
from sparsedp.errors import ConvergenceError
from sparsedp.operators.masks_and_lift import diagonal, identity
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.lazy import Diagonal
from sparsedp.solvers.choose_method import SolveSettings
from sparsedp.solvers.inverse import build
from sparsedp.solvers.records import failure
from sparsedp.solvers.scaling import exponent_of
from sparsedp.solvers.system import System

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

__all__ = [
    "AT_ROUNDOFF",
    "DENSE_UP_TO",
    "METHODS",
    "ROUNDING",
    "EigenSettings",
    "Pencil",
    "Spectrum",
    "general_values",
    "symmetric_pairs",
    "with_fixed_sign",
]

METHODS = ("auto", "dense", "arpack", "lobpcg")
DENSE_UP_TO = 512  # unknowns for which "auto" takes LAPACK: 0.1 s
GENERAL_DENSE_UP_TO = 1024  # the same for operators that are not symmetric: 1 s
DENSE_AT_MOST = 20_000  # unknowns for which "dense" is accepted: a matrix of 3 GB
DENSE_SHARE = 4  # "auto" takes LAPACK too for more than one eigenvalue in 4
# Distance of the shift from 0 for operators without negative eigenvalues, relative to the mean size of the rows. It is
# larger where 0 is an eigenvalue and multigrid solves, whose cycles in single precision must see the shift.
SHIFT = 1e-10
SHIFT_OF_SINGULAR = 1e-6
SHIFT_OF_INDEFINITE = 1e-4  # the same for operators with negative eigenvalues
CLEARANCE = 1e-3  # smallest distance of the first shift below negative eigenvalues from them, relative to the shift
OFFSET_OF_SHIFT = 1e-11  # distance from a shift of the user, which may be an eigenvalue, relative to the mean size
# The same for operators that are not symmetric: values at distance d have errors of EPS d^2 / offset.
OFFSET_OF_GENERAL_SHIFT = 1e-6
SYMMETRIC = 1e-12  # two products that should be equal may differ by this share of their sizes
LARGEST_EXPONENT = 200  # an operator or a mass beyond this power of two is scaled
ROUNDING = 1e-12  # eigenvalues that differ by this share of the size of the operator are equal
SINGULAR_MASS = 1e12  # condition number beyond which a mass counts as singular
LARGEST_FINITE = 1e3  # in units of the largest row of A over the mean of M: a larger eigenvalue is one at infinity
LARGEST_RESIDUAL = 1e-2  # relative, of a solve with A - sigma M; more if it is singular and errors are projected out
AT_ROUNDOFF = 128 * EPS  # residuals below this share of the terms are rounding errors
ZERO_AT_ROUNDOFF = 4 * EPS  # lambda M v below this share of the terms of A v is 0
LARGE_CONTRAST = 1e6  # of the mass; beyond it, errors name it as the reason
COUNTED_UP_TO = 20_000  # unknowns up to which a factorisation tests that lobpcg missed no eigenvalue
COUNTED_BELOW = 1e-8  # relative distance below the last eigenvalue from which others are counted
INNER_RTOL = 1e-11  # of the solves inside of ARPACK
ARPACK_TOLERANCE = 1e-11  # a step of inverse iteration follows
SEARCH_TOLERANCE = 1e-6  # of ARPACK in the search for missing copies
MOST_RESTARTS = 64  # for missing copies
TIE = 1e-9  # eigenvalues that are nearer by less than this share count as equally near in that search
MOST_STEPS = 20  # of inverse iteration after ARPACK or LOBPCG
INERTIA_UP_TO = 300_000  # unknowns for which a factorisation counts the eigenvalues below a shift


@dataclass(frozen=True)
class EigenSettings:
    """The options of `eigenpairs`, after their checks.

    Attributes
    ----------
    k : int
    which : "smallest", "largest" or number
    symmetric : bool
    cluster : float
    method : one of METHODS
    rtol : float
    maxiter : int or None
    """

    k: int
    which: Any
    symmetric: bool
    cluster: float
    method: str
    rtol: float
    maxiter: int | None


@dataclass(frozen=True)
class Spectrum:
    """Pairs of a pencil.

    Attributes
    ----------
    values : array, shape (k,)
        Ascending.
    vectors : array, shape (k, n)
        v_i^H M v_j is 1 for i = j and 0 otherwise.
    beyond : array
        The nearest eigenvalues that do not belong to the k: one, or none if there are no others.
    """

    values: NDArray[Any]
    vectors: NDArray[Any]
    beyond: NDArray[Any]


class Pencil:
    """The operators A and M of A v = lambda M v as functions of flat arrays, scaled so that squares do not overflow.

    Parameters
    ----------
    op : Operator
    mass : None, number, array of the shape of a field, or Operator
        M: the identity for None, and a diagonal matrix for a number or an array.
    rtol : float
        Largest relative residual of a pair.
    symmetric : bool
        Whether `weights` make A and M symmetric.

    Attributes
    ----------
    name : str
        Name of A in messages.
    exponent : int
        Eigenvalues are those of the pencil times 2^exponent.
    mass_exponent : int
        Eigenvectors are those of the pencil times 2^(-mass_exponent / 2); it is even.
    """

    def __init__(self, op: Operator, mass: Any, rtol: float, symmetric: bool = True) -> None:
        self.name = op.name
        self._symmetric = symmetric
        self.system = System(op)
        self.op = self.system.op
        self.rtol = rtol
        self.size = op.domain.size
        self.complex = op.dtype.kind == "c" or (isinstance(mass, Operator) and mass.dtype.kind == "c")
        self.mass_exponent = 0
        if mass is not None and not isinstance(mass, Operator):
            mass = np.broadcast_to(np.asarray(mass, float), op.domain.shape)
        self.mass = self._scaled(mass)
        self.exponent = self.system.exponent - self.mass_exponent

    def _scaled(self, mass):
        """Return the mass divided by an even power of two."""
        if mass is None:
            return None
        if isinstance(mass, Operator):
            size = float(np.max(mass.structure.magnitude()(np.ones(self.size)), initial=0.0))
        else:
            size = float(np.max(mass, initial=0.0))
        exponent = exponent_of(size)
        if abs(exponent) <= LARGEST_EXPONENT:
            return mass
        self.mass_exponent = exponent - exponent % 2
        if isinstance(mass, Operator):
            return mass * 2.0 ** -(self.mass_exponent // 2) * 2.0 ** -(self.mass_exponent // 2)
        return np.ldexp(mass, -self.mass_exponent)

    # ------------------------------------------------------------ unknowns and inner product

    @cached_property
    def active(self) -> NDArray[Any] | None:
        """The unknowns as a boolean array, None when all are: an operator on a grid does not use solid cells."""
        if self.op.domain.grid is None or isinstance(self.op.structure, Diagonal):
            return None
        return self.system.active

    @cached_property
    def unknowns(self) -> int:
        """The number of unknowns."""
        return self.size if self.active is None else int(np.count_nonzero(self.active))

    @cached_property
    def weights(self) -> Any:
        """Positive w such that diag(w) A and diag(w) M are symmetric: 1.0, an array, or None when none is known.

        It is 1.0 if they need not be symmetric.
        """
        if not self._symmetric:
            return 1.0
        candidates: list[Any] = [1.0]
        if not self.complex and not self.system.uniform:
            space = self.op.domain if self.op.domain.grid is not None else self.op.codomain
            volumes = np.asarray(space.volumes).reshape(-1)
            candidates += [volumes, 1.0 / volumes]
        for weights in candidates:
            if self._is_symmetric(self._stiffness, weights, self.system.magnitude):
                return weights
        return None

    @cached_property
    def mass_is_symmetric(self) -> bool:
        """Whether diag(w) M is symmetric."""
        if not isinstance(self.mass, Operator):
            return True
        return self._is_symmetric(self._plain_mass, self.weights, self.mass.structure.magnitude())

    def _is_symmetric(self, product, weights, magnitude):
        """Return whether y . w A x and x . w A y are equal for random x and y, relative to their terms."""
        x, y = np.random.default_rng(0).standard_normal((2, self.size))
        x = self.masked(x)
        y = self.masked(y)
        one = y @ (weights * product(x))
        other = np.conj(x @ (weights * product(y)))
        size = np.abs(y) @ (weights * magnitude(np.abs(x)))
        return bool(abs(one - other) <= SYMMETRIC * size)

    @property
    def mass_contrast(self) -> float:
        """The largest entry on the diagonal of M divided by the smallest, for a positive M with entries; else 1."""
        if self.mass is None or (isinstance(self.mass, Operator) and not self.mass.structure.has_entries):
            return 1.0
        diagonal = self.matrices[1].diagonal().real
        return float(np.max(diagonal) / np.min(diagonal)) if np.min(diagonal) > 0 else 1.0

    def masked(self, x: NDArray[Any]) -> NDArray[Any]:
        """Return a vector with 0 in the entries that are not unknowns."""
        return x if self.active is None else np.where(self.active, x, 0.0)

    # ------------------------------------------------------------ products

    def _stiffness(self, x):
        """Return A x."""
        return self.masked(self.op._acting.product(x))

    def _plain_mass(self, x):
        """Return M x."""
        if self.mass is None:
            return x
        if isinstance(self.mass, Operator):
            return self.masked(self.mass._acting.product(x))
        return self.mass.reshape(-1) * x

    def apply_stiffness(self, x: NDArray[Any]) -> NDArray[Any]:
        """Return diag(w) A x."""
        return self.weights * self._stiffness(np.ascontiguousarray(x))

    def apply_mass(self, x: NDArray[Any]) -> NDArray[Any]:
        """Return diag(w) M x."""
        return self.weights * self._plain_mass(np.ascontiguousarray(x))

    @cached_property
    def scale(self) -> float:
        """The mean sum of magnitudes in a row of A, divided by the mean of M; 1.0 if A is 0."""
        return float(np.mean(self._row_sums)) or 1.0

    @property
    def _row_sums(self):
        """Sums of magnitudes in the rows of the unknowns of A, divided by the mean of M."""
        sums = self.weights * self.masked(self.system.magnitude(self.masked(np.ones(self.size))))
        if self._symmetric:
            signs = self.start
            mass = float(np.real(np.vdot(signs, self.apply_mass(signs)))) / float(np.real(np.vdot(signs, signs)))
        else:
            mass = self._mean_of_mass
        if self.active is not None:
            sums = sums[self.active]
        return sums / mass if mass > 0 else 0.0 * sums

    @property
    def _mean_of_mass(self):
        """Mean sum of magnitudes in the rows of M: a mass that is not symmetric may be of both signs."""
        if self.mass is None:
            return 1.0
        if isinstance(self.mass, Operator):
            sums = self.masked(self.mass.structure.magnitude()(self.masked(np.ones(self.size))))
        else:
            sums = self.masked(np.abs(self.mass.reshape(-1)))
        return float(np.sum(sums)) / max(self.unknowns, 1)

    @cached_property
    def start(self) -> NDArray[Any]:
        """The vector with which iterations start: random numbers from a fixed seed."""
        return self.start_of_search(0)

    def start_of_search(self, count: int) -> NDArray[Any]:
        """Return the vector with which a search in the complement of a number of known vectors starts.

        The component of one start in an eigenspace is the copy that its Krylov space contains. In the complement of
        this copy the same start has nothing of the eigenspace but rounding errors, so each search needs another one.
        """
        seed = 1 + count
        return self.masked(np.random.default_rng(seed).standard_normal(self.size)).astype(self.dtype)

    @property
    def dtype(self) -> Any:
        """float, or complex for complex operators."""
        return complex if self.complex else float

    # ------------------------------------------------------------ matrices

    @cached_property
    def matrices(self) -> tuple[Any, Any]:
        """diag(w) A and diag(w) M on the unknowns, as sparse matrices."""
        keep = np.arange(self.size) if self.active is None else np.flatnonzero(self.active)
        weights = sp.diags_array(np.broadcast_to(self.weights, self.size)[keep])
        stiffness = weights @ _matrix(self.op)[keep][:, keep]
        if self.mass is None:
            mass = weights
        elif isinstance(self.mass, Operator):
            mass = weights @ _matrix(self.mass)[keep][:, keep]
        else:
            mass = weights @ sp.diags_array(self.mass.reshape(-1)[keep])
        return sp.csr_array(stiffness), sp.csr_array(mass)

    def embedded(self, vectors: NDArray[Any]) -> NDArray[Any]:
        """Return vectors of the unknowns, in rows, as vectors of all numbers of a field."""
        if self.active is None:
            return vectors
        full = np.zeros((len(vectors), self.size), vectors.dtype)
        full[:, self.active] = vectors
        return full

    # ------------------------------------------------------------ shifted operators

    def shifted(self, sigma: float) -> Operator:
        """Return the operator A - sigma M."""
        if self.mass is None:
            mass = identity(self.op.domain)
        elif isinstance(self.mass, Operator):
            mass = self.mass
        elif np.all(self.mass == self.mass.flat[0]):
            mass = float(self.mass.flat[0]) * identity(self.op.domain)
        else:
            mass = diagonal(self.op.domain, self.mass)
        shifted = self.op + (-sigma) * mass
        return Operator(shifted.structure, self.op.domain, self.op.domain, f"shift of {self.name}")

    def shifted_inverse(self, sigma: float, rtol: float, definite: bool) -> Callable:
        """Return the function that maps b to the solution x of diag(w) (A - sigma M) x = b.

        Parameters
        ----------
        sigma : float
        rtol : float
            Relative tolerance of a solve.
        definite : bool
            Whether the shift is below the spectrum, so that multigrid can be used.
        """
        op = self.shifted(sigma)
        method = "auto"
        if not definite and op.structure.has_entries and not op.separable:
            method = "direct"
        settings = SolveSettings(method, rtol, None, "project", {})
        name = f"eigenpairs({self.name})"
        solve = build(op, settings, name, all_rows=False).apply
        shape = self.op.domain.shape

        def solved(b: NDArray[Any]) -> NDArray[Any]:
            return self.masked(solve((b / self.weights).reshape(shape)).reshape(-1))

        return solved

    def count_below(self, sigma: float) -> int:
        """Return the number of eigenvalues below a shift, by the negative pivots of A - sigma M (Sylvester's law)."""
        stiffness, mass = self.matrices
        try:
            return _negative_pivots(stiffness - sigma * mass)
        except RuntimeError:  # sigma is an eigenvalue
            return self.count_below(sigma - OFFSET_OF_SHIFT * self.scale)

    @cached_property
    def mass_is_positive(self) -> bool:
        """Whether M has positive pivots only; True if they are not known."""
        is_known = isinstance(self.mass, Operator) and self.mass.structure.has_entries
        if not is_known or self.unknowns > INERTIA_UP_TO:
            return True
        try:
            return not _negative_pivots(self.matrices[1])
        except RuntimeError:  # M is singular
            return False

    @cached_property
    def is_positive(self) -> bool:
        """Whether each diagonal entry is at least the sum of the others in its row: no eigenvalue is negative then."""
        if not self.op.structure.has_entries:
            return False
        stiffness, _ = self.matrices
        diagonal = stiffness.diagonal().real
        sums = abs(stiffness) @ np.ones(self.unknowns)
        return bool(np.all(2.0 * diagonal - sums >= -64 * EPS * sums))

    def negative(self) -> Pencil:
        """Return the pencil of -A and M."""
        negative = copy(self)
        negative.op = -1.0 * self.op
        negative.system = System(negative.op)
        for name in ("is_positive", "matrices"):  # cached properties that depend on the sign of A
            vars(negative).pop(name, None)
        return negative

    def _is_singular(self):
        """Return whether the constants or the volumes of a component are a null vector of A."""
        try:
            return self.system.null_space.count > 0
        except ArithmeticError:  # a null vector without a partner on the other side
            return True

    def below_spectrum(self) -> float:
        """Return a shift below all eigenvalues, near to the least one."""
        sigma = -SHIFT * self.scale
        grid = self.op.domain.grid
        if grid is not None and grid.dim > 1 and self._is_singular():
            sigma = -SHIFT_OF_SINGULAR * (float(np.min(self._row_sums)) or self.scale)
        if self.is_positive or not self.op.structure.has_entries:
            return sigma
        if self.unknowns > INERTIA_UP_TO:
            raise ConvergenceError(
                f"eigenpairs cannot find the end of the spectrum of {self.name}, whose rows do not show that it "
                "has no negative eigenvalue; write a number below or near the wanted eigenvalues, such as which=-1.0",
                info=failure("setup_failed"),
            )
        if not self.count_below(sigma):
            return sigma
        while self.count_below((1.0 - CLEARANCE) * sigma):  # a shift that is an eigenvalue has no inverse
            sigma *= 1000.0
        return self._nearer(sigma)

    def _nearer(self, sigma):
        """Return a shift that is nearer to the least eigenvalue than one far below it."""
        none = np.zeros((0, self.size), self.dtype)
        for _ in range(4):
            solve = self.shifted_inverse(sigma, SEARCH_TOLERANCE, False)
            upper = float(_shift_invert(self, sigma, solve, none, 1, None, 1e-3)[0][0])  # the least one, or above it
            distance = upper - sigma
            if distance <= SHIFT_OF_INDEFINITE * self.scale or self.count_below(upper - 0.01 * distance):
                break
            sigma = upper - 0.01 * distance
        return sigma


def _negative_pivots(matrix):
    """Return the number of negative pivots of a symmetric matrix; raise RuntimeError if it is singular."""
    from scipy.sparse.linalg import splu

    options = {"SymmetricMode": True}
    factors = splu(sp.csc_array(matrix), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return int(np.count_nonzero(factors.U.diagonal().real < 0))


def _matrix(op: Operator) -> sp.csr_array:
    """Return the matrix of an operator; of one without entries, by its products with the unit vectors."""
    if op.structure.has_entries:
        return op.matrix
    columns = [op._acting.product(unit) for unit in np.eye(op.domain.size)]
    return sp.csr_array(np.array(columns).T)


# ---- symmetric pencils -----------------------------------------------------------------------------------------------


def symmetric_pairs(pencil: Pencil, settings: EigenSettings) -> Spectrum:
    """Return k pairs of a symmetric (or Hermitian) pencil.

    Parameters
    ----------
    pencil : Pencil
    settings : EigenSettings

    Raises
    ------
    ValueError
        If the method does not fit the number of unknowns, k or `which`, or if the mass is not positive definite.
    ConvergenceError
        If the iteration does not converge, or the residual of a pair is too large.
    """
    k = settings.k
    maxiter = settings.maxiter
    scaled_which = settings.which
    if not isinstance(settings.which, str):
        scaled_which = float(np.ldexp(settings.which, -pencil.exponent))
    method = _chosen_method(pencil, settings)
    if method == "dense":
        values, vectors = _dense(pencil)
        # Errors of LAPACK are rounding errors of the largest eigenvalue, which may be larger than the smallest one.
        if k + 1 < pencil.unknowns and not _are_accurate(pencil, k, scaled_which, values, vectors):
            method = "arpack"
            values, vectors = _by_arpack(pencil, k, scaled_which, maxiter)
    elif not pencil.mass_is_positive:
        raise _mass_error(pencil)
    elif method == "lobpcg":
        values, vectors = _by_lobpcg(pencil, k, maxiter)
    else:
        values, vectors = _by_arpack(pencil, k, scaled_which, maxiter)
    order = _distances(values, scaled_which).argsort(kind="stable")
    chosen = order[:k][np.argsort(values[order[:k]], kind="stable")]
    beyond = values[order[k : k + 1]]
    vectors = np.array([with_fixed_sign(vector) for vector in vectors[chosen]])
    residuals = [PairResidual.of(pencil, *pair) for pair in zip(values[chosen], vectors, strict=True)]
    _check_residuals(residuals, pencil, method)
    is_zero = np.array([residual.is_zero for residual in residuals], bool)
    return Spectrum(
        _in_given_units(pencil, np.where(is_zero, 0.0, values[chosen])),
        vectors * 2.0 ** -(pencil.mass_exponent // 2),
        _in_given_units(pencil, beyond),
    )


def _in_given_units(pencil, values):
    """Return eigenvalues of the operators as given, not scaled; raise NonFiniteError if they overflow."""
    with np.errstate(over="ignore"):
        values = values * 2.0 ** (pencil.exponent // 2) * 2.0 ** (pencil.exponent - pencil.exponent // 2)
    check_finite(f"eigenvalues of {pencil.name}", values, advice="; write the operator and the mass in units near 1")
    return values


def _chosen_method(pencil, settings):
    """Return the method, chosen by size for "auto"; raise ValueError for a method that does not fit."""
    k = settings.k
    which = settings.which
    method = settings.method
    n = pencil.unknowns
    if method == "dense" and n > DENSE_AT_MOST:
        raise _too_large(n)
    if method == "lobpcg":
        if which != "smallest":
            raise ValueError(f"method lobpcg takes which='smallest', got {which!r}; write method='arpack'")
        if 5 * (k + 1) > n:
            raise ValueError(f"method lobpcg takes k up to a fifth of the {n} unknowns, got {k}; write method='dense'")
    if method == "arpack" and k + 1 >= n:
        raise ValueError(f"method arpack takes k < {n - 1} for {n} unknowns, got {k}; write method='dense'")
    if method != "auto":
        return method
    if n <= DENSE_UP_TO or (DENSE_SHARE * (k + 1) > n and n <= DENSE_AT_MOST):
        return "dense"
    return "arpack"


def _too_large(n):
    """Return the error for a full matrix that does not fit into the memory."""
    return ValueError(f"method dense takes up to {DENSE_AT_MOST} unknowns, got {n}; write method='arpack'")


def _distances(values, which):
    """Return numbers that are smaller for eigenvalues that are selected first."""
    if which == "smallest":
        return values
    if which == "largest":
        return -values
    return np.abs(values - which)


def _dense(pencil):
    """Return all pairs, by LAPACK."""
    stiffness, mass = (matrix.toarray() for matrix in pencil.matrices)
    stiffness = (stiffness + stiffness.conj().T) / 2.0
    mass = (mass + mass.conj().T) / 2.0
    try:
        if pencil.mass is None and np.ndim(pencil.weights) == 0:
            values, vectors = la.eigh(stiffness)
        else:
            values, vectors = la.eigh(stiffness, mass)
    except la.LinAlgError:
        raise _mass_error(pencil) from None
    return values, pencil.embedded(vectors.T)


def _mass_error(pencil):
    """Return the error for products v_i . M v_j that are not those of a positive definite M."""
    if not isinstance(pencil.mass, Operator):  # its entries are positive
        message = f"eigenpairs found vectors that are parallel up to rounding errors; {_advice(pencil, 'lobpcg')}"
        return ConvergenceError(message, info=failure("stagnated"))
    return ValueError("mass must be positive definite, and the one given is not; write a mass > 0 in all unknowns")


def _by_arpack(pencil, k, which, maxiter):
    """Return the k pairs nearest to an end or to a number and one more at least, by ARPACK."""
    sign = 1.0
    if not pencil.op.structure.has_entries:
        return _by_products(pencil, k, which, maxiter)
    if which == "largest":
        sign = -1.0
        pencil = pencil.negative()
    if isinstance(which, str):
        sigma = pencil.below_spectrum()
    else:
        sigma = which - OFFSET_OF_SHIFT * pencil.scale
    solve = pencil.shifted_inverse(sigma, INNER_RTOL, isinstance(which, str) and pencil.is_positive)

    def search(basis, count):
        tolerance = SEARCH_TOLERANCE if len(basis) else ARPACK_TOLERANCE
        return _shift_invert(pencil, sigma, solve, basis, count, maxiter, tolerance)

    def is_nearer(value, last):
        return abs(value - sigma) < abs(last - sigma) * (1.0 - TIE)

    _, vectors = _with_missing_copies(
        search, is_nearer, lambda values: np.abs(values - sigma), pencil, k, most=pencil.unknowns - 2
    )
    values, vectors = _polished(pencil, solve, vectors, k)
    return sign * values, vectors


def _with_missing_copies(search, is_nearer, distances, pencil, k, most):
    """Return k + 1 pairs or more, after searches in the complement of the known vectors that find no nearer pair.

    Parameters
    ----------
    search : callable
        ``search(basis, count)`` returns the values and vectors of `count` pairs in the complement of the basis.
    is_nearer : callable
        ``is_nearer(value, last)`` returns whether a new eigenvalue belongs before the last one of the k + 1 pairs.
    distances : callable
        ``distances(values)`` returns numbers that are smaller for eigenvalues that are selected first.
    pencil : Pencil
    k : int
    most : int
        Number of vectors beyond which the complement is too small for another search.
    """
    values = np.zeros(0)
    vectors = np.zeros((0, pencil.size), pencil.dtype)
    count = k + 1
    for _ in range(MOST_RESTARTS):
        new_values, new_vectors = search(vectors, count)
        if len(vectors):
            nearest = new_values[np.argmin(distances(new_values))]
            last = values[np.argsort(distances(values))[k]]
            if not is_nearer(nearest, last):
                break
        values = np.concatenate([values, new_values])
        vectors = np.concatenate([vectors, new_vectors])
        if len(vectors) > most:
            break
        count = 1
    return values, vectors


@contextmanager
def _arpack_errors(count: int) -> Iterator[None]:
    """Raise ConvergenceError in place of the exception of ARPACK for fewer than `count` eigenvalues."""
    from scipy.sparse.linalg import ArpackNoConvergence

    try:
        yield
    except ArpackNoConvergence as error:
        raise ConvergenceError(
            f"eigenpairs found {len(error.eigenvalues)} of {count} pairs; increase maxiter, or write a number near "
            "them as which",
            info=failure("max_iterations"),
        ) from None


def _shift_invert(pencil, sigma, solve, basis, count, maxiter, tolerance):
    """Return pairs near a shift, in the complement of the known vectors."""
    from scipy.sparse.linalg import LinearOperator, eigsh

    shape = pencil.size, pencil.size
    images = np.array([pencil.apply_mass(vector) for vector in basis]).reshape(basis.shape)

    def complement(x):
        return x - basis.T @ (images.conj() @ x)

    def solved(b):
        b = np.asarray(b).reshape(-1)
        return complement(solve(b - images.T @ (basis.conj() @ b)))

    dtype = pencil.dtype
    with _arpack_errors(count):
        values, vectors = eigsh(
            LinearOperator(shape, pencil.apply_stiffness, dtype=dtype),
            count,
            LinearOperator(shape, pencil.apply_mass, dtype=dtype),
            sigma,
            v0=complement(pencil.start_of_search(len(basis))),
            ncv=min(pencil.unknowns, max(2 * count + 1, 20)),
            maxiter=maxiter,
            tol=tolerance,
            OPinv=LinearOperator(shape, solved, dtype=dtype),
        )
    return values, vectors.T


def _by_products(pencil, k, which, maxiter):
    """Return the pairs of an operator without entries at an end of its spectrum, by products only."""
    from scipy.sparse.linalg import LinearOperator, eigsh

    if not isinstance(which, str) or isinstance(pencil.mass, Operator):
        raise ValueError(
            f"{pencil.name} has no entries, so that eigenpairs takes which='smallest' or 'largest' and a mass that is "
            "a number or a field; write dp.from_matrix(A) of its matrix for the others"
        )
    masses = pencil.apply_mass(np.ones(pencil.size))
    roots = np.sqrt(masses)
    direction = {"smallest": 1.0, "largest": -1.0}[which]
    ends = {"smallest": "SA", "largest": "LA"}
    # A bound of the width of the spectrum: known vectors are moved by it to the other end.
    width = direction * 4.0 * pencil.scale * max(1.0, float(np.max(masses) / np.min(masses))) * pencil.size

    def search(basis, count):
        def product(x):
            x = np.asarray(x).reshape(-1)
            y = pencil.apply_stiffness(x / roots) / roots
            return y + width * (basis.T @ (basis.conj() @ x))

        op = LinearOperator((pencil.size, pencil.size), product, dtype=pencil.dtype)
        ncv = min(pencil.size, max(2 * count + 1, 20))
        limit = maxiter or 100 * pencil.size
        start = pencil.start_of_search(len(basis))
        with _arpack_errors(count):
            values, vectors = eigsh(op, count, which=ends[which], v0=start, ncv=ncv, maxiter=limit)
        return values.real, vectors.T

    def is_nearer(value, last):
        return direction * value < direction * last - TIE * abs(width)

    values, vectors = _with_missing_copies(
        search, is_nearer, lambda values: direction * values, pencil, k, most=pencil.size
    )
    return values, vectors / roots


def _polished(pencil, solve, vectors, count):
    """Return the pairs of the pencil near the space of the given vectors, by steps of inverse iteration.

    One step suffices for vectors of ARPACK. Further steps are for the first `count` pairs.
    """
    for _ in range(MOST_STEPS):
        vectors = np.array([solve(pencil.apply_mass(vector)) for vector in vectors])
        values, vectors = _rayleigh_ritz(pencil, vectors)
        tested = zip(values[:count], vectors[:count], strict=True)
        if all(PairResidual.of(pencil, value, vector).is_small for value, vector in tested):
            break
    return values, vectors


def _rayleigh_ritz(pencil, vectors):
    """Return the pairs of the pencil on the space of some vectors."""
    vectors = _orthonormal(pencil, vectors)
    images = np.array([pencil.apply_stiffness(vector) for vector in vectors])
    masses = np.array([pencil.apply_mass(vector) for vector in vectors])
    stiffness = vectors.conj() @ images.T
    mass = vectors.conj() @ masses.T
    try:
        values, combinations = la.eigh((stiffness + stiffness.conj().T) / 2, (mass + mass.conj().T) / 2)
    except la.LinAlgError:
        raise _mass_error(pencil) from None
    return values, combinations.T @ vectors


def _orthonormal(pencil, vectors):
    """Return vectors with the products v_i . M v_j = delta_ij, which span the same space, by the Gram-Schmidt process.

    Solutions with a shift near an eigenvalue are almost parallel, so that a Cholesky factorisation of their products
    would fail.
    """
    basis = np.zeros((0, pencil.size), vectors.dtype)
    images = basis
    for vector in vectors:
        for _ in range(2):  # the first time leaves rounding errors of the components that it removes
            vector = vector / np.linalg.norm(vector)
            vector = vector - (images.conj() @ vector) @ basis
        image = pencil.apply_mass(vector)
        square = float(np.real(np.vdot(vector, image)))
        if not square > 0:
            raise _mass_error(pencil)
        basis = np.concatenate([basis, vector[None] / np.sqrt(square)])
        images = np.concatenate([images, image[None] / np.sqrt(square)])
    return basis


def _by_lobpcg(pencil, k, maxiter):
    """Return the k smallest pairs and one more, by LOBPCG with an approximate solve as preconditioner."""
    from warnings import catch_warnings, simplefilter

    from scipy.sparse.linalg import LinearOperator, lobpcg

    sigma = pencil.below_spectrum()
    solve = pencil.shifted_inverse(sigma, INNER_RTOL, pencil.is_positive)
    count = k + 1 + max(2, (k + 1) // 4)  # the last vectors converge slowly
    shape = pencil.size, pencil.size

    def of_columns(product):
        def act(block):
            return np.array([product(np.ascontiguousarray(column)) for column in block.T]).T

        return LinearOperator(shape, matvec=lambda x: product(x.reshape(-1)), matmat=act, dtype=pencil.dtype)

    block = np.random.default_rng(1).standard_normal((count, pencil.size))
    block = np.array([pencil.masked(line) for line in block])
    for _ in range(2):
        block = np.array([solve(pencil.apply_mass(line)) for line in block])
        bounds, block = _rayleigh_ritz(pencil, block)  # upper bounds of the eigenvalues
    if pencil.is_positive:  # a preconditioner that is nearly singular would favour one vector
        precondition = pencil.shifted_inverse(min(sigma, -0.1 * bounds[k]), 1e-2, True)
    else:
        precondition = pencil.shifted_inverse(sigma, 1e-2, False)
    mass = None if pencil.mass is None and np.ndim(pencil.weights) == 0 else of_columns(pencil.apply_mass)
    with catch_warnings():
        simplefilter("ignore")  # the residuals are tested below
        _, vectors = lobpcg(
            of_columns(pencil.apply_stiffness),
            block.T,
            mass,
            of_columns(precondition),
            tol=max(1e-8 * abs(bounds[k]), EPS * pencil.scale),
            maxiter=maxiter or 200,
            largest=False,
        )[:2]
    values, vectors = _polished(pencil, solve, vectors.T, k)
    if pencil.op.structure.has_entries and pencil.unknowns <= COUNTED_UP_TO:
        _check_complete(pencil, values, k)
    return values, vectors


def _check_complete(pencil, values, k):
    """Raise ConvergenceError if there are more eigenvalues below the k-th than were found."""
    distance = COUNTED_BELOW * max(abs(values[k - 1]), COUNTED_BELOW * pencil.scale)
    missing = pencil.count_below(values[k - 1] - distance) - int(np.count_nonzero(values < values[k - 1] - distance))
    if missing > 0:
        raise ConvergenceError(
            f"eigenpairs by lobpcg missed {missing} eigenvalues below {np.ldexp(values[k - 1], pencil.exponent):.6g}; "
            "write method='arpack'",
            info=failure("stagnated"),
        )


class PairResidual(NamedTuple):
    """The residual A v - lambda M v of a pair.

    Attributes
    ----------
    relative : float
        Its norm, divided by that of lambda M v.
    is_small : bool
        Whether it is within the tolerance, or at the level of rounding errors.
    is_zero : bool
        Whether the eigenvalue is 0 up to rounding errors.
    """

    relative: float
    is_small: bool
    is_zero: bool

    @classmethod
    def of(cls, pencil: Pencil, value: float, vector: NDArray[Any]) -> PairResidual:
        """Return the residual of one pair."""
        image = pencil.apply_stiffness(vector)
        mass = value * pencil.apply_mass(vector)
        residual = np.linalg.norm(image - mass)
        size = np.linalg.norm(mass)
        terms = np.linalg.norm(pencil.weights * pencil.system.magnitude(np.abs(vector)))
        is_small = residual <= max(pencil.rtol * size, AT_ROUNDOFF * (terms + size))
        return cls(float(residual / (size or 1.0)), bool(is_small), bool(size <= ZERO_AT_ROUNDOFF * terms))


def _are_accurate(pencil, k, which, values, vectors):
    """Return whether the residuals of the selected pairs are small."""
    selected = _distances(values, which).argsort(kind="stable")[:k]
    return all(PairResidual.of(pencil, values[number], vectors[number]).is_small for number in selected)


def _check_residuals(residuals, pencil, method):
    """Raise ConvergenceError if a pair does not satisfy A v = lambda M v."""
    for number, residual in enumerate(residuals):
        if not residual.is_small:
            raise ConvergenceError(
                f"pair {number} of eigenpairs has a relative residual of {residual.relative:.1e}, more than "
                f"{pencil.rtol:g}; {_advice(pencil, method)}",
                info=failure("stagnated"),
            )


def _advice(pencil, method):
    """Return what to do about pairs that are not accurate."""
    contrast = pencil.mass_contrast
    if contrast > LARGE_CONTRAST:
        return (
            f"the mass varies by a factor of {contrast:.0e}, so that rounding errors of the largest eigenvalues are "
            "large beside this one; write which='smallest' with method='arpack', a mass that varies less, or a larger "
            "rtol"
        )
    if method == "arpack":
        return "write a number near it as which, or increase maxiter"
    return "write method='arpack', or a larger rtol"


def with_fixed_sign(vector: NDArray[Any]) -> NDArray[Any]:
    """Return a vector times a number of magnitude 1, such that its first large entry is positive."""
    sizes = np.abs(vector)
    first = vector[np.argmax(sizes > 0.5 * np.max(sizes, initial=0.0))] if vector.size else 1.0
    if first == 0:
        return vector
    return vector * (np.conj(first) / np.abs(first))


# ---- operators that are not symmetric --------------------------------------------------------------------------------


def general_values(pencil: Pencil, settings: EigenSettings) -> NDArray[Any]:
    """Return k eigenvalues of a pencil that need not be symmetric, in ascending order of their real parts.

    Parameters
    ----------
    pencil : Pencil
    settings : EigenSettings

    Raises
    ------
    ValueError
        If the method does not fit the number of unknowns or `which`.
    ConvergenceError
        If the iteration does not converge.
    """
    k = settings.k
    which = settings.which
    if not isinstance(which, str):
        which = complex(which) * 2.0**-pencil.exponent
    if settings.method == "lobpcg":
        raise ValueError("method lobpcg takes symmetric operators; write method='arpack'")
    n = pencil.unknowns
    is_small = n <= GENERAL_DENSE_UP_TO or DENSE_SHARE * (k + 2) > n
    if settings.method == "dense" or (settings.method == "auto" and is_small):
        values = _general_dense(pencil, which)
    else:
        values = _general_by_arpack(pencil, k, which, settings.maxiter)
    nearest = _distances(values.real if isinstance(which, str) else values, which).argsort(kind="stable")
    _check_finite_ones(pencil, values[nearest[:k]])
    return _in_given_units(pencil, _sorted(values[nearest[:k]].astype(complex)))


def _sorted(values):
    """Return eigenvalues in ascending order of their real parts; equal ones are ordered by their imaginary parts.

    The real parts of a conjugate pair may differ by rounding.
    """
    values = values[np.argsort(values.real, kind="stable")]
    is_next = np.diff(values.real, prepend=-np.inf) > TIE * np.max(np.abs(values), initial=0.0)
    return values[np.lexsort((values.imag, np.cumsum(is_next)))]


def _general_dense(pencil, which):
    """Return all eigenvalues, by LAPACK; with a singular mass the finite ones, from the inverse of A - sigma M."""
    if pencil.unknowns > DENSE_AT_MOST:
        raise _too_large(pencil.unknowns)
    stiffness, mass = (matrix.toarray() for matrix in pencil.matrices)
    if pencil.mass is None:
        return la.eigvals(stiffness)
    if np.linalg.cond(mass) < SINGULAR_MASS:
        return la.eigvals(stiffness, mass)
    if isinstance(which, str):
        raise ValueError(f"a singular mass needs a shift, got which={which!r}; write a number as which")
    sigma = which - OFFSET_OF_GENERAL_SHIFT * pencil.scale
    if which.imag == 0:
        sigma = sigma.real
    shifted = stiffness - sigma * mass
    if _is_singular(shifted):
        raise _singular_pencil(pencil)
    with np.errstate(all="ignore"):
        return sigma + 1.0 / la.eigvals(np.linalg.solve(shifted, mass))


def _singular_pencil(pencil):
    return ValueError(
        f"eigenpairs of {pencil.name} with this mass are not defined: A - lambda M is singular for every lambda; "
        "remove the unknowns on which neither A nor M acts, or give them a mass"
    )


def _is_singular(matrix):
    """Return whether a matrix is singular up to rounding, whatever the units of its rows and columns."""
    for axis in (1, 0):
        largest = np.max(np.abs(matrix), axis=axis, keepdims=True, initial=0.0)
        if not np.all(largest):
            return True
        matrix = matrix / largest
    return bool(np.linalg.cond(matrix) * EPS * len(matrix) > 1)


def _check_finite_ones(pencil, values):
    """Raise ValueError for eigenvalues at infinity, which a singular mass has."""
    if pencil.mass is None:
        return
    diagonal = np.abs(pencil.matrices[1].diagonal())
    contrast = float(np.mean(diagonal)) / float(np.min(diagonal[diagonal > 0], initial=np.inf))
    largest = LARGEST_FINITE * max(contrast, 1.0) * float(np.max(pencil._row_sums, initial=0.0))
    count = int(np.count_nonzero(np.abs(values) <= largest))
    if count < values.size:
        raise ValueError(
            f"eigenpairs got k={values.size}, but {pencil.name} with this mass has {count} finite eigenvalues near "
            "the number given as which; write a smaller k"
        )


def _general_by_arpack(pencil, k, which, maxiter):
    """Return k eigenvalues at an end of the spectrum, or near a number by shift-invert."""
    from scipy.sparse.linalg import LinearOperator, eigs

    shape = pencil.size, pencil.size
    dtype = pencil.dtype
    if not isinstance(which, str):
        sigma = which.real if which.imag == 0 else which
        sigma = sigma - OFFSET_OF_GENERAL_SHIFT * pencil.scale
        solve = pencil.shifted_inverse(sigma, INNER_RTOL, False)
        if isinstance(sigma, complex):
            dtype = complex
    elif pencil.mass is not None:
        raise ValueError(
            "method arpack for an operator that is not symmetric, with a mass, needs a shift, got "
            f"which={which!r}; write a number as which"
        )
    if isinstance(which, str):
        # ARPACK's tolerance is relative to an eigenvalue: it never finds 0. Far from 0 it is relative to the operator.
        bound = float(np.max(pencil._row_sums, initial=0.0)) or 1.0
        offset = -2.0 * bound if which == "smallest" else 2.0 * bound

        def act(x):
            return pencil.apply_stiffness(x) + offset * x

        with _arpack_errors(k):
            act_op = LinearOperator(shape, act, dtype=dtype)
            end = {"smallest": "SR", "largest": "LR"}[which]
            values, vectors = eigs(act_op, k, v0=pencil.start, maxiter=maxiter, which=end)
        value_of = partial(np.add, -offset)
        return _with_missing_values(pencil, k, which, maxiter, value_of(values), vectors, act, value_of)

    def inverse(x):
        return solve(pencil.apply_mass(x))

    start = pencil.start
    if pencil.mass is not None:
        x = solve(start)
        residual = pencil.apply_stiffness(x) - sigma * pencil.apply_mass(x) - start
        if not np.linalg.norm(residual) <= LARGEST_RESIDUAL * np.linalg.norm(start):
            raise _singular_pencil(pencil)
        start = inverse(inverse(start))  # has no part in the space of eigenvalues at infinity
    with _arpack_errors(k):
        act_op = LinearOperator(shape, inverse, dtype=dtype)
        numbers, vectors = eigs(act_op, k, v0=start, maxiter=maxiter, which="LM")
    with np.errstate(all="ignore"):
        values = sigma + 1.0 / numbers
    return _with_missing_values(pencil, k, which, maxiter, values, vectors, inverse, lambda mu: sigma + 1.0 / mu)


def _with_missing_values(pencil, k, which, maxiter, values, vectors, act, value_of):
    """Return eigenvalues after searches outside of the known invariant subspace that find no nearer one.

    Parameters
    ----------
    pencil, k, which, maxiter
        As for `_general_by_arpack`.
    values, vectors : arrays, shapes (k,) and (n, k)
    act : callable
        The operator of which the vectors are eigenvectors. On the orthogonal complement of an invariant subspace its
        compression has the other eigenvalues.
    value_of : callable
        Returns the eigenvalue of the pencil for one of `act`.
    """
    from scipy.sparse.linalg import LinearOperator, eigs

    if not np.any(vectors.imag):
        vectors = vectors.real
    basis = la.qr(vectors, mode="economic")[0]
    end = {"smallest": "SR", "largest": "LR"}.get(str(which), "LM")

    def distances(values):
        return _distances(values.real if isinstance(which, str) else values, which)

    def complement(x):
        x = np.asarray(x).reshape(-1)
        return x - basis @ (basis.conj().T @ x)  # of all vectors that are known at this time

    for _ in range(MOST_RESTARTS):
        dimension = basis.shape[1]
        if dimension + 3 > pencil.unknowns:
            break
        last = np.sort(distances(values))[k - 1]

        def compressed(x):
            return complement(act(complement(x)))

        start = complement(pencil.start_of_search(dimension)).astype(basis.dtype)
        with _arpack_errors(1):
            operator = LinearOperator((pencil.size, pencil.size), compressed, dtype=basis.dtype)
            nearest, vector = eigs(operator, 1, which=end, v0=start, maxiter=maxiter, tol=ARPACK_TOLERANCE)
        new = value_of(nearest)
        if not distances(new)[0] < last - TIE * max(abs(last), pencil.scale * TIE):
            break
        values = np.concatenate([values, new])
        vector = complement(vector[:, 0])
        vector = complement(vector / np.linalg.norm(vector))
        basis = np.concatenate([basis, vector[:, None] / np.linalg.norm(vector)], axis=1)
    return values
