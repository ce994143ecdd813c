"""Derivatives that other code computes: right ones agree, wrong ones disagree, within 40 runs of a right program."""

import json
import pickle
import time
import warnings

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import LinearOperator, aslinearoperator

import sparsedp as dp

VJP = dp.check.vjp
JVP = dp.check.jvp
X = np.linspace(1.0, 2.0, 12)
M = np.cos(np.arange(60.0)).reshape(5, 12)


def marked(names, quick):
    """Return parameters: some for the default suite, all others with the marker `whole`."""
    return [pytest.param(name, id=str(name), marks=[] if name in quick else pytest.mark.whole) for name in names]


def cube(u):
    return u**3


def cube_vjp(u, g):
    return 3 * u**2 * g


def wave(u):
    return {"a": np.sin(u["p"]) * u["q"], "b": np.sum(u["p"] ** 2)}


def wave_vjp(u, g):
    p, q = u["p"], u["q"]
    return {"p": np.cos(p) * q * g["a"] + 2 * p * g["b"], "q": np.sum(np.sin(p) * g["a"])}


def wave_jvp(u, t):
    p, q = u["p"], u["q"]
    return {"a": np.cos(p) * q * t["p"] + np.sin(p) * t["q"], "b": np.sum(2 * p * t["p"])}


WAVE_POINT = {"q": 0.7, "p": X}


class Simulator:
    """A simulator with an adjoint, as many codes have it."""

    def apply(self, x):
        return np.cumsum(x**2)

    def vjp(self, x, g):
        return 2 * x * np.cumsum(g[::-1])[::-1]

    def jvp(self, x, t):
        return np.cumsum(2 * x * t)


class Stateful(Simulator):
    """A simulator whose adjoint differentiates its last run."""

    def apply(self, x):
        self.x = x
        return super().apply(x)

    def vjp(self, g):
        return super().vjp(self.x, g)


class StatefulInSecret(Stateful):
    """One that takes the point, and does not use it."""

    def vjp(self, x, g):
        return super().vjp(g)


# ---- right derivatives ---------------------------------------------------------------------------------------------


def agrees(result):
    """The documented number of runs is enough."""
    assert result.verdict == "agrees" and result.digits >= 7, result
    assert result.evaluations <= {"vjp": 41, "jvp": 58}[result.kind] and not result.gaps
    return True


def test_right_derivatives_agree():
    assert agrees(VJP(wave, wave_vjp, WAVE_POINT, jvp=wave_jvp))
    assert agrees(VJP(lambda z: z**2, lambda z, g: 2 * z * g, X + 0.5j))


@pytest.mark.whole
def test_right_derivatives_of_all_kinds_of_programs_agree():
    for result in (
        VJP(cube, cube_vjp, X),
        JVP(wave, wave_jvp, WAVE_POINT),
        VJP(Simulator(), x=X),
        JVP(Simulator(), x=X),
        VJP(Stateful(), x=X),
        VJP(dp.laplacian(dp.Grid((3, 4)))),
        VJP(dp.inverse(dp.identity(dp.Grid(5).cells) - dp.laplacian(dp.Grid(5), dp.dirichlet))),
        VJP(aslinearoperator(M)),
        VJP(lambda z: z**2, lambda z, g: 2 * np.conj(z) * g, X + 0.5j, convention="adjoint"),
        VJP(lambda u: 1e-310 * u, lambda u, g: 1e-310 * g, X),
        VJP(lambda u: 1e300 * u, lambda u, g: 1e300 * g, 1e-3 * X),
    ):
        assert result.verdict == "agrees", result
    assert len(VJP(wave, wave_vjp, WAVE_POINT, jvp=wave_jvp).identities) == 4
    for empty in (VJP(cube, cube_vjp, np.zeros(0)), VJP(lambda u: u[:0], lambda u, g: 0 * u, X)):
        assert empty.verdict == "inconclusive" and "has no entries" in empty.reason


