"""flow_step: a time step of incompressible flow, second-order accurate; only the operators it needs are built.

    v* = v + dt (3/2 a(v) - 1/2 a(v_previous) - G p) + dt nu (L (v + v*) / 2 + B)
    q  = pressure(v*),    v_next = v* + G q,    p_next = p - q / dt

with a(v) = force(v) - div(v v). This is the form for implicit viscosity. If viscosity is explicit, a(v) also contains
nu (L v + B), and the last term of the first line is omitted. Explicit terms are advanced by the second-order
Adams-Bashforth method, implicit viscosity by the trapezoidal rule. The pressure is corrected in each step (incremental
pressure correction). B is the contribution of the tangential velocities of walls.

A friction f >= 0, such as that of an obstacle, is implicit and acts on each face separately. It adds to v* the term

    -dt f (v* - (v - v_previous) / 2),

which is second-order accurate, because the bracket approximates the velocity at half the step. Without other terms the
step multiplies v by a root z of (1 + m) z^2 - (1 + m / 2) z + m / 2 = 0 with m = dt f. It is stable for every m, and
|z| tends to 0.71 for large m, whereas |z| of the trapezoidal rule tends to 1. In the code a also contains f v, so that
a_previous supplies the term with v_previous:

    (1 + dt f) v* = v - dt f v + dt (3/2 a - 1/2 a_previous - G p).

Scalars are advanced with the velocity at the beginning of the step; see `scalars`. Convection is explicit; see
`diffusion` for the amplification of waves.

A viscosity that varies in space replaces nu (L v + B) by div(mu (grad v + grad v^T)); see `viscous_stress` and
`variable_diffusion`. With a density rho, this term and G p are divided by rho, and G q by rho in the projection; see
`variable_density`. Explicit terms take mu and rho at the beginning of the step, all others take them at half the step.
If dt is a function, the previous acceleration has the weight -r / 2 and the new one 1 + r / 2, with the ratio r of this
step length to the previous one.

References
----------
J. van Kan, SIAM J. Sci. Stat. Comput. 7 (1986) (second-order pressure correction).
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.base_classes import Reconstructible
from sparsedp._utils.calls import deprecated_attribute, public
from sparsedp._utils.pytree import copied, mapped
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
from sparsedp.autodiff.program_trace import check_values
from sparsedp.autodiff.tape import cast, dtype_of, isbox, real_dtype, sample
from sparsedp.autodiff.tape_constants import frozen
from sparsedp.errors import DerivativeError, ShapeError, UnstableStepError
from sparsedp.flow.diffusion import Diffusion, wave_growth
from sparsedp.flow.momentum import convection, face_laplacian, free_face_mask
from sparsedp.flow.moving_walls import moving_walls
from sparsedp.flow.pressure_projection import projection
from sparsedp.flow.projection_setup import mask_of_faces
from sparsedp.flow.scalars import Scalar
from sparsedp.flow.settings import FlowSettings, needs_fields
from sparsedp.flow.variable_density import density_on_faces
from sparsedp.flow.variable_diffusion import Coefficient, VariableDiffusion, in_precision_of, is_constant
from sparsedp.flow.viscous_stress import ViscousStress
from sparsedp.grid.boundary_conditions import inflow as inflow_side
from sparsedp.grid.boundary_conditions import no_slip, occurring
from sparsedp.grid.grid import check_grid
from sparsedp.operators.difference import divergence, gradient
from sparsedp.operators.masks_and_lift import mask
from sparsedp.operators.operator import Operator

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike

    from sparsedp.grid.grid import Grid

__all__ = ["FlowStep", "flow_step"]

SCALAR_ENTRIES = ("diffusivity", "boundary", "values", "source")
# Largest accepted amplification of a wave in a step at Courant numbers above SAFE_COURANT. Without damping,
# Adams-Bashforth always amplifies waves slightly.
MAX_GROWTH = 1.02
SAFE_COURANT = 0.5  # Courant number up to which steps are accepted; without viscosity, waves grow there by 2.7 %


def flow_step(
    grid: Grid,
    dt: float | Callable[[Any], Any],
    viscosity: Any = 0.0,
    force: Callable | None = None,
    boundary: Any = no_slip,
    solid: ArrayLike | None = None,
    implicit: bool = False,
    convective: bool = True,
    walls: Any = None,
    solid_boundary: Any = no_slip,
    scalars: dict[str, dict[str, Any]] | None = None,
    unstable: str = "raise",
    friction: Any = None,
    inflow: Any = None,
    density: Any = None,
) -> FlowStep:
    """Return the time step ``step(state, params)`` of incompressible flow, of order 2 in space and time.

    Parameters
    ----------
    grid : Grid
    dt : float or callable
        Time step > 0 [time]. A function ``dt(params)`` returns the length of each step; differentiable.
    viscosity : number, array or callable
        >= 0 [length^2 / time], one number or one for each cell, with which the viscous term is
        div(viscosity (grad v + grad v^T)). A function ``viscosity(params)`` returns such a number or array. A function
        ``viscosity(shear_rate, params)``, with scalars ``viscosity(shear_rate, s, params)``, also gets the shear rate
        sqrt(2 D : D) [1 / time] in the cells, where D = (grad v + grad v^T) / 2. Functions are differentiable. With a
        density, this is the dynamic viscosity [density length^2 / time].
    force : callable, optional
        ``force(v, params)`` returns an array on faces [velocity / time], or a number.
    boundary, solid, solid_boundary
        As in `projection` and `face_laplacian`. Openings in a wall are written with `patch`.
    implicit : bool
        Whether viscosity and the diffusion of scalars are implicit. They are then stable for every dt, at the cost of
        one additional solve each per step.
    convective : bool
        Whether to include convection, div(v v). False gives (unsteady) Stokes flow.
    walls : callable or array, optional
        Tangential velocities of moving walls, and of flow that enters at an angle. ``walls(params)`` returns the
        velocities at the end of a step, one flat array on ``face_lift(grid, boundary).domain`` [velocity];
        differentiable. Constant velocities may be given as the array ``face_lift(grid, boundary)(velocities)``, unless
        the viscosity depends on the shear rate. Default: 0.
    scalars : dict, optional
        Cell fields that the flow carries, such as ``{"heat": {"diffusivity": 0.1, "boundary": {"x": dp.dirichlet},
        "values": values, "source": lambda s, params: ...}}``. All four entries are optional. "diffusivity": >= 0
        [length^2 / time], one number or one for each cell, or a function ``diffusivity(params)`` or
        ``diffusivity(s, params)`` that returns them; differentiable. "boundary": a condition or a dict (default
        neumann). "values": wall values as `lift` takes them, here for x-lower, x-upper, y-lower and y-upper
        ``dp.lift(grid, {"x": dp.dirichlet}).domain.join(1.0, 0.0, 0.0, 0.0)``, or a function ``values(params)`` that
        returns those at the end of a step; differentiable. "source": a function that returns the rate [scalar / time]
        from the dict of all scalars. With scalars, the force is called as ``force(v, s, params)``.
    unstable : "raise" or "allow"
        Whether to raise UnstableStepError if dt is too large for stability.
    friction : array or callable, optional
        Array on faces >= 0 [1 / time], or ``friction(params)`` that returns one; differentiable. It adds the term
        -friction * v, which is implicit and stable for every size; viscosity must then be explicit. With
        ``drag = dp.brinkman(grid)``, the friction ``lambda radius: viscosity * drag(distance - radius)`` represents an
        obstacle of any shape. It has no effect on the faces of walls and inflows.
    inflow : callable or array, optional
        ``inflow(params)`` returns an array on faces [velocity]; differentiable. Its values on inflow boundaries are the
        normal velocity there at the end of a step; all other values are ignored. Default: the normal velocity keeps the
        values of the first state.
    density : number, array or callable, optional
        > 0 [density], one number or one for each cell, or a function ``density(params)``, with scalars also
        ``density(s, params)``, that returns them; differentiable. The viscous term and the gradient of the pressure
        are divided by it; the force remains an acceleration. The flow does not move a density that is an array: give
        a function of a scalar, or move it with `transport` and pass it in the params. Default: 1.

    Returns
    -------
    FlowStep
        ``step.start(v, params=None)`` returns the first state, a dict of the velocity "v" [velocity], the pressure "p"
        [velocity^2] and the previous acceleration "a". ``step(state, params)`` returns the next state, for `rollout`.
        The params are passed to all arguments that are functions. With scalars,
        ``step.start(v, params, s)`` takes a dict of cell fields. The state then also holds these as "s" and their
        previous rates as "r". If `walls` is a function, the state also holds the wall velocities as "walls"; if wall
        values of scalars are functions, it holds these as "values"; if `dt` is a function, the step length as "dt"; if
        an implicit viscosity depends on the shear rate, the previous velocity as "before"; if an implicit diffusivity
        depends on scalars, the previous scalars as "s_before". With a density, the pressure has the unit
        [density velocity^2]. The pressure of a state belongs to the middle of the step before it: it has order 2 there,
        and order 1 in dt at the time of the velocity.

    Raises
    ------
    ValueError
        If dt, the viscosity, a diffusivity or the density is out of range, a scalar has an entry other than those
        four, a friction is given with implicit viscosity, `inflow` is given without an inflow boundary, an array as
        `walls` without a side that has a tangential velocity, or beside a viscosity that depends on the shear rate, or
        it does not determine the tangential velocity at an inflow boundary. On use, if a friction is < 0 or complex, or
        `walls` is an array that does not determine the velocities of walls, which a viscosity for each cell needs.
    ShapeError
        If `walls` is an array of another shape than the faces, or a viscosity, diffusivity or density is an array of
        another shape than the cells. On use, if the state does not have the entries that ``step.start`` returns, or a
        force, friction, source, inflow or wall velocity has the wrong shape.
    TypeError
        If scalars is not a dict, or a function does not take the right number of arguments.
    DerivativeError
        If dt, a viscosity, a diffusivity or a density that is not given as a function is traced.
    NonFiniteError
        If dt, the viscosity, a diffusivity or the density is NaN or infinite. On use, if the velocity or a friction is.
    UnstableStepError
        If dt is too large for explicit viscosity or diffusivity. On use, if it is too large for convection.

    See Also
    --------
    transport, projection, convection, face_laplacian, face_lift, brinkman, cut_flow, no_slip, free_slip, inflow,
    outflow, rollout

    Notes
    -----
    Explicit viscosity is stable for dt nu / h^2 <= 1/8 in 2-D (Adams-Bashforth), and for <= 1/16 where it varies in
    space; a larger dt raises an error.
    At an outflow the normal viscous stress is 0, as if the velocity there did not change along the axis.
    A function that is the viscosity, a diffusivity or the density is called with the params alone if it accepts one
    positional argument, and with the fields too if it accepts as many as are named above. The rule is the same for
    functions, methods, ``functools.partial`` and objects with ``__call__``. A function that accepts both numbers, by a
    default value or by ``*args``, is refused; bind other values by keyword: ``lambda params, *, k=k: ...``.
    Implicit terms take the viscosity and the diffusivity at half the step. A viscosity of the shear rate, and a
    diffusivity of scalars, are computed there from fields that are extrapolated from this and the previous step, so
    that each step solves linear systems alone, with order 2. Steps of any length are stable if such a viscosity changes
    at most in proportion to the shear rate or to its inverse, as in Smagorinsky's model and for plastic fluids.
    A viscosity, diffusivity or density in solid cells has no effect, is not checked and has the derivative 0: beside an
    obstacle, stresses are computed from the harmonic average of the viscosity of fluid cells alone. In solid cells a
    function of the shear rate gets the shear rate of the first fluid cell.
    A viscosity, diffusivity or density that varies in space is not available on ranks.
    Convection is explicit. Let the Courant number c be dt times the largest sum over the axes of |v| / h in a cell. A
    step with c > 0.5 raises an error if it would amplify waves by more than 2 %. Without viscosity the limit is
    therefore c = 0.5, where waves grow by 2.7 % a step, and viscosity increases it.
    The force that a friction exerts in a step is the sum of volumes * friction * (v* - (v - v_previous) / 2), where
    v* = v_next + dt G (p_next - p), as in benchmarks/cylinder.py. The bracket equals v_next only at a steady state.
    Cost: one pressure solve per step, and one more solve for implicit viscosity; as many in the backward pass. A solve
    with a coefficient that changes from step to step includes a new set-up.

    References
    ----------
    J. van Kan, SIAM J. Sci. Stat. Comput. 7 (1986).

    Examples
    --------
    >>> from sparsedp import Grid
    >>> step = flow_step(Grid((4, 4), periodic=True), 0.1)
    >>> state = step(step.start(np.ones(32)), None)
    >>> bool(np.allclose(state["v"], 1.0))
    True

    A wind (1, 0.3) enters through the lower side of each axis, at an angle, and leaves through the upper side.

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
    arguments = dict(
        grid=grid,
        dt=dt,
        viscosity=viscosity,
        force=force,
        boundary=boundary,
        solid=solid,
        implicit=implicit,
        convective=convective,
        walls=walls,
        solid_boundary=solid_boundary,
        scalars=scalars,
        unstable=unstable,
        friction=friction,
        inflow=inflow,
        density=density,
    )
    settings = FlowSettings(**copied(arguments))  # copies: the caller may change the originals
    _check(settings)
    return FlowStep(settings.with_plain_numbers())


