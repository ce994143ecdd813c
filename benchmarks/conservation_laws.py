"""Gas and water that must stay positive, beside exact solutions and fine references: one row a case.

Run ``python -m benchmarks.conservation_laws [name ...] [--quick]`` in the root of the repository; a name is a part of a
case. Columns: case; cells along an axis; the figure, ours and published, exact or of the reference; mean error of the
density or the depth, and its order from half as many cells; seconds of the run, once; the verdict of `check.gradient`
on a sum over the field of few cells; lines of the scene, without comments and without the law of gas.

A scene takes a number of cells and returns (end, p, exact): end(p) is the density or the depth at the end,
differentiable in p; exact is the field to compare with, or None for a reference with four times the cells, in two
dimensions (Lax-Liu) twice the cells along each axis: errors against it are about half of the exact ones.
"""

from time import perf_counter

import autograd.numpy as np

import sparsedp as dp
from benchmarks.tables import lines, print_rows

GAMMA = 1.4
GRAVITY = 9.81


def pressure(u, params=None):
    return (GAMMA - 1) * (u[-1] - 0.5 * np.sum(u[1:-1] ** 2, axis=0) / u[0])


def gas_flux(u, params, axis):
    p = pressure(u)
    rows = [0.0 * p, *(p * (k == axis) for k in range(len(u) - 2)), p * u[1 + axis] / u[0]]
    return u * u[1 + axis] / u[0] + np.stack(rows)


def gas_speeds(u, params, axis):
    v, c = u[1 + axis] / u[0], np.sqrt(GAMMA * pressure(u) / u[0])
    return v - c, v + c


def gas(grid, **options):
    """The law of a gas that keeps density and pressure positive."""
    positive = {"density": lambda u, params: u[0], "pressure": pressure}
    return dp.conservation_law(grid, gas_flux, gas_speeds, positive=positive, **options)


def gas_state(density, p, *velocities):
    """Return density, momenta and energy."""
    kinetic = 0.5 * density * sum(v**2 for v in velocities)
    return np.stack([density, *(density * v for v in velocities), p / (GAMMA - 1) + kinetic])


def run(law, start, end, faster, p=None):
    """Return the first field at a time, where waves become `faster` times as fast as at the start."""
    steps = int(np.ceil(faster * end / law.time_step(start, p, cfl=0.45)))
    return lambda u, params: dp.rollout(dp.stepper("ssprk3", law, end / steps), u, params, steps)[0]


def rarefactions(n):
    """Nearly a vacuum between two rarefactions (Einfeldt and others, J. Comput. Phys. 92, 1991), in the pressure."""
    grid = dp.Grid(n, size=1.0)
    x = grid.centres()[0]
    start = lambda p: gas_state(1.0 + 0 * x, p + 0 * x, np.where(x < 0.5, -2.0, 2.0))
    advance = run(gas(grid), start(0.4), 0.15, 1.1)
    c = np.sqrt(GAMMA * 0.4)
    in_fan = (2 * c + (GAMMA - 1) * (np.abs(x - 0.5) / 0.15 - 2.0)) / (GAMMA + 1)
    exact = (np.clip(in_fan, c - (GAMMA - 1), c) / c) ** (2 / (GAMMA - 1))
    return lambda p: advance(start(p), None), 0.4, exact


def blast(n):
    """Two blast waves between walls that meet (Woodward and Colella, J. Comput. Phys. 54, 1984), in the pressure."""
    grid = dp.Grid(n, size=1.0)
    x = grid.centres()[0]
    start = lambda p: gas_state(1.0 + 0 * x, np.select([x < 0.1, x < 0.9], [p, 0.01], 100.0), 0 * x)
    advance = run(gas(grid, boundary=dp.free_slip, momentum=1), start(1000.0), 0.038, 1.3)
    return lambda p: advance(start(p), None), 1000.0, None


def quadrants(density, p, v, w, end):
    """Four states that meet in the middle of a square (Lax and Liu, SIAM J. Sci. Comput. 19, 1998)."""

    def scene(n):
        grid = dp.Grid((n, n), size=1.0)
        x, y = grid.centres()
        places = [(x > 0.5) & (y > 0.5), (x < 0.5) & (y > 0.5), (x < 0.5) & (y < 0.5), (x > 0.5) & (y < 0.5)]
        pick = lambda values: np.select(places, values)
        start = lambda scale: gas_state(pick(density), scale * pick(p), pick(v), pick(w))
        advance = run(gas(grid), start(1.0), end, 1.3)
        return lambda scale: advance(start(scale), None), 1.0, None

    return scene


def dry_bed(n):
    """A dam of height 1 breaks onto dry ground (Ritter, 1892), in gravity."""
    grid = dp.Grid(n, size=2.0, origin=-1.0)
    x = grid.centres()[0]
    start = np.stack([np.where(x < 0, 1.0, 0.0), 0 * x])
    advance = run(dp.shallow_water(grid, gravity=lambda g: g), start, 0.15, 2.0, GRAVITY)
    c = np.sqrt(GRAVITY)
    return lambda g: advance(start, g), GRAVITY, (2 * c - np.clip(x / 0.15, -c, 2 * c)) ** 2 / (9 * GRAVITY)


