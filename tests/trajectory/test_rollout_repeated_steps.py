"""Steps that are run again: what depends on more than its arguments is refused, or its gradient equals the gradient of
a plain loop.

The reference is a loop on the tape of autograd in which every step is called once, in order.
"""

import autograd
import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.derivative import pullback, pushforward
from sparsedp.errors import DerivativeError
from sparsedp.trajectory.specification import fingerprint

N = 12
U = np.array([0.3, -0.5, 0.8, 0.1])
BUDGETS = [None, *(16 + 2 * 8 * N + 32 * (slots + 4) for slots in (1, 2, 3, 4, 6, 9, 12, 200))]
WEIGHTS = np.cos(np.arange(4.0 * (N + 1))).reshape(N + 1, 4)
KEEPS = {
    "last": ("last", lambda out: anp.sum(WEIGHTS[0] * out**2), lambda all_: anp.sum(WEIGHTS[0] * all_[-1] ** 2)),
    "all": ("all", lambda out: anp.sum(WEIGHTS * out**2), lambda all_: anp.sum(WEIGHTS * anp.stack(all_) ** 2)),
    "each": (
        lambda i, u: (anp.sum(WEIGHTS[i] * u**3), i),
        lambda out: sum(value for value, _ in out),
        lambda all_: sum(anp.sum(w * u**3) for w, u in zip(WEIGHTS, all_)),
    ),
}
AGAIN = "^the step gives another state when it is run again; it must depend on its arguments only$"


def smooth(u, p):
    return u + 0.1 * anp.sin(p * u) * anp.roll(u, 1)


def even(u, p):
    """The sign of a state is forgotten by the next step."""
    return smooth(anp.sqrt(u**2), p)


STEPS = {  # number of the call, state, params -> state
    "pure": lambda c, u, p: smooth(u, p),
    "counter": lambda c, u, p: smooth(u, p) + 0.01 * c,
    "rounding": lambda c, u, p: smooth(u, p) * (1.0 + 1e-15 * c),
    "once": lambda c, u, p: smooth(u, p) * (1.5 if c == 5 else 1.0),
    "once, later": lambda c, u, p: smooth(u, p) * (1.5 if c == N + 1 else 1.0),
    "once, much later": lambda c, u, p: smooth(u, p) * (1.5 if c == N + 8 else 1.0),
    "cancels": lambda c, u, p: even(u, p) * (1.0 if c % 3 else -1.0),
    "cancels, later": lambda c, u, p: even(u, p) * (-1.0 if c == N + 3 else 1.0),
    "turns": lambda c, u, p: anp.roll(smooth(u, p), 1 if c % 3 else -1),
}


class Counted:
    """A step that knows how often it was called."""

    def __init__(self, name):
        self.calls = 0
        self.of = STEPS[name]

    def __call__(self, u, p, *inputs):
        self.calls += 1
        return self.of(self.calls - 1, u, p) + sum(inputs)


def by_loop(name, keep, inputs, truncate, p):
    step = Counted(name)
    states = [U]
    for i in range(N):
        u = autograd.tracer.getval(states[-1]) if truncate and i and (N - i) % truncate == 0 else states[-1]
        states.append(step(u, p, *([] if inputs is None else [inputs[i]])))
    return KEEPS[keep][2](states)


@pytest.mark.sampled(1)
@pytest.mark.filterwarnings("ignore::sparsedp.errors.BudgetWarning")
@pytest.mark.parametrize("keep", KEEPS)
@pytest.mark.parametrize("name", STEPS)
def test_refused_or_right(name, keep):
    refused = 0
    for inputs, truncate in ((None, None), (0.1 * np.sin(np.arange(N)), None), (None, 5)):
        value, slope = autograd.value_and_grad(lambda p: by_loop(name, keep, inputs, truncate, p))(1.3)
        for memory in BUDGETS:
            step = Counted(name)
            options = {"inputs": inputs, "memory": memory, "truncate": truncate}
            loss = lambda p: KEEPS[keep][1](dp.rollout(step, U, p, N, keep=KEEPS[keep][0], **options))
            try:
                found = dp.value_and_grad(loss)(1.3)
            except DerivativeError as error:
                assert "when it is" in str(error) and step.calls > N
                refused += 1
            else:
                assert found == pytest.approx((value, slope), rel=1e-11)
    assert refused == 0 if name == "pure" else refused > 5


