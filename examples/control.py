"""The least force that ends a flow as wanted, in 100 scenes. Run: python examples/control.py [scenes] [--out FOLDER]"""

import sys
from pathlib import Path
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp

scenes, rng = int(sys.argv[1]) if sys.argv[1:2] and sys.argv[1] != "--out" else 100, np.random.default_rng(0)
sheet, dt, nu = dp.Grid((32, scenes), spacing=(1 / 32, 1e9), periodic=True), 0.03, 0.003  # scenes stand far apart
spread, right = dp.identity(sheet.cells) + nu * dt * dp.laplacian(sheet), np.eye(2)[0][:, None, None]
carry, x = dp.transport(sheet, "semi_lagrangian", velocity="cells"), sheet.centres()[0]
draw = lambda ends: rng.uniform(*ends, scenes)
bell = lambda height, place, width: draw(height) * np.exp(-0.5 * ((x - draw(place)) / draw(width)) ** 2)


def step(u, _, push):  # u_t + u u_x = nu u_xx + f: the field carries itself, diffusion, then the force
    return spread(carry(u, u * right, dt)) + push


start = bell((0, 3), (0.2, 0.4), (0.05, 0.15)) + bell((-3, 0), (0.6, 0.8), (0.05, 0.15))
truth = bell((-1.6, 1.6), (0.4, 0.6), (0.1, 0.4)) + np.zeros((32, 1, 1))  # the steady force
run = lambda f, keep="last": dp.rollout(step, start, None, 32, inputs=dt * f, keep=keep)
size = lambda f, eps=0.0: dt * np.sum(np.sqrt(f**2 + eps**2), (0, 1))  # total |f| of each scene; smooth with eps
wanted, clock, count, f, price = run(truth), perf_counter(), 0, 0 * truth, np.zeros(sheet.shape)


def tell(label, number, f):
    seconds, share = perf_counter() - clock, np.sum(size(f)) / np.sum(size(truth))
    told = f"{share:9.3f} {np.max(size(f) / size(truth)):9.3f} {np.max(abs(run(f) - wanted)):9.1e}"
    print(f"{label:20} {number:6} {seconds:8.1f} {1e3 * seconds / number:8.1f} {told}", flush=True)


print(f"{scenes:3} scenes           number  seconds  ms each |f|/truth     worst   largest error at the end")
for eps, weight in zip((0.1, 0.1, 0.1, 0.05, 0.03, 0.03, 0.03), (1e2, 1e2, 1e3, 1e3, 1e4, 1e5, 1e6)):
    penalty = lambda miss, price=price, weight=weight: np.sum(price * miss + 0.5 * weight * miss**2)
    best = dp.minimize(lambda f: np.sum(size(f, eps)) + penalty(run(f) - wanted), f, maxiter=min(100, 10 * scenes))
    f, count, price = best.x, count + best.evaluations, price + weight * (run(best.x) - wanted)
    tell("adjoint, gradients", count, f)
# Cross-entropy: 32 forces on 8 x 8 blocks; mean and deviation of the 8 best draw the next ones, scene by scene.
mean, deviation, clock, blocks = 0.0, 1.0, perf_counter(), lambda f: f.repeat(4, axis=0).repeat(4, axis=1)
for _ in range(3 * count // 32):  # a gradient counts as three runs
    drawn = mean + deviation * rng.standard_normal((32, 8, 8, scenes))
    cost = [size(f) + 100 * np.sum((run(f) - wanted) ** 2, 0) for f in map(blocks, drawn)]
    chosen = np.take_along_axis(drawn, np.argsort(cost, axis=0)[:8, None, None], axis=0)
    mean, deviation = np.mean(chosen, axis=0), np.std(chosen, axis=0) + 0.01
tell("cross-entropy, runs", 3 * count // 32 * 32, blocks(mean))
print("published |f|/truth: reinforcement learning 1.31 after 15.6 h, a learned controller 1.27 after 1.3 h")
if "--out" in sys.argv:
    from matplotlib import pyplot

    pyplot.figure(figsize=(11, 3))
    shown = {"u": run(truth, "all"), "u, least force": run(f, "all"), "force": truth, "least force": f}
    for place, (title, values) in enumerate(shown.items(), 1):  # x to the right, time upwards
        pyplot.subplot(1, 4, place, title=title).imshow(values[:, :, 0], "RdBu", vmin=-2, vmax=2, origin="lower")
    Path(sys.argv[-1]).mkdir(exist_ok=True)
    pyplot.savefig(Path(sys.argv[-1]) / "control.png", dpi=120, bbox_inches="tight")
