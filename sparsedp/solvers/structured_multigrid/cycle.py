"""The levels of the structured multigrid, the transfer between them, and the V-cycle.

Notes
-----
Black-box interpolation takes its weights from the equations of the cells themselves, so it follows jumps of the
coefficients. A fine cell between two coarse ones is interpolated by its equation summed up across the line between
them; a cell between four coarse ones by its equation summed up across their plane; a cell between eight by its own
equation, given the values of all cells around it. Coarse matrices are Galerkin products P^T A P.

References
----------
J. E. Dendy, Black box multigrid, J. Comput. Phys. 48 (1982) 366-386.
J. E. Dendy, Two multigrid methods for three-dimensional problems with discontinuous and anisotropic coefficients,
SIAM J. Sci. Stat. Comput. 8 (1987) 673-685.
"""

from __future__ import annotations

from itertools import product
from math import prod
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.sparse.linalg import LinearOperator, eigsh

from sparsedp.solvers.structured_multigrid import loops
from sparsedp.solvers.structured_multigrid.loops import neighbour_steps

if TYPE_CHECKING:
    from numpy.typing import DTypeLike, NDArray

    from sparsedp.solvers.structured_multigrid.loops import PaddedGrid

    Step = tuple[int, ...]

__all__ = ["Hierarchy", "Level", "Transfer", "build_hierarchy", "interpolation_weights"]

COARSEST_CELLS = 100  # a level of at most this many cells is solved by a dense matrix
ZERO_EIGENVALUE = 1e-14  # eigenvalues of a matrix with a unit diagonal that count as 0
EXTRA_ROUNDING = 1e-10  # an extra below this share of the diagonal is rounding
WEIGHT_ROUNDING = 1e-12  # a sum of weights differs from 1 by at most this because of rounding
SMOOTHING_RATIO = 4.0  # the smoother damps eigenvalues from the largest one down to the largest one divided by this
ACCURATE_BOUND = 2.5  # an eigenvalue bound up to this is used as it is; without negative links it is at most 2
LANCZOS_MARGIN = 1.05  # factor on a Lanczos estimate of the largest eigenvalue; the smoother converges up to 1.25
WEAK_RATIO = 0.1  # a cell is weak along an axis whose links are below this share of those along another axis
SMALLEST_HOLD = 1e-10  # a fine cell is interpolated if its summed equation exceeds this share of its diagonal
EXAMINED_CELLS = 1000  # smaller levels are not examined for weak cells


