"""What the card of an operator tells: signs, spectrum, stable step, and scaling."""

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


def test_large_operators_report_the_ends_of_their_spectrum():
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


def test_unknown_facts_are_omitted():
    blur = dp.from_functions(lambda u: u + np.roll(u, 1), lambda g: g + np.roll(g, -1), 600, 600, name="blur")
    facts = CARD(blur, seeds=1).facts
    assert "spectral radius" not in facts and "symmetric" not in facts
    broken = CARD(dp.from_functions(lambda u: u[:2], lambda g: g, 3, 3, name="broken"))
    assert "row sums" not in broken.facts and "broken" in str(broken)


def test_scaling():
    for op in (dp.gradient(GRID), dp.inverse(-dp.laplacian(GRID, dp.dirichlet), "krylov")):
        rows = {row.name: row for row in CARD(op).rows}
        kinds = "float64", "transposed, float64"
        assert [rows[f"scaling by 2^+-900, {kind}"].figure for kind in kinds] == [0.0, 0.0]
    clipped = dp.from_functions(lambda u: np.clip(u, -9, 9), lambda g: g, 4, 4, name="clipped")
    assert "scaling by 2^+-900, float64" in CARD(clipped).failed


def test_text_and_data():
    card = CARD(dp.laplacian(GRID))
    for words in ("row sums: 0", "symmetric: True", "spectral radius", "stable step"):
        assert words in str(card)
    assert json.loads(json.dumps(card.to_dict()))["null space"] == 1
