"""Runge-Kutta steps: explicit ones from a table of weights, implicit ones from stages x that solve x = b + h f(x, t).

If the rate is c L u only, an explicit step of order p with p stages is u times the Taylor polynomial of order p of
exp(z L), with z = h c. Such a step is one node on the tape; with a node for each stage of Horner's rule it would take
two to three times as long.

The implicit methods are backward Euler, Crank-Nicolson, TR-BDF2 and imex. In a linear problem, f = c L x + s(t), a
stage is the linear solve x = (1 - h c L)^-1 (b + h s). In a nonlinear problem a stage is found by Newton's method.

Crank-Nicolson is x = 2 w - u with w = (1 - z/2 L)^-1 (u + h/4 (s_0 + s_1)): one solve, no product with L.
TR-BDF2 takes Crank-Nicolson over g h, g = 2 - sqrt(2), then x = b + d h f(x) with d = g/2 and
b = u + (y - u) / (g (2 - g)): both stages have the same factor 1 - d z L.

imex, for u' = c L u + N(u, t) + s(t), is the method ARS(2,2,2) of order 2, whose implicit part is L-stable, with
d = 1 - 1/sqrt(2), e = 1 - 1/(2 d), z = c h. The source s(t) is treated implicitly like the operator, because it usually
contains the boundary values of the operator. It is evaluated at the time of each stage,

    x1 = u + h d N(u) + d (z L x1 + h s(t + d h)),
    x2 = u + h (e N(u) + (1 - e) N(x1)) + (1 - d) (z L x1 + h s(t + d h)) + d (z L x2 + h s(t + h)),

These are two solves with the same factorisation. z L x1 + h s is computed from the first equation, without a product
with L.

All linear stages solve (1 - z L) x = b, and are differentiable in z and b. With S = (1 - z L)^-1 and x = S b,

    dx = S (db + dz L x),          so with y = S^T g:   b_bar = y,   z_bar = y . L x.

The transposed solve is a rule of the same form with L^T, so that derivatives of every order exist. One set-up is used
for all stages, steps and adjoint solves with the same z. For z = 0 the result is b, without set-up or solve.

The component of b in the null space of L (the mean, if there is no flux through the walls) is removed before the solve
and added to the result. In this component 1 - z L has the eigenvalue 1, while other eigenvalues are of size z |L|, so
that the solve would lose digits of it.

References
----------
K. Heun, Z. Math. Phys. 45 (1900); W. Kutta, Z. Math. Phys. 46 (1901); C.-W. Shu, S. Osher, J. Comput. Phys. 77 (1988),
the strong-stability-preserving step of order 3; R. E. Bank et al., IEEE Trans. Electron Devices 32 (1985); M. E. Hosea,
L. F. Shampine, Appl. Numer. Math. 20 (1996); U. M. Ascher, S. J. Ruuth, R. J. Spiteri, Appl. Numer. Math. 25 (1997).
"""

from __future__ import annotations

from functools import cached_property, lru_cache, partial, reduce
from math import sqrt
from operator import add
from typing import TYPE_CHECKING, Any, NamedTuple

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp._utils.counters import note
from sparsedp.autodiff.derivative import of_argument
from sparsedp.autodiff.tape import Rule
from sparsedp.errors import ConvergenceError, UnstableStepError
from sparsedp.integrators.problem import SidedParams, combine, time_after, untraced, without_side
from sparsedp.operators.given import from_matrix
from sparsedp.operators.operator import Operator
from sparsedp.solvers.adjoint import solve_rule
from sparsedp.solvers.inverse import build
from sparsedp.solvers.nullspace import Projector
from sparsedp.solvers.records import SolveLog
from sparsedp.solvers.roots import implicit
from sparsedp.solvers.system import System

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from sparsedp.integrators.problem import Problem
    from sparsedp.solvers.choose_method import SolveSettings

__all__ = [
    "EXPLICIT",
    "IMPLICIT",
    "Explicit",
    "Linear",
    "Nonlinear",
    "Polynomial",
    "Resolvent",
    "Scheme",
    "as_matrix",
]


