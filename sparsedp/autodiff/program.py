"""Programs: recorded calls, compiled to one function of straight-line Python code.

A program executes the calls of a `ProgramTrace` that its results need, on plain values and without a tape. Calls whose
results are not used are dropped, except checks. Large arrays are overwritten by a later result, or freed, as soon as no
call needs them any more.
"""

from __future__ import annotations

import operator
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.calls import PROGRAM
from sparsedp.autodiff.fast_derivatives import ARRAY, ITEM, NUMBERS
from sparsedp.autodiff.program_trace import Slot
from sparsedp.autodiff.tape import executed_function

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from sparsedp.autodiff.program_trace import ProgramCall, ProgramTrace

__all__ = ["compile_program", "free_slots", "needed_calls"]

LARGE = (
    2**15
)  # arrays with more bytes are overwritten and freed early; for smaller ones this takes longer than it saves
# Function -> its sign in Python code. Sums and products of NumPy arrays give the same bits by sign and by name.
SIGNS = {
    operator.add: "+",
    operator.sub: "-",
    operator.mul: "*",
    operator.truediv: "/",
    operator.pow: "**",
    operator.getitem: "[]",
    np.add: "+",
    np.subtract: "-",
    np.multiply: "*",
    np.true_divide: "/",
}
# Sign -> the function that writes its result into an operand.
IN_PLACE = {"+": np.add, "-": np.subtract, "*": np.multiply, "/": np.true_divide}


def needed_calls(calls: Iterable[ProgramCall], results: Iterable[Slot]) -> list[ProgramCall]:
    """Return the calls that some results need, and all checks, in order."""
    numbers = {slot.number for slot in results}
    needed = []
    for call in reversed(list(calls)):
        if call.result.number in numbers or call.has_effect:
            needed.append(call)
            numbers.update(arg.number for arg in call.args if type(arg) is Slot)
    needed.reverse()
    return needed


def free_slots(calls: Iterable[ProgramCall]) -> set[int]:
    """Return the numbers of the slots that some calls use and do not compute."""
    used: set[int] = set()
    computed: set[int] = set()
    for call in calls:
        used.update(arg.number for arg in call.args if type(arg) is Slot)
        computed.add(call.result.number)
    return used - computed


def compile_program(
    trace: ProgramTrace, calls: Sequence[ProgramCall], inputs: Sequence[Slot], results: Sequence[Any]
) -> Callable[..., tuple]:
    """Return a function that executes some calls.

    Parameters
    ----------
    trace : ProgramTrace
        The trace of the calls; its recorded values give the sizes of all arrays.
    calls : sequence of ProgramCall
        In the order of execution.
    inputs : sequence of Slot
        The arguments of the function.
    results : sequence
        What the function returns as a tuple: slots, and constants.

    Returns
    -------
    callable
        ``run(*inputs) -> tuple``.
    """
    writer = _Writer(trace, calls, results)
    lines = [writer.line(position, call) for position, call in enumerate(calls)]
    parameters = ", ".join(writer.name(slot) for slot in inputs)
    returned = "".join(f"{writer.name(result)}, " for result in results)
    body = "".join(f"    {line}\n" for line in lines)
    text = f"def program({parameters}):\n{body}    return ({returned})\n"
    exec(compile(text, PROGRAM, "exec"), writer.constants)
    return writer.constants["program"]


