"""work_precision: error against run time, of values and of gradients, one row for each run."""

import csv
import itertools
import json
import os
import platform
import tracemalloc
from collections.abc import Iterable
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from math import inf, isfinite, nan
from pathlib import Path
from time import perf_counter
from timeit import repeat, timeit

import numpy as np

from sparsedp._utils.counters import recording
from sparsedp._utils.pytree import leaves
from sparsedp._utils.validation import check_function, check_whole
from sparsedp.autodiff.backend import process_count
from sparsedp.autodiff.derivative import value_and_grad
from sparsedp.check.summary import Result
from sparsedp.check.table import table_of
from sparsedp.errors import SparsedpError
from sparsedp.io.atomic_files import path_errors, write_file
from sparsedp.report import plots
from sparsedp.report.certificate import distance
from sparsedp.report.explain import total

__all__ = ["COLUMNS", "Rows", "work_precision"]

COLUMNS = (
    "scene", "method", "unknowns", "steps", "tolerance", "forward_error", "gradient_error", "seconds_setup",
    "seconds_forward", "seconds_backward", "peak_bytes", "solves_forward", "solves_adjoint", "iterations", "status",
    "seed", "versions", "settings", "reference_error", "seconds_forward_median", "seconds_forward_max",
    "seconds_backward_median", "seconds_backward_max",
)  # fmt: skip
KEY = ("scene", "method", "settings", "seed", "versions")  # what a row of an earlier run is found by
TEXTS = (*KEY, "status")  # the other columns are numbers
SHOWN = COLUMNS[2:15]
COUNTS = {"solves_forward": "solve", "solves_adjoint": "adjoint", "iterations": "iterations"}  # in the ledger
SETTLED = 2.0  # a run that is not faster than the last one by more is warm
MOST_WARM_UPS = 7
SHORT = 2e-3  # [s]: below, times differ for other reasons
GOALS = 0.1, 0.01, 1e-3, 1e-4, 1e-6  # errors that a method is recommended for, as far as one reaches them
FAILURES = (SparsedpError, ArithmeticError, ValueError, MemoryError, np.linalg.LinAlgError)


