"""README.md is short, and every command and code block of it runs and prints what the page says.

- Python blocks are run in order, and compared with the output that stands below them (pages.py).
- Each command of a shell block, here and in CONTRIBUTING.md, is recognised: the demo runs small, an example runs,
  installs and tests are checked against pyproject.toml and the folders of tests.
"""

import os
import re
import shlex
import subprocess
import sys

import numpy as np
import pytest
from pages import SHELL, blocks, check_install, commands, run_blocks, same
from sources import ROOT

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

README = ROOT / "README.md"
GUIDES = sorted(path for path in (ROOT / "docs" / "guides").glob("*.md") if path.name != "index.md")
WITH_COMMANDS = [README, ROOT / "CONTRIBUTING.md"]
COMMANDS = "<!-- commands -->"


def page():
    assert README.exists(), "README.md is missing: its blocks cannot be tested"
    return README.read_text(encoding="utf-8")


# ---- python blocks and their output --------------------------------------------------------------------------------


def test_python_blocks(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_blocks(README)


def test_both_scenes_are_short():
    scenes = [block.text.splitlines() for block in blocks(page()) if block.language == "python"]
    poisson, rollout = [len([line for line in lines if line.strip()]) for lines in scenes]
    assert poisson <= 15 and rollout <= 12


def test_the_pages_at_the_root_are_short():
    assert len(README.read_bytes()) <= 8000
    assert len((ROOT / "CONTRIBUTING.md").read_bytes()) <= 5000


def test_every_guide_is_in_the_table_of_features():
    rows = re.findall(r"^\| [^|]+ \| [^|]+ \| \[[^]]+\]\(docs/guides/(\w+\.md)\) \|$", page(), flags=re.MULTILINE)
    assert sorted(rows) == [path.name for path in GUIDES]


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "examples/README.md"])
def test_relative_links_lead_to_files(name):
    path = ROOT / name
    links = re.findall(r"\]\(([^)#]+)", path.read_text(encoding="utf-8"))
    assert not [link for link in links if "://" not in link and not (path.parent / link).exists()]


def test_the_table_of_examples_is_complete():
    text = (ROOT / "examples" / "README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| `(\w+\.py)`", text, flags=re.MULTILINE)
    assert [int(number) for number, _ in rows] == list(range(1, len(rows) + 1))
    assert {name for _, name in rows} == {path.name for path in (ROOT / "examples").glob("*.py")}
    assert re.search(rf"\b{len(rows)} scripts", page())


def test_comparison_of_printed_text():
    assert same("loss  1.0 -> 2e-3", "loss 1.0000001 ->  0.002", rel_tol=1e-6, abs_tol=0.0)
    assert not same("loss 1.0", "loss 1.1", rel_tol=1e-6, abs_tol=0.0)
    assert not same("loss 1.0", "loss 1.0 more", rel_tol=1e-6, abs_tol=0.0)
    assert same("cells(24, 20) in ... s", "cells(24, 20) in 0.3 s", rel_tol=1e-6, abs_tol=0.0)
    assert not same("cells(24, 20)", "cells(20, 24)", rel_tol=1e-6, abs_tol=0.0)


# ---- shell blocks --------------------------------------------------------------------------------------------------


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
    kept = []
    options = iter(arguments)
    for word in options:
        if word in ("--size", "--out"):
            next(options)
        elif not word.startswith(("--size=", "--out=")):
            kept.append(word)
    if "--input" in kept:
        terrain(folder / kept[kept.index("--input") + 1])
    run_python(["-m", "sparsedp", "demo", *kept, "--size", "24", "--out", str(folder / "out")], folder)
    assert any((folder / "out").iterdir()), "the demo wrote nothing"


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
        assert all((ROOT / word).exists() for word in words[3:] if word.startswith(("tests/", "sparsedp/")))
    elif words[0] == "python" and words[1].startswith("examples/"):
        assert (ROOT / words[1]).exists()
        run(run_python, [str(ROOT / words[1]), *words[2:]], folder)
    elif words[0] == "python" and words[1].startswith("benchmarks/"):
        compile((ROOT / words[1]).read_text(encoding="utf-8"), words[1], "exec")  # takes minutes: not run here
    elif words[:3] == ["python", "-m", "sphinx"]:
        assert (ROOT / words[-2] / "conf.py").exists()  # tests/test_pages.py builds them
    elif words[0] == ".ci/run":
        assert os.access(ROOT / ".ci" / "run", os.X_OK)
    elif words[0] == "pre-commit":
        assert (ROOT / ".pre-commit-config.yaml").exists()
    else:
        assert words[:3] == ["python3", "-m", "venv"] or words[0] in (".", "cd"), f"not recognised: {shlex.join(words)}"


@pytest.mark.parametrize(
    "run",
    [
        pytest.param(lambda *_: None, id="recognised"),
        pytest.param(lambda command, *given: command(*given), id="run", marks=pytest.mark.slow),
    ],
)
def test_shell_blocks(tmp_path, run):
    """Every command is known; the demo and the examples themselves run beside it by default, and here as `slow`."""
    listed = []
    for path in WITH_COMMANDS:
        found = [block for block in blocks(path.read_text(encoding="utf-8")) if block.language in SHELL]
        listed += [words for block in found for words in commands(block.text)]
        assert found or path != README, "README.md has no shell block"
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
        assert all(len(list((ROOT / "tests").rglob(f"test_{word}.py"))) == 1 for word in lists[name].split()), name


def test_the_oldest_versions_are_those_of_the_requirements():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = [*project["dependencies"], *(one for group in project["optional-dependencies"].values() for one in group)]
    assert ci("oldest") == [one.replace(">=", "==") for one in named if ">=" in one]
    extras = [one for one in named if one.startswith("sparsedp[")]  # in extras that are made of extras
    assert len(ci("oldest")) == len(named) - len(extras)
