"""The passes of the projection on plain arrays: compiled where numba is installed, NumPy elsewhere."""

import functools

from sparsedp.kernels import compiled
from sparsedp.kernels.unable import warn_unable

__all__ = ["net_flow", "push"]


@functools.cache
def _staggered():
    """The passes of the projection: compiled (imports numba), or plain where that is not there or does not work."""
    if compiled():
        try:
            from sparsedp.kernels import staggered

            return staggered
        except Exception as error:  # whatever LLVM or numba object to on this machine
            warn_unable(error, 5)
    from sparsedp.kernels import staggered_plain

    return staggered_plain


def net_flow(x, shape, lines, b):
    """Face field -> b = sum over the axes of upper v[i + 1] + lower v[i]; returns the sums of squares of b and x.

    Parameters
    ----------
    x : flat float64 array
        The components of a face field, one after the other.
    shape : tuple of six
        Cells (n0, n1, n2), leading ones where there are fewer axes, and faces along each axis: n, one more
        between walls, 0 for an axis that is not there.
    lines : array, shape (2, n0 + n1 + n2)
        Lower and upper coefficients of the cells along each axis.
    b : flat float64 array, one number for each cell

    Examples
    --------
    >>> import numpy as np
    >>> b, lines = np.zeros(2), np.array([[0.0, 0.0, -1.0, -1.0], [0.0, 0.0, 1.0, 1.0]])
    >>> net_flow(np.array([0.0, 1.0, 3.0]), (1, 1, 2, 0, 0, 3), lines, b)
    (5.0, 10.0)
    >>> b
    array([1., 2.])
    """
    return _staggered().net_flow(x, shape, lines, b)


def push(x, p, shape, lines, out):
    """Face and cell field -> out = keep x + below p[i - 1] + above p[i], one coefficient for each face along its axis.

    Parameters
    ----------
    x, p, out : flat float64 arrays
        A face field, a cell field, the result.
    shape : tuple of six
        As in `net_flow`.
    lines : array, shape (3, faces along the axes)
        keep, below and above of the faces along each axis, one axis after the other.

    Examples
    --------
    >>> import numpy as np
    >>> out, lines = np.zeros(3), np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    >>> push(np.ones(3), np.array([2.0, 5.0]), (1, 1, 2, 0, 0, 3), lines, out)
    >>> out
    array([0., 4., 0.])
    """
    _staggered().push(x, p, shape, lines, out)
