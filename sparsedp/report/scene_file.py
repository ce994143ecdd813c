"""Load a scene (a loss and a point) from a file or module named on the command line, and create the folder of results.

The user's code may end the process or change its state. While it runs, standard output, ``sys.argv``, ``sys.path`` and
``os._exit`` are replaced. They are restored afterwards, also after an error. Only ``python -m sparsedp`` calls the
functions of this module.
"""

from __future__ import annotations

import contextlib
import importlib
import inspect
import os
import re
import runpy
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple, NoReturn

from sparsedp._utils.calls import warn_deprecated

__all__ = ["SceneFile", "claim_folder", "free_folder", "errors_as_value_error", "load_scene"]

POINT_NAMES = ("start", "x")  # names of the point; the first one that the file defines is used
OPTIONS = ("work_precision", "stress")  # the file may define their arguments as a dict NAME_options


class SceneFile(NamedTuple):
    """A loss and a point from a file or a module, its derivatives, and arguments for `work_precision` and `stress`.

    Attributes
    ----------
    name : str
    loss : callable or object
        ``loss(x)``, or an object with the method ``apply(x)``.
    x : tree of arrays
    derivatives : dict
        The objects that `derivatives` of `load_scene` names.
    options : dict
        Dict of arguments for "work_precision" and "stress".
    """

    name: str
    loss: Any
    x: Any
    derivatives: dict[str, Any]
    options: dict[str, dict[str, Any]]


def load_scene(target: str, derivatives: Mapping[str, str] | None = None) -> SceneFile:
    """Run a file once, or import a module, and return the scene that it defines. Its output is redirected to stderr.

    Parameters
    ----------
    target : str
        ``FILE.py[:loss[:start]]`` or ``MODULE:loss[:start]``. The default name of the loss is `loss`, and the default
        name of the point is `start` or `x`. If the loss takes several arguments, the point is the tuple of arguments.
        If the point is a function, its result is the point. The file may also define the dicts
        `work_precision_options` (problem, methods, ...) and `stress_options` (ranges, step, ...).
    derivatives : mapping, optional
        Names in the file by what they are: "gradient", "vjp", "jvp", "jacobian" or "hessian".

    Raises
    ------
    ValueError
        If the file or module does not exist or raises an error, or if a name is missing.
    """
    source = _source(target)
    loss = source.names.get(source.loss)
    if not callable(loss) and not hasattr(loss, "apply"):
        raise ValueError(
            f"{source.file} has no function {source.loss!r}; write {source.file}:NAME of the function to examine"
        )
    chosen = {}
    for kind, name in (derivatives or {}).items():
        if name not in source.names:
            raise ValueError(f"{source.file} has no {name!r}; write --{kind} NAME with a name that it defines")
        chosen[kind] = source.names[name]
    point = _point(source)
    name = source.file.stem
    if source.loss != "loss":
        name = f"{name}-{source.loss}"
    return SceneFile(name, _with_one_argument(loss, point), point, chosen, _options(source))


class Source(NamedTuple):
    """A file or a module that has run: its global names, and the names of the loss and of the point in it."""

    file: Path
    names: dict[str, Any]
    loss: str
    points: tuple[str, ...]


def _source(target: str) -> Source:
    """Run the file, or import the module, that a command line names."""
    file = re.fullmatch(r"(.+\.py)(?::([^:]+))?(?::([^:]+))?", target)
    module = re.fullmatch(r"([\w.]+):([^:]+)(?::([^:]+))?", target)
    parts = file or module
    if parts is None:
        raise ValueError(f"{target!r} names no function; write FILE.py:NAME, FILE.py:NAME:POINT, or MODULE:NAME")
    names = _run(Path(parts[1])) if file else _import(parts[1])
    return Source(Path(parts[1]), names, parts[2] or "loss", (parts[3],) if parts[3] else POINT_NAMES)


def _point(source: Source) -> Any:
    """Return the point that a file defines, or the result of the function that it defines for it."""
    name = next((name for name in source.points if name in source.names), None)
    if name is None:
        expected = " or ".join(source.points)
        raise ValueError(f"{source.file} has no {expected!r}, the point; write {source.file}:{source.loss}:NAME")
    point = source.names[name]
    if isinstance(point, FunctionType):
        with errors_as_value_error(file=f"{source.file}:{name}"):
            return point()
    return point


