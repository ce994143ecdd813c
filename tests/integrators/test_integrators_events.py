"""Located events: value, gradient, tangent and Hessian product beside closed forms, and what is refused."""

import functools
import pickle
import sys
from pathlib import Path

import autograd.numpy as anp
import numpy as np
import pytest
from scipy.optimize import brentq

import sparsedp as dp
from sparsedp.autodiff.derivative import pushforward, value_and_grad
from sparsedp.integrators.events import Event


def event(function, terminal=False, direction=0):
    function.terminal = terminal
    function.direction = direction
    return function


def falling(u, g, t):
    return anp.array([u[1], -g])


ground = event(lambda u, g: u[0], direction=-1)
landing = event(lambda u, p, t: u[1], terminal=True, direction=-1)


def bounce(u, g):
    return anp.array([0.0 * u[0], -0.8 * u[1]])


def height(g, end=2.0):
    """Of a ball that falls from 1 and keeps 0.8 of its speed in each bounce, and its two derivatives in g."""
    g = float(g)
    t = np.sqrt(2 / g)
    v = 0.8 * np.sqrt(2 * g)
    count = 1
    while t + 2 * v / g < end:
        t = t + 2 * v / g
        v = 0.8 * v
        count = count + 1
    share = t * np.sqrt(g)  # t is share / sqrt(g), v is speed * sqrt(g)
    speed = v / np.sqrt(g)
    rest = end - share * g**-0.5
    slope = 0.5 * share * g**-1.5
    bend = -0.75 * share * g**-2.5
    value = speed * g**0.5 * rest - 0.5 * g * rest**2
    first = 0.5 * speed * g**-0.5 * rest + speed * g**0.5 * slope - 0.5 * rest**2 - g * rest * slope
    second = (
        -0.25 * speed * g**-1.5 * rest
        + speed * g**-0.5 * slope
        + speed * g**0.5 * bend
        - 2 * rest * slope
        - g * slope**2
        - g * rest * bend
    )
    return count, value, first, second


def cannon(u, drag, t):
    return anp.array([u[2], u[3], -drag * u[2], -9.81 - drag * u[3]])


def landing_time(drag, speed=30.0):
    """Of a ball shot upward with linear drag, and its derivative in the drag."""
    fall = speed + 9.81 / drag
    y = lambda t: fall / drag * (1 - np.exp(-drag * t)) - 9.81 / drag * t
    t = brentq(y, 1.0, 10.0, xtol=1e-14)
    decay = np.exp(-drag * t)
    by_drag = (
        -9.81 / drag**3 * (1 - decay) - fall / drag**2 * (1 - decay) + fall / drag * t * decay + 9.81 / drag**2 * t
    )
    return t, -by_drag / (fall * decay - 9.81 / drag)


@pytest.mark.sampled(0)
@pytest.mark.parametrize(
    "method, tolerance",
    [
        ("heun", 1e-1),
        ("radau", 1e-6),
        pytest.param("rodas5p", 1e-6, marks=pytest.mark.whole),
        *(pytest.param(m, 1e-2, marks=pytest.mark.whole) for m in ("rk4", "ssprk3", "crank_nicolson")),
    ],
)
def test_a_bouncing_ball(method, tolerance):
    """Steps of order 2 are exact between the bounces."""
    step = dp.stepper(method, falling, 2.0, tolerance=tolerance, events=(ground, bounce))
    loss = lambda g: step((np.array([1.0, 0.0]), 0.0), g)[0][0]
    count, value, slope, bend = height(9.81)
    assert value_and_grad(loss)(9.81) == pytest.approx((value, slope), rel=1e-9)
    assert len(step.t_events[0]) == count and step.t_events[0][0] == pytest.approx(np.sqrt(2 / 9.81), rel=1e-14)
    assert pushforward(loss, 9.81, 1.0)[1] == pytest.approx(slope, rel=1e-9)
    if method == "ssprk3":
        assert dp.hvp(loss, 9.81, 1.0) == pytest.approx(bend, rel=1e-9)


