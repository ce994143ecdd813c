"""Mosaic, a public benchmark of differentiable solvers, with this library: errors, gradients, horizons, drag and cost.

Run ``python -m benchmarks.mosaic [parts ...] [--references FOLDER] [--quick]`` in the root of the repository. The parts
are forward, gradients, horizons, drag and cost; all of them by default. The folder holds the stored results of Mosaic
(github.com/pasteurlabs/mosaic) as PROBLEM__EXPERIMENT.npz with `sweep_values` and `reference_0`, `reference_1`, ...;
the environment variable MOSAIC_REFERENCES names it too. Without it the part `forward` is left out.

- forward: the largest error of an experiment, relative as in Mosaic (root mean squares), and seconds of all its cases.
- gradients: the cosine between directional derivatives and differences, for the loss sum(result^2), as in Mosaic; and
  the verdict of `check.gradient` for the same loss.
- horizons: the same after more and more steps, beside how much a small change of the start has grown.
- drag: the inflow of least drag on a cylinder.
- cost: seconds of value and of value and gradient, the memory that the gradient needs, and iterations of the solver.

Seconds are of the processor. The equations, the fields and the settings are those of Mosaic, the code is ours.
"""

import argparse
import os
import tracemalloc
import warnings
from pathlib import Path
from time import process_time

import numpy as np

import sparsedp as dp
from benchmarks.mosaic.cylinders import DragTask, OpenChannel, flux_variation
from benchmarks.mosaic.flows import SpectralFlow, StaggeredFlow, relative_error, several_modes, taylor_green
from benchmarks.mosaic.gradients import agreement, growth, squares
from benchmarks.mosaic.hexahedra import Level
from benchmarks.mosaic.meshes import Cantilever, Slab, random_density, simp

PARTS = ("forward", "gradients", "horizons", "drag", "cost")
ENOUGH = 0.99  # the cosine that Mosaic asks for


class Table:
    """Prints rows of aligned columns under a heading."""

    def __init__(self, heading, **widths):
        self.widths = widths
        print(f"\n{heading}\n" + "".join(f"{name:>{width}}" for name, width in widths.items()))

    def row(self, *values):
        """Print a row."""
        print(
            "".join(f"{value:>{width}}" for value, width in zip(values, self.widths.values(), strict=True)), flush=True
        )


# ---------------------------------------------------------------- forward agreement


def stored(folder, name):
    """Return the pairs of a sweep value and the stored result for it."""
    with np.load(folder / f"{name}.npz") as file:
        return [(value.item(), file[f"reference_{i}"]) for i, value in enumerate(file["sweep_values"])]


def heat(nx, **settings):
    """Return the compliance of the slab with the uniform density 0.5 and a source."""
    slab = Slab(int(nx))
    return slab.compliance(np.full(slab.shape, 0.5), slab.gaussian_source(**settings))


def heat_of_density(density):
    """Return the compliance of the slab with a uniform density."""
    slab = Slab(16)
    return slab.compliance(np.full(slab.shape, density))


def heat_of_random_density(nx):
    """Return the compliance of the slab with a random density."""
    slab = Slab(int(nx))
    return slab.compliance(random_density(slab.shape))


def bending(nx, density=0.5):
    """Return the compliance of the cantilever with a uniform density."""
    beam = Cantilever((int(nx), 2, 4))
    return beam.compliance(np.full(beam.shape, density))


def vortices(solver, n, nu):
    """Return the velocities on 16^3 nodes at the time 0.5, computed on n^3 nodes."""
    flow = solver(n, 3, nu, 0.5 / max(50, n), max(50, n))
    fraction = n // 16
    return flow(taylor_green(n, 3))[::fraction, ::fraction, ::fraction]


def decay(solver, nu, steps):
    """Return the velocities of the vortices in 2-D at the time 1."""
    return solver(64, 2, nu, 1.0 / steps, steps)(taylor_green(64, 2))


def decayed(nu):
    """Return the exact velocities of the vortices in 2-D at the time 1."""
    return np.exp(-2.0 * nu) * taylor_green(64, 2)


