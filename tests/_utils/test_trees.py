"""Trees that belong together are paired by name, whatever the order of their entries, and refused by path."""

from collections import Counter, OrderedDict, defaultdict
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import autograd.numpy as anp
import numpy as np
import pytest
import scipy.sparse as sp

import sparsedp as dp
from sparsedp._utils.pytree import is_uniform, leaves, mapped, paired
from sparsedp.errors import DerivativeError, ShapeError

METHODS = ["lbfgs", "gd", "newton_cg"]
SQUARES = ["gauss_newton", "levenberg_marquardt", "half_inverse"]
START = {"a": 0.0, "b": 0.0}


class Pair(NamedTuple):
    a: Any
    b: Any


class Turned(NamedTuple):
    b: Any
    a: Any


class Other(NamedTuple):
    a: Any
    c: Any


@dataclass
class Settings:
    """A dataclass that checks its fields: it is not a tree."""

    k: Any

    def __post_init__(self):
        assert self.k is None or self.k is not False

    def __getitem__(self, name):
        return getattr(self, name)


def loss(x):
    return (x["a"] - 1.0) ** 2 + 10 * (x["b"] - 2.0) ** 2


def residuals(x):
    return anp.array([x["a"] - 1.0, 3.0 * (x["b"] - 2.0)])


def turned_gradient(x):
    return {"b": 20 * (x["b"] - 2.0), "a": 2 * (x["a"] - 1.0)}


# ---- the function ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tree", "reference", "wanted"),
    [
        ({"b": 2, "a": 1}, {"a": 0, "b": 0}, [1, 2]),
        ({"b": 2, "a": 1}, OrderedDict(a=0, b=0), [1, 2]),
        (defaultdict(list, b=2, a=1), {"a": 0, "b": 0}, [1, 2]),
        (Turned(b=2, a=1), Pair(0, 0), [1, 2]),
        ((1, 2), Pair(0, 0), [1, 2]),
        ([1, 2], (0, 0), [1, 2]),
        ({"v": [{"d": 3, "c": 2}], "u": 1}, {"u": 0, "v": ({"c": 0, "d": 0},)}, [1, 2, 3]),
        ({1: 2, "1": 1}, {"1": 0, 1: 0}, [1, 2]),
        ({}, {}, []),
    ],
)
def test_leaves_are_paired_by_name(tree, reference, wanted):
    assert paired(tree, reference, "tree") == wanted


@pytest.mark.parametrize(
    ("tree", "reference", "words"),
    [
        ({"a": 1, "q": 1}, START, "tree: unknown key 'q'; expected 'a', 'b'"),
        ({"q": 1, "z": 1}, START, "tree: unknown keys 'q', 'z'; expected 'a', 'b'"),
        ({"b": 1}, START, "tree: missing key 'a'; expected 'a', 'b'"),
        ({}, START, "tree: missing keys 'a', 'b'; expected 'a', 'b'"),
        ({"a": 1}, {}, "tree: unknown key 'a'; expected none"),
        (Other(1, 2), Pair(0, 0), "tree: unknown field 'c'; expected 'a', 'b'"),
        ((1, 2), START, "tree: expected a dict of a, b, got a tuple of length 2"),
        ({0: 1, 1: 2}, (0, 0), "tree: expected a tuple of length 2, got a dict of 0, 1"),
        (Pair(1, 2), START, "tree: expected a dict of a, b, got a Pair of length 2"),
        ([1, 2, 3], (0, 0), "tree: expected a tuple of length 2, got a list of length 3"),
        (1, START, "tree: expected a dict of a, b, got int"),
        ([1, 2], np.ones(2), "tree: expected one array or number, got a list of length 2"),
        ({"u": [{"w": 1}]}, {"u": ({"v": 1},)}, "tree['u'][0]: unknown key 'w'; expected 'v'"),
        ({"u": Pair(1, {})}, {"u": Pair(1, {"v": 1})}, "tree['u'].b: missing key 'v'; expected 'v'"),
        (
            {"b": np.ones(2), "a": np.ones(3)},
            {"a": np.ones(3), "b": np.ones(4)},
            "tree['b']: expected shape (4,), got (2,)",
        ),
    ],
)
def test_other_trees_are_refused_by_path(tree, reference, words):
    with pytest.raises(ShapeError) as refused:
        paired(tree, reference, "tree", shapes=True)
    assert str(refused.value) == words


