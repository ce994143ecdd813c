"""Time steps on ranks compared with one process: every method of stepper.

mpirun -n 2 python -m mpi4py tests/ranks/steps_on_ranks.py
"""

from functools import partial

import autograd.numpy as anp
import numpy as np
from flow_on_ranks import COMM, as_array, derivatives, in_blocks, on_both, refused

import sparsedp as dp

PLAIN = dp.Grid((5, 6), size=(1.0, 2.0))
UNEVEN = dp.Grid((6, 4), spacing=[np.linspace(1, 2, 6), np.linspace(2, 1, 4)], periodic=(False, True))
RNG = np.random.default_rng(0)


def linear(method):
    """Steps of c L u, with a free mean and without."""

    def make(grid):
        steps = [dp.stepper(method, dp.laplacian(grid, b), 1e-3, rtol=1e-13) for b in (dp.neumann, dp.dirichlet)]
        return lambda u, k: steps[1](steps[0](u, k), 0.3 * k)

    return make


def rates(method, **options):
    """Steps of a rate that is not linear."""

    def make(grid):
        L = dp.laplacian(grid)
        return dp.stepper(method, lambda u, k: k * L(anp.tanh(u)), 1e-2, **options)

    return make


def stiff(method, **options):
    """Return a stepper of a nonlinear rate, a linear part and a source."""

    def make(grid):
        L = dp.laplacian(grid)
        V = grid.volumes
        given = dict(linear=(L, lambda k: k), source=lambda k: k * V, **options)
        return dp.stepper(method, lambda u, k: k * anp.tanh(u), 1e-2, rtol=1e-13, **given)

    return make


def tree(grid):
    """Fields of a tree, one of them without a linear part."""
    step = dp.stepper(
        "imex",
        lambda u, k: {"a": u["b"] * k, "b": -u["a"]},
        1e-2,
        linear={"a": (dp.laplacian(grid), lambda k: k), "b": None},
        rtol=1e-13,
    )
    return lambda u, k: step({"a": u, "b": k * u}, k)["a"]


def leapfrog(grid):
    """Waves that die out at the ends."""
    D = dp.divergence(grid)
    G = dp.gradient(grid, dp.dirichlet)
    step = dp.stepper("leapfrog", (lambda v, k: k * D(v), lambda p, k: k * G(p)), 0.05, damping=dp.sponge(grid, 2, 1.0))
    return lambda u, k: step((u, G(u) * k), k)[0]


def root(grid):
    """A root, whose residual is moved by a field."""
    L = dp.laplacian(grid)
    A = dp.average(grid)
    solve = dp.implicit(lambda x, u, k: x - u - k * 1e-2 * L(anp.tanh(x)) + 0.1 * anp.sum(A(x) ** 2) * u, rtol=1e-13)
    return lambda u, k: solve(np.zeros(grid.shape), u, k)


EVERYWHERE = {
    **{f"{method}, linear": linear(method) for method in ("euler", "heun", "ssprk3", "rk4")},
    **{f"{method}, linear": linear(method) for method in ("backward_euler", "crank_nicolson", "tr_bdf2")},
    **{method: rates(method) for method in ("euler", "heun", "ssprk3", "rk4")},
    "heun with a tolerance": rates("heun", tolerance=1e-4),
    "imex": stiff("imex"),
    "imex with a tolerance": stiff("imex", tolerance=1e-3),
    "imex of a tree": tree,
    "leapfrog": leapfrog,
    "implicit": root,
    **{f"{method}, by Newton": rates(method, rtol=1e-13) for method in ("backward_euler", "crank_nicolson", "tr_bdf2")},
}
# Of states that every rank knows; those that lie on ranks are refused by name.
KNOWN_TO_ALL = {
    "etdrk4": lambda grid: dp.stepper("etdrk4", lambda u, k: k * anp.tanh(u), 1e-2, linear=dp.laplacian(grid)),
}


def steps_and_derivatives(name, make, grid, field):
    """Two steps in a rollout and their gradient; of some methods derivatives of all kinds, of one step."""
    u, t = RNG_FIELDS[grid.shape]
    step = make(grid)
    n = 1 if name in BENT else 2
    loss = lambda x: anp.sum(anp.sin(dp.rollout(step, x[0], x[1], n)) ** 2)
    x = (field(grid.cells, u), 0.7)
    along = (field(grid.cells, t), -0.3)
    if name not in BENT:
        value, slopes = dp.value_and_grad(loss)(x)
        return value, *slopes
    value, slopes, tangent, bent = derivatives(loss, x, along)
    return value, *slopes, tangent, *bent


BENT = "rk4", "rk4, linear", "tr_bdf2, linear", "tr_bdf2, by Newton", "imex", "leapfrog", "implicit"
RNG_FIELDS = {grid.shape: RNG.standard_normal((2, *grid.shape)) for grid in (PLAIN, UNEVEN)}


def steps():
    """All methods, of states on ranks, some of whole states too; on the second grid solves weigh rows.

    A root whose residual has a sum in it is found of whole states alone.
    """
    for number, (name, make) in enumerate(EVERYWHERE.items()):
        if make is root:
            fields = (as_array,)
        elif make is tree:
            fields = (as_array, in_blocks)
        else:
            fields = (in_blocks,)
        plain = UNEVEN if number % 2 else PLAIN
        on_both(name, plain, partial(steps_and_derivatives, name, make), fields=fields)


def steps_of_arrays():
    """The same, or the refusal."""
    for name, make in KNOWN_TO_ALL.items():
        on_both(name, PLAIN, partial(steps_and_derivatives, name, make), fields=(as_array,))
        grid = dp.distribute(PLAIN, COMM)
        u = in_blocks(grid.cells, RNG_FIELDS[PLAIN.shape][0])
        words = f"{name}) does not work on a field on ranks; write dp.gather(u) for the whole array"
        refused(TypeError, words, lambda make=make, u=u, grid=grid: make(grid)(u, 0.7))
    grid = dp.distribute(PLAIN, COMM)
    for method in ("radau", "rodas5p"):
        words = f"stepper({method}) does not work on a field on ranks"
        refused(TypeError, words, lambda method=method: rates(method)(grid)(np.ones(PLAIN.shape), 0.7))


def intermediate_states():
    """All states, and what a function makes of each: on ranks fields apart, numbers in stacks."""

    def compute(grid, field):
        L = dp.laplacian(grid, dp.dirichlet)
        step = lambda state, k: {"u": state["u"] + 0.01 * k * L(anp.tanh(state["u"])), "t": state["t"] + k}
        start = lambda x: ({"u": x[0], "t": 0.0}, x[1], 4)
        every = lambda x: dp.rollout(step, *start(x), keep="all")
        seen = lambda i, state: (i * state["u"], anp.sum(state["u"] ** 2), state["t"])

        def loss(x):
            states = every(x)
            looks = dp.rollout(step, *start(x), keep=seen, memory=3000)
            first = sum(anp.sum(u**2) * (i + 1) for i, u in enumerate(states["u"])) + anp.sum(states["t"] ** 2)
            return first + sum(anp.sum(anp.sin(u)) * total + t for u, total, t in looks)

        u, t = RNG_FIELDS[grid.shape]
        x = (field(grid.cells, u), 0.7)
        along = (field(grid.cells, t), -0.3)
        value, slopes, tangent, bent = derivatives(loss, x, along)
        return value, *slopes, tangent, *bent, *every(x)["u"], every(x)["t"]

    on_both("states", PLAIN, compute)


if __name__ == "__main__":
    intermediate_states()
    steps()
    steps_of_arrays()
    if COMM.rank == 0:
        print("all agree")
