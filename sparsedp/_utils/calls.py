"""Calls of public functions: error messages for wrong arguments, and tracebacks without internal frames.

The environment variable ``SPARSEDP_TRACEBACK=full`` keeps all frames.
"""

from __future__ import annotations

import os
import sys
import warnings
from difflib import get_close_matches
from functools import partial, wraps
from inspect import Parameter, signature
from pathlib import Path
from types import FunctionType, MethodType, ModuleType, TracebackType
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Sequence

__all__ = [
    "PROGRAM",
    "advice_near",
    "deprecated_attribute",
    "describe_module",
    "foreign_keyword_advice",
    "frames_inside",
    "nearest",
    "public",
    "public_name",
    "shortened",
    "without_own_frames",
    "warn_deprecated",
    "wrapped_functions",
]

PACKAGE = Path(__file__).parent.parent
PROGRAM = "<program of dp.jit>"  # file name of the code that `dp.jit` generates
# Packages whose frames are removed from tracebacks: this library, and packages that call its code.
HIDDEN = ("sparsedp", "autograd", "functools", "contextlib", "scipy", "pyamg")
# Keyword argument of other libraries -> {parameter of ours: advice}. The first parameter that the function has is used.
FOREIGN_KEYWORDS = {
    "args": {"batches": "loss=lambda x: loss(x, *args)"},
    "argnums": {"argnum": "argnum=..."},
    "bc": {"boundary": "boundary=..."},
    "bcs": {"boundary": "boundary=..."},
    "boundaries": {"boundary": "boundary=..."},
    "boundary_conditions": {"boundary": "boundary=..."},
    "epochs": {"maxiter": "maxiter=..."},
    "fun": {"loss": "loss=...", "fun": "fun=..."},
    "grad": {"gradient": "gradient=function, or omit it: it is computed in reverse mode"},
    "hess": {"batches": "method='newton_cg', which computes products with the Hessian"},
    "hessp": {"batches": "method='newton_cg', which computes products with the Hessian"},
    "iterations": {"maxiter": "maxiter=..."},
    "jac": {
        "gradient": "gradient=function, or omit it: it is computed in reverse mode",
        "jacobian": "jacobian=...",
    },
    "learning_rate": {"batches": "method='adam', rate=..."},
    "lr": {"batches": "method='adam', rate=..."},
    "max_iter": {"maxiter": "maxiter=..."},
    "max_iterations": {"maxiter": "maxiter=..."},
    "max_workers": {"executor": "executor=..."},
    "n_iter": {"maxiter": "maxiter=..."},
    "n_jobs": {"executor": "executor=..."},
    "n_steps": {"n": "n=..."},
    "num_steps": {"n": "n=..."},
    "optimizer": {"batches": "method='adam'"},
    "options": {"batches": "the options themselves as keyword arguments, as in memory=20"},
    "order": {"scheme": "scheme=...", "method": "method=..."},
    "parameters": {"params": "params=..."},
    "solver": {"method": "method=..."},
    "steps": {"n": "n=...", "maxiter": "maxiter=..."},
    "timestep": {"dt": "dt=..."},
    "tol": {"tolerance": "tolerance=...", "rtol": "rtol=..."},
    "u0": {"start": "start=..."},
    "workers": {"executor": "executor=..."},
    "x0": {"start": "start=...", "guess": "guess=...", "x": "x=..."},
}
# Examples for error messages of functions for which a list of the required parameters is not enough.
EXAMPLES = {
    "dp.ensemble": "dp.ensemble(loss, scenes), and executor=concurrent.futures.ProcessPoolExecutor(2) for processes",
    "dp.hvp": "dp.hvp(loss, x, tangent)",
    "dp.rollout": "dp.rollout(step, start, params, n), with params=None if the step has none",
    "dp.save": "dp.save('run.npz', grid, u=u)",
    "dp.stepper": "dp.stepper('rk4', rate, dt)",
    "dp.testing.assert_gradient": "dp.testing.assert_gradient(f, x, vjp=vjp)",
}


def nearest(word: Any, words: Sequence[str]) -> str | None:
    """Return the entry of `words` that is most similar to a misspelt word; None if none is similar."""
    word = str(word).lower()
    similar = [other for other in words if word and other.startswith(word)]
    if not similar:
        similar = get_close_matches(word, words)
    if similar:
        return similar[0]
    return None


def advice_near(word: Any, words: Sequence[str]) -> str:
    """Return the end of an error message that proposes the most similar entry of `words`; empty if none is similar."""
    near = nearest(word, words)
    if near is None:
        return ""
    return f"; write {near!r}"


Function = TypeVar("Function", bound="Callable")


