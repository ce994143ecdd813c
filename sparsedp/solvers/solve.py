"""The adjoint contract: the one place that every solve goes through, forward and backward.

1. A right-hand side near an end of the range of floats is scaled by a power of two, the solution
   scaled back. Between, scaling would change no bit, because every method is homogeneous.
2. A solve is judged by its true residual r = b - A x, recomputed: |r| <= rtol |b| (converged), or
   |r| <= 8 eps (|A| |x| + |b|), the attainable accuracy (converged_at_roundoff). Never absolutely.
   The tolerance is that of the call: who can do with less (a Newton step, a correction) asks `approximate`.
3. inv.T solves with the true transpose of the same set-up. 4. A derivative rule calls it once.
5. Data and solution are projected on both sides of a singular system (see nullspace.py); primal data
   that are not compatible are refused unless nullspace="project"; derivatives are never refused.
6. A solve meets its tolerance or raises; the best iterate rides on the exception.
7. `inv.info` keeps the record.

An engine is what solves inside the contract. It is any object with

    solve(b, goal, transposed) -> (x, iterations, word)

on flat float64 arrays (complex128 for the direct method, when the operator is complex). `b` is left as it is, and
compatible, 0 on what is not an unknown, of a norm between 2^-255 and 2^200. Stop when |b - A x| <= goal
(2-norm), or when |b - A x| is below rounding; `word` is "" when that was met, else a status word. An
engine is homogeneous: no absolute thresholds. `x` is a fresh array; its part along the null space, and
its values on what is not an unknown, do not matter. The engine
need not be exact: the contract refines with further calls on the residual. Attributes of an engine:

    method           word that the user writes, such as "direct"
    unit             what an iteration is called in messages: "iterations", "cycles"
    hierarchy        one line: levels, unknowns, entries
    iterative        True: what it leaves depends on the tolerance
    hierarchical     True: its set-up is a multigrid hierarchy
    refines          False: one call, no refinement and no error (fixed numbers of iterations)
    unrolled         True: inv(b) is engine.unroll(b, goal, transposed)[0], differentiated as it runs

Its builder is a function (system, **options) -> engine; `system` is a System (system.py).
"""

from dataclasses import asdict, dataclass, field
from time import perf_counter
from typing import Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.counters import count, thread, timed
from sparsedp._utils.html import facts, table
from sparsedp._utils.reconstruction import Remade
from sparsedp._utils.validation import EPS, check_finite, number_beside, place
from sparsedp.autodiff.tape import plain
from sparsedp.errors import ConvergenceError, IncompatibleError, NonFiniteError
from sparsedp.solvers.nullspace import ROUNDING
from sparsedp.solvers.scaling import exponent_of, in_range, norm, shifted

__all__ = ["STATUS_WORDS", "Engine", "Run", "SolveInfo", "SolveLog", "Solver", "failure", "merged"]

COMPATIBLE = 1e-6  # largest relative defect of primal data that is taken for rounding
FAR_OFF = 0.1  # a residual beyond this share of the data is no solution, whatever the size of x
ADVICE = {"indefinite_operator": "; write method='direct'"}


class Engine:
    """Defaults of the engine protocol. `solve(b, goal, transposed)` is the engine's own."""

    method = "engine"
    unit = "iterations"
    hierarchy = ""
    iterative = False
    hierarchical = False
    refines = True
    rounds = 8  # refinements at most
    shrink = 0.5  # what each must leave of the residual at most
    advice = ""  # for solves that do not meet the tolerance
    unrolled = False


class EmptySystem(Engine):
    """The engine of a system without unknowns: it is never called."""

    method = "none"
    hierarchy = "no unknowns"


def accepted(residual, goal, terms):
    """Whether norms meet the tolerance ("converged"), the attainable accuracy, or neither ("")."""
    if residual <= goal:
        return "converged"
    return "converged_at_roundoff" if residual <= ROUNDING * terms else ""