def test_a_bouncing_ball_bends():
    step = dp.stepper("heun", falling, 0.5, tolerance=1e-1, events=(ground, bounce))
    _, _, _, bend = height(9.81, 0.5)
    assert dp.hvp(lambda g: step((np.array([1.0, 0.0]), 0.0), g)[0][0], 9.81, 1.0) == pytest.approx(bend, rel=1e-9)


@pytest.mark.parametrize(
    "method, tolerance, near",
    [
        ("rk4", 1e-6, 1e-5),
        ("radau", 1e-6, 1e-6),
        pytest.param("rodas5p", 1e-6, 1e-5, marks=pytest.mark.whole),
        pytest.param("heun", 1e-5, 1e-4, marks=pytest.mark.whole),
        pytest.param("tr_bdf2", 1e-5, 1e-4, marks=pytest.mark.whole),
    ],
)
def test_the_landing_time_of_a_cannonball(method, tolerance, near):
    """The time that a terminal event returns has a derivative; the state lies on the ground to rounding."""
    step = dp.stepper(method, cannon, 100.0, tolerance=tolerance, events=[landing])
    start = np.array([0.0, 0.0, 20.0, 30.0])
    time, slope = landing_time(0.1)
    u, t = step((start, 0.0), 0.1)
    assert t == step.t_events[0][0] == pytest.approx(time, rel=near) and abs(u[1]) < 1e-12
    loss = lambda drag: step((start, 0.0), drag)[1]
    assert value_and_grad(loss)(0.1) == pytest.approx((t, slope), rel=near)
    assert pushforward(loss, 0.1, 1.0)[1] == pytest.approx(slope, rel=near)
    if method in ("heun", "tr_bdf2"):
        bend = (landing_time(0.1001)[1] - landing_time(0.0999)[1]) / 2e-4
        assert dp.hvp(loss, 0.1, 1.0) == pytest.approx(bend, rel=10 * near)


@pytest.mark.parametrize("wrap", [dp.jit, functools.partial])
def test_a_wrapped_event_keeps_its_attributes(wrap):
    wrapped = Event(wrap(landing), None, 0)
    assert wrapped.terminal and wrapped.direction == -1


def switching(u, p, t):
    """y' = -p y until v = p t is 0.5, then +p y: y(1) = exp(p - 1) for y(0) = 1."""
    return anp.array([anp.where(u[1] > 0.5, 1.0, -1.0) * p * u[0], p])


@pytest.mark.parametrize(
    "method, tolerance, near",
    [
        ("rk4", 1e-6, 1e-5),
        ("radau", 1e-6, 1e-6),
        pytest.param("rodas5p", 1e-6, 1e-5, marks=pytest.mark.whole),
        pytest.param("heun", 1e-3, 1e-3, marks=pytest.mark.whole),
        pytest.param("tr_bdf2", 1e-4, 1e-4, marks=pytest.mark.whole),
    ],
)
def test_a_rate_that_switches_with_the_state(method, tolerance, near):
    """The derivative was off by its own size; the rate is taken on the side of the surface where the step is."""
    step = dp.stepper(method, switching, 1.0, tolerance=tolerance, events=lambda u, p: u[1] - 0.5)
    loss = lambda p: step((np.array([1.0, 0.0]), 0.0), p)[0][0]
    value, slope = value_and_grad(loss)(0.8)
    assert value == loss(0.8) == pytest.approx(np.exp(-0.2), rel=near) and slope == pytest.approx(value, rel=near)
    assert step.t_events[0] == pytest.approx([0.625], rel=1e-9)
    if method == "heun":
        assert dp.hvp(loss, 0.8, 1.0) == pytest.approx(np.exp(-0.2), rel=2 * near)


