"""A step of transport with a fixed dt."""

from sparsedp.errors import DerivativeError
from sparsedp.tape import isbox
from sparsedp.tree import copied

__all__ = ["Step"]


class Step:
    """``step(u, v)``: transport with fixed dt and inflow, made by ``Transport.step``."""

    __slots__ = ("dt", "inflow", "transport")

    def __init__(self, transport, dt, inflow):
        if isbox(dt) or isbox(inflow):
            raise DerivativeError(
                "step needs constant dt and inflow, got traced ones; write lambda u, p: move(u, p[0], p[1]) instead"
            )
        self.transport = transport
        self.dt, self.inflow = copied((dt, inflow))  # the caller may reuse the arrays

    def __call__(self, u, v):
        return self.transport(u, v, self.dt, self.inflow)

    def __repr__(self):
        return f"<step of {self.transport!r}, dt = {self.dt:g}>"
