"""The examples as processes of their own, small; each runs once in a session, on the worker that looks at it."""

import os
from functools import cache
from importlib.util import find_spec

import pytest
from fresh_process import run_python
from sources import ROOT

from sparsedp.kernels.team import NOTICE

EXAMPLES = sorted(path.name for path in (ROOT / "examples").glob("*.py"))
SMALL = {
    "data_assimilation.py": "32",
    "poisson_adjoint.py": "32",
    "two_families.py": "24",
    "poisson_control.py": "64",
    "warm_start.py": "64",
    "implicit_or_unrolled.py": "96",
    "inexact_solves.py": "30",
    "burgers.py": "128",
    "shock.py": "64",
    "stiff_chemistry.py": "50",
    "reaction_waves.py": "10",
    "pressure_projection.py": "80",
    "plume.py": "32",
    "plume_inverse.py": "6",
    "taylor_green.py": "50",
    "cavity.py": "32",
    "convection.py": "32",
    "cylinder.py": "10",
    "steady_states.py": "24",
    "backward_step.py": "8",
    "wake_onset.py": "6",
    "stiff_and_extreme.py": "8",
    "obstacle.py": "10",
    "shape.py": "12",
    "velocity_recovery.py": "64",
    "update_directions.py": "10",
    "half_inverse.py": "1",
    "inverse_heat.py": "6",
    "control.py": "2",
    "full_waveform.py": "24",
    "edges.py": "24",
    "conservation_laws.py": "64",
    "dry_ground.py": "50",
    "conductivity_design.py": "200",
    "helmholtz.py": "64",
    "patterns.py": "32",
    "residual_or_physics.py": "10",
    "solver_in_the_loop.py": "48",
    "ensemble.py": "5",
    "mesh_design.py": "3",
    "mbb_beam.py": "20",
    "volume_to_point.py": "32",
    "room.py": "4",
    "pylops_exchange.py": "32",
    "pendulums.py": "10",
    "curved_walls.py": "64",
    "drag_of_a_shape.py": "10",
}  # cells, the end time, or gradients; the others run with 16
NEEDS = {
    "torch_training.py": ["torch"],
    "jax_optimiser.py": ["optax"],
    "mesh_design.py": ["skfem"],
    "mbb_beam.py": ["skfem", "nlopt"],
    "volume_to_point.py": ["nlopt"],
    "pylops_exchange.py": ["pylops"],
}  # libraries that need not be there
DEFAULT = {"heat_rod.py", "new_operator.py"}


def marks(name):
    """Of whatever looks at an example: one worker runs it, once, and most of them only with the marker `whole`."""
    absent = [library for library in NEEDS.get(name, []) if find_spec(library) is None]
    missing = pytest.mark.skipif(bool(absent), reason=f"{', '.join(absent)} is not installed")
    return [pytest.mark.xdist_group(name), missing, *([] if name in DEFAULT else [pytest.mark.whole])]


def example(name):
    """Decorator of a test that looks at an example."""

    def marked(test):
        for mark in marks(name):
            test = mark(test)
        return test

    return marked


@cache
def done(name, *options_of_its_own):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
    arguments = [SMALL.get(name, "16"), *options_of_its_own]
    return run_python(str(ROOT / "examples" / name), arguments, ROOT, environment, timeout=600)  # for what hangs


def run(name, *options):
    """What an example prints when it runs small."""
    found = done(name, *options)
    assert found.returncode == 0, found.stderr
    assert found.stderr.replace(NOTICE, "") == ""  # the first one to use a loop says that it is compiled
    return found.stdout
