"""What is left of a rollout afterwards: how often steps were run, and how the cotangent grew on its way back.

A cotangent that grows by exp(rate) a step is that of a chaotic run: the gradient is exact for these very steps, but
a change of the start by rounding changes it by about amplification * 1e-16. Nothing is clipped. Beyond LIMIT the
gradient says little about the physics, and a GrowthWarning says so.
"""

import warnings
from math import inf, log, nan
from typing import NamedTuple

import numpy as np

from sparsedp._utils.counters import thread
from sparsedp.autodiff.tape import plain
from sparsedp.errors import GrowthWarning

__all__ = ["APART", "Record", "SAMPLES", "growth", "largest"]

LIMIT = 1e8  # half of the digits are gone
SAMPLES = 32  # measurements of the cotangent in a long run
APART = 16  # least number of steps between two of them: they cost a pass over the cotangent


class Record(NamedTuple):
    """One run over all steps, as `rollout` hands it to `record`.

    Attributes
    ----------
    direction : str
        "forward" or "backward".
    steps : int
    kept : int
        States kept for the way back.
    recomputed : int
        Steps run again on the way back.
    norms : tuple of (int, float)
        Index of a state and the largest entry of its cotangent, from the last state to the first.
    growth : float
        Rate a step: the norm behaves like exp(growth * number of steps back); NaN when it was not measured.
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
    def factor(self):
        """Plain steps over steps, the first run included: 1 when nothing was run again."""
        return 1 + self.recomputed / max(self.steps, 1)

    @property
    def flagged(self):
        """Whether the cotangent grew beyond what makes a gradient useful."""
        return self.amplification > LIMIT


def growth(loop, norms, recomputed):
    """Loop, (number of a state, largest entry of its cotangent), steps run again -> the Record of the way back.

    It warns when the cotangent grew too much.
    """
    first = next((norm for _, norm in norms if norm > 0), nan)
    grown = max((norm / first for _, norm in norms), default=nan)
    cut = max(loop.cuts, default=-1)  # beyond it the cotangent begins anew
    whole = [(i, log(norm)) for i, norm in norms if 0 < norm < inf and i > cut]
    steps = whole[0][0] - whole[-1][0] if whole else 0
    rate = (whole[-1][1] - whole[0][1]) / steps if steps else nan
    result = Record("backward", loop.n, loop.kept, recomputed, tuple(norms), rate, grown)
    if result.flagged:
        thread.grown += 1
        warnings.warn(
            GrowthWarning(
                f"the cotangent grew by {grown:.0e} over {loop.n} steps of rollout, {rate:.2g} a step in the "
                "logarithm; the gradient is exact and of little use, take fewer steps or truncate"
            ),
            stacklevel=2,
        )
    return result


def largest(cotangents):
    """Largest entry of some cotangents, plain or traced, of which None counts for nothing."""
    return max((_largest(plain(g)) for g in cotangents if g is not None), default=0.0)


def _largest(g):
    """Largest entry, without a temporary array; NaN and infinity come through."""
    if not np.size(g):
        return 0.0
    if np.iscomplexobj(g):
        return float(np.max(np.abs(g)))
    low, high = float(np.minimum.reduce(g, axis=None)), float(np.maximum.reduce(g, axis=None))
    return max(high, -low) if low == low else low
