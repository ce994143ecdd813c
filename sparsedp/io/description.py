"""Texts that describe an object, with the code and the data of functions, and are the same in every process.

A function is described by its code, its defaults, its closure, its global variables, and those of the functions among
them. Functions of this library and of NumPy, SciPy and autograd count by name, and objects of this library by the call
that constructs them.

The content of some objects cannot be described, such as that of instances of the user's classes: they may hold
counters, open files or random generators. `Description` says whether there are any. On request the attributes of
such instances are described too.
"""

from __future__ import annotations

import functools
import inspect
import sys
from contextlib import suppress
from dataclasses import fields, is_dataclass
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from sparsedp._utils.base_classes import Frozen, Reconstructible, Uncached
from sparsedp.autodiff.jit import Jitted
from sparsedp.io.digest import array_description

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["PACKAGES", "Description"]

PACKAGES = ("autograd", "numpy", "scipy", "sparsedp")
LIBRARIES = sys.stdlib_module_names | set(PACKAGES)  # their functions count by name
MOST_OBJECTS = 10_000  # functions and other objects that are followed at most
PLAIN_TYPES = (bool, int, float, complex, str, bytes, slice, np.dtype, type(None), type(...))
FUNCTIONS_OF_C = (np.ufunc, BuiltinFunctionType, type(np.sum))


class Description:
    """Texts that describe an object, and the objects to which it refers, and are the same in every process.

    Parameters
    ----------
    value : object
    with_attributes : bool
        Whether the attributes of instances of the user's classes are described.

    Attributes
    ----------
    texts : list of str
    is_complete : bool
        Whether they describe everything.
    """

    def __init__(self, value: Any, with_attributes: bool = False) -> None:
        self.with_attributes = with_attributes
        self.texts: list[str] = []
        self.is_complete = True
        self._numbers: dict[int, int] = {}  # of the objects that have been described, by their id
        self._objects: list[Any] = []  # these objects: while they exist, their ids are unique
        self._pending = [value]  # a stack instead of a recursion: objects may be nested deeper than Python's limit
        while self._pending:
            self._add(self._pending.pop())

    def _add(self, value):
        """Add the texts of an object, without those of the objects to which it refers."""
        if isinstance(value, (np.ndarray, np.generic)) and value.dtype != object:
            self.texts.append(array_description(value))
        elif isinstance(value, PLAIN_TYPES):
            self.texts.append(f"{type(value).__qualname__} {value!r}")
        elif id(value) in self._numbers:
            self.texts.append(f"object {self._numbers[id(value)]}")
        elif len(self._objects) >= MOST_OBJECTS:
            self._add_name(value, is_complete=False)
        else:
            self._numbers[id(value)] = len(self._objects)
            self._objects.append(value)
            self._add_object(value)

    def _add_object(self, value):
        """Add the texts of an object that is not a number, a text or an array of numbers."""
        if isinstance(value, Jitted):
            self._pending.append(value.function)
        elif isinstance(value, functools.partial):
            self._add_parts("partial", value.func, value.args, value.keywords)
        elif isinstance(value, MethodType):
            self._add_parts("method", value.__func__, value.__self__)
        elif isinstance(value, FunctionType):
            self._add_function(value)
        elif isinstance(value, (list, tuple)):
            self._add_parts(type(value).__qualname__, *value)
        elif isinstance(value, dict):
            self._add_parts(type(value).__qualname__, *value, *value.values())
        elif isinstance(value, (set, frozenset)):
            self._add_parts(type(value).__qualname__, *sorted(value, key=repr))
        elif isinstance(value, Reconstructible):
            build, arguments = value.recipe()
            self._add_parts(type(value).__qualname__, build, *arguments)
        elif sp.issparse(value):
            self._add_parts(type(value).__qualname__, *_entries(value))
        elif isinstance(value, (Frozen, Uncached)) or (is_dataclass(value) and not isinstance(value, type)):
            self._add_parts(type(value).__qualname__, *_attributes(value))
        elif isinstance(value, (type, ModuleType, *FUNCTIONS_OF_C)):
            self._add_name(value, _is_of_library(value))
        else:
            self._add_name(value, is_complete=False)
            if self.with_attributes:
                self._add_attributes(value)

    def _add_attributes(self, value):
        """Add an instance of a class that is not known: as an array if it is one, else its call and its attributes."""
        if hasattr(value, "__array__"):
            array = np.asarray(value)
            if array.dtype != object:
                self._pending.append(array)
            return
        call = inspect.getattr_static(type(value), "__call__", None)
        if isinstance(call, FunctionType):
            self._pending.append(call)
        if isinstance(getattr(value, "__wrapped__", None), FunctionType):  # a function that another library compiles
            self._pending.append(value.__wrapped__)
        attributes = dict(getattr(value, "__dict__", {}))
        for kind in type(value).__mro__:
            names = vars(kind).get("__slots__", ())
            for name in (names,) if isinstance(names, str) else names:
                with suppress(AttributeError):
                    attributes[name] = getattr(value, name)
        self._add_parts("attributes", *(part for name in sorted(attributes) for part in (name, attributes[name])))

    def _add_parts(self, name, *parts):
        self.texts.append(f"{name} of {len(parts)}")
        self._pending += reversed(parts)

    def _add_name(self, value, is_complete):
        """Add the name of a function, class or module, or the name of the class of another object."""
        name = getattr(value, "__qualname__", getattr(value, "__name__", type(value).__qualname__))
        self.texts.append(f"{getattr(value, '__module__', '')} {name}")
        self.is_complete = self.is_complete and is_complete

    def _add_function(self, function):
        """Add the name of a function, its code, and the objects to which it refers."""
        self._add_name(function, is_complete=True)
        referred = [function.__defaults__, function.__kwdefaults__]
        for cell in function.__closure__ or ():
            with suppress(ValueError):  # an empty cell
                referred.append(cell.cell_contents)
        if not _is_of_library(function):
            self.texts.append(_code_text(function.__code__))
            names = sorted(set(_names(function.__code__)) & function.__globals__.keys())
            referred += [function.__globals__[name] for name in names]
        self._add_parts("references", *referred)


