"""Functions of z L for a separable operator L: sums of phi_k(z L), differentiable in z.

    phi_0(x) = exp(x),    phi_{k+1}(x) = (phi_k(x) - 1/k!) / x,    phi_k'(x) = phi_k(x) - k phi_{k+1}(x)

so a sum f of them has a derivative of the same form, and with y = f(z L) b

    dy = f(z L) db + L f'(z L) b dz,     b_bar = f(z L)^T g,     z_bar = g . L f'(z L) b.

Near 0 the formula in the middle loses all digits: there the Taylor series of the highest one is summed and
the others follow downwards, phi_k = x phi_{k+1} + 1/k!. Sources: Cox and Matthews, J. Comput. Phys. 176
(2002); Kassam and Trefethen, SIAM J. Sci. Comput. 26 (2005), who name the trouble.

etdrk4 is order 4, and exact where N is constant and s a polynomial of degree 3. A source counts in every stage by the
integral of exp((h - x) c L) s(t + x), with s through four points.
Source: Cox and Matthews, J. Comput. Phys. 176 (2002), formulas 26 to 29; Hochbruck and Ostermann,
Acta Numerica 19 (2010), section 2.2, exponential quadrature.
"""

from functools import lru_cache
from math import factorial
from typing import NamedTuple

import autograd.numpy as anp
import numpy as np
from numpy.polynomial.polynomial import polyval

from sparsedp.errors import NonFiniteError, ShapeError
from sparsedp.integrators.problem import later
from sparsedp.integrators.runge_kutta import Scheme
from sparsedp.solvers.separable import SpectralFunction, spectrum
from sparsedp.tape import Rule, isbox, of_argument

__all__ = ["Exponential", "Function", "Functions", "phi"]

NEAR, TERMS = 3.0, 36  # the series is summed up to |x| = 3, where its terms after the 36th are below rounding
KEPT = 64  # tables of weights, for a few z


def phi(k, x):
    """[phi_0(x), ..., phi_k(x)] for real x, to a few units of the last digit.

    Examples
    --------
    >>> [round(float(value), 6) for value in phi(2, np.array(-1e-9))]
    [1.0, 1.0, 0.5]
    """
    near = np.abs(x) <= NEAR
    small, large = np.where(near, x, 0.0), np.where(near, NEAR, x)
    series = [polyval(small, [1 / factorial(n + k) for n in range(TERMS)])]
    with np.errstate(over="ignore"):
        upward = [np.exp(large)]
    for j in range(k):
        series.insert(0, small * series[0] + 1 / factorial(k - 1 - j))
        upward.append((upward[j] - 1 / factorial(j)) / large)
    return [np.where(near, low, high) for low, high in zip(series, upward, strict=True)]


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

    def at_zero(self, op, field):
        """For z = 0, where f is a number."""
        for _ in range(self.power):
            field = op.apply(field)
        return sum(a / factorial(k) for k, a in enumerate(self.weights)) * field

    def values(self, z, eigenvalues):
        """On the eigenvalues of L."""
        with np.errstate(over="ignore", invalid="ignore"):
            found = phi(len(self.weights) - 1, self.scale * z * eigenvalues)
            return eigenvalues**self.power * sum(a * value for a, value in zip(self.weights, found, strict=True) if a)


class Functions:
    """combine(functions, z, *fields): the sum of f_j(z L) b_j, by one transform for each field and one back.

    Parameters
    ----------
    op : Operator
        L, separable, or a power of a separable operator.
    name : str
        For messages and counts.

    Raises
    ------
    ValueError
        If L cannot be diagonalised by transforms.
    """

    def __init__(self, op, name):
        self.op, self.name = op, name
        self.found, self.eigenvalues = _diagonalised(op, name)
        # Plain values only, of a few z; and rules made once, for every z, step and adjoint.
        self._table, self._rule = lru_cache(KEPT)(self._values), lru_cache(None)(self._made)

    def __call__(self, functions, z, *fields):
        """The sum, differentiable in z and the fields."""
        return self._rule(functions, False)(z, *fields)

    def plain(self, rows, z, fields, transposed=False):
        """[the sum for each row of functions], on plain values, or with the transpose of L."""
        op, z = (self.op.T if transposed else self.op), float(z)
        for field in fields:
            if np.shape(field) != op.domain.shape:
                raise ShapeError(
                    f"{self.name} takes a field on {op.domain.told}, got an array of shape {np.shape(field)}"
                )
        if z == 0:  # no transform, and for phi_0 the field itself, bit for bit
            return [sum(f.at_zero(op, field) for f, field in zip(row, fields, strict=True)) for row in rows]
        if any(map(np.iscomplexobj, fields)):
            parts = (self.plain(rows, z, [*map(part, fields)], transposed) for part in (np.real, np.imag))
            return [real + 1j * imaginary for real, imaginary in zip(*parts, strict=True)]
        moved = [self.found.forward(np.asarray(field, float), transposed) for field in fields]
        sums = (sum(c * self._table(f, z) for f, c in zip(row, moved, strict=True)) for row in rows)
        return [self.found.backward(total, transposed).reshape(op.domain.shape) for total in sums]

    def _values(self, function, z):
        """The values of a function on the eigenvalues of z L."""
        values = function.values(z, self.eigenvalues)
        if not np.all(np.isfinite(values)):
            raise NonFiniteError(
                f"{self.name}: exp({z:g} * {self.op.name}) is beyond 1.8e308; take a smaller dt or the other sign"
            )
        return values

    def _made(self, functions, transposed):
        """The sum as a rule in (z, *fields)."""

        def forward(z, *fields):
            return self.plain([functions], z, fields, transposed)[0]

        def slope(z, fields):
            return self._rule(tuple(f.derivative() for f in functions), transposed)(z, *fields)

        def vjp(nums, ans, z, *fields):
            chosen = [(functions[num - 1],) for num in nums if num]

            def pull(g):
                if isbox(g) or isbox(z):
                    backs = iter([self._rule(row, not transposed)(z, g) for row in chosen])
                else:  # with one transform of g
                    backs = iter(self.plain(chosen, z, [g], not transposed))
                return tuple(next(backs) if num else of_argument(anp.sum(g * slope(z, fields)), z) for num in nums)

            return pull

        def jvp(nums, tangents, ans, z, *fields):
            chosen, moves = [functions[num - 1] for num in nums if num], tangents[nums[0] == 0 :]
            total = tangents[0] * slope(z, fields) if nums[0] == 0 else 0.0
            return total + self._rule(tuple(chosen), transposed)(z, *moves) if chosen else total

        return Rule(f"{self.name}.phi{'.T' * transposed}", forward, vjp, jvp)


def _diagonalised(op, name):
    """(Spectrum, eigenvalues) of an operator that is separable, or a function of such a one."""
    structure = op.structure
    if isinstance(structure, SpectralFunction) and not structure.transposed:
        return structure.found, structure.weights
    found = spectrum(structure) if op.separable else None
    if found is None:
        raise ValueError(f"{name} needs a separable operator that can be diagonalised, got {op}; try imex or tr_bdf2")
    return found, found.eigenvalues


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


class Exponential(Scheme):
    """Exponential time differencing, Runge-Kutta of order 4."""

    dyadic = True

    def __init__(self, problem):
        super().__init__(problem, "etdrk4", 4)
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
