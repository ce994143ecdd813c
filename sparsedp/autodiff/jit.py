"""jit(): a function whose calls are recorded once and then replayed as a program, without a tape."""

from __future__ import annotations

import warnings
from contextlib import contextmanager
from functools import partial, update_wrapper
from importlib import import_module
from math import inf
from operator import getitem
from threading import RLock
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.base_classes import Reconstructible
from sparsedp._utils.calls import frames_inside
from sparsedp._utils.counters import active, thread
from sparsedp._utils.pytree import TreeStructure, child, flatten, keys, labels, leaves, placed
from sparsedp._utils.validation import check_function, check_leaves, check_native
from sparsedp.autodiff.backend import ARRAY_KINDS
from sparsedp.autodiff.derivative import (
    forward,
    gradient_of,
    hvp,
    name_of,
    random_like,
    taped,
    value_and_grad,
    zero_like,
)
from sparsedp.autodiff.program import compile_program, free_slots, needed_calls
from sparsedp.autodiff.program_trace import ProgramTrace, Slot, array_copy, opaque, open_traces, refuse_outer_trace
from sparsedp.autodiff.tape import (
    ForwardNode,
    Rule,
    VJPNode,
    dtype_of,
    forward_root,
    innermost,
    is_fresh,
    is_recorded,
    is_variable,
    isbox,
    new_box,
    new_trace,
    recording_trace,
    sample,
    through,
)
from sparsedp.autodiff.tape_constants import constant, constant_args
from sparsedp.errors import JitError, JitWarning, SparsedpError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from sparsedp.autodiff.program_trace import ProgramCall

__all__ = ["Jitted", "PullbackProgram", "gap", "tree_form", "is_watched", "jit", "opaque"]

FORMS_BEFORE_WARNING = 8
MOST_FORMS = 64  # programs of one function that are kept
# Parts of Python's and NumPy's messages for a traced value in a wrong place; the last one: in an index.
OF_TRACED_VALUES = (
    "ArrayBox",
    "object array",
    "dtype object",
    "dtype('O')",
    "setting an array element",
    "boolean ndarray",
    "only integers, slices",
)
# Largest accepted difference between a program and its function, relative to the largest entry, in units of eps.
VALUE_TOLERANCE = 1e4


def jit(function: Callable, check: bool = True, compile: bool = False) -> Jitted:
    """Return a function that records its first call and replays it as a program, without Python's overhead.

    The first call with arguments of a new form runs the function and records all calls of NumPy, rules, Operators and
    solves. Later calls with arguments of the same form execute these calls again with the new numbers. The form
    consists of the tree structure, the shapes and dtypes of floating arrays and numbers, and the values of all other
    leaves (integers, booleans, strings, None).

    Parameters
    ----------
    function : callable
        A pure function of trees of arrays. Whatever it uses apart from its arguments is a constant: the program keeps
        the value of the first call. It is written with autograd.numpy, Operators and other functions of this library;
        values of arrays must not decide what it does (``if``, ``while``, ``float()``).
    check : bool
        Whether each program is compared with the function once, in its next call with other numbers.
    compile : bool
        Whether programs are translated to machine code. For functions of small arrays, and for rollouts of such steps,
        whose loop becomes one call. The last bits of results may then differ from those of NumPy. Needs the extra
        `fast`. See Notes.

    Returns
    -------
    Jitted
        A function with the same arguments and results. `value_and_grad`, `grad`, `vjp`, `jvp`, `hvp`, `minimize` and
        `rollout` use its programs. On a tape each call is one node. In nested derivatives and for distributed fields it
        calls the function itself.

    Raises
    ------
    TypeError
        If `function` is not callable.
    ImportError
        If `compile` is used and llvmlite is not installed.
    JitError
        When the returned function is called: if the function makes a decision by values, or if its program differs from
        it because it is not pure.

    Warns
    -----
    JitWarning
        If more than eight forms were recorded. The warning names the argument that changes.

    See Also
    --------
    rollout, value_and_grad, check.jit

    Notes
    -----
    **Cost.** A recording takes about as long as ten calls. It pays for small arrays, where Python takes most of the
    time of a call. Use it for the step of a `rollout`, or for a whole loss.

    **Numbers.** Values are equal bit for bit to those of the function, and derivatives up to rounding. With `compile`,
    values are equal up to rounding too: `exp`, `log`, `tanh`, `pow` and others are those of the C library, which differ
    from NumPy's in the last bit for a few per cent of all arguments, and sums along axes have another order. NumPy's
    warnings, for example of a division by zero, are not issued.

    **Machine code.** Programs of arithmetic, functions of entries, comparisons, `where`, `sum`, `mean`, products of
    small matrices, Operators, and functions that move entries (slices, `roll`, `reshape`, `concatenate`) are translated
    by LLVM, the compiler of numba, in 0.1 to 1 s. Programs with any other call, a rule or a solve for example, and
    programs of complex numbers or integers remain as they are: ``jitted.not_compiled`` names these calls. A rollout is
    one call of machine code unless `memory` is a number, `progress` is used or `keep` is a function; then each step is
    one. Whenever a result is not finite, the recorded program runs instead, with its checks and errors.

    Examples
    --------
    >>> import sparsedp as dp
    >>> loss = dp.jit(lambda x: np.sum(x**2))
    >>> dp.value_and_grad(loss)(np.array([1.0, 2.0]))
    (5.0, array([2., 4.]))
    """
    check_function("jit", function, "lambda x: ...")
    if compile:
        import_module("sparsedp.autodiff.compiled_program")  # raises ImportError without llvmlite
    return Jitted(function, bool(check), compiles=bool(compile))


