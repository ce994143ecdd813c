"""inverse(op): the inverse of an operator, as an operator."""

from __future__ import annotations

from copy import deepcopy
from time import perf_counter
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.calls import public
from sparsedp._utils.counters import active, count, spent
from sparsedp._utils.html import facts
from sparsedp._utils.validation import check_finite, check_native, check_on, field_array
from sparsedp.autodiff.backend import collectively
from sparsedp.autodiff.tape import apply_operator, isbox, plain
from sparsedp.errors import NonFiniteError, ShapeError
from sparsedp.grid.space import fits
from sparsedp.operators.given import check_operator
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Structure, result_dtype
from sparsedp.solvers.choose_method import (
    Choice,
    SolveSettings,
    check_options,
    check_settings,
    check_unknowns,
    choose_method,
    engine_of,
)
from sparsedp.solvers.direct import DenseSystem, dense_engine
from sparsedp.solvers.records import SolveLog, merged
from sparsedp.solvers.solve import Solver
from sparsedp.solvers.system import System

if TYPE_CHECKING:
    from collections.abc import Callable

    from sparsedp._utils.html import Markup
    from sparsedp.solvers.engine import Engine

__all__ = ["Inverse", "Solution", "build", "build_dense", "inverse"]

FRAMES = 10  # Python calls inside a solve, in units of those that a nested product or sum of operators takes


def inverse(
    op: Operator,
    method: str = "auto",
    rtol: float = 1e-10,
    maxiter: int | None = None,
    nullspace: str = "raise",
    **options: Any,
) -> Inverse:
    """Set up the inverse of an operator: ``x = inv(b)`` solves op(x) = b, ``inv.T(g)`` the transposed system.

    Parameters
    ----------
    op : Operator
        Square: its domain and its codomain hold the same fields.
    method : str
        "auto" chooses by a fixed rule; ``print(inv)`` says why. Else "separable", "direct", "structured",
        "multigrid" or "krylov".
    rtol : float
        Tolerance on the true residual relative to the right-hand side, 0 < rtol < 1, forward and adjoint.
    maxiter : int, optional
        Most iterations of one solve. Default: enough for the method.
    nullspace : "raise" or "project"
        What to do with data outside the range of a singular operator: refuse them, or project them onto the range.
    **options
        Of the method. separable has none; auto takes those of all.

        ==========  ==============  ==========  =================================================================
        method      option          default     meaning
        ==========  ==============  ==========  =================================================================
        multigrid   cycle           "V"         "V" or "W", which costs more and needs fewer iterations
        multigrid   strength        0.25        share of the largest entry of a row from which one is strong
        multigrid   sweeps          see right   Gauss-Seidel sweeps, (('forward',), ('backward',)): before, after
        multigrid   levels          25          most levels
        krylov      preconditioner  None        "jacobi", "shifted_laplace" (for waves), Operator or function
        krylov      diff            "implicit"  "unrolled": derivatives go through the iterations
        krylov      iterations      None        exactly this number, whatever the residual
        structured  precision       "auto"      "single" or "double", of the cycle
        direct      precision       "auto"      "single" or "double", of the factors
        ==========  ==============  ==========  =================================================================

    Returns
    -------
    Inverse
        An Operator from fields b on the codomain of `op` to fields x on its domain. `inv.info` holds the records of
        the last forward and adjoint solve. The set-up is done here, once.

    Raises
    ------
    ShapeError
        If `op` is not square.
    TypeError
        If `op` is not an Operator, or the method does not take an option.
    ValueError
        If `rtol`, `maxiter`, `nullspace` or `method` is out of range.
    ConvergenceError
        If the set-up fails, and on use, when a solve does not meet `rtol`.
    IncompatibleError
        On use, if the operator is singular, the right-hand side out of its range, and nullspace="raise".
    NonFiniteError
        On use, if the right-hand side holds NaN or infinity, or the solution cannot be represented.

    See Also
    --------
    laplacian, Operator, elliptic_solver, matrix_solver, implicit, matrix_power

    Notes
    -----
    Null space: one vector for each connected component, found from the entries. Data are projected
    with it, and the solution has volume-weighted mean 0 on each singular component; see nullspace.py.
    Transpose: `inv.T` uses the same set-up, is exact to rtol, and never refuses.
    Triangular parts: "direct", "structured", "multigrid" and "auto" find by substitution the unknowns that depend on
    no coupled ones, and those that no other equation uses; only the coupled ones are factored or iterated on. A system
    that is triangular in some order, such as a chain or upwind differences, takes one pass over its entries.
    Memory: the coarsest level of "multigrid" is a dense matrix of at most 2000 unknowns; a larger one is refused.
    Threads: several may solve at once, to the same bits; `inv.info` is of the solve that ended last.
    Complex numbers: see docs/guides/complex_numbers.md.

    Examples
    --------
    >>> import numpy as np
    >>> from sparsedp import from_matrix
    >>> inv = inverse(from_matrix([[2.0, 0.0], [1.0, 4.0]]))
    >>> inv(np.array([2.0, 5.0]))
    array([1., 1.])
    >>> inv.T(np.array([2.0, 4.0]))
    array([0.5, 1. ])
    """
    check_operator("inverse", op)
    if not fits(op.domain, op.codomain):
        raise ShapeError(f"inverse takes a square operator, got one from {op.domain} to {op.codomain}; write op.T @ op")
    settings = check_settings(method, rtol, maxiter, nullspace, options)
    return collectively("inverse", (op,), lambda: build(op, settings))


