"""workprec: error against run time, of values and of gradients, one row for each run."""

import csv
import itertools
import json
import platform
import tracemalloc
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from math import inf, isfinite, isnan, nan
from pathlib import Path
from time import perf_counter

import numpy as np

from sparsedp.check.summary import text_of
from sparsedp.derivative import value_and_grad
from sparsedp.errors import SparsedpError
from sparsedp.fields import check_function, is_whole
from sparsedp.files import write_file
from sparsedp.ledger import Calls, recording
from sparsedp.report import plots
from sparsedp.report.certificate import distance
from sparsedp.report.plan import total
from sparsedp.report.table import Table, csv_text, write_table
from sparsedp.tree import leaves

__all__ = ["COLUMNS", "Rows", "measured_row", "relative_distance", "timed", "versions", "words_of", "workprec"]

COLUMNS = (
    "scene", "method", "unknowns", "steps", "tolerance", "forward_error", "gradient_error", "seconds_setup",
    "seconds_forward", "seconds_backward", "peak_bytes", "solves_forward", "solves_adjoint", "iterations", "status",
    "seed", "versions", "settings", "reference_error", "seconds_forward_median", "seconds_forward_max",
    "seconds_backward_median", "seconds_backward_max",
)  # fmt: skip
TEXTS = ("scene", "method", "status", "seed", "versions", "settings")
KEY = ("scene", "method", "settings", "seed")  # what a row of an earlier run is found by
SHOWN = COLUMNS[1:15]
COUNTS = {"solves_forward": "solve", "solves_adjoint": "adjoint", "iterations": "iterations"}  # in the ledger
SETTLED = 2.0  # a run that is not faster than the last one by more is warm
MOST_WARM_UPS = 7
SHORT = 2e-3  # [s]: below, times differ for other reasons
FAILURES = (SparsedpError, ArithmeticError, ValueError, MemoryError, np.linalg.LinAlgError)


def workprec(
    problem, methods, over=None, reference=None, compare=None, repeats=3, file=None, scene=None, skip=None, seed=0
):
    """Problem and methods -> error against run time: a table, one row for each method and setting.

    Parameters
    ----------
    problem : callable
        ``problem(**settings)`` -> (loss, x) or (loss, x, facts). Facts are columns (unknowns, steps, tolerance);
        facts["output"], a function of x, gives the array that the forward error is about in place of the loss.
        With x None, loss() is the run itself (an optimizer, say) and its result the answer; it has no gradient.
    methods : dict
        Name of a method -> dict of its settings.
    over : dict, optional
        Name of a setting -> list of values: every method is run with every combination.
    reference : (value, gradient), callable, dict, or list of two dicts
        The exact answer and gradient; a function of the settings in `over` that gives them; or settings that
        replace those of the row: of two the second is used, and its distance from the first is the error of
        the reference. Default: the errors are NaN.
    compare : callable, optional
        ``compare(found, wanted)`` -> error of a gradient or an answer. Default: Euclidean, relative.
    repeats : int
        Timed runs after the warm ones; the least counts.
    file : path, optional
        CSV file: rows are added as they finish, and those in it are not run again.
    scene : str, optional
        Default: the name of `problem`.
    skip : callable, optional
        ``skip(method, settings)`` -> the reason why a run is left out, or None.
    seed : int
        Noted in every row; handed to the problem by the caller.

    Returns
    -------
    Rows
        `.rows` (dicts), `.markdown()`, `.csv()`, `.plot(ax)`, `.pareto()`, `.save(folder)`, `.left_out`; str() is
        the table.

    Raises
    ------
    ValueError
        If `repeats` is not a whole number >= 1, there is no method, or the file is not such a table.
    TypeError
        If the problem does not give (loss, x).

    Notes
    -----
    Every run is warm: it is repeated until its time has settled, and one that does not settle has the status
    not_warm and no time. Set-up: the time of problem(...) and of the first set-ups of solvers. Backward: the time
    of value and gradient less that of the value. Peak bytes: what Python's allocator saw in one run. A run that
    fails keeps its row, with the status of its solve or the name of its error.

    Examples
    --------
    >>> from sparsedp import Grid, dirichlet, inverse, laplacian
    >>> def poisson(cells, method):
    ...     solve = inverse(-laplacian(Grid(cells, size=1.0), dirichlet), method)
    ...     return lambda s: solve(s * np.ones(cells)).mean(), 1.0
    >>> table = workprec(poisson, {"direct": {"method": "direct"}}, {"cells": [8, 16, 32]}, reference=(1 / 12, 1 / 12))
    >>> [f"{row['gradient_error']:.4f}" for row in table.rows]
    ['0.0313', '0.0078', '0.0020']
    """
    check_function("workprec", problem, "lambda cells: (loss, x)")
    if not is_whole(repeats, 1):
        raise ValueError(f"workprec needs repeats >= 1, a whole number, got {repeats!r}; the default is 3")
    if not methods or not isinstance(methods, dict):
        raise ValueError("workprec needs at least one method; write {'name': {settings}}")
    scene, over, rows = scene or getattr(problem, "__name__", "scene"), over or {}, []
    finished, skipped = _finished(Path(file)) if file else ({}, [])
    errors = partial(_errors, problem, reference, compare or relative_distance, {})
    for (method, own), *values in itertools.product(methods.items(), *over.values()):
        shared = dict(zip(over, values))
        settings = shared | own
        reason = skip and skip(str(method), settings)
        if reason:
            skipped.append(f"{method} with {_words(settings)}: {reason}")
            continue
        key = scene, str(method), _text_of(settings), str(seed)
        if key not in finished:
            figures, *result = measured_row(problem, settings, repeats)
            figures |= errors({name: settings[name] for name in over}, *result)
            figures |= {**dict(zip(KEY, key)), "versions": versions()}
            finished[key] = {name: figures.get(name, nan) for name in COLUMNS}
            if file:
                _append(Path(file), finished[key])
        rows.append(finished[key])
    return Rows(scene=scene, rows=rows, left_out=skipped)


