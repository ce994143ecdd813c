"""The collection of wrong and right derivatives: what is known of each, and the verdicts of `check.vjp`."""

import re

import numpy as np
import pytest
from sources import ROOT
from true_derivatives import true_vjp

import sparsedp as dp
from benchmarks.wrong_adjoints import RIGHT, WRONG
from benchmarks.wrong_adjoints.other_checks import check_grads, gradcheck, taylor
from sparsedp._utils.pytree import leaves, mapped

PAGE = ROOT / "docs" / "wrong_adjoints.md"
SAMPLE = {
    "cold walls",
    "inflow",
    "predators and prey",
    "dense layer",
    "linearized once",
    "concentrations of many decades",
    "large offset",
    "results in one buffer",
    "counts and rates",
    "complex polynomial",
}
# Errors of right derivatives that are larger than rounding errors in double precision.
TOLERANCES = {"diffusion in single precision": 1e-6, "contraction": 1e-8, "gas law by bisection": 1e-8}


def marked(cases):
    """Return parameters: a sample for the default suite, all others with the marker `whole`."""
    return [pytest.param(case, id=case.name, marks=[] if case.name in SAMPLE else pytest.mark.whole) for case in cases]


def moved(x, share):
    """Return x with all floating entries changed by up to a share."""

    def of_leaf(leaf):
        array = np.array(leaf)
        if array.dtype.kind not in "fc":
            return array
        factors = 1 + share * np.cos(np.arange(array.size)).reshape(array.shape)
        return (array * factors).astype(array.dtype)

    return mapped(of_leaf, x)


def weights_of(y):
    """Return random numbers in the structure of a result."""
    rng = np.random.default_rng(0)

    def of_leaf(leaf):
        array = np.asarray(leaf)
        weights = rng.normal(size=array.shape)
        if array.dtype.kind == "c":
            weights = weights + 1j * rng.normal(size=array.shape)
        return weights.astype(array.dtype)

    return mapped(of_leaf, y)


def copies(tree):
    return mapped(np.array, tree)


def relative_errors(case):
    """Return for each leaf of x the largest relative errors of the VJP at two points, after runs at other points."""
    program = case.program()
    errors = []
    for x in (program.x, moved(program.x, 1e-3)):
        g = weights_of(copies(program.f(x)))
        program.f(moved(x, 2e-3))
        if case.is_wrong:
            program.vjp(x, copies(g))  # a buffer that is not cleared shows in the second run
        found = leaves(copies(program.vjp(x, copies(g))))
        right = true_vjp(case.name, program.f, x, g)
        sizes = [np.maximum(np.abs(part), 1e-14 * np.max(np.abs(part), initial=0.0)) + 1e-307 for part in right]
        errors.append([np.abs(a - b) / size for a, b, size in zip(found, right, sizes)])
    return [np.maximum(first, second) for first, second in zip(*errors)]


def wrong_entries(case, x):
    """Return for each leaf of x whether its entries are wrong, as the collection says."""
    masks = []
    is_dict = isinstance(x, dict)
    for name, leaf in x.items() if is_dict else [("", x)]:
        mask = np.zeros(np.shape(leaf), dtype=bool)
        index = case.entries.get(name, ()) if is_dict and case.entries is not ... else case.entries
        if not (isinstance(index, tuple) and index == ()):
            mask[index] = True
        masks.append(mask)
    return masks


def test_there_are_fifty_of_each():
    assert len(WRONG) == len(RIGHT) == 50
    assert len({case.name for case in WRONG + RIGHT}) == 100