FORWARD = {  # name of the row: the stored experiment, and the function of its sweep value
    "heat, uniform density": ("thermal_mesh__forward_agreement", heat_of_density),
    "heat, random density": ("thermal_mesh__forward_baseline", heat_of_random_density),
    "heat, source, meshes": ("thermal_mesh__forward_source_baseline", heat),
    "heat, source, amplitudes": (
        "thermal_mesh__forward_source_linearity",
        lambda amplitude: heat(16, amplitude=amplitude),
    ),
    "elasticity, meshes": ("structural_mesh__forward_baseline", bending),
    "elasticity, densities": ("structural_mesh__forward_agreement", lambda density: bending(8, density)),
    "vortices in 3-D, spectral": (
        "navier_stokes_3d_grid__forward_agreement",
        lambda nu: vortices(SpectralFlow, 16, nu),
    ),
    "the same, flow_step 16^3": (
        "navier_stokes_3d_grid__forward_agreement",
        lambda nu: vortices(StaggeredFlow, 16, nu),
    ),
    "the same, flow_step 32^3": (
        "navier_stokes_3d_grid__forward_agreement",
        lambda nu: vortices(StaggeredFlow, 32, nu),
    ),
    "vortices in 2-D, spectral": ("exact", lambda nu: decay(SpectralFlow, nu, 20)),
    "the same, flow_step 64^2": ("exact", lambda nu: decay(StaggeredFlow, nu, 40)),
    "cylinder, solid cells 64^2": (
        "ns_grid__forward_cylinder",
        lambda nu: OpenChannel(64, nu, 500, solid=True)()[:, :, None],
    ),
    "cylinder, brinkman 64^2": (
        "ns_grid__forward_cylinder",
        lambda nu: OpenChannel(64, nu, 500)()[:, :, None],
    ),
}
QUICK_FORWARD = ("heat, uniform density", "heat, random density", "elasticity, densities", "vortices in 2-D, spectral")
NU_SWEEP = (1e-4, 5e-4, 1e-3, 5e-3, 1e-2, 5e-2)


def show_forward(folder, quick):
    """Print the forward agreement."""
    table = Table("forward agreement", problem=28, cases=7, reference=14, ours=14, error=10, seconds=9)
    for name, (experiment, function) in FORWARD.items():
        if quick and name not in QUICK_FORWARD:
            continue
        if experiment == "exact":
            pairs = [(nu, decayed(nu)) for nu in NU_SWEEP]
        else:
            pairs = stored(folder, experiment)
        began = process_time()
        ours = [function(value) for value, _ in pairs]
        seconds = process_time() - began
        error = max(relative_error(found, reference) for found, (_, reference) in zip(ours, pairs, strict=True))
        last = [f"{np.sqrt(np.mean(np.square(values))):.7g}" for values in (pairs[-1][1], ours[-1])]
        table.row(name, len(pairs), *last, f"{error:.1e}", f"{seconds:.2f}")
    if quick:
        return
    print("  reference and ours: root mean square of the last case; a compliance is one number")
    reference = [velocity[:, :, 0] for _, velocity in stored(folder, "ns_grid__forward_cylinder")]
    variations = ", ".join(f"{flux_variation(velocity):.1%}" for velocity in reference)
    print(f"  the flux of the stored cylinder flows differs between sections x = const by {variations}")
    coarse, middle, fine = (OpenChannel(n, 0.02, 8 * n)(32) for n in (32, 64, 128))
    coarse_error = relative_error(coarse, fine)
    middle_error = relative_error(middle, fine)
    print(
        f"  ours, brinkman on 32^2 and 64^2 beside 128^2, nu = 0.02: {coarse_error:.4f} and {middle_error:.4f}, "
        f"ratio {coarse_error / middle_error:.1f} (order 1: 3, order 2: 5)"
    )


# ---------------------------------------------------------------- gradients


def start_in_2d(quick):
    """Return the velocity on 16^2 nodes that Mosaic starts from, which needs jax; vortices for --quick."""
    if quick:
        return taylor_green(16, 2)
    return several_modes(16)


def gradient_cases(quick):
    """Return the losses and the points of Mosaic's checks of gradients, with the largest relative step."""
    slab = Slab(8)
    beam = Cantilever((8, 2, 4), at_corner=True)
    cases = {
        "heat, density 8x4x1": (slab.compliance, random_density(slab.shape)),
        "elasticity, density 8x2x4": (beam.compliance, random_density(beam.shape)),
        "flow in 2-D, start 16^2": (StaggeredFlow(16, 2, 1e-3, 0.05, 20), start_in_2d(quick)),
    }
    if not quick:
        cases["the same, spectral"] = (SpectralFlow(16, 2, 1e-3, 0.05, 20), several_modes(16))
        cases["flow in 3-D, start 16^3"] = (StaggeredFlow(16, 3, 1e-3, 0.05, 10), taylor_green(16, 3))
    return cases


