"""projection around a body of cut_cells: the limit without a body, conditions, density, derivatives, errors."""

import autograd.numpy as np
import pytest

import sparsedp as dp
from sparsedp.errors import IncompatibleError, NonFiniteError, ShapeError

GRID = dp.Grid((9, 8), size=(1.1, 0.9))
CHANNEL = {"x": (dp.inflow, dp.outflow)}


def ring(x, y, radius=0.21):
    """The fluid around a disc."""
    return np.sqrt((x - 0.53) ** 2 + (y - 0.41) ** 2) - radius


@pytest.fixture
def body():
    return dp.cut_cells(GRID, ring, dp.dirichlet, dp.dirichlet)


@pytest.mark.parametrize("boundary", [dp.no_slip, CHANNEL], ids=["closed", "channel"])
def test_without_a_wall_it_is_the_projection_of_the_grid(boundary, rng):
    everywhere = dp.cut_cells(GRID, np.ones(GRID.nodes.shape))
    plain = dp.projection(GRID, boundary=boundary)
    P = dp.projection(GRID, everywhere, boundary)
    v = rng.standard_normal(GRID.faces.size)
    density = rng.uniform(1.0, 3.0, GRID.faces.size)
    assert np.allclose(P(v), plain(v), atol=1e-12)
    assert np.allclose(P.pressure(v), plain.pressure(v), atol=1e-12)
    assert np.allclose(P(v, 2.0), plain(v), atol=1e-12)
    assert np.allclose(P(v, density), plain(v, density), atol=1e-12)


def test_a_channel_with_a_body(body, rng):
    P = dp.projection(GRID, body, CHANNEL)
    v = rng.standard_normal((2, GRID.faces.size))
    result = P(v)
    assert np.all(abs(body.volumes * body.divergence(result)) < 1e-14)
    assert np.all(result[:, body.apertures == 0] == 0)
    x_faces, y_faces = GRID.split(result[0])
    assert np.array_equal(x_faces[0], GRID.split(v[0])[0][0])  # the inflow is kept
    assert np.all(y_faces[:, [0, -1]] == 0)  # closed walls
    assert np.allclose(P(result), result, atol=1e-12)
    assert np.allclose(P(v[1]), result[1], atol=1e-13)
    open_body = dp.cut_cells(GRID, ring, {"x": (dp.neumann, dp.dirichlet)})
    p = P.pressure(v)
    closed = GRID.join(1.0, np.pad(np.ones((9, 7)), ((0, 0), (1, 1)))) * (body.apertures > 0)
    assert np.allclose(result, closed * v + open_body.gradient(p), atol=1e-12)
    assert P.info.forward.status == "converged"
    assert repr(P) == f"<projection: {dp.cut_cells(GRID, ring)}>"


def test_derivatives(rng):
    v, weights = rng.standard_normal((2, GRID.faces.size))
    slope_of_density = rng.uniform(0.0, 1.0, GRID.faces.size)

    def loss(q):
        body = dp.cut_cells(GRID, lambda x, y: ring(x, y, 0.21 * q[0]))
        P = dp.projection(GRID, body, CHANNEL)
        return np.sum(weights * body.apertures * P(q[1] * v, 1.0 + q[2] * slope_of_density) ** 2)

    q, direction = np.array([1.02, 0.9, 0.6]), np.array([0.3, -0.5, 0.7])
    h = 1e-5
    slope = np.dot(dp.grad(loss)(q), direction)
    assert np.isclose(slope, (loss(q + h * direction) - loss(q - h * direction)) / (2 * h), rtol=1e-6)
    assert np.isclose(dp.jvp(loss, q, direction)[1], slope, rtol=1e-9)
    second = (dp.grad(loss)(q + h * direction) - dp.grad(loss)(q - h * direction)) / (2 * h)
    assert np.allclose(dp.hvp(loss, q, direction), second, rtol=1e-5)


def test_errors(body):
    v = np.ones(GRID.faces.size)
    with pytest.raises(
        ValueError,
        match=r"^projection takes a body of cut_cells on its grid Grid\(9 x 8 cells, size 9 x 8\), got one on Grid\(9 ",
    ):
        dp.projection(dp.Grid((9, 8)), body)
    P = dp.projection(GRID, body, CHANNEL)
    with pytest.raises(ValueError, match="^density of cut_cells must be > 0, got -1 on face 0$"):
        P(v, -v)
    with pytest.raises(NonFiniteError, match="density of cut_cells must be finite"):
        P(v, np.nan)
    with pytest.raises(TypeError, match="density of cut_cells must hold real numbers, got dtype complex128"):
        P(v, 1j)
    with pytest.raises(
        ShapeError,
        match=r"^project of cut_cells takes a number or one field on faces as density, got an array of shape \(9, 8\)$",
    ):
        P(v, np.ones(GRID.shape))
    with pytest.raises(NonFiniteError, match="v of cut_cells must be finite"):
        P(np.nan * v)
    with pytest.raises(
        IncompatibleError,
        match="^project of cut_cells: inflow and outflow through the walls of a connected region differ",
    ):
        dp.projection(GRID, body, {"x": (dp.inflow, dp.no_slip)})(v)
