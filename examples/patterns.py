"""Four patterns, one stepper each, the stiff part in linear. Run: python examples/patterns.py [cells] [--out FOLDER]"""

import sys
from pathlib import Path
from time import perf_counter

import autograd.numpy as np
from scipy.ndimage import maximum_filter

import sparsedp as dp

n = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 64
dish, box = dp.Grid((n, n), spacing=2.5 / 256, periodic=True), dp.Grid((n, n), spacing=0.5)
wide = dp.Grid((n, n), spacing=np.pi / 5, periodic=True)
D, C, L = map(dp.laplacian, (dish, box, wide))
G, slope, mean = dp.gradient(wide), dp.gradient(box), dp.average(wide).T
noise = np.random.default_rng(0).uniform(-1, 1, (n, n))
drop = np.pad(np.ones((20, 20)), ((n - 20) // 2, n - 20 - (n - 20) // 2)) * (1 + 0.05 * noise)
soup = {"u": 1 - 0.5 * drop, "v": 0.25 * drop}


def gray_scott(x, p):  # Pearson, Science 261 (1993): class lambda at feed 0.034 and kill 0.065
    eaten = x["u"] * x["v"] ** 2
    return {"u": p["feed"] * (1 - x["u"]) - eaten, "v": eaten - (p["feed"] + p["kill"]) * x["v"]}


def spots(x):
    return int(np.sum((x["v"] == maximum_filter(x["v"], 5, mode="wrap")) & (x["v"] > 0.15)))


def report(name, step, state, params, steps, keep="last"):
    """Run, and judge the gradient of the sum of squares after 5 steps in every param -> the last state, or all."""
    clock = perf_counter()
    found = dp.rollout(step, state, params, steps, keep=keep)
    seconds, field = perf_counter() - clock, lambda x: x["v"] if isinstance(x, dict) else x
    verdict = dp.check.gradient(lambda p: np.sum(field(dp.rollout(step, state, p, 5)) ** 2), params).verdict
    print(f"{name:20} {steps:5} steps {seconds:6.1f} s   gradient {verdict}", end="   ")
    return found


feeding = {"feed": 0.034, "kill": 0.065}
pearson = dp.stepper("imex", gray_scott, 4.0, linear={"u": (D, 2e-5), "v": (D, 1e-5)})
end = report("Gray-Scott", pearson, soup, feeding, 1500)
gone = dp.rollout(pearson, soup, feeding | {"kill": 0.075}, 250)
print(f"{spots(end)} spots (1 drop at the start; with more kill {spots(gone)}, known 0)")

step = dp.stepper("imex", lambda u, m: m * C(u**3 - 3 * u), 0.1, linear=(2 * C - C @ C, lambda m: m))
films = report("Cahn-Hilliard", step, 0.1 * noise, 1.0, 400, "all")
energy = [np.sum((u**2 - 1) ** 2) / 4 + np.sum(slope(u) ** 2) / 2 for u in films]
drift = np.max(np.abs(np.sum(films - films[0], axis=(1, 2)))) / n**2
print(f"drift of the mean {drift:.0e} (0), largest rise of energy {max(np.diff(energy)):.0e} (below 0)")

step = dp.stepper("etdrk4", lambda u, r: r * u - u**3, 0.5, linear=dp.function(L, lambda e: -((1 + e) ** 2)))
rolls = report("Swift-Hohenberg", step, 0.1 * noise, 0.1, 1000)
waves = 2 * np.pi * np.hypot(*np.meshgrid(*[np.fft.fftfreq(n, np.pi / 5)] * 2))
power = np.abs(np.fft.fft2(rolls)) ** 2
length, size = 2 * np.pi * np.sum(power) / np.sum(waves * power), np.sqrt(np.mean(rolls**2))
print(f"wavelength {length:.2f} ({2 * np.pi:.2f}), size {size:.3f} (one wave: {np.sqrt(0.2 / 3):.3f})")

step = dp.stepper("etdrk4", lambda u, c: -0.5 * c * mean(G(u) ** 2), 0.1, linear=-1.0 * L - L @ L)
flame = report("Kuramoto-Sivashinsky", step, 0.1 * noise, 1.0, 1000)
k, x = 10 * round(n / 14) / n, wide.centres()[0] - wide.centres()[0][0, 0]
rate = np.log(1e6 * np.max(dp.rollout(step, 1e-6 * np.cos(k * x), 1.0, 50))) / 5
print(f"growth of a small wave {rate:.4f} ({k**2 - k**4:.4f})")
seen = dp.rollout(pearson, soup, feeding, 25)["v"]
loss = lambda feed: np.mean((dp.rollout(pearson, soup, feeding | {"feed": feed}, 25)["v"] - seen) ** 2)
best = dp.minimize(loss, np.array(0.04), maxiter=30)
print(f"feed found from what is seen after 25 steps: {best.x:.6f} (0.034), {len(best.history)} evaluations")
if "--out" in sys.argv:
    from matplotlib.figure import Figure

    picture = Figure(figsize=(13, 3.2), layout="constrained")
    fields = {f"Gray-Scott, v\n{spots(end)} spots": end["v"], f"Cahn-Hilliard\nmean off by {drift:.0e}": films[-1]}
    fields[f"Swift-Hohenberg\nwavelength {length:.2f}, known {2 * np.pi:.2f}"] = rolls
    fields[f"Kuramoto-Sivashinsky\ngrowth {rate:.3f}, known {k**2 - k**4:.3f}"] = flame - np.mean(flame)
    for ax, (name, u) in zip(picture.subplots(1, 4), fields.items()):
        picture.colorbar(ax.imshow(u.T, origin="lower"), ax=ax, shrink=0.8)
        ax.set(title=name, xticks=[], yticks=[])
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    picture.savefig(Path(sys.argv[-1]) / "patterns.png", dpi=120)
