"""Where a derivative is wrong: the entries with the largest gaps, in grid coordinates where a grid is known.

The gap along a direction d is e . d with the error e of the derivative, so it is linear in d. With random weights on
the entries of a block it is about as large as the part of e in the block. Bisection along one axis after the other
finds an entry with a large gap in about log2(n) measurements.
"""

from contextlib import suppress
from math import inf
from typing import Any, NamedTuple

import numpy as np

from sparsedp._utils.counters import recording
from sparsedp.check.evaluations import REFUSALS, UNCHANGED, Line
from sparsedp.grid.grid import node_axes

__all__ = [
    "MOST_ENTRIES",
    "EntryGap",
    "DEFAULT_STEP",
    "gaps_along_entries",
    "largest_gaps",
    "listed",
    "spaces_of",
    "subscript",
    "where",
]

MOST_ENTRIES = 3  # that are named
NEGLIGIBLE = 0.05  # a part of a gap below this share is none
REMAINDER = 0.01  # of the largest gap found: no further entry is sought where all others are below
DEFAULT_STEP = 2.0**-11  # where no step of the sweep has shown a derivative
CLEAR = 4.0  # a gap has to be this many times the noise of its measurement


class EntryGap(NamedTuple):
    """A block of entries, usually a single one, where a derivative is wrong.

    Attributes
    ----------
    leaf : int
    block : tuple of slice
    gap : float
        Right derivative less the given one, in units of the leaf; NaN where the block is no single entry.
    region : tuple of slice or None
        A larger block that holds the whole gap of the leaf, such as all cells at one wall.
    """

    leaf: int
    block: tuple
    gap: float
    region: Any = None


class _NotMeasured(Exception):
    """The loss has no value that is needed."""


def largest_gaps(gap_along, shapes, most=MOST_ENTRIES, noise=0.0):
    """Find entries with large gaps.

    Parameters
    ----------
    gap_along : callable
        ``gap_along(weights)``, linear in a list of arrays of these shapes.
    shapes : list of tuple
    most : int
        Entries that are sought.
    noise : float
        A gap below it is none.

    Returns
    -------
    list of EntryGap
        The largest gap first.
    """
    search = _Search(gap_along, shapes, noise)
    found: list[EntryGap] = []
    with suppress(_NotMeasured):
        total = search.total()
        while len(found) < most and abs(total) > max(REMAINDER * search.largest, noise):
            entry = search.next(total)
            if entry is None:
                break
            found.append(entry)
            total = search.total() if len(found) < most else 0.0
    return sorted(found, key=lambda one: -abs(one.gap) if one.gap == one.gap else inf)