def test_a_number_may_stand_for_a_branch():
    reference = {"u": (np.ones(2), np.ones(3)), "v": np.ones(4)}
    assert paired({"v": 2.0, "u": 1.0}, reference, "floor", prefix=is_uniform) == [1.0, 1.0, 2.0]
    assert paired(None, reference, "floor", prefix=is_uniform) == [None] * 3
    with pytest.raises(ShapeError, match=r"floor\['u'\]: expected a tuple of length 2, got an array of shape \(2,\)"):
        paired({"v": 2.0, "u": np.ones(2)}, reference, "floor", prefix=is_uniform)


def test_mapped_trees_are_paired():
    assert mapped(max, {"a": 1, "b": 5}, {"b": 3, "a": 2}) == {"a": 2, "b": 5}


# ---- kinds of dicts --------------------------------------------------------------------------------------------------


class Named(dict):
    """A dict with a name, which its entries alone do not give."""

    def __init__(self, name, entries):
        super().__init__(entries)
        self.name = name


KINDS = {
    "dict": dict,
    "OrderedDict": OrderedDict,
    "defaultdict": lambda entries: defaultdict(list, entries),
    "Counter": Counter,
    "subclass": lambda entries: Named("scene", entries),
}


@pytest.mark.parametrize("kind", KINDS)
def test_subclasses_of_dict_are_trees(kind):
    start = KINDS[kind]({"b": np.zeros(2), "a": np.zeros(3)})

    def of_any(x):
        assert type(x) is type(start)
        return anp.sum((x["a"] - 1.0) ** 2) + anp.sum((x["b"] - 2.0) ** 2)

    value, gradient = dp.value_and_grad(of_any)(start)
    assert (value, type(gradient)) == (11.0, type(start))
    assert np.all(gradient["a"] == -2.0) and np.all(gradient["b"] == -4.0)
    best = dp.minimize(of_any, start, bounds=({"a": 0.0, "b": None}, {"a": 0.5, "b": 3.0}))
    assert type(best.x) is type(start) and list(best.x) == ["b", "a"]
    assert best.x["a"] == pytest.approx(0.5) and best.x["b"] == pytest.approx(2.0)
    last = dp.rollout(lambda s, p: {"a": 0.5 * s["a"], "b": s["b"]}, start, None, 3)
    assert type(last) is type(start) and list(last) == ["b", "a"]
    vector, unflatten = dp.flatten(start)
    assert type(unflatten(vector)) is type(start)
    assert dp.check.gradient(of_any, start)
    tangent = {"a": np.ones(3), "b": np.zeros(2)}
    assert dp.jvp(of_any, start, tangent)[1] == -6.0
    assert dp.hvp(of_any, start, tangent)["a"].tolist() == [2.0, 2.0, 2.0]


def test_a_rebuilt_dict_keeps_what_its_class_knows():
    start = defaultdict(list, a=1.0)
    assert mapped(lambda leaf: leaf + 1.0, start)["missing"] == []
    assert list(start) == ["a"]
    assert mapped(lambda leaf: leaf, Named("scene", {"a": 1.0})).name == "scene"


# ---- minimize --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_bounds_in_another_order(method):
    best = dp.minimize(loss, START, method, bounds=({"b": -1.0, "a": -5.0}, {"b": 1.5, "a": 0.5}))
    assert best.x == pytest.approx({"a": 0.5, "b": 1.5})


@pytest.mark.parametrize("method", SQUARES)
def test_bounds_of_least_squares_in_another_order(method):
    best = dp.minimize(residuals, START, method, bounds=({"b": -1.0, "a": -5.0}, {"b": 1.5, "a": 0.5}))
    assert best.x == pytest.approx({"a": 0.5, "b": 1.5})


def test_bounds_of_adam_and_admm_in_another_order():
    bounds = {"b": -1.0, "a": -5.0}, {"b": 1.5, "a": 0.5}
    best = dp.minimize(loss, START, "adam", rate=0.1, maxiter=300, bounds=bounds)
    assert best.x == pytest.approx({"a": 0.5, "b": 1.5}, rel=1e-3)
    best = dp.minimize(loss, START, "admm", weight=1e-9, operator=residuals, bounds=bounds)
    assert best.x == pytest.approx({"a": 0.5, "b": 1.5}, rel=1e-4)


def test_bounds_of_nested_trees_and_of_other_named_tuples():
    start = {"p": Pair(np.zeros(2), 0.0), "q": [0.0], "n": 3}

    def distance(x):
        return anp.sum((x["p"].a - 9.0) ** 2) + (x["p"].b - 9.0) ** 2 + (x["q"][0] - 9.0) ** 2

    upper = {"q": [3.0], "n": None, "p": Turned(b=2.0, a=np.array([1.0, 1.5]))}
    best = dp.minimize(distance, start, bounds=(None, upper)).x
    assert best["p"].a.tolist() == [1.0, 1.5] and (best["p"].b, best["q"]) == (2.0, [3.0])
    best = dp.minimize(distance, start, bounds=(None, {"q": None, "n": None, "p": 1.0})).x  # a number for a branch
    assert best["p"].a.tolist() == [1.0, 1.0] and best["p"].b == 1.0
    assert best["q"][0] == pytest.approx(9.0)


