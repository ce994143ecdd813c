"""Transport on ranks: the step of one process, on blocks that are widened by the cells that it reads.

    u' = C s(H u, H v, dt, inflow),     H: widen the blocks,     s: the step, unchanged,     C: keep the own block.

C^T puts zeros around a block. H^T sends the entries beyond a block back to the ranks that hold them, and adds them
there. A number goes to all ranks as it is; its cotangent is the sum over them. These maps are rules, and so is s:
derivatives of every order follow. A step is one node of the tape, which sees fields on ranks alone, the same on every
rank. Where a block ends at another one the widened grid has a wall that does not exist; C drops the cells that it
influences.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from math import floor, isfinite, prod
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_cdt

from sparsedp.advection.arguments import check_array, check_numbers, check_stability, check_step
from sparsedp.advection.settings import TransportSettings, wall_space
from sparsedp.advection.transport import Transport
from sparsedp.autodiff.tape import Rule, isbox, linear, plain
from sparsedp.errors import NonFiniteError, UnstableStepError
from sparsedp.grid.boundary_conditions import neumann
from sparsedp.grid.grid import Grid
from sparsedp.grid.space import Space, components
from sparsedp.kernels.fluxes import SCHEMES
from sparsedp.parallel.agreement import Agreement
from sparsedp.parallel.exchange import Exchange, exchange_of_boxes
from sparsedp.parallel.fields import DistributedField, block
from sparsedp.parallel.partition import Box, partition_of

__all__ = ["TransportOnBlocks"]

ROUNDING = 1e-9  # relative difference between the displacement here and the one that the step computes


class TransportOnBlocks:
    """``move(u, v, dt, inflow)`` on fields on ranks, or arrays that every rank holds; built by `Layout`."""

    def __init__(self, settings: TransportSettings) -> None:
        self.settings = settings
        self.layout = partition_of(settings.space)
        self.walls = wall_space(settings)
        self.speed = remembering_last(self._speed)
        self.block_step = cache(partial(BlockStep, settings))
        self.solid_depth = 0  # cells from the fluid to the deepest solid cell
        if settings.solid is not None and settings.of == "cells":
            self.solid_depth = int(np.max(distance_transform_cdt(settings.solid, "taxicab"), initial=0))

    def __call__(self, u: Any, v: Any, dt: Any, inflow: Any) -> Any:
        """Return the field after a step."""
        settings = self.settings
        name = f"transport {settings.scheme}"
        plain_arguments = tuple(map(plain, (u, v, dt, inflow)))
        _, plain_v, plain_dt, plain_inflow = plain_arguments
        inflow_shape: tuple[int, ...] = ()
        if np.shape(plain_inflow):
            inflow_shape = self.walls.shape
        check_step(name, plain_dt)
        check_array(name, "u", plain_arguments[0], (settings.space.shape,))
        check_array(name, "v", plain_v, settings.velocity_shapes)
        check_array(name, "inflow", plain_inflow, (inflow_shape,))
        width = self._width(plain_v, plain_dt)
        step = partial(self.block_step, width, np.shape(plain_v), inflow_shape)
        try:
            return step(settings.unstable).rule(u, v, dt, inflow)
        except (NonFiniteError, UnstableStepError):
            self._check(step("allow"), *plain_arguments)
            return step("allow").rule(u, v, dt, inflow)  # only cells beyond the blocks are concerned

    def _width(self, v, dt):
        """Return the number of cells beyond a block that a step may read: the same on all ranks."""
        settings = self.settings
        if settings.scheme in SCHEMES:
            scheme = SCHEMES[settings.scheme]
            cells = len(scheme.stages) * (1 + (scheme.limiter is not None))
            if settings.of == "faces" and settings.solid is not None:
                cells += 1  # these cells determine whether a face is closed
            return cells
        displacement = self.speed(v) * dt * (1 + ROUNDING)
        cells = 1 + (settings.interpolation == "cubic") + (settings.backtrace == "midpoint")
        if isfinite(displacement):  # otherwise the step itself raises an error
            cells += floor(displacement)
        cells += min(self.solid_depth, cells * settings.grid.dim)  # solids are filled from the fluid, layer by layer
        if settings.scheme == "maccormack":
            cells *= 2
        return _rounded_up(cells)

    def _speed(self, v):
        """Return the largest velocity, in widths of the narrowest cell."""
        space = velocity_space(self.settings, np.shape(v))
        parts = components(np.abs(block(v, space).flat), self.layout.shapes(space.parts))
        narrowest = [np.min(h, initial=np.inf) for h in self.settings.grid.widths]
        speeds = [np.max(part, initial=0.0) / h for part, h in zip(parts, narrowest, strict=True)]
        return float(self.layout.max(speeds).max())

    def _check(self, block_step, u, v, dt, inflow):
        """Raise the error of one process for a step that is not finite, or too large in some block."""
        settings = self.settings
        method = block_step.move.method
        values: Any = (block(u, settings.space), block(v, block_step.velocity), block(inflow, self.walls))
        check_numbers(settings, *values)
        if settings.scheme in SCHEMES:
            widen_velocity = block_step.inputs[1].widen
            wide_v = widen_velocity.forward(v).reshape(-1)
            rate = self.layout.agreement.run("transport", method.reference.rate, wide_v)
            check_stability(settings, dt, block_step.crop.forward(rate), method.scheme.max_courant)


def _rounded_up(cells):
    """Return the next power of two, or three quarters of it: a few widths serve all velocities."""
    power = 1 << (cells - 1).bit_length()
    three_quarters = power - power // 4
    if cells <= three_quarters:
        return three_quarters
    return power


def velocity_space(settings: TransportSettings, shape: tuple[int, ...]) -> Space:
    """Return the space of a velocity of this shape."""
    grid = settings.grid
    if settings.velocity == "faces":
        return grid.faces
    return Space(shape, "cells", grid, (grid.shape,) * grid.dim)


class RulePair(NamedTuple):
    """A linear map from values on ranks to their widened blocks, and its transpose, as rules."""

    widen: Rule
    collect: Rule


class BlockStep:
    """The step on blocks that are widened by some cells, for velocities and inflow values of given shapes.

    Parameters
    ----------
    settings : TransportSettings
    width : int
    velocity_shape, inflow_shape : tuples of int
    unstable : "raise" or "allow"

    Attributes
    ----------
    move : Transport
        The step on the widened block.
    velocity : Space
    inputs : list of RulePair
        For u, v, dt and inflow.
    crop, embed : Rule
        From a widened block to the own one, and the transpose.
    rule : Rule
        The step of fields on ranks.
    """

    def __init__(
        self,
        settings: TransportSettings,
        width: int,
        velocity_shape: tuple[int, ...],
        inflow_shape: tuple[int, ...],
        unstable: str,
    ) -> None:
        grid = settings.grid
        layout = partition_of(settings.space)
        spans, sides = _widened_box(settings, layout.box(grid.shape), width)
        index = [np.arange(*span) % max(n, 1) for span, n in zip(spans, grid.shape, strict=True)]
        widths = [h[i] for h, i in zip(grid.widths, index, strict=True)]
        local_grid = Grid([i.size for i in index], spacing=widths, periodic=[side is None for side in sides])
        solid = None
        if settings.solid is not None:
            solid = settings.solid[np.ix_(*index)]
        local = replace(settings, grid=local_grid, sides=sides, solid=solid, unstable=unstable)
        self.move = layout.agreement.run("transport", Transport, local)
        self.velocity = velocity_space(settings, velocity_shape)

        def boxes_of(wide_space):
            return [[(a, a + n) for (a, _), n in zip(spans, part, strict=True)] for part in wide_space.parts]

        field_exchange = exchange_of_boxes(layout, settings.space.parts, boxes_of(local.space))
        wide_velocity = velocity_space(local, velocity_shape[: -grid.dim] + local_grid.shape)
        number = RulePair(*linear("number", _unchanged, layout.sum))
        field = _widening(settings.space, field_exchange, local.space.shape)
        velocity_exchange = exchange_of_boxes(layout, self.velocity.parts, boxes_of(wide_velocity))
        velocity = _widening(self.velocity, velocity_exchange, wide_velocity.shape)
        inflow = number
        if inflow_shape:
            inflow = _inflow(settings, self.move, spans)
        self.inputs = [field, velocity, number, inflow]

        def crop(x):
            return DistributedField(field_exchange.taken(x.reshape(-1)), settings.space)

        def embed(g):
            return field_exchange.placed(block(g, settings.space).flat).reshape(local.space.shape)

        self.crop, self.embed = linear("block", crop, embed)
        self.rule = rule_on_blocks(layout.agreement, self.move._rule, self.inputs, self.crop, self.embed)


def _unchanged(x):
    return x


def _widened_box(settings, box, width):
    """Return the spans of a box that is widened by some cells, and the conditions of its sides."""
    spans = []
    sides: list[tuple | None] = []
    for (a, b), n, pair in zip(box, settings.grid.shape, settings.sides, strict=True):
        low = a - width
        high = b + width
        if pair is not None:
            spans.append((max(low, 0), min(high, n)))
            lower = pair[0] if low <= 0 else neumann
            upper = pair[1] if high >= n else neumann
            sides.append((lower, upper))
        elif high - low >= n:  # a whole period
            spans.append((0, n))
            sides.append(None)
        else:
            spans.append((low, high))
            sides.append((neumann, neumann))
    return spans, tuple(sides)


def _inflow(settings, move, spans):
    """Return the rules of inflow values: walls of the widened grid get the values given for them, or zeros."""
    boxes: list[Box] = []
    places = [np.zeros(0, int)]
    wall_indices = iter(components(np.arange(move.walls.size), move.walls.parts))
    for part in move.space.parts:
        for axis, (pair, local_pair) in enumerate(zip(settings.sides, move.settings.sides, strict=True)):
            if not local_pair:
                continue
            for end in (0, settings.grid.shape[axis]):
                place = next(wall_indices)
                if not pair:
                    continue
                is_wall = end in spans[axis]
                box = [(a, a + n) for (a, _), n in zip(spans, part, strict=True)]
                boxes.append([*box[:axis], (0, int(is_wall)), *box[axis + 1 :]])
                if is_wall:
                    places.append(place.reshape(-1))
    walls = wall_space(settings)
    exchange = exchange_of_boxes(partition_of(walls), walls.parts, boxes)
    return _widening(walls, exchange, move.walls.shape, np.concatenate(places))


# ---- between fields on ranks and widened blocks ----


def _widening(space: Space, exchange: Exchange, shape: tuple[int, ...], places: NDArray | None = None) -> RulePair:
    """Return the rules from the blocks of a field to arrays of a shape, and back.

    Parameters
    ----------
    space : Space
        Of the field.
    exchange : Exchange
    shape : tuple of int
    places : int array, optional
        Where the numbers that are read go in the flat array; zeros elsewhere. Default: they are the array.
    """

    def widen(x):
        flat = block(x, space).flat
        if flat.dtype.kind != "f":
            flat = flat.astype(float)
        wide = exchange.forward(flat)
        if places is not None:
            read = wide
            wide = np.zeros(prod(shape), read.dtype)
            wide[places] = read
        wide.flags.writeable = False
        return wide.reshape(shape)

    def collect(g):
        wide = np.ascontiguousarray(g, dtype=float).reshape(-1)
        if places is not None:
            wide = wide[places]
        return DistributedField(exchange.backward(wide), space)

    return RulePair(*linear("widened", remembering_last(widen), collect))


def remembering_last(act: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a function of a field that reuses its last result: many steps have the same velocity."""
    last_argument: Any = None
    last_result: Any = None

    def remembered(x):
        nonlocal last_argument, last_result
        if last_argument is not x or not isinstance(x, DistributedField):  # other values can be written to
            last_result = act(x)
            last_argument = x
        return last_result

    return remembered


