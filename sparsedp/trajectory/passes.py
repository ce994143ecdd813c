"""The forward and the backward pass of a rollout, and the derivative rule by which the tape calls them.

A rollout is one node on the tape of the innermost trace of its arguments, if that is a reverse-mode trace. All other
traces follow the operations inside the steps, in both passes: a forward derivative is a loop over steps with tangents,
and derivatives of higher order differentiate the operations that the two passes execute.
"""

from __future__ import annotations

from copy import copy
from functools import partial
from operator import is_
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.counters import count
from sparsedp._utils.progress import shown_steps
from sparsedp.autodiff.derivative import checking_derivatives, is_finite, zero_like
from sparsedp.autodiff.jit import Jitted
from sparsedp.autodiff.tape import Rule, fit, innermost, isbox, through
from sparsedp.errors import DerivativeError, NonFiniteError
from sparsedp.trajectory.disk_states import BackwardProgress, DiskStates, state_digest
from sparsedp.trajectory.record import Record, backward_record, largest
from sparsedp.trajectory.recorded_steps import CompiledRun, compiled_run, recorded_runner
from sparsedp.trajectory.specification import RolloutSpecification, stacked
from sparsedp.trajectory.step_runner import State, StepRunner

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Sequence

    from sparsedp.trajectory.checkpoint_plan import CheckpointPlan
    from sparsedp.trajectory.outputs import LastState

    KeptStates = list[State] | DiskStates

__all__ = ["RolloutRule"]

SAMPLES = 32  # number of states of a long run at which the size of the cotangent is measured
LEAST_INTERVAL = 16  # least number of steps between two measurements, because each of them reads the whole cotangent


# ---- forward ---------------------------------------------------------------------------------------------------------


def run_forward(
    runner: StepRunner,
    plan: CheckpointPlan,
    outputs: LastState,
    stored: set[int],
    progress: bool | str,
    kept: KeptStates,
) -> State:
    """Run all steps; return the last state, and append the states kept for the backward pass, with the last, to `kept`.

    If an interrupted run left states in files, the steps up to the last one of them are not run, unless the step has
    changed.
    """
    is_differentiated = bool(runner.specification.differentiated)
    recorder = runner.recorder
    room = plan.tape_bytes
    tape_bytes = 0
    outputs.start(runner)
    state = outputs.see(runner.first)
    if isinstance(kept, DiskStates):
        state = kept.resume(runner, state)
    else:
        kept.append(state)
    for i in shown_steps(progress, range(state.i, plan.n), "forward"):
        start = state
        is_taped = is_differentiated and (i == 0 or tape_bytes <= room)
        if i < 2:
            recorder.bytes = 0
        else:
            recorder.bytes = None
        state = runner.step(start, is_taped)
        if not runner.copies and True in map(is_, state.values, start.values) and _share_an_array(state, start):
            # The step writes into arrays that it has returned, and it may have read one of them after that. Run all
            # steps again with copies of the states.
            runner.copies = True
            kept.clear()
            return run_forward(runner, plan, outputs, stored, progress, kept)
        if is_taped:
            if i < 2:  # estimate the memory of a tape from the first two steps
                tape_bytes = runner.tape_size(start)
            room -= tape_bytes
            if i == 0 and room < 0:
                start.tape = None
                state.boxes = None
        if outputs.enters_everywhere:
            state = outputs.see(state)
        if i + 1 in stored:
            if not is_taped and not outputs.holds_all_states:
                state = state.owned()
            kept.append(state)
    if isinstance(kept, DiskStates) and not kept.finish_forward(state):
        return run_forward(runner, plan, outputs, stored, progress, kept)
    return state


def _share_an_array(state: State, start: State) -> bool:
    pairs = zip(state.values, start.values, strict=True)
    return any(a is b and isinstance(a, np.ndarray) for a, b in pairs)


def refuse_nonfinite_step(runner: StepRunner) -> None:
    """Run the steps again and raise NonFiniteError for the first one that produces NaN or infinity.

    These usually persist, so that the forward pass checks the last state only.
    """
    specification = runner.specification
    state = runner.first
    for i in range(specification.n):
        state = runner.step(state, False)
        specification.state.check_finite(state.values, f"step {i} of rollout", "needs a smaller time step")


# ---- backward --------------------------------------------------------------------------------------------------------


