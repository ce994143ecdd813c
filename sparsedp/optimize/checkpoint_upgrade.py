"""States of minimize as version 0.2 wrote them, converted to those of today."""

from __future__ import annotations

from typing import Any

from sparsedp.optimize.first_order import DescentState
from sparsedp.optimize.least_squares import SquaresState
from sparsedp.optimize.newton import NewtonState
from sparsedp.optimize.result import Trial
from sparsedp.optimize.trials import SMALLEST

__all__ = ["FORMAT_0_2", "upgraded"]

FORMAT_0_2 = "sparsedp optimization 4"
TRIAL_FIELDS = 5  # a state begins with the fields of its point


def upgraded(
    state_fields: list[Any], best_fields: list[Any], template: Any, residual_scale: float | None
) -> tuple[Any, Trial]:
    """Return the state and the best point of a checkpoint of version 0.2.

    Parameters
    ----------
    state_fields, best_fields : list
        What the file holds: the numbers and arrays of both.
    template : state of the method at the start
        Its type says which method the state belongs to; its units are those of the result.
    residual_scale : float or None
        The power of two that least-squares problems divide their residuals by. Version 0.2 did not divide them.

    Returns
    -------
    state : named tuple like template
    best : Trial
    """
    residual_scale = residual_scale or 1.0
    trial = _trial(state_fields[:TRIAL_FIELDS], residual_scale)
    state = _state(trial, state_fields[TRIAL_FIELDS:], template, residual_scale)
    return state, _trial(best_fields, residual_scale)


def _trial(fields, residual_scale):
    """Return a point with its loss and gradient, given those of residuals that were not divided."""
    vector, value, slope, rounding, iteration = fields
    value = value / residual_scale / residual_scale
    slope = slope / residual_scale / residual_scale
    rounding = max(rounding / residual_scale / residual_scale, SMALLEST)
    return Trial(vector, value, slope, rounding, iteration)


def _state(trial, fields, template, residual_scale):
    """Return the state of a method from its fields in version 0.2 after the point."""
    if isinstance(template, DescentState):
        velocity, rate, share = fields  # the rate belonged to the gradient itself
        return DescentState(trial, velocity, rate * template.height, share, template.height)
    if isinstance(template, NewtonState):
        radius, size = fields  # the radius was in the units of x
        return NewtonState(trial, radius / template.length, size, template.length)
    if isinstance(template, SquaresState):
        damping, share = fields  # the damping belonged to the Jacobian itself
        unit = 1.0 if damping else 0.0
        return SquaresState(trial, damping / residual_scale / residual_scale, share, unit)
    return type(template)(trial, *fields)
