"""A body in the Earth's crust, found from waves. Run: python examples/full_waveform.py [cells deep] [--out FOLDER]

Pressure p and velocity v:  p' = -c^2 div v + source,  v' = -grad p.  The crust is that of the model ak135 (Kennett,
Engdahl, Buland, Geophys. J. Int. 122, 1995): 5.80 km/s down to 20 km, 6.50 down to 35 km. A body in it is 10 % slower.
"""

import sys
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

n = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 64  # cells over 32 km of depth
h, deep = 32.0 / n, n // 3  # width of a cell [km]; cells of the sponge
grid = dp.Grid((2 * n + 2 * deep, n + deep), size=((2 * n + 2 * deep) * h, (n + deep) * h), origin=(-deep * h, 0.0))
x, depth = grid.centres()

D, G = dp.divergence(grid), dp.gradient(grid, {"y": (dp.dirichlet, dp.neumann)})  # no pressure at the surface

crust = np.where(depth < 20.0, 5.80, 6.50)
body = -0.1 * np.exp(-((((x - 26.0) / 6.0) ** 2 + ((depth - 12.0) / 4.0) ** 2) ** 2))

# ---- shots and receivers: beside each other, a kilometre deep ---------------------------------------------------

shots = np.linspace(8.0, 56.0, 6)
receivers = dp.sample(grid, np.stack([np.linspace(2.0, 62.0, 2 * n), np.full(2 * n, 1.0)], 1))
where = np.stack([dp.sample(grid, [[place, 1.0]]).T(np.ones(1)) for place in shots]) / h**2  # one source each
dt, pitch = 0.5 * h / 6.5, 0.26 / h  # [s]; [1 / s]: eleven cells a wavelength
steps = int(14.0 / dt)
beat = (np.pi * pitch * (dt * np.arange(steps) - 1.2 / pitch)) ** 2
wavelet = (1 - 2 * beat) * np.exp(-beat)  # Ricker's

sponge = dp.sponge(grid, {"x": (deep, deep), "y": (0, deep)}, 6.5)
rates = (
    lambda v, given: -(given[0] ** 2) * D(v) + given[1] * where,
    lambda p, given: -G(p),
)
step = dp.stepper("leapfrog", rates, dt, damping=sponge)
quiet = np.zeros((len(shots), *grid.shape)), np.zeros((len(shots), grid.faces.size))


def heard(c):
    """What the receivers hear after each step, for all shots at once."""
    traces = dp.rollout(step, quiet, c, steps, inputs=wavelet, keep=lambda index, state: receivers(state[0]))
    return np.stack(traces)


# ---- the search ------------------------------------------------------------------------------------------------------

smooth = dp.inverse(dp.identity(grid.cells) - 2.0**2 * dp.laplacian(grid))  # over 2 km
signal = heard(crust * (1 + body))
scale = np.sum((heard(crust) - signal) ** 2)


def loss(m):
    return np.sum((heard(crust * (1 + smooth(m))) - signal) ** 2) / scale


start = np.zeros(grid.shape)
print(f"{len(shots)} shots, {steps} steps, {grid.shape[0]} x {grid.shape[1]} cells")
print("gradient against finite differences:", dp.check.gradient(loss, start, directions=1).verdict)
best = dp.minimize(loss, start, maxiter=12)
answer = smooth(best.x)
near = (abs(x - 26.0) < 12) & (depth < 20)
place = np.argmin(answer)
error = np.linalg.norm((answer - body)[near]) / np.linalg.norm(body[near])
print(
    f"misfit 1 -> {best.value:.4f} in {len(best.history)} evaluations; error of the speed around the body: {error:.2f}"
)
print(f"slowest place: {answer.flat[place]:.3f} at x = {x.flat[place]:.1f} km, depth {depth.flat[place]:.1f} km")

if "--out" in sys.argv:
    from matplotlib.figure import Figure

    picture = Figure(figsize=(6, 9), layout="constrained")
    panels = {
        "the crust": (crust * (1 + body), "viridis", 5.2, 6.6, "speed [km/s]"),
        f"what the waves told, error {error:.0%}": (crust * (1 + answer), "viridis", 5.2, 6.6, "speed [km/s]"),
        "relative to ak135": (100 * answer, "RdBu", -10, 10, "change of speed [%]"),
    }
    for axes, (name, (field, colors, low, high, unit)) in zip(picture.subplots(3, 1), panels.items()):
        drawn = axes.pcolormesh(x, depth, field, cmap=colors, vmin=low, vmax=high, shading="nearest")
        axes.contour(x, depth, body, [-0.05], colors="black", linestyles="dashed")  # where the body is
        axes.plot(shots, np.ones(shots.size), "r*", clip_on=False)
        axes.set(title=name, xlabel="x [km]", ylabel="depth [km]", xlim=(0, 64), ylim=(32, 0), aspect="equal")
        picture.colorbar(drawn, ax=axes, label=unit)
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    picture.savefig(Path(sys.argv[-1]) / "full_waveform.png", dpi=120)
