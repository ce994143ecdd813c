"""Difference operators on the staggered grid: gradient, divergence, flux, laplacian, curl, upwind."""

from __future__ import annotations

from functools import reduce
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from sparsedp.grid.boundary_conditions import check_condition, describe_patches, neumann, resolve
from sparsedp.grid.grid import Grid, check_grid
from sparsedp.grid.space import Space
from sparsedp.operators.masks_and_lift import Body, check_solid, refuse_body, region_of, solid_faces
from sparsedp.operators.operator import Operator
from sparsedp.operators.stencils import (
    along,
    check_order,
    differences,
    differences_4,
    kronecker_operator,
    one_sided,
    pick,
    slope_terms,
    slopes_4,
    to_faces,
)
from sparsedp.operators.structure.base import Matrix
from sparsedp.operators.structure.lazy import Mask, compose, total

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

__all__ = ["curl", "divergence", "flux", "gradient", "laplacian", "upwind"]


def gradient(
    grid: Grid,
    boundary: Any = neumann,
    solid: ArrayLike | None = None,
    solid_boundary: Any = neumann,
    order: int = 2,
) -> Operator:
    """Return the gradient operator from cells to faces, (u[i] - u[i - 1]) / d[i] on every face.

    Here d[i] is the distance between the centres of the two cells.

    Parameters
    ----------
    grid : Grid
    boundary : condition, or dict of conditions
        Boundary condition on the walls of the grid, with boundary value 0; add other values by `lift`. A condition on
        part of a wall is written with `patch`.
    solid : bool array, shape `grid.shape`, optional
        True for cells that are not part of the domain. On a face between two solid cells the gradient is 0.
    solid_boundary : condition
        Boundary condition, with boundary value 0, on every face between a solid cell and a cell of the domain.
    order : 2 or 4
        Order of accuracy. 4 needs cells of one width along each axis, at least four of them between two walls, no solid
        cells and no `patch`.

    Returns
    -------
    Operator
        in: cells [unit]; out: faces [unit / length].

    Raises
    ------
    ShapeError
        If `solid` has another shape than the grid.
    TypeError
        If `grid` is not a Grid, `solid` is not boolean, or `solid_boundary` is not a single condition.
    ValueError
        If `boundary` names an axis that is periodic or that the grid does not have, or if the grid does not allow the
        order.

    See Also
    --------
    divergence, laplacian, upwind, average, lift, dirichlet, neumann, robin, patch, curl

    Notes
    -----
    The gradient is second-order accurate on interior faces of uniform grids, and of grids whose spacing varies
    smoothly. Let V and W be the diagonal matrices of cell and face volumes, D the divergence, G the gradient, and I the
    `interior` operator on faces. Then V D I = -(W I G)^T. If all walls are neumann or periodic, the null space of G
    consists of the constant fields.

    With ``order=4`` the slope on a face is (27 (u[i] - u[i - 1]) - (u[i + 1] - u[i - 2])) / (24 h). The two faces next
    to a wall use one-sided differences of order 3, so that V D I = -(W I G)^T holds on periodic axes only.

    Examples
    --------
    >>> import numpy as np
    >>> from sparsedp import Grid, dirichlet
    >>> gradient(Grid(3))(np.array([1.0, 2.0, 4.0]))
    array([0., 1., 2., 0.])
    >>> gradient(Grid(3), {"x": (dirichlet, neumann)})(np.array([1.0, 2.0, 4.0]))
    array([2., 1., 2., 0.])
    """
    check_condition("solid_boundary", solid_boundary)
    refuse_body("gradient", solid, "body.gradient(u), or dp.laplacian(grid, solid=body)")
    check_order("gradient", grid, order, solid)
    if order == 4:
        sides = resolve(grid, boundary, name="gradient with order=4")
        return to_faces("gradient", grid, [slopes_4(grid, axis, sides[axis]) for axis in range(grid.dim)])
    sides = resolve(grid, boundary, patches=True)
    name = f"gradient{describe_patches(sides)}"
    slope = to_faces(name, grid, [slope_terms(grid, axis, sides[axis]) for axis in range(grid.dim)])
    if solid is None:
        return slope
    # Set the slope to 0 on all faces of solid cells, then add the one-sided slope that the condition implies (0 for
    # neumann) on the faces between a solid cell and a cell of the domain.
    below, above = solid_faces(grid, check_solid(grid, solid))
    structure = compose(Mask(~(below | above)), slope.structure)
    if solid_boundary.a:
        for upper, faces in ((True, below & ~above), (False, above & ~below)):
            factors = [one_sided(grid, axis, upper, solid_boundary) for axis in range(grid.dim)]
            side = to_faces("gradient", grid, factors)
            structure = total(structure, compose(Mask(faces), side.structure))
    return Operator(structure, grid.cells, grid.faces, name)