class Solver(Remade):
    """An engine inside the contract.

    Parameters
    ----------
    system : System
    engine : Engine
    nullspace : "raise" or "project"
    log : SolveLog
    name : str
    made : (function, arguments)
        What makes the same inverse again.
    reason : str
        Why this method, in words.
    """

    def __init__(self, system, engine, nullspace, log, name, made, reason=""):
        # Factors and hierarchies do not travel: what was asked for does, and is set up again.
        self.made, self.reason = (_remade, made), reason
        self.served = not thread.calls  # whether this set-up served before, or was made where nobody counts
        self.system, self.engine = system, engine
        self.nullspace, self.log, self.name = nullspace, log, name

    def solve(self, b, transposed=False, checked=True, start=None):
        """Flat b, float64 or of a complex operator complex128 -> flat x. `checked`: primal data, to be compatible."""
        if thread.solve_hooks:
            return thread.solve_hooks[-1].linear(self, b, transposed, checked, start)
        return self.solved(b, transposed, checked, start)

    def solved(self, b, transposed=False, checked=True, start=None, rtol=None):
        """The solve itself, counted and recorded. One to a tolerance of its own, `rtol`, is not in the log."""
        count(self.name, "reused", self.served)
        self.served = True
        return timed(self.name, "adjoint" if transposed else "solve", self._solved, b, transposed, checked, start, rtol)

    def approximate(self, b, rtol, transposed=False):
        """About A^-1 b, to the relative residual `rtol` where that can be had: the caller sees to what is left."""
        try:
            return self.solved(b, transposed, False, rtol=rtol)
        except ConvergenceError as error:
            if error.best is None:
                raise
            return self.system.flat(error.best)

    def _solved(self, b, transposed, checked, start, rtol):
        run = Run(transposed, checked and not transposed, rtol or self.system.rtol)
        thread.solves += 1
        try:
            return self._scaled(b, run, start)
        finally:
            if rtol is None:
                self.log.note(run.info(), transposed)
            count(self.name, "iterations", run.iterations)
            count(self.name, "skipped", run.status == "exact_zero_rhs")

    def judged(self, b, data, terms, residual, adjoint, transposed):
        """Flat x by one call of the engine, where ``residual(x)``, its true residual, is known to the caller.

        `data`, `terms`: norms of b, and of all that the residual is the sum of. `adjoint`: whether it is an adjoint
        solve, by the transpose or not. None where the residual is not accepted: then `solve` refines, or raises.
        """
        run = Run(adjoint)
        x = self.engine.solve(b, 0.0, transposed)[0]
        left = residual(x)
        run.status = accepted(left, self.system.rtol * data, terms)
        if not run.status:
            return None
        run.measure(left, data, max(terms - data, 0.0))
        thread.solves += 1
        count(self.name, "adjoint" if adjoint else "solve")
        self.log.note(run.info(), adjoint)
        return x

    def unroll(self, b, start, transposed):
        """The engine's iterations on the tape. The record is that of the solve: its derivatives are no solves."""
        system, run = self.system, Run(transposed, rtol=self.system.rtol)
        op = system.given.T if transposed else system.given
        r = b * 1.0 if start is None else b - op(start)
        data = np.array(plain(b), dtype=float).reshape(-1)
        x, run.iterations, word = self.engine.unroll(anp.reshape(r, (-1,)), run.rtol * norm(data), transposed)
        x = anp.reshape(x, op.domain.shape) + (0.0 if start is None else start)
        solution = shifted(np.array(plain(x)).reshape(-1), system.exponent)
        _, rest, length = system.residual(solution, data, transposed)
        run.status = ("converged" if data.any() else "exact_zero_rhs") if word == "" or not rest else word
        run.measure(rest, norm(data), system.norm(transposed) * length)
        self.log.note(run.info(), transposed)
        if run.status == word and self.engine.refines:
            self._refuse(run, plain(x), "unrolled ")
        return x

    def _scaled(self, b, run, start):
        """The solve with data and solution in the middle of the range of floats."""
        size, exponent = self.system.size_of(b), 0
        if not in_range(size):
            top = self.system.largest(b)
            if not np.isfinite(top):
                run.status = "nonfinite_input"
                space = self.system.op.domain if run.transposed else self.system.op.codomain
                check_finite(self.name, self.system.shaped(b, space), "takes finite numbers")
            if top == 0:
                run.status = "exact_zero_rhs"
                return np.zeros_like(b)
            exponent = exponent_of(top)
            b = shifted(b, -exponent)
            size = self.system.size_of(b)
        exponent -= self.system.exponent
        run.exponent = exponent
        if start is not None:
            start = shifted(start, -exponent)
            start = start if in_range(self.system.size_of(start)) else None  # 0, or as far from x as from 0
        x = self._compatible(b, size, run, start)
        if not exponent:
            return x
        x = shifted(x, exponent)
        if not np.isfinite(self.system.largest(x)):
            run.status = "not_representable"
            raise NonFiniteError(f"the solution of {self.name} is beyond 1.8e308; scale the right-hand side down")
        return x

    # ------------------------------------------------------------ null space

    def _compatible(self, b, raw, run, start):
        """Project, refuse what must be refused, solve. `raw`: norm of b."""
        space, size, refuses = self.system.null_space, raw, run.checked and self.nullspace == "raise"
        if self.system.active is not None:
            b = self._on_unknowns(b, raw, run, refuses)
            size = self.system.size_of(b)
        if space.count:
            sums = space.sums(b, run.transposed)
            defect, worst = space.defect(b, sums, size, run.rtol * raw, run.transposed)
            run.defect = max(run.defect, defect)
            if refuses and defect > COMPATIBLE:
                self._refuse_defect(run, defect, worst)
            before, (b, size) = size, space.projected(b, run.transposed, sums=sums)
            if size < 0.7 * before:  # most of it was taken out: what is left needs its own digits
                b, size = space.projected(b, run.transposed, into=b)
        if size <= 8 * EPS * raw and start is None:
            run.status = "converged_at_roundoff" if size else "exact_zero_rhs"
            return np.zeros_like(b)
        lift = self.system.lift(b, size) if self.engine.iterative else None
        if lift is None:
            return self._refined(b, size, run, start)
        # A tolerance relative to the whole would leave no digits to a region whose data are faint; the whole is judged
        # by its own size, which is less than that of many regions lifted to it.
        run.exponent = run.exponent - lift
        b, start = (None if x is None else shifted(x, lift) for x in (b, start))
        b = space.project(b, run.transposed, into=b)
        return shifted(self._refined(b, size, run, start), -lift)

    def _on_unknowns(self, b, raw, run, refuses):
        outside = np.where(self.system.active, 0.0, b)
        run.defect = self.system.size_of(outside) / raw if raw else 0.0
        if refuses and run.defect > 8 * EPS:
            self._incompatible(
                run,
                ": the right-hand side must be 0 where there is no unknown (solid or isolated cells, "
                f"coefficient 0), but is not in cell {self._cell(self.system.number_of_largest(outside))}; set it to 0",
            )
        return np.where(self.system.active, b, 0.0)

    def _refuse_defect(self, run, defect, worst):
        space = self.system.null_space
        cells = space.cells(worst)
        share = number_beside(defect, COMPATIBLE, digits=1, style="e")
        self._incompatible(
            run,
            f" is singular and the right-hand side is not in its range: on component {worst + 1} of {space.count} "
            f"({cells.size} cells from {self._cell(cells[0])}) the defect is {share}, "
            f"allowed is {COMPATIBLE:g}; subtract the weighted mean",
        )

    def _cell(self, number):
        return place(int(number), self.system.op.codomain.shape)

    def _incompatible(self, run, reason):
        run.status = "incompatible_rhs"
        raise IncompatibleError(f"{self.name}{reason} or write nullspace='project'", info=run.info())

    # ------------------------------------------------------------ accuracy

    def _refined(self, b, data, run, start):
        """Call the engine on the residual until the true residual is accepted, or does not fall."""
        system, goal, transposed = self.system, run.rtol * data, run.transposed
        x, r, residual, length, word, trouble = start, b, data, 0.0, "", ""
        if start is not None:
            r, residual, length = system.residual(start, b, transposed)
            if system.null_space.count:
                r, residual = system.null_space.projected(r, transposed)
            word = self._word(run, residual, goal, length, data)
        for _ in range(self.engine.rounds if not word else 0):
            # A correction need not go below what rounding leaves of the whole; an engine sees the correction alone.
            floor = 0.0 if x is None else system.rounding(x, data, transposed)
            step, used, trouble = self._correction(r, max(goal, floor), transposed)
            run.iterations += used
            trial = step if x is None else np.add(x, step, out=step)
            trial = system.null_space.project(trial, transposed, into=trial)
            r_trial, reached, size = system.residual(trial, b, transposed)
            fell = reached <= self.engine.shrink * residual
            if not np.isfinite(reached):
                trouble = "nonfinite_output"
            elif reached <= residual or x is None:
                x, r, residual, length = trial, r_trial, reached, size
                word = self._word(run, residual, goal, length, data)
            if trouble or not fell or not self.engine.refines or word == "converged":
                break
            # Attainable by the norm of A is not the end where rows differ in size: go on to their own rounding.
            if word and residual <= 2 * system.rounding(x, data, transposed):
                break
        x = np.zeros_like(b) if x is None else x
        run.status = word or trouble or "stagnated"
        run.measure(residual, data, system.norm(transposed) * length)
        if word or not self.engine.refines:
            return x
        self._refuse(run, x, why=f" ({run.status}){ADVICE.get(run.status, self.engine.advice)}")

    def _refuse(self, run, x, how="", why=""):
        """Raise: x does not meet the tolerance."""
        op = self.system.given.T if run.transposed else self.system.given
        reached = number_beside(run.residual, run.rtol, digits=1, style="e")
        raise ConvergenceError(
            f"{how}{self.engine.method} on {op}: relative residual {reached} after {run.iterations} "
            f"{self.engine.unit}, wanted {run.rtol:g}{why}",
            info=run.info(),
            best=self.system.shaped(shifted(x, run.exponent), op.domain),
        )

    def _word(self, run, residual, goal, length, data):
        """The status word of a solution of this length, "" while it is none."""
        if goal < residual and residual > FAR_OFF * data:  # huge along an unknown null vector: any size of rounding
            return ""
        return accepted(residual, goal, self.system.norm(run.transposed) * length + data)

    def _correction(self, r, goal, transposed):
        """One call of the engine."""
        step, used, trouble = self.engine.solve(r, goal, transposed)
        return self.system.masked(step), used, trouble


