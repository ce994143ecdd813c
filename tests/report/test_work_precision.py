"""Error against run time: rows, references, failures, warm caches, files that are continued, pictures."""

import csv
import io
import math
import re

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.report import work_precision
from sparsedp.report.work_precision import COLUMNS

FIRST = (
    "scene method unknowns steps tolerance forward_error gradient_error seconds_setup seconds_forward seconds_backward "
    "peak_bytes solves_forward solves_adjoint iterations status seed versions"
)


def poisson(cells, method="direct", rtol=1e-10):
    """-u'' = s on (0, 1), u = 0 at the ends: the mean is s/12."""
    solve = dp.inverse(-dp.laplacian(dp.Grid(cells, size=1.0), dp.dirichlet), method, rtol=rtol)
    return lambda s: anp.sum(solve(s * np.ones(cells))) / cells, 1.0, {"unknowns": cells, "tolerance": rtol}


METHODS = {"direct": {"method": "direct"}, "krylov": {"method": "krylov", "rtol": 1e-8}}
EXACT = (1 / 12, 1 / 12)


def table(**options):
    return dp.work_precision(poisson, METHODS, {"cells": [8, 16]}, **{"reference": EXACT, "repeats": 2, **options})


def test_names_that_tables_and_files_cannot_hold(tmp_path):
    methods = {"a|b": METHODS["direct"], 3: METHODS["krylov"]}
    options = {"reference": EXACT, "repeats": 1, "scene": "walls/x", "file": tmp_path / "rows.csv"}
    found = dp.work_precision(poisson, methods, {"cells": [8]}, **options)
    assert "| a\\|b |" in found.markdown() and "| 3 |" in found.markdown()
    assert [path.name for path in found.save(tmp_path)[:2]] == ["walls-x.md", "walls-x.csv"]
    again = dp.work_precision(poisson, methods, {"cells": [8]}, **options)
    assert [row["method"] for row in again.rows] == ["a|b", "3"] and again.markdown() == found.markdown()


def test_rows():
    found = table(seed=7)
    assert COLUMNS[:17] == tuple(FIRST.split())
    assert [(row["method"], row["unknowns"]) for row in found.rows] == [
        ("direct", 8),
        ("direct", 16),
        ("krylov", 8),
        ("krylov", 16),
    ]
    for row in found.rows:
        assert set(row) == set(COLUMNS) and row["status"] == "ok" and row["seed"] == "7"
        assert row["solves_forward"] == row["solves_adjoint"] == 1 and row["peak_bytes"] > 0
        assert (row["iterations"] > 0) == (row["method"] == "krylov")
        assert row["forward_error"] == pytest.approx(row["gradient_error"], rel=1e-6)
        assert row["seconds_forward"] <= row["seconds_forward_median"] <= row["seconds_forward_max"]
        assert row["seconds_setup"] > 0 and row["seconds_backward"] >= 0 and "numpy" in row["versions"]
    assert found.rows[1]["forward_error"] == pytest.approx(found.rows[0]["forward_error"] / 4, rel=1e-6)


def heat(scheme, steps):
    """u' = -u from p, to time 1."""

    def loss(p):
        u = p
        dt = 1 / steps
        for _ in range(steps):
            u = u * (1 - dt) if scheme == 1 else u * (1 - dt + dt**2 / 2) if scheme == 2 else u * np.exp(-dt)
        return u**2

    return loss, 2.0, {"steps": steps}


def test_orders_of_schemes_and_their_ordering():
    """At equal steps the first order is behind the second, and the exponential is exact; Pareto takes the best."""
    schemes = {name: {"scheme": k} for k, name in enumerate(("euler", "heun", "exponential"), 1)}
    exact = (4 * math.exp(-2), 4 * math.exp(-2))
    found = dp.work_precision(heat, schemes, {"steps": [10, 20, 40]}, reference=exact, repeats=1)
    error = {(row["method"], row["steps"]): row["gradient_error"] for row in found.rows}
    for order, name in ((1, "euler"), (2, "heun")):
        assert math.log2(error[name, 20] / error[name, 40]) == pytest.approx(order, abs=0.1)
    assert error["exponential", 10] < 1e-12 < error["heun", 40] < error["euler", 40]
    assert found.best(1e-9)["method"] == "exponential" and found.best(1e-300) is None
    times = [found.seconds(row) for row in found.pareto()]
    errors = [row["gradient_error"] for row in found.pareto()]
    assert times == sorted(times) and errors == sorted(errors, reverse=True)


