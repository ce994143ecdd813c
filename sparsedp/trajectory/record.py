"""What a rollout reports after each pass: how many steps were run, and how the cotangent grew.

In a chaotic run the cotangent grows by a factor exp(rate) in each step. The gradient is the exact derivative of the
computed steps, but a rounding error in the first state changes it by a relative amount of about amplification * 1e-16.
The cotangent is never clipped. If the amplification exceeds `LIMIT`, the gradient describes the rounding errors more
than the physics, and a GrowthWarning is issued.
"""

from __future__ import annotations

import warnings
from math import inf, log, nan
from typing import Any, NamedTuple

import numpy as np

from sparsedp._utils.counters import thread
from sparsedp.autodiff.tape import plain
from sparsedp.errors import GrowthWarning

__all__ = ["Record", "backward_record", "largest"]

LIMIT = 1e8  # amplification of rounding errors at which half of the digits of double precision are lost


class Record(NamedTuple):
    """One pass over all steps, as `rollout` passes it to `record`.

    Attributes
    ----------
    direction : str
        "forward" or "backward".
    steps : int
    kept : int
        Number of states kept for the backward pass.
    recomputed : int
        Number of steps that the backward pass ran again to recompute states.
    norms : tuple of (int, float)
        Index of a state and the largest magnitude of an entry of its cotangent, from the last state to the first.
    growth : float
        Growth rate per step of the backward pass: the norm behaves like exp(growth * steps). NaN if not measured.
    amplification : float
        Ratio of the largest norm to the first norm that is not zero.
    on_disk : int
        Number of states that were written to files.
    resumed_at : int or None
        Index of the state from which an interrupted run was continued, in the forward pass; None without such a run.
    """

    direction: str
    steps: int
    kept: int
    recomputed: int
    norms: tuple = ()
    growth: float = nan
    amplification: float = nan
    on_disk: int = 0
    resumed_at: int | None = None

    @property
    def factor(self) -> float:
        """Return the average number of runs per step: 1 for the forward pass, plus those that recompute states."""
        return 1 + self.recomputed / max(self.steps, 1)

    @property
    def flagged(self) -> bool:
        """Return whether the cotangent grew by more than `LIMIT`, so that the gradient is of little use."""
        return self.amplification > LIMIT


def backward_record(n: int, kept: int, recomputed: int, norms: list[tuple[int, float]], last_cut: int) -> Record:
    """Return the record of a backward pass, and warn if the cotangent grew too much.

    Parameters
    ----------
    n, kept, recomputed : int
        See the attributes of `Record`.
    norms : list of (int, float)
        Index of a state and the largest magnitude of an entry of its cotangent.
    last_cut : int
        Largest index of a state at which truncation sets the cotangent to zero, or -1.
    """
    reference = nan
    amplification = nan
    logarithms = []
    for i, norm in norms:
        if norm > 0 and not reference > 0:
            reference = norm
        if 0 < norm < inf and i > last_cut:  # before a cut the cotangent has been set to zero and starts again
            logarithms.append((i, log(norm)))
    if norms:
        amplification = max(norm for _, norm in norms) / reference
    rate = nan
    if logarithms:
        (latest, first), (earliest, last) = logarithms[0], logarithms[-1]
        if latest > earliest:
            rate = (last - first) / (latest - earliest)
    record = Record("backward", n, kept, recomputed, tuple(norms), rate, amplification)
    if amplification > LIMIT:
        thread.grown += 1
        warnings.warn(
            GrowthWarning(
                f"the cotangent grew by {amplification:.0e} over {n} steps of rollout, {rate:.2g} a step in the "
                "logarithm; the gradient is exact and of little use, take fewer steps or truncate"
            ),
            stacklevel=2,
        )
    return record


def largest(arrays: Any) -> float:
    """Return the largest magnitude of an entry of some arrays, plain or traced; ignore None, propagate NaN."""
    total = 0.0
    for array in arrays:
        if array is None or not np.size(plain(array)):
            continue
        values = plain(array)
        if np.iscomplexobj(values):
            size = float(np.max(np.abs(values)))
        else:  # without a temporary array
            size = max(float(np.maximum.reduce(values, axis=None)), -float(np.minimum.reduce(values, axis=None)))
        if size > total or np.isnan(size):
            total = size
    return total
