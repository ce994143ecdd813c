"""The four arguments of a step: checked, flat and in float64, plain or traced."""

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.validation import check_number, check_plain
from sparsedp.advection.law import INFLOW, STEP
from sparsedp.autodiff.tape import cast, dtype_of, isbox, plain
from sparsedp.errors import ShapeError

__all__ = [
    "FLOAT",
    "LETTERS",
    "NOTHING",
    "check_given",
    "check_step",
    "flat_numbers",
    "prepare",
    "raised",
    "result_like",
    "unflatten",
]

FLOAT, NOTHING = np.dtype(float), np.zeros(0)
LETTERS = "u", "v", "dt", "inflow"


def prepare(law, u, v, dt, inflow):
    """Arguments of a step -> the arguments of a law."""
    if type(dt) is not float or not 0 < dt < np.inf:
        number = check_step(law.name, plain(dt))
        dt = dt if isbox(dt) else number
    u = flat_numbers(law.name, "u", u, law.field_shapes)
    v = flat_numbers(law.name, "v", v, law.velocity_shapes)
    return u, v, dt, _inflow(law.name, inflow, law.walls)


def check_step(name, dt):
    """A time step, a positive number -> a float."""
    return check_number(f"dt of {name}", dt, "> 0", "; write dt=0.01, or turn the velocity round")


def flat_numbers(name, letter, value, shapes):
    """Array of one of the shapes -> flat contiguous float64; a traced one stays traced."""
    if type(value) is np.ndarray and value.shape in shapes and value.dtype == FLOAT and value.flags.c_contiguous:
        return value.reshape(-1)
    check_given(name, letter, value, shapes)
    if isbox(value):
        return anp.reshape(cast(value, FLOAT), (-1,))
    return np.ascontiguousarray(value, dtype=float).reshape(-1)


def check_given(name, letter, value, shapes):
    """Refuse what is no array of real numbers of one of the shapes."""
    shape = _shape(name, letter, value)
    if shape not in shapes:
        parts = len(shapes[0]) == 1 < len(shape)
        hint = "; write grid.join(...) for the components on faces" if parts else ""
        hint += ", or velocity='cells'" if parts and letter == "v" else ""
        raise ShapeError(f"{name} takes {letter} of shape {shapes[0]}, got an array of shape {shape}{hint}")
    check_plain(f"{name}, as {letter},", value)
    kind = dtype_of(value)
    if kind.kind not in "biu" and kind.char not in "df":
        raise TypeError(
            f"{name} takes real numbers as {letter}, got dtype {kind}; write {letter}.real or {letter}.astype(float)"
        )


def _shape(name, letter, value):
    try:
        return np.shape(value)
    except ValueError:  # the components of a face field, which grid.split hands out, have different shapes
        given = f"a {type(value).__name__} of {len(value)} parts"
        raise ShapeError(f"{name} takes {letter} as one array, got {given}; write grid.join(...) for faces") from None


def _inflow(name, inflow, walls):
    if type(inflow) is float:
        return np.full(walls.size, inflow) if walls.size else NOTHING
    if np.shape(inflow) == ():
        return flat_numbers(name, "inflow", inflow, ((),)) * np.ones(walls.size)
    return flat_numbers(name, "inflow", inflow, (walls.shape,))


def result_like(u, flat, shape):
    """Flat float64 result -> field of the dtype of u (bool and int become float64)."""
    kind = dtype_of(u)
    return (flat.astype(kind.newbyteorder("=")) if kind.char == "f" else flat).reshape(shape)


def raised(num, law, tangent):
    """Tangent of an argument as it was given -> flat float64 as the law has it."""
    if num == STEP:
        return tangent
    if type(tangent) is np.ndarray and tangent.dtype == FLOAT and tangent.ndim:
        return tangent.reshape(-1)
    tangent = anp.reshape(cast(tangent, FLOAT), (-1,))
    return tangent * np.ones(law.walls.size) if num == INFLOW and tangent.size == 1 else tangent


def unflatten(value, cotangent):
    """Flat cotangent -> the shape in which the argument was given; a number for all walls gets their sum."""
    shape = np.shape(value)
    if shape == () and type(cotangent) is not float:
        return anp.sum(cotangent)
    return cotangent.reshape(shape) if shape else cotangent
