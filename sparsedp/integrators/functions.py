"""Functions of z L for a separable operator L, differentiable in z: one rule for all of them.

Such a function f has a derivative f' of the same kind, and with y = f(z L) b

    dy = f(z L) db + L f'(z L) b dz,     b_bar = f(z L)^T g,     z_bar = g . L f'(z L) b.

They are sums of phi_k, by one transform and one back:

    phi_0(x) = exp(x),    phi_{k+1}(x) = (phi_k(x) - 1/k!) / x,    phi_k'(x) = phi_k(x) - k phi_{k+1}(x)

Near 0 the formula in the middle loses all digits: from x = -3 on they are taken as Kummer's functions,
phi_k(x) = 1F1(1; k + 1; x) / k!, of which SciPy knows all.
Sources: Cox and Matthews, J. Comput. Phys. 176 (2002); Kassam and Trefethen, SIAM J. Sci. Comput. 26 (2005), who name
the trouble.
"""

from functools import lru_cache, reduce
from math import factorial
from operator import matmul
from typing import NamedTuple

import autograd.numpy as anp
import numpy as np
from scipy.special import hyp1f1

from sparsedp.derivative import of_argument
from sparsedp.errors import NonFiniteError
from sparsedp.operator import Operator
from sparsedp.operators.masks_and_lift import identity
from sparsedp.shortcuts import refuse_elsewhere
from sparsedp.solvers.separable import SpectralFunction, diagonalised
from sparsedp.space import Space
from sparsedp.tape import Rule

__all__ = ["Function", "PhiFunctions", "phi"]

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
        self.spectrum, self.eigenvalues = diagonalised(op, name, "; try imex or tr_bdf2")
        self._rule = lru_cache(None)(self._made)  # rules made once, for every z, step and adjoint
        self._operator = lru_cache(KEPT)(self._set_up)  # of a few z

    def __call__(self, function, z, b):
        return self._rule(function, False)(z, b)

    def _made(self, function, transposed):
        """f(z L) b, or f(z L^T) b, as a rule in (z, b)."""

        def forward(z, b):
            refuse_elsewhere(self.name, [b])
            op = self._operator(function, float(z))
            return (op.T if transposed else op).apply(b)

        def change(num, by, z, b):
            """What a change of z or b makes."""
            return (
                self._rule(function, transposed)(z, by)
                if num
                else by * self._rule(function.derivative(), transposed)(z, b)
            )

        def vjp(nums, ans, z, b):
            def pull(g):
                turned = self._rule(function, not transposed)
                backs = (turned(z, g) if num else anp.sum(change(0, g, z, b)) for num in nums)
                return tuple(of_argument(back, (z, b)[num]) for num, back in zip(nums, backs, strict=True))

            return pull

        def jvp(nums, tangents, ans, z, b):
            return sum(change(num, tangent, z, b) for num, tangent in zip(nums, tangents, strict=True))

        return Rule(f"{self.name}{'.T' * transposed}", forward, vjp, jvp)

    def _set_up(self, function, z):
        """The Operator f(z L), of plain z; for z = 0 without transforms: then exp(z L) keeps every bit."""
        if z == 0:
            product = reduce(matmul, [self.op] * function.power, identity(self.op.domain))
            return self._named((function.start * product).structure)
        values = function.values(z, self.eigenvalues)
        if not np.all(np.isfinite(values)):
            raise NonFiniteError(
                f"{self.name}: exp({z:g} * {self.op.name}) is beyond 1.8e308; take a smaller dt or the other sign"
            )
        return self._named(SpectralFunction(self.spectrum, values))

    def _named(self, structure):
        return Operator(structure, self.space, self.space, self.name)
