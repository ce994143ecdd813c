"""Bridge to PyTorch: functions of arrays as functions of tensors, and the reverse.

This is the only module that imports torch (extra `torch`).

For a complex number, the gradient of torch is dL/dRe + i dL/dIm and the cotangent of our tape is dL/dRe - i dL/dIm;
they are complex conjugates. The bridge conjugates derivatives when they pass from one library to the other.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import autograd.numpy as anp
import numpy as np
import torch

from sparsedp._utils.base_classes import ReconstructibleFunction
from sparsedp._utils.pytree import flatten, leaves, mapped, paired, placed
from sparsedp._utils.validation import check_function, check_leaves
from sparsedp.autodiff.program_trace import opaque
from sparsedp.autodiff.tape import Rule, dtype_of, is_variable, isbox
from sparsedp.autodiff.tape_constants import constant, frozen
from sparsedp.errors import ShapeError
from sparsedp.interop.recording import owned, parts, recorded

__all__ = ["TorchFunction", "from_torch", "to_torch"]

STRUCTURE_ADVICE = "; return the same entries each time"


# ---- functions of this library for torch -----------------------------------------------------------------------------


def to_torch(f: Callable) -> Callable:
    """Convert a function of NumPy arrays to a function of torch tensors that torch can differentiate.

    Parameters
    ----------
    f : callable
        ``f(*args, **options)``, written with this library and autograd.numpy: for example an Operator, an inverse, a
        solver, a rollout or a loss. Arguments and result are arrays, or trees (tuples, lists, dicts) of arrays.

    Returns
    -------
    callable
        Takes tensors in place of arrays, in the same trees. Other arguments are passed to `f` unchanged. Results have
        the dtypes that `f` returns. Only arguments that require a gradient are differentiated. If no argument requires
        a gradient, nothing is recorded.

    Raises
    ------
    TypeError
        If `f` is not callable. The returned function raises it if a tensor is not on the CPU, or has half precision.
    RuntimeError
        Raised by torch in the backward pass if a tensor was modified in place after the call.

    See Also
    --------
    interop.from_torch, from_blackbox

    Notes
    -----
    Tensors and arrays share their memory. A result is copied if `f` may have kept a reference to it. f runs once for a
    value and its gradient, and a second time for a gradient of the gradient (``create_graph=True``). Derivatives of
    every order are supported; f must be deterministic. ``torch.func`` and forward mode are not supported, and torch
    raises an error for them.

    Gradients of complex numbers follow torch, dL/dRe + i dL/dIm; see docs/guides/complex_numbers.md.

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

    def apply(tree):
        args, options = tree
        return f(*args, **options)

    def call(*args, **options):
        return _bridged(apply, (args, options))

    return ReconstructibleFunction(call, to_torch, f)


def _bridged(fun, tree):
    """Call a function of a tree of arrays with a tree that contains tensors; return the result as a tree of tensors."""
    entries, rebuild = flatten(tree)
    places = [place for place, leaf in enumerate(entries) if isinstance(leaf, torch.Tensor)]
    tensors = [entries[place] for place in places]
    # The closure below must not refer to tensors, because a tensor would keep its graph alive.
    constants = [*map(constant, placed(entries, places, [None] * len(places)))]
    if not torch.is_grad_enabled():
        tensors = [tensor.detach() for tensor in tensors]

    def of_arrays(arrays):
        return fun(rebuild(placed(constants, places, arrays)))

    result: list = []  # filled by `_TorchNode.forward`, which can only return tensors
    outputs = _TorchNode.apply(of_arrays, result, *tensors)
    values, output_places, rebuild_result = result
    return rebuild_result(placed(values, output_places, outputs))


