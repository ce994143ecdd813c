"""Derivatives by torch and JAX, and derivatives for their functions that other code computes."""

import numpy as np
import pytest

import sparsedp as dp

VJP = dp.check.vjp
JVP = dp.check.jvp
X = np.linspace(1.0, 2.0, 12)


@pytest.mark.whole
def test_functions_and_modules_of_torch():
    torch = pytest.importorskip("torch")
    x = torch.tensor(X)
    wave = lambda u: torch.sin(u) * u
    assert VJP(wave, x=x) and JVP(wave, x=x)
    assert VJP(wave, x=x * (1 + 0.5j)) and VJP(wave, x=x.float())
    assert VJP(torch.sin, lambda u, g: torch.cos(u) * g, x)
    assert VJP(torch.sin, lambda u, g: 1.001 * torch.cos(u) * g, x).verdict == "disagrees"

    class Cube(torch.autograd.Function):
        @staticmethod
        def forward(ctx, u):
            ctx.save_for_backward(u)
            return u**3

        @staticmethod
        def backward(ctx, g):
            return 2 * ctx.saved_tensors[0] ** 2 * g

    result = VJP(Cube.apply, x=x)
    assert result.gaps == ("every entry of x: vjp is too small, by a factor of 0.6667",)
    net = torch.nn.Sequential(torch.nn.Linear(12, 4), torch.nn.Tanh(), torch.nn.Linear(4, 2)).double()
    assert VJP(net, x=X)
    assert not any(parameter.grad is not None for parameter in net.parameters())


@pytest.mark.whole
def test_a_wrong_gradient_in_a_parameter_of_a_module():
    torch = pytest.importorskip("torch")

    class Scaled(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = torch.nn.Parameter(torch.ones(12, dtype=torch.float64))

        def forward(self, u):
            return u * (self.weight + self.weight.detach())

    result = VJP(Scaled(), x=X)
    assert result.gaps[0] == "every entry of x['parameters']['weight']: vjp is too small, by a factor of 0.5"


@pytest.mark.whole
def test_functions_of_jax():
    jax = pytest.importorskip("jax")
    jnp = jax.numpy
    wave = lambda u: (jnp.sin(u[0]) * u[1], jnp.sum(u[0]))
    with jax.enable_x64(True):
        x = jnp.asarray(X)
        assert VJP(wave, x=(x, 2 * x)) and JVP(wave, x=(x, 2 * x))
        assert VJP(jax.jit(jnp.exp), x=x * (1 + 0.5j))
        assert VJP(jnp.sin, lambda u, g: 1.001 * jnp.cos(u) * g, x).verdict == "disagrees"
    assert VJP(jax.jit(jnp.sin), x=X)  # in single precision
