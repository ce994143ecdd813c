"""Kinks, noise, ripples and losses that are rounding, which an audit must not decide; orders of Hessian products."""

import json
from collections import Counter

import autograd.numpy as anp
import numpy as np
import pytest
from undecidable_losses import kinked, noisy

import sparsedp as dp

AUDIT = dp.check.gradient
X = np.linspace(1.0, 2.0, 20)


def verdicts(make, seeds):
    with np.errstate(all="ignore"):
        return Counter(AUDIT(*make(seed)).verdict for seed in seeds)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("seed", [4, pytest.param(5, marks=pytest.mark.whole)])
@pytest.mark.parametrize("make", [kinked, noisy])
def test_at_a_kink_or_in_noise_nothing_agrees(make, seed):
    assert not verdicts(make, [seed])["agrees"]


@pytest.mark.slow
@pytest.mark.parametrize("make", [kinked, noisy])
def test_100_scenes_at_a_kink_or_in_noise(make):
    """A norm at 0 has a gradient of NaN, which is wrong; nothing else is."""
    found = verdicts(make, range(100))
    assert not found["agrees"] and found["inconclusive"] >= (87 if make is kinked else 99), found


def test_noise_is_reported_in_digits():
    staircase = AUDIT(lambda u: float(np.float32(np.sum(u**2))), X, gradient=lambda u: 2 * u)
    assert staircase.verdict == "inconclusive" and "of the loss leaves" in staircase.reason
    assert AUDIT(lambda u: float(np.float32(np.sum(u**2))), X, gradient=lambda u: 2.02 * u).verdict == "disagrees"


@pytest.mark.whole
def test_staircase_losses_that_the_steps_of_the_sweep_cannot_see():
    """Powers of two meet a loss in single precision at one place of its stairs; the table of differences does not."""
    loss, x = noisy(6)
    assert AUDIT(loss, x).verdict == "inconclusive"
    slope = lambda u: float(np.float32(8.0 + u)) - 8.0
    assert AUDIT(slope, 1 / 3, gradient=1.001).verdict != "agrees"


@pytest.mark.parametrize("size", [1e-6, 1e-8, 1e-10])
def test_a_right_gradient_is_not_called_wrong_for_noise_of_any_size(size):
    """Noise that is new at every point: a table of differences measures it, wherever the steps of the sweep are."""
    rng = np.random.default_rng(1)
    for scale in (0.1, 1.0, 10.0, 1.0, 0.1, 10.0):
        x = scale * rng.normal(size=3)
        weights = np.arange(1.0, 4.0)

        def loss(z, size=size, weights=weights):
            return np.sum(np.sin(z) * np.exp(z / 3)) + size * (weights @ z * 1e9 % 1.0 - 0.5)

        found = dp.check.gradient(loss, x, gradient=lambda z: (np.cos(z) + np.sin(z) / 3) * np.exp(z / 3))
        assert found.verdict != "disagrees", found


def test_several_kinks_at_once_follow_a_convention():
    weights = np.random.default_rng(3).standard_normal(20)
    clipped = lambda u: anp.sum(weights * anp.clip(u - X, -9.0, 0.0)) + 3 * anp.sum(u)
    assert AUDIT(clipped, X).verdict == "inconclusive"  # 0 at the kink lies outside some one-sided derivatives
    wrong = lambda u: 3 + weights * (u < X) + 0.1
    assert AUDIT(clipped, X, gradient=wrong).verdict == "disagrees"


def test_a_point_where_every_line_is_straight_but_no_derivative_exists():
    """Differences along two directions do not add up there; a gradient that is wrong beside it too is wrong."""
    weights = np.random.default_rng(4).standard_normal(6)

    def loss(u):
        x = u[::2]
        y = u[1::2]
        return anp.sum(weights * x**3 / (x**2 + y**2 + 1e-300)) + 3 * anp.sum(u)

    def slope(u):
        x = u[::2]
        y = u[1::2]
        square = np.where(x**2 + y**2 > 0, x**2 + y**2, 1.0)
        pairs = np.stack([(x**4 + 3 * x**2 * y**2) / square**2, -2 * x**3 * y / square**2])
        return 3 + np.ravel(weights * pairs, "F")

    zero = np.zeros(12)
    assert "parts of a direction" in AUDIT(loss, zero, gradient=slope).reason
    assert AUDIT(loss, zero, gradient=slope).verdict == "inconclusive"
    assert AUDIT(loss, zero, gradient=lambda u: slope(u) + 0.1).verdict == "disagrees"


