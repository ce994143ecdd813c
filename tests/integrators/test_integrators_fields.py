"""Steps of several fields: `linear` as a tree, functions of an operator, batches; against dense matrices and twins."""

import pickle
from math import factorial

import autograd.numpy as anp
import numpy as np
import pytest
import scipy.linalg
from step_methods import METHODS

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp._utils.pytree import leaves
from sparsedp.autodiff.derivative import pushforward, value_and_grad

GRID = dp.Grid((4, 3), size=1.0)
L = dp.laplacian(GRID)
M = dp.laplacian(GRID, dp.dirichlet)
U, V, W = np.random.default_rng(3).standard_normal((3, 4, 3))
STATE = {"u": U, "v": V, "w": W}
PARAMS = {"D": 0.3, "F": 0.7, "dt": 0.02}
LINEAR = {"w": None, "v": (-1e-3 * M @ M, lambda p: 0.5 * p["D"]), "u": (L, lambda p: p["D"])}  # in another order


def react(x, p):
    """Three species; the third does not spread. The entries are not in the order of the state."""
    u = x["u"]
    v = x["v"]
    w = x["w"]
    return {"w": u - w, "u": p["F"] * (1 - u) - u * v**2, "v": u * v**2 - p["F"] * v}


# ---- a twin by autograd: one flat array, one dense matrix ------------------------------------------------------------


def dense(op):
    return np.array([op @ unit for unit in np.eye(12)]).T


DENSE_U = dense(L)
DENSE_V = dense(-1e-3 * M @ M)


def matrix(p):
    zero = np.zeros((12, 12))
    rows = [[p["D"] * DENSE_U, zero, zero], [zero, 0.5 * p["D"] * DENSE_V, zero], [zero, zero, zero]]
    return anp.concatenate([anp.concatenate(row, axis=1) for row in rows])


def flat(x):
    return anp.concatenate([anp.ravel(x[name]) for name in "uvw"])


def flat_rate(x, p):
    return flat(react({"u": x[:12], "v": x[12:24], "w": x[24:]}, p))


def imex(x, p):
    d = 1 - np.sqrt(0.5)
    h = p["dt"]
    A = matrix(p)
    e = 1 - 1 / (2 * d)
    solve = lambda b: anp.linalg.solve(np.eye(36) - d * h * A, b)
    n0 = flat_rate(x, p)
    y = solve(x + h * d * n0)
    return solve(x + h * (e * n0 + (1 - e) * flat_rate(y, p)) + (1 - d) * h * anp.dot(A, y))


def phi(k, Z):
    total = np.eye(36) / factorial(k)
    term = np.eye(36)
    for n in range(1, 40):
        term = anp.dot(term, Z)
        total = total + term / factorial(n + k)
    return total


def etdrk4(x, p):
    """Cox and Matthews, in phi functions, which are sums of powers."""
    h = p["dt"]
    A = matrix(p)
    Z = h * A
    n = lambda x: h * flat_rate(x, p)
    half = phi(0, 0.5 * Z)
    q = 0.5 * phi(1, 0.5 * Z)
    n0 = n(x)
    a = half @ x + q @ n(x)
    b = half @ x + q @ n(a)
    c = half @ a + q @ (2 * n(b) - n0)
    one, two, three = (phi(k, Z) for k in (1, 2, 3))
    ends = (one - 3 * two + 4 * three) @ n0 + (4 * three - two) @ n(c)
    return phi(0, Z) @ x + ends + (2 * two - 4 * three) @ (n(a) + n(b))


@pytest.mark.parametrize(("method", "twin"), [("imex", imex), ("etdrk4", etdrk4)])
def test_twin(method, twin):
    """Value, gradient, tangent and second order of two steps in the states, coefficients, rate and dt."""
    step = dp.stepper(method, react, lambda p: p["dt"], linear=LINEAR, rtol=1e-13)
    weights = np.cos(np.arange(36.0))
    ours = lambda x: anp.sum(weights * flat(step(step(x[0], x[1]), x[1])) ** 2)
    by_hand = lambda x: anp.sum(weights * twin(twin(flat(x[0]), x[1]), x[1]) ** 2)
    x = (STATE, PARAMS)
    along = ({"u": V, "v": W, "w": U}, {"D": 0.2, "F": -0.4, "dt": 0.01})
    found, wanted = (value_and_grad(loss)(x) for loss in (ours, by_hand))
    assert found[0] == pytest.approx(wanted[0], rel=1e-11)
    check_alike(found[1], wanted[1], 1e-9)
    tangent = pushforward(ours, x, along)[1]
    assert tangent == pytest.approx(dot(wanted[1], along), rel=1e-9)
    second = pushforward(lambda x: value_and_grad(ours)(x)[1], x, along)[1]
    by_twin = value_and_grad(lambda x: dot(value_and_grad(by_hand)(x)[1], along))(x)[1]  # solve has no JVP
    check_alike(second, by_twin, 1e-7)


