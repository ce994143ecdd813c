"""dp.jit of each building block: programs give the values and gradients of the functions at other arguments."""

import autograd.numpy as anp
import numpy as np
import pytest
from differentiable_cases import CASES, CONSTANT, LINE, field

import sparsedp as dp
from sparsedp._utils.pytree import leaves, placed
from sparsedp.autodiff.tape import sample

RING = dp.Grid(12, periodic=True, size=1.0)
SQUARE = dp.Grid((6, 5), size=(1.0, 0.8))
SOLID = np.zeros(SQUARE.shape, bool)
SOLID[2:4, 1:3] = True
CHANNEL = {"x": (dp.inflow, dp.outflow), "y": (dp.no_slip, dp.free_slip)}
CHANNEL_SOLID = np.zeros(SQUARE.shape, bool)
CHANNEL_SOLID[2, 2] = True
SCENES = dict.fromkeys(CASES)


def scene(make):
    """Add a scene: a function that returns a callable and, for each argument, a function from a seed to a tree."""
    SCENES[make.__name__] = make
    return make


def of(space, low=0.5, high=1.5):
    shape = getattr(space, "shape", space)
    return lambda seed: field(shape, seed, low, high)


# ---- time steps ------------------------------------------------------------------------------------------------------


def logistic(u, p):
    return p["k"] * u * (1 - u) + p["s"]


def logistic_params(n):
    return lambda seed: {"k": field(n, seed), "s": field(n, seed + 50)}


def stepped(name, method, rate, dt, makers, **options):
    def make():
        return dp.stepper(method, rate, dt, **options), makers

    make.__name__ = name
    scene(make)


for method in ("heun", "ssprk3"):
    stepped(f"stepper_{method}", method, logistic, 0.05, [of(6), logistic_params(6)])
for method in ("heun", "rk4", "tr_bdf2", "imex", "radau", "backward_euler"):
    linear = {"linear": dp.laplacian(LINE)} if method == "imex" else {}
    makers = [of(6), logistic_params(6)]
    stepped(f"stepper_{method}_tolerance", method, logistic, 0.5, makers, tolerance=1e-3, **linear)
for method in ("euler", "rk4", "backward_euler", "imex", "etdrk4"):
    term = (dp.laplacian(LINE), lambda p: p["c"])
    rate = None if method in ("euler", "backward_euler") else (lambda u, p: p["c"] * u**2)
    makers = [of(6), lambda seed: {"c": field((), seed)}]
    stepped(f"stepper_{method}_coefficient", method, rate, 0.005, makers, linear=term)
for method in ("heun", "backward_euler", "etdrk4", "imex", "crank_nicolson"):
    linear = {"linear": dp.laplacian(LINE)} if method in ("etdrk4", "imex") else {}
    makers = [of(6), logistic_params(6)]
    stepped(f"stepper_{method}_dt", method, logistic, lambda p: 0.01 * p["k"][0], makers, **linear)


@scene
def stepper_timed():
    step = dp.stepper("rk4", lambda u, p, t: anp.sin(p * t) * u, 0.1)
    return (lambda u, t, p: step((u, t), p)), [of(6), of(()), of(6)]


@scene
def stepper_breaks():
    rate = lambda u, off, t: anp.where(t < off, 1.0, 0.0) - u
    step = dp.stepper("rk4", rate, 2.0, tolerance=1e-6, breaks=lambda off: [off])
    return (lambda u, off: step((u, 0.0), off)[0]), [of(()), of((), 0.2, 1.8)]


@scene
def stepper_events():
    ground = lambda u, g, t: u[0]
    jump = lambda u, g, t: anp.array([0.0, -0.9 * u[1]])
    step = dp.stepper("rk4", lambda u, g, t: anp.array([u[1], -g]), 1.0, tolerance=1e-6, events=(ground, jump))
    return (lambda h, g: step((anp.array([h, 0.0]), 0.0), 10.0 * g)), [of((), 0.5, 3.0), of(())]


@scene
def stepper_radau_timed():
    step = dp.stepper("radau", lambda u, p, t: -p * u + anp.sin(t), 0.5)
    return (lambda u, t, p: step((u, t), p)), [of(4), of(()), of(4)]


