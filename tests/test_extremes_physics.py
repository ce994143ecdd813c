"""The matrix of extreme cases for what physicists come with: stiff steps, steady flow, obstacles, waves, laws, TV.

Each piece is a scene on any grid, with its arguments; each row is asked of all of them. What a piece alone can get
wrong (a level set, a tensor that is not positive, a step too long) stands in the tests of the piece.
"""

from typing import Any, NamedTuple

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

from extremes import KINDS, agree, same_bits  # isort: skip

NONFINITE = dp.errors.NonFiniteError
SHAPE = dp.errors.ShapeError


class Piece(NamedTuple):
    """A scene: what it makes of its arguments on a grid."""

    make: Any  # grid -> run(*args)
    args: str  # a letter each: c cells > 0, f faces of both signs, k faces > 0, n nodes > 0
    linear: tuple = ()  # numbers of the arguments that it is linear in
    smallest: int = 0  # number of cells that it needs between two walls


def stiff(method, tolerance=None):
    def make(grid):
        L = dp.laplacian(grid)
        return dp.stepper(method, lambda u, p: L(u) - p * u, 0.1, tolerance=tolerance)

    return make


def fields(method):
    """Two fields, one with a term of fourth order."""

    def make(grid):
        L = dp.laplacian(grid)
        linear = {"u": (L, 0.1), "v": dp.matrix_function(L, lambda e: -(e**2) - e)}
        step = dp.stepper(method, lambda x, p: {"u": -p * x["u"], "v": p * x["u"]}, 0.1, linear=linear)

        def run(u, v, p):
            end = step({"u": u, "v": v}, p)
            return end["u"] + 2.0 * end["v"]

        return run

    return make


def steady(grid):
    L = dp.laplacian(grid)
    return lambda k, b: dp.steady(lambda u, k, b: k * u - 0.1 * L(u) + 0.1 * u**3 - b, np.zeros(grid.shape), k, b)


def force(grid):
    on = dp.forces(grid, cells=np.ones(grid.shape, bool))
    return lambda v, p: on(v, p, 0.1)


def obstacle(grid):
    friction = dp.brinkman(grid)
    return lambda level: anp.log1p(friction(level))  # it goes over many decades


def flow(grid):
    """Friction, and heat that drives the flow and has a source."""
    mean = dp.average(grid)
    heat = {"diffusivity": 0.1, "source": lambda s, p: 0.1 * s["heat"]}
    step = dp.flow_step(
        grid, 0.01, 0.1, force=lambda v, s, p: mean(s["heat"]), friction=lambda p: p, scalars={"heat": heat}
    )

    def run(v, u, drag):
        end = step(step(step.start(v, drag, {"heat": u}), drag), drag)
        return anp.concatenate([end["v"], anp.ravel(end["s"]["heat"])])

    return run


def elliptic(turn, **options):
    """Shifted by a field, complex where `turn` is."""

    def make(grid):
        solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet), **options)
        return lambda k, b, shift: anp.real(solve(k, b, turn * shift)) + anp.imag(solve(k, b, turn * shift))

    return make


def tensor(grid):
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
    mixed = (0.3 + 1.7 * np.eye(grid.dim)).reshape(grid.dim, grid.dim, *[1] * grid.dim)
    return lambda k, b: solve(mixed * k, b, 0.5)


def waves(damped=False, memory=None):
    def make(grid):
        D = dp.divergence(grid)
        G = dp.gradient(grid)
        inside = dp.interior(grid)
        cells = 1 if min(grid.shape, default=0) and not all(grid.periodic) else 0
        damping = dp.sponge(grid, cells, 1.0) if damped else None
        rates = (lambda v, c: -c * D(v)), (lambda p, c: -inside(G(p)))
        step = dp.stepper("leapfrog", rates, 0.1, damping=damping)
        return lambda p, v, c: dp.rollout(step, (p, v), c, 3, memory=memory)[0]

    return make


def law(scheme, speed, **options):
    def make(grid):
        flux = lambda u, p, axis: u**2 / 2
        source = lambda u, p: -p * u
        return dp.conservation_law(grid, flux, speed, scheme=scheme, source=source, **options)

    return make


def fluid(viscosity=0.1, density=1.0):
    """A flow with media that vary: the parameter is a field."""

    def make(grid):
        step = dp.flow_step(grid, 0.001, viscosity, density=density)
        return lambda v, p: step(step.start(v, p), p)["v"]

    return make


