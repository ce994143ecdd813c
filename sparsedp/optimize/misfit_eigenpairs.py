"""Eigenpairs of the Hessian of a misfit in the metric of a prior covariance.

Notes
-----
With the Hessian H of the misfit and the prior covariance C, the pairs H v = lambda C^-1 v are computed from products
with H and C only. Let v = C w. Then H C w = lambda w, and H C is self-adjoint in the inner product u^T C w.

If there are few residuals, or few unknowns, the eigenpairs of the small matrix J C J^T give all of them. Otherwise they
are found in a block Krylov space of H C. It starts with products of H and random samples, like the first pass of a
randomized method. Each product with H serves twice: as the next block of the basis, and, like the second pass, for the
matrix of H C in this basis. When all eigenpairs above the tolerance have converged, new random samples show whether
others were missed, for example of a multiple eigenvalue.

References
----------
N. Halko, P. G. Martinsson, J. A. Tropp, Finding structure with randomness, SIAM Review 53, 2011: a bound on a matrix
from products with random vectors, section 4.3.
A. K. Saibaba, J. Lee, P. K. Kitanidis, Randomized algorithms for generalized Hermitian eigenvalue problems,
Numer. Linear Algebra Appl. 23, 2016.
C. Musco, C. Musco, Randomized block Krylov methods for stronger and faster approximate singular value decomposition,
NIPS 2015.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy.linalg

from sparsedp._utils.pytree import norm
from sparsedp._utils.validation import EPS, check_finite
from sparsedp.errors import DerivativeError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from sparsedp.optimize.prior_covariance import PriorCovariance

__all__ = ["RESCALE", "MisfitEigenpairs", "eigenpairs_of_jacobian", "eigenpairs_of_products"]

BLOCK = 10  # random samples, and vectors in a block of the Krylov space
FIRST_BLOCKS = 2  # convergence is not tested before the space has this number of blocks
SPARE_BLOCKS = 6  # blocks beyond two vectors for each eigenpair, in the largest Krylov space
SHARE_OF_RESIDUALS = 0.1  # share of the tolerance for the residuals of the eigenpairs
CLEARLY_ABOVE = 1 + 1e-6  # eigenvalues above a threshold by this factor are not equal to it
SAFETY = 10.0  # the norm of a matrix is rarely larger than this multiple of its products with random vectors
FIRST_GROUP = 1e-4  # roots of eigenvalues above this multiple of the largest are taken from one matrix J C J^T
ROUNDING = 1e3 * EPS  # eigenvalues below this multiple of the largest are lost in rounding of products with H
ASYMMETRY = 1e-2  # relative asymmetry of the Hessian above which its products are wrong
SMALLEST = np.finfo(float).tiny
RESCALE = "; write the residuals and the unknowns in units in which they are closer to 1"
NEGATIVE = (
    "the Hessian of the loss has the eigenvalue {:.3g} in the metric of the prior, so x is not a minimum of the "
    "posterior; continue minimize from x, or return residuals, whose Gauss-Newton Hessian has no negative eigenvalue"
)
NOT_SYMMETRIC = (
    "products with the Hessian are not symmetric (relative difference {:.1e}); dp.check.gradient(loss, x) tests the "
    "derivatives of the function"
)


class MisfitEigenpairs(NamedTuple):
    """Eigenpairs in descending order of the magnitude of the eigenvalues, and what is known about the others.

    Attributes
    ----------
    values : (k,) array
    vectors : (k, n) array
        The rows v, with v^T C^-1 v = 1.
    duals : (k, n) array
        The rows w = C^-1 v.
    neglected : float
        Estimate of the largest magnitude of the other eigenvalues.
    residual : float
        Bound on the relative error of variances due to the residuals of the eigenpairs.
    products : int
        Number of products with the Hessian, or of products with J or J^T if J was computed.
    kind : str
        What was counted.
    is_complete : bool
        Whether the others are below the tolerance.
    lost_in_rounding : bool
        Whether they are not, because of rounding errors.
    """

    values: NDArray
    vectors: NDArray
    duals: NDArray
    neglected: float
    residual: float
    products: int
    kind: str
    is_complete: bool
    lost_in_rounding: bool


def eigenpairs_of_jacobian(jacobian: NDArray, prior: PriorCovariance, tolerance: float) -> MisfitEigenpairs:
    """Return all eigenpairs for the Gauss-Newton Hessian J^T J, from the eigenpairs of J C J^T.

    In one such matrix, eigenvalues that are much smaller than the largest have lost their digits. Therefore only the
    group of large ones is taken from it, and the others from the matrix of the remaining combinations of the rows of J,
    and so on, as in `linearization.left_singular`.

    Parameters
    ----------
    jacobian : (m, n) array
    prior : PriorCovariance
    tolerance : float
        For `is_complete`.
    """
    products = min(jacobian.shape)
    rows = jacobian
    if rows.shape[0] > rows.shape[1]:
        rows = scipy.linalg.qr(jacobian, mode="r", check_finite=False)[0][: rows.shape[1]]
    largest = 0.0
    rounding = 0.0
    values: list[NDArray] = []
    vectors: list[NDArray] = []
    duals: list[NDArray] = []
    while len(rows):
        images = prior.apply(rows)
        gram = images @ rows.T
        asymmetry = _checked_asymmetry(gram, max(largest, np.max(np.abs(gram))))
        squares, weights = np.linalg.eigh(_symmetric(gram))
        largest = max(largest, np.max(squares))
        rounding = max(asymmetry, ROUNDING**2 * largest)
        if not squares[-1] > rounding:
            break
        is_first = squares > max(rounding, FIRST_GROUP**2 * squares[-1])
        first = weights[:, is_first]
        second = weights[:, ~is_first]
        leak = (first.T @ images) @ (second.T @ rows).T / squares[is_first, None]
        first, second = first + second @ leak.T, second - first @ leak
        scaled = (first / np.sqrt(squares[is_first])).T[::-1]
        values.append(squares[is_first][::-1])
        vectors.append(scaled @ images)
        duals.append(scaled @ rows)
        rows = second.T @ rows
    neglected = rounding if len(rows) else 0.0
    empty = np.zeros((0, prior.size))
    return MisfitEigenpairs(
        values=np.concatenate([np.zeros(0), *values]),
        vectors=np.concatenate([empty, *vectors]),
        duals=np.concatenate([empty, *duals]),
        neglected=float(neglected),
        residual=0.0,
        products=products,
        kind="products with the Jacobian",
        is_complete=bool(neglected <= tolerance),
        lost_in_rounding=bool(neglected > tolerance),
    )


def eigenpairs_of_products(
    product: Callable[[NDArray], NDArray], prior: PriorCovariance, rank: int, tolerance: float, seed: int
) -> MisfitEigenpairs:
    """Return the eigenpairs above the tolerance, from products with the Hessian.

    Parameters
    ----------
    product : callable
        ``product(rows)`` returns H times each row of an array of shape (m, n).
    prior : PriorCovariance
    rank : int
        Largest number of eigenpairs.
    tolerance : float
    seed : int
        Of the random samples.

    Raises
    ------
    ValueError
        If an eigenvalue is -1 or less: then H + C^-1 is not positive definite.
    DerivativeError
        If the products with H are not symmetric.
    """
    space = KrylovSpace(product, prior, tolerance, rank)
    rng = np.random.default_rng(seed)
    count = min(BLOCK, prior.size)
    least = min(FIRST_BLOCKS * count, prior.size)
    while True:
        threshold = space.threshold
        previous_count = space.count_above(threshold)
        outside = space.start(_random_rows(prior, rng, count), prior.has_root)
        if outside <= space.threshold:
            return space.result(is_verified=True, outside=outside)
        if not space.grow_until_converged(least):
            outside = space.start(_random_rows(prior, rng, count), are_samples=True)
            return space.result(is_verified=False, outside=outside)
        if space.count_above(threshold) == previous_count:  # new random samples did not show another eigenpair
            return space.result(is_verified=True)


def _random_rows(prior, rng, count):
    """Return samples of the prior; where they would take an iteration, C times random rows, scaled like samples."""
    if prior.has_root:
        return prior.samples(rng, count)
    rows = rng.standard_normal((count, prior.size))
    images = prior.apply(rows)
    squares = np.einsum("ij,ij->i", rows, images)
    return images * np.sqrt(prior.size / np.maximum(squares, SMALLEST))[:, None]


class Block(NamedTuple):
    """Rows q that are orthonormal in the inner product u^T C w, and their images C q."""

    rows: NDArray
    images: NDArray

    @property
    def dimension(self) -> int:
        """The number of rows."""
        return len(self.rows)


class KrylovSpace:
    """A growing block Krylov space of H C, with a basis Q that is orthonormal in the inner product u^T C w.

    Parameters
    ----------
    product, prior, tolerance, rank
        As for `eigenpairs_of_products`.

    Attributes
    ----------
    matrix : (m, m) array
        Q^T C H C Q.
    values : (m,) array
        Eigenvalues of the matrix (Ritz values).
    residuals : (m,) array
        Norms of H C w - lambda w, relative to sqrt(1 + lambda).
    threshold : float
        The magnitude above which eigenpairs are wanted: the tolerance, the size of rounding errors of eigenvalues, or
        the magnitude above which there are `rank` of them, whichever is largest.
    products : int
        Number of products with H.
    """

    def __init__(
        self, product: Callable[[NDArray], NDArray], prior: PriorCovariance, tolerance: float, rank: int
    ) -> None:
        self._product = product
        self._prior = prior
        self._tolerance = tolerance
        self._rank = rank
        self._most = min(prior.size, 2 * rank + SPARE_BLOCKS * BLOCK)  # largest dimension
        self._blocks: list[Block] = []
        self._next = Block(np.zeros((0, prior.size)), np.zeros((0, prior.size)))  # extends the space
        self._continues = False  # whether the next block has the components of the last one outside of the space
        self._starts = 0
        self._open: list[tuple[slice, NDArray]] = []  # components of H C Q outside of the space, by blocks
        self.dimension = 0
        self.matrix = np.zeros((0, 0))
        self.values = np.zeros(0)
        self.residuals = np.zeros(0)
        self.asymmetry = 0.0
        self.products = 0
        self._vectors = np.zeros((0, 0))

    @property
    def threshold(self) -> float:
        """The magnitude above which eigenpairs are wanted."""
        if len(self.values) <= self._rank:
            return self._least_threshold
        return max(self._least_threshold, np.sort(np.abs(self.values))[-1 - self._rank])

    @property
    def _least_threshold(self):
        """The threshold without a limit of the number of pairs."""
        return max(self._tolerance, self._rounding)

    @property
    def _rounding(self):
        """The size of rounding errors of eigenvalues."""
        return max(ROUNDING * np.max(np.abs(self.values), initial=0.0), self.asymmetry)

    def count_above(self, threshold: float) -> int:
        """Return the number of Ritz values whose magnitude is clearly above a threshold."""
        return int(np.count_nonzero(np.abs(self.values) > CLEARLY_ABOVE * threshold))

    @property
    def has_converged(self) -> bool:
        """Whether all eigenpairs above the threshold have converged."""
        clearly_above = np.abs(self.values) > CLEARLY_ABOVE * self.threshold
        # Each start leaves the components outside of the last space as they are, so the next one has a looser goal.
        count = max(1, int(np.count_nonzero(clearly_above)))
        goal = self._starts * SHARE_OF_RESIDUALS * self._tolerance / np.sqrt(count)
        return bool(np.all(2 * self.residuals[clearly_above] <= max(goal, self._rounding)))

    def start(self, rows: NDArray, are_samples: bool) -> float:
        """Begin a new sequence of blocks with H times random rows; return an estimate of the norm of H C outside.

        If the rows are samples of the prior, the norm is at most ten times the estimate with probability
        1 - 10^-BLOCK. For other rows, infinity is returned unless nothing remains.
        """
        images = self._product(rows)
        self.products += len(rows)
        remainder = self._projected(images)
        squares = np.einsum("ij,ij->i", remainder, self._prior.apply(remainder))
        self._next, _ = self._orthonormalized(remainder)
        self._continues = False
        self._starts += 1
        if self._next.dimension and not are_samples:
            return np.inf
        return float(np.sqrt(np.max(np.maximum(squares, 0.0))))

    def grow_until_converged(self, least: int) -> bool:
        """Add blocks until all eigenpairs above the threshold have converged; return whether they have.

        It ends without convergence when the largest dimension is reached.

        Parameters
        ----------
        least : int
            The smallest dimension at which convergence is tested.
        """
        while self._next.dimension:
            if self.dimension + self._next.dimension > self._most:
                return False
            self._grow()
            if self.dimension >= least and self.has_converged:
                break
        return True

    def _grow(self):
        """Add the next block to the space, multiply it by H C, and update the Ritz values and residuals."""
        block = self._next
        place = slice(self.dimension, self.dimension + block.dimension)
        self._blocks.append(block)
        self.dimension = place.stop
        products = self._product(block.images)
        self.products += block.dimension
        self._extend_matrix(products, place)
        # The components outside of the space form the next block, and their coefficients give the residuals.
        self._next, components = self._orthonormalized(self._projected(products))
        if self._continues:
            self._open.pop()  # the components of the previous block are in this block
        self._continues = True
        self._open.append((place, components))
        self._update_ritz_pairs()

    def _extend_matrix(self, products, place):
        """Add the columns and rows of a block to the matrix, given its products with H."""
        columns = np.concatenate([block.images @ products.T for block in self._blocks])
        matrix = np.zeros((place.stop, place.stop))
        matrix[: place.start, : place.start] = self.matrix
        matrix[:, place] = columns
        matrix[place, : place.start] = columns[: place.start].T
        corner = matrix[place, place]
        self.asymmetry = max(self.asymmetry, _checked_asymmetry(corner, np.max(np.abs(matrix), initial=0.0)))
        matrix[place, place] = 0.5 * (corner + corner.T)
        self.matrix = matrix

    def _update_ritz_pairs(self):
        """Compute the Ritz values and residuals; raise ValueError if H + C^-1 is not positive definite."""
        self.values, self._vectors = np.linalg.eigh(self.matrix)
        if len(self.values) and self.values[0] <= -1:  # eigenvalues are at most as large as Ritz values
            raise ValueError(NEGATIVE.format(self.values[0]))
        squares = np.zeros(len(self.values))
        for place, components in self._open:
            squares += np.sum((components.T @ self._vectors[place]) ** 2, axis=0)
        self.residuals = np.sqrt(squares / (1 + self.values))

    def _projected(self, rows, blocks=None):
        """Return rows without their components in the space; they are orthogonalized twice because of rounding."""
        for _ in range(2):
            for block in self._blocks if blocks is None else blocks:
                rows = rows - (rows @ block.images.T) @ block.rows
        return rows

    def _orthonormalized(self, rows):
        """Return an orthonormal Block for rows outside of the space, and the components of the rows in it.

        Directions shorter than a fraction of the tolerance are dropped. A Gram matrix resolves directions that are
        shorter than the longest one by up to six digits. If there are others, they are found in the remainder.
        """
        dropped = max(0.01 * SHARE_OF_RESIDUALS * self._tolerance, self._rounding)
        blocks: list[Block] = []
        components = np.zeros((len(rows), 0))
        has_more = True
        while has_more:
            basis, coefficients, has_more = self._by_gram_matrix(rows, dropped)
            if not basis.dimension:
                break
            rows = rows - coefficients @ basis.rows
            # Small directions have components in the space because of rounding: remove them and normalize again.
            basis, change, _ = self._by_gram_matrix(self._projected(self._projected(basis.rows), blocks), 0.5)
            blocks.append(basis)
            components = np.concatenate([components, coefficients @ change], axis=1)
        if not blocks:
            return Block(rows[:0], rows[:0]), components
        return Block(*map(np.concatenate, zip(*blocks, strict=True))), components

    def _by_gram_matrix(self, rows, dropped):
        """Return a Block for the longest directions, the components, and whether there are shorter directions."""
        images = self._prior.apply(rows)
        gram = rows @ images.T
        check_finite("the Hessian of the misfit, in the metric of the prior,", gram, advice=RESCALE)
        squares, vectors = np.linalg.eigh(_symmetric(gram))
        resolved = ROUNDING * np.max(squares, initial=0.0)
        kept = squares > max(dropped**2, resolved)
        lengths = np.sqrt(squares[kept])
        vectors = vectors[:, kept]
        weights = (vectors / lengths).T
        return Block(weights @ rows, weights @ images), vectors * lengths, resolved > dropped**2 and not np.all(kept)

    def result(self, is_verified: bool, outside: float = np.inf) -> MisfitEigenpairs:
        """Return the eigenpairs that have converged, at most `rank`.

        Parameters
        ----------
        is_verified : bool
            Whether all eigenpairs above the threshold are in the space and have converged.
        outside : float
            The last result of `start`.
        """
        magnitudes = np.abs(self.values)
        is_whole = self.dimension == self._prior.size
        accurate = 2 * self.residuals <= max(self._tolerance, self._rounding)
        if not is_whole:
            accurate &= magnitudes > self._least_threshold
        kept = np.flatnonzero(accurate)
        kept = kept[np.argsort(-magnitudes[kept], kind="stable")][: self._rank]
        others = np.ones(len(self.values), bool)
        others[kept] = False
        if is_whole:
            neglected = np.max(magnitudes[others], initial=0.0)
        elif is_verified:
            neglected = max(np.max(magnitudes[others], initial=0.0), min(self.threshold, SAFETY * outside))
        else:
            neglected = max(self.threshold, outside, np.max((magnitudes + self.residuals)[others], initial=0.0))
        vectors = np.zeros((len(kept), self._prior.size))
        duals = np.zeros_like(vectors)
        start = 0
        for block in self._blocks:
            weights = self._vectors[start : start + block.dimension, kept].T
            duals += weights @ block.rows
            vectors += weights @ block.images
            start += block.dimension
        return MisfitEigenpairs(
            values=self.values[kept],
            vectors=vectors,
            duals=duals,
            neglected=float(neglected),
            residual=2 * float(np.linalg.norm(self.residuals[kept])),
            products=self.products,
            kind="products with the Hessian",
            is_complete=bool(neglected <= self._tolerance),
            lost_in_rounding=bool(self._tolerance < neglected <= self._rounding),
        )


def _symmetric(matrix):
    """Return the symmetric part of a matrix."""
    return 0.5 * (matrix + matrix.T)


def _checked_asymmetry(matrix, scale):
    """Return the norm of the difference of a matrix from its transpose.

    Raises
    ------
    DerivativeError
        If it is large relative to the given scale.
    NonFiniteError
        If the matrix is not finite.
    """
    check_finite("the Hessian of the misfit, in the metric of the prior,", matrix, advice=RESCALE)
    difference = norm(matrix - matrix.T)  # without squares that overflow
    if difference > ASYMMETRY * scale:
        raise DerivativeError(NOT_SYMMETRIC.format(difference / scale))
    return difference
