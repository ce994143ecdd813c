"""Compare the compiled Laplacian with the memory bandwidth of this machine.

The measure is the STREAM triad a = b + s c, counted as 24 bytes a number; the Laplacian is counted
as 16 bytes a cell, one read and one write. All rows of a table are measured in turn and the
smallest time of each counts, because only ratios of one run mean anything on a shared machine.

Run ``python -m benchmarks.triad [--quick]`` in the root of the repository.
"""

import argparse
import os
import time
from functools import reduce
from math import prod

import numpy as np
import scipy.sparse as sp

from sparsedp import kernels
from sparsedp.kernels import reference
from sparsedp.kernels.reference import Tridiagonal

__all__ = ["best_times", "triad", "triad_bandwidth"]

SHAPES = ((1, 4096, 4096), (256, 256, 256), (1, 1024, 1024), (1, 512, 512))


def _numpy_triad(a, b, c, s):
    np.multiply(c, s, out=a)
    np.add(a, b, out=a)


def _numba_triad():
    # The threads of numba's own parallel loops would go on spinning after a triad, on the processor of the next task.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    from numba import njit, prange

    @njit(parallel=True, nogil=True)
    def run(a, b, c, s):
        for i in prange(a.size):
            a[i] = b[i] + s * c[i]

    return run


def triad(shape):
    """Return a function without arguments that runs one triad over its own arrays."""
    a, b, c = (np.ones(prod(shape)) for _ in range(3))
    run = _numba_triad() if kernels.compiled() else _numpy_triad
    return lambda: run(a, b, c, 3.0)


def times_in_turn(tasks, repeats):
    """Run functions in turn `repeats` times, and return the times [s] of each as a list, by name."""
    times = {name: [] for name in tasks}
    for lap in range(repeats + 1):
        for name, task in tasks.items():
            start = time.perf_counter()
            task()
            if lap:  # the first lap compiles and touches the pages
                times[name].append(time.perf_counter() - start)
    return times


def best_times(tasks, repeats):
    """Run functions in turn `repeats` times, and return the smallest time [s] of each, by name."""
    return {name: min(times) for name, times in times_in_turn(tasks, repeats).items()}


def triad_bandwidth(shape, repeats=10):
    """Return the bandwidth of the triad [GB/s], with 24 bytes for each number."""
    return 24e-9 * prod(shape) / best_times({"triad": triad(shape)}, repeats)["triad"]


def laplacian_axes(shape, stretched):
    """Return 1-D Laplacians with zero values at the walls for a shape (n0, n1, n2); None for axes of one cell."""
    return tuple(None if n == 1 else _line(n, stretched) for n in shape)


def _line(n, stretched):
    widths = 1.0 + 0.3 * np.sin(np.arange(n)) if stretched else np.ones(n)
    steps = 0.5 * (widths[1:] + widths[:-1])
    lower, upper = np.zeros(n), np.zeros(n)
    lower[1:], upper[:-1] = 1 / (steps * widths[1:]), 1 / (steps * widths[:-1])
    centre = -(lower + upper)
    centre[[0, -1]] -= 2
    return Tridiagonal(lower, centre, upper)


def laplacian_csr(axes):
    """Return the sparse matrix of the Kronecker sum of tridiagonal matrices."""
    lines = [
        sp.csr_array((1, 1))
        if x is None
        else sp.diags_array([x.lower[1:], x.centre, x.upper[:-1]], offsets=[-1, 0, 1], format="csr")
        for x in axes
    ]
    return reduce(lambda a, b: sp.kronsum(b, a, format="csr"), lines)


def numpy_slices(u, out, axes, buffer):
    """The Laplacian as one writes it by hand: whole arrays, slices, out=. No allocation."""
    here = [(axis, x) for axis, x in enumerate(axes) if x is not None]
    np.multiply(u, sum(x.centre[len(x.centre) // 2] for _, x in here), out=out)
    np.multiply(u, here[0][1].upper[1], out=buffer)
    for axis, _ in here:
        for move in (slice(1, None), slice(None, -1)):
            other = slice(None, -1) if move.start else slice(1, None)
            a, b = (tuple(side if k == axis else slice(None) for k in range(3)) for side in (move, other))
            np.add(out[a], buffer[b], out=out[a])


def measure(shape, stretched, repeats, csr=True):
    """Times of all ways to apply one Laplacian [s] and of the triad."""
    axes = laplacian_axes(shape, stretched)
    u, out, buffer = np.random.default_rng(0).standard_normal(shape), np.empty(shape), np.empty(shape)
    tasks = {"triad": triad(shape), "plain": lambda: reference.kronecker_sum(u, out, axes, 0.0)}
    if kernels.compiled():
        tasks["compiled"] = lambda: kernels.summed(u.shape, axes, 0.0)(u, out)
    if not stretched:
        tasks["slices"] = lambda: numpy_slices(u, out, axes, buffer)
    if csr:
        matrix = laplacian_csr(axes)
        flat = u.ravel()
        tasks["csr"] = lambda: matrix @ flat
    return best_times(tasks, repeats)


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--quick", action="store_true", help="leave out the sparse matrices")
    quick = parser.parse_args().quick
    print(f"{kernels.threads()} threads; numba: {kernels.compiled()}")
    print(
        f"{'cells':18}{'grid':11}{'triad':>9}{'compiled':>10}{'of triad':>10}{'x csr':>7}{'x slices':>9}"
        f"{'plain x slices':>16}"
    )
    for shape in SHAPES:
        for stretched in (False, True):
            size = prod(shape)
            t = measure(shape, stretched, max(8, min(300, int(2e8) // size)), not quick)
            none = float("nan")
            fast = t.get("compiled", none)
            print(
                f"{'x'.join(str(n) for n in shape):18}{'stretched' if stretched else 'uniform':11}"
                f"{24e-9 * size / t['triad']:7.1f}/s{1e3 * fast:8.2f}ms{16 / 24 * t['triad'] / fast:10.2f}"
                f"{t.get('csr', none) / fast:7.1f}{t.get('slices', none) / fast:9.1f}"
                f"{t.get('slices', none) / t['plain']:16.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
