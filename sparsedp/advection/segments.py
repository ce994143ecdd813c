"""The segments of one component of the moved field, and where each stream of the formulas starts in them."""

from math import prod

import numpy as np

from sparsedp.kernels.formulas import POINTS
from sparsedp.kernels.streams import PLACE, TILE

__all__ = ["ARRAYS", "Component"]

# The arrays of a kernel call, in this order; zeros is read and nothing is written to it but zeros.
ARRAYS = (
    "u",
    "inflow",
    "w",
    "out",
    "g",
    "ginflow",
    "gw",
    "factors",
    "zeros",
    "dump",
    "u0",
    "slope",
    "a",
    "b",
    "ratios",
    "spill",
)
BESIDE = ("sm", "s", "sp", "al", "bu", "ap", "bm")  # streams of slopes
NUMBER = {name: number << PLACE for number, name in enumerate(ARRAYS)}


class Component:
    """One lattice: its segments and the starts of all streams."""

    def __init__(self, lattice, mode, limited, offsets, lines):
        self.lattice, self.mode, self.limited = lattice, mode, limited
        self.shape = lattice.shape
        self.own = offsets["u"]
        offsets["u"] += prod(self.shape)
        self.axes = [Places(self, number, axis, offsets, next(lines)) for number, axis in enumerate(lattice.axes)]
        self.starts, self.counts = self._cut()
        self.at = np.unravel_index(self.starts, self.shape) if self.starts.size else (self.starts,) * len(self.shape)
        for axis in self.axes:
            axis.look()

    def _cut(self):
        """First point and count of each segment."""
        size, n = prod(self.shape), self.shape[-1]
        breaks = np.zeros(self.shape, bool)
        if size:
            breaks[..., [0, min(1, n - 1), n - 1]] = True
            breaks[..., 1::TILE] = True
        if self.lattice.solid is not None:
            for axis in self.axes:
                for closed in axis.closed():
                    breaks[..., 1:] |= closed[..., 1:] != closed[..., :-1]
        starts = np.flatnonzero(breaks)
        return starts, np.diff(np.append(starts, size))

    def points(self):
        """Counts and streams of the points."""
        own = self.own + self.starts
        found = {name: NUMBER[name] + own for name in ("u", "u0", "out", "g")}
        found["gu"] = found["out"]
        for axis in self.axes:
            found.update({f"{name}{axis.number}": starts for name, starts in axis.streams().items()})
        return self.counts, found

    def ghosts(self):
        """The same for what is outside each wall: a point without cotangent, whose own goes to the inflow."""
        found = []
        for axis in self.axes:
            for side in range(0 if axis.periodic else 2):
                found.append(self._ghost(axis, side))
        return found

    def _ghost(self, axis, side):
        here = axis.index == (axis.n - 1 if side else 0)
        cells = axis.streams()
        outside = cells["up" if side else "um"][here]
        zeros = np.full(outside.size, NUMBER["zeros"])
        own = NUMBER["ginflow"] - NUMBER["inflow"]
        found = {"u": outside, "u0": outside, "g": zeros, "gu": axis.wall[side][here] + own, "out": zeros}
        for other in self.axes:
            some = {name: starts[here] for name, starts in other.streams().items()}
            some |= dict.fromkeys(("gm", "gp", "wl", "wu", "c", "cl", "cu", "cm", "cp", "da", "db", *BESIDE), zeros)
            some |= {"um": outside, "up": outside, "gw": zeros - NUMBER["zeros"] + NUMBER["dump"]}
            some |= dict.fromkeys("ab", zeros - NUMBER["zeros"] + NUMBER["spill"])
            if other is axis:
                some |= self._beside(axis, side, here)
            found.update({f"{name}{other.number}": starts for name, starts in some.items()})
        return self.counts[here], found

    def _beside(self, axis, side, here):
        """What a ghost shares with the point inside the wall."""
        cells = {name: starts[here] for name, starts in axis.streams().items()}
        own = NUMBER["g"] + (self.own + self.starts)[here]
        g = np.where(axis.shut[side][here], NUMBER["zeros"], own)
        if side:
            u = NUMBER["u"] + (self.own + self.starts)[here]
            found = {"um": u, "gm": g, "wl": cells["wu"], "rm": cells["r"], "cm": cells["cu"], "rl": cells["ru"]}
            found |= {"sm": cells["s"], "bm": cells["bu"]}
            return found | ({} if self.mode == POINTS else {"gw": axis.upper[here] + NUMBER["gw"]})
        found = {"gp": g, "wu": cells["wl"], "rp": cells["r"], "cp": cells["cl"], "ru": cells["rl"]}
        return found | {"sp": cells["s"], "ap": cells["al"]}


