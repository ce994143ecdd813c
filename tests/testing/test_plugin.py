"""The plugin of pytest, in a project that knows nothing of the operators of this library."""

import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import pytest
from sources import ROOT

from sparsedp.testing.plugin import GradientCheck, annotation

PROJECT = """
import numpy as np
from hypothesis import given
from sparsedp import testing
from sparsedp.testing import fields

x = np.linspace(1.0, 2.0, 5)

def loss(u):
    return np.sum(u**4) / 4

def test_right(assert_gradient):
    assert_gradient(loss, x, gradient=lambda u: u**3)

def test_wrong(assert_gradient):
    assert_gradient(loss, x, gradient=lambda u: np.where(np.arange(5) == 2, 0.9, 1.0) * u**3)

def test_transpose(assert_transpose):
    assert_transpose(lambda u: u[1:] - u[:-1], lambda g: np.diff(g, prepend=0, append=0), shape=6)

def test_kink(assert_gradient):
    assert_gradient(lambda u: np.sum(np.abs(u)), np.zeros(3), gradient=np.sign, allow_inconclusive=True)

@given(fields(4))
def test_fields(u):
    testing.assert_gradient(lambda v: v**3, u, vjp=lambda v, g: 3 * v**2 * g, allow_inconclusive=True)

def test_arguments(assert_gradient):
    assert_gradient(loss, x, gradeint=x)

def test_shape(assert_gradient):
    assert_gradient(loss, x, gradient=x[:3])

def test_user_error(assert_gradient):
    def broken(u, g):
        return g @ np.ones(3)

    assert_gradient(np.exp, x, vjp=broken)
"""


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    folder = tmp_path_factory.mktemp("project")
    (folder / "test_model.py").write_text(PROJECT, encoding="utf-8")
    return folder


def run(folder, *options, **variables):
    """Run the tests of the project in a process, and return what it printed."""
    plugin = ["-p", "no:sparsedp", "-p", "sparsedp.testing.plugin"]  # the same, whether it is installed or not
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PYTEST", "GITHUB"))}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *plugin, *options],
        cwd=folder,
        env={**environment, "PYTHONPATH": str(ROOT), **variables},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 1, done.stdout + done.stderr
    assert "5 failed, 3 passed" in done.stdout
    return done.stdout


@pytest.mark.whole
def test_failures_are_short_by_default(project):
    printed = run(project)
    assert "E       AssertionError: the gradient disagrees: " in printed
    assert "E         largest gap: x[2]: 3.375 by differences, 3.038 by the gradient" in printed
    assert "= gradients =" not in printed and "::error" not in printed
    for name, most in (("wrong", 10), ("transpose", 12), ("arguments", 9), ("shape", 9), ("user_error", 25)):
        shown = printed.partition(f"_ test_{name} _")[2].partition("\n___")[0].partition("\n===")[0]
        assert 3 < len(shown.splitlines()) <= most, shown  # neither tables of gaps nor frames of this library
    assert "Warning" not in printed
    for file in ("assertions", "plugin", "choice", "derivatives", "calls", "programs", "flattening"):
        assert f"{file}.py:" not in printed
    assert "E       TypeError: no check of a derivative has the argument 'gradeint'; write 'gradient'" in printed


@pytest.mark.whole
def test_all_checks_in_a_table_in_junit_and_as_annotations(project, tmp_path):
    file = tmp_path / "junit.xml"
    printed = run(project, "--gradients", "-n", "2", f"--junitxml={file}", GITHUB_ACTIONS="true")
    table = printed.partition("= gradients =")[2].splitlines()[1:]
    verdicts = {line.split("::")[1].partition(",")[0]: line.split()[0] for line in table[1:6]}
    assert verdicts == {
        "test_fields": "inconclusive",  # at some of its examples, all of them in one line
        "test_right": "agrees",
        "test_wrong": "disagrees",
        "test_transpose": "disagrees",
        "test_kink": "inconclusive",
    }
    assert table[6].startswith("5 checks, 2 failed, ")
    (fields,) = (line for line in table if "::test_fields, " in line)
    assert int(fields.rpartition(", ")[2].removesuffix(" times")) >= 20
    assert "verdict: disagrees" in printed  # the tables of a complete check
    annotations = [line for line in printed.splitlines() if line.startswith("::error ")]
    assert len(annotations) == 2
    assert "file=test_model.py,line=16,title=gradient disagrees::along " in annotations[1]
    assert "%0A  largest gap: x[2]: 3.375 by differences" in annotations[1]
    case = next(case for case in ElementTree.parse(file).iter("testcase") if case.get("name") == "test_right")
    properties = {entry.get("name"): entry.get("value") for entry in case.iter("property")}
    assert properties["gradient_1_kind"] == "gradient" and properties["gradient_1_verdict"] == "agrees"
    assert int(properties["gradient_1_digits"]) >= 8 and int(properties["gradient_1_runs"]) > 50


@pytest.mark.whole
def test_a_project_without_gradients_pays_little():
    """pytest imports the plugin in every project: without NumPy, and without the rest of this library."""
    code = "import sys, sparsedp.testing.plugin; print({'numpy', 'sparsedp.check', 'autograd'} & set(sys.modules))"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


def test_annotations_are_escaped():
    check = GradientCheck(
        test="a, b.py::test",
        kind="vjp",
        verdict="disagrees",
        digits=None,
        runs=40,
        seconds=0.1,
        message="100 % wrong:\n  x[1, 2]",
        file="a, b.py",
        line=3,
        passed=False,
    )
    found = annotation(check)
    assert found == "::error file=a%2C b.py,line=3,title=vjp disagrees::100 %25 wrong:%0A  x[1, 2]"


def test_the_fixtures_of_this_environment(assert_gradient, assert_transpose, request):
    assert assert_gradient(lambda u: u**2, 1.5, vjp=lambda u, g: 2 * u * g)
    assert assert_transpose(lambda u: 2 * u, lambda g: 2 * g, shape=3)
    properties = dict(request.node.user_properties)
    assert properties["gradient_1_kind"] == "vjp" and properties["gradient_2_kind"] == "transpose"
    assert properties["gradient_1_verdict"] == properties["gradient_2_verdict"] == "agrees"
