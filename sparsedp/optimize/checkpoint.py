"""A run of minimize written down as it goes, whole or not at all, and taken up again."""

import hashlib
import time
from pathlib import Path
from typing import Any

import numpy as np

from sparsedp._utils.pytree import flatten, leaves, norm
from sparsedp.autodiff.fast_derivatives import ranks, whole
from sparsedp.io.atomic_files import UNFINISHED, load_tree, path_errors, save_tree
from sparsedp.optimize.checkpoint_upgrade import FORMAT_0_2, upgraded
from sparsedp.optimize.result import Failure, Record, Trial

__all__ = ["Checkpoint"]

FORMAT = "sparsedp optimization 5"
KEPT = 2
NEAR = 1e-6  # share of loss and gradient at the start by which other ranks or another version may differ
SHARE = 0.1  # a state is written when that takes at most this share of the time since the last one


class Checkpoint:
    """A folder with the last two states of a run, each a .npz file without pickle. Does nothing without a folder.

    Parameters
    ----------
    folder : path or None
    settings : dict
        What the run depends on, beside the loss and the batches: name -> any value. A folder of another run is refused.
    """

    def __init__(self, folder, settings):
        self._folder: Any = None if folder is None else Path(folder)
        self._settings = settings
        self._latest: Any = None  # what is to be written
        self._written, self._cost = -np.inf, 0.0
        self.resumed = ""

    def resume(self, template, trials, watch):
        """The last state of the folder, put into trials and watch too; None when there is none.

        `template` is the state at the start: what a state looks like, and proof that the loss is the same there.

        Raises
        ------
        ValueError
            If the folder holds another run, or one with other batches or with another loss at its last point.
        """
        if self._folder is None:
            return None
        with path_errors(self._folder):
            self._folder.mkdir(parents=True, exist_ok=True)
        self._settings = {name: fingerprint(value) for name, value in self._settings.items()}
        self._settings["list of batches"] = ""
        content, skipped = self._load()
        for number in range(content["iteration"] + 1 if content else 1):
            self._pass(trials.batches, number)
        if not content:
            self.resumed = f"nothing to resume in {self._folder}{skipped}"
            return None
        self.resumed = f"resumed from iteration {content['iteration']} in {self._folder}{skipped}"
        for name, setting in self._settings.items():
            self._check(name, setting == content["settings"].get(name))
        history, start = [_record(row) for row in content["history"]], template.trial
        value, size = history[0].value, history[0].gradient_norm
        rounds_alike = content["ranks"] == ranks() and content["format"] == FORMAT

        def same(now, then, size):
            """Whether two numbers or vectors agree bit for bit; with other ranks or versions up to rounding."""
            if np.array_equal(now, then):
                return True
            return not rounds_alike and norm(now - then) <= NEAR * abs(size)

        same_norm = same(trials.as_given(norm(trials.downhill(start))), size, size)
        self._check("loss at the start", same_norm and same(trials.as_given(start.value), value, value))
        if content["format"] == FORMAT_0_2:
            state, best = upgraded(content["state"], content["best"], template, trials.residual_scale)
        else:
            state = flatten(template)[1](content["state"])
            best = Trial(*content["best"])
        trials.iteration = content["iteration"]
        again, last = trials(state.trial.vector), state.trial
        same_value = same(again.value, last.value, start.value)
        same_slope = same(again.slope, last.slope, norm(trials.downhill(start)))
        self._check("loss at the last point", same_value and same_slope)
        trials.best, trials.count = best, content["evaluations"]
        watch.resume(history, start, last)
        return state

    def _load(self):
        """The newest state that is whole, empty without one, and words on files that were skipped."""
        skipped = [f"; skipped {path.name}: an unfinished write" for path in self._folder.glob(f"*{UNFINISHED}")]
        for path in self._states():
            for version in (FORMAT, FORMAT_0_2):
                content = load_tree(path, version)
                if content:
                    return {**content[0], "format": version}, "".join(skipped)
            skipped.append(f"; skipped {path.name}: damaged, or not a state of sparsedp")
        return {}, "".join(skipped)

    def _states(self):
        return sorted(self._folder.glob("state-*.npz"), reverse=True)

    def _check(self, name, same):
        if not same:
            raise ValueError(
                f"{self._folder} holds a run with another {name} than the one given; give what it was begun with, or "
                "write another checkpoint folder"
            )

    def _pass(self, batches, number):
        so_far = self._settings["list of batches"] + fingerprint(batches.at(number))
        self._settings = {**self._settings, "list of batches": _digest(so_far.encode())}

    def save(self, state, trials, watch):
        """Write the state down, unless that was done a moment ago and the run goes on."""
        if self._folder is None:
            return
        self._pass(trials.batches, watch.iteration)
        self._latest = {
            "iteration": watch.iteration, "settings": self._settings, "ranks": ranks(),
            "evaluations": trials.count, "state": leaves(state), "best": list(trials.best),
        }  # fmt: skip
        if SHARE * (time.perf_counter() - self._written) >= self._cost or watch.message:
            self.write(watch.history)

    def write(self, history):
        """Write down the state of the last iteration that is complete, unless that was done."""
        if self._latest is None:
            return
        begun, number = time.perf_counter(), self._latest["iteration"]
        path = self._folder / f"state-{number:09d}.npz"
        save_tree(path, {**self._latest, "history": history[: number + 1]}, FORMAT)
        for older in [state for state in self._states() if state <= path][KEPT:]:  # newer ones are damaged
            older.unlink(missing_ok=True)
        self._latest, self._written = None, time.perf_counter()
        self._cost = self._written - begun


def _digest(content):
    return hashlib.sha256(content).hexdigest()


def fingerprint(tree):
    """Any value -> a hash of its kind and content: of its structure, of every leaf, of a function its name."""
    entries, rebuild = flatten(tree)
    return _digest("\n".join([repr(rebuild(range(len(entries)))), *map(_word, entries)]).encode())


def _word(leaf):
    leaf = whole(leaf)
    kind = type(leaf).__qualname__
    if isinstance(leaf, (np.ndarray, np.generic)) and leaf.dtype != object:
        return f"{kind} {leaf.dtype} {leaf.shape} {_digest(leaf.tobytes())}"
    if callable(leaf):
        return f"{getattr(leaf, '__module__', '')} {getattr(leaf, '__qualname__', kind)}"
    return kind if " at 0x" in repr(leaf) else f"{kind} {leaf!r}"  # an address is another one in the next process


def _record(row):
    record = Record(*row)
    return record._replace(failed=tuple(Failure(*words) for words in record.failed))
