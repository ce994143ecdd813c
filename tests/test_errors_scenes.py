"""Messages of conservation laws, waves, flows with scalars, stiff steps and sparse terms, in full."""

import re

import autograd.numpy as anp
import numpy as np
import pytest
from autograd.extend import defvjp, primitive

import sparsedp as dp

LINE = dp.Grid(4)
BOX = dp.Grid((4, 4))
WATER = np.array([[1.0, 1.0, 1.0, 1.0], [0.0, 0.0, 0.0, 0.0]])
RATES = (lambda v, c: v), (lambda p, c: p)
SHAPE = dp.errors.ShapeError
UNSTABLE = dp.errors.UnstableStepError
VALUE = ValueError
TYPE = TypeError


def carry(u, params, axis):
    return u


def law(**given):
    return dp.conservation_law(LINE, carry, carry, **given)


def flow(dt=0.1, v=0.0, s=None, **given):
    step = dp.flow_step(BOX, dt, **given)
    return step(step.start(np.full(40, v), None, s))


def turned(u, params):
    return anp.real(params) * u


def stay(target, rho, x):
    return x


def tensor(K, D=None):
    G = dp.gradient(BOX)
    return dp.elliptic_solver(D or dp.divergence(BOX), G)(K, np.ones((4, 4)), 1.0)


def leaked(c):
    return dp.stepper("radau", lambda u, p: c * u, 0.1)(np.ones(2))[0]


def fast(u, params):
    return -(u**2)


def drift():
    grid = dp.Grid((16, 16), periodic=True)
    step = dp.flow_step(grid, 0.75)
    return step(step.start(grid.join(1.0, 0.0)))


@primitive
def repeated(a):
    """A function of autograd whose derivative has the wrong shape."""
    return a * np.ones(3)


defvjp(repeated, lambda ans, a: lambda g: g)


class Wrong:
    """A step with a wrong inverse."""

    def __call__(self, u, c):
        return c * u

    def back(self, u, c):
        return u / c + 1e-3


class Growing:
    """An operator that changes its shape."""

    def __init__(self):
        self.calls = 0

    def __call__(self, x):
        self.calls += 1
        if self.calls < 3:
            return x
        return anp.concatenate([x, x])