def words_of(row):
    """The settings of a row in words."""
    return _words(json.loads(row["settings"]))


def _words(settings):
    return ", ".join(f"{name}={value}" for name, value in settings.items()) or "no settings"


def _text_of(settings):
    return json.dumps(settings, sort_keys=True, default=str)


def versions():
    """Python and the libraries that figures depend on, in words."""
    found = [f"python {platform.python_version()}"]
    for name in ("sparsedp", "numpy", "scipy", "autograd", "pyamg", "numba"):
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"{name} -")
    return " ".join(found)


# ---------------------------------------------------------------- one run: timed, weighed, counted


def measured_row(problem, settings, repeats):
    """Settings of one run -> (row of figures, answer, gradient). What fails keeps a row with its status."""
    try:
        setup, given = timed(partial(problem, **settings))
        loss, x, facts = _task(given)
        runs = [loss] if x is None else [partial(loss, x), partial(value_and_grad(loss), x)]
        calls, status, first = _warm(runs[-1])
        row = {"status": status, "seconds_setup": setup + total(first, "setup")}
        row |= {name: total(calls, kind) for name, kind in COUNTS.items()}
        value, gradient = _times(runs, row, repeats)
        row["peak_bytes"] = _peak(runs[-1])
        answer = _answer(value, x, facts)
    except FAILURES as error:
        return {"status": _failure(error)}, None, None
    if not np.all(np.isfinite(answer)):
        row["status"] = "nonfinite"
    size = sum(map(np.size, leaves(answer if x is None else x)))
    return {"unknowns": size, **facts, **row}, answer, gradient


def _task(given):
    """(loss, x) or (loss, x, facts) -> all three."""
    if not isinstance(given, tuple) or len(given) not in (2, 3):
        raise TypeError(
            f"a problem gives (loss, x) or (loss, x, facts), got {type(given).__name__}; write return loss, x"
        )
    return (*given, {})[:3]


def _answer(value, x, facts):
    """What the forward error is about: the output if the facts name one, else the value."""
    output = facts.get("output")
    return np.asarray(value if output is None else output(x), float)


def timed(run):
    clock = perf_counter()
    result = run()
    return perf_counter() - clock, result


