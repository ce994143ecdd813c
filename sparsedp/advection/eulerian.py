"""What donor cell and van Leer share: the bilinear form, its fused loops, and the checks after a pass."""

from functools import cached_property
from math import isfinite

from sparsedp.advection.bilinear import Bilinear
from sparsedp.advection.law import STEP, VELOCITY, Finite, Law
from sparsedp.advection.loops import Loops
from sparsedp.advection.stability import check_numbers, check_result, check_weights
from sparsedp.fields import surely_finite

__all__ = ["Eulerian"]


class Eulerian(Law):
    """Base of the schemes whose formulas run point by point over the matrices of `lattice`."""

    limited = False

    def __init__(self, setting):
        super().__init__(setting)
        self.bilinear = Bilinear(setting, self.walls)

    @property
    def matrices(self):
        return self.bilinear.matrices

    @cached_property
    def _loops(self):
        return Loops(self.matrices, limited=self.limited)

    def _needed(self, v):
        """The velocity where the scheme needs it."""
        between = self.bilinear.between
        return v if between is None else between[0] @ v

    def _check(self, wrong, u, v, dt, inflow, out, share=1.0):
        """Name what a pass has found wrong, and what it has not met."""
        if wrong or not isfinite(self._unseen(v, inflow)):
            check_numbers(self.setting, u, v, inflow)
            check_weights(self, dt, self.bilinear.rate(v), share)
            check_result(self.setting, out)

    def _unseen(self, v, inflow):
        """Sum over what a pass may leave out: inflow values at closed walls, velocities inside solids."""
        unseen = inflow.sum() if inflow.size else 0.0
        return unseen if self.setting.solid is None else unseen + v.sum()

    def _cotangents(self, nums, found, good):
        """Those of the arguments `nums`; good: what the loops have written is finite."""
        if good and VELOCITY in nums and self.bilinear.between is not None:
            good = surely_finite(found[VELOCITY])
        backs = tuple(found[num] for num in nums)
        return Finite(backs) if good and isfinite(found[STEP]) else backs

    def _of_velocity(self, gw, kept, added):
        """Cotangent of the velocity as given, from that where it is needed; added to `kept` where there is one."""
        between = self.bilinear.between
        found = gw if between is None else between[1] @ gw
        if kept is None or added:
            return found
        kept += found
        return kept
