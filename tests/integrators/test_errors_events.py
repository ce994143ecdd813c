"""Every message about breaks, events and undeclared jumps of steps with error control."""

import re

import autograd.numpy as anp
import numpy as np
import pytest
from test_integrators_breaks import first, switched
from test_integrators_events import bounce, event, falling, ground

import sparsedp as dp
from sparsedp.autodiff.derivative import value_and_grad
from sparsedp.errors import ConvergenceError, DerivativeError, NonFiniteError, ShapeError

NO_END = event(lambda u, g: u[0], terminal="yes")
UP = event(lambda u, g: u[0], direction="up")
PAIR = event(lambda u, g: u[0], terminal=np.array([1, 2]))
FASTER = (lambda u, g: 2.0 * u[0], lambda u, g: anp.array([u[0], u[1] + 1.0]))
APEX = event(lambda u, g: u[0] - 1.0, terminal=True)
BALL = lambda events, **options: dp.stepper("rk4", falling, 2.0, **{"tolerance": 1e-6, "events": events, **options})
FALL = lambda events: BALL(events)((np.array([1.0, 0.0]), 0.0), 9.81)
HEAT = lambda **options: dp.stepper("rk4", switched, 2.0, **options)


def thrown(speed, method="rk4"):
    """The derivative, in the speed, of the time at which a ball reaches 1."""
    step = dp.stepper(method, falling, 2.0, tolerance=1e-6, events=APEX)
    return value_and_grad(lambda v: step((anp.array([0.0, v]), 0.0), 9.81)[1])(speed)


def weighed(u, g):
    """An event whose time has another derivative than the bounce at the same time."""
    return u[0] + 0.1 * (g - 9.81)


def before_the_bounce(g):
    """A Hessian product of a height that is linear in g: its interval ends just before the bounce."""
    step = dp.stepper("heun", falling, 0.25 * (1 - 1e-12) * np.sqrt(2 / 9.81), tolerance=1e-1, events=(ground, bounce))
    return dp.hvp(lambda g: dp.rollout(step, (np.array([1.0, 0.0]), 0.0), g, 4)[0][0], g, 1.0)


def closed(u, p, t):
    """A rate that is refused around the time of an event."""
    if abs(t - 0.55) < 0.01:
        raise NonFiniteError("closed")
    return 1.0


def faster(u, p):
    """A rate that jumps with the state."""
    return anp.where(u < 0.5, 1.0, 2.0) * p


def layer(u, s, t):
    """A rate that is smooth and steep."""
    return anp.tanh((t - s) / 4e-3) - 0.5 * u


