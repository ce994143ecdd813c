"""The argument `metric` of `minimize`: the inner product of the unknowns, which turns gradients into directions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.pytree import described, norm, power_of_two
from sparsedp._utils.validation import check_finite, check_kind
from sparsedp.autodiff.flattening import joined
from sparsedp.errors import ConvergenceError, IncompatibleError, ShapeError
from sparsedp.grid.space import fits
from sparsedp.operators.given import check_operator
from sparsedp.operators.operator import Operator
from sparsedp.solvers.cache import Cache

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.autodiff.flattening import Packing

__all__ = ["EUCLIDEAN", "Euclidean", "Metric"]

COUPLING = 1e-9  # an operator with relative off-diagonal parts below this is diagonal
ASYMMETRY = 1e-8  # tolerated relative difference of u.Mv and v.Mu, because the metric may be an iterative solve
ROUNDINGS = 10  # u.Mu is 0 if it is below this multiple of the rounding error of |u| |Mu|
INACCURACY = 0.1  # tolerated relative residual of a solve with M; near 1 if M is singular
SINGULAR = "{} must not be singular, and {} is; add a multiple of dp.identity"


class Euclidean:
    """The Euclidean inner product of flat vectors, which is the default metric.

    Attributes
    ----------
    diagonal : bool
        Whether each entry of the representer of a gradient depends only on the same entry of the gradient. Only then
        can bounds be used.
    """

    diagonal = True

    def representer(self, gradient: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return M^-1 g, the direction of steepest ascent for the gradient g."""
        return gradient

    def norm(self, vector: NDArray[np.float64]) -> float:
        """Return sqrt(u.M u)."""
        return norm(vector)

    def dual_norm(self, gradient: NDArray[np.float64]) -> float:
        """Return sqrt(g.M^-1 g), the norm of the representer of a gradient."""
        return norm(gradient)

    def square(self, vector: NDArray[np.float64], image: NDArray[np.float64]) -> float:
        """Return u.M u, given u and M u; or g.M^-1 g, given both factors."""
        return float(np.dot(vector, image))

    def length(self, vector: NDArray[np.float64], image: NDArray[np.float64]) -> float:
        """Return sqrt(u.M u), given u and M u."""
        return norm(vector)

    def unit(self, size: float) -> float:
        """Return a number near a size, by which lengths are divided."""
        return power_of_two(size)

    def restricted(self, free: NDArray[np.bool_]) -> Euclidean:
        """Return the metric of the free entries alone; the metric must be diagonal."""
        return self


EUCLIDEAN = Euclidean()