def public(written: str, advice: Callable | None = None) -> Callable[[Function], Function]:
    """Decorate a public function: add advice to errors of wrong arguments, and remove internal frames from tracebacks.

    Parameters
    ----------
    written : str
        The function as a user writes it, such as ``"dp.rollout"``.
    advice : callable, optional
        ``advice(*args, **options)`` is called with the arguments of a wrong call. It returns the call that the user
        should write instead, or None for the default advice.

    Returns
    -------
    callable
        The decorator. The decorated function has the signature, docstring and name of the original one.

    Examples
    --------
    >>> @public("dp.plot")
    ... def plot(grid, u): ...
    >>> plot(1)
    Traceback (most recent call last):
        ...
    TypeError: dp.plot needs the argument 'u'; write dp.plot(grid, u)
    """

    def decorate(function):
        @wraps(function)
        def call(*args, **options):
            __tracebackhide__ = True  # pytest shows the line that calls the function
            try:
                return function(*args, **options)
            except Exception as error:
                error = _call_error(error, function, written, advice, args, options)
                raise shortened(error)  # noqa: B904 SPARSEDP_TRACEBACK=full keeps all frames

        return call

    return decorate


def _call_error(error, function, written, advice, args, options):
    """Return a TypeError with advice if the arguments do not match the signature of a function, else the error."""
    raised_by_the_call = error.__traceback__.tb_next is None
    if not (isinstance(error, TypeError) and raised_by_the_call):
        return error
    form = signature(function)
    try:
        form.bind(*args, **options)
    except TypeError:
        return _misfit(form, written, advice, args, options).with_traceback(error.__traceback__)
    return error


def _misfit(form, written, advice, args, options):
    """Return the TypeError for arguments that do not match a signature."""
    parameters = {name: parameter for name, parameter in form.parameters.items() if name != "self"}
    positional_args = args
    if "self" in form.parameters:
        positional_args = args[1:]
    example = None
    if advice is not None:
        example = advice(*positional_args, **options)
    example = example or EXAMPLES.get(written) or _example(written, parameters)
    takes_any_keyword = any(parameter.kind is Parameter.VAR_KEYWORD for parameter in parameters.values())
    for name in options:
        if name not in parameters and not takes_any_keyword:
            return TypeError(
                f"{written} has no argument {name!r}; write {_suggested_argument(name, parameters) or example}"
            )
    by_position = Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD
    positional = [parameter for parameter in parameters.values() if parameter.kind in by_position]
    if len(positional_args) > len(positional):
        arguments = "argument" if len(positional) == 1 else "arguments"
        return TypeError(
            f"{written} takes {len(positional)} {arguments} by position, got {len(positional_args)}; write {example}"
        )
    for name, parameter in parameters.items():
        filled = name in options or parameter in positional[: len(positional_args)]
        if _is_required(parameter) and not filled:
            return TypeError(f"{written} needs the argument {name!r}; write {example}")
    return TypeError(f"{written} was given an argument twice, by position and by name; write {example}")


def foreign_keyword_advice(name: str, parameters: Container[str]) -> str | None:
    """Return advice for a keyword argument that only other libraries have, or None.

    Parameters
    ----------
    name : str
        The keyword argument.
    parameters : container of str
        The parameters of the function that was called.
    """
    for parameter, advice in FOREIGN_KEYWORDS.get(name.lower(), {}).items():
        if parameter in parameters:
            return advice
    return None


def _suggested_argument(name, parameters):
    """Return the argument to write in place of an unknown keyword argument, or None."""
    advice = foreign_keyword_advice(name, parameters)
    if advice:
        return advice
    near = nearest(name, list(parameters))
    if near is None:
        return None
    return f"{near}=..."


def _example(written, parameters):
    """Return the text of a call with the required arguments."""
    return f"{written}({', '.join(name for name, parameter in parameters.items() if _is_required(parameter))})"


def _is_required(parameter):
    return parameter.default is Parameter.empty and parameter.kind not in (
        Parameter.VAR_POSITIONAL,
        Parameter.VAR_KEYWORD,
    )


def shortened(error: Exception) -> Exception:
    """Remove internal frames from the tracebacks of an error and its causes, except for the frame that raised it.

    Returns
    -------
    Exception
        The same object.
    """
    if os.environ.get("SPARSEDP_TRACEBACK") == "full":
        return error
    seen: set = set()
    link: Any = error
    while link is not None and id(link) not in seen:
        seen.add(id(link))
        link.__traceback__ = _without_internal_frames(link.__traceback__)
        link = link.__cause__ or link.__context__
    return error


def without_own_frames(error: Exception) -> Exception:
    """Remove all frames of this library from the traceback of an error, also the one that raised it.

    The message of an error about a wrong argument says what to write; the line of the caller is all that is needed.
    Other errors keep the frame that raised them.

    Returns
    -------
    Exception
        The same object.
    """
    error = shortened(error)
    entries = _frames(error.__traceback__)
    is_full = os.environ.get("SPARSEDP_TRACEBACK") == "full"
    is_own = entries[-1].tb_frame.f_globals.get("__name__", "").startswith("sparsedp.")
    if is_own and not is_full and isinstance(error, (TypeError, ValueError)):
        error.__traceback__ = _joined_frames(entries[:-1])
    return error


