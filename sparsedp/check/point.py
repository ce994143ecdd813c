"""The point where a gradient is audited, flattened to one real vector, and the directions of the audit.

A complex entry is stored as two real entries in points, gradients and directions, so that the derivative along a
direction is an ordinary dot product.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sparsedp._utils.pytree import copied, mapped, norm
from sparsedp._utils.validation import check_finite
from sparsedp.autodiff.backend import gathered
from sparsedp.autodiff.flattening import Packing, joined

__all__ = [
    "LARGEST_SHARE",
    "MOST_LEAVES",
    "QUICK_DIRECTIONS",
    "Point",
    "audit_generator",
    "is_random",
    "root_mean_square",
]

MOST_LEAVES = 8  # a tree with more leaves has no separate direction for each leaf
LARGEST_SHARE = 4.0  # the gradient direction moves an entry by at most this many units
QUICK_DIRECTIONS = ("random 1", "gradient")  # the only directions of a quick audit
SEED = 20240229


def audit_generator(rng: int | np.random.Generator | None) -> np.random.Generator:
    """Return the random generator of an audit. None gives a new generator with a fixed seed."""
    return np.random.default_rng(SEED if rng is None else rng)


def root_mean_square(vector: NDArray[Any]) -> float:
    """Return the root mean square of the entries; 0 for an empty vector."""
    return norm(vector) / np.sqrt(max(vector.size, 1))


def _as_numpy(leaf: Any) -> Any:
    """Return a leaf as a NumPy scalar or array. A distributed field is gathered from all ranks.

    Python scalars are converted, because they raise an error for a division by 0 and do not accept complex steps.
    """
    if isinstance(leaf, (float, complex)):
        return np.asarray(leaf)[()]
    return gathered(leaf)


def is_random(name: str) -> bool:
    """Return whether a name denotes a random direction in all leaves together."""
    return name.removeprefix("random ").isdigit()


def _contains(directions: Iterable[NDArray[Any]], direction: NDArray[Any]) -> bool:
    """Return whether a direction or its opposite is one of some directions."""
    return any(np.array_equal(direction, other) or np.array_equal(direction, -other) for other in directions)


class Point(Packing):
    """The point where a loss is audited, as a vector.

    Each leaf has a unit: the root mean square of its values, or 1 if all values are 0. A step of size t moves each leaf
    by t times its unit, so that leaves of different magnitude are changed by the same relative amount.

    Parameters
    ----------
    x : tree of arrays

    Attributes
    ----------
    vector : ndarray
        All floating leaves, flattened and concatenated.
    units : ndarray
        The unit of each entry of the vector.
    entries : int
        Number of entries of all floating leaves. A complex entry counts once.
    """

    def __init__(self, x: Any) -> None:
        super().__init__(mapped(_as_numpy, x))
        for name, values in zip(self.names, self.values):
            check_finite(name, values, "must be finite where a gradient is checked")
        self.vector = joined(self.values)
        self.values = self.arrays(self.vector)  # copies, because the caller may modify the arrays of x later
        self.units = self._leaf_sizes(self.vector)
        self.entries = sum(map(np.size, self.values))

    def tree(self, arrays: list[Any]) -> Any:
        """Return a tree like x that has `arrays` as its floating leaves, and copies of the other leaves."""
        return copied(super().tree(arrays))

    def fresh(self) -> Any:
        """Return a new copy of x."""
        return self.unpack(self.vector)

    def gradient(self, tree: Any) -> NDArray[Any]:
        """Return a gradient, given as a tree like x, as a vector."""
        return joined(self.slopes(tree))

    def directions(
        self,
        gradient: NDArray[Any],
        count: int,
        rng: np.random.Generator,
        is_wanted: Callable[[str], bool] | None = None,
    ) -> list[tuple[str, NDArray[Any]]]:
        """Return the names of the directions of an audit and their displacements for step size 1.

        Parameters
        ----------
        gradient : ndarray
            The gradient under test.
        count : int
            Number of random directions in all leaves together. Those that are equal or opposite to an earlier one are
            omitted: for one real number there is only one direction.
        rng : Generator
        is_wanted : callable, optional
            ``is_wanted(name)`` selects directions; default: all.

        Returns
        -------
        list of (str, ndarray)
            Random directions, and special directions for errors that would average out in random ones: one random
            direction in each leaf, the same displacement in all entries of a leaf, the gradient, and the entry with
            the largest gradient.
        """
        displacements: dict[str, NDArray[Any]] = {}
        for number in range(count):
            displacement = self.random(rng)
            if not _contains(displacements.values(), displacement):
                displacements[f"random {number + 1}"] = displacement
        if 1 < len(self.names) <= MOST_LEAVES:
            leaf_number = self._for_each_entry(range(len(self.values)))
            for number, name in enumerate(self.names):
                displacements[f"random in {name}"] = self.random(rng) * (leaf_number == number)
        if self.entries > 1:
            displacements["constant"] = self.units
            slopes = self.units * gradient
            largest = np.max(np.abs(slopes), initial=0.0)
            if largest:
                shares = slopes / largest
                displacements["gradient"] = self.units * shares / max(root_mean_square(shares), 1 / LARGEST_SHARE)
                is_largest = np.arange(slopes.size) == np.argmax(np.abs(slopes))
                displacements["largest entry"] = self.units * is_largest
        return [
            (name, displacement)
            for name, displacement in displacements.items()
            if np.any(displacement) and (is_wanted is None or is_wanted(name))
        ]

    def random(self, rng: np.random.Generator) -> NDArray[Any]:
        """Return a random displacement with a root mean square of one unit in each leaf."""
        values = rng.standard_normal(self.vector.size)
        return self.units * (values / self._leaf_sizes(values))

    def _leaf_sizes(self, vector: NDArray[Any]) -> NDArray[Any]:
        """Return for each entry the root mean square of its leaf, or 1 if the leaf is zero."""
        return self._for_each_entry([root_mean_square(part) or 1.0 for part in self.split(vector)])

    def _for_each_entry(self, leaf_values: Sequence[float]) -> NDArray[Any]:
        """Return a vector in which each entry has the value of its leaf."""
        return np.repeat(leaf_values, [part.size for part in self.split(self.vector)])
