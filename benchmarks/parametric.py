"""Solves whose operator depends on parameters: what a gradient costs beside the solve, and Taylor orders.

Sections: cost, orders, waves. Run ``python -m benchmarks.parametric [cost|orders|waves] [--quick]`` in the root of
the repository. `cost`: a new coefficient each time; the set-up is what the first solve with it takes
longer than the second; limit: value and gradient <= 2.1 forward solves and one set-up. Times are the
smallest of a few, of the processor and on one thread, which other programs hardly disturb. `orders`:
with t the step, the remainder of the loss without derivatives falls like t, with the gradient like t^2
(limit 1.95), with the Hessian like t^3 (2.9). `waves`: Helmholtz in a medium of two speeds at 10 cells a wavelength,
LU beside GMRES with shifted Laplace, each in a process of its own for its memory; limit: residual 1e-6 at 1024^2.
"""

import argparse
from concurrent.futures import ProcessPoolExecutor
from resource import RUSAGE_SELF, getrusage
from time import process_time

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

import sparsedp as dp
from sparsedp.autodiff.derivative import pushforward, value_and_grad

STEPS = 2.0 ** -np.arange(3, 14)


def elliptic(shape, method, seed=0, **options):
    """elliptic_solver with its arguments: a smooth coefficient on the faces, data, a shift."""
    grid, generator = dp.Grid(shape, size=1.0), np.random.default_rng(seed)
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet), method, **options)
    waves = 1 + 0.5 * np.prod([np.sin(5 * x) for x in grid.centres()], axis=0)
    return solve, [dp.harmonic_average(grid)(waves), generator.standard_normal(shape), 0.3]


def entries(n, method="auto"):
    """matrix_solver with its arguments: the entries of a 2-D Laplacian, made unsymmetric, and data."""
    generator = np.random.default_rng(1)
    matrix = sp.csr_array((-dp.laplacian(dp.Grid((n, n), size=1.0), dp.dirichlet)).matrix)
    data = matrix.data * generator.uniform(0.9, 1.0, matrix.nnz)
    return dp.matrix_solver(matrix, method), [data, generator.standard_normal(n * n)]


def root(n):
    """implicit with its arguments: -lap x + c x^3 = f."""
    grid, generator = dp.Grid((n, n), size=1.0), np.random.default_rng(2)
    lap = dp.laplacian(grid, dp.dirichlet)
    solve = dp.implicit(lambda x, c, f: c * x**3 - lap(x) - f)
    guess = np.zeros(grid.shape)
    return (lambda c, f: solve(guess, c, f)), [2.0, 50 * generator.standard_normal(grid.shape)], solve.info


# ---------------------------------------------------------------- cost


def timed(task):
    start = process_time()
    found = task()
    return process_time() - start, found


def cost(quick):
    """Value and gradient in k beside the forward solve."""
    dp.set_threads(1)
    shapes = ((64, 64), (16, 16, 16)) if quick else ((256, 256), (512, 512), (64, 64, 64))
    print("\nelliptic_solver, a new k each time; limit: (value + gradient - set-up) / forward <= 2.1")
    print(
        f"{'cells':15}{'method':12}{'set-up s':>9}{'forward s':>10}{'value+grad s':>13}{'ratio':>7}  solves"
        f"{'residual':>10}{'adjoint':>9}{'gradient error':>15}"
    )
    for shape in shapes:
        for method in ("structured", "multigrid", "direct"):
            if method == "direct" and len(shape) == 3 and shape[0] > 32:
                continue
            solve, (k, b, shift) = elliptic(shape, method)
            _cost_row("x".join(map(str, shape)), method, solve, k, b, shift, turns=6)
    print("matrix_solver (direct) and implicit: the same")
    for n in (32,) if quick else (64, 128):
        solve, (data, b) = entries(n)
        _cost_row(f"{n}x{n} entries", "auto", solve, data, b)
    dp.set_threads()


def _cost_row(cells, method, solve, k, *rest, turns=5):
    loss = lambda k: anp.sum(solve(k, *rest) ** 2)
    slope = value_and_grad(loss)
    slope(k)  # loads the kernels
    first = kept = whole = np.inf
    for turn in range(1, turns + 1):
        other, another = k * (1 + 1e-3 * turn), k * (1 - 1e-3 * turn)
        first = min(first, timed(lambda other=other: loss(other))[0])
        kept = min(kept, timed(lambda other=other: loss(other))[0])
        seconds, (_, gradient) = timed(lambda another=another: slope(another))
        whole = min(whole, seconds)
    setup = first - kept
    direction = k * np.random.default_rng(3).uniform(-1, 1, k.size)
    info, gap = solve.info, _gap(loss, another, gradient, direction)
    print(
        f"{cells:15}{method:12}{setup:9.4f}{kept:10.4f}{whole:13.4f}{(whole - setup) / kept:7.2f}"
        f"  1 + 1{info.forward.residual:12.1e}{info.adjoint.residual:9.1e}{gap:15.1e}",
        flush=True,
    )


def _gap(loss, k, gradient, direction):
    """Relative difference between the slope along a direction and the best of several differences."""
    slope = float(np.sum(gradient * direction))
    steps = 10.0 ** -np.arange(2, 6)
    differences = [(loss(k + h * direction) - loss(k - h * direction)) / (2 * h) for h in steps]
    return min(abs(difference / slope - 1) for difference in differences)


