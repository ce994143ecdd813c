r"""One family of update directions: J^T (J J^T + damping)^(-power) g.

With the singular values s of J the gradient J^T g is multiplied by (s^2 + damping)^(-power) in each singular
direction. power 0: the gradient. 1/2: all directions equally far. 3/4: half-inverse gradients, the part of g in each
direction times s^(-1/2). 1: Gauss-Newton, or Levenberg-Marquardt with damping.
"""

from typing import NamedTuple

import numpy as np

from sparsedp._utils.pytree import safe_unit
from sparsedp._utils.validation import (
    check_choice,
    check_finite,
    check_function,
    check_number,
    check_shape,
    check_whole,
)
from sparsedp.autodiff.flattening import Packing
from sparsedp.optimize.linearised import Linearised, singular
from sparsedp.solvers.scaling import largest
from sparsedp.solvers.scaling import length as length_of

__all__ = ["Direction", "Family", "form_of", "update_direction"]

FORMS = {"auto": None, "dense": True, "krylov": False}  # whether the Jacobian is formed; None: when it is small
SETTLED = 1e-9  # relative change of the direction at which the bidiagonalisation stops
EXHAUSTED = 1e-13  # relative size below which a new basis vector is rounding
CANCELLED = 0.1  # a vector of which less is left after Gram and Schmidt's pass gets a second one
LOOK = 4  # fewest steps of the bidiagonalisation between two looks at the direction, which cost an SVD each
BLOCK = 32  # rows of a basis that memory is taken for at a time


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
        marks = dict.fromkeys(np.linspace(0, len(s) - 1, 5, dtype=int))
        shown = "  ".join(f"s[{i}] {s[i]:.2e}" for i in marks)
        return f"direction ({self.method}): {len(s)} singular values, {self.kept} kept; {shown}"


