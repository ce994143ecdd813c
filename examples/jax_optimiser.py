"""An optimizer of JAX around a rollout. Run: python examples/jax_optimiser.py [cells]

A drop of ink is carried by a wind and spreads. Where did it fall, and how fast does it spread? JAX makes the drop, the
rollout is one more function of JAX, under jit and grad, and optax's Adam finds both from a picture of the end.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import optax

import sparsedp as dp

cells = int(sys.argv[1]) if len(sys.argv) > 1 else 32
jax.config.update("jax_enable_x64", True)
grid = dp.Grid((cells, cells), size=1.0)
carry, spread = dp.transport(grid), dp.laplacian(grid)
x, y = grid.centres()
wind = dp.curl(grid)(0.3 * np.outer(np.hanning(cells + 1), np.hanning(cells + 1)))
dt = 0.2 / cells


def step(ink, diffusivity):
    return carry(ink, wind, dt) + dt * diffusivity * spread(ink)


def end(start, diffusivity):
    return dp.rollout(step, start, diffusivity, 2 * cells)


def drop(place):
    return jnp.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / 0.02)


picture = end(np.asarray(drop((0.35, 0.6))), 0.01)
transported = dp.interop.to_jax(end, like=picture)


@jax.jit
@jax.value_and_grad
def loss(unknown):
    return jnp.mean((transported(drop(unknown["place"]), jnp.exp(unknown["log"])) - picture) ** 2)


unknown = {"place": jnp.array([0.5, 0.5]), "log": jnp.log(0.003)}
optimizer = optax.adam(0.05)
state = optimizer.init(unknown)
for iteration in range(101):
    value, slope = loss(unknown)
    if iteration % 25 == 0:
        print(f"iteration {iteration:3d}: loss {value:.3e}")
    change, state = optimizer.update(slope, state)
    unknown = optax.apply_updates(unknown, change)

print(f"it fell at ({unknown['place'][0]:.3f}, {unknown['place'][1]:.3f}), true (0.35, 0.60)")
print(f"diffusivity {float(jnp.exp(unknown['log'])):.4f}, true 0.01")