# ---- losses that are 0 to rounding -----------------------------------------------------------------------------------

PERIODIC_LAPLACIAN = dp.laplacian(dp.Grid((6, 5), periodic=True))
WAVES = np.sin(np.arange(30.0)).reshape(6, 5)


def cancelled(u):
    """Sum of a Laplacian on a periodic grid: 0 up to rounding, and so is each derivative."""
    return 1e-9 * anp.sum(PERIODIC_LAPLACIAN(u))


@pytest.mark.parametrize("gradient", [None, dp.grad(cancelled)])
@pytest.mark.parametrize("x", [WAVES, np.ones((6, 5))])
def test_a_loss_and_a_gradient_that_are_rounding_are_inconclusive(x, gradient):
    """At ones the loss is exactly 0 and does not change along the constant, and the gradient is not exactly 0."""
    found = AUDIT(cancelled, x, gradient, directions=1)
    assert abs(found.value) < 1e-22 and found.verdict == "inconclusive", found
    assert gradient is not None or "not enough to tell which is right, both may be noise of the loss" in found.reason


def wrong_cube(vjp_error, jvp_error):
    return dp.differentiable(
        "cube",
        lambda u: u**3,
        lambda nums, ans, u: lambda g: (3 * (1 + vjp_error) * u**2 * g,),
        lambda nums, tangents, ans, u: 3 * (1 + jvp_error) * u**2 * tangents[0],
    )


@pytest.mark.parametrize("errors", [(1e-3, 0.0), (0.0, 1e-3), (1e-6, 1e-6)])
def test_a_wrong_gradient_of_a_tiny_loss_is_found(errors):
    cube = wrong_cube(*errors)
    found = AUDIT(lambda u: 1e-20 * anp.sum(cube(u)), X)
    assert found.verdict == "disagrees" and found.culprit == "cube"
    assert AUDIT(lambda u: 1e-20 * anp.sum(u**3), X, gradient=3.003e-20 * X**2).verdict == "disagrees"
    assert AUDIT(lambda u: 0.0 * anp.sum(u**3), X, gradient=3e-23 * X**2).verdict == "disagrees"


def test_a_wrong_rule_that_a_large_constant_hides_is_found_by_itself():
    found = AUDIT(lambda u: 1e15 + anp.sum(wrong_cube(0.0, 1e-2)(u)), X)
    assert found.verdict == "disagrees" and found.culprit == "cube"


# ---- ripples --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size, frequency", [(1e-12, 1e9), (1e-14, 1e11), (1e-10, 1e9), (1e-11, 1e11)])
def test_a_ripple_is_inconclusive_for_any_gradient(size, frequency):
    """The loss moves by its ripple no more than by rounding (or by little more), its derivative by far more."""
    x = X[:3]
    slope = lambda u: size * frequency * np.cos(frequency * u)
    loss = lambda u: anp.sum(u**2) + size * anp.sum(anp.sin(frequency * u))
    taped = AUDIT(loss, x)
    assert taped.verdict == "inconclusive" and "a ripple" in taped.reason
    assert AUDIT(loss, x, gradient=lambda u: 2 * u + slope(u)).verdict == "inconclusive"
    blind = AUDIT(loss, x, gradient=lambda u: 2 * u)  # what the whole climbs by is not the derivative
    assert blind.verdict == "inconclusive" or size * frequency < 1e-2


