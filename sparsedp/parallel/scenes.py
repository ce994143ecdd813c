"""One loss over many scenes: its weighted sum and the derivatives of it, computed by the workers of any executor."""

from __future__ import annotations

import os
import pickle
from collections import OrderedDict
from collections.abc import Callable, Iterable
from hashlib import sha256
from platform import node
from threading import RLock
from typing import Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.calls import public
from sparsedp._utils.progress import shown_steps
from sparsedp._utils.pytree import copied, flatten, leaves, mapped, placed
from sparsedp._utils.reconstruction import Reconstructible
from sparsedp._utils.validation import check_finite, check_function, check_leaves, check_shape, check_whole, is_whole
from sparsedp.autodiff.derivative import check_loss, grad, jvp, unwarned, value_and_grad, zero_like
from sparsedp.autodiff.tape import Rule, isbox
from sparsedp.autodiff.tape_constants import frozen

__all__ = ["Ensemble", "ensemble"]

CACHED = 128  # scenes and losses that a worker keeps as they were unpacked, with all that they have set up since


def ensemble(
    loss: Callable,
    scenes: Iterable,
    executor: Any = None,
    weights: Any = None,
    chunk: int | None = None,
    progress: bool | str = False,
) -> Ensemble:
    """Return the function total(x), the weighted sum of loss(x, scene) over all scenes, differentiable in x.

    Parameters
    ----------
    loss : callable
        ``loss(x, scene)``, a real scalar; `x` is any nesting of arrays, tuples, lists and dicts.
    scenes : iterable
        Whatever the loss takes: observations, initial states, grids, solvers.
    executor : concurrent.futures.Executor, optional
        Such as ``ProcessPoolExecutor``, Dask's ``client.get_executor()``, mpi4py's ``MPIPoolExecutor``.
        Default: this process, one scene after the other. The caller starts it and shuts it down.
    weights : array (number of scenes,), optional
        Default: ones.
    chunk : int, optional
        Scenes of one task; default 1. More of them make fewer messages: a task returns one sum.
    progress : bool or str
        A bar over the tasks of each evaluation, with this label.

    Returns
    -------
    Ensemble
        ``total(x)``, or ``total(x, numbers)`` over the scenes of these numbers, in this order: a batch of `minimize`.

    Raises
    ------
    TypeError
        If `loss` is no function, the executor has no `submit`, or a scene cannot be pickled.
    ValueError
        If there is no scene, or `chunk` is no whole number from 1 on.
    ShapeError, NonFiniteError
        If there is not one finite weight for each scene.
    IndexError
        On use, if there is no scene of a number.

    Notes
    -----
    Sums are taken in the order of the scenes, within a chunk and over chunks: the bits do not depend on the executor,
    nor on how many workers it has. Loss and scenes are pickled once (by cloudpickle, where that is installed and
    functions have no name). A worker keeps what it has unpacked, so each sets up a solver once; the bytes go with a
    task until every worker has them, and again to one that has not. With each task goes x, and back comes a gradient
    of its size. An error has the type that it has here, and names its scene; tasks that have not begun are cancelled.

    Derivatives of second order are right, too; of third order there are none. Only the leaves of x that are traced
    are differentiated. `explain` counts what this process does.

    A script that starts processes needs ``if __name__ == "__main__":`` around what it does. Processes that are
    forked while compiled loops run on several threads may hang: start them afresh, with one thread each, by
    ``ProcessPoolExecutor(2, multiprocessing.get_context("spawn"), dp.set_threads, (1,))``.

    Examples
    --------
    >>> total = ensemble(lambda x, scene: (x - scene) ** 2, [1.0, 2.0, 6.0], weights=[1, 1, 2])
    >>> value_and_grad(total)(3.0)
    (23.0, -6.0)
    """
    return Ensemble(loss, scenes, executor, weights, chunk, progress)


