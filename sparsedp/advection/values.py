"""The four arguments of a step: checked, flat and in float64, plain or traced."""

import autograd.numpy as anp
import numpy as np

from sparsedp.advection.law import FIELD, INFLOW, STEP, VELOCITY
from sparsedp.errors import ShapeError
from sparsedp.fields import check_finite, is_number
from sparsedp.tape import cast, dtype_of, isbox, plain

__all__ = ["LETTERS", "check_step", "flat_numbers", "prepare", "raised", "result_like", "unflatten"]

FLOAT = np.dtype(float)
NONE = np.empty(0)
LETTERS = {FIELD: "u", VELOCITY: "v", INFLOW: "inflow"}


def prepare(law, u, v, dt, inflow):
    """Arguments of a step -> the arguments of a law."""
    if type(dt) is not float or not 0 < dt < np.inf:
        check_step(law.name, plain(dt))
        dt = dt if isbox(dt) else float(dt)
    u = flat_numbers(law.name, "u", u, law.field_shapes)
    v = flat_numbers(law.name, "v", v, law.velocity_shapes)
    return u, v, dt, _inflow(law.name, inflow, law.walls)


def check_step(name, dt):
    """Refuse a time step that is no positive number."""
    if not is_number(dt):
        raise TypeError(f"{name} needs one real number as dt, got {dt!r}; write for example dt=0.01")
    check_finite(name, dt, "needs a finite dt")
    if not dt > 0:
        raise ValueError(f"{name} needs dt > 0, got {dt:g}; to go back in time turn the velocity round")


def flat_numbers(name, letter, value, shapes):
    """Array of one of the shapes -> flat contiguous float64; a traced one stays traced."""
    if type(value) is np.ndarray and value.shape in shapes and value.dtype == FLOAT and value.flags.c_contiguous:
        return value.reshape(-1)
    shape = _shape(name, letter, value)
    if shape not in shapes:
        parts = len(shapes[0]) == 1 < len(shape)
        hint = "; write grid.join(...) for the components on faces" if parts else ""
        hint += ", or velocity='cells'" if parts and letter == "v" else ""
        raise ShapeError(f"{name} takes {letter} of shape {shapes[0]}, got an array of shape {shape}{hint}")
    if type(plain(value)) is not np.ndarray:
        if isinstance(value, np.ma.MaskedArray):
            raise TypeError(f"{name} takes plain arrays, got a masked array as {letter}; fill it first")
        value = value if isbox(value) else np.asarray(value)
    kind = dtype_of(value)
    if kind.kind not in "biu" and kind.char not in "df":
        raise TypeError(
            f"{name} takes real numbers as {letter}, got dtype {kind}; write {letter}.real or {letter}.astype(float)"
        )
    if isbox(value):
        return anp.reshape(cast(value, np.dtype(float)), (-1,))
    return np.ascontiguousarray(value, dtype=float).reshape(-1)


def _shape(name, letter, value):
    try:
        return np.shape(value)
    except ValueError:  # the components of a face field, which grid.split hands out, have different shapes
        given = f"a {type(value).__name__} of {len(value)} parts"
        raise ShapeError(f"{name} takes {letter} as one array, got {given}; write grid.join(...) for faces") from None


def _inflow(name, inflow, walls):
    if type(inflow) is float and -np.inf < inflow < np.inf:
        return np.full(walls.size, inflow) if walls.size else NONE
    if not walls.size and np.shape(inflow) == () and not isbox(inflow) and np.isfinite(inflow):
        return NONE
    if np.shape(inflow) == ():
        inflow = flat_numbers(name, "inflow", inflow, ((),))
        return inflow * np.ones(walls.size) if isbox(inflow) else np.full(walls.size, inflow[0])
    return flat_numbers(name, "inflow", inflow, (walls.shape,))


def result_like(u, flat, shape):
    """Flat float64 result -> field of the dtype of u (bool and int become float64)."""
    kind = u.dtype if type(u) is np.ndarray else dtype_of(u)
    if kind == FLOAT:
        return flat.reshape(shape)
    flat = flat if kind.char != "f" else np.asarray(flat, kind.newbyteorder("="))
    return flat.reshape(shape)


def raised(num, law, tangent):
    """Tangent of an argument as it was given -> flat float64 as the law has it."""
    if num != STEP and type(tangent) is np.ndarray and tangent.dtype == FLOAT and tangent.ndim:
        return tangent.reshape(-1)
    if num == INFLOW and np.shape(tangent) == ():
        return tangent * np.ones(law.walls.size)
    if num in LETTERS:
        return anp.reshape(cast(tangent, np.dtype(float)), (-1,))
    return tangent


def unflatten(value, cotangent):
    """Flat cotangent -> the shape in which the argument was given; a number for all walls gets their sum."""
    if type(cotangent) is np.ndarray and type(value) is np.ndarray and value.ndim:
        return cotangent.reshape(value.shape)
    shape = np.shape(value)
    if shape == ():
        return cotangent if type(cotangent) is float else anp.sum(cotangent)
    return anp.reshape(cotangent, shape)
