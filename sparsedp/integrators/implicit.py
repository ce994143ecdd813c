"""Implicit steps from one stage, x of x = b + h f(x, t): backward Euler, Crank-Nicolson, TR-BDF2.

A linear problem, f = c L x + s(t), solves x = (1 - h c L)^-1 (b + h s); a nonlinear one finds the root.

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

The linear solve of all of them is x of (1 - z L) x = b, differentiable in z and b.

With S = (1 - z L)^-1 and x = S b,

    dx = S (db + dz L x),          so with y = S^T g:   b_bar = y,   z_bar = y . L x.

The transposed solve is a rule of the same form with L^T: derivatives of every order follow. One set-up
serves all stages, steps and adjoint solves of one z. For z = 0, x is b, and nothing is set up or solved.

What L leaves as it is (the mean, where nothing flows through the walls) is split off before the solve and added
after it: 1 - z L has the eigenvalue 1 there beside those of size z |L|, and would lose it to rounding.
"""

from functools import cached_property
from math import sqrt

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp.errors import ConvergenceError
from sparsedp.integrators.problem import combine, later, untraced
from sparsedp.ledger import active as recordings
from sparsedp.ledger import tell
from sparsedp.operator import Operator
from sparsedp.operators.boundary import identity
from sparsedp.solvers.cache import Cache
from sparsedp.solvers.inverses import build
from sparsedp.solvers.roots import implicit
from sparsedp.solvers.solve import SolveLog
from sparsedp.solvers.system import System
from sparsedp.tape import Rule, of_argument

__all__ = ["IMPLICIT", "Imex", "Linear", "Nonlinear", "Resolvent"]


class Resolvent:
    """solve(z, b): x of (1 - z L) x = b.

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

    Attributes
    ----------
    info : SolveLog
    """

    def __init__(self, op, name, settings, most=2):
        self.op, self.name, self.settings = op, name, settings
        self.info, self._kept = SolveLog(), Cache(most)
        self._checked, self._free = self._rule(False, True), self._rule(False, False)
        self._adjoint = self._rule(True, False)

    def __call__(self, z, b):
        """Solve; z >= 0 a number, b a field on the domain of L."""
        return self._checked(z, b)

    def plain(self, z, b, transposed=False):
        """The same on plain values, or with the transpose."""
        return self._solved(z, b, transposed, not transposed)

    def _solved(self, z, b, transposed, checked):
        if z == 0:
            if recordings:
                tell(self._checked.name, "skipped", "dt or coefficient 0, no solve and no set-up")
            return np.array(b, dtype=np.result_type(b, np.float32))  # whole numbers become floating ones
        inv = self.inverse(float(z))
        inv = inv.T if transposed else inv if checked else inv.tangent
        if self._kernel is None:
            return inv.apply(b)
        b = np.asarray(b)
        wide = b.astype(np.result_type(b, np.float64), copy=False)
        moving = self._projected(wide, transposed)
        x = self._projected(inv.apply(moving), transposed) + (wide - moving)
        return x.astype(np.result_type(b, np.float32), copy=False)

    def _projected(self, b, transposed):
        """b without what L leaves as it is, field by field of a batch."""
        fields = np.ascontiguousarray(b).reshape(-1, self.op.shape[0])
        return np.array([self._kernel.project(field, transposed) for field in fields]).reshape(b.shape)

    @cached_property
    def _kernel(self):
        """The null space of L where L is symmetric up to weights, None where there is none."""
        system = System(self.op, self.settings["rtol"], None)
        if not self.op.structure.has_entries or system.complex or system.weights is None:
            return None
        return system.null_space if system.null_space is not None and system.null_space.count else None

    def _rule(self, transposed, checked):
        """The solve (or the transposed solve) as a rule in (z, b)."""

        def vjp(nums, ans, z, b):
            def pull(g):
                other = (self._free if transposed else self._adjoint)(z, g)
                x, y = (other, ans) if transposed else (ans, other)
                slopes = {0: lambda: anp.sum(y * self.op(x)), 1: lambda: other}
                return tuple(of_argument(slopes[num](), (z, b)[num]) for num in nums)

            return pull

        def jvp(nums, tangents, ans, z, b):
            op = self.op.T if transposed else self.op
            change = {0: lambda t: t * op(ans), 1: lambda t: t}
            total = sum(change[num](t) for num, t in zip(nums, tangents, strict=True))
            return (self._adjoint if transposed else self._free)(z, total)

        def forward(z, b):
            return self._solved(z, b, transposed, checked)

        return Rule(f"{self.name}.solve.T" if transposed else f"{self.name}.solve", forward, vjp, jvp)

    def inverse(self, z):
        """The inverse of 1 - z L: kept or set up."""
        known = self._kept.find((z,))
        if known is not None:
            return known
        op = identity(self.op.domain) - z * self.op
        return self._kept.put((z,), build(op, name=self.name, log=self.info, **self.settings))

    def __str__(self):
        last = self._kept.last
        return (
            "no set-up yet" if last is None else f"{len(self._kept)} of {self._kept.most} set-ups kept, last:\n{last}"
        )