class Scheme:
    """A time step: ``scheme(u, params, t, h)`` returns the state after a step h of a problem.

    Attributes
    ----------
    order : int
        Order of accuracy in time.
    dyadic : bool
        Whether error control restricts step lengths to an interval divided by powers of two, to need few set-ups.
    info : SolveLog or None
        Records of the last solves and set-up.
    """

    dyadic = False
    info: Any = None

    def __init__(self, problem: Any, name: str, order: int) -> None:
        self.problem = problem
        self.name = name
        self.order = order


# ---- explicit --------------------------------------------------------------------------------------------------------


class Table(NamedTuple):
    """Weights of an explicit Runge-Kutta step of order p with p stages.

    Attributes
    ----------
    stages : tuple
        For each stage after the first, the weights of the rates of earlier stages.
    weights : tuple
        Weights of the rates in the result.
    order : int
    reach : float
        Length of the stable interval on the negative real axis.
    """

    stages: tuple
    weights: tuple
    order: int
    reach: float


EXPLICIT = {
    "euler": Table((), (1.0,), 1, 2.0),
    "heun": Table(((1.0,),), (0.5, 0.5), 2, 2.0),
    "ssprk3": Table(((1.0,), (0.25, 0.25)), (1 / 6, 1 / 6, 2 / 3), 3, 2.512745326618),
    "rk4": Table(((0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)), (1 / 6, 1 / 3, 1 / 3, 1 / 6), 4, 2.785293563405),
}


class Explicit(Scheme):
    """An explicit step of a problem whose state may be any tree."""

    def __init__(self, problem: Problem, name: str) -> None:
        self.table = EXPLICIT[name]
        super().__init__(problem, name, self.table.order)

    def __call__(self, u: Any, params: Any, t: Any, h: Any, first: Any = None) -> Any:
        """Return the state after a step; `first` is the rate at its start, if the caller has evaluated it."""
        rates = [self.problem(u, params, t) if first is None else first]
        for row in self.table.stages:
            rates.append(self.problem(_advanced(u, h, row, rates), params, time_after(t, sum(row) * h)))
        return _advanced(u, h, self.table.weights, rates)


def _advanced(u: Any, h: Any, weights: Sequence[float], rates: Sequence) -> Any:
    return combine(u, *((h * weight, rate) for weight, rate in zip(weights, rates, strict=True) if weight))


class Polynomial(Scheme):
    """An explicit step of u' = c L u: one node on the tape, whose VJP is the polynomial of the transpose."""

    def __init__(self, problem: Problem, name: str) -> None:
        super().__init__(problem, name, EXPLICIT[name].order)
        self._rule = lru_cache(None)(taylor)  # one rule for each operator

    def __call__(self, u: Any, params: Any, t: Any, h: Any) -> Any:
        """Return the state after a step."""
        name = f"stepper({self.name})"

        def advanced(op: Operator | None, z: Any, leaf: Any) -> Any:
            if op is None:
                return 1.0 * leaf
            return self._rule(op, name, self.order)(z, leaf)

        return self.problem.on_fields(advanced, h, params, u)


def taylor(op: Operator, name: str, order: int, power: int = 0) -> Rule:
    """Return the rule of (z, u) for L^power T_order(z L) u, with the Taylor polynomial T of the exponential.

    Its derivative with respect to z is again such a rule, with order - 1 and power + 1.
    """
    if name.endswith(".T"):
        other = name.removesuffix(".T")
    else:
        other = f"{name}.T"
    transposed = partial(taylor, op.T, other, order, power)
    slope = partial(taylor, op, name, order - 1, power + 1)

    def forward(z: Any, u: Any) -> Any:
        z = float(z)  # a Python float, so that products with float32 fields are computed in float32
        if order >= 0:
            total = u
        else:
            total = 0.0 * u
        for k in range(order, 0, -1):
            total = op.apply(total)
            total *= z / k
            total += u
        for _ in range(power):
            total = op.apply(total)
        return total

    return family(name, forward, slope, transposed)


