"""work_precision: measure errors of values and gradients against run time, with one row for each run."""

from __future__ import annotations

import csv
import itertools
import json
import os
import platform
import tracemalloc
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from math import inf, isfinite, nan
from pathlib import Path
from time import perf_counter
from timeit import repeat, timeit
from typing import Any

import numpy as np

from sparsedp._utils.calls import deprecated_attribute
from sparsedp._utils.counters import Calls, recording
from sparsedp._utils.pytree import leaves
from sparsedp._utils.validation import check_function, check_type, check_whole
from sparsedp.autodiff.backend import process_count
from sparsedp.autodiff.derivative import value_and_grad
from sparsedp.check.summary import Result
from sparsedp.check.table import Table, table_of
from sparsedp.errors import SparsedpError
from sparsedp.io.atomic_files import path_errors, write_file
from sparsedp.report import plots
from sparsedp.report.certificate import distance
from sparsedp.report.explain import total

__all__ = ["COLUMNS", "Rows", "work_precision"]

SHOWN = (
    "unknowns",
    "steps",
    "tolerance",
    "forward_error",
    "gradient_error",
    "seconds_setup",
    "seconds_forward",
    "seconds_backward",
    "peak_bytes",
    "solves_forward",
    "solves_adjoint",
    "iterations",
    "status",
)
COLUMNS = (
    "scene",
    "method",
    *SHOWN,
    "seed",
    "versions",
    "settings",
    "reference_error",
    "seconds_forward_median",
    "seconds_forward_max",
    "seconds_backward_median",
    "seconds_backward_max",
)
KEY = ("scene", "method", "settings", "seed", "versions")  # columns that identify a row
TEXTS = (*KEY, "status")  # the other columns are numbers
FACTS = ("unknowns", "steps", "tolerance")  # columns that `problem` may give
COUNTS = {"solves_forward": "solve", "solves_adjoint": "adjoint", "iterations": "iterations"}  # column: kind of call
SETTLED_RATIO = 2.0  # the warm-up ends if the previous run took at most this many times as long
MOST_WARM_UPS = 7
SHORT = 2e-3  # [s]: differences below this time are ignored, since short times fluctuate
GOALS = (0.1, 0.01, 1e-3, 1e-4, 1e-6)  # errors for which the fastest method is named
FAILURES = (SparsedpError, ArithmeticError, ValueError, MemoryError, np.linalg.LinAlgError)


