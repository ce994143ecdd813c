"""A run of minimize written down as it goes, and taken up again."""

import time
from typing import Any

import numpy as np

from sparsedp.optimize.checkpoint import Checkpoint, digest, fingerprint
from sparsedp.optimize.result import Record
from sparsedp.optimize.trials import Failure
from sparsedp.tree import flatten

__all__ = ["Journal"]

SHARE = 0.1  # a state is written when that takes at most this share of the time since the last one


class Journal:
    """Does nothing without a folder.

    Parameters
    ----------
    folder : path or None
    settings : dict
        What the run depends on, beside the loss and the batches: name -> any value.
    """

    def __init__(self, folder, settings):
        self._folder, self._settings = folder, dict(settings)
        self._checkpoint: Any = None
        self._latest: Any = None
        self._written, self._cost = -np.inf, 0.0
        self._batches = ""  # a hash of all batches so far
        self.told = ""

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
        settings = {name: fingerprint(value) for name, value in self._settings.items()}
        self._checkpoint = Checkpoint(self._folder, {**settings, "loss at the start": _bits(template.trial)})
        found = self._checkpoint.load()
        skipped = "".join(f"; skipped {words}" for words in found.skipped)
        for number in range(max(found.iteration, 0) + 1):
            self._pass(trials.batches, number)
        if found.iteration < 0:
            self.told = f"nothing to resume in {self._folder}{skipped}"
            return None
        self.told = f"resumed from iteration {found.iteration} in {self._folder}{skipped}"
        self._checkpoint.check("list of batches", found.words["batches"] == self._batches)
        (state, best), history = _restored(template, found.leaves)
        trials.batches.number = found.iteration
        again = trials(state.trial.vector)
        self._checkpoint.check("loss at the last point", not again.refused and _bits(again) == _bits(state.trial))
        trials.best, trials.count = best, found.words["evaluations"]
        watch.resume(_records(history, found.words["failed"]), found.words["stopped"])
        return state

    def _pass(self, batches, number):
        self._batches = digest((self._batches + batches.mark(number)).encode())

    def save(self, state, trials, watch):
        """Write the state down, unless that was done a moment ago and the run goes on."""
        if self._checkpoint is None:
            return
        self._pass(trials.batches, watch.iteration)
        words = {"evaluations": trials.count, "stopped": watch.stopped, "batches": self._batches}
        self._latest = (state, trials.best), len(watch.history), words
        if SHARE * (time.perf_counter() - self._written) >= self._cost or watch.stopped:
            self.write(watch.history)

    def write(self, history):
        """Write down the state of the last iteration that is complete, unless that was done."""
        if self._latest is None:
            return
        begun = time.perf_counter()
        pair, many, words = self._latest
        table = np.array([(*record[:5], record.solves) for record in history[:many]], dtype=float)
        failed = {str(record.iteration): record.failed for record in history[:many] if record.failed}
        self._checkpoint.save(many - 1, (pair, table), {**words, "failed": failed})
        self._latest, self._written = None, time.perf_counter()
        self._cost = self._written - begun


def _bits(trial):
    return digest(np.float64(trial.value).tobytes() + trial.slope.tobytes())


def _restored(template, found):
    """Leaves from the file -> ((state, best trial), history), numbers as the kinds that the template has."""
    originals, rebuild = flatten(((template, template.trial), np.empty((0, 6))))
    pairs = zip(originals, found, strict=True)
    return rebuild(leaf if isinstance(like, np.ndarray) else type(like)(leaf) for like, leaf in pairs)


def _records(table, failed):
    for row in table:
        iteration, value, size, seconds, evaluations, solves = row
        failures = tuple(Failure(*words) for words in failed.get(str(int(iteration)), ()))
        yield Record(int(iteration), float(value), float(size), float(seconds), int(evaluations), failures, int(solves))
