"""The unknowns of a search as one flat vector of doubles, and back."""

import autograd.numpy as anp
import numpy as np

from sparsedp.fields import check_finite
from sparsedp.packing import Packing, joined

__all__ = ["Unknowns", "power_of_two"]

FINITE = "must be finite (dp.check.gradient(loss, x) shows where it comes from)"


class Unknowns(Packing):
    """How the unknowns of a search lie in one vector."""

    def pack_gradient(self, tree):
        """Finite gradient of the same structure -> flat gradient with respect to the packed vector."""
        slopes = self.slopes(tree)
        for name, g in zip(self.names, slopes):
            check_finite(f"the gradient of {name}", g, FINITE)
        return joined(slopes)

    def join(self, tree):
        """The floating leaves of a tree that may be traced, as one traced vector."""
        return anp.concatenate([anp.reshape(leaf, (-1,)) for leaf in self.floating(tree)])


def power_of_two(value):
    """The power of two next above, so that dividing by it changes no digits."""
    return 2.0 ** float(np.clip(np.frexp(value)[1], -900, 900)) if value > 0 else 1.0