@scene
def matrix_exponential():
    decay = dp.matrix_exponential(0.01 * dp.laplacian(LINE))
    return decay, [of(6)]


# ---- flow ------------------------------------------------------------------------------------------------------------


def flow_scene(name, grid, **options):
    def make():
        step = dp.flow_step(grid, 0.01, **options)

        def run(v, p):
            state = (
                step.start(v, p)
                if "scalars" not in options
                else step.start(v, p, {"s": v[: grid.cells.size].reshape(grid.shape)})
            )
            for _ in range(2):
                state = step(state, p)
            return state

        return run, [of(grid.faces, -1.0, 1.0), lambda s: {"a": field(grid.faces.shape, s), "c": field((), s)}]

    make.__name__ = name
    scene(make)


flow_scene("flow_obstacle", SQUARE, viscosity=0.01, solid=SOLID, force=lambda v, p: p["a"] * v)
flow_scene("flow_friction", SQUARE, viscosity=0.01, friction=lambda p: p["a"])
flow_scene("flow_implicit", SQUARE, viscosity=0.1, implicit=True, force=lambda v, p: p["a"] * v)
flow_scene("flow_viscosity", SQUARE, viscosity=lambda p: 0.01 * p["c"], force=lambda v, p: p["c"])
flow_scene("flow_inflow", SQUARE, viscosity=0.01, boundary=CHANNEL, inflow=lambda p: p["a"], solid=CHANNEL_SOLID)
flow_scene(
    "flow_scalars",
    SQUARE,
    viscosity=0.01,
    scalars={"s": {"diffusivity": 0.01, "source": lambda s, p: p["c"] * s["s"]}},
    force=lambda v, s, p: p["a"] * v,
)


@scene
def flow_walls():
    walls = dp.face_lift(SQUARE, dp.no_slip).domain
    step = dp.flow_step(SQUARE, 0.01, 0.1, walls=lambda p: p)

    def run(v, p):
        state = step(step.start(v, p), p)
        return step(state, 2.0 * p)

    return run, [of(SQUARE.faces, -1.0, 1.0), of(walls)]


@scene
def projection():
    return dp.projection(SQUARE, SOLID), [of(SQUARE.faces, -1.0, 1.0)]


@scene
def forces_with_walls():
    return dp.forces(SQUARE, SOLID), [of(SQUARE.faces, -1.0, 1.0), of(SQUARE), of(())]


@scene
def brinkman():
    return dp.brinkman(SQUARE), [of(SQUARE.faces, -1.0, 1.0)]


@scene
def convection_with_solid():
    return dp.convection(SQUARE, solid=SOLID), [of(SQUARE.faces, -1.0, 1.0), of(SQUARE.faces, -1.0, 1.0)]


for name, limiter in (("upwind", "upwind"), ("default", None)):

    def law(limiter=limiter):
        options = {} if limiter is None else {"scheme": limiter}
        burgers = dp.conservation_law(
            LINE,
            lambda u, p, axis: 0.5 * p * u**2,
            lambda u, p, axis: anp.abs(p * u),
            boundary=(dp.inflow, dp.outflow),
            inflow=lambda p, axis, side: p * anp.ones(1)[0],
            **options,
        )
        return burgers, [of(LINE, -1.0, 1.0), of(())]

    law.__name__ = f"conservation_law_{name}"
    scene(law)


@scene
def conservation_law_positive():
    """Slopes of the same fields are limited in one argument and not in another."""
    amount = {"amount": lambda u, p: u - 0.5 * p}
    law = dp.conservation_law(RING, lambda u, p, axis: p * u**2, lambda u, p, axis: anp.abs(2 * p * u), positive=amount)
    return law, [of(RING, 0.51, 1.0), of((), 0.9, 1.0)]


@scene
def shallow_water():
    """Cells that are dry in one argument and wet in another."""
    law = dp.shallow_water(SQUARE, lambda p: p, boundary=dp.free_slip)

    def start(seed):
        u = np.stack([field(SQUARE.shape, seed + k, -0.5, 1.0) for k in range(3)])
        u[0] = np.maximum(u[0], 0.0)
        return u

    return law, [start, of(SQUARE)]


