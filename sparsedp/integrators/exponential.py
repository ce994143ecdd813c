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
from sparsedp.integrators.problem import combine, later
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
        self.functions = problem.engines(lambda op: PhiFunctions(op, "stepper(etdrk4)"), _free)
        self.nodes = () if problem.source is None else NODES if problem.moving else NODES[:1]
        self.parts = [quadrature(self.nodes, *ends) for ends in ((0.0, 1.0), (0.0, 0.5), (0.5, 1.0))]

    def __call__(self, u, params, t, h):
        def f(functions, *trees):
            def of_field(op, z, leaf, *rates):
                return self.functions[op](functions, z, leaf, *(h * rate for rate in rates))

            return self.problem.on_fields(of_field, h, params, *trees)

        s = [self.problem.given(params, later(t, node * h)) for node in self.nodes]
        whole, first, second = self.parts
        if self.problem.rate is None:
            return f((WHOLE, *whole), u, *s)

        def n(v, share):
            return self.problem.explicit(v, params, later(t, share * h))

        n0 = n(u, 0.0)
        a = f((HALF, MEAN, *first), u, n0, *s)
        n1 = n(a, 0.5)
        n2 = n(f((HALF, MEAN, *first), u, n1, *s), 0.5)
        n3 = n(f((HALF, MEAN, *second), a, combine(n2, (1.0, n2), (-1.0, n0)), *s), 1.0)
        return f((WHOLE, BEGIN, MIDDLE, END, *whole), u, n0, combine(n1, (1.0, n2)), n3, *s)


def _free(functions, z, *fields):
    """The sum of functions where L is 0."""
    return sum(function.at_zero(None, field) for function, field in zip(functions, fields, strict=True))
