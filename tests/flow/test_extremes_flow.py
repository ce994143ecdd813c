"""Extreme cases of transport, steppers, projection and rollout together: what the files of each do not ask."""

from itertools import product

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

SHAPE = dp.errors.ShapeError
NONFINITE = dp.errors.NonFiniteError
SCHEMES = ("upwind", "van_leer", "semi_lagrangian", "maccormack")
SPLIT = ("imex", "etdrk4")
METHODS = ("euler", "heun", "ssprk3", "rk4", "backward_euler", "crank_nicolson", "tr_bdf2", "radau", *SPLIT)
IN_PLACE = r"the rate changes the state in place; write u = u \+ du instead of u \+= du, or work on a copy"
LINE = dp.laplacian(dp.Grid(5, size=1.0, periodic=True))


@pytest.fixture
def rng():
    return np.random.default_rng(4)


def scene(scheme, rng, shape=(6, 5), **options):
    """A step, a field, a velocity through which nothing leaves, values at the walls."""
    grid = dp.Grid(shape, size=1.0)
    move = dp.transport(grid, scheme, dp.dirichlet, **options)
    v = 0.3 * dp.interior(grid)(rng.normal(size=grid.faces.size))
    return move, rng.random(move.space.shape), v, rng.random(move.walls.shape)


# ---- transport ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme, of", list(product(SCHEMES, ("cells", "faces"))))
def test_separate_gradients_next_to_solids(scheme, of, rng):
    """Gradients requested separately equal those requested together."""
    solid = np.zeros((6, 5), bool)
    solid[2:4, 1:3] = solid[5, 4] = True
    move, *args = scene(scheme, rng, of=of, solid=solid)
    args.insert(2, 0.02)
    together = dp.value_and_grad(lambda x: anp.sum(move(*x) ** 3))(tuple(args))[1]
    for number, wanted in enumerate(together):
        slope = dp.value_and_grad(lambda x, n=number: anp.sum(move(*args[:n], x, *args[n + 1 :]) ** 3))(args[number])[1]
        np.testing.assert_allclose(slope, wanted, rtol=1e-13, atol=1e-14)


# ---- rollout of library steps -------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", SCHEMES)
def test_single_precision_in_a_rollout(scheme, rng):
    """In state, params or both: gradients have the dtype of each and are close to double precision."""
    move, u, v, q = scene(scheme, rng)
    step = lambda u, v: move(u, v, 0.02, q)
    slopes = dp.value_and_grad(lambda x: anp.sum(dp.rollout(step, *x, 7) ** 2))
    wanted = slopes((u, v))[1]
    for kinds in product((np.float32, np.float64), repeat=2):
        given = tuple(x.astype(kind) for x, kind in zip((u, v), kinds))
        found = slopes(given)[1]
        assert [slope.dtype for slope in found] == list(kinds)
        for one, other in zip(found, wanted):
            assert np.max(np.abs(one - other)) <= 1e-4 * np.max(np.abs(other))


# ---- steppers -----------------------------------------------------------------------------------------------------


def made(method, rate, dt=1e-3):
    return dp.stepper(method, rate, dt, **({"linear": LINE} if method in SPLIT else {}))


@pytest.mark.parametrize("shape", [(5, 6), (30,), (6, 4), (1, 1), (1, 5), ()])
@pytest.mark.parametrize("rate", [None, lambda u, p: -u])
def test_etdrk4_refuses_other_shapes(rate, shape):
    """The transposed shape and the flat field have as many values: they used to be read in the wrong order."""
    step = dp.stepper("etdrk4", rate, 1e-3, linear=dp.laplacian(dp.Grid((6, 5)), dp.dirichlet))
    with pytest.raises(SHAPE, match=r"^(stepper\(etdrk4\) takes a field on|rate: expected shape)"):
        step(np.ones(shape))


@pytest.mark.parametrize("method", METHODS)
def test_a_rate_that_writes_into_the_state(method):
    u = np.ones(5)
    if method in ("backward_euler", "crank_nicolson", "tr_bdf2"):
        pytest.skip("their rates are traced, and a traced value cannot be written into")
    with pytest.raises(ValueError, match=f"^{IN_PLACE}$"):
        made(method, lambda u, p: u.__imul__(2.0))(u)
    with pytest.raises(ValueError, match="^broken"):
        made(method, lambda u, p: (_ for _ in ()).throw(ValueError("broken")))(u)
    assert np.all(u == 1)


