"""float32 states beside numbers of Python, and cotangents at the ends of the range, without a warning."""

import warnings

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.derivative import pushforward

U = np.array([0.5, -0.25, 0.75], np.float32)


def damped(s, p):
    return {"u": s["u"] * p["k"] + s["c"], "c": s["c"] * 0.5}


def rolled(a, memory=None):
    state = dp.rollout(damped, {"u": a[0], "c": a[1]}, {"k": a[2]}, 4, memory=memory)
    return anp.sum(state["u"] ** 2)


def looped(a):
    state = {"u": a[0], "c": a[1]}
    for _ in range(4):
        state = damped(state, {"k": a[2]})
    return anp.sum(state["u"] ** 2)


def test_a_float32_state_takes_numbers_of_python():
    given = U, 0.3, 1.25
    value, found = dp.value_and_grad(rolled)(given)
    wide, wanted = dp.value_and_grad(looped)((U.astype(float), 0.3, 1.25))
    assert abs(value - wide) < 1e-6 * wide
    assert found[0].dtype == np.float32 and isinstance(found[1], float) and isinstance(found[2], float)
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)
    again = dp.value_and_grad(lambda a: rolled(a, memory=600))(given)[1]
    assert all(np.array_equal(one, other) for one, other in zip(found, again, strict=True))
    assert dp.rollout(damped, {"u": U, "c": 0.3}, {"k": 1.25}, 4, keep="all")["u"].dtype == np.float32


def test_a_float32_state_has_tangents_beside_numbers_of_python():
    tangent = np.ones(3, np.float32), 0.25, 0.5
    slope = pushforward(rolled, (U, 0.3, 1.25), tangent)[1]
    wanted = pushforward(looped, (U.astype(float), 0.3, 1.25), (np.ones(3), 0.25, 0.5))[1]
    assert abs(slope - wanted) < 1e-6 * abs(wanted)


def test_a_float32_state_beside_arrays_alone_must_keep_its_dtype():
    with pytest.raises(dp.errors.ShapeError, match="made dtype float64 of dtype float32"):
        dp.rollout(lambda u, p: u * p, U, np.full(3, 2.0), 2)


@pytest.mark.parametrize("method", ["backward_euler", "crank_nicolson", "tr_bdf2"])
def test_cotangents_beyond_the_root_of_the_range_pass_in_silence(method):
    grid = dp.Grid((5, 4), size=1.0)
    step = dp.stepper(method, dp.laplacian(grid), 0.01)
    w = np.arange(1.0, 21.0).reshape(5, 4)

    def slopes(k):
        return dp.value_and_grad(lambda a: anp.sum(np.ldexp(w, k) * step(a[0], a[1])))((np.sqrt(w), 0.75))[1]

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        high = slopes(900)
        plain = slopes(0)
    assert np.array_equal(high[0], np.ldexp(plain[0], 900)) and high[1] == np.ldexp(plain[1], 900)


@pytest.mark.parametrize("method", ["euler", "heun", "ssprk3", "rk4"])
def test_an_explicit_step_of_an_operator_rounds_traced_numbers_like_plain_ones(method):
    """Under a budget the steps run plain first, and on a tape in the backward pass: to the same bits."""
    u = np.sin(np.arange(6.0)).astype(np.float32)
    step = dp.stepper(method, dp.laplacian(dp.Grid(6, size=1.0), dp.dirichlet), 0.01)
    loss = lambda c, **options: anp.sum(dp.rollout(step, u, c, 7, **options) ** 2)
    bits = {dp.value_and_grad(lambda c, m=memory: loss(c, memory=m))(0.3) for memory in (None, 200, 260, "1 MB")}
    assert len(bits) == 1


def test_reverse_over_reverse_of_a_rollout_with_float32_beside_float64():
    """The pullback has a result for each of two arguments, and their cotangents come together."""
    loss = lambda x: anp.sum(dp.rollout(lambda u, p: u * p, x[0], x[1], 2) ** 2)  # p^4 |u|^2
    back = dp.grad(lambda x: dp.grad(loss)(x)[1])((U, 0.5))
    assert back[0].dtype == np.float32 and back[0] == pytest.approx(8 * 0.5**3 * U)
    assert back[1] == pytest.approx(12 * 0.5**2 * 0.875)
