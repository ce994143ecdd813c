"""The demo from the first line to the last: hide a ground, survey it, check the gradient, recover it on three grids.

What the reader sees is printed; pictures, the table and the recovered field are left behind.
"""

import os
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
from sparsedp.report.table import csv_text, text_table
from sparsedp.report.work_precision import measured_row, versions

__all__ = ["ARRAYS", "PICTURES", "Study", "Trial", "grids_for", "prepare", "tell"]

SMALLEST, LARGEST = 12, 512  # cells along the longest side
THINNEST = 0.25  # shortest side of the box
ITERATIONS = 80
SEED = 0
PICTURES = ("truth.png", "recovery.png", "error.png", "convergence.png")
ARRAYS = ("table.csv", "recovered.npy")
SHOWN = ("grid", "unknowns", "iterations", "solves_forward", "solves_adjoint", "seconds", "misfit", "error")


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

    Attributes
    ----------
    loss, x : callable, array
        And a ground that is nowhere special.
    trace : list of (seconds, misfit, error)
        After each iteration. Misfit: root mean square of (computed - read) / noise, 1 is a fit within the noise.
        Error: distance from the truth, relative, 1 for the flat start.
    """

    def __init__(self, study, grid):
        self.study, self.grid, self.name = study, grid, " x ".join(map(str, grid.shape))
        self.loss, self.x = self.problem()
        self.trace: list = []

    def problem(self):
        """A loss that has not been used before, and where it is looked at."""
        x, y = self.grid.centres()
        ground = Ground(self.grid, self.study.data.wells, self.study.data.sensors)
        return objective(ground, self.study.data), 0.5 * np.sin(5 * x + 1) * np.cos(4 * y)

    def recover(self):
        """L-BFGS from the flat start; prints a line for each iteration."""
        truth, roughness, start = self.study.truth, regulariser(self.grid), np.zeros(self.grid.shape)
        to_finest = remap(self.grid, self.study.grids[-1]).explicit()

        def note(record, logk):
            misfit = float(np.sqrt(max(0.0, 2 * (record.value - roughness(logk)))))
            error = float(np.linalg.norm(to_finest(logk) - truth) / np.linalg.norm(truth))
            self.trace.append((record.seconds, misfit, error))
            print(f"  {len(self.trace):9d}   {misfit:12.3f}   {error:5.3f}   {record.seconds:7.2f}", flush=True)

        print(f"Recovery on {self.grid}\n  iteration   misfit/noise   error   seconds")
        dp.value_and_grad(self.loss)(start + 1e-12)  # the first call of a kernel is not the price of a run
        with recording() as calls:
            self.best = best = dp.minimize(self.loss, start, maxiter=ITERATIONS, callback=note, memory=20)
        if best.message.startswith("interrupted"):  # minimize keeps its best point; the demo ends
            raise KeyboardInterrupt
        if best.history[-1].iteration > len(self.trace):  # the iteration that meets the tolerance is not reported
            note(best.history[-1], best.x)
        kinds = {"solves_forward": "solve", "solves_adjoint": "adjoint", "setups": "setup"}
        self.solves = {name: total(calls, kind) for name, kind in kinds.items()}
        forward, adjoint, setups = self.solves.values()
        print(f"  {forward} forward and {adjoint} adjoint solves, {setups} set-ups\n")

    def row(self, check):
        """The figures of the run and of its gradient check, in the order of the columns of the table."""
        _, misfit, error = self.trace[-1]
        cost = measured_row(self.problem, {}, repeats=3)[0]
        gaps = (abs(line.gap) / line.scale for line in check.lines if line.scale > 0)
        return {
            "scene": "demo",
            "method": "lbfgs, adjoint",
            "grid": self.name,
            "unknowns": self.grid.cells.size,
            "tolerance": RTOL,
            "misfit": misfit,
            "error": error,
            "gradient_error": max(gaps, default=np.nan),
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
    checks = [dp.check.gradient(t.loss, t.x, directions=3 if t is trials[-1] else 1) for t in trials]
    print(f"Is the gradient right? On {trials[-1].grid}:", checks[-1], sep="\n")
    print(f"On the coarser grids: {', '.join(check.verdict for check in checks[:-1])}\n")
    for trial in trials:
        trial.recover()
    rows = [trial.row(check) for trial, check in zip(trials, checks, strict=True)]
    print("Error against run time. Misfit/noise 1: the readings are met to the noise. Error 1: the flat start.")
    print(text_table([{"grid": "flat start", "error": 1.0}, *rows], SHOWN), end="\n\n")
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
    print(
        f"The ground   {terrain.source}, {' x '.join(map(str, terrain.field.shape))} values,",
        f"             taken as log-conductivity: {low:.2g} to {high:.2g} times the mean",
        f"The survey   {wells} wells pumped in turn, {sensors} pressure sensors, {100 * NOISE:g} % noise,",
        f"             computed on {study.source_grid}",
        "The law      -div(k grad p) = b, rivers at both ends in x, no flow through the other sides",
        "The task     find log k in every cell from the readings: L-BFGS through the adjoint, from a flat start\n",
        sep="\n", flush=True,
    )  # fmt: skip


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
    truth, recovery, data = study.truth, trial.best.x, study.data
    low, high = float(truth.min()), float(truth.max())
    for title, field, options in (
        ("Hidden ground", truth, {"limits": (low, high)}),
        ("Recovered from the readings", recovery, {"limits": (low, high)}),
        (f"Recovered - hidden: relative error {trial.trace[-1][2]:.2f}", recovery - truth,
         {"limits": (-high, high), "cmap": "RdBu_r"}),
    ):  # fmt: skip
        picture = plots.figure()
        ax = picture.add_subplot()
        plots.plot(trial.grid, field, ax, title, "log of conductivity / mean conductivity", **options)
        ax.set(xlabel="x [longest side]", ylabel="y [longest side]")
        ax.plot(*data.sensors.T, ".", color="black", markersize=1, alpha=0.6)
        ax.plot(*data.wells.T, "o", color="white", markeredgecolor="black", markersize=6)
        picture.supxlabel("circles: wells, pumped in turn; dots: pressure sensors", fontsize="small", color="0.3")
        yield picture


def _convergence(trials):
    """Misfit and error against run time, one curve for each grid."""
    picture = plots.figure(9.5, 4.2)
    left, right = picture.subplots(1, 2)
    for ax, column, name, title in (
        (left, 1, "misfit / noise", "How well the readings are met (1: to the noise)"),
        (right, 2, "relative error of log conductivity", "How well the ground is found (flat start: 1)"),
    ):
        traces = {f"{trial.name} cells": np.transpose(trial.trace)[[0, column]] for trial in trials}
        plots.curves(traces, ax, "run time [s]", name, title)
    left.axhline(1.0, color="0.5", linestyle=":", linewidth=1)
    return picture
