"""Break times: values and derivatives of every order beside closed forms, in rollouts, and what is refused."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.derivative import pushforward, value_and_grad

# u' = 1 - u/2 until t = off, then -u/2, from u(0) = 0 to t = 2
EXACT = lambda off: 2 * (np.exp(-0.5 * (2 - off)) - np.exp(-1.0))
SLOPE = lambda off: np.exp(-0.5 * (2 - off))
BEND = lambda off: 0.5 * np.exp(-0.5 * (2 - off))


def switched(u, off, t):
    return anp.where(t < off, 1.0, 0.0) - 0.5 * u


def first(step, start=0.0):
    return lambda off: step((np.array([start]), 0.0), off)[0][0]


@pytest.mark.parametrize(
    "method, tolerance, near",
    [
        pytest.param("heun", 1e-3, 1e-3, marks=pytest.mark.whole),
        ("rk4", 1e-6, 1e-5),
        ("radau", 1e-6, 1e-6),
        pytest.param("rodas5p", 1e-6, 1e-5, marks=pytest.mark.whole),
        pytest.param("ssprk3", 1e-5, 1e-5, marks=pytest.mark.whole),
        pytest.param("tr_bdf2", 1e-4, 1e-4, marks=pytest.mark.whole),
        pytest.param("euler", 1e-3, 2e-3, marks=pytest.mark.whole),
        pytest.param("backward_euler", 1e-3, 2e-3, marks=pytest.mark.whole),
        pytest.param("crank_nicolson", 1e-3, 2e-3, marks=pytest.mark.whole),
    ],
)
def test_a_break_that_moves(method, tolerance, near):
    """The derivative in the time of a break was 0; the second one follows from the same steps."""
    step = dp.stepper(method, switched, 2.0, tolerance=tolerance, breaks=lambda off: [off])
    loss = first(step)
    value, slope = value_and_grad(loss)(0.98)
    assert value == loss(0.98) == pytest.approx(EXACT(0.98), abs=near)
    assert slope == pytest.approx(SLOPE(0.98), abs=near)
    assert pushforward(loss, 0.98, 1.0)[1] == pytest.approx(slope, rel=1e-9)
    assert sum(step.taken) == pytest.approx(1.0)
    if method not in ("radau", "rk4"):  # rk4 is in the test below
        assert dp.hvp(loss, 0.98, 1.0) == pytest.approx(BEND(0.98), abs=2 * near)


@pytest.mark.whole
def test_second_derivative_of_rk4():
    step = dp.stepper("rk4", switched, 2.0, tolerance=1e-6, breaks=lambda off: [off])
    assert dp.hvp(first(step), 0.98, 1.0) == pytest.approx(BEND(0.98), abs=1e-5)


@pytest.mark.parametrize("method", ["rk4", "radau", pytest.param("tr_bdf2", marks=pytest.mark.whole)])
def test_a_source_switched_on_at_a_fixed_time(method):
    """The derivative in the first state was -4.28."""
    pump = lambda u, p, t: -u + 10 * np.where(t > 0.5, 1.0, 0.0)
    step = dp.stepper(method, pump, 1.0, tolerance=1e-6, breaks=[0.5])
    value, slope = value_and_grad(lambda u: step((u, 0.0))[0][0])(np.array([1.3]))
    assert value == pytest.approx(1.3 * np.exp(-1.0) + 10 * (1 - np.exp(-0.5)), rel=1e-5)
    assert slope == pytest.approx(np.exp(-1.0), rel=1e-5)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("off", [0.25, 0.5, 0.6])
def test_a_break_at_the_end_of_a_step(off):
    """It is a break of the step that ends there; the step that begins there takes the rate after it."""
    step = dp.stepper("heun", switched, 0.25, tolerance=1e-3, breaks=lambda off: [off])
    loss = lambda off: dp.rollout(step, (np.zeros(1), 0.0), off, 3)[0][0]
    exact = lambda off: 2 * (np.exp(-0.5 * (0.75 - off)) - np.exp(-0.375))
    value, slope = value_and_grad(loss)(off)
    assert value == pytest.approx(exact(off), rel=1e-3)
    assert slope == pytest.approx(np.exp(-0.5 * (0.75 - off)), rel=1e-3)
    assert pushforward(loss, off, 1.0)[1] == pytest.approx(slope, rel=1e-9)


@pytest.mark.whole
@pytest.mark.parametrize("count", [10, pytest.param(100, marks=pytest.mark.whole)])
def test_a_break_in_a_rollout_under_a_budget(count):
    """A break that a param declares, inside one of many steps: the same bits for every budget."""
    rate = lambda u, p, t: anp.where(t < p["off"], p["power"], 0.0) - 0.5 * u
    step = dp.stepper("heun", rate, 2.0 / count, tolerance=1e-2, breaks=lambda p: p["off"])
    runs = []
    loss = lambda p, **options: dp.rollout(step, (np.zeros(1), 0.0), p, count, record=runs.append, **options)[0][0]
    p = {"off": 0.987, "power": 1.0}
    value, g = value_and_grad(loss)(p)
    assert value == pytest.approx(EXACT(0.987), rel=1e-3)
    assert g["off"] == pytest.approx(SLOPE(0.987), rel=1e-3) and g["power"] == pytest.approx(value, rel=1e-3)
    again = value_and_grad(lambda p: loss(p, memory=200))(p)
    assert again == (value, g) and runs[-1].recomputed > 0


@pytest.mark.whole
def test_the_order_and_the_range_of_breaks():
    """Unsorted, repeated constants, outside of the interval, at its start: none changes the result."""
    rate = lambda u, p, t: anp.where(t < 0.3, p, 0.0) + anp.where(t >= 0.7, 2.0, 0.0) * u
    wanted = 0.3 * 2.0 * np.exp(0.6)
    for breaks in ([0.7, 0.3], (0.3, 0.3, 0.7), np.array([5.0, 0.7, -1.0, 0.3, 0.0]), lambda p: [0.7, 0.3, 1e9]):
        step = dp.stepper("rk4", rate, 1.0, tolerance=1e-6, breaks=breaks)
        assert value_and_grad(lambda p: step((0.0, 0.0), p)[0])(2.0) == pytest.approx((wanted, wanted / 2), rel=1e-5)
    tree = dp.stepper("rk4", rate, 1.0, tolerance=1e-6, breaks=lambda p: {"late": np.array([0.7]), "early": 0.3})
    assert tree((0.0, 0.0), 2.0)[0] == pytest.approx(wanted, rel=1e-5)
    none = dp.stepper("rk4", lambda u, p: -p * u, 1.0, tolerance=1e-6, breaks=[])
    assert none((1.0, 0.0), 1.0) == pytest.approx((np.exp(-1.0), 1.0), rel=1e-6)


def test_two_breaks_of_one_param():
    """A pulse of given length: its start moves the result, its height too."""
    rate = lambda u, p, t: anp.where((t >= p[0]) & (t < p[0] + 0.01), p[1], 0.0) - u
    step = dp.stepper("rk4", rate, 2.0, tolerance=1e-6, breaks=lambda p: [p[0], p[0] + 0.01])
    value, g = value_and_grad(lambda p: step((1.0, 0.0), p)[0])(np.array([1.0, 100.0]))
    part = 100 * (np.exp(-0.99) - np.exp(-1.0))
    assert value == pytest.approx(np.exp(-2.0) + part, rel=1e-6)  # 0.505060
    assert g == pytest.approx([part, part / 100], rel=1e-5)


def test_breaks_that_are_adjacent_numbers_coincide():
    """There is no time between them at which the rate could be evaluated: the derivative would be wrong."""
    rate = lambda u, p, t: anp.where(t < p[0], 0.0, 1.0) + anp.where(t < p[1], 0.0, 3.0)
    step = dp.stepper("rk4", rate, 1.0, tolerance=1e-6, breaks=lambda p: p)
    loss = lambda p: step((0.0, 0.0), p)[0]
    near = np.nextafter(0.7, 1.0)
    with pytest.raises(dp.errors.DerivativeError, match="coincide at t = 0.7"):
        value_and_grad(loss)(np.array([0.7, near]))
    assert value_and_grad(loss)(np.array([0.7, np.nextafter(near, 1.0)]))[1] == pytest.approx([-1.0, -3.0], rel=1e-6)


@pytest.mark.whole
def test_a_linear_problem_with_a_source():
    """u' = L u + s(t), by solves: in halves of halves of each piece."""
    grid = dp.Grid(8, size=1.0)
    source = lambda off, t: anp.where(t < off, 1.0, 0.0) * np.ones(8)
    linear = dp.laplacian(grid, dp.neumann)
    step = dp.stepper(
        "backward_euler", None, 0.5, linear=(linear, 1.0), source=source, tolerance=1e-3, breaks=lambda off: off
    )
    value, slope = value_and_grad(lambda off: anp.sum(step((np.zeros(8), 0.0), off)[0]))(0.3)
    assert value == pytest.approx(8 * 0.3, rel=1e-12) and slope == pytest.approx(8.0, rel=1e-12)