def _check(settings: FlowSettings) -> None:
    """Raise an error if arguments of `flow_step` are out of range or contradict each other."""
    check_grid("flow_step", settings.grid)
    if callable(settings.dt):
        needs_fields("dt", settings.dt, ())
    else:
        _check_constant("dt", settings.dt, "> 0")
    _check_coefficient("viscosity", settings.viscosity, ">= 0")
    if settings.density is not None:
        settings.grid.backend.check("density in flow_step")
        _check_coefficient("density", settings.density, "> 0")
    if settings.scalars is not None:
        check_type("flow_step", settings.scalars, dict, "a dict of scalars", 'scalars={"heat": {...}}')
    if settings.force is not None:
        if settings.scalars:
            check_function("flow_step", settings.force, "force=lambda v, s, params: ...", 3)
        else:
            check_function("flow_step", settings.force, "force=lambda v, params: ...", 2)
    if needs_fields("density", settings.density, settings.fields_of("density")) and not settings.scalars:
        raise ValueError(
            "density of flow_step is a function of scalars, and there are none; write density=lambda params: ..."
        )
    needs_fields("viscosity", settings.viscosity, settings.fields_of("viscosity"))
    if callable(settings.walls):
        check_function("flow_step, as walls,", settings.walls, "walls=lambda params: values", 1)
    elif settings.walls is not None:
        advice = "; write walls=lambda params: values, or face_lift(grid, boundary)(values)"
        check_on("flow_step, as walls,", settings.walls, settings.grid.faces, advice)
    if callable(settings.inflow):
        check_function("flow_step, as inflow,", settings.inflow, "inflow=lambda params: ...", 1)
    if settings.friction is not None and settings.implicit:
        raise ValueError("flow_step takes no friction beside implicit viscosity; write implicit=False")
    check_choice("unstable", settings.unstable, ("raise", "allow"))
    for name, entries in (settings.scalars or {}).items():
        if not isinstance(entries, dict) or not entries.keys() <= set(SCALAR_ENTRIES):
            raise ValueError(
                f"scalar {name!r} of flow_step needs a dict of {', '.join(SCALAR_ENTRIES)}, got {entries!r}"
            )
        diffusivity = entries.get("diffusivity", 0.0)
        _check_coefficient(f"diffusivity of {name!r}", diffusivity, ">= 0")
        needs_fields("diffusivity", diffusivity, settings.fields_of("diffusivity"))
        if entries.get("source") is not None:
            check_function("flow_step", entries["source"], "source=lambda s, params: ...", 2)
        if callable(entries.get("values")):
            check_function("flow_step, as values,", entries["values"], "values=lambda params: ...", 1)


