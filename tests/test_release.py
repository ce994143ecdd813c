"""The release: one version, a workflow that says what .ci/run does, a wheel that works without the checkout."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from packaging.version import Version
from pages import tomllib
from sources import ROOT

import sparsedp

yaml = pytest.importorskip("yaml", reason='pyyaml is not installed: python -m pip install -e ".[test]"')

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
SETTINGS = (".toml", ".cff", ".cfg", ".md", ".in")
SMOKE = """
from pathlib import Path
import autograd.numpy as np
import sparsedp as dp
assert "site-packages" in Path(dp.__file__).parts, dp.__file__
assert dp.__version__ == VERSION, dp.__version__
assert (Path(dp.__file__).parent / "__init__.pyi").exists()
for name in dir(dp):
    getattr(dp, name)
grid = dp.Grid((16, 12), size=1.0)
solve = dp.inverse(-dp.laplacian(grid, dp.dirichlet))
print(dp.check.gradient(lambda b: np.sum(solve(b) ** 2), np.ones(grid.shape)).verdict)
"""


def read(name):
    return yaml.safe_load((ROOT / name).read_text(encoding="utf-8"))


def ci(*words):
    done = subprocess.run([ROOT / ".ci" / "run", *words], capture_output=True, text=True, check=True, timeout=60)
    return done.stdout.splitlines()


# ---- what is written in more than one place --------------------------------------------------------------------------


def test_the_version_is_the_same_everywhere():
    dated = re.findall(r"^## \[(\d[^\]]*)\] - (\S+)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.M)
    citation = read("CITATION.cff")
    assert (citation["version"], str(citation["date-released"])) == dated[0]
    assert {citation["version"], read("recipe/meta.yaml")["package"]["version"]} == {PROJECT["version"]}


CHECKLIST = (ROOT / "docs" / "release.md").read_text(encoding="utf-8")


def test_the_checklist_names_every_line_with_the_version():
    """Filled in, its lines equal those in the files; no other file of the root or the recipe has the version."""
    lines = re.findall(r"^\| `([\w./]+)` \| `(.+)` \|$", CHECKLIST, re.M)
    date = str(read("CITATION.cff")["date-released"])
    for file, line in lines:
        wanted = line.replace("X.Y.Z", PROJECT["version"]).replace("YYYY-MM-DD", date)
        text = (ROOT / file).read_text(encoding="utf-8")
        assert [known.strip() for known in text.splitlines()].count(wanted) == 1, (file, wanted)
    places = [ROOT / "recipe" / "meta.yaml", *(path for path in ROOT.iterdir() if path.suffix in SETTINGS)]
    version = re.compile(rf"\bversion\b.*{re.escape(PROJECT['version'])}|^## \[{re.escape(PROJECT['version'])}\]", re.M)
    holders = {path.relative_to(ROOT).as_posix() for path in places if version.search(path.read_text(encoding="utf-8"))}
    assert holders == {file for file, _ in lines}


def test_the_checklist_says_what_the_next_version_is():
    [following] = re.findall(r"the next release is (\d+\.\d+\.\d+)\.", CHECKLIST)
    assert Version(following) > Version(PROJECT["version"])


@pytest.mark.parametrize("version", [PROJECT["version"], "0.2.0", "0.3.0rc1", "0.3.0", "1.0.0rc12"])
def test_versions_are_written_as_the_index_writes_them(version):
    """The version is the name of the files, the tag, and the heading in CHANGELOG.md."""
    assert re.fullmatch(r"\d+\.\d+\.\d+(rc[1-9]\d*)?", version) and str(Version(version)) == version


def is_overdue(removal, version):
    """Whether a name that is removed in `removal` may not be in `version`; a candidate counts as its release."""
    return Version(version).release[:2] >= Version(removal).release


@pytest.mark.parametrize(
    ("version", "overdue"),
    [("0.4.9", False), ("0.5.0rc1", True), ("0.5.0", True), ("0.10.0", True), ("1.0.0rc1", True)],
)
def test_a_removal_is_due_from_its_first_candidate(version, overdue):
    assert is_overdue("0.5", version) == overdue


def removals():
    """Yield versions that remove a deprecated name, with the place of the warning."""
    call = re.compile(r'(?:warn_deprecated|deprecated_attribute)\(.*, "(\d+\.\d+)"\)')
    for path in (ROOT / "sparsedp").rglob("*.py"):
        yield from ((path.name, removal) for removal in call.findall(path.read_text(encoding="utf-8")))
    for name, (_, removal) in sparsedp._DEPRECATED.items():
        yield name, removal


def test_no_deprecated_name_is_overdue():
    found = list(removals())
    assert len(found) > len(sparsedp._DEPRECATED)
    assert not [place for place, removal in found if is_overdue(removal, PROJECT["version"])]


def test_the_recipe_asks_for_what_the_project_asks_for():
    needs = {
        kind: [one.replace(" ", "") for one in many] for kind, many in read("recipe/meta.yaml")["requirements"].items()
    }
    extras = PROJECT["optional-dependencies"]
    assert needs["run"] == [f"python{PROJECT['requires-python']}", *PROJECT["dependencies"]]
    assert needs["run_constrained"] == [
        one.replace("matplotlib>", "matplotlib-base>") for one in (*extras["fast"], *extras["plot"])
    ]
    build = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["build-system"]["requires"]
    assert needs["host"] == [needs["run"][0], "pip", *build]


def workflow():
    return read(".github/workflows/ci.yml")["jobs"]


def test_the_jobs_of_the_workflow_are_those_of_ci_run():
    assert list(workflow()) == ci("jobs")


@pytest.mark.parametrize("name", workflow())
def test_the_commands_of_the_workflow_are_those_of_ci_run(name):
    """And nothing beside them but the checkout and a Python: what is green there is green here."""
    steps = workflow()[name]["steps"]
    assert [step["run"] for step in steps if "run" in step] == ci("job", name)
    used = [step["uses"].split("@")[0] for step in steps if "uses" in step]
    assert used == ["actions/checkout", "actions/setup-python"]
    assert all(set(step) <= {"run", "uses", "with"} for step in steps)


def test_the_workflow_runs_on_every_system_and_python_that_is_promised():
    matrix = workflow()["newest"]["strategy"]["matrix"]
    promised = [one.rsplit(" ", 1)[1] for one in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", one)]
    assert matrix["python"] == promised == [f"3.{minor}" for minor in range(10, 15)]
    assert [system.removesuffix("-latest") for system in matrix["os"]] == ["ubuntu", "macos", "windows"]
    assert "3.10" in workflow()["oldest"]["strategy"]["matrix"]["python"]


def test_the_workflow_runs_on_the_tags_of_the_checklist():
    tags = re.findall(r"git tag -a (\S+) ", CHECKLIST)
    assert tags == ["vX.Y.Z"]
    assert read(".github/workflows/ci.yml")[True]["push"] == {"branches": ["main"], "tags": ["v*"]}  # YAML: on is true


def test_ci_run_goes_through_its_jobs():
    text = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    run = set(re.findall(r"^ *run_job (\w+)$", text, re.M))
    assert {*run, "newest"} == set(ci("jobs"))  # the README's two commands are its first stages


@pytest.mark.parametrize("selection", ["quick", "plain"])
def test_every_name_of_a_selection_is_a_file_of_tests(selection):
    """A name without a file would be left out in silence."""
    text = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    names = re.search(rf"^{selection}=\(([^)]*)\)", text, re.M)[1].split()
    assert sorted(Path(path).stem for path in ci("tests", selection)) == sorted(f"test_{name}" for name in names)


def test_an_unknown_job_is_refused():
    done = subprocess.run(
        [ROOT / ".ci" / "run", "job", "none"], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode and done.stderr.startswith("ci: there is no job none; the jobs are: newest lint oldest")


@pytest.mark.parametrize("name", ["bug", "gradient", "question"])
def test_issue_forms(name):
    form = read(f".github/ISSUE_TEMPLATE/{name}.yml")
    assert {"name", "description", "body"} <= set(form)
    assert all(field["type"] == "textarea" and field["attributes"]["label"] for field in form["body"])
    assert any(field.get("validations", {}).get("required") for field in form["body"])


# ---- sdist and wheel -------------------------------------------------------------------------------------------------


def run(*words, folder):
    """Run a command without the checkout on its path; return its output."""
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME")}
    done = subprocess.run(
        words,
        cwd=folder,
        env={**environment, "MPLBACKEND": "Agg", "PYTHONNOUSERSITE": "1"},
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )
    assert done.returncode == 0, f"{words}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Folder with sdist and wheel, made from a copy of what git knows."""
    for module in ("build", "twine"):
        pytest.importorskip(module, reason=f'{module} is not installed: python -m pip install -e ".[release]"')
    copy = tmp_path_factory.mktemp("release") / "tree"
    junk = shutil.ignore_patterns(
        ".git", ".venv", "venv", "__pycache__", "*.egg-info", "build", "dist", "_build", ".*_cache"
    )
    shutil.copytree(ROOT, copy, ignore=junk)
    run(sys.executable, "-m", "build", folder=copy)
    return copy / "dist"