@pytest.mark.parametrize(
    ("bounds", "words"),
    [
        (({"q": -1.0, "z": -5.0}, None), r"bounds\[0\]: unknown keys 'q', 'z'; expected 'a', 'b'; write one number"),
        ((None, {"a": 1.0, "q": 1.5}), r"bounds\[1\]: unknown key 'q'; expected 'a', 'b'"),
        ((None, {"a": 1.0}), r"bounds\[1\]: missing key 'b'; expected 'a', 'b'"),
        ((None, (1.0, 1.0)), r"bounds\[1\]: expected a dict of a, b, got a tuple of length 2"),
        (({"b": np.zeros(3), "a": 0.0}, None), r"bounds\[0\]\['b'\]: shape \(3,\) does not fit start\['b'\]"),
    ],
)
def test_other_bounds_are_refused(bounds, words):
    with pytest.raises(ShapeError, match=words):
        dp.minimize(loss, START, bounds=bounds)


def test_bounds_that_are_no_numbers_are_refused():
    for bound in (Settings(1.0), "0.5", np.array([None, 1.0])):
        with pytest.raises(
            TypeError, match=r"bounds\[1\]: expected numbers, got dtype .*; write -np.inf or np.inf for none"
        ):
            dp.minimize(square, np.zeros(2), bounds=(None, bound))
    with pytest.raises(ShapeError, match=r"bounds\[1\]: expected a dict of a, b, got Settings; write one number, None"):
        dp.minimize(loss, START, bounds=(None, Settings(1.0)))


@pytest.mark.parametrize("method", ["lbfgs", "gd"])
def test_a_gradient_in_another_order(method):
    best = dp.minimize(loss, START, method, gradient=turned_gradient)
    assert best.x == pytest.approx({"a": 1.0, "b": 2.0})


def test_a_gradient_whose_order_changes_from_call_to_call():
    calls = []

    def gradient(x):
        calls.append(None)
        slopes = turned_gradient(x)
        if len(calls) % 2:
            return slopes
        return dict(reversed(slopes.items()))

    assert dp.minimize(loss, START, gradient=gradient).x == pytest.approx({"a": 1.0, "b": 2.0})


def test_a_projection_in_another_order():
    best = dp.minimize(loss, START, project=lambda x: {"b": x["b"], "a": 0.0 * x["a"]})
    assert list(best.x) == ["a", "b"] and best.x == pytest.approx({"a": 0.0, "b": 2.0})


GRADIENTS: list[tuple] = [
    (lambda x: {"a": 1.0, "q": 1.0}, "gradient: unknown key 'q'; expected 'a', 'b'; return a tree like {}"),
    (lambda x: {"a": 1.0}, "gradient: missing key 'b'; expected 'a', 'b'; return a tree like {}"),
    (lambda x: (1.0, 1.0), "gradient: expected a dict of a, b, got a tuple of length 2; return a tree like {}"),
    (lambda x: {"b": np.ones(2), "a": 1.0}, r"gradient\['b'\]: expected shape \(\), got \(2,\); return a tree like {}"),
    (lambda x: {"b": None, "a": 1.0}, r"gradient\['b'\]: expected numbers, got dtype object; return a tree like {}"),
]


@pytest.mark.parametrize(("gradient", "words"), GRADIENTS)
def test_other_gradients_are_refused(gradient, words):
    with pytest.raises(DerivativeError, match=words.format("start")):
        dp.minimize(loss, START, gradient=gradient)
    with pytest.raises(DerivativeError, match=words.format("x")):
        dp.check.gradient(loss, START, gradient=gradient)
    with pytest.raises(DerivativeError, match=words.format("x")):
        dp.check.gradient(loss, START, gradient=gradient(START))


def test_a_checked_gradient_in_another_order():
    x = {"a": 0.3, "b": 0.7}
    assert dp.check.gradient(loss, x, gradient=turned_gradient)
    assert dp.check.gradient(loss, x, gradient=turned_gradient(x))
    swapped = dp.check.gradient(loss, x, gradient=lambda x: dict(zip("ab", turned_gradient(x).values())))
    assert swapped.verdict == "disagrees"


