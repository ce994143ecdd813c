"""The projection with its gradient beside the plain NumPy + DCT prototype, and what the flow steps reach.

value and gradient of |P v - target|^2 / 2. The prototype is written as a careful NumPy user would: slices and two
transforms, no checks, and the gradient P (P v - target) known by hand. Ours goes over the tape, checks the
velocity and the residual of every solve, and keeps the record. All rows of a size run in turn; smallest times.

Run ``python -m benchmarks.flow [--quick]`` in the root of the repository.
"""

import argparse
from timeit import repeat

import autograd.numpy as anp
import numpy as np
from scipy.fft import dctn, idctn

import sparsedp as dp
from sparsedp import kernels
from sparsedp._utils.counters import recording

LIMIT = 1.2  # value and gradient, over the prototype
SIZES = (128, 256, 512)


def prototype(n):
    """Return the value and gradient function of a projection that uses only NumPy slices and scipy.fft."""
    h = 1 / n
    line = (4 / h**2) * np.sin(np.pi * np.arange(n) / (2 * n)) ** 2
    eigenvalues = line[:, None] + line
    eigenvalues[0, 0] = 1.0
    weights = 1 / eigenvalues
    weights[0, 0] = 0.0

    def project(vx, vy):
        vx, vy = vx.copy(), vy.copy()
        vx[[0, -1]] = 0.0
        vy[:, [0, -1]] = 0.0
        b = (vx[1:] - vx[:-1] + vy[:, 1:] - vy[:, :-1]) / h
        p = idctn(dctn(b, norm="ortho") * weights, norm="ortho")
        vx[1:-1] += (p[1:] - p[:-1]) / h
        vy[:, 1:-1] += (p[:, 1:] - p[:, :-1]) / h
        return vx, vy

    def value_and_gradient(vx, vy, tx, ty):
        wx, wy = project(vx, vy)
        rx, ry = wx - tx, wy - ty
        return 0.5 * (np.sum(rx**2) + np.sum(ry**2)), project(rx, ry)

    return value_and_gradient


def tasks(n):
    """Return the functions to measure, by name, and the error of our gradient relative to that of the prototype."""
    grid = dp.Grid((n, n), size=1.0)
    rng = np.random.default_rng(0)
    v, target = rng.standard_normal((2, grid.faces.size))
    P, parts = dp.projection(grid), (*grid.split(v), *grid.split(target))
    # Half the square of a distance as one rule, so that what is timed is the projection; below it the plain one.
    distance = dp.differentiable(
        "distance",
        lambda u: 0.5 * np.einsum("i,i->", u - target, u - target),
        lambda nums, ans, u: lambda g: (g * (u - target),),
    )
    ours = dp.value_and_grad(lambda v: distance(P(v)))
    plain = dp.value_and_grad(lambda v: 0.5 * anp.sum((P(v) - target) ** 2))
    theirs = prototype(n)
    wanted = grid.join(*theirs(*parts)[1])
    error = np.max(np.abs(ours(v)[1] - wanted)) / np.max(np.abs(wanted))
    found = {
        "NumPy slices and DCT": lambda: theirs(*parts),
        "projection on the tape": lambda: ours(v),
        "the same, loss by autograd": lambda: plain(v),
    }
    with recording() as calls:
        ours(v)
    nodes = sum(many for (name, kind), many in calls.items() if name == "projection" and kind == "forward")
    return found, error, nodes, P.info


def table(n, rounds, calls):
    """Print one block, and say whether the gate holds."""
    found, error, nodes, info = tasks(n)
    best = dict.fromkeys(found, np.inf)
    for _ in range(rounds):
        for name, action in found.items():
            best[name] = min(best[name], *repeat(action, number=1, repeat=calls))
    first = best["NumPy slices and DCT"]
    print(f"\n{n}^2, {kernels.threads()} threads, kernels: {'numba' if kernels.compiled() else 'NumPy'}")
    print(f"{'':28} {'ms':>8} {'ratio':>6} {'limit':>6}")
    for name, seconds in best.items():
        limit = f"{LIMIT:6.2f}" if name == "projection on the tape" else f"{'-':>6}"
        print(f"{name:28} {1e3 * seconds:8.3f} {seconds / first:6.2f} {limit}")
    print(f"nodes on the tape {nodes}, gradient error {error:.0e}, residual {info.forward.residual:.0e}, ", end="")
    print(f"set-up {1e3 * info.setup_seconds:.1f} ms")
    return best["projection on the tape"] <= LIMIT * first


def steps(n, rounds):
    """Print value and gradient of 20 flow steps in a closed box: on the tape, and by the plain forms of the step."""
    grid = dp.Grid((n, n), size=1.0)
    step = dp.flow_step(grid, 0.1 / n, lambda nu: nu)
    state = step.start(np.sin(np.arange(grid.faces.size)), 1e-4)

    def loop(s, nu):
        for _ in range(20):
            s = step(s, nu)
        return s

    ways = {
        "loop on the tape": loop,
        "rollout, each step taped": lambda s, nu: dp.rollout(lambda s, nu: step(s, nu), s, nu, 20),
        "rollout, plain forms": lambda s, nu: dp.rollout(step, s, nu, 20),
    }
    ways = {
        name: dp.value_and_grad(lambda x, go=go: anp.sum(go({**state, "v": x[0]}, x[1])["v"] ** 2))
        for name, go in ways.items()
    }
    best = dict.fromkeys(ways, np.inf)
    for _ in range(rounds):
        for name, action in ways.items():
            best[name] = min(best[name], *repeat(lambda run=action: run((state["v"], 1e-4)), number=1, repeat=2))
    first = best["loop on the tape"]
    print(f"\n20 flow steps, {n}^2\n{'':28} {'ms':>8} {'ratio':>6}")
    for name, seconds in best.items():
        print(f"{name:28} {1e3 * seconds:8.3f} {seconds / first:6.2f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer repeats, small grids only")
    quick = parser.parse_args().quick
    kept = [table(n, 3 if quick else 12, 5) for n in (SIZES[:1] if quick else SIZES)]
    for n in (32, 64):
        steps(n, 3 if quick else 12)
    print(f"\ngate: at most {LIMIT} times the prototype: {'met' if all(kept) else 'missed'}")


if __name__ == "__main__":
    main()
