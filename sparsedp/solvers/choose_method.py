"""The methods of `inverse`: their options, the fixed rule of method "auto", and the set-up of the linear solver."""

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
from sparsedp.solvers.preconditioners import NearbyFactorization, krylov_engine
from sparsedp.solvers.records import failure
from sparsedp.solvers.separable import find_eigenbasis, separable_engine, transform_engine
from sparsedp.solvers.structured_multigrid.engine import structured_engine, structured_if_suited
from sparsedp.solvers.substitution import BlockTriangular, largest_block

if TYPE_CHECKING:
    from collections.abc import Sequence

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


def schur_engine(system: System) -> Engine:
    """Build the solver for systems with multipliers: see saddle_point.py, which is imported on first use."""
    from sparsedp.solvers import saddle_point

    return saddle_point.schur_engine(system)


# For each method the function that builds its solver (an Engine). The function takes a System, and the options of the
# method as keyword-only arguments.
METHODS: dict[str, Any] = {
    "separable": separable_engine,
    "direct": direct_engine,
    "structured": structured_engine,
    "multigrid": multigrid_engine,
    "krylov": krylov_engine,
    "schur": schur_engine,
}
# Functions that check the option values of a method. They are called when substitution solves for all unknowns: the
# method itself is then not set up, so nothing else would check its options.
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

# In 2-D and 3-D, "separable" is chosen from SEPARABLE_FROM unknowns on. Axes that need a dense matrix of eigenvectors
# may have at most LONGEST_EIGENVECTORS of them.
SEPARABLE_FROM = 1024
LONGEST_EIGENVECTORS = 2048

# Largest number of unknowns for which sparse LU is chosen, for each dimension of the grid (0: no grid). The set-up is
# used for "many" solves or for a "few", about two. Measured at 512^2: the set-up of LU takes 5 times as long as that of
# multigrid, and a solve a sixth of the time. In 3-D, LU and multigrid take the same time at 32^3.
DIRECT_UP_TO = {
    "many": {0: 50_000, 1: 10_000_000, 2: 262_144, 3: 13_824},
    "few": {0: 10_000, 1: 10_000_000, 2: 16_384, 3: 2_000},
}

# The same limits for operators that structured multigrid can solve. Measured in 3-D, LU relative to structured
# multigrid: at 16^3 the set-up takes 5 times as long and a solve a third of the time; at 24^3 the set-up takes 26 times
# and a solve 1.3 times as long.
DIRECT_BELOW_STRUCTURED = {"many": {1: 10_000_000, 2: 16_384, 3: 4_096}, "few": {1: 10_000_000, 2: 4_096, 3: 1_000}}

# From this number of unknowns on, "schur" is chosen for flows in 3-D. LU factors of a driven cavity of more than 20^3
# cells do not fit into memory.
SCHUR_FROM = 34_000

# The same limits for matrices with complex entries, which multigrid cannot solve. Measured for the value and gradient
# of a wave problem: at 2048^2 LU takes 96 s and 8.3 GB, and GMRES does not converge. At 32^3 LU takes 5 s and 0.6 GB,
# and GMRES 2 s and 0.3 GB. At 48^3 LU takes 67 s and 2.7 GB, and GMRES 7 s and 0.7 GB.
COMPLEX_UP_TO = {0: 1_048_576, 1: 10_000_000, 2: 4_194_304, 3: 27_000}


class Choice(NamedTuple):
    """The method that was chosen for a linear system.

    Attributes
    ----------
    method : str
    reason : str
        Why this method was chosen, as ``print(inv)`` shows it.
    engine : Engine, optional
        The solver for the coupled unknowns, with default options, if the choice required building it.
    """

    method: str
    reason: str
    engine: Engine | None = None


# ---- settings ----


COMMON_OPTIONS = ("rtol", "maxiter", "nullspace")  # options of every method


@dataclass(frozen=True, eq=False)
class SolveSettings:
    """The checked settings of a solve; see `inverse`."""

    method: str
    rtol: float
    maxiter: int | None
    nullspace: str
    options: dict[str, Any]


def check_settings(
    method: str,
    rtol: float,
    maxiter: int | None,
    nullspace: str,
    options: dict[str, Any],
    common: Sequence[str] = COMMON_OPTIONS,
) -> SolveSettings:
    """Check the settings of a solve; `common` are the names of the options that do not depend on the method."""
    check_choice("method", method, ("auto", *METHODS), _method_advice(method))
    rtol = check_number("rtol", rtol, "between 0 and 1", "; the default is 1e-10")
    if maxiter is not None:
        maxiter = check_whole("maxiter", maxiter, 1, "; None leaves it to the method")
    check_choice("nullspace", nullspace, ("raise", "project"))
    check_options(method, options, common)
    return SolveSettings(method, rtol, maxiter, nullspace, copied(options))


def _method_advice(method: Any) -> str:
    """Return advice for an invalid `method`, such as a right-hand side or the name that another library uses."""
    if isinstance(method, np.ndarray):
        return "; write dp.inverse(op)(b) for a right-hand side b"
    if isinstance(method, str) and method in SYNONYMS:
        return f"; write {SYNONYMS[method]!r}"
    return ""


