"""Sequential quadratic programming (SLSQP), by SciPy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from sparsedp.optimize.constrained_run import ConstrainedMethod

if TYPE_CHECKING:
    from sparsedp.optimize.constrained_problem import ConstrainedProblem
    from sparsedp.optimize.constrained_run import ConstrainedRun

__all__ = ["SLSQP"]

ACCURACY = 1e-30  # SciPy's own test of convergence, which is replaced by that of `minimize`
DEPENDENT = "Singular matrix C", "More equality constraints than"  # in SciPy's messages about dependent equalities
UNLIMITED = 2**31 - 1  # number of iterations in SciPy, which are counted by `minimize`


@dataclass
class SLSQP(ConstrainedMethod):
    """Sequential least-squares quadratic programming, by SciPy.

    Notes
    -----
    Each iteration minimizes a quadratic model of the Lagrangian under the linearized constraints, and searches along
    the step. The model is a dense BFGS matrix: for n unknowns it takes n^2 numbers, and an iteration of the order of
    n^3 operations. The method suits up to about 1000 unknowns. The multipliers are a least-squares estimate.

    References
    ----------
    D. Kraft, A software package for sequential quadratic programming, DFVLR-FB 88-28, 1988; J. Nocedal, S. J. Wright,
    Numerical Optimization, Springer, 2006, chapter 18.
    """

    name: ClassVar[str] = "slsqp"

    def run(self, problem: ConstrainedProblem, run: ConstrainedRun, state: Any, save: Any) -> str:
        """Iterate until SciPy ends; see `ConstrainedMethod`."""
        from scipy.optimize import Bounds, minimize

        constraints = []
        for kind, rows, sign in (("eq", problem.equality, 1.0), ("ineq", ~problem.equality, -1.0)):
            if not rows.any():
                continue
            constraints.append(
                {
                    "type": kind,
                    "fun": lambda z, rows=rows, sign=sign: sign * problem.functions(z).rows[rows],
                    "jac": lambda z, rows=rows, sign=sign: sign * problem.functions(z).jacobian[rows],
                }
            )
        result = minimize(
            lambda z: problem.functions(z).value,
            problem.start.z,
            method="SLSQP",
            jac=lambda z: problem.functions(z).gradient,
            bounds=Bounds(*problem.limits),
            constraints=constraints,
            callback=lambda z: run.record(problem.functions(z).usable),
            options={"ftol": ACCURACY, "maxiter": UNLIMITED},
        )
        reason = f"SciPy's SLSQP ended ({result.message})"
        if any(cause in result.message for cause in DEPENDENT):
            reason += "; for equalities that depend on each other write method='augmented_lagrangian'"
        return reason