class Level:
    """A symmetric matrix on a grid: x.A x = sum of a_ij (x_i - x_j)^2 over linked cells + sum of extra_i x_i^2.

    Parameters
    ----------
    grid : PaddedGrid
    steps : list of tuple of int
        Steps to the neighbours that a cell is linked to; of two opposite steps only the forward one.
    links : array, shape (steps, *grid.padded_shape)
        The coefficients a for each step. Ghost cells are filled here.
    extra : array, shape grid.padded_shape
    singular : bool array, shape grid.padded_shape
        Cells of singular components, where `extra` is 0 up to rounding.
    dtype : float32 or float64
        Precision of the cycle.

    Attributes
    ----------
    distances : int array
        Distance in the flat array of the neighbour at each step.
    neighbour_links : dict
        For each forward or backward step the field of links in that direction.
    root_diagonal, inverse_root : fields
        Square root of the diagonal and its reciprocal; 0 where there is no unknown.
    scaled_links : array
        Links of the matrix scaled to a unit diagonal, in double precision.
    plane_sums : array
        The scalar product of `apply_scaled`, plane by plane.
    eigenvalue_bound : float
        Gershgorin's bound of the eigenvalues of the matrix scaled to a unit diagonal.
    weak_share : float
        Share of the cells that are held much more weakly along one axis than along another; 0 on a small level.
    """

    def __init__(
        self,
        grid: PaddedGrid,
        steps: list[Step],
        links: NDArray[Any],
        extra: NDArray[Any],
        singular: NDArray[Any],
        dtype: DTypeLike,
    ) -> None:
        self.grid = grid
        self.steps = steps
        self.dtype = dtype
        self.plane_sums = np.zeros(grid.shape[0])
        self.links = grid.fill_ghosts(links)
        self.singular = grid.fill_ghosts(singular)
        self.extra = grid.fill_ghosts(np.where(singular, 0.0, extra))
        self.distances = np.array(steps) @ grid.strides
        self.neighbour_links = self._links_in_all_directions()
        self.weak_share = self._share_of_weak_cells()
        diagonal = sum(self.neighbour_links.values(), self.extra)
        self.root_diagonal = np.sqrt(np.maximum(diagonal, 0.0))
        self.inverse_root = np.divide(1.0, self.root_diagonal, out=grid.zeros(), where=self.root_diagonal > 0.0)
        row_sums = sum(map(abs, self.neighbour_links.values())) * self.inverse_root**2
        self.eigenvalue_bound = 1.0 + float(np.max(row_sums))
        self.scaled_links = grid.zeros(len(steps))
        for scaled, link, step in zip(grid.cells(self.scaled_links), self.links, steps):
            scaled[...] = grid.cells(link) * grid.cells(self.inverse_root) * grid.cells(self.inverse_root, step)
        grid.fill_ghosts(self.scaled_links)

    def _links_in_all_directions(self):
        """Collect the links of forward steps, and those of backward steps, which are read at the neighbour."""
        grid = self.grid
        links = dict(zip(self.steps, self.links))
        for step, link in zip(self.steps, self.links):
            opposite = tuple(-d for d in step)
            backward_link = grid.zeros()
            grid.cells(backward_link)[...] = grid.cells(link, opposite)
            links[opposite] = grid.fill_ghosts(backward_link)
        return links

    def _share_of_weak_cells(self):
        links_along_axes = [
            sum(link for step, link in self.neighbour_links.items() if step[axis]) for axis in range(self.grid.dim)
        ]
        weakest = np.min(links_along_axes, axis=0)
        strongest = np.max(links_along_axes, axis=0)
        is_weak = self.grid.cells(weakest < WEAK_RATIO * strongest)
        if is_weak.size < EXAMINED_CELLS:
            return 0.0
        return np.count_nonzero(is_weak) / is_weak.size

    def apply_scaled(self, x: NDArray[Any], out: NDArray[Any]) -> NDArray[Any]:
        """Set out = A x with A scaled to a unit diagonal, in double precision, and store x . out in `plane_sums`.

        The ghost cells of x must be filled.
        """
        self.grid.run(loops.apply_matrix, self.scaled_links, x, out, self.distances, self.grid.sizes, self.plane_sums)
        return out

    def scaled_operator(self) -> LinearOperator:
        """Return the matrix scaled to a unit diagonal as an operator on flat vectors in natural order."""
        grid = self.grid
        x, image = grid.zeros(2)
        size = prod(grid.shape)

        def matvec(vector):
            grid.cells(x)[...] = vector.reshape(grid.shape)
            return grid.cells(self.apply_scaled(grid.fill_ghosts(x), image)).flatten()

        return LinearOperator((size, size), matvec=matvec, dtype=float)

    def largest_eigenvalue(self) -> float:
        """Return a close upper bound of the eigenvalues of the matrix scaled to a unit diagonal."""
        if self.eigenvalue_bound <= ACCURATE_BOUND:
            return self.eigenvalue_bound
        start = np.random.default_rng(0).standard_normal(prod(self.grid.shape))
        tolerance = LANCZOS_MARGIN - 1.0
        estimate = eigsh(self.scaled_operator(), 1, which="LA", v0=start, tol=tolerance, return_eigenvectors=False)
        return min(self.eigenvalue_bound, LANCZOS_MARGIN * float(estimate[0]))

    def coarsened(self) -> tuple[Level, Transfer]:
        """Return the next coarser level, with the Galerkin matrix P^T A P, and the transfer between the levels."""
        grid = self.grid
        coarse = grid.coarse()
        steps = neighbour_steps(grid.dim)
        weights = interpolation_weights(self)
        forward_steps, links = self._galerkin_links(coarse, dict(zip(steps, weights)))
        singular = self._coarse_singular_cells(coarse, steps, weights)
        for weight, step in zip(coarse.cells(weights), steps):  # now for the matrix scaled to a unit diagonal
            weight *= grid.cells(self.root_diagonal, step, 2)
        extra = self._coarse_extra(Transfer(grid, coarse, coarse.fill_ghosts(weights)))
        lost = singular & (np.abs(extra) > EXTRA_ROUNDING * np.abs(links).sum(axis=0))
        _remove_negative_links(coarse, forward_steps, links, lost)
        level = Level(coarse, forward_steps, links, extra, singular, self.dtype)
        return level, Transfer(grid, coarse, (weights * level.inverse_root).astype(self.dtype))

    def _galerkin_links(self, coarse, weights):
        """Return the forward steps of P^T A P and its links: sums over the fine entries between two coarse cells."""
        steps = neighbour_steps(coarse.dim)
        forward_steps = steps[len(steps) // 2 + 1 :]
        links = coarse.zeros(len(forward_steps))
        centre = (0,) * coarse.dim
        entries = self.neighbour_links | {centre: -sum(self.neighbour_links.values())}
        for link, step in zip(coarse.cells(links), forward_steps):
            leads_to_another_cell = any(
                d and (n > 1 or not periodic) for d, n, periodic in zip(step, coarse.shape, coarse.periodic)
            )
            if not leads_to_another_cell:
                continue
            for (side, weight), (entry_step, entry) in product(weights.items(), entries.items()):
                # the place of the fine neighbour, as seen from the coarse neighbour
                far_side = tuple(s + d - 2 * t for s, d, t in zip(side, entry_step, step))
                if far_side in weights:
                    far_weight = coarse.cells(weights[far_side], step)
                    link += coarse.cells(weight) * self.grid.cells(entry, side, 2) * far_weight
        return forward_steps, links

    def _coarse_singular_cells(self, coarse, steps, weights):
        """Return flags of the coarse cells whose fine cells all belong to singular components."""
        is_unknown = self.root_diagonal > 0.0
        reaches_singular = np.zeros(coarse.shape, dtype=bool)
        reaches_regular = np.zeros(coarse.shape, dtype=bool)
        for weight, step in zip(weights, steps):
            has_weight = coarse.cells(weight) != 0
            reaches_singular |= self.grid.cells(self.singular & is_unknown, step, 2) & has_weight
            reaches_regular |= self.grid.cells(~self.singular & is_unknown, step, 2) & has_weight
        flags = coarse.zeros(dtype=bool)
        coarse.cells(flags)[...] = reaches_singular & ~reaches_regular
        return flags

    def _coarse_extra(self, transfer):
        """Return the row sums of P^T A P: P^T times the image of the constant.

        A is applied only to the part of the constant that P does not reproduce, so that no large terms cancel.
        """
        grid, coarse = self.grid, transfer.coarse
        missing = self.root_diagonal - transfer.prolong(np.ones(coarse.padded_shape), grid.zeros())
        missing[np.abs(missing) <= WEIGHT_ROUNDING * self.root_diagonal] = 0.0
        image = self.inverse_root * self.extra - self.apply_scaled(grid.fill_ghosts(missing), grid.zeros())
        return transfer.restrict(grid.fill_ghosts(image), coarse.zeros())


def _remove_negative_links(grid, steps, links, flags):
    """Set negative links of the flagged cells to 0.

    A fine cell beside an obstacle that cannot be interpolated along its axis has no weights. The constant is then not
    reproduced exactly, and the Galerkin product has an extra at a singular cell where the matrix has none. That extra
    is dropped, so that the coarse matrix has the same null vector; without negative links around it, the matrix keeps
    having no negative eigenvalues.
    """
    grid.fill_ghosts(flags)
    for link, step in zip(grid.cells(links), steps):
        touched = grid.cells(flags) | grid.cells(flags, step)
        link[touched & (link < 0.0)] = 0.0


# ---- black-box interpolation ----------------------------------------------------------------------------------------


class Transfer:
    """Interpolation from a coarse grid to a fine one, and restriction, its transpose.

    Parameters
    ----------
    fine, coarse : PaddedGrid
    weights : array, shape (3^dim, *coarse.padded_shape)
        For each step around a coarse cell the weight of that coarse cell at the fine cell there.
    """

    def __init__(self, fine: PaddedGrid, coarse: PaddedGrid, weights: NDArray[Any]) -> None:
        self.fine = fine
        self.coarse = coarse
        self.weights = weights
        self.distances = np.array(neighbour_steps(fine.dim)) @ fine.strides

    def restrict(self, residual: NDArray[Any], out: NDArray[Any]) -> NDArray[Any]:
        """Set out = P^T residual; the ghost cells of the residual must be filled."""
        arguments = (self.weights, residual, out, self.distances, self.fine.sizes, self.coarse.sizes)
        self.coarse.run(loops.restrict, *arguments)
        self.coarse.fill_ghosts_compiled(out)
        return out

    def prolong(self, correction: NDArray[Any], x: NDArray[Any]) -> NDArray[Any]:
        """Add P correction to x; the ghost cells of the correction must be filled."""
        self.fine.run(loops.prolong, self.weights, correction, x, self.fine.sizes, self.coarse.sizes)
        self.fine.fill_ghosts_compiled(x)
        return x


def interpolation_weights(level: Level) -> NDArray[Any]:
    """Compute the weights of black-box interpolation from the next coarser grid.

    Parameters
    ----------
    level : Level

    Returns
    -------
    array, shape (3^dim, *coarse.padded_shape)
        The weights of `Transfer`. A ghost cell holds the weights as seen from there.
    """
    grid = level.grid
    coarse = grid.coarse()
    # Parity by flags, not by steps: at the ends of a periodic axis of odd length two even cells are neighbours.
    is_odd = grid.zeros(grid.dim, dtype=bool)
    grid.cells(is_odd)[...] = np.indices(grid.shape) % 2
    grid.fill_ghosts(is_odd)
    steps = neighbour_steps(grid.dim)
    centre = (0,) * grid.dim
    weights = coarse.zeros(len(steps))
    weight_at = dict(zip(steps, coarse.cells(weights)))  # views
    weight_at[centre][...] = 1.0
    computed = {centre}
    for side in sorted(steps, key=np.count_nonzero)[1:]:  # cells between two coarse ones, then four, then eight
        total = grid.cells(level.extra, side, 2).copy()
        weight = weight_at[side]
        for step, link in level.neighbour_links.items():
            offset = tuple(d * abs(s) for d, s in zip(step, side))  # links along the other axes are summed up
            if not any(offset):
                continue
            share = grid.cells(link, side, 2)
            total += share
            neighbour = tuple(s + d for s, d in zip(side, offset))
            if neighbour in computed:
                weight += share * weight_at[neighbour]
        parity = np.array(side, bool).reshape(-1, *(1,) * grid.dim)
        is_interpolated = np.all(grid.cells(is_odd, side, 2) == parity, axis=0)
        is_interpolated &= total > SMALLEST_HOLD * grid.cells(level.root_diagonal, side, 2) ** 2
        weight *= np.divide(1.0, total, out=np.zeros_like(total), where=is_interpolated)
        computed.add(side)
    coarse.fill_ghosts(weights)
    for axis, periodic in enumerate(grid.periodic):
        if periodic and grid.shape[axis] % 2:
            _shift_ghost_weights(coarse, weights, axis)
    return weights


def _shift_ghost_weights(coarse, weights, axis):
    """Correct the ghost weights of a periodic axis with an odd number of fine cells.

    There the first coarse cell lies one fine cell after the last coarse one, not two.
    """
    first = coarse.ghosts[axis]
    last = first + coarse.shape[axis] - 1
    by_side = weights.reshape(*(3,) * coarse.dim, *coarse.padded_shape)
    by_side = np.moveaxis(by_side, (axis, coarse.dim + axis), (0, 1))
    by_side[:2, last + 1] = by_side[1:, first]
    by_side[2, last + 1] = 0.0
    by_side[1:, first - 1] = by_side[:2, last]
    by_side[0, first - 1] = 0.0


# ---- the cycle ------------------------------------------------------------------------------------------------------


class SmoothedLevel:
    """A level in the cycle, smoothed by the Chebyshev polynomial of degree 2.

    Attributes
    ----------
    b, x : fields
        Right-hand side and solution, with ghost cells filled.
    transfer : Transfer
        To the next coarser level.
    coarser : SmoothedLevel or CoarsestLevel
    """

    transfer: Transfer
    coarser: SmoothedLevel | CoarsestLevel

    def __init__(self, level: Level) -> None:
        self.grid = level.grid
        self.distances = level.distances
        self.scaled_links = level.scaled_links.astype(level.dtype, copy=False)
        self.b, self.x, self.residual = self.grid.zeros(3, dtype=level.dtype)
        self.plane_sums = np.zeros(self.grid.shape[0])
        half = level.largest_eigenvalue() / 2.0
        middle = half * (1.0 + 1.0 / SMOOTHING_RATIO)
        radius = half * (1.0 - 1.0 / SMOOTHING_RATIO)
        offset = np.sqrt(0.5) * radius
        first_damping = 1.0 / (middle + offset)  # reciprocal of the roots of the Chebyshev polynomial
        second_damping = 1.0 / (middle - offset)
        both = first_damping * second_damping
        # Two steps of damped Jacobi from x = 0, of which the first gives a multiple of b; then the residual.
        smoothing = [0.0, first_damping + second_damping - both, both]
        residual = [-1.0, 1.0, 1.0]
        self.factors_from_zero = np.array([*smoothing, *residual], level.dtype)
        # The same two steps from any x.
        first_step = [1.0 - first_damping, first_damping, first_damping]
        second_step = [1.0 - second_damping, second_damping, second_damping]
        self.factors_from_x = np.array([*first_step, *second_step], level.dtype)

    def _smooth(self, x, between, factors, plane_sums):
        """Run the loop `smooth` on b; its result is in `residual`."""
        fields = (x, self.b, between, self.residual)
        self.grid.run(loops.smooth, self.scaled_links, *fields, factors, self.distances, self.grid.sizes, plane_sums)
        self.grid.fill_ghosts_compiled(self.residual)

    def cycle(self) -> float:
        """Set x to the result of one V-cycle for b, and return b . x."""
        no_sums = self.plane_sums[:0]
        no_field = self.x[:0]
        self._smooth(self.b, self.x, self.factors_from_zero, no_sums)
        self.transfer.restrict(self.residual, self.coarser.b)
        self.coarser.cycle()
        self.transfer.prolong(self.coarser.x, self.x)
        self._smooth(self.x, no_field, self.factors_from_x, self.plane_sums)
        self.x, self.residual = self.residual, self.x  # the smoother wrote the solution there
        return float(self.plane_sums.sum())


class CoarsestLevel:
    """The level that is solved by a dense matrix, its pseudo-inverse.

    Attributes
    ----------
    b, x : fields
        Right-hand side and solution, with ghost cells filled.
    """

    def __init__(self, level: Level) -> None:
        self.grid = level.grid
        self.b, self.x = self.grid.zeros(2, dtype=level.dtype)
        operator = level.scaled_operator()
        eigenvalues, vectors = np.linalg.eigh([operator.matvec(unit) for unit in np.eye(operator.shape[0])])
        # Omit null vectors, and those of cells whose weights depend on each other.
        is_kept = np.abs(eigenvalues) > ZERO_EIGENVALUE
        kept_vectors = vectors[:, is_kept]
        self.inverse = ((kept_vectors / eigenvalues[is_kept]) @ kept_vectors.T).astype(level.dtype)

    def cycle(self) -> None:
        """Set x to the solution for b."""
        b = self.grid.cells(self.b)
        x = self.grid.cells(self.x)
        # A sum of products, not `@`: it has the same bits for every number of threads.
        x[...] = (self.inverse * b.reshape(-1)).sum(axis=1).reshape(x.shape)
        self.grid.fill_ghosts(self.x)


class Hierarchy(NamedTuple):
    """The levels of a multigrid cycle.

    Attributes
    ----------
    finest : SmoothedLevel
    weak_share : float
        The largest `Level.weak_share` of all levels.
    description : str
    """

    finest: SmoothedLevel
    weak_share: float
    description: str


def build_hierarchy(level: Level) -> Hierarchy:
    """Coarsen the finest level until at most `COARSEST_CELLS` cells remain, at least once."""
    finest = current = SmoothedLevel(level)
    levels = [level]
    while True:
        level, current.transfer = level.coarsened()
        levels.append(level)
        if prod(level.grid.shape) <= COARSEST_CELLS:
            break
        current.coarser = SmoothedLevel(level)
        current = current.coarser
    current.coarser = CoarsestLevel(level)
    weak_share = max(each.weak_share for each in levels)
    first_shape = " x ".join(map(str, levels[0].grid.shape))
    last_shape = " x ".join(map(str, level.grid.shape))
    return Hierarchy(finest, weak_share, f"{len(levels)} levels, {first_shape} to {last_shape}")
