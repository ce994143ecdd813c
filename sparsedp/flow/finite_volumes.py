"""conservation_law: du/dt = -div F(u) + S(u) for any number of fields, by finite volumes with limited slopes.

Along an axis with cells of widths h, for each field,

    du_i/dt = (F_i - F_(i+1)) / h_i + S_i.

At face i there are two reconstructed values: u_lower = u_(i-1) + ahead, from the cell below, and u_upper = u_i -
behind, from the cell above. `ahead` and `behind` are the slope-limited corrections of a scheme of `dp.transport`. The
numerical flux is that of Harten, Lax and van Leer. With a = min(0, slowest wave speed) and b = max(0, fastest wave
speed), taken over both values,

    F = (b F(u_lower) - a F(u_upper) + a b (u_upper - u_lower)) / (b - a).

With one speed s for both directions, a = -s and b = s, it is Rusanov's flux.

There are two ghost cells beyond each end of an axis. On a periodic axis they hold the cells of the other end; at an
outflow they repeat the last cell; at a wall (free_slip) they mirror the cells, with the sign of the normal momentum
reversed; at an inflow they hold the given state.

Steady states: if an equilibrium e is given, the limited slopes are taken of u - e instead of u, and the rate of e
(by the same formulas) is subtracted from the rate of u. For u = e both rates are equal bit for bit, so that e is
preserved exactly: for example a lake at rest over uneven ground, or a gas at rest under gravity. The ghost cells of e
at an inflow boundary repeat its last cell. Therefore e is preserved if the inflow equals this last cell, as for a
moving steady state; any other inflow changes the field.

Positivity: if quantities are given that must stay positive, such as density and pressure, the values at both ends of a
cell are moved towards the value u_i of the cell. With Q the quantity, and theta = 1 where no end is below the floor,

    u_end <- u_i + theta (u_end - u_i),   theta = (Q(u_i) - floor) / (Q(u_i) - least Q(u_end)),   floor = Q(u_i) / 100.

Q is concave, therefore Q(u_end) >= floor afterwards, and the mean of both ends remains u_i. A quantity is limited after
those before it: the pressure is concave only where the density is positive. An Euler step of the cell is then the mean
of two steps with the flux between its ends, each with cells of half the width, and each such step is a sum of
(s u - F(u)) and (F(u) + s u), with weights >= 0 if dt s / h <= 1/2 for the largest s of its faces. These states are
positive for waves not faster than s. In more dimensions dt s / h is summed over the axes.

All operations except the limiter are recorded by autograd, so that derivatives of every order exist where the user's
flux, speed and source have them. The limiter is one differentiation rule with first derivatives only.
"""

from __future__ import annotations

from abc import abstractmethod
from functools import partial
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.base_classes import Reconstructible
from sparsedp._utils.calls import public
from sparsedp._utils.pytree import mapped
from sparsedp._utils.validation import (
    check_choice,
    check_finite,
    check_function,
    check_kind,
    check_number,
    check_plain,
    check_shape,
    field_array,
    is_whole,
    place,
)
from sparsedp.autodiff.derivative import entrywise
from sparsedp.autodiff.program_trace import check_values
from sparsedp.autodiff.tape import cast, dtype_of, isbox, plain, sample
from sparsedp.autodiff.tape_constants import constant, frozen
from sparsedp.errors import ShapeError, UnstableStepError
from sparsedp.grid.boundary_conditions import free_slip, outflow, resolve
from sparsedp.grid.boundary_conditions import inflow as inflow_side
from sparsedp.grid.grid import AXES, check_grid
from sparsedp.kernels.fluxes import SCHEMES

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from sparsedp.grid.grid import Grid
    from sparsedp.kernels.fluxes import Scheme

__all__ = ["ConservationLaw", "FiniteVolumes", "check_positive", "checked_result", "conservation_law", "sides_of"]

IF_NOT_FINITE = "; a density or a depth may have become negative: take a smaller dt"
POSITIVE_FLOOR = (
    0.01  # least share of a positive quantity at the ends of a cell: no slope is limited where it is smooth
)
GHOSTS = 2  # ghost cells beyond each end: the slope in the nearer one needs the value of the farther one
# The mode of np.pad that fills the ghost cells, by boundary condition; None stands for a periodic axis.
PAD_MODES: dict[Any, Any] = {None: "wrap", free_slip: "symmetric", outflow: "edge", inflow_side: "edge"}