@pytest.mark.parametrize("method", ["rk4", "heun", "radau"])
def test_a_faster_rate_above_a_level(method):
    """u' = p below 0.5 and 2 p above: u(1) = 2 p - 0.5."""
    rate = lambda u, p, t: anp.where(u < 0.5, 1.0, 2.0) * p
    step = dp.stepper(method, rate, 1.0, tolerance=1e-6, events=lambda u, p, t: u[0] - 0.5)
    assert value_and_grad(lambda p: step((np.zeros(1), 0.0), p)[0][0])(1.0) == pytest.approx((1.5, 2.0), rel=1e-9)


@pytest.mark.whole
def test_simultaneous_events_have_derivatives_of_their_own():
    """Two balls that fall together; the gravity of one moves its bounce alone."""
    rate = lambda u, g, t: {"a": falling(u["a"], 9.81, t), "b": falling(u["b"], g, t)}
    events = [
        (lambda u, g: u["a"][0], lambda u, g: {**u, "a": bounce(u["a"], g)}),
        (lambda u, g: u["b"][0], lambda u, g: {**u, "b": bounce(u["b"], g)}),
    ]
    step = dp.stepper("heun", rate, 0.5, tolerance=1e-1, events=events)
    start = {"a": np.array([1.0, 0.0]), "b": np.array([1.0, 0.0])}
    a, b = (value_and_grad(lambda g: step((start, 0.0), g)[0][name][0])(9.81) for name in "ab")
    _, value, slope, _ = height(9.81, 0.5)
    assert a == pytest.approx((value, 0.0), rel=1e-9, abs=1e-12) and b == pytest.approx((value, slope), rel=1e-9)


@pytest.mark.parametrize("name", ["down", *(pytest.param(name, marks=pytest.mark.whole) for name in ("up", "both"))])
def test_direction_twice_in_a_step_and_the_time_in_the_state(name):
    """A ball passes a height on its way up and down; a jump writes the time into the state."""
    up, down, both = (event(lambda u, p: u["y"][0] - 1.0, direction=d) for d in (1, -1, 0))
    write = lambda u, p, t: {**u, "seen": t}
    rate = lambda u, v, t: {"y": falling(u["y"], 9.81, t), "seen": 0.0 * u["seen"]}
    exact = lambda sign: lambda v: (v + sign * np.sqrt(v**2 - 2 * 9.81)) / 9.81
    v = 1.001 * np.sqrt(2 * 9.81)
    passed, signs = {"up": (up, [-1]), "down": (down, [1]), "both": (both, [-1, 1])}[name]
    step = dp.stepper("heun", rate, 1.5, tolerance=1e-4, events=(passed, write))
    seen = lambda v: step(({"y": anp.array([0.0, v]), "seen": 0.0}, 0.0))[0]["seen"]
    time = exact(signs[-1])
    slope = (time(v + 1e-6) - time(v - 1e-6)) / 2e-6
    assert value_and_grad(seen)(v) == pytest.approx((time(v), slope), rel=1e-6)
    assert step.t_events[0] == pytest.approx([exact(sign)(v) for sign in signs], rel=1e-9)


@pytest.mark.whole
def test_events_in_a_rollout_under_a_budget():
    """Bounces in 8 steps: the same bits for every budget, and the result of one long step up to rounding."""
    step = dp.stepper("heun", falling, 0.25, tolerance=1e-1, events=(ground, bounce))
    start = (np.array([1.0, 0.0]), 0.0)
    loss = lambda g, **options: dp.rollout(step, start, g, 8, **options)[0][0]
    _, value, slope, _ = height(9.81)
    found = value_and_grad(loss)(9.81)
    assert found == pytest.approx((value, slope), rel=1e-9)
    assert value_and_grad(lambda g: loss(g, memory=200))(9.81) == found


def halve(u, g):
    return anp.array([u[0], 0.5 * u[1]])


