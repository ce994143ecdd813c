"""Leapfrog steps of a first-order system dp/dt = f(q), dq/dt = g(p), and damping layers ("sponges") for waves.

The field q is staggered in time: it is given half a step before p. A step of length h advances the state
(p_n, q_(n-1/2)) to (p_(n+1), q_(n+1/2)), written with primes for new values:

    q' = q + h g(p),        p' = p + h f(q').

The method has order 2, is reversible, and is stable for h w <= 2, where w is the largest frequency. w^2 is the largest
eigenvalue of -f' g' (derivatives of f and g). It is estimated once for each h and params by a few steps of Arnoldi's
method, which gives a lower bound. The reversed step is

    p = p' - h f(q'),       q = q' - h g(p).

Each field may be damped at a rate s >= 0 [1 / time]. The damping term uses the mean of old and new values, which is
stable for any s:

    x' = ((1 - s h / 2) x + h r) / (1 + s h / 2) = x + h (r - s x) / (1 + s h / 2),       r = f or g.

If p and q are damped at the same rate, the impedance does not change, so that a wave enters a sponge without
reflection. Small reflections remain because s varies in space, and for waves at an oblique angle.

References
----------
K. S. Yee, IEEE Trans. Antennas Propag. 14 (1966) 302-307 (the scheme); J.-P. Berenger, J. Comput. Phys. 114 (1994)
185-200 (matched damping, its strength for a given echo).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial, reduce
from math import log
from operator import mul as multiply
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse.linalg import ArpackError, LinearOperator, eigs

from sparsedp._utils.base_classes import Value
from sparsedp._utils.pytree import flatten, is_uniform, leaves, mapped, paired
from sparsedp._utils.validation import check_function, check_number, is_whole, number_beside, rounded_down
from sparsedp.autodiff.backend import replicated
from sparsedp.autodiff.derivative import push
from sparsedp.autodiff.program_trace import check_values
from sparsedp.autodiff.tape import is_variable
from sparsedp.errors import UnstableStepError
from sparsedp.grid.grid import AXES, check_grid
from sparsedp.integrators.adaptive import FlatDeviation
from sparsedp.integrators.problem import check_pair, combine, field_leaves, untraced
from sparsedp.integrators.runge_kutta import Scheme
from sparsedp.solvers.cache import Cache

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy.typing as npt

    from sparsedp.grid.grid import Grid

__all__ = ["Leapfrog", "MatchedLayer", "matched_layer", "sponge"]

# Number of products and tolerance of Arnoldi's method. The error of (h w)^2 is 0.4 % on 300^2 cells, at most 2 %.
PRODUCTS = 20
EIGENVALUE_TOLERANCE = 0.1
SLACK = 1e-3  # relative excess of (h w)^2 over the stability limit above which an error is raised
SAFE = 0.98  # fraction of the largest stable dt that the error message recommends
POWER = 2  # the rate in a sponge grows with this power of the depth; of 1 to 4 it had the least echo for echo=1e-3
LEAST_MATCHED = 6  # cells of a matched layer: 6 reflect 4.5e-4 of plane waves up to 60 degrees, 5 reflect 3.2e-3
MATCHED_POWER = 3  # of a matched layer; of 2 to 4 it had the least echo for 8 to 20 cells and echo=1e-8


def _check_damping(*rates):
    """Raise ValueError for damping rates that are negative or not finite."""
    for rate in rates:
        if rate is not None and not (np.all(np.isfinite(rate)) and np.all(rate >= 0)):
            raise ValueError("damping needs finite rates >= 0 [1 / time]; take dp.sponge(grid, cells, speed)")


class Leapfrog(Scheme):
    """Steps of dp/dt = f(q, params), dq/dt = g(p, params): see the docstring of this module.

    Parameters
    ----------
    rates : pair of callables
        f and g.
    damping : None, or pair of numbers or trees
        Damping rates of p and of q.
    """

    stiff = ()
    timed = False

    def __init__(self, rates: Any, damping: Any) -> None:
        super().__init__(self, "leapfrog", 2)
        example = "(lambda v, c: ..., lambda p, c: ...) for the state (p, v)"
        for rate in check_pair("the rates of leapfrog", rates, example):
            check_function("a rate of leapfrog", rate, "lambda field, params: ...", 2)
        if damping is not None:
            example = "layer.damping" if isinstance(damping, MatchedLayer) else "(s, None)"
            check_pair("damping, for both fields of the state,", damping, example)
        check_values(_check_damping, *leaves(damping))
        self.rates = rates
        self.damping = damping
        self._fastest_squares = Cache()

    def check_stable(self, state: Any, params: Any, h: Any, dependencies: Any) -> None:
        """Raise UnstableStepError if waves grow without bound; `dependencies` are the key of the cached estimate."""
        state, params, h, dependencies = mapped(replicated, untraced((state, params, h, dependencies)))
        key = h, *leaves(dependencies)
        fastest = self._fastest_squares.find(key)
        if fastest is None:
            fastest = self._fastest_squares.put(key, self._fastest_square(state, params, h))
        if fastest > 4 * (1 + SLACK):
            safe = rounded_down(SAFE * 2 * h / fastest**0.5)
            shown = number_beside(h, float(safe), digits=12)
            raise UnstableStepError(
                f"leapfrog is unstable with dt = {shown}: waves of frequency {fastest**0.5 / h:.4g} grow; dt = {safe} "
                "is safe, or write unstable='allow'"
            )

    def _fastest_square(self, state: Any, params: Any, h: float) -> float:
        """Return (h w)^2 for the largest frequency w."""
        p, q = _fields(state)
        f, g = self.rates
        p = mapped(lambda leaf: leaf if leaf is None else leaf * 1.0, p)  # convert integers, which have no derivative
        flat = FlatDeviation(p, is_variable, [1.0] * len(leaves(p)))
        n = flat.space.size

        def forces(x: Any) -> Any:
            return flat.deviation(f(combine(q, (h, g(flat.tree(x), params))), params))

        def product(x: np.ndarray) -> np.ndarray:
            slope = -h * push(forces, np.zeros(n), [x])[1]
            return np.where(np.isfinite(slope), slope, 0.0)

        if n <= PRODUCTS:
            values = np.linalg.eigvals(np.reshape([product(unit) for unit in np.eye(n)], (n, n)))
        else:
            start = np.random.default_rng(0).standard_normal(n)  # a fixed seed, so that every run gives the same bits
            operator = LinearOperator((n, n), product, dtype=float)
            try:
                values = eigs(
                    operator, 1, which="LR", v0=start, ncv=PRODUCTS, tol=EIGENVALUE_TOLERANCE, return_eigenvectors=False
                )
            except ArpackError:  # raised if the map is 0
                return 0.0
        return float(np.max(values.real, initial=0.0))

    def __call__(self, state: Any, params: Any, t: Any, h: Any) -> tuple:
        """Return the state after a step."""
        p, q = _fields(state)
        f, g = self.rates
        s, z = self.damping or (None, None)
        q = _advanced(q, g(p, params), h, z, "damping[1]")
        return _advanced(p, f(q, params), h, s, "damping[0]"), q

    def check_reversible(self) -> None:
        """Raise ValueError if the step has damping."""
        if self.damping is not None:
            raise ValueError(
                "a leapfrog step with damping cannot be reversed: the damped part would grow; give rollout a memory "
                "in bytes"
            )

    def back(self, state: Any, params: Any, h: Any) -> tuple:
        """Reverse a step: return the state before it."""
        p, q = _fields(state)
        f, g = self.rates
        p = combine(p, (-h, f(q, params)))
        return p, combine(q, (-h, g(p, params)))


def _fields(state: Any) -> Any:
    return check_pair("the state of leapfrog", state, "(p, v)")


def _advanced(x: Any, rate: Any, h: Any, damping: Any, name: str) -> Any:
    """Return x after a time h with the given rate; `name` is the name of the damping in error messages."""
    if damping is None:
        return combine(x, (h, rate))
    entries, rebuild = flatten(x)
    rates = field_leaves(rate, x)
    dampings = paired(damping, x, name, advice="; give one number, or a tree like the field", prefix=is_uniform)
    rows = zip(entries, rates, dampings, strict=True)
    return rebuild([leaf + h * (r - s * leaf) / (1 + 0.5 * h * s) for leaf, r, s in rows])


def sponge(
    grid: Grid, cells: int | Mapping[str, Any], speed: float, echo: float = 1e-3
) -> tuple[npt.NDArray, npt.NDArray]:
    """Return damping rates for layers ("sponges") at the ends of a grid that absorb waves; see `stepper`.

    Parameters
    ----------
    grid : Grid
    cells : int, or dict
        Thickness of the sponge in cells, at both ends of every axis that is not periodic; or a dict such as
        {"x": 8, "y": (lower, upper)} with the thickness for each axis or end. 0 means no sponge, and axes that are not
        in the dict have none.
    speed : float
        Largest speed of the waves in the sponge [length / time].
    echo : float
        Ratio of the amplitude of a wave that leaves the sponge, after reflection at the wall, to the amplitude of the
        wave that entered it at a right angle.

    Returns
    -------
    in_cells : array of grid.shape
    on_faces : array of grid.faces.shape
        Damping rates [1 / time] of cell and face fields. The pair is the argument `damping` of
        ``stepper("leapfrog", ...)`` for the state (p, v) of pressures and velocities.

    Raises
    ------
    ValueError
        If a sponge is thicker than its axis, if `cells` names a periodic axis or is a number and all axes are periodic,
        or if speed or echo is out of range.

    See Also
    --------
    matched_layer, stepper

    Notes
    -----
    The rate grows with the square of the depth: s = 1.5 c log(1 / echo) (depth / width)^2 / width, where c is the speed
    and width the thickness of the sponge. For circular waves from a pulse the measured echo, relative to the pulse, was
    2e-4 for a sponge of two wavelengths, 5e-4 for one and a half, and 2e-3 for one. If the mean of p is not 0, an echo
    of 1e-2 remains, which does not exist in an unbounded domain.

    References
    ----------
    J.-P. Berenger, J. Comput. Phys. 114 (1994) 185-200.

    Examples
    --------
    >>> from sparsedp import Grid
    >>> inside, between = sponge(Grid(6), {"x": (0, 2)}, speed=1.0, echo=0.01)
    >>> inside.round(3)
    array([0.   , 0.   , 0.   , 0.   , 0.216, 1.943])
    """
    check_grid("sponge", grid)
    rate = _rates("sponge", grid, _counts("sponge", grid, cells), speed, echo, "1e-3", POWER)

    def rates(places: Any) -> np.ndarray:
        """Return the rates at places, given as a list with the coordinates along each axis."""
        return sum(rate(axis, places[axis]) for axis in range(grid.dim))

    in_cells = rates(grid.centres())
    on_faces = grid.join(*(rates(grid.face_centres(axis)) for axis in range(grid.dim)))
    _check_rates("sponge", in_cells, on_faces)
    return in_cells, on_faces


def matched_layer(grid: Grid, cells: int | Mapping[str, Any], speed: float, echo: float = 1e-8) -> MatchedLayer:
    """Return perfectly matched layers at the ends of a grid, which absorb waves of every direction.

    Parameters
    ----------
    grid : Grid
    cells : int, or dict
        Thickness of the layers in cells, as for `sponge`: 0, or at least 6. Take 8 or more.
    speed : float
        Largest speed of the waves in the layers [length / time].
    echo : float
        Ratio of the amplitude of a wave that leaves a layer, after reflection at the wall, to the amplitude of the wave
        that entered it at a right angle. At an angle a from the normal it is ``echo**cos(a)``, in the limit of small
        cells.

    Returns
    -------
    MatchedLayer
        ``layer.damping`` for waves in time, ``layer.coefficients(omega)`` for waves of one frequency.

    Raises
    ------
    ValueError
        If a layer has 1 to 5 cells, if the layers of an axis leave no cell between them, if `cells` names a periodic
        axis or is a number and all axes are periodic, or if speed or echo is out of range.

    See Also
    --------
    sponge, stepper, elliptic_solver

    Notes
    -----
    A rate s(x) grows with the cube of the depth: s = 2 c log(1 / echo) (depth / width)^3 / width. Lengths across the
    layer are stretched by the complex number 1 + i s / omega for waves exp(-i omega t). So a wave decays in the layer
    and is not reflected, whatever its direction. In time this is equivalent to Berenger's split field: each axis has
    its own part of the pressure, damped at the rate of this axis.

    Measured at ten cells a wavelength, the largest reflection of plane waves up to 60 degrees from the normal is 4.5e-4
    for 6 cells, 1.3e-4 for 8 cells and 9e-5 for 10 to 20 cells. Fewer cells are refused: 5 reflect 3.2e-3, 4 reflect
    1.1e-2, and one reflects 0.66.

    References
    ----------
    J.-P. Berenger, J. Comput. Phys. 114 (1994) 185-200; W. C. Chew, W. H. Weedon, Microw. Opt. Technol. Lett. 7 (1994)
    599-604 (complex stretched coordinates).

    Examples
    --------
    Waves of the frequency 0.6 from a point, on a line. Their amplitude does not change until they reach a layer:

    >>> from sparsedp import Grid, dirichlet, divergence, elliptic_solver, gradient
    >>> grid = Grid(60)
    >>> in_cells, on_faces = matched_layer(grid, 10, speed=1.0).coefficients(0.6)
    >>> solve = elliptic_solver(divergence(grid), gradient(grid, dirichlet))
    >>> u = solve(on_faces, in_cells * np.eye(60)[30], -(0.6**2) * in_cells)
    >>> np.abs(u[[12, 20, 40, 48]]).round(3)
    array([0.874, 0.874, 0.874, 0.874])
    """
    check_grid("matched_layer", grid)
    counts = _counts("matched_layer", grid, cells)
    axes = range(grid.dim)
    for axis in axes:
        _check_layers(grid, axis, counts[axis])
    rate = _rates("matched_layer", grid, counts, speed, echo, "1e-8", MATCHED_POWER)
    in_cells = tuple(rate(axis, grid.centres()[axis]) for axis in axes)
    on_faces = tuple(tuple(rate(axis, grid.face_centres(normal)[axis]) for axis in axes) for normal in axes)
    _check_rates("matched_layer", *in_cells, *(rates for lines in on_faces for rates in lines))
    return MatchedLayer(grid, in_cells, on_faces)


class MatchedLayer(Value):
    """Perfectly matched layers of a grid; see `matched_layer`.

    Parameters
    ----------
    grid : Grid
    in_cells : tuple of arrays of grid.shape
        Rates [1 / time] of each axis in the cells. All arrays become read-only.
    on_faces : tuple of tuples of arrays
        ``on_faces[normal][axis]``: the rates of an axis on the faces perpendicular to `normal`.
    """

    grid: Grid
    in_cells: tuple[npt.NDArray, ...]
    on_faces: tuple[tuple[npt.NDArray, ...], ...]

    def __init__(self, grid: Grid, in_cells: tuple, on_faces: tuple) -> None:
        super().__init__(grid=grid, in_cells=in_cells, on_faces=on_faces)
        for rates in (*in_cells, *(line for lines in on_faces for line in lines)):
            rates.flags.writeable = False  # they are part of the hash

    def __reduce__(self) -> tuple:
        return MatchedLayer, (self.grid, self.in_cells, self.on_faces)

    @property
    def _key(self):
        return self.grid, tuple(rates.tobytes() for rates in self.in_cells)

    @property
    def damping(self) -> tuple[tuple[npt.NDArray, ...], npt.NDArray]:
        """The argument `damping` of ``stepper("leapfrog", ...)`` for the state ((p_x, p_y, ...), v).

        The pressure is the sum of its parts, one for each axis: p_x changes with ``divergence(grid, axis="x")`` of v.
        v is the velocity on the faces.
        """
        normal = (rates[axis] for axis, rates in enumerate(self.on_faces))
        return self.in_cells, self.grid.join(*normal)

    def coefficients(self, omega: Any) -> tuple[Any, Any]:
        """Return the coefficients (in_cells, on_faces) of waves exp(-i omega t), complex fields on cells and faces.

        In ``elliptic_solver(D, G)`` multiply k by `on_faces`, and shift and b by `in_cells`. A source in a layer has no
        meaning.

        Parameters
        ----------
        omega : number
            Angular frequency [1 / time], not 0. Differentiable.

        Returns
        -------
        in_cells : complex array of grid.shape
            The product of the stretches of all axes.
        on_faces : complex array of grid.faces.shape
            The same on faces, divided by the square of the stretch across the face.

        Raises
        ------
        ValueError
            If omega is not one finite number other than 0, or so small beside the rates that stretches overflow.
        """
        rates_along = zip(self.in_cells, *self.on_faces, strict=True)
        largest = np.array([max(np.max(rate, initial=0.0) for rate in rates) for rates in rates_along])
        check_values(partial(_check_frequency, largest), omega)

        def stretches(rates: Any) -> list:
            return [1 + 1j * rate / omega for rate in rates]

        on_faces = []
        for normal, line in enumerate(self.on_faces):
            along = stretches(line)
            across = along.pop(normal)
            on_faces.append(reduce(multiply, along, 1.0) / across)
        return reduce(multiply, stretches(self.in_cells)), self.grid.join(*on_faces)

    def __repr__(self) -> str:
        return f"<matched_layer on {self.grid}>"


def _check_frequency(largest_rates, omega):
    """Raise ValueError for a frequency that is not one finite number other than 0, or for which stretches overflow."""
    if np.ndim(omega) or np.asarray(omega).dtype.kind not in "iufc" or not np.isfinite(omega) or omega == 0:
        raise ValueError(f"omega of a matched layer must be one finite number, not 0, got {omega!r}")
    with np.errstate(over="ignore"):
        largest = np.prod(1.0 + largest_rates / abs(omega))
    if not np.isfinite(largest):
        raise ValueError(
            f"omega of a matched layer is too small, got {omega!r} beside rates up to {np.max(largest_rates):.3g}; "
            "give the angular frequency of the waves"
        )


def _check_layers(grid: Grid, axis: int, counts: tuple[int, int]) -> None:
    """Raise ValueError for matched layers of too few cells, or without a cell between them."""
    for count in counts:
        if 0 < count < LEAST_MATCHED:
            raise ValueError(
                f"matched_layer on {AXES[axis]} needs 0 or at least {LEAST_MATCHED} cells, got {count}; fewer reflect "
                "more than 1e-3 of a wave"
            )
    lower, upper = counts
    if lower + upper and lower + upper >= grid.shape[axis]:
        raise ValueError(
            f"matched_layer on {AXES[axis]} got {lower} + {upper} of {grid.shape[axis]} cells; leave cells between the "
            "layers"
        )


def _counts(name: str, grid: Grid, cells: Any) -> list[tuple[int, int]]:
    """Return the cells of the layers at both ends of each axis; `name` is the caller."""
    bounded = [str(axis) for axis, periodic in zip(grid.axes, grid.periodic, strict=True) if not periodic]
    depths: dict[str, Any] = dict(cells) if isinstance(cells, Mapping) else dict.fromkeys(bounded, cells)
    if not bounded and not (isinstance(cells, Mapping) or is_whole(cells, 0) and cells == 0):
        raise ValueError(
            f"{name} needs an axis that is not periodic, got {grid!r}, which is periodic along every axis; write "
            "Grid(..., periodic=False)"
        )
    for word in grid.axes:
        if word in depths and word not in bounded:
            raise ValueError(
                f"{name} got cells for {word}, which is periodic and has no ends; leave it out of cells, or write "
                "periodic=False for this axis of the grid"
            )
    if set(depths) - set(bounded) or any(np.shape(deep) not in ((), (2,)) for deep in depths.values()):
        raise ValueError(f"{name} needs a number of cells or a pair for axes of {bounded}, got {cells!r}")
    counts = []
    for axis, word in enumerate(grid.axes):
        deep = depths.get(word, 0)
        lower, upper = deep if np.ndim(deep) else (deep, deep)
        for count in (lower, upper):
            if not (is_whole(count, 0) and count <= grid.shape[axis]):
                raise ValueError(
                    f"{name} on {AXES[axis]} needs a whole number of cells from 0 to {grid.shape[axis]}, got {count!r}"
                )
        counts.append((int(lower), int(upper)))  # `is_whole` also accepts floats such as 2.0
    return counts


def _rates(
    name: str, grid: Grid, counts: Sequence[tuple[int, int]], speed: float, echo: float, usual: str, power: int
) -> Callable:
    """Return the function ``rate(axis, x)`` of the damping rates of an axis at the coordinates x along it.

    The rates grow with a power of the depth in the layer; `name` is the caller and `usual` its default echo.
    """
    check_number(f"speed of {name}", speed, "> 0", "; give the speed of the fastest waves")
    check_number(f"echo of {name}", echo, "between 0 and 1", f"; the default is {usual}")

    def rate(axis: int, x: Any) -> Any:
        total: Any = 0.0 * x
        for is_upper, count in enumerate(counts[axis]):
            if count:
                with np.errstate(over="ignore", divide="ignore", invalid="ignore"):  # the caller checks
                    shape = _rate(grid, axis, is_upper, count, x, power)
                    total = total + shape * (power + 1) / 2 * speed * -log(echo)
        return total

    return rate


def _check_rates(name: str, *rates: np.ndarray) -> None:
    """Raise ValueError for rates that overflow."""
    if not all(np.all(np.isfinite(array)) for array in rates):
        raise ValueError(
            f"the rates of {name} overflow: they grow with the speed divided by the thickness of the layer; give "
            "lengths and times in other units"
        )


def _rate(grid: Grid, axis: int, is_upper: int, count: int, x: Any, power: int) -> np.ndarray:
    """Return (depth / width)^power / width at the places x along an axis."""
    widths = grid.widths[axis]
    width = np.sum(widths[-count:] if is_upper else widths[:count])
    wall = grid.origin[axis] + is_upper * np.sum(widths)
    return np.maximum(1 - np.abs(x - wall) / width, 0.0) ** power / width
