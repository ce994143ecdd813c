"""A scene in a file, named on the command line, and the report on it: all instruments in one folder.

The folder gets Markdown, CSV and pictures of each instrument, and a page that says what they say, twice: report.md, and
report.html, which holds all of it.
"""

import contextlib
import inspect
import os
import re
import runpy
import sys
import traceback
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from sparsedp import check
from sparsedp._utils.calls import warn_deprecated
from sparsedp.check.summary import Result, error_text
from sparsedp.io.atomic_files import write_file
from sparsedp.report import plots
from sparsedp.report.certificate import certify
from sparsedp.report.explain import explain
from sparsedp.report.html_page import page, section
from sparsedp.report.stress_table import stress
from sparsedp.report.work_precision import work_precision

__all__ = ["Source", "audited", "claim", "load", "write_report"]

STARTS = ("start", "x")  # names of the point, the first that is there
OPTIONS = "work_precision", "stress"  # instruments whose arguments the file may hold, as dicts of the name NAME_options
PAGES = "report.md", "report.html"
NO_PROBLEM = "the file gives no work_precision_options (problem, methods, over)"
MEANING = {  # the worst first: one that is wrong beats one that is open
    "disagrees": "Something is wrong: the gradient is not what differences of the loss say, or a case below FAILED.",
    "inconclusive": "Nothing is proved: the reason stands below. This is no pass.",
    "agrees": "The gradient is what differences of the loss say, and no stiff or extreme case failed.",
}


# ---------------------------------------------------------------- a scene in a file


class Source(NamedTuple):
    """A loss, the point where it is examined, and what else the file tells the instruments."""

    name: str
    loss: Any
    x: Any
    options: dict  # by instrument


def load(target):
    """Target -> Source. The file is run once, as a module; what it prints goes to stderr.

    Parameters
    ----------
    target : str
        ``FILE.py[:loss[:start]]``. Without a name the loss is called `loss`, and the point `start` or `x`; a point
        that is a tuple fills a loss of several arguments. Two dicts in the file are handed on: `work_precision_options`
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
    names = _run(file)
    if not callable(names.get(loss)):
        raise ValueError(f"{file} has no function {loss!r}; write {file}:NAME of the function to examine")
    place = next((name for name in ([start] if start else STARTS) if name in names), None)
    if place is None:
        raise ValueError(f"{file} has no {start or ' or '.join(STARTS)!r}, the point; write {file}:{loss}:NAME")
    name = file.stem if loss == "loss" else f"{file.stem}-{loss}"
    if "workprec_options" in names:
        names.setdefault("work_precision_options", names["workprec_options"])
        warn_deprecated("workprec_options", "work_precision_options", "0.5")
    options = {key: names.get(f"{key}_options", {}) for key in OPTIONS}
    for key, given in options.items():
        if not isinstance(given, dict):
            raise ValueError(f"{key}_options in {file} must be a dict of arguments, got {type(given).__name__}")
    return Source(name, _of_one(names[loss], names[place]), names[place], options)


@contextlib.contextmanager
def audited(name="", file=""):
    """In it code of the user's runs: it prints to stderr, and what it raises, an exit too, is refused.

    name: of its loss. file: it is the file itself that runs.
    """
    try:
        with contextlib.redirect_stdout(sys.stderr), _exit_is_an_error():
            yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        cure = "" if isinstance(error, Exception) else "; it ended the program, let it return its value"
        reason = f"{_where(error, file)}{type(error).__name__}: {error}{cure}"
        if file:
            raise ValueError(f"{file} does not run: {reason}") from error
        raise ValueError(f"{name} cannot be audited: {reason}") from error


@contextlib.contextmanager
def _exit_is_an_error():
    """Within the block ``os._exit(0)`` raises SystemExit: the code of the user must not choose the exit code.

    Child processes, which end this way, are left alone.
    """
    end, process = os._exit, os.getpid()

    def refused(status):
        if os.getpid() != process:
            end(status)
        raise SystemExit(f"os._exit({status})")

    os._exit = refused
    try:
        yield
    finally:
        os._exit = end


def _of_one(loss, x):
    """The loss as a function of one point: a point that is a tuple fills a loss of several arguments."""
    try:
        inspect.signature(loss).bind(None)
    except TypeError:
        return (lambda point: loss(*point)) if isinstance(x, tuple) else loss
    return loss


def _run(file):
    if not os.path.isfile(file):  # Path.is_file raises for a name that is too long
        raise ValueError(f"there is no file {file}; name one that is there")
    before = sys.argv, sys.path
    sys.argv, sys.path = [str(file)], [str(file.resolve().parent), *sys.path]
    try:
        with audited(file=str(file)):
            return runpy.run_path(str(file), run_name=file.stem)
    finally:
        sys.argv, sys.path = before


def _where(error, file):
    """The last line of the file itself that took part, in words."""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    lines += [error.lineno] if isinstance(error, SyntaxError) and error.filename == file else []
    return f"line {lines[-1]}: " if lines else ""


# ---------------------------------------------------------------- the report on it


def free_folder(folder, names, force):
    """Return a folder, or if it holds one of these files and `force` is not set the first of folder-2, folder-3, ..."""
    number, free = 1, folder
    while not force and any(os.path.lexists(free / name) for name in names):
        number += 1
        free = folder.with_name(f"{folder.name}-{number}")
    return free


def claim(folder, names, force):
    """Make a folder, and refuse when it holds one of these files and `force` is not set."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{folder} cannot be made a folder: {error.strerror}; name another with --out") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(f"{folder} cannot be written to; name another with --out")
    for path in (folder / name for name in names):
        if os.path.lexists(path) and not force:
            raise ValueError(f"{path} is there already; name another folder with --out, or write --force")


