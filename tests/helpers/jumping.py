"""Random initial value problems whose rates jump, or are smooth and steep, with derivatives by closed forms.

Run: python tests/helpers/jumping.py [problems of each kind] prints how many derivatives are refused, right, and wrong
by more than 1 %.
"""

import sys
from typing import Any, NamedTuple

import autograd.numpy as anp
import numpy as np

import sparsedp as dp
from sparsedp.autodiff.derivative import pushforward
from sparsedp.errors import ConvergenceError, DerivativeError

TOLERANCES = {"heun": (2, 5), "ssprk3": (2, 6), "rk4": (2, 7), "tr_bdf2": (2, 4), "radau": (2, 7)}  # 10^-a to 10^-b
GAUSS = np.polynomial.legendre.leggauss(400)


class Scene(NamedTuple):
    """u' = rate(u, p, t) from u(0) to `end`, and the derivative of u(end)[0] in p[0], or in u(0)[0]."""

    kind: str
    rate: Any
    start: np.ndarray
    p: np.ndarray
    end: float
    of_start: bool
    slope: float
    max_step: float | None = None  # where something brief could fall between two evaluations of the rate


def layer(c, s, w, end):
    """Of u' = tanh((t - s) / w) - c u: the derivative of u(end) in s."""
    x = 18 * GAUSS[0]
    inside = (s + w * x > 0) & (s + w * x < end)
    if w > 0.02:  # the layer reaches the ends: integrate over time
        t = 0.5 * end * (1 + GAUSS[0])
        return -0.5 * end * np.sum(GAUSS[1] * np.cosh((t - s) / w) ** -2 / w * np.exp(-c * (end - t)))
    return -18 * np.sum(GAUSS[1] * np.cosh(x) ** -2 * np.exp(-c * (end - s - w * x)) * inside)


def jumping(rng):
    """A problem of which the rate jumps in time or with the state."""
    s = rng.uniform(0.2, 1.7)
    c = rng.uniform(0.1, 2.0)
    end = rng.uniform(1.8, 2.5)
    a, b = rng.uniform(-3, 3, 2)
    p, q, r = rng.uniform(0.5, 2.0, 3)
    decay = np.exp(-c * (end - s))
    kind = rng.integers(8)
    one = np.ones(1)
    zero = np.zeros(1)
    if kind == 0:
        return Scene(
            "time", lambda u, x, t: anp.where(t < x, a, b) - c * u, one, np.array([s]), end, False, (a - b) * decay
        )
    if kind == 1:
        w = rng.uniform(0.5, 5.0)
        rate = lambda u, x, t: anp.where(t > x, a * anp.sin(w * t), 0.0) - c * u
        return Scene("wave", rate, one, np.array([s]), end, False, -a * np.sin(w * s) * decay)
    if kind == 2:
        w = 10 ** rng.uniform(-2.5, -0.5)
        rate = lambda u, x, t: anp.where((t > x) & (t < x + w), a / w, 0.0) - c * u
        return Scene(
            "pulse",
            rate,
            one,
            np.array([s]),
            end,
            False,
            a / w * np.exp(-c * (end - s)) * (np.exp(c * w) - 1),
            max_step=w if w < 0.01 * end else None,
        )
    if kind == 3:
        rate = lambda u, x, t: anp.where(t > s, a, 0.0) - c * u
        return Scene("fixed", rate, one, zero, end, True, np.exp(-c * end))
    if kind == 4:
        th = rng.uniform(0.2, 0.8) * p * end
        rate = lambda u, x, t: anp.where(u < th, 1.0, r + 0.3) * x
        return Scene("state", rate, zero, np.array([p]), end, False, (r + 0.3) * end)
    if kind == 5:
        th = rng.uniform(0.2, 0.8) * p * end
        rate = lambda u, x, t: anp.array([anp.where(u[1] < th, -1.0, q) * u[0], x[0]])
        slope = np.exp(-th / p + q * (end - th / p)) * (1 + q) * th / p**2
        return Scene("two fields", rate, np.array([1.0, 0.0]), np.array([p]), end, False, slope)
    if kind == 6:
        rate = lambda u, x, t: anp.sign(t - x) * a - c * u + anp.cos(3 * t)
        return Scene("sign", rate, one, np.array([s]), end, False, -2 * a * decay)
    small = 10 ** rng.uniform(-2, -0.5)
    rate = lambda u, x, t: anp.where(t < x, small, 0.0) + anp.sin(2 * t) - c * u
    return Scene("small", rate, one, np.array([s]), end, False, small * decay)


