"""structured: multigrid on the grid itself, compiled, for 5- and 7-point operators that no transform solves.

S = scale V A, V the cell volumes, is symmetric. So A x = b is S x = scale V b, and A^T y = g is S z = scale g
with y = V z: one set-up serves both. Conjugate gradients run on the red cells (see `loops`)
with one V-cycle as preconditioner, which is its own transpose. The cycle computes in single precision, and
so are the directions kept; the equations, the solution and the residual are double.
"""

import threading

import numpy as np

from sparsedp import kernels
from sparsedp._utils.validation import EPS
from sparsedp.solvers.direct import check_precision
from sparsedp.solvers.multigrid.stencil import Unfit, components, stencil_of
from sparsedp.solvers.nullspace import NullSpace
from sparsedp.solvers.scaling import exponent_of
from sparsedp.solvers.solve import Engine, norm

__all__ = ["Structured", "structured_engine", "structured_if_suited"]

PRECISIONS = {"auto": None, "single": np.float32, "double": np.float64}  # words -> types of the cycle

SERIAL = 100_000  # cells below which a team of threads is not worth it
MAXITER = 200
SLOW = 0.3  # a step that leaves more than this share of the residual may have met rounding
WEAK_SHARE = 0.1  # of cells: beyond it a cycle with point smoothing takes more than about 30 iterations
SURE = 1 - 1e-6  # sizes are measured with weights in single precision
PATIENCE = 20  # steps without a smaller residual before giving up
ROUNDING = 4 * EPS
# Ratio of the coefficients times cells along the longest axis, up to which a cycle in single precision does:
# a strong cluster of that width is held by so small a share of its links. Beyond, single precision takes 14 to
# 100 iterations where double takes 9 (a million times stronger balls, 512^2), and fails from ratios of 1e8 on.
SINGLE_UP_TO = 2e7


def structured_engine(system, *, precision="auto"):
    """System -> Structured: compiled multigrid for a symmetric 5- or 7-point operator on a 2-D or 3-D grid.

    Parameters
    ----------
    system : System
    precision : "auto", "single" or "double"
        In which the multigrid cycle computes; the solution is double in any case. "auto" takes single unless
        coefficients jump too far for it.

    Returns
    -------
    Structured

    Raises
    ------
    ValueError
        If numba is not installed, or the operator is not such a stencil; the message says why.

    Notes
    -----
    Source: J. E. Dendy, Black box multigrid, J. Comput. Phys. 48 (1982) 366-386.
    """
    check_precision(precision)
    if not kernels.compiled():
        raise ValueError("structured needs numba, which is not installed; write method='multigrid'")
    try:
        return _built(system, PRECISIONS[precision])
    except Unfit as reason:
        method = "multigrid" if system.sign else "direct"  # multigrid needs a diagonal of one sign, and entries
        if not system.op.structure.has_entries:
            method = "krylov"
        message = f"structured does not take {system.given}: {reason}; write method={method!r}"
        raise ValueError(message) from None


def structured_if_suited(system):
    """System -> (engine, "") if structured multigrid is a good choice, else (None, why not)."""
    grid = system.op.domain.grid
    if grid is None or grid.dim == 1:
        return None, "structured multigrid is for grids in 2-D and 3-D"
    if not kernels.compiled():
        return None, "structured multigrid needs numba, which is not installed"
    try:
        engine = _built(system)
    except Unfit as reason:
        return None, f"structured multigrid does not take it: {reason}"
    if engine.weak_share > WEAK_SHARE:
        share = f"{100 * engine.weak_share:.0f} % of the cells of one of its levels"
        return None, f"structured multigrid is slow: {share} are held 10 times weaker along one axis"
    return engine, ""


def _built(system, dtype=None):
    """The engine; raises Unfit. The type of its cycle, where it is not given, is found from the coefficients."""
    stencil, faces = stencil_of(system), system.faces
    if faces is not None and faces.connected:  # what is known need not be found from the entries
        system.components = None, 1
        if faces.extra.any():
            system.null_space = NullSpace.none(system.size)
    else:
        system.components = components(stencil)
    free = system.null_space.right != 0 if system.null_space.count else np.zeros(system.size, bool)
    engine = Structured(stencil, free, system.maxiter, dtype or _precision(stencil))
    if system.grid.cells.size and all(system.grid.uniform):
        system.norms = engine.norm, engine.norm
    return engine


def _precision(stencil):
    """The type that resolves how weakly the cells with the largest coefficients may be held together."""
    limit = SINGLE_UP_TO / max(1, *stencil.grid.shape)
    smooth = all(c.max(initial=0.0) <= limit * c.min(initial=np.inf, where=c > 0) for c in stencil.links)
    return np.float32 if smooth else np.float64