def test_a_vjp_takes_forty_runs():
    runs = []

    def slow(u):
        runs.append("f")
        return np.sin(u) + np.roll(u, 1) ** 2

    def slow_vjp(u, g):
        runs.append("vjp")
        return np.cos(u) * g + 2 * u * np.roll(g, -1)

    x = np.linspace(0.5, 2.0, 10**3)
    result = VJP(slow, slow_vjp, x)
    assert result and len(runs) == result.evaluations <= 40


# ---- wrong derivatives ---------------------------------------------------------------------------------------------


def changes_its_cotangent(u, g):
    g *= 3 * u**2
    return g


def one_wrong_entry(u, g):
    return cube_vjp(u, g) * (1 + 1e-3 * (np.arange(12) == 7))


class Accumulator:
    """A VJP that adds to the cotangents of earlier calls."""

    def __init__(self):
        self.total = 0.0

    def __call__(self, u, g):
        self.total = self.total + cube_vjp(u, g)
        return self.total


WRONG = {
    "factor": (lambda u, g: 1.001 * cube_vjp(u, g), "off by"),
    "entry": (one_wrong_entry, "off by"),
    "single precision inside": (lambda u, g: cube_vjp(u, g).astype(np.float32), "off by"),
    "constant of x": (lambda u, g: cube_vjp(X, g), "beside x"),
    "not linear": (lambda u, g: cube_vjp(u, np.clip(g, -0.1, 0.1)), "vjp is not linear in g"),
    "in place": (changes_its_cotangent, "vjp(x, g) changes its cotangent or tangent in place"),
    "state": (Accumulator(), "two runs of vjp at x differ"),
    "NaN": (lambda u, g: np.where(np.arange(12) == 3, np.nan, g), "NaN or infinity in x, the first at 3"),
    "shape": (lambda u, g: g[:, None] * u, "vjp(x, g): expected shape (12,), got (12, 12)"),
    "nothing": (lambda u, g: None, "got None; return the cotangent of x"),
}


@pytest.mark.parametrize("name", marked(WRONG, ["constant of x", "in place", "state", "not linear"]))
def test_wrong_vjps_disagree(name):
    function, words = WRONG[name]
    result = VJP(cube, function, X)
    assert result.verdict == "disagrees" and words in str(result), result
    assert not result


@pytest.mark.whole
def test_results_can_be_stored():
    wrong = pickle.loads(pickle.dumps(VJP(cube, np.multiply, X)))
    assert wrong.verdict == "disagrees" and wrong.gaps and json.dumps(wrong.to_dict())
    assert "disagrees" in wrong.markdown() and "disagrees" in wrong.html() and wrong.csv().count("\n") > 20


def test_names_of_leaves_stand_unchanged_in_reasons():
    """Sentences are written with the words of each check, not changed afterwards."""
    x = {"the gradient": X, "the loss": X}
    pull = lambda u, g: {"the gradient": g, "the loss": np.where(np.arange(12) == 3, np.nan, g)}
    wrong = VJP(lambda u: u["the gradient"] + u["the loss"], pull, x)
    assert wrong.reason == "vjp(x, g) holds NaN or infinity in x['the loss'], the first at 3"
    push = lambda u, t: {"f(x)": np.where(np.arange(12) == 3, np.nan, t)}
    wrong = JVP(lambda u: {"f(x)": u}, push, X)
    assert wrong.reason == "jvp(x, t)['f(x)'] holds NaN or infinity, the first at 3"


def test_a_state_of_the_last_run():
    result = VJP(StatefulInSecret(), x=X)
    assert result.verdict == "disagrees" and "it keeps a state of other runs" in result.reason


def test_a_random_vjp_has_no_rounding_errors():
    """Its roughness in g looks like an ill-conditioned problem, which would give "inconclusive"."""
    rng = np.random.default_rng(0)
    result = VJP(lambda u: u**2, lambda u, g: 3 * u * g * (1 + 1e-3 * rng.random()), X)
    assert result.verdict == "disagrees", result
    assert result.reason.startswith("two runs of vjp at x differ by") and result.reason.endswith("or is random")


