"""Ten tasks of people who come from elsewhere: by hand, as they wrote them, and with what the library has for them now.

Both ways run and give the same. The table counts lines of code of the user; it must not grow.
"""

import sys
import warnings
from importlib.util import find_spec

import autograd.numpy as np
import numpy
import pytest

import sparsedp as dp

GRID = dp.Grid((8, 6), size=(2.0, 1.0), periodic=(True, False))


def scene():
    """What every task begins with."""
    solve = dp.inverse(-dp.laplacian(GRID, dp.dirichlet))
    x, y = GRID.centres()

    def loss(b):
        return np.sum(solve(b) ** 2)

    return {"np": np, "dp": dp, "grid": GRID, "solve": solve, "x": x, "y": y, "loss": loss, "start": np.sin(x) + y}


# task: (library that it needs, by hand, now). Each leaves what it found in `result`.
TASKS = {
    "a loss in a training loop of PyTorch": (
        "torch",
        """
import torch

class Loss(torch.autograd.Function):
    @staticmethod
    def forward(ctx, b):
        value, gradient = dp.value_and_grad(loss)(b.detach().numpy())
        ctx.save_for_backward(torch.from_numpy(gradient))
        return torch.tensor(value, dtype=b.dtype)
    @staticmethod
    def backward(ctx, g):
        (gradient,) = ctx.saved_tensors
        return g * gradient

b = torch.tensor(start, requires_grad=True)
Loss.apply(b).backward()
result = b.grad.numpy()
""",
        """
import torch

b = torch.tensor(start, requires_grad=True)
dp.interop.to_torch(loss)(b).backward()
result = b.grad.numpy()
""",
    ),
    "a loss under jax.jit and jax.grad": (
        "jax",
        """
import jax
jax.config.update("jax_enable_x64", True)

kinds = jax.ShapeDtypeStruct((), float), jax.ShapeDtypeStruct(start.shape, float)
both = lambda b: tuple(map(np.asarray, dp.value_and_grad(loss)(np.asarray(b))))

@jax.custom_vjp
def bridged(b):
    return jax.pure_callback(both, kinds, b)[0]

bridged.defvjp(lambda b: jax.pure_callback(both, kinds, b), lambda gradient, g: (g * gradient,))
result = np.asarray(jax.jit(jax.grad(bridged))(start))
""",
        """
import jax
jax.config.update("jax_enable_x64", True)

result = np.asarray(jax.jit(jax.grad(dp.interop.to_jax(loss, np.float64(0.0))))(start))
""",
    ),
    "scipy.optimize on a dict of arrays": (
        "scipy",
        """
from scipy.optimize import minimize

unknowns = {"shift": 0.5, "b": start}
far = lambda p: loss(p["b"] - 1.0) + (p["shift"] - 2.0) ** 2

def pack(p):
    return np.concatenate([np.array([p["shift"]]), p["b"].ravel()])

def unpack(vector):
    return {"shift": vector[0], "b": vector[1:].reshape(start.shape)}

def flat(vector):
    value, slopes = dp.value_and_grad(far)(unpack(vector))
    return value, pack(slopes)

result = unpack(minimize(flat, pack(unknowns), jac=True, method="L-BFGS-B").x)["shift"]
""",
        """
from scipy.optimize import minimize

far = lambda p: loss(p["b"] - 1.0) + (p["shift"] - 2.0) ** 2
vector, unflatten = dp.flatten({"shift": 0.5, "b": start})
flat = dp.value_and_grad(lambda x: far(unflatten(x)))
result = unflatten(minimize(flat, vector, jac=True, method="L-BFGS-B").x)["shift"]
""",
    ),
    "coefficients of elements on a mesh": (
        "skfem",
        """
import scipy.sparse, skfem
from skfem.models.poisson import laplace, mass

basis = skfem.Basis(skfem.MeshTri.init_circle(2), skfem.ElementTriP1())
entries, n = laplace.coo_data(basis), basis.N
fixed, b = 0.1 * mass.assemble(basis), np.ones(n)
element = np.arange(entries.data.size) % basis.mesh.nelements
rows, columns = entries.indices
keys, slot = np.unique(rows.astype(np.int64) * n + columns, return_inverse=True)
pattern = scipy.sparse.csr_array((np.ones(keys.size), np.divmod(keys, n)), shape=(n, n))
adding = scipy.sparse.csr_array((np.ones(slot.size), (slot, np.arange(slot.size))))
add, matrix = dp.from_matrix(adding), dp.matrix_solver(pattern)
rest = np.asarray(fixed.tocsr()[np.divmod(keys, n)]).ravel()
compliance = lambda k: np.sum(b * matrix(add(entries.data * k[element]) + rest, b))
result = dp.grad(compliance)(np.ones(basis.mesh.nelements))
""",
        """
import skfem
from skfem.models.poisson import laplace, mass

basis = skfem.Basis(skfem.MeshTri.init_circle(2), skfem.ElementTriP1())
stiff, fixed, b = laplace.coo_data(basis), 0.1 * mass.coo_data(basis).data, np.ones(basis.N)
element = np.arange(stiff.data.size) % basis.mesh.nelements
matrix = dp.matrix_solver.from_coo(*stiff.indices)
compliance = lambda k: np.sum(b * matrix(stiff.data * k[element] + fixed, b))
result = dp.grad(compliance)(np.ones(basis.mesh.nelements))
""",
    ),
    "an operator inside PyLops": (
        "pylops",
        """
import pylops

class Heat(pylops.LinearOperator):
    def __init__(self, op):
        super().__init__(dtype=op.dtype, shape=op.shape)
        self.op = op
    def _matvec(self, u):
        return self.op(u.reshape(self.op.domain.shape)).ravel()
    def _rmatvec(self, g):
        return self.op.T(g.reshape(self.op.codomain.shape)).ravel()

result = (Heat(dp.gradient(grid)).H @ pylops.Diagonal(np.arange(104.0)) @ Heat(dp.gradient(grid))) @ start.ravel()
""",
        """
import pylops

G = pylops.LinearOperator(Op=dp.gradient(grid).to_scipy())
result = (G.H @ pylops.Diagonal(np.arange(104.0)) @ G) @ start.ravel()
""",
    ),
    "fields in a file, with their grid": (
        "numpy",
        """
faces = dp.gradient(grid)(start)
with open("fields.npz", "wb") as file:
    widths = {f"widths{axis}": line for axis, line in enumerate(grid.widths)}
    numpy.savez(file, u=start, v=faces, periodic=grid.periodic, origin=grid.origin, **widths)
with numpy.load("fields.npz") as file:
    widths = [file[f"widths{axis}"] for axis in range(len(file["origin"]))]
    shape, origin = tuple(map(len, widths)), file["origin"].tolist()
    again = dp.Grid(shape, spacing=widths, origin=origin, periodic=list(map(bool, file["periodic"])))
    result = (again == grid) * dp.divergence(again)(file["v"])
""",
        """
dp.save("fields.npz", grid, u=start, v=dp.gradient(grid)(start))
again, fields = dp.load("fields.npz")
result = (again == grid) * dp.divergence(again)(fields["v"])
""",
    ),
    "a picture as a field": (
        "PIL",
        """
from PIL import Image

picture = Image.open("picture.png").convert("L")
shades = numpy.asarray(picture, float) / 255
result = numpy.ascontiguousarray(shades[::-1].T)
""",
        """
result = dp.from_image("picture.png")
""",
    ),
    "three states of a long run": (
        "numpy",
        """
kept, wanted = [], (50, 100, 150)
cool = lambda u, nu: u + 0.001 * nu * dp.laplacian(grid)(u)

def looked_at(nu):
    u, kept = start, []
    for i in range(1, 151):
        u = cool(u, nu)
        if i in wanted:
            kept.append(u)
    return sum(np.sum(u**2) for u in kept)

result = dp.grad(looked_at)(1.0)
""",
        """
cool = lambda u, nu: u + 0.001 * nu * dp.laplacian(grid)(u)
states = lambda nu: dp.rollout(cool, start, nu, 150, keep=[50, 100, 150])
result = dp.grad(lambda nu: np.sum(states(nu) ** 2))(1.0)
""",
    ),
    "a regularizer that keeps edges, walls left out": (
        "numpy",
        """
G, inside, eps = dp.gradient(grid), dp.interior(grid), 0.1

def variation(u):
    total = 0.0
    for axis, slope in enumerate(grid.split(G(u) ** 2)):
        if grid.periodic[axis]:
            below, above, many = slope, np.roll(slope, -1, axis), 2.0
        else:
            below, above = (slope[:, :-1], slope[:, 1:]) if axis else (slope[:-1], slope[1:])
            open_faces = 2.0 * np.ones(grid.shape[axis])
            open_faces[[0, -1]] = 1.0
            many = open_faces.reshape([-1 if a == axis else 1 for a in range(grid.dim)])
        total = total + (below + above) / many
    return np.sum(grid.volumes * (np.sqrt(total + eps**2) - eps))

result = dp.grad(variation)(start)
""",
        """
result = dp.grad(dp.total_variation(grid, 0.1))(start)
""",
    ),
    "an array of xarray, its axes as they come": (
        "xarray",
        """
import xarray

array = xarray.DataArray(numpy.arange(48.0).reshape(6, 8), coords={"y": y[0], "x": x[:, 0]}, dims=("y", "x"))
if set(array.dims) != {"x", "y"}:
    raise ValueError("other dimensions")
for axis, name in enumerate(("x", "y")):
    if not numpy.allclose(array[name].values, grid.coordinates(axis)):
        raise ValueError(f"other places along {name}")
result = loss(numpy.array(array.transpose("x", "y").values))
""",
        """
import xarray

array = xarray.DataArray(numpy.arange(48.0).reshape(6, 8), coords={"y": y[0], "x": x[:, 0]}, dims=("y", "x"))
result = loss(dp.interop.from_xarray(grid, array))
""",
    ),
}

