"""What a forward and an adjoint solve by transforms cost, beside the bare transforms of SciPy.

The operator is -divergence @ gradient on a box with equal cells. Its inverse carries the whole
contract: projection where it is singular, the true residual, the record. The bare pairs are
written by hand: for the right-hand side and for the cotangent a forward transform, a product with
precomputed weights and a backward transform, with as many workers as the library has threads.

Both run in turn and the smallest time of each counts, because only ratios of one run mean anything
on a shared machine. Run ``python -m benchmarks.transforms [--plain] [--quick]`` in the root of the
repository; --plain switches the compiled kernels off, as SPARSEDP_NUMBA=0 does.
"""

import argparse
import os
from functools import partial, reduce
from math import prod

import numpy as np
import scipy.fft as fft

import sparsedp as dp
from benchmarks.triad import best_times
from sparsedp import kernels

SHAPES = ((256, 256), (1024, 1024), (128, 128, 128))
LIMITS = {True: 1.15, False: 1.6}  # largest ratio with the compiled kernels, and without
WALLS = {  # name: kind of the first axis, kind of the others
    "dirichlet": ("dirichlet", "dirichlet"),
    "neumann": ("neumann", "neumann"),
    "periodic": ("periodic", "periodic"),
    "mixed": ("half", "dirichlet"),
    "mixed, periodic": ("neumann", "periodic"),
}
SIDES = {"dirichlet": dp.dirichlet, "neumann": dp.neumann, "half": (dp.neumann, dp.dirichlet)}
TRANSFORMS = {  # kind: there, back, further arguments
    "dirichlet": (fft.dstn, fft.idstn, {"type": 2}),
    "neumann": (fft.dctn, fft.idctn, {"type": 2}),
    "half": (fft.dctn, fft.idctn, {"type": 4}),
    "periodic": (fft.rfftn, fft.irfftn, {}),
}


def operator(shape, kinds):
    """Return -divergence @ gradient on the unit box for a shape and a kind of each axis."""
    grid = dp.Grid(shape, size=1.0, periodic=[kind == "periodic" for kind in kinds])
    boundary = {axis: SIDES[kind] for axis, kind in zip(grid.axes, kinds, strict=True) if kind != "periodic"}
    return -dp.divergence(grid) @ dp.gradient(grid, boundary or dp.neumann)


def eigenvalues(n, kind):
    """Return the eigenvalues of the negative second difference on an axis of length 1."""
    place = np.arange(n) + {"dirichlet": 1.0, "half": 0.5}.get(kind, 0.0)
    return 4.0 * n**2 * np.sin(np.pi * place / (n if kind == "periodic" else 2 * n)) ** 2


def bare(shape, kinds):
    """Return a function that solves for x with scipy.fft alone."""
    values = reduce(np.add.outer, map(eigenvalues, shape, kinds))
    if kinds[-1] == "periodic":
        values = values[..., : shape[-1] // 2 + 1]
    weights = np.divide(1.0, values, out=np.zeros_like(values), where=values != 0)
    steps = []
    for kind in dict.fromkeys(kinds):
        there, back, more = TRANSFORMS[kind]
        more = {**more, "axes": tuple(a for a, other in enumerate(kinds) if other == kind)}
        steps.append((partial(there, **more), partial(back, **more)))

    def solve(b):
        for there, _ in steps:
            b = there(b, workers=kernels.threads())
        b = b * weights
        for _, back in reversed(steps):
            b = back(b, workers=kernels.threads())
        return b

    return solve


def residual(op, x, b):
    """|b - A x| / |b|, of the data without their part along the constants where A is singular."""
    b = b - b.mean() if op.T.apply(np.ones_like(b)).max() == 0 else b
    return float(np.linalg.norm(b - op.apply(x)) / np.linalg.norm(b))


def measure(shape, kinds, repeats):
    """One row: seconds of both ways, true residual of both, error of the adjoint identity of ours."""
    op, generator = operator(shape, kinds), np.random.default_rng(0)
    inv, by_hand = dp.inverse(op, nullspace="project"), bare(shape, kinds)
    b, g = generator.standard_normal((2, *shape))
    best = best_times({"ours": lambda: (inv(b), inv.T(g)), "bare": lambda: (by_hand(b), by_hand(g))}, repeats)
    x, y = inv(b), inv.T(g)
    identity = abs(np.vdot(x, g) - np.vdot(b, y)) / (np.linalg.norm(x) * np.linalg.norm(g))
    return best["ours"], best["bare"], residual(op, x, b), residual(op, by_hand(b), b), identity


def table(shapes, seconds):
    """Print the rows for the current number of threads; about `seconds` for each."""
    limit = LIMITS[kernels.compiled()]
    kind = "compiled" if kernels.compiled() else "NumPy"
    print(f"\n{kernels.threads()} threads, kernels: {kind}; forward and adjoint solve; limit {limit} x the bare pairs")
    print(f"{'':34}{'ms':>9}{'bare ms':>9}{'ratio':>7}{'residual':>10}{'bare':>9}{'adjoint':>9}")
    for shape in shapes:
        for name, (first, others) in WALLS.items():
            repeats = max(5, int(seconds * 2e7 / prod(shape)))
            kinds = [first] + [others] * (len(shape) - 1)
            ours, theirs, wrong, theirs_wrong, identity = measure(shape, kinds, repeats)
            print(
                f"{name:18}{'x'.join(map(str, shape)):16}{1e3 * ours:9.2f}{1e3 * theirs:9.2f}{ours / theirs:7.2f}"
                f"{wrong:10.1e}{theirs_wrong:9.1e}{identity:9.1e}{'' if ours <= limit * theirs else '  above'}",
                flush=True,
            )


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--plain", action="store_true", help="without the compiled kernels")
    parser.add_argument("--quick", action="store_true", help="the smallest grid only, few repeats")
    chosen = parser.parse_args()
    if chosen.plain:
        os.environ["SPARSEDP_NUMBA"] = "0"
    dp.set_threads()
    for threads in sorted({1, kernels.threads()}):
        dp.set_threads(threads)
        table(SHAPES[:1] if chosen.quick else SHAPES, 0.5 if chosen.quick else 1.0)


if __name__ == "__main__":
    main()
