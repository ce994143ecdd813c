"""Compiled loops of `sampling` on the way back: one look at a place for the value, its slopes and its transpose."""

from numba import njit
from numba.extending import register_jitable

from sparsedp.kernels.pointers import address, get, pointer, put
from sparsedp.kernels.sampling_places import both, slope, value

__all__ = ["add", "miss", "sides", "total", "way_back"]


@njit(error_model="numpy")
def total(samples, one, two, three, strides):
    """Product of the weights of three axes with the samples."""
    found = 0.0
    first = one[0] * strides[0] + two[0] * strides[1] + three[0]
    for i in range(len(one[1])):
        plane = 0.0
        for j in range(len(two[1])):
            at, line = first + i * strides[0] + j * strides[1], 0.0
            for k in range(len(three[1])):
                line += three[1][k] * get(samples, at + k)
            plane += two[1][j] * line
        found += one[1][i] * plane
    return found


@njit(error_model="numpy")
def add(samples, one, two, three, strides, number):
    """The transpose of `total`: samples += weights times a number."""
    first = one[0] * strides[0] + two[0] * strides[1] + three[0]
    for i in range(len(one[1])):
        for j in range(len(two[1])):
            at, share = first + i * strides[0] + j * strides[1], number * one[1][i] * two[1][j]
            for k in range(len(three[1])):
                put(samples, at + k, get(samples, at + k) + share * three[1][k])


@njit(error_model="numpy")
def _smooth(samples, one, two, three, strides):
    """Value and slopes from the same samples."""
    first = one[0] * strides[0] + two[0] * strides[1] + three[0]
    found = (0.0, 0.0, 0.0, 0.0)
    for i in range(len(one[1])):
        plane = across = along = 0.0
        for j in range(len(two[1])):
            at, line, steep = first + i * strides[0] + j * strides[1], 0.0, 0.0
            for k in range(len(three[1])):
                number = get(samples, at + k)
                line += three[1][k] * number
                steep += three[2][k] * number
            plane += two[1][j] * line
            across += two[2][j] * line
            along += two[1][j] * steep
        found = (
            found[0] + one[1][i] * plane,
            found[1] + one[2][i] * plane,
            found[2] + one[1][i] * across,
            found[3] + one[1][i] * along,
        )
    return found


@njit(error_model="numpy")
def _look(samples, place, axes, shape, strides, wraps, like):
    """Value and slopes at a place; at a kink the slope is the mean of both sides."""
    one, two, three = axes
    found, first, second, third = _smooth(samples, one, two, three, strides)
    if one[3] or two[3] or three[3]:
        a, b, c = (one[0], one[1]), (two[0], two[1]), (three[0], three[1])
        if one[3]:
            first = total(samples, slope(place[0], shape[0], wraps[0], like[0]), b, c, strides)
        if two[3]:
            second = total(samples, a, slope(place[1], shape[1], wraps[1], like[1]), c, strides)
        if three[3]:
            third = total(samples, a, b, slope(place[2], shape[2], wraps[2], like[2]), strides)
    return found, first, second, third


@njit(error_model="numpy")
def _axes(place, shape, wraps, like):
    """Where a place is along three axes; see `both`."""
    return (
        both(place[0], shape[0], wraps[0], like[0]),
        both(place[1], shape[1], wraps[1], like[1]),
        both(place[2], shape[2], wraps[2], like[2]),
    )


@njit(error_model="numpy")
def _cell(one, two, three, strides, like):
    """First sample of the cell around a place: the inner ones of cubic weights."""
    a, b, c = len(like[0]) // 4, len(like[1]) // 4, len(like[2]) // 4
    return (one[0] + a) * strides[0] + (two[0] + b) * strides[1] + three[0] + c


@njit(error_model="numpy")
def _range(samples, first, strides, like):
    """Least and greatest sample of a cell."""
    least = most = get(samples, first)
    for i in range(min(len(like[0]), 2)):
        for j in range(min(len(like[1]), 2)):
            for k in range(min(len(like[2]), 2)):
                number = get(samples, first + i * strides[0] + j * strides[1] + k)
                least, most = min(least, number), max(most, number)
    return least, most


@njit(error_model="numpy")
def _spread(samples, back, first, strides, like, bound, number):
    """Give a number in equal parts to the samples of a cell that equal the bound."""
    many = 0
    for turn in range(2):
        for i in range(min(len(like[0]), 2)):
            for j in range(min(len(like[1]), 2)):
                for k in range(min(len(like[2]), 2)):
                    at = first + i * strides[0] + j * strides[1] + k
                    if get(samples, at) == bound:
                        if turn:
                            put(back, at, get(back, at) + number / many)
                        else:
                            many += 1


