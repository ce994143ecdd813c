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


def net_flow(parts, lower, upper, b):
    """Face components -> b = sum over the axes of upper v[i + 1] + lower v[i]; returns the sum of its squares.

    Parameters
    ----------
    parts : three ndarrays
        C-contiguous float64 with three axes, leading ones of length 1; the last component has entries,
        a component that is not there none.
    lower, upper : three ndarrays each
        One coefficient for each cell along the axis.
    b : ndarray, shape (n0, n1, n2)
        C-contiguous float64.

    Examples
    --------
    >>> import numpy as np
    >>> v, b, none = np.array([[[0.0, 1.0, 3.0]]]), np.zeros((1, 1, 2)), np.zeros((0, 0, 0))
    >>> ones = (np.ones(1), np.ones(1), np.ones(2))
    >>> net_flow((none, none, v), tuple(-line for line in ones), ones, b)
    5.0
    >>> b
    array([[[1., 2.]]])
    """
    return _staggered().net_flow(*parts, lower, upper, b)


def push(x, p, keep, below, above, axis, out):
    """One face component -> out = keep x + below p[i - 1] + above p[i], one coefficient for each face along `axis`.

    Parameters
    ----------
    x, p, out : ndarrays
        As in `net_flow`: a component, a cell field, the result in the shape of x.
    keep, below, above : three ndarrays each
    axis : int
        0, 1 or 2.

    Examples
    --------
    >>> import numpy as np
    >>> x, p, out = np.ones((1, 1, 3)), np.array([[[2.0, 5.0]]]), np.zeros((1, 1, 3))
    >>> inside = (np.array([0.0, 1.0, 0.0]),) * 3
    >>> push(x, p, inside, tuple(-line for line in inside), inside, 2, out)
    >>> out
    array([[[0., 4., 0.]]])
    """
    _staggered().push(x, p, keep, below, above, axis, out)
