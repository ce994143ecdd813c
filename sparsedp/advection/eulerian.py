r"""Eulerian schemes, which sum fluxes through the sides of control volumes: upwind, van Leer, others in `SCHEMES`.

Upwind (donor cell), first order: the value at a side is the value of the upstream point.

Van Leer, second order where the field is smooth: let A and B be the differences of u to the points below and above,
q = A / (A + B), h the width, d the distances to both neighbours, c = 2 d_below / h and e = 2 d_above / h. If A and B
have the same sign, the value at a side differs from the value at the upstream point by

    s = (A + B) R(q),   R = q (1 - q) (q e^2 + (1 - q) c^2) / (q^2 e^2 + (c + e - 2) c e q (1 - q) + (1 - q)^2 c^2)

(for equal cells A B / (A + B), half the harmonic mean); otherwise s = 0. The result of a step is the mean of the old
field and the result of two Euler steps (SSP-RK2). If the CFL number of every point (see `transport`) is at most 1/2, no
new extrema arise (TVD in 1-D). Derivatives at kinks: if one of A and B is 0, the derivative of s is the mean of
both one-sided derivatives, and if both are 0, it is 0. The derivative in a velocity of 0 is also the mean.

The compiled loops of `sparsedp.kernels.fluxes` compute a step and its cotangents. `SparseReference` replaces them if
numba is not available or a value is traced; it also computes tangents and matrices.

References
----------
R. Courant, E. Isaacson, M. Rees, Comm. Pure Appl. Math. 5 (1952) 243-255 (upwind).
B. van Leer, J. Comput. Phys. 32 (1979) 101-136 (limiter and slopes).
A. Mignone, J. Comput. Phys. 270 (2014) 784-814 (stretched grids).
S. Gottlieb, C.-W. Shu, Math. Comp. 67 (1998) 73-85 (stages).
"""

from __future__ import annotations

from functools import cached_property
from math import isfinite, prod
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from sparsedp import kernels
from sparsedp._utils import buffers
from sparsedp._utils.validation import check_finite
from sparsedp.advection.arguments import ROUNDING, check_numbers, check_stability
from sparsedp.advection.method import TransportMethod
from sparsedp.advection.settings import FIELD, INFLOW, VELOCITY
from sparsedp.advection.sparse_reference import SparseReference
from sparsedp.autodiff.tape import isbox
from sparsedp.kernels import fluxes
from sparsedp.kernels.fluxes import SCHEMES

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from sparsedp.advection.control_volumes import Component
    from sparsedp.advection.settings import TransportSettings

__all__ = ["Eulerian"]

EMPTY = np.zeros(0)  # stands for a result that is not requested
EULER = (0.0,)  # the stages of a scheme whose step is one Euler step


