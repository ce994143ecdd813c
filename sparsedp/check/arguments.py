"""How an operator treats what it is given: shapes, dtypes, memory layout, its own results."""

import numpy as np

from sparsedp.check.findings import Row, attempted, skipped
from sparsedp.check.probes import field
from sparsedp.derivative import pullback
from sparsedp.errors import DerivativeError, ShapeError
from sparsedp.structure.base import result_dtype

__all__ = ["argument_rows", "scaling_rows"]

FLOATING = ("float32", "float64", "complex64", "complex128")
ORDINARY = 1e-30, 1e30  # sizes of operators that take fields near the ends of the range of floats
WHOLE = ("int64", "bool")


def argument_rows(op, rng):
    """Rows: wrong shapes, dtypes, layouts, fresh results. The figure is the count of mistakes."""
    tests = {
        "wrong shapes refused": _shapes,
        "dtypes": _dtypes,
        "memory layouts": _layouts,
        "input unmodified, result fresh": _freshness,
        "same bits twice": _repeats,
    }
    return [_row(name, test, op, rng) for name, test in tests.items()]


def scaling_rows(op, size, rng):
    """A field times 2^900 or 2^-900 gives the same digits: largest difference, relative, in roundings."""
    if not ORDINARY[0] < size < ORDINARY[1]:
        return [skipped("scaling by 2^+-900", f"entries of size {size:.1e} leave the range of floats then")]
    u, g = field(rng, op.domain.shape, float), field(rng, op.codomain.shape, float)
    return [
        attempted("scaling by 2^+-900", 10.0, lambda: _scaled(op, u)),
        attempted("scaling by 2^+-900, transposed", 10.0, lambda: _scaled(op.T, g)),
    ]


def _scaled(op, u):
    wanted, worst = op.apply(u), 0.0
    largest = np.max(np.abs(wanted), initial=0.0)
    for exponent in (900, -900):
        found = op.apply(u * 2.0**exponent) * 2.0**-exponent
        if not np.array_equal(found, wanted):
            worst = max(worst, float(np.max(np.abs(found - wanted)) / (np.finfo(float).eps * largest)))
    return worst


def _row(name, test, op, rng):
    try:
        wrong = test(op, rng)
    except Exception as error:  # a foreign function may raise anything: its row shows it
        wrong = [f"{type(error).__name__}: {error}"]
    return Row(name, float(len(wrong)), 0.0, not wrong, "; ".join(wrong))


def _shapes(op, rng):
    """Fields that hold as many numbers in another shape, or one number too many."""
    shape, size = op.domain.shape, op.domain.size
    wrong = []
    for other in {(*shape, 1), (size + 1,), (1, size), (size,)} - {shape}:
        try:
            op(np.zeros(other))
            wrong.append(f"takes shape {other} for {shape}")
        except ShapeError:
            pass
        except Exception as error:  # anything but a ShapeError is the wrong answer
            wrong.append(f"shape {other} raises {type(error).__name__}")
    return wrong


def _dtypes(op, rng):
    """The result has the dtype of the field; bool and int become float64, and have no gradient."""
    wrong = []
    for dtype in map(np.dtype, FLOATING):
        try:
            found = op(field(rng, op.domain.shape, dtype)).dtype
        except (TypeError, DerivativeError):
            if dtype.kind == "c" and op.dtype.kind != "c":
                continue  # a clean refusal of complex fields
            raise
        if found != result_dtype(op.structure, dtype):
            wrong.append(f"{dtype} gives {found}")
    for dtype in map(np.dtype, WHOLE):
        u = rng.integers(0, 2, op.domain.shape).astype(dtype)
        if not _equal(op(u), op(u.astype(float))):
            wrong.append(f"{dtype} gives other numbers than float64")
        try:
            pullback(op, u)
            wrong.append(f"a gradient in {dtype} is not refused")
        except DerivativeError:
            pass
    return wrong


def _layouts(op, rng):
    """Fortran order, strides, a reversed and a read-only array: the bits of the contiguous copy."""
    u = field(rng, op.domain.shape, float)
    wanted = op(u)
    return [name for name, other in _copies(u) if not _equal(op(other), wanted)]


def _copies(u):
    frozen = u.copy()
    frozen.flags.writeable = False
    yield "read-only", frozen
    yield "Fortran order", np.asfortranarray(u)
    if u.ndim:
        apart = np.full((*u.shape[:-1], 2 * u.shape[-1]), np.nan)
        apart[..., ::2] = u
        yield "strided", apart[..., ::2]
        yield "reversed", u[::-1].copy()[::-1]


def _freshness(op, rng):
    u = field(rng, op.domain.shape, float)
    before, first = u.copy(), op(u)
    kept = first.copy()
    second = op(-2.0 * u)
    wrong = [] if _equal(u, before) else ["the input is modified"]
    if np.may_share_memory(first, u) or np.may_share_memory(first, second) or not _equal(first, kept):
        wrong.append("the result is not a fresh array")
    given = np.full_like(first, np.nan)
    if op.apply(u, out=given) is not given or not _equal(given, kept):
        wrong.append("apply(u, out) differs from apply(u)")
    return wrong


def _repeats(op, rng):
    u, g = field(rng, op.domain.shape, float), field(rng, op.codomain.shape, float)
    wrong = [] if _equal(op(u), op(u)) else ["two applications differ"]
    return wrong if _equal(op.T(g), op.T(g)) else [*wrong, "two transposed applications differ"]


def _equal(a, b):
    return a.dtype == b.dtype and a.shape == b.shape and np.array_equal(a, b, equal_nan=True)
