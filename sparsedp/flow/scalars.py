"""Cell fields that the flow carries, such as heat or dye.

    s_next = s + dt (3/2 r(s, v) - 1/2 r_previous) + dt k (L (s + s_next) / 2 + D B),    r = source - D(v (A s + W)),

for implicit diffusion. If diffusion is explicit, r also contains k (L s + D B), and the third term is omitted. D is the
divergence, A the average from cells to faces, and k the diffusivity. B and W are the contributions of the wall values
to the slopes and to the values on faces. If the wall values are a function of params, r contains those at the beginning
of the step, and B is the mean of those at its beginning and at its end. If the diffusivity varies, the diffusive term
is D(k (G s + B)); see `variable_diffusion`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.pytree import mapped
from sparsedp._utils.validation import check_finite, check_on
from sparsedp.autodiff.program_trace import check_values, sample
from sparsedp.autodiff.tape import cast, dtype_of
from sparsedp.autodiff.tape_constants import frozen
from sparsedp.errors import ShapeError
from sparsedp.flow.diffusion import Diffusion
from sparsedp.flow.variable_diffusion import (
    DiffusionForm,
    VariableDiffusion,
    as_array,
    in_precision_of,
    is_constant,
)
from sparsedp.grid.boundary_conditions import neumann
from sparsedp.operators.difference import divergence, gradient, laplacian
from sparsedp.operators.harmonic import harmonic_average
from sparsedp.operators.masks_and_lift import check_solid, lift, mask
from sparsedp.operators.transfer import average

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.flow.settings import FlowSettings
    from sparsedp.operators.operator import Operator

__all__ = ["Scalar"]

ADVICE = "; write dp.lift(grid, boundary).domain.join(...)"


class Scalar:
    """A cell field that the flow carries.

    Parameters
    ----------
    name : str
    settings : FlowSettings
    divergence : Operator
    diffusivity, boundary, values, source
        As `flow_step` takes them in `scalars`.

    Attributes
    ----------
    changes : bool
        Whether the wall values are a function of params. If they are, the state of a flow step contains them.
    """

    def __init__(
        self,
        name: str,
        settings: FlowSettings,
        divergence: Operator,
        diffusivity: Any = 0.0,
        boundary: Any = neumann,
        values: NDArray | Callable | None = None,
        source: Callable | None = None,
    ) -> None:
        grid = settings.grid
        solid = settings.solid
        self.name = name
        self.source = source
        self._divergence = divergence
        self._average = average(grid, boundary)
        self._build_lift = partial(lift, grid, boundary)
        self._fluid: Any = None
        if solid is not None:
            self._fluid = mask(grid.cells, ~check_solid(grid, solid))
        self.changes = callable(values)
        self._values: Any = values if self.changes or values is None else as_array(values)
        self._constant_parts: tuple = (None, None)
        if values is not None and not self.changes:
            self._constant_parts = self._contributions(self._values)
        build_laplacian = partial(laplacian, grid, boundary, solid)
        coefficient_name = f"diffusivity of {name!r}"
        self.diffusion: Any
        if is_constant(diffusivity, settings):
            self.diffusion = Diffusion(coefficient_name, float(diffusivity), build_laplacian, settings)
        else:
            build_form = partial(DiffusiveFlux, settings, boundary, self._fluid)
            self.diffusion = VariableDiffusion(coefficient_name, diffusivity, settings, build_form, build_laplacian)

    def wall_values(self, params: Any, dtype: np.dtype) -> Any:
        """Return the wall values for params, in the dtype of the field, if they are a function of params."""
        values = self._values(params)
        check_on(f"flow_step, as values of {self.name!r},", values, self._lift.domain, ADVICE)
        return cast(values, dtype)

    @cached_property
    def _lift(self) -> Operator:
        return self._build_lift()

    def _contributions(self, values: Any) -> tuple[Any, Any]:
        """Return the contributions of wall values to the Laplacian, and to the values on faces."""
        slopes = self._lift(values)
        part = self._divergence(slopes)
        if self._fluid is not None:
            part = self._fluid(part)
        return part, slopes / self._twice_normal

    @cached_property
    def _twice_normal(self) -> Any:
        """2 / h on walls, with the sign of the outward normal, and 1 on all other faces."""
        at_wall = self._lift(np.ones(self._lift.domain.shape)) != 0
        normal = self._divergence.T(np.ones(self._divergence.codomain.shape))
        return np.where(at_wall, 2 * normal, 1.0)

    def _parts(self, values: Any, dtype: np.dtype) -> tuple[Any, ...]:
        """Return `_contributions` of the given values, of the constant ones if values is None; None stands for 0."""
        parts = self._constant_parts
        if values is not None:
            parts = self._contributions(values)
        return tuple(None if part is None else cast(part, dtype) for part in parts)

    def diffusivity(self, scalars: dict[str, Any], params: Any) -> Any:
        """Return the diffusivity for these scalars if it varies, else None."""
        if not self.diffusion.varies:
            return None
        u = scalars[self.name]
        batch = np.shape(u)[: np.ndim(u) - len(self._divergence.codomain.shape)]
        return self.diffusion.coefficient(lambda: (scalars,), params, dtype_of(u), batch)

    def rate(self, v: Any, scalars: dict[str, Any], params: Any, values: Any = None, dt: Any = None) -> Any:
        """Return the explicit part r of the rate of change; see the module docstring.

        `values` are the wall values at the beginning of the step, None if they are constant. `dt` is the length of the
        step, which a diffusivity that varies needs for its stability limit.
        """
        u = scalars[self.name]
        wall_part, on_walls = self._parts(values, dtype_of(u))
        on_faces = self._average(u)
        if on_walls is not None:
            on_faces = on_faces + on_walls
        rate = -self._divergence(v * on_faces)
        if self.source is not None:
            source = self.source(mapped(frozen, scalars), params)
            if np.shape(sample(source)) not in ((), u.shape):
                raise ShapeError(
                    f"flow_step takes a source of {self.name!r} of shape {u.shape}, or a number, got an array of shape "
                    f"{np.shape(sample(source))}; write one number for each cell"
                )
            rate = rate + in_precision_of(source, dtype_of(u))
        if self.diffusion.varies:
            k = self.diffusivity(scalars, params)
            rate = self.diffusion.add_explicit(rate, u, k, lambda: wall_part, lambda: self._at_walls(values), None, dt)
        else:
            rate = self.diffusion.add_explicit(rate, u, lambda: wall_part)
        check_values(partial(check_finite, f"the rate of {self.name!r}"), rate)
        return rate

    def _at_walls(self, values: Any) -> Any:
        """Return the wall values, given those of a function; None stands for 0."""
        if values is None and not self.changes:
            return self._values
        return values

    def step(
        self,
        u: Any,
        change: Any,
        before: Any = None,
        after: Any = None,
        k: Any = None,
        dt: Any = None,
        middle: Any = None,
    ) -> Any:
        """Return the field after a step.

        Parameters
        ----------
        u : array
        change : array
            The change by the explicit terms.
        before, after : array or None
            The wall values at the beginning and the end of the step; None if they are constant.
        k : number or array or None
            The diffusivity, and the length of the step `dt`, if the diffusivity varies.
        middle : array or None
            The field from which k was computed, at half the step; None if no diffusivity depends on scalars.
        """
        explicit = u + change
        if not self.diffusion.implicit:
            return explicit
        wall_part = partial(self._sum_of_parts, before, after, dtype_of(u))
        if self.diffusion.varies:
            walls = partial(self._sum_at_walls, before, after)
            return self.diffusion.step_implicit(explicit, u, k, wall_part, walls, None, dt, middle)
        return self.diffusion.step_implicit(explicit, u, wall_part())

    def _sum_at_walls(self, before: Any, after: Any) -> Any:
        """Return the sum of the wall values at the beginning and the end of a step; None stands for 0."""
        if before is not None:
            return before + after
        if self._values is None:
            return None
        return 2.0 * self._values

    def _sum_of_parts(self, before: Any, after: Any, dtype: np.dtype) -> Any:
        """Return the contribution of `_sum_at_walls` to the Laplacian; None stands for 0."""
        if before is not None:
            return self._parts(before + after, dtype)[0]
        wall_part, _ = self._parts(None, dtype)
        if wall_part is None:
            return None
        return 2.0 * wall_part


class DiffusiveFlux(DiffusionForm):
    """The factors of div(k grad s) for a scalar; see `variable_diffusion`.

    Parameters
    ----------
    settings : FlowSettings
    boundary : condition or dict
        As `flow_step` takes it in `scalars`.
    fluid : Operator or None
        The mask of the cells that are not solid; None if there are no solid cells.
    """

    def __init__(self, settings: FlowSettings, boundary: Any, fluid: Any) -> None:
        grid = settings.grid
        grid.backend.check("a diffusivity that varies in flow_step")
        self.slopes = gradient(grid, boundary, settings.solid)
        self.wall_slopes = lift(grid, boundary)
        self.divergence = divergence(grid)
        if fluid is not None:
            self.divergence = fluid @ self.divergence
        self.at_sites = harmonic_average(grid)
