"""A run of minimise written down as it goes, and taken up again."""

import time

import numpy as np

from sparsedp.optimise.checkpoint import Checkpoint, digest
from sparsedp.optimise.result import Record
from sparsedp.optimise.trials import Failure
from sparsedp.tree import flatten

__all__ = ["Journal"]

SHARE = 0.1  # a state is written when that takes at most this share of the time since the last one


class Journal:
    """Does nothing without a folder.

    Parameters
    ----------
    folder : path or None
    settings : dict of str
        What the run depends on, beside the start and the loss there.
    """

    def __init__(self, folder, settings):
        self._folder, self._settings = folder, dict(settings)
        self._checkpoint = None
        self._last, self._cost = -np.inf, 0.0
        self.told = ""

    def resume(self, template, trials, watch):
        """The last state of the folder, put into trials and watch too; None when there is none.

        `template` is the state at the start: what a state looks like, and proof that the loss is the same.
        """
        if self._folder is None:
            return None
        first = template.trial
        content = first.vector.tobytes() + np.float64(first.value).tobytes() + first.slope.tobytes()
        self._checkpoint = Checkpoint(self._folder, {**self._settings, "start, or loss at the start": digest(content)})
        found = self._checkpoint.load()
        skipped = "".join(f"; skipped {words}" for words in found.skipped)
        if found.iteration < 0:
            self.told = f"nothing to resume in {self._folder}{skipped}"
            return None
        self.told = f"resumed from iteration {found.iteration} in {self._folder}{skipped}"
        (state, best), history = _restored(template, found.leaves)
        trials.best, trials.count = best, found.words["evaluations"]
        trials.batches.number = found.iteration
        watch.resume(_records(history, found.words["failed"]), found.words["stopped"])
        return state

    def save(self, state, trials, watch):
        """Write the state down, unless that was done a moment ago and the run goes on."""
        now = time.perf_counter()
        if self._checkpoint is None or (SHARE * (now - self._last) < self._cost and not watch.stopped):
            return
        table = np.array([(*record[:5], record.solves) for record in watch.history], dtype=float)
        failed = {str(record.iteration): record.failed for record in watch.history if record.failed}
        words = {"evaluations": trials.count, "stopped": watch.stopped, "failed": failed}
        self._checkpoint.save(watch.iteration, ((state, trials.best), table), words)
        self._last = time.perf_counter()
        self._cost = self._last - now


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
