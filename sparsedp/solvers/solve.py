"""The solve contract: the one path of every linear solve, forward and adjoint.

1. Scale. Data near an end of the range of floats are scaled by a power of two, and the solution is scaled back. In
   between, scaling would change no bit, because every method is homogeneous.
2. Tolerance. The true residual r = b - A x is computed from the solution: a solve has converged if |r| <= rtol |b|, or
   if |r| <= 8 eps (|A| |x| + |b|), the attainable accuracy (converged_at_roundoff). There is no absolute tolerance.
   Callers with a looser tolerance (a Newton step, a correction) use `Solver.approximate`.
3. Transpose. inv.T solves with the transpose of the same set-up.
4. Derivatives. A derivative rule calls one adjoint solve.
5. Null space. Data and solution are projected on both sides of a singular system (see nullspace.py). Primal data
   outside the range are refused unless nullspace="project"; derivatives are never refused.
6. Failure. A solve that does not meet its tolerance raises an error with its best iterate.
7. Record. `inv.info` holds the figures of the last forward and the last adjoint solve.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from time import perf_counter
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.counters import active, count, thread, timed
from sparsedp._utils.reconstruction import Reconstructible
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

COMPATIBLE = 1e-6  # largest relative defect of primal data that counts as rounding
MOST_OF_DATA = 0.7  # a projection that leaves less than this share of the data is applied twice
LARGEST_AT_ROUNDOFF = 0.1  # share of the data beyond which a residual is not accepted, however large x is
ADVICE = {"indefinite_operator": "; write method='direct'"}


@dataclass(slots=True)
class Run:
    """The figures of a solve in progress, and the request.

    Attributes
    ----------
    transposed : bool
    checked : bool
        Whether b are primal data, which must be in the range of a singular operator.
    rtol : float
    exponent : int or int array
        The solution is the one that the engine computes times 2 to this power.
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
        """Note the figures of a solution, and return the status of its residual.

        Parameters
        ----------
        residual : float
            Norm of the residual.
        goal : float
            A residual up to it is accepted.
        data : float
            Norm of the right-hand side.
        terms : float
            Sum of the norms of all terms of the residual.
        largest : float
            A residual beyond it is not accepted at roundoff.

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
    """A system and an engine that is set up for it: solves to a tolerance, with the matrix and with its transpose.

    Parameters
    ----------
    system : System
    engine : Engine
    nullspace : "raise" or "project"
    log : SolveLog
    name : str
    made : (function, arguments)
        The call that sets up the same inverse again: factors and hierarchies are not pickled.
    reason : str
        Why this method, in words.
    """

    def __init__(
        self,
        system: System,
        engine: Engine,
        nullspace: str,
        log: SolveLog,
        name: str,
        made: tuple | None,
        reason: str = "",
    ) -> None:
        self.system = system
        self.engine = engine
        self.nullspace = nullspace
        self.log = log
        self.name = name
        self.made = (_remade, made)
        self.reason = reason
        self.reused = not thread.calls  # whether the next solve reuses the set-up, as far as open recordings know

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
        """Solve A x = b, or A^T x = b: observers, counts and records of every solve are here.

        Parameters
        ----------
        b : array, shape (n,)
            float64, or complex128 if the operator is complex.
        transposed : bool
        checked : bool
            Whether b are primal data, which must be in the range of a singular operator.
        start : array, shape (n,), optional
            First guess.
        rtol : float, optional
            Tolerance of this solve alone, which is then not recorded in the log.
        observed : bool
            False if the caller is the observer of solves.

        Returns
        -------
        array, shape (n,)
            Fresh.

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
        """Solve to the relative residual `rtol` if that can be reached; the caller tests the result."""
        try:
            return self.solve(b, transposed, checked=False, rtol=rtol, observed=False)
        except ConvergenceError as error:
            if error.best is None:
                raise
            return self.system.flat(error.best)

    def _solve(self, b: np.ndarray, run: Run, start: np.ndarray | None) -> np.ndarray:
        """Rescale, project, solve and refine, accept or raise, scale back."""
        system = self.system

        # Rescale: the norms of data and solution stay in the middle of the range of floats.
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
            if not in_range(system.size_of(start)):  # 0, or as far from the solution as 0 is
                start = None

        # Project: the data are in the range of the operator.
        data = size
        if system.active is not None or system.null_space.count:
            b, data = self._projected(b, size, run)
        if data <= 8 * EPS * size and start is None:
            run.status = "converged_at_roundoff" if data else "exact_zero_rhs"
            return np.zeros_like(b)

        # A tolerance relative to all data would leave no digits to a region with small data. They are scaled up; the
        # tolerance stays relative to the norm of the unscaled data.
        lift = None
        if self.engine.iterative:
            lift = system.lift(b, data)
        if lift is not None:
            run.exponent = run.exponent - lift
            b = shifted(b, lift)
            b = system.null_space.project(b, run.transposed, into=b)
            if start is not None:
                start = shifted(start, lift)

        # Solve and refine. Accept or raise.
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
        """Call the engine on the residual until the true residual is accepted or stops decreasing.

        `data` is the norm of the data. The status is written into `run`.
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
        trouble = ""
        if start is not None:
            r, residual, length = system.residual(start, b, transposed)
            if singular:
                r, residual = system.null_space.projected(r, transposed)
            status = run.assess(residual, goal, data, size_of_matrix * length + data, LARGEST_AT_ROUNDOFF * data)
        rounds = engine.most_refinements
        if status:  # the first guess is a solution
            rounds = 0
        for _ in range(rounds):
            # A correction need not be more accurate than the rounding errors of the whole solution.
            accuracy = goal
            if x is not None:
                accuracy = max(goal, system.rounding(x, data, transposed))
            trial, iterations, trouble = engine.solve(r, accuracy, transposed)
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
                trouble = "nonfinite_output"
            elif trial_residual <= residual or x is None:
                x, r, residual, length = trial, trial_r, trial_residual, trial_length
                status = run.assess(residual, goal, data, size_of_matrix * length + data, LARGEST_AT_ROUNDOFF * data)
            if trouble or not reduced or not engine.refines or status == "converged":
                break
            # The accuracy that is attainable by the norm of A is not the limit where rows differ in size.
            if status and x is not None and residual <= 2 * system.rounding(x, data, transposed):
                break
        if x is None:
            x = np.zeros_like(b)
            run.residual = 1.0
            run.backward_error = 1.0
        run.status = status or trouble or "stagnated"
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
        x, run.iterations, trouble = self.engine.unroll(anp.reshape(r, (-1,)), goal, transposed)
        x = anp.reshape(x, op.domain.shape)
        if start is not None:
            x = x + start
        solution = shifted(np.array(plain(x)).reshape(-1), system.exponent)
        _, residual, length = system.residual(solution, data, transposed)
        run.status = trouble
        if trouble == "" or not residual:
            run.status = "converged" if data.any() else "exact_zero_rhs"
        run.assess(residual, goal, size, system.norms[transposed] * length + size)
        self.log.note(run.info(), transposed)
        if run.status == trouble and self.engine.refines:
            raise self._not_converged(run, plain(x), "unrolled ")
        return x

    # ------------------------------------------------------------ scale and range of the data

    def _exponent(self, b: np.ndarray, run: Run) -> int:
        """Return the exponent by which b is scaled; refuse data that are not finite."""
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
        """Return the part of b in the range of the operator, and its norm; refuse primal data outside of it."""
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
            if data < MOST_OF_DATA * unprojected:  # the remainder is small: project it to its own rounding
                b, data = space.projected(b, run.transposed, into=b)
        return b, data

    def _on_unknowns(self, b: np.ndarray, size: float, run: Run, refuses: bool) -> np.ndarray:
        """Return b with zeros where there is no unknown; refuse primal data that are not 0 there."""
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
        """Raise for data with a component along a null vector."""
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
        """Return the indices of an entry of the right-hand side."""
        return place(int(number), self.system.op.codomain.shape)

    def _refuse_data(self, run: Run, reason: str) -> None:
        """Raise for data outside the range."""
        run.status = "incompatible_rhs"
        raise IncompatibleError(f"{self.name}{reason} or write nullspace='project'", info=run.info())

    def _not_converged(self, run: Run, x: np.ndarray, how: str = "", why: str = "") -> ConvergenceError:
        """Return the error of a solve whose solution x does not meet the tolerance."""
        op = self.system.operator(run.transposed)
        reached = number_beside(run.residual, run.rtol, digits=1, style="e")
        return ConvergenceError(
            f"{how}{self.engine.method} on {op}: relative residual {reached} after {run.iterations} "
            f"{self.engine.unit}, wanted {run.rtol:g}{why}",
            info=run.info(),
            best=self.system.shaped(shifted(x, run.exponent), op.domain),
        )


def _remade(build: Callable, arguments: tuple) -> Solver:
    """Set up a Solver again from its recipe."""
    return build(*arguments).solver
