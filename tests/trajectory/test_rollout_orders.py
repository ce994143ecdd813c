"""rollout: derivatives of every order and mode, each against the loop on the tape, for every kind of step."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils.pytree import flatten, leaves
from sparsedp.autodiff.derivative import pushforward
from sparsedp.autodiff.tape import plain

pytestmark = pytest.mark.filterwarnings("ignore::sparsedp.errors.BudgetWarning")
N = 7
U = np.array([0.3, -0.5, 0.8])
FORCE = np.cos(np.arange(3.0 * N)).reshape(N, 3)
WEIGHTS = np.cos(np.arange(3.0 * (N + 1))).reshape(N + 1, 3)


def own_pull(nums, ans, u, p):
    slopes = lambda: (1 + 0.1 * p * anp.cos(p * u), 0.1 * u * anp.cos(p * u))
    return lambda g: tuple(anp.sum(g * slopes()[num]) if num else g * slopes()[num] for num in nums)


OWN = dp.differentiable("own", lambda u, p: u + 0.1 * np.sin(p * u), own_pull)


def tree(s, p, f):
    moved = s["u"] + 0.1 * anp.sin(p["a"] * s["u"]) * anp.roll(s["v"], 1) + 0.1 * f
    return {"u": moved, "v": s["v"] * p["b"] - 0.1 * s["u"] ** 2, "n": s["n"] + 1}


STEPS = {  # step, and what derivatives are taken in: state, params, inputs
    "tree": (tree, ({"u": U, "v": 0.7 * U[::-1], "n": 0}, {"a": 1.3, "b": 0.9}, FORCE)),
    "own": (OWN, (U, 1.1, None)),
    "no forward derivative": (lambda u, p: u + 0.1 * p * anp.real(anp.fft.ifft(anp.fft.fft(u) ** 2)), (U, 0.4, None)),
    "branch": (lambda u, p: u * p if plain(anp.sum(u)) > 0.3 else u - 0.1 * p * u**2, (U, 0.9, None)),
    "single": (lambda u, p: u * p + u.dtype.type(0.1) * u * u, (U.astype("f"), np.float32(0.9), None)),
    "complex": (lambda u, p: u * p + 0.1 * u * u, (U + 0.2j, 0.9 + 0.1j, None)),
}


def field(state):
    if isinstance(state, dict):
        return state["u"] + state["v"] ** 2
    return state


def by_loop(step, x, keep, truncate=None, memory=None):
    (state, p, inputs), total = x, 0.0
    for i in range(N + 1):
        total = total + (anp.sum(WEIGHTS[i] * field(state) ** 3) if i == N or keep != "last" else 0.0)
        if i < N:
            found, rebuild = flatten(state)
            cut = truncate and i and (N - i) % truncate == 0
            state = rebuild(map(plain, found)) if cut else state
            state = step(state, p, *([] if inputs is None else [inputs[i]]))
    return anp.real(total)


def by_rollout(step, x, keep, **options):
    kind = (lambda i, state: anp.sum(WEIGHTS[i] * field(state) ** 3)) if keep == "each" else keep
    out = dp.rollout(step, x[0], x[1], N, inputs=x[2], keep=kind, **options)
    if keep == "each":
        return anp.real(sum(out))
    return anp.real(anp.sum((WEIGHTS if keep == "all" else WEIGHTS[N]) * field(out) ** 3))


def paired(f, x, along):
    slopes = zip(leaves(dp.grad(f)(x)), leaves(along), strict=True)
    return sum(anp.sum(anp.real(g * t)) for g, t in slopes if g is not None)


ORDERS = {
    "reverse": lambda f, x, t: dp.grad(f)(x),
    "forward": lambda f, x, t: dp.jvp(f, x, t),
    "forward over reverse": lambda f, x, t: dp.hvp(f, x, t),
    "reverse over reverse": lambda f, x, t: dp.grad(lambda x: paired(f, x, t))(x),
    "reverse over forward": lambda f, x, t: dp.grad(lambda x: dp.jvp(f, x, t)[1])(x),
    "third": lambda f, x, t: dp.jvp(lambda x: dp.hvp(f, x, t), x, t),
}


KEPT = [
    {"keep": "last"},
    {"keep": "last", "memory": 900, "truncate": 3},
    {"keep": "all"},
    {"keep": "each", "memory": 1200},
]


@pytest.mark.whole
@pytest.mark.sampled
@pytest.mark.parametrize("options", KEPT, ids=["last", "last, truncated", "all", "each"])
@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("name", STEPS)
def test_every_order_is_that_of_the_loop(name, order, options, rng):
    step, x = STEPS[name]
    found, rebuild = flatten(x)
    numbers = [isinstance(leaf, (float, complex, np.ndarray, np.generic)) for leaf in found]
    random = [rng.normal(size=np.shape(leaf)) for leaf in found]
    along = rebuild(np.asarray(t, np.asarray(u).dtype)[()] if n else None for t, u, n in zip(random, found, numbers))
    ours, wanted = (
        [np.asarray(leaf) for leaf in leaves(ORDERS[order](lambda x: f(step, x, **options), x, along))]
        for f in (by_rollout, by_loop)
    )
    for one, other in zip(ours, wanted, strict=True):
        assert one.dtype == other.dtype
        if one.dtype != object:
            bound = 1e-3 if name == "single" else 1e-11
            assert np.max(np.abs(one - other)) <= bound * (1 + np.max(np.abs(other)))


def test_a_forward_derivative_runs_each_step_once_and_keeps_one_state():
    calls = []
    runs = []
    step = lambda u, p: calls.append(0) or u * p
    pushforward(lambda p: anp.sum(dp.rollout(step, U, p, N, record=runs.append)), 0.9, 1.0)
    assert len(calls) == N and [(run.direction, run.kept) for run in runs] == [("forward", 0)]


@pytest.mark.parametrize("keep", ["last", "all", "each"])
@pytest.mark.parametrize("memory", [None, 300])
def test_a_step_without_a_forward_derivative_has_its_pullback_differentiated(keep, memory):
    """A rule without a forward derivative behind the loop: the pullback itself is differentiated."""
    behind = lambda value: anp.sum(anp.real(anp.fft.fft(value * np.cos(np.arange(3.0)))) ** 2)
    step, x = STEPS["own"]
    found = dp.jvp(lambda x: behind(by_rollout(step, x, keep, memory=memory)), x, (U, 0.3, None))
    wanted = dp.jvp(lambda x: behind(by_loop(step, x, keep)), x, (U, 0.3, None))
    assert found == pytest.approx(wanted, rel=1e-12)


def test_a_value_of_an_outer_trace_in_a_step_is_right_or_refused():
    """Both derivatives of u p q where the step finds q outside its arguments, traced by the outer one only."""
    slope = lambda q: dp.grad(lambda p: anp.sum(dp.rollout(lambda u, p: u * p * q, U * q, p, 2)))(0.9)
    assert dp.grad(slope)(1.1) == pytest.approx(2 * 0.9 * 3 * 1.1**2 * np.sum(U), rel=1e-13)
    with pytest.raises(
        dp.errors.DerivativeError, match="the step uses a traced value that is not one of its arguments"
    ):
        dp.grad(lambda q: dp.grad(lambda p: anp.sum(dp.rollout(lambda u, p: u * p * q, U, p, 2)))(0.9))(1.1)
