"""What all instruments give: frozen values, and one table as text, Markdown, CSV and files."""

import csv
import importlib.util
import io
import math

import pytest

import sparsedp as dp
from sparsedp.report.certificate import Certificate
from sparsedp.report.plan import Plan
from sparsedp.report.stress_table import Stress
from sparsedp.report.table import Result, csv_text, markdown_table, text_table, write_table
from sparsedp.report.work_precision import Rows

ROWS = [
    {"name": "a|b", "error": 1.23456e-5, "count": 12, "note": "two\nlines"},
    {"name": "plain", "error": math.nan, "count": 3, "note": ""},
]
NAMES = ("name", "error", "count", "note", "absent")


def test_text_has_columns():
    head, first, second = text_table(ROWS, NAMES[:3]).splitlines()
    assert head.split() == ["name", "error", "count"] and first.split() == ["a|b", "1.2e-05", "12"]
    assert second.split() == ["plain", "3"]  # NaN is left empty
    assert len(head) == len(first) == len(second)  # numbers stand below each other


def test_markdown_keeps_its_columns_whatever_the_cells_hold():
    lines = markdown_table(ROWS, NAMES)
    assert lines[1] == "|---|---|---|---|---|"
    assert lines[2] == "| a\\|b | 1.2e-05 | 12 | two lines |  |"
    assert {line.replace("\\|", "").count("|") for line in lines} == {6}


def test_csv_reads_back_whole():
    rows = list(csv.DictReader(io.StringIO(csv_text(ROWS))))
    assert [row["note"] for row in rows] == ["two\nlines", ""] and float(rows[0]["error"]) == ROWS[0]["error"]
    assert csv_text([], ("a", "b")) == "a,b\n" and csv_text([]) == "nothing\n"


def test_files(tmp_path):
    paths = write_table(tmp_path, "t", "# t", csv_text(ROWS))
    assert [path.name for path in paths] == ["t.md", "t.csv"] and all(path.exists() for path in paths)
    drawn = write_table(tmp_path, "t", "# t", csv_text(ROWS), lambda ax: ax)
    assert [path.name for path in drawn[2:]] == (["t.png"] if importlib.util.find_spec("matplotlib") else [])


def test_results_are_frozen_and_print_themselves():
    assert all(issubclass(kind, Result) for kind in (Plan, Certificate, Stress, Rows))
    found = dp.stress(lambda x: x**2, 1.5, only=["as given"])
    with pytest.raises(AttributeError, match="Stress is frozen; make a new one instead of setting rows"):
        found.rows = []
    assert repr(found) == str(found)