class Ensemble(Reconstructible):
    """The weighted sum of a loss over scenes. Made by `ensemble`.

    Attributes
    ----------
    count : int
        Of scenes.
    """

    name = "ensemble"

    def __init__(
        self,
        loss: Any,
        scenes: Any,
        executor: Any = None,
        weights: Any = None,
        chunk: Any = None,
        progress: Any = False,
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
        self._weights = np.ones(self.count) if weights is None else np.array(weights, float)
        check_shape("weights of ensemble", self._weights, (self.count,), "; give one number for each scene")
        check_finite("weights", self._weights)
        self._weights = self._weights.tolist()
        self.made = ensemble, (loss, scenes, executor, self._weights, chunk, progress)
        self._chunk = int(chunk or 1)
        self._executor = executor
        self._progress = progress
        self._loss, *self._scenes = (_packed(x) if executor is not None else mapped(frozen, x) for x in (loss, *scenes))
        self._holders: dict = {}  # worker that has answered -> the keys of what it has

    def __repr__(self):
        return f"<ensemble of {self.count} scenes>"

    @public("dp.ensemble(loss, scenes)")
    def __call__(self, x: Any, numbers: Any = None) -> Any:
        numbers = list(range(self.count) if numbers is None else numbers)
        for number in numbers:
            if not is_whole(number, 0) or number >= self.count:
                raise IndexError(f"ensemble has scenes 0 to {self.count - 1}, got {number!r}")
        if not numbers:
            raise ValueError("ensemble needs a scene, got none")
        check_leaves("x", x, containers=False)
        x = copied(x)  # the caller may write into what is not traced, before a second derivative is asked for
        entries = leaves(x)
        moving = [place for place, leaf in enumerate(entries) if isbox(leaf)]
        slopes: Any = []

        def total(task, values, tangents=None):
            return self._sum(task, (_placed(x, moving, values), moving, tangents), numbers)

        def value(*values):
            result, *slopes[:] = total(_slopes if values else _value, values)
            return result

        def slopes_at(values):
            return gradient(*values) if any(map(isbox, values)) else slopes

        def along(nums, tangents, ans, *values):
            at = slopes_at(values)
            return sum(anp.real(anp.sum(at[num] * tangent)) for num, tangent in zip(nums, tangents, strict=True))

        def back(nums, ans, *values):
            at = slopes_at(values)
            return lambda g: tuple(g * at[num] for num in nums)

        def curved(nums, tangents, ans, *values):
            given = dict(zip(nums, tangents, strict=True))
            return hessian(*values, *(given.get(num, zero_like(one)) for num, one in enumerate(values)))

        def curved_back(nums, ans, *values):  # the Hessian is symmetric
            def pull(g):
                product = hessian(*values, *(g[num] for num in range(len(values))))
                return tuple(product[num] for num in nums)

            return pull

        hessian = Rule("ensemble", lambda *both: tuple(total(_curvature, both[: len(moving)], both[len(moving) :])))
        gradient = Rule("ensemble", lambda *values: tuple(total(_slopes, values)[1:]), curved_back, curved)
        return Rule("ensemble", value, back, along)(*(entries[place] for place in moving))

    def _sum(self, task, point, numbers):
        """What a task returns, added up over scenes in their order."""
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
                parts = self._answer(chunks[number], futures[number]) if futures else _sum(*chunks[number])
                total = _added(total, parts)
        finally:
            for future in futures:
                future.cancel()
        return total

    def _submitted(self, chunk):
        """A task, with the bytes of what some worker may not have."""
        task, loss, point, scenes, count = chunk
        parcels = dict([loss, *(parcel for _, _, parcel in scenes)])
        held = [*self._holders.values()]
        bodies = {key: data for key, data in parcels.items() if not held or any(key not in keys for keys in held)}
        keys = [(n, weight, parcel[0]) for n, weight, parcel in scenes]
        return self._executor.submit(_of_parcels, [*parcels], bodies, task, loss[0], point, keys, count)

    def _answer(self, chunk, future):
        """What a task returns; where its worker has lost what it had, or is a new one, it is sent again with all."""
        keys, worker, parts = future.result()
        if parts is None:
            self._holders[worker] = set()
            return self._answer(chunk, self._submitted(chunk))
        self._holders.setdefault(worker, set()).update(keys)
        return parts


# ---- in a worker -----------------------------------------------------------------------------------------------------


_cache: OrderedDict = OrderedDict()  # key -> what was unpacked, read-only, with what it set up since; last used last
_alone = RLock()  # a worker may have several threads


def _of_parcels(keys, bodies, task, loss, point, scenes, count):
    """(keys, this worker, what `_sum` returns of what they stand for; None where it has not all of them)."""
    worker = f"{node()} {os.getpid()}"
    found = {}
    with _alone:
        for key in keys:
            if key not in _cache:
                if key not in bodies:
                    return keys, worker, None
                _cache[key] = mapped(frozen, pickle.loads(bodies[key]))
            _cache.move_to_end(key)
            found[key] = _cache[key]
        while len(_cache) > CACHED:
            _cache.popitem(last=False)
    return keys, worker, _sum(task, found[loss], point, [(n, weight, found[key]) for n, weight, key in scenes], count)


def _sum(task, loss, point, scenes, count):
    """What a task returns over some scenes (number, weight, scene), added up in their order."""
    (x, moving, tangents), total = point, None
    x = mapped(frozen, x)
    values = [leaves(x)[place] for place in moving]
    for number, weight, scene in scenes:
        try:
            parts = task(lambda values, scene=scene: loss(_placed(x, moving, values), scene), values, tangents)
        except Exception as error:
            if error.args and not isinstance(error.args[0], str):
                raise RuntimeError(f"scene {number} of {count} raised {type(error).__name__}: {error}") from error
            words = error.args[0] if error.args else type(error).__name__
            error.args = f"scene {number} of {count}: {words}", *error.args[1:]
            raise
        total = _added(total, [weight * part for part in parts])
    return total


def _value(of, values, tangents):
    value = of(values)
    check_loss(value)
    return [float(value)]


def _slopes(of, values, tangents):
    with unwarned():  # the gradient of the whole ensemble is examined
        value, slopes = value_and_grad(of)(values)
    return [value, *slopes]


def _curvature(of, values, tangents):
    with unwarned():
        return jvp(grad(of), values, list(tangents))[1]


def _placed(x, moving, values):
    """Return a tree with other values at its variable leaves."""
    entries, rebuild = flatten(x)
    return rebuild(placed(entries, moving, values))


def _added(total, parts):
    return parts if total is None else [a + b for a, b in zip(total, parts, strict=True)]


def _packed(thing):
    """Return a key for the pickled bytes of an object, and these bytes."""
    data = _pickled(thing)
    return sha256(data).hexdigest(), data


def _pickled(thing):
    try:
        return pickle.dumps(thing, 5)
    except Exception as error:
        try:
            import cloudpickle
        except ImportError:
            raise TypeError(
                f"ensemble cannot send {type(thing).__name__} to another process ({error}); write functions as a def "
                "at the top level of a module, or install cloudpickle"
            ) from error
        return cloudpickle.dumps(thing, 5)