def _remade(build, arguments):
    return build(*arguments).solver


# ---------------------------------------------------------------- what a solve leaves behind

STATUS_WORDS = (  # from good to bad: of two solves that share a record, the later word counts
    "exact_zero_rhs",
    "converged",
    "converged_at_roundoff",
    "max_iterations",
    "stagnated",
    "diverged",
    "indefinite_operator",
    "incompatible_rhs",
    "empty_row",
    "empty_column",
    "nonfinite_input",
    "nonfinite_output",
    "not_representable",
    "setup_failed",
)


@dataclass(frozen=True)
class SolveInfo:
    """The record of one solve.

    Attributes
    ----------
    status : str
        One of STATUS_WORDS.
    iterations : int
        0 for direct methods.
    residual : float
        True relative residual |b - A x| / |b|, recomputed after the solve.
    backward_error : float
        |b - A x| / (|A| |x| + |b|).
    defect : float
        Part of the data along the null space, relative, largest over the components.
    seconds : float
    """

    status: str
    iterations: int
    residual: float
    backward_error: float
    defect: float
    seconds: float

    def _repr_html_(self):
        """For a notebook."""
        return facts("solve", asdict(self))


@dataclass(slots=True)
class SolveLog:
    """The last forward and the last adjoint solve of an inverse, by whichever thread, and its set-up.

    Attributes
    ----------
    forward, adjoint : SolveInfo or None
        None before the first solve.
    setup_seconds : float
    hierarchy : str
        Size of what was set up: levels, unknowns, entries.
    """

    forward: SolveInfo | None = None
    adjoint: SolveInfo | None = None
    setup_seconds: float = 0.0
    hierarchy: str = ""

    def note(self, info, transposed):
        """Record a solve."""
        setattr(self, "adjoint" if transposed else "forward", info)

    def last(self, transposed):
        """The record of the last adjoint or forward solve, None before the first one."""
        return self.adjoint if transposed else self.forward

    def _repr_html_(self):
        """For a notebook: the two solves side by side."""
        runs = {"forward": self.forward, "adjoint": self.adjoint}
        rows = [{"": name, **asdict(info)} for name, info in runs.items() if info]
        title = f"set-up {self.setup_seconds:.2g} s{self.hierarchy and ': '}{self.hierarchy}"
        return table([row.values() for row in rows], rows[0] if rows else (), title)


