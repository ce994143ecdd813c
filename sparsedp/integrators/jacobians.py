"""Jacobians of a small function at many points, in reverse mode.

All rows of a Jacobian are computed in one backward pass over a tape, with the cotangents batched along the last axis.
Tapes with the same calls (at different points) are also processed together, batched along the axis before it. For a
small function most of the time is the overhead of Python for each call, which batching divides by the batch size. If a
call is not supported here, its cotangents are propagated one after the other, and its tape is not batched with others.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.pytree import leaves
from sparsedp.autodiff.derivative import taped
from sparsedp.autodiff.fast_derivatives import ARRAY, FLOAT, ITEM, REAL, Part, by_entry
from sparsedp.autodiff.tape import added, autograd_rules, called, dtype_of
from sparsedp.operators.operator import Operator

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

__all__ = ["jacobians_of"]

# Elementwise functions. SELECTIONS below are functions whose result consists of entries of one array.
ENTRYWISE = {
    anp.add,
    anp.subtract,
    anp.multiply,
    anp.true_divide,
    anp.power,
    anp.negative,
    anp.abs,
    anp.sqrt,
    anp.square,
    anp.exp,
    anp.log,
    anp.sin,
    anp.cos,
    anp.tan,
    anp.sinh,
    anp.cosh,
    anp.tanh,
    anp.maximum,
    anp.minimum,
    anp.where,
}
PLACES = ITEM, ARRAY  # the pullbacks of these act on the first axes, so that batch axes may follow
SELECTIONS = {ITEM, anp.reshape, anp.ravel, anp.roll, anp.repeat, anp.transpose}


def jacobians_of(fun: Callable, trees: Sequence, moving: Sequence[bool]) -> tuple[np.ndarray, np.ndarray]:
    """Return the values and the Jacobians of a function at several points, each of which is a tree.

    Parameters
    ----------
    fun : callable
        ``fun(tree)`` returns a tree with m real numbers in total.
    trees : list of trees
        The points: plain trees of equal structure and shapes.
    moving : list of bool
        For each leaf, whether it is differentiated.

    Returns
    -------
    values : array, shape (number of trees, m)
    jacobians : array, shape (number of trees, m, k)
        Derivatives with respect to the k entries of the differentiated leaves.

    Examples
    --------
    >>> values, rows = jacobians_of(lambda x: anp.array([x[0] * x[1], x[0]]), [np.array([2.0, 5.0])], [True])
    >>> rows.tolist()
    [[[5.0, 2.0], [1.0, 0.0]]]
    """
    batched_calls: dict = {}  # node whose own pullback does not accept batched cotangents -> result of `_batched`

    def add_batched_call(node: Any, fun: Any, *call: Any) -> None:
        if not (node.vjp in by_entry or (node.held and fun in PLACES)):
            batched_calls[node] = _batched(node, fun, *call)

    tapes = [taped(fun, tree, moving, add_batched_call) for tree in trees]
    values = np.array([np.concatenate([*map(np.ravel, tape.values)]) for tape in tapes])
    sizes = [np.size(leaf) for leaf, moves in zip(leaves(trees[0]), moving, strict=True) if moves]
    rows = np.zeros((*values.shape, sum(sizes)))
    m = values.shape[1]
    for group in _groups(tapes, batched_calls):
        derivatives = _rows([tapes[number] for number in group], m, batched_calls)
        for g, size, stop in zip(derivatives, sizes, np.cumsum(sizes), strict=True):
            if g is not None:
                rows[group, :, stop - size : stop] = np.moveaxis(g.reshape(size, len(group), m), 0, -1)
    return values, rows


def _groups(tapes: list, batched_calls: dict) -> list[list[int]]:
    """Return groups of indices of tapes that can be processed together."""
    if len(tapes) == 1:
        return [[0]]
    groups: list[tuple[list, list[int]]] = []
    for number, tape in enumerate(tapes):
        kinds = _kinds(tape, batched_calls)
        for others, group in groups:
            if others == kinds:
                group.append(number)
                break
        else:
            groups.append((kinds, [number]))
    return [group for _, group in groups]


def _kinds(tape: Any, batched_calls: dict) -> list:
    """Return a description of the calls of a tape and their arguments, which is equal for tapes of one group."""
    places: dict = {node: place for place, node in enumerate((None, *tape.roots, *tape.nodes))}
    kinds: list = [places[end] for end in tape.ends]
    for node in tape.nodes:
        if node not in batched_calls:
            kind = node.vjp, [getattr(x, "shape", x) for x in node.held]
        else:
            batched = batched_calls[node]
            if batched:
                kind = batched[0]
            else:
                kind = node
        kinds.append((kind, [places[parent] for parent in node.parents]))
    return kinds


def _rows(tapes: list, size: int, batched_calls: dict) -> list:
    """Return for each root the derivatives of all entries of the result, of shape (*shape, tapes, size), or None."""
    count = len(tapes)
    first = tapes[0]
    sums: dict = {}  # node -> (sum of its cotangents, whether the sum may be modified in place)

    def add(parent: Any, g: Any) -> None:
        total, is_ours = sums.get(parent, (None, False))
        if type(g) is not Part:
            if total is None:
                sums[parent] = (g, False)
            else:
                sums[parent] = (total + g, True)
            return
        part, index, shape = g
        if not is_ours:
            if total is None:
                total = np.zeros((*shape, count, size))
            else:
                total = np.array(total)
            sums[parent] = total, True
        if index is Ellipsis or (type(index) is tuple and Ellipsis in index):  # it counts from the last axes
            total = np.moveaxis(total, (-2, -1), (0, 1))
            part = np.moveaxis(part, (-2, -1), (0, 1))
            index = (slice(None), slice(None), *(index if type(index) is tuple else (index,)))
        total[index] += part

    units = np.split(np.eye(size), np.cumsum([*map(np.size, first.values)])[:-1])
    for end, value, unit in zip(first.ends, first.values, units, strict=True):
        if end is not None:
            add(end, np.repeat(unit.reshape(*np.shape(value), 1, size), count, -2))
    for nodes in zip(*(reversed(tape.nodes) for tape in tapes), strict=True):
        if nodes[0] in sums:
            g, _ = sums.pop(nodes[0])
            for parent, back in zip(nodes[0].parents, _pulled(nodes, g, batched_calls), strict=True):
                add(parent, back)
    return [sums.get(root, (None,))[0] for root in first.roots if root is not None]


def _pulled(nodes: Sequence, g: Any, batched_calls: dict) -> Any:
    """Return the batched cotangents of the arguments of a group of equal calls, given those of their results."""
    node = nodes[0]
    if node not in batched_calls:
        return node.vjp(g, *_side_by_side([node.held for node in nodes]))
    if batched_calls[node]:
        act = batched_calls[node][2]
        return act(g, [batched_calls[node][1] for node in nodes])
    # A call of one tape, one cotangent after the other.
    cotangents: Any = g
    if type(g) is not CotangentList:
        cotangents = np.ascontiguousarray(np.moveaxis(g[..., 0, :], -1, 0))
    columns = zip(*(node.vjp(one, *node.held) for one in cotangents), strict=True)
    return [_joined([added(None, back)[0] for back in column]) for column in columns]


class CotangentList(list):
    """List of the cotangents of a call with several results, which cannot be stacked to one array."""

    def __add__(self, other: Any) -> CotangentList:
        """Return the elementwise sum."""
        return CotangentList(added((one, False), two)[0] for one, two in zip(self, other, strict=True))


def _joined(column: list) -> Any:
    """Stack the cotangents of one tape along the batch axes."""
    if isinstance(column[0], (tuple, list)):
        return CotangentList(column)
    return np.stack(column, -1)[..., None, :]


def _side_by_side(rows: Sequence) -> list:
    """Stack the `held` values of several calls of one function along the batch axes."""
    columns: list = []
    for column in zip(*rows, strict=True):
        x = column[0]
        if type(x) is not np.ndarray and column.count(x) == len(column):
            columns.append(x)  # as the exponent of a power
        else:
            columns.append(np.stack(column, -1)[..., None])
    return columns


# ---- calls with batched cotangents -----------------------------------------------------------------------------------


def _batched(node: Any, fun: Any, value: Any, args: Any, options: Any, nums: Any) -> tuple | None:
    """Return the batched form of a call, or None.

    Returns
    -------
    kind : list
        Equal for calls that can be processed together.
    held : sequence
        The values that the pullback of this call needs.
    act : callable
        ``act(g, rows)`` returns the cotangents of the arguments. `g` has the shape (*shape of the result, calls,
        cotangents), and `rows` are the `held` values of each call.
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
    op = called(fun, args)
    if isinstance(op, Operator):
        return [id(op)], (), lambda g, rows: [_transposed(op, g)]
    if fun in (anp.dot, anp.matmul) and [*map(np.ndim, args)] == [2, 1]:
        return [fun, nums, np.shape(args[0])], args, lambda g, rows: _product(nums, g, rows)
    if fun is anp.sum and len(args) == 1:
        return [fun, *shapes], (), lambda g, rows: [np.broadcast_to(g, (*shapes[0], *g.shape))]
    return None


