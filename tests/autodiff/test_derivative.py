"""The public derivatives: grad, value_and_grad, vjp, jvp, hvp, against formulas and differences."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.errors import DerivativeError, ShapeError

RNG = np.random.default_rng(0)
GRID = dp.Grid((4, 5), size=1.0)
LAPLACIAN = dp.laplacian(GRID, dp.dirichlet)
U, T = RNG.standard_normal((2, *GRID.shape))


def energy(u, k=0.3):
    return anp.sum(anp.sin(k * LAPLACIAN(u)) * u**2)


def difference(fun, x, t, step=1e-6):
    return (fun(x + step * t) - fun(x - step * t)) / (2 * step)


def test_grad_and_the_number_of_the_argument():
    assert np.sum(dp.grad(energy)(U) * T) == pytest.approx(difference(energy, U, T), rel=1e-6)
    of_k = dp.grad(energy, argnum=1)(U, 0.3)
    assert isinstance(of_k, float)
    assert of_k == pytest.approx(difference(lambda k: energy(U, k), 0.3, 1.0), rel=1e-6)
    value, same = dp.value_and_grad(energy, 1)(U, 0.3)
    assert (value, same) == (energy(U), of_k)


def thirty_fields(u):
    return anp.stack([k * u if k % 3 else GRID.volumes for k in range(30)], -1)


def counted(monkeypatch, module, name):
    calls = []
    function = getattr(module, name)

    def counting(*args, **options):
        calls.append(name)
        return function(*args, **options)

    monkeypatch.setattr(module, name, counting)
    return calls


def test_reverse_mode_of_a_concatenation_takes_the_length_of_each_array_once(monkeypatch):
    """autograd's rule for one argument at a time adds up all lengths before it: n^2 operations for n arrays."""
    calls = counted(monkeypatch, anp, "shape")
    weights = np.arange(600.0).reshape(*GRID.shape, 30)
    slope = dp.grad(lambda u: anp.sum(weights * thirty_fields(u)))(U)
    assert 0 < len(calls) < 60
    np.testing.assert_allclose(slope, sum(k * weights[..., k] for k in range(30) if k % 3), rtol=1e-15)


def test_concatenation_without_axis():
    weights = np.arange(40.0)
    slope = dp.grad(lambda u: anp.sum(weights * anp.concatenate([u, 2.0 * u], axis=None)))(U)
    np.testing.assert_allclose(slope, np.reshape(weights[:20] + 2.0 * weights[20:], GRID.shape), rtol=1e-15)


def test_forward_mode_concatenates_all_tangents_at_once(monkeypatch):
    """autograd's rule for one argument at a time takes n concatenations for n arrays."""
    calls = counted(monkeypatch, np, "concatenate")
    value, tangent = dp.jvp(thirty_fields, U, T)
    assert len(calls) < 5
    assert value.shape == (*GRID.shape, 30)
    assert np.array_equal(tangent, np.stack([k * T if k % 3 else 0 * T for k in range(30)], -1))


def test_vjp_of_several_arguments_and_of_a_tree():
    g = RNG.standard_normal(GRID.shape)
    value, pull = dp.vjp(lambda u, k: k * LAPLACIAN(u), U, 0.7)
    of_u, of_k = pull(g)
    assert np.array_equal(value, 0.7 * LAPLACIAN(U))
    np.testing.assert_allclose(of_u, 0.7 * LAPLACIAN.T(g), rtol=1e-13)
    assert of_k == pytest.approx(np.sum(g * LAPLACIAN(U)), rel=1e-13)
    _, pull = dp.vjp(lambda x: x["a"] * x["n"], {"a": U, "n": 2})
    back = pull(g)
    assert np.array_equal(back["a"], 2 * g) and back["n"] is None


def test_jvp_of_trees_and_without_a_forward_derivative():
    value, slope = dp.jvp(lambda x: {"s": anp.sin(x[0]) * x[1], "n": 3}, (U, 2.0), (T, 0.5))
    assert np.array_equal(value["s"], np.sin(U) * 2.0) and slope["n"] is None
    np.testing.assert_allclose(slope["s"], np.cos(U) * T * 2.0 + np.sin(U) * 0.5, rtol=1e-13)
    backward_only = dp.differentiable("cube", lambda u: u**3, lambda nums, ans, u: lambda g: (3 * u**2 * g,))
    np.testing.assert_allclose(dp.jvp(backward_only, U, T)[1], 3 * U**2 * T, rtol=1e-12)


def skips(g, x, slope):
    return (slope * g if np.any(g) else np.zeros_like(x),)


def divides(g, x, slope):
    return (slope * (g / anp.max(anp.abs(g))) * anp.max(anp.abs(g)),)


def skips_what_carries_nothing(g, x, slope):
    """Constants, which many a backward pass begins with, are removed first."""
    return (slope * g if np.any(g - anp.mean(g)) else np.zeros_like(x),)


@pytest.mark.parametrize("back", [skips, divides, skips_what_carries_nothing])
def test_rules_that_branch_on_their_cotangent(back):
    cube = dp.differentiable("cube", lambda u: u**3, lambda nums, ans, u: lambda g: back(g, u, 3 * u**2))
    np.testing.assert_allclose(dp.jvp(cube, U, T)[1], 3 * U**2 * T, rtol=1e-12)
    loss = lambda u: anp.sum(anp.sin(cube(u)) * T)
    wanted = (6 * U * np.cos(U**3) - 9 * U**4 * np.sin(U**3)) * T * T
    np.testing.assert_allclose(dp.hvp(loss, U, T), wanted, rtol=1e-10)


