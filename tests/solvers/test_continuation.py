"""Continuation: exact branches and folds, published folds, branch points, gradients of points, what is refused."""

import autograd.numpy as anp
import numpy as np
import pytest
from test_steady import bratu, bratu_exact

import sparsedp as dp
import sparsedp.solvers.continuation as module
from sparsedp.errors import ConvergenceError, DerivativeError, JitError, NonFiniteError, ShapeError, UnstableStepError

BRATU_FOLD = {1: 3.513830719, 2: 6.808124423}


def cubic(x, p, scale=1.0):
    """p = x^3 - 3 x in units of the scale: folds at x = -1 and 1, p = 2 and -2."""
    return p / scale + 3 * x - x**3


def test_folds_of_a_cubic_are_exact():
    branch = dp.continuation(cubic, -3.0, -4.0, 4.0, step=2.0, largest_step=4.0)
    assert branch.status == "reached_stop"
    assert branch.parameter[0] == -4.0
    assert branch.parameter[-1] == 4.0
    x = np.array(branch.states)
    np.testing.assert_allclose(branch.parameter, x**3 - 3 * x, rtol=0, atol=1e-8)
    assert np.all(np.diff(x) > 0)
    assert [fold.parameter for fold in branch.folds] == pytest.approx([2.0, -2.0], rel=1e-14)
    assert [fold.state for fold in branch.folds] == pytest.approx([-1.0, 1.0], abs=1e-7)
    assert [branch.states[fold.index] for fold in branch.folds] == [fold.state for fold in branch.folds]
    assert abs(branch.folds[0].null_vector) == 1.0
    assert repr(branch) == f"<branch of {len(branch)} steady states, parameter -4 to 4, 2 folds, reached_stop>"


@pytest.mark.parametrize("scale", [1e-250, 1e-170, 1e160, 1e200])
def test_folds_are_found_in_any_unit_of_the_parameter(scale):
    """Products of two slopes dp/ds, which are proportional to the scale, would underflow or overflow."""
    branch = dp.continuation(lambda x, p: cubic(x, p, scale), -3.0, -4.0 * scale, 4.0 * scale)
    assert branch.status == "reached_stop"
    assert [fold.parameter / scale for fold in branch.folds] == pytest.approx([2.0, -2.0], rel=1e-14)
    branch = dp.continuation(lambda x, p: cubic(x, p, scale), -3.0, -4.0 * scale, 4.0 * scale, largest_step=8.0 * scale)
    assert [fold.parameter / scale for fold in branch.folds] == pytest.approx([2.0, -2.0], rel=1e-14)


def inflected(x, p, a):
    """p = x^3 - a x: two folds at p = -+2 (a / 3)^(3/2), which are close together for a small a; none for a <= 0."""
    return p - x**3 + a * x


@pytest.mark.parametrize(
    ("a", "settings"),
    [
        (1e-3, {"largest_step": 2.0}),
        pytest.param(1e-3, {}, marks=pytest.mark.whole),
        pytest.param(1e-3, {"step": 0.013}, marks=pytest.mark.whole),
        pytest.param(0.1, {"largest_step": 2.0}, marks=pytest.mark.whole),
        pytest.param(1e-5, {"largest_step": 2.0}, marks=pytest.mark.whole),
    ],
)
def test_two_folds_within_a_step_are_found(a, settings):
    branch = dp.continuation(inflected, -1.0, -1.0, 1.0, a, **settings)
    fold = 2 * (a / 3) ** 1.5
    assert [point.parameter for point in branch.folds] == pytest.approx([fold, -fold], abs=1e-12)
    assert [branch.parameter[point.index] for point in branch.folds] == [point.parameter for point in branch.folds]
    assert np.all(np.diff(branch.states) > 0)


@pytest.mark.whole
def test_two_folds_within_a_step_are_found_by_natural_steps():
    with pytest.raises(ConvergenceError, match=r"there are two folds in a step of \d\.\de-\d\d"):
        dp.continuation(inflected, -1.0, -1.0, 1.0, 1e-6, method="natural")


