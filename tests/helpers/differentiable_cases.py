"""Differentiable callables with the arrays that they take, for tests in which the caller reuses those arrays.

CASES maps a name to a builder and the public names that the case covers. The builder returns the callable and, for each
of its arguments, a function from a seed to an array or a tree.
"""

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp

import sparsedp as dp

GRID = dp.Grid((5, 4), size=(1.0, 0.8))
LINE = dp.Grid(6, size=1.0)
CALLS = 3


def field(shape, seed, low=0.5, high=1.5):
    return np.random.default_rng(seed).uniform(low, high, shape)


PLACES = sp.diags_array([np.ones(5), np.ones(6), np.ones(5)], offsets=[-1, 0, 1]).tocsr()


def entries(seed):
    """Return the entries of a diagonally dominant matrix on PLACES, row by row."""
    rows = np.repeat(np.arange(6), np.diff(PLACES.indptr))
    columns = PLACES.indices
    return field(16, seed, -1, 1) + 4.0 * (rows == columns)


CASES = {}


def case(*names):
    """Public names that the case is for; its own name is the name of the function."""

    def add(make):
        CASES[make.__name__] = make, names
        return make

    return add


@case("matrix_solver")
def matrix_solver():
    return dp.matrix_solver(PLACES), [entries, lambda s: field(6, s)]


@case("conservation_law")
def conservation_law():
    law = dp.conservation_law(
        GRID,
        lambda u, params, axis: params * u**2,
        lambda u, params, axis: anp.max(anp.abs(2 * params * u), axis=0),
        source=lambda u, params: -params * u,
        equilibrium=field((2, *GRID.shape), 0),
    )
    return law, [lambda s: field((2, *GRID.shape), s), lambda s: field((), s)]


@case("shallow_water")
def shallow_water():
    law = dp.shallow_water(GRID, lambda p: p, source=lambda u, p: -p * u)
    return law, [lambda s: 3.0 + field((3, *GRID.shape), s), lambda s: 0.1 * field(GRID.shape, s)]


@case("ensemble")
def ensemble():
    total = dp.ensemble(lambda x, scene: anp.sum((x[0] * x[1]) ** 2 * scene), [0.5, 2.0])
    return lambda u, v: total((u, v)), [lambda s: field(6, s), lambda s: field(6, s)]


@case("steady")
def steady():
    def residual(x, p):
        return p["s"] - x - 0.1 * p["k"] * x**3

    return lambda p: dp.steady(residual, np.ones(6), p), [lambda s: {"k": field(6, s), "s": field(6, s + 50)}]


@case("sponge")
def leapfrog():
    D = dp.divergence(LINE)
    G = dp.gradient(LINE)
    rates = (lambda v, c: -c * D(v)), (lambda p, c: -G(p))
    step = dp.stepper("leapfrog", rates, 0.01, damping=dp.sponge(LINE, 2, 1.0))
    start = lambda s: (field(LINE.shape, s), field(LINE.faces.shape, s))
    return lambda state, c: step(state, c)[0], [start, lambda s: field((), s)]


@case("elliptic_solver")
def elliptic_solver():
    solve = dp.elliptic_solver(dp.divergence(GRID), dp.gradient(GRID, dp.dirichlet))
    return solve, [lambda s: field(GRID.faces.shape, s), lambda s: field(GRID.shape, s), lambda s: field((), s)]


@case("elliptic_solver")
def elliptic_solver_large():
    grid = dp.Grid((100, 90))  # arrays above the size up to which each call has a copy of its own
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet), method="direct")
    return solve, [lambda s: field(grid.faces.shape, s), lambda s: field(grid.shape, s)]


@case("implicit")
def implicit():
    root = dp.implicit(lambda x, p, q: p["a"] * x + 0.1 * x**3 - q * p["b"][::-1])
    return (lambda guess, p, q: root(guess, p, q)), [
        lambda s: field(6, s),
        lambda s: {"a": field(6, s), "b": field(6, s + 50)},
        lambda s: field(6, s),
    ]


