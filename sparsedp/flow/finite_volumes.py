"""conservation_law: du/dt = -div F(u) + S(u) for any number of fields, by finite volumes with limited slopes.

Along an axis with the widths h of its cells, and for each of the fields,

    du_i/dt = (F_i - F_(i+1)) / h_i + S_i.

At face i the two cells around it offer two values: u_lower = u_(i-1) + ahead and u_upper = u_i - behind, with the
limited slopes of a scheme of `dp.transport`. The flux between them is that of Harten, Lax and van Leer: with the
slowest and the fastest wave, a = min(0, slow), b = max(0, fast) over both values,

    F = (b F(u_lower) - a F(u_upper) + a b (u_upper - u_lower)) / (b - a).

With one speed s for both directions, a = -s and b = s, this is Rusanov's flux.

Two ghost cells stand beyond each end of an axis: they go round where it is periodic, repeat the last cell (outflow),
mirror the cells with the momentum across the wall turned round (free_slip), or hold what is given (inflow).

Steady states: with an equilibrium e the slopes are those of u - e, and the rate that the same formulas give for e is
subtracted. So e stays as it is, to the last bit: a lake at rest over any ground, a gas at rest in its weight. Beyond a
side of inflow e goes on with its last cell. An inflow that differs from that acts on the field; one that equals it, as
that of a moving steady state, keeps e.

Everything but the limiter is arithmetic on the tape: its derivatives of every order are those of autograd, and those of
the user's flux, speed and source. The limiter is one rule, with the derivatives that stand beside its formula.
"""

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.calls import public
from sparsedp._utils.pytree import mapped
from sparsedp._utils.reconstruction import Remade
from sparsedp._utils.validation import (
    check_choice,
    check_finite,
    check_function,
    check_kind,
    check_number,
    check_shape,
    field_array,
    is_whole,
)
from sparsedp.autodiff.derivative import entrywise
from sparsedp.autodiff.tape import cast, dtype_of, isbox, plain
from sparsedp.autodiff.tape_constants import constant, frozen
from sparsedp.errors import ShapeError
from sparsedp.grid.boundary_conditions import free_slip, outflow, resolve
from sparsedp.grid.boundary_conditions import inflow as inflow_side
from sparsedp.grid.grid import AXES, check_grid
from sparsedp.kernels.fluxes import SCHEMES

__all__ = ["ConservationLaw", "conservation_law"]

NO_WAVES = "; has the state left where it has waves (a density or a depth below 0)? Take a smaller dt"
GHOSTS = 2  # cells beyond each end: the slope in the first of them needs the second
# What a side is -> how np.pad repeats cells there; None: the axis is periodic.
REPEATED: dict = {None: "wrap", free_slip: "symmetric", outflow: "edge", inflow_side: "edge"}


