"""The largest stable step of an explicit Runge-Kutta method for u' = c L u.

A step multiplies a mode with the eigenvalue w of L by R(h c w), where R is the Taylor polynomial of the exponential.
The limit is the largest h c up to which |R| <= 1 for all modes that do not grow in the exact solution.

References
----------
E. Hairer, G. Wanner, Solving Ordinary Differential Equations II (1996), section IV.2; L. N. Trefethen, M. Embree,
Spectra and Pseudospectra (2005), chapters 26 and 31 (matrices far from normal, and the interior condition for them).
"""

from __future__ import annotations

from functools import reduce
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse.linalg import ArpackError, eigsh

from sparsedp.solvers.separable import compute_spectrum, diagonalise

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.integrators.runge_kutta import Table
    from sparsedp.operators.structure.factor import Factor

__all__ = ["largest_step"]

DENSE_UP_TO = 64  # eigenvalues of matrices up to this size are computed by a dense solver
DENSE_FACTOR_UP_TO = 512  # the same for the factor of a Kronecker sum
PRODUCTS = 80  # of Arnoldi's method; the error of the limit is below 0.5 % for 300^2 cells
DIRECTIONS = 256  # in which the outermost eigenvalues are kept
FAR_FROM_NORMAL = 1e8  # condition number of the eigenvectors; modes of such a matrix may first grow by this factor
GROWTH = 1e-6  # of a mode in one step that does not count as growth
GROWING = 1e-8  # real part, relative to the largest absolute eigenvalue, of modes that grow in the exact solution
FARTHEST = 4.0  # no method of EXPLICIT is stable at |h c w| >= 4 in the left half plane
SCANNED = 400  # values of |h c w| at which |R| is evaluated before bisection


def largest_step(op: Any, table: Table) -> float:
    """Return the largest stable value of h c for an explicit step of length h of u' = c L u.

    For separable operators it is computed from the eigenvalues of L, for other symmetric matrices from the most
    negative one, and for other matrices from Ritz values. Modes that grow in the exact solution set no limit. For
    operators without a matrix the limit is not known; infinity is returned, so that every step is allowed.

    Parameters
    ----------
    op : Operator
        L.
    table : Table
        The method.
    """
    least = _least_eigenvalue(op)
    if least is not None:
        return table.reach / -least if least < 0 else np.inf
    eigenvalues = _outermost_eigenvalues(op)
    if eigenvalues is None:
        return np.inf
    return _largest_multiple(eigenvalues, table.order)


def _least_eigenvalue(op: Any) -> float | None:
    """Return the most negative eigenvalue of an operator whose symmetry shows that all are real, else None."""
    if op.dtype.kind == "c":
        return None
    if op.separable:
        factors = compute_spectrum(op.structure)
        if factors is not None:
            return float(np.min(factors.eigenvalues))
    if not op.structure.has_entries:
        return None
    matrix = op.matrix
    n = op.shape[0]
    if n and abs(matrix - matrix.T).max() > 1e-14 * abs(matrix).max():
        return None
    if n <= DENSE_UP_TO:
        return float(np.min(np.linalg.eigvalsh(matrix.toarray()), initial=0.0))
    start = np.random.default_rng(0).standard_normal(n)  # a fixed seed, so that every run gives the same bits
    try:
        return float(eigsh(matrix, 1, which="SA", v0=start, tol=1e-3, return_eigenvectors=False)[0])
    except ArpackError:
        return None


def _outermost_eigenvalues(op: Any) -> NDArray | None:
    """Return the eigenvalues of an operator that may limit the step; None if it has no matrix."""
    if op.separable and op.dtype.kind != "c":
        sums = np.full(1, op.structure.shift, complex)
        for factor in op.structure.lines.values():
            sums = _outermost(np.add.outer(sums, _eigenvalues_of_factor(factor)))
        return sums
    if not op.structure.has_entries:
        return None
    matrix = op.matrix
    if op.shape[0] <= DENSE_UP_TO:
        return np.linalg.eigvals(matrix.toarray())
    return _ritz_values(matrix)


