"""Gauss-Newton, Levenberg-Marquardt and half-inverse gradients.

All of them minimize half the sum of squares of residuals r(x), whose Jacobian is J.
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
from sparsedp.optimize.update_direction import Direction, DirectionFamily, forms_jacobian
from sparsedp.solvers.scaling import largest

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from sparsedp.optimize.linearization import Linearization
    from sparsedp.optimize.objective import Objective

__all__ = ["GaussNewton", "HalfInverse", "LevenbergMarquardt", "SquaresState"]

RANK_TOLERANCE = 1e-12  # singular values below this multiple of the largest count as 0
UNDAMPED_LENGTHS = 2  # trial points along an undamped Gauss-Newton step: the full step and half of it
DAMPED_BELOW = 0.1  # next step is damped if actual / gradient-predicted decrease is below this (1/2 if r is linear)
FIRST_DAMPING = 1e-3  # initial damping of Gauss-Newton, relative to the largest diagonal entry of J^T J
LEAST_DAMPING = 1e-6  # relative damping below which Gauss-Newton returns to undamped steps
LSMR_ACCURACY = 1e-10  # relative tolerances atol and btol of LSMR
LSMR_CONDITION = 1e14  # LSMR stops when its estimate of the condition number exceeds this
CHOLESKY_DAMPING = 1e-9  # damping / |J|^2 above which Cholesky of the Gram matrix gives 6 digits of the step


class SquaresState(NamedTuple):
    """State of the least-squares methods.

    Attributes
    ----------
    current : Evaluation
    damping : float
        Damping parameter of the problem with the scaled Jacobian J / unit.
    share : float
        Fraction of the next step that is tried first.
    unit : float
        A power of two for which the squares of the entries of J / unit do not overflow or underflow; 0 until it is
        known.
    """

    current: Evaluation
    damping: float = 0.0
    share: float = 1.0
    unit: float = 0.0


class LeastSquaresMethod(Method):
    """Base class of the least-squares methods, with their common options.

    Attributes
    ----------
    apart : bool
        True if the residuals along axis 0 belong to independent samples.
    absolute_sigma : bool
        True if the user divided the residuals by their standard deviations.
    forms_jacobian : bool or None
        Whether the matrix J is computed. None: it is computed if it is small.
    """

    uses_residuals: ClassVar[bool] = True
    apart: bool
    absolute_sigma: bool
    forms_jacobian: bool | None

    def begin(self, first: Evaluation) -> SquaresState:
        """Return the state at the start."""
        return SquaresState(first)

    def _check_common_options(self):
        """Validate the options that all least-squares methods have."""
        check_choice("absolute_sigma", self.absolute_sigma, (True, False), "; the default is False")
        self.apart = bool(self.apart)
        self.absolute_sigma = bool(self.absolute_sigma)


def _damped_step(
    current: Evaluation,
    linearization: Linearization,
    objective: Objective,
    damping: float,
    unit: float,
    accuracy: float,
) -> NDArray[np.float64]:
    """Return the minimizer d of |J d + r|^2 + damping |unit d|^2, subject to the bounds on the current point + d.

    `accuracy` is the relative tolerance of LSMR, if there are no bounds and J is not formed.
    """
    if not objective.box.bounded:
        return _unbounded_step(linearization, linearization.flat, damping, unit, accuracy)
    problem = BoundedLeastSquares(current, linearization, objective.box, damping, unit)

    def solve(restricted, r):  # with bounds, signs of multipliers decide; they need an accurate solution
        return _unbounded_step(restricted, r, damping, unit, LSMR_ACCURACY)

    return problem.minimum(solve, objective.free(current))


def _unbounded_step(linearization, r, damping, unit, accuracy):
    """Return the minimizer d of |J d + r|^2 + damping |unit d|^2, without bounds."""
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
    solution = lsmr(product, r, damp=np.sqrt(damping), atol=accuracy, btol=accuracy, conlim=LSMR_CONDITION)
    return -solution[0] / unit


def _negated_dense_step(jacobian, r, damping):
    """Return -d, where d minimizes |J d + r|^2 + damping |d|^2.

    If the damping is large enough for an accurate result, a Cholesky factorization of J J^T + damping I or
    J^T J + damping I is used, which is much faster than the singular values that are needed otherwise.
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
    state: SquaresState, linearization: Linearization, objective: Objective, failure: str, accuracy: float
) -> SquaresState:
    """Return the state after a damped step; the damping is increased until the step decreases the loss.

    Raises
    ------
    NoStepFound
        With the message `failure`, if no trial value of the damping decreases the loss.
    """
    current = state.current
    unit = state.unit

    def candidates() -> Iterator[tuple[NDArray[np.float64], float, float]]:
        """Yield trial points with increasing damping."""
        damping = state.damping
        growth = 2.0
        for _ in range(HALVINGS):
            step = _damped_step(current, linearization, objective, damping, unit, accuracy)
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
    """Re-raise a RoundingReached, unless a gradient step predicts a decrease that clearly exceeds rounding."""
    if isinstance(error, RoundingReached):
        gradient_step = BoundedLeastSquares(current, linearization, objective.box, 0.0, 1.0).gradient_step()
        if not objective.decrease_is_visible(current, gradient_step):
            raise error


