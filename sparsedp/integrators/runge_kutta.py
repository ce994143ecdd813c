"""Runge-Kutta steps. An explicit one is a table of numbers; an implicit one a few stages, x of x = b + h f(x, t).

Where the rate is c L u and nothing else, an explicit step of order p in p stages is the Taylor polynomial of order p of
exp(z L), z = h c, times u: one node on the tape, for Horner's rule on it takes two to three times as long.

Sources: Heun, Z. Math. Phys. 45 (1900); Kutta, Z. Math. Phys. 46 (1901);
Shu and Osher, J. Comput. Phys. 77 (1988), the strong-stability-preserving step of order 3.

Implicit: backward Euler, Crank-Nicolson, TR-BDF2, imex. A linear problem, f = c L x + s(t), solves
x = (1 - h c L)^-1 (b + h s); a nonlinear one finds the root.

Crank-Nicolson is x = 2 w - u with w = (1 - z/2 L)^-1 (u + h/4 (s_0 + s_1)): one solve, no product with L.
TR-BDF2 takes Crank-Nicolson over g h, g = 2 - sqrt(2), then x = b + d h f(x) with d = g/2 and
b = u + (y - u) / (g (2 - g)): both stages have the same factor 1 - d z L.
Sources: Bank et al., IEEE Trans. Electron Devices 32 (1985); Hosea and Shampine, Appl. Numer. Math. 20 (1996).

imex, for u' = c L u + N(u, t) + s(t), is ARS(2,2,2), order 2, with the L-stable implicit part d = 1 - 1/sqrt(2),
e = 1 - 1/(2 d), z = c h. A source s(t) belongs to the operator, as the walls whose values it brings: it is implicit, at
the time of each stage,

    x1 = u + h d N(u) + d (z L x1 + h s(t + d h)),
    x2 = u + h (e N(u) + (1 - e) N(x1)) + (1 - d) (z L x1 + h s(t + d h)) + d (z L x2 + h s(t + h)),

two solves with one factor; z L x1 + h s is taken from the first equation, without a product.
Source: Ascher, Ruuth, Spiteri, Appl. Numer. Math. 25 (1997).

The linear solve of all of them is x of (1 - z L) x = b, differentiable in z and b. With S = (1 - z L)^-1 and x = S b,

    dx = S (db + dz L x),          so with y = S^T g:   b_bar = y,   z_bar = y . L x.

The transposed solve is a rule of the same form with L^T: derivatives of every order follow. One set-up
serves all stages, steps and adjoint solves of one z. For z = 0, x is b, and nothing is set up or solved.

What L leaves as it is (the mean, where nothing flows through the walls) is split off before the solve and added
after it: 1 - z L has the eigenvalue 1 there beside those of size z |L|, and would lose it to rounding.
"""

from functools import cached_property, lru_cache, partial, reduce
from math import sqrt
from operator import add
from typing import Any, NamedTuple

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp._utils.counters import note
from sparsedp.autodiff.derivative import of_argument
from sparsedp.autodiff.tape import Rule
from sparsedp.errors import ConvergenceError, UnstableStepError
from sparsedp.integrators.problem import Sided, combine, later, unsided, untraced
from sparsedp.operators.given import from_matrix
from sparsedp.operators.operator import Operator
from sparsedp.solvers.adjoint import solve_rule
from sparsedp.solvers.inverse import build
from sparsedp.solvers.nullspace import Projector
from sparsedp.solvers.records import SolveLog
from sparsedp.solvers.roots import implicit
from sparsedp.solvers.system import System

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
    """``scheme(u, params, t, h)``: the state after a step h of a problem.

    Attributes
    ----------
    order : int
        Of accuracy in time.
    dyadic : bool
        Whether error control takes halves of halves of an interval, so that few set-ups are needed.
    info : SolveLog or None
        Records of the last solves and set-up.
    """

    dyadic = False
    info: Any = None

    def __init__(self, problem, name, order):
        self.problem, self.name, self.order = problem, name, order


