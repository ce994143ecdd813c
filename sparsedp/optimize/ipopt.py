"""The interior-point method Ipopt, by cyipopt. Only this module imports cyipopt."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sparsedp.optimize.constrained_run import ConstrainedMethod

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.optimize.constrained_problem import ConstrainedProblem
    from sparsedp.optimize.constrained_run import ConstrainedRun

__all__ = ["Ipopt"]

# Options of Ipopt. `minimize` tests convergence and counts iterations, and the problem is given in units of size 1.
SETTINGS = {
    "hessian_approximation": "limited-memory",
    "print_level": 0,
    "sb": "yes",
    "tol": 1e-14,
    "acceptable_iter": 0,
    "max_iter": 2**31 - 1,
    "nlp_scaling_method": "none",
}


class IpoptCallbacks:
    """The functions that cyipopt calls: the problem in units of size 1.

    Parameters
    ----------
    problem : ConstrainedProblem
    run : ConstrainedRun

    Attributes
    ----------
    error : BaseException or None
        The first exception of a function, which is raised after Ipopt has returned.
    """

    def __init__(self, problem: ConstrainedProblem, run: ConstrainedRun):
        self._problem = problem
        self._run = run
        self._iterate: Any = problem.start.z
        self.error: BaseException | None = None

    def objective(self, z: NDArray[np.float64]) -> float:
        """Return the loss."""
        return self._functions(z).value

    def gradient(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradient of the loss. Ipopt asks for it at accepted points only."""
        self._iterate = np.array(z)
        return self._functions(z).gradient

    def constraints(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the rows of the constraints."""
        return self._functions(z).rows

    def jacobian(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the dense Jacobian of the rows, row by row."""
        return self._functions(z).jacobian.ravel()

    def intermediate(self, mode: int, iteration: int, *figures: float) -> bool:
        """Record an iterate; return False if the run ends."""
        if self.error is None and iteration > 0:
            try:
                self._run.record(self._problem.functions(self._iterate).usable)
            except BaseException as error:
                self.error = error
        return self.error is None

    def _functions(self, z):
        """Return the functions at z; after an error, those of the start, until Ipopt calls `intermediate`."""
        if self.error is None:
            try:
                return self._problem.functions(z)
            except BaseException as error:
                self.error = error
        return self._problem.functions(self._problem.start.z)


@dataclass
class Ipopt(ConstrainedMethod):
    """The interior-point method Ipopt, by cyipopt, with limited-memory approximations of the Hessian.

    Parameters
    ----------
    settings : dict, optional
        Options of Ipopt by name, such as ``{"linear_solver": "ma57"}``.

    Notes
    -----
    The Jacobian of the constraints is passed as a dense matrix. The multipliers are a least-squares estimate. Ipopt
    moves a start at a bound inside. The method needs the package cyipopt, which conda-forge provides with Ipopt.

    References
    ----------
    A. Waechter, L. T. Biegler, On the implementation of an interior-point filter line-search algorithm for large-scale
    nonlinear programming, Math. Program. 106, 2006.
    """

    name: ClassVar[str] = "ipopt"
    settings: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        if self.settings is not None and not isinstance(self.settings, Mapping):
            raise TypeError(
                f"settings of ipopt must be a dict of Ipopt's options, got {type(self.settings).__name__}; write "
                "{'linear_solver': 'mumps'}"
            )

    def check_available(self) -> None:
        """Raise ImportError if cyipopt is not installed."""
        _cyipopt()

    def run(self, problem: ConstrainedProblem, run: ConstrainedRun, state: Any, save: Any) -> str:
        """Iterate until Ipopt ends; see `ConstrainedMethod`."""
        cyipopt = _cyipopt()
        callbacks = IpoptCallbacks(problem, run)
        lower, upper = problem.limits
        count = problem.start.rows.size
        ipopt = cyipopt.Problem(
            n=problem.start.z.size,
            m=count,
            problem_obj=callbacks,
            lb=lower,
            ub=upper,
            cl=problem.least_rows,
            cu=np.zeros(count),
        )
        for name, value in {**SETTINGS, **(self.settings or {})}.items():
            ipopt.add_option(name, value)
        _, info = ipopt.solve(problem.start.z)
        if callbacks.error is not None:
            raise callbacks.error
        message = info["status_msg"]
        if isinstance(message, bytes):
            message = message.decode()
        return f"Ipopt ended ({message})"


def _cyipopt():
    """Import cyipopt; raise ImportError that says how to install it."""
    try:
        import cyipopt
    except ImportError as error:
        raise ImportError(
            "the method ipopt needs cyipopt; install it with conda install -c conda-forge cyipopt"
        ) from error
    return cyipopt
