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

from sparsedp.advection.lattice import lattices, opened, spread, take
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
    def between(self):
        """From the velocity as given to that on sides (or points) and its transpose; None where they are the same."""
        found = interpolation(self.setting)
        return None if found is None else (found, sp.csr_array(found.T))

    @cached_property
    def tables(self):
        """For the points of all axes of all components, one after the other: a dict of arrays, see `_table`."""
        found, starts = [], {"point": 0, "wall": self.setting.space.size, "speed": 0, "row": 0}
        for lattice in lattices(self.setting):
            own = starts["point"] + np.arange(prod(lattice.shape)).reshape(lattice.shape)
            found += [self._table(lattice, number, own, starts) for number in range(len(lattice.axes))]
            starts["point"] += own.size
        return {name: np.concatenate([table[name].ravel() for table in found]) for name in found[0]}

    def _table(self, lattice, number, own, starts):
        """Of one axis: columns of the field and inflow, of slopes and of the velocity; lengths; what is open."""
        axis, shape = lattice.axes[number], lattice.shape
        index = spread(np.arange(axis.points), number, shape)
        stride, walls = prod(shape[number + 1 :]), own.size // axis.points
        row, count = starts["row"] + np.arange(own.size).reshape(shape), own.size if self.points else walls * axis.sides
        block, rest = np.divmod(row - starts["row"], axis.points * stride)
        free, found = opened(lattice, number), {"own": own}
        for side, name in enumerate(("lower", "upper")):
            end = index == side * (axis.points - 1)
            beside = np.where(end, (1 - 2 * side) * (axis.points - 1), 2 * side - 1) * stride
            outside = end & (not axis.periodic)
            ghost = own if axis.closed[side] else starts["wall"] + side * walls + block * stride + rest % stride
            is_open = found[f"open {name}"] = take(free, axis, number, side)
            found[f"z {name}"] = np.where(is_open, np.where(outside, ghost, own + beside), own)
            found[f"slope {name}"] = np.where(outside | ~is_open, -1, row + beside)
            sides = (index + side) % axis.sides
            speeds = (
                row - starts["row"] if self.points else block * axis.sides * stride + sides * stride + rest % stride
            )
            found[f"w {name}"] = starts["speed"] + speeds
            line = axis.gaps if self.points and not self.limited else axis.widths
            lengths = take(line, axis, 0, side) if line is axis.gaps else line
            found[f"weight {name}"] = is_open / spread(lengths, number, shape)
            halved = axis.gaps * np.where(
                np.isin(np.arange(axis.sides), (0, axis.points)) & (not axis.periodic), 0.5, 1
            )
            found[f"distance {name}"] = spread(2 * take(halved, axis, 0, side) / axis.widths, number, shape)
        starts["row"] += own.size
        starts["speed"] += count
        starts["wall"] += 0 if axis.periodic else 2 * walls
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
            found[f"speed {side}"] = speeds if self.between is None else sp.csr_array(speeds @ self.between[0])
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
