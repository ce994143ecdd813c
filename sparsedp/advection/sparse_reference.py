"""The Eulerian schemes as products with sparse matrices.

These formulas work without numba and with traced values, give the matrix of a step, and are the reference for the tests
of the compiled loops. The compiled loops exist because they are about ten times as fast.

All quantities belong to the lower or upper side of a point along an axis. Let C be the velocity there times dt over the
length, H = 1, 1/2 or 0 for C > 0, C = 0 or C < 0, p = H C and m = (1 - H) C. Then

    u'     = (1 - sum of leaves) u + sum of enters
    leaves = p_lower - m_upper  [+ C_upper - C_lower in flux form]
    enters = p_lower (u_below + ahead_below) - m_upper (u_above - behind_above) - p_upper ahead - m_lower behind

where the sums are over the axes, and `ahead` and `behind` are the corrections that the limiter of a second-order scheme
adds at the upper and the lower side of a point. For differentiation, H and the derivatives of the limiter are treated
as constants. This is exact except at kinks; for a velocity of 0 it gives the mean of both one-sided derivatives. In a
scheme with several stages, the result of a stage is averaged with the first field.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp._utils.pytree import placed
from sparsedp.advection.control_volumes import Component, components
from sparsedp.autodiff.derivative import pullback, pushforward
from sparsedp.autodiff.program_trace import recorded_level
from sparsedp.autodiff.tape import isbox, linear, plain
from sparsedp.kernels.fluxes import INVERSE_LENGTH

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from sparsedp.advection.settings import TransportSettings
    from sparsedp.kernels.fluxes import Scheme
    from sparsedp.operators.operator import Operator

__all__ = ["SparseReference"]


class SparseReference:
    """The schemes by the formulas of the module docstring, for plain and for traced flat arguments.

    Parameters
    ----------
    settings : TransportSettings
    scheme : Scheme
    inflow_size : int
        Number of inflow values.
    interpolation : Operator or None
        Interpolates the velocity to the sides or points where the scheme needs it; None if it is given there.
    """

    def __init__(
        self, settings: TransportSettings, scheme: Scheme, inflow_size: int, interpolation: Operator | None
    ) -> None:
        self.settings = settings
        self.scheme = scheme
        if settings.form == "flux":
            self.flux_form = 1.0
        else:
            self.flux_form = 0.0
        self._inflow_size = inflow_size
        self._interpolation = interpolation

    @cached_property
    def components(self) -> list[Component]:
        """The components of the field."""
        return components(self.settings, self.scheme.limiter is not None)

    @cached_property
    def _sides(self) -> _SideTable:
        """The sides of all points, axis by axis and component by component."""
        tables = []
        rows = 0
        for component in self.components:
            start = component.field.start
            points = np.arange(start, component.field.stop)
            for axis in range(len(component.axes)):
                sides = component.sides(axis)
                lengths = component.table[:, sides.column]
                is_open = np.ones((2, points.size), bool)
                if component.free.size:
                    is_open = component.free[2 * axis : 2 * axis + 2]
                beyond = np.where(is_open, start + sides.beyond, points)
                inflow = self.settings.space.size + component.inflow.start + sides.wall
                beyond = np.where(is_open & (sides.wall >= 0), inflow, beyond)
                slope = np.where(is_open & ~sides.at_wall, rows + sides.beyond, -1)
                speed = component.speed.start + sides.speed
                inverse_lengths = is_open * lengths[INVERSE_LENGTH : INVERSE_LENGTH + 2]
                tables.append((points[None], beyond, slope, speed, inverse_lengths, lengths[-2:]))
                rows += points.size
        return _SideTable(*(np.concatenate(parts, 1) for parts in zip(*tables, strict=True)))

    @cached_property
    def _matrices(self) -> _Matrices:
        sides = self._sides
        points = sides.points[0]
        size = self.settings.space.size
        ones = np.ones(points.size)
        speeds = [_selection(sides.speed[side], 1 + sides.speed.max(), sides.weight[side]) for side in range(2)]
        if self._interpolation is not None:
            speeds = [sp.csr_array(matrix @ self._interpolation.matrix) for matrix in speeds]
        return _Matrices(
            points=_selection(points, size, ones),
            beyond=[_selection(side, size + self._inflow_size, ones) for side in sides.beyond],
            slope=[_selection(side, points.size, ones) for side in sides.slope],
            speed=speeds,
        )

    @cached_property
    def _maps(self) -> _Maps:
        matrices = self._matrices
        return _Maps(
            points=_product(matrices.points),
            total=_product(sp.csr_array(matrices.points.T)),
            beyond=[_product(matrix) for matrix in matrices.beyond],
            slope=[_product(matrix) for matrix in matrices.slope],
            speed=[_product(matrix) for matrix in matrices.speed],
        )

    def _courant_numbers(self, v: Any, dt: Any) -> tuple[Any, Any]:
        """Return the velocity times dt / length on the lower and on the upper sides."""
        lower, upper = self._maps.speed
        return dt * lower(v), dt * upper(v)

    def _leaves(self, lower: Any, upper: Any, p_lower: Any, m_upper: Any) -> Any:
        """Return, for each point and axis, the fraction of the value that leaves the point."""
        leaves = p_lower - m_upper
        if self.flux_form:
            return leaves + upper - lower
        return leaves

    def _stage(self, u: Any, lower: Any, upper: Any, inflow: Any) -> Any:
        """Return u + dt du/dt for the Courant numbers on the lower and the upper sides."""
        maps = self._maps
        values = anp.concatenate([u, inflow])
        p_lower, m_lower = _by_direction(lower)
        p_upper, m_upper = _by_direction(upper)
        leaves = self._leaves(lower, upper, p_lower, m_upper)
        below, above = (beyond(values) for beyond in maps.beyond)
        enters = p_lower * below - m_upper * above
        if self.scheme.limiter is not None:
            at_points = maps.points(u)
            ahead, behind = self._slopes(self.scheme.limiter, at_points - below, above - at_points)
            enters = enters + p_lower * maps.slope[0](ahead) + m_upper * maps.slope[1](behind)
            enters = enters - p_upper * ahead - m_lower * behind
        return (1.0 - maps.total(leaves)) * u + maps.total(enters)

    def _slopes(self, limiter: Callable, a: Any, b: Any) -> tuple[Any, Any]:
        """Return `ahead` and `behind` for the differences to the points below and above."""
        a_value = plain(a)
        b_value = plain(b)
        with np.errstate(all="ignore"):
            ahead, behind, *derivatives = limiter(a_value, b_value, *self._sides.distances)
        if isbox(a) or isbox(b):
            da = a - a_value
            db = b - b_value
            ahead = ahead + derivatives[0] * da + derivatives[1] * db
            behind = behind + derivatives[2] * da + derivatives[3] * db
        return ahead, behind

    def step(self, u: Any, v: Any, dt: Any, inflow: Any) -> Any:
        """Return the field after one step."""
        lower, upper = self._courant_numbers(v, dt)
        result = u
        for keep in self.scheme.stages:
            stage = self._stage(result, lower, upper, inflow)
            if keep:
                result = keep * u + (1.0 - keep) * stage
            else:
                result = stage
        return result

    def vjp(self, nums: Sequence[int], g: Any, *args: Any) -> tuple[Any, ...]:
        """Return the cotangents of the arguments `nums` for the cotangent of the result."""

        def step(some):
            return self.step(*placed(args, nums, some))

        return pullback(step, tuple(args[num] for num in nums))[1](g)

    def jvp(self, tangents: Mapping[int, Any], *args: Any) -> Any:
        """Return the tangent of the result; `tangents` is a dict {position of the argument: tangent}."""

        def step(some):
            return self.step(*placed(args, tangents, some))

        return pushforward(step, tuple(args[num] for num in tangents), tuple(tangents.values()))[1]

    def rate(self, v: NDArray) -> NDArray:
        """Return the CFL number of each point divided by dt."""
        lower, upper = self._courant_numbers(v, 1.0)
        p_lower, _ = _by_direction(lower)
        _, m_upper = _by_direction(upper)
        return self._maps.total(self._leaves(lower, upper, p_lower, m_upper))

    def matrix(self, v: NDArray, dt: float) -> sp.csr_array:
        """Return the matrix of the step of a first-order scheme, which maps u to the next field."""
        lower, upper = self._courant_numbers(v, dt)
        p_lower, _ = _by_direction(lower)
        _, m_upper = _by_direction(upper)
        size = self.settings.space.size
        below, above = (matrix[:, :size] for matrix in self._matrices.beyond)
        enters = sp.diags_array(p_lower) @ below - sp.diags_array(m_upper) @ above
        keeps = sp.diags_array(1.0 - dt * self.rate(v))
        return sp.csr_array(keeps + self._matrices.points.T @ enters)


class _SideTable(NamedTuple):
    """Arrays with a column for each pair of a point and an axis; the rows are for the lower and the upper side."""

    points: NDArray  # index of the point itself, one row
    beyond: NDArray  # index of the value beyond the side, in (field, inflow)
    slope: NDArray  # column of the neighbour whose slope is used at the side; -1 if there is none
    speed: NDArray  # index of the velocity
    weight: NDArray  # 1 / length, 0 on closed sides
    distances: NDArray  # c and e of the limiter


class _Matrices(NamedTuple):
    """Matrices from the field, (field, inflow), slopes and velocity to the sides; a list has one for each side."""

    points: Any
    beyond: list
    slope: list
    speed: list


class _Maps(NamedTuple):
    """Products with the `_Matrices`, as functions of plain and traced arrays; `total` sums over the axes of a point."""

    points: Callable[[Any], Any]
    total: Callable[[Any], Any]
    beyond: list[Callable[[Any], Any]]
    slope: list[Callable[[Any], Any]]
    speed: list[Callable[[Any], Any]]


def _by_direction(courant: Any) -> tuple[Any, Any]:
    """Return the positive part p and the negative part m of Courant numbers."""
    share = anp.heaviside(recorded_level(courant), 0.5)
    return courant * share, courant * (1.0 - share)


def _selection(columns: NDArray, size: int, values: NDArray) -> sp.csr_array:
    """Return the matrix with the entry `values[i]` in column `columns[i]` of row i; no entry if the column is -1."""
    keep = (columns >= 0) & (values != 0)
    places = np.flatnonzero(keep), columns[keep].astype(np.int32)
    return sp.csr_array((values[keep], places), (columns.size, size))


def _product(matrix: sp.csr_array) -> Callable[[Any], Any]:
    """Return the product with a matrix as a function of plain and traced arrays."""
    rule = linear("transport", matrix.__matmul__, sp.csr_array(matrix.T).__matmul__)[0]

    def product(x):
        if isbox(x):
            return rule(x)
        return matrix @ x

    return product
