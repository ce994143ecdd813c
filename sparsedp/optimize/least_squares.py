"""Gauss-Newton, Levenberg-Marquardt and half-inverse gradients, as steps from one state to the next.

The loss is half the sum of squares of residuals r(x); J is their Jacobian.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg
from scipy.sparse.linalg import LinearOperator, lsmr

from sparsedp.fields import check_number
from sparsedp.optimize.directions import Family, form_of
from sparsedp.optimize.first_order import HALVINGS, admissible, backtracked
from sparsedp.optimize.result import Trial
from sparsedp.tree import norm

__all__ = ["GaussNewton", "HalfInverse", "LevenbergMarquardt", "SquaresState"]

ROUNDING = 1e-12  # singular values below this share of the largest are taken for 0
FORCING, CONDITION = 1e-10, 1e14  # of LSMR: relative accuracy, and where it gives up
EXACT = 1e-9  # damping relative to |J|^2 above which the Gram matrix, with rounding 1e-16, gives 6 digits of the step


class SquaresState(NamedTuple):
    """State of the least-squares methods: the point, the damping, the share to try first."""

    trial: Trial
    damping: float = 0.0
    share: float = 1.0


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
    """Gauss-Newton: the step that solves the linearised problem, halved until the loss falls.

    Parameters
    ----------
    apart : bool
        Residuals along axis 0 are samples that see x independently: J by a few products.
    dense : bool or None
        Whether J is formed, by products forward or in reverse, whichever are fewer; None: when it has at most 3e7
        entries and 4000 rows or columns. Else LSMR on products with J and J^T.
    """

    residuals, searches = True, True

    def __init__(self, apart=False, dense=None):
        self.apart, self.dense = bool(apart), dense

    def step(self, linearised, damping=0.0):
        """The step to the minimum of |J d + r|^2 + damping |d|^2."""
        r = linearised.flat
        if linearised.dense:
            return -_backwards(linearised.rows(), r, damping)
        product = LinearOperator(linearised.shape, linearised.push, linearised.pull, dtype=float)
        return -lsmr(product, r, damp=np.sqrt(damping), atol=FORCING, btol=FORCING, conlim=CONDITION)[0]

    def begin(self, first):
        """State at the start."""
        return SquaresState(first)

    def advance(self, state, trials):
        """One iteration. Raises Stuck when no lower point is found."""
        step = self.step(trials.linearised(state.trial))
        return state._replace(trial=backtracked(state.trial, step, trials, "the Gauss-Newton step")[0])


class LevenbergMarquardt(GaussNewton):
    """Levenberg-Marquardt: damping falls when the linearised problem predicts well and grows when not.

    Parameters
    ----------
    damping : float
        At the start, relative to the largest diagonal entry of J^T J.
    apart, dense
        As for gauss_newton.

    Notes
    -----
    Source: H. B. Nielsen, Damping parameter in Marquardt's method, IMM-REP-1999-05, 1999.
    """

    def __init__(self, damping=1e-3, apart=False, dense=None):
        check_number("damping of levenberg_marquardt", damping, "> 0", "; the default is 1e-3")
        super().__init__(apart, dense)
        self.damping = damping

    def advance(self, state, trials):
        """One iteration: one Jacobian, as many dampings as it takes. Raises Stuck when none is large enough."""
        here, linearised = state.trial, trials.linearised(state.trial)

        def damped():
            damping, growth = state.damping or self.damping * self.largest(linearised) or 1.0, 2.0
            for _ in range(HALVINGS):
                point = trials.box.inside(here.vector + self.step(linearised, damping))
                change = linearised.push(point - here.vector)
                yield point, -float(np.dot(change, linearised.flat + 0.5 * change)), damping
                damping, growth = damping * growth, 2 * growth

        trial, gain, damping = trials.lower(here, damped(), "no damping gives a lower point")
        return SquaresState(trial, damping * max(1 / 3, 1 - (2 * gain - 1) ** 3))

    def largest(self, linearised):
        """The largest diagonal entry of J^T J; where J is not formed, that along the gradient."""
        if linearised.dense:
            return float(np.max(np.linalg.norm(linearised.rows(), axis=0), initial=0.0)) ** 2
        slope = linearised.pull(linearised.flat)
        return norm(linearised.push(slope / (norm(slope) or 1.0))) ** 2


class HalfInverse(GaussNewton):
    """Half-inverse gradients: J^T (J J^T)^(-3/4) r, each singular value to the power -1/2.

    Parameters
    ----------
    rate : float
    truncation, rank, apart
        As for dp.update_direction.
    form : "auto", "dense" or "krylov"
        How the direction is found.

    Notes
    -----
    Source: P. Schnell, P. Holl, N. Thuerey, Half-inverse gradients for physical deep learning, ICLR 2022.
    """

    searches = False

    def __init__(self, rate=1.0, truncation=1e-10, power=0.75, rank=None, apart=False, form="auto"):
        check_number("rate of half_inverse", rate, "> 0", "; the default is 1")
        super().__init__(apart, form_of(form))
        self.rate, self._family = rate, Family(power, 0.0, truncation, rank)

    def advance(self, state, trials):
        """One iteration, on the batch of the present one."""
        linearised = trials.linearised(state.trial)
        step = -self.rate * self._family(linearised, linearised.flat).step
        trial, _, larger = admissible(state.trial.vector, step, state.share, trials)
        return SquaresState(trial, share=larger)
