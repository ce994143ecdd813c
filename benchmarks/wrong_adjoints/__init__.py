"""A collection of wrong derivatives, and of right ones that are hard to check.

Each program has a derivative that is written by hand, as ``vjp(x, g)``. Fifty derivatives have a planted fault, in the
line with the comment "fault", which names what is right. Run ``python -m benchmarks.wrong_adjoints`` to compare
`check.vjp` with the checks of torch and JAX and with a Taylor test.
"""

from benchmarks.wrong_adjoints import (
    arrays,
    kinks,
    networks,
    right_arrays,
    right_kinks,
    right_noise,
    right_runs,
    right_scales,
    solves,
    terms,
    time_loops,
    transposes,
    walls,
    waves,
)
from benchmarks.wrong_adjoints.cases import Case, Program

__all__ = ["RIGHT", "WRONG", "Case", "Program"]

MODULES = (
    walls,
    transposes,
    time_loops,
    terms,
    solves,
    kinks,
    waves,
    networks,
    arrays,
    right_scales,
    right_noise,
    right_runs,
    right_kinks,
    right_arrays,
)
CASES = [case for module in MODULES for case in vars(module).values() if isinstance(case, Case)]
WRONG = [case for case in CASES if case.is_wrong]
RIGHT = [case for case in CASES if not case.is_wrong]
