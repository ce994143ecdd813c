"""The physics people come with, beside published figures: one row a scene.

Run ``python -m benchmarks.physics [name ...] [--quick]`` in the root of the repository; a name is a part of a case.
Columns: case; what is looked at; ours; published or exact; how far off, relative; seconds of the scene once, imports
and compiling left out; the verdict of `check.gradient` on the same scene with fewer cells; lines of the scene, all
that a user writes for it, without comments and the rates of benchmarks.stiff. ``--quick``: the few cells for both.

A scene takes a number of cells and returns (f, p): f(p) is the number that is looked at, differentiable in p.
"""

from time import perf_counter

import autograd.numpy as np

import sparsedp as dp
from benchmarks import helmholtz, stiff
from benchmarks.tables import lines, print_rows


def hires(tolerance):
    """u6 at the end, in the rate that makes u8 of u6 and u7 (Hairer and Wanner, Solving ODEs II; Mazzia, Magherini)."""

    step = dp.stepper("radau", stiff.hires, 321.8122, tolerance=tolerance, floor=1e-3)
    return lambda k: step(np.array([1.0, 0, 0, 0, 0, 0, 0, 0.0057]), [k, *stiff.HIRES[1:]])[5], stiff.HIRES[0]


def robertson(tolerance):
    """u1 at 1e11, in the logarithm of the slowest rate (Mazzia and Magherini, test set for IVP solvers, 2008)."""

    step = dp.stepper("radau", stiff.robertson, 1e11, tolerance=tolerance, floor=np.array([1e-8, 1e-13, 1.0]))
    return lambda k: step(np.array([1.0, 0.0, 0.0]), [np.exp(k), 1e4, 3e7])[0], np.log(0.04)


def swift_hohenberg(n):
    """Amplitude of rolls close to the threshold: 2 sqrt(r / 3) (Cross and Hohenberg, Rev. Mod. Phys. 65, 1993)."""
    grid = dp.Grid((n, n), size=4 * np.pi, periodic=True)
    L = dp.matrix_function(dp.laplacian(grid), lambda e: -((1 + e) ** 2))
    step = dp.stepper("etdrk4", lambda u, r: r * u - u**3, 8.0, linear=L)
    start = 0.1 * np.cos(grid.centres()[0])
    return lambda r: np.sqrt(2 * np.mean(dp.rollout(step, start, r, 150) ** 2)), 0.01


def cahn_hilliard(n):
    """Energy of a flat interface in a 3-D box: sqrt(8) / 3 (Cahn and Hilliard, J. Chem. Phys. 28, 1958)."""
    grid = dp.Grid((n, 4, 4), spacing=10.0 / n)
    L, G = dp.laplacian(grid), dp.gradient(grid)
    step = dp.stepper("imex", lambda u, p: L(u**3 - 3 * u), 0.2, linear=(2 * L - L @ L))
    start = np.where(grid.centres()[0] < 5.0, -1.0, 1.0)

    def energy(w):
        u = dp.rollout(step, w * start, None, 200)
        return (np.sum((u**2 - 1) ** 2) / 4 + np.sum(G(u) ** 2) / 2) * grid.volumes[0, 0, 0] / (40.0 / n) ** 2

    return energy, 1.0