def test_the_longest_step():
    step = dp.stepper("rk4", lambda u, p: -p * u, 2.0, tolerance=1e-3, max_step=0.25)
    assert step(1.0, 1.0) == pytest.approx(np.exp(-2.0), rel=1e-4)
    assert 0.1 < max(step.taken) <= 0.125 and len(step.taken) >= 8
    radau = dp.stepper("radau", lambda u, p: -p * u, 2.0, tolerance=1e-3, max_step=0.25)
    assert radau(1.0, 1.0) == pytest.approx(np.exp(-2.0), rel=1e-4) and max(radau.taken) <= 0.125


@pytest.mark.parametrize("method", ["heun", "rk4", "radau"])
def test_a_break_without_a_jump_has_the_derivative_0(method):
    """The derivative of the discrete steps is an error, which was refused as uncertain beside nothing."""
    rate = lambda u, off, t: anp.where(t < off, 1.0, 1.0) - u * u
    step = dp.stepper(method, rate, 1.0, tolerance=1e-4, breaks=lambda off: [off])
    value, slope = value_and_grad(lambda off: step((np.full(1, 2.0), 0.0), off)[0][0])(0.5)
    assert slope == 0.0 and value == pytest.approx(1 / np.tanh(1.0 + np.arctanh(0.5)), rel=1e-4)
