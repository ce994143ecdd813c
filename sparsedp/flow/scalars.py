"""Cell fields that the flow carries, such as heat or dye.

    s_next = s + dt (3/2 r(s, v) - 1/2 r_previous) + dt k (L (s + s_next) / 2 + D B),    r = source - D(v (A s + W)),

for implicit diffusion. If diffusion is explicit, r also contains k (L s + D B), and the third term is omitted. D is the
divergence, A the average from cells to faces, and k the diffusivity. B and W are the contributions of the wall values
to the slopes and to the values on faces.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.pytree import mapped
from sparsedp._utils.validation import check_finite
from sparsedp.autodiff.program_trace import check_values, sample
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


class Scalar:
    """A cell field that the flow carries.

    Parameters
    ----------
    name : str
    settings : FlowSettings
    divergence : Operator
    diffusivity, boundary, values, source
        As `flow_step` takes them in `scalars`.
    """

    def __init__(
        self,
        name: str,
        settings: FlowSettings,
        divergence: Operator,
        diffusivity: float = 0.0,
        boundary: Any = neumann,
        values: NDArray | None = None,
        source: Callable | None = None,
    ) -> None:
        grid = settings.grid
        solid = settings.solid
        self.name = name
        self.dt = settings.dt
        self.source = source
        self._divergence = divergence
        self._average = average(grid, boundary)
        self._wall_values: Any = 0.0  # on faces
        self._wall_part: Any = None  # contribution of wall values to the Laplacian
        if values is not None:
            slopes = lift(grid, boundary)(values)
            self._wall_part = divergence(slopes)
            if solid is not None:
                self._wall_part = mask(grid.cells, ~check_solid(grid, solid))(self._wall_part)
            normal = divergence.T(np.ones(grid.shape))
            self._wall_values = slopes / np.where(slopes != 0, 2 * normal, 1.0)
        build_laplacian = partial(laplacian, grid, boundary, solid)
        self.diffusion = Diffusion(f"diffusivity of {name!r}", float(diffusivity), build_laplacian, settings)

    def rate(self, v: Any, scalars: dict[str, Any], params: Any) -> Any:
        """Return the explicit part r of the rate of change; see the module docstring."""
        u = scalars[self.name]
        rate = -self._divergence(v * (self._average(u) + self._wall_values))
        if self.source is not None:
            source = self.source(mapped(frozen, scalars), params)
            if np.shape(sample(source)) not in ((), u.shape):
                raise ShapeError(
                    f"flow_step takes a source of {self.name!r} of shape {u.shape}, or a number, got an array of shape "
                    f"{np.shape(sample(source))}; write one number for each cell"
                )
            rate = rate + source
        rate = self.diffusion.add_explicit(rate, u, params, lambda: self._wall_part)
        check_values(partial(check_finite, f"the rate of {self.name!r}"), rate)
        return rate

    def step(self, u: Any, rate: Any, previous_rate: Any) -> Any:
        """Return the field after a step."""
        explicit = u + self.dt * (1.5 * rate - 0.5 * previous_rate)
        if self.diffusion.solve is None:
            return explicit
        if self._wall_part is None:
            wall_part = None
        else:
            wall_part = 2.0 * self._wall_part
        return self.diffusion.step_implicit(explicit, u, wall_part)