class _TorchNode(torch.autograd.Function):
    """A function of arrays as a node of torch's graph."""

    @staticmethod
    def forward(ctx, fun, result, *tensors):
        arrays = [*map(_array, tensors)]
        moving = ctx.needs_input_grad[2:]
        traced: list[bool] = []

        def with_marks(arrays):
            tree = fun(arrays)
            traced.extend(map(isbox, leaves(tree)))
            return tree

        values, rebuild, gradients = recorded(with_marks, arrays, moving)
        check_leaves("result of to_torch", rebuild(values), containers=False)
        places = [place for place, value in enumerate(values) if is_variable(value) or isinstance(value, np.ndarray)]
        results = []
        for place in places:
            value = values[place]
            # A traced result is a new array of this call. f may have kept a reference to any other result.
            results.append(value if traced[place] else np.array(value))
        outputs = _tensors(results, arrays)
        result += values, places, rebuild
        form = rebuild(range(len(values)))  # a second run may return the keys of a dict in another order

        def rerun(arrays):
            return paired(fun(arrays), form, "result of to_torch", advice=STRUCTURE_ADVICE)

        ctx.kept = rerun, moving, gradients, places, len(values)
        ctx.save_for_backward(*tensors, *outputs)  # torch raises an error if one of them is modified in place
        ctx.set_materialize_grads(False)
        return tuple(outputs)

    @staticmethod
    def backward(ctx, *cotangents):
        fun, moving, gradients, places, result_count = ctx.kept
        input_count = len(moving)
        tensors = ctx.saved_tensors[:input_count]
        places = [place for place, g in zip(places, cotangents, strict=True) if g is not None]
        seeds = [g for g in cotangents if g is not None]

        def input_gradients(gradients, arrays):
            of_results = placed([None] * result_count, places, map(_conjugated, arrays))
            return [*map(_conjugated, gradients(of_results))]

        def differentiable(arrays):
            gradients = recorded(fun, arrays[:input_count], moving)[2]
            return input_gradients(gradients, arrays[input_count:])

        if torch.is_grad_enabled():  # a gradient of this gradient may be requested
            slopes = _bridged(differentiable, [*tensors, *seeds])
        else:
            arrays = [*map(_array, seeds)]
            slopes = _tensors(input_gradients(gradients, arrays), arrays)
        variables = [place for place, moves in enumerate(moving) if moves]
        return None, None, *placed([None] * input_count, variables, slopes)


def _array(tensor):
    """Return a tensor as a read-only array that shares its memory, or as a NumPy scalar."""
    if tensor.device.type != "cpu":
        raise TypeError(f"to_torch computes on the CPU, got a tensor on {tensor.device}; write tensor.cpu()")
    if tensor.is_floating_point() and tensor.dtype.itemsize < 4:
        raise TypeError(f"to_torch takes float32 or float64, got {tensor.dtype}; write tensor.float()")
    return frozen(tensor.numpy(force=True))[()]


def _tensors(values, others):
    """Return arrays as tensors that share their memory. Read-only, reversed and overlapping arrays are copied."""
    tensors = []
    seen = [*others]
    for value in map(np.asarray, values):
        if not value.flags.writeable or min(value.strides, default=0) < 0:
            value = value.copy()
        if any(np.may_share_memory(value, other) for other in seen):
            value = value.copy()
        seen.append(value)
        tensors.append(torch.from_numpy(value))
    return tensors


def _conjugated(g):
    """Convert a gradient of torch to a cotangent of the tape, or a cotangent of the tape to a gradient of torch."""
    if dtype_of(g).kind == "c":
        return anp.conj(g)
    return g


# ---- functions of torch on our tape ----------------------------------------------------------------------------------


