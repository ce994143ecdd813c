"""Every command and code block of README.md runs, and prints what the page says.

- A python block is executed, after the ones before it. The text block that follows (at once, or after one line that
  ends in a colon) is its real output: words are compared with white space normalised, numbers with a relative
  tolerance, ``...`` stands for anything. A line ``<!-- rtol=1e-3 atol=1e-12 -->`` before the text block sets the
  tolerances.
- Each command of a shell block is recognised: the demo runs small, an example runs, installs and tests are checked
  against pyproject.toml and .ci/run.
"""

import contextlib
import importlib.util
import io
import math
import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import pytest
from sources import ROOT

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

README = ROOT / "README.md"
SHELL = ("sh", "bash", "shell", "console")
NUMBER = r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w])"
COMMANDS = "<!-- commands -->"
MESHES = importlib.util.find_spec("skfem") is not None  # in the extra `test`; a block that needs it is left out without


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, text, line number, and the text between it and the block before it."""

    language: str
    text: str
    line: int
    before: str


def blocks(page):
    found, before, inside = [], [], None
    for number, line in enumerate(page.splitlines(), 1):
        fence = re.match(r"\s*```\s*(\w*)", line)
        if inside is not None and fence:
            found.append(Block(inside[0], "\n".join(inside[2]), inside[1], "\n".join(before)))
            inside, before = None, []
        elif inside is not None:
            inside[2].append(line)
        elif fence:
            inside = (fence[1].lower(), number, [])
        else:
            before.append(line)
    return found


def page():
    assert README.exists(), "README.md is missing: its blocks cannot be tested"
    return README.read_text(encoding="utf-8")


# ---- python blocks and their output --------------------------------------------------------------------------------


def tolerances(text):
    found = dict(re.findall(r"\b(rtol|atol)=([-+.\deE]+)", text))
    return {"rel_tol": float(found.get("rtol", 1e-6)), "abs_tol": float(found.get("atol", 0.0))}


def same(wanted, got, **tolerance):
    """Whether a printed text is the wanted one, numbers within the tolerance and ``...`` for anything."""
    wanted, got = " ".join(wanted.split()), " ".join(got.split())
    numbers, rule = [], ""
    for part in re.split(rf"({NUMBER}|\.\.\.)", wanted):
        if part == "...":
            rule += ".*?"
        elif re.fullmatch(NUMBER, part):
            numbers.append(float(part))
            rule += r"\s*(" + NUMBER + ")"  # columns may shift by a sign
        else:
            rule += re.escape(part)
    found = re.fullmatch(rule, got)
    return found is not None and all(math.isclose(a, float(b), **tolerance) for a, b in zip(numbers, found.groups()))


def test_python_blocks(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    all_blocks, space = blocks(page()), {"__name__": "__readme__"}
    assert any(block.language == "python" for block in all_blocks), "README.md has no python block"
    for block, following in zip(all_blocks, [*all_blocks[1:], Block("", "", 0, "")]):
        if block.language != "python" or ("import skfem" in block.text and not MESHES):
            continue
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(block.text, f"README.md block at line {block.line}", "exec"), space)
        prose = re.sub(r"<!--.*?-->", "", following.before, flags=re.DOTALL).strip()
        wanted = following.text if following.language == "text" and re.fullmatch(r"([^\n]*:)?", prose) else ""
        assert same(wanted, printed.getvalue(), **tolerances(following.before)), (
            f"README.md line {block.line}: the block prints\n{printed.getvalue()}\nthe page says\n{wanted}"
        )


def test_first_scene_is_short():
    first = next(block for block in blocks(page()) if block.language == "python")
    assert len([line for line in first.text.splitlines() if line.strip()]) <= 20


def test_both_tables_of_examples_have_one_order():
    pages = [page(), (ROOT / "examples" / "README.md").read_text(encoding="utf-8")]
    rows = [re.findall(r"^\| (\d+) \| `(?:examples/)?(\w+\.py)`", text, flags=re.MULTILINE) for text in pages]
    assert rows[0] == rows[1] and [int(number) for number, _ in rows[0]] == list(range(1, len(rows[0]) + 1))
    assert {name for _, name in rows[0]} == {path.name for path in (ROOT / "examples").glob("*.py")}


def test_comparison_of_printed_text():
    assert same("loss  1.0 -> 2e-3", "loss 1.0000001 ->  0.002", rel_tol=1e-6, abs_tol=0.0)
    assert not same("loss 1.0", "loss 1.1", rel_tol=1e-6, abs_tol=0.0)
    assert not same("loss 1.0", "loss 1.0 more", rel_tol=1e-6, abs_tol=0.0)
    assert same("cells(24, 20) in ... s", "cells(24, 20) in 0.3 s", rel_tol=1e-6, abs_tol=0.0)
    assert not same("cells(24, 20)", "cells(20, 24)", rel_tol=1e-6, abs_tol=0.0)


# ---- shell blocks --------------------------------------------------------------------------------------------------


def commands(text):
    """Single commands of a shell block: continued lines joined, prompts and comments dropped, split at &&."""
    lines = text.replace("\\\n", " ").splitlines()
    words = [shlex.split(line.removeprefix("$ "), comments=True) for line in lines]
    for line in words:
        while "&&" in line:
            yield line[: line.index("&&")]
            line = line[line.index("&&") + 1 :]
        if line:
            yield line


def run_python(arguments, folder):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, f"{shlex.join(arguments)}\n{done.stdout}\n{done.stderr}"


def terrain(path):
    """A field to stand for the reader's own file."""
    x, y = np.meshgrid(np.linspace(0, 3, 28), np.linspace(0, 2, 24), indexing="ij")
    field = np.sin(x) * np.cos(2 * y) + 0.3 * x
    if path.suffix == ".npz":
        np.savez(path, field=field)
    elif path.suffix == ".npy":
        np.save(path, field)
    else:
        pytest.importorskip("matplotlib.image").imsave(path, field)


