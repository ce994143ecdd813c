r"""One family of update directions: J^T (J J^T + damping)^(-power) g.

With the singular values s of J the gradient J^T g is multiplied by (s^2 + damping)^(-power) in each singular
direction. power 0: the gradient. 1/2: all directions equally far. 3/4: half-inverse gradients, the part of g in each
direction times s^(-1/2). 1: Gauss-Newton, or Levenberg-Marquardt with damping.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg

from sparsedp.fields import check_function, is_number
from sparsedp.optimize.flat import Packing
from sparsedp.optimize.linearised import Linearised
from sparsedp.optimize.singular_values import decomposed

__all__ = ["Direction", "Family", "update_direction"]

DENSE = 3e7  # entries of a Jacobian (240 MB) above which it is not formed
SETTLED = 1e-9  # relative change of the direction at which the bidiagonalisation stops
EXHAUSTED = 1e-13  # relative size below which a new basis vector is rounding
CANCELLED = 0.1  # a vector of which less is left after Gram and Schmidt's pass gets a second one
LOOK = 4  # fewest steps of the bidiagonalisation between two looks at the direction, which cost an SVD each
BLOCK = 32  # rows of a basis that are stored together


class Direction(NamedTuple):
    """An update direction: the step (a tree like x, or a flat array), and the singular values it was built from.

    `spectrum` are the singular values found, largest first; `kept` is how many of them were used.
    """

    step: np.ndarray
    spectrum: np.ndarray
    kept: int
    method: str

    def __str__(self):
        s = self.spectrum
        if not len(s):
            return f"direction ({self.method}): J is 0"
        marks = [0, len(s) // 4, len(s) // 2, 3 * len(s) // 4, len(s) - 1]
        shown = "  ".join(f"s[{i}] {s[i]:.2e}" for i in dict.fromkeys(marks))
        return f"direction ({self.method}): {len(s)} singular values, {self.kept} kept; {shown}"


class Family:
    """Which update direction, and how it is found.

    Parameters
    ----------
    power : float
        In [0, 1].
    damping : float
        >= 0, added to the squares of the singular values.
    truncation : float
        Singular values below this share of the largest are left out.
    method : "auto", "dense" or "krylov"
        dense: J is formed, and its singular values come group by group from Gram matrices, as exact as from an SVD
        (when truncation > 1e-7 all at once). krylov: Golub-Kahan bidiagonalisation with full reorthogonalisation from
        products with J and J^T alone; memory rank (m + n).
    rank : int or None
        Most steps of the bidiagonalisation; None: until the direction has settled.
    apart : bool
        The outputs along axis 0 are samples that see x independently: see Linearised.rows.
    """

    def __init__(self, power=0.75, damping=0.0, truncation=1e-10, method="auto", rank=None, apart=False):
        if not (is_number(power) and 0 <= power <= 1):
            raise ValueError(f"power must be from 0 to 1, got {power!r}; 0.75 gives half-inverse gradients")
        if not (is_number(damping) and 0 <= damping < np.inf):
            raise ValueError(f"damping must be finite and >= 0, got {damping!r}; the default is 0")
        if not (is_number(truncation) and 0 <= truncation < 1):
            raise ValueError(f"truncation must be from 0 to below 1, got {truncation!r}; the default is 1e-10")
        if method not in ("auto", "dense", "krylov"):
            raise ValueError(f"method must be auto, dense or krylov, got {method!r}")
        if rank is not None and not (isinstance(rank, int) and rank >= 1):
            raise ValueError(f"rank must be a whole number >= 1, got {rank!r}; leave it out for no limit")
        self.power, self.damping, self.truncation = float(power), float(damping), float(truncation)
        self.method, self.rank, self.apart = method, rank, bool(apart)

    def __call__(self, linearised, g):
        """Flat Direction for a flat cotangent g of the outputs."""
        if self.forms(*linearised.shape):
            return self.dense(linearised.rows(self.apart), g)
        return self.krylov(linearised.push, linearised.pull, g, min(linearised.shape))

    def forms(self, rows, columns):
        """Whether J is formed."""
        return self.method == "dense" or (self.method == "auto" and rows * columns <= DENSE)

    def dense(self, jacobian, g):
        """Direction from J itself, m x n."""
        if not jacobian.size:
            return Direction(np.zeros(jacobian.shape[1]), np.zeros(0), 0, "dense")
        if self.truncation > 1e-7 and len(jacobian) <= jacobian.shape[1]:
            return self._gram(jacobian, g)
        combine, s, parts = decomposed(jacobian, g)
        weights, kept = self._weights(s, parts)
        return Direction(combine(weights), s, kept, "dense")

    def _gram(self, jacobian, g):
        squares, u = scipy.linalg.eigh(jacobian @ jacobian.T, check_finite=False)
        s = np.sqrt(np.maximum(squares[::-1], 0.0))
        u = u[:, ::-1]
        weights, kept = self._weights(s, u.T @ g)
        inner = np.divide(weights, s, out=np.zeros_like(s), where=s > 0)
        return Direction(jacobian.T @ (u @ inner), s, kept, "gram")

    def _weights(self, s, parts):
        """s (s^2 + damping)^(-power) parts, 0 for the singular values that are left out."""
        kept = (s > self.truncation * s[0]) & (s > 0)
        factor = np.zeros_like(s)
        root = np.hypot(s[kept], np.sqrt(self.damping))
        factor[kept] = s[kept] * root ** (-2 * self.power)
        return factor * parts, int(np.count_nonzero(kept))

    def krylov(self, push, pull, g, limit):
        """Direction from products with J and J^T.

        The bidiagonalisation started with g gives J^T P = Q L^T with orthonormal P, Q and a lower bidiagonal L, and
        the direction is Q L^T (L L^T + damping)^(-power) P^T g: exact after min(m, n) steps, and usually settled long
        before. Source: G. H. Golub, W. Kahan, SIAM J. Numer. Anal. 2, 1965.
        """
        size = float(np.linalg.norm(g))
        rank = min(limit, self.rank or limit)
        basis = _Bidiagonal(push, pull, g) if size > 0 else None
        if basis is None or not basis.steps:
            return Direction(pull(0.0 * g), np.zeros(0), 0, "krylov")
        before = None
        while True:
            more = basis.grow(min(max(LOOK, basis.steps // 8), rank - basis.steps))
            weights, s, kept = self._small(basis, size)
            if not more or basis.steps >= rank or _settled(weights, before):
                return Direction(basis.combine(weights), s, kept, "krylov")
            before = weights

    def _small(self, basis, size):
        left, s, right = scipy.linalg.svd(basis.matrix(), check_finite=False)
        weights, kept = self._weights(s, left[0] * size)
        return right.T @ weights, s, kept


def _settled(weights, before):
    if before is None:
        return False
    change = np.linalg.norm(weights[: len(before)] - before) + np.linalg.norm(weights[len(before) :])
    return change <= SETTLED * np.linalg.norm(weights)


class _Rows:
    """Orthonormal rows, in blocks: no copy is made when one more comes."""

    def __init__(self, size):
        self._size, self._blocks, self.count = size, [], 0
        self.last = np.empty(0)

    def append(self, row):
        if self.count == BLOCK * len(self._blocks):
            self._blocks.append(np.empty((BLOCK, self._size)))
        self.last = self._blocks[-1][self.count % BLOCK]
        self.last[:] = row
        self.count += 1

    def _parts(self):
        return [block[: self.count - BLOCK * i] for i, block in enumerate(self._blocks)]

    def apart(self, vector):
        """The part of a vector orthogonal to the rows; twice where little is left, so that rounding stays out."""
        before = float(np.linalg.norm(vector))
        vector = vector - self._sum([rows @ vector for rows in self._parts()])
        if np.linalg.norm(vector) > CANCELLED * before:
            return vector
        return vector - self._sum([rows @ vector for rows in self._parts()])

    def combine(self, weights):
        """weights @ rows."""
        return self._sum([weights[BLOCK * i : BLOCK * (i + 1)] for i in range(len(self._blocks))])

    def _sum(self, shares):
        total = np.zeros(self._size)
        for share, rows in zip(shares, self._parts(), strict=True):
            total += share @ rows
        return total


class _Bidiagonal:
    """J^T P = Q L^T, one column more at a time."""

    def __init__(self, push, pull, g):
        self._push, self._pull = push, pull
        u = g / np.linalg.norm(g)
        v = pull(u)
        self._left, self._right = _Rows(u.size), _Rows(v.size)
        self._diagonal, self._below = [], []
        self._largest = 0.0
        self._add(u, v)

    @property
    def steps(self):
        return len(self._diagonal)

    def _add(self, u, v):
        """Append a left vector and v, what J^T makes of it; false when the space is exhausted."""
        v = self._right.apart(v)
        size = float(np.linalg.norm(v))
        if not size > EXHAUSTED * self._largest:
            return False
        self._largest = max(self._largest, size)
        self._left.append(u)
        self._right.append(v / size)
        self._diagonal.append(size)
        return True

    def grow(self, steps):
        """Up to so many steps; false when there is no further one."""
        for _ in range(steps):
            u = self._left.apart(self._push(self._right.last))
            size = float(np.linalg.norm(u))
            if not size > EXHAUSTED * self._largest:
                return False
            u = u / size
            if not self._add(u, self._pull(u)):
                return False
            self._below.append(size)
        return steps > 0

    def matrix(self):
        """L, k x k."""
        return np.diag(self._diagonal) + np.diag(self._below, -1)

    def combine(self, weights):
        """Q times weights."""
        return self._right.combine(weights)


def update_direction(outputs, x, g=None, **options):
    """Function and point -> the direction J^T (J J^T + damping)^(-power) g, with the spectrum of J.

    Parameters
    ----------
    outputs : callable
        ``outputs(x) -> array`` of m numbers; J is its Jacobian at x.
    x : array, or any nesting of them; n floating numbers
    g : array like outputs(x), optional
        The cotangent, dL/dy. Default: the outputs themselves, the gradient of half their sum of squares.
    **options
        power=0.75 (0: gradient, 3/4: half-inverse, 1: Gauss-Newton), damping=0.0, truncation=1e-10,
        method="auto" | "dense" | "krylov", rank=None, apart=False. truncation: singular values below this share
        of the largest are left out; rank: at most so many are kept; apart: as in `minimize`.

    Returns
    -------
    Direction
        `.step`, a tree like x; `.spectrum`, `.kept`, `.method`; str() tells the spectrum. Update x <- x - rate step.

    Raises
    ------
    ValueError
        If an option is out of range.
    ShapeError
        If g has another shape than the outputs.

    Notes
    -----
    Source: P. Schnell, P. Holl, N. Thuerey, Half-inverse gradients for physical deep learning, ICLR 2022.

    Examples
    --------
    >>> import numpy as np
    >>> direction = update_direction(lambda x: np.array([4.0, 1.0]) * x, np.ones(2), power=1.0)
    >>> direction.step
    array([1., 1.])
    >>> direction.spectrum
    array([4., 1.])
    """
    check_function("update_direction", outputs, "lambda x: A @ x - b")
    family, packing = Family(**options), Packing(x)
    linearised = Linearised(outputs, packing, packing.pack(x))
    cotangent = linearised.flat if g is None else linearised.like(g)
    found = family(linearised, cotangent)
    return found._replace(step=packing.unpack(found.step))
