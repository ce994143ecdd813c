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
from typing import Any

import numpy as np

__all__ = ["ROUNDING_FACTOR", "rounding_error"]

# A gap up to this multiple of a rounding error may be due to rounding. The errors in other modes are of the size of
# those in the usual mode. Over 300 right derivatives of ill-conditioned solves, no gap was above twice the error.
ROUNDING_FACTOR = 4.0

# Values of FE_UPWARD, FE_DOWNWARD and FE_TOWARDZERO in <fenv.h> by architecture.
_INTEL = (0x800, 0x400, 0xC00)
_ARM = (0x400000, 0x800000, 0xC00000)
_MODES = {"x86_64": _INTEL, "i686": _INTEL, "aarch64": _ARM, "arm64": _ARM}


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


def _available_modes() -> tuple[int, ...]:
    """Return the rounding modes that change the results of NumPy on this computer."""
    if _c_library() is None:
        return ()
    numbers = np.array([1.0, -1.0])
    available = []
    for mode in _MODES.get(platform.machine(), ()):
        with _rounding_mode(mode):
            tenths = numbers / 10.0  # they are not numbers in binary, so that each mode changes one of them
        if not np.array_equal(tenths, numbers / 10.0):
            available.append(mode)
    return tuple(available)


def rounding_error(function: Callable[[], float]) -> float:
    """Return the largest change of a number in other rounding modes: upward, downward, and toward zero.

    Only the current thread rounds in another way. On computers without such modes the change is 0.

    Parameters
    ----------
    function : callable
        Called without arguments; returns the number.
    """
    usual = function()
    largest = 0.0
    for mode in _available_modes():
        with _rounding_mode(mode):
            rounded = function()
        largest = max(largest, abs(rounded - usual))
    return largest
