"""Dataclasses as trees: parameters, states, unknowns and checkpoints, each against the same numbers in a dict."""

from dataclasses import dataclass, field
from typing import Any

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils.pytree import TreeStructure, flatten, keys, labels, leaves, paired
from sparsedp.autodiff.tape_constants import constant
from sparsedp.errors import DerivativeError, ShapeError


@dataclass
class Model:
    k: Any
    u: Any
    name: str = "model"


@dataclass(frozen=True)
class Reversed:
    name: str
    u: Any
    k: Any


@dataclass(frozen=True, kw_only=True)
class State:
    ink: Any
    time: Any


@dataclass
class Derived:
    k: float
    double: float = field(init=False, default=0.0)


def loss(x):
    return x.k**2 * anp.sum(x.u**2)


U = np.array([1.0, 2.0])


def test_leaves_paths_and_pairs():
    tree = {"m": Model(2.0, (U, 3.0))}
    entries, rebuild = flatten(tree)
    assert [entries[0], *entries[2:]] == [2.0, 3.0, "model"] and entries[1] is U
    assert labels(tree, "x") == ["x['m'].k", "x['m'].u[0]", "x['m'].u[1]", "x['m'].name"]
    assert rebuild([1.0, 2.0, 3.0, "n"]) == {"m": Model(1.0, (2.0, 3.0), "n")}
    assert paired(Reversed("a", 1.0, 2.0), Model(0, 0), "x") == [2.0, 1.0, "a"]
    with pytest.raises(ShapeError, match=r"^x: missing field 'name'; expected 'k', 'u', 'name'$"):
        paired(dataclass(type("Few", (), {"__annotations__": {"k": Any, "u": Any}}))(1, 2), Model(0, 0), "x")
    for other in ((1.0, 2.0, "a"), {"k": 1.0, "u": 2.0, "name": "a"}, 1.0):
        with pytest.raises(ShapeError, match="^x: expected a Model of k, u, name, got"):
            paired(other, Model(0, 0), "x")
    structure = TreeStructure(tree, "x")
    assert structure.names == structure.labels == labels(tree, "x")
    assert structure.variables(structure.build("abcd")) == list("abcd")


def test_what_cannot_be_rebuilt_is_a_leaf():
    assert leaves(Derived(1.0)) == [Derived(1.0)] and keys(Model) is None
    with pytest.raises(TypeError, match="is a Derived, which is not a tree"):
        dp.grad(lambda x: x.k)(Derived(1.0))


@pytest.mark.parametrize("order", ["reverse", "forward", "second"])
def test_derivatives(order):
    x = Model(3.0, U)
    if order == "reverse":
        value, gradient = dp.value_and_grad(loss)(x)
        assert value == 45.0 and type(gradient) is Model and gradient.k == 30.0 and gradient.name is None
        np.testing.assert_array_equal(gradient.u, 18 * U)
        with pytest.raises(DerivativeError, match="must return one array or number, got Model"):
            dp.grad(lambda x: x)(x)
    elif order == "forward":
        assert dp.jvp(loss, x, Reversed("", 0 * U, 1.0))[1] == 30.0
        _, pull = dp.vjp(lambda x, y: loss(x) * y, x, 2.0)
        assert pull(1.0)[0].k == 60.0
    else:
        product = dp.hvp(loss, x, Model(1.0, 0 * U))
        assert product.k == 10.0 and type(product) is Model
    assert dp.check.gradient(loss, x)


def test_a_vector_and_back():
    x = Model(3.0, U)
    vector, unflatten = dp.flatten(x)
    np.testing.assert_array_equal(vector, [3.0, 1.0, 2.0])
    again = unflatten(vector)
    assert type(again) is Model and again.k == 3.0 and again.name == "model"
    np.testing.assert_array_equal(dp.grad(lambda v: loss(unflatten(v)))(vector), [30.0, 18.0, 36.0])


