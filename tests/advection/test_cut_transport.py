"""transport around a body of cut_cells: steps, inflow, limits of dt, derivatives, errors."""

import autograd.numpy as np
import pytest

import sparsedp as dp
from sparsedp.errors import NonFiniteError, ShapeError, UnstableStepError

GRID = dp.Grid((9, 8), size=(1.1, 0.9))


def ring(x, y, radius=0.21):
    """The fluid around a disc."""
    return np.sqrt((x - 0.53) ** 2 + (y - 0.41) ** 2) - radius


@pytest.fixture
def body():
    return dp.cut_cells(GRID, ring)


def wind(body):
    """A velocity around the body, which enters on the left and leaves on the right."""
    return body.project(GRID.join(1.0, 0.0))


def test_without_a_wall_the_steps_are_those_of_the_grid(rng):
    """The values that enter; at walls of neumann the values of the cells."""
    everywhere = dp.cut_cells(GRID, np.ones(GRID.nodes.shape))
    u = rng.standard_normal(GRID.shape)
    v = rng.standard_normal(GRID.faces.size)
    for boundary in (dp.neumann, dp.dirichlet, {"x": (dp.dirichlet, dp.neumann)}):
        plain = dp.transport(GRID, boundary=boundary)
        move = dp.transport(GRID, boundary=boundary, solid=everywhere)
        assert move.walls == plain.walls
        inflow = rng.standard_normal(plain.walls.size) if boundary != dp.neumann else 0.0
        assert np.allclose(move(u, v, 0.01, inflow), plain(u, v, 0.01, inflow), rtol=1e-12)


def test_steps_around_a_body_are_conservative_and_stable(body, rng):
    v = wind(body)
    u = rng.uniform(0.2, 1.0, GRID.shape) * body.is_fluid
    limit = 1.0 / np.max(body.outflow_rates(v))
    for scheme, cfl in (("upwind", 1.0), ("van_leer", 0.5)):
        move = dp.transport(GRID, scheme, solid=body, boundary=dp.dirichlet)
        after = u
        for _ in range(150):
            after = move(after, v, 0.999 * cfl * limit, 0.5)
            assert 0.0 < np.min(after[body.is_fluid]) and np.max(after) < 1.1
        assert np.allclose(after[body.is_fluid], 0.5, atol=0.02)  # all of the ink has left
        with pytest.raises(UnstableStepError, match=f"^transport {scheme}: dt = .* is too large at 1 of 72 points"):
            move(u, v, 1.01 * cfl * limit)
        dp.transport(GRID, scheme, solid=body, boundary=dp.dirichlet, unstable="allow")(u, v, 1.01 * cfl * limit)
        closed = dp.interior(GRID)(v)
        closed = body.project(closed * rng.uniform(0.5, 1.0, v.size))
        content = np.sum(body.volumes * u)
        assert np.isclose(np.sum(body.volumes * move(u, closed, 0.1 * limit, 0.7)), content, rtol=1e-13)
        assert np.allclose(move(np.stack([u, after]), v, 0.1 * limit)[1], move(after, v, 0.1 * limit), rtol=1e-13)
    assert repr(move) == f"<transport van_leer: {body}>"


@pytest.mark.parametrize("scheme", ["upwind", "van_leer"])
def test_a_field_in_single_precision_stays_so(scheme, body, rng):
    move = dp.transport(GRID, scheme, dp.dirichlet, solid=body)
    u, v = rng.uniform(0.2, 1.0, GRID.shape), wind(body)
    for dt in (0.01, np.float64(0.01), np.asarray(0.01)):
        single = move(u.astype(np.float32), v, dt, np.float64(0.3))
        assert single.dtype == np.float32
        assert np.allclose(single, move(u, v, dt, 0.3), rtol=1e-6)
    assert move(u.astype(int), v, 0.01).dtype == float


@pytest.mark.parametrize("scheme", ["upwind", "van_leer"])
def test_derivatives_in_all_arguments_and_the_shape(scheme, rng):
    u, weights = rng.standard_normal((2, *GRID.shape))

    def loss(q):
        body = dp.cut_cells(GRID, lambda x, y: ring(x, y, 0.21 * q[0]))
        move = dp.transport(GRID, scheme, {"x": (dp.dirichlet, dp.neumann)}, solid=body)
        end = u * q[3]
        for _ in range(3):
            end = move(end, wind(body), 0.01 * q[1], q[2])
        return np.sum(weights * body.volumes * end**2)

    q, direction = np.array([1.02, 0.9, 0.4, 1.1]), np.array([0.3, -0.5, 0.7, 0.4])
    h = 1e-6
    slope = np.dot(dp.grad(loss)(q), direction)
    assert np.isclose(slope, (loss(q + h * direction) - loss(q - h * direction)) / (2 * h), rtol=1e-5)
    assert np.isclose(dp.jvp(loss, q, direction)[1], slope, rtol=1e-9)


def test_errors_of_transport_around_a_body(body):
    with pytest.raises(
        ValueError,
        match="^transport around a body of cut_cells takes upwind or van_leer in flux form, of cells with a velocity "
        "on faces, got scheme='semi_lagrangian', form=None, of='cells', velocity='faces'$",
    ):
        dp.transport(GRID, "semi_lagrangian", solid=body)
    with pytest.raises(ValueError, match="got scheme='upwind', form='advective', of='cells', velocity='faces'$"):
        dp.transport(GRID, form="advective", solid=body)
    with pytest.raises(
        ValueError,
        match=r"^transport takes a body of cut_cells on its grid Grid\(9 x 8 cells, size 9 x 8\), got one on Grid\(9 ",
    ):
        dp.transport(dp.Grid((9, 8)), solid=body)
    opening = dp.patch((0.2, 0.4), dp.dirichlet, dp.neumann)
    with pytest.raises(
        ValueError,
        match=r"^transport around a body of cut_cells takes one condition for each wall, got a patch; write u \+ dt \* "
        r"body.advection\(u, v, inflow\) with inflow on faces$",
    ):
        dp.transport(GRID, boundary={"x": (opening, dp.neumann), "y": dp.neumann}, solid=body)
    move = dp.transport(GRID, boundary=dp.dirichlet, solid=body)
    u = np.ones(GRID.shape)
    with pytest.raises(
        ShapeError,
        match=r"^transport upwind with a body takes a number or an array of shape \(34,\) as inflow, got an array of "
        r"shape \(3,\); write move.walls.join\(...\)$",
    ):
        move(u, wind(body), 0.01, np.ones(3))
    with pytest.raises(
        ShapeError, match=r"^transport upwind takes a field on cells\(9, 8\), got an array of shape \(8, 9\)$"
    ):
        move(u.T, wind(body), 0.01)
    with pytest.raises(NonFiniteError, match="inflow of cut_cells must be finite"):
        move(u, wind(body), 0.01, np.nan)
    with pytest.raises(ValueError, match="^transport upwind uses inflow values at sides of dp.dirichlet only"):
        dp.transport(GRID, solid=body)(u, wind(body), 0.01, 0.5)
    with pytest.raises(ValueError, match="dt of transport upwind must be > 0"):
        move(u, wind(body), -0.01)
