"""Layout: the backend of grids whose fields are stored in blocks on the ranks of MPI; see autodiff/backend.py."""

from __future__ import annotations

from functools import cache, cached_property, reduce
from operator import add
from typing import Any

import numpy as np

from sparsedp._utils.validation import field_array
from sparsedp.advection.method import TransportMethod
from sparsedp.advection.transport import method_and_rule
from sparsedp.autodiff.backend import Backend, is_distributed
from sparsedp.autodiff.tape import linear
from sparsedp.errors import ShapeError
from sparsedp.grid.grid import node_axes
from sparsedp.grid.space import Space
from sparsedp.operators.given import from_matrix
from sparsedp.optimize.minimize import minimize
from sparsedp.parallel.cut import localized
from sparsedp.parallel.exchange import hold
from sparsedp.parallel.fields import DistributedField, block, everywhere
from sparsedp.parallel.partition import Partition
from sparsedp.parallel.solve import RanksSystem
from sparsedp.parallel.stencil import stencil_of
from sparsedp.parallel.transport import Carry
from sparsedp.solvers.choose_method import Choice
from sparsedp.solvers.inverse import system_and_choice
from sparsedp.solvers.jacobian import jacobian_on_unknowns
from sparsedp.solvers.newton import space_of_unknowns
from sparsedp.solvers.system import System

__all__ = ["Layout"]

# The functions that call `check_grid` or `check_operator` and work on ranks; all others raise TypeError.
RIGHT = {
    "component",
    "curl",
    "distribute",
    "divergence",
    "flow_step",
    "flux",
    "harmonic_average",
    "interior",
    "inverse",
    "laplacian",
    "projection",
    "prolong",
    "restrict",
    "sample",
    "sponge",
    "transport",
    "upwind",
}


ENTRIES = 1000  # of an array beside a field that are compared between ranks, in 5 us


