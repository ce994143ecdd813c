"""States of minimize as version 0.2 wrote them, converted to those of today."""

from __future__ import annotations

from typing import Any

from sparsedp.optimize.first_order import DescentState
from sparsedp.optimize.least_squares import SquaresState
from sparsedp.optimize.newton_cg import NewtonState
from sparsedp.optimize.objective import SMALLEST
from sparsedp.optimize.result import Evaluation

__all__ = ["FORMAT_0_2", "upgraded"]

FORMAT_0_2 = "sparsedp optimization 4"
POINT_FIELDS = 5  # a state begins with the fields of its point


def upgraded(
    state_fields: list[Any], best_fields: list[Any], template: Any, residual_scale: float | None
) -> tuple[Any, Evaluation]:
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
    best : Evaluation
    """
    residual_scale = residual_scale or 1.0
    current = _evaluation(state_fields[:POINT_FIELDS], residual_scale)
    state = _state(current, state_fields[POINT_FIELDS:], template, residual_scale)
    return state, _evaluation(best_fields, residual_scale)


def _evaluation(fields, residual_scale):
    """Return a point with its loss and gradient, given those of residuals that were not divided."""
    vector, value, gradient, rounding, iteration = fields
    value = value / residual_scale / residual_scale
    gradient = gradient / residual_scale / residual_scale
    rounding = max(rounding / residual_scale / residual_scale, SMALLEST)
    return Evaluation(vector, value, gradient, rounding, iteration)


def _state(current, fields, template, residual_scale):
    """Return the state of a method from its fields in version 0.2 after the point."""
    if isinstance(template, DescentState):
        velocity, rate, share = fields  # the rate belonged to the gradient itself
        return DescentState(current, velocity, rate * template.gradient_unit, share, template.gradient_unit)
    if isinstance(template, NewtonState):
        radius, size = fields  # the radius was in the units of x
        return NewtonState(current, radius / template.length_unit, size, template.length_unit)
    if isinstance(template, SquaresState):
        damping, share = fields  # the damping belonged to the Jacobian itself
        unit = 1.0 if damping else 0.0
        return SquaresState(current, damping / residual_scale / residual_scale, share, unit)
    return type(template)(current, *fields)
