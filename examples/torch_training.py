r"""
A torch network and a solve in one training loop
================================================

An unmeasured law, learned from its consequences.

Heat flows through plates whose conductivity depends on their material in an unknown way. What is seen are materials and
steady temperatures, never a conductivity. A network of torch stands for the law, a solver of this library for the
physics, and an optimizer of torch trains the network through the solves: one adjoint solve for each plate.

Run it: ``python examples/torch_training.py [cells] [--out FOLDER]``; it needs torch
"""

import argparse
from pathlib import Path

import numpy as np
import torch

import sparsedp as dp

parser = argparse.ArgumentParser(description="A torch network, trained through solves.")
parser.add_argument("cells", nargs="?", type=int, default=32, help="cells along an axis")
parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw a picture into this folder")
options = parser.parse_args()

# %%
# Plates
# ------
# Each plate is heated evenly and cold at its edges. With the conductivity :math:`k` its temperature obeys
#
# .. math:: -\nabla \cdot (k \, \nabla u) = 1, \qquad u = 0 \text{ on the edges} .
#
# On the grid this is :math:`-D \, \text{diag}(k) \, G \, u = b`, with one :math:`k` for each face between two cells.
# `dp.elliptic_solver` solves it for any :math:`k`, and is differentiable in :math:`k`.

grid = dp.Grid((options.cells, options.cells), size=1.0)
solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
heating = np.ones(grid.shape)

# %%
# The law
# -------
# A material is a number between -1 and 1 in each cell, three plates have three patterns of it, and the conductivity
# grows with it along an S. We use this law to make up what is seen, and then forget it.


def law(material):
    """Return the true conductivity, which the network does not know."""
    return 0.5 + 2.0 / (1.0 + np.exp(-4.0 * material))


x, y = grid.centres()
to_faces = dp.average(grid)
patterns = (1, 1), (2, 1), (1, 3)
materials = [to_faces(np.sin(a * np.pi * x) * np.cos(b * np.pi * y)) for a, b in patterns]
temperatures = [solve(law(material), heating) for material in materials]

# %%
# The network
# -----------
# One number in, one number out, 16 in between. Softplus, :math:`\log (1 + e^z)`, keeps the conductivity positive;
# otherwise there is no steady temperature. Before training, the law is a guess.

torch.manual_seed(0)
network = torch.nn.Sequential(
    torch.nn.Linear(1, 16),
    torch.nn.Tanh(),
    torch.nn.Linear(16, 1),
    torch.nn.Softplus(),
).double()


def learned(values):
    """The network's conductivity of some materials, as numbers."""
    with torch.no_grad():
        return network(torch.tensor(values, dtype=torch.float64)[:, None])[:, 0].numpy()


scale = np.linspace(-1.0, 1.0, 101)
untrained = learned(scale)

# %%
# The bridge
# ----------
# `dp.interop.to_torch` makes a function of tensors of any function of arrays. In the middle of torch's chain of
# derivatives it does what every operator here does: it takes the cotangent :math:`g = \partial J / \partial u` and
# gives back that of :math:`k`. With the adjoint temperature :math:`\lambda`,
#
# .. math:: (-D \, \text{diag}(k) \, G)^T \lambda = g, \qquad
#           \frac{\partial J}{\partial k_f} = (D^T \lambda)_f \, (G u)_f ,
#
# for each face :math:`f`. Torch propagates it to the weights.

temperature = dp.interop.to_torch(lambda k: solve(k, heating))
inputs = [torch.from_numpy(material)[:, None] for material in materials]
wanted = [torch.from_numpy(u) for u in temperatures]

# %%
# Training
# --------
# The loss is the mean square of relative errors, so that cells near the cold edges count as much as the warm middle.
# The optimizer is torch's own L-BFGS, and it never learns that a partial differential equation is in there.

optimizer = torch.optim.LBFGS(network.parameters(), max_iter=10, line_search_fn="strong_wolfe")


def loss():
    """Mean squared relative error of the temperatures, with its gradient in the weights."""
    optimizer.zero_grad()
    total = 0.0
    for material, u in zip(inputs, wanted):
        conductivity = network(material)[:, 0]
        miss = temperature(conductivity) / u - 1.0
        total = total + torch.mean(miss**2)
    value = total / len(inputs)
    value.backward()
    return value


for epoch in range(4):
    before = optimizer.step(loss)  # torch returns the loss before its steps
    print(f"epoch {epoch}: relative error of the temperatures {before.item() ** 0.5:.5f}")

# %%
# What it has learned
# -------------------
# No conductivity was ever shown to the network. It has the law all the same, since temperatures follow from it.

print("material  conductivity  by the network")
points = np.array([-0.8, -0.4, 0.0, 0.4, 0.8])
for material, conductivity in zip(points, learned(points)):
    print(f"{material:8.1f} {law(material):13.2f} {conductivity:15.2f}")

# %%
# The picture
# -----------
# The law before and after training, and one of the plates.
#
# Exercises
# ---------
# 1. Add 1 % noise to the temperatures. Where does the law get worst, and why there?
# 2. Train with the first plate alone, and look at the error on the other two.
# 3. Give the network no Softplus. What does the solver say of a negative conductivity?

if options.out:
    from matplotlib import pyplot, style

    style.use("tableau-colorblind10")
    picture, (left, middle, right) = pyplot.subplots(1, 3, figsize=(14, 3.8), layout="constrained")
    left.plot(scale, law(scale), color="black", linewidth=4, alpha=0.3, label="true")
    left.plot(scale, untrained, ":", label="before training")
    left.plot(scale, learned(scale), label="learned")
    left.set(title="the law", xlabel="material", ylabel="conductivity")
    left.legend(frameon=False)
    a, b = patterns[1]
    dp.plot(grid, np.sin(a * np.pi * x) * np.cos(b * np.pi * y), ax=middle, title="material of the second plate")
    dp.plot(grid, temperatures[1], ax=right, title="its temperature", cmap="inferno")
    options.out.mkdir(parents=True, exist_ok=True)
    picture.savefig(options.out / "torch_training.png", dpi=120)
