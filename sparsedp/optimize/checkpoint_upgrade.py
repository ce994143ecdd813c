"""Conversion of the states of `minimize` that version 0.2 wrote to the current format."""

from __future__ import annotations

from typing import Any

from sparsedp.optimize.first_order import DescentState
from sparsedp.optimize.least_squares import SquaresState
from sparsedp.optimize.newton_cg import NewtonState
from sparsedp.optimize.objective import SMALLEST
from sparsedp.optimize.result import Evaluation

__all__ = ["FORMAT_0_2", "upgraded"]

FORMAT_0_2 = "sparsedp optimization 4"
POINT_FIELDS = 5  # the first five fields of a state are those of its point, an Evaluation


def upgraded(
    state_fields: list[Any], best_fields: list[Any], template: Any, residual_scale: float | None
) -> tuple[Any, Evaluation]:
    """Return the state and the best point of a checkpoint that version 0.2 wrote.

    Parameters
    ----------
    state_fields, best_fields : list
        The numbers and arrays of the state and of the best point, as stored in the file.
    template : state of the method at the start
        Its type determines the method. The result has the units of this state.
    residual_scale : float or None
        The power of two by which residuals of least-squares problems are divided. Version 0.2 did not divide them.

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
    """Return a point with its loss and gradient, rescaled to residuals that are divided by `residual_scale`."""
    vector, value, gradient, rounding, iteration = fields
    value = value / residual_scale / residual_scale
    gradient = gradient / residual_scale / residual_scale
    rounding = max(rounding / residual_scale / residual_scale, SMALLEST)
    return Evaluation(vector, value, gradient, rounding, iteration)


def _state(current, fields, template, residual_scale):
    """Return the state of a method, given its point and the remaining fields as stored by version 0.2."""
    if isinstance(template, DescentState):
        velocity, rate, share = fields  # this rate multiplied the gradient without division by gradient_unit
        return DescentState(current, velocity, rate * template.gradient_unit, share, template.gradient_unit)
    if isinstance(template, NewtonState):
        radius, size = fields  # this radius was not divided by length_unit
        return NewtonState(current, radius / template.length_unit, size, template.length_unit)
    if isinstance(template, SquaresState):
        damping, share = fields  # this damping belonged to the Jacobian without division by unit
        unit = 1.0 if damping else 0.0
        return SquaresState(current, damping / residual_scale / residual_scale, share, unit)
    return type(template)(current, *fields)
