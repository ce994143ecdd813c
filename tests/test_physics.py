"""Scenes of benchmarks with few cells: close to what is published, and their gradients right.

Stiff systems are in test_integrators_radau.
"""

import pytest

from benchmarks import conservation_laws
from benchmarks.physics import row

CLOSE = {  # by how much a scene with few cells is off
    "Swift-Hohenberg, r 0.01": 0.2,
    "Cahn-Hilliard, 3-D": 0.02,
    "Bratu, p = 1": 2e-3,
    "cavity, Re 1000": 0.3,
    "convection, Ra 1e5": 0.15,
    "Helmholtz, two speeds": 5e-3,
    "Helmholtz, 2-D": 0.04,
    "diffusion by a tensor": 0.02,
    "waves in a box, 3-D": 2e-4,
    "waves into a sponge": 1e-4,
    "Sod's tube": 0.02,
    "dam break": 5e-3,
    "vortex of gas, 2-D": 0.8,
}


@pytest.mark.whole
@pytest.mark.parametrize("name", CLOSE)
def test_a_scene(name):
    _, off, _, verdict = row(name, quick=True)
    assert off < CLOSE[name]
    assert verdict == ("inconclusive" if "vortex" in name else "agrees")  # its least density is at a kink of limiters


@pytest.mark.whole
def test_a_row_of_laws_that_stay_positive():
    _, depth, exact, error, _, _, verdict = conservation_laws.row("dry bed", quick=True)
    assert abs(depth / exact - 1) < 0.1
    assert error < 0.03
    assert verdict == "agrees"
