"""Radau IIA: order, published stiff problems, derivatives that are right or refused, refusals at the door."""

import autograd.numpy as anp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from stiff import SCENES, of_hires, robertson
from test_integrators_variation import KNOWN, oscillator

import sparsedp as dp
from sparsedp.autodiff.derivative import pushforward, value_and_grad
from sparsedp.errors import ConvergenceError, DerivativeError, NonFiniteError, ShapeError
from sparsedp.integrators import jacobians
from sparsedp.integrators.embedded import FlatProblem
from sparsedp.integrators.problem import untraced
from sparsedp.integrators.radau import A, C, Radau

RATES = np.array([0.04, 1e4, 3e7])
SMALL = {"Robertson": np.array([1e-6, 1e-11, 1e-2])}


def pendulum(u, p, t):
    return {"a": u["s"], "s": -p["g"] * anp.sin(u["a"]) * (1 + 0.1 * anp.cos(t))}


def pendulum_by_scipy(a, g, end, start=0.0):
    rate = lambda t, u: [u[1], -g * np.sin(u[0]) * (1 + 0.1 * np.cos(t))]
    return solve_ivp(rate, (start, start + end), [a, 0.0], method="DOP853", rtol=1e-13, atol=1e-14).y[0, -1]


def angle(x, count=1, **options):
    """Of (first angle, g, end, first time): the last angle."""
    step = dp.stepper("radau", pendulum, lambda p: p["T"] / count, **options)
    return dp.rollout(step, ({"a": x[0], "s": 0.0}, x[3]), {"g": x[1], "T": x[2]}, count)[0]["a"]


def bends(pair):
    """Both results of a call with two: their derivatives have two shapes."""
    return anp.abs(pair[1][0]) + pair[0] * pair[1][1] ** 2


split = dp.differentiable(
    "split",
    lambda u: (u[:1] * 2.0, u * u),
    lambda nums, ans, u: lambda g: (2 * anp.concatenate([g[0], np.zeros(2)]) + 2 * u * g[1],),
)
X = np.array([1.0, 2.0, 1.5, 0.3])
MATRIX = np.random.default_rng(1).standard_normal((3, 3))
LINE = dp.laplacian(dp.Grid(3), dp.dirichlet)


def test_order_five():
    """On a smooth problem with fixed steps."""
    exact = pendulum_by_scipy(*X)
    errors = [abs(angle(X, count) - exact) for count in (4, 8, 16)]
    assert np.log2(np.array(errors[:-1]) / errors[1:]) == pytest.approx([5, 5], abs=0.25)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("stiffness", [1e2, 1e6])
def test_prothero_robinson(stiffness, monkeypatch):
    """u' = -k (u - cos t) - sin t, whose solution is cos t: at every tolerance, and better with the tolerance."""
    calls = []

    def rate(u, k, t):
        calls.append(t)
        return -k * (u - anp.cos(t)) - anp.sin(t)

    errors = []
    tolerances = (1e-3, 1e-5, 1e-8)
    for tolerance in tolerances:
        calls.clear()
        step = dp.stepper("radau", rate, 5.0, tolerance=tolerance)
        with monkeypatch.context() as patch:
            patch.setattr(Radau, "inspector", lambda self, known: None)  # calls of Newton's method alone are counted
            errors.append(abs(step((1.0, 0.0), stiffness)[0] - np.cos(5.0)))
        assert len(calls) < 10 * len(step.taken)  # 11 to 42 with an error of the start in every trial from it
        forced = dp.stepper("radau", lambda u, p, t: p * rate(u / p, stiffness, t), 5.0, tolerance=tolerance)
        slope = value_and_grad(lambda p: forced((1.0, 0.0), p)[0])(1.0)[1]  # of p cos t
        assert slope == pytest.approx(np.cos(5.0), rel=10 * tolerance)
        assert len(step.taken) < 110
    assert errors[2] < errors[0] and all(e <= 2 * tol for e, tol in zip(errors, tolerances, strict=True))


