"""A scene under stress: a loss, its named parameters, their legal ranges, and which are time step and viscosity."""

import numpy as np

from sparsedp.check.point import Point
from sparsedp.report.growth import growth_of
from sparsedp.report.trial import run
from sparsedp.tree import copied, flatten

__all__ = ["Scene"]

KNOWN = {"time step": ("dt", "time_step", "tau"), "viscosity": ("nu", "viscosity", "diffusivity", "kappa", "mu")}


class Scene:
    """What `stress` works on. Every run gets fresh copies of the parameters.

    Attributes
    ----------
    leaves : dict
        Name -> array or float: the floating leaves of x.
    ranges : dict
        Name -> (low, high).
    named : dict
        "time step", "viscosity" -> name of the parameter, or None.
    base : Outcome
        Value and gradient as given.
    growth : Growth or None
    """

    def __init__(self, loss, x, ranges, step, time_step, viscosity):
        self.loss, self.step = loss, step
        point = Point(x)
        self._found, self._rebuild = flatten(x)
        self._places = dict(zip(_short(point.names), point.places, strict=True))
        self.leaves = {name: self._found[place] for name, place in self._places.items()}
        self.ranges = self._checked(ranges)
        self.named = {
            "time step": self._named("time step", time_step),
            "viscosity": self._named("viscosity", viscosity),
        }
        self.base = run(loss, self.at())
        self.growth = growth_of(loss, self.at(), step)

    def at(self, other=None):
        """The tree x with other values of some parameters."""
        leaves = copied(self._found)
        for name, value in (other or {}).items():
            plain = isinstance(self.leaves[name], float) and np.ndim(value) == 0
            leaves[self._places[name]] = float(value) if plain and np.asarray(value).dtype.kind == "f" else value
        return self._rebuild(leaves)

    def legal(self, name, value):
        """Whether a value lies in the legal range of a parameter; without a range everything does."""
        low, high = self.ranges.get(name, (-np.inf, np.inf))
        return bool(np.all(value >= low) and np.all(value <= high))

    def sensitive(self, name):
        """Index of the entry with the largest derivative; None where the loss does not depend on the parameter."""
        if not self.base.gradient:
            return None
        g = np.abs(self.base.gradient[list(self.leaves).index(name)])
        return np.unravel_index(int(np.argmax(g)), g.shape) if g.size and np.max(g) > 0 else None

    def _checked(self, ranges):
        if isinstance(ranges, (tuple, list)) and len(self.leaves) == 1:
            ranges = dict.fromkeys(self.leaves, ranges)
        for name, limits in (ranges or {}).items():
            self._known(name)
            low, high = limits if np.size(limits) == 2 else (np.nan, np.nan)
            if not (np.isfinite(low) and np.isfinite(high) and low < high):
                raise ValueError(f"stress needs ranges of two finite numbers, low < high, got {limits!r} for {name}")
        return {name: (float(low), float(high)) for name, (low, high) in (ranges or {}).items()}

    def _named(self, kind, name):
        if name is None:
            return next((word for word in KNOWN[kind] if word in self.leaves), None)
        self._known(name)
        return name

    def _known(self, name):
        if name not in self.leaves:
            raise ValueError(f"stress knows the parameters {', '.join(self.leaves)}, got {name!r}; write one of them")


def _short(names):
    """x['dt'] -> dt; deeper and other places keep their path."""
    parts = [name.removeprefix("x") or "x" for name in names]
    keys = [part[2:-2] if part.startswith("['") and part.count("[") == 1 else part for part in parts]
    return [key.strip("[]") if key.startswith("[") and key.count("[") == 1 else key for key in keys]
