"""Methods of `inverse`: their options, the fixed rule by which "auto" chooses one, and the set-up of its engine."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sparsedp._utils.calls import advice_near
from sparsedp._utils.pytree import copied
from sparsedp._utils.validation import check_choice, check_number, check_whole
from sparsedp.errors import ConvergenceError
from sparsedp.solvers.algebraic_multigrid import check_multigrid_options, multigrid_engine
from sparsedp.solvers.direct import check_precision, direct_engine
from sparsedp.solvers.engine import EmptySystem
from sparsedp.solvers.preconditioners import Near, krylov_engine
from sparsedp.solvers.records import failure
from sparsedp.solvers.separable import find_eigenbasis, separable_engine, transform_engine
from sparsedp.solvers.structured_multigrid.engine import structured_engine, structured_if_suited
from sparsedp.solvers.substitution import BlockTriangular, largest_block

if TYPE_CHECKING:
    from sparsedp.solvers.engine import Engine
    from sparsedp.solvers.substitution import Splitting
    from sparsedp.solvers.system import System

__all__ = [
    "METHODS",
    "Choice",
    "SolveSettings",
    "check_options",
    "check_settings",
    "check_unknowns",
    "choose_method",
    "engine_of",
]

# Each method with the function that builds its engine: from a System, and options that are keyword-only.
METHODS: dict[str, Any] = {
    "separable": separable_engine,
    "direct": direct_engine,
    "structured": structured_engine,
    "multigrid": multigrid_engine,
    "krylov": krylov_engine,
}
# Functions that refuse values of options of a method that has nothing to solve.
OPTION_CHECKS: dict[str, Any] = {
    "direct": check_precision,
    "structured": check_precision,
    "multigrid": check_multigrid_options,
}
# Names that other libraries use for the methods.
SYNONYMS = {
    "cg": "krylov",
    "gmres": "krylov",
    "amg": "multigrid",
    "mg": "structured",
    "lu": "direct",
    "fft": "separable",
}

# Transforms are chosen from this number of unknowns on, in 2-D and 3-D, while the axes that need dense eigenvectors are
# not longer than this.
SEPARABLE_FROM = 1024
LONGEST_EIGENVECTORS = 2048

# Largest number of unknowns for which kept LU factors are chosen, by dimension (0: no grid), when one set-up serves
# many solves, and when it serves two. Measured: at 512^2 LU costs 5 times the set-up of multigrid and a sixth of its
# solve; in 3-D both cost the same at 32^3.
DIRECT_UP_TO = {
    "many": {0: 50_000, 1: 10_000_000, 2: 262_144, 3: 13_824},
    "few": {0: 10_000, 1: 10_000_000, 2: 16_384, 3: 2_000},
}

# The same where structured multigrid is possible. Measured in 3-D: at 16^3 LU takes 5 times its set-up and a third
# of its solve, at 24^3 26 times and 1.3 times.
DIRECT_BELOW_STRUCTURED = {"many": {1: 10_000_000, 2: 16_384, 3: 4_096}, "few": {1: 10_000_000, 2: 4_096, 3: 1_000}}

# The same for complex entries, which multigrid does not take. Measured, value and gradient of waves: LU 96 s and 8.3 GB
# at 2048^2, where GMRES does not converge; in 3-D 5 s and 0.6 GB at 32^3 and 67 s and 2.7 GB at 48^3, GMRES 2 s
# and 0.3 GB, 7 s and 0.7 GB.
COMPLEX_UP_TO = {0: 1_048_576, 1: 10_000_000, 2: 4_194_304, 3: 27_000}


class Choice(NamedTuple):
    """The method of a solve.

    Attributes
    ----------
    method : str
    reason : str
        In words, for ``print(inv)``.
    engine : Engine, optional
        Of the coupled unknowns, without options, if it was built to decide.
    """

    method: str
    reason: str
    engine: Engine | None = None


# ---- settings ----


@dataclass(frozen=True, eq=False)
class SolveSettings:
    """The checked settings of a solve; see `inverse`."""

    method: str
    rtol: float
    maxiter: int | None
    nullspace: str
    options: dict[str, Any]


def check_settings(
    method: str, rtol: float, maxiter: int | None, nullspace: str, options: dict[str, Any]
) -> SolveSettings:
    """Check the settings of a solve."""
    check_choice("method", method, ("auto", *METHODS), _method_advice(method))
    rtol = check_number("rtol", rtol, "between 0 and 1", "; the default is 1e-10")
    if maxiter is not None:
        maxiter = check_whole("maxiter", maxiter, 1, "; None leaves it to the method")
    check_choice("nullspace", nullspace, ("raise", "project"))
    check_options(method, options)
    return SolveSettings(method, rtol, maxiter, nullspace, copied(options))


def _method_advice(method: Any) -> str:
    """Return advice for a wrong method: a right-hand side in its place, or the name of another library."""
    if isinstance(method, np.ndarray):
        return "; write dp.inverse(op)(b) for a right-hand side b"
    if isinstance(method, str) and method in SYNONYMS:
        return f"; write {SYNONYMS[method]!r}"
    return ""


def check_options(method: str, options: dict[str, Any]) -> None:
    """Refuse options that a method, or with "auto" every method, does not take."""
    builders = METHODS.values() if method == "auto" else [METHODS[method]]
    parameters = [parameter for build in builders for parameter in inspect.signature(build).parameters.values()]
    names = list(dict.fromkeys(parameter.name for parameter in parameters if parameter.kind == parameter.KEYWORD_ONLY))
    for name in options:
        if name not in names:
            advice = advice_near(name, [*names, "rtol", "maxiter", "method", "nullspace"])
            raise TypeError(f"method {method} takes the options {', '.join(names) or '(none)'}, got {name!r}{advice}")


def check_unknowns(system: System) -> None:
    """Refuse an operator with an unknown that no row uses, while its own row has entries."""
    number = system.unused_unknown
    if number is not None:
        raise ConvergenceError(
            f"row {number} of {system.unscaled} has entries, but unknown {number} is used in no row, so that this "
            "equation would be ignored; use the unknown in a row, or leave the equation out: "
            "dp.mask(A.codomain, keep) @ A",
            info=failure("empty_column"),
        )


# ---- the engine of a method ----


def engine_of(system: System, choice: Choice, options: dict[str, Any], near: Engine | None = None) -> Engine:
    """Build the engine of a method.

    Parameters
    ----------
    system : System
    choice : Choice
    options : dict
    near : Engine, optional
        The engine of a matrix close to this one, for the direct method.

    Raises
    ------
    ConvergenceError
        If the operator cannot be inverted.
    """
    if system.unknowns == 0:
        return EmptySystem()
    if system.empty_row is not None:
        raise ConvergenceError(
            f"row {system.empty_row} of {system.unscaled} has no entries, but its unknown is used in other rows; "
            "give it an equation",
            info=failure("empty_row"),
        )
    try:
        engine = _engine(system, choice, options, near)
        _ = system.null_space  # found here, so that its failure is one of the set-up
    except ArithmeticError as error:
        message = f"{system.unscaled} is singular and cannot be projected: {error}; add a shift"
        raise ConvergenceError(message, info=failure("setup_failed")) from None
    return engine


def _engine(system: System, choice: Choice, options: dict[str, Any], near: Engine | None) -> Engine:
    """Build the engine of a system with unknowns, with substitution around it for those that are not coupled."""
    method = choice.method
    if system.splitting is not None:
        if system.coupled.unknowns:
            return BlockTriangular(system, engine_of(system.coupled, choice, options, getattr(near, "inner", near)))
        OPTION_CHECKS[method](**options)
        return BlockTriangular(system, None)
    if near is not None and method == "direct":
        return Near(system, getattr(near, "lu", near))
    if choice.engine is not None and not options:
        return choice.engine
    build: Any = system.engine_builder or METHODS[method]
    return build(system, **options)


# ---- the rule of "auto" ----


def choose_method(system: System, solves: str) -> Choice:
    """Choose a method by a fixed rule that depends on the operator alone, so that results are reproducible.

    Parameters
    ----------
    system : System
    solves : "many" or "few"
        How many solves are expected of the set-up.
    """
    structure = system.op.structure
    grid = system.op.domain.grid
    dimension = 0
    if grid is not None:
        dimension = grid.dim
    engine = _transforms(system, dimension)
    if engine is not None:
        system.splitting = None  # transforms solve for all unknowns
        kind = "a sum of 1-D factors" if structure.separable else "a function of a sum of 1-D factors"
        reason = f"{system.unknowns} unknowns in {dimension}-D, {kind}: transforms solve it exactly"
        return Choice("separable", reason, engine)
    if not structure.has_entries:
        return Choice("krylov", "only products with the operator are known")
    splitting = _splitting(system)
    if splitting is None:
        return _choose_by_entries(system, solves, dimension, "")
    if not system.coupled.unknowns:
        size = _size_in_words(system, "", dimension)
        return Choice("direct", f"{size}: the system is triangular, substitution solves it")
    return _choose_by_entries(system.coupled, solves, dimension, f", {splitting.size} others by substitution")


def _transforms(system: System, dimension: int) -> Engine | None:
    """Return the engine of a sum of 1-D factors, or a function of one, if transforms along them are fast; else None."""
    structure = system.op.structure
    is_small = dimension < 2 or system.size < SEPARABLE_FROM
    if (structure.has_entries and is_small) or system.active is not None:
        return None
    basis = find_eigenbasis(structure)
    if basis is None:
        return None
    lengths = [axis.eigenvalues.size for axis in basis[0].axes if axis.kind == "eigenvectors"]
    if max(lengths, default=0) > LONGEST_EIGENVECTORS:
        return None
    return transform_engine(system, *basis)


def _splitting(system: System) -> Splitting | None:
    """Return the Splitting of a system or None; None for a singular one, which is refused when the engine is built."""
    try:
        return system.splitting
    except ArithmeticError:
        return None


def _choose_by_entries(system: System, solves: str, dimension: int, others: str) -> Choice:
    """Choose a method for a system with entries that no transform solves.

    `others` describes the unknowns that substitution finds and that are not in this system.
    """
    kind = "coupled " if others else ""
    if system.complex:
        return _choose_for_complex_entries(system, dimension, kind, others)
    unknowns = system.unknowns
    size = _size_in_words(system, kind, dimension) + others

    unsuited = ""
    if unknowns > DIRECT_BELOW_STRUCTURED[solves].get(dimension, 0):
        engine, unsuited = structured_if_suited(system)
        if engine is not None:
            reason = f"{size}, coefficients or obstacles that no transform takes: multigrid on the grid itself"
            return Choice("structured", reason, engine)

    limit = DIRECT_UP_TO[solves][dimension]
    if unknowns <= limit:
        return Choice("direct", f"{size}; up to {limit}, for {solves} solves, kept LU factors are fastest")
    largest = _largest_factored(system)
    if largest <= limit:
        reason = f"{size}, in blocks of at most {largest}, one after the other; up to {limit}, LU is fastest"
        return Choice("direct", reason)

    size = f"{size}; {unsuited}; above {limit}, for {solves} solves, LU costs more"
    if not system.sign:
        return Choice("direct", f"{size}; the diagonal has no single sign, which rules multigrid out")
    try:
        multigrid = multigrid_engine(system)
    except ConvergenceError:
        return Choice("direct", f"{size}; but multigrid does not coarsen it")
    return Choice("multigrid", f"{size}; the diagonal has one sign", multigrid)


def _choose_for_complex_entries(system: System, dimension: int, kind: str, others: str) -> Choice:
    """Choose a method for a system with complex entries."""
    limit = COMPLEX_UP_TO[dimension]
    if system.unknowns <= limit:
        return Choice("direct", f"complex entries{others}")
    largest = _largest_factored(system)
    if largest <= limit:
        return Choice("direct", f"complex entries{others}, in blocks of at most {largest} unknowns")
    engine = krylov_engine(system, preconditioner="shifted_laplace")
    size = _size_in_words(system, f"{kind}complex ", dimension) + others
    return Choice("krylov", f"{size}: LU would not fit, GMRES and shifted Laplace do", engine)


def _size_in_words(system: System, kind: str, dimension: int) -> str:
    """Return the number of unknowns of some kind and the dimension of the grid in words."""
    place = f"in {dimension}-D" if dimension else "without a grid"
    return f"{system.unknowns} {kind}unknowns {place}"


def _largest_factored(system: System) -> int:
    """Return the number of unknowns of the largest block that LU factors take together."""
    if system.faces is not None:
        return system.unknowns
    largest, triangular = largest_block(system.matrix)
    if not triangular:
        return system.unknowns
    return largest
