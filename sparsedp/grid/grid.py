"""Grid: the positions of cells, faces, nodes and edges, with the indexing conventions of the library.

* Axis 0 is x, axis 1 is y, axis 2 is z: `field[i, j]` is the value in cell i along x and j along y.
* Cells are numbered from the lower end; cell i of an axis lies between nodes i and i + 1.
* Face i of an axis is the LOWER face of cell i. A bounded axis of n cells has n + 1 faces, the two
  walls included. A periodic axis has n faces, and its face 0 lies between cell n - 1 and cell 0.
* A face field is one flat array: all x-faces, then all y-faces, then all z-faces. Edge fields are stored
  in the same way: all x-edges, then all y-edges, then all z-edges. An x-edge is parallel to x; its
  coordinates are those of a cell centre along x and of nodes along the other axes.
* Nodes are the corners of cells: n + 1 along a bounded axis, n along a periodic one.
* The user chooses the unit of length; docstrings write it as [length].
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import compress
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.base_classes import Uncached, Value
from sparsedp._utils.calls import public
from sparsedp._utils.html import facts
from sparsedp._utils.validation import check_number, check_type
from sparsedp.autodiff.backend import NUMPY, Backend
from sparsedp.errors import ShapeError
from sparsedp.grid.space import Space, whole_lengths

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = [
    "AXES",
    "Grid",
    "check_grid",
    "node_axes",
    "real_numbers",
]


def _what_to_write(*shape, **options):
    """Return the correct form of a wrong call of `Grid`, such as Grid(64, 64) or Grid((64, 64), dx=0.1)."""
    lengths = [n for n in shape if isinstance(n, (int, np.integer))]
    if len(lengths) == len(shape) > 1:
        return f"dp.Grid({tuple(map(int, lengths))}) for cells of width 1, or add size=1.0"
    if len(shape) == 2:
        return f"dp.Grid({shape[0]!r}, size={shape[1]!r})"
    for name in options:
        if name in ("dx", "h", "cell_size", "widths"):
            return f"spacing={options[name]!r}"
        if name in ("extent", "extents", "length", "lengths", "domain", "L"):
            return f"size={options[name]!r}"
    return "dp.Grid((64, 64), size=1.0)"


class Grid(Value, Uncached):
    """A rectangular grid of cells in 1-D, 2-D or 3-D, with uniform or stretched spacing.

    Grids are immutable, and two grids with the same values are equal.

    Parameters
    ----------
    shape : int or tuple of int
        Number of cells along each axis.
    size : float or sequence of float, optional
        Extent of the grid along each axis [length]. Give `size` or `spacing`, not both. Default: cells of width 1, so
        that ``Grid((64, 64))`` has the extent 64 x 64.
    spacing : float, sequence or array, optional
        Cell width along each axis [length]. Default: 1. For a stretched axis the entry is an array with the width of
        each cell.
    origin : float or sequence of float
        Coordinate of the lower corner [length].
    periodic : bool or sequence of bool
        Whether each axis is periodic, so that its last cell is a neighbour of its first cell.

    Raises
    ------
    ShapeError
        If the shape is not one to three integers >= 0, or an argument does not fit it.
    ValueError
        If a width is not positive and finite, or both `size` and `spacing` are given.
    TypeError
        If a length is not a real number, or an entry of `periodic` is not True or False.

    See Also
    --------
    Space, distribute

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
    attribute_suggestions = {
        "dx": "grid.widths",
        "h": "grid.widths",
        "n": "grid.shape",
        "ndim": "grid.dim",
        "x": "grid.centres()[0]",
    }
    backend: Backend = NUMPY  # where the fields are stored

    @public("dp.Grid", _what_to_write)
    def __init__(
        self,
        shape: int | Sequence[int],
        *,
        size: float | Sequence[float] | None = None,
        spacing: float | Sequence | NDArray | None = None,
        origin: float | Sequence[float] = 0.0,
        periodic: bool | Sequence[bool] = False,
    ) -> None:
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
    def cells(self) -> Space:
        """Space of cell fields; their shape is `grid.shape`."""
        return Space(self.shape, "cells", self)

    @cached_property
    def nodes(self) -> Space:
        """Space of node fields."""
        return Space(self._part("nodes", 0), "nodes", self)

    @cached_property
    def faces(self) -> Space:
        """Space of face fields, flat: x-faces, then y-faces, then z-faces."""
        return self._stacked("faces")

    @cached_property
    def edges(self) -> Space:
        """Space of edge fields, flat: x-edges, then y-edges, then z-edges."""
        return self._stacked("edges")

    def _stacked(self, kind):
        return Space(None, kind, self, [self._part(kind, axis) for axis in range(self.dim)])

    def _part(self, kind, component):
        """Return the shape of component number `component` of the fields of a kind, such as "faces"."""
        on_nodes = node_axes(kind, component, self.dim) or ()
        lengths = list(self.shape)
        for axis in on_nodes:
            lengths[axis] = self.node_count(axis)
        return tuple(lengths)

    def node_count(self, axis: int) -> int:
        """Return the number of nodes (and of faces) along one axis."""
        return self.shape[axis] + (not self.periodic[axis])

    def face_shape(self, axis: int) -> tuple[int, ...]:
        """Return the shape of the values on the faces perpendicular to `axis`."""
        return self._part("faces", axis)

    @cached_property
    def volumes(self) -> Any:
        """Cell volumes [length^dim], a read-only array of shape `grid.shape`."""
        return self.cells.volumes

    @cached_property
    def size(self) -> tuple[float, ...]:
        """Extent of each axis [length]."""
        return tuple(float(widths.sum()) for widths in self.widths)

    @cached_property
    def uniform(self) -> tuple[bool, ...]:
        """For each axis, whether all cells have the same width."""
        return tuple(bool(np.all(widths == widths[:1])) for widths in self.widths)

    def spacings(self, axis: int) -> NDArray:
        """Return the distance between the centres of the two cells at each face of an axis [length].

        At a wall it is the distance between the wall and the centre of its cell, which is half a cell width.
        """
        widths = self.widths[axis]
        if self.periodic[axis]:
            return 0.5 * (widths + np.roll(widths, 1))
        return 0.5 * (np.append(widths, 0.0) + np.append(0.0, widths))

    def control_lengths(self, kind: str, axis: int) -> list[NDArray]:
        """Return one array of lengths for each axis; their outer product is the control volumes of a component."""
        on_nodes = node_axes(kind, axis, self.dim)
        if on_nodes is None:
            raise ShapeError(f"values on {kind} have no volumes; take those of grid.cells, faces, nodes or edges")
        return [self.spacings(a) if a in on_nodes else self.widths[a] for a in range(self.dim)]

    def split(self, v: ArrayLike) -> tuple:
        """Return the components of a face field, or of an edge field in 3-D. Differentiable.

        An edge field in 2-D can have the same size as a face field; for it write ``grid.edges.split(v)``.

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
            If `v` has neither of the two shapes.

        Examples
        --------
        >>> grid = Grid((2, 1))
        >>> [part.shape for part in grid.split(np.zeros(7))]
        [(3, 1), (2, 2)]
        """
        on_edges = self.dim == 3 and np.shape(v) == self.edges.shape
        return (self.edges if on_edges else self.faces).split(v)

    def join(self, *parts: ArrayLike) -> Any:
        """Join components into one flat face field, or into an edge field in 3-D. Differentiable.

        For an edge field in 2-D write ``grid.edges.join(*parts)``.

        Parameters
        ----------
        *parts : arrays, one for each axis
            Each is broadcast to the shape of its component.

        Returns
        -------
        array, shape (faces.size,) or (edges.size,)

        Raises
        ------
        ShapeError
            If the number of components is wrong, or a component cannot be broadcast.

        Examples
        --------
        >>> Grid(2).join(np.array([1.0, 2.0, 3.0]))
        array([1., 2., 3.])
        """
        on_edges = self.dim == 3 and tuple(map(np.shape, parts)) == self.edges.parts
        return (self.edges if on_edges else self.faces).join(*parts)

    def coordinates(self, axis: int, at: str = "cells") -> NDArray:
        """Return the 1-D coordinates of cell centres, nodes or cell boundaries along one axis [length].

        Parameters
        ----------
        axis : int
        at : "cells", "nodes" or "ends"
            "ends" gives the n + 1 boundaries of n cells. On a periodic axis this is one more than the nodes, because
            the upper boundary of the last cell is the same node as the first one.

        Returns
        -------
        array, shape (n,)
        """
        ends = self.origin[axis] + np.append(0.0, np.cumsum(self.widths[axis]))
        if at == "cells":
            return 0.5 * (ends[:-1] + ends[1:])
        if at == "nodes":
            return ends[: self.node_count(axis)]
        return ends

    def centres(self) -> tuple:
        """Return the coordinates of the cell centres: a tuple of `dim` arrays (a tuple of one in 1-D).

        Returns
        -------
        tuple of arrays, shape `grid.shape` [length]

        Examples
        --------
        >>> Grid(2, size=1.0).centres()
        (array([0.25, 0.75]),)
        """
        return self._mesh(["cells"] * self.dim)

    def face_centres(self, axis: int) -> tuple:
        """Return the coordinates of the centres of the faces perpendicular to `axis`, a tuple of `dim` arrays.

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
        """Return coordinate arrays as from np.meshgrid; `places` has "cells" or "nodes" for each axis."""
        lines = [self.coordinates(axis, at) for axis, at in enumerate(places)]
        return self.backend.mesh(self, lines)

    def axis(self, axis: int | str) -> int:
        """Return the number of an axis, given its number or its name ("x"); raise ValueError if there is none."""
        number: Any = axis
        if isinstance(axis, str) and axis in AXES:
            number = AXES.index(axis)
        if isinstance(number, (int, np.integer)) and 0 <= number < self.dim:
            return int(number)
        raise ValueError(
            f"{self} has axes 0 to {self.dim - 1}, got {axis!r}; write a number or a name of {', '.join(self.axes)}"
        )

    def stored_by(self, backend: Backend) -> Grid:
        """Return a copy of this grid whose fields are stored by another backend."""
        grid = object.__new__(type(self))
        Value.__init__(grid, **{**self.__getstate__(), "backend": backend})
        return grid

    @property
    def layout(self) -> Any:
        """How fields are distributed over processes, with the communicator as ``layout.comm``; None on one process."""
        return None if self.backend is NUMPY else self.backend

    @cached_property
    def _key(self):
        return self.shape, self.periodic, self.origin, tuple(widths.tobytes() for widths in self.widths), self.backend

    def __repr__(self) -> str:
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
        """Return HTML for a notebook: a line for each axis and for each space."""
        entries = {}
        for axis, name in enumerate(self.axes):
            widths = self.widths[axis]
            narrowest = np.min(widths, initial=np.inf)
            widest = np.max(widths, initial=0.0)
            start = self.origin[axis]
            text = f"{self.shape[axis]} cells from {start:.6g} to {start + self.size[axis]:.6g}"
            if self.periodic[axis]:
                text += ", periodic"
            if widest <= narrowest:
                text += f", width {widest:.4g}"
            else:
                text += f", widths {narrowest:.4g} to {widest:.4g}"
            entries[name] = text
        for space in (self.cells, self.faces, self.nodes, self.edges):
            entries[space.kind] = f"{space.size} values, shape {space.shape}"
        return facts(repr(self), entries)


def check_grid(name: str, grid: Any) -> None:
    """Raise TypeError if `grid` is not a Grid, or if the function `name` does not support its backend."""
    check_type(name, grid, Grid, "a Grid", "dp.Grid((64, 64), size=1.0)")
    grid.backend.check(name)


# ---- arguments of Grid that have one entry for each axis ----


AXES = ("x", "y", "z")


def lengths(shape: Any) -> tuple[int, ...]:
    """Return the argument `shape` as a tuple of one to three integers."""
    entries = whole_lengths(shape)
    if entries is None or not 1 <= len(entries) <= 3:
        raise ShapeError(f"a grid needs one to three whole lengths >= 0, got shape {shape}; write Grid((8, 6))")
    return entries


def node_axes(kind: str, component: int, dim: int) -> tuple[int, ...] | None:
    """Return the axes along which values are located at nodes; along the others they are at cell centres.

    Parameters
    ----------
    kind : str
        cells, nodes, faces, edges, or one component of faces, such as x-faces.
    component : int
        Number of the component of faces or edges.
    dim : int

    Returns
    -------
    tuple of int, or None
        None for a kind whose values have no control volumes, such as walls.
    """
    axes: dict[str, tuple[int, ...]] = {
        "cells": (),
        "nodes": tuple(range(dim)),
        "faces": (component,),
        "edges": tuple(axis for axis in range(dim) if axis != component),
    }
    for number, name in enumerate(AXES):
        axes[f"{name}-faces"] = (number,)
    return axes.get(kind)


def per_axis(value: Any, shape: tuple[int, ...], name: str) -> tuple:
    """Return one entry for each axis; a scalar is repeated."""
    if not isinstance(value, (tuple, list)) and np.ndim(value) == 0:
        return (value,) * len(shape)
    if len(value) != len(shape):
        raise ShapeError(f"{name} needs one entry for each of {len(shape)} axes, got {len(value)}")
    return tuple(value)


def real_numbers(entry: Any, name: str, example: str) -> NDArray:
    """Return an argument as an array; raise TypeError if its entries are not real numbers."""
    values = np.asarray(entry)
    if values.dtype.kind not in "biuf":
        raise TypeError(f"{name} needs real numbers, got {entry!r}; write for example {example}")
    return values


def numbers_per_axis(value: Any, shape: tuple[int, ...], name: str, needs: str = "") -> tuple[float, ...]:
    """Return one finite float for each axis; a scalar is repeated.

    `needs` is an optional condition on the values, such as "> 0".
    """
    advice = "; write one number for each axis, or one for all"
    return tuple(check_number(name, entry, needs, kind=advice) for entry in per_axis(value, shape, name))


def flag(entry: Any, shape: tuple[int, ...]) -> bool:
    """Return one entry of `periodic`; raise TypeError if it is not a bool."""
    if not isinstance(entry, (bool, np.bool_)):
        example: Any = True
        if len(shape) > 1:
            example = (True, False, False)[: len(shape)]
        raise TypeError(f"periodic needs True or False for each axis, got {entry!r}; write periodic={example}")
    return bool(entry)


def cell_widths(shape: tuple[int, ...], size: Any, spacing: Any) -> tuple[NDArray, ...]:
    """Return the cell widths of each axis as read-only arrays, from the argument `size` or `spacing`."""
    if size is not None:
        extents = numbers_per_axis(size, shape, "size", "> 0")
        spacing = [extent / max(n, 1) for n, extent in zip(shape, extents, strict=True)]
    elif len(shape) == 1 and isinstance(spacing, np.ndarray) and spacing.ndim == 1:
        spacing = [spacing]  # in 1-D an array is the cell widths of the only axis, not one entry for each axis
    elif spacing is None:
        spacing = 1.0
    entries = per_axis(spacing, shape, "spacing")
    return tuple(_axis_widths(n, entry, axis) for n, entry, axis in zip(shape, entries, AXES, strict=False))


def _axis_widths(n, entry, axis):
    """Return the widths of the cells of one axis, given one width or an array of them."""
    line = np.array(real_numbers(entry, "spacing", "spacing=0.5"), dtype=float)
    if line.shape not in ((), (n,)):
        raise ShapeError(f"spacing along {axis} needs {n} cell widths, got an array of shape {line.shape}")
    wrong = ~((line > 0) & (line < np.inf))  # also true for NaN
    if np.any(wrong):
        raise ValueError(f"spacing must be positive and finite, got {line[wrong][0]}")
    line = np.full(n, line)
    line.flags.writeable = False
    return line