def _warm(run):
    """Run until the time has settled: compiled code, caches of set-ups, imports.

    Gives the calls of the last run, whether it is warm, and the seconds of the calls of the first.
    """
    before, first = inf, Calls()
    for _ in range(MOST_WARM_UPS):
        with recording() as calls:
            now, _ = timed(run)
        first = first or calls
        if before <= SETTLED * now + SHORT:  # it does not fall any more
            return calls, "ok", first.seconds
        before = now
    return calls, "not_warm", first.seconds


def _times(runs, row, repeats):
    """Run times into the row: the least, the median and the largest of the repeats -> (value, gradient).

    NaN when the caches never got warm. The time of the gradient is that of both less the least of the value.
    """
    least = 0.0
    for name, run in zip(("seconds_forward", "seconds_backward"), runs):
        pairs = [timed(run) for _ in range(repeats)]
        seconds = [max(spent - least, 0.0) if row["status"] == "ok" else nan for spent, _ in pairs]
        least, result = min(seconds), pairs[-1][1]
        row |= {name: least, f"{name}_median": float(np.median(seconds)), f"{name}_max": max(seconds)}
    return result if len(runs) > 1 else (result, None)


def _peak(run):
    """Bytes that a run holds at most, beyond what there was before, as Python's allocator sees it."""
    running = tracemalloc.is_tracing()
    tracemalloc.start()  # nothing where it runs
    try:
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        run()
        return tracemalloc.get_traced_memory()[1] - before
    finally:
        if not running:
            tracemalloc.stop()


def _failure(error):
    """Status of a run that failed: the word of the solve, or the name of the error."""
    return getattr(getattr(error, "info", None), "status", None) or type(error).__name__


# ---------------------------------------------------------------- exact answers


def _errors(problem, given, compare, cache, shared, answer, gradient):
    """The columns of errors of one run; a reference is found once for the settings that the methods share."""
    if given is None or answer is None:
        return {}
    try:
        key = _text_of(shared)
        if key not in cache:
            cache[key] = _reference(problem, given, compare, shared)
        value, slope, error = cache[key]
        gaps = {"forward_error": compare(answer, value), "reference_error": error}
        return gaps if gradient is None or slope is None else {**gaps, "gradient_error": compare(gradient, slope)}
    except FAILURES as trouble:
        return {"status": f"reference: {_failure(trouble)}"}


def _reference(problem, given, compare, shared):
    """(answer, gradient, error of the reference)."""
    if callable(given) or isinstance(given, tuple):
        return *(given(**shared) if callable(given) else given), 0.0
    results = []
    for settings in [given] if isinstance(given, dict) else given:
        loss, x, facts = _task(problem(**{**shared, **settings}))
        value, gradient = (loss(), None) if x is None else value_and_grad(loss)(x)
        results.append((_answer(value, x, facts), gradient))
    gaps = [compare(a, b) for a, b in zip(*results[-2:]) if a is not None] if len(results) > 1 else []
    return *results[-1], max(gaps, default=nan)


def relative_distance(one, other):
    """Euclidean distance relative to the second."""
    for a, b in zip(map(np.shape, leaves(one)), map(np.shape, leaves(other)), strict=True):
        if a != b:
            raise ValueError(f"workprec cannot compare shape {a} with {b}; give compare=function(found, wanted)")
    return distance(one, other, relative=True)


# ---------------------------------------------------------------- the table


