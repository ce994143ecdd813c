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
    "warm_start.py": "64",
    "implicit_or_unrolled.py": "96",
    "inexact_solves.py": "30",
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


def test_warm_start():
    """Case B6: plain CG 100 to 170 iterations to 1e-3; multigrid at most 5, and at most 10 to 1e-6."""
    printed = run("warm_start.py")
    plain = float(re.search(r"^plain CG from zero +(\S+)", printed, re.MULTILINE)[1])
    largest = float(re.search(r"above 1e-3: (\d+\.\d)", printed)[1])
    assert 100 <= largest <= plain <= 170
    coarse, fine = map(float, re.search(r"^multigrid from zero +(\S+) +(\S+)", printed, re.MULTILINE).groups())
    assert coarse <= 5 and fine <= 10


def test_implicit_or_unrolled():
    """Case B8: the same gradient, at least 20 times less memory, at least 5 times less time."""
    rows = re.findall(r"^(\S.*?) +(\d+)\^2 +(\S+) +(\S+) +(\S+)$", run("implicit_or_unrolled.py"), re.MULTILINE)
    table = {(label, int(n)): tuple(map(float, figures)) for label, n, *figures in rows}
    assert len(table) == 10
    for n in (48, 96):
        taped, cut = table["CG, 200 iterations unrolled", n], table["CG, 20 iterations unrolled", n]
        for label in ("CG, implicit", "multigrid, implicit", "chosen by itself, implicit"):
            assert table[label, n][1] <= taped[1] / 20 and table[label, n][2] <= 1e-10
        assert table["chosen by itself, implicit", n][0] <= taped[0] / 5
        assert cut[2] > 0.1
    assert table["CG, implicit", 48][0] <= table["CG, 200 iterations unrolled", 48][0] / 5
    assert table["CG, 200 iterations unrolled", 48][2] <= 1e-10  # 200 iterations are enough here
    assert 1e-8 <= table["CG, 200 iterations unrolled", 96][2] <= 1e-4  # and not here


def test_inexact_solves():
    """Case B7: the published figures, at least 80 % fewer sweeps at no larger error, and one exact step."""
    rows = re.findall(r"^(\S.*?) +(\d+) +(?:-|\d+) +(\d\.\S+) +\S+$", run("inexact_solves.py"), re.MULTILINE)
    (many, error), (refined, after), few, _, (certified, sure), (_, exact) = ((int(n), float(e)) for _, n, e in rows)
    assert many == 75000 and abs(error - 1.30e-5) < 0.005e-5
    assert refined <= 0.7 * many and after < 2e-5
    assert certified <= 0.2 * many and sure <= error
    assert few[1] > 100 * error  # a number of sweeps that is guessed too low says nothing
    assert exact <= 1e-14
