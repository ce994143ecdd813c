"""dp.jit(..., compile=True): machine code gives the numbers of the function, and says what it does not translate."""

import pickle
import sys

import autograd.numpy as anp
import numpy as np
import pytest
from helpers.entrywise_programs import random_function

import sparsedp as dp

llvmlite = pytest.importorskip("llvmlite")

X = np.sin(np.arange(12.0))
Y = np.cos(np.arange(12.0))


def agree(found, expected, tolerance=1e-13):
    found, expected = np.asarray(found), np.asarray(expected)
    assert found.shape == expected.shape and found.dtype == expected.dtype
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * max(1.0, np.max(np.abs(expected), initial=0)))


def compare(loss, jitted, x):
    """Compare values and gradients."""
    value, gradient = dp.value_and_grad(loss)(x)
    found, slope = dp.value_and_grad(jitted)(x)
    agree(found, value)
    agree(jitted(x), loss(x))
    agree(slope, gradient)


def mixed(u):
    """Every kind of call that is translated; arrays of 3 to 24 entries."""
    pair = anp.reshape(u, (2, 6))
    v = anp.concatenate([u[3:], anp.roll(u, 2)[:3]]) * u[::-1]
    w = anp.where(u > 0.2, anp.exp(-u) / (1.0 + u**2), anp.maximum(v, -0.3)) + anp.mean(pair, axis=0)[1]
    few = anp.array([w[0] * w[3], anp.tanh(v[2]), anp.sum(w)])
    rows = anp.dot(pair, anp.transpose(pair)) @ pair + anp.sum(pair, axis=1)[:, None]
    both = anp.stack([u, w]) * few[1]
    return anp.sum(few**2) + anp.sum(rows**3) + anp.sum(both * u) + anp.abs(u[2]) ** 1.5


def test_value_and_gradient():
    jitted = dp.jit(mixed, compile=True)
    for x in (X, Y):
        compare(mixed, jitted, x)
    assert jitted.not_compiled == () and jitted.forms == 1


@pytest.mark.whole
def test_other_derivatives_and_copies():
    jitted = dp.jit(mixed, compile=True)
    jitted(X)
    agree(dp.hvp(jitted, X, Y), dp.hvp(mixed, X, Y), 1e-11)
    agree(dp.jvp(jitted, X, Y)[1], dp.jvp(mixed, X, Y)[1])
    assert dp.check.jit(jitted, X).verdict == "agrees"
    agree(pickle.loads(pickle.dumps(dp.jit(np.sin, compile=True)))(X), np.sin(X))


def test_memory_is_used_again_after_the_last_use():
    """Regions that a later value overwrites while an open loop still reads them would change these numbers."""

    def loss(u):
        v = u * 2.0
        kept = v + 1.0
        total = 0.0
        for k in range(5):
            w = anp.roll(v, k + 1) * kept
            total = total + anp.sum(anp.roll(w, 1) * v)
            v = w - u[k] * anp.concatenate([v[k:], v[:k]])
        return total + anp.sum(kept * v)

    jitted = dp.jit(loss, compile=True)
    for x in (X, Y):
        compare(loss, jitted, x)
    assert not jitted.not_compiled


@pytest.mark.parametrize("seed", range(1))
def test_random_functions(seed):
    rng = np.random.default_rng(seed)
    function = random_function(rng, 9, 2)
    loss = lambda trees: anp.sum(function(*trees) * Y[:9])
    jitted = dp.jit(loss, compile=True)
    for trees in ((X[:9], X[:2]), (Y[:9], Y[:2])):
        value, gradients = dp.value_and_grad(loss)(trees)
        found, slopes = dp.value_and_grad(jitted)(trees)
        agree(found, value)
        for slope, gradient in zip(slopes, gradients, strict=True):
            agree(slope, gradient, 1e-12)


@pytest.mark.whole
@pytest.mark.parametrize("seed", range(1, 60))
def test_more_random_functions(seed):
    test_random_functions(seed)


def test_products_without_terms():
    """An operator without entries, and matrices without columns."""
    empty = dp.from_matrix(np.zeros((12, 12)))

    def loss(u):
        return anp.sum((empty(u) + u) ** 2) + anp.sum(anp.cos(np.zeros((12, 0)) @ u[:0]) * u)

    jitted = dp.jit(loss, compile=True)
    for x in (X, Y):
        compare(loss, jitted, x)
    assert not jitted.not_compiled


@pytest.mark.whole
def test_single_precision_and_booleans():
    def function(u):
        mask = (u > 0.1) & ~(u > 0.9)
        return {"u": anp.where(mask, u * 0.1, anp.exp(u)), "mask": mask, "few": u[:3] + 1.0}

    jitted = dp.jit(function, compile=True)
    for x in (X.astype(np.float32), Y.astype(np.float32)):
        expected = function(x)
        found = jitted(x)
        for name in expected:
            assert found[name].dtype == expected[name].dtype
            np.testing.assert_allclose(found[name], expected[name], rtol=3e-7)
    assert not jitted.not_compiled


