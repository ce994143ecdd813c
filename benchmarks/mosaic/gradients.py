"""Gradients as Mosaic measures them, and how long they keep a meaning in a flow.

Mosaic takes the loss sum(result^2), a few random directions of length 1, and central differences with steps relative to
the root mean square of the input. Its figure is the cosine between the two lists of directional derivatives.
"""

from dataclasses import dataclass

import autograd.numpy as np

import sparsedp as dp

__all__ = ["Agreement", "agreement", "growth", "squares"]

TINY = 1e-30  # in place of a divisor 0


@dataclass
class Agreement:
    """How a gradient agrees with central differences.

    Attributes
    ----------
    cosine : float
        Of the directional derivatives by the gradient and by differences, with the best of the steps.
    error : float
        The median of the relative differences of the derivatives, with the best of the steps.
    step : float
        The step with the least error, relative to the root mean square of the input.
    norm : float
        Of the gradient.
    """

    cosine: float
    error: float
    step: float
    norm: float


def squares(function):
    """Return the loss sum(function(x)^2)."""
    return lambda x: np.sum(function(x) ** 2)


def agreement(loss, x, steps=(1.0, 1e-1, 1e-2, 1e-3), directions=6, seed=0):
    """Compare the gradient of a loss at x with central differences."""
    gradient = dp.grad(loss)(x)
    scale = np.sqrt(np.mean(x**2))
    rng = np.random.default_rng(seed)
    along = [direction / np.linalg.norm(direction) for direction in rng.standard_normal((directions, *x.shape))]
    by_gradient = np.array([np.sum(gradient * direction) for direction in along])
    rows = []
    for step in steps:
        h = step * scale
        found = np.array([(loss(x + h * direction) - loss(x - h * direction)) / (2.0 * h) for direction in along])
        sizes = np.maximum(np.maximum(np.abs(found), np.abs(by_gradient)), TINY)
        cosine = found @ by_gradient / max(np.linalg.norm(found) * np.linalg.norm(by_gradient), TINY)
        rows.append((float(np.median(np.abs(found - by_gradient) / sizes)), float(cosine), step))
    error, cosine, step = min(rows)
    return Agreement(cosine, error, step, float(np.linalg.norm(gradient)))


def growth(flow, v, numbers, seed=0):
    """Return by how much a small random change of the velocity has grown after each of the numbers of steps."""

    def after(v):
        state = flow.step.start(flow.to_faces(v))
        return dp.rollout(flow.step, state, None, numbers[-1], keep=list(numbers))["v"]

    direction = np.random.default_rng(seed).standard_normal(v.shape)
    _, change = dp.jvp(after, v, direction)
    first = np.linalg.norm(dp.projection(flow.grid)(flow.to_faces(direction)))
    return np.linalg.norm(change, axis=1) / first
