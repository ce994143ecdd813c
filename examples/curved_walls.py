r"""
Curved walls in cut cells
=========================

The potential between a wire and a pipe on a grid of squares: cells that the walls cut, beside the exact solution and a
staircase.

A mask of solid cells turns a curved wall into a staircase, and its errors decrease only in proportion to the width of a
cell. Cut cells keep the exact share of each cell and of each face. Then values, fluxes and the charge on the wire have
order 2, and all of them have derivatives in the shape.

Run it: ``python examples/curved_walls.py [cells] [--out FOLDER]``
"""

import argparse
from pathlib import Path

import autograd.numpy as np

import sparsedp as dp

parser = argparse.ArgumentParser(description="Curved walls in cut cells.")
parser.add_argument("cells", nargs="?", type=int, default=128, help="cells along an axis of the finest grid")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()
sizes = options.cells // 4, options.cells // 2, options.cells

# %%
# The exact solution
# ------------------
# A wire of radius :math:`a` at the potential 1 stands in the middle of a grounded pipe of radius :math:`b`. With the
# distance :math:`r` from the axis,
#
# .. math:: u = \frac{\log (b / r)}{\log (b / a)}, \qquad q = \frac{2 \pi}{\log (b / a)},
#
# where :math:`q` is the charge on the wire: the integral of :math:`\partial u / \partial n` over its surface.

WIRE, PIPE = 0.31, 0.9
CENTRE = 0.031, -0.017  # at no symmetric place of the grid
CHARGE = 2 * np.pi / np.log(PIPE / WIRE)
SLOPE = CHARGE**2 / (2 * np.pi * WIRE)  # of the charge in the radius of the wire


def distance(x, y):
    """The distance from the axis."""
    return np.sqrt((x - CENTRE[0]) ** 2 + (y - CENTRE[1]) ** 2)


def level(x, y, radius=WIRE):
    """The distance from the nearest wall: positive between wire and pipe."""
    return np.minimum(distance(x, y) - radius, PIPE - distance(x, y))


def square(cells):
    """A grid that holds the pipe."""
    return dp.Grid((cells, cells), size=2.0, origin=-1.0)


# %%
# Cut cells and a staircase
# -------------------------
# The level set is all that a shape needs. The values on the walls are those at the centroids of the wall in each cell:
# here 1 on the wire and 0 on the pipe. A mask of solid cells has only the value 0 on its walls. To compare both, we
# solve :math:`-\Delta u = 1` for a membrane over the whole cross-section of the pipe, whose height is
# :math:`(b^2 - r^2) / 4`.


def potential(cells, radius=WIRE):
    """The potential, and the charge on the wire."""
    grid = square(cells)
    body = dp.cut_cells(grid, lambda x, y: level(x, y, radius), solid_boundary=dp.dirichlet)
    on_wire = 1.0 * (distance(*grid.centres()) < 0.6)
    u = body.solve(np.zeros(grid.shape), on_wire)
    return u, np.sum(body.flux(u, on_wire) * on_wire), body


def potential_error(cells):
    """The largest error of the potential in cells with their centre between the walls, and the error of the charge."""
    u, charge, body = potential(cells)
    r = distance(*body.grid.centres())
    between = (r > WIRE) & (r < PIPE)
    exact = np.log(PIPE / r) / np.log(PIPE / WIRE)
    return np.max(abs(u - exact)[between]), abs(charge / CHARGE - 1)


def membrane_errors(cells):
    """The largest errors of a membrane over the pipe, with cut cells and with a staircase."""
    grid = square(cells)
    r = distance(*grid.centres())
    inside = r < PIPE
    load = np.ones(grid.shape)
    body = dp.cut_cells(grid, lambda x, y: PIPE - distance(x, y), solid_boundary=dp.dirichlet)
    stairs = dp.inverse(-dp.laplacian(grid, dp.dirichlet, solid=~inside, solid_boundary=dp.dirichlet))
    exact = (PIPE**2 - r**2) / 4
    return tuple(np.max(abs(u - exact)[inside]) for u in (body.solve(load), stairs(load * inside)))


print("cells  potential  charge off by  membrane: cut cells  staircase")
rows = []
for cells in sizes:
    rows.append((*potential_error(cells), *membrane_errors(cells)))
    print("{:5}  {:9.1e}  {:13.3%}  {:19.1e}  {:9.1e}".format(cells, *rows[-1]))
orders = np.log2(np.array(rows[0]) / np.array(rows[-1])) / 2
print("order  {:9.2f}  {:13.2f}  {:19.2f}  {:9.2f}".format(*orders))

# %%
# The derivative in the shape
# ---------------------------
# The level is an ordinary argument: whatever it is computed from has a derivative, through the shares of cells and
# faces, the fluxes and the solve. Here it is the radius of the wire.


def charge_of(radius):
    return potential(sizes[0], radius)[1]


value, slope = dp.value_and_grad(charge_of)(WIRE)
audit = dp.check.gradient(charge_of, WIRE, quick=True)
print(f"charge {value:.4f}, exact {CHARGE:.4f}; slope in the radius {slope:.3f}, exact {SLOPE:.3f}; {audit.verdict}")

# %%
# A radius from a charge
# ----------------------
# The radius of a wire with the charge 8, by Newton's method; the exact answer is :math:`b \exp (-2 \pi / 8)`.

radius = WIRE
for _ in range(6):
    value, slope = dp.value_and_grad(charge_of)(radius)
    radius = radius - (value - 8.0) / slope
print(f"radius {radius:.5f}, exact {PIPE * np.exp(-2 * np.pi / 8):.5f}, charge {charge_of(radius):.6f}")

# %%
# The picture
# -----------
# Left: the potential on the coarsest grid, and the walls. Middle: the potential of its cells over the distance from the
# axis, and the exact curve. Right: the errors, with lines of the orders 1 and 2.

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (map_of_u, profile, errors) = pyplot.subplots(1, 3, figsize=(13, 4), layout="constrained")
    u, _, body = potential(sizes[0])
    grid = body.grid
    dp.plot(grid, np.where(body.is_fluid, u, np.nan), ax=map_of_u, title="potential", label="u", limits=(0, 1))
    angle = np.linspace(0, 2 * np.pi, 200)
    for wall in (WIRE, PIPE):
        map_of_u.plot(CENTRE[0] + wall * np.cos(angle), CENTRE[1] + wall * np.sin(angle), "k", linewidth=1)
    r = distance(*grid.centres())
    between = (r > WIRE) & (r < PIPE)
    line = np.linspace(WIRE, PIPE, 100)
    profile.plot(r[between], u[between], ".", markersize=3, label=f"{sizes[0]}^2 cells")
    profile.plot(line, np.log(PIPE / line) / np.log(PIPE / WIRE), "k", linewidth=1, label="exact")
    profile.set(title="over the distance from the axis", xlabel="r", ylabel="u")
    profile.legend(frameon=False)
    names = "potential", "charge, relative", "membrane, cut cells", "membrane, staircase"
    for name, line_of_errors, mark in zip(names, np.array(rows).T, "osv^"):
        errors.loglog(sizes, line_of_errors, marker=mark, label=name)
    across = np.array(sizes, float)
    for order in (1, 2):
        errors.loglog(across, rows[0][3 if order == 1 else 0] * (across / across[0]) ** -order, "k:", linewidth=1)
    errors.set(title="errors; dotted: orders 1 and 2", xlabel="cells along an axis")
    errors.legend(frameon=False)
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "curved_walls.png", dpi=120)
