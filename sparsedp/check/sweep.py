"""The numbers of an audit: a point, directions to leave it, and losses over a sweep of step sizes on both sides.

A point is one vector of real numbers, complex leaves as pairs, and so are gradients and directions: the derivative
along a direction is a plain dot product. The noise of the loss comes from a table of differences of neighbouring
values. The loss itself only ever sees fresh copies of the tree.
"""

import math
from typing import NamedTuple

import numpy as np

from sparsedp._utils.counters import recording, thread
from sparsedp._utils.pytree import copied, mapped, norm
from sparsedp._utils.validation import advise, check_finite
from sparsedp.autodiff.backend import gathered
from sparsedp.autodiff.derivative import check_loss
from sparsedp.autodiff.flattening import Packing, joined
from sparsedp.check.summary import error_text
from sparsedp.errors import SparsedpError

__all__ = [
    "POINTS",
    "QUICK",
    "REFUSALS",
    "Line",
    "Point",
    "Trials",
    "default_steps",
    "generator",
    "noise_of",
    "rms",
    "solvers_of",
]

REFUSALS = (SparsedpError, ValueError, ArithmeticError)  # what a loss may raise away from x
MOST_LEAVES = 8  # with more leaves than this, none gets a direction for itself
SAME = "the loss does not change"
QUICK = "random 1", "gradient"  # the directions that are looked at where there is time for two


def generator(rng):
    """None, a seed or a Generator -> a Generator that nobody else draws from."""
    return np.random.default_rng(20240229 if rng is None else rng)


def default_steps(eps):
    """Step sizes in units of x, over at least eight decades, from coarse to fine.

    Powers of two, so that x + step * d loses as few digits as it can. Single precision leaves fewer
    decades, so they lie closer.
    """
    return tuple(2.0**-k for k in (range(2, 31, 3) if eps < 1e-10 else range(-2, 27, 2)))


# ------------------------------------------------------------ points and directions


class Point(Packing):
    """Where a loss is examined, as a vector.

    Each leaf has a unit: the root mean square of its values (1 if they are all 0). A step of size t
    moves every leaf by t times its unit, so that leaves of different physical size are all examined.

    Parameters
    ----------
    x : tree of arrays
    """

    def __init__(self, x):
        # Numbers of NumPy in place of Python's: those divide by 0, and take complex steps. Of fields on ranks all.
        number = lambda leaf: np.asarray(leaf)[()] if isinstance(leaf, (float, complex)) else gathered(leaf)
        super().__init__(mapped(number, x))
        for name, values in zip(self.names, self.values):
            check_finite(name, values, "must be finite where a gradient is checked")
        self.vector = joined(self.values)
        self.values = self.arrays(self.vector)  # the caller may write into those of x
        self.units = self.sizes(self.vector)
        self.entries = sum(map(np.size, self.values))

    def tree(self, arrays):
        """As of any packing, with copies of the other leaves."""
        return copied(super().tree(arrays))

    def fresh(self):
        """The tree."""
        return self.unpack(self.vector)

    def gradient(self, tree):
        """Vector of a gradient, a tree like x."""
        return joined(self.slopes(tree))

    def sizes(self, vector):
        """Root mean square of each leaf, 1 of zeros, for each of its entries."""
        return self._each([rms(part) or 1.0 for part in self.split(vector)])

    def _each(self, values):
        """A value for each leaf -> one for each entry."""
        return np.repeat(values, [part.size for part in self.split(self.vector)])

    def directions(self, gradient, count, rng, wanted=None):
        """Names and displacements: random ones, and structured ones that see what random ones average away.

        Each leaf alone, all by the same, along the gradient, its largest entry; ``wanted(name)``: whether it is.
        """
        displacements = {f"random {number + 1}": self.random(rng) for number in range(count)}
        leaf = self._each(range(len(self.values)))
        for place, name in enumerate(self.names if 1 < len(self.names) <= MOST_LEAVES else ()):
            displacements[f"random in {name}"] = self.random(rng) * (leaf == place)
        slopes = self.units * gradient
        largest = np.max(np.abs(slopes), initial=0.0)
        if self.entries > 1:
            displacements["constant"] = self.units
        if self.entries > 1 and largest:
            # Along the gradient, as the units measure it, no entry moves more than 4 units.
            shares = slopes / largest
            displacements["gradient"] = self.units * shares / max(rms(shares), 0.25)
            displacements["largest entry"] = self.units * (np.arange(slopes.size) == np.argmax(np.abs(slopes)))
        return [(name, way) for name, way in displacements.items() if np.any(way) and (wanted is None or wanted(name))]

    def random(self, rng):
        """Random displacement, of root mean square 1 in each leaf."""
        values = rng.standard_normal(self.vector.size)
        return self.units * (values / self.sizes(values))