@pytest.mark.whole
@pytest.mark.sampled(1)
@pytest.mark.filterwarnings("ignore::sparsedp.errors.BudgetWarning")
@pytest.mark.parametrize("keep", KEEPS)
@pytest.mark.parametrize("name", ["pure", "counter", "once, much later", "cancels", "cancels, later"])
def test_tangents_and_second_derivatives_are_refused_or_right(name, keep):
    """The run that carries the tangents must pass through the returned states."""
    slope = lambda f: lambda p: dp.value_and_grad(f)(p)[1]
    ways = {
        "forward": lambda f: pushforward(f, 1.3, 1.0)[1],
        "forward over reverse": lambda f: pushforward(slope(f), 1.3, 1.0)[1],
        "reverse over reverse": lambda f: slope(slope(f))(1.3),
        "a pullback twice": lambda f: [pull := pullback(f, 1.3)[1], pull(1.0), pull(1.0)][-1],
    }
    first = autograd.grad(lambda p: by_loop(name, keep, None, None, p))
    wanted = {way: autograd.grad(first)(1.3) if "over" in way else first(1.3) for way in ways}
    refused = 0
    for memory in BUDGETS[:5]:
        for way, derivative in ways.items():
            step = Counted(name)
            try:
                found = derivative(
                    lambda p: KEEPS[keep][1](dp.rollout(step, U, p, N, keep=KEEPS[keep][0], memory=memory))
                )
            except DerivativeError:
                refused += 1
            else:
                assert found == pytest.approx(wanted[way], rel=1e-9)
    assert refused == 0 if name == "pure" else refused > 2


@pytest.mark.parametrize("memory", [32 * 5 + 16, 600])
def test_a_hidden_counter_under_a_budget(memory):
    with pytest.raises(DerivativeError, match=AGAIN):
        dp.value_and_grad(lambda p: anp.sum(dp.rollout(Counted("counter"), U, p, 40, memory=memory)))(1.3)


def test_a_keep_function_that_is_called_again():
    calls = []
    loss = lambda p: sum(dp.rollout(smooth, U, p, 3, keep=lambda i, u: calls.append(0) or u[0] * len(calls)))
    with pytest.raises(
        DerivativeError,
        match="keep returns something else when it is called again; it must depend on its arguments only",
    ):
        dp.value_and_grad(loss)(1.3)
    calls.clear()  # a derivative forward calls it once
    slope = pushforward(loss, 1.3, 1.0)[1]
    states = lambda p: [u := U] + [u := smooth(u, p) for _ in range(3)]
    wanted = autograd.grad(lambda p: sum((i + 1) * u[0] for i, u in enumerate(states(p))))(1.3)
    assert slope == pytest.approx(wanted, rel=1e-13)


@pytest.mark.parametrize("keep", ["last", "all"])
@pytest.mark.parametrize("changed", ["one array", "all arrays", "a number"])
def test_values_changed_before_the_backward_pass(changed, keep):
    """A list of arrays beside the arguments, and a table that everybody may change."""
    steps = {
        "tree": lambda s, p: (s[0] * p * given[s[1]] + table["k"] * s[0] ** 2, s[1] + 1),
        "kept": lambda s, p: (s[0] * p * anp.cos(given[s[1]]) + table["k"] * s[0] ** 2, s[1] + 1),
    }
    for memory in BUDGETS[:1] + BUDGETS[2:]:
        for step in steps.values():
            given = list(np.linspace(0.5, 1.5, 4 * N).reshape(N, 4))
            table = {"k": 0.1}
            given = [one.copy() for one in given]
            loss = lambda p: anp.sum(dp.rollout(step, (U, 0), p, N, memory=memory, keep=keep)[0])
            wanted = dp.value_and_grad(loss)(0.9)[1]
            pull = pullback(loss, 0.9)[1]
            table["k"] = 0.3 if changed == "a number" else 0.1
            for one in {"one array": given[3:4], "all arrays": given}.get(changed, []):
                one[:] = 7.0
            try:
                assert pull(1.0) == wanted
            except DerivativeError as error:
                assert str(error).startswith("the step gives another state[0] when it is run again")


def donor(name):
    """A step with a derivative of its own, whose forward is impure in many ways; and its calls."""
    calls = []
    own = np.empty(4)

    def forward(u, p):
        calls.append(0)
        factor = {"counter": 1 + 0.01 * len(calls), "sign": 1.0 if len(calls) % 5 else -1.0}.get(name, 1.0)
        if name == "identity" and not np.sum(u) % 0.5 < 0.25:
            return u
        if name == "buffer":
            own[:] = u + 0.1 * np.abs(u) * p
            return own
        return factor * (u + 0.1 * np.abs(u) * p)

    def vjp(nums, ans, u, p):
        stays = name == "identity" and not np.sum(u) % 0.5 < 0.25
        slopes = (1.0, 0.0) if stays else (1 + 0.1 * np.sign(u) * p, 0.1 * np.abs(u))
        return lambda g: tuple(g * slopes[num] for num in nums)

    return dp.differentiable("donor", forward, vjp), calls


