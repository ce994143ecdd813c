"""Steady flow around bodies whose wall cuts the cells, beside published and exact figures.

Run ``python -m benchmarks.cut_flow [cells a diameter ...]`` in the root of the repository; 10, 20 and 40 by default.

- DFG 2D-1, a cylinder in a channel at Re 20: drag, lift and difference of pressure beside the published digits,
  by how much the force differs from the balance of momentum over a box of cells around the cylinder (`dp.forces`),
  seconds of the flow, seconds of the gradient of the drag in all values of the level.
- Flow between a rotating and a fixed cylinder: root mean square and largest error of the velocity, orders from one row
  to the next one.
- The derivative of the drag of a cylinder in its radius, the viscosity and the speed: what `check.gradient` says.
"""

import sys
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp
from benchmarks.tables import lines

DRAG, LIFT, DIFFERENCE = 5.57953523384, 0.010618948146, 0.11752016697  # DFG 2D-1: Nabh; John and Matthies
HEIGHT, DIAMETER, NU = 0.41, 0.1, 1e-3
SIDES = {"x": (dp.inflow, dp.outflow)}
SCALE = 2 / (0.2**2 * DIAMETER)  # mean velocity 0.2


def disc(x0, y0, radius):
    return lambda x, y: np.sqrt((x - x0) ** 2 + (y - y0) ** 2) - radius


def channel(cells):
    """The grid; cells are longer behind the cylinder."""
    h = DIAMETER / cells
    wake = np.minimum(1.04 ** (20 / cells * np.arange(1, 40 * cells)), 8.0)
    wake = wake[: np.argmax(np.cumsum(wake) >= 1.8 / h) + 1]
    widths = np.append(np.full(4 * cells, h), 1.8 / np.sum(wake) * wake)
    return dp.Grid((widths.size, round(HEIGHT / h)), spacing=[widths, h])


def coefficients(grid, level, guess=None):
    """Drag and lift of the body whose wall is the zero of the level, and the state of the flow."""
    rows = grid.face_centres(0)[1]
    parabola = grid.join(1.2 * rows * (HEIGHT - rows) / HEIGHT**2, 0.0)
    flow = dp.cut_flow(grid, level, SIDES)
    state = flow.steady(NU, parabola, guess=guess)
    return SCALE * flow.force(state, NU), state


def published(cells):
    grid = channel(cells)
    x, y = np.meshgrid(*(grid.coordinates(axis, "nodes") for axis in (0, 1)), indexing="ij")
    level = disc(0.2, 0.2, DIAMETER / 2)(x, y)

    clock = perf_counter()
    force, state = coefficients(grid, level)
    seconds = perf_counter() - clock
    box = np.all([abs(c - 0.2) < 0.08 for c in grid.centres()], axis=0)
    balance = SCALE * dp.forces(grid, boundary=SIDES, cells=box)(state["v"], state["p"], NU)[:2]
    clock = perf_counter()
    dp.grad(lambda level: coefficients(grid, level, state)[0][0])(level)
    gradient = perf_counter() - clock

    middle = 2 * cells  # the row above the centre
    line = 0.5 * (state["p"][:, middle - 1] + state["p"][:, middle])
    front, back = round(1.5 * cells), round(2.5 * cells)
    at_wall = lambda p: (15 * p[0] - 10 * p[1] + 3 * p[2]) / 8  # by a parabola through three cells
    difference = at_wall(line[front - 3 : front][::-1]) - at_wall(line[back : back + 3])
    figures = zip((*force, difference), (DRAG, LIFT, DIFFERENCE), strict=True)
    words = "  ".join(f"{value:9.6f} {value / known - 1:+8.3%}" for value, known in figures)
    off = np.max(abs(force - balance)) / DRAG
    return f"{cells:5}  {words}  {off:8.1e}  {seconds:7.1f}  {gradient:8.1f}"


INNER, OUTER, OMEGA, CENTRE = 0.31, 0.93, 1.3, (0.013, -0.021)


def between_cylinders(n):
    """Return (rms error of v, largest error of v, error of p up to a constant, force on both walls)."""
    grid = dp.Grid((n, n), size=2.0, origin=-1.0)
    radius = disc(*CENTRE, 0.0)

    def wall(x, y):
        is_inner = radius(x, y) < 0.6
        return -OMEGA * (y - CENTRE[1]) * is_inner, OMEGA * (x - CENTRE[0]) * is_inner

    level = lambda x, y: np.minimum(radius(x, y) - INNER, OUTER - radius(x, y))
    flow = dp.cut_flow(grid, level, solid_velocity=wall)
    state = flow.steady(0.5)
    px, py = flow.face_positions
    r = radius(px, py)
    b = OMEGA * INNER**2 / (1 - INNER**2 / OUTER**2)
    a = -b / OUTER**2
    is_x = np.arange(r.size) < grid.faces.offsets[1]
    turning = np.where(is_x, CENTRE[1] - py, px - CENTRE[0])
    error = (state["v"] - (a + b / r**2) * turning) * (flow.apertures > 0)
    root_mean_square = np.sqrt(np.sum(flow.apertures * grid.faces.volumes * error**2))

    r = radius(*grid.centres())
    inside = (r > INNER + 0.1) & (r < OUTER - 0.1)
    error_of_p = state["p"] - (a * a * r * r / 2 + 2 * a * b * np.log(r) - b * b / 2 / r**2)
    return root_mean_square, np.max(abs(error)), np.std(error_of_p[inside]), np.max(abs(flow.force(state, 0.5)))


def drag_of(q):
    """The drag of a cylinder for its radius, the viscosity and the mean speed."""
    grid = dp.Grid((24, 16), size=(3.0, 2.0))
    rows = grid.face_centres(0)[1]
    flow = dp.cut_flow(grid, disc(1.03, 0.97, q[0]), SIDES, rtol=1e-13)
    state = flow.steady(q[1], q[2] * grid.join(1.5 * rows * (2 - rows), 0.0))
    return flow.force(state, q[1])[0]


if __name__ == "__main__":
    print("cells      c_D      off        c_L      off         dp      off   balance  seconds  gradient", flush=True)
    for cells in map(int, sys.argv[1:] or ["10", "20", "40"]):
        print(published(cells), flush=True)
    print("\ncells  rms error  order  max error  order")
    older = None
    for n in (16, 32, 64, 128):
        errors = np.array(between_cylinders(n)[:2])
        orders = [np.nan, np.nan] if older is None else np.log2(older / errors)
        print(f"{n:5}  {errors[0]:9.1e}  {orders[0]:5.2f}  {errors[1]:9.1e}  {orders[1]:5.2f}", flush=True)
        older = errors
    print(
        "\nderivative of the drag in radius, viscosity, speed:",
        dp.check.gradient(drag_of, np.array([0.3, 0.1, 1.0])).verdict,
    )
    print(f"lines: channel {lines(channel) + lines(coefficients)}, cylinders {lines(between_cylinders)}")