@pytest.mark.parametrize("memory", [None, 400])
@pytest.mark.filterwarnings("ignore::sparsedp.errors.BudgetWarning")
def test_a_state_of_a_rollout(memory):
    def step(s, p):
        return State(ink=s.ink - 0.1 * p.k * s.ink**2 * p.u, time=s.time + 0.1)

    def in_dicts(s, p):
        return {"ink": s["ink"] - 0.1 * p["k"] * s["ink"] ** 2 * p["u"], "time": s["time"] + 0.1}

    def total(p, memory=memory):
        end = dp.rollout(step, State(ink=U, time=0.0), p, 5, memory=memory)
        assert type(end) is State
        return anp.sum(end.ink) * end.time

    def total_of_dicts(p):
        end = dp.rollout(in_dicts, {"ink": U, "time": 0.0}, p, 5, memory=memory)
        return anp.sum(end["ink"]) * end["time"]

    value, gradient = dp.value_and_grad(total)(Model(0.5, 2 * U))
    expected, by_dicts = dp.value_and_grad(total_of_dicts)({"k": 0.5, "u": 2 * U})
    assert value == expected and gradient.k == by_dicts["k"]
    np.testing.assert_array_equal(gradient.u, by_dicts["u"])
    with pytest.raises(ShapeError, match="state"):
        dp.rollout(lambda s, p: (s.ink, s.time), State(ink=U, time=0.0), None, 2)


def test_a_state_of_a_stepper():
    rate = lambda s, p: State(ink=-p * s.ink, time=1.0)
    step = dp.stepper("rk4", rate, 0.1)
    end = dp.rollout(step, State(ink=U, time=0.0), 2.0, 3)
    np.testing.assert_allclose(end.ink, U * np.exp(-0.6), rtol=1e-4)
    assert end.time == pytest.approx(0.3)


def test_unknowns_of_an_equation():
    pair = dp.implicit(lambda x, p: State(ink=x.ink**2 - p.k, time=x.time - x.ink * p.u))
    found = pair(State(ink=np.ones(2), time=np.ones(2)), Model(4.0, U))
    assert type(found) is State
    np.testing.assert_allclose(found.time, 2 * U, rtol=1e-10)
    slope = dp.grad(lambda p: anp.sum(pair(State(ink=np.ones(2), time=np.ones(2)), p).time))(Model(4.0, U))
    assert slope.k == pytest.approx(0.75) and slope.u == pytest.approx(2.0)


@pytest.mark.parametrize("method", ["lbfgs", "adam"])
def test_minimize_and_its_checkpoints(method, tmp_path):
    distance = lambda x: (x.k - 1.0) ** 2 + anp.sum((x.u - 2.0) ** 2)
    by_dict = lambda x: (x["k"] - 1.0) ** 2 + anp.sum((x["u"] - 2.0) ** 2)
    file = tmp_path / "run.npz"
    best = dp.minimize(distance, Model(0.0, U), method, maxiter=6)
    known = dp.minimize(by_dict, {"k": 0.0, "u": U}, method, maxiter=6)
    assert type(best.x) is Model and best.x.name == "model" and best.x.k == known.x["k"]
    np.testing.assert_array_equal(best.x.u, known.x["u"])
    dp.minimize(distance, Model(0.0, U), method, maxiter=3, checkpoint=file)
    assert file.exists()
    resumed = dp.minimize(distance, Model(0.0, U), method, maxiter=6, checkpoint=file)
    assert type(resumed.x) is Model and resumed.x.k == best.x.k
    np.testing.assert_array_equal(resumed.x.u, best.x.u)


def test_constants_on_a_tape_are_copied():
    work = Model(1.0, U.copy())
    held = constant(work)
    work.u[:] = 0.0
    np.testing.assert_array_equal(held.u, U)
    scaled = dp.differentiable("scaled", lambda x, m: x * m.u, lambda nums, ans, x, m: lambda g: (g * m.u,))
    work = Model(1.0, U.copy())

    def loss(x):
        y = anp.sum(scaled(x, work))
        work.u[:] = 0.0
        return y

    np.testing.assert_array_equal(dp.grad(loss)(np.ones(2)), U)
    with pytest.raises(DerivativeError, match="traced value inside a Model"):
        dp.grad(lambda k: anp.sum(scaled(U, Model(k, U))))(1.0)
