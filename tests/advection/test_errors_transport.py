"""Every message of transport: what was given, what is needed, what to write instead."""

import re

import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.derivative import value_and_grad
from sparsedp.errors import DerivativeError, NonFiniteError, ShapeError, UnstableStepError

GRID = dp.Grid((3, 2))
U = np.ones((3, 2))
V = np.zeros(17)


def bad(array, index, value=np.nan):
    array = np.array(array, dtype=float)
    array[index] = value
    return array


def through_walls():
    """A velocity that is too large on one face, out of a cell of a 1-D grid."""
    return dp.transport(dp.Grid(4, spacing=0.5))(np.ones(4), np.array([0, 0, 2.0, 0, 0]), 0.5)


def traced_solid(x):
    return dp.transport(GRID, solid=x)(U, V, 0.1)


def frozen():
    dp.transport(GRID).method = None


def call(u=U, v=V, dt=0.1, inflow=0.0, **options):
    return lambda: dp.transport(GRID, **options)(u, v, dt, inflow)


CASES = [
    (lambda: dp.transport(7), TypeError, "transport takes a Grid, got int; write dp.Grid((64, 64), size=1.0)"),
    (
        lambda: dp.transport(GRID, of="nodes"),
        ValueError,
        "of= of transport must be one of cells, faces, got 'nodes'",
    ),
    (
        lambda: dp.transport(GRID, boundary=dp.robin(1, 1)),
        ValueError,
        "transport takes dirichlet (inflow values) or neumann (outflow), got robin(1, 1); write boundary=dp.dirichlet",
    ),
    (frozen, AttributeError, "Transport is frozen; make a new one instead of setting method"),
    (
        call(dt=0.0),
        ValueError,
        "dt of transport upwind must be > 0, got 0; write dt=0.01, or -v for a step backwards in time",
    ),
    (
        call(dt="soon"),
        TypeError,
        "dt of transport upwind must be one real number, got 'soon'",
    ),
    (
        call(dt=np.nan),
        NonFiniteError,
        "dt of transport upwind must be finite, got nan",
    ),
    (call(u=U[0]), ShapeError, "transport upwind takes u of shape (3, 2), got an array of shape (2,)"),
    (
        call(v=U),
        ShapeError,
        "transport upwind takes v of shape (17,), got an array of shape (3, 2); "
        "write grid.join(...) for the components on faces, or velocity='cells'",
    ),
    (
        call(v=GRID.split(V)),
        ShapeError,
        "transport upwind takes v as one array, got a tuple of 2 parts; write grid.join(...) for faces",
    ),
    (
        lambda: dp.transport(dp.Grid(4, size=4 / 3, periodic=True))(np.ones(4), 3 * np.ones(4), 0.12),
        UnstableStepError,
        "transport upwind: dt = 0.12 is too large at 4 of 4 points, most at 0; "
        "the largest stable dt is 0.111111, or write unstable='allow'",
    ),
    (
        call(inflow=np.ones(3), boundary=dp.dirichlet),
        ShapeError,
        "transport upwind takes inflow of shape (10,), got an array of shape (3,)",
    ),
    (
        call(u=1j * U),
        TypeError,
        "transport upwind takes real numbers as u, got dtype complex128; write u.real or u.astype(float)",
    ),
    (
        call(u=np.ma.masked_array(U)),
        TypeError,
        "transport upwind, as u, takes plain arrays, got a masked array; fill it first",
    ),
    (
        call(u=bad(U, (1, 1))),
        NonFiniteError,
        "transport upwind needs a finite field, got 1 that are NaN or infinite, the first at (1, 1)",
    ),
    (
        call(v=bad(V, slice(5, 7), np.inf)),
        NonFiniteError,
        "transport upwind needs a finite velocity, got 2 that are NaN or infinite, the first at 5",
    ),
    (
        call(inflow=2.0),
        ValueError,
        "transport upwind uses inflow values at sides of dp.dirichlet only, and boundary= has none; write "
        "boundary=dp.dirichlet, or leave the inflow out",
    ),
    (
        lambda: value_and_grad(lambda x: dp.transport(GRID, "semi_lagrangian")(U, V, 0.1, x).sum())(np.zeros(10)),
        ValueError,
        "transport semi_lagrangian uses inflow values at sides of dp.dirichlet only, and boundary= has none; write "
        "boundary=dp.dirichlet, or leave the inflow out",
    ),
    (
        call(inflow=bad(np.zeros(10), 3), boundary=dp.dirichlet),
        NonFiniteError,
        "transport upwind needs finite inflow values, got 1 that are NaN or infinite, the first at 3",
    ),
    (
        through_walls,
        UnstableStepError,
        "transport upwind: dt = 0.5 is too large at 1 of 4 points, most at 1; "
        "the largest stable dt is 0.25, or write unstable='allow'",
    ),
    (
        lambda: dp.transport(GRID)(1.7e308 * U, GRID.join(np.array([[0], [0.4], [-0.4], [0]]), 0.0), 1.0),
        NonFiniteError,
        "transport upwind cannot represent the result, got 2 that are NaN or infinite, the first at (1, 0)",
    ),
    (
        lambda: value_and_grad(lambda x: traced_solid(x).sum())(U),
        DerivativeError,
        "solid needs a constant boolean array, got a traced one; take it from plain numbers",
    ),
    (
        lambda: value_and_grad(lambda x: dp.transport(GRID).operator(x, 0.1)(U).sum())(V),
        DerivativeError,
        "transport upwind.operator needs constant v and dt, got traced ones; call move(u, v, dt) instead",
    ),
    (
        lambda: dp.transport(GRID).step(0.1),
        AttributeError,
        "transport has no attribute 'step'; write lambda u, v: move(u, v, dt)",
    ),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case[2][:60])
