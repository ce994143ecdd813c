"""Builders keep none of the arrays, lists and dicts that they are given: the caller may reuse them."""

import pickle
from copy import deepcopy
from types import ModuleType

import autograd.numpy as anp
import numpy as np
import pytest
import scipy.sparse as sp

import sparsedp as dp
from sparsedp._utils.pytree import leaves
from sparsedp.autodiff.derivative import value_and_grad

GRID = dp.Grid((4, 3), size=1.0)
L = dp.laplacian(GRID, dp.dirichlet)
HEAT = dp.identity(dp.Grid((20, 21)).cells) - dp.laplacian(dp.Grid((20, 21)), dp.dirichlet)  # of several levels
SOLID = np.zeros(GRID.shape, bool)
SOLID[1, 1] = True
K = np.linspace(1.0, 2.0, GRID.faces.size)
CELLS = np.linspace(1.0, 2.0, 12).reshape(GRID.shape)
ROWS = np.eye(12) * 4 + np.eye(12, k=1) + np.eye(12, k=-1)


def cells(op):
    return op(CELLS)


def applied(op):
    """What an Operator says, its transpose and its entries."""
    u, g = (np.cos(np.arange(space.size)).reshape(space.shape) for space in (op.domain, op.codomain))
    return op(u), op.T(g), op.matrix.toarray()


def flow(step):
    state = step.start(np.cos(np.arange(GRID.faces.size)))
    final = lambda v: anp.sum(dp.rollout(step, {**state, "v": v}, None, 2)["v"] ** 2)
    return leaves(dp.rollout(step, state, None, 2)), value_and_grad(final)(state["v"])


def moved(move):
    return value_and_grad(lambda v: anp.sum(move(CELLS, v, 0.01, 0.5) ** 2))(0.1 * K)


def stepped(step):
    return value_and_grad(lambda u: anp.sum(dp.rollout(step, u, 0.5, 2) ** 2))(CELLS)


def misfit_of(x, scene):
    return anp.sum((x - scene) ** 2)


def squares(x):
    return x**2 + 0.5 * np.roll(x, 1)


def cubic(x, p):
    return x**3 + x - p


def walls(name):
    if name == "pressure":
        return {"x": (dp.neumann, dp.dirichlet)}
    return {"x": [dp.inflow, dp.outflow]}