class Places:
    """One axis of a component."""

    def __init__(self, component, number, axis, offsets, line):
        self.component, self.number, self.axis = component, number, axis
        self.n, self.periodic = axis.points, axis.periodic
        shape = component.shape
        self.faces = tuple(axis.interfaces if a == number else n for a, n in enumerate(shape))
        self.first = offsets["w"]
        offsets["w"] += prod(shape) if component.mode == POINTS else prod(self.faces)
        self.slope, self.ratio = offsets["slope"], offsets["ratios"]
        offsets["slope"] += prod(shape)
        offsets["ratios"] += 2 * self.n
        self.walls = []
        for _ in range(0 if self.periodic else 2):
            self.walls.append(offsets["inflow"])
            offsets["inflow"] += prod(shape[:number] + shape[number + 1 :])
        self.line, self.same = offsets["factors"], line[1]
        offsets["factors"] += line[0]

    def closed(self):
        """Boolean arrays on the points: the interface below is closed, the one above is."""
        solid = self.component.lattice.solid
        if solid is None:
            return (np.zeros(self.component.shape, bool),) * 2
        low, high = np.roll(solid, 1, self.number), np.roll(solid, -1, self.number)
        if not self.periodic and self.n:
            np.moveaxis(low, self.number, 0)[0] = False
            np.moveaxis(high, self.number, 0)[-1] = False
        return solid | low, solid | high

    def look(self):
        """Neighbours of the first point of each segment."""
        component = self.component
        self.index = component.at[self.number]
        stride = prod(component.shape[self.number + 1 :])
        wall_shape = component.shape[: self.number] + component.shape[self.number + 1 :]
        across = [at for a, at in enumerate(component.at) if a != self.number]
        place = np.zeros(self.index.size, int)
        for at, n in zip(across, wall_shape, strict=True):
            place = place * n + at
        self.wall = [NUMBER["inflow"] + first + place for first in self.walls]
        self.end = [self.index == 0, self.index == self.n - 1]
        if component.lattice.solid is None:
            self.shut = [np.zeros(self.index.size, bool)] * 2
        else:
            self.shut = [side.ravel()[component.starts] for side in self.closed()]
        around = (self.n - 1) * stride
        self.beside = [
            component.starts + np.where(self.end[0], around, -stride),
            component.starts + np.where(self.end[1], -around, stride),
        ]
        self.lower = self.first + self._interface(self.index)
        self.upper = self.first + self._interface((self.index + 1) % max(self.axis.interfaces, 1))

    def _interface(self, index):
        place = np.zeros(index.size, int)
        for a, n in enumerate(self.faces):
            place = place * n + (index if a == self.number else self.component.at[a])
        return place

    def _value(self, side):
        """The field beside."""
        component = self.component
        own, found = component.own + component.starts, component.own + self.beside[side]
        found = NUMBER["u"] + np.where(self.shut[side], own, found)
        if self.periodic:
            return found
        outside = NUMBER["u"] + own if self.axis.closed[side] else self.wall[side]
        return np.where(self.end[side] & ~self.shut[side], outside, np.where(self.end[side], NUMBER["u"] + own, found))

    def _cotangent(self, side):
        component = self.component
        own, found = component.own + component.starts, component.own + self.beside[side]
        found = NUMBER["g"] + np.where(self.shut[side], own, found)
        return found if self.periodic else np.where(self.end[side], self._nothing(side, own), found)

    def _nothing(self, side, own):
        """Beyond a wall there is no cotangent; at a closed one the difference must be exactly 0."""
        return np.where(self.shut[side], NUMBER["g"] + own, NUMBER["zeros"])

    def _factor(self, index):
        return NUMBER["factors"] + self.line + (0 * index if self.same else index)

    def streams(self):
        """Starts of all streams of the points."""
        found = {"um": self._value(0), "up": self._value(1), "gm": self._cotangent(0), "gp": self._cotangent(1)}
        points = self.component.mode == POINTS
        found |= (self._on_points() if points else self._on_interfaces()) | self._slopes()
        if points and not self.component.limited:
            return found | dict.fromkeys(("r", "rm", "rp"), found["um"])
        before, after = np.where(self.end[0], self.n - 1, self.index - 1), np.where(self.end[1], 0, self.index + 1)
        before, after = np.where(self.shut[0], self.index, before), np.where(self.shut[1], self.index, after)
        return found | {"r": self._factor(self.index), "rm": self._factor(before), "rp": self._factor(after)}

    def _on_points(self):
        none, own = NUMBER["zeros"], NUMBER["w"] + self.first + self.component.starts
        low, high = (np.where(self._gone(side), none, NUMBER["w"] + self.first + self.beside[side]) for side in (0, 1))
        found = {"c": own, "cl": np.where(self.shut[0], none, own), "cu": np.where(self.shut[1], none, own)}
        found |= {"cm": low, "cp": high, "gw": own - NUMBER["w"] + NUMBER["gw"], "rl": self._factor(self.index)}
        found |= {"ru": self._factor((self.index + 1) % max(self.axis.interfaces, 1))}
        return found | dict.fromkeys(("wl", "wu"), own)

    def _on_interfaces(self):
        none = NUMBER["zeros"]
        found = {"wl": np.where(self.shut[0], none, NUMBER["w"] + self.lower), "gw": NUMBER["gw"] + self.lower}
        found |= {"wu": np.where(self.shut[1], none, NUMBER["w"] + self.upper)}
        return found | dict.fromkeys(("rl", "ru", "c", "cl", "cu", "cm", "cp"), self.component.starts)

    def _gone(self, side):
        """Where there is no point beside."""
        return self.shut[side] | self.end[side] & (not self.periodic)

    def _slopes(self):
        """What a point has for its slope, and what its neighbours have."""
        none, own = NUMBER["zeros"], self.slope + self.component.starts
        below, above = (self.slope + beside for beside in self.beside)
        found = {"s": NUMBER["slope"] + own, "a": NUMBER["a"] + own, "b": NUMBER["b"] + own}
        found |= {"da": found["a"], "db": found["b"]}
        found |= {"sm": np.where(self._gone(0), none, NUMBER["slope"] + below)}
        found |= {"sp": np.where(self._gone(1), none, NUMBER["slope"] + above)}
        found |= {"al": np.where(self.shut[0], none, found["a"]), "bu": np.where(self.shut[1], none, found["b"])}
        found |= {"bm": np.where(self._gone(0), none, NUMBER["b"] + below)}
        found |= {"ap": np.where(self._gone(1), none, NUMBER["a"] + above)}
        ratio = NUMBER["ratios"] + self.ratio + self.index
        return found | {"ratio": ratio, "ahead": ratio + self.n}
