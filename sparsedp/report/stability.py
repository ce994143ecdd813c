"""The growth factor of a time step: by how much a small change of the state grows in one step; and its map.

A change is carried along the run by the tangent of the step and made small again after each step; what it grows
by, once the fastest mode has won, is the growth factor (G. Benettin et al., Meccanica 15, 1980). Above 1 is not
wrong in itself: unstable physics grows. It is the step that is wrong when the fastest mode changes its sign from
step to step, or when the growth per unit of time falls with the step.
"""

from typing import NamedTuple

import numpy as np

from sparsedp._utils.counters import thread
from sparsedp._utils.pytree import mapped, norm
from sparsedp.autodiff.derivative import jvp
from sparsedp.check.point import Point
from sparsedp.check.summary import Result
from sparsedp.check.table import Table
from sparsedp.errors import SparsedpError

__all__ = ["SEED", "STEADY", "Growth", "StabilityMap", "growth_of", "stability_map"]

SEED = 20240229  # of random changes, here and in the stress cases
STEPS, SETTLED = 40, 20  # steps in all, and those that are measured
STEADY = 1.0 + 1e-3  # growth factors up to here do not count as growth
SHARES = np.geomspace(1e-2, 1e2, 9)  # of the time step and viscosity of the scene, along the axes of the map


class Growth(NamedTuple):
    """Growth factor of one step, NaN where there is none; whether the fastest mode flips its sign; the error."""

    factor: float
    flips: bool = False
    refusal: str = ""


class Loop(Exception):
    """Carries the first rollout out of a loss before it runs; `args` are one step of it, and where it starts."""


def growth_of(loss, x, step=None):
    """Loss and point -> Growth of the step of its first rollout; None without one.

    ``step(x) -> (advance, state)`` gives another loop.
    """
    try:
        loop = _first_rollout(loss, x) if step is None else step(x)
        return loop and _measured(*loop)
    except (SparsedpError, ValueError, ArithmeticError, RuntimeError) as error:
        return Growth(np.nan, refusal=type(error).__name__)


def _first_rollout(loss, x):
    def leave(step, state, params, inputs, n):
        if n:
            first = mapped(lambda leaf: leaf[0] if isinstance(leaf, np.ndarray) else leaf, inputs)
            rest = () if inputs is None else (first,)
            raise Loop(lambda state: step(state, params, *rest), state)

    thread.loop_hooks.append(leave)
    try:
        loss(x)
    except Loop as loop:
        return loop.args
    finally:
        thread.loop_hooks.remove(leave)
    return None


def _measured(advance, state):
    change, steps = np.random.default_rng(SEED).standard_normal(Point(state).size), []
    for _ in range(STEPS):
        point, before = Point(state), change / norm(change)
        state, moved = jvp(advance, state, point.unpack(before))
        change = point.pack(moved)
        size = norm(change)
        if size == 0 or not np.isfinite(size):
            return Growth(float(size), flips=size > 0)
        steps.append((np.log(size), before @ change < 0))
    rate, flips = np.mean(steps[-SETTLED:], axis=0)
    return Growth(float(np.exp(rate)), bool(flips > 0.5))


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

    def parts(self):
        """The factors."""
        cells = np.where(np.isnan(self.factors), "refused", self.factors.astype(object))
        rows = [(dt, *row) for dt, row in zip(self.time_steps, cells)]
        return ["growth factor of a step:", Table((" \\ ".join(self.names), *self.viscosities), rows)]


def stability_map(scene):
    """Scene -> StabilityMap, or None where it has no loop, or no named time step and viscosity of one number each."""
    names = scene.time_step, scene.viscosity
    here = [scene.leaves[name] for name in names if name]
    if not scene.growth or scene.growth.refusal or [x.size for x in here] != [1, 1] or min(here) <= 0:
        return None
    dt, nu = here

    def factor(longer, stiffer):
        growth = scene.growth_at(dict(zip(names, (dt * longer, nu * stiffer))))
        return growth.factor if growth else np.nan

    factors = np.array([[factor(longer, stiffer) for stiffer in SHARES] for longer in SHARES])
    steps, viscosities, place = dt.item() * SHARES, nu.item() * SHARES, (dt.item(), nu.item())
    return StabilityMap(names=names, time_steps=steps, viscosities=viscosities, factors=factors, here=place)
