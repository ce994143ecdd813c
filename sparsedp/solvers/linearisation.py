"""The Jacobian of a residual at one point, as Newton's method and the derivative rules use it."""

from functools import cached_property

import numpy as np

from sparsedp.errors import ConvergenceError
from sparsedp.ledger import thread
from sparsedp.solvers.contract import norm
from sparsedp.solvers.record import failure

__all__ = ["Linearisation"]


class Linearisation:
    """J at one point, and its inverse.

    Parameters
    ----------
    op : Operator, or a function that makes it
        Where `small` serves, it is not made until somebody asks.
    setup : callable
        ``setup(op)``: its Inverse.
    point : (equation, x, leaves)
        Plain copies.
    checked : bool
        Whether J is known to be the derivative of the residual.
    rtol : float
        Tolerance of `solve`.
    small : Small or None
        Its dense factors. While calls are counted the general path runs, which everything counts and observes.
    """

    def __init__(self, op, setup, point, checked, rtol, small=None):
        self._op, self._setup = op, setup
        self.point, self.checked, self.rtol = point, checked, rtol
        self._small = small if small is not None and small.sound else None
        if self.small is None:
            self.inv  # noqa: B018  a set-up that fails must fail here

    @property
    def small(self):
        """The dense factors, when they serve."""
        return None if thread.calls else self._small

    @cached_property
    def op(self):
        """J as an Operator."""
        return self._op() if not hasattr(self._op, "structure") else self._op

    @cached_property
    def inv(self):
        """Its Inverse."""
        return self._setup(self.op)

    @property
    def told(self):
        """(seconds of the set-up, what was set up)."""
        if self.small is not None:
            return self.small.seconds, str(self.small)
        return self.inv.info.setup_seconds, self.inv.info.hierarchy

    def terms(self, x):
        """|J| |x|: how large the terms of J x are; of dense factors entry by entry."""
        return self.norm * norm(x) if self._small is None else self._small.terms(x)

    def step(self, F, forcing):
        """The Newton step -J^-1 F, up to the relative residual `forcing`. Never refused: the next residual judges."""
        found = None if self.small is None else self.small.solve(-F, forcing)
        if found is not None:
            return found[0]
        solver = self.inv.solver
        return solver.approximate(-F, max(forcing, solver.system.rtol))

    def solve(self, b, transposed):
        """(J^-1 b or J^-T b to the full tolerance, its record). Refused when the root is not isolated."""
        found = None if self.small is None else self.small.solve(b, self.rtol, transposed)
        if found is not None:
            return found
        solver = self.inv.solver
        if self.singular and solver.nullspace == "raise":
            raise ConvergenceError(
                f"the Jacobian {self.op} is singular at the solution: the root is not isolated and has no "
                "derivative; add an equation that fixes it or write nullspace='project'",
                info=failure("setup_failed"),
            )
        x = solver.solve(b, transposed, checked=False)
        return x, self.inv.info.adjoint if transposed else self.inv.info.forward

    @property
    def singular(self):
        """Whether a null space of J, or an unknown that no equation uses, is known."""
        if self.small is not None:
            return False
        system = self.inv.solver.system
        return system.active is not None or system.null_space.count > 0

    def product(self, x):
        """J x."""
        return self.op._flat.apply(x) if self.small is None else self.small.product(x)

    @property
    def norm(self):
        """|J|_inf, or an upper bound."""
        if self.small is not None:
            return self.small.norm
        system = self.inv.solver.system
        return float(np.ldexp(system.norm(False), system.exponent))

    def defect(self):
        """How far J is from the derivative of the residual along a random direction: (largest, its row)."""
        equation, x, leaves = self.point
        rng = np.random.default_rng(0)
        v = rng.uniform(0.5, 1.5, x.size) * rng.choice([-1.0, 1.0], x.size)
        with np.errstate(all="ignore"):
            wanted = equation.tangent(x, leaves)(v)
        size = np.maximum(self.op.structure.magnitude()(np.abs(v)), np.abs(wanted))
        size += 1e-8 * np.max(size, initial=0.0)  # rounding of large rows is no difference in small ones
        share = np.abs(self.product(v) - wanted) / np.where(size > 0, size, 1.0)
        row = int(np.argmax(share)) if share.size else 0
        return (float(share[row]) if share.size else 0.0), row