def show_gradients(quick):
    """Print the gradients beside differences."""
    table = Table("gradients", problem=28, cosine=18, error=10, step=10, verdict=14, digits=8)
    for name, (function, x) in gradient_cases(quick).items():
        loss = squares(function)
        found = agreement(loss, x, steps=(1e-1, 1e-2, 1e-3, 1e-4))
        audit = dp.check.gradient(loss, x, quick=True)
        table.row(
            name, f"1 - {1 - found.cosine:.1e}", f"{found.error:.1e}", found.step, audit.verdict, f"{audit.digits:.0f}"
        )


# ---------------------------------------------------------------- horizons


def show_horizon(name, flow, v, numbers, steps, directions):
    """Print cosines after more and more steps, and where they fall below 0.99."""
    table = Table(f"horizon: {name}", time=8, steps=7, growth=10, norm=10, **{f"cosine {step:g}": 16 for step in steps})
    ends = None
    for number, grown in zip(numbers, growth(flow(numbers[-1]), v, numbers), strict=True):
        found = [agreement(squares(flow(number)), v, (step,), directions) for step in steps]
        cosines = [one.cosine for one in found]
        table.row(f"{number * 0.05:g}", number, f"{grown:.3g}", f"{found[0].norm:.4g}", *[f"{c:.10f}" for c in cosines])
        if cosines[0] < ENOUGH and ends is None:
            ends = number
    if ends is None:
        print(f"  the cosine with steps of {steps[0]:g} stays above {ENOUGH} to the end")
    else:
        print(f"  the cosine with steps of {steps[0]:g} is below {ENOUGH} after {ends} steps, the time {ends * 0.05:g}")


def show_horizons(quick):
    """Print the horizons in 2-D and 3-D."""
    numbers = (5, 20) if quick else (5, 10, 20, 40, 80, 160, 320, 640)
    directions = 1 if quick else 4
    show_horizon(
        "2-D, 16^2, nu = 0.001",
        lambda n: StaggeredFlow(16, 2, 1e-3, 0.05, n),
        start_in_2d(quick),
        numbers,
        (1e-3,),
        directions,
    )
    if not quick:
        show_horizon(
            "3-D, 20^3, nu = 0.001",
            lambda n: StaggeredFlow(20, 3, 1e-3, 0.05, n),
            taylor_green(20, 3),
            (40, 80, 160, 320, 640, 1280),
            (1e-3, 1e-6),
            2,
        )


# ---------------------------------------------------------------- drag


def show_drag(quick):
    """Print the drag before and after the searches."""
    task = DragTask(16, steps=40, dt=0.04) if quick else DragTask()
    searches = {"lbfgs": ("lbfgs", {}, 4 if quick else 200)}
    if not quick:
        searches["adam, rate 5e-4, as Mosaic"] = ("adam", {"rate": 5e-4}, 250)
    table = Table("drag of a cylinder, Re 20", search=28, drag=12, loss=12, inflow=9, gradients=10, seconds=9)
    flat = task.flat()
    table.row("flat inflow", f"{task.drag(flat):.6f}", f"{task.loss(flat):.6f}", f"{np.mean(flat):.4f}", 0, 0)
    for name, (method, settings, iterations) in searches.items():
        began = process_time()
        with np.errstate(over="ignore"):  # a trial of the line search may be an inflow with unstable steps
            best = dp.minimize(task.loss, flat, method, bounds=(0.0, task.LARGEST), maxiter=iterations, **settings)
        seconds = process_time() - began
        drag = task.drag(best.x)
        table.row(
            name, f"{drag:.2e}", f"{best.value:.2e}", f"{np.mean(best.x):.4f}", best.evaluations, f"{seconds:.0f}"
        )


# ---------------------------------------------------------------- cost


