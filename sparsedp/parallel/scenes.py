"""Differentiable weighted sums of a loss over many scenes, computed in parallel by an executor."""

from __future__ import annotations

import os
import pickle
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from hashlib import sha256
from platform import node
from threading import RLock
from typing import Any

import autograd.numpy as anp
import numpy as np
from numpy.typing import ArrayLike

from sparsedp._utils.base_classes import Reconstructible
from sparsedp._utils.calls import public
from sparsedp._utils.progress import shown_steps
from sparsedp._utils.pytree import copied, flatten, leaves, mapped, placed
from sparsedp._utils.validation import check_finite, check_function, check_leaves, check_shape, check_whole, is_whole
from sparsedp.autodiff.derivative import check_loss, grad, jvp, unwarned, value_and_grad, zero_like
from sparsedp.autodiff.tape import Rule, isbox
from sparsedp.autodiff.tape_constants import frozen

__all__ = ["Ensemble", "ensemble"]

CACHED = 128  # maximum number of scenes and losses (with their solvers) in the cache of a worker


def ensemble(
    loss: Callable,
    scenes: Iterable,
    executor: Any = None,
    weights: Any = None,
    chunk: int | None = None,
    progress: bool | str = False,
) -> Ensemble:
    """Return a differentiable function total(x), the weighted sum of loss(x, scene) over many scenes.

    Parameters
    ----------
    loss : callable
        ``loss(x, scene)`` returns a real scalar; `x` is any nesting of arrays, tuples, lists and dicts.
    scenes : iterable
        The second arguments of the loss, such as observations, initial states, grids or solvers.
    executor : concurrent.futures.Executor, optional
        For example ``ProcessPoolExecutor``, Dask's ``client.get_executor()`` or mpi4py's ``MPIPoolExecutor``. The
        caller must start it and shut it down. Default: the scenes are evaluated one by one in this process.
    weights : array (number of scenes,), optional
        Default: ones.
    chunk : int, optional
        Number of scenes in one task, 1 by default. A task returns one sum over its scenes, so that larger chunks need
        less communication.
    progress : bool or str
        Show a progress bar over the tasks of each evaluation; a string is used as its label.

    Returns
    -------
    Ensemble
        The function ``total(x)``. ``total(x, numbers)`` is the sum over the scenes with the given indices, in this
        order; use it with the argument `batches` of `minimize`.

    Raises
    ------
    TypeError
        If `loss` is not a function, the executor has no method `submit`, or a scene cannot be pickled.
    ValueError
        If there is no scene, or `chunk` is not a positive integer.
    ShapeError, NonFiniteError
        If `weights` does not have one finite number for each scene.
    IndexError
        When ``total(x, numbers)`` is called, if an index is out of range.

    See Also
    --------
    rollout, minimize, distribute, set_threads

    Notes
    -----
    The results are added in the order of the scenes, within a chunk and over chunks. For a given chunk size the result
    is therefore bitwise the same for every executor and number of workers. Loss and scenes are pickled once. If pickle
    fails, as for lambdas, cloudpickle is used if it is installed. Each worker caches the unpickled objects, so that it
    sets up a solver only once. The pickled objects are sent with each task until every worker has them, and are sent
    again to a worker whose cache has dropped them. Each task receives x and returns a gradient of the size of x. If the
    loss raises an exception for a scene, an exception of the same type is raised; its message contains the index of
    the scene, and tasks that have not started are cancelled.

    First and second derivatives are supported, third derivatives are not. Only the leaves of x that are being
    differentiated cause gradient computations. `explain` counts the work of this process only.

    A script that starts processes must have its main part inside ``if __name__ == "__main__":``. Processes that are
    forked while compiled loops run in several threads may hang. To avoid this, start new processes with one thread
    each: ``ProcessPoolExecutor(2, multiprocessing.get_context("spawn"), dp.set_threads, (1,))``.

    Examples
    --------
    >>> total = ensemble(lambda x, scene: (x - scene) ** 2, [1.0, 2.0, 6.0], weights=[1, 1, 2])
    >>> value_and_grad(total)(3.0)
    (23.0, -6.0)
    """
    return Ensemble(loss, scenes, executor, weights, chunk, progress)


