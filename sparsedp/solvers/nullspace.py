"""The null space of a singular operator: one pair of vectors for each connected component.

With A r = 0 and l^T A = 0 on a component, the oblique projection P b = b - r (l.b) / (l.r) makes data
compatible, and the solution is the one with l.x = 0: inv = P A+ P. The transposed system has l and r
exchanged, so inv.T = P^T A+^T P^T, exactly. On a pure Neumann problem r is ones and l the cell volumes.
"""

from functools import cached_property

import numpy as np
from scipy.sparse import eye_array
from scipy.sparse.linalg import splu

from sparsedp._utils.validation import EPS
from sparsedp.operators.structure.base import Turning
from sparsedp.solvers.scaling import dot, norm

__all__ = ["NullSpace", "Projector", "find_null_space"]

ROUNDING = 8 * EPS  # a row whose entries sum to less than this share of their magnitudes sums to 0
POWER_STEPS = 3


class NullSpace:
    """Right and left null vectors of the singular components.

    Parameters
    ----------
    labels : int array, shape (n,), or None
        Component of each unknown, -1 where the operator is regular; None: one component, everywhere.
    right, left : arrays, shape (n,)
        r and l of all components in one array each, 0 where the operator is regular.
    count : int
    """

    total = whole = staticmethod(lambda numbers: numbers)  # on ranks, these are of all of them
    size_of = staticmethod(norm)

    def __init__(self, labels, right, left, count):
        self.labels, self.count = labels, count
        self.right, self.left = right, left
        self._sides = [_plainest(side) if labels is None else side for side in (right, left)]
        self._products = self._dots(self._sides[0], left)

    @classmethod
    def none(cls, size=0):
        """That of a regular operator."""
        return cls(None, np.zeros(size), np.zeros(size), 0)

    def _dots(self, side, values):
        """Sum of side * values over each component; `side` is 0 beside them."""
        if self.count != 1:
            return self._sums(side * values)
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is found by the caller
            return self.total(np.array([dot(side, values) if np.ndim(side) else side * values.sum()]))

    def _sums(self, values):
        if self.labels is None:
            return np.array([values.sum()])
        if values.dtype.kind == "c":  # bincount is real
            return self._sums(values.real) + 1j * self._sums(values.imag)
        return self.total(np.bincount(self.labels + 1, values, self.count + 1)[1:])

    def sums(self, b, transposed=False):
        """l.b on each component."""
        return self._dots(self._sides[not transposed], b)

    def project(self, b, transposed=False, into=None):
        """Take out, component by component, the part along the null space. The same map for b and x.

        `into`: array for the result.
        """
        return self.projected(b, transposed, into)[0] if self.count else b

    def projected(self, b, transposed=False, into=None, sums=None):
        """What `project` gives, and its norm. `sums`: what `sums(b)` gave, when it is known."""
        shares = (self.sums(b, transposed) if sums is None else sums) / self._products
        part = self._sides[transposed] * (shares[0] if self.count == 1 else np.append(shares, 0.0)[self.labels])
        with np.errstate(over="ignore", invalid="ignore"):
            b = np.subtract(b, part, out=into)
        return b, self.size_of(b)

    def defect(self, b, sums, size, floor, transposed=False):
        """The largest |l.b| / (|l| |b|) over the components, and the number of that component.

        `size` is the norm of b, `floor` a size below which |b| on a component counts as noise.
        """
        lengths = self._lengths[not transposed]
        if self.labels is None and size > floor:
            return float(abs(sums[0]) / (size * lengths[0])), 0
        sizes = np.maximum(np.sqrt(self._sums(np.conj(b) * b).real), floor)
        shares = np.abs(sums) / np.where(sizes > 0, sizes * lengths, 1.0)
        worst = int(np.argmax(shares))
        return float(shares[worst]), worst

    @cached_property
    def _lengths(self):
        return tuple(np.sqrt(self._dots(np.conj(side), side).real) for side in (self.right, self.left))

    def cells(self, number):
        """Indices of the unknowns of one component."""
        return np.arange(self.right.size) if self.labels is None else np.flatnonzero(self.whole(self.labels) == number)

    def anchors(self):
        """One unknown for each component, where it can be pinned: the largest |l r|."""
        if not self.count:
            return np.array([], dtype=int)
        weight = np.abs(self.right * self.left)
        labels = np.zeros(weight.size, dtype=int) if self.labels is None else self.labels
        order = np.lexsort((-weight, labels))
        found = order[np.unique(labels[order], return_index=True)[1]]
        return found[labels[found] >= 0]