@pytest.mark.filterwarnings("ignore::sparsedp.errors.BudgetWarning")
@pytest.mark.parametrize("keep", KEEPS)
@pytest.mark.parametrize("name", ["identity", "buffer", "pure"])
def test_rules_may_return_their_argument_or_an_array_of_their_own(name, keep):
    def loop(x):
        states = [x[0]]
        for _ in range(N):
            u = states[-1]
            stays = name == "identity" and not np.sum(autograd.tracer.getval(u)) % 0.5 < 0.25
            states.append(u if stays else u + 0.1 * anp.abs(u) * x[1])
        return KEEPS[keep][2](states)

    x = (U, np.array([0.3, 0.4, 0.5, 0.6]))
    value, slopes = autograd.value_and_grad(loop)(x)
    for memory in (None, *(32 * (slots + 6) for slots in (1, 2, 4, 7, 30))):
        loss = lambda x: KEEPS[keep][1](dp.rollout(donor(name)[0], *x, N, keep=KEEPS[keep][0], memory=memory))
        again, found = dp.value_and_grad(loss)(x)
        assert again == pytest.approx(value, rel=1e-13)
        for one, other in zip(found, slopes, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-12)


@pytest.mark.filterwarnings("ignore::sparsedp.errors.BudgetWarning")
@pytest.mark.parametrize("name", ["counter", "sign"])
def test_rules_are_compared_where_they_are_run_again(name):
    for slots in (1, 2, 3, 4):
        step, calls = donor(name)
        with pytest.raises(DerivativeError, match=AGAIN):
            dp.value_and_grad(lambda u: anp.sum(dp.rollout(step, u, 0.3 * np.ones(4), 20, memory=32 * (slots + 5))))(U)
        assert len(calls) > 20


@pytest.mark.filterwarnings("ignore::sparsedp.errors.BudgetWarning")
@pytest.mark.parametrize("size", [8, 3001])
def test_nan_and_zeros_of_both_signs_are_no_other_result(size):
    """NaN in a state on the way, gone at the end; zeros that keep their sign."""
    u = np.linspace(-1.0, 1.0, size)
    u[::3] = -0.0

    def step(s, p):
        bad = np.where(np.arange(size) == 3, np.nan, 0.0) if s[1] == 4 else np.zeros(size)
        return anp.where(np.arange(size) == 3, 0.5, s[0]) * p * np.tile([1.0, -1.0], size)[:size] + bad, s[1] + 1

    def loop(p):
        s = (u, 0)
        for _ in range(N):
            s = step(s, p)
        return anp.sum(s[0])

    wanted = autograd.grad(loop)(0.9)
    for slots in (None, 1, 3, 12, 2000):
        memory = None if slots is None else 16 + (slots + 4) * u.nbytes
        found = dp.value_and_grad(lambda p: anp.sum(dp.rollout(step, (u, 0), p, N, memory=memory)[0]))(0.9)[1]
        assert found == pytest.approx(wanted, rel=1e-12)


def test_fingerprints_see_every_bit_and_every_place():
    rng = np.random.default_rng(0)
    for shape in ((4,), (1023,), (1025,), (64, 64), (509, 40), (40, 521), (700, 509)):
        for dtype in ("f4", "f8", "c16"):
            u = rng.standard_normal(shape).astype(dtype)
            known = fingerprint([u])
            assert known == fingerprint([u.copy()]) == fingerprint([np.asfortranarray(u)])
            assert all(fingerprint([np.roll(u, 1, axis)]) != known for axis in range(u.ndim))
            for place in rng.integers(0, u.size, 20):
                other = u.copy()
                other.flat[place] = np.nextafter(u.flat[place].real, np.inf) + (
                    u.flat[place].imag * 1j if dtype == "c16" else 0
                )
                assert fingerprint([other]) != known