class Layout(Partition, Backend):
    """The partition of a grid, and how operators and fields use it."""

    whole_fields = False

    def __init__(self, shape: tuple, periodic: Any, comm: Any) -> None:
        super().__init__(shape, periodic, comm)
        hold(comm)
        self._pieces = cache(_pieces)

    def __str__(self):
        return f"on {self.comm.size} ranks"

    __repr__ = __str__

    def check(self, name: str) -> None:
        """Raise TypeError if a function does not work on ranks."""
        if name not in RIGHT:
            raise TypeError(f"{name} does not work on ranks yet; give it the grid from before dp.distribute")

    def place(self, grid: Any) -> Any:
        """Return a grid whose fields are on the same ranks."""
        return laid(grid, self.comm)

    # ------------------------------------------------------------ operators

    def apply(self, op: Any, u: Any, out: Any = None) -> Any:
        """Return the result of an Operator for a field on ranks, or one that every rank holds."""
        if out is not None:
            raise TypeError(f"{op.name} takes no out on ranks; leave it out")
        return self.agreement.agreed(op.name, self._applied, op, u)

    def cut(self, op: Any) -> Any:
        """Return what an operator does to the blocks of this rank, as a Structure; it is kept with the operator."""
        if "_cut" not in vars(op):
            vars(op)["_cut"] = localized(op.structure, _side(op.domain), _side(op.codomain))
        return vars(op)["_cut"]

    def _applied(self, op, u):
        y = self.cut(op).product(self._given(op, u))
        if op.codomain.backend.whole_fields:
            return y.reshape(op.codomain.shape)
        return DistributedField(y, op.codomain)

    def _given(self, op, u):
        if not isinstance(u, DistributedField):
            u = field_array(op, u)
            return u.reshape(-1) if op.domain.backend.whole_fields else block(u, op.domain).flat
        if _side(op.domain) != _side(u.space):
            raise ShapeError(f"{op.name} takes a field on {op.domain.described}, got one on {u.space.described}")
        return u.flat if u.dtype.kind in "fc" else u.flat.astype(float)

    def system(self, op: Any, rtol: Any, maxiter: Any, method: str = "auto", options: Any = None) -> Any:
        """Return the system of an operator on ranks, for `inverse`."""
        if _side(op.domain) != _side(op.codomain):
            raise TypeError(f"inverse of {op.name} does not work on ranks; both sides must lie there in the same way")
        if method != "auto" or options:
            raise TypeError(f"inverse takes no method and no options on ranks, got {method!r}; omit them")
        if op.dtype.kind == "c":
            raise TypeError(f"inverse takes real operators on ranks, {op.name} is complex; solve it on one process")
        return RanksSystem(op, rtol, maxiter)

    stencil = staticmethod(stencil_of)  # what the rows of a Jacobian on each rank need

    def reference(self, u: Any) -> Any:
        """Return the argument of an Operator, which tells on which space its gradient is."""
        return u

    def implementation(self, default: Any) -> Any:
        """Return what is called on ranks instead of a class or function of one process."""
        replacements = {
            System: self.system,
            jacobian_on_unknowns: jacobian_on_ranks,
            method_and_rule: method_and_carry,
            minimize: self.minimize,
            space_of_unknowns: self.joined,
            system_and_choice: self.system_and_choice,
        }
        return replacements.get(default, default)

    def system_and_choice(self, op: Any, settings: Any, solves: Any) -> Any:
        """Return the System of an operator on ranks, and that PETSc solves it."""
        system = self.system(op, settings.rtol, settings.maxiter, settings.method, settings.options)
        return system, Choice("petsc", str(self))

    def minimize(self, *given: Any) -> Any:
        """`minimize` of unknowns on ranks."""
        from sparsedp.parallel.minimize import minimize_on_ranks

        return minimize_on_ranks(self.comm, *given)

    def attempt(self, act: Any, *args: Any) -> Any:
        """Return ``act(*args)``; if it fails on one rank it fails on all."""
        return self.agreement.agreed("a trial", act, *args, at_once=True)

    # ------------------------------------------------------------ fields

    def tell(self, value: Any) -> None:
        """Note a number or an array, or a part of its entries, that meets a field: it must be the same on all ranks."""
        value, what = np.asarray(value), "a number"
        if value.ndim:
            most, what = round(ENTRIES ** (1 / value.ndim)), f"an array of shape {value.shape}"
            value = value[tuple(slice(None, None, n // most + 1) for n in value.shape)]
        self.agreement.tell(f"{what} beside a field on ranks", value.tobytes())

    def volumes(self, space: Any) -> Any:
        """Control volumes, as a field."""
        lines = [
            self._beside(part, space.grid.control_lengths(space.kind, axis)) for axis, part in enumerate(space.parts)
        ]
        return DistributedField(np.concatenate([reduce(np.multiply.outer, some).reshape(-1) for some in lines]), space)

    def mesh(self, grid: Any, lines: Any) -> Any:
        """Return a field of coordinates for each axis, from the coordinates along the axes."""
        space = Space(tuple(line.size for line in lines), "places", grid)
        lines = self._beside(space.shape, lines)
        return tuple(DistributedField(np.array(full).reshape(-1), space) for full in np.meshgrid(*lines, indexing="ij"))

    def _beside(self, part, lines):
        """Return the parts of arrays along the axes that belong to the block of this rank."""
        return [line[start:stop] for line, (start, stop) in zip(lines, self.box(part))]

    def flat(self, field: Any) -> Any:
        """Return the field itself, whose operations act on the flat block."""
        return field

    def field(self, space: Any, value: Any) -> Any:
        """Return a field on ranks of values that every rank holds."""
        return block(value, space)

    def joined(self, name: str, fields: Any) -> Any:
        """Return the space of some fields side by side."""
        for field in fields:
            if not isinstance(field, DistributedField) or field.layout != self:
                raise TypeError(
                    f"{name} takes fields that all lie on the same ranks, or none, got {type(field).__name__} among "
                    "them; write dp.identity(grid.cells)(u) for the field of an array"
                )
        return Joint([field.space for field in fields])

    def split(self, space: Any, v: Any) -> Any:
        """Return the components of a field, or the fields that a joint one holds; differentiable."""
        if type(space) is Space and not is_distributed(v):
            return space.split_array(v)
        return tuple(take(v) for _, take, _ in self._pieces(space))

    def join(self, space: Any, parts: Any) -> Any:
        """Return one field of its components, or of fields; differentiable."""
        if type(space) is Space and not any(map(is_distributed, parts)):
            return space.join_arrays(parts)
        pairs = zip(self._pieces(space), parts)
        return reduce(add, (back(everywhere(part, inner)) for (inner, _, back), part in pairs))


def jacobian_on_ranks(op: Any, space: Any) -> Any:
    """Return a Jacobian that was given as an Operator, between the unknowns on ranks."""
    if _side(op.domain) == _side(op.codomain) == _side(space):
        return op
    return from_matrix(op.matrix, space, space, op.name)


def method_and_carry(settings: Any) -> Any:
    """Return a scheme of transport, and the differentiable rule of a step on ranks."""
    return TransportMethod(settings), Carry(settings)


def laid(grid: Any, comm: Any) -> Any:
    """Return a grid whose fields are on the ranks of a communicator."""
    made = object.__new__(type(grid))
    vars(made).update(grid.__getstate__(), backend=Layout(grid.shape, grid.periodic, comm))
    return made


class Joint(Space):
    """Where some fields lie side by side, as one flat field."""

    spaces: list

    def __init__(self, spaces: Any) -> None:
        parts = [part for space in spaces for part in space.parts]
        super().__init__(None, " and ".join(map(str, spaces)), spaces[0].grid, parts)
        vars(self).update(spaces=spaces)

    @cached_property
    def volumes(self) -> Any:
        """Control volume of each value; ones where those of a field are not known, as on one process."""
        if any(node_axes(space.kind, 0, space.grid.dim) is None for space in self.spaces):
            return block(1.0, self)
        return self.backend.join(self, [space.volumes for space in self.spaces])


def _pieces(space):
    """Return the space of each component (or field) of a space, with the rules from the whole to it and back."""
    layout, made, start = space.backend, [], 0
    for inner in getattr(space, "spaces", None) or [
        Space(part, f"components of {space.kind}", space.grid) for part in space.parts
    ]:
        stop = start + layout.size(inner.parts)
        made.append((inner, *_piece(space, inner, slice(start, stop))))
        start = stop
    return made


def _piece(space, inner, here):
    size = space.backend.size(space.parts)

    def back(g):
        g = block(g, inner).flat
        flat = np.zeros(size, g.dtype)
        flat[here] = g
        return DistributedField(flat, space)

    return linear("piece", lambda x: DistributedField(block(x, space).flat[here], inner), back)


def _side(space):
    """Return where fields on a space are stored: (layout, components), or None if every rank has all of it."""
    return None if space.backend.whole_fields else (space.backend, space.parts)