def conservation_law(
    grid: Grid,
    flux: Callable,
    speed: Callable,
    *,
    scheme: str = "van_leer",
    boundary: Any = outflow,
    momentum: int | tuple[int, ...] | None = None,
    inflow: Any = None,
    source: Callable | None = None,
    equilibrium: Any = None,
    positive: dict[str, Callable] | None = None,
) -> ConservationLaw:
    """Return the rate of change ``law(u, params)`` of a conservation law: -div F(u) + S(u).

    Parameters
    ----------
    grid : Grid
    flux : callable
        ``flux(u, params, axis)`` returns the flux along an axis (0 is x) [unit length / time], an array of the shape of
        u. Here u holds values at faces: along the axis, first the values on the lower sides of all faces, then the
        values on their upper sides. It is therefore longer along the axis than the state. Write coefficients that
        depend on the position as additional fields of the state with a flux of 0.
    speed : callable
        ``speed(u, params, axis)`` returns wave speeds along an axis [length / time], in the shape of u without the axis
        of the fields. Either one array, the speed >= 0 of the fastest wave (Rusanov's flux), or a tuple, the signed
        speeds of the slowest and of the fastest wave (flux of Harten, Lax and van Leer, which is less diffusive).
    scheme : str
        How the values at faces are reconstructed: "van_leer" (limited slopes, second order) or "upwind" (first order),
        the Eulerian schemes of `dp.transport`.
    boundary : condition, or dict of conditions
        outflow: waves leave the domain. free_slip: a wall, which requires `momentum`. inflow: the state outside the
        boundary is given by `inflow`.
    momentum : int or tuple of int, optional
        Index of the field that is the momentum along each axis; its sign is reversed at walls. In 2-D, (1, 2) means
        that u[1] and u[2] are the momenta along x and y.
    inflow : number, array, or callable, optional
        The state outside inflow boundaries: an array that broadcasts to the state, or one number for each field; or
        ``inflow(params, axis, side)`` that returns one, with side 0 (lower) or 1 (upper).
    source : callable, optional
        ``source(u, params)`` returns S(u) in the cells [unit / time], an array of the shape of u.
    equilibrium : array or callable, optional
        A steady state, at rest or moving, that is preserved exactly; or ``equilibrium(params)`` that returns one. At an
        inflow boundary it is preserved only if the inflow equals the equilibrium in the cell next to the boundary.
    positive : dict of callables, optional
        Quantities that must stay positive, by name: ``{"density": lambda u, params: u[0], "pressure": pressure}``. Each
        ``quantity(u, params)`` returns an array of the shape of u without the axis of the fields, a linear or concave
        function of u where the quantities before it are positive. Steep slopes at which one would be negative are
        reduced, and an error names the quantity and the cell if it is not positive in a state.

    Returns
    -------
    ConservationLaw
        ``law(u, params=None)`` returns the rate, for `stepper`. u has the shape (fields, *grid.shape), or grid.shape
        for one field; differentiable in u and params. ``law.time_step(u, params)`` returns a stable dt.

    Raises
    ------
    ValueError
        If scheme, boundary or momentum is not one of the above, or if `inflow` does not go together with an inflow
        boundary. On use, if a speed is negative, or a function changes its argument in place.
    ShapeError
        If the state, or the result of a function, has the wrong shape, or the state has no field for a momentum.
    NonFiniteError
        If a speed, the rate or a positive quantity is NaN or infinite, often because a density or a depth has become
        negative.
    UnstableStepError
        On use, if a positive quantity is not positive in a cell: a previous step was too long, or the state is wrong.
    TypeError
        If flux, speed, source or a quantity is not a function, if `positive` is not a dict, or if the state or the
        result of a function is not real.

    See Also
    --------
    shallow_water, transport, free_slip, inflow, outflow, stepper

    Notes
    -----
    Order: 2 where the solution is smooth and has no extremum (van_leer), 1 at shocks.
    Time steps: use "ssprk3" of `stepper` with a dt from `law.time_step`. This method is strong stability preserving:
    bounds that hold for an Euler step of size dt, such as the absence of new extrema, hold for its step too. The law
    itself does not check dt.
    Positivity: with `positive` an Euler step, and therefore one of "ssprk3", keeps the quantities positive if
    dt <= ``law.time_step(u, params, cfl=0.5)`` in each stage, for gas, shallow water and all laws whose exact solution
    stays positive, on cells of any width. Waves may become faster than those of the first state: take a smaller cfl or
    compute dt again after some steps. A source and an equilibrium are not part of this bound.
    Derivatives: limiters, shocks and the maximum of two speeds have kinks, where `check.gradient` returns
    "inconclusive".

    References
    ----------
    Harten, Lax, van Leer, SIAM Review 25 (1983) 35-61.
    van Leer, J. Comput. Phys. 32 (1979) 101-136.
    Berberich, Chandrashekar, Klingenberg, Computers & Fluids 219 (2021) 104858 (equilibrium).
    Zhang, Shu, J. Comput. Phys. 229 (2010) 8918-8934; Perthame, Shu, Numer. Math. 73 (1996) 119-130 (positive).

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

    Declare the depth as positive, so that an error names the cell in which it is not:

    >>> options = {"boundary": free_slip, "momentum": 1, "positive": {"depth": lambda u, g: u[0]}}
    >>> water = conservation_law(Grid(4), flux, speed, **options)
    >>> try:
    ...     water(np.array([[2.0, 2.0, -1.0, 1.0], [0.0, 0.0, 0.0, 0.0]]), 10.0)
    ... except ValueError as error:
    ...     print(str(error).split(";")[0])
    the depth of a conservation_law must be > 0, got -1 in cell 2
    """
    check_grid("conservation_law", grid)
    check_choice("scheme of conservation_law", scheme, SCHEMES)
    check_function("conservation_law, as flux,", flux, "lambda u, params, axis: ...", 3)
    check_function("conservation_law, as speed,", speed, "lambda u, params, axis: ...", 3)
    if source is not None:
        check_function("conservation_law, as source,", source, "lambda u, params: ...", 2)
    quantities = _checked_quantities(positive)
    sides = sides_of("conservation_law", grid, boundary, inflow)
    if momentum is not None or any(free_slip in (pair or ()) for pair in sides):
        fields = _momentum_fields(grid, momentum)
    else:
        fields = None
    return ConservationLaw(grid, flux, speed, scheme, sides, fields, inflow, source, equilibrium, quantities)