# ---------------------------------------------------------------- orders


def orders(quick):
    """Taylor orders in each argument."""
    print(
        "\norders of the remainder; limits: 1 +- 0.05 without derivatives, 1.95 with the gradient, 2.9 with the Hessian"
    )
    print(f"{'rule':19}{'method':12}{'argument':10}{'without':>9}{'gradient':>10}{'Hessian':>9}")
    n = 16 if quick else 48
    tight = {"rtol": 1e-13}
    for method in ("direct", "multigrid", "structured"):
        solve, point = elliptic((n, n), method, **tight)
        _order_rows("elliptic_solver", method, solve, point, ("k", "b", "shift"))
    solve, point = entries(n)
    _order_rows("matrix_solver", "auto", solve, point, ("entries", "b"), 1e-3)
    solve, point, _ = root(n)
    _order_rows("implicit", "auto", solve, point, ("c", "f"))


def _order_rows(rule, method, solve, point, names, share=1.0):
    """`share`: how far entries may move before the matrix becomes another one."""
    generator = np.random.default_rng(4)
    level = float(np.mean(np.abs(solve(*point))))
    loss = lambda *arguments: anp.sum(anp.sin(solve(*arguments) / level))
    for place, name in enumerate(names):
        line = lambda x, place=place: loss(*point[:place], x, *point[place + 1 :])
        size, slope = np.abs(point[place]), value_and_grad(line)(point[place])[1]
        uphill = size * generator.uniform(0, 1, np.shape(size)) * np.sign(slope)  # the first order has something to say
        direction = (share if place == 0 else 1.0) * uphill if np.ndim(size) else 10.0
        print(
            f"{rule:19}{method:12}{name:10}"
            + "".join(f"{order:9.2f} " for order in _orders(line, point[place], direction))
        )


def _orders(line, x, direction):
    """Least orders over the pairs of steps whose remainders are above rounding and below the range of the series."""
    value, gradient = value_and_grad(line)(x)
    slope = np.sum(gradient * direction)
    bend = np.sum(pushforward(lambda x: value_and_grad(line)(x)[1], x, direction)[1] * direction)
    values = np.array([line(x + t * direction) for t in STEPS])
    remainders = values - value, values - value - STEPS * slope, values - value - STEPS * slope - STEPS**2 / 2 * bend
    return [_order(np.abs(rest), 1e-11 * abs(value) + 1e-13) for rest in remainders]


def _order(rests, floor):
    usable = rests > 100 * floor
    found = np.log2(rests[:-1] / rests[1:])[usable[:-1] & usable[1:]]
    return float(found[-3:].min()) if found.size >= 2 else float("nan")


# ---------------------------------------------------------------- waves


def waves(quick):
    """Helmholtz: forward and adjoint."""
    print("\nHelmholtz, 10 cells a wavelength, sponge of 2 wavelengths, rtol 1e-10; limit: relative residual 1e-6")
    print(
        f"{'cells':12}{'method':9}{'set-up s':>9}{'forward s':>10}{'adjoint s':>10}{'iterations':>12}{'residual':>10}"
        f"{'adjoint':>9}{'GB':>6}"
    )
    for n in (128,) if quick else (256, 512, 1024):
        for method in ("direct", "krylov"):
            with ProcessPoolExecutor(1) as pool:
                print(pool.submit(_wave_row, n, method).result(), flush=True)


def _wave_row(n, method, cells=10):
    dp.set_threads(1)
    grid = dp.Grid((n, n), size=1.0)
    x, y = grid.centres()
    speed = 1.0 + 0.5 * ((x - 0.4) ** 2 + (y - 0.6) ** 2 < 0.04)
    damping = np.maximum(1 - np.minimum(np.minimum(x, 1 - x), np.minimum(y, 1 - y)) * n / (2 * cells), 0) ** 2
    options = {"preconditioner": "shifted_laplace"} if method == "krylov" else {}
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet), method, **options)
    source = n**2 * (np.hypot(x - 0.5, y - 0.3) < 1.5 / n)
    loss = lambda c: anp.sum(anp.abs(solve(1.0, source, -((2 * np.pi * n / cells / c) ** 2) * (1 + 1j * damping))) ** 2)
    value_and_grad(loss)(speed)
    there, back, memory = solve.info.forward, solve.info.adjoint, getrusage(RUSAGE_SELF).ru_maxrss / 1e6
    return (
        f"{n:4} x {n:<5}{method:9}{solve.info.setup_seconds:9.2f}{there.seconds:10.2f}{back.seconds:10.2f}"
        f"{there.iterations:6} +{back.iterations:4}{there.residual:10.1e}{back.residual:9.1e}{memory:6.2f}"
    )


SECTIONS = {"cost": cost, "orders": orders, "waves": waves}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("sections", nargs="*", choices=[*SECTIONS, []], help=", ".join(SECTIONS))
    parser.add_argument("--quick", action="store_true", help="small sizes")
    chosen = parser.parse_args()
    for name in chosen.sections or SECTIONS:
        SECTIONS[name](chosen.quick)


if __name__ == "__main__":
    main()
