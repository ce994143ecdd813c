"""The argument `project` of `minimize`: an affine projection of the unknowns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.pytree import flatten, norm, paired
from sparsedp.autodiff.derivative import vjp

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from sparsedp.autodiff.flattening import Packing

__all__ = ["Projection"]

TEST_LENGTH = 2.0**20  # length of the longest test direction, relative to the start
ACCURACY = 1e-6  # tolerated relative deviation from an affine map, because the projection may use iterative solves
NOT_AFFINE = (
    "project must be a projection onto a linear or affine space, but {}; with other maps a search may stop where the "
    "loss has no minimum. Write bounds=(lower, upper) to keep x in a box"
)


class Projection:
    """An affine projection P, that is, P(a x + (1 - a) y) = a P(x) + (1 - a) P(y) and P(P(x)) = P(x).

    Parameters
    ----------
    function : callable
    packing : Packing
    start : tree

    Raises
    ------
    ShapeError
        If the function does not return a tree like start.
    ValueError
        If the function is not affine or not idempotent at a few test points.

    Notes
    -----
    loss(P(x)) is as smooth as the loss, and its gradient with respect to x is the transpose of the linear part of P
    times the gradient of the loss at P(x). If this gradient is 0, then P(x) is a stationary point of the loss in the
    range of P. For other maps, such as np.clip, this is not true.
    """

    def __init__(self, function: Callable[[Any], Any], packing: Packing, start: Any):
        self._function = function
        self._packing = packing
        self._start = packing.pack(start)
        self._start_image = self._image(self._start)
        size = norm(self._start) / np.sqrt(self._start.size) or 1.0
        direction = size * np.random.default_rng(0).standard_normal(self._start.size)
        near = self._image(self._start + direction)
        for factor in (TEST_LENGTH, -TEST_LENGTH):
            far = self._image(self._start + factor * direction)
            predicted = self._start_image + factor * (near - self._start_image)
            self._compare(far, predicted, norm(factor * direction), "it is not affine near the start")
        self._compare(self._image(near), near, norm(near), "project(project(x)) is not project(x)")

    def result(self, vector: NDArray[np.float64]) -> Any:
        """Return P(x) as a tree, given x as a flat vector.

        Raises
        ------
        ValueError
            If P is not affine between the start and this point.
        """
        middle = self._image(self._start + 0.5 * (vector - self._start))
        image = self._image(vector)
        predicted = self._start_image + 0.5 * (image - self._start_image)
        self._compare(middle, predicted, norm(vector), "it is not affine near the result")
        return self._projected(self._packing.unpack(vector))

    def loss(self, loss: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function loss(P(x)), given the user's loss."""

        def loss_of_projection(x, *batch):
            return loss(self._function(x), *batch)

        return loss_of_projection

    def gradient(self, gradient: Callable[..., Any]) -> Callable[..., Any]:
        """Return the gradient of loss(P(x)), given the gradient of the user's loss."""

        def gradient_of_projection(x, *batch):
            image, pull = vjp(self._function, x)
            return pull(gradient(image, *batch))

        return gradient_of_projection

    def _projected(self, x):
        """Return P(x) for a tree x, with dict entries in the same order as in x."""
        entries = paired(self._function(x), x, "project(x)", advice="; return a tree like start", shapes=True)
        return flatten(x)[1](entries)

    def _image(self, vector):
        """Return P(x) as a flat vector, given x as a flat vector."""
        return self._packing.pack(self._projected(self._packing.unpack(vector)))

    def _compare(self, values, predicted, size, reason):
        """Raise ValueError with the given reason if two flat vectors differ by more than the tolerance."""
        accuracy = max(ACCURACY, 1e3 * self._packing.eps)
        if not norm(values - predicted) <= accuracy * max(size, norm(predicted), norm(self._start)):
            raise ValueError(NOT_AFFINE.format(reason))
