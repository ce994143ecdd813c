"""rollout: values and derivatives against the loop written out, at every memory budget."""

import re

import autograd
import autograd.numpy as anp
import numpy as np
import pytest
from journeys import check_journey

import sparsedp as dp
from sparsedp._utils.pytree import flatten, leaves
from sparsedp.autodiff.derivative import pullback, pushforward
from sparsedp.trajectory.checkpoint_plan import advances, stride

N = 9
START = {"u": np.array([0.3, -1.2, 0.8, 0.1, 2.0]), "v": np.array([1.0, 0.2, -0.4, 0.9, -0.7]), "turn": 0, "name": "a"}
PARAMS = {"k": np.linspace(0.5, 1.5, 5), "c": 0.7, "grid": None}
FORCE = np.sin(np.arange(5.0 * N)).reshape(N, 5)
MEMORY = [1216, 1296, 1376, 1456, 1536, 1700, "2 kB", 1e6]


def step(state, params, force=0.0):
    u = state["u"]
    v = state["v"]
    moved = v - 0.1 * u * anp.roll(u, 1) * params["c"] + 0.1 * force
    return {"v": moved, "u": u + 0.1 * anp.sin(params["k"] * v), "turn": state["turn"] + 1, "name": "a"}


def unrolled(state, params, n, inputs=None):
    """The loop, every step on the tape."""
    states = [state]
    for i in range(n):
        states.append(step(states[-1], params) if inputs is None else step(states[-1], params, inputs[i]))
    return states


def measure(state):
    return anp.sum(state["u"] ** 2 * anp.array([1.0, 2.0, 3.0, 4.0, 5.0])) + anp.sum(anp.cos(state["v"]))


def by_loop(x):
    return measure(unrolled(x[0], x[1], N, x[2])[-1])


def by_rollout(x, **options):
    return measure(dp.rollout(step, x[0], x[1], N, inputs=x[2], **options))


def gap(one, other):
    pairs = [
        (a, b) for a, b in zip(leaves(one), leaves(other), strict=True) if not isinstance(a, (int, str, type(None)))
    ]
    return max(float(np.max(np.abs(np.asarray(a) - np.asarray(b)))) for a, b in pairs)


@pytest.mark.parametrize("inputs", [None, FORCE])
def test_value_and_gradient(inputs):
    x = (START, PARAMS, inputs)
    wanted = dp.value_and_grad(by_loop)(x)
    found = dp.value_and_grad(by_rollout)(x)
    assert wanted[0] == found[0]
    assert gap(wanted[1], found[1]) < 1e-14
    assert dp.check.gradient(by_rollout, x, quick=True)


@pytest.mark.parametrize("memory", MEMORY)
def test_bits_of_the_gradient_do_not_depend_on_memory(memory):
    x = (START, PARAMS, FORCE)
    value, slope = dp.value_and_grad(by_rollout)(x)
    again, same = dp.value_and_grad(lambda x: by_rollout(x, memory=memory))(x)
    assert again == value and gap(slope, same) == 0.0


def test_all_states():
    states = dp.rollout(step, START, PARAMS, N, keep="all")
    wanted = unrolled(START, PARAMS, N)
    for name in ("u", "v", "turn"):
        assert np.array_equal(states[name], np.stack([state[name] for state in wanted]))
    assert states["name"] == "a"


@pytest.mark.parametrize("keep", [[N], range(0, N + 1, 2), np.array([1, N - 1])])
def test_some_states(keep):
    some, states = (dp.rollout(step, START, PARAMS, N, keep=which) for which in (keep, "all"))
    for name in ("u", "v", "turn"):
        assert np.array_equal(some[name], states[name][list(keep)])
    assert some["name"] == "a" and some["u"].flags.writeable


def test_a_step_may_return_the_same_array_each_time():
    """In every mode: where nothing is traced, forward, back, and both."""
    work = np.zeros(2)

    def count(state, _):
        work[:] = state["n"] + 1.0
        return {"a": 2.0 * state["a"], "n": state["n"] + 1, "w": work}

    def run(a, keep):
        states = dp.rollout(count, {"a": a, "n": 0, "w": np.zeros(2)}, None, 4, keep=keep)
        return states["a"] * states["w"][:, 0]

    for keep in ("all", [1, 3, 4]):
        powers = np.array([0.0, 2.0, 8.0, 24.0, 64.0])[slice(None) if keep == "all" else keep]
        value, slope = dp.jvp(lambda a, keep=keep: run(a, keep), 1.0, 1.0)
        again, pull = dp.vjp(lambda a, keep=keep: run(a, keep), 1.0)
        assert np.array_equal(run(1.0, keep), powers)
        assert np.array_equal(value, powers) and np.array_equal(slope, powers) and np.array_equal(again, powers)
        assert pull(np.ones(powers.size)) == powers.sum()
        assert dp.hvp(lambda a, keep=keep: anp.sum(run(a, keep) * a), 1.0, 1.0) == 2 * powers.sum()


