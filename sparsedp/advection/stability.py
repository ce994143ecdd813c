"""Before a step is taken: are the numbers finite, and is the step small enough?"""

import numpy as np

from sparsedp._utils.validation import EPS, check_finite, number_beside, rounded_down
from sparsedp.advection.control_volumes import place_words
from sparsedp.errors import UnstableStepError

__all__ = ["ROUNDING", "check_numbers", "check_weights"]

ROUNDING = 8 * EPS  # CFL exactly 1 leaves a weight of about -1e-16


def check_numbers(setting, u, v, inflow):
    """Refuse NaN and infinity: name the argument, the first index and the count."""
    name = f"transport {setting.scheme}"
    check_finite(name, np.reshape(u, setting.space.shape), "needs a finite field")
    check_finite(name, v, "needs a finite velocity", setting.velocity_place)
    check_finite(name, inflow, "needs finite inflow values")


def check_weights(setting, dt, rate, share):
    """Refuse a step in which share - dt * rate, the weight that a point keeps, is negative somewhere."""
    bad = ~(share - dt * rate >= -ROUNDING)
    if setting.unstable == "raise" and np.any(bad):
        worst = int(np.argmax(rate))
        largest = rounded_down(share / np.max(rate))
        given = number_beside(dt, float(largest), digits=12)
        raise UnstableStepError(
            f"transport {setting.scheme}: dt = {given} is too large at {np.count_nonzero(bad)} of {rate.size} "
            f"points, most at {place_words(setting, worst)}; the largest stable dt is {largest}, "
            "or write unstable='allow'"
        )
