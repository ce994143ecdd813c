"""The demo from the first line to the last: hide a ground, survey it, check the gradient, recover it on three grids.

What the reader sees is printed; pictures, the table and the recovered field are left behind.
"""

import os
import sys
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import numpy as np

import sparsedp as dp
from sparsedp.files import write_file
from sparsedp.ledger import recording
from sparsedp.report import plots
from sparsedp.report.demo.scene import NOISE, RTOL, Ground, Survey, objective, regulariser, survey
from sparsedp.report.demo.terrain import Terrain, hidden_ground, remap
from sparsedp.report.plan import total
from sparsedp.report.table import csv_text
from sparsedp.report.work_precision import measured_row, versions

__all__ = ["ARRAYS", "PICTURES", "Study", "Trial", "grids_for", "prepare", "tell"]

SMALLEST, LARGEST = 12, 512  # cells along the longest side
THINNEST = 0.25  # shortest side of the box
ITERATIONS = 80
SEED = 0
PICTURES = ("truth.png", "recovery.png", "error.png", "convergence.png")
ARRAYS = ("table.csv", "recovered.npy")
TABLE = "  {:>10}  {:>8}  {:>10}  {:>7}  {:>7}  {:>7}  {:>12}  {:>5}"


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
        self.loss = self.problem()[0]
        self.roughness = regulariser(grid)
        self.to_finest = remap(grid, study.grids[-1]).explicit()
        self.trace = []  # (seconds, misfit, error) after each iteration
        self.name = " x ".join(map(str, grid.shape))

    def problem(self):
        """A loss that has not been used before, and the ground where it is looked at: nowhere special."""
        x, y = self.grid.centres()
        ground = Ground(self.grid, self.study.data.wells, self.study.data.sensors)
        return objective(ground, self.study.data), 0.5 * np.sin(5 * x + 1) * np.cos(4 * y)

    def check_gradient(self, directions):
        """The gradient against finite differences."""
        loss, x = self.problem()
        return dp.check.gradient(loss, x, directions=directions)

    def recover(self, watch):
        """L-BFGS from the flat start. ``watch(seconds, misfit, error)`` is called after each iteration."""
        truth = self.study.truth

        def note(record, logk):
            # Root mean square of (computed - read) / noise: 1 is a fit within the noise.
            misfit = float(np.sqrt(max(0.0, 2 * (record.value - self.roughness(logk)))))
            error = float(np.linalg.norm(self.to_finest(logk) - truth) / np.linalg.norm(truth))
            self.trace.append((record.seconds, misfit, error))
            watch(*self.trace[-1])

        start = np.zeros(self.grid.shape)
        dp.value_and_grad(self.loss)(start + 1e-12)  # the first call of a kernel is not the price of a run
        self.to_finest(start)
        with recording() as calls:
            best = dp.minimise(self.loss, start, maxiter=ITERATIONS, callback=note, memory=20)
        if best.message.startswith("interrupted"):  # minimise keeps its best point; the demo ends
            raise KeyboardInterrupt
        if best.history[-1].iteration > len(self.trace):  # the iteration that meets the tolerance is not reported
            note(best.history[-1], best.x)
        self.best = best
        kinds = {"solves_forward": "solve", "solves_adjoint": "adjoint", "setups": "setup"}
        self.solves = {name: total(calls, kind) for name, kind in kinds.items()}

    def row(self, check):
        """The figures of the run and of its gradient check, in the order of the columns of the table."""
        _, misfit, error = self.trace[-1]
        cost = measured_row(self.problem, {}, repeats=3)[0]
        return {
            "scene": "demo",
            "method": "lbfgs, adjoint",
            "grid": self.name,
            "unknowns": self.grid.cells.size,
            "tolerance": RTOL,
            "misfit": misfit,
            "error": error,
            "gradient_error": max(
                (abs(line.gap) / line.scale for line in check.lines if line.scale > 0), default=np.nan
            ),
            "seconds": self.best.history[-1].seconds,
            **{name: cost[name] for name in ("seconds_setup", "seconds_forward", "seconds_backward", "peak_bytes")},
            **self.solves,
            "iterations": len(self.trace),
            "status": "converged" if self.best.converged else self.best.message,
            "seed": SEED,
            "versions": versions(),
        }


# ---------------------------------------------------------------- what the reader sees


def tell(study, folder, force):
    """Run the demo, print what happens, write the files.

    Parameters
    ----------
    study : Study
    folder : pathlib.Path
        Claimed before.
    force : bool
        Whether files may be overwritten that appear during the run.

    Returns
    -------
    bool
        Whether the gradient agrees with finite differences on every grid.

    Raises
    ------
    OSError
        If a file cannot be written, or is there and `force` is not set.
    """
    _introduce(study)
    trials = [Trial(study, grid) for grid in study.grids]
    checks = [trial.check_gradient(directions=3 if trial is trials[-1] else 1) for trial in trials]
    print(f"Is the gradient right? On {trials[-1].grid}:", checks[-1], sep="\n")
    print(f"On the coarser grids: {', '.join(check.verdict for check in checks[:-1])}\n")
    for trial in trials:
        _recover(trial)
    rows = [trial.row(check) for trial, check in zip(trials, checks, strict=True)]
    _show_table(rows)
    write_arrays(folder, force, rows, trials[-1].best.x)
    written = list(ARRAYS)
    try:
        for name, picture in zip(PICTURES, (*_maps(study, trials[-1]), _convergence(trials)), strict=True):
            _write(folder / name, force, partial(plots.save, picture))
        written += PICTURES
    except ImportError as error:
        print(f"No pictures: {error}")
    print(f"Written to {folder}: {', '.join(written)}")
    return all(check.verdict == "agrees" for check in checks)