LINES = {  # of the user: by hand, now
    "a loss in a training loop of PyTorch": (14, 4),
    "a loss under jax.jit and jax.grad": (9, 3),
    "scipy.optimize on a dict of arrays": (11, 5),
    "coefficients of elements on a mesh": (14, 8),
    "an operator inside PyLops": (10, 3),
    "fields in a file, with their grid": (9, 3),
    "a picture as a field": (4, 1),
    "three states of a long run": (10, 3),
    "a regularizer that keeps edges, walls left out": (14, 1),
    "an array of xarray, its axes as they come": (8, 3),
}


def lines(code):
    return sum(bool(line.strip()) for line in code.splitlines())


@pytest.fixture(autouse=True)
def precision_of_jax():
    """Programs below set it for the process, in which tests of its default follow."""
    yield
    if "jax" in sys.modules:
        sys.modules["jax"].config.update("jax_enable_x64", False)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("task", TASKS)
def test_both_ways_give_the_same(task, tmp_path, monkeypatch):
    library, by_hand, now = TASKS[task]
    if find_spec(library) is None:
        pytest.skip(f"{library} is not installed")
    monkeypatch.chdir(tmp_path)
    if library == "PIL":
        from PIL import Image

        shades = numpy.arange(48, dtype=numpy.uint8).reshape(6, 8)
        Image.fromarray(shades).save("picture.png")
    results = []
    for code in (by_hand, now):
        names = scene() | {"numpy": numpy}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of other libraries
            exec(code, names)
        results.append(numpy.asarray(names["result"]))
    assert numpy.any(results[0]) and numpy.allclose(*results, rtol=1e-6, atol=1e-12)


def test_lines_of_the_user():
    assert len(TASKS) == 10
    assert {task: (lines(by_hand), lines(now)) for task, (_, by_hand, now) in TASKS.items()} == LINES
