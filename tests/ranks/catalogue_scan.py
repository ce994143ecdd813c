"""Every operator of the catalogue on ranks, and sums of them: errors, dot tests, and a hash of the results.

    mpirun -n 4 python -m mpi4py tests/ranks/catalogue_scan.py

Rank 0 prints one line for each operator: its label, the largest error and dot test, the hash; or what refused it.
"""

from hashlib import sha256

import numpy as np
from catalogue import CATALOGUE, LABELS, Entry
from mpi4py import MPI

import sparsedp as dp

RNG = np.random.default_rng(3)
GRIDS = [
    dp.Grid(13, spacing=0.3),
    dp.Grid((12, 9), size=(2.0, 1.0), periodic=(True, False)),
    dp.Grid((12, 9), spacing=[RNG.uniform(0.5, 2.0, n) for n in (12, 9)]),
    dp.Grid((3, 20), spacing=[RNG.uniform(0.5, 2.0, n) for n in (3, 20)], periodic=True),
    dp.Grid((6, 4, 8), size=1.0, periodic=(False, True, False)),
    dp.Grid((4, 6, 5), spacing=[RNG.uniform(0.5, 2.0, n) for n in (4, 6, 5)], periodic=(True, False, True)),
]


def sum_with_the_identity(direction):
    """One pass adds up the terms of a sum, in another order at the ends of a row: here one end needs no neighbour."""
    return lambda grid, sides: 0.4 * dp.identity(grid.cells) - 1.7 * dp.upwind(grid, grid.dim - 1, direction, sides)


def after_a_laplacian(grid, sides):
    last = dp.upwind(grid, grid.dim - 1, 1, sides)
    return dp.laplacian(grid, sides) @ dp.upwind(grid, 0, 1, sides) - 0.5 * dp.identity(grid.cells) + 0.7 * last


SUMS = {
    "sum-forward": Entry("sum", sum_with_the_identity(1)),
    "sum-backward": Entry("sum", sum_with_the_identity(-1)),
    "sum-laplacian": Entry("sum", after_a_laplacian),
}


def boundary(grid):
    """The conditions of the README's kinds, mixed."""
    sides = [(dp.dirichlet, dp.robin(1, 2)), (dp.neumann, dp.dirichlet), (dp.robin(2, 0.5), dp.neumann)]
    return {name: sides[a] for a, name in enumerate(grid.axes) if not grid.periodic[a]}


def as_array(u):
    """A result as one array, on ranks or not."""
    return np.asarray(dp.gather(u))


def compared(entry, plain, grid):
    """(largest error, dot test, digest) of one operator on one grid; or the refusal."""
    one = entry.make(plain, boundary(plain))
    try:
        op = entry.make(grid, boundary(grid))
        digest = sha256()
        worst = 0.0
        u, g = (np.random.default_rng(5).standard_normal(space.shape) for space in (one.domain, one.codomain))
        figures = []
        for act, reference, x in ((op, one, u), (op.T, one.T, g)):
            y = as_array(act(x))
            right = reference(x)
            assert y.shape == right.shape
            scale = max(np.max(magnitude_of(reference, x), initial=0.0), 1e-300)
            worst = max(worst, float(np.max(np.abs(y - right), initial=0.0) / scale))
            digest.update(y.tobytes())
            figures.append(act(x))
        terms = np.vdot(g, figures[0]), np.vdot(u, figures[1])
        dot = abs(terms[0] - terms[1]) / (np.vdot(np.abs(g), magnitude_of(one, u)) or 1.0)
        return worst, float(dot), digest.hexdigest()[:16]
    except TypeError as error:
        return str(error)


def magnitude_of(op, x):
    """|A| |x|, the scale of rounding errors."""
    return np.abs(op.matrix) @ np.abs(x).reshape(-1)


def main():
    """Print the table; end with an error where the ranks do not agree."""
    comm = MPI.COMM_WORLD
    for number, plain in enumerate(GRIDS):
        grid = dp.distribute(plain, comm)
        for label, entry in [*zip(LABELS, CATALOGUE), *SUMS.items()]:
            if plain.dim < entry.least_dim:
                continue
            figures = compared(entry, plain, grid)
            assert len(set(comm.allgather(repr(figures)))) == 1, (label, plain, comm.allgather(repr(figures)))
            if comm.rank == 0:
                text = f"refused {figures}" if isinstance(figures, str) else "{:.2e} {:.2e} {}".format(*figures)
                print(f"{number} {label} {text}")


if __name__ == "__main__":
    main()
