"""Evaluations of a loss and its gradient: counted, refused ones kept apart, the best one remembered."""

from typing import Any, NamedTuple

import numpy as np

from sparsedp.derivative import pullback, value_and_grad
from sparsedp.errors import ConvergenceError, DerivativeError, NonFiniteError, ShapeError, UnstableStepError
from sparsedp.optimize.batches import Batches
from sparsedp.optimize.box import Box
from sparsedp.optimize.linearised import Linearised
from sparsedp.tape import isbox

__all__ = ["Failure", "Stuck", "Trial", "Trials"]

OPEN, WHOLE = Box(), Batches()
MOST = 4000  # unknowns of which the covariance is found, 128 MB
REFUSED = (UnstableStepError, ConvergenceError, NonFiniteError)


class Stuck(Exception):
    """No admissible point was found; the message says why."""


class Failure(NamedTuple):
    """A trial point that the loss refused."""

    error: str
    message: str


class Trial(NamedTuple):
    """A point, the loss and the flat gradient there. A refused point has the value infinity.

    It has no gradient, nor has a point that is not low enough for whoever asked.
    """

    vector: np.ndarray
    value: float
    slope: np.ndarray | None
    rounding: float = 0.0  # a smaller change of the loss is not seen

    @property
    def refused(self):
        """Whether the loss has no value here."""
        return self.value == np.inf


class Trials:
    """The loss on flat vectors.

    Parameters
    ----------
    loss : callable
    gradient : callable or None
        None: reverse mode.
    packing : Packing
    box : Box
        The points that are allowed.
    batches : Batches
        What the loss is given after x; `batches.number` is moved by the loop.
    squares : method of least squares, or None
        With one, the loss returns residuals r, and what falls is |r|^2 / 2; ``squares.forms(rows, columns)`` tells
        whether it forms their Jacobian.
    """

    best: Trial

    def __init__(self, loss, gradient, packing, box=OPEN, batches=WHOLE, squares=None):
        self._loss, self._gradient, self._packing = loss, gradient, packing
        self._squares, self._forward = squares, False
        self.box, self.batches = box, batches
        self.count = 0
        self.failures = []
        self._last: Any = None  # what was linearised last: it, its point, the number of its batch

    def first(self, vector):
        """The trial at the start; what the loss raises there is not caught."""
        self.best = self._evaluate(vector)
        return self.best

    def __call__(self, vector, below=np.inf):
        """The trial at a point. An error that is part of searching counts as the value infinity.

        The gradient of residuals is left out unless their loss is below what is asked for.
        """
        try:
            trial = self._evaluate(vector, below)
        except REFUSED as error:
            self.failures.append(Failure(type(error).__name__, str(error)))
            return Trial(np.array(vector), np.inf, np.full_like(vector, np.nan))
        if self.batches.varied or trial.value < self.best.value:
            self.best = trial  # losses of two batches cannot be compared: the last point stands
        return trial

    def _evaluate(self, vector, below=np.inf):
        self.count += 1
        value, slope = self._both(vector) if self._squares is None else self._summed(vector, below)
        if not np.isfinite(value):
            raise NonFiniteError(f"the loss is {value}; it must be finite at the start, and elsewhere it is avoided")
        rounded = self._packing.pack(self._packing.unpack(vector))  # single-precision leaves round
        return Trial(rounded, value, slope, self._packing.eps * abs(value))

    def _summed(self, vector, below):
        """Half the sum of squares of the residuals, and its gradient J^T r.

        A Jacobian with fewer columns than rows that is formed anyway is formed at once, by forward products.
        """
        here = self._linearise(vector, self.batches.now())
        with np.errstate(over="ignore"):  # infinity is refused
            value = 0.5 * float(np.dot(here.flat, here.flat))
        if not value < below:
            return value, None
        few = not self._squares.apart and here.shape[1] < here.shape[0]
        self._forward = few and self._squares.forms(*here.shape)
        slope = here.flat @ here.rows() if self._forward else here.pull(here.flat)
        self._last = here, np.array(vector), self.batches.number
        return value, slope

    def _linearise(self, vector, batch):
        return Linearised(self._loss, self._packing, vector, batch, self._forward, self._squares.apart)

    def _both(self, vector):
        """Loss and flat gradient, each from a fresh tree."""
        tree, batch = self._packing.unpack(vector), self.batches.now()
        if self._gradient is None:
            value, gradient = value_and_grad(self._loss)(tree, *batch)
            return value, self._packing.pack_gradient(gradient)
        value = self._loss(tree, *batch)
        if np.shape(value) != ():
            raise ShapeError(f"the loss must be a scalar, got an array of shape {np.shape(value)}; sum it")
        gradient = self._gradient(self._packing.unpack(vector), *batch)
        return float(value), self._packing.pack_gradient(gradient)

    def linearised(self, trial):
        """The residuals at a point and their Jacobian in what the bounds leave free, on the batch that saw it."""
        free = self.box.free_mask(trial.vector, trial.slope)
        here = self._linearised(trial)
        return here if free is None else here.among(free)

    def _linearised(self, trial):
        """Kept, when it was the last one."""
        if self._last is not None:
            here, vector, number = self._last
            same_batch = not self.batches.varied or number == self.batches.number - 1
            if same_batch and np.array_equal(vector, trial.vector):
                return here
        return self._linearise(trial.vector, self.batches.now(back=1))

    def covariance(self, trial):
        """That of the unknowns of a least-squares problem at a point; None where its Jacobian is not formed."""
        if self._squares is None or self.batches.varied:
            return None
        here = self._linearised(trial)
        rows, columns = here.shape
        enough = columns < rows and columns <= MOST and self._squares.forms(rows, columns)
        return here.covariance() if enough else None

    def curvature(self, trial):
        """Function from a flat vector to the Hessian times it, at a point: one tape, one backward pass a product."""
        if self._gradient is not None:
            raise TypeError("newton_cg differentiates the loss twice and takes no gradient of yours; leave it out")
        batch, packing = self.batches.now(back=1), self._packing
        tree = packing.unpack(trial.vector)
        slope, pull = pullback(lambda x: packing.join(value_and_grad(self._loss)(x, *batch)[1]), tree)
        if isbox(slope) or slope.shape != trial.vector.shape:
            raise DerivativeError("newton_cg takes real numbers, got complex ones; split them into two real arrays")
        return lambda v: packing.pack_gradient(pull(np.asarray(v, dtype=slope.dtype)))

    def downhill(self, trial):
        """The part of the gradient that the bounds leave free."""
        return self.box.free(trial.vector, trial.slope)

    def pop_failures(self):
        """The refused points since the last call."""
        failures, self.failures = tuple(self.failures), []
        return failures