@pytest.mark.whole
def test_published_values():
    """Robertson at 40 s (Hairer and Wanner), at 1e11 s and HIRES at 321.8122 s (IVP test set)."""
    step = dp.stepper("radau", robertson, 40.0, tolerance=1e-6, floor=SMALL["Robertson"])
    assert step(np.array([1.0, 0, 0]), RATES) == pytest.approx([0.7158, 9.185e-6, 0.2841], rel=1e-3)
    late = dp.stepper("radau", robertson, 1e11, tolerance=1e-6, floor=np.array([1e-8, 1e-13, 1.0]))
    end = late(np.array([1.0, 0, 0]), RATES)  # the first step is 1e-16 of the interval
    assert end == pytest.approx([0.2083340149701255e-7, 0.8333360770334713e-13, 0.9999999791665050], rel=1e-6)
    rate, _, start, params, end, _ = SCENES["HIRES"]
    wanted = [
        0.7371312573325668e-3,
        0.1442485726316185e-3,
        0.5888729740967575e-4,
        0.1175651343283149e-2,
        0.2386356198831331e-2,
        0.6238968252742796e-2,
        0.2849998395185769e-2,
        0.2850001604814231e-2,
    ]
    new = dp.stepper("radau", rate, end, tolerance=1e-9)(np.array(start), np.array(params))
    assert np.max(np.abs(new - wanted)) <= 1e-9 * np.max(wanted)


@pytest.mark.parametrize(
    "name",
    [
        "van der Pol, 100",
        *(pytest.param(n, marks=pytest.mark.whole) for n in ("Robertson", "HIRES", "van der Pol, 1000")),
    ],
)
def test_stiff_problems_with_their_gradients(name):
    """Values and gradients within the tolerance that the page names; both fall with it."""
    rate, _, start, params, end, number = SCENES[name]
    state, slopes = map(np.array, KNOWN[name])
    start = np.array(start)
    params = np.array(params)
    found = []
    for tolerance in (1e-3, 1e-5, 1e-7):
        step = dp.stepper("radau", rate, end, tolerance=tolerance, floor=SMALL.get(name))
        new = step(start, params)
        value, g = value_and_grad(lambda p: step(start, p)[number])(params)
        assert value == new[number]  # a trace changes no bit
        of_gradient = np.linalg.norm(g * params - slopes) / np.linalg.norm(slopes)
        assert of_gradient <= 6 * tolerance**0.75
        found.append((np.max(np.abs(new - state)) / np.max(np.abs(state)), of_gradient))
    assert (
        found[0][0] > found[1][0] > found[2][0] and max(found[0][1], 1e-7) > found[2][1] <= 1e-6
    )  # the reference is good to 3e-8


@pytest.mark.parametrize("tolerance", [1e-6, 1e-8])
def test_moved_rates_with_the_default_floor(tolerance):
    """Robertson's system with rates 10 % larger: the reference is SciPy's Radau with its variational equation."""
    step = dp.stepper("radau", robertson, 73.0, tolerance=tolerance)
    value, g = value_and_grad(lambda p: step(np.array([1.0, 0.0, 0.0]), p)[2])(1.1 * RATES)
    assert value == pytest.approx(0.358133418, rel=1e-7)
    assert 1.1 * RATES * g == pytest.approx([0.1968827, -0.17206365, 0.08603297], rel=1e-6)


