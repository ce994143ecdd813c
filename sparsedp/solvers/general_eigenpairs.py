r"""Eigenvalues of pencils that are not symmetric, with their right and left vectors and derivatives.

Notes
-----
Let A v = lambda M v and u^T A = lambda u^T M with u^T M v = 1; the left vector in the usual notation is conj(u). A and
M are real or complex and need not be symmetric, M may be singular. Under changes dA and dM a simple eigenvalue changes
by

    dlambda = u^T (dA - lambda dM) v,

so a cotangent g of lambda gives the cotangents Re(g u v^T) of the entries of A and -Re(g lambda u v^T) of the entries
of M, without a solve. (A complex cotangent is dL/dRe - i dL/dIm, as in autograd.)

Second derivatives need the changes of u and v. With c^T v = 1, c constant, they are the solutions of

    (A - lambda M) dv = -(dA - lambda dM) v + dlambda M v,             c^T dv = 0,
    (A - lambda M)^T du = -(dA - lambda dM)^T u + dlambda M^T u,       (M v)^T du = -u^T (dM v + M dv).

The adjoint of this map takes the cotangents (g_v, g_u) to

    -u^T dA y - z^T dA v + lambda (u^T dM y + z^T dM v) - s u^T dM v,

where s = u^T g_u, (A - lambda M) y = g_u - s M v with (M^T u)^T y = 0, and (A - lambda M)^T z = g_v - s M^T u - t c
with (M v)^T z = 0 and t = v^T (g_v - s M^T u). One LU factorisation of a bordered matrix gives v, u, and these solves:

    [ A - lambda M   b ] [ v ]   [ 0 ]
    [ c^T            0 ] [ h ] = [ 1 ] .

b and c are the unit vectors of the largest entries of u and v, which a few steps of inverse iteration estimate: the
matrix stays sparse, and is regular at a simple eigenvalue.

At a multiple eigenvalue, inverse iteration with a block gives orthonormal bases V and U of the right and the left
eigenspace. With the singular value decomposition U^T M V = P S Q^H, the vectors of V Q and U conj(P) form pairs with
u^T M v = s. An eigenvalue is semisimple if no s is 0.

References
----------
J. R. Magnus, On differentiating eigenvalues and eigenvectors, Econometric Theory 1 (1985) 179-191.
W. J. F. Govaerts, Numerical Methods for Bifurcations of Dynamical Equilibria, SIAM, 2000.
F. Giannetti, P. Luchini, Structural sensitivity of the first instability of the cylinder wake, J. Fluid Mech. 581
(2007) 167-197.
"""

from __future__ import annotations

from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from sparsedp._utils.pytree import leaves
from sparsedp.autodiff.derivative import push
from sparsedp.autodiff.tape import Rule, cast, isbox, plain
from sparsedp.errors import ConvergenceError, DerivativeError
from sparsedp.operators.given import from_matrix
from sparsedp.solvers.adjoint import vary
from sparsedp.solvers.cache import Cache
from sparsedp.solvers.choose_method import SolveSettings
from sparsedp.solvers.eigen_rules import EigenProblem, PencilMember, without_derivative
from sparsedp.solvers.eigensolver import AT_ROUNDOFF, ROUNDING, general_values, with_fixed_sign
from sparsedp.solvers.jacobian import Jacobians
from sparsedp.solvers.newton import Equation, Unknowns
from sparsedp.solvers.records import failure
from sparsedp.solvers.roots import Root, negative_gradient, product_with

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from sparsedp.solvers.eigensolver import EigenSettings, Pencil

__all__ = ["GeneralEigenpairs", "GeneralEigenProblem", "JacobianMember"]

