"""The solve contract: every linear solve, forward or adjoint, runs through `Solver` and follows these rules.

1. Scaling. If the norm of b is so large or so small that its square could overflow or underflow, b is multiplied by a
   power of two, and the solution is scaled back. Other b need no scaling, because every method is homogeneous: a power
   of two would not change a bit of the result.
2. Tolerance. The residual r = b - A x is computed from the solution. A solve has converged if |r| <= rtol |b|, or if
   |r| <= 8 eps (|A| |x| + |b|), the attainable accuracy (status "converged_at_roundoff"). There is no absolute
   tolerance. Callers with a looser tolerance (a Newton step, a correction) use `Solver.approximate`.
3. Transpose. inv.T uses the same set-up: the transposes of the same factors or of the same cycle.
4. Derivatives. A VJP of a solve is one adjoint solve.
5. Null space. If the system is singular, b and x are projected (see nullspace.py). A right-hand side of the user that
   is not in the range raises IncompatibleError unless nullspace="project". Solves for derivatives always project.
6. Failure. A solve that does not meet its tolerance raises ConvergenceError, which holds the best iterate.
7. Record. `inv.info` holds the records of the last forward and of the last adjoint solve.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from time import perf_counter
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.base_classes import Reconstructible
from sparsedp._utils.counters import active, count, thread, timed
from sparsedp._utils.validation import EPS, check_finite, number_beside, place
from sparsedp.autodiff.tape import plain
from sparsedp.errors import ConvergenceError, IncompatibleError, NonFiniteError
from sparsedp.solvers.nullspace import ROUNDING
from sparsedp.solvers.records import SolveInfo, SolveLog
from sparsedp.solvers.scaling import LARGE, SMALL, exponent_of, in_range, norm, shifted

if TYPE_CHECKING:
    from collections.abc import Callable

    from sparsedp.solvers.engine import Engine
    from sparsedp.solvers.system import System

__all__ = ["Run", "Solver"]

COMPATIBLE = 1e-6  # a right-hand side with a relative defect up to this is accepted as being in the range
MOST_OF_DATA = 0.7  # the projection is repeated if it reduces |b| below this fraction: cancellation
LARGEST_AT_ROUNDOFF = 0.1  # a residual above this fraction of |b| is not accepted, however large x is
ADVICE = {"indefinite_operator": "; write method='direct'"}


@dataclass(slots=True)
class Run:
    """A solve in progress: its parameters, and the values for its record.

    Attributes
    ----------
    transposed : bool
    checked : bool
        Whether a right-hand side outside the range of a singular operator is an error.
    rtol : float
    exponent : int or int array
        The solution of the scaled system times 2^exponent is the solution of the original system.
    status, iterations, residual, backward_error, defect
        See SolveInfo.
    start_time : float
    """

    transposed: bool = False
    checked: bool = False
    rtol: float = 0.0
    status: str = ""
    iterations: int = 0
    residual: float = 0.0
    backward_error: float = 0.0
    defect: float = 0.0
    exponent: Any = 0
    start_time: float = field(default_factory=perf_counter)

    def assess(self, residual: float, goal: float, data: float, terms: float, largest: float = np.inf) -> str:
        """Store the relative residual and the backward error of a solution, and return its status.

        Parameters
        ----------
        residual : float
            Norm of the residual.
        goal : float
            A residual is accepted if its norm is at most this value.
        data : float
            Norm of the right-hand side.
        terms : float
            Sum of the norms of all terms of the residual.
        largest : float
            A residual above this value is not accepted as "converged_at_roundoff".

        Returns
        -------
        str
            "converged", "converged_at_roundoff", or "" if the residual is not accepted.
        """
        self.residual = 0.0
        if data:
            self.residual = residual / data
        self.backward_error = residual / (terms or 1.0)
        if residual <= goal:
            return "converged"
        if residual <= ROUNDING * terms and residual <= largest:
            return "converged_at_roundoff"
        return ""

    def info(self) -> SolveInfo:
        """Return the record of this solve."""
        return SolveInfo(
            self.status,
            int(self.iterations),
            float(self.residual),
            float(self.backward_error),
            float(self.defect),
            perf_counter() - self.start_time,
        )


class Solver(Reconstructible):
    """Solve linear systems with one matrix, or with its transpose, to a tolerance.

    Parameters
    ----------
    system : System
        The matrix and its properties.
    engine : Engine
        The solver that is set up for this matrix.
    nullspace : "raise" or "project"
    log : SolveLog
    name : str
    constructor_call : (function, arguments)
        A call that sets up the same inverse again. A pickle holds this call, and no factors or hierarchies.
    reason : str
        Why this method was chosen.
    """

    def __init__(
        self,
        system: System,
        engine: Engine,
        nullspace: str,
        log: SolveLog,
        name: str,
        constructor_call: tuple | None,
        reason: str = "",
    ) -> None:
        self.system = system
        self.engine = engine
        self.nullspace = nullspace
        self.log = log
        self.name = name
        self.constructor_call = (_reconstruct_solver, constructor_call)
        self.reason = reason
        self.reused = not thread.calls  # for the counters: whether the next solve reuses the set-up

    # ------------------------------------------------------------ solves

    def solve(
        self,
        b: np.ndarray,
        transposed: bool = False,
        checked: bool = True,
        start: np.ndarray | None = None,
        rtol: float | None = None,
        observed: bool = True,
    ) -> np.ndarray:
        """Solve A x = b, or A^T x = b. This method calls the solve hook, updates the counters, and records the solve.

        Parameters
        ----------
        b : array, shape (n,)
            float64, or complex128 if the operator is complex.
        transposed : bool
        checked : bool
            Whether b must be in the range of a singular operator. It need not be if `transposed`.
        start : array, shape (n,), optional
            Initial guess.
        rtol : float, optional
            Tolerance of this solve, in place of the tolerance of the system. If given, the solve is not recorded in
            the log.
        observed : bool
            Whether to call the solve hook, if there is one. A hook that calls this method sets it to False.

        Returns
        -------
        array, shape (n,)
            A new array.

        Raises
        ------
        ConvergenceError, IncompatibleError, NonFiniteError
        """
        if observed and thread.solve_hooks:
            return thread.solve_hooks[-1].linear(self, b, transposed, checked, start)
        run = Run(transposed, checked and not transposed, rtol or self.system.rtol)
        thread.solves += 1
        if active:
            count(self.name, "reused", self.reused)
        self.reused = True
        try:
            if active:
                return timed(self.name, "adjoint" if transposed else "solve", self._solve, b, run, start)
            return self._solve(b, run, start)
        finally:
            if rtol is None and transposed:
                self.log.adjoint = run.info()
            elif rtol is None:
                self.log.forward = run.info()
            if active:
                count(self.name, "iterations", run.iterations)
                count(self.name, "skipped", run.status == "exact_zero_rhs")

    def approximate(self, b: np.ndarray, rtol: float, transposed: bool = False) -> np.ndarray:
        """Solve to the relative residual `rtol`; if that fails, return the best iterate, which the caller must test."""
        try:
            return self.solve(b, transposed, checked=False, rtol=rtol, observed=False)
        except ConvergenceError as error:
            if error.best is None:
                raise
            return self.system.flat(error.best)

    def _solve(self, b: np.ndarray, run: Run, start: np.ndarray | None) -> np.ndarray:
        """Do one solve: scale, project, solve and refine, test the residual, and scale back."""
        system = self.system

        # Scale b, so that its norm is far from overflow and underflow.
        size = system.size_of(b)
        exponent = 0
        if not SMALL < size < LARGE:
            exponent = self._exponent(b, run)
            if run.status == "exact_zero_rhs":
                return np.zeros_like(b)
            b = shifted(b, -exponent)
            size = system.size_of(b)
        exponent -= system.exponent
        run.exponent = exponent
        if start is not None:
            start = shifted(start, -exponent)
            if not in_range(system.size_of(start)):  # of no use as an initial guess for the scaled data
                start = None

        # Project b onto the range of the operator.
        data = size
        if system.active is not None or system.null_space.count:
            b, data = self._projected(b, size, run)
        if data <= 8 * EPS * size and start is None:
            run.status = "converged_at_roundoff" if data else "exact_zero_rhs"
            return np.zeros_like(b)

        # In a component whose data are much smaller than those of others, a solution with no correct digit could meet
        # the tolerance. Therefore its data are scaled up. The tolerance stays relative to the norm of the unscaled b.
        lift = None
        if self.engine.iterative:
            lift = system.lift(b, data)
        if lift is not None:
            run.exponent = run.exponent - lift
            b = shifted(b, lift)
            b = system.null_space.project(b, run.transposed, into=b)
            if start is not None:
                start = shifted(start, lift)

        # Solve and refine. Raise an error if the residual is not accepted.
        x = self._refined(b, data, run, start)
        if self.engine.refines and run.status not in ("converged", "converged_at_roundoff"):
            raise self._not_converged(run, x, why=f" ({run.status}){ADVICE.get(run.status, self.engine.advice)}")

        # Scale back.
        if lift is not None:
            x = shifted(x, -lift)
        if exponent:
            x = shifted(x, exponent)
            if not np.isfinite(system.largest(x)):
                run.status = "not_representable"
                raise NonFiniteError(f"the solution of {self.name} is beyond 1.8e308; scale the right-hand side down")
        return x

    def _refined(self, b: np.ndarray, data: float, run: Run, start: np.ndarray | None) -> np.ndarray:
        """Solve with iterative refinement until the residual is accepted or stops decreasing.

        `data` is the norm of b before small components were scaled up. The status is written into `run`.
        """
        system = self.system
        engine = self.engine
        transposed = run.transposed
        goal = run.rtol * data
        size_of_matrix = system.norms[transposed]
        singular = system.null_space.count > 0
        x = start
        r = b
        residual = data
        length = 0.0  # norm of x
        status = ""
        failure = ""
        if start is not None:
            r, residual, length = system.residual(start, b, transposed)
            if singular:
                r, residual = system.null_space.projected(r, transposed)
            status = run.assess(residual, goal, data, size_of_matrix * length + data, LARGEST_AT_ROUNDOFF * data)
        rounds = engine.most_refinements
        if status:  # the initial guess is a solution
            rounds = 0
        for _ in range(rounds):
            # A correction need not be more accurate than the rounding errors of the whole solution.
            accuracy = goal
            if x is not None:
                accuracy = max(goal, system.rounding(x, data, transposed))
            trial, iterations, failure = engine.solve(r, accuracy, transposed)
            run.iterations += iterations
            if system.active is not None:
                trial = system.masked(trial)
            if x is not None:
                np.add(x, trial, out=trial)
            if singular:
                trial = system.null_space.project(trial, transposed, into=trial)
            trial_r, trial_residual, trial_length = system.residual(trial, b, transposed)
            reduced = trial_residual <= engine.reduction * residual
            if not np.isfinite(trial_residual):
                failure = "nonfinite_output"
            elif trial_residual <= residual or x is None:
                x, r, residual, length = trial, trial_r, trial_residual, trial_length
                status = run.assess(residual, goal, data, size_of_matrix * length + data, LARGEST_AT_ROUNDOFF * data)
            if failure or not reduced or not engine.refines or status == "converged":
                break
            # If rows differ in size, more accuracy is attainable than the bound with |A| states: refine further.
            if status and x is not None and residual <= 2 * system.rounding(x, data, transposed):
                break
        if x is None:
            x = np.zeros_like(b)
            run.residual = 1.0
            run.backward_error = 1.0
        run.status = status or failure or "stagnated"
        return x

    def solve_once(
        self,
        b: np.ndarray,
        data: float,
        terms: float,
        residual: Callable[[np.ndarray], float],
        adjoint: bool,
        transposed: bool,
    ) -> np.ndarray | None:
        """Solve by one call of the engine, where the caller computes the norm of the true residual, ``residual(x)``.

        Parameters
        ----------
        b : array, shape (n,)
        data : float
            Norm of b.
        terms : float
            Sum of the norms of all terms of the residual.
        residual : callable
        adjoint : bool
            Whether the solve is recorded as an adjoint solve: a symmetric system needs no transposed one.
        transposed : bool

        Returns
        -------
        array, shape (n,), or None
            None if the residual is not accepted: then `solve` refines, or raises.
        """
        run = Run(adjoint, rtol=self.system.rtol)
        x = self.engine.solve(b, 0.0, transposed)[0]
        run.status = run.assess(residual(x), run.rtol * data, data, terms)
        if not run.status:
            return None
        thread.solves += 1
        count(self.name, "adjoint" if adjoint else "solve")
        self.log.note(run.info(), adjoint)
        return x

    def check_range(self, b: np.ndarray) -> None:
        """Raise IncompatibleError if b, one flat field, is not in the range; nullspace="project" accepts every b."""
        exponent = exponent_of(self.system.largest(b))
        b = shifted(b, -exponent)
        self._projected(b, self.system.size_of(b), Run(checked=True, rtol=self.system.rtol))

    def unroll(self, b: Any, start: Any, transposed: bool) -> Any:
        """Record the iterations of the engine on the tape; b and start are fields and may be traced.

        The solve is recorded in the log; its derivatives are not solves.
        """
        system = self.system
        run = Run(transposed, rtol=system.rtol)
        op = system.operator(transposed)
        r = b * 1.0
        if start is not None:
            r = b - op(start)
        data = np.array(plain(b), dtype=float).reshape(-1)
        size = norm(data)
        goal = run.rtol * size
        x, run.iterations, failure = self.engine.unroll(anp.reshape(r, (-1,)), goal, transposed)
        x = anp.reshape(x, op.domain.shape)
        if start is not None:
            x = x + start
        solution = shifted(np.array(plain(x)).reshape(-1), system.exponent)
        _, residual, length = system.residual(solution, data, transposed)
        run.status = failure
        if failure == "" or not residual:
            run.status = "converged" if data.any() else "exact_zero_rhs"
        run.assess(residual, goal, size, system.norms[transposed] * length + size)
        self.log.note(run.info(), transposed)
        if run.status == failure and self.engine.refines:
            raise self._not_converged(run, plain(x), "unrolled ")
        return x

    # ------------------------------------------------------------ scale and range of the data

    def _exponent(self, b: np.ndarray, run: Run) -> int:
        """Return the exponent by which b is scaled; raise NonFiniteError if b is not finite."""
        system = self.system
        largest = system.largest(b)
        if not np.isfinite(largest):
            run.status = "nonfinite_input"
            space = system.operator(run.transposed).codomain
            check_finite(self.name, system.shaped(b, space), "takes finite numbers")
        if largest == 0:
            run.status = "exact_zero_rhs"
            return 0
        return exponent_of(largest)

    def _projected(self, b: np.ndarray, size: float, run: Run) -> tuple[np.ndarray, float]:
        """Return the projection of b onto the range, and its norm.

        Raise IncompatibleError if b is not in the range, `run.checked` is True and nullspace="raise".
        """
        system = self.system
        space = system.null_space
        refuses = run.checked and self.nullspace == "raise"
        data = size
        if system.active is not None:
            b = self._on_unknowns(b, size, run, refuses)
            data = system.size_of(b)
        if space.count:
            sums = space.sums(b, run.transposed)
            defect, component = space.defect(b, sums, data, run.rtol * size, run.transposed)
            run.defect = max(run.defect, defect)
            if refuses and defect > COMPATIBLE:
                self._refuse_defect(run, defect, component)
            unprojected = data
            b, data = space.projected(b, run.transposed, sums=sums)
            if data < MOST_OF_DATA * unprojected:  # cancellation left rounding errors along the null space
                b, data = space.projected(b, run.transposed, into=b)
        return b, data

    def _on_unknowns(self, b: np.ndarray, size: float, run: Run, refuses: bool) -> np.ndarray:
        """Return b with zeros where there is no unknown; raise if `refuses` is set and b was not 0 there."""
        system = self.system
        active: Any = system.active
        outside = np.where(active, 0.0, b)
        run.defect = 0.0
        if size:
            run.defect = system.size_of(outside) / size
        if refuses and run.defect > 8 * EPS:
            self._refuse_data(
                run,
                ": the right-hand side must be 0 where there is no unknown (solid or isolated cells, "
                f"coefficient 0), but is not in cell {self._cell(system.number_of_largest(outside))}; set it to 0",
            )
        return np.where(active, b, 0.0)

    def _refuse_defect(self, run: Run, defect: float, component: int) -> None:
        """Raise IncompatibleError for a b that is not orthogonal to a left null vector."""
        space = self.system.null_space
        cells = space.cells(component)
        share = number_beside(defect, COMPATIBLE, digits=1, style="e")
        self._refuse_data(
            run,
            f" is singular and the right-hand side is not in its range: on component {component + 1} of {space.count} "
            f"({cells.size} cells from {self._cell(cells[0])}) the defect is {share}, "
            f"allowed is {COMPATIBLE:g}; subtract the weighted mean",
        )

    def _cell(self, number: int) -> str:
        """Return the grid indices of the entry with this number in the flat right-hand side, as text."""
        return place(int(number), self.system.op.codomain.shape)

    def _refuse_data(self, run: Run, reason: str) -> None:
        """Raise IncompatibleError for a right-hand side outside the range."""
        run.status = "incompatible_rhs"
        raise IncompatibleError(f"{self.name}{reason} or write nullspace='project'", info=run.info())

    def _not_converged(self, run: Run, x: np.ndarray, how: str = "", why: str = "") -> ConvergenceError:
        """Return the ConvergenceError of a solve whose best iterate is x."""
        op = self.system.operator(run.transposed)
        reached = number_beside(run.residual, run.rtol, digits=1, style="e")
        return ConvergenceError(
            f"{how}{self.engine.method} on {op}: relative residual {reached} after {run.iterations} "
            f"{self.engine.unit}, wanted {run.rtol:g}{why}",
            info=run.info(),
            best=self.system.shaped(shifted(x, run.exponent), op.domain),
        )


def _reconstruct_solver(build: Callable, arguments: tuple) -> Solver:
    """Reconstruct a Solver by the call that sets up its inverse."""
    return build(*arguments).solver
