"""Base class of the transport schemes, whose plain functions of flat arrays `rule` makes differentiable."""

from __future__ import annotations

from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from sparsedp.advection.arguments import check_numbers
from sparsedp.advection.settings import FIELD, INFLOW, VELOCITY, TransportSettings, wall_space
from sparsedp.advection.velocity_interpolation import velocity_interpolation

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from sparsedp.operators.operator import Operator

__all__ = ["Identity", "TransportMethod"]


class TransportMethod:
    """Base class of the transport schemes: plain functions of flat arrays.

    A subclass sets the flags and defines

    ``forward(u, v, dt, inflow)``
        Return the field after one step.
    ``vjp(nums, g, u, v, dt, inflow)``
        Return a tuple of the cotangents of the arguments whose positions are in `nums`, for the cotangent g of the
        result, and whether these cotangents are known to be finite. Other cotangents are not computed.
    ``jvp(tangents, u, v, dt, inflow)``
        Return the tangent of the result; `tangents` is a dict {position of the argument: tangent}.
    ``matrix(v, dt)``
        Return the step as a csr_array that is applied to `u`, for an inflow of 0; only if `linear`.

    All arrays are flat, contiguous and of dtype float64. They may contain NaN and infinity, which the methods must
    detect themselves. `u` has ``settings.space.size`` entries, `v` is the velocity that the user passed, flattened,
    ``dt > 0`` is a float and `inflow` has ``walls.size`` entries.

    A step depends only on the product of velocity and dt. `vjp` and `jvp` are therefore never called for a derivative
    in dt: `rule` computes it from the derivative in the velocity.

    Parameters
    ----------
    settings : TransportSettings

    Attributes
    ----------
    walls : Space
        Space of the inflow values; see `wall_space`.
    options : tuple of str
        Options of `transport` that the scheme uses.
    linear : bool
        Whether the step is linear in (u, inflow).
    accumulates : bool
        Whether `vjp` has an additional argument `velocity_sum`, an array or None. If it is an array, `vjp` adds the
        cotangent of the velocity to it in place, and returns this array as the cotangent.
    any_order : bool
        Whether `vjp` and `jvp` accept traced values, so that derivatives of every order exist.
    """

    options: tuple[str, ...] = ("form", "unstable")
    linear: bool = False
    any_order: bool = False
    accumulates: bool = False
    forward: Any
    vjp: Any
    jvp: Any
    matrix: Any

    def __init__(self, settings: TransportSettings) -> None:
        self.settings = settings
        self.name = f"transport {settings.scheme}"
        self.field_shapes = (settings.space.shape,)
        self.velocity_shapes = settings.velocity_shapes
        self.walls = wall_space(settings)

    @cached_property
    def interpolation(self) -> Operator | None:
        """Operator that interpolates the velocity to where the scheme needs it; None if it is given there."""
        return velocity_interpolation(self.settings)

    def bound_forward(self) -> Callable[..., NDArray]:
        """Return a function that returns what `forward` returns; a subclass may return one with less overhead."""
        return self.forward

    def bound_vjp(self, nums: Sequence[int]) -> Callable[..., tuple[Sequence[Any], bool]]:
        """Return a function ``pull(g, u, v, dt, inflow)`` that returns what `vjp` returns, see `bound_forward`."""
        return partial(self.vjp, nums)

    def interpolate_velocity(self, v: NDArray) -> NDArray:
        """Return the velocity where the scheme needs it, axis by axis for each component of the field."""
        if self.interpolation is None:
            return v
        return self.interpolation.apply(v)

    def interpolate_velocity_vjp(self, g: NDArray) -> NDArray:
        """Return the product of the transpose of `interpolate_velocity` with a cotangent."""
        if self.interpolation is None:
            return g
        return self.interpolation.T.apply(g)


class Identity(TransportMethod):
    """The method that replaces every scheme on a grid without cells: a step returns a copy of the field."""

    linear = True
    any_order = True

    def forward(self, u: NDArray, v: NDArray, dt: float, inflow: NDArray) -> NDArray:
        """Return a copy of the field."""
        check_numbers(self.settings, u, v, inflow)
        return u + 0.0

    def vjp(
        self,
        nums: Sequence[int],
        g: Any,
        u: Any,
        v: Any,
        dt: Any,
        inflow: Any,
        velocity_sum: NDArray | None = None,
    ) -> tuple[tuple[Any, ...], bool]:
        """Return the cotangents: a copy of g for the field, zeros for the others."""
        cotangents = {FIELD: g + 0.0, VELOCITY: np.zeros(np.shape(v)), INFLOW: np.zeros(np.shape(inflow))}
        return tuple(cotangents[num] for num in nums), True

    def jvp(self, tangents: Mapping[int, Any], u: Any, v: Any, dt: Any, inflow: Any) -> Any:
        """Return the tangent of the field."""
        return tangents.get(FIELD, np.zeros(np.shape(u))) + 0.0

    def matrix(self, v: NDArray, dt: float) -> sp.csr_array:
        """Return the identity matrix."""
        return sp.csr_array(sp.eye_array(self.settings.space.size, format="csr"))