@pytest.mark.sampled(0)
@pytest.mark.parametrize(
    "events, factor",
    [
        ([(ground, bounce), lambda u, g: 2.0 * u[0]], 0.8),
        ([(ground, bounce), (lambda u, g: 2.0 * u[0], halve)], 0.4),
        ([(lambda u, g: 2.0 * u[0], halve), (ground, bounce)], 0.4),
        ([event(lambda u, g: 2.0 * u[0], terminal=True), (ground, bounce)], None),
        ([(ground, bounce), event(lambda u, g: 2.0 * u[0], terminal=True)], None),
    ],
)
def test_events_at_the_same_time_are_all_recorded(events, factor):
    """Their jumps act in the order of `events`; the first one moved the state off the surface of the second."""
    step = dp.stepper("rk4", falling, 0.5, tolerance=1e-3, events=events)
    loss = lambda g: step((np.array([1.0, 0.0]), 0.0), g)[0][1]
    time = np.sqrt(2 / 9.81)
    root = np.sqrt(2 * 9.81)
    if factor is None:  # the speed after the bounce, at which the step ends
        value = 0.8 * root
        slope = 0.8 / root
    else:
        value = factor * root - 9.81 * (0.5 - time)
        slope = factor / root - 0.5 + 0.5 * time
    assert loss(9.81) == pytest.approx(value, rel=1e-9)
    assert [times == pytest.approx([time], rel=1e-12) for times in step.t_events] == [True, True]
    assert value_and_grad(loss)(9.81) == pytest.approx((value, slope), rel=1e-9)


def test_an_event_at_the_start_does_not_count():
    """A ball that starts on the ground, and one that starts there at rest: neither bounces at once."""
    step = dp.stepper("rk4", falling, 0.5, tolerance=1e-6, events=(ground, bounce))
    assert step((np.array([0.0, 5.0]), 0.0), 9.81)[0][0] == pytest.approx(2.5 - 0.5 * 9.81 * 0.25, rel=1e-9)
    assert len(step.t_events[0]) == 0
    rest = dp.stepper("rk4", lambda u, g, t: 0.0 * u, 0.5, tolerance=1e-6, events=(ground, bounce))
    assert np.array_equal(rest((np.zeros(2), 0.0), 9.81)[0], np.zeros(2))


@pytest.mark.parametrize(
    ("method", "counts"),
    [
        pytest.param("heun", (1, 2, 3, 4), marks=pytest.mark.whole),
        ("radau", (1, 3)),
        pytest.param("radau", (2, 4), marks=pytest.mark.whole),
    ],
)
def test_events_at_the_ends_of_intervals(method, counts):
    """Two balls land at t = count dt to rounding, each once, and the gravity of one moves its bounce alone."""
    rate = lambda u, g, t: {"a": falling(u["a"], 10.0, t), "b": falling(u["b"], g, t)}
    events = [
        (lambda u, g: u["a"][0], lambda u, g: {**u, "a": bounce(u["a"], g)}),
        (lambda u, g: u["b"][0], lambda u, g: {**u, "b": bounce(u["b"], g)}),
    ]
    step = dp.stepper(method, rate, 0.25, tolerance=1e-3, events=events)
    for count in counts:
        time = 0.25 * count
        start = {name: np.array([5.0 * time**2, 0.0]) for name in "ab"}
        loss = lambda g: dp.rollout(step, (start, 0.0), g, count + 1)[0]["b"][0]
        value, slope = value_and_grad(loss)(10.0)
        assert value == pytest.approx(0.8 * 10 * time * 0.25 - 5.0 * 0.25**2, rel=1e-9)
        # With landing time s = c / sqrt(g) and its slope -s / (2 g): b = 0.8 g s (end - s) - g (end - s)^2 / 2.
        rest = 0.25
        by_g = -time / 20
        exact = 0.8 * time * rest + 8 * by_g * (rest - time) - 0.5 * rest**2 + 10 * rest * by_g
        assert slope == pytest.approx(exact, rel=1e-9, abs=1e-11)