class Family:
    """Which update direction.

    Where J is formed its singular values come group by group from Gram matrices, as exact as from an SVD. Else Golub
    and Kahan's bidiagonalisation with full reorthogonalisation takes products with J and J^T alone, and memory
    rank (m + n).

    Parameters
    ----------
    power : float
        In [0, 1].
    damping : float
        >= 0, added to the squares of the singular values.
    truncation : float
        Singular values below this share of the largest are left out.
    rank : int or None
        Most steps of the bidiagonalisation; None: until the direction has settled.
    """

    def __init__(self, power=0.75, damping=0.0, truncation=1e-10, rank=None):
        self.power = check_number("power", power, "from 0 to 1", "; 0.75 gives half-inverse gradients")
        self.damping = check_number("damping", damping, ">= 0", "; the default is 0")
        self.truncation = check_number("truncation", truncation, "from 0 to below 1", "; the default is 1e-10")
        self.rank = np.inf if rank is None else check_whole("rank", rank, 1, "; leave it out for no limit")

    def __call__(self, linearised, g):
        """Flat Direction for a flat cotangent g of the outputs."""
        return self.dense(linearised.rows(), g) if linearised.dense else self.krylov(linearised, g)

    def dense(self, jacobian, g):
        """Direction from J itself, m x n: (J^T J + damping)^(-power) J^T g, or with J J^T where that is smaller."""
        wide = len(jacobian) <= jacobian.shape[1]
        unit, height = safe_unit(largest(jacobian)), safe_unit(largest(g))
        jacobian = jacobian if unit == 1 else jacobian / unit
        g = g if height == 1 else g / height
        vectors, s = singular(jacobian if wide else jacobian.T)
        shares, kept = self._shares(s, unit)
        weights = vectors @ (shares * ((g if wide else g @ jacobian) @ vectors))
        step = weights @ jacobian if wide else weights
        return Direction(self._in_units(step, unit, height), unit * s, kept, "dense")

    def krylov(self, linearised, g):
        """Direction from products with J and J^T.

        The bidiagonalisation started with g gives J Q = P B with orthonormal P, Q and a lower bidiagonal B of one row
        more than columns, and the direction is Q (B^T B + damping)^(-power) B^T P^T g: exact after min(m, n) steps,
        and usually settled long before. What of g is not in the range of J stays in P, and does no harm.
        Source: G. H. Golub, W. Kahan, SIAM J. Numer. Anal. 2, 1965; C. C. Paige, M. A. Saunders, ACM TOMS 8, 1982.
        """
        left, right = map(_Rows, linearised.shape)
        limit, look, weights = min(*linearised.shape, self.rank), LOOK, np.zeros(0)
        length = left.add(g)
        sizes: list = []  # of B: diagonal, below it, diagonal, ...
        while len(sizes) < 2 * limit:
            onto_rows = len(sizes) % 2 == 0
            size = right.add(linearised.pull(left.last)) if onto_rows else left.add(linearised.push(right.last))
            if not size > EXHAUSTED * max(sizes, default=0.0):
                break
            sizes.append(size)
            if len(sizes) == 2 * look:
                before, weights = weights, self._small(length, sizes)[0]
                moved = weights - np.pad(before, (0, look - len(before)))
                if length_of(moved) <= SETTLED * length_of(weights):
                    break
                look += max(LOOK, look // 8)
        weights, s, kept = self._small(length, sizes)
        return Direction(weights @ right.rows[: len(weights)], s, kept, "krylov")

    def _small(self, length, sizes):
        """The direction in the basis Q, the singular values of B, and how many of them were kept."""
        place, steps = np.arange(len(sizes)), (len(sizes) + 1) // 2
        small = np.zeros((steps + 1, steps))
        unit = safe_unit(max(sizes, default=0.0))
        small[(place + 1) // 2, place // 2] = np.divide(sizes, unit)
        left, s, right = np.linalg.svd(small, full_matrices=False)
        shares, kept = self._shares(s, unit)
        return self._in_units((shares * s * left[0]) @ right, unit, length), unit * s, kept

    def _in_units(self, step, unit, height):
        """Return the direction for J times unit and g times height, given that for J and g."""
        return step * height * unit ** (1.0 - 2.0 * self.power)

    def _shares(self, s, unit):
        """Return (s^2 + damping / unit^2)^(-power), 0 for the singular values that are left out; how many are not."""
        kept = (s > self.truncation * np.max(s, initial=0.0)) & (s > 0)
        shares = np.zeros_like(s)
        with np.errstate(over="ignore"):  # a damping that is large beside J leaves no step
            damping = np.sqrt(self.damping) / np.float64(unit)
        shares[kept] = np.hypot(s[kept], damping) ** (-2 * self.power)
        return shares, int(np.count_nonzero(kept))


class _Rows:
    """Orthonormal rows; memory for a block of them is taken at a time."""

    def __init__(self, size):
        self._memory, self._count = np.empty((BLOCK, size)), 0

    @property
    def rows(self):
        return self._memory[: self._count]

    def add(self, vector):
        """Append the direction of what of a vector is orthogonal to the rows; the length of that."""
        rest = vector - (self.rows @ vector) @ self.rows
        if length_of(rest) <= CANCELLED * length_of(vector):  # twice, so that rounding stays out
            rest = rest - (self.rows @ rest) @ self.rows
        if self._count == len(self._memory):
            self._memory = np.concatenate([self._memory, np.empty((BLOCK, vector.size))])
        size = length_of(rest)
        self._memory[self._count] = self.last = rest / (size or 1.0)
        self._count += 1
        return size


def form_of(word):
    """Whether the Jacobian is formed: True, False, or None for when it is small."""
    check_choice("method", word, FORMS)
    return FORMS[word]


def update_direction(outputs, x, g=None, method="auto", apart=False, **options):
    """Function and point -> the direction J^T (J J^T + damping)^(-power) g, with the spectrum of J.

    Parameters
    ----------
    outputs : callable
        ``outputs(x) -> array`` of m numbers; J is its Jacobian at x.
    x : array, or any nesting of them; n floating numbers
    g : array like outputs(x), optional
        The cotangent, dL/dy. Default: the outputs themselves, the gradient of half their sum of squares.
    method : "auto", "dense" or "krylov"
        Whether J is formed; auto: when it is small.
    apart : bool
        As in `minimize`.
    **options
        power=0.75 (0: gradient, 3/4: half-inverse, 1: Gauss-Newton), damping=0.0, truncation=1e-10, rank=None.
        truncation: singular values below this share of the largest are left out; rank: at most so many are kept.

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
    linearised = Linearised(outputs, packing, packing.pack(x), apart=apart, dense=form_of(method))
    g = linearised.value if g is None else g
    check_shape("the cotangent", g, linearised.value.shape, "; give one like the outputs")
    check_finite("the cotangent", g)
    direction = family(linearised, np.asarray(g, dtype=float).reshape(-1))
    return direction._replace(step=packing.unpack(direction.step))
