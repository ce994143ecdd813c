"""Problems with curved walls by `cut_cells`, beside exact solutions.

Run ``python -m benchmarks.cut_cells`` in the root of the repository. First table: a smooth field around and inside of a
disc, on 16^2 to 128^2 cells; the orders are those of the last three refinements. Second table: quantities with exact
values on 64^2 cells, their order from 32^2 to 128^2 cells, seconds of the value on 64^2 cells, and the verdict of the
check of the gradient on 16^2 cells (the ball has half as many cells along an axis). Third table: a blob of ink that
touches the wall of a rotating cylinder, with advection of order 1 and 2, on 32^2 to 128^2 cells.
"""

from time import perf_counter

import autograd.numpy as np

import sparsedp as dp
from benchmarks.tables import lines

CENTRE = 0.03, -0.021
RADIUS = 0.6183


def distance(x, y):
    return np.sqrt((x - CENTRE[0]) ** 2 + (y - CENTRE[1]) ** 2)


def square(n):
    return dp.Grid((n, n), size=2.0, origin=-1.0)


def field_errors(n, side, condition):
    """Errors of sin(1.7 x + 0.3) exp(0.8 y) + x^2 y: L2, maximum, and relative error of the flux through the wall."""
    grid = square(n)
    level = lambda x, y: side * (distance(x, y) - RADIUS)
    body = dp.cut_cells(grid, level, dp.dirichlet, condition, nullspace="project")
    exact = lambda x, y: np.sin(1.7 * x + 0.3) * np.exp(0.8 * y) + x * x * y
    x, y = body.centroids
    along_x = 1.7 * np.cos(1.7 * x + 0.3) * np.exp(0.8 * y) + 2 * x * y
    along_y = 0.8 * np.sin(1.7 * x + 0.3) * np.exp(0.8 * y) + x * x
    slope = -side * (along_x * (x - CENTRE[0]) + along_y * (y - CENTRE[1])) / distance(x, y)
    values = condition.a * exact(x, y) + condition.b * slope
    c = grid.coordinates(0)
    walls = dp.lift(grid, dp.dirichlet).domain.join(
        exact(-1, c)[None], exact(1, c)[None], exact(c, -1)[:, None], exact(c, 1)[:, None]
    )
    x, y = grid.centres()
    b = 2.25 * np.sin(1.7 * x + 0.3) * np.exp(0.8 * y) - 2 * y
    u = body.solve(b, values, walls)
    error = body.is_fluid * (u - exact(x, y))
    if side < 0 and condition == dp.neumann:  # the level is free
        error = body.is_fluid * (error - np.sum(body.volumes * error) / np.sum(body.volumes))
    flux = np.sum(body.flux(u, values)) / (side * 0.8693302)
    return np.sqrt(np.sum(body.volumes * error**2)), np.max(abs(error)), abs(flux - 1)


def charge(n, radius=0.35):
    """The charge of a wire at the potential 1 in a grounded pipe."""
    grid = square(n)
    level = lambda x, y: np.minimum(distance(x, y) - radius, 0.9 - distance(x, y))
    line = dp.cut_cells(grid, level, solid_boundary=dp.dirichlet)
    on_wire = 1.0 * (distance(*grid.centres()) < 0.6)
    u = line.solve(np.zeros(grid.shape), on_wire)
    return np.sum(line.flux(u, on_wire) * on_wire)


def volume_below(n, radius=RADIUS):
    """The volume below a membrane over a disc."""
    grid = square(n)
    disc = dp.cut_cells(grid, lambda x, y: radius - distance(x, y), solid_boundary=dp.dirichlet)
    return np.sum(disc.volumes * disc.solve(np.ones(grid.shape)))


def mean_temperature(n, radius=RADIUS):
    """The mean temperature of a heated disc that loses heat through its rim: u + du/dn / 2 = 0."""
    grid = square(n)
    level = lambda x, y: radius - distance(x, y)
    disc = dp.cut_cells(grid, level, solid_boundary=dp.robin(1.0, 0.5))
    return np.sum(disc.volumes * disc.solve(np.ones(grid.shape))) / np.sum(disc.volumes)


