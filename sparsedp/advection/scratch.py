"""Arrays that a call needs on its way only, kept for the next call: fresh pages cost more than many a pass."""

import numpy as np

__all__ = ["FEW", "Scratch"]

FEW = 1 << 14  # numbers that NumPy hands out as fast
MOST = 1 << 24  # numbers kept in all (128 MB)


class Scratch:
    """Spare arrays by size. Who takes an array owns it; it may give it back, or not."""

    def __init__(self):
        self.spare = {}

    def take(self, size):
        """An array of `size` numbers, whatever they are."""
        if size <= FEW:
            return np.empty(size)
        try:
            return self.spare[size].pop()
        except LookupError:  # asked for and taken in one go: another thread may want it too
            return np.empty(size)

    def lender(self, taken):
        """`take` that also puts the array into a list."""

        def lend(size):
            taken.append(self.take(size))
            return taken[-1]

        return lend

    def give(self, *arrays):
        """Keep arrays for later, as long as they are not too many."""
        for array in arrays:
            known = list(self.spare.items())  # in one go: another thread may bring a new size
            if array.size > FEW and array.size + sum(n * len(kept) for n, kept in known) <= MOST:
                self.spare.setdefault(array.size, []).append(array)
