"""Gauss-Newton, Levenberg-Marquardt and half-inverse gradients, as steps from one state to the next.

The loss is half the sum of squares of residuals r(x); J is their Jacobian.
"""

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
from scipy.sparse.linalg import LinearOperator, lsmr

from sparsedp.fields import is_number
from sparsedp.optimize.directions import DENSE, Family
from sparsedp.optimize.first_order import HALVINGS, admissible, backtracked
from sparsedp.optimize.singular_values import decomposed
from sparsedp.optimize.trials import Stuck, Trial
from sparsedp.tree import norm

__all__ = ["GaussNewton", "HalfInverse", "LevenbergMarquardt", "SquaresState"]

EXACT = 1e-9  # damping relative to |J|^2 above which the Gram matrix, with rounding 1e-16, gives 6 digits of the step
FORCING = 1e-10  # relative accuracy of the inner least-squares solution


class SquaresState(NamedTuple):
    """State of the least-squares methods: the point, the damping and its growth, the share to try first."""

    trial: Trial
    damping: float = 0.0
    growth: float = 2.0
    share: float = 1.0


class _Normal:
    """Solves min |J d + r|^2 + damping |d|^2 at one point, for several dampings."""

    def __init__(self, linearised, method):
        self._linearised = linearised
        self._jacobian: Any = None
        self._gram: Any = None
        self._factor: Any = None
        if method.forms(*linearised.shape):
            self._jacobian = jacobian = linearised.rows(method.apart)
            self.largest = float(np.max(np.einsum("ij,ij->j", jacobian, jacobian), initial=0.0))
        else:
            slope = linearised.pull(linearised.flat)
            size = norm(slope)
            self.largest = norm(linearised.push(slope / size)) ** 2 if size > 0 else 0.0

    def step(self, damping):
        if self._jacobian is None:
            return -self._iterated(damping)
        if damping > EXACT * np.linalg.norm(self._jacobian) ** 2:
            return -self._damped(damping)
        if self._factor is None:
            self._factor = decomposed(self._jacobian, self._linearised.flat)
        return -_solve(self._factor, damping, max(self._jacobian.shape))

    def fall(self, d):
        """How far the linearised problem falls along d, which a bound may have cut short."""
        change = self._linearised.push(d)
        return -float(np.dot(change, self._linearised.flat) + 0.5 * np.dot(change, change))

    def _damped(self, damping):
        """By Cholesky of J J^T + damping or J^T J + damping, whichever is small."""
        jacobian, r = self._jacobian, self._linearised.flat
        wide = len(jacobian) < jacobian.shape[1]
        if self._gram is None:
            self._gram = jacobian @ jacobian.T if wide else jacobian.T @ jacobian
        matrix = self._gram.copy()
        np.einsum("ii->i", matrix)[:] += damping
        factor = scipy.linalg.cho_factor(matrix.T, overwrite_a=True, check_finite=False)
        if wide:
            return scipy.linalg.cho_solve(factor, r, check_finite=False) @ jacobian
        return scipy.linalg.cho_solve(factor, r @ jacobian, check_finite=False)

    def _iterated(self, damping):
        rows, columns = self._linearised.shape
        product = LinearOperator(
            (rows, columns), matvec=self._linearised.push, rmatvec=self._linearised.pull, dtype=float
        )
        return lsmr(product, self._linearised.flat, damp=np.sqrt(damping), atol=FORCING, btol=FORCING, conlim=1e14)[0]


def _solve(factor, damping, size):
    """Damped least squares from a decomposition that every damping shares; `size` is the longer side of J."""
    combine, s, parts = factor
    floor = np.finfo(float).eps * size * (s[0] if len(s) else 0.0)
    kept = s > floor
    shares = np.divide(s, s * s + damping, out=np.zeros_like(s), where=kept)
    return combine(shares * parts)


def _formed(dense, rows, columns):
    return rows * columns <= DENSE and min(rows, columns) <= 4000 if dense is None else dense


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

    def forms(self, rows, columns):
        """Whether J is formed."""
        return _formed(self.dense, rows, columns)

    def begin(self, first):
        """State at the start."""
        return SquaresState(first)

    def advance(self, state, trials):
        """One iteration. Raises Stuck when no lower point is found."""
        step = _Normal(trials.linearised(state.trial), self).step(0.0)
        trial, _ = backtracked(state.trial, step, trials, "the Gauss-Newton step")
        return state._replace(trial=trial)


class LevenbergMarquardt:
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

    residuals, searches = True, True

    def __init__(self, damping=1e-3, apart=False, dense=None):
        if not (is_number(damping) and 0 < damping < np.inf):
            raise ValueError(f"levenberg_marquardt needs a positive damping, got {damping!r}; the default is 1e-3")
        self.damping, self.apart, self.dense = damping, bool(apart), dense

    def forms(self, rows, columns):
        """Whether J is formed."""
        return _formed(self.dense, rows, columns)

    def begin(self, first):
        """State at the start; the damping is scaled at the first step."""
        return SquaresState(first, 0.0)

    def advance(self, state, trials):
        """One iteration: one Jacobian, as many dampings as it takes. Raises Stuck when none is large enough."""
        here = state.trial
        normal = _Normal(trials.linearised(here), self)
        damping = state.damping or self.damping * normal.largest or 1.0
        growth = 2.0
        for _ in range(HALVINGS):
            step = normal.step(damping)
            trial = trials(trials.box.inside(here.vector + step), here.value)
            predicted = 0.5 * float(np.dot(step, damping * step - here.slope))
            if not trial.refused and trial.value < here.value:
                fall = predicted if trials.box.open else normal.fall(trial.vector - here.vector)
                gain = (here.value - trial.value) / fall if fall > 0 else 0.0
                return SquaresState(trial, damping * max(1 / 3, 1 - (2 * gain - 1) ** 3))
            if predicted <= here.rounding:
                break
            damping, growth = damping * growth, 2 * growth
        hopeless = predicted <= 100 * here.rounding
        raise Stuck("rounding" if hopeless else "no damping gives a lower point")


class HalfInverse:
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

    residuals, searches = True, False

    def __init__(self, rate=1.0, truncation=1e-10, power=0.75, rank=None, apart=False, form="auto"):
        if not (is_number(rate) and 0 < rate < np.inf):
            raise ValueError(f"half_inverse needs a positive rate, got {rate!r}; the default is 1")
        self.rate = rate
        self.family = Family(power, 0.0, truncation, form, rank, apart)
        self.apart = self.family.apart

    def forms(self, rows, columns):
        """Whether J is formed."""
        return self.family.forms(rows, columns)

    def begin(self, first):
        """State at the start."""
        return SquaresState(first)

    def advance(self, state, trials):
        """One iteration, on the batch of the present one."""
        linearised = trials.linearised(state.trial)
        step = -self.rate * self.family(linearised, linearised.flat).step
        trial, share = admissible(state.trial.vector, step, state.share, trials)
        return SquaresState(trial, share=min(1.0, 2 * share))
