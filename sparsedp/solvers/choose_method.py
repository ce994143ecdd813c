"""inverse(op): which method solves, by a fixed rule, with its reason in words."""

import inspect
from copy import deepcopy
from time import perf_counter
from typing import Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.calls import advice_near, public
from sparsedp._utils.counters import count, spent
from sparsedp._utils.html import facts
from sparsedp._utils.pytree import copied
from sparsedp._utils.validation import (
    check_choice,
    check_finite,
    check_native,
    check_number,
    check_on,
    check_whole,
    field_array,
)
from sparsedp.autodiff.fast_derivatives import together
from sparsedp.autodiff.tape import plain
from sparsedp.errors import ConvergenceError, NonFiniteError, ShapeError
from sparsedp.grid.space import fits
from sparsedp.operators.given import check_operator
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Structure
from sparsedp.solvers.amg import check_multigrid_options, multigrid_engine
from sparsedp.solvers.direct import DenseSystem, check_precision, dense_engine, direct_engine
from sparsedp.solvers.multigrid.engine import structured_engine, structured_if_suited
from sparsedp.solvers.preconditioners import Near, krylov_engine
from sparsedp.solvers.separable import eigenbasis, separable_engine, transforming
from sparsedp.solvers.solve import EmptySystem, SolveLog, Solver, failure, merged
from sparsedp.solvers.system import System

__all__ = ["Inverse", "METHODS", "build", "build_dense", "check_settings", "inverse"]

# word -> function (system, **options) -> engine; see solve.py. Options are keyword-only.
METHODS = {
    "separable": separable_engine,
    "direct": direct_engine,
    "structured": structured_engine,
    "multigrid": multigrid_engine,
    "krylov": krylov_engine,
}
# What refuses the values of options where the method itself is not needed.
CHECKS = {"direct": check_precision, "structured": check_precision, "multigrid": check_multigrid_options}
MEANT = {"cg": "krylov", "gmres": "krylov", "amg": "multigrid", "mg": "structured", "lu": "direct", "fft": "separable"}

FRAMES = 10  # calls inside of a solve, in units of those that a nested product or sum takes

# Transforms win from this number of unknowns on, in 2-D and 3-D, while the axes that need dense
# eigenvectors are not longer than this.
SEPARABLE_FROM, LONGEST_EIGENVECTORS = 1024, 2048

# Largest number of unknowns for which a kept LU is chosen, by dimension (0: no grid known): when one
# set-up serves many solves, and when it serves two. Measured: at 512^2 LU costs 5 times the set-up of
# multigrid and a sixth of its solve; in 3-D the two meet at 32^3.
DIRECT_UP_TO = {
    "many": {0: 50_000, 1: 10_000_000, 2: 262_144, 3: 13_824},
    "few": {0: 10_000, 1: 10_000_000, 2: 16_384, 3: 2_000},
}

# The same where structured multigrid is possible. Measured in 3-D: at 16^3 LU takes 5 times its set-up and a third
# of its solve, at 24^3 26 times and 1.3 times.
DIRECT_BELOW_STRUCTURED = {"many": {1: 10_000_000, 2: 16_384, 3: 4_096}, "few": {1: 10_000_000, 2: 4_096, 3: 1_000}}


# The same for complex entries, which multigrid does not take. Measured, value and gradient of waves: LU 96 s and 8.3 GB
# at 2048^2, where GMRES comes to no end; in 3-D 5 s and 0.6 GB at 32^3 and 67 s and 2.7 GB at 48^3, GMRES 2 s
# and 0.3 GB, 7 s and 0.7 GB.
COMPLEX_UP_TO = {0: 1_048_576, 1: 10_000_000, 2: 4_194_304, 3: 27_000}


