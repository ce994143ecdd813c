"""The differentiation rule of a transport method: forward, cotangents, tangents, and second derivatives."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.validation import check_finite, surely_finite
from sparsedp.advection.arguments import FLOAT, check_step, flatten_array
from sparsedp.advection.settings import FIELD, INFLOW, STEP, VELOCITY
from sparsedp.autodiff.program_trace import check_values, open_traces, recording_trace
from sparsedp.autodiff.tape import Rule, cast, dtype_of, isbox, linear, plain
from sparsedp.errors import DerivativeError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from sparsedp.advection.method import TransportMethod
    from sparsedp.grid.space import Space

__all__ = ["rule_of"]

ARGUMENTS = ("u", "v", "dt", "inflow")


def rule_of(method: TransportMethod) -> Rule:
    """Return a transport step as a differentiable function of (u, v, dt, inflow)."""
    space = method.settings.space

    def forward(u, v, dt, inflow):
        return _unflatten_result(u, method.forward(*_flatten(method, u, v, dt, inflow)), space.shape)

    def bind(*values):
        flatten = _bound_flatten(method, *values)
        if flatten is None:
            return forward

        step = method.bound_forward()

        def bound_forward(u, v, dt, inflow):
            return step(*flatten(u, v, dt, inflow)).reshape(space.shape)

        return bound_forward

    def bind_vjp(nums, *values):
        flatten = _bound_flatten(method, *values)
        if flatten is None:
            return None
        return _bound_pull(method, nums, values, flatten)

    def vjp(nums, ans, *args):
        bound_pull = rule.bound_vjp(nums, *args)

        def pull(g, *sums):
            if bound_pull is None:
                return _pull(method, nums, args, g, sums, partial(_flatten, method), args_are_plain=False)
            return bound_pull(g, *args, sums=sums)

        return pull

    def jvp(nums, tangents, ans, *args):
        flat = _flatten(method, *args)
        flat_tangents = {
            num: _flatten_tangent(num, method, tangent) for num, tangent in zip(nums, tangents, strict=True)
        }
        if any(map(isbox, (*args, *tangents))) and not method.any_order:
            rules = zip(_linear_rules(method, nums, flat), flat_tangents.values(), strict=True)
            tangent = sum(pushforward(along) for (_, pushforward), along in rules)
        else:
            if STEP in flat_tangents:  # a step depends only on v dt
                along_velocity = flat_tangents.pop(STEP) / flat[STEP] * flat[VELOCITY]
                flat_tangents[VELOCITY] = flat_tangents.get(VELOCITY, 0.0) + along_velocity
            tangent = method.jvp(flat_tangents, *flat)
        _check_derivative(method, "the tangent", tangent, tangents)
        return _unflatten(ans, tangent)

    rule = Rule(method.name, forward, vjp, jvp)
    rule.bind = bind
    rule.bind_vjp = bind_vjp
    rule.adds = method.accumulates
    return rule


def _bound_pull(method: TransportMethod, nums: Sequence[int], values: Sequence, flatten: Callable) -> Callable:
    """Return a pullback ``pull(g, *args, sums=())`` for arguments of the form of `values`.

    `flatten` is that of `_bound_flatten`. See `Rule` for `sums`.
    """
    shapes = [np.shape(values[num]) for num in nums]
    is_direct = not {STEP, INFLOW} & set(nums)
    bound_vjp = method.bound_vjp(nums)
    velocity_place = None
    if VELOCITY in nums:
        velocity_place = nums.index(VELOCITY)

    def pull(g, u, v, dt, inflow, sums=()):
        adds = sums and velocity_place is not None and sums[velocity_place] is not None
        if is_direct and not adds and type(g) is np.ndarray and g.dtype == FLOAT:
            cotangents, finite = bound_vjp(g.reshape(-1), *flatten(u, v, dt, inflow))
            if finite or all(map(surely_finite, cotangents)):
                return [cotangent.reshape(shape) for cotangent, shape in zip(cotangents, shapes)]
        return _pull(method, nums, (u, v, dt, inflow), g, sums, flatten, args_are_plain=True)

    return pull


def _pull(
    method: TransportMethod,
    nums: Sequence[int],
    args: tuple,
    g: Any,
    sums: tuple,
    flatten: Callable,
    args_are_plain: bool,
) -> list:
    """Return the cotangents of the arguments `nums`, in the shapes of these arguments.

    See `Rule` for `sums`. `flatten` returns the arguments as `_flatten` does.
    """
    flat = flatten(*args)
    g = _flatten_tangent(FIELD, method, g)
    traced = type(g) is not np.ndarray or (not args_are_plain and any(map(isbox, flat)))
    velocity_sum = None
    if sums and not traced and STEP not in nums:
        velocity_sum = _velocity_sum(args, dict(zip(nums, sums)))
    if traced and not method.any_order:
        cotangents = [pullback(g) for pullback, _ in _linear_rules(method, nums, flat)]
        finite = False
    else:
        cotangents, finite = _cotangents(method, nums, g, flat, velocity_sum)
        if velocity_sum is not None and not finite and not surely_finite(velocity_sum):
            # The sum may have been infinite before this step: check only the cotangent of this step.
            of_velocity = method.vjp((VELOCITY,), g, *flat)[0][0]
            _check_derivative(method, "the gradient in v", of_velocity, (g,))
    if velocity_sum is None and (finite or _are_surely_finite(cotangents)):
        return [_unflatten(args[num], cotangent) for num, cotangent in zip(nums, cotangents, strict=True)]
    results = []
    for position, (num, cotangent) in enumerate(zip(nums, cotangents, strict=True)):
        accumulated = velocity_sum is not None and cotangent is velocity_sum
        if not finite and not accumulated:
            _check_derivative(method, f"the gradient in {ARGUMENTS[num]}", cotangent, (g,))
        results.append(sums[position] if accumulated else _unflatten(args[num], cotangent))
    return results


def _velocity_sum(args: tuple, sums: Mapping[int, NDArray | None]) -> NDArray | None:
    """Return the sum of the cotangents of the velocity so far, flat; None if a step cannot add to it in place."""
    total = sums.get(VELOCITY)
    if total is None or total.dtype != FLOAT or dtype_of(args[VELOCITY]) != FLOAT or not total.flags.c_contiguous:
        return None
    return total.reshape(-1)


def _cotangents(
    method: TransportMethod, nums: Sequence[int], g: Any, flat: tuple, velocity_sum: NDArray | None
) -> tuple[list, bool]:
    """Return the cotangents of the arguments `nums`, and whether they are known to be finite.

    A step depends only on v dt, so that the cotangent of dt follows from the cotangent of the velocity.
    """
    requested = nums
    if STEP in nums:
        requested = tuple({VELOCITY if num == STEP else num for num in nums})
    if velocity_sum is None:
        values, finite = method.vjp(requested, g, *flat)
    else:
        values, finite = method.vjp(requested, g, *flat, velocity_sum)
    if requested is nums:
        return list(values), finite
    cotangents = dict(zip(requested, values, strict=True))
    if STEP in nums:
        cotangents[STEP] = anp.dot(flat[VELOCITY], cotangents[VELOCITY]) / flat[STEP]
        finite = False
    return [cotangents[num] for num in nums], finite


def _check_derivative(method: TransportMethod, description: str, derivative: Any, inputs: Iterable) -> None:
    """Raise if a derivative is not finite although all cotangents or tangents passed to the step are finite."""
    check_values(partial(_check_plain_derivative, method.name, description), derivative, *inputs)


def _check_plain_derivative(name, description, derivative, *inputs):
    if surely_finite(derivative) or not all(np.all(np.isfinite(value)) for value in inputs):
        return
    check_finite(name, np.asarray(derivative), f"cannot represent {description}")


def _are_surely_finite(cotangents):
    """Return True if all entries are known to be finite; False while `dp.jit` records, which checks them later."""
    if open_traces and recording_trace(cotangents) is not None:
        return False
    return all(map(surely_finite, map(plain, cotangents)))


def _linear_rules(method: TransportMethod, nums: Sequence[int], flat: tuple) -> list:
    """Return, for each argument, its pullback and its pushforward as differentiable linear rules.

    They do not depend on u and inflow. If a scheme is linear in (u, inflow), and v and dt are constant, they therefore
    give derivatives of every order in u and inflow.
    """
    constant = not isbox(flat[VELOCITY]) and not isbox(flat[STEP])
    if not (method.linear and constant and set(nums) <= {FIELD, INFLOW}):
        raise DerivativeError(f"{method.name} has first derivatives only; for second ones write scheme='upwind'")
    args = tuple(map(plain, flat))

    def rules(num):
        def pullback(g):
            return method.vjp((num,), np.asarray(g), *args)[0][0]

        def pushforward(tangent):
            return method.jvp({num: tangent}, *args)

        return linear(f"{method.name}.T", pullback, pushforward)

    return [rules(num) for num in nums]


# ---- between the arguments of the user and flat float64 arrays -------------------------------------------------------


def _bound_flatten(method: TransportMethod, u: Any, v: Any, dt: Any, inflow: Any) -> Callable | None:
    """Return a function like `_flatten`, without checks of the form, for arguments of the same form as these.

    Return None for arguments that need a conversion or are traced.
    """
    for array, shapes in ((u, method.field_shapes), (v, method.velocity_shapes)):
        if type(array) is not np.ndarray or array.shape not in shapes or array.dtype != FLOAT:
            return None
        if not array.flags.c_contiguous:
            return None
    if type(dt) is not float or type(inflow) is not float:
        return None
    flat_field = u.ndim == 1
    flat_velocity = v.ndim == 1
    count = method.walls.size
    no_inflow = np.zeros(0)

    def flatten(u, v, dt, inflow):
        if not 0 < dt < np.inf:
            check_step(method.name, dt)
        return (
            u if flat_field else u.reshape(-1),
            v if flat_velocity else v.reshape(-1),
            dt,
            np.full(count, inflow) if count else no_inflow,
        )

    return flatten


def _flatten(method: TransportMethod, u: Any, v: Any, dt: Any, inflow: Any) -> tuple[Any, Any, Any, Any]:
    """Check the arguments of a step and return them as flat arrays and a float, as the method needs them."""
    if isbox(dt):
        check_values(partial(check_step, method.name), dt)
    elif type(dt) is not float or not 0 < dt < np.inf:
        dt = check_step(method.name, dt)
    u = flatten_array(method.name, "u", u, method.field_shapes)
    v = flatten_array(method.name, "v", v, method.velocity_shapes)
    return u, v, dt, _flatten_inflow(method.name, inflow, method.walls)


def _flatten_inflow(name: str, inflow: Any, walls: Space) -> Any:
    """Return the inflow as a flat array with one value for each point at a wall."""
    if type(inflow) is float:
        return np.full(walls.size, inflow)
    if np.shape(inflow) == ():
        return flatten_array(name, "inflow", inflow, ((),)) * np.ones(walls.size)
    return flatten_array(name, "inflow", inflow, (walls.shape,))


def _unflatten_result(u: Any, flat: NDArray, shape: tuple[int, ...]) -> NDArray:
    """Return a flat float64 result in the shape of the field and the dtype of u (float64 for bool and int)."""
    dtype = dtype_of(u)
    if dtype.char == "f":
        flat = flat.astype(dtype.newbyteorder("="))
    return flat.reshape(shape)


def _flatten_tangent(num: int, method: TransportMethod, tangent: Any) -> Any:
    """Return the tangent of an argument, or a cotangent of the result, as a flat float64 array."""
    if num == STEP:
        return tangent
    if type(tangent) is np.ndarray and tangent.dtype == FLOAT and tangent.ndim:
        return tangent.reshape(-1)
    tangent = anp.reshape(cast(tangent, FLOAT), (-1,))
    if num == INFLOW and tangent.size == 1:
        return tangent * np.ones(method.walls.size)
    return tangent


def _unflatten(value: Any, derivative: Any) -> Any:
    """Return a flat derivative in the shape of a value; if the value is a scalar, return the sum."""
    if type(value) is np.ndarray and value.ndim:
        return derivative if value.ndim == 1 else derivative.reshape(value.shape)
    shape = np.shape(value)
    if shape:
        return derivative.reshape(shape)
    if type(derivative) is float:
        return derivative
    return anp.sum(derivative)