# ---- set-up ----


def build(
    op: Operator,
    settings: SolveSettings,
    name: str | None = None,
    log: SolveLog | None = None,
    solves: str = "many",
    near: Engine | None = None,
    all_rows: bool = True,
) -> Inverse:
    """Set up an inverse.

    Parameters
    ----------
    op : Operator
    settings : SolveSettings
    name : str, optional
        Of the inverse in messages and counts.
    log : SolveLog, optional
        Where its solves are recorded.
    solves : "many" or "few"
        How many solves the caller expects of this set-up.
    near : Engine, optional
        The engine of a matrix close to this one, whose LU factors may serve as a preconditioner.
    all_rows : bool
        Refuse an operator with a row whose own unknown no row uses. False if the caller tests the residual of such
        rows, or leaves them out on purpose.
    """
    start_time = perf_counter()
    choose = op.backend.implementation(system_and_choice)
    system, choice = choose(op, settings, solves)
    if system.complex and choice.method not in ("direct", "krylov"):
        raise ValueError(f"{choice.method} takes real operators, {op} is complex; write method='direct' or 'krylov'")
    if all_rows:
        check_unknowns(system)
    engine = engine_of(system, choice, settings.options, near)
    name = name or f"inverse({op.name})"
    made = build, (op, settings, name, None, solves, None, all_rows)
    solver = Solver(system, engine, settings.nullspace, log or SolveLog(), name, made, choice.reason)
    _record_set_up(solver, start_time)
    return Inverse(Solution(solver))


def system_and_choice(op: Operator, settings: SolveSettings, solves: str) -> tuple[System, Choice]:
    """Return the System of an operator, and the method that solves it: see `build`."""
    method = settings.method
    system = System(op, settings.rtol, settings.maxiter)
    if method in ("krylov", "separable"):
        system.splitting = None  # these solve for all unknowns, without looking at the entries
    if method == "auto":
        choice = choose_method(system, solves)
    else:
        choice = Choice(method, "as asked")
    check_options(choice.method, settings.options)
    return system, choice


def build_dense(op: Operator, rtol: float, nullspace: str, name: str) -> Solver | None:
    """Set up the Solver of a small explicit operator; return None if it may be singular."""
    start_time = perf_counter()
    system = DenseSystem(op, rtol)
    engine = dense_engine(system)
    if engine is None:
        return None
    solver = Solver(system, engine, nullspace, SolveLog(), name, None, "a small full matrix")
    _record_set_up(solver, start_time)
    return solver


def _record_set_up(solver: Solver, start_time: float) -> None:
    """Record the time and the size of a set-up, and count it."""
    log = solver.log
    log.setup_seconds = perf_counter() - start_time
    log.hierarchy = solver.engine.hierarchy
    count(solver.name, "setup")
    count(solver.name, "hierarchy", int(solver.engine.hierarchical))
    spent(solver.name, "setup", log.setup_seconds, log.setup_seconds)


