"""Runs that are killed and taken up again."""

import json
import signal
import subprocess
import sys
import time

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp


def valley(x):
    return anp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)


def residuals(x, batch=0.0):
    return anp.concatenate([10 * (x[1:] - x[:-1] ** 2), 1 - x[:-1]]) + batch


START = np.array([-1.2, 1.0, 0.3, 0.8])
RUNS = [
    ("lbfgs", valley, {}),
    ("lbfgs", valley, {"bounds": (-2.0, 0.9)}),
    ("gd", valley, {"rate": 1e-4, "momentum": 0.5}),
    ("gd", valley, {}),
    ("adam", valley, {"rate": 0.05}),
    ("newton_cg", valley, {}),
    ("gauss_newton", residuals, {}),
    ("levenberg_marquardt", residuals, {}),
    ("half_inverse", residuals, {"rate": 0.1, "batches": [1e-3 * i for i in range(5)]}),
]


def same(a, b):
    return (
        np.array_equal(a.x, b.x)
        and a.value == b.value
        and a.evaluations == b.evaluations
        and a.message == b.message
        and [record[:3] + record[4:] for record in a.history] == [record[:3] + record[4:] for record in b.history]
    )


@pytest.mark.parametrize("method, loss, options", RUNS)
def test_a_run_in_pieces_is_the_run(tmp_path, monkeypatch, method, loss, options):
    monkeypatch.setattr("sparsedp.optimise.resume.SHARE", np.inf)  # every state is written
    whole = dp.minimise(loss, START, method, maxiter=12, tolerance=0, **options)
    for stop in (3, 4, 9, 12):
        part = dp.minimise(loss, START, method, maxiter=stop, tolerance=0, checkpoint=tmp_path, **options)
    assert same(part, whole)
    assert part.resumed.startswith("resumed from iteration ")
    assert len(list(tmp_path.iterdir())) == 4  # two states of two files
    again = dp.minimise(loss, START, method, maxiter=12, tolerance=0, checkpoint=tmp_path, **options)
    assert same(again, whole)


def test_what_a_finished_run_says_when_called_again(tmp_path):
    first = dp.minimise(valley, START, checkpoint=tmp_path)
    assert first.converged and first.resumed == f"nothing to resume in {tmp_path}"
    again = dp.minimise(valley, START, checkpoint=tmp_path)
    assert same(again, first) and again.resumed in str(again)


def test_what_stopped_a_run_does_not_stop_the_next(tmp_path):
    """A callback stops one run; more iterations and a smaller tolerance go on from there, to the same bits."""
    options = {"maxiter": 30, "tolerance": 1e-6}
    whole = dp.minimise(valley, START, **options)
    stopped = dp.minimise(
        valley, START, checkpoint=tmp_path, callback=lambda record, x: record.iteration == 5, **options
    )
    assert stopped.message == "stopped by the callback" and len(stopped.history) == 6
    assert same(dp.minimise(valley, START, checkpoint=tmp_path, **options), whole)
    finer = {"maxiter": 200, "tolerance": 1e-12}
    assert same(dp.minimise(valley, START, checkpoint=tmp_path, **finer), dp.minimise(valley, START, **finer))


def test_truncated_and_foreign_files_are_named_and_skipped(tmp_path, monkeypatch):
    monkeypatch.setattr("sparsedp.optimise.resume.SHARE", np.inf)
    whole = dp.minimise(valley, START, maxiter=8, tolerance=0)
    dp.minimise(valley, START, maxiter=6, tolerance=0, checkpoint=tmp_path)
    last = tmp_path / "state-000000006.npz"
    last.write_bytes(last.read_bytes()[:-7])
    (tmp_path / "state-000000009.json").write_text("{}")
    (tmp_path / "state-000000008.json").write_text(json.dumps({"format": "another", "seal": ""}))
    (tmp_path / "state-000000007.npz.part").write_bytes(b"half")
    best = dp.minimise(valley, START, maxiter=8, tolerance=0, checkpoint=tmp_path)
    assert same(best, whole)
    assert "resumed from iteration 5" in best.resumed
    assert "state-000000006.json: state-000000006.npz is truncated or changed" in best.resumed
    assert "state-000000009.json: not a manifest of sparsedp" in best.resumed
    assert "state-000000008.json: not a manifest of sparsedp" in best.resumed
    assert "state-000000007.npz.part: an unfinished write" in best.resumed


