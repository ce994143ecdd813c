"""The test of the campaign: faults of many kinds, each planted in a copy of the package, each found by random scenes.

    python -m pytest -n0 -m slow tests/test_campaign_faults.py

prints for each fault after how many scenes it was found, and checks that the program that was written shows it.
"""

import os
import re
import subprocess
import sys

import pytest
from sources import ROOT
from test_planted import Bug, copied, planted  # noqa: F401 (a fixture)

SCENES = 2000
FAULTS = {
    "a value on a lower wall with the wrong sign": Bug(
        "operators",
        "slope = (2 * side - 1) / (condition.a * half + condition.b)",
        "slope = 1.0 / (condition.a * half + condition.b)",
        "",
    ),
    "a direct solve that does not transpose": Bug(
        "solvers", 'factors.solve(b, trans="T" if transposed else "N")', "factors.solve(b)", ""
    ),
    "a set-up that is kept though the data changed": Bug(
        "solvers",
        "if len(entry_key) == len(key) and all(map(_are_equal, entry_key, key)):",
        "if len(entry_key) == len(key):",
        "",
    ),
    "a JVP of a solve without the share of the coefficients": Bug(
        "solvers", "            total = total - change\n", "", ""
    ),
    "the cotangent of one field for a batch of them": Bug(
        "autodiff/derivative.py", "cotangent = anp.sum(cotangent, axis=0)", "cotangent = cotangent[0]", ""
    ),
    "inputs whose cotangents go to the step before": Bug(
        "trajectory", "row[state.i] = sums.pop(root)[0]", "row[state.i - 1] = sums.pop(root)[0]", ""
    ),
    "cotangents of kept states at the step before": Bug(
        "trajectory",
        "return [block[row] for block in blocks]",
        "return [block[row - 1] for block in blocks]",
        "",
    ),
    "a truncation one step early": Bug(
        "trajectory",
        "range(self.n - self.truncate, 0, -self.truncate)",
        "range(self.n - self.truncate - 1, 0, -self.truncate)",
        "",
    ),
    "a gradient in another precision than its argument": Bug(
        "autodiff/derivative.py",
        'return _as_leaf(fit("the gradient", leaf, cotangent, cotangent), leaf)',
        "return _as_leaf(cotangent, leaf)",
        "",
    ),
    "entries of dicts paired by their place": Bug(
        "_utils/pytree.py",
        '        _check_names("key", tree, reference)\n        return reference.keys()\n',
        '        _check_names("key", tree, reference)\n        return tree.keys()\n',
        "",
    ),
    "an adjoint null space equal to the forward one": Bug(
        "solvers", "part = self._sides[transposed]\n", "part = self._sides[0]\n", ""
    ),
    "an ensemble whose gradient has no weights": Bug("parallel", "[weight * part for part in parts]", "parts", ""),
    "a departure point as far as the whole step at half of it": Bug(
        "advection",
        "Trajectory(interpolant.half_way, w, 0.5 * step)",
        "Trajectory(interpolant.half_way, w, step)",
        "",
    ),
    "the derivative of a root with the wrong sign": Bug(
        "solvers",
        "-push(varied, chosen, tangents)[1], equation, ans, *leaves)",
        "push(varied, chosen, tangents)[1], equation, ans, *leaves)",
        "",
    ),
    "a flow step that forgets the acceleration before": Bug(
        "flow", 'self._half_step_ahead(a, state["a"], state, dt)', "a", ""
    ),
}


def run(command, folder, **variables):
    """Run Python in a folder with the package that is there."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "SPARSEDP_NUMBA": "0", **variables}
    environment.pop("PYTHONPYCACHEPREFIX", None)
    return subprocess.run(
        [sys.executable, *command], cwd=folder, env=environment, capture_output=True, text=True, timeout=3600
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_found(copied, name, tmp_path, capsys):  # noqa: F811
    path, text = planted(copied, FAULTS[name])
    right = path.read_text(encoding="utf-8")
    path.write_text(text, encoding="utf-8")
    try:
        command = ["-m", "pytest", "-n0", "-x", "-p", "no:cacheprovider", "-m", "campaign", "tests/test_campaign.py"]
        done = run(command, copied, SPARSEDP_SCENES=str(SCENES), SPARSEDP_FAILURES=str(tmp_path))
        count = re.search(r"after (\d+) scenes", done.stdout)
        assert count, f"not found in {SCENES} scenes: {done.stdout[-2000:]}"
        with capsys.disabled():
            print(f"\n{name}: found after {count.group(1)} scenes")
        (program,) = tmp_path.glob("*.py")
        assert "Mismatch" in run([str(program)], copied).stderr
    finally:
        path.write_text(right, encoding="utf-8")
    assert run([str(program)], ROOT).returncode == 0


def test_every_fault_fits_its_line():
    for fault in FAULTS.values():
        path, text = planted(ROOT, fault)
        compile(text, path.name, "exec")