@pytest.mark.whole
def test_entries_chosen_twice():
    few = np.array([1, 1, 2])

    def loss(u):
        return anp.sum(u[few] * u[4]) ** 2 + anp.sum(u[np.arange(24) % 12] * u[::-1][np.arange(24) // 2]) + u[3]

    for dtype in (float, np.float32):
        jitted = dp.jit(loss, compile=True)
        for x in (X.astype(dtype), Y.astype(dtype)):
            value, gradient = dp.value_and_grad(loss)(x)
            found, slope = dp.value_and_grad(jitted)(x)
            np.testing.assert_allclose(found, value, rtol=1e-6 if dtype is np.float32 else 1e-14)
            np.testing.assert_allclose(slope, gradient, rtol=0, atol=1e-5 if dtype is np.float32 else 1e-13)
            assert slope.dtype == dtype
        assert not jitted.not_compiled


@pytest.mark.whole
def test_results_share_no_memory_and_have_their_types():
    jitted = dp.jit(lambda u: (u, u[:3], 2.0 * u[0], anp.sum(u)), compile=True)
    whole, part, number, total = jitted(X)
    whole[:] = 7.0
    assert part[0] == X[0] and type(number) is type(total) is np.float64
    again = jitted(Y)
    np.testing.assert_array_equal(again[0], Y)
    assert np.all(whole == 7.0)


@pytest.mark.whole
def test_what_stays_python_is_named():
    grid = dp.Grid(12, periodic=True)
    move = dp.transport(grid, "upwind", velocity="cells")
    for loss, word in (
        (lambda u: anp.sum(move(u, u, 0.1) ** 2), "upwind"),
        (lambda u: anp.sum(anp.sort(u) * Y), "sort"),
        (lambda u: anp.real(anp.sum(1j * u * u * 1j)), "complex"),
    ):
        jitted = dp.jit(loss, compile=True)
        for x in (X, Y):
            value, gradient = dp.value_and_grad(loss)(x)
            found, slope = dp.value_and_grad(jitted)(x)
            assert found == value
            agree(slope, gradient)
        assert any(word in reason for reason in jitted.not_compiled)
        assert "not compiled because of" in repr(jitted)
    assert dp.jit(mixed).not_compiled == ()


def test_values_that_are_not_finite_are_those_of_numpy():
    jitted = dp.jit(lambda u: anp.sum(anp.log(u)) + anp.sqrt(u[0]), compile=True, check=False)
    jitted(np.ones(12))
    with pytest.warns(RuntimeWarning, match="invalid value"):
        jitted(-np.ones(12))
    with np.errstate(all="ignore"):
        assert np.isnan(jitted(-np.ones(12)))
        assert jitted(np.r_[0.0, np.ones(11)]) == -np.inf
    extremes = dp.jit(lambda u: anp.where(u > 0, anp.minimum(u, 1.0), anp.sign(u)), compile=True, check=False)
    for x in (X, np.array([np.nan, np.inf, -np.inf, 0.0, -0.0, 5e-324, 1e308, 1.0, -1.0, 2.0, -2.0, 3.0])):
        np.testing.assert_array_equal(extremes(x), np.where(x > 0, np.minimum(x, 1.0), np.sign(x)))


def test_stale_constants_are_detected():
    factor = {"value": 2.0}
    scaled = dp.jit(lambda u: factor["value"] * u, compile=True)
    scaled(X)
    factor["value"] = 3.0
    with pytest.raises(dp.errors.JitError, match="the program of <lambda> differs from the function in result 0"):
        scaled(Y)


def test_a_wrong_translation_is_not_used(monkeypatch):
    from sparsedp.autodiff import compiled_program

    wrong = lambda builder, x: builder.fadd(x, x)
    monkeypatch.setitem(compiled_program.FLOATING, np.sin, wrong)
    jitted = dp.jit(lambda u: anp.sum(anp.sin(u)), compile=True)
    for x in (X, Y):
        assert jitted(x) == np.sum(np.sin(x))
    assert any("differed from those of the recorded program" in reason for reason in jitted.not_compiled)
    step = dp.jit(lambda u, p: anp.sin(u) * p, compile=True)
    assert dp.rollout(step, X, 1.1, 3)[1] == pytest.approx(np.sin(np.sin(np.sin(X[1]) * 1.1) * 1.1) * 1.1, rel=1e-14)
    assert step.not_compiled


def test_without_llvmlite(monkeypatch):
    monkeypatch.delitem(sys.modules, "sparsedp.autodiff.compiled_program", raising=False)
    monkeypatch.setitem(sys.modules, "llvmlite", None)
    with pytest.raises(
        ImportError,
        match=r"^dp.jit with compile=True needs llvmlite; install it with: pip install 'sparsedp\[fast\]'$",
    ):
        dp.jit(mixed, compile=True)
