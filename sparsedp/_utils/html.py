"""Values as HTML, for notebooks and for the page of a report: tables, curves and the entries of a matrix.

What stands here needs no other package and no network: tables are plain HTML, pictures are SVG. It looks right on
light and dark pages, for it takes their colour of text.
"""

from html import escape
from math import isnan

import numpy as np

__all__ = ["Markup", "cell", "curves", "facts", "folded", "paragraphs", "spy", "table", "text_of"]

# Of Okabe and Ito: safe for all eyes.
COLOURS = "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#999999"
WIDTH, HEIGHT, LEFT, BELOW = 420, 260, 60, 40  # of a picture, and of what is left for its labels [pixels]
SHORT = 20  # letters of a cell that stay on one line
SPOTS = 48  # a matrix is drawn as at most so many squares a side


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()

    def _repr_html_(self):
        return self


def text_of(value, digits):
    """A value in words: so many digits of a float, nothing for NaN and None."""
    if isinstance(value, (float, np.floating)):
        return "" if isnan(value) else f"{value:.{digits}g}"
    return "" if value is None else str(value)


def cell(value):
    """A value as HTML: three digits of a float, nothing for NaN and None."""
    return value if isinstance(value, Markup) else escape(text_of(value, 3))


def table(rows, head=(), title=""):
    """Rows of values, names of the columns -> a table."""
    lines = [f"<caption>{cell(title)}</caption>"] if title else []
    if head:
        lines.append(f"<thead><tr>{''.join(f'<th>{cell(name)}</th>' for name in head)}</tr></thead>")
    body = (f"<tr>{''.join(map(_in_table, row))}</tr>" for row in rows)
    return Markup("\n".join(["<table>", *lines, "<tbody>", *body, "</tbody>", "</table>"]))


def _in_table(value):
    """A cell of a table; a number or a word is not broken."""
    text = cell(value)
    return f'<td nowrap="nowrap">{text}</td>' if len(text) <= SHORT else f"<td>{text}</td>"


def facts(title, entries):
    """A title and a dict -> a table of two columns, without the entries that are None."""
    return table([line for line in entries.items() if line[1] is not None], title=title)


def paragraphs(lines, tag="p"):
    """Lines -> a paragraph of each, or another element."""
    return Markup("\n".join(f"<{tag}>{cell(line)}</{tag}>" for line in lines))


def folded(title, lines):
    """Lines that are seen after a click on the title, as a list; nothing without any."""
    body = f"<details><summary>{cell(title)}</summary><ul>\n{paragraphs(lines, 'li')}\n</ul></details>"
    return Markup(body if lines else "")


def spy(matrix):
    """Sparse matrix -> a picture of where its entries are: a dark square holds many."""
    rows, columns = matrix.shape
    many = matrix.tocoo()
    size = max(rows, columns, 1)
    side = min(size, SPOTS)
    places = np.stack([many.row, many.col]).astype(np.int64) * side // size
    spots, counts = np.unique(places, axis=1, return_counts=True)
    squares = (
        f'<rect x="{column}" y="{row}" width="1" height="1" opacity="{0.3 + 0.7 * count / counts.max():.2f}"/>'
        for (row, column), count in zip(spots.T.tolist(), counts)
    )
    width, height = (max(1, -(-length * side // size)) for length in (columns, rows))
    return Markup(
        f'<svg viewBox="0 0 {width} {height}" width="{3 * width}" height="{3 * height}" fill="currentColor" role="img" '
        f'style="border: 1px solid"><title>entries</title>{"".join(squares)}</svg>'
    )


def curves(lines, across, up, *, log=(False, True)):
    """Lines {name: points (x, y)} -> a picture of them; empty where nothing can be drawn.

    across, up: names of the axes; log: whether each is logarithmic. Points that are not finite, or not positive on such
    an axis, are left out.
    """
    shown = {name: _points(line, log) for name, line in lines.items()}
    every = np.concatenate([np.empty((0, 2)), *shown.values()])
    if not len(every):
        return Markup("")
    low, high = every.min(axis=0), every.max(axis=0)
    low, high = np.where(high > low, (low, high), (low - 0.5, high + 0.5))
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
    ends = [[cell(float(10.0**end if scale else end)) for end, scale in zip(corner, log)] for corner in (low, high)]
    parts += [
        _text(LEFT, floor + 16, ends[0][0], "start"), _text(WIDTH - 10, floor + 16, ends[1][0], "end"),
        _text(LEFT - 5, floor, ends[0][1], "end"), _text(LEFT - 5, 18, ends[1][1], "end"),
        _text((LEFT + WIDTH) / 2, HEIGHT - 6, across, "middle"),
        f'<g transform="translate(16 {floor / 2}) rotate(-90)">{_text(0, 0, up, "middle")}</g>',
    ]  # fmt: skip
    wide = WIDTH + 150 * (len(lines) > 1)
    return Markup(
        f'<svg viewBox="0 0 {wide} {HEIGHT}" width="{wide}" height="{HEIGHT}" font-size="12" role="img" '
        f'stroke-width="1.5" style="max-width: 100%; height: auto">{"".join(parts)}</svg>'
    )


def _points(line, log):
    """The points of a line that can be drawn, as rows."""
    points = np.array(list(line), float).reshape(-1, 2)
    points[~((points > 0) | ~np.array(log))] = np.nan
    points = points[np.isfinite(points).all(axis=1)]
    return np.where(log, np.log10(np.where(log, points, 1.0)), points)


def _text(x, y, words, anchor, colour="currentColor"):
    return f'<text x="{x}" y="{y}" text-anchor="{anchor}" stroke="none" fill="{colour}">{cell(words)}</text>'
