"""PyTorch: a function of arrays as one of tensors, and the other way. The only file that imports torch (extra `torch`).

Torch's gradient in a complex number is dL/dRe + i dL/dIm, the cotangent of our tape dL/dRe - i dL/dIm: each is turned
into the other where it crosses.
"""

from __future__ import annotations

from collections.abc import Callable

import autograd.numpy as anp
import numpy as np
import torch

from sparsedp._utils.pytree import flatten, leaves, paired, placed
from sparsedp._utils.reconstruction import ReconstructibleFunction
from sparsedp._utils.validation import check_function, check_leaves
from sparsedp.autodiff.tape import Rule, dtype_of, is_variable, isbox
from sparsedp.autodiff.tape_constants import constant, frozen
from sparsedp.errors import ShapeError
from sparsedp.interop.recording import owned, parts, recorded

__all__ = ["from_torch", "to_torch"]

SAME = "; return the same entries each time"


# ---- functions of this library for torch -----------------------------------------------------------------------------


def to_torch(f: Callable) -> Callable:
    """Return a function of arrays as a function of torch tensors, differentiable by torch.

    Parameters
    ----------
    f : callable
        ``f(*args, **options)``, of this library and autograd.numpy: an Operator, an inverse, a solver, a rollout,
        a loss. Arguments and result are arrays, or trees (tuples, lists, dicts) of arrays.

    Returns
    -------
    callable
        Takes tensors instead of arrays, in the same trees, and passes other arguments unchanged. Results have the
        dtypes of the results of f: float32 for float32. Only arguments that require a gradient are differentiated; if
        there are none, nothing is recorded.

    Raises
    ------
    TypeError
        If f is no function; on use, if a tensor is not on the CPU, or has half precision.
    RuntimeError
        By torch, in the backward pass, if a tensor has been changed in place since the call.

    Notes
    -----
    Tensors and arrays share their memory; a result is copied where f may know its memory. f runs once for a value and
    its gradient, and once more for a gradient of the gradient (``create_graph=True``), which is right to every order:
    f must give the same for the same arguments. Gradients in complex numbers are torch's, dL/dRe + i dL/dIm, see
    "Complex numbers" in docs/ideas.md. ``torch.func`` and forward mode do not look through it, torch says so.

    Examples
    --------
    >>> import sparsedp as dp
    >>> slope = to_torch(dp.gradient(dp.Grid(4, periodic=True)))
    >>> u = torch.tensor([1.0, 2.0, 4.0, 8.0], requires_grad=True)
    >>> torch.sum(slope(u) ** 2).backward()
    >>> u.grad
    tensor([-16.,  -2.,  -4.,  22.])
    """
    check_function("to_torch", f, "dp.interop.to_torch(dp.laplacian(grid))")
    return ReconstructibleFunction(
        lambda *args, **options: _bridged(lambda tree: f(*tree[0], **tree[1]), (args, options)), to_torch, f
    )


def _bridged(fun, tree):
    """Return the result of a function of a tree of arrays as a tree of tensors, for a tree with some tensors."""
    given, rebuild = flatten(tree)
    places = [place for place, leaf in enumerate(given) if isinstance(leaf, torch.Tensor)]
    tensors = [given[place] for place in places]
    beside = [*map(constant, placed(given, places, [None] * len(places)))]  # no tensor: it would keep its graph alive
    if not torch.is_grad_enabled():
        tensors = [tensor.detach() for tensor in tensors]
    result: list = []
    tensors = _Call.apply(lambda arrays: fun(rebuild(placed(beside, places, arrays))), result, *tensors)
    entries, filled, build = result
    return build(placed(entries, filled, tensors))


