"""flow_step: a step of incompressible flow, of second order in time, that builds only what the scene needs.

    v* = v + dt (3/2 a(v) - 1/2 a(v_before) - G p) + dt nu (L (v + v*) / 2 + B)
    q  = pressure(v*),    v_next = v* + G q,    p_next = p - q / dt

with a(v) = force(v) - div(v v), and + nu (L v + B) in place of the last term where viscosity is explicit:
Adams-Bashforth for what is explicit, the trapezoidal rule for an implicit viscosity, and a pressure that is corrected,
not found anew (incremental).
Source: van Kan, SIAM J. Sci. Stat. Comput. 7 (1986), second order pressure correction.
"""

from typing import Any

import numpy as np

from sparsedp.conditions import no_slip
from sparsedp.constants import constant
from sparsedp.errors import DerivativeError, NonFiniteError, ShapeError, UnstableStepError
from sparsedp.fields import check_function, is_number, rounded_down
from sparsedp.flow.momentum import convection, face_laplacian
from sparsedp.flow.pressure import projection
from sparsedp.operators.boundary import identity, mask
from sparsedp.operators.difference import gradient
from sparsedp.recipe import Remade
from sparsedp.solvers.inverses import inverse
from sparsedp.tape import dtype_of, isbox, plain

__all__ = ["FlowStep", "flow_step"]

ROUNDING = 1e-12  # a step at the limit may lie beyond it by rounding


def flow_step(
    grid,
    dt,
    viscosity=0.0,
    force=None,
    boundary=no_slip,
    solid=None,
    implicit=False,
    convective=True,
    walls=None,
    solid_boundary=no_slip,
):
    """Grid -> ``step(state, params)`` of incompressible flow, of order 2 in space and time.

    Parameters
    ----------
    grid : Grid
    dt : float
        Time step > 0 [time].
    viscosity : float or callable
        >= 0 [length^2 / time]. 0 builds no Laplacian. ``viscosity(params)`` has a derivative; explicit only.
    force : callable, optional
        ``force(v, params)`` -> faces [velocity / time]; whatever is differentiable goes here.
    boundary, solid, solid_boundary
        As in `projection` and `face_laplacian`.
    implicit : bool
        Whether viscosity is implicit: any dt nu / h^2, for one more solve.
    convective : bool
        False: Stokes flow, no div(v v).
    walls : array, optional
        What moving walls add, ``face_lift(grid, boundary)(values)``.

    Returns
    -------
    FlowStep
        ``step.start(v, params=None)`` makes the first state, a dict of the velocity "v" [velocity], the pressure "p"
        [velocity^2] and the acceleration before "a"; ``step(state, params)`` the next one. For `rollout`. The params
        are those of the force.

    Raises
    ------
    ValueError
        If dt or the viscosity is out of range, or a word of `boundary` is not known.
    ShapeError
        On use, if the state is not one that ``step.start`` makes.
    DerivativeError
        If dt or the viscosity is traced.
    NonFiniteError
        If dt or the viscosity is NaN or infinite; on use, if the velocity is.
    UnstableStepError
        If dt is beyond what explicit viscosity allows.

    Notes
    -----
    A step of explicit viscosity is stable for dt nu / h^2 <= 1/8 in 2-D (Adams-Bashforth); a longer one is refused.
    Convection is explicit and no step is refused for it: where there is little viscosity, keep dt times the sum over
    axes of the largest |v| / h below 0.5. A longer step grows until the velocity overflows.
    Cost: one pressure solve, and one solve for implicit viscosity; the same again backward.
    Source: van Kan, SIAM J. Sci. Stat. Comput. 7 (1986).

    Examples
    --------
    >>> from sparsedp import Grid
    >>> step = flow_step(Grid((4, 4), periodic=True), 0.1)
    >>> state = step(step.start(np.ones(32)), None)
    >>> bool(np.allclose(state["v"], 1.0))
    True
    """
    _check_constant("dt", dt, "> 0")
    if not callable(viscosity):
        _check_constant("viscosity", viscosity, ">= 0")
    elif implicit:
        raise ValueError("implicit viscosity of flow_step is a number, got a function; write implicit=False")
    if force is not None:
        check_function("flow_step", force, "force=lambda v, params: ...")
    if walls is not None and np.shape(plain(walls)) != grid.faces.shape:
        raise ShapeError(
            f"flow_step takes walls on {grid.faces}, got an array of shape {np.shape(plain(walls))}; write "
            "face_lift(grid, boundary)(values)"
        )
    viscosity = viscosity if callable(viscosity) else float(viscosity)
    return FlowStep(grid, float(dt), viscosity, force, boundary, solid, implicit, convective, walls, solid_boundary)


