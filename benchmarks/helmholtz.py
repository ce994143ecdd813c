"""Waves of one frequency in the plane: a scene of benchmarks.physics."""

import autograd.numpy as np

import sparsedp as dp

FRESNEL = (np.sqrt(27) - np.sqrt(7)) / (np.sqrt(27) + np.sqrt(7))  # cos 30 degrees and sqrt(1 / 1.5^2 - 1 / 4)


def slanted(n):
    """Echo of a wave at 30 degrees from a jump of the speed to c, ten cells a wavelength (Fresnel); n a multiple of 20.

    So few cells make it 3.5 % too strong: sin((a - b) / 2) / sin((a + b) / 2) with the wave numbers a, b on the grid.
    """
    grid = dp.Grid((n, n), periodic=(False, True))
    (x, y), (faces, _), omega = grid.centres(), grid.face_centres(0), 2 * np.pi / 10
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
    layer = lambda x: 1 - 2j * np.maximum(1 - np.minimum(x, n - x) / (n / 8), 0) ** 3
    k = grid.join(1 / layer(faces), layer(grid.face_centres(1)[0]))
    source = np.where(x == n // 4 + 0.5, np.exp(0.5j * omega * y), 0)

    def reflected(c):
        far = 1.0 * (x > n / 2)
        u, w = (solve(k, source, -layer(x) * (omega * (far / c + 1 - far)) ** 2) for c in (c, 1.0))
        part = slice(3 * n // 10, 9 * n // 20)
        return np.mean(np.abs(u - w)[part]) / np.mean(np.abs(w[part]))

    return reflected, 1.5