class Jitted(Reconstructible):
    """A function that is recorded once for each form of its arguments; see `jit`.

    Attributes
    ----------
    function : callable
        The function itself.
    forms : int
        Number of forms that were recorded.
    not_compiled : tuple of str
        With ``compile=True``: the calls because of which programs were not translated to machine code.
    """

    def __init__(
        self, function: Callable, check: bool = True, falls_back: bool = False, compiles: bool = False
    ) -> None:
        self.function = function
        self.name = name_of(function)
        self.check = check
        self.falls_back = falls_back
        self.compiles = compiles
        self._reasons: dict[str, None] = {}  # why programs were not compiled, in order
        self._recorded: dict[Any, Recorded] = {}
        self._gradients: dict[int, Jitted] = {}
        self._hessian_product: Jitted | None = None
        self._tangents: dict[tuple[int, ...], Jitted] = {}
        self._lock = RLock()
        self._warned = False
        self._is_refused = False
        self.forms = 0
        update_wrapper(self, function, updated=())

    def recipe(self) -> tuple[Callable, tuple]:
        """Return the call that constructs this object again."""
        return Jitted, (self.function, self.check, self.falls_back, self.compiles)

    def __repr__(self) -> str:
        text = f"jit of {self.name}: {self.forms} forms recorded"
        if self._reasons:
            text = f"{text}, not compiled because of {', '.join(self._reasons)}"
        return f"<{text}>"

    @property
    def not_compiled(self) -> tuple[str, ...]:
        """Return the calls because of which programs were not translated to machine code."""
        return tuple(self._reasons)

    def note_not_compiled(self, reason: str) -> None:
        """Note why a program was not translated to machine code."""
        if reason != "rollout":  # its steps are translated by themselves
            self._reasons[reason] = None

    def related(self, function: Callable, falls_back: bool) -> Jitted:
        """Return another function that is recorded with the same options, for a part or derivative of this one."""
        other = Jitted(function, self.check, falls_back, self.compiles)
        other._reasons = self._reasons
        return other

    def __call__(self, *args: Any, **options: Any) -> Any:
        """Call the function, by its program if there is one for arguments of this form."""
        if self._is_refused or is_watched():
            return self.function(*args, **options)
        variables: list = []
        form = tree_form((args, options), variables)
        nums = _differentiated(variables)
        if form is None or nums is None:
            if form is not None and _is_pushed(variables):
                return self._pushed(args, options)
            return self.function(*args, **options)
        try:
            recorded = self.recorded(form, args, options, variables)
            if not nums:
                return recorded.value(variables)
            program = recorded.pullback(nums, variables)
            program.compile()
        except JitError:
            if not self.falls_back:
                raise
            self._is_refused = True
            return self.function(*args, **options)
        rule = JittedRule(recorded.name, program)
        results = _separated(through(rule, nums, *variables), len(program.floating))
        return program.build(results, rule.others)

    def recorded(self, form: Any, args: tuple, options: dict, variables: list) -> Recorded:
        """Return the programs for arguments of a form."""
        recorded = self._recorded.get(form)
        if recorded is None:
            with self._lock:
                recorded = self._recorded.get(form)
                if recorded is None:
                    recorded = Recorded(self, args, options, variables)
                    self._add(form, recorded, (args, options))
        return recorded

    def _add(self, form: Any, recorded: Recorded, arguments: tuple) -> None:
        """Store the programs of a new form; warn if there are many."""
        if self.forms == FORMS_BEFORE_WARNING and not self._warned:
            self._warned = True
            last_form = next(reversed(self._recorded))
            warnings.warn(
                JitWarning(
                    f"dp.jit recorded {self.name} for {self.forms} forms of its arguments, and "
                    f"{_difference(last_form, form, arguments)}; pass it as a floating number, or leave out dp.jit"
                ),
                stacklevel=frames_inside() + 1,
            )
        if len(self._recorded) >= MOST_FORMS:
            del self._recorded[next(iter(self._recorded))]
        self._recorded[form] = recorded
        self.forms += 1

    def jitted_value_and_grad(self, argnum: int) -> Jitted:
        """Return the jitted function ``value_and_grad(function, argnum)``, which `value_and_grad` calls."""
        gradient = self._gradients.get(argnum)
        if gradient is None:
            gradient = self.related(value_and_grad(self.function, argnum), self.falls_back)
            gradient.name = f"value_and_grad({self.name})"
            gradient = self._gradients.setdefault(argnum, gradient)
        return gradient

    def jitted_hvp(self, x: Any, tangent: Any) -> Any:
        """Return ``hvp(function, x, tangent)`` by a program."""
        if self._hessian_product is None:
            product = self.related(partial(hvp, self.function), falls_back=True)
            product.name = f"hvp({self.name})"
            self._hessian_product = product
        return self._hessian_product(x, tangent)

    def _pushed(self, args: tuple, options: dict) -> Any:
        """Return the result in forward mode. Its values and its tangents are computed by a program."""
        entries, rebuild = flatten((args, options))
        places = tuple([place for place, entry in enumerate(entries) if isbox(entry)])
        trace = entries[places[0]]._trace
        tangents = tuple([entries[place]._node.g for place in places])
        plain_args, plain_options = rebuild([entry._value if isbox(entry) else entry for entry in entries])
        tangent_program = self._tangents.get(places)
        if tangent_program is None:
            tangent_program = self.related(partial(_value_and_tangent, self.function, places), falls_back=True)
            tangent_program.name = f"jvp({self.name})"
            tangent_program = self._tangents.setdefault(places, tangent_program)
        value, tangent = tangent_program(plain_args, plain_options, tangents)
        results, rebuild = flatten(value)
        for place, slope in enumerate(leaves(tangent)):
            if slope is not None:
                results[place] = new_box(results[place], trace, forward_root(slope))
        return rebuild(results)