def test_references():
    """Exact, a function of the settings, or refined, with the error of the reference stated."""
    by_cells = table(reference=lambda cells: (1 / 12, 1 / 12))
    assert by_cells.rows[0]["forward_error"] == table().rows[0]["forward_error"]
    own = table(reference={"method": "direct"})  # at the cells of the row: what the solver leaves
    assert own.rows[0]["forward_error"] == 0.0 and 0 < own.rows[3]["forward_error"] < 1e-6
    assert math.isnan(own.rows[0]["reference_error"])
    refined = table(reference=[{"cells": 64}, {"cells": 128}])
    assert refined.rows[0]["reference_error"] == pytest.approx(3 * 2 / 128**2, rel=0.01)
    assert "Error of the reference: 3.7e-04" in refined.markdown()
    assert math.isnan(table(reference=None).rows[0]["forward_error"])


def test_settings_and_facts_are_columns(tmp_path):
    """Also a setting with the name of another column, and facts that only some rows have."""

    def decay(method, steps, seed=0):
        facts = {"energy": 0.25 * steps, "note": "a|b"} if method == "direct" else {"steps": 2 * steps}
        return lambda: 1.0, None, facts

    def tables(**options):
        over = {"method": ["direct", "krylov"], "steps": [10, 1], "seed": [3]}
        return dp.work_precision(decay, {"all": {}}, over, reference=(1.0, None), repeats=1, **options)

    found = tables(file=tmp_path / "rows.csv")
    lines = [line.strip("| ").split(" | ") for line in found.markdown().splitlines() if line.startswith("| ")]
    assert lines[0][:6] == ["method", "method (setting)", "steps (setting)", "seed (setting)", "unknowns", "steps"]
    assert [line[1:4] for line in lines[1:]] == [
        ["direct", "10", "3"],
        ["direct", "1", "3"],
        ["krylov", "10", "3"],
        ["krylov", "1", "3"],
    ]
    column = lines[0].index("energy")
    assert lines[0][column:] == ["energy", "note", "best"] and lines[1][column:][:2] == ["2.5", "a\\|b"]
    assert [row["steps"] for row in found.rows[2:]] == [20, 2] and math.isnan(found.rows[2]["energy"])
    assert [row["energy"] for row in found.rows[:2]] == [2.5, 0.25] and found.rows[0]["note"] == "a|b"
    assert "energy,note\n" in found.csv() and all(list(row) == list(found.rows[0]) for row in found.rows)
    assert str(tables(file=tmp_path / "rows.csv")) == str(found)

    alone = dp.work_precision(lambda steps: (lambda: 1.0, None), {"all": {}}, {"steps": [10, 1]}, repeats=1)
    assert "| method | steps | unknowns |" in alone.markdown() and "| all | 10 |" in alone.markdown()
    with pytest.raises(
        TypeError, match="work_precision fills the column 'iterations' itself; give the fact another name"
    ):
        dp.work_precision(lambda: (lambda: 1.0, None, {"iterations": 3}), {"all": {}})
    with pytest.raises(TypeError, match="the third result of a problem takes a dict, got float; write {'steps': n}"):
        dp.work_precision(lambda: (lambda: 1.0, None, 3.0), {"all": {}})
    with pytest.raises(TypeError, match="a fact of a problem is a number or a string, got ndarray for 'x'"):
        dp.work_precision(lambda: (lambda: 1.0, None, {"x": np.zeros(3)}), {"all": {}})


