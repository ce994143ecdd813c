"""What the loss is given after x: nothing, or the batch of the present iteration."""

from collections.abc import Sequence
from functools import lru_cache

from sparsedp.optimize.checkpoint import fingerprint

__all__ = ["Batches"]


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
    number : int
        Of the present iteration.

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
        self._cycle = None if given is None or callable(given) else len(given)
        if self._cycle == 0:
            raise ValueError("batches is empty; leave it out, and the loss is called with x alone")
        self.varied, self.number = given is not None, 0
        self._batch = lru_cache(maxsize=2)(given if callable(given) else lambda place: given[place])
        self._mark = lru_cache(maxsize=None)(lambda place: fingerprint(self._batch(place)))

    def _place(self, number):
        return number % self._cycle if self._cycle else number

    def now(self, back=0):
        """The arguments of the loss after x in this iteration, or so many iterations earlier."""
        return (self._batch(self._place(self.number - back)),) if self.varied else ()

    def mark(self, number):
        """A hash of the batch of an iteration."""
        return self._mark(self._place(number)) if self.varied else ""
