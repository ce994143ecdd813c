"""Leapfrog steps of a first-order system p' = f(q), q' = g(p), with both fields half a step apart; and sponge layers.

q belongs to times halfway between those of p. A step h takes the state (p_n, q_(n-1/2)) to (p_(n+1), q_(n+1/2)):

    q' = q + h g(p),        p' = p + h f(q'),

second order, stable up to h w = 2 for the fastest frequency w, and reversible. w^2 is the largest eigenvalue of -f' g':
it is estimated once for each h and params, from below, by a few steps of Arnoldi's method. The reversed step is

    p = p' - h f(q'),       q = q' - h g(p).

Damping with the rates s >= 0 [1 / time], one for each field, is split evenly over old and new values, stable for any s:

    x' = ((1 - s h / 2) x + h r) / (1 + s h / 2) = x + h (r - s x) / (1 + s h / 2),       r = f or g.

Where p and q are damped at the same rate the impedance does not change: a wave enters a sponge layer without an echo,
except for the effects of the slope of the rate and of the angle.

References
----------
K. S. Yee, IEEE Trans. Antennas Propag. 14 (1966) 302-307 (the scheme); J.-P. Berenger, J. Comput. Phys. 114 (1994)
185-200 (matched damping, its strength for a given echo).
"""

from __future__ import annotations

from math import log
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse.linalg import ArpackError, LinearOperator, eigs

from sparsedp._utils.pytree import flatten, is_uniform, leaves, mapped, paired
from sparsedp._utils.validation import check_function, check_number, is_whole, number_beside, rounded_down
from sparsedp.autodiff.backend import replicated
from sparsedp.autodiff.derivative import push
from sparsedp.autodiff.tape import is_variable, plain
from sparsedp.errors import UnstableStepError
from sparsedp.grid.grid import AXES, check_grid
from sparsedp.integrators.adaptive import FlatDeviation
from sparsedp.integrators.problem import check_pair, combine, field_leaves, untraced
from sparsedp.integrators.runge_kutta import Scheme
from sparsedp.solvers.cache import Cache

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy.typing as npt

    from sparsedp.grid.grid import Grid

__all__ = ["Leapfrog", "sponge"]

# Products and tolerance of Arnoldi's method: (h w)^2 is right to 0.4 % on 300^2 cells, to 2 % at worst.
PRODUCTS = 20
ROUGH = 0.1
SLACK = 1e-3  # excess of (h w)^2 over the limit, from which on a step is refused
SAFE = 0.98  # share of the limit that the message recommends
POWER = 2  # of the depth in a sponge layer, with which its rate grows: of 1 to 4 the least echo, with echo=1e-3


class Leapfrog(Scheme):
    """Steps of p' = f(q, params), q' = g(p, params): see the head of this file.

    Parameters
    ----------
    rates : pair of callables
        f and g.
    damping : None, or pair of numbers or trees
        Of p and of q.
    """

    stiff = ()
    timed = False

    def __init__(self, rates: Any, damping: Any) -> None:
        super().__init__(self, "leapfrog", 2)
        example = "(lambda v, c: ..., lambda p, c: ...) for the state (p, v)"
        for rate in check_pair("the rates of leapfrog", rates, example):
            check_function("a rate of leapfrog", rate, "lambda field, params: ...", 2)
        if damping is not None:
            check_pair("damping, for both fields of the state,", damping, "(s, None)")
        for rate in map(plain, leaves(damping)):
            if rate is not None and not (np.all(np.isfinite(rate)) and np.all(rate >= 0)):
                raise ValueError("damping needs finite rates >= 0 [1 / time]; take dp.sponge(grid, cells, speed)")
        self.rates = rates
        self.damping = damping
        self._fastest_squares = Cache()

    def check_stable(self, state: Any, params: Any, h: Any, dependencies: Any) -> None:
        """Refuse a step that would grow without bound; `dependencies`: all that the frequencies depend on."""
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
        """Return (h w)^2 of the fastest waves."""
        p, q = _fields(state)
        f, g = self.rates
        p = mapped(lambda leaf: leaf if leaf is None else leaf * 1.0, p)  # whole numbers have no slope
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
            start = np.random.default_rng(0).standard_normal(n)  # the same bits in every run
            operator = LinearOperator((n, n), product, dtype=float)
            try:
                values = eigs(operator, 1, which="LR", v0=start, ncv=PRODUCTS, tol=ROUGH, return_eigenvectors=False)
            except ArpackError:  # of a map that is 0
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
        """Refuse a step with damping."""
        if self.damping is not None:
            raise ValueError(
                "a leapfrog step with damping cannot be reversed: the damped part would grow; give rollout a memory "
                "in bytes"
            )

    def back(self, state: Any, params: Any, h: Any) -> tuple:
        """Return the state before a step."""
        p, q = _fields(state)
        f, g = self.rates
        p = combine(p, (-h, f(q, params)))
        return p, combine(q, (-h, g(p, params)))


