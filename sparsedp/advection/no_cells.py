"""Transport on a grid without cells: nothing moves."""

import numpy as np
import scipy.sparse as sp

from sparsedp.advection.law import FIELD, INFLOW, VELOCITY, Law
from sparsedp.advection.stability import check_numbers

__all__ = ["NoCells"]


class NoCells(Law):
    """The identity, whatever the scheme."""

    linear = True
    twice = True

    def forward(self, u, v, dt, inflow):
        check_numbers(self.setting, u, v, inflow)
        return u + 0.0

    def vjp(self, nums, g, u, v, dt, inflow):
        found = {FIELD: g + 0.0, VELOCITY: np.zeros(np.shape(v)), INFLOW: np.zeros(np.shape(inflow))}
        return tuple(found[num] for num in nums), True

    def jvp(self, tangents, u, v, dt, inflow):
        return tangents.get(FIELD, np.zeros(np.shape(u))) + 0.0

    def matrix(self, v, dt):
        return sp.eye_array(self.setting.space.size, format="csr")
