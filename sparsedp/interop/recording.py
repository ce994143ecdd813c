"""What both bridges need of our tape: one run of a function, and the gradients that belong to it."""

import numpy as np

from sparsedp._utils.validation import check_precision
from sparsedp.autodiff.derivative import gradient_of, linearised

__all__ = ["owned", "parts", "recorded"]


def recorded(fun, arrays, moving):
    """Function of a list of arrays, some of which move -> (leaves of its result, how to build it, gradients).

    ``gradients(cotangents)``: of all leaves of the result, None where there is none -> those of the arrays that move.
    """
    values, rebuild, pull = linearised(fun, arrays, moving)

    def gradients(cotangents):
        slopes = zip(arrays, pull(cotangents), moving, strict=True)
        return [gradient_of(array, slope) for array, slope, moves in slopes if moves]

    return values, rebuild, gradients


def owned(array):
    """Array of another library -> one of our own, or a number; whole numbers stay arrays, as the tape takes them."""
    check_precision("a result of another library", array)
    array = np.array(array)
    return array[()] if array.dtype.kind in "fc" else array


def parts(values, count):
    """A tuple, traced or not, as one of values that are traced or not."""
    return tuple(values[k] for k in range(count))