# name -> (arguments that hold arrays, lists or dicts; builder; what it is used for)
BUILDERS = {
    "Grid": ((np.linspace(1, 2, 4), [1.0, 2.0]), lambda h, o: dp.Grid((4, 3), spacing=[h, 1.0], origin=o), repr),
    "Grid, widths": (
        (np.linspace(1, 2, 4),),
        lambda h: dp.Grid(4, spacing=h),
        lambda grid: dp.laplacian(grid)(np.arange(4.0)),
    ),
    "Grid, lists": (([4, 3], [2.0, 1.0], [True, False]), lambda n, s, p: dp.Grid(n, size=s, periodic=p), repr),
    "Space": (([4, 3],), lambda n: dp.Space(n), lambda space: space.volumes),
    "gradient": ((SOLID, walls("pressure")), lambda s, b: dp.gradient(GRID, b, s), applied),
    "laplacian": ((SOLID, walls("pressure")), lambda s, b: dp.laplacian(GRID, b, s, dp.dirichlet), applied),
    "robin": ((np.array(2.0), np.array(0.5)), dp.robin, lambda c: dp.laplacian(GRID, c)(CELLS)),
    "patch": (
        (np.array([True, False, True, False]),),
        lambda faces: dp.patch(faces, dp.dirichlet),
        lambda wall: dp.laplacian(GRID, {"y": wall})(CELLS),
    ),
    "lift": ((walls("pressure"),), lambda b: dp.lift(GRID, b), applied),
    "average": ((walls("pressure"),), lambda b: dp.average(GRID, b), applied),
    "flux": ((SOLID,), lambda s: dp.flux(GRID, s), applied),
    "free_faces": ((SOLID,), lambda s: dp.free_faces(GRID, solid=s), applied),
    "interior": ((SOLID,), lambda s: dp.interior(GRID, s), applied),
    "mask": ((SOLID,), lambda s: dp.mask(GRID.cells, s), applied),
    "diagonal": ((CELLS,), lambda v: dp.diagonal(GRID.cells, v), applied),
    "scaled": ((np.array(2.0),), lambda c: c * dp.from_functions(np.sin, np.cos, 12, 12), lambda op: op(CELLS.ravel())),
    "sample": ((np.array([[0.2, 0.3], [0.5, 0.6]]),), lambda p: dp.sample(GRID, p), applied),
    "restrict": (([2, 3],), lambda f: dp.restrict(GRID, f), applied),
    "from_matrix, dense": ((ROWS,), dp.from_matrix, applied),
    "from_matrix, csr": ((sp.csr_array(ROWS),), dp.from_matrix, lambda op: op(CELLS.ravel())),
    "from_matrix, coo": ((sp.coo_array(ROWS),), dp.from_matrix, lambda op: op.T(CELLS.ravel())),
    "matrix_solver": ((sp.csr_array(ROWS),), dp.matrix_solver, lambda solve: solve(ROWS[ROWS != 0], CELLS.ravel())),
    "inverse": (
        ([["forward"], ["backward"]],),
        lambda sweeps: dp.inverse(HEAT, "multigrid", sweeps=sweeps),
        lambda inv: pickle.loads(pickle.dumps(inv))(np.ones(HEAT.domain.shape)),
    ),
    "inverse, rtol": ((np.array(1e-3),), lambda rtol: dp.inverse(-L, "krylov", rtol), cells),
    "elliptic_solver": (
        (np.array(1e-3),),
        lambda rtol: dp.elliptic_solver(dp.divergence(GRID), dp.gradient(GRID, dp.dirichlet), "krylov", rtol),
        lambda solve: solve(K, CELLS),
    ),
    "cut_cells": (
        (np.add.outer(np.arange(-1.3, 3.0), np.arange(4.0)), walls("pressure")),
        lambda level, b: dp.cut_cells(GRID, level, b, dp.dirichlet),
        lambda body: body.solve(CELLS),
    ),
    "cut_flow": (
        (np.add.outer(np.arange(-1.3, 3.0), np.arange(4.0)), walls("flow")),
        lambda level, b: dp.cut_flow(GRID, level, b),
        lambda flow: leaves(flow.residual({"v": K, "p": CELLS}, 0.1, K)),
    ),
    "implicit": ((sp.csr_array(np.eye(12)),), lambda s: dp.implicit(cubic, sparsity=s), lambda f: f(CELLS, CELLS)),
    "ensemble": (
        ([CELLS.copy(), 2 * CELLS], np.array([1.0, 2.0])),
        lambda scenes, weights: dp.ensemble(misfit_of, scenes, weights=weights),
        lambda total: value_and_grad(total)(CELLS),
    ),
    "from_blackbox": (
        (sp.csr_array(np.eye(12) + np.roll(np.eye(12), -1, 1)),),
        lambda s: dp.from_blackbox(squares, s),
        lambda f: value_and_grad(lambda x: anp.sum(f(x)))(np.arange(12.0)),
    ),
    "matrix_exponential": ((np.array(0.3),), lambda t: dp.matrix_exponential(L, t), cells),
    "matrix_power": ((np.array(0.5),), lambda t: dp.matrix_power(-L, t), cells),
    "face_laplacian": ((SOLID, walls("flow")), lambda s, b: dp.face_laplacian(GRID, b, s), applied),
    "face_lift": ((walls("flow"),), lambda b: dp.face_lift(GRID, b), lambda op: op(np.ones(op.domain.shape))),
    "convection": ((SOLID, walls("flow")), lambda s, b: dp.convection(GRID, b, s), lambda f: f(K, K)),
    "forces": (
        (SOLID, walls("flow"), SOLID.copy(), [0.1, 0.2]),
        lambda s, b, c, about: dp.forces(GRID, s, b, cells=c, about=about),
        lambda on: on(K, CELLS, 0.1),
    ),
    "projection": ((SOLID, walls("flow")), lambda s, b: dp.projection(GRID, s, b), lambda P: (P(K), P.T(K))),
    "projection, sent": (
        (SOLID, walls("flow")),
        lambda s, b: dp.projection(GRID, s, b),
        lambda P: pickle.loads(pickle.dumps(P))(K),
    ),
    "flow_step": (
        (np.sin(K), SOLID, walls("flow"), np.array(0.01), np.array(0.02)),
        lambda w, s, b, dt, nu: dp.flow_step(GRID, dt, nu, boundary=b, solid=s, walls=w),
        flow,
    ),
    "flow_step, media": (
        (np.abs(CELLS) + 0.01, np.abs(CELLS) + 1.0),
        lambda mu, rho: dp.flow_step(GRID, 1e-6, mu, density=rho),
        flow,
    ),
    "flow_step, friction": (
        (np.abs(np.sin(K)),),
        lambda f: dp.flow_step(GRID, 0.01, friction=f),
        flow,
    ),
    "flow_step, implicit": (
        (np.sin(K), np.array(0.02)),
        lambda w, nu: dp.flow_step(GRID, 0.01, nu, implicit=True, walls=w),
        flow,
    ),
    "transport": (
        (SOLID, {"x": [dp.dirichlet, dp.neumann]}),
        lambda s, b: dp.transport(GRID, "van_leer", b, solid=s),
        moved,
    ),
    "semi_lagrangian": ((SOLID,), lambda s: dp.transport(GRID, "semi_lagrangian", solid=s), lambda m: m(CELLS, K, 0.1)),
    "transport operator": ((0.1 * K,), lambda v: dp.transport(GRID).operator(v, 0.01), cells),
    "stepper": (
        (np.array(0.01), np.array(1e-3)),
        lambda dt, r: dp.stepper("tr_bdf2", L, dt, solver="krylov", rtol=r),
        stepped,
    ),
    "stepper, copied": (
        (np.array(0.01), np.array(1e-3), sp.csr_array(np.eye(12))),
        lambda dt, r, s: dp.stepper("backward_euler", lambda u, p: -p * u**3, dt, rtol=r, sparsity=s),
        lambda step: stepped(deepcopy(step)),
    ),
    "stepper, coefficient": (
        (np.array(0.3),),
        lambda c: dp.stepper("imex", lambda u, p: p * u * u, 0.01, linear=(L, c)),
        stepped,
    ),
    "stepper, error control": (
        (np.array(1e-3), 0.1 * CELLS),
        lambda tolerance, floor: dp.stepper("heun", lambda u, p: -p * u**2, 0.1, tolerance=tolerance, floor=floor),
        stepped,
    ),
    "conservation_law": (
        (CELLS.copy(), {"y": [dp.inflow, dp.outflow]}, CELLS[:, :1].copy()),
        lambda still, sides, given: dp.conservation_law(
            GRID,
            lambda u, p, axis: u**2,
            lambda u, p, axis: anp.abs(2 * u),
            boundary=sides,
            inflow=given,
            equilibrium=still,
        ),
        lambda law: value_and_grad(lambda u: anp.sum(law(u) ** 2))(CELLS**2),
    ),
    "shallow_water": (
        (0.1 * CELLS, {"y": [dp.inflow, dp.outflow]}, np.ones((3, *CELLS[:, :1].shape))),
        lambda ground, sides, given: dp.shallow_water(GRID, ground, boundary=sides, inflow=given),
        lambda law: value_and_grad(lambda u: anp.sum(law(u) ** 2))(1.0 + np.stack([CELLS, CELLS, CELLS]) ** 2),
    ),
    "stepper, leapfrog": (
        ((np.ones(12), np.ones(12)),),
        lambda damping: dp.stepper("leapfrog", (lambda q, p: -q, lambda p, c: p), 0.1, damping=damping),
        lambda step: step((np.ones(12), np.ones(12))),
    ),
    "total_variation": ((SOLID.copy(),), lambda solid: dp.total_variation(GRID, 0.1, solid), lambda tv: tv(CELLS**3)),
    "flatten": (({"u": CELLS.copy(), "n": [3]},), lambda tree: dp.flatten(tree)[1], lambda back: back(K[:12] ** 2)),
    "smoothness": ((SOLID.copy(),), lambda solid: dp.smoothness(GRID, solid), lambda h1: h1(CELLS**3)),
    "physical_gradient": (
        (np.array(0.5),),
        lambda rate: dp.physical_gradient(lambda x: x**3, lambda y, x: np.cbrt(y), rate),
        lambda cube: value_and_grad(lambda x: anp.sum(cube(x)))(CELLS),
    ),
}


