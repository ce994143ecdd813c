"""Functions of z L for a separable operator L, differentiable in z: one rule for all of them.

A sum f of such functions has a derivative f' of the same kind, and with y = f(z L) b

    dy = f(z L) db + L f'(z L) b dz,     b_bar = f(z L)^T g,     z_bar = g . L f'(z L) b.

They are sums of phi_k, by transforms, where L is separable:

    phi_0(x) = exp(x),    phi_{k+1}(x) = (phi_k(x) - 1/k!) / x,    phi_k'(x) = phi_k(x) - k phi_{k+1}(x)

Near 0 the formula in the middle loses all digits: from x = -3 on they are taken as Kummer's functions,
phi_k(x) = 1F1(1; k + 1; x) / k!, of which SciPy knows all.
Sources: Cox and Matthews, J. Comput. Phys. 176 (2002); Kassam and Trefethen, SIAM J. Sci. Comput. 26 (2005), who name
the trouble.
"""

from functools import lru_cache
from math import factorial, prod
from typing import NamedTuple

import autograd.numpy as anp
import numpy as np
from scipy.special import hyp1f1

from sparsedp.derivative import of_argument
from sparsedp.errors import NonFiniteError
from sparsedp.fields import field_array
from sparsedp.shortcuts import refuse_elsewhere
from sparsedp.solvers.separable import diagonalised
from sparsedp.tape import Rule, isbox

__all__ = ["Function", "PhiFunctions", "phi"]

NEAR, LARGEST = 3.0, 1e3  # of x; beyond the second even the exponential is infinite
KEPT = 64  # tables of weights, for a few z


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


class PhiFunctions:
    """combine(functions, z, *fields): the sum of f_j(z L) b_j, differentiable in z and the fields.

    By one transform for each field and one back.

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
        self.op, self.name, self.domain = op, name, op.domain
        self.found, self.eigenvalues = diagonalised(op, name, "; try imex or tr_bdf2")
        self._rule = lru_cache(None)(self._made)  # rules made once, for every z, step and adjoint
        self._table = lru_cache(KEPT)(self._values)  # plain values only, of a few z

    def __call__(self, functions, z, *fields):
        return self._rule(functions, False)(z, *fields)

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
                else:  # all at once
                    backs = iter(self.plain(chosen, z, [g], not transposed))
                found = [next(backs) if num else anp.sum(g * slope(z, fields)) for num in nums]
                return tuple(of_argument(back, (z, *fields)[num]) for num, back in zip(nums, found, strict=True))

            return pull

        def jvp(nums, tangents, ans, z, *fields):
            chosen, moves = [functions[num - 1] for num in nums if num], tangents[nums[0] == 0 :]
            total = tangents[0] * slope(z, fields) if nums[0] == 0 else 0.0
            return total + self._rule(tuple(chosen), transposed)(z, *moves) if chosen else total

        return Rule(f"{self.name}{'.T' * transposed}", forward, vjp, jvp)

    def plain(self, rows, z, fields, transposed=False):
        """[the sum for each row of functions], on plain values, or with the transpose of L."""
        op, z = (self.op.T if transposed else self.op), float(z)
        refuse_elsewhere(self.name, fields)
        fields = [field_array(self, field, batch=True) for field in fields]
        if z == 0:  # no transform, and for phi_0 the field itself, bit for bit
            return [sum(f.at_zero(op, field) for f, field in zip(row, fields, strict=True)) for row in rows]
        if any(map(np.iscomplexobj, fields)):
            parts = (self.plain(rows, z, [*map(part, fields)], transposed) for part in (np.real, np.imag))
            return [real + 1j * imaginary for real, imaginary in zip(*parts, strict=True)]
        shape, lone = fields[0].shape, op.domain.shape
        if shape == lone:
            return [total.reshape(shape) for total in self._sums(rows, z, fields, transposed)]
        count = prod(shape[: len(shape) - len(lone)])  # of a batch
        batches = [field.reshape(count, *lone) for field in fields]
        sums = [self._sums(rows, z, row, transposed) for row in zip(*batches, strict=True)]
        each = np.reshape(sums, (count, len(rows), op.domain.size))
        return [total.reshape(shape) for total in np.moveaxis(each, 1, 0)]

    def _sums(self, rows, z, fields, transposed):
        """The sum for each row of functions, on one field each."""
        moved = [self.found.forward(field.astype(float, copy=False), transposed) for field in fields]
        sums = (sum(c * self._table(f, z) for f, c in zip(row, moved, strict=True)) for row in rows)
        return [self.found.backward(total, transposed) for total in sums]

    def _values(self, function, z):
        """The values of a function on the eigenvalues of z L."""
        values = function.values(z, self.eigenvalues)
        if not np.all(np.isfinite(values)):
            raise NonFiniteError(
                f"{self.name}: exp({z:g} * {self.op.name}) is beyond 1.8e308; take a smaller dt or the other sign"
            )
        return values
