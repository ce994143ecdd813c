r"""Derivatives of eigenpairs, cluster by cluster.

Notes
-----
Let A v = lambda M v with symmetric A and M, M positive definite, and v_i . M v_j = delta_ij. The fields of one cluster
of m equal eigenvalues are the rows of V, and L = V A V^T is the m by m matrix of the cluster, here diag(lambda). Under
changes dA and dM, with N = V dM V^T, the derivative of A V = L M V and of V M V^T = 1 is the bordered system

    A dV - L M dV - dL M V = -(dA V - L dM V)
    -dV M V^T              = N / 2

for (dV, dL), whose operator K is symmetric. (The second row says that vectors do not rotate within their cluster; no
function that has a derivative depends on such rotations.) For a simple eigenvalue this is

    [ A - lambda M   -M v ] [ dv      ]     [ (dA - lambda dM) v ]
    [ -(M v)^T          0 ] [ dlambda ] = - [ -v . dM v / 2      ]

The product of the first row with V gives dL = V dA V^T - (L N + N L) / 2, for m = 1 dlambda = v . (dA - lambda dM) v
(Hellmann-Feynman theorem): eigenvalues need no solve. With a cotangent G of L and a cotangent g of V, the change of the
loss is

    G : dL = G : (V dA V^T) - (G L + L G) : N / 2
    g . dV = (g, 0) . (dV, dL) = K (Y, C) . (dV, dL) = (Y, C) . K (dV, dL) = -Y . dA V + (L Y) . dM V + (C : N) / 2

where (Y, C) is the solution of the adjoint system K (Y, C) = (g, 0), one solve for each vector. The cotangents of the
coefficients are the factors of their changes in dA and dM. V, L and the solution of the bordered system are
differentiable rules, and the formulas above are differentiable functions of them, so that derivatives of every order
follow.

References
----------
R. B. Nelson, Simplified calculation of eigenvector derivatives, AIAA J. 14 (1976) 1201-1205.
J. R. Magnus, On differentiating eigenvalues and eigenvectors, Econometric Theory 1 (1985) 179-191.
A. L. Andrew, R. C. E. Tan, Computation of derivatives of repeated eigenvalues and the corresponding eigenvectors of
symmetric matrix pencils, SIAM J. Matrix Anal. Appl. 20 (1998) 78-100.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp.autodiff.derivative import of_argument, pullback
from sparsedp.autodiff.tape import Rule, cast, dtype_of, isbox, plain
from sparsedp.errors import ConvergenceError
from sparsedp.operators.given import from_matrix
from sparsedp.solvers.adjoint import solve_rule
from sparsedp.solvers.cache import Cache
from sparsedp.solvers.choose_method import SolveSettings
from sparsedp.solvers.eigensolver import Pencil, symmetric_pairs
from sparsedp.solvers.inverse import build
from sparsedp.solvers.records import failure

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from sparsedp.errors import DerivativeError
    from sparsedp.operators.operator import Operator
    from sparsedp.solvers.eigensolver import EigenSettings, Spectrum
    from sparsedp.solvers.parametric import ParametricSolver

__all__ = [
    "CoefficientOperator",
    "ConstantOperator",
    "DiagonalMass",
    "EigenProblem",
    "IdentityMass",
    "member_values",
    "member_vectors",
    "without_derivative",
]

# Unknowns beyond which bordered systems of pairs at an end of the spectrum are solved by iterations in the complement
# of V. Measured at 256^2: LU 5.8 s, 13 iterations 0.5 s.
BORDERED_LU_UP_TO = 20_000
SYMMETRIC = 1e-6  # share of |g| |v| up to which the products of cotangents and vectors of a cluster are symmetric
MOST_SPREAD = 0.2  # share of the largest by which cotangents of the values of a cluster may differ at most
MOST_ITERATIONS = 1000  # of MINRES; shift-invert as preconditioner takes 10 to 40


# ---- operators with coefficients -------------------------------------------------------------------------------------


class PencilMember(ABC):
    """A or M of A v = lambda M v, a linear function of its coefficients.

    Attributes
    ----------
    coefficients : tuple
        Plain or traced values.
    """

    coefficients: tuple = ()

    @abstractmethod
    def argument(self, values: Sequence) -> Any:
        """Return the argument of `Pencil` for plain coefficients: an Operator, or for M also an array or None."""

    @abstractmethod
    def product(self, x: Any, values: Sequence) -> Any:
        """Return the products with a batch of fields; linear in x and in the coefficients."""

    def gradients(self, y: Any, x: Any, values: Sequence, places: Sequence[int]) -> list:
        """Return the gradients of sum(y * product(x, values)) in the coefficients at `places`."""
        return []

    def change(self, x: Any, values: Sequence, tangents: dict[int, Any], transposed: bool = False) -> Any:
        """Return the change of the products, or of those of the transpose, for tangents of some coefficients."""
        directions = [tangents.get(place, 0.0) for place in range(len(self.coefficients))]
        if transposed:
            return pullback(lambda z: self.product(z, directions), x)[1](x)
        return self.product(x, directions)


class ConstantOperator(PencilMember):
    """A constant Operator."""

    def __init__(self, op: Operator) -> None:
        self.op = op

    def argument(self, values: Sequence) -> Any:
        """Return the Operator."""
        return self.op

    def product(self, x: Any, values: Sequence) -> Any:
        """Return the product of the Operator."""
        return self.op(x)


class IdentityMass(PencilMember):
    """The mass M = 1, for the argument None."""

    def argument(self, values: Sequence) -> Any:
        """Return None."""
        return None

    def product(self, x: Any, values: Sequence) -> Any:
        """Return x."""
        return x


class DiagonalMass(PencilMember):
    """A diagonal mass matrix: a number or a field, which is the only coefficient."""

    def __init__(self, values: Any) -> None:
        self.coefficients = (values,)

    def argument(self, values: Sequence) -> Any:
        """Return the values."""
        return values[0]

    def product(self, x: Any, values: Sequence) -> Any:
        """Return the product of the values with each field."""
        return values[0] * x

    def gradients(self, y: Any, x: Any, values: Sequence, places: Sequence[int]) -> list:
        """Return the gradient in the values."""
        return [of_argument(y * x, values[place]) for place in places]


class CoefficientOperator(PencilMember):
    """The operator that a solver such as `elliptic_solver` inverts.

    Parameters
    ----------
    solver : ParametricSolver
    coefficients : (k, shift)
    """

    def __init__(self, solver: ParametricSolver, coefficients: tuple) -> None:
        self.solver = solver
        self.coefficients = coefficients

    def argument(self, values: Sequence) -> Any:
        """Return the Operator of the coefficients."""
        k, shift = (np.array(value, np.result_type(value, float)) for value in values)
        return self.solver._operator(k, shift)

    def product(self, x: Any, values: Sequence) -> Any:
        """Return the product of (shift - D diag(k) G) with each field."""
        return self.solver._product(False, x, *values)

    def gradients(self, y: Any, x: Any, values: Sequence, places: Sequence[int]) -> list:
        """Return the gradients in k and shift."""
        return [-gradient for gradient in self.solver._negative_gradient(tuple(values), places, y, x)]


# ---- the problem -----------------------------------------------------------------------------------------------------


class EigenProblem:
    """The eigenvalue problem of `eigenpairs` as differentiable rules of its coefficients.

    Parameters
    ----------
    stiffness, mass : PencilMember
    settings : EigenSettings

    Attributes
    ----------
    coefficients : tuple
        The coefficients of A, then the coefficients of M.
    """

    def __init__(self, stiffness: PencilMember, mass: PencilMember, settings: EigenSettings) -> None:
        self.stiffness = stiffness
        self.mass = mass
        self.settings = settings
        # Copies: the caller may write into the arrays before `values` is read.
        self.coefficients = tuple(map(_read_only_copy, (*stiffness.coefficients, *mass.coefficients)))
        self._count = len(stiffness.coefficients)
        self._solutions = Cache()

    def parts(self, values: Sequence) -> tuple[Any, Any]:
        """Return the coefficients of A and M."""
        return values[: self._count], values[self._count :]

    def pencil(self, values: Sequence) -> Pencil:
        """Return the operators of plain coefficients."""
        of_stiffness, of_mass = self.parts(values)
        stiffness = self.stiffness.argument(of_stiffness)
        return Pencil(stiffness, self.mass.argument(of_mass), self.settings.rtol, self.settings.symmetric)

    def solution(self, values: Sequence) -> EigenSolution:
        """Return the solution for plain coefficients, from the cache or new."""
        key = tuple(np.asarray(value, np.result_type(value, float)) for value in values)
        solution = self._solutions.find(key)
        if solution is None:
            solution = self._solutions.put(key, EigenSolution(self.pencil(key), self.settings))
        return solution

    @cached_property
    def plain_solution(self) -> EigenSolution:
        """The solution for the plain values of the coefficients."""
        return self.solution([plain(value) for value in self.coefficients])

    # ------------------------------------------------------------ rules

    def block(self, cluster: range) -> Any:
        """Return the matrix L of a cluster, differentiable in the coefficients."""
        return self._block_rule(cluster)(*self.coefficients)

    def vectors(self, cluster: range) -> Any:
        """Return the vectors V of a cluster, shape (m, *field), up to rotations differentiable in the coefficients."""
        return self._vectors_rule(cluster)(*self.coefficients)

    def cut_values(self, cluster: range, refusal: Callable[[], DerivativeError]) -> Any:
        """Return the eigenvalues of a cluster that continues behind the last pair; they have no derivative."""

        def forward(*values):
            return self.solution(values).spectrum.values[cluster.start : cluster.stop].copy()

        return self._refusing_rule(forward, refusal)

    def cut_vectors(self, cluster: range, refusal: Callable[[], DerivativeError]) -> Any:
        """Return the vectors of a cluster that continues behind the last pair; they have no derivative."""

        def forward(*values):
            return self.solution(values).fields(cluster).copy()

        return self._refusing_rule(forward, refusal)

    def _refusing_rule(self, forward, refusal):
        """Return ``forward(*values)``, all derivatives of which raise the error of `refusal` unless they are 0."""

        def vjp(nums, ans, *values):
            def pull(g):
                zero = anp.sum(without_derivative(g, refusal))
                return tuple(np.zeros(np.shape(plain(values[num]))) + zero for num in nums)

            return pull

        return _member_rule(forward, vjp, refusal)(*self.coefficients)

    def _block_rule(self, cluster):
        """Return the rule of L, whose derivatives need no solve: dL = V dA V^T - (L N + N L) / 2."""

        def forward(*values):
            return np.diag(self.solution(values).spectrum.values[cluster.start : cluster.stop])

        def vjp(nums, ans, *values):
            def pull(g):
                v = self._vectors_rule(cluster)(*values)
                g = cast(g, float)
                weights = -0.5 * (anp.dot(g, ans) + anp.dot(ans, g))
                return self._gradients(nums, values, _combined(g.T, v), _combined(weights.T, v), v)

            return pull

        def jvp(nums, tangents, ans, *values):
            v = self._vectors_rule(cluster)(*values)
            by_stiffness, by_mass = self._changes(nums, tangents, v)
            change = _inner_products(v, by_stiffness, (len(v), len(v)))
            n = _inner_products(v, by_mass, (len(v), len(v)))
            return change - 0.5 * (anp.dot(ans, n) + anp.dot(n, ans))

        return Rule("eigenpairs", forward, vjp, jvp)

    def _vectors_rule(self, cluster):
        """Return the rule of V, whose derivatives take one solve of the bordered system for each vector."""

        def forward(*values):
            return self.solution(values).fields(cluster)

        def vjp(nums, ans, *values):
            def pull(g):
                m = len(ans)
                block = self._block_rule(cluster)(*values)
                data = anp.concatenate([anp.reshape(cast(g, float), (m, -1)), np.zeros((m, m))], axis=1)
                y, c = self._split(self._bordered(cluster)(data, block, ans, *values))
                return self._gradients(nums, values, -y, _combined(block, y) + 0.5 * _combined(c.T, ans), ans)

            return pull

        def jvp(nums, tangents, ans, *values):
            m = len(ans)
            block = self._block_rule(cluster)(*values)
            by_stiffness, by_mass = self._changes(nums, tangents, ans)
            data = np.zeros((m, self.plain_solution.pencil.size))
            if by_stiffness is not None:
                data = data - anp.reshape(by_stiffness, (m, -1))
            if by_mass is not None:
                data = data + anp.reshape(_combined(block, by_mass), (m, -1))
            products = 0.5 * _inner_products(ans, by_mass, (m, m))
            solution = self._bordered(cluster)(anp.concatenate([data, products], axis=1), block, ans, *values)
            return self._split(solution)[0]

        return Rule("eigenpairs", forward, vjp, jvp)

    def _bordered(self, cluster):
        """Return the rule that maps (data, L, V, *values) to (X, B), the solution of the bordered system.

        A row of `data` and of the solution holds a field and m numbers.

        Notes
        -----
        The system is A X - L M X - B M V = F, -X M V^T = E, with the data (F, E). For a cotangent S of the solution,
        the adjoint solution K (Y, C) = S is the cotangent of the data, and the terms -(Y, C) . dK (X, B) are

            (Y (M X)^T) : dL + (B^T Y + C^T X) . M dV - Y . dA X + (L^T Y) . dM X + (B^T Y + C^T X) . dM V .
        """
        name = "eigenpairs, adjoint,"
        weights = self.plain_solution.weights

        def solve(transposed, checked, data, block, v, *values):
            return self.solution(values).bordered_solve(cluster, data)

        def product(transposed, s, block, v, *values):
            of_stiffness, of_mass = self.parts(values)
            x, b = self._split(s)
            masses = weights * self.mass.product(_combined(block, x) + _combined(b, v), of_mass)
            fields = weights * self.stiffness.product(x, of_stiffness) - masses
            numbers = -_inner_products(x, weights * self.mass.product(v, of_mass), (len(v), len(v)))
            return anp.concatenate([anp.reshape(fields, (len(v), -1)), numbers], axis=1)

        def back(params, places, adjoint, s):
            """Return the cotangents of L, V and the coefficients at `places`."""
            block, v, *values = params
            y, c = self._split(adjoint)
            x, b = self._split(s)
            _, of_mass = self.parts(values)
            crossed = _combined(b.T, y) + _combined(c.T, x)
            gradients: dict[int, Any] = {}
            if 0 in places:
                gradients[0] = _inner_products(y, weights * self.mass.product(x, of_mass), (len(v), len(v)))
            if 1 in places:
                gradients[1] = weights * self.mass.product(crossed, of_mass)
            numbers = [place - 2 for place in places if place > 1]
            if numbers:
                for_x = self._gradients(numbers, values, -y, _combined(block.T, y), x)
                for_v = self._gradients(numbers, values, None, crossed, v)
                for number, one, other in zip(numbers, for_x, for_v, strict=True):
                    gradients[number + 2] = one + other
            return [gradients[place] for place in places]

        return solve_rule(name, solve, back, product)

    def _split(self, s):
        """Return the fields and the numbers of each row of a solution of the bordered system."""
        size = self.plain_solution.pencil.size
        return anp.reshape(s[:, :size], (len(s), *self.plain_solution.shape)), s[:, size:]

    def _gradients(self, nums, values, for_stiffness, for_mass, x):
        """Return the gradients of sum(for_stiffness * A x) + sum(for_mass * M x) in the coefficients at `nums`."""
        of_stiffness, of_mass = self.parts(values)
        weights = self.plain_solution.weights
        gradients: dict[int, Any] = {}
        places = [num for num in nums if num < self._count]
        if places and for_stiffness is None:
            gradients.update({place: np.zeros(np.shape(plain(of_stiffness[place]))) for place in places})
        elif places:
            parts = self.stiffness.gradients(weights * for_stiffness, x, of_stiffness, places)
            gradients.update(zip(places, parts, strict=True))
        places = [num - self._count for num in nums if num >= self._count]
        parts = self.mass.gradients(weights * for_mass, x, of_mass, places)
        gradients.update({place + self._count: part for place, part in zip(places, parts, strict=True)})
        return tuple(gradients[num] for num in nums)

    def _changes(self, nums, tangents, x):
        """Return dA x and dM x for tangents of the coefficients at `nums`; None for no change."""
        tangent_of = dict(zip(nums, tangents, strict=True))
        changes = []
        for member, first in ((self.stiffness, 0), (self.mass, self._count)):
            numbers = range(first, first + len(member.coefficients))
            if any(number in tangent_of for number in numbers):
                directions = [tangent_of.get(number, 0.0) for number in numbers]
                changes.append(self.plain_solution.weights * member.product(x, directions))
            else:
                changes.append(None)
        return changes


def _read_only_copy(value):
    """Return a read-only copy of a plain value in double precision, and traced values as they are."""
    if isbox(value):
        return value
    copy = np.array(value, np.result_type(value, float))
    copy.flags.writeable = False
    return copy


def _combined(matrix, fields):
    """Return the linear combinations of some fields with the rows of a matrix as coefficients."""
    return anp.tensordot(matrix, fields, axes=1)


def _inner_products(one, other, shape):
    """Return the matrix of the inner products of two lists of fields; zeros if one of them is None."""
    if one is None or other is None:
        return np.zeros(shape)
    flat = anp.reshape(one, (shape[0], -1))
    return anp.dot(flat, anp.reshape(other, (shape[1], -1)).T)


# ---- the solution for plain coefficients -----------------------------------------------------------------------------


class EigenSolution:
    """The pairs of plain operators, and the solves of the bordered systems of their derivatives.

    Parameters
    ----------
    pencil : Pencil
    settings : EigenSettings
    """

    def __init__(self, pencil: Pencil, settings: EigenSettings) -> None:
        self.pencil = pencil
        self.which = settings.which
        self.shape = pencil.op.domain.shape
        self.spectrum: Spectrum = symmetric_pairs(pencil, settings)
        self._solves: dict[tuple, Callable] = {}

    @cached_property
    def weights(self) -> Any:
        """The weights with which A and M are symmetric, as a field or 1.0."""
        weights = self.pencil.weights
        return weights if np.ndim(weights) == 0 else weights.reshape(self.shape)

    def fields(self, cluster: range) -> NDArray[Any]:
        """Return the vectors of a cluster as fields."""
        return self.spectrum.vectors[cluster.start : cluster.stop].reshape(-1, *self.shape)

    def bordered_solve(self, cluster: range, data: NDArray[Any]) -> NDArray[Any]:
        """Solve the bordered system; each row of `data` and of the result holds a field and m numbers."""
        pencil = self.pencil
        size = pencil.size
        # In the units of the pencil, where squares of the entries do not overflow.
        half = pencil.mass_exponent // 2
        stiffness_exponent = pencil.exponent + pencil.mass_exponent
        result = np.zeros_like(data)
        for row, number in enumerate(cluster):
            field = np.ldexp(data[row, :size], half - stiffness_exponent)
            x, numbers = self._solve_row(cluster, number, pencil.masked(field), data[row, size:])
            result[row, :size] = np.ldexp(x, -half)
            result[row, size:] = np.ldexp(numbers, pencil.exponent)
        return result

    def _solve_row(self, cluster, number, field, numbers):
        """Solve the bordered system of one eigenvalue in the units of the pencil; its set-up is kept."""
        if not np.any(field) and not np.any(numbers):
            return np.zeros_like(field), np.zeros_like(numbers)
        key = cluster, number
        if key not in self._solves:
            build_solve = _bordered_lu
            if self.pencil.unknowns > BORDERED_LU_UP_TO and isinstance(self.which, str):
                build_solve = partial(_projected_minres, largest=self.which == "largest")
            values = np.ldexp(self.spectrum.values, -self.pencil.exponent)
            vectors = self.spectrum.vectors[cluster.start : cluster.stop] * 2.0 ** (self.pencil.mass_exponent // 2)
            chosen = values[cluster.start : cluster.stop]
            self._solves[key] = build_solve(self.pencil, values[number], chosen, vectors)
        return self._solves[key](field, numbers)


def _bordered_lu(pencil, value, values, vectors):
    """Return the solve of the bordered system of one eigenvalue by LU factors."""
    stiffness, mass = pencil.matrices
    keep = slice(None) if pencil.active is None else pencil.active
    scale = pencil.scale or 1.0
    border = sp.csr_array(-scale * np.array([pencil.apply_mass(vector)[keep] for vector in vectors]))
    matrix = sp.block_array([[stiffness - value * mass, border.T], [border, None]], format="csr")
    settings = SolveSettings("direct", pencil.rtol, None, "project", {})
    solve = build(from_matrix(matrix), settings, "eigenpairs, adjoint,").apply
    count = pencil.unknowns

    def solved(field, numbers):
        solution = solve(np.concatenate([field[keep], scale * numbers]))
        return pencil.embedded(solution[None, :count])[0], scale * solution[count:]

    return solved


def _projected_minres(pencil, value, values, vectors, largest):
    """Return the solve of the bordered system of one eigenvalue by MINRES in the complement of the vectors.

    The preconditioner is the inverse of A - sigma M with a shift below the spectrum.
    """
    from scipy.sparse.linalg import LinearOperator, minres

    sign = 1.0
    shifted = pencil
    if largest:
        sign = -1.0
        shifted = pencil.negative()
    precondition = shifted.shifted_inverse(shifted.below_spectrum(), 1e-10, shifted.is_positive)
    masses = np.array([pencil.apply_mass(vector) for vector in vectors])
    shape = pencil.size, pencil.size

    def complement(x):
        return x - vectors.T @ (masses @ x)

    def range_of(b):
        return b - masses.T @ (vectors @ b)

    def product(x):
        x = complement(x.reshape(-1))
        return sign * range_of(pencil.apply_stiffness(x) - value * pencil.apply_mass(x))

    def preconditioned(b):
        return complement(precondition(range_of(b.reshape(-1))))

    act = LinearOperator(shape, product, dtype=float)
    preconditioner = LinearOperator(shape, preconditioned, dtype=float)

    def solved(field, numbers):
        in_range = sign * range_of(field)
        x = np.zeros(pencil.size)
        size = np.linalg.norm(in_range)
        for _ in range(3):  # MINRES estimates its residual; the true one is computed here
            remainder = in_range - product(x)
            if np.linalg.norm(remainder) <= pencil.rtol * size:
                break
            x = x + minres(act, remainder, M=preconditioner, rtol=1e-12, maxiter=MOST_ITERATIONS)[0]
        residual = np.linalg.norm(in_range - product(x))
        if not residual <= max(100 * pencil.rtol, 1e-8) * size:
            raise ConvergenceError(
                f"the adjoint solve of eigenpairs ended with a relative residual of {residual / size:.1e}; "
                "increase k, so that the gap behind the last pair is larger",
                info=failure("max_iterations"),
            )
        solution = complement(x) - numbers @ vectors
        return solution, -(values - value) * numbers - vectors @ field

    return solved


# ---- members of clusters ---------------------------------------------------------------------------------------------


def member_values(block: Any, refusal: Callable[[], DerivativeError], spread: float) -> Any:
    """Return the eigenvalues of a cluster, which have a derivative only if all of them have the same cotangent.

    Parameters
    ----------
    block : array, shape (m, m)
        L.
    refusal : callable
        Returns the error for other derivatives.
    spread : float
        Relative difference of the eigenvalues.
    """
    tolerance = min(MOST_SPREAD, 1e-6 + 1e3 * spread)

    def vjp(nums, ans, block):
        def pull(g):
            if isbox(g):
                return (anp.diag(without_derivative(g, refusal)),)
            if np.max(g) - np.min(g) > tolerance * np.max(np.abs(g)):
                raise refusal()
            return (np.diag(np.asarray(g, float)),)

        return pull

    return _member_rule(np.diag, vjp, refusal)(block)


def member_vectors(vectors: Any, refusal: Callable[[], DerivativeError]) -> Any:
    """Return the eigenvectors of a cluster, which have a derivative only for functions that no rotation changes."""

    def vjp(nums, ans, vectors):
        def pull(g):
            if isbox(g):
                return (without_derivative(g, refusal),)
            flat = np.reshape(g, (len(g), -1))
            fields = np.reshape(plain(ans), (len(g), -1))
            products = flat @ fields.T
            if np.max(np.abs(products - products.T)) > SYMMETRIC * np.linalg.norm(flat) * np.linalg.norm(fields):
                raise refusal()
            return (g,)

        return pull

    return _member_rule(np.array, vjp, refusal)(vectors)


def _member_rule(forward, vjp, refusal):
    """Return a rule whose derivatives in forward mode are refused."""

    def jvp(nums, tangents, ans, *values):
        raise refusal()

    return Rule("eigenpairs", forward, vjp, jvp)


def without_derivative(g: Any, refusal: Callable[[], DerivativeError]) -> Any:
    """Return zeros for a cotangent that must be 0.

    A traced cotangent may be 0 because the function does not use these values, as in ``pairs.values[0]**2``. So its
    derivative is NaN, which arrives where the function uses them, and nowhere else.
    """
    if np.any(plain(g) != 0):
        raise refusal()
    if not isbox(g):
        return g

    def vjp(nums, ans, g):
        return lambda outer: (np.full(np.shape(plain(g)), np.nan, dtype_of(g)),)

    def jvp(nums, tangents, ans, g):
        if np.any(plain(tangents[0]) != 0):
            raise refusal()
        return tangents[0]

    return Rule("eigenpairs", np.zeros_like, vjp, jvp)(g)