CORRECTIONS = 4  # of an eigenvalue, each with one factorisation; they converge quadratically
RESIDUAL = 1e3 * AT_ROUNDOFF  # share of the terms below which the residual of a pair is rounding
NEAR = 1e-9  # distance of the shift of inverse iteration from the eigenvalue, in units of the mean row of A
SHIFTS = (1.0, -1.7, 2.9)  # in units of `NEAR`, tried in turn if a matrix with an earlier one is exactly singular
START_STEPS = 3  # of inverse iteration
GAP_STEPS = 3  # steps of inverse iteration that estimate the distance of the nearest other eigenvalue
SAME = 1e-9  # distance below which eigenvalues may have a common eigenspace, in units of the mean row of A
SPACE_STEPS = 4  # of inverse iteration with a block, for the eigenspace of a multiple eigenvalue
PERPENDICULAR = 1e-14  # the cosine |u^T M v| / (|u| |M v|) below which it is 0 up to rounding
DEFECTIVE = 1e-7  # |u^T M v| / (|u| |M v|) below which an eigenvalue has no derivative
LARGEST_DEFECTIVE = 1e-5  # the same below which an eigenvalue that is a multiple one up to rounding is defective


class JacobianMember(PencilMember):
    """The Jacobian dF/dx of a residual F(x, *params) at a state.

    Its coefficients are the flat state and the floating leaves of the parameters.

    Parameters
    ----------
    residual : callable or Root
    state : tree of arrays
    params : tuple of trees
    """

    def __init__(self, residual: Callable[..., Any] | Root, state: Any, params: tuple) -> None:
        self.unknowns = Unknowns(state, "eigenpairs")
        function = residual.residual if isinstance(residual, Root) else residual
        self.equation = Equation(function, self.unknowns, params, "eigenpairs")
        if isinstance(residual, Root):
            self.jacobians = residual.jacobians_of(self.equation)
        else:
            settings = SolveSettings("auto", 1e-10, None, "project", {})
            self.jacobians = Jacobians("eigenpairs", None, None, settings)
        flat = anp.concatenate([anp.ravel(leaf) for leaf in leaves(state)])
        self.coefficients = (cast(flat, np.float64), *self.equation.variables(params))

    def argument(self, values: Sequence) -> Any:
        """Return the Jacobian as an Operator between flat arrays."""
        x, *others = values
        self.equation.value(x, others)  # raise an error for traced values that are not arguments
        op = self.jacobians.operator(self.equation, x, others)
        if op.form != "explicit":
            return op
        return from_matrix(op.matrix, name="the Jacobian")

    def product(self, x: Any, values: Sequence) -> Any:
        """Return the products with a batch of fields."""
        return anp.array([product_with(False, row, self.equation, *values) for row in x])

    def transposed_product(self, y: Any, values: Sequence) -> Any:
        """Return the products of the transpose with a batch of fields."""
        return anp.array([product_with(True, row, self.equation, *values) for row in y])

    def change(self, x: Any, values: Sequence, tangents: dict[int, Any], transposed: bool = False) -> Any:
        """Return the change of the products, or of those of the transpose, for tangents of some coefficients."""
        places = list(tangents)
        function = self.transposed_product if transposed else self.product
        varied, chosen = vary(lambda *values: function(x, values), values, places)
        return push(varied, chosen, list(tangents.values()))[1]

    def gradients(self, y: Any, x: Any, values: Sequence, places: Sequence[int]) -> list:
        """Return the gradients of sum(y * product(x, values)) in the coefficients at `places`."""
        point = (self.equation, *values)
        totals: list[Any] = [0.0] * len(places)
        for one, other in zip(y, x, strict=True):
            parts = negative_gradient(point, [place + 1 for place in places], one, other)
            totals = [total - part for total, part in zip(totals, parts, strict=True)]
        return totals


