"""How objects travel to other processes, and are copied: as the call that makes them again. Caches stay behind."""

import pickle
from copy import deepcopy
from functools import cached_property, update_wrapper
from threading import local
from types import MethodType
from typing import Any

from sparsedp._utils.calls import shortened

__all__ = ["Frozen", "Made", "Remade", "Uncached", "Value"]


class Remade:
    """An object that is pickled, and copied, as the call that makes it: its attribute `made`, or ``recipe()``.

    These are the function or class of a module, and its arguments.
    """

    __slots__ = ()
    made: Any

    def recipe(self):
        """The call that makes it again."""
        return self.made

    def __reduce__(self):
        build, arguments = self.recipe()
        _check_named(getattr(self, "name", type(self).__name__), arguments)
        return build, arguments

    def __copy__(self):
        build, arguments = self.recipe()
        return build(*arguments)

    def __deepcopy__(self, memo):
        build, arguments = self.recipe()
        return build(*deepcopy(arguments, memo))


_busy = local()  # .parts: what this thread is looking at, for objects that hold what holds them


def _check_named(owner, part):
    """Refuse functions that another process cannot import.

    Of a method only the class is looked at: its object may hold `owner`, and pickle itself follows such circles.
    """
    if isinstance(part, (tuple, list, dict)):
        for one in part.values() if isinstance(part, dict) else part:
            _check_named(owner, one)
    elif callable(part) and not isinstance(part, Remade):
        parts = vars(_busy).setdefault("parts", set())
        if id(part) in parts:
            return
        parts.add(id(part))
        method = isinstance(part, MethodType) and not isinstance(part.__self__, type)
        try:
            pickle.dumps(type(part.__self__) if method else part)
        except Exception as error:
            raise TypeError(
                f"{owner} cannot be pickled with {getattr(part, '__qualname__', repr(part))}, which other processes "
                f"cannot import; write {'its class' if method else 'it as a def'} at the top level of a module"
            ) from error
        finally:
            parts.discard(id(part))


class Made(Remade):
    """A function that a builder has made; it travels as the call of the builder.

    Parameters
    ----------
    function, build : callable
    *arguments
        Of `build`.
    """

    def __init__(self, function, build, *arguments):
        update_wrapper(self, function)
        self.name, self._function, self.made = build.__name__, function, (build, arguments)

    def __call__(self, *args, **options):
        try:
            return self._function(*args, **options)
        except Exception as error:
            raise shortened(error)  # noqa: B904 SPARSEDP_TRACEBACK=full keeps all frames

    def __repr__(self):
        return f"<function of {self.name}>"


class Uncached:
    """An object whose cached properties do not travel."""

    def __getstate__(self):
        values = vars(self).items()
        return {
            name: value for name, value in values if not isinstance(getattr(type(self), name, None), cached_property)
        }


class Frozen:
    """An object whose attributes are the values it is made with.

    Attributes
    ----------
    meant : dict
        What people write, coming from elsewhere: what to write here.
    """

    meant: Any = {}

    def __init__(self, **values):
        vars(self).update(values)

    def __getattr__(self, name):
        if name in self.meant:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}; write {self.meant[name]}")
        return object.__getattribute__(self, name)  # in Python's own words

    def __setattr__(self, name, value):
        raise AttributeError(f"{type(self).__name__} is frozen; make a new one instead of setting {name}")


class Value(Frozen):
    """A frozen object that equals every other of its class with the same `_key`."""

    _key: Any

    def __eq__(self, other):
        if type(other) is not type(self):
            return NotImplemented
        return self is other or self._key == other._key

    def __hash__(self):
        return hash(self._key)
