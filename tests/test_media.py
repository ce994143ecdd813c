"""The scenes of benchmarks.media with few cells: close to what is exact, and their gradients right."""

import pytest

from benchmarks.media import row

CLOSE = {  # error with few cells, and the least order
    "vortex, viscosity varies": (0.02, 1.8),
    "Carreau, m = 0.5": (0.01, 1.8),
    "Smagorinsky, l = 0.3": (0.01, 1.8),
    "diffusivity 1 + x": (1e-3, 1.8),
    "diffusivity 1 + T": (1e-3, 1.8),
    "Taylor-Green, dt of params": (0.01, 1.8),
}


@pytest.mark.whole
@pytest.mark.parametrize("name", CLOSE)
def test_a_scene(name):
    _, error, order, _, verdict = row(name, quick=True)
    largest, least_order = CLOSE[name]
    assert error < largest
    assert order > least_order
    assert verdict == "agrees"
