"""Every message of rollout: steps that break the rules, and arguments out of range."""

import re
import sys
from collections import namedtuple

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.errors import DerivativeError, GrowthWarning, NonFiniteError, ShapeError

U = np.array([1.0, 2.0, 3.0])
Pair = namedtuple("Pair", "ink wind")
SHAPE = ShapeError
VALUE = ValueError
TYPE = TypeError
FINITE = NonFiniteError
NONE = DerivativeError


def same(u, p):
    return 1.0 * u


def writes_state(u, p):
    u *= 2.0
    return u


def writes_params(u, p):
    p["k"][0] = 1.0
    return u * p["k"]


def writes_input(u, p, f):
    f += 1.0
    return u + f


def writes_one_of_two(s, p):
    s["b"][:] = 0.0
    return {"a": s["a"] * 2.0, "b": s["b"] + 1.0}


def writes_whole_numbers(s, p):
    s["count"][0] += 1
    return {"u": s["u"] * 2.0, "count": s["count"]}


def puts_into_params(u, p):
    p["calls"] += 1
    return 1.0 * u


def grows(u, p):
    return anp.concatenate([u, u])


def shrinks_tree(s, p):
    return {"a": s["a"]}


def blows_up(u, p):
    return u * 1e200


def root(u, p):
    return anp.where(u > 0, anp.sqrt(u), u) * p


def by_length(u, p):
    return u * p + anp.linalg.norm(u)


law = dp.differentiable("law", lambda u: u, lambda nums, ans, u: lambda g: (g / (u < 4),))


def roll(step=same, state=U, params=None, n=3, **options):
    return lambda: dp.rollout(step, state, params, n, **options)


def slope(step=same, state=U, params=None, n=3, **options):
    def loss(p):
        out = dp.rollout(step, state, p, n, **options)
        return anp.sum(out["u"] if isinstance(out, dict) else out)

    return lambda: dp.value_and_grad(loss)(2.0 if params is None else params)


class Forgetful:
    """A step that is another one every time."""

    calls = 0

    def __call__(self, u, p):
        self.calls += 1
        return u * p * self.calls


def captured(p):
    return anp.sum(dp.rollout(lambda u, _: u * p, U, None, 3))


def captured_by_keep(p):
    return sum(dp.rollout(lambda u, p: u * p, U, p, 3, keep=lambda i, u: anp.sum(u * p)))


def traced_number(p):
    return anp.sum(dp.rollout(same, U, None, p))


def traced_whole_numbers(p):
    return anp.sum(dp.rollout(same, (p * U).astype(int), None, 2))


def grad(loss):
    return lambda: dp.value_and_grad(loss)(2.0)


