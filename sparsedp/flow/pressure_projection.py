"""projection: the divergence-free part of a face field, as one Operator.

With the mask K of open faces, the divergence D, the pressure gradient G and A = -D G, as in projection_setup.py,

    P v = K v + G p,          A p = D K v,          so that D P v = D K v - A p = 0,
    P^T g = K (g + D^T q),    A^T q = G^T g,        so that G^T P^T g = 0.

On uniform grids without inflow or outflow G = -K D^T. Then P is an orthogonal projection, and both lines are the same
computation. On stretched grids W P is symmetric, where W is the diagonal matrix of the volumes of the faces.

References
----------
A. J. Chorin, Math. Comp. 22 (1968) 745-762.
F. H. Harlow, J. E. Welch, Phys. Fluids 8 (1965) 2182-2189 (the staggered grid).
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from sparsedp._utils.base_classes import Frozen
from sparsedp._utils.calls import public
from sparsedp._utils.validation import check_on
from sparsedp.autodiff.tape import dtype_of
from sparsedp.errors import ShapeError
from sparsedp.flow.cut_projection import CutProjection
from sparsedp.flow.projection_setup import ProjectionSetup
from sparsedp.flow.variable_density import WeightedProjection
from sparsedp.grid.boundary_conditions import describe_patches, no_slip
from sparsedp.grid.grid import check_grid
from sparsedp.operators.masks_and_lift import Body
from sparsedp.operators.operator import Operator
from sparsedp.solvers.choose_method import check_settings

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from sparsedp.grid.grid import Grid

__all__ = ["Projection", "projection"]


@overload
def projection(
    grid: Grid,
    solid: Body,
    boundary: Any = ...,
    method: str = ...,
    rtol: float = ...,
    maxiter: int | None = ...,
    **options: Any,
) -> CutProjection: ...
@overload
def projection(
    grid: Grid,
    solid: ArrayLike | None = ...,
    boundary: Any = ...,
    method: str = ...,
    rtol: float = ...,
    maxiter: int | None = ...,
    **options: Any,
) -> Projection: ...
def projection(
    grid: Grid,
    solid: ArrayLike | Body | None = None,
    boundary: Any = no_slip,
    method: str = "auto",
    rtol: float = 1e-10,
    maxiter: int | None = None,
    **options: Any,
) -> Projection | CutProjection:
    """Return the operator that removes the divergence from a velocity on faces.

    Parameters
    ----------
    grid : Grid
    solid : bool array, shape `grid.shape`, or body of `cut_cells`, optional
        Obstacles. The result is 0 on faces that touch an obstacle. Of a body only the shape is used; the result is then
        a function of the velocity with `pressure` and `info`, and is 0 on faces without fluid.
    boundary : flow condition or dict
        no_slip, free_slip (here equivalent: the normal velocity is 0), inflow (the normal velocity is kept) or outflow
        (pressure 0), for all bounded sides or as {"x": (lower, upper), ...}; axes that are not named are no_slip. An
        opening in part of a wall is written with `patch`.
    method, rtol, maxiter, **options
        Arguments of the pressure solve, as in `inverse`.

    Returns
    -------
    Projection
        in: faces [velocity]; out: faces [velocity], with a divergence that is 0 to the relative tolerance `rtol`.
        ``P.pressure(v)`` returns the potential p [velocity length] with P(v) = v + G(p) on free faces; ``P.info``
        records the solves.
        ``P(v, density)`` returns v + G(p) / density without divergence, for a fluid whose density varies: a number > 0,
        or one for each cell or each face. The density of a face is the mean of its two cells, weighted by their widths.
        The density of solid cells has no effect. Leading axes of v are a batch, and the density may have one leading
        axis, for a density of each entry. Differentiable in both, to every order.

    Raises
    ------
    ShapeError
        If `solid` has another shape than the grid; on use, if the density has neither the shape of the cells nor of the
        faces.
    ValueError
        If an axis is named that is periodic or does not exist, or an inflow enters a region without an outflow. On use,
        if the density is not > 0.
    TypeError
        If `boundary` is not a flow condition.
    NonFiniteError
        On use, if the velocity holds NaN or infinity on any face, faces on walls included.
    ConvergenceError
        On use, if the solve does not meet `rtol`.

    See Also
    --------
    divergence, flow_step, cut_cells, no_slip, free_slip, inflow, outflow, patch

    Notes
    -----
    Null space: in a region without an outflow the pressure is determined only up to a constant, which is removed.
    Transpose: ``P.T(g)`` equals ``P(g)`` bit for bit on uniform grids without inflow or outflow.
    Cost: one pressure solve for each application, forward or transposed; one node on the tape. With a density, a new
    set-up for each new content of it; the last two are cached. The arguments of the solve also apply there.

    References
    ----------
    A. J. Chorin, Mathematics of Computation 22 (1968) 745-762.

    Examples
    --------
    >>> from sparsedp import Grid, inflow, outflow
    >>> P = projection(Grid((2, 2), periodic=True))
    >>> P(np.array([1.0, 2.0, 3.0, 4.0, 0.0, 0.0, 0.0, 0.0]))
    array([2., 3., 2., 3., 0., 0., 0., 0.])

    A density that varies, between an inflow and an outflow:

    >>> P = projection(Grid(2), boundary={"x": (inflow, outflow)})
    >>> P(np.array([1.0, 0.0, 0.0]), np.array([1.0, 3.0]))
    array([1., 1., 1.])
    """
    check_grid("projection", grid)
    settings = check_settings(method, rtol, maxiter, "project", options, common=("rtol", "maxiter"))
    if isinstance(solid, Body):
        return CutProjection(grid, solid, boundary, settings)
    if solid is not None and np.shape(solid) == grid.faces.shape != grid.shape:
        raise ShapeError(
            f"the second argument of projection is solid, a boolean array on {grid.cells}, got an array on "
            f"{grid.faces}; write dp.projection(grid)(v) for a velocity v"
        )
    set_up = grid.backend.implementation(ProjectionSetup)
    return Projection(set_up(grid, solid, boundary, settings))


class Projection(Operator):
    """The operator that `projection` returns, with its pressure and the records of its solves.

    Parameters
    ----------
    setup : ProjectionSetup
    """

    setup: ProjectionSetup

    def __init__(self, setup: ProjectionSetup) -> None:
        faces = setup.grid.faces
        name = f"projection{describe_patches(setup.sides)}"
        super().__init__(setup.structure(), faces, faces, name, "matrix-free")
        Frozen.__init__(self, setup=setup)

    def recipe(self) -> tuple:
        """Return the call that builds an equal object, for pickling and copying."""
        return Projection, (self.setup,)

    def __call__(self, v: Any, density: Any = None) -> Any:
        """Return the velocity without divergence.

        Parameters
        ----------
        v : array on faces
            Leading axes are a batch.
        density : number, array on cells or array on faces, optional
            > 0; see `projection`. One leading axis is a batch. Default: the same everywhere.

        Returns
        -------
        array like v

        Raises
        ------
        ShapeError
            If v is not a field on faces, or the density has another shape than those of cells and faces.
        ValueError
            If the density is not > 0.
        NonFiniteError
            If v or the density holds NaN or infinity.
        ConvergenceError
            If the solve does not meet `rtol`.
        """
        if density is None:
            return super().__call__(v)
        return self._with_density(v, density)

    @public("dp.projection(grid)")
    def _with_density(self, v: Any, density: Any) -> Any:
        if np.shape(v)[-1:] != self.domain.shape:  # leading axes are a batch
            check_on("projection", v, self.domain, "; join its components with grid.join")
        projected, _ = self.weighted.split(v, self.weighted.face_density(density, dtype_of(v)))
        return projected

    @cached_property
    def weighted(self) -> WeightedProjection:
        """The projection for a density that varies, with its solver."""
        return WeightedProjection(self.setup)

    @property
    def info(self) -> Any:
        """SolveLog of the pressure solves: .forward, .adjoint, .setup_seconds."""
        return self.setup.info

    @property
    def method(self) -> str:
        """Name of the solution method for the pressure."""
        return self.setup.inverse.method

    @cached_property
    def pressure(self) -> Operator:
        """Operator from faces to cells: the p with P(v) = v + G(p) on free faces [velocity length]."""
        return Operator(self.setup.pressure_structure(), self.domain, self.setup.grid.cells, "pressure")

    def __str__(self) -> str:
        return str(self.setup.inverse)
