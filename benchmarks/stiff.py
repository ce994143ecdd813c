"""Error against run time on small stiff systems: radau beside Radau and BDF of SciPy, with gradients.

The error is the largest of |u - exact| / (|exact| + floor) at the end; SciPy gets atol = tolerance * floor, so all aim
at the same. They take the same rate and no Jacobian. `ratio`: our seconds over those of SciPy's Radau at the same
error, between its rows. The gradient is that of one number of the end in the logarithm of each parameter; its error is
relative to its norm.

Exact states and gradients: SciPy's Radau with rtol 1e-10 on the rate with its variational equation (``--reference``
prints them; of E5 the gradient is a difference of its runs, good to 1e-6); Prothero and Robinson's is known. Errors
below 1e-9 are those of the reference, too.

``--grids``: reactions on grids with about 10 000 unknowns, rodas5p beside Radau and BDF of SciPy with `jac_sparsity`.
The reference of their errors is rodas5p with a tolerance of 1e-8; the rows of SciPy show that it is right. The time of
the gradient is that of value and gradient together, in times of the value; "refused" is a DerivativeError, as the
tolerance is too coarse for the derivative.

Run ``python -m benchmarks.stiff [--quick] [--grids] [--out FOLDER]`` in the root of the repository.
"""

import argparse
from functools import partial
from pathlib import Path
from time import perf_counter

import autograd.numpy as anp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag
from scipy.sparse import kron

import sparsedp as dp


def robertson(u, p):
    """A -> B, B + C -> A + C, 2 B -> B + C."""
    slow, back, fast = p[0] * u[0], p[1] * u[1] * u[2], p[2] * u[1] ** 2
    return anp.array([back - slow, slow - back - fast, fast])


def hires(u, p):
    """High irradiance responses of photomorphogenesis (Schaefer 1975)."""
    k1, k2, k3, k4, k5, k6, meeting, k7 = p
    meet = meeting * u[5] * u[7]
    return anp.array(
        [
            -k1 * u[0] + k2 * u[1] + k6 * u[2] + 0.0007,
            k1 * u[0] - (k2 + k3) * u[1],
            -(k6 + k1) * u[2] + k2 * u[3] + k5 * u[4],
            k3 * u[1] + k1 * u[2] - (k4 + k2) * u[3],
            -(k5 + k1) * u[4] + k2 * (u[5] + u[6]),
            -meet + k4 * (u[3] + u[6]) + k1 * u[4] - k2 * u[5],
            meet - k7 * u[6],
            k7 * u[6] - meet,
        ]
    )


def van_der_pol(u, p):
    """Slow for a time of mu, and a jump in 1 / mu."""
    return anp.array([u[1], p[0] * (1 - u[0] ** 2) * u[1] - u[0]])


def orego(u, p):
    """The Oregonator (Field and Noyes 1974)."""
    return anp.array(
        [p[0] * (u[1] + u[0] * (1 - p[1] * u[0] - u[1])), (u[2] - (1 + u[0]) * u[1]) / p[0], p[2] * (u[0] - u[2])]
    )


def e5(u, p):
    """Chemical pyrolysis (Enright, Hull and Lindberg 1975)."""
    a, b, c = p[0] * u[0], p[1] * u[0] * u[2], p[2] * 1e6 * u[1] * u[2]
    d = p[2] * u[3]
    return anp.array([-a - b, a - c, a - b - c + d, b - d])


def prothero(u, p, t):
    """-1e6 (u - p cos t) - p sin t: u = p cos t."""
    return anp.array([-1e6 * (u[0] - p[0] * anp.cos(t)) - p[0] * anp.sin(t)])


