"""Run the demo: generate synthetic data from a known field, check the gradient, and estimate the field on three grids.

Progress is printed. The plots, the table and the estimated field are written to files.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp._utils.progress import bar
from sparsedp.check.table import table_of
from sparsedp.io.atomic_files import write_file
from sparsedp.report import plots
from sparsedp.report.certificate import distance
from sparsedp.report.demo.scene import NOISE, Ground, Survey, objective, regulariser, survey
from sparsedp.report.demo.terrain import Terrain, hidden_ground, remap
from sparsedp.report.explain import total
from sparsedp.report.scene_file import claim_folder

__all__ = ["FILES", "Study", "grids_for", "prepare", "run"]

SMALLEST = 12  # smallest and largest number of cells along the longest side
LARGEST = 512
THINNEST = 0.25  # smallest length of the shorter side of the box
ITERATIONS = 80
WARM_UP = 2  # number of iterations before the measured run
ARRAYS = ("table.csv", "convergence.csv", "recovered.npy")
PICTURES = ("truth.png", "recovery.png", "convergence.png")
FILES = (*ARRAYS, *PICTURES)
COUNTED = {"solves_forward": "solve", "solves_adjoint": "adjoint", "setups": "setup"}
TABLE_COLUMNS = ("grid", "unknowns", "gradient", "iterations", *COUNTED, "seconds", "misfit", "error")


class Study(NamedTuple):
    """The data that all grids share: the measurements, and the true log-conductivity on the finest grid."""

    terrain: Terrain
    grids: list
    data: Survey
    truth: np.ndarray


def grids_for(terrain: Terrain, size: int) -> list[dp.Grid]:
    """Return three grids with the aspect ratio of a terrain. The longest side has length 1.

    Along the longest side the grids have size / 2, 3 size / 4 and `size` cells.

    Raises
    ------
    ValueError
        If the size is out of range.
    """
    if not SMALLEST <= size <= LARGEST:
        raise ValueError(f"--size needs a whole number from {SMALLEST} to {LARGEST}, got {size}")
    sides = np.maximum(np.divide(terrain.field.shape, max(terrain.field.shape)), THINNEST)
    cells = np.rint(np.outer((size // 2, 3 * size // 4, size), sides)).astype(int)
    return [dp.Grid(tuple(shape), size=tuple(sides)) for shape in cells.tolist()]


def prepare(terrain: Terrain, grids: list[dp.Grid]) -> Study:
    """Generate the true field and the synthetic measurements on a grid twice as fine as the finest grid.

    Raises
    ------
    ValueError
        If the terrain is constant after it is averaged to the cells.
    """
    fine = dp.Grid(tuple(2 * n for n in grids[-1].shape), size=grids[-1].size)
    hidden = hidden_ground(fine, terrain)
    return Study(terrain, grids, survey(fine, hidden), remap(fine, grids[-1])(hidden))


def recover(study: Study, grid: dp.Grid) -> tuple[np.ndarray, dict[str, Any], list[dict[str, Any]]]:
    """Check the gradient, and estimate the log-conductivity by L-BFGS, with a progress bar on a terminal.

    A separate run of two iterations comes first, so that the measured time does not include compilation.

    Returns
    -------
    logk : ndarray
        The estimated log-conductivity.
    row : dict
        The row of the table for this grid. The misfit is the root mean square of (computed - measured) / noise; a value
        of 1 means that the data are fitted up to noise. The error is the relative distance from the true field; it is 1
        at the start, where log k = 0.
    iterations : list of dict
        The grid, number, seconds, misfit and error of each iteration.
    """
    loss = objective(Ground(grid, study.data.wells, study.data.sensors), study.data)
    check = _check_gradient(study, grid, loss)
    _warm_up(study, grid)
    progress = _Progress(study, grid)
    with recording() as calls, progress:
        best = dp.minimize(loss, np.zeros(grid.shape), maxiter=ITERATIONS, callback=progress.note, memory=20)
    if best.message.startswith("interrupted"):  # minimize returns its best point after Ctrl-C; end the demo
        raise KeyboardInterrupt
    rows = progress.rows
    if best.history[-1].iteration > len(rows):  # minimize does not call the callback for the iteration that converges
        progress.note(best.history[-1], best.x)
    last = rows[-1]
    misfit_and_error = f"misfit/noise {last['misfit']:.3f}, error {last['error']:.3f}"
    print(f"  {last['iterations']} iterations, {last['seconds']:.2f} s: {misfit_and_error}\n", flush=True)
    counts = {name: total(calls, kind) for name, kind in COUNTED.items()}
    row = {**last, "unknowns": best.x.size, **counts}
    row["gradient"] = check.verdict
    row["gradient_error"] = max((line.share for line in check.lines), default=np.nan)
    return best.x, row, rows


def _check_gradient(study: Study, grid: dp.Grid, loss: Any) -> Any:
    """Check the gradient at a field with generic values, and print the result."""
    x, y = grid.centres()
    check = dp.check.gradient(loss, 0.5 * np.sin(5 * x + 1) * np.cos(4 * y), directions=1)
    # Print the whole table only once.
    if grid is study.grids[-1]:
        shown = str(check)
    else:
        shown = f"  {check.verdict}"
    print(f"On {grid}. Is the gradient right?", shown, sep="\n", flush=True)  # at once, also in a log file
    return check


def _warm_up(study: Study, grid: dp.Grid) -> None:
    """Run a few iterations, so that code is compiled before the measured run."""
    loss = objective(Ground(grid, study.data.wells, study.data.sensors), study.data)
    with recording():
        dp.minimize(loss, np.zeros(grid.shape), maxiter=WARM_UP, memory=20)


class _Progress:
    """Record the iterations of one run, and show a progress bar on a terminal if tqdm is installed."""

    def __init__(self, study: Study, grid: dp.Grid) -> None:
        self.name = " x ".join(map(str, grid.shape))
        self.truth = study.truth
        self.roughness = regulariser(grid)
        self.to_finest = remap(grid, study.grids[-1])
        self.rows: list[dict[str, Any]] = []

    def __enter__(self) -> _Progress:
        title = f"  {self.name} cells"
        self.bar = bar(needed=False, total=ITERATIONS, desc=title, unit="iteration", leave=False, disable=None)
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.close()

    def note(self, record: Any, logk: np.ndarray) -> None:
        """Record an iteration. This is the callback of `minimize`."""
        misfit = float(np.sqrt(max(0.0, 2 * (record.value - self.roughness(logk)))))
        error = distance(self.to_finest(logk), self.truth)
        numbers = {"iterations": len(self.rows) + 1, "seconds": record.seconds, "misfit": misfit, "error": error}
        self.rows.append({"grid": self.name, **numbers})
        if self.bar is not None:
            self.bar.update()


# ---------------------------------------------------------------- what the reader sees


def run(study: Study, folder: Path, force: bool) -> bool:
    """Run the demo, print the progress, and write the files.

    Parameters
    ----------
    study : Study
    folder : pathlib.Path
    force : bool
        Whether files may be overwritten.

    Returns
    -------
    bool
        Whether the gradient agrees with finite differences on every grid.

    Raises
    ------
    OSError
        If a file cannot be written.
    ValueError
        If one of the files has been created by another process during the run, and `force` is not set.
    """
    print(INTRODUCTION.format(s=study, d=study.data, noise=100 * NOISE), flush=True)
    rows = []
    runs = []
    for grid in study.grids:
        logk, row, run = recover(study, grid)
        rows.append(row)
        runs.append(run)
    print("Error against run time. Misfit/noise 1: the readings are met to the noise. Error 1: the flat start.")
    print(table_of(rows, TABLE_COLUMNS), end="\n\n")
    claim_folder(folder, FILES, force)  # check again: files may have been created during the run
    write_file(folder / "table.csv", table_of(rows).csv())
    write_file(folder / "convergence.csv", table_of([iteration for run in runs for iteration in run]).csv())
    write_file(folder / "recovered.npy", lambda stream: np.save(stream, logk, allow_pickle=False))
    try:
        plots.write_picture(folder / "truth.png", partial(_map, study, "Hidden ground", study.truth))
        plots.write_picture(folder / "recovery.png", partial(_map, study, "Recovered", logk))
        plots.write_picture(folder / "convergence.png", partial(_convergence, runs))
    except ImportError as error:
        print(f"No pictures: {error}")
    print(f"Written to {folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}", NEXT_COMMANDS, sep="\n")
    return all(row["gradient"] == "agrees" for row in rows)


INTRODUCTION = """\
The ground   {s.terrain.source}, {s.terrain.field.shape} values, taken as log-conductivity
The survey   {d.readings.shape} wells pumped in turn and pressure sensors, {noise:g} % noise, computed on a finer grid
The law      -div(k grad p) = b, rivers at both ends in x, no flow through the other sides
The task     find log k in every cell from the readings: L-BFGS through the adjoint, from a flat start
"""

NEXT_COMMANDS = """
To try next:
  python -m sparsedp demo --input FIELD.npy --out MINE    a field of your own, as .npy, .npz or .png
  python -m sparsedp check FILE.py                        is the gradient of the loss in a file right?
  python -m sparsedp report FILE.py                       all instruments on it, in one folder"""


def _map(study: Study, title: str, field: np.ndarray, ax: Any) -> Any:
    """Plot a field with wells and sensors. True and estimated field have the same colour scale."""
    limits = float(study.truth.min()), float(study.truth.max())
    plots.plot(study.grids[-1], field, ax, title, "log of conductivity / mean conductivity", limits)
    ax.plot(*study.data.sensors.T, ".", color="black", markersize=1, alpha=0.6)
    ax.plot(*study.data.wells.T, "o", color="white", markeredgecolor="black")
    return ax


def _convergence(runs: list[list[dict[str, Any]]], ax: Any) -> Any:
    """Plot error against run time, with one curve for each grid."""
    lines = {f"{run[0]['grid']} cells": [(row["seconds"], row["error"]) for row in run] for run in runs}
    return plots.curves(lines, ax, "run time [s]", "relative error of log conductivity (flat start: 1)")
