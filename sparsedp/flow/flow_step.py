"""flow_step: a step of incompressible flow, of second order in time, that builds only what the scene needs.

    v* = v + dt (3/2 a(v) - 1/2 a(v_before) - G p) + dt nu (L (v + v*) / 2 + B)
    q  = pressure(v*),    v_next = v* + G q,    p_next = p - q / dt

with a(v) = force(v) - div(v v), and + nu (L v + B) in place of the last term where viscosity is explicit:
Adams-Bashforth for what is explicit, the trapezoidal rule for an implicit viscosity, and a pressure that is corrected,
not solved for anew (incremental).

A friction f >= 0, such as that of an obstacle, is implicit, face by face: v* gets the further term

    -dt f (v* - (v - v_before) / 2)

of second order, as its bracket is the velocity half way. Alone it multiplies by the roots of
(1 + m) z^2 - (1 + m / 2) z + m / 2 = 0, m = dt f: stable for every m, and |z| = 0.71 where m is large, while the
trapezoidal rule would only change the sign there. With f v in a, which then brings in v_before, it is
(1 + dt f) v* = v - dt f v + dt (3/2 a - 1/2 a_before - G p).

Source: van Kan, SIAM J. Sci. Stat. Comput. 7 (1986), second order pressure correction.

Scalars, such as heat or dye, go along in the same way, with the velocity of the same time:

    s_next = s + dt (3/2 r(s, v) - 1/2 r_before) + dt k (L (s + s_next) / 2 + D B),    r = source - D(v (A s + W)),

and + k (L s + D B) in r where diffusion is explicit; B and W bring in what the walls hold, to slopes and to faces.

Convection is explicit. A wave that moves by the Courant number c in a step and is damped by d = dt nu k^2 grows, under
Adams-Bashforth, by the largest root |z| of

    z^2 - z = (3/2 z - 1/2) (i c - d),      or, with implicit damping,  (z^2 - z) + d z (z + 1) / 2 = (3/2 z - 1/2) i c.
"""

from functools import cached_property, partial
from typing import Any

import numpy as np

from sparsedp._utils.calls import public
from sparsedp._utils.pytree import copied, mapped
from sparsedp._utils.reconstruction import Remade
from sparsedp._utils.validation import (
    check_choice,
    check_finite,
    check_function,
    check_number,
    check_on,
    check_type,
    number_beside,
    rounded_down,
)
from sparsedp.autodiff.tape import cast, dtype_of, isbox, plain
from sparsedp.autodiff.tape_constants import frozen
from sparsedp.errors import DerivativeError, ShapeError, UnstableStepError
from sparsedp.flow.momentum import check_walls, convection, face_laplacian, face_lift, free_faces, velocities_of
from sparsedp.flow.pressure_projection import projection
from sparsedp.flow.projection_setup import faces_that
from sparsedp.grid.boundary_conditions import inflow as inflow_side
from sparsedp.grid.boundary_conditions import neumann, no_slip
from sparsedp.grid.grid import check_grid
from sparsedp.operators.difference import divergence, gradient, laplacian
from sparsedp.operators.masks_and_lift import check_solid, identity, lift, mask
from sparsedp.operators.operator import Operator
from sparsedp.operators.transfer import average
from sparsedp.solvers.inverse import inverse

__all__ = ["FlowStep", "flow_step"]

