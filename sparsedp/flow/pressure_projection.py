"""projection: the divergence-free part of a face field, as one Operator.

With K, D, G and A = -D G as in projection_setup.py,

    P v = K v + G p,          A p = D K v,          so that D P v = D K v - A p = 0,
    P^T g = K (g + D^T q),    A^T q = G^T g,        so that G^T P^T g = 0.

On uniform grids without openings G = -K D^T: P is an orthogonal projection, and both lines are the
same arithmetic. On stretched grids W P is symmetric, with W the volumes of the faces.
Source: Chorin, Math. Comp. 22 (1968); the mesh of Harlow and Welch, Phys. Fluids 8 (1965).
"""

from functools import cached_property

import numpy as np

from sparsedp.flow.projection_setup import Setup
from sparsedp.grid.boundary_conditions import no_slip
from sparsedp.grid.grid import check_grid
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Turning
from sparsedp.solvers.choose_method import check_settings

__all__ = ["Projection", "projection"]


def projection(grid, solid=None, boundary=no_slip, method="auto", rtol=1e-10, maxiter=None, **options):
    """Grid -> the Operator faces -> faces that takes the divergence out of a velocity.

    Parameters
    ----------
    grid : Grid
    solid : bool array, shape `grid.shape`, optional
        Obstacles. Faces that touch one get 0.
    boundary : flow condition or dict
        no_slip, free_slip (both closed here), inflow (keeps the value that is given) or outflow
        (pressure 0), for all bounded sides or as {"x": (lower, upper), ...}; axes that are not named are
        no_slip. An inflow is the value that the faces of that side already have.
    method, rtol, maxiter, **options
        Of the pressure solve, as in `inverse`.

    Returns
    -------
    Projection
        in: faces [velocity]; out: faces [velocity], of divergence 0 to `rtol`. ``P.pressure(v)`` is the
        potential p [velocity length] with P(v) = v + G(p) inside; ``P.info`` holds the records of the solves.

    Raises
    ------
    ShapeError
        If `solid` has another shape than the grid.
    ValueError
        If an axis is named that is periodic or not there, or an inflow enters a region without an outflow.
    TypeError
        If `boundary` holds what is no flow condition.
    NonFiniteError
        On use, if the velocity holds NaN or infinity anywhere, walls included.
    ConvergenceError
        On use, if the solve does not meet `rtol`.

    Notes
    -----
    Null space: the pressure of a closed region is known up to a constant, which is taken out, region by
    region. Transpose: ``P.T(g)`` equals ``P(g)`` bit for bit on uniform grids without openings.
    Cost: one pressure solve, forward and backward; one node on the tape.
    Source: Chorin, Mathematics of Computation 22 (1968).

    Examples
    --------
    >>> from sparsedp import Grid
    >>> P = projection(Grid((2, 2), periodic=True))
    >>> P(np.array([1.0, 2.0, 3.0, 4.0, 0.0, 0.0, 0.0, 0.0]))
    array([2., 3., 2., 3., 0., 0., 0., 0.])
    """
    check_grid("projection", grid)
    settings = check_settings(method, rtol, maxiter, "project", options)
    return Projection(Setup(grid, solid, boundary, settings))


class Projected(Turning):
    """P or P^T on flat face fields, of a Setup. It solves in double precision, and rounds once."""

    def act(self, x, out):
        self.inner.split(x, out, self.transposed)


class Potential(Turning):
    """Face field -> the p with P v = v + G p, one of average 0 where only its slope is known; or the transpose."""

    def act(self, x, out):
        setup, scale = self.inner, 2.0**self.inner.exponent
        if self.transposed:
            setup.pressed(scale * x, out)
        else:
            p = setup.split(x, np.empty(x.size))
            np.multiply(scale, setup.inverse.solver.system.null_space.project(p), out=out)


class Projection(Operator):
    """The Operator that `projection` makes, with its pressure and its records."""

    setup: Setup

    def __init__(self, setup):
        faces = setup.grid.faces
        structure = (
            Projected(setup, (faces.size,) * 2) if faces.backend.whole_fields else setup.operators()[0].structure
        )
        super().__init__(structure, faces, faces, "projection", "matrix-free")
        vars(self)["setup"] = setup

    def recipe(self):
        """The call that makes it again: see _utils/reconstruction.py."""
        return Projection, (self.setup,)

    @property
    def info(self):
        """SolveLog of the pressure solves: .forward, .adjoint, .setup_seconds."""
        return self.setup.info

    @property
    def method(self):
        """The word of the pressure solver in use."""
        return self.setup.inverse.method

    @cached_property
    def pressure(self):
        """Operator faces -> cells: the p with P(v) = v + G(p) on the faces where the flow is free [velocity length]."""
        setup, cells = self.setup, self.setup.grid.cells
        shape = cells.size, self.domain.size
        structure = Potential(setup, shape) if cells.backend.whole_fields else setup.operators()[1].structure
        return Operator(structure, self.domain, cells, "pressure")

    def __str__(self):
        return str(self.setup.inverse)