def test_message(case):
    act, kind, message = case
    with pytest.raises(kind, match=f"^{re.escape(message)}$"):
        act()


def test_messages_of_other_schemes(monkeypatch):
    """Messages of a scheme that is not linear and has no second derivatives."""
    move = dp.transport(GRID)
    move.method.linear = move.method.any_order = False
    message = "transport upwind is not linear in u and has no matrix; write scheme='upwind', or call move(u, v, dt)"
    with pytest.raises(ValueError, match=re.escape(message)):
        move.operator(V, 0.1)
    message = "transport upwind has first derivatives only; for second ones write scheme='upwind'"
    slope = value_and_grad(lambda u: (move(u, V, 0.1) ** 2).sum())
    with pytest.raises(DerivativeError, match=message):
        value_and_grad(lambda u: (slope(u)[1] ** 2).sum())(U)


UNUSED = {
    "upwind": {"interpolation": "cubic", "backtrace": "midpoint", "clamp": False},
    "van_leer": {"interpolation": "cubic", "backtrace": "midpoint", "clamp": False},
    "semi_lagrangian": {"form": "advective", "clamp": False, "unstable": "allow"},
    "maccormack": {"form": "flux", "unstable": "allow"},
}


@pytest.mark.parametrize("scheme", UNUSED)
def test_an_option_that_a_scheme_does_not_use_is_refused(scheme):
    for name, value in UNUSED[scheme].items():
        with pytest.raises(ValueError, match=f"transport {scheme} does not use {name}; leave it out"):
            dp.transport(GRID, scheme, **{name: value})


@pytest.mark.parametrize("word", ["midpoint", "clamped", "unclamped midpoint"])
def test_old_values_of_form_are_refused(word):
    message = f"form= of transport must be one of flux, advective, got '{word}'; write backtrace= or clamp="
    with pytest.raises(ValueError, match=message):
        dp.transport(GRID, "maccormack", form=word)


@pytest.mark.parametrize("options", [{"clamp": 1}, {"clamp": None}, {"backtrace": np.array(["euler"])}, {"form": True}])
def test_options_of_a_wrong_type_are_refused(options):
    with pytest.raises(ValueError, match="of transport must be one of"):
        dp.transport(GRID, "maccormack", **options)