def test_references_of_a_wrong_form():
    with pytest.raises(
        TypeError,
        match=r"reference of work_precision must be \(value, gradient\), a function of the settings, a dict of "
        r"settings or a list of such dicts, got 1.0; without an exact gradient write \(value, None\)",
    ):
        table(reference=1.0)
    for wrong in ((1.0, 2.0, 3.0), [], [1.0, 2.0], np.ones(2)):
        with pytest.raises(TypeError, match=r"reference of work_precision must be \(value, gradient\)"):
            table(reference=wrong)
    with pytest.raises(
        TypeError,
        match=r"the function reference of work_precision must return \(value, gradient\), got 1.0; "
        r"without an exact gradient return \(value, None\)",
    ):
        dp.work_precision(lambda: (lambda: 1.0, None), {"all": {}}, reference=lambda: 1.0)


def test_failures_keep_their_row():
    def scene(kind):
        if kind == "stuck":
            solve = dp.inverse(-dp.laplacian(dp.Grid(50), dp.dirichlet), "krylov", maxiter=1)
            return lambda b: anp.sum(solve(b * np.arange(50.0))), 1.0
        if kind == "unstable":
            raise dp.errors.UnstableStepError("too large a step")
        if kind == "nan":
            return lambda b: b * np.nan, 1.0
        return lambda b: b**2, np.arange(3.0) if kind == "shape" else 2.0

    kinds = ("stuck", "unstable", "nan", "fine")
    found = dp.work_precision(scene, {kind: {"kind": kind} for kind in kinds}, reference=(4.0, 4.0), repeats=1)
    status = {row["method"]: row["status"] for row in found.rows}
    assert status == {"stuck": "max_iterations", "unstable": "UnstableStepError", "nan": "nonfinite", "fine": "ok"}
    assert math.isnan(found.rows[0]["seconds_forward"]) and "max_iterations" in str(found)
    assert [row["method"] for row in found.pareto()] == ["fine"]

    wide = dp.work_precision(
        lambda n: (lambda x: anp.sum(x), np.ones(n)), {"n": {"n": 3}}, reference=(3.0, np.ones(4)), repeats=1
    )
    assert wide.rows[0]["status"].startswith("reference: ValueError")
    with pytest.raises(
        ValueError,
        match=r"result of work_precision: expected shape \(4,\), got \(3,\); give compare=function\(result, exact\)",
    ):
        work_precision.distance(np.ones(3), np.ones(4))
    short = lambda found, wanted: abs(np.sum(found) - np.sum(wanted))
    fair = dp.work_precision(
        lambda n: (lambda x: anp.sum(x), np.ones(n)),
        {"n": {"n": 3}},
        reference=(3.0, np.ones(4)),
        compare=short,
        repeats=1,
    )
    assert fair.rows[0]["gradient_error"] == 1.0


def test_caches_that_are_not_warm_are_refused(monkeypatch):
    """A run that goes on getting faster has no time; one that settles is warmed first."""
    clock = iter(2.0**-k for k in range(80))
    monkeypatch.setattr(work_precision, "timeit", lambda run, number: run() and next(clock))
    monkeypatch.setattr(work_precision, "SETTLED_RATIO", 1.5)
    monkeypatch.setattr(work_precision, "SHORT", 0.0)
    row = table().rows[0]
    assert row["status"] == "not_warm" and math.isnan(row["seconds_forward"]) and row["forward_error"] < 0.1
    monkeypatch.undo()
    calls = []

    def cold():
        return lambda s: calls.append(1) or s**2, 1.0

    dp.work_precision(cold, {"it": {}}, repeats=2)
    assert len(calls) >= 2 + 2 * 2 + 1  # warm-up, two of each kind, and the one that is weighed


def test_a_run_without_gradient_and_an_output():
    """An optimizer: the run is its own answer. An output: the field, not the loss, is compared."""

    def fit(method):
        loss = lambda x: anp.sum((x - 3.0) ** 2)
        return lambda: dp.minimize(loss, np.zeros(2), method=method, maxiter=50).x, None

    found = dp.work_precision(fit, {"lbfgs": {"method": "lbfgs"}}, reference=(np.full(2, 3.0), None), repeats=1)
    assert found.rows[0]["forward_error"] < 1e-6 and math.isnan(found.rows[0]["gradient_error"])
    assert found.pareto("forward_error") and not found.pareto()

    scene = lambda: (lambda x: anp.sum(x**2), np.ones(3), {"output": lambda x: 2 * x})
    found = dp.work_precision(scene, {"it": {}}, reference=(2 * np.ones(3), 2 * np.ones(3)), repeats=1)
    assert found.rows[0]["forward_error"] == found.rows[0]["gradient_error"] == 0.0