@pytest.mark.parametrize("method", ["euler", "heun", "ssprk3", "rk4", "imex", "etdrk4"])
def test_a_complex_rate_of_a_real_state(method):
    """Its imaginary part used to be dropped."""
    step = made(method, lambda u, p: 1j * u)
    with pytest.raises(
        TypeError, match=r"^a rate of complex numbers needs a complex state, got float64; write u.astype\(complex\)$"
    ):
        step(np.ones(5))
    assert np.any(step(np.ones(5, complex)).imag)


@pytest.mark.parametrize("method", METHODS)
def test_nonfinite_values_are_named(method):
    """Also where a solver is the first to detect it."""
    step = made(method, lambda u, p: -p * u)
    timed = made(method, lambda u, p, t: -p * u * anp.cos(t))
    u = np.ones(5)
    wrong = np.array([1.0, 1.0, np.nan, 1.0, np.inf])
    at = "got 2 that are NaN or infinite, the first at 2$"
    with np.errstate(invalid="ignore"):
        for state, params, words in (
            (wrong, 1.0, rf"state of stepper\({method}\) must be finite, {at}"),
            (u, wrong, rf"params of stepper\({method}\) must be finite, {at}"),
            (u, {"a": 1.0, "k": np.inf}, rf"params\['k'\] of stepper\({method}\) must be finite, got inf;"),
        ):
            rate = step if not isinstance(params, dict) else made(method, lambda u, p: -p["k"] * u)
            with pytest.raises(NONFINITE, match="^" + words):
                rate(state, params)
        with pytest.raises(NONFINITE, match=rf"^state\[1\] of stepper\({method}\) must be finite, got nan;"):
            timed((u, np.nan), 1.0)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("method", [word for word in METHODS if word != "radau"])  # real states only
def test_dtypes_in_a_loop_of_linear_steps(method, rng):
    """The step's own pullback gives the dtypes of the tape: single precision, complex state and real coefficient."""
    step = dp.stepper(method, dp.laplacian(dp.Grid((6, 5), size=1.0), dp.dirichlet), 1e-3)
    u = rng.random((6, 5))
    slopes = dp.value_and_grad(lambda x: anp.sum(anp.abs(dp.rollout(step, *x, 5)) ** 2))
    plain = dp.value_and_grad(
        lambda x: anp.sum(anp.abs(step(step(step(step(step(x[0], x[1]), x[1]), x[1]), x[1]), x[1])) ** 2)
    )
    for kind, other in product("fdFD", "fd"):
        start = (u + 1j * u[::-1]).astype(kind) if kind in "FD" else u.astype(kind)
        point = (start, np.dtype(other).type(0.3))
        found = slopes(point)[1]
        wanted = plain(point)[1]
        assert found[0].dtype == kind and np.asarray(found[1]).dtype == other
        for one, two in zip(found, wanted):
            assert np.max(np.abs(one - two)) <= (1e-13 if kind + other in ("dd", "Dd") else 1e-5) * np.max(np.abs(two))


def test_a_rollout_of_whole_numbers_that_become_floats_is_refused():
    with pytest.raises(SHAPE, match="made a floating value of an array of dtype int64; start with a floating value"):
        dp.rollout(lambda u, p: 0.5 * u, np.arange(100), None, 2)


@pytest.mark.parametrize("method", ["backward_euler", "crank_nicolson", "tr_bdf2", "imex"])
def test_a_fixed_operator_over_n_steps(method, rng):
    """One set-up, one forward and one backward solve per stage; the same bits for every memory budget."""
    step = dp.stepper(method, dp.laplacian(dp.Grid((9, 8)), dp.dirichlet), 0.7)
    u = rng.random((9, 8))
    n = 6
    stages = 2 if method in ("tr_bdf2", "imex") else 1

    def loss(memory=None):
        return lambda u, nu: anp.sum(dp.rollout(step, u, nu, n, memory=memory) ** 2)

    totals = dp.explain(lambda u: loss()(u, 0.4), u).totals
    counts = [totals[name] for name in ("set-ups built", "forward solves", "adjoint solves")]
    assert counts == [1, n * stages, n * stages]
    totals = dp.explain(lambda nu: loss()(u, nu), 0.4).totals
    assert totals["set-ups built"] == 0 and totals["forward solves"] == totals["adjoint solves"] == n * stages
    wanted = dp.value_and_grad(lambda x: loss()(*x))((u, 0.4))[1]
    for memory in (5 * u.nbytes + 100, 7 * u.nbytes):
        found = dp.value_and_grad(lambda x, m=memory: loss(m)(*x))((u, 0.4))[1]
        assert np.array_equal(found[0], wanted[0]) and found[1] == wanted[1]