TABLE = [
    (lambda: HEAT(breaks=[1.0]), TypeError, "breaks needs steps with error control; write tolerance=1e-6"),
    (lambda: HEAT(max_step=1.0), TypeError, "max_step needs steps with error control; write tolerance=1e-6"),
    (lambda: BALL(ground, tolerance=None), TypeError, "events needs steps with error control; write tolerance=1e-6"),
    (
        lambda: HEAT(tolerance=1e-3, max_step=0.0),
        ValueError,
        "max_step of stepper must be > 0, got 0; write the longest step, in the units of dt",
    ),
    (
        lambda: HEAT(tolerance=1e-3, breaks=[1.0], timed=False),
        TypeError,
        "breaks needs the time in the state; leave timed out, and give the state (u, t)",
    ),
    (
        lambda: BALL(ground, timed=False),
        TypeError,
        "events needs the time in the state; leave timed out, and give the state (u, t)",
    ),
    (
        lambda: HEAT(tolerance=1e-3, breaks=[np.nan]),
        NonFiniteError,
        "breaks must be finite, got nan at place 0",
    ),
    (
        lambda: HEAT(tolerance=1e-3, breaks=lambda p: [0.5, np.inf])((np.zeros(1), 0.0), 1.0),
        NonFiniteError,
        "breaks must be finite, got inf at place 1",
    ),
    (
        lambda: HEAT(tolerance=1e-3, breaks=["noon"]),
        TypeError,
        "breaks takes times, or a function of params that returns times, got str; write breaks=[0.5, 1.0]",
    ),
    (
        lambda: HEAT(tolerance=1e-3, breaks=np.ones((2, 2))),
        ShapeError,
        "breaks must be a sequence of times, got an array of shape (2, 2)",
    ),
    (
        lambda: value_and_grad(first(HEAT(tolerance=1e-3, breaks=lambda p: [p, p])))(0.5),
        DerivativeError,
        "two breaks of stepper(rk4) coincide at t = 0.5, where the derivative depends on their order; return each "
        "time once",
    ),
    (
        lambda: dp.stepper("leapfrog", (switched, switched), 0.1, breaks=[0.5]),
        TypeError,
        "leapfrog does not use breaks; leave it out",
    ),
    (
        lambda: BALL(3.0),
        TypeError,
        "events takes functions, or pairs (function, jump), got float; write events=[lambda u, params, t: ...]",
    ),
    (
        lambda: BALL([3.0]),
        TypeError,
        "stepper, as events[0], takes a function, got float; write lambda u, params, t: ...",
    ),
    (
        lambda: BALL([(ground, 3.0)]),
        TypeError,
        "stepper, as the jump of events[0], takes a function, got float; write lambda u, params, t: ...",
    ),
    (
        lambda: BALL([lambda u: u[0]]),
        TypeError,
        "stepper calls a function with 2 arguments, got one that takes 1; write lambda u, params, t: ...",
    ),
    (
        lambda: BALL([NO_END]),
        ValueError,
        "the attribute terminal of events[0] must be True or False, got 'yes'",
    ),
    (
        lambda: BALL([PAIR]),
        ValueError,
        "the attribute terminal of events[0] must be True or False, got array([1, 2])",
    ),
    (
        lambda: FALL([(ground, bounce), FASTER]),
        ValueError,
        "events[0] and events[1] of stepper(rk4) occur at the same time t = 0.451523640986, and the state after their "
        "jumps depends on their order; write one event for both",
    ),
    (
        lambda: value_and_grad(lambda g: BALL([(ground, bounce), weighed])((np.array([1.0, 0.0]), 0.0), g)[0][1])(9.81),
        DerivativeError,
        "events[0] and events[1] of stepper(rk4) occur at the same time t = 0.451523640986, and the derivative of the "
        "state depends on their order; write one event for both",
    ),
    (
        lambda: before_the_bounce(9.81),
        DerivativeError,
        "a second derivative of stepper(heun) over 6 steps is 0 to rounding, which error control cannot tell from an "
        "error: the result does not depend on it to second order, as that of a ball before its first bounce; leave it "
        "out, or take fixed steps",
    ),
    (
        lambda: BALL([UP]),
        TypeError,
        "the direction of events[0] must be one real number, got 'up'",
    ),
    (
        lambda: FALL([lambda u, g: u]),
        ShapeError,
        "events[0] must return one real number, got float64 of shape (2,)",
    ),
    (
        lambda: FALL([lambda u, g: np.nan * u[0]]),
        NonFiniteError,
        "events[0] must be finite, got nan at t = 0",
    ),
    (
        lambda: FALL([(ground, lambda u, g: u[:1])]),
        ShapeError,
        "the jump of events[0]: expected shape (2,), got (1,); return a tree like the state",
    ),
    (
        lambda: FALL([(ground, lambda u, g: 0.05 * bounce(u, g))]),
        ConvergenceError,
        "events[0] of stepper(rk4) occurs again and again at t = 0.488807486283; let it be terminal, or return from "
        "its jump a state that leaves the surface",
    ),
    (
        lambda: dp.stepper("rk4", closed, 1.0, tolerance=1e-6, events=lambda u, p: u - 0.55)((0.0, 0.0)),
        ConvergenceError,
        "stepper(rk4): no step leads to events[0] near t = 0.156",
    ),
    (
        lambda: value_and_grad(first(HEAT(tolerance=1e-4)))(0.98),
        DerivativeError,
        "the rate of stepper(rk4) jumps at t = 0.98, and the derivative of steps across it lacks the term of the jump; "
        "write breaks=[0.98], or breaks=lambda params: [...] where it moves",
    ),
    (
        lambda: value_and_grad(lambda p: dp.stepper("rk4", faster, 1.0, tolerance=1e-4)(np.zeros(1), p)[0])(1.0),
        DerivativeError,
        "the rate of stepper(rk4) jumps at t = 0.5, and the derivative of steps across it lacks the term of the jump; "
        "write events=lambda u, params, t: ... with a function that is 0 there",
    ),
    (
        lambda: value_and_grad(first(dp.stepper("ssprk3", layer, 2.0, tolerance=1e-3)))(0.98),
        DerivativeError,
        "the rate of stepper(ssprk3) changes near t = 0.946 faster than steps with the tolerance 0.001 resolve, and "
        "the derivative would miss a part of it; give a smaller tolerance or max_step, or breaks= where it jumps",
    ),
    (
        lambda: thrown(np.sqrt(2 * 9.81)),
        DerivativeError,
        "events[0] of stepper(rk4) grazes its surface at t = 0.451523632: its rate of change there, 9.05e-08, is zero "
        "to the tolerance 1e-06, so that its time has no derivative; give another event or parameter, or a "
        "smaller tolerance",
    ),
    (
        lambda: thrown(np.sqrt(2 * 9.81) * (1 + 1e-9), "radau"),
        DerivativeError,
        "events[0] of stepper(radau) grazes its surface at t = 0.451503687: its rate of change there, 0.000198, is "
        "zero to the tolerance 1e-06, so that its time has no derivative; give another event or parameter, or a "
        "smaller tolerance",
    ),
]


def numberless(text):
    """A message without its numbers, whose last digits are rounding."""
    return re.sub(r"\d+[.\de+-]*", "0", text)


SLOW = "a second derivative of stepper(heun) over 6 steps"


@pytest.mark.parametrize(
    "act, kind, message", [pytest.param(*row, marks=[pytest.mark.whole] * row[2].startswith(SLOW)) for row in TABLE]
)
def test_messages(act, kind, message):
    with pytest.raises(kind) as caught:
        act()
    assert numberless(str(caught.value)) == numberless(message)


def test_a_jump_in_time_close_to_a_state_of_zero_mentions_breaks():
    """The state is 0 until the jump, so that a jump in time and one with the state look alike."""
    rate = lambda u, p, t: anp.where(t < 0.537, 0.0, 1.0) - p * u
    step = dp.stepper("rk4", rate, 0.1, tolerance=1e-5)
    loss = lambda p: anp.sum(dp.rollout(step, (np.zeros(3), 0.0), p, 20)[0])
    with pytest.raises(DerivativeError, match=r"breaks=\[0.537\]"):
        value_and_grad(loss)(0.8)
