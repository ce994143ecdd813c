"""From what the user gave (size, spacing, origin) to one entry for each axis."""

import numpy as np

from sparsedp.errors import ShapeError

__all__ = ["AXES", "cell_widths", "finite_number", "flag", "lengths", "node_axes", "per_axis", "real_numbers"]

AXES = ("x", "y", "z")


def lengths(shape):
    """Shape argument -> tuple of one to three lengths."""
    shape = (shape,) if np.ndim(shape) == 0 else tuple(shape)
    whole = all(isinstance(n, (int, np.integer)) and not isinstance(n, bool) and n >= 0 for n in shape)
    if not (whole and 1 <= len(shape) <= 3):
        raise ShapeError(f"a grid needs one to three whole lengths >= 0, got shape {shape}; write Grid((8, 6))")
    return tuple(int(n) for n in shape)


def node_axes(kind, component, dim):
    """Axes along which values sit on nodes, not on centres; None for kinds of spaces that have no places, as walls.

    kind: cells, nodes, faces, edges, or one component of faces, such as x-faces; component: its number.
    """
    if kind in [f"{axis}-faces" for axis in AXES[:dim]]:
        return (AXES.index(kind[0]),)
    across = tuple(axis for axis in range(dim) if axis != component)
    return {"cells": (), "nodes": tuple(range(dim)), "faces": (component,), "edges": across}.get(kind)


def per_axis(value, shape, name):
    """One entry for each axis; a scalar serves all of them."""
    if not isinstance(value, (tuple, list)) and np.ndim(value) == 0:
        return (value,) * len(shape)
    if len(value) != len(shape):
        raise ShapeError(f"{name} needs one entry for each of {len(shape)} axes, got {len(value)}")
    return tuple(value)


def real_numbers(entry, name, example):
    """Array of real numbers, or TypeError that names the argument."""
    values = np.asarray(entry)
    if values.dtype.kind not in "biuf":
        raise TypeError(f"{name} needs real numbers, got {entry!r}; write for example {example}")
    return values


def finite_number(entry, name):
    """One finite float, or an error that names the argument."""
    if real_numbers(entry, name, f"{name}=1.0").ndim or not np.isfinite(entry):
        raise ValueError(f"{name} needs finite numbers, got {entry}; write one for each axis, or one for all")
    return float(entry)


def flag(entry, shape):
    """One entry of `periodic`: True or False, nothing that only counts as one of them."""
    if not isinstance(entry, (bool, np.bool_)):
        example = "True" if len(shape) == 1 else f"({', '.join(['True', *['False'] * (len(shape) - 1)])})"
        raise TypeError(f"periodic needs True or False for each axis, got {entry!r}; write periodic={example}")
    return bool(entry)


def cell_widths(shape, size, spacing):
    """Size or spacing argument -> tuple of read-only arrays of cell widths, one for each axis."""
    if size is not None:
        extents = per_axis(size, shape, "size")
        widths = [
            np.full(n, finite_number(extent, "size") / max(n, 1)) for n, extent in zip(shape, extents, strict=True)
        ]
        _positive("size", [float(extent) for extent in extents])
    else:
        if len(shape) == 1 and isinstance(spacing, np.ndarray) and spacing.ndim == 1:
            spacing = [spacing]  # in 1-D an array is the widths themselves
        entries = per_axis(1.0 if spacing is None else spacing, shape, "spacing")
        widths = [_axis_widths(n, entry, axis) for n, entry, axis in zip(shape, entries, AXES, strict=False)]
    for line in widths:
        _positive("spacing", line)
        line.flags.writeable = False
    return tuple(widths)


def _axis_widths(n, entry, axis):
    line = np.array(real_numbers(entry, "spacing", "spacing=0.5"), dtype=float)
    if line.ndim == 0:
        return np.full(n, float(line))
    if line.shape != (n,):
        raise ShapeError(f"spacing along {axis} needs {n} cell widths, got an array of shape {line.shape}")
    return line


def _positive(name, numbers):
    for number in numbers:
        if not (np.isfinite(number) and number > 0):
            raise ValueError(f"{name} must be positive and finite, got {number}")