def sides_of(name: str, grid: Grid, boundary: Any, inflow: Any) -> tuple:
    """Return the conditions at both ends of each axis; raise if one of them, or `inflow`, does not fit."""
    sides = resolve(grid, boundary, outflow, name=name)
    conditions = [condition for pair in sides for condition in pair or ()]
    for condition in conditions:
        if condition not in PAD_MODES:
            raise ValueError(f"{name} takes outflow, free_slip or inflow, got {condition}; write one of them")
    if (inflow_side in conditions) != (inflow is not None):
        raise ValueError(
            f"{name} got a side of dp.inflow without inflow=, or inflow= without such a side; give both or none"
        )
    return sides


def _checked_quantities(positive: Any) -> dict[str, Callable]:
    """Return a copy of the positive quantities; raise unless it is a dict of functions."""
    if positive is None:
        return {}
    if not isinstance(positive, dict):
        raise TypeError(
            f"positive of conservation_law must be a dict of functions, got {type(positive).__name__}; "
            'write {"density": lambda u, params: u[0]}'
        )
    for name, quantity in positive.items():
        if not isinstance(name, str):
            raise TypeError(
                f"the names in positive of conservation_law must be str, got {type(name).__name__}; "
                'write {"density": lambda u, params: u[0]}'
            )
        check_function(f"conservation_law, as positive[{name!r}],", quantity, "lambda u, params: ...", 2)
    return dict(positive)


def _momentum_fields(grid: Grid, momentum: Any) -> tuple[int, ...]:
    """Return the numbers of the fields that are the momentum along each axis."""
    if isinstance(momentum, (tuple, list)):
        fields = momentum
    else:
        fields = (momentum,)
    numbers = {field for field in fields if field is not None and is_whole(field, 0)}
    if not len(fields) == len(numbers) == grid.dim:
        raise ValueError(
            f"momentum of conservation_law, needed at free_slip walls, must be the number of a field for each axis, "
            f"got {momentum!r}; write for example momentum={tuple(range(1, grid.dim + 1))}"
        )
    return tuple(map(int, fields))