def run_backward(
    runner: StepRunner,
    plan: CheckpointPlan,
    outputs: LastState,
    kept: KeptStates,
    cotangents: list,
    progress: bool | str,
) -> tuple[list, list[tuple[int, float]], int]:
    """Run one backward pass over all steps.

    Parameters
    ----------
    runner, plan, outputs
        The same objects as in the forward pass.
    kept : list of State, or DiskStates
        The states that the forward pass kept, with the last one; this function empties the list.
    cotangents : list
        Cotangents of the arrays of the result.
    progress : bool or str

    Returns
    -------
    cotangents : list
        Cotangents of the variables of all arguments; None for a variable that the result does not depend on.
    norms : list of (int, float)
        Index of a state and the largest magnitude of an entry of its cotangent.
    recomputed : int
        Number of steps that were run again to recompute states.
    """
    specification = runner.specification
    n = plan.n
    interval = max(n // SAMPLES, LEAST_INTERVAL)
    source = outputs.sources(n, cotangents)
    sums: dict = {}  # for each root of params: (sum of cotangents so far, whether the sum may be modified in place)
    rows: list[list] = []  # for each array of inputs the cotangents of its rows, one row per step
    for block, root in zip(runner.inputs, runner.input_roots, strict=True):
        if root:
            rows.append(list(zero_like(block)))
        else:
            rows.append([])
    recomputed = 0
    state = kept.pop()
    if plan.is_reversing:
        last = state
    else:
        last = None
    total = source(state)
    if total is None:
        norms = []
    else:
        norms = [(n, largest(total))]
    first = n - 1
    digest_of_next = None
    if isinstance(kept, DiskStates):
        saved = kept.saved_progress(cotangents)
        if saved is not None:
            first, total, recomputed, norms, digest_of_next = _restore(saved, runner, sums, rows)
    for i in shown_steps(progress, range(first, -1, -1), "backward"):
        if total is None and not outputs.enters_everywhere:
            break  # truncation: earlier states get no cotangent
        is_taped = kept and kept[-1].tape
        if is_taped:
            fingerprint = []
        else:
            fingerprint = state.fingerprint()
        if plan.is_reversing:
            state = runner.reversed_step(state)
        else:
            state, repeated = _state_at(i, runner, plan, kept)
            recomputed += repeated
        if total is not None:
            if not is_taped:
                state = state.with_values(state.values)  # a new object, so that no kept state holds the tape
                following = runner.step(state, True)
                if digest_of_next is not None:
                    check_repeated(specification, [state_digest(following.values)], [digest_of_next])
                    digest_of_next = None
                elif not plan.is_reversing:
                    check_repeated(specification, following.fingerprint(), fingerprint)
                del following  # its arrays take memory
            total = runner.pulled_back(total, state, sums, rows)
            if not is_taped:
                state.tape = None
        if i % interval == 0 and total is not None:
            norms.append((i, largest(total)))
        if outputs.enters_everywhere and i >= specification.first_traced:
            total = _sum(total, source(state))
        if i and isinstance(kept, DiskStates) and total is not None:
            kept.save(partial(_progress, i, total, runner, sums, rows, norms, recomputed, state))
    if last is not None and state.i == 0:
        runner.check_drift(state, last)
    backs = list(total or [None] * len(specification.state.places))
    for root, value in zip(runner.param_roots, runner.params, strict=True):
        if root in sums:
            back = sums[root][0]
        else:
            back = None
        if back is None:
            backs.append(None)
        else:
            backs.append(fit("the step", value, back, back))
    for row in rows:
        if row:
            backs.append(stacked(row))
        else:
            backs.append(None)
    return backs, norms, recomputed


def _progress(
    i: int,
    total: list,
    runner: StepRunner,
    sums: dict,
    rows: list[list],
    norms: list,
    recomputed: int,
    state: State,
) -> BackwardProgress:
    """Return what the backward pass has computed when the step that begins at a state has been differentiated."""
    param_sums = []
    for root in runner.param_roots:
        if root in sums:
            param_sums.append(sums[root][0])
        else:
            param_sums.append(None)
    input_rows = [np.stack(row[i:]) for row in rows if row]
    return BackwardProgress(i - 1, total, param_sums, input_rows, norms, recomputed, state_digest(state.values))


def _restore(
    saved: BackwardProgress, runner: StepRunner, sums: dict, rows: list[list]
) -> tuple[int, list, int, list, str]:
    """Put the saved sums and rows in place; return the index of the next step and what belongs to it."""
    for root, total in zip(runner.param_roots, saved.sums, strict=True):
        if total is not None:
            sums[root] = (total, False)
    for row, saved_rows in zip((row for row in rows if row), saved.rows, strict=True):
        row[saved.i + 1 :] = list(saved_rows)
    norms = [(index, norm) for index, norm in saved.norms]
    return saved.i, saved.total, saved.recomputed, norms, saved.digest


def _state_at(i: int, runner: StepRunner, plan: CheckpointPlan, kept: KeptStates) -> tuple[State, int]:
    """Return state i, computed from the nearest kept state before it, and the number of steps that were run."""
    state = kept.pop()
    repeated = 0
    while state.i < i:
        kept.append(state)
        if isinstance(kept, DiskStates):
            in_memory = kept.in_memory
        else:
            in_memory = len(kept)
        stop = plan.next_index(state.i, i, in_memory)
        repeated += stop - state.i
        while state.i < stop:
            state = runner.step(state, False)
        state = state.owned()
    return state, repeated


def _sum(total: list | None, entering: list | None) -> list | None:
    """Return the elementwise sum of two lists of cotangents; None, as a list or as an entry, counts as zero."""
    if entering is None:
        return total
    if total is None:
        return entering
    sums = []
    for a, b in zip(total, entering, strict=True):
        if a is None or b is None:
            if a is None:
                sums.append(b)
            else:
                sums.append(a)
        else:
            sums.append(a + b)
    return sums


def check_repeated(specification: RolloutSpecification, fingerprints: list, earlier: list) -> None:
    """Raise DerivativeError if the fingerprints of a state differ from its fingerprints in an earlier run."""
    if fingerprints == earlier:
        return
    form = specification.state
    names = [*form.names, *[form.root] * len(fingerprints)]
    name = next(name for name, a, b in zip(names, fingerprints, earlier, strict=False) if a != b)
    raise DerivativeError(f"the step gives another {name} when it is run again; it must depend on its arguments only")


def release(kept: KeptStates, error: BaseException) -> None:
    """Remove the files of states after an error; leave them for a later run after Ctrl-C or sys.exit()."""
    if isinstance(kept, DiskStates):
        if isinstance(error, Exception):
            kept.remove()
        else:
            kept.preserve()


# ---- the rule --------------------------------------------------------------------------------------------------------


class RolloutRule(Rule):
    """A rollout as a derivative rule of its variables; holds the states kept for the backward pass.

    Parameters
    ----------
    specification : RolloutSpecification
    plan : CheckpointPlan
    outputs : LastState, SelectedStates, AllStates or FunctionOfStates
    progress : bool or str
    record : callable or None
    disk : path or None
        Folder for the files of states that do not fit into the memory.

    Attributes
    ----------
    count : int
        Number of arrays of the result.
    truncate : int or None
        The value in the specification; `check.gradient` reads it to explain a difference.
    """

    name = "rollout"
    jvp = None
    accepts_traced = True
    keywords = ()

    def __init__(
        self,
        specification: RolloutSpecification,
        plan: CheckpointPlan,
        outputs: LastState,
        progress: bool | str,
        record: Callable[[Record], Any] | None,
        disk: str | os.PathLike[str] | None,
    ) -> None:
        self.specification = specification
        self.truncate = specification.truncate
        self.plan = plan
        self.outputs = outputs
        self.progress = progress
        self.record = record
        self.disk = disk
        if specification.differentiated:
            self.stored = plan.stored_indices()
        else:
            self.stored = {0}
        self._runs: list[tuple[StepRunner, Any]] = []  # for the backward pass
        self._compiles = True  # whether all steps may be one call of machine code
        self._last_fingerprint: list = []

    def forward(self, *args: Any) -> Any:
        """Run all steps; return the array of the result, or the tuple of its arrays."""
        specification = self.specification
        runner: StepRunner | None = None
        if isinstance(specification.step, Jitted):
            runner = recorded_runner(specification, args)
        if runner is None:
            runner = StepRunner(specification, args)
        kept: Any = []
        if self.disk is not None:
            kept = self._new_store(args)  # may contain states of an interrupted run
        with runner.errors_named():
            run = None
            if self._compiles and self.disk is None and isinstance(specification.step, Jitted):
                run = compiled_run(runner, self.plan, self.outputs, self.progress)
            if run is not None:
                last = run.last
                kept = run
            else:
                try:
                    last = run_forward(runner, self.plan, self.outputs, self.stored, self.progress, kept)
                except BaseException as error:
                    release(kept, error)
                    raise
        if not all(map(is_finite, last.values)):
            try:
                refuse_nonfinite_step(runner)
            except BaseException as error:
                release(kept, error)
                raise
        runner.recorder.ended = True
        if specification.differentiated:
            self._last_fingerprint = last.fingerprint()
            self._runs = [(runner, kept)]
        n_kept = len(self.stored) - 1
        count("rollout.step", "forward", specification.n)
        count("rollout", "bytes", n_kept * specification.state.nbytes)
        if self.record is not None:
            record = Record("forward", specification.n, n_kept, 0)
            if isinstance(kept, DiskStates):
                record = record._replace(on_disk=kept.written, resumed_at=kept.resumed_at)
            self.record(record)
        results = self.outputs.finish(last)
        self.count = len(results)
        if self.count != 1:
            return results
        return results[0]

    def _new_store(self, args: Sequence) -> KeptStates:
        """Return an empty store for the states of a run, with files if states do not fit into the memory."""
        if self.disk is None or not self.plan.disk_slots or not self.specification.differentiated:
            return []
        if any(map(isbox, args)):
            raise DerivativeError(
                "rollout with disk has first derivatives only, because files cannot hold traced states; leave disk out"
            )
        return DiskStates(self.specification, args, self.plan, self.disk, not self.outputs.enters_everywhere)

    def again(self, *args: Any) -> Any:
        """Run the same steps for other arguments, which may be on any trace, without `progress` and `record`."""
        old = self.specification
        specification = RolloutSpecification(old.step, old.forms, old.n, old.truncate, innermost(args))
        rule = RolloutRule(specification, self.plan, copy(self.outputs), False, None, self.disk)
        return through(rule, specification.differentiated, *args)

    def parts(self, values: Any) -> list:
        """Return the results of `forward`, or their cotangents, as a list."""
        if self.count == 1:
            return [values]
        return [values[k] for k in range(self.count)]

    def vjp(self, nums: Sequence[int], ans: Any, *args: Any) -> Callable:
        """Return the function that maps cotangents of the result to cotangents of the differentiated arguments."""
        return partial(self._cotangents, args, self._take_runs())

    def _take_runs(self) -> list:
        """Return and clear the last run, so that the rule does not keep its states in memory."""
        runs = self._runs
        self._runs = []
        return runs

    def _cotangents(self, args: tuple, runs: list, cotangent: Any) -> tuple:
        """Return the cotangents of the differentiated arguments; raise NonFiniteError if they are not finite."""
        g = self.parts(cotangent)
        backs = self._backward_pass(args, g, runs)
        for position, back in zip(self.specification.differentiated, backs, strict=True):
            if not is_finite(back) and all(map(is_finite, g)):
                with checking_derivatives():  # run again with checks, to raise at the operation that is not finite
                    self._backward_pass(args, g, [])
                raise NonFiniteError(
                    f"the backward pass through {self.specification.n} steps of rollout makes the gradient in "
                    f"{self.specification.names[position]} NaN or infinite; take fewer steps, or cut it with truncate"
                )
        return backs

    def _backward_pass(self, args: tuple, g: list, runs: list) -> tuple:
        """Return the cotangents, without a check that they are finite.

        With limited memory the backward pass frees the states of the run that it uses; if it is called again, the
        forward pass is repeated first.
        """
        specification = self.specification
        interval = max(specification.n // SAMPLES, LEAST_INTERVAL)
        compiled = None
        if runs and isinstance(runs[0][1], CompiledRun):
            if not any(map(isbox, g)):
                compiled = runs[0][1].backward(self.outputs, g, interval)
            if compiled is None:  # follow the steps of the recorded program
                self._compiles = False
                self.forward(*args)
                runs[:] = self._take_runs()
        elif not runs:
            last_fingerprint = self._last_fingerprint
            self.forward(*args)
            check_repeated(specification, self._last_fingerprint, last_fingerprint)
            runs.extend(self._take_runs())
        if compiled is None:
            backs, norms, recomputed = self._backward_steps(runs, g)
        else:
            backs, norms = compiled
            recomputed = 0
        count("rollout.step", "vjp", specification.n)
        count("rollout.step", "recomputed", recomputed)
        last_cut = max(specification.cuts, default=-1)
        record = backward_record(specification.n, len(self.stored) - 1, recomputed, norms, last_cut)
        if self.record is not None:
            self.record(record)
        cotangents = []
        for position in specification.differentiated:
            back = backs[position]
            if back is None:
                cotangents.append(zero_like(args[position]))
            else:
                cotangents.append(back)
        return tuple(cotangents)

    def _backward_steps(self, runs: list, g: list) -> tuple[list, list[tuple[int, float]], int]:
        """Run a backward pass step by step, see `run_backward`."""
        runner, kept = runs[0] if self.plan.slots is None else runs.pop()
        if runs:
            kept = list(kept)
        runner.recorder.ended = False
        with runner.errors_named("in the backward pass through step"):
            try:
                results = run_backward(runner, self.plan, self.outputs, kept, g, self.progress)
            except BaseException as error:
                release(kept, error)
                raise
        if isinstance(kept, DiskStates):
            kept.remove()
        runner.recorder.ended = True
        return results