class Eulerian(TransportMethod):
    """A scheme of `SCHEMES`: a limiter for the values at the sides of cells, and the stages of a step."""

    def __init__(self, settings: TransportSettings) -> None:
        super().__init__(settings)
        self.scheme = SCHEMES[settings.scheme]
        first_order = self.scheme.limiter is None
        self.linear = first_order
        self.any_order = first_order
        self.accumulates = self.interpolation is None and _has_compiled_loops()
        self._new_field = buffers.allocator((settings.space.size,))
        if self.interpolation is None:
            velocities = prod(self.velocity_shapes[0])
        else:
            velocities = self.interpolation.codomain.size
        self._new_velocity = buffers.allocator((velocities,))

    @cached_property
    def reference(self) -> SparseReference:
        """The same scheme implemented by sparse matrices."""
        return SparseReference(self.settings, self.scheme, self.walls.size, self.interpolation)

    @cached_property
    def _loops(self) -> CompiledLoops:
        return CompiledLoops(self.reference)

    def forward(self, u: NDArray, v: NDArray, dt: float, inflow: NDArray) -> NDArray:
        """Return the field after one step."""
        if _has_compiled_loops():
            w = self.interpolate_velocity(v)
            out = u
            invalid = 0.0
            for keep in self.scheme.stages:
                x = out
                out = self._new_field()
                beyond = self._values_beyond_walls(x, inflow)
                slopes = self._loops.slopes(x, beyond, partials=False)
                invalid += self._loops.stage(x, slopes, w, dt, beyond, u, keep, out)
            must_check = invalid or not isfinite(self._unread_sum(v, inflow))
        else:
            with np.errstate(all="ignore"):
                out = self.reference.step(u, v, dt, inflow)
            must_check = True
        if must_check:
            check_numbers(self.settings, u, v, inflow)
            check_stability(self.settings, dt, self.reference.rate(v), self.scheme.max_courant)
            check_finite(self.name, out.reshape(self.settings.space.shape), "cannot represent the result")
        return out

    @cached_property
    def _is_one_loop(self) -> bool:
        """Whether a step, and its VJP, is one call of a compiled loop."""
        is_simple = self.scheme.stages == EULER and self.interpolation is None and self.settings.solid is None
        return is_simple and len(self.settings.space.parts) == 1 and not self._repeated[0].size

    def bound_forward(self) -> Callable[..., NDArray]:
        """Return a function that returns what `forward` returns, with less overhead."""
        forward = self.forward
        if not _has_compiled_loops() or not self._is_one_loop:
            return forward
        new_field = self._new_field
        stage = self._loops.stages[0]
        slopes = self._loops.no_slopes[0][0]

        def one_loop(u, v, dt, inflow):
            out = new_field()
            invalid = stage(u, slopes, v, dt, inflow, u, 0.0, out)
            if invalid or (inflow.size and not isfinite(inflow.sum())):
                return forward(u, v, dt, inflow)  # raises an error, or finds that the sum overflows
            return out

        return one_loop

    def bound_vjp(self, nums: Sequence[int]) -> Callable[..., tuple[Sequence[Any], bool]]:
        """Return a function that returns what `vjp` returns, with less overhead."""
        if not _has_compiled_loops() or not self._is_one_loop or not {FIELD, VELOCITY} >= set(nums):
            return super().bound_vjp(nums)
        new_arrays = [{FIELD: self._new_field, VELOCITY: self._new_velocity}[num] for num in nums]
        field_place = nums.index(FIELD) if FIELD in nums else None
        velocity_place = nums.index(VELOCITY) if VELOCITY in nums else None
        vjp = self._loops.vjps[0]
        slopes, partials = self._loops.no_slopes[0]

        def one_loop(g, u, v, dt, inflow):
            cotangents = [new() for new in new_arrays]
            of_u = EMPTY if field_place is None else cotangents[field_place]
            of_w = EMPTY if velocity_place is None else cotangents[velocity_place]
            if not g.flags.c_contiguous:
                g = np.ascontiguousarray(g)
            of_inflow = np.zeros(inflow.size)
            invalid = vjp(g, u, slopes, partials, v, dt, inflow, of_u, of_inflow, of_w, True)
            return cotangents, not invalid and (not inflow.size or isfinite(of_inflow.sum()))

        return one_loop

    @cached_property
    def _repeated(self) -> tuple[NDArray, NDArray]:
        """The inflow values that stand for the value of a point, and these points; see `Component`."""
        components = self.reference.components
        values = [component.inflow.start + component.repeated[0] for component in components]
        points = [component.field.start + component.repeated[1] for component in components]
        return np.concatenate(values), np.concatenate(points)

    def _values_beyond_walls(self, u: NDArray, inflow: NDArray) -> NDArray:
        """Return the inflow values, replaced by the values of the points on those faces of mixed walls without inflow.

        They depend on the field, so they differ from stage to stage.
        """
        values, points = self._repeated
        if not values.size:
            return inflow
        beyond = inflow.copy()
        beyond[values] = u[points]
        return beyond

    def _unread_sum(self, v: NDArray, inflow: NDArray) -> float:
        """Return the sum of the values that the loops may not read: inflow at closed walls, velocity in the solid.

        The sum is used to detect NaN and infinity among them.
        """
        if inflow.size:
            total = inflow.sum()
        else:
            total = 0.0
        if self.settings.solid is None:
            return total
        return total + v.sum()

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
        """Return the cotangents of the arguments `nums`; see `TransportMethod`."""
        plain_arrays = type(g) is type(u) is type(v) is type(inflow) is np.ndarray
        if not _has_compiled_loops() or not plain_arrays or isbox(dt):
            return self.reference.vjp(nums, g, u, v, dt, inflow), False
        w = self.interpolate_velocity(v)
        of_field_wanted = FIELD in nums or INFLOW in nums
        of_velocity_is_set = velocity_sum is None
        of_velocity = EMPTY
        if VELOCITY in nums:
            if velocity_sum is None:
                of_velocity = self._new_velocity()
            else:
                of_velocity = velocity_sum
        of_field, of_inflow, invalid = self._vjp_of_stages(
            np.ascontiguousarray(g), u, w, dt, inflow, of_velocity, of_field_wanted, of_velocity_is_set
        )
        cotangents: dict[int, Any] = {FIELD: of_field, INFLOW: of_inflow, VELOCITY: None}
        if of_velocity.size:
            cotangents[VELOCITY] = self.interpolate_velocity_vjp(of_velocity)
        # The count of non-finite values in the loops omits the contributions of interpolation and slopes.
        counted = self.accumulates and not (self.scheme.limiter and of_field_wanted) and not self._repeated[0].size
        finite = counted and not invalid and (not of_inflow.size or isfinite(of_inflow.sum()))
        return tuple([cotangents[num] for num in nums]), finite

    def _vjp_of_stages(
        self,
        g: NDArray,
        u: NDArray,
        w: NDArray,
        dt: float,
        inflow: NDArray,
        of_velocity: NDArray,
        of_field_wanted: bool,
        of_velocity_is_set: bool,
    ) -> tuple[NDArray, NDArray, float]:
        """Return the cotangents of u and inflow, and the number of computed cotangents that are not finite.

        `of_velocity` is set to the cotangent of w if `of_velocity_is_set`; otherwise the cotangent is added to it.
        """
        of_inflow = np.zeros(inflow.size)
        repeated, points = self._repeated
        if self.scheme.stages == EULER and not repeated.size:
            of_u = self._new_field() if of_field_wanted else EMPTY
            slopes = self._loops.slopes(u, inflow, partials=True)
            invalid = self._loops.vjp(g, u, slopes, w, dt, inflow, of_u, of_inflow, of_velocity, of_velocity_is_set)
            return of_u, of_inflow, invalid
        stages: list[_Stage] = []
        for keep in self.scheme.stages:
            x = u
            if stages:
                last = stages[-1]
                x = self._new_field()
                self._loops.stage(last.x, last.slopes, w, dt, last.beyond, u, last.keep, x)
            beyond = self._values_beyond_walls(x, inflow)
            stages.append(_Stage(x, self._loops.slopes(x, beyond, partials=True), keep, beyond))
        of_first_field = None  # cotangent of u from its direct use in the means of later stages
        invalid = 0.0
        while stages:
            x, slopes, keep, beyond = stages.pop()
            if keep:
                share = keep * g
                if of_first_field is None:
                    of_first_field = share
                else:
                    of_first_field = of_first_field + share
                g = (1.0 - keep) * g
            if stages or of_field_wanted:
                of_x = self._new_field()
            else:
                of_x = EMPTY
            invalid = self._loops.vjp(g, x, slopes, w, dt, beyond, of_x, of_inflow, of_velocity, of_velocity_is_set)
            if repeated.size:
                if of_x.size:
                    np.add.at(of_x, points, of_inflow[repeated])  # a point in a corner is at several walls
                of_inflow[repeated] = 0.0
            g = of_x
            of_velocity_is_set = False
        if of_first_field is not None and of_field_wanted:
            g += of_first_field
        return g, of_inflow, invalid

    def jvp(self, tangents: Mapping[int, Any], u: Any, v: Any, dt: Any, inflow: Any) -> Any:
        """Return the tangent of the result; see `TransportMethod`."""
        return self.reference.jvp(tangents, u, v, dt, inflow)

    def matrix(self, v: NDArray, dt: float) -> sp.csr_array:
        """Return the matrix of the step, which maps u to the next field for an inflow of 0."""
        check_numbers(self.settings, np.zeros(self.settings.space.size), v, np.zeros(self.walls.size))
        check_stability(self.settings, dt, self.reference.rate(v), self.scheme.max_courant)
        return self.reference.matrix(v, dt)