@pytest.mark.parametrize("keep", ["last", "all", lambda i, state: state])
def test_a_step_that_writes_into_the_memory_of_its_state(keep):
    """It reads state[1] after it has written into the array that it returned as such."""
    work = np.zeros(2)

    def mixed(state, p):
        u, w = state
        work[:] = 0.5 * w + 1.0
        return u * p + 0.1 * w, work

    def run(step, p):
        states = dp.rollout(step, (np.ones(2), np.array([2.0, 3.0])), p, 4, keep=keep)
        return anp.sum((states[-1] if callable(keep) else states)[0] ** 2)

    fresh = lambda state, p: (state[0] * p + 0.1 * state[1], 0.5 * state[1] + 1.0)
    wanted, slope = dp.value_and_grad(lambda p: run(fresh, p))(0.9)
    assert run(mixed, 0.9) == wanted
    assert dp.jvp(lambda p: run(mixed, p), 0.9, 1.0) == (wanted, pytest.approx(slope, rel=1e-13))


def hessian_product(loss, x, along, reverse):
    def slope(x):
        return dp.value_and_grad(loss)(x)[1]

    if not reverse:
        return pushforward(slope, x, along)[1]

    def paired(x):
        pairs = zip(leaves(slope(x)), leaves(along), strict=True)
        return sum(anp.sum(g * t) for g, t in pairs if g is not None)

    return dp.value_and_grad(paired)(x)[1]


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("memory", [None, 1240])
def test_second_order(reverse, memory, rng):
    x = (START, PARAMS, FORCE)
    found, rebuild = flatten(x)
    along = rebuild([rng.normal(size=np.shape(a))[()] if isinstance(a, (float, np.ndarray)) else a for a in found])
    wanted = hessian_product(by_loop, x, along, True)
    assert gap(wanted, hessian_product(lambda x: by_rollout(x, memory=memory), x, along, reverse)) < 1e-12


def test_a_pullback_may_be_used_again():
    for memory in (None, 1240):
        _, pull = pullback(lambda x: by_rollout(x, memory=memory), (START, PARAMS, FORCE))
        assert gap(pull(1.0), pull(1.0)) == 0.0


def test_binomial_schedule_is_optimal():
    def best(n, s, known):
        if n <= 1 or s == 1:
            return n * (n - 1) // 2
        if (n, s) not in known:
            known[n, s] = min(m + best(n - m, s - 1, known) + best(m, s, known) for m in range(1, n))
        return known[n, s]

    def ours(n, s):
        if n <= 1 or s == 1:
            return n * (n - 1) // 2
        m = stride(n, s)
        return m + ours(n - m, s - 1) + ours(m, s)

    known: dict = {}
    assert all(best(n, s, known) == advances(n, s) == ours(n, s) for n in range(60) for s in range(1, 8))


def test_steps_run_once_where_their_tapes_fit():
    """Small tapes and large budgets: no step and no solve runs again, and no bit of the gradient changes."""
    grid = dp.Grid((6, 5), size=1.0)
    solve = dp.inverse(dp.identity(grid.cells) - 0.01 * dp.laplacian(grid))
    u = np.cos(np.arange(30.0)).reshape(grid.shape)
    calls = []

    def step(u, k):
        calls.append(1)
        return solve(k * anp.floor(1.0 + u**2) * anp.sin(u))

    def slopes(memory=None):
        calls.clear()
        found = dp.value_and_grad(lambda x: anp.sum(dp.rollout(step, *x, 8, memory=memory) ** 2))((u, 0.9))
        return len(calls), found[1][0].tobytes(), found[1][1]

    many, *wanted = slopes()
    assert many == 8
    for memory, least, most in (("1 MB", 8, 8), (240 * 200, 9, 15), (240 * 20, 16, 16), (240 * 7, 17, 99)):
        many, *found = slopes(memory)
        assert found == wanted and least <= many <= most


