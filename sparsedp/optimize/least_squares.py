"""Gauss-Newton, Levenberg-Marquardt and half-inverse gradients, as steps from one state to the next.

The loss is half the sum of squares of residuals r(x); J is their Jacobian.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg
from scipy.sparse.linalg import LinearOperator, lsmr

from sparsedp._utils.pytree import norm, power_of_two, safe_unit
from sparsedp._utils.validation import check_choice, check_number
from sparsedp.optimize.bounded_squares import BoundedProblem
from sparsedp.optimize.directions import Family, form_of
from sparsedp.optimize.first_order import HALVINGS, admissible, backtracked
from sparsedp.optimize.result import Stuck, Trial
from sparsedp.solvers.scaling import largest

__all__ = ["GaussNewton", "HalfInverse", "LevenbergMarquardt", "SquaresState"]

ROUNDING = 1e-12  # singular values below this share of the largest are taken for 0
LENGTHS = 2  # of an undamped step that are tried: all of it and half of it
POOR = 0.1  # share of the fall predicted by the gradient, 1/2 for a parabola, below which the next step is damped
FIRST_DAMPING, LAST_DAMPING = 1e-3, 1e-6  # of Gauss-Newton, relative to the largest diagonal entry of J^T J
FORCING, CONDITION = 1e-10, 1e14  # of LSMR: relative accuracy, and where it gives up
EXACT = 1e-9  # damping relative to |J|^2 above which the Gram matrix, with rounding 1e-16, gives 6 digits of the step


class SquaresState(NamedTuple):
    """State of the least-squares methods: the point, the damping, the share to try first, the unit of the Jacobian.

    The damping is that of the Jacobian divided by `unit`, a power of two (0: not known), whose square is a float.
    """

    trial: Trial
    damping: float = 0.0
    share: float = 1.0
    unit: float = 0.0


def _backwards(jacobian, r, damping):
    """From the minimum of |J d + r|^2 + damping |d|^2 to the point.

    Where that is exact, by Cholesky of J J^T + damping or J^T J + damping: far faster than by singular values.
    """
    if damping <= EXACT * np.linalg.norm(jacobian) ** 2:
        return Family(1.0, damping, ROUNDING).dense(jacobian, r).step
    wide = len(jacobian) < jacobian.shape[1]
    gram = jacobian @ jacobian.T if wide else jacobian.T @ jacobian
    gram.flat[:: len(gram) + 1] += damping
    solution = scipy.linalg.solve(
        gram.T, r if wide else r @ jacobian, overwrite_a=True, check_finite=False, assume_a="pos"
    )
    return solution @ jacobian if wide else solution


class GaussNewton:
    """Gauss-Newton: the step that solves the linearised problem inside the bounds.

    Where neither the step nor half of it lowers the loss, or by far less than predicted, steps are damped as those of
    Levenberg-Marquardt until the linearised problem predicts well again.

    Parameters
    ----------
    apart : bool
        Residuals along axis 0 are samples that see x independently: J by a few products.
    dense : bool or None
        Whether J is formed, by products forward or in reverse, whichever are fewer; None: when it has at most 3e7
        entries and 4000 rows or columns. Else LSMR on products with J and J^T.
    absolute_sigma : bool
        Whether the residuals are divided by their standard deviations, so that the covariance is (J^T J)^(-1).
    """

    residuals, searches = True, True

    def __init__(self, apart=False, dense=None, absolute_sigma=False):
        check_choice("absolute_sigma", absolute_sigma, (True, False), "; the default is False")
        self.apart, self.dense, self.absolute_sigma = bool(apart), dense, bool(absolute_sigma)

    def step(self, linearised, r, damping, unit):
        """Return the minimum d of |J d + r|^2 + damping |unit d|^2."""
        if linearised.dense:
            jacobian = linearised.rows()
            return -_backwards(jacobian if unit == 1 else jacobian / unit, r, damping) / unit
        product = LinearOperator(
            linearised.shape, lambda v: linearised.push(v / unit), lambda w: linearised.pull(w) / unit, dtype=float
        )
        return -lsmr(product, r, damp=np.sqrt(damping), atol=FORCING, btol=FORCING, conlim=CONDITION)[0] / unit

    def bounded_step(self, here, linearised, trials, damping, unit):
        """Return the minimum d of |J d + r|^2 + damping |unit d|^2 for which the point here + d is inside the box."""
        if not trials.box.bounded:
            return self.step(linearised, linearised.flat, damping, unit)
        problem = BoundedProblem(here, linearised, trials.box, damping, unit)
        return problem.solved(lambda some, r: self.step(some, r, damping, unit), trials.free(here))

    def begin(self, first):
        """State at the start."""
        return SquaresState(first)

    def advance(self, state, trials):
        """One iteration. Raises Stuck when no lower point is found."""
        here, linearised = state.trial, trials.linearised(state.trial)
        unit = state.unit or safe_unit(self.largest(linearised))
        state = state._replace(unit=unit)
        if not state.damping:
            step = self.bounded_step(here, linearised, trials, 0.0, unit)
            try:
                trial, _, gain = backtracked(here, step, trials, "the Gauss-Newton step", LENGTHS)
            except Stuck as stuck:
                self.check_stuck(stuck, here, linearised, trials)
            else:
                if gain < POOR:
                    state = state._replace(damping=FIRST_DAMPING * (self.largest(linearised) / unit) ** 2)
                return state._replace(trial=trial)
        size = (self.largest(linearised) / unit) ** 2
        if not state.damping:
            state = state._replace(damping=FIRST_DAMPING * size or 1.0)
        state = self.damped(state, linearised, trials, "no lower point along the Gauss-Newton step, damped or not")
        return state if state.damping > LAST_DAMPING * size else state._replace(damping=0.0)

    def damped(self, state, linearised, trials, unless):
        """Return the state after a step with as much damping as it takes. Raises Stuck(unless) when none is enough."""
        here, unit = state.trial, state.unit

        def tries():
            damping, growth = state.damping, 2.0
            for _ in range(HALVINGS):
                point = trials.box.moved(here.vector, self.bounded_step(here, linearised, trials, damping, unit))
                change = linearised.push(point - here.vector)
                yield point, -float(np.dot(change, linearised.flat + 0.5 * change)), damping
                damping, growth = damping * growth, 2 * growth

        try:
            trial, gain, damping = trials.lower(here, tries(), unless)
        except Stuck as stuck:
            self.check_stuck(stuck, here, linearised, trials)
            raise Stuck(unless) from None
        damping *= max(1 / 3, 1 - (2 * gain - 1) ** 3)
        return state._replace(trial=trial, damping=damping)

    def check_stuck(self, stuck, here, linearised, trials):
        """Raise what a search ended with if it is rounding: where the gradient predicts no visible fall either."""
        if str(stuck) == "rounding":
            downhill = BoundedProblem(here, linearised, trials.box, 0.0, 1.0).downhill()
            if not trials.seen_to_fall(here, downhill):
                raise stuck

    def largest(self, linearised):
        """Return the norm of the largest column of J; where J is not formed, that of J along the gradient."""
        if linearised.dense:
            jacobian = linearised.rows()
            unit = power_of_two(largest(jacobian))
            return unit * float(np.max(np.linalg.norm(jacobian / unit, axis=0), initial=0.0))
        slope = linearised.pull(linearised.flat)
        return norm(linearised.push(slope / (norm(slope) or 1.0)))


class LevenbergMarquardt(GaussNewton):
    """Levenberg-Marquardt: damping falls when the linearised problem predicts well and grows when not.

    Parameters
    ----------
    damping : float
        At the start, relative to the largest diagonal entry of J^T J.
    apart, dense, absolute_sigma
        As for gauss_newton.

    Notes
    -----
    Source: H. B. Nielsen, Damping parameter in Marquardt's method, IMM-REP-1999-05, 1999.
    """

    def __init__(self, damping=1e-3, apart=False, dense=None, absolute_sigma=False):
        check_number("damping of levenberg_marquardt", damping, "> 0", "; the default is 1e-3")
        super().__init__(apart, dense, absolute_sigma)
        self.damping = damping

    def advance(self, state, trials):
        """One iteration: one Jacobian, as many dampings as it takes. Raises Stuck when none is large enough."""
        linearised = trials.linearised(state.trial)
        if not state.unit:
            size = self.largest(linearised)
            unit = safe_unit(size)
            state = state._replace(unit=unit, damping=self.damping * (size / unit) ** 2 or 1.0)
        return self.damped(state, linearised, trials, "no damping gives a lower point")


class HalfInverse(GaussNewton):
    """Half-inverse gradients: J^T (J J^T)^(-3/4) r, each singular value to the power -1/2.

    Parameters
    ----------
    rate : float
    truncation, rank, apart
        As for dp.update_direction.
    absolute_sigma
        As for gauss_newton.
    form : "auto", "dense" or "krylov"
        How the direction is found.

    Notes
    -----
    Source: P. Schnell, P. Holl, N. Thuerey, Half-inverse gradients for physical deep learning, ICLR 2022.
    """

    searches = False

    def __init__(
        self, rate=1.0, truncation=1e-10, power=0.75, rank=None, apart=False, form="auto", absolute_sigma=False
    ):
        check_number("rate of half_inverse", rate, "> 0", "; the default is 1")
        super().__init__(apart, form_of(form), absolute_sigma)
        self.rate, self._family = rate, Family(power, 0.0, truncation, rank)

    def advance(self, state, trials):
        """One iteration, on the batch of the present one."""
        linearised = trials.linearised(state.trial).among(trials.free(state.trial))
        # Residuals and J divided by s give a direction divided by s^(2 - 2 power).
        scale = trials.residual_scale ** (2.0 - 2.0 * self._family.power)
        step = -self.rate * scale * self._family(linearised, linearised.flat).step
        trial, _, larger = admissible(state.trial.vector, step, state.share, trials)
        return SquaresState(trial, share=larger)
