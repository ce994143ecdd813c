"""The two passes of a projection: b = D K x, the net flow out of the cells, and out = K (x + G p).

K is the mask that sets closed faces to 0. Along each axis D and G are 1-D matrices with two entries in each row. The
transposed projection has the same form, with G^T in place of D and D^T in place of G. `OperatorPasses` computes both
passes as products with the operators themselves. `CompiledPasses` computes the same on separable grids by compiled
loops, which are faster because each pass reads its fields only once.
"""

from __future__ import annotations

from math import sqrt
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp import kernels
from sparsedp.operators.structure.lazy import face_entries
from sparsedp.solvers.scaling import norm

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from sparsedp.grid.grid import Grid
    from sparsedp.operators.structure.base import Structure

__all__ = ["CompiledPasses", "OperatorPasses", "compiled_passes"]


class OperatorPasses:
    """The passes as products with operators.

    Parameters
    ----------
    first, second : Structure
        The operators from faces to cells (D) and from cells to faces (G).
    kept : array
        The diagonal of K: 0 on closed faces, else 1.
    """

    def __init__(self, first: Structure, second: Structure, kept: NDArray) -> None:
        self.first = first
        self.second = second
        self.kept = kept

    def net_flow(self, x: NDArray, b: NDArray) -> tuple[float, float]:
        """Set b = D K x, and return the norms of b and of x."""
        with np.errstate(invalid="ignore"):
            self.first.apply(self.kept * x, b)
        return norm(b), norm(x)

    def push(self, x: NDArray, p: NDArray, out: NDArray) -> None:
        """Set out = K (x + G p)."""
        self.second.apply(p, out)
        out += x
        out *= self.kept


class CompiledPasses:
    """The passes as compiled loops, for grids without obstacles whose walls are each open or closed as a whole.

    Parameters
    ----------
    grid : Grid
    lines : sequence of (kept, entries), one for each axis
        Arrays along the axis. `kept` is 1 for open and 0 for closed faces. `entries` has four rows with one entry for
        each face: of G for the cell below and for the cell above the face, then of D for these two cells. The entries
        of closed faces are 0.
    loops : module
        `sparsedp.kernels.projection`, which needs numba.
    """

    def __init__(self, grid: Grid, lines: Sequence[tuple[NDArray, NDArray]], loops: Any) -> None:
        self.loops = loops
        missing = 3 - grid.dim  # the loops have three axes; axes that the grid lacks have no faces
        self.cells = (1,) * missing + grid.shape
        self.parts: list[tuple[slice, tuple[int, ...]]] = [(slice(0), (0, 0, 0))] * missing
        self.cell_entries = [np.zeros((2, 0))] * missing
        self.face_entries = [np.zeros((3, 0))] * missing
        for axis, (kept, entries) in enumerate(lines):
            span = slice(*grid.faces.offsets[axis : axis + 2])
            self.parts.append((span, (1,) * missing + grid.face_shape(axis)))
            from_below, from_above, to_below, to_above = entries
            # Entries of D for each cell: for its lower face and for its upper face.
            self.cell_entries.append(np.stack([to_above[:-1], to_below[1:]]))
            self.face_entries.append(np.stack([kept, from_below[: kept.size], from_above[: kept.size]]))

    def _components(self, x: NDArray) -> list[NDArray]:
        return [x[span].reshape(shape) for span, shape in self.parts]

    def net_flow(self, x: NDArray, b: NDArray) -> tuple[float, float]:
        """Set b = D K x, and return the norms of b and of x."""
        of_flow, of_velocity = self.loops.net_flow.compiled(
            x, *self._components(x), *self.cell_entries, b.reshape(self.cells), 0, self.cells[0]
        )
        return sqrt(of_flow), sqrt(of_velocity)

    def push(self, x: NDArray, p: NDArray, out: NDArray) -> None:
        """Set out = K (x + G p)."""
        self.loops.push.compiled(
            *self._components(x), p.reshape(self.cells), *self.face_entries, *self._components(out), 0, 1
        )


def compiled_passes(grid: Grid, products: OperatorPasses) -> CompiledPasses | None:
    """Return the same passes as compiled loops; None without numba, or if D or G does not suit these loops."""
    if not kernels.compiled():
        return None
    from sparsedp.kernels import projection

    lines = []
    for axis, faces in enumerate(grid.faces.split(products.kept)):
        n = grid.shape[axis]
        lines_of_mask = np.moveaxis(faces, axis, -1).reshape(-1, faces.shape[axis])
        kept = lines_of_mask[0]
        if np.any(lines_of_mask != kept):  # a wall is closed on one part and has an inflow on another
            return None
        entries = face_entries(products.first, products.second, axis, n)
        if entries is None:
            return None
        lines.append((kept, entries * np.resize(kept, n + 1)))  # the last face of a periodic axis is the first
    if projection.net_flow.compiled is None:
        return None
    return CompiledPasses(grid, lines, projection)