def divergence(grid: Grid, order: int = 2, axis: int | str | None = None) -> Operator:
    """Return the divergence operator from faces to cells, the sum over the axes of (v[i + 1] - v[i]) / h[i].

    Parameters
    ----------
    grid : Grid
    order : 2 or 4
        Order of accuracy; see `gradient`.
    axis : int or "x", "y", "z", optional
        Compute the term of this axis only. Default: the sum over all axes.

    Returns
    -------
    Operator
        in: faces [unit]; out: cells [unit / length].

    Raises
    ------
    TypeError
        If `grid` is not a Grid.
    ValueError
        If the grid does not allow the order, or has no such axis.

    See Also
    --------
    gradient, laplacian, curl, flux, projection

    Notes
    -----
    The discrete divergence theorem holds exactly on any grid: sum(grid.volumes * D(v)) is the net outflow through the
    walls. With ``order=4`` it holds on periodic axes only; the cells at walls use one-sided differences of order 3.

    Examples
    --------
    >>> import numpy as np
    >>> from sparsedp import Grid
    >>> divergence(Grid(3))(np.array([0.0, 1.0, 3.0, 3.0]))
    array([1., 2., 0.])
    """
    check_grid("divergence", grid)
    check_order("divergence", grid, order)
    axes: Any = range(grid.dim)
    if axis is not None:
        grid.backend.check("divergence along one axis")
        axes = [grid.axis(axis)]
    factor = differences if order == 2 else differences_4
    blocks = {(0, a): along(a, grid.dim, factor(grid, a)) for a in axes}
    return kronecker_operator(grid.faces, grid.cells, blocks, "divergence")


def flux(grid: Grid, cells: Any) -> Operator:
    """Return the operator that maps a velocity on faces to the net outflow from a set of cells, a scalar.

    Parameters
    ----------
    grid : Grid
    cells : slices or bool array
        The set of cells: either one slice for each axis, such as ``(slice(4, 8), slice(2, 6))`` or
        ``np.s_[4:8, 2:6]``, or a boolean array of shape `grid.shape`.

    Returns
    -------
    Operator
        in: faces [velocity]; out: shape () [velocity length^(dim - 1)]. The result is the sum of face area times
        outward velocity over the boundary of the set. It equals the sum of volume times divergence over its cells.

    Raises
    ------
    ShapeError
        If the array has another shape than the grid.
    TypeError
        If the array is not boolean.
    ValueError
        If `cells` is not one slice for each axis, or if a slice has a step other than 1.

    See Also
    --------
    divergence

    Examples
    --------
    >>> import numpy as np
    >>> from sparsedp import Grid
    >>> out = flux(Grid(4), slice(1, 3))
    >>> float(out(np.array([0.0, 1.0, 7.0, 3.0, 4.0])))
    2.0
    """
    check_grid("flux", grid)
    below, above = solid_faces(grid, region_of(grid, cells))
    areas = []
    for axis, shape in enumerate(grid.faces.parts):
        lengths = [np.ones(shape[a]) if a == axis else h for a, h in enumerate(grid.widths)]
        areas.append(reduce(np.multiply.outer, lengths).ravel())
    row = np.concatenate(areas) * (below.astype(float) - above)
    return Operator(Matrix(sp.csr_array(row[None])), grid.faces, Space(()), "flux")


