"""free_faces: the faces of a grid whose velocity is an unknown of a flow."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sparsedp.flow import momentum
from sparsedp.grid.boundary_conditions import no_slip, resolve
from sparsedp.grid.grid import check_grid
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.lazy import Mask

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from sparsedp.grid.grid import Grid

__all__ = ["free_faces"]


def free_faces(grid: Grid, boundary: Any = no_slip, solid: ArrayLike | None = None) -> Operator:
    """Return the operator that sets a velocity to 0 on all faces where it is given: walls, inflow and obstacles.

    Parameters
    ----------
    grid : Grid
    boundary : flow condition or dict
        As for `face_laplacian`. The faces of an outflow are free.
    solid : bool array, shape `grid.shape`, optional
        Obstacles. The faces of solid cells, also those between fluid and solid, are not free.

    Returns
    -------
    Operator
        in, out: faces. ``free(np.ones(grid.faces.size))`` is 1 on the free faces and 0 on all others.

    Raises
    ------
    ShapeError
        If `solid` has another shape than the grid.
    TypeError
        If `boundary` is not a flow condition.

    See Also
    --------
    interior

    Notes
    -----
    In the equations of a steady flow, the momentum balance holds on free faces, and the given velocity on all others:
    ``free(balance) + (v - given) - free(v - given)``.

    Examples
    --------
    >>> import numpy as np
    >>> from sparsedp import Grid, inflow, outflow
    >>> free_faces(Grid(3), {"x": (inflow, outflow)})(np.ones(4))
    array([0., 1., 1., 1.])
    >>> free_faces(Grid(4), {"x": (inflow, outflow)}, np.array([False, False, True, False]))(np.ones(5))
    array([0., 1., 0., 0., 1.])
    """
    check_grid("free_faces", grid)
    mask = momentum.free_face_mask(grid, resolve(grid, boundary, no_slip, patches=True), solid)
    return Operator(Mask(mask), grid.faces, grid.faces, "free_faces")