@pytest.mark.whole
@pytest.mark.parametrize("a", [0.0, -1e-6, -1e-3])
def test_an_inflection_is_no_fold(a):
    for method in ("arclength", "natural"):
        assert not dp.continuation(inflected, -1.0, -1.0, 1.0, a, method=method).folds


@pytest.mark.whole
@pytest.mark.parametrize("error", [0.0, 1e-15, -1e-15, 1e-11, -1e-11])
def test_a_fold_at_the_end_of_the_range_ends_the_branch(error):
    branch = dp.continuation(cubic, -3.0, -4.0, 2.0 + error)
    assert branch.status == "reached_stop"
    assert branch.parameter[-1] == 2.0 + error
    assert [fold.index for fold in branch.folds] == [len(branch) - 1]
    branch = dp.continuation(cubic, -2.5, -2.0 + error, 4.0)
    assert branch.status == "returned_to_start"
    assert branch.parameter[-1] == -2.0 + error
    assert [fold.index for fold in branch.folds][1:] == [len(branch) - 1]


def test_a_fold_has_no_derivative():
    """The state moves by sqrt(d) if the parameter is at the distance d from the fold."""
    branch = dp.continuation(lambda x, p, s: s * cubic(x, p), np.array([-3.0]), -4.0, 4.0, 1.0)
    fold = branch.folds[1]

    def state(q):
        return branch.solve(fold.index, *q)[0]

    for derivative in (dp.grad(state), lambda q: dp.jvp(state, q, (1.0, 0.0))):
        with pytest.raises(
            ConvergenceError,
            match=r"the steady state at parameter -2 is a fold up to the tolerance, where it has no derivative; "
            "differentiate at another parameter, or write a smaller rtol",
        ):
            derivative((fold.parameter, 1.0))
    p = fold.parameter + 1e-4
    slope = dp.grad(lambda p: branch.solve(fold.index + 1, p, 1.0)[0])(p)
    x = float(branch.solve(fold.index + 1, p, 1.0)[0])
    assert slope == pytest.approx(1 / (3 * x**2 - 3), rel=1e-9)


@pytest.mark.whole
@pytest.mark.parametrize("unit", [2.0**-500, 2.0**500])
def test_units_of_the_state_do_not_matter(unit):
    def scaled(x, p):
        return cubic(x / unit, p)

    branch = dp.continuation(scaled, -3.0 * unit, -4.0, 4.0, step=1.0, largest_step=2.0, maxsteps=9)
    plain = dp.continuation(cubic, -3.0, -4.0, 4.0, step=1.0, largest_step=2.0, maxsteps=9)
    np.testing.assert_allclose(branch.parameter, plain.parameter, rtol=1e-13)
    np.testing.assert_allclose(branch.states, np.array(plain.states) * unit, rtol=1e-13)


@pytest.mark.whole
def test_units_of_the_parameter_do_not_matter():
    def scaled(x, p):
        return cubic(x, p * 2.0**500)

    branch = dp.continuation(scaled, -3.0, -(2.0**-498), 2.0**-498)
    assert [fold.parameter * 2.0**500 for fold in branch.folds] == pytest.approx([2.0, -2.0], rel=1e-14)


@pytest.mark.whole
def test_a_branch_may_go_down():
    branch = dp.continuation(cubic, 3.0, 4.0, -4.0, largest_step=2.0)
    assert [fold.parameter for fold in branch.folds] == pytest.approx([-2.0, 2.0], rel=1e-14)
    assert branch.parameter[-1] == -4.0