def laplacian(
    grid: Grid,
    boundary: Any = neumann,
    solid: ArrayLike | None = None,
    solid_boundary: Any = neumann,
    order: int = 2,
) -> Operator:
    """Return the Laplacian on cells, divergence(grid) @ gradient(grid, boundary, solid, solid_boundary).

    Parameters
    ----------
    grid : Grid
    boundary, solid, solid_boundary, order
        As for `gradient`. The divergence has the same order. `solid` can also be a body of `cut_cells` with the same
        grid and conditions; the result is then its attribute `laplacian`.

    Returns
    -------
    Operator
        in: cells [unit]; out: cells [unit / length^2].

    Raises
    ------
    ShapeError
        If `solid` has another shape than the grid.
    ValueError
        If the grid does not allow the order, or a body of `cut_cells` has another grid or other conditions.

    See Also
    --------
    gradient, divergence, lift, inverse, face_laplacian, cut_cells, dirichlet, neumann, robin, patch

    Notes
    -----
    The truncation error is of order 2 inside the domain, and of order 1 (neumann) or 0 (dirichlet) next to a wall;
    solutions of Poisson problems are nevertheless second-order accurate. With ``order=4`` the truncation error is of
    order 2 next to a wall, and solutions are fourth-order accurate. The operator is then symmetric on periodic axes
    only. If all walls are neumann, the solutions of `inverse` and `elliptic_solver` have the integral 0 of a quadrature
    of order 4, whose weights are not equal next to walls; their mean over the cells is therefore not exactly 0.
    Between walls a step of euler is stable for c dt <= 0.34 / sum(1 / h^2); `stepper` raises UnstableStepError beyond
    the limit.

    Values of the field in solid cells have no effect on the other cells. The result in a solid cell is the net flux
    through its faces to cells of the domain; linear solves exclude solid cells.

    Examples
    --------
    >>> import numpy as np
    >>> from sparsedp import Grid
    >>> laplacian(Grid(3))(np.array([1.0, 2.0, 4.0]))
    array([ 1.,  1., -2.])
    """
    check_grid("laplacian", grid)
    check_order("laplacian", grid, order, solid)
    if isinstance(solid, Body):
        return _laplacian_of_cut_cells(grid, boundary, solid, solid_boundary)
    G = gradient(grid, boundary, solid, solid_boundary, order)
    product = divergence(grid, order) @ G
    return Operator(product.structure, grid.cells, grid.cells, G.name.replace("gradient", "laplacian", 1))


def _laplacian_of_cut_cells(grid, boundary, body, solid_boundary):
    """Return the Laplacian of a body, whose grid and conditions must be those of the call."""
    if grid != body.grid:
        raise ValueError(f"laplacian takes a body of cut_cells on its grid {grid}, got one on {body.grid}")
    same_sides = resolve(grid, boundary, patches=True) == resolve(grid, body.boundary, patches=True)
    if not same_sides or solid_boundary != body.solid_boundary:
        raise ValueError(
            "laplacian needs the conditions of its body of cut_cells as boundary and solid_boundary, got others; write "
            "body.laplacian"
        )
    return body.laplacian


