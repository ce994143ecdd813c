"""shallow_water: depth and discharge of water over any ground, with dry cells, by hydrostatic reconstruction.

With depth h, velocity v, discharge q = h v, bathymetry z and surface w = h + z, along an axis with cells of width d,

    h' = -(q)_x,   q' = -(q v + g h^2 / 2)_x - g h z_x.

In a cell the limited slopes s_h, s_w and s_v of depth, surface and velocity (differences between an end and the cell)
give the values at its ends: h + s_h, w + s_w and z = w - h at the upper end, h - s_h, w - s_w at the lower end. The
velocity there is v + s_v (h - s_h) / h and v - s_v (h + s_h) / h, so that the mean of the discharges is q. Limited
depths lie between neighbouring cells; thus they are not negative.

At a face the water above the higher of both grounds flows. With z_lower and z_upper from the cells below and above, the
depths are

    h_lower* = max(0, h_lower - max(0, z_upper - z_lower)),   h_upper* = max(0, h_upper - max(0, z_lower - z_upper)),

and F is the flux of Harten, Lax and van Leer for the states (h*, h* v). The rate of the cell below contains F, and the
pressure g (h_lower^2 - h_lower*^2) / 2 of the step of the ground. Inside the cell the weight of the water on the slope
is g h (z_upper_end - z_lower_end). Since the sum of the depths at both ends is 2 h, all terms that do not vanish at
rest add up to

    q' = (F_lower - P_lower) / d - (F_upper - P_upper) / d - g h (w_upper_end - w_lower_end) / d,

where P = g h*^2 / 2 belongs to the side of the face in this cell. At rest w is constant, h* is the same on both sides,
F = P, and nothing moves, beside dry ground too.

The outflow through a face is at most s h_end with the largest wave speed s, and the depths at both ends add up to 2 h.
Therefore an Euler step with dt s / d <= 1/2, summed over the axes, leaves h >= 0.

Friction of Manning's law, with the coefficient n, slows the discharge at the rate k = g n^2 |v| / h^(4/3):

    q' = ... - k q.

k is without bound for thin layers. `ShallowWater.stepper` therefore takes -k q implicitly in each stage of "ssprk3",
with k from the beginning of the stage. With the other terms f this is u + dt f divided by 1 + dt k. A last correction,

    q <- (q + dt^2 k f) / (1 + (dt k)^2),

makes the step second-order. Where f = k q nothing changes: steady flows satisfy the law exactly, for every dt.

The velocity is q / h. Below the depth `dry` it is multiplied by a factor that decreases to 0 with the depth, since
q / h is the quotient of two rounding errors there.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.base_classes import Reconstructible
from sparsedp._utils.calls import public
from sparsedp._utils.validation import check_choice, check_finite, check_function, check_kind, check_number
from sparsedp.autodiff.derivative import entrywise
from sparsedp.autodiff.program_trace import check_values
from sparsedp.autodiff.tape import cast, dtype_of, plain, real_dtype, sample
from sparsedp.autodiff.tape_constants import constant
from sparsedp.flow.finite_volumes import FiniteVolumes, check_positive, checked_result, sides_of
from sparsedp.grid.boundary_conditions import outflow
from sparsedp.grid.grid import check_grid
from sparsedp.kernels.fluxes import SCHEMES

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from sparsedp.flow.finite_volumes import AxisFluxes
    from sparsedp.grid.grid import Grid

__all__ = ["FrictionStep", "ShallowWater", "shallow_water"]

TINY = 1e-30  # a rise of the depth, without influence on the values of a limiter
ROUNDING = 16  # a depth that is negative by this many roundings of the largest depth counts as 0


def shallow_water(
    grid: Grid,
    bathymetry: Any = 0.0,
    gravity: Any = 9.81,
    *,
    scheme: str = "van_leer",
    boundary: Any = outflow,
    inflow: Any = None,
    source: Callable | None = None,
    manning: Any = None,
    dry: float = 1e-6,
) -> ShallowWater:
    """Return the rate of change of shallow water over any ground, with wet and dry cells.

    Parameters
    ----------
    grid : Grid
        One or two axes are usual; the grid may have three.
    bathymetry : number, array, or callable, optional
        Height of the ground in the cells [length], an array of shape grid.shape; or ``bathymetry(params)`` that
        returns one, to differentiate with respect to it.
    gravity : number > 0, or callable, optional
        Gravity [length / time^2]; or ``gravity(params)`` that returns it.
    scheme : str
        "van_leer" (limited slopes, second order) or "upwind" (first order).
    boundary : condition, or dict of conditions
        outflow: waves leave the domain; it does not hold a depth. Where water flows out more slowly than its waves, as
        in most rivers, give the state at this end by inflow. free_slip: a wall. inflow: the state outside the boundary
        is given by `inflow`, above the ground of the last cell.
    inflow : number, array, or callable, optional
        The state outside inflow boundaries, as `conservation_law` takes it.
    source : callable, optional
        ``source(u, params)`` returns rates that are added in the cells [unit / time], for example rain.
    manning : number >= 0, array of shape grid.shape, or callable, optional
        Manning's coefficient n of the friction of the ground [time / length^(1/3)], about 0.03 s / m^(1/3) in a river;
        or ``manning(params)`` that returns it. Take steps of ``law.stepper(dt)``, in which friction is implicit.
    dry : float, optional
        Depth [length] below which the velocity is reduced, to 0 for no water: thin layers that a wave leaves behind
        would otherwise be fast and require small steps. Take about 1e-6 of the largest depth.

    Returns
    -------
    ShallowWater
        ``law(u, params=None)`` returns the rate, for `stepper`. u has the shape (1 + grid.dim, *grid.shape): depth, and
        discharge (depth times velocity) along each axis. Further fields are amounts of tracers: depth times
        concentration. Differentiable in u and params. ``law.time_step(u, params)`` returns a stable dt, and
        ``law.stepper(dt)`` a step with implicit friction.

    Raises
    ------
    ValueError
        If scheme or boundary is not one of the above, if `inflow` does not go together with an inflow boundary, or if
        gravity or dry is not > 0, or if manning is negative.
    ShapeError
        If the bathymetry, manning, the state or the result of a function has the wrong shape.
    NonFiniteError
        If the bathymetry, manning, the depth or the rate contains NaN or infinity.
    UnstableStepError
        On use, if a depth is negative: a previous step was too long, or the state is wrong.
    TypeError
        If source is not a function, or if the bathymetry, the state or the result of a function is not real.

    See Also
    --------
    conservation_law

    Notes
    -----
    Water at rest stays at rest to rounding, beside islands too, and the volume changes only by fluxes through the
    boundary.

    Depths stay >= 0 in an Euler step, and therefore in one of "ssprk3", if dt <= ``law.time_step(u, params, cfl=0.5)``
    in each stage. Water that runs onto dry ground becomes up to twice as fast as the waves of the first state: take a
    smaller cfl, or compute dt again after some steps. A source is not part of this bound.

    Order: 2 where the solution is smooth and has no extremum, about 1.5 with a moving shore line.

    Derivatives: limiters, shocks, shore lines, and steps of the ground that change their sign have kinks, where
    `check.gradient` returns "inconclusive". One is a flat ground with respect to the bathymetry. The derivative in the
    depth of a dry cell is one-sided, for a rising depth, unless this changes the sign of a step of the ground.

    References
    ----------
    Audusse, Bouchut, Bristeau, Klein, Perthame, SIAM J. Sci. Comput. 25 (2004) 2050-2065.
    Kurganov, Petrova, Commun. Math. Sci. 5 (2007) 133-160 (velocity of thin layers).
    Chertock, Cui, Kurganov, Tong, SIAM J. Numer. Anal. 53 (2015) 2008-2029 (steps with implicit friction).

    Examples
    --------
    A lake at rest with an island, and a dam that breaks onto dry ground:

    >>> import numpy as np
    >>> from sparsedp import Grid
    >>> ground = np.array([0.0, 0.5, 2.0, 0.5])
    >>> lake = np.stack([np.maximum(1.0 - ground, 0.0), np.zeros(4)])
    >>> bool(np.all(shallow_water(Grid(4), ground)(lake) == 0))
    True
    >>> dam = np.array([[1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    >>> shallow_water(Grid(4), gravity=16.0)(dam).round(12)
    array([[ 0., -2.,  2.,  0.],
           [ 0.,  4.,  4.,  0.]])
    """
    check_grid("shallow_water", grid)
    check_choice("scheme of shallow_water", scheme, SCHEMES)
    if source is not None:
        check_function("shallow_water, as source,", source, "lambda u, params: ...", 2)
    if not callable(gravity):
        check_number("gravity of shallow_water", gravity, "> 0", "; write gravity=9.81")
    check_number("dry of shallow_water", dry, "> 0", "; write dry=1e-6")
    sides = sides_of("shallow_water", grid, boundary, inflow)
    law = ShallowWater(grid, bathymetry, gravity, scheme, sides, inflow, source, dry, manning)
    if not callable(bathymetry):
        law.ground(None)  # raises an error for a wrong bathymetry
    if not callable(manning):
        law.roughness(None)
    return law


class Faces(NamedTuple):
    """The water beside the faces along an axis."""

    lower_depth: Any  # (1, *shape): above the higher ground, from the cell below the face
    lower_velocity: Any  # (fields - 1, *shape), with the concentrations of tracers
    upper_depth: Any
    upper_velocity: Any
    slowest: Any  # speeds of the slowest wave, <= 0, and of the fastest, >= 0
    fastest: Any


class ShallowWater(FiniteVolumes):
    """The rate of change of shallow water, ``law(u, params=None)``, as `shallow_water` returns it.

    Parameters
    ----------
    bathymetry, gravity, dry, manning
        As `shallow_water` takes them.
    grid, scheme, sides, inflow, source
        As `FiniteVolumes` takes them.
    """

    name = "shallow_water"

    def __init__(
        self,
        grid: Grid,
        bathymetry: Any,
        gravity: Any,
        scheme: str,
        sides: tuple,
        inflow: Any,
        source: Callable | None,
        dry: float,
        manning: Any = None,
    ) -> None:
        super().__init__(grid, scheme, sides, tuple(range(1, 1 + grid.dim)), inflow, source)
        limiter = SCHEMES[scheme].limiter
        self._limiters = [limiter and _limiter_with_shore(limiter, axis) for axis in self.axes]
        self.bathymetry = constant(bathymetry)
        self.gravity = constant(gravity)
        self.dry = dry
        self.manning = constant(manning)

    def recipe(self) -> tuple:
        """Return the call that builds an equal object, for pickling and copying."""
        return ShallowWater, (
            self.grid,
            self.bathymetry,
            self.gravity,
            self.scheme,
            self.sides,
            self.inflow,
            self.source,
            self.dry,
            self.manning,
        )

    @public("dp.shallow_water(grid)")
    def __call__(self, u: Any, params: Any = None) -> Any:
        """Return the rate of change of a state.

        Parameters
        ----------
        u : array, shape (1 + grid.dim, *grid.shape)
            Depth and discharges; further fields are amounts of tracers.
        params : tree, optional
            Passed to bathymetry, gravity, inflow and source.

        Returns
        -------
        array like u
        """
        return self._checked_rate(u, params)

    def ground(self, params: Any = None) -> Any:
        """Return the height of the ground in the cells.

        Parameters
        ----------
        params : tree, optional
            Passed to the bathymetry.

        Returns
        -------
        array, shape grid.shape
        """
        return self._in_cells("bathymetry", self.bathymetry, params)

    def roughness(self, params: Any = None) -> Any:
        """Return Manning's coefficient in the cells, or None without friction.

        Parameters
        ----------
        params : tree, optional
            Passed to manning.

        Returns
        -------
        array, shape grid.shape
        """
        if self.manning is None:
            return None
        roughness = self._in_cells("manning", self.manning, params)
        check_values(_check_roughness, roughness)
        return roughness

    def stepper(self, dt: Any) -> FrictionStep:
        """Return a step in which the friction is implicit: stable for every friction, also in thin layers.

        Parameters
        ----------
        dt : number > 0, or callable
            Length of the step [time]; or ``dt(params)`` that returns it. A dt from `time_step` is stable.

        Returns
        -------
        FrictionStep
            ``step(u, params=None)`` returns the state after dt, for `rollout`. It is second-order accurate, and keeps
            the steady flows of the law. Differentiable in u and params.

        Raises
        ------
        TypeError, ValueError
            If dt is not a number > 0. On use, if the result of a function dt is not.
        NonFiniteError
            If dt is NaN or infinite. On use, if the state is.

        See Also
        --------
        stepper : "ssprk3" takes the same step if there is no friction.
        """
        if not callable(dt):
            check_values(_check_length, dt)
        return FrictionStep(self, dt)

    def _in_cells(self, name: str, value: Any, params: Any) -> Any:
        """Return a number, an array or the result of a function as a field in the cells; raise if it is none."""
        if callable(value):
            value = value(params)
        flat = np.zeros(self.grid.shape)
        if isinstance(value, (list, tuple)):
            value = anp.array(value)
        dtype = np.asarray(sample(value)).dtype
        advice = "; write its .real" if dtype.kind == "c" else "; write a number or an array"
        check_kind(self._what(name), dtype, "real numbers", advice)
        if np.ndim(value) == 0:
            value = value + flat
        checked_result(self._what(name), value, flat)
        check_values(partial(check_finite, self._what(name)), value)
        return value

    def _gravity_at(self, params: Any) -> Any:
        """Return gravity."""
        if not callable(self.gravity):
            return self.gravity
        g = self.gravity(params)
        check_values(_check_gravity, g)
        return g

    def _check_physical(self, u: Any, params: Any, argument: str = "", at: str = "") -> None:
        advice = "" if self.manning is None else "; with friction, take those of law.stepper(dt)"
        check_values(partial(_check_depth, self._what("depth", argument) + at, argument, advice), u[0])

    def _required_fields(self) -> str:
        shape = ", ".join(map(str, (1 + self.grid.dim, *self.grid.shape)))
        return f"shallow_water needs u of shape ({shape}), the depth and a discharge for each axis"

    def _rate(self, u: Any, params: Any) -> Any:
        rate = self._rate_without_friction(u, params)
        if self.manning is None:
            return rate
        return rate - self.friction_rate(u, params) * u

    def _rate_without_friction(self, u: Any, params: Any) -> Any:
        g = self._gravity_at(params)
        ground = self.ground(params)
        total = self._source_term(u, params)
        for axis in self.axes:
            faces, rise = self._faces(axis, u, g, ground, params)
            total = total + self._rate_along(axis, u, g, faces, rise)
        return total

    def frictionless(self, u: Any, params: Any) -> Any:
        """Return the rate of change of a state without friction, after checks."""
        return self._checked_rate(u, params, self._rate_without_friction)

    def friction_rate(self, u: Any, params: Any = None) -> Any:
        """Return the rate at which friction slows each field of a state [1 / time]; 0 for depth and tracers.

        Parameters
        ----------
        u : array
            The state, as for the call.
        params : tree, optional

        Returns
        -------
        array like u
        """
        return cast(self._friction_rate(u, params), real_dtype(dtype_of(u)))

    def _friction_rate(self, u: Any, params: Any) -> Any:
        """Return the rate of friction in double precision."""
        is_discharge = np.arange(len(u)) - 1 < self.grid.dim
        is_discharge[0] = False
        is_discharge = is_discharge.reshape(-1, *[1] * self.grid.dim)
        roughness = self.roughness(params)
        if roughness is None:
            return is_discharge * np.zeros(u.shape)
        depth = anp.maximum(u[:1], self.dry)
        square = anp.sum(self._velocity(_not_negative(u[:1], u[:1]), u[1 : 1 + self.grid.dim]) ** 2, axis=0)
        moves = square > 0.0
        speed = anp.where(moves, anp.sqrt(anp.where(moves, square, 1.0)), 0.0)  # sqrt has no derivative at 0
        return is_discharge * (self._gravity_at(params) * roughness**2 * speed / depth ** (4 / 3))

    def _velocity(self, depth: Any, discharge: Any) -> Any:
        """Return discharge / depth, reduced for depths below `dry`, and without overflow."""
        wet_depth = anp.maximum(depth, self.dry)
        share = depth / wet_depth  # 1 in wet cells
        return 2.0 * share / (share * share + 1.0) * (discharge / wet_depth)

    def _faces(self, axis: AxisFluxes, u: Any, g: Any, ground: Any, params: Any) -> tuple[Faces, Any]:
        """Return the water beside the faces along an axis, and the rise of the surface along each cell."""
        padded = axis.padded(u, params)
        padded_depth = _not_negative(padded[:1], padded[:1])
        padded_surface = padded_depth + axis.extended(ground)[None]
        padded_velocity = self._velocity(padded_depth, padded[1:])
        fields = anp.concatenate([padded_depth, padded_surface, padded_velocity])
        cells = axis.part(fields, 1, -1)
        depth = cells[:1]
        ground_in_cells = cells[1:2] - depth
        limiter = self._limiters[axis.number]
        if limiter:
            stencil = (axis.part(fields[:2], first, last) for first, last in ((0, -2), (1, -1), (2, None)))
            slopes = anp.concatenate([limiter(*stencil), *axis.slopes(fields[2:])])
        else:
            slopes = np.zeros(cells.shape)
        depth_slope = slopes[:1]
        ground_slope = slopes[1:2] - depth_slope
        share = depth_slope / anp.where(depth > 0.0, depth, 1.0)  # the slope is 0 where the depth is 0

        # from the cell below: values at its upper end; from the cell above: values at its lower end
        lower_depth = axis.part(depth + depth_slope, 0, -1)
        lower_ground = axis.part(ground_in_cells + ground_slope, 0, -1)
        lower_velocity = axis.part(cells[2:] + slopes[2:] * (1.0 - share), 0, -1)
        upper_depth = axis.part(depth - depth_slope, 1)
        upper_ground = axis.part(ground_in_cells - ground_slope, 1)
        upper_velocity = axis.part(cells[2:] - slopes[2:] * (1.0 + share), 1)

        step = upper_ground - lower_ground
        lower_depth = _not_negative(lower_depth - anp.maximum(step, 0.0), lower_depth)
        upper_depth = _not_negative(upper_depth - anp.maximum(-step, 0.0), upper_depth)
        # Of dry states too, waves have a positive speed here: sqrt has no derivative at 0.
        lower_wave = anp.sqrt(g * anp.maximum(lower_depth, self.dry))
        upper_wave = anp.sqrt(g * anp.maximum(upper_depth, self.dry))
        lower_normal = self._along(axis, lower_velocity)
        upper_normal = self._along(axis, upper_velocity)
        slowest = anp.minimum(anp.minimum(lower_normal - lower_wave, upper_normal - upper_wave), 0.0)
        fastest = anp.maximum(anp.maximum(lower_normal + lower_wave, upper_normal + upper_wave), 0.0)
        faces = Faces(lower_depth, lower_velocity, upper_depth, upper_velocity, slowest, fastest)
        return faces, 2.0 * axis.part(slopes[1:2], 1, -1)

    def _along(self, axis: AxisFluxes, velocity: Any) -> Any:
        """Return the component of the velocity along an axis."""
        return velocity[axis.number : axis.number + 1]

    def _rate_along(self, axis: AxisFluxes, u: Any, g: Any, faces: Faces, rise: Any) -> Any:
        """Return the part of the rate that is due to the fluxes along an axis."""
        lower_depth, lower_velocity, upper_depth, upper_velocity, slowest, fastest = faces
        width = fastest - slowest  # positive, because waves of dry states have a speed too
        lower_share = fastest / width
        upper_share = -slowest / width
        diffusion = slowest * fastest / width

        lower_mass = lower_depth * self._along(axis, lower_velocity)
        upper_mass = upper_depth * self._along(axis, upper_velocity)
        mass = lower_share * lower_mass + upper_share * upper_mass + diffusion * (upper_depth - lower_depth)
        carried = lower_share * lower_mass * lower_velocity + upper_share * upper_mass * upper_velocity
        carried = carried + diffusion * (upper_depth * upper_velocity - lower_depth * lower_velocity)

        # The difference of the pressures at both sides of the face: exactly 0 if the depths are equal.
        pressure_jump = 0.5 * g * (upper_depth - lower_depth) * (upper_depth + lower_depth)
        normal = (np.arange(len(u) - 1) == axis.number).reshape(-1, *[1] * self.grid.dim)
        for_cell_below = carried + normal * (upper_share * pressure_jump)
        for_cell_above = carried - normal * (lower_share * pressure_jump)
        weight = normal * (g * _not_negative(u[:1], u[:1]) * rise)

        depth_change = axis.part(mass, 0, -1) - axis.part(mass, 1)
        change = axis.part(for_cell_above, 0, -1) - axis.part(for_cell_below, 1) - weight
        return anp.concatenate([depth_change, change]) / axis.widths

    def _fastest_waves(self, axis: AxisFluxes, u: NDArray, params: Any) -> NDArray:
        faces, _ = self._faces(axis, u, self._gravity_at(params), self.ground(params), params)
        at_faces = np.maximum(-plain(faces.slowest), plain(faces.fastest))[0]
        return np.maximum(axis.part(at_faces, 0, -1), axis.part(at_faces, 1))


def _not_negative(x, depth):
    """Return max(x, 0); where x and the depth are 0, with the derivative for a rising depth, 1."""
    return anp.where((x == 0.0) & (depth == 0.0), x, anp.maximum(x, 0.0))


def _limiter_with_shore(limiter, axis):
    """Return the rule of the limited slopes of depth and surface along an axis.

    Its arguments are both fields in the cell below, in the cell, and in the cell above. A depth of 0 can only rise.
    Where a difference to a neighbour is 0, the derivative in a depth of 0 is therefore the limit for a rising depth,
    instead of the mean of both one-sided derivatives. Differences between copies of one cell remain 0.
    """
    changes = axis.along_fields(axis.differs)
    a_changes = axis.part(changes, 0, -1)
    b_changes = axis.part(changes, 1)

    def partials(a, b, rise_of_a, rise_of_b):
        a = anp.where(a == 0.0, a_changes * rise_of_a, a)
        b = anp.where(b == 0.0, b_changes * rise_of_b, b)
        in_a, in_b = limiter(a, b, *axis.distances)[2:4]
        return a_changes * in_a, b_changes * in_b

    def slope(below, cell, above):
        return limiter(cell - below, above - cell, *axis.distances)[0]

    def derivatives(below, cell, above):
        a = cell - below
        b = above - cell
        rise_below, rise, rise_above = (TINY * (x[:1] <= 0.0) for x in (below, cell, above))
        in_below, _ = partials(a, b, -rise_below, 0.0)
        in_a, in_b = partials(a, b, rise, -rise)
        _, in_above = partials(a, b, 0.0, rise_above)
        return -in_below, in_a - in_b, in_above

    return entrywise("limiter", slope, derivatives)


def _check_depth(what, argument, advice, depth):
    """Raise an error for a depth that is negative, and not only by rounding."""
    rounding = ROUNDING * np.finfo(depth.dtype).eps * np.max(np.abs(depth), initial=0.0)
    check_positive(what, depth, rounding, argument, advice)


class FrictionStep(Reconstructible):
    """A step of shallow water with implicit friction, as `ShallowWater.stepper` returns it.

    Parameters
    ----------
    law : ShallowWater
    dt : number or callable
    """

    name = "a step of shallow_water"

    def __init__(self, law: ShallowWater, dt: Any) -> None:
        self.law = law
        self.dt = dt

    def recipe(self) -> tuple:
        """Return the call that builds an equal object, for pickling and copying."""
        return FrictionStep, (self.law, self.dt)

    @public("dp.shallow_water(grid).stepper(dt)")
    def __call__(self, u: Any, params: Any = None) -> Any:
        """Return the state after a step.

        Parameters
        ----------
        u : array, shape (1 + grid.dim, *grid.shape)
        params : tree, optional
            Passed to the law.

        Returns
        -------
        array like u
        """
        u = self.law._checked_state(u)  # whole numbers become floating-point numbers
        dt = self.dt
        if callable(dt):
            dt = dt(params)
            check_values(_check_length, dt)
        first = self._stage(u, params, dt)
        second = 0.75 * u + 0.25 * self._stage(first, params, dt)
        third = u / 3 + (2 / 3) * self._stage(second, params, dt)
        if self.law.manning is None:
            return cast(third, dtype_of(u))
        slowing = dt * self.law._friction_rate(third, params)
        end = (third + dt * slowing * self.law.frictionless(third, params)) / (1.0 + slowing * slowing)
        return cast(end, dtype_of(u))

    def _stage(self, u: Any, params: Any, dt: Any) -> Any:
        """Return the state after an Euler step with implicit friction."""
        rate = self.law.frictionless(u, params)
        return (u + dt * rate) / (1.0 + dt * self.law._friction_rate(u, params))

    def __repr__(self) -> str:
        return f"<step of {self.law}>"


def _check_roughness(roughness):
    if np.min(roughness, initial=0.0) < 0:
        raise ValueError(f"manning of shallow_water must be >= 0, got {np.min(roughness):g}; write manning=0.03")


def _check_length(dt):
    check_number("dt of a step of shallow_water", dt, "> 0", "; take law.time_step(u, params)")


def _check_gravity(g):
    check_number("gravity of shallow_water", g, "> 0", "; write gravity=9.81")