@case("implicit")
def implicit_with_indices():
    root = dp.implicit(lambda x, p, order: x + 0.1 * x**3 - p[order])
    return (lambda p, order: root(np.ones(4), p, order)), [
        lambda s: field(4, s),
        lambda s: np.random.default_rng(s).permutation(4),
    ]


@case("inverse")
def inverse_from_a_start():
    inv = dp.inverse(-dp.laplacian(GRID, dp.dirichlet), method="krylov")
    return (lambda b, start: inv(b, start=start)), [lambda s: field(GRID.shape, s), lambda s: field(GRID.shape, s)]


@case("inverse")
def inverse_unrolled():
    inv = dp.inverse(-dp.laplacian(GRID, dp.dirichlet), method="krylov", diff="unrolled")
    return (lambda b, start: inv(b, start=start)), [lambda s: field(GRID.shape, s), lambda s: field(GRID.shape, s)]


@case("forces")
def forces():
    on = dp.forces(GRID, cells=np.s_[1:3, :2])
    return on, [lambda s: field(GRID.faces.shape, s), lambda s: field(GRID.shape, s), lambda s: field((), s)]


@case("convection")
def convection():
    return dp.convection(GRID), [lambda s: field(GRID.faces.shape, s), lambda s: field(GRID.faces.shape, s)]


def transported(scheme, **options):
    def make():
        move = dp.transport(GRID, scheme, boundary=dp.dirichlet, **options)
        shapes = (2, *GRID.shape) if options.get("velocity") == "cells" else GRID.faces.shape
        return (lambda u, v, dt, inflow: move(u, v, dt, inflow)), [
            lambda s: field(GRID.shape, s),
            lambda s: field(shapes, s, -1, 1),
            lambda s: field((), s, 0.02, 0.04),
            lambda s: field(move.walls.shape, s),
        ]

    make.__name__ = f"transport_{scheme}"
    return make


for scheme in ("upwind", "van_leer", "semi_lagrangian", "maccormack"):
    case("transport")(transported(scheme, velocity="cells" if scheme == "maccormack" else "faces"))


STEPPERS = {
    "euler": {},
    "rk4": {},
    "backward_euler": {},
    "crank_nicolson": {},
    "tr_bdf2": {},
    "radau": {},
    "rodas5p": {},
    "imex": {"linear": dp.laplacian(LINE)},
    "etdrk4": {"linear": dp.laplacian(LINE)},
}


def stepped(method, options):
    def make():
        step = dp.stepper(method, lambda u, p: p["k"] * u * (1 - u) + p["s"], 0.05, **options)
        return step, [lambda s: field(6, s), lambda s: {"k": field(6, s), "s": field(6, s + 50)}]

    make.__name__ = f"stepper_{method}"
    return make


for method, options in STEPPERS.items():
    case("stepper")(stepped(method, options))


def stepped_linear(method):
    def make():
        step = dp.stepper(method, None, 0.01, linear=dp.laplacian(LINE), source=lambda p: p["s"])
        return (lambda u, s: step(u, {"s": s})), [lambda s: field(6, s), lambda s: field(6, s)]

    make.__name__ = f"stepper_linear_{method}"
    return make


for method in ("heun", "backward_euler", "crank_nicolson", "tr_bdf2"):
    case("stepper")(stepped_linear(method))


@case("stepper")
def stepper_with_tolerance():
    step = dp.stepper("tr_bdf2", lambda u, p: -p * u, 0.002, tolerance=1e-2)
    return step, [lambda s: field(6, s), lambda s: field(6, s)]


