"""structured: multigrid on the grid itself, compiled, for 5- and 7-point operators that no transform solves.

S = scale V A, V the cell volumes, is symmetric. So A x = b is S x = scale V b, and A^T y = g is S z = scale g
with y = V z: one set-up serves both. Conjugate gradients run on the red cells (see `kernels.multigrid`)
with one V-cycle as preconditioner, which is its own transpose. The cycle computes in single precision, and
so are the directions kept; the equations, the solution and the residual are double.
"""

import threading
from math import prod

import numpy as np

from sparsedp import kernels
from sparsedp.solvers.contract import Engine, norm

__all__ = ["Structured", "structured_engine", "structured_if_suited"]

PRECISIONS = {"auto": None, "single": np.float32, "double": np.float64}  # words -> types of the cycle

CHUNK = 16384  # cells for which one sum is kept
SERIAL = 100_000  # cells below which a team of threads is not worth it
MAXITER = 200
OVER = 1.2  # of a sweep on the finest level; 1 takes up to one iteration more
SLOW = 0.3  # a step that leaves more than this share of the residual may have met rounding
WEAK_SHARE = 0.1  # of cells: beyond it a cycle with point smoothing takes more than about 30 iterations
SURE = 1 - 1e-6  # sizes are measured with weights in single precision
PATIENCE = 20  # steps without a smaller residual before giving up
ROUNDING = 4 * np.finfo(float).eps
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
    from sparsedp.solvers.stencil import Unfit

    if precision not in tuple(PRECISIONS):
        raise ValueError(f"precision must be 'auto', 'single' or 'double', got {precision!r}")
    if not kernels.compiled():
        raise ValueError("structured needs numba, which is not installed; write method='multigrid'")
    try:
        return _built(system, PRECISIONS[precision])
    except Unfit as reason:
        message = f"structured does not take {system.given}: {reason}; write method='multigrid'"
        raise ValueError(message) from None


def structured_if_suited(system):
    """System -> (engine, "") if structured multigrid is a good choice, else (None, why not)."""
    from sparsedp.solvers.stencil import Unfit

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
    from sparsedp.solvers.stencil_facts import components_of_stencil, null_space_of_stencil
    from sparsedp.solvers.stencil_reading import stencil_of

    stencil, faces = stencil_of(system), system.faces
    if faces is not None and faces.connected:
        system.components = labels, count = None, 1
    else:
        system.components = labels, count = components_of_stencil(stencil, system.active)
    system.null_space = null_space_of_stencil(stencil, labels, count, system.active)
    free = system.null_space.right > 0 if system.null_space.count else np.zeros(system.size, bool)
    engine = Structured(stencil, free, system.maxiter, dtype or _precision(stencil, faces))
    if system.grid.cells.size and all(system.grid.uniform):
        system.norms = engine.size.norm, engine.size.norm
    return engine


