"""Every example is short, runs small, and says what its page promises."""

import os
import re
import subprocess
import sys
from functools import cache

import pytest
from sources import ROOT

EXAMPLES = sorted(path.name for path in (ROOT / "examples").glob("*.py"))
SMALL = {
    "poisson_adjoint.py": "32",
    "two_families.py": "24",
    "poisson_control.py": "64",
}  # cells; the others run with 16


@cache
def run(name):
    """What an example prints when it runs small."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
    command = [sys.executable, str(ROOT / "examples" / name), SMALL.get(name, "16")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


@pytest.mark.parametrize("name", EXAMPLES)
def test_it_runs(name):
    assert run(name).strip()


@pytest.mark.parametrize("name", EXAMPLES)
def test_short_and_on_both_pages(name):
    text = (ROOT / "examples" / name).read_text(encoding="utf-8")
    assert len(text.splitlines()) < 60
    assert text.startswith('"""') and f"python examples/{name}" in text.splitlines()[0]
    assert f"`{name}`" in (ROOT / "examples" / "README.md").read_text(encoding="utf-8")
    assert f"`examples/{name}`" in (ROOT / "README.md").read_text(encoding="utf-8")


def test_heat_rod():
    printed = run("heat_rod.py")
    assert "three lines against L(u): difference 0e+00" in printed
    assert "verdict: agrees" in printed
    before, after = map(float, re.search(r"loss (\S+) -> (\S+)", printed).groups())
    assert after < before / 10


def test_two_families():
    printed = run("two_families.py")
    losses = re.findall(r"(?:explicit|matrix-free) .* (\d\.\d+)$", printed, re.MULTILINE)
    assert len(losses) == 2 and losses[0] == losses[1]
    assert float(re.search(r"gradients, relative: (\S+)", printed)[1]) < 1e-13
    assert "agrees" in printed and "FAILS" not in printed


def test_new_operator():
    printed = run("new_operator.py")
    assert printed.count(": agrees") >= 3
    assert "wind that never turns: disagrees" in printed


def test_poisson_control():
    """Case B2: the optimum to 1e-8 within 60 iterations, as many on every grid (+-3)."""
    rows = re.findall(r"^ +(\d+)\^2 +(\S+) +\S+ +\S+ +(\S+) +(\d+) +\d+$", run("poisson_control.py"), re.MULTILINE)
    assert len(rows) == 6
    for alpha in ("1e-02", "1e-04"):
        gaps, counts = zip(*((float(gap), int(count)) for _, a, gap, count in rows if a == alpha))
        assert max(gaps) <= 1e-8 and max(counts) <= 60
        assert max(counts) - min(counts) <= 3
