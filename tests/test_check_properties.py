"""What the card of an operator tells: signs, spectrum, stable step, the derivative that it is, and scaling."""

import json

import numpy as np
import pytest

import sparsedp as dp

CARD = dp.check.operator
GRID = dp.Grid((9, 8), spacing=0.5)


def test_laplacian():
    """Its eigenvalues are known: -4/h^2 sin^2(k pi / 2n) in each direction."""
    facts = CARD(dp.laplacian(GRID)).facts
    radius = 16 * sum(np.sin((n - 1) * np.pi / (2 * n)) ** 2 for n in GRID.shape)
    assert facts["spectral radius"] == pytest.approx(radius, rel=1e-12)
    assert facts["stable step"] == pytest.approx(2 / radius, rel=1e-12)
    assert facts["null space"] == 1 and facts["definite"] == "negative semidefinite"
    assert facts["row sums"] == "0" and facts["symmetric"] is True
    assert facts["nnz"] == 9 * 8 * 5 - 2 * (9 + 8)
    assert CARD(-dp.laplacian(GRID, dp.dirichlet)).facts["definite"] == "positive definite"


def test_large_ones_know_the_ends_of_their_spectrum():
    facts = CARD(dp.laplacian(dp.Grid((40, 30)), dp.dirichlet), seeds=1).facts
    assert facts["spectral radius"] == pytest.approx(8.0, rel=0.01) and facts["stable step"] == pytest.approx(
        0.25, rel=0.01
    )
    assert facts["definite"].startswith("negative")
    assert CARD(dp.upwind(dp.Grid(300), "x", boundary=dp.dirichlet), seeds=1).facts["spectral radius"] < 2.1


def test_the_stable_step_of_transport_is_its_cfl_number():
    """Upwind with speed 1 on a periodic grid: dt <= h; centred differences: no step at all."""
    grid = dp.Grid(32, spacing=0.25, periodic=True)
    facts = CARD(-dp.divergence(grid) @ dp.from_matrix(np.roll(np.eye(32), 0, 1), grid.cells, grid.faces)).facts
    turn = np.roll(np.eye(32), -1, 0)
    upwind, centred = (dp.from_matrix(m / 0.25) for m in (turn.T - np.eye(32), (turn.T - turn) / 2))
    assert CARD(upwind).facts["stable step"] == pytest.approx(0.25, rel=1e-8)
    assert CARD(centred).facts["stable step"] == 0.0
    assert facts["row sums"] == "0"
    growing = CARD(dp.from_matrix(np.diag([1.0, -1.0]))).facts
    assert growing["stable step"] == 0.0 and growing["definite"] == "indefinite"
    assert CARD(dp.from_matrix(np.zeros((2, 2)))).facts["stable step"] == np.inf


def test_what_is_not_known_is_left_out():
    blur = dp.from_functions(lambda u: u + np.roll(u, 1), lambda g: g + np.roll(g, -1), 600, 600, name="blur")
    facts = CARD(blur, seeds=1).facts
    assert "spectral radius" not in facts and "symmetric" not in facts
    broken = CARD(dp.from_functions(lambda u: u[:2], lambda g: g, 3, 3, name="broken"))
    assert "order" not in broken.facts and "broken" in str(broken)


def test_scaling():
    for op in (dp.gradient(GRID), dp.inverse(-dp.laplacian(GRID, dp.dirichlet), "krylov")):
        rows = {row.name: row for row in CARD(op).rows}
        kinds = "float64", "transposed, float64"
        assert [rows[f"scaling by 2^+-900, {kind}"].figure for kind in kinds] == [0.0, 0.0]
    clipped = dp.from_functions(lambda u: np.clip(u, -9, 9), lambda g: g, 4, 4, name="clipped")
    assert "scaling by 2^+-900, float64" in CARD(clipped).failed


def test_text_and_data():
    card = CARD(dp.laplacian(GRID))
    for words in ("row sums: 0", "symmetric: True", "spectral radius", "stable step", "acts as: u_xx + u_yy"):
        assert words in str(card)
    assert json.loads(json.dumps(card.to_dict()))["null space"] == 1