def test_one_step_against_a_root():
    """The value and gradient of a fixed step agree with the stage equations, solved by `implicit`."""
    p = np.array([2.0, 0.5])
    u = np.array([1.0, -0.5, 0.3])

    def rate(u, p, t):
        return anp.array([u[1] * u[2], -p[0] * u[0] + anp.sin(t), p[1] * u[0] ** 2 - u[2]])

    def stages(z, u, p, t, h):
        f = anp.array([rate(u + z[i], p, t + C[i] * h) for i in range(3)])
        return z - h * anp.dot(A, f)

    root = dp.implicit(stages, rtol=1e-13)
    weights = np.array([1.0, 2.0, -1.0])
    step = dp.stepper("radau", rate, lambda p: p[1], rtol=1e-13)
    ours = lambda x: anp.sum(weights * step((x["u"], x["t"]), (x["p"], x["h"]))[0])
    step = dp.stepper("radau", lambda u, p, t: rate(u, p[0], t), lambda p: p[1], rtol=1e-13)
    twin = lambda x: anp.sum(weights * (x["u"] + root(np.zeros((3, 3)), x["u"], x["p"], x["t"], x["h"])[2]))
    x = {"u": u, "p": p, "t": 0.3, "h": 0.4}
    (value, g), (wanted, slopes) = value_and_grad(ours)(x), value_and_grad(twin)(x)
    assert value == pytest.approx(wanted, rel=1e-11)
    for key, slope in slopes.items():
        assert g[key] == pytest.approx(slope, rel=1e-9, abs=1e-11)
    assert dp.check.gradient(ours, x, directions=1).verdict == "agrees"


@pytest.mark.sampled(0)
@pytest.mark.parametrize(
    "count, options, near", [(1, dict(tolerance=1e-7), 1e-6), (3, dict(tolerance=1e-7), 1e-6), (20, {}, 1e-6)]
)
def test_every_mode(count, options, near):
    """A tree with time: gradient and tangent in state, params, time and length beside differences of SciPy's."""
    wanted = [(pendulum_by_scipy(*(X + d)) - pendulum_by_scipy(*(X - d))) / 2e-4 for d in 1e-4 * np.eye(4)]
    loss = lambda x: angle(x, count, **options)
    value, g = value_and_grad(loss)(X)
    assert value == pytest.approx(pendulum_by_scipy(*X), abs=near) and g == pytest.approx(wanted, rel=near, abs=near)
    along = np.array([0.3, 0.5, -0.2, 0.1])
    assert pushforward(loss, X, along)[1] == pytest.approx(g @ along, rel=1e-9)


@pytest.mark.parametrize(
    "rate",
    [
        lambda u, p: anp.array([p[0] * u[1] / u[0], -(u[2] ** p[1]) + u[2] - 3.0, u[0] * u[0] + u[-1]]),
        lambda u, p: anp.array([u[..., 0] * p[0], anp.sin(u[0]) * u[1], 2.0 - u[2]]),
        lambda u, p: anp.dot(anp.array([[1.0, p[0], 2.0], [p[1], 0.0, 1.0], [0.0, 3.0, 1.0]]), u * u) + u[1],
        lambda u, p: u[anp.array([0, 0, 2])] * p[0] + anp.concatenate([u[1:], u[:1]]) * anp.array([u[0], p[1], 1.0]),
        lambda u, p: anp.array([u, u * p[0], u])[1] + anp.sum(anp.array([u, p[1] * u])),
        lambda u, p: u * [1.0, 2.0, 3.0] / anp.array([u, u * u])[1:, :][0] - (u[None] ** np.array([2.0, 1.0, 3.0]))[0],
        lambda u, p: (np.ones((3, 3)) * anp.array([u, 2.0 * u, u * u]) * np.arange(3.0))[1, ...] + u[...],
        lambda u, p: anp.array([1.0, 2.0, 3.0]) + 0.0 * u[0],
        lambda u, p: u,
        lambda u, p: anp.ones(3),
        lambda u, p: anp.where(u > 1, anp.exp(-u), u**2) * p[0] + anp.maximum(u, p[1]) - anp.minimum(u, 1.0),
        lambda u, p: anp.roll(u, 1) * anp.repeat(p[:1], 3) + anp.sum(u * u) * anp.sqrt(u) / p[1],
        lambda u, p: anp.concatenate([u[u > 1], np.ones(int(np.sum(untraced(u) <= 1)))]) * p[0],
        lambda u, p: u * p[0] if u[0] > u[1] else anp.sin(u) / p[1],
        lambda u, p: (MATRIX + p[0]) @ anp.tanh(MATRIX @ u) + anp.dot(MATRIX, anp.concatenate([p, [1.0]])) * u,
        lambda u, p: anp.reshape(anp.reshape(u, (3, 1)) * anp.array([p[0], 1.0]) + MATRIX[:, :2], -1)[::2] - u[-1:],
        lambda u, p: LINE(u * p[0]) + dp.transport(LINE.domain.grid)(u, p[1] * np.ones(4), 0.01),
        lambda u, p: anp.sum(anp.outer(u, p), axis=1) + anp.real(anp.exp(1j * u)) + u ** p[0],
        lambda u, p: anp.roll(u * [1.0, 2.0, 5.0], 1) * p[0] + anp.roll(u / (1.0, 2.0, 4.0), 2) ** [1.0, 2.0, 3.0],
        lambda u, p: split(u)[0] * split(u)[1] + anp.roll(split(p[0] * u)[0], 1),
        lambda u, p: bends(anp.linalg.eigh(p[0] * MATRIX @ MATRIX.T + anp.outer(u, u))),
    ],
)
def test_all_rows_at_once(rate):
    """The derivatives of a rate at many points agree up to rounding with one backward pass for each row and point."""
    points = np.random.default_rng(0).uniform(0.3, 2.5, (9, 3))
    p = np.array([0.7, 1.6])
    problem = dp.stepper("radau", rate, 1.0).problem
    rates, rows = FlatProblem(problem, points[0], "radau").rows([(u, 0.0) for u in points], p, [True])
    for u, f, found in zip(points, rates, rows, strict=True):
        _, pull = dp.vjp(lambda u, p: 1.0 * rate(u, p) + 0.0 * u * p[0], u, p)
        wanted = np.array([[*np.concatenate(pull(e)), 0.0] for e in np.eye(3)])
        assert np.array_equal(f, rate(u, p)) and found == pytest.approx(wanted, rel=1e-14, abs=1e-14)


