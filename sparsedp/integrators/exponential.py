"""Functions of z L for a separable operator L, differentiable in z, and the exponential step etdrk4.

The derivative f' of such a function f is of the same kind, and with y = f(z L) b

    dy = f(z L) db + L f'(z L) b dz,     b_bar = f(z L)^T g,     z_bar = g . L f'(z L) b.

So one rule is enough for all functions. They are linear combinations of the functions phi_k, and are applied by one
transform and its inverse:

    phi_0(x) = exp(x),    phi_{k+1}(x) = (phi_k(x) - 1/k!) / x,    phi_k'(x) = phi_k(x) - k phi_{k+1}(x)

Near 0 the recurrence loses all digits. For x >= -3 the phi_k are therefore computed as Kummer's functions,
phi_k(x) = 1F1(1; k + 1; x) / k!, which SciPy provides for all k.

etdrk4 (exponential time differencing) is built from functions of z L. It has order 4 and is exact if the rate N is
constant and the source s a polynomial in time of degree 3. The source contributes to every stage the integral of
exp((h - x) c L) s(t + x), with s interpolated at four points.

References
----------
S. M. Cox, P. C. Matthews, J. Comput. Phys. 176 (2002), formulas 26 to 29; A.-K. Kassam, L. N. Trefethen, SIAM J. Sci.
Comput. 26 (2005), on the cancellation near 0; M. Hochbruck, A. Ostermann, Acta Numerica 19 (2010), section 2.2,
exponential quadrature.
"""

from __future__ import annotations

from functools import lru_cache, reduce
from math import factorial
from operator import add, matmul
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.polynomial import Polynomial as Line
from scipy.special import hyp1f1

from sparsedp._utils.pytree import mapped
from sparsedp._utils.validation import check_finite
from sparsedp.autodiff.backend import require_arrays
from sparsedp.grid.space import Space
from sparsedp.integrators.problem import combine, time_after
from sparsedp.integrators.runge_kutta import Scheme, family
from sparsedp.operators.masks_and_lift import identity
from sparsedp.operators.operator import Operator
from sparsedp.solvers.separable import Eigenbasis, SpectralFunction, require_eigenbasis

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from sparsedp.autodiff.tape import Rule
    from sparsedp.integrators.problem import Problem

__all__ = ["Exponential", "Function", "PhiFunctions", "phi"]

NEAR = 3.0  # largest -x for which Kummer's function is used
LARGEST = 1e3  # x is limited to this value, above which the exponential overflows
KEPT = 64  # number of cached operators f(z L)


def phi(k: int, x: Any) -> list[np.ndarray]:
    """Return phi_0(x), ..., phi_k(x) for real x, with errors of a few units in the last digit.

    Examples
    --------
    >>> [round(float(value), 6) for value in phi(2, np.array(-1e-9))]
    [1.0, 1.0, 0.5]
    """
    is_far = x < -NEAR
    near = np.clip(x, -NEAR, LARGEST)
    with np.errstate(all="ignore"):
        values = [np.exp(x)]
        for j in range(k):
            kummer = hyp1f1(1, j + 2, near) / factorial(j + 1)
            values.append(np.where(is_far, (values[j] - 1 / factorial(j)) / x, kummer))
    return values


class Function(NamedTuple):
    """The function L^power f(z L) with f(x) = sum over k of weights[k] phi_k(scale x)."""

    weights: tuple
    scale: float = 1.0
    power: int = 0

    def derivative(self) -> Function:
        """Return the derivative with respect to z, as a Function."""
        weights = [*self.weights, 0.0]
        for k, weight in enumerate(self.weights):
            weights[k + 1] -= k * weight
        return Function(tuple(self.scale * weight for weight in weights), self.scale, self.power + 1)

    @property
    def start(self) -> float:
        """Return f(0)."""
        return sum(a / factorial(k) for k, a in enumerate(self.weights))

    def values(self, z: float, eigenvalues: np.ndarray) -> np.ndarray:
        """Return the values of the function at the eigenvalues of L."""
        with np.errstate(over="ignore", invalid="ignore"):
            phis = phi(len(self.weights) - 1, self.scale * z * eigenvalues)
            pairs = zip(self.weights, phis, strict=True)
            return eigenvalues**self.power * sum(weight * value for weight, value in pairs if weight)


