"""rollout(): a time loop whose gradient costs one node on the tape."""

import warnings

import numpy as np

from sparsedp._utils.calls import frames_inside
from sparsedp._utils.counters import thread
from sparsedp._utils.pytree import leaves
from sparsedp._utils.validation import check_function, check_takes, check_whole
from sparsedp.autodiff.backend import collectively
from sparsedp.autodiff.tape import dtype_of, innermost, is_variable, isbox, plain, through
from sparsedp.autodiff.tape_constants import constant_args
from sparsedp.errors import BudgetWarning, DerivativeError, ShapeError
from sparsedp.trajectory.kept_states import kind
from sparsedp.trajectory.layout import Layout
from sparsedp.trajectory.memory_budget import advances, budget_within_reach, room_within, slots_within
from sparsedp.trajectory.run import Loop

__all__ = ["rollout"]

ROOM = 2**28  # bytes that tapes of steps may take, beside the states on them, where no budget is given


def rollout(
    step, state, params, n, inputs=None, memory=None, keep="last", truncate=None, *, progress=False, record=None
):
    """Step and first state -> the state after n steps, differentiable as one node on the tape.

    Parameters
    ----------
    step : callable
        ``step(state, params)``, or ``step(state, params, input)`` with inputs: the next state, of the same
        form. It uses only its arguments and constants, and changes none of them.
    state : array, number, or any nesting of them in tuples, lists and dicts
        Not modified. Leaves that are not floating (int, None, str) are handed along without a derivative.
    params : the same, or None
    n : int
        Number of steps.
    inputs : the same, optional
        What changes from step to step: step i gets entry i of the first axis of every array.
    memory : None, number of bytes, text such as "200 MB", or "reverse"
        What the rollout may take. None keeps every state. Else as many are kept as fit beside params, inputs
        and their gradients, and the others are run again from those, as rarely as possible. Where all fit, what
        is left goes to the tapes of the steps (with None 256 MB): such a step runs once, not twice. Not counted:
        what one step needs by itself, and what `keep` hands out; with keep="all" no state is run again.
        "reverse" keeps the last state alone, and goes back by ``step.back(state, params)``, the step turned round: for
        leapfrog without damping. Rounding makes the gradient a little off; where reversed steps miss the first state by
        more than 1e-8 of its size, 1e-4 in single precision, it is refused.
    keep : "last", "all", list of int or callable
        What is handed out: the last state; all n + 1, or those after so many steps (rising, 0 is the first state),
        each array with a new first axis, of a field on ranks a tuple; or the tuple of what ``keep(index, state)``
        returned for index = 0 ... n, any trees.
    truncate : int, optional
        Truncated back-propagation: state i counts as a constant for the steps after it wherever n - i is a
        multiple of `truncate`, 0 < i < n. The value is the same, derivatives of all orders are cut there.
    progress : bool or str
        Progress bars on standard error, a string is their label; needs the extra `plot`.
    record : callable, optional
        ``record(one)`` after every run over the steps, forward and backward: steps, states kept, steps run
        again, growth of the cotangent. For example ``record=runs.append``.

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
        If state, params or inputs hold NaN or infinity, or a step makes some, or the way back does.
    DerivativeError
        If the step or `keep` uses a traced value that is not an argument, or what one of them stored is used later; if
        a derivative is asked of a state without floating numbers; if a step or `keep` that is run again gives another
        result.
    ImportError
        If a progress bar is wanted and tqdm is not installed.

    Warns
    -----
    GrowthWarning
        If the cotangent of the state grew by more than 1e8: a chaotic run. The gradient is exact; nothing is cut.
    BudgetWarning
        If a third of the runs of steps would do with at most twice the memory; it says how much is needed.

    Notes
    -----
    Cost: n steps forward; backward n steps on a tape of their own, unless it is kept, plus those run again:
    with s states kept and at most r runs over each step, n <= (s + r)! / (s! r!) steps go back. The gradient
    has the same bits for every `memory`. A derivative forward costs the memory of one step, that of a gradient (`hvp`)
    twice the memory of the gradient; the gradient of a gradient has all calls of both on its tape. A step with a
    derivative of its own is one made by `differentiable`.

    The states gone back through are those of one run that ends, bit by bit, in what was handed out: a step on its
    tape must give the state after it, and states that are run again must lead to those kept. Large ones are compared
    by 64 bits that are made of all of theirs.

    Source
    ------
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
    n = _number_of_steps(n)
    given = {"state": state, "params": params} | ({} if inputs is None else {"inputs": inputs})
    forms = [Layout(tree, name) for name, tree in given.items()]
    _check_inputs(inputs, n)
    example = "lambda state, params: ..." if inputs is None else "lambda state, params, input: ..."
    check_takes("rollout", step, 2 if inputs is None else 3, example)
    values = [form.variables(tree) for tree, form in zip(given.values(), forms)]
    args = [value for part in values for value in part]
    traced = [k for k, arg in enumerate(args) if isbox(arg)]
    if traced:  # what is kept on the way forward must be what the way back sees
        args = constant_args(args, traced)
    beside = sum((1 + any(map(isbox, part))) * form.nbytes for form, part in zip(forms[1:], values[1:]))  # a gradient
    sizes = max(forms[0].nbytes, 1), n, beside  # an empty state takes a place among those kept, too
    if memory == "reverse":
        _check_reversible(step)
    slots = None if memory is None else 0 if memory == "reverse" else slots_within(memory, *sizes)
    if truncate is not None:
        check_whole("truncate of rollout", truncate, 1, "; leave it out and nothing is cut")
    room = ROOM if memory is None else room_within(memory, *sizes) if slots else 0
    loop = Loop(step, forms, n, truncate, innermost(args), kind(keep, forms[0], n), slots, room, progress, record)
    _check_values(loop, args, traced)
    if loop.wanted and loop.slots:
        _warn_of_repeats(memory, *sizes)
    for hook in thread.loop_hooks:
        hook(step, state, params, inputs, n)
    result = collectively("rollout", tuple(given.values()), through, loop, loop.wanted, *args)
    return loop.keep.tree(loop.parts(result))


def _check_reversible(step):
    """Refuse a step that cannot be turned round."""
    if not callable(getattr(step, "back", None)):
        raise ValueError(
            f"memory='reverse' needs a step with step.back(state, params), got {step!r}; write memory='200 MB', or "
            "make it by stepper('leapfrog', ...)"
        )
    getattr(step, "check_reversible", lambda: None)()


def _number_of_steps(n):
    if isbox(n):
        raise DerivativeError("rollout needs n as a plain whole number, got a traced value; it has no derivative")
    return check_whole("n of rollout", n, 0, "; give the number of steps")


def _check_inputs(inputs, n):
    for leaf in leaves(inputs):
        if is_variable(leaf) or isinstance(leaf, np.ndarray):
            shape = np.shape(plain(leaf))
            if shape[:1] != (n,):
                raise ShapeError(f"inputs need a first axis of n = {n} entries, got an array of shape {shape}")


def _warn_of_repeats(memory, size, n, beside):
    more = budget_within_reach(memory, size, n, beside)
    if more is not None:
        few, many = ((advances(n, slots_within(b, size, n, beside)) + 1) / n for b in (more, memory))
        warnings.warn(
            BudgetWarning(
                f"rollout runs {n} steps {many:.3g} times each within memory={memory!r}, and {few:.3g} times with "
                f"more; write memory={more}"
            ),
            stacklevel=frames_inside() + 1,
        )


def _check_values(loop, args, traced):
    for layout, values in zip(loop.layouts, loop.split(args), strict=False):
        layout.check_finite(values, "rollout")
    for k in traced:
        if dtype_of(args[k]).kind not in "fc":
            raise DerivativeError(
                f"{loop.names[k]} of rollout is traced but holds {dtype_of(args[k])}; derivatives need floating numbers"
            )
    if traced and not loop.state.places:
        kinds = ", ".join(sorted({str(dtype_of(leaf)) for leaf in loop.state.statics if leaf is not None}))
        raise DerivativeError(
            f"a gradient through rollout needs a state of floating numbers, got {kinds or 'nothing'}; "
            "write np.asarray(state, float)"
        )