ROUNDING = 1e-12  # a step at the limit may lie beyond it by rounding
SCALAR = "diffusivity", "boundary", "values", "source"
GROWTH = 1.02  # of a wave in one step, that is taken: Adams-Bashforth without damping always has a little
SURE = 0.5  # Courant number up to which no wave grows by that much


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
    scalars=None,
    unstable="raise",
    friction=None,
    inflow=None,
):
    """Return ``step(state, params)`` of incompressible flow, of order 2 in space and time.

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
    walls : callable or array, optional
        Tangential velocities of moving walls and of flow that enters at an angle: ``walls(params)`` -> one flat array
        on ``face_lift(grid, boundary).domain`` [velocity], at the end of a step; differentiable. Velocities that do
        not change may be given as ``face_lift(grid, boundary)(values)``. Default: 0.
    scalars : dict, optional
        Of cell fields that the flow carries: ``{"heat": {"diffusivity": 0.1, "boundary": {"x": dp.dirichlet},
        "values": values, "source": lambda s, params: ...}}``, all four optional: a number >= 0 [length^2 / time], a
        condition or dict (default neumann), wall values as `lift` takes them, a rate [scalar / time] that gets the dict
        of all scalars. Values for x-lower, x-upper, y-lower and y-upper:
        ``dp.lift(grid, {"x": dp.dirichlet}).domain.join(1.0, 0.0, 0.0, 0.0)``. The force is then
        ``force(v, s, params)``.
    unstable : "raise" or "allow"
        What to do when a step is so long that waves would grow.
    friction : array or callable, optional
        Faces >= 0 [1 / time], or ``friction(params)`` -> such faces: the term -friction * v, implicit, for any size of
        it; viscosity is explicit then. With ``rub = dp.brinkman(grid)`` an obstacle of any shape is
        ``lambda radius: viscosity * rub(distance - radius)``. Differentiable. It does nothing on walls and inflows.
    inflow : callable or array, optional
        ``inflow(params)`` -> faces [velocity], whose values on sides of inflow are the normal velocity there at the
        end of a step; differentiable. Default: what the velocity of the state has there, the same at all times.

    Returns
    -------
    FlowStep
        ``step.start(v, params=None)`` makes the first state, a dict of the velocity "v" [velocity], the pressure "p"
        [velocity^2] and the acceleration before "a"; ``step(state, params)`` the next one. For `rollout`. The params
        are those of force, friction, viscosity, walls and inflow. With scalars ``step.start(v, params, s)``, s a dict
        of fields: the state has them as "s", and their rates before as "r". With a function as walls the state has
        the wall velocities as "walls".

    Raises
    ------
    ValueError
        If dt or the viscosity is out of range, a scalar has another entry than those four, a friction comes with
        implicit viscosity, inflow is given without a side of inflow, or an array as walls does not tell the velocity of
        a flow that enters; on use, if a friction is < 0 or complex.
    ShapeError
        If an array as walls is not on the faces; on use, if the state is not one that ``step.start`` makes, or a force,
        friction, source, inflow or wall velocity does not fit its space.
    TypeError
        If scalars is not a dict, or a force or source is no function of as many arguments.
    DerivativeError
        If dt or the viscosity is traced.
    NonFiniteError
        If dt or the viscosity is NaN or infinite; on use, if the velocity or a friction is.
    UnstableStepError
        If dt is beyond what explicit viscosity or diffusivity allows; on use, beyond what convection allows.

    Notes
    -----
    A step of explicit viscosity is stable for dt nu / h^2 <= 1/8 in 2-D (Adams-Bashforth); a longer one is refused.
    Convection is explicit: with c, dt times the largest sum over the axes of |v| / h in a cell, a step is refused where
    waves would grow by more than 2 % in it. Without viscosity that is c > 0.53; viscosity allows more.
    The force of a friction in a step is the sum of volumes * friction * (v* - (v - v_before) / 2), with v* = v_next +
    dt G (p_next - p), as in benchmarks/cylinder.py; v_next in place of the bracket is good at a steady state only.
    Cost: one pressure solve, and one solve for implicit viscosity; the same again backward.
    Source: van Kan, SIAM J. Sci. Stat. Comput. 7 (1986).

    Examples
    --------
    >>> from sparsedp import Grid
    >>> step = flow_step(Grid((4, 4), periodic=True), 0.1)
    >>> state = step(step.start(np.ones(32)), None)
    >>> bool(np.allclose(state["v"], 1.0))
    True

    A wind (1, 0.3) enters through the lower side of each axis, at an angle, and leaves through the upper one.

    >>> from sparsedp import face_lift
    >>> from sparsedp import inflow as enters
    >>> from sparsedp import outflow as leaves
    >>> grid, sides = Grid((4, 4)), {"x": (enters, leaves), "y": (enters, leaves)}
    >>> values = face_lift(grid, sides).domain.join(0.3, 1.0)  # v at x-lower, u at y-lower
    >>> step = flow_step(grid, 0.1, 0.01, boundary=sides, walls=lambda params: values)
    >>> wind = grid.join(1.0, 0.3)
    >>> bool(np.allclose(step(step.start(wind))["v"], wind))
    True
    """
    given = copied(locals())  # the caller may change them
    check_grid("flow_step", grid)
    _check_constant("dt", dt, "> 0")
    if not callable(viscosity):
        _check_constant("viscosity", viscosity, ">= 0")
    elif implicit:
        raise ValueError("implicit viscosity of flow_step is a number, got a function; write implicit=False")
    if scalars is not None:
        check_type("flow_step", scalars, dict, "a dict of scalars", 'scalars={"heat": {...}}')
    if force is not None:
        example = f"force=lambda v, {'s, ' * bool(scalars)}params: ..."
        check_function("flow_step", force, example, 3 if scalars else 2)
    if callable(walls):
        check_function("flow_step, as walls,", walls, "walls=lambda params: values", 1)
    elif walls is not None:
        advice = "; write walls=lambda params: values, or face_lift(grid, boundary)(values)"
        check_on("flow_step, as walls,", walls, grid.faces, advice)
    if callable(inflow):
        check_function("flow_step, as inflow,", inflow, "inflow=lambda params: ...", 1)
    if friction is not None and implicit:
        raise ValueError("flow_step takes no friction beside implicit viscosity; write implicit=False")
    check_choice("unstable", unstable, ("raise", "allow"))
    for name, parts in (scalars or {}).items():
        if not isinstance(parts, dict) or not parts.keys() <= set(SCALAR):
            raise ValueError(f"scalar {name!r} of flow_step needs a dict of {', '.join(SCALAR)}, got {parts!r}")
        _check_constant(f"diffusivity of {name!r}", parts.get("diffusivity", 0.0), ">= 0")
        if parts.get("source") is not None:
            check_function("flow_step", parts["source"], "source=lambda s, params: ...", 2)
    return FlowStep(given)


