"""stress: planted instabilities are found, sound scenes pass, every case that is left out has a reason."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.report.stress_cases import GROUPS, WHOLE

GRID = dp.Grid(24, size=1.0)
L = dp.laplacian(GRID, dp.dirichlet)
START = np.sin(3 * GRID.centres()[0])


def explicit(p):
    """Diffusion by an Euler step that is written by hand."""
    return anp.sum(dp.rollout(lambda u, p: u + p["dt"] * p["nu"] * L(u), START, p, 40) ** 2)


def by_hand(p):
    u = START
    for _ in range(30):
        u = u + p["dt"] * L(u)
    return anp.sum(u**2)


def implicit(p):
    solve = dp.elliptic_solver(dp.divergence(GRID), dp.gradient(GRID, dp.dirichlet))
    u = p["start"]
    for _ in range(3):
        u = solve(p["nu"] * p["dt"], u, 1.0)
    return anp.sum(u**2)


def notes(result, group):
    return [(row["case"], row["outcome"], row["note"]) for row in result.rows if row["group"] == group]


def number(d, nu=1.0):
    """Parameters with diffusion number d."""
    return {"dt": d / 24**2 / nu, "nu": nu}


shared = pytest.mark.xdist_group("stress")  # most of them look at one run


@pytest.fixture(scope="module")
def stable():
    """All cases of a step that is small enough, its map included."""
    return dp.stress(explicit, number(0.4), ranges={"nu": (0.5, 1.0)})


@shared
def test_a_stable_step_passes(stable):
    assert stable and stable.counts["FAILED"] == 0 and not stable.failures
    assert ("growth in one step", "passed", "") in notes(stable, "as given")


@pytest.mark.whole
@pytest.mark.parametrize("d", [0.52, 0.6, 3.0])
def test_a_diffusion_number_above_a_half_is_found(d):
    result = dp.stress(explicit, number(d), only=["as given"])
    assert not result
    (row,) = result.failures
    assert row["case"] == "growth in one step" and row["figure"] == pytest.approx(4 * d - 1, abs=0.05 * d)


def test_a_legal_range_that_is_too_wide_is_found():
    result = dp.stress(explicit, number(0.4), ranges={"nu": (0.1, 10.0)}, only=["legal range"])
    assert not result and all(row["figure"] > 1.01 for row in result.failures)


def test_a_loop_without_rollout():
    x = {"dt": 0.6 / 24**2}
    assert any("give step=" in sentence for sentence in dp.stress(by_hand, x, only=["as given"]).skipped)
    found = dp.stress(by_hand, x, step=lambda p: (lambda u: u + p["dt"] * L(u), START), only=["as given"])
    assert found.failures[0]["case"] == "growth in one step"


def test_physics_that_grows_passes():
    grow = lambda p: anp.sum(dp.rollout(lambda u, p: u + p["dt"] * 2.0 * u, START, p, 10))
    row = dp.stress(grow, {"dt": 0.1}, only=["as given"]).rows[-1]
    assert (row["outcome"], row["note"]) == ("passed", "grows as the physics does")
    assert row["figure"] == pytest.approx(1.2)


def test_growth_without_a_time_step_is_no_verdict():
    grow = lambda u: anp.sum(dp.rollout(lambda u, _: 1.2 * u, u, None, 10))
    assert dp.stress(grow, START, only=["as given"]).rows[-1]["outcome"] == "degraded"


# ---- null space ----------------------------------------------------------------------------------------------------


def singular():
    """A Neumann problem on cells of different size: (operator, right-hand side without a mean)."""
    grid = dp.Grid(24, spacing=1 + 0.5 * np.sin(np.arange(24.0)))
    volumes = grid.volumes
    return -dp.divergence(grid) @ dp.gradient(grid), START - np.sum(volumes * START) / np.sum(volumes)


def test_a_missing_null_space_projection_is_found():
    op, b = singular()
    inverse = np.linalg.inv(op.matrix.toarray())  # rounding makes it regular
    bad = dp.from_functions(lambda u: inverse @ u, lambda u: inverse.T @ u, op.domain, op.codomain)
    result = dp.stress(lambda b: anp.sum(bad(b) ** 2), b)
    assert not result
    assert any("is a null space left in?" in row["note"] for row in result.failures)
    assert any("rounding is amplified" in row["note"] for row in result.failures)


@pytest.mark.parametrize("nullspace", ["raise", "project"])
def test_a_projected_null_space_passes(nullspace):
    op, b = singular()
    solve = dp.inverse(op, nullspace=nullspace)
    result = dp.stress(lambda b: anp.sum(solve(b) ** 2), b)
    assert result
    words = {case: word for case, word, _ in notes(result, "constant added")}
    assert words["plus 1 of itself"] == ("refused correctly" if nullspace == "raise" else "passed")
    assert all(word == "refused correctly" for _, word, _ in notes(result, "not finite"))


# ---- other faults ----------------------------------------------------------------------------------------------------


def test_a_wrong_gradient_and_a_swallowed_nan_fail():
    off = dp.differentiable("off", lambda u: u**3, lambda nums, ans, u: lambda g: (3.3 * u**2 * g,))
    failed = dp.stress(lambda u: anp.sum(off(u)), START).failures
    assert failed[0]["note"].startswith("the differences settle on another gradient, along ")
    lost = dp.differentiable("lost", lambda u: u**3, lambda nums, ans, u: lambda g: (0.0 * g,))
    assert dp.stress(lambda u: anp.sum(lost(u)), START).failures[0]["note"] == (
        "the gradient is 0, the differences are not"
    )
    assert dp.stress(lambda u: 1.0 + anp.sum(u**2), 0 * START, only=["as given"])  # as it should be
    swallow = lambda u: anp.sum(anp.where(anp.isfinite(u), u, 0.0) ** 2)
    failed = dp.stress(swallow, START, only=["not finite"]).failures
    assert {row["case"] for row in failed} >= {"one nan"} and "swallowed" in failed[0]["note"]


def off_by(share):
    """A cube whose VJP is off by a share of itself, for all entries or one for each."""
    return dp.differentiable("cube", lambda u: u**3, lambda nums, ans, u: lambda g: (3 * (1 + share) * u**2 * g,))


@pytest.mark.parametrize("share", [1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6])
def test_a_gradient_that_is_a_little_wrong_fails(share):
    cube = off_by(share)
    result = dp.stress(lambda u: anp.sum(cube(u)), START, only=["as given", "zeros and signs"])
    first = result.rows[0]
    assert (first["case"], first["outcome"]) == ("value and gradient", "FAILED")
    if share > 1e-5:  # beside the point as given one difference that agrees to five digits is enough
        assert next(row for row in result.rows if row["case"] == "sign changed")["outcome"] == "FAILED"


def test_a_single_wrong_entry_fails():
    cube = off_by(1e-3 * (np.arange(24) == 7))
    assert dp.stress(lambda u: anp.sum(cube(u)), START + 1.5, only=["as given"]).rows[0]["outcome"] == "FAILED"


@pytest.mark.parametrize("size", [1.0, 1e-6])
def test_a_leaf_whose_gradient_is_lost_fails(size):
    """The direction of the gradient does not move it."""
    lost = off_by(-1.0)
    loss = lambda p: anp.sum(p["a"] ** 2) + size * anp.sum(lost(p["b"]))
    result = dp.stress(loss, {"a": START, "b": START + 1.0}, only=["as given"])
    assert result.rows[0]["outcome"] == "FAILED" and "along random in x['b']" in result.rows[0]["note"]


@pytest.mark.parametrize(
    ("loss", "x"),
    [
        (lambda u: anp.sum(anp.abs(u)), np.array([0.0, 1.0, -2.0])),
        (lambda u: anp.max(u), np.array([1.0, 1.0, 0.0])),
        (lambda u: anp.sum(anp.maximum(u, 0.0)), np.array([0.0, 0.0, 1.0, -1.0])),
        (lambda u: anp.sum(anp.maximum(u, 0.0) ** 2), np.array([0.0, 0.0, 1.0, -1.0])),
    ],
)
def test_a_right_gradient_at_a_kink_does_not_fail(loss, x):
    result = dp.stress(loss, x, only=["as given", "zeros and signs", "scaling"])
    assert not [row for row in result.failures if row["case"] != "last digits of x changed"]


def test_a_gradient_below_the_smallest_numbers_does_not_fail():
    """The loss is 1e-300 and dt is 1e30, so that the derivative in dt is 0 in double precision."""
    loss = lambda p: anp.mean((p["u"] / (1.0 + p["dt"]) ** 5) ** 2)
    result = dp.stress(loss, {"u": START + 1.5, "dt": 1.0}, only=["scaling"])
    rows = {row["case"]: row for row in result.rows if row["parameter"] == "dt"}
    assert rows["times 2^100"]["outcome"] == "degraded"
    assert "below the smallest numbers" in rows["times 2^100"]["note"]
    assert all(row["outcome"] != "FAILED" for row in rows.values())


def test_a_refusal_names_the_field_or_the_place():
    """NaN in a scene of the library is refused with its place; "something is wrong" is no help."""
    solve = dp.inverse(-L)
    sound = dp.stress(lambda b: anp.sum(solve(b) ** 2), START, only=["not finite"])
    assert sound and all("the first at" in row["note"] for row in sound.rows)

    def mute(sentence):
        def loss(u):
            if not np.all(np.isfinite(getattr(u, "_value", u))):
                raise ValueError(sentence)
            return anp.sum(u**2)

        return loss

    for sentence, word in (("something is wrong", "degraded"), ("x must be finite", "refused correctly")):
        rows = dp.stress(mute(sentence), START, only=["not finite"]).rows
        assert {row["outcome"] for row in rows} == {word}, sentence
    rows = dp.stress(mute("something is wrong"), START, only=["not finite"]).rows
    assert "refused without a name or a place: ValueError: something is wrong" in rows[0]["note"]


def test_a_state_and_a_modified_input_fail():
    calls = []

    def forgetful(u):
        calls.append(1)
        return anp.sum(u**2) * len(calls)

    assert [row["case"] for row in dp.stress(forgetful, START).failures][0] == "two runs"

    def greedy(u):
        if isinstance(u, np.ndarray) and u.flags.writeable:
            u *= 1.0 + 1e-9
        return anp.sum(u**2)

    assert dp.stress(lambda u: greedy(getattr(u, "_value", u)) + anp.sum(u), START).failures


@pytest.mark.whole
def test_implicit_diffusion_passes_and_has_a_map():
    result = dp.stress(implicit, {"start": START, "dt": 1e-3, "nu": 0.1})
    assert result, str(result)
    assert result.map is None  # no rollout


# ---- the value ------------------------------------------------------------------------------------------------------


@shared
def test_the_result_as_data_and_text(stable):
    result = stable
    data = stable.to_dict()
    assert data["counts"] == result.counts and len(data["rows"]) == len(result.rows)
    assert sum(result.counts.values()) == len(result.rows)
    assert len(result.csv().splitlines()) == len(result.rows) + 1
    assert "| group |" in result.markdown() and "skipped" in result.markdown()
    assert str(result).endswith(result.summary) and str(result.map) in str(result)
    assert np.shape(data["map"]["factors"]) == (9, 9)


@shared
def test_the_map_knows_the_limit_of_euler(stable):
    d = stable.map.time_steps[:, None] * stable.map.viscosities * 24**2
    assert np.all(stable.map.factors[d < 0.49] <= 1.001) and np.all(stable.map.factors[d > 0.55] > 1.1)


@shared
def test_the_picture(stable):
    plots = pytest.importorskip("matplotlib") and __import__("sparsedp.report.plots", fromlist=["figure"])
    assert stable.plot(plots.figure().add_subplot()).get_ylabel() == "dt"


# ---- the table of cases ---------------------------------------------------------------------------------------------


def test_every_group_has_cases_and_a_reason_to_have_none():
    assert all(group.reason for name, group in GROUPS.items() if name != WHOLE)
    x = {"field": START, "dt": 0.1, "nu": 0.5}
    loss = lambda p: p["nu"] * anp.sum(p["field"] ** 2) * (1 + p["dt"])
    result = dp.stress(loss, x, ranges={"dt": (0.01, 0.2)})
    jumps = dp.stress(lambda u: anp.sum(u**2), START**2 + 1, only=["jumps"])
    assert {row["group"] for row in [*result.rows, *jumps.rows]} == set(GROUPS)
    assert not any(sentence.startswith("kinds of arrays") for sentence in result.skipped)


def test_values_outside_a_stated_range_are_not_failures():
    """A number that is not finite is a failure inside a range, and shown as degraded outside and without one."""
    loss = lambda p: p["a"] / anp.where(p["a"] < 2.0, 1.0, 0.0)
    words = {}
    for high in (1.9, 3.0):
        rows = dp.stress(loss, {"a": 1.0}, ranges={"a": (0.5, high)}, only=["legal range"]).rows
        words[high] = {row["case"]: row["outcome"] for row in rows}
    assert words[1.9]["all 1.9"] == "passed" and words[1.9]["above its range"] == "degraded"
    assert words[3.0]["all 3"] == "FAILED"
    alone = dp.stress(lambda a: a**2, 1.5, ranges=(1.0, 2.0), only=["legal range"])
    assert alone and [row["case"] for row in alone.rows][:2] == ["all 1", "all 1.25"]
    free = dp.stress(loss, {"a": 1.0}, only=["scaling"]).rows
    assert {row["outcome"] for row in free if row["case"] == "times 2^10"} == {"degraded"}


def test_an_absolute_tolerance_does_not_scale():
    """A monomial has to scale exactly: what is lost at 2^-100 is found."""
    blunt = lambda u: anp.where(anp.abs(u) > 1e-12, u, 0.0)
    failed = dp.stress(lambda u: anp.sum(blunt(u) ** 2), START, only=["scaling"]).failures
    assert {row["case"] for row in failed} >= {"times 2^-100"}
    assert any("is not 2^-200 times the plain value" in row["note"] for row in failed)


def test_refusals():
    with pytest.raises(ValueError, match="stress knows the parameters dt, nu, got 'k'; write one of them"):
        dp.stress(explicit, number(0.4), ranges={"k": (0, 1)})
    with pytest.raises(ValueError, match="stress knows the parameters dt, nu, got 'k'; write one of them"):
        dp.stress(explicit, number(0.4), ranges={"k": (0, 1), "j": (0, 1)}, time_step="i", viscosity="h")
    with pytest.raises(ValueError, match=r"stress needs ranges of two finite numbers, low < high, got \(1, 0\) for nu"):
        dp.stress(explicit, number(0.4), ranges={"nu": (1, 0)})
    with pytest.raises(ValueError, match="a group of stress cases must be one of as given, scaling"):
        dp.stress(explicit, number(0.4), only=["all"])
    with pytest.raises(
        ValueError, match="this scene has no stability map; it needs a rollout, a time step and a viscosity by name"
    ):
        dp.stress(by_hand, {"dt": 1e-4}, only=["as given"]).plot()
