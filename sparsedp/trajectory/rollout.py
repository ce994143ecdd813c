"""rollout(): a time loop whose gradient is one node on the tape."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.calls import frames_inside
from sparsedp._utils.counters import thread
from sparsedp._utils.pytree import leaves
from sparsedp._utils.validation import check_function, check_takes, check_whole
from sparsedp.autodiff.backend import collectively
from sparsedp.autodiff.tape import dtype_of, innermost, is_variable, isbox, plain, through
from sparsedp.autodiff.tape_constants import constant_args
from sparsedp.errors import BudgetWarning, DerivativeError, ShapeError
from sparsedp.trajectory.checkpoint_plan import (
    CheckpointPlan,
    advances,
    budget_within_reach,
    slots_within,
    tape_bytes_within,
)
from sparsedp.trajectory.outputs import make_outputs
from sparsedp.trajectory.passes import RolloutRule
from sparsedp.trajectory.specification import ArgumentForm, RolloutSpecification, contiguous

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from sparsedp.trajectory.record import Record

__all__ = ["rollout"]

TAPE_BYTES = 2**28  # for tapes of steps, where no memory is given


def rollout(
    step: Callable,
    state: Any,
    params: Any,
    n: int,
    inputs: Any = None,
    memory: float | str | None = None,
    keep: str | Sequence[int] | Callable[[int, Any], Any] = "last",
    truncate: int | None = None,
    *,
    progress: bool | str = False,
    record: Callable[[Record], Any] | None = None,
) -> Any:
    """Run a time loop of n steps, differentiable as one node on the tape.

    Parameters
    ----------
    step : callable
        ``step(state, params)``, or ``step(state, params, input)`` with inputs: the next state, of the same
        form. It uses only its arguments and constants, and does not modify them.
    state : array, number, or any nesting of them in tuples, lists and dicts
        Not modified. Leaves that are not floating (int, None, str) are passed on without a derivative.
    params : array, number, tree of these, or None
    n : int
        Number of steps.
    inputs : array or tree of arrays, optional
        Values that change from step to step: step i gets entry i of the first axis of every array.
    memory : None, number of bytes, text such as "200 MB", or "reverse"
        Memory of the rollout. None keeps every state. Otherwise as many are kept as fit beside params, inputs
        and their gradients, and the others are computed again from those, as rarely as possible. Where all fit, the
        remaining memory holds tapes of steps (with None 256 MB): such a step runs once, not twice. Not counted:
        the memory that one step needs by itself, and the result; with keep="all" no state is computed again.
        "reverse" keeps the last state alone, and the backward pass calls ``step.back(state, params)``, the reversed
        step: for leapfrog without damping. The gradient then has an error of rounding; where reversed steps miss the
        first state by more than 1e-8 of its size, 1e-4 in single precision, it is refused.
    keep : "last", "all", list of int or callable
        The result: the last state; all n + 1, or those after the listed numbers of steps (rising, 0 is the first
        state), each array with a new first axis, of a field on ranks a tuple; or the tuple of the trees that
        ``keep(index, state)`` returned for index = 0 ... n.
    truncate : int, optional
        Truncated back-propagation: state i counts as a constant for the steps after it wherever n - i is a
        multiple of `truncate`, 0 < i < n. The value is the same, derivatives of all orders are cut there.
    progress : bool or str
        Progress bars on standard error, a string is their label; needs the extra `plot`.
    record : callable, optional
        Called as ``record(entry)`` after every forward and backward pass: steps, states kept, steps run again,
        growth of the cotangent. For example ``record=runs.append``.

    Returns
    -------
    tree
        Fresh arrays, with the dtypes of `state`.

    Raises
    ------
    ValueError
        If n, memory, keep or truncate is out of range; if the step changes one of its arguments.
    ShapeError
        If a state has another form, shape or dtype than the first, or inputs have not n entries.
    NonFiniteError
        If state, params or inputs hold NaN or infinity, or a step or the backward pass makes some.
    DerivativeError
        If the step or `keep` uses a traced value that is not an argument, or a value that one of them stored is used
        later; if a derivative is requested of a state without floating numbers; if a step or `keep` that is run again
        gives another result.
    ImportError
        If a progress bar is wanted and tqdm is not installed.

    Warns
    -----
    GrowthWarning
        If the cotangent of the state grew by more than 1e8: a chaotic run. The gradient is exact; nothing is cut.
    BudgetWarning
        If at most twice the memory would reduce the runs of steps to a third; it says how much is needed.

    See Also
    --------
    flow_step, stepper, ensemble, explain

    Notes
    -----
    Cost: n steps forward; backward n steps on a tape of their own, unless it is kept, plus those run again:
    with s states kept and at most r runs over each step, n <= (s + r)! / (s! r!) steps can be reversed. The gradient
    has the same bits for every `memory`. A forward derivative costs the memory of one step, the derivative of a
    gradient (`hvp`) twice the memory of the gradient; the gradient of a gradient has all calls of both on its tape.
    `differentiable` gives a step a hand-written derivative.

    The states of the backward pass are those of one run that ends, bit by bit, in the result: a step on its
    tape must give the state after it, and states that are run again must lead to those kept. Large ones are compared
    by a fingerprint of 64 bits.

    References
    ----------
    A. Griewank, A. Walther, ACM Trans. Math. Softw. 26 (2000) 19-45 (binomial checkpoints).

    Examples
    --------
    >>> from sparsedp import value_and_grad
    >>> decay = lambda u, rate: u - 0.5 * rate * u
    >>> rollout(decay, 16.0, 1.0, 3)
    2.0
    >>> value_and_grad(lambda rate: rollout(decay, 16.0, rate, 3))(1.0)
    (2.0, -6.0)
    >>> rollout(decay, 16.0, 1.0, 3, keep="all")
    array([16.,  8.,  4.,  2.])
    >>> rollout(decay, 16.0, 1.0, 3, keep=[1, 3])
    array([8., 2.])
    """
    check_function("rollout", step, "lambda state, params: ...")
    if isbox(n):
        raise DerivativeError("rollout needs n as a plain whole number, got a traced value; it has no derivative")
    n = check_whole("n of rollout", n, 0, "; give the number of steps")
    trees = {"state": state, "params": params}
    if inputs is not None:
        trees["inputs"] = inputs
    forms = [ArgumentForm(tree, name) for name, tree in trees.items()]
    _check_inputs(inputs, n)
    if inputs is None:
        check_takes("rollout", step, 2, "lambda state, params: ...")
    else:
        check_takes("rollout", step, 3, "lambda state, params, input: ...")
    args = []
    memory_beside = 0  # of params and inputs, and of their gradients
    for form, tree in zip(forms, trees.values()):
        variables = list(map(contiguous, form.variables(tree)))
        args += variables
        if form is not forms[0]:
            memory_beside += (1 + any(map(isbox, variables))) * form.nbytes
    traced = [position for position, arg in enumerate(args) if isbox(arg)]
    if traced:  # the backward pass must see the values of the forward pass
        args = constant_args(args, traced)
    if truncate is not None:
        check_whole("truncate of rollout", truncate, 1, "; leave it out and nothing is cut")
    outputs = make_outputs(keep, forms[0], n)
    plan = _checkpoint_plan(step, memory, max(forms[0].nbytes, 1), n, memory_beside, outputs.holds_all_states)
    outputs.is_exact = not plan.is_reversing
    specification = RolloutSpecification(step, forms, n, truncate, innermost(args))
    _check_values(specification, args, traced)
    if specification.differentiated and plan.slots:
        _warn_of_repeats(memory, max(forms[0].nbytes, 1), n, memory_beside)
    rule = RolloutRule(specification, plan, outputs, progress, record)
    for hook in thread.loop_hooks:
        hook(step, state, params, inputs, n)
    arguments = tuple(trees.values())
    result = collectively("rollout", arguments, through, rule, specification.differentiated, *args)
    return outputs.tree(rule.parts(result))


def _check_inputs(inputs: Any, n: int) -> None:
    for leaf in leaves(inputs):
        if is_variable(leaf) or isinstance(leaf, np.ndarray):
            shape = np.shape(plain(leaf))
            if shape[:1] != (n,):
                raise ShapeError(f"inputs need a first axis of n = {n} entries, got an array of shape {shape}")


def _checkpoint_plan(
    step: Callable, memory: float | str | None, state_bytes: int, n: int, beside: int, holds_all_states: bool
) -> CheckpointPlan:
    """Return the plan for a memory. An empty state counts as one byte: it takes a place among those kept, too."""
    if memory is None:
        return CheckpointPlan(n, None, TAPE_BYTES)
    if memory == "reverse":
        _check_reversible(step)
        return CheckpointPlan(n, None if holds_all_states else 0, 0, is_reversing=True)
    slots = slots_within(memory, state_bytes, n, beside)
    tape_bytes = tape_bytes_within(memory, state_bytes, n, beside)
    return CheckpointPlan(n, None if holds_all_states else slots, tape_bytes)


def _check_reversible(step: Callable) -> None:
    """Refuse a step that cannot be reversed."""
    if not callable(getattr(step, "back", None)):
        raise ValueError(
            f"memory='reverse' needs a step with step.back(state, params), got {step!r}; write memory='200 MB', or "
            "take a step from stepper('leapfrog', ...)"
        )
    if hasattr(step, "check_reversible"):
        step.check_reversible()


def _warn_of_repeats(memory: Any, state_bytes: int, n: int, beside: int) -> None:
    """Warn if a little more memory would avoid most repeated steps."""
    larger = budget_within_reach(memory, state_bytes, n, beside)
    if larger is not None:
        runs = (advances(n, slots_within(memory, state_bytes, n, beside)) + 1) / n
        fewer = (advances(n, slots_within(larger, state_bytes, n, beside)) + 1) / n
        warnings.warn(
            BudgetWarning(
                f"rollout runs {n} steps {runs:.3g} times each within memory={memory!r}, and {fewer:.3g} times with "
                f"more; write memory={larger}"
            ),
            stacklevel=frames_inside() + 1,
        )


def _check_values(specification: RolloutSpecification, args: Sequence, traced: Sequence[int]) -> None:
    """Refuse values that are not finite, and traced ones without a derivative."""
    for form, values in zip(specification.forms, specification.split(args), strict=False):
        form.check_finite(values, "rollout")
    for position in traced:
        dtype = dtype_of(args[position])
        if dtype.kind not in "fc":
            raise DerivativeError(
                f"{specification.names[position]} of rollout is traced but holds {dtype}; derivatives need floating "
                "numbers"
            )
    if traced and not specification.state.places:
        dtypes = {str(dtype_of(leaf)) for leaf in specification.state.statics if leaf is not None}
        raise DerivativeError(
            "a gradient through rollout needs a state of floating numbers, got "
            f"{', '.join(sorted(dtypes)) or 'nothing'}; write np.asarray(state, float)"
        )
