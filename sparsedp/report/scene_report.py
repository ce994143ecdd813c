"""A scene in a file, named on the command line, and the report on it: all instruments in one folder.

The folder gets Markdown, CSV and pictures of each instrument, and a page that says what they say.
"""

import contextlib
import inspect
import json
import os
import re
import runpy
import sys
import traceback
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from sparsedp import check
from sparsedp.check.summary import error_text
from sparsedp.files import write_file
from sparsedp.report import plots
from sparsedp.report.certificate import certify
from sparsedp.report.plan import explain
from sparsedp.report.stress_table import stress
from sparsedp.report.work_precision import words_of, workprec

__all__ = ["Source", "audited", "claim", "load", "write_report"]

STARTS = ("start", "x")  # names of the point, the first that is there
OPTIONS = ("workprec_options", "stress_options")  # dicts of arguments in the file
PAGE = "report.md"
NO_PROBLEM = (
    "error against run time: not measured, the file gives no workprec_options (problem, methods, over)"
)
GOALS = 0.1, 0.01, 1e-3, 1e-4, 1e-6  # the errors that the page recommends a method for, as far as one reaches them
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
    names = _run(file)
    if not callable(names.get(loss)):
        raise ValueError(f"{file} has no function {loss!r}; write {file}:NAME of the function to examine")
    place = next((name for name in ([start] if start else STARTS) if name in names), None)
    if place is None:
        raise ValueError(f"{file} has no {start or ' or '.join(STARTS)!r}, the point; write {file}:{loss}:NAME")
    name = file.stem if loss == "loss" else f"{file.stem}-{loss}"
    options = [names.get(key, {}) for key in OPTIONS]
    for key, given in zip(OPTIONS, options):
        if not isinstance(given, dict):
            raise ValueError(f"{key} in {file} must be a dict of arguments, got {type(given).__name__}")
    return Source(name, _of_one(names[loss], names[place]), names[place], *options)


@contextlib.contextmanager
def audited(name="", file=""):
    """In it code of the user's runs: it prints to stderr, and what it raises, an exit too, is refused.

    name: of its loss. file: it is the file itself that runs.
    """
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        cure = "" if isinstance(error, Exception) else "; it ended the program, let it return its value"
        reason = f"{_where(error, file)}{type(error).__name__}: {error}{cure}"
        if file:
            raise ValueError(f"{file} does not run: {reason}") from error
        raise ValueError(f"{name} cannot be audited: {reason}") from error


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
    lines += [error.lineno] if isinstance(error, SyntaxError) else []
    return f"line {lines[-1]}: " if lines else ""


# ---------------------------------------------------------------- the report on it


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
    claim(folder, [PAGE], force)
    with audited(source.name):
        findings = [_attempt(chapter, source) for chapter in CHAPTERS]
    words = [getattr(result, "verdict", "inconclusive") for result, *_ in (findings[0], findings[-1])]
    verdict = next(word for word in MEANING if word in words)
    page, lines = [f"# {source.name}: {verdict}", "", MEANING[verdict]], []
    for chapter, (result, sentences, draw) in zip(CHAPTERS, findings):
        files = []
        if result is not None:
            sentences = [*sentences, *(f"{chapter.stem} left out: {sentence}" for sentence in result.left_out)]
            stem, heading = getattr(result, "stem", chapter.stem), f"# {chapter.title}\n\n"
            files = plots.write_result(result, folder, stem, draw, heading)
        links = (f"{'!' if path.suffix == '.png' else ''}[{path.name}]({path.name})" for path in files)
        page += ["", f"## {chapter.title}", "", *(f"- {sentence}" for sentence in sentences), "", *links]
        lines += sentences
    write_file(folder / PAGE, "\n".join([*page, ""]))
    return verdict, lines


def _attempt(chapter, source):
    """What a chapter finds, or the error in words: an instrument that fails does not take the others with it."""
    try:
        return chapter.find(source)
    except Exception as error:  # the loss is the user's: it may raise anything
        return None, [f"{chapter.failed}, {error_text(error)}"], None


# Chapters: source -> (result or None, sentences for the page, what draws it on axes or None).


def _audit(source):
    audit = check.gradient(source.loss, source.x)
    digits = f", {audit.digits} digits" if audit.digits is not None else ""
    sentences = [f"gradient: {audit.verdict}{digits}{': ' if audit.reason else ''}{audit.reason}"]
    if audit.culprit:
        sentences.append(f"at fault: {audit.culprit}")
    return audit, sentences, partial(plots.v_curve, audit)


def _workprec(source):
    if not source.workprec:
        return None, [NO_PROBLEM], None
    rows, sentences = workprec(**source.workprec), []
    for goal in GOALS:
        words, row = f"a {rows.judged.replace('_', ' ')} of {100 * goal:g} %", rows.best(goal, rows.judged)
        if row is None:
            sentences.append(f"error against run time: no method reaches {words}, see {rows.stem}.md")
            break
        settings, seconds = words_of(json.loads(row["settings"])), rows.seconds(row, rows.judged)
        sentences.append(f"fastest at {words}: {row['method']} ({settings}), {seconds:.1e} s")
    return rows, sentences, rows.plot


def _certificate(source):
    found = certify(source.loss, source.x)
    return found, [f"error of the gradient from its solves: about {found.gradient_error:.1e}; {found.advice}"], None


def _plan(source):
    plan = explain(source.loss, source.x)
    return plan, [f"one gradient: {plan.sums}"], None


def _stress(source):
    trial = stress(source.loss, source.x, **source.stress)
    failed = [": ".join(["FAILED", f"{row['parameter']} {row['case']}".strip(), row["note"]]) for row in trial.failures]
    return trial, [trial.summary, *failed], trial.plot if trial.map else None


class Chapter(NamedTuple):
    """An instrument of the report."""

    stem: str  # of its files
    title: str
    failed: str  # what is said when it fails
    find: Any


# The audit comes first and the stress cases last: both have a say in the verdict.
CHAPTERS = (
    Chapter("audit", "Is the gradient right?", "gradient: not audited", _audit),
    Chapter("workprec", "Which method for which error?", "error against run time: not measured", _workprec),
    Chapter("certificate", "How exact is the gradient, and how exact need the solves be?", "certificate: not made",
            _certificate),
    Chapter("plan", "What one gradient computes", "plan: not made", _plan),
    Chapter("stress", "Stiff and extreme cases", "stress: not run", _stress),
)  # fmt: skip
