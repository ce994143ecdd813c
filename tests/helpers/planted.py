"""Random composed scenes, each call under its own name, in one of which a wrong derivative can be planted."""

import autograd.numpy as anp
import numpy as np
from autograd.extend import defvjp, primitive

import sparsedp as dp

KINDS = ("rule", "operator", "inverse", "elliptic", "matrix", "function", "operator given")


def scene(seed, error=0.0, jvp=False):
    """Return (loss, x, name of the call whose VJP or JVP has the relative error `error`)."""
    rng = np.random.default_rng(seed)
    grid = dp.Grid(tuple(map(int, rng.integers(3, 7, 2))), spacing=float(rng.uniform(0.5, 2.0)))
    many = int(rng.integers(2, 5))
    planted = int(rng.integers(many))
    kinds = ["rule" if jvp and place == planted else KINDS[rng.integers(len(KINDS))] for place in range(many)]
    made = [
        call(kind, f"{kind}{place}", grid, rng, error * (place == planted), jvp) for place, kind in enumerate(kinds)
    ]
    weights = rng.standard_normal(grid.shape)

    def loss(u):
        for act, _ in made:
            u = act(u)
        return anp.sum(weights * u**2) + anp.sum(u)

    return loss, rng.standard_normal(grid.shape), made[planted][1]


def call(kind, name, grid, rng, error, jvp):
    """(function on fields, its name in a verdict)."""
    if kind == "rule":
        return rule(name, rng, error, jvp), name
    if kind == "function":
        return function(name, error), name
    op = diffusion(name, grid, error)
    if kind == "operator":
        return op, name
    if kind == "operator given":
        turned = dp.from_matrix(op.explicit().T.matrix * (1 + error))
        act = lambda u: op.matrix @ u
        return dp.from_functions(
            lambda u: act(u.reshape(-1)).reshape(u.shape), turned_on(turned), grid.cells, grid.cells, name
        ), name
    if kind == "inverse":
        return dp.inverse(op, "krylov", rtol=1e-12), f"inverse({name})"
    if kind == "elliptic":
        D = scaled(f"{name} D", dp.divergence(grid), error)
        G = dp.gradient(grid, dp.dirichlet)
        solve = dp.elliptic_solver(D, G, "direct")
        faces = 1.0 + 0.2 * np.cos(np.arange(grid.faces.size))
        to_faces = dp.average(grid)
        return lambda u: solve(anp.exp(0.1 * to_faces(u)) * faces, 1.0 + 0.1 * U(grid), 1.0), f"{name} D"
    place = rng.permutation(grid.cells.size)
    mixed = dp.from_matrix(
        np.eye(grid.cells.size)[place] + np.diag(np.full(grid.cells.size, 2.5)), grid.cells, grid.cells
    )
    return scaled(name, mixed, error), name


def U(grid):
    return np.sin(np.arange(grid.cells.size)).reshape(grid.shape)


def turned_on(op):
    return lambda g: (op @ g.reshape(-1)).reshape(g.shape)


def scaled(name, op, error):
    """An operator under another name, with a transpose that is off."""
    return dp.from_functions(op.apply, lambda g: (1 + error) * op.T.apply(g), op.domain, op.codomain, name)


def diffusion(name, grid, error):
    return scaled(name, dp.identity(grid.cells) - 0.1 * dp.laplacian(grid, dp.dirichlet), error)


def rule(name, rng, error, jvp):
    back, ahead = (0.0, error) if jvp else (error, 0.0)
    if rng.integers(2):
        return dp.differentiable(
            name,
            lambda u: np.sin(u) + 0.1 * u**2,
            lambda nums, ans, u: lambda g: ((1 + back) * g * (anp.cos(u) + 0.2 * u),),
            lambda nums, tangents, ans, u: (1 + ahead) * tangents[0] * (anp.cos(u) + 0.2 * u),
        )
    half = dp.differentiable(  # two arguments, one of them wrong
        name,
        lambda a, b: a * b + a,
        lambda nums, ans, a, b: lambda g: tuple(g * (b + 1) if num == 0 else (1 + back) * g * a for num in nums),
        lambda nums, ts, ans, a, b: sum(
            t * (b + 1) if num == 0 else (1 + ahead) * t * a for num, t in zip(nums, ts, strict=True)
        ),
    )
    return lambda u: half(anp.tanh(u), 0.5 + 0.3 * u)


def function(name, error):
    """A function of autograd's own kind, as a user may have registered it."""

    def forward(u):
        return np.exp(0.2 * u)

    forward.__name__ = name
    act = primitive(forward)
    defvjp(act, lambda ans, u: lambda g: (1 + error) * 0.2 * g * ans)
    return act