@pytest.mark.whole
def test_bratu_in_1d_returns_on_the_upper_branch():
    folds = []
    for n in (32, 64):
        branch = dp.continuation(bratu(n), np.zeros(n), 1.0, 4.0)
        assert branch.status == "returned_to_start"
        assert branch.parameter[-1] == 1.0
        folds.append(branch.folds[0].parameter)
        assert folds[-1] == np.max(branch.parameter)
    assert (4 * folds[1] - folds[0]) / 3 == pytest.approx(BRATU_FOLD[1], rel=1e-6)
    (x,) = dp.Grid(64, size=1.0).centres()
    np.testing.assert_allclose(branch.states[0], bratu_exact(x, 1.0), rtol=0, atol=1e-4)
    theta = dp.implicit(lambda t: t - np.sqrt(2.0) * anp.cosh(t / 4))(11.0)
    upper = -2 * np.log(np.cosh((x - 0.5) * theta / 2) / np.cosh(theta / 4))
    np.testing.assert_allclose(branch.states[-1], upper, rtol=0, atol=0.01)


@pytest.mark.whole
def test_bratu_in_2d_has_the_published_fold():
    folds = []
    for n in (16, 32):
        branch = dp.continuation(bratu(n, 2), np.zeros((n, n)), 1.0, 8.0)
        folds.append(branch.folds[0].parameter)
    assert (4 * folds[1] - folds[0]) / 3 == pytest.approx(BRATU_FOLD[2], rel=1e-5)


def test_the_symmetric_branch_passes_a_pitchfork():
    """L u + p u - u^3 = 0: u = 0 crosses another branch at the first eigenvalue of -L, where J is singular."""
    n = 12
    grid = dp.Grid(n, size=1.0)
    L = dp.laplacian(grid, dp.dirichlet)
    first = 4 * n**2 * np.sin(np.pi / (2 * n)) ** 2

    def residual(u, p):
        return L(u) + p * u - u**3

    # the third step ends at the branch point
    branch = dp.continuation(residual, np.zeros(n), 0.0, 2 * first, step=first / 7, largest_step=2 * first)
    assert branch.status == "reached_stop"
    assert not branch.folds
    assert not np.any(branch.states)
    mode = np.sin(np.pi * grid.centres()[0])
    other = dp.continuation(residual, 0.6 * mode, first + 0.3, 2 * first)
    assert other.status == "reached_stop"
    assert other.states[0] @ mode / (mode @ mode) == pytest.approx(np.sqrt(0.3 * 4 / 3), rel=0.01)


def test_the_jacobian_may_be_singular_at_a_point():
    """The first step ends at the branch point x = 0, p = 1."""
    branch = dp.continuation(lambda x, p: (p - 1) * x, 0.0, 0.0, 2.0, step=1.0, largest_step=1.0)
    assert list(branch.parameter) == [0.0, 1.0, 2.0]
    assert branch.states == [0.0, 0.0, 0.0]


def test_natural_steps_have_the_length_given():
    branch = dp.continuation(cubic, -3.0, -4.0, 1.5, method="natural", step=0.5, largest_step=0.5)
    np.testing.assert_allclose(branch.parameter, np.arange(-4.0, 1.6, 0.5), rtol=0, atol=1e-14)
    assert branch.status == "reached_stop"


@pytest.mark.whole
def test_natural_steps_do_not_pass_a_fold():
    with pytest.raises(
        ConvergenceError,
        match=r"continuation stopped at parameter 2 after \d+ steps, as shorter steps fail as well: "
        r"a fold may be near, write method='arclength'; error\.branch is the branch up to there; the last failure was: "
        ".*",
    ) as failure:
        dp.continuation(cubic, -3.0, -4.0, 4.0, method="natural")
    assert failure.value.best == pytest.approx(-1.0, abs=0.1)


