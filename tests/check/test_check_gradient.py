"""The audit of a gradient: right ones agree, wrong ones are caught, and what proves nothing is inconclusive."""

import zlib

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

AUDIT = dp.check.gradient
X = np.linspace(1.0, 2.0, 20)
GRID = dp.Grid((6, 5), size=(1.0, 2.0))


def smooth(u):
    return anp.sum(anp.sin(u) * u**2)


def slope(u):
    return np.cos(u) * u**2 + 2 * u * np.sin(u)


def hash_noise(u):
    return zlib.crc32(u.tobytes()) / 2**31 - 1


# ---- smooth losses -------------------------------------------------------------------------------------------------


def test_a_right_gradient_agrees():
    result = AUDIT(smooth, X)
    assert result and result.ok and result.verdict == "agrees"
    assert result.digits >= 8 and result.culprit is None
    assert {line.direction for line in result.lines} >= {"random 1", "constant", "gradient", "largest entry"}
    for line in result.lines:
        assert line.word == "agrees"
        assert line.rate1 == pytest.approx(1, abs=0.05)
        assert line.rate2 >= 1.95


@pytest.mark.parametrize("error", [1e-2, 1e-3, 1e-4, -1e-4, 1e-6, -1e-6, 1e-7])
def test_a_wrong_gradient_disagrees(error):
    result = AUDIT(smooth, X, gradient=lambda u: (1 + error) * slope(u))
    assert result.verdict == "disagrees" and not result
    assert result.digits is None
    assert "off by" in result.reason and "error bars" in result.reason


@pytest.mark.parametrize("scale", [1e-200, 1e-12, 1e12, 1e200])
def test_the_size_of_the_loss_does_not_matter(scale):
    assert AUDIT(lambda u: scale * smooth(u), X).digits == AUDIT(smooth, X).digits
    assert AUDIT(lambda u: scale * smooth(u), X, gradient=lambda u: 1.001 * scale * slope(u)).verdict == "disagrees"


@pytest.mark.parametrize("scale", [1e-10, 1e-3, 1e10])
def test_the_size_of_x_does_not_matter(scale):
    assert AUDIT(lambda u: smooth(u / scale), X * scale)
    assert AUDIT(lambda u: np.sum(np.sin(u)), 0 * X, gradient=np.cos)
    assert AUDIT(lambda u: np.sum(np.sin(u)), 1e-10 * X, gradient=np.cos)
    assert AUDIT(lambda u: np.sum(np.sin(u)), 1e-10 * X, gradient=lambda u: 1.001 * np.cos(u)).verdict == "disagrees"
    assert AUDIT(lambda u: np.sum(np.sin(u)), 1e5 + X, gradient=np.cos)


def test_what_an_absolute_tolerance_accepts():
    assert AUDIT(lambda u: 1 + 1e-8 * np.sum(u**2), X, gradient=lambda u: 3 * 2e-8 * u).verdict == "disagrees"
    assert AUDIT(lambda u: 1e-6 * np.sum(u), X, gradient=lambda u: 1.1e-6 + 0 * u).verdict == "disagrees"
    assert AUDIT(lambda u: 1e-6 * np.sum(u), X, gradient=lambda u: 1e-6 + 0 * u)


def test_one_wrong_entry_in_ten_thousand():
    x = np.linspace(0.0, 1.0, 10000)
    wrong = AUDIT(lambda u: np.sum(np.sin(u)), x, gradient=lambda u: np.cos(u) * (np.arange(10000) != 77))
    assert wrong.verdict == "disagrees"


@pytest.mark.parametrize(
    "x, quick, factor, least, most",
    [
        (np.linspace(1.0, 2.0, 200), False, 1.0, 130, 160),
        (np.linspace(1.0, 2.0, 200), True, 1.0, 55, 65),
        (1.5, False, 1.0, 30, 40),
        (np.linspace(1.0, 2.0, 200), False, 1.01, 350, 450),
        (np.linspace(1.0, 2.0, 200), True, 1.01, 150, 180),
    ],
)
def test_the_documented_numbers_of_evaluations(x, quick, factor, least, most):
    found = AUDIT(lambda u: np.sum(u**3), x, gradient=lambda u: 3 * u ** (1 + factor), quick=quick)
    assert bool(found) == (factor == 1) and least <= found.evaluations <= most


def test_random_directions_are_not_repeated():
    """One number can be moved along one direction only; two numbers along two random ones that differ."""
    names = [line.direction for line in AUDIT(lambda u: u**2, 1.5, gradient=lambda u: 2 * u, directions=5).lines]
    assert names == ["random 1"]
    lines = AUDIT(lambda u: u[0] * u[1], (1.5, 0.5), gradient=lambda u: (u[1], u[0]), directions=9).lines
    assert sum(line.direction.removeprefix("random ").isdigit() for line in lines) == 2


