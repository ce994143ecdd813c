"""Steps of u' = c L u with their own pullback, for loops without a tape.

A step is u_1 = R(z L) u with z = c h, so g_u = R(z L^T) g and c_bar = h g . L R'(z L) u. In turn,

    explicit, p stages   R = 1 + z + ... + z^p/p!    R' = the same with one term less
    backward_euler       u_1 = S u                   g_u = y = S^T g                c_bar = h y . L u_1
    crank_nicolson       u_1 = 2 w - u, w = S u      g_u = 2 y - g, y = S^T g       c_bar = h y . L w
    tr_bdf2, imex        u_1 = S v, v = u + k (x - u): the chain of its two solves
    etdrk4               u_1 = exp(z L) u            g_u = exp(z L^T) g             c_bar = h g_u . L u
"""

import numpy as np

from sparsedp.derivative import pushforward
from sparsedp.integrators.explicit import EXPLICIT
from sparsedp.integrators.implicit_steps import C, D
from sparsedp.integrators.split_steps import WHOLE
from sparsedp.integrators.steps import Step
from sparsedp.tape import is_variable

__all__ = ["LinearStep"]


class LinearStep(Step):
    """A Step of an Operator alone: plain forward and backward, without a tape."""

    sparing = True

    def forward(self, state, params):
        """The state after a step, of plain values."""
        if self.method not in EXPLICIT or not isinstance(state, np.ndarray) or state.dtype != np.float64:
            return self(state, params)
        c = self.problem.coefficient(params)
        if self.limit is not None:
            self.limit.check(self.dt, c)
        new = self._explicit(state, c, np.empty(state.shape))
        return self.checked(new, state, params, self.dt)

    def _explicit(self, u, c, out):
        """The same numbers as the call gives, bit for bit, in arrays that are used again."""
        table, L = self.scheme.table, self.problem.op
        *rates, share, stage = self._arrays(u.shape, len(table.weights) + 2)
        np.multiply(L.apply(u, out=rates[0]), c, out=rates[0])
        for row, rate in zip(table.stages, rates[1:], strict=True):
            np.multiply(L.apply(_ahead(u, self.dt, row, rates, share, stage), out=rate), c, out=rate)
        return _ahead(u, self.dt, table.weights, rates, share, out)

    def _arrays(self, shape, count):
        """Room for the stages of a step; kept."""
        kept = self.__dict__.get("_room")
        if kept is None or kept[0].shape != shape or len(kept) < count:
            kept = self._room = [np.empty(shape) for _ in range(count)]
        return kept[:count]

    def backward(self, state, params, g, new=None, wanted=True):
        """Cotangents (of state, of params) of a step; plain.

        `new`: the result of the step where it is still known; it saves the solve that finds it again. `wanted`: whether
        params want a cotangent.
        """
        inner = D * self.dt if self.method in ("tr_bdf2", "imex") else self.dt
        z = inner * self.problem.coefficient(params)  # to the last bit that of the way forward: one set-up
        wanted = wanted and is_variable(params)
        if wanted and new is None and self.method == "crank_nicolson":
            new = self(state, params)  # the slope is made of it, with the same bits
        back, slope = PULLS[self.method](self.scheme, z, state, g, new, wanted)
        back = back if back.dtype == state.dtype else back.astype(state.dtype)
        return back, np.asarray(params).dtype.type(self.dt * np.real(slope)) if wanted else None

    def tangent(self, state, params, dstate, dparams):
        """Tangent of a step along (dstate, dparams); plain."""
        if dparams is None or not is_variable(params):
            return pushforward(lambda u: self(u, params), state, dstate)[1]
        return pushforward(lambda both: self(*both), (state, params), (dstate, dparams))[1]


def _ahead(u, h, row, rates, share, out):
    """u + the sum of h * weight * rate, written into `out`."""
    total = u
    for weight, rate in zip(row, rates, strict=False):
        if weight:
            total = np.add(total, np.multiply(rate, h * weight, out=share), out=out)
    return total


def runge_kutta(scheme, z, u, g, new, wanted):
    """Horner's rule with L^T; the slope leaves out the last term."""
    L, order = scheme.problem.op, scheme.order

    def horner(v, terms):
        total, room = v, [np.empty_like(v), np.empty_like(v)]
        for k in reversed(range(1, terms)):
            total = L.T.apply(total, out=room[k % 2])
            total *= z / k
            total += v
        return total

    g = np.ascontiguousarray(g)
    return horner(g, order + 1), np.sum(L.apply(u) * horner(g, order)) if wanted else 0.0


def backward_euler(scheme, z, u, g, new, wanted):
    solve, L = scheme.resolvent.plain, scheme.problem.op
    y = solve(z, g, transposed=True)
    return y, np.sum(y * L.apply(solve(z, u) if new is None else new)) if wanted else 0.0


def crank_nicolson(scheme, z, u, g, new, wanted):
    solve, L = scheme.resolvent.plain, scheme.problem.op
    y = solve(0.5 * z, g, transposed=True)
    slope = 0.0
    if wanted:
        slope = np.sum(y * L.apply(solve(0.5 * z, u) if new is None else 0.5 * (u + new)))
    return 2.0 * y - g, slope


def two_solves(share, double):
    """z is that of a stage, D dt c. Of v = u + share (y - u) and y = x (or 2 x - u) with x = S u, then S v."""
    factor = 2.0 if double else 1.0

    def pull(scheme, z, u, g, new, wanted):
        solve, L = scheme.resolvent.plain, scheme.problem.op
        q = solve(z, g, transposed=True)
        p = solve(z, factor * share * q, transposed=True)
        back = (1 - factor * share) * q + p
        if not wanted:
            return back, 0.0
        x = solve(z, u)
        if new is None:
            new = solve(z, u + share * (factor * x - factor * u))
        return back, D * (np.sum(q * L.apply(new)) + np.sum(p * L.apply(x)))

    return pull


def etdrk4(scheme, z, u, g, new, wanted):
    back = scheme.functions.plain((WHOLE,), z, g, transposed=True)
    return back, np.sum(back * scheme.problem.op.apply(u)) if wanted else 0.0


PULLS = {
    **dict.fromkeys(("euler", "heun", "ssprk3", "rk4"), runge_kutta),
    "backward_euler": backward_euler,
    "crank_nicolson": crank_nicolson,
    "tr_bdf2": two_solves(C, True),
    "imex": two_solves((1 - D) / D, False),
    "etdrk4": etdrk4,
}