class GeneralEigenProblem(EigenProblem):
    """The eigenvalue problem of a pencil that need not be symmetric, as differentiable rules of its coefficients.

    Parameters
    ----------
    stiffness, mass : PencilMember
    settings : EigenSettings
    """

    def __init__(self, stiffness: PencilMember, mass: PencilMember, settings: EigenSettings) -> None:
        super().__init__(stiffness, mass, settings)
        self._general_solutions = Cache()

    def solution(self, values: Sequence) -> Any:
        """Return the GeneralSolution for plain coefficients, from the cache or new."""
        key = tuple(np.asarray(value, np.result_type(value, float)) for value in values)
        solution = self._general_solutions.find(key)
        if solution is None:
            solution = self._general_solutions.put(key, GeneralSolution(self.pencil(key), self.settings))
        return solution

    def value(self, number: int) -> Any:
        """Return an eigenvalue as an array of one number, differentiable in the coefficients."""
        return self._value_rule(number)(*self.coefficients)

    def _value_rule(self, number):
        def forward(*values):
            return self.solution(values).values[number : number + 1].copy()

        def vjp(nums, ans, *values):
            def pull(g):
                solution = self.solution([plain(value) for value in values])
                refusal = partial(solution.refusal, number)
                if solution.refusal(number):
                    zero = anp.sum(anp.real(without_derivative(g, refusal)))
                    return tuple(np.zeros(np.shape(plain(values[num]))) + zero for num in nums)
                if not isbox(g) and not np.any(g):
                    return tuple(np.zeros(np.shape(plain(values[num]))) for num in nums)
                v, u = self._vectors_rule(number)(*values)
                return self._gradients_of(nums, values, [(g * u, v)], [(-g * ans * u, v)])

            return pull

        def jvp(nums, tangents, ans, *values):
            self._check_simple(number, values)
            v, u = self._vectors_rule(number)(*values)
            for_stiffness, for_mass = self._tangents_of(nums, tangents)
            change = anp.sum(u * self._change(self.stiffness, v, values, for_stiffness))
            change = change - ans * anp.sum(u * self._change(self.mass, v, values, for_mass))
            return anp.reshape(change, (1,))

        return Rule("eigenpairs", forward, vjp, jvp)

    def _vectors_rule(self, number):
        """Return the rule of (v, u), shape (2, *field)."""

        def forward(*values):
            pair = self.solution(values).pair(number)
            return np.array([pair.v, pair.u]).reshape(2, *self.plain_solution.shape)

        def vjp(nums, ans, *values):
            if any(map(isbox, values)):
                raise _third_derivative()

            def pull(g):
                if isbox(g):
                    raise _third_derivative()
                pair = self.solution(values).pair(number)
                shape = self.plain_solution.shape
                flat = np.reshape(g, (2, -1)).astype(complex)
                s = pair.u @ flat[1]
                y = pair.solve(flat[1] - s * pair.mass_v, False).reshape(shape)
                rest = flat[0] - s * pair.mass_u
                z = pair.solve(rest - (pair.v @ rest) * pair.c, True).reshape(shape)
                v, u = ans
                value = pair.value
                for_mass = [(value * u, y), (value * z, v), (-s * u, v)]
                return self._gradients_of(nums, values, [(-u, y), (-z, v)], for_mass)

            return pull

        def jvp(nums, tangents, ans, *values):
            if any(map(isbox, (*values, *tangents))):
                raise _third_derivative()
            pair = self.solution(values).pair(number)
            for_stiffness, for_mass = self._tangents_of(nums, tangents)

            def change(member, vector, chosen, transposed=False):
                field = np.reshape(vector, self.plain_solution.shape)
                return np.ravel(self._change(member, field, values, chosen, transposed))

            mass_change = change(self.mass, pair.v, for_mass)
            r = change(self.stiffness, pair.v, for_stiffness) - pair.value * mass_change
            slope = pair.u @ r
            dv = pair.solve(slope * pair.mass_v - r, False)
            dv = dv - (pair.c @ dv) * pair.v
            r = change(self.stiffness, pair.u, for_stiffness, True)
            r = r - pair.value * change(self.mass, pair.u, for_mass, True)
            du = pair.solve(slope * pair.mass_u - r, True)
            du = du - (pair.u @ mass_change + pair.mass_u @ dv) * pair.u
            return np.array([dv, du]).reshape(np.shape(ans))

        return Rule("eigenpairs", forward, vjp, jvp)

    def all_vectors(self, left: bool) -> Any:
        """Return the right or left vectors, shape (k, *field), which have no derivatives."""

        def forward(*values):
            solution = self.solution(values)
            pairs = [solution.pair(number) for number in range(len(solution.values))]
            rows = [pair.left if left else pair.right for pair in pairs]
            return np.array(rows).reshape(-1, *self.plain_solution.shape)

        def refused(*args):
            raise DerivativeError(
                "the vectors of eigenpairs with symmetric=False have no derivatives; differentiate functions of "
                "pairs.values"
            )

        return Rule("eigenpairs", forward, refused, refused)(*self.coefficients)

    def _check_simple(self, number, values):
        error = self.solution([plain(value) for value in values]).refusal(number)
        if error:
            raise error

    # ------------------------------------------------------------ changes of A and M, in complex arithmetic

    def _tangents_of(self, nums, tangents):
        """Return the tangents of the coefficients of A and M, by their places."""
        for_stiffness = {num: t for num, t in zip(nums, tangents, strict=True) if num < self._count}
        for_mass = {num - self._count: t for num, t in zip(nums, tangents, strict=True) if num >= self._count}
        return for_stiffness, for_mass

    def _change(self, member, field, values, tangents, transposed=False):
        """Return dA x, dM x, or the products of their transposes, for a complex field x."""
        if not tangents:
            return np.zeros(np.shape(plain(field)))
        own = self.parts(values)[0 if member is self.stiffness else 1]
        parts = anp.array([anp.real(field), anp.imag(field)])
        changed = member.change(parts, own, tangents, transposed)
        return changed[0] + 1j * changed[1]

    def _gradients_of(self, nums, values, for_stiffness, for_mass):
        """Return the gradients of Re(sum(y * A x)) over pairs (y, x) for A and for M in the coefficients at `nums`."""
        of_stiffness, of_mass = self.parts(values)
        gradients: dict[int, Any] = {}
        for member, own, first, pairs in (
            (self.stiffness, of_stiffness, 0, for_stiffness),
            (self.mass, of_mass, self._count, for_mass),
        ):
            places = [num - first for num in nums if 0 <= num - first < len(own)]
            if places:
                ys = [part for y, _ in pairs for part in (anp.real(y), -anp.imag(y))]
                xs = [part for _, x in pairs for part in (anp.real(x), anp.imag(x))]
                parts = member.gradients(anp.array(ys), anp.array(xs), own, places)
                gradients.update({place + first: part for place, part in zip(places, parts, strict=True)})
        return tuple(gradients[num] for num in nums)


