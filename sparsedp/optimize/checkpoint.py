"""Checkpoints of a run of `minimize`. Each state is stored in one file, which is written atomically."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.pytree import flatten, leaves, norm
from sparsedp.autodiff.backend import process_count
from sparsedp.io.atomic_files import UNFINISHED, load_tree, path_errors, save_tree
from sparsedp.io.digest import digest
from sparsedp.io.fingerprint import fingerprint
from sparsedp.optimize.checkpoint_upgrade import FORMAT_0_2, upgraded
from sparsedp.optimize.result import Evaluation, Failure, Record

if TYPE_CHECKING:
    import os

    from sparsedp.optimize.monitor import Monitor
    from sparsedp.optimize.objective import Objective

__all__ = ["Checkpoint"]

FORMAT = "sparsedp optimization 5"
STATES = 2  # number of states that are kept
ROUNDING = 1e-6  # tolerated relative difference of loss and gradient if the number of processes or the version changed
SHARE = 0.1  # writing states may take at most this fraction of the run time


class Checkpoint:
    """A folder with the last two states of a run, each stored in an .npz file without pickle.

    Parameters
    ----------
    folder : path or None
        If it is None, nothing is read or written.
    settings : dict
        Names and values of the settings of the run, other than the loss and the batches. If the folder contains a run
        with other settings, ValueError is raised.

    Attributes
    ----------
    resumed : str
        A sentence that says whether the run continued from the folder; empty if there is no folder.
    """

    def __init__(self, folder: str | os.PathLike[str] | None, settings: dict[str, Any]):
        self._folder: Any = None
        if folder is not None:
            self._folder = Path(folder)
        self._settings = settings
        self._unwritten: Any = None  # content of the last state, until it is written
        self._last_write_time = -np.inf
        self._last_write_seconds = 0.0
        self.resumed = ""

    def resume(self, template: Any, objective: Objective, monitor: Monitor) -> Any:
        """Return the last state stored in the folder, or None, and restore `objective` and `monitor`.

        Parameters
        ----------
        template : state
            The state at the start. It determines the structure of the stored state, and its loss is compared with the
            stored loss at the start.
        objective : Objective
        monitor : Monitor

        Raises
        ------
        ValueError
            If the folder contains a run with other settings or batches, or if the loss at its first or last point has
            changed.
        """
        if self._folder is None:
            return None
        with path_errors(self._folder):
            self._folder.mkdir(parents=True, exist_ok=True)
        self._settings = {name: fingerprint(value) for name, value in self._settings.items()}
        self._settings["list of batches"] = ""
        content, skipped = self._load()
        past_iterations = content["iteration"] + 1 if content else 1
        for number in range(past_iterations):
            self._add_batch(objective.batches.at(number))
        if not content:
            self.resumed = f"nothing to resume in {self._folder}{skipped}"
            return None
        self.resumed = f"resumed from iteration {content['iteration']} in {self._folder}{skipped}"
        for name in {**self._settings, "metric": None}:  # only runs with a metric have this setting
            self._check_same(name, self._settings.get(name) == content["settings"].get(name))
        history = [_record(fields) for fields in content["history"]]
        start = template.current
        exact = content["ranks"] == process_count() and content["format"] == FORMAT
        self._check_start(start, history[0], objective, exact)
        if content["format"] == FORMAT:
            state = flatten(template)[1](content["state"])
            best = Evaluation(*content["best"])
        else:
            state, best = upgraded(content["state"], content["best"], template, objective.residual_scale)
        objective.iteration = content["iteration"]
        self._check_last_point(state.current, start, objective, exact)
        objective.best = best
        objective.count = content["evaluations"]
        monitor.resume(history, start, state.current)
        return state

    def _check_start(self, start, record, objective, exact):
        """Raise ValueError if the loss or gradient norm at the start differs from the stored record."""
        value = objective.in_units_of_loss(start.value)
        gradient_norm = objective.in_units_of_loss(objective.gradient_norm(start))
        same = _agree(value, record.value, record.value, exact)
        same = same and _agree(gradient_norm, record.gradient_norm, record.gradient_norm, exact)
        self._check_same("loss at the start", same)

    def _check_last_point(self, last, start, objective, exact):
        """Raise ValueError if the loss or gradient at the last point differs from the stored one."""
        again = objective(last.point)
        same = _agree(again.value, last.value, start.value, exact)
        same = same and _agree(again.gradient, last.gradient, norm(objective.projected_gradient(start)), exact)
        self._check_same("loss at the last point", same)

    def _check_same(self, name, same):
        """Raise ValueError unless `same` is true; `name` says what differs in the stored run."""
        if not same:
            raise ValueError(
                f"{self._folder} holds a run with another {name}; call minimize as that run began, or write another "
                "checkpoint folder"
            )

    def _load(self):
        """Return the content of the newest valid file ({} without one), and a text about skipped files."""
        skipped = [f"; skipped {path.name}: an unfinished write" for path in self._folder.glob(f"*{UNFINISHED}")]
        for path in self._files():
            for version in (FORMAT, FORMAT_0_2):
                content = load_tree(path, version)
                if content:
                    return {**content[0], "format": version}, "".join(skipped)
            skipped.append(f"; skipped {path.name}: damaged, or not a state of sparsedp")
        return {}, "".join(skipped)

    def _files(self):
        """Return the paths of all stored states, newest first."""
        return sorted(self._folder.glob("state-*.npz"), reverse=True)

    def _add_batch(self, batch):
        """Update the fingerprint of all batches so far with the batch of one more iteration."""
        so_far = self._settings["list of batches"] + fingerprint(batch)
        self._settings = {**self._settings, "list of batches": digest(so_far.encode())}

    def save(self, state: Any, objective: Objective, monitor: Monitor) -> None:
        """Remember the state, and write it if enough time has passed since the last write or if the run stops."""
        if self._folder is None:
            return
        self._add_batch(objective.batches.at(monitor.iteration))
        self._unwritten = {
            "iteration": monitor.iteration,
            "settings": self._settings,
            "ranks": process_count(),
            "evaluations": objective.count,
            "state": leaves(state),
            "best": list(objective.best),
        }
        seconds_since_write = time.perf_counter() - self._last_write_time
        if SHARE * seconds_since_write >= self._last_write_seconds or monitor.message:
            self.write(monitor.history)

    def write(self, history: list[Record]) -> None:
        """Write the state of the last complete iteration if it has not been written yet."""
        if self._unwritten is None:
            return
        begin = time.perf_counter()
        number = self._unwritten["iteration"]
        path = self._folder / f"state-{number:09d}.npz"
        save_tree(path, {**self._unwritten, "history": history[: number + 1]}, FORMAT)
        up_to_this = [file for file in self._files() if file <= path]  # files of later iterations are damaged
        for file in up_to_this[STATES:]:
            file.unlink(missing_ok=True)
        self._unwritten = None
        self._last_write_time = time.perf_counter()
        self._last_write_seconds = self._last_write_time - begin


def _agree(value, stored, size, exact):
    """Return whether two values agree: bitwise if `exact`, else up to a tolerance relative to `size`."""
    if np.array_equal(value, stored):
        return True
    return not exact and norm(value - stored) <= ROUNDING * abs(size)


def _record(fields):
    """Return a record of the history from its stored fields."""
    record = Record(*fields)
    return record._replace(failed=tuple(Failure(*failure) for failure in record.failed))
