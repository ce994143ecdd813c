"""What may be given to an operator: the checks of fields and of reused result arrays."""

import numpy as np

from sparsedp.errors import ShapeError

__all__ = ["check_out", "field_array"]


def field_array(op, u):
    """Argument of an operator -> contiguous native array of float32, float64 or a complex kind."""
    if type(u) is not np.ndarray:
        if isinstance(u, np.ma.MaskedArray):
            raise TypeError(f"{op.name} takes plain arrays, got a masked array; fill it first")
        u = np.asarray(u)
    if u.shape != op.domain.shape:
        raise ShapeError(f"{op.name} takes a field on {op.domain}, got an array of shape {u.shape}")
    if u.dtype.char not in "dfDF":
        if u.dtype.kind not in "biu":
            raise TypeError(f"{op.name} takes float or complex numbers, got dtype {u.dtype}; write u.astype(float)")
        u = u.astype(float)
    if not u.flags.c_contiguous or not u.dtype.isnative:
        u = np.ascontiguousarray(u, dtype=u.dtype.newbyteorder("="))
    return u


def check_out(op, out, u, dtype):
    """Refuse a result array of another shape or dtype, or one that shares memory with `u`."""
    if out.shape != op.codomain.shape:
        raise ShapeError(f"{op.name} gives a field on {op.codomain}, got out of shape {out.shape}")
    if out.dtype != dtype:
        raise TypeError(f"{op.name} gives {dtype} here, got out of dtype {out.dtype}")
    if not out.flags.c_contiguous or not out.flags.writeable or np.may_share_memory(out, u):
        raise ValueError(f"{op.name} needs an out that is contiguous, writeable and apart from u")