def from_torch(function: Callable) -> TorchFunction:
    """Convert a torch function or module to a function of NumPy arrays that this library can differentiate.

    Parameters
    ----------
    function : callable or torch.nn.Module
        ``function(*args)``. Arguments and result are tensors, or trees (tuples, lists, dicts) of tensors.

    Returns
    -------
    TorchFunction
        A function that takes and returns arrays in place of tensors. For a module the first argument is a dict of its
        parameters as arrays: ``net(net.parameters, x)``. Here ``net.parameters`` has copies of the parameters of the
        module. Parameters that are missing in the dict are taken from the module, as constants.

    Raises
    ------
    TypeError
        If `function` is not callable. The returned function raises it if a dtype has neither single nor double
        precision.
    ShapeError
        Raised by the returned function if the dict has parameters that the module does not have.

    See Also
    --------
    interop.to_torch

    Notes
    -----
    The module is not changed, and its parameters get no ``.grad``: `value_and_grad` returns their gradients. After a
    minimization, ``module.load_state_dict({name: torch.tensor(p) for name, p in best.x.items()}, strict=False)`` copies
    the optimal parameters into the module. torch computes in the dtypes of its arguments: for float64 fields write
    ``module.double()``.

    The function runs only once for its value and its derivatives of every order, so that random numbers (dropout) are
    the same in all of them. Only traced arguments are differentiated. There is only reverse mode; `jvp` is computed by
    two reverse passes.

    For complex numbers see docs/guides/complex_numbers.md.

    Examples
    --------
    >>> import sparsedp as dp
    >>> cube = from_torch(lambda x: x**3)
    >>> dp.value_and_grad(lambda x: np.sum(cube(x)))(np.array([1.0, 2.0]))
    (9.0, array([ 3., 12.]))
    """
    check_function("from_torch", function, "dp.interop.from_torch(module)")
    run = function
    parameters: dict[str, Any] = {}
    names: set[str] = set()
    if isinstance(function, torch.nn.Module):

        def with_parameters(parameters, *args):
            return torch.func.functional_call(function, parameters, args)

        run = with_parameters
        parameters = {name: _owned(tensor) for name, tensor in function.named_parameters()}
        names = {*parameters, *(name for name, _ in function.named_buffers())}

    def check_names(argument):
        """Raise an error for parameters that the module does not have; torch ignores them."""
        unknown = [repr(name) for name in argument if name not in names]
        if unknown:
            expected = ", ".join(map(repr, parameters))
            raise ShapeError(f"parameters of from_torch: unknown key {', '.join(unknown)}; expected {expected}")

    def call(*args):
        check_leaves("arguments of from_torch", args, containers=False)
        if parameters:
            check_names(args[0])
        entries, rebuild = flatten(args)
        moving = [*map(isbox, entries)]
        for place, entry in enumerate(entries):
            # Copy, because torch or the caller may modify an array before the backward pass. Traced entries are boxes
            # and not instances of np.ndarray.
            if isinstance(entry, np.ndarray):
                entries[place] = np.array(entry)
        rebuild_result: Any = None

        def act(tensors):
            nonlocal rebuild_result
            results, rebuild_result = flatten(run(*rebuild(tensors)))
            return results

        graph = _Graph(act, moving)
        results = _rule(graph, *entries)
        return rebuild_result(parts(results, len(graph.outputs)))

    call.__name__ = "from_torch"
    # Each call has a graph of its own, so that `dp.jit` must not record the rule of this call.
    return TorchFunction(opaque(call), function, parameters)


class TorchFunction(ReconstructibleFunction):
    """A torch function or module as a function of arrays. `from_torch` returns it.

    Parameters
    ----------
    call : callable
        The function of arrays.
    function : callable or torch.nn.Module

    Attributes
    ----------
    parameters : dict
        Copies of the parameters of a module, by name; empty if `function` is not a module.
    """

    def __init__(self, call: Callable, function: Callable, parameters: dict[str, Any]) -> None:
        super().__init__(call, from_torch, function)
        self.parameters = parameters


class _Graph:
    """One run of a torch function, with its input and output tensors.

    Parameters
    ----------
    act : callable
        ``act(tensors)`` returns a list of tensors.
    moving : list of bool
        Whether each argument may be differentiated.
    inputs : list of tensors, optional
        The first arguments, if they are tensors of a previous run.
    """

    outputs: list[torch.Tensor]

    def __init__(self, act, moving, inputs=()):
        self._act = act
        self._moving = moving
        self.inputs = [*inputs]
        self._continues = bool(self.inputs)

    def run(self, *entries):
        """Return the results as a tuple of arrays, for arguments as arrays."""
        start = len(self.inputs)
        for entry, moves in zip(entries[start:], self._moving[start:], strict=True):
            if moves or isinstance(entry, np.ndarray):
                (tensor,) = _tensors([entry], ())
                self.inputs.append(tensor.requires_grad_(moves))
            else:
                self.inputs.append(entry)
        with torch.set_grad_enabled(any(self._moving)):
            self.outputs = self._act(self.inputs)
        return tuple(map(_owned, self.outputs))

    def as_new(self):
        """Return a graph of the same function that has not run. A graph of gradients belongs to one run: return it."""
        if self._continues:
            return self
        return _Graph(self._act, self._moving)

    def pulled(self, places, moving):
        """Return the graph of gradients with respect to arguments `places`; it takes all arguments, then cotangents."""

        def act(tensors):
            outputs = [y for y in self.outputs if y.requires_grad]
            cotangents = [g.to(y.dtype) for y, g in zip(outputs, tensors[len(self.inputs) :], strict=True)]
            variables = [self.inputs[place] for place in places]
            return torch.autograd.grad(
                outputs,
                variables,
                cotangents,
                create_graph=any(moving),
                retain_graph=True,
                allow_unused=True,
                materialize_grads=True,
            )

        return _Graph(act, moving, self.inputs)


