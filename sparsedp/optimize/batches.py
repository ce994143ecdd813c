"""What the loss is given after x: nothing, or the batch of the present iteration."""

from collections.abc import Sequence

from sparsedp.optimize.checkpoint import fingerprint

__all__ = ["Batches"]


class Batches:
    """Batches by number of iteration, so that a run that is resumed sees the same ones.

    Parameters
    ----------
    given : None, sequence or callable
        A sequence is used in turn and again from its start; a callable is asked for the batch of an iteration.

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
        if given is not None and not callable(given) and not len(given):
            raise ValueError("batches is empty; leave it out, and the loss is called with x alone")
        self._given, self.number = given, 0
        self._last = -1, None  # a function is asked once for a batch that is used several times in a row
        self._marks = {}

    @property
    def varied(self):
        """Whether two iterations may see two losses."""
        return self._given is not None

    def now(self, back=0):
        """The arguments of the loss after x in this iteration, or so many iterations earlier."""
        if self._given is None:
            return ()
        return (self._batch(self.number - back),)

    def _batch(self, number):
        if not callable(self._given):
            return self._given[number % len(self._given)]
        if self._last[0] != number:
            self._last = number, self._given(number)
        return self._last[1]

    def mark(self, number):
        """A hash of the batch of an iteration."""
        if self._given is None:
            return ""
        if callable(self._given):
            return fingerprint(self._batch(number))
        place = number % len(self._given)
        if place not in self._marks:
            self._marks[place] = fingerprint(self._given[place])
        return self._marks[place]