@scene
def conservation_law_still():
    """Speeds are 0 at some faces, other ones for other arguments."""
    law = dp.conservation_law(RING, lambda u, p, axis: p * u**2, lambda u, p, axis: anp.abs(2 * p * u))

    def start(seed):
        u = field(12, seed, -1.0, 1.0)
        u[seed : seed + 4] = 0.0
        return u

    return law, [start, of(())]


# ---- transport -------------------------------------------------------------------------------------------------------


def transport_scene(name, grid, scheme, boundary, **options):
    def make():
        move = dp.transport(grid, scheme, boundary=boundary, **options)
        velocity = (grid.dim, *grid.shape) if options.get("velocity") == "cells" else grid.faces.shape
        if grid.dim == 1 and options.get("velocity") == "cells":
            velocity = grid.shape
        makers = [of(grid), of(velocity, -1.0, 1.0), of((), 0.01, 0.02)]
        if boundary == dp.dirichlet:
            makers.append(of(move.walls))
        return move, makers

    make.__name__ = name
    scene(make)


for scheme in ("upwind", "van_leer", "semi_lagrangian", "maccormack"):
    transport_scene(f"transport_solid_{scheme}", SQUARE, scheme, dp.dirichlet, solid=SOLID)
    transport_scene(f"transport_out_{scheme}", SQUARE, scheme, dp.neumann)
    transport_scene(f"transport_ring_{scheme}", RING, scheme, None, velocity="cells")


# ---- solvers ---------------------------------------------------------------------------------------------------------


for method in ("direct", "krylov", "multigrid", "auto"):

    def inverse(method=method):
        return dp.inverse(-dp.laplacian(SQUARE, dp.dirichlet), method=method), [of(SQUARE)]

    inverse.__name__ = f"inverse_{method}"
    scene(inverse)

    def elliptic(method=method):
        solve = dp.elliptic_solver(dp.divergence(SQUARE), dp.gradient(SQUARE, dp.dirichlet), method=method)
        mean = dp.harmonic_average(SQUARE)
        return (lambda k, b: solve(mean(k), b)), [of(SQUARE), of(SQUARE)]

    elliptic.__name__ = f"elliptic_{method}"
    scene(elliptic)


@scene
def harmonic_average():
    def coefficient(seed):
        k = field(SQUARE.shape, seed)
        k[seed : seed + 2] = 0.0  # neighbours without a coefficient, at other places for other seeds
        return k

    return dp.harmonic_average(SQUARE), [coefficient]


@scene
def elliptic_tensor():
    solve = dp.elliptic_solver(dp.divergence(SQUARE), dp.gradient(SQUARE, dp.dirichlet))
    eye = np.eye(2)[:, :, None, None]
    return (lambda k, b: solve(k * eye, b)), [of(SQUARE), of(SQUARE)]


@scene
def elliptic_number():
    solve = dp.elliptic_solver(dp.divergence(SQUARE), dp.gradient(SQUARE, dp.dirichlet))
    flux = lambda k, b: solve.flux(k, dp.gradient(SQUARE, dp.dirichlet)(b))
    return (lambda k, b: (solve(k, b), flux(k, b))), [of(()), of(SQUARE)]


@scene
def steady_tree():
    residual = lambda x, p: {"u": x["w"] - x["u"], "w": p - x["u"] * x["w"]}
    return (lambda p, x: dp.steady(residual, {"u": x, "w": x}, 9.0 * p)), [of(()), of((), 2.0, 4.0)]


# ---- others ----------------------------------------------------------------------------------------------------------


@scene
def total_variation():
    return dp.total_variation(SQUARE, 1e-3), [lambda s: 10.0 ** (3 * s) * field(SQUARE.shape, s)]


@scene
def combined_masks():
    inside = lambda u, v: anp.where((u > 0.8) & ~(v > 1.0) | (u < v) ^ (v < 0.7), u, 2.0 * v)
    return inside, [of(20), of(20)]


@scene
def smoothness():
    return dp.smoothness(SQUARE), [of(SQUARE)]