def rule_on_blocks(agreement: Agreement, local: Rule, inputs: Sequence[RulePair], crop: Rule, embed: Rule) -> Rule:
    """Return the Rule of fields on ranks, from the Rule on blocks; its derivatives consist of rules, to any order.

    Parameters
    ----------
    agreement : Agreement
    local : Rule
    inputs : sequence of RulePair
        One for each argument.
    crop, embed : Rule
        From the result on a widened block to the field, and the transpose.
    """
    local_rule: Any = local

    def run(rule, x):
        if isbox(x):
            return rule(x)
        return rule.forward(x)

    def widened(numbers, values):
        return [run(inputs[number].widen, value) for number, value in zip(numbers, values, strict=True)]

    def forward(*args):
        wide_args = widened(range(len(inputs)), args)
        return crop.forward(agreement.run(local.name, local.forward, *wide_args, at_once=True))

    def vjp(nums, ans, *args):
        def pull(g):
            wide_args = widened(range(len(inputs)), args)
            wide_g = run(embed, g)

            def pull_wide():
                return local_rule.vjp(nums, None, *wide_args)(wide_g)

            cotangents = agreement.run(local.name, pull_wide)
            return [run(inputs[num].collect, cotangent) for num, cotangent in zip(nums, cotangents, strict=True)]

        return pull

    def jvp(nums, tangents, ans, *args):
        wide_args = widened(range(len(inputs)), args)
        wide_tangents = widened(nums, tangents)
        tangent = agreement.run(local.name, local_rule.jvp, nums, wide_tangents, wide_args[0], *wide_args)
        return run(crop, tangent)

    return Rule(local.name, forward, vjp, jvp)
