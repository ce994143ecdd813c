"""Explicit Runge-Kutta steps, each a short table of numbers.

Sources: Heun, Z. Math. Phys. 45 (1900); Kutta, Z. Math. Phys. 46 (1901);
Shu and Osher, J. Comput. Phys. 77 (1988), the strong-stability-preserving step of order 3.
"""

from typing import NamedTuple

from sparsedp.integrators.combination import combine

__all__ = ["EXPLICIT", "Explicit"]


class Table(NamedTuple):
    """Nodes and weights of a Runge-Kutta step.

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
            at = t if t is None else t + sum(row) * h
            rates.append(self.problem(_ahead(u, h, row, rates), params, at))
        return _ahead(u, h, self.table.weights, rates)


def _ahead(u, h, row, rates):
    return combine(u, *((h * share, rate) for share, rate in zip(row, rates, strict=True) if share))
