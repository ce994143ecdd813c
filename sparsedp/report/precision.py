"""workprec: error against run time, of values and of gradients, one row for each run."""

import itertools
import json
import platform

import numpy as np

from sparsedp.fields import check_function, is_whole
from sparsedp.report.measurement import FAILURES, failure_word, measured_row, task_of
from sparsedp.report.rows import COLUMNS, Rows, kept_rows, write_row
from sparsedp.tree import leaves, norm

__all__ = ["workprec"]


def workprec(
    problem, methods, over=None, reference=None, compare=None, repeats=3, file=None, scene=None, skip=None, seed=0
):
    """Problem and methods -> error against run time: a table, one row for each method and setting.

    Parameters
    ----------
    problem : callable
        ``problem(**settings)`` -> (loss, x) or (loss, x, facts). Facts are columns (unknowns, steps, tolerance);
        facts["output"], a function of x, gives the array that the forward error is about in place of the loss.
        With x None, loss() is the run itself (an optimiser, say) and its result the answer; it has no gradient.
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
    scene, compare = scene or getattr(problem, "__name__", "scene"), compare or _distance
    known, left_out = kept_rows(file, _versions()) if file else ({}, [])
    wanted = Reference(problem, reference, compare)
    rows = []
    for method, settings in _runs(methods, over or {}):
        reason = skip and skip(method, settings)
        if reason:
            left_out.append(f"{method} with {_words(settings)}: {reason}")
            continue
        key = scene, method, json.dumps(settings, sort_keys=True, default=str), str(seed)
        row = known.get(key)
        if row is None:
            shared = {name: value for name, value in settings.items() if name in (over or {})}
            row = dict.fromkeys(COLUMNS, np.nan) | dict(zip(("scene", "method", "settings", "seed"), key, strict=True))
            row |= _row(problem, settings, wanted, shared, repeats) | {"versions": _versions()}
            if file:
                write_row(file, row)
        rows.append(row)
    return Rows(scene, rows, left_out)


def _runs(methods, over):
    for method, own in methods.items():
        for values in itertools.product(*over.values()):
            yield str(method), {**dict(zip(over, values, strict=True)), **own}


def _row(problem, settings, wanted, shared, repeats):
    found, answer, gradient = measured_row(problem, settings, repeats)
    row = {name: found[name] for name in found if name in COLUMNS}
    return row | ({} if answer is None else wanted.errors(answer, gradient, shared))


class Reference:
    """Where the exact answers come from; each is found once."""

    def __init__(self, problem, given, compare):
        self.problem, self.given, self.compare = problem, given, compare
        self._known: dict = {}

    def errors(self, answer, gradient, shared):
        """The columns of errors of one run."""
        if self.given is None:
            return {}
        try:
            value, slope, error = self._found(shared)
            found = {"forward_error": self.compare(answer, value), "reference_error": error}
            if gradient is not None and slope is not None:
                found["gradient_error"] = self.compare(gradient, slope)
            return found
        except FAILURES as trouble:
            return {"status": f"reference: {failure_word(trouble)}"}

    def _found(self, shared):
        key = json.dumps(shared, sort_keys=True, default=str)
        if key not in self._known:
            self._known[key] = self._make(shared)
        return self._known[key]

    def _make(self, shared):
        """(answer, gradient, error of the reference)."""
        if callable(self.given):
            return *self.given(**shared), 0.0
        if isinstance(self.given, tuple):
            return *self.given, 0.0
        chain = [self.given] if isinstance(self.given, dict) else list(self.given)
        *others, last = [self._refined({**shared, **settings}) for settings in chain]
        if not others:
            return *last, np.nan
        pairs = [(a, b) for a, b in zip(others[-1], last, strict=True) if a is not None]
        return *last, max(self.compare(a, b) for a, b in pairs)

    def _refined(self, settings):
        task = task_of(self.problem(**settings))
        forward, both = task.runs
        value, gradient = (forward(), None) if both is None else both()
        return task.answer(value), gradient


def _distance(found, wanted):
    """Euclidean distance relative to what is wanted."""
    pairs = [(np.asarray(a, float), np.asarray(b, float)) for a, b in zip(leaves(found), leaves(wanted), strict=True)]
    for a, b in pairs:
        if a.shape != b.shape:
            raise ValueError(
                f"workprec cannot compare shape {a.shape} with {b.shape}; give compare=function(found, wanted)"
            )
    size = norm([b for _, b in pairs])
    gap = norm([a - b for a, b in pairs])
    return gap / size if size else gap


def _words(settings):
    return ", ".join(f"{name}={value}" for name, value in settings.items()) or "no settings"


def _versions():
    from importlib.metadata import PackageNotFoundError, version

    found = [f"python {platform.python_version()}"]
    for name in ("sparsedp", "numpy", "scipy", "autograd", "pyamg", "numba"):
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"{name} -")
    return " ".join(found)
