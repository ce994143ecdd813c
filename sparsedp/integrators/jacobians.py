"""Jacobians of a small function at many points, by reverse mode.

A tape goes back once, with all cotangents side by side along a last axis; and tapes of the same calls go back together,
side by side along the axis before it. What a small function takes is the time of Python, for each call, and that once.
Where a call is not known here its cotangents go back one after the other, and its tape by itself.
"""

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.pytree import leaves
from sparsedp.autodiff.derivative import taped
from sparsedp.autodiff.fast_derivatives import ARRAY, FLOAT, ITEM, REAL, Part, by_entry
from sparsedp.autodiff.tape import added, autograd_rules, called, dtype_of
from sparsedp.operators.operator import Operator

__all__ = ["jacobians_of"]

# Functions entry by entry, and those that hand entries of one array on: copied, left out, or in another order.
ENTRYWISE = {
    anp.add, anp.subtract, anp.multiply, anp.true_divide, anp.power, anp.negative, anp.abs, anp.sqrt, anp.square,
    anp.exp, anp.log, anp.sin, anp.cos, anp.tan, anp.sinh, anp.cosh, anp.tanh, anp.maximum, anp.minimum, anp.where,
}  # fmt: skip
PLACES = ITEM, ARRAY  # their pullbacks hand on entries along the first axes: more axes at the end do not matter
SELECTIONS = {ITEM, anp.reshape, anp.ravel, anp.roll, anp.repeat, anp.transpose}


def jacobians_of(fun, trees, moving):
    """A function at many trees of floating values -> its values, and its derivatives in all leaves that move.

    Parameters
    ----------
    fun : callable
        ``fun(tree)``: a tree of m real numbers in all.
    trees : list of trees
        Of the same structure and shapes; plain.
    moving : list of bool
        For each leaf.

    Returns
    -------
    (array (trees, m), array (trees, m, numbers that move))

    Examples
    --------
    >>> values, rows = jacobians_of(lambda x: anp.array([x[0] * x[1], x[0]]), [np.array([2.0, 5.0])], [True])
    >>> rows.tolist()
    [[[5.0, 2.0], [1.0, 0.0]]]
    """
    calls: dict = {}  # what `_batched` says of nodes whose own pullbacks do not take many cotangents

    def see(node, fun, *call):
        if not (node.vjp in by_entry or node.held and fun in PLACES):
            calls[node] = _batched(node, fun, *call)

    tapes, groups = [taped(fun, tree, moving, see) for tree in trees], []  # type: list, list
    for number, tape in enumerate(tapes):
        kinds = _kinds(tape, calls) if len(tapes) > 1 else None
        group = next((group for known, group in groups if known == kinds), None)
        if group is None:
            groups.append((kinds, group := []))
        group.append(number)
    values = np.array([np.concatenate([*map(np.ravel, tape.values)]) for tape in tapes])
    sizes = [np.size(leaf) for leaf, moves in zip(leaves(trees[0]), moving, strict=True) if moves]
    rows = np.zeros((*values.shape, sum(sizes)))
    for _, group in groups:
        found = _rows([tapes[number] for number in group], values.shape[1], calls)
        for g, size, stop in zip(found, sizes, np.cumsum(sizes), strict=True):
            if g is not None:
                rows[group, :, stop - size : stop] = np.moveaxis(g.reshape(size, len(group), values.shape[1]), 0, -1)
    return values, rows


def _kinds(tape, calls):
    """What tapes have in common that go back together: the kinds of their calls, and of which results these are."""
    places: dict = {node: place for place, node in enumerate((None, *tape.roots, *tape.nodes))}
    found: list = [places[end] for end in tape.ends]
    for node in tape.nodes:
        if node not in calls:
            kind = node.vjp, [getattr(x, "shape", x) for x in node.held]
        else:
            kind = calls[node][0] if calls[node] else node
        found.append((kind, [places[parent] for parent in node.parents]))
    return found


def _rows(tapes, size, calls):
    """For each root the derivatives of all numbers of the result, (*shape, tapes, size), or None."""
    count, first = len(tapes), tapes[0]
    sums: dict = {}

    def add(parent, g):
        total, ours = sums.get(parent, (None, False))
        if type(g) is not Part:
            sums[parent] = (g, False) if total is None else (total + g, True)
            return
        part, index, shape = g
        if not ours:  # a sum that was made here is written into
            total = np.zeros((*shape, count, size)) if total is None else np.array(total)
            sums[parent] = total, True
        if index is Ellipsis or type(index) is tuple and Ellipsis in index:  # the last axes are others then
            total, part = (np.moveaxis(x, (-2, -1), (0, 1)) for x in (total, part))
            index = slice(None), slice(None), *(index if type(index) is tuple else (index,))
        total[index] += part

    units = np.split(np.eye(size), np.cumsum([*map(np.size, first.values)])[:-1])
    for end, value, unit in zip(first.ends, first.values, units, strict=True):
        if end is not None:
            add(end, np.repeat(unit.reshape(*np.shape(value), 1, size), count, -2))
    for nodes in zip(*(reversed(tape.nodes) for tape in tapes), strict=True):
        node = nodes[0]
        if node not in sums:
            continue
        g, _ = sums.pop(node)
        if node not in calls:
            backs = node.vjp(g, *_beside([node.held for node in nodes]))
        elif calls[node]:
            backs = calls[node][2](g, [calls[node][1] for node in nodes])
        else:  # of one tape, one cotangent after the other
            ones = g if type(g) is Several else np.ascontiguousarray(np.moveaxis(g[..., 0, :], -1, 0))
            columns = zip(*(node.vjp(one, *node.held) for one in ones), strict=True)
            backs = [_joined([added(None, back)[0] for back in column]) for column in columns]
        for parent, back in zip(node.parents, backs, strict=True):
            add(parent, back)
    return [sums.get(root, (None,))[0] for root in first.roots if root is not None]


