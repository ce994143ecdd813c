"""Transport on ranks: the step of one process, on blocks that are widened by what it reads.

    u' = C s(H u, H v, dt, inflow),     H: widen the blocks,     s: the step, unchanged,     C: keep the own block.

C^T puts zeros around a block. H^T sends what stands beyond it back to whom it belongs, where it is added. A number goes
to all ranks as it is, and what comes back is the sum over them. So every derivative of a step, of whatever order, is
one of s between these maps: the tape of a program sees fields on ranks alone, the same on every rank. Where a
block ends at another one the widened grid has a wall that is not there; what that changes C leaves out.
"""

from functools import cache, partial
from math import floor, isfinite
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_cdt

from sparsedp.advection.front import Transport
from sparsedp.advection.law import wall_space
from sparsedp.advection.stability import check_numbers, check_weights
from sparsedp.advection.values import check_given, check_step
from sparsedp.boundary_conditions import neumann
from sparsedp.derivative import forward, linearised, zero_like
from sparsedp.errors import NonFiniteError, UnstableStepError
from sparsedp.grid import Grid
from sparsedp.kernels.fluxes import SCHEMES
from sparsedp.parallel.exchange import of_boxes
from sparsedp.parallel.fields import DistributedField, block
from sparsedp.space import Space, components
from sparsedp.tape import Rule, isbox, plain

__all__ = ["Carry"]

ROUNDING = 1e-9  # relative, of a displacement: what it may be off the one that the step finds


class Carry:
    """``move(u, v, dt, inflow)`` on fields that lie on ranks, or that all of them know; made by `Layout`."""

    def __init__(self, setting):
        self.setting, self.layout, self.walls = setting, setting.grid.layout, wall_space(setting)
        self.speed, self.block, self.depth = last(self._speed), cache(partial(Block, setting)), 0
        if setting.solid is not None and setting.of == "cells":
            self.depth = int(np.max(distance_transform_cdt(setting.solid, "taxicab"), initial=0))

    def __call__(self, u, v, dt, inflow):
        setting, given, name = self.setting, tuple(map(plain, (u, v, dt, inflow))), f"transport {self.setting.scheme}"
        inflows = self.walls.shape if np.shape(given[3]) else ()
        check_step(name, given[2])
        check_given(name, "u", given[0], (setting.space.shape,))
        check_given(name, "v", given[1], setting.velocity_shapes)
        check_given(name, "inflow", given[3], (inflows,))
        made = partial(self.block, self._width(*given[1:3]), np.shape(given[1]), inflows)
        try:
            return made(setting.unstable).rule(u, v, dt, inflow)
        except (NonFiniteError, UnstableStepError):
            self._check(made("allow"), *given)
            return made("allow").rule(u, v, dt, inflow)  # what is wrong is beyond the blocks alone

    def _width(self, v, dt):
        """Cells beyond a block that a step may read: the same on all ranks."""
        setting = self.setting
        if setting.scheme in SCHEMES:
            scheme, of_faces = SCHEMES[setting.scheme], setting.of == "faces"
            cells = len(scheme.stages) * (1 + (scheme.limiter is not None))
            return cells + (of_faces and setting.solid is not None)  # the cells that tell whether a face is closed
        far = self.speed(v) * dt * (1 + ROUNDING)
        cells = floor(far) if isfinite(far) else 0  # the step itself refuses what is not finite
        cells += 1 + (setting.interpolation == "cubic") + (setting.backtrace == "midpoint")
        cells += min(self.depth, cells * setting.grid.dim)  # solids are filled from the fluid, layer by layer
        cells *= 1 + (setting.scheme == "maccormack")
        most = 1 << (cells - 1).bit_length()  # few widths serve all velocities
        return most - most // 4 if cells <= most - most // 4 else most

    def _speed(self, v):
        """The largest velocity, in widths of the narrowest cell."""
        space = velocity_space(self.setting, np.shape(v))
        parts = components(np.abs(block(v, space).flat), self.layout.shapes(space.parts))
        narrowest = [np.min(h, initial=np.inf) for h in self.setting.grid.widths]
        return float(self.layout.max([np.max(part, initial=0.0) / h for part, h in zip(parts, narrowest)]).max())

    def _check(self, wide, u, v, dt, inflow):
        """Refuse, in the words of one process, a step that is not finite, or too large in some block."""
        setting, law = self.setting, wide.move.law
        check_numbers(setting, block(u, setting.space), block(v, wide.velocity), block(inflow, self.walls))
        if setting.scheme in SCHEMES:
            rate = self.layout.agreement.agreed("transport", law.reference.rate, wide.ins[1].into(v).reshape(-1))
            check_weights(setting, dt, wide.outs.out(rate), law.scheme.most)


def velocity_space(setting, shape):
    """Where a velocity of this shape lives."""
    grid = setting.grid
    return grid.faces if setting.velocity == "faces" else Space(shape, "cells", grid, (grid.shape,) * grid.dim)