def test_a_terminal_event_in_single_precision_ends_one_interval():
    """The returned state lies on the surface to its own rounding."""
    ends = event(lambda u, p, t: u[0], terminal=True)
    step = dp.stepper(
        "tr_bdf2", lambda u, p, t: anp.array([u[1], -10.0 + 0.0 * u[1]]), 1.0, tolerance=1e-4, events=ends
    )
    u, t = step(step((np.array([3.3, 0.0], np.float32), np.float32(0.0))))
    assert t == pytest.approx(np.sqrt(0.66) + 1.0, rel=1e-5) and u[0] < -10.0


@pytest.mark.parametrize("method", ["rk4", "radau"])
def test_a_jump_discards_the_rest_of_its_step(method):
    """A point that turns round at t = 0.4 neither reaches 0.5, nor crosses it upward."""
    level = event(lambda u, p, t: u[0] - 0.5, direction=1)
    turn = (lambda u, p, t: t - 0.4, lambda u, p: anp.array([u[0], -u[1]]))
    rate = lambda u, p, t: anp.array([u[1], 0.0 * u[0]])
    step = dp.stepper(method, rate, 1.0, tolerance=1e-6, events=[level, turn])
    assert step((np.array([1.0, -1.0]), 0.0))[0] == pytest.approx([1.2, 1.0])
    assert len(step.t_events[0]) == 0 and step.t_events[1] == pytest.approx([0.4])


@pytest.mark.sampled(0)
@pytest.mark.parametrize("level", [0.49, 0.6, 0.73, 0.89])
def test_an_event_of_a_smooth_rate_does_not_look_like_a_layer(level):
    """u' = -p u has the derivative -exp(-1) after t = 1, with an event or without."""
    step = dp.stepper("heun", lambda u, p, t: -p * u, 1.0, tolerance=1e-4, events=lambda u, p: u[0] - level)
    slope = value_and_grad(lambda p: step((np.ones(2), 0.0), p)[0][0])(1.0)[1]
    assert slope == pytest.approx(-np.exp(-1.0), rel=1e-3)


def test_radau_locates_an_event_in_a_step_with_a_large_error():
    """The second error estimate, of a first step, evaluates the rate with the params that were given."""
    step = dp.stepper(
        "radau", lambda u, p, t: anp.array([u[1], -p * u[0]]), 2.0, tolerance=1e-4, events=lambda u, p: u[0] - 0.5
    )
    step((np.array([0.9, 0.3]), 0.0), 1.25)
    f = np.sqrt(1.25)
    size = np.hypot(0.9, 0.3 / f)
    phase = np.arctan2(0.3 / f, 0.9)
    assert step.t_events[0] == pytest.approx([(phase + np.arccos(0.5 / size)) / f], rel=1e-3)


def test_a_stepper_with_events_is_pickled():
    step = dp.stepper("rk4", falling, 0.6, tolerance=1e-6, events=(level, bounce), breaks=[0.3])
    again = pickle.loads(pickle.dumps(step))
    start = (np.array([1.0, 0.0]), 0.0)
    assert np.array_equal(again(start, 9.81)[0], step(start, 9.81)[0]) and len(again.t_events[0]) == 1


def level(u, g):
    return u[0]


@pytest.mark.whole
def test_errors_stay_near_the_tolerance():
    """The rows of a benchmark: errors of value, gradient and Hessian product are at most ten tolerances."""
    sys.path.insert(0, str(Path(__file__).parents[2]))
    from benchmarks.events import table

    for _, _, tolerance, found in table({"heun": (1e-3,), "rk4": (1e-3,), "radau": (1e-6,)}):
        assert all(error is None or error <= 10 * tolerance for error in found)
        assert found[1] is not None and found[2] is not None
