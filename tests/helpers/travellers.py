"""Every public object that is called, how to make it of functions with names, and what it gives: for test_pickling.py.

A module of its own: another process imports it, and finds the functions here.
"""

from copy import deepcopy
from functools import partial

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp
from catalogue import CATALOGUE
from scipy.sparse.linalg import aslinearoperator

import sparsedp as dp
from sparsedp import kernels
from sparsedp.autodiff.derivative import pullback, pushforward

GRID = dp.Grid((6, 5), spacing=[np.linspace(1.0, 1.5, 6), 0.7])
BOX = dp.Grid((16, 12), size=1.0)
LINE = dp.Grid(12, size=1.0)
SOLID = np.zeros((6, 5), dtype=bool)
SOLID[2:4, 2] = True
BAND = np.diag(np.full(12, 3.0)) + np.diag(np.linspace(0.5, 1, 11), 1) - np.diag(np.ones(11), -1)


def numbers(shape, seed=0):
    return np.random.default_rng(seed).standard_normal(shape)


# ------------------------------------------------------------ functions with names


def loss(x):
    return anp.sum(anp.sin(x) ** 2)


def burgers(u, params):
    return -params * u * (u - anp.roll(u, 1))


def forced(u, params, t):
    return anp.cos(t) * u - params * u**2


def heating(params, t):
    return params * anp.cos(t) * np.ones(12)


def half(params):
    return 0.5 * params


def cubic(x, p):
    return x**3 + x - p


def slope_of_cubic(x, p):
    return np.diag(3 * x**2 + 1)


def coupled(x, p):
    return 3 * x + x**3 - 0.5 * anp.roll(x, 1) - 0.2 * anp.roll(x, -1) - p


def mix(u):
    return np.roll(u, 1) - 0.5 * u


def unmix(g):
    return np.roll(g, -1) - 0.5 * g


def weigh(r):
    return 0.25 * r


def burgers_flux(u, params, axis):
    return 0.5 * params * u**2


def burgers_speed(u, params, axis):
    return anp.max(anp.abs(params * u), axis=0)


def sliding(params):
    return params * np.ones(dp.face_lift(GRID).domain.size)


def push(v, params):
    return -params * v


def foreign(x):
    return np.where(x.real > 0, x * np.roll(x, 1), np.sin(x))


def cube(x):
    return x**3


def cube_vjp(nums, y, x):
    return partial(cube_pull, x)


def cube_pull(x, g):
    return (3 * x**2 * g,)


def cube_jvp(nums, tangents, y, x):
    return 3 * x**2 * tangents[0]


def root_of_cube(y, x):
    return np.sign(y) * np.abs(y) ** (1 / 3)


# ------------------------------------------------------------ what an object gives


def bits(f, *args):
    """Value, gradient in all arguments and tangent, as bytes."""
    floats = tuple(np.asarray(x, float) for x in args)
    call = lambda x: f(*x)
    y, pull = pullback(call, floats)
    back = pull(numbers(np.shape(y), 1))
    found = [y, *back, pushforward(call, floats, tuple(numbers(np.shape(x), 2) for x in floats))[1]]
    return [np.asarray(one).tobytes() for one in (*found, f(*args))]


def of_operator(op):
    return bits(op, numbers(op.domain.shape)) + bits(op.T, numbers(op.codomain.shape)) + [op.form, op.name, op.T.form]


def of_inverse(inv):
    b = numbers(inv.domain.shape)
    return of_operator(inv) + [inv(b, start=0.1 * b).tobytes(), (inv.info.hierarchy, inv.method)]


def of_step(step, state, params):
    """A loop of three steps, and one step."""
    whole = lambda u, p: dp.rollout(step, u, p, 3)
    leaf = lambda u, p: whole(u, p)[0] if isinstance(state, tuple) else whole(u, p)
    if isinstance(state, tuple):
        return bits(lambda u, p: leaf((u, state[1]), p), state[0], params)
    return bits(leaf, state, params) + bits(step, state, params)


def of_flow(step):
    v = 0.1 * numbers(step.grid.faces.shape)
    return bits(lambda v, p: dp.rollout(step, step.start(v, p), p, 2)["v"], v, 0.3)


