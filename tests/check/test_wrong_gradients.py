"""Wrong and awkward gradients in a table with the verdicts of the audit, and right ones of random scenes."""

import math
import zlib
from collections import Counter

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

AUDIT = dp.check.gradient
X = np.linspace(1.0, 2.0, 20)
GRID = dp.Grid((6, 5))
WIND = dp.upwind(GRID, "x", boundary=dp.dirichlet)
U = np.sin(np.arange(30.0)).reshape(6, 5)
DT = 0.05


KERNEL = np.pad(X[1:], (1, 0)) - np.pad(X[1:], (0, 1))  # gradient of sum(X[1:] diff(u))


def bits(u):
    return zlib.crc32(u.tobytes()) / 2**31 - 1


def stepped(u):
    """Sum of cubes after one explicit step."""
    return np.sum((u + DT * WIND.apply(u)) ** 3)


def pulled(back, factor=1.0):
    """Its gradient, by a pullback of the step that may be wrong."""
    return lambda u: factor * back(3 * (u + DT * WIND.apply(u)) ** 2)


def right(g):
    return g + DT * WIND.T.apply(g)


def power(p, weight=1.0):
    return lambda u: np.sum(weight * np.abs(u - X) ** p) + np.sum(u), lambda u: 1 + 0 * u


def half(p, weight):
    return lambda u: np.sum(weight * np.maximum(u - X, 0) ** p + u)


def noisy(size, factor=1.0):
    return lambda u: np.sum(u**2) * (1 + size * bits(u)), lambda u: 2 * factor * u


GRADIENTS = {
    "right": (stepped, pulled(right), "agrees"),
    "A for the transpose": (stepped, pulled(lambda g: g + DT * WIND.apply(g)), "disagrees"),
    "one sign": (stepped, pulled(lambda g: g - DT * WIND.T.apply(g)), "disagrees"),
    "missing dt": (stepped, pulled(lambda g: g + WIND.T.apply(g)), "disagrees"),
    "0.1 %": (stepped, pulled(right, 1 + 1e-3), "disagrees"),
    "0.01 %": (stepped, pulled(right, 1 + 1e-4), "disagrees"),
    "1e-6": (stepped, pulled(right, 1 + 1e-6), "disagrees"),
    "1e-7": (stepped, pulled(right, 1 + 1e-7), "disagrees"),
    "0": (stepped, lambda u: 0 * u, "disagrees"),
    "kink at the point": (lambda u: np.sum(np.maximum(u - X, 0) + u), lambda u: 1.5 + 0 * u, "inconclusive"),
    "|x|^1.2": (*power(1.2), "inconclusive"),
    "|x|^1.8": (*power(1.8), "inconclusive"),
    "|x|^1.8, little of it": (*power(1.8, 1e-3), "inconclusive"),
    "|x|^1.9": (*power(1.9), "inconclusive"),
    "|x|^1.8 at its minimum": (lambda u: np.sum(np.abs(u - X) ** 1.8), lambda u: 0 * u, "inconclusive"),
    "max(x, 0)^1.2, little of it": (half(1.2, 1e-2), lambda u: 1 + 0 * u, "inconclusive"),
    "max(x, 0)^1.8, little of it": (half(1.8, 1e-4), lambda u: 1 + 0 * u, "inconclusive"),
    "|x|^2.2": (*power(2.2), "agrees"),
    "noise 1e-10": (*noisy(1e-10), "agrees"),
    "noise 1e-10, 0.1 %": (*noisy(1e-10, 1.001), "disagrees"),
    "noise 1e-4": (*noisy(1e-4), "inconclusive"),
    "linear": (lambda u: np.sum(X * u), lambda u: X, "agrees"),
    "linear, 1e-6": (lambda u: np.sum(X * u), lambda u: (1 + 1e-6) * X, "disagrees"),
    "linear beside 1e5": (lambda u: 1e5 + np.sum(X * u), lambda u: X, "agrees"),
    "nearly linear": (lambda u: np.sum(u + 1e-11 * u**2), lambda u: 1 + 2e-11 * u, "agrees"),
    "quadratic": (lambda u: np.sum(u**2), lambda u: 2 * u, "agrees"),
    "quadratic, 1e-6": (lambda u: np.sum(u**2), lambda u: (2 + 2e-6) * u, "disagrees"),
    "kernel": (lambda u: np.sum(np.diff(u) * X[1:]), lambda u: KERNEL, "agrees"),
    "kernel, 0.1 %": (lambda u: np.sum(np.diff(u) * X[1:]), lambda u: 1.001 * KERNEL, "disagrees"),
    "minimum": (lambda u: 5 + np.sum((u - X) ** 2), lambda u: 2 * (u - X), "agrees"),
    "flat minimum": (lambda u: np.sum((u - X) ** 4), lambda u: 4 * (u - X) ** 3, "agrees"),
    "near a minimum": (lambda u: 5 + np.sum((u - X - 1e-7) ** 2), lambda u: 2 * (u - X - 1e-7), "agrees"),
}