def _eigenvalues_of_factor(factor: Factor) -> NDArray:
    """Return the outermost eigenvalues of a 1-D factor.

    For a factor far from normal, such as upwind differences between walls, they do not bound the growth in about
    as many steps as there are cells. The eigenvalues of the same stencil on an unbounded axis do; they are then
    returned too.
    """
    basis = diagonalise(factor)
    if basis is not None:
        return _outermost(basis.eigenvalues)
    matrix = factor.matrix
    if factor.shape[0] > DENSE_FACTOR_UP_TO:
        return np.append(_outermost(_ritz_values(matrix)), _interior_eigenvalues(matrix))
    eigenvalues, vectors = np.linalg.eig(matrix.toarray())
    eigenvalues = _outermost(eigenvalues)
    if not np.linalg.cond(vectors) < FAR_FROM_NORMAL:
        eigenvalues = np.append(eigenvalues, _interior_eigenvalues(matrix))
    return eigenvalues


def _interior_eigenvalues(matrix: Any) -> NDArray:
    """Return eigenvalues of the stencil in the middle row of a 1-D matrix, on an unbounded axis."""
    middle = matrix.shape[0] // 2
    row = matrix[[middle]].tocoo()
    angles = np.linspace(0.0, 2 * np.pi, DIRECTIONS, endpoint=False)
    return np.exp(1j * np.outer(angles, row.col - middle)) @ row.data


def _ritz_values(matrix: Any) -> NDArray:
    """Return eigenvalues of the projection of a matrix on a Krylov space, which approximate the outermost ones."""
    n = matrix.shape[0]
    steps = min(PRODUCTS, n)
    basis = np.zeros((steps + 1, n), matrix.dtype)
    projected = np.zeros((steps, steps), matrix.dtype)
    start = np.random.default_rng(0).standard_normal(n)  # a fixed seed, so that every run gives the same bits
    basis[0] = start / np.linalg.norm(start)
    scale = 0.0
    for k in range(steps):
        vector = matrix @ basis[k]
        scale = max(scale, float(np.linalg.norm(vector)))
        for _ in range(2):  # the second pass restores orthogonality
            shares = basis[: k + 1].conj() @ vector
            projected[: k + 1, k] += shares
            vector = vector - shares @ basis[: k + 1]
        size = float(np.linalg.norm(vector))
        if size <= 1e-12 * scale:  # the Krylov space is invariant
            return np.linalg.eigvals(projected[: k + 1, : k + 1])
        basis[k + 1] = vector / size
        if k + 1 < steps:
            projected[k + 1, k] = size
    return np.linalg.eigvals(projected)


def _outermost(values: NDArray) -> NDArray:
    """Return the numbers that are farthest in one of DIRECTIONS directions of the complex plane."""
    values = np.unique(values)
    if values.size <= DIRECTIONS:
        return values
    directions = np.exp(2j * np.pi * np.arange(DIRECTIONS) / DIRECTIONS)
    chosen = {int(np.argmax((values * direction).real)) for direction in directions}
    return values[sorted(chosen)]


def _largest_multiple(eigenvalues: NDArray, order: int) -> float:
    """Return the largest s such that |R(r w)| <= 1 for all r <= s and all eigenvalues w that do not grow."""
    size = np.abs(eigenvalues)
    largest = np.max(size, initial=0.0)
    limiting = (size > 0) & (eigenvalues.real <= GROWING * largest)
    if not np.any(limiting):
        return np.inf
    size = size[limiting]
    directions = eigenvalues[limiting] / size

    def is_stable(radius: Any) -> NDArray:
        terms = [np.ones(np.broadcast(radius, directions).shape, complex)]
        for k in range(1, order + 1):
            terms.append(terms[-1] * (radius * directions / k))
        return np.abs(reduce(np.add, terms)) <= 1 + GROWTH

    radii = np.linspace(0.0, FARTHEST, SCANNED + 1)
    first = np.argmin(is_stable(radii[:, None]), axis=0)  # the first radius that is unstable, for each direction
    lower, upper = radii[first - 1], radii[first]
    for _ in range(50):
        middle = 0.5 * (lower + upper)
        stable = is_stable(middle)
        lower = np.where(stable, middle, lower)
        upper = np.where(stable, upper, middle)
    return float(np.min(lower / size))
