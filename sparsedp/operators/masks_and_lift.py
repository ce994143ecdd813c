"""Operators for boundary values, masks and pointwise multiplication: lift, mask, interior, identity, diagonal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.base_classes import Reconstructible
from sparsedp._utils.validation import check_finite, check_kind, check_on, check_plain, check_type
from sparsedp.autodiff.tape import isbox, sample
from sparsedp.errors import DerivativeError, ShapeError
from sparsedp.grid.boundary_conditions import SIDES, MixedWall, describe_patches, resolve, walls_of
from sparsedp.grid.grid import Grid, check_grid
from sparsedp.grid.space import Space
from sparsedp.operators.operator import Operator
from sparsedp.operators.stencils import along, check_order, kronecker_operator, wall_slope_terms, wall_slopes_4
from sparsedp.operators.structure.kronecker import Kronecker
from sparsedp.operators.structure.lazy import Diagonal, Mask

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["diagonal", "identity", "interior", "lift", "mask"]


def lift(grid: Grid, boundary: Any, order: int = 2) -> Operator:
    """Return the operator B that adds nonzero boundary values to a gradient G: the gradient is G(u) + B(values).

    Parameters
    ----------
    grid : Grid
    boundary : condition, or dict of conditions
        The conditions that G was built with. The boundary values are u [unit] for dirichlet, du/dn [unit / length] for
        neumann, and the right-hand side of a u + b du/dn = value for robin. On a wall with a `patch`, the value of
        each face belongs to the condition of this face.
    order : 2 or 4
        The order of G.

    Returns
    -------
    Operator
        in: one flat array of the values on all walls, in the order lower x, upper x, lower y, ... without periodic
        axes; out: faces [unit / length]. ``op.domain.join(...)`` builds the flat array. Its arguments are one array or
        number for each wall; in 2-D the array has one entry for each cell along the wall. For a wall with a patch, it
        takes an array, such as ``patch.values(grid, "x", 1.0)``, or 0.

    Raises
    ------
    ValueError
        If `boundary` names a periodic axis, or the grid does not allow the order. On use of ``join``, if a wall with a
        patch gets a number other than 0.

    See Also
    --------
    gradient, laplacian, upwind, face_lift, dirichlet, neumann, robin, patch

    Notes
    -----
    The equation -D (G u + B v) = b with boundary values v is solved by ``solve(b + D(B(v)))``, where
    ``solve = inverse(-D @ G)``. With a coefficient k and an `elliptic_solver`, it is ``solve(k, b + D(k * B(v)))``.

    Examples
    --------
    >>> from sparsedp import Grid, dirichlet
    >>> lift(Grid(3), dirichlet)(np.array([1.0, 5.0]))
    array([-2.,  0.,  0., 10.])

    `upwind` takes the slope of a cell from its upstream face, so that the boundary values are added on these faces.
    The following solves du/dx = 1 with u = 2 at the lower end:

    >>> from sparsedp import inverse, neumann, upwind
    >>> grid, sides = Grid(4, size=1.0), {"x": (dirichlet, neumann)}
    >>> B = lift(grid, sides)
    >>> x_faces = grid.split(B(B.domain.join(2.0, 0.0)))[0]
    >>> inverse(upwind(grid, "x", 1, sides))(np.ones(4) - x_faces[:-1])
    array([2.125, 2.375, 2.625, 2.875])
    """
    parts: list[tuple[int, ...]] = []
    blocks = {}
    check_order("lift", grid, order)
    sides = resolve(grid, boundary, patches=order == 2, name="lift with order=4")
    for axis, side, wall in walls_of(sides):
        if order == 2:
            terms = wall_slope_terms(grid, axis, side, wall)
        else:
            terms = along(axis, grid.dim, wall_slopes_4(grid, axis, side, wall))
        blocks[axis, len(parts)] = terms
        parts.append(tuple(1 if a == axis else n for a, n in enumerate(grid.shape)))
    mixed = {}
    for number, (axis, side, wall) in enumerate(walls_of(sides)):
        if isinstance(wall, MixedWall):
            mixed[number] = f"{grid.axes[axis]}-{SIDES[side]}"
    if mixed:
        walls: Space = MixedWalls(grid, parts, mixed)
    else:
        walls = Space(None, "walls", grid, parts)
    return kronecker_operator(walls, grid.faces, blocks, f"lift{describe_patches(sides)}")


class MixedWalls(Space):
    """The space of values on walls of which some have several conditions.

    Parameters
    ----------
    grid : Grid
    parts : list of tuple of int
        Shapes of the walls.
    mixed : dict
        Maps the numbers of the walls with several conditions to their names.
    """

    mixed: dict[int, str]

    def __init__(self, grid: Grid, parts: list[tuple[int, ...]], mixed: dict[int, str]) -> None:
        super().__init__(None, "walls", grid, parts)
        self.__dict__["mixed"] = mixed

    def join(self, *parts: Any) -> Any:
        """Return one field of the values on all walls; see `Space.join`.

        Raises
        ------
        ValueError
            If a number other than 0 is given for a wall with several conditions: it would be a value on one part of the
            wall and a slope on another.
        """
        if len(parts) == len(self.parts):
            for number, name in self.mixed.items():
                part = parts[number]
                if np.size(sample(part)) == 1 and (isbox(part) or np.any(part != 0)):
                    raise ValueError(
                        f"{name} has several conditions, and one number does not say which of them it belongs to; "
                        f"write patch.values(grid, {name[0]!r}, number), or one entry for each face"
                    )
        return super().join(*parts)


def mask(space: Space, keep: ArrayLike) -> Operator:
    """Return the operator that sets a field to 0 where `keep` is False, even if the field is NaN or infinite there.

    Parameters
    ----------
    space : Space
    keep : bool array, shape `space.shape`

    Returns
    -------
    Operator

    Raises
    ------
    ShapeError
        If `keep` has another shape.
    TypeError
        If `space` is not a Space, or `keep` is not boolean.

    See Also
    --------
    interior, diagonal, identity

    Examples
    --------
    >>> from sparsedp import Grid
    >>> mask(Grid(3).cells, np.array([True, False, True]))(np.array([1.0, np.nan, 3.0]))
    array([1., 0., 3.])
    """
    _check_space(space, "mask")
    return Operator(Mask(_boolean(keep, space, "keep")), space, space, "mask")


def interior(grid: Grid, solid: ArrayLike | None = None) -> Operator:
    """Return the operator that sets a face field to 0 on walls and on all faces of solid cells.

    Parameters
    ----------
    grid : Grid
    solid : bool array, shape `grid.shape`, optional

    Returns
    -------
    Operator

    Raises
    ------
    ShapeError
        If `solid` has another shape than the grid.

    See Also
    --------
    mask, free_faces

    Examples
    --------
    >>> from sparsedp import Grid
    >>> interior(Grid(3))(np.ones(4))
    array([0., 1., 1., 0.])
    """
    check_grid("interior", grid)
    below, above = solid_faces(grid, ~check_solid(grid, solid))
    return Operator(Mask(below & above), grid.faces, grid.faces, "interior")


def identity(space: Space) -> Operator:
    """Return the identity operator on a space. Its result is a copy of the field.

    Parameters
    ----------
    space : Space

    Returns
    -------
    Operator

    Raises
    ------
    TypeError
        If `space` is not a Space.

    See Also
    --------
    mask, diagonal

    Examples
    --------
    >>> from sparsedp import Grid
    >>> identity(Grid(2).cells)(np.array([1.0, 2.0]))
    array([1., 2.])
    """
    _check_space(space, "identity")
    parts = space.parts if space.grid is not None else ((space.size,),)
    return Operator(Kronecker.identity(parts), space, space, "identity")


def diagonal(space: Space, values: ArrayLike) -> Operator:
    """Return the operator that multiplies a field elementwise by constant values.

    Parameters
    ----------
    space : Space
    values : array that broadcasts to `space.shape`

    Returns
    -------
    Operator

    Raises
    ------
    ShapeError
        If the values cannot be broadcast to `space.shape`.
    NonFiniteError
        If a value is NaN or infinite.
    TypeError
        If `space` is not a Space, or the values are not numbers.
    DerivativeError
        If autograd traces the values, because an Operator is constant; write ``values * u`` instead.

    See Also
    --------
    mask, identity, laplace

    Notes
    -----
    For complex values see docs/guides/complex_numbers.md.

    Examples
    --------
    >>> from sparsedp import Grid
    >>> diagonal(Grid(2).cells, np.array([2.0, 3.0]))(np.array([1.0, 1.0]))
    array([2., 3.])
    """
    if isbox(values):
        raise DerivativeError(
            "diagonal needs constant values, got traced ones; write values * u instead, and to solve a system with "
            "them dp.implicit(residual)"
        )
    _check_space(space, "diagonal")
    check_plain("diagonal", values)
    values = np.asarray(values)
    check_kind(f"diagonal on {space}", values.dtype, "numbers", "; write values.astype(float)")
    try:
        values = np.broadcast_to(values, space.shape)
    except ValueError:
        raise ShapeError(f"diagonal on {space} needs values of shape {space.shape}, got {np.shape(values)}") from None
    check_finite(f"diagonal on {space}", values, "needs finite values")
    return Operator(Diagonal(values), space, space, "diagonal")


def _check_space(space, name):
    """Raise TypeError if an argument is not a Space."""
    check_type(name, space, Space, "a Space", "grid.cells or grid.faces")


class Body(Reconstructible):
    """Base class of bodies with a wall that cuts the cells, which some functions accept in place of solid cells.

    Attributes
    ----------
    grid : Grid
    boundary, solid_boundary
        The conditions on the walls of the grid and on the wall of the body.
    laplacian : Operator
    """

    grid: Grid
    boundary: Any
    solid_boundary: Any
    laplacian: Any


def refuse_body(name: str, solid: Any, advice: str) -> None:
    """Raise TypeError if the argument `solid` of a function is a body of `cut_cells`, which it does not take."""
    if isinstance(solid, Body):
        raise TypeError(f"{name} takes a boolean array as solid, got a body of cut_cells; write {advice}")


def check_solid(grid: Grid, solid: ArrayLike | None) -> NDArray:
    """Return the argument `solid` as a boolean array of the shape of the grid; None means no solid cells."""
    if solid is None:
        return np.zeros(grid.shape, bool)
    refuse_body("this function", solid, "solid=~body.is_fluid for a staircase, or use the methods of the body")
    return _boolean(solid, grid.cells, "solid")


def _boolean(flags, space, name):
    """Return an argument as a boolean array of the shape of a space; raise if it is anything else."""
    if isbox(flags):
        raise DerivativeError(f"{name} needs a constant boolean array, got a traced one; take it from plain numbers")
    flags = np.asarray(flags)
    check_kind(name, flags.dtype, "True or False", f"; write {name}.astype(bool)")
    check_on(name, flags, space)
    return flags


def region_of(grid: Grid, cells: Any) -> NDArray:
    """Return a boolean array of cells, given one slice for each axis or a boolean array."""
    if not isinstance(cells, (slice, tuple)):
        return _boolean(cells, grid.cells, "cells")
    box = cells if isinstance(cells, tuple) else (cells,)
    if len(box) != grid.dim or not all(map(_is_run, box)):
        raise ValueError(
            f"a box on {grid} needs one slice of cells for each axis, got {cells}; write (slice(4, 8), slice(2, 6))"
        )
    region = np.zeros(grid.shape, dtype=bool)
    region[box] = True
    return region


def _is_run(side):
    """Return whether an entry is a slice with step 1 and integer (or no) ends."""
    if not isinstance(side, slice) or side.step not in (None, 1):
        return False
    return all(end is None or hasattr(end, "__index__") for end in (side.start, side.stop))


def solid_faces(grid: Grid, solid: NDArray) -> tuple[NDArray, NDArray]:
    """Return for each face whether its lower cell and whether its upper cell is solid.

    Parameters
    ----------
    grid : Grid
    solid : bool array, shape `grid.shape`

    Returns
    -------
    below, above : bool arrays, shape (faces.size,)
        False on the outer side of a wall, where there is no cell.
    """
    below = []
    above = []
    for axis in range(grid.dim):
        if grid.periodic[axis]:
            below.append(np.roll(solid, 1, axis).ravel())
            above.append(solid.ravel())
        else:
            pad = [(0, 0)] * grid.dim
            pad[axis] = (1, 0)
            below.append(np.pad(solid, pad).ravel())
            above.append(np.pad(solid, [side[::-1] for side in pad]).ravel())
    return np.concatenate(below), np.concatenate(above)