class _Call(torch.autograd.Function):
    """A function of arrays as a node of torch's graph."""

    @staticmethod
    def forward(ctx, fun, result, *tensors):
        arrays, moving = [*map(_array, tensors)], ctx.needs_input_grad[2:]
        made: list = []

        def watched(arrays):
            tree = fun(arrays)
            made.extend(map(isbox, leaves(tree)))  # what is traced comes from this call; all else may be f's own
            return tree

        values, rebuild, gradients = recorded(watched, arrays, moving)
        check_leaves("result of to_torch", rebuild(values), containers=False)
        places = [place for place, value in enumerate(values) if is_variable(value) or isinstance(value, np.ndarray)]
        outputs = _tensors([values[k] if made[k] else np.array(values[k]) for k in places], arrays)
        result += values, places, rebuild
        form = rebuild(range(len(values)))  # a second run may return a dict in another order

        def again(arrays):
            return paired(fun(arrays), form, "result of to_torch", advice=SAME)

        ctx.kept = again, moving, gradients, places, len(values)
        ctx.save_for_backward(*tensors, *outputs)  # torch refuses what has been changed in place since
        ctx.set_materialize_grads(False)
        return tuple(outputs)

    @staticmethod
    def backward(ctx, *cotangents):
        fun, moving, gradients, places, many = ctx.kept
        count = len(moving)
        tensors = ctx.saved_tensors[:count]
        places = [place for place, g in zip(places, cotangents, strict=True) if g is not None]
        given = [g for g in cotangents if g is not None]

        def slopes(arrays, gradients=None):
            gradients = gradients or recorded(fun, arrays[:count], moving)[2]
            return [*map(_turned, gradients(placed([None] * many, places, map(_turned, arrays[count:]))))]

        if torch.is_grad_enabled():  # a gradient of this gradient is wanted
            found = iter(_bridged(slopes, [*tensors, *given]))
        else:
            arrays = [*map(_array, given)]
            found = iter(_tensors(slopes([*tensors, *arrays], gradients), arrays))
        return None, None, *(next(found) if moves else None for moves in moving)


def _array(tensor):
    """Return the memory of a tensor as a read-only array, or as a number."""
    if tensor.device.type != "cpu":
        raise TypeError(f"to_torch computes on the CPU, got a tensor on {tensor.device}; write tensor.cpu()")
    if tensor.is_floating_point() and tensor.dtype.itemsize < 4:
        raise TypeError(f"to_torch takes float32 or float64, got {tensor.dtype}; write tensor.float()")
    return frozen(tensor.numpy(force=True))[()]


def _tensors(values, others):
    """Return arrays as tensors of the same memory; copied if it is read-only or shared with other arrays."""
    found, seen = [], [*others]
    for value in map(np.asarray, values):
        if not value.flags.writeable or min(value.strides, default=0) < 0:
            value = value.copy()
        if any(np.may_share_memory(value, other) for other in seen):
            value = value.copy()
        seen.append(value)
        found.append(torch.from_numpy(value))
    return found


def _turned(g):
    """Convert a gradient of torch to a cotangent of the tape, or back."""
    return anp.conj(g) if dtype_of(g).kind == "c" else g


# ---- functions of torch on our tape ----------------------------------------------------------------------------------


