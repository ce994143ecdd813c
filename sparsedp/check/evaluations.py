"""Evaluations of a loss along lines through a point. They are the data from which an audit draws its conclusions.

Each evaluation receives a new copy of the tree, so that a loss that modifies its argument does not change the point.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sparsedp._utils.counters import recording, thread
from sparsedp._utils.pytree import norm
from sparsedp._utils.validation import advise
from sparsedp.autodiff.derivative import check_loss
from sparsedp.autodiff.flattening import joined
from sparsedp.check.point import Point
from sparsedp.check.step_sizes import COARSER_STEPS, default_steps
from sparsedp.check.summary import error_text
from sparsedp.errors import SparsedpError

__all__ = ["EVALUATION_ERRORS", "FLOAT_TINY", "Evaluations", "Level", "Line", "solvers_of"]

# Exceptions that a loss may raise at a trial point, where it has no value. The solvers of SciPy raise RuntimeError.
EVALUATION_ERRORS = (SparsedpError, ValueError, ArithmeticError, RuntimeError)
FLOAT_TINY = float(np.finfo(float).tiny)
LOST_SHARE = 0.1  # a step is unusable if the rounding of x changes the displacement by more than this share


def _no_tick() -> None:
    """Do nothing. This is the default of `Evaluations.tick`."""


class Evaluations:
    """A loss and the gradient under test at a point, with the noise and the tolerances of the loss.

    Parameters
    ----------
    loss : callable
    point : Point
    gradient : callable or tree
        The gradient under test.
    steps : sequence of float
        Step sizes. If empty, the default steps are used, and more steps are added if they give no decision.
    tick : callable
        Called without arguments at each evaluation of the loss.

    Attributes
    ----------
    base : float
        The loss at the point. Set by `start`.
    slopes : ndarray
        The gradient under test at the point, as a vector.
    noise : float
        Noise of the loss in units of its rounding, measured by a table of differences; 0 if none was measured.
    deviation : float
        The same noise as an absolute value.
    count : int
        Number of evaluations of the loss.
    solved : bool
        Whether the loss calls a linear or nonlinear solve of this library.
    tolerance : float
        The largest relative tolerance of the iterative solves; 0 if there are none.
    step_tolerance : float
        The largest tolerance of time steps with error control; 0 if there are none.
    coarser_steps : tuple of float
        Steps that extend a sweep in which rounding errors hide the derivative.
    eps : float
        Machine epsilon of the dtype with the lowest precision that the loss has returned, at least that of float64.
    loss_name, gradient_name : str
        Names of the loss and of the gradient under test in sentences.
    digits_needed : int
        Number of digits in which a gradient must agree if the loss has noise, for sentences.
    """

    coarser_steps = COARSER_STEPS

    def __init__(
        self,
        loss: Callable[[Any], Any],
        point: Point,
        gradient: Any,
        steps: Sequence[float] = (),
        tick: Callable[[], Any] = _no_tick,
    ) -> None:
        self.loss = loss
        self.point = point
        self.gradient = gradient
        self.tick = tick
        self.steps = steps or default_steps(point.eps)
        self.may_extend = not steps
        self.base = np.nan
        self.slopes: Any = np.nan
        self.count = 0
        self.solved = False
        self.tolerance = 0.0
        self.step_tolerance = 0.0
        self.noise = 0.0
        self.deviation = 0.0
        self.eps = float(np.finfo(float).eps)
        self.loss_name = "the loss"
        self.gradient_name = "the gradient"
        self.digits_needed = 6

    @property
    def unchanged(self) -> str:
        """Note of a level at which the loss has the same value as at x."""
        return f"{self.loss_name} does not change"

    def value(self, tree: Any) -> float:
        """Return the loss as a float."""
        self.count += 1
        self.tick()
        with np.errstate(all="ignore"):
            value = self.loss(tree)
        check_loss(value)
        value = np.asarray(value)
        if value.dtype.kind == "f":
            self.eps = max(self.eps, float(np.finfo(value.dtype).eps))
        return float(value)

    def gradient_at(self, tree: Any) -> NDArray[Any]:
        """Return the gradient under test as a vector."""
        if callable(self.gradient):
            gradient = self.gradient(tree)
        else:
            gradient = self.gradient
        return self.point.gradient(gradient)

    def at(self, point: Point) -> Evaluations:
        """Return evaluations of the same loss and gradient at another point, with the default steps."""
        return Evaluations(self.loss, point, self.gradient, tick=self.tick)

    def start(self) -> None:
        """Evaluate the loss at the point, and find the tolerances of its solves and time steps.

        The tolerances are recorded in a second run, because recording may change how functions are called.
        """
        solves = thread.solves
        controlled = thread.controlled
        try:
            self.base = self.value(self.point.fresh())
        except TypeError as error:
            advise(error)
            raise
        self.find_tolerances(self.loss, solves, controlled)

    def find_tolerances(self, function: Callable[[Any], Any], solves: int, controlled: int) -> None:
        """Find the tolerances of the solves and time steps of a function by another run at the point.

        Parameters
        ----------
        function : callable
        solves, controlled : int
            The counters of solves and of time steps with error control before the first run of the function.
        """
        self.solved = thread.solves > solves
        if self.solved or thread.controlled > controlled:
            with recording() as calls, np.errstate(all="ignore"):
                function(self.point.fresh())
            tolerances = [solver.system.rtol for _, solver in solvers_of(calls) if solver.engine.iterative]
            self.tolerance = max(tolerances, default=0.0)
            for (_, what), values in calls.notes.items():
                if what == "tolerance":
                    self.step_tolerance = max(self.step_tolerance, *values)


def solvers_of(calls: Any) -> list[tuple[str, Any]]:
    """Return the names and solvers of all recorded solves."""
    return [
        (name, method_object)
        for name, method_objects in calls.method_objects.items()
        for method_object in method_objects.values()
        if hasattr(method_object, "engine")
    ]


class Level(NamedTuple):
    """The losses on both sides of the point at one step size, and the changes that the gradient predicts.

    Attributes
    ----------
    step : float
    plus, minus : float
        f(x + t d) and f(x - t d).
    ahead, behind : float
        g . (x+ - x) and g . (x- - x), where x+ and x- are x + t d and x - t d as rounded to the dtype of x.
    note : str
        Why the level cannot be used; empty if it can.
    """

    step: float
    plus: float
    minus: float
    ahead: float
    behind: float
    note: str

    @property
    def difference(self) -> float:
        """Central difference quotient."""
        return (self.plus - self.minus) / (2 * self.step)

    @property
    def slope(self) -> float:
        """Difference quotient that the gradient predicts for the rounded displacements."""
        return (self.ahead - self.behind) / (2 * self.step)


class Line:
    """Evaluations of the loss along one direction at many step sizes. More steps can be added by `sweep`.

    Parameters
    ----------
    name : str
    direction : ndarray
        The direction d: the displacement for step size 1.
    evaluations : Evaluations

    Attributes
    ----------
    slope : float
        g . d, the derivative along d by the gradient under test.
    typical : float
        2-norm of the vector of terms g_i d_i of g . d.
    levels : list of Level
        From coarse to fine.
    is_short : bool
        Whether the steps do not reach those at which rounding dominates. Differences between the finest levels are then
        no measure of the noise.
    """

    is_short = False

    def __init__(self, name: str, direction: NDArray[Any], evaluations: Evaluations) -> None:
        self.name = name
        self.direction = direction
        self.evaluations = evaluations
        self.point = evaluations.point
        self.base = evaluations.base
        self.gradient = evaluations.slopes
        self.slope = float(self.gradient @ direction)
        self.typical = norm(self.gradient * direction)
        self.levels: list[Level] = []

    def end(self, step: float) -> tuple[float, float, str]:
        """Evaluate the loss at x + step d.

        Returns
        -------
        value : float
            The loss, NaN if it raised an exception or the step is too small for the precision of x.
        change : float
            The change of the loss that the gradient predicts.
        note : str
            Why the value cannot be used; empty if it can.
        """
        arrays = self.point.arrays(self.point.vector + step * self.direction)
        displacement = joined(arrays) - self.point.vector  # after rounding to the dtype of x
        change = float(self.gradient @ displacement)
        if not abs(norm(displacement) / (abs(step) * norm(self.direction)) - 1) < LOST_SHARE:
            return np.nan, change, "the step is lost in the rounding of x"
        try:
            value = self.evaluations.value(self.point.tree(arrays))
        except EVALUATION_ERRORS as error:
            return np.nan, change, error_text(error)
        return value, change, "" if np.isfinite(value) else f"{self.evaluations.loss_name} overflows"

    def sweep(self, steps: Iterable[float]) -> None:
        """Evaluate the loss at x + t d and x - t d for each t in `steps` that was not evaluated before."""
        earlier = {level.step: level for level in self.levels}
        all_steps = sorted({*earlier, *steps}, reverse=True)
        self.levels = [earlier.get(step) or self.level(step) for step in all_steps]

    def level(self, step: float) -> Level:
        """Evaluate the loss at x + t d and x - t d."""
        plus, ahead, note_ahead = self.end(step)
        minus, behind, note_behind = self.end(-step)
        note = note_ahead or note_behind
        if plus == minus == self.base:
            note = self.evaluations.unchanged
        return Level(step, plus, minus, ahead, behind, note)

    def rounding(self, steps: NDArray[Any], losses: NDArray[Any]) -> NDArray[Any]:
        """Return the rounding error of the losses at each step.

        Parameters
        ----------
        steps : ndarray, shape (n,)
        losses : ndarray, shape (2, n)
            The losses on both sides.
        """
        return self.evaluations.eps * np.max(np.abs(losses), axis=0, initial=max(abs(self.base), FLOAT_TINY))

    @property
    def usable(self) -> list[Level]:
        """Levels with finite losses that differ from the loss at x."""
        return [level for level in self.levels if not level.note]

    @property
    def unchanged_steps(self) -> list[float]:
        """Steps at which the loss has the same value as at x. Empty if the loss changes at another step."""
        if self.usable:
            return []
        return [level.step for level in self.levels if level.note == self.evaluations.unchanged]
