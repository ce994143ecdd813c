"""The test of the tests: seventeen bugs, each planted in a copy of the package, each caught by the tests named here.

Run with  python -m pytest -m slow tests/test_planted.py
"""

import os
import shutil
import subprocess
import sys
from typing import NamedTuple

import pytest
from sources import ROOT


class Bug(NamedTuple):
    """A line of a file, what stands there instead, and the tests that must fail then."""

    file: str
    right: str
    wrong: str
    tests: str


BUGS = {
    "A for the transpose of A": Bug(
        "solvers/direct.py",
        'factors.solve(b, trans="T" if transposed else "N")',
        "factors.solve(b)",
        "tests/test_solvers.py tests/test_solvers_methods.py",
    ),
    "one face flux with the wrong sign": Bug(
        "operators/difference.py",
        "    blocks = {(0, a): along(a, grid.dim, differences(grid, a)) for a in range(grid.dim)}",
        "    blocks = {(0, a): along(a, grid.dim, differences(grid, a), 1.0 - 2 * (a == 1)) for a in range(grid.dim)}",
        "tests/test_operators.py::test_discrete_identities",
    ),
    "a missing 1/h": Bug(
        "operators/stencils.py",
        "    step = 1 / grid.spacings(axis)[face]",
        "    step = np.ones(face.size)",
        "tests/test_operators.py::test_linear_fields_are_exact",
    ),
    "a boundary row that is not transposed": Bug(
        "structure/factor.py",
        "        turned = Factor(self.matrix.T)",
        "        rows = self.matrix.T.tolil()\n"
        "        if rows.shape[0] == rows.shape[1] and rows.shape[0]:\n"
        "            rows[[0]] = self.matrix.tolil()[[0]]\n"
        "        turned = Factor(rows.tocsr())",
        "tests/test_operators.py",
    ),
    "an adjoint without mean removal": Bug(
        "solvers/nullspace.py",
        "        right = self._sides[transposed]\n        real =",
        "        if transposed:\n            return b, norm(b)\n"
        "        right = self._sides[transposed]\n        real =",
        "tests/test_solvers_singular.py",
    ),
    "the mean removed over all components together": Bug(
        "solvers/nullspace.py",
        "        shares = sums / self._products",
        "        shares = np.full_like(sums, np.sum(sums) / np.sum(self._products))",
        "tests/test_solvers_singular.py",
    ),
    "1 as the derivative at a kink": Bug(
        "advection/reference.py",
        "np.heaviside(plain(c), 0.5)",
        "np.heaviside(plain(c), 1.0)",
        "tests/test_transport_rules.py::test_kinks_get_the_mean_of_both_sides",
    ),
    "a stale set-up after a change of the coefficient": Bug(
        "solvers/parametric.py",
        "known = self._cache.find((k, shift))",
        "known = self._cache.last",
        "tests/test_elliptic.py",
    ),
    "a residual tested before unscaling": Bug(
        "solvers/contract.py",
        "        system, goal, transposed = self.system, run.rtol * data, run.transposed",
        "        system, goal, transposed = self.system, run.rtol * max(data, 1.0), run.transposed",
        "tests/test_solvers_use.py::test_a_small_right_hand_side_gives_the_same_bits",
    ),
    "off by one in the last step": Bug(
        "trajectory/backward_pass.py",
        "range(run.n - 1, -1, -1)",
        "range(run.n - 2, -1, -1)",
        "tests/test_rollout.py",
    ),
    "a cotangent of the wrong dtype": Bug(
        "tape.py",
        "    return cast(cotangent, precise)",
        "    return cotangent",
        "tests/test_tape.py tests/test_rules.py tests/test_check_operators.py",
    ),
    "a VJP that holds an array which changes later": Bug(
        "tape.py",
        "values = constant_args(args[1:], nums)",
        "values = args[1:]",
        "tests/test_solvers_use.py::test_a_coefficient_may_be_reused_before_the_pullback",
    ),
    "a product that holds an array which changes later": Bug(
        "traces.py",
        "            args = constant_args(args, nums)",
        "            pass",
        "tests/test_reused_arrays.py::test_views_of_what_is_written_into",
    ),
    "x and y swapped on a grid that is not square": Bug(
        "grid.py",
        '        return self._mesh(["cells"] * self.dim)',
        '        return self._mesh(["cells"] * self.dim)[::-1]',
        "tests/test_grid.py",
    ),
    "a wall value without a derivative": Bug(
        "advection/reference.py",
        "anp.concatenate([u, inflow])",
        "anp.concatenate([u, plain(inflow)])",
        "tests/test_transport_rules.py",
    ),
    "a checkpoint that misses a vector of the optimizer": Bug(
        "optimize/resume.py",
        "        (state, best), history = _restored(template, found.leaves)",
        "        (state, best), history = _restored(template, found.leaves)\n"
        "        state = state._replace(**{state._fields[1]: template[1]})",
        "tests/test_resume.py",
    ),
    "a tolerance that the adjoint ignores": Bug(
        "solvers/contract.py",
        "        system, goal, transposed = self.system, run.rtol * data, run.transposed",
        "        system, transposed = self.system, run.transposed\n"
        "        goal = (1e-2 if transposed else run.rtol) * data",
        "tests/test_solvers.py tests/test_solvers_methods.py tests/test_solvers_use.py",
    ),
}


@pytest.fixture
def copied(tmp_path):
    """A copy of the package and its tests."""
    for name in ("sparsedp", "tests"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("setup.cfg", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path / name)
    return tmp_path


def failures(folder, tests):
    """Run tests in a copy -> (exit code, what was printed). The plain kernels: nothing is compiled again."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "SPARSEDP_NUMBA": "0"}
    command = [sys.executable, "-m", "pytest", "-n0", "-x", "-p", "no:cacheprovider", "--tb=line", *tests.split()]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    return done.returncode, done.stdout


def test_every_bug_fits_its_line():
    assert len(BUGS) == 17
    for name, bug in BUGS.items():
        text = (ROOT / "sparsedp" / bug.file).read_text(encoding="utf-8")
        assert text.count(bug.right) == 1, f"{name}: the line in {bug.file} has changed"
        compile(text.replace(bug.right, bug.wrong), bug.file, "exec")
        assert all((ROOT / file.split("::")[0]).exists() for file in bug.tests.split())


@pytest.mark.slow
@pytest.mark.parametrize("name", BUGS)
def test_it_is_caught(copied, name):
    bug = BUGS[name]
    path = copied / "sparsedp" / bug.file
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace(bug.right, bug.wrong), encoding="utf-8")
    code, printed = failures(copied, bug.tests)
    assert code == 1 and " failed" in printed, f"not caught:\n{printed[-2000:]}"


@pytest.mark.slow
@pytest.mark.parametrize("file", sorted({test.split("::")[0] for bug in BUGS.values() for test in bug.tests.split()}))
def test_without_a_bug_nothing_fails(copied, file):
    code, printed = failures(copied, file)
    assert code == 0, printed[-2000:]
