"""What a rollout reports after each pass: how many steps were run, and how the cotangent grew.

A cotangent that grows by exp(rate) a step belongs to a chaotic run: the gradient is exact for these very steps, but
a change of the start by rounding changes it by about amplification * 1e-16. Nothing is clipped. Beyond `LIMIT` the
gradient says little about the physics, and a GrowthWarning says so.
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

LIMIT = 1e8  # amplification that costs half of the digits


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
        Steps run again in the backward pass.
    norms : tuple of (int, float)
        Index of a state and the largest entry of its cotangent, from the last state to the first.
    growth : float
        Rate per step: the norm behaves like exp(growth * number of steps back); NaN when it was not measured.
    amplification : float
        Largest norm over the first one.
    """

    direction: str
    steps: int
    kept: int
    recomputed: int
    norms: tuple = ()
    growth: float = nan
    amplification: float = nan

    @property
    def factor(self) -> float:
        """Return the runs of steps over the number of steps, the first run included; 1 if none was run again."""
        return 1 + self.recomputed / max(self.steps, 1)

    @property
    def flagged(self) -> bool:
        """Return whether the cotangent grew beyond the limit at which a gradient is useful."""
        return self.amplification > LIMIT


def backward_record(n: int, kept: int, recomputed: int, norms: list[tuple[int, float]], last_cut: int) -> Record:
    """Return the record of a backward pass, and warn if the cotangent grew too much.

    Parameters
    ----------
    n, kept, recomputed : int
        As the attributes of `Record`.
    norms : list of (int, float)
        Index of a state and the largest entry of its cotangent.
    last_cut : int
        The last state at which truncation sets the cotangent to zero, or -1.
    """
    reference = nan
    amplification = nan
    logarithms = []
    for i, norm in norms:
        if norm > 0 and not reference > 0:
            reference = norm
        if 0 < norm < inf and i > last_cut:  # at a cut the cotangent begins anew
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
    """Return the largest entry of some arrays, plain or traced; None counts as empty, NaN and infinity as they are."""
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