class Structured(Engine):
    """The engine.

    Parameters
    ----------
    stencil : Stencil
    free : bool array, shape (cells,)
        Cells of singular components.
    maxiter : int or None
    dtype : float32 or float64
        Type of the cycle.
    """

    method = "structured"
    iterative = hierarchical = True

    def __init__(self, stencil, free, maxiter=None, dtype=np.float32):
        from sparsedp.solvers.multigrid import loops
        from sparsedp.solvers.multigrid.cycle import Level, hierarchy
        from sparsedp.solvers.multigrid.loops import Layout

        grid, self.scale, self.maxiter, self.loops = stencil.grid, stencil.scale, maxiter or MAXITER, loops
        threads = kernels.threads() if grid.cells.size >= SERIAL else 1
        self.layout = layout = Layout(grid.shape, grid.periodic, threads)
        links, extra, flags = layout.zeros(grid.dim), layout.zeros(), layout.zeros(dtype=bool)
        for field, values in zip((*links, extra, flags), (*stencil.links, stencil.extra, free)):
            layout.cells(field)[...] = values.reshape(grid.shape)
        steps = [tuple(step) for step in np.eye(grid.dim, dtype=int).tolist()]
        self.level = level = Level(layout, steps, links, extra, flags, dtype)
        self.fine, self.weak_share, self.hierarchy = hierarchy(level)
        self.hierarchy += ", cycle in double precision" if dtype == np.float64 else ""
        volumes, scale, root = grid.volumes, layout.cells(level.scale), layout.cells(level.root)
        self.factors = scale * volumes, scale  # what a right-hand side of A, and of its transpose, is multiplied with
        gauges = root / volumes, root  # how a scaled residual measures in the user's cells, but for a number
        self.tops = tuple(float(gauge.max(initial=0.0)) or 1.0 for gauge in gauges)
        self.norm = 2.0 * float(np.max(gauges[0] * root, initial=0.0)) / abs(self.scale)
        self.gauges = layout.zeros(2, dtype=dtype)
        for field, gauge, top in zip(self.gauges, gauges, self.tops):
            layout.cells(field)[...] = gauge / top
        self.vectors, self.direction = layout.zeros(3), layout.zeros(dtype=dtype)
        self.lock = threading.Lock()

    def solve(self, b, goal, transposed):
        with self.lock:
            run = _Run(self, b, goal, transposed)
            word, used = run.iterate()
            return run.solution(), used, word


class _Run:
    """One solve: the vectors and numbers of conjugate gradients.

    Right-hand side and solution are scaled by a power of two, so that single precision does not overflow.
    """

    def __init__(self, engine, b, goal, transposed):
        self.engine, self.data, self.gauge = engine, norm(b), engine.gauges[int(transposed)]
        before, self.after = engine.factors[transposed], engine.factors[not transposed]
        top = engine.tops[transposed] / abs(engine.scale)
        self.unit = 2.0 ** (exponent_of(self.data) - exponent_of(top))
        self.measure = self.unit * top  # of a residual that is 1 by the gauge
        self.goal = SURE * goal / self.measure
        self.x, self.r, self.q = engine.vectors
        self.p, self.sums, self.cells = engine.direction, engine.level.sums, engine.layout.cells
        engine.vectors[...] = self.p[...] = 0.0
        np.multiply(before, b.reshape(before.shape), out=self.cells(self.r))
        self.r *= engine.scale / self.unit
        self.step(0.0)

    def iterate(self):
        """Until the residual is small enough -> (word, number of iterations)."""
        rho, best, since, last = 1.0, np.inf, 0, np.inf
        for used in range(1, self.engine.maxiter + 1):
            rho, old = self.engine.fine.cycle(), rho
            curvature = self.direct(rho / old if used > 1 else 0.0)
            if not (rho > 0.0 and 0.0 < curvature < np.inf):
                return self.stuck(rho, curvature, last), used
            residual = self.step(rho / curvature)
            if residual <= self.goal:
                return "", used
            if not residual < SLOW * last and residual <= self.rounding():
                return "", used
            since, best = (0, residual) if residual < best else (since + 1, best)
            if since >= PATIENCE:
                return "stagnated", used
            last = residual
        return "max_iterations", used

    def stuck(self, rho, curvature, residual):
        """The word for a product that must be positive and is not: the stencil is, so rounding has won."""
        if not np.isfinite(rho + curvature):
            return "nonfinite_output"
        return "" if rho == 0.0 or residual <= 100 * self.rounding() else "stagnated"

    def direct(self, beta):
        """The next direction p and its image q -> p . q."""
        engine, layout = self.engine, self.engine.layout
        layout.run(engine.loops.direct, self.p, engine.fine.x, layout.sizes, beta)
        layout.fill(self.p)
        engine.level.apply(self.p, self.q)
        return float(self.sums.sum())

    def step(self, alpha):
        """x += alpha p, r -= alpha q -> the size of r."""
        engine, layout, light = self.engine, self.engine.layout, self.engine.fine.b
        vectors = self.x, self.p, self.r, self.q, light, self.gauge
        layout.run(engine.loops.update, *vectors, layout.sizes, self.sums, alpha)
        layout.fill(light)
        return float(np.sqrt(self.sums.sum()))

    def rounding(self):
        """Size of a residual that rounding explains, as the contract will see it."""
        return ROUNDING * (self.engine.norm * norm(self.solution()) + self.data) / self.measure

    def solution(self):
        """x as a flat field."""
        values = self.cells(self.x) * self.after
        values *= self.unit
        return values.reshape(-1)