def _entrywise(node: Any, fun: Any, value: Any, args: Any, nums: Any, shapes: list) -> tuple:
    """Return the batched form of an elementwise function: a product with its derivative, summed if broadcast."""
    shape = np.shape(value)
    if all(other == shape for other in shapes):
        slopes = node.vjp(np.ones(shape), *node.held)
    else:
        spread = [np.broadcast_to(x, shape) if num in nums else x for num, x in enumerate(args)]
        slopes = autograd_rules(fun)[0](nums, value, spread, {})(np.ones(shape))

    def act(g: Any, rows: Any) -> list:
        pairs = zip(_side_by_side(rows), shapes, strict=True)
        return [_summed(g * slope, other) for slope, other in pairs]

    return [fun, shape, *shapes], slopes, act


def _summed(g: np.ndarray, shape: tuple) -> np.ndarray:
    """Sum the cotangent of an array that was broadcast from a shape."""
    padded = (*[1] * (g.ndim - 2 - len(shape)), *shape)
    axes = tuple(axis for axis, n in enumerate(padded) if n != g.shape[axis])
    return np.sum(g, axes).reshape(*shape, *g.shape[-2:])


def _selection(fun: Any, args: Any, options: Any, nums: Any, shape: tuple) -> tuple:
    """Return the batched form of a function that selects entries: cotangents are added to the selected entries."""
    numbers = np.arange(int(np.prod(shape))).reshape(shape)
    arguments = [numbers if num in nums else arg for num, arg in enumerate(args)]
    places = np.asarray(fun.fun(*arguments, **options))

    def act(g: Any, rows: Any) -> list:
        total = np.zeros((numbers.size, *g.shape[-2:]))
        np.add.at(total, places, g)
        return [total.reshape(*shape, *g.shape[-2:])]

    return [fun, places.shape, places.tobytes(), shape], (), act


def _transposed(op: Operator, g: np.ndarray) -> np.ndarray:
    """Apply the transpose of an operator to many cotangents."""
    if op.form == "explicit" and g.ndim == 2 + len(op.codomain.shape):
        return (op.matrix.T @ g.reshape(op.shape[0], -1)).reshape(*op.domain.shape, *g.shape[-2:])
    return np.moveaxis(op.T.apply(np.moveaxis(g, (-2, -1), (0, 1))), (0, 1), (-2, -1))


def _product(nums: Any, g: np.ndarray, rows: Any) -> list:
    """Return the cotangents of products of a matrix and a vector."""
    A, x = (np.stack(column, -1) for column in zip(*rows, strict=True))
    return [np.einsum("mkc,mcj->kcj", A, g) if num else g[:, None] * x[..., None] for num in nums]