@pytest.mark.parametrize("memory", [None, "1 MB", 240 * 40])
@pytest.mark.parametrize("period", [0, 2, 4, 11])
def test_steps_may_write_into_arrays_of_their_own(memory, period):
    """A tape that is kept must not see what a later step, or another rollout, writes there."""
    start = np.linspace(0.5, 1.0, 30)
    own = np.empty(30)
    order = np.empty(30, int)
    n = 12
    forcing = np.cos(np.arange(n) % (period or n))

    def reused(u, p, x):
        np.multiply(x, np.linspace(0.0, 1.0, 30), out=own)
        order[:] = np.roll(np.arange(30), int(9 * x))
        return anp.sin(u * own) * p + 0.1 * u[order] + 0.1 * anp.reshape(u, (1, 30))[(0, order)]

    def fresh(u, p, x):
        moved = u[np.roll(np.arange(30), int(9 * x))]
        return anp.sin(u * (x * np.linspace(0.0, 1.0, 30))) * p + 0.1 * moved + 0.1 * moved

    def slopes(step):
        def loss(x):
            first = dp.rollout(step, *x, n, inputs=forcing, memory=memory)
            return anp.sum(first * dp.rollout(step, *x, 3, inputs=forcing[3:6], memory=memory))

        return dp.value_and_grad(loss)((start, 0.9))[1]

    for found, wanted in zip(slopes(reused), slopes(fresh), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-13)


def test_masked_arrays_are_refused():
    u = np.arange(3.0)
    end = "; fill it first, and pass the mask as an array of its own"
    masked = np.ma.masked_array(u, u > 1)
    for message, call in {
        "rollout takes plain arrays, got a masked array as state['b'][1]": lambda: (same, {"b": (u, masked)}, None),
        "rollout takes plain arrays, got a masked array as params": lambda: (same, u, masked.astype(int)),
        "the step made a masked array of state": lambda: (lambda u, p: np.ma.masked_array(u, u > 1), u, None),
        "the step made a masked array of state[0]": lambda: (lambda s, p: [np.ma.masked_array(s[0])], [u], None),
    }.items():
        with pytest.raises(TypeError, match=re.escape(message + end)):
            dp.rollout(*call(), 2)
    with pytest.raises(
        TypeError, match="keep returned a masked array; fill it first, and pass the mask as an array of its own"
    ):
        dp.rollout(same, u, None, 2, keep=lambda i, u: np.ma.masked_array(u))


def same(u, p):
    return u


def puts_into_state(s, p):
    s["u"] = s["u"] * p["k"]
    return s


def scales_params(s, p):
    p["k"] = p["k"] * 1.1  # on a tape every step would start from the first value again
    return {"u": s["u"] * p["k"]}


def writes_times_params(s, p):
    u = s["u"]
    u *= p["k"]
    return {"u": u}


@pytest.mark.parametrize("memory", [None, 136])
@pytest.mark.parametrize(
    "step, message",
    [
        (puts_into_state, "the step changes the entries of state; return another dict or list"),
        (scales_params, "the step changes the entries of params; make what changes a part of the state"),
        (
            writes_times_params,
            "the step changes state['u'] in place; write u = u + du instead of u += du, or work on a copy",
        ),
    ],
)
def test_steps_that_change_their_arguments_are_refused_with_and_without_a_tape(step, message, memory):
    def last(p):
        return anp.sum(dp.rollout(step, {"u": np.ones(3)}, p, 9, memory=memory)["u"])

    for run in (last, dp.value_and_grad(last)):
        with pytest.raises(ValueError, match=re.escape(message)):
            run({"k": 0.5})


@pytest.mark.parametrize("step", [lambda u, k: u - k * u**3, dp.stepper("euler", dp.laplacian(dp.Grid(5)), 0.1)])
def test_second_derivative_in_a_number_of_python(step):
    def slope(k):
        return autograd.grad(lambda k: anp.sum(anp.sin(dp.rollout(step, START["u"], k, 4))))(k)

    assert autograd.grad(slope)(0.1) == autograd.grad(slope)(np.float64(0.1))
    assert autograd.grad(slope)(0.1) == pytest.approx((slope(0.1 + 1e-5) - slope(0.1 - 1e-5)) / 2e-5, rel=1e-6)


def test_the_gradient_of_a_rollout_enters_few_functions():
    def decay(u, rate):
        return u - 0.1 * rate * u

    gradient = dp.value_and_grad(lambda u: anp.sum(dp.rollout(decay, u, 1.0, 3) ** 2))
    check_journey(lambda: gradient(np.ones((20, 21))), functions=141, files=18)
