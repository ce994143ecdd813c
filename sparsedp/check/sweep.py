"""Differences of a loss along one direction, over a sweep of step sizes."""

from typing import NamedTuple

import numpy as np

from sparsedp.errors import DerivativeError, ShapeError, SparsedpError
from sparsedp.ledger import recording
from sparsedp.tree import norm

__all__ = ["Level", "Line", "Trials", "default_steps", "dot"]

REFUSALS = (SparsedpError, ValueError, ArithmeticError)  # what a loss may raise away from x
SOLVES = ("solve", "adjoint")  # kinds under which the ledger counts solves


class Trials:
    """A loss with its count of evaluations. Away from x it may refuse; then there is a note and no value.

    `told` is called at each evaluation.
    `solved`: whether the ledger showed a solve of this library in the first evaluation; `tolerance`: the
    loosest relative tolerance of iterative ones.
    """

    def __init__(self, loss, told=lambda: None):
        self.loss, self.told = loss, told
        self.count, self.solved, self.tolerance = 0, False, 0.0
        self.eps = float(np.finfo(float).eps)

    def value(self, tree):
        """The loss as a float; the coarsest dtype that it returns is remembered."""
        self.count += 1
        self.told()
        with np.errstate(all="ignore"):
            value = np.asarray(self.loss(tree) if self.count > 1 else self._first(tree))
        if value.shape != ():
            raise ShapeError(f"the loss must be a scalar, got an array of shape {value.shape}; sum it")
        if value.dtype.kind == "c":
            raise DerivativeError(
                "the loss must be real, got a complex number; take its real part or its absolute value"
            )
        if value.dtype.kind == "f":
            self.eps = max(self.eps, float(np.finfo(value.dtype).eps))
        return float(value)

    def _first(self, tree):
        with recording() as calls:
            value = self.loss(tree)
        self.solved = any(kind in SOLVES for _, kind in calls)
        solvers = [actor for found in calls.actors.values() for actor in found.values() if hasattr(actor, "engine")]
        self.tolerance = max((solver.system.rtol for solver in solvers if solver.engine.iterative), default=0.0)
        return value

    def attempt(self, tree):
        """(value, note): NaN and the reason where there is no finite value."""
        try:
            value = self.value(tree)
        except REFUSALS as error:
            return np.nan, f"{type(error).__name__}: {error}"
        return (value, "") if np.isfinite(value) else (np.nan, "the loss overflows")


class Level(NamedTuple):
    """One step size: the losses on both sides, and what the gradient says about the way there."""

    step: float
    plus: float
    minus: float
    ahead: float  # g . (x+ - x)
    behind: float  # g . (x- - x)
    note: str  # why the level cannot be used; empty if it can

    @property
    def difference(self):
        """Central difference quotient."""
        return (self.plus - self.minus) / (2 * self.step)

    @property
    def slope(self):
        """What the gradient says the difference quotient is, for the displacement that was realised."""
        return (self.ahead - self.behind) / (2 * self.step)


def default_steps(eps):
    """Step sizes in units of x, over at least eight decades, from coarse to fine.

    Powers of two, so that x + step * d loses as few digits as it can. Single precision leaves fewer
    decades, so they lie closer.
    """
    return tuple(2.0**-k for k in range(2, 31, 3)) if eps < 1e-10 else tuple(2.0**-k for k in range(-2, 27, 2))


class Line:
    """A sweep along one direction, which can be extended.

    Parameters
    ----------
    name : str
    direction : list of arrays
        Displacement of each leaf for step 1.
    point : Point
    gradient : list of arrays
    trials : Trials
    base : float
        The loss at the point.

    Attributes
    ----------
    noise : float
        Noise of the loss in units of its rounding, where a table of differences has shown it; else 0.
    close : bool
        Whether steps far below the plateau are looked at as well, where there is noise.
    """

    def __init__(self, name, direction, point, gradient, trials, base):
        self.name, self.direction, self.base = name, direction, base
        self.gradient, self.solved, self.tolerance = gradient, trials.solved, trials.tolerance
        self._point, self._trials = point, trials
        self._length = norm(direction)
        self.slope = dot(gradient, direction)
        self.typical = norm([g * d for g, d in zip(gradient, direction, strict=True)])
        self.levels = []
        self.noise, self.close = 0.0, False

    def expected(self, displacement):
        """What the gradient says that the loss changes by."""
        return dot(self.gradient, displacement)

    def sweep(self, steps):
        """Evaluate the loss at x + t d and x - t d for every t of `steps`."""
        self.levels = sorted([*self.levels, *map(self._level, steps)], key=lambda level: -level.step)

    def _level(self, step):
        ends = [self._point.moved(self.direction, sign * step) for sign in (1, -1)]
        there, back = map(self._point.away, ends)
        length = norm([a - b for a, b in zip(there, back, strict=True)]) / (2 * step)
        ahead, behind = self.expected(there), self.expected(back)
        if not abs(length / self._length - 1) < 0.1:
            return Level(step, np.nan, np.nan, ahead, behind, "the step is lost in the rounding of x")
        plus, note = self._trials.attempt(self._point.tree(ends[0]))
        minus, other = self._trials.attempt(self._point.tree(ends[1]))
        if plus == minus == self.base:
            note = "the loss does not change"
        return Level(step, plus, minus, ahead, behind, note or other)

    @property
    def usable(self):
        """Levels with finite losses that differ from the loss at x."""
        return [level for level in self.levels if not level.note]

    @property
    def silent(self):
        """Whether the loss never changed: constant along this direction, to rounding."""
        return not self.usable and any(level.note == "the loss does not change" for level in self.levels)


def dot(gradient, direction):
    """g . d, for complex leaves the real part of the plain product, as the tape defines the gradient."""
    return float(sum(np.sum((g * d).real) for g, d in zip(gradient, direction, strict=True)))
