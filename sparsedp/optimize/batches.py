"""The batch that the loss of an iteration is given."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

__all__ = ["Batches"]

PERIOD_OF_FUNCTION = 10  # a function does not say how many batches there are


class Batches:
    """Batches by number of iteration, so that a resumed run gets the same ones.

    Parameters
    ----------
    batches : None, sequence or callable
        A sequence is used cyclically. A callable ``batches(iteration)`` is called once for each iteration.

    Attributes
    ----------
    varied : bool
        Whether two iterations may have two losses.
    period : int
        Number of iterations in which the gradient must be small: the length of a sequence, 10 for a function.

    Raises
    ------
    TypeError
        If `batches` is neither.
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
        """Return the arguments of the loss after x in an iteration: one batch, or none."""
        if not self.varied:
            return ()
        return (self._batch_of(iteration),)
