"""Random scenes against their twins: a few hundred by default, many by `python -m pytest -m campaign`.

SPARSEDP_SCENES is the number of scenes of a campaign (20 000), SPARSEDP_SEED the number of the campaign (0). A scene
that fails is shrunk and written as a program to .pytest_cache/campaign (or to the folder SPARSEDP_FAILURES).
"""

import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import hypothesis
import pytest
from campaign import script
from campaign.scene import Discarded, Mismatch, compare
from campaign.strategies import scenes
from sources import ROOT

import sparsedp as dp

SCENES = int(os.environ.get("SPARSEDP_SCENES", 20_000))
SEED = int(os.environ.get("SPARSEDP_SEED", 0))
FOLDER = Path(os.environ.get("SPARSEDP_FAILURES", ROOT / ".pytest_cache" / "campaign"))
PER_TEST = 100
QUICK = 25


def run(count, seed, strategy=None):
    """Compare `count` scenes; the shrunk one that fails is written to a file.

    Returns
    -------
    dict
        How many scenes, comparisons and refusals there were, and the refusals by reason.
    """
    tally = {"scenes": 0, "discarded": 0, "comparisons": 0, "refused": 0, "reasons": {}}
    file = FOLDER / f"scene_{seed}.py"

    warnings.filterwarnings("ignore", "Output seems independent of input")  # autograd's, of a twin of a constant
    warnings.filterwarnings("ignore", category=dp.errors.GrowthWarning)

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=count,
        database=None,
        derandomize=False,
        deadline=None,
        suppress_health_check=list(hypothesis.HealthCheck),
        report_multiple_bugs=False,
        phases=[hypothesis.Phase.generate, hypothesis.Phase.shrink],
    )
    @hypothesis.given(scenes() if strategy is None else strategy)
    def one(scene):
        try:
            outcome = compare(scene)
        except Discarded:
            tally["discarded"] += 1
            return
        except Mismatch as error:
            FOLDER.mkdir(parents=True, exist_ok=True)
            file.write_text(script.script(scene, str(error)), encoding="utf-8")  # the last one written is the smallest
            raise Mismatch(f"{error}\n{file} shows it") from error.__cause__
        tally["scenes"] += 1
        tally["comparisons"] += len(outcome.compared)
        tally["refused"] += bool(outcome.refused) and not outcome.compared
        for reason in outcome.refused:
            tally["reasons"][reason] = tally["reasons"].get(reason, 0) + 1

    one()
    return tally


def check(tally):
    """At most a tenth of the scenes is refused as a whole, and as few grow out of range."""
    assert tally["refused"] <= 0.1 * tally["scenes"], tally
    assert tally["discarded"] <= 0.1 * (tally["scenes"] + tally["discarded"]), tally


@pytest.mark.parametrize("seed", range(2))
def test_a_few_scenes(seed):
    check(run(QUICK, seed))


@pytest.mark.campaign
@pytest.mark.parametrize("number", range(-(-SCENES // PER_TEST)))
def test_many_scenes(number, record_property):
    tally = run(PER_TEST, 1_000_003 * (SEED + 1) + number)
    record_property("tally", tally)
    check(tally)
