"""Exponential steps: functions of z L for a separable operator L, differentiable in z, and the step made of them.

Such a function f has a derivative f' of the same kind, and with y = f(z L) b

    dy = f(z L) db + L f'(z L) b dz,     b_bar = f(z L)^T g,     z_bar = g . L f'(z L) b.

So one rule serves all of them. They are sums of phi_k, by one transform and one back:

    phi_0(x) = exp(x),    phi_{k+1}(x) = (phi_k(x) - 1/k!) / x,    phi_k'(x) = phi_k(x) - k phi_{k+1}(x)

Near 0 the formula in the middle loses all digits: from x = -3 on they are taken as Kummer's functions,
phi_k(x) = 1F1(1; k + 1; x) / k!, of which SciPy knows all.
Sources: Cox and Matthews, J. Comput. Phys. 176 (2002); Kassam and Trefethen, SIAM J. Sci. Comput. 26 (2005), who name
the trouble.

etdrk4, exponential time differencing, is made of functions of z L. Order 4, and exact where N is constant and s a
polynomial of degree 3. A source counts in every stage by the integral of exp((h - x) c L) s(t + x), with s through four
points.
Source: Cox and Matthews, J. Comput. Phys. 176 (2002), formulas 26 to 29; Hochbruck and Ostermann,
Acta Numerica 19 (2010), section 2.2, exponential quadrature.
"""

from functools import lru_cache, reduce
from math import factorial
from operator import add, matmul
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Polynomial as Line
from scipy.special import hyp1f1

from sparsedp._utils.pytree import mapped
from sparsedp._utils.validation import check_finite
from sparsedp.autodiff.backend import require_arrays
from sparsedp.grid.space import Space
from sparsedp.integrators.problem import combine, later
from sparsedp.integrators.runge_kutta import Scheme, family
from sparsedp.operators.masks_and_lift import identity
from sparsedp.operators.operator import Operator
from sparsedp.solvers.separable import Eigenbasis, SpectralFunction, require_eigenbasis

__all__ = ["Exponential", "Function", "PhiFunctions", "phi"]

NEAR, LARGEST = 3.0, 1e3  # of x; beyond the second even the exponential is infinite
KEPT = 64  # operators f(z L), for a few z


def phi(k, x):
    """[phi_0(x), ..., phi_k(x)] for real x, to a few units of the last digit.

    Examples
    --------
    >>> [round(float(value), 6) for value in phi(2, np.array(-1e-9))]
    [1.0, 1.0, 0.5]
    """
    far, near = x < -NEAR, np.clip(x, -NEAR, LARGEST)
    with np.errstate(all="ignore"):
        found = [np.exp(x)]
        for j in range(k):
            kummer = hyp1f1(1, j + 2, near) / factorial(j + 1)
            found.append(np.where(far, (found[j] - 1 / factorial(j)) / x, kummer))
    return found


class Function(NamedTuple):
    """L^power f(z L) with f(x) = sum over k of weights[k] phi_k(scale x)."""

    weights: tuple
    scale: float = 1.0
    power: int = 0

    def derivative(self):
        """The function of the same kind for d/dz."""
        found = [*self.weights, 0.0]
        for k, weight in enumerate(self.weights):
            found[k + 1] -= k * weight
        return Function(tuple(self.scale * weight for weight in found), self.scale, self.power + 1)

    @property
    def start(self):
        """f(0)."""
        return sum(a / factorial(k) for k, a in enumerate(self.weights))

    def values(self, z, eigenvalues):
        """On the eigenvalues of L."""
        with np.errstate(over="ignore", invalid="ignore"):
            found = phi(len(self.weights) - 1, self.scale * z * eigenvalues)
            return eigenvalues**self.power * sum(a * value for a, value in zip(self.weights, found, strict=True) if a)


