"""A trust-region method with barrier functions (trust-constr), by SciPy."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sparsedp._utils.validation import check_number
from sparsedp.optimize.constrained_run import ConstrainedMethod

if TYPE_CHECKING:
    from sparsedp.optimize.constrained_problem import ConstrainedProblem
    from sparsedp.optimize.constrained_run import ConstrainedRun

__all__ = ["TrustConstr"]

INSIDE = 1e-2  # distance of the start from the bounds, as a fraction of their distance or of the unit of x
LEAST_RADIUS = 1e-14  # SciPy stops at this radius
LEAST_BARRIER = 1e-12  # SciPy stops at this barrier parameter
# SciPy's warnings for functions that are linear along a step, and for constraints that depend on each other.
EXPECTED_WARNINGS = "delta_grad == 0.0|Singular Jacobian matrix"
UNLIMITED = 2**31 - 1  # number of iterations in SciPy, which are counted by `minimize`


@dataclass
class TrustConstr(ConstrainedMethod):
    """The trust-region interior-point method of SciPy (trust-constr).

    Parameters
    ----------
    radius : float
        Initial trust radius, in units of x.
    barrier : float
        Initial barrier parameter of inequalities and bounds.

    Notes
    -----
    Equalities are handled by the Byrd-Omojokun trust-region method, inequalities and bounds by a barrier function. The
    Hessian is a dense BFGS approximation. The method suits up to about 1000 unknowns. A start at a bound is moved
    inside. The multipliers are a least-squares estimate.

    References
    ----------
    R. H. Byrd, M. E. Hribar, J. Nocedal, An interior point algorithm for large-scale nonlinear programming, SIAM J.
    Optim. 9, 1999; M. Lalee, J. Nocedal, T. Plantenga, On the implementation of an algorithm for large-scale equality
    constrained optimization, SIAM J. Optim. 8, 1998.
    """

    name: ClassVar[str] = "trust_constr"
    radius: float = 1.0
    barrier: float = 0.1

    def __post_init__(self) -> None:
        check_number("radius of trust_constr", self.radius, "> 0", "; the default is 1")
        check_number("barrier of trust_constr", self.barrier, "> 0", "; the default is 0.1")

    def run(self, problem: ConstrainedProblem, run: ConstrainedRun, state: Any, save: Any) -> str:
        """Iterate until SciPy ends; see `ConstrainedMethod`."""
        from scipy.optimize import BFGS, Bounds, NonlinearConstraint, minimize

        whole_start = problem.start.z
        lower, upper = problem.limits
        moving = lower < upper  # a barrier needs an interior
        if not moving.any():
            return "the bounds allow one point only"
        equalities = int(np.count_nonzero(problem.equality))
        if equalities > np.count_nonzero(moving):
            return (
                f"there are more equalities ({equalities}) than unknowns ({np.count_nonzero(moving)}); write "
                "method='augmented_lagrangian'"
            )
        start = whole_start[moving]
        lower = lower[moving]
        upper = upper[moving]

        def functions(z):
            whole = whole_start.copy()
            whole[moving] = z
            return problem.functions(whole)

        constraints = []
        if problem.start.rows.size:
            constraints.append(
                NonlinearConstraint(
                    lambda z: functions(z).rows,
                    problem.least_rows,
                    np.zeros(problem.equality.size),
                    jac=lambda z: functions(z).jacobian[:, moving],
                    hess=BFGS(),
                )
            )
        bounds = None
        if problem.box.bounded:
            bounds = Bounds(lower, upper, keep_feasible=True)
            start = _inside(start, lower, upper)

        def callback(z, state):
            if state.nit > 0:
                run.record(functions(z).usable)

        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=EXPECTED_WARNINGS)
            result = minimize(
                lambda z: functions(z).value,
                start,
                method="trust-constr",
                jac=lambda z: functions(z).gradient[moving],
                hess=BFGS(),
                bounds=bounds,
                constraints=constraints,
                callback=callback,
                options={
                    "gtol": 0.0,
                    "xtol": LEAST_RADIUS,
                    "barrier_tol": LEAST_BARRIER,
                    "maxiter": UNLIMITED,
                    "initial_tr_radius": self.radius,
                    "initial_barrier_parameter": self.barrier,
                    "initial_barrier_tolerance": self.barrier,
                },
            )
        return f"SciPy's trust-constr ended ({result.message})"


def _inside(start, lower, upper):
    """Return the start, moved away from the bounds."""
    distance = INSIDE * np.minimum(1.0, upper - lower)
    return np.clip(start, lower + distance, upper - distance)