class FiniteVolumes(Reconstructible):
    """The part that all laws on finite volumes share: the state, its ghost cells, and the time step.

    A law defines `_check_physical`, `_rate` and `_fastest_waves`.

    Parameters
    ----------
    grid : Grid
    scheme : str
        A key of `SCHEMES`.
    sides : tuple
        The conditions as `resolve` returns them.
    momentum : tuple of int or None
        For each axis, the index of the field that is the momentum along this axis.
    inflow, source
        As `conservation_law` takes them.

    Attributes
    ----------
    domain : Space
        The cells.
    """

    name = ""

    def __init__(
        self,
        grid: Grid,
        scheme: str,
        sides: tuple,
        momentum: tuple[int, ...] | None,
        inflow: Any,
        source: Callable | None,
    ) -> None:
        self.grid = grid
        self.domain = grid.cells
        self.scheme = scheme
        self.sides = sides
        self.momentum = momentum
        self.inflow = constant(inflow)
        self.source = source
        self.axes: list[AxisFluxes] = []
        if not grid.cells.size:
            return
        for axis in range(grid.dim):
            self.axes.append(
                AxisFluxes(
                    grid,
                    axis,
                    sides[axis] or (None, None),
                    None if momentum is None else momentum[axis],
                    self.inflow,
                    SCHEMES[scheme],
                    self.name,
                )
            )

    def _checked_rate(self, u: Any, params: Any, rate_of: Callable | None = None) -> Any:
        """Check the state, return its rate of change by `_rate` or `rate_of`, and check that the rate is finite."""
        u = self._checked_state(u)
        self._check_states(u, params)
        rate = (rate_of or self._rate)(u, params)
        check_values(partial(check_finite, self._what("rate")), rate)
        return cast(rate, dtype_of(u))

    def _check_states(self, u: Any, params: Any) -> None:
        """Raise if a quantity of the state, or of the inflow, is not positive."""
        self._check_physical(u, params)
        for axis in self.axes:
            for side, condition in enumerate(axis.sides):
                if condition == inflow_side:
                    at = f" at the {('lower', 'upper')[side]} end of {AXES[axis.number]}"
                    self._check_physical(axis.ghost_values(u, params, side), params, "inflow", at)

    @abstractmethod
    def _check_physical(self, u: Any, params: Any, argument: str = "", at: str = "") -> None:
        """Raise if a quantity of the state is not positive.

        Parameters
        ----------
        u : array
        params : tree
        argument : str
            The argument of the law that u comes from, if it is not the state in the cells.
        at : str
            Where it holds, the end of a message.
        """

    @abstractmethod
    def _rate(self, u: Any, params: Any) -> Any:
        """Return the rate of a state."""

    @abstractmethod
    def _fastest_waves(self, axis: AxisFluxes, u: NDArray, params: Any) -> NDArray:
        """Return the speed of the fastest wave along an axis in each cell, including waves of the inflow."""

    def _source_term(self, u: Any, params: Any) -> Any:
        """Return the source in the cells, zeros without one."""
        if self.source is None:
            return np.zeros(u.shape)
        return checked_result(self._what("source"), self.source(u, params), u)

    def _what(self, part: str, argument: str = "") -> str:
        """Return the subject of a message; for `argument` see `_check_physical`."""
        if argument:
            part = f"{part} of the {argument}"
        return f"the {part} of a {self.name}"

    def _checked_state(self, u: Any) -> Any:
        """Return the state as a floating-point array; raise if its shape or dtype is wrong."""
        values = field_array(self, sample(u), batch=True)
        fields = values.shape[: values.ndim - self.grid.dim]
        if len(fields) > 1:
            expected = ", ".join(map(str, ("fields", *self.grid.shape)))
            raise ShapeError(f"{self.name} takes u of shape ({expected}), got {values.shape}")
        if fields:
            count = fields[0]
        else:
            count = 1
        if self.momentum is not None and max(self.momentum) >= count:
            raise ShapeError(f"{self._required_fields()}, got u of shape {values.shape}")
        check_kind(f"u of {self.name}", values.dtype, "real numbers", "; write u.real")
        return frozen(u if isbox(u) else values)

    def _required_fields(self) -> str:
        """Return the beginning of the message for a state without a field for each momentum."""
        return f"{self.name} needs a field for each number in momentum={self.momentum}"

    def _first_field(self, u: Any) -> Any:
        """Return the first field of a state, or the state if it is one field."""
        return u[(0,) * (u.ndim - self.grid.dim)]

    def time_step(self, u: Any, params: Any = None, cfl: float = 0.4) -> float:
        """Return a stable dt: `cfl` divided by the largest sum over the axes of speed / width in a cell.

        Parameters
        ----------
        u : array
            The state, as for the call. The speeds are taken in the cells and, at inflow boundaries, of the inflow; of
            `shallow_water` and with `positive` also on both sides of the faces.
        params : tree, optional
        cfl : float
            Up to 0.5 for limited slopes, up to 1 for "upwind".

        Returns
        -------
        float [time]
            Infinite if all speeds are 0. Not differentiated.

        Raises
        ------
        ValueError
            If cfl is not > 0, or a speed is negative.
        ShapeError, NonFiniteError, UnstableStepError
            As the call.
        """
        check_number("cfl of time_step", cfl, "> 0", "; write cfl=0.4")
        u = plain(self._checked_state(u))
        params = mapped(plain, params)
        self._check_states(u, params)
        rates = sum(self._fastest_waves(axis, u, params) / axis.widths for axis in self.axes)
        largest = np.max(rates, initial=0.0)
        if largest:
            return float(cfl / largest)
        return np.inf

    def __repr__(self) -> str:
        return f"<{self.name} {self.scheme}: {self.grid.cells}>"


