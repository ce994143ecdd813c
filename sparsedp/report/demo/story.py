"""The demo from the first line to the last: hide a ground, survey it, check the gradient, recover it on three grids.

What the reader sees is printed; pictures, the table and the recovered field are left behind.
"""

from functools import partial
from typing import NamedTuple

import numpy as np

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp.check.table import table_of
from sparsedp.io.atomic_files import write_file
from sparsedp.report import plots
from sparsedp.report.certificate import distance
from sparsedp.report.demo.scene import NOISE, Ground, Survey, objective, regulariser, survey
from sparsedp.report.demo.terrain import Terrain, hidden_ground, remap
from sparsedp.report.explain import total
from sparsedp.report.scene_file import claim_folder

__all__ = ["FILES", "Study", "grids_for", "prepare", "tell"]

SMALLEST, LARGEST = 12, 512  # cells along the longest side
THINNEST = 0.25  # shortest side of the box
ITERATIONS = 80
WARM_UP = 2  # iterations whose time is not measured
PRINTED = (1, 2, 5, 10, 20, 40, 80)  # iterations
ARRAYS = ("table.csv", "recovered.npy")
PICTURES = ("truth.png", "recovery.png", "convergence.png")
FILES = (*ARRAYS, *PICTURES)
COUNTED = {"solves_forward": "solve", "solves_adjoint": "adjoint", "setups": "setup"}
SHOWN = ("grid", "unknowns", "gradient", "iterations", *COUNTED, "seconds", "misfit", "error")


class Study(NamedTuple):
    """What all grids share: the survey, and the hidden ground they try to find, on the finest of them."""

    terrain: Terrain
    grids: list
    data: Survey
    truth: np.ndarray


