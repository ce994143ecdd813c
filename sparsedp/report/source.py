"""A scene in a file, named on the command line: FILE.py, FILE.py:loss or FILE.py:loss:start."""

import contextlib
import inspect
import os
import re
import runpy
import sys
import traceback
from pathlib import Path
from typing import Any, NamedTuple

__all__ = ["Source", "audited", "load"]

STARTS = ("start", "x")  # names of the point, the first that is there


class Source(NamedTuple):
    """A loss, the point where it is examined, and what else the file tells the instruments."""

    name: str
    loss: Any
    x: Any
    workprec: dict
    stress: dict


def load(target):
    """Target -> Source. The file is run once, as a module; what it prints goes to stderr.

    Parameters
    ----------
    target : str
        ``FILE.py[:loss[:start]]``. Without a name the loss is called `loss`, and the point `start` or `x`; a point
        that is a tuple fills a loss of several arguments. Two dicts in the file are handed on: `workprec_options`
        (problem, methods, ...) and `stress_options` (ranges, step, ...).

    Raises
    ------
    ValueError
        If there is no such file, it does not run, or a name is missing.
    """
    parts = re.fullmatch(r"(.+\.py)(?::([^:]+))?(?::([^:]+))?", target)
    if parts is None:
        raise ValueError(f"{target!r} names no scene; write FILE.py:loss, or FILE.py:loss:start")
    file, loss, start = Path(parts[1]), parts[2] or "loss", parts[3]
    found = _run(file)
    if not callable(found.get(loss)):
        raise ValueError(f"{file} has no function {loss!r}; write {file}:NAME of the function to examine")
    names = [start] if start else [name for name in STARTS if name in found]
    if not names or names[0] not in found:
        raise ValueError(f"{file} has no {start or ' or '.join(STARTS)!r}, the point; write {file}:{loss}:NAME")
    name = file.stem if loss == "loss" else f"{file.stem}-{loss}"
    options = [found.get(key, {}) for key in ("workprec_options", "stress_options")]
    for key, given in zip(("workprec_options", "stress_options"), options, strict=True):
        if not isinstance(given, dict):
            raise ValueError(f"{key} in {file} must be a dict of arguments, got {type(given).__name__}")
    return Source(name, _of_one(found[loss], found[names[0]]), found[names[0]], *options)


@contextlib.contextmanager
def audited(name):
    """In it a loss of the user's runs: what it prints goes to stderr, and what it raises, an exit too, is refused."""
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        cure = "" if isinstance(error, Exception) else "; it ended the program, let it return its value"
        raise ValueError(f"{name} cannot be audited: {type(error).__name__}: {error}{cure}") from error


def _of_one(loss, x):
    """The loss as a function of one point: a point that is a tuple fills a loss of several arguments."""
    if not isinstance(x, tuple) or hasattr(x, "_fields"):
        return loss
    try:
        inspect.signature(loss).bind(None)
    except TypeError:
        return lambda point: loss(*point)
    except ValueError:  # a function of C without a signature
        return loss
    return loss


def _run(file):
    if not os.path.isfile(file):  # Path.is_file raises for a name that is too long
        raise ValueError(f"there is no file {file}; name one that is there")
    before = sys.argv, sys.path
    sys.argv, sys.path = [str(file)], [str(file.resolve().parent), *sys.path]
    try:
        with contextlib.redirect_stdout(sys.stderr):
            return runpy.run_path(str(file), run_name=file.stem)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # the file is the user's: it may raise anything, or end the program
        raise ValueError(f"{file} does not run: {_where(error, file)}{type(error).__name__}: {error}") from error
    finally:
        sys.argv, sys.path = before


def _where(error, file):
    """The last line of the file itself that took part, in words."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(file)]
    line = error.lineno if isinstance(error, SyntaxError) else frames[-1].lineno if frames else None
    return "" if line is None else f"line {line}: "
