"""Formulas of `formulas` on many points: streams of numbers, cut into segments in which all of them run on.

A `Table` says where the streams of each segment start. Points at walls, at the far end of a periodic axis or at
solids are segments of their own, whose neighbours are somewhere else: the formula knows nothing of them.
"""

from functools import cached_property

import numpy as np

from sparsedp import kernels
from sparsedp.kernels.limited import FORMULAS

__all__ = ["PLACE", "TILE", "Table", "march", "run"]

PLACE = 44  # bits of a place in its array; above them the number of the array
TILE = 1024  # most points of a segment; streams of one number repeated are as long as this
SHORT = 8  # points in a mean segment from which on segments are worth it


class Table:
    """Segments of one formula.

    Parameters
    ----------
    number : int
        Of the formula.
    counts : int array, shape (segments,)
        Points of each segment.
    starts : list of int arrays, shape (segments,)
        For each stream of the formula: (number of the array << PLACE) + place where it starts.
    """

    def __init__(self, number, counts, starts):
        self.number, self.formula = number, FORMULAS[number]
        self.rows = np.ascontiguousarray(np.stack([counts, *starts], axis=1), dtype=np.int64)
        self.points = int(counts.sum())
        self.arrays = sorted({int(number) for start in starts for number in np.unique(start >> PLACE)})

    @property
    def long(self):
        """Whether segments are long enough for the compiled loop."""
        return self.points >= SHORT * len(self.rows) or self.points < 4096

    @cached_property
    def places(self):
        """For each stream: number of the array and place of every point, one array each."""
        counts = self.rows[:, 0]
        inside = np.arange(self.points) - np.repeat(np.cumsum(counts) - counts, counts)
        found = []
        for stream, starts in zip(self.formula.streams, self.rows[:, 1:].T, strict=True):
            place = np.repeat(starts & ((1 << PLACE) - 1), counts) + (0 if stream.fixed else inside)
            found.append((np.repeat(starts >> PLACE, counts), place))
        return found


def run(table, arrays):
    """Run the formula of a table on flat float64 arrays; return its sums over all points.

    Results are written into the arrays that the table names. The sums of a segment are added in a fixed order, so
    that nothing depends on the number of threads.
    """
    if not table.points:
        return np.zeros(table.formula.sums)
    if table.long and kernels.compiled():
        from sparsedp.kernels import streams_native

        return streams_native.run(table, arrays, kernels.threads())
    from sparsedp.kernels import streams_plain

    return streams_plain.run(table, arrays)


def march(table, arrays, strides, n, checked, turned):
    """Run the formula of a table n times in one call, for small arrays; None where there is no compiled loop.

    Parameters
    ----------
    table : Table
    arrays : list of flat float64 arrays
    strides : int array, shape (2, arrays)
        Bytes by which the start of each array moves on after an even and after an odd run.
    n : int
    checked : bool
        Whether to stop at a run whose first sum is not 0.
    turned : (results, aside, places, points)
        After run k, ``aside[places]`` is added to ``results[(k + 1) % 2, points]`` and set to 0.

    Returns
    -------
    int
        How many runs came before the one that stopped, or n.
    """
    if not (table.points and table.long and kernels.compiled()):
        return None
    from sparsedp.kernels import streams_native

    return streams_native.march(table, arrays, strides, n, checked, turned)
