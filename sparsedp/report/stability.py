"""The growth factor of a time step (how much a small change of the state grows in one step), and the stability map.

A change of the state is propagated by the JVP of the step and normalized after each step. After some steps the fastest
growing mode dominates, and the factor by which the change grows is the growth factor. A factor above 1 is not always an
error, because unstable physics grows, too. The step itself is unstable if the fastest mode changes its sign from step
to step, or if the growth per unit of time becomes smaller with a smaller step.

References
----------
G. Benettin, L. Galgani, A. Giorgilli and J.-M. Strelcyn, Lyapunov characteristic exponents, Meccanica 15, 1980.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from sparsedp._utils.counters import thread
from sparsedp._utils.pytree import mapped, norm
from sparsedp.autodiff.derivative import jvp
from sparsedp.check.point import Point
from sparsedp.check.summary import Result
from sparsedp.check.table import Table
from sparsedp.errors import SparsedpError

__all__ = ["LARGEST_STEADY_GROWTH", "SEED", "Growth", "StabilityMap", "growth_of", "stability_map"]

SEED = 20240229  # seed of random changes in this module and in the stress cases
STEPS = 40
MEASURED_STEPS = 20  # the growth is averaged over this number of last steps
LARGEST_STEADY_GROWTH = 1.0 + 1e-3  # growth factors up to here do not count as growth
SHARES = np.geomspace(1e-2, 1e2, 9)  # multiples of time step and viscosity along the axes of the map


class Growth(NamedTuple):
    """The growth of a small change in one time step.

    Attributes
    ----------
    factor : float
        The growth factor; NaN if the step raised an error.
    flips : bool
        Whether the fastest mode changes its sign from step to step.
    refusal : str
        Name of the exception that the step raised; empty if none.
    """

    factor: float
    flips: bool = False
    refusal: str = ""


class _FirstRollout(Exception):
    """Raised inside a loss at the start of its first rollout. `args` are the step function and the initial state."""


def growth_of(loss: Callable[[Any], Any], x: Any, step: Callable[[Any], Any] | None = None) -> Growth | None:
    """Return the growth in one step of the first rollout in a loss; None if the loss has no rollout.

    Parameters
    ----------
    loss : callable
    x : tree of arrays
    step : callable, optional
        ``step(x)`` returns (advance, state): a step function and an initial state, in place of the first rollout.
    """
    try:
        if step is None:
            loop = _first_rollout(loss, x)
        else:
            loop = step(x)
        return loop and _measure_growth(*loop)
    except (SparsedpError, ValueError, ArithmeticError, RuntimeError) as error:
        return Growth(np.nan, refusal=type(error).__name__)


def _first_rollout(loss: Callable[[Any], Any], x: Any) -> Any:
    """Return (step function, initial state) of the first rollout in a loss; None if there is no rollout."""

    def leave(step: Any, state: Any, params: Any, inputs: Any, n: int) -> None:
        if not n:
            return
        if inputs is None:
            raise _FirstRollout(lambda state: step(state, params), state)
        first_inputs = mapped(lambda leaf: leaf[0] if isinstance(leaf, np.ndarray) else leaf, inputs)
        raise _FirstRollout(lambda state: step(state, params, first_inputs), state)

    thread.loop_hooks.append(leave)
    try:
        loss(x)
    except _FirstRollout as rollout:
        return rollout.args
    finally:
        thread.loop_hooks.remove(leave)
    return None


def _measure_growth(advance: Callable[[Any], Any], state: Any) -> Growth:
    """Measure the growth of a random change, averaged over the last MEASURED_STEPS of STEPS steps."""
    change = np.random.default_rng(SEED).standard_normal(Point(state).size)
    rates = []
    flips = []
    for _ in range(STEPS):
        point = Point(state)
        direction = change / norm(change)
        state, tangent = jvp(advance, state, point.unpack(direction))
        change = point.pack(tangent)
        size = norm(change)
        if size == 0 or not np.isfinite(size):
            return Growth(float(size), flips=size > 0)
        rates.append(np.log(size))
        flips.append(direction @ change < 0)
    rate, share_of_flips = np.mean(np.column_stack([rates, flips])[-MEASURED_STEPS:], axis=0)
    return Growth(float(np.exp(rate)), bool(share_of_flips > 0.5))


class StabilityMap(Result):
    """Growth factors over time step (rows) and viscosity (columns).

    Attributes
    ----------
    names : (str, str)
        Names of the time step and of the viscosity.
    time_steps, viscosities : 1-D arrays
    factors : 2-D array
        Growth factor of a step; NaN if the step raises an error.
    here : (float, float)
        Time step and viscosity of the scene.
    """

    _plain = ("time_steps", "viscosities", "factors")

    def parts(self) -> list[str | Table]:
        """Return the table of growth factors."""
        cells = np.where(np.isnan(self.factors), "refused", self.factors.astype(object))
        rows = [(time_step, *row) for time_step, row in zip(self.time_steps, cells)]
        return ["growth factor of a step:", Table((" \\ ".join(self.names), *self.viscosities), rows)]


def stability_map(scene: Any) -> StabilityMap | None:
    """Return the stability map of a scene.

    Return None unless the scene has a rollout, and time step and viscosity are positive single numbers.
    """
    time_step_name = scene.time_step
    viscosity_name = scene.viscosity
    if not scene.growth or scene.growth.refusal or time_step_name is None or viscosity_name is None:
        return None
    time_step = scene.leaves[time_step_name]
    viscosity = scene.leaves[viscosity_name]
    if time_step.size != 1 or viscosity.size != 1 or min(time_step, viscosity) <= 0:
        return None
    factors = np.full((SHARES.size, SHARES.size), np.nan)
    for row, longer in enumerate(SHARES):
        for column, stiffer in enumerate(SHARES):
            growth = scene.growth_at({time_step_name: time_step * longer, viscosity_name: viscosity * stiffer})
            if growth:
                factors[row, column] = growth.factor
    return StabilityMap(
        names=(time_step_name, viscosity_name),
        time_steps=time_step.item() * SHARES,
        viscosities=viscosity.item() * SHARES,
        factors=factors,
        here=(time_step.item(), viscosity.item()),
    )
