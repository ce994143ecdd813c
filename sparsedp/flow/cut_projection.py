"""The projection of a velocity around a body of `cut_cells`, with the flow conditions of `projection`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.base_classes import Reconstructible
from sparsedp._utils.validation import check_kind, check_on
from sparsedp.autodiff.tape import dtype_of
from sparsedp.flow.projection_setup import mask_of_faces, pressure_conditions
from sparsedp.grid.boundary_conditions import neumann, no_slip, resolve

if TYPE_CHECKING:
    from sparsedp.grid.grid import Grid
    from sparsedp.solvers.choose_method import SolveSettings

__all__ = ["CutProjection"]


class CutProjection(Reconstructible):
    """The projection that `projection` returns for a body of `cut_cells`: a differentiable function of the velocity.

    Only the shape of the body is used; the conditions are those of `projection`, and nothing flows through the wall of
    the body.

    Parameters
    ----------
    grid : Grid
    body : CutCells
    boundary : flow condition or dict
    settings : SolveSettings
    """

    def __init__(self, grid: Grid, body: Any, boundary: Any, settings: SolveSettings) -> None:
        if grid != body.grid:
            raise ValueError(f"projection takes a body of cut_cells on its grid {grid}, got one on {body.grid}")
        self.constructor_call = (CutProjection, (grid, body, boundary, settings))
        sides = resolve(grid, boundary, no_slip, patches=True)
        self._body = body.with_conditions(pressure_conditions(grid, sides), neumann, settings)
        self._is_open = mask_of_faces(grid, sides, None, lambda condition: not condition.closed)

    def __call__(self, v: Any, density: Any = None) -> Any:
        """Return the velocity without divergence, 0 on closed walls and on faces without fluid.

        Parameters
        ----------
        v : array, a field on the faces; leading axes are a batch
        density : number, or array on faces, optional
            > 0. Default: 1.
        """
        return self._body.project(self._open_part(v), density)

    def pressure(self, v: Any, density: Any = None) -> Any:
        """Return the p with P(v) = v + G(p) / density on open faces.

        Parameters
        ----------
        v : array on faces; leading axes are a batch
        density : number or array on faces, optional
            > 0. Default: 1.

        Returns
        -------
        array on cells [velocity length, times the unit of density]
        """
        return -self._body.potential(self._open_part(v), density)

    def _open_part(self, v):
        """Return a velocity, or a batch of them, that is 0 on closed walls."""
        faces = self._body.grid.faces
        if np.shape(v)[-1:] != faces.shape:
            check_on("projection", v, faces, "; join its components with grid.join")
        check_kind("v of projection", dtype_of(v), "numbers")
        return anp.where(self._is_open, v, 0.0)

    @property
    def info(self) -> Any:
        """Records of the pressure solves; None before the first one."""
        return self._body.info

    def __repr__(self) -> str:
        return f"<projection: {self._body}>"