def inverse(op, method="auto", rtol=1e-10, maxiter=None, nullspace="raise", **options):
    """Operator -> its inverse, an Operator: x = inv(b) solves op(x) = b, inv.T(g) the transposed system.

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
        What to do with data outside the range of a singular operator: refuse it, or take that part out.
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
        krylov      iterations      None        exactly so many, whatever the residual
        structured  precision       "auto"      "single" or "double", of the cycle
        direct      precision       "auto"      "single" or "double", of the factors
        ==========  ==============  ==========  =================================================================

    Returns
    -------
    Inverse
        in: b on the codomain of `op`; out: x on its domain. `inv.info` holds the records of the last
        forward and adjoint solve. The set-up is done here, once.

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

    Notes
    -----
    Null space: one vector for each connected component, found from the entries. Data are projected
    with it, and the solution has volume-weighted mean 0 on each singular component; see nullspace.py.
    Transpose: `inv.T` uses the same set-up, is exact to rtol, and never refuses.
    Triangular parts: "direct", "structured", "multigrid" and "auto" find the unknowns that follow from known ones, and
    those that no other equation uses, by substitution; only the coupled ones are factored or iterated on. A system
    that is triangular in some order, such as a chain or upwind differences, takes one pass over its entries.
    Memory: the coarsest level of "multigrid" is a dense matrix of at most 2000 unknowns; a larger one is refused.
    Threads: several may solve at once, to the same bits; `inv.info` is of the solve that ended last.

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
    return together("inverse", (op,), lambda: build(op, **settings))


def build(op, method, rtol, maxiter, nullspace, options, name=None, log=None, solves="many", near=None, all_rows=True):
    """The set-up behind `inverse`, for callers that name it, keep its log, or expect "few" solves of it.

    `near`: the engine of a matrix nearby, whose LU may do. `all_rows`: refuse an operator with a row whose
    own unknown no row uses; False if the caller tests the residual of such rows itself, or leaves them out on purpose.
    """
    clock = perf_counter()
    if op.layout is not None:
        system = op.layout.system(op, rtol, maxiter, method, options)
        word, reason, engine = "petsc", str(op.layout), None
    else:
        system = System(op, rtol, maxiter)
        if method in ("krylov", "separable"):
            system.splitting = None  # these solve for all unknowns, without looking at the entries
        word, reason, engine = (method, "as asked", None) if method != "auto" else _chosen(system, solves)
        _check_options(word, options)
    if system.complex and word not in ("direct", "krylov"):
        raise ValueError(f"{word} takes real operators, {op} is complex; write method='direct' or 'krylov'")
    if all_rows:
        _check_unknowns(system)
    engine = _engine(system, word, options, engine, near)
    name = name or f"inverse({op.name})"
    made = build, (op, method, rtol, maxiter, nullspace, options, name, None, solves, None, all_rows)
    solver = Solver(system, engine, nullspace, log or SolveLog(), name, made, reason)
    return Inverse(Solution(_set_up(solver, clock)))


def build_dense(op, rtol, nullspace, name):
    """Small explicit Operator -> Solver; None where it may be singular."""
    clock = perf_counter()
    engine = dense_engine(system := DenseSystem(op, rtol))
    if engine is None:
        return None
    return _set_up(Solver(system, engine, nullspace, SolveLog(), name, None, "a small full matrix"), clock)


def _set_up(solver, clock):
    """The Solver, its set-up noted, which began at this time."""
    log, name = solver.log, solver.name
    log.setup_seconds, log.hierarchy = perf_counter() - clock, solver.engine.hierarchy
    count(name, "setup")
    count(name, "hierarchy", int(solver.engine.hierarchical))
    spent(name, "setup", log.setup_seconds, log.setup_seconds)
    return solver


def check_settings(method, rtol, maxiter, nullspace, options):
    """Refuse settings that the method, or with "auto" every method, cannot take -> them, as keywords of `build`."""
    check_choice("method", method, ("auto", *METHODS), _advice(method))
    rtol = check_number("rtol", rtol, "between 0 and 1", "; the default is 1e-10")
    if maxiter is not None:
        maxiter = check_whole("maxiter", maxiter, 1, "; None leaves it to the method")
    check_choice("nullspace", nullspace, ("raise", "project"))
    _check_options(method, options)
    return dict(method=method, rtol=rtol, maxiter=maxiter, nullspace=nullspace, options=copied(options))


def _advice(method):
    """Advice for what is no method: the method of another name, or where a field belongs."""
    if isinstance(method, np.ndarray):
        return "; write dp.inverse(op)(b) for a right-hand side b"
    return f"; write {MEANT[method]!r}" if isinstance(method, str) and method in MEANT else ""


def _check_options(word, options):
    makers = METHODS.values() if word == "auto" else [METHODS[word]]
    parameters = [p for make in makers for p in inspect.signature(make).parameters.values()]
    known = list(dict.fromkeys(p.name for p in parameters if p.kind == p.KEYWORD_ONLY))
    for name in options:
        if name not in known:
            near = advice_near(name, [*known, "rtol", "maxiter", "method", "nullspace"])
            raise TypeError(f"method {word} takes the options {', '.join(known) or '(none)'}, got {name!r}{near}")


def _check_unknowns(system):
    """Refuse an operator with an unknown that no row uses, while its own row has entries."""
    number = system.unused_unknown
    if number is not None:
        raise ConvergenceError(
            f"row {number} of {system.given} has entries, but unknown {number} is used in no row, so that this "
            "equation would be ignored; use the unknown in a row, or leave the equation out: "
            "dp.mask(A.codomain, keep) @ A",
            info=failure("empty_column"),
        )


def _engine(system, word, options, suited=None, near=None):
    """Build the engine of a method.

    Parameters
    ----------
    system : System
    word : str
    options : dict
    suited : Engine, optional
        That of the coupled unknowns without options, if it has been built to see whether it suits.
    near : Engine, optional
        That of a matrix nearby, for the direct method.
    """
    if system.unknowns == 0:
        return EmptySystem()
    if system.empty_row is not None:
        raise ConvergenceError(
            f"row {system.empty_row} of {system.given} has no entries, but its unknown is used in other rows; "
            "give it an equation",
            info=failure("empty_row"),
        )
    try:
        if system.splitting is not None:
            from sparsedp.solvers.substitution import BlockTriangular

            inner = None
            if system.coupled.unknowns:
                inner = _engine(system.coupled, word, options, suited, getattr(near, "inner", near))
            else:
                CHECKS[word](**options)
            engine: Any = BlockTriangular(system, inner)
        elif near is not None and word == "direct":
            engine = Near(system, getattr(near, "lu", near))
        elif suited is None or options:
            engine = (system.make or METHODS[word])(system, **options)
        else:
            engine = suited
        return engine if system.null_space is not None else None
    except ArithmeticError as error:
        message = f"{system.given} is singular and cannot be projected: {error}; add a shift"
        raise ConvergenceError(message, info=failure("setup_failed")) from None


# ------------------------------------------------------------ the rule


def _chosen(system, solves):
    """The word of a method, why, and its engine if it is built. Depends on the operator only, so that bits repeat."""
    grid = system.op.domain.grid
    dimension = 0 if grid is None else grid.dim
    engine = _transforms(system, dimension)
    if engine is not None:
        what = "" if system.op.structure.separable else "a function of "
        reason = f"{system.unknowns} unknowns in {dimension}-D, {what}a sum of 1-D factors: transforms solve it exactly"
        return "separable", reason, engine
    if not system.op.structure.has_entries:
        return "krylov", "only products with the operator are known", None
    splitting = _splitting(system)
    if splitting is None:
        return _chosen_by_entries(system, solves, dimension, "")
    if not system.coupled.unknowns:
        where = _size_in_words(system, "", dimension)
        return "direct", f"{where}: the system is triangular, substitution solves it", None
    others = f", {splitting.size} others by substitution"
    return _chosen_by_entries(system.coupled, solves, dimension, others)


def _size_in_words(system, kind, dimension):
    """Return the number of unknowns of some kind and the dimension of the grid in words."""
    where = f"in {dimension}-D" if dimension else "without a grid"
    return f"{system.unknowns} {kind}unknowns {where}"


def _splitting(system):
    """Return the Splitting of a system or None; None for a singular one, which is refused when the engine is built."""
    try:
        return system.splitting
    except ArithmeticError:
        return None


def _chosen_by_entries(system, solves, dimension, others):
    """As `_chosen`, for a system with entries that no transform solves.

    `others`: words about the unknowns that are not in this system, because they are found by substitution.
    """
    size, kind = system.unknowns, "coupled " if others else ""
    if system.complex:
        limit = COMPLEX_UP_TO[dimension]
        if size <= limit:
            return "direct", "complex entries" + others, None
        largest = _largest_factored(system)
        if largest <= limit:
            return "direct", f"complex entries{others}, in blocks of at most {largest} unknowns", None
        engine = krylov_engine(system, preconditioner="shifted_laplace")
        where = _size_in_words(system, kind + "complex ", dimension) + others
        return "krylov", f"{where}: LU would not fit, GMRES and shifted Laplace do", engine
    where = _size_in_words(system, kind, dimension) + others
    limit = DIRECT_BELOW_STRUCTURED[solves].get(dimension, 0)
    engine, unsuited = (None, "") if size <= limit else structured_if_suited(system)
    if engine is not None:
        reason = f"{where}, coefficients or obstacles that no transform takes: multigrid on the grid itself"
        return "structured", reason, engine
    limit = DIRECT_UP_TO[solves][dimension]
    if size <= limit:
        return "direct", f"{where}; up to {limit}, for {solves} solves, kept LU factors are fastest", None
    largest = _largest_factored(system)
    if largest <= limit:
        return (
            "direct",
            f"{where}, in blocks of at most {largest}, one after the other; up to {limit}, LU is fastest",
            None,
        )
    where = f"{where}; {unsuited}; above {limit}, for {solves} solves, LU costs more"
    if not system.sign:
        return "direct", f"{where}; the diagonal has no single sign, which rules multigrid out", None
    try:
        engine = multigrid_engine(system)
    except ConvergenceError:
        return "direct", f"{where}; but multigrid does not coarsen it", None
    return "multigrid", f"{where}; the diagonal has one sign", engine


def _largest_factored(system):
    """Return the number of unknowns of the largest block that LU factors take together."""
    if system.faces is not None:
        return system.unknowns
    from sparsedp.solvers.substitution import largest_block

    largest, triangular = largest_block(system.matrix)
    return largest if triangular else system.unknowns


def _transforms(system, dimension):
    """The engine of a sum of 1-D factors or what is made of one, where transforms along them are cheap, else None."""
    structure = system.op.structure
    few = dimension < 2 or system.size < SEPARABLE_FROM
    if structure.has_entries and few or system.active is not None:
        return None
    found = eigenbasis(structure)
    dense = [] if found is None else [axis.eigenvalues.size for axis in found[0].axes if axis.kind == "eigenvectors"]
    return None if found is None or max(dense, default=0) > LONGEST_EIGENVECTORS else transforming(system, *found)


# ---- the inverse as an operator ----


class Solution(Structure):
    """The solve as a structure on flat arrays. Transposes and tangents share set-up and log.

    `checked`: primal data, which must be compatible with a singular operator. Transposes and tangents
    are not, so that a derivative of any order is projected and never refused. `start`: first guess, flat; they
    have none.
    """

    has_entries = False

    def __init__(self, solver, transposed=False, checked=True, start=None):
        self.solver, self.transposed, self.checked, self.start = solver, transposed, checked, start
        self.shape, self.dtype = (solver.system.size,) * 2, solver.system.op.dtype
        self.depth = solver.system.op.structure.depth + FRAMES

    def apply(self, x, out):
        """A^-1 x: solved in double precision, rounded once; of a real operator real and imaginary part apart."""
        if x.dtype.kind == "c" and not self.solver.system.complex:
            self._by_halves(x, out)
            return
        wide = np.result_type(x, float, self.dtype)
        start = None if self.start is None else self.start.astype(wide)
        solution = self.solver.solve(x.astype(wide, copy=False), self.transposed, self.checked, start)
        with np.errstate(over="ignore"):
            np.copyto(out, solution, casting="same_kind")
        if out.dtype != solution.dtype and not np.isfinite(self.solver.system.largest(np.abs(out))):
            raise NonFiniteError(f"the solution of {self.solver.name} is beyond {out.dtype}; give it double precision")

    def _by_halves(self, x, out):
        """Two solves of a real operator with complex data, and one record of both."""
        log, before, records = self.solver.log, self.solver.log.last(self.transposed), []
        for part in ("real", "imag"):
            start = None if self.start is None else getattr(self.start, part)
            half = np.empty_like(out.real)
            Solution(self.solver, self.transposed, self.checked, start).apply(getattr(x, part).copy(), half)
            getattr(out, part)[...] = half
            records.append(log.last(self.transposed))
        if records[0] is not before:  # an approximate solve leaves no record
            log.note(merged(*records), self.transposed)

    def transpose(self):
        return Solution(self.solver, not self.transposed, checked=False)

    def __deepcopy__(self, memo):
        return Solution(deepcopy(self.solver, memo), self.transposed, self.checked, deepcopy(self.start, memo))

    def tangent(self):
        warm = self.start is not None
        return Solution(self.solver, self.transposed, checked=False) if self.checked or warm else self


class Inverse(Operator):
    """The inverse of an Operator, as an Operator: ``inv(b)`` solves, ``inv.T(g)`` solves the transposed system.

    Made by `inverse`. For singular operators it is the generalised inverse that `nullspace.py` defines.

    Parameters
    ----------
    structure : Solution
    """

    structure: Solution
    solver: Solver

    def __init__(self, structure):
        solver, transposed = structure.solver, structure.transposed
        op = solver.system.given
        domain, codomain = (op.domain, op.codomain) if transposed else (op.codomain, op.domain)
        super().__init__(structure, domain, codomain, f"{solver.name}.T" if transposed else solver.name, "matrix-free")
        self.__dict__["solver"] = solver

    def _acting_as(self, structure, domain, codomain, name):
        return Inverse(structure)

    def recipe(self):
        """The call that makes it again: see _utils/reconstruction.py."""
        return Inverse, (self.structure,)

    @property
    def info(self):
        """SolveLog, shared with the transpose: .forward, .adjoint, .setup_seconds, .hierarchy.

        Complex data are two solves for a real operator, with one record: the sum of their iterations and seconds, and
        the worse of the rest.
        """
        return self.solver.log

    @property
    def reason(self):
        """Why this method, in words."""
        return self.solver.reason

    @property
    def method(self):
        """The word of the method in use."""
        return self.solver.engine.method

    # ------------------------------------------------------------ application

    @public("dp.inverse(op)")
    def __call__(self, b, start=None):
        """Solve; differentiable in b. `start`: first guess, which saves iterations of iterative methods.

        Implicit derivatives do not depend on `start`: the derivative in it is 0. With the option
        diff="unrolled" of krylov, the iterations themselves are differentiated, in b and in `start`.
        """
        if start is not None:
            check_native(self.name, start)
            check_finite(f"the start of {self.name}", plain(start))
            check_on(f"{self.name}, as start,", start, self.codomain)
        if self.solver.engine.unrolled:
            if np.ndim(b) > len(self.domain.shape):  # a batch: each solve has steps of its own
                return anp.array([self(field, start) for field in b])
            return self.solver.unroll(b, start, self.structure.transposed)
        if start is None:
            return super().__call__(b)
        field_array(self, plain(b))  # a start is for one field
        structure, start = self.structure, np.asarray(plain(start)).reshape(-1)
        return Inverse(Solution(self.solver, structure.transposed, structure.checked, start))(b)

    # ------------------------------------------------------------ words

    def __repr__(self):
        return f"<{self.name}: {self.domain} -> {self.codomain}, {self.method}>"

    def _facts(self):
        """How it solves, in words."""
        system, space = self.solver.system, self.solver.system.null_space
        return {
            "method": f"{self.method}: {self.reason}",
            "unknowns": f"{system.unknowns} of {system.size}{self._by_substitution()}",
            "tolerance": f"relative residual {system.rtol:g}",
            "null space": f"{space.count} singular component{'s' * (space.count != 1)}, {self.solver.nullspace!r}",
            "set-up": f"{self.info.setup_seconds:.2g} s; {self.info.hierarchy}",
        }

    def _by_substitution(self):
        splitting = self.solver.system.splitting
        return "" if splitting is None else f", {splitting.size} of them found by substitution"

    def __str__(self):
        lines = (f"  {name:10}  {words}" for name, words in self._facts().items())
        return "\n".join([f"{self.name}: {self.domain} -> {self.codomain}", *lines])

    def _repr_html_(self):
        """For a notebook: how it solves."""
        return facts(self.name, {"from": self.domain, "to": self.codomain, **self._facts()})