def _check_constant(name, number, least):
    if isbox(number):
        raise DerivativeError(
            f"flow_step needs a constant {name}, got a traced one; a derivative in the viscosity takes "
            "viscosity=lambda params: ..."
        )
    check_number(f"{name} of flow_step", number, least)


def _remade(given):
    return flow_step(**given)


class FlowStep(Remade):
    """A step of incompressible flow, made by `flow_step` of what is given. What the scene does not need is None."""

    def __init__(self, given):
        self.made = _remade, (given,)
        grid, boundary, solid = given["grid"], given["boundary"], given["solid"]
        self.grid, self.dt, self.force, self.friction = grid, float(given["dt"]), given["force"], given["friction"]
        self.strict, self.implicit = given["unstable"] == "raise", given["implicit"]
        self.may_be_implicit = self.friction is None and not callable(given["viscosity"])
        self.project = projection(grid, solid, boundary)
        self.pressure, self.divergence = self.project.pressure, divergence(grid)
        self.passing = Operator(self.divergence.structure.absolute, grid.faces, grid.cells, "passing")
        setup = self.project.setup
        self.slope = gradient(grid, setup.pressure_conditions, solid)
        self.open = mask(grid.faces, setup.open)
        # A force is for faces that are free: an implicit viscosity would carry it from the others into the fluid.
        self.free = mask(grid.faces, free_faces(grid, setup.sides, solid))
        self.convect: Any = convection(grid, boundary, solid) if given["convective"] else None
        viscous = partial(face_laplacian, grid, boundary, solid, given["solid_boundary"])
        self.viscous = Diffusion("viscosity", given["viscosity"], viscous, self)
        self.wall_motion = WallMotion(self, boundary, solid, given["walls"])
        self.inflow = given["inflow"]
        self.entering: Any = None if self.inflow is None else self._sides_of_inflow(setup.sides, solid)
        self.scalars = {name: Scalar(name, solid, self, **parts) for name, parts in (given["scalars"] or {}).items()}

    def _sides_of_inflow(self, sides, solid):
        """Return the mask of the faces where inflow= says what enters."""
        if inflow_side not in [side for pair in sides for side in pair or ()]:
            raise ValueError("flow_step got inflow= without a side of dp.inflow in boundary=; give both or none")
        inside = faces_that(self.grid, sides, solid, lambda condition: False)
        with_inflows = faces_that(self.grid, sides, solid, lambda condition: condition == inflow_side)
        return mask(self.grid.faces, with_inflows & ~inside)

    def start(self, v, params=None, s=None):
        """Velocity and scalars -> the first state: made incompressible, the pressure still unknown."""
        v, s = self.project(self._entered(v, params)), {} if s is None else s
        if not isinstance(s, dict) or s.keys() != self.scalars.keys():
            raise ShapeError(
                f"flow_step needs the scalars {sorted(self.scalars)}, got "
                f"{list(s) if isinstance(s, dict) else type(s).__name__}; write step.start(v, params, s)"
            )
        p = np.zeros(np.shape(v)[:-1] + self.grid.shape, dtype_of(v))
        walls = self.wall_motion.velocities(params, dtype_of(v))
        state = {"v": v, "p": p, "a": self.acceleration(v, params, s, self._rub(params), walls)}
        if self.wall_motion.changes:
            state["walls"] = walls
        return state | ({"s": s, "r": self._rates(v, s, params)} if s else {})

    def _entered(self, v, params):
        """The velocity with what enters at sides of inflow."""
        if self.inflow is None:
            return v
        given = self.inflow(params) if callable(self.inflow) else self.inflow
        check_on("flow_step, as inflow,", given, self.grid.faces, "; join its components with grid.join")
        return v + self.entering(cast(given, dtype_of(v)) - v)

    @public("dp.flow_step(grid, dt)")
    def __call__(self, state, params=None):
        parts = ["v", "p", "a"]
        if self.scalars:
            parts += ["s", "r"]
        if self.wall_motion.changes:
            parts += ["walls"]
        if not isinstance(state, dict) or state.keys() != set(parts):
            words = f"{', '.join(parts[:-1])} and {parts[-1]}"
            raise ShapeError(f"flow_step takes a dict of {words} as its state; make it with step.start")
        v, p, s, dt = state["v"], state["p"], state.get("s", {}), self.dt
        if self.convect is not None and self.strict:
            self._check_convection(v)
        rub = self._rub(params)
        walls = state.get("walls", self.wall_motion.constant)
        walls_after = self.wall_motion.velocities(params, dtype_of(v))
        a = self.acceleration(v, params, s, rub, walls)
        ahead = v + dt * (1.5 * a - 0.5 * state["a"] - self.slope(p))
        if rub is not None:
            ahead = (ahead - dt * rub * v) / (1.0 + dt * rub)
        ahead = self._entered(ahead, params)
        if self.viscous.relax is not None:
            ahead = self.viscous.relaxed(ahead, v, self.wall_motion.lifted_sum(walls, walls_after))
        q = self.pressure(ahead)
        new = {"v": self.open(ahead) + self.slope(q), "p": p - q / dt, "a": a}
        if self.wall_motion.changes:
            new["walls"] = walls_after
        if s:
            new["r"] = self._rates(v, s, params)
            new["s"] = {k: one.step(s[k], new["r"][k], state["r"][k]) for k, one in self.scalars.items()}
        return new

    def _rates(self, v, s, params):
        return {name: one.rate(v, s, params) for name, one in self.scalars.items()}

    def acceleration(self, v, params, s=None, rub=None, walls=None):
        """a(v): what is explicit, of those parts that the scene has, and rub v (see the head of this file)."""
        a = 0.0 * v if self.convect is None else -self.convect(v, v, walls)
        if self.force is not None:
            a = a + self.free(self._pushed(v, params, *([s] if self.scalars else [])))
        if rub is not None:
            a = a + rub * v
        return self.viscous.added(a, v, params, partial(self.wall_motion.lifted, walls))

    def _pushed(self, v, params, *scalars):
        """The force; a number is the same on all faces."""
        force = self.force(*mapped(frozen, (v, *scalars)), params)
        if np.shape(plain(force)) == ():
            return force * np.ones(v.shape, dtype_of(v))
        check_on("flow_step, as force,", force, self.grid.faces, "; join its components with grid.join")
        return force

    def _rub(self, params):
        """The friction, on faces whose velocity is not given."""
        if self.friction is None:
            return None
        rub = self.friction(params) if callable(self.friction) else self.friction
        check_on("flow_step, as friction,", rub, self.grid.faces, "; write one number for each face")
        values = plain(rub)
        check_finite("flow_step", values, "takes a finite friction")
        if np.any(values != np.abs(values)):  # complex numbers too
            raise ValueError(f"flow_step takes a friction >= 0, got {np.min(values)}; write abs(friction)")
        return self.free(rub)

    def _check_convection(self, v):
        """Refuse a step in which a wave that the flow carries would grow."""
        passing = self.passing.apply(np.abs(plain(v)).astype(float))  # twice the mean |v| / h
        fastest = 0.5 * float(np.max(passing, initial=0.0))
        if SURE < self.dt * fastest < np.inf:
            terms = [self.viscous, *(one.diffused for one in self.scalars.values())]
            growth = max(_growth(self.dt * fastest, term.damping, self.implicit) for term in terms)
            if growth > GROWTH:
                safe = rounded_down(SURE / fastest)
                given = number_beside(self.dt, float(safe), digits=12)
                raise UnstableStepError(
                    f"flow_step is unstable for this velocity with dt = {given}: waves grow by {growth - 1:.0%} "
                    f"a step, at a Courant number of {self.dt * fastest:.3g}; dt = {safe} is "
                    "safe, or write unstable='allow'"
                )

    def __repr__(self):
        parts = {
            "convection": self.convect,
            "viscosity": self.viscous.op,
            "force": self.force,
            "friction": self.friction,
            "scalars": self.scalars or None,
        }
        words = [word for word, part in parts.items() if part is not None]
        return f"<flow step on {self.grid}: {', '.join(['pressure', *words])}>"


