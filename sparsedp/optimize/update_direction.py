r"""Update directions J^T (J J^T + damping)^(-power) g between the gradient and Gauss-Newton."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

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
from sparsedp.optimize.linearization import Linearization, left_singular
from sparsedp.solvers.scaling import largest, length

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["Direction", "DirectionFamily", "forms_jacobian", "update_direction"]

FORMS = {"auto": None, "dense": True, "krylov": False}  # whether the Jacobian is formed; None: if it is small
SETTLED = 1e-9  # relative change of the direction at which the bidiagonalization stops
EXHAUSTED = 1e-13  # relative size below which a new basis vector is rounding
CANCELLED = 0.1  # a vector that keeps less than this share in a pass of Gram-Schmidt gets a second pass
FIRST_COMPARISON = 4  # step of the bidiagonalization after which the direction is first computed, by an SVD
ROW_BLOCK = 32  # rows of a basis for which memory is allocated at a time
SHOWN = 5  # singular values in the text of a direction


class Direction(NamedTuple):
    """An update direction and the singular values from which it was built.

    Attributes
    ----------
    step : tree like x, or (n,) array
    spectrum : array
        The singular values that were computed, largest first.
    kept : int
        How many of them were used.
    method : str
        "dense" or "krylov".
    """

    step: Any
    spectrum: np.ndarray
    kept: int
    method: str

    def __str__(self):
        s = self.spectrum
        if not len(s):
            return f"direction ({self.method}): J is 0"
        places = dict.fromkeys(np.linspace(0, len(s) - 1, SHOWN, dtype=int))
        values = "  ".join(f"s[{place}] {s[place]:.2e}" for place in places)
        return f"direction ({self.method}): {len(s)} singular values, {self.kept} kept; {values}"


class DirectionFamily:
    """The options of an update direction, and its computation for a flat cotangent.

    Parameters
    ----------
    power : float
        From 0 to 1.
    damping : float
        >= 0, added to the squares of the singular values.
    truncation : float
        Singular values below this share of the largest are ignored.
    rank : int, optional
        Most steps of the bidiagonalization. Default: until the direction has settled.

    Notes
    -----
    Where J is formed, its singular values come group by group from Gram matrices, as exact as from an SVD. Otherwise
    the bidiagonalization of Golub and Kahan with full reorthogonalization needs products with J and J^T alone, and
    memory rank (m + n).
    """

    def __init__(self, power: float = 0.75, damping: float = 0.0, truncation: float = 1e-10, rank: int | None = None):
        self.power = check_number("power", power, "from 0 to 1", "; 0.75 gives half-inverse gradients")
        self.damping = check_number("damping", damping, ">= 0", "; the default is 0")
        self.truncation = check_number("truncation", truncation, "from 0 to below 1", "; the default is 1e-10")
        self.rank: float = np.inf
        if rank is not None:
            self.rank = check_whole("rank", rank, 1, "; leave it out for no limit")

    def __call__(self, linearization: Linearization, g: NDArray[np.float64]) -> Direction:
        """Return the flat direction for a flat cotangent g of the outputs."""
        if linearization.dense:
            return self.dense(linearization.jacobian(), g)
        return self.krylov(linearization, g)

    def dense(self, jacobian: NDArray[np.float64], g: NDArray[np.float64]) -> Direction:
        """Return the direction from J itself, m x n.

        It is (J^T J + damping)^(-power) J^T g, or the same with J J^T where that is smaller.
        """
        jacobian_unit = safe_unit(largest(jacobian))
        g_unit = safe_unit(largest(g))
        if jacobian_unit != 1:
            jacobian = jacobian / jacobian_unit
        if g_unit != 1:
            g = g / g_unit
        if len(jacobian) <= jacobian.shape[1]:
            vectors, s = left_singular(jacobian)
            factors, kept = self._factors(s, jacobian_unit)
            step = vectors @ (factors * (g @ vectors)) @ jacobian
        else:
            vectors, s = left_singular(jacobian.T)
            factors, kept = self._factors(s, jacobian_unit)
            step = vectors @ (factors * ((g @ jacobian) @ vectors))
        return Direction(self._in_units(step, jacobian_unit, g_unit), jacobian_unit * s, kept, "dense")

    def krylov(self, linearization: Linearization, g: NDArray[np.float64]) -> Direction:
        """Return the direction from products with J and J^T.

        Notes
        -----
        The bidiagonalization that starts with g gives J Q = P B with orthonormal P, Q and a lower bidiagonal B of one
        row more than columns. The direction is Q (B^T B + damping)^(-power) B^T P^T g: exact after min(m, n) steps, and
        usually settled long before. The part of g outside the range of J stays in P and has no effect.

        References
        ----------
        G. H. Golub, W. Kahan, Calculating the singular values and pseudo-inverse of a matrix, SIAM J. Numer. Anal. 2,
        1965; C. C. Paige, M. A. Saunders, LSQR: an algorithm for sparse linear equations and sparse least squares, ACM
        TOMS 8, 1982.
        """
        rows, columns = linearization.shape
        left = _OrthonormalRows(rows)
        right = _OrthonormalRows(columns)
        most_steps = min(rows, columns, self.rank)
        next_comparison = FIRST_COMPARISON
        weights = np.zeros(0)
        g_length = left.add(g)
        entries: list[float] = []  # of B: diagonal, below it, diagonal, ...
        while len(entries) < 2 * most_steps:
            if len(entries) % 2 == 0:
                entry = right.add(linearization.vjp(left.last))
            else:
                entry = left.add(linearization.jvp(right.last))
            if not entry > EXHAUSTED * max(entries, default=0.0):
                break
            entries.append(entry)
            if len(entries) == 2 * next_comparison:
                previous = weights
                weights, _, _ = self._from_bidiagonal(g_length, entries)
                change = weights - np.pad(previous, (0, next_comparison - len(previous)))
                if length(change) <= SETTLED * length(weights):
                    break
                next_comparison += max(FIRST_COMPARISON, next_comparison // 8)
        weights, s, kept = self._from_bidiagonal(g_length, entries)
        return Direction(weights @ right.rows[: len(weights)], s, kept, "krylov")

    def _from_bidiagonal(self, g_length, entries):
        """Return the direction in the basis Q, the singular values of B, and how many of them were used."""
        place = np.arange(len(entries))
        steps = (len(entries) + 1) // 2
        bidiagonal = np.zeros((steps + 1, steps))
        unit = safe_unit(max(entries, default=0.0))
        bidiagonal[(place + 1) // 2, place // 2] = np.divide(entries, unit)
        left, s, right = np.linalg.svd(bidiagonal, full_matrices=False)
        factors, kept = self._factors(s, unit)
        step = (factors * s * left[0]) @ right
        return self._in_units(step, unit, g_length), unit * s, kept

    def _in_units(self, step, jacobian_unit, g_unit):
        """Return the direction for J times jacobian_unit and g times g_unit, given that for J and g."""
        return step * g_unit * jacobian_unit ** (1.0 - 2.0 * self.power)

    def _factors(self, s, unit):
        """Return (s^2 + damping / unit^2)^(-power), 0 for ignored singular values, and how many are used."""
        used = (s > self.truncation * np.max(s, initial=0.0)) & (s > 0)
        factors = np.zeros_like(s)
        with np.errstate(over="ignore"):  # a damping that is large beside J gives a step of 0
            damping = np.sqrt(self.damping) / np.float64(unit)
        factors[used] = np.hypot(s[used], damping) ** (-2 * self.power)
        return factors, int(np.count_nonzero(used))


class _OrthonormalRows:
    """Orthonormal rows; memory is allocated in blocks."""

    last: NDArray[np.float64]

    def __init__(self, size):
        self._memory = np.empty((ROW_BLOCK, size))
        self._count = 0

    @property
    def rows(self):
        return self._memory[: self._count]

    def add(self, vector):
        """Append the normalized part of a vector that is orthogonal to the rows, and return the length of that part."""
        rest = vector - (self.rows @ vector) @ self.rows
        if length(rest) <= CANCELLED * length(vector):  # a second pass removes the rounding
            rest = rest - (self.rows @ rest) @ self.rows
        if self._count == len(self._memory):
            self._memory = np.concatenate([self._memory, np.empty((ROW_BLOCK, vector.size))])
        size = length(rest)
        self.last = rest / (size or 1.0)
        self._memory[self._count] = self.last
        self._count += 1
        return size


def forms_jacobian(form: str) -> bool | None:
    """Return whether a form of the direction forms the Jacobian; None: if it is small."""
    check_choice("method", form, FORMS)
    return FORMS[form]


def update_direction(
    outputs: Callable[[Any], Any],
    x: Any,
    g: ArrayLike | None = None,
    method: str = "auto",
    apart: bool = False,
    **options: Any,
) -> Direction:
    """Compute the direction J^T (J J^T + damping)^(-power) g, with the spectrum of J.

    Parameters
    ----------
    outputs : callable
        ``outputs(x)`` returns an array of m numbers; J is its Jacobian at x.
    x : array, or any nesting of them
        With n floating numbers.
    g : array like outputs(x), optional
        The cotangent, dL/dy. Default: the outputs themselves, the gradient of half their sum of squares.
    method : "auto", "dense" or "krylov"
        Whether J is formed; "auto": if it is small.
    apart : bool
        As in `minimize`.
    **options
        power=0.75, damping=0.0; truncation=1e-10: singular values below this share of the largest are ignored;
        rank=None: the most that are used.

    Returns
    -------
    Direction
        `.step`, a tree like x; `.spectrum`, `.kept`, `.method`; str() shows the spectrum. Update x <- x - rate step.

    Raises
    ------
    ValueError
        If an option is out of range.
    ShapeError
        If g has another shape than the outputs.

    See Also
    --------
    minimize, physical_gradient

    Notes
    -----
    With the singular values s of J the gradient J^T g is multiplied by (s^2 + damping)^(-power) in each singular
    direction. power 0: the gradient. 1/2: all directions equally far. 3/4: half-inverse gradients, the part of g in
    each direction times s^(-1/2). 1: Gauss-Newton, or Levenberg-Marquardt with damping.

    References
    ----------
    P. Schnell, P. Holl, N. Thuerey, Half-inverse gradients for physical deep learning, ICLR 2022.

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
    family = DirectionFamily(**options)
    packing = Packing(x)
    dense = forms_jacobian(method)
    linearization = Linearization(outputs, packing, packing.pack(x), apart=apart, dense=dense)
    if g is None:
        g = linearization.value
    check_shape("the cotangent", g, linearization.value.shape, "; give one like the outputs")
    check_finite("the cotangent", g)
    direction = family(linearization, np.asarray(g, dtype=float).reshape(-1))
    return direction._replace(step=packing.unpack(direction.step))
