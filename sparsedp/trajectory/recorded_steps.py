"""Run the steps of a rollout by the programs of a jitted step: see `jit`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp.autodiff.derivative import random_like, zero_like
from sparsedp.autodiff.jit import Jitted, is_watched, tree_form
from sparsedp.autodiff.program_trace import Slot
from sparsedp.autodiff.tape import added, fit, isbox
from sparsedp.errors import JitError
from sparsedp.trajectory.record import largest
from sparsedp.trajectory.step_runner import State, StepRunner

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sparsedp.autodiff.compiled_program import CompiledLoop
    from sparsedp.autodiff.jit import Outputs
    from sparsedp.trajectory.checkpoint_plan import CheckpointPlan
    from sparsedp.trajectory.outputs import LastState
    from sparsedp.trajectory.specification import RolloutSpecification

__all__ = ["CompiledRun", "compiled_run", "recorded_runner"]

MOST_BYTES = 2**28  # memory for the states of a run without derivatives, of which some are returned


def recorded_runner(specification: RolloutSpecification, args: Sequence) -> RecordedStepRunner | None:
    """Return the object that runs the steps of a rollout by the programs of its jitted step.

    Return None if the step itself has to be called: if an outer trace follows its operations, if the calls inside it
    are observed, and if leaves of the state or of the inputs are not floating, because they may change from step to
    step.
    """
    step: Any = specification.step
    if not specification.n or is_watched() or any(map(isbox, args)):
        return None
    for form in (specification.state, specification.inputs):
        if form is not None and len(form.places) < len(form.statics):
            return None
    try:
        runner = RecordedStepRunner(specification, args, step)
    except JitError:
        if not step.falls_back:
            raise
        return None
    if runner.keeps_form:
        return runner
    return None


class RecordedStepRunner(StepRunner):
    """Runs the steps of a rollout by the programs of a jitted step.

    Parameters
    ----------
    specification : RolloutSpecification
    args : list of arrays
        Variables of state, params and inputs.
    step : Jitted

    Attributes
    ----------
    keeps_form : bool
        Whether the step returns a state of the same form as its argument, so that no result has to be converted.
    """

    def __init__(self, specification: RolloutSpecification, args: Sequence, step: Jitted) -> None:
        super().__init__(specification, args)
        arguments = self._plain_arguments(self.first)
        variables: list = []
        form = tree_form((arguments, {}), variables)
        self._n_state = len(self.first.values)
        self.plain_params = variables[self._n_state : self._n_state + len(self.params)]
        self._recorded = step.recorded(form, arguments, {}, variables)
        self._program: Any = None
        if specification.differentiated:
            roots = [True] * self._n_state + self.param_roots + self.input_roots
            nums = tuple(num for num, root in enumerate(roots) if root)
            self._program = self._recorded.pullback(nums, variables)
            outputs = self._program.outputs
        else:
            outputs = self._recorded.outputs()
            if outputs.state_is_known and not self._recorded.value_is_checked:
                self._recorded.results(variables, compiles=False)
        if not outputs.state_is_known:
            outputs.state_places = self._state_places(outputs, variables)
            outputs.state_is_known = True
        self.keeps_form = outputs.state_places is not None
        # For each variable of the state its position among the results of the program.
        self._order = outputs.state_places or []
        # For each result of the program the position of its variable in the state.
        self._places = [self._order.index(place) for place in range(len(self._order))]
        self._is_prepared = False
        self._differentiated_params = [root for root in self.param_roots if root]

    def _state_places(self, outputs: Outputs, variables: Sequence) -> list[int] | None:
        """Return for each variable of the state its position among the results of the program.

        Return None if the step does not keep the form of the state. Raise an error if its result is no such state.
        """
        if self._program is None:
            _, results = self._recorded.results(variables, compiles=False)
        else:
            results, _ = self._program.forward(variables)
        form = self.specification.state
        _, values, _, _ = form.take(outputs.build(results), "the step", self.number, self.outer)
        slots = form.variables(outputs.build(outputs.slots))
        returned = form.variables(outputs.build(results))
        if not (all(map(_is_same_kind, returned, values)) and all(type(slot) is Slot for slot in slots)):
            return None
        return [outputs.slots.index(slot) for slot in slots]

    def _variables(self, state: State) -> list:
        """Return the variables of the arguments of the step that begins at a state."""
        variables = state.values + self.plain_params
        for block in self.inputs:
            variables.append(block[state.i])
        return variables

    def step(self, state: State, is_taped: bool) -> State:
        """Return the state after one step; if `is_taped`, store what the backward pass needs in the given state."""
        self.current = state
        variables = self._variables(state)
        if is_taped:
            program = self._program
            if not self._is_prepared:
                self._is_prepared = True
                program.compile()
            if not program.is_checked:
                self._recorded.pullback(program.nums, variables)
            results, saved = program.forward(variables)
            state.tape = (saved,)
        else:
            _, results = self._recorded.results(variables)
        return State(state.i + 1, [results[place] for place in self._order], state.statics)

    def compiled_loop(self) -> CompiledLoop | None:
        """Return all steps as machine code, if the user wants it and if it is possible."""
        if not self._recorded.jitted.compiles or not all(map(is_plain_number, self.first.values)):
            return None
        loop = None
        if self._program is not None:
            loop = self._program.compiled_loop(self._order, len(self.params))
        else:
            program, _ = self._recorded.value_program()
            loop = self._recorded.compiled_loop((program.parts, None), self._order, len(self.params))
        if loop is not None and not loop.is_checked:
            if not self._agrees(loop):
                self._recorded.refuse_loop(loop, loop.DIFFERENT)
                return None
            loop.is_checked = True
        return loop

    def _agrees(self, loop):
        """Return whether a loop of machine code agrees with the recorded programs for the first two steps."""
        n = min(self.specification.n, 2)
        program = self._program
        state = self.first
        tapes = []
        for _ in range(n):
            self.current = state
            variables = self._variables(state)
            if program is None:
                _, results = self._recorded.results(variables, compiles=False)
            else:
                if not program.is_checked:
                    self._recorded.pullback(program.nums, variables)
                results, saved = program.forward(variables)
                tapes.append(saved)
            state = State(state.i + 1, [results[place] for place in self._order], state.statics)
        trajectories = loop.trajectories(self.first.values, n + 1)
        saved_blocks = loop.saved_blocks(n)
        params = self.plain_params
        if not loop.forward(trajectories, params, self.inputs, saved_blocks, 0, n):
            return True  # not finite: the recorded programs run in any case
        agree = self._recorded.agree
        if not all(agree(value, block[n]) for value, block in zip(state.values, trajectories, strict=True)):
            return False
        if program is None:
            return True
        g = [random_like(value) for value in state.values]
        inputs = [block[:n] for block in self.inputs]
        result = loop.backward(trajectories, params, inputs, saved_blocks, g, None, n, 0, 0, 0, n)
        if result is None:
            return True
        backs, input_cotangents, _ = result
        sums: dict[int, Any] = {}
        rows: dict[int, list] = {}
        for saved in reversed(tapes):
            pulled = program.backward(*saved, *[g[place] for place in self._places])
            pulled = [
                zero_like(variables[num]) if back is None else back
                for num, back in zip(program.nums, pulled, strict=True)
            ]
            g = list(pulled[: self._n_state])
            for num, back in zip(program.nums[self._n_state :], pulled[self._n_state :], strict=True):
                if num < self._n_state + len(self.params):
                    sums[num] = sums.get(num, 0.0) + back
                else:
                    rows.setdefault(num, []).insert(0, back)
        expected = [*g, *sums.values(), *map(np.stack, rows.values())]
        first_input = self._n_state + len(self.params)
        results = backs[: self._n_state] + [backs[num] for num in sums]
        results += [input_cotangents[num - first_input] for num in rows]
        return all(map(agree, expected, results))

    def tape_size(self, state: State) -> int:
        """Return an estimate of the bytes that the tape of a state takes beside the state."""
        return self._program.saved_bytes

    def pulled_back(self, g: list, state: State, sums: dict, rows: list[list]) -> list | None:
        """Return the cotangents of a state with a tape, given those of the next state; None if no variable has one."""
        self.current = state
        (saved,) = state.tape
        if any(back is None for back in g):
            g = [zero_like(value) if back is None else back for back, value in zip(g, state.values, strict=True)]
        cotangents = [g[place] for place in self._places]
        if any(map(isbox, cotangents)):
            pulled = tuple(self._program.pull(saved, cotangents, self._variables(state)))
        else:
            pulled = self._program.backward(*saved, *cotangents)
        backs = list(pulled[: self._n_state])
        position = self._n_state
        for root in self._differentiated_params:
            back = pulled[position]
            position += 1
            if back is not None:
                sums[root] = added(sums.get(root), back)
        for row, root in zip(rows, self.input_roots, strict=True):
            if root:
                if pulled[position] is not None:
                    row[state.i] = pulled[position]
                position += 1
        specification = self.specification
        if state.i < specification.first_traced or state.i in specification.cuts:
            return None
        if all(back is None for back in backs):
            return None
        return backs


def is_plain_number(value: Any) -> bool:
    """Return whether a value is a number or array of NumPy of real numbers."""
    return isinstance(value, (np.ndarray, np.floating)) and value.dtype.char in "df"


def compiled_run(
    runner: StepRunner, plan: CheckpointPlan, outputs: LastState, progress: bool | str
) -> CompiledRun | None:
    """Run all steps as one call of machine code, if that is wanted and possible.

    Return None if the steps have to be run one by one: if the program of the step was not translated, with `memory` for
    fewer than all states and tapes, with `progress`, if a function sees each state, or if a state is not finite.
    """
    if not isinstance(runner, RecordedStepRunner) or progress or plan.is_reversing or not outputs.takes_trajectories:
        return None
    specification = runner.specification
    n = plan.n
    rows = 2
    if specification.differentiated:
        if plan.slots is not None and plan.slots < n:
            return None
        rows = n + 1
    elif outputs.enters_everywhere:
        if (n + 1) * specification.state.nbytes > MOST_BYTES and not outputs.holds_all_states:
            return None
        rows = n + 1
    loop = runner.compiled_loop()
    if loop is None or n * loop.saved_bytes > plan.tape_bytes and specification.differentiated:
        return None
    run = CompiledRun(runner, loop, rows)
    if not run.is_finite:
        return None
    outputs.start(runner)
    outputs.take(run.trajectories, run.last)
    return run


class CompiledRun:
    """A run of all steps as one call of machine code.

    Parameters
    ----------
    runner : RecordedStepRunner
    loop : CompiledLoop
    rows : int
        Number of states that are in memory at a time.

    Attributes
    ----------
    is_finite : bool
        Whether all states are finite.
    last : State
        The last state.
    trajectories : list of arrays
        For each variable of the state its values, state i in row ``i % rows``.
    """

    def __init__(self, runner: RecordedStepRunner, loop: CompiledLoop, rows: int) -> None:
        self._runner = runner
        self._loop = loop
        n = runner.specification.n
        self.trajectories = loop.trajectories(runner.first.values, rows)
        self._params = runner.plain_params
        self._saved = loop.saved_blocks(n)
        self.is_finite = loop.forward(self.trajectories, self._params, runner.inputs, self._saved, 0, n)
        self.last = State(n, [block[n % rows] for block in self.trajectories], runner.first.statics)

    def backward(
        self, outputs: LastState, cotangents: list, interval: int
    ) -> tuple[list, list[tuple[int, float]]] | None:
        """Run the backward pass.

        Parameters
        ----------
        outputs : LastState or SelectedStates
        cotangents : list of arrays
            Those of the results.
        interval : int
            Number of steps between two measurements of the cotangent.

        Returns
        -------
        cotangents : list
            Cotangents of the variables of all arguments; None for one that is not differentiated.
        norms : list of (int, float)
            Index of a state and the largest magnitude of an entry of its cotangent.

        None instead of both if a value is not finite.
        """
        runner = self._runner
        specification = runner.specification
        n = specification.n
        cuts = specification.cuts
        low = 0
        if cuts and not outputs.enters_everywhere:
            low = cuts[0]
        total = outputs.sources(n, cotangents)(self.last)
        entering = outputs.entering(n, cotangents)
        if total is None:
            total = [None] * len(self.last.values)
        total = [
            zero_like(value) if back is None else back for back, value in zip(total, self.last.values, strict=True)
        ]
        result = self._loop.backward(
            self.trajectories,
            self._params,
            runner.inputs,
            self._saved,
            total,
            entering,
            n,
            low,
            specification.first_traced,
            specification.truncate or 0,
            interval,
        )
        if result is None:
            return None
        backs, input_cotangents, sizes = result
        norms = [(n, largest(total))]
        for i in range((n - 1) // interval * interval, low - 1, -interval):
            if i not in cuts and i >= specification.first_traced:
                norms.append((i, float(sizes[i // interval])))
        n_state = len(self.last.values)
        is_reached = low == 0 and specification.first_traced == 0
        results: list = [back if is_reached else None for back in backs[:n_state]]
        for root, value, back in zip(runner.param_roots, runner.params, backs[n_state:], strict=True):
            results.append(root and fit("the step", value, back, back))
        for root, back in zip(runner.input_roots, input_cotangents, strict=True):
            results.append(root and back)
        return results, norms


def _is_same_kind(returned: Any, converted: Any) -> bool:
    """Return whether a result of a step needs no conversion to a number or contiguous array of the state's dtype."""
    if type(returned) is not type(converted) or returned.dtype != converted.dtype:
        return False
    return not isinstance(returned, np.ndarray) or returned.flags.c_contiguous
