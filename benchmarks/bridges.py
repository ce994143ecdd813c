"""What a call through a bridge costs on top of the function: a sum of squares of a Laplacian on 8 x 8 cells.

The value, and the value with its gradient, each by this library alone, by torch or JAX through a bridge, and the other
way. All rows of a block run in turn, and the smallest time of a single call counts. Beside what is on top stands what
the other library takes for a node or a call back that does nothing.

Run ``python -m benchmarks.bridges`` in the root of the repository.
"""

from importlib.util import find_spec
from timeit import repeat

import autograd.numpy as anp
import numpy as np

import sparsedp as dp

LIMITS = {"torch": 100, "jax": 300}  # of one call [us]
GRID = dp.Grid((8, 8))
L = dp.laplacian(GRID)
U = np.cos(np.arange(64.0)).reshape(GRID.shape)


def loss(u):
    return anp.sum(L(u) ** 2)


def best(calls, rounds=400):
    """Smallest time of one call of each [us], run in turn."""
    for call in calls.values():
        call()
    times = [[min(repeat(call, number=1, repeat=3)) for call in calls.values()] for _ in range(rounds)]
    return dict(zip(calls, 1e6 * np.min(times, axis=0), strict=True))


def of_torch():
    """torch: ours there, a node that does nothing, theirs here."""
    import torch

    class Nothing(torch.autograd.Function):
        """A node that hands its argument on."""

        @staticmethod
        def forward(ctx, u):
            return u.clone()

        @staticmethod
        def backward(ctx, g):
            return g

    there, here = dp.interop.to_torch(loss), dp.interop.from_torch(lambda u: torch.sum(u**2))
    u, moving = torch.tensor(U), torch.tensor(U, requires_grad=True)
    return {
        "to_torch, value": lambda: there(u),
        "to_torch, gradient": lambda: torch.autograd.grad(there(moving), moving),
        "nothing, value": lambda: Nothing.apply(u),
        "nothing, gradient": lambda: torch.autograd.grad(Nothing.apply(moving).sum(), moving),
        "from_torch, value": lambda: here(U),
        "from_torch, gradient": lambda: dp.value_and_grad(here)(U),
    }


def of_jax():
    """JAX under jit: ours there, a call back that does nothing, theirs here."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    bridge = dp.interop.to_jax(loss)
    there, slope = jax.jit(bridge), jax.jit(jax.grad(bridge))
    nothing = jax.jit(lambda u: jax.pure_callback(lambda u: np.float64(0), jax.ShapeDtypeStruct((), float), u))
    here, u = dp.interop.from_jax(lambda u: jnp.sum(u**2)), jnp.asarray(U)
    return {
        "to_jax, value": lambda: there(u).block_until_ready(),
        "to_jax, gradient": lambda: slope(u).block_until_ready(),
        "nothing, value": lambda: nothing(u).block_until_ready(),
        "from_jax, value": lambda: here(U),
        "from_jax, gradient": lambda: dp.value_and_grad(here)(U),
    }


def main():
    for library, calls in (("torch", of_torch), ("jax", of_jax)):
        if find_spec(library) is None:
            print(f"{library} is not installed")
            continue
        times = best({"ours, value": lambda: loss(U), "ours, gradient": lambda: dp.value_and_grad(loss)(U), **calls()})
        for name, time in times.items():
            top = time - times[f"ours, {name.split(', ')[1]}"]
            limit = f"   at most {LIMITS[library]} us" if name == f"to_{library}, value" else ""
            print(f"{name:22} {time:7.1f} us" + (f"   on top {top:7.1f} us{limit}" if name.startswith("to_") else ""))


if __name__ == "__main__":
    main()
