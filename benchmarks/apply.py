"""The run time of one application of an operator, for each form, compared with the limit of the machine.

Bytes counted: 16 a cell for a Laplacian (one read, one write), 24 a number for the triad a = b + s c.
All rows of a block run in turn and the smallest time counts; only ratios in one run mean anything.

Run ``python -m benchmarks.apply [--quick]`` in the root of the repository.
"""

import argparse
import subprocess
import sys
from functools import partial
from math import prod
from timeit import repeat

import autograd.numpy as anp
import numpy as np

import sparsedp as dp
from benchmarks.triad import best_times, triad
from sparsedp import kernels

LIMITS = {  # least share of the triad, least factor over scipy CSR: with numba, out of cache
    "laplacian, uniform, out=": (0.85, 12.0),
    "its transpose, out=": (0.85, 12.0),
    "laplacian, stretched, out=": (0.60, None),
    "its transpose, stretched, out=": (0.60, None),
    "laplacian op(u), fresh result": (0.60, None),
}
SHAPES = ((4096, 4096), (256, 256, 256), (1024, 1024))


def stretched(n):
    """Smoothly varying cell widths that sum to 1."""
    s = np.linspace(0, 1, n + 1)
    return np.diff(s + 0.1 * np.sin(2 * np.pi * s) / np.pi)


def slices(u, out):
    """The Laplacian that a careful NumPy user writes: slices, with out=, no temporary array."""
    inside = (slice(1, -1),) * u.ndim
    inner = out[inside]
    np.multiply(u[inside], -2.0 * u.ndim, out=inner)
    for axis in range(u.ndim):
        for move in (slice(2, None), slice(None, -2)):
            np.add(inner, u[tuple(move if a == axis else slice(1, -1) for a in range(u.ndim))], out=inner)
    np.multiply(inner, 1e6, out=inner)


def tasks(shape, with_matrix):
    """Return the functions to measure on one grid, by name."""
    uniform = dp.laplacian(dp.Grid(shape, size=1.0), dp.dirichlet).matrix_free()
    bent = dp.laplacian(dp.Grid(shape, spacing=[stretched(n) for n in shape]), dp.dirichlet).matrix_free()
    u, out = np.random.default_rng(0).random(shape), np.empty(shape)
    found = {
        "triad": triad(shape),
        "laplacian, uniform, out=": lambda: uniform.apply(u, out=out),
        "its transpose, out=": lambda: uniform.T.apply(u, out=out),
        "laplacian, stretched, out=": lambda: bent.apply(u, out=out),
        "its transpose, stretched, out=": lambda: bent.T.apply(u, out=out),
        "laplacian op(u), fresh result": lambda: uniform(u),
    }
    found["NumPy slices with out="] = lambda: slices(u, out)
    if with_matrix:
        matrix = uniform.matrix
        found["scipy CSR"] = lambda: matrix @ u.ravel()
    return found


def table(shape, repeats, with_matrix=True):
    """Print one block: seconds, GB/s, share of the triad, times faster than CSR."""
    best = best_times(tasks(shape, with_matrix), repeats)
    rate = {name: (24 if name == "triad" else 16) * prod(shape) / seconds / 1e9 for name, seconds in best.items()}
    kind = "numba" if kernels.compiled() else "NumPy"
    print(f"\n{' x '.join(map(str, shape))}, {kernels.threads()} threads, kernels: {kind}")
    print(f"{'':32} {'ms':>9} {'GB/s':>7} {'of triad':>9} {'limit':>6} {'x CSR':>7} {'limit':>6} {'x slices':>9}")
    for name, seconds in best.items():
        share, factor = LIMITS.get(name, (None, None)) if kernels.compiled() else (None, None)
        against = f"{best['scipy CSR'] / seconds:7.1f}" if with_matrix else f"{'-':>7}"
        print(
            f"{name:32} {1e3 * seconds:9.2f} {rate[name]:7.1f} {rate[name] / rate['triad']:9.0%}"
            f" {f'{share:.0%}' if share else '':>6} {against} {f'{factor:g}' if factor else '':>6}"
            f" {best['NumPy slices with out='] / seconds:9.1f}"
        )


def forms():
    """Where the matrix-free form overtakes the explicit one: the source of the thresholds in operator.py."""
    print("\nexplicit against matrix-free, microseconds a call of the 2-D Laplacian:")
    for n in (4, 16, 32, 64, 128, 256, 512):
        best = best_times(both_forms(n), 200)
        print(f"  {n * n:7} cells: {1e6 * best['explicit']:8.1f} {1e6 * best['free']:8.1f}")


def both_forms(n):
    """Return functions that apply both forms on n x n cells, by name."""
    op, u = dp.laplacian(dp.Grid((n, n))), np.ones((n, n))
    return {"explicit": partial(op.explicit().apply, u), "free": partial(op.matrix_free().apply, u)}


def tape():
    """Cost of one operator call on the tape, VJP included, for a field of 4 elements. Gate: 12 us."""
    op, u = dp.laplacian(dp.Grid((2, 2))), np.ones((2, 2))

    def loss(u):
        for _ in range(200):
            u = op(u)
        return anp.sum(u)

    slope = dp.value_and_grad(loss)
    slope(u)
    best = min(repeat(lambda: slope(u), number=1, repeat=50)) / 200
    print(f"\noperator call on the tape with its VJP, 4 elements: {1e6 * best:.1f} us, limit 12 us")


def imports():
    """Seconds to import, each in fresh processes, smallest of several. Gate: 1.15."""

    def seconds(code):
        line = f"import time; t = time.perf_counter(); {code}; print(time.perf_counter() - t)"
        runs = [
            subprocess.run([sys.executable, "-c", line], capture_output=True, text=True, check=True) for _ in range(7)
        ]
        return min(float(run.stdout) for run in runs)

    base = seconds("import numpy, scipy.sparse.linalg, autograd.numpy")
    used = seconds("import sparsedp as dp; dp.laplacian(dp.Grid((2, 2)))")
    alone = seconds("import sparsedp")
    print(f"\nimport of numpy, scipy.sparse.linalg and autograd.numpy: {base:.3f} s; limit 1.15 times that")
    print(f"import of sparsedp: {alone:.3f} s, {alone / base:.2f} x")
    print(f"import of sparsedp and a first operator: {used:.3f} s, {used / base:.2f} x")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small sizes, few repeats")
    quick = parser.parse_args().quick
    print("Limits hold for the first two tables; without numba (SPARSEDP_NUMBA=0) the limit is 1 x slices.")
    for shape in ((256, 256), (32, 32, 32)) if quick else SHAPES:
        table(shape, 3 if quick else 15)
    forms()
    tape()
    imports()


if __name__ == "__main__":
    main()