def test_the_inner_function_of_admm_in_another_order():
    def inner(target, rho, x):
        return {"b": target[1] / 3.0 + 2.0, "a": target[0] + 1.0}

    best = dp.minimize(loss, START, "admm", weight=1e-9, operator=residuals, inner=inner, maxiter=3)
    assert list(best.x) == ["a", "b"]
    with pytest.raises(ShapeError, match=r"inner\(target, rho, x\): missing key 'b'; expected 'a', 'b'; return a tree"):
        dp.minimize(loss, START, "admm", weight=1.0, operator=residuals, inner=lambda target, rho, x: {"a": 1.0})


def test_references_of_workprec_in_another_order():
    x = {"a": np.ones(2), "b": np.zeros(3)}
    reference = 2.0, {"b": np.zeros(3), "a": 2.0 * np.ones(2)}
    table = dp.work_precision(
        lambda n: (lambda x: anp.sum(x["a"] ** 2) + anp.sum(x["b"] ** 2), x),
        {"n": {"n": 1}},
        reference=reference,
        repeats=1,
    )
    assert (table.rows[0]["status"], table.rows[0]["gradient_error"]) == ("ok", 0.0)


# ---- tangents --------------------------------------------------------------------------------------------------------


def test_tangents_in_another_order():
    x = {"a": 0.3, "b": 0.7}
    tangent = {"b": 2.0, "a": 1.0}
    assert dp.jvp(loss, x, tangent)[1] == pytest.approx(2 * (0.3 - 1) + 2 * 20 * (0.7 - 2))
    assert dp.hvp(loss, x, tangent) == {"a": 2.0, "b": 40.0}
    x = Pair(2.0, 5.0)
    tangent = Turned(b=0.0, a=1.0)
    assert dp.jvp(lambda x: x.a * x.b, x, tangent)[1] == 5.0


@pytest.mark.parametrize(
    ("tangent", "words"),
    [
        ({"a": 1.0, "q": 1.0}, "tangent: unknown key 'q'; expected 'a', 'b'"),
        ({"a": 1.0}, "tangent: missing key 'b'; expected 'a', 'b'"),
        ({"b": np.ones(2), "a": 1.0}, r"tangent\['b'\]: expected an array of shape \(\), got an array of shape \(2,\)"),
        ({"b": None, "a": 1.0}, r"tangent\['b'\]: expected an array of shape \(\), got NoneType"),
    ],
)
def test_other_tangents_are_refused(tangent, words):
    for derivative in (dp.jvp, dp.hvp):
        with pytest.raises(ShapeError, match=words):
            derivative(loss, START, tangent)


# ---- steps in time ---------------------------------------------------------------------------------------------------


def decay(u, p):
    """Rates of two fields, in the other order."""
    return {"slow": -u["slow"], "fast": -5.0 * u["fast"]}


FIELDS = {"fast": np.array([1.0, 2.0]), "slow": np.array([3.0])}


@pytest.mark.parametrize("method", ["euler", "rk4", "heun", pytest.param("tr_bdf2", marks=pytest.mark.whole), "radau"])
def test_a_floor_in_another_order(method):
    options = dict(tolerance=1e-4) if method != "euler" else dict(tolerance=1e-2)
    one = dp.stepper(method, decay, 1.0, floor={"fast": 1e-3, "slow": 10.0}, **options)
    other = dp.stepper(method, decay, 1.0, floor={"slow": 10.0, "fast": 1e-3}, **options)
    swapped = dp.stepper(method, decay, 1.0, floor={"slow": 1e-3, "fast": 10.0}, **options)
    results = [step(FIELDS) for step in (one, other, swapped)]
    assert one.taken == other.taken != swapped.taken
    assert all(np.array_equal(results[0][name], results[1][name]) for name in FIELDS)


def test_a_floor_of_one_number_for_a_branch():
    state = {"u": FIELDS, "v": 1.0}

    def rate(s, p):
        return {"v": -s["v"], "u": decay(s["u"], p)}

    branch = dp.stepper("rk4", rate, 1.0, tolerance=1e-6, floor={"v": None, "u": 1e-2})
    fields = dp.stepper("rk4", rate, 1.0, tolerance=1e-6, floor={"u": {"slow": 1e-2, "fast": 1e-2}, "v": None})
    branch(state), fields(state)
    assert branch.taken == fields.taken


