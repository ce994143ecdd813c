"""Where a gradient is wrong: entries of the argument and of the result of a call, in grid coordinates."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp.check.entries import largest_gaps, where

GRID = dp.Grid((8, 6), size=1.0)
LAPLACIAN = dp.laplacian(GRID, dp.dirichlet)
FIELD = np.random.default_rng(3).uniform(1.0, 2.0, GRID.shape)


def law(share):
    """A cube whose VJP is off by a share, one for each entry."""
    return dp.differentiable("law", lambda u: u**3, lambda nums, ans, u: lambda g: (3 * (1 + share) * u**2 * g,))


def wrong_at(*index, share=1e-3):
    shares = np.zeros(GRID.shape)
    shares[index] = share
    return law(shares)


@pytest.mark.parametrize(
    ("index", "entry", "region"),
    [
        ((0, 4), "x[0, 4], at the lower x wall", ""),
        ((7, 0), "x[7, 0], at the upper x wall and the lower y wall", ""),
        ((3, 2), "x[3, 2], at x = 0.4375, y = 0.4167", ""),
        ((0,), "x[0, ", "lies in x[0, :], at the lower x wall"),
        ((slice(None), 5), ", 5], at the upper y wall", "lies in x[:, 5], at the upper y wall"),
        ((slice(None), 2), ", 2], at ", "lies in x[:, 2], at y = 0.4167"),
    ],
)
def test_the_entry_and_its_place(index, entry, region):
    act = wrong_at(*index)
    found = dp.check.gradient(lambda u: anp.sum(LAPLACIAN(act(u)) ** 2), FIELD, quick=True)
    assert found.verdict == "disagrees"
    (gap,) = found.gaps
    assert entry in gap and region in gap
    assert "by differences" in gap and "by the gradient" in gap
    assert f"largest gaps: {gap}" in str(found) and gap in repr(found)
    place = region.removeprefix("lies in x") or entry.removeprefix("x")
    assert f"argument{place}" in str(found) and f"in its result{place}" in str(found)


def test_the_largest_entries_come_first():
    shares = np.zeros(GRID.shape)
    shares[3, 4], shares[7, 0], shares[1, 1] = 1e-2, 1e-1, 5e-2
    act = law(shares)
    found = dp.check.gradient(lambda u: anp.sum(act(u)), FIELD, directions=1)
    assert [gap.split(":")[0] for gap in found.gaps] == ["x[7, 0]", "x[1, 1]", "x[3, 4]"]


def test_a_factor_of_a_call_on_the_tape():
    found = dp.check.gradient(lambda u: anp.sum(anp.sin(law(-2.0)(u))), FIELD, quick=True)
    assert found.culprit == "law" and "every entry of its argument: its VJP has the wrong sign" in str(found)


def test_the_numbers_of_a_gradient_that_is_given():
    """There is no tape and no culprit, and the entry is named all the same."""
    slope = 2 * FIELD
    slope[5, 3] += 0.25
    found = dp.check.gradient(lambda u: np.sum(u**2), FIELD, gradient=slope, quick=True)
    assert found.verdict == "disagrees" and found.culprit is None
    entry, numbers = found.gaps[0].split(": ")
    assert entry == "x[5, 3]"
    by_differences, by_gradient = (float(part.split()[0]) for part in numbers.split(", "))
    assert by_differences == pytest.approx(slope[5, 3] - 0.25, abs=2e-3)
    assert by_gradient == pytest.approx(slope[5, 3], abs=2e-3)
    assert found.to_dict()["gaps"] == [found.gaps[0]]


def test_leaves_of_trees_numbers_and_complex_entries():
    slope = {"u": 2 * FIELD, "k": 2.2, "n": None}
    loss = lambda p: np.sum(p["u"] ** 2) + p["k"] ** 2
    found = dp.check.gradient(loss, {"u": FIELD, "k": 1.0, "n": 3}, gradient=slope, quick=True)
    assert found.gaps[0].startswith("x['k']: 2 by differences, 2.2 by the gradient")
    z = FIELD + 1j
    wrong = 2 * np.conj(z)
    wrong[2, 2] *= 1.1
    assert dp.check.gradient(lambda u: np.sum(np.abs(u) ** 2), z, gradient=wrong, quick=True).gaps[0] == "x[2, 2]"
    assert dp.check.gradient(lambda x: x**2, 2.0, gradient=4.1).gaps == ()


def test_a_face_is_named_by_its_component():
    divergence = dp.divergence(GRID)
    shares = np.zeros(GRID.faces.size)
    shares[0] = 0.1
    act = law(shares)
    flow = np.random.default_rng(0).uniform(1.0, 2.0, GRID.faces.size)
    found = dp.check.gradient(lambda v: anp.sum(divergence(act(v)) ** 2), flow, quick=True)
    assert found.gaps[0].startswith("x[0], x-face (0, 0) at the lower x wall and the lower y wall: ")


def test_an_operator_with_a_wrong_transpose():
    def transposed(g):
        back = LAPLACIAN.T(g)
        back[0] *= 1.001
        return back

    bent = dp.from_functions(LAPLACIAN.apply, transposed, GRID.cells, GRID.cells, "bent")
    found = dp.check.gradient(lambda u: anp.sum(bent(u) ** 2), FIELD, quick=True)
    assert found.culprit == "bent"
    assert "largest gap in its argument[0, :], at the lower x wall" in str(found)


def test_a_gradient_that_is_not_finite_says_where():
    loss = lambda u: anp.sum(anp.where(u > 0, anp.sqrt(anp.abs(u)), 0.0))
    found = dp.check.gradient(loss, np.array([[1.0, 2.0], [0.0, 1.0]]))
    assert found.reason == "the gradient of x holds NaN or infinity, the first at (1, 0)"


def test_few_measurements():
    """About log2(n) for each entry, whatever their number."""
    error = np.zeros((64, 64))
    error[17, 40], error[3, 9] = 1.0, -0.5
    measured = []

    def gap_along(weights):
        measured.append(1)
        return float(np.sum(error * weights[0]))

    found = largest_gaps(gap_along, [error.shape])
    assert [tuple(part.start for part in one.block) for one in found] == [(17, 40), (3, 9)]
    assert [one.gap for one in found] == pytest.approx([1.0, -0.5])
    assert len(measured) <= 2 * 12 + 6


def test_two_wrong_entries_are_no_region():
    """Nor are they if both lie in one row; a row whose entries are all wrong is one, beside other wrong entries."""
    error = np.zeros((16, 12))
    error[3, 2] = error[3, 9] = 1.0
    error[9, 9] = 0.5
    found = largest_gaps(lambda weights: float(np.sum(error * weights[0])), [error.shape])
    assert [one.region for one in found] == [None, None, None]
    error[3] = np.linspace(1.0, 2.0, 12)
    first = largest_gaps(lambda weights: float(np.sum(error * weights[0])), [error.shape])[0]
    assert first.region == (slice(3, 4), slice(None)) and not first.is_whole


def test_places_on_periodic_axes_nodes_and_batches():
    grid = dp.Grid((4, 3), size=(4.0, 3.0), periodic=(True, False))
    block = (slice(0, 1), slice(2, 3))
    assert where(block, (4, 3), [grid.cells]) == ", at the upper y wall"
    assert where((slice(1, 2), *block), (5, 4, 3), [grid.cells]) == ", at the upper y wall"
    assert where((slice(0, 1), slice(1, 2)), (4, 3), [grid.cells]) == ", at x = 0.5, y = 1.5"
    assert where(block, (4, 4), [grid.nodes]) == ", at x = 0, y = 2"
    assert where(block, (7, 7), [grid.cells]) == ""


def test_an_audit_that_agrees_takes_no_more_evaluations():
    loss = lambda u: anp.sum(LAPLACIAN(u) ** 2)
    with recording() as calls:
        found = dp.check.gradient(loss, FIELD, quick=True)
    assert found.gaps == () and calls["laplacian", "forward"] <= found.evaluations + 8


def test_derivatives_that_are_zero_to_rounding_have_no_factor():
    """Rounding errors of about 1e-16 are named as 0, and their ratios are not named at all."""
    mix = np.linalg.qr(np.cos(np.arange(144.0)).reshape(12, 12) + 3 * np.eye(12))[0]
    x = {"a": np.linspace(1.0, 2.0, 12), "b": np.linspace(1.0, 2.0, 12)}

    def cancelled(b):
        return mix @ (mix.T @ b) - b

    f = lambda u: u["a"] ** 3 + u["b"] ** 2
    missing = dp.check.vjp(f, lambda u, g: {"a": 3 * u["a"] ** 2 * g, "b": cancelled(2 * u["b"] * g)}, x)
    assert missing.gaps == ("every entry of x['b']: vjp is 0",)
    f = lambda u: u["a"] ** 3 + cancelled(u["b"])
    needless = dp.check.vjp(f, lambda u, g: {"a": 3 * u["a"] ** 2 * g, "b": 2 * u["b"] * g}, x)
    assert needless.gaps == ("every entry of x['b']: vjp should be 0",)


def test_a_derivative_that_is_zero_within_the_noise_should_be_zero():
    """The difference is an error of 1e-3, whose ratio to the derivative under test has no meaning."""

    def slope_along(weights):
        return float(np.sum(weights[0]))

    def gap_along(weights):
        return 1e-3 * np.sin(1e3 * np.sum(weights[0])) - slope_along(weights)

    (entry,) = largest_gaps(gap_along, [(8,)], noise=2e-3, slope_along=slope_along)
    assert entry.factor == np.inf and entry.region == (slice(None),)