def _largest_column_norm(linearization: Linearization) -> float:
    """Return the largest column norm of J. If J is not formed, return |J g| / |g| instead, with the gradient g."""
    if linearization.dense:
        jacobian = linearization.jacobian()
        unit = power_of_two(largest(jacobian))
        return unit * float(np.max(np.linalg.norm(jacobian / unit, axis=0), initial=0.0))
    gradient = linearization.vjp(linearization.flat)
    return norm(linearization.jvp(gradient / (norm(gradient) or 1.0)))


@dataclass
class GaussNewton(LeastSquaresMethod):
    """Gauss-Newton: each step minimizes the linearized problem, subject to the bounds.

    Parameters
    ----------
    apart : bool
        True if the residuals along axis 0 belong to independent samples. J is then computed by one product for each
        residual of a sample; see `minimize`.
    dense : bool, optional
        True: compute the matrix J, by Jacobian-vector or vector-Jacobian products, whichever are fewer. False: solve
        the linearized problem by LSMR, with products of J and J^T only. Default: True if J has at most 3e7 entries and
        its shorter side is at most 4000.
    absolute_sigma : bool
        True if the residuals were divided by their standard deviations; the covariance is then (J^T J)^(-1).
    accuracy : float
        Relative tolerance of LSMR, which computes a step if J is not formed and there are no bounds. With 1e-2 or 1e-3
        a step takes fewer products, and the search more steps.

    Notes
    -----
    Each iteration computes the minimizer d of |J d + r|^2 and sets x <- x + d. If neither the step nor half of it
    decreases the loss, or if the decrease is much smaller than predicted, the next steps are damped as in
    Levenberg-Marquardt, until the linearized problem predicts the decrease well.

    References
    ----------
    J. Nocedal, S. J. Wright, Numerical Optimization, 2006, section 10.3; D. C.-L. Fong, M. Saunders, LSMR: an iterative
    algorithm for sparse least-squares problems, SIAM J. Sci. Comput. 33, 2011.
    """

    name: ClassVar[str] = "gauss_newton"
    apart: bool = False
    dense: bool | None = None
    absolute_sigma: bool = False
    accuracy: float = LSMR_ACCURACY

    def __post_init__(self) -> None:
        self._check_common_options()
        check_number("accuracy of gauss_newton", self.accuracy, "from 0 to below 1", "; the default is 1e-10")
        self.forms_jacobian = self.dense

    def advance(self, state: SquaresState, objective: Objective) -> SquaresState:
        """Return the state after one iteration. Raises NoStepFound if no lower point is found."""
        current = state.current
        linearization = objective.linearization(current)
        unit = state.unit or safe_unit(_largest_column_norm(linearization))
        state = state._replace(unit=unit)
        if not state.damping:
            step = _damped_step(current, linearization, objective, 0.0, unit, self.accuracy)
            try:
                evaluation, _, share_of_decrease = backtracked(
                    current, step, objective, "the Gauss-Newton step", UNDAMPED_LENGTHS
                )
            except NoStepFound as error:
                _check_rounding(error, current, linearization, objective)
            else:
                damping = 0.0
                if share_of_decrease < DAMPED_BELOW:
                    damping = FIRST_DAMPING * (_largest_column_norm(linearization) / unit) ** 2
                return state._replace(current=evaluation, damping=damping)
        largest_diagonal = (_largest_column_norm(linearization) / unit) ** 2
        if not state.damping:
            state = state._replace(damping=FIRST_DAMPING * largest_diagonal or 1.0)
        failure = "no lower point along the Gauss-Newton step, damped or not"
        state = _advance_damped(state, linearization, objective, failure, self.accuracy)
        if state.damping <= LEAST_DAMPING * largest_diagonal:
            state = state._replace(damping=0.0)
        return state