def family(name: str, forward: Callable, slope: Callable[[], Rule], transposed: Callable[[], Rule]) -> Rule:
    """Return the Rule of (z, b) for F(z) b, a linear map of b that depends on a number z.

    With y = F(z) b

        dy = F(z) db + F'(z) b dz,     b_bar = F(z)^T g,     z_bar = g . F'(z) b.

    Parameters
    ----------
    name : str
    forward : callable
        ``forward(z, b)``.
    slope, transposed : callable
        Return the Rules of F'(z) b and of F(z)^T b, of the same form.
    """

    def vjp(nums: Sequence[int], ans: Any, z: Any, b: Any) -> Callable:
        def pull(g: Any) -> tuple:
            backs = []
            for num in nums:
                if num == 1:
                    backs.append(of_argument(transposed()(z, g), b))
                else:
                    backs.append(of_argument(anp.sum(g * slope()(z, b)), z))
            return tuple(backs)

        return pull

    def jvp(nums: Sequence[int], tangents: Sequence, ans: Any, z: Any, b: Any) -> Any:
        parts = []
        for num, tangent in zip(nums, tangents, strict=True):
            if num == 1:
                parts.append(rule(z, tangent))
            else:
                parts.append(tangent * slope()(z, b))
        return reduce(add, parts)

    rule = Rule(name, forward, vjp, jvp)
    return rule


# ---- the linear solve ------------------------------------------------------------------------------------------------


class Resolvent:
    """Solves (1 - z L) x = b for a number z >= 0 and a field b on the domain of L.

    Parameters
    ----------
    op : Operator
        L, from a space to itself.
    name : str
        Name in error messages and counts.
    settings : SolveSettings
    most : int
        Number of cached set-ups.
    log : SolveLog, optional
        Log in which the solves are recorded.

    Attributes
    ----------
    info : SolveLog
    """

    def __init__(
        self, op: Operator, name: str, settings: SolveSettings, most: int = 2, log: SolveLog | None = None
    ) -> None:
        from sparsedp.operators.masks_and_lift import identity  # not needed by explicit schemes

        self.op = op
        self.name = name
        self.settings = settings
        self.info = log or SolveLog()
        self._one = identity(op.domain)
        self._inverse = lru_cache(most)(self._set_up)

    def __call__(self, z: Any, b: Any) -> Any:
        """Return x."""
        return solve_rule(f"{self.name}.solve", self._solved, self._back, self._product, checked=True)(b, z)

    def _solved(self, transposed: bool, checked: bool, b: Any, z: Any) -> Any:
        if z == 0:
            note(f"{self.name}.solve", "skipped", "dt or coefficient 0, no solve and no set-up")
            return self._one.apply(b)  # converts integers to floats
        inverse = self._inverse(float(z))
        if transposed:
            return inverse.T.apply(b)
        if checked:
            return inverse.apply(b)
        return inverse.tangent.apply(b)

    def _back(self, params: Sequence, places: Any, y: Any, x: Any) -> list:
        return [of_argument(anp.sum(y * self.op(x)), params[0])]

    def _product(self, transposed: bool, x: Any, z: Any) -> Any:
        if transposed:
            op = self.op.T
        else:
            op = self.op
        return x - z * op(x)

    def _set_up(self, z: float) -> Operator:
        """Return the inverse of 1 - z L."""
        inverse = build(self._one - z * self.op, self.settings, self.name, self.info)
        self._check_sign(inverse.structure.solver.system)
        P = self._projection
        if P is None:
            return inverse
        return self._named(((P @ inverse - self._one) @ P + self._one).structure)

    def _check_sign(self, system: Any) -> None:
        """Raise UnstableStepError if L has an eigenvalue of 1 / z or more: a step would change the sign of its field.

        Only symmetric operators are checked, by a few power iterations.
        """
        if system.complex or not system.symmetric:
            return
        x = system.masked(np.random.default_rng(system.seed).standard_normal(system.local_size))
        for _ in range(8):  # power iteration with z L
            change = x - system.masked(system.applied(x))  # z L x
            if system.total(x @ (system.weights * (x - change))) < 0:
                raise UnstableStepError(
                    f"the operator of {self.name} makes fields grow faster than the step can follow, as -laplacian "
                    "does; change its sign, or take a smaller time step"
                )
            x = change / (system.largest(change) or 1.0)

    def _named(self, structure: Any) -> Operator:
        return Operator(structure, self.op.domain, self.op.domain, self.name)

    @cached_property
    def _projection(self) -> Operator | None:
        """Return the projection along the null space of L; None if there is no null space or L is not symmetric."""
        system = self.op.backend.implementation(System)(self.op, self.settings.rtol, None)
        if not self.op.structure.has_entries or system.complex or system.weights is None:
            return None
        null = system.null_space
        if null.count:
            return self._named(Projector(null, self.op.shape))
        return None