def test_a_point_has_derivatives():
    """dx/dp = -1 / (3 - 3 x^2), and x depends on p / scale alone."""
    branch = dp.continuation(cubic, -3.0, -4.0, 4.0, 1.0, largest_step=2.0)
    middle = int(np.argmin(np.abs(branch.states)))
    p = branch.parameter[middle]
    slopes = dp.grad(lambda q: branch.solve(middle, q["p"], q["scale"]))({"p": p, "scale": 1.0})
    x = branch.states[middle]
    assert slopes["p"] == pytest.approx(1 / (3 * x**2 - 3), rel=1e-9)
    assert slopes["scale"] == pytest.approx(-p * slopes["p"], rel=1e-9)


@pytest.mark.whole
def test_the_gradient_of_a_point_agrees():
    L = dp.laplacian(dp.Grid(12, size=1.0), dp.dirichlet)
    branch = dp.continuation(
        lambda u, lam, k: k * L(u) + lam * anp.exp(u), np.zeros(12), 1.0, 3.0, np.ones(12), rtol=1e-13
    )

    def energy(q):
        return anp.sum(branch.solve(-1, q["lam"], q["k"]) ** 2)

    assert dp.check.gradient(energy, {"lam": 2.9, "k": np.linspace(1.0, 1.1, 12)}).verdict == "agrees"


def test_trees_and_dtypes_are_those_of_the_guess():
    """u = w^2 and p + 3 w - w^3 = 0; the residual is a list, and u has another unit."""

    def residual(x, p, unit):
        return [x["u"] / unit - x["w"] ** 2, cubic(x["w"], p)]

    guess = {"u": np.float32([9e6]), "w": np.array([-3.0])}
    branch = dp.continuation(residual, guess, -4.0, 4.0, 1e6)
    assert [fold.parameter for fold in branch.folds] == pytest.approx([2.0, -2.0], rel=1e-13)
    state = branch.folds[1].state
    assert state["u"].dtype == np.float32
    assert state["w"].dtype == np.float64
    assert state["u"][0] == pytest.approx(1e6, rel=1e-6)
    assert set(branch.folds[1].null_vector) == {"u", "w"}


@pytest.mark.whole
def test_a_step_into_an_undefined_place_is_repeated():
    def residual(x, p):
        if p > 2.5:
            raise UnstableStepError("too far")
        return cubic(x, p)

    branch = dp.continuation(residual, -3.0, -4.0, 4.0, step=7.0, largest_step=7.0, maxsteps=30)
    assert branch.rejected > 0
    assert branch.folds[0].parameter == pytest.approx(2.0, rel=1e-14)


def test_a_step_is_not_longer_than_the_range():
    branch = dp.continuation(cubic, -3.0, -4.0, 4.0, step=1e300)
    assert [fold.parameter for fold in branch.folds] == pytest.approx([2.0, -2.0], rel=1e-14)


def test_the_number_of_steps_is_limited():
    branch = dp.continuation(cubic, -3.0, -4.0, 4.0, maxsteps=3)
    assert branch.status == "max_steps"
    assert len(branch) == 4


def test_a_branch_is_not_continued_from_a_singular_point():
    with pytest.raises(
        ConvergenceError,
        match="continuation cannot start at parameter 0, where the Jacobian is singular; start at another one, or fix "
        "what is free by a constant",
    ):
        dp.continuation(lambda x, p: x**2 - p, 0.0, 0.0, 1.0)
    L = dp.laplacian(dp.Grid(80), dp.neumann)
    with pytest.raises(ConvergenceError, match="continuation cannot start at parameter 1, where the Jacobian"):
        dp.continuation(lambda u, p: p * L(u), np.zeros(80), 1.0, 2.0)


@pytest.mark.whole
def test_a_branch_that_ends_is_reported():
    """x = sqrt(p - 1) ends at p = 1 with a vertical tangent in the wrong direction: NaN behind it."""
    with pytest.raises(
        ConvergenceError,
        match=r"continuation stopped at parameter .* after \d+ steps, as shorter steps fail as well: the branch may "
        r"end or go to infinity there, or the residual may have a kink; error\.branch is the branch up to there; the "
        "last failure was: .*",
    ) as failure:
        dp.continuation(lambda x, p: x - anp.sqrt(p - 1), 1.0, 2.0, 0.0)
    branch = failure.value.branch
    assert branch.status == "stopped"
    assert branch.parameter[-1] == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(branch.parameter, 1 + np.square(branch.states), rtol=1e-9)
    assert branch.solve(0, 2.0) == branch.states[0] == 1.0