class _Search:
    """Bisection for entries with large gaps; entries that were found are excluded from later searches."""

    def __init__(self, gap_along, shapes, noise):
        rng = np.random.default_rng(0)
        self.gap_along, self.shapes, self.noise = gap_along, shapes, noise
        self.weights = [np.array(rng.choice([-1.0, 1.0], s) * rng.uniform(0.5, 1.5, s)) for s in shapes]
        self.largest = 0.0

    def total(self):
        """Gap of all entries that have not been found yet."""
        return self.gap_along(self.weights)

    def block_gap(self, leaf, block):
        """Gap of a block of one leaf."""
        weights = [np.zeros(shape) for shape in self.shapes]
        weights[leaf][block] = self.weights[leaf][block]
        return self.gap_along(weights)

    def leaves_gap(self, low, high):
        """Gap of some leaves."""
        return self.gap_along(
            [weight if low <= leaf < high else np.zeros_like(weight) for leaf, weight in enumerate(self.weights)]
        )

    def next(self, total):
        """Find one entry, given the gap of all entries not found yet, and exclude it from later searches.

        Return None where noise leads to an entry that was found before.
        """
        leaf, _, gap, _ = self._bisect(len(self.shapes), self.leaves_gap, total)
        block = [slice(None)] * len(self.shapes[leaf])
        of_leaf, certain = gap, []  # axes along which the gap lies at one place
        for axis, length in enumerate(self.shapes[leaf]):

            def part(low, high, axis=axis):
                return self.block_gap(leaf, (*block[:axis], slice(low, high), *block[axis + 1 :]))

            low, high, gap, beside = self._bisect(length, part, gap)
            block[axis] = slice(low, high)
            if beside <= NEGLIGIBLE * abs(gap):
                certain.append(axis)
        self.largest = max(self.largest, abs(gap))
        region = self._region(leaf, block, certain, of_leaf)
        weight = self.weights[leaf][tuple(block)]
        if not np.any(weight):
            return None
        single = np.size(weight) == 1
        value = gap / float(np.reshape(weight, -1)[0]) if single else np.nan
        self.weights[leaf][tuple(block) if region is None else region] = 0.0
        return EntryGap(leaf, tuple(block), value, region)

    def _region(self, leaf, block, certain, of_leaf):
        """The block of all entries that share the place along the certain axes, if it holds the whole gap."""
        if not 0 < len(certain) < len(block):
            return None
        region = tuple(part if axis in certain else slice(None) for axis, part in enumerate(block))
        gap = self.block_gap(leaf, region)
        return region if abs(of_leaf - gap) <= NEGLIGIBLE * abs(of_leaf) else None

    def _bisect(self, length, gap_of, gap):
        """Halve a range again and again, and keep the half with the larger gap.

        Returns
        -------
        (low, high, gap between them, root of the sum of squares of the gaps of all other halves)
        """
        low, high, beside = 0, length, 0.0
        while high - low > 1 and abs(gap) > self.noise:
            middle = (low + high) // 2
            first = gap_of(low, middle)
            second = gap - first
            if abs(first) >= abs(second):
                high, gap, other = middle, first, second
            else:
                low, gap, other = middle, second, first
            beside = float(np.hypot(beside, other))
        return low, high, gap, beside


def gaps_along_entries(evaluations, judged, most=MOST_ENTRIES):
    """Entries where differences and gradient are far apart, by the judgement of the worst direction.

    Returns
    -------
    list of EntryGap
        Gaps are those of derivatives of the loss; empty where nothing can be told.
    """
    point = evaluations.point
    wrong = [one for one in judged if one.word in ("disagrees", "outside")]
    if point.entries < 2 or not wrong:
        return []
    worst = max(wrong, key=lambda one: one.share if one.share == one.share else 0.0)
    step = worst.step if worst.step > 0 else DEFAULT_STEP
    jitter = worst.jitter if worst.jitter > 0 else 0.0
    noise = CLEAR * max(2.0, jitter) * evaluations.eps * abs(evaluations.base) / step

    def gap_along(weights):
        parts = [w * (1 + 1j) if np.iscomplexobj(x) else w for w, x in zip(weights, point.values, strict=True)]
        direction = point.units * np.concatenate([np.ravel(part).view(float) for part in parts])
        if not np.any(direction):
            return 0.0
        level = Line("entries", direction, evaluations).level(step)
        if level.note and level.note != UNCHANGED:
            raise _NotMeasured(level.note)
        return level.difference - level.slope

    found = largest_gaps(gap_along, [x.shape for x in point.values], most, noise)
    units = [float(part[0]) if part.size else 1.0 for part in point.split(point.units)]
    return [one._replace(gap=one.gap / units[one.leaf]) for one in found]


# ------------------------------------------------------------ in words


def spaces_of(function, x):
    """Spaces on a grid of the Operators that a function applies at a point."""
    spaces: dict[str, Any] = {}
    with suppress(*REFUSALS), recording() as calls, np.errstate(all="ignore"):
        function(x)
        for actors in calls.actors.values():
            for actor in actors.values():
                for name in ("domain", "codomain"):
                    space: Any = getattr(actor, name, None)
                    if getattr(space, "grid", None) is not None and space.backend.whole_fields:
                        spaces.setdefault(str(space), space)
    return list(spaces.values())