# ---- explicit --------------------------------------------------------------------------------------------------------


class Table(NamedTuple):
    """Nodes and weights of a Runge-Kutta step of order p in p stages.

    stages: for each stage after the first, its weights of the earlier rates. weights: of the result.
    order. reach: the length of the stable interval on the negative real axis.
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

    def __init__(self, problem, name):
        self.table = EXPLICIT[name]
        super().__init__(problem, name, self.table.order)

    def __call__(self, u, params, t, h, first=None):
        """The state after a step; `first`: the rate at its start, where it is known."""
        rates = [self.problem(u, params, t) if first is None else first]
        for row in self.table.stages:
            rates.append(self.problem(_ahead(u, h, row, rates), params, later(t, sum(row) * h)))
        return _ahead(u, h, self.table.weights, rates)


def _ahead(u, h, row, rates):
    return combine(u, *((h * share, rate) for share, rate in zip(row, rates, strict=True) if share))


class Polynomial(Scheme):
    """The same for u' = c L u: one node on the tape, whose way back is the polynomial of the transpose."""

    def __init__(self, problem, name):
        super().__init__(problem, name, EXPLICIT[name].order)
        self._rule = lru_cache(None)(taylor)  # made once for each operator

    def __call__(self, u, params, t, h):
        name = f"stepper({self.name})"
        return self.problem.on_fields(
            lambda L, z, leaf: 1.0 * leaf if L is None else self._rule(L, name, self.order)(z, leaf), h, params, u
        )


def taylor(op, name, order, power=0):
    """The rule (z, u) -> L^power T_order(z L) u; its derivative in z is the same with order - 1 and power + 1."""
    other = name.removesuffix(".T") if name.endswith(".T") else f"{name}.T"
    transposed = partial(taylor, op.T, other, order, power)
    slope = partial(taylor, op, name, order - 1, power + 1)

    def forward(z, u):
        z = float(z)  # a NumPy scalar would round float32
        total = u if order >= 0 else 0.0 * u
        for k in range(order, 0, -1):
            total = op.apply(total)
            total *= z / k
            total += u
        for _ in range(power):
            total = op.apply(total)
        return total

    return family(name, forward, slope, transposed)


def family(name, forward, slope, transposed):
    """The Rule of (z, b), forward(z, b) = F(z) b: a linear map that depends on a number.

    `slope`, `transposed`: functions that give the Rules of F'(z) b and of F(z)^T b, of the same form. With y = F(z) b

        dy = F(z) db + F'(z) b dz,     b_bar = F(z)^T g,     z_bar = g . F'(z) b.
    """

    def vjp(nums, ans, *given):
        def pull(g):
            backs = (transposed()(given[0], g) if num else anp.sum(g * slope()(*given)) for num in nums)
            return tuple(of_argument(back, given[num]) for num, back in zip(nums, backs, strict=True))

        return pull

    def jvp(nums, tangents, ans, *given):
        pairs = zip(nums, tangents, strict=True)
        return reduce(add, (rule(given[0], tangent) if num else tangent * slope()(*given) for num, tangent in pairs))

    rule = Rule(name, forward, vjp, jvp)
    return rule


# ---- the linear solve ------------------------------------------------------------------------------------------------