@pytest.mark.parametrize("method", ["rk4", "radau"])
@pytest.mark.parametrize(
    ("floor", "words"),
    [
        ({"fast": 1.0, "q": 1.0}, "floor: unknown key 'q'; expected 'fast', 'slow'; give one number"),
        ({"fast": 1.0}, "floor: missing key 'slow'; expected 'fast', 'slow'"),
        ((1.0, 1.0), "floor: expected a dict of fast, slow, got a tuple of length 2"),
        ({"slow": np.ones(2), "fast": 1.0}, r"floor\['slow'\]: shape \(2,\) does not fit the state there"),
    ],
)
def test_other_floors_are_refused(method, floor, words):
    with pytest.raises(ShapeError, match=words):
        dp.stepper(method, decay, 1.0, tolerance=1e-4, floor=floor)(FIELDS)


@pytest.mark.parametrize("method", ["euler", "rk4", "backward_euler", "tr_bdf2", "radau"])
def test_rates_in_another_order(method):
    step = dp.stepper(method, decay, 0.1)
    straight = dp.stepper(method, lambda u, p: dict(reversed(decay(u, p).items())), 0.1)
    one = step(FIELDS)
    other = straight(FIELDS)
    assert list(one) == ["fast", "slow"]
    assert all(np.array_equal(one[name], other[name]) for name in FIELDS)
    turned = dp.stepper(method, lambda u, p: Turned(b=-5.0 * u.b, a=-u.a), 0.1)(Pair(np.array([3.0]), FIELDS["fast"]))
    assert turned.a == pytest.approx(one["slow"]) and turned.b == pytest.approx(one["fast"])
    with pytest.raises(ShapeError, match=r"rate\['slow'\]: expected shape \(1,\), got \(2,\); return a tree like"):
        dp.stepper(method, lambda u, p: {"slow": -u["fast"], "fast": -u["fast"]}, 0.1)(FIELDS)


def test_the_stable_step_of_leapfrog_in_another_order():
    """The estimate of the fastest wave pairs forces with the field that they move."""
    mass = {"p": np.ones(2), "q": np.full(3, 100.0)}

    def force(q, c):
        return {"q": -mass["q"] * q["q"], "p": -mass["p"] * q["p"]}

    state = {"p": np.ones(2), "q": np.ones(3)}, {"p": np.zeros(2), "q": np.zeros(3)}
    step = dp.stepper("leapfrog", (force, lambda p, c: dict(reversed(p.items()))), 0.19)
    assert np.all(np.isfinite(step(state)[0]["q"]))
    with pytest.raises(dp.errors.UnstableStepError, match="waves of frequency 10 grow"):
        dp.stepper("leapfrog", (force, lambda p, c: dict(reversed(p.items()))), 0.21)(state)


def test_damping_in_another_order_and_for_a_branch():
    state = {"a": np.ones(2), "b": np.ones(2)}, {"a": np.ones(2), "b": np.ones(2)}

    def rates(damping):
        still = lambda x, c: {name: 0.0 * value for name, value in x.items()}
        return dp.stepper("leapfrog", (still, still), 0.1, damping=damping)(state)[0]

    damped = rates(({"b": 0.0, "a": 1.0}, None))
    assert np.all(damped["b"] == 1.0) and np.all(damped["a"] < 1.0)
    assert np.all(rates((1.0, None))["b"] == damped["a"])
    with pytest.raises(ShapeError, match=r"damping\[0\]: missing key 'a'; expected 'a', 'b'; give one number"):
        rates(({"b": 0.0}, None))


def test_stiff_terms_in_another_order():
    grid = dp.Grid(4, size=1.0)
    L = dp.laplacian(grid, dp.dirichlet)
    u = np.arange(4.0) + 1.0
    given = {"v": None, "u": (L, 0.1)}, {"u": (L, 0.1), "v": None}, Turned(b=None, a=(L, 0.1))
    states = {"u": u, "v": u}, {"u": u, "v": u}, Pair(u, u)
    results = [dp.stepper("backward_euler", None, 0.1, linear=terms)(state) for terms, state in zip(given, states)]
    for result in results:
        first, second = leaves(result)
        assert np.array_equal(first, leaves(results[0])[0]) and np.array_equal(second, u)
    with pytest.raises(TypeError, match="linear: missing key 'v'; expected 'u', 'v'; write None for a field without"):
        dp.stepper("backward_euler", None, 0.1, linear={"u": L})({"u": u, "v": u})


