"""The demo: it recovers what it hid, it leaves its files, and it refuses what it cannot use in one sentence."""

import csv
import importlib.util
import io
import os
import re
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from sources import ROOT

import sparsedp as dp
from sparsedp.__main__ import main
from sparsedp.report.demo import scene, story, terrain

pytestmark = pytest.mark.xdist_group("demo")  # most of them look at one run
PICTURES = importlib.util.find_spec("matplotlib") is not None
WRITTEN = (*(story.PICTURES if PICTURES else ()), *story.ARRAYS)


def relief(shape=(28, 24)):
    x, y = np.meshgrid(np.linspace(0, 3, shape[0]), np.linspace(0, 2, shape[1]), indexing="ij")
    return np.sin(x) * np.cos(2 * y) + 0.3 * x


def demo(folder, *arguments, way=("-m", "sparsedp"), **variables):
    """The command in a process of its own, as a reader types it."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg", **variables}
    command = [sys.executable, *way, "demo", *map(str, arguments)]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


# ---- a run ---------------------------------------------------------------------------------------------------------


FEWER = "import sys; from sparsedp.report.demo import story; story.ITERATIONS = 4; from sparsedp.__main__ import main; "


@pytest.fixture(scope="module", params=["short", pytest.param("whole", marks=pytest.mark.whole)])
def finished(request, tmp_path_factory):
    """One small run with the default terrain, shared by the tests that look at it; by default with few iterations.

    The whole one compiles its loops.
    """
    folder = tmp_path_factory.mktemp("demo")
    if request.param == "short":
        done = demo(folder, "--size", "16", way=["-c", FEWER + "sys.exit(main(sys.argv[1:]))"])
    else:
        done = demo(folder, "--size", "16", NUMBA_CACHE_DIR=str(folder / "numba"))
    return folder / "sparsedp-demo", done


def test_the_demo_succeeds(finished):
    folder, done = finished
    assert done.returncode == 0, done.stderr
    assert sorted(os.listdir(folder)) == sorted(WRITTEN)
    assert "jacksboro_fault_dem.npz" in done.stdout if PICTURES else "generated" in done.stdout


def test_it_shows_the_gradient_table_and_its_verdict(finished):
    assert re.search(r"^verdict: agrees", finished[1].stdout, re.MULTILINE)


def rows_of(finished, name):
    with open(finished[0] / name, newline="") as stream:
        return list(csv.DictReader(stream))


def test_it_prints_one_line_for_the_iterations_of_each_grid(finished):
    line = r"^ +(\d+) iterations, [\d.]+ s: misfit/noise ([\d.]+), error [\d.]+$"
    lines = re.findall(line, finished[1].stdout, re.MULTILINE)
    rows = rows_of(finished, "table.csv")
    assert [int(number) for number, _ in lines] == [int(row["iterations"]) for row in rows]
    assert [misfit for _, misfit in lines] == [f"{float(row['misfit']):.3f}" for row in rows]
    assert len(finished[1].stdout.splitlines()) < 60


def test_iterations_of_the_picture(finished):
    """Every iteration of every grid, the last ones as in the table."""
    iterations = rows_of(finished, "convergence.csv")
    for row in rows_of(finished, "table.csv"):
        run = [iteration for iteration in iterations if iteration["grid"] == row["grid"]]
        assert [int(iteration["iterations"]) for iteration in run] == list(range(1, int(row["iterations"]) + 1))
        assert [run[-1][name] for name in ("seconds", "misfit", "error")] == [
            row["seconds"],
            row["misfit"],
            row["error"],
        ]


def test_the_seconds_contain_no_compilation(finished):
    """The first iteration takes a few times what the others take; compiling the loops takes seconds."""
    iterations = rows_of(finished, "convergence.csv")
    for row in rows_of(finished, "table.csv"):
        first = next(float(iteration["seconds"]) for iteration in iterations if iteration["grid"] == row["grid"])
        assert first <= 0.1 + 10 * float(row["seconds"]) / int(row["iterations"])


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_terminal_shows_a_bar_of_iterations(finished, monkeypatch):
    """A log does not."""
    pytest.importorskip("tqdm")
    assert "cells:" not in finished[1].stderr
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setattr(story, "ITERATIONS", 2)
    monkeypatch.setattr(dp.check, "gradient", audit("agrees"))
    ground = terrain.Terrain(relief(), "relief")
    study = story.prepare(ground, story.grids_for(ground, 12))
    story.recover(study, study.grids[0])
    assert "6 x 5 cells:   0%" in sys.stderr.getvalue()


def test_it_ends_with_what_to_try_next(finished):
    *_, first, second, third = finished[1].stdout.splitlines()
    commands = [line.split("    ")[0].split() for line in (first, second, third)]
    assert [words[:3] for words in commands] == [["python", "-m", "sparsedp"]] * 3
    assert [words[3] for words in commands] == ["demo", "check", "report"]


def test_a_log_is_written_before_each_long_piece_of_work(monkeypatch):
    """Into a file or a pipe too: what was printed before a minimization is there when it begins."""
    raw = io.BytesIO()
    seen = []
    real = dp.minimize
    ground = terrain.load(None)
    study = story.prepare(ground, story.grids_for(ground, 12))
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding="utf-8"))
    monkeypatch.setattr(story, "ITERATIONS", 1)
    monkeypatch.setattr(dp, "minimize", lambda *given, **how: seen.append(raw.getvalue()) or real(*given, **how))
    story.recover(study, study.grids[0])
    warm_up, measured = seen
    assert warm_up == measured and warm_up.endswith(b"Is the gradient right?\n  agrees\n")
    assert re.search(rb"error [\d.]+\n\n$", raw.getvalue())  # the result, before the next grid


def test_table(finished):
    with open(finished[0] / "table.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [int(row["unknowns"]) for row in rows] == [8 * 7, 12 * 10, 16 * 14]
    for row in rows:
        assert float(row["error"]) < 0.8
        assert float(row["gradient_error"]) < 1e-6
        assert int(row["solves_forward"]) == int(row["solves_adjoint"]) > 0
        assert int(row["setups"]) * 12 == int(row["solves_forward"])
    misfits = [float(row["misfit"]) for row in rows]
    assert misfits[0] > misfits[-1]


def test_recovered_field(finished):
    found = np.load(finished[0] / "recovered.npy", allow_pickle=False)
    assert found.shape == (16, 14) and np.all(np.isfinite(found))


@pytest.mark.whole
def test_a_second_run_writes_beside_the_first(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(dp.check, "gradient", audit("agrees"))
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setattr(story, "ITERATIONS", 1)
    monkeypatch.chdir(tmp_path)
    for folder in ("sparsedp-demo", "sparsedp-demo-2", "sparsedp-demo-3"):
        assert main(["demo", "--size", "12"]) == 0
        assert sorted(os.listdir(folder)) == sorted(story.ARRAYS)
        assert f"Written to {folder}: " in capsys.readouterr().out
    assert main(["demo", "--size", "12", "--force"]) == 0
    assert len(os.listdir()) == 3


def test_nothing_is_overwritten_unasked(finished):
    folder, _ = finished
    before = {name: (folder / name).read_bytes() for name in os.listdir(folder)}
    again = demo(folder.parent, "--size", "16", "--out", folder.name)
    assert again.returncode == 2 and again.stdout == ""
    assert re.fullmatch(r"sparsedp: .* is there already; [^\n]*\n", again.stderr)
    assert before == {name: (folder / name).read_bytes() for name in os.listdir(folder)}


@pytest.mark.slow
def test_own_field_and_force(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(story, "ITERATIONS", 3)
    np.save(tmp_path / "ground.npy", relief())
    arguments = ["demo", "--input", str(tmp_path / "ground.npy"), "--size", "12", "--out", str(tmp_path / "out")]
    assert main(arguments) == 0
    first = (tmp_path / "out" / "recovered.npy").read_bytes()
    assert "your file" in capsys.readouterr().out
    assert main(arguments) == 2
    assert main([*arguments, "--force"]) == 0
    assert (tmp_path / "out" / "recovered.npy").read_bytes() == first  # the same in every run


def audit(verdict):
    """In place of `dp.check.gradient`: a verdict without a sweep."""
    return lambda loss, x, directions: SimpleNamespace(verdict=verdict, lines=())


def test_without_matplotlib_and_tqdm(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(dp.check, "gradient", audit("agrees"))
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "tqdm.auto", None)
    monkeypatch.setattr(story, "ITERATIONS", 1)
    assert main(["demo", "--size", "12", "--out", str(tmp_path)]) == 0
    assert sorted(os.listdir(tmp_path)) == sorted(story.ARRAYS)
    printed = capsys.readouterr().out
    assert "a generated terrain" in printed
    assert "No pictures: pictures need matplotlib" in printed


def test_a_wrong_gradient_is_not_a_success(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(dp.check, "gradient", audit("disagrees"))
    monkeypatch.setitem(sys.modules, "matplotlib", None)  # pictures take longest
    monkeypatch.setattr(story, "ITERATIONS", 1)
    assert main(["demo", "--size", "12", "--out", str(tmp_path)]) == 1


# ---- the parts -----------------------------------------------------------------------------------------------------


def test_remap_is_the_mean_over_cells():
    fine = dp.Grid((24, 16), size=(2.0, 1.0))
    coarse = dp.Grid((6, 4), size=(2.0, 1.0))
    u = relief((24, 16))
    assert np.allclose(terrain.remap(fine, coarse)(u), u.reshape(6, 4, 4, 4).mean(axis=(1, 3)), rtol=1e-13)
    x, y = fine.centres()
    a, b = coarse.centres()
    assert np.allclose(terrain.remap(fine, coarse)(2 * x - y), 2 * a - b, rtol=1e-13)
    assert np.allclose(terrain.remap(coarse, fine)(2 * a - b), 2 * x - y, rtol=1e-13)


def test_generated_terrain_is_the_same_everywhere():
    one = terrain.generated((40, 32))
    other = terrain.generated((40, 32))
    assert one.shape == (40, 32) and np.array_equal(one, other)
    assert one.std() > 0.2 * np.abs(one).max()


@pytest.mark.parametrize("field", [relief() * 1e300, relief() * 1e-300, relief() + 1e6, np.eye(40)])
def test_conductivity_has_a_sensible_contrast(tmp_path, field):
    np.save(tmp_path / "a.npy", field)
    logk = terrain.hidden_ground(dp.Grid((14, 12)), terrain.load(tmp_path / "a.npy"))
    assert np.abs(logk).max() <= terrain.STEEPEST * (1 + 1e-12)
    assert abs(logk.mean()) < 1e-9 and logk.std() > 0.3


def test_pumps_inject_the_same_on_every_grid():
    for n in (12, 24, 48):
        grid = dp.Grid((n, n), size=1.0)
        assert np.isclose(np.sum(scene.pump(grid, (0.3, 0.4)) * grid.volumes), 1.0)


def test_one_setup_serves_all_wells_forward_and_backward():
    from sparsedp._utils.counters import recording

    grid = dp.Grid((8, 8), size=1.0)
    data = scene.survey(grid, relief((8, 8)))
    loss = scene.objective(scene.Ground(grid, data.wells, data.sensors), data)
    with recording() as calls:
        dp.value_and_grad(loss)(np.zeros((8, 8)))
    counts = {kind: sum(n for (_, k), n in calls.items() if k == kind) for kind in ("setup", "solve", "adjoint")}
    assert counts == {"setup": 1, "solve": 12, "adjoint": 12}


def test_loss_at_the_truth_is_the_noise():
    grid = dp.Grid((16, 16), size=1.0)
    hidden = relief((16, 16))
    data = scene.survey(grid, hidden)
    loss = scene.objective(scene.Ground(grid, data.wells, data.sensors), data)
    chi = 2 * (loss(hidden) - scene.regulariser(grid)(hidden))
    assert 0.9 < chi < 1.1
