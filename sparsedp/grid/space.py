"""Space: the shape of a field and the grid locations of its values. It stores no field values."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, reduce
from itertools import accumulate
from math import prod
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.base_classes import Uncached, Value
from sparsedp._utils.validation import check_finite, check_on, check_plain
from sparsedp.autodiff.backend import NUMPY, Backend
from sparsedp.autodiff.tape import dtype_of, isbox
from sparsedp.errors import ShapeError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["Space", "components", "fits", "whole_lengths"]


class Space(Value, Uncached):
    """The shape and location of a field: on the cells, faces, nodes or edges of a grid, or without a grid.

    Parameters
    ----------
    shape : int, tuple of int or None
        Shape of a field; ``Space(7)`` is the space of arrays of 7 numbers, without a grid. None: a field is one flat
        array that contains all `parts`.
    kind : str
        "cells", "faces", ... Set by Grid.
    grid : Grid or None
        Set by Grid.
    parts : sequence of tuple of int, optional
        The shapes of the components; default: one component of shape `shape`. Set by Grid.

    Raises
    ------
    ShapeError
        If the shape has an entry that is not an integer >= 0.

    See Also
    --------
    Grid

    Notes
    -----
    A field on cells or nodes has one array axis for each axis of the grid. A field on faces or edges is ONE flat array
    in which the components follow each other (x, then y, then z); each component is stored in C order and has shape
    `parts[axis]`.

    Examples
    --------
    >>> Space((2, 3)).size
    6
    >>> print(Space(7))
    space(7)
    """

    shape: tuple[int, ...]
    kind: str
    grid: Any
    parts: tuple[tuple[int, ...], ...]

    def __init__(self, shape: Any, kind: str = "space", grid: Any = None, parts: Sequence | None = None) -> None:
        lengths = whole_lengths(sum(map(prod, parts or ())) if shape is None else shape)
        if lengths is None:
            raise ShapeError(f"a space needs whole lengths >= 0, got {shape}; write Space(7) or Space((2, 3))")
        if parts is None:
            parts = (lengths,)
        super().__init__(shape=lengths, kind=kind, grid=grid, parts=tuple(parts))

    @cached_property
    def size(self) -> int:
        """Number of entries of a field."""
        return prod(self.shape)

    @cached_property
    def offsets(self) -> tuple[int, ...]:
        """Start index of each component in the flat array, followed by the total size."""
        return (0, *accumulate(map(prod, self.parts)))

    @cached_property
    def backend(self) -> Backend:
        """The backend that stores the fields: NumPy, or blocks on MPI ranks."""
        if self.grid is None:
            return NUMPY
        return self.grid.backend

    @cached_property
    def volumes(self) -> Any:
        """Control volume of each value [length^dim]; 1 for every value in a space without a grid."""
        return self.backend.volumes(self)

    def array_of_volumes(self) -> NDArray:
        """Return the control volumes as one array: see `volumes`."""
        if self.grid is None:
            return np.ones(self.shape)
        flat = []
        with np.errstate(over="ignore"):  # infinite volumes raise an error below
            for axis in range(len(self.parts)):
                lengths = self.grid.control_lengths(self.kind, axis)
                flat.append(reduce(np.multiply.outer, lengths).ravel())
        volumes = np.concatenate(flat).reshape(self.shape)
        check_finite("volumes of a grid", volumes, advice="; its spacing is too large, rescale its lengths")
        volumes.flags.writeable = False
        return volumes

    def component(self, axis: int | str) -> Space:
        """Return the space of one component of faces or edges, such as x-faces.

        Parameters
        ----------
        axis : int or "x", "y", "z"

        Returns
        -------
        Space
            The space of fields of shape `parts[axis]`, which `split` returns.

        Raises
        ------
        TypeError
            If this is not the space of faces or edges of a grid.
        ValueError
            If the grid has no such axis.

        Examples
        --------
        >>> from sparsedp import Grid
        >>> space = Grid((4, 3)).faces.component("x")
        >>> space.kind, space.shape
        ('x-faces', (5, 3))
        """
        if self.kind not in ("faces", "edges"):
            raise TypeError(f"component takes faces or edges of a grid, got {self}; write grid.faces.component(0)")
        number = self.grid.axis(axis)
        return Space(self.parts[number], f"{self.grid.axes[number]}-{self.kind}", self.grid)

    def split(self, v: ArrayLike) -> tuple:
        """Return the components of a field, each of shape `parts[axis]`. Differentiable.

        Parameters
        ----------
        v : array, shape `shape`

        Returns
        -------
        tuple of arrays

        Raises
        ------
        ShapeError
            If `v` has another shape.
        """
        check_on("split", v, self)
        return self.backend.split(self, v)

    def split_array(self, v: Any) -> tuple:
        """Return the components of an array, which autograd may be tracing: see `split`."""
        check_plain("split", v)
        if len(self.parts) == 1:
            return (anp.reshape(v, self.parts[0]),)
        return tuple(components(anp.reshape(v, (-1,)), self.parts))

    def join(self, *parts: ArrayLike) -> Any:
        """Return one field of shape `shape` from its components. Differentiable; inverse of `split`.

        Parameters
        ----------
        *parts : arrays
            Each component is broadcast to its shape in `self.parts`. A component with the right number of entries may
            also lack axes of length 1, or have additional ones; so the values on a wall need no axis across the wall.

        Returns
        -------
        array

        Raises
        ------
        ShapeError
            If the number of components is wrong, or a component cannot be broadcast.
        """
        if len(parts) != len(self.parts):
            shapes = ", ".join(map(str, self.parts)) or "none"
            raise ShapeError(
                f"join on {self} takes {len(self.parts)} components, got {len(parts)}; their shapes are {shapes}"
            )
        check_plain("join", *parts)
        return self.backend.join(self, parts)

    def join_arrays(self, parts: Any) -> Any:
        """Return one array joined from components, which autograd may be tracing: see `join`."""
        if len(parts) == 0:  # the space of walls of a fully periodic grid has no components
            return np.zeros(self.shape)
        numpy = anp if any(map(isbox, parts)) else np  # NumPy's own functions are faster
        flat = [numpy.reshape(_broadcast(self, part, shape), (-1,)) for part, shape in zip(parts, self.parts)]
        return numpy.reshape(numpy.concatenate(flat), self.shape)

    @cached_property
    def _key(self):
        return self.shape, self.kind, self.grid

    def __str__(self) -> str:
        shape = self.grid.shape if self.grid is not None else self.shape
        return f"{self.kind}({', '.join(map(str, shape))})"

    __repr__ = __str__

    @property
    def described(self) -> str:
        """The name of the space for error messages, followed by the shape of its fields where the name differs."""
        shape = self.shape if self.grid is None else self.grid.shape
        if shape == self.shape:
            return str(self)
        return f"{self} of shape {self.shape}"


def components(flat: Any, parts: Sequence[tuple[int, ...]]) -> list:
    """Split a flat array, which autograd may be tracing, into components of the given shapes."""
    ends = accumulate(map(prod, parts))
    return [flat[end - prod(part) : end].reshape(part) for end, part in zip(ends, parts)]


def whole_lengths(shape: Any) -> tuple[int, ...] | None:
    """Return one length, or a sequence of lengths, as a tuple of int; return None unless all are integers >= 0."""
    lengths = (shape,) if np.ndim(shape) == 0 else tuple(shape)
    for length in lengths:
        if isinstance(length, bool) or not isinstance(length, (int, np.integer)) or length < 0:
            return None
    return tuple(map(int, lengths))


def fits(first: Space, second: Space) -> bool:
    """Return True if a field on one space is valid on the other.

    This is so if the spaces are equal, or if they have the same size and at least one of them has no grid.
    """
    if first.grid is None or second.grid is None:
        return first.size == second.size
    return first == second


def _broadcast(space: Space, part: Any, shape: tuple[int, ...]) -> Any:
    """Broadcast a component to its shape; return it unchanged if it differs only by axes of length 1."""
    if [n for n in np.shape(part) if n != 1] == [n for n in shape if n != 1]:
        return part
    try:
        np.broadcast_shapes(np.shape(part), shape)
        if isbox(part):  # autograd's broadcast_to does not add dimensions; a product with ones does
            return part * np.ones(shape, dtype_of(part))
        return np.broadcast_to(part, shape)
    except ValueError:
        raise ShapeError(f"join on {space} needs components {space.parts}, got one of shape {np.shape(part)}") from None