def test_tapes_of_many_points_are_traversed_together(monkeypatch):
    """Tapes of the same calls do, each branch by itself; what is not known goes back alone."""
    groups = []
    one_by_one = jacobians._rows
    monkeypatch.setattr(jacobians, "_rows", lambda tapes, *rest: groups.append(len(tapes)) or one_by_one(tapes, *rest))
    cube = dp.differentiable("cube", lambda x: x**3, lambda nums, ans, x: lambda g: (3 * x**2 * g,))
    points = [np.array([x, 1.0]) for x in (0.5, 1.5, 2.5, 0.1)]
    for fun, found in ((lambda u: u * u if u[0] > 1 else anp.sin(u), [2, 2]), (cube, [1, 1, 1, 1])):
        groups.clear()
        values, rows = jacobians.jacobians_of(fun, points, [True])
        assert groups == found and np.array_equal(values, [fun(u) for u in points])
        assert rows == pytest.approx(np.array([np.diag(dp.vjp(fun, u)[1](np.ones(2))) for u in points]), rel=1e-15)


def test_second_and_third_derivatives():
    """u' = -p u^2 has the solution u / (1 + p u t): with error control, and of one step in every order of the modes."""
    x, tangent = np.array([1.5, 2.0]), np.array([0.3, -0.7])
    second = lambda fun: lambda x: dp.grad(lambda x: dp.grad(fun)(x) @ tangent)(x)
    third = lambda fun: pushforward(second(fun), x, tangent)[1]
    for dt, options, near in ((0.5, dict(tolerance=1e-3), 1e-5), (0.05, dict(rtol=1e-13), 1e-8)):
        step = dp.stepper("radau", lambda u, p: -p * u**2, dt, **options)
        ours = lambda x, step=step: step(x[:1], x[1])[0]
        exact = lambda x, dt=dt: x[0] / (1 + dt * x[0] * x[1])
        assert dp.hvp(ours, x, tangent) == pytest.approx(second(exact)(x), rel=near)
    assert second(ours)(x) == pytest.approx(second(exact)(x), rel=near)
    assert third(ours) == pytest.approx(third(exact), rel=near)


