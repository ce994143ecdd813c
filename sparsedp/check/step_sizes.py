"""Step sizes of the finite differences in an audit of a gradient."""

from __future__ import annotations

from math import inf
from typing import Any

import numpy as np

__all__ = ["COARSER_STEPS", "FINER_STEPS", "RIPPLE_STEPS", "STEPS_BETWEEN", "checked_steps", "default_steps"]

FEWEST_STEPS = 8  # of a sweep

# Steps that extend the default sweep.
COARSER_STEPS = tuple(2.0**k for k in range(1, 38, 3))  # if rounding errors hide the derivative
FINER_STEPS = tuple(2.0**-k for k in range(33, 46, 3))  # if other noise hides it: there may be finer features
STEPS_BETWEEN = 2.0 ** np.arange(-9, 7)  # multiples of the step of the plateau, for Taylor orders
RIPPLE_STEPS = 2.0 ** -np.arange(27, 46)  # fine steps at which a ripple is visible


def default_steps(eps: float) -> tuple[float, ...]:
    """Return the step sizes of an audit in units of x, over at least eight decades, from coarse to fine.

    The steps are powers of two, so that x + step * d has small rounding errors. Single precision has fewer usable
    decades, and the steps are closer together.
    """
    if eps < 1e-10:
        exponents = range(2, 31, 3)
    else:
        exponents = range(-2, 27, 2)
    return tuple(2.0**-exponent for exponent in exponents)


def checked_steps(steps: Any) -> tuple[float, ...]:
    """Return the steps that a caller gives for a sweep, or an empty tuple for None.

    Raises
    ------
    ValueError
        If there are too few steps, or if one of them is not a positive number.
    """
    if steps is None:
        return ()
    try:
        chosen = tuple(map(float, np.ravel(steps)))
    except (TypeError, ValueError):
        chosen = ()
    if len(set(chosen)) < FEWEST_STEPS or not all(0 < step < inf for step in chosen):
        raise ValueError(
            f"a sweep needs at least {FEWEST_STEPS} different positive steps, got {steps!r}; omit steps, or write "
            "steps=np.logspace(-1, -8, 8)"
        )
    return chosen
