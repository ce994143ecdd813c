"""dp.jit: programs give the bits of their functions, and refuse what they cannot record."""

import pickle
from threading import Thread

import autograd
import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.jit import opaque
from sparsedp.autodiff.program_trace import check_values
from sparsedp.autodiff.tape import plain

RING = dp.Grid(16, periodic=True)
LAPLACIAN = dp.laplacian(RING)
TRANSPORT = dp.transport(RING, "upwind", velocity="cells")
X = np.sin(np.arange(16.0))
Y = np.cos(np.arange(16.0))


def arithmetic(u):
    """Sums, products and entries; some of them are read twice."""
    first = u[0] * u[1] - u[3] / (2.0 + u[0] ** 2)
    v = -u[2:10] * 3.0 + u[6:14] ** 2
    return first + anp.sum(v * v) + v[0]


def functions(u):
    """Functions of autograd.numpy."""
    v = anp.where(u > 0.1, anp.sin(u), anp.exp(u) - anp.floor(u))
    pair = anp.array([v[0], anp.sum(v)])
    return anp.mean(anp.abs(v)) + anp.dot(pair, pair) + anp.max(u) + anp.linalg.norm(anp.concatenate([u, v]))


def physics(u):
    """Operators, transport and a power of an array."""
    for _ in range(3):
        u = u + 0.01 * LAPLACIAN(u)
        u = TRANSPORT(u, u, 0.02)
    return anp.sum(u**3) + anp.sum(LAPLACIAN.T(u) * u)


def of_indices(u):
    """Entries chosen by a traced index, and by arrays with an entry twice."""
    last = anp.argmax(u)
    return u[last] ** 2 + anp.sum(u[np.array([1, 1, 2])] ** 2) + anp.sum(anp.sort(u)[:3])


def rolls(u):
    """Shifts of arrays with one axis, which are two slices, and others."""
    total = 0.0
    for shift in (-17, -1, 0, 3, 16, 33):
        total = total + anp.sum(u * anp.roll(u, shift)) * anp.sum(anp.roll(u, shift, 0) * Y)
    pair = anp.reshape(u, (2, 8))
    return total + anp.sum(anp.roll(pair, 3) * anp.roll(pair, 1, axis=0) * anp.roll(pair, 5, 1))


LOSSES = [arithmetic, functions, physics, of_indices, rolls]


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: loss.__name__)
def test_value_and_gradient_at_other_numbers(loss):
    jitted = dp.jit(loss)
    for x in (X, Y, X + Y, 3.0 * X):
        value, gradient = dp.value_and_grad(loss)(x)
        found, slope = dp.value_and_grad(jitted)(x)
        assert jitted(x) == loss(x) == value == found
        np.testing.assert_allclose(slope, gradient, rtol=1e-15, atol=1e-15 * np.max(np.abs(gradient)))
        np.testing.assert_array_equal(dp.vjp(jitted, x)[1](1.0), slope)
    assert jitted.forms == 1


@pytest.mark.parametrize("loss", [arithmetic, functions, physics], ids=lambda loss: loss.__name__)
def test_second_order_and_forward_mode(loss):
    jitted = dp.jit(loss)
    for x in (X, Y):
        expected = dp.hvp(loss, x, Y)
        np.testing.assert_allclose(dp.hvp(jitted, x, Y), expected, rtol=1e-13, atol=1e-13 * np.max(np.abs(expected)))
        np.testing.assert_allclose(dp.jvp(jitted, x, Y)[1], dp.jvp(loss, x, Y)[1], rtol=1e-14)
        nested = dp.grad(lambda x: anp.sum(dp.grad(jitted)(x) ** 2))(x)
        expected = dp.grad(lambda x: anp.sum(dp.grad(loss)(x) ** 2))(x)
        np.testing.assert_allclose(nested, expected, rtol=1e-12, atol=1e-12 * np.max(np.abs(expected)))


def test_on_the_tape_of_autograd():
    jitted = dp.jit(physics)
    np.testing.assert_allclose(autograd.grad(lambda x: 2.0 * jitted(x))(X), 2.0 * dp.grad(physics)(X), rtol=1e-14)