def work_precision(
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
        ``compare(result, exact)`` -> error of a gradient or an answer. Default: Euclidean, relative.
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
        `.rows` (dicts), `.markdown()`, `.csv()`, `.plot(ax)`, `.pareto()`, `.save(folder)`, `.skipped`; str() is
        the table.

    Raises
    ------
    ValueError
        If `repeats` is not a whole number >= 1, there is no method, or the file is not such a table.
    TypeError
        If the problem does not give (loss, x); on several ranks.

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
    >>> methods = {"direct": {"method": "direct"}}
    >>> table = work_precision(poisson, methods, {"cells": [8, 16, 32]}, reference=(1 / 12, 1 / 12))
    >>> [f"{row['gradient_error']:.4f}" for row in table.rows]
    ['0.0313', '0.0078', '0.0020']
    """
    check_function("work_precision", problem, "lambda cells: (loss, x)")
    if process_count() > 1:
        raise TypeError("work_precision repeats runs by the clock, which no two ranks share; run it on one process")
    repeats = check_whole("repeats of work_precision", repeats, 1, "; the default is 3")
    if not methods or not isinstance(methods, dict):
        raise ValueError("work_precision needs at least one method; write {'name': {settings}}")
    for name, values in (over or {}).items():
        if isinstance(values, str) or not isinstance(values, Iterable):
            raise TypeError(
                f"over of work_precision takes a list of values for {name!r}, got {values!r}; write [{values!r}]"
            )
    scene, over, now, rows = scene or getattr(problem, "__name__", "scene"), over or {}, _versions(), []
    finished = {tuple(map(row.get, KEY)): row for row in _stored(file)}
    compare, known = compare or distance, {}

    def exact(shared):  # one for all methods
        words = _text_of(shared)
        if words not in known:
            known[words] = _exact(problem, reference, compare, shared)
        return known[words]

    other = sum(row["versions"] != now for row in finished.values())
    skipped = [f"{other} rows of {Path(file).name} from other versions: run again"] if other else []
    for (method, choice), *values in itertools.product(methods.items(), *over.values()):
        settings = dict(zip(over, values)) | choice
        reason = skip and skip(str(method), settings)
        if reason:
            skipped.append(f"{method} with {words_of(settings)}: {reason}")
            continue
        key = scene, str(method), _text_of(settings), str(seed), now
        if key not in finished:
            figures = _measured(problem, settings, repeats)
            if "answer" in figures:
                figures |= _errors(figures, partial(exact, {name: settings[name] for name in over}), compare)
            finished[key] = {name: figures.get(name, nan) for name in COLUMNS} | dict(zip(KEY, key))
            if file:
                write_file(file, table_of([*_stored(file), finished[key]], COLUMNS).csv())
        rows.append(finished[key])
    return Rows(scene=scene, over=tuple(over), rows=rows, skipped=skipped)


def words_of(settings):
    """Settings in words."""
    return ", ".join(f"{name}={value}" for name, value in settings.items()) or "no settings"


def _text_of(settings):
    return json.dumps(settings, sort_keys=True, default=str)


def _versions():
    """Python and the libraries that figures depend on, in words."""
    words = [f"python {platform.python_version()}"]
    for name in ("sparsedp", "numpy", "scipy", "autograd", "pyamg", "numba"):
        try:
            words.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            words.append(f"{name} -")
    return " ".join(words)


# ---------------------------------------------------------------- one run: timed, weighed, counted


def _prepared(problem, settings):
    """Settings -> (runs of the value, and of value and gradient; facts; what the result of the last run answers)."""
    given = problem(**settings)
    if not isinstance(given, tuple) or len(given) not in (2, 3):
        raise TypeError(
            f"a problem gives (loss, x) or (loss, x, facts), got {type(given).__name__}; write return loss, x"
        )
    loss, x, facts = (*given, {})[:3]
    alone = x is None  # the loss is the run itself, its result the answer
    runs = [loss] if alone else [partial(loss, x), partial(value_and_grad(loss), x)]
    output = facts.get("output")

    def answers(result):
        """(What the forward error is about, gradient)."""
        value, gradient = (result, None) if alone else result
        return np.asarray(value if output is None else output(x), float), gradient

    return runs, facts if alone else {"unknowns": sum(map(np.size, leaves(x))), **facts}, answers


def _measured(problem, settings, repeats):
    """Settings of one run -> its figures, with answer and gradient. What fails has a status only."""
    try:
        clock = perf_counter()
        runs, facts, answers = _prepared(problem, settings)
        seconds = perf_counter() - clock
        status, first, last = _warm(runs[-1])
        times = _times(runs, repeats) if status == "ok" else {}
        peak, result = _peak(runs[-1])
        answer, gradient = answers(result)
    except FAILURES as error:
        return {"status": _failure(error)}
    return {
        "answer": answer, "gradient": gradient, "unknowns": answer.size, **facts, "peak_bytes": peak, **times,
        **{name: total(last, kind) for name, kind in COUNTS.items()},
        "seconds_setup": seconds + total(first.seconds, "setup"),
        "status": status if np.all(np.isfinite(answer)) else "nonfinite",
    }  # fmt: skip


def _warm(run):
    """Run until the time has settled: compiled code, caches -> (status, calls of the first run, of the last)."""
    before, first = inf, None
    for _ in range(MOST_WARM_UPS):
        with recording() as calls:
            now = timeit(run, number=1)
        first = first or calls
        if before <= SETTLED * now + SHORT:  # it does not fall any more
            return "ok", first, calls
        before = now
    return "not_warm", first, calls


def _times(runs, repeats):
    """Runs of the value, and of value and gradient -> columns of their times.

    The time of the gradient is that of both less the least of the value.
    """
    row: dict = {}
    least = 0.0
    for name, run in zip(("seconds_forward", "seconds_backward"), runs):
        seconds = np.subtract(repeat(run, number=1, repeat=repeats), least)
        times = np.quantile(np.maximum(seconds, 0.0), (0.0, 0.5, 1.0)).tolist()
        row |= dict(zip((name, f"{name}_median", f"{name}_max"), times))
        least = times[0]
    return row


def _peak(run):
    """(Bytes that a run holds at most, beyond what there was before, as Python's allocator sees it; what it gives)."""
    running = tracemalloc.is_tracing()
    tracemalloc.start()  # nothing where it runs
    try:
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        result = run()
        return tracemalloc.get_traced_memory()[1] - before, result
    finally:
        if not running:
            tracemalloc.stop()


def _failure(error):
    """Status of a run that failed: the word of the solve, or the name of the error."""
    return getattr(getattr(error, "info", None), "status", None) or type(error).__name__


# ---------------------------------------------------------------- exact answers


def _errors(figures, exact, compare):
    """The columns of errors of one run, beside the exact answer."""
    try:
        value, slope, error = exact()
        pairs = {"forward_error": (figures["answer"], value), "gradient_error": (figures["gradient"], slope)}
        gaps = {name: compare(a, b) for name, (a, b) in pairs.items() if a is not None and b is not None}
        return gaps | {"reference_error": error}
    except FAILURES as trouble:
        return {"status": f"reference: {_failure(trouble)}"}


def _exact(problem, given, compare, shared):
    """The reference in any of its forms, at the settings that methods share -> (answer, gradient, error of both)."""
    if given is None:
        return None, None, nan
    if callable(given) or isinstance(given, tuple):
        return *(given(**shared) if callable(given) else given), 0.0
    tasks = [_prepared(problem, shared | finer) for finer in ([given] if isinstance(given, dict) else given)]
    *coarser, finest = [answers(runs[-1]()) for runs, _, answers in tasks]
    gaps = [compare(a, b) for rough in coarser for a, b in zip(rough, finest) if a is not None]
    return *finest, max(gaps, default=nan)


# ---------------------------------------------------------------- the table


class Rows(Result):
    """Error against run time. Made by `work_precision`.

    Attributes
    ----------
    scene : str
    over : tuple of str
        Names of the settings that vary.
    rows : list of dict
        Keys are COLUMNS; NaN where a figure does not exist.
    skipped : list of str
        Runs that were not made, with the reason.
    """

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

    def parts(self):
        """The figures, and the settings that tell those of a method apart; what was left out."""
        error = self.judged
        best = [row for row in self.pareto(error) if row[error] < 1]
        rows = [json.loads(row["settings"]) | row | {"best": "*" * (row in best)} for row in self.rows]
        apart = [name for name in self.over if name not in COLUMNS]
        errors = [row["reference_error"] for row in rows if row["reference_error"] >= 0]
        return [
            f"{self.scene}: error against run time",
            table_of(rows, ["method", *apart, *SHOWN, "best"]),
            *self.omissions(),
            *self._recommended(error),
            "A star: an error below 1, and no other row is both faster and more exact (the Pareto set).",
            *([f"Error of the reference: {max(errors):.1e}."] if errors else []),
        ]

    def _recommended(self, error):
        """The fastest method for each value of GOALS of this error, in words."""
        for goal in GOALS if self.pareto(error) else ():
            words, row = f"a {error.replace('_', ' ')} of {100 * goal:g} %", self.best(goal, error)
            if row is None:
                yield f"no method reaches {words}"
                return
            settings, seconds = words_of(json.loads(row["settings"])), self.seconds(row, error)
            yield f"fastest at {words}: {row['method']} ({settings}), {seconds:.1e} s"

    def plot(self, ax=None, error=None):
        """Log-log picture: run time across, error up, one curve for each method, the Pareto set marked.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Default: the current axes of pyplot.
        error : "gradient_error" or "forward_error"
            Default: that of the gradient, where there is one.

        Returns
        -------
        matplotlib Axes
        """
        ax, (lines, across, up) = plots.current(ax), self.curves(error)
        if lines:  # nothing has no logarithm
            plots.curves(lines, ax, across, up)
        ax.set_title(self.scene)
        return ax

    def curves(self, error=None):
        """The error over the run time, a curve for each method."""
        lines: dict = {}
        error = error or self.judged
        for *point, row in sorted(self._points(error), key=lambda point: point[0]):
            lines.setdefault(row["method"], []).append(point)
        return lines, "run time [s]", error.replace("_", " ")

    def save(self, folder):
        """Write scene.md, scene.csv and, where matplotlib is installed, scene.png into a folder -> list of paths.

        A scene may have a name that is no name of a file: "/" becomes "-". A file that cannot be written is an
        OSError.
        """
        folder = Path(folder)
        with path_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
        return plots.write_result(self, folder, self.stem, self.plot)


# ---------------------------------------------------------------- a file that can be continued


def _stored(file):
    """CSV file -> its rows, without one that was cut off; none without a file."""
    if not file or not os.path.exists(file):
        return []
    with path_errors(file, reading=True):
        stream = open(file, encoding="utf-8", newline="")
    with stream:
        reader = csv.DictReader(stream)
        if reader.fieldnames not in (None, list(COLUMNS)):
            raise ValueError(f"{Path(file).name} is no table of work_precision; give another file name")
        whole = [row for row in reader if row[COLUMNS[-1]] is not None]
    return [{name: text if name in TEXTS else _number(text) for name, text in row.items()} for row in whole]


def _number(text):
    return int(text) if text.isdigit() else float(text or "nan")