class Ensemble(Reconstructible):
    """The weighted sum of a loss over scenes. Returned by `ensemble`.

    Attributes
    ----------
    count : int
        Number of scenes.
    """

    name = "ensemble"

    def __init__(
        self,
        loss: Callable,
        scenes: Iterable,
        executor: Any = None,
        weights: ArrayLike | None = None,
        chunk: int | None = None,
        progress: bool | str = False,
    ) -> None:
        check_function("ensemble", loss, "lambda x, scene: ...")
        if not isinstance(scenes, Iterable):
            raise TypeError(
                f"ensemble takes a list of scenes, got {scenes!r}; write [first, second, ...], or range(n) for numbers"
            )
        scenes = [*map(copied, scenes)]
        self.count = len(scenes)
        if not scenes:
            raise ValueError("ensemble needs a scene, got none")
        if executor is not None and not hasattr(executor, "submit"):
            raise TypeError(
                f"ensemble takes an executor, got {type(executor).__name__}; write "
                "concurrent.futures.ProcessPoolExecutor(2)"
            )
        if chunk is not None:
            check_whole("chunk of ensemble", chunk, 1, "; the default is 1")
        if weights is None:
            weights = np.ones(self.count)
        weights = np.array(weights, float)
        check_shape("weights of ensemble", weights, (self.count,), "; give one number for each scene")
        check_finite("weights", weights)
        self._weights = weights.tolist()
        self.constructor_call = ensemble, (loss, scenes, executor, self._weights, chunk, progress)
        self._chunk = int(chunk or 1)
        self._executor = executor
        self._progress = progress
        if executor is None:
            self._loss = mapped(frozen, loss)
            self._scenes = [mapped(frozen, scene) for scene in scenes]
        else:
            self._loss = _packed(loss)
            self._scenes = [_packed(scene) for scene in scenes]
        self._held_keys: dict[str, set] = {}  # the keys of the cached objects of each worker, as far as known

    def __repr__(self):
        return f"<ensemble of {self.count} scenes>"

    @public("dp.ensemble(loss, scenes)")
    def __call__(self, x: Any, numbers: Sequence[int] | None = None) -> Any:
        """Return the weighted sum at x over all scenes, or over the scenes with the indices `numbers`."""
        if numbers is None:
            numbers = range(self.count)
        numbers = list(numbers)
        for number in numbers:
            if not is_whole(number, 0) or number >= self.count:
                raise IndexError(f"ensemble has scenes 0 to {self.count - 1}, got {number!r}")
        if not numbers:
            raise ValueError("ensemble needs a scene, got none")
        check_leaves("x", x, containers=False)
        x = copied(x)  # second derivatives are computed later, when the caller may have modified the arrays of x
        entries = leaves(x)
        variable_places = [place for place, leaf in enumerate(entries) if isbox(leaf)]
        gradients: Any = []

        def total(task, values, tangents=None):
            return self._sum(task, (_placed(x, variable_places, values), variable_places, tangents), numbers)

        def forward(*values):
            nonlocal gradients
            task = _value
            if values:
                task = _value_and_gradients
            result, *gradients = total(task, values)
            return result

        def gradients_at(values):
            if any(map(isbox, values)):
                return gradient(*values)
            return gradients

        def jvp(nums, tangents, ans, *values):
            at = gradients_at(values)
            return sum(anp.real(anp.sum(at[num] * tangent)) for num, tangent in zip(nums, tangents, strict=True))

        def vjp(nums, ans, *values):
            at = gradients_at(values)

            def pull(g):
                return tuple(g * at[num] for num in nums)

            return pull

        def gradient_at(*values):
            return tuple(total(_value_and_gradients, values)[1:])

        def hessian_product(*values_and_tangents):
            values = values_and_tangents[: len(variable_places)]
            tangents = values_and_tangents[len(variable_places) :]
            return tuple(total(_hessian_product, values, tangents))

        def gradient_jvp(nums, tangents, ans, *values):
            tangent_of = dict(zip(nums, tangents, strict=True))
            return hessian(*values, *(tangent_of.get(num, zero_like(leaf)) for num, leaf in enumerate(values)))

        def gradient_vjp(nums, ans, *values):  # the Hessian is symmetric
            def pull(g):
                product = hessian(*values, *(g[num] for num in range(len(values))))
                return tuple(product[num] for num in nums)

            return pull

        hessian = Rule("ensemble", hessian_product)
        gradient = Rule("ensemble", gradient_at, gradient_vjp, gradient_jvp)
        return Rule("ensemble", forward, vjp, jvp)(*(entries[place] for place in variable_places))

    def _sum(self, task, point, numbers):
        """Return the sum of the results of a task over scenes, added in the order of `numbers`."""
        chunks = []
        for begin in range(0, len(numbers), self._chunk):
            scenes = [(n, self._weights[n], self._scenes[n]) for n in numbers[begin : begin + self._chunk]]
            chunks.append((task, self._loss, point, scenes, self.count))
        futures: list = []
        total = None
        try:
            if self._executor is not None:
                futures += map(self._submitted, chunks)
            for number in shown_steps(self._progress, range(len(chunks)), "scenes"):
                if futures:
                    parts = self._result_of_task(chunks[number], futures[number])
                else:
                    parts = _sum(*chunks[number])
                total = _added(total, parts)
        finally:
            for future in futures:
                future.cancel()
        return total

    def _submitted(self, chunk):
        """Submit a task, with the pickled objects that at least one worker may not have in its cache."""
        task, loss, point, scenes, count = chunk
        pickles = dict([loss, *(pickled for _, _, pickled in scenes)])
        held = [*self._held_keys.values()]
        data_of_key = {}
        for key, data in pickles.items():
            if not held or any(key not in held_keys for held_keys in held):
                data_of_key[key] = data
        keys = [(n, weight, pickled[0]) for n, weight, pickled in scenes]
        return self._executor.submit(_run_pickled, [*pickles], data_of_key, task, loss[0], point, keys, count)

    def _result_of_task(self, chunk, future):
        """Return the result of a task. If its worker's cache lacks an object, submit the task again with the object."""
        keys, worker, parts = future.result()
        if parts is None:
            self._held_keys[worker] = set()
            return self._result_of_task(chunk, self._submitted(chunk))
        self._held_keys.setdefault(worker, set()).update(keys)
        return parts