class ConservationLaw(FiniteVolumes):
    """The rate of change of a conservation law, ``law(u, params=None)``, as `conservation_law` returns it.

    Parameters
    ----------
    flux, speed, equilibrium, positive
        As `conservation_law` takes them.
    grid, scheme, sides, momentum, inflow, source
        As `FiniteVolumes` takes them.
    """

    name = "conservation_law"

    def __init__(
        self,
        grid: Grid,
        flux: Callable,
        speed: Callable,
        scheme: str,
        sides: tuple,
        momentum: tuple[int, ...] | None,
        inflow: Any,
        source: Callable | None,
        equilibrium: Any,
        positive: dict[str, Callable] | None = None,
    ) -> None:
        super().__init__(grid, scheme, sides, momentum, inflow, source)
        self.flux = flux
        self.speed = speed
        self.equilibrium = constant(equilibrium)
        self.positive = positive or {}

    def recipe(self) -> tuple:
        """Return the call that builds an equal object, for pickling and copying."""
        return ConservationLaw, (
            self.grid,
            self.flux,
            self.speed,
            self.scheme,
            self.sides,
            self.momentum,
            self.inflow,
            self.source,
            self.equilibrium,
            self.positive,
        )

    @public("dp.conservation_law(grid, flux, speed)")
    def __call__(self, u: Any, params: Any = None) -> Any:
        """Return the rate of change of a state.

        Parameters
        ----------
        u : array, shape (fields, *grid.shape) or grid.shape
        params : tree, optional
            Passed to flux, speed, source, inflow, equilibrium and the functions of positive, where these are functions.

        Returns
        -------
        array like u
        """
        return self._checked_rate(u, params)

    def _check_states(self, u: Any, params: Any) -> None:
        if self.positive:
            super()._check_states(u, params)

    def _check_physical(self, u: Any, params: Any, argument: str = "", at: str = "") -> None:
        for name, quantity in self.positive.items():
            check = partial(check_positive, self._what(name, argument) + at, argument=argument)
            check_values(check, self._quantity(name, quantity, u, params))

    def _equilibrium_state(self, u: Any, params: Any) -> Any:
        """Return the equilibrium for these params, or None."""
        equilibrium = self.equilibrium
        if equilibrium is None:
            return None
        if callable(equilibrium):
            equilibrium = equilibrium(params)
        return checked_result(self._what("equilibrium"), equilibrium, u)

    def _quantity(self, name: str, quantity: Callable, u: Any, params: Any) -> Any:
        """Return a positive quantity of states; raise unless it is real and has the shape of one field."""
        value = quantity(u, params)
        checked_result(self._what(name), sample(value), self._first_field(u))
        return value

    def _rate(self, u: Any, params: Any) -> Any:
        e = self._equilibrium_state(u, params)
        if e is None:
            return self._rate_beside(u, None, params)
        self._check_physical(e, params, "equilibrium")
        at_rest = self._rate_beside(e, e, params, with_inflow=False)
        return self._rate_beside(u, e, params) - at_rest

    def _rate_beside(self, u: Any, equilibrium: Any, params: Any, with_inflow: bool = True) -> Any:
        """Return the rate of a state; `equilibrium` affects the slopes only.

        For `with_inflow` see `AxisFluxes.padded`.
        """
        total = self._source_term(u, params)
        for axis in self.axes:
            lower, upper = self._beside_faces(axis, u, equilibrium, params, with_inflow)
            f = self._numerical_flux(axis, lower, upper, params, "" if with_inflow else "equilibrium")
            total = total + (axis.part(f, 0, -1) - axis.part(f, 1)) / axis.widths
        return total

    def _beside_faces(self, axis: AxisFluxes, u: Any, equilibrium: Any, params: Any, with_inflow: bool = True) -> tuple:
        """Return the values below and above each face along an axis."""
        padded = axis.padded(u, params, with_inflow)
        if equilibrium is None:
            at_lower_end, at_upper_end = axis.ends_of_cells(padded)
        else:
            at_rest = axis.padded(equilibrium, params, False)
            at_faces = axis.face_means(at_rest)
            at_lower_end, at_upper_end = axis.ends_of_cells(padded - at_rest)
            at_lower_end = at_lower_end + axis.part(at_faces, 0, -1)
            at_upper_end = at_upper_end + axis.part(at_faces, 1)
        if self.positive:
            cells = axis.part(padded, 1, -1)
            at_lower_end, at_upper_end = self._kept_positive(cells, at_lower_end, at_upper_end, params)
        return axis.part(at_upper_end, 0, -1), axis.part(at_lower_end, 1)

    def _kept_positive(self, cells: Any, at_lower_end: Any, at_upper_end: Any, params: Any) -> tuple[Any, Any]:
        """Return the values at both ends of the cells, moved towards the cells where a quantity is too small."""
        for name, quantity in self.positive.items():
            states = [frozen(state) for state in (cells, at_lower_end, at_upper_end)]
            in_cell, at_lower, at_upper = (self._quantity(name, quantity, state, params) for state in states)
            least = anp.minimum(at_lower, at_upper)
            floor = POSITIVE_FLOOR * in_cell
            too_small = least < floor
            theta = anp.where(too_small, (in_cell - floor) / anp.where(too_small, in_cell - least, 1.0), 1.0)
            at_lower_end = anp.where(too_small, cells + theta * (at_lower_end - cells), at_lower_end)
            at_upper_end = anp.where(too_small, cells + theta * (at_upper_end - cells), at_upper_end)
        return at_lower_end, at_upper_end

    def _numerical_flux(self, axis: AxisFluxes, lower: Any, upper: Any, params: Any, argument: str) -> Any:
        """Return the flux of Harten, Lax and van Leer for the values below and above each face.

        For `argument` see `_check_physical`.
        """
        both = frozen(anp.concatenate([lower, upper], axis.place))
        f_lower, f_upper = axis.halves(checked_result(self._what("flux"), self.flux(both, params, axis.number), both))
        slowest, fastest = self._wave_speeds(axis.number, both, params, argument)
        a = anp.minimum(anp.minimum(*axis.halves(slowest)), 0.0)
        b = anp.maximum(anp.maximum(*axis.halves(fastest)), 0.0)
        no_waves = a == b  # a = b = 0: the flux is the mean of both fluxes
        width = b - a + no_waves
        share = (b + 0.5 * no_waves) / width
        return share * f_lower + (1.0 - share) * f_upper + a * b / width * (upper - lower)

    def _wave_speeds(self, axis: int, u: Any, params: Any, argument: str = "") -> tuple[Any, Any]:
        """Return the speeds of the slowest and the fastest wave along an axis."""
        speeds = self.speed(u, params, axis)
        first_field = self._first_field(u)
        if isinstance(speeds, tuple):
            slowest, fastest = (checked_result(self._what("speed"), speed, first_field) for speed in speeds)
        else:
            fastest = checked_result(self._what("speed"), speeds, first_field)
            slowest = -fastest
        what = f"{self._what('speed', argument)} along {AXES[axis]}"
        check_values(partial(_check_speeds, what, argument), slowest, fastest)
        return slowest, fastest

    def _fastest_waves(self, axis: AxisFluxes, u: NDArray, params: Any) -> NDArray:
        """Return the speed of the fastest wave along an axis in each cell, including waves of the inflow."""
        speeds = np.max(np.abs(self._wave_speeds(axis.number, u, params)), axis=0)
        for side, edge in ((0, slice(0, 1)), (1, slice(-1, None))):
            if axis.sides[side] == inflow_side:
                entering = plain(axis.ghost_values(u, params, side))
                beyond = np.max(np.abs(self._wave_speeds(axis.number, entering, params)), axis=0)
                cells = axis.at(edge)
                speeds[cells] = np.maximum(speeds[cells], axis.part(beyond, 0, 1))
        if self.positive:
            lower, upper = map(plain, self._beside_faces(axis, u, plain(self._equilibrium_state(u, params)), params))
            both = frozen(np.concatenate([lower, upper], axis.place))
            beside_faces = np.max(np.abs(self._wave_speeds(axis.number, both, params)), axis=0)
            at_faces = np.maximum(*axis.halves(beside_faces))
            at_ends = np.maximum(axis.part(at_faces, 0, -1), axis.part(at_faces, 1))
            speeds = np.maximum(speeds, at_ends)
        return speeds