TABLE = [
    (
        lambda: law(scheme="weno"),
        VALUE,
        "scheme of conservation_law must be one of upwind, van_leer, got 'weno'",
    ),
    (
        lambda: law(boundary=dp.no_slip),
        VALUE,
        "conservation_law takes outflow, free_slip or inflow, got no_slip; write one of them",
    ),
    (
        lambda: law(boundary=dp.inflow),
        VALUE,
        "conservation_law got a side of dp.inflow without inflow=, or inflow= without such a side; give both or none",
    ),
    (
        lambda: law(inflow=1.0),
        VALUE,
        "conservation_law got a side of dp.inflow without inflow=, or inflow= without such a side; give both or none",
    ),
    (
        lambda: law(boundary=dp.free_slip),
        VALUE,
        "momentum of conservation_law, needed at free_slip walls, must be the number of a field for each "
        "axis, got None; write for example momentum=(1,)",
    ),
    (
        lambda: law(boundary=dp.free_slip, momentum=1)(np.ones(4)),
        SHAPE,
        "conservation_law needs a field for each number in momentum=(1,), got u of shape (4,)",
    ),
    (
        lambda: law()(np.ones(5)),
        SHAPE,
        "conservation_law takes a field on cells(4), got an array of shape (5,)",
    ),
    (
        lambda: law()(np.ones((2, 3, 4))),
        SHAPE,
        "conservation_law takes u of shape (fields, 4), got (2, 3, 4)",
    ),
    (
        lambda: law()(np.ones(4, complex)),
        TYPE,
        "u of conservation_law must hold real numbers, got dtype complex128; write u.real",
    ),
    (
        lambda: law()(np.array([1.0, np.nan, 1.0, 1.0])),
        dp.errors.NonFiniteError,
        "the speed of a conservation_law along x must be finite, got 6 that are NaN or infinite, the first at "
        "1; a density or a depth may have become negative: take a smaller dt",
    ),
    (
        lambda: law(source=lambda u, p: 1.0)(np.ones(4)),
        SHAPE,
        "the source of a conservation_law must have shape (4,), got ()",
    ),
    (
        lambda: dp.conservation_law(LINE, np.ones(4), carry),
        TYPE,
        "conservation_law, as flux, takes a function, got ndarray; write lambda u, params, axis: ...",
    ),
    (
        lambda: dp.shallow_water(LINE, scheme="weno"),
        VALUE,
        "scheme of shallow_water must be one of upwind, van_leer, got 'weno'",
    ),
    (
        lambda: dp.shallow_water(LINE, boundary=dp.no_slip),
        VALUE,
        "shallow_water takes outflow, free_slip or inflow, got no_slip; write one of them",
    ),
    (
        lambda: dp.shallow_water(LINE, inflow=1.0),
        VALUE,
        "shallow_water got a side of dp.inflow without inflow=, or inflow= without such a side; give both or none",
    ),
    (
        lambda: dp.shallow_water(LINE, source=1.0),
        TYPE,
        "shallow_water, as source, takes a function, got float; write lambda u, params: ...",
    ),
    (
        lambda: dp.shallow_water(LINE, gravity=-9.81),
        VALUE,
        "gravity of shallow_water must be > 0, got -9.81; write gravity=9.81",
    ),
    (
        lambda: dp.shallow_water(LINE, gravity=lambda p: p)(WATER, 0.0),
        VALUE,
        "gravity of shallow_water must be > 0, got 0; write gravity=9.81",
    ),
    (
        lambda: dp.shallow_water(LINE, dry=0.0),
        VALUE,
        "dry of shallow_water must be > 0, got 0; write dry=1e-6",
    ),
    (
        lambda: dp.shallow_water(LINE, np.ones(3)),
        SHAPE,
        "the bathymetry of a shallow_water must have shape (4,), got (3,)",
    ),
    (
        lambda: dp.shallow_water(LINE, np.ones(4, complex)),
        TYPE,
        "the bathymetry of a shallow_water must hold real numbers, got dtype complex128; write its .real",
    ),
    (
        lambda: dp.shallow_water(LINE, lambda p: p)(WATER, np.nan),
        dp.errors.NonFiniteError,
        "the bathymetry of a shallow_water must be finite, got 4 that are NaN or infinite, the first at 0",
    ),
    (
        lambda: dp.shallow_water(LINE)(np.ones(4)),
        SHAPE,
        "shallow_water needs u of shape (2, 4), the depth and a discharge for each axis, got u of shape (4,)",
    ),
    (
        lambda: dp.shallow_water(LINE)(WATER - 2.0),
        UNSTABLE,
        "the depth of a shallow_water must be >= 0, got -1 in cell 0 and in 3 more; give a state without such cells, "
        "or take smaller steps, dt <= law.time_step(u, params)",
    ),
    (
        lambda: dp.rollout(dp.stepper("ssprk3", dp.shallow_water(LINE), 9.0), WATER * [4, 4, 1, 1], None, 2),
        UNSTABLE,
        "in step 0 of rollout: the depth of a shallow_water must be >= 0, got -80.5665 in cell 1; give a state without "
        "such cells, or take smaller steps, dt <= law.time_step(u, params)",
    ),
    (
        lambda: dp.shallow_water(LINE)(WATER * [[np.nan], [1.0]]),
        dp.errors.NonFiniteError,
        "the depth of a shallow_water must be finite, got 4 that are NaN or infinite, the first at 0",
    ),
    (
        lambda: dp.shallow_water(LINE)(WATER * [[1.0], [np.nan]]),
        dp.errors.NonFiniteError,
        "the rate of a shallow_water must be finite, got 8 that are NaN or infinite, the first at (0, 0)",
    ),
    (
        lambda: dp.shallow_water(LINE, boundary=dp.inflow, inflow=[-1.0, 0.0])(WATER),
        UNSTABLE,
        "the depth of the inflow of a shallow_water at the lower end of x must be >= 0, got -1; change inflow=",
    ),
    (
        lambda: law(boundary=dp.inflow, inflow=-1.0, positive={"amount": lambda u, p: u})(np.ones(4)),
        UNSTABLE,
        "the amount of the inflow of a conservation_law at the lower end of x must be > 0, got -1; change inflow=",
    ),
    (
        lambda: dp.shallow_water(LINE, "hill"),
        TYPE,
        "the bathymetry of a shallow_water must hold real numbers, got dtype <U4; write a number or an array",
    ),
    (
        lambda: law(positive=["density"]),
        TYPE,
        'positive of conservation_law must be a dict of functions, got list; write {"density": lambda u, params: u[0]}',
    ),
    (
        lambda: law(positive={"depth": 0}),
        TYPE,
        "conservation_law, as positive['depth'], takes a function, got int; write lambda u, params: ...",
    ),
    (
        lambda: law(positive={"depth": lambda u, p: 1.0})(np.ones(4)),
        SHAPE,
        "the depth of a conservation_law must have shape (4,), got ()",
    ),
    (
        lambda: law(positive={"depth": lambda u, p: u})(np.array([1.0, 0.0, 1.0, 1.0])),
        UNSTABLE,
        "the depth of a conservation_law must be > 0, got 0 in cell 1; give a state without such cells, or take "
        "smaller steps, dt <= law.time_step(u, params)",
    ),
    (
        lambda: dp.conservation_law(BOX, carry, carry, positive={"depth": lambda u, p: -u[0]})(np.ones((2, 4, 4))),
        UNSTABLE,
        "the depth of a conservation_law must be > 0, got -1 in cell (0, 0) and in 15 more; give a state without "
        "such cells, or take smaller steps, dt <= law.time_step(u, params)",
    ),
    (
        lambda: law(positive={"depth": lambda u, p: u})(np.array([1.0, 1.0, np.nan, 1.0])),
        dp.errors.NonFiniteError,
        "the depth of a conservation_law must be finite, got 1 that are NaN or infinite, the first at 2",
    ),
    (
        lambda: flow(scalars={"heat": 0.1}),
        VALUE,
        "scalar 'heat' of flow_step needs a dict of diffusivity, boundary, values, source, got 0.1",
    ),
    (
        lambda: flow(scalars=["heat"]),
        TYPE,
        'flow_step takes a dict of scalars, got list; write scalars={"heat": {...}}',
    ),
    (
        lambda: flow(scalars={"heat": {}}, force=lambda v, params: v),
        TYPE,
        "flow_step calls a function with 3 arguments, got one that takes 2; write force=lambda v, s, params: ...",
    ),
    (
        lambda: flow(force=lambda v, s, params: v),
        TYPE,
        "flow_step calls a function with 2 arguments, got one that takes 3; write force=lambda v, params: ...",
    ),
    (
        lambda: flow(scalars={"heat": {"source": lambda s: s}}),
        TYPE,
        "flow_step calls a function with 2 arguments, got one that takes 1; write source=lambda s, params: ...",
    ),
    (
        lambda: flow(scalars={"heat": {}}),
        SHAPE,
        "flow_step needs the scalars ['heat'], got []; write step.start(v, params, s)",
    ),
    (
        lambda: drift(),
        UNSTABLE,
        "flow_step is unstable for this velocity with dt = 0.75: waves grow by 20% a step, at a "
        "Courant number of 0.75; dt = 0.5 is safe, or write unstable='allow'",
    ),
    (
        lambda: dp.stepper("radau", fast, 0.1, solver="krylov"),
        TYPE,
        "radau does not use solver; leave it out",
    ),
    (
        lambda: dp.stepper("leapfrog", RATES[0], 0.1),
        TYPE,
        "the rates of leapfrog must be a pair, got function; write (lambda v, c: ..., lambda p, c: ...) for the state "
        "(p, v)",
    ),
    (
        lambda: dp.stepper("leapfrog", RATES, 0.1, tolerance=0.1),
        TYPE,
        "leapfrog does not use tolerance; leave it out",
    ),
    (
        lambda: dp.stepper("rk4", fast, 0.1, damping=(1.0, 1.0)),
        TYPE,
        "rk4 does not use damping; leave it out",
    ),
    (
        lambda: dp.stepper("leapfrog", RATES, 0.1, damping=1.0),
        TYPE,
        "damping, for both fields of the state, must be a pair, got float; write (s, None)",
    ),
    (
        lambda: dp.stepper("leapfrog", RATES, 0.1, damping=dp.matched_layer(dp.Grid(20), 8, 1.0)),
        TYPE,
        "damping, for both fields of the state, must be a pair, got MatchedLayer; write layer.damping",
    ),
    (
        lambda: dp.stepper("leapfrog", RATES, 0.1, damping=(-1.0, 0.0)),
        VALUE,
        "damping needs finite rates >= 0 [1 / time]; take dp.sponge(grid, cells, speed)",
    ),
    (
        lambda: dp.stepper("leapfrog", RATES, 0.1, damping=(1.0, 0.0)).back((1.0, 1.0)),
        VALUE,
        "a leapfrog step with damping cannot be reversed: the damped part would grow; give rollout a memory in bytes",
    ),
    (
        lambda: dp.stepper("rk4", fast, 0.1).back(1.0),
        VALUE,
        "stepper(rk4) cannot be reversed; write 'leapfrog'",
    ),
    (
        lambda: dp.stepper("leapfrog", RATES, 0.1)(1.0),
        TYPE,
        "the state of leapfrog must be a pair, got float; write (p, v)",
    ),
    (
        lambda: dp.stepper("leapfrog", RATES, 0.1, damping=((1.0, 2.0), None))((1.0, 1.0)),
        SHAPE,
        "damping[0]: expected one array or number, got a tuple of length 2; give one number, or a tree like the field",
    ),
    (
        lambda: dp.sponge(LINE, {"y": (2, 2)}, 1.0),
        VALUE,
        "sponge needs a number of cells or a pair for axes of ['x'], got {'y': (2, 2)}",
    ),
    (
        lambda: dp.matched_layer(dp.Grid((8, 9), periodic=True), 6, 1.0),
        ValueError,
        "matched_layer needs an axis that is not periodic, got Grid(8 x 9 cells, size 8 x 9, periodic in x, y), which "
        "is periodic along every axis; write Grid(..., periodic=False)",
    ),
    (
        lambda: dp.sponge(dp.Grid((8, 9), periodic=(True, False)), {"x": 3, "y": 3}, 1.0),
        ValueError,
        "sponge got cells for x, which is periodic and has no ends; leave it out of cells, or write periodic=False for "
        "this axis of the grid",
    ),
    (
        lambda: dp.matched_layer(dp.Grid(20, size=1e-300), 6, 1e10),
        ValueError,
        "the rates of matched_layer overflow: they grow with the speed divided by the thickness of the layer; give "
        "lengths and times in other units",
    ),
    (
        lambda: dp.matched_layer(LINE, {"y": (2, 2)}, 1.0),
        VALUE,
        "matched_layer needs a number of cells or a pair for axes of ['x'], got {'y': (2, 2)}",
    ),
    (
        lambda: dp.matched_layer(LINE, 5, 1.0),
        VALUE,
        "matched_layer on x needs a whole number of cells from 0 to 4, got 5",
    ),
    (
        lambda: dp.matched_layer(dp.Grid(12), True, 1.0),
        VALUE,
        "matched_layer on x needs a whole number of cells from 0 to 12, got True",
    ),
    (
        lambda: dp.matched_layer(dp.Grid(12), {"x": (0, 5)}, 1.0),
        VALUE,
        "matched_layer on x needs 0 or at least 6 cells, got 5; fewer reflect more than 1e-3 of a wave",
    ),
    (
        lambda: dp.matched_layer(dp.Grid((20, 13)), {"y": (7, 6)}, 1.0),
        VALUE,
        "matched_layer on y got 7 + 6 of 13 cells; leave cells between the layers",
    ),
    (
        lambda: dp.matched_layer(dp.Grid(8), {"x": (6, 0)}, 1.0).coefficients(1e-320),
        VALUE,
        "omega of a matched layer is too small, got 1e-320 beside rates up to 6.14; give the angular frequency of the "
        "waves",
    ),
    (
        lambda: dp.matched_layer(LINE, 0, 0),
        VALUE,
        "speed of matched_layer must be > 0, got 0; give the speed of the fastest waves",
    ),
    (
        lambda: dp.matched_layer(LINE, 0, 1.0, echo=2.0),
        VALUE,
        "echo of matched_layer must be between 0 and 1, got 2; the default is 1e-8",
    ),
    (
        lambda: dp.matched_layer(LINE, 0, 1.0).coefficients(0.0),
        VALUE,
        "omega of a matched layer must be one finite number, not 0, got 0.0",
    ),
    (
        lambda: dp.matched_layer(LINE, 0, 1.0).coefficients([1.0, 2.0]),
        VALUE,
        "omega of a matched layer must be one finite number, not 0, got [1.0, 2.0]",
    ),
    (
        lambda: dp.sponge(LINE, 5, 1.0),
        VALUE,
        "sponge on x needs a whole number of cells from 0 to 4, got 5",
    ),
    (
        lambda: dp.sponge(LINE, 2, 0),
        VALUE,
        "speed of sponge must be > 0, got 0; give the speed of the fastest waves",
    ),
    (
        lambda: dp.total_variation(LINE, 0.0),
        VALUE,
        "total_variation needs eps > 0, a slope that counts as small, got 0.0",
    ),
    (
        lambda: dp.minimize(lambda x: anp.sum(x**2), np.ones(3), "admm", weight=1.0, operator=Growing(), inner=stay),
        SHAPE,
        "the result of the operator of admm must have shape (3,), got (6,); it must not change from call to call",
    ),
    (
        lambda: dp.minimize(lambda x: anp.sum(x**2), np.ones(3), "admm", weight=0.0),
        VALUE,
        "weight of admm must be > 0, got 0; write weight=0.1",
    ),
    (
        lambda: dp.minimize(lambda x: anp.sum(x**2), np.ones(3), "admm", weight=1.0, inner=0),
        VALUE,
        "inner of admm, steps or a function, must be a whole number >= 1, got 0; write inner=10",
    ),
    (
        lambda: dp.minimize(lambda x: anp.sum(x**2), np.ones(3), "admm", weight=1.0, batches=[1]),
        TYPE,
        "admm does not use batches; leave it out",
    ),
    (
        lambda: dp.minimize(lambda x: anp.sum(x**2), np.ones(3), "admm", weights=1.0),
        TYPE,
        "admm has no option 'weights'; it has weight, operator, rho, inner, prox",
    ),
    (
        lambda: dp.stepper("radau", fast, 0.1)(np.ones(3, complex)),
        TYPE,
        "stepper(radau) solves for real unknowns; give real and imaginary part as two fields",
    ),
    (
        lambda: dp.stepper("radau", fast, 0.1)(np.ones(600)),
        SHAPE,
        "stepper(radau) solves full systems of at most 500 unknowns, got 600; take rodas5p",
    ),
    (
        lambda: dp.stepper("radau", lambda u, p: u**2, 50.0)(np.ones(1)),
        dp.errors.ConvergenceError,
        "stepper(radau): Newton's method does not converge in a step of 50; take a smaller dt, "
        "or give stepper a tolerance",
    ),
    (
        lambda: dp.grad(lambda c: anp.real(dp.stepper("radau", turned, 0.1)(np.ones(1), c)[0]))(1.0 + 1.0j),
        dp.errors.DerivativeError,
        "stepper(radau) has derivatives in real params; give real and imaginary part as two",
    ),
    (
        lambda: tensor(np.ones((2, 2, 3, 3))),
        SHAPE,
        "k, a tensor for each cell, must have shape (2, 2, 4, 4), got (2, 2, 3, 3)",
    ),
    (
        lambda: tensor(np.zeros((2, 2, 4, 4))),
        VALUE,
        "k must be positive definite in every cell, but in cell (0, 0) it is [[0.0, 0.0], [0.0, "
        "0.0]]; give it eigenvalues > 0",
    ),
    (
        lambda: tensor(np.ones((2, 2, 4, 4)), dp.from_matrix(dp.divergence(BOX).matrix)),
        SHAPE,
        "a tensor needs D from the faces to the cells of a grid, got <matrix: space(40) -> "
        "space(16), explicit>; write k for each face",
    ),
    (
        lambda: dp.grad(leaked)(1.0),
        dp.errors.DerivativeError,
        "the rate of stepper(radau) uses a traced value that is not an argument; put it into params",
    ),
    (
        lambda: dp.rollout(dp.identity(LINE.cells), np.ones(4), None, 3, memory="reverse"),
        VALUE,
        "memory='reverse' needs a step with step.back(state, params), got <identity: cells(4) -> "
        "cells(4), explicit>; write memory='200 MB', or take a step from stepper('leapfrog', ...)",
    ),
    (
        lambda: dp.grad(lambda c: dp.rollout(Wrong(), 1.0, c, 3, memory="reverse"))(1.0),
        dp.errors.DerivativeError,
        "reversed steps end 3.0e-03 away from the first state, beside states of size 1.0e+00: "
        "rounding grew on the way; give rollout a memory in bytes",
    ),
    (
        lambda: dp.grad(lambda a: anp.sum(repeated(a)))(1.0),
        SHAPE,
        "the gradient must have shape (), got (3,); in the defvjp of a function, add up the cotangents of an argument "
        "that broadcasting repeats",
    ),
    (
        lambda: dp.conservation_law(LINE, lambda u, p, axis: 1j * u, carry)(np.ones(4)),
        TYPE,
        "the flux of a conservation_law must hold real numbers, got dtype complex128; write its .real",
    ),
    (
        lambda: law()(-np.ones(4)),
        VALUE,
        "the speed of a conservation_law must be >= 0, or a pair, the slowest before the "
        "fastest; write abs(u) for u, or (u - c, u + c)",
    ),
    (
        lambda: flow(scalars={"heat": {"source": lambda s, params: np.ones(4)}}, s={"heat": np.ones((4, 4))}),
        SHAPE,
        "flow_step takes a source of 'heat' of shape (4, 4), or a number, got an array of shape "
        "(4,); write one number for each cell",
    ),
    (
        lambda: dp.smoothness(LINE)(np.ones(4, complex)),
        TYPE,
        "smoothness must hold real numbers, got dtype complex128; add the values of u.real and u.imag",
    ),
    (
        lambda: dp.minimize(lambda x: anp.sum(x**2), np.ones(3), "admm", weight=1.0, inner=stay, bounds=(0, 1)),
        TYPE,
        "admm with a function as inner does not use bounds; leave them out, or apply them in inner",
    ),
    (
        lambda: dp.vjp(dp.projection(BOX).pressure, np.zeros(40))[1](np.where(np.eye(4) > 0, np.nan, 1.0)),
        dp.errors.NonFiniteError,
        "pressure solve takes finite numbers, got 4 that are NaN or infinite, the first at (0, 0)",
    ),
]


@pytest.mark.parametrize("call, kind, message", TABLE, ids=[message[:40] for _, _, message in TABLE])
def test_message(call, kind, message):
    with pytest.raises(kind, match=re.escape(message)):
        call()
