"""The course as notebooks: each is assembled from an example and a lesson, executed, and offered on a page.

The example, `examples/NAME.py`, holds the text and the code of the steps and the questions of the exercises. The
lesson, `examples/course/NAME.md`, holds what a course adds: goals, prerequisites, solutions of the exercises, and the
audit of a gradient with one planted mistake. Nothing stands in both.

Why not jupytext: it pairs one script with one notebook. The scripts of the gallery are reST (Sphinx-Gallery renders
them), take options on the command line, and are run by the tests as processes; a paired notebook would need Markdown
text, no `argparse`, and cells that the script must not have (solutions, wrong code). That would be a second copy of
each script. Here the script stays the only source of its code and of every number, and the lesson refers to its names.
"""

import argparse
import ast
import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path
from unittest import mock

import gallery_scripts
from gallery_scripts import ROOT
from sphinx_gallery.notebook import rst2md
from sphinx_gallery.py_source_parser import split_code_and_text_blocks

LESSONS = ROOT / "examples" / "course"
EXECUTED = Path(__file__).parent / "_build" / "course"  # a notebook stays here until its cells change
RUNNER = Path(__file__).parent / "run_notebook.py"
HEADING_LEVELS = {(None, "="): 1, (None, "-"): 2}
FOLDED = {"jupyter": {"source_hidden": True, "outputs_hidden": True}}  # JupyterLab opens such a cell by a click
INSTALL = """- The package with its extras: in a checkout, `python -m pip install -e ".[all]"`."""
OPTIONS = """# The options of the script. Sizes are small, so that every cell runs in seconds.
options = SimpleNamespace({})"""
EXERCISES = """## Exercises

Each has a solution below it. Open a text by a click on *Solution*, a folded code cell by a click on its bar. Code of a
solution is an ordinary cell: change it and run it again."""
METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"file_extension": ".py", "mimetype": "text/x-python", "name": "python"},
}


def units():
    """Return the names of the examples of the course in order: the first section of examples/README.md."""
    _, _, rows = next(gallery_scripts.sections())
    return [Path(script).stem for script in rows]


# ---- the cells -------------------------------------------------------------------------------------------------------


def text_cell(text, tags=()):
    """Return a Markdown cell."""
    return {"cell_type": "markdown", "metadata": metadata_of(tags), "source": text.strip().splitlines(True)}


def code_cell(code, tags=()):
    """Return a code cell without outputs. A solution is folded."""
    metadata = metadata_of(tags)
    if "solution" in tags:
        metadata |= FOLDED
    source = code.strip().splitlines(True)
    return {"cell_type": "code", "metadata": metadata, "execution_count": None, "outputs": [], "source": source}


def metadata_of(tags):
    """Return the metadata of a cell with tags, by which tools of Jupyter select cells."""
    return {"tags": list(tags)} if tags else {}


def notebook(name):
    """Return the notebook of a unit without outputs, as a dict in the format nbformat 4.5."""
    parts = lesson(name)
    introduction, steps, questions = script_cells(name)
    cells = [
        introduction,
        text_cell("## Goals\n\n" + parts["Goals"][0]["text"]),
        text_cell("## Prerequisites\n\n" + parts["Prerequisites"][0]["text"] + "\n" + INSTALL),
        *steps,
        text_cell(EXERCISES),
    ]
    for number, question in enumerate(questions, 1):
        cells.append(text_cell(f"**Exercise {number}.** {question}"))
        cells += [solution_cell(piece) for piece in parts[f"Solution {number}"]]
    cells.append(text_cell("## Audit\n\n" + parts["Audit"][0]["text"]))
    cells += [lesson_cell(piece) for piece in parts["Audit"][1:]]
    for number, cell in enumerate(cells):
        cell["id"] = f"cell-{number}"
    return {"cells": cells, "metadata": METADATA, "nbformat": 4, "nbformat_minor": 5}


def lesson_cell(piece):
    """Return the cell of a piece of a lesson."""
    if piece["kind"] == "text":
        return text_cell(piece["text"])
    return code_cell(piece["text"], piece["tags"])


def solution_cell(piece):
    """Return the folded cell of a piece of a solution."""
    if piece["kind"] == "text":
        return text_cell(f"<details>\n<summary>Solution</summary>\n\n{piece['text']}\n\n</details>", ["solution"])
    return code_cell(piece["text"], ["solution"])


