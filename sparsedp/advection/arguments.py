"""Checks of the arguments of a transport step: shapes, dtypes, finite numbers and the size of the time step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.validation import EPS, check_finite, check_number, check_plain, number_beside, rounded_down
from sparsedp.autodiff.tape import cast, dtype_of, isbox, sample
from sparsedp.errors import ShapeError, UnstableStepError
from sparsedp.grid.boundary_conditions import dirichlet, occurring

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from sparsedp.advection.settings import TransportSettings

__all__ = ["ROUNDING", "check_array", "check_inflow", "check_numbers", "check_stability", "check_step", "flatten_array"]

FLOAT = np.dtype(float)
ROUNDING = 8 * EPS  # tolerance: with a CFL number of exactly 1 the weight is about -1e-16 instead of 0


def check_step(name: str, dt: Any) -> float:
    """Return a time step as a float; raise unless it is a finite number > 0."""
    return check_number(f"dt of {name}", dt, "> 0", "; write dt=0.01, or -v for a step backwards in time")


def check_inflow(name: str, settings: TransportSettings, inflow: Any) -> None:
    """Raise ValueError if no side uses the inflow values. Constant zeros and empty arrays are accepted."""
    if dirichlet in occurring(settings.sides):
        return
    values = sample(inflow)
    if np.size(values) and (isbox(inflow) or np.any(values)):
        raise ValueError(
            f"{name} uses inflow values at sides of dp.dirichlet only, and boundary= has none; write "
            "boundary=dp.dirichlet, or leave the inflow out"
        )


def flatten_array(name: str, argument: str, value: Any, shapes: Sequence[tuple[int, ...]]) -> Any:
    """Return an array of one of the given shapes as a flat contiguous float64 array; a traced array stays traced."""
    if type(value) is np.ndarray and value.shape in shapes and value.dtype == FLOAT and value.flags.c_contiguous:
        return value.reshape(-1)
    check_array(name, argument, value, shapes)
    if isbox(value):
        return anp.reshape(cast(value, FLOAT), (-1,))
    return np.ascontiguousarray(value, dtype=float).reshape(-1)


def check_array(name: str, argument: str, value: Any, shapes: Sequence[tuple[int, ...]]) -> None:
    """Raise unless an argument is an array of real numbers of one of the shapes."""
    shape = _shape(name, argument, value)
    if shape not in shapes:
        hint = ""
        if len(shapes[0]) == 1 < len(shape):
            hint = "; write grid.join(...) for the components on faces"
            if argument == "v":
                hint += ", or velocity='cells'"
        raise ShapeError(f"{name} takes {argument} of shape {shapes[0]}, got an array of shape {shape}{hint}")
    check_plain(f"{name}, as {argument},", value)
    dtype = dtype_of(value)
    if dtype.kind not in "biu" and dtype.char not in "df":
        raise TypeError(
            f"{name} takes real numbers as {argument}, got dtype {dtype}; "
            f"write {argument}.real or {argument}.astype(float)"
        )


def _shape(name: str, argument: str, value: Any) -> tuple[int, ...]:
    """Return the shape of an argument; raise ShapeError for the list of components that ``grid.split`` returns."""
    try:
        return np.shape(value)
    except ValueError:  # the components have different shapes
        raise ShapeError(
            f"{name} takes {argument} as one array, got a {type(value).__name__} of {len(value)} parts; "
            "write grid.join(...) for faces"
        ) from None


def check_numbers(settings: TransportSettings, u: NDArray, v: NDArray, inflow: NDArray) -> None:
    """Raise NonFiniteError, with the first index and the count, if an argument holds NaN or infinity."""
    name = f"transport {settings.scheme}"
    check_finite(name, np.reshape(u, settings.space.shape), "needs a finite field")
    check_finite(name, v, "needs a finite velocity", settings.velocity_place)
    check_finite(name, inflow, "needs finite inflow values")


def check_stability(settings: TransportSettings, dt: float, rate: NDArray, limit: float) -> None:
    """Raise UnstableStepError if ``limit - dt * rate``, a bound of the weight of the old value, is negative anywhere.

    Parameters
    ----------
    settings : TransportSettings
    dt : float
        Time step [time].
    rate : array
        The CFL number of each point, divided by dt [1 / time]; see `transport`.
    limit : float
        Largest stable CFL number.
    """
    if settings.unstable == "allow":
        return
    unstable = ~(limit - dt * rate >= -ROUNDING)
    if np.any(unstable):
        largest = rounded_down(limit / np.max(rate))
        raise UnstableStepError(
            f"transport {settings.scheme}: dt = {number_beside(dt, float(largest), digits=12)} is too large at "
            f"{np.count_nonzero(unstable)} of {rate.size} points, most at {settings.field_place(int(np.argmax(rate)))};"
            f" the largest stable dt is {largest}, or write unstable='allow'"
        )