def of_certified(tolerance):
    solve = dp.inverse(-dp.laplacian(BOX, dp.dirichlet), "krylov")
    start = np.zeros(BOX.shape)  # it serves one run
    twin = deepcopy(tolerance)
    best = dp.minimize(lambda b: anp.sum((solve(b) - 1.0) ** 2), start, maxiter=5, tolerance=twin)
    return [best.x.tobytes()]


def misfit_of(x, scene):
    return anp.sum((x - scene) ** 2)


def of_total(f):
    return of_pair(dp.value_and_grad(f))


def of_pair(f):
    value, slope = f(numbers(7))
    return [np.float64(value).tobytes(), slope.tobytes()]


def of_physical(f):
    y, pull = pullback(f, numbers(7))
    return [y.tobytes(), pull(numbers(7, 1)).tobytes()]


def of_adopted(f):
    """Its Jacobian at two points: where branches were met before it has entries that are 0."""
    return [f.jacobian(x).toarray().tobytes() for x in (numbers(12), numbers(12, 5))] + bits(f, numbers(12))


# ------------------------------------------------------------ the objects

STEPS = {
    "euler": dict(rate=burgers),
    "heun": dict(rate=burgers, dt=half),
    "ssprk3": dict(rate=dp.laplacian(LINE), dt=1e-4),
    "rk4": dict(rate=forced),
    "backward_euler": dict(rate=dp.laplacian(LINE)),
    "crank_nicolson": dict(rate=burgers),
    "tr_bdf2": dict(linear=(dp.laplacian(LINE, dp.dirichlet), half), source=heating),
    "radau": dict(rate=forced),
    "rodas5p": dict(rate=forced),
    "imex": dict(linear=(dp.laplacian(LINE), 0.1), rate=burgers),
    "etdrk4": dict(linear=dp.laplacian(LINE), rate=burgers),
}


def stepped(method, tolerance=None):
    given = dict(STEPS[method])
    dt = given.pop("dt", 0.01 if tolerance is None else 0.001)  # of few intervals also under error control
    step = dp.stepper(method, given.pop("rate", None), dt, tolerance=tolerance, **given)
    state = (numbers(12), 0.2) if step.problem.timed else numbers(12)
    return step, partial(of_step, state=state, params=0.4)


def inverses():
    """Every method, and what is made of inverses."""
    poisson = dp.inverse(-dp.laplacian(BOX, dp.dirichlet))
    neumann = dp.divergence(GRID) @ dp.gradient(GRID, solid=SOLID)
    yield "auto", poisson
    for method in ("separable", "direct", "multigrid", "krylov", *["structured"] * kernels.compiled()):
        yield method, dp.inverse(-dp.laplacian(BOX, dp.dirichlet), method)
    yield "singular", dp.inverse(-neumann, nullspace="project")
    yield "wind", dp.inverse(dp.identity(BOX.cells) - 0.1 * dp.upwind(BOX, 0, 1) - dp.laplacian(BOX), "multigrid")
    yield "preconditioned", dp.inverse(dp.from_matrix(BAND), "krylov", preconditioner=weigh)
    yield "transposed", dp.inverse(dp.from_matrix(BAND)).T


def operators():
    for number, entry in enumerate(CATALOGUE):
        grid = GRID if entry.builder != "from_functions" else LINE
        if entry.builder != "from_functions":
            yield f"{entry.builder} {number}", entry.make(grid, entry.conditions([dp.robin(1, 2)])[0])
    yield "from_functions", dp.from_functions(mix, unmix, 12, 12)
    yield "from_linear_operator", dp.from_linear_operator(aslinearoperator(sp.csr_array(BAND)))
    yield "matrix_exponential", dp.matrix_exponential(dp.laplacian(GRID, dp.dirichlet), 0.1)
    yield "matrix_function", dp.matrix_function(dp.laplacian(BOX), np.cos)
    yield "matrix_power", dp.matrix_power(-dp.laplacian(BOX, dp.dirichlet), 0.5)
    yield "projection", dp.projection(GRID, SOLID, {"x": (dp.no_slip, dp.outflow)})
    yield "projection by transforms", dp.projection(BOX)
    yield "pressure", dp.projection(GRID).pressure
    yield "composed", dp.gradient(BOX) @ dp.inverse(dp.identity(BOX.cells) - dp.laplacian(BOX)) @ dp.divergence(BOX)
    yield "move.operator", dp.transport(LINE).operator(np.linspace(-1, 1, 13), 0.01)