def _is_of_library(value):
    """Return whether a function, class or module belongs to a library whose functions count by name."""
    name = value.__name__ if isinstance(value, ModuleType) else getattr(value, "__module__", None)
    if isinstance(value, FunctionType):  # it may have been built by eval, in a dictionary of its own
        module = sys.modules.get(str(name))
        if module is None or value.__globals__ is not vars(module):
            return False
    return str(name or "numpy").partition(".")[0] in LIBRARIES  # functions in C may have no module


def _attributes(value):
    """Return the names and values of the attributes with which an object was constructed."""
    if is_dataclass(value):
        names = [field.name for field in fields(value)]
    else:
        names = []
        for name in sorted(vars(value)):
            if not isinstance(getattr(type(value), name, None), functools.cached_property):
                names.append(name)
    return [part for name in names for part in (name, getattr(value, name))]


def _entries(matrix):
    """Return the shape and the entries of a sparse matrix."""
    rows = matrix.tocsr()
    return rows.shape, rows.data, rows.indices, rows.indptr


def _names(code: Any) -> Iterator[str]:
    """Yield the names of global variables and attributes in the code of a function."""
    yield from code.co_names
    for constant in code.co_consts:
        if hasattr(constant, "co_code"):
            yield from _names(constant)


def _code_text(code: Any) -> str:
    """Return a text that describes the code of a function and is the same in every process."""
    texts = [code.co_code.hex(), repr(code.co_names)]
    for constant in code.co_consts:
        if hasattr(constant, "co_code"):
            texts.append(_code_text(constant))
        elif isinstance(constant, frozenset):
            texts.append(repr(sorted(map(repr, constant))))
        else:
            texts.append(repr(constant))
    return " ".join(texts)
