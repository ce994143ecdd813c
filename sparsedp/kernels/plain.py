"""NumPy twins of the compiled kernels: in pieces that stay in cache, through small reused buffers.

A complex field is handled as a real one with two numbers a cell. Products and sums are float64.
"""

from itertools import product
from typing import Any

import numpy as np

__all__ = ["along_axis", "kronecker_sum", "sweep"]

PIECE = 32768  # numbers handled at a time: input, output and buffers fit in L2
FEW = 16  # changes of a coefficient that are worth a cut; lines that are worth looking for changes
WHOLE = 16384  # fields with fewer numbers are handled at once


# ---------------------------------------------------------------- sum of tridiagonal matrices


def _real(array):
    """(a, b, c) field -> (a, b, c) or, when it is complex, (a, b, 2 c) numbers."""
    return array.view(array.real.dtype) if array.dtype.kind == "c" else array


def _pieces(size, most, cuts=()):
    """Ranges that cover range(size), none longer than `most`, none across a cut."""
    ends = sorted({0, size, *cuts})
    spans = zip(ends, ends[1:], strict=False)
    return [(a, min(a + most, end)) for start, end in spans for a in range(start, end, most)]


def _boxes(sizes, cuts):
    """Boxes of at most PIECE numbers that cover a field, and whether their coefficients are constant.

    Where rows fit, a constant box spans whole rows, because NumPy is slow on cut ones; the boxes of
    the ends of the rows come later and put them right.
    """
    constant = cuts[2]
    for columns in sorted(_pieces(sizes[2], PIECE, constant), key=lambda piece: piece[0] not in range(*constant)):
        inside = constant[0] <= columns[0] < constant[1]
        if columns == constant and sizes[2] <= PIECE:
            columns = 0, sizes[2]
        room = max(1, PIECE // (columns[1] - columns[0]))
        for rows in _pieces(sizes[1], room, cuts[1] if inside else ()):
            here = inside and cuts[1][0] <= rows[0] < cuts[1][1]
            for planes in _pieces(sizes[0], max(1, room // (rows[1] - rows[0])), cuts[0] if here else ()):
                yield (planes, rows, columns), here and cuts[0][0] <= planes[0] < cuts[0][1]


def _add_up(views, total):
    """Sum of one or more arrays."""
    if len(views) > 1:
        np.add(views[0], views[1], out=total, dtype=np.float64)
    else:
        np.copyto(total, views[0])
    for view in views[2:]:
        np.add(total, view, out=total)


class _Sum:
    """The data of one call: coefficients for numbers, distances of neighbours, buffers."""

    def __init__(self, u, out, axes, shift):
        near = 2 if u.dtype.kind == "c" else 1
        self.u, self.out, self.shift = _real(u), _real(out), float(shift)
        self.lines: list[Any] = []  # (axis, its distance of neighbours, lower, centre, upper)
        self.constant: list[tuple[int, int]] = []
        self.groups: dict[float, list] = {}
        for axis, (line, size) in enumerate(zip(axes, self.u.shape, strict=True)):
            first, last = 0, size
            if line is not None:
                step = near if axis == 2 else 1
                values = (np.repeat(x, step) if step > 1 else x for x in line[:3])
                shape = [-1 if k == axis else 1 for k in range(3)]
                self.lines.append((axis, step, *(x.reshape(shape) for x in values)))
                # The first and the last cell may have a neighbour elsewhere: they are never in the constant part.
                first, last = max(line.first * step, step), min(line.last * step, size - step)
            self.constant.append((first, last) if first < last else (0, 0))

    def run(self):
        whole = self.u.size <= WHOLE
        boxes = [(tuple((0, n) for n in self.u.shape), False)] if whole else _boxes(self.u.shape, self.constant)
        self.weights()
        buffers = np.empty((2, self.u.size if whole else PIECE))
        for box, inside in boxes:
            shape = [b - a for a, b in box]
            here = tuple(slice(a, b) for a, b in box)
            buffer, total = (piece[: shape[0] * shape[1] * shape[2]].reshape(shape) for piece in buffers)
            exact = self.u.dtype == np.float64  # else sums are rounded once, at the end
            total = self.out[here] if exact else total
            (self.inner if inside else self.outer)(box, here, total, buffer)
            if not exact:
                self.out[here] = total

    def weights(self):
        """Constant coefficients: of the cell, and of groups of neighbours that share one."""
        self.centre = self.shift
        self.groups.clear()
        for axis, step, lower, centre, upper in self.lines:
            first = self.constant[axis][0]
            self.centre += float(centre.flat[first])
            self.groups.setdefault(float(lower.flat[first]), []).append((axis, -step))
            self.groups.setdefault(float(upper.flat[first]), []).append((axis, step))

    def moved(self, box, axis, move):
        return self.u[tuple(slice(a + move, b + move) if k == axis else slice(a, b) for k, (a, b) in enumerate(box))]

    def inner(self, box, here, total, buffer):
        """Constant coefficients: neighbours with equal ones are added before they are multiplied."""
        np.multiply(self.u[here], self.centre, out=total, dtype=np.float64)
        (a, b), (first, last) = box[2], self.constant[2]
        middle = max(a, first), min(b, last)
        short = slice(None), slice(None), slice(middle[0] - a, middle[1] - a)
        for weight, moves in self.groups.items():
            views = [self.moved(box, *move) for move in moves if move[0] < 2]
            along = [self.moved((*box[:2], middle), *move) for move in moves if move[0] == 2]
            if views:
                _add_up(views, buffer)
                for view in along:
                    np.add(buffer[short], view, out=buffer[short])
                np.multiply(buffer, weight, out=buffer)
                np.add(total, buffer, out=total)
            else:
                _add_up(along, buffer[short])
                np.multiply(buffer[short], weight, out=buffer[short])
                np.add(total[short], buffer[short], out=total[short])

    def outer(self, box, here, total, buffer):
        """Any coefficients, and the ends of the axes."""
        centre = self.shift
        for axis, _, _, values, _ in self.lines:
            centre = centre + self.cut(values, axis, *box[axis])
        np.multiply(self.u[here], centre, out=total, dtype=np.float64)
        for axis, step, lower, _, upper in self.lines:
            size, (a, b) = self.u.shape[axis], box[axis]
            self.add(box, axis, lower, -step, max(a, step), b, total, buffer)
            self.add(box, axis, upper, step, a, min(b, size - step), total, buffer)
            if a < step and lower.flat[a] != 0:
                self.add(box, axis, lower, size - step, a, min(b, step), total, buffer)
            if b > size - step and upper.flat[b - 1] != 0:
                self.add(box, axis, upper, step - size, max(a, size - step), b, total, buffer)

    def cut(self, values, axis, start, stop):
        return values[tuple(slice(start, stop) if k == axis else slice(None) for k in range(3))]

    def add(self, box, axis, weights, move, start, stop, total, buffer):
        """Add weight * neighbour for the cells start:stop of an axis."""
        if start >= stop:
            return
        corner = box[axis][0]
        part = tuple(slice(start - corner, stop - corner) if k == axis else slice(None) for k in range(3))
        source = self.moved([(start, stop) if k == axis else side for k, side in enumerate(box)], axis, move)
        np.multiply(source, self.cut(weights, axis, start, stop), out=buffer[part], dtype=np.float64)
        np.add(total[part], buffer[part], out=total[part])


def kronecker_sum(u, out, axes, shift):
    """See `sparsedp.kernels.kronecker_sum`."""
    if u.size:
        _Sum(u, out, axes, shift).run()


# ---------------------------------------------------------------- sparse matrix along an axis


def _weights(values, shape):
    """Coefficients along the middle axis, as one number where they are equal: NumPy is much faster with that."""
    same = shape[0] * shape[2] >= FEW and values[0] == values[-1] and np.all(values == values[0])
    return float(values[0]) if same else values.reshape(1, -1, 1)


def _changes(rows):
    """Places where the coefficients of a diagonal change, if there are only a few of them."""
    places: set[int] = set()
    for d in range(len(rows.offsets)):
        start, stop = int(rows.start[d]), int(rows.stop[d])
        steps = np.flatnonzero(np.diff(rows.values[d, start:stop])) + start + 1
        places.update((start, stop), steps.tolist() if steps.size < FEW else ())
    return places


def _diagonals(u, rows, scale, left, right, total, buffer):
    """scale * sum of the diagonals over rows left:right -> total."""
    written = left  # rows before this one hold a part of the sum already
    for d in np.argsort(rows.start, kind="stable"):
        start, stop = max(left, int(rows.start[d])), min(right, int(rows.stop[d]))
        if start >= stop:
            continue
        source = u[:, start + rows.offsets[d] : stop + rows.offsets[d]]
        weights = scale * _weights(rows.values[d, start:stop], total.shape)
        if start >= written:
            total[:, written - left : start - left] = 0.0
            np.multiply(source, weights, out=total[:, start - left : stop - left], dtype=np.float64)
        else:
            total[:, written - left : max(stop, written) - left] = 0.0
            part, sums = buffer[:, start - left : stop - left], total[:, start - left : stop - left]
            np.multiply(source, weights, out=part, dtype=np.float64)
            np.add(sums, part, out=sums)
        written = max(written, stop)
    total[:, written - left :] = 0.0


def _entries(u, rows, scale, left, right, total, buffer):
    """scale * sum of the first entries of all rows left:right, then of the second ones ... -> total."""
    total[...] = 0.0
    first, last = rows.indptr[left:right], rows.indptr[left + 1 : right + 1]
    for entry in range(int(np.max(last - first, initial=0))):
        places = np.flatnonzero(first + entry < last)
        which = first[places] + entry
        total[:, places] += u[:, rows.indices[which]] * (scale * rows.data[which]).reshape(1, -1, 1)


def along_axis(u, out, rows, scale, accumulate):
    """See `sparsedp.kernels.along_axis`."""
    if not out.size:
        return
    u, out = _real(u), _real(out)
    count, n, length = out.shape
    # A row may need any column: u is cut only along the other two axes.
    wide = min(length, PIECE)
    high = min(n, max(1, PIECE // wide))
    deep = min(count, max(1, PIECE // (wide * high)))
    buffers = np.empty((2, deep * high * wide))
    add_up = _diagonals if len(rows.offsets) else _entries
    exact = out.dtype == np.float64 and not accumulate
    cuts = _changes(rows) if count * length >= FEW else ()
    pieces = product(_pieces(count, deep), _pieces(length, wide), _pieces(n, high, cuts))
    for (i, j), (a, b), (left, right) in pieces:
        shape = (j - i, right - left, b - a)
        buffer, total = (piece[: shape[0] * shape[1] * shape[2]].reshape(shape) for piece in buffers)
        target = out[i:j, left:right, a:b]
        total = target if exact else total
        add_up(u[i:j, :, a:b], rows, float(scale), left, right, total, buffer)
        if accumulate:
            np.add(target, total, out=total)
        if not exact:
            target[...] = total


# ---------------------------------------------------------------- elimination along the first axis


def sweep(x, lower, upper, inverses, column, row, ends):
    """See `sparsedp.kernels.sweep`."""
    wide = min(x.shape[1], 8192)  # columns at a time: the rows in use and the buffers stay in L2
    buffers = np.empty((2, wide))
    for a, b in _pieces(x.shape[1], wide):
        here = slice(a, b)
        end = int(np.max(ends[here], initial=0))
        _eliminate(x[:, here], lower, upper, inverses[:, here], column[:, here], row[:, here], end, buffers[:, : b - a])


def _eliminate(x, lower, upper, inverses, column, row, end, buffers):
    """Down all rows, gathering the last one of a periodic axis on the way, and up again."""
    n, cyclic = len(x), int(row.size > 0)
    buffer, more = buffers
    for i in range(n - cyclic):
        if i:
            np.multiply(x[i - 1], lower[i], out=buffer)
            np.subtract(x[i], buffer, out=x[i])
        np.multiply(x[i], inverses[i], out=x[i])
        if cyclic and (i < end or i == n - 2):
            np.multiply(row[i], x[i], out=buffer)
            np.subtract(x[-1], buffer, out=x[-1])
    if cyclic:
        np.multiply(x[-1], inverses[-1], out=x[-1])
    for i in range(n - 2, -1, -1):
        if cyclic:
            np.multiply(column[i], x[-1], out=more)
        if i < n - 1 - cyclic:
            np.multiply(x[i + 1], upper[i], out=buffer)
            more = np.add(buffer, more, out=more) if cyclic else buffer
        np.multiply(more, inverses[i], out=buffer)
        np.subtract(x[i], buffer, out=x[i])