class PhiFunctions:
    """f(function, z, b): f(z L) b, differentiable in z and b, to every order.

    Parameters
    ----------
    op : Operator
        L, separable, or made of such ones.
    name : str
        For messages and counts.

    Raises
    ------
    ValueError
        If L cannot be diagonalised by transforms.
    """

    def __init__(self, op, name):
        self.op, self.name, self.space = op, name, Space(op.domain.shape, op.domain.kind)  # on no ranks
        self.spectrum, self.eigenvalues = require_eigenbasis(op, name, "; try imex or tr_bdf2")
        self._rule = lru_cache(None)(self._made)  # rules made once, for every z, step and adjoint
        self._operator = lru_cache(KEPT)(self._set_up)  # of a few z

    def __call__(self, function, z, b):
        return self._rule(function, False)(z, b)

    def _made(self, function, transposed):
        """f(z L) b, or f(z L^T) b, as a rule in (z, b)."""

        def forward(z, b):
            require_arrays(self.name, [b])
            op = self._operator(function, float(z))
            return (op.T if transposed else op).apply(b)

        slope, turned = (function.derivative(), transposed), (function, not transposed)
        name = f"{self.name}{'.T' * transposed}"
        return family(name, forward, lambda: self._rule(*slope), lambda: self._rule(*turned))

    def _set_up(self, function, z):
        """The Operator f(z L), of plain z; for z = 0 without transforms: then exp(z L) keeps every bit."""
        if z == 0:
            product = reduce(matmul, [self.op] * function.power, identity(self.op.domain))
            return self._named((function.start * product).structure)
        values = function.values(z, self.eigenvalues)
        check_finite(
            f"{self.name}: exp({z:g} * {self.op.name})", values, advice="; take a smaller dt or the other sign"
        )
        return self._named(SpectralFunction(Eigenbasis(self.spectrum, values), self.op.shape))

    def _named(self, structure):
        return Operator(structure, self.space, self.space, self.name)


# ---- the step of order 4 ---------------------------------------------------------------------------------------------

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
        line = Line.fit(nodes, values, len(nodes) - 1, domain=(start, stop), window=(0.0, 1.0))
        weights = (float((stop - start) * factorial(k) * a) for k, a in enumerate(line.coef))
        found.append(Function((0.0, *weights), stop - start))
    return tuple(found)


class Exponential(Scheme):
    """Exponential time differencing, Runge-Kutta of order 4."""

    dyadic = True

    def __init__(self, problem):
        super().__init__(problem, "etdrk4", 4)
        self.functions = {op: PhiFunctions(op, "stepper(etdrk4)") for op in problem.operators} | {None: _free}
        self.nodes = () if problem.source is None else NODES if problem.source_takes_time else NODES[:1]
        self.parts = [quadrature(self.nodes, *ends) for ends in ((0.0, 1.0), (0.0, 0.5), (0.5, 1.0))]

    def __call__(self, u, params, t, h):
        def f(functions, *trees):
            def of_field(L, z, *row):
                return reduce(add, (self.functions[L](f, z, leaf) for f, leaf in zip(functions, row, strict=True)))

            return self.problem.on_fields(of_field, h, params, *trees)

        def scaled(rate):
            return mapped(lambda leaf: leaf if leaf is None else h * leaf, rate)

        s = [scaled(self.problem.source_value(params, later(t, node * h))) for node in self.nodes]
        whole, first, second = self.parts
        if self.problem.rate is None:
            return f((WHOLE, *whole), u, *s)

        def n(v, share):
            return scaled(self.problem.rate_value(v, params, later(t, share * h)))

        n0, half = n(u, 0.0), f((HALF, *first), u, *s)
        a = combine(half, (1.0, f((MEAN,), n0)))
        n1 = n(a, 0.5)
        n2 = n(combine(half, (1.0, f((MEAN,), n1))), 0.5)
        n3 = n(f((HALF, MEAN, *second), a, combine(n2, (1.0, n2), (-1.0, n0)), *s), 1.0)
        return f((WHOLE, BEGIN, MIDDLE, END, *whole), u, n0, combine(n1, (1.0, n2)), n3, *s)


def _free(function, z, b):
    """The same where L is 0."""
    return function.start * b