def conservation_law(
    grid, flux, speed, *, scheme="van_leer", boundary=outflow, momentum=None, inflow=None, source=None, equilibrium=None
):
    """Grid, flux F(u), speed of its waves -> the rate of change, ``law(u, params)``: -div F(u) + S(u).

    Parameters
    ----------
    grid : Grid
    flux : callable
        ``flux(u, params, axis)``: the flux along an axis (0 is x) [unit length / time], of the shape of u. u holds
        values at faces, first those below all of them, then those above: longer along the axis than the state is.
        Coefficients that depend on the place are further fields of the state, with a flux of 0.
    speed : callable
        ``speed(u, params, axis)``: how fast the fastest wave travels along an axis [length / time], one number for each
        point, the field's axis left out (Rusanov's flux); or a pair, the slowest and the fastest with their signs
        (the flux of Harten, Lax and van Leer, which smears less).
    scheme : str
        How values at faces are made: "van_leer" (limited slopes, second order) or "upwind" (first order), the
        Eulerian schemes of `dp.transport`.
    boundary : condition, or dict of conditions
        outflow: waves leave. free_slip: a wall, needs `momentum`. inflow: what `inflow` says.
    momentum : int or tuple of int, optional
        Which field is the momentum along each axis: it changes its sign at walls. In 2-D (1, 2) says that u[1] and
        u[2] are the momenta along x and y.
    inflow : number, array, or callable, optional
        The state beyond sides of inflow, in a shape that fits the state's; or ``inflow(params, axis, side)``, side 0
        (lower) or 1 (upper).
    source : callable, optional
        ``source(u, params)``: S(u) in the cells [unit / time], of the shape of u.
    equilibrium : array or callable, optional
        A state, or ``equilibrium(params)``, that is to stay exactly as it is, at rest or moving. At a side of inflow it
        stays if its last cell there holds the state that flows in; another inflow disturbs it.

    Returns
    -------
    ConservationLaw
        ``law(u, params=None)``: the rate, a `rate` of `stepper`. u of shape (fields, *grid.shape), or grid.shape
        for one field; differentiable in u and params. ``law.time_step(u, params)``: a stable dt.

    Raises
    ------
    ValueError
        If scheme, boundary or momentum is none of the above, or something is missing; on use, if a speed is
        negative, or a function changes its argument in place.
    ShapeError
        If the state, or what a function returns, has the wrong shape, or the state has no field for a momentum.
    NonFiniteError
        If a speed is NaN or infinite, often because a density or a depth has become negative, or the rate is.
    TypeError
        If a function is none, or it or the state holds no real numbers.

    Notes
    -----
    Order: 2 where the solution is smooth and has no extremum (van_leer), 1 at shocks.
    Steps: "ssprk3" of `stepper` with a dt of `law.time_step` keeps what one step of Euler keeps; there is no check
    of dt beyond that of a finite state.
    Derivatives: limiters, shocks and the largest of two speeds have kinks; `check.gradient` says "inconclusive" there.

    Source
    ------
    A. Harten, P. D. Lax, B. van Leer, SIAM Review 25 (1983) 35-61.
    B. van Leer, J. Comput. Phys. 32 (1979) 101-136.
    J. P. Berberich, P. Chandrashekar, C. Klingenberg, Computers & Fluids 219 (2021) 104858 (equilibrium).

    Examples
    --------
    >>> from sparsedp import Grid
    >>> grid = Grid(4, periodic=True)
    >>> law = conservation_law(grid, lambda u, p, axis: u**2 / 2, lambda u, p, axis: (u, u), scheme="upwind")
    >>> law(np.array([1.0, 1.0, 2.0, 1.0]))
    array([ 0. ,  0. , -1.5,  1.5])

    Shallow water between walls, with depth u[0], discharge u[1] and gravity 10: a dam starts to break in the middle.

    >>> import autograd.numpy as anp
    >>> flux = lambda u, g, axis: anp.stack([u[1], u[1] ** 2 / u[0] + 0.5 * g * u[0] ** 2])
    >>> speed = lambda u, g, axis: anp.abs(u[1] / u[0]) + anp.sqrt(g * u[0])
    >>> water = conservation_law(Grid(4), flux, speed, boundary=free_slip, momentum=1)
    >>> water(np.array([[2.0, 2.0, 1.0, 1.0], [0.0, 0.0, 0.0, 0.0]]), 10.0).round(2)
    array([[ 0.  , -2.24,  2.24,  0.  ],
           [ 0.  ,  7.5 ,  7.5 ,  0.  ]])
    """
    check_grid("conservation_law", grid)
    check_choice("scheme of conservation_law", scheme, SCHEMES)
    for name, function, count in (("flux", flux, 3), ("speed", speed, 3), ("source", source, 2)):
        if function is not None or name != "source":
            check_function(f"conservation_law, as {name},", function, _example(name, count), count)
    sides = resolve(grid, boundary, outflow)
    conditions = [side for pair in sides for side in pair or ()]
    for side in conditions:
        if side not in REPEATED:
            raise ValueError(f"conservation_law takes outflow, free_slip or inflow, got {side}; write one of them")
    if (inflow_side in conditions) != (inflow is not None):
        raise ValueError(
            "conservation_law got a side of dp.inflow without inflow=, or inflow= without such a side; "
            "give both or none"
        )
    momentum = _momentum(grid, momentum) if free_slip in conditions else None
    return ConservationLaw(grid, flux, speed, scheme, sides, momentum, inflow, source, equilibrium)