HIRES = [1.71, 0.43, 8.32, 0.69, 0.035, 8.32, 280.0, 1.81]
SCENES = {  # rate, start, params, end, number that is looked at, floor
    "Robertson, 50": (robertson, [1.0, 0, 0], [0.04, 1e4, 3e7], 50.0, 2, [1e-3, 1e-6, 1e-3]),
    "Robertson, 4e7": (robertson, [1.0, 0, 0], [0.04, 1e4, 3e7], 4e7, 2, [1e-6, 1e-11, 1e-2]),
    "HIRES": (hires, [1.0, 0, 0, 0, 0, 0, 0, 0.0057], HIRES, 321.8122, 5, [1e-3] * 8),
    "van der Pol, 1000": (van_der_pol, [2.0, 0.0], [1000.0], 2000.0, 0, [0.1, 1e-3]),
    "OREGO": (orego, [1.0, 2.0, 3.0], [77.27, 8.375e-6, 0.161], 360.0, 1, [1.0, 1.0, 1.0]),
    "E5": (e5, [1.76e-3, 0, 0, 0], [7.89e-10, 1.1e7, 1.13e3], 1e5, 1, [1e-6, 1e-15, 1e-15, 1e-15]),
    "Prothero-Robinson": (prothero, [1.0], [1.0], 5.0, 0, [0.1]),
}
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
EXACT = {  # state at the end, derivative in the logarithms of the params
    "Robertson, 50": (
        [0.6928771641521915, 8.344239514281457e-06, 0.3071144916082925],
        [0.17883267408230286, -0.1487887030083044, 0.07439552853354561],
    ),
    "Robertson, 4e7": (
        [5.20307184411703e-05, 2.0813357318911267e-10, 0.999947969073425],
        [0.0001039659539466278, -0.00010396531406907325, 5.1982867013740734e-05],
    ),
    "HIRES": (
        [
            0.0007371312573325896,
            0.00014424857263162295,
            5.8887297409679966e-05,
            0.0011756513432831916,
            0.002386356198832007,
            0.006238968252744013,
            0.002849998395187059,
            0.002850001604812934,
        ],
        [
            -0.0015894443848579244,
            0.19977273553126043,
            -3.8592012637943195e-05,
            0.3180980333804039,
            9.790873661194322e-05,
            -2.9464601353048974e-07,
            -0.014550360553956285,
            -0.819570907996197,
        ],
    ),
    "van der Pol, 1000": ([1.7061677321704865, -0.0008928097010248124], [1.7847935434610434]),
    "OREGO": (
        [1.0008148703185227, 1228.178521549928, 132.0554942846868],
        [7841.580997863524, -2385.6351354853887, -2787.2772968678128],
    ),
    "E5": (
        [7.48132082151389e-06, 2.3734781556722314e-12, 2.2123586691059546e-12, 1.6111948715348128e-13],
        [-3.558335226918871e-13, -2.392312044297875e-12, -3.3694942941565305e-13],
    ),
    "Prothero-Robinson": ([0.28366218546322625], [0.28366218546322625]),
}


def by_scipy(name, method, tolerance):
    """The state at the end."""
    rate, start, params, end, _, floor = SCENES[name]
    p, atol = np.array(params), tolerance * np.array(floor)
    return solve_ivp(right(rate, p), (0, end), start, method, rtol=tolerance, atol=atol, t_eval=[end]).y[:, -1]


def right(rate, p):
    """f(t, u)."""
    return (lambda t, u: rate(u, p, t)) if rate is prothero else (lambda t, u: rate(u, p))


def reference(name):
    """(state, derivative of one number in the logarithm of each parameter)."""
    rate, start, params, end, number, floor = SCENES[name]
    if rate is prothero:
        return [np.cos(end)], [np.cos(end)]
    p, n, m = np.array(params), len(start), len(params)
    of_u = lambda u, p: complex_step(lambda u: rate(u, p), u)
    of_p = lambda u, p: complex_step(lambda p: rate(u, p), p)

    def both(t, z):
        u, S = z[:n], z[n:].reshape(n, m)
        return np.concatenate([rate(u, p), (of_u(u, p) @ S + of_p(u, p) * p).ravel()])

    def linearised(t, z):  # without the second derivatives: good enough for Newton's method
        J = of_u(z[:n], p)
        return block_diag(J, np.kron(J, np.eye(m)))

    atol = 1e-10 * np.concatenate([floor, np.repeat(floor, m)])
    start = [*start, *[0.0] * (n * m)]
    run = solve_ivp(both, (0, end), start, "Radau", rtol=1e-10, atol=atol, t_eval=[end], jac=linearised)
    return run.y[:n, -1].tolist(), run.y[n:, -1].reshape(n, m)[number].tolist()


def complex_step(fun, x):
    """The derivative of an analytic function, exact to rounding."""
    return np.array([fun(x + 1e-40j * unit).imag for unit in np.eye(x.size)]).T / 1e-40


def by_us(name, tolerance):
    """(function of the params: the state at the end, the step)."""
    rate, start, _, end, _, floor = SCENES[name]
    step, start = dp.stepper("radau", rate, end, tolerance=tolerance, floor=np.array(floor)), np.array(start)
    return (lambda p: step((start, 0.0), p)[0]) if rate is prothero else (lambda p: step(start, p)), step


def fastest(task, repeats):
    """(result, least of a few times)."""
    best = np.inf
    for _ in range(repeats):
        clock = perf_counter()
        result = task()
        best = min(best, perf_counter() - clock)
    return result, best


