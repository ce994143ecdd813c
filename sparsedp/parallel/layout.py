"""Layout: the backend of grids whose fields are distributed over MPI ranks; see autodiff/backend.py."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, cached_property, reduce
from operator import add
from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from sparsedp._utils.base_classes import Frozen
from sparsedp._utils.validation import field_array
from sparsedp.advection.method import TransportMethod
from sparsedp.advection.settings import TransportSettings
from sparsedp.advection.transport import method_and_rule
from sparsedp.autodiff.backend import Backend
from sparsedp.autodiff.tape import Rule, linear, sample
from sparsedp.errors import ShapeError
from sparsedp.flow.projection_setup import ProjectionSetup
from sparsedp.grid.grid import Grid, node_axes
from sparsedp.grid.space import Space
from sparsedp.integrators.runge_kutta import Explicit, Polynomial
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Structure
from sparsedp.optimize.minimize import minimize
from sparsedp.optimize.result import Minimum
from sparsedp.parallel.cut import local_structure, storage
from sparsedp.parallel.exchange import keep_petsc_communicator
from sparsedp.parallel.fields import DistributedField, block, everywhere
from sparsedp.parallel.jacobian import RanksJacobians
from sparsedp.parallel.partition import Partition
from sparsedp.parallel.projection import RanksProjectionSetup
from sparsedp.parallel.solve import RanksSystem
from sparsedp.parallel.transport import TransportOnBlocks
from sparsedp.solvers.choose_method import Choice, SolveSettings
from sparsedp.solvers.inverse import system_and_choice
from sparsedp.solvers.jacobian import Jacobians
from sparsedp.solvers.newton import space_of_unknowns
from sparsedp.solvers.system import System

__all__ = ["Layout"]

# Functions that support distributed grids; in all others `check_grid` and `check_operator` raise TypeError.
SUPPORTED = {
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


class Layout(Partition, Backend):
    """The backend of a distributed grid: its partition, and the operations on operators and fields."""

    whole_fields = False

    def __init__(self, shape: Sequence[int], periodic: Sequence[bool], comm: MPI.Comm) -> None:
        super().__init__(shape, periodic, comm)
        keep_petsc_communicator(comm)
        self._pieces = cache(_pieces)

    def __str__(self) -> str:
        return f"on {self.comm.size} ranks"

    __repr__ = __str__

    def check(self, name: str) -> None:
        """Raise TypeError if a function does not work on ranks."""
        if name not in SUPPORTED:
            raise TypeError(f"{name} does not work on ranks yet; give it the grid from before dp.distribute")

    def place(self, grid: Grid) -> Grid:
        """Return a copy of a grid whose fields are distributed over the same ranks."""
        return grid_on_ranks(grid, self.comm)

    # ------------------------------------------------------------ operators

    def apply(self, op: Operator, u: Any, out: NDArray | None = None) -> Any:
        """Apply an Operator to a distributed field, or to an array that is the same on every rank."""
        if out is not None:
            raise TypeError(f"{op.name} takes no out on ranks; leave it out")
        return self.agreement.run(op.name, self._applied, op, u)

    def local_structure(self, op: Operator) -> Structure:
        """Return the linear map of an operator between the blocks of this rank."""
        return local_structure(op.structure, storage(op.domain), storage(op.codomain))

    def _applied(self, op, u):
        y = op.local_structure.product(self._flat_argument(op, u))
        if op.codomain.backend.whole_fields:
            return y.reshape(op.codomain.shape)
        return DistributedField(y, op.codomain)

    def _flat_argument(self, op, u):
        """Return the flat block of this rank of the argument of an operator; raise if the argument does not fit."""
        if not isinstance(u, DistributedField):
            u = field_array(op, u)
            if op.domain.backend.whole_fields:
                return u.reshape(-1)
            return block(u, op.domain).flat
        if storage(op.domain) != storage(u.space):
            raise ShapeError(f"{op.name} takes a field on {op.domain.described}, got one on {u.space.described}")
        if u.dtype.kind in "fc":
            return u.flat
        return u.flat.astype(float)

    def system(
        self,
        op: Operator,
        rtol: float,
        maxiter: int | None,
        method: str = "auto",
        options: dict[str, Any] | None = None,
    ) -> RanksSystem:
        """Return the system of an operator on ranks, for `inverse`."""
        if storage(op.domain) != storage(op.codomain):
            raise TypeError(f"inverse of {op.name} does not work on ranks; both sides must be stored in the same way")
        if method != "auto" or options:
            raise TypeError(f"inverse takes no method and no options on ranks, got {method!r}; omit them")
        if op.dtype.kind == "c":
            raise TypeError(f"inverse takes real operators on ranks, {op.name} is complex; solve it on one process")
        return RanksSystem(op, rtol, maxiter)

    def reference(self, u: Any) -> Any:
        """Return the argument of an Operator: its gradient is on the same space."""
        return u

    def implementation(self, default: Callable) -> Callable:
        """Return the class or function that replaces `default` for distributed fields; `default` if there is none."""
        replacements: dict[Callable, Callable] = {
            Jacobians: RanksJacobians,
            Polynomial: Explicit,
            ProjectionSetup: RanksProjectionSetup,
            System: self.system,
            method_and_rule: method_and_rule_on_ranks,
            minimize: self.minimize,
            space_of_unknowns: self.space_of_fields,
            system_and_choice: self.system_and_choice,
        }
        return replacements.get(default, default)

    def system_and_choice(self, op: Operator, settings: SolveSettings, solves: str) -> tuple[RanksSystem, Choice]:
        """Return the System of an operator for distributed fields, and the Choice of PETSc as its solver."""
        system = self.system(op, settings.rtol, settings.maxiter, settings.method, settings.options)
        return system, Choice("petsc", str(self))

    def minimize(self, *arguments: Any) -> Minimum:
        """Call `minimize_on_ranks`."""
        from sparsedp.parallel.minimize import minimize_on_ranks

        return minimize_on_ranks(self.comm, *arguments)

    def attempt(self, act: Callable, *args: Any) -> Any:
        """Return ``act(*args)``. If it raises an exception on one rank, it is raised on all ranks."""
        return self.agreement.run("a trial", act, *args, at_once=True)

    # ------------------------------------------------------------ fields

    def volumes(self, space: Space) -> DistributedField:
        """Return the control volumes as a distributed field."""
        blocks = []
        for axis, part in enumerate(space.parts):
            lines = self._own_parts(part, space.grid.control_lengths(space.kind, axis))
            blocks.append(reduce(np.multiply.outer, lines).reshape(-1))
        return DistributedField(np.concatenate(blocks), space)

    def mesh(self, grid: Grid, lines: Sequence[NDArray]) -> tuple[DistributedField, ...]:
        """Return one distributed field of coordinates for each axis, given the 1-D coordinates along the axes."""
        space = Space(tuple(line.size for line in lines), "places", grid)
        own_lines = self._own_parts(space.shape, lines)
        fields = np.meshgrid(*own_lines, indexing="ij")
        return tuple(DistributedField(np.array(values).reshape(-1), space) for values in fields)

    def _own_parts(self, part, lines):
        """Return the parts of arrays along the axes that belong to the block of this rank."""
        return [line[start:stop] for line, (start, stop) in zip(lines, self.box(part), strict=True)]

    def stack(self, fields: Sequence) -> tuple:
        """Return the tuple of fields."""
        return tuple(fields)

    def fingerprint(self, field: DistributedField) -> int:
        """Return a hash of a field, the same on all ranks."""
        return field.fingerprint()

    def flat(self, field: Any) -> Any:
        """Return the field itself: distributed fields need not be flattened."""
        return field

    def combinable(self, value: Any) -> Any:
        """Return the value itself: numbers and whole arrays can be combined with distributed fields."""
        return value

    def field(self, space: Space, values: Any) -> DistributedField:
        """Return a distributed field, given values that are the same on every rank."""
        return block(values, space)

    def space_of_fields(self, name: str, fields: Sequence[Any]) -> JointSpace:
        """Return the joint space of several fields."""
        for field in fields:
            if not isinstance(field, DistributedField) or field.layout != self:
                raise TypeError(
                    f"{name} takes fields that are all distributed in the same way, or none, got "
                    f"{type(field).__name__} among them; write dp.identity(grid.cells)(u) for the field of an array"
                )
        return JointSpace([field.space for field in fields])

    def split(self, space: Space, v: Any) -> tuple:
        """Return the components of a field, or the fields that a field on a joint space contains. Differentiable."""
        if type(space) is Space and not _is_distributed(v):
            return space.split_array(v)
        return tuple(piece.take(v) for piece in self._pieces(space))

    def join(self, space: Space, parts: Any) -> Any:
        """Return one field from its components, or a field on a joint space from several fields. Differentiable."""
        if type(space) is Space and not any(map(_is_distributed, parts)):
            return space.join_arrays(parts)
        pairs = zip(self._pieces(space), parts, strict=True)
        return reduce(add, (piece.embed(everywhere(part, piece.space)) for piece, part in pairs))

    concatenate = join  # the values are fields on the spaces of a joint space


def method_and_rule_on_ranks(settings: TransportSettings) -> tuple[TransportMethod, TransportOnBlocks]:
    """Return a transport scheme, and the differentiable function that computes a step of distributed fields."""
    return TransportMethod(settings), TransportOnBlocks(settings)


def grid_on_ranks(grid: Grid, comm: MPI.Comm) -> Grid:
    """Return a copy of a grid whose fields are distributed over the ranks of a communicator."""
    return grid.stored_by(Layout(grid.shape, grid.periodic, comm))


class JointSpace(Space):
    """The space of several fields that are concatenated to one flat field.

    Parameters
    ----------
    spaces : list of Space
    """

    spaces: list[Space]

    def __init__(self, spaces: list[Space]) -> None:
        parts = [part for space in spaces for part in space.parts]
        super().__init__(None, " and ".join(map(str, spaces)), spaces[0].grid, parts)
        Frozen.__init__(self, spaces=spaces)

    @cached_property
    def volumes(self) -> Any:
        """Control volume of each value; all ones if one of the spaces has no control volumes, as on one process."""
        if any(node_axes(space.kind, 0, space.grid.dim) is None for space in self.spaces):
            return block(1.0, self)
        return self.backend.join(self, [space.volumes for space in self.spaces])


class Piece(NamedTuple):
    """A component of a space, or a field of a joint space.

    Attributes
    ----------
    space : Space
    take : Rule
        Extracts the part from a field on the whole space.
    embed : Rule
        The transpose of `take`: a field on the whole space that is 0 outside the part.
    """

    space: Space
    take: Rule
    embed: Rule


def _is_distributed(value):
    return isinstance(sample(value), DistributedField)


def _pieces(space):
    """Return the pieces of a space."""
    layout = space.backend
    inner_spaces = getattr(space, "spaces", None)
    if inner_spaces is None:
        inner_spaces = [Space(part, f"components of {space.kind}", space.grid) for part in space.parts]
    pieces = []
    start = 0
    for inner in inner_spaces:
        stop = start + layout.size(inner.parts)
        pieces.append(_piece(space, inner, slice(start, stop)))
        start = stop
    return pieces


def _piece(space, inner, window):
    """Return the piece of a space that is a window of the flat block."""
    size = space.backend.size(space.parts)

    def take(x):
        return DistributedField(block(x, space).flat[window], inner)

    def embed(g):
        values = block(g, inner).flat
        flat = np.zeros(size, values.dtype)
        flat[window] = values
        return DistributedField(flat, space)

    return Piece(inner, *linear("piece", take, embed))