# ---- the inverse as an operator ----


class Solution(Structure):
    """The solve as a linear map on flat arrays. Transposes and tangents share the set-up and the log.

    Parameters
    ----------
    solver : Solver
    transposed : bool
    checked : bool
        Whether it is applied to primal data, which must be in the range of a singular operator. Data of transposes and
        tangents are projected onto it, so that derivatives of every order are never refused.
    start : array, shape (n,), optional
        First guess; transposes and tangents have none.
    """

    has_entries = False

    def __init__(
        self, solver: Solver, transposed: bool = False, checked: bool = True, start: np.ndarray | None = None
    ) -> None:
        system = solver.system
        self.solver = solver
        self.transposed = transposed
        self.checked = checked
        self.start = start
        self.shape = (system.size, system.size)
        self.dtype = system.op.dtype
        self.depth = system.op.structure.depth + FRAMES

    def product(self, x: np.ndarray) -> np.ndarray:
        """Return A^-1 x as a fresh array: solved in double precision, and rounded once to the precision of x.

        Real and imaginary part of complex data are solved for one after the other if the operator is real.
        """
        if x.dtype == self.dtype and self.start is None:
            return self.solver.solve(x, self.transposed, self.checked)
        if x.dtype.kind == "c" and self.dtype.kind != "c":
            return self._product_by_parts(x)
        double = np.result_type(x, float, self.dtype)
        start = self.start
        if start is not None:
            start = start.astype(double)
        solution = self.solver.solve(x.astype(double, copy=False), self.transposed, self.checked, start)
        dtype = result_dtype(self, x.dtype)
        if dtype == solution.dtype:
            return solution
        with np.errstate(over="ignore"):
            rounded = solution.astype(dtype)
        if not np.isfinite(self.solver.system.largest(np.abs(rounded))):
            raise NonFiniteError(f"the solution of {self.solver.name} is beyond {dtype}; give it double precision")
        return rounded

    def apply(self, x: np.ndarray, out: np.ndarray) -> None:
        """Write A^-1 x into `out`."""
        np.copyto(out, self.product(x))

    def _product_by_parts(self, x: np.ndarray) -> np.ndarray:
        """Solve for the real and the imaginary part of complex data, and record both solves as one."""
        log = self.solver.log
        last = log.last(self.transposed)
        solution = np.empty_like(x)
        records: list[Any] = []
        for part in ("real", "imag"):
            start = None if self.start is None else getattr(self.start, part)
            half = Solution(self.solver, self.transposed, self.checked, start).product(getattr(x, part).copy())
            getattr(solution, part)[...] = half
            records.append(log.last(self.transposed))
        if records[0] is not last:  # an observed solve may leave no record
            log.note(merged(*records), self.transposed)
        return solution

    def transpose(self) -> Solution:
        """Return the solve with the transposed operator."""
        return Solution(self.solver, not self.transposed, checked=False)

    def tangent(self) -> Solution:
        """Return the same map without a first guess and without refusals of data."""
        if self.checked or self.start is not None:
            return Solution(self.solver, self.transposed, checked=False)
        return self

    def __deepcopy__(self, memo: dict) -> Solution:
        solver = deepcopy(self.solver, memo)
        return Solution(solver, self.transposed, self.checked, deepcopy(self.start, memo))