class Resolvent:
    """solve(z, b): x of (1 - z L) x = b, with z >= 0 a number and b a field on the domain of L.

    Parameters
    ----------
    op : Operator
        L, from a space to itself.
    name : str
        For messages and counts.
    settings : dict
        method, rtol, maxiter, nullspace, options: as in `inverse`.
    most : int
        Number of set-ups that are kept.
    log : SolveLog, optional
        Where its solves are recorded.

    Attributes
    ----------
    info : SolveLog
    """

    def __init__(self, op, name, settings, most=2, log=None):
        from sparsedp.operators.masks_and_lift import identity  # explicit schemes do without

        self.op, self.name, self.settings, self._one = op, name, settings, identity(op.domain)
        self.info, self._inverse = log or SolveLog(), lru_cache(most)(self._set_up)

    def __call__(self, z, b):
        return solve_rule(f"{self.name}.solve", self._solved, self._back, self._product, checked=True)(b, z)

    def _solved(self, transposed, checked, b, z):
        if z == 0:
            note(f"{self.name}.solve", "skipped", "dt or coefficient 0, no solve and no set-up")
            return self._one.apply(b)  # whole numbers become floating ones
        inv = self._inverse(float(z))
        return (inv.T if transposed else inv if checked else inv.tangent).apply(b)

    def _back(self, params, places, y, x):
        return [of_argument(anp.sum(y * self.op(x)), params[0])]

    def _product(self, transposed, x, z):
        return x - z * (self.op.T if transposed else self.op)(x)

    def _set_up(self, z):
        """The inverse of 1 - z L."""
        inv, P = build(self._one - z * self.op, name=self.name, log=self.info, **self.settings), self._moving
        self._check_sign(inv.structure.solver.system)
        return inv if P is None else self._named(((P @ inv - self._one) @ P + self._one).structure)

    def _check_sign(self, system):
        """Refuse an L under which something grows as fast as 1 / z or faster: a step would turn its sign."""
        if system.complex or not system.symmetric:
            return
        x = system.masked(np.random.default_rng(system.seed).standard_normal(system.local_size))
        for _ in range(8):  # towards what changes fastest
            change = x - system.masked(system.applied(x))  # z L x
            if system.total(x @ (system.weights * (x - change))) < 0:
                raise UnstableStepError(
                    f"the operator of {self.name} makes fields grow faster than the step can follow, as -laplacian "
                    "does; change its sign, or take a smaller time step"
                )
            x = change / (system.largest(change) or 1.0)

    def _named(self, structure):
        return Operator(structure, self.op.domain, self.op.domain, self.name)

    @cached_property
    def _moving(self):
        """Projection from what L leaves as it is; None where that is nothing, or L unsymmetric."""
        system = self.op.backend.implementation(System)(self.op, self.settings["rtol"], None)
        if not self.op.structure.has_entries or system.complex or system.weights is None:
            return None
        null = system.null_space
        return self._named(Projector(null, self.op.shape)) if null.count else None


# ---- implicit: steps made of stages ----------------------------------------------------------------------------------

G = 2 - sqrt(2.0)
D = G / 2
C = 1 / (G * (2 - G))
E = 1 - 1 / (2 * D)


def backward_euler(stages, u, params, t, h):
    """Order 1, L-stable."""
    return stages.solve(u, u, params, later(t, h), h)


def crank_nicolson(stages, u, params, t, h):
    """Order 2, A-stable: what is stiff keeps its size and changes its sign (it rings)."""
    return stages.trapezium(u, params, t, h)


def tr_bdf2(stages, u, params, t, h):
    """Order 2, L-stable."""
    y = stages.trapezium(u, params, t, G * h)
    return stages.solve(y, combine(u, (C, combine(y, (-1.0, u)))), params, later(t, h), D * h)


def imex(stages, u, params, t, h):
    """Order 2: the rate explicit, operator and source implicit (L-stable)."""

    def ahead(*pairs):
        """u and the multiples of rates, where there is a rate."""
        return combine(u, *(pair for pair in pairs if pair[1] is not None))

    first = stages.problem.rate_value(u, params, t)
    b = ahead((D * h, first))
    x = stages.solve(u, b, params, later(t, D * h), D * h)
    second = stages.problem.rate_value(x, params, later(t, D * h))
    moved = combine(x, (-1.0, b))  # d (z L x + h s)
    b = ahead((E * h, first), ((1 - E) * h, second), ((1 - D) / D, moved))
    return stages.solve(x, b, params, later(t, h), D * h)


IMPLICIT = {
    "backward_euler": (backward_euler, 1),
    "crank_nicolson": (crank_nicolson, 2),
    "tr_bdf2": (tr_bdf2, 2),
    "imex": (imex, 2),
}


