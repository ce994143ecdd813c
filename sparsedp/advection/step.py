"""A step of transport with a fixed dt, and its plain forms without the tape, for a time loop that owns its buffers."""

import numpy as np

from sparsedp.advection.law import FIELD, VELOCITY
from sparsedp.advection.values import prepare, raised, result_like, unflatten
from sparsedp.errors import DerivativeError
from sparsedp.tape import dtype_of, isbox
from sparsedp.tree import copied

__all__ = ["Step"]


class Step:
    """``step(u, v)``: transport with fixed dt and inflow, made by ``Transport.step``."""

    __slots__ = ("dt", "inflow", "transport")
    sparing = True  # `backward` is told what nobody wants

    def __init__(self, transport, dt, inflow):
        if isbox(dt) or isbox(inflow):
            raise DerivativeError(
                "step needs constant dt and inflow, got traced ones; write lambda u, p: move(u, p[0], p[1]) instead"
            )
        self.transport = transport
        self.dt, self.inflow = copied((dt, inflow))  # the caller may reuse the arrays

    def __call__(self, u, v):
        return self.transport(u, v, self.dt, self.inflow)

    def forward(self, u, v, out=None):
        """The moved field, plain; the array `out` is used for it when it fits."""
        law = self.transport.law
        flat = law.forward(*prepare(law, u, v, self.dt, self.inflow), out=_target(out))
        return result_like(u, flat, law.setting.space.shape)

    def backward(self, u, v, g, into=None, new=None, wanted=True):
        """Cotangents of u and v, plain; that of v is added to the array `into` when it is given, or not computed."""
        law, target = self.transport.law, _target(into)
        flat = prepare(law, u, v, self.dt, self.inflow)
        if not wanted:
            (of_u,) = law.pull((FIELD,), raised(FIELD, law, g), *flat)
            return _rounded(u, unflatten(u, of_u)), into
        own = {} if target is None else {VELOCITY: target}
        of_u, of_v = law.pull((FIELD, VELOCITY), raised(FIELD, law, g), *flat, into=own)
        if into is None:
            into = _rounded(v, unflatten(v, of_v))
        elif target is None:
            into += unflatten(v, of_v)
        return _rounded(u, unflatten(u, of_u)), into

    def march(self, states, v):
        """Fill the rows of the array `states` from the first: one step from each to the next."""
        law = self.transport.law
        _, *flat = prepare(law, states[0], v, self.dt, self.inflow)
        law.march(states.reshape(len(states), -1), *flat)

    def retreat(self, states, v, g, into=None):
        """`backward` over all those steps; without `into` nothing is computed for v."""
        law = self.transport.law
        _, *flat = prepare(law, states[0], v, self.dt, self.inflow)
        rows, target = states.reshape(len(states), -1), None if into is None else into.reshape(-1)
        return law.retreat(rows, raised(FIELD, law, g), *flat, into=target).reshape(g.shape), into

    def tangent(self, u, v, du, dv):
        """Tangent of the moved field, plain."""
        law = self.transport.law
        flat = prepare(law, u, v, self.dt, self.inflow)
        along = {FIELD: raised(FIELD, law, du), VELOCITY: raised(VELOCITY, law, dv)}
        return _rounded(u, unflatten(u, law.push(along, *flat)))

    def __repr__(self):
        return f"<step of {self.transport!r}, dt = {self.dt:g}>"


def _rounded(value, found):
    """In the dtype of a value in single precision."""
    kind = dtype_of(value)
    return found.astype(kind.newbyteorder("=")) if kind.char == "f" else found


def _target(array):
    """A flat view that may be written to, or None."""
    if not isinstance(array, np.ndarray) or array.dtype != np.dtype(float):
        return None
    return array.reshape(-1) if array.flags.c_contiguous and array.flags.writeable else None
