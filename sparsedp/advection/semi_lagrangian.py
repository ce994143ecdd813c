"""Semi-Lagrangian transport: the new value at a point is the interpolated value at its departure point.

Let E be the field with ghost cells, m_i the velocity from the departure point of point i to the point, and
s = dt / spacing. Then

    u'_i     = sum over k of W_ik E_k,     W_ik = product over the axes of weights at i - s m_i
    g_E      = W^T g,                      from which `Interpolant.pad_vjp` computes the cotangents of u and inflow
    g_m      = -s g_i (gradient of the interpolant at i - s m_i)
    tangent  = W dE + g_m(g = 1) . dm.

`departure_points` has the relation between m and the velocity v. A step depends only on v dt: therefore
g_dt = g_v . v / dt, and a tangent ddt of dt has the effect of a tangent v ddt / dt of v. The linear interpolant has
kinks at the points; its slope there is the mean of both one-sided slopes. The cubic weights are those of Catmull and
Rom (cubic convolution). Their error is of third order in a step, hence of second order or better at a fixed ratio of dt
to spacing, and they are exact for quadratic fields away from walls.

References
----------
A. Staniforth, J. Cote, Monthly Weather Review 119 (1991) 2206-2223.
R. Keys, IEEE Trans. Acoustics, Speech and Signal Processing 29 (1981) 1153-1160.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from sparsedp._utils import buffers
from sparsedp._utils.validation import surely_finite
from sparsedp.advection.arguments import check_numbers
from sparsedp.advection.departure_points import Trajectory
from sparsedp.advection.interpolant import Interpolant
from sparsedp.advection.method import TransportMethod
from sparsedp.advection.settings import FIELD, INFLOW, VELOCITY
from sparsedp.kernels.interpolation_weights import interpolate, scatter

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from sparsedp.advection.settings import TransportSettings

__all__ = ["ComponentStep", "SemiLagrangian"]


class ComponentStep:
    """The step of one component of the field: its values at the departure points.

    Parameters
    ----------
    interpolant : Interpolant
    w : array, shape (axes, points)
        Velocities at the points.
    dt : float
    u : array
        The component as a flat array.
    inflow : array
        All inflow values.
    """

    __slots__ = ("back", "values")

    def __init__(self, interpolant: Interpolant, w: NDArray, dt: float, u: NDArray, inflow: NDArray) -> None:
        self.back = Trajectory(interpolant, w, dt)
        self.values = self.back.at_departure_points(u, inflow)

    def value(self, out: NDArray) -> None:
        """Set `out` to the component after the step."""
        self.values.value(out)

    def vjp(self, g: NDArray, of_u: NDArray | None, of_inflow: NDArray, of_w: NDArray | None) -> None:
        """Compute cotangents from the cotangent g of the result: set `of_u` and `of_w`, and add to `of_inflow`.

        If `of_u` is None, the cotangents of u and inflow are not computed; if `of_w` is None, the cotangent of w is
        not.
        """
        if of_u is not None:
            self.values.vjp(g, of_u, of_inflow)
        if of_w is not None:
            self.back.vjp(self.values.velocity_slopes(g, of_w))

    def jvp(self, du: NDArray, dinflow: NDArray, dw: NDArray | None) -> NDArray:
        """Return the tangent for tangents of u, inflow and w; None for `dw` stands for 0."""
        return self.values.jvp(du, dinflow, None if dw is None else self.back.jvp(dw))

    def matrix(self) -> sp.csr_array:
        """Return the matrix of the step, which maps u to the result for an inflow of 0."""
        return self.values.matrix()


class SemiLagrangian(TransportMethod):
    """The semi-Lagrangian scheme; the module docstring has its formulas."""

    options: tuple[str, ...] = ("interpolation", "backtrace")
    linear = True
    component_step: Any = ComponentStep

    def __init__(self, settings: TransportSettings) -> None:
        super().__init__(settings)
        self.components = [Interpolant(settings, number) for number in range(len(settings.space.parts))]
        dim = settings.grid.dim
        self._velocity_parts = [
            (slice(dim * c.span.start, dim * c.span.stop), (dim, c.span.stop - c.span.start)) for c in self.components
        ]
        size = settings.space.size
        self._new_field = buffers.allocator((size,))
        self._new_velocity = buffers.allocator((dim * size,))
        self.solid = settings.solid_points  # mask of the points whose value does not change

    def _split_velocity(self, w: NDArray) -> list[NDArray]:
        """Return, for each component, the velocities at its points as an array (axis, point)."""
        if len(self._velocity_parts) == 1:
            return [w.reshape(self._velocity_parts[0][1])]
        return [w[span].reshape(shape) for span, shape in self._velocity_parts]

    def _steps(self, u: NDArray, v: NDArray, dt: float, inflow: NDArray) -> Iterable[tuple[slice, Any]]:
        """Return, for each component, the range of its entries in the field and its step."""
        w = self.interpolate_velocity(v)
        if len(self.components) == 1:
            (component,) = self.components
            return ((component.span, self.component_step(component, *self._split_velocity(w), dt, u, inflow)),)
        return self._steps_of_components(u, w, dt, inflow)

    def _steps_of_components(self, u: NDArray, w: NDArray, dt: float, inflow: NDArray) -> Iterator[tuple[slice, Any]]:
        """Yield what `_steps` returns, so that the memory of a step is free before the next one is computed."""
        for component, part_of_w in zip(self.components, self._split_velocity(w)):
            span = component.span
            yield span, self.component_step(component, part_of_w, dt, u[span], inflow)

    def _keep_solid(self, result: NDArray, u: NDArray) -> NDArray:
        """Set the points of `result` inside the solid to the values of u, and return `result`."""
        if self.solid is not None:
            np.copyto(result, u, where=self.solid)
        return result

    def forward(self, u: NDArray, v: NDArray, dt: float, inflow: NDArray) -> NDArray:
        """Return the field after one step."""
        finite = surely_finite(u) and (v is u or surely_finite(v)) and (not inflow.size or surely_finite(inflow))
        if not finite:
            check_numbers(self.settings, u, v, inflow)  # the result alone does not show all of them
        out = self._new_field()
        for span, step in self._steps(u, v, dt, inflow):
            step.value(out[span])
        return self._keep_solid(out, u)

    @property
    def _is_direct(self) -> bool:
        """Whether a step consists of a few calls of compiled loops for one component of the field."""
        is_simple = self.component_step is ComponentStep and self.solid is None and len(self.components) == 1
        return is_simple and self.components[0].is_direct

    def bound_forward(self) -> Callable[..., NDArray]:
        """Return a function that returns what `forward` returns, with less overhead."""
        if not self._is_direct:
            return self.forward
        settings = self.settings
        component = self.components[0]
        pad, points, scale = component.pad, component.points, component.coordinates.scale
        interpolate_velocity, new_field = self.interpolate_velocity, self._new_field
        shape = self._velocity_parts[0][1]

        def direct(u, v, dt, inflow):
            if not (surely_finite(u) and (v is u or surely_finite(v)) and (not inflow.size or surely_finite(inflow))):
                check_numbers(settings, u, v, inflow)
            w = interpolate_velocity(v).reshape(shape)
            return interpolate(points, pad(u, inflow), w, scale(dt), new_field())

        return direct

    def bound_vjp(self, nums: Sequence[int]) -> Callable[..., tuple[Sequence[Any], bool]]:
        """Return a function that returns what `vjp` returns, with less overhead."""
        if not self._is_direct or not {FIELD, VELOCITY} >= set(nums):
            return super().bound_vjp(nums)
        component = self.components[0]
        pad, points, scale = component.pad, component.points, component.coordinates.scale
        new_samples, pad_vjp = component.new_samples, component.pad_vjp
        new_field, new_velocity = self._new_field, self._new_velocity
        interpolate_velocity, interpolate_velocity_vjp = self.interpolate_velocity, self.interpolate_velocity_vjp
        shape = self._velocity_parts[0][1]

        def direct(g, u, v, dt, inflow):
            if not g.flags.c_contiguous:
                g = np.ascontiguousarray(g)
            w = interpolate_velocity(v).reshape(shape)
            scales = scale(dt)
            cotangents = []
            for num in nums:
                if num == FIELD:
                    of_u = new_field()
                    pad_vjp(scatter(points, w, scales, g, new_samples()), of_u, np.zeros(inflow.size))
                    cotangents.append(of_u)
                else:
                    of_w = new_velocity()
                    interpolate(points, pad(u, inflow), w, scales, of_w.reshape(shape), g)
                    cotangents.append(interpolate_velocity_vjp(of_w))
            return cotangents, False

        return direct

    def vjp(
        self,
        nums: Sequence[int],
        g: NDArray,
        u: NDArray,
        v: NDArray,
        dt: float,
        inflow: NDArray,
        velocity_sum: NDArray | None = None,
    ) -> tuple[tuple[Any, ...], bool]:
        """Return the cotangents of the arguments `nums`; see `TransportMethod`."""
        of_field_wanted = FIELD in nums or INFLOW in nums
        of_velocity_wanted = VELOCITY in nums
        g = np.ascontiguousarray(g)
        if self.solid is None:
            of_moved = g
        else:
            of_moved = np.where(self.solid, 0.0, g)
        of_u = self._new_field() if of_field_wanted else None
        of_inflow = np.zeros(inflow.size)
        of_w = None
        parts_of_w: list = [None] * len(self.components)
        if of_velocity_wanted:
            of_w = self._new_velocity()
            parts_of_w = self._split_velocity(of_w)
        for (span, step), part_of_w in zip(self._steps(u, v, dt, inflow), parts_of_w):
            step.vjp(of_moved[span], None if of_u is None else of_u[span], of_inflow, part_of_w)
        if of_u is not None and self.solid is not None:
            of_u += g - of_moved
        if of_w is not None:
            of_w = self.interpolate_velocity_vjp(of_w)
        cotangents = {FIELD: of_u, VELOCITY: of_w, INFLOW: of_inflow}
        return tuple([cotangents[num] for num in nums]), False

    def jvp(self, tangents: Mapping[int, Any], u: NDArray, v: NDArray, dt: float, inflow: NDArray) -> NDArray:
        """Return the tangent of the result; see `TransportMethod`."""
        du = np.ascontiguousarray(tangents.get(FIELD, np.zeros(u.size)))
        dv = np.ascontiguousarray(tangents.get(VELOCITY, np.zeros(v.size)))
        dinflow = np.ascontiguousarray(tangents.get(INFLOW, np.zeros(inflow.size)))
        velocity_moves = VELOCITY in tangents
        velocities = self._split_velocity(self.interpolate_velocity(dv))
        out = np.empty(u.size)
        for (span, step), dw in zip(self._steps(u, v, dt, inflow), velocities, strict=True):
            out[span] = step.jvp(du[span], dinflow, dw if velocity_moves else None)
        return self._keep_solid(out, du)

    def matrix(self, v: NDArray, dt: float) -> sp.csr_array:
        """Return the matrix of the step, which maps u to the next field for an inflow of 0."""
        no_field = np.zeros(self.settings.space.size)
        no_inflow = np.zeros(self.walls.size)
        blocks = [step.matrix() for _, step in self._steps(no_field, v, dt, no_inflow)]
        moved = sp.csr_array(sp.block_diag(blocks, format="csr"))
        if self.solid is None:
            return moved
        return sp.csr_array(sp.diags_array(1.0 * ~self.solid) @ moved + sp.diags_array(1.0 * self.solid))