def row(name, tolerance, repeats):
    """(tolerance, steps, (error, seconds) of each solver, (error of the gradient, time of gradient / value))."""
    _, _, params, _, number, floor = SCENES[name]
    state, slopes = map(np.array, EXACT[name])
    p, (run, step) = np.array(params), by_us(name, tolerance)
    solvers = lambda: run(p), lambda: by_scipy(name, "Radau", tolerance), lambda: by_scipy(name, "BDF", tolerance)
    pairs = [fastest(solver, repeats) for solver in solvers]
    errors = [(np.max(np.abs(u - state) / (np.abs(state) + floor)), seconds) for u, seconds in pairs]
    both, times = dp.value_and_grad(lambda p: run(p)[number]), []
    try:
        for _ in range(3 if pairs[0][1] > 0.02 else 25):  # in turns: a busy machine slows both
            ((_, g), seconds), (_, alone) = fastest(lambda: both(p), 1), fastest(solvers[0], 1)
            times.append(seconds / alone)
        gradient = np.linalg.norm(g * p - slopes) / np.linalg.norm(slopes), np.median(times)
    except dp.errors.DerivativeError:
        gradient = np.nan, np.nan
    return tolerance, len(step.taken), errors, gradient


def ratios(found):
    """Our seconds divided by the seconds of Radau at the same error, by lines between its rows."""
    ours, theirs = (np.log([row[2][k] for row in found]) for k in (0, 1))
    theirs = theirs[np.argsort(theirs[:, 0])]
    at = np.interp(ours[:, 0], *theirs.T, left=np.nan, right=np.nan)
    return np.exp(ours[:, 1] - at)


HEAD = "tolerance steps |   ours: error    ms |  Radau: error    ms |    BDF: error    ms | ratio | gradient x value"


def table(name, found):
    """Text."""
    print(f"\n{name}\n  {HEAD}")
    for (tolerance, steps, errors, (error, times)), ratio in zip(found, ratios(found), strict=True):
        cells = " | ".join(f"{one:12.1e} {1e3 * seconds:6.0f}" for one, seconds in errors)
        print(f"  {tolerance:9.0e} {steps:5} | {cells} | {ratio:5.2f} | {error:8.1e} {times:7.1f}", flush=True)