@pytest.mark.parametrize("stop", [1.0, pytest.param(0.5, marks=pytest.mark.whole)])
def test_a_branch_to_infinity_has_no_fold_there(stop):
    """x = p exp(x) has one fold, at p = 1 / e; then x grows without bound while p decreases to `start`."""
    branch = dp.continuation(lambda x, p: x - p * anp.exp(x), 0.0, 0.0, stop, maxsteps=70)
    assert branch.status == "max_steps"
    assert [fold.parameter for fold in branch.folds] == pytest.approx([1 / np.e], rel=1e-13)
    assert branch.folds[0].state == pytest.approx(1.0, abs=1e-7)
    x = np.array(branch.states)
    assert x[-1] > 100
    np.testing.assert_allclose(branch.parameter, x * np.exp(-x), rtol=1e-8)
    assert branch.params == branch.param_count == 0


@pytest.mark.whole
def test_a_branch_to_a_singular_state_is_returned_with_the_error():
    """L u + lam / (1 - u)^2 = 0, a membrane in an electric field: u reaches 1 as lam returns to 0."""
    n = 16
    L = dp.laplacian(dp.Grid(n, size=1.0), dp.dirichlet)

    def residual(u, lam):
        return L(u) + lam / (1 - u) ** 2

    with pytest.raises(ConvergenceError, match="the branch may end or go to infinity there") as failure:
        dp.continuation(residual, np.zeros(n), 0.0, 2.0)
    assert "raise maxiter" not in str(failure.value)
    branch = failure.value.branch
    assert branch.status == "stopped"
    assert np.array_equal(branch.states[-1], failure.value.best)
    assert 0 < branch.parameter[-1] < 1e-8
    assert np.max(branch.states[-1]) < 1
    (fold,) = branch.folds
    assert dp.jvp(lambda u: residual(u, fold.parameter), fold.state, fold.null_vector)[1] == pytest.approx(0, abs=1e-4)
    assert fold.parameter == pytest.approx(1.4000164, rel=0.005)


def test_a_point_that_fails_a_test_is_not_taken(monkeypatch):
    monkeypatch.setattr(module, "SMALLEST_STEP", 0.4)
    monkeypatch.setattr(module, "FOLD_TOLERANCE", 0.0)
    monkeypatch.setattr(module, "FOLD_STEPS", 1)
    with pytest.raises(ConvergenceError, match=r"the fold near parameter (2|1\.9\d+) is not located"):
        dp.continuation(cubic, -3.0, -4.0, 4.0)
    monkeypatch.setattr(module, "RECHECKS", 1)
    with pytest.raises(
        ConvergenceError,
        match=r"the residual at parameter -3\.\d+ is small only beside the terms of an earlier iterate",
    ):
        dp.continuation(cubic, -3.0, -4.0, 4.0)


def test_a_kink_and_a_missing_end_stop_the_branch():
    with pytest.raises(ConvergenceError, match=r"the branch turns by \d\.\d+ radians in a step of \d\.\de-\d\d"):
        dp.continuation(lambda x, p: x - 2 - 0.6 * anp.abs(p), 2.6, -1.0, 1.0)

    def residual(x, p):
        return x - (100.0 if p == 1.0 else p)

    with pytest.raises(ConvergenceError, match="there is no point of this branch at parameter 1") as failure:
        dp.continuation(residual, 0.0, 0.0, 1.0)
    np.testing.assert_allclose(failure.value.branch.states, failure.value.branch.parameter, rtol=1e-9)


