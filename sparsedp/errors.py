"""The errors and warnings of this library.

Every error also derives from a built-in exception, so that ``except ValueError`` works too. A message says what was
given, what is expected and what to write instead.
"""

from __future__ import annotations

from typing import Any

__all__ = [
    "BudgetWarning",
    "ConvergenceError",
    "DerivativeError",
    "GrowthWarning",
    "IncompatibleError",
    "NonFiniteError",
    "NonFiniteGradientWarning",
    "ShapeError",
    "SparsedpError",
    "UnstableStepError",
]


class SparsedpError(Exception):
    """Base class of the errors of this library."""


class ShapeError(SparsedpError, ValueError):
    """An array or an operator does not fit the space on which it is used."""


class NonFiniteError(SparsedpError, ValueError):
    """A field or a parameter holds NaN or infinity, or a result cannot be represented."""


class UnstableStepError(SparsedpError, ValueError):
    """A time step is larger than the scheme allows."""


class DerivativeError(SparsedpError, TypeError):
    """A derivative does not exist, or a rule returned one of the wrong form."""


class GrowthWarning(UserWarning):
    """A gradient through many steps grew so much that it is of little use, although it is exact."""


class BudgetWarning(UserWarning):
    """A run would take a third of the time with at most twice its memory budget."""


class NonFiniteGradientWarning(UserWarning):
    """A returned derivative holds NaN or infinity; the message names the call that caused it.

    `grad`, `value_and_grad`, `vjp`, `jvp` and `hvp` warn. Turn it into an error by
    ``warnings.filterwarnings("error", category=sparsedp.errors.NonFiniteGradientWarning)``.
    """


class ConvergenceError(SparsedpError, RuntimeError):
    """A solve did not meet its tolerance.

    Attributes
    ----------
    info : SolveInfo or None
        The record of the solve: status word, iterations, residual.
    best : ndarray or None
        The best iterate.
    """

    def __init__(self, message: str, info: Any = None, best: Any = None):
        super().__init__(message)
        self.info = info
        self.best = best


class IncompatibleError(ConvergenceError):
    """The right-hand side of a singular system is not in the range of the operator."""
