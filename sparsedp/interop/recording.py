"""Record one run of a function on the tape, and compute its gradients. Both bridges use this module."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sparsedp._utils.validation import check_precision
from sparsedp.autodiff.derivative import gradient_of, taped

__all__ = ["owned", "parts", "recorded"]


def recorded(fun: Callable, arrays: Sequence, moving: Sequence[bool]) -> tuple[list, Callable, Callable]:
    """Run a function of a list of arrays on the tape.

    Parameters
    ----------
    fun : callable
    arrays : list of arrays
    moving : list of bool
        Whether each array is a variable, to which gradients are computed.

    Returns
    -------
    values : list
        The leaves of the result.
    rebuild : callable
        ``rebuild(values)`` returns the result as a tree.
    gradients : callable
        ``gradients(cotangents)`` returns the gradients with respect to the variables. `cotangents` has an array or None
        for each leaf of the result.
    """
    tape = taped(fun, arrays, moving)

    def gradients(cotangents):
        slopes = zip(arrays, tape.pull(cotangents), moving, strict=True)
        return [gradient_of(array, slope) for array, slope, moves in slopes if moves]

    return tape.values, tape.rebuild, gradients


def owned(array: Any) -> Any:
    """Return a copy of an array of another library as a NumPy array, or as a NumPy scalar if it is floating and 0-d."""
    check_precision("a result of another library", array)
    array = np.array(array)
    if array.dtype.kind in "fc":
        return array[()]
    return array


def parts(values: Any, count: int) -> tuple:
    """Return the first `count` entries of a tuple, which may be a traced value, as a plain tuple."""
    return tuple(values[k] for k in range(count))