def cut(level=None, condition=dp.dirichlet):
    """Poisson in the part of the grid where the level is positive: an argument, or a ball."""

    def make(grid):
        def inside(*x):
            return 0.3 * max(grid.shape) - anp.sqrt(sum((a - 0.4 * n) ** 2 for a, n in zip(x, grid.shape)))

        if level == "argument":
            return lambda b, nodes: dp.cut_cells(
                grid, nodes - 0.6, dp.dirichlet, condition, "direct", nullspace="project"
            ).solve(b)
        return dp.cut_cells(grid, inside, dp.neumann, condition, nullspace="project").solve

    return make


def water(grid):
    law = dp.shallow_water(grid, lambda p: p)

    def run(h, q, ground):
        return law(anp.stack([h, *[q - 0.5] * grid.dim]), ground)

    return run


def order_4(grid):
    return dp.inverse(dp.identity(grid.cells) - 0.1 * dp.laplacian(grid, dp.dirichlet, order=4))


RUSANOV = lambda u, p, axis: anp.abs(u) + 1.0
HLL = lambda u, p, axis: (u - 1.0, u + 1.0)

PIECES = {
    "radau": Piece(stiff("radau"), "cc", (0,)),
    "radau, tolerance": Piece(stiff("radau", 1e-4), "cc"),
    "rodas5p": Piece(stiff("rodas5p"), "cc", (0,)),
    "rodas5p, tolerance": Piece(stiff("rodas5p", 1e-4), "cc"),
    "imex tree": Piece(fields("imex"), "ccc"),
    "etdrk4 function": Piece(fields("etdrk4"), "ccc"),
    "steady": Piece(steady, "cc"),
    "forces": Piece(force, "fc"),
    "flux": Piece(lambda grid: dp.flux(grid, np.ones(grid.shape, bool)), "f", (0,)),
    "brinkman": Piece(obstacle, "f"),
    "flow": Piece(flow, "fck"),
    "shift field": Piece(elliptic(1.0), "kcc", (1,)),
    "complex shift": Piece(elliptic(1.0 - 0.2j), "kcc", (1,)),
    "tensor": Piece(tensor, "cc", (1,)),
    "helmholtz": Piece(elliptic(-0.5 - 0.1j, method="krylov", preconditioner="shifted_laplace"), "kcc"),
    "leapfrog": Piece(waves(), "cfc", (0, 1)),
    "sponge": Piece(waves(damped=True), "cfc", (0, 1)),
    "reversed": Piece(waves(memory="reverse"), "cfc", (0, 1)),
    "limited, rusanov": Piece(law("van_leer", RUSANOV), "cc"),
    "limited, hll": Piece(law("van_leer", HLL), "cc"),
    "upwind, hll": Piece(law("upwind", HLL), "cc"),
    "positive": Piece(law("van_leer", RUSANOV, positive={"u": lambda u, p: u}), "cc"),
    "shallow water": Piece(water, "ccc"),
    "order 4": Piece(order_4, "c", (0,), smallest=4),
    "varying viscosity": Piece(fluid(viscosity=lambda p: p), "fc"),
    "varying density": Piece(fluid(density=lambda p: p), "fc"),
    "weighted projection": Piece(dp.projection, "fc", (0,)),
    "cut cells": Piece(cut(), "c", (0,)),
    "cut cells, neumann": Piece(cut(condition=dp.neumann), "c", (0,)),
    "cut cells, level": Piece(cut("argument"), "cn", (0,)),
    "total variation": Piece(lambda grid: dp.total_variation(grid, 0.1), "c"),
    "smoothness": Piece(dp.smoothness, "c"),
}
ZERO_REFUSED = {
    "tensor": "k must be positive definite in every cell",
    "positive": "the u of a conservation_law must be > 0, got 0 in cell",
    "varying density": "density of flow_step must be > 0, got 0",
    "weighted projection": "density of projection must be > 0, got 0",
}
EVERY = pytest.mark.parametrize("name", PIECES)
SHAPES = [(0,), (0, 3), (1,), (1, 1), (1, 7), (7, 1), (2, 2), (7, 5), (1, 1, 1), (2, 1, 3)]


