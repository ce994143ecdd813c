"""Space: where the numbers of a field live, as a value. No numbers are stored here."""

from functools import cached_property, reduce
from itertools import accumulate
from math import prod
from typing import Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.reconstruction import Uncached, Value
from sparsedp._utils.validation import check_finite, check_on, check_plain
from sparsedp.autodiff.backend import NUMPY
from sparsedp.autodiff.tape import dtype_of, isbox
from sparsedp.errors import ShapeError

__all__ = ["Space", "components", "fits", "whole_lengths"]


class Space(Value, Uncached):
    """The place of a field: the cells, faces, nodes or edges of a grid, or a plain shape.

    Parameters
    ----------
    shape : int, tuple of int or None
        For a space without a grid: ``Space(7)`` holds 7 numbers. None: one flat array of all `parts`.
    kind, grid, parts
        Filled in by Grid: a word, the grid, and the shapes of the components.

    Notes
    -----
    `shape` is the shape of a field. Cells and nodes have the shape of the grid of cells or nodes;
    faces and edges are ONE flat array, component after component (x, then y, then z), each
    component in C order with shape `parts[axis]`.

    Raises
    ------
    ShapeError
        If the shape has an entry that is not a whole number >= 0.

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

    def __init__(self, shape, kind="space", grid=None, parts=None):
        entries = whole_lengths(sum(map(prod, parts)) if shape is None else shape)
        if entries is None:
            raise ShapeError(f"a space needs whole lengths >= 0, got {shape}; write Space(7) or Space((2, 3))")
        super().__init__(shape=entries, kind=kind, grid=grid, parts=(entries,) if parts is None else tuple(parts))

    @cached_property
    def size(self):
        """Count of numbers in a field."""
        return prod(self.shape)

    @cached_property
    def offsets(self):
        """Where each component starts in the flat array, and where the last one ends."""
        return (0, *accumulate(map(prod, self.parts)))

    @cached_property
    def backend(self):
        """Where the fields are stored."""
        return NUMPY if self.grid is None else self.grid.backend

    @cached_property
    def volumes(self):
        """Control volume of each value [length^dim]; ones in a space without a grid."""
        return self.backend.volumes(self)

    def array_of_volumes(self):
        """Return the control volumes as one array: see `volumes`."""
        if self.grid is None:
            return np.ones(self.shape)
        with np.errstate(over="ignore"):  # what overflows is refused
            lengths = (self.grid.control_lengths(self.kind, axis) for axis in range(len(self.parts)))
            flat = [reduce(np.multiply.outer, lines).ravel() for lines in lengths]
        volumes = np.concatenate(flat).reshape(self.shape)
        check_finite("volumes of a grid", volumes, advice="; its spacing is too large, rescale its lengths")
        volumes.flags.writeable = False
        return volumes

    def component(self, axis):
        """The space of one component of faces or edges, such as x-faces.

        Parameters
        ----------
        axis : int or "x", "y", "z"

        Returns
        -------
        Space
            Its fields have the shape `parts[axis]`, as those that `split` gives.

        Raises
        ------
        TypeError
            If the space is not that of faces or edges of a grid.
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
        axis = self.grid.axis(axis)
        return Space(self.parts[axis], f"{self.grid.axes[axis]}-{self.kind}", self.grid)

    def split(self, v):
        """Flat field -> tuple of its components, each of shape `parts[axis]`. Differentiable.

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

    def split_array(self, v):
        """Return the components of an array, traced or not: see `split`."""
        check_plain("split", v)
        if len(self.parts) == 1:
            return (anp.reshape(v, self.parts[0]),)
        return tuple(components(anp.reshape(v, (-1,)), self.parts))

    def join(self, *parts):
        """Components -> one field of shape `shape`. Differentiable; inverse of `split`.

        Parameters
        ----------
        *parts : arrays that can be broadcast to the shapes in `self.parts`
            Or that differ from them by axes of length 1 only, as the values along one wall.

        Returns
        -------
        array

        Raises
        ------
        ShapeError
            If the number of components or a shape does not fit.
        """
        if len(parts) != len(self.parts):
            shapes = ", ".join(map(str, self.parts)) or "none"
            raise ShapeError(
                f"join on {self} takes {len(self.parts)} components, got {len(parts)}; their shapes are {shapes}"
            )
        check_plain("join", *parts)
        return self.backend.join(self, parts)

    def join_arrays(self, parts):
        """Return one array of its components, traced or not: see `join`."""
        numpy = anp if any(map(isbox, parts)) else np  # the same, without the tape
        if len(parts) == 0:  # as of walls in a periodic box
            return np.zeros(self.shape)
        flat = [numpy.reshape(_broadcast(self, part, shape), (-1,)) for part, shape in zip(parts, self.parts)]
        return numpy.reshape(numpy.concatenate(flat), self.shape)

    @cached_property
    def _key(self):
        return self.shape, self.kind, self.grid

    def __str__(self):
        shape = self.grid.shape if self.grid is not None else self.shape
        return f"{self.kind}({', '.join(map(str, shape))})"

    __repr__ = __str__

    @property
    def described(self):
        """Its name for messages, with the shape of a field where the name does not show it: faces are flat."""
        shape = self.shape if self.grid is None else self.grid.shape
        return str(self) if shape == self.shape else f"{self} of shape {self.shape}"


def components(flat, parts):
    """Flat field, traced or not -> its components, of these shapes."""
    ends = accumulate(map(prod, parts))
    return [flat[end - prod(part) : end].reshape(part) for end, part in zip(ends, parts)]


def whole_lengths(shape):
    """A length or a sequence of them -> tuple of int, or None where one is no whole number >= 0."""
    shape = (shape,) if np.ndim(shape) == 0 else tuple(shape)
    whole = all(isinstance(n, (int, np.integer)) and not isinstance(n, bool) and n >= 0 for n in shape)
    return tuple(map(int, shape)) if whole else None


def fits(one, other):
    """Whether two spaces hold the same fields: equal, or of one size when one has no grid."""
    if one.grid is None or other.grid is None:
        return one.size == other.size
    return one == other


def _broadcast(space, part, shape):
    """As many numbers as the shape has, in the order of C."""
    if [n for n in np.shape(part) if n != 1] == [n for n in shape if n != 1]:
        return part
    try:
        np.broadcast_shapes(np.shape(part), shape)
        # autograd cannot broadcast_to into more dimensions; a product with ones can.
        return part * np.ones(shape, dtype_of(part)) if isbox(part) else np.broadcast_to(part, shape)
    except ValueError:
        raise ShapeError(f"join on {space} needs components {space.parts}, got one of shape {np.shape(part)}") from None