def picture(found, folder):
    """Error against seconds, one panel for each problem."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 6), layout="constrained")
    *axes, last = figure.subplots(2, 4).ravel()
    for ax, (name, part) in zip(axes, found.items(), strict=True):
        for k, label in enumerate(("radau (ours)", "Radau (SciPy)", "BDF (SciPy)")):
            ax.loglog(*np.array([row[2][k] for row in part]).T[::-1], ".-", label=label)
        ax.set(title=name, xlabel="seconds", ylabel="error")
        ax.xaxis.set_minor_formatter("")  # within one decade its labels overlap
    last.axis("off")
    last.legend(*axes[0].get_legend_handles_labels(), frameon=False, loc="center")
    Path(folder).mkdir(exist_ok=True)
    figure.savefig(Path(folder) / "stiff.png", dpi=150)


# ---- reactions on grids ----------------------------------------------------------------------------------------------


def brusselator(cells):
    """(rate, start, params, end): two species, Neumann walls, diffusion numbers of 100 and more in a step."""
    grid = dp.Grid(cells, size=1.0)
    spread = dp.laplacian(grid, dp.neumann)

    def rate(s, p):
        reaction = s["u"] ** 2 * s["v"]
        u = p["a"] - (p["b"] + 1) * s["u"] + reaction + p["D"] * spread(s["u"])
        return {"u": u, "v": p["b"] * s["u"] - reaction + p["D"] * spread(s["v"])}

    wave = np.cos(2 * np.pi * grid.centres()[0]) * np.cos(np.pi * grid.centres()[-1])
    return rate, {"u": 1.0 + 0.8 * wave, "v": 3.0 - wave}, {"a": 1.0, "b": 3.0, "D": 0.02}, 5.0


def robertson_on_a_line(cells):
    """(rate, start, params, end): three species with rate constants over nine decades, and diffusion."""
    grid = dp.Grid(cells, size=1.0)
    spread = dp.laplacian(grid, dp.neumann)

    def rate(s, p):
        slow, back, fast = p["k"][0] * s["a"], p["k"][1] * s["b"] * s["c"], p["k"][2] * s["b"] ** 2
        terms = {"a": back - slow, "b": slow - back - fast, "c": fast}
        return {name: terms[name] + p["D"] * spread(s[name]) for name in s}

    (x,) = grid.centres()
    start = {"a": 1.0 + 0.5 * np.cos(np.pi * x), "b": 0.0 * x, "c": 0.1 * x}
    return rate, start, {"k": np.array([0.04, 1e4, 3e7]), "D": 1e-3}, 40.0


GRIDS = {  # scene, size of the cells of its grid, floor
    "Brusselator, 70 x 70": (brusselator, (70, 70), 1e-1),
    "Brusselator, 5000": (brusselator, 5000, 1e-1),
    "Robertson, 3333": (robertson_on_a_line, 3333, {"a": 0.1, "b": 1e-6, "c": 0.1}),
}


def flat(tree):
    """One array."""
    return np.concatenate([np.ravel(leaf) for leaf in tree.values()])


def floors_of(start, floor):
    """The floor of each number of a state."""
    if not isinstance(floor, dict):
        floor = dict.fromkeys(start, floor)
    return flat({name: np.full(u.shape, floor[name]) for name, u in start.items()})


def pattern_of(rate, start, p):
    """The sparsity pattern of the Jacobian: all species of a cell and of its neighbours."""
    shape = next(iter(start.values())).shape
    stencil = abs(dp.laplacian(dp.Grid(shape), dp.neumann).matrix)
    return kron(np.ones((len(start), len(start))), stencil, "csc")


def on_a_grid(name, tolerances, methods):
    """Print one row for each tolerance."""
    scene, cells, floor = GRIDS[name]
    rate, start, p, end = scene(cells)
    sizes = [u.size for u in start.values()]
    floors = floors_of(start, floor)
    pattern = pattern_of(rate, start, p)

    def numbers(t, z):
        parts = np.split(z, np.cumsum(sizes)[:-1])
        fields = {key: part.reshape(start[key].shape) for key, part in zip(start, parts, strict=True)}
        return flat(rate(fields, p))

    def by_us(tolerance):
        step = dp.stepper("rodas5p", rate, end, tolerance=tolerance, floor=floor)
        return step, lambda p: step(start, p)

    def error_of(new):
        return np.max(np.abs(flat(new) - reference) / (np.abs(reference) + floors))

    reference = flat(by_us(1e-8)[1](p))
    print(f"\n{name}: {sum(sizes)} unknowns\n  tolerance steps | rodas5p: error     s | gradient x value", end="")
    print("".join(f" | {method}: error     s" for method in methods), flush=True)
    for tolerance in tolerances:
        step, run = by_us(tolerance)
        run(p)  # the pattern is found in the first call
        new, seconds = fastest(partial(run, p), 1)
        text = f"  {tolerance:9.0e} {len(step.taken):5} | {error_of(new):14.1e} {seconds:5.1f}"
        text += f" | {times_of_gradient(run, p):>16}"
        for method in methods:
            settings = {"rtol": tolerance, "atol": tolerance * floors, "jac_sparsity": pattern}
            solve = partial(solve_ivp, numbers, (0, end), flat(start), method, **settings)
            theirs, seconds = fastest(solve, 1)
            error = np.max(np.abs(theirs.y[:, -1] - reference) / (np.abs(reference) + floors))
            text += f" | {error:12.1e} {seconds:5.1f}"
        print(text, flush=True)


def times_of_gradient(run, p, laps=3):
    """Text: time of value and gradient over that of the value, in turn: a busy machine slows both."""
    both = dp.value_and_grad(lambda p: anp.mean(next(iter(run(p).values())) ** 2))
    ratios = []
    try:
        both(p)
    except dp.errors.DerivativeError:
        return "refused"
    for _ in range(laps):
        ratios.append(fastest(partial(both, p), 1)[1] / fastest(partial(run, p), 1)[1])
    return f"{np.median(ratios):.1f}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--reference", action="store_true", help="print exact states and gradients: a quarter of an hour"
    )
    parser.add_argument("--quick", action="store_true", help="three tolerances, one run each")
    parser.add_argument("--out", help="folder of a picture")
    parser.add_argument("--grids", action="store_true", help="reactions on grids in place of small systems")
    given, found = parser.parse_args(), {}
    if given.grids:
        for scene in GRIDS:
            on_a_grid(scene, TOLERANCES[:3] if given.quick else TOLERANCES[:4], ("Radau", "BDF"))
        raise SystemExit
    for scene in SCENES:
        if given.reference:
            print(f'    "{scene}": {tuple(reference(scene))},', flush=True)
            continue
        tolerances, repeats = (TOLERANCES[1::2], 1) if given.quick else (TOLERANCES, 3)
        found[scene] = [row(scene, tolerance, repeats) for tolerance in tolerances]
        table(scene, found[scene])
    if given.out and found:
        picture(found, given.out)