class Block:
    """The step on blocks that are so many cells wider, for velocities and inflow values of these shapes."""

    def __init__(self, setting, width, shape, inflows, unstable):
        grid, layout = setting.grid, setting.grid.layout
        spans, around, sides = [], [], []
        for (a, b), n, pair in zip(layout.box(grid.shape), grid.shape, setting.sides, strict=True):
            whole = pair is None and b - a + 2 * width >= n  # a whole period
            span = (a - width, b + width) if pair is None else (max(a - width, 0), min(b + width, n))
            spans.append((0, n) if whole else span)
            around.append(whole)
            ends = zip(pair or (neumann, neumann), (span[0] == 0, span[1] == n))
            sides.append(None if whole else tuple(condition if at else neumann for condition, at in ends))
        index = [np.arange(*span) % max(n, 1) for span, n in zip(spans, grid.shape)]
        local = Grid([i.size for i in index], spacing=[h[i] for h, i in zip(grid.widths, index)], periodic=around)
        solid = None if setting.solid is None else setting.solid[np.ix_(*index)]
        here = setting._replace(grid=local, sides=tuple(sides), solid=solid, unstable=unstable)
        self.move, self.velocity = layout.agreement.agreed("transport", Transport, here), velocity_space(setting, shape)

        def way(space, wide):
            return widened(space, [[(a, a + n) for (a, _), n in zip(spans, part)] for part in wide.parts], wide.shape)

        number = Way(lambda x: x, layout.sum)
        carried, exchange = way(setting.space, here.space)
        speed, _ = way(self.velocity, velocity_space(here, shape[: -grid.dim] + local.shape))
        self.ins = [carried, speed, number, _inflow(setting, self.move, spans) if inflows else number]
        self.outs = Way(
            lambda g: exchange.placed(block(g, setting.space).flat).reshape(here.space.shape),
            lambda x: DistributedField(exchange.taken(x.reshape(-1)), setting.space),
        )
        self.rule = on_blocks(layout, self.move._rule, self.ins, self.outs)


def _inflow(setting, move, spans):
    """The Way of inflow values: a wall of the widened grid gets what is given there, zeros where there is none."""
    boxes, places = [], [np.zeros(0, int)]
    numbers = iter(components(np.arange(move.walls.size), move.walls.parts))
    for part in move.space.parts:
        for axis, (pair, local) in enumerate(zip(setting.sides, move.setting.sides)):
            for end in (0, setting.grid.shape[axis]) if local else ():
                place, there = next(numbers), pair is not None and end in spans[axis]
                if pair:
                    box = [(a, a + n) for (a, _), n in zip(spans, part)]
                    boxes.append([*box[:axis], (0, int(there)), *box[axis + 1 :]])
                    places.append(place.reshape(-1)[: place.size * there])
    return widened(wall_space(setting), boxes, move.walls.shape, np.concatenate(places))[0]


# ---- between fields and what a rank works on ----


class Way(NamedTuple):
    """A linear map from what the user has to what a rank works on, and its transpose, which leads back."""

    into: Any
    out: Any


def widened(space, boxes, shape, places=None):
    """(Way, Exchange) from the blocks of a field to boxes around them, at some places of an array of this shape."""
    exchange = of_boxes(space.layout, space.parts, boxes)

    def into(x):
        flat = block(x, space).flat
        wide = exchange.forward(flat if flat.dtype.kind == "f" else flat.astype(float))
        if places is not None:
            read, wide = wide, np.zeros(shape, wide.dtype)
            wide[places] = read
        wide.flags.writeable = False
        return wide.reshape(shape)

    def out(g):
        read = np.ascontiguousarray(g, dtype=float).reshape(-1)
        return DistributedField(exchange.backward(read if places is None else read[places]), space)

    return Way(last(into), out), exchange


def last(act):
    """A function of a field -> the same, which still knows what it gave last: a velocity often stays for many steps."""
    held = [None, None]

    def known(x):
        if held[0] is not x or not isinstance(x, DistributedField):  # others can be written to
            held[:] = x, act(x)
        return held[1]

    return known


# ---- derivatives ----


def on_blocks(layout, act, ins, outs):
    """A Rule, or a function, of what a rank works on -> the Rule of what the user has.

    Parameters
    ----------
    act : callable
        Of as many arguments as `ins`.
    ins : list of Way
    outs : Way, or list of Way where `act` gives a list
    """
    many = isinstance(outs, list)

    def run(*args):
        wide = [way.into(arg) for way, arg in zip(ins, args, strict=True)]
        found = layout.agreement.agreed("transport", getattr(act, "forward", act), *wide)
        return tuple(way.out(x) for way, x in zip(outs, found)) if many else outs.out(found)

    def vjp(nums, ans, *args):
        ways = outs if many else [outs]
        rule = on_blocks(layout, partial(_back, act, nums, len(ways)), [*ways, *ins], [ins[num] for num in nums])

        def pull(g):
            both = *((g[k] for k in range(len(ways))) if many else [g]), *args
            backs = rule(*both) if any(map(isbox, both)) else rule.forward(*both)
            return [backs[k] for k in range(len(nums))]

        return pull

    def jvp(nums, tangents, ans, *args):
        rule = on_blocks(layout, partial(_ahead, act, nums), [*(ins[num] for num in nums), *ins], outs)
        return rule(*tangents, *args)

    return Rule(getattr(act, "name", "a derivative of transport"), run, vjp, jvp)


def _back(act, nums, count, *both):
    """Cotangents of the results of a function, so many, and its arguments -> cotangents of the arguments `nums`."""
    g, args = both[:count], both[count:]
    if isinstance(act, Rule):
        return act.vjp(nums, None, *args)(*g)
    backs = linearised(lambda args: act(*args), args, [num in nums for num in range(len(args))])[2](g)
    return [zero_like(args[num]) if backs[num] is None else backs[num] for num in nums]


def _ahead(act, nums, *both):
    """Tangents of the arguments `nums` of a function, and its arguments -> the tangent of its result."""
    tangents, args = both[: len(nums)], both[len(nums) :]
    if isinstance(act, Rule):
        return act.jvp(nums, tangents, args[0], *args)
    along = dict(zip(nums, tangents, strict=True))
    return forward(lambda args: act(*args), args, [along.get(num) for num in range(len(args))])[1]