# ---- rollouts --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("memory", [None, 200])
def test_steps_that_return_their_state_in_another_order(memory):
    def step(s, p):
        return {"b": s["b"] * p, "a": s["a"] + s["b"]}

    def named(s, p):
        return Turned(b=s.b * p, a=s.a + s.b)

    def straight(s, p):
        return {"a": s["a"] + s["b"], "b": s["b"] * p}

    start = np.array([1.0, 2.0]), np.array([0.5, 0.25])

    def total(step, state, value):
        return lambda p: anp.sum(value(dp.rollout(step, state, p, 12, memory=memory)) ** 3)

    wanted = dp.value_and_grad(total(straight, dict(zip("ab", start)), lambda s: s["a"] - 2.0 * s["b"]))(0.9)
    assert dp.value_and_grad(total(step, dict(zip("ab", start)), lambda s: s["a"] - 2.0 * s["b"]))(0.9) == wanted
    assert dp.value_and_grad(total(named, Pair(*start), lambda s: s.a - 2.0 * s.b))(0.9) == wanted


def test_other_states_are_refused():
    start = {"a": np.ones(2), "b": np.ones(2)}
    for step, words in (
        (lambda s, p: {"a": s["a"], "q": s["b"]}, "state after the step: unknown key 'q'; expected 'a', 'b'"),
        (lambda s, p: {"b": s["b"]}, "state after the step: missing key 'a'; expected 'a', 'b'"),
        (lambda s, p: {"b": s["b"][:1], "a": s["a"]}, r"state\['b'\] must keep its form: the step made shape \(1,\)"),
    ):
        with pytest.raises(ShapeError, match=words):
            dp.rollout(step, start, None, 2)
    with pytest.raises(ShapeError, match="state after the step: unknown field 'c'; expected 'a', 'b'"):
        dp.rollout(lambda s, p: Other(s.a, s.b), Pair(1.0, 2.0), None, 2)


def in_turn(results):
    """A function that returns what `results` does, its entries in another order each time."""
    calls = []

    def function(i, state):
        calls.append(None)
        entries = results(state)
        if len(calls) % 3:
            return entries
        return dict(reversed(entries.items()))

    return function


@pytest.mark.parametrize("memory", [None, 240, "reverse"])
def test_what_keep_returns_in_another_order(memory):
    """Both entries have one shape and, at the start, equal values: nothing but their names tells them apart."""
    step = dp.stepper("leapfrog", (lambda q, c: -c * q, lambda p, c: p), 0.1)
    start = np.ones(2), np.ones(2)

    def loss(keep):
        def total(c):
            kept = dp.rollout(step, start, c, 8, memory=memory, keep=keep)
            return sum(anp.sum(one["a"] ** 2 + 3.0 * one["b"]) for one in kept)

        return total

    def both(state):
        return {"a": state[0], "b": state[1]}

    wanted = dp.value_and_grad(loss(lambda i, state: both(state)))(0.7)
    keep = in_turn(both)
    assert dp.value_and_grad(loss(keep))(0.7) == wanted
    value, pull = dp.vjp(loss(keep), 0.7)
    assert (pull(1.0), pull(1.0)) == (wanted[1], wanted[1])


def test_other_entries_of_keep_are_refused():
    calls = []

    def keep(i, state):
        calls.append(None)
        return {"a" if len(calls) <= 4 else "c": state}

    def loss(p):
        return sum(anp.sum(one["a"]) for one in dp.rollout(lambda u, p: p * u, np.ones(2), p, 3, keep=keep))

    with pytest.raises(
        DerivativeError, match=r"keep\(3, state\): unknown key 'c'; expected 'a'; keep returns something"
    ):
        dp.grad(loss)(0.5)


# ---- roots -----------------------------------------------------------------------------------------------------------


def test_residuals_in_another_order():
    def flow(x, p):
        return {"w": p - x["u"] * x["w"], "u": 4.0 * x["w"] - x["u"]}

    root = dp.implicit(flow)({"u": 1.0, "w": 1.0}, 9.0)
    assert root == pytest.approx({"u": 6.0, "w": 1.5})

    def named(x, p):
        return Turned(b=x.a - 2.0 * x.b, a=x.a - p)

    assert dp.implicit(named)(Pair(np.ones(2), np.ones(2)), 4.0).b == pytest.approx(2.0)
    with pytest.raises(ShapeError, match=r"residual of implicit\(<lambda>\): missing key 'w'; expected 'u', 'w'"):
        dp.implicit(lambda x, p: {"u": x["u"]})({"u": 1.0, "w": 1.0}, 9.0)


# ---- precision -------------------------------------------------------------------------------------------------------


X = np.arange(3.0)
LINE = dp.Grid(3, size=1.0)


def square(u):
    return anp.sum((u - 1.0) ** 2)


