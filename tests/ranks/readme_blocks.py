"""Scenes with ``dp.distribute`` around their grids print what they print on one process, on every rank.

The scenes are the blocks of README.md, the file of docs/guides/ranks_and_ensembles.md, and three more below. Run by
mpirun -n 2 python -m mpi4py tests/ranks/readme_blocks.py
"""

import io
import re
from contextlib import redirect_stdout
from pathlib import Path

from mpi4py import MPI

COMM = MPI.COMM_WORLD
ROOT = Path(__file__).parents[2]
# Each goes on from those before: coefficients and minimize, stiff steps, an incompressible flow.
SCENES = """
```python
sides = {"x": (dp.dirichlet, dp.robin(1.0, 0.5)), "y": dp.neumann}
D = dp.divergence(grid)
ground = dp.elliptic_solver(D, dp.gradient(grid, sides))
to_faces = dp.harmonic_average(grid)
source = np.ones(grid.shape)

def misfit(logk):
    return np.sum((centre(ground(to_faces(np.exp(logk)), source)) - 0.2) ** 2)

best = dp.minimize(misfit, np.zeros(grid.shape), maxiter=30)
print("pressure fitted:", best.value < 1e-9)
```

```text
pressure fitted: True
```

```python
L = dp.laplacian(grid, boundary=dp.dirichlet)
react = lambda u, p: p["growth"] * u * (1 - u)
step = dp.stepper("imex", react, 0.01, linear=(L, lambda p: p["nu"]))

def mass(params):
    u = dp.rollout(step, 0.1 * np.ones(grid.shape), params, 100)
    return np.mean(u)

value, slopes = dp.value_and_grad(mass)({"nu": 0.01, "growth": 5.0})
print(f"mass at t = 1: {value:.4f}, in nu {slopes['nu']:.3f}, in growth {slopes['growth']:.4f}")
```

```text
mass at t = 1: 0.7199, in nu -10.676, in growth 0.0727
```

```python
room = dp.Grid((32, 32), size=1.0)
carry = dp.transport(room, "semi_lagrangian")
carry_wind = dp.transport(room, "semi_lagrangian", dp.dirichlet, of="faces")
project, to_faces, up = dp.projection(room), dp.average(room), room.join(0.0, 1.0)

def step(state, _):
    smoke, wind = state
    smoke = carry(smoke, wind, 0.05)
    return smoke, project(carry_wind(wind, wind, 0.05) + 0.05 * up * to_faces(smoke))

def height(smoke):
    end, _ = dp.rollout(step, (smoke, np.zeros(room.faces.size)), None, 20)
    return np.sum(room.centres()[1] * end) / np.sum(end)

x, y = room.centres()
puff = np.exp(-((x - 0.5) ** 2 + (y - 0.3) ** 2) / 0.01)
value, gradient = dp.value_and_grad(height)(puff)
print(f"the smoke rises from {np.sum(y * puff) / np.sum(puff):.3f} to {value:.3f}")
print("gradient against finite differences:", dp.check.gradient(height, puff).verdict)
```

```text
the smoke rises from 0.300 to 0.390
gradient against finite differences: agrees
```
"""


def blocks(text):
    """Return (code, printed text) of the python blocks that are followed by what they print."""
    return re.findall(r"```python\n((?:(?!```).)*)```\n\n```text\n(.*?)```", text, re.DOTALL)


def of_the_pages():
    """Return the blocks of README.md, and the whole file of the guide."""
    readme = blocks((ROOT / "README.md").read_text(encoding="utf-8"))
    guide = blocks((ROOT / "docs" / "guides" / "ranks_and_ensembles.md").read_text(encoding="utf-8"))
    whole_files = [block for block in guide if "dp.distribute(" in block[0]]
    assert len(readme) == 2 and len(whole_files) == 1
    return readme, whole_files


def distributed(code):
    """Return the code with every grid on ranks."""
    return re.sub(r"(?<!distribute\()dp\.Grid\(\((.*?)\), size=1\.0\)", r"dp.distribute(dp.Grid((\1), size=1.0))", code)


def run(scenes, names):
    """Run blocks one after the other, and compare what they print."""
    for code, expected in scenes:
        printed = io.StringIO()
        with redirect_stdout(printed):
            exec(distributed(code), names)
        first_prints = "is_first" in code and COMM.rank > 0
        assert printed.getvalue() == ("" if first_prints else expected), (printed.getvalue(), expected)
    assert names["grid"].layout is not None


def main():
    """Run all scenes."""
    readme, whole_files = of_the_pages()
    run([*readme, *blocks(SCENES)], {})
    run(whole_files, {})


if __name__ == "__main__":
    main()
    COMM.Barrier()
    if COMM.rank == 0:
        print("all agree")