def _without_internal_frames(traceback):
    """Return a traceback with the frames of the user's code and the last frame."""
    entries = _frames(traceback)
    return _joined_frames([entry for entry in entries[:-1] if _is_of_the_user(entry.tb_frame)] + entries[-1:])


def _frames(traceback):
    """Return the entries of a traceback as a list."""
    entries = []
    while traceback is not None:
        entries.append(traceback)
        traceback = traceback.tb_next
    return entries


def _joined_frames(entries):
    """Return a traceback with these entries."""
    following = None
    for entry in reversed(entries):
        following = TracebackType(following, entry.tb_frame, entry.tb_lasti, entry.tb_lineno)
    return following


def _is_of_the_user(frame):
    return frame.f_globals.get("__name__", "").partition(".")[0] not in HIDDEN


def _is_of_the_package(file_name):
    return file_name == PROGRAM or Path(file_name).is_relative_to(PACKAGE)


def frames_inside() -> int:
    """Return the number of frames of this package from the caller of this function up to the user's code.

    The caller itself is counted, and so are programs of `dp.jit`. A warning with ``stacklevel=frames_inside() + 1``
    names the line of the user's code.
    """
    frame: Any = sys._getframe(1)
    count = 0
    while frame is not None and _is_of_the_package(frame.f_code.co_filename):
        frame = frame.f_back
        count += 1
    return count


class _CallableModule(ModuleType):
    """A public module that raises a TypeError with an example if a user calls it like a function."""

    def __call__(self, *args, **options):
        raise TypeError(f"{self.__name__} is a module; write {self._example}")

    def __getattr__(self, name):
        if "__getattr__" in vars(self):  # the module's own function has failed: call it again to raise its error
            return vars(self)["__getattr__"](name)
        raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}{advice_near(name, self.__all__)}")


def describe_module(name: str, example: str) -> None:
    """Add advice to the errors of wrong calls of a module and of its public functions.

    Parameters
    ----------
    name : str
        Name of the module, such as ``"sparsedp.check"``.
    example : str
        The call that a user should write instead of calling the module.
    """
    module: Any = sys.modules[name]
    module.__class__ = _CallableModule
    module._example = example
    for word in module.__all__:
        function = vars(module).get(word)  # some modules import a function when it is first used
        if type(function) is FunctionType:
            setattr(module, word, public_name(function, name, word))


def public_name(function: Callable, module: str, name: str) -> Callable:
    """Wrap a function with `public` under its name in a public module."""
    written = f"{module.replace('sparsedp', 'dp', 1)}.{name}"
    wrapped = public(written)(function)
    wrapped.__module__ = module  # pickle looks for the function there
    return wrapped


def warn_deprecated(old: str, new: str, removal: str) -> None:
    """Issue a DeprecationWarning that names the line of the user's code.

    Parameters
    ----------
    old, new : str
        The deprecated name and its replacement, as a user writes them.
    removal : str
        Version in which the old name stops working.
    """
    message = f"{old} is deprecated and will be removed in version {removal}; write {new}"
    warnings.warn(message, DeprecationWarning, stacklevel=frames_inside() + 1)


def deprecated_attribute(old: str, new: str, removal: str) -> property:
    """Return a property that reads a renamed attribute and warns.

    Parameters
    ----------
    old, new : str
        The deprecated name of the attribute and its replacement.
    removal : str
        Version in which the old name stops working.

    Examples
    --------
    >>> class Plan:
    ...     skipped = ("velocity",)
    ...     left_out = deprecated_attribute("left_out", "skipped", "0.5")
    """

    def read(self: Any) -> Any:
        kind = type(self).__name__
        warn_deprecated(f"{kind}.{old}", f"{kind}.{new}", removal)
        return getattr(self, new)

    return property(read, doc=f"Deprecated name of `{new}`.")


def wrapped_functions(function: Callable) -> list[Any]:
    """Return a function and those that it wraps, the outermost first.

    Attributes of a function are not copied by all wrappers. This finds them behind `jit`, `functools.wraps`,
    `functools.lru_cache`, `functools.partial` and the method ``__call__`` of an object, in any nesting.
    """
    functions: list[Any] = []
    layer: Any = function
    while layer is not None and not any(layer is outer for outer in functions):
        functions.append(layer)
        if isinstance(layer, partial):
            layer = layer.func
        elif isinstance(layer, MethodType) and layer.__name__ == "__call__":
            layer = layer.__self__
        else:
            layer = getattr(layer, "__wrapped__", None)
    return functions
