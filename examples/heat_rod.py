"""Heat in a rod: one operator, one gradient, one finite-difference table. Run: python examples/heat_rod.py [cells]"""

import sys

import autograd.numpy as np
from autograd.extend import defvjp, primitive

import sparsedp as dp

rod = dp.Grid(int(sys.argv[1]) if len(sys.argv) > 1 else 64, size=1.0)  # 1 m long, both ends held at 0 degrees
L = dp.laplacian(rod, boundary=dp.dirichlet).explicit()
print(L)

# The whole idea in three lines: apply, transpose, defvjp.
# What flows forward through A flows backward through its transpose; autograd does the rest.
apply = primitive(lambda u: L.matrix @ u)
transpose = lambda g: L.matrix.T @ g
defvjp(apply, lambda ans, u: transpose)

(x,) = rod.centres()
bump = np.exp(-(((x - 0.3) / 0.1) ** 2))
_, by_hand = dp.value_and_grad(lambda u: np.sum(apply(u) ** 2))(bump)
_, built_in = dp.value_and_grad(lambda u: np.sum(L(u) ** 2))(bump)  # an Operator carries these lines with it
print(f"three lines against L(u): difference {np.max(np.abs(by_hand - built_in)) / np.max(np.abs(built_in)):.0e}\n")

# The rod cools. Explicit steps are stable while dt <= h^2 / 2.
dt, steps = 0.4 * (1.0 / rod.shape[0]) ** 2, 3 * rod.shape[0]


def cool(u):
    """Temperature now -> temperature after all steps (diffusivity 1)."""
    for _ in range(steps):
        u = u + dt * L(u)
    return u


wanted = cool(np.exp(-(((x - 0.6) / 0.1) ** 2)))


def loss(u):
    """How far is the cooled rod from the wanted one?"""
    return np.sum(rod.volumes * (cool(u) - wanted) ** 2)


print(f"gradient of the loss after {steps} steps, against finite differences:")
print(dp.check.gradient(loss, bump))
best = dp.minimize(loss, bump, maxiter=20)
print(f"\nloss {loss(bump):.2e} -> {best.value:.2e} in {len(best.history)} entries of history")
