"""minimise(): the loop around every method."""

import inspect
import time

from sparsedp.fields import is_number, is_whole
from sparsedp.optimise.first_order import Adam, Descent, Stuck
from sparsedp.optimise.flat import Packing
from sparsedp.optimise.progress import progress_bar
from sparsedp.optimise.quasi_newton import Quasi
from sparsedp.optimise.result import Minimum, Record
from sparsedp.optimise.trials import Trials, norm

__all__ = ["minimise"]

METHODS = {"lbfgs": Quasi, "gd": Descent, "adam": Adam}


def minimise(
    loss, start, method="lbfgs", maxiter=100, tolerance=1e-8, callback=None, progress=False, gradient=None, **options
):
    """Loss and start -> the best point found: any nesting of arrays in, the same nesting out.

    Parameters
    ----------
    loss : callable
        ``loss(x) -> real scalar``.
    start : array, number, or any nesting of them in tuples, lists and dicts
        Not modified. Leaves that are not floating stay as they are.
    method : "lbfgs", "gd" or "adam"
    maxiter : int
        Most iterations; 0 evaluates the start and returns it.
    tolerance : float or callable
        Converged when the Euclidean norm of the gradient has fallen to `tolerance` times its value at the
        start; nothing in the test is absolute. A callable is asked ``tolerance(record, first_record)``.
    callback : callable, optional
        ``callback(record, x)`` after every iteration; a true answer stops the run.
    progress : bool or str
        A progress bar on standard error, a string is its label; needs the extra `plot`.
    gradient : callable, optional
        ``gradient(x)``, with the structure of x. Default: reverse mode.
    **options
        lbfgs: memory=10, line_search=20. gd: rate=None (found by backtracking), momentum=0.0,
        line_search=None or "backtracking". adam: rate=1e-3, betas=(0.9, 0.999), epsilon=1e-8.

    Returns
    -------
    Minimum
        `.x`, `.value`, `.history` (a record for each iteration), `.message`, `.converged`,
        `.evaluations`; str() is a table. `.x` is the best point seen.

    Raises
    ------
    ValueError
        If the method is not known, or maxiter, tolerance or an option is out of range.
    TypeError
        If the method has no such option.
    UnstableStepError, ConvergenceError, NonFiniteError
        If the loss raises one of them, or is NaN or infinite, at the start. At a trial point the same
        counts as an infinite loss: the search goes back, and the record of the iteration lists it.
    ImportError
        If a progress bar is wanted and tqdm is not installed.

    Examples
    --------
    >>> import autograd.numpy as anp
    >>> import numpy as np
    >>> best = minimise(lambda x: anp.sum((x["a"] - 3.0) ** 2), {"a": np.zeros(2), "n": 7})
    >>> best.x
    {'a': array([3., 3.]), 'n': 7}
    >>> best.converged
    True
    """
    stepper = _stepper(method, options)
    if not is_whole(maxiter, 0):
        raise ValueError(f"minimise needs maxiter >= 0, a whole number, got {maxiter!r}; the default is 100")
    if not callable(tolerance) and not (is_number(tolerance) and tolerance >= 0):
        raise ValueError(f"minimise needs a tolerance >= 0, got {tolerance!r}; the default is 1e-8")
    packing = Packing(start)
    trials = Trials(loss, gradient, packing)
    watch = Watch(trials, packing, tolerance, callback, progress_bar(progress, int(maxiter)))
    try:
        first = trials.first(packing.pack(start))
        stuck = None
        if not watch(first) and maxiter > 0:
            run = stepper.run if isinstance(stepper, Quasi) else lambda *rest: _iterate(stepper, *rest)
            stuck = run(first, trials, watch, int(maxiter))
    finally:
        watch.bar.close()
    message, converged = watch.reason(stuck)
    best = trials.best
    return Minimum(packing.unpack(best.vector), best.value, watch.history, method, message, converged, trials.count)


def _stepper(method, options):
    if method not in tuple(METHODS):
        raise ValueError(f"method must be one of {', '.join(METHODS)}, got {method!r}")
    known = list(inspect.signature(METHODS[method]).parameters)
    for name in options:
        if name not in known:
            raise TypeError(f"{method} has no option {name!r}; it has {', '.join(known)}")
    return METHODS[method](**options)


def _iterate(stepper, first, trials, watch, maxiter):
    """Advance a state until the watch stops it or it is stuck; return why it is stuck."""
    state = stepper.begin(first)
    while watch.iteration < maxiter:
        try:
            state = stepper.advance(state, trials)
        except Stuck as reason:
            return str(reason)
        if watch(state.trial):
            break
    return None


class Watch:
    """Keeps the history and decides when to stop. Called with every accepted trial; true means stop."""

    def __init__(self, trials, packing, tolerance, callback, bar):
        self._trials, self._packing = trials, packing
        self._tolerance, self._callback, self.bar = tolerance, callback, bar
        self._clock = time.perf_counter()
        self.history = []
        self.stopped = ""

    @property
    def iteration(self):
        """Number of the last recorded iteration."""
        return len(self.history) - 1

    def __call__(self, trial):
        seconds = time.perf_counter() - self._clock
        failed = self._trials.pop_failures()
        record = Record(len(self.history), trial.value, norm(trial.slope), seconds, self._trials.count, failed)
        self.history.append(record)
        self.bar.show(record)
        if self._met(record):
            self.stopped = "converged"
        elif self._callback is not None and record.iteration > 0:
            if self._callback(record, self._packing.unpack(trial.vector)):
                self.stopped = "callback"
        return bool(self.stopped)

    def _met(self, record):
        first = self.history[0]
        if record.gradient_norm == 0:
            return True
        if callable(self._tolerance):
            return bool(self._tolerance(record, first))
        return record.gradient_norm <= self._tolerance * first.gradient_norm

    def reason(self, stuck):
        """(message, converged) of a run that is over; `stuck` is why the method gave up, if it did."""
        last, first = self.history[-1], self.history[0]
        if self.stopped == "converged":
            if last.gradient_norm == 0:
                return "converged: the gradient is 0", True
            return (
                f"converged: the gradient is {last.gradient_norm / first.gradient_norm:.1e} of that at the start",
                True,
            )
        if self.stopped:
            return "stopped by the callback", False
        if stuck == "rounding":
            return "converged to rounding: the loss cannot fall further in floating point numbers", True
        if stuck:
            left = self._trials.pop_failures()
            refused = f", {len(left)} points refused ({left[-1].error}: {left[-1].message})" if left else ""
            return f"stopped: {stuck}{refused}; dp.check.gradient(loss, x) tells whether the gradient is right", False
        return f"stopped after {last.iteration} iterations, as maxiter asks", False
