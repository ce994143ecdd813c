"""A torch network and a solve in one training loop. Run: python examples/torch_training.py [cells]

Heat flows through a plate whose conductivity depends on the material in an unknown way. What is seen are materials and
steady temperatures, never a conductivity. A network of torch gives the conductivity of each face, `elliptic_solver`
the temperature, and an optimizer of torch trains the network through the solves: one adjoint solve a plate.
"""

import sys

import numpy as np
import torch

import sparsedp as dp

cells = int(sys.argv[1]) if len(sys.argv) > 1 else 32
grid = dp.Grid((cells, cells), size=1.0)
solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
to_faces = dp.average(grid)
x, y = grid.centres()


def law(material):
    """The conductivity that nobody knows."""
    return 0.5 + 2.0 / (1.0 + np.exp(-4.0 * material))


materials = [to_faces(np.sin(a * np.pi * x) * np.cos(b * np.pi * y)) for a, b in ((1, 1), (2, 1), (1, 3))]
heating = np.ones(grid.shape)
seen = [solve(law(material), heating) for material in materials]

torch.manual_seed(0)
network = torch.nn.Sequential(
    torch.nn.Linear(1, 16), torch.nn.Tanh(), torch.nn.Linear(16, 1), torch.nn.Softplus()
).double()
temperature = dp.interop.to_torch(lambda k: solve(k, heating))
optimizer = torch.optim.LBFGS(network.parameters(), max_iter=10, line_search_fn="strong_wolfe")
inputs = [torch.from_numpy(material)[:, None] for material in materials]
wanted = [torch.from_numpy(u) for u in seen]


def loss():
    optimizer.zero_grad()
    misses = [temperature(network(m)[:, 0]) / u - 1.0 for m, u in zip(inputs, wanted)]
    value = sum(torch.mean(miss**2) for miss in misses) / len(misses)
    value.backward()
    return value


for epoch in range(4):
    print(f"epoch {epoch}: relative error of the temperatures {optimizer.step(loss).item() ** 0.5:.5f}")

print("material  conductivity  by the network")
for material in (-0.8, -0.4, 0.0, 0.4, 0.8):
    found = network(torch.tensor([[material]], dtype=torch.float64)).item()
    print(f"{material:8.1f} {law(material):13.2f} {found:15.2f}")
