"""The quadratic model that a quasi-Newton memory makes of a loss, and its minimum inside bounds."""

import numpy as np

__all__ = ["Quadratic"]

BLOCK = 1024  # breakpoints that are looked at together; the path seldom passes more
EPS = float(np.finfo(float).eps)


class Quadratic:
    """g.d + d.B d / 2 with the B of L-BFGS in compact form, B = bend - W^T M W.

    With the steps S and the changes Y of the gradient as rows, in units in which s.y = 1 for each pair,

        W = (Y; S),   M^(-1) = (-1, L^T / bend; L / bend, S S^T / bend),   L the part of S Y^T below the diagonal.

    Parameters
    ----------
    steps, changes : (k, n) arrays
        Oldest first, each pair with s.y > 0.
    bend : float
        B without a memory; with one it is y.y / s.y of the last pair.

    Notes
    -----
    Source: R. H. Byrd, J. Nocedal, R. B. Schnabel, Representations of quasi-Newton matrices, Math. Program. 63, 1994.
    """

    def __init__(self, steps, changes, bend):
        self._steps, self._changes = steps, changes
        self._grams = yy, sy, ss = _grams(steps, changes)
        unit = 1.0 / np.sqrt(np.diag(sy))
        self._unit = np.concatenate([unit, unit])
        self.bend = bend = float(yy[-1, -1] / sy[-1, -1]) if len(unit) else bend
        below = np.tril(sy, -1)
        inverse = np.block([[-bend * np.diag(np.diag(sy)), below.T], [below, ss]])
        self._inverse = np.outer(self._unit, self._unit / bend) * inverse
        self._m = np.linalg.inv(self._inverse)

    def _across(self, d):
        """(n,) -> W d."""
        return self._unit * np.concatenate([self._changes @ d, self._steps @ d])

    def minimum(self, g, lower, upper, free):
        """The step to the minimum of the model where lower <= step <= upper.

        Parameters
        ----------
        g : (n,) array
        lower, upper : (n,) arrays
            lower <= 0 <= upper.
        free : (n,) bool array or None
            Entries at which -g points into the box; None: there are no bounds.

        Returns
        -------
        (n,) array
            Inside, and downhill but for rounding.

        Notes
        -----
        First the Cauchy point: the first minimum along the path that -g takes when each entry stops at its bound.
        Then the minimum of the entries that have not stopped, moved onto the box; where that goes uphill it is
        shortened instead. Source: J. L. Morales, J. Nocedal, ACM Trans. Math. Softw. 38, 2011, for the last step.
        """
        if free is None:
            return self._newton(g, None)
        way = np.where(free, -g, 0.0)
        bound = np.where(way < 0, lower, upper)
        stops = np.full(way.shape, np.inf)
        with np.errstate(over="ignore"):
            np.divide(bound, way, out=stops, where=way != 0)
        t = self._first_minimum(way, stops)
        step = np.where(stops <= t, bound, np.where(way == 0, 0.0, t * way))
        inside = np.flatnonzero(free & (stops > t))
        if not len(inside):
            return step
        start, low, high = step[inside], lower[inside], upper[inside]
        newton = self._newton(g + self._product(step), inside)
        step[inside] = np.clip(start + newton, low, high)
        if np.dot(step, g) > 0:
            room = np.where(newton < 0, low, high) - start
            share = np.min(np.divide(room, newton, out=np.ones_like(room), where=newton != 0), initial=1.0)
            step[inside] = np.clip(start + share * newton, low, high)
        return step

    def _product(self, d):
        """(n,) -> B d."""
        later, sooner = np.split(self._unit * (self._m @ self._across(d)), 2)
        return self.bend * d - (later @ self._changes + sooner @ self._steps)

    def _first_minimum(self, way, stops):
        """The t of the first minimum along the path min(t, stops) way.

        Between two breakpoints the model has in t

            slope = -d.d + t bend d.d - (W d).M W z,   curvature = bend d.d - (W d).M W d

        with d the entries of `way` that still move and z where the path is; sums over the breakpoints in order give
        them for many intervals at once.
        """
        order = np.flatnonzero(np.isfinite(stops))
        order = order[np.argsort(stops[order], kind="stable")]
        edges = np.concatenate([[0.0], stops[order], [np.inf]])
        endless = float(np.sum(np.where(np.isinf(stops), way, 0.0) ** 2))
        squares = endless + np.append(np.cumsum((way[order] ** 2)[::-1])[::-1], 0.0)  # d.d after each breakpoint
        floor = EPS * self.bend * squares[0]  # a smaller curvature is rounding
        d, z = self._across(way)[:, None], np.zeros((len(self._unit), 1))
        for start in range(0, max(len(order), 1), BLOCK):
            block = order[start : start + BLOCK]
            here = slice(start, start + len(block) + 1)
            columns = np.concatenate([self._changes[:, block], self._steps[:, block]])
            gone, begins = self._unit[:, None] * columns * way[block], edges[here]
            d = np.cumsum(np.concatenate([d[:, -1:], -gone], axis=1), axis=1)
            z = np.cumsum(np.concatenate([z[:, -1:], gone * stops[block]], axis=1), axis=1)
            pressed = self._m @ d
            slope = squares[here] * (self.bend * begins - 1.0) - np.sum(pressed * (z + begins * d), axis=0)
            curvature = np.maximum(self.bend * squares[here] - np.sum(pressed * d, axis=0), floor)
            t = begins - np.divide(slope, curvature, out=np.zeros_like(slope), where=slope < 0)
            done = np.flatnonzero(t <= edges[1:][here])
            if len(done):
                return t[done[0]]
        return edges[-2]

    def _newton(self, g, inside):
        """-B^(-1) g over the entries inside, None for all, the others held; by the formula of Woodbury."""
        s, y, r = self._steps, self._changes, g
        yy, sy, ss = self._grams
        if inside is not None:
            s, y, r = s[:, inside], y[:, inside], g[inside]
            yy, sy, ss = _grams(s, y)
        gram = np.block([[yy, sy.T], [sy, ss]]) * np.outer(self._unit, self._unit / self.bend)
        shares = np.linalg.solve(self._inverse - gram, self._unit * np.concatenate([y @ r, s @ r]))
        later, sooner = np.split(self._unit * shares, 2)
        return -(r + (later @ y + sooner @ s) / self.bend) / self.bend


def _grams(s, y):
    return y @ y.T, s @ y.T, s @ s.T
