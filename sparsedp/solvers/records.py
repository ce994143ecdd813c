"""Records of solves: the content of `inv.info`, and of the attribute `info` of errors that solves raise."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from sparsedp._utils.html import facts, table

if TYPE_CHECKING:
    from sparsedp._utils.html import Markup

__all__ = ["STATUS_WORDS", "SolveInfo", "SolveLog", "failure", "merged"]

STATUS_WORDS = (  # from best to worst: the merged record of two solves has the worse status
    "exact_zero_rhs",
    "converged",
    "converged_at_roundoff",
    "max_iterations",
    "stagnated",
    "diverged",
    "indefinite_operator",
    "incompatible_rhs",
    "empty_row",
    "empty_column",
    "nonfinite_input",
    "nonfinite_output",
    "not_representable",
    "setup_failed",
)


@dataclass(frozen=True)
class SolveInfo:
    """The record of one solve.

    Attributes
    ----------
    status : str
        One of STATUS_WORDS.
    iterations : int
        0 for direct methods.
    residual : float
        True relative residual |b - A x| / |b|, computed from the solution.
    backward_error : float
        |b - A x| / (|A| |x| + |b|).
    defect : float
        Component of the right-hand side outside the range, relative to its norm: |l.b| / (|l| |b|) with the left null
        vector l. It is the largest value over all singular components of the operator.
    seconds : float
    """

    status: str
    iterations: int
    residual: float
    backward_error: float
    defect: float
    seconds: float

    def _repr_html_(self) -> Markup:
        """Return a table for notebooks."""
        return facts("solve", asdict(self))


@dataclass(slots=True)
class SolveLog:
    """Records of the last forward and the last adjoint solve of an inverse, by any thread, and of its set-up.

    Attributes
    ----------
    forward, adjoint : SolveInfo or None
        None before the first solve.
    setup_seconds : float
    hierarchy : str
        Description of the set-up: levels, unknowns, matrix entries.
    """

    forward: SolveInfo | None = None
    adjoint: SolveInfo | None = None
    setup_seconds: float = 0.0
    hierarchy: str = ""

    def note(self, info: SolveInfo, transposed: bool) -> None:
        """Record a solve."""
        if transposed:
            self.adjoint = info
        else:
            self.forward = info

    def last(self, transposed: bool) -> SolveInfo | None:
        """Return the record of the last adjoint or forward solve, None before the first one."""
        return self.adjoint if transposed else self.forward

    def _repr_html_(self) -> Markup:
        """Return a table of both solves for notebooks."""
        records = {"forward": self.forward, "adjoint": self.adjoint}
        rows = [{"": name, **asdict(info)} for name, info in records.items() if info]
        head = list(rows[0]) if rows else []
        title = f"set-up {self.setup_seconds:.2g} s"
        if self.hierarchy:
            title = f"{title}: {self.hierarchy}"
        return table([row.values() for row in rows], head, title)


def failure(status: str) -> SolveInfo:
    """Return the record of a set-up that failed."""
    return SolveInfo(status, 0, 0.0, 0.0, 0.0, 0.0)


def merged(one: SolveInfo, other: SolveInfo) -> SolveInfo:
    """Return one record for two solves: iterations and seconds are added, of other values the worse is taken."""
    return SolveInfo(
        max(one.status, other.status, key=STATUS_WORDS.index),
        one.iterations + other.iterations,
        max(one.residual, other.residual),
        max(one.backward_error, other.backward_error),
        max(one.defect, other.defect),
        one.seconds + other.seconds,
    )