def rolled(name, **options):
    def make():
        def step(u, p, x):
            return u + 0.1 * p["a"] * u**2 + x[p["order"]]

        def run(u, a, x, order):
            return dp.rollout(step, u, {"a": a, "order": order}, 5, inputs=x, **options)

        return run, [
            lambda s: field(6, s),
            lambda s: field(6, s),
            lambda s: field((5, 6), s),
            lambda s: np.random.default_rng(s).permutation(6),
        ]

    make.__name__ = f"rollout_{name}"
    return make


for name, options in {"all": {}, "in_little": {"memory": 1000}, "trajectory": {"keep": "all"}}.items():
    case("rollout")(rolled(name, **options))


@case("rollout")
def rollout_of_a_chain():
    return (lambda u, p: dp.rollout(lambda u, p: u + 0.1 * p * anp.sin(u), u, p, 12)), [
        lambda s: field(6, s),
        lambda s: field(6, s),
    ]


@case("rollout")
def rollout_of_transport():
    move = dp.transport(LINE)
    return (lambda u, v: dp.rollout(lambda u, v: move(u, v, 0.01), u, v, 6)), [
        lambda s: field(6, s),
        lambda s: field(7, s),
    ]


@case("flow_step")
def flow_step():
    step = dp.flow_step(GRID, 0.01, viscosity=0.01, force=lambda v, p: p * v)

    def start(s):
        return {"v": dp.projection(GRID)(field(GRID.faces.shape, s)), "p": field(GRID.shape, s), "a": field(49, s)}

    return (lambda state, p: step(state, p)["v"]), [start, lambda s: field(GRID.faces.shape, s)]


@case("network")
def dense():
    return (lambda x, w, b: dp.network.dense({"weight": w, "bias": b}, x)), [
        lambda s: field((3, 4), s),
        lambda s: field((4, 2), s),
        lambda s: field(2, s),
    ]


@case("network")
def convolution():
    return (lambda x, w, b: dp.network.convolution({"weight": w, "bias": b}, x)), [
        lambda s: field((2, 3, 8), s),
        lambda s: field((2, 3, 3), s),
        lambda s: field(2, s),
    ]


@case("Grid", "Space")
def join():
    return GRID.faces.join, [lambda s: field((6, 4), s), lambda s: field((5, 5), s)]


@case("differentiable")
def rule_of_a_user():
    """A rule of x, a weight, a tuple, a list, a dict, and an option."""

    def forward(x, w, pair, several, named, power=1.0):
        return x**2 * w + pair[0] * x + several[0] * x + named["c"] * x**3 + power * x

    def vjp(nums, ans, x, w, pair, several, named, power):
        slopes = {
            0: lambda g: g * (2 * x * w + pair[0] + several[0] + 3 * named["c"] * x**2 + power),
            1: lambda g: g * x**2,
        }
        return lambda g: tuple(slopes[num](g) for num in nums)

    def jvp(nums, tangents, ans, x, w, pair, several, named, power):
        slopes = {0: 2 * x * w + pair[0] + several[0] + 3 * named["c"] * x**2 + power, 1: x**2}
        return sum(slopes[num] * t for num, t in zip(nums, tangents, strict=True))

    rule = dp.differentiable("of a user", forward, vjp, jvp, keywords=("power",))
    return (lambda x, w, a, b, c, p: rule(x, w, (a, "word"), [b], {"c": c}, power=p)), [
        lambda s, n=n: field(4, s + 20 * n) for n in range(6)
    ]


@case()
def functions_of_autograd():
    def fun(x, w, keep, order, y):
        picked = x[order] * w + anp.where(keep > 0.9, x, w * x) + x[(order, None)][:, 0] / w
        return picked**y + anp.maximum(x, w) * anp.exp(x) + anp.einsum("i,i->i", w, x) + anp.dot(w, x)

    return fun, [
        lambda s: field(6, s),
        lambda s: field(6, s),
        lambda s: field(6, s),
        lambda s: np.random.default_rng(s).permutation(6),
        lambda s: field(6, s),
    ]


CONSTANT = {("rule_of_a_user", number) for number in (2, 3, 4, 5)}  # no derivative in these