@register_jitable(error_model="numpy")
def sides(samples, w, scale, shape, strides, wraps, like, start, stop, out, low, high):
    """`gather`, and the least and greatest sample of the cell around each place."""
    n, numbers = shape[2], pointer(address(samples), 1.0)
    for row in range(start, stop):
        i, j = divmod(row, shape[1])
        for k in range(n):
            at = row * n + k
            one = value(i - scale[0] * w[0][at], shape[0], wraps[0], like[0])
            two = value(j - scale[1] * w[1][at], shape[1], wraps[1], like[1])
            three = value(k - scale[2] * w[2][at], n, wraps[2], like[2])
            out[at] = total(numbers, one, two, three, strides)
            low[at], high[at] = _range(numbers, _cell(one, two, three, strides, like), strides, like)


@njit(error_model="numpy")
def _turned(out, w, scale, like, at, steep, number, fresh):
    """Write or add the cotangents of the velocities; their product with the velocities."""
    gain = -scale[2] * number * steep[3]
    out[2][at] = gain if fresh else out[2][at] + gain
    rate = gain * w[2][at]
    if len(like[1]) > 1:
        gain = -scale[1] * number * steep[2]
        out[1][at] = gain if fresh else out[1][at] + gain
        rate += gain * w[1][at]
    if len(like[0]) > 1:
        gain = -scale[0] * number * steep[1]
        out[0][at] = gain if fresh else out[0][at] + gain
        rate += gain * w[0][at]
    return rate


@register_jitable(error_model="numpy")
def way_back(samples, w, scale, shape, strides, wraps, like, start, stop, g, back, low, high, out, fresh):
    """`scatter` of g to back, and `slopes` to out (written when fresh), in one look; their product with w.

    low and high, if not empty, are given to the samples that are the least and the greatest of the cell.
    """
    n, numbers, target = shape[2], pointer(address(samples), 1.0), pointer(address(back), 1.0)
    spread, clamped, sums = back.size > 0, low.size > 0, 0.0
    for row in range(start, stop):
        i, j = divmod(row, shape[1])
        rate = 0.0
        for k in range(n):
            at = row * n + k
            number = g[at]
            place = (i - scale[0] * w[0][at], j - scale[1] * w[1][at], k - scale[2] * w[2][at])
            axes = _axes(place, shape, wraps, like)
            one, two, three = axes
            if spread:
                add(target, one, two, three, strides, number)
            if clamped and (low[at] != 0.0 or high[at] != 0.0):
                first = _cell(one, two, three, strides, like)
                least, most = _range(numbers, first, strides, like)
                if low[at] != 0.0:
                    _spread(numbers, target, first, strides, like, least, low[at])
                if high[at] != 0.0:
                    _spread(numbers, target, first, strides, like, most, high[at])
            if out[2].size:
                steep = _look(numbers, place, axes, shape, strides, wraps, like)
                rate += _turned(out, w, scale, like, at, steep, number, fresh)
        sums += rate
    return sums


@njit(error_model="numpy")
def _step(x):
    """1, 1/2, 0 where x > 0, = 0, < 0."""
    return 1.0 if x > 0.0 else (0.5 if x == 0.0 else 0.0)


@register_jitable(error_model="numpy")
def miss(samples, w, scale, shape, strides, wraps, like, start, stop, f, u, g, own, back, low, high, out):
    """The look ahead of MacCormack's way back: what it finds decides what is clamped.

    own = the part of g that is not clamped, low and high (bounds at first) the parts that are; -own / 2 is scattered
    to back, and gives the slopes in out. Returns their product with w.
    """
    n, numbers, target = shape[2], pointer(address(samples), 1.0), pointer(address(back), 1.0)
    clamped, sums = low.size > 0, 0.0
    for row in range(start, stop):
        i, j = divmod(row, shape[1])
        rate = 0.0
        for k in range(n):
            at = row * n + k
            place = (i - scale[0] * w[0][at], j - scale[1] * w[1][at], k - scale[2] * w[2][at])
            axes = _axes(place, shape, wraps, like)
            one, two, three = axes
            steep = _look(numbers, place, axes, shape, strides, wraps, like)
            number = g[at]
            if clamped:
                new = f[at] + 0.5 * (u[at] - steep[0])
                under, over = _step(low[at] - new), _step(new - high[at])
                low[at], high[at] = under * g[at], over * g[at]
                number *= 1.0 - under - over
            own[at] = number
            number *= -0.5
            add(target, one, two, three, strides, number)
            if out[2].size:
                rate += _turned(out, w, scale, like, at, steep, number, True)
        sums += rate
    return sums