def _fields(state: Any) -> Any:
    return check_pair("the state of leapfrog", state, "(p, v)")


def _advanced(x: Any, rate: Any, h: Any, damping: Any, name: str) -> Any:
    """Return x after h, with its rate; `name` of the damping is for messages."""
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
    """Return rates at which waves decay near the ends of a grid: damping for `stepper("leapfrog", ...)`.

    Parameters
    ----------
    grid : Grid
    cells : int, or dict
        How many cells deep the sponge is at every bounded end; or {"x": 8, "y": (lower, upper)}, 0 for none, axes that
        are not named have none.
    speed : float
        Of the waves there, the fastest [length / time].
    echo : float
        Remaining share of a wave that enters at a right angle, is reflected at the wall, and leaves.

    Returns
    -------
    (array of grid.shape, array of grid.faces.shape)
        Rates in the cells and on the faces [1 / time]: for the state (p, v) of pressures and velocities, as the
        `damping` of `stepper` takes them.

    Raises
    ------
    ValueError
        If a sponge is deeper than its axis, an axis that is named has no ends, or speed or echo are out of range.

    See Also
    --------
    stepper

    Notes
    -----
    The rate grows with the square of the depth: s = 1.5 c log(1 / echo) (depth / width)^2 / width. Measured for round
    waves around a pulse: an echo of 2e-4 of the pulse where the sponge is two wavelengths deep, 5e-4 for one and a
    half, 2e-3 for one. A mean of p that is not 0 leaves an echo of 1e-2, where open space leaves none.

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
    check_number("speed of sponge", speed, "> 0", "; give the speed of the fastest waves")
    check_number("echo of sponge", echo, "between 0 and 1", "; the default is 1e-3")
    bounded = [name for name, periodic in zip(grid.axes, grid.periodic, strict=True) if not periodic]
    depths: dict[str, Any] = dict(cells) if isinstance(cells, dict) else dict.fromkeys(bounded, cells)
    if set(depths) - set(bounded) or any(np.shape(deep) not in ((), (2,)) for deep in depths.values()):
        raise ValueError(f"sponge needs a number of cells or a pair for axes of {bounded}, got {cells!r}")

    def rates(places: Any) -> np.ndarray:
        """Return the rates at places, a list of coordinates by axis."""
        total: Any = 0
        for axis, name in enumerate(grid.axes):
            for is_upper, count in enumerate(np.broadcast_to(depths.get(name, 0), 2)):
                shape = _rate(grid, axis, is_upper, count, places[axis])
                total = total + shape * (POWER + 1) / 2 * speed * log(1 / echo)
        return total

    return rates(grid.centres()), grid.join(*(rates(grid.face_centres(axis)) for axis in range(grid.dim)))


def _rate(grid: Grid, axis: int, is_upper: int, count: Any, x: Any) -> np.ndarray:
    """Return (depth / width)^POWER / width at the places x along an axis."""
    widths = grid.widths[axis]
    if not (is_whole(count, 0) and count <= widths.size):
        raise ValueError(f"sponge on {AXES[axis]} needs 0 to {widths.size} cells, got {count}")
    count = int(count)  # 2.0 counts as a whole number
    width = np.inf
    if count:
        width = np.sum(widths[-count:] if is_upper else widths[:count])
    wall = grid.origin[axis] + is_upper * np.sum(widths)
    return np.maximum(1 - np.abs(x - wall) / width, 0.0) ** POWER / width
