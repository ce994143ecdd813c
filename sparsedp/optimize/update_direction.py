r"""Update directions J^T (J J^T + damping I)^(-power) g, which include gradient descent and Gauss-Newton."""

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

FORMS = {"auto": None, "dense": True, "krylov": False}  # whether the Jacobian is formed; None: only if it is small
SETTLED = 1e-9  # the bidiagonalization stops when the relative change of the direction is below this
EXHAUSTED = 1e-13  # a new basis vector of relative norm below this consists of rounding errors
CANCELLED = 0.1  # Gram-Schmidt is repeated for vectors whose norm it reduces below this fraction
FIRST_COMPARISON = 4  # number of bidiagonalization steps before the direction is computed for the first time
ROW_BLOCK = 32  # number of basis vectors for which memory is allocated at a time
SHOWN = 5  # number of singular values that str() of a direction shows


class Direction(NamedTuple):
    """An update direction and the singular values from which it was computed.

    Attributes
    ----------
    step : tree like x, or (n,) array
        The direction.
    spectrum : array
        The computed singular values of J, in descending order.
    kept : int
        The number of singular values that were used, that is, not truncated.
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
        >= 0, added to the squared singular values.
    truncation : float
        Singular values below this multiple of the largest one are ignored.
    rank : int, optional
        Maximum number of bidiagonalization steps. Default: iterate until the direction has converged.

    Notes
    -----
    If J is formed, its singular values are computed from Gram matrices, in groups of similar size, with the accuracy of
    an SVD. Otherwise the Golub-Kahan bidiagonalization with full reorthogonalization is used. It needs only products
    with J and J^T, and memory for rank (m + n) numbers.
    """

    def __init__(self, power: float = 0.75, damping: float = 0.0, truncation: float = 1e-10, rank: int | None = None):
        self.power = check_number("power", power, "from 0 to 1", "; 0.75 gives half-inverse gradients")
        self.damping = check_number("damping", damping, ">= 0", "; the default is 0")
        self.truncation = check_number("truncation", truncation, "from 0 to below 1", "; the default is 1e-10")
        self.rank: float = np.inf
        if rank is not None:
            self.rank = check_whole("rank", rank, 1, "; leave it out for no limit")

    def __call__(self, linearization: Linearization, g: NDArray[np.float64]) -> Direction:
        """Return the direction for a cotangent g of the outputs, both as flat arrays."""
        if linearization.dense:
            return self.dense(linearization.jacobian(), g)
        return self.krylov(linearization, g)

    def dense(self, jacobian: NDArray[np.float64], g: NDArray[np.float64]) -> Direction:
        """Return the direction, given the matrix J of shape m x n.

        It is (J^T J + damping I)^(-power) J^T g, or J^T (J J^T + damping I)^(-power) g if m <= n.
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
        """Return the direction, computed from products with J and J^T only.

        Notes
        -----
        The bidiagonalization with starting vector g gives J Q = P B, where P and Q have orthonormal columns and B is
        lower bidiagonal, with one more row than columns. The direction is Q (B^T B + damping I)^(-power) B^T P^T g. It
        is exact after min(m, n) steps, and usually converges much earlier. The component of g orthogonal to the range
        of J has no effect.

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
        entries: list[float] = []  # entries of B, alternating: on the diagonal, below the diagonal
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
        """Return the coefficients of the direction in the basis Q, the singular values of B, and the number used."""
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
        """Rescale a direction that was computed from J / jacobian_unit and g / g_unit to that of J and g."""
        return step * g_unit * jacobian_unit ** (1.0 - 2.0 * self.power)

    def _factors(self, s, unit):
        """Return (s^2 + damping / unit^2)^(-power), or 0 for truncated singular values, and the number of others."""
        used = (s > self.truncation * np.max(s, initial=0.0)) & (s > 0)
        factors = np.zeros_like(s)
        with np.errstate(over="ignore"):  # if the damping is much larger than J, it overflows and the step is 0
            damping = np.sqrt(self.damping) / np.float64(unit)
        factors[used] = np.hypot(s[used], damping) ** (-2 * self.power)
        return factors, int(np.count_nonzero(used))


class _OrthonormalRows:
    """A growing set of orthonormal vectors, stored as rows; memory is allocated in blocks."""

    last: NDArray[np.float64]

    def __init__(self, size):
        self._memory = np.empty((ROW_BLOCK, size))
        self._count = 0

    @property
    def rows(self):
        return self._memory[: self._count]

    def add(self, vector):
        """Orthogonalize a vector against the rows, append it normalized, and return its norm before normalization."""
        rest = vector - (self.rows @ vector) @ self.rows
        if length(rest) <= CANCELLED * length(vector):  # repeat, because cancellation left rounding errors
            rest = rest - (self.rows @ rest) @ self.rows
        if self._count == len(self._memory):
            self._memory = np.concatenate([self._memory, np.empty((ROW_BLOCK, vector.size))])
        size = length(rest)
        self.last = rest / (size or 1.0)
        self._memory[self._count] = self.last
        self._count += 1
        return size


def forms_jacobian(form: str) -> bool | None:
    """Return whether the Jacobian is formed for a value of the option `form`; None: only if it is small."""
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
    """Compute the update direction J^T (J J^T + damping I)^(-power) g, and the singular values of J.

    Parameters
    ----------
    outputs : callable
        ``outputs(x)`` returns an array y of m numbers. J is its Jacobian at x.
    x : array, or any nesting of arrays
        Contains n floating-point numbers.
    g : array like outputs(x), optional
        The gradient dL/dy of a loss L with respect to the outputs. Default: y itself, which is the gradient of half the
        sum of squares of y.
    method : "auto", "dense" or "krylov"
        "dense" computes the matrix J; "krylov" uses products with J and J^T only. "auto" selects "dense" if J is small.
    apart : bool
        As in `minimize`.
    **options
        The exponent ``power=0.75`` and ``damping=0.0`` in the formula above. ``truncation=1e-10``: singular values
        below this multiple of the largest one are ignored. ``rank=None``: maximum number of bidiagonalization steps of
        the method "krylov".

    Returns
    -------
    Direction
        The direction `step`, a tree like x, to be used as x <- x - rate step; also `spectrum`, `kept` and `method`.
        str() of the result shows the singular values.

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
    In each singular direction of J, with singular value s, the gradient J^T g is multiplied by
    (s^2 + damping)^(-power). Special cases are power=0, the gradient; power=0.5, where the step length in a singular
    direction does not depend on s; power=0.75, half-inverse gradients; and power=1, Gauss-Newton, or
    Levenberg-Marquardt if the damping is positive.

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