class PhiFunctions:
    """Functions f(z L) b of a separable operator L, differentiable in z and b, to every order.

    Parameters
    ----------
    op : Operator
        L, a separable operator or composed of separable operators.
    name : str
        Name in error messages and counts.

    Raises
    ------
    ValueError
        If L cannot be diagonalised by transforms.
    """

    def __init__(self, op: Operator, name: str) -> None:
        self.op = op
        self.name = name
        self.space = Space(op.domain.shape, op.domain.kind)  # not distributed
        self.spectrum, self.eigenvalues = require_eigenbasis(op, name, "; try imex or tr_bdf2")
        self._rule = lru_cache(None)(self._make_rule)  # one for every z, step and adjoint
        self._operator = lru_cache(KEPT)(self._set_up)  # for a few z

    def __call__(self, function: Function, z: Any, b: Any) -> Any:
        """Return f(z L) b."""
        return self._rule(function, False)(z, b)

    def _make_rule(self, function: Function, is_transposed: bool) -> Rule:
        """Return the rule of (z, b) for f(z L) b or, if `is_transposed`, for f(z L)^T b."""

        def forward(z: Any, b: Any) -> Any:
            require_arrays(self.name, [b])
            op = self._operator(function, float(z))
            return (op.T if is_transposed else op).apply(b)

        def slope() -> Rule:
            return self._rule(function.derivative(), is_transposed)

        def transposed() -> Rule:
            return self._rule(function, not is_transposed)

        if is_transposed:
            name = f"{self.name}.T"
        else:
            name = self.name
        return family(name, forward, slope, transposed)

    def _set_up(self, function: Function, z: float) -> Operator:
        """Return the Operator f(z L) for a plain z. For z = 0 no transforms are used, so that exp(z L) b equals b."""
        if z == 0:
            product = reduce(matmul, [self.op] * function.power, identity(self.op.domain))
            return self._named((function.start * product).structure)
        values = function.values(z, self.eigenvalues)
        check_finite(
            f"{self.name}: exp({z:g} * {self.op.name})", values, advice="; take a smaller dt or the other sign"
        )
        return self._named(SpectralFunction(Eigenbasis(self.spectrum, values), self.op.shape))

    def _named(self, structure: Any) -> Operator:
        return Operator(structure, self.space, self.space, self.name)


# ---- the step of order 4 ---------------------------------------------------------------------------------------------

WHOLE = Function((1.0,))
HALF = Function((1.0,), 0.5)
MEAN = Function((0.0, 0.5), 0.5)
BEGIN = Function((0.0, 1.0, -3.0, 4.0))
MIDDLE = Function((0.0, 0.0, 2.0, -4.0))
END = Function((0.0, 0.0, -1.0, 4.0))
NODES = (0.0, 0.5 - 0.1 * 5**0.5, 0.5 + 0.1 * 5**0.5, 1.0)  # Lobatto nodes, as fractions of a step


def quadrature(nodes: Sequence[float], start: float, stop: float) -> tuple[Function, ...]:
    """Return the weights of s(t + node h) in h times the integral of exp((stop - x) z L) s(t + x h), start < x < stop.

    They are computed from the Lagrange polynomials of the nodes; for s(t + x h) = x^k the integral from 0 to 1 is
    k! phi_{k+1}(z L).
    """
    functions = []
    for values in np.eye(len(nodes)):
        line = Line.fit(nodes, values, len(nodes) - 1, domain=(start, stop), window=(0.0, 1.0))
        coefficients: Any = line.coef
        weights = [float((stop - start) * factorial(k) * a) for k, a in enumerate(coefficients)]
        functions.append(Function((0.0, *weights), stop - start))
    return tuple(functions)


class Exponential(Scheme):
    """Exponential time differencing, Runge-Kutta of order 4."""

    dyadic = True

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem, "etdrk4", 4)
        self.functions: dict[Operator | None, Callable] = {None: _without_operator}
        for op in problem.operators:
            self.functions[op] = PhiFunctions(op, "stepper(etdrk4)")
        self.nodes: tuple = ()
        if problem.source is not None:
            if problem.source_takes_time:
                self.nodes = NODES
            else:
                self.nodes = NODES[:1]
        self.parts = [quadrature(self.nodes, *ends) for ends in ((0.0, 1.0), (0.0, 0.5), (0.5, 1.0))]

    def __call__(self, u: Any, params: Any, t: Any, h: Any) -> Any:
        """Return the state after a step."""

        def f(functions: Sequence[Function], *trees: Any) -> Any:
            """Return the sum of function(h c L) applied to the corresponding tree."""

            def of_field(op: Operator | None, z: Any, *row: Any) -> Any:
                pairs = zip(functions, row, strict=True)
                return reduce(add, [self.functions[op](function, z, leaf) for function, leaf in pairs])

            return self.problem.on_fields(of_field, h, params, *trees)

        def scaled(rate: Any) -> Any:
            return mapped(lambda leaf: leaf if leaf is None else h * leaf, rate)

        def n(v: Any, share: float) -> Any:
            return scaled(self.problem.rate_value(v, params, time_after(t, share * h)))

        s = [scaled(self.problem.source_value(params, time_after(t, node * h))) for node in self.nodes]
        whole, first, second = self.parts
        if self.problem.rate is None:
            return f((WHOLE, *whole), u, *s)
        n0 = n(u, 0.0)
        half = f((HALF, *first), u, *s)
        a = combine(half, (1.0, f((MEAN,), n0)))
        n1 = n(a, 0.5)
        n2 = n(combine(half, (1.0, f((MEAN,), n1))), 0.5)
        n3 = n(f((HALF, MEAN, *second), a, combine(n2, (1.0, n2), (-1.0, n0)), *s), 1.0)
        return f((WHOLE, BEGIN, MIDDLE, END, *whole), u, n0, combine(n1, (1.0, n2)), n3, *s)


def _without_operator(function: Function, z: Any, b: Any) -> Any:
    """Return f(0) b, for a field without an operator."""
    return function.start * b