def _third_derivative():
    return DerivativeError(
        "eigenvalues of eigenpairs with symmetric=False have first and second derivatives, no third ones"
    )


# ---- the solution for plain coefficients -----------------------------------------------------------------------------


class GeneralSolution:
    """The eigenvalues of a plain pencil, and their vectors once they are asked for.

    Parameters
    ----------
    pencil : Pencil
    settings : EigenSettings

    Attributes
    ----------
    values : complex array, shape (k,)
    shape : tuple of int
        Of a field.
    """

    weights = 1.0

    def __init__(self, pencil: Pencil, settings: EigenSettings) -> None:
        self.pencil = pencil
        self.settings = settings
        self.shape = pencil.op.domain.shape
        self.values = general_values(pencil, settings)
        self._pairs: dict[int, Any] = {}
        self._refusals: dict[int, DerivativeError | None] = {}

    def pair(self, number: int) -> Any:
        """Return the vectors of an eigenvalue: a Pair, or a PairOfSpace if the eigenspace has more dimensions."""
        if number not in self._pairs:
            self._find(number)
        return self._pairs[number]

    def _find(self, number):
        """Compute the vectors of an eigenvalue, and those of its copies."""
        least = SAME * float(np.ldexp(self.pencil.scale, self.pencil.exponent))
        copies = self._cluster(number, least)
        failure = None
        pair = None
        try:
            pair = Pair(self.pencil, self.values[number], number, self.settings.rtol)
        except ConvergenceError as error:
            failure = error
        if pair is None or pair.is_defective or len(copies) > 1 or pair.gap <= least:
            space = _eigenspace(self.pencil, complex(np.mean(self.values[copies])), number)
            if space and (len(space) > 1 or pair is None):
                for place, copy in enumerate(copies):
                    self._pairs.setdefault(int(copy), space[place % len(space)])
                return
        if failure is not None:
            raise failure
        self._pairs[number] = pair

    def _cluster(self, number, least):
        """Return the numbers of the eigenvalues at a distance of at most `least` from another one of the cluster."""
        is_near = np.abs(self.values[:, None] - self.values) <= least
        is_member = is_near[number]
        for _ in self.values:
            is_member = np.any(is_near[is_member], axis=0)
        return np.flatnonzero(is_member)

    def refusal(self, number: int) -> DerivativeError | None:
        """Return the error for the derivative of an eigenvalue that is not simple; None if it is simple."""
        if number not in self._refusals:
            self._refusals[number] = self._refusal(number)
        return self._refusals[number]

    def _refusal(self, number):
        value = self.values[number]
        floor = ROUNDING * float(np.ldexp(self.pencil.scale, self.pencil.exponent))
        least = max(self.settings.cluster * abs(value), floor)
        gaps = np.delete(np.abs(self.values - value), number)
        gap = float(np.min(gaps, initial=np.inf))
        if gap > least:
            try:
                pair = self.pair(number)
                gap = 0.0 if pair.is_defective else min(gap, pair.gap)
            except ConvergenceError:
                gap = 0.0
        if gap > least:
            return None
        return DerivativeError(
            f"eigenvalue {number} of eigenpairs, {value:.10g}, has no derivative: it is a multiple one, or another one "
            f"is at a distance of {gap:.1e}"
        )


