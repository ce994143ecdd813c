"""rollout(): a time loop whose gradient is one node on the tape."""

from __future__ import annotations

import os
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.calls import frames_inside
from sparsedp._utils.counters import thread
from sparsedp._utils.pytree import leaves
from sparsedp._utils.validation import check_function, check_integer, check_takes, check_whole
from sparsedp.autodiff.backend import collectively
from sparsedp.autodiff.jit import Jitted, opaque
from sparsedp.autodiff.program_trace import open_traces
from sparsedp.autodiff.tape import dtype_of, innermost, is_variable, isbox, plain, recording_trace, through
from sparsedp.autodiff.tape_constants import constant_args
from sparsedp.errors import BudgetWarning, DerivativeError, ShapeError
from sparsedp.trajectory.checkpoint_plan import (
    CheckpointPlan,
    advances,
    budget_within_reach,
    bytes_of,
    slots_within,
    tape_bytes_within,
)
from sparsedp.trajectory.disk_states import free_bytes
from sparsedp.trajectory.outputs import make_outputs
from sparsedp.trajectory.passes import RolloutRule
from sparsedp.trajectory.specification import ArgumentForm, RolloutSpecification, contiguous, is_array

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from sparsedp.trajectory.record import Record

__all__ = ["rollout"]

TAPE_BYTES = 2**28  # memory for the tapes of steps if the user gives no `memory`


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
    disk: str | os.PathLike[str] | tuple[str | os.PathLike[str], float | str] | None = None,
    progress: bool | str = False,
    record: Callable[[Record], Any] | None = None,
) -> Any:
    """Run a time loop of n steps, differentiable as one node on the tape.

    Parameters
    ----------
    step : callable
        ``step(state, params)``, or ``step(state, params, input)`` if there are inputs. It returns the next state, with
        the same tree structure, shapes and dtypes. It uses only its arguments and constants, and does not modify them.
    state : array, number, or any nesting of them in tuples, lists and dicts
        The first state; it is not modified. Leaves that are not floating (int, None, str) are passed to the step and
        have no derivative.
    params : array, number, tree of these, or None
    n : int
        Number of steps. For steps of length dt up to the time T, write ``round(T / dt)``.
    inputs : array or tree of arrays, optional
        Values that change from step to step: step i gets entry i along the first axis of every array.
    memory : None, number of bytes, text such as "200 MB", or "reverse"
        Memory that the rollout may use. None keeps every state. With a number of bytes, the rollout keeps the states
        that fit into the memory beside params, inputs and their gradients, and computes the other states again from
        these, with as few repeated steps as possible. If all states fit, the remaining memory (256 MB with None) holds
        tapes of steps; a step whose tape is kept is run once instead of twice. The memory that one step needs for its
        own work and the memory of the result are not counted. With keep="all" no state is computed again.
        "reverse" keeps only the last state, and the backward pass computes earlier states by the reversed step
        ``step.back(state, params)``, which leapfrog without damping has. The gradient then has a rounding error. If
        the reversed steps miss the first state by more than 1e-8 of its size (1e-4 in single precision), a
        DerivativeError is raised.
    keep : "last", "all", list of int or callable
        What is returned. "last": the last state. "all": all n + 1 states. A list of int, in increasing order: the
        states after these numbers of steps (0 is the first state). States are stacked along a new first axis of each
        array; distributed fields are returned as a tuple. A callable: the tuple of the trees that
        ``keep(index, state)`` returned for index = 0 ... n.
    truncate : int, optional
        Truncated back-propagation: each state i with 0 < i < n for which n - i is a multiple of `truncate` is treated
        as a constant by the steps after it. This changes derivatives of all orders, not the value.
    disk : path or (path, number of bytes or text such as "20 GB"), optional
        Folder for the states that do not fit into `memory`. Up to the given number of bytes, by default half of the
        free space, are used there, so that fewer steps are run again. The files are removed when the backward pass
        ends. If it is interrupted or the process is killed, they remain, and the same call continues from them; see
        Notes.
    progress : bool or str
        True shows progress bars on standard error; a string does so and is their label. Needs the extra `plot`.
    record : callable, optional
        Called as ``record(entry)`` after every forward and backward pass. The entry has the number of steps, of states
        kept and of steps run again, and the growth of the cotangent. For example ``record=runs.append``.

    Returns
    -------
    tree
        New arrays, with the dtypes of `state`; for a callable `keep`, see there.

    Raises
    ------
    TypeError
        If n is not an integer; a float such as 3.0 is not one.
    ValueError
        If n, memory, disk, keep or truncate is out of range, or if the step changes one of its arguments.
    ShapeError
        If a state differs from the first one in tree structure, shape or dtype, or if the first axis of an array of
        inputs does not have n entries.
    NonFiniteError
        If state, params or inputs contain NaN or infinity, or if a step or the backward pass produces NaN or infinity.
    DerivativeError
        If the step or `keep` uses a traced value that is not one of its arguments; if a traced value that the step or
        `keep` stored is used after the call; if a derivative is requested but the state has no floating values; if a
        step or `keep` returns a different result when it is run again; if a second derivative is requested with `disk`.
    OSError
        If a file cannot be written or read in the folder `disk`.
    ImportError
        If `progress` is used and tqdm is not installed.

    Warns
    -----
    GrowthWarning
        If the cotangent of the state grew by a factor of more than 1e8, as in a chaotic run. The gradient is exact and
        is not clipped.
    BudgetWarning
        If at most twice the memory would reduce the number of step evaluations to a third. The warning says how much
        memory is needed.

    See Also
    --------
    flow_step, stepper, ensemble, explain, jit

    Notes
    -----
    Cost: the forward pass runs n steps. The backward pass repeats, on a tape, every step whose tape was not
    kept, and repeats other steps to recompute states: with s states kept and each step run at most r times,
    n <= (s + r)! / (s! r!) steps can be differentiated. The gradient is the same bit for bit for every `memory` in
    bytes. A forward derivative needs the memory of one step, and the derivative of a gradient (`hvp`) twice the memory
    of the gradient. The gradient of a gradient records all calls of both passes on its tape.
    A step decorated with `differentiable` uses a hand-written derivative.
    A jitted step (see `jit`) runs as a program in both passes, without a tape, under every option except
    memory="reverse". This shortens runs of small states several times.

    The backward pass differentiates one run of steps that ends, bit for bit, in the result: whenever it runs a step
    again on a tape, it compares the next state with the one that it used before, by fingerprints of 64 bits. With
    memory="reverse" only the first state is compared, up to rounding.

    With `disk`, a run that was interrupted by Ctrl-C, ``sys.exit()`` or the end of the process is continued if the
    arguments and the step are the same. A step is the same if its code is, and everything that it refers to: numbers,
    arrays, functions and operators in its closure and in global variables. Objects of other classes and the content of
    other modules are not compared. If a step refers to those, the steps after the last state in a file are run again,
    too, and must give the same last state; the backward pass compares the other states. States are written as the run
    proceeds, and the cotangents of the backward pass at most every 30 seconds. Only keep="last", with a state of
    floating arrays, can be continued. Ctrl-C and ``sys.exit()`` keep the files of the rollout that is running, not
    those of other rollouts in the same loss. Use a folder on a local disk; several runs may use it at the same time.

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
    n = check_integer("n of rollout", n, 0, "; for a time T write round(T / dt)")
    trace = recording_trace(leaves((state, params, inputs))) if open_traces else None
    if trace is not None:
        jitted = step
        if memory != "reverse" and not isinstance(step, Jitted):
            jitted = trace.owner.related(step, falls_back=True)
        return opaque(rollout)(
            jitted, state, params, n, inputs, memory, keep, truncate, disk=disk, progress=progress, record=record
        )
    trees = {"state": state, "params": params}
    if inputs is not None:
        trees["inputs"] = inputs
    forms = list(map(ArgumentForm, trees.values(), trees))
    _check_inputs(inputs, n)
    if inputs is None:
        check_takes("rollout", step, 2, "lambda state, params: ...")
    else:
        check_takes("rollout", step, 3, "lambda state, params, input: ...")
    args = []
    memory_beside = 0  # bytes of params and inputs, and of their gradients
    for form, tree in zip(forms, trees.values()):
        variables = list(map(contiguous, form.variables(tree)))
        args += variables
        if form is not forms[0]:
            memory_beside += (1 + any(map(isbox, variables))) * form.nbytes
    traced = []
    for position, arg in enumerate(args):
        if isbox(arg):
            traced.append(position)
    if traced:  # copy the constants: the caller may change them before the backward pass
        args = constant_args(args, traced)
    if truncate is not None:
        check_whole("truncate of rollout", truncate, 1, "; leave it out and nothing is cut")
    outputs = make_outputs(keep, forms[0], n)
    plan = _checkpoint_plan(step, memory, max(forms[0].nbytes, 1), n, memory_beside, outputs.holds_all_states)
    folder = None
    if disk is not None:
        _check_disk(memory, outputs.holds_all_states, args)  # before the folder is created
        folder, limit = _folder_and_limit(disk)
        plan = plan.with_files(limit // max(forms[0].nbytes, 1))
    outputs.is_exact = not plan.is_reversing
    specification = RolloutSpecification(step, forms, n, truncate, innermost(args))
    _check_values(specification, args, traced)
    if specification.differentiated and plan.slots and not plan.disk_slots:
        _warn_of_repeats(memory, max(forms[0].nbytes, 1), n, memory_beside)
    rule = RolloutRule(specification, plan, outputs, progress, record, folder)
    for hook in thread.loop_hooks:
        hook(step, state, params, inputs, n)
    arguments = tuple(trees.values())
    result = collectively("rollout", arguments, through, rule, specification.differentiated, *args)
    return outputs.tree(rule.parts(result))


def _folder_and_limit(disk: Any) -> tuple[Any, int]:
    """Return the path of the folder in the argument `disk`, and the bytes that may be used there."""
    folder = disk
    limit = None
    if isinstance(disk, tuple) and len(disk) == 2:
        folder, limit = disk
    if not isinstance(folder, (str, os.PathLike)) or not os.fspath(folder):
        raise TypeError(f'disk of rollout must be a path or a pair (path, "20 GB"), got {disk!r}')
    folder = os.path.abspath(folder)  # the backward pass may run in another working directory
    if limit is None:
        return folder, free_bytes(folder)
    return folder, bytes_of(limit, "disk")


def _check_disk(memory: Any, holds_all_states: bool, args: Sequence) -> None:
    """Raise an error for arguments that cannot be used together with `disk`."""
    if memory is None or memory == "reverse":
        raise ValueError(
            f"disk of rollout needs memory as bytes or text, got memory={memory!r}; write memory='2 GB', and the "
            "states that do not fit into it go to files"
        )
    if holds_all_states:
        raise ValueError("keep='all' returns every state in memory, so that disk has no effect; leave disk out")
    if not all(is_array(plain(arg)) for arg in args):
        raise TypeError("disk of rollout cannot be used with distributed fields; leave it out")


def _check_inputs(inputs: Any, n: int) -> None:
    for leaf in leaves(inputs):
        if is_variable(leaf) or isinstance(leaf, np.ndarray):
            shape = np.shape(plain(leaf))
            if shape[:1] != (n,):
                raise ShapeError(f"inputs need a first axis of n = {n} entries, got an array of shape {shape}")


def _checkpoint_plan(
    step: Callable, memory: float | str | None, state_bytes: int, n: int, beside: int, holds_all_states: bool
) -> CheckpointPlan:
    """Return the checkpoint plan for a given `memory`."""
    if memory is None:
        return CheckpointPlan(n, None, TAPE_BYTES)
    if memory == "reverse":
        _check_reversible(step)
        return CheckpointPlan(n, None if holds_all_states else 0, 0, is_reversing=True)
    slots = slots_within(memory, state_bytes, n, beside)
    tape_bytes = tape_bytes_within(memory, state_bytes, n, beside)
    return CheckpointPlan(n, None if holds_all_states else slots, tape_bytes)


def _check_reversible(step: Callable) -> None:
    """Raise ValueError if a step cannot be reversed."""
    if not callable(getattr(step, "back", None)):
        raise ValueError(
            f"memory='reverse' needs a step with step.back(state, params), got {step!r}; write memory='200 MB', or "
            "take a step from stepper('leapfrog', ...)"
        )
    if hasattr(step, "check_reversible"):
        step.check_reversible()


def _warn_of_repeats(memory: Any, state_bytes: int, n: int, beside: int) -> None:
    """Warn if at most twice the memory would avoid most of the repeated steps."""
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
    """Raise an error for values that are not finite, and for traced values that cannot have a derivative."""
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
