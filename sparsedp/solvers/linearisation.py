"""The Jacobian of a residual at one point, as Newton's method and the derivative rules use it."""

from copy import copy

import numpy as np

from sparsedp.errors import ConvergenceError
from sparsedp.solvers import facts
from sparsedp.solvers.record import failure

__all__ = ["Linearisation"]


class Linearisation:
    """J at one point, and its inverse.

    Parameters
    ----------
    op : Operator
    inv : Inverse of `op`
    point : (equation, x, leaves)
        Plain copies.
    checked : bool
        Whether J is known to be the derivative of the residual.
    """

    def __init__(self, op, inv, point, checked):
        self.op, self.inv, self.point, self.checked = op, inv, point, checked

    def step(self, F, forcing):
        """The Newton step -J^-1 F, up to the relative residual `forcing`. Never refused: the next residual judges."""
        solver = copy(self.inv.solver)
        solver.system = copy(solver.system)
        solver.system.rtol = max(forcing, solver.system.rtol)
        solver.observed, self.inv.solver.served = False, True  # what it leaves, the next step takes away
        try:
            return solver.solve(-F, checked=False)
        except ConvergenceError as error:
            if error.best is None:
                raise
            return error.best.reshape(-1)  # a step that is not exact may still lead downhill

    def solve(self, b, transposed):
        """J^-1 b or J^-T b, to the full tolerance. Refused when the root is not isolated."""
        solver = self.inv.solver
        if self.singular and solver.nullspace == "raise":
            raise ConvergenceError(
                f"the Jacobian {self.op} is singular at the solution: the root is not isolated and has no "
                "derivative; add an equation that fixes it or write nullspace='project'",
                info=failure("setup_failed"),
            )
        return solver.solve(b, transposed, checked=False)

    @property
    def singular(self):
        """Whether a null space of J, or an unknown that no equation uses, is known."""
        system = self.inv.solver.system
        return system.active is not None or system.null_space.count > 0

    def product(self, x):
        """J x."""
        return self.op._flat.apply(x)

    @property
    def norm(self):
        """|J|_inf, or an upper bound."""
        system = self.inv.solver.system
        return float(np.ldexp(system.norm(False), system.exponent))

    def defect(self):
        """How far J is from the derivative of the residual along a random direction: (largest, its row)."""
        equation, x, leaves = self.point
        rng = np.random.default_rng(0)
        v = rng.uniform(0.5, 1.5, x.size) * rng.choice([-1.0, 1.0], x.size)
        with np.errstate(all="ignore"):
            wanted = equation.tangent(x, leaves)(v)
        size = np.maximum(facts.magnitude(self.op.structure)(np.abs(v)), np.abs(wanted))
        size += 1e-8 * np.max(size, initial=0.0)  # rounding of large rows is no difference in small ones
        share = np.abs(self.product(v) - wanted) / np.where(size > 0, size, 1.0)
        row = int(np.argmax(share)) if share.size else 0
        return (float(share[row]) if share.size else 0.0), row
