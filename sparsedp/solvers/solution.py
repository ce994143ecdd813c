"""Inverse: an Operator whose application is a solve."""

import weakref
from functools import cached_property

import autograd.numpy as anp
import numpy as np

from sparsedp.errors import NonFiniteError, ShapeError
from sparsedp.fields import field_array
from sparsedp.operator import Operator
from sparsedp.solvers.solve import Solver
from sparsedp.structure.base import Structure, result_dtype
from sparsedp.tape import Rule, isbox

__all__ = ["Inverse"]


class Solution(Structure):
    """The solve as a structure on flat arrays. Transposes and tangents share set-up and log.

    `checked`: primal data, which must be compatible with a singular operator. Transposes and tangents
    are not, so that a derivative of any order is projected and never refused.
    """

    has_entries = False

    def __init__(self, solver, transposed=False, checked=True):
        self.solver = solver
        self.transposed, self.checked = transposed, checked
        self.shape = (solver.system.size,) * 2
        self.dtype = solver.system.op.dtype

    def apply(self, x, out):
        np.copyto(out, self.solved(x))

    def solved(self, b, start=None):
        """A^-1 b as a fresh flat array: solved in double precision, rounded once."""
        wide, dtype = np.complex128 if b.dtype.kind == "c" else np.float64, result_dtype(self, b.dtype)
        start = None if start is None else start.astype(wide)
        x = self.solver.solve(b.astype(wide, copy=False), self.transposed, self.checked, start)
        if x.dtype == dtype:
            return x
        with np.errstate(over="ignore"):
            rounded = x.astype(dtype)
        if not np.all(np.isfinite(rounded)):
            raise NonFiniteError(f"the solution of {self.solver.name} is beyond {dtype}; give it double precision")
        return rounded

    def transpose(self):
        return Solution(self.solver, not self.transposed, checked=False)

    def tangent(self):
        return Solution(self.solver, self.transposed, checked=False) if self.checked else self


class Inverse(Operator):
    """The inverse of an Operator, as an Operator: ``inv(b)`` solves, ``inv.T(g)`` solves the transposed system.

    Made by `inverse`. For singular operators it is the generalised inverse that `nullspace.py` defines.

    Parameters
    ----------
    solver : Solver
    transposed, checked : bool
    """

    structure: Solution
    solver: Solver

    def __init__(self, solver, transposed=False, checked=True):
        op = solver.system.given
        domain, codomain = (op.domain, op.codomain) if transposed else (op.codomain, op.domain)
        name = f"{solver.name}.T" if transposed else solver.name
        super().__init__(Solution(solver, transposed, checked), domain, codomain, name, "matrix-free")
        self.__dict__["solver"] = solver

    def recipe(self):
        """The call that makes it again: see recipe.py."""
        return Inverse, (self.solver, self.structure.transposed, self.structure.checked)

    @property
    def info(self):
        """SolveLog, shared with the transpose: .forward, .adjoint, .setup_seconds, .hierarchy."""
        return self.solver.log

    @property
    def reason(self):
        """Why this method, in words."""
        return self.solver.reason

    @property
    def method(self):
        """The word of the method in use."""
        return self.solver.engine.method

    def _make_transpose(self):
        structure = self.structure
        turned = Inverse(self.solver, not structure.transposed, checked=False)
        if not structure.checked:  # the transpose of a transpose is the twin that never refuses
            turned.__dict__["_origin"] = weakref.ref(self)
        self.__dict__["_transposed"] = turned
        return turned

    @property
    def tangent(self):
        """This inverse without the check of primal data: what derivative rules apply."""
        return self._unchecked if self.structure.checked else self

    @cached_property
    def _unchecked(self):
        return Inverse(self.solver, self.structure.transposed, checked=False)

    # ------------------------------------------------------------ application

    def __call__(self, b, start=None):
        """Solve; differentiable in b. `start`: first guess, which saves iterations of iterative methods.

        Implicit derivatives do not depend on `start`: the derivative in it is 0. With the option
        diff="unrolled" of krylov, the iterations themselves are differentiated, in b and in `start`.
        """
        if self.solver.engine.unrolled:
            if np.ndim(b) > len(self.domain.shape):  # a batch: each solve has steps of its own
                return anp.array([self(field, start) for field in b])
            return self.solver.unroll(b, start, self.structure.transposed)
        if start is None:
            return super().__call__(b)
        if np.shape(start) != self.codomain.shape:
            raise ShapeError(f"{self.name} takes a start on {self.codomain}, got an array of shape {np.shape(start)}")
        return self._warm()(b, start) if isbox(b) or isbox(start) else self._solve_from(b, start)

    def apply(self, u, out=None):
        """Solve for a plain array, without the tape; see `Operator.apply`."""
        return self._solve_from(u) if out is None and np.ndim(u) == len(self.domain.shape) else super().apply(u, out)

    def _solve_from(self, b, start=None):
        start = None if start is None else np.asarray(start).reshape(-1)
        return self.structure.solved(field_array(self, b).reshape(-1), start).reshape(self.codomain.shape)

    def _warm(self):
        """The rule of a solve from a start: x does not depend on the start. Not kept: it holds this inverse."""

        def vjp(nums, ans, b, start):
            return lambda g: tuple(self.T(g) if num == 0 else 0.0 * start for num in nums)

        def jvp(nums, tangents, ans, b, start):
            return sum(self.tangent(t) if num == 0 else 0.0 * t for num, t in zip(nums, tangents, strict=True))

        return Rule(self.name, self._solve_from, vjp, jvp)

    # ------------------------------------------------------------ words

    def __repr__(self):
        return f"<{self.name}: {self.domain} -> {self.codomain}, {self.method}>"

    def __str__(self):
        system, log = self.solver.system, self.info
        space = system.null_space
        lines = [
            f"{self.name}: {self.domain} -> {self.codomain}",
            f"  method      {self.method}: {self.reason}",
            f"  unknowns    {system.unknowns} of {system.size}",
            f"  tolerance   relative residual {system.rtol:g}",
            f"  null space  {space.count} singular component{'s' * (space.count != 1)}, {self.solver.nullspace!r}",
            f"  set-up      {log.setup_seconds:.2g} s; {log.hierarchy}",
        ]
        return "\n".join(lines)