class Stages(Scheme):
    """An implicit step by its stages, solve and trapezium."""

    def __init__(self, problem, name):
        self.advance, order = IMPLICIT[name]
        super().__init__(problem, name, order)

    def __call__(self, u, params, t, h):
        return self.advance(self, u, params, t, h)


class Linear(Stages):
    """Stages of u' = c L u + source by one factor, hierarchy or transform for each L and h c.

    Parameters
    ----------
    problem : Problem
    name : str
        One of IMPLICIT.
    settings, most
        As `Resolvent` takes them.
    """

    dyadic = True

    def __init__(self, problem, name, settings, most):
        super().__init__(problem, name)
        self.info, most, name = SolveLog(), most * len(problem.stiff), f"stepper({name})"
        self.resolvents = {op: Resolvent(op, name, settings, most, self.info) for op in problem.operators}

    def _resolved(self, h, params, b, *shares):
        """(1 - h c L)^-1 (b + the sum of factor * s(t) over pairs (factor, t)), field by field."""
        if self.problem.source is not None:
            b = combine(b, *((factor, self.problem.source_value(params, t)) for factor, t in shares))
        return self.problem.on_fields(
            lambda L, z, leaf: leaf if L is None else self.resolvents[L](z, leaf), h, params, b
        )

    def solve(self, guess, b, params, t, h):
        """x of x = b + h (c L x + s(t))."""
        return self._resolved(h, params, b, (h, t))

    def trapezium(self, u, params, t, h):
        """x of x = u + h/2 (f(u, t) + f(x, t + h))."""
        w = self._resolved(0.5 * h, params, u, *((0.25 * h, at) for at in (t, later(t, h))))
        return combine(w, (1.0, w), (-1.0, u))


class Nonlinear(Stages):
    """Stages of u' = f(u, params, t) by Newton's method, with one adjoint solve for each.

    Parameters
    ----------
    problem : Problem
    name : str
        One of IMPLICIT, except imex.
    jacobian : callable or None
        ``jacobian(u, params)`` or ``jacobian(u, params, t)``: df/du.
    settings : dict
        As `Resolvent` takes them.
    """

    def __init__(self, problem, name, jacobian, settings):
        super().__init__(problem, name)
        given = (settings | settings["options"]).items()
        newton = {word: value for word, value in given if word != "options" and value is not None}

        def residual(x, b, h, params, t):
            return combine(x, (-1.0, b), (-h, problem(x, params, t)))

        residual.__name__ = name
        self.root = implicit(residual, jacobian and shifted(jacobian, problem.timed), **newton)
        self.info = self.root.info

    def __call__(self, u, params, t, h):
        # The stages share a Jacobian while that is good enough; none outlives the step.
        with self.root.series():
            return super().__call__(u, params, t, h)

    def solve(self, guess, b, params, t, h):
        """x of x = b + h f(x, t)."""
        try:
            return self.root(untraced(guess), b, h, params, t)
        except ConvergenceError as error:  # often there is no root: a quadratic rate may leave none for a large dt
            error.args = f"{error}; take a smaller dt, or give stepper a tolerance", *error.args[1:]
            raise

    def trapezium(self, u, params, t, h):
        """x of x = u + h/2 (f(u, t) + f(x, t + h))."""
        b = combine(u, (0.5 * h, self.problem(u, params, t)))
        return self.solve(u, b, params, later(t, h), 0.5 * h)


def shifted(jacobian, timed):
    """df/du -> the derivative 1 - h df/du of a stage's residual."""

    def of_residual(x, b, h, params, t):
        if type(params) is Sided:
            x, t = params.side.inside(x, params.params, t)
        J = as_matrix(jacobian(*(x, unsided(params), t)[: 2 + timed]))
        return sp.eye_array(J.shape[0]) - h * J

    return of_residual


def as_matrix(J):
    """A jacobian that was given, as a sparse matrix."""
    return (J if isinstance(J, Operator) else from_matrix(J)).matrix
