"""Selection of the batch of data for each iteration of `minimize`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

__all__ = ["Batches"]

PERIOD_OF_FUNCTION = 10  # iterations used in the convergence test if `batches` is a function of unknown period


class Batches:
    """Batches of data, selected by the number of the iteration, so that a resumed run uses the same batches.

    Parameters
    ----------
    batches : None, sequence or callable
        A sequence is used cyclically. A function ``batches(iteration)`` returns the batch of an iteration.

    Attributes
    ----------
    varied : bool
        Whether batches are used, so that the loss may differ from one iteration to the next.
    period : int
        Number of successive iterations in which the gradient must be small for convergence: the length of a sequence,
        or 10 for a function.

    Raises
    ------
    TypeError
        If `batches` is not None, a sequence or callable.
    ValueError
        If the sequence is empty.
    """

    def __init__(self, batches: Sequence[Any] | Callable[[int], Any] | None = None):
        if batches is not None and not callable(batches) and not isinstance(batches, Sequence):
            raise TypeError(
                f"batches must be a list or a function of the iteration, got {type(batches).__name__}; "
                "write list(batches)"
            )
        if isinstance(batches, Sequence) and not batches:
            raise ValueError("batches is empty; leave it out to call the loss with x alone")
        self.varied = batches is not None
        self.period = PERIOD_OF_FUNCTION
        if isinstance(batches, Sequence):
            self.period = len(batches)
        self._batches = batches
        self._batch_of = lru_cache(maxsize=2)(self._compute)

    def _compute(self, iteration):
        """Return the batch of an iteration."""
        batches: Any = self._batches
        if callable(batches):
            return batches(iteration)
        return batches[iteration % len(batches)]

    def at(self, iteration: int) -> tuple[Any, ...]:
        """Return the arguments that follow x in a call of the loss: a tuple of one batch, empty without batches."""
        if not self.varied:
            return ()
        return (self._batch_of(iteration),)
