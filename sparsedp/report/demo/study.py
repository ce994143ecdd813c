"""The scene on several grids: check the gradient, recover the ground, count the solves, take the time."""

import platform
import tracemalloc
from dataclasses import dataclass
from importlib.metadata import version
from time import perf_counter

import numpy as np

import sparsedp as dp
from sparsedp.ledger import recording
from sparsedp.report.demo.scene import RTOL, Ground, Survey, objective, regulariser, survey
from sparsedp.report.demo.terrain import Terrain, hidden_ground, remap

__all__ = ["Study", "Trial", "grids_for", "prepare"]

SMALLEST, LARGEST = 12, 512  # cells along the longest side
THINNEST = 0.25  # shortest side of the box
ITERATIONS = 80
SEED = 0


@dataclass(frozen=True, eq=False)
class Study:
    """What all grids share: the survey, and the hidden ground they try to find.

    `truth` is the hidden ground on the finest of `grids`; the survey was made on a grid twice as fine.
    """

    terrain: Terrain
    grids: tuple
    source_grid: dp.Grid
    data: Survey
    truth: np.ndarray


def grids_for(terrain, size):
    """Terrain and cells along the longest side -> three grids: half, three quarters, all of the size.

    Raises
    ------
    ValueError
        If the size is out of range.
    """
    if not SMALLEST <= size <= LARGEST:
        raise ValueError(f"--size needs a whole number from {SMALLEST} to {LARGEST}, got {size}")
    return tuple(_grid(terrain, cells) for cells in (size // 2, 3 * size // 4, size))


def _grid(terrain, cells):
    """Grid in the proportions of the terrain; its longest side has length 1."""
    longest = max(terrain.field.shape)
    sides = [max(n / longest, THINNEST) for n in terrain.field.shape]
    return dp.Grid(tuple(round(cells * side) for side in sides), size=sides)


def prepare(terrain, grids):
    """Terrain and grids -> Study: hide the ground, make the survey on a grid twice as fine as the finest.

    Raises
    ------
    ValueError
        If nothing of the terrain is left at this size.
    """
    source_grid = dp.Grid(tuple(2 * n for n in grids[-1].shape), size=grids[-1].size)
    hidden = hidden_ground(source_grid, terrain)
    truth = remap(source_grid, grids[-1])(hidden)
    return Study(terrain, grids, source_grid, survey(source_grid, hidden, SEED), truth)


class Trial:
    """The recovery on one grid, and its row in the table of error against run time.

    Parameters
    ----------
    study : Study
    grid : Grid
    """

    def __init__(self, study, grid):
        self.study, self.grid = study, grid
        self.ground = Ground(grid, study.data.wells, study.data.sensors)
        self.loss = objective(self.ground, study.data)
        self.roughness = regulariser(grid)
        self.to_finest = remap(grid, study.grids[-1]).explicit()
        self.trace = []  # (seconds, misfit, error) after each iteration

    def error(self, logk):
        """Distance of a recovered field from the truth, relative: 1 for the flat start."""
        truth = self.study.truth
        return float(np.linalg.norm(self.to_finest(logk) - truth) / np.linalg.norm(truth))

    def check_gradient(self, directions):
        """The gradient at a ground that is nowhere special, against finite differences."""
        x, y = self.grid.centres()
        return dp.check.gradient(self.loss, 0.5 * np.sin(5 * x + 1) * np.cos(4 * y), directions=directions)

    def misfit(self, logk, value):
        """Root mean square of (computed - read) / noise, from the value of the loss; 1 is a fit within the noise."""
        return float(np.sqrt(max(0.0, 2 * (value - self.roughness(logk)))))

    def recover(self, watch):
        """L-BFGS from the flat start. ``watch(trial)`` is called after each iteration."""

        def note(record, logk):
            self.trace.append((record.seconds, self.misfit(logk, record.value), self.error(logk)))
            watch(self)

        start = np.zeros(self.grid.shape)
        dp.value_and_grad(self.loss)(start + 1e-12)  # the first call of a kernel is not the price of a run
        self.error(start)
        with recording() as calls:
            best = dp.minimise(self.loss, start, maxiter=ITERATIONS, callback=note, memory=20)
        if best.message.startswith("interrupted"):  # minimise keeps its best point; the demo ends
            raise KeyboardInterrupt
        if best.history[-1].iteration > len(self.trace):  # the iteration that meets the tolerance is not reported
            note(best.history[-1], best.x)
        self.best = best
        self.solves = {
            kind: sum(n for (_, what), n in calls.items() if what == kind) for kind in ("setup", "solve", "adjoint")
        }

    def row(self, check):
        """The figures of the run and of its gradient check, in the order of the columns of the table."""
        _, misfit, error = self.trace[-1]
        return {
            "scene": "demo",
            "method": "lbfgs, adjoint",
            "grid": " x ".join(map(str, self.grid.shape)),
            "unknowns": self.grid.cells.size,
            "tolerance": RTOL,
            "misfit": misfit,
            "error": error,
            "gradient_error": max(
                (abs(line.gap) / line.scale for line in check.lines if line.scale > 0), default=np.nan
            ),
            "seconds": self.best.history[-1].seconds,
            **_cost(self.loss, self.best.x),
            "solves_forward": self.solves["solve"],
            "solves_adjoint": self.solves["adjoint"],
            "setups": self.solves["setup"],
            "iterations": len(self.trace),
            "status": "converged" if self.best.converged else self.best.message,
            "seed": SEED,
            "versions": ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy", "pyamg", "autograd"))
            + f", python {platform.python_version()}",
        }


def _cost(loss, x):
    """Time of one loss and one gradient [s], best of three, set-up apart; memory of the gradient [bytes]."""
    with_gradient = dp.value_and_grad(loss)
    cold = _seconds(loss, x * (1 + 1e-12))  # other numbers, so that nothing is in the solver's cache
    forward, gradient = (min(_seconds(action, x) for _ in range(4)) for action in (loss, with_gradient))
    tracemalloc.start()
    with_gradient(x)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return {
        "seconds_setup": max(0.0, cold - forward),
        "seconds_forward": forward,
        "seconds_backward": max(0.0, gradient - forward),
        "peak_bytes": peak,
    }


def _seconds(action, x):
    clock = perf_counter()
    action(x)
    return perf_counter() - clock
