"""Functions of this library for torch and JAX, and theirs here: values, gradients of every order, dtypes, refusals."""

import pickle
import sys

import autograd.numpy as anp
import numpy as np
import pytest
from scipy.optimize import minimize

import sparsedp as dp

GRID = dp.Grid((5, 4), size=1.0)
L = dp.laplacian(GRID)


# ---- without either library ------------------------------------------------------------------------------------------


def test_a_name_that_is_not_there():
    message = "module 'sparsedp.interop' has no attribute 'to_numpy'; "
    message += "it has from_jax, from_torch, from_xarray, to_jax, to_torch, to_xarray, with_units"
    with pytest.raises(AttributeError, match="^module .* has no attribute .*; it has .*$") as found:
        dp.interop.to_numpy
    assert str(found.value) == message


@pytest.mark.parametrize(("library", "extra"), [("jax", "jax"), ("torch", "torch"), ("xarray", "files")])
def test_a_library_that_is_not_installed(library, extra, monkeypatch):
    for module in (f"interop.{library}_bridge", "io.labelled"):
        monkeypatch.delitem(sys.modules, f"sparsedp.{module}", raising=False)
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(vars(dp.interop), f"to_{library}", raising=False)  # kept since its first use
    with pytest.raises(ImportError, match=r"^dp.interop.to_.* needs .*; install sparsedp\[.*\]$") as found:
        getattr(dp.interop, f"to_{library}")
    assert str(found.value) == f"dp.interop.to_{library} needs {library}; install sparsedp[{extra}]"


def like_one_of(module):
    """An array whose type comes from a module, like arrays of torch and jax."""
    return type("Tensor", (), {"__module__": module, "shape": GRID.shape, "dtype": np.dtype(float)})()


FACES = np.ones(GRID.faces.size)
DOORS = {
    "laplacian": L,
    "a flat product": lambda u: L @ u,
    "an inverse": dp.inverse(dp.identity(GRID.cells) - L),
    "a first guess": lambda u: dp.inverse(dp.identity(GRID.cells) - L, "krylov")(np.ones(GRID.shape), start=u),
    "elliptic_solver": lambda u: dp.elliptic_solver(dp.divergence(GRID), dp.gradient(GRID))(FACES, u, 1.0),
    "transport": lambda u: dp.transport(GRID)(u, FACES, 0.01),
    "rollout": lambda u: dp.rollout(lambda u, p: 0.5 * u, u, None, 3),
    "params of a rollout": lambda u: dp.rollout(lambda u, p: 0.5 * u, np.ones(3), {"a": u}, 3),
    "stepper": lambda u: dp.stepper("crank_nicolson", L, 0.1)(u, None),
    "harmonic_average": dp.harmonic_average(GRID),
    "total_variation": dp.total_variation(GRID, 0.1),
    "a gradient": dp.value_and_grad(lambda u: 1.0),
    "a gradient in a tree": lambda u: dp.value_and_grad(lambda p: p["k"])({"k": 1.0, "u": u}),
    "jvp": lambda u: dp.jvp(lambda u: 1.0, u, u),
    "minimize": lambda u: dp.minimize(lambda u: 1.0, u),
    "check": lambda u: dp.check.gradient(lambda u: 1.0, u),
}


@pytest.mark.parametrize("module", ["torch", "torch.nn.parameter", "jaxlib._jax", "jax._src.interpreters.ad"])
@pytest.mark.parametrize("door", DOORS)
def test_arrays_of_others_are_sent_to_the_bridge(door, module):
    """Whatever the library does next, the advice of torch to detach a tensor would cut its gradient."""
    library = "torch" if module.startswith("torch") else "jax"
    with pytest.raises(
        TypeError,
        match=r"^.* needs arrays of NumPy, got a Tensor of .*; wrap what is computed in dp.interop.to_.*\(f\), "
        "which keeps gradients$",
    ) as found:
        DOORS[door](like_one_of(module))
    assert f"of {library}; wrap what is computed in dp.interop.to_{library}(f)" in str(found.value)


# ---- flat vectors for SciPy ------------------------------------------------------------------------------------------

TREE = {"u": np.arange(3.0), "z": np.array([1 + 2j]), "n": 3, "f": np.float32(2.0), "p": (4.0, np.ones((2, 2), "f"))}


def loss_of(p):
    size = anp.sum(anp.abs(p["z"] * (1 + 1j)) ** 2)
    return anp.sum(p["u"] ** 3) * size * p["f"] * p["p"][0] + anp.sum(p["p"][1] ** 2) * anp.sum(
        anp.real(p["z"] * (1 - 2j))
    )


def test_flatten_and_back():
    vector, unflatten = dp.flatten(TREE)
    assert vector.tolist() == [0, 1, 2, 1, 2, 2, 4, 1, 1, 1, 1]
    back = unflatten(vector)
    assert back["n"] == 3 and type(back["p"]) is tuple and back["z"] == TREE["z"] and back["p"][1].dtype == "f"
    vector[:] = 0.0
    assert back["u"].tolist() == [0, 1, 2]  # an array of its own
    assert pickle.loads(pickle.dumps(unflatten))(vector)["n"] == 3
    with pytest.raises(
        dp.errors.ShapeError,
        match="^the vector of this tree must have shape .11,., got .*; write one from dp.flatten of a tree like it$",
    ):
        unflatten(np.ones(3))


def test_flatten_has_derivatives_of_every_order():
    tree = {name: np.asarray(part, complex if name == "z" else float) for name, part in TREE.items() if name != "p"}
    loss = lambda p: loss_of({**p, "p": (4.0, np.ones(2))})
    vector, unflatten = dp.flatten(tree)
    flat = lambda x: loss(unflatten(x))
    assert dp.check.gradient(flat, vector + 0.1).verdict == "agrees"
    slopes = dp.grad(loss)(tree)
    wanted = dp.flatten({**slopes, "z": np.conj(slopes["z"])})[0]  # the tape gives dL/dRe - i dL/dIm
    assert np.allclose(dp.grad(flat)(vector), wanted, rtol=1e-14)
    t = np.cos(np.arange(vector.size))
    h = 1e-6
    differences = (dp.grad(flat)(vector + h * t) - dp.grad(flat)(vector - h * t)) / (2 * h)
    assert np.allclose(dp.hvp(flat, vector, t), differences, rtol=1e-6, atol=1e-6)


def test_one_line_of_scipy():
    vector, unflatten = dp.flatten({"u": np.zeros(GRID.shape), "k": 1.0})
    wanted = np.cos(np.arange(20.0)).reshape(GRID.shape)
    loss = lambda p: anp.sum((L(p["u"]) - 40 * p["u"] - wanted) ** 2) + (p["k"] - 3.0) ** 2
    best = minimize(dp.value_and_grad(lambda x: loss(unflatten(x))), vector, jac=True)
    assert best.success and unflatten(best.x)["k"] == pytest.approx(3.0)