class Metric(Euclidean):
    """The inner product <u, v> = u.M v of flat vectors, with a symmetric positive definite operator M.

    Parameters
    ----------
    metric : Operator, or tree of Operators and None
        The operator M of each leaf of the unknowns, or one of a single array. None is the identity.
    packing : Packing
        The map between trees like the start and flat vectors.

    Raises
    ------
    TypeError
        If an entry is not an Operator, or is complex.
    ShapeError
        If an operator does not map fields of the shape of its leaf to such fields.
    NonFiniteError
        If a product with an operator is not finite.
    ValueError
        If test vectors show that an operator is not symmetric, not positive definite, or singular.

    Attributes
    ----------
    fingerprint : list of arrays
        Products of the operators with test vectors, which identify the metric in a checkpoint.

    Notes
    -----
    The derivative of the loss along u is g . u = <M^-1 g, u>, so that M^-1 g is its Riesz representer: the gradient in
    this inner product, and the direction of steepest ascent. The norm of the representer is sqrt(g . M^-1 g).

    The inverse of each operator is set up once. For an `Inverse`, the operator that it inverts is used for M^-1. An
    operator on fields acts on each field of a leaf with leading axes.

    References
    ----------
    T. Schwedes, D. A. Ham, S. W. Funke, M. D. Piggott, Mesh Dependence in PDE-Constrained Optimisation, Springer, 2017;
    R. Herzog, K. Kunisch, Algorithms for PDE-constrained optimization, GAMM-Mitteilungen 33, 2010.
    """

    def __init__(self, metric: Any, packing: Packing):
        advice = "write an Operator or None for each array of start"
        if isinstance(metric, Operator) and not packing.is_leaf:
            raise ShapeError(f"metric is one Operator, and start is {described(packing.template)}; {advice}")
        operators = packing.variables(metric, "metric", advice=f"; {advice}", prefix=_is_none)
        self._packing = packing
        self._blocks: list[Any] = []
        for op, x, name, x_name in zip(operators, packing.values, packing.names_under("metric"), packing.names):
            self._blocks.append(None if op is None else _Block(op, x, name, x_name))
        self._representers = Cache(1)
        self.diagonal = all(block is None or block.diagonal is not None for block in self._blocks)
        self.fingerprint = [None if block is None else block.image for block in self._blocks]

    def _mapped(self, vector, function_name):
        """Return the flat vector of the images of all leaves under one method of their blocks."""
        images = []
        for part, x, block in zip(self._packing.split(vector), self._packing.values, self._blocks):
            numbers = part.view(np.result_type(x.dtype, float)).reshape(x.shape)
            images.append(numbers if block is None else getattr(block, function_name)(numbers))
        return joined(images)

    def representer(self, gradient: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return M^-1 g, the direction of steepest ascent for the gradient g."""
        unit = power_of_two(norm(gradient))
        scaled = gradient / unit
        result = self._representers.find((scaled,))
        if result is None:
            result = self._representers.put((scaled,), self._mapped(scaled, "solve"))
        return unit * result

    def norm(self, vector: NDArray[np.float64]) -> float:
        """Return sqrt(u.M u)."""
        unit = power_of_two(norm(vector))
        scaled = vector / unit
        return unit * self.length(scaled, self._mapped(scaled, "apply"))

    def dual_norm(self, gradient: NDArray[np.float64]) -> float:
        """Return sqrt(g.M^-1 g), the norm of the representer of a gradient."""
        unit = power_of_two(norm(gradient))
        scaled = gradient / unit
        return unit * self.length(scaled, self.representer(scaled))

    def square(self, vector: NDArray[np.float64], image: NDArray[np.float64]) -> float:
        """Return u.M u, given u and M u, or g.M^-1 g, given both factors; raise ValueError if it is negative."""
        square = super().square(vector, image)
        if square < 0:
            raise ValueError(
                "metric must be positive definite, and is negative for a vector of this run; check its eigenvalues"
            )
        return square

    def length(self, vector: NDArray[np.float64], image: NDArray[np.float64]) -> float:
        """Return sqrt(u.M u), given u and M u."""
        return float(np.sqrt(self.square(vector, image)))

    def unit(self, size: float) -> float:
        """Return the size itself, or 1 for 0, so that the run does not depend on the scale of M."""
        return size or 1.0

    def restricted(self, free: NDArray[np.bool_]) -> Euclidean:
        """Return the metric of the free entries alone; the metric must be diagonal."""
        return _Restricted(self, free)


def _is_none(leaf):
    """Return whether an entry of the metric is None, which may stand for a whole branch."""
    return leaf is None


class _Restricted(Euclidean):
    """A diagonal metric of some of the entries."""

    def __init__(self, metric, free):
        self._metric = metric
        self._free = free

    def representer(self, gradient):
        """Return M^-1 g for the free entries."""
        whole = np.zeros(len(self._free))
        whole[self._free] = gradient
        return self._metric.representer(whole)[self._free]


class _Block:
    """The operator M of one leaf, its inverse, and its diagonal if it has no other entries.

    Attributes
    ----------
    diagonal : array or None
    image : array
        The product of M with a test vector.
    """

    def __init__(self, op: Operator, x: NDArray[Any], name: str, x_name: str):
        check_operator(name, op)
        check_kind(name, op.dtype, "real numbers")
        shape = op.domain.shape
        if not fits(op.domain, op.codomain) or x.shape[x.ndim - len(shape) :] != shape:
            raise ShapeError(
                f"{name} must map arrays of the shape of {x_name}, {x.shape}, to such arrays, got {op.name} from "
                f"{op.domain} to {op.codomain}"
            )
        self.apply, self.diagonal, self.image = _checked(op, name)
        self._solve = None
        if self.diagonal is None:
            self._solve = _inverse(op, name)

    def solve(self, g):
        """Return M^-1 g."""
        if self._solve is None:
            return g / self.diagonal
        return self._solve(g)


def _checked(op, name):
    """Return the product with M, its diagonal or None, and a product; raise an error if M is no inner product."""
    draw = np.random.default_rng(0)
    one = draw.uniform(0.5, 1.5, op.domain.shape)  # with a part along the null vectors of Laplacians
    other = draw.standard_normal(op.domain.shape)
    ones = np.ones(op.domain.shape)
    try:
        images = [op.apply(vector) for vector in (one, other, ones)]
    except IncompatibleError:  # the metric is the inverse of a singular operator
        raise ValueError(SINGULAR.format(name, op.name)) from None
    check_finite(f"the product with {name}", images)
    one_image, other_image, row_sums = images
    size = norm(one) * norm(other_image) + norm(other) * norm(one_image)
    if not abs(np.sum(one * other_image) - np.sum(other * one_image)) <= ASYMMETRY * size:
        raise ValueError(
            f"{name} must be symmetric, and {op.name} is not; on a grid with cells of different volume multiply it by "
            "them, as in dp.diagonal(grid.cells, grid.volumes) @ op"
        )
    _check_positive(name, op, ((one, one_image), (other, other_image), (ones, row_sums)))
    diagonal = None
    if np.all(np.abs(one_image - row_sums * one) <= COUPLING * np.abs(row_sums * one)):
        diagonal = row_sums
        if not np.all(diagonal > 0):
            raise ValueError(f"{name} must be positive definite, and has the diagonal entry {float(diagonal.min()):g}")
    return op.apply, diagonal, one_image


def _check_positive(name, op, pairs):
    """Raise ValueError unless u.M u is positive for all pairs of u and M u."""
    largest_image = max(norm(image) / (norm(vector) or 1.0) for vector, image in pairs)
    for vector, image in pairs:
        square = float(np.sum(vector * image))
        rounding = ROUNDINGS * np.finfo(float).eps * largest_image * norm(vector) ** 2
        if abs(square) <= rounding and vector.size:
            raise ValueError(SINGULAR.format(name, op.name))
        if square < 0:
            raise ValueError(
                f"{name} must be positive definite, and {op.name} is not; check its sign: -dp.laplacian(grid) has "
                "positive eigenvalues"
            )


def _inverse(op, name):
    """Return the function that multiplies by M^-1; raise ValueError if M is singular."""
    from sparsedp.solvers.inverse import Inverse, inverse

    test = np.random.default_rng(1).uniform(0.5, 1.5, op.domain.shape)
    try:
        if isinstance(op, Inverse):
            inverted = op.solver.system.unscaled
            null_space = op.solver.system.null_space
            residual = inverted.apply(op.apply(test)) - test
        else:
            inverted = inverse(op, nullspace="project")
            null_space = inverted.solver.system.null_space
            residual = op.apply(inverted.apply(test)) - test
    except ConvergenceError as error:
        raise ValueError(f"{name} has no inverse: {error}") from None
    if null_space.count or not norm(residual) <= INACCURACY * norm(test):
        raise ValueError(SINGULAR.format(name, op.name))
    return inverted.apply
