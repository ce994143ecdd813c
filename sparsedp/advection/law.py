"""What a scheme must offer: plain functions of flat arrays, from which `front` makes one rule of the tape.

Every array that a law gets is flat, contiguous, finite-or-not float64, and none of its business to check
but for what it finds on the way: `u` of `space.size` numbers, `v` of the velocity as the user gave it,
`dt` a float > 0, `inflow` of `walls.size` numbers. Arguments are numbered 0 to 3 in that order.
"""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from sparsedp._utils.validation import place
from sparsedp.advection.velocities import interpolation
from sparsedp.grid.space import Space
from sparsedp.operators.masks_and_lift import solid_faces

__all__ = ["FIELD", "INFLOW", "STEP", "VELOCITY", "Law", "Setting"]

FIELD, VELOCITY, STEP, INFLOW = range(4)


class Setting(NamedTuple):
    """The checked arguments of `transport`."""

    grid: Any
    scheme: str
    sides: tuple  # for each axis (lower, upper) conditions, or None where it is periodic
    velocity: str
    of: str
    interpolation: str
    form: str | None  # None where the scheme has none
    backtrace: str
    clamp: bool
    solid: Any  # boolean array of the shape of the grid, or None
    unstable: str

    @property
    def space(self):
        """Where the moved field lives."""
        return self.grid.cells if self.of == "cells" else self.grid.faces

    @property
    def solid_points(self):
        """Flat mask of the points of the field that are in a solid; None where there is none."""
        if self.solid is None or self.of == "cells":
            return None if self.solid is None else self.solid.ravel()
        return np.logical_or(*solid_faces(self.grid, self.solid))

    @property
    def at_points(self):
        """Whether the scheme needs the velocity at the points of the field; else on the sides of control volumes."""
        return self.form is None or (self.form, self.velocity) == ("advective", "cells")

    @property
    def velocity_shapes(self):
        """The shapes that a velocity may have."""
        shape = self.grid.shape
        if self.velocity == "faces":
            return (self.grid.faces.shape,)
        return ((1, *shape), shape) if len(shape) == 1 else ((len(shape), *shape),)

    def velocity_place(self, index):
        """Number of an entry of the velocity -> its index as the user sees it."""
        return place(index, self.velocity_shapes[-1])


class Law:
    """Base of the schemes. A subclass sets the flags and has these methods:

    ``forward(u, v, dt, inflow)``
        The moved field.
    ``vjp(nums, g, u, v, dt, inflow)``
        Cotangent of the result -> a tuple of those of the arguments `nums`, nothing else computed, and whether they are
        known to be finite. dt is not asked for: a step depends on v dt alone, and `rule` derives it from v.
    ``jvp(tangents, u, v, dt, inflow)``
        {number of an argument: tangent} -> tangent of the result; dt as above.
    ``matrix(v, dt)``
        csr_array of the step in `u`, inflow 0; only where `linear`.

    Attributes
    ----------
    setting : Setting
    walls : Space
        Where inflow values live: one part for each wall of each component, x-lower, x-upper, y-lower, ...
    options : tuple of str
        The options of `transport` that the scheme uses.
    linear : bool
        Whether the step is linear in (u, inflow).
    adds : bool
        Whether `vjp` takes one argument more: an array to which it adds the cotangent of the velocity, to return it.
    twice : bool
        Whether `vjp` and `jvp` take traced values too, so that derivatives of every order follow.
    """

    options: tuple[str, ...] = ("form", "unstable")
    linear = False
    twice = False
    adds = False
    forward: Any
    vjp: Any
    jvp: Any
    matrix: Any

    def __init__(self, setting):
        self.setting = setting
        self.name = f"transport {setting.scheme}"
        self.field_shapes, self.velocity_shapes = (setting.space.shape,), setting.velocity_shapes
        self.walls = wall_space(setting)

    @cached_property
    def between(self):
        """Operator from the velocity as given to where the scheme needs it; None where that is the same."""
        return interpolation(self.setting)

    def velocity(self, v):
        """Velocity as given -> that where the scheme needs it, axis by axis for each component; linear."""
        return v if self.between is None else self.between.apply(v)

    def velocity_vjp(self, g):
        """Its transpose."""
        return g if self.between is None else self.between.T.apply(g)


def wall_space(setting):
    """Space of the inflow values: one number for each place of the field that touches a wall."""
    parts = [
        tuple(1 if a == axis else n for a, n in enumerate(shape))
        for shape in setting.space.parts
        for axis, sides in enumerate(setting.sides)
        for _ in sides or ()
    ]
    return Space(None, "walls", setting.grid, parts)