def travellers():
    """(name of the public builder, label, object, what it gives): all that a scene may hold and call."""
    yield from (("inverse", label, inv, of_inverse) for label, inv in inverses())
    yield from ((label.split()[0], label, op, of_operator) for label, op in operators())
    yield from (("stepper", method, *stepped(method)) for method in STEPS)
    yield from (("stepper", f"{method}, tolerance", *stepped(method, 1e-2)) for method in STEPS if method != "ssprk3")
    leapfrog = dp.stepper("leapfrog", (push, push), 0.1, damping=(1.0, numbers(12) ** 2))
    yield "stepper", "leapfrog", leapfrog, partial(of_step, state=(numbers(12), numbers(12, 1)), params=0.4)
    solve = dp.elliptic_solver(dp.divergence(GRID), dp.gradient(GRID, dp.dirichlet))
    k = np.exp(numbers(GRID.faces.size))
    b = numbers(GRID.shape)
    v = numbers(GRID.faces.size)
    yield "elliptic_solver", "", solve, lambda solve: bits(solve, k, b, 0.5)
    K = np.eye(GRID.dim).reshape(GRID.dim, GRID.dim, *[1] * GRID.dim) + 0.1 * np.ones(GRID.shape)
    body = dp.cut_cells(GRID, numbers(GRID.nodes.shape) + 1.0, dp.dirichlet, dp.robin(1.0, 0.5))
    yield "cut_cells", "", body, lambda body: bits(lambda b, values, k: body.solve(b, values, None, k), b, b, k)
    flow = dp.cut_flow(GRID, numbers(GRID.nodes.shape) + 1.0, dp.free_slip)
    yield "cut_flow", "", flow, lambda flow: bits(lambda v, p: flow.residual({"v": v, "p": p}, 0.1, v)["v"], v, b)
    yield "elliptic_solver", "tensors", solve, lambda solve: bits(solve, K, b, 0.5)
    waves = dp.elliptic_solver(solve.D, solve.G, "krylov", preconditioner="shifted_laplace")
    yield "elliptic_solver", "waves", waves, lambda solve: bits(lambda k, b: anp.real(solve(k, b, -1 - 0.5j)), k, b)
    pattern = sp.csr_array(BAND)
    yield "matrix_solver", "", dp.matrix_solver(pattern), lambda s: bits(s, pattern.data, numbers(12))
    for jacobian in (None, slope_of_cubic):
        yield (
            "implicit",
            "jacobian" if jacobian else "",
            dp.implicit(cubic, jacobian),
            lambda s: bits(s, np.zeros(12), numbers(12)),
        )
    yield "implicit", "large", dp.implicit(coupled), lambda s: bits(s, np.zeros(90), numbers(90))
    for scheme in ("upwind", "van_leer", "semi_lagrangian", "maccormack"):
        move = dp.transport(GRID, scheme, solid=SOLID)
        u = numbers(GRID.shape)
        v = 0.3 * numbers(GRID.faces.size)
        yield "transport", scheme, move, lambda move, u=u, v=v: bits(move, u, v, 0.1)
    yield "total_variation", "", dp.total_variation(GRID, 0.1, SOLID), lambda tv: bits(tv, numbers(GRID.shape))
    yield "smoothness", "", dp.smoothness(GRID, SOLID), lambda h1: bits(h1, numbers(GRID.shape))
    law = dp.conservation_law(BOX, burgers_flux, burgers_speed, source=push)
    yield "conservation_law", "", law, lambda law: bits(law, numbers((2, *BOX.shape)), 0.3)
    law = dp.conservation_law(
        LINE, burgers_flux, burgers_speed, boundary=(dp.inflow, dp.free_slip), momentum=0, inflow=np.array([1.0, 2.0])
    )
    yield "conservation_law", "walls and inflow", law, lambda law: bits(law, numbers((2, 12)), 0.3)
    law = dp.shallow_water(BOX, numbers(BOX.shape), boundary=dp.free_slip, source=push, dry=1e-4)
    yield "shallow_water", "", law, lambda law: bits(law, 9.0 + numbers((3, *BOX.shape)), 0.3)
    channel = {"x": (dp.inflow, dp.outflow), "y": dp.no_slip}
    lift = dp.face_lift(GRID, channel)
    yield "face_lift", "", lift, lambda lift: bits(lift, numbers(lift.domain.size))
    yield "flow_step", "", dp.flow_step(GRID, 0.01, 0.1, push, solid=SOLID), of_flow
    yield "flow_step", "implicit", dp.flow_step(BOX, 0.01, 0.1, implicit=True, convective=False), of_flow
    media = {"viscosity": 0.01 * numbers(GRID.shape) ** 2, "density": 1.0 + numbers(GRID.shape) ** 2}
    yield "flow_step", "media", dp.flow_step(GRID, 0.001, **media), of_flow
    yield "flow_step", "friction", dp.flow_step(GRID, 0.01, friction=numbers(GRID.faces.size) ** 2), of_flow
    lid = dp.face_lift(GRID)
    lid = lid(lid.domain.join(0.0, 0.0, 0.0, 1.0))
    yield "flow_step", "lid", dp.flow_step(GRID, 0.01, half, walls=lid), of_flow
    yield "flow_step", "walls of params", dp.flow_step(GRID, 0.01, half, walls=sliding), of_flow
    v, w = numbers((2, GRID.faces.size))
    yield "convection", "", dp.convection(GRID, {"x": dp.free_slip}, SOLID), lambda c: bits(c, v, w)
    on = dp.forces(GRID, SOLID, {"x": dp.free_slip}, about=0.2)
    yield "forces", "", on, lambda on: bits(on, v, numbers(GRID.shape), 0.1)
    yield "brinkman", "", dp.brinkman(GRID), lambda friction: bits(friction, v)
    yield "harmonic_average", "", dp.harmonic_average(GRID), lambda f: bits(f, np.exp(numbers(GRID.shape)))
    yield "value_and_grad", "", dp.value_and_grad(loss), of_pair
    yield "jit", "", dp.jit(loss), lambda f: [f(numbers((5, 4))).tobytes()]
    yield "grad", "", dp.grad(loss), lambda f: [f(numbers(7)).tobytes()]
    yield "differentiable", "", dp.differentiable("cube", cube, cube_vjp, cube_jvp), lambda f: bits(f, numbers(7))
    yield "equal", "", dp.equal(cube), lambda f: bits(f, numbers(7))
    yield "physical_gradient", "", dp.physical_gradient(cube, root_of_cube), of_physical
    yield "from_blackbox", "", dp.from_blackbox(foreign), of_adopted
    yield "ensemble", "", dp.ensemble(misfit_of, [1.0, 2.0], weights=[1, 3], chunk=2), of_total
    yield "certified", "", dp.certified(0.2), of_certified
    net = dp.network
    x = numbers((2, 2, 9))
    p = net.residual_weights(np.random.default_rng(0), 2, 3)
    yield "network", "residual_block", net.residual_block, lambda f: [f(p, x).tobytes()]
    yield "network", "training_range", net.training_range(x), lambda f: bits(f, x)
    for layer in (net.tanh, net.relu, net.softplus):
        yield "network", layer.__name__, layer, lambda f: bits(f, x)


# Public names that make nothing which is called later: values, runs, pictures, rooms.
NOTHING_TO_CALL = {
    "Grid",
    "Space",
    "Operator",
    "dirichlet",
    "neumann",
    "robin",
    "patch",
    "no_slip",
    "free_slip",
    "inflow",
    "outflow",
    "rollout",
    "minimize",
    "laplace",
    "update_direction",
    "set_threads",
    "convergence",
    "v_curve",
    "animate",
    "plot",
    "certify",
    "stress",
    "work_precision",
    "explain",
    "eigenpairs",
    "check",
    "errors",
    "testing",
    "report",
    "vjp",
    "jvp",
    "hvp",
    "sponge",
    "matched_layer",
    "steady",
    "continuation",
    "free_faces",
    "distribute",
    "gather",
    "flatten",
    "from_image",
    "interop",
    "load",
    "save",
}