def from_torch(function: Callable) -> Callable:
    """Return a function of torch tensors, or a module, as a function of arrays, differentiable by this library.

    Parameters
    ----------
    function : callable or torch.nn.Module
        ``function(*args)``; arguments and result are tensors, or trees (tuples, lists, dicts) of tensors.

    Returns
    -------
    callable
        Takes and returns arrays instead of tensors. For a module the first argument is a dict of its parameters as
        arrays: ``net(net.parameters, x)``; ``net.parameters`` are copies of the parameters of the module. Parameters
        that are missing in a dict are taken from the module, as constants.

    Raises
    ------
    TypeError
        If it is no function; on use, if a dtype has other than single or double precision.
    ShapeError
        On use, if the dict holds parameters that the module does not have.

    Notes
    -----
    The module is not changed, and its parameters get no ``.grad``: gradients come from `value_and_grad` like all
    others, and ``module.load_state_dict({name: torch.tensor(p) for name, p in best.x.items()}, strict=False)`` puts
    what was found back. torch computes in the dtypes that it is given: for float64 fields write ``module.double()``.

    The function runs once for its value and for derivatives of every order, those with random numbers (dropout) too;
    only what is traced is differentiated. Derivatives are reverse: `jvp` takes two passes.

    Examples
    --------
    >>> import sparsedp as dp
    >>> cube = from_torch(lambda x: x**3)
    >>> dp.value_and_grad(lambda x: np.sum(cube(x)))(np.array([1.0, 2.0]))
    (9.0, array([ 3., 12.]))
    """
    check_function("from_torch", function, "dp.interop.from_torch(module)")
    run, parameters, names = function, {}, set()
    if isinstance(function, torch.nn.Module):
        run = lambda parameters, *args: torch.func.functional_call(function, parameters, args)
        parameters = {name: _owned(tensor) for name, tensor in function.named_parameters()}
        names = {*parameters, *(name for name, _ in function.named_buffers())}

    def check_names(given):
        """Refuse parameters that the module does not have; torch ignores them."""
        unknown = [repr(name) for name in given if name not in names]
        if unknown:
            expected = ", ".join(map(repr, parameters))
            raise ShapeError(f"parameters of from_torch: unknown key {', '.join(unknown)}; expected {expected}")

    def call(*args):
        check_leaves("arguments of from_torch", args, containers=False)
        if parameters:
            check_names(args[0])
        entries, rebuild = flatten(args)
        moving = [*map(isbox, entries)]
        built: list = []
        # Copies: torch, or the caller before the backward pass, may write into the arguments. Traced ones are safe.
        entries = [np.array(one) if isinstance(one, np.ndarray) else one for one in entries]

        def act(tensors):
            results, *built[:] = flatten(run(*rebuild(tensors)))
            return results

        graph = _Graph(act, moving)
        results = _rule(graph, *entries)
        return built[0](parts(results, len(graph.outputs)))

    vars(call)["parameters"] = parameters
    return ReconstructibleFunction(call, from_torch, function)


class _Graph:
    """One run of a torch function: the tensors that go in, and those that come out.

    Parameters
    ----------
    act : callable
        ``act(tensors) -> list of tensors``.
    moving : list of bool
        Which arguments may be differentiated.
    inputs : list of tensors
        The first of them, where another run has made them.
    """

    outputs: list

    def __init__(self, act, moving, inputs=()):
        self._act, self._moving, self.inputs = act, moving, [*inputs]
        self._continues = bool(self.inputs)

    def run(self, *entries):
        """Return the results as a tuple of arrays, for arguments as arrays."""
        for entry, moves in [*zip(entries, self._moving, strict=True)][len(self.inputs) :]:
            tensor = _tensors([entry], ())[0].requires_grad_(moves) if moves or isinstance(entry, np.ndarray) else entry
            self.inputs.append(tensor)
        with torch.set_grad_enabled(any(self._moving)):
            self.outputs = self._act(self.inputs)
        return tuple(map(_owned, self.outputs))

    def as_new(self):
        """Return a graph of the same function that has not run; a graph of gradients belongs to one run."""
        return self if self._continues else _Graph(self._act, self._moving)

    def pulled(self, places, moving):
        """The graph of the gradients of some arguments; its arguments are those here, and then the cotangents."""

        def act(tensors):
            ends = [y for y in self.outputs if y.requires_grad]
            cotangents = [g.to(y.dtype) for y, g in zip(ends, tensors[len(self.inputs) :], strict=True)]
            options = dict(create_graph=any(moving), retain_graph=True, allow_unused=True, materialize_grads=True)
            wanted = [self.inputs[place] for place in places]
            return torch.autograd.grad(ends, wanted, cotangents, **options)

        return _Graph(act, moving, self.inputs)


def _pull(nums, ans, graph, *entries):
    def pull(g):
        cotangents = [_turned(g[k]) for k, y in enumerate(graph.outputs) if y.requires_grad]
        pulled = graph.pulled([num - 1 for num in nums], [*map(isbox, (*entries, *cotangents))])
        return tuple(map(_turned, parts(_rule(pulled, *entries, *cotangents), len(nums))))

    return pull


_rule = Rule("torch function", _Graph.run, _pull)


def _owned(tensor):
    """Return a tensor as an array or number with its own memory: the tensor may be a parameter, or saved by torch."""
    if tensor.is_floating_point() and tensor.dtype.itemsize < 4:
        raise TypeError(f"from_torch takes and gives float32 or float64, got {tensor.dtype}; write tensor.float()")
    return owned(tensor.numpy(force=True))
