"""Steps of u' = c L u + N(u, t) that treat the stiff linear term apart: imex and etdrk4.

imex is ARS(2,2,2), order 2, with the L-stable implicit part d = 1 - 1/sqrt(2), e = 1 - 1/(2 d), z = c h:

    x1 = u + h d N(u) + d z L x1,     x2 = u + h (e N(u) + (1 - e) N(x1)) + (1 - d) z L x1 + d z L x2,

two solves with one factor; z L x1 is taken from the first equation, without a product.
Source: Ascher, Ruuth, Spiteri, Appl. Numer. Math. 25 (1997).

etdrk4 is order 4, and exact where N does not depend on u and t: see functions.py for the functions of z L.
Source: Cox and Matthews, J. Comput. Phys. 176 (2002), formulas 26 to 29.
"""

from sparsedp.integrators.combination import combine
from sparsedp.integrators.functions import Function, Functions
from sparsedp.integrators.implicit_steps import D
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

    @property
    def alone(self):
        """Whether there is no term beside the operator."""
        return self.problem.rate is None and self.problem.source is None

    def rest(self, u, params, t, h, share):
        """h N at the time t + share h."""
        return h * self.problem.rest(u, params, t if t is None else t + share * h)


class Imex(Split):
    """ARS(2,2,2)."""

    order = 2

    def __init__(self, problem, settings, most):
        super().__init__(problem)
        self.resolvent = Resolvent(problem.op, "stepper(imex)", settings, most)

    def __call__(self, u, params, t, h):
        z = D * h * self.problem.coefficient(params)
        if self.alone:
            x = self.resolvent(z, u)
            return self.resolvent(z, combine(u, ((1 - D) / D, combine(x, (-1.0, u)))))
        first = self.rest(u, params, t, h, 0.0)
        b = combine(u, (D, first))
        x = self.resolvent(z, b)
        second = self.rest(x, params, t, h, D)
        implicit = combine(x, (-1.0, b))  # d z L x
        return self.resolvent(z, combine(u, (E, first), (1 - E, second), ((1 - D) / D, implicit)))

    @property
    def info(self):
        return self.resolvent.info


WHOLE, HALF, MEAN = Function((1.0,)), Function((1.0,), 0.5), Function((0.0, 0.5), 0.5)
BEGIN, MIDDLE, END = (
    Function((0.0, 1.0, -3.0, 4.0)),
    Function((0.0, 0.0, 2.0, -4.0)),
    Function((0.0, 0.0, -1.0, 4.0)),
)


class Exponential(Split):
    """Exponential time differencing, Runge-Kutta of order 4."""

    order = 4

    def __init__(self, problem):
        super().__init__(problem)
        self.functions = Functions(problem.op, "stepper(etdrk4)")

    def __call__(self, u, params, t, h):
        z, f = h * self.problem.coefficient(params), self.functions
        if self.alone:
            return f((WHOLE,), z, u)
        n0 = self.rest(u, params, t, h, 0.0)
        a = f((HALF, MEAN), z, u, n0)
        n1 = self.rest(a, params, t, h, 0.5)
        n2 = self.rest(f((HALF, MEAN), z, u, n1), params, t, h, 0.5)
        n3 = self.rest(f((HALF, MEAN), z, a, 2.0 * n2 - n0), params, t, h, 1.0)
        return f((WHOLE, BEGIN, MIDDLE, END), z, u, n0, n1 + n2, n3)


SPLIT = ("imex", "etdrk4")