def bratu(n):
    """u'' + p e^u = 0, u = 0 at both ends: the largest u for p = 1 is 0.1405392 (Ascher, Mattheij, Russell, 1995)."""
    grid = dp.Grid(n, size=1.0)
    L = dp.laplacian(grid, dp.dirichlet)
    return lambda p: dp.steady(lambda u, p: L(u) + p * np.exp(u), np.zeros(n), p)[n // 2], 1.0


def cavity(n):
    """Least u on x = 1/2 at Re 1000 (Botella and Peyret, Computers and Fluids 27, 1998)."""
    grid = dp.Grid((n, n), size=1.0)
    D, G, L, convect = dp.divergence(grid), dp.gradient(grid), dp.face_laplacian(grid), dp.convection(grid)
    inside, lid, pin = dp.interior(grid), dp.face_lift(grid), np.eye(1, n * n).reshape(n, n)
    moving = lid(lid.domain.join(0.0, 0.0, 0.0, 1.0))

    def flow(x, re):
        v, p = x["v"], x["p"]
        momentum = (L(v) + moving) / re - convect(v, v) - G(p)
        return {"v": inside(momentum) + v - inside(v), "p": D(v) + pin * p}

    def least(re):
        x = {"v": np.zeros(grid.faces.size), "p": np.zeros(grid.shape)}
        for number in (100.0, 400.0, re):
            x = dp.steady(flow, x, number, rtol=1e-12)
        u = grid.split(x["v"])[0][n // 2]
        low, top, high = u[np.argmin(u) - 1 + np.arange(3)]
        return top + (high - low) ** 2 / (8 * (2 * top - low - high))

    return least, 1000.0


def convection(n):
    """Mean Nusselt number at Ra 1e5 (de Vahl Davis, Int. J. Numer. Meth. Fluids 3, 1983)."""
    grid, hot = dp.Grid((n, n), size=1.0), {"x": dp.dirichlet}
    D, G, L, convect = dp.divergence(grid), dp.gradient(grid), dp.face_laplacian(grid), dp.convection(grid)
    inside, mean, pin = dp.interior(grid), dp.average(grid), np.eye(1, n * n).reshape(n, n)
    slope, lift, up = dp.gradient(grid, hot), dp.lift(grid, hot), grid.join(0.0, 1.0)
    walls = lift(lift.domain.join(1.0, 0.0, 0.0, 0.0))

    def heat_flow(x):
        return x["v"] * mean(x["T"]) - slope(x["T"]) - walls

    def flow(x, ra):
        v, p = x["v"], x["p"]
        momentum = 0.71 * (L(v) + ra * up * mean(x["T"])) - convect(v, v) - G(p)
        return {"v": inside(momentum) + v - inside(v), "p": D(v) + pin * p, "T": -D(heat_flow(x))}

    def nusselt(ra):
        x = {"v": np.zeros(grid.faces.size), "p": np.zeros(grid.shape), "T": 1 - grid.centres()[0]}
        for number in (1e4, ra):
            x = dp.steady(flow, x, number, rtol=1e-12)
        return np.mean(grid.split(heat_flow(x))[0])

    return nusselt, 1e5


def echo(n):
    """Echo of a jump of the speed from 1 to c in Helmholtz's equation: (c - 1) / (c + 1), forty cells a wavelength."""
    grid = dp.Grid(n)
    (x,), (faces,), omega = grid.centres(), grid.face_centres(0), 2 * np.pi / 40
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
    layer = lambda x: 1 - 2j * np.maximum(1 - np.minimum(x, n - x) / (n / 8), 0) ** 3
    source = np.eye(n)[n // 4]

    def reflected(c):
        far = 1.0 * (x > n / 2)
        u = solve(1 / layer(faces), source, -layer(x) * (omega * (far / c + 1 - far)) ** 2)
        w = solve(1 / layer(faces), source, -layer(x) * omega**2)
        part = slice(n // 4 + 20, n // 2 - 20)
        return np.mean(np.abs(u - w)[part]) / np.mean(np.abs(w[part]))

    return reflected, 2.0


def tensor(n):
    """-div K grad u = f, K = diag(1, 9) turned by an angle, f such that u = sin pi x sin pi y: the largest u."""
    grid = dp.Grid((n, n), size=1.0)
    x, y = grid.centres()
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
    exact = np.sin(np.pi * x) * np.sin(np.pi * y)
    mixed = np.cos(np.pi * x) * np.cos(np.pi * y)

    def middle(angle):
        c, s = np.cos(angle), np.sin(angle)
        kxx, kyy, kxy = c**2 + 9 * s**2, s**2 + 9 * c**2, -8 * s * c
        k = np.array([[kxx, kxy], [kxy, kyy]])[:, :, None, None] * np.ones((n, n))
        u = solve(k, np.pi**2 * ((kxx + kyy) * exact - 2 * kxy * mixed))
        return np.max(u)

    return middle, np.pi / 6


def box_waves(n):
    """A standing wave in a closed 3-D box after one period: what it was, 1, in its speed."""
    grid = dp.Grid((n, n, n), size=1.0)
    D, G = dp.divergence(grid), dp.gradient(grid)
    mode = np.prod([np.cos(np.pi * x) for x in grid.centres()], axis=0)
    steps = 4 * n
    dt = 2 / np.sqrt(3) / steps
    step = dp.stepper("leapfrog", (lambda v, c: -(c**2) * D(v), lambda p, c: -G(p)), dt)

    def after(c):
        start = mode, 0.5 * dt * G(mode)  # half a step earlier
        p, _ = dp.rollout(step, start, c, steps, memory="reverse")
        return np.sum(p * mode) / np.sum(mode**2)

    return after, 1.0


def sponge(n):
    """What comes back from a sponge of two wavelengths, of a pulse of 1: nothing, in the speed of its waves."""
    grid = dp.Grid(n)
    (x,) = grid.centres()
    D, G, thick = dp.divergence(grid), dp.gradient(grid), n // 4
    rates = lambda v, c: -(c**2) * D(v), lambda p, c: -G(p)
    step = dp.stepper("leapfrog", rates, 0.5, damping=dp.sponge(grid, {"x": (thick, thick)}, 1.0))
    pulse = np.exp(-(((x - n / 2) / (n / 40)) ** 2))
    start = pulse, 0 * grid.face_centres(0)[0]
    return lambda c: 1 + np.max(np.abs(dp.rollout(step, start, c, 3 * n)[0])), 1.0


def sod(n):
    """Density between contact and shock, x = 0.75, at t = 0.2 (Sod, J. Comput. Phys. 27, 1978), in gamma."""
    grid = dp.Grid(n, size=1.0)
    (x,) = grid.centres()

    def pressure(u, gamma):
        return (gamma - 1) * (u[2] - 0.5 * u[1] ** 2 / u[0])

    def flux(u, gamma, axis):
        v, p = u[1] / u[0], pressure(u, gamma)
        return np.stack([u[1], u[1] * v + p, v * (u[2] + p)])

    def speed(u, gamma, axis):
        v, c = u[1] / u[0], np.sqrt(gamma * pressure(u, gamma) / u[0])
        return v - c, v + c

    step = dp.stepper("ssprk3", dp.conservation_law(grid, flux, speed), 0.08 / n)
    left = x < 0.5

    def behind(gamma):
        gas = np.stack([np.where(left, 1.0, 0.125), 0 * x, np.where(left, 1.0, 0.1) / (gamma - 1)])
        return dp.rollout(step, gas, gamma, int(2.5 * n))[0, 3 * n // 4]

    return behind, 1.4


def dam(n):
    """Depth behind the wave of a broken dam, 1 m over 0.2 m (Stoker, Water Waves, 1957), in the gravity."""
    grid = dp.Grid(n, size=1.0)
    (x,) = grid.centres()
    flux = lambda u, g, axis: np.stack([u[1], u[1] ** 2 / u[0] + 0.5 * g * u[0] ** 2])
    speed = lambda u, g, axis: (u[1] / u[0] - np.sqrt(g * u[0]), u[1] / u[0] + np.sqrt(g * u[0]))
    water = dp.conservation_law(grid, flux, speed, boundary=dp.free_slip, momentum=1)
    step = dp.stepper("ssprk3", water, 0.08 / n)
    start = np.stack([np.where(x < 0.5, 1.0, 0.2), 0 * x])
    return lambda g: dp.rollout(step, start, g, int(1.25 * n))[0, 13 * n // 20], 9.81


def vortex(n):
    """A vortex of gas that a wind carries once around the plane (Shu, ICASE 97-65): least density, in gamma."""
    grid = dp.Grid((n, n), size=10.0, periodic=True)
    x, y = (c - 5 for c in grid.centres())

    def pressure(u, gamma):
        return (gamma - 1) * (u[3] - 0.5 * (u[1] ** 2 + u[2] ** 2) / u[0])

    def flux(u, gamma, axis):
        v, p = u[1 + axis] / u[0], pressure(u, gamma)
        push = [0 * p, p, 0 * p, p * v] if axis == 0 else [0 * p, 0 * p, p, p * v]
        return v * u + np.stack(push)

    def speed(u, gamma, axis):
        v, c = u[1 + axis] / u[0], np.sqrt(gamma * pressure(u, gamma) / u[0])
        return v - c, v + c

    law = dp.conservation_law(grid, flux, speed)
    step = dp.stepper("ssprk3", law, 1 / n)

    def least(gamma):
        turn = 5 / (2 * np.pi) * np.exp(0.5 * (1 - x**2 - y**2))
        heat = 1 - (gamma - 1) / (2 * gamma) * turn**2
        rho = heat ** (1 / (gamma - 1))
        v, w, p = 1 - turn * y, 1 + turn * x, rho * heat
        gas = np.stack([rho, rho * v, rho * w, p / (gamma - 1) + 0.5 * rho * (v**2 + w**2)])
        return np.min(dp.rollout(step, gas, gamma, 10 * n)[0]) / np.min(rho)

    return least, 1.4


CASES = {  # name: scene, number that is looked at, what is published or exact, cells (or tolerance), few cells
    "HIRES": (hires, "u6", 0.006238968252742796, 1e-8, 1e-9),
    "Robertson, 1e11": (robertson, "u1", 2.083340149701255e-8, 1e-8, 1e-9),
    "Swift-Hohenberg, r 0.01": (swift_hohenberg, "amplitude of rolls", 2 * np.sqrt(0.01 / 3), 64, 16),
    "Cahn-Hilliard, 3-D": (cahn_hilliard, "energy of an interface", np.sqrt(8) / 3, 64, 16),
    "Bratu, p = 1": (bratu, "largest u", 0.1405392, 257, 33),
    "cavity, Re 1000": (cavity, "min u", -0.3885698, 128, 24),
    "convection, Ra 1e5": (convection, "Nu", 4.519, 64, 16),
    "Helmholtz, two speeds": (echo, "echo of the jump", 1 / 3, 3200, 640),
    "Helmholtz, 2-D": (helmholtz.slanted, "echo of a slanted wave", helmholtz.FRESNEL, 1040, 160),
    "diffusion by a tensor": (tensor, "largest u", 1.0, 128, 16),
    "waves in a box, 3-D": (box_waves, "after one period", 1.0, 48, 12),
    "waves into a sponge": (sponge, "1 + echo", 1.0, 400, 200),
    "Sod's tube": (sod, "density at x = 0.75", 0.26557371, 400, 40),
    "dam break": (dam, "depth at x = 0.65", 0.5078714345, 400, 40),
    "vortex of gas, 2-D": (vortex, "least density", 1.0, 64, 16),
}


def row(name, quick):
    """Return our number, its error, the seconds, and the verdict on its gradient."""
    scene, _, published, n, few = CASES[name]
    coarse, p = scene(few)
    verdict = dp.check.gradient(coarse, p, quick=True).verdict
    clock = perf_counter()
    fine, p = scene(few if quick else n)
    ours = float(fine(p))
    return ours, abs(ours / published - 1), perf_counter() - clock, verdict


def cells(name, quick):
    """Return the cells of a row of the table."""
    ours, off, seconds, verdict = row(name, quick)
    scene, watched, published, *_ = CASES[name]
    return f"{watched} | {ours:.6g} | {published:.6g} | {off:.1e} | {seconds:.2f} | {verdict} | {lines(scene)}"


if __name__ == "__main__":
    print_rows(__doc__, "case | figure | ours | published | off | seconds | gradient | lines", CASES, cells)