class Pair:
    """The right and left vectors of an eigenvalue, and the solves of their derivatives.

    Parameters
    ----------
    pencil : Pencil
    value : complex
    number : int
    rtol : float
        Largest relative residual.

    Attributes
    ----------
    value : complex
        The eigenvalue, in the units of the operators as given.
    v, u : complex arrays, shape (n,)
        u^T M v = 1 and c^T v = 1.
    c : complex array
    mass_v, mass_u : complex arrays
        M v and M^T u.
    is_defective : bool
        Whether |u^T M v| is so small that derivatives are refused.
    condition_number : float
        |u| |M v| / |u^T M v|; inf if the eigenvalue is defective up to rounding errors of A. Then u has norm 1.

    Notes
    -----
    Let h(lambda) be the last unknown of the bordered system, which is 0 at an eigenvalue, scaled by u. Then
    h' = u^T M v and h'' / 2 = u^T M dv/dlambda. A change of A by |h'|^2 / (2 |h''|) makes the eigenvalue a multiple
    one. If this is a rounding error, the cosine of a computed defective eigenvalue, about 1e-8 for two copies, has no
    correct digit. The cosine of a simple eigenvalue that is sensitive may be as small, but is correct.
    """

    def __init__(self, pencil: Pencil, value: complex, number: int, rtol: float) -> None:
        self._pencil = pencil
        stiffness, mass = pencil.matrices
        value = complex(value) * 2.0**-pencil.exponent
        is_real = not pencil.complex and value.imag == 0
        n = pencil.unknowns
        scale = pencil.scale
        unit = np.append(np.zeros(n), 1.0)
        largest = _largest_entries(stiffness, mass, value.real if is_real else value, scale, number)
        for _ in range(CORRECTIONS):
            shift = value.real if is_real else value
            block = stiffness - shift * mass
            borders = [sp.coo_array(([scale], ([place], [0])), shape=(n, 1)) for place in largest]
            bordered = sp.block_array([[block, borders[1]], [borders[0].T, None]], format="csc")
            factors = _factors(bordered, number)
            v = factors.solve(unit.astype(bordered.dtype))[:n]
            u = factors.solve(unit.astype(bordered.dtype), "T")[:n]
            sizes: Any = (np.linalg.norm(v), np.linalg.norm(u))
            if not np.all(np.isfinite(sizes)):
                raise _no_vector(number, "the bordered matrix is singular")
            v, u = v / sizes[0], u / sizes[1]
            mass_v, mass_u = mass @ v, mass.T @ u
            product = u @ mass_v
            terms = abs(stiffness) @ np.abs(v) + abs(value) * (abs(mass) @ np.abs(v))
            residuals: Any = [
                np.linalg.norm(stiffness @ v - value * mass_v),
                np.linalg.norm(stiffness.T @ u - value * mass_u),
            ]
            left_terms = abs(stiffness).T @ np.abs(u) + abs(value) * (abs(mass).T @ np.abs(u))
            bounds = [
                max(rtol * abs(value) * np.linalg.norm(image), RESIDUAL * np.linalg.norm(size))
                for image, size in ((mass_v, terms), (mass_u, left_terms))
            ]
            if residuals[0] <= bounds[0] and residuals[1] <= bounds[1]:
                break
            if product != 0:
                value = complex((u @ (stiffness @ v)) / product)
        else:
            raise _no_vector(number, f"residual {np.max(residuals) / (np.linalg.norm(terms) or 1.0):.1e}")
        cosine = abs(product) / max(np.linalg.norm(u) * np.linalg.norm(mass_v), 1e-300)
        slope = factors.solve(np.append(mass_v, 0.0).astype(bordered.dtype))[:n]  # dv/dlambda
        allowed = 4 * AT_ROUNDOFF * np.linalg.norm(terms) * abs(mass_u @ slope)
        is_multiple = cosine <= LARGEST_DEFECTIVE and abs(product) ** 2 <= allowed
        is_infinite = bool(is_multiple or cosine <= PERPENDICULAR)
        self.is_defective = bool(is_infinite or cosine <= DEFECTIVE)
        self._factors = factors
        self._dtype = bordered.dtype
        self.value = value * 2.0**pencil.exponent
        right = with_fixed_sign(v)
        self.condition_number = np.inf if is_infinite else float(1 / cosine)
        scale_u = 1.0 if is_infinite else 2.0**-pencil.mass_exponent
        safe = 1.0 if is_infinite else product
        self._scaled = v, u / safe, mass_v, mass_u / safe
        # In the units of the operators as given, M is 2^mass_exponent times the mass of the pencil.
        self.v = self._embedded(v)
        self.u = self._embedded(u / safe * scale_u)
        self.mass_v = self._embedded(mass_v) * 2.0**pencil.mass_exponent
        self.mass_u = self._embedded(mass_u / safe)
        self.c = self._embedded(np.conj(v))
        self.right = self._embedded(right)
        turn = np.vdot(v, right)
        self.left = np.conj(self.u / turn)

    def _embedded(self, vector):
        return self._pencil.embedded(np.asarray(vector, complex)[None])[0]

    @cached_property
    def gap(self) -> float:
        """Estimate of the distance of the nearest other eigenvalue, by inverse iteration without this one."""
        v, u, mass_v, mass_u = self._scaled
        mass = self._pencil.matrices[1]
        x = mass @ np.random.default_rng(1).standard_normal(v.size)
        x = self._singular_solve(x - (u @ x) * mass_v, False)
        size = 0.0
        for _ in range(GAP_STEPS):
            length = np.linalg.norm(x)
            if not np.isfinite(length):
                return 0.0
            if length == 0:
                return np.inf
            x = mass @ (x / length)
            x = self._singular_solve(x - (u @ x) * mass_v, False)
            size = float(np.linalg.norm(x))
        if not np.isfinite(size):
            return 0.0
        return float(np.ldexp(1 / size, self._pencil.exponent)) if size > 0 else np.inf

    def _singular_solve(self, r, transposed):
        """Return x with (A - lambda M) x = r and (M^T u)^T x = 0, or the same for the transpose; scaled units."""
        v, u, mass_v, mass_u = self._scaled

        def solve(r):
            data = np.append(r, 0.0)
            trans = "T" if transposed else "N"
            if self._dtype.kind == "c":
                return self._factors.solve(data.astype(complex), trans)[:-1]
            if data.dtype.kind != "c":
                return self._factors.solve(data, trans)[:-1]
            return (self._factors.solve(data.real.copy(), trans) + 1j * self._factors.solve(data.imag.copy(), trans))[
                :-1
            ]

        x = solve(r)
        if transposed:
            return x - (mass_v @ x) * u
        return x - (mass_u @ x) * v

    def solve(self, r: NDArray[Any], transposed: bool) -> NDArray[Any]:
        """Return x with (A - lambda M) x = r and (M^T u)^T x = 0, or the same for the transpose, for r in the range."""
        active = self._pencil.active
        data = r if active is None else r[active]
        return self._embedded(self._singular_solve(data, transposed) * 2.0**-self._pencil.system.exponent)