def test_second_derivatives_in_everything():
    """Of a tree with time, in state, params, length and time: a symmetric matrix that differences of gradients give."""
    loss = lambda x: angle(x, 2, rtol=1e-13)
    tangent, slopes = np.array([0.3, 0.5, -0.2, 0.1]), dp.grad(loss)
    wanted = (slopes(X + 1e-4 * tangent) - slopes(X - 1e-4 * tangent)) / 2e-4
    assert dp.hvp(loss, X, tangent) == pytest.approx(wanted, rel=1e-7)


def test_second_derivatives_of_the_time_of_an_event():
    """The ball reaches the height 1 at sqrt(2 (h - 1) / g)."""
    reached = lambda u, g, t: u["x"] - 1.0
    reached.terminal = True
    fall = lambda u, g, t: {"x": u["v"], "v": -g + 0.0 * u["v"]}
    step = dp.stepper("radau", fall, 2.0, tolerance=1e-4, events=reached)
    ours = lambda x: step(({"x": x[0], "v": 0.0}, 0.0), x[1])[1]
    exact = lambda x: anp.sqrt(2 * (x[0] - 1) / x[1])
    x, tangent = np.array([5.0, 10.0]), np.array([0.3, -0.7])
    assert dp.hvp(ours, x, tangent) == pytest.approx(dp.hvp(exact, x, tangent), rel=1e-8)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("tolerance", [1e-2, 1e-4, pytest.param(1e-6, marks=pytest.mark.whole)])
def test_intervals_that_meet_in_a_jump(tolerance):
    """Terms of the derivative there cancel to a thousandth: right, or refused."""
    slope = -0.6642059117567769 / 20
    for cut in (16.969, 16.9692, 16.9694):
        first, then = (dp.stepper("radau", oscillator, length, tolerance=tolerance) for length in (cut, 20.0 - cut))
        try:
            g = value_and_grad(lambda mu: then(first(np.array([2.0, 0.0]), mu), mu)[0])(20.0)[1]
        except DerivativeError as error:
            assert "give a smaller floor or tolerance" in str(error)
        else:
            assert abs(g / slope - 1) <= 10 * tolerance


@pytest.mark.whole
@pytest.mark.parametrize("at_fault", ["double", None])
def test_an_audit_of_a_wrong_loss_blames_no_step(at_fault):
    """Its gradient is right, and the search for the culprit goes on after it."""
    step = dp.stepper("radau", robertson, 0.5, tolerance=1e-3, floor=SMALL["Robertson"])
    bypass = dp.differentiable("double", lambda u: 2.0 * u, lambda nums, ans, u: lambda g: (2.1 * g,))
    ends = lambda p: step(np.array([1.0, 0, 0]), RATES * p)[2]
    losses = {"double": lambda p: bypass(ends(p)), None: lambda p: ends(p) * (1 + 0.1 * anp.sum(untraced(p)))}
    found = dp.check.gradient(losses[at_fault], np.ones(3), directions=1, quick=True)
    assert found.verdict == "disagrees" and found.culprit == at_fault


@pytest.mark.whole
def test_long_oscillation():
    """The phase of the derivative in a frequency grows with time; right, or refused."""
    rate = lambda u, p: anp.array([p * u[1], -p * u[0]])
    end = 80.0
    for tolerance in (1e-3, 1e-5):
        step = dp.stepper("radau", rate, end, tolerance=tolerance)
        exact = -end * np.sin(end * 1.01)
        try:
            g = value_and_grad(lambda p: step(np.array([1.0, 0.0]), p)[0])(1.01)[1]
        except DerivativeError:
            continue
        assert abs(g - exact) <= 6 * tolerance**0.75 * end