class WallMotion:
    """The tangential velocities of walls and inflows, for convection and viscosity.

    Parameters
    ----------
    flow : FlowStep
    boundary, solid
        As `flow_step` takes them.
    given : callable, array or None
        As `flow_step` takes walls.

    Attributes
    ----------
    changes : bool
        Whether the velocities are a function of params; the state then holds them.
    constant : array or None
        Velocities on the space of `face_lift` that do not change, as convection needs them.
    """

    def __init__(self, flow, boundary, solid, given):
        self._grid, self._boundary, self._solid = flow.grid, boundary, solid
        self.given = given
        self.changes = callable(given)
        self.constant: Any = None
        if given is None or self.changes:
            return
        # An implicit viscosity would carry what stands on faces that are not free into the fluid.
        self.given = flow.free(given)
        sides = flow.project.setup.sides
        enters = any(side == inflow_side for pair in sides for side in pair or ())
        if flow.convect is not None and enters:
            self.constant = velocities_of(given, flow.grid, sides)

    @cached_property
    def _lift(self):
        return face_lift(self._grid, self._boundary, self._solid)

    def velocities(self, params, dtype):
        """Return the wall velocities that belong to params, in the dtype of the flow; None where all are 0."""
        if not self.changes:
            return self.constant
        values = self.given(params)
        check_walls("flow_step", values, self._lift.domain)
        return cast(values, dtype)

    def lifted(self, walls):
        """Return what wall velocities add to the Laplacian; None where that is 0."""
        return self._lift(walls) if self.changes else self.given

    def lifted_sum(self, before, after):
        """Return the same for the sum of the wall velocities at both ends of a step."""
        if self.changes:
            return self._lift(before + after)
        return None if self.given is None else 2.0 * self.given


