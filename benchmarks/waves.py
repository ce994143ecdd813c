"""Waves of one frequency from a point, beside Hankel's function: error and time by order and cells a wavelength.

Run it: ``python -m benchmarks.waves [wavelengths across]``
"""

import sys
import time

import autograd.numpy as np
from scipy.special import hankel1

import sparsedp as dp


def point_source(across, cells, order):
    """Return the error relative to Hankel's function, one wavelength from the source and farther, and the seconds.

    A square of `across` wavelengths, with the source in its centre, is surrounded by matched layers of a wavelength.
    """
    n = across * cells + 1 + 2 * cells
    grid = dp.Grid((n, n))
    omega = 2 * np.pi / cells
    in_cells, on_faces = dp.matched_layer(grid, cells, speed=1.0).coefficients(omega)
    solve = dp.elliptic_solver(dp.divergence(grid, order), dp.gradient(grid, dp.dirichlet, order=order))
    source = np.zeros(grid.shape)
    source[n // 2, n // 2] = 1.0
    start = time.perf_counter()
    u = solve(on_faces, in_cells * source, -(omega**2) * in_cells)
    seconds = time.perf_counter() - start
    radius = np.hypot(*(x - 0.5 * n for x in grid.centres()))
    inside = np.zeros(grid.shape, bool)
    inside[cells:-cells, cells:-cells] = True
    inside &= radius >= cells
    exact = 0.25j * hankel1(0, omega * radius[inside])
    return np.linalg.norm(u[inside] - exact) / np.linalg.norm(exact), seconds


def main():
    across = int(sys.argv[1]) if len(sys.argv) > 1 else 6
    print(f"{across} wavelengths across; order, cells a wavelength, error, seconds (LU and one solve)")
    for order, cells in ((2, 10), (2, 20), (2, 40), (4, 8), (4, 10), (4, 14)):
        error, seconds = point_source(across, cells, order)
        print(f"{order:6} {cells:6} {error:9.2%} {seconds:9.2f}")


if __name__ == "__main__":
    main()
