"""The linear solve of implicit steps: x of (1 - z L) x = b, differentiable in z and b.

With S = (1 - z L)^-1 and x = S b,

    dx = S (db + dz L x),          so with y = S^T g:   b_bar = y,   z_bar = y . L x.

The transposed solve is a rule of the same form with L^T: derivatives of every order follow. One set-up
serves all stages, steps and adjoint solves of one z. For z = 0, x is b, and nothing is set up or solved.

What L leaves as it is (the mean, where nothing flows through the walls) is split off before the solve and added
after it: 1 - z L has the eigenvalue 1 there beside those of size z |L|, and would lose it to rounding.
"""

from functools import cached_property

import autograd.numpy as anp
import numpy as np

from sparsedp.ledger import active as recordings
from sparsedp.ledger import tell
from sparsedp.operators.boundary import identity
from sparsedp.solvers.cache import Cache
from sparsedp.solvers.choose import build
from sparsedp.solvers.solve import SolveLog
from sparsedp.solvers.system import System
from sparsedp.tape import Rule, of_argument

__all__ = ["Resolvent"]


class Resolvent:
    """solve(z, b): x of (1 - z L) x = b.

    Parameters
    ----------
    op : Operator
        L, from a space to itself.
    name : str
        For messages and counts.
    settings : dict
        method, rtol, maxiter, nullspace, options: as in `inverse`.
    most : int
        Number of set-ups that are kept.

    Attributes
    ----------
    info : SolveLog
    """

    def __init__(self, op, name, settings, most=2):
        self.op, self.name, self.settings = op, name, settings
        self.info, self._kept = SolveLog(), Cache(most)
        self._checked, self._free = self._rule(False, True), self._rule(False, False)
        self._adjoint = self._rule(True, False)

    def __call__(self, z, b):
        """Solve; z >= 0 a number, b a field on the domain of L."""
        return self._checked(z, b)

    def plain(self, z, b, transposed=False):
        """The same on plain values, or with the transpose."""
        return self._solved(z, b, transposed, not transposed)

    def _solved(self, z, b, transposed, checked):
        if z == 0:
            if recordings:
                tell(self._checked.name, "skipped", "dt or coefficient 0, no solve and no set-up")
            return np.array(b, dtype=np.result_type(b, np.float32))  # whole numbers become floating ones
        inv = self.inverse(float(z))
        inv = inv.T if transposed else inv if checked else inv.tangent
        if self._kernel is None:
            return inv.apply(b)
        b = np.asarray(b)
        wide = b.astype(np.result_type(b, np.float64), copy=False)
        moving = self._projected(wide, transposed)
        x = self._projected(inv.apply(moving), transposed) + (wide - moving)
        return x.astype(np.result_type(b, np.float32), copy=False)

    def _projected(self, b, transposed):
        """b without what L leaves as it is, field by field of a batch."""
        fields = np.ascontiguousarray(b).reshape(-1, self.op.shape[0])
        return np.array([self._kernel.project(field, transposed) for field in fields]).reshape(b.shape)

    @cached_property
    def _kernel(self):
        """The null space of L where L is symmetric up to weights, None where there is none."""
        system = System(self.op, self.settings["rtol"], None)
        if not self.op.structure.has_entries or system.complex or system.weights is None:
            return None
        return system.null_space if system.null_space is not None and system.null_space.count else None

    def _rule(self, transposed, checked):
        """The solve (or the transposed solve) as a rule in (z, b)."""

        def vjp(nums, ans, z, b):
            def pull(g):
                other = (self._free if transposed else self._adjoint)(z, g)
                x, y = (other, ans) if transposed else (ans, other)
                slopes = {0: lambda: anp.sum(y * self.op(x)), 1: lambda: other}
                return tuple(of_argument(slopes[num](), (z, b)[num]) for num in nums)

            return pull

        def jvp(nums, tangents, ans, z, b):
            op = self.op.T if transposed else self.op
            change = {0: lambda t: t * op(ans), 1: lambda t: t}
            total = sum(change[num](t) for num, t in zip(nums, tangents, strict=True))
            return (self._adjoint if transposed else self._free)(z, total)

        def forward(z, b):
            return self._solved(z, b, transposed, checked)

        return Rule(f"{self.name}.solve.T" if transposed else f"{self.name}.solve", forward, vjp, jvp)

    def inverse(self, z):
        """The inverse of 1 - z L: kept or set up."""
        known = self._kept.find((z,))
        if known is not None:
            return known
        op = identity(self.op.domain) - z * self.op
        return self._kept.put((z,), build(op, name=self.name, log=self.info, **self.settings))

    def __str__(self):
        last = self._kept.last
        return (
            "no set-up yet" if last is None else f"{len(self._kept)} of {self._kept.most} set-ups kept, last:\n{last}"
        )