def eps_of(dtype):
    """Size of one rounding."""
    return float(np.finfo(dtype).eps)


def rms(vector):
    """Root mean square."""
    return norm(vector) / np.sqrt(max(vector.size, 1))


# ------------------------------------------------------------ losses


class Trials:
    """A loss at a point with the gradient under test. Away from the point it may refuse: a note, and no value.

    Parameters
    ----------
    loss : callable
    point : Point
    slope : callable or tree
        The gradient under test.
    steps : sequence of float
        Step sizes; without any the usual ones, and more where they leave the derivative open.
    tick : callable
        Is called at each evaluation.

    Attributes
    ----------
    base : float
        The loss at the point, once it is started.
    gradient : vector
        At the point.
    noise : float
        Noise of the loss in units of its rounding, where a table of differences has shown it; else 0.
    deviation : float
        The same in units of the loss.
    count : int
        Evaluations.
    solved : bool
        Whether the loss takes a solve of this library at the point.
    tolerance : float
        The loosest relative tolerance of iterative ones.
    step_tolerance : float
        The loosest tolerance of time steps with error control; 0 without any.
    eps : float
        Rounding of the coarsest dtype that the loss has returned.
    """

    def __init__(self, loss, point, slope, steps=(), tick=lambda: None):
        self.loss, self.point, self.slope, self.tick = loss, point, slope, tick
        self.steps, self.extend = steps or default_steps(point.eps), not steps
        self.base = self.gradient = np.nan  # until it is started
        self.count, self.solved, self.tolerance, self.noise = 0, False, 0.0, 0.0
        self.step_tolerance = 0.0
        self.deviation = 0.0
        self.eps = eps_of(float)

    def value(self, tree):
        """The loss as a float."""
        self.count += 1
        self.tick()
        with np.errstate(all="ignore"):
            value = self.loss(tree)
        check_loss(value)
        value = np.asarray(value)
        if value.dtype.kind == "f":
            self.eps = max(self.eps, eps_of(value.dtype))
        return float(value)

    def gradient_at(self, tree):
        """The gradient under test, as a vector."""
        return self.point.gradient(self.slope(tree) if callable(self.slope) else self.slope)

    def start(self):
        """Find the loss at the point, and the tolerances of solves and time steps in it.

        Those are recorded in one more run: recording is no part of what is judged.
        """
        solves, controlled = thread.solves, thread.controlled
        try:
            self.base = self.value(self.point.fresh())
        except TypeError as error:
            advise(error)
            raise
        self.solved = thread.solves > solves
        if self.solved or thread.controlled > controlled:
            with recording() as calls, np.errstate(all="ignore"):
                self.loss(self.point.fresh())
            loose = [solver.system.rtol for _, solver in solvers_of(calls) if solver.engine.iterative]
            self.tolerance = max(loose, default=0.0)
            of_steps = [tolerances for (_, what), tolerances in calls.notes.items() if what == "tolerance"]
            self.step_tolerance = max((max(tolerances) for tolerances in of_steps), default=0.0)


def solvers_of(calls):
    """Recorded calls -> pairs of name and solver, of all that solved."""
    return [(name, one) for name, actors in calls.actors.items() for one in actors.values() if hasattr(one, "engine")]


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


