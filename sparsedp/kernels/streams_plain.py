"""NumPy twin of the compiled streams: the same formulas, every stream gathered into one array."""

import numpy as np

__all__ = ["run"]


class Numbers:
    """An array with the functions that formulas use beside + - *; see `emit.Lane`."""

    __slots__ = ("value",)

    def __init__(self, value):
        self.value = value

    def __add__(self, other):
        return Numbers(self.value + getattr(other, "value", other))

    def __sub__(self, other):
        return Numbers(self.value - getattr(other, "value", other))

    def __mul__(self, other):
        return Numbers(self.value * getattr(other, "value", other))

    def __truediv__(self, other):
        return Numbers(self.value / getattr(other, "value", other))

    def step(self):
        return Numbers(0.5 * (self.value > 0) + 0.5 * (self.value >= 0))

    def alike(self, other):
        here, there = self.value, other.value
        return Numbers(1.0 * (((here > 0) & (there > 0)) | ((here < 0) & (there < 0))))

    def zero(self):
        return Numbers(1.0 * (self.value == 0))

    def short_of(self, limit):
        return Numbers(1.0 - (self.value >= limit))

    def infinite(self):
        return Numbers(1.0 - np.isfinite(self.value))


def run(table, arrays):
    """See `sparsedp.kernels.streams.run`."""
    places, given = _Places(table, arrays), {}
    for number, stream in enumerate(table.formula.streams):
        if stream.read:
            given[stream.name] = Numbers(places.pool[places.index[number]])
    with np.errstate(invalid="ignore", over="ignore"):
        results, sums = table.formula.body(given)
    for number, stream in enumerate(table.formula.streams):
        if stream.write:
            places.write(number, results[stream.name].value)
    return np.array([np.sum(total.value) for total in sums])


class _Places:
    """The arrays one after another, and where each stream is found there."""

    def __init__(self, table, arrays):
        self.table, self.arrays = table, arrays
        starts = np.concatenate([[0], np.cumsum([array.size for array in arrays])])
        known = table.__dict__.get("_index")
        if known is None or not np.array_equal(known[0], starts):
            known = starts, [starts[which] + place for which, place in table.places]
            table.__dict__["_index"] = known
        self.index = known[1]
        self.pool = np.concatenate(arrays)

    def write(self, number, values):
        which, place = self.table.places[number]
        for array in np.unique(which):
            here = which == array
            self.arrays[array][place[here]] = values[here]
