"""The errors and warnings of this library.

Every error class also derives from a built-in exception, so that for example ``except ValueError`` catches it too. An
error message states what was given, what is expected and what to write instead.
"""

from __future__ import annotations

from typing import Any

__all__ = [
    "BudgetWarning",
    "ConvergenceError",
    "DerivativeError",
    "DiskWarning",
    "GrowthWarning",
    "IncompatibleError",
    "JitError",
    "JitWarning",
    "NonFiniteError",
    "NonFiniteGradientWarning",
    "PosteriorWarning",
    "RangeWarning",
    "ShapeError",
    "SparsedpError",
    "UnstableStepError",
]


class SparsedpError(Exception):
    """Base class of the errors of this library."""


class ShapeError(SparsedpError, ValueError):
    """An array or an operator does not fit the space on which it is used."""


class NonFiniteError(SparsedpError, ValueError):
    """A field or a parameter holds NaN or infinity, or a result overflows."""


class UnstableStepError(SparsedpError, ValueError):
    """A time step is too large for the stability of the scheme."""


class DerivativeError(SparsedpError, TypeError):
    """A derivative does not exist, or a user-defined rule returned a derivative of the wrong shape or type."""


class JitError(SparsedpError, TypeError):
    """`dp.jit` cannot record a function, or its program differs from the function."""


class JitWarning(UserWarning):
    """A jitted function was recorded for many forms of its arguments, so that most of its time goes into recording."""


class GrowthWarning(UserWarning):
    """A gradient through many time steps is exact, but grew so much that it is of little use."""


class BudgetWarning(UserWarning):
    """With at most twice the memory budget, the run would take only a third of the time."""


class DiskWarning(UserWarning):
    """The folder for the states of a rollout has no more space, or contains files of runs that were interrupted."""


class NonFiniteGradientWarning(UserWarning):
    """A returned derivative holds NaN or infinity; the message names the call that caused it.

    `grad`, `value_and_grad`, `vjp`, `jvp` and `hvp` issue this warning. To raise an error instead, call
    ``warnings.filterwarnings("error", category=sparsedp.errors.NonFiniteGradientWarning)``.
    """


class RangeWarning(UserWarning):
    """An input of a network is outside the range of the training data; see `network.training_range`."""


class PosteriorWarning(UserWarning):
    """A posterior of `dp.laplace` has variances that are too large, or its mean is not the mode."""


class ConvergenceError(SparsedpError, RuntimeError):
    """A solve did not meet its tolerance.

    The message states the residual that was reached, and `info.status` the cause:

    - "max_iterations": increase `maxiter`, give a `preconditioner`, or use another `method`.
    - "stagnated", "diverged", "indefinite_operator": use ``method="direct"``, or check the operator.
    - "setup_failed": the operator is singular; add a shift, or fix the value of an unknown.
    - "empty_row", "empty_column": an unknown or an equation is missing in the matrix.

    If Newton's method fails (`implicit`, `steady`, implicit time steps), start from a better guess or take a smaller
    step. ``minimize`` handles this error at trial points. The guide docs/guides/solvers.md describes the rules that
    every solve follows, with a table of all causes.

    Attributes
    ----------
    info : SolveInfo or None
        The record of the solve: status, iterations, residual.
    best : ndarray or None
        The best iterate that was computed.
    branch : Branch or None
        The branch up to the failure, from `continuation`.
    """

    def __init__(self, message: str, info: Any = None, best: Any = None):
        super().__init__(message)
        self.info = info
        self.best = best
        self.branch: Any = None


class IncompatibleError(ConvergenceError):
    """The right-hand side of a singular system is not in the range of the operator."""