def test_a_minimum_and_a_gradient_of_zero():
    result = AUDIT(lambda u: anp.sum((u - X) ** 2), X)
    assert result and "0 to rounding" in result.reason
    assert AUDIT(lambda u: 5.0 + anp.sum((anp.sin(u) - np.sin(X)) ** 2), X)
    assert AUDIT(lambda u: anp.sum(u**2), 0 * X)
    assert AUDIT(lambda u: anp.sum(u**2), X, gradient=lambda u: 0 * u).verdict == "disagrees"
    near = AUDIT(lambda u: np.sum((u - X) ** 2), X + 1e-8, gradient=lambda u: 4 * (u - X))
    assert near.verdict == "disagrees"


# ---- planted mistakes in rules -------------------------------------------------------------------------------------


def advance(mistake):
    """u + dt A u with a rule of our own; `mistake` spoils its VJP."""
    op = dp.upwind(GRID, "x", boundary=dp.dirichlet)
    dt = 0.05
    vjps = {
        "none": lambda g: g + dt * op.T(g),
        "A for the transpose": lambda g: g + dt * op(g),
        "one sign": lambda g: g - dt * op.T(g),
        "missing dt": lambda g: g + op.T(g),
        "0.1 %": lambda g: 1.001 * (g + dt * op.T(g)),
        "0.01 %": lambda g: 1.0001 * (g + dt * op.T(g)),
    }
    return dp.differentiable(
        "advance",
        lambda u: u + dt * op(u),
        lambda nums, ans, u: lambda g: (vjps[mistake](g),),
        lambda nums, tangents, ans, u: tangents[0] + dt * op(tangents[0]),
    ), list(vjps)


@pytest.mark.parametrize("mistake", advance("none")[1])
def test_planted_mistakes(mistake, rng):
    step = advance(mistake)[0]
    x = rng.standard_normal(GRID.shape)
    result = AUDIT(lambda u: anp.sum(anp.tanh(step(anp.sin(step(u)))) ** 2), x)
    assert result.verdict == ("agrees" if mistake == "none" else "disagrees"), result


def test_a_captured_value_and_a_wrong_jvp():
    x = np.array([1.5, 2.0])
    captured = dp.differentiable("f", lambda u: u**3, lambda nums, ans, u: lambda g: (3 * x[::-1] ** 2 * g,))
    assert AUDIT(lambda u: anp.sum(captured(u)), x).verdict == "disagrees"
    forward = dp.differentiable(
        "f", lambda u: u**3, lambda nums, ans, u: lambda g: (3 * u**2 * g,), lambda nums, t, ans, u: 3.1 * u**2 * t[0]
    )
    result = AUDIT(lambda u: anp.sum(forward(u)), x)
    assert result.verdict == "disagrees" and "forward and reverse mode differ" in result.reason


def test_random_scenes(rng):
    """Composed scenes: the right rule agrees, one that is off by 0.1 % does not."""

    def scene(error):
        sine = dp.differentiable("sine", anp.sin, lambda nums, ans, u: lambda g: ((1 + error) * g * anp.cos(u),))
        return lambda u: anp.sum(weights * mix(sine(mix(anp.exp(0.3 * u)))) ** 2)

    for _ in range(4):
        grid = dp.Grid(tuple(rng.integers(3, 9, 2)), spacing=rng.uniform(0.5, 2.0))
        mix = dp.identity(grid.cells) + 0.1 * dp.laplacian(grid, dp.dirichlet)
        weights = rng.standard_normal(grid.shape)
        x = rng.standard_normal(grid.shape)
        assert AUDIT(scene(0.0), x)
        assert AUDIT(scene(1e-3), x).verdict == "disagrees"


# ---- what proves nothing -------------------------------------------------------------------------------------------

INCONCLUSIVE = {
    "kink": (lambda u: np.sum(np.abs(u - X[3])), lambda u: np.sign(u - X[3]), "a kink"),
    "kink everywhere": (lambda u: np.sum(np.abs(u - X)), lambda u: 0 * u, "a kink"),
    "kink at 1e-9": (lambda u: np.sum(np.maximum(u - X[3] - 1e-9, 0)), lambda u: 1.0 * (u > X[3] + 1e-9), "a kink"),
    "root": (
        lambda u: np.sum(np.abs(u - X) ** 1.5) + np.sum((u - X) ** 2) + np.sum(u),
        lambda u: 1 + 0 * u,
        "not twice differentiable",
    ),
    "noise": (
        lambda u: np.sum(u**2) + 0.1 * hash_noise(u),
        lambda u: 2 * u,
        "of the derivative: not enough to tell",
    ),
    "staircase": (
        lambda u: float(np.sum(np.floor(u))),
        lambda u: 0 * u,
        "of the derivative: not enough to tell",
    ),
    "constant": (lambda u: 3.0, lambda u: 0 * u, "the loss is constant to rounding"),
    "infinite": (lambda u: np.inf, lambda u: 0 * u, "the loss is inf at x"),
    "tiny": (lambda u: 1e-320 * np.sum(u**2), lambda u: 2e-320 * u, "it underflows"),
}


@pytest.mark.parametrize("name", INCONCLUSIVE)
def test_inconclusive(name):
    loss, grad, reason = INCONCLUSIVE[name]
    result = AUDIT(loss, X, gradient=grad)
    assert result.verdict == "inconclusive" and not result, result
    assert reason in result.reason


