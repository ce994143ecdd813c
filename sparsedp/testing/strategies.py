"""Strategies of hypothesis for grids and fields. Only this module imports hypothesis (extra `test`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from sparsedp._utils.validation import check_choice, check_number, check_whole
from sparsedp.grid.grid import Grid
from sparsedp.grid.space import Space

if TYPE_CHECKING:
    from hypothesis.strategies import SearchStrategy

__all__ = ["fields", "grids"]

WIDTHS = (1.0, 0.5, 0.25, 2.0, 0.1)  # of the cells of stretched axes [length]
PATTERNS = ("zero", "constant", "spike", "ramp", "checkerboard", "half zero", "random", "scales")  # simplest first


def grids(
    max_dimensions: int = 3,
    max_cells: int = 6,
    periodic: bool | None = None,
    stretched: bool | None = None,
) -> SearchStrategy[Grid]:
    """Return a strategy of hypothesis for grids. Simple examples are small, uniform and one-dimensional.

    Parameters
    ----------
    max_dimensions : int
        Largest number of axes, 1 to 3.
    max_cells : int
        Largest number of cells along an axis.
    periodic, stretched : bool, optional
        Whether all axes are periodic, or have cells of different widths. Default: each axis has its own.

    Returns
    -------
    SearchStrategy
        Its examples are `Grid` objects.

    Raises
    ------
    ImportError
        If hypothesis is not installed.

    See Also
    --------
    testing.fields

    Examples
    --------
    >>> from hypothesis import given, settings
    >>> @settings(max_examples=5)
    ... @given(grids(max_dimensions=2))
    ... def test(grid):
    ...     assert grid.volumes.size <= 36
    >>> test()
    """
    st = _strategies()
    check_choice("max_dimensions of testing.grids", max_dimensions, (1, 2, 3))
    check_whole("max_cells of testing.grids", max_cells, 1, "; the default is 6")

    def choice(value: bool | None) -> SearchStrategy[bool]:
        return st.booleans() if value is None else st.just(value)

    @st.composite
    def drawn(draw: Any) -> Grid:
        widths = []
        is_periodic = []
        for _ in range(draw(st.integers(1, max_dimensions))):
            count = draw(st.integers(1, max_cells))
            if draw(choice(stretched)):
                widths.append(np.array(draw(st.lists(st.sampled_from(WIDTHS), min_size=count, max_size=count))))
            else:
                widths.append(np.full(count, 1.0 / count))
            is_periodic.append(draw(choice(periodic)))
        return Grid(tuple(map(len, widths)), spacing=widths, periodic=is_periodic)

    return drawn()


def fields(
    where: Grid | Space | int | tuple[int, ...],
    dtype: DTypeLike = float,
    max_magnitude: float = 1e3,
) -> SearchStrategy[NDArray[Any]]:
    """Return a strategy of hypothesis for arrays of numbers that find mistakes in derivatives.

    The examples are: zero, a constant, one nonzero entry, a linear ramp, alternating signs, random numbers with exact
    zeros, random numbers, and random numbers over many orders of magnitude. Simple examples come first.

    Parameters
    ----------
    where : Grid, Space, int, or tuple of int
        The cells of a grid, the places of a space, or a shape.
    dtype : data-type
        A floating dtype, real or complex.
    max_magnitude : float
        Largest absolute value of a real or imaginary part.

    Returns
    -------
    SearchStrategy
        Its examples are new arrays.

    Raises
    ------
    ImportError
        If hypothesis is not installed.
    TypeError
        If `dtype` is not a floating dtype.

    See Also
    --------
    testing.grids

    Examples
    --------
    >>> from hypothesis import given, settings
    >>> @settings(max_examples=5)
    ... @given(fields((3, 4), max_magnitude=2.0))
    ... def test(u):
    ...     assert u.shape == (3, 4) and abs(u).max() <= 2
    >>> test()
    """
    st = _strategies()
    check_number("max_magnitude of testing.fields", max_magnitude, "> 0")
    kind = np.dtype(dtype)
    if kind.kind not in "fc":
        raise TypeError(f"dtype of testing.fields must be a floating dtype, got {kind}; write float or complex")
    shape = where.shape if isinstance(where, (Grid, Space)) else where
    shape = (shape,) if isinstance(shape, int) else tuple(shape)

    @st.composite
    def drawn(draw: Any) -> NDArray[Any]:
        real = _field(draw, st, shape, max_magnitude)
        if kind.kind == "c":
            return (real + 1j * _field(draw, st, shape, max_magnitude)).astype(kind)
        return real.astype(kind)

    return drawn()


def _field(draw: Any, st: Any, shape: tuple[int, ...], largest: float) -> NDArray[Any]:
    """Draw a real field with one of the patterns."""
    name = draw(st.sampled_from(PATTERNS))
    size = int(np.prod(shape))
    if name == "zero" or size == 0:
        return np.zeros(shape)
    magnitude = draw(st.floats(1e-3 * largest, largest))
    rng = np.random.default_rng(draw(st.integers(0, 2**16)))
    values = rng.uniform(-1.0, 1.0, size)
    if name == "constant":
        values = np.ones(size)
    elif name == "spike":
        values = np.zeros(size)
        values[draw(st.integers(0, size - 1))] = 1.0
    elif name == "ramp":
        values = np.linspace(-1.0, 1.0, size)
    elif name == "checkerboard":
        values = np.where(sum(np.indices(shape)) % 2 == 0, 1.0, -1.0)
    elif name == "half zero":
        values = np.where(rng.random(size) < 0.5, 0.0, values)
    elif name == "scales":
        values = values * 10.0 ** rng.uniform(-12.0, 0.0, size)
    return magnitude * values.reshape(shape)


def _strategies() -> Any:
    """Return hypothesis.strategies; its error says how to install hypothesis."""
    try:
        from hypothesis import strategies
    except ImportError as error:
        raise ImportError("dp.testing.grids and dp.testing.fields need hypothesis; pip install hypothesis") from error
    return strategies
