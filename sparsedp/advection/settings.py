"""The settings of a transport step, and the positions of its arguments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sparsedp._utils.validation import place
from sparsedp.grid.boundary_conditions import MixedWall, dirichlet, mixed_wall, neumann, points_touching
from sparsedp.grid.space import Space
from sparsedp.operators.masks_and_lift import solid_faces

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.grid.grid import Grid

__all__ = ["FIELD", "INFLOW", "STEP", "VELOCITY", "TransportSettings", "wall_space"]

FIELD, VELOCITY, STEP, INFLOW = range(4)


@dataclass(frozen=True, eq=False)
class TransportSettings:
    """The checked arguments of `transport`.

    Attributes
    ----------
    grid : Grid
    scheme : str
    sides : tuple
        For each axis the conditions of its lower and its upper side, or None where the axis is periodic.
    velocity, of : "faces" or "cells"
        Whether the velocity and the transported field are given on faces or in cells.
    interpolation : "linear" or "cubic"
    form : "flux", "advective" or None
        None for schemes without this option.
    backtrace : "euler" or "midpoint"
    clamp : bool
    solid : bool array, shape ``grid.shape``, or None
    unstable : "raise" or "allow"
    """

    grid: Grid
    scheme: str
    sides: tuple
    velocity: str
    of: str
    interpolation: str
    form: str | None
    backtrace: str
    clamp: bool
    solid: NDArray[np.bool_] | None
    unstable: str

    def sides_of(self, number: int) -> tuple:
        """Return the conditions in the form of `sides`, for the points of a component of the field.

        On a wall with several conditions, a point that lies between two faces has inflow if one of them has it.
        """
        if self.of == "cells":
            return self.sides
        return tuple(
            pair and tuple(self._at_points(wall, axis, number) for wall in pair) for axis, pair in enumerate(self.sides)
        )

    def _at_points(self, wall, axis, number):
        """Return the condition of the points of a component of faces at a wall, or a MixedWall of the points."""
        if not isinstance(wall, MixedWall) or axis == number:
            return wall
        has_inflow = points_touching(self.grid, wall, axis, number, lambda condition: condition == dirichlet)
        return mixed_wall([(dirichlet, has_inflow), (neumann, ~has_inflow)])

    @property
    def space(self) -> Space:
        """Space of the transported field."""
        if self.of == "cells":
            return self.grid.cells
        return self.grid.faces

    @property
    def solid_points(self) -> NDArray[np.bool_] | None:
        """Flat mask of the points of the field inside the solid; None if there is no solid."""
        if self.solid is None:
            return None
        if self.of == "cells":
            return self.solid.ravel()
        return np.logical_or(*solid_faces(self.grid, self.solid))

    @property
    def at_points(self) -> bool:
        """Whether the scheme needs the velocity at the points of the field, not on the sides of control volumes."""
        return self.form is None or (self.form, self.velocity) == ("advective", "cells")

    @property
    def velocity_shapes(self) -> tuple[tuple[int, ...], ...]:
        """Accepted shapes of the velocity."""
        shape = self.grid.shape
        if self.velocity == "faces":
            return (self.grid.faces.shape,)
        if len(shape) == 1:
            return ((1, *shape), shape)
        return ((len(shape), *shape),)

    def velocity_place(self, index: int) -> str:
        """Return the text of the index of an entry of the velocity, in the shape that the user passed."""
        return place(index, self.velocity_shapes[-1])

    def field_place(self, index: int) -> str:
        """Return the text of the index of an entry of the field, for a face field with the name of the component."""
        offsets = self.space.offsets
        component = int(np.searchsorted(offsets, index, "right")) - 1
        text = place(index - offsets[component], self.space.parts[component])
        if self.of == "faces":
            return f"{text} of the {self.grid.axes[component]}-faces"
        return text


def wall_space(settings: TransportSettings) -> Space:
    """Return the space of the inflow values, one value for each point of the field at a wall.

    The parts are ordered x-lower, x-upper, y-lower, ..., for each component of the field in turn.
    """
    parts = []
    for shape in settings.space.parts:
        for axis, sides in enumerate(settings.sides):
            wall_shape = tuple(1 if a == axis else n for a, n in enumerate(shape))
            parts += [wall_shape] * len(sides or ())
    return Space(None, "walls", settings.grid, parts)