class Diffusion:
    """A term nu (L u + held) of a flow step, by the trapezoidal rule or explicit. For nu = 0 nothing is built.

    Parameters
    ----------
    name : str
        Of nu in messages.
    number : number or callable
        nu.
    make_operator : callable
        Makes L.
    flow : FlowStep

    Attributes
    ----------
    op : Operator or None
        L.
    relax : Operator or None
        The solve of the trapezoidal rule.
    damping : float
        dt nu |L|; 0 where nu is a function.
    """

    def __init__(self, name, number, make_operator, flow):
        self.name, self.number, self.flow = name, number, flow
        self.op: Any = make_operator() if number else None
        self.damping = 0.0
        self.relax: Any = None
        if self.op is None:
            return
        rows = self.op.structure.magnitude()(np.ones(self.op.domain.size))
        self._steepest = float(np.max(rows, initial=0.0))  # no eigenvalue is beyond the largest sum of a row
        if not callable(number):
            self.damping = flow.dt * number * self._steepest
        if flow.implicit:
            self.relax = inverse(identity(self.op.domain) - (0.5 * flow.dt * number) * self.op)
        elif not callable(number):
            self._check_stable(number)

    def added(self, rate, u, params, held):
        """Return a rate plus nu (L u + held()) if that is explicit; `held` is a function to an array or None."""
        if self.op is None or self.relax is not None:
            return rate
        number = self.number
        if callable(number):
            number = number(params)
            check_number("the viscosity of flow_step", plain(number), ">= 0")
            self._check_stable(float(plain(number)))
        return rate + number * self._laplacian(u, held())

    def relaxed(self, ahead, u, held):
        """The new field of the trapezoidal rule.

        Parameters
        ----------
        ahead, u : arrays
            The field that all other terms lead to, and the old one.
        held : array or None
            What walls add to L u at the beginning and at the end of the step, in sum.
        """
        return self.relax(ahead + (0.5 * self.flow.dt * self.number) * self._laplacian(u, held))

    def _laplacian(self, u, held):
        """Return L u and what walls add to it."""
        return self.op(u) if held is None else self.op(u) + held

    def _check_stable(self, number):
        """Adams-Bashforth is stable for dt nu |lambda| <= 1."""
        rate, dt = number * self._steepest, self.flow.dt
        if self.flow.strict and dt * rate > 1 + ROUNDING:
            largest = rounded_down(1 / rate)
            given = number_beside(dt, float(largest), digits=12)
            if self.flow.may_be_implicit:
                advice = "take smaller steps or write implicit=True"
            else:  # refused beside a friction, and for a viscosity that is a function
                advice = "take smaller steps, or write unstable='allow'"
            raise UnstableStepError(
                f"flow_step is unstable for {self.name} = {number:.6g} with dt = {given}: the largest "
                f"stable dt is {largest}; {advice}"
            )