class PairOfSpace(NamedTuple):
    """A right and a left vector of an eigenvalue whose eigenspace has more dimensions; they have no derivatives.

    Attributes
    ----------
    right, left : complex arrays, shape (n,)
    condition_number : float
    is_defective : bool
    gap : float
        Distance of the nearest other eigenvalue: 0.
    """

    right: NDArray[Any]
    left: NDArray[Any]
    condition_number: float
    is_defective: bool
    gap: float = 0.0


def _eigenspace(pencil, value, number):
    """Return pairs of vectors that are bases of the eigenspaces of a multiple eigenvalue; none if there are none."""
    stiffness, mass = pencil.matrices
    value = value * 2.0**-pencil.exponent
    if not pencil.complex and value.imag == 0:
        value = value.real
    shifted = stiffness - value * mass
    try:
        factors = _shifted_factors(stiffness, mass, value, pencil.scale, number)
    except ConvergenceError:
        return []
    bases = []
    for transposed in (False, True):
        basis = _null_space(shifted, mass, factors, value, stiffness, transposed)
        if not basis.shape[1]:
            return []
        bases.append(basis)
    V, U = bases
    if V.shape != U.shape:
        return []
    P, sizes, Q = np.linalg.svd(U.T @ (mass @ V))
    V = V @ Q.conj().T
    U = U @ P.conj()
    pairs = []
    for v, u, size in zip(V.T, U.T, sizes, strict=True):
        cosine = size / max(np.linalg.norm(mass @ v), 1e-300)
        is_defective = bool(cosine <= LARGEST_DEFECTIVE)
        right = with_fixed_sign(v)
        left = np.conj(u / np.vdot(v, right))
        if not is_defective:
            left = left / size * 2.0**-pencil.mass_exponent
        right, left = pencil.embedded(np.array([right, left], complex))
        condition_number = np.inf if is_defective else float(1 / cosine)
        pairs.append(PairOfSpace(right, left, condition_number, is_defective))
    return pairs