@pytest.mark.parametrize("check", [VJP, JVP])
@pytest.mark.parametrize("number", [2, 3, 4, 5])
def test_nan_in_a_later_run_of_a_derivative(check, number):
    """A gap that is NaN is not below a limit."""
    runs = []

    def derivative(u, g):
        runs.append(number)
        return 2 * u * g if len(runs) < number else np.full(12, np.nan)

    result = check(lambda u: u**2, derivative, X)
    assert result.verdict == "disagrees" and ("NaN" in result.reason or "two runs" in result.reason), result


def test_nan_in_the_other_derivative():
    result = VJP(cube, cube_vjp, X, jvp=lambda u, t: np.nan * t)
    assert result.verdict == "disagrees" and result.reason == "jvp(x, t) holds NaN or infinity, the first at 0"
    result = JVP(cube, lambda u, t: 3 * u**2 * t, X, vjp=lambda u, g: np.nan * g)
    assert result.verdict == "disagrees" and result.reason == "vjp(x, g) holds NaN or infinity in x, the first at 0"


def test_hessians_and_jacobians_are_named_as_they_were_given():
    loss = lambda u: np.sum(u**4)
    slope = lambda u: 4 * u**3
    wrong = dp.check.hessian(loss, lambda u, v: 12 * u * v, X, gradient=slope)
    assert wrong.result_gaps[0].startswith("gradient(x)[")
    assert [row.name for row in wrong.identities[:3]] == ["linear in v", "the Hessian twice", "gradient(x) twice"]
    for gradient in (None, slope):
        infinite = dp.check.hessian(loss, lambda u, v: np.inf * v, X, gradient=gradient)
        assert infinite.verdict == "disagrees" and "holds NaN or infinity" in infinite.reason, infinite
        assert "jvp" not in infinite.reason and "symmetric" not in infinite.reason
    infinite = dp.check.hessian(loss, lambda u, v: v, X, gradient=lambda u: np.nan * u)
    assert infinite.reason.startswith("gradient(x) is not the gradient of f, gradient(x) holds NaN or infinity in x")
    infinite = dp.check.jacobian(cube, np.full((12, 12), np.nan), X)
    assert infinite.reason.startswith("the product of the transposed Jacobian with g holds NaN or infinity in x")


@pytest.mark.parametrize("scale", [1e-300, 1e300])
def test_the_norm_of_huge_and_tiny_values(scale):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = VJP(lambda u: scale * u, lambda u, g: scale * g, np.full(4, 2.0))
    assert result.value == 4 * scale


def test_derivatives_with_less_precision_than_the_function():
    """Along some directions their errors cancel: then a test of linearity shows them."""
    rounded = VJP(lambda u: u**3, lambda u, g: (3 * u**2 * g).astype(np.float32).astype(float), X, rng=4)
    assert rounded.verdict == "disagrees" and "rounds its numbers to single precision" in rounded.reason
    inexact = VJP(lambda u: 2 * u, lambda u, g: 2 * (g + 1e-4 * np.roll(np.abs(g), 1)), X)
    assert inexact.verdict == "disagrees" and "although f is exact: tighten the tolerance" in inexact.reason


@pytest.mark.whole
def test_wrong_derivatives_of_other_kinds_disagree():
    assert JVP(cube, lambda u, t: 3.001 * u**2 * t, X).verdict == "disagrees"
    assert JVP(cube, lambda u, t: 3 * X**2 * t, X).verdict == "disagrees"
    assert VJP(lambda z: z**2, lambda z, g: 2 * np.conj(z) * g, X + 0.5j).verdict == "disagrees"
    wrong = LinearOperator((5, 12), matvec=lambda v: M @ v, rmatvec=lambda g: M.T @ g + 1e-6 * g[0], dtype=float)
    assert VJP(wrong).verdict == "disagrees"
    mismatch = VJP(cube, cube_vjp, X, jvp=lambda u, t: 3.01 * u**2 * t)
    assert mismatch.verdict == "disagrees" and "vjp is not the transpose of jvp" in mismatch.reason


def test_a_function_that_changes_its_argument():
    def doubled(u):
        u *= 2
        return u

    result = VJP(doubled, lambda u, g: 2 * g, X)
    assert result.verdict == "disagrees" and "f(x) changes x in place" in result.reason


# ---- places --------------------------------------------------------------------------------------------------------

