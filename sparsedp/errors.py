"""The tree of typed errors: what can go wrong, and what the caller can do about it.

Every class also derives from a built-in exception, so ``except ValueError`` keeps working.
The message is one sentence: what was given, what is needed, what to write instead.
"""

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
    """Base of all errors of this library."""


class ShapeError(SparsedpError, ValueError):
    """An array or an operator does not fit the space it is used on."""


class NonFiniteError(SparsedpError, ValueError):
    """A field or a parameter holds NaN or infinity, or a result cannot be represented."""


class UnstableStepError(SparsedpError, ValueError):
    """A time step is larger than the scheme allows."""


class DerivativeError(SparsedpError, TypeError):
    """A derivative was asked of something that has none, or a rule returned a wrong one."""


class GrowthWarning(UserWarning):
    """A gradient through a long run grew so much that it is exact and of little use."""


class BudgetWarning(UserWarning):
    """A memory budget with which a run takes three times as long as with at most twice as much."""


class NonFiniteGradientWarning(UserWarning):
    """A derivative that is returned holds NaN or infinity; the message names the call it comes from.

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
        The best iterate that was reached.
    """

    def __init__(self, message, info=None, best=None):
        super().__init__(message)
        self.info = info
        self.best = best


class IncompatibleError(ConvergenceError):
    """The right-hand side of a singular system is not in the range of the operator."""