def _value_and_tangent(function, places, args, options, tangents):
    """Return the value of a function and its tangent, for tangents of the leaves at some places of the arguments."""
    entries = leaves((args, options))
    directions: list = placed([None] * len(entries), places, tangents)
    return forward(lambda arguments: function(*arguments[0], **arguments[1]), (args, options), directions)


# ---- forms -----------------------------------------------------------------------------------------------------------


def tree_form(tree: Any, variables: list) -> Any:
    """Return the form of a tree as a hashable value, and append its floating leaves, plain or traced, to `variables`.

    Returns
    -------
    (tuple, tuple) or None
        The structure of the tree, and a form for each leaf. None for a tree with distributed fields.
    """
    structure: list = []
    leaf_forms: list = []
    if _append_form(tree, structure, leaf_forms, variables):
        return tuple(structure), tuple(leaf_forms)
    return None


def _append_form(tree, structure, leaf_forms, variables):
    """Append the forms of the branches and leaves of a tree; return False for a tree with distributed fields."""
    value = sample(tree)
    kind = type(value)
    if kind is np.ndarray:
        if value.dtype.kind in "fc":
            variables.append(tree)
            leaf_forms.append((value.shape, value.dtype, value.flags.c_contiguous or value.strides))
        elif value.dtype.hasobject:
            leaf_forms.append(_Identity(value))
        else:
            leaf_forms.append((value.shape, value.dtype, value.tobytes()))
        return True
    if kind is float or kind is complex or isinstance(value, np.inexact):
        variables.append(tree)
        leaf_forms.append(kind)
        return True
    if kind in ARRAY_KINDS:
        return False
    names = keys(tree)
    if names is None:
        leaf_forms.append((kind, value if _is_hashable(value) else _Identity(value)))
        return True
    structure.append((kind, *names))
    for name in names:
        if not _append_form(child(tree, name), structure, leaf_forms, variables):
            return False
    return True


def _is_hashable(value):
    try:
        hash(value)
    except TypeError:
        return False
    return True