def test_wrong_arguments_are_refused():
    for stop in (1.0, 1.0 + 1e-15, 1.0 - 1e-13):
        with pytest.raises(
            ValueError,
            match=r"continuation needs a range of the parameter that is long beside rounding errors, got start = 1\.0 "
            "and stop = .*",
        ):
            dp.continuation(cubic, 1.0, 1.0, stop)
    with pytest.raises(
        ValueError,
        match=r"the range of continuation must be finite, got start = -1e\+308 and stop = 1e\+308; give the parameter "
        "in other units",
    ):
        dp.continuation(cubic, 1.0, -1e308, 1e308)
    with pytest.raises(ShapeError, match="continuation needs a guess with at least one number, got none"):
        dp.continuation(lambda x, p: x - p, np.zeros(0), 0.0, 1.0)
    with pytest.raises(ValueError, match="method of continuation must be one of arclength, natural, got 'arc'"):
        dp.continuation(cubic, 1.0, 0.0, 1.0, method="arc")
    with pytest.raises(TypeError, match="continuation takes a function, got float"):
        dp.continuation(1.0, 1.0, 0.0, 1.0)
    with pytest.raises(NonFiniteError, match="stop must be finite"):
        dp.continuation(cubic, 1.0, 0.0, np.inf)
    with pytest.raises(NonFiniteError, match="guess"):
        dp.continuation(cubic, np.nan, 0.0, 1.0)
    with pytest.raises(ValueError, match="step must be > 0"):
        dp.continuation(cubic, 1.0, 0.0, 1.0, step=-1.0)
    with pytest.raises(
        DerivativeError,
        match=r"continuation returns plain numbers; differentiate branch\.solve\(index, p, \*params\), which solves "
        "for the steady state near a point",
    ):
        dp.grad(lambda s: dp.continuation(cubic, -3.0, -4.0, 4.0, s).states[-1])(1.0)
    with pytest.raises(
        JitError, match="dp.jit cannot record continuation, whose steps depend on values; call it without dp.jit"
    ):
        dp.jit(lambda s: dp.continuation(cubic, -3.0, -4.0, 4.0, s).states[-1])(1.0)


def test_wrong_arguments_of_solve_are_refused():
    branch = dp.continuation(cubic, -3.0, -4.0, -3.0, 1.0)
    n = len(branch)
    assert branch.solve(-n, -4.0, 1.0) == pytest.approx(branch.states[0])
    with pytest.raises(IndexError, match=r"^index of branch\.solve must be from .* to .*, got .*$"):
        branch.solve(n, -4.0, 1.0)
    with pytest.raises(IndexError, match=f"index of branch.solve must be from -{n} to {n - 1}, got -{n + 1}"):
        branch.solve(-n - 1, -4.0, 1.0)
    with pytest.raises(TypeError, match=r"index of branch\.solve must be an integer, got 1\.0"):
        branch.solve(1.0, -4.0, 1.0)
    with pytest.raises(TypeError, match=r"p of branch\.solve must be one real number, got an array of shape \(1,\)"):
        branch.solve(0, np.ones(1), 1.0)
    with pytest.raises(
        TypeError,
        match=r"branch\.solve takes an index, p and 1 other parameters, as many as continuation got, got 0",
    ):
        branch.solve(0, -4.0)


def test_the_first_step_and_the_last_one():
    """`step` is taken as given where `largest_step` is not; a point within rounding of `stop` is the last one."""
    line = dp.continuation(lambda x, p: x - p, 0.0, 0.0, 1.0, method="natural", step=0.5)
    assert line.parameter[1] == 0.5
    line = dp.continuation(lambda x, p: x - p, 0.0, 0.0, 1.0, method="natural", step=0.1, largest_step=0.1)
    assert len(line) == 11 and line.parameter[-1] == 1.0
    with pytest.raises(TypeError, match="takes 2; write lambda x, p, param_0: ..."):
        dp.continuation(lambda x, p: x - p, 0.0, 0.0, 1.0, 2.0)
