"""Perfectly matched layers: reflection of plane waves and pulses, circular waves, derivatives in the frequency."""

import copy
import pickle

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp


@pytest.mark.parametrize(("deep", "most"), [(6, 5e-4), (8, 1.5e-4), (20, 1e-4)])
def test_plane_waves_up_to_60_degrees(deep, most):
    """Waves exp(i l y) of ten cells a wavelength, by the equation across the layer that remains for them."""
    omega = 2 * np.pi / 10
    grid = dp.Grid(200 + deep)
    in_cells, on_faces = dp.matched_layer(grid, {"x": (0, deep)}, 2.0).coefficients(2.0 * omega)
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
    for angle in (0, 30, 60):
        along = 4 * np.sin(0.5 * omega * np.sin(np.radians(angle))) ** 2  # l^2 on the grid
        u = solve(on_faces, np.eye(200 + deep)[0], (along - omega**2) * in_cells)[20:190]
        phase = np.arange(170) * np.arccos(1 - (omega**2 - along) / 2)
        there, back = np.abs(np.linalg.lstsq(np.exp(np.outer(phase, [1j, -1j])), u, rcond=None)[0])
        assert back <= most * there


def waves_from_a_point(cells, deep, order):
    n = cells + 2 * deep
    grid = dp.Grid((n, n))
    in_cells, on_faces = dp.matched_layer(grid, deep, 1.0).coefficients(0.6)
    solve = dp.elliptic_solver(dp.divergence(grid, order), dp.gradient(grid, dp.dirichlet, order=order))
    source = np.zeros(grid.shape)
    source[n // 2, n // 2] = 1.0
    return solve(on_faces, in_cells * source, -(0.6**2) * in_cells)[deep : n - deep, deep : n - deep]


@pytest.mark.parametrize("order", [2, 4])
def test_a_larger_domain_changes_nothing(order):
    small = waves_from_a_point(11, 8, order)
    large = waves_from_a_point(31, 10, order)[10:21, 10:21]
    assert np.linalg.norm(small - large) <= 1e-3 * np.linalg.norm(large)


def pulse(cells, deep, steps, order, is_matched):
    """Return the pressure of a round pulse in a box of `cells` after some steps; layers surround the box."""
    n = cells + 2 * deep
    grid = dp.Grid((n, n))
    x_part, y_part = (dp.divergence(grid, order, axis) for axis in "xy")
    G = dp.gradient(grid, order=order)
    inside = dp.interior(grid)
    rates = (lambda v, c: (-c * x_part(v), -c * y_part(v))), (lambda p, c: -inside(G(p[0] + p[1])))
    damping = dp.matched_layer(grid, deep, 1.0).damping if is_matched else None
    step = dp.stepper("leapfrog", rates, 0.5, damping=damping)
    square = sum((c - n / 2) ** 2 for c in grid.centres()) / 18
    part = 0.5 * (1 - square) * np.exp(-square)
    (p_x, p_y), _ = dp.rollout(step, ((part, part), np.zeros(grid.faces.size)), 1.0, steps)
    return (p_x + p_y)[deep : n - deep, deep : n - deep]


@pytest.mark.parametrize("order", [2, pytest.param(4, marks=pytest.mark.whole)])
def test_echo_of_a_pulse(order):
    """Against a box so large that nothing comes back; a sponge of eight cells has an echo of 2e-3."""
    assert np.max(np.abs(pulse(30, 8, 90, order, True) - pulse(30, 25, 90, order, False))) < 3e-5


def test_derivatives_in_the_frequency():
    grid = dp.Grid(24)
    layer = dp.matched_layer(grid, 8, 1.0)
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))

    def loss(omega):
        in_cells, on_faces = layer.coefficients(omega)
        return anp.abs(solve(on_faces, in_cells * np.eye(24)[9], -(omega**2) * in_cells)[15]) ** 2

    assert dp.check.gradient(loss, 0.6, quick=True).verdict == "agrees"
    slope = dp.grad(loss)
    second = (slope(0.6 + 1e-4) - slope(0.6 - 1e-4)) / 2e-4
    assert dp.hvp(loss, 0.6, 1.0) == pytest.approx(second, rel=1e-5)


def test_stretches_of_a_layer():
    """In a corner the stretches of both axes are multiplied; without cells there is none."""
    grid = dp.Grid((9, 10), periodic=(False, False))
    layer = dp.matched_layer(grid, {"x": (8, 0), "y": (0, 8)}, 2.0, echo=0.01)
    depth = lambda x: (np.maximum(1 - x / 8, 0)) ** 3 / 8 * 2 * 2.0 * np.log(100)
    s_x = 1 + 1j * depth(np.arange(9) + 0.5) / 3.0
    s_y = 1 + 1j * depth(9.5 - np.arange(10)) / 3.0
    in_cells, on_faces = layer.coefficients(3.0)
    np.testing.assert_allclose(in_cells, np.outer(s_x, s_y), rtol=1e-13)
    s_x = 1 + 1j * depth(np.arange(10.0)) / 3.0
    np.testing.assert_allclose(grid.split(on_faces)[0], s_y / s_x[:, None], rtol=1e-13)
    in_cells, on_faces = dp.matched_layer(grid, 0, 2.0).coefficients(3.0)
    assert np.all(in_cells == 1) and np.all(on_faces == 1)
    assert layer == dp.matched_layer(grid, {"x": (8, 0), "y": (0, 8)}, 2.0, echo=0.01) != dp.matched_layer(grid, 0, 2.0)
    assert repr(layer) == "<matched_layer on Grid(9 x 10 cells, size 9 x 10)>"


def test_layers_cannot_be_changed():
    layer = dp.matched_layer(dp.Grid((9, 10)), {"x": (0, 8)}, 2.0)
    for other in (layer, copy.deepcopy(layer), pickle.loads(pickle.dumps(layer))):
        assert other == layer and hash(other) == hash(layer)
        for rates in (*other.in_cells, *other.on_faces[0], *other.on_faces[1], *other.damping[0]):
            with pytest.raises(ValueError, match="read-only"):
                rates[0, 0] = 1.0


def test_layers_of_low_frequencies():
    """Stretches of 1e200 are finite, though their squares are not."""
    in_cells, on_faces = dp.matched_layer(dp.Grid((9, 10)), {"x": (0, 8)}, 2.0).coefficients(1e-200)
    assert np.all(np.isfinite(in_cells)) and np.all(np.isfinite(on_faces))


@pytest.mark.parametrize("function", [dp.sponge, dp.matched_layer])
@pytest.mark.parametrize("cells", [True, {"x": (8, True)}, "8", 2.5, -1, None, [8, "9"]])
def test_numbers_of_cells(function, cells):
    with pytest.raises(ValueError, match=f"{function.__name__} on x needs a whole number of cells from 0 to 30, got "):
        function(dp.Grid(30), cells, 1.0)