def check_options(method: str, options: dict[str, Any], common: Sequence[str] = COMMON_OPTIONS) -> None:
    """Raise TypeError for an option that the method does not take; for "auto", that no method takes."""
    builders = METHODS.values() if method == "auto" else [METHODS[method]]
    parameters = [parameter for build in builders for parameter in inspect.signature(build).parameters.values()]
    names = list(dict.fromkeys(parameter.name for parameter in parameters if parameter.kind == parameter.KEYWORD_ONLY))
    for name in options:
        if name not in names:
            advice = advice_near(name, [*common, *names, "method"])
            listed = ", ".join([*common, *names])
            raise TypeError(f"method {method} takes the options {listed}, got {name!r}{advice}")


def check_unknowns(system: System) -> None:
    """Raise ConvergenceError if a column of the operator is empty while the row with the same number is not."""
    number = system.unused_unknown
    if number is not None:
        raise ConvergenceError(
            f"row {number} of {system.unscaled} has entries, but unknown {number} is used in no row, so that this "
            "equation would be ignored; use the unknown in a row, or leave the equation out: "
            "dp.mask(A.codomain, keep) @ A",
            info=failure("empty_column"),
        )


# ---- set-up of a method ----


def engine_of(system: System, choice: Choice, options: dict[str, Any], near: Engine | None = None) -> Engine:
    """Build the solver (an Engine) of the chosen method.

    Parameters
    ----------
    system : System
    choice : Choice
    options : dict
    near : Engine, optional
        The solver of a similar matrix. The direct method uses its LU factors as a preconditioner.

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
        _ = system.null_space  # computed now, so that a failure is reported as one of the set-up
    except ArithmeticError as error:
        message = f"{system.unscaled} is singular and cannot be projected: {error}; add a shift"
        raise ConvergenceError(message, info=failure("setup_failed")) from None
    return engine


def _engine(system: System, choice: Choice, options: dict[str, Any], near: Engine | None) -> Engine:
    """Build the solver of a nonempty system; unknowns that are not coupled to others are found by substitution."""
    method = choice.method
    if system.splitting is not None:
        if system.coupled.unknowns:
            return BlockTriangular(system, engine_of(system.coupled, choice, options, getattr(near, "inner", near)))
        OPTION_CHECKS[method](**options)
        return BlockTriangular(system, None)
    if near is not None and method == "direct":
        return NearbyFactorization(system, getattr(near, "lu", near))
    if choice.engine is not None and not options:
        return choice.engine
    build: Any = system.engine_builder or METHODS[method]
    return build(system, **options)


# ---- the rule of "auto" ----


def choose_method(system: System, solves: str) -> Choice:
    """Choose a method by a fixed rule that uses only the operator and `solves`, so that results are reproducible.

    Parameters
    ----------
    system : System
    solves : "many" or "few"
        How many solves are expected to use this set-up.
    """
    structure = system.op.structure
    grid = system.op.domain.grid
    dimension = 0
    if grid is not None:
        dimension = grid.dim
    engine = _transforms(system, dimension)
    if engine is not None:
        system.splitting = None  # the transforms solve for all unknowns at once
        kind = "a sum of 1-D factors" if structure.separable else "a function of a sum of 1-D factors"
        reason = f"{system.unknowns} unknowns in {dimension}-D, {kind}: transforms solve it exactly"
        return Choice("separable", reason, engine)
    if not structure.has_entries:
        return Choice("krylov", "only products with the operator are known")
    if _is_large_flow(system):
        system.splitting = None  # the cycles of the fields take all unknowns
        size = _size_in_words(system, "", 3)
        return Choice("schur", f"{size}, of which some are multipliers, such as a pressure: LU costs more")
    splitting = _splitting(system)
    if splitting is None:
        return _choose_by_entries(system, solves, dimension, "")
    if not system.coupled.unknowns:
        size = _size_in_words(system, "", dimension)
        return Choice("direct", f"{size}: the system is triangular, substitution solves it")
    return _choose_by_entries(system.coupled, solves, dimension, f", {splitting.size} others by substitution")


def _is_large_flow(system: System) -> bool:
    """Return whether a system has several fields in 3-D, of which one is a multiplier, and is too large for LU."""
    parts = system.op.domain.parts
    if len(parts) < 2 or max(map(len, parts)) != 3 or system.complex:
        return False
    if system.unknowns <= SCHUR_FROM:
        return False
    from sparsedp.solvers.saddle_point import find_multipliers

    return bool(find_multipliers(system).any())


def _transforms(system: System, dimension: int) -> Engine | None:
    """Return the transform solver if the operator is (a function of) a sum of 1-D factors and it is fast; else None."""
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
    """Return the Splitting of a system, or None.

    Also return None if computing it raises ArithmeticError: the set-up that follows reports the singular system.
    """
    try:
        return system.splitting
    except ArithmeticError:
        return None


def _choose_by_entries(system: System, solves: str, dimension: int, others: str) -> Choice:
    """Choose a method for a system whose matrix entries are known and that no transform solves.

    `others` is a phrase about the unknowns outside this system, which are found by substitution; it may be empty.
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
    """Return a phrase with the number of unknowns, their kind, and the dimension of the grid."""
    place = f"in {dimension}-D" if dimension else "without a grid"
    return f"{system.unknowns} {kind}unknowns {place}"


def _largest_factored(system: System) -> int:
    """Return the number of unknowns in the largest diagonal block that LU must factor."""
    if system.faces is not None:
        return system.unknowns
    largest, triangular = largest_block(system.matrix)
    if not triangular:
        return system.unknowns
    return largest
