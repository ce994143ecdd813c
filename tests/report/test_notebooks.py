"""What a notebook shows: tables, curves and the entries of matrices as HTML."""

import re
import xml.etree.ElementTree as ElementTree

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils import html

GRID = dp.Grid((6, 4), size=(3.0, 1.0), periodic=(True, False))


def shown(value):
    """The HTML of a value, as a tree: it is well formed."""
    return ElementTree.fromstring(f"<body>{value._repr_html_()}</body>")


def cells(tree):
    """The texts of the cells of its tables, row by row."""
    return [["".join(cell.itertext()) for cell in row if cell.tag == "td"] for row in tree.iter("tr")]


def test_grid():
    entries = dict(cells(shown(GRID)))
    assert entries["x"] == "6 cells from 0 to 3, periodic, width 0.5"
    assert entries["y"] == "4 cells from 0 to 1, width 0.25"
    assert entries["faces"] == "54 values, shape (54,)" and entries["nodes"] == "30 values, shape (6, 5)"


@pytest.mark.parametrize("grid", [dp.Grid(0), dp.Grid(1), dp.Grid(3, spacing=[[1.0, 2.0, 4.0]]), dp.Grid((2, 2, 2))])
def test_grids_of_all_kinds(grid):
    assert f"{grid.cells.size} values" in grid._repr_html_()
    assert ("widths 1 to 4" in grid._repr_html_()) == (not all(grid.uniform))


