"""The notebooks of the course: each runs from top to bottom, and the mistake that is planted in its audit is found."""

import ast
import importlib.util
import json
import re
import sys

import pytest
from scripts import EXAMPLES
from sources import ROOT

DOCS = ROOT / "docs"
LESSONS = ROOT / "examples" / "course"
TABLE = (ROOT / "examples" / "README.md").read_text(encoding="utf-8").split("\n## ")[1]
UNITS = re.findall(r"^\| \d+ \| `(\w+)\.py`", TABLE, re.MULTILINE)
LONGEST = ["half_inverse", "control", "plume_inverse"]  # first, so that two workers end together
KEYS = {"id", "cell_type", "metadata", "source"}


@pytest.fixture(scope="module")
def course():
    """The module that assembles the notebooks; it needs the libraries of the pages."""
    for module in ("sphinx_gallery", "matplotlib"):
        if importlib.util.find_spec(module) is None:
            pytest.skip(f'{module} is not installed: python -m pip install -e ".[docs]"')
    sys.path.insert(0, str(DOCS))
    try:
        import course_notebooks
    finally:
        sys.path.remove(str(DOCS))
    return course_notebooks


def test_every_unit_has_a_lesson_and_a_row_of_the_page():
    """The course has the ten first examples, in the order of their table."""
    page = (DOCS / "course.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| \{doc\}`(.+?) <.*/(\w+)>` .* \| (\d+) \| (.*) \|$", page, re.MULTILINE)
    assert [name for _, _, name, _, _ in rows] == UNITS and len(UNITS) == 10
    assert sorted(path.stem for path in LESSONS.iterdir()) == sorted(UNITS)
    for number, (place, title, name, minutes, download) in enumerate(rows, 1):
        script = (ROOT / "examples" / f"{name}.py").read_text(encoding="utf-8")
        assert f"{name}.py" in EXAMPLES and int(place) == number
        assert script.splitlines()[1] == title and 15 <= int(minutes) <= 30
        assert download == f"{{download}}`{name}.ipynb <gallery/a_course/{name}.ipynb>`"


@pytest.mark.slow
@pytest.mark.parametrize("name", UNITS)
def test_a_notebook_has_its_parts(course, name):
    """Goals, a solution for each exercise, and an audit in four cells; no code of the script is lost or copied."""
    notebook = course.notebook(name)
    texts = ["".join(cell["source"]) for cell in notebook["cells"]]
    assert texts[0].startswith("# ")
    assert texts[1].startswith("## Goals") and len(re.findall("^- ", texts[1], re.MULTILINE)) == 3
    assert texts[2].startswith("## Prerequisites")
    exercises = [place for place, text in enumerate(texts) if text.startswith("**Exercise")]
    assert 2 <= len(exercises) <= 4
    for place in exercises:
        assert texts[place + 1].startswith("<details>\n<summary>Solution</summary>")
        assert "solution" in tags(notebook["cells"][place + 2])
    audit = next(place for place, text in enumerate(texts) if text.startswith("## Audit"))
    kinds = [tags(cell)[0] for cell in notebook["cells"][audit:] if cell["cell_type"] == "code"]
    assert kinds == ["planted", "audit", "solution", "audit"] and texts[-1] == "audit(adjoint)"
    assert sum(":math:" in text or "parser" in text for text in texts) == 0
    code = [text for cell, text in zip(notebook["cells"], texts) if cell["cell_type"] == "code"]
    script = (ROOT / "examples" / f"{name}.py").read_text(encoding="utf-8")
    missing = statements(script) - statements("\n".join(code))
    assert all("pars" in statement for statement in missing), missing
    assert len(course.lesson(name)) == 3 + len(exercises)


def tags(cell):
    return cell["metadata"].get("tags", [""])


def statements(code):
    """The statements of a module, each as text without comments; the docstring is none of them."""
    return {ast.unparse(node) for node in ast.parse(code).body if not is_text(node)}


def is_text(node):
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(UNITS, key=lambda name: name not in LONGEST))
def test_the_planted_mistake_is_found(course, name, tmp_path):
    """The notebook runs; the check disagrees and names the call at fault, and agrees after the repair."""
    path = course.write(name, tmp_path, executed=True)
    notebook = json.loads(path.read_text(encoding="utf-8"))
    check_format(notebook)
    before, after = [printed(cell) for cell in notebook["cells"] if "audit" in tags(cell)]
    assert re.fullmatch(r"verdict: disagrees, culprit: own_\w+\n", before)
    assert after == "verdict: agrees, culprit: None\n"
    figures = [
        output["data"]["image/png"]
        for cell in notebook["cells"]
        for output in cell.get("outputs", [])
        if output["output_type"] == "display_data"
    ]
    assert figures and all(len(figure) > 10_000 for figure in figures)


def check_format(notebook):
    """The keys and types that nbformat 4.5 asks for."""
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    names = [cell["id"] for cell in notebook["cells"]]
    assert len(set(names)) == len(names)
    counts = []
    for cell in notebook["cells"]:
        assert all(isinstance(line, str) for line in cell["source"])
        if cell["cell_type"] == "markdown":
            assert set(cell) == KEYS
            continue
        assert set(cell) == KEYS | {"execution_count", "outputs"}
        counts.append(cell["execution_count"])
        for output in cell["outputs"]:
            assert output["output_type"] in ("stream", "execute_result", "display_data")
    assert counts == list(range(1, len(counts) + 1))


def printed(cell):
    return "".join(line for output in cell["outputs"] for line in output.get("text", []))


@pytest.mark.slow
def test_a_cell_that_fails_ends_the_run(course, tmp_path):
    """A traceback names the line of the cell, and no notebook without outputs stays behind."""
    path = tmp_path / "broken.ipynb"
    cells = [course.code_cell("x = 1"), course.code_cell("x.missing")]
    path.write_text(json.dumps({"cells": cells}), encoding="utf-8")
    with pytest.raises(RuntimeError, match=r"(?s)broken.ipynb fails.*<cell 2>.*x\.missing.*AttributeError"):
        course.execute(path)
    assert not path.exists()