class Projector(Turning):
    """x without its part along a null space, `inner`, as a linear map."""

    def act(self, x, out):
        self.inner.project(x, self.transposed, into=out)


def _plainest(side):
    """A null vector that is one number everywhere as that number: a pass less for each projection."""
    return side[0] if side.size and np.all(side == side[0]) else side


def find_null_space(system):
    """System -> NullSpace of its active part.

    Candidates are tried first, relative to the magnitudes of the rows: ones, volumes. Where only one
    side is known, the other is computed by solves with the component alone.

    Raises
    ------
    ArithmeticError
        If a null vector of the other side cannot be found, or is orthogonal to this one.
    """
    labels, count = system.components
    labels = np.zeros(system.size, dtype=int) if labels is None else labels
    if system.active is not None:  # what is not active goes into a bin of its own
        labels = np.where(system.active, labels, count)
    right, has_right = _candidates(system, labels, count, transposed=False)
    left, has_left = _candidates(system, labels, count, transposed=True)
    for number in np.flatnonzero(has_right != has_left):
        cells = np.flatnonzero(labels == number)
        block = system.entries[cells][:, cells]
        side, block = (left, block.T) if has_right[number] else (right, block)
        side[cells] = _computed(block)
    singular = has_right | has_left
    many = int(np.count_nonzero(singular))
    labels = np.append(np.where(singular, np.cumsum(singular) - 1, -1), -1)[labels]
    space = system.kernel(labels, right, left, many)
    if many and np.any(np.abs(space._products) <= 1e-10 * space._lengths[0] * space._lengths[1]):
        raise ArithmeticError("the right and the left null vector are orthogonal")
    return space


def _candidates(system, labels, count, transposed):
    """The first of the candidates that the operator maps to 0, component by component."""
    found, known = np.zeros(labels.size, system.op.dtype), np.zeros(count, dtype=bool)
    candidates = [np.ones(labels.size), system.volumes][: 1 if system.uniform else 2]
    members = system.counts(labels, None, count + 1)[:count] > 0
    for candidate in map(system.masked, reversed(candidates) if transposed else candidates):
        wrong = np.abs(system.product(candidate, transposed)) > ROUNDING * system.magnitude(candidate, transposed)
        fresh = members & ~known & (system.counts(labels, wrong, count + 1)[:count] == 0)
        chosen = np.append(fresh, False)[labels]
        found[chosen] = candidate[chosen]
        known |= fresh
    return found, known


def _computed(matrix):
    """The null vector of a singular matrix, by inverse iteration with a shift at rounding level."""
    size = matrix.shape[0]
    norm = abs(matrix).sum(axis=1).max()
    vector = np.ones(size, matrix.dtype)
    try:
        factors = splu((matrix + 4 * EPS * norm * eye_array(size)).tocsc())
    except RuntimeError:  # exactly singular in spite of the shift
        raise ArithmeticError("the null vector of the other side was not found") from None
    for _ in range(POWER_STEPS):
        vector = factors.solve(vector)
        vector = vector / np.max(np.abs(vector))
    if not np.max(np.abs(matrix @ vector)) <= 1e-10 * norm:
        raise ArithmeticError("the null vector of the other side was not found")
    return vector / vector[np.argmax(np.abs(vector))]  # of one sign where it can be, and positive then