def test_operator_with_its_entries():
    gradient = dp.gradient(GRID)
    tree = shown(gradient)
    entries = dict(row for row in cells(tree) if len(row) == 2)
    assert entries["from"] == "cells(6, 4)" and entries["acts"] == gradient.form
    assert entries["entries"] == f"{gradient.matrix.nnz} of 54 x 24"
    [picture] = tree.iter("svg")
    places = {(int(square.get("y")), int(square.get("x"))) for square in picture.iter("rect")}
    wanted = gradient.matrix.tocoo()
    assert places == set(zip((wanted.row * 48 // 54).tolist(), (wanted.col * 48 // 54).tolist()))


@pytest.mark.parametrize(
    "op",
    [
        dp.from_functions(np.copy, np.copy, GRID.cells, GRID.cells, name="a < b"),
        dp.laplacian(dp.Grid((200, 200))),  # large: no matrix is made for a picture
        dp.inverse(dp.identity(GRID.cells) - dp.laplacian(GRID)),
    ],
)
def test_operator_without_entries(op):
    tree = shown(op)
    assert not list(tree.iter("svg")) and "_matrix_structure" not in vars(op)
    assert next(tree.iter("caption")).text == op.name


def test_operator_of_zeros_and_of_no_cells():
    for op in (0.0 * dp.laplacian(GRID), dp.laplacian(dp.Grid(0)), dp.diagonal(GRID.cells, np.zeros(GRID.shape))):
        text = "".join(shown(op).itertext())
        assert op.name in text and "Sparse" not in op._repr_html_() and "where" not in text


def test_inverse_tells_how_it_solves():
    inverse = dp.inverse(-dp.laplacian(GRID, dp.dirichlet))
    entries = dict(cells(shown(inverse)))
    assert entries["method"].startswith(f"{inverse.method}: ") and entries["unknowns"] == "24 of 24"
    assert all(words in str(inverse) for name, words in entries.items() if name not in ("from", "to"))


def test_numbers_are_not_broken():
    table = html.table([[2.4e-11, "a sentence that may be broken at its spaces"]])
    assert '<td nowrap="nowrap">2.4e-11</td>' in table and "<td>a sentence" in table


def test_solves():
    inverse = dp.inverse(-dp.laplacian(GRID, dp.dirichlet))
    assert "set-up" in inverse.info._repr_html_() and not any(cells(shown(inverse.info)))  # no solve so far
    inverse.T(inverse(np.ones(GRID.shape)))
    rows = [row for row in cells(shown(inverse.info)) if row]
    assert [row[:2] for row in rows] == [["forward", inverse.info.forward.status], ["adjoint", "converged"]]
    assert dict(cells(shown(inverse.info.forward)))["status"] == "converged"


def test_minimum_with_its_convergence():
    best = dp.minimize(lambda u: anp.sum((u - 2.0) ** 4), np.zeros(3), "gd", rate=0.01, maxiter=20)
    tree = shown(best)
    entries = {row[0]: row[1] for row in cells(tree)}
    assert entries["loss"] == f"{best.value:.6g}" and entries["iterations"] == "20"
    [line] = tree.iter("polyline")
    heights = [float(point.split(",")[1]) for point in line.get("points").split()]
    assert len(heights) == 21 and heights == sorted(heights)  # down the page, as the loss falls


def test_minimum_that_starts_at_zero_has_no_picture():
    best = dp.minimize(lambda u: anp.sum(u**2), np.zeros(2))
    assert not list(shown(best).iter("polyline"))


def test_audit_with_its_curves():
    audit = dp.check.gradient(lambda u: anp.sum(anp.sin(u) ** 2), np.array([0.3, 0.7]))
    tree = shown(audit)
    assert "verdict: agrees" in "".join(tree.itertext())
    assert len(list(tree.iter("polyline"))) == len(audit.lines) and len(list(tree.iter("table"))) == 2
    assert len(list(tree.iter("tr"))) == len(audit.lines) + len({row["step"] for row in audit.rows}) + 2


def test_plan_folds_what_was_skipped():
    plan = dp.explain(lambda u: anp.sum(dp.laplacian(GRID)(u) ** 2), np.ones(GRID.shape))
    tree = shown(plan)
    [folded] = tree.iter("details")
    assert [line.text for line in folded.iter("li")] == list(plan.skipped)
    assert "skipped:" not in "".join("".join(part.itertext()) for part in tree.iter("p"))


def test_work_precision_table():
    box = dp.Grid((8, 8))
    problem = lambda method: (lambda s: anp.sum(dp.inverse(dp.identity(box.cells) - dp.laplacian(box), method)(s)), S)
    S = np.ones(box.shape)
    table = dp.work_precision(
        problem, {"a": {"method": "direct"}, "b": {"method": "krylov"}}, reference=(64.01, np.ones((8, 8)))
    )
    tree = shown(table)
    assert [row[0] for row in cells(tree) if row] == ["a", "b"] and len(list(tree.iter("polyline"))) == 2


def test_check_of_an_operator():
    assert "transpose" in "".join(shown(dp.check.operator(dp.gradient(GRID))).itertext())


def test_curves():
    lines = {"<one>": [(1e-3, 1.0), (1.0, 1e6), (np.nan, 1.0), (2.0, -1.0)], "two": [(1.0, 1e3)]}
    picture = ElementTree.fromstring(html.curves(lines, "step & co", "gap", log=(True, True)))
    first, second = picture.iter("polyline")
    left, right = (tuple(map(float, point.split(","))) for point in first.get("points").split())
    [middle] = (tuple(map(float, point.split(","))) for point in second.get("points").split())
    assert left[0] < right[0] == middle[0] and right[1] < middle[1] < left[1]
    assert abs(middle[1] - (left[1] + right[1]) / 2) < 0.11  # half way on a logarithmic axis
    texts = [text.text for text in picture.iter("text")]
    assert texts[:2] == ["<one>", "two"] and {"step & co", "gap", "0.001", "1e+06"} <= set(texts)


def test_curves_of_nothing():
    assert html.curves({"a": [], "b": [(1.0, 0.0)]}, "x", "y") == ""


def test_words_of_the_user_are_no_markup():
    assert "<script>" not in html.table([["<script>", html.Markup("<b>bold</b>")]], ["<script>"], "<script>")
    assert re.search("<td[^>]*><b>bold</b></td>", html.table([[html.Markup("<b>bold</b>")]]))
