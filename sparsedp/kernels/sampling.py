"""Values of a field between its points: interpolation, its slopes, and the transposes of both.

The field is extended by two layers (linear) or three (cubic) beyond each end of each axis that is
there, so that nothing needs to be asked inside the loops. Point (i, j, k) looks at the place
(i - scale[0] w[0], j - scale[1] w[1], k - scale[2] w[2]), in units of points. Periodic axes wrap;
on others a place further out than the first layer has the value and slope of that layer.

Fields are flat float64 arrays in C order, w a sequence of one such array for each of three axes (any
for an axis that is not there). The arrays are not checked; NaN does no harm.
"""

import functools
from math import prod
from typing import Any, NamedTuple

import numpy as np

from sparsedp.kernels import compiled, sampling_plain
from sparsedp.kernels.unable import warn_unable

__all__ = ["Points", "advance", "extend", "extrema", "fold", "gather", "layers", "mean_of_equal", "scatter", "slopes"]
__all__ += ["finite", "miss", "retreat", "sides", "spread_to_equal", "way_back"]

NONE = np.empty(0)
LIKE = {1: (0.0,), 2: (0.0, 0.0), 4: (0.0,) * 4}  # their lengths tell the compiler how many weights there are


class Points(NamedTuple):
    """The points of a field and the samples they are extended to."""

    shape: tuple  # three lengths; axes that are not there come first, with length 1
    wraps: tuple  # for each axis, whether it is periodic
    like: tuple  # for each axis, a tuple as long as there are weights
    strides: tuple  # of the samples
    corner: int  # the first point among the samples
    size: int  # how many samples there are
    targets: Any  # samples that are filled in, and
    sources: Any  # the point they come from, or points + number of a value from outside


def layers(width):
    """Layers that an axis of so many weights is extended by, on each side."""
    return {1: 0, 2: 2, 4: 3}[width]


def finite(values):
    """Whether no number of a flat float64 array is NaN or infinite."""
    return bool(_loop("finite")(values))


@functools.cache
def _loop(name, like=()):
    """The function that does the work; imports numba where it is installed."""
    if compiled():
        try:
            from sparsedp.kernels import sampling_native

            return sampling_native.kernel(name, like)
        except Exception as error:  # whatever LLVM or numba object to on this machine
            warn_unable(error, 4)
    return getattr(sampling_plain, name)


def _looked_up(points, w, scale):
    """Arguments of a pass over the places, in the order of the loops."""
    shape = points.shape
    return w, scale, shape, points.strides, points.wraps, points.like, 0, shape[0] * shape[1]


def extend(points, u, outside):
    """Field, values from outside -> samples."""
    samples = np.empty(points.size)
    rest = points.shape, points.strides, points.corner, points.targets, points.sources
    _loop("extend")(u, outside, *rest, samples)
    return samples


def fold(points, samples, u, outside, fresh=False):
    """The transpose of `extend`, added to u and outside (which may be empty), or written there when they are fresh."""
    _loop("fold")(u, outside, *points[:1], *points[3:5], *points[6:], samples, fresh)


def gather(points, samples, w, scale, out):
    """Interpolated values at all places -> out."""
    _loop("gather", points.like)(samples, *_looked_up(points, w, scale), out)
    return out


def scatter(points, g, w, scale):
    """The transpose of `gather` -> samples."""
    samples = np.zeros(points.size)
    _loop("scatter", points.like)(samples, *_looked_up(points, w, scale), g)
    return samples


def slopes(points, samples, w, scale, g, out):
    """out[axis] += g * (derivative of `gather` in w[axis]), for the axes that are there."""
    _loop("slopes", points.like)(samples, *_looked_up(points, w, scale), g, out)


def extrema(points, samples, w, scale):
    """Least and greatest sample of the cell around each place."""
    low, high = np.empty((2, prod(points.shape)))
    _loop("extrema", points.like)(samples, *_looked_up(points, w, scale), low, high)
    return low, high


def mean_of_equal(points, samples, bound, changes, w, scale):
    """Mean of the changes of those samples around each place that equal the bound."""
    out = np.empty_like(bound)
    rest = _looked_up(points, w, scale)
    _loop("mean_of_equal", points.like)(samples, bound, changes, *rest, out)
    return out


def spread_to_equal(points, samples, bound, changes, w, scale, g):
    """The transpose of `mean_of_equal`, added to the changes."""
    rest = _looked_up(points, w, scale)
    _loop("spread_to_equal", points.like)(samples, bound, changes, *rest, g)


def advance(points, u, outside, w, scale, out):
    """Field and values outside -> out, moved in one go; whether all that it came from is finite."""
    shape, wraps, like, strides, corner, size, targets, sources = points
    ghosts = shape, strides, corner, targets, sources
    return _loop("advance", like)(u, outside, *ghosts, np.empty(size), w, scale, wraps, like, out)


def retreat(points, u, outside, w, scale, g, field, aside, speeds, fresh, room=np.empty):
    """The transpose of `advance` and the slopes: added to field and aside, and to speeds; what is empty is left out.

    What is fresh, (field and aside, speeds), is written instead. Returns what speeds gained, times w, in total.
    room: size -> an array, for the samples and their cotangents.
    """
    shape, wraps, like, strides, corner, size, targets, sources = points
    ghosts, places = (shape, strides, corner, targets, sources), (w, scale, wraps, like)
    samples, back = room(size) if speeds[2].size else NONE, room(size) if field.size else NONE
    return _loop("retreat", like)(u, outside, *ghosts, samples, places, g, back, field, aside, speeds, fresh)


def sides(points, samples, w, scale):
    """Interpolated values at all places, and the least and greatest sample of the cell around each."""
    out, low, high = np.empty(w[0].size), np.empty(w[0].size), np.empty(w[0].size)
    _loop("sides", points.like)(samples, *_looked_up(points, w, scale), out, low, high)
    return out, low, high


def way_back(points, samples, look, g, shares, speeds, fresh):
    """`scatter` of g -> samples; `slopes` added to speeds, or written when fresh; their product with w, in total.

    shares, if any: two arrays that go to the least and to the greatest sample of each cell. speeds may be empty.
    """
    back, (low, high) = np.zeros(points.size), shares or (NONE, NONE)
    rest = _looked_up(points, *look)
    return back, _loop("way_back", points.like)(samples, *rest, g, back, low, high, speeds, fresh)


def miss(points, samples, look, found, u, g, bounds, speeds):
    """The look ahead of MacCormack's way back.

    found: f, at the places of the first look; samples: those of f. bounds: least and greatest value, or nothing; they
    are overwritten by the parts of g that belong to them. What is left of g is own; -own / 2 goes back to the samples
    and gives the slopes, written to speeds, which may be empty.

    Returns
    -------
    own, samples, product of speeds and w
    """
    own, back, (low, high) = np.empty(g.size), np.zeros(points.size), bounds or (NONE, NONE)
    rest = _looked_up(points, *look)
    return own, back, _loop("miss", points.like)(samples, *rest, found, u, g, own, back, low, high, speeds)