def spoil(thing):
    """Other numbers in every array, and other entries in every list and dict."""
    if isinstance(thing, dict):
        thing.clear()
    elif isinstance(thing, list):
        for part in thing:
            spoil(part)
        thing[:] = thing[::-1]
    elif isinstance(thing, tuple):
        for part in thing:
            spoil(part)
    elif sp.issparse(thing):
        thing.data[:] = 0.0
        for name in ("indices", "row", "col"):
            if hasattr(thing, name):
                getattr(thing, name)[:] = 0
    elif isinstance(thing, np.ndarray):
        thing[...] = ~thing if thing.dtype == bool else 1e-7 * thing


def equal(found, wanted):
    """Whether two trees hold the same numbers or words."""
    return all(np.array_equal(one, other) for one, other in zip(leaves(found), leaves(wanted), strict=True))


@pytest.mark.parametrize("name", BUILDERS)
def test_arrays_may_be_reused(name):
    """The same bits, whether the arguments are overwritten before the first use, after it, or never."""
    given, build, use = BUILDERS[name]
    wanted = use(build(*deepcopy(given)))
    for used in (False, True):
        mine = deepcopy(given)
        made = build(*mine)
        if used:
            use(made)
        spoil(mine)
        found = use(made)
        assert equal(found, wanted)
    try:
        others = use(build(*mine))
    except (ValueError, TypeError, ArithmeticError, RuntimeError):
        return
    assert not equal(others, wanted), "the arguments do not matter"