GRID = dp.Grid((4, 5))
FIELD = np.sin(np.arange(20.0)).reshape(4, 5) + 2.0


def scaled_where(place, factor):
    """The VJP of a cube, times a factor at some entries."""

    def pull(u, g):
        slope = 3 * u**2 * g
        slope[place] *= factor
        return slope

    return pull


@pytest.mark.whole
@pytest.mark.parametrize(
    ("place", "factor", "words"),
    [
        ((0,), -1.0, "lies in x[0, :], at the lower x wall, where vjp has the wrong sign"),
        ((slice(None), 4), 0.0, "lies in x[:, 4], at the upper y wall, where vjp is 0"),
        ((..., [0, 4]), 1.1, "(as in all of x[:, 0], at the lower y wall, where vjp is too large, by a factor of 1.1)"),
        ((...,), 2.0, "every entry of x: vjp is too large, by a factor of 2"),
        ((...,), -1.0, "every entry of x: vjp has the wrong sign"),
        ((2, 3), 1.01, "x[2, 3], at x = 2.5, y = 3.5: "),
    ],
)
def test_the_wrong_entries_are_grouped(place, factor, words):
    result = VJP(cube, scaled_where(place, factor), FIELD, grid=GRID)
    assert result.verdict == "disagrees" and words in "; ".join(result.gaps), result.gaps


@pytest.mark.whole
def test_places_in_the_result_and_of_a_jvp():
    def push(u, t):
        product = 3 * u**2 * t
        product[3] *= 0.5
        return product

    result = JVP(cube, push, FIELD, grid=GRID)
    (gap,) = result.result_gaps
    assert "f(x)[3, :], at the upper x wall, where jvp is too small, by a factor of 0.5" in gap
    leaf = VJP(wave, lambda u, g: {**wave_vjp(u, g), "q": 0.0}, WAVE_POINT)
    assert leaf.gaps[0].startswith("x['q']: ")


@pytest.mark.whole
def test_gaps_of_check_gradient_are_grouped():
    slope = 2 * FIELD
    slope[0] *= -1
    loss = lambda u: np.sum(u**2)
    (gap,) = dp.check.gradient(loss, FIELD, gradient=slope, quick=True).gaps
    assert "lies in x[0, :], where the gradient has the wrong sign" in gap
    (gap,) = dp.check.gradient(loss, FIELD, gradient=lambda u: 4 * u, quick=True).gaps
    assert gap == "every entry of x: the gradient is too large, by a factor of 2"


@pytest.mark.whole
def test_mistakes_with_a_name():
    shift = np.eye(12, k=1) + 2 * np.eye(12)
    assert VJP(lambda u: shift @ u, lambda u, g: shift @ g, X).culprit == (
        "it multiplies by the Jacobian instead of its transpose"
    )
    assert "it uses a stored value" in VJP(cube, lambda u, g: cube_vjp(X, g), X).culprit
    z = X + 0.5j
    assert "convention='adjoint'" in VJP(lambda z: z**2, lambda z, g: np.conj(2 * z) * g, z).culprit
    assert "a conjugate is missing" in VJP(lambda z: z**2, lambda z, g: 2 * z * np.conj(g), z).culprit


def smooth(u):
    return u + 0.1 * np.roll(u, 1, 0)


def smooth_vjp(u, g):
    return g + 0.1 * np.roll(g, -1, 0)


def smooth_vjp_with_a_wrong_wall(u, g):
    back = smooth_vjp(u, g)
    back[0] = -back[0]
    return back


def test_the_stage_that_is_wrong():
    stages = [(cube, cube_vjp), ("blur", smooth, smooth_vjp_with_a_wrong_wall)]
    result = VJP(None, x=FIELD, stages=stages, grid=GRID)
    assert result.culprit == "stage 2 (blur)"
    assert result.gaps[0].startswith("stage 2 (blur): x[0, ")
    assert "lies in x[0, :], at the lower x wall, where vjp has the wrong sign" in result.gaps[0]


