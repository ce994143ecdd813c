"""Steps of u' = c L u + N(u, t) that treat the stiff linear term apart: imex and etdrk4.

imex is ARS(2,2,2), order 2, with the L-stable implicit part d = 1 - 1/sqrt(2), e = 1 - 1/(2 d), z = c h. A source
s(t) belongs to the operator, as the walls whose values it brings: it is implicit, at the time of each stage,

    x1 = u + h d N(u) + d (z L x1 + h s(t + d h)),
    x2 = u + h (e N(u) + (1 - e) N(x1)) + (1 - d) (z L x1 + h s(t + d h)) + d (z L x2 + h s(t + h)),

two solves with one factor; z L x1 + h s is taken from the first equation, without a product.
Source: Ascher, Ruuth, Spiteri, Appl. Numer. Math. 25 (1997).

etdrk4 is order 4, and exact where N is constant and s a polynomial of degree 3: see functions.py for the functions
of z L. A source counts in every stage by the integral of exp((h - x) c L) s(t + x), with s through four points.
Source: Cox and Matthews, J. Comput. Phys. 176 (2002), formulas 26 to 29; Hochbruck and Ostermann,
Acta Numerica 19 (2010), section 2.2, exponential quadrature.
"""

from math import factorial

import numpy as np

from sparsedp.integrators.combination import combine
from sparsedp.integrators.functions import Function, Functions
from sparsedp.integrators.implicit_steps import D, later
from sparsedp.integrators.resolvent import Resolvent

__all__ = ["SPLIT", "Exponential", "Imex"]

E = 1 - 1 / (2 * D)


class Split:
    """What the split steps have in common.

    Parameters
    ----------
    problem : Problem
        With an operator.
    """

    dyadic = True

    def __init__(self, problem):
        self.problem = problem


class Imex(Split):
    """ARS(2,2,2)."""

    order = 2

    def __init__(self, problem, settings, most):
        super().__init__(problem)
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


WHOLE, HALF, MEAN = Function((1.0,)), Function((1.0,), 0.5), Function((0.0, 0.5), 0.5)
BEGIN, MIDDLE, END = (
    Function((0.0, 1.0, -3.0, 4.0)),
    Function((0.0, 0.0, 2.0, -4.0)),
    Function((0.0, 0.0, -1.0, 4.0)),
)
NODES = (0.0, 0.5 - 0.1 * 5**0.5, 0.5 + 0.1 * 5**0.5, 1.0)  # of Lobatto, as shares of a step


def quadrature(nodes, start, stop):
    """Weights of s(t + node h) in h times the integral of exp((stop - x) z L) s(t + x h) over start < x < stop.

    Of the Lagrange polynomials of the nodes; that of x^k over 0 < x < 1 is k! phi_{k+1}(z L).
    """
    part = np.polynomial.Polynomial([start, stop - start])
    found = []
    for values in np.eye(len(nodes)):
        line = np.polynomial.Polynomial(np.linalg.solve(np.vander(nodes, increasing=True), values))(part)
        weights = (float((stop - start) * factorial(k) * a) for k, a in enumerate(line.coef))
        found.append(Function((0.0, *weights), stop - start))
    return tuple(found)


class Exponential(Split):
    """Exponential time differencing, Runge-Kutta of order 4."""

    order = 4

    def __init__(self, problem):
        super().__init__(problem)
        self.functions = Functions(problem.op, "stepper(etdrk4)")
        self.nodes = () if problem.source is None else NODES if problem.moving else NODES[:1]
        self.parts = [quadrature(self.nodes, *ends) for ends in ((0.0, 1.0), (0.0, 0.5), (0.5, 1.0))]

    def __call__(self, u, params, t, h):
        z, f = h * self.problem.coefficient(params), self.functions
        s = [h * self.problem.given(params, later(t, node * h)) for node in self.nodes]
        whole, first, second = self.parts
        if self.problem.rate is None:
            return f((WHOLE, *whole), z, u, *s)

        def n(v, share):
            return h * self.problem.explicit(v, params, later(t, share * h))

        n0 = n(u, 0.0)
        a = f((HALF, MEAN, *first), z, u, n0, *s)
        n1 = n(a, 0.5)
        n2 = n(f((HALF, MEAN, *first), z, u, n1, *s), 0.5)
        n3 = n(f((HALF, MEAN, *second), z, a, 2.0 * n2 - n0, *s), 1.0)
        return f((WHOLE, BEGIN, MIDDLE, END, *whole), z, u, n0, n1 + n2, n3, *s)


SPLIT = ("imex", "etdrk4")