def test_the_page_has_a_row_for_every_program():
    row = r"^\| ([\w ]+) \| ([^|]+) \| (agrees|disagrees|inconclusive) \|"
    rows = re.findall(row, PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert [(name, kind) for name, kind, _ in rows] == [(case.name, case.kind) for case in WRONG + RIGHT]
    assert {verdict for _, _, verdict in rows[: len(WRONG)]} == {"disagrees"}


@pytest.mark.slow
@pytest.mark.parametrize(("check", "library"), [(check_grads, "jax"), (gradcheck, "torch"), (taylor, "numpy")])
def test_checks_of_other_libraries(check, library):
    """They see an error of a size in the order of the derivative, in complex fields and trees too."""
    pytest.importorskip(library)
    cases = {case.name: case.program() for case in WRONG + RIGHT}
    for name in ("cold walls", "inflow", "intensity of light"):
        assert check(cases[name]) == "disagrees"
    for name in ("one number", "nested results", "counts and rates", "complex polynomial"):
        assert check(cases[name]) == "agrees"


@pytest.mark.whole
@pytest.mark.parametrize("case", WRONG, ids=lambda case: case.name)
def test_exactly_the_entries_of_the_collection_are_wrong(case):
    with np.errstate(all="ignore"):
        errors = relative_errors(case)
    for error, mask in zip(errors, wrong_entries(case, case.program().x)):
        np.testing.assert_array_equal(error > 1e-9, mask)


@pytest.mark.whole
@pytest.mark.parametrize("case", RIGHT, ids=lambda case: case.name)
def test_right_derivatives_are_right_to_rounding(case):
    with np.errstate(all="ignore"):
        errors = relative_errors(case)
    assert max(np.max(error, initial=0.0) for error in errors) <= TOLERANCES.get(case.name, 3e-14)


def check(case):
    program = case.program()
    return dp.check.vjp(program.f, program.vjp, program.x, stages=program.stages or None)


def names_the_culprit(case, result):
    """Return whether `check.vjp` names the stage at fault, or the mistake where it is one that it recognizes."""
    names = [function.__name__ for function, _ in case.program().stages]
    if names:
        return result.culprit == f"stage {names.index(case.culprit) + 1} ({case.culprit})"
    if case.diagnosis:
        return case.diagnosis in result.culprit
    return result.culprit is None


def leaf_and_index(gap):
    """Return the name of a leaf of x, and an index, from the words of `check.vjp`; None for entries of f(x)."""
    words = gap.rpartition("): ")[2] if gap.startswith("stage") else gap
    found = re.match(r"(every entry of )?(x(?:\['\w+'\])?)((?:\[[\d, ]+\])?)(?=[:, ]|$)", words)
    if found is None:
        return None
    every, name, index = found.groups()
    return name, ... if every else tuple(map(int, re.findall(r"\d+", index)))


@pytest.mark.parametrize("case", marked(WRONG))
def test_wrong_derivatives_disagree(case):
    """The verdict comes with the stage at fault, and with entries that are wrong: entries of x, or of its input."""
    result = check(case)
    assert result.verdict == "disagrees" and names_the_culprit(case, result), result
    x = case.program().x
    masks = wrong_entries(case, x)
    names = [f"x['{name}']" for name in x] if isinstance(x, dict) else ["x"]
    places = [place for gap in result.gaps if (place := leaf_and_index(gap))]
    assert bool(places) == any(map(np.any, masks))
    for name, index in places:
        assert np.all(masks[names.index(name)][index]), result.gaps


@pytest.mark.parametrize("case", marked(RIGHT))
def test_right_derivatives_agree(case):
    """Some cannot be decided by values of f: there the collection says why, and "inconclusive" is right too."""
    result = check(case)
    allowed = ("agrees", "inconclusive") if case.undecidable else ("agrees",)
    assert result.verdict in allowed, result


@pytest.mark.whole
@pytest.mark.parametrize("seed", range(4, 8))
@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("cotangent in single precision", "rounds its numbers to single precision|off by"),
        ("loose adjoint solve", "although f is exact: tighten the tolerance"),
        ("values of the last run", "it keeps a state of other runs"),
        ("cells at sensors", "is a staircase of g"),
    ],
)
def test_reasons_do_not_depend_on_the_random_directions(name, reason, seed):
    program = next(case for case in WRONG if case.name == name).program()
    result = dp.check.vjp(program.f, program.vjp, program.x, rng=seed)
    assert result.verdict == "disagrees" and re.search(reason, result.reason), result


@pytest.mark.whole
def test_rounding_inside_a_function_is_no_derivative():
    """With some weights, the finest steps show a slope that is due to the rounding of cosines."""
    program = next(case for case in RIGHT if case.name == "nearly cancelling terms").program()
    assert dp.check.vjp(program.f, program.vjp, program.x, rng=11).verdict == "inconclusive"