def dot(a, b):
    return sum(anp.sum(x * y) for x, y in zip(leaves(a), leaves(b), strict=True))


def check_alike(found, wanted, tolerance):
    for part, other in zip(found, wanted, strict=True):
        for name in other:
            scale = np.max(np.abs(other[name]))
            np.testing.assert_allclose(part[name], other[name], rtol=0, atol=tolerance * scale, err_msg=name)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_takes_a_tree(method):
    """A short time against small steps of rk4 with the operators inside the rate."""
    inside = lambda x, p: {
        "v": react(x, p)["v"] - 5e-4 * p["D"] * M(M(x["v"])),
        "u": react(x, p)["u"] + p["D"] * L(x["u"]),
        "w": react(x, p)["w"],
    }
    fine = dp.rollout(dp.stepper("rk4", inside, 2e-4), STATE, PARAMS, 40)
    end = dp.rollout(dp.stepper(method, react, 0.002, linear=LINEAR), STATE, PARAMS, 4)
    order = {"euler": 3e-2, "backward_euler": 3e-2}.get(method, 1e-4)
    assert [*end] == ["u", "v", "w"]
    for name in end:
        np.testing.assert_allclose(end[name], fine[name], rtol=0, atol=order)


@pytest.mark.parametrize("method", ["heun", "radau", "backward_euler", "imex"])
def test_rates_go_to_the_fields_of_their_names(method):
    """A rate whose entries are in another order went to the wrong fields."""
    turned = lambda x, p: dict(reversed(react(x, p).items()))
    linear = {"linear": LINEAR} if method == "imex" else {}
    one, other = (dp.stepper(method, rate, 0.01, **linear)(STATE, PARAMS) for rate in (react, turned))
    plain = dp.stepper(method, lambda x, p: {name: react(x, p)[name] for name in x}, 0.01, **linear)(STATE, PARAMS)
    for name in STATE:
        assert np.array_equal(one[name], plain[name]) and np.array_equal(other[name], plain[name])


@pytest.mark.parametrize("method", ["backward_euler", "crank_nicolson", "tr_bdf2", "rk4", "imex", "etdrk4"])
def test_linear_problems_of_a_tree(method):
    """Without a rate: each field as if it were alone, bit by bit; with sources, what is not stiff grows by them."""
    tree = dp.stepper(method, None, 1e-3, linear=[(L, lambda p: p), (None, (M, 0.2))])
    u, (w, v) = tree([U, (W, V)], 0.3)
    assert np.array_equal(u, dp.stepper(method, L, 1e-3)(U, 0.3))
    assert np.array_equal(v, dp.stepper(method, M, 1e-3)(V, 0.2)) and np.array_equal(w, W)
    source = lambda p: {"v": p * np.ones((4, 3)), "u": p * V}
    forced = dp.stepper(method, None, 0.5, linear={"u": (M, 1e-3), "v": 0}, source=source)({"u": U, "v": W}, 2.0)
    np.testing.assert_allclose(forced["v"], W + 1.0, rtol=1e-14)
    alone = dp.stepper(method, None, 0.5, linear=(M, 1e-3), source=lambda p: p * V)(U, 2.0)
    np.testing.assert_allclose(forced["u"], alone, rtol=1e-14)


@pytest.mark.parametrize(("coefficients", "count"), [((0.3, 0.3), 1), ((0.3, 0.2), 2)])
def test_set_ups_are_shared(coefficients, count):
    step = dp.stepper("imex", lambda x, p: x, 0.1, linear=tuple((L, c) for c in coefficients))
    with recording() as calls:
        loss = lambda x: sum(anp.sum(leaf**2) for leaf in dp.rollout(step, x, None, 3))
        value_and_grad(loss)((U, V))
    name = "stepper(imex)"
    assert (calls[name, "setup"], calls[name, "solve"], calls[name, "adjoint"]) == (count, 12, 12)