class _Writer:
    """Writes the lines of a program.

    Parameters
    ----------
    trace, calls, results
        The arguments of `compile_program`.

    Attributes
    ----------
    constants : dict
        The global names of the code: constants, and the functions that it calls.
    """

    def __init__(self, trace: ProgramTrace, calls: Sequence[ProgramCall], results: Sequence[Any]) -> None:
        self._trace = trace
        self._returned = {result.number for result in results if type(result) is Slot}
        self.constants: dict[str, Any] = {}
        self._names: dict[int, str] = {}  # id of a constant -> its name
        self._last_use: dict[int, int] = {}  # number of a slot -> position of the last call that uses it
        for position, call in enumerate(calls):
            for arg in call.args:
                if type(arg) is Slot:
                    self._last_use[arg.number] = position
        # Arrays that arithmetic operations have created and that no other array shares memory with.
        self._private: set[int] = set()

    def name(self, value: Any) -> str:
        """Return the name of a slot or constant."""
        if type(value) is Slot:
            return f"v{value.number}"
        constant = self._names.get(id(value))
        if constant is None:
            constant = self._names[id(value)] = f"k{len(self._names)}"
            self.constants[constant] = value
        return constant

    def line(self, position: int, call: ProgramCall) -> str:
        """Return the line of code of a call."""
        used = {arg.number for arg in call.args if type(arg) is Slot}
        dead = {number for number in used if self._last_use[number] == position and number not in self._returned}
        result = self.name(call.result)
        sign = self._sign(call)
        if sign in IN_PLACE:
            line = f"{result} = {self._arithmetic(call, sign, dead)}"
            self._private.add(call.result.number)
        else:
            self._private -= used  # the result may be a view of an argument
            line = f"{result} = {self._expression(call, sign)}"
        freed = [f"v{number}" for number in sorted(dead) if self._is_large(number)]
        if freed:
            line = f"{line}; del {', '.join(freed)}"
        return line

    def _sign(self, call: ProgramCall) -> str | None:
        """Return the sign of an operation of two operands, None for other calls."""
        if call.options or len(call.args) != 2:
            return None
        if call.function is ITEM:
            return "[]"
        sign = SIGNS.get(getattr(call.function, "fun", call.function))
        # Python's own numbers have other rules than those of NumPy, for example at a division by zero.
        if sign in IN_PLACE and not any(type(self._trace.sample(arg)) in NUMBERS for arg in call.args):
            return None
        return sign

    def _arithmetic(self, call: ProgramCall, sign: str, dead: set[int]) -> str:
        """Return an operation of two operands; a large operand that is not needed any more takes the result."""
        first, second = map(self.name, call.args)
        result = call.result.number
        if self._is_large(result):
            value = self._trace.samples[result]
            for number in sorted(dead & self._private):
                operand = self._trace.samples[number]
                if operand.shape == value.shape and operand.dtype == value.dtype:
                    return f"{self.name(IN_PLACE[sign])}({first}, {second}, v{number})"
        return f"{first} {sign} {second}"

    def _expression(self, call: ProgramCall, sign: str | None) -> str:
        """Return any other call."""
        names = list(map(self.name, call.args))
        if sign == "[]":
            return f"{names[0]}[{names[1]}]"
        if sign is not None:
            return f"{names[0]} {sign} {names[1]}"
        if call.function is ARRAY and not (call.options or call.args[0] or call.args[1]):
            return f"{self.name(np.array)}([{', '.join(names[2:])}])"
        if call.function is anp.negative and not call.options:
            return f"-{names[0]}"
        shift = self._shift_of_roll(call)
        if shift:
            return f"{self.name(np.concatenate)}(({names[0]}[{-shift}:], {names[0]}[:{-shift}]))"
        samples = list(map(self._trace.sample, call.args))
        function, args = executed_function(call.function, call.args, samples)
        arguments = ", ".join(map(self.name, args))
        if call.options:
            arguments = f"{arguments}, **{self.name(call.options)}"
        return f"{self.name(function)}({arguments})"

    def _shift_of_roll(self, call: ProgramCall) -> int:
        """Return by how much a call of roll shifts an array with one axis, between 1 and its size; 0 for other calls.

        Two slices give the same bits as `numpy.roll` in a tenth of its time.
        """
        if call.function is not anp.roll or not 2 <= len(call.args) <= 3 or call.options.keys() - {"axis"}:
            return 0
        array = self._trace.sample(call.args[0])
        shift = call.args[1]
        axis = call.args[2] if len(call.args) == 3 else call.options.get("axis")
        if type(array) is not np.ndarray or array.ndim != 1 or type(shift) is not int or axis not in (None, 0, -1):
            return 0
        return shift % array.size if array.size else 0

    def _is_large(self, number: int) -> bool:
        value = self._trace.samples[number]
        return isinstance(value, np.ndarray) and value.nbytes >= LARGE