@pytest.mark.whole
def test_stages_that_are_right():
    stages = [(cube, cube_vjp), (smooth, smooth_vjp), (np.sin, lambda u, g: np.cos(u) * g)]
    assert VJP(None, x=FIELD, stages=stages).verdict == "agrees"
    assert JVP(None, x=FIELD, stages=[(cube, lambda u, t: 3 * u**2 * t), (np.sin, lambda u, t: np.cos(u) * t)])
    other = VJP(lambda u: 2 * np.sin(smooth(cube(u))), x=FIELD, stages=stages)
    assert other.verdict == "disagrees" and other.culprit == "the composition of the stages"


def test_stages_that_are_none():
    with pytest.raises(
        ValueError, match=r"^stages must have at least one stage, got none; write stages=\[\(f, vjp\)\]$"
    ):
        VJP(None, x=FIELD, stages=[])
    with pytest.raises(TypeError, match=r"^stage 1 must be a pair of functions; write \(f, vjp\)$"):
        VJP(None, x=FIELD, stages=[(cube, 3)])


# ---- hard programs -------------------------------------------------------------------------------------------------


def truncated_solve(b, tolerance):
    """Conjugate gradients with a loose tolerance, as many codes have them."""
    A = 2.1 * np.eye(b.size) - np.eye(b.size, k=1) - np.eye(b.size, k=-1)
    x = np.zeros_like(b)
    r = p = b
    while r @ r > tolerance**2 * (b @ b):
        a = (r @ r) / (p @ A @ p)
        x = x + a * p
        old = r
        r = r - a * (A @ p)
        p = r + (r @ r) / (old @ old) * p
    return x


WIDE = np.logspace(-12.0, 12.0, 40)
SINGLE = np.linspace(1.0, 2.0, 30, dtype=np.float32)
HARD = {
    "entries of 24 decades": (np.log, lambda u, g: g / u, WIDE, "agrees"),
    "results of 24 decades": (lambda u: WIDE * np.sin(u), lambda u, g: WIDE * np.cos(u) * g, np.ones(40), "agrees"),
    "single precision": (np.sin, lambda u, g: np.cos(u) * g, SINGLE, "agrees"),
    "kinks near x": (np.abs, lambda u, g: np.sign(u) * g, np.linspace(-1.0, 1.0, 30), "agrees"),
    "an inexact solve": (
        lambda u: truncated_solve(u**2, 1e-4),
        lambda u, g: 2 * u * truncated_solve(g, 1e-4),
        np.linspace(1.0, 2.0, 30),
        "inconclusive",
    ),
    "a staircase": (lambda u: np.round(u, 3), lambda u, g: 0 * u, X, "inconclusive"),
    "a constant": (lambda u: np.ones(3), lambda u, g: 0 * u, X, "inconclusive"),
    "a kink at x": (lambda u: np.abs(u - X), lambda u, g: np.sign(u - X) * g, X, "inconclusive"),
}


@pytest.mark.parametrize("name", marked(HARD, ["entries of 24 decades", "an inexact solve"]))
def test_right_but_hard_programs(name):
    f, pull, x, verdict = HARD[name]
    assert VJP(f, pull, x).verdict == verdict


def test_small_entries_hide_no_error():
    two = lambda p: 1e10 * p["a"] ** 2 + np.sum(p["b"] ** 2)
    pull = lambda p, g: {"a": 2e10 * p["a"] * g, "b": np.sum(g) * p["b"]}
    result = VJP(two, pull, {"a": np.linspace(1.0, 2.0, 40), "b": X[:3]})
    assert result.gaps == ("every entry of x['b']: vjp is too small, by a factor of 0.5",)


@pytest.mark.whole
def test_small_entries_of_one_array_hide_no_error():
    wrong = 1 + 0.1 * (np.arange(40) == 3)
    assert "x[3]" in VJP(np.square, lambda u, g: 2 * u * g * wrong, WIDE).gaps[0]
    assert (
        VJP(lambda u: WIDE * np.sin(u), lambda u, g: WIDE * np.cos(u) * g * wrong, np.ones(40)).verdict == "disagrees"
    )
    tail = np.exp(-(np.linspace(-8.0, 8.0, 40) ** 2))
    wall = np.ones(40)
    wall[0] = 0.0
    assert VJP(lambda u: u + u**2, lambda u, g: (1 + 2 * u) * g * wall, tail).verdict == "disagrees"