def test_what_matters_early_only():
    """A kick in the first thousandth, forgotten by one part and kept by the other."""

    def rate(u, p, t):
        kick = p[0] * anp.exp(-(((t - 0.05) / 0.01) ** 2))
        return anp.array([kick - p[1] * u[0], kick])

    step = dp.stepper("radau", rate, 50.0, tolerance=1e-6, floor=1e-3)
    value, g = value_and_grad(lambda p: step((np.zeros(2), 0.0), p)[0][1])(np.array([3.0, 1.0]))
    assert g[0] == pytest.approx(0.01 * np.sqrt(np.pi), rel=1e-5) and abs(g[1]) <= 1e-9


@pytest.mark.sampled(0)
@pytest.mark.parametrize("given", [lambda u, p: of_hires(u, p)[0], lambda u, p: 1.1 * of_hires(u, p)[0]])
def test_a_jacobian_that_is_given(given):
    """It serves Newton's method; a poor one costs steps, and never the derivative."""
    rate, _, start, params, end, number = SCENES["HIRES"]
    start = np.array(start)
    params = np.array(params)
    step = dp.stepper("radau", rate, end, tolerance=1e-6, jacobian=given)
    value, g = value_and_grad(lambda p: step(start, p)[number])(params)
    assert value == pytest.approx(KNOWN["HIRES"][0][number], rel=1e-5)
    assert np.linalg.norm(g * params - KNOWN["HIRES"][1]) <= 1e-5 * np.linalg.norm(KNOWN["HIRES"][1])


def test_kinds_of_states():
    """Batches, single precision, one number, whole numbers, nothing, nothing that moves; inputs stay as they are."""
    rate = lambda u, p: -p * u**2
    p = 0.5
    step = dp.stepper("radau", rate, 2.0, tolerance=1e-6)
    u = np.array([[1.0, 2.0], [0.5, 0.1]])
    u.flags.writeable = False
    exact = u / (1 + p * u * 2.0)
    assert step(u, p) == pytest.approx(exact, rel=1e-5)
    single = step(u.astype(np.float32), p)
    assert single.dtype == np.float32 and single == pytest.approx(exact, rel=1e-5)
    g = value_and_grad(lambda u: anp.sum(step(u, p)))(u.astype(np.float32))[1]
    assert g.dtype == np.float32 and g == pytest.approx((1 + p * u * 2.0) ** -2, rel=1e-4)
    assert isinstance(step(1.0, p), float) and step(1.0, p) == pytest.approx(0.5, rel=1e-6)
    assert value_and_grad(lambda p: step(1.0, p))(p)[1] == pytest.approx(-0.5, rel=1e-5)
    assert step(np.array([1, 2]), p) == pytest.approx(exact[0], rel=1e-5)
    assert step(np.zeros(0), p).shape == (0,)
    still = dp.stepper("radau", lambda u, p: 0.0 * u, 1.0, tolerance=1e-6)
    assert np.array_equal(still(u, None), u) and still.taken == [1.0]
    from_zero = dp.stepper("radau", lambda u, p: p + 0.0 * u, 2.0, tolerance=1e-6)
    assert from_zero(np.zeros(2), 3.0) == pytest.approx([6.0, 6.0], rel=1e-12)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("tolerance", [1e-12, 1e-14])
def test_fine_tolerances(tolerance):
    """Near rounding: met, or refused in words."""
    step = dp.stepper("radau", lambda u, p: -p * u, 1.0, tolerance=tolerance)
    try:
        assert step(np.ones(2), 1.0) == pytest.approx(np.exp(-1.0), rel=1e-11)
    except ConvergenceError as error:
        assert "found no step that meets the tolerance" in str(error)


def test_an_operator_and_a_source():
    """u' = c L u + s + rate, dense."""
    grid = dp.Grid(12, size=1.0)
    L = dp.laplacian(grid, dp.dirichlet)
    step = dp.stepper(
        "radau", lambda u, p: -(u**3), 0.1, linear=(L, lambda p: p), source=lambda p: p * np.ones(12), tolerance=1e-7
    )
    u = np.sin(np.pi * grid.centres()[0])
    short = dp.stepper("rk4", lambda u, p: p * L(u) - u**3 + p, 0.1 / 200)
    fine = lambda u, p: dp.rollout(short, u, p, 200)
    (value, g), (wanted, slope) = (value_and_grad(lambda p: anp.sum(s(u, p)))(0.7) for s in (step, fine))
    assert value == pytest.approx(wanted, rel=1e-5) and g == pytest.approx(slope, rel=1e-4)