def _null_space(shifted, mass, factors, value, stiffness, transposed):
    """Return an orthonormal basis, shape (n, m), of the null space of A - lambda M, or of its transpose."""
    n = mass.shape[0]
    terms = abs(stiffness) + abs(value) * abs(mass)
    if transposed:
        shifted, mass, terms = shifted.T, mass.T, terms.T
    bound = RESIDUAL * float(np.max(terms @ np.ones(n), initial=0.0))
    width = min(n, 4)
    while True:
        x = np.random.default_rng(width).standard_normal((n, width)).astype(shifted.dtype)
        for _ in range(SPACE_STEPS):
            x = factors.solve(mass @ x, "T" if transposed else "N")
            if not np.all(np.isfinite(x)):
                return x[:, :0]
            x = np.linalg.qr(x)[0]
        _, sizes, rows = np.linalg.svd(shifted @ x, full_matrices=False)
        is_null = sizes <= bound
        if np.all(is_null) and width < n:
            width = min(n, 2 * width)
            continue
        return x @ rows[is_null].conj().T


def _factors(matrix, number):
    """Return the LU factors of a matrix."""
    try:
        return splu(sp.csc_array(matrix))
    except RuntimeError:
        raise _no_vector(number, "the matrix is singular") from None


def _shifted_factors(stiffness, mass, value, scale, number):
    """Return the LU factors of A - (lambda + e) M for a small number e with which they exist."""
    for factor in SHIFTS:
        try:
            return _factors(stiffness - (value + factor * NEAR * scale) * mass, number)
        except ConvergenceError:
            continue
    raise _no_vector(number, "the matrix is singular")