def _example(name, count):
    return f"lambda {', '.join(('u', 'params', 'axis')[:count])}: ..."


def _momentum(grid, momentum):
    """Numbers of the fields that are the momentum along each axis."""
    fields = momentum if isinstance(momentum, (tuple, list)) else (momentum,)
    numbers = {field for field in fields if field is not None and is_whole(field, 0)}
    if not len(fields) == len(numbers) == grid.dim:
        raise ValueError(
            f"conservation_law at a free_slip wall needs momentum, the number of a field for each axis, "
            f"got {momentum!r}; write for example momentum={tuple(range(1, grid.dim + 1))}"
        )
    return tuple(map(int, fields))


class ConservationLaw(Remade):
    """The rate of change of a conservation law, made by `conservation_law`. Call it: ``law(u, params=None)``."""

    name = "conservation_law"

    def __init__(self, grid, flux, speed, scheme, sides, momentum, inflow, source, equilibrium):
        inflow, equilibrium = constant(inflow), constant(equilibrium)
        given = grid, flux, speed, scheme, sides, momentum, inflow, source, equilibrium
        self.made, self.scheme, self.momentum = (ConservationLaw, given), scheme, momentum
        self.grid, self.domain, self.flux, self.speed = grid, grid.cells, flux, speed
        self.source, self.equilibrium = source, equilibrium
        self.axes = [
            Axis(grid, axis, sides[axis] or (None, None), momentum and momentum[axis], inflow, SCHEMES[scheme])
            for axis in range(grid.dim if grid.cells.size else 0)
        ]

    @public("dp.conservation_law(grid, flux, speed)")
    def __call__(self, u, params=None):
        """State -> its rate of change.

        Parameters
        ----------
        u : array, shape (fields, *grid.shape) or grid.shape
        params : tree, optional
            What flux, speed and source get.

        Returns
        -------
        array like u
        """
        u = self._state(u)
        e = self.equilibrium
        if e is None:
            rate = self._rate(u, None, params)
        else:
            e = _shaped("equilibrium", e(params) if callable(e) else e, u)
            rate = self._rate(u, e, params) - self._rate(e, e, params, flows=False)
        check_finite("the rate of a conservation_law", plain(rate))
        return cast(rate, dtype_of(u))

    def _state(self, u):
        """The state, of floating numbers."""
        values, momentum, shape = field_array(self, plain(u), batch=True), self.momentum, self.grid.shape
        fields = values.shape[: values.ndim - len(shape)]
        if len(fields) > 1:
            wanted = ", ".join(map(str, ("fields", *shape)))
            raise ShapeError(f"conservation_law takes u of shape ({wanted}), got {values.shape}")
        count = fields[0] if fields else 1
        if momentum and max(momentum) >= count:
            raise ShapeError(
                f"conservation_law needs a field for each number in momentum={momentum}, got u of shape "
                f"{values.shape}; give a state that holds them all"
            )
        check_kind("u of conservation_law", values.dtype, "real numbers", "; write u.real")
        return frozen(u if isbox(u) else values)

    def _rate(self, u, e, params, flows=True):
        """The rate; of an equilibrium e only the slopes take notice. `flows`: see `Axis.padded`."""
        total = np.zeros(u.shape) if self.source is None else _shaped("source", self.source(u, params), u)
        for axis in self.axes:
            padded = axis.padded(u, params, flows)
            if e is None:
                lower, upper = axis.beside_faces(padded)
            else:
                rest = axis.padded(e, params, False)
                lower, upper = (values + axis.between(rest) for values in axis.beside_faces(padded - rest))
            f = self._flux(axis, lower, upper, params)
            total = total + (axis.part(f, 0, -1) - axis.part(f, 1)) / axis.widths
        return total

    def _flux(self, axis, lower, upper, params):
        """The values below and above each face -> the flux of Harten, Lax and van Leer."""
        both = frozen(anp.concatenate([lower, upper], axis.place))
        f_lower, f_upper = axis.halves(_shaped("flux", self.flux(both, params, axis.number), both))
        slow, fast = map(axis.halves, self._speeds(axis.number, both, params))
        a, b = anp.minimum(anp.minimum(*slow), 0.0), anp.maximum(anp.maximum(*fast), 0.0)
        rest = plain(a) == plain(b)  # nothing moves: the mean
        width = b - a + rest
        share = (b + 0.5 * rest) / width
        return share * f_lower + (1.0 - share) * f_upper + a * b / width * (upper - lower)

    def _speeds(self, axis, u, params):
        """The slowest and the fastest wave along an axis."""
        given = self.speed(u, params, axis)
        given = given if isinstance(given, tuple) else (-given, given)
        for speed in map(plain, given):
            _shaped("speed", speed, u[(0,) * (u.ndim - self.grid.dim)])
            check_finite(f"the speed of a conservation_law along {AXES[axis]}", speed, advice=NO_WAVES)
        if np.any(plain(given[0]) > plain(given[1])):  # no flux would lean against the wind
            raise ValueError(
                "the speed of a conservation_law must be >= 0, or a pair, the slowest before the fastest; write abs(u) "
                "for u, or (u - c, u + c)"
            )
        return given

    def time_step(self, u, params=None, cfl=0.4):
        """Return a stable dt: `cfl` over the largest sum over the axes of speed / width.

        Parameters
        ----------
        u : array
            As for the call. The values in the cells count, and at sides of inflow what flows in.
        params : tree, optional
        cfl : float
            Up to 0.5 for limited slopes, up to 1 for "upwind".

        Returns
        -------
        float [time]
            Infinite where nothing moves. Not differentiated.
        """
        check_number("cfl of time_step", cfl, "> 0", "; write cfl=0.4")
        u, params = mapped(plain, (self._state(u), params))
        most = np.max(sum(self._fastest(axis, u, params) / axis.widths for axis in self.axes), initial=0.0)
        return float(cfl / most) if most else np.inf

    def _fastest(self, axis, u, params):
        """Return the speed of the fastest wave along an axis in each cell, with those that enter it at a side."""
        speeds = np.max(np.abs(self._speeds(axis.number, u, params)), axis=0)
        for side, edge in ((0, slice(0, 1)), (1, slice(-1, None))):
            if axis.sides[side] == inflow_side:
                entering = plain(axis.ghosts_beyond(u, params, side))
                beyond = np.max(np.abs(self._speeds(axis.number, entering, params)), axis=0)
                cells = axis.at(edge)
                speeds[cells] = np.maximum(speeds[cells], axis.part(beyond, 0, 1))
        return speeds

    def __repr__(self):
        return f"<conservation_law {self.scheme}: {self.grid.cells}>"


