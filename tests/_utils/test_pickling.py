"""Whatever a scene holds travels to another process and gives the same bits there: value, gradient, tangent."""

import copy
import os
import pickle
import re
import subprocess
import sys

import numpy as np
import pytest
import travellers
from scipy.sparse.linalg import LinearOperator
from sources import ROOT

import sparsedp as dp

ALL = list(travellers.travellers())
LABELS = [f"{builder} {label}".strip() for builder, label, *_ in ALL]
SLOW = {f"stepper {method}, tolerance" for method in travellers.STEPS.keys() - {"rk4", "backward_euler"}}
MARKED = [pytest.param(one, marks=[pytest.mark.whole] * (label in SLOW)) for one, label in zip(ALL, LABELS)]


def test_everything_public_that_is_called_is_here():
    missing = set(dp.__all__) - {builder for builder, *_ in ALL} - travellers.NOTHING_TO_CALL
    assert not missing, f"give them a line in tests/helpers/travellers.py: {sorted(missing)}"


@pytest.mark.parametrize("one", MARKED, ids=LABELS)
def test_same_bits_here(one):
    """Pickled fresh; what has been used, in a fresh process below."""
    _, _, thing, use = one
    fresh = pickle.dumps(thing)
    twin = pickle.loads(fresh)
    assert use(twin) == use(thing)
    assert len(pickle.dumps(thing)) <= 1.2 * len(fresh) + 5000 or one[0] == "from_blackbox", "a cache travels"


@pytest.mark.whole
@pytest.mark.parametrize("one", ALL, ids=LABELS)
def test_same_bits_of_copies(one):
    """Copied fresh, and copied and pickled when used."""
    _, _, thing, use = one
    twins = [copy.deepcopy(thing), copy.copy(thing)]
    wanted = use(thing)
    for twin in (*twins, pickle.loads(pickle.dumps(thing)), copy.deepcopy(thing)):
        assert use(twin) == wanted


@pytest.mark.slow
def test_same_bits_in_a_fresh_process(tmp_path):
    """All of them at once: a new interpreter has seen none of the numbers."""
    for _, _, thing, use in ALL:
        use(thing)  # what has been used travels
    wanted = [use(thing) for _, _, thing, use in ALL]
    (tmp_path / "things").write_bytes(pickle.dumps([thing for _, _, thing, _ in ALL]))
    code = (
        "import pickle, sys, travellers\n"
        "things = pickle.load(open(sys.argv[1], 'rb'))\n"
        "uses = [one[3] for one in travellers.travellers()]\n"
        "pickle.dump([use(thing) for use, thing in zip(uses, things, strict=True)], open(sys.argv[2], 'wb'))\n"
    )
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "helpers")])
    names = [str(tmp_path / name) for name in ("things", "found")]
    subprocess.run([sys.executable, "-c", code, *names], check=True, env={**os.environ, "PYTHONPATH": path})
    found = pickle.loads((tmp_path / "found").read_bytes())
    different = [label for label, one, other in zip(LABELS, found, wanted, strict=True) if one != other]
    assert not different


def test_twins_are_apart_from_what_the_caller_writes(rng):
    """A recipe holds copies: what is made again is what was made."""
    solid = travellers.SOLID.copy()
    boundary = {"x": (dp.no_slip, dp.outflow)}
    grid = travellers.GRID
    v = rng.standard_normal(travellers.GRID.faces.size)
    convect = dp.convection(grid, boundary, solid)
    P = dp.projection(grid, solid, boundary)
    step = dp.flow_step(grid, 0.01, boundary=boundary, solid=solid)
    wanted = convect(v, v), P(v), step(step.start(v))["v"]
    solid[:], boundary["x"] = False, dp.free_slip
    convect, P, step = (pickle.loads(pickle.dumps(one)) for one in (convect, P, step))
    found = convect(v, v), P(v), step(step.start(v))["v"]
    assert all(map(np.array_equal, found, wanted))


@pytest.mark.parametrize("one", [one for one in ALL if isinstance(one[2], dp.Operator)], ids=lambda one: str(one[:2]))
def test_transposes_travel(one):
    turned = one[2].T
    wanted = one[3](turned) if one[3] is not travellers.of_inverse else travellers.of_operator(turned)
    twin = pickle.loads(pickle.dumps(turned))
    assert (one[3](twin) if one[3] is not travellers.of_inverse else travellers.of_operator(twin)) == wanted