def _largest_entries(stiffness, mass, value, scale, number):
    """Return the places of the largest entries of v and u, by inverse iteration."""
    factors = _shifted_factors(stiffness, mass, value, scale, number)
    places = []
    for transposed in (False, True):
        matrix = mass.T if transposed else mass
        x = np.random.default_rng(number).standard_normal(mass.shape[0]).astype(np.result_type(value, stiffness.dtype))
        for _ in range(START_STEPS):
            x = factors.solve(matrix @ x, "T" if transposed else "N")
            size = np.max(np.abs(x))
            if not (np.isfinite(size) and size > 0):
                raise _no_vector(number, "inverse iteration fails")
            x = x / size
        places.append(int(np.argmax(np.abs(x))))
    return places


def _no_vector(number, reason):
    return ConvergenceError(
        f"eigenpairs found no vectors for eigenvalue {number}: {reason}; write a number near it as which",
        info=failure("stagnated"),
    )


# ---- the result ------------------------------------------------------------------------------------------------------


class GeneralEigenpairs:
    """Eigenvalues of an operator that need not be symmetric, and their vectors, which `eigenpairs` returns.

    Parameters
    ----------
    problem : GeneralEigenProblem
    split : callable or None
        Returns the tree of a flat array of unknowns, if the operator is the Jacobian of a residual.

    Attributes
    ----------
    values : array, shape (k,)
        Complex, in ascending order of their real parts; differentiable.
    vectors, left_vectors : array, shape (k, *domain.shape), or trees of them
        Computed when they are first read.
    condition_numbers : array, shape (k,)
        Computed when they are first read. Infinite for an eigenvalue that is defective up to rounding: it has fewer
        vectors than its multiplicity, some are repeated, and left ones with w^H M v = 0 have norm 1.
    """

    def __init__(self, problem: GeneralEigenProblem, split: Callable | None) -> None:
        self._problem = problem
        self._split = split
        solution: Any = problem.plain_solution
        self._solution = solution
        self._count = len(solution.values)

    @cached_property
    def values(self) -> Any:
        """The eigenvalues, shape (k,)."""
        if not any(map(isbox, self._problem.coefficients)):
            return self._solution.values.copy()
        return anp.concatenate([self._problem.value(number) for number in range(self._count)])

    @cached_property
    def vectors(self) -> Any:
        """The right eigenvectors, A v = lambda M v, of norm 1; their first large entry is positive."""
        return self._fields(self._problem.all_vectors(left=False))

    @cached_property
    def left_vectors(self) -> Any:
        """The left eigenvectors, w^H A = lambda w^H M, with w^H M v = 1 (adjoint modes).

        If w^H M v is 0 up to rounding, as for a defective eigenvalue, w has norm 1.
        """
        return self._fields(self._problem.all_vectors(left=True))

    @cached_property
    def condition_numbers(self) -> NDArray[Any]:
        """The condition numbers |w| |M v| / |w^H M v| of the eigenvalues, shape (k,); inf for a defective one."""
        return np.array([self._solution.pair(number).condition_number for number in range(self._count)])

    def _fields(self, rows):
        return rows if self._split is None else self._split(rows)

    def __len__(self) -> int:
        return self._count

    def __repr__(self) -> str:
        return f"<{self._count} eigenvalues>"