TABLE = [
    # what is given
    (
        roll(n=-1),
        VALUE,
        "n of rollout must be an integer >= 0, got -1; for a time T write round(T / dt)",
    ),
    (
        roll(n=True),
        VALUE,
        "n of rollout must be an integer >= 0, got True; for a time T write round(T / dt)",
    ),
    (
        roll(n=0.3 / 0.1),
        TYPE,
        "n of rollout must be an integer, got 2.9999999999999996; for a time T write round(T / dt)",
    ),
    (
        roll(params=3, n=1.0),
        TYPE,
        "n of rollout must be an integer, got 1.0; for a time T write round(T / dt)",
    ),  # exchanged arguments
    (
        roll(n=np.ones(3)),
        TYPE,
        "n of rollout must be an integer, got an array of shape (3,); for a time T write round(T / dt)",
    ),
    (
        grad(traced_number),
        NONE,
        "rollout needs n as a plain whole number, got a traced value; it has no derivative",
    ),
    (roll(inputs=np.ones((2, 3))), SHAPE, "inputs need a first axis of n = 3 entries, got an array of shape (2, 3)"),
    (roll(inputs=1.0), SHAPE, "inputs need a first axis of n = 3 entries, got an array of shape ()"),
    (
        roll(memory="much"),
        VALUE,
        "rollout needs memory as bytes > 0 or a text, got 'much'; write for example \"200 MB\"",
    ),
    (roll(memory=-1), VALUE, 'rollout needs memory as bytes > 0 or a text, got -1; write for example "200 MB"'),
    (
        roll(memory=119),
        VALUE,
        "rollout cannot work within memory=119: 5 states of 24 bytes and 0 bytes for params and inputs "
        "are needed; write memory=120",
    ),
    (
        roll(keep="most"),
        VALUE,
        'keep must be "last", "all", a list of states or a function of (index, state), got \'most\'',
    ),
    (roll(keep=[]), VALUE, "keep needs at least one state, numbers from 0 on, got []"),
    (roll(keep=[-1, 2]), VALUE, "keep needs at least one state, numbers from 0 on, got [-1, 2]"),
    (roll(keep=[1, 4]), VALUE, "keep needs rising numbers of states from 0 to n = 3, got [1, 4]"),
    (roll(keep=[2, 1]), VALUE, "keep needs rising numbers of states from 0 to n = 3, got [2, 1]"),
    (
        roll(truncate=0),
        VALUE,
        "truncate of rollout must be a whole number >= 1, got 0; leave it out and nothing is cut",
    ),
    (
        roll(state={"a": U, "b": np.array([[1.0, np.nan], [np.inf, 2.0]])}),
        FINITE,
        "state['b'] of rollout must be finite, got 2 that are NaN or infinite, the first at (0, 1)",
    ),
    (
        roll(params=(1, np.inf)),
        FINITE,
        "params[1] of rollout must be finite, got inf; write a finite number",
    ),
    (
        slope(state=np.arange(3)),
        NONE,
        "a gradient through rollout needs a state of floating numbers, got int64; write np.asarray(state, float)",
    ),
    (
        grad(traced_whole_numbers),
        NONE,
        "state of rollout is traced but holds int64; derivatives need floating numbers",
    ),
    # what the step does
    (
        roll(grows),
        SHAPE,
        "state must keep its form: the step made shape (6,) of shape (3,); return a state like the first one",
    ),
    (
        roll(lambda u, p: u.astype(np.float32)),
        SHAPE,
        "state must keep its form: the step made dtype float32 of dtype float64; return a state like the first one",
    ),
    (
        roll(shrinks_tree, {"a": U, "b": U}),
        SHAPE,
        "state after the step: missing key 'b'; expected 'a', 'b'; return a state like the first one",
    ),
    (
        roll(lambda s, p: [s[0]], [U, U]),
        SHAPE,
        "state after the step: expected a list of length 2, got a list of length 1; return a state like the first one",
    ),
    (
        roll(lambda u, p: (u, u)),
        SHAPE,
        "state after the step: expected one array or number, got a tuple of length 2; "
        "return a state like the first one",
    ),
    (
        roll(lambda s, p: {"a": (s["a"], 1.0)}, {"a": U}),
        SHAPE,
        "state['a'] after the step: expected one array or number, got a tuple of length 2; "
        "return a state like the first one",
    ),
    (
        roll(lambda s, p: Pair(s.ink, s.wind[:2]), Pair(U, U)),
        SHAPE,
        "state.wind must keep its form: the step made shape (2,) of shape (3,); return a state like the first one",
    ),
    (
        roll(lambda s, p: (Pair(s[0].ink, (U, U)),), (Pair(U, U),)),
        SHAPE,
        "state[0].wind after the step: expected one array or number, got a tuple of length 2; "
        "return a state like the first one",
    ),
    (
        roll(lambda u, p: None),
        SHAPE,
        "state must keep its form: the step made NoneType of one array; return a state like the first one",
    ),
    (
        roll(lambda s, p: {"u": s["u"], "n": s["n"] + 0.5}, {"u": U, "n": 0}),
        SHAPE,
        "state must keep its form: the step made a floating value of 0; start with a floating value, "
        "for example state.astype(float)",
    ),
    (
        roll(lambda u: u),
        TypeError,
        "rollout calls a function with 2 arguments, got one that takes 1; write lambda state, params: ...",
    ),
    (
        roll(lambda u, p: u.astype(object)),
        SHAPE,
        "state must keep its form: the step made an array of objects; use autograd.numpy as np in it",
    ),
    (
        roll(writes_state),
        VALUE,
        "the step changes state in place; write u = u + du instead of u += du, or work on a copy",
    ),
    (
        roll(writes_one_of_two, {"a": U, "b": U}),
        VALUE,
        "the step changes state['b'] in place; write u = u + du instead of u += du, or work on a copy",
    ),
    (
        roll(writes_params, params={"k": U}),
        VALUE,
        "the step changes params['k'] in place; write u = u + du instead of u += du, or work on a copy",
    ),
    (
        roll(writes_input, inputs=np.ones((3, 3))),
        VALUE,
        "the step changes inputs in place; write u = u + du instead of u += du, or work on a copy",
    ),
    (
        roll(writes_whole_numbers, {"u": U, "count": np.zeros(1, int)}),
        VALUE,
        "the step changes state['count'] in place; write u = u + du instead of u += du, or work on a copy",
    ),
    (
        roll(keep=lambda i, u: writes_state(u, None)),
        VALUE,
        "keep changes the state in place; write u = u + du instead of u += du, or work on a copy",
    ),
    (
        roll(puts_into_params, params={"calls": 0}),
        VALUE,
        "the step changes the entries of params; make what changes a part of the state",
    ),
    (
        slope(Forgetful(), memory=5 * 24 + 2 * 8),  # under a budget steps are run again
        NONE,
        "the step gives another state when it is run again; it must depend on its arguments only",
    ),
    (
        roll(blows_up),
        FINITE,
        "state of step 1 of rollout needs a smaller time step, got 3 that are NaN or infinite, the first at 0",
    ),
    (
        grad(captured),
        NONE,
        "the step uses a traced value that is not one of its arguments, and its derivative would be lost; "
        "pass it in params or make it a part of the state",
    ),
    (
        grad(captured_by_keep),
        NONE,
        "keep uses a traced value that is not part of the state, and its derivative would be lost; "
        "return what it needs of the state, and combine the two outside of rollout",
    ),
    # the backward pass
    (
        slope(lambda u, p: anp.tanh(1e160 * u * p), 0.0 * U, 1.0),
        FINITE,
        "the backward pass through 3 steps of rollout makes the gradient in params NaN or infinite; "
        "take fewer steps, or cut it with truncate",
    ),
    (
        slope(root, 0.0 * U),
        FINITE,
        "in the backward pass through step 2 of rollout: the derivative of sqrt is NaN or infinite where its argument "
        "is 0; keep it away from there",
    ),
    (
        slope(root, 0.0 * U, memory=150),
        FINITE,
        "in the backward pass through step 2 of rollout: the derivative of sqrt is NaN or infinite where its argument "
        "is 0; keep it away from there",
    ),
    (
        grad(lambda p: anp.sum(dp.rollout(by_length, 0.0 * U, p * U, 3))),
        FINITE,
        "in the backward pass through step 2 of rollout: the derivative of norm is NaN or infinite where its argument "
        "is 0; keep it away from there",
    ),
    (
        grad(lambda p: anp.sum(dp.rollout(lambda u, p: law(u) * p, U, p, 3))),
        FINITE,
        "in the backward pass through step 2 of rollout: the derivative of law is NaN or infinite where its argument "
        "is 4; keep it away from there",
    ),
]


