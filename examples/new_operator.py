"""Your own operator in five lines, in both families. Run: python examples/new_operator.py [cells]"""

import sys

import autograd.numpy as np
import scipy.sparse as sp

import sparsedp as dp

n = int(sys.argv[1]) if len(sys.argv) > 1 else 48
grid = dp.Grid((n, n), size=1.0)

# Explicit: any SciPy sparse matrix. Here a scanner that reads the mean of every column of cells.
rows = sp.kron(sp.eye_array(n), np.full((1, n), 1 / n))
scanner = dp.from_matrix(rows, grid.cells, n, name="scanner")
print(dp.check.operator(scanner), "\n")


# Matrix-free: two functions, the map and its transpose. Here a smear: wind blows half of each value
# one cell along x, and round the end. In the transpose the wind blows the other way.
def smear(u):
    return 0.5 * u + 0.5 * np.roll(u, 1, axis=0)


def smear_back(g):
    return 0.5 * g + 0.5 * np.roll(g, -1, axis=0)


wind = dp.from_functions(smear, smear_back, grid.cells, grid.cells, name="wind")
print(dp.check.operator(wind), "\n")

# Both compose with the catalogue, and gradients run through all of it.
scan = scanner @ dp.laplacian(grid) @ wind
x, y = grid.centres()
print(scan)
print(dp.check.gradient(lambda u: np.sum(scan(u) ** 2), np.sin(5 * x + y)), "\n")

# What the check is for: forget to turn the wind, and it says so.
wrong = dp.from_functions(smear, smear, grid.cells, grid.cells, name="wind that never turns")
found = dp.check.operator(wrong)
print(f"{wrong.name}: {found.verdict}, because these fail: " + "; ".join(found.failed))