@pytest.mark.slow
def test_the_seconds_of_a_simulator_of_1e5_unknowns():
    """Forty runs of 0.1 seconds; the rest of the work takes less than they do."""

    def run(u):
        time.sleep(0.1)
        return u + 0.1 * np.roll(u, 1) * u - 0.05 * u**3

    def pull(u, g):
        time.sleep(0.1)
        return 0.1 * np.roll(u, 1) * g + g - 0.15 * u**2 * g + np.roll(0.1 * u * g, -1)

    result = VJP(run, pull, np.random.default_rng(0).standard_normal(10**5))
    assert result and result.evaluations <= 40 and result.seconds < 8.0


# ---- matrices ------------------------------------------------------------------------------------------------------


@pytest.mark.whole
def test_jacobians():
    slopes = np.diag(np.cos(X))
    for J in (
        slopes,
        sp.diags(np.cos(X)),
        aslinearoperator(slopes),
        dp.from_matrix(slopes),
        lambda u: np.diag(np.cos(u)),
    ):
        assert dp.check.jacobian(np.sin, J, X)
    assert dp.check.jacobian(lambda z: M @ z**2, lambda z: 2 * M * z, X + 0.5j)
    assert dp.check.jacobian(np.sin, 1.001 * slopes, X).verdict == "disagrees"
    wrong = dp.check.jacobian(np.sin, M, X)
    assert wrong.verdict == "disagrees" and wrong.reason.startswith(
        "the Jacobian has shape (5, 12), expected (12, 12); "
    )


@pytest.mark.whole
def test_hessians():
    loss = lambda u: np.sum(u**4)
    gradient = lambda u: 4 * u**3
    product = lambda u, v: 12 * u**2 * v
    matrix = np.diag(12 * X**2)
    for H in (product, matrix, lambda u: np.diag(12 * u**2)):
        assert dp.check.hessian(loss, H, X)
        assert dp.check.hessian(loss, H, X, gradient=gradient).digits >= 7
    assert dp.check.hessian(loss, 1.001 * matrix, X).verdict == "disagrees"
    assert dp.check.hessian(loss, lambda u: matrix, X).verdict == "disagrees"
    assert dp.check.hessian(loss, lambda u, v: product(u, v) * (1 + 1e-6), X, gradient=gradient).verdict == "disagrees"
    assert dp.check.hessian(lambda u: np.sum((u - X) ** 2), lambda u, v: 2 * v, X)
    assert dp.check.hessian(np.sum, lambda u, v: 0 * v, X)
    assert dp.check.hessian(lambda u: np.sum(np.abs(u) ** 3), lambda u, v: 6 * np.abs(u) * v, X - 1.5)


@pytest.mark.parametrize(
    ("slope", "bend", "culprit", "words"),
    [
        (3, 12, "the gradient", "the Hessian agrees"),
        (3, 9, "the gradient and the Hessian", "the Hessian disagrees, too"),
        (4, 9, None, ""),
    ],
)
def test_a_wrong_gradient_is_not_blamed_on_the_hessian(slope, bend, culprit, words):
    result = dp.check.hessian(lambda u: np.sum(u**4), lambda u, v: bend * u**2 * v, X, gradient=lambda u: slope * u**3)
    assert result.verdict == "disagrees" and result.culprit == culprit and result.reason.endswith(words)
    assert ("gradient(x) is not the gradient of f" in result.reason) == (slope == 3)
    assert ("gradient(x) is too small" in result.gaps[0]) == (slope == 3)


def test_a_hessian_that_is_not_symmetric():
    A = M.T @ np.roll(M, 1, 0)
    for options in ({}, {"gradient": lambda u: (A + A.T) @ u}):
        wrong = dp.check.hessian(lambda u: u @ A @ u, 2 * A, X, **options)
        assert wrong.verdict == "disagrees" and "the Hessian is not symmetric" in wrong.reason
        assert dp.check.hessian(lambda u: u @ A @ u, A + A.T, X, **options)
