"""How good must a first guess be? What a guess saves, beside multigrid. Run: python examples/warm_start.py [cells]"""

import sys

import autograd.numpy as np

import sparsedp as dp

n = int(sys.argv[1]) if len(sys.argv) > 1 else 64
grid = dp.Grid((n, n))
box = -dp.laplacian(grid)  # closed box: pressure is known up to a constant
rng = np.random.default_rng(0)


def smoke_divergence():
    """Divergence of a buoyant flow: what the pressure solve of a smoke simulation sees."""
    x, y = grid.centres()
    smoke = sum(
        np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * r**2))
        for cx, cy, r in zip(rng.uniform(0.2, 0.8, 4) * n, rng.uniform(0.1, 0.5, 4) * n, rng.uniform(2, 6, 4))
    )
    lift = grid.join(0.0, dp.component(grid, 1)(dp.average(grid)(smoke)))
    return dp.divergence(grid)(dp.interior(grid)(lift))


cases = [smoke_divergence() for _ in range(5)]
print("Iterations to a relative residual, mean of 5 smoke states:\n")
print("method                              1e-3   1e-6")
for label, method, quality in (
    ("plain CG from zero", "krylov", None),
    ("plain CG, guess with 10 % error", "krylov", 0.1),
    ("plain CG, guess with 1 % error", "krylov", 0.01),
    ("multigrid from zero", "multigrid", None),
    ("multigrid, guess with 1 % error", "multigrid", 0.01),
):
    counts = []
    for rtol in (1e-3, 1e-6):
        inv = dp.inverse(box, method, rtol=rtol, nullspace="project")
        exact = dp.inverse(box, "separable", nullspace="project")
        used = []
        for b in cases:
            answer = exact(b)
            noise = rng.standard_normal(grid.shape)  # smooth error, as a trained network leaves it
            noise = exact(noise - noise.mean())
            guess = (
                None if quality is None else answer + quality * noise * np.linalg.norm(answer) / np.linalg.norm(noise)
            )
            inv(b, start=guess)
            used.append(inv.info.forward.iterations)
        counts.append(np.mean(used))
    print(f"{label:32} {counts[0]:7.1f} {counts[1]:6.1f}")


def largest_residual(b, steps):
    return np.max(np.abs(b - box(dp.inverse(box, "krylov", iterations=steps, nullspace="project")(b))))


mean = np.mean([next(k for k in range(1, 400) if largest_residual(b, k) <= 1e-3) for b in cases])
print(f"\nPlain CG until no residual is above 1e-3: {mean:.1f}. Published, 64 x 64: 121.6, learned guess: 29.6.")
