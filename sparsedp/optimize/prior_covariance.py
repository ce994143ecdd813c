"""The prior covariance of `laplace`: its products, checks, samples and diagonal."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg

from sparsedp._utils.base_classes import Uncached
from sparsedp._utils.pytree import keys, norm, paired
from sparsedp._utils.validation import EPS, check_finite, check_type, is_number
from sparsedp.errors import ConvergenceError, ShapeError
from sparsedp.operators.given import check_operator
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Matrix
from sparsedp.solvers.separable import find_eigenbasis
from sparsedp.solvers.spectral import matrix_power

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.autodiff.flattening import Packing

__all__ = ["PriorCovariance"]

MOST_COLUMNS = 1024  # the matrix of a covariance with at most this many columns is computed where it is needed
COLUMNS_AT_ONCE = 256  # products with columns of the identity that are computed in one batch
TEST_VECTORS = 4
SYMMETRY = 1e-6  # largest relative difference of u . C v from v . C u; products by solves have errors of about 1e-10
LANCZOS_STEPS = 25  # steps of the Lanczos iteration that looks for negative eigenvalues
NULL = 1e-10  # relative size of C 1 that counts as 0
NEGATIVE = 1e-8  # relative size of an eigenvalue < 0 that is not rounding, where the matrix is not computed
ROOT_ACCURACY = 1e-4  # relative change of C^(1/2) z between two sizes of the Krylov space at which it is accepted
ROOT_STEPS = 400  # largest dimension of this Krylov space
ROOT_INTERVAL = 10  # steps between two comparisons

ADVICE = "; write an Operator for the array x, one for the flattened x, or a tree of them like x"
SINGULAR = "{} is singular: {}; add a small multiple of dp.identity, and remove known entries from x"
INDEFINITE = "{} has negative eigenvalues, down to {:.1e}; a covariance is positive definite"
NOT_SYMMETRIC = (
    "{} is not symmetric (relative difference {:.1e}); for a power of an operator on a stretched grid write "
    "C @ dp.diagonal(grid.cells, 1 / grid.volumes)"
)
NO_ROOT = (
    "the square root of {} was not found in {} products (relative change {:.0e}); "
    "write prior_root=R, with R @ R.T equal to the prior"
)
OTHER_ROOT = "prior_root must satisfy R @ R.T = prior, but the products of {} differ by {:.1e}"


class PriorBlock(Uncached):
    """The prior covariance of one part of the flattened unknowns: a variance, or an Operator.

    Parameters
    ----------
    name : str
        For messages.
    covariance : float or Operator
        A number stands for a multiple of the identity.
    part : slice
        Of the flattened unknowns.
    root : Operator, optional
        R with R @ R.T = C.
    """

    def __init__(self, name: str, covariance: Any, part: slice, root: Operator | None = None) -> None:
        self.name = name
        self.covariance = covariance
        self.part = part
        self.size = part.stop - part.start
        self.root = root

    def apply(self, rows: NDArray) -> NDArray:
        """Return C times each row of an array of shape (m, size)."""
        return _product(self.covariance, rows)

    @cached_property
    def eigenbasis(self) -> Any:
        """The eigenvectors and eigenvalues of a diagonal or of a function of a separable operator; else None."""
        if isinstance(self.covariance, Operator):
            return find_eigenbasis(self.covariance.structure)
        return None

    @cached_property
    def matrix(self) -> NDArray | None:
        """C as a dense array, symmetric to the last bit, if it is small; else None."""
        if self.size > MOST_COLUMNS:
            return None
        matrix = self.columns()
        return 0.5 * (matrix + matrix.T)

    def columns(self) -> NDArray:
        """Return C as a dense array."""
        batches = [self.apply(unit) for unit in unit_rows(self.size)]
        return np.concatenate(batches)

    @cached_property
    def _matrix_root(self):
        """The symmetric square root of the dense matrix."""
        assert self.matrix is not None
        eigenvalues, vectors = np.linalg.eigh(self.matrix)
        return (vectors * np.sqrt(np.maximum(eigenvalues, 0.0))) @ vectors.T

    @cached_property
    def diagonal(self) -> NDArray | None:
        """The variances C[i, i], if they can be computed exactly with few products; else None."""
        if not isinstance(self.covariance, Operator):
            return np.full(self.size, self.covariance)
        if self.eigenbasis is not None:
            spectrum, values = self.eigenbasis
            return spectrum.diagonal(values)
        if isinstance(self.covariance.structure, Matrix):
            return self.covariance.matrix.diagonal()
        if self.matrix is not None:
            return np.diagonal(self.matrix).copy()
        return None

    @property
    def has_root(self) -> bool:
        """Whether C^(1/2) z takes no Krylov iteration."""
        if self.root is not None or not isinstance(self.covariance, Operator):
            return True
        return self.eigenbasis is not None or self.size <= MOST_COLUMNS

    @property
    def root_size(self) -> int:
        """The number of standard normal numbers from which a sample is computed."""
        return self.size if self.root is None else self.root.domain.size

    def samples(self, normal: NDArray) -> NDArray:
        """Return samples of the prior, rows of shape (m, size), from standard normal rows of shape (m, root_size)."""
        if self.root is not None:
            return _product(self.root, normal)
        if not isinstance(self.covariance, Operator):
            return np.sqrt(self.covariance) * normal
        if self.eigenbasis is not None:
            return _product(matrix_power(self.covariance, 0.5), normal)
        if self.matrix is not None:
            return normal @ self._matrix_root
        return np.array([self._krylov_root(row) for row in normal])

    def _krylov_root(self, normal):
        """Return C^(1/2) z by Lanczos iteration: |z| V T^(1/2) e_1, with the basis V and the tridiagonal matrix T.

        Raises
        ------
        ConvergenceError
            If the result still changes after ROOT_STEPS products.

        References
        ----------
        E. Chow, Y. Saad, Preconditioned Krylov subspace methods for sampling multivariate Gaussian distributions, SIAM
        J. Sci. Comput. 36, 2014.
        """
        size = np.linalg.norm(normal)
        previous = None
        change: Any = np.inf
        for basis, diagonal, side in lanczos(self.apply, normal, ROOT_STEPS):
            steps = len(diagonal)
            if steps % ROOT_INTERVAL and side[-1] > 0:
                continue
            eigenvalues, vectors = scipy.linalg.eigh_tridiagonal(diagonal, side[:-1])
            weights = vectors @ (np.sqrt(np.maximum(eigenvalues, 0.0)) * vectors[0])
            root = size * (weights @ np.array(basis))
            if side[-1] == 0:
                return root
            if previous is not None:
                change = np.linalg.norm(root - previous) / np.linalg.norm(root)
                if change <= ROOT_ACCURACY:
                    return root
            previous = root
        raise ConvergenceError(NO_ROOT.format(self.name, ROOT_STEPS, change), best=previous)

    def check(self) -> None:
        """Raise an error unless C is finite, symmetric and positive definite, as far as test vectors show.

        Raises
        ------
        ValueError
        NonFiniteError
            If a product is not finite.
        """
        if not isinstance(self.covariance, Operator) and self.root is None:
            return
        tests = np.random.default_rng(0).standard_normal((TEST_VECTORS, self.size))
        images = self.apply(tests)
        check_finite(f"a product with {self.name}", images)
        self._check_symmetry(tests, images)
        if self.root is not None:
            self._check_root(self.root, tests, images)  # R @ R.T has no negative eigenvalue
        else:
            self._check_eigenvalues(tests[0])

    def _check_symmetry(self, tests, images):
        """Raise ValueError if products u . C v and v . C u of test vectors differ."""
        products = tests @ images.T
        # The typical size of u . C v for independent u and v.
        scale = max(map(norm, images)) or 1.0
        difference = np.max(np.abs(products - products.T)) / scale
        if difference > SYMMETRY:
            raise ValueError(NOT_SYMMETRIC.format(self.name, difference))

    def _check_root(self, root, tests, images):
        """Raise ValueError if products of test vectors with R R^T and with C differ."""
        by_root = _product(root, _product(root.T, tests))
        difference = norm(by_root - images) / (norm(images) or 1.0)
        if not difference <= SYMMETRY:
            raise ValueError(OTHER_ROOT.format(self.name, difference))

    def _check_eigenvalues(self, start):
        """Raise ValueError if C has a negative eigenvalue or is singular, as far as a Lanczos iteration shows."""
        largest, smallest, rounding = self._extreme_eigenvalues(start)
        if smallest < -rounding * abs(largest):
            raise ValueError(INDEFINITE.format(self.name, smallest))
        if not largest > 0:
            raise ValueError(SINGULAR.format(self.name, "it maps test vectors to 0"))
        is_exact = self.eigenbasis is not None or self.matrix is not None
        if is_exact and smallest <= rounding * largest:
            raise ValueError(SINGULAR.format(self.name, "its smallest eigenvalue is 0"))
        constant = np.ones((1, self.size))
        if norm(self.apply(constant)) <= NULL * largest * np.sqrt(self.size):
            raise ValueError(SINGULAR.format(self.name, "it maps a constant to 0"))

    def _extreme_eigenvalues(self, start):
        """Return the largest eigenvalue, the smallest one, and the relative size up to which the latter is rounding.

        They are exact for eigenbases and small matrices, and estimates by Lanczos iteration otherwise.
        """
        if self.eigenbasis is not None:
            values = self.eigenbasis.eigenvalues
            return np.max(values), np.min(values), 0.0
        if self.matrix is not None:
            values = scipy.linalg.eigvalsh(self.matrix)
            return values[-1], values[0], self.size * EPS
        _, diagonal, side = list(lanczos(self.apply, start, LANCZOS_STEPS))[-1]
        values = scipy.linalg.eigvalsh_tridiagonal(diagonal, side[:-1])
        return values[-1], values[0], NEGATIVE


def _product(factor, rows):
    """Return a number or an Operator times each row."""
    if not isinstance(factor, Operator):
        return factor * rows
    fields = rows.reshape(len(rows), *factor.domain.shape)
    return np.asarray(factor.tangent(fields)).reshape(len(rows), factor.codomain.size)


def unit_rows(size: int) -> Iterator[NDArray]:
    """Yield the rows of the identity in batches."""
    for start in range(0, size, COLUMNS_AT_ONCE):
        count = min(COLUMNS_AT_ONCE, size - start)
        rows = np.zeros((count, size))
        rows[np.arange(count), start + np.arange(count)] = 1.0
        yield rows


def lanczos(apply: Any, start: NDArray, most: int) -> Iterator[tuple[list, list, list]]:
    """Yield after each step of the Lanczos iteration the basis, and the diagonal and off-diagonal of the matrix in it.

    The last off-diagonal entry is the norm of the remainder; it is 0 when the Krylov space is complete. All vectors are
    orthogonalized against each other.
    """
    basis = [start / np.linalg.norm(start)]
    diagonal: list[float] = []
    side: list[float] = []
    for _ in range(most):
        image = apply(basis[-1][None])[0]
        diagonal.append(float(basis[-1] @ image))
        scale = np.linalg.norm(image)
        vectors = np.array(basis)
        for _ in range(2):
            image = image - (vectors @ image) @ vectors
        length = float(np.linalg.norm(image))
        if length <= 100 * EPS * scale or len(basis) == start.size:
            length = 0.0
        side.append(length)
        yield basis, diagonal, side
        if length == 0:
            return
        basis.append(image / length)


class PriorCovariance:
    """The prior covariance of the flattened unknowns, block diagonal with one block for each operator.

    Vectors are rows of arrays of shape (m, n).

    Parameters
    ----------
    prior : Operator, number, or tree of them
    root : Operator or tree of them, or None
    packing : Packing
        Of the unknowns.

    Attributes
    ----------
    blocks : list of PriorBlock
    size : int
        The number of unknowns n.

    Raises
    ------
    TypeError
        If an entry is neither an Operator nor a number.
    ShapeError
        If an entry does not fit the unknowns.
    ValueError
        If a variance is not positive, or an operator is not symmetric and positive definite.
    """

    def __init__(self, prior: Any, root: Any, packing: Packing) -> None:
        self.size = packing.size
        self.blocks = _blocks(prior, root, packing)
        for block in self.blocks:
            if block.size:
                block.check()

    def apply(self, rows: NDArray) -> NDArray:
        """Return C times each row."""
        if not rows.size:
            return rows.copy()
        return np.concatenate([block.apply(rows[:, block.part]) for block in self.blocks], axis=1)

    def samples(self, rng: np.random.Generator, count: int) -> NDArray:
        """Return samples of N(0, C) as rows.

        Raises
        ------
        ConvergenceError
            If a square root is computed iteratively and does not converge.
        """
        parts = [block.samples(rng.standard_normal((count, block.root_size))) for block in self.blocks if block.size]
        if not parts:
            return np.zeros((count, 0))
        return np.concatenate(parts, axis=1)

    @property
    def has_root(self) -> bool:
        """Whether samples take no Krylov iteration."""
        return all(block.has_root for block in self.blocks)

    def traces(self) -> list[float]:
        """Return the trace of each block, exact or from a few random vectors."""
        return [_trace(block) for block in self.blocks]


def _trace(block):
    """Return the trace of a block: the sum of its variances, or Hutchinson's estimate from random signs."""
    if block.diagonal is not None:
        return float(np.sum(block.diagonal))
    signs = np.random.default_rng(1).choice([-1.0, 1.0], (16, block.size))
    return float(np.mean(np.sum(signs * block.apply(signs), axis=1)))