G = 2 - sqrt(2.0)
D = G / 2
C = 1 / (G * (2 - G))
E = 1 - 1 / (2 * D)


def backward_euler(stage, u, params, t, h):
    """Order 1, L-stable."""
    return stage.solve(u, u, params, later(t, h), h)


def crank_nicolson(stage, u, params, t, h):
    """Order 2, A-stable: what is stiff keeps its size and changes its sign (it rings)."""
    return stage.trapezium(u, params, t, h)


def tr_bdf2(stage, u, params, t, h):
    """Order 2, L-stable."""
    y = stage.trapezium(u, params, t, G * h)
    return stage.solve(y, combine(u, (C, combine(y, (-1.0, u)))), params, later(t, h), D * h)


IMPLICIT = {"backward_euler": (backward_euler, 1), "crank_nicolson": (crank_nicolson, 2), "tr_bdf2": (tr_bdf2, 2)}


class Stage:
    """What the linear and the nonlinear stage have in common."""

    def __init__(self, problem, name):
        self.problem, self.name = problem, name
        self.advance, self.order = IMPLICIT[name]

    def __call__(self, u, params, t, h):
        """The state after a step h."""
        return self.advance(self, u, params, t, h)


class Linear(Stage):
    """Stages of u' = c L u + source by one factor, hierarchy or transform for each h c.

    Parameters
    ----------
    problem : Problem
    name : str
        One of IMPLICIT.
    settings : dict
        As `Resolvent` takes them.
    most : int
        Set-ups that are kept.
    """

    dyadic = True

    def __init__(self, problem, name, settings, most):
        super().__init__(problem, name)
        self.resolvent = Resolvent(problem.op, f"stepper({name})", settings, most)

    def solve(self, guess, b, params, t, h):
        """x of x = b + h (c L x + s(t))."""
        source = self.problem.given(params, t)
        b = b if source is None else combine(b, (h, source))
        return self.resolvent(h * self.problem.coefficient(params), b)

    def trapezium(self, u, params, t, h):
        """x of x = u + h/2 (f(u, t) + f(x, t + h))."""
        b = u
        if self.problem.source is not None:
            ends = self.problem.given(params, t), self.problem.given(params, later(t, h))
            b = combine(u, *((0.25 * h, source) for source in ends))
        w = self.resolvent(0.5 * h * self.problem.coefficient(params), b)
        return 2.0 * w - u

    @property
    def info(self):
        return self.resolvent.info


class Nonlinear(Stage):
    """Stages of u' = f(u, params, t) by Newton's method, with one adjoint solve for each.

    Parameters
    ----------
    problem : Problem
    name : str
    jacobian : callable or None
        ``jacobian(u, params)`` or ``jacobian(u, params, t)``: df/du.
    settings : dict
        Keywords of `implicit`.
    """

    dyadic = False

    def __init__(self, problem, name, jacobian, settings):
        super().__init__(problem, name)

        def residual(x, b, h, params, t):
            return combine(x, (-1.0, b), (-h, problem(x, params, t)))

        residual.__name__ = name
        self.root = implicit(residual, jacobian and shifted(jacobian, problem.timed), **settings)

    def __call__(self, u, params, t, h):
        """The state after a step h. Its stages share a Jacobian while that is good enough; none outlives the step."""
        with self.root.series():
            return self.advance(self, u, params, t, h)

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

    @property
    def info(self):
        return self.root.info


class Imex:
    """ARS(2,2,2): the rate explicit, operator and source implicit."""

    order, dyadic = 2, True

    def __init__(self, problem, settings, most):
        self.problem = problem
        self.resolvent = Resolvent(problem.op, "stepper(imex)", settings, most)

    def __call__(self, u, params, t, h):
        z, first = D * h * self.problem.coefficient(params), self.explicit(u, params, t, h)
        b = combine(u, *weighted((D, first)))
        x = self.resolvent(z, self.with_source(b, params, t, h, D))
        second = self.explicit(x, params, later(t, D * h), h)
        implicit = combine(x, (-1.0, b))  # d (z L x + h s)
        b = combine(u, *weighted((E, first), (1 - E, second)), ((1 - D) / D, implicit))
        return self.resolvent(z, self.with_source(b, params, t, h, 1.0))

    def explicit(self, u, params, t, h):
        """h N, or None where there is no rate."""
        return None if self.problem.rate is None else h * self.problem.explicit(u, params, t)

    def with_source(self, b, params, t, h, share):
        """b + d h s at the time t + share h."""
        source = self.problem.given(params, later(t, share * h))
        return b if source is None else combine(b, (D * h, source))

    @property
    def info(self):
        return self.resolvent.info


def weighted(*pairs):
    """The pairs (factor, tree) that have a tree."""
    return [pair for pair in pairs if pair[1] is not None]


def shifted(jacobian, timed):
    """df/du -> the derivative 1 - h df/du of a stage's residual."""

    def of_residual(x, b, h, params, t):
        J = jacobian(x, params, t) if timed else jacobian(x, params)
        J = J.matrix if isinstance(J, Operator) else J
        return sp.eye_array(J.shape[0]) - h * J if sp.issparse(J) else np.eye(len(J)) - h * np.asarray(J)

    return of_residual
