"""Plots of fields and of results. Only this module of sparsedp imports matplotlib (extra `plot`)."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial, reduce
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sparsedp._utils.validation import check_choice, check_kind, check_type
from sparsedp.autodiff.tape import plain
from sparsedp.check.gradient_check import Audit
from sparsedp.check.summary import Result
from sparsedp.errors import ShapeError
from sparsedp.grid.grid import Grid, check_grid
from sparsedp.io.atomic_files import write_file
from sparsedp.optimize.result import Minimum

__all__ = [
    "animate",
    "convergence",
    "current",
    "curves",
    "figure",
    "opened",
    "plot",
    "sample_data",
    "stability_chart",
    "pareto_front",
    "v_curve",
    "write_picture",
    "write_result",
]

MOST_ARROWS = 24  # largest number of arrows along an axis
MOST_MARKERS = 64  # lines with more points have no markers
LARGEST_FACTOR = 2.0  # growth factor at the red end of the colour map
BAR_SHARE = 0.2  # share of the width of axes that is left for the colour bar and its labels
MOST_TICKS = 6  # labels along a logarithmic axis; more would overlap in three plots side by side


def plot(
    grid: Grid,
    u: ArrayLike,
    ax: Any = None,
    title: str | None = None,
    label: str | None = None,
    limits: tuple[float, float] | None = None,
    cmap: str = "viridis",
    at: str | None = None,
) -> Any:
    """Plot a field on a grid. Axis 0 is x, axis 1 is y, and both have the same scale.

    Parameters
    ----------
    grid : Grid
    u : array, a field on cells, faces or nodes [unit]
        A 1-D field is plotted as a line, a 2-D field as a colour map, and a 3-D field as three slices through the
        middle. Of a face field the magnitude is shown, and in 2-D also arrows.
    ax : matplotlib Axes, optional
        Axes to draw on. Default: the current axes of pyplot if they are empty, otherwise those of a new figure.
    title, label : str, optional
        Title of the plot, and label of the colour bar (in 1-D: of the vertical axis).
    limits : (float, float), optional
        The values at the ends of the colour bar. Use the same limits for plots that are to be compared.
    cmap : str
        Name of a matplotlib colour map.
    at : "cells", "faces" or "nodes", optional
        The space of the field. Default: the first of these spaces whose shape matches.

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    ShapeError
        If `u` is not a field on the cells, faces or nodes of the grid.
    TypeError
        If `u` is complex, or `ax` is something else than Axes.
    ImportError
        If matplotlib is not installed.

    See Also
    --------
    animate, convergence, from_image

    Examples
    --------
    >>> from sparsedp import Grid
    >>> picture = plot(Grid((2, 3)), np.ones((2, 3)), ax=figure().add_subplot(), title="flat")
    >>> picture.get_xlabel(), picture.get_ylabel(), picture.get_title()
    ('x', 'y', 'flat')

    To write the picture to a file, for example "flat.png", use ``picture.figure.savefig("flat.png")``.
    """
    check_grid("plot", grid)
    values = np.asarray(plain(u))
    check_kind("u of plot", values.dtype, "real numbers", "; plot its real part or its absolute value")
    values, kind, components = _scalar_field(grid, values, at)
    ax = current(ax)
    if title is not None:
        ax.set_title(title)
    if grid.dim == 1:
        if values.size <= MOST_MARKERS:
            marker = "."
        else:
            marker = None
        ax.plot(grid.coordinates(0, kind), values, marker=marker)
        ax.set(xlim=(grid.origin[0], grid.origin[0] + grid.size[0]), xlabel="x", ylabel=label or "")
        return ax
    low, high = limits or _range(values)
    views = [(ax, values, [0, 1])]
    if grid.dim == 3:
        views = list(_middle_slices(grid, values, kind, ax))
    # pcolormesh needs the positions of the nodes, or the ends of the cells.
    if kind == "nodes":
        places = "nodes"
    else:
        places = "ends"
    for view, part, axes in views:
        lines = [grid.coordinates(axis, places) for axis in axes]
        # pcolormesh expects rows along y, so the array is transposed.
        image = view.pcolormesh(*lines, part.T, shading="auto", vmin=low, vmax=high, cmap=cmap, rasterized=True)
        view.set(aspect="equal", xlabel=grid.axes[axes[0]], ylabel=grid.axes[axes[1]])
    if ax.figure.get_layout_engine() is None:
        _make_room(ax)
    bar = ax.inset_axes((1.03, 0.0, 0.04, 1.0))  # as high as the plot, for every aspect ratio
    ax.figure.colorbar(image, cax=bar, label=label or "")
    if components and grid.dim == 2:
        strides = tuple(slice(n // MOST_ARROWS // 2, None, -(-n // MOST_ARROWS)) for n in grid.shape)
        ax.quiver(*(part[strides] for part in (*grid.centres(), *components)), color="white", pivot="mid")
    return ax


def animate(
    grid: Grid,
    frames: Sequence[ArrayLike],
    path: Any,
    title: str | None = None,
    limits: tuple[float, float] | None = None,
    cmap: str = "viridis",
    rate: float = 12,
) -> None:
    """Write an animated GIF of a sequence of fields.

    Parameters
    ----------
    grid : Grid
    frames : sequence of arrays
        Fields as for `plot`.
    path : str, Path or binary stream
    title, limits, cmap
        See `plot`. The limits are the same for all frames.
    rate : float
        Frames per second.

    Raises
    ------
    ValueError
        If `frames` is empty.
    ShapeError
        If a frame is not a field on the grid.
    ImportError
        If matplotlib is not installed.
    OSError
        If the file cannot be written.

    See Also
    --------
    plot

    Examples
    --------
    >>> import io
    >>> from sparsedp import Grid
    >>> film = io.BytesIO()
    >>> animate(Grid((2, 3)), [np.zeros((2, 3)), np.ones((2, 3))], film)
    >>> film.getvalue()[:3]
    b'GIF'
    """
    arrays = [np.asarray(plain(frame)) for frame in frames]
    if not arrays:
        raise ValueError("animate needs at least one frame, got none; run with keep='all'")
    limits = limits or _range(np.concatenate([_scalar_field(grid, frame)[0].ravel() for frame in arrays]))
    images = []
    for frame in arrays:
        picture = figure()
        pixels = io.BytesIO()
        plot(grid, frame, ax=picture.add_subplot(), title=title, limits=limits, cmap=cmap)
        picture.savefig(pixels, format="png", dpi="figure")
        images.append(opened(pixels).convert("RGB").quantize(256))
    first, *others = images
    write = partial(first.save, format="GIF", save_all=True, append_images=others, duration=round(1000 / rate), loop=0)
    if hasattr(path, "write"):
        write(path)
    else:
        write_file(path, write)


def _scalar_field(
    grid: Grid, u: NDArray[Any], at: str | None = None
) -> tuple[NDArray[Any], str, Sequence[NDArray[Any]]]:
    """Return (values, kind, components): what is plotted, its space ("cells" or "nodes"), and a list of components.

    The values of a face field in 2-D or 3-D are its magnitude at the cell centres, and the components are its
    components there. For other fields the list of components is empty.
    """
    kinds = [at] if at else ["cells", "faces", "nodes"]
    kind = next((kind for kind in kinds if u.shape == getattr(grid, kind).shape), None)
    if kind is None:
        where = at or "cells, faces or nodes"
        raise ShapeError(f"plot takes a field on the {where} of {grid}, got an array of shape {u.shape}")
    if kind != "faces":
        return u, kind, []
    if grid.dim == 1:
        return u, "nodes", []
    inside = tuple(map(slice, grid.shape))  # drop the wrapped mean at the last face of a bounded axis
    parts = [0.5 * (part + np.roll(part, -1, axis))[inside] for axis, part in enumerate(grid.split(u))]
    return reduce(np.hypot, parts), "cells", parts


def _make_room(ax: Any) -> None:
    """Make axes narrower, so that a colour bar at their right end is inside the figure."""
    position = ax.get_position(original=True)
    ax.set_position((position.x0, position.y0, (1.0 - BAR_SHARE) * position.width, position.height))
    ax.set_in_layout(True)  # set_position excludes the axes from a layout that the user may choose later


def _range(u: NDArray[Any]) -> tuple[float, float]:
    """Return the smallest and the largest finite value, or (0, 1) if there is no finite value."""
    finite = u[np.isfinite(u)]
    if finite.size:
        return (float(finite.min()), float(finite.max()))
    return (0.0, 1.0)


def _middle_slices(grid: Grid, u: NDArray[Any], kind: str, ax: Any) -> Iterator[tuple[Any, NDArray[Any], list[int]]]:
    """Yield (axes, array, two grid axes) for the three middle slices of a 3-D field, side by side."""
    ax.set_axis_off()
    for place, across in enumerate((2, 1, 0)):
        inset = ax.inset_axes((0.35 * place, 0.0, 0.25, 1.0))
        middle = u.shape[across] // 2
        inset.set_title(f"{grid.axes[across]} = {grid.coordinates(across, kind)[middle]:.3g}", fontsize="medium")
        yield inset, u.take(middle, across), [axis for axis in range(3) if axis != across]


# ---------------------------------------------------------------- charts


def pareto_front(points: Sequence[Any]) -> list[Any]:
    """Return the Pareto set of tuples whose first two entries are costs, sorted by the first cost.

    A tuple is in the Pareto set if no other tuple is better in both costs.

    Examples
    --------
    >>> pareto_front([(3, 1), (1, 5), (2, 6), (2, 2)])
    [(1, 5), (2, 2), (3, 1)]
    """
    best: list[Any] = []
    for point in sorted(points, key=lambda point: point[:2]):
        if not best or point[1] < best[-1][1]:
            best.append(point)
    return best


def curves(lines: Mapping[str, Any], ax: Any, xlabel: str, ylabel: str) -> Any:
    """Plot named curves on log-log axes, with a band through the Pareto set of all points.

    Parameters
    ----------
    lines : dict
        Lists of points (x, y) of positive numbers, by name of the curve.
    ax : matplotlib Axes
    xlabel, ylabel : str

    Returns
    -------
    matplotlib Axes
    """
    best = pareto_front([point for points in lines.values() for point in points if point[1] > 0])
    ax.plot(*np.reshape(best, (-1, 2)).T, color="0.8", linewidth=6, solid_capstyle="round", label="best so far")
    return _labelled_curves(lines, ax, xlabel, ylabel)


def _labelled_curves(
    lines: Mapping[str, Any], ax: Any, xlabel: str, ylabel: str, title: str | None = None, xscale: str = "log"
) -> Any:
    """Plot named curves with labels, a grid and a legend."""
    for name, points in lines.items():
        ax.plot(*np.reshape(points, (-1, 2)).T, marker=".", markersize=4, linewidth=1, label=name)
    ax.set(xlabel=xlabel, ylabel=ylabel, title=title, xscale=xscale)
    ax.set_yscale("log", nonpositive="mask")  # leave a gap at 0, which has no logarithm
    _thin_out(ax.xaxis)
    ax.grid(visible=True, color="0.93")
    if ax.lines:
        ax.legend(frameon=False, fontsize="small")
    return ax


def _thin_out(axis: Any) -> None:
    """Limit the number of labels on a logarithmic axis of many decades."""
    low, high = axis.get_view_interval()
    if axis.get_scale() == "log" and np.log10(high / low) > MOST_TICKS:
        ticker = _matplotlib(".ticker")
        axis.set_major_locator(ticker.LogLocator(numticks=MOST_TICKS))
        axis.set_minor_locator(ticker.NullLocator())


def convergence(best: Minimum, ax: Any = None, against: str = "iteration") -> Any:
    """Plot loss and gradient norm of a run of `minimize` over iterations, seconds, evaluations or solves.

    Parameters
    ----------
    best : Minimum
        The result of `minimize`.
    ax : matplotlib Axes, optional
        Default: the current axes of pyplot if they are empty, otherwise those of a new figure.
    against : "iteration", "seconds", "evaluations" or "solves"
        The quantity on the horizontal axis.

    Returns
    -------
    matplotlib Axes
        The vertical axis is logarithmic. If some values of the loss are not positive, the smallest one is subtracted.

    Raises
    ------
    ValueError
        If `against` is none of the four words.
    TypeError
        If `best` is not a result of `minimize`.
    ImportError
        If matplotlib is not installed.

    See Also
    --------
    v_curve, minimize, plot

    Examples
    --------
    >>> import autograd.numpy as anp
    >>> from sparsedp import minimize
    >>> best = minimize(lambda x: anp.sum((x - 1.0) ** 4), np.zeros(2), maxiter=5)
    >>> convergence(best, figure().add_subplot()).get_xlabel()
    'iteration'
    """
    check_type("convergence", best, Minimum, "what minimize returns", "dp.convergence(dp.minimize(loss, start))")
    check_choice("against of convergence", against, ("iteration", "seconds", "evaluations", "solves"))
    ax = current(ax)
    records = [(getattr(record, against), record.value, record.gradient_norm) for record in best.history]
    numbers = np.array(records, float)
    least = numbers[:, 1].min()
    if least <= 0:
        name = "loss - least loss"
    else:
        name = "loss"
    lines = {name: numbers[:, :2] - (0.0, min(least, 0.0)), "gradient norm": numbers[:, ::2]}
    return _labelled_curves(lines, ax, against, "", f"{best.method}: {best.message.split(':')[0]}", xscale="linear")


def v_curve(audit: Audit, ax: Any = None) -> Any:
    """Plot the gap |difference - gradient| of an audit over the step size, with one curve for each direction.

    For a correct gradient the curve is a V: the error of the differences decreases with the step until rounding errors
    dominate. For a wrong gradient it has a plateau.

    Parameters
    ----------
    audit : Audit
        The result of `check.gradient`.
    ax : matplotlib Axes, optional
        Default: the current axes of pyplot if they are empty, otherwise those of a new figure.

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    TypeError
        If `audit` is not a result of `check.gradient`.
    ImportError
        If matplotlib is not installed.

    See Also
    --------
    convergence, check.gradient

    Examples
    --------
    >>> from sparsedp import check
    >>> result = check.gradient(lambda u: np.sum(u**3), np.array([1.0, 2.0]), gradient=lambda u: 3 * u**2)
    >>> v_curve(result, figure().add_subplot()).get_xlabel()
    'step'
    """
    check_type("v_curve", audit, Audit, "what check.gradient returns", "dp.v_curve(dp.check.gradient(loss, x))")
    lines, xlabel, ylabel = audit.curves()
    lines = {name: points for name, points in lines.items() if any(gap > 0 for _, gap in points)}
    if audit.culprit:
        title = f"{audit.verdict}: {audit.culprit}"
    else:
        title = audit.verdict
    return _labelled_curves(lines, current(ax), xlabel, ylabel, title)


def stability_chart(growth: Any, ax: Any) -> Any:
    """Plot a stability map: the growth factor over viscosity (horizontal) and time step (vertical).

    Steps that raise an error are grey.

    Parameters
    ----------
    growth : StabilityMap
    ax : matplotlib Axes

    Returns
    -------
    matplotlib Axes
    """
    ylabel, xlabel = growth.names
    ax.set(xlabel=xlabel, ylabel=ylabel, title="stable: blue; grows: red; refused: grey", facecolor="0.75")
    factors = np.clip(growth.factors, 0.0, LARGEST_FACTOR)
    x = _ends_between(growth.viscosities)
    y = _ends_between(growth.time_steps)
    image = ax.pcolormesh(x, y, factors, cmap="coolwarm", vmin=0, vmax=LARGEST_FACTOR)
    ax.figure.colorbar(image, ax=ax, label="growth factor of a step (2 and more: red)")
    ax.loglog(*growth.here[::-1], marker="*", color="black", markersize=12)
    return ax


def _ends_between(values: NDArray[Any]) -> NDArray[Any]:
    """Return the ends of cells around increasing positive numbers: the midpoints on a logarithmic axis."""
    ends = np.sqrt(values[1:] * values[:-1])
    return np.concatenate([values[:1] ** 2 / ends[:1], ends, values[-1:] ** 2 / ends[-1:]])


# ---------------------------------------------------------------- figures and files


def figure() -> Any:
    """Return an empty figure that is not registered with pyplot."""
    return _matplotlib(".figure").Figure(figsize=(5.5, 4.4), layout="constrained")


def current(ax: Any) -> Any:
    """Return `ax`. If it is None, return the current axes of pyplot if they are empty, else those of a new figure.

    Raises
    ------
    TypeError
        If `ax` is neither None nor Axes.
    """
    if ax is None:
        pyplot = _matplotlib(".pyplot")
        if pyplot.get_fignums():
            axes = pyplot.gca()
            if not axes.has_data() and not axes.child_axes:
                return axes
        return pyplot.figure(layout="constrained").add_subplot()
    if isinstance(ax, (str, Path)):
        raise TypeError(
            f"ax must be matplotlib Axes, got the path {str(ax)!r}; write dp.plot(grid, u).figure.savefig({str(ax)!r})"
        )
    check_type("ax", ax, _matplotlib(".axes").Axes, "matplotlib Axes", "ax=figure.add_subplot()")
    return ax


def write_picture(path: Path, draw: Callable[[Any], Any]) -> None:
    """Call ``draw(axes)`` with new axes, and write the figure to a PNG file."""
    picture = draw(figure().add_subplot()).figure
    write_file(path, partial(picture.savefig, format="png", dpi=150, bbox_inches="tight", pad_inches=0.15))


def write_result(
    result: Result, folder: Path, stem: str, draw: Callable[[Any], Any] | None = None, heading: str = ""
) -> list[Path]:
    """Write a result to stem.md, stem.csv and, if matplotlib is installed, stem.png; return the paths.

    Parameters
    ----------
    result : Result
    folder : pathlib.Path
    stem : str
    draw : callable, optional
        ``draw(axes)`` draws the plot. Default: no .png file.
    heading : str
        Text at the beginning of the .md file.
    """
    paths = [folder / f"{stem}.md", folder / f"{stem}.csv"]
    write_file(paths[0], heading + result.markdown())
    write_file(paths[1], result.csv())
    if draw:
        picture = folder / f"{stem}.png"
        with contextlib.suppress(ImportError):
            write_picture(picture, draw)
            paths.append(picture)
    return paths


def sample_data(name: str) -> Any:
    """Return a file of matplotlib's sample data."""
    return _matplotlib(".cbook").get_sample_data(name)


def opened(file: Any) -> Any:
    """Open a file or stream as a Pillow image. Pillow raises an error for images that are too large."""
    _matplotlib()
    return import_module("PIL.Image").open(file)


def _matplotlib(part: str = "") -> Any:
    """Import matplotlib, or one of its modules such as ".pyplot"; raise ImportError with advice if it is missing."""
    try:
        import_module("matplotlib")
        return import_module(f"matplotlib{part}")
    except ImportError as error:
        raise ImportError('pictures need matplotlib; install the extra: pip install "sparsedp[plot]"') from error
