"""etdrk4: exponential time differencing, Runge-Kutta of order 4, in functions of z L.

Order 4, and exact where N is constant and s a polynomial of degree 3. A source counts in every stage by the
integral of exp((h - x) c L) s(t + x), with s through four points.
Source: Cox and Matthews, J. Comput. Phys. 176 (2002), formulas 26 to 29; Hochbruck and Ostermann,
Acta Numerica 19 (2010), section 2.2, exponential quadrature.
"""

from math import factorial

import numpy as np
from numpy.polynomial import Polynomial

from sparsedp.integrators.functions import Function, PhiFunctions
from sparsedp.integrators.problem import later
from sparsedp.integrators.runge_kutta import Scheme

__all__ = ["Exponential"]

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
    found = []
    for values in np.eye(len(nodes)):
        line = Polynomial.fit(nodes, values, len(nodes) - 1, domain=(start, stop), window=(0.0, 1.0))
        weights = (float((stop - start) * factorial(k) * a) for k, a in enumerate(line.coef))
        found.append(Function((0.0, *weights), stop - start))
    return tuple(found)


class Exponential(Scheme):
    """Exponential time differencing, Runge-Kutta of order 4."""

    dyadic = True

    def __init__(self, problem):
        super().__init__(problem, "etdrk4", 4)
        self.functions = PhiFunctions(problem.op, "stepper(etdrk4)")
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