def test_a_missing_file_and_a_manifest_that_was_changed(tmp_path, monkeypatch):
    monkeypatch.setattr("sparsedp.optimise.resume.SHARE", np.inf)
    dp.minimise(valley, START, maxiter=3, tolerance=0, checkpoint=tmp_path)
    (tmp_path / "state-000000003.npz").unlink()
    changed = tmp_path / "state-000000002.json"
    changed.write_text(changed.read_text().replace('"iteration": 2', '"iteration": 1'))
    best = dp.minimise(valley, START, maxiter=0, checkpoint=tmp_path)
    assert "state-000000003.npz is missing" in best.resumed and "nothing to resume" in best.resumed
    assert "state-000000002.json: not a manifest of sparsedp" in best.resumed


@pytest.mark.parametrize(
    "change, name",
    [
        ({"method": "gd"}, "method"),
        ({"memory": 3}, "options"),
        ({"bounds": (-3.0, None)}, "bounds"),
        ({"start": START + 1}, "start, or loss at the start"),
        ({"loss": lambda x: 2 * valley(x)}, "start, or loss at the start"),
    ],
)
def test_another_run_is_refused(tmp_path, change, name):
    run = {"loss": valley, "start": START, "maxiter": 2, "checkpoint": tmp_path}
    dp.minimise(**run)
    with pytest.raises(
        ValueError, match=".* holds a run with another .*: .*, not .*; write another checkpoint folder"
    ) as refused:
        dp.minimise(**{**run, **change})
    assert f"another {name}:" in str(refused.value)


SCRIPT = """
import sys
import autograd.numpy as anp, numpy as np, time
import sparsedp as dp
import sparsedp.optimise.resume as resume
resume.SHARE = np.inf
def valley(x):
    time.sleep(1e-3)
    return anp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)
bounds = (-2.0, np.where(np.arange(60) % 7, 2.0, 0.9)) if sys.argv[3:] else None
start = np.linspace(-1.2, 1.0, 60)
best = dp.minimise(valley, start, maxiter=150, tolerance=0, bounds=bounds, checkpoint=sys.argv[1])
np.save(sys.argv[2], best.x)
np.save(sys.argv[2] + ".values", [record.value for record in best.history])
"""


def newest(folder):
    """Number of the last iteration that is written down; -1 without any."""
    return max((int(path.stem[6:]) for path in folder.glob("state-*.json")), default=-1)


def killed_on_its_way(run, folder, delay):
    """Whether kill -9, so many seconds after the first new state, came before the end of the run."""
    process, before = subprocess.Popen(run), newest(folder)
    while process.poll() is None and newest(folder) == before:
        time.sleep(1e-3)
    time.sleep(delay)
    process.send_signal(signal.SIGKILL)
    return process.wait() == -signal.SIGKILL and newest(folder) > before


@pytest.mark.slow
@pytest.mark.parametrize("bounds", [[], ["bounds"]])
def test_killed_at_ten_random_instants(tmp_path, rng, bounds):
    """kill -9 while it runs, ten times: result and all values on the way have the bits of an undisturbed run."""
    run = [sys.executable, "-c", SCRIPT]
    subprocess.run([*run, str(tmp_path / "whole"), str(tmp_path / "whole.npy"), *bounds], check=True)
    parts = [*run, str(tmp_path / "parts"), str(tmp_path / "parts.npy"), *bounds]
    kills = [killed_on_its_way(parts, tmp_path / "parts", rng.uniform(0, 0.02)) for _ in range(10)]
    assert kills == [True] * 10 and 10 <= newest(tmp_path / "parts") < newest(tmp_path / "whole")
    subprocess.run(parts, check=True)
    for name in ("npy", "npy.values.npy"):
        whole, resumed = (np.load(tmp_path / f"{part}.{name}") for part in ("whole", "parts"))
        assert np.array_equal(whole, resumed) and len(whole) > 50
