"""Transport around a body of `cut_cells`: one explicit step of its method `advection`."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.base_classes import Reconstructible
from sparsedp.advection.arguments import check_inflow, check_stability, check_step
from sparsedp.advection.settings import wall_space
from sparsedp.autodiff.program_trace import check_values
from sparsedp.errors import ShapeError
from sparsedp.grid.boundary_conditions import dirichlet, walls_of
from sparsedp.operators.cut_geometry import sum_at_places
from sparsedp.operators.cut_operators import in_dtype_of

if TYPE_CHECKING:
    from sparsedp.advection.settings import TransportSettings
    from sparsedp.grid.space import Space

__all__ = ["CutTransport"]

LIMITS = {"upwind": 1.0, "van_leer": 0.5}  # largest stable CFL numbers


class CutTransport(Reconstructible):
    """One step of transport around a body, ``move(u, v, dt, inflow=0.0)``, as `transport` returns it with a body.

    Parameters
    ----------
    settings : TransportSettings
        Without solid cells.
    body : CutCells

    Attributes
    ----------
    walls : Space
        Space of the inflow values, as for `Transport`.
    """

    def __init__(self, settings: TransportSettings, body: Any) -> None:
        self.constructor_call = (CutTransport, (settings, body))
        self.walls: Space = wall_space(settings)
        self._settings = settings
        self._body = body
        grid = settings.grid
        faces = []
        has_inflow = np.zeros(grid.faces.size, bool)
        for axis, upper, condition in walls_of(settings.sides):
            part = np.arange(*grid.faces.offsets[axis : axis + 2]).reshape(grid.faces.parts[axis])
            faces.append(part.take(-1 if upper else 0, axis).reshape(-1))
            has_inflow[faces[-1]] = condition == dirichlet
        places = np.concatenate([np.zeros(0, int), *faces])
        self._has_inflow = has_inflow
        self._on_faces = sum_at_places(places, grid.faces)

    def __call__(self, u: Any, v: Any, dt: Any, inflow: Any = 0.0) -> Any:
        """Return the field after one step; differentiable in every argument and in the level of the body.

        Parameters
        ----------
        u : array, a field on the cells; leading axes are a batch
        v : array, a field on the faces
        dt : number > 0
        inflow : number, or array of the shape `walls.shape`
        """
        name = f"transport {self._settings.scheme}"
        check_values(partial(check_step, name), dt)
        cells = self._settings.grid.cells
        if np.shape(u)[-len(cells.shape) :] != cells.shape:
            raise ShapeError(f"{name} takes a field on {cells}, got an array of shape {np.shape(u)}")
        check_inflow(name, self._settings, inflow)
        shape = np.shape(inflow)
        if shape not in ((), self.walls.shape):
            raise ShapeError(
                f"{name} with a body takes a number or an array of shape {self.walls.shape} as inflow, got an array of "
                f"shape {shape}; write move.walls.join(...)"
            )
        body = self._body
        limit = LIMITS[self._settings.scheme]
        check_values(partial(check_stability, self._settings, limit=limit), dt, body.outflow_rates(v))
        entering = self._on_faces(inflow * np.ones(self.walls.size))
        if self._settings.scheme == "upwind":
            return in_dtype_of(u, u + dt * self._rate(u, v, entering, 1))
        middle = u + dt * self._rate(u, v, entering, 2)
        return in_dtype_of(u, 0.5 * (u + middle + dt * self._rate(middle, v, entering, 2)))

    def _rate(self, u, v, entering, order):
        """Return the rate; on walls without inflow, the value of the cell enters."""
        values = self._body.face_values
        of_cells = anp.where(values.at_lower, values.above(u), values.below(u))
        return self._body.advection(u, v, anp.where(self._has_inflow, entering, of_cells), order)

    def __repr__(self) -> str:
        return f"<transport {self._settings.scheme}: {self._body}>"