def _precision(stencil, faces):
    """The type that resolves how weakly the cells with the largest coefficients may be held together."""
    limit = SINGLE_UP_TO / max(1, *stencil.grid.shape)
    if faces is not None and faces.largest <= limit * faces.smallest:
        return np.float32
    linked = [np.where(c > 0, c, np.inf).min(initial=np.inf) for c in stencil.inner]
    small = all(c.max(initial=0.0) <= limit * least for c, least in zip(stencil.inner, linked))
    return np.float32 if small else np.float64


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
    overwrites = False

    def __init__(self, stencil, free, maxiter=None, dtype=np.float32):
        from sparsedp.kernels import multigrid_cycle, multigrid_pack, multigrid_teams, native
        from sparsedp.solvers.stencil_levels import Levels
        from sparsedp.solvers.stencil_spread import Spread

        self.passes, self.cycle, self.in_team = multigrid_teams, multigrid_cycle.cycle, native.in_team
        self.scale, self.maxiter = stencil.scale, maxiter or MAXITER
        spread = Spread(stencil.grid)
        levels = Levels(spread.natural(stencil, free), spread.widths(), spread.coarsenings, dtype, abs(stencil.scale))
        self.fine, self.coarse, self.hierarchy = levels.fine, levels.coarse, levels.words
        self.hierarchy += ", cycle in double precision" if dtype == np.float64 else ""
        self.found, self.volumes, self.ones = spread.found, spread.widths(), spread.widths(of_grid=False)
        self.shape = stencil.grid.shape if spread.dim == 3 else (stencil.grid.shape[0], 1, stencil.grid.shape[1])
        self.size, self.weak_share = levels.size, levels.weak_share
        self._scratch(multigrid_pack.packed, multigrid_pack.width, dtype)
        self.lock = threading.Lock()

    def _scratch(self, packed, width, dtype):
        """Vectors and what the members of a team work on."""
        fine, shape = self.fine, self.fine.shape
        wide, rows = fine.links.shape[-1], fine.links.shape[1:]
        self.teams = teams = kernels.threads() if prod(shape) >= SERIAL else 1
        self.wide_vectors = [packed(*rows) for _ in range(3)]
        self.vectors = [packed(*rows, dtype=dtype) for _ in range(3)]
        self.sums = np.zeros((max(1, min(shape[0], prod(shape) // CHUNK)), 2))
        self.totals, self.line = packed(teams, 2, wide), packed(teams, width(shape[2], split=False))
        self.rings = packed(teams, 2, 3, shape[1], wide), packed(teams, 2, 3, shape[1], wide, dtype=dtype)
        natural = width((shape[2] + 1) // 2, split=False)
        self.lines = packed(teams, 2 * ((shape[1] + 1) // 2) + 1, natural, dtype=dtype)
        first = self.coarse.levels[0]
        self.first = self.coarse.b[: 2 * first[3] * first[4]].reshape(first[3], 2, first[4])
        self.natural = self.coarse.natural[: first[3] * first[9]].reshape(first[3], first[9])

    def run(self, kernel, *arguments):
        """A pass, by the team."""
        return self.in_team(kernel, arguments, self.teams)

    def solve(self, b, goal, transposed):
        with self.lock:
            run = _Run(self, b, goal, transposed)
            word, used = run.iterate()
            solution = run.solution()
            for vector in self.vectors if word else ():  # the next solve multiplies them by 0
                vector[:] = 0.0
            return solution, used, word


class _Run:
    """One solve: the vectors and numbers of conjugate gradients.

    Right-hand side and solution are scaled by a power of two, so that single precision does not overflow.
    """

    def __init__(self, engine, b, goal, transposed):
        self.engine, fine = engine, engine.fine
        self.grid = fine.shape, fine.periodic, fine.half
        self.b, self.data, self.transposed = b.reshape(engine.shape), norm(b), transposed
        self.unit = 2.0 ** (np.frexp(self.data)[1] + engine.size.exponent[transposed])
        volumes, ones = (engine.ones, engine.volumes) if transposed else (engine.volumes, engine.ones)
        self.before = (volumes[0] * (engine.scale / self.unit), *volumes[1:])
        self.after = (ones[0] * self.unit, *ones[1:])
        self.goal = SURE * goal / (self.unit * engine.size.factor[transposed])
        self.gauge = engine.size.gauge[transposed]
        self.x, self.r, self.q = engine.wide_vectors
        self.z, self.p, self.old = engine.vectors
        self.x[:] = 0.0
        self.tail = engine.totals, engine.sums
        self.field = engine.rings[0], engine.line
        self.steps = 0.0, 0.0  # what is still to be added to x, of p and of old
        vectors = fine.links, self.r, self.b
        engine.run(engine.passes.load, *vectors, fine.scale, self.before, engine.found, *self.grid, *self.field)

    def iterate(self):
        """Until the residual is small enough -> (word, number of iterations)."""
        rho, best, since, last = 1.0, np.inf, 0, np.inf
        for used in range(1, self.engine.maxiter + 1):
            rho, old = self.precondition(), rho
            curvature = self.direct(rho / old if used > 1 else 0.0, odd=used % 2 == 1)
            if not (rho > 0.0 and 0.0 < curvature < np.inf):
                return self.stuck(rho, curvature, last), used
            residual = self.step(rho / curvature, odd=used % 2 == 1)
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

    # ------------------------------------------------------------ passes

    def precondition(self):
        """z = M r -> r . z."""
        engine, fine = self.engine, self.engine.fine
        light = *self.grid, engine.rings[1]
        transfer = fine.weights, fine.starts, OVER
        engine.run(engine.passes.restrict, fine.light, self.r, engine.first, *transfer, *light, engine.lines)
        engine.run(engine.cycle, *engine.coarse, engine.lines)
        engine.run(engine.passes.correct, fine.light, self.r, self.z, engine.natural, *transfer, *light, *self.tail)
        return float(engine.sums[:, 0].sum())

    def direct(self, beta, odd):
        """The next direction and its image -> p . q. Every other time x catches up."""
        engine = self.engine
        steps, self.p, self.old = self.steps if odd else (0.0, 0.0), self.old, self.p
        vectors = self.x, self.p, self.old, self.z, self.q
        links, rings = engine.fine.links, engine.rings[0]
        engine.run(engine.passes.direction, links, *vectors, beta, steps, *self.grid, rings, *self.tail)
        return float(engine.sums[:, 0].sum())

    def step(self, alpha, odd):
        """r -= alpha q -> its size."""
        self.steps = (alpha, 0.0) if odd else (alpha, self.steps[0])
        self.engine.run(self.engine.passes.update, self.r, self.q, self.gauge, alpha, *self.grid, *self.tail)
        return float(np.sqrt(self.engine.sums[:, 0].sum()))

    def rounding(self):
        """Size of a residual that rounding explains, as the contract will see it."""
        size, gauge = self.engine.size, self.engine.size.gauge[not self.transposed]
        x = self.x + self.steps[0] * self.p + self.steps[1] * self.old
        x = np.divide(x, gauge, out=np.zeros_like(x), where=gauge > 0)
        solution = norm(x.reshape(-1)) * self.unit / size.factor[not self.transposed]
        return ROUNDING * (size.norm * solution + self.data) * self.goal_unit

    @property
    def goal_unit(self):
        return 1.0 / (self.unit * self.engine.size.factor[self.transposed])

    def solution(self):
        """x as a flat field."""
        engine, fine = self.engine, self.engine.fine
        out = np.empty(engine.shape)
        vectors = fine.links, self.x, self.steps, self.p, self.old, self.b, out
        widths = self.before + self.after
        engine.run(engine.passes.finish, *vectors, fine.scale, widths, engine.found, *self.grid, *self.field)
        return out.reshape(-1)