def test_trees_options_and_other_leaves():
    def function(state, n, *, scale):
        u, more = state["u"], state["more"]
        return {"u": n * scale * u + more[0], "sum": anp.sum(u) + more[1], "name": "x", "n": n, "order": anp.argsort(u)}

    jitted = dp.jit(function)
    for x in (X, Y):
        state = {"u": x, "more": (2.0, 1.0)}
        for n in (2, 3):
            expected = function(state, n, scale=0.5)
            found = jitted(state, n, scale=0.5)
            assert list(found) == list(expected) and found["name"] == "x" and found["n"] == n
            for name in ("u", "sum", "order"):
                np.testing.assert_array_equal(found[name], expected[name])

            def loss(function, state, n=n):
                result = function(state, n, scale=0.5)
                return anp.sum(result["u"] ** 2) * result["sum"] * result["n"]

            both = [dp.grad(lambda state, function=f: loss(function, state))(state) for f in (function, jitted)]
            assert both[0]["more"] == pytest.approx(both[1]["more"], rel=1e-14)
            np.testing.assert_allclose(both[0]["u"], both[1]["u"], rtol=1e-14)
    assert jitted.forms == 2


@pytest.mark.parametrize("dtype", [np.float32, complex])
def test_other_dtypes(dtype):
    def loss(u):
        return anp.sum(anp.abs(LAPLACIAN(u) + 0.5 * u * u) ** 2)

    jitted = dp.jit(loss)
    for x in (X, Y):
        x = (x * (1 + 0.3j) if dtype is complex else x).astype(dtype)
        value, gradient = dp.value_and_grad(loss)(x)
        found, slope = dp.value_and_grad(jitted)(x)
        assert found == value and slope.dtype == gradient.dtype == dtype
        np.testing.assert_allclose(slope, gradient, rtol=1e-5 if dtype is np.float32 else 1e-13)


@pytest.mark.parametrize(
    "view", [lambda u: u[::-1], lambda u: u[::2], lambda u: np.broadcast_to(u[:1], (50, 40)), np.asfortranarray]
)
def test_layouts(view):
    def loss(u):
        v = anp.reshape(u * u, (-1,))
        return anp.sum(anp.sin(v)) + anp.sum(LAPLACIAN(v[:16]) ** 2)

    jitted = dp.jit(loss, check=False)
    for seed in range(3):
        x = view(np.random.default_rng(seed).random((50, 40)))
        value, gradient = dp.value_and_grad(loss)(x)
        found, slope = dp.value_and_grad(jitted)(x)
        assert found == value
        np.testing.assert_allclose(slope, gradient, rtol=1e-13)


def test_results_share_no_memory():
    def function(u):
        v = 3.0 * u
        return u, u, u[:2], v, v, anp.real(v), anp.real(u), 1.0 * u, X

    jitted = dp.jit(function)
    for x in (X.copy(), Y.copy()):
        results = jitted(x)
        for k, result in enumerate(results):
            for other in (x, X, *results[k + 1 :]):
                assert not np.shares_memory(result, other)
        results[-1][:] = 7.0
    np.testing.assert_array_equal(jitted(Y.copy())[-1], X)


def test_large_arrays_are_overwritten_only_when_nobody_needs_them():
    def function(u):
        v = 2.0 * u
        row = v.reshape(-1)[:5]  # a view of v
        w = v + 1.0
        w = w * w
        return w - u, row

    jitted = dp.jit(function)
    for seed in range(3):
        x = np.random.default_rng(seed).random((100, 100))
        for found, expected in zip(jitted(x), function(x), strict=True):
            np.testing.assert_array_equal(found, expected)
        gradients = [dp.grad(lambda x, f=f: anp.sum(f(x)[0] ** 2) + anp.sum(f(x)[1]))(x) for f in (function, jitted)]
        np.testing.assert_allclose(gradients[0], gradients[1], rtol=1e-14)


def test_constants_are_copied():
    constant = X.copy()
    jitted = dp.jit(lambda u: anp.sum(constant * u), check=False)
    assert jitted(Y) == X @ Y
    constant[:] = 0.0
    assert jitted(Y + 0.0) == X @ Y


# ---- calls that decide by values -------------------------------------------------------------------------------------


@opaque
def iterated(u, p):
    """Newton's method for x**2 = p, with a number of steps that depends on values."""
    x = u
    while np.max(np.abs(plain(x) ** 2 / plain(p) - 1.0)) > 1e-12:
        x = 0.5 * (x + p / x)
    return {"x": x, "n": 3}


def test_opaque_calls_run_again():
    def loss(p):
        result = iterated(1.0 + 0.0 * p, p)
        return anp.sum(result["x"] ** 3) * result["n"]

    jitted = dp.jit(loss)
    for p in (np.array([2.0, 3.0]), np.array([200.0, 1e-3]), np.array([1.0, 1.0])):
        value, gradient = dp.value_and_grad(loss)(p)
        assert jitted(p) == value
        np.testing.assert_allclose(dp.value_and_grad(jitted)(p)[1], gradient, rtol=1e-15)
    np.testing.assert_allclose(dp.hvp(jitted, p, p), dp.hvp(loss, p, p), rtol=1e-12)