def listed(found, point, gradient, spaces, source="the gradient"):
    """Sentences about gaps: the entries with both derivatives, and the region that holds all of a gap.

    Parameters
    ----------
    found : list of EntryGap
    point : Point
    gradient : vector or None
        That was given at the point.
    spaces : list of Space
    source : str
        What gave it.
    """
    slopes = [None] * len(point.values) if gradient is None else point.split(gradient)
    sentences = []
    for one in found:
        name, x, slope = point.names[one.leaf], point.values[one.leaf], slopes[one.leaf]
        words = f"{name}{subscript(one.block, x.shape)}{where(one.block, x.shape, spaces)}"
        if one.gap == one.gap and slope is not None and not np.iscomplexobj(x):
            given = float(np.reshape(slope, x.shape)[one.block].reshape(-1)[0])
            digits = _digits(one.gap, given)
            words += f": {given + one.gap:.{digits}g} by differences, {given:.{digits}g} by {source}"
        if one.region is not None:
            place = where(one.region, x.shape, spaces)
            words += f" (all of the gap in {name} lies in {name}{subscript(one.region, x.shape)}{place})"
        sentences.append(words)
    return sentences


def _digits(gap, given):
    """Digits in which two numbers differ, and two more."""
    share = abs(gap) / (abs(given) or abs(gap) or 1.0)
    return int(np.clip(3 - np.floor(np.log10(share or 1.0)), 4, 16))


def subscript(index, shape):
    """A block as one would write it."""
    parts = []
    for part, length in zip(index, shape, strict=True):
        low, high, _ = part.indices(length)
        if (low, high) == (0, length) and length > 1:
            parts.append(":")
        elif high - low == 1:
            parts.append(f"{low}")
        else:
            parts.append(f"{low}:{high}")
    return f"[{', '.join(parts)}]" if parts else ""


def where(index, shape, spaces):
    """A block of a field on the grid of one of some spaces, in words: at which walls, or at which coordinates."""
    for space in spaces:
        dim = len(space.shape)
        if dim and shape[len(shape) - dim :] == space.shape:
            words = _place(space, index[len(index) - dim :])
            return f", {words}" if words else ""
    return ""


def _place(space, block):
    """Return in words where a block of a field on a space lies; empty if it cannot be said."""
    grid = space.grid
    prefix = ""
    component = 0
    if space.kind in ("faces", "edges"):
        low, high, _ = block[0].indices(space.size)
        if high - low != 1:
            return ""
        component = int(np.searchsorted(space.offsets, low, side="right")) - 1
        index = np.unravel_index(low - space.offsets[component], space.parts[component])
        block = tuple(slice(int(k), int(k) + 1) for k in index)
        prefix = f"{grid.axes[component]}-{space.kind[:-1]} {tuple(map(int, index))} "
    elif "-" in space.kind:
        component = grid.axes.index(space.kind[0])
    if len(block) != grid.dim:
        return ""
    kind = space.kind.split("-")[-1]
    on_nodes = node_axes(kind, component, grid.dim)
    if on_nodes is None:
        return ""
    walls = []
    coordinates = []
    for axis, part in enumerate(block):
        places = grid.coordinates(axis, "nodes" if axis in on_nodes else "cells")
        low, high, _ = part.indices(len(places))
        name = grid.axes[axis]
        if high - low != 1:
            continue
        if low in (0, len(places) - 1) and not grid.periodic[axis] and len(places) > 1:
            walls.append(f"the {'upper' if low else 'lower'} {name} wall")
        else:
            coordinates.append(f"{name} = {places[low]:.4g}")
    if walls:
        return f"{prefix}at {' and '.join(walls)}"
    if coordinates:
        return f"{prefix}at {', '.join(coordinates)}"
    return prefix
