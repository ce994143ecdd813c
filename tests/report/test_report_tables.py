"""What all instruments give: frozen values, and one table as text, Markdown, CSV and files."""

import csv
import importlib.util
import io
import math

import pytest

import sparsedp as dp
from sparsedp.check.summary import Result, Row, Summary
from sparsedp.check.table import Table, table_of
from sparsedp.report.certificate import Certificate
from sparsedp.report.explain import Plan
from sparsedp.report.plots import write_result
from sparsedp.report.stress_table import Stress
from sparsedp.report.work_precision import Rows

ROWS = [
    {"name": "a|b", "error": 1.23456e-5, "count": 12, "note": "two\nlines"},
    {"name": "plain", "error": math.nan, "count": 3, "note": ""},
]
NAMES = ("name", "error", "count", "note", "absent")


def test_text_has_columns():
    head, first, second = str(table_of(ROWS, NAMES[:3])).splitlines()
    assert head.split() == ["name", "error", "count"] and first.split() == ["a|b", "1.2e-05", "12"]
    assert second.split() == ["plain", "3"]  # NaN is left empty
    assert len(head) == len(first) == len(second)  # numbers stand below each other


def test_markdown_keeps_its_columns_whatever_the_cells_hold():
    lines = table_of(ROWS, NAMES).markdown().splitlines()
    assert lines[0] == "| name | error | count | note |" and lines[1] == "|---|---|---|---|"  # an empty one is left out
    assert lines[2] == "| a\\|b | 1.2e-05 | 12 | two lines |"
    assert {line.replace("\\|", "").count("|") for line in lines} == {5}
    assert table_of([], NAMES).markdown().splitlines()[0] == "| name | error | count | note | absent |"


def test_a_table_without_an_entry_keeps_its_first_column():
    table = Table(("a", "b"), [(math.nan, None)])
    assert table.markdown().splitlines() == ["| a |", "|---|", "|  |"]
    assert "<th>a</th>" in table.html() and "<th>b</th>" not in table.html()
    assert str(table) == "  a\n"


def test_rows_with_other_keys_lose_nothing():
    assert table_of([{"a": 1}, {"b": 2, "a": 3}, {"c": 4}]).csv() == "a,b,c\n1,,\n3,2,\n,,4\n"
    assert table_of([{}]).csv().splitlines()[0] == "nothing"


def test_a_limit_of_zero_is_a_limit():
    table = Summary("title", [Row("exact", 0.0, 0.0, True), Row("left out")]).parts()[1]
    assert [cells[2] for cells in table.rows] == ["<= 0", ""]


def test_a_failure_is_one_line_of_its_nonempty_cells():
    names = ("group", "parameter", "case", "outcome", "figure", "note")
    case = ("", "value and gradient", "FAILED", 1.0, "")
    rows = [dict(zip(names, ("as given", *case))), dict(zip(names, ("x", "dt", "low", "FAILED", 1.0, "grows")))]
    found = Stress(rows=rows, counts={"FAILED": 2}, failures=rows, map=None, skipped=[], summary="two")
    assert found.parts()[-3:] == ["FAILED: value and gradient", "FAILED: dt low: grows", "two"]


def test_csv_reads_back_whole():
    rows = list(csv.DictReader(io.StringIO(table_of(ROWS).csv())))
    assert [row["note"] for row in rows] == ["two\nlines", ""] and float(rows[0]["error"]) == ROWS[0]["error"]
    assert table_of([], ("a", "b")).csv() == "a,b\n" and table_of([]).csv() == "nothing\n"


def test_files(tmp_path):
    found = dp.explain(lambda x: x**2, 1.5)
    paths = write_result(found, tmp_path, "t", heading="# t\n\n")
    assert [path.name for path in paths] == ["t.md", "t.csv"] and all(path.exists() for path in paths)
    assert paths[0].read_text().startswith("# t\n\n### value 2.25: ")
    drawn = write_result(found, tmp_path, "t", lambda ax: ax)
    assert [path.name for path in drawn[2:]] == (["t.png"] if importlib.util.find_spec("matplotlib") else [])


def test_an_audit_is_a_table_in_markdown_too():
    text = dp.check.gradient(lambda x: x**2, 1.5).markdown()
    assert text.startswith("### gradient at 1 values") and "\n| step | random 1 |" in text
    assert "\n- verdict: agrees to" in text


def test_curves_of_results():
    lines, across, up = dp.check.gradient(lambda x: x**2, 1.5).curves()
    assert list(lines)[0] == "random 1" and (across, up) == ("step", "|difference - gradient| / |derivative|")
    assert dp.explain(lambda x: x**2, 1.5).curves() == ({}, "", "")


def test_results_are_frozen_and_print_themselves():
    assert all(issubclass(kind, Result) for kind in (Plan, Certificate, Stress, Rows))
    found = dp.stress(lambda x: x**2, 1.5, only=["as given"])
    with pytest.raises(AttributeError, match="Stress is frozen; make a new one instead of setting rows"):
        found.rows = []
    assert repr(found) == str(found)
