"""Where the heat was, from a blurred picture. Run: python examples/inverse_heat.py [samples] [--out FOLDER]"""

import sys
from pathlib import Path
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp

count, rng = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 128, np.random.default_rng(0)
grid, places, dot = dp.Grid((64, 64), periodic=True), np.arange(64), np.eye(64)[:1].T * np.eye(64)[0]
heat = dp.exponential(dp.laplacian(grid), 8.0)
fade, bend = (np.fft.fft2(op(dot)).real for op in (heat, -dp.laplacian(grid)))  # both are diagonal in waves
waves = lambda factor, u: np.fft.ifft2(factor * np.fft.fft2(u)).real
descent = lambda y: waves((1 - (1 - fade**2) ** 1000) / fade, y)  # 1000 steps of rate 1: a geometric series


def rectangles():
    x = np.zeros(grid.shape)
    for _ in range(rng.integers(4, 11)):
        x += rng.random() * np.outer(*(abs(places - rng.uniform(6.4, 57.6)) <= rng.uniform(0, 10) for _ in "xy"))
    return x


def physical(y):
    """One physical gradient; the inverse simulator leaves out the waves that single precision has drowned."""
    rule = dp.physical_gradient(heat, lambda end, x: x + waves((fade > 1e-6) / fade, end - heat(x)))
    return -dp.value_and_grad(lambda x: 0.5 * np.sum((rule(x) - y) ** 2))(0 * y)[1]


def piecewise(y, weight=1e-8):
    """x >= 0 that makes |heat(x) - y|^2 / 2 + weight |jumps of x| small; both terms are diagonal in waves."""
    blurred = waves(fade, y)

    def inner(target, rho, x):  # the x that fits y, and jumps and values of which are near the target
        a, b, c = rho * target
        return waves(1 / (fade**2 + rho * (1 + bend)), blurred + np.roll(a, 1, 0) - a + np.roll(b, 1, 1) - b + c)

    best = dp.minimize(
        lambda x: 0.5 * np.sum((heat(x) - y) ** 2), np.zeros(grid.shape), "admm", 300, 1e-4,
        weight=weight, rho=1e-7, inner=inner,
        operator=lambda x: np.stack([np.roll(x, -1, 0) - x, np.roll(x, -1, 1) - x, x]),
        prox=lambda v, t: np.concatenate([np.sign(v[:2]) * np.maximum(abs(v[:2]) - t, 0), np.maximum(v[2:], 0)]),
    )  # fmt: skip
    return np.maximum(best.x, 0)


hidden = [rectangles() for _ in range(count)]
seen, published = [np.float32(heat(x)).astype(float) for x in hidden], ("170", "104", "50.4, by a network")
noise = np.std([y - heat(x) for x, y in zip(hidden, seen)])
print(f"{count} samples with heat {np.sum(hidden) / count:.0f}, noise of the data (single precision) {noise:.0e}")
names = {1000: "descent, summed", 1: "physical gradient", 300: "jumps and x >= 0"}
print("method             gradients  error  ms a sample  published, on other samples")
for n, method, told in zip((1000, 1, 300), (descent, physical, piecewise), published):
    clock = perf_counter()
    found = [method(y) for y in seen]
    spent, error = 1e3 * (perf_counter() - clock) / count, np.mean(np.sum(abs(np.subtract(found, hidden)), axis=(1, 2)))
    print(f"{names[n]:18} {n:9} {error:6.1f} {spent:12.1f}  {told}")

if "--out" in sys.argv:
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    axes = dp.plot(dp.Grid((192, 64)), np.concatenate([hidden[0], seen[0], found[0]]), title="hidden, seen, found")
    axes.figure.savefig(Path(sys.argv[-1]) / "inverse_heat.png", dpi=120, bbox_inches="tight")