# ---- order -----------------------------------------------------------------------------------

STRETCHED = dp.Grid((9, 8), spacing=[np.linspace(1.0, 2.0, 9), 0.3])
SOLID = np.zeros((9, 8), bool)
SOLID[3:5, 3:5] = True
DERIVATIVES = {
    "gradient": (dp.gradient(GRID), 2, "u_x; u_y"),
    "at a wall of value": (dp.gradient(STRETCHED, dp.dirichlet), 1, "u_x; u_y"),
    "around a solid": (dp.gradient(GRID, solid=SOLID), 2, "u_x; u_y"),
    "divergence": (dp.divergence(GRID), 2, "u1_x + u2_y"),
    "laplacian": (dp.laplacian(STRETCHED), 1, "u_xx + u_yy"),
    "upwind": (3 * dp.upwind(GRID, "x"), 1, "3 u_x"),
    "average": (dp.average(GRID), 2, "u; u"),
    "curl": (dp.curl(GRID), 2, "u_y; -u_x"),
    "identity": (dp.identity(GRID.cells), "exact on polynomials", "u"),
    "mixed": (
        dp.identity(GRID.cells) - 2 * dp.laplacian(GRID),
        "not known: it mixes u with -2 u_xx",
        "",
    ),
    "inverse": (dp.inverse(-dp.laplacian(GRID, dp.dirichlet)), "not known: a row is no stencil", ""),
    "matrix": (dp.from_matrix(np.eye(5)), "not known: it is no operator", ""),
    "few cells": (dp.laplacian(dp.Grid(4)), "not known: it needs 5 cells", ""),
    "complex": (1j * dp.laplacian(GRID), "not known: it is complex", ""),
    "zero": (0 * dp.laplacian(GRID), "not known: its rows in the middle are 0", ""),
    "one way": (
        dp.from_functions(lambda u: 2 * u, None, GRID.cells, GRID.cells),
        "not known: it has no transpose",
        "",
    ),
}


@pytest.mark.parametrize("name", DERIVATIVES)
def test_derivative_and_order(name):
    """Which derivative, and how exactly; or why that is not known."""
    op, order, terms = DERIVATIVES[name]
    card = CARD(op, seeds=1)
    if isinstance(order, int):
        assert card.facts["order"] == order and card.facts["acts as"] == terms
        assert f"order: {order}" in str(card)
    else:
        assert card.facts["order"].startswith(order) and card.facts.get("acts as", "") == terms


def test_a_sign_and_a_factor_show():
    grid = dp.Grid((9, 8), spacing=0.5)
    G = dp.gradient(grid)
    bent = dp.from_functions(lambda u: 1.001 * G.apply(u), lambda v: 1.001 * G.T.apply(v), G.domain, G.codomain, "bent")
    assert CARD(bent, seeds=1).facts["acts as"] == "1.001 u_x; 1.001 u_y"
    assert CARD(-dp.divergence(grid), seeds=1).facts["acts as"] == "-u1_x - u2_y"


def test_the_order_that_refinement_shows():
    """The order from one row is the slope of the error over grids."""

    def error(build):
        def at(n):
            op = build(dp.Grid(n, size=1.0))
            (x,), inside = op.domain.grid.centres(), slice(3, -3)
            return np.max(np.abs(op(np.sin(3 * x)) - 3 * np.cos(3 * x))[inside])

        return at

    wind = lambda grid: dp.upwind(grid, "x")
    assert dp.check.order(error(wind), expected=CARD(wind(dp.Grid(16)), seeds=1).facts["order"])


def test_one_component_of_faces_has_its_places_and_volumes():
    """x-faces sit on nodes along x: a difference between the centres beside them is of second order."""
    for axis, slope in enumerate(("u_x", "u_y")):
        one = dp.component(GRID, axis)
        assert np.array_equal(one.codomain.volumes, GRID.split(GRID.faces.volumes)[axis])
        facts = CARD(one @ dp.gradient(GRID)).facts
        assert (facts["acts as"], facts["order"]) == (slope, 2)
    assert CARD(dp.lift(GRID, dp.dirichlet)).facts["order"] == "not known: values on walls have no places"
