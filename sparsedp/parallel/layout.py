"""Layout: what the core asks of a grid whose fields lie on ranks. It calls the methods, and imports nothing here."""

from functools import reduce
from itertools import accumulate
from math import prod
from weakref import WeakKeyDictionary

import numpy as np

from sparsedp.errors import ShapeError
from sparsedp.fields import field_array
from sparsedp.parallel.cut import OnBlocks, localized
from sparsedp.parallel.exchange import hold
from sparsedp.parallel.fields import DistributedField, block, everywhere
from sparsedp.parallel.partition import Partition
from sparsedp.parallel.solve import RanksSystem
from sparsedp.parallel.transport import Carry
from sparsedp.structure.base import result_dtype
from sparsedp.tape import Rule, linear, plain

__all__ = ["Layout"]

# What asks by `check_grid` or `check_operator`, and is known to be right on ranks; all others are refused by name.
RIGHT = {
    "component", "curl", "distribute", "divergence", "flow_step", "flux", "harmonic_average", "interior", "inverse",
    "laplacian", "projection", "prolong", "restrict", "sample", "sponge", "transport", "upwind",
}  # fmt: skip


ENTRIES = 1000  # of an array that meets a field, so many are compared between ranks: it takes 5 us


class Layout(Partition):
    """The partition of a grid, and how operators and fields use it."""

    def __init__(self, shape, periodic, comm):
        super().__init__(shape, periodic, comm)
        hold(comm)
        self._cuts: WeakKeyDictionary = WeakKeyDictionary()  # structure of whole fields -> that of blocks

    def __repr__(self):
        return f"on {self.comm.size} ranks"

    def check(self, name):
        """Refuse what is not known to be right on ranks."""
        if name not in RIGHT:
            raise TypeError(f"{name} does not work on ranks yet; give it the grid from before dp.distribute")

    def laid(self, grid):
        """Another grid on the same ranks."""
        return laid(grid, type(self)(grid.shape, grid.periodic, self.comm))

    # ------------------------------------------------------------ operators

    def applied(self, op, u, out=None):
        """Operator, field on ranks or known to all -> the result, on ranks where its space is."""
        if out is not None:
            raise TypeError(f"{op.name} takes no out on ranks; leave it away")
        return self.agreement.agreed(op.name, self._applied, op, u)

    def _applied(self, op, u):
        x, side = self._given(op, u), _side(op.codomain)
        act = self._cuts.get(op.structure) or localized(op.structure, _side(op.domain), side)
        if not isinstance(act, OnBlocks):  # which holds what it is made of, and would keep it for ever
            self._cuts[op.structure] = act
        y = np.empty(act.shape[0], result_dtype(op.structure, x.dtype))
        act.apply(x, y)
        return DistributedField(y, op.codomain) if side else y.reshape(op.codomain.shape)

    def _given(self, op, u):
        if isinstance(u, DistributedField):
            if _side(op.domain) != _side(u.space):
                raise ShapeError(f"{op.name} takes a field on {op.domain.described}, got one on {u.space.described}")
            return u.flat if u.dtype.kind in "fc" else u.flat.astype(float)
        u = field_array(op, u)
        return block(u, op.domain).flat if op.domain.layout else u.reshape(-1)

    def system(self, op, rtol, maxiter, method="auto", options=None):
        """The system of an operator on ranks, for `inverse`."""
        if _side(op.domain) != _side(op.codomain):
            raise TypeError(f"inverse of {op.name} does not work on ranks; both sides must lie there in the same way")
        if method != "auto" or options:
            raise TypeError(f"inverse takes no method and no options on ranks, got {method!r}; leave them away")
        if op.dtype.kind == "c":
            raise TypeError(f"inverse takes real operators on ranks, {op.name} is complex; solve it on one process")
        return RanksSystem(op, rtol, maxiter)

    def transport(self, setting):
        """The setting of a transport -> its step, called with (u, v, dt, inflow)."""
        return Carry(setting)

    def minimize(self, *given):
        """`minimize` of unknowns on ranks."""
        from sparsedp.parallel.search import minimized

        return minimized(self.comm, *given)

    # ------------------------------------------------------------ fields

    def tell(self, value):
        """Note a number or an array, or a part of its entries, that meets a field: it must be the same on all ranks."""
        value, what = np.asarray(value), "a number"
        if value.ndim:
            most, what = round(ENTRIES ** (1 / value.ndim)), f"an array of shape {value.shape}"
            value = value[tuple(slice(None, None, n // most + 1) for n in value.shape)]
        self.agreement.tell(f"{what} beside a field on ranks", value.tobytes())

    def holds(self, *values):
        """Whether one of some values, traced or not, lies on ranks."""
        return any(isinstance(plain(value), DistributedField) for value in values)

    def volumes(self, space):
        """Control volumes, as a field."""
        lines = [
            self._beside(part, space.grid.control_lengths(space.kind, axis)) for axis, part in enumerate(space.parts)
        ]
        return DistributedField(np.concatenate([reduce(np.multiply.outer, some).reshape(-1) for some in lines]), space)

    def mesh(self, space, lines):
        """Coordinates along each axis -> for each axis a field of them."""
        lines = self._beside(space.shape, lines)
        return tuple(DistributedField(np.array(full).reshape(-1), space) for full in np.meshgrid(*lines, indexing="ij"))

    def _beside(self, part, lines):
        """Arrays along the axes -> what lies beside the block of this rank."""
        return [line[start:stop] for line, (start, stop) in zip(lines, self.box(part))]

    def split(self, space, v):
        """Field -> its components, each a field on ranks; differentiable."""
        if len(space.parts) == 1:
            return (v,)
        ends = [0, *accumulate(map(prod, self.shapes(space.parts)))]

        def component(axis, own):
            def put(g):
                flat = np.zeros(ends[-1], g.dtype)
                flat[ends[axis] : ends[axis + 1]] = g.flat
                return DistributedField(flat, space)

            return linear(
                f"component of {space.kind}",
                lambda v: DistributedField(v.flat[ends[axis] : ends[axis + 1]].copy(), own),
                put,
            )[0]

        return tuple(component(axis, own)(v) for axis, own in enumerate(_components(space)))

    def join(self, space, parts):
        """Components, on ranks or known to all -> one field; differentiable."""
        own = _components(space)
        parts = [everywhere(part, one) for part, one in zip(parts, own)]

        def joined(*parts):
            return DistributedField(np.concatenate([part.flat for part in parts]), space)

        def vjp(nums, ans, *parts):
            return lambda g: tuple(self.split(space, g)[num] for num in nums)

        def jvp(nums, tangents, ans, *parts):
            moved = dict(zip(nums, tangents))
            return rule(*(everywhere(moved.get(num, 0.0), one) for num, one in enumerate(own)))

        rule = Rule("join", joined, vjp, jvp)
        return rule(*parts)


def laid(grid, layout):
    """Grid -> the same with its fields on ranks."""
    made = object.__new__(type(grid))
    vars(made).update(grid.__getstate__(), layout=layout)
    return made


def _components(space):
    """The space of each component of a field."""
    return [space.component(axis) for axis in range(len(space.parts))]


def _side(space):
    """Where fields on a space lie: (layout, components), or None where every rank has all of it."""
    return (space.layout, space.parts) if space.layout else None