@pytest.mark.parametrize("call, kind, message", TABLE, ids=[f"{k}-{row[2][:40]}" for k, row in enumerate(TABLE)])
def test_message(call, kind, message):
    with np.errstate(all="ignore"), pytest.raises(kind, match=f"^{re.escape(message)}$"):
        call()


def test_progress_without_tqdm(monkeypatch):
    monkeypatch.setitem(sys.modules, "tqdm.auto", None)
    message = r"a progress bar needs tqdm; install sparsedp\[plot\], or leave progress out"
    with pytest.raises(ImportError, match=message):
        dp.rollout(same, U, None, 2, progress=True)


def test_growth_warning():
    message = (
        r"the cotangent grew by 1e\+09 over 30 steps of rollout, 0.69 a step in the logarithm; "
        "the gradient is exact and of little use, take fewer steps or truncate"
    )
    with pytest.warns(GrowthWarning, match=message):
        dp.value_and_grad(lambda u: anp.sum(dp.rollout(lambda u, p: 2.0 * u, u, None, 30)))(U)


def test_inputs_are_not_changed():
    state = {"a": U.copy(), "n": np.zeros(2, int)}
    params = {"k": U.copy()}
    out = dp.rollout(lambda s, p: {"a": s["a"] * p["k"], "n": s["n"] + 1}, state, params, 2)
    assert np.array_equal(state["a"], U) and not state["n"].any() and np.array_equal(params["k"], U)
    assert np.array_equal(out["a"], U**3) and np.array_equal(out["n"], [2, 2])
    out["a"][0] = 7.0  # the result is the caller's
    assert dp.rollout(lambda u, p: u, U, None, 3) is not U