def run_demo(arguments, folder):
    """The demo as the page calls it, but small and into a folder of its own."""
    kept, options = [], iter(arguments)
    for word in options:
        if word in ("--size", "--out"):
            next(options)
        elif not word.startswith(("--size=", "--out=")):
            kept.append(word)
    if "--input" in kept:
        terrain(folder / kept[kept.index("--input") + 1])
    run_python(["-m", "sparsedp", "demo", *kept, "--size", "24", "--out", str(folder / "out")], folder)
    assert any((folder / "out").iterdir()), "the demo wrote nothing"


def check_install(arguments):
    extras = set(
        tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    )
    targets = [word for word in arguments if word.startswith((".", "sparsedp"))]
    asked = {extra for word in targets for extra in re.findall(r"[\w-]+", "".join(re.findall(r"\[(.*?)\]", word)))}
    assert targets, f"pip {shlex.join(arguments)} does not install this package"
    assert asked <= extras, f"pyproject.toml has no extras {sorted(asked - extras)}"


def obey(words, folder, run):
    """Check one command of the page; what takes long is given to `run`."""
    if words[:3] == ["python", "-m", "pip"]:
        check_install(words[3:])
    elif words[:4] == ["python", "-m", "sparsedp", "demo"]:
        run(run_demo, words[4:], folder)
    elif words[:3] == ["python", "-m", "sparsedp"]:
        run(run_python, words[1:], folder)
    elif words[:3] == ["python", "-m", "pytest"]:
        assert "python -m pytest" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    elif words[0] == "python" and words[1].startswith("examples/"):
        assert (ROOT / words[1]).exists()
        run(run_python, [str(ROOT / words[1]), *words[2:]], folder)
    elif words[0] == "python" and words[1].startswith("benchmarks/"):
        compile((ROOT / words[1]).read_text(encoding="utf-8"), words[1], "exec")  # takes minutes: not run here
    elif words[0] == ".ci/run":
        assert os.access(ROOT / ".ci" / "run", os.X_OK)
    else:
        assert words[:2] == ["git", "clone"] or words[0] == "cd", f"teach tests/test_readme.py: {shlex.join(words)}"


@pytest.mark.parametrize(
    "run",
    [
        pytest.param(lambda *_: None, id="recognised"),
        pytest.param(lambda command, *given: command(*given), id="run", marks=pytest.mark.slow),
    ],
)
def test_shell_blocks(tmp_path, run):
    """Every command is known; the demo and the examples themselves run beside it by default, and here as `slow`."""
    listed = [words for block in blocks(page()) if block.language in SHELL for words in commands(block.text)]
    assert listed, "README.md has no shell block"
    for number, words in enumerate(listed):
        folder = tmp_path / str(number)
        folder.mkdir()
        obey(words, folder, run)


def test_the_two_commands():
    marked = [block for block in blocks(page()) if block.before.rstrip().endswith(COMMANDS)]
    assert len(marked) == 1 and marked[0].language == "sh", f"one ```sh block must follow the line {COMMANDS}"
    first, second = (line for line in marked[0].text.splitlines() if line.strip())
    install = 'python -m pip install -e ".[all]" && '
    assert first.startswith(install + "python -m sparsedp demo")
    assert second.startswith(install + "python -m pytest")
    assert ci("commands") == [first, second]


def ci(word):
    """What .ci/run says that it runs."""
    return subprocess.run([ROOT / ".ci" / "run", word], capture_output=True, text=True, check=True).stdout.splitlines()


def test_the_virtual_environment_is_the_one_of_the_page():
    """In the checkout, where tests that look at other people's files would find some; git does not."""
    [line] = ci("venv")
    assert f"(`{line}`, Python 3.10 or newer)" in page()
    folder = re.fullmatch(r"python3 -m venv (\S+) && \. (\S+)/bin/activate", line)[1]
    assert f"{folder}/" in (ROOT / ".gitignore").read_text(encoding="utf-8").splitlines()


def test_the_lists_of_tests_name_files():
    text = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    lists = dict(re.findall(r"^(\w+)=\(([^)]+)\)$", text, flags=re.MULTILINE))
    for name in ("quick", "plain"):
        assert all((ROOT / "tests" / f"test_{word}.py").exists() for word in lists[name].split()), name


def test_the_oldest_versions_are_those_of_the_requirements():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = [*project["dependencies"], *(one for group in project["optional-dependencies"].values() for one in group)]
    assert ci("oldest") == [one.replace(">=", "==") for one in named if ">=" in one]
    assert len(ci("oldest")) == len(named) - 1  # all but the extra that is made of extras