@dataclass
class LevenbergMarquardt(LeastSquaresMethod):
    """Levenberg-Marquardt: Gauss-Newton with a damping that adapts to the accuracy of the linearized problem.

    Parameters
    ----------
    damping : float
        Initial damping, relative to the largest diagonal entry of J^T J.
    apart, dense, absolute_sigma, accuracy
        As for gauss_newton.

    Notes
    -----
    Each iteration computes the minimizer d of |J d + r|^2 + damping |d|^2 and sets x <- x + d. If the loss does not
    decrease, the step is rejected and the damping is multiplied by 2, then by 4, 8, ... After an accepted step,
    damping <- damping max(1/3, 1 - (2 s - 1)^3), where s is the actual decrease divided by the predicted one.

    References
    ----------
    H. B. Nielsen, Damping parameter in Marquardt's method, IMM-REP-1999-05, 1999.
    """

    name: ClassVar[str] = "levenberg_marquardt"
    damping: float = 1e-3
    apart: bool = False
    dense: bool | None = None
    absolute_sigma: bool = False
    accuracy: float = LSMR_ACCURACY

    def __post_init__(self) -> None:
        check_number("damping of levenberg_marquardt", self.damping, "> 0", "; the default is 1e-3")
        self._check_common_options()
        check_number("accuracy of levenberg_marquardt", self.accuracy, "from 0 to below 1", "; the default is 1e-10")
        self.forms_jacobian = self.dense

    def advance(self, state: SquaresState, objective: Objective) -> SquaresState:
        """Return the state after one iteration. Raises NoStepFound if no damping is large enough."""
        linearization = objective.linearization(state.current)
        if not state.unit:
            size = _largest_column_norm(linearization)
            unit = safe_unit(size)
            state = state._replace(unit=unit, damping=self.damping * (size / unit) ** 2 or 1.0)
        return _advance_damped(state, linearization, objective, "no damping gives a lower point", self.accuracy)