def scene(name, shape=(5, 4), periodic=False):
    """A piece on a grid, and its arguments."""
    piece = PIECES[name]
    grid = dp.Grid(shape, periodic=periodic)
    rng = np.random.default_rng(5)
    values = {"c": lambda: 0.2 + rng.random(shape), "f": lambda: 0.1 * rng.normal(size=grid.faces.size)}
    values["k"] = lambda: 0.2 + rng.random(grid.faces.size)
    values["n"] = lambda: 0.2 + rng.random(grid.nodes.shape)
    return piece.make(grid), [values[letter]() for letter in piece.args]


def alone(run, args, number):
    """Return a number that depends on one argument."""
    return lambda x: anp.sum(anp.sin(run(*args[:number], x, *args[number + 1 :])))


@pytest.mark.sampled(1)
@EVERY
@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("periodic", [False, True])
def test_every_size_has_its_gradient(name, shape, periodic):
    """No cells, one cell, lines, primes: the gradient is the slope of the value."""
    if not periodic and min(shape) < PIECES[name].smallest:
        with pytest.raises(ValueError, match="needs at least 4 cells between two walls"):
            scene(name, shape)
        return
    run, args = scene(name, shape, periodic)
    for number, x in enumerate(args):
        loss = alone(run, args, number)
        t = np.cos(np.arange(x.size)).reshape(x.shape)
        slope = dp.grad(loss)(x)
        assert slope.shape == x.shape and np.all(np.isfinite(slope))
        h = 1e-6 if abs(np.sum(slope * t)) > 100 else 1e-5  # steep beside tiny cells
        wanted = (loss(x + h * t) - loss(x - h * t)) / (2 * h)
        assert np.sum(slope * t) == pytest.approx(wanted, rel=1e-4, abs=1e-6 * (1 + np.sum(np.abs(slope))))


