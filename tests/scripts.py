"""The examples as processes of their own, small; each runs once in a session, beside the other tests.

One process works through them while the tests run on the other core. Who needs an example that has not begun runs it
at once, so at the end two run at a time.
"""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import cache

from sources import ROOT

from sparsedp.kernels.team import NOTICE

EXAMPLES = sorted(path.name for path in (ROOT / "examples").glob("*.py"))
SMALL = {
    "poisson_adjoint.py": "32",
    "two_families.py": "24",
    "poisson_control.py": "64",
    "warm_start.py": "64",
    "implicit_or_unrolled.py": "96",
    "inexact_solves.py": "30",
    "burgers.py": "128",
    "shock.py": "64",
    "stiff_chemistry.py": "50",
    "pressure_projection.py": "80",
    "plume.py": "32",
    "plume_inverse.py": "6",
    "taylor_green.py": "50",
    "cavity.py": "32",
    "convection.py": "32",
    "obstacle.py": "10",
    "shape.py": "12",
    "velocity_recovery.py": "64",
    "update_directions.py": "10",
    "half_inverse.py": "1",
    "inverse_heat.py": "6",
    "control.py": "2",
    "conductivity_design.py": "200",
    "residual_or_physics.py": "10",
    "solver_in_the_loop.py": "48",
}  # cells, the end time, or gradients; the others run with 16
BESIDE = ThreadPoolExecutor(1)


def done(name, *options_of_its_own):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
    command = [sys.executable, str(ROOT / "examples" / name), SMALL.get(name, "16"), *options_of_its_own]
    options = {"capture_output": True, "text": True, "timeout": 600, "check": False}  # for what hangs
    return subprocess.run(command, env=environment, **options)


@cache
def begun(name, *options):
    """An example that waits for its turn beside the tests, runs, or has run."""
    return BESIDE.submit(done, name, *options)


@cache
def ended(name, *options):
    waiting = begun(name, *options)
    return done(name, *options) if waiting.cancel() else waiting.result()


def run(name, *options):
    """What an example prints when it runs small."""
    found = ended(name, *options)
    assert found.returncode == 0, found.stderr
    assert found.stderr.replace(NOTICE, "") == ""  # the first one to use a loop says that it is compiled
    return found.stdout