class _Identity:
    """An object that cannot be hashed, compared by its identity."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Identity) and other.value is self.value

    def __hash__(self) -> int:
        return id(self.value)


def _difference(earlier, later, arguments):
    """Return words that say which leaf of the arguments makes two forms different."""
    args, options = arguments
    names = labels(args, "args") + labels(options, "options")
    if earlier[0] == later[0]:
        for name, before, after, leaf in zip(names, earlier[1], later[1], leaves(arguments), strict=True):
            if before != after:
                return f"{name} changes: now {_described(leaf)}"
    return "their tree structure changes"


def _described(leaf):
    if isinstance(leaf, np.ndarray):
        return f"an array of shape {leaf.shape} and dtype {leaf.dtype}"
    return repr(leaf)


def _differentiated(variables):
    """Return the positions of traced values whose calls can be one node on their tape.

    Return an empty tuple if no value is traced. Return None in forward mode, on nested traces, and while another
    program is recorded.
    """
    nums = []
    trace = None
    for num, value in enumerate(variables):
        if not isbox(value):
            continue
        if isbox(value._value) or not isinstance(value._node, VJPNode) or trace not in (None, value._trace):
            return None
        trace = value._trace
        nums.append(num)
    return tuple(nums)


def _is_pushed(variables):
    """Return whether all traced values belong to one trace of forward mode, with plain tangents."""
    boxes = [value for value in variables if isbox(value)]
    return all(
        isinstance(box._node, ForwardNode)
        and box._trace == boxes[0]._trace
        and not isbox(box._value)
        and not isbox(box._node.g)
        for box in boxes
    )


def is_watched() -> bool:
    """Return whether calls are counted or observed, which needs the calls inside the function."""
    return bool(active or thread.node_hooks or thread.solve_hooks or thread.loop_hooks)


# ---- programs --------------------------------------------------------------------------------------------------------


class Recorded:
    """The programs of a function for arguments of one form.

    Parameters
    ----------
    jitted : Jitted
        The function, its name, and whether each program is compared with the function once.
    args, options : tuple, dict
        Arguments of this form.
    variables : list
        Their floating leaves, plain or traced.
    """

    def __init__(self, jitted: Jitted, args: tuple, options: dict, variables: Sequence) -> None:
        self.name = jitted.name
        self.jitted = jitted
        self._check = jitted.check
        self._function = jitted.function
        self.first = [array_copy(sample(variable)) for variable in variables]
        self.eps = max([np.finfo(dtype_of(value)).eps for value in self.first], default=0.0)
        self._strided = [num for num, variable in enumerate(variables) if _is_strided(sample(variable))]
        check_leaves("args", (args, options))
        check_native("dp.jit", *self.first)
        entries = leaves((args, options))
        self.places = [place for place, leaf in enumerate(entries) if is_variable(leaf)]
        self._statics = [None if is_variable(leaf) else constant(leaf) for leaf in entries]
        self._rebuild = flatten(_without_leaves((args, options)))[1]
        self._pullbacks: dict[tuple, PullbackProgram] = {}
        self._value: Any = None
        self.value_is_checked = False
        self._loops: dict[tuple, Any] = {}
        # For a step of a rollout, by the number of variables of the state: for each of them its position among the
        # results, see `trajectory.recorded_steps`.
        self.orders: dict[int, list[int]] = {}

    def arguments(self, variables: Sequence) -> tuple[tuple, dict]:
        """Return the arguments of the function with the given floating leaves."""
        return self._rebuild(placed(self._statics, self.places, variables))

    def call(self, arguments: tuple) -> Any:
        """Call the function with a pair of its positional and keyword arguments."""
        args, options = arguments
        return self._function(*args, **options)

    def begin(self) -> tuple[ProgramTrace, list[Slot]]:
        """Return a new trace, and the slots of the variables."""
        trace = ProgramTrace(new_trace(), opaque_call)
        trace.owner = self.jitted
        return trace, [trace.slot(array_copy(value)) for value in self.first]

    def dense(self, variables: Sequence) -> Sequence:
        """Return the variables with copies of arrays that are not contiguous, in the layout of the recording."""
        if not self._strided:
            return variables
        return placed(variables, self._strided, [array_copy(variables[num]) for num in self._strided])

    def run(self, program: Callable[..., tuple], variables: Sequence) -> tuple:
        """Call a program with the variables; if it raises an error of this library, raise that of the function.

        The function wraps errors of its parts: it names the stage of a time step, for example.
        """
        try:
            return program(*self.dense(variables))
        except SparsedpError:
            self.call(self.arguments(variables))
            raise

    def value(self, variables: Sequence) -> Any:
        """Return the result of the function by its program."""
        outputs, results = self.results(variables)
        return outputs.build(results)

    def value_program(self) -> tuple[Executable, Outputs]:
        """Return the program of the function, and its outputs."""
        if self._value is None:
            self._value = self._record_value()
        return self._value

    def outputs(self) -> Outputs:
        """Return the outputs of the function."""
        return self.value_program()[1]

    def results(self, variables: Sequence, compiles: bool = True) -> tuple[Outputs, tuple]:
        """Return the outputs of the function, and their values by its program, checked once."""
        program, outputs = self.value_program()
        if compiles:
            program.compile()
        results = self.run(program.run, variables)
        if not self.value_is_checked and self._is_to_be_checked(variables):
            check_program(self.name, self.call(self.arguments(variables)), outputs.build(results), self.eps)
            self.value_is_checked = True
        return outputs, results

    def pullback(self, nums: tuple[int, ...], variables: Sequence) -> PullbackProgram:
        """Return the program of the function and of its VJP in the variables `nums`, checked at some variables."""
        program = self._pullbacks.get(nums)
        if program is None:
            program = self._pullbacks.setdefault(nums, PullbackProgram(self, nums))
        if not program.is_checked and self._is_to_be_checked(variables):
            program.compare([sample(variable) for variable in variables])
            program.is_checked = True
        return program

    def _is_to_be_checked(self, variables):
        """Return whether a program is compared at these variables.

        It is not compared at the arguments of the recording, where a frozen value would not be noticed.
        """
        return self._check and not all(map(_same, variables, self.first))

    def _record_value(self):
        trace, inputs = self.begin()
        boxes = list(map(trace.box, inputs))
        with _recording(self.name):
            result = self.call(self.arguments(boxes))
        outputs = Outputs(trace, inputs, result)
        return Executable(self, trace, needed_calls(trace.calls, outputs.slots), inputs, outputs.slots), outputs

    def compiled_loop(
        self, parts: tuple[Any, Any], order: Sequence[int], n_params: int, nums: Sequence[int] = (), n_saved: int = 0
    ) -> Any:
        """Return all steps of a rollout as machine code, None if that is not possible; see `CompiledLoop`."""
        from sparsedp.autodiff.compiled_program import CompiledLoop, NotCompiled

        key = tuple(order), n_params, tuple(nums)
        if key not in self._loops:
            self._loops[key] = None
            try:
                self._loops[key] = CompiledLoop(parts[0], parts[1], order, n_params, nums, n_saved)
            except NotCompiled as error:
                self.jitted.note_not_compiled(str(error))
        return self._loops[key]

    def refuse_loop(self, loop: Any, reason: str) -> None:
        """Do not use a `CompiledLoop` any more."""
        for key, recorded_loop in self._loops.items():
            if recorded_loop is loop:
                self._loops[key] = None
        self.jitted.note_not_compiled(reason)

    def agree(self, expected: Any, result: Any) -> bool:
        """Return whether a result of machine code equals that of the recorded program up to rounding."""
        return _agree(expected, result, self.eps)


class Executable:
    """A program: Python code or, once it has been compiled, machine code.

    Parameters
    ----------
    recorded : Recorded
    trace, calls, inputs, results
        The arguments of `compile_program`.

    Attributes
    ----------
    run : callable
        ``run(*inputs) -> results``.
    parts : tuple or None
        The parameters `trace`, `calls`, `inputs` and `results`, if machine code is wanted.
    """

    def __init__(
        self,
        recorded: Recorded,
        trace: ProgramTrace,
        calls: Sequence[ProgramCall],
        inputs: Sequence[Slot],
        results: Sequence[Any],
    ) -> None:
        self.run = compile_program(trace, calls, inputs, results)
        self.parts: tuple | None = None
        self._recorded = recorded
        if recorded.jitted.compiles:
            self.parts = trace, calls, inputs, results
        self._is_compiled = False

    def compile(self) -> None:
        """Translate the program to machine code, if that is wanted and possible."""
        if self._is_compiled or self.parts is None:
            return
        self._is_compiled = True
        from sparsedp.autodiff.compiled_program import CompiledProgram, NotCompiled

        recorded = self._recorded
        try:
            self.run = CompiledProgram(self.parts, self.run, recorded.agree, recorded.jitted.note_not_compiled)
        except NotCompiled as error:
            recorded.jitted.note_not_compiled(str(error))


def check_program(name: str, expected: Any, result: Any, eps: float) -> None:
    """Raise JitError if the result of a program differs from that of its function.

    `eps` is the rounding error of the least precise argument, which differences are compared with.
    """
    for place, (a, b) in enumerate(zip(leaves(expected), leaves(result), strict=True)):
        if not _agree(a, b, eps):
            raise JitError(
                f"the program of {name} differs from the function in result {place}: the function uses something that "
                "has changed, or random numbers, or values of traced arrays; pass what changes as an argument"
            )


def _agree(expected, actual, eps=0.0):
    """Return whether two leaves are equal up to rounding, numbers in any precision."""
    if is_variable(expected) and is_variable(actual) and np.ndim(expected) == np.ndim(actual) == 0:
        dtypes = dtype_of(expected), dtype_of(actual)
        eps = max(eps, *[np.finfo(dtype).eps for dtype in dtypes])
        common = np.result_type(*dtypes)
        expected = np.asarray(expected, common)
        actual = np.asarray(actual, common)
    return gap(expected, actual, eps) <= VALUE_TOLERANCE


def gap(expected: Any, actual: Any, eps: float = 0.0) -> float:
    """Return the largest difference of two leaves relative to the largest entry, in units of the machine epsilon.

    The gap is infinite if shapes, dtypes, entries that are not finite, or leaves that are not floating differ. `eps` is
    the machine epsilon of a less precise leaf, from which both have been computed.
    """
    if not is_variable(expected):
        if isinstance(expected, np.ndarray) or isinstance(actual, np.ndarray):
            is_equal = np.array_equal(expected, actual)
        else:
            is_equal = expected is actual or expected == actual
        return 0.0 if is_equal else inf
    a = np.asarray(expected)
    b = np.asarray(actual)
    if a.shape != b.shape or a.dtype != b.dtype:
        return inf
    if np.array_equal(a, b, equal_nan=True):
        return 0.0
    finite = np.isfinite(a)
    if not np.array_equal(finite, np.isfinite(b)) or not np.array_equal(a[~finite], b[~finite], equal_nan=True):
        return inf
    size = np.max(np.abs(a[finite])) or np.max(np.abs(b[finite]))
    return float(np.max(np.abs(a[finite] - b[finite])) / size / max(eps, np.finfo(a.dtype).eps))


def _same(a, b):
    """Return True if two arrays have the same values."""
    return np.array_equal(sample(a), b)


def _is_strided(value):
    return isinstance(value, np.ndarray) and not value.flags.c_contiguous


def _without_leaves(tree):
    """Return a tree with None in place of all leaves."""
    return flatten(tree)[1](iter(lambda: None, 0))


class Outputs:
    """The result of a recorded function: which of its leaves a program computes.

    Parameters
    ----------
    trace : ProgramTrace
    inputs : sequence of Slot
    result : tree
        The result of the function on the trace.

    Attributes
    ----------
    slots : list of Slot
        The leaves that the program computes. They share no memory with each other and with the inputs.
    state_places : list of int or None
        If the function is the step of a rollout and keeps the form of the state: for each variable of the state its
        position among the slots. A rollout sets it.
    state_is_known : bool
        Whether a rollout has set `state_places`.
    """

    state_places: list[int] | None = None
    state_is_known = False

    def __init__(self, trace: ProgramTrace, inputs: Sequence[Slot], result: Any) -> None:
        trace.check()
        ends = leaves(result)
        self._rebuild = flatten(_without_leaves(result))[1]
        self.slots: list[Slot] = []
        self.places: list[int] = []
        self._statics: list = []
        for place, end in enumerate(ends):
            if is_recorded(end):
                slot = end._node.slot
            elif isbox(end):
                refuse_outer_trace()
            elif isinstance(end, np.ndarray):
                slot = trace.call(array_copy, end)
            else:
                self._statics.append(constant(end))
                continue
            self._statics.append(None)
            self.places.append(place)
            self.slots.append(_own_array(trace, slot, (*inputs, *self.slots)))

    def build(self, values: Sequence) -> Any:
        """Return the result of the function from the values of the slots."""
        return self._rebuild(placed(self._statics, self.places, values))


def _own_array(trace, slot, others):
    """Return a slot for an array that shares no memory with others: the same slot, or that of a copy."""
    value = trace.samples[slot.number]
    if not isinstance(value, np.ndarray):
        return slot
    producer = next((call for call in trace.calls if call.result is slot), None)
    if producer is None:
        return trace.call(array_copy, slot)
    used = [trace.sample(arg) for arg in producer.args]
    shares = any(isinstance(arg, np.ndarray) and np.may_share_memory(value, arg) for arg in used)
    is_new = is_fresh(producer.function) or (value.base is None and not shares)
    if is_new and all(slot.number != other.number for other in others):
        return slot
    return trace.call(array_copy, slot)


class PullbackProgram:
    """The program of a function, and that of its VJP.

    Parameters
    ----------
    recorded : Recorded
    nums : tuple of int
        Positions of the variables that are differentiated.

    Attributes
    ----------
    nums : tuple of int
    floating : list of int
        Positions of the floating leaves among the slots of the result.
    is_checked : bool
        Whether the program has been compared with the function.
    saved_bytes : int
        Size of the values that `backward` needs, without those of the variables.
    """

    def __init__(self, recorded: Recorded, nums: tuple[int, ...]) -> None:
        self.nums = nums
        self.is_checked = False
        self._recorded = recorded
        trace, inputs = recorded.begin()
        boxes = list(map(trace.box, inputs))
        with _recording(recorded.name):
            tape = self._tape(boxes)
            self.outputs = Outputs(trace, inputs, tape.rebuild(tape.values))
            n_forward = len(trace.calls)
            results = [trace.samples[slot.number] for slot in self.outputs.slots]
            self.floating = [k for k, value in enumerate(results) if is_variable(value)]
            result_cotangents: list = [None] * len(tape.values)
            cotangent_slots = []
            for k in self.floating:
                slot = trace.slot(random_like(results[k]))
                cotangent_slots.append(slot)
                result_cotangents[self.outputs.places[k]] = trace.box(slot)
            pulled = tape.pull(result_cotangents)
            cotangents = []
            for num in nums:
                cotangent = pulled[recorded.places[num]]
                if cotangent is not None:
                    cotangent = trace.unboxed(gradient_of(boxes[num], cotangent))
                cotangents.append(cotangent)
            trace.check()
        slots = [cotangent for cotangent in cotangents if type(cotangent) is Slot]
        backward_calls = needed_calls(trace.calls[n_forward:], slots)
        used = free_slots(backward_calls) | {slot.number for slot in slots}
        computed = {call.result.number for call in backward_calls}
        of_cotangents = {slot.number for slot in cotangent_slots}
        self._saved = [Slot(number) for number in sorted(used - of_cotangents - computed)]
        self._n_results = len(self.outputs.slots)
        self.saved_bytes = _bytes_of(trace, self._saved, inputs)
        results_and_saved = [*self.outputs.slots, *self._saved]
        forward_calls = needed_calls(trace.calls[:n_forward], results_and_saved)
        self._forward = Executable(recorded, trace, forward_calls, inputs, results_and_saved)
        self._backward = Executable(recorded, trace, backward_calls, [*self._saved, *cotangent_slots], cotangents)

    def compile(self) -> None:
        """Translate both programs to machine code, if that is wanted and possible."""
        self._forward.compile()
        self._backward.compile()

    def backward(self, *saved_and_cotangents: Any) -> tuple:
        """Return the cotangents of the variables `nums`; None for a variable that the result does not depend on."""
        return self._backward.run(*saved_and_cotangents)

    def compiled_loop(self, order: Sequence[int], n_params: int) -> Any:
        """Return all steps of a rollout as machine code, None if that is not possible; see `CompiledLoop`."""
        parts = self._forward.parts, self._backward.parts
        return self._recorded.compiled_loop(parts, order, n_params, self.nums, len(self._saved))

    def forward(self, variables: Sequence) -> tuple[tuple, tuple]:
        """Return the values of the result, and the values that `backward` needs before the cotangents."""
        values = self._recorded.run(self._forward.run, variables)
        return values[: self._n_results], values[self._n_results :]

    def compare(self, variables: Sequence) -> None:
        """Raise JitError if the program and the function, or their pullbacks, differ at some plain variables."""
        recorded = self._recorded
        results, saved = self.forward(variables)
        tape = self._tape(variables)
        check_program(recorded.name, tape.rebuild(tape.values), self.outputs.build(results), recorded.eps)
        cotangents = [random_like(results[k]) for k in self.floating]
        expected = self._pull_tape(tape, cotangents, variables)
        actual = self.pull(saved, cotangents, variables)
        check_program(f"the gradient of {recorded.name}", expected, actual, recorded.eps)

    def _tape(self, variables):
        """Return the function on a tape at some variables, plain or of a program."""
        recorded = self._recorded
        arguments = recorded.arguments(variables)
        moving = [False] * len(leaves(arguments))
        for num in self.nums:
            moving[recorded.places[num]] = True
        return taped(recorded.call, arguments, moving)

    def _pull_tape(self, tape, cotangents, variables):
        """Return the cotangents of the variables `nums` by a tape of the function itself."""
        places = [self.outputs.places[k] for k in self.floating]
        pulled = tape.pull(placed([None] * len(tape.values), places, cotangents))
        return [gradient_of(variables[num], pulled[self._recorded.places[num]]) for num in self.nums]

    def pull(self, saved: Sequence, cotangents: Sequence, variables: Sequence) -> list:
        """Return the cotangents of the variables `nums`, for cotangents that may be traced."""
        if any(map(isbox, cotangents)):
            return self._pull_tape(self._tape(variables), cotangents, variables)
        pulled = self.backward(*saved, *cotangents)
        return [
            zero_like(variables[num]) if back is None else back for num, back in zip(self.nums, pulled, strict=True)
        ]

    def build(self, floating: Sequence, others: Sequence) -> Any:
        """Return the result of the function from its floating leaves, which may be traced, and the other ones."""
        values = placed([None] * self._n_results, self.floating, floating)
        other_places = [k for k in range(self._n_results) if k not in self.floating]
        return self.outputs.build(placed(values, other_places, others))


def _bytes_of(trace, slots, inputs):
    """Return the bytes of the values of some slots; for the pullback of a rule those of the arguments of its call."""
    numbers = {slot.number for slot in slots}
    for call in trace.calls:
        if call.result.number in numbers and not isinstance(trace.sample(call.result), (np.ndarray, np.generic)):
            numbers.update(arg.number for arg in call.args if type(arg) is Slot)
    numbers -= {slot.number for slot in inputs}
    return sum(getattr(trace.samples[number], "nbytes", 0) for number in numbers)


@contextmanager
def _recording(name):
    """Record inside a `with` block; raise JitError for a traced value that a function does not accept."""
    open_traces.append(None)
    try:
        yield
    except (TypeError, ValueError, AttributeError, IndexError) as error:
        texts = f"{error} {error.__cause__}"
        if isinstance(error, JitError) or not any(words in texts for words in OF_TRACED_VALUES):
            raise
        raise JitError(
            f"dp.jit cannot record {name}: a traced value was refused ({error}); write the function with "
            "autograd.numpy, without float(), int(), item() and u[i] = ..."
        ) from error
    finally:
        open_traces.pop()


class JittedRule(Rule):
    """A call of a jitted function on a tape, as one node.

    Parameters
    ----------
    name : str
        Name of the function.
    program : PullbackProgram

    Attributes
    ----------
    others : list
        The leaves of the result that the program computes and that are not floating.
    """

    jvp = None
    keywords = ()
    accepts_traced = True

    def __init__(self, name: str, program: PullbackProgram) -> None:
        self.name = f"jit of {name}"
        self._program = program
        self._saved: tuple = ()
        self.others: list = []

    def forward(self, *variables: Any) -> Any:
        """Return the floating leaves of the result."""
        program = self._program
        results, self._saved = program.forward(constant_args(variables, program.nums))
        floating = [results[k] for k in program.floating]
        self.others = [results[k] for k in range(len(results)) if k not in program.floating]
        return _combined(floating)

    def vjp(self, nums: Sequence[int], ans: Any, *variables: Any) -> Callable:
        """Return the function that maps cotangents of the result to those of the differentiated variables."""
        saved = self._saved
        self._saved = ()

        def pull(g):
            return self._program.pull(saved, _separated(g, len(self._program.floating)), variables)

        return pull


# ---- functions that decide by values ---------------------------------------------------------------------------------


def opaque_call(function: Callable, args: tuple, options: dict) -> Any:
    """Record a call of a function that makes decisions by values as one call of the program; see `opaque`."""
    structure = TreeStructure((args, options), "arguments", is_variable)
    variables = structure.variables((args, options))
    nums = innermost(variables)
    owner = getattr(function, "__self__", args[0] if args else None)
    name = getattr(owner, "name", None)
    if not isinstance(name, str) or isinstance(owner, Jitted):
        name = name_of(function)
    rule = OpaqueCall(name, function, structure, nums)
    return rule.build(through(rule, nums, *variables))


class OpaqueCall(Rule):
    """A call of a function that makes decisions by values, while `dp.jit` records.

    Parameters
    ----------
    name : str
        Name of the function, or of the object whose method it is.
    function : callable
    structure : TreeStructure
        Structure of the pair of its positional and keyword arguments.
    nums : sequence of int
        Positions of the variables that are differentiated.
    """

    jvp = None
    keywords = ()
    accepts_traced = True

    def __init__(self, name: str, function: Callable, structure: TreeStructure, nums: Sequence[int]) -> None:
        self.name = name
        self._function = function
        self._structure = structure
        self._nums = nums
        self._result: Any = None  # structure of the result
        self._call: Any = None  # slot of the call

    def forward(self, *variables: Any) -> Any:
        """Return the floating leaves of the result, as one value or a tuple."""
        if any(isbox(value) and not is_recorded(value) for value in variables):
            raise JitError(
                f"dp.jit cannot record tangents and second derivatives of {self.name}; call the function without dp.jit"
            )
        trace = recording_trace(variables)
        self._call = trace.call(self._run, *map(trace.unboxed, variables))
        results, _ = trace.sample(self._call)
        return _combined([trace.box(trace.call(_entry, self._call, 0, place)) for place in range(len(results))])

    def _evaluate(self, arguments):
        args, options = arguments
        return self._function(*args, **options)

    def _run(self, *variables):
        """Call the function with plain values; return the floating leaves of its result, and a tape if it is needed."""
        arguments = self._structure.build(variables)
        if not self._nums:
            result = self._evaluate(arguments)
            return self._variables_of(result), None
        moving = [False] * len(self._structure.statics)
        for num in self._nums:
            moving[self._structure.places[num]] = True
        tape = taped(self._evaluate, arguments, moving)
        return self._variables_of(tape.rebuild(tape.values)), tape

    def _variables_of(self, result):
        """Return the floating leaves of a result; raise JitError if another leaf differs from that of the recording."""
        structure = TreeStructure(result, "result", is_variable, constant)
        if self._result is None:
            self._result = structure
        recorded = self._result
        if structure.places != recorded.places or not all(map(_agree, structure.statics, recorded.statics)):
            raise JitError(
                f"{self.name} returned a leaf that is not floating and differs from that of the recording; "
                "call the function without dp.jit"
            )
        return structure.variables(result)

    def build(self, results: Any) -> Any:
        """Return the result of the function from its floating leaves."""
        return self._result.build(_separated(results, len(self._result.places)))

    def vjp(self, nums: Sequence[int], ans: Any, *variables: Any) -> Callable:
        """Return the function that maps cotangents of the result to those of the differentiated variables."""

        def pull(g):
            cotangents = _separated(g, len(self._result.places))
            trace = recording_trace((ans, *cotangents, *variables))
            plain_variables = [trace.unboxed(variable) for variable in variables]
            pulled = trace.call(self._pull, self._call, *map(trace.unboxed, cotangents), *plain_variables)
            return [trace.box(trace.call(getitem, pulled, place)) for place in range(len(self._nums))]

        return pull

    def _pull(self, call, *cotangents_and_variables):
        """Return the cotangents of the differentiated variables, from the tape of a call."""
        _, tape = call
        n = len(self._result.places)
        tape_cotangents = placed([None] * len(tape.values), self._result.places, cotangents_and_variables[:n])
        variables = cotangents_and_variables[n:]
        pulled = tape.pull(tape_cotangents)
        return [gradient_of(variables[num], pulled[self._structure.places[num]]) for num in self._nums]


def _combined(values):
    """Return several values as the result of a rule: the only one, or a tuple."""
    if len(values) == 1:
        return values[0]
    return tuple(values)


def _separated(result, n):
    """Return the list of the n values that `_combined` has combined, or of their cotangents."""
    if n == 1:
        return [result]
    return [result[k] for k in range(n)]


def _entry(call, part, place):
    """Return an entry of a part of the result of an opaque call."""
    return call[part][place]