def work_precision(
    problem: Callable[..., Any],
    methods: Mapping[str, Mapping[str, Any]],
    over: Mapping[str, Iterable[Any]] | None = None,
    reference: Any = None,
    compare: Callable[[Any, Any], float] | None = None,
    repeats: int = 3,
    file: Any = None,
    scene: str | None = None,
    skip: Callable[[str, dict[str, Any]], str | None] | None = None,
    seed: int = 0,
) -> Rows:
    """Measure errors of values and gradients against run time, for several methods and settings.

    Parameters
    ----------
    problem : callable
        ``problem(**settings)`` returns (loss, x) or (loss, x, facts). The dict `facts` has values for the columns
        "unknowns", "steps" and "tolerance". Other numbers and strings in it become further columns. It may also have
        a function "output": then the forward error is the error of the array output(x), and not of the loss. If x is
        None, loss() is called without arguments, for example to run an optimizer; its result is compared with the
        reference, and there is no gradient.
    methods : dict
        A dict of settings for each method, by name of the method.
    over : dict, optional
        A list of values for each setting, by name of the setting. Every method is run with every combination. The
        printed table has a column for each of these settings.
    reference : (value, gradient), callable, dict, or list of two dicts
        The exact value and gradient, or a function of the settings in `over` that returns them. A dict of settings
        means that the reference is computed by `problem` with these settings in addition to those in `over`. With a
        list of two dicts, the second one gives the reference, and the difference of both results is the error of the
        reference. By default there is no reference, and the errors are NaN.
    compare : callable, optional
        ``compare(result, exact)`` returns the error of a value or a gradient. Default: the relative error in the
        Euclidean norm.
    repeats : int
        Number of timed runs after the warm-up. The shortest time is used.
    file : path, optional
        CSV file to which each row is added when it is finished. Rows that the file already has are not run again.
    scene : str, optional
        Name of the problem in the table. Default: the name of the function `problem`.
    skip : callable, optional
        ``skip(method, settings)`` returns the reason why a run is to be skipped, or None.
    seed : int
        Stored in every row. It is not passed to `problem`; the caller has to use it.

    Returns
    -------
    Rows
        It has the attributes `.rows` (list of dicts) and `.skipped`, and the methods `.markdown()`, `.csv()`,
        `.plot(ax)`, `.pareto()` and `.save(folder)`. str() returns the table.

    Raises
    ------
    ValueError
        If `repeats` is not an integer >= 1, `methods` is empty, or `file` is another kind of file.
    TypeError
        If `problem` does not return (loss, x) or its facts cannot be columns, `reference` has another form, or the
        program runs on several MPI ranks.

    See Also
    --------
    explain

    Notes
    -----
    Before it is timed, a run is repeated until its time no longer decreases. If this does not happen, the row has the
    status "not_warm" and no times. The set-up time is the time of problem(...) and of the set-ups of solvers in the
    first run. The backward time is the time of value and gradient minus the time of the value. The peak bytes are
    measured by tracemalloc in one run. A run that raises an exception has a row, too; its status is the status of the
    failed solve, or the name of the exception.

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
        raise TypeError("work_precision measures times, which differ between processes; run it on one process")
    repeats = check_whole("repeats of work_precision", repeats, 1, "; the default is 3")
    if not methods or not isinstance(methods, dict):
        raise ValueError("work_precision needs at least one method; write {'name': {settings}}")
    over = over or {}
    for name, values in over.items():
        if isinstance(values, str) or not isinstance(values, Iterable):
            raise TypeError(
                f"over of work_precision takes a list of values for {name!r}, got {values!r}; write [{values!r}]"
            )
    _check_reference(reference)
    scene = scene or getattr(problem, "__name__", "scene")
    compare = compare or distance
    versions = _versions()
    references = _References(problem, reference, compare)
    finished = {tuple(row.get(name) for name in KEY): row for row in _stored(file)}
    skipped = []
    outdated = sum(row["versions"] != versions for row in finished.values())
    if outdated:
        skipped.append(f"{outdated} rows of {Path(file).name} from other versions: run again")
    rows = []
    for (method, choice), *values in itertools.product(methods.items(), *over.values()):
        settings = dict(zip(over, values)) | dict(choice)
        if skip:
            reason = skip(str(method), settings)
        else:
            reason = None
        if reason:
            skipped.append(f"{method} with {words_of(settings)}: {reason}")
            continue
        key = (scene, str(method), _text_of(settings), str(seed), versions)
        if key not in finished:
            figures, answer = _measure(problem, settings, repeats)
            if answer is not None:
                shared = {name: settings[name] for name in over}
                figures |= _errors(answer, references, shared)
            finished[key] = dict.fromkeys(COLUMNS, nan) | figures | dict(zip(KEY, key))
            if file:
                write_file(file, table_of(_same_columns([*_stored(file), finished[key]])).csv())
        rows.append(finished[key])
    return Rows(scene=scene, over=tuple(over), rows=_same_columns(rows), skipped=skipped)


def _same_columns(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows with the columns of all of them. A fact that a row does not have is NaN."""
    columns = dict.fromkeys([*COLUMNS, *(name for row in rows for name in row)], nan)
    return [columns | row for row in rows]


def words_of(settings: Mapping[str, Any]) -> str:
    """Return settings as text for a sentence."""
    return ", ".join(f"{name}={value}" for name, value in settings.items()) or "no settings"


def _text_of(settings: Mapping[str, Any]) -> str:
    """Return settings as JSON text, which is stored in a row and identifies it."""
    return json.dumps(settings, sort_keys=True, default=str)


def _versions() -> str:
    """Return the versions of Python and of the libraries that influence the results."""
    words = [f"python {platform.python_version()}"]
    for name in ("sparsedp", "numpy", "scipy", "autograd", "pyamg", "numba"):
        try:
            words.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            words.append(f"{name} -")
    return " ".join(words)


# ---------------------------------------------------------------- one run: time, memory, counts


Answer = tuple[np.ndarray, Any]  # what the forward error is about, and the gradient or None


@dataclass
class _Task:
    """What `problem` returned for some settings.

    Attributes
    ----------
    runs : list of callable
        Functions without arguments that compute the value, and value and gradient. If `x` is None: only loss().
    x : tree or None
    facts : dict
        Values of columns, without "output".
    output : callable or None
        ``output(x)`` returns the array whose error is the forward error.
    """

    runs: Sequence[Callable[[], Any]]
    x: Any
    facts: dict[str, Any]
    output: Callable[[Any], Any] | None

    def answer(self, result: Any) -> Answer:
        """Return the answer, which the forward error is about, and the gradient from the result of the last run."""
        value = result
        gradient = None
        if self.x is not None:
            value, gradient = result
        if self.output is not None:
            value = self.output(self.x)
        return np.asarray(value, float), gradient


