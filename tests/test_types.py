"""A user's script type-checks: right calls pass mypy in its strict mode, wrong calls are reported at their lines."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mypy")
pytestmark = pytest.mark.slow  # mypy reads the whole package

ROOT = Path(__file__).parent.parent
LENIENT = ("--ignore-missing-imports", "--allow-untyped-calls", "--follow-imports=silent")  # autograd has no types

RIGHT = """
from typing import Any

import autograd.numpy as np
import sparsedp as dp

grid = dp.Grid((16, 16), size=1.0)
G = dp.gradient(grid, boundary=dp.dirichlet)
D = dp.divergence(grid)
laplacian: dp.Operator = D @ G
solve = dp.inverse(-laplacian, rtol=1e-10)
u = solve(np.ones(grid.shape))
transposed: dp.Operator = laplacian.T
scaled = 2.0 * laplacian + dp.identity(grid.cells)


def loss(source: Any) -> Any:
    return np.sum(solve(source) ** 2)


value, gradient = dp.value_and_grad(loss)(np.ones(grid.shape))
report = dp.check.gradient(loss, np.ones(grid.shape))
verdict: str = report.verdict

step = dp.stepper("rk4", lambda u, k: k * laplacian(u), 0.01)
final = dp.rollout(step, np.ones(grid.shape), 0.1, 10)
best = dp.minimize(loss, np.ones(grid.shape), "lbfgs", maxiter=5)
x: Any = best.x
transport = dp.transport(grid, "upwind")
project = dp.projection(grid)
dp.save("state.npz", grid, u=u)
fields: dict[str, Any] = dp.load("state.npz")[1]
"""

WRONG = """
import sparsedp as dp

grid = dp.Grid((16, 16), sise=1.0)  # unknown argument
grid.shapes  # unknown attribute
dp.laplasian(grid)  # unknown name
dp.inverse()  # missing argument
dp.laplacian(grid).transposed  # unknown attribute
dp.inverse(dp.laplacian(grid), rtol="small")  # wrong type
dp.rollout(lambda u, p: u, 1.0, 2.0, "ten")  # wrong type
"""


def errors(program, tmp_path):
    """Return the lines of a script at which mypy reports an error, and its report."""
    script = tmp_path / "script.py"
    script.write_text(program, encoding="utf-8")
    command = [sys.executable, "-m", "mypy", "--strict", "--config-file=", *LENIENT, str(script)]
    environment = {**os.environ, "MYPYPATH": str(ROOT)}  # an editable installation is invisible to mypy
    run = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)
    reported = [line for line in run.stdout.splitlines() if line.startswith("script.py:") and ": error: " in line]
    return sorted({int(line.split(":")[1]) for line in reported}), run.stdout


def test_right_calls(tmp_path):
    lines, report = errors(RIGHT, tmp_path)
    assert not lines, report
    assert "Success" in report, report


def test_wrong_calls(tmp_path):
    lines, report = errors(WRONG, tmp_path)
    expected = [number for number, line in enumerate(WRONG.splitlines(), 1) if "#" in line]
    assert lines == expected, report
