"""Transport on ranks: the step of one process, on blocks that are widened by what it reads.

    u' = C s(H u, H v, dt, inflow),     H: widen the blocks,     s: the step, unchanged,     C: keep the own block.

C^T puts zeros around a block. H^T sends what stands beyond it back to whom it belongs, where it is added. A number goes
to all ranks as it is, and what comes back is the sum over them. These maps are rules, and so is s: derivatives of every
order follow. A step is one node of the tape, which sees fields on ranks alone, the same on every rank. Where a block
ends at another one the widened grid has a wall that is not there; what that changes C leaves out.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from math import floor, isfinite, prod
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_cdt

from sparsedp.advection.arguments import check_array, check_numbers, check_stability, check_step
from sparsedp.advection.settings import wall_space
from sparsedp.advection.transport import Transport
from sparsedp.autodiff.tape import Rule, isbox, linear, plain
from sparsedp.errors import NonFiniteError, UnstableStepError
from sparsedp.grid.boundary_conditions import neumann
from sparsedp.grid.grid import Grid
from sparsedp.grid.space import Space, components
from sparsedp.kernels.fluxes import SCHEMES
from sparsedp.parallel.exchange import of_boxes
from sparsedp.parallel.fields import DistributedField, block

__all__ = ["Carry"]

ROUNDING = 1e-9  # relative, of a displacement: what it may be off the one that the step finds


class Carry:
    """``move(u, v, dt, inflow)`` on fields that lie on ranks, or that all of them know; made by `Layout`."""

    def __init__(self, setting: Any) -> None:
        self.setting, self.layout, self.walls = setting, setting.grid.backend, wall_space(setting)
        self.speed, self.block, self.depth = last(self._speed), cache(partial(Block, setting)), 0
        if setting.solid is not None and setting.of == "cells":
            self.depth = int(np.max(distance_transform_cdt(setting.solid, "taxicab"), initial=0))

    def __call__(self, u: Any, v: Any, dt: Any, inflow: Any) -> Any:
        """Return the field after a step."""
        setting, given, name = self.setting, tuple(map(plain, (u, v, dt, inflow))), f"transport {self.setting.scheme}"
        inflows = self.walls.shape if np.shape(given[3]) else ()
        check_step(name, given[2])
        check_array(name, "u", given[0], (setting.space.shape,))
        check_array(name, "v", given[1], setting.velocity_shapes)
        check_array(name, "inflow", given[3], (inflows,))
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
        """Return the largest velocity, in widths of the narrowest cell."""
        space = velocity_space(self.setting, np.shape(v))
        parts = components(np.abs(block(v, space).flat), self.layout.shapes(space.parts))
        narrowest = [np.min(h, initial=np.inf) for h in self.setting.grid.widths]
        return float(self.layout.max([np.max(part, initial=0.0) / h for part, h in zip(parts, narrowest)]).max())

    def _check(self, wide, u, v, dt, inflow):
        """Refuse, in the words of one process, a step that is not finite, or too large in some block."""
        setting, method = self.setting, wide.move.method
        check_numbers(setting, block(u, setting.space), block(v, wide.velocity), block(inflow, self.walls))
        if setting.scheme in SCHEMES:
            v = wide.ins[1][0].forward(v).reshape(-1)
            rate = self.layout.agreement.agreed("transport", method.reference.rate, v)
            check_stability(setting, dt, wide.crop[0].forward(rate), method.scheme.max_courant)


def velocity_space(setting: Any, shape: tuple) -> Any:
    """Where a velocity of this shape lives."""
    grid = setting.grid
    return grid.faces if setting.velocity == "faces" else Space(shape, "cells", grid, (grid.shape,) * grid.dim)


class Block:
    """The step on blocks that are widened by some cells, for velocities and inflow values of given shapes."""

    def __init__(self, setting: Any, width: Any, shape: tuple, inflows: Any, unstable: Any) -> None:
        grid, layout = setting.grid, setting.grid.backend
        spans, sides = [], []
        for (a, b), n, pair in zip(layout.box(grid.shape), grid.shape, setting.sides, strict=True):
            low, high = a - width, b + width
            if pair is None:
                whole = high - low >= n  # a period
                spans.append((0, n) if whole else (low, high))
                sides.append(None if whole else (neumann, neumann))
            else:
                spans.append((max(low, 0), min(high, n)))
                sides.append((pair[0] if low <= 0 else neumann, pair[1] if high >= n else neumann))
        index = [np.arange(*span) % max(n, 1) for span, n in zip(spans, grid.shape)]
        widths, around = [h[i] for h, i in zip(grid.widths, index)], [side is None for side in sides]
        local = Grid([i.size for i in index], spacing=widths, periodic=around)
        solid = None if setting.solid is None else setting.solid[np.ix_(*index)]
        here = replace(setting, grid=local, sides=tuple(sides), solid=solid, unstable=unstable)
        self.move, self.velocity = layout.agreement.agreed("transport", Transport, here), velocity_space(setting, shape)

        def wider(space, wide):
            return widened(space, [[(a, a + n) for (a, _), n in zip(spans, part)] for part in wide.parts], wide.shape)

        number = linear("number", lambda x: x, layout.sum)
        field, exchange = wider(setting.space, here.space)
        speed, _ = wider(self.velocity, velocity_space(here, shape[: -grid.dim] + local.shape))
        self.ins = [field, speed, number, _inflow(setting, self.move, spans) if inflows else number]
        self.crop = linear(
            "block",
            lambda x: DistributedField(exchange.taken(x.reshape(-1)), setting.space),
            lambda g: exchange.placed(block(g, setting.space).flat).reshape(here.space.shape),
        )
        self.rule = on_blocks(layout.agreement, self.move._rule, self.ins, self.crop)


def _inflow(setting, move, spans):
    """Return the rules of inflow values: walls of the widened grid get the given values, or zeros."""
    boxes, places = [], [np.zeros(0, int)]
    numbers = iter(components(np.arange(move.walls.size), move.walls.parts))
    for part in move.space.parts:
        for axis, (pair, local) in enumerate(zip(setting.sides, move.settings.sides)):
            for end in (0, setting.grid.shape[axis]) if local else ():
                place, there = next(numbers), pair is not None and end in spans[axis]
                if pair:
                    box = [(a, a + n) for (a, _), n in zip(spans, part)]
                    boxes.append([*box[:axis], (0, int(there)), *box[axis + 1 :]])
                    places.append(place.reshape(-1)[: place.size * there])
    return widened(wall_space(setting), boxes, move.walls.shape, np.concatenate(places))[0]


# ---- between fields and what a rank works on ----


def widened(space: Any, boxes: Any, shape: tuple, places: Any = None) -> Any:
    """Return the rules from the blocks of a field to boxes around them, at some places of an array of this shape.

    Those that lead there and back.
    """
    exchange = of_boxes(space.backend, space.parts, boxes)

    def wide(x):
        flat = block(x, space).flat
        read = exchange.forward(flat if flat.dtype.kind == "f" else flat.astype(float))
        if places is not None:
            read, inner = np.zeros(prod(shape), read.dtype), read
            read[places] = inner
        read.flags.writeable = False
        return read.reshape(shape)

    def back(g):
        read = np.ascontiguousarray(g, dtype=float).reshape(-1)
        return DistributedField(exchange.backward(read if places is None else read[places]), space)

    return linear("widened", last(wide), back), exchange


def last(act: Any) -> Any:
    """Return a function of a field that reuses its last result: many steps have the same velocity."""
    held = [None, None]

    def known(x):
        if held[0] is not x or not isinstance(x, DistributedField):  # others can be written to
            held[:] = x, act(x)
        return held[1]

    return known


def on_blocks(agreement: Any, local: Any, ins: Any, crop: Any) -> Any:
    """Return the Rule of fields on ranks, from the Rule on blocks; its derivatives consist of rules, to any order.

    Parameters
    ----------
    local : Rule
    ins : list of pairs of Rules
        What leads to each argument of it, and back; linear.
    crop : pair of Rules
        What leads from its result, and back.
    """

    def run(rule, x):
        return rule(x) if isbox(x) else rule.forward(x)

    def wide(numbers, values):
        return [run(ins[num][0], value) for num, value in zip(numbers, values, strict=True)]

    def forward(*args):
        given = wide(range(len(ins)), args)
        return crop[0].forward(agreement.agreed(local.name, local.forward, *given, at_once=True))

    def vjp(nums, ans, *args):
        def pull(g):
            given, g = wide(range(len(ins)), args), run(crop[1], g)
            backs = agreement.agreed(local.name, lambda: local.vjp(nums, None, *given)(g))
            return [run(ins[num][1], back) for num, back in zip(nums, backs, strict=True)]

        return pull

    def jvp(nums, tangents, ans, *args):
        given = wide(range(len(ins)), args)
        tangent = agreement.agreed(local.name, local.jvp, nums, wide(nums, tangents), given[0], *given)
        return run(crop[0], tangent)

    return Rule(local.name, forward, vjp, jvp)