@pytest.mark.slow
def test_sdist_and_wheel_are_sound(built):
    sdist, wheel = (next(built.glob(f"*.{kind}")) for kind in ("tar.gz", "whl"))
    version = PROJECT["version"]
    assert (sdist.name, wheel.name) == (f"sparsedp-{version}.tar.gz", f"sparsedp-{version}-py3-none-any.whl")
    said = run(sys.executable, "-m", "twine", "check", "--strict", str(sdist), str(wheel), folder=built)
    assert said.count("PASSED") == 2
    packed = {name for name in zipfile.ZipFile(wheel).namelist() if "dist-info" not in name}
    sources = (path for kind in ("*.py", "*.pyi", "py.typed") for path in (ROOT / "sparsedp").rglob(kind))
    assert packed == {path.relative_to(ROOT).as_posix() for path in sources}
    with tarfile.open(sdist) as archive:
        inside = {Path(*Path(name).parts[1:]).as_posix() for name in archive.getnames()}
    folders = ("tests", "examples", "docs", "benchmarks", "recipe", ".github")
    kept = {
        path.relative_to(ROOT).as_posix()
        for folder in folders
        for kind in ("py", "md", "rst", "yml", "yaml", "css", "png")
        for path in (ROOT / folder).rglob(f"*.{kind}")
        if not {"_build", "api", "gallery"} & set(path.relative_to(ROOT).parts)
    }
    names = ".gitignore .pre-commit-config.yaml CHANGELOG.md CITATION.cff CONTRIBUTING.md LICENSE README.md setup.cfg"
    assert packed | kept | {".ci/run", *names.split()} <= inside  # all that the tests of a checkout read


@pytest.mark.slow
def test_the_wheel_works_without_the_checkout(built, tmp_path):
    """It also has types for users: mypy ignores types of an installed package without the file py.typed."""
    run(sys.executable, "-m", "venv", "clean", folder=tmp_path)
    python = str(tmp_path / "clean" / ("Scripts" if os.name == "nt" else "bin") / "python")
    [wheel] = built.glob("*.whl")
    run(python, "-m", "pip", "install", str(wheel), folder=tmp_path)
    (tmp_path / "script.py").write_text("import sparsedp\nreveal_type(sparsedp.Grid((2,)).dim)\n", encoding="utf-8")
    options = ["--config-file=", "--follow-imports=silent", "--ignore-missing-imports", "--python-executable", python]
    assert 'Revealed type is "int"' in run(sys.executable, "-m", "mypy", *options, "script.py", folder=tmp_path)
    assert run(python, "-c", SMOKE.replace("VERSION", repr(PROJECT["version"])), folder=tmp_path).split() == ["agrees"]
    said = run(python, "-m", "sparsedp", "demo", "--size", "16", "--out", "demo", folder=tmp_path)
    assert "Error against run time" in said and (tmp_path / "demo" / "table.csv").exists()
