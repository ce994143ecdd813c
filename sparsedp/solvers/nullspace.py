"""The null space of a singular operator: one pair of vectors for each connected component.

With A r = 0 and l^T A = 0 on a component, the oblique projection P b = b - r (l.b) / (l.r) maps data into the range,
and the solution is the one with l.x = 0: inv = P A+ P. The transposed system has l and r exchanged, so that
inv.T = P^T A+^T P^T, exactly. On a pure Neumann problem r is ones and l the cell volumes.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import eye_array
from scipy.sparse.linalg import splu

from sparsedp._utils.validation import EPS
from sparsedp.operators.structure.base import Transposable
from sparsedp.solvers.scaling import dot, norm

if TYPE_CHECKING:
    from collections.abc import Callable

    from scipy.sparse import csr_array


__all__ = ["ROUNDING", "NullSpace", "Projector", "find_null_space"]

ROUNDING = 8 * EPS  # a row whose entries sum to less than this share of their magnitudes sums to 0
POWER_STEPS = 3
LARGEST_RESIDUAL = 1e-10  # share of |A| |r| beyond which A r is not 0
SMALLEST_PRODUCT = 1e-10  # share of |l| |r| below which two null vectors are orthogonal


def _unchanged(numbers: Any) -> Any:
    """Return the argument."""
    return numbers


class NullSpace:
    """Right and left null vectors of the singular components.

    Parameters
    ----------
    labels : int array, shape (n,), or None
        Component of each unknown, -1 where the operator is regular; None: one component, everywhere.
    right, left : arrays, shape (n,)
        r and l of all components in one array each, 0 where the operator is regular.
    count : int
        Number of singular components.
    """

    # Sums, arrays and norms over all processes that hold unknowns; a subclass replaces them.
    total: Callable[[Any], Any] = staticmethod(_unchanged)
    whole: Callable[[Any], Any] = staticmethod(_unchanged)
    size_of: Callable[[Any], float] = staticmethod(norm)

    def __init__(self, labels: np.ndarray | None, right: np.ndarray, left: np.ndarray, count: int) -> None:
        self.labels = labels
        self.count = count
        self.right = right
        self.left = left
        self._sides = [right, left]
        if labels is None:
            self._sides = [_as_number_if_constant(right), _as_number_if_constant(left)]
        self._products = self._dots(self._sides[0], left)

    @classmethod
    def none(cls, size: int = 0) -> NullSpace:
        """Return the null space of a regular operator."""
        return cls(None, np.zeros(size), np.zeros(size), 0)

    def _dots(self, side: Any, values: np.ndarray) -> np.ndarray:
        """Return the sum of side * values over each component; `side` is 0 beside them."""
        if self.count != 1:
            return self._sums(side * values)
        with np.errstate(over="ignore", invalid="ignore"):  # the caller tests for NaN and infinity
            if np.ndim(side):
                product = dot(side, values)
            else:
                product = side * values.sum()
            return self.total(np.array([product]))

    def _sums(self, values: np.ndarray) -> np.ndarray:
        """Return the sum over each component."""
        if self.labels is None:
            return np.array([values.sum()])
        if values.dtype.kind == "c":  # bincount is real
            return self._sums(values.real) + 1j * self._sums(values.imag)
        return self.total(np.bincount(self.labels + 1, values, self.count + 1)[1:])

    def sums(self, b: np.ndarray, transposed: bool = False) -> np.ndarray:
        """Return l.b on each component."""
        return self._dots(self._sides[not transposed], b)

    def project(self, b: np.ndarray, transposed: bool = False, into: np.ndarray | None = None) -> np.ndarray:
        """Subtract, on each component, the part along the null space: the same map for data and solutions.

        `into` is an array for the result.
        """
        if not self.count:
            return b
        return self.projected(b, transposed, into)[0]

    def projected(
        self,
        b: np.ndarray,
        transposed: bool = False,
        into: np.ndarray | None = None,
        sums: np.ndarray | None = None,
    ) -> tuple[np.ndarray, float]:
        """Return the result of `project` and its norm. `sums` is ``sums(b, transposed)`` if the caller has it."""
        if sums is None:
            sums = self.sums(b, transposed)
        shares = sums / self._products
        part = self._sides[transposed]
        if self.count == 1:
            part = part * shares[0]
        else:
            part = part * np.append(shares, 0.0)[self.labels]
        with np.errstate(over="ignore", invalid="ignore"):
            b = np.subtract(b, part, out=into)
        return b, self.size_of(b)

    def defect(
        self, b: np.ndarray, sums: np.ndarray, size: float, floor: float, transposed: bool = False
    ) -> tuple[float, int]:
        """Return the largest |l.b| / (|l| |b|) over the components, and the number of that component.

        `size` is the norm of b, `floor` a size below which |b| on a component is rounding.
        """
        lengths = self._lengths[not transposed]
        if self.labels is None and size > floor:
            return float(abs(sums[0]) / (size * lengths[0])), 0
        sizes = np.maximum(np.sqrt(self._sums(np.conj(b) * b).real), floor)
        shares = np.abs(sums) / np.where(sizes > 0, sizes * lengths, 1.0)
        largest = int(np.argmax(shares))
        return float(shares[largest]), largest

    @cached_property
    def _lengths(self) -> tuple[np.ndarray, ...]:
        """The norms of the right and of the left null vectors."""
        return tuple(np.sqrt(self._dots(np.conj(side), side).real) for side in (self.right, self.left))

    def cells(self, number: int) -> np.ndarray:
        """Return the indices of the unknowns of one component."""
        if self.labels is None:
            return np.arange(self.right.size)
        return np.flatnonzero(self.whole(self.labels) == number)

    def anchors(self) -> np.ndarray:
        """Return one unknown of each component that can be pinned: the one with the largest |l r|."""
        if not self.count:
            return np.array([], dtype=int)
        weight = np.abs(self.right * self.left)
        labels = self.labels
        if labels is None:
            labels = np.zeros(weight.size, dtype=int)
        order = np.lexsort((-weight, labels))
        _, firsts = np.unique(labels[order], return_index=True)
        anchors = order[firsts]
        return anchors[labels[anchors] >= 0]


class Projector(Transposable):
    """The projection of `NullSpace.project` as a linear map; `inner` is the NullSpace."""

    def act(self, x: np.ndarray, out: np.ndarray) -> None:
        """Write the projection of x into `out`."""
        self.inner.project(x, self.transposed, into=out)


def _as_number_if_constant(side: np.ndarray) -> Any:
    """Return a null vector of equal entries as one number: this saves a pass in each projection."""
    if side.size and np.all(side == side[0]):
        return side[0]
    return side


def find_null_space(system: Any) -> NullSpace:
    """Find the null space of the unknowns of a system.

    Ones and volumes are tried first, relative to the magnitudes of the rows. Where only one side is known, the other
    is computed by solves with the component alone.

    Raises
    ------
    ArithmeticError
        If a null vector of the other side cannot be found, or is orthogonal to this one.
    """
    labels, count = system.components
    if labels is None:
        labels = np.zeros(system.size, dtype=int)
    if system.active is not None:  # entries that are not unknowns get a label of their own
        labels = np.where(system.active, labels, count)
    right, has_right = _null_vectors(system, labels, count, transposed=False)
    left, has_left = _null_vectors(system, labels, count, transposed=True)
    for number in np.flatnonzero(has_right != has_left):
        cells = np.flatnonzero(labels == number)
        block = system.entries[cells][:, cells]
        if has_right[number]:
            left[cells] = _null_vector(block.T)
        else:
            right[cells] = _null_vector(block)
    singular = has_right | has_left
    singular_count = int(np.count_nonzero(singular))
    new_labels = np.where(singular, np.cumsum(singular) - 1, -1)
    labels = np.append(new_labels, -1)[labels]
    space = system.kernel(labels, right, left, singular_count)
    right_lengths, left_lengths = space._lengths
    if singular_count and np.any(np.abs(space._products) <= SMALLEST_PRODUCT * right_lengths * left_lengths):
        raise ArithmeticError("the right and the left null vector are orthogonal")
    return space


def _null_vectors(system: Any, labels: np.ndarray, count: int, transposed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each component, the first of ones and volumes that the operator maps to 0; and which have one."""
    vectors = np.zeros(labels.size, system.op.dtype)
    has_vector = np.zeros(count, dtype=bool)
    candidates = [np.ones(labels.size)]
    if not system.uniform:
        candidates.append(system.volumes)
    if transposed:
        candidates.reverse()
    has_members = system.counts(labels, None, count + 1)[:count] > 0
    for candidate in candidates:
        vector = system.masked(candidate)
        is_wrong = np.abs(system.product(vector, transposed)) > ROUNDING * system.magnitude(vector, transposed)
        fits = system.counts(labels, is_wrong, count + 1)[:count] == 0
        is_new = has_members & ~has_vector & fits
        cells = np.append(is_new, False)[labels]
        vectors[cells] = vector[cells]
        has_vector |= is_new
    return vectors, has_vector


def _null_vector(matrix: csr_array) -> np.ndarray:
    """Return the null vector of a singular matrix, by inverse iteration with a shift at the level of rounding."""
    size = matrix.shape[0]
    largest_sum = abs(matrix).sum(axis=1).max()
    vector = np.ones(size, matrix.dtype)
    try:
        factors = splu((matrix + 4 * EPS * largest_sum * eye_array(size)).tocsc())
    except RuntimeError:  # exactly singular in spite of the shift
        raise ArithmeticError("the null vector of the other side was not found") from None
    for _ in range(POWER_STEPS):
        vector = factors.solve(vector)
        vector = vector / np.max(np.abs(vector))
    if not np.max(np.abs(matrix @ vector)) <= LARGEST_RESIDUAL * largest_sum:
        raise ArithmeticError("the null vector of the other side was not found")
    return vector / vector[np.argmax(np.abs(vector))]  # of one sign if it can be, and positive then