class Inverse(Operator):
    """The inverse of an Operator, as an Operator: ``inv(b)`` solves, ``inv.T(g)`` solves the transposed system.

    `inverse` sets it up. For singular operators it is the generalised inverse that nullspace.py defines.

    Parameters
    ----------
    structure : Solution
    """

    structure: Solution
    solver: Solver

    def __init__(self, structure: Solution) -> None:
        solver = structure.solver
        op = solver.system.unscaled
        if structure.transposed:
            super().__init__(structure, op.domain, op.codomain, f"{solver.name}.T", "matrix-free")
        else:
            super().__init__(structure, op.codomain, op.domain, solver.name, "matrix-free")
        self.__dict__["solver"] = solver

    def _acting_as(self, structure: Solution, domain: Any, codomain: Any, name: str) -> Inverse:
        return Inverse(structure)

    def recipe(self) -> tuple[Callable, tuple]:
        """Return the class and the arguments that build it again."""
        return Inverse, (self.structure,)

    @property
    def info(self) -> SolveLog:
        """Records of the last solves, shared with the transpose: .forward, .adjoint, .setup_seconds, .hierarchy.

        Complex data are two solves for a real operator, with one record: the sum of their iterations and seconds, and
        the worse of the other figures.
        """
        return self.solver.log

    @property
    def reason(self) -> str:
        """Why this method was chosen."""
        return self.solver.reason

    @property
    def method(self) -> str:
        """The method in use."""
        return self.solver.engine.method

    # ------------------------------------------------------------ application

    @public("dp.inverse(op)")
    def __call__(self, b: Any, start: Any = None) -> Any:
        """Solve for a field b, or a batch of them; differentiable in b.

        Parameters
        ----------
        b : array, shape (..., *`domain.shape`)
            Leading axes are a batch.
        start : array, shape `codomain.shape`, optional
            First guess, which saves iterations of iterative methods. Derivatives do not depend on it, and the
            derivative in it is 0; with the option diff="unrolled" of krylov the iterations themselves are
            differentiated, in b and in `start`.

        Returns
        -------
        array, shape (..., *`codomain.shape`)
        """
        if start is not None or self.solver.engine.unrolled:
            return self._solve_from(b, start)
        if active or isbox(b):
            return apply_operator(self, b)
        return self.apply(b)

    def apply(self, u: Any, out: np.ndarray | None = None) -> Any:
        """Solve for plain data, without the tape: see `Operator.apply`."""
        if (
            type(u) is np.ndarray
            and u.shape == self.domain.shape
            and u.dtype == self.structure.dtype
            and u.flags.c_contiguous
            and out is None
            and self.backend.whole_fields
        ):  # one field as the solver takes it: its solution is returned without a copy
            return self.structure.product(u.reshape(-1)).reshape(self.codomain.shape)
        return super().apply(u, out)

    def _solve_from(self, b: Any, start: Any) -> Any:
        """Solve from a first guess, or by iterations that are differentiated."""
        if start is not None:
            check_native(self.name, start)
            check_finite(f"the start of {self.name}", plain(start))
            check_on(f"{self.name}, as start,", start, self.codomain)
        structure = self.structure
        if self.solver.engine.unrolled:
            if np.ndim(b) > len(self.domain.shape):  # a batch: the iterations of each solve are recorded
                return anp.array([self(field, start) for field in b])
            return self.solver.unroll(b, start, structure.transposed)
        field_array(self, plain(b))  # a start is for one field
        start = np.asarray(plain(start)).reshape(-1)
        return Inverse(Solution(self.solver, structure.transposed, structure.checked, start))(b)

    # ------------------------------------------------------------ description

    def __repr__(self) -> str:
        return f"<{self.name}: {self.domain} -> {self.codomain}, {self.method}>"

    def _facts(self) -> dict[str, str]:
        """Return a description of the set-up."""
        system = self.solver.system
        singular = system.null_space.count
        by_substitution = ""
        if system.splitting is not None:
            by_substitution = f", {system.splitting.size} of them found by substitution"
        return {
            "method": f"{self.method}: {self.reason}",
            "unknowns": f"{system.unknowns} of {system.size}{by_substitution}",
            "tolerance": f"relative residual {system.rtol:g}",
            "null space": f"{singular} singular component{'s' * (singular != 1)}, {self.solver.nullspace!r}",
            "set-up": f"{self.info.setup_seconds:.2g} s; {self.info.hierarchy}",
        }

    def __str__(self) -> str:
        lines = (f"  {name:10}  {words}" for name, words in self._facts().items())
        return "\n".join([f"{self.name}: {self.domain} -> {self.codomain}", *lines])

    def _repr_html_(self) -> Markup:
        """Return a table for notebooks."""
        return facts(self.name, {"from": self.domain, "to": self.codomain, **self._facts()})