def test_every_builder_is_here():
    """The others are built of no arrays (a LinearOperator and functions are used as they are), or build nothing."""
    unbuilt = "brinkman equal matched_layer "
    unbuilt += (
        "sponge identity divergence curl upwind component prolong harmonic_average from_functions from_linear_operator"
    )
    calls = "matrix_function from_blackbox minimize laplace certify certified explain stress work_precision rollout"
    calls += " eigenpairs jit grad value_and_grad vjp jvp hvp differentiable set_threads steady distribute gather"
    calls += " continuation"
    shown = "animate plot convergence v_curve update_direction save load from_image"
    public = {name for name in dir(dp) if callable(getattr(dp, name)) and name.islower() and name[0] != "_"}
    public -= {"dirichlet", "neumann"}  # a call of them is refused with advice
    public -= {name for name in public if isinstance(getattr(dp, name), ModuleType)}  # so is a call of these
    here = {name.split(",")[0].split(" ")[0] for name in BUILDERS}
    assert public - here == set(f"{unbuilt} {calls} {shown}".split()) - here


def test_results_of_jvp_are_the_callers_own():
    x = np.ones(3)
    t = np.full(3, 2.0)
    value, slope = dp.jvp(lambda u: u, x, t)
    value[0], slope[0] = 9.0, 9.0
    assert np.array_equal(x, np.ones(3)) and np.array_equal(t, np.full(3, 2.0))


def test_a_function_that_writes_into_the_field_is_refused():
    """It would change the array of the caller."""
    double = dp.from_functions(lambda u: np.multiply(u, 2, out=u), lambda g: 2 * g, 3, 3)
    x = np.ones(3)
    with pytest.raises(ValueError, match="read-only"):
        double(x)
    assert np.array_equal(x, np.ones(3))