class Several(list):
    """Cotangents of a call with several results: they have no common shape, and stand one after the other."""

    def __add__(self, other):
        return Several(added((one, False), two)[0] for one, two in zip(self, other, strict=True))


def _joined(column):
    """Cotangents of one tape, side by side."""
    return Several(column) if isinstance(column[0], (tuple, list)) else np.stack(column, -1)[..., None, :]


def _beside(rows):
    """What calls of a function hold, beside their cotangents."""
    found: list = []
    for column in zip(*rows, strict=True):
        x = column[0]
        if type(x) is not np.ndarray and column.count(x) == len(column):
            found.append(x)  # as a power of 2 that the function names
        else:
            found.append(np.stack(column, -1)[..., None])
    return found


# ---- calls that take many cotangents ---------------------------------------------------------------------------------


def _batched(node, fun, value, args, options, nums):
    """A call -> (what it has in common with calls it may go back with, what it holds, act), or None.

    ``act(g, rows)``: cotangents (*shape of the value, calls, many), what each call holds -> those of the arguments.
    """
    traced = [args[num] for num in nums]
    if any(type(x) not in REAL or dtype_of(x) is not FLOAT for x in (value, *traced)):
        return None
    shapes = [np.shape(x) for x in traced]
    if fun in SELECTIONS:
        return _selection(fun, args, options, nums, *shapes)
    if options:
        return None
    if fun in ENTRYWISE:
        return _entrywise(node, fun, value, args, nums, shapes)
    if fun is anp.concatenate_args and args[0] == 0:
        cuts = np.cumsum([0, *map(len, args[1:])]).tolist()
        return [fun, nums, cuts], (), lambda g, rows: [g[cuts[num - 1] : cuts[num]] for num in nums]
    if isinstance(op := called(fun, args), Operator):
        return [id(op)], (), lambda g, rows: [_transposed(op, g)]
    if fun in (anp.dot, anp.matmul) and [*map(np.ndim, args)] == [2, 1]:
        return [fun, nums, np.shape(args[0])], args, lambda g, rows: _product(nums, g, rows)
    if fun is anp.sum and len(args) == 1:
        return [fun, *shapes], (), lambda g, rows: [np.broadcast_to(g, (*shapes[0], *g.shape))]
    return None


def _entrywise(node, fun, value, args, nums, shapes):
    """By the slope in each entry; what was spread is added up."""
    shape = np.shape(value)
    if all(known == shape for known in shapes):
        slopes = node.vjp(np.ones(shape), *node.held)
    else:
        spread = [np.broadcast_to(x, shape) if num in nums else x for num, x in enumerate(args)]
        slopes = autograd_rules(fun)[0](nums, value, spread, {})(np.ones(shape))

    def act(g, rows):
        return [_summed(g * slope, known) for slope, known in zip(_beside(rows), shapes, strict=True)]

    return [fun, shape, *shapes], slopes, act


def _summed(g, shape):
    """What was spread from a shape, added up."""
    before = (*[1] * (g.ndim - 2 - len(shape)), *shape)
    axes = tuple(axis for axis, n in enumerate(before) if n != g.shape[axis])
    return np.sum(g, axes).reshape(*shape, *g.shape[-2:])


def _selection(fun, args, options, nums, shape):
    """By the number of the entry that each one of the result is."""
    numbers = np.arange(int(np.prod(shape))).reshape(shape)
    places = np.asarray(fun.fun(*(numbers if num in nums else arg for num, arg in enumerate(args)), **options))

    def act(g, rows):
        found = np.zeros((numbers.size, *g.shape[-2:]))
        np.add.at(found, places, g)
        return [found.reshape(*shape, *g.shape[-2:])]

    return [fun, places.shape, places.tobytes(), shape], (), act


def _transposed(op, g):
    if op.form == "explicit" and g.ndim == 2 + len(op.codomain.shape):
        return (op.matrix.T @ g.reshape(op.shape[0], -1)).reshape(*op.domain.shape, *g.shape[-2:])
    return np.moveaxis(op.T.apply(np.moveaxis(g, (-2, -1), (0, 1))), (0, 1), (-2, -1))


def _product(nums, g, rows):
    """Of a matrix and a vector."""
    A, x = (np.stack(column, -1) for column in zip(*rows, strict=True))
    return [np.einsum("mkc,mcj->kcj", A, g) if num else g[:, None] * x[..., None] for num in nums]