@dataclass(slots=True)
class Run:
    """The figures of a solve while it runs, and what was asked of it."""

    transposed: bool = False
    checked: bool = False
    rtol: float = 0.0
    status: str = ""
    iterations: int = 0
    residual: float = 0.0
    backward_error: float = 0.0
    defect: float = 0.0
    exponent: Any = 0  # the solution is what the engine works on, times 2 to this power
    clock: float = field(default_factory=perf_counter)

    def measure(self, residual, data, terms):
        """Note the norm of the residual, relative to that of the data, and to the sum of both terms of it."""
        self.residual = residual / data if data else 0.0
        self.backward_error = residual / (terms + data or 1.0)

    def info(self):
        """Freeze the figures."""
        figures = map(float, (self.residual, self.backward_error, self.defect, perf_counter() - self.clock))
        return SolveInfo(self.status, int(self.iterations), *figures)


def failure(status):
    """The record of a set-up that failed."""
    return Run(status=status).info()


def merged(one, other):
    """The record of two solves that belong together."""
    return SolveInfo(
        max(one.status, other.status, key=STATUS_WORDS.index),
        one.iterations + other.iterations,
        max(one.residual, other.residual),
        max(one.backward_error, other.backward_error),
        max(one.defect, other.defect),
        one.seconds + other.seconds,
    )