def check_positive(what: str, values: Any, slack: float | None = None, argument: str = "", advice: str = "") -> None:
    """Raise an error that names the quantity and the cell where it is not positive.

    Parameters
    ----------
    what : str
        Subject of the message.
    values : array
    slack : float, optional
        If it is given, 0 is valid, and so are negative values of at most this size.
    argument : str, optional
        The argument of the law that the values come from, if they do not come from the state in the cells.
    advice : str, optional
        Further advice for values of the state.
    """
    check_finite(what, values)
    if slack is None:
        wrong = values <= 0
        needs = "> 0"
    else:
        wrong = values < -slack
        needs = ">= 0"
    if np.any(wrong):
        first = int(np.argmax(wrong))
        count = np.count_nonzero(wrong)
        if argument:
            raise UnstableStepError(f"{what} must be {needs}, got {values.flat[first]:g}; change {argument}=")
        if count > 1:
            others = f" and in {count - 1} more"
        else:
            others = ""
        raise UnstableStepError(
            f"{what} must be {needs}, got {values.flat[first]:g} in cell {place(first, values.shape)}{others}; give a "
            f"state without such cells, or take smaller steps, dt <= law.time_step(u, params){advice}"
        )


def _check_speeds(what, argument, slowest, fastest):
    """Raise an error for wave speeds that are not finite or in the wrong order."""
    advice = f"; change {argument}=" if argument else IF_NOT_FINITE
    for speed in (slowest, fastest):
        check_finite(what, speed, advice=advice)
    if np.any(slowest > fastest):  # the flux would not be upwind
        raise ValueError(
            "the speed of a conservation_law must be >= 0, or a pair, the slowest before the fastest; write abs(u) "
            "for u, or (u - c, u + c)"
        )


