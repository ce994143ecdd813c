"""Rounding errors of a function, measured by running it again in the other rounding modes of the processor.

A function that solves an ill-conditioned system has rounding errors far above the last digit. They need not show as
noise: with a fixed matrix, an LU factorization has the same errors at every point, so that the values vary smoothly.
But with other rounding of each single operation, the result differs by about its rounding error.

References
----------
W. Kahan, How futile are mindless assessments of roundoff in floating-point computation?, 2006.
"""

from __future__ import annotations

import ctypes
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import inf, isfinite
from typing import Any

import numpy as np

__all__ = ["ROUNDING_FACTOR", "UNBOUNDED_ERROR", "rounding_error"]

# A gap up to this multiple of a rounding error may be due to rounding. The errors in other modes are of the size of
# those in the usual mode. Over 300 right derivatives of ill-conditioned solves, no gap was above twice the error.
ROUNDING_FACTOR = 4.0
# Part of the reason of a verdict.
UNBOUNDED_ERROR = (
    "in another rounding mode the program fails or is not finite: it amplifies rounding errors, the problem is too "
    "ill-conditioned to tell"
)

# Values of FE_UPWARD, FE_DOWNWARD and FE_TOWARDZERO in <fenv.h> by architecture.
_INTEL = (0x800, 0x400, 0xC00)
_ARM = (0x400000, 0x800000, 0xC00000)
_MODES = {"x86_64": _INTEL, "i686": _INTEL, "aarch64": _ARM, "arm64": _ARM}
# Exact elementary functions differ between modes by no more than this multiple of machine epsilon. The sine and the
# cosine of NumPy in single precision assume the usual mode: in others they can be off by 1.
_MODE_EPS = 32.0


def _c_library() -> Any:
    """Return the C library with ``fegetround`` and ``fesetround``; None if there is none."""
    try:
        library = ctypes.CDLL(None)
        return library if library.fesetround and library.fegetround else None
    except (OSError, TypeError, AttributeError):  # Windows has another interface
        return None


@contextmanager
def _rounding_mode(mode: int) -> Iterator[None]:
    """Round all operations of the current thread in another mode."""
    library = _c_library()
    usual = library.fegetround()
    library.fesetround(mode)
    try:
        yield
    finally:
        library.fesetround(usual)


def _available_modes(single: bool = False) -> tuple[int, ...]:
    """Return the rounding modes that change the results of NumPy on this computer by their rounding errors only.

    Parameters
    ----------
    single : bool
        Whether the modes are for programs in single precision.
    """
    if _c_library() is None:
        return ()
    numbers = np.array([1.0, -1.0])
    available = []
    for mode in _MODES.get(platform.machine(), ()):
        with _rounding_mode(mode):
            tenths = numbers / 10.0  # they are not numbers in binary, so that each mode changes one of them
        if not np.array_equal(tenths, numbers / 10.0) and not (single and _breaks_functions(mode)):
            available.append(mode)
    return tuple(available)


def _breaks_functions(mode: int) -> bool:
    """Return whether the sine or the cosine of NumPy in single precision is wrong in a rounding mode."""
    angles = np.linspace(0.1, 100.0, 1000, dtype=np.float32)
    for function in (np.sin, np.cos):
        usual = function(angles)
        with _rounding_mode(mode):
            rounded = function(angles)
        if not np.max(np.abs(rounded - usual)) <= _MODE_EPS * np.finfo(np.float32).eps:
            return True
    return False


def rounding_error(function: Callable[[], float], single: bool = False) -> float:
    """Return the largest change of a number in other rounding modes: upward, downward, and toward zero.

    Only the current thread rounds in another way. On computers without such modes the change is 0.

    Parameters
    ----------
    function : callable
        Called without arguments; returns the number.
    single : bool
        Whether it computes in single precision. Modes in which functions of NumPy are wrong are not used then.

    Returns
    -------
    float
        Infinity if the number is not finite, or if the function raises an exception in another mode only: such a
        function has no bound of its rounding errors.
    """
    usual = function()
    largest = 0.0
    for mode in _available_modes(single):
        try:
            with _rounding_mode(mode):
                rounded = function()
        except Exception:  # of any foreign program; in the usual mode it has none
            return inf
        if not isfinite(rounded - usual):
            return inf
        largest = max(largest, abs(rounded - usual))
    return largest