# ---- implicit: steps with stages -------------------------------------------------------------------------------------

G = 2 - sqrt(2.0)
D = G / 2
C = 1 / (G * (2 - G))
E = 1 - 1 / (2 * D)


def backward_euler(stages: Stages, u: Any, params: Any, t: Any, h: Any) -> Any:
    """Order 1, L-stable."""
    return stages.solve(u, u, params, time_after(t, h), h)


def crank_nicolson(stages: Stages, u: Any, params: Any, t: Any, h: Any) -> Any:
    """Order 2, A-stable: stiff components keep their size and change their sign in each step."""
    return stages.trapezium(u, params, t, h)


def tr_bdf2(stages: Stages, u: Any, params: Any, t: Any, h: Any) -> Any:
    """Order 2, L-stable."""
    y = stages.trapezium(u, params, t, G * h)
    return stages.solve(y, combine(u, (C, combine(y, (-1.0, u)))), params, time_after(t, h), D * h)


def imex(stages: Stages, u: Any, params: Any, t: Any, h: Any) -> Any:
    """Order 2: the rate explicit, operator and source implicit (L-stable)."""

    def advanced(*pairs: tuple) -> Any:
        """Return u plus the sum of factor * rate over pairs whose rate is not None."""
        return combine(u, *(pair for pair in pairs if pair[1] is not None))

    first = stages.problem.rate_value(u, params, t)
    b = advanced((D * h, first))
    x = stages.solve(u, b, params, time_after(t, D * h), D * h)
    second = stages.problem.rate_value(x, params, time_after(t, D * h))
    moved = combine(x, (-1.0, b))  # d (z L x + h s)
    b = advanced((E * h, first), ((1 - E) * h, second), ((1 - D) / D, moved))
    return stages.solve(x, b, params, time_after(t, h), D * h)


IMPLICIT = {
    "backward_euler": (backward_euler, 1),
    "crank_nicolson": (crank_nicolson, 2),
    "tr_bdf2": (tr_bdf2, 2),
    "imex": (imex, 2),
}


class Stages(Scheme):
    """An implicit step that is composed of two kinds of stages, `solve` and `trapezium`."""

    solve: Callable
    trapezium: Callable

    def __init__(self, problem: Problem, name: str) -> None:
        self.advance, order = IMPLICIT[name]
        super().__init__(problem, name, order)

    def __call__(self, u: Any, params: Any, t: Any, h: Any) -> Any:
        """Return the state after a step."""
        return self.advance(self, u, params, t, h)


