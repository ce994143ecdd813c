"""The growth factor of a time step: by how much a small change of the state grows in one step; and its map.

A change is carried along the run by the tangent of the step and normalized after each step; the factor by which it
grows once the fastest mode dominates is the growth factor. A factor above 1 need not be wrong: unstable physics
grows. The step is wrong when the fastest mode changes its sign from step to step, or when the growth per unit of time
falls with the step.

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

SEED = 20240229  # of random changes, here and in the stress cases
STEPS = 40
MEASURED_STEPS = 20  # the last ones
LARGEST_STEADY_GROWTH = 1.0 + 1e-3  # growth factors up to here do not count as growth
SHARES = np.geomspace(1e-2, 1e2, 9)  # of the time step and viscosity of the scene, along the axes of the map


class Growth(NamedTuple):
    """Growth in one step.

    Attributes
    ----------
    factor : float
        NaN where there is none.
    flips : bool
        Whether the fastest mode changes its sign from step to step.
    refusal : str
        Name of the error that the step raised.
    """

    factor: float
    flips: bool = False
    refusal: str = ""


class _FirstRollout(Exception):
    """Carries the first rollout out of a loss before it runs; `args` are one step of it, and its start."""


def growth_of(loss: Callable[[Any], Any], x: Any, step: Callable[[Any], Any] | None = None) -> Growth | None:
    """Return the growth of the step of the first rollout of a loss; None without one.

    Parameters
    ----------
    loss : callable
    x : tree of arrays
    step : callable, optional
        ``step(x)`` returns (advance, state) of another loop.
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
    """Return one step of the first rollout of a loss, and its start; None without one."""

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
    """Measure the growth of a random change over the last of some steps."""
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
    """Growth factors over time step (down) and viscosity (across).

    Attributes
    ----------
    names : (str, str)
    time_steps, viscosities : 1-D arrays
    factors : 2-D array
        Growth factor of a step; NaN where the step is refused.
    here : (float, float)
        Time step and viscosity of the scene.
    """

    _plain = ("time_steps", "viscosities", "factors")

    def parts(self) -> list[str | Table]:
        """Return the factors."""
        cells = np.where(np.isnan(self.factors), "refused", self.factors.astype(object))
        rows = [(time_step, *row) for time_step, row in zip(self.time_steps, cells)]
        return ["growth factor of a step:", Table((" \\ ".join(self.names), *self.viscosities), rows)]


def stability_map(scene: Any) -> StabilityMap | None:
    """Return the stability map of a scene; None without a loop and both as single numbers."""
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
