"""Find the entries in which a derivative is wrong, and name them by grid coordinates if a grid is known.

Let e be the error of the derivative. The gap along a direction d is e . d, which is linear in d. If d has random
weights in the entries of a block and zeros elsewhere, the gap is about as large as the norm of e in the block.
Bisection along one axis after the other therefore finds an entry with a large gap in about log2(n) measurements.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from math import inf, isinf, isnan, nan
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sparsedp._utils.counters import recording
from sparsedp.check.direction_evidence import WRONG_WORDS, DirectionEvidence
from sparsedp.check.evaluations import EVALUATION_ERRORS, Evaluations, Line
from sparsedp.check.point import Point
from sparsedp.grid.grid import node_axes

__all__ = [
    "DEFAULT_STEP",
    "EVERY_ENTRY",
    "MOST_ENTRIES",
    "EntryGap",
    "gaps_along_entries",
    "largest_gaps",
    "listed",
    "spaces_of",
    "subscript",
    "where",
]

MOST_ENTRIES = 3  # default number of entries that are searched for
NEGLIGIBLE_SHARE = 0.05  # a part of a gap below this share counts as 0
REMAINDER_SHARE = 0.01  # the search stops when the other entries together have less than this share of the largest gap
SLAB_PARTS = 4  # a region is divided into this number of parts, each of which must have a gap
NOISE_RATIO = 3.0  # a gap that was measured along a direction exceeds the noise by this factor
FACTOR_DIRECTIONS = 3  # a common factor of all entries is measured along this number of directions
FACTOR_SHARE = 0.02  # it may differ between them by this share of its distances from 0 and 1
ZERO_SHARE = 1e-12  # a derivative below this share of another one counts as 0: terms that cancel leave rounding errors
SMALL_NOISE_SHARE = 1e-3  # a noise below this share of a gap does not matter
EVERY_ENTRY = "every entry of "  # begins a sentence about a leaf
DEFAULT_STEP = 2.0**-11  # used if the sweep found no plateau
CLEAR_OF_NOISE = 4.0  # a gap has to be this many times the noise of its measurement

Block = tuple[slice, ...]


class EntryGap(NamedTuple):
    """A block of entries in which a derivative is wrong. It is usually a single entry.

    Attributes
    ----------
    leaf : int
        Number of the leaf.
    block : tuple of slice
        Position in the leaf.
    gap : float
        Finite difference minus the derivative under test; NaN if the block is not a single entry.
    region : tuple of slice or None
        A larger block of wrong entries, such as all cells at one wall.
    is_whole : bool
        Whether the region contains the whole gap of the leaf.
    factor : float
        The derivative under test divided by the right one, if this ratio is the same for all entries of the region; NaN
        if it is not, or if it was not measured.
    """

    leaf: int
    block: Block
    gap: float
    region: Block | None = None
    is_whole: bool = True
    factor: float = nan

    @property
    def sort_key(self) -> float:
        """Sort key: leaves and regions first, then the largest gap; blocks with unknown gaps (NaN) come last."""
        if isnan(self.gap) and self.region is not None:
            return -inf
        if isnan(self.gap):
            return inf
        return -abs(self.gap)


class _NotMeasured(Exception):
    """A gap could not be measured, because the loss has no value at a point of the difference."""


def largest_gaps(
    gap_along: Callable[[Sequence[NDArray[Any]]], float],
    shapes: Sequence[tuple[int, ...]],
    most: int = MOST_ENTRIES,
    noise: float = 0.0,
    slope_along: Callable[[Sequence[NDArray[Any]]], float] | None = None,
) -> list[EntryGap]:
    """Find entries with large gaps, and the regions of wrong entries around them.

    Parameters
    ----------
    gap_along : callable
        ``gap_along(weights)`` returns the gap along a direction, given as a list of arrays. It is linear in `weights`.
    shapes : list of tuple
        Shapes of the arrays.
    most : int
        Largest number of entries to find.
    noise : float
        A gap below this value counts as 0.
    slope_along : callable, optional
        ``slope_along(weights)`` returns the derivative under test along a direction. If it is given, the factor by
        which all entries of a leaf or region are wrong is measured.

    Returns
    -------
    list of EntryGap
        The largest gap first.
    """
    search = _Search(gap_along, shapes, noise, slope_along)
    entries: list[EntryGap] = []
    with suppress(_NotMeasured):
        while len(entries) < most:
            total = search.total()
            if not abs(total) > max(REMAINDER_SHARE * search.largest, noise):
                break
            entry = search.next(total)
            if entry is None:
                break
            entries.append(entry)
    return sorted(entries, key=lambda entry: entry.sort_key)


class _Bisection(NamedTuple):
    """The result of a bisection.

    Attributes
    ----------
    low, high : int
        The range to which the gap was narrowed down.
    gap : float
        The gap in this range.
    beside : float
        Root of the sum of squares of the gaps of all discarded halves.
    """

    low: int
    high: int
    gap: float
    beside: float


class _Search:
    """Bisection for entries with large gaps; entries that were found are excluded from later searches."""

    def __init__(
        self,
        gap_along: Callable[[Sequence[NDArray[Any]]], float],
        shapes: Sequence[tuple[int, ...]],
        noise: float,
        slope_along: Callable[[Sequence[NDArray[Any]]], float] | None = None,
    ) -> None:
        rng = np.random.default_rng(0)
        self.rng = rng
        self.slope_along = slope_along
        self.gap_along = gap_along
        self.shapes = shapes
        self.noise = noise
        self.largest = 0.0
        self.weights = []
        for shape in shapes:
            signs = rng.choice([-1.0, 1.0], shape)
            self.weights.append(np.array(signs * rng.uniform(0.5, 1.5, shape)))

    def total(self) -> float:
        """Return the gap of all entries that have not been found yet."""
        return self.gap_along(self.weights)

    def block_weights(self, leaf: int, block: Block) -> list[NDArray[Any]]:
        """Return the weights of the entries in a block of one leaf, and zeros for all others."""
        weights = [np.zeros(shape) for shape in self.shapes]
        weights[leaf][block] = self.weights[leaf][block]
        return weights

    def block_gap(self, leaf: int, block: Block) -> float:
        """Return the gap of a block of one leaf."""
        return self.gap_along(self.block_weights(leaf, block))

    def factor(self, leaf: int, block: Block) -> float:
        """Return the derivative under test divided by the right one if it is the same in all entries of a block.

        The ratio is measured along three directions. It is NaN if they differ.
        """
        if self.slope_along is None:
            return nan
        weights = self.block_weights(leaf, block)
        entries = np.flatnonzero(weights[leaf])
        if entries.size < 2:
            return nan
        factors: list[float] = []
        for number in range(FACTOR_DIRECTIONS):
            gap = self.gap_along(weights)
            slope = self.slope_along(weights)
            factors.append(self._ratio(slope, slope + gap))
            if not all(_is_same_error(factors[0], factor) for factor in factors):  # NaN is not equal to itself
                return nan
            if number + 1 < FACTOR_DIRECTIONS:
                signs = self.rng.choice([-1.0, 1.0], entries.size) * self.rng.uniform(0.2, 1.8, entries.size)
                weights = [weight.copy() for weight in weights]
                weights[leaf].reshape(-1)[entries] = signs
        return float(np.median(factors))

    def _ratio(self, slope: float, difference: float) -> float:
        """Return the derivative under test divided by that by differences.

        It is 0 or infinite if one of them is 0 up to rounding or noise. It is NaN if noise hides both of them or the
        gap between them.
        """
        if abs(difference - slope) <= min(self.noise, FACTOR_SHARE * abs(slope)):
            return nan
        if abs(difference) <= max(self.noise, ZERO_SHARE * abs(slope)):
            return inf if abs(slope) > NOISE_RATIO * self.noise else nan
        if abs(slope) <= ZERO_SHARE * abs(difference):
            return 0.0
        return slope / difference

    def leaves_gap(self, low: int, high: int) -> float:
        """Return the gap of the leaves low, ..., high - 1."""
        weights = [np.zeros(shape) for shape in self.shapes]
        weights[low:high] = self.weights[low:high]
        return self.gap_along(weights)

    def next(self, total: float) -> EntryGap | None:
        """Find one entry, given the gap of all entries not found yet, and exclude it from later searches.

        Return None if noise has led the bisection to an entry that was found before.
        """
        leaf, _, gap_of_leaf, _ = self._bisect(len(self.shapes), self.leaves_gap, total)
        gap = gap_of_leaf
        everything = tuple(slice(None) for _ in self.shapes[leaf])
        factor = nan
        if np.all(self.weights[leaf]):
            factor = self.factor(leaf, everything)
        visible = max(NEGLIGIBLE_SHARE * REMAINDER_SHARE * abs(gap), self.noise)
        if not isnan(factor) and all(abs(part) > visible for part in self._part_gaps(leaf, everything)):
            self.largest = max(self.largest, abs(gap))
            self.weights[leaf][everything] = 0.0
            return EntryGap(leaf, everything, nan, everything, True, factor)
        block = [slice(None)] * len(self.shapes[leaf])
        certain_axes = []  # axes along which the gap is concentrated at one position
        for axis, length in enumerate(self.shapes[leaf]):

            def gap_between(low: int, high: int, axis: int = axis) -> float:
                return self.block_gap(leaf, (*block[:axis], slice(low, high), *block[axis + 1 :]))

            low, high, gap, beside = self._bisect(length, gap_between, gap)
            block[axis] = slice(low, high)
            if beside <= NEGLIGIBLE_SHARE * abs(gap):
                certain_axes.append(axis)
        self.largest = max(self.largest, abs(gap))
        weight = self.weights[leaf][tuple(block)]
        if not np.any(weight):
            return None
        region = self._region(leaf, block, certain_axes, gap_of_leaf)
        is_whole = region is not None and bool(np.all(self.weights[leaf]))  # no other gap was found in this leaf before
        if region is not None and not is_whole:
            visible = max(NEGLIGIBLE_SHARE * abs(gap), self.noise)
            if not all(abs(part) > visible for part in self._part_gaps(leaf, region)):
                region = None
        if region is None and len(certain_axes) < len(block):
            region = self._slab(leaf, block, gap)
        value = np.nan
        if np.size(weight) == 1:
            value = gap / float(np.reshape(weight, -1)[0])
        if region is not None:
            factor = self.factor(leaf, region)
        self.weights[leaf][tuple(block) if region is None else region] = 0.0
        return EntryGap(leaf, tuple(block), value, region, is_whole, factor)

    def _slab(self, leaf: int, block: list[slice], gap: float) -> Block | None:
        """Return the block of all entries at the same position along one axis, if the gap is in all parts of it."""
        for axis, length in enumerate(self.shapes[leaf]):
            position = block[axis].start
            if len(block) < 2 or length < 2 or block[axis].stop - position != 1:
                continue
            others = [slice(None)] * len(block)

            def slab(at: int, axis: int = axis, others: list[slice] = others) -> Block:
                return (*others[:axis], slice(at, at + 1), *others[axis + 1 :])

            remainder = self.block_gap(leaf, slab(position)) - gap
            visible = max(NEGLIGIBLE_SHARE * max(abs(gap), abs(remainder)), self.noise)
            if abs(remainder) <= visible:
                continue
            neighbours = [at for at in (position - 1, position + 1) if 0 <= at < length]
            if all(abs(self.block_gap(leaf, slab(at))) <= visible for at in neighbours):
                if all(abs(part) > visible for part in self._part_gaps(leaf, slab(position))):
                    return slab(position)
        return None

    def _part_gaps(self, leaf: int, block: Block) -> Iterator[float]:
        """Yield the gaps of disjoint parts of a block, each with entries from all over it."""
        weights = self.block_weights(leaf, block)
        entries = np.flatnonzero(weights[leaf])
        for start in range(min(SLAB_PARTS, entries.size)):
            part = [np.zeros(shape) for shape in self.shapes]
            chosen = entries[start::SLAB_PARTS]
            part[leaf].reshape(-1)[chosen] = weights[leaf].reshape(-1)[chosen]
            yield self.gap_along(part)

    def _region(self, leaf: int, block: list[slice], certain_axes: list[int], gap_of_leaf: float) -> Block | None:
        """Return the block of all entries at the same position along `certain_axes`, if it contains the whole gap."""
        if not 0 < len(certain_axes) < len(block):
            return None
        region = tuple(part if axis in certain_axes else slice(None) for axis, part in enumerate(block))
        gap = self.block_gap(leaf, region)
        if abs(gap_of_leaf - gap) > NEGLIGIBLE_SHARE * abs(gap_of_leaf):
            return None
        # The gaps of the entries outside may have cancelled, so they are measured again with other weights.
        outside = [np.zeros(shape) for shape in self.shapes]
        signs = self.rng.choice([-1.0, 1.0], self.shapes[leaf])
        outside[leaf][...] = self.weights[leaf] * signs
        outside[leaf][region] = 0.0
        if abs(self.gap_along(outside)) > max(NEGLIGIBLE_SHARE * abs(gap_of_leaf), self.noise):
            return None
        return region

    def _bisect(self, length: int, gap_between: Callable[[int, int], float], gap: float) -> _Bisection:
        """Halve a range repeatedly, and keep the half with the larger gap each time."""
        low = 0
        high = length
        beside = 0.0
        while high - low > 1 and abs(gap) > self.noise:
            middle = (low + high) // 2
            first = gap_between(low, middle)
            second = gap - first
            if abs(first) >= abs(second):
                high = middle
                gap = first
                other = second
            else:
                low = middle
                gap = second
                other = first
            beside = float(np.hypot(beside, other))
        return _Bisection(low, high, gap, beside)


def _is_same_error(first: float, second: float) -> bool:
    """Return whether two ratios of a derivative to the right one show the same error."""
    if first == second:
        return True
    return abs(first - second) <= FACTOR_SHARE * min(abs(first), abs(first - 1))


def gaps_along_entries(
    evaluations: Evaluations,
    directions: Sequence[DirectionEvidence],
    most: int = MOST_ENTRIES,
    slope_along: Callable[[NDArray[Any]], float] | None = None,
    units: NDArray[Any] | None = None,
) -> list[EntryGap]:
    """Find the entries with the largest gaps between gradient and finite difference.

    The differences use the step of the direction with the largest gap.

    Parameters
    ----------
    evaluations : Evaluations
    directions : list of DirectionEvidence
    most : int
        Largest number of entries to find.
    slope_along : callable, optional
        ``slope_along(direction)`` returns the derivative under test along a direction. Default: by the gradient under
        test.
    units : ndarray, optional
        The unit of each entry. Default: those of the point.

    Returns
    -------
    list of EntryGap
        Empty if no direction disagrees, or if `x` has only one entry.
    """
    point = evaluations.point
    wrong = [direction for direction in directions if direction.word in WRONG_WORDS]
    if point.entries < 2 or not wrong:
        return []
    if units is None:
        units = point.units
    worst = max(wrong, key=lambda direction: 0.0 if isnan(direction.share) else direction.share)
    jitter = worst.jitter if worst.jitter > 0 else 0.0
    rounding = CLEAR_OF_NOISE * max(2.0, jitter) * evaluations.eps * abs(evaluations.base)
    step = worst.difference_step if worst.step > 0 else DEFAULT_STEP
    if step > DEFAULT_STEP and rounding / DEFAULT_STEP <= SMALL_NOISE_SHARE * worst.size:
        step = DEFAULT_STEP  # other directions may have larger third derivatives than this one
    noise = rounding / step

    def displacement(weights: Sequence[NDArray[Any]]) -> NDArray[Any]:
        parts = []
        for weight, x in zip(weights, point.values, strict=True):
            if np.iscomplexobj(x):
                part = weight * (1 + 1j)
            else:
                part = weight
            parts.append(np.ravel(part).view(float))
        return units * np.concatenate(parts)

    def slope_of(weights: Sequence[NDArray[Any]]) -> float:
        direction = displacement(weights)
        if slope_along is None:
            return float(evaluations.slopes @ direction)
        return slope_along(direction)

    def gap_along(weights: Sequence[NDArray[Any]]) -> float:
        direction = displacement(weights)
        if not np.any(direction):
            return 0.0
        level = Line("entries", direction, evaluations).level(step)
        if level.note and level.note != evaluations.unchanged:
            raise _NotMeasured(level.note)
        if slope_along is None:
            return level.difference - level.slope
        return level.difference - slope_along(direction)

    if worst.size > 0:
        noise = min(noise, worst.size / NOISE_RATIO)  # the gap was measured along a direction, so it is no noise
    entries = largest_gaps(gap_along, [x.shape for x in point.values], most, noise, slope_of)
    parts = point.split(units)
    return [entry._replace(gap=entry.gap / _unit_of(entry, parts, point.values)) for entry in entries]


def _unit_of(entry: EntryGap, units: Sequence[NDArray[Any]], values: Sequence[NDArray[Any]]) -> float:
    """Return the unit of the first entry of a block."""
    shape = values[entry.leaf].shape
    of_leaf = units[entry.leaf]
    if np.iscomplexobj(values[entry.leaf]):
        of_leaf = of_leaf[::2]
    of_block = np.reshape(of_leaf, shape)[entry.block]
    return float(np.reshape(of_block, -1)[0]) if np.size(of_block) else 1.0


# ------------------------------------------------------------ in words


def spaces_of(function: Callable[[Any], Any], x: Any) -> list[Any]:
    """Return the grid spaces (domains and codomains) of all Operators that `function` applies at `x`."""
    spaces: dict[str, Any] = {}
    with suppress(*EVALUATION_ERRORS), recording() as calls, np.errstate(all="ignore"):
        function(x)
        for method_objects in calls.method_objects.values():
            for method_object in method_objects.values():
                for name in ("domain", "codomain"):
                    space: Any = getattr(method_object, name, None)
                    if getattr(space, "grid", None) is not None:
                        spaces.setdefault(str(space), space)
    return list(spaces.values())


def listed(
    entries: Sequence[EntryGap],
    point: Point,
    gradient: NDArray[Any] | None,
    spaces: Sequence[Any],
    source: str = "the gradient",
) -> list[str]:
    """Return a sentence for each entry in which two derivatives differ: its place, both values, the region affected.

    Parameters
    ----------
    entries : list of EntryGap
    point : Point
    gradient : vector or None
        The gradient under test at the point.
    spaces : list of Space
        Grid spaces in which leaves may live. They give the coordinates.
    source : str
        Name of the derivative under test, for the sentences.
    """
    if gradient is None:
        slopes = [None] * len(point.values)
    else:
        slopes = point.split(gradient)
    sentences = []
    for entry in entries:
        name = point.names[entry.leaf]
        x = point.values[entry.leaf]
        slope = slopes[entry.leaf]
        if entry.block == entry.region:
            sentences.append(f"{EVERY_ENTRY}{name}: {source} {_factor_in_words(entry.factor)}")
            continue
        words = f"{name}{subscript(entry.block, x.shape)}{where(entry.block, x.shape, spaces)}"
        if not isnan(entry.gap) and slope is not None and not np.iscomplexobj(x):
            derivative = float(np.reshape(slope, x.shape)[entry.block].reshape(-1)[0])
            digits = _digits(entry.gap, derivative)
            by_differences = derivative + entry.gap
            words += f": {by_differences:.{digits}g} by differences, {derivative:.{digits}g} by {source}"
        if entry.region is not None:
            region = f"{name}{subscript(entry.region, x.shape)}{where(entry.region, x.shape, spaces)}"
            what = f"all of the gap in {name} lies in" if entry.is_whole else "as in all of"
            factor = "" if isnan(entry.factor) else f", where {source} {_factor_in_words(entry.factor)}"
            words += f" ({what} {region}{factor})"
        sentences.append(words)
    return sentences


def _factor_in_words(factor: float) -> str:
    """Return a phrase about a factor by which a derivative is wrong."""
    if factor == 0:
        return "is 0"
    if isinf(factor):
        return "should be 0"
    if abs(factor + 1) < FACTOR_SHARE:
        return "has the wrong sign"
    if abs(factor) >= 1:
        size = "too large"
    else:
        size = "too small"
    digits = int(np.clip(3 - np.floor(np.log10(abs(factor - 1) or 1.0)), 3, 12))
    return f"is {size}, by a factor of {factor:.{digits}g}"


def _digits(gap: float, derivative: float) -> int:
    """Return the number of digits to print so that the gap is visible, plus two more digits."""
    share = abs(gap) / (abs(derivative) or abs(gap) or 1.0)
    return int(np.clip(3 - np.floor(np.log10(share or 1.0)), 4, 16))


def subscript(index: Block, shape: tuple[int, ...]) -> str:
    """Return a block in subscript notation, such as ``[0, :, 3:5]``."""
    parts = []
    for part, length in zip(index, shape, strict=True):
        low, high, _ = part.indices(length)
        if (low, high) == (0, length) and length > 1:
            parts.append(":")
        elif high - low == 1:
            parts.append(f"{low}")
        else:
            parts.append(f"{low}:{high}")
    if parts:
        return f"[{', '.join(parts)}]"
    return ""


def where(index: Block, shape: tuple[int, ...], spaces: Sequence[Any]) -> str:
    """Return a phrase with the walls or grid coordinates of a block, by the first space whose shape matches."""
    for space in spaces:
        dim = len(space.shape)
        if dim and shape[len(shape) - dim :] == space.shape:
            words = _place(space, index[len(index) - dim :])
            if words:
                return f", {words}"
            return ""
    return ""


def _place(space: Any, block: Block) -> str:
    """Return a phrase with the position of a block of a field on a space; "" if the position is not unique."""
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
