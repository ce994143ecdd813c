"""Points near a point, and changes from them, for foreign code that refuses some arguments."""

import numpy as np

__all__ = ["REFUSED", "changes", "points_near", "typical"]

REFUSED = ValueError, ArithmeticError, RuntimeError  # what foreign code raises where it has no result
POINTS = 3  # points at which a pattern is probed
NEARER = 1.0, 0.1, 1e-3, 0.0  # shares of the way, until the code takes the point; it takes x itself
SMALLER = 1.0, -1.0, 1e-2, -1e-2, 1e-4, -1e-4


def points_near(run, x):
    """Three points near x that `run` takes.

    Parameters
    ----------
    run : callable
        ``run(x) -> y``, arrays; may raise or return NaN.
    x : array

    Returns
    -------
    list of arrays
    """
    rng, size = np.random.default_rng(0), typical(x)
    parts = [0.1 * x * rng.uniform(-1, 1, x.shape) + 0.05 * size * rng.standard_normal(x.shape) for _ in range(POINTS)]
    return [next(x + share * part for share in NEARER if _taken(run, x + share * part, share)) for part in parts]


def _taken(run, x, share):
    try:
        return share == 0 or bool(np.all(np.isfinite(run(x))))
    except REFUSED:
        return False


def changes(run, x):
    """v -> how run(x) changes when x moves along v, flat: a tenth of the size of x, less where that is refused.

    Parameters
    ----------
    run : callable
    x : array

    Returns
    -------
    callable
    """
    size, before = 0.1 * typical(x), run(x)

    def product(v):
        refusal = None
        for share in SMALLER:
            try:
                change = np.ravel(run(x + share * size * v.reshape(x.shape)) - before)
            except REFUSED as error:
                refusal = error
                continue
            if np.all(np.isfinite(change)):
                return change
        if refusal is not None:
            raise refusal
        return change

    return product


def typical(x):
    """Root mean square of an array, 1 where that is 0 or the array is empty."""
    return (np.sqrt(np.mean(x**2)) if x.size else 0.0) or 1.0