def _introduce(study):
    terrain, data = study.terrain, study.data
    low, high = np.exp([study.truth.min(), study.truth.max()])
    wells, sensors = data.readings.shape
    print(f"The ground   {terrain.source}, {' x '.join(map(str, terrain.field.shape))} values,")
    print(f"             taken as log-conductivity: {low:.2g} to {high:.2g} times the mean")
    print(f"The survey   {wells} wells pumped in turn, {sensors} pressure sensors, {100 * NOISE:g} % noise,")
    print(f"             computed on {study.source_grid}")
    print("The law      -div(k grad p) = b, rivers at both ends in x, no flow through the other sides")
    print(
        "The task     find log k in every cell from the readings: L-BFGS through the adjoint, from a flat start\n",
        flush=True,
    )


def _recover(trial):
    print(f"Recovery on {trial.grid}")
    print("  iteration   misfit/noise   error   seconds")
    with _progress() as (say, step):

        def watch(seconds, misfit, error):
            say(f"  {len(trial.trace):9d}   {misfit:12.3f}   {error:5.3f}   {seconds:7.2f}")
            step()

        trial.recover(watch)
    print("  {solves_forward} forward and {solves_adjoint} adjoint solves, {setups} set-ups\n".format(**trial.solves))


@contextmanager
def _progress():
    """A bar below the lines when tqdm is installed and someone is watching; the lines alone otherwise."""
    try:
        from tqdm import tqdm
    except ImportError:
        yield partial(print, flush=True), lambda: None
        return
    with tqdm(total=ITERATIONS, unit="iteration", leave=False, disable=not sys.stderr.isatty()) as bar:
        yield (partial(print, flush=True) if bar.disable else bar.write), bar.update


def _show_table(rows):
    print("Error against run time. Misfit/noise 1: the readings are met to the noise. Error 1: the flat start.")
    print(TABLE.format("grid", "unknowns", "iterations", "forward", "adjoint", "seconds", "misfit/noise", "error"))
    print(TABLE.format("flat start", "", "", "", "", "", "", "1.000"))
    for row in rows:
        counts = (row[name] for name in ("grid", "unknowns", "iterations", "solves_forward", "solves_adjoint"))
        print(TABLE.format(*counts, *(f"{row[name]:.3f}" for name in ("seconds", "misfit", "error"))))
    print()


# ---------------------------------------------------------------- what is left behind


def _write(path, force, content):
    """A file. Without `force` one that appeared during the run is safe too."""
    if not force and os.path.lexists(path):
        raise FileExistsError(f"{path} came there during the run; name another folder with --out, or write --force")
    write_file(path, content)


def write_arrays(folder, force, rows, recovered):
    """Table rows (dicts with the same keys) and the recovered field -> table.csv, recovered.npy."""
    _write(folder / "table.csv", force, csv_text(rows))
    _write(folder / "recovered.npy", force, lambda stream: np.save(stream, recovered, allow_pickle=False))


def _maps(study, trial):
    """Truth and recovery with the same colours, and their difference."""
    grid, truth, found = trial.grid, study.truth, trial.best.x
    limits = float(truth.min()), float(truth.max())
    label = "log of conductivity / mean conductivity"
    for title, field in (("Hidden ground", truth), ("Recovered from the readings", found)):
        yield _map(grid, field, study.data, title, label=label, limits=limits)
    gap = found - truth
    title = f"Recovered - hidden: relative error {trial.trace[-1][2]:.2f}"
    yield _map(grid, gap, None, title, label=label, limits=(-limits[1], limits[1]), colours="RdBu_r")


def _map(grid, field, data, title, **options):
    picture = plots.figure()
    ax = plots.plot(grid, field, ax=picture.add_subplot(), title=title, **options)
    ax.set_xlabel("x [longest side]")
    ax.set_ylabel("y [longest side]")
    if data is not None:
        ax.plot(*data.sensors.T, ".", color="black", markersize=1, alpha=0.6)
        ax.plot(*data.wells.T, "o", color="white", markeredgecolor="black", markersize=6)
        picture.supxlabel("circles: wells, pumped in turn; dots: pressure sensors", fontsize="small", color="0.3")
    return picture


def _convergence(trials):
    """Misfit and error against run time, one curve for each grid."""
    picture = plots.figure(9.5, 4.2)
    left, right = picture.subplots(1, 2)
    for ax, column, name, title in (
        (left, 1, "misfit / noise", "How well the readings are met (1: to the noise)"),
        (right, 2, "relative error of log conductivity", "How well the ground is found (flat start: 1)"),
    ):
        traces = {f"{trial.name} cells": np.transpose(trial.trace) for trial in trials}
        plots.curves(
            {label: (trace[0], trace[column]) for label, trace in traces.items()}, ax, "run time [s]", name, title
        )
    left.axhline(1.0, color="0.5", linestyle=":", linewidth=1)
    return picture
