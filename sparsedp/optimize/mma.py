"""The method of moving asymptotes, by NLopt. Only this module imports nlopt (extra `design`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sparsedp._utils.validation import check_choice
from sparsedp.optimize.constrained_run import ConstrainedMethod

if TYPE_CHECKING:
    from sparsedp.optimize.constrained_problem import ConstrainedProblem
    from sparsedp.optimize.constrained_run import ConstrainedRun

__all__ = ["MMA"]

LEAST_STEP = 1e-15  # NLopt stops when a step changes no unknown by more than this fraction
DUAL_EVALUATIONS = 200  # largest number of evaluations of the dual problem, which has no maximum if x is infeasible
RESTART = 0.5  # NLopt is started again if the residual has fallen to this fraction


@dataclass
class MMA(ConstrainedMethod):
    """The method of moving asymptotes (MMA), globally convergent, by NLopt.

    Parameters
    ----------
    model : "mma" or "quadratic"
        The separable convex approximation of the functions: with moving asymptotes (NLopt's LD_MMA), or quadratic
        (LD_CCSAQ).

    Notes
    -----
    In each iteration the loss and the constraints are replaced by convex separable approximations, sums of functions of
    one unknown. The dual of this problem has one unknown for each constraint, and is solved by NLopt. The method suits
    many unknowns with bounds and few constraints. It takes inequalities only. The gradient of each row of the
    constraints takes one backward pass.

    An iteration is an evaluation at a new point, also if the method rejects this point. The multipliers are a
    least-squares estimate from the gradients, because NLopt does not return those of the dual problem.

    References
    ----------
    K. Svanberg, A class of globally convergent optimization methods based on conservative convex separable
    approximations, SIAM J. Optim. 12, 2002; S. G. Johnson, The NLopt nonlinear-optimization package.
    """

    name: ClassVar[str] = "mma"
    takes_equalities: ClassVar[bool] = False
    model: str = "mma"

    def __post_init__(self) -> None:
        check_choice("model of mma", self.model, ("mma", "quadratic"))

    def check_available(self) -> None:
        """Raise ImportError if NLopt is not installed."""
        _nlopt()

    def run(self, problem: ConstrainedProblem, run: ConstrainedRun, state: Any, save: Any) -> str:
        """Iterate until NLopt ends; see `ConstrainedMethod`.

        Rounding errors of the loss make the models of NLopt too conservative in the course of a run. Therefore it is
        started again from the best point as long as this improves the feasibility and the optimality.
        """
        while True:
            before = run.best.residual
            reason = self._run_nlopt(problem, run)
            if not run.best.residual < RESTART * before:
                return reason

    def _run_nlopt(self, problem, run):
        """Run NLopt from the best point, and return why it has ended by itself."""
        nlopt = _nlopt()
        algorithm = nlopt.LD_MMA if self.model == "mma" else nlopt.LD_CCSAQ
        lower, upper = problem.limits
        optimizer = nlopt.opt(algorithm, problem.start.z.size)
        optimizer.set_lower_bounds(lower)
        optimizer.set_upper_bounds(upper)
        optimizer.set_xtol_rel(LEAST_STEP)
        optimizer.set_param("dual_algorithm", nlopt.LD_LBFGS)  # needs a quarter of the time of NLopt's default
        optimizer.set_param("dual_maxeval", DUAL_EVALUATIONS)
        errors: list[BaseException] = []

        def stopping(function: Any) -> Any:
            """Return the function with exceptions stored, because NLopt does not pass them on reliably."""

            def guarded(*arguments):
                try:
                    return function(*arguments)
                except BaseException as error:
                    errors.append(error)
                    raise nlopt.ForcedStop from None

            return guarded

        def loss(z, gradient):
            functions = problem.functions(z)
            if functions.usable is not run.last:
                run.record(functions.usable)
            if gradient.size:
                gradient[:] = functions.gradient
            return functions.value

        def rows(result, z, jacobian):
            functions = problem.functions(z)
            result[:] = functions.rows
            if jacobian.size:
                jacobian[:] = functions.jacobian

        optimizer.set_min_objective(stopping(loss))
        if problem.start.rows.size:
            optimizer.add_inequality_mconstraint(stopping(rows), np.zeros(problem.start.rows.size))
        reason = "NLopt found no step that changes x"
        try:
            optimizer.optimize(run.best.point.z)
        except Exception as error:
            reason = f"NLopt stopped ({type(error).__name__})"
        if errors:
            raise errors[0]
        return reason


def _nlopt():
    """Import nlopt; raise ImportError that names the extra."""
    try:
        import nlopt
    except ImportError as error:
        raise ImportError("the method mma needs nlopt; install sparsedp[design]") from error
    return nlopt