def ball_volume_below(n, radius=RADIUS):
    """The integral of the solution in a ball, on n / 2 cells along an axis."""
    grid = dp.Grid((n // 2,) * 3, size=2.0, origin=-1.0)
    level = lambda x, y, z: radius - np.sqrt((x - 0.03) ** 2 + (y + 0.021) ** 2 + z**2)
    ball = dp.cut_cells(grid, level, solid_boundary=dp.dirichlet)
    return np.sum(ball.volumes * ball.solve(np.ones(grid.shape)))


QUANTITIES = {  # exact value, and the derivative in the radius
    charge: (2 * np.pi / np.log(0.9 / 0.35), 2 * np.pi / np.log(0.9 / 0.35) ** 2 / 0.35),
    volume_below: (np.pi * RADIUS**4 / 8, np.pi * RADIUS**3 / 2),
    mean_temperature: (RADIUS**2 / 8 + RADIUS / 4, RADIUS / 4 + 0.25),
    ball_volume_below: (4 * np.pi * RADIUS**5 / 45, 4 * np.pi * RADIUS**4 / 9),
}


def rotation_errors(n, order, end=2.0, wall=0.81, speed=1.0):
    """Errors of ink in a fluid that rotates in a cylinder: L1, L2, maximum; relative change of the content."""
    grid = square(n)
    body = dp.cut_cells(grid, lambda x, y: wall - distance(x, y))
    nodes = np.meshgrid(grid.coordinates(0, "nodes"), grid.coordinates(1, "nodes"), indexing="ij")
    through_faces = dp.curl(grid)(np.maximum(wall**2 - distance(*nodes) ** 2, 0.0) / 2)
    v = speed * through_faces / np.where(body.apertures > 0, body.apertures, 1.0)
    x, y = grid.centres()

    def exact(t):
        centre = CENTRE[0] + 0.55 * np.cos(t), CENTRE[1] + 0.55 * np.sin(t)
        return body.is_fluid * np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / 0.04)

    steps = int(np.ceil(2.0 * n))
    dt = end / steps
    u = exact(0.0)
    for _ in range(steps):
        start, u = u, u + dt * body.advection(u, v, order=order)
        if order == 2:  # Heun's method
            u = 0.5 * (start + u + dt * body.advection(u, v, order=order))
    error = u - exact(end)
    content = np.sum(body.volumes * u) / np.sum(body.volumes * exact(0.0)) - 1
    in_square = np.sqrt(np.sum(body.volumes * error**2))
    return np.sum(body.volumes * abs(error)), in_square, np.max(abs(error)), abs(content)


if __name__ == "__main__":
    print("field                   |  L2 error  order | max error  order | flux off by | seconds")
    for side, place in ((1, "around"), (-1, "inside")):
        for condition in (dp.dirichlet, dp.neumann, dp.robin(1.0, 0.5), dp.robin(1.0, 0.01)):
            errors = []
            for n in (16, 32, 64, 128):
                clock = perf_counter()
                errors.append(field_errors(n, side, condition))
                if n == 64:
                    seconds = perf_counter() - clock
            errors = np.array(errors)
            orders = np.log2(errors[0] / errors[-1]) / 3
            size, largest, flux = errors[2]
            in_square = f"{size:9.1e} {orders[0]:6.2f}"
            at_most = f"{largest:9.1e} {orders[1]:6.2f}"
            print(f"{place + ', ' + repr(condition):23} | {in_square} | {at_most} | {flux:11.3%} | {seconds:.2f}")
    print("\nquantity              ours     exact   off by  order  seconds  derivative off by  gradient  lines")
    for quantity, (exact, slope) in QUANTITIES.items():
        radius = quantity.__defaults__[0]
        clock = perf_counter()
        value = quantity(64)
        seconds = perf_counter() - clock
        order = np.log2(abs(quantity(32) - exact) / abs(quantity(128) - exact)) / 2
        derivative = dp.grad(lambda radius, quantity=quantity: quantity(64, radius))(radius)
        verdict = dp.check.gradient(lambda radius, quantity=quantity: quantity(16, radius), radius, quick=True).verdict
        print(
            f"{quantity.__name__:18} {value:8.5f}  {exact:8.5f}  {abs(value / exact - 1):7.3%}  {order:5.2f}  "
            f"{seconds:7.2f}  {abs(derivative / slope - 1):17.2%}  {verdict:8}  {lines(quantity):5}"
        )
    print(f"lines of the scene of the field: {lines(field_errors)}, of the rotation: {lines(rotation_errors)}")
    print("\nadvection, order | L1 error  order | L2 error  order | max error  order | content off by")
    for order in (1, 2):
        errors = np.array([rotation_errors(n, order) for n in (32, 64, 128)])
        orders = np.log2(errors[0, :3] / errors[-1, :3]) / 2
        size, in_square, largest, content = errors[-1]
        print(
            f"{order:16} | {size:8.1e} {orders[0]:6.2f} | {in_square:8.1e} {orders[1]:6.2f} | {largest:9.1e} "
            f"{orders[2]:6.2f} | {content:14.0e}"
        )
    amount = lambda speed: rotation_errors(12, 2, 0.5, speed=speed)[1]
    print(f"gradient of the rotation, order 2: {dp.check.gradient(amount, 1.03, quick=True).verdict}")