def bowl(dim):
    """Water that turns in a parabolic bowl with a plane surface, one period (Thacker, J. Fluid Mech. 107, 1981)."""

    def scene(n):
        grid = dp.Grid((n,) * dim, size=4.0, origin=-2.0)
        x, y = (*grid.centres(), 0.0)[:2]
        turn = np.sqrt(GRAVITY)
        ground = 0.5 * (x**2 + y**2 - 1.0)
        depth = np.maximum(0.5 * x - 0.125 - ground, 0.0)
        start = np.stack([depth, 0 * depth, 0.5 * turn * depth][: dim + 1])
        advance = run(dp.shallow_water(grid, ground, lambda g: g), start, 2 * np.pi / turn, 2.5, GRAVITY)
        return lambda g: advance(start, g), GRAVITY, depth

    return scene


def lake(n):
    """A lake at rest with a row of islands, for 50 steps, in the height of its surface."""
    grid = dp.Grid((n, n), size=1.0)
    x, y = grid.centres()
    ground = 0.5 * np.sin(9 * x) * np.cos(7 * y)
    start = lambda p: np.stack([np.maximum(p - ground, 0.0), 0 * x, 0 * x])
    law = dp.shallow_water(grid, ground, boundary=dp.free_slip)
    step = dp.stepper("ssprk3", law, law.time_step(start(0.1)))
    return lambda p: dp.rollout(step, start(p), None, 50)[0], 0.1, start(0.1)[0]


LAX_3 = quadrants([1.5, 0.5323, 0.138, 0.5323], [1.5, 0.3, 0.029, 0.3], [0, 1.206, 1.206, 0], [0, 0, 1.206, 1.206], 0.3)
LAX_12 = quadrants([0.5313, 1, 0.8, 1], [0.4, 1, 1, 1], [0, 0.7276, 0, 0], [0, 0, 0, 0.7276], 0.25)
# name: scene, figure, its function of the field, what is published (None: exact, or of the reference), cells, few cells
CASES = {
    "Einfeldt 1-2-3": (rarefactions, "density at x = 0.7", lambda rho: rho[7 * len(rho) // 10], None, 400, 40),
    "blast waves": (blast, "largest density", np.max, 6.4, 400, 20),
    "Lax-Liu 3": (LAX_3, "largest density", np.max, None, 100, 8),
    "Lax-Liu 12": (LAX_12, "largest density", np.max, None, 100, 8),
    "dry bed": (dry_bed, "depth at the dam", lambda h: np.mean(h[len(h) // 2 - 1 : len(h) // 2 + 1]), 4 / 9, 400, 20),
    "bowl, 1-D": (bowl(1), "largest depth", np.max, None, 200, 32),
    "bowl, 2-D": (bowl(2), "largest depth", np.max, None, 40, 12),
    "lake with islands": (lake, "largest depth", np.max, None, 32, 8),
}


def coarsened(field, n):
    """Return the means over blocks of cells, n along each axis."""
    for axis in range(field.ndim):
        shape = (*field.shape[:axis], n, -1, *field.shape[axis + 1 :])
        field = np.mean(np.reshape(field, shape), axis=axis + 1)
    return field


def row(name, quick=False):
    """Return cells, our figure, the wanted figure, error, order, seconds, and the verdict on the gradient."""
    scene, _, figure, published, n, few = CASES[name]
    coarse, p, _ = scene(few)
    shape = coarse(p).shape
    weights = np.cos(np.arange(np.prod(shape))).reshape(shape)
    verdict = dp.check.gradient(lambda p: np.sum(weights * coarse(p)), p, quick=True).verdict
    if quick:
        n = few
    if scene(few)[2] is None:
        fine, p, _ = scene((4 if len(shape) == 1 else 2) * n)
        reference = fine(p)
    errors = []
    for cells in (n // 2, n):
        end, p, exact = scene(cells)
        clock = perf_counter()
        ours = end(p)
        seconds = perf_counter() - clock
        if exact is None:
            exact = coarsened(reference, cells)
        errors.append(np.mean(np.abs(ours - exact)))
    wanted = figure(exact) if published is None else published
    return n, figure(ours), wanted, errors[1], np.log2(errors[0] / errors[1]), seconds, verdict


def cells(name, quick):
    """Return the cells of a row of the table."""
    n, ours, wanted, error, order, seconds, verdict = row(name, quick)
    scene, watched, *_ = CASES[name]
    figures = f"{ours:.4f} | {wanted:.4f} | {error:.1e} | {order:.1f} | {seconds:.1f}"
    return f"{n} | {watched} | {figures} | {verdict} | {lines(scene)}"


if __name__ == "__main__":
    columns = "case | cells | figure | ours | wanted | mean error | order | seconds | gradient | lines"
    print_rows(__doc__, columns, CASES, cells)
