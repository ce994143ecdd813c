"""Self-test of ranks, ``python -m sparsedp ranks``: versions of MPI and PETSc, and a comparison of two processes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from shutil import which
from sysconfig import get_path
from typing import Any

import autograd.numpy as anp
import numpy as np

from sparsedp.autodiff.derivative import value_and_grad
from sparsedp.grid.boundary_conditions import dirichlet
from sparsedp.grid.grid import Grid
from sparsedp.operators.difference import laplacian
from sparsedp.parallel.distribute import distribute
from sparsedp.solvers.inverse import inverse

__all__ = ["report"]

SECONDS = 300  # timeout of a test; the first one compiles loops
WITHIN = 1e-10  # tolerance, relative to the result of one process
DEBIAN = "apt-get install -y --no-install-recommends"
# Debian keeps petsc4py in a folder of its own, which a virtual environment of its python has to be told.
PETSC4PY = f"ls -d /usr/lib/petscdir/*/*-real/lib/python3/dist-packages > {get_path('purelib')}/petsc.pth"
COMMANDS = {  # for key words of an error, the command that repairs it
    "'mpirun'": f"{DEBIAN} openmpi-bin",
    "'mpi4py'": "python -m pip install mpi4py",
    "'petsc4py'": f"{DEBIAN} python3-petsc4py && {PETSC4PY} (not on Debian: conda install -c conda-forge petsc4py)",
    "run as root": "export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1",
    "numpy.dtype size changed": 'python -m pip install "numpy<2"',
    "another MPI": "python -m pip install --force-reinstall --no-binary mpi4py mpi4py",
}


def report() -> Any:
    """Yield lines on the installed versions and the test of two processes; the last is empty if the test failed."""
    script = [sys.executable, "-m", __name__]
    for command in (script, ["mpirun", "-n", "2", sys.executable, "-m", "mpi4py", *script[1:], "compare"]):
        lines, wrong = run(command)
        yield from lines
        if wrong:
            yield "; write ".join([wrong, *(told for word, told in COMMANDS.items() if word in wrong)])
            yield ""
            return
    yield "ranks work; write mpirun -n 2 python -m mpi4py scene.py"


def run(command: Any) -> Any:
    """Run a command; return the lines that it prints, and a few words on its error (empty without one)."""
    settings = {"OMPI_MCA_rmaps_base_oversubscribe": "1", "OMP_NUM_THREADS": "1", **os.environ}
    try:
        done = subprocess.run(command, env=settings, capture_output=True, text=True, timeout=SECONDS, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return [], str(error)
    told = [line for line in done.stderr.splitlines() if line.strip(" -")] or [f"exit code {done.returncode}"]
    errors = [line for line in told if re.match(r"[\w.]+Error: ", line)] or told
    if done.returncode == 0:
        return done.stdout.splitlines(), ""
    return done.stdout.splitlines(), errors[0]


# ---- in processes of their own ---------------------------------------------------------------------------------------


def versions() -> Any:
    """Yield lines with the versions of the packages that can be imported."""
    yield f"Python {sys.version.split()[0]}, NumPy {np.__version__}, {which('mpirun') or 'no mpirun'}"
    import mpi4py
    from mpi4py import MPI

    yield f"mpi4py {mpi4py.__version__} on {MPI.Get_library_version().split(',')[0].strip()}"
    import petsc4py
    from petsc4py import PETSc

    hypre = "with" if PETSc.Sys.hasExternalPackage("hypre") else "WITHOUT"
    yield f"petsc4py {petsc4py.__version__} for {np.dtype(PETSc.ScalarType)}, {hypre} hypre"


def compare() -> Any:
    """Solve Poisson's equation with a gradient, on all processes and on one; yield one line with the difference."""
    from mpi4py import MPI

    alone = Grid((24, 20), size=1.0)
    results = []
    for grid in (alone, distribute(alone)):
        solution = inverse(-laplacian(grid, dirichlet), rtol=1e-12)
        loss = value_and_grad(lambda b, solution=solution: anp.sum(anp.sin(100.0 * solution(b)) ** 2))
        results.append(loss(np.sin(np.arange(480.0)).reshape(24, 20)))
    off = np.max([np.max(np.abs(found - wanted)) / np.max(np.abs(wanted)) for wanted, found in zip(*results)])
    if not off <= WITHIN:
        raise ArithmeticError(f"a gradient is off by {off:.1e} from one process")
    if MPI.COMM_WORLD.rank == 0:
        yield f"Poisson's equation on {MPI.COMM_WORLD.size} processes: value and gradient within {off:.0e} of one"


if __name__ == "__main__":
    for line in compare() if sys.argv[1:] else versions():
        sys.stdout.write(line + "\n")
