"""Self-test of ranks, ``python -m sparsedp ranks``: versions of MPI and PETSc, and a comparison of two processes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from shutil import which
from sysconfig import get_path

import autograd.numpy as anp
import numpy as np

from sparsedp.autodiff.derivative import value_and_grad
from sparsedp.grid.boundary_conditions import dirichlet
from sparsedp.grid.grid import Grid
from sparsedp.operators.difference import laplacian
from sparsedp.parallel.distribute import distribute
from sparsedp.solvers.inverse import inverse

__all__ = ["report"]

TIMEOUT = 300  # seconds of a test; the first one compiles loops
TOLERANCE = 1e-10  # relative to the result of one process
DEBIAN = "apt-get install -y --no-install-recommends"
# Debian has petsc4py in a folder of its own, which must be added to the path of a virtual environment.
PETSC4PY = f"ls -d /usr/lib/petscdir/*/*-real/lib/python3/dist-packages > {get_path('purelib')}/petsc.pth"
COMMANDS = {  # for key words of an error, the command that repairs it
    "'mpirun'": f"{DEBIAN} openmpi-bin",
    "'mpi4py'": "python -m pip install mpi4py",
    "'petsc4py'": f"{DEBIAN} python3-petsc4py && {PETSC4PY} (not on Debian: conda install -c conda-forge petsc4py)",
    "run as root": "export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1",
    "numpy.dtype size changed": 'python -m pip install "numpy<2"',
    "another MPI": "python -m pip install --force-reinstall --no-binary mpi4py mpi4py",
}


def report() -> Iterator[str]:
    """Yield lines on the installed versions and the test of two processes; the last is empty if the test failed."""
    show_versions = [sys.executable, "-m", __name__]
    compare_results = ["mpirun", "-n", "2", sys.executable, "-m", "mpi4py", "-m", __name__, "compare"]
    for command in (show_versions, compare_results):
        lines, error = run(command)
        yield from lines
        if error:
            repairs = [repair for word, repair in COMMANDS.items() if word in error]
            yield "; write ".join([error, *repairs])
            yield ""
            return
    yield "ranks work; write mpirun -n 2 python -m mpi4py scene.py"


def run(command: Sequence[str]) -> tuple[list[str], str]:
    """Run a command; return the lines that it prints, and its error message, empty if it succeeds."""
    settings = {"OMPI_MCA_rmaps_base_oversubscribe": "1", "OMP_NUM_THREADS": "1", **os.environ}
    try:
        process = subprocess.run(command, env=settings, capture_output=True, text=True, timeout=TIMEOUT, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return [], str(error)
    lines = process.stdout.splitlines()
    if process.returncode == 0:
        return lines, ""
    messages = [line for line in process.stderr.splitlines() if line.strip(" -")]
    errors = [line for line in messages if re.match(r"[\w.]+Error: ", line)]
    return lines, [*errors, *messages, f"exit code {process.returncode}"][0]


# ---- in processes of their own ---------------------------------------------------------------------------------------


def versions() -> Iterator[str]:
    """Yield lines with the versions of the packages that can be imported."""
    yield f"Python {sys.version.split()[0]}, NumPy {np.__version__}, {which('mpirun') or 'no mpirun'}"
    import mpi4py
    from mpi4py import MPI

    yield f"mpi4py {mpi4py.__version__} on {MPI.Get_library_version().split(',')[0].strip()}"
    import petsc4py
    from petsc4py import PETSc

    hypre = "WITHOUT"
    if PETSc.Sys.hasExternalPackage("hypre"):
        hypre = "with"
    yield f"petsc4py {petsc4py.__version__} for {np.dtype(PETSc.ScalarType)}, {hypre} hypre"


def compare() -> Iterator[str]:
    """Solve Poisson's equation with a gradient, on all processes and on one; yield one line with the difference."""
    from mpi4py import MPI

    grid_on_one = Grid((24, 20), size=1.0)
    results = []
    for grid in (grid_on_one, distribute(grid_on_one)):
        solution = inverse(-laplacian(grid, dirichlet), rtol=1e-12)
        loss = value_and_grad(lambda b, solution=solution: anp.sum(anp.sin(100.0 * solution(b)) ** 2))
        results.append(loss(np.sin(np.arange(480.0)).reshape(24, 20)))
    errors = []
    for expected, value in zip(*results, strict=True):
        errors.append(np.max(np.abs(value - expected)) / np.max(np.abs(expected)))
    error = np.max(errors)
    if not error <= TOLERANCE:
        raise ArithmeticError(f"a gradient differs by {error:.1e} (relative) from that of one process")
    if MPI.COMM_WORLD.rank == 0:
        yield f"Poisson's equation on {MPI.COMM_WORLD.size} processes: value and gradient within {error:.0e} of one"


if __name__ == "__main__":
    lines_of = versions
    if sys.argv[1:]:
        lines_of = compare
    for line in lines_of():
        sys.stdout.write(line + "\n")
