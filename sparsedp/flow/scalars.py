"""Cell fields that the flow carries, such as heat or dye.

    s_next = s + dt (3/2 r(s, v) - 1/2 r_previous) + dt k (L (s + s_next) / 2 + D B),    r = source - D(v (A s + W)),

for implicit diffusion. If diffusion is explicit, r also contains k (L s + D B), and the third term is omitted. D is the
divergence, A the average from cells to faces, and k the diffusivity. B and W are the contributions of the wall values
to the slopes and to the values on faces. If the wall values are a function of params, r contains those at the beginning
of the step, and B is the mean of those at its beginning and at its end.
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
from sparsedp.grid.boundary_conditions import neumann
from sparsedp.operators.difference import laplacian
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
        diffusivity: float = 0.0,
        boundary: Any = neumann,
        values: NDArray | Callable | None = None,
        source: Callable | None = None,
    ) -> None:
        grid = settings.grid
        solid = settings.solid
        self.name = name
        self.dt = settings.dt
        self.source = source
        self._divergence = divergence
        self._average = average(grid, boundary)
        self._build_lift = partial(lift, grid, boundary)
        self._fluid: Any = None
        if solid is not None:
            self._fluid = mask(grid.cells, ~check_solid(grid, solid))
        self._values: Any = values
        self.changes = callable(values)
        self._constant_parts: tuple = (None, None)
        if values is not None and not self.changes:
            self._constant_parts = self._contributions(values)
        build_laplacian = partial(laplacian, grid, boundary, solid)
        self.diffusion = Diffusion(f"diffusivity of {name!r}", float(diffusivity), build_laplacian, settings)

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

    def rate(self, v: Any, scalars: dict[str, Any], params: Any, values: Any = None) -> Any:
        """Return the explicit part r of the rate of change; see the module docstring.

        `values` are the wall values at the beginning of the step; None if they are constant.
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
            rate = rate + source
        rate = self.diffusion.add_explicit(rate, u, params, lambda: wall_part)
        check_values(partial(check_finite, f"the rate of {self.name!r}"), rate)
        return rate

    def step(self, u: Any, rate: Any, previous_rate: Any, before: Any = None, after: Any = None) -> Any:
        """Return the field after a step, given the wall values at its beginning and end; None if they are constant."""
        explicit = u + self.dt * (1.5 * rate - 0.5 * previous_rate)
        if self.diffusion.solve is None:
            return explicit
        if before is not None:
            wall_part, _ = self._parts(before + after, dtype_of(u))
        else:
            wall_part, _ = self._parts(None, dtype_of(u))
            if wall_part is not None:
                wall_part = 2.0 * wall_part
        return self.diffusion.step_implicit(explicit, u, wall_part)
