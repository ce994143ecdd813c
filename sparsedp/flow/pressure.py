"""projection: the divergence-free part of a face field, as one Operator.

With K the mask of the faces that are not closed, D the divergence, G the gradient of the pressure
(0 on closed and on given faces) and A = -D G,

    P v = K v + G p,          A p = D K v,          so that D P v = D K v - A p = 0,
    P^T g = K (g + D^T q),    A^T q = G^T g,        so that G^T P^T g = 0.

On uniform grids without openings G = -K D^T: P is an orthogonal projection, and both lines are the
same arithmetic. On stretched grids W P is symmetric, with W the volumes of the faces.
Source: Chorin, Math. Comp. 22 (1968); the mesh of Harlow and Welch, Phys. Fluids 8 (1965).
"""

from functools import cached_property

import numpy as np

from sparsedp.fields import check_finite, place
from sparsedp.flow.setup import Setup
from sparsedp.grid import check_grid
from sparsedp.ledger import active as recordings
from sparsedp.ledger import count, tally
from sparsedp.operator import Operator
from sparsedp.operators.boundary import mask
from sparsedp.solvers.choose import check_settings
from sparsedp.solvers.record import Run
from sparsedp.solvers.scaling import in_range, largest, norm, shifted
from sparsedp.structure.base import Structure

__all__ = ["Projection", "projection"]

EPS = np.finfo(float).eps


def projection(grid, solid=None, boundary="no_slip", method="auto", rtol=1e-10, maxiter=None, **options):
    """Grid -> the Operator faces -> faces that takes the divergence out of a velocity.

    Parameters
    ----------
    grid : Grid
    solid : bool array, shape `grid.shape`, optional
        Obstacles. Faces that touch one get 0.
    boundary : str or dict
        "no_slip", "free_slip" (both closed here), "inflow" (keeps the value that is given) or "outflow"
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
        If a word of `boundary` is not known, or an inflow enters a region without an outflow.
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
    check_settings(method, rtol, maxiter, "project")
    settings = (method, rtol, maxiter, options)
    return Projection(Setup(grid, solid, boundary, settings))


class Projected(Structure):
    """P or P^T on flat face fields."""

    has_entries = False

    def __init__(self, setup, transposed=False):
        self.setup, self.transposed = setup, transposed
        self.shape = (setup.grid.faces.size,) * 2

    def transpose(self):
        return Projected(self.setup, not self.transposed)

    def apply(self, x, out):
        if x.dtype.kind == "c":
            for part, target in ((x.real, out.real), (x.imag, out.imag)):
                np.copyto(target, self._fresh(part), casting="same_kind")
        elif x.dtype == np.float64 and out.dtype == np.float64:
            self._project(x, out)
        else:  # solved in double precision, rounded once
            np.copyto(out, self._fresh(x), casting="same_kind")

    def _fresh(self, x):
        out = np.empty(x.size)
        self._project(np.ascontiguousarray(x, dtype=np.float64), out)
        return out

    def _project(self, x, out):
        setup, size, exponent = self.setup, norm(x), 0
        if not in_range(size):
            top = largest(x)
            if not np.isfinite(top):
                self._refuse(x)
            exponent = int(np.frexp(top)[1])
            x = shifted(x, -exponent)
            size = norm(x)
        if setup.passes is None or not self._by_transforms(x, out, size):
            np.copyto(out, x)
            out[setup.closed] = 0.0
            self._by_contract(out)
        if setup.still:
            out[:] = 0.0
        elif exponent:
            out[:] = shifted(out, exponent)

    def _refuse(self, x):
        faces = self.setup.grid.faces

        def where(index):
            axis = int(np.searchsorted(faces.offsets, index, side="right")) - 1
            return f"{faces.grid.axes[axis]}-face {place(index - faces.offsets[axis], faces.parts[axis])}"

        check_finite("the cotangent of projection" if self.transposed else "the velocity in projection", x, where=where)

    def _by_transforms(self, x, out, length):
        """The solve without the contract's own passes: the divergence of the result is its true residual.

        False when that is not below the tolerance: then the contract decides, and refines or raises.
        """
        setup, turned, run = self.setup, self.transposed, Run()
        passes, engine = setup.passes[turned], setup.solver.engine
        b = np.empty(setup.grid.cells.size)
        size = passes.net_flow(x, b)
        p = engine.solve(b, 0.0, turned and not setup.symmetric)[0]
        passes.push(x, p, out)
        residual, goal = passes.net_flow(out, np.ascontiguousarray(p)), setup.solver.system.rtol * size
        if not residual <= max(goal, 8 * EPS * setup.reach[turned] * length):
            return False
        run.status = "converged" if residual <= goal else "converged_at_roundoff"
        run.residual = residual / size if size else 0.0
        tally.solves += 1
        if recordings:
            count(setup.solver.name, "adjoint" if turned else "solve")
        setup.solver.log.note(run.info(), turned)
        return True

    def _by_contract(self, out):
        """The solve inside the contract; the transposed one with the true transpose, unless that is the same."""
        setup, turned, log = self.setup, self.transposed, self.setup.solver.log
        b = setup.firsts[turned].product(out)
        if turned and setup.symmetric:
            before = log.forward
            p = setup.solver.solve(b, False, checked=False)
            log.adjoint, log.forward = log.forward, before
        else:
            p = setup.solver.solve(b, turned, checked=False)
        self._add(p, out)

    def _add(self, p, out):
        out += self.setup.seconds[self.transposed].product(p)
        if self.transposed and not self.setup.symmetric:  # D^T reaches the walls, G does not
            out[self.setup.closed] = 0.0


class Projection(Operator):
    """The Operator that `projection` makes, with its pressure and its records."""

    structure: Projected

    def __init__(self, setup):
        faces = setup.grid.faces
        super().__init__(Projected(setup), faces, faces, "projection", "matrix-free")

    def __reduce__(self):
        return _remade, self.structure.setup.recipe

    @property
    def info(self):
        """SolveLog of the pressure solves: .forward, .adjoint, .setup_seconds."""
        return self.structure.setup.inverse.info

    @property
    def method(self):
        """The word of the pressure solver in use."""
        return self.structure.setup.inverse.method

    @cached_property
    def pressure(self):
        """Operator faces -> cells: the p with P(v) = v + G(p) on the faces where the flow is free [velocity length]."""
        setup = self.structure.setup
        solve = setup.inverse.tangent @ setup.D @ mask(setup.D.domain, setup.open)
        chain = solve.structure.scaled(2.0**setup.exponent)
        return Operator(chain, setup.grid.faces, setup.grid.cells, "pressure")

    def __str__(self):
        return str(self.structure.setup.inverse)


def _remade(grid, solid, boundary, settings):
    return Projection(Setup(grid, solid, boundary, settings))