ONES = np.ones(2)
DECAY = lambda u, p: -p * u
REFUSED = [
    (
        lambda: dp.stepper("radau", DECAY, 1.0, sparsity=np.eye(2)),
        TypeError,
        "radau does not use sparsity; leave it out",
    ),
    (lambda: dp.stepper("radau", DECAY, 1.0, solver="krylov"), TypeError, "radau does not use solver; leave it out"),
    (
        lambda: dp.stepper("radau", DECAY, 1.0)(np.ones(501), 1.0),
        ShapeError,
        "stepper(radau) solves full systems of at most 500 unknowns, got 501; take rodas5p",
    ),
    (
        lambda: dp.stepper("radau", DECAY, 1.0)(ONES + 1j, 1.0),
        TypeError,
        "stepper(radau) solves for real unknowns; give real and imaginary part as two fields",
    ),
    (
        lambda: dp.stepper("radau", DECAY, 1.0)(ONES, 1j),
        TypeError,
        "a rate of complex numbers needs a complex state, got float64; write u.astype(complex)",
    ),
    (
        lambda: value_and_grad(lambda p: dp.stepper("radau", lambda u, p: -anp.abs(p) * u, 1.0)(ONES, p)[0])(1j),
        DerivativeError,
        "stepper(radau) has derivatives in real params; give real and imaginary part as two",
    ),
    (
        lambda: value_and_grad(lambda k: dp.stepper("radau", lambda u, p: -k * u, 1.0)(ONES, None)[0])(1.0),
        DerivativeError,
        "the rate of stepper(radau) uses a traced value that is not an argument; put it into params",
    ),
    (
        lambda: dp.stepper("radau", DECAY, 1.0, tolerance=1e-8)(np.ones(2, np.float32), 1.0),
        ValueError,
        "stepper(radau) cannot meet the tolerance 1e-08 with a state of float32, whose rounding is 1.2e-07; "
        "take a larger tolerance or write u.astype(float)",
    ),
    (
        lambda: dp.stepper("radau", DECAY, 1.0, jacobian=lambda u, p: np.eye(3))(ONES, 1.0),
        ShapeError,
        "the jacobian of stepper(radau) must have shape (2, 2), got (3, 3)",
    ),
    (
        lambda: dp.stepper("radau", lambda u, p: u[:1], 1.0)(ONES, 1.0),
        ShapeError,
        "rate: expected shape (2,), got (1,); return a tree like the state",
    ),
    (
        lambda: dp.stepper("radau", DECAY, 1.0)(np.array([1.0, np.nan]), 1.0),
        NonFiniteError,
        "state of stepper(radau) must be finite, got 1 that are NaN or infinite, the first at 1",
    ),
    (
        lambda: dp.stepper("radau", lambda u, p: p * u**2, 2.0)(np.array([1.0]), 1.0),
        ConvergenceError,
        "stepper(radau): Newton's method does not converge in a step of 2; "
        "take a smaller dt, or give stepper a tolerance",
    ),
    (
        lambda: dp.stepper("radau", lambda u, p: p * u**2, 2.0, tolerance=1e-3)(np.array([1.0]), 1.0),
        ConvergenceError,
        "stepper(radau) found no step that meets the tolerance 0.001 at 0.5",
    ),
    (
        lambda: dp.stepper("radau", lambda u, p: p * anp.log(u), 1.0, tolerance=1e-3)(np.array([0.0]), 1.0),
        NonFiniteError,
        "the rate of stepper(radau) must be finite at the state given; take a state in its domain",
    ),
]


@pytest.mark.parametrize("act, kind, message", REFUSED)
def test_refusals(act, kind, message):
    with pytest.raises(kind) as caught, np.errstate(all="ignore"):
        act()
    assert str(caught.value).startswith(message)