@dataclass
class HalfInverse(LeastSquaresMethod):
    """Half-inverse gradients: a step between gradient descent and Gauss-Newton, J^T (J J^T)^(-3/4) r by default.

    Parameters
    ----------
    rate : float, optional
        Factor of the step. Default: found by backtracking, and with batches given by the formula below.
    truncation : float
        As for dp.update_direction. Singular vectors of very small singular values are mostly noise, and their steps are
        long, so that they limit the rate.
    power : float
        The exponent p in the formula below.
    rank : int, optional
        As for dp.update_direction.
    apart : bool
        As for gauss_newton.
    form : "auto", "dense" or "krylov"
        "dense" computes the matrix J; "krylov" uses products with J and J^T only. "auto" selects "dense" if J is small.
    absolute_sigma : bool
        As for gauss_newton.

    Notes
    -----
    Each iteration sets x <- x - rate J^T (J J^T)^(-p) r. With a given rate, losses are not compared.

    Let s be the largest singular value of J. With the rate s^(2 p - 2), the step in its singular direction equals the
    Gauss-Newton step, and steps in other directions are shorter than with Gauss-Newton. The step does not depend on the
    units of x and r. Backtracking begins with this rate in the first iteration, halves it until the loss decreases
    sufficiently (Armijo condition), and doubles it for the next iteration. The first step is not longer than x, unless
    x is 0: a step many times longer than the weights of a network saturates its neurons, J loses rank, and truncated
    directions do not recover.

    The losses of batches cannot be compared. For a batch of m samples, which are the entries of r along axis 0, the
    rate is the smaller of s^(2 p - 2) and 2 / m: the rate 1 for the mean of |r|^2 over the samples, as in the
    reference.

    On the two-scale problem of the reference (7 neurons, 30 weights, 256 samples, 300 iterations) all of 24 random
    starts reach the published losses, 2.9e-3 for the scale 0.01 and 4.7e-4 for the scale 1: with a truncation of 1e-5
    or 1e-7, or with a longer first step, 2 to 7 of them do not. If a loss stays high, `kept` of `update_direction`
    shows the rank of J; take another start.

    References
    ----------
    P. Schnell, P. Holl, N. Thuerey, Half-inverse gradients for physical deep learning, ICLR 2022.
    """

    name: ClassVar[str] = "half_inverse"
    rate: float | None = None
    truncation: float = 1e-6
    power: float = 0.75
    rank: int | None = None
    apart: bool = False
    form: str = "auto"
    absolute_sigma: bool = False

    def __post_init__(self) -> None:
        if self.rate is not None:
            check_number("rate of half_inverse", self.rate, "> 0", "; leave it out and it is searched for")
        self.forms_jacobian = forms_jacobian(self.form)
        self._check_common_options()
        self._family = DirectionFamily(self.power, 0.0, self.truncation, self.rank)

    @property
    def compares_losses(self) -> bool:
        """False: batches can be used. Losses are compared only if neither a rate nor batches were given."""
        return False

    def advance(self, state: SquaresState, objective: Objective) -> SquaresState:
        """Return the state after one iteration, on its batch. Raises NoStepFound if no point is accepted."""
        linearization = objective.linearization(state.current).restricted(objective.free(state.current))
        direction = self._family(linearization, linearization.flat)
        if self.rate is not None:
            # r and J were divided by s, which divides the direction by s^(2 - 2 power): undo this.
            residual_scale: Any = objective.residual_scale
            scale = residual_scale ** (2.0 - 2.0 * self._family.power)
            step = -self.rate * scale * direction.step
        else:
            step = self._scaled_step(direction)
            if not objective.batches.varied:
                longest = state.share
                if state.current.iteration == 0:
                    longest = _share_within_norm(step, state.current.point)
                name = "the half-inverse step"
                evaluation, share, _ = backtracked(state.current, longest * step, objective, name)
                return SquaresState(evaluation, share=2 * share * longest)
            step *= self._share_of_batch(direction, linearization, objective)
        evaluation, _, next_share = admissible(state.current.point, step, state.share, objective)
        return SquaresState(evaluation, share=next_share)

    def _scaled_step(self, direction: Direction) -> NDArray[np.float64]:
        """Return the step with the rate s^(2 p - 2), where s is the largest singular value of J."""
        size = float(np.max(direction.spectrum, initial=0.0)) or 1.0
        root_of_rate = size ** (self._family.power - 1.0)
        return -(direction.step * root_of_rate) * root_of_rate  # the rate itself can leave the range of floats

    def _share_of_batch(self, direction: Direction, linearization: Linearization, objective: Objective) -> float:
        """Return min(1, 2 s^(2 - 2 p) / m), the rate for a batch of m samples divided by the rate s^(2 p - 2)."""
        residual_scale: Any = objective.residual_scale
        size = float(np.max(direction.spectrum, initial=0.0)) * residual_scale
        with np.errstate(over="ignore"):
            inverse_of_longest = np.float64(size) ** (2.0 - 2.0 * self._family.power)
            return float(min(1.0, 2.0 * inverse_of_longest / max(1, len(linearization.value))))


def _share_within_norm(step, x):
    """Return the largest share <= 1 of a step that is not longer than x; 1 if x is 0."""
    limit = norm(x)
    length = norm(step)
    if 0 < limit < length:
        return limit / length
    return 1.0