@scene
def from_blackbox():
    return dp.from_blackbox(lambda x: x**2 + np.roll(x, 1)), [of(6)]


@scene
def physical_gradient():
    return dp.physical_gradient(lambda x: x**3, lambda y, x: anp.sign(y) * abs(y) ** (1 / 3)), [of(6)]


@scene
def lift_and_average():
    lift = dp.lift(SQUARE, dp.dirichlet)
    mean = dp.average(SQUARE)
    D = dp.divergence(SQUARE)
    return (lambda w, u: D(lift(w) * mean(u))), [of(lift.domain), of(SQUARE)]


@scene
def sample_at_points():
    points = field((2, 7), 3, 0.1, 0.7).T
    look = dp.sample(SQUARE, points)
    return look, [of(SQUARE)]


@scene
def from_torch():
    torch = pytest.importorskip("torch")
    return dp.interop.from_torch(lambda x: torch.sin(x) ** 2), [of(6)]


@scene
def from_jax():
    pytest.importorskip("jax")
    return dp.interop.from_jax(lambda x, k: k * x**3), [of(6), of(())]


@scene
def guess_of_a_root():
    """The guess decides which of two roots is found."""
    root = dp.implicit(lambda x, p: x**2 - p)
    return (lambda u, p: root(u - 1.0, p)), [of(6), of(())]


@scene
def loop_of_adaptive_steps():
    step = dp.stepper("rk4", lambda u, p: -p * u**2, 1.0, tolerance=1e-5)

    def run(u, p):
        for _ in range(4):
            u = step(u, p)
        return u

    return run, [of(6), of(())]


@scene
def number_of_events():
    """Events: other ones for other arguments."""
    rate = lambda u, p: p * anp.array([anp.cos(3 * u[1]), 1.0])
    step = dp.stepper("rk4", rate, 6.0, tolerance=1e-5, events=lambda u, p: u[0] - 0.3)
    return (lambda u, p: step((anp.array([u - 0.7, 0.0]), 0.0), p)), [of(()), of(())]


# ---- the comparison --------------------------------------------------------------------------------------------------


def loss_of(fun):
    """Return a loss of a list of arguments: a sum of the entries of all results with weights."""

    def loss(args):
        result = fun(*args)
        total = 0.0
        for number, leaf in enumerate(leaves(result)):
            total = total + anp.sum(field(np.shape(sample(leaf)), 100 + number) * leaf)
        return total

    return loss


def compare(name):
    make = SCENES[name] or CASES[name][0]
    fun, makers = make()
    fixed = [maker(0) for maker in makers]
    varied = []
    for place, arg in enumerate(fixed):
        is_floating = all(np.asarray(leaf).dtype.kind == "f" for leaf in leaves(arg))
        if is_floating and (name, place) not in CONSTANT:
            varied.append(place)
    loss = loss_of(lambda *args: fun(*placed(fixed, varied, args)))
    jitted = dp.jit(loss, check=False)  # so that a frozen value is found here
    for seed in (0, 1, 2):
        args = [makers[place](seed) for place in varied]
        value, gradient = dp.value_and_grad(loss)(args)
        found, slope = dp.value_and_grad(jitted)(args)
        assert found == pytest.approx(value, rel=1e-14)
        assert jitted(args) == found
        for one, other in zip(leaves(gradient), leaves(slope), strict=True):
            one = np.asarray(one)
            if one.dtype.kind == "f":
                np.testing.assert_allclose(other, one, rtol=1e-12, atol=1e-12 * np.max(np.abs(one), initial=0.0))
    assert jitted.forms == 1


# One scene for each kind of repair: checks, masks, Newton's method, error control.
ALWAYS = (
    "leapfrog",
    "conservation_law_still",
    "harmonic_average",
    "brinkman",
    "stepper_radau",
    "guess_of_a_root",
)


@pytest.mark.parametrize("name", ALWAYS)
def test_programs_at_other_arguments(name):
    compare(name)


@pytest.mark.whole
@pytest.mark.parametrize("name", [name for name in SCENES if name not in ALWAYS])
def test_programs_of_other_scenes(name):
    compare(name)