def checked_result(what: str, value: Any, u: Any) -> Any:
    """Return the result of a user-supplied function as an array.

    Parameters
    ----------
    what : str
        Name in error messages.
    value : array or list, traced or not
    u : array
        An array of the expected shape.

    Returns
    -------
    array, shape of u

    Raises
    ------
    ShapeError
        If the result has another shape.
    TypeError
        If it does not hold real numbers, or is an array of another library.
    """
    check_plain(what, value)
    if isinstance(value, (list, tuple)):
        value = anp.array(value)
    check_shape(what, value, np.shape(u))
    check_kind(what, dtype_of(value), "real numbers", "; write its .real")
    return value


class AxisFluxes:
    """Ghost cells, limited slopes and face values of a conservation law along one axis of the grid.

    Parameters
    ----------
    grid : Grid
    number : int
        Index of the axis.
    sides : pair of FlowCondition, or (None, None) if the axis is periodic
    momentum : int or None
        Index of the field whose sign is reversed at walls.
    inflow : array, number or callable
        As `conservation_law` takes it.
    scheme : Scheme
    name : str
        Name of the law, for error messages.
    """

    def __init__(
        self, grid: Grid, number: int, sides: tuple, momentum: int | None, inflow: Any, scheme: Scheme, name: str
    ) -> None:
        self.name = name
        self.number = number
        self.place = number - grid.dim  # index of this axis in an array of fields, counted from the end
        self.dim = grid.dim
        self.sides = sides
        self.momentum = momentum
        self.inflow = inflow
        widths = grid.widths[number]
        cells = np.arange(grid.shape[number])
        repeated_lower = np.pad(cells, GHOSTS, PAD_MODES[sides[0]])
        repeated_upper = np.pad(cells, GHOSTS, PAD_MODES[sides[1]])
        self.ghosts = repeated_lower[:GHOSTS], repeated_upper[-GHOSTS:]  # indices of the repeated cells
        indices = np.concatenate([self.ghosts[0], cells, self.ghosts[1]])
        self.differs = np.diff(indices) != 0  # False between two copies of one cell
        self.differs[:GHOSTS] |= sides[0] == inflow_side
        self.differs[-GHOSTS:] |= sides[1] == inflow_side
        self.widths = self._along(widths)
        padded_widths = np.concatenate([widths[repeated_lower[:-GHOSTS]], widths[repeated_upper[-GHOSTS:]]])
        gaps = padded_widths[1:] + padded_widths[:-1]
        self.distances = [self._along(gap / padded_widths[1:-1]) for gap in (gaps[:-1], gaps[1:])]
        self.limiters = []  # for the upper and the lower end of each cell; a single one if both slopes are equal
        if scheme.limiter is not None:
            ends = [0] if scheme.symmetric else [0, 1]
            self.limiters = [self._limiter(scheme.limiter, end) for end in ends]

    def _along(self, line: NDArray) -> Any:
        """Return the values along this axis in a shape that broadcasts to fields; a scalar if all are equal."""
        if np.all(line == line[0]):
            return line[0]
        return self.along_fields(line)

    def along_fields(self, line: NDArray) -> NDArray:
        """Return the values along this axis in a shape that broadcasts to fields."""
        return line.reshape(-1, *[1] * (-1 - self.place))

    def part(self, x: Any, start: int, stop: int | None = None) -> Any:
        """Return the entries from start to stop along this axis."""
        return x[self.at(slice(start, stop))]

    def at(self, places: Any) -> tuple:
        """Return the index expression that selects `places` along this axis."""
        return (Ellipsis, places, *[slice(None)] * (-1 - self.place))

    def halves(self, x: Any) -> tuple[Any, Any]:
        """Split an array along this axis: into the values below all faces and the values above all faces."""
        n = x.shape[self.place] // 2
        return self.part(x, 0, n), self.part(x, n)

    def padded(self, u: Any, params: Any, with_inflow: bool = True) -> Any:
        """Return a state with its ghost cells.

        At an inflow boundary they hold the inflow or, if `with_inflow` is False, repeat the last cell.
        """
        lower = self.ghost_values(u, params, 0, with_inflow)
        upper = self.ghost_values(u, params, 1, with_inflow)
        return anp.concatenate([lower, u, upper], self.place)

    def extended(self, field: Any) -> Any:
        """Return a field with its ghost cells, which repeat cells at all boundaries."""
        lower, upper = (field[self.at(ghosts)] for ghosts in self.ghosts)
        return anp.concatenate([lower, field, upper], self.place)

    def ghost_values(self, u: Any, params: Any, upper: int, with_inflow: bool = True) -> Any:
        """Return the values of the ghost cells beyond the lower (0) or the upper (1) end."""
        ghosts = u[self.at(self.ghosts[upper])]
        side = self.sides[upper]
        if side == free_slip:  # the normal momentum changes its sign
            if u.ndim == self.dim:
                return -ghosts
            signs = 1.0 - 2.0 * (np.arange(len(u)) == self.momentum)
            return ghosts * self._per_field(signs)
        if side != inflow_side or not with_inflow:
            return ghosts
        value = self.inflow
        if callable(value):
            value = value(params, self.number, upper)
        if np.ndim(value) == 1 and u.ndim > self.dim:
            value = self._per_field(value)
        return checked_result(f"the inflow of a {self.name}", value + np.zeros(ghosts.shape, dtype_of(ghosts)), ghosts)

    def _per_field(self, numbers: Any) -> Any:
        """Reshape an array with one number for each field, so that it broadcasts to the fields."""
        return anp.reshape(numbers, (-1,) + (1,) * self.dim)

    def face_means(self, padded: Any) -> Any:
        """Return the means of the two cells at each face, including the faces between two ghost cells."""
        return 0.5 * (self.part(padded, 0, -1) + self.part(padded, 1))

    def ends_of_cells(self, padded: Any) -> tuple[Any, Any]:
        """Return the values at the lower and the upper end of each cell, and of one ghost cell beyond each side."""
        cells = self.part(padded, 1, -1)
        if not self.limiters:
            return cells, cells
        slopes = self.slopes(padded)
        return cells - slopes[-1], cells + slopes[0]

    def slopes(self, padded: Any) -> list:
        """Return the limited differences between the upper end, or the lower end, of each cell and the cell."""
        differences = self.part(padded, 1) - self.part(padded, 0, -1)
        below = self.part(differences, 0, -1)
        above = self.part(differences, 1)
        return [limiter(below, above) for limiter in self.limiters]

    def _limiter(self, limiter: Callable, end: int) -> Any:
        """Return the differentiation rule of the limited slope at an end of each cell (0 upper, 1 lower).

        Its arguments are the differences to the cells below and above. The limiter returns the two slopes, followed by
        their derivatives.
        """

        def slope(a, b):
            return limiter(a, b, *self.distances)[end]

        def derivatives(a, b):
            return limiter(a, b, *self.distances)[2 + 2 * end : 4 + 2 * end]

        return entrywise("limiter", slope, derivatives)
