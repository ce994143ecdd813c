"""Schedules of optax as the rate of Adam in `minimize`, beside Adam of optax itself."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.io.fingerprint import fingerprint

jax = pytest.importorskip("jax", reason="jax is not installed: the extra `jax`")
optax = pytest.importorskip("optax", reason="optax is not installed")

STEPS = 12
START = {"a": np.array([1.0, 2.5]), "b": 0.3}
SCHEDULES = {
    "constant": lambda: optax.constant_schedule(0.1),
    "cosine": lambda: optax.cosine_decay_schedule(0.2, 10),
    "warm-up": lambda: optax.warmup_cosine_decay_schedule(0.01, 0.2, 4, 12),
    "pieces": lambda: optax.piecewise_constant_schedule(0.2, {5: 0.1}),
    "joined": lambda: optax.join_schedules(
        [optax.linear_schedule(0.1, 0.2, 5), optax.exponential_decay(0.2, 3, 0.5)], [5]
    ),
    "compiled": lambda: jax.jit(optax.exponential_decay(0.1, 10, 0.9)),
}


def loss(x):
    return anp.sum((x["a"] - 3.0) ** 4) + 2 * (x["b"] + 1.0) ** 2


@pytest.mark.parametrize("max_norm", [None, 2.0])
@pytest.mark.parametrize("schedule", SCHEDULES.values(), ids=SCHEDULES)
def test_adam_with_a_schedule_of_optax_takes_the_steps_of_optax(schedule, max_norm):
    """The gradient has the norm 64 at the start; one with a norm above 2 is clipped."""
    points = []
    dp.minimize(
        loss,
        START,
        "adam",
        STEPS,
        0,
        rate=schedule(),
        max_norm=max_norm,
        epsilon=1e-14,
        callback=lambda record, x: points.append(x) or False,
    )
    with jax.enable_x64(True):
        chain = [optax.adam(schedule(), eps=0.0)]
        if max_norm is not None:
            chain.insert(0, optax.clip_by_global_norm(max_norm))
        optimizer = optax.chain(*chain)
        x = jax.tree.map(jax.numpy.asarray, START)
        state = optimizer.init(x)
        for point in points:
            gradient = dp.grad(loss)(jax.tree.map(np.asarray, x))
            updates, state = optimizer.update(jax.tree.map(jax.numpy.asarray, gradient), state)
            x = optax.apply_updates(x, updates)
            assert np.allclose(point["a"], x["a"], rtol=1e-6, atol=1e-7)  # schedules compute in float32
            assert np.allclose(point["b"], x["b"], rtol=1e-6, atol=1e-7)
    assert len(points) >= STEPS


def test_a_schedule_of_optax_continues_its_own_run_only(tmp_path):
    run = {"method": "adam", "tolerance": 0}
    dp.minimize(loss, START, maxiter=4, rate=SCHEDULES["joined"](), checkpoint=tmp_path, **run)
    for name in ("cosine", "pieces", "compiled"):
        with pytest.raises(ValueError, match="holds a run with another set of options"):
            dp.minimize(loss, START, maxiter=8, rate=SCHEDULES[name](), checkpoint=tmp_path, **run)
    again = dp.minimize(loss, START, maxiter=8, rate=SCHEDULES["joined"](), checkpoint=tmp_path, **run)
    whole = dp.minimize(loss, START, maxiter=8, rate=SCHEDULES["joined"](), **run)
    assert again.resumed.startswith("resumed from iteration 4") and np.array_equal(again.x["a"], whole.x["a"])


@pytest.mark.parametrize("compiled", [False, True])
def test_schedules_of_optax_with_other_numbers_are_distinguished(compiled):
    wrap = jax.jit if compiled else lambda schedule: schedule
    decays = (0.9, 0.8, jax.numpy.array(0.9), jax.numpy.array(0.8))
    schedules = [lambda decay=decay: wrap(optax.exponential_decay(0.1, 10, decay)) for decay in decays]
    assert len({fingerprint(schedule()) for schedule in schedules}) == len(schedules)
    for schedule in schedules:
        called = schedule()
        called(3)
        assert fingerprint(called) == fingerprint(schedule())