class Scalar:
    """A cell field that the flow carries; the last four arguments as `flow_step` takes them."""

    def __init__(self, name, solid, flow, diffusivity=0.0, boundary=neumann, values=None, source=None):
        grid, self.name, self.flow, self.source = flow.grid, name, flow, source
        self.mean = average(grid, boundary)
        self.held: Any = 0.0
        self.of_walls: Any = None  # their part of the Laplacian
        if values is not None:
            slopes, normal = lift(grid, boundary)(values), flow.divergence.T(np.ones(grid.shape))
            self.of_walls = flow.divergence(slopes)
            if solid is not None:
                self.of_walls = mask(grid.cells, ~check_solid(grid, solid))(self.of_walls)
            self.held = slopes / np.where(slopes != 0, 2 * normal, 1.0)  # the wall's value
        op = partial(laplacian, grid, boundary, solid)
        self.diffused = Diffusion(f"diffusivity of {name!r}", float(diffusivity), op, flow)

    def rate(self, v, s, params):
        """What is explicit."""
        u = s[self.name]
        rate = -self.flow.divergence(v * (self.mean(u) + self.held))
        if self.source is not None:
            source = self.source(mapped(frozen, s), params)
            if np.shape(plain(source)) not in ((), u.shape):
                raise ShapeError(
                    f"flow_step takes a source of {self.name!r} of shape {u.shape}, or a number, got an array of shape "
                    f"{np.shape(plain(source))}; write one number for each cell"
                )
            rate = rate + source
        rate = self.diffused.added(rate, u, params, lambda: self.of_walls)
        check_finite(f"the rate of {self.name!r}", plain(rate))
        return rate

    def step(self, u, rate, before):
        """The field after a step."""
        ahead = u + self.flow.dt * (1.5 * rate - 0.5 * before)
        if self.diffused.relax is None:
            return ahead
        return self.diffused.relaxed(ahead, u, None if self.of_walls is None else 2.0 * self.of_walls)


def _growth(courant, damping, implicit):
    """The largest growth of a wave in a step: see the head of this file."""
    angle = np.linspace(0.0, np.pi, 65)
    c, d = 1j * courant * np.sin(angle), damping * np.sin(angle / 2) ** 2
    a, b, e = (1 + d / 2, 1 - d / 2 + 1.5 * c, 0.5 * c) if implicit else (1.0, 1 + 1.5 * (c - d), 0.5 * (c - d))
    root = np.sqrt(b**2 - 4 * a * e)
    return float(np.max(np.maximum(np.abs(b + root), np.abs(b - root)) / (2 * a)))