L = dp.laplacian(travellers.LINE)

# (what is over a function without a name, what the message calls it)
UNNAMED = [
    (dp.stepper("rk4", lambda u, p: -u, 0.1), "stepper(rk4)"),
    (dp.stepper("imex", travellers.burgers, 0.1, linear=(L, lambda p: p)), "stepper(imex)"),
    (dp.stepper("tr_bdf2", L, 0.1, source=lambda p: p), "stepper(tr_bdf2)"),
    (dp.stepper("euler", L, lambda p: p), "stepper(euler)"),
    (dp.implicit(lambda x, p: x**3 - p), "implicit(<lambda>)"),
    (dp.implicit(travellers.cubic, lambda x, p: 3 * x**2), "implicit(cubic)"),
    (dp.value_and_grad(lambda x: x**2), "value_and_grad"),
    (dp.flow_step(travellers.BOX, 0.1, force=lambda v, p: v), "FlowStep"),
    (dp.from_blackbox(lambda x: x, name="copy"), "copy"),
    (dp.differentiable("copy", lambda x: x), "copy"),
    (dp.differentiable("copy", travellers.cube, lambda nums, y, x: lambda g: (g,)), "copy"),
    (dp.physical_gradient(travellers.cube, lambda y, x: y), "physical gradient"),
    (dp.from_functions(lambda u: u, travellers.unmix, 12, 12), "an operator of two functions"),
    (2.0 * dp.from_functions(travellers.mix, lambda g: g, 12, 12).T, "an operator of two functions"),
    (dp.inverse(dp.from_matrix(travellers.BAND), "krylov", preconditioner=lambda r: r), "inverse(matrix)"),
    (dp.matrix_solver(travellers.BAND, "krylov", preconditioner=lambda r: r), "matrix_solver"),
]


@pytest.mark.parametrize("thing, name", UNNAMED, ids=[name for _, name in UNNAMED])
def test_functions_without_a_name_stay_at_home(thing, name):
    """They are named, with what to write; a copy in this process needs no name."""
    told = (
        r" cannot be pickled with .*<lambda>, which other processes cannot import; write it as a def at the top level"
    )
    with pytest.raises(TypeError, match="^" + re.escape(name) + told):
        pickle.dumps(thing)
    assert type(copy.deepcopy(thing)) is type(copy.copy(thing)) is type(thing)


def test_the_message_whole():
    def doubled(x):
        return 2 * x

    scipys = LinearOperator((3, 3), matvec=doubled, rmatvec=doubled, dtype=float)
    with pytest.raises(
        TypeError,
        match="adopted cannot be pickled with test_the_message_whole.<locals>.doubled, which other processes cannot "
        "import; write it as a def at the top level of a module",
    ):
        pickle.dumps(dp.from_blackbox(doubled, name="adopted"))
    with pytest.raises(TypeError, match="cannot be pickled with .*LinearOperator with dtype=float64"):
        pickle.dumps(dp.from_linear_operator(scipys))


class Scene:
    """As users write one: it holds what was made of its own method."""

    def __init__(self):
        self.factor = 3.0
        self.gradient = dp.value_and_grad(self.loss)
        self.step = dp.stepper("euler", self.rate, 0.5)

    def loss(self, x):
        return self.factor * self.step(x, None) ** 2

    def rate(self, u, params):
        return -u


class Doubles:
    """A function with a state, that holds what was made of it."""

    def __init__(self):
        self.gradient = dp.value_and_grad(self)

    def __call__(self, x):
        return 2 * x


def test_objects_made_of_a_method_of_what_holds_them():
    for scene in (Scene(), Doubles()):
        for twin in (pickle.loads(pickle.dumps(scene)), copy.deepcopy(scene)):
            assert twin.gradient(2.0) == scene.gradient(2.0)
            assert twin is not scene
    twin = pickle.loads(pickle.dumps(scene.gradient))
    assert twin(2.0) == scene.gradient(2.0)


def test_a_method_of_a_class_without_a_place():
    class Inner:
        def rate(self, u, params):
            return -u

    with pytest.raises(
        TypeError,
        match=r"stepper\(euler\) cannot be pickled with .*Inner.rate, which other processes cannot import; write its "
        "class at the top level of a module",
    ):
        pickle.dumps(dp.stepper("euler", Inner().rate, 0.5))
