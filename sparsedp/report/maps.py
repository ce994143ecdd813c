"""The stability map of a scene: the growth factor of its step, time step against viscosity."""

import numpy as np

from sparsedp.check.findings import table
from sparsedp.report.growth import growth_of

__all__ = ["StabilityMap", "stability_map"]

POINTS, DECADES = 9, 2.0  # along each axis; on either side of the values given


class StabilityMap:
    """Growth factors over time step (down) and viscosity (across).

    Attributes
    ----------
    time_steps, viscosities : 1-D arrays
    factors : 2-D array
        Growth factor of a step; NaN where the step is refused.
    here : (float, float)
        Time step and viscosity of the scene.
    """

    def __init__(self, names, time_steps, viscosities, factors, here):
        self.names, self.here = names, here
        self.time_steps, self.viscosities, self.factors = time_steps, viscosities, factors

    def to_dict(self):
        """The map as plain lists; None where the step is refused."""
        factors = [[None if np.isnan(f) else float(f) for f in row] for row in self.factors]
        return {"time_steps": self.time_steps.tolist(), "viscosities": self.viscosities.tolist(), "factors": factors}

    def __str__(self):
        rows = [(f"{dt:.1e}", *map(_cell, row)) for dt, row in zip(self.time_steps, self.factors, strict=True)]
        head = (f"{self.names[0]} \\ {self.names[1]}", *(f"{nu:.1e}" for nu in self.viscosities))
        return table(rows, head)

    __repr__ = __str__


def _cell(factor):
    return "refused" if np.isnan(factor) else f"{factor:.3g}"


def stability_map(scene):
    """Scene -> StabilityMap, or None where it has no loop, or no named time step and viscosity of one number each."""
    names = scene.named["time step"], scene.named["viscosity"]
    if (
        scene.growth is None
        or scene.growth.refusal
        or None in names
        or any(np.size(scene.leaves[name]) != 1 for name in names)
    ):
        return None
    here = tuple(float(np.reshape(scene.leaves[name], ())) for name in names)
    if not all(value > 0 for value in here):
        return None
    dts, nus = (_values(value, scene.ranges.get(name)) for name, value in zip(names, here, strict=True))
    factors = np.array([[_factor(scene, names, dt, nu) for nu in nus] for dt in dts])
    return StabilityMap(names, dts, nus, factors, here)


def _values(value, limits):
    if limits is not None and limits[0] > 0:
        return np.geomspace(limits[0], limits[1], POINTS)
    return value * 10.0 ** np.linspace(-DECADES, DECADES, POINTS)


def _factor(scene, names, dt, nu):
    other = {name: value * np.ones_like(scene.leaves[name]) for name, value in zip(names, (dt, nu), strict=True)}
    found = growth_of(scene.loss, scene.at(other), scene.step)
    return np.nan if found is None or found.refusal else found.factor
