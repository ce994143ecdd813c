"""Random scenes against their twins: a few hundred by default, many by `python -m pytest -m campaign`.

SPARSEDP_SCENES is the number of scenes of a campaign (20 000), SPARSEDP_SEED the number of the campaign (0). A scene
that fails is shrunk and written as a program to .pytest_cache/campaign (or to the folder SPARSEDP_FAILURES).
"""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import hypothesis
import numpy as np
import pytest
from campaign import ingredients as parts
from campaign import physics, script
from campaign.boxes import Box
from campaign.ingredients import Discarded
from campaign.scene import (
    TREES,
    Mismatch,
    Outcome,
    Scene,
    Twin,
    attempt,
    check_close,
    check_gradient,
    check_range,
    compare,
)
from campaign.strategies import scenes
from sources import ROOT

import sparsedp as dp

SCENES = int(os.environ.get("SPARSEDP_SCENES", 20_000))
SEED = int(os.environ.get("SPARSEDP_SEED", 0))
FOLDER = Path(os.environ.get("SPARSEDP_FAILURES", ROOT / ".pytest_cache" / "campaign"))
PER_TEST = 50
PER_SEARCH = 10  # a longer search of Hypothesis repeats parts of its scenes


def run(count, seed, before=0):
    """Compare `count` scenes, after `before` others; the shrunk one that fails is written to a file.

    Returns
    -------
    dict
        How many scenes, comparisons and refusals there were, and the refusals by reason.
    """
    tally = {"scenes": 0, "discarded": 0, "comparisons": 0, "refused": 0, "reasons": {}}
    first: list = []  # number of the scene that failed before it was shrunk
    file = FOLDER / f"scene_{seed}.py"

    warnings.filterwarnings("ignore", "Output seems independent of input")  # autograd's, of a twin of a constant
    warnings.filterwarnings("ignore", category=dp.errors.GrowthWarning)
    warnings.filterwarnings("ignore", category=dp.errors.BudgetWarning)

    @hypothesis.settings(
        max_examples=PER_SEARCH,
        database=None,
        derandomize=False,
        deadline=None,
        suppress_health_check=list(hypothesis.HealthCheck),
        report_multiple_bugs=False,
        phases=[hypothesis.Phase.generate, hypothesis.Phase.shrink],
    )
    @hypothesis.given(scenes())
    def one(scene):
        try:
            outcome = compare(scene)
        except Discarded:
            tally["discarded"] += 1
            return
        except Mismatch as error:
            FOLDER.mkdir(parents=True, exist_ok=True)
            file.write_text(script.script(scene, str(error)), encoding="utf-8")  # the last one written is the smallest
            first.append(before + tally["scenes"] + 1)
            raise Mismatch(f"{error}\nfound after {first[0]} scenes; {file} shows it") from error.__cause__
        tally["scenes"] += 1
        tally["comparisons"] += len(outcome.compared)
        tally["refused"] += bool(outcome.refused) and not outcome.compared
        for reason in outcome.refused:
            tally["reasons"][reason] = tally["reasons"].get(reason, 0) + 1

    for number in range(-(-count // PER_SEARCH)):
        hypothesis.seed(1000 * seed + number)(one)()
    return tally


@pytest.mark.whole
@pytest.mark.parametrize(("count", "seed"), [(10, 5), pytest.param(40, 4, marks=pytest.mark.whole)])
def test_a_few_scenes(count, seed):
    tally = run(count, seed)
    assert tally["scenes"] > count // 2


@pytest.mark.campaign
@pytest.mark.parametrize("number", range(-(-SCENES // PER_TEST)))
def test_many_scenes(number, record_property):
    """The hook in conftest.py adds up what each test counts; at most a quarter of its scenes is refused as a whole."""
    tally = run(PER_TEST, 1_000_003 * (SEED + 1) + number, PER_TEST * number)
    record_property("campaign", tally)
    assert tally["refused"] + tally["discarded"] <= 0.25 * PER_TEST, tally


# ---- the same scenes, jitted ---------------------------------------------------------------------------------------


def run_jitted(count, seed):
    """Record random scenes at other numbers, and compare value and gradient with those of the function itself.

    Returns
    -------
    dict
        How many scenes were compared, and how many the recording refused by name.
    """
    tally = {"compared": 0, "refused": 0}

    @hypothesis.settings(
        max_examples=count,
        database=None,
        deadline=None,
        suppress_health_check=list(hypothesis.HealthCheck),
        phases=[hypothesis.Phase.generate],
    )
    @hypothesis.seed(seed)
    @hypothesis.given(scenes())
    def one(scene):
        values = scene.leaves()
        x = TREES[scene.tree][0](values)
        vector, build = dp.flatten(x)
        try:
            with np.errstate(all="ignore"):
                Twin(scene, values, scene.tangents())  # discards scenes whose numbers grow
            loss = scene.library()
            value, gradient = dp.value_and_grad(loss)(x)
        except (Discarded, ValueError, TypeError, RuntimeError, ArithmeticError):
            return  # what the library refuses is counted by the other tests
        jitted = dp.jit(loss, check=False)
        try:
            dp.value_and_grad(jitted)(build(0.9 * vector))
        except dp.errors.JitError:
            tally["refused"] += 1
            return
        found, slopes = dp.value_and_grad(jitted)(x)
        expected = dp.flatten(gradient)[0]
        gap = np.abs(dp.flatten(slopes)[0] - expected)
        assert found == value, scene
        assert np.all(gap <= scene.tolerance * np.max(np.abs(expected), initial=0.0)), scene
        tally["compared"] += 1

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        one()
    return tally


@pytest.mark.parametrize(
    "count", [pytest.param(60, marks=pytest.mark.whole), pytest.param(2000, marks=pytest.mark.campaign)]
)
def test_jitted_scenes(count):
    tally = run_jitted(count, seed=7)
    assert tally["compared"] > count // 2, tally


# ---- scenes that once failed, as they were shrunk ------------------------------------------------------------------

LINE = Box(shape=(1,), periodic=(True,), stretched=(False,))
COLUMN = Box(shape=(2, 1), periodic=(False, True), stretched=(True, False), seed=3)
FOUND = {
    "a length of a step of radau as an array, whose value differed by a rounding where it was differentiated": Scene(
        Box((1, 1, 3), (False, False, True), (False, False, False)),
        (parts.TimeStep("radau", (("neumann", "neumann"), ("neumann", "neumann"), None), seed=0),),
        loss="first",
        number="array",
    ),
    "a complex number as the shift of an elliptic solve": Scene(
        COLUMN, (physics.Damped((("dirichlet", "neumann"), None), "auto", seed=4),)
    ),
    "a Hessian product in single precision, behind a rule without a JVP": Scene(
        LINE,
        (parts.Rule("cells", forward=False, seed=0), parts.TimeStep("euler", (None,), seed=0)),
        dtype="float32",
        loss="first",
    ),
}


@pytest.mark.parametrize("name", FOUND)
def test_a_scene_that_once_failed(name):
    compared = compare(FOUND[name]).compared
    assert {"value", "gradient", "jvp"} <= set(compared)
    assert FOUND[name].order == 1 or "hvp" in compared


# ---- the campaign itself -------------------------------------------------------------------------------------------


@pytest.mark.whole
def test_a_scene_as_a_program_that_stands_alone(tmp_path):
    """It runs without the folder of tests, from another directory."""
    sides = (("dirichlet", "neumann"), ("neumann", "neumann"))
    box = Box((2, 3), (False, False), (False, True))
    chain = (
        parts.Linear(("laplacian", sides, 1, "neumann"), 1.0, "cells", "cells"),
        parts.Transport("upwind", sides, "faces", "cells", "flux", still=False, seed=2),
        parts.Rollout((parts.TimeStep("euler", sides, 3),), 2, None, "all", None, inputs=False, tree=True, seed=4),
    )
    scene = Scene(box, chain, tree="pair")
    file = tmp_path / "scene.py"
    file.write_text(script.script(scene, "gradient: 1.0 for 2.0"), encoding="utf-8")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["PYTHONPATH"] = str(ROOT)
    done = subprocess.run(
        [sys.executable, str(file)], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == repr(compare(scene))
    assert "campaign" not in file.read_text(encoding="utf-8")


def test_a_difference_is_seen_in_each_quantity():
    """Twins with a wrong number, and arguments that are refused."""
    scene = Scene(LINE, (parts.Pointwise("sine", "cells", "field", 0),), dtype="float64")
    assert compare(scene).compared == ["value", "gradient", "jvp", "hvp"]
    for what, rows in {
        "shape": (np.zeros(2), np.zeros(1)),
        "dtype": (np.zeros(1, "float32"), np.zeros(1)),
        "is": (np.full(1, 0.1), np.zeros(1)),
    }.items():
        with pytest.raises(Mismatch, match=what):
            check_gradient(scene, "gradient", {"u": rows[0]}, {"u": rows[1]}, {"u": np.zeros(1)})
    with pytest.raises(Mismatch, match="leaves"):
        check_gradient(scene, "gradient", {"v": np.zeros(1)}, {"u": np.zeros(1)}, {"u": np.zeros(1)})
    with pytest.raises(Mismatch, match="value: library 1.0, twin 1.1"):
        check_close(scene, "value", 1.0, 1.1, 1.0)
    with pytest.raises(Mismatch, match="set-up: ShapeError: no"):
        attempt(scene, Outcome(), "set-up", refused)
    with pytest.raises(Discarded):
        check_range(1.0, np.array([1.0, np.nan]))


def refused():
    raise dp.errors.ShapeError("no")
