"""What a solve leaves behind: the record of one solve, and the log that an inverse shares with its transpose."""

from dataclasses import dataclass
from time import perf_counter

__all__ = ["STATUS_WORDS", "Run", "SolveInfo", "SolveLog", "failure", "merged"]

# In order of gravity: of two solves (real and imaginary part) the later word is reported.
STATUS_WORDS = (
    "exact_zero_rhs",
    "converged",
    "converged_at_roundoff",
    "max_iterations",
    "stagnated",
    "diverged",
    "indefinite_operator",
    "nonsymmetric_operator",
    "incompatible_rhs",
    "empty_row",
    "nonfinite_input",
    "nonfinite_output",
    "not_representable",
    "setup_failed",
    "unstable_step",
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
        True relative residual |b - A x| / |b|, recomputed after the solve.
    backward_error : float
        |b - A x| / (|A| |x| + |b|).
    defect : float
        Part of the data along the null space, relative, largest over the components.
    seconds : float
    """

    status: str
    iterations: int
    residual: float
    backward_error: float
    defect: float
    seconds: float


class SolveLog:
    """The last forward and the last adjoint solve of an inverse, by whichever thread, and its set-up.

    Attributes
    ----------
    forward, adjoint : SolveInfo or None
        None before the first solve.
    setup_seconds : float
    hierarchy : str
        Size of what was set up: levels, unknowns, entries.
    """

    __slots__ = ("adjoint", "forward", "hierarchy", "setup_seconds")

    def __init__(self):
        self.forward = self.adjoint = None
        self.setup_seconds = 0.0
        self.hierarchy = ""

    def note(self, info, transposed):
        """Record a solve."""
        if transposed:
            self.adjoint = info
        else:
            self.forward = info

    def __repr__(self):
        return (
            f"SolveLog(forward={self.forward}, adjoint={self.adjoint}, "
            f"setup_seconds={self.setup_seconds:.3g}, hierarchy={self.hierarchy!r})"
        )


class Run:
    """The figures of a solve while it runs, and what was asked of it."""

    __slots__ = (
        "backward_error", "checked", "clock", "defect", "iterations", "residual", "rtol", "status", "transposed",
    )  # fmt: skip

    def __init__(self, transposed=False, checked=False, rtol=0.0):
        self.transposed, self.checked, self.rtol = transposed, checked, rtol
        self.status = ""
        self.iterations = 0
        self.residual = self.backward_error = self.defect = 0.0
        self.clock = perf_counter()

    def measure(self, residual, data, terms):
        """Note the norm of the residual, relative to that of the data, and to the sum of both terms of it."""
        self.residual = residual / data if data else 0.0
        self.backward_error = residual / (terms + data or 1.0)

    def info(self):
        """Freeze the figures."""
        residual, backward_error, defect = map(float, (self.residual, self.backward_error, self.defect))
        seconds = perf_counter() - self.clock
        return SolveInfo(self.status, int(self.iterations), residual, backward_error, defect, seconds)


def failure(status):
    """The record of a set-up that failed."""
    run = Run()
    run.status = status
    return run.info()


def merged(one, other):
    """The record of two solves that belong together."""
    return SolveInfo(
        max(one.status, other.status, key=STATUS_WORDS.index),
        one.iterations + other.iterations,
        max(one.residual, other.residual),
        max(one.backward_error, other.backward_error),
        max(one.defect, other.defect),
        one.seconds + other.seconds,
    )
