"""The Eulerian schemes by sparse matrices: what runs without numba, second derivatives, and the test of the loops.

All numbers stand on the lower or upper side of a point along an axis. With C the velocity times dt over the length
there, H = 1, 1/2, 0 for C > 0, = 0, < 0, and p = H C, m = (1 - H) C,

    u'     = (1 - sum of leaves) u + sum of enters
    leaves = p_lower - m_upper  [+ C_upper - C_lower in flux form]
    enters = p_lower (u_below + ahead_below) - m_upper (u_above - behind_above) - p_upper ahead - m_lower behind

over the axes; `ahead` and `behind` are what the limiter of a scheme of second order adds at the sides of a point. H and
the slopes of the limiter are constants to the tape: that is exact away from kinks, and the mean of both sides at rest.
A stage of a scheme with several is followed by a mean with the first field.
"""

from functools import cached_property
from math import prod

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

from sparsedp.advection.lattice import beside, lattices
from sparsedp.advection.velocities import interpolation
from sparsedp.derivative import pullback, pushforward
from sparsedp.kernels.fluxes import SCHEMES
from sparsedp.tape import isbox, linear, plain

__all__ = ["Reference"]


class Reference:
    """The formula in the head of this file, for plain and for traced flat arguments."""

    def __init__(self, setting, walls):
        self.setting, self.scheme, self.walls = setting, SCHEMES[setting.scheme], walls
        self.points, self.limited = setting.velocity == "cells" and setting.form == "advective", self.scheme.limiter
        self.flux = 1.0 if setting.form == "flux" else 0.0

    @cached_property
    def _between(self):
        """From the velocity as given to that on sides (or points) and its transpose; None where they are the same."""
        found = interpolation(self.setting)
        return None if found is None else (found, sp.csr_array(found.T))

    def on_sides(self, v):
        """Velocity as given -> that on the sides of all components (or at their points), axis by axis."""
        return v if self._between is None else self._between[0] @ v

    def of_sides(self, gw):
        """The cotangent of `on_sides` -> that of the velocity as given."""
        return gw if self._between is None else self._between[1] @ gw

    @cached_property
    def tables(self):
        """For the points of all axes of all components, one after the other: a dict of arrays, see `_table`."""
        found, starts = [], {"point": 0, "wall": self.setting.space.size, "speed": 0, "row": 0}
        for lattice in lattices(self.setting):
            own = _numbers(starts, "point", lattice.shape)
            found += [self._table(lattice, number, own, starts) for number in range(len(lattice.axes))]
        return {name: np.concatenate([table[name].ravel() for table in found]) for name in found[0]}

    def _table(self, lattice, number, own, starts):
        """Of one axis: columns of the field and inflow, of slopes and of the velocity; lengths; what is open."""
        axis, shape, walls, none = lattice.axes[number], list(lattice.shape), None, None
        rows, points = _numbers(starts, "row", shape), np.arange(axis.widths.size)
        if not axis.periodic:
            ends = own.take([0], number), own.take([-1], number)
            walls = [_numbers(starts, "wall", end.shape) for end in ends]
            walls = [end if closed else wall for end, closed, wall in zip(ends, axis.closed, walls, strict=True)]
            none = [np.full_like(end, -1) for end in ends]
        shape[number] = points.size if self.points else axis.sides
        speeds = _numbers(starts, "speed", shape)
        is_open = np.ones((2, *own.shape), bool) if lattice.solid is None else lattice.open[number]
        spread = [-1 if a == number else 1 for a in range(own.ndim)]
        found = {"own": own}
        for side, name in enumerate(("lower", "upper")):
            found[f"z {name}"] = np.where(is_open[side], beside(own, number, walls)[side], own)
            found[f"slope {name}"] = np.where(is_open[side], beside(rows, number, none)[side], -1)
            places = points if self.points else (points + side) % axis.sides
            found[f"w {name}"] = speeds.take(places, number)
            length = axis.around[side] if self.points and not self.limited else axis.widths
            found[f"weight {name}"] = is_open[side] / length.reshape(spread)
            found[f"distance {name}"] = np.broadcast_to(axis.distances[side].reshape(spread), own.shape)
        return found

    @cached_property
    def matrices(self):
        """From (field, inflow) to what is below and above, from the velocity to that over length, from points ..."""
        tables, n = self.tables, self.setting.space.size
        rows = np.arange(tables["own"].size)
        size = 1 + max(tables["w lower"].max(), tables["w upper"].max())

        def pick(columns, many, values=1.0):
            values = np.broadcast_to(values, rows.shape)
            keep = (columns >= 0) & (values != 0)
            return sp.csr_array((values[keep], (rows[keep], columns[keep].astype(np.int32))), (rows.size, many))

        found = {"own": pick(tables["own"], n)}
        for side in ("lower", "upper"):
            found[f"z {side}"] = pick(tables[f"z {side}"], n + self.walls.size)
            found[f"slope {side}"] = pick(tables[f"slope {side}"], rows.size)
            speeds = pick(tables[f"w {side}"], size, tables[f"weight {side}"])
            found[f"speed {side}"] = speeds if self._between is None else sp.csr_array(speeds @ self._between[0])
        return found

    @cached_property
    def _maps(self):
        """The matrices as functions of plain and traced arrays, and the transpose of the first one."""
        found = {}
        for name, matrix in self.matrices.items():
            turned = sp.csr_array(matrix.T)
            found[name], back = (_applied(m, rule) for m, rule in zip((matrix, turned), _rules(matrix, turned)))
            if name == "own":
                found["total"] = back
        return found

    def _given(self, low, high):
        """p and m on the lower sides, then on the upper ones, and what leaves the points through both."""
        shares = [np.heaviside(plain(c), 0.5) for c in (low, high)]
        p, m = zip(*((c * share, c * (1.0 - share)) for c, share in zip((low, high), shares)))
        leaves = p[0] - m[1] + high - low if self.flux else p[0] - m[1]
        return p, m, leaves

    def _stage(self, u, low, high, inflow):
        maps, z = self._maps, anp.concatenate([u, inflow])
        (p_low, p_high), (m_low, m_high), leaves = self._given(low, high)
        below, above = maps["z lower"](z), maps["z upper"](z)
        enters = p_low * below - m_high * above
        if self.limited:
            own = maps["own"](u)
            ahead, behind = self._slopes(own - below, above - own)
            enters = enters + p_low * maps["slope lower"](ahead) + m_high * maps["slope upper"](behind)
            enters = enters - p_high * ahead - m_low * behind
        return (1.0 - maps["total"](leaves)) * u + maps["total"](enters)

    def _slopes(self, a, b):
        with np.errstate(all="ignore"):
            given = plain(a), plain(b), self.tables["distance lower"], self.tables["distance upper"]
            ahead, behind, *slopes = self.limited(*given)
        if isbox(a) or isbox(b):
            da, db = a - given[0], b - given[1]
            ahead, behind = ahead + slopes[0] * da + slopes[1] * db, behind + slopes[2] * da + slopes[3] * db
        return ahead, behind

    def step(self, u, v, dt, inflow):
        """The moved field."""
        low, high = dt * self._maps["speed lower"](v), dt * self._maps["speed upper"](v)
        found = u
        for keep in self.scheme.stages:
            new = self._stage(found, low, high, inflow)
            found = keep * u + (1.0 - keep) * new if keep else new
        return found

    def pull(self, nums, g, *args):
        """Cotangent of the moved field -> those of the arguments `nums`."""
        return pullback(lambda some: self.step(*_with(args, nums, some)), tuple(args[num] for num in nums))[1](g)

    def push(self, tangents, *args):
        """{number of an argument: tangent} -> tangent of the moved field."""
        given = tuple(args[num] for num in tangents)
        return pushforward(lambda some: self.step(*_with(args, tangents, some)), given, tuple(tangents.values()))[1]

    def rate(self, v):
        """What the weight 1 - dt * rate of each point is made of."""
        return self._maps["total"](self._given(self._maps["speed lower"](v), self._maps["speed upper"](v))[2])

    def matrix(self, v, dt):
        """The step in the columns of u."""
        low, high = dt * self._maps["speed lower"](v), dt * self._maps["speed upper"](v)
        (p, _), (_, m), _ = self._given(low, high)
        n, total = self.setting.space.size, self.matrices["own"].T
        enters = (
            sp.diags_array(p) @ self.matrices["z lower"][:, :n] - sp.diags_array(m) @ self.matrices["z upper"][:, :n]
        )
        return sp.csr_array(sp.diags_array(1.0 - dt * self.rate(v)) + total @ enters)


def _rules(matrix, turned):
    return linear("transport", matrix.__matmul__, turned.__matmul__)


def _applied(matrix, rule):
    return lambda x: rule(x) if isbox(x) else matrix @ x


def _with(args, nums, some):
    """The arguments with others in some places."""
    found = list(args)
    for num, value in zip(nums, some, strict=True):
        found[num] = value
    return found


def _numbers(starts, name, shape):
    """The next numbers of a kind, one for each place."""
    found = starts[name] + np.arange(prod(shape)).reshape(shape)
    starts[name] += found.size
    return found
