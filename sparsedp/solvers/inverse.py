"""inverse(op): the inverse of an operator, as an operator."""

from __future__ import annotations

from copy import deepcopy
from functools import partial
from time import perf_counter
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.calls import public
from sparsedp._utils.counters import active, count, spent
from sparsedp._utils.html import facts
from sparsedp._utils.validation import check_finite, check_native, check_on, field_array
from sparsedp.autodiff.backend import collectively
from sparsedp.autodiff.program_trace import opaque
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

FRAMES = 10  # nesting depth of a solve; one nested product or sum of operators has depth 1


def inverse(
    op: Operator,
    method: str = "auto",
    rtol: float = 1e-10,
    maxiter: int | None = None,
    nullspace: str = "raise",
    **options: Any,
) -> Inverse:
    """Set up the inverse of an operator: ``x = inv(b)`` solves op(x) = b, ``y = inv.T(g)`` solves op.T(y) = g.

    Parameters
    ----------
    op : Operator
        A square operator: fields on its domain and on its codomain have the same layout.
    method : str
        "auto", "separable", "direct", "structured", "multigrid", "krylov" or "schur". With "auto" a fixed rule chooses
        the method, and ``print(inv)`` shows the reason.
    rtol : float
        Relative tolerance, 0 < rtol < 1: a solve succeeds if |b - op(x)| <= rtol |b|, or if the residual is at the
        level of rounding errors. The residual is computed from x. Adjoint solves use the same tolerance.
    maxiter : int, optional
        Largest number of iterations of an iterative method. Default: depends on the method.
    nullspace : "raise" or "project"
        What to do if the operator is singular and the right-hand side is not in its range: raise IncompatibleError, or
        project the right-hand side onto the range.
    **options
        Options of the method. "separable" and "schur" have none. "auto" accepts the options of all methods; the chosen
        method must accept them too.

        ==========  ==============  ==========  =================================================================
        method      option          default     meaning
        ==========  ==============  ==========  =================================================================
        multigrid   cycle           "V"         "V" or "W"; a W-cycle costs more and needs fewer iterations
        multigrid   strength        0.25        an entry is strong from this fraction of the largest in its row
        multigrid   sweeps          see right   pre- and post-smoothing sweeps, (('forward',), ('backward',))
        multigrid   levels          25          largest number of levels
        krylov      preconditioner  None        "jacobi", "shifted_laplace" (for waves), Operator or function
        krylov      diff            "implicit"  "implicit" or "unrolled" (differentiate the iterations)
        krylov      iterations      None        number of iterations; no tolerance is tested
        structured  precision       "auto"      precision of the cycle: "single" or "double"
        direct      precision       "auto"      precision of the LU factors: "single" or "double"
        ==========  ==============  ==========  =================================================================

    Returns
    -------
    Inverse
        An Operator that maps a field b on the codomain of `op` to a field x on its domain. The set-up, such as an LU
        factorisation, is computed once, by this call. `inv.info` holds the records of the last forward and the last
        adjoint solve.

    Raises
    ------
    ShapeError
        If `op` is not square.
    TypeError
        If `op` is not an Operator, or the method does not take an option.
    ValueError
        If `rtol`, `maxiter`, `nullspace` or `method` is out of range.
    ConvergenceError
        If the set-up fails. Also when ``inv(b)`` or ``inv.T(g)`` is called, if the solve does not meet `rtol`.
    IncompatibleError
        When ``inv(b)`` is called, if the operator is singular, b is not in its range, and nullspace="raise".
    NonFiniteError
        When a solve is called, if the right-hand side contains NaN or infinity, or the solution overflows.

    See Also
    --------
    laplacian, Operator, elliptic_solver, matrix_solver, eigenpairs, implicit, matrix_power

    Notes
    -----
    Null space: each connected component of the matrix has at most one null vector, which is computed in the set-up. The
    right-hand side is projected onto the range. For a pure Neumann problem the solution has volume-weighted mean 0 on
    each singular component (order=4: see `laplacian`); nullspace.py describes the general case.
    Transpose: `inv.T` uses the same set-up and the same `rtol`. It projects its data onto the range, and never raises
    IncompatibleError.
    Triangular parts: "direct", "structured", "multigrid" and "auto" use substitution for the unknowns that do not
    depend on coupled unknowns, and for those that appear in no other equation. Only the coupled unknowns are factored
    or iterated on. Substitution alone solves a system that is triangular after a permutation, such as a chain or upwind
    differences, in one pass over its entries.
    Memory: the matrix of the coarsest level of "multigrid" is dense. If that level has more than 2000 unknowns, the
    set-up raises ConvergenceError.
    Threads: several threads may call the same inverse at once, and obtain the same results bit for bit. `inv.info`
    describes the solve that ended last.
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
        Name of the inverse in error messages and counters. Default: "inverse(...)" around the name of `op`.
    log : SolveLog, optional
        Log in which the solves are recorded. Default: a new one.
    solves : "many" or "few"
        How many solves the caller expects to do with this set-up.
    near : Engine, optional
        The solver of a similar matrix; its LU factors may be used as a preconditioner.
    all_rows : bool
        Whether to raise ConvergenceError if an unknown appears in no row although the row with its number has entries.
        False if the caller tests the residual of such rows, or ignores them on purpose.
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
    constructor_call = build, (op, settings, name, None, solves, None, all_rows)
    solver = Solver(system, engine, settings.nullspace, log or SolveLog(), name, constructor_call, choice.reason)
    _record_set_up(solver, start_time)
    return Inverse(Solution(solver))


def system_and_choice(op: Operator, settings: SolveSettings, solves: str) -> tuple[System, Choice]:
    """Return the System of an operator, and the Choice of its method; the parameters are those of `build`."""
    method = settings.method
    system = System(op, settings.rtol, settings.maxiter)
    if method in ("krylov", "schur", "separable"):
        system.splitting = None  # these methods solve for all unknowns and do not use the matrix entries
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
    """Record the duration and the description of a set-up in the log, and increment the counters."""
    log = solver.log
    log.setup_seconds = perf_counter() - start_time
    log.hierarchy = solver.engine.hierarchy
    count(solver.name, "setup")
    count(solver.name, "hierarchy", int(solver.engine.hierarchical))
    spent(solver.name, "setup", log.setup_seconds, log.setup_seconds)


# ---- the inverse as an operator ----


class Solution(Structure):
    """The solve as a linear map on flat arrays. Its transpose and its tangent map share the set-up and the log.

    Parameters
    ----------
    solver : Solver
    transposed : bool
    checked : bool
        Whether a right-hand side outside the range of a singular operator raises IncompatibleError. If False, it is
        projected onto the range. Transposes and tangent maps always project, so that derivatives of every order exist.
    start : array, shape (n,), optional
        Initial guess; transposes and tangent maps have none.
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
        """Return A^-1 x as a new array.

        The solve uses double precision; only the solution is rounded to the precision of x. If the operator is real and
        x is complex, two solves are done: one for the real part and one for the imaginary part.
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
        if records[0] is not last:  # a solve that a hook handles may leave no record
            log.note(merged(*records), self.transposed)
        return solution

    def transpose(self) -> Solution:
        """Return the solve with the transposed operator."""
        return Solution(self.solver, not self.transposed, checked=False)

    def tangent(self) -> Solution:
        """Return the same map without an initial guess; it projects its data and never raises IncompatibleError."""
        if self.checked or self.start is not None:
            return Solution(self.solver, self.transposed, checked=False)
        return self

    def __deepcopy__(self, memo: dict) -> Solution:
        solver = deepcopy(self.solver, memo)
        return Solution(solver, self.transposed, self.checked, deepcopy(self.start, memo))


class Inverse(Operator):
    """The inverse of an Operator, as an Operator: ``inv(b)`` solves, ``inv.T(g)`` solves the transposed system.

    Instances are created by `inverse`. The inverse of a singular operator is the generalised inverse that is defined in
    nullspace.py.

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
        """Return the class and the arguments that reconstruct this object."""
        return Inverse, (self.structure,)

    @property
    def info(self) -> SolveLog:
        """Records of the last solves, shared with the transpose: .forward, .adjoint, .setup_seconds, .hierarchy.

        A real operator solves for complex data by two solves, which have one record: `iterations` and `seconds` are
        sums, and each of the other values is the worse one of the two solves.
        """
        return self.solver.log

    @property
    def reason(self) -> str:
        """The reason for which this method was chosen, as text."""
        return self.solver.reason

    @property
    def method(self) -> str:
        """The name of the method in use."""
        return self.solver.engine.method

    # ------------------------------------------------------------ application

    @public("dp.inverse(op)")
    def __call__(self, b: Any, start: Any = None) -> Any:
        """Solve op(x) = b for a field b or a batch of fields; the result is differentiable in b.

        Parameters
        ----------
        b : array, shape (..., *`domain.shape`)
            Leading axes are a batch.
        start : array, shape `codomain.shape`, optional
            Initial guess for one field b, not for a batch. A good guess saves iterations of iterative methods. The
            derivative with respect to `start` is 0. Exception: with method="krylov" and diff="unrolled" the iterations
            are differentiated with respect to b and `start`.

        Returns
        -------
        array, shape (..., *`codomain.shape`)
        """
        if start is not None or self.solver.engine.unrolled:
            return self._solve_from(b, start)
        if active or isbox(b):
            return apply_operator(self, b)
        if type(b) is np.ndarray:  # as in `Operator.apply`; repeated here so that a call takes few steps
            solve = self._bound.get((b.shape, b.dtype))
            if solve is not None and b.flags.c_contiguous:
                return solve(b)
        return self.apply(b)

    def _bind(self, lead, dtype):
        """Return the function for arrays of this dtype with leading axes of shape `lead`: see `Operator.bound`."""
        structure = self.structure
        if lead or dtype != structure.dtype or structure.start is not None:
            return super()._bind(lead, dtype)
        # The solver can use one such field directly, without a conversion or a copy of the solution.
        solve = partial(structure.solver.solve, transposed=structure.transposed, checked=structure.checked)
        shape = self.codomain.shape
        return lambda b: solve(b.reshape(-1)).reshape(shape)

    @opaque
    def _solve_from(self, b: Any, start: Any) -> Any:
        """Solve from an initial guess, or by iterations that autograd records."""
        if start is not None:
            check_native(self.name, start)
            check_finite(f"the start of {self.name}", plain(start))
            check_on(f"{self.name}, as start,", start, self.codomain)
        structure = self.structure
        if self.solver.engine.unrolled:
            if np.ndim(b) > len(self.domain.shape):  # a batch: solve for one field after the other
                return anp.array([self(field, start) for field in b])
            return self.solver.unroll(b, start, structure.transposed)
        field_array(self, plain(b))  # raises ShapeError for a batch: a start belongs to one field
        start = np.asarray(plain(start)).reshape(-1)
        return Inverse(Solution(self.solver, structure.transposed, structure.checked, start))(b)

    # ------------------------------------------------------------ description

    def __repr__(self) -> str:
        return f"<{self.name}: {self.domain} -> {self.codomain}, {self.method}>"

    def _facts(self) -> dict[str, str]:
        """Return the labels and values that describe the set-up."""
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