def write_report(source, folder, force=False):
    """Scene and folder -> (verdict, sentences): "agrees", "disagrees" or "inconclusive", and what stands on the page.

    Parameters
    ----------
    source : Source
    folder : pathlib.Path
    force : bool
        Whether a report that is there may be replaced.

    Raises
    ------
    ValueError
        If there is a report already, the folder cannot be written, or the loss ends the program.
    OSError
        If a file cannot be written.
    """
    claim(folder, PAGES, force)
    with audited(source.name):
        results = [_attempt(chapter, source) for chapter in CHAPTERS]
    words = [getattr(result, "verdict", "inconclusive") for result in (results[0], results[-1])]
    verdict = next(word for word in MEANING if word in words)
    degraded = getattr(results[-1], "counts", {}).get("degraded")
    meaning = MEANING[verdict] + (f" {degraded} stiff or extreme cases are degraded, see below." if degraded else "")
    text, lines, sections, missing = [f"# {source.name}: {verdict}", "", meaning], [], [], []
    for chapter, result in zip(CHAPTERS, results):
        sentences, files = [f"{chapter.failed}, {result}"], []
        if isinstance(result, Result):
            sentences = [part.strip() for part in result.parts() if isinstance(part, str)]
            stem, heading = getattr(result, "stem", chapter.stem), f"# {chapter.title}\n\n"
            files = plots.write_result(result, folder, stem, chapter.draw(result), heading)
            sections.append(section(chapter.title, result, files, chapter.caption))
        else:
            missing += sentences
        links = [f"{'!' if path.suffix == '.png' else ''}[{path.name}]({path.name})" for path in files]
        caption = ["", chapter.caption] if any(path.suffix == ".png" for path in files) else []
        text += ["", f"## {chapter.title}", "", *(f"- {sentence}" for sentence in sentences), "", *links, *caption]
        lines += sentences
    write_file(folder / PAGES[0], "\n".join([*text, ""]))
    write_file(folder / PAGES[1], page(source.name, verdict, meaning, sections, missing))
    return verdict, lines


def _attempt(chapter, source):
    """What an instrument gives, or the error in words: one that fails does not take the others with it."""
    try:
        return chapter.run(source.loss, source.x, **source.options.get(chapter.stem, {}))
    except Exception as error:  # the loss is the user's: it may raise anything
        return error_text(error)


def _work_precision(loss, x, **options):
    return work_precision(**options) if options else NO_PROBLEM


class Chapter(NamedTuple):
    """An instrument of the report."""

    stem: str  # of its files
    title: str
    failed: str  # what is said when it fails
    run: Any  # loss, x and options -> result, or in words why there is none
    draw: Any = lambda result: None  # result -> what draws it on axes, or None
    caption: str = ""  # how to read the picture


# The audit comes first and the stress cases last: both have a say in the verdict.
CHAPTERS = (
    Chapter("audit", "Is the gradient right?", "gradient: not audited", check.gradient,
            lambda audit: partial(plots.v_curve, audit),
            "Each curve is a direction. Of a right gradient it falls with the step, from the right to the left, until "
            "rounding lifts it: a V. Of a wrong one it stays up: a plateau."),
    Chapter("work_precision", "Which method for which error?", "error against run time: not measured", _work_precision,
            lambda rows: rows.plot,
            "Further to the left is faster, further down is more exact. The grey band joins the best runs: no other "
            "one is both faster and more exact."),
    Chapter("certificate", "How exact is the gradient, and how exact need the solves be?", "certificate: not made",
            certify),
    Chapter("plan", "What one gradient computes", "plan: not made", explain),
    Chapter("stress", "Stiff and extreme cases", "stress: not run", stress,
            lambda trial: trial.plot if trial.map else None,
            "How much a small change grows in one step, over viscosity (across) and time step (up): above 1 the step "
            "is unstable, grey ones are refused, the star is where the scene is."),
)  # fmt: skip