def _check_constant(name, number, least):
    if isbox(number):
        raise DerivativeError(
            f"flow_step needs a constant {name}, got a traced one; a derivative in the viscosity takes "
            "viscosity=lambda params: ..."
        )
    if not is_number(number) or number < 0 or (least == "> 0" and number == 0):
        raise ValueError(f"flow_step needs {name} {least}, got {number!r}; write a number")
    if not np.isfinite(number):
        raise NonFiniteError(f"flow_step needs a finite {name}, got {number}; write a number")


class FlowStep(Remade):
    """A step of incompressible flow, made by `flow_step`. What the scene does not need is None."""

    def __init__(self, grid, dt, viscosity, force, boundary, solid, implicit, convective, walls, solid_boundary):
        self.grid, self.dt, self.viscosity, self.force = grid, dt, viscosity, force
        self.project = projection(grid, solid, boundary)
        setup = self.project.structure.setup
        _, solid, boundary, _ = setup.made  # copies, as of the walls: the caller may change them
        walls = constant(walls)
        self.made = grid, dt, viscosity, force, boundary, solid, implicit, convective, walls, solid_boundary
        self.pressure = self.project.pressure
        self.slope = gradient(grid, setup.pressure_conditions, solid)
        self.kept = mask(grid.faces, setup.open)
        self.convect: Any = convection(grid, boundary, solid) if convective else None
        self.laplacian: Any = None
        if viscosity:
            self.laplacian = face_laplacian(grid, boundary, solid, solid_boundary)
        self.walls = walls if viscosity else None
        self.relax: Any = None
        if implicit and viscosity:
            self.relax = inverse(identity(grid.faces) - (0.5 * dt * viscosity) * self.laplacian)
        elif viscosity:
            rows = self.laplacian.structure.magnitude()(np.ones(grid.faces.size))
            self._steepest = float(np.max(rows, initial=0.0))  # no eigenvalue is beyond the largest sum of a row
            if not callable(viscosity):
                self._check_stable(viscosity)

    def recipe(self):
        """The call that makes it again: see recipe.py."""
        return FlowStep, self.made

    def start(self, v, params=None):
        """Velocity -> the first state: made incompressible, the pressure still unknown."""
        v = self.project(v)
        return {"v": v, "p": np.zeros(self.grid.shape), "a": self.acceleration(v, params)}

    def __call__(self, state, params=None):
        if not isinstance(state, dict) or state.keys() != {"v", "p", "a"}:
            raise ShapeError("flow_step takes a dict of v, p and a as its state; make it with step.start")
        v, p, dt = state["v"], state["p"], self.dt
        a = self.acceleration(v, params)
        ahead = v + dt * (1.5 * a - 0.5 * state["a"] - self.slope(p))
        if self.relax is not None:
            half = self.laplacian(v) if self.walls is None else self.laplacian(v) + 2.0 * self.walls  # of v and of v*
            ahead = self.relax(ahead + (0.5 * dt * self.viscosity) * half)
        q = self.pressure(ahead)
        return {"v": self.kept(ahead) + self.slope(q), "p": p - q / dt, "a": a}

    def acceleration(self, v, params):
        """a(v): what is explicit, of those parts that the scene has."""
        a = 0.0 * v if self.convect is None else -self.convect(v, v)
        if self.force is not None:
            a = a + self._pushed(v, params)
        if self.laplacian is not None and self.relax is None:
            bend = self.laplacian(v) if self.walls is None else self.laplacian(v) + self.walls
            a = a + self._number(params) * bend
        return a

    def _pushed(self, v, params):
        """The force; a number is the same on all faces."""
        force = self.force(v, params)
        if np.shape(plain(force)) == ():
            return force * np.ones(v.shape, dtype_of(v))
        if np.shape(plain(force)) != v.shape:
            raise ShapeError(
                f"flow_step takes a force on {self.grid.faces}, got an array of shape {np.shape(plain(force))}; join "
                "its components with grid.join"
            )
        return force

    def _number(self, params):
        """The explicit viscosity."""
        if not callable(self.viscosity):
            return self.viscosity
        found = self.viscosity(params)
        if not is_number(plain(found)) or not 0 <= plain(found) < np.inf:
            raise ValueError(f"the viscosity in flow_step must be a finite number >= 0, got {plain(found)}")
        self._check_stable(float(plain(found)))
        return found

    def _check_stable(self, viscosity):
        """Adams-Bashforth is stable for dt nu |lambda| <= 1."""
        rate = viscosity * self._steepest
        if self.dt * rate > 1 + ROUNDING:
            raise UnstableStepError(
                f"flow_step is unstable for viscosity = {viscosity:.6g} with dt = {self.dt:.12g}: the largest "
                f"stable dt is {rounded_down(1 / rate)}; take smaller steps or write implicit=True"
            )

    def __repr__(self):
        parts = {
            "convection": self.convect,
            "viscosity": self.laplacian,
            "implicit": self.relax,
            "force": self.force,
            "moving walls": self.walls,
        }
        words = [word for word, part in parts.items() if part is not None]
        return f"<flow step on {self.grid}: {', '.join(['pressure', *words])}>"