def test_chaos_is_inconclusive(rng):
    def loss(u):
        for _ in range(60):
            u = 3.9 * u * (1 - u)
        return anp.sum(u)

    assert AUDIT(loss, rng.uniform(0.2, 0.8, 10)).verdict == "inconclusive"


def test_small_noise_costs_digits_only():
    result = AUDIT(lambda u: np.sum(u**2) + 1e-9 * hash_noise(u), X, gradient=lambda u: 2 * u)
    assert result and 3 <= result.digits <= 8
    rounded = AUDIT(lambda u: float(np.float32(np.sum(u**2))), X, gradient=lambda u: 2 * u)
    assert rounded.verdict == "inconclusive" and "digits, 6 are needed" in rounded.reason
    remaining = float(rounded.reason.split(" leaves ")[1].split(" digits")[0])
    assert 3 < remaining < 6
    assert AUDIT(lambda u: np.float32(np.sum(u**2)), X, gradient=lambda u: 2 * u)  # it says that it is single
    assert AUDIT(lambda u: np.sum(u**2) + 1e-9 * hash_noise(u), X, gradient=lambda u: 2.02 * u).verdict == "disagrees"


def test_orders_that_cannot_be_read_from_close_steps():
    """Where the usable steps are close together there is no order, and none is quoted."""
    steps = np.geomspace(1e-9, 1e-6, 12)
    audit = dp.check.gradient(lambda x: anp.sum(x**2), np.linspace(0.3, 1, 4), steps=steps)
    assert audit.verdict == "inconclusive"
    assert audit.reason.endswith("no two usable steps are a factor 4 apart: orders cannot be read")


def test_a_gradient_outside_a_kink_is_wrong():
    assert AUDIT(lambda u: np.sum(np.abs(u - X)), X, gradient=lambda u: 3 + 0 * u).verdict == "disagrees"


def test_kinks_far_enough_away_do_not_matter():
    result = AUDIT(lambda u: np.sum(np.abs(u - X - 1e-4) + u**2), X, gradient=lambda u: np.sign(u - X - 1e-4) + 2 * u)
    assert result and result.digits >= 5


def test_randomness_and_states_are_seen(rng):
    calls = []
    assert (
        "not deterministic" in AUDIT(lambda u: np.sum(u**2) + 1e-3 * rng.random(), X, gradient=lambda u: 2 * u).reason
    )
    noisy = AUDIT(lambda u: np.sum(u**2), X, gradient=lambda u: 2 * u + 1e-12 * rng.random(20))
    assert noisy.verdict == "inconclusive" and "gradient differ" in noisy.reason

    def counting(u):
        calls.append(1)
        return np.sum(u**2) + (len(calls) > 10)

    assert "it keeps a state" in AUDIT(counting, X, gradient=lambda u: 2 * u).reason


def test_nan_in_the_gradient():
    result = AUDIT(lambda u: anp.sqrt(anp.sum(u**2)), np.zeros(3))
    assert result.verdict == "disagrees" and "holds NaN" in result.reason
    assert "verdict: disagrees" in str(result)


def test_trial_points_that_refuse():
    def loss(reach):
        def inside(u):
            if np.max(np.abs(u - X)) > reach:
                raise dp.errors.UnstableStepError("too far")
            return np.sum(u**3)

        return inside

    assert AUDIT(loss(1e-3), X, gradient=lambda u: 3 * u**2)
    nowhere = AUDIT(loss(1e-15), X, gradient=lambda u: 3 * u**2)
    assert nowhere.verdict == "inconclusive" and "UnstableStepError: too far" in nowhere.reason
    with pytest.raises(dp.errors.UnstableStepError, match="too far"):
        AUDIT(loss(-1.0), X, gradient=lambda u: 3 * u**2)


# ---- detection limits ----------------------------------------------------------------------------------------------


SHARES = [1e-1, 1e-3, 1e-5, 1e-6, pytest.param(1e-7, marks=pytest.mark.whole)]


@pytest.mark.whole
def test_an_error_in_all_entries_is_found_at_the_documented_limit():
    test_small_errors_of_a_gradient_are_found("all", 1e-8)


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("wrong", ["all", "one entry", "one leaf"])
def test_small_errors_of_a_gradient_are_found(wrong, share):
    weight = np.ones(20) if wrong != "one entry" else 1.0 * (np.arange(20) == 7)

    def derivative(p):
        error = share * weight
        return {"u": 3 * p["u"] ** 2 * (1 + error), "v": 2 * p["v"] * (1 + (share if wrong == "all" else 0.0))}

    loss = lambda p: np.sum(p["u"] ** 3) + np.sum(p["v"] ** 2)
    x = {"u": X, "v": X[:3]}
    assert AUDIT(loss, x, gradient=derivative, directions=1).verdict == "disagrees"
    share = 0.0
    assert AUDIT(loss, x, gradient=derivative, directions=1).verdict == "agrees"
