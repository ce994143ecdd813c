"""Implicit steps from one stage, x of x = b + h f(x, t): backward Euler, Crank-Nicolson, TR-BDF2.

A linear problem, f = c L x + s(t), solves x = (1 - h c L)^-1 (b + h s); a nonlinear one finds the root.

Crank-Nicolson is x = 2 w - u with w = (1 - z/2 L)^-1 (u + h/4 (s_0 + s_1)): one solve, no product with L.
TR-BDF2 takes Crank-Nicolson over g h, g = 2 - sqrt(2), then x = b + d h f(x) with d = g/2 and
b = u + (y - u) / (g (2 - g)): both stages have the same factor 1 - d z L.
Sources: Bank et al., IEEE Trans. Electron Devices 32 (1985); Hosea and Shampine, Appl. Numer. Math. 20 (1996).
"""

import numpy as np
import scipy.sparse as sp

from sparsedp.errors import ConvergenceError
from sparsedp.integrators.combination import combine, untraced
from sparsedp.integrators.resolvent import Resolvent
from sparsedp.operator import Operator
from sparsedp.solvers.roots import implicit

__all__ = ["IMPLICIT", "Linear", "Nonlinear", "later"]

G = 2 - np.sqrt(2.0)
D = float(G / 2)
C = float(1 / (G * (2 - G)))
G = float(G)


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


def later(t, h):
    """The time t + h, or None where nothing takes a time."""
    return t if t is None else t + h


def shifted(jacobian, timed):
    """df/du -> the derivative 1 - h df/du of a stage's residual."""

    def of_residual(x, b, h, params, t):
        J = jacobian(x, params, t) if timed else jacobian(x, params)
        J = J.matrix if isinstance(J, Operator) else J
        return sp.eye_array(J.shape[0]) - h * J if sp.issparse(J) else np.eye(len(J)) - h * np.asarray(J)

    return of_residual