class Linear(Stages):
    """Stages of u' = c L u + source, with one set-up (factorisation, hierarchy or transform) for each L and h c.

    Parameters
    ----------
    problem : Problem
    name : str
        One of IMPLICIT.
    settings : SolveSettings
    most : int
        Number of cached set-ups per term.
    """

    dyadic = True

    def __init__(self, problem: Problem, name: str, settings: SolveSettings, most: int) -> None:
        super().__init__(problem, name)
        self.info = SolveLog()
        self.resolvents = {}
        for op in problem.operators:
            self.resolvents[op] = Resolvent(op, f"stepper({name})", settings, most * len(problem.stiff), self.info)

    def _resolved(self, h: Any, params: Any, b: Any, *shares: tuple) -> Any:
        """Return (1 - h c L)^-1 (b + the sum of factor * s(t) over pairs (factor, t)) for each field."""
        if self.problem.source is not None:
            b = combine(b, *((factor, self.problem.source_value(params, t)) for factor, t in shares))

        def solved(op: Operator | None, z: Any, leaf: Any) -> Any:
            if op is None:
                return leaf
            return self.resolvents[op](z, leaf)

        return self.problem.on_fields(solved, h, params, b)

    def solve(self, guess: Any, b: Any, params: Any, t: Any, h: Any) -> Any:
        """Return the solution x of x = b + h (c L x + s(t))."""
        return self._resolved(h, params, b, (h, t))

    def trapezium(self, u: Any, params: Any, t: Any, h: Any) -> Any:
        """Return x of x = u + h/2 (f(u, t) + f(x, t + h))."""
        w = self._resolved(0.5 * h, params, u, *((0.25 * h, at) for at in (t, time_after(t, h))))
        return combine(w, (1.0, w), (-1.0, u))


class Nonlinear(Stages):
    """Stages of u' = f(u, params, t) by Newton's method; the VJP of each stage takes one adjoint solve.

    Parameters
    ----------
    problem : Problem
    name : str
        One of IMPLICIT, except imex.
    jacobian : callable or None
        ``jacobian(u, params)`` or ``jacobian(u, params, t)``: df/du.
    settings : SolveSettings
    """

    def __init__(self, problem: Problem, name: str, jacobian: Callable | None, settings: SolveSettings) -> None:
        super().__init__(problem, name)
        options = vars(settings) | settings.options
        options = {word: value for word, value in options.items() if word != "options" and value is not None}

        def residual(x: Any, b: Any, h: Any, params: Any, t: Any) -> Any:
            return combine(x, (-1.0, b), (-h, problem(x, params, t)))

        residual.__name__ = name
        if jacobian is None:
            derivative = None
        else:
            derivative = residual_jacobian(jacobian, bool(problem.timed))
        self.root = implicit(residual, derivative, **options)
        self.info = self.root.info

    def __call__(self, u: Any, params: Any, t: Any, h: Any) -> Any:
        """Return the state after a step."""
        # The stages of one step share a Jacobian as long as Newton's method converges with it.
        with self.root.series():
            return super().__call__(u, params, t, h)

    def solve(self, guess: Any, b: Any, params: Any, t: Any, h: Any) -> Any:
        """Return the solution x of x = b + h f(x, t)."""
        try:
            return self.root(untraced(guess), b, h, params, t)
        except ConvergenceError as error:  # often there is no root, for example for a quadratic rate and a large dt
            error.args = f"{error}; take a smaller dt, or give stepper a tolerance", *error.args[1:]
            raise

    def trapezium(self, u: Any, params: Any, t: Any, h: Any) -> Any:
        """Return x of x = u + h/2 (f(u, t) + f(x, t + h))."""
        b = combine(u, (0.5 * h, self.problem(u, params, t)))
        return self.solve(u, b, params, time_after(t, h), 0.5 * h)


def residual_jacobian(jacobian: Callable, timed: bool) -> Callable:
    """Return a function for the Jacobian 1 - h df/du of the residual of a stage, given the user's df/du."""

    def of_residual(x: Any, b: Any, h: Any, params: Any, t: Any) -> Any:
        if type(params) is SidedParams:
            x, t = params.side.inside(x, params.params, t)
        if timed:
            J = as_matrix(jacobian(x, without_side(params), t))
        else:
            J = as_matrix(jacobian(x, without_side(params)))
        return sp.eye_array(J.shape[0]) - h * J

    return of_residual


def as_matrix(J: Any) -> Any:
    """Convert a user's Jacobian to a sparse matrix."""
    return (J if isinstance(J, Operator) else from_matrix(J)).matrix