class Line:
    """A sweep along one direction, which can be extended.

    Parameters
    ----------
    name : str
    direction : vector
        Displacement for step 1.
    trials : Trials
    """

    def __init__(self, name, direction, trials):
        self.name, self.direction, self.trials = name, direction, trials
        self.point, self.base, self.gradient = trials.point, trials.base, trials.gradient
        self.slope, self.typical = float(self.gradient @ direction), norm(self.gradient * direction)
        self.levels = []

    def end(self, step):
        """(loss at x + step d, what the gradient expects it to change by, why there is no loss)."""
        arrays = self.point.arrays(self.point.vector + step * self.direction)
        away = joined(arrays) - self.point.vector  # what the rounding of x left of the step
        change = float(self.gradient @ away)
        if not abs(norm(away) / (abs(step) * norm(self.direction)) - 1) < 0.1:
            return np.nan, change, "the step is lost in the rounding of x"
        try:
            value = self.trials.value(self.point.tree(arrays))
        except REFUSALS as error:
            return np.nan, change, error_text(error)
        return value, change, "" if np.isfinite(value) else "the loss overflows"

    def sweep(self, steps):
        """Evaluate the loss at x + t d and x - t d for every new t of `steps`."""
        earlier = {level.step: level for level in self.levels}
        self.levels = [earlier.get(step) or self.level(step) for step in sorted({*earlier, *steps}, reverse=True)]

    def level(self, step):
        """The losses at x + t d and x - t d."""
        (plus, ahead, note), (minus, behind, other) = self.end(step), self.end(-step)
        return Level(step, plus, minus, ahead, behind, SAME if plus == minus == self.base else note or other)

    @property
    def usable(self):
        """Levels with finite losses that differ from the loss at x."""
        return [level for level in self.levels if not level.note]

    @property
    def silent(self):
        """Steps that left the loss the same, if all did: it is constant along this direction, to rounding."""
        return [] if self.usable else [level.step for level in self.levels if level.note == SAME]


# ------------------------------------------------------------ noise

POINTS = 8  # of a table of differences
ORDER, VARIANCE = 4, 70.0  # of the differences that are read: parabolas leave them alone; (2k)! / (k!)^2
FIRST = 0.7320508 * 2.0**-28  # least distance, in units of x, of double precision; no power of two times a step
GROWTH = 2.0**6  # of the distance, while the loss stands still
MOST = 4  # distances tried


def noise_of(line):
    """Measure how much the loss varies where it should not.

    Returns
    -------
    (float, float)
        Standard deviation, in units of the rounding of the loss and in those of the loss; 0 where nothing varies.

    Notes
    -----

    Values at equal distances, so close that a smooth loss is a straight line there. The k-th differences of a line
    are 0; those of independent errors of standard deviation s have the variance s^2 (2k)! / (k!)^2. The distance is
    no power of two times a step of the sweep, and it grows until the loss changes from point to point: else the
    steps of a loss that was rounded (to single precision, by a table) fall on the points of the sweep and hide.

    Source: the table is that of J. J. Moré and S. M. Wild, SIAM J. Sci. Comput. 33, 2011.
    """
    distance = FIRST * max(1.0, line.point.eps / eps_of(float)) ** 0.5
    for _ in range(MOST):
        # On one side: a kink at x is no noise.
        values, changes, notes = zip(*(line.end(place * distance) for place in range(1, POINTS + 1)))
        if any(notes):
            return 0.0, 0.0
        if np.count_nonzero(np.diff(values)) > POINTS // 2:
            size = max(*map(abs, values), abs(line.base), np.finfo(float).tiny)
            rests = np.array(values) - line.base - changes
            deviation = norm(np.diff(rests, ORDER)) / math.sqrt((POINTS - ORDER) * VARIANCE)
            return deviation / (line.trials.eps * size), deviation
        distance *= GROWTH
    return 0.0, 0.0