def _prepare(problem: Callable[..., Any], settings: Mapping[str, Any]) -> _Task:
    """Call `problem` with settings, and return its result as a task."""
    parts = problem(**settings)
    if not isinstance(parts, tuple) or len(parts) not in (2, 3):
        kind = type(parts).__name__
        raise TypeError(f"a problem gives (loss, x) or (loss, x, facts), got {kind}; write return loss, x")
    loss, x = parts[:2]
    facts: dict[str, Any] = {}
    if len(parts) == 3:
        check_type("the third result of a problem", parts[2], dict, "a dict", "{'steps': n}")
        facts |= parts[2]
    output = facts.pop("output", None)
    _check_facts(facts)
    if x is None:  # loss() is run without arguments, and its result is the answer
        return _Task([loss], x, facts, output)
    unknowns = sum(map(np.size, leaves(x)))
    runs = [partial(loss, x), partial(value_and_grad(loss), x)]
    return _Task(runs, x, {"unknowns": unknowns, **facts}, output)


def _check_facts(facts: Mapping[str, Any]) -> None:
    """Refuse facts that work_precision measures itself, and facts that do not fit into a cell of a table."""
    for name, value in facts.items():
        if name in COLUMNS and name not in FACTS:
            raise TypeError(f"work_precision fills the column {name!r} itself; give the fact another name")
        if not isinstance(value, (str, int, float, np.number)):
            kind = type(value).__name__
            raise TypeError(f"a fact of a problem is a number or a string, got {kind} for {name!r}")


def _measure(
    problem: Callable[..., Any], settings: Mapping[str, Any], repeats: int
) -> tuple[dict[str, Any], Answer | None]:
    """Return the columns of a run and its answer; only a status and None if the run fails."""
    try:
        start = perf_counter()
        task = _prepare(problem, settings)
        seconds = perf_counter() - start
        status, first_calls, last_calls = _warm_up(task.runs[-1])
        if status == "ok":
            times = _times(task.runs, repeats)
        else:
            times = {}
        peak_bytes, result = _peak_bytes(task.runs[-1])
        answer = task.answer(result)
    except FAILURES as error:
        return {"status": _status_of(error)}, None
    row = {
        "unknowns": answer[0].size,
        **task.facts,
        "peak_bytes": peak_bytes,
        **times,
        **{column: total(last_calls, kind) for column, kind in COUNTS.items()},
        "seconds_setup": seconds + total(first_calls.seconds, "setup"),
        "status": status if np.all(np.isfinite(answer[0])) else "nonfinite",
    }
    return row, answer


def _warm_up(run: Callable[[], Any]) -> tuple[str, Calls, Calls]:
    """Run until the time no longer decreases, since the first runs compile code and fill caches.

    Returns
    -------
    status : "ok" or "not_warm"
    first_calls, last_calls : Calls
        Calls of the first and of the last run.
    """
    status = "not_warm"
    last_seconds = inf
    first_calls = None
    for _ in range(MOST_WARM_UPS):
        with recording() as calls:
            seconds = timeit(run, number=1)
        first_calls = first_calls or calls
        if last_seconds <= SETTLED_RATIO * seconds + SHORT:
            status = "ok"
            break
        last_seconds = seconds
    return status, first_calls or calls, calls