def grids_for(terrain, size):
    """Terrain and cells along the longest side -> three grids in its proportions, the longest side of length 1.

    They have half, three quarters and all of these cells.

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


def prepare(terrain, grids):
    """Terrain and grids -> Study: hide the ground, make the survey on a grid twice as fine as the finest.

    Raises
    ------
    ValueError
        If nothing of the terrain is left at this size.
    """
    fine = dp.Grid(tuple(2 * n for n in grids[-1].shape), size=grids[-1].size)
    hidden = hidden_ground(fine, terrain)
    return Study(terrain, grids, survey(fine, hidden), remap(fine, grids[-1])(hidden))


def recover(study, grid):
    """Study and grid -> (log-conductivity, row of the table, pairs of seconds and error).

    The gradient is checked, then the ground is found by L-BFGS; the iterations in `PRINTED` and the last one are
    printed. Two iterations run beforehand, on a ground of their own: the seconds do not contain compilation.
    Misfit: root mean square of (computed - read) / noise, 1 is a fit within the noise. Error: distance from the truth,
    relative, 1 for the flat start.
    """
    loss, warm_up = (objective(Ground(grid, study.data.wells, study.data.sensors), study.data) for _ in range(2))
    x, y = grid.centres()  # a ground that is nowhere special
    check = dp.check.gradient(loss, 0.5 * np.sin(5 * x + 1) * np.cos(4 * y), directions=1)
    shown = check if grid is study.grids[-1] else check.verdict  # one table is enough
    print(f"On {grid}. Is the gradient right?", shown, sep="\n", end="\n\n", flush=True)
    roughness, to_finest = regulariser(grid), remap(grid, study.grids[-1])
    rows: list[dict] = []

    def note(record, logk):
        misfit = float(np.sqrt(max(0.0, 2 * (record.value - roughness(logk)))))
        error = distance(to_finest(logk), study.truth)
        rows.append({"iterations": len(rows) + 1, "seconds": record.seconds, "misfit": misfit, "error": error})
        if len(rows) in PRINTED:
            show(rows[-1])

    def show(row):
        print("  {iterations:9d}   {misfit:12.3f}   {error:5.3f}   {seconds:7.2f}".format(**row), flush=True)

    with recording():
        dp.minimize(warm_up, np.zeros(grid.shape), maxiter=WARM_UP, memory=20)
    print("  iteration   misfit/noise   error   seconds", flush=True)  # a log is read while it is written
    with recording() as calls:
        best = dp.minimize(loss, np.zeros(grid.shape), maxiter=ITERATIONS, callback=note, memory=20)
    if best.message.startswith("interrupted"):  # minimize keeps its best point; the demo ends
        raise KeyboardInterrupt
    if best.history[-1].iteration > len(rows):  # the iteration that meets the tolerance is not reported
        note(best.history[-1], best.x)
    if len(rows) not in PRINTED:
        show(rows[-1])
    counts = {name: total(calls, kind) for name, kind in COUNTED.items()}
    print(f"  {', '.join(f'{many} {name}' for name, many in counts.items())}\n", flush=True)
    row = {"grid": " x ".join(map(str, grid.shape)), "unknowns": best.x.size, **rows[-1], **counts}
    row |= {"gradient": check.verdict, "gradient_error": max((line.share for line in check.lines), default=np.nan)}
    return best.x, row, [(one["seconds"], one["error"]) for one in rows]


# ---------------------------------------------------------------- what the reader sees


def tell(study, folder, force):
    """Run the demo, print what happens, write the files.

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
        If one has come there during the run, and `force` is not set.
    """
    print(INTRODUCTION.format(s=study, d=study.data, noise=100 * NOISE), flush=True)
    (*_, logk), rows, curves = zip(*(recover(study, grid) for grid in study.grids))
    print("Error against run time. Misfit/noise 1: the readings are met to the noise. Error 1: the flat start.")
    print(table_of(rows, SHOWN), end="\n\n")
    claim_folder(folder, FILES, force)  # once more: it is a while since the run began
    write_file(folder / "table.csv", table_of(rows).csv())
    write_file(folder / "recovered.npy", lambda stream: np.save(stream, logk, allow_pickle=False))
    try:
        plots.write_picture(folder / "truth.png", partial(_map, study, "Hidden ground", study.truth))
        plots.write_picture(folder / "recovery.png", partial(_map, study, "Recovered", logk))
        plots.write_picture(folder / "convergence.png", partial(_convergence, rows, curves))
    except ImportError as error:
        print(f"No pictures: {error}")
    print(f"Written to {folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}", NEXT, sep="\n")
    return all(row["gradient"] == "agrees" for row in rows)


INTRODUCTION = """\
The ground   {s.terrain.source}, {s.terrain.field.shape} values, taken as log-conductivity
The survey   {d.readings.shape} wells pumped in turn and pressure sensors, {noise:g} % noise, computed on a finer grid
The law      -div(k grad p) = b, rivers at both ends in x, no flow through the other sides
The task     find log k in every cell from the readings: L-BFGS through the adjoint, from a flat start
"""

NEXT = """
To try next:
  python -m sparsedp demo --input FIELD.npy --out MINE    a field of your own, as .npy, .npz or .png
  python -m sparsedp check FILE.py                        is the gradient of the loss in a file right?
  python -m sparsedp report FILE.py                       all instruments on it, in one folder"""


def _map(study, title, field, ax):
    """A field with the wells and the sensors; truth and recovery with the same colours."""
    limits = float(study.truth.min()), float(study.truth.max())
    plots.plot(study.grids[-1], field, ax, title, "log of conductivity / mean conductivity", limits)
    ax.plot(*study.data.sensors.T, ".", color="black", markersize=1, alpha=0.6)
    ax.plot(*study.data.wells.T, "o", color="white", markeredgecolor="black")
    return ax


def _convergence(rows, curves, ax):
    """Error against run time, one curve for each grid."""
    lines = {f"{row['grid']} cells": curve for row, curve in zip(rows, curves)}
    return plots.curves(lines, ax, "run time [s]", "relative error of log conductivity (flat start: 1)")
