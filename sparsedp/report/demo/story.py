"""What the reader of the demo sees, from the first line to the last."""

import sys
from contextlib import contextmanager
from functools import partial

import numpy as np

from sparsedp.report.demo import outputs
from sparsedp.report.demo.scene import NOISE
from sparsedp.report.demo.study import ITERATIONS, Trial

__all__ = ["tell"]

TABLE = "  {:>10}  {:>8}  {:>10}  {:>7}  {:>7}  {:>7}  {:>12}  {:>5}"


def tell(study, folder, force):
    """Run the demo, print what happens, write the files.

    Parameters
    ----------
    study : Study
    folder : pathlib.Path
        Claimed before, see `outputs.claim`.
    force : bool

    Returns
    -------
    bool
        Whether the gradient agrees with finite differences on every grid.
    """
    _introduce(study)
    trials = [Trial(study, grid) for grid in study.grids]
    checks = [trial.check_gradient(directions=3 if trial is trials[-1] else 1) for trial in trials]
    _show_check(trials[-1], checks)
    for trial in trials:
        _recover(trial)
    rows = [trial.row(check) for trial, check in zip(trials, checks, strict=True)]
    _show_table(rows)
    outputs.write_arrays(folder, force, rows, trials[-1].best.x)
    _show_files(study, trials, folder, force)
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


def _show_check(trial, checks):
    print(f"Is the gradient right? On {trial.grid}:")
    print(checks[-1])
    others = ", ".join(check.verdict for check in checks[:-1])
    print(f"On the coarser grids: {others}\n")


def _recover(trial):
    print(f"Recovery on {trial.grid}")
    print("  iteration   misfit/noise   error   seconds")
    with _progress() as (say, step):

        def watch(trial):
            seconds, misfit, error = trial.trace[-1]
            say(f"  {len(trial.trace):9d}   {misfit:12.3f}   {error:5.3f}   {seconds:7.2f}")
            step()

        trial.recover(watch)
    solves = trial.solves
    print(f"  {solves['solve']} forward and {solves['adjoint']} adjoint solves, {solves['setup']} set-ups\n")


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
    head = ("grid", "unknowns", "iterations", "forward", "adjoint", "seconds", "misfit/noise", "error")
    print(TABLE.format(*head))
    print(TABLE.format("flat start", "", "", "", "", "", "", "1.000"))
    for row in rows:
        figures = row["seconds"], row["misfit"], row["error"]
        counts = row["unknowns"], row["iterations"], row["solves_forward"], row["solves_adjoint"]
        print(TABLE.format(row["grid"], *counts, *(f"{figure:.3f}" for figure in figures)))
    print()


def _show_files(study, trials, folder, force):
    written = list(outputs.ARRAYS)
    try:
        outputs.write_pictures(folder, force, study, trials)
        written += outputs.PICTURES
    except ImportError as error:
        print(f"No pictures: {error}")
    print(f"Written to {folder}: {', '.join(written)}")