def cost_cases(quick):
    """Return losses and points, on meshes and grids of Mosaic's measurements."""

    def thermal(nx):
        slab = Slab(nx)
        return slab.compliance, np.full(slab.shape, 0.5)

    def structural(nx):
        beam = Cantilever((nx, 2, nx // 2))
        return beam.compliance, np.full(beam.shape, 0.5)

    def flow(n, dim, steps):
        return squares(StaggeredFlow(n, dim, 0.01, 0.01, steps)), taylor_green(n, dim)

    if quick:
        return {"heat 16x8x1": thermal(16), "elasticity 8x2x4": structural(8)}
    return {
        "heat 16x8x1": thermal(16),
        "heat 64x32x1": thermal(64),
        "heat 256x128x1": thermal(256),
        "elasticity 16x2x8": structural(16),
        "elasticity 64x2x32": structural(64),
        "flow 64^2, 100 steps": flow(64, 2, 100),
        "flow 128^2, 100 steps": flow(128, 2, 100),
        "flow 256^2, 100 steps": flow(256, 2, 100),
        "flow 16^3, 50 steps": flow(16, 3, 50),
        "flow 32^3, 50 steps": flow(32, 3, 50),
        "flow 64^3, 50 steps": flow(64, 3, 50),
    }


def seconds_of(function, x):
    """Return the least seconds of three calls; each at another point, so that no set-up is reused."""
    times = []
    for trial in range(3):
        point = x * (1.0 + 1e-6 * trial)
        began = process_time()
        function(point)
        times.append(process_time() - began)
    return min(times)


def show_cost(quick):
    """Print seconds and memory."""
    table = Table("cost", problem=28, inputs=10, value=10, gradient=10, ratio=7, MB=8)
    for name, (loss, x) in cost_cases(quick).items():
        both = dp.value_and_grad(loss)
        loss(0.99 * x)  # loops are compiled in the first call
        both(0.98 * x)
        value = seconds_of(loss, x)
        gradient = seconds_of(both, 1.01 * x)
        tracemalloc.start()
        both(1.02 * x)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        table.row(name, x.size, f"{value:.3f}", f"{gradient:.3f}", f"{gradient / value:.1f}", f"{peak / 1e6:.0f}")
    show_iterations(quick)


def iterations(mesh, k, load, preconditioner):
    """Return the number of iterations of conjugate gradients for a load."""
    inverse = dp.inverse(mesh.stiffness(k), "krylov", preconditioner=preconditioner)
    inverse(mesh.free * load)
    return inverse.info.forward.iterations


def show_iterations(quick):
    """Print iterations with a V-cycle and with the diagonal as preconditioner."""
    table = Table("iterations of conjugate gradients", elements=28, density=10, cycle=8, diagonal=10)
    problems = [Slab(16)] if quick else [Slab(16), Slab(32), Cantilever((16, 2, 8)), Cantilever((32, 4, 16))]
    for problem in problems:
        mesh = problem.mesh
        name = f"{type(problem).__name__} {'x'.join(map(str, mesh.shape))}"
        for kind, density in (("0.5", np.full(mesh.shape, 0.5)), ("random", random_density(mesh.shape))):
            k = simp(density)
            level = Level(mesh.shape, mesh.widths, mesh.matrix, k, mesh.free)
            diagonal = dp.diagonal(level.correction.domain, level.inverse_diagonal + 1.0 - mesh.free)
            found = [iterations(mesh, k, problem.load, one) for one in (level.correction, diagonal)]
            table.row(name, kind, *found)


def main(arguments=None):
    """Print the tables that are asked for."""
    parser = argparse.ArgumentParser(description="The problems of Mosaic with this library.")
    parser.add_argument("parts", nargs="*", metavar="part", help=f"of {', '.join(PARTS)}; default: all")
    parser.add_argument("--references", type=Path, metavar="FOLDER", default=os.environ.get("MOSAIC_REFERENCES"))
    parser.add_argument("--quick", action="store_true", help="few small cases")
    options = parser.parse_args(arguments)
    parts = options.parts or PARTS
    for part in parts:
        if part not in PARTS:
            parser.error(f"the parts are {', '.join(PARTS)}, got {part}")
    warnings.simplefilter("ignore", dp.errors.GrowthWarning)  # the growth is a column of the table
    if "forward" in parts:
        if options.references is None:
            print("no stored results: write --references FOLDER for the part forward")
        else:
            show_forward(Path(options.references), options.quick)
    for part, show in {
        "gradients": show_gradients,
        "horizons": show_horizons,
        "drag": show_drag,
        "cost": show_cost,
    }.items():
        if part in parts:
            show(options.quick)


if __name__ == "__main__":
    main()