def _shaped(name, value, u):
    """What a function of the user returned, of the shape of u."""
    check_shape(f"the {name} of a conservation_law", value, np.shape(u))
    check_kind(f"the {name} of a conservation_law", dtype_of(value), "real numbers", "; write its .real")
    return value


class Axis:
    """What a conservation law does along one axis of the grid.

    Parameters
    ----------
    grid : Grid
    number : int
        Of the axis.
    sides : pair of FlowCondition, or of None where the axis is periodic
    momentum : int or None
        The field that changes its sign at walls.
    inflow : as `conservation_law` takes it
    scheme : Scheme
    """

    def __init__(self, grid, number, sides, momentum, inflow, scheme):
        self.number, self.place, self.dim = number, number - grid.dim, grid.dim
        self.sides, self.momentum, self.inflow = sides, momentum, inflow
        line, n = grid.widths[number], grid.shape[number]
        lower, upper = (np.pad(np.arange(n), GHOSTS, REPEATED[side]) for side in sides)
        self.ghosts = lower[:GHOSTS], upper[-GHOSTS:]  # the cells that those beyond the ends repeat
        self.widths, padded = self._along(line), np.concatenate([line[lower[:-GHOSTS]], line[upper[-GHOSTS:]]])
        gaps = padded[1:] + padded[:-1]
        self.distances = [self._along(gap / padded[1:-1]) for gap in (gaps[:-1], gaps[1:])]
        ends = () if scheme.limiter is None else (0,) if scheme.symmetric else (0, 1)
        self.limiters = [self._limiter(scheme.limiter, end) for end in ends]

    def _along(self, line):
        """Numbers along this axis, shaped so that they fit fields; one number where all are the same."""
        return line[0] if np.all(line == line[0]) else line.reshape(-1, *[1] * (-1 - self.place))

    def part(self, x, start, stop=None):
        """The places from start to stop along this axis."""
        return x[self.at(slice(start, stop))]

    def at(self, places):
        """An index of places along this axis."""
        return (Ellipsis, places, *[slice(None)] * (-1 - self.place))

    def halves(self, x):
        """What `_flux` put one after the other."""
        n = x.shape[self.place] // 2
        return self.part(x, 0, n), self.part(x, n)

    def padded(self, u, params, flows=True):
        """The field with its ghost cells; `flows`: those beyond an inflow are what flows in, else the last cell."""
        lower, upper = (self.ghosts_beyond(u, params, upper, flows) for upper in (0, 1))
        return anp.concatenate([lower, u, upper], self.place)

    def ghosts_beyond(self, u, params, upper, flows=True):
        """What stands beyond an end."""
        ghosts, side = u[self.at(self.ghosts[upper])], self.sides[upper]
        if side == free_slip:  # the momentum changes its sign
            signs = 1.0 - 2.0 * (np.arange(len(u)) == self.momentum)
            return -ghosts if u.ndim == self.dim else ghosts * self._fields(signs)
        if side != inflow_side or not flows:
            return ghosts
        value = self.inflow(params, self.number, upper) if callable(self.inflow) else self.inflow
        if np.ndim(value) == 1 and u.ndim > self.dim:
            value = self._fields(value)
        return _shaped("inflow", value + 0.0 * plain(ghosts), ghosts)

    def _fields(self, numbers):
        """A number for each field, shaped so that they fit fields."""
        return anp.reshape(numbers, (-1,) + (1,) * self.dim)

    def between(self, padded):
        """Cells with ghost cells -> the means at the faces."""
        return 0.5 * (self.part(padded, 1, -2) + self.part(padded, 2, -1))

    def beside_faces(self, padded):
        """Cells with ghost cells -> the values below and above each face."""
        lower, upper = self.part(padded, 1, -2), self.part(padded, 2, -1)
        if not self.limiters:
            return lower, upper
        step = self.part(padded, 1) - self.part(padded, 0, -1)
        below, above = self.part(step, 0, -1), self.part(step, 1)
        ends = [limiter(below, above) for limiter in self.limiters]
        return lower + self.part(ends[0], 0, -1), upper - self.part(ends[-1], 1)

    def _limiter(self, limiter, end):
        """A rule: differences to the cells below and above -> what the upper (0) or lower (1) end differs by."""
        return entrywise(
            "limiter",
            lambda a, b: limiter(a, b, *self.distances)[end],
            lambda a, b: limiter(a, b, *self.distances)[2 + 2 * end :][:2],
        )