ENTRANCES = {
    "grad": lambda x: dp.grad(square)(x),
    "value_and_grad": lambda x: dp.value_and_grad(lambda t: square(t["u"]))({"u": x}),
    "vjp": lambda x: dp.vjp(lambda u: 2.0 * u, x),
    "cotangent": lambda x: dp.vjp(lambda u: 2.0 * u, X)[1](x),
    "jvp": lambda x: dp.jvp(square, x, np.ones(3)),
    "tangent": lambda x: dp.jvp(lambda u: 2.0 * u, X, x),
    "hvp": lambda x: dp.hvp(square, x, np.ones(3)),
    "flatten": lambda x: dp.flatten({"u": x}),
    "check.gradient": lambda x: dp.check.gradient(square, x),
    "update_direction": lambda x: dp.update_direction(lambda u: u - 1.0, x),
    "rollout": lambda x: dp.rollout(lambda u, p: 0.5 * u, x, None, 9, memory=2000),
    "params of rollout": lambda x: dp.rollout(lambda u, p: p * u, X, x, 9),
    "guess of implicit": lambda x: dp.implicit(lambda x, p: x**2 - p)(x + 1, X),
    "params of implicit": lambda x: dp.implicit(lambda x, p: x**2 - p)(X, x),
    "guess of steady": lambda x: dp.steady(lambda x: x - 1.0, x),
    "argument of adopt": lambda x: dp.from_blackbox(lambda x: x**2)(x),
    "ensemble": lambda x: dp.ensemble(lambda x, scene: anp.sum(abs(x)), [1])(x),
    "certify": lambda x: dp.certify(square, x),
    "stress": lambda x: dp.stress(square, x),
    "explain": lambda x: dp.explain(square, x),
    **{
        f"state of {method}": lambda x, method=method: dp.stepper(method, lambda u, p: -u, 0.1)(x)
        for method in ["euler", "heun", "ssprk3", "rk4", "backward_euler", "crank_nicolson", "tr_bdf2", "radau"]
    },
    "state with a tolerance": lambda x: dp.stepper("rk4", lambda u, p: -u, 0.1, tolerance=0.01)({"u": x}),
    "state of leapfrog": lambda x: dp.stepper("leapfrog", (lambda q, c: -q, lambda p, c: p), 0.1)((x, x)),
    "params of stepper": lambda x: dp.stepper("rk4", lambda u, p: -p * u, 0.1)(X, {"k": x}),
    "inputs of rollout": lambda x: dp.rollout(lambda u, p, i: i * u, 1.0, None, 3, inputs=x),
    **{
        f"minimize, {method}": lambda x, method=method: dp.minimize(
            (lambda u: u - 1.0) if method in SQUARES else square, x, method
        )
        for method in [*METHODS, "adam", *SQUARES]
    },
}


@pytest.mark.parametrize("dtype", [np.float16, np.longdouble, np.clongdouble])
@pytest.mark.parametrize("entrance", ENTRANCES)
def test_other_precisions_are_refused_by_name(entrance, dtype):
    words = f"must be float32, float64, complex64 or complex128, got {np.dtype(dtype)}; write np.asarray"
    with pytest.raises(TypeError, match=words):
        ENTRANCES[entrance](X.astype(dtype))


@pytest.mark.parametrize("dtype", [np.float16, np.longdouble])
def test_adopted_functions_of_other_precision_are_refused(dtype):
    """Differences of half precision would give a derivative of 0."""
    with pytest.raises(TypeError, match="the result of <lambda> must be float32, float64, complex64 or complex128"):
        dp.from_blackbox(lambda u: (u**2).astype(dtype))(X)


def test_derivatives_of_other_precision_are_rounded():
    best = dp.minimize(square, X, gradient=lambda u: 2 * (u - 1.0).astype(np.longdouble))
    assert best.x == pytest.approx(1.0)
    assert dp.check.gradient(square, X, gradient=lambda u: 2 * (u - 1.0).astype(np.longdouble))
    assert dp.implicit(lambda x, p: (x**2 - p).astype(np.longdouble))(X + 1.0, X + 4.0) == pytest.approx(
        np.sqrt(X + 4.0)
    )
    best = dp.minimize(lambda u: (u - 1.0).astype(np.longdouble), X, "levenberg_marquardt")
    assert best.x == pytest.approx(1.0)
    for method in ("rk4", "radau"):
        step, exact = (
            dp.stepper(method, lambda u, p, kind=kind: (-u).astype(kind), 0.1) for kind in (np.longdouble, float)
        )
        assert step(X).dtype == float and step(X) == pytest.approx(exact(X))
    best = dp.minimize(square, X, "admm", weight=1e-9, operator=lambda u: u.astype(np.longdouble))
    assert best.x == pytest.approx(1.0)
    best = dp.minimize(square, X, bounds=(np.zeros(3, np.longdouble), np.full(3, 0.5, np.float16)))
    assert best.x == pytest.approx(0.5)


