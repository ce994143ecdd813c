"""Base classes of objects that are pickled and copied as the call that constructs them, or that are immutable."""

from __future__ import annotations

import pickle
from copy import deepcopy
from dataclasses import fields, is_dataclass
from functools import cached_property, update_wrapper
from threading import local
from types import MethodType
from typing import TYPE_CHECKING, Any

from sparsedp._utils.calls import shortened

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["Frozen", "Reconstructible", "ReconstructibleFunction", "Uncached", "Value"]


class Reconstructible:
    """An object that is pickled and copied as a call: a function or class of a module, and its arguments.

    Attributes
    ----------
    constructor_call : (callable, tuple)
        The function and its arguments, unless the class overrides `recipe`.
    """

    __slots__ = ()
    constructor_call: Any

    def recipe(self) -> tuple[Callable, tuple]:
        """Return the function and the arguments that construct the object again."""
        return self.constructor_call

    def __reduce__(self) -> Any:
        build, arguments = self.recipe()
        _check_importable(getattr(self, "name", type(self).__name__), arguments)
        return build, arguments

    def __copy__(self) -> Any:
        build, arguments = self.recipe()
        return build(*arguments)

    def __deepcopy__(self, memo: dict) -> Any:
        build, arguments = self.recipe()
        return build(*deepcopy(arguments, memo))


class _Visits(local):
    """The functions that the current thread is checking; stops the recursion for objects that contain themselves."""

    def __init__(self):
        self.functions: set[int] = set()


_visits = _Visits()


def _check_importable(owner, part):
    """Raise TypeError for functions that another process cannot import.

    For a bound method only the class is checked, because its object may contain `owner`. pickle handles such cycles.
    """
    if isinstance(part, dict):
        part = list(part.values())
    if is_dataclass(part) and not callable(part) and not isinstance(part, Reconstructible):
        part = [getattr(part, field.name) for field in fields(part)]
    if isinstance(part, (tuple, list)):
        for entry in part:
            _check_importable(owner, entry)
        return
    if not callable(part) or isinstance(part, Reconstructible) or id(part) in _visits.functions:
        return
    _visits.functions.add(id(part))
    is_bound_method = isinstance(part, MethodType) and not isinstance(part.__self__, type)
    try:
        pickle.dumps(type(part.__self__) if is_bound_method else part)
    except Exception as error:
        definition = "its class" if is_bound_method else "it as a def"
        raise TypeError(
            f"{owner} cannot be pickled with {getattr(part, '__qualname__', repr(part))}, which other processes "
            f"cannot import; write {definition} at the top level of a module"
        ) from error
    finally:
        _visits.functions.discard(id(part))


class ReconstructibleFunction(Reconstructible):
    """A function that is pickled and copied as the call that returned it.

    Parameters
    ----------
    function : callable
    build : callable
        ``build(*arguments)`` returns such a function.
    *arguments
        Arguments of `build`.
    """

    def __init__(self, function: Callable, build: Callable, *arguments: Any):
        update_wrapper(self, function)
        self.name = build.__name__
        self.constructor_call = build, arguments
        self._function = function

    def __call__(self, *args: Any, **options: Any) -> Any:
        try:
            return self._function(*args, **options)
        except Exception as error:
            raise shortened(error)  # noqa: B904 SPARSEDP_TRACEBACK=full keeps all frames

    def __repr__(self) -> str:
        return f"<function of {self.name}>"


class Uncached:
    """An object whose cached properties are not pickled."""

    def __getstate__(self) -> dict[str, Any]:
        state = {}
        for name, value in self.__dict__.items():
            if not isinstance(getattr(type(self), name, None), cached_property):
                state[name] = value
        return state


class Frozen:
    """An object whose attributes cannot be set after its construction.

    Attributes
    ----------
    attribute_suggestions : dict
        Maps attribute names of other libraries to the expression that the error message proposes instead.
    """

    attribute_suggestions: Any = {}

    def __init__(self, **values: Any):
        self.__dict__.update(values)

    if not TYPE_CHECKING:  # a type checker reports an attribute that does not exist

        def __getattr__(self, name: str) -> Any:
            if name in self.attribute_suggestions:
                raise AttributeError(
                    f"{type(self).__name__} has no attribute {name!r}; write {self.attribute_suggestions[name]}"
                )
            return object.__getattribute__(self, name)  # raises Python's own error

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"{type(self).__name__} is frozen; make a new one instead of setting {name}")


class Value(Frozen):
    """A frozen object that is compared and hashed by its attribute `_key`."""

    _key: Any

    def __eq__(self, other: object) -> Any:
        if type(other) is not type(self):
            return NotImplemented
        return self is other or self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)
