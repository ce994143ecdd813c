"""Stencil: a symmetric 5- or 7-point matrix on the cells of a grid, given by its faces."""

from typing import Any, NamedTuple

import numpy as np

__all__ = ["Stencil", "Unfit", "cleaned"]

EPS = np.finfo(float).eps
CLEAN = 16 * EPS  # what is left of a diagonal is 0 below this share of the links at it


class Unfit(Exception):
    """An operator is not a stencil; the message is the reason in words."""


class Stencil(NamedTuple):
    """S = scale V A, with V the cell volumes: (S x)_i = sum over faces of c (x_i - x_j) + extra_i x_i.

    Attributes
    ----------
    grid : Grid
        2-D or 3-D. Its lengths may be those of the user up to powers of two.
    links : tuple of arrays, one for each axis, shape `grid.face_shape(axis)`
        c >= 0 of each face. On walls it is not read.
    extra : array, shape `grid.shape`
        >= 0: conductance to walls and Dirichlet obstacles, shift times volume.
    scale : float
        A power of two, or minus one.
    """

    grid: Any
    links: tuple
    extra: np.ndarray
    scale: float = 1.0

    def apply(self, x):
        """S x, for a field x."""
        out = self.extra * x
        for axis, (c, flag) in enumerate(zip(self.links, self.grid.periodic)):
            u, y = np.moveaxis(x, axis, 0), np.moveaxis(out, axis, 0)
            c = np.moveaxis(c, axis, 0)
            flux = c[1 : len(u)] * (u[1:] - u[:-1])
            y[:-1] -= flux
            y[1:] += flux
            if flag:
                flux = c[0] * (u[0] - u[-1])
                y[-1] -= flux
                y[0] += flux
        return out

    def checked(self):
        """The stencil times the number that makes it positive and near 1; refuses what multigrid cannot smooth."""
        arrays = [array for array in (*self.inner, self.extra) if array.size]
        largest = [array.flat[np.argmax(np.abs(array))] for array in arrays]
        signs = {np.sign(value) for value in largest} - {0.0}
        factor = float(
            np.ldexp(-1.0 if signs == {-1.0} else 1.0, -int(np.frexp(np.max(np.abs(largest), initial=0))[1]))
        )
        links = tuple(factor * c for c in self.links)
        self = self._replace(links=links, extra=factor * self.extra, scale=factor * self.scale)
        if any(np.any(c < 0) for c in self.inner):
            raise Unfit("a face has a coefficient of the wrong sign")
        if np.any(self.extra < 0):
            raise Unfit("a row sums to less than 0: a shift of the wrong sign")
        return self

    @property
    def inner(self):
        """The links without walls."""
        whole = [[slice(None)] * self.grid.dim for _ in self.links]
        for axis, flag in enumerate(self.grid.periodic):
            whole[axis][axis] = slice(None) if flag else slice(1, -1)
        return tuple(c[tuple(part)] for c, part in zip(self.links, whole))


def cleaned(extra, total):
    """Set to 0 what is rounding, compared with the magnitudes that it is the sum of."""
    return np.where(np.abs(extra) <= CLEAN * total, 0.0, extra)