@pytest.mark.parametrize("dtype", [np.float16, np.longdouble])
def test_constants_of_other_precision_are_rounded(dtype):
    for matrix in (np.diag(X + 1.0).astype(dtype), sp.diags_array(X + 1.0).tocsr().astype(np.longdouble)):
        op = dp.from_matrix(matrix)
        assert op.matrix.dtype == float and dp.check.operator(op)
        assert dp.inverse(op)(X) == pytest.approx(X / (X + 1.0))
    step = dp.stepper("rk4", lambda u, p: -u, dtype(0.125), tolerance=0.01, floor=X.astype(dtype) + 1)
    assert np.array_equal(step(X), dp.stepper("rk4", lambda u, p: -u, 0.125, tolerance=0.01, floor=X + 1)(X))


# ---- containers that are no trees ------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [lambda k: MappingProxyType({"k": k}), Settings, lambda k: Settings([Settings(k)])])
def test_containers_that_are_no_trees_are_refused_by_name(kind):
    hidden = kind(2.0)
    words = f"is a {type(hidden).__name__}, which is not a tree: its numbers would have no derivative; write a dict"
    for call in (
        lambda: dp.grad(lambda x: x["k"] ** 2)(hidden),
        lambda: dp.grad(lambda x: x["u"] * x["m"]["k"])({"u": 1.0, "m": hidden}),
        lambda: dp.minimize(lambda x: x["u"] * x["m"]["k"], {"u": 1.0, "m": hidden}),
    ):
        with pytest.raises(TypeError, match=words):
            call()
    circle = Settings(None)
    circle.k = [circle, 2.0]
    with pytest.raises(TypeError, match="is a Settings, which is not a tree"):
        dp.grad(lambda x: x.k[1])(circle)
    words_only = MappingProxyType({"name": "scene", "n": 3})  # nothing to differentiate
    assert dp.grad(lambda x: x["u"] ** x["m"]["n"])({"u": 2.0, "m": words_only}) == {"u": 12.0, "m": None}


def test_whole_messages():
    with pytest.raises(
        TypeError,
        match=r"x must be float32, float64, complex64 or complex128, got float16; write np.asarray\(x, float\)",
    ):
        dp.grad(square)(X.astype(np.float16))
    with pytest.raises(
        TypeError,
        match="x is a mappingproxy, which is not a tree: its numbers would have no derivative; "
        "write a dict, a NamedTuple or a plain dataclass",
    ):
        dp.grad(lambda x: x["k"] ** 2)(MappingProxyType({"k": 2.0}))
    with pytest.raises(DerivativeError, match=r"gradient\['b'\]: expected numbers, got dtype object; return a tree"):
        dp.minimize(loss, START, gradient=lambda x: {"b": None, "a": 1.0})


@pytest.mark.parametrize("kind", [lambda k: MappingProxyType({"k": k}), Settings])
def test_containers_in_a_rollout(kind):
    """As constants they are handed to the step; traced values inside would be lost."""

    def step(u, p):
        return u * p["c"]["k"]

    assert dp.rollout(step, 8.0, {"c": kind(0.5)}, 3) == 1.0
    assert dp.grad(lambda u: dp.rollout(step, u, {"c": kind(0.5)}, 3))(8.0) == 0.125
    with pytest.raises(
        DerivativeError,
        match=r"params\['c'\] of rollout is a .* with a traced value, which is not a tree; "
        "write a dict, a NamedTuple or a plain dataclass",
    ):
        dp.grad(lambda k: dp.rollout(step, 8.0, {"c": kind(k)}, 3))(0.5)


@pytest.mark.parametrize("kind", KINDS)
def test_constants_in_subclasses_of_dict_keep_their_values(kind):
    """The update of a Counter adds."""
    params = KINDS[kind]({"k": 0.5, "m": np.full(2, 2.0)})

    def step(u, p):
        return p["k"] * p["m"] * u * u

    assert dp.grad(lambda u: anp.sum(dp.rollout(step, u, params, 1)))(np.ones(2)).tolist() == [2.0, 2.0]
    rule = dp.differentiable(
        "scaled", lambda u, p: p["m"] * u, lambda nums, ans, u, p: lambda g: (p["m"] * g,) * len(nums)
    )
    assert dp.grad(lambda u: anp.sum(rule(u, params)))(np.ones(2)).tolist() == [2.0, 2.0]