@pytest.mark.parametrize("size, frequency", [(1e-12, 1e6), (1e-13, 1e7), (1e-15, 1e8), (1e-10, 1e5)])
def test_a_right_gradient_is_not_called_wrong_for_a_ripple_that_its_curvature_hides(size, frequency):
    """Within a step that shows the ripple the gradient changes more by its curvature; both sides tell them apart."""
    assert AUDIT(lambda u: anp.sum(u**2) + size * anp.sum(anp.sin(frequency * u)), X).verdict == "inconclusive"


def test_a_constant_far_above_the_rest_makes_no_ripple():
    """Steps of 1e11 see no curvature at all, and are no measure of the usual one."""
    x = np.random.default_rng(0).uniform(0.5, 1.0, 7)
    off = lambda factor: lambda u: factor * np.cos(u)
    loss = lambda u: 1e8 + anp.sum(anp.sin(u))
    assert AUDIT(loss, x, gradient=off(1.01)).verdict == "disagrees"
    assert AUDIT(loss, x, gradient=off(1.0)).verdict == "agrees"


def test_a_wrong_gradient_is_no_ripple():
    for error in (1e-7, 1e-5, 1e-3):
        assert AUDIT(lambda u: np.sum(np.exp(u)), X, gradient=lambda u: (1 + error) * np.exp(u)).verdict == "disagrees"


# ---- the size of a gradient, Hessian products -----------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-200, 1e200])
def test_the_verdict_does_not_depend_on_the_size_of_the_loss(scale):
    """A right gradient, one three times too large, one off by 1e-7, a kink: with a Hessian product of that size."""
    smooth = lambda u: scale * anp.sum(anp.sin(u) * u**2)
    assert AUDIT(smooth, X).to_dict()["hessian"] == "agrees"
    slope = lambda u: scale * (np.cos(u) * u**2 + 2 * u * np.sin(u))
    assert AUDIT(smooth, X, gradient=lambda u: 3 * slope(u)).verdict == "disagrees"
    assert AUDIT(smooth, X, gradient=lambda u: (1 + 1e-7) * slope(u)).verdict == "disagrees"
    assert AUDIT(lambda u: scale * anp.sum(anp.abs(u - X)), X).verdict == "inconclusive"


def test_order_three_with_a_hessian_product():
    found = AUDIT(lambda u: anp.sum(anp.sin(u) * u**2), X)
    line = found.lines[0]
    assert found.hessian == "agrees" and line.rate3 == pytest.approx(3, abs=0.1) and "order 3" in str(found)
    data = json.loads(json.dumps(found.to_dict()))
    assert data["hessian"] == "agrees" and data["lines"][0]["rate3"] == line.rate3
    square = AUDIT(lambda u: anp.sum(u**2), X)
    assert square.hessian == "agrees" and np.isinf(square.lines[0].rate3)
    solve = dp.inverse(-dp.laplacian(dp.Grid((5, 4)), dp.dirichlet))
    assert AUDIT(lambda b: anp.sum(solve(anp.exp(b)) ** 2), X.reshape(5, 4)).lines[0].rate3 >= 2.9


def test_a_wrong_hessian_leaves_the_verdict_on_the_gradient():
    kept = dp.differentiable(
        "kept", lambda u: u**3, lambda nums, ans, u: lambda g: (3 * np.asarray(plain(u)) ** 2 * g,)
    )
    found = AUDIT(lambda u: anp.sum(kept(u) * u), X)
    assert found and found.hessian == "disagrees" and "Hessian product: disagrees" in str(found)
    assert found.lines[0].rate3 == pytest.approx(2, abs=0.05)


def plain(u):
    return getattr(u, "_value", u)


def test_unavailable_hessian_products():
    bent = AUDIT(lambda u: anp.sum(u**2) + anp.sum(anp.abs(u - X) ** 2.5), X)
    assert bent and bent.hessian == "inconclusive" and "not three times differentiable" in str(bent)
    assert AUDIT(lambda u: np.sum(u**2), X, gradient=2 * X).hessian is None
    assert "x is complex" in str(AUDIT(lambda z: anp.sum(anp.abs(z) ** 2), X + 1j))

    def once(nums, ans, u):
        def pull(g):
            if isinstance(u, np.ndarray):
                return (3 * u**2 * g,)
            raise TypeError("no second derivative")

        return pull

    cube = dp.differentiable("cube", lambda u: u**3, once)
    found = AUDIT(lambda u: anp.sum(cube(u)), X)
    assert found and found.hessian is None and "Hessian product: not available (TypeError)" in str(found)