# ---- in a worker -----------------------------------------------------------------------------------------------------


# Read-only unpickled objects by key, including the solvers that they have set up; the most recently used one is last.
_cache: OrderedDict = OrderedDict()
_cache_lock = RLock()  # a worker may have several threads


def _run_pickled(keys, data_of_key, task, loss, point, scenes, count):
    """Run a task in a worker.

    Return the keys, the name of this worker, and the result of `_sum`, or None if an object is missing in the cache.
    """
    worker = f"{node()} {os.getpid()}"
    unpickled = {}
    with _cache_lock:
        for key in keys:
            if key not in _cache:
                if key not in data_of_key:
                    return keys, worker, None
                _cache[key] = mapped(frozen, pickle.loads(data_of_key[key]))
            _cache.move_to_end(key)
            unpickled[key] = _cache[key]
        while len(_cache) > CACHED:
            _cache.popitem(last=False)
    weighted_scenes = [(n, weight, unpickled[key]) for n, weight, key in scenes]
    return keys, worker, _sum(task, unpickled[loss], point, weighted_scenes, count)


def _sum(task, loss, point, scenes, count):
    """Return the sum of the results of a task over scenes, a list of (number, weight, scene), in their order."""
    x, variable_places, tangents = point
    total = None
    x = mapped(frozen, x)
    values = [leaves(x)[place] for place in variable_places]
    for number, weight, scene in scenes:
        try:
            parts = task(partial(_loss_of_values, loss, scene, x, variable_places), values, tangents)
        except Exception as error:
            if error.args and not isinstance(error.args[0], str):
                raise RuntimeError(f"scene {number} of {count} raised {type(error).__name__}: {error}") from error
            message = error.args[0] if error.args else type(error).__name__
            error.args = f"scene {number} of {count}: {message}", *error.args[1:]
            raise
        total = _added(total, [weight * part for part in parts])
    return total


def _loss_of_values(loss, scene, x, variable_places, values):
    """Return the loss of one scene, with the variable leaves of x replaced by `values`."""
    return loss(_placed(x, variable_places, values), scene)


def _value(loss, values, tangents):
    """Return the value of a loss, as a task of `_sum`."""
    value = loss(values)
    check_loss(value)
    return [float(value)]


def _value_and_gradients(loss, values, tangents):
    """Return the value and the gradient of a loss, as a task of `_sum`."""
    with unwarned():  # warnings are issued once, for the gradient of the sum
        value, gradients = value_and_grad(loss)(values)
    return [value, *gradients]


def _hessian_product(loss, values, tangents):
    """Return the product of the Hessian of a loss with the tangents, as a task of `_sum`."""
    with unwarned():
        return jvp(grad(loss), values, list(tangents))[1]


def _placed(x, variable_places, values):
    """Return the tree x with its variable leaves replaced by `values`."""
    entries, rebuild = flatten(x)
    return rebuild(placed(entries, variable_places, values))


def _added(total, parts):
    """Return the elementwise sum of two lists; the first may be None."""
    if total is None:
        return parts
    return [a + b for a, b in zip(total, parts, strict=True)]


def _packed(value):
    """Pickle an object; return the hash of the pickled bytes as its key, and the bytes."""
    data = _pickled(value)
    return sha256(data).hexdigest(), data


def _pickled(value):
    """Pickle an object, by cloudpickle if pickle fails."""
    try:
        return pickle.dumps(value, 5)
    except Exception as error:
        try:
            import cloudpickle
        except ImportError:
            raise TypeError(
                f"ensemble cannot send {type(value).__name__} to another process ({error}); write functions as a def "
                "at the top level of a module, or install cloudpickle"
            ) from error
        return cloudpickle.dumps(value, 5)