@pytest.mark.parametrize("name", GRADIENTS)
def test_verdict_on_wrong_and_awkward_gradients(name):
    loss, grad, verdict = GRADIENTS[name]
    result = AUDIT(loss, U if loss is stepped else X, gradient=grad)
    assert result.verdict == verdict, result
    assert verdict == "agrees" or result.reason


def test_a_cubic_that_is_off_by_nine_parts_in_ten_million():
    assert AUDIT(lambda u: np.sum(u**3), X, gradient=lambda u: 3 * u**2 * (1 + 9e-7)).verdict == "disagrees"
    assert AUDIT(lambda u: np.sum(u**3), X, gradient=lambda u: 3 * u**2 * (1 + 1e-9))


def test_taylor_orders_are_gates():
    """Agreement means: order 1 is 1, order 2 is 1.95 or more; or there is none, in the two cases of the notes."""
    for name, (loss, grad, verdict) in GRADIENTS.items():
        lines = AUDIT(loss, U if loss is stepped else X, gradient=grad).lines if verdict == "agrees" else ()
        for line in lines:
            assert line.rate2 >= 1.95, name
            assert line.word == "vanishes" or math.isnan(line.rate1) or abs(line.rate1 - 1) <= 0.05, name
            assert not math.isnan(line.rate1) or line.word == "vanishes" or line.note.startswith("flat"), name
    linear = AUDIT(*GRADIENTS["linear"][:1], X, gradient=GRADIENTS["linear"][1])
    assert all(math.isinf(line.rate2) and abs(line.rate1 - 1) <= 0.05 for line in linear.lines)


def test_too_few_usable_steps_are_inconclusive():
    """Eight steps of which one shows the second remainder: no order, no agreement."""
    steps = [2.0**-k for k in (2, 20, 22, 24, 26, 28, 30, 32)]
    found = AUDIT(lambda u: np.sum(u + 1e-5 * u**2), X, gradient=lambda u: 1 + 2e-5 * u, steps=steps)
    assert found.verdict == "inconclusive" and "stands out of the noise on 1 steps, 3 are needed" in found.reason


def test_forward_and_reverse_mode_may_differ_by_rounding_only():
    def cube(error):
        return dp.differentiable(
            "cube",
            lambda u: u**3,
            lambda nums, ans, u: lambda g: (3 * u**2 * g,),
            lambda nums, tangents, ans, u: (3 + error) * u**2 * tangents[0],
        )

    assert AUDIT(lambda u: anp.sum(cube(1e-13)(u)), X)
    result = AUDIT(lambda u: anp.sum(cube(1e-8)(u)), X)
    assert result.verdict == "disagrees" and "forward and reverse mode differ" in result.reason
    solve = dp.inverse(-dp.laplacian(GRID, dp.dirichlet), "krylov", rtol=1e-8)
    assert "forward and reverse" not in AUDIT(lambda b: anp.sum(solve(anp.exp(b)) ** 3), U).reason
    assert AUDIT(lambda b: anp.sum(solve(anp.exp(cube(1e-2)(b))) ** 3), U).verdict == "disagrees"


ACTS = (anp.sin, anp.tanh, anp.cos, anp.square, lambda u: anp.exp(0.3 * u), lambda u: u**3 - u, lambda u: u)


def scene(seed):
    """A random composed smooth loss: two fifths of them end with a solve."""
    rng = np.random.default_rng(seed)
    dim = int(rng.integers(1, 4))
    grid = dp.Grid(tuple(map(int, rng.integers(3, (20, 9, 5)[dim - 1], dim))), spacing=float(rng.uniform(0.5, 2)))
    spread = dp.laplacian(grid, dp.dirichlet)
    mix = dp.identity(grid.cells) + 0.1 * spread
    acts = [ACTS[place] for place in rng.integers(0, len(ACTS), rng.integers(1, 5))]
    if seed % 5 > 2:
        matrix = -spread if seed % 5 == 4 else dp.identity(grid.cells) - 0.3 * spread
        acts.append(dp.inverse(matrix, ("krylov", "multigrid", "direct")[rng.integers(3)]))
    weights = rng.standard_normal(grid.shape)
    offset = 10.0 ** rng.uniform(-3, 3) * rng.integers(2)
    order = int(rng.integers(1, 3))

    def loss(u):
        for act in acts:
            u = act(mix(u))
        return offset + anp.sum(weights * u**order)

    return loss, rng.standard_normal(grid.shape) * 10.0 ** rng.uniform(-1, 0.5)


@pytest.mark.slow
def test_random_smooth_scenes_agree():
    found = Counter(AUDIT(*scene(seed), directions=2).verdict for seed in range(100))
    assert found["agrees"] >= 95 and found["disagrees"] == 0, found


@pytest.mark.parametrize(
    "error, seeds",
    [(1e-3, range(3)), (1e-4, range(3, 6)), (1e-5, range(6, 10))]
    + [pytest.param(error, range(10), marks=pytest.mark.whole) for error in (1e-3, 1e-4, 1e-5)],
)
def test_random_scenes_with_a_wrong_gradient_do_not_agree(error, seeds):
    for seed in seeds:
        loss, x = scene(seed)
        grad = dp.value_and_grad(loss)(x)[1]
        assert AUDIT(loss, x, gradient=(1 + error) * grad, directions=1).verdict != "agrees", seed
