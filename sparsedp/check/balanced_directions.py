"""Directions along which large and small entries of x have about the same share of a derivative."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sparsedp.check.point import LARGEST_SHARE, Point, root_mean_square

__all__ = ["balanced_direction", "entry_units", "has_wide_leaves", "hidden_entries"]

RANGE = 1e3  # entries of a leaf are moved relative to their own size if their sizes differ by more than this factor
MOST_BALANCE = 1e4  # a balanced direction changes entries relative to each other by at most this factor
VISIBLE_SHARE = 1e-3  # an entry with this share of the typical contribution to a derivative is examined


def _is_wide(values: NDArray) -> bool:
    """Return whether the sizes of the entries of a leaf differ by orders of magnitude."""
    sizes = np.abs(values)
    nonzero = sizes[sizes > 0]
    return bool(nonzero.size and np.quantile(nonzero, 0.95) > RANGE * np.quantile(nonzero, 0.05))


def has_wide_leaves(point: Point) -> bool:
    """Return whether there is a leaf in which the sizes of the entries differ by orders of magnitude."""
    return any(map(_is_wide, point.split(point.vector)))


def entry_units(point: Point) -> NDArray:
    """Return the unit of each entry: that of its leaf, or its own size if the sizes in the leaf differ much."""
    units = []
    for values, unit in zip(point.split(point.vector), point.split(point.units)):
        if _is_wide(values):
            sizes = np.abs(values)
            unit = np.minimum(np.where(sizes > 0, sizes, np.median(sizes[sizes > 0])), unit)
        units.append(unit)
    return np.concatenate(units)


def balanced_direction(point: Point, slopes: NDArray | None, rng: np.random.Generator) -> NDArray:
    """Return a random direction along which all entries have about the same share of the derivative.

    Parameters
    ----------
    point : Point
    slopes : ndarray or None
        The gradient under test; None if it is not known.
    rng : Generator
    """
    units = entry_units(point)
    balance = np.ones(units.size)
    if slopes is not None:
        shares = np.abs(slopes * units)
        if np.any(shares):
            smallest = max(float(np.quantile(shares[shares > 0], 0.1)), float(np.max(shares)) / MOST_BALANCE)
            balance = smallest / np.maximum(shares, smallest)
    balance *= min(1 / root_mean_square(balance), LARGEST_SHARE)
    return units * balance * rng.choice([-1.0, 1.0], units.size) * rng.uniform(0.5, 1.5, units.size)


def hidden_entries(point: Point, slopes: NDArray, direction: NDArray) -> NDArray:
    """Return which entries contribute so little to the derivative along a direction that an error there is hidden.

    These are entries with a small contribution, and, if x has several leaves, leaves without any contribution.

    Returns
    -------
    ndarray of bool
    """
    shares = np.abs(slopes * direction)
    typical = root_mean_square(shares)
    hidden = (shares > 0) & (shares < VISIBLE_SHARE * typical)
    parts = point.split(shares)
    if len(parts) > 1:
        for part, is_hidden in zip(parts, point.split(hidden)):
            if not np.any(part):
                is_hidden[:] = True
    return hidden
