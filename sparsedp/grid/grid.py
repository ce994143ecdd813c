"""Grid: where cells, faces, nodes and edges are. The conventions of the library, stated once.

* Axis 0 is x, axis 1 is y, axis 2 is z: `field[i, j]` is the cell i along x and j along y.
* Cells are numbered from the lower end; cell i of an axis lies between nodes i and i + 1.
* Face i of an axis is the LOWER face of cell i. A bounded axis of n cells has n + 1 faces, the two
  walls included; a periodic axis has n, and its face 0 lies between cell n - 1 and cell 0.
* A face field is one flat array: all x-faces, then all y-faces, then all z-faces. Edges alike:
  an x-edge runs along a cell in x and sits on nodes in the other axes.
* Nodes sit on the corners: n + 1 along a bounded axis, n along a periodic one.
* Lengths carry whatever unit the user chose; every docstring says [length].
"""

from functools import cached_property
from itertools import compress

import numpy as np

from sparsedp._utils.calls import public
from sparsedp._utils.html import facts
from sparsedp._utils.reconstruction import Uncached, Value
from sparsedp._utils.validation import check_number, check_type
from sparsedp.autodiff.backend import NUMPY, Backend
from sparsedp.errors import ShapeError
from sparsedp.grid.space import Space, whole_lengths

__all__ = [
    "AXES",
    "Grid",
    "check_grid",
    "node_axes",
    "real_numbers",
]


def _what_to_write(*shape, **options):
    """The call in place of one that `Grid` refuses, such as Grid(64, 64) and Grid((64, 64), dx=0.1)."""
    lengths = [n for n in shape if isinstance(n, (int, np.integer))]
    if len(lengths) == len(shape) > 1:
        return f"dp.Grid({tuple(map(int, lengths))})"
    if len(shape) == 2:
        return f"dp.Grid({shape[0]!r}, size={shape[1]!r})"
    for name in options:
        if name in ("dx", "h", "cell_size", "widths"):
            return f"spacing={options[name]!r}"
        if name in ("extent", "extents", "length", "lengths", "domain", "L"):
            return f"size={options[name]!r}"
    return "dp.Grid((64, 64), size=1.0)"


