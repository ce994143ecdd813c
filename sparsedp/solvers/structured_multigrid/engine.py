"""The engine of method "structured": compiled multigrid for 5- and 7-point operators that no transform solves.

Notes
-----
S = scale V A, V the cell volumes, is symmetric. A x = b is solved as S x = scale V b, and A^T y = g as
S z = scale g with y = V z, so one set-up serves both. The iterations are conjugate gradients, preconditioned with one
V-cycle, which is its own transpose. The V-cycle and the search directions are in single precision (in double where
the coefficients jump too far); the matrix, the solution and the residual are in double precision.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp import kernels
from sparsedp._utils.validation import EPS
from sparsedp.solvers.direct import check_precision
from sparsedp.solvers.engine import Engine
from sparsedp.solvers.nullspace import NullSpace
from sparsedp.solvers.scaling import exponent_of, norm
from sparsedp.solvers.structured_multigrid.stencil import UnsuitableOperator, component_labels, stencil_of_system

if TYPE_CHECKING:
    from numpy.typing import DTypeLike, NDArray

    from sparsedp.solvers.structured_multigrid.stencil import Stencil
    from sparsedp.solvers.system import System

__all__ = ["Structured", "structured_engine", "structured_if_suited"]

PRECISIONS = {"auto": None, "single": np.float32, "double": np.float64}  # option -> type of the cycle

THREADED_FROM = 100_000  # cells below which a second thread costs more time than it saves
MAXITER = 200
SLOW = 0.3  # a step that leaves more than this share of the residual may have reached the level of rounding
WEAK_SHARE = 0.1  # of cells: beyond it a cycle with point smoothing takes more than about 30 iterations
GAUGE_ROUNDING = 1e-6  # relative error of a norm that is measured with weights in single precision
PATIENCE = 20  # iterations without a smaller residual after which the solve has stagnated
ROUNDING = 4 * EPS
# Largest ratio of the coefficients times cells along the longest axis for which a cycle in single precision suffices:
# a cluster of strongly linked cells of that width is held to its surroundings by so small a share of its links.
# Beyond, single precision takes 14 to 100 iterations where double takes 9 (inclusions a million times stronger,
# 512^2 cells), and fails from ratios of 1e8 on.
SINGLE_PRECISION_UP_TO = 2e7


def structured_engine(system: System, *, precision: str = "auto") -> Structured:
    """Set up compiled multigrid for a symmetric 5- or 7-point operator on a 2-D or 3-D grid.

    Parameters
    ----------
    system : System
    precision : "auto", "single" or "double"
        Precision of the multigrid cycle; the solution is in double precision in any case. "auto" takes single
        precision unless the coefficients jump too far.

    Returns
    -------
    Structured

    Raises
    ------
    ValueError
        If numba is not installed, or the operator is not such a stencil; the message says why.

    References
    ----------
    J. E. Dendy, Black box multigrid, J. Comput. Phys. 48 (1982) 366-386.
    """
    check_precision(precision)
    if not kernels.compiled():
        raise ValueError("structured needs numba, which is not installed or switched off; write method='multigrid'")
    try:
        return _build_engine(system, PRECISIONS[precision])
    except UnsuitableOperator as reason:
        if not system.op.structure.has_entries:
            method = "krylov"
        elif system.sign:  # multigrid needs a diagonal of one sign
            method = "multigrid"
        else:
            method = "direct"
        message = f"structured cannot solve {system.unscaled}: {reason}; write method={method!r}"
        raise ValueError(message) from None


def structured_if_suited(system: System) -> tuple[Structured | None, str]:
    """Set up structured multigrid if it is a good choice.

    Parameters
    ----------
    system : System

    Returns
    -------
    engine : Structured or None
    reason : str
        Why there is no engine; empty if there is one.
    """
    grid = system.op.domain.grid
    if grid is None or grid.dim == 1:
        return None, "structured multigrid is for grids in 2-D and 3-D"
    if not kernels.compiled():
        return None, "structured multigrid needs numba, which is not installed or switched off"
    try:
        engine = _build_engine(system)
    except UnsuitableOperator as reason:
        return None, f"structured multigrid cannot solve it: {reason}"
    if engine.weak_share > WEAK_SHARE:
        share = f"{100 * engine.weak_share:.0f} % of the cells of one of its levels"
        return None, f"structured multigrid is slow: {share} are held 10 times weaker along one axis"
    return engine, ""


def _build_engine(system, dtype=None):
    """Build the engine; raises UnsuitableOperator. By default the coefficients decide the precision of the cycle."""
    stencil = stencil_of_system(system)
    faces = system.faces
    if faces is not None and faces.connected:  # one component: the entries need not be searched
        system.components = None, 1
        if faces.extra.any():
            system.null_space = NullSpace.none(system.size)
    else:
        system.components = component_labels(stencil)
    if system.null_space.count:
        singular = system.null_space.right != 0
    else:
        singular = np.zeros(system.size, bool)
    engine = Structured(stencil, singular, system.maxiter, dtype or _cycle_precision(stencil))
    if system.grid.cells.size and all(system.grid.uniform):
        system.norms = engine.norm, engine.norm
    return engine


def _cycle_precision(stencil):
    """Return the type that resolves how weakly the cells with the largest coefficients may be held together."""
    limit = SINGLE_PRECISION_UP_TO / max(1, *stencil.grid.shape)
    for c in stencil.links:
        smallest = c.min(initial=np.inf, where=c > 0)
        if c.max(initial=0.0) > limit * smallest:
            return np.float64
    return np.float32


class Structured(Engine):
    """Conjugate gradients on a stencil, preconditioned with a multigrid cycle.

    Parameters
    ----------
    stencil : Stencil
    singular : bool array, shape (cells,)
        Cells of singular components.
    maxiter : int or None
        Default: 200.
    dtype : float32 or float64
        Precision of the cycle.

    Attributes
    ----------
    weak_share : float
        The largest share of cells of a level that are held much more weakly along one axis than along another.
    norm : float
        An upper bound of |A|_inf.
    """

    method = "structured"
    iterative = True
    hierarchical = True

    def __init__(
        self,
        stencil: Stencil,
        singular: NDArray[Any],
        maxiter: int | None = None,
        dtype: DTypeLike = np.float32,
    ) -> None:
        from sparsedp.solvers.structured_multigrid import loops
        from sparsedp.solvers.structured_multigrid.cycle import build_hierarchy
        from sparsedp.solvers.structured_multigrid.loops import PaddedGrid

        grid = stencil.grid
        self.scale = stencil.scale
        self.maxiter = maxiter or MAXITER
        self.loops = loops
        threads = kernels.threads() if grid.cells.size >= THREADED_FROM else 1
        self.padded_grid = PaddedGrid(grid.shape, grid.periodic, threads)
        self.level = self._finest_level(stencil, singular, dtype)
        self.finest, self.weak_share, self.hierarchy = build_hierarchy(self.level)
        if dtype == np.float64:
            self.hierarchy += ", cycle in double precision"
        self._set_factors(grid.volumes, dtype)
        self.vectors = self.padded_grid.zeros(3)
        self.direction = self.padded_grid.zeros(dtype=dtype)
        self.lock = threading.Lock()  # the vectors serve one solve at a time

    def _finest_level(self, stencil, singular, dtype):
        from sparsedp.solvers.structured_multigrid.cycle import Level

        padded_grid = self.padded_grid
        shape = padded_grid.shape
        links = padded_grid.zeros(padded_grid.dim)
        extra = padded_grid.zeros()
        flags = padded_grid.zeros(dtype=bool)
        for link, values in zip(links, stencil.links):
            padded_grid.cells(link)[...] = values.reshape(shape)
        padded_grid.cells(extra)[...] = stencil.extra.reshape(shape)
        padded_grid.cells(flags)[...] = singular.reshape(shape)
        steps = [tuple(step) for step in np.eye(padded_grid.dim, dtype=int).tolist()]
        return Level(padded_grid, steps, links, extra, flags, dtype)

    def _set_factors(self, volumes, dtype):
        """Set what depends on whether A x = b or A^T x = b is solved: pairs, for A and for its transpose."""
        padded_grid = self.padded_grid
        inverse_root = padded_grid.cells(self.level.inverse_root)
        root = padded_grid.cells(self.level.root_diagonal)
        # Factors from a right-hand side to the one for the matrix with a unit diagonal.
        self.factors = (inverse_root * volumes, np.ascontiguousarray(inverse_root))
        # Factors from a residual of that matrix to one of A or A^T, up to 1 / scale: their maximum, and fields over it.
        gauges = (root / volumes, root)
        self.largest_gauges = tuple(float(gauge.max(initial=0.0)) or 1.0 for gauge in gauges)
        self.gauges = padded_grid.zeros(2, dtype=dtype)
        for field, gauge, largest in zip(self.gauges, gauges, self.largest_gauges):
            padded_grid.cells(field)[...] = gauge / largest
        self.norm = 2.0 * float(np.max(gauges[0] * root, initial=0.0)) / abs(self.scale)

    def solve(self, b: NDArray[Any], goal: float, transposed: bool) -> tuple[NDArray[Any], int, str]:
        """Solve A x = b or A^T x = b until the residual is at most `goal`: see `Engine`."""
        with self.lock:
            run = _ConjugateGradients(self, b, goal, transposed)
            status, iterations = run.iterate()
            return run.solution(), iterations, status


class _ConjugateGradients:
    """The vectors and numbers of one solve.

    Right-hand side and solution are divided by a power of two, `unit`, so that single precision does not overflow.
    """

    def __init__(self, engine, b, goal, transposed):
        self.engine = engine
        self.padded_grid = engine.padded_grid
        self.data_norm = norm(b)
        self.gauge = engine.gauges[int(transposed)]
        b_factors = engine.factors[transposed]
        self.solution_factors = engine.factors[not transposed]
        largest_gauge = engine.largest_gauges[transposed] / abs(engine.scale)
        self.unit = 2.0 ** (exponent_of(self.data_norm) - exponent_of(largest_gauge))
        self.residual_unit = self.unit * largest_gauge  # size of a residual whose gauged norm is 1
        self.goal = (1 - GAUGE_ROUNDING) * goal / self.residual_unit
        self.x, self.residual, self.image = engine.vectors
        self.direction = engine.direction
        self.plane_sums = engine.level.plane_sums
        vectors = (self.x, self.direction, self.residual, self.image)
        data = (b_factors, np.ascontiguousarray(b))
        self.padded_grid.run(
            engine.loops.set_residual, *vectors, *data, self.padded_grid.sizes, engine.scale / self.unit
        )
        self._update_solution(0.0)

    def iterate(self):
        """Iterate until the residual is small enough; return a status word, empty on success, and the iterations."""
        rho = 1.0
        residual = np.inf
        smallest_residual = np.inf
        iterations_since_smallest = 0
        for iteration in range(1, self.engine.maxiter + 1):
            previous_rho = rho
            previous_residual = residual
            rho = self.engine.finest.cycle()
            beta = rho / previous_rho if iteration > 1 else 0.0
            curvature = self._update_direction(beta)
            if not (rho > 0.0 and 0.0 < curvature < np.inf):
                return self._status_without_curvature(rho, curvature, previous_residual), iteration
            residual = self._update_solution(rho / curvature)
            if residual <= self.goal:
                return "", iteration
            if not residual < SLOW * previous_residual and residual <= self._rounding():
                return "", iteration
            if residual < smallest_residual:
                smallest_residual = residual
                iterations_since_smallest = 0
            else:
                iterations_since_smallest += 1
            if iterations_since_smallest >= PATIENCE:
                return "stagnated", iteration
        return "max_iterations", self.engine.maxiter

    def _status_without_curvature(self, rho, curvature, residual):
        """Return the status where a scalar product is not positive: as the matrix is, by rounding alone."""
        if not np.isfinite(rho + curvature):
            return "nonfinite_output"
        return "" if rho == 0.0 or residual <= 100 * self._rounding() else "stagnated"

    def _update_direction(self, beta):
        """Compute the next direction p and its image A p; return p . A p."""
        preconditioned = self.engine.finest.x
        self.padded_grid.run(
            self.engine.loops.update_direction, self.direction, preconditioned, self.padded_grid.sizes, beta
        )
        self.padded_grid.fill_ghosts_compiled(self.direction)
        self.engine.level.apply_scaled(self.direction, self.image)
        return float(self.plane_sums.sum())

    def _update_solution(self, alpha):
        """Add alpha p to x, subtract alpha A p from the residual; return the gauged norm of the residual."""
        rounded_residual = self.engine.finest.b
        vectors = (self.x, self.direction, self.residual, self.image, rounded_residual, self.gauge)
        self.padded_grid.run(
            self.engine.loops.update_solution, *vectors, self.padded_grid.sizes, self.plane_sums, alpha
        )
        self.padded_grid.fill_ghosts_compiled(rounded_residual)
        return float(np.sqrt(self.plane_sums.sum()))

    def _rounding(self):
        """Return the gauged norm of a residual that rounding explains, by the test of the solve contract."""
        return ROUNDING * (self.engine.norm * norm(self.solution()) + self.data_norm) / self.residual_unit

    def solution(self):
        """Return x as a flat field."""
        values = np.empty(self.padded_grid.shape)
        self.padded_grid.run(
            self.engine.loops.copy_solution, values, self.x, self.solution_factors, self.padded_grid.sizes, self.unit
        )
        return values.reshape(-1)
