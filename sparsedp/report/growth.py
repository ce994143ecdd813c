"""The growth factor of a time step: by how much a small change of the state grows in one step.

A change is carried along the run by the tangent of the step and made small again after each step; what it grows
by, once the fastest mode has won, is the growth factor (G. Benettin et al., Meccanica 15, 1980). Above 1 is not
wrong in itself: unstable physics grows. It is the step that is wrong when the fastest mode changes its sign from
step to step, or when the growth per unit of time falls with the step.
"""

from typing import Any, NamedTuple

import numpy as np

from sparsedp.check.probes import generator
from sparsedp.derivative import NO_JVP, pushforward
from sparsedp.errors import SparsedpError
from sparsedp.ledger import thread
from sparsedp.tape import is_variable
from sparsedp.tree import flatten, norm

__all__ = ["STEADY", "Growth", "Loop", "growth_of", "loop_of"]

STEPS, SETTLED = 40, 20  # steps in all, and those that are measured
STEADY = 1.0 + 1e-3  # growth factors up to here do not count as growth
SMALL = 1e-6  # change of the state, in units of itself, where a step has no tangent


class Loop(NamedTuple):
    """A time loop that a loss runs: one step of it, and where it starts."""

    advance: Any
    state: Any


class Growth(NamedTuple):
    """Growth factor of one step; whether the fastest mode flips its sign; why there is none."""

    factor: float
    flips: bool = False
    refusal: str = ""


class Found(Exception):
    """Carries the first loop out of a loss, before it runs."""


def loop_of(loss, x, step=None):
    """Loss and point -> its first rollout as a Loop, or None. `step(x)` gives (advance, state) instead."""
    if step is not None:
        return Loop(*step(x))
    found: list = []

    def told(step, state, params, inputs, n):
        if n:
            found.append(Loop(_advance(step, params, inputs), state))
            raise Found

    thread.loops.append(told)
    try:
        loss(x)
    except Found:
        return found[0]
    finally:
        thread.loops.remove(told)
    return None


def _advance(step, params, inputs):
    if inputs is None:
        return lambda state: step(state, params)
    found, rebuild = flatten(inputs)
    first = rebuild([leaf[0] if isinstance(leaf, np.ndarray) else leaf for leaf in found])
    return lambda state: step(state, params, first)


def growth_of(loss, x, step=None, rng=None):
    """Loss and point -> Growth of the step of its loop; None without a loop."""
    with np.errstate(all="ignore"):
        try:
            loop = loop_of(loss, x, step)
            return None if loop is None else _measured(loop, generator(rng))
        except (SparsedpError, ValueError, ArithmeticError, RuntimeError) as error:
            return Growth(np.nan, refusal=type(error).__name__)


def _measured(loop, rng):
    state = loop.state
    v = _unit([np.asarray(rng.standard_normal(np.shape(leaf))) for leaf in _floating(state)])
    sizes, signs = [], []
    for _ in range(STEPS):
        state, moved = _pushed(loop.advance, state, v)
        size = norm(moved)
        if not np.isfinite(size):
            return Growth(np.inf, True)
        if size == 0:
            return Growth(0.0)
        sizes.append(size)
        signs.append(sum(float(np.sum(a * b).real) for a, b in zip(v, moved, strict=True)) < 0)
        v = [part / size for part in moved]
    return Growth(float(np.exp(np.mean(np.log(sizes[-SETTLED:])))), float(np.mean(signs[-SETTLED:])) > 0.5)


def _floating(state):
    return [leaf for leaf in flatten(state)[0] if is_variable(leaf)]


def _unit(parts):
    size = norm(parts) or 1.0
    return [part / size for part in parts]


def _with(state, parts):
    """The tree of a state with other floating leaves."""
    leaves, rebuild = flatten(state)
    fresh = iter(parts)
    return rebuild([next(fresh) if is_variable(leaf) else leaf for leaf in leaves])


def _pushed(advance, state, v):
    """(next state, change of it) for a change of the state."""
    try:
        after, moved = pushforward(advance, state, _with(state, v))
        return after, [m for a, m in zip(flatten(after)[0], flatten(moved)[0], strict=True) if is_variable(a)]
    except NO_JVP:  # a rule without a JVP
        here = _floating(state)
        t = SMALL * (norm(here) or 1.0)
        after = advance(state)
        other = advance(_with(state, [a + t * b for a, b in zip(here, v, strict=True)]))
        return after, [(b - a) / t for a, b in zip(_floating(after), _floating(other), strict=True)]