# ---- functions of an operator --------------------------------------------------------------------------------------

F = dp.matrix_function(L, lambda e: 0.3 - (1 + e) ** 2)
OPERATORS = [
    L @ L * -1.0,
    -2.0 * L - L @ L,
    F,
    F - dp.matrix_power(L, 2),
    -1.0 * dp.matrix_power(-L, 1.5),
    dp.diagonal(GRID.cells, -(U**2)),
    dp.diagonal(GRID.cells, U) - 2 * dp.diagonal(GRID.cells, V**2),
]


@pytest.mark.whole
@pytest.mark.parametrize("op", OPERATORS, ids=[op.name for op in OPERATORS])
def test_functions_of_an_operator(op):
    A = dense(op)
    h = 0.05
    nu = 0.6
    assert dp.stepper("etdrk4", op, h)(U, nu).ravel() == pytest.approx(
        scipy.linalg.expm(h * nu * A) @ U.ravel(), rel=1e-9
    )
    found = dp.stepper("backward_euler", op, h)(U, nu)
    assert found.ravel() == pytest.approx(np.linalg.solve(np.eye(12) - h * nu * A, U.ravel()), rel=1e-9)
    fine = dp.stepper("rk4", lambda u, p: p * u**2 + p * op(u), h / 20)
    exact = None
    if op.name.startswith("diagonal"):  # the others are too stiff for these figures
        exact = value_and_grad(lambda p: anp.sum((1 + V) * dp.rollout(fine, p * U, p, 40) ** 2))(nu)
    for method in ("imex", "etdrk4"):
        step = dp.stepper(method, lambda u, p: p * u**2, h, linear=(op, lambda p: p), rtol=1e-13)
        loss = lambda p, step=step: anp.sum((1 + V) * step(step(p * U, p), p) ** 2)
        if exact is not None:
            assert value_and_grad(loss)(nu) == pytest.approx(exact, rel=3e-2 if method == "imex" else 1e-4)
        assert dp.check.gradient(loss, nu, quick=True).verdict == "agrees"


@pytest.mark.parametrize(
    "op", [-1.0 * L @ L, dp.matrix_function(L, lambda e: -(e**2) - e)], ids=["product", "function"]
)
@pytest.mark.parametrize("method", ["imex", "etdrk4"])
def test_the_mean_stays_under_fourth_order_terms(op, method):
    grid = GRID
    step = dp.stepper(method, lambda u, p: L(u**3 - u), 1e-4, linear=(op, lambda p: p))
    for nu in (1.0, 1e8, 1e16):
        assert np.sum(step(U, nu)) == pytest.approx(np.sum(U), rel=1e-12)
        g = value_and_grad(lambda u, nu=nu: anp.sum(step(u, nu)))(U)[1]
        assert g == pytest.approx(np.ones(grid.shape), rel=1e-11)


# ---- batches -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [float, np.float32, complex])
@pytest.mark.parametrize("nu", [0.5, 0.0])
def test_batches_of_etdrk4(dtype, nu):
    """Leading axes are a batch: the bits of one field after the other, and one gradient in the coefficient."""
    step = dp.stepper("etdrk4", lambda u, p: p * u - u**3, 0.01, linear=(L, lambda p: p))
    batch = np.stack([[U, V], [W, U]]).astype(dtype) * (1 + 1j if dtype is complex else 1)
    wanted = np.array([[step(u, nu) for u in row] for row in batch])
    found = step(batch, nu)
    assert found.dtype == batch.dtype and np.array_equal(found, wanted)
    assert step(batch[:0], nu).shape == (0, 2, 4, 3)
    loss = lambda p, u: anp.sum(anp.abs(step(u, p)) ** 2)
    value, (of_p, of_u) = value_and_grad(lambda x: loss(*x))((nu, batch))
    each = [value_and_grad(lambda x: loss(*x))((nu, u))[1] for row in batch for u in row]
    assert of_p == pytest.approx(sum(p for p, _ in each), rel=1e-5 if dtype is np.float32 else 1e-12)
    np.testing.assert_allclose(of_u.reshape(4, 4, 3), [u for _, u in each], rtol=1e-6 if dtype is np.float32 else 1e-12)


