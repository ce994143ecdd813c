"""Compiled substitution for sparse systems that are triangular after a permutation of rows and columns."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sparsedp.kernels.team import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["backward", "backward_complex", "forward", "forward_complex"]


@kernel("place1 place1 +read1 place1 +read1 +write1")
def forward(
    indptr: NDArray, indices: NDArray, data: NDArray, order: NDArray, b: NDArray, x: NDArray, start: int, stop: int
) -> None:
    """Solve A x = b for the rows in order[start:stop], one after the other.

    x[i] = (b[i] - sum over j != i of A[i, j] x[j]) / A[i, i]. The order must be such that each x[j] is computed before
    a row needs it.
    """
    for number in range(start, stop):
        i = order[number]
        total = b[i]
        pivot = data[indptr[i]]
        for k in range(indptr[i], indptr[i + 1]):
            j = indices[k]
            if j == i:
                pivot = data[k]
            else:
                total -= data[k] * x[j]
        x[i] = total / pivot


@kernel("place1 place1 +read1 place1 +write1 +write1")
def backward(
    indptr: NDArray, indices: NDArray, data: NDArray, order: NDArray, r: NDArray, x: NDArray, start: int, stop: int
) -> None:
    """Solve A^T x = r for the rows of A in order[start:stop], from the last one to the first.

    x[i] = r[i] / A[i, i], then r[j] -= A[i, j] x[i] for all j != i. As a result, A^T x of the computed x is subtracted
    from the entries of r that belong to the other unknowns.
    """
    for number in range(stop - 1, start - 1, -1):
        i = order[number]
        pivot = data[indptr[i]]
        for k in range(indptr[i], indptr[i + 1]):
            if indices[k] == i:
                pivot = data[k]
        value = r[i] / pivot
        x[i] = value
        for k in range(indptr[i], indptr[i + 1]):
            j = indices[k]
            if j != i:
                r[j] -= data[k] * value


forward_complex = forward.complex
backward_complex = backward.complex
