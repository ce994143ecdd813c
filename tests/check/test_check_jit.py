"""check.jit: programs that agree, and what it says of those that do not."""

import autograd.numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils.counters import recording

U = np.sin(np.arange(8.0))
LAPLACIAN = dp.laplacian(dp.Grid(8, periodic=True))


def loss(u, v):
    return np.sum(np.where(u > 0.0, u**2 * v, LAPLACIAN(u))) + v[0]


def step(state, dt):
    return {"u": state["u"] + dt * LAPLACIAN(state["u"]), "n": state["n"] + 1, "name": "heat"}


@pytest.mark.parametrize("transform", [lambda f: f, dp.jit], ids=["plain", "jitted"])
def test_pure_functions_agree(transform):
    result = dp.check.jit(transform(loss), U, U + 2.0)
    assert result and result.verdict == "agrees" and result.reason == ""
    assert len(result.rows) == 9 and 0.0 <= result.gap <= 10.0
    assert dp.check.jit(transform(step), {"u": U, "n": 3}, 0.1).verdict == "agrees"
    assert dp.check.jit(lambda u, p: p["a"] * u, U * 1j, {"a": 2.0, "zero": np.zeros(3)}).verdict == "agrees"


def test_the_leaf_with_the_largest_gap_is_named():
    rng = np.random.default_rng(0)
    result = dp.check.jit(lambda u: {"size": np.sum(u), "scaled": u * rng.random()}, U)
    assert (result.verdict, result.leaf) == ("disagrees", "result['scaled']")
    assert result.gap > 1e14


def test_constants_that_have_changed_since_the_recording():
    constant = np.ones(8)
    jitted = dp.jit(lambda u: np.sum(constant * u**2))
    dp.value_and_grad(jitted)(U)
    assert dp.check.jit(jitted, U)
    constant[2] = 3.0
    for _ in range(2):
        result = dp.check.jit(jitted, U)
        assert not result and result.verdict == "disagrees"
        assert result.leaf == "gradient in args[0]"
        figures = f"gradient in args[0] differs by {result.gap:.2g} eps, at most 10000 is accepted"
        assert result.reason == f"{figures}; first in the result at the given arguments"
        assert result.gap > 1e15
        assert "FAILS" in str(result) and result.reason in str(result)
        assert result.to_dict()["leaf"] == result.leaf


def test_a_refusal_is_the_reason():
    result = dp.check.jit(lambda u: u if np.sum(u) > 0 else -u, U)
    assert result.verdict == "disagrees" and result.leaf == "" and result.gap == 0.0
    with pytest.raises(dp.errors.JitError) as caught:
        dp.jit(lambda u: u if np.sum(u) > 0 else -u)(U)
    assert result.reason == str(caught.value)


def test_what_cannot_be_compared_is_inconclusive():
    def only_at(u):
        if not np.array_equal(u, U):
            raise ValueError("another u")
        return u * 2.0

    result = dp.check.jit(dp.differentiable("only_at", only_at, lambda nums, ans, u: lambda g: (2.0 * g,)), U)
    assert result.verdict == "inconclusive"
    assert result.reason == "the function raised an exception at all perturbed arguments"
    assert "not compared, the function raised ValueError: another u" in str(result)
    with recording():
        assert dp.check.jit(loss, U, U).reason == (
            "no program was recorded: a field is distributed, or calls are counted or observed"
        )


def test_arguments_are_not_modified_and_errors_are_those_of_the_function():
    x = U.copy()
    dp.check.jit(loss, x, x)
    assert np.array_equal(x, U)
    with pytest.raises(TypeError, match="check.jit takes a function, got float"):
        dp.check.jit(3.0, U)
    with pytest.raises(ZeroDivisionError):
        dp.check.jit(lambda u: 1 / 0, U)