def _pull(nums, ans, graph, *entries):
    """Return the function from cotangents of the results to gradients of the arguments `nums`."""

    def pull(g):
        cotangents = [_conjugated(g[k]) for k, y in enumerate(graph.outputs) if y.requires_grad]
        moving = [*map(isbox, (*entries, *cotangents))]
        gradient_graph = graph.pulled([num - 1 for num in nums], moving)  # argument 0 of the rule is the graph
        gradients = parts(_rule(gradient_graph, *entries, *cotangents), len(nums))
        return tuple(map(_conjugated, gradients))

    return pull


_rule = Rule("torch function", _Graph.run, _pull)


def _owned(tensor):
    """Return a copy of a tensor as an array or scalar. The tensor itself may be a parameter, or saved by torch."""
    if tensor.is_floating_point() and tensor.dtype.itemsize < 4:
        raise TypeError(f"from_torch takes and gives float32 or float64, got {tensor.dtype}; write tensor.float()")
    return owned(tensor.numpy(force=True))


# ---- derivatives by torch, for checks --------------------------------------------------------------------------------


def as_tensors(tree: Any) -> Any:
    """Return a tree with tensors in place of its arrays and floating numbers; they share no memory with the arrays."""

    def tensor(leaf: Any) -> Any:
        if isinstance(leaf, np.ndarray) or is_variable(leaf):
            return torch.from_numpy(np.array(leaf))
        return leaf

    return mapped(tensor, tree)


def as_arrays(tree: Any) -> Any:
    """Return a tree with arrays in place of its tensors. They may share memory with the tensors."""

    def array(leaf: Any) -> Any:
        if isinstance(leaf, torch.Tensor):
            return leaf.numpy(force=True)
        return leaf

    return mapped(array, tree)


def with_parameters(module: Any, x: Any) -> tuple[Callable, Any]:
    """Return a module as a function of its input and its parameters, and the tree of both."""
    parameters = {name: tensor.detach() for name, tensor in module.named_parameters()}
    if x is None or not parameters:
        return module, x

    def call(tree: Any) -> Any:
        return torch.func.functional_call(module, tree["parameters"], (tree["x"],))

    return call, {"x": x, "parameters": parameters}


def _is_floating(tensor: Any) -> bool:
    """Return whether a tensor has a real or complex floating dtype."""
    return tensor.is_floating_point() or tensor.is_complex()


def vjp_of(f: Callable, x: Any, g: Any) -> Any:
    """Return the VJP of a function of a tree of tensors by torch."""
    entries, rebuild = flatten(x)
    moving = [isinstance(leaf, torch.Tensor) and _is_floating(leaf) for leaf in entries]
    entries = [leaf.requires_grad_() if moves else leaf for leaf, moves in zip(entries, moving, strict=True)]
    variables = [leaf for leaf, moves in zip(entries, moving, strict=True) if moves]
    with torch.enable_grad():
        # A function that changes its argument in place may not do so with a variable itself.
        results = leaves(f(rebuild([leaf.clone() if moves else leaf for leaf, moves in zip(entries, moving)])))
    pairs = []
    for y, cotangent in zip(results, leaves(g), strict=True):
        if isinstance(y, torch.Tensor) and y.requires_grad:
            pairs.append((y, cotangent))
    slopes: list[Any] = [None] * len(variables)
    if pairs:
        outputs, cotangents = zip(*pairs)
        slopes = [*torch.autograd.grad(outputs, variables, cotangents, allow_unused=True)]
    slopes = [torch.zeros_like(v) if slope is None else slope for v, slope in zip(variables, slopes, strict=True)]
    places = [place for place, moves in enumerate(moving) if moves]
    return rebuild(placed(entries, places, slopes))


def jvp_of(f: Callable, x: Any, t: Any) -> Any:
    """Return the JVP of a function of a tree of tensors by torch."""
    entries, rebuild = flatten(x)
    places = [place for place, leaf in enumerate(entries) if isinstance(leaf, torch.Tensor) and _is_floating(leaf)]
    tangents = leaves(t)
    rebuild_result: Any = None

    def of_tensors(*tensors: Any) -> Any:
        nonlocal rebuild_result
        results, rebuild_result = flatten(f(rebuild(placed(entries, places, tensors))))
        return tuple(results)

    tensors = tuple(entries[place] for place in places)
    _, slopes = torch.func.jvp(of_tensors, tensors, tuple(tangents[place] for place in places))
    return rebuild_result(slopes)