def _options(source: Source) -> dict[str, dict[str, Any]]:
    """Return the arguments for `work_precision` and `stress` that a file defines."""
    names = source.names
    if "workprec_options" in names:
        names.setdefault("work_precision_options", names["workprec_options"])
        warn_deprecated("workprec_options", "work_precision_options", "0.5")
    options = {}
    for instrument in OPTIONS:
        arguments = names.get(f"{instrument}_options", {})
        if not isinstance(arguments, dict):
            kind = type(arguments).__name__
            raise ValueError(f"{instrument}_options in {source.file} must be a dict of arguments, got {kind}")
        options[instrument] = arguments
    return options


def _import(module: str) -> dict[str, Any]:
    """Import a module, from the current folder or an installed package, and return its global names."""
    path = sys.path
    sys.path = [os.getcwd(), *path]
    try:
        with errors_as_value_error(file=module):
            return vars(importlib.import_module(module))
    finally:
        sys.path = path


def _with_one_argument(loss: Any, point: Any) -> Any:
    """Return a loss as a function of one argument. A point that is a tuple is unpacked if the loss takes several."""
    if not isinstance(point, tuple) or not callable(loss):
        return loss
    try:
        inspect.signature(loss).bind(None)
    except TypeError:
        return lambda arguments: loss(*arguments)
    return loss


def _run(file: Path) -> dict[str, Any]:
    """Run a file with the ``sys.argv`` and ``sys.path`` of ``python FILE``; return its global names."""
    if not os.path.isfile(file):  # Path.is_file raises for a name that is too long
        raise ValueError(f"there is no file {file}; name one that is there")
    arguments = sys.argv
    path = sys.path
    sys.argv = [str(file)]
    sys.path = [str(file.resolve().parent), *path]
    try:
        with errors_as_value_error(file=str(file)):
            return runpy.run_path(str(file), run_name=file.stem)
    finally:
        sys.argv = arguments
        sys.path = path


# ---------------------------------------------------------------- run code of the user


@contextlib.contextmanager
def errors_as_value_error(name: str = "", file: str = "") -> Iterator[None]:
    """Run user code in a `with` block: its output goes to stderr, and all exceptions and exits become ValueError.

    Parameters
    ----------
    name : str
        Name of the loss, for the message.
    file : str
        Name of the file, if the file itself is run.
    """
    try:
        with contextlib.redirect_stdout(sys.stderr), _exit_as_an_error():
            yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        reason = f"{_line_of(error, file)}{type(error).__name__}: {error}"
        if not isinstance(error, Exception):
            reason += "; it ended the program, let it return its value"
        if file:
            raise ValueError(f"{file} does not run: {reason}") from error
        raise ValueError(f"{name} cannot be audited: {reason}") from error


@contextlib.contextmanager
def _exit_as_an_error() -> Iterator[None]:
    """Let ``os._exit`` raise SystemExit within the block, so that the user's code cannot choose the exit code.

    The function is replaced in the whole process until the block ends, because there is no other way to intercept it.
    Child processes, which normally end by ``os._exit``, are not affected.
    """
    original = os._exit
    process = os.getpid()

    def raise_exit(status: int) -> NoReturn:
        if os.getpid() != process:
            original(status)
        raise SystemExit(f"os._exit({status})")

    os._exit = raise_exit
    try:
        yield
    finally:
        os._exit = original


def _line_of(error: BaseException, file: str) -> str:
    """Return "line N: " for the last line of a file in the traceback of an error; "" if there is none."""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    if isinstance(error, SyntaxError) and error.filename == file:
        lines.append(error.lineno)
    if lines:
        return f"line {lines[-1]}: "
    return ""


# ---------------------------------------------------------------- folders


def free_folder(folder: Path, names: Sequence[str], force: bool) -> Path:
    """Return `folder`, or the first of folder-2, folder-3, ... that has none of these files (unless `force`)."""
    free = folder
    number = 1
    while not force and any(os.path.lexists(free / name) for name in names):
        number += 1
        free = folder.with_name(f"{folder.name}-{number}")
    return free


def claim_folder(folder: Path, names: Sequence[str], force: bool) -> None:
    """Create a folder. Raise ValueError if it has one of these files and `force` is not set."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{folder} cannot be created: {error.strerror}; name another with --out") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(f"{folder} cannot be written to; name another with --out")
    for name in names:
        path = folder / name
        if os.path.lexists(path) and not force:
            raise ValueError(f"{path} is there already; name another folder with --out, or write --force")
