"""Scripts of tests/ranks/ as several processes: mpirun in a process of its own, with an end."""

import os
import shutil
import subprocess
import sys
from importlib.util import find_spec

import pytest
from sources import ROOT

MISSING = [name for name in ("petsc4py", "mpi4py") if find_spec(name) is None]
MISSING += [] if shutil.which("mpirun") else ["mpirun"]
GUIDE = "docs/guides/ranks_and_ensembles.md"
on_ranks = pytest.mark.skipif(bool(MISSING), reason=f"not here: {', '.join(MISSING)}; see {GUIDE}")
COUNTS = [2, *(pytest.param(count, marks=pytest.mark.whole) for count in (1, 4))]  # of processes
SECONDS = 120

SETTINGS = {
    "OMPI_ALLOW_RUN_AS_ROOT": "1",
    "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
    "OMPI_MCA_btl_vader_single_copy_mechanism": "none",  # containers forbid it
    "OMP_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
    "PYTHONFAULTHANDLER": "1",
}


def launched(script, count, *options, seconds=SECONDS):
    """Return the finished run of a script on n processes."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "helpers")])
    environment = {**os.environ, **SETTINGS, "PYTHONPATH": path}
    command = ["mpirun", "--oversubscribe", "-n", str(count), sys.executable, "-m", "mpi4py"]
    command += [str(ROOT / "tests" / "ranks" / script), *options]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=seconds, check=False)


def printed(script, count, *options):
    """What it prints, where it ends well."""
    done = launched(script, count, *options)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return done.stdout