def test_a_hessian_product_that_is_no_number_does_not_agree():
    back = lambda nums, ans, u: lambda g: (3 * u**2 * g + 0 * anp.sqrt(u - u) * g,)
    cube = dp.differentiable("cube", lambda u: u**3, back)
    with np.errstate(all="ignore"):
        found = AUDIT(lambda u: anp.sum(cube(u) ** 2), X)
    assert found and found.hessian == "disagrees"
    assert "third Taylor remainder cannot be told: it is not finite" in str(found)


@pytest.mark.slow
def test_a_right_gradient_among_kinks_is_not_called_wrong_and_a_wrong_one_is():
    """Clamped MacCormack on a field with ties: along one of the directions the kinks lie too close to be split."""
    grid = dp.Grid((24, 24), size=1.0, periodic=True)
    x, y = grid.centres()
    wind = dp.projection(grid)(0.3 * np.random.default_rng(1).standard_normal(grid.faces.size))
    ink = np.exp(-((x - 0.5) ** 2 + (y - 0.5) ** 2) / 0.02) + 0.1 * np.sin(5 * x)
    move = dp.transport(grid, "maccormack")
    wrong = dp.differentiable("wrong", lambda u: u**2, lambda nums, ans, u: lambda g: (2.02 * u * g,))

    def end(p):
        return dp.rollout(lambda u, q: move(u, q["wind"], q["dt"]), p["ink"], p, 5)

    start = {"ink": ink, "wind": wind, "dt": 0.01}
    found = dp.check.gradient(lambda p: anp.sum(end(p) ** 2), start)
    assert "a kink: the one-sided" in str(found) and found.verdict == "inconclusive"
    found = dp.check.gradient(lambda p: anp.sum(wrong(end(p))), start)
    assert found.verdict == "disagrees" and found.culprit == "wrong"


# ---- steps with error control ----------------------------------------------------------------------------------------


CONTROLLED = dp.stepper("heun", lambda u, p: p * anp.sin(u), 0.5, tolerance=1e-3)
RATE = np.array([1.1, 0.9])


def with_controlled_steps(error):
    """A loss with error-controlled steps and a rule whose VJP and JVP are off by the share `error`."""
    cube = dp.differentiable(
        "cube",
        lambda u: u**3,
        lambda nums, ans, u: lambda g: (3 * (1 + error) * u**2 * g,),
        lambda nums, tangents, ans, u: 3 * (1 + error) * u**2 * tangents[0],
    )
    return lambda rate: anp.sum(cube(CONTROLLED(np.array([1.0, 0.4]), rate)))


@pytest.mark.parametrize("error", [0.0, *(pytest.param(share, marks=pytest.mark.whole) for share in (1e-3, 0.1))])
def test_gaps_within_the_tolerance_of_steps_are_inconclusive(error):
    """The gap is below the tolerance; a wrong rule of the same size is found by itself."""
    found = dp.check.gradient(with_controlled_steps(error), RATE, directions=1, quick=True)
    if error:
        assert found.verdict == "disagrees" and found.culprit == "cube"
    else:
        assert found.verdict == "inconclusive" and found.culprit is None
        assert "the steps' tolerance of 0.001 leaves this, tighten it" in found.reason


@pytest.mark.whole
def test_a_given_gradient_behind_controlled_steps():
    """Ten tolerances are the limit where no call can be examined."""
    loss = with_controlled_steps(0.0)
    slope = dp.grad(loss)
    assert dp.check.gradient(loss, RATE, slope, directions=1, quick=True).verdict == "inconclusive"
    wrong = dp.check.gradient(loss, RATE, lambda rate: 1.05 * slope(rate), directions=1, quick=True)
    assert wrong.verdict == "disagrees"
