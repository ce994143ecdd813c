"""What the demo leaves behind: pictures, the table, the recovered field. Nothing is overwritten unasked."""

import os
from functools import partial

import numpy as np

from sparsedp.files import write_file
from sparsedp.report import charts, plots
from sparsedp.report.rows import csv_text

__all__ = ["PICTURES", "claim", "write_arrays", "write_pictures"]

PICTURES = ("truth.png", "recovery.png", "error.png", "convergence.png")
ARRAYS = ("table.csv", "recovered.npy")


def claim(folder, force):
    """Make the folder, and refuse when it holds a file that would be overwritten.

    Parameters
    ----------
    folder : pathlib.Path
    force : bool
        Whether overwriting was asked for.

    Raises
    ------
    ValueError
        If a file is there already, or the folder cannot be made or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        taken = [name for name in (*PICTURES, *ARRAYS) if os.path.lexists(folder / name)]
    except OSError as error:
        raise ValueError(f"{folder} cannot be made a folder: {error.strerror}; name another with --out") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(f"{folder} cannot be written to; name another with --out")
    if taken and not force:
        raise ValueError(f"{folder / taken[0]} is there already; name another folder with --out, or write --force")


def _write(path, force, content):
    """A file. Without `force` one that appeared during the run is safe too."""
    if not force and os.path.lexists(path):
        raise FileExistsError(f"{path} came there during the run; name another folder with --out, or write --force")
    write_file(path, content)


def write_arrays(folder, force, rows, recovered):
    """Table rows (dicts with the same keys) and the recovered field -> table.csv, recovered.npy.

    Parameters
    ----------
    folder : pathlib.Path
    force : bool
    rows : list of dict
    recovered : array

    Raises
    ------
    OSError
        If a file cannot be written, or is there and `force` is not set.
    """
    _write(folder / "table.csv", force, csv_text(rows, list(rows[0])))
    _write(folder / "recovered.npy", force, lambda stream: np.save(stream, recovered, allow_pickle=False))


def write_pictures(folder, force, study, trials):
    """Study and its trials, coarse to fine -> truth, recovery, error and convergence pictures.

    Parameters
    ----------
    folder : pathlib.Path
    force : bool
    study : Study
    trials : list of Trial

    Raises
    ------
    ImportError
        If matplotlib is not installed.
    OSError
        If a file cannot be written, or is there and `force` is not set.
    """
    for name, picture in zip(PICTURES, (*_maps(study, trials[-1]), _convergence(trials)), strict=True):
        _write(folder / name, force, partial(plots.save, picture))


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
    for ax, column, name in ((left, 1, "misfit / noise"), (right, 2, "relative error of log conductivity")):
        lines = {
            f"{' x '.join(map(str, trial.grid.shape))} cells": (
                [point[0] for point in trial.trace],
                [point[column] for point in trial.trace],
            )
            for trial in trials
        }
        charts.curves(lines, ax, "run time [s]", name)
    left.axhline(1.0, color="0.5", linestyle=":", linewidth=1)
    left.set_title("How well the readings are met (1: to the noise)")
    right.set_title("How well the ground is found (flat start: 1)")
    return picture