def _blocks(prior, root, packing):
    """Return the blocks of the prior: one for all unknowns, or one for each floating leaf of a tree."""
    if keys(prior) is None:
        shape = packing.values[0].shape if len(packing.values) == 1 else (packing.size,)
        covariance = _checked("the prior", prior, shape, "x" if len(packing.values) == 1 else "the flattened x")
        return [PriorBlock("the prior", covariance, slice(0, packing.size), _checked_root(root, shape))]
    roots = [None] * len(packing.values)
    if root is not None:
        roots = _in_order(root, packing, "prior_root")
    blocks = []
    start = 0
    covariances = _in_order(prior, packing, "prior")
    for name, covariance, own_root, value in zip(
        packing.names_under("prior"), covariances, roots, packing.values, strict=True
    ):
        checked = _checked(name, covariance, value.shape, name.replace("prior", "x", 1))
        part = slice(start, start + value.size)
        blocks.append(PriorBlock(name, checked, part, _checked_root(own_root, value.shape)))
        start = part.stop
    return blocks


def _in_order(entries, packing, name):
    """Return the entries for the floating leaves of x, in their order."""
    ordered = paired(entries, packing.template, name, advice=ADVICE)
    return [ordered[place] for place in packing.places]


def _checked(name, covariance, shape, unknowns):
    """Return an entry of the prior, a positive float or an Operator that fits unknowns of this shape."""
    if not isinstance(covariance, Operator) and is_number(covariance):
        if not 0 < covariance < np.inf:
            raise ValueError(f"a number as {name} is a variance and must be > 0 and finite, got {covariance}")
        return float(covariance)
    example = "dp.diagonal(grid.cells, variances), or dp.from_matrix(matrix, grid.cells, grid.cells)"
    check_type(name, covariance, Operator, "an Operator or a variance", example)
    check_operator("laplace", covariance)
    if covariance.shape[0] != covariance.shape[1] or not _fits(covariance.domain, shape):
        raise ShapeError(
            f"{name} maps {covariance.domain} to {covariance.codomain}, but {unknowns} has shape {shape}{ADVICE}"
        )
    _check_real(name, covariance)
    return covariance


def _fits(space, shape):
    """Whether unknowns of this shape are fields on the space, or flat arrays of such a field."""
    return shape == space.shape or shape == (space.size,) or (shape == () and space.size == 1)


def _checked_root(root, shape):
    """Return a root that fits unknowns of this shape, or None."""
    if root is None:
        return None
    check_type("prior_root", root, Operator, "an Operator", "prior_root=R, with R @ R.T equal to the prior")
    check_operator("laplace", root)
    if not _fits(root.codomain, shape):
        raise ShapeError(
            f"prior_root maps to {root.codomain}, but the unknowns have shape {shape}; write R with R @ R.T equal to "
            "the prior"
        )
    _check_real("prior_root", root)
    return root


def _check_real(name, op):
    """Raise TypeError if an operator is complex."""
    if op.dtype.kind == "c":
        raise TypeError(f"{name} has complex entries; laplace takes real unknowns and a real covariance")