def curl(grid: Grid) -> Operator:
    """Return the curl operator from nodes (a stream function, in 2-D) or edges (in 3-D) to faces.

    The divergence of the result is 0 up to rounding.

    Parameters
    ----------
    grid : Grid
        2-D or 3-D.

    Returns
    -------
    Operator
        in: nodes or edges [unit]; out: faces [unit / length]. In 2-D the result is v_x = d psi/dy and
        v_y = -d psi/dx, for a stream function psi of shape ``grid.nodes.shape``. An axis of n cells has n + 1 nodes,
        or n if it is periodic.

    Raises
    ------
    ValueError
        If the grid is 1-D.

    See Also
    --------
    gradient, divergence

    Examples
    --------
    >>> import numpy as np
    >>> from sparsedp import Grid
    >>> grid = Grid((1, 1))
    >>> curl(grid)(np.array([[0.0, 1.0], [0.0, 0.0]]))
    array([1., 0., 0., 1.])
    """
    check_grid("curl", grid)
    if grid.dim == 1:
        raise ValueError(f"curl needs a 2-D or 3-D grid, got {grid}; a 1-D slope is gradient(grid)")
    slope = [differences(grid, axis) for axis in range(grid.dim)]
    if grid.dim == 2:
        blocks = {(0, 0): along(1, 2, slope[1]), (1, 0): along(0, 2, slope[0], -1.0)}
        return kronecker_operator(grid.nodes, grid.faces, blocks, "curl")
    blocks = {}
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # v_a = d psi_c / d b - d psi_b / d c
        blocks[a, c] = along(b, 3, slope[b])
        blocks[a, b] = along(c, 3, slope[c], -1.0)
    return kronecker_operator(grid.edges, grid.faces, blocks, "curl")


def upwind(grid: Grid, axis: int | str = 0, direction: int = 1, boundary: Any = neumann) -> Operator:
    """Return the first-order upwind derivative along one axis, from cells to cells.

    Parameters
    ----------
    grid : Grid
    axis : int or "x", "y", "z"
    direction : 1 or -1
        Sign of the velocity: 1 gives (u[i] - u[i - 1]) / d, and -1 gives (u[i + 1] - u[i]) / d, where d is the distance
        between the two cell centres.
    boundary : condition, or dict of conditions
        Boundary condition that defines the slope on walls, with boundary value 0. The documentation of `lift` shows in
        an example how other values are added.

    Returns
    -------
    Operator
        in: cells [unit]; out: cells [unit / length].

    Raises
    ------
    ValueError
        If the grid has no such axis, or `direction` is not 1 or -1.

    See Also
    --------
    gradient, lift, transport

    Examples
    --------
    >>> import numpy as np
    >>> from sparsedp import Grid
    >>> upwind(Grid(3, periodic=True))(np.array([1.0, 2.0, 4.0]))
    array([-3.,  1.,  2.])

    Solve the steady advection problem w du/dx = 1 with a variable velocity w, and differentiate the solution with
    respect to w:

    >>> from sparsedp import dirichlet, grad, implicit, neumann
    >>> slope = upwind(Grid(3), boundary={"x": (dirichlet, neumann)})
    >>> sweep = implicit(lambda u, w: w * slope(u) - 1.0)
    >>> wind = np.array([2.0, 2.0, 1.0])
    >>> sweep(np.zeros(3), wind)
    array([0.25, 0.75, 1.75])
    >>> grad(lambda w: sweep(np.zeros(3), w)[2])(wind)
    array([-0.125, -0.25 , -1.   ])
    """
    check_grid("upwind", grid)
    number = grid.axis(axis)
    if np.ndim(direction) > 0:
        raise ValueError(
            f"upwind needs direction 1 or -1, got an array of shape {np.shape(direction)}; for a wind w write "
            "np.maximum(w, 0) * upwind(grid, axis, 1)(u) + np.minimum(w, 0) * upwind(grid, axis, -1)(u)"
        )
    if direction not in (1, -1):
        raise ValueError(f"upwind needs direction 1 or -1, got {direction!r}")
    sides = resolve(grid, boundary, patches=True)
    (upstream_face,) = along(number, grid.dim, pick(grid, number, direction == -1))
    terms = tuple(upstream_face @ term for term in slope_terms(grid, number, sides[number]))
    name = f"upwind{describe_patches(sides)}"
    return kronecker_operator(grid.cells, grid.cells, {(0, 0): terms}, name)