def test_eigenvectors_forward():
    """Autograd's rule of eigh skips cotangents of zero."""

    def chain(k):
        return anp.diag(k[:-1] + k[1:]) - anp.diag(k[1:-1], 1) - anp.diag(k[1:-1], -1)

    k = np.linspace(1.0, 2.0, 7)
    t = np.arange(7.0)
    shape = lambda k: anp.linalg.eigh(chain(k))[1][:, 0] ** 2
    lowest = lambda k: anp.linalg.eigh(chain(k))[0][0]
    np.testing.assert_allclose(dp.jvp(shape, k, t)[1], difference(shape, k, t), rtol=1e-6)
    np.testing.assert_allclose(dp.hvp(lowest, k, t), difference(dp.grad(lowest), k, t), rtol=1e-6)
    goal = shape(k[::-1])
    for dense in (True, False):
        found = dp.minimize(lambda k: shape(k) - goal, k, "levenberg_marquardt", dense=dense)
        assert found.converged and found.value < 1e-15


def test_full_like_of_a_traced_value():
    for kind in (float, np.float32):
        given = np.ones(3, kind)
        assert dp.grad(lambda k: anp.sum(anp.full_like(given, k) ** 2))(2.0) == 12.0
        assert np.array_equal(dp.jvp(lambda k: anp.full_like(given, k), 2.0, 1.0)[1], np.ones(3))
        assert anp.full_like(given, 2.0).dtype == kind
    assert np.array_equal(dp.grad(lambda k: anp.sum(anp.full_like(k, k[::-1]) ** 2))(np.array([2.0, 3.0])), [4.0, 6.0])
    assert dp.grad(lambda k: k + anp.sum(anp.full_like(np.ones(3, int), k)))(2.5) == 1.0  # whole numbers: it jumps


@pytest.mark.parametrize("name", ["sum", "mean", "prod", "var", "std", "max", "min", "amax", "amin"])
@pytest.mark.parametrize("library", [np, anp])
def test_reductions_of_some_entries_are_refused(name, library):
    x = np.array([1.0, 2.0, 4.0])
    mask = np.array([True, False, True])
    told = name if library is anp else name.removeprefix("a")  # NumPy's asks the traced value for its `max`
    options = [{"initial": 9.0}] if name not in ("mean", "var", "std") else []
    options += [{"where": mask, **({"initial": 9.0} if name[-3:] in ("max", "min") else {})}]
    for given in options:
        some = lambda x: getattr(library, name)(x, **given)
        assert some(x) == getattr(np, name)(x, **given)
        for derive in (dp.grad(some), lambda x: dp.jvp(some, x, x)):
            with pytest.raises(DerivativeError) as refused:
                derive(x)
            assert str(refused.value) == (
                f"autograd's derivative of {told} does not know where= and initial=; choose entries by x[mask] or "
                "anp.where(mask, x, 0.0), and add the initial value to the result"
            )


def test_hvp_is_the_difference_of_gradients_and_symmetric():
    other = RNG.standard_normal(GRID.shape)
    product = dp.hvp(energy, U, T)
    np.testing.assert_allclose(product, difference(dp.grad(energy), U, T), rtol=1e-5, atol=1e-5)
    assert np.sum(product * other) == pytest.approx(np.sum(dp.hvp(energy, U, other) * T), rel=1e-11)
    tree = dp.hvp(lambda x: x["a"] ** 3 * x["n"], {"a": 2.0, "n": 5}, {"a": 1.0, "n": None})
    assert tree == {"a": 60.0, "n": None}


def test_derivatives_of_derivatives():
    once = lambda u: anp.sum(dp.grad(energy)(u) * T)
    np.testing.assert_allclose(dp.grad(once)(U), dp.hvp(energy, U, T), rtol=1e-11)
    third = dp.grad(lambda u: anp.sum(dp.hvp(energy, u, T) * T))(U)
    wanted = difference(lambda u: dp.hvp(energy, u, T), U, T, 1e-5)
    np.testing.assert_allclose(third, wanted, rtol=1e-4, atol=1e-4 * np.max(np.abs(wanted)))


@pytest.mark.parametrize("function", [dp.grad, dp.value_and_grad, lambda f: dp.vjp(f, U), lambda f: dp.hvp(f, U, T)])
def test_what_is_no_function_is_refused(function):
    with pytest.raises(TypeError, match="takes a function, got float"):
        function(2.0)


def test_messages():
    with pytest.raises(TypeError, match="takes a function, got ndarray"):
        dp.jvp(U, U, T)
    with pytest.raises(
        ValueError, match="argnum of value_and_grad must be a whole number >= 0, got -1; write 0 for the first argument"
    ):
        dp.grad(energy, -1)
    with pytest.raises(TypeError, match="the gradient in argument 1 of the loss needs it, got 1 arguments"):
        dp.grad(energy, 1)(U)
    with pytest.raises(ShapeError, match="tangent: expected an array of shape"):
        dp.jvp(energy, U, T[:2])
    with pytest.raises(ShapeError, match="the loss must be a scalar"):
        dp.hvp(LAPLACIAN, U, T)
    with pytest.raises(DerivativeError, match="a gradient needs floating values"):
        dp.vjp(energy, 3)