def _times(runs: Sequence[Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Return the columns of times.

    The backward time is the time of value and gradient minus the shortest time of the value.
    """
    row: dict[str, float] = {}
    least = 0.0
    for name, run in zip(("seconds_forward", "seconds_backward"), runs):
        seconds = np.subtract(repeat(run, number=1, repeat=repeats), least)
        minimum, median, maximum = np.quantile(np.maximum(seconds, 0.0), (0.0, 0.5, 1.0)).tolist()
        row[name] = minimum
        row[f"{name}_median"] = median
        row[f"{name}_max"] = maximum
        least = minimum
    return row


def _peak_bytes(run: Callable[[], Any]) -> tuple[int, Any]:
    """Return the peak of allocated bytes during a run, as measured by tracemalloc, and the result of the run."""
    was_tracing = tracemalloc.is_tracing()
    tracemalloc.start()  # does nothing if it is already active
    try:
        tracemalloc.reset_peak()
        before, _ = tracemalloc.get_traced_memory()
        result = run()
        _, peak = tracemalloc.get_traced_memory()
        return peak - before, result
    finally:
        if not was_tracing:
            tracemalloc.stop()


def _status_of(error: BaseException) -> str:
    """Return the status of a run that failed: the status of its solve, or the name of the exception."""
    return getattr(getattr(error, "info", None), "status", None) or type(error).__name__


# ---------------------------------------------------------------- reference


def _check_reference(reference: Any) -> None:
    """Refuse a reference that has none of the documented forms."""
    is_pair = isinstance(reference, tuple) and len(reference) == 2
    is_list = isinstance(reference, list) and reference and all(isinstance(part, dict) for part in reference)
    if not (reference is None or callable(reference) or isinstance(reference, dict) or is_pair or is_list):
        raise TypeError(
            "reference of work_precision must be (value, gradient), a function of the settings, a dict of settings or "
            f"a list of such dicts, got {reference!r}; without an exact gradient write (value, None)"
        )


class _References:
    """The reference in any of its forms. It is computed once for each combination of settings in `over`."""

    def __init__(self, problem: Callable[..., Any], reference: Any, compare: Callable[[Any, Any], float]) -> None:
        self.problem = problem
        self.reference = reference
        self.compare = compare
        self._computed: dict[str, tuple[Any, Any, float]] = {}

    def at(self, shared: dict[str, Any]) -> tuple[Any, Any, float]:
        """Return answer, gradient and error of the reference, from a cache if possible."""
        text = _text_of(shared)
        if text not in self._computed:
            self._computed[text] = self._compute(shared)
        return self._computed[text]

    def _compute(self, shared: dict[str, Any]) -> tuple[Any, Any, float]:
        """Compute answer, gradient and error of the reference."""
        reference = self.reference
        if reference is None:
            return None, None, nan
        if callable(reference):
            reference = reference(**shared)
            if not isinstance(reference, tuple) or len(reference) != 2:
                raise TypeError(
                    f"the function reference of work_precision must return (value, gradient), got {reference!r}; "
                    "without an exact gradient return (value, None)"
                )
        if isinstance(reference, tuple):
            value, gradient = reference
            return value, gradient, 0.0
        if isinstance(reference, dict):
            refinements = [reference]
        else:
            refinements = reference
        answers = []
        for refinement in refinements:
            task = _prepare(self.problem, shared | refinement)
            answers.append(task.answer(task.runs[-1]()))
        *coarser, finest = answers
        gaps = [self.compare(a, b) for rough in coarser for a, b in zip(rough, finest) if a is not None]
        return *finest, max(gaps, default=nan)


def _errors(answer: Answer, references: _References, shared: dict[str, Any]) -> dict[str, Any]:
    """Return the columns with the errors of one run."""
    try:
        value, gradient, error = references.at(shared)
        row = {"reference_error": error}
        if value is not None:
            row["forward_error"] = references.compare(answer[0], value)
        if gradient is not None and answer[1] is not None:
            row["gradient_error"] = references.compare(answer[1], gradient)
        return row
    except FAILURES as failure:
        return {"status": f"reference: {_status_of(failure)}"}


# ---------------------------------------------------------------- the table


class Rows(Result):
    """The result of `work_precision`: errors and run times.

    Attributes
    ----------
    scene : str
    over : tuple of str
        Names of the settings that vary.
    rows : list of dict
        The keys are COLUMNS and the names of further facts. A value that was not measured is NaN.
    skipped : list of str
        Sentences about runs that were skipped, with the reasons.
    """

    judged = deprecated_attribute("judged", "main_error", "0.5")

    @property
    def stem(self) -> str:
        """Name of the files of `save`, without a suffix."""
        return self.scene.replace("/", "-")

    @property
    def main_error(self) -> str:
        """Error by which methods are compared: "gradient_error" if any row has it, else "forward_error"."""
        if self.pareto():
            return "gradient_error"
        return "forward_error"

    def seconds(self, row: dict[str, Any], error: str = "gradient_error") -> float:
        """Return the time of value and gradient for a gradient error, or the time of the value for a forward error."""
        if error == "gradient_error":
            return row["seconds_forward"] + row["seconds_backward"]
        return row["seconds_forward"] + 0.0

    def _points(self, error: str) -> list[tuple[float, float, dict[str, Any]]]:
        """Return (seconds, error, row) for each successful row in which both numbers are finite."""
        points = [(self.seconds(row, error), row[error], row) for row in self.rows if row["status"] == "ok"]
        return [point for point in points if isfinite(point[0] + point[1])]

    def pareto(self, error: str = "gradient_error") -> list[dict[str, Any]]:
        """Return the rows for which no other row has both less time and a smaller error, the fastest first."""
        return [row for *_, row in plots.pareto_front(self._points(error))]

    def best(self, error: float, which: str = "gradient_error") -> dict[str, Any] | None:
        """Return the fastest row whose error is at most `error`, or None."""
        return next((row for row in self.pareto(which) if row[which] <= error), None)

    def _settings_columns(self) -> dict[str, str]:
        """Return the name of the column of each setting that varies.

        It is "name (setting)" if the rows already have another value under that name.
        """
        columns = {}
        for name in self.over:
            values = [(json.loads(row["settings"])[name], row.get(name, nan)) for row in self.rows]
            is_same = all(value == setting or value != value for setting, value in values)
            columns[name] = name if is_same else f"{name} (setting)"
        return columns

    def parts(self) -> list[str | Table]:
        """Return the table of all rows, the skipped runs, and the fastest method for each error."""
        error = self.main_error
        best = [row for row in self.pareto(error) if row[error] < 1]
        columns = self._settings_columns()
        rows = []
        for row in self.rows:
            if row in best:
                star = "*"
            else:
                star = ""
            settings = {column: json.loads(row["settings"])[name] for name, column in columns.items()}
            rows.append(row | settings | {"best": star})
        further = [name for row in self.rows[:1] for name in row if name not in COLUMNS]
        names = dict.fromkeys(["method", *columns.values(), *SHOWN, *further, "best"])
        parts: list[str | Table] = [
            f"{self.scene}: error against run time",
            table_of(rows, list(names)),
            *self.omissions(),
            *self._recommendations(error),
            "A star: an error below 1, and no other row is both faster and more exact (the Pareto set).",
        ]
        errors = [row["reference_error"] for row in rows if row["reference_error"] >= 0]
        if errors:
            parts.append(f"Error of the reference: {max(errors):.1e}.")
        return parts

    def _recommendations(self, error: str) -> Iterator[str]:
        """Yield a sentence that names the fastest method for each error in GOALS."""
        if not self.pareto(error):
            return
        for goal in GOALS:
            target = f"a {error.replace('_', ' ')} of {100 * goal:g} %"
            row = self.best(goal, error)
            if row is None:
                yield f"no method reaches {target}"
                return
            settings = words_of(json.loads(row["settings"]))
            yield f"fastest at {target}: {row['method']} ({settings}), {self.seconds(row, error):.1e} s"

    def plot(self, ax: Any = None, error: str | None = None) -> Any:
        """Plot error against run time on logarithmic axes: one curve for each method, and the Pareto set as a band.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Default: the current axes of pyplot.
        error : "gradient_error" or "forward_error"
            Default: the error of the gradient if any row has one, else the forward error.

        Returns
        -------
        matplotlib Axes
        """
        ax = plots.current(ax)
        curves, xlabel, ylabel = self.curves(error)
        if curves:  # logarithmic axes cannot be empty
            plots.curves(curves, ax, xlabel, ylabel)
        ax.set_title(self.scene)
        return ax

    def curves(self, error: str | None = None) -> tuple[dict[str, list[Any]], str, str]:
        """Return the curves of error over run time, one for each method, and the labels of the axes."""
        error = error or self.main_error
        curves: dict[str, list[Any]] = {}
        for seconds, size, row in sorted(self._points(error), key=lambda point: point[0]):
            curves.setdefault(row["method"], []).append([seconds, size])
        return curves, "run time [s]", error.replace("_", " ")

    def save(self, folder: Any) -> list[Path]:
        """Write scene.md, scene.csv and, if matplotlib is installed, scene.png to a folder.

        Returns
        -------
        list of Path

        Raises
        ------
        OSError
            If a file cannot be written.

        Notes
        -----
        A "/" in the name of the scene is replaced by "-" in the file names.
        """
        folder = Path(folder)
        with path_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
        return plots.write_result(self, folder, self.stem, self.plot)


# ---------------------------------------------------------------- a file that can be continued


def _stored(file: Any) -> list[dict[str, Any]]:
    """Return the complete rows of a CSV file. The list is empty if the file does not exist."""
    if not file or not os.path.exists(file):
        return []
    with path_errors(file, reading=True):
        stream = open(file, encoding="utf-8", newline="")
    with stream:
        reader = csv.DictReader(stream)
        names = list(reader.fieldnames or COLUMNS)
        if tuple(names[: len(COLUMNS)]) != COLUMNS:
            raise ValueError(f"{Path(file).name} is no table of work_precision; give another file name")
        complete = [row for row in reader if row[names[-1]] is not None]
    return [{name: text if name in TEXTS else _value(text) for name, text in row.items()} for row in complete]


def _value(text: str) -> float | str:
    """Return the number in a cell; its text if it is not a number. An empty cell is NaN."""
    if text.isdigit():
        return int(text)
    try:
        return float(text or "nan")
    except ValueError:
        return text