def test_a_file_is_continued(tmp_path):
    """Finished rows are kept when a run is cut off, also in the middle of a line."""
    file = tmp_path / "runs.csv"
    built = []

    def counted(cells, method, rtol=1e-10):
        built.append((cells, method))
        if len(built) == 3:
            raise KeyboardInterrupt
        return poisson(cells, method, rtol)

    options = dict(over={"cells": [8, 16]}, reference=EXACT, repeats=1, file=file, scene="poisson")
    with pytest.raises(KeyboardInterrupt):
        dp.work_precision(counted, METHODS, **options)
    file.write_text(file.read_text()[:-30])  # the second row is torn
    found = dp.work_precision(counted, METHODS, **options)
    assert built[3:] == [(16, "direct"), (8, "krylov"), (16, "krylov")]
    again = dp.work_precision(counted, METHODS, **options)
    assert len(built) == 6 and again.csv() == found.csv() and not again.skipped
    rows = list(csv.DictReader(io.StringIO(again.csv())))
    assert len(rows) == 4 and [row["method"] for row in rows] == ["direct", "direct", "krylov", "krylov"]

    file.write_text(file.read_text().replace("numpy ", "numpy 0."))
    old = dp.work_precision(counted, METHODS, **options)
    assert len(built) == 10 and "4 rows of runs.csv from other versions: run again" in old.skipped
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="other.csv is no table of work_precision; give another file name"):
        table(file=tmp_path / "other.csv")


def test_words_pictures_and_refusals(tmp_path):
    found = table(skip=lambda method, s: "too slow here" if (method, s["cells"]) == ("krylov", 16) else None)
    assert len(found.rows) == 3 and found.skipped == ["krylov with cells=16, method=krylov, rtol=1e-08: too slow here"]
    text = found.markdown()
    assert text.startswith("### poisson") and "| * |" in text and "- skipped: krylov with" in text
    assert "skipped: krylov" in str(found) and repr(found) == str(found)
    assert "| method | cells | unknowns |" in text and "| direct | 16 |" in text  # what tells two rows apart is shown
    assert re.search(r"^ *method +cells +unknowns", str(found), re.MULTILINE)
    paths = [path.name for path in found.save(tmp_path / "out")]
    assert paths[:2] == ["poisson.md", "poisson.csv"]
    pytest.importorskip("matplotlib")
    assert paths[2:] == ["poisson.png"]
    ax = found.plot()
    assert ax.get_xlabel() == "run time [s]" and ax.get_ylabel() == "gradient error" and ax.get_title() == "poisson"
    labels = [line.get_label() for line in ax.lines]
    assert "best so far" in labels and "direct" in labels

    with pytest.raises(
        ValueError, match="repeats of work_precision must be a whole number >= 1, got 0; the default is 3"
    ):
        table(repeats=0)
    with pytest.raises(ValueError, match="work_precision needs at least one method; write {'name': {settings}}"):
        dp.work_precision(poisson, {})
    with pytest.raises(ValueError, match="work_precision needs at least one method"):
        dp.work_precision(poisson, ["direct"])
    with pytest.raises(
        TypeError, match=r"a problem gives \(loss, x\) or \(loss, x, facts\), got float; write return loss, x"
    ):
        dp.work_precision(lambda: 1.0, {"it": {}})


def test_a_star_needs_an_error_below_one():
    """A value that is right by luck, beside a gradient that is not, is no good run."""

    def scene(share, bend):
        return lambda b: share * b**2 + bend * (b - 2.0), 2.0

    methods = {
        "lucky": {"share": 1.0, "bend": 40.0},
        "off": {"share": 9.0, "bend": 0.0},
        "fine": {"share": 1.01, "bend": 0.0},
    }
    lines = dp.work_precision(scene, methods, reference=(4.0, 4.0), repeats=1).markdown().splitlines()
    starred = [line for line in lines if line.startswith("|") and line.rstrip(" |").endswith("*")]
    assert len(starred) == 1 and "fine" in starred[0]
