"""The answers of all solves of a run, kept, and corrected in a second run by one loose solve each.

With x an answer and r = b - A x its residual, A^-1 r is its error; solved to the share s, it takes all but s of
that error away. A run that starts from the answers of an earlier one, with data b' that have changed a little,
solves for b' - A x in place of b': that corrects x and follows the data at once. To follow the data and keep the
error, the old residual is taken off first: b' - A x - r.
"""

from collections import Counter
from copy import copy
from typing import Any, NamedTuple

import numpy as np

from sparsedp.derivative import value_and_grad
from sparsedp.errors import ConvergenceError
from sparsedp.ledger import recording, thread
from sparsedp.solvers.record import SolveLog

__all__ = ["Answer", "Answers", "run", "seen"]


class Answer(NamedTuple):
    """One solve: its solution, residual and right-hand side (flat), and the tolerance it was asked for."""

    x: np.ndarray
    r: np.ndarray
    size: float  # of the right-hand side
    rtol: float
    iterative: bool


class Answers:
    """Takes part in the solves of a run. Keys of `found` are (name, "forward" or "adjoint", turn).

    Parameters
    ----------
    before : dict, optional
        Answers of an earlier run: each is the start of the same solve.
    correct : callable, optional
        ``correct(key)``: whether the error of the answer is taken away, or kept. Default: always taken away.
    share : float or None
        Relative tolerance of each correction. None: the answers are taken as they are, without a solve.
    fresh : float, optional
        Tolerance of solves that have no answer yet. Default: their own.
    """

    def __init__(self, before=None, correct=None, share=1e-2, fresh=None):
        self.before = before or {}
        self.correct = correct or (lambda key: True)
        self.share, self.fresh = share, fresh
        self.found: dict[tuple, Answer] = {}
        self.calls: Any = None
        self._turns: Counter = Counter()

    def _key(self, name, kind):
        self._turns[name, kind] += 1
        return name, kind, self._turns[name, kind] - 1

    def _earlier(self, key, size):
        answer = self.before.get(key)
        return answer if answer is not None and answer.x.size == size else None

    def linear(self, solver, b, transposed, checked, start):
        """The solution of one linear solve, flat."""
        key = self._key(solver.name, "adjoint" if transposed else "forward")
        old = self._earlier(key, b.size)
        acting = (solver.system.given.T if transposed else solver.system.given)._flat
        if old is None:
            x = _loosely(solver, b, transposed, self.fresh) if self.fresh else None
            x = solver.solved(b, transposed, checked, start) if x is None else x
        elif self.share is None:
            x = old.x
        else:
            r = b - acting.apply(old.x)
            if not self.correct(key):
                r -= old.r
            x = old.x + (_loosely(solver, r, transposed, self.share) if np.any(r) else 0.0)
        rest, engine = b - acting.apply(x), solver.engine
        self.found[key] = Answer(x, rest, float(np.linalg.norm(b)), solver.system.rtol, engine.iterative)
        return x

    def root(self, root, equation, guess, leaves):
        """The solution of one nonlinear solve, flat."""
        key = self._key(root.name, "forward")
        old = self._earlier(key, guess.size)
        if old is None:
            x = root.solved(equation, guess, leaves)
        elif self.share is None:
            x = old.x
        else:
            x = root.corrected(equation, old.x, leaves, self.share, 0.0 if self.correct(key) else -old.r)
        rest = -equation.value(x, leaves)
        self.found[key] = Answer(x, rest, 0.0, root.rtol, True)
        return x


def _loosely(solver, r, transposed, share):
    """A^-1 r to the relative residual `share`, beside the log of the solver."""
    loose = copy(solver)
    loose.system, loose.log = copy(solver.system), SolveLog()
    loose.system.rtol = share
    try:
        return loose.solved(r, transposed, False)
    except ConvergenceError as error:
        if error.best is None:
            raise
        return error.best.reshape(-1)  # what it could not take away is still there to be seen


def run(loss, x, answers):
    """Value and gradient of a loss, with the answers taking part in its solves; `answers.calls` counts them."""
    return seen(value_and_grad(loss), x, answers)


def seen(function, x, answers):
    """function(x) with the answers taking part in its solves."""
    thread.observers.append(answers)
    try:
        with recording() as answers.calls:
            return function(x)
    finally:
        thread.observers.remove(answers)
