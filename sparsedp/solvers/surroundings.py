"""Where the unknowns of a residual lie: on the cells of a grid, when the Operators that the residual uses say so.

An assembled Jacobian is then a matrix on that grid, and solvers that use its geometry can take it.
"""

from typing import Any

import numpy as np
import scipy.sparse as sp

from sparsedp.derivative import traced
from sparsedp.operator import Operator
from sparsedp.tape import called
from sparsedp.traces import ReverseNode, untraced

__all__ = ["Surroundings", "cells_met"]

ROUNDING = 1e-12  # of the largest entry


class Surroundings:
    """The cells that the rows of a Jacobian belong to.

    Parameters
    ----------
    space : Space
    pattern : csr_array
        Of the Jacobian, its own transpose.
    """

    def __init__(self, space, pattern):
        self.space = space
        places = sp.csr_array((np.arange(pattern.nnz), pattern.indices, pattern.indptr), shape=pattern.shape)
        self._turned = places.T.tocsr().data  # where the mirror image of each entry stands
        self._volumes = np.repeat(space.grid.volumes.reshape(-1), np.diff(pattern.indptr))

    def suit(self, matrix, shape):
        """Whether x is a field on the cells, and the matrix, times the volumes, symmetric: multigrid needs that."""
        if shape != self.space.shape:
            return False
        weighed = self._volumes * matrix.data
        gap = np.max(np.abs(weighed - weighed[self._turned]), initial=0.0)
        return bool(gap <= ROUNDING * np.max(np.abs(weighed), initial=0.0))


class Watched(ReverseNode):
    """A node that notes, in a list that its root holds, the spaces that Operators map from."""

    __slots__ = ("found",)
    found: Any

    def __init__(self, value, fun, args, options, nums, parents):
        super().__init__(value, fun, args, options, nums, parents)
        self.found, op = parents[0].found, called(fun, args)
        if isinstance(op, Operator):
            self.found.append(op.domain)


untraced[Watched] = untraced[ReverseNode]  # comparisons, shapes, rounding: plain values for this kind too


def cells_met(equation, x, leaves):
    """The cells of the first grid that an Operator in the residual acts on, if x is one field on them; else None.

    Parameters
    ----------
    equation : Equation
    x : flat array
    leaves : tuple of arrays

    Returns
    -------
    Space or None
    """
    layout = equation.layout
    if len(layout.shapes) != 1 or len(layout.shapes[0]) < 2:
        return None  # on one axis banded LU needs no geometry
    root = Watched.new_root()
    root.found = []
    with np.errstate(all="ignore"):
        traced(lambda y: equation(y, *leaves), x, [root])
    fitting = (s for s in root.found if s.grid is not None and s.kind == "cells" and s.shape == layout.shapes[0])
    return next(fitting, None)