class Grid(Value, Uncached):
    """A box of cells in 1-D, 2-D or 3-D, with uniform or stretched spacing. Frozen, equal by value.

    Parameters
    ----------
    shape : int or tuple of int
        Number of cells along each axis.
    size : float or sequence of float, optional
        Extent of each axis [length]. Give `size` or `spacing`, not both; default unit cells.
    spacing : float, sequence or array, optional
        Cell width of each axis [length]; an entry may be an array of widths (stretched axis).
    origin : float or sequence of float
        Coordinate of the lower corner [length].
    periodic : bool or sequence of bool
        Whether the last cell of an axis is followed by the first.

    Raises
    ------
    ShapeError
        If the shape is not one to three lengths >= 0, or an argument does not fit it.
    ValueError
        If a width is not positive and finite, or both `size` and `spacing` are given.
    TypeError
        If a length is not a real number, or an entry of `periodic` not True or False.

    Examples
    --------
    >>> grid = Grid((4, 3), size=(2.0, 3.0))
    >>> print(grid)
    Grid(4 x 3 cells, size 2 x 3)
    >>> grid.faces.size
    31
    """

    shape: tuple[int, ...]
    dim: int
    axes: tuple[str, ...]
    periodic: tuple[bool, ...]
    origin: tuple[float, ...]
    widths: tuple[np.ndarray, ...]
    meant = {"dx": "grid.widths", "h": "grid.widths", "n": "grid.shape", "ndim": "grid.dim", "x": "grid.centres()[0]"}
    backend: Backend = NUMPY  # where the fields are stored

    @public("dp.Grid", _what_to_write)
    def __init__(self, shape, *, size=None, spacing=None, origin=0.0, periodic=False):
        shape = lengths(shape)
        if size is not None and spacing is not None:
            raise ValueError("a grid takes size or spacing, not both; leave one out")
        super().__init__(
            shape=shape,
            dim=len(shape),
            axes=AXES[: len(shape)],
            periodic=tuple(flag(entry, shape) for entry in per_axis(periodic, shape, "periodic")),
            origin=numbers_per_axis(origin, shape, "origin"),
            widths=cell_widths(shape, size, spacing),
        )

    @cached_property
    def cells(self):
        """Space of cell fields; their shape is `grid.shape`."""
        return Space(self.shape, "cells", self)

    @cached_property
    def nodes(self):
        """Space of node fields."""
        return Space(self._part("nodes", 0), "nodes", self)

    @cached_property
    def faces(self):
        """Space of face fields, flat: x-faces, then y-faces, then z-faces."""
        return self._stacked("faces")

    @cached_property
    def edges(self):
        """Space of edge fields, flat: x-edges, then y-edges, then z-edges."""
        return self._stacked("edges")

    def _stacked(self, kind):
        return Space(None, kind, self, [self._part(kind, axis) for axis in range(self.dim)])

    def _part(self, kind, component):
        """Shape of a component of a space."""
        on_nodes = node_axes(kind, component, self.dim)
        return tuple(self.node_count(a) if a in on_nodes else n for a, n in enumerate(self.shape))

    def node_count(self, axis):
        """Number of nodes (and of faces) along one axis."""
        return self.shape[axis] + (not self.periodic[axis])

    def face_shape(self, axis):
        """Shape of the component of a face field that crosses `axis`."""
        return self._part("faces", axis)

    @cached_property
    def volumes(self):
        """Cell volumes [length^dim], shape `grid.shape`, read-only."""
        return self.cells.volumes

    @cached_property
    def size(self):
        """Extent of each axis [length]."""
        return tuple(float(widths.sum()) for widths in self.widths)

    @cached_property
    def uniform(self):
        """For each axis, whether all cells have the same width."""
        return tuple(bool(np.all(widths == widths[:1])) for widths in self.widths)

    def spacings(self, axis):
        """Distance between the neighbouring centres at each face of an axis [length].

        At a wall it is the distance from the centre to the wall: half a cell.
        """
        h = self.widths[axis]
        if self.periodic[axis]:
            return 0.5 * (h + np.roll(h, 1))
        return 0.5 * (np.append(h, 0.0) + np.append(0.0, h))

    def control_lengths(self, kind, axis):
        """The lengths along each axis whose products are the control volumes of a component; they fill the box."""
        on_nodes = node_axes(kind, axis, self.dim)
        if on_nodes is None:
            raise ShapeError(f"values on {kind} have no volumes; take those of grid.cells, faces, nodes or edges")
        return [self.spacings(a) if a in on_nodes else self.widths[a] for a in range(self.dim)]

    def split(self, v):
        """Face field (or 3-D edge field; in 2-D write ``grid.edges.split``) -> tuple of components. Differentiable.

        Parameters
        ----------
        v : array, shape (faces.size,) or (edges.size,)

        Returns
        -------
        tuple of arrays
            Component a of a face field has shape `face_shape(a)`.

        Raises
        ------
        ShapeError
            If `v` is neither.

        Examples
        --------
        >>> grid = Grid((2, 1))
        >>> [part.shape for part in grid.split(np.zeros(7))]
        [(3, 1), (2, 2)]
        """
        on_edges = self.dim == 3 and np.shape(v) == self.edges.shape
        return (self.edges if on_edges else self.faces).split(v)

    def join(self, *parts):
        """Components -> face field (or 3-D edge field; in 2-D ``grid.edges.join``), one flat array. Differentiable.

        Parameters
        ----------
        *parts : arrays, one for each axis
            Read-only arrays and arrays that broadcast to the component shapes are fine.

        Returns
        -------
        array, shape (faces.size,) or (edges.size,)

        Raises
        ------
        ShapeError
            If the number of components or a shape does not fit.

        Examples
        --------
        >>> Grid(2).join(np.array([1.0, 2.0, 3.0]))
        array([1., 2., 3.])
        """
        on_edges = self.dim == 3 and tuple(map(np.shape, parts)) == self.edges.parts
        return (self.edges if on_edges else self.faces).join(*parts)

    def coordinates(self, axis, at="cells"):
        """1-D coordinates along one axis [length]: of the `cells` (centres), the `nodes`, or the `ends` of cells.

        Parameters
        ----------
        axis : int
        at : "cells", "nodes" or "ends"
            Ends of cells are nodes, and on a periodic axis one more: where the last cell ends.

        Returns
        -------
        array, shape (n,)
        """
        ends = self.origin[axis] + np.append(0.0, np.cumsum(self.widths[axis]))
        if at == "cells":
            return 0.5 * (ends[:-1] + ends[1:])
        return ends[: self.node_count(axis)] if at == "nodes" else ends

    def centres(self):
        """Coordinates of the cell centres: a tuple of `dim` full arrays, also in 1-D.

        Returns
        -------
        tuple of arrays, shape `grid.shape` [length]

        Examples
        --------
        >>> Grid(2, size=1.0).centres()
        (array([0.25, 0.75]),)
        """
        return self._mesh(["cells"] * self.dim)

    def face_centres(self, axis):
        """Coordinates of the centres of the faces that cross `axis`: a tuple of `dim` full arrays.

        Parameters
        ----------
        axis : int

        Returns
        -------
        tuple of arrays, shape `face_shape(axis)` [length]

        Raises
        ------
        ValueError
            If the grid has no such axis.
        """
        axis = self.axis(axis)
        return self._mesh(["nodes" if a == axis else "cells" for a in range(self.dim)])

    def _mesh(self, places):
        lines = [self.coordinates(axis, at) for axis, at in enumerate(places)]
        return self.backend.mesh(self, lines)

    def axis(self, axis):
        """Check an axis number or name ("x") and return the number."""
        number = AXES.index(axis) if isinstance(axis, str) and axis in AXES else axis
        if isinstance(number, (int, np.integer)) and 0 <= number < self.dim:
            return int(number)
        raise ValueError(
            f"{self} has axes 0 to {self.dim - 1}, got {axis!r}; write a number or a name of {', '.join(self.axes)}"
        )

    @cached_property
    def _key(self):
        return self.shape, self.periodic, self.origin, tuple(widths.tobytes() for widths in self.widths), self.backend

    def __repr__(self):
        words = [" x ".join(map(str, self.shape)) + " cells", "size " + " x ".join(f"{size:.6g}" for size in self.size)]
        if any(self.origin):
            words.append("origin " + ", ".join(f"{start:.6g}" for start in self.origin))
        for word, flags in (("periodic", self.periodic), ("stretched", [not uniform for uniform in self.uniform])):
            if any(flags):
                words.append(f"{word} in {', '.join(compress(AXES, flags))}")
        if str(self.backend):
            words.append(str(self.backend))
        return f"Grid({', '.join(words)})"

    def _repr_html_(self):
        """For a notebook: a line for each axis and for each space."""
        entries = {}
        for name, n, size, start, widths, around in zip(
            self.axes, self.shape, self.size, self.origin, self.widths, self.periodic, strict=True
        ):
            narrow, wide = np.min(widths, initial=np.inf), np.max(widths, initial=0.0)
            width = f"width {wide:.4g}" if wide <= narrow else f"widths {narrow:.4g} to {wide:.4g}"
            ends = f"from {start:.6g} to {start + size:.6g}{', periodic' if around else ''}"
            entries[name] = f"{n} cells {ends}, {width}"
        for space in (self.cells, self.faces, self.nodes, self.edges):
            entries[space.kind] = f"{space.size} values, shape {space.shape}"
        return facts(repr(self), entries)


