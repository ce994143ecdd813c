"""Gauss-Newton, Levenberg-Marquardt and half-inverse gradients.

The loss is half the sum of squares of residuals r(x); J is their Jacobian.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
import scipy.linalg
from scipy.sparse.linalg import LinearOperator, lsmr

from sparsedp._utils.pytree import norm, power_of_two, safe_unit
from sparsedp._utils.validation import check_choice, check_number
from sparsedp.optimize.bounded_least_squares import BoundedLeastSquares
from sparsedp.optimize.first_order import HALVINGS, admissible, backtracked
from sparsedp.optimize.method import Method
from sparsedp.optimize.result import Evaluation, NoStepFound, RoundingReached
from sparsedp.optimize.update_direction import DirectionFamily, forms_jacobian
from sparsedp.solvers.scaling import largest

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from sparsedp.optimize.linearization import Linearization
    from sparsedp.optimize.objective import Objective

__all__ = ["GaussNewton", "HalfInverse", "LevenbergMarquardt", "SquaresState"]

RANK_TOLERANCE = 1e-12  # singular values below this share of the largest are taken for 0
UNDAMPED_LENGTHS = 2  # of an undamped step that are tried: all of it and half of it
POOR = 0.1  # share of the decrease predicted by the gradient, 1/2 for a parabola, below which the next step is damped
FIRST_DAMPING = 1e-3  # of Gauss-Newton, relative to the largest diagonal entry of J^T J
LEAST_DAMPING = 1e-6  # below which its steps are undamped again
LSMR_ACCURACY = 1e-10  # relative
LSMR_CONDITION = 1e14  # at which LSMR stops
CHOLESKY_DAMPING = 1e-9  # relative to |J|^2: above it the Gram matrix, with rounding 1e-16, gives 6 digits of the step


class SquaresState(NamedTuple):
    """State of the least-squares methods.

    Attributes
    ----------
    current : Evaluation
    damping : float
        Of the Jacobian divided by `unit`.
    share : float
        Of the next step, which is tried first.
    unit : float
        A power of two for which the squares of J / unit are floats; 0 while it is unknown.
    """

    current: Evaluation
    damping: float = 0.0
    share: float = 1.0
    unit: float = 0.0


class LeastSquaresMethod(Method):
    """What the least-squares methods share: their options, and steps of the linearized problem inside the bounds.

    Attributes
    ----------
    apart : bool
        Residuals along axis 0 are samples that depend on x independently.
    absolute_sigma : bool
        Whether the residuals are divided by their standard deviations.
    forms_jacobian : bool or None
        Whether J is formed; None: if it is small.
    """

    uses_residuals: ClassVar[bool] = True
    apart: bool
    absolute_sigma: bool
    forms_jacobian: bool | None

    def begin(self, first: Evaluation) -> SquaresState:
        """Return the state at the start."""
        return SquaresState(first)

    def _check_common_options(self):
        """Validate the options that all methods have."""
        check_choice("absolute_sigma", self.absolute_sigma, (True, False), "; the default is False")
        self.apart = bool(self.apart)
        self.absolute_sigma = bool(self.absolute_sigma)


def _damped_step(
    current: Evaluation, linearization: Linearization, objective: Objective, damping: float, unit: float
) -> NDArray[np.float64]:
    """Return the minimum d of |J d + r|^2 + damping |unit d|^2 for which the current point + d is inside the box."""
    if not objective.box.bounded:
        return _unbounded_step(linearization, linearization.flat, damping, unit)
    problem = BoundedLeastSquares(current, linearization, objective.box, damping, unit)

    def solve(restricted, r):
        return _unbounded_step(restricted, r, damping, unit)

    return problem.minimum(solve, objective.free(current))


def _unbounded_step(linearization, r, damping, unit):
    """Return the minimum d of |J d + r|^2 + damping |unit d|^2."""
    if linearization.dense:
        jacobian = linearization.jacobian()
        if unit != 1:
            jacobian = jacobian / unit
        return -_negated_dense_step(jacobian, r, damping) / unit
    product = LinearOperator(
        linearization.shape,
        lambda v: linearization.jvp(v / unit),
        lambda w: linearization.vjp(w) / unit,
        dtype=float,
    )
    solution = lsmr(product, r, damp=np.sqrt(damping), atol=LSMR_ACCURACY, btol=LSMR_ACCURACY, conlim=LSMR_CONDITION)
    return -solution[0] / unit


def _negated_dense_step(jacobian, r, damping):
    """Return -d for the minimum d of |J d + r|^2 + damping |d|^2.

    Where that is exact, by Cholesky of J J^T + damping or J^T J + damping: far faster than by singular values.
    """
    if damping <= CHOLESKY_DAMPING * np.linalg.norm(jacobian) ** 2:
        return DirectionFamily(1.0, damping, RANK_TOLERANCE).dense(jacobian, r).step
    wide = len(jacobian) < jacobian.shape[1]
    if wide:
        gram = jacobian @ jacobian.T
        right_side = r
    else:
        gram = jacobian.T @ jacobian
        right_side = r @ jacobian
    gram.flat[:: len(gram) + 1] += damping
    solution = scipy.linalg.solve(gram.T, right_side, overwrite_a=True, check_finite=False, assume_a="pos")
    if wide:
        return solution @ jacobian
    return solution


def _advance_damped(
    state: SquaresState, linearization: Linearization, objective: Objective, failure: str
) -> SquaresState:
    """Return the state after a step with as much damping as it takes to lower the loss.

    Raises
    ------
    NoStepFound
        With the message `failure`, if no damping is large enough.
    """
    current = state.current
    unit = state.unit

    def candidates() -> Iterator[tuple[NDArray[np.float64], float, float]]:
        """Yield points with ever more damping."""
        damping = state.damping
        growth = 2.0
        for _ in range(HALVINGS):
            step = _damped_step(current, linearization, objective, damping, unit)
            point = objective.box.moved(current.point, step)
            change = linearization.jvp(point - current.point)
            yield point, -float(np.dot(change, linearization.flat + 0.5 * change)), damping
            damping *= growth
            growth *= 2

    try:
        evaluation, share_of_decrease, damping = objective.first_lower(current, candidates(), failure)
    except NoStepFound as error:
        _check_rounding(error, current, linearization, objective)
        raise NoStepFound(failure) from None
    damping *= max(1 / 3, 1 - (2 * share_of_decrease - 1) ** 3)
    return state._replace(current=evaluation, damping=damping)


def _check_rounding(
    error: NoStepFound, current: Evaluation, linearization: Linearization, objective: Objective
) -> None:
    """Raise a RoundingReached of a search again, unless a gradient step promises a visible decrease."""
    if isinstance(error, RoundingReached):
        gradient_step = BoundedLeastSquares(current, linearization, objective.box, 0.0, 1.0).gradient_step()
        if not objective.decrease_is_visible(current, gradient_step):
            raise error


def _largest_column_norm(linearization: Linearization) -> float:
    """Return the norm of the largest column of J; where J is not formed, its norm along the gradient."""
    if linearization.dense:
        jacobian = linearization.jacobian()
        unit = power_of_two(largest(jacobian))
        return unit * float(np.max(np.linalg.norm(jacobian / unit, axis=0), initial=0.0))
    gradient = linearization.vjp(linearization.flat)
    return norm(linearization.jvp(gradient / (norm(gradient) or 1.0)))


@dataclass
class GaussNewton(LeastSquaresMethod):
    """Gauss-Newton: the step that solves the linearized problem inside the bounds.

    Parameters
    ----------
    apart : bool
        Residuals along axis 0 are samples that depend on x independently: a few products give J.
    dense : bool, optional
        Whether J is formed, by products forward or in reverse, whichever are fewer. Default: if it has at most 3e7
        entries and 4000 rows or columns. Otherwise LSMR with products of J and J^T.
    absolute_sigma : bool
        Whether the residuals are divided by their standard deviations, so that the covariance is (J^T J)^(-1).

    Notes
    -----
    d minimizes |J d + r|^2,  x <- x + d. Where neither the step nor half of it lowers the loss, or only by far less
    than predicted, the next steps are damped as in Levenberg-Marquardt until the linearized problem predicts well.

    References
    ----------
    J. Nocedal, S. J. Wright, Numerical Optimization, 2006, section 10.3; D. C.-L. Fong, M. Saunders, LSMR: an iterative
    algorithm for sparse least-squares problems, SIAM J. Sci. Comput. 33, 2011.
    """

    name: ClassVar[str] = "gauss_newton"
    apart: bool = False
    dense: bool | None = None
    absolute_sigma: bool = False

    def __post_init__(self) -> None:
        self._check_common_options()
        self.forms_jacobian = self.dense

    def advance(self, state: SquaresState, objective: Objective) -> SquaresState:
        """Return the state after one iteration. Raises NoStepFound if no lower point is found."""
        current = state.current
        linearization = objective.linearization(current)
        unit = state.unit or safe_unit(_largest_column_norm(linearization))
        state = state._replace(unit=unit)
        if not state.damping:
            step = _damped_step(current, linearization, objective, 0.0, unit)
            try:
                evaluation, _, share_of_decrease = backtracked(
                    current, step, objective, "the Gauss-Newton step", UNDAMPED_LENGTHS
                )
            except NoStepFound as error:
                _check_rounding(error, current, linearization, objective)
            else:
                damping = 0.0
                if share_of_decrease < POOR:
                    damping = FIRST_DAMPING * (_largest_column_norm(linearization) / unit) ** 2
                return state._replace(current=evaluation, damping=damping)
        largest_diagonal = (_largest_column_norm(linearization) / unit) ** 2
        if not state.damping:
            state = state._replace(damping=FIRST_DAMPING * largest_diagonal or 1.0)
        failure = "no lower point along the Gauss-Newton step, damped or not"
        state = _advance_damped(state, linearization, objective, failure)
        if state.damping <= LEAST_DAMPING * largest_diagonal:
            state = state._replace(damping=0.0)
        return state


@dataclass
class LevenbergMarquardt(LeastSquaresMethod):
    """Levenberg-Marquardt: damping falls where the linearized problem predicts well and grows where it does not.

    Parameters
    ----------
    damping : float
        At the start, relative to the largest diagonal entry of J^T J.
    apart, dense, absolute_sigma
        As for gauss_newton.

    Notes
    -----
    d minimizes |J d + r|^2 + damping |d|^2,  x <- x + d. With the share s of the predicted decrease that was reached,
    damping <- damping max(1/3, 1 - (2 s - 1)^3); where the loss does not fall it is multiplied by 2, 4, 8, ...

    References
    ----------
    H. B. Nielsen, Damping parameter in Marquardt's method, IMM-REP-1999-05, 1999.
    """

    name: ClassVar[str] = "levenberg_marquardt"
    damping: float = 1e-3
    apart: bool = False
    dense: bool | None = None
    absolute_sigma: bool = False

    def __post_init__(self) -> None:
        check_number("damping of levenberg_marquardt", self.damping, "> 0", "; the default is 1e-3")
        self._check_common_options()
        self.forms_jacobian = self.dense

    def advance(self, state: SquaresState, objective: Objective) -> SquaresState:
        """Return the state after one iteration. Raises NoStepFound if no damping is large enough."""
        linearization = objective.linearization(state.current)
        if not state.unit:
            size = _largest_column_norm(linearization)
            unit = safe_unit(size)
            state = state._replace(unit=unit, damping=self.damping * (size / unit) ** 2 or 1.0)
        return _advance_damped(state, linearization, objective, "no damping gives a lower point")


@dataclass
class HalfInverse(LeastSquaresMethod):
    """Half-inverse gradients: each singular value of J to the power -1/2.

    Parameters
    ----------
    rate : float
        Factor of the step.
    truncation : float
        As for dp.update_direction.
    power : float
        p in the formula below.
    rank : int, optional
        As for dp.update_direction.
    apart : bool
        As for gauss_newton.
    form : "auto", "dense" or "krylov"
        How the direction is computed; "auto" forms J if it is small.
    absolute_sigma : bool
        As for gauss_newton.

    Notes
    -----
    x <- x - rate J^T (J J^T)^(-p) r. Losses are not compared.

    References
    ----------
    P. Schnell, P. Holl, N. Thuerey, Half-inverse gradients for physical deep learning, ICLR 2022.
    """

    name: ClassVar[str] = "half_inverse"
    rate: float = 1.0
    truncation: float = 1e-10
    power: float = 0.75
    rank: int | None = None
    apart: bool = False
    form: str = "auto"
    absolute_sigma: bool = False

    def __post_init__(self) -> None:
        check_number("rate of half_inverse", self.rate, "> 0", "; the default is 1")
        self.forms_jacobian = forms_jacobian(self.form)
        self._check_common_options()
        self._family = DirectionFamily(self.power, 0.0, self.truncation, self.rank)

    @property
    def compares_losses(self) -> bool:
        """Never: every admissible step is taken."""
        return False

    def advance(self, state: SquaresState, objective: Objective) -> SquaresState:
        """Return the state after one iteration, on its batch. Raises NoStepFound if no admissible point is found."""
        linearization = objective.linearization(state.current).restricted(objective.free(state.current))
        # Residuals and J divided by s give a direction divided by s^(2 - 2 power).
        residual_scale: Any = objective.residual_scale
        scale = residual_scale ** (2.0 - 2.0 * self._family.power)
        step = -self.rate * scale * self._family(linearization, linearization.flat).step
        evaluation, _, next_share = admissible(state.current.point, step, state.share, objective)
        return SquaresState(evaluation, share=next_share)