@pytest.mark.filterwarnings("ignore::sparsedp.errors.BudgetWarning")
@pytest.mark.parametrize("memory", BUDGETS)
def test_a_step_that_stores_values_computed_from_params_is_refused(memory):
    """Run again on a tape, it would take the plain number for a constant: the same value, another derivative."""
    known = {}

    def step(u, p):
        if not known:
            known["scale"] = anp.exp(-p)
        return u * known["scale"]

    with pytest.raises(DerivativeError, match="uses a traced value that is not one of its arguments"):
        dp.value_and_grad(lambda p: anp.sum(dp.rollout(step, U, p, N, memory=memory)))(0.3)


def stored_in(name):
    """A step of a state (field, number of the step), and what it stores."""
    stored = {}
    at = int(name.split()[-1])

    def step(s, p):
        u, i = s
        if name.startswith("params") and i == at:
            stored["k"] = anp.exp(-p)
        if name.startswith("field") and i == at:
            stored["k"] = 0.1 * anp.mean(u * p)
        if name.startswith("every") and i % at == 0:
            stored["k"] = anp.exp(-p)
        new = smooth(u, p) * (1.0 + (0.0 if "loss" in name else stored.get("k", 0.0)))
        if name.startswith("before"):
            stored["k"] = anp.mean(u)
        return new, i + 1

    return step, stored


@pytest.mark.sampled(1)
@pytest.mark.filterwarnings("ignore::sparsedp.errors.BudgetWarning")
@pytest.mark.parametrize("keep", KEEPS)
@pytest.mark.parametrize(
    "name",
    ["params 1", "params 5", "field 1", "field 4", "every 4", "before 0", "params, loss 1", "field, loss 7"],
)
def test_values_stored_by_a_step_are_refused_or_right(name, keep):
    """Used by later steps, or by the loss: a state that is run again knows nothing of the first run's constants."""

    def loop(p):
        step, stored = stored_in(name)
        states = [(U, 0)]
        for _ in range(N):
            states.append(step(states[-1], p))
        return KEEPS[keep][2]([u for u, _ in states]) + ("loss" in name) * stored["k"]

    def rolled(p, memory):
        step, stored = stored_in(name)
        function = lambda i, s: KEEPS["each"][0](i, s[0])
        out = dp.rollout(step, (U, 0), p, N, memory=memory, keep=function if keep == "each" else keep)
        return KEEPS[keep][1](out if keep == "each" else out[0]) + ("loss" in name) * stored["k"]

    value, slope = autograd.value_and_grad(loop)(1.3)
    refused = 0
    for memory in BUDGETS:
        assert pushforward(lambda p: rolled(p, memory), 1.3, 1.0)[1] == pytest.approx(slope, rel=1e-11)
        try:
            found = dp.value_and_grad(lambda p: rolled(p, memory))(1.3)
        except DerivativeError:
            refused += 1
        else:
            assert found == pytest.approx((value, slope), rel=1e-11)
    assert refused > 2


def stores(where):
    """Losses that use what was stored on the way."""
    seen = []

    def step(u, p):
        seen.append(anp.sum(u))
        return smooth(u, p)

    def loss(p, memory):
        seen.clear()
        if where == "keep":
            dp.rollout(smooth, U, p, N, memory=memory, keep=lambda i, u: seen.append(anp.sum(u)))
        else:
            dp.rollout(step, U, p, N, memory=memory)
        if where == "another rollout":
            return anp.sum(dp.rollout(lambda u, q: u * q, U, seen[5], 2))
        if where == "as it is":
            return seen[5]
        return p * seen[5]

    return loss


@pytest.mark.filterwarnings("ignore::sparsedp.errors.BudgetWarning")
@pytest.mark.parametrize("memory", BUDGETS[:3])
@pytest.mark.parametrize("where", ["keep", "step", "another rollout", "as it is"])
def test_a_loss_that_uses_values_stored_by_a_step_is_refused(where, memory):
    loss = stores(where)
    with pytest.raises(DerivativeError, match="^a traced value was stored"):
        dp.value_and_grad(lambda p: loss(p, memory))(1.3)
    assert np.isfinite(loss(1.3, memory))


def test_a_value_stored_by_an_earlier_gradient_is_refused():
    seen = {}
    loss = lambda p: seen.setdefault("k", anp.exp(p)) * p
    first = dp.value_and_grad(loss)(0.5)
    assert first == pytest.approx((0.5 * np.exp(0.5), 1.5 * np.exp(0.5)))
    for again in (loss, lambda p: seen["k"]):
        with pytest.raises(
            DerivativeError,
            match="^a traced value was stored and used after the function or the step that computed it had ended, so "
            "its derivative would be lost; return it, from a rollout in the state or by keep$",
        ):
            dp.value_and_grad(again)(0.5)
