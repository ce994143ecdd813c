"""Run the steps of a rollout by the programs of a jitted step: see `jit`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp.autodiff.derivative import zero_like
from sparsedp.autodiff.jit import Jitted, is_watched, tree_form
from sparsedp.autodiff.program_trace import Slot
from sparsedp.autodiff.tape import added, isbox
from sparsedp.errors import JitError
from sparsedp.trajectory.step_runner import State, StepRunner

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sparsedp.autodiff.jit import Outputs
    from sparsedp.trajectory.specification import RolloutSpecification

__all__ = ["recorded_runner"]


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
        self._params = variables[self._n_state : self._n_state + len(self.params)]
        self._recorded = step.recorded(form, arguments, {}, variables)
        self._program: Any = None
        if specification.differentiated:
            roots = [True] * self._n_state + self.param_roots + self.input_roots
            nums = tuple(num for num, root in enumerate(roots) if root)
            self._program = self._recorded.pullback(nums, variables)
            outputs = self._program.outputs
        else:
            outputs = self._recorded.outputs()
        if not outputs.state_is_known:
            outputs.state_places = self._state_places(outputs, variables)
            outputs.state_is_known = True
        self.keeps_form = outputs.state_places is not None
        # For each variable of the state its position among the results of the program.
        self._order = outputs.state_places or []
        # For each result of the program the position of its variable in the state.
        self._places = [self._order.index(place) for place in range(len(self._order))]
        self._differentiated_params = [root for root in self.param_roots if root]

    def _state_places(self, outputs: Outputs, variables: Sequence) -> list[int] | None:
        """Return for each variable of the state its position among the results of the program.

        Return None if the step does not keep the form of the state. Raise an error if its result is no such state.
        """
        if self._program is None:
            _, results = self._recorded.results(variables)
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
        variables = state.values + self._params
        for block in self.inputs:
            variables.append(block[state.i])
        return variables

    def step(self, state: State, is_taped: bool) -> State:
        """Return the state after one step; if `is_taped`, store what the backward pass needs in the given state."""
        self.current = state
        variables = self._variables(state)
        if is_taped:
            program = self._program
            if not program.is_checked:
                self._recorded.pullback(program.nums, variables)
            results, saved = program.forward(variables)
            state.tape = (saved,)
        else:
            _, results = self._recorded.results(variables)
        return State(state.i + 1, [results[place] for place in self._order], state.statics)

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


def _is_same_kind(returned: Any, converted: Any) -> bool:
    """Return whether a result of a step needs no conversion to a number or contiguous array of the state's dtype."""
    if type(returned) is not type(converted) or returned.dtype != converted.dtype:
        return False
    return not isinstance(returned, np.ndarray) or returned.flags.c_contiguous