def positive(u):
    if not np.all(u > 0):
        raise dp.errors.NonFiniteError("not positive")


def test_checks_are_calls_of_the_program():
    def function(u):
        check_values(positive, u)
        return 2.0 * u

    jitted = dp.jit(function, check=False)  # otherwise the comparison calls the function, which raises too
    jitted(X**2 + 1.0)
    for f in (jitted, dp.grad(lambda u: anp.sum(jitted(u)))):
        with pytest.raises(dp.errors.NonFiniteError, match="not positive"):
            f(-1.0 - X**2)


def test_threads_and_pickles():
    jitted = dp.jit(physics)
    expected = {seed: dp.value_and_grad(physics)(X * seed) for seed in range(1, 5)}
    found = {}

    def run(seed):
        for _ in range(5):
            found[seed] = dp.value_and_grad(jitted)(X * seed)

    threads = [Thread(target=run, args=(seed,)) for seed in expected]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for seed, (value, gradient) in expected.items():
        assert found[seed][0] == value
        np.testing.assert_allclose(found[seed][1], gradient, rtol=1e-14)
    again = pickle.loads(pickle.dumps(jitted))
    assert again.forms == 0 and again(X) == physics(X)
    assert repr(again) == "<jit of physics: 1 forms recorded>"


PLACES = np.array([1, 2])
OTHER_PLACES = np.array([0, 1])


def constant_and_traced_parts(u):
    """The cotangent of an array is the sum of a constant part and of a traced one."""
    return anp.sum(u[PLACES] ** 2) + anp.sum(u[OTHER_PLACES]) + u[3] * u[4] * np.float64(1.0) + u[3]


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_constant_sums_of_cotangents_are_not_written_into(dtype):
    jitted = dp.jit(constant_and_traced_parts, check=False)
    step = dp.jit(lambda u, p: u - 0.1 * p * dp.grad(constant_and_traced_parts)(u), check=False)
    for factor in (1.0, 10.0, 1.0, 0.0):
        x = (factor * np.arange(1.0, 7.0)).astype(dtype)
        np.testing.assert_array_equal(dp.value_and_grad(jitted)(x)[1], dp.grad(constant_and_traced_parts)(x))
        np.testing.assert_array_equal(dp.jit(dp.grad(jitted))(x), dp.grad(constant_and_traced_parts)(x))
        if dtype is np.float64:
            slopes = [dp.grad(lambda x, f=f: anp.sum(dp.rollout(f, x, 1.0, 3) ** 2))(x) for f in (step, step.function)]
            np.testing.assert_allclose(*slopes, rtol=1e-14)


def test_functions_without_jvp():
    """Their tangent comes from two reverse passes, in which the cotangent is traced."""

    def solved(x):
        return anp.linalg.solve(anp.sum(x) * np.eye(16) + anp.outer(x, x), x)

    jitted = dp.jit(solved)
    for x in (X, Y):
        dp.vjp(jitted, x)[1](x)
        np.testing.assert_allclose(dp.jvp(jitted, x, Y)[1], dp.jvp(solved, x, Y)[1], rtol=1e-13)
    step = dp.jit(lambda u, p: p * solved(u))
    found = dp.jvp(lambda u: dp.rollout(step, u, 1.5, 3), X, Y)[1]
    np.testing.assert_allclose(found, dp.jvp(lambda u: dp.rollout(step.function, u, 1.5, 3), X, Y)[1], rtol=1e-12)


def test_forward_mode_runs_a_program():
    calls = []

    def step(state, params):
        calls.append(None)
        u, count = state
        return u + params["dt"] * (LAPLACIAN(u) - u**3), count

    jitted = dp.jit(step)
    push = lambda function, x: dp.jvp(lambda u: function((u, 3), {"dt": 0.01 * u[0]})[0], x, Y)
    push(jitted, X)  # records
    push(jitted, 2 * X)  # compares
    recorded = len(calls)
    value, tangent = push(jitted, 4 * X)
    assert len(calls) == recorded
    expected = push(step, 4 * X)
    assert np.array_equal(value, expected[0])
    np.testing.assert_allclose(tangent, expected[1], rtol=1e-13)
    nested = dp.grad(lambda x: anp.sum(push(jitted, x)[1] ** 2))(X)  # reverse mode around forward mode
    np.testing.assert_allclose(nested, dp.grad(lambda x: anp.sum(push(step, x)[1] ** 2))(X), rtol=1e-12)