class Rows(Table):
    """Error against run time. Made by `workprec`.

    Attributes
    ----------
    scene : str
    rows : list of dict
        Keys are COLUMNS; NaN where a figure does not exist.
    left_out : list of str
        Runs that were not made, with the reason.
    """

    _columns = COLUMNS

    @property
    def stem(self):
        """What the files of `save` are called."""
        return self.scene.replace("/", "-")

    @property
    def judged(self):
        """The error that methods are compared by: that of the gradient, where there is one."""
        return "gradient_error" if self.pareto() else "forward_error"

    def seconds(self, row, error="gradient_error"):
        """The run time that belongs to an error: of the value, or of value and gradient."""
        return row["seconds_forward"] + (row["seconds_backward"] if error == "gradient_error" else 0.0)

    def _points(self, error):
        """(seconds, error, row) of the runs that have both."""
        points = [(self.seconds(row, error), row[error], row) for row in self.rows if row["status"] == "ok"]
        return [point for point in points if isfinite(point[0] + point[1])]

    def pareto(self, error="gradient_error"):
        """Rows that no other row beats in both time and error, the fastest first."""
        return [row for *_, row in plots.unbeaten(self._points(error))]

    def best(self, error, which="gradient_error"):
        """The fastest row whose error is at most `error`, or None."""
        return next((row for row in self.pareto(which) if row[which] <= error), None)

    def _parts(self):
        """The table for readers: what is known of the runs, and the settings that tell those of a method apart."""
        rows = [json.loads(row["settings"]) | row for row in self.rows]
        first: dict = {}
        apart = dict.fromkeys(
            name for row in rows for name in row
            if name not in COLUMNS and row[name] != first.setdefault(row["method"], row)[name]
        )  # fmt: skip
        used = [name for name in SHOWN if any(text_of(row[name]) for row in rows)]
        best = [*self.pareto(), *self.pareto("forward_error")]
        marked = [row | {"best": "*" * (own in best)} for row, own in zip(rows, self.rows)]
        star = "A star: no other row is both faster and more exact (the Pareto set, in gradient or value)."
        errors = [row["reference_error"] for row in self.rows if not isnan(row["reference_error"])]
        stated = [f"Error of the reference: {max(errors):.1e}."] if errors else []
        names = [*used[:1], *apart, *used[1:], "best"]
        return [f"{self.scene}: error against run time"], marked, names, [star, *stated]

    def plot(self, ax=None, error="gradient_error"):
        """Log-log picture: run time across, error up, one curve for each method, the Pareto set marked.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Default: the current axes of pyplot.
        error : "gradient_error" or "forward_error"

        Returns
        -------
        matplotlib Axes
        """
        ax = plots.current(ax)
        curves: dict = {}
        for seconds, gap, row in self._points(error):
            if gap > 0:
                curves.setdefault(row["method"], []).append((seconds, gap))
        lines = {name: np.transpose(sorted(points)) for name, points in curves.items()}
        if lines:  # nothing has no logarithm
            plots.curves(lines, ax, "run time [s]", error.replace("_", " "))
        ax.set_title(self.scene)
        return ax

    def save(self, folder):
        """Write scene.md, scene.csv and, where matplotlib is installed, scene.png into a folder -> list of paths.

        A scene may have a name that is no name of a file: "/" becomes "-". A file that cannot be written is an
        OSError.
        """
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        return write_table(folder, self.stem, self.markdown(), self.csv(), partial(self.plot, error=self.judged))


# ---------------------------------------------------------------- a file that can be continued


def _append(path, row):
    """Add a finished row to a CSV file, on a line of its own: somebody may have cut the last one off."""
    before = path.read_text(encoding="utf-8") if path.exists() else ""
    lines = csv_text([row], COLUMNS)
    write_file(path, f"{before.rstrip()}\n{lines.partition(chr(10))[2]}" if before else lines)


def _finished(path):
    """CSV file -> (finished rows of these versions by key, what is left out)."""
    if not path.exists() or not path.stat().st_size:
        return {}, []
    with path.open(encoding="utf-8", newline="") as stream:
        reader = csv.DictReader(stream)
        if tuple(reader.fieldnames or ()) != COLUMNS:
            raise ValueError(f"{path.name} is no table of workprec; give another file name")
        rows = [row for row in reader if row["versions"] and row["seconds_backward_max"] is not None]
    same = [row for row in rows if row["versions"] == versions()]
    other = len(rows) - len(same)
    left = [f"{other} rows of {path.name} from other versions: run again"] if other else []
    typed = [{name: text if name in TEXTS else _number(text) for name, text in row.items()} for row in same]
    return {tuple(map(row.get, KEY)): row for row in typed}, left


def _number(text):
    return int(text) if text.isdigit() else float(text or "nan")