def smooth(rng):
    """A problem of which the rate is smooth: steep in time or in the state, or not at all."""
    s = rng.uniform(0.2, 1.7)
    c = rng.uniform(0.1, 2.0)
    end = rng.uniform(1.8, 2.5)
    p = rng.uniform(0.5, 2.0)
    w = 10 ** rng.uniform(-4, 0)
    kind = rng.integers(4)
    if kind <= 1:
        rate = lambda u, x, t: anp.tanh((t - x) / w) - c * u
        return Scene(
            "layer" if w < 0.02 else "gentle", rate, np.ones(1), np.array([s]), end, False, layer(c, s, w, end)
        )
    if kind == 2:
        w = 10 * rng.uniform(0.05, 1.0)
        f = rng.uniform(1.0, 8.0)
        rate = lambda u, x, t: x[0] * anp.cos(f * t) - c * u
        wave = (c * np.cos(f * end) + f * np.sin(f * end) - c * np.exp(-c * end)) / (c**2 + f**2)
        return Scene("forced", rate, np.ones(1), np.array([p]), end, False, wave)
    rate = lambda u, x, t: x[0] * u * (1 - u)
    u0 = 0.1
    value = 1 / (1 + (1 / u0 - 1) * np.exp(-p * end))
    return Scene("logistic", rate, np.array([u0]), np.array([p]), end, False, end * value * (1 - value))


def outcome(scene, method, tolerance):
    """ "refused", "right" or "wrong" (by more than 1 %)."""
    step = dp.stepper(method, scene.rate, scene.end, timed=True, tolerance=tolerance, max_step=scene.max_step)

    def loss(x):
        start, p = (x, scene.p) if scene.of_start else (scene.start, x)
        return step((start, 0.0), p)[0][0]

    x = scene.start if scene.of_start else scene.p
    try:
        slope = pushforward(loss, x, np.eye(len(x))[0])[1]
    except (DerivativeError, ConvergenceError):
        return "refused"
    if abs(slope - scene.slope) <= 0.01 * abs(scene.slope):
        return "right"
    return "wrong"


def counted(make, count, seed, methods=TOLERANCES, coarsest=2):
    """{(kind, outcome): how often}, and the problems with a wrong derivative: (number, method, tolerance, scene)."""
    found = {}
    wrong = []
    for number in range(count):
        rng = np.random.default_rng((seed, number))
        scene = make(rng)
        for method in methods:
            tolerance = 10.0 ** -rng.uniform(coarsest, TOLERANCES[method][1])
            word = outcome(scene, method, tolerance)
            found[scene.kind, word] = found.get((scene.kind, word), 0) + 1
            if word == "wrong":
                wrong.append((number, method, tolerance, scene))
    return found, wrong


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    for make, coarsest in ((jumping, 2), (smooth, 3)):
        found, wrong = counted(make, count, 0, coarsest=coarsest)
        print(
            make.__name__,
            {word: sum(n for (_, w), n in found.items() if w == word) for word in ("refused", "right", "wrong")},
        )
        for (kind, word), number in sorted(found.items()):
            print(f"    {kind:12} {word:8} {number}")
        for number, method, tolerance, scene in wrong[:20]:
            print(f"    wrong: {scene.kind} {number} {method} {tolerance:.1e}")