def test_batches_of_trees():
    step = dp.stepper("etdrk4", react, 0.01, linear=LINEAR)
    end = step({name: np.stack([u, 2 * u]) for name, u in STATE.items()}, PARAMS)
    for name, u in step(STATE, PARAMS).items():
        assert np.array_equal(end[name][0], u)
    with pytest.raises(
        dp.errors.ShapeError, match=r"rate: expected shape \(2, 4, 3\), got \(4, 3\); return a tree like the state"
    ):
        dp.stepper("etdrk4", lambda u, p: U, 0.01, linear=L)(np.stack([U, V]))


# ---- extremes ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["imex", "etdrk4"])
def test_extremes_of_a_tree(method):
    """Coefficients of 0, powers of two, layouts, dtypes field by field, NaN by its place; nothing is written into."""
    free = dp.stepper(
        method, lambda x, p: {name: 0.0 * u for name, u in x.items()}, 0.1, linear={"u": L, "v": (M, 0.0)}
    )
    x = {"u": U, "v": V.astype(np.float32)}
    with recording() as calls:
        end = free(x)
    assert np.array_equal(end["v"], x["v"]) and end["v"].dtype == np.float32 and end["u"].dtype == float
    assert calls["stepper(imex)", "setup"] == (method == "imex")
    for exponent in (-900, 900):
        scaled = free({name: np.ldexp(u, exponent) for name, u in {"u": U, "v": V}.items()})
        assert np.array_equal(scaled["u"], np.ldexp(end["u"], exponent))
    for form in (np.asfortranarray(U), np.repeat(U, 2, axis=1)[:, ::2], U[::-1][::-1], np.broadcast_to(U, (4, 3))):
        form.flags.writeable = False
        assert np.array_equal(free({"v": V, "u": form})["u"], end["u"])
    with pytest.raises(dp.errors.NonFiniteError, match=r"state\['v'\] of stepper"):
        free({"u": U, "v": V * np.nan})
    with pytest.raises(dp.errors.ShapeError, match="takes a field on cells"):
        free({"u": U.T, "v": V})


def test_trees_travel():
    step = dp.stepper("imex", react, 0.01, linear={"u": (L, 0.1), "v": M, "w": None})
    copy = pickle.loads(pickle.dumps(step))
    for one, other in zip(step(STATE, PARAMS).values(), copy(STATE, PARAMS).values(), strict=True):
        assert np.array_equal(one, other)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (2, 2), (0, 3)])
@pytest.mark.parametrize("method", ["imex", "etdrk4"])
def test_thin_and_empty_grids(method, shape):
    lap = dp.laplacian(dp.Grid(shape))
    u = np.cos(np.arange(shape[0] * shape[1])).reshape(shape)
    for op in (-1.0 * lap @ lap, dp.matrix_function(lap, lambda e: -(e**2))):
        step = dp.stepper(method, lambda x, p: {"b": -p * x["b"], "a": p * x["b"]}, 0.1, linear={"a": op, "b": None})
        end = step({"a": u, "b": u}, 0.5)
        assert end["a"].shape == shape and np.sum(end["a"] + end["b"]) == pytest.approx(2 * np.sum(u), rel=1e-12)


@pytest.mark.parametrize("method", ["rk4", "crank_nicolson", "tr_bdf2", "imex", "etdrk4"])
def test_a_field_of_none_stays(method):
    step = lambda linear: dp.stepper(method, None, 0.01, linear=linear)
    found = step({"u": L, "v": L, "w": None})({"u": U, "v": None, "w": None})
    assert found["v"] is found["w"] is None and np.array_equal(found["u"], step(L)(U))


@pytest.mark.parametrize("method", ["euler", "rk4", "imex", "etdrk4"])
def test_a_field_without_a_term_is_returned_as_a_copy(method):
    state = {"u": U.copy(), "v": V.copy()}
    found = dp.stepper(method, None, 0.01, linear={"u": L, "v": None})(state)
    assert np.array_equal(found["v"], V) and not np.shares_memory(found["v"], state["v"])


def test_the_vjp_of_a_linear_step_has_its_own_name():
    step = dp.stepper("heun", dp.laplacian(dp.Grid(5)), 0.1)
    u = np.arange(5.0)
    with recording() as calls:
        dp.grad(lambda u: anp.sum(step(u) ** 2))(u)
    assert calls["stepper(heun)", "forward"] == calls["stepper(heun)", "vjp"] == 1
    assert calls["stepper(heun).T", "forward"] == 1