def _check_coefficient(name: str, value: Any, range_: str) -> None:
    """Raise unless a coefficient is a function, or constant: an array, or a number in the given range."""
    if callable(value):
        return
    _check_not_traced(name, value)
    if np.ndim(value) == 0:
        _check_constant(name, value, range_)


def _check_constant(name: str, number: Any, range_: str) -> None:
    """Raise unless an argument is a finite number in the given range that is not traced."""
    _check_not_traced(name, number)
    check_number(f"{name} of flow_step", number, range_)


def _check_not_traced(name: str, value: Any) -> None:
    if isbox(value):
        argument = name.split()[0]
        raise DerivativeError(
            f"flow_step needs a constant {name}, got a traced one; a derivative in the {argument} takes "
            f"{argument}=lambda params: ..."
        )


def _rebuild(arguments: dict[str, Any]) -> FlowStep:
    return flow_step(**arguments)


class FlowStep(Reconstructible):
    """A time step of incompressible flow, as `flow_step` returns it.

    Parameters
    ----------
    settings : FlowSettings

    Attributes
    ----------
    grid : Grid
    dt : float or callable
    project : Projection
    pressure : Operator
        From a face field to the pressure potential of `project`.
    divergence, pressure_gradient : Operator
    convect : callable or None
        The function that `convection` returns; None without convection.
    viscous : Diffusion or VariableDiffusion
    walls : WallsAtRest
        Tangential velocities of walls.
    scalars : dict of Scalar
    """

    slope = deprecated_attribute("slope", "pressure_gradient", "0.5")

    def __init__(self, settings: FlowSettings) -> None:
        grid = settings.grid
        self.settings = settings
        self.grid = grid
        self.dt: Any = settings.dt
        self.project = projection(grid, settings.solid, settings.boundary)
        self.pressure = self.project.pressure
        self.divergence = divergence(grid)
        setup = self.project.setup
        self.pressure_gradient = gradient(grid, setup.pressure_conditions, settings.solid)
        self.convect: Any = None
        if settings.convective:
            self.convect = convection(grid, settings.boundary, settings.solid)
        build_laplacian = partial(face_laplacian, grid, settings.boundary, settings.solid, settings.solid_boundary)
        self.viscous: Any
        if is_constant(settings.viscosity, settings) and settings.density is None:
            self.viscous = Diffusion("viscosity", settings.viscosity, build_laplacian, settings)
        else:
            build_stress = partial(ViscousStress, settings, setup.sides)
            self.viscous = VariableDiffusion("viscosity", settings.viscosity, settings, build_stress, build_laplacian)
        self._density: Any = None
        if settings.density is not None:
            self._density = Coefficient("density", settings.density, settings, "> 0")
            self._to_faces = density_on_faces(grid)
            self._weighted_projection = self.project.weighted
        depends_on_flow = self.viscous.varies and self.viscous.coefficient.needs_fields
        self._extrapolates = settings.implicit and depends_on_flow
        self.walls = moving_walls(settings, setup.sides)
        if depends_on_flow and settings.walls is not None and not self.walls.changes:
            raise ValueError(
                "flow_step takes walls= as a function beside a viscosity that depends on the shear rate; write "
                "walls=lambda params: values, with values on face_lift(grid, boundary).domain"
            )
        self.scalars = {
            name: Scalar(name, settings, self.divergence, **entries)
            for name, entries in (settings.scalars or {}).items()
        }
        self._extrapolates_scalars = settings.implicit and any(
            scalar.diffusion.varies and scalar.diffusion.coefficient.needs_fields for scalar in self.scalars.values()
        )
        self._open_faces = mask(grid.faces, setup.open)
        # Forces are set to 0 on all other faces, because an implicit viscosity would spread them into the fluid.
        self._free_faces = mask(grid.faces, free_face_mask(grid, setup.sides, settings.solid))
        self._total_flow = Operator(self.divergence.structure.absolute, grid.faces, grid.cells, "total flow")
        self._inflow_faces: Any = None
        if settings.inflow is not None:
            self._inflow_faces = self._inflow_mask(setup.sides)

    def recipe(self) -> tuple:
        """Return the call that builds an equal object, for pickling and copying."""
        return _rebuild, (dict(vars(self.settings)),)

    def _inflow_mask(self, sides: tuple) -> Operator:
        """Return the mask of the faces whose normal velocity is given by `inflow`."""
        if inflow_side not in occurring(sides):
            raise ValueError("flow_step got inflow= without a side of dp.inflow in boundary=; give both or none")
        solid = self.settings.solid
        inside = mask_of_faces(self.grid, sides, solid, lambda condition: False)
        inside_and_inflows = mask_of_faces(self.grid, sides, solid, lambda condition: condition == inflow_side)
        return mask(self.grid.faces, inside_and_inflows & ~inside)

    def start(self, v: Any, params: Any = None, s: dict[str, Any] | None = None) -> dict[str, Any]:
        """Return the first state.

        Parameters
        ----------
        v : array on faces
            Velocity; its divergence is removed.
        params : tree, optional
            As for the call.
        s : dict of arrays, optional
            The scalars.

        Returns
        -------
        dict
            The state, with a pressure of 0.
        """
        if s is None:
            s = {}
        if not isinstance(s, dict) or s.keys() != self.scalars.keys():
            if isinstance(s, dict):
                names = list(s)
            else:
                names = type(s).__name__
            raise ShapeError(
                f"flow_step needs the scalars {sorted(self.scalars)}, got {names}; write step.start(v, params, s)"
            )
        v = self._set_inflow(v, params)
        if self._density is None:
            v = self.project(v)
        else:
            v, _ = self._weighted_projection.split(v, self._face_density(s, params, v))
        walls = self.walls.velocities(params, dtype_of(v))
        dt = self._step_length(params, dtype_of(v))
        state = {
            "v": v,
            "p": np.zeros(np.shape(v)[:-1] + self.grid.shape, dtype_of(v)),
            "a": self.acceleration(v, params, s, self._friction(params, dtype_of(v)), walls, dt),
        }
        if self.walls.changes:
            state["walls"] = walls
        if callable(self.dt):
            state["dt"] = dt
        if self._extrapolates:
            state["before"] = v
        if s:
            state["s"] = s
            if self._extrapolates_scalars:
                state["s_before"] = s
            values = self._wall_values(s, params)
            state["r"] = self._rates(v, s, params, values, dt)
            if values:
                state["values"] = values
        return state

    @public("dp.flow_step(grid, dt)")
    def __call__(self, state: dict[str, Any], params: Any = None) -> dict[str, Any]:
        """Return the state after one step.

        Parameters
        ----------
        state : dict
            A state from ``step.start`` or from the call.
        params : tree, optional
            Passed to all arguments of `flow_step` that are functions.

        Returns
        -------
        dict
        """
        self._check_state(state)
        v = state["v"]
        dt = self._step_length(params, dtype_of(v))
        p = state["p"]
        s = state.get("s", {})
        if self.convect is not None and self.settings.strict:
            check_values(self._check_convection, v, dt)
        friction = self._friction(params, dtype_of(v))
        walls = state.get("walls", self.walls.constant)
        walls_after = self.walls.velocities(params, dtype_of(v))
        a = self.acceleration(v, params, s, friction, walls, dt)
        density = None
        scalars: dict[str, Any] = {}
        mean_scalars = s
        if s and (self._density is not None or self._extrapolates):  # both need the scalars at half the step
            scalars = self._advance_scalars(state, params, dt)
            mean_scalars = {name: 0.5 * (u + scalars["s"][name]) for name, u in s.items()}
        slope_of_p = self.pressure_gradient(p)
        if self._density is not None:
            density = self._face_density(mean_scalars, params, v)
            slope_of_p = slope_of_p / density
        predicted = v + dt * (self._half_step_ahead(a, state["a"], state, dt) - slope_of_p)
        if friction is not None:
            predicted = (predicted - dt * friction * v) / (1.0 + dt * friction)
        predicted = self._set_inflow(predicted, params)
        if self.viscous.varies:
            if self.viscous.implicit:
                middle = None
                if self._extrapolates:
                    middle = self._half_step_ahead(v, state["before"], state, dt)
                predicted = self._step_viscosity(
                    predicted, v, middle, mean_scalars, params, walls, walls_after, density, dt
                )
        elif self.viscous.solve is not None:
            wall_part = self.walls.laplacian_part_sum(walls, walls_after)
            predicted = self.viscous.step_implicit(predicted, v, wall_part)
        if density is None:
            q = self.pressure(predicted)
            next_v = self._open_faces(predicted) + self.pressure_gradient(q)
        else:
            next_v, q = self._weighted_projection.split(predicted, density)
        new = {"v": next_v, "p": p - q / dt, "a": a}
        if self.walls.changes:
            new["walls"] = walls_after
        if callable(self.dt):
            new["dt"] = dt
        if self._extrapolates:
            new["before"] = v
        if self._extrapolates_scalars:
            new["s_before"] = s
        if s:
            new.update(scalars or self._advance_scalars(state, params, dt))
        return new

    def _step_length(self, params: Any, dtype: np.dtype) -> Any:
        """Return the length of the step; the result of a function is converted to the precision of the flow."""
        if not callable(self.dt):
            return self.dt
        dt = self.dt(params)
        check_values(_check_step_length, dt)
        return cast(dt, real_dtype(dtype))

    def _half_step_ahead(self, now: Any, before: Any, state: dict[str, Any], dt: Any) -> Any:
        """Return a value half a step ahead, extrapolated from those at the beginning of this and the previous step."""
        if not callable(self.dt):
            return 1.5 * now - 0.5 * before
        half_ratio = 0.5 * dt / state["dt"]
        return (1.0 + half_ratio) * now - half_ratio * before

    def _step_viscosity(
        self,
        predicted: Any,
        v: Any,
        middle: Any,
        s: dict[str, Any],
        params: Any,
        walls: Any,
        walls_after: Any,
        density: Any,
        dt: Any,
    ) -> Any:
        """Return the velocity after an implicit viscosity that varies.

        `middle`, `s` and `density` are the velocity, the scalars and the density on faces at half the step; `middle` is
        None if the viscosity does not depend on the velocity.
        """
        sum_of_walls = None
        mean_of_walls = None
        if self.walls.changes:
            sum_of_walls = walls + walls_after
            mean_of_walls = 0.5 * sum_of_walls
        viscosity = self._viscosity(middle, s, params, mean_of_walls)
        wall_part = partial(self.walls.laplacian_part_sum, walls, walls_after)
        for_stress = partial(self.walls.for_stress, sum_of_walls, 2.0)
        return self.viscous.step_implicit(predicted, v, viscosity, wall_part, for_stress, density, dt, middle)

    def _viscosity(self, v: Any, s: dict[str, Any], params: Any, walls: Any) -> Any:
        """Return a viscosity that varies, a number or one value for each cell."""

        def fields():
            shear_rate = self.viscous.form.shear_rate(v, walls)
            if self.scalars:
                return shear_rate, s
            return (shear_rate,)

        return self.viscous.coefficient(fields, params, dtype_of(v), np.shape(v)[:-1])

    def _face_density(self, s: dict[str, Any], params: Any, v: Any) -> Any:
        """Return the density on faces, or a number."""
        density = self._density(lambda: (s,), params, dtype_of(v), np.shape(v)[:-1])
        if np.shape(sample(density)) == ():
            return density
        return self._to_faces(density)

    def _advance_scalars(self, state: dict[str, Any], params: Any, dt: Any) -> dict[str, Any]:
        """Return the entries of the next state that belong to scalars."""
        s = state["s"]
        before = state.get("values", {})
        after = self._wall_values(s, params)
        rates = self._rates(state["v"], s, params, before, dt)
        new: dict[str, Any] = {"r": rates, "s": {}}
        middle = None
        if self._extrapolates_scalars:
            middle = {name: self._half_step_ahead(u, state["s_before"][name], state, dt) for name, u in s.items()}
        for name, scalar in self.scalars.items():
            change = dt * self._half_step_ahead(rates[name], state["r"][name], state, dt)
            diffusivity = None
            if self.settings.implicit:
                diffusivity = scalar.diffusivity(middle or s, params)
            u = None if middle is None else middle[name]
            new["s"][name] = scalar.step(s[name], change, before.get(name), after.get(name), diffusivity, dt, u)
        if after:
            new["values"] = after
        return new

    def _check_state(self, state: Any) -> None:
        names = ["v", "p", "a"]
        if self.scalars:
            names += ["s", "r"]
        if self.walls.changes:
            names += ["walls"]
        if callable(self.dt):
            names += ["dt"]
        if self._extrapolates:
            names += ["before"]
        if self._extrapolates_scalars:
            names += ["s_before"]
        if any(scalar.changes for scalar in self.scalars.values()):
            names += ["values"]
        if not isinstance(state, dict) or state.keys() != set(names):
            raise ShapeError(
                f"flow_step takes a dict of {', '.join(names[:-1])} and {names[-1]} as its state; "
                "write state = step.start(v, params)"
            )

    def acceleration(
        self,
        v: Any,
        params: Any,
        s: dict[str, Any] | None = None,
        friction: Any = None,
        walls: Any = None,
        dt: Any = None,
    ) -> Any:
        """Return a(v), the sum of the explicit terms, plus friction * v; see the module docstring."""
        if self.convect is None:
            a = 0.0 * v
        else:
            a = -self.convect(v, v, walls)
        if self.settings.force is not None:
            a = a + self._free_faces(self._force(v, params, s))
        if friction is not None:
            a = a + friction * v
        wall_part = partial(self.walls.laplacian_part, walls)
        if not self.viscous.varies:
            return self.viscous.add_explicit(a, v, wall_part)
        if self.viscous.implicit:
            return a
        viscosity = self._viscosity(v, s or {}, params, walls)
        density = None
        if self._density is not None:
            density = self._face_density(s or {}, params, v)
        for_stress = partial(self.walls.for_stress, walls, 1.0)
        return self.viscous.add_explicit(a, v, viscosity, wall_part, for_stress, density, dt)

    def _force(self, v: Any, params: Any, s: dict[str, Any] | None) -> Any:
        """Return the force as an array on faces; a force that is one number applies to all faces."""
        fields = [v, s] if self.scalars else [v]
        force = self.settings.force(*mapped(frozen, fields), params)
        if np.shape(sample(force)) == ():
            return force * np.ones(v.shape, dtype_of(v))
        check_on("flow_step, as force,", force, self.grid.faces, "; join its components with grid.join")
        return in_precision_of(force, dtype_of(v))

    def _friction(self, params: Any, dtype: np.dtype) -> Any:
        """Return the friction, set to 0 on faces that are not free; None if there is no friction."""
        friction = self.settings.friction
        if friction is None:
            return None
        if callable(friction):
            friction = friction(params)
        check_on("flow_step, as friction,", friction, self.grid.faces, "; write one number for each face")
        check_values(_check_friction, friction)
        return self._free_faces(in_precision_of(friction, dtype))

    def _set_inflow(self, v: Any, params: Any) -> Any:
        """Return the velocity with the values of `inflow` on the faces of inflow boundaries."""
        inflow = self.settings.inflow
        if inflow is None:
            return v
        if callable(inflow):
            inflow = inflow(params)
        check_on("flow_step, as inflow,", inflow, self.grid.faces, "; join its components with grid.join")
        return v + self._inflow_faces(cast(inflow, dtype_of(v)) - v)

    def _wall_values(self, s: dict[str, Any], params: Any) -> dict[str, Any]:
        """Return the wall values of the scalars for which they are functions of params."""
        scalars = self.scalars.items()
        return {name: scalar.wall_values(params, dtype_of(s[name])) for name, scalar in scalars if scalar.changes}

    def _rates(self, v: Any, s: dict[str, Any], params: Any, values: dict[str, Any], dt: Any) -> dict[str, Any]:
        return {name: scalar.rate(v, s, params, values.get(name), dt) for name, scalar in self.scalars.items()}

    def _check_convection(self, v: Any, dt: Any) -> None:
        """Raise UnstableStepError if convection would amplify a wave by more than MAX_GROWTH."""
        total_flow = self._total_flow.apply(np.abs(v).astype(float))  # in each cell, 2 * sum of |v| / h
        fastest = 0.5 * float(np.max(total_flow, initial=0.0))
        courant = dt * fastest
        if not SAFE_COURANT < courant < np.inf:
            return
        terms = [self.viscous, *(scalar.diffusion for scalar in self.scalars.values())]
        growth = max(wave_growth(courant, term.damping, self.settings.implicit) for term in terms)
        if growth > MAX_GROWTH:
            safe = rounded_down(SAFE_COURANT / fastest)
            raise UnstableStepError(
                f"flow_step is unstable for this velocity with dt = {number_beside(dt, float(safe), digits=12)}: "
                f"waves grow by {growth - 1:.0%} a step, at a Courant number of {courant:.3g}; dt = {safe} is safe, "
                "or write unstable='allow'"
            )

    def __repr__(self) -> str:
        terms = {
            "convection": self.convect,
            "viscosity": self.viscous if self.viscous.varies else self.viscous.op,
            "force": self.settings.force,
            "friction": self.settings.friction,
            "density": self.settings.density,
            "scalars": self.scalars or None,
        }
        names = ["pressure", *(name for name, term in terms.items() if term is not None)]
        return f"<flow step on {self.grid}: {', '.join(names)}>"


def _check_step_length(dt):
    check_number("dt of flow_step", dt, "> 0")


def _check_friction(friction):
    """Raise an error for a friction that is not finite, negative or complex."""
    check_finite("flow_step", friction, "takes a finite friction")
    if np.any(friction != np.abs(friction)):  # also raises for complex values
        raise ValueError(f"flow_step takes a friction >= 0, got {np.min(friction)}; write abs(friction)")
