"""What the first use on a machine costs: each scene in a fresh process with an empty cache of compiled loops.

Prints the wall-clock seconds from `import sparsedp` to the result and the number of loops compiled, for a first run and
for a second run that uses the loops on disk. Limits: 5 s, and 15 s for scenes with a structured solve.

Run ``python -m benchmarks.cold_start [--only NAME]`` in the root of the repository.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

__all__ = ["SCENES"]

START = """
import autograd.numpy as anp
import numpy as np
import sparsedp as dp
random = np.random.default_rng(0)
"""
SCENES = {  # name -> (gate [s], a program)
    "stencil, value and gradient": (
        5,
        """
grid = dp.Grid((300, 300), size=1.0)
laplacian = dp.laplacian(grid, dp.dirichlet).matrix_free()
dp.value_and_grad(lambda u: anp.sum(laplacian(u) ** 2))(random.random(grid.shape))
""",
    ),
    "upwind, ten steps and gradient": (
        5,
        """
grid = dp.Grid((300, 300), size=1.0)
move, wind = dp.transport(grid, "upwind"), 0.1 * random.random(grid.faces.size)
rolled = lambda u: anp.sum(dp.rollout(lambda u, v: move(u, v, 1e-3), u, wind, 10) ** 2)
dp.value_and_grad(rolled)(random.random(grid.shape))
""",
    ),
    "semi-Lagrangian, ten steps and gradient": (
        5,
        """
grid = dp.Grid((300, 300), size=1.0)
move, wind = dp.transport(grid, "semi_lagrangian"), 0.1 * random.random(grid.faces.size)
rolled = lambda u: anp.sum(dp.rollout(lambda u, v: move(u, v, 1e-3), u, wind, 10) ** 2)
dp.value_and_grad(rolled)(random.random(grid.shape))
""",
    ),
    "structured solve and adjoint": (
        15,
        """
grid = dp.Grid((300, 300), size=1.0)
k = dp.harmonic_average(grid)(np.exp(random.random(grid.shape)))
op = -dp.divergence(grid) @ dp.diagonal(grid.faces, k) @ dp.gradient(grid, dp.dirichlet)
solve = dp.inverse(op, method="structured")
dp.value_and_grad(lambda b: anp.sum(solve(b) ** 2))(random.random(grid.shape))
""",
    ),
    "structured in 3-D": (
        15,
        """
grid = dp.Grid((40, 40, 40), size=1.0)
solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet), method="structured")
k = np.exp(random.random(grid.faces.size))
dp.value_and_grad(lambda k: anp.sum(solve(k, np.ones(grid.shape)) ** 2))(k)
""",
    ),
    "ink, wind and pressure (README)": (
        15,
        """
grid = dp.Grid((64, 64), size=1.0)
carry, project = dp.transport(grid, "upwind"), dp.projection(grid)
def loss(wind):
    ink = dp.rollout(lambda ink, wind: carry(ink, wind, 0.0025), random.random(grid.shape), project(wind), 40)
    return anp.sum(ink**2)
dp.value_and_grad(loss)(1e-2 * random.random(grid.faces.size))
""",
    ),
}


def seconds(program, cache):
    """Run a program in a process of its own, and return the elapsed seconds."""
    start = time.perf_counter()
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    subprocess.run([sys.executable, "-c", START + program], env=environment, check=True, capture_output=True)
    return time.perf_counter() - start


def loops(cache):
    """How many compiled functions stand in a cache: numba writes an index for each."""
    return len(list(Path(cache).rglob("*.nbi")))


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--only", help="scenes with this in their name")
    only = parser.parse_args().only or ""
    print(f"{'':42}{'first [s]':>10}{'gate':>6}{'loops':>7}{'again [s]':>11}")
    for name, (gate, program) in SCENES.items():
        if only in name:
            with tempfile.TemporaryDirectory() as cache:
                first = seconds(program, cache)
                print(f"{name:42}{first:10.1f}{gate:6}{loops(cache):7}{seconds(program, cache):11.1f}", flush=True)


if __name__ == "__main__":
    main()
