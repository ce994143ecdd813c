"""What the loss is given after x: nothing, or the batch of the present iteration."""

from collections.abc import Sequence
from functools import lru_cache

__all__ = ["Batches"]

FEW = 10  # batches of a function, whose number is not known


class Batches:
    """Batches by number of iteration, so that a run that is resumed sees the same ones.

    Parameters
    ----------
    given : None, sequence or callable
        A sequence is used in turn and again from its start; a callable is asked for the batch of an iteration, once.

    Attributes
    ----------
    varied : bool
        Whether two iterations may see two losses.
    period : int
        Number of iterations that the gradient must be small in: the length of a sequence, 10 for a function.

    Raises
    ------
    TypeError
        If it is neither; ValueError if the sequence is empty.
    """

    def __init__(self, given=None):
        if given is not None and not callable(given) and not isinstance(given, Sequence):
            raise TypeError(
                f"batches must be a list or a function of the iteration, got {type(given).__name__}; "
                "write list(batches)"
            )
        if isinstance(given, Sequence) and not given:
            raise ValueError("batches is empty; leave it out, and the loss is called with x alone")
        self.varied = given is not None
        self.period = len(given) if isinstance(given, Sequence) else FEW
        self._batch = lru_cache(maxsize=2)(given if callable(given) else lambda number: given[number % len(given)])

    def at(self, iteration):
        """The arguments of the loss after x in an iteration."""
        return (self._batch(iteration),) if self.varied else ()