class _Stage(NamedTuple):
    """A stage of a step: the field x before it, the slopes of x, and the weight of the first field in its mean."""

    x: NDArray
    slopes: list
    keep: float
    beyond: NDArray  # the values beyond walls, in the place of the inflow


def _has_compiled_loops() -> bool:
    """Return whether the compiled loops work on this machine."""
    return kernels.compiled() and fluxes.stage.compiled is not None


class CompiledLoops:
    """Calls the loops of `sparsedp.kernels.fluxes` for all components of a field.

    Parameters
    ----------
    reference : SparseReference
        The same scheme implemented by sparse matrices, which holds the tables of the components.

    Attributes
    ----------
    stages, vjps : lists of callables
        For each component a function that runs the loop `stage`, and one that runs `vjp` and `slope_vjp`.
    no_slopes : list
        For each component the empty slopes of a first-order scheme.
    """

    def __init__(self, reference: SparseReference) -> None:
        self.scheme = reference.scheme
        self.flux_form = reference.flux_form
        self.components = reference.components
        self.slope_loop = fluxes.slope_loops.get(reference.settings.scheme)
        if self.scheme.symmetric:
            self.slopes_per_axis = 1
        else:
            self.slopes_per_axis = 2
        self.least_weight = 1.0 - self.scheme.max_courant - ROUNDING
        self.no_slopes = [self._empty_slopes(component, 0, 0) for component in self.components]
        self.stages = [self._bound_stage(component) for component in self.components]
        self.vjps = [self._bound_vjp(component) for component in self.components]

    def _bound_stage(self, part: Component) -> Callable[..., float]:
        """Return a function that runs the loop `stage` for a component of given fields."""
        run = part.bound(fluxes.stage)
        flux_form = self.flux_form
        least_weight = self.least_weight
        free, table, axes, tiles = part.free, part.table, part.axes, part.tiles

        def stage_of_component(u, slopes, w, dt, inflow, first_field, keep, out):
            invalid = np.empty(tiles)
            run(u, inflow, w, free, slopes, dt, table, axes, flux_form, least_weight, first_field, keep, out, invalid)
            return _sum_of_tiles(invalid)

        if len(self.components) == 1:
            return stage_of_component

        def stage(u, slopes, w, dt, inflow, first_field, keep, out):
            field = part.field
            fields = first_field[field], keep, out[field]
            return stage_of_component(u[field], slopes, w[part.speed], dt, inflow[part.inflow], *fields)

        return stage

    def _bound_vjp(self, part: Component) -> Callable[..., float]:
        """Return a function that runs the loops `vjp` and `slope_vjp` for a component of given fields."""
        run = part.bound(fluxes.vjp)
        run_slope_vjp = part.bound(fluxes.slope_vjp)
        flux_form = self.flux_form
        free, table, axes, tiles = part.free, part.table, part.axes, part.tiles

        def vjp_of_component(g, u, slopes, partials, w, dt, inflow, of_u, of_inflow, of_w, of_w_is_set):
            invalid = np.empty(tiles)
            inputs = u, inflow, w, free, slopes, dt, table, axes, flux_form
            run(g, *inputs, of_u, of_inflow, of_w, of_w_is_set, partials, invalid)
            if partials.size and of_u.size:
                run_slope_vjp(partials, free, axes, of_u, of_inflow)
            return _sum_of_tiles(invalid)

        if len(self.components) == 1:
            return vjp_of_component

        def vjp(g, u, slopes, partials, w, dt, inflow, of_u, of_inflow, of_w, of_w_is_set):
            field, walls, speed = part.field, part.inflow, part.speed
            inputs = g[field], u[field], slopes, partials, w[speed], dt, inflow[walls]
            return vjp_of_component(*inputs, of_u[field], of_inflow[walls], of_w[speed], of_w_is_set)

        return vjp

    def slopes(self, u: NDArray, inflow: NDArray, partials: bool) -> list:
        """Return, for each component, its limited slopes and their derivatives in a and b.

        The derivatives are empty if `partials` is False. For a first-order scheme the slopes are empty too.
        """
        if self.slope_loop is None:
            return self.no_slopes
        result = []
        for part in self.components:
            slopes, derivatives = self._empty_slopes(part, part.points, part.points if partials else 0)
            field, values = u[part.field], inflow[part.inflow]
            part.run(self.slope_loop, field, values, part.free, part.table, part.axes, slopes, derivatives)
            result.append((slopes, derivatives))
        return result

    def _empty_slopes(self, part: Component, points: int, points_of_derivatives: int) -> tuple[NDArray, NDArray]:
        shape = (len(part.axes), self.slopes_per_axis)
        slopes = buffers.empty((*shape, points), float)
        return slopes, buffers.empty((*shape, 2, points_of_derivatives), float)

    def stage(
        self,
        u: NDArray,
        slopes: list,
        w: NDArray,
        dt: float,
        inflow: NDArray,
        first_field: NDArray,
        keep: float,
        out: NDArray,
    ) -> float:
        """Set out = keep first_field + (1 - keep) (u + dt du/dt).

        Returns
        -------
        float
            Number of weights below the stability limit plus the number of results that are not finite.
        """
        total = 0.0
        for act, (values, _) in zip(self.stages, slopes):
            total += act(u, values, w, dt, inflow, first_field, keep, out)
        return total

    def vjp(
        self,
        g: NDArray,
        u: NDArray,
        slopes: list,
        w: NDArray,
        dt: float,
        inflow: NDArray,
        of_u: NDArray,
        of_inflow: NDArray,
        of_w: NDArray,
        of_w_is_set: bool,
    ) -> float:
        """Compute the cotangents of u, inflow and w from g, the cotangent of u + dt du/dt.

        `of_u` is set to the cotangent of u. The cotangent of the inflow is added to `of_inflow`. `of_w` is set to the
        cotangent of w if `of_w_is_set`; otherwise the cotangent is added to it. If `of_u` or `of_w` is empty, this
        cotangent is not computed. The derivatives in `slopes` are overwritten.

        Returns
        -------
        float
            Number of values of `of_u` (before the contribution of the slopes) and `of_w` that are not finite.
        """
        total = 0.0
        for act, (values, partials) in zip(self.vjps, slopes):
            total += act(g, u, values, partials, w, dt, inflow, of_u, of_inflow, of_w, of_w_is_set)
        return total


def _sum_of_tiles(counts: NDArray) -> float:
    if counts.size == 1:
        return counts[0]
    return counts.sum()