@pytest.mark.sampled(1)
@EVERY
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused(name, bad):
    run, args = scene(name)
    for number, x in enumerate(args):
        x = x.copy()
        x.flat[0 if name in ("forces", "flux") else x.size // 2] = bad  # what stands inside a box cancels
        loss = alone(run, args, number)
        for act in (loss, dp.grad(loss)):
            if name == "flux":  # an Operator lets it through
                assert not np.all(np.isfinite(act(x)))
                continue
            with np.errstate(all="ignore"), pytest.raises(NONFINITE):
                act(x)


@pytest.mark.sampled(1)
@EVERY
@pytest.mark.parametrize("kind", KINDS)
def test_kinds_of_arrays(name, kind):
    run, args = scene(name)
    for number, x in enumerate(args):
        given = KINDS[kind](x)
        if kind == "bool" and PIECES[name].args[number] == "c" and number == len(args) - 1:
            continue  # params, of which the functions of the user take what they like
        if name in ("leapfrog", "sponge", "reversed") and number < 2 and kind in ("int64", "bool"):
            with pytest.raises(SHAPE, match="the step made a floating value of an array of dtype"):
                alone(run, args, number)(given)
            continue
        act = lambda x, number=number: np.asarray(run(*args[:number], x, *args[number + 1 :]))
        if kind != "float32":
            before = given.copy()
            assert np.array_equal(act(given), act(np.ascontiguousarray(given, dtype=float)))
            assert np.array_equal(given, before)
        else:
            agree(act(given), act(given.astype(float)), 1e-5)
        if kind not in ("int64", "bool"):
            single, plain = (dp.grad(alone(run, args, number))(one) for one in (given, given.astype(float)))
            assert single.dtype == given.dtype
            agree(single, plain, {"float32": 1e-3, "other byte order": 1e-15}.get(kind, 0.0))


@EVERY
def test_zero_everywhere(name):
    """At rest nothing happens, and there is a gradient."""
    run, args = scene(name)
    args = [0.0 * x for x in args]
    if name in ZERO_REFUSED:
        with pytest.raises(ValueError, match=ZERO_REFUSED[name]):
            run(*args)
        return
    value = np.asarray(run(*args))
    assert np.all(value[()] == 0.0) or name == "brinkman"
    for number, x in enumerate(args):
        if name != "steady":  # 0 = 0 there, refused in words
            assert np.all(np.isfinite(dp.grad(alone(run, args, number))(x)))


@pytest.mark.parametrize("name", [name for name, piece in PIECES.items() if piece.linear])
@pytest.mark.parametrize("exponent", [-900, 900])
def test_units_change_no_bit(name, exponent):
    run, args = scene(name)
    far = [np.ldexp(x, exponent) if number in PIECES[name].linear else x for number, x in enumerate(args)]
    same_bits(np.asarray(run(*far)), np.ldexp(np.asarray(run(*args)), exponent))


@EVERY
@pytest.mark.parametrize("factor", [1e-200, 1e200])
def test_far_from_one(name, factor):
    """A finite value with a finite gradient, or an error of ours."""
    run, args = scene(name)
    for number, x in enumerate(args):
        loss = lambda x, number=number: anp.sum(run(*args[:number], x, *args[number + 1 :]))
        for act in (loss, dp.grad(loss)):
            try:
                with np.errstate(all="ignore"):
                    found = act(factor * x)
            except dp.errors.SparsedpError:
                continue
            assert np.all(np.isfinite(found))


@EVERY
def test_wrong_shapes_and_masks(name):
    run, args = scene(name)
    for number, letter in enumerate(PIECES[name].args):
        if letter == "c" and number == len(args) - 1 and number:
            continue  # params or the last of the fields: broadcast by the functions of the user, or checked alike
        for wrong in (args[number][:-1], np.ma.array(args[number])):
            if name == "shallow water" and np.ma.isMA(wrong):
                continue  # NumPy drops the mask where the scene stacks its fields
            with pytest.raises((SHAPE, TypeError, ValueError)):
                run(*args[:number], wrong, *args[number + 1 :])


# ---- numbers that settle a piece -----------------------------------------------------------------------------------

GRID = dp.Grid((3, 4))
U = np.ones((3, 4))
V = np.zeros(GRID.faces.size)
TRANSPORT = dp.conservation_law(GRID, lambda u, p, axis: u, lambda u, p, axis: abs(u), inflow=1e300, boundary=dp.inflow)
ON = dp.forces(GRID, cells=np.ones((3, 4), bool))
SPLIT = lambda **options: dp.minimize(lambda x: anp.sum(x**2), U, method="admm", weight=0.1, maxiter=1, **options)
HEAT = dp.flow_step(GRID, 0.1, scalars={"heat": {"source": lambda s, p: p}})
REFUSED = [
    (lambda: ON(V + 1e200, U, 1.0), NONFINITE, "the result of forces must be finite, got "),
    (lambda: HEAT(HEAT.start(V, 1.0, {"heat": U}), np.inf), NONFINITE, "the rate of 'heat' must be finite, got 12"),
    (lambda: SPLIT(prox=0), TypeError, "admm, as prox, takes a function, got int; write lambda v, t: ..."),
    (lambda: SPLIT(operator=np.eye(3)), TypeError, "admm, as operator, takes a function, got ndarray; write lambda x"),
    (
        lambda: dp.stepper("radau", lambda u, p: -u, 0.1, tolerance=1e-3, floor=np.inf),
        ValueError,
        "floor must hold finite numbers >= 0, in the units of u, got inf; write 1e-3",
    ),
    (
        lambda: dp.smoothness(GRID)(1e200 * np.arange(12.0).reshape(3, 4)),
        NONFINITE,
        "the squared slope in smoothness must be finite, got 12 that are NaN or infinite, the first at (0, 0)",
    ),
    (
        lambda: dp.total_variation(GRID, 0.1)(np.full((3, 4), np.nan)),
        NONFINITE,
        "the squared slope in total_variation must be finite, got 12 that are NaN or infinite, the first at (0, 0)",
    ),
]


@pytest.mark.parametrize("act, kind, message", REFUSED)
def test_refused(act, kind, message):
    with np.errstate(all="ignore"), pytest.raises(kind) as caught:
        act()
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize("wrong", [-1.0, np.nan, np.inf])
def test_numbers_out_of_range(wrong):
    with pytest.raises(ValueError, match="the viscosity of forces must be"):
        ON(V, U, wrong)
    told = "> 0, got -1; write cfl=0.4" if wrong < 0 else "finite, got "
    with pytest.raises(ValueError, match=f"cfl of time_step must be {told}"):
        TRANSPORT.time_step(U, None, wrong)


def test_a_rate_beyond_the_range_of_floats():
    burgers = dp.conservation_law(GRID, lambda u, p, axis: u**2, lambda u, p, axis: abs(u))
    with (
        np.errstate(all="ignore"),
        pytest.raises(NONFINITE, match="the rate of a conservation_law must be finite"),
    ):
        burgers(1e200 * np.arange(12.0).reshape(3, 4))


def test_a_batch_of_flows_is_a_flow_each():
    """The Courant number of each counts; the first state has the form of the next."""
    grid = dp.Grid((4, 3), size=1.0)
    step = dp.flow_step(grid, 0.02, 0.01)
    v = 0.3 * np.random.default_rng(3).normal(size=(2, grid.faces.size))
    ends = dp.rollout(step, step.start(v), None, 3)
    for number, one in enumerate(v):
        wanted = dp.rollout(step, step.start(one), None, 3)
        for part in "vpa":
            agree(ends[part][number], wanted[part], 1e-9)
    with pytest.raises(dp.errors.UnstableStepError, match="flow_step is unstable for this velocity with dt = 0.02"):
        step(step.start(v * [[0.1], [300.0]]))


# ---- solids and jumps ----------------------------------------------------------------------------------------------


@pytest.mark.sampled(1)
@pytest.mark.parametrize("shape", [(5, 4), (1, 4), (3, 3, 2)], ids=str)
@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("left", [0, 1, None])
def test_solids_everywhere(shape, periodic, left):
    """Few cells are open: values and gradients stay finite, and where nothing is open nothing happens."""
    grid = dp.Grid(shape, periodic=periodic)
    rng = np.random.default_rng(2)
    solid = np.arange(np.prod(shape)).reshape(shape) >= (np.prod(shape) if left is None else left)
    u = 1.0 + rng.random(shape)
    v = 0.1 * rng.normal(size=grid.faces.size)
    D = dp.divergence(grid)
    L = dp.laplacian(grid, solid=solid)
    solve = dp.elliptic_solver(D, dp.gradient(grid, solid=solid))
    on = dp.forces(grid, solid)
    tv = dp.total_variation(grid, 0.1, solid)
    box = dp.flux(grid, solid)
    step = dp.flow_step(grid, 0.01, 0.1, solid=solid, friction=lambda p: p, scalars={"heat": {"diffusivity": 0.1}})

    def flow(v, u):
        return step(step.start(v, v**2, {"heat": u}), v**2)["v"]

    runs = {
        "forces": (lambda v, u: on(v, u, 0.1), v, u),
        "flux": (box, v),
        "total variation": (tv, u),
        "flow": (flow, v, u),
        "shift": (lambda k, b, s: solve(k, b, s), 1.0 + np.abs(v), u, u),
        "complex shift": (lambda k, b, s: anp.imag(solve(k, b, 1j * s)), 1.0 + np.abs(v), u, u),
        "steady": (lambda b: dp.steady(lambda u, b: u - L(u) + u**3 - b, 0.0 * u, b), u),
    }
    for name, (run, *args) in runs.items():
        value, slopes = dp.value_and_grad(lambda args, run=run: anp.sum(run(*args) ** 2))(tuple(args))
        assert np.isfinite(value) and all(np.all(np.isfinite(slope)) for slope in slopes), name
        if left == 0 and name in ("total variation", "flow"):
            assert value == 0.0 and not any(np.any(slope) for slope in slopes), name


@pytest.mark.parametrize("turn", [1.0, 1j, -1.0, -1.0 - 0.1j])
def test_coefficients_over_eight_decades(turn):
    """A field as shift, real, complex, and of waves: backward error of LU."""
    grid = dp.Grid((8, 7))
    rng = np.random.default_rng(4)
    D = dp.divergence(grid)
    G = dp.gradient(grid, dp.dirichlet)
    k, shift = (10.0 ** rng.uniform(-4, 4, shape) for shape in (grid.faces.size, grid.shape))
    b = rng.normal(size=grid.shape)
    x = dp.elliptic_solver(D, G)(k, b, turn * shift).ravel()
    A = np.diag((turn * shift).ravel()) - (D.matrix * k) @ G.matrix.toarray()
    left = np.linalg.norm(A @ x - b.ravel())
    assert left <= 1e-12 * np.linalg.norm(np.abs(A) @ np.abs(x) + np.abs(b.ravel()))
