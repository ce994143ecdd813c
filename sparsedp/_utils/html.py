"""HTML for notebooks and report pages: tables, curves and pictures of sparse matrices.

Tables are plain HTML and pictures are SVG. They need no other package and no network access, and use the text colour of
the page, so that they are readable on light and dark pages.
"""

from __future__ import annotations

from html import escape
from math import isnan
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

__all__ = ["Markup", "cell", "curves", "facts", "folded_list", "paragraphs", "spy", "table", "text_of"]

# Palette of Okabe and Ito, which colour-blind readers can distinguish.
COLOURS = "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#999999"
WIDTH = 420  # size of a picture [pixels]
HEIGHT = 260
LEFT = 60  # margins for labels [pixels]
BELOW = 40
SHORT = 20  # table cells with at most this number of characters are not wrapped
SPOTS = 48  # largest number of squares along one side of the picture of a matrix


class Markup(str):
    """A string that contains HTML and must not be escaped."""

    __slots__ = ()

    def _repr_html_(self):
        return self


def text_of(value: Any, digits: int) -> str:
    """Format a value as text: a float with this number of digits; NaN and None as an empty string."""
    if value is None:
        return ""
    if not isinstance(value, (float, np.floating)):
        return str(value)
    if isnan(value):
        return ""
    return f"{value:.{digits}g}"


def cell(value: Any) -> str:
    """Format a value as HTML: a float with three digits; NaN and None as an empty string."""
    return value if isinstance(value, Markup) else escape(text_of(value, 3))


def table(rows: Iterable[Iterable], head: Sequence = (), title: str = "") -> Markup:
    """Return an HTML table with the given rows of values, column names (`head`) and caption (`title`)."""
    lines = []
    if title:
        lines.append(f"<caption>{cell(title)}</caption>")
    if head:
        lines.append(f"<thead><tr>{''.join(f'<th>{cell(name)}</th>' for name in head)}</tr></thead>")
    body = (f"<tr>{''.join(map(_in_table, row))}</tr>" for row in rows)
    return Markup("\n".join(["<table>", *lines, "<tbody>", *body, "</tbody>", "</table>"]))


def _in_table(value):
    """Return a value as a cell of a table; a short text is not wrapped."""
    text = cell(value)
    if len(text) <= SHORT:
        return f'<td nowrap="nowrap">{text}</td>'
    return f"<td>{text}</td>"


def facts(title: str, entries: dict) -> Markup:
    """Return a dict as a table of two columns, without the entries that are None."""
    rows = [(name, value) for name, value in entries.items() if value is not None]
    return table(rows, title=title)


def paragraphs(lines: Iterable, tag: str = "p") -> Markup:
    """Return each line as an HTML element, by default as a paragraph."""
    return Markup("\n".join(f"<{tag}>{cell(line)}</{tag}>" for line in lines))


def folded_list(title: str, lines: Sequence) -> Markup:
    """Return a list of lines that is hidden until the user clicks on the title; an empty string without lines."""
    if not lines:
        return Markup("")
    return Markup(f"<details><summary>{cell(title)}</summary><ul>\n{paragraphs(lines, 'li')}\n</ul></details>")


def spy(matrix: Any) -> Markup:
    """Return a picture of the sparsity pattern of a matrix, in which darker squares contain more entries."""
    rows, columns = matrix.shape
    entries = matrix.tocoo()
    size = max(rows, columns, 1)
    side = min(size, SPOTS)
    places = np.stack([entries.row, entries.col]).astype(np.int64) * side // size
    spots, counts = np.unique(places, axis=1, return_counts=True)
    squares = (
        f'<rect x="{column}" y="{row}" width="1" height="1" opacity="{0.3 + 0.7 * count / counts.max():.2f}"/>'
        for (row, column), count in zip(spots.T.tolist(), counts)
    )
    width = max(1, -(-columns * side // size))
    height = max(1, -(-rows * side // size))
    return Markup(
        f'<svg viewBox="0 0 {width} {height}" width="{3 * width}" height="{3 * height}" fill="currentColor" role="img" '
        f'style="border: 1px solid"><title>entries</title>{"".join(squares)}</svg>'
    )


def curves(lines: dict, across: str, up: str, *, log: tuple[bool, bool] = (False, True)) -> Markup:
    """Return a picture of curves; an empty string if no point can be drawn.

    Parameters
    ----------
    lines : dict
        Maps the name of each curve to its points (x, y). Points that are not finite, or not positive on a logarithmic
        axis, are omitted.
    across, up : str
        Names of the axes.
    log : (bool, bool)
        Whether each axis is logarithmic.
    """
    shown = {name: _points(line, log) for name, line in lines.items()}
    every = np.concatenate([np.empty((0, 2)), *shown.values()])
    if not len(every):
        return Markup("")
    low = every.min(axis=0)
    high = every.max(axis=0)
    is_flat = high <= low
    low = np.where(is_flat, low - 0.5, low)
    high = np.where(is_flat, high + 0.5, high)
    floor = HEIGHT - BELOW
    box = np.array([WIDTH - LEFT - 10, 10 - floor])
    parts = [f'<path d="M{LEFT} 10V{floor}H{WIDTH - 10}" stroke="currentColor" fill="none"/>']
    for number, (name, points) in enumerate(shown.items()):
        colour = COLOURS[number % len(COLOURS)]
        pixels = (LEFT, floor) + box * (points - low) / (high - low)
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in pixels)
        parts.append(f'<polyline points="{path}" stroke="{colour}" fill="none"><title>{cell(name)}</title></polyline>')
        if len(lines) > 1:
            parts.append(_text(WIDTH + 5, 20 + 16 * number, name, "start", colour))
    first_x, first_y = _end_labels(low, log)
    last_x, last_y = _end_labels(high, log)
    parts += [
        _text(LEFT, floor + 16, first_x, "start"),
        _text(WIDTH - 10, floor + 16, last_x, "end"),
        _text(LEFT - 5, floor, first_y, "end"),
        _text(LEFT - 5, 18, last_y, "end"),
        _text((LEFT + WIDTH) / 2, HEIGHT - 6, across, "middle"),
        f'<g transform="translate(16 {floor / 2}) rotate(-90)">{_text(0, 0, up, "middle")}</g>',
    ]
    wide = WIDTH + 150 * (len(lines) > 1)
    return Markup(
        f'<svg viewBox="0 0 {wide} {HEIGHT}" width="{wide}" height="{HEIGHT}" font-size="12" role="img" '
        f'stroke-width="1.5" style="max-width: 100%; height: auto">{"".join(parts)}</svg>'
    )


def _end_labels(corner, log):
    """Return the labels of the two axes for a corner of the picture."""
    return [cell(float(10.0**end if is_log else end)) for end, is_log in zip(corner, log)]


def _points(line, log):
    """Return the points of a curve that can be drawn, as rows."""
    points = np.array(list(line), float).reshape(-1, 2)
    points[~((points > 0) | ~np.array(log))] = np.nan
    points = points[np.isfinite(points).all(axis=1)]
    return np.where(log, np.log10(np.where(log, points, 1.0)), points)


def _text(x, y, words, anchor, colour="currentColor"):
    """Return a label of a picture."""
    return f'<text x="{x}" y="{y}" text-anchor="{anchor}" stroke="none" fill="{colour}">{cell(words)}</text>'
