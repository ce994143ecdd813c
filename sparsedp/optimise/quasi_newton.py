"""L-BFGS by SciPy, on a scaled flat problem, past trial points that the loss refuses."""

import numpy as np
from scipy.optimize import minimize

from sparsedp.fields import is_whole
from sparsedp.optimise.trials import norm

__all__ = ["Quasi"]

RISE = 1.5  # a refused point looks as if the loss had risen by this multiple of the predicted fall
RESTARTS = 20


class Quasi:
    """Limited-memory BFGS with a line search for the strong Wolfe conditions.

    SciPy's stopping tests are switched off: they are absolute. So is its first step, of length 1; the
    problem is scaled by powers of two so that this step is |f| / |g| long, which would bring a linear loss
    to 0, but not longer than x, and the scaled gradient is of size 1.

    Parameters
    ----------
    memory : int
        Number of steps that the curvature is taken from.
    line_search : int
        Largest number of trial points in one line search.

    Notes
    -----
    Source: R. H. Byrd, P. Lu, J. Nocedal, C. Zhu, SIAM J. Sci. Comput. 16, 1995.
    """

    def __init__(self, memory=10, line_search=20):
        if not (is_whole(memory, 1) and is_whole(line_search, 2)):
            raise ValueError(
                f"lbfgs needs memory >= 1 and line_search >= 2, got {memory} and {line_search}; write whole numbers"
            )
        self.memory, self.line_search = int(memory), int(line_search)

    def run(self, first, trials, watch, maxiter):
        """Iterate until `watch` stops it, or no lower point is found.

        Returns
        -------
        "rounding", or words that say why no lower point was found; None when `watch` stopped it.
        """
        search = _Search(first, trials, watch)
        for _ in range(RESTARTS):
            before = search.accepted
            self._scipy(search, maxiter - watch.iteration)
            if watch.stopped or watch.iteration >= maxiter:
                return None
            # A fresh memory helps after a failed line search, as long as it still brings progress.
            if search.accepted is before or search.at_rounding():
                break
        return "rounding" if search.at_rounding() else "the line search found no lower point"

    def _scipy(self, search, maxiter):
        options = {"maxiter": maxiter, "maxfun": 2**31 - 1, "maxcor": self.memory, "maxls": self.line_search}
        start = search.accepted.vector / search.length
        minimize(
            search.evaluate, start, jac=True, method="L-BFGS-B", callback=search.iterate,
            options={**options, "ftol": 0.0, "gtol": 0.0},
        )  # fmt: skip


class _Search:
    """The loss as SciPy sees it, and the point from which the present line search starts."""

    def __init__(self, first, trials, watch):
        self.accepted = first
        self.curvature = None
        self._trials, self._watch = trials, watch
        self._recent = []
        self.length = _power_of_two(_first_length(first))
        self._height = _power_of_two(self.length * norm(first.slope))

    def evaluate(self, scaled):
        """Scaled value and gradient; at a refused point those of a parabola that sends the search back."""
        vector = self.length * scaled
        trial = self.accepted if np.array_equal(vector, self.accepted.vector) else self._trials(vector)
        value, slope = (trial.value, trial.slope) if not trial.refused else self._parabola(vector)
        if not trial.refused:
            self._recent.append((vector, trial))
        return value / self._height, self.length * (slope / self._height)

    def _parabola(self, vector):
        """Through the accepted point with its slope, and RISE times the predicted fall higher here.

        Its minimum lies at 1 / (2 RISE + 2) of the way, where an interpolating search goes next.
        """
        step = vector - self.accepted.vector
        fall = abs(float(np.dot(self.accepted.slope, step))) or norm(self.accepted.slope) * norm(step)
        length = float(np.dot(step, step)) or 1.0
        return self.accepted.value + RISE * fall, (2 * RISE + 1) * fall / length * step

    def iterate(self, scaled):
        """SciPy accepted a point: record it, and stop when the watch says so."""
        vector = self.length * scaled
        known = (trial for point, trial in reversed(self._recent) if np.array_equal(point, vector))
        trial = next(known, None) or self._trials(vector)
        step, change = trial.vector - self.accepted.vector, trial.slope - self.accepted.slope
        bend = float(np.dot(step, change))
        self.curvature = bend / float(np.dot(step, step)) if bend > 0 else self.curvature
        self.accepted, self._recent = trial, []
        if self._watch(trial):
            raise StopIteration

    def at_rounding(self):
        """Whether the fall that gradient and curvature still promise is lost in the rounding of the loss."""
        if self.curvature is None:
            return False
        size = norm(self.accepted.slope)
        promised = size * (size / (2 * self.curvature))  # in this order nothing overflows
        return promised <= 100 * self.accepted.rounding


def _first_length(first):
    """Length of the first step: |f| / |g|, at most |x|, whichever is known."""
    slope, size = norm(first.slope), norm(first.vector)
    known = [length for length in (abs(first.value) / slope if slope else 0.0, size) if 0 < length < np.inf]
    return min(known, default=1.0)


def _power_of_two(value):
    """The power of two next above, so that dividing by it changes no digits."""
    return 2.0 ** float(np.clip(np.frexp(value)[1], -900, 900)) if value > 0 else 1.0
