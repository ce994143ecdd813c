"""Explicit Runge-Kutta steps, each a short table of numbers.

Where the rate is c L u and nothing else, a step of order p in p stages is a polynomial of z L, z = h c, and one node on
the tape, with a derivative of the same form:

    T_p(z) u = u + z L u + ... + (z L)^p u / p!,     dT_p(z) u = L T_{p-1}(z) u dz + T_p(z) du

Sources: Heun, Z. Math. Phys. 45 (1900); Kutta, Z. Math. Phys. 46 (1901);
Shu and Osher, J. Comput. Phys. 77 (1988), the strong-stability-preserving step of order 3.
"""

from typing import NamedTuple

import autograd.numpy as anp

from sparsedp.integrators.problem import combine, later
from sparsedp.tape import Rule, of_argument

__all__ = ["EXPLICIT", "Explicit", "Polynomial"]


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


class Explicit:
    """An explicit Runge-Kutta step of a problem whose state may be any tree.

    Parameters
    ----------
    problem : Problem
    name : str
        One of EXPLICIT.
    """

    dyadic = False

    def __init__(self, problem, name):
        self.problem, self.table = problem, EXPLICIT[name]
        self.order = self.table.order

    def __call__(self, u, params, t, h):
        """The state after a step h."""
        rates = [self.problem(u, params, t)]
        for row in self.table.stages:
            rates.append(self.problem(_ahead(u, h, row, rates), params, later(t, sum(row) * h)))
        return _ahead(u, h, self.table.weights, rates)


def _ahead(u, h, row, rates):
    return combine(u, *((h * share, rate) for share, rate in zip(row, rates, strict=True) if share))


class Polynomial:
    """The same for u' = c L u.

    Parameters
    ----------
    problem : Problem
        With an operator, and neither rate nor source.
    name : str
        One of EXPLICIT.
    """

    dyadic = False

    def __init__(self, problem, name):
        self.problem, self.name, self.order = problem, name, EXPLICIT[name].order
        orders = range(1, self.order + 1)
        self._rules = {(terms, flag): self._rule(terms, flag) for terms in orders for flag in (False, True)}

    def __call__(self, u, params, t, h):
        """The state after a step h."""
        return self._rules[self.order, False](h * self.problem.coefficient(params), u)

    def _rule(self, terms, transposed):
        """T of L, or of L^T, as a rule in (z, u)."""
        L = self.problem.op.T if transposed else self.problem.op

        def forward(z, u):
            z, total = float(z), u  # traced it is a NumPy scalar, which would round float32 otherwise
            for k in reversed(range(1, terms + 1)):  # Horner's rule
                total = L.apply(total)
                total *= z / k
                total += u
            return total

        def slope(z, u):
            return self._rules[terms - 1, transposed](z, L(u)) if terms > 1 else L(u)

        def vjp(nums, ans, z, u):
            def pull(g):
                found = {
                    0: lambda: anp.sum(g * slope(z, u)),
                    1: lambda: self._rules[terms, not transposed](z, g),
                }
                return tuple(of_argument(found[num](), (z, u)[num]) for num in nums)

            return pull

        def jvp(nums, tangents, ans, z, u):
            change = {0: lambda t: t * slope(z, u), 1: lambda t: self._rules[terms, transposed](z, t)}
            return sum(change[num](t) for num, t in zip(nums, tangents, strict=True))

        return Rule(f"stepper({self.name}){'.T' * transposed}", forward, vjp, jvp)