def lesson(name):
    """Return the parts of a lesson: a list of pieces, texts and code with tags, for each heading."""
    text = (LESSONS / f"{name}.md").read_text(encoding="utf-8")
    fences = re.split(r"^```python *(.*?)\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)
    parts = {}
    pieces = []
    for prose, tags, code in zip(fences[::3], [*fences[1::3], ""], [*fences[2::3], ""]):
        before, *sections = re.split(r"^# (.+)$", prose, flags=re.MULTILINE)
        texts = [before, *sections[1::2]]
        for heading, body in zip([None, *sections[::2]], texts):
            if heading is not None:
                pieces = parts[heading] = []
            if body.strip():
                pieces.append({"kind": "text", "text": body.strip()})
        if code:
            pieces.append({"kind": "code", "text": code, "tags": tags.split()})
    return parts


# ---- from the script -------------------------------------------------------------------------------------------------


def script_cells(name):
    """Return the cells of a script: its introduction, its steps, and the questions of its exercises as Markdown."""
    _, blocks = split_code_and_text_blocks(ROOT / "examples" / f"{name}.py")
    introduction, *rest = blocks
    steps = []
    questions = []
    for kind, content, _ in rest:
        if kind == "code":
            steps.append(code_cell(without_command_line(name, content)))
            continue
        text, _, exercises = markdown(content).partition("## Exercises")
        if text.strip():
            steps.append(text_cell(text))
        questions += re.findall(r"^\d\. (.*?)(?=^\d\. |\Z)", exercises, flags=re.MULTILINE | re.DOTALL)
    return text_cell(markdown(introduction[1])), steps, [" ".join(question.split()) for question in questions]


def markdown(text):
    """Return the Markdown of a text cell of a script, which is reST."""
    converted = rst2md(text, {"notebook_images": False}, ".", HEADING_LEVELS)
    return re.sub(r"\\begin{align}(.*?)\\end{align}", r"$$\1$$", converted, flags=re.DOTALL)


def without_command_line(name, code):
    """Return code of a script with the values of its options in the place of the parser of the command line."""
    lines = code.splitlines()
    statements = [node for node in ast.parse(code).body if uses_parser(node)]
    if not statements:
        return code
    for node in statements:
        lines[node.lineno - 1 : node.end_lineno] = [None] * (node.end_lineno - node.lineno + 1)
    lines[statements[0].lineno - 1] = OPTIONS.format(options_of(name, statements))
    lines[lines.index("import argparse")] = None
    lines.insert(lines.index("from pathlib import Path") + 1, "from types import SimpleNamespace")
    return "\n".join(line for line in lines if line is not None)


def uses_parser(node):
    """Whether a statement uses the parser of the command line."""
    return any(isinstance(part, ast.Name) and part.id == "parser" for part in ast.walk(node))


def options_of(name, statements):
    """Return the options of a script as keyword arguments, at the size that the tests run it with."""
    space = {"argparse": argparse, "Path": Path}
    given = [f"{name}.py", gallery_scripts.size(f"{name}.py"), "--out", name]
    with mock.patch.object(sys, "argv", given):
        exec(compile(ast.Module(statements, []), given[0], "exec"), space)
    values = vars(space["options"])
    arguments = []
    for key, value in values.items():
        text = f'Path("{value}")' if isinstance(value, Path) else repr(value)
        arguments.append(f"{key}={text}")
    return ", ".join(arguments)


# ---- the files -------------------------------------------------------------------------------------------------------


def write(name, folder, executed):
    """Write the notebook of a unit into a folder, executed or without outputs, and return its path."""
    path = folder / f"{name}.ipynb"
    wanted = notebook(name)
    if path.exists() and is_current(json.loads(path.read_text(encoding="utf-8")), wanted, executed):
        return path
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(wanted, indent=1) + "\n", encoding="utf-8")
    if executed:
        execute(path)
    return path


def is_current(found, wanted, executed):
    """Whether a notebook has the wanted cells, and outputs if and only if it is to be executed."""
    has_outputs = any(cell.get("outputs") for cell in found["cells"])
    sources = [[(cell["source"], cell["metadata"]) for cell in book["cells"]] for book in (found, wanted)]
    return sources[0] == sources[1] and has_outputs == executed


def execute(path):
    """Execute a notebook in place, in a process of its own."""
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "MPLBACKEND": "Agg", "PYTHONPATH": os.pathsep.join(paths)}
    done = subprocess.run(
        [sys.executable, str(RUNNER), path.name],
        cwd=path.parent,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    if done.returncode != 0:
        path.unlink()
        raise RuntimeError(f"the notebook {path.name} fails:\n{done.stderr}")
    return done.stderr


def offer(app):
    """Replace the notebooks of Sphinx-Gallery by those of the course, where a page of the gallery offers them."""
    pattern = re.compile(app.config.sphinx_gallery_conf["filename_pattern"])
    title, *_ = next(gallery_scripts.sections())
    pages = Path(app.srcdir) / "gallery" / gallery_scripts.folder(title)
    for name in units():
        path = write(name, EXECUTED, executed=bool(pattern.search(f"/{name}.py")))
        (pages / path.name).write_bytes(path.read_bytes())
        with zipfile.ZipFile(pages / f"{name}.zip", "w", zipfile.ZIP_DEFLATED) as archive:
            for file in (f"{name}.py", path.name):
                archive.write(pages / file, file)