def check_grid(name, grid):
    """Refuse what is no Grid."""
    check_type(name, grid, Grid, "a Grid", "dp.Grid((64, 64), size=1.0)")
    grid.backend.check(name)


# ---- from what the user gave to one entry for each axis ----


AXES = ("x", "y", "z")


def lengths(shape):
    """Shape argument -> tuple of one to three lengths."""
    entries = whole_lengths(shape)
    if entries is None or not 1 <= len(entries) <= 3:
        raise ShapeError(f"a grid needs one to three whole lengths >= 0, got shape {shape}; write Grid((8, 6))")
    return entries


def node_axes(kind, component, dim):
    """Axes along which values sit on nodes, not on centres; None for kinds of spaces that have no places, as walls.

    kind: cells, nodes, faces, edges, or one component of faces, such as x-faces; component: its number.
    """
    across = tuple(axis for axis in range(dim) if axis != component)
    places: dict = {f"{axis}-faces": (number,) for number, axis in enumerate(AXES)}
    places |= {"cells": (), "nodes": tuple(range(dim)), "faces": (component,), "edges": across}
    return places.get(kind)


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


def numbers_per_axis(value, shape, name, needs=""):
    """One finite float for each axis, in the range that is needed; a number serves all of them."""
    kind = "; write one number for each axis, or one for all"
    return tuple(check_number(name, entry, needs, kind=kind) for entry in per_axis(value, shape, name))


def flag(entry, shape):
    """One entry of `periodic`: True or False, nothing that only counts as one of them."""
    if not isinstance(entry, (bool, np.bool_)):
        example = (True, False, False)[: len(shape)] if len(shape) > 1 else True
        raise TypeError(f"periodic needs True or False for each axis, got {entry!r}; write periodic={example}")
    return bool(entry)


def cell_widths(shape, size, spacing):
    """Size or spacing argument -> tuple of read-only arrays of cell widths, one for each axis."""
    if size is not None:
        extents = numbers_per_axis(size, shape, "size", "> 0")
        spacing = [extent / max(n, 1) for n, extent in zip(shape, extents, strict=True)]
    elif len(shape) == 1 and isinstance(spacing, np.ndarray) and spacing.ndim == 1:
        spacing = [spacing]  # in 1-D an array is the widths themselves
    entries = per_axis(1.0 if spacing is None else spacing, shape, "spacing")
    return tuple(_axis_widths(n, entry, axis) for n, entry, axis in zip(shape, entries, AXES, strict=False))


def _axis_widths(n, entry, axis):
    line = np.array(real_numbers(entry, "spacing", "spacing=0.5"), dtype=float)
    if line.shape not in ((), (n,)):
        raise ShapeError(f"spacing along {axis} needs {n} cell widths, got an array of shape {line.shape}")
    wrong = ~((line > 0) & (line < np.inf))  # NaN too
    if np.any(wrong):
        raise ValueError(f"spacing must be positive and finite, got {line[wrong][0]}")
    line = np.full(n, line)
    line.flags.writeable = False
    return line
