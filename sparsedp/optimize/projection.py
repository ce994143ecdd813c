"""The option project= of minimize: an affine projection of the unknowns."""

import numpy as np

from sparsedp._utils.pytree import flatten, norm, paired
from sparsedp.autodiff.derivative import vjp

__all__ = ["Projection"]

FAR = 2.0**20  # length of the longest test direction, in units of the start
ACCURACY = 1e-6  # relative difference from an affine map that a projection by an iterative solve may have
NOT_AFFINE = (
    "project must be a projection onto a linear or affine space, but {}; with other maps a search may stop where the "
    "loss has no minimum. Write bounds=(lower, upper) to keep x in a box"
)


class Projection:
    """A map P of trees like start, with P(P(x)) = P(x), affine: P(a x + (1 - a) y) = a P(x) + (1 - a) P(y).

    The loss of P(x) then is smooth where the loss is, its gradient is P^T times that of the loss, and where it is 0 the
    point P(x) is stationary among all points of the range of P. Of other maps, such as np.clip, this is not so.

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
        If it is not affine or not idempotent at a few test points.
    """

    def __init__(self, function, packing, start):
        self._function, self._packing = function, packing
        self._origin = packing.pack(start)
        self._image = self._at(self._origin)
        size = norm(self._origin) / np.sqrt(self._origin.size) or 1.0
        direction = size * np.random.default_rng(0).standard_normal(self._origin.size)
        near = self._at(self._origin + direction)
        for factor in (FAR, -FAR):
            far, predicted = self._at(self._origin + factor * direction), self._image + factor * (near - self._image)
            self._compare(far, predicted, norm(factor * direction), "it is not affine near the start")
        self._compare(self._at(near), near, norm(near), "project(project(x)) is not project(x)")

    def result(self, vector):
        """Return P of a flat point as a tree; refuse what is not affine between the start and there."""
        middle, image = self._at(self._origin + 0.5 * (vector - self._origin)), self._at(vector)
        self._compare(
            middle, self._image + 0.5 * (image - self._image), norm(vector), "it is not affine near the result"
        )
        return self._tree(self._packing.unpack(vector))

    def loss(self, loss):
        """Return the function x, *rest -> loss(P(x), *rest)."""
        return lambda x, *rest: loss(self._function(x), *rest)

    def gradient(self, gradient):
        """Return the gradient of `loss`, given that of the user's loss."""

        def composed(x, *rest):
            image, pull = vjp(self._function, x)
            return pull(gradient(image, *rest))

        return composed

    def _tree(self, x):
        entries = paired(self._function(x), x, "project(x)", advice="; return a tree like start", shapes=True)
        return flatten(x)[1](entries)

    def _at(self, vector):
        return self._packing.pack(self._tree(self._packing.unpack(vector)))

    def _compare(self, values, predicted, size, reason):
        accuracy = max(ACCURACY, 1e3 * self._packing.eps)
        if not norm(values - predicted) <= accuracy * max(size, norm(predicted), norm(self._origin)):
            raise ValueError(NOT_AFFINE.format(reason))
