"""Every message of stepper, printed once."""

import re

import numpy as np
import pytest

import sparsedp as dp

SHAPE = dp.errors.ShapeError
TYPE = TypeError
VALUE = ValueError
FINITE = dp.errors.NonFiniteError
UNSTABLE = dp.errors.UnstableStepError
L = dp.laplacian(dp.Grid(4), dp.dirichlet)
U = np.ones(4)


def decay(u, p):
    return -p * u


TABLE = [
    (
        lambda: dp.stepper("rk5", decay, 0.1),
        VALUE,
        "method must be one of euler, heun, ssprk3, rk4, backward_euler, crank_nicolson, tr_bdf2, imex, "
        "radau, rodas5p, etdrk4, leapfrog, got 'rk5'; write 'rk4'",
    ),
    (
        lambda: dp.stepper("rodas5p", lambda u, p: u / 0.21193756319429014, 1.0)(np.ones(2)),
        dp.errors.ConvergenceError,
        "stepper(rodas5p): the matrix of a step is singular or nearly so, as the Jacobian of the rate has an "
        "eigenvalue near 1 / (0.212 dt); take a smaller dt, or give stepper a tolerance",
    ),
    (lambda: dp.stepper("euler", L, 0.1, unstable="warn"), VALUE, "unstable must be one of raise, allow, got 'warn'"),
    (
        lambda: dp.stepper("euler", decay, 0.1, tolerance=0),
        VALUE,
        "tolerance of stepper must be between 0 and 1, got 0; write for example 1e-6",
    ),
    (
        lambda: dp.stepper("rk4", decay, 0.1, tolerance=1e-3, floor=(1e-3, -1.0)),
        VALUE,
        "floor must hold finite numbers >= 0, in the units of u, got (0.001, -1.0); write 1e-3",
    ),
    (
        lambda: dp.stepper("rk4", decay, 0.1, tolerance=1e-3, floor="small"),
        VALUE,
        "floor must hold finite numbers >= 0, in the units of u, got 'small'; write 1e-3",
    ),
    (
        lambda: dp.stepper("rk4", lambda u, p: -u, 0.1, tolerance=1e-3, floor=np.ones(2))(np.ones(3)),
        dp.errors.ShapeError,
        "floor: shape (2,) does not fit the state there, of shape (3,); give one number, or a tree like the state",
    ),
    (
        lambda: dp.stepper("radau", lambda u, p: -u, 0.1, tolerance=1e-3, floor=(1.0, 2.0))(np.ones(3)),
        dp.errors.ShapeError,
        "floor: expected one array or number, got a tuple of length 2; give one number, or a tree like the state",
    ),
    (
        lambda: dp.stepper("imex", decay, 0.1),
        TYPE,
        "imex needs the stiff linear term: write linear=L or linear=(L, coefficient)",
    ),
    (
        lambda: dp.stepper("imex", decay, 0.1, linear=0),  # no term
        TYPE,
        "imex needs the stiff linear term: write linear=L or linear=(L, coefficient)",
    ),
    (
        lambda: dp.stepper("etdrk4", dp.from_matrix(np.triu(np.ones((2, 2))), name="A"), 0.1),
        VALUE,
        "stepper(etdrk4) needs a separable operator that can be diagonalised, got "
        "<A: space(2) -> space(2), explicit>; try imex or tr_bdf2",
    ),
    (
        lambda: dp.stepper("etdrk4", -1.0 * L, 1e6)(U),
        FINITE,
        "stepper(etdrk4): exp(1e+06 * -laplacian) must be finite, got 4 that are NaN or infinite, the first "
        "at 0; take a smaller dt or the other sign",
    ),
    (
        lambda: dp.stepper("euler", L, 0.1, linear=L),
        TYPE,
        "give the operator once: as rate, or as linear with the rest as rate",
    ),
    (
        lambda: dp.stepper("euler", 3.0, 0.1),
        TYPE,
        "stepper, as rate, takes a function, got float; write rate=lambda u, params: ...",
    ),
    (
        lambda: dp.stepper("rk4", lambda u: -u, 0.1),
        TYPE,
        "stepper calls a function with 2 arguments, got one that takes 1; "
        "write lambda u, params: ... or lambda u, params, t: ...",
    ),
    (
        lambda: dp.stepper("imex", decay, 0.1, linear=L)({"a": U}),
        TYPE,
        "linear: expected a dict of a, got one operator; write None for a field without a stiff part",
    ),
    (
        lambda: dp.stepper("etdrk4", decay, 0.1, linear={"a": (L, 1.0)})(U),
        TYPE,
        "linear: expected one array or number, got a dict of a; write None for a field without a stiff part",
    ),
    (
        lambda: dp.stepper("imex", decay, 0.1, linear={"a": (L, {"b": L, "c": None})})({"a": (U, {"b": U, "d": U})}),
        TYPE,
        "linear['a'][1]: unknown key 'c'; expected 'b', 'd'; write None for a field without a stiff part",
    ),
    (
        lambda: dp.stepper("imex", decay, 0.1, linear=[L, {"b": 3.0}]),
        TYPE,
        "linear[1]['b'] takes an Operator or a pair (Operator, coefficient), got float",
    ),
    (
        lambda: dp.stepper("imex", lambda u, p: u, 0.1, linear={"a": (L, -1.0)})({"a": U}),
        VALUE,
        "the coefficient of laplacian['a'] must be >= 0, got -1; write a number >= 0, the sign belongs to the operator",
    ),
    (
        lambda: dp.stepper("euler", None, 0.1),
        TYPE,
        "stepper needs a rate, a function rate(u, params) or an Operator, or the option linear",
    ),
    (
        lambda: dp.stepper("euler", decay, 0.1, linear=3.0),
        TYPE,
        "linear takes an Operator or a pair (Operator, coefficient), got float",
    ),
    (
        lambda: dp.stepper("euler", dp.gradient(dp.Grid(4)), 0.1),
        SHAPE,
        "stepper needs an operator from a space to itself, gradient maps cells(4) to faces(4)",
    ),
    (lambda: dp.stepper("euler", decay, 0.0), VALUE, "dt must be > 0, got 0"),
    (lambda: dp.stepper("euler", decay, -1.0), VALUE, "dt must be > 0, got -1"),
    (lambda: dp.stepper("euler", decay, np.nan), FINITE, "dt must be finite, got nan"),
    (lambda: dp.stepper("euler", decay), TYPE, "dt must be one real number, got None"),
    (lambda: dp.stepper("euler", decay, U), TYPE, "dt must be one real number, got an array of shape (4,)"),
    (lambda: dp.stepper("euler", decay, lambda p: -p)(U, 1.0), VALUE, "dt must be > 0, got -1"),
    (
        lambda: dp.stepper("backward_euler", L, 0.1)(U, -1.0),
        VALUE,
        "the coefficient of laplacian must be >= 0, got -1; write a number >= 0, the sign belongs to the operator",
    ),
    (
        lambda: dp.stepper("backward_euler", None, 0.1, linear=(L, np.nan))(U),
        FINITE,
        "the coefficient of laplacian must be finite, got nan",
    ),
    (
        lambda: dp.stepper("euler", L, 0.6)(U, 1.0),
        UNSTABLE,
        "euler is unstable for laplacian with dt = 0.6: the largest stable dt is 0.5; take smaller steps or an "
        "implicit method, or write unstable='allow'",
    ),
    (
        lambda: dp.stepper("euler", lambda u, p, t: u, 0.6)(U),
        TYPE,
        "the state of stepper(euler), whose rate takes a time, must be a pair, got ndarray; write (u, t)",
    ),
    (
        lambda: dp.stepper("euler", lambda u, p: 1j * u, 0.6)(U),
        TYPE,
        "a rate of complex numbers needs a complex state, got float64; write u.astype(complex)",
    ),
    (
        lambda: dp.stepper("euler", lambda u, p: u.__imul__(2.0), 0.6)(U),
        VALUE,
        "the rate changes the state in place; write u = u + du instead of u += du, or work on a copy",
    ),
    (
        lambda: dp.stepper("euler", decay, 0.6)(np.array([1, np.nan, 1]), 1.0),
        FINITE,
        "state of stepper(euler) must be finite, got 1 that are NaN or infinite, the first at 1",
    ),
    (
        lambda: dp.stepper("euler", lambda u, p: p[0] * u, 0.6)(U, (np.inf, 1.0)),
        FINITE,
        "params[0] of stepper(euler) must be finite, got inf; write a finite number",
    ),
    (
        lambda: dp.stepper("euler", lambda u, p: p * u, 1.0)(U * 1e300, 1e300),
        FINITE,
        "stepper(euler) got NaN or infinity from a finite state with dt = 1; take smaller steps or an implicit method",
    ),
    (
        lambda: dp.stepper("euler", lambda u, p: u[:1], 0.6)(U),
        SHAPE,
        "rate: expected shape (4,), got (1,); return a tree like the state",
    ),
    (
        lambda: dp.stepper("rk4", lambda x, p: {"w": x["v"], "u": x["u"]}, 0.6)({"u": U, "v": U}),
        SHAPE,
        "rate: unknown key 'w'; expected 'u', 'v'; return a tree like the state",
    ),
    (
        lambda: dp.stepper("rk4", lambda x, p: (x["v"], x["u"]), 0.6)({"u": U, "v": U}),
        SHAPE,
        "rate: expected a dict of u, v, got a tuple of length 2; return a tree like the state",
    ),
    (
        lambda: dp.stepper("rk4", lambda x, p: (x[0], [*x[1].values()]), 0.6)((U, {"u": U, "v": U})),
        SHAPE,
        "rate[1]: expected a dict of u, v, got a list of length 2; return a tree like the state",
    ),
    (
        lambda: dp.stepper("rk4", lambda x, p: {0: x[0], 1: x[1]}, 0.6)((U, U)),
        SHAPE,
        "rate: expected a tuple of length 2, got a dict of 0, 1; return a tree like the state",
    ),
    (
        lambda: dp.stepper("rk4", lambda x, p: (x[0], [x[1][0]]), 0.6)((U, {0: U})),
        SHAPE,
        "rate[1]: expected a dict of 0, got a list of length 1; return a tree like the state",
    ),
    (
        lambda: dp.stepper("tr_bdf2", dp.laplacian(dp.Grid(3)), 0.6)(U),
        SHAPE,
        "stepper(tr_bdf2) takes a field on cells(3), got an array of shape (4,)",
    ),
    (
        lambda: dp.stepper("rk4", decay, 0.6, tolerance=1e-9)(U.astype(np.float32), 1.0),
        VALUE,
        "stepper(rk4) cannot meet the tolerance 1e-09 with a state of float32, whose rounding is 1.2e-07; take a "
        "larger tolerance or write u.astype(float)",
    ),
    (
        lambda: dp.stepper("rk4", lambda u, p: u * np.nan, 0.6, tolerance=1e-3)(U),
        FINITE,
        "the rate of stepper(rk4) must be finite at the state given; take a state in its domain",
    ),
    (
        lambda: dp.stepper("rk4", decay, 0.6, tolerance=1e-3)(U, np.nan),
        FINITE,
        "params of stepper(rk4) must be finite, got nan; write a finite number",
    ),
]


@pytest.mark.parametrize(("call", "error", "message"), TABLE, ids=[row[2][:50] for row in TABLE])
def test_message(call, error, message):
    with np.errstate(over="ignore"), pytest.raises(error) as caught:
        call()
    assert str(caught.value) == message


def test_unstable_steps_are_taken_when_allowed():
    step = dp.stepper("euler", L, 0.75, unstable="allow")
    mode = np.array([1.0, -1.0, 1.0, -1.0])  # eigenvalue -4
    assert step(mode, 1.0) == pytest.approx(-2 * mode)


def test_the_limit_itself_is_stable():
    for op in (L, L.explicit(), dp.from_matrix(L.matrix)):
        assert np.all(np.abs(dp.stepper("euler", op, 0.5)(U, 1.0)) <= 1)
        with pytest.raises(UNSTABLE, match="the largest stable dt is"):
            dp.stepper("rk4", op, 0.7)(U, 1.0)


def test_no_step_meets_the_tolerance():
    """The solution 1 / (1 - t) ends at t = 1."""
    step = dp.stepper("rk4", lambda u, p: u**2, 2.0, tolerance=1e-3)
    message = (
        r"stepper\(rk4\) found no step that meets the tolerance 0.001 at 0.5 of its interval after \d+ steps; take a "
        "larger tolerance, a method for stiff problems, or an interval that ends before the solution does"
    )
    with pytest.raises(dp.errors.ConvergenceError, match=message):
        step(np.ones(1))


@pytest.mark.parametrize("method", ["heun", "tr_bdf2", "radau"])
def test_a_rate_that_sets_in_from_a_state_of_zero_advises_a_floor(method):
    """Errors are relative to a state of 0 until the rate sets in; with a floor the value is 2 - 0.53."""
    sets_in = lambda u, p, t: np.where(t < 0.53, 0.0, 1.0) + 0.0 * u
    with pytest.raises(
        dp.errors.ConvergenceError, match="an array of the state is 0 there.*; write floor=.* or breaks="
    ):
        dp.stepper(method, sets_in, 2.0, tolerance=1e-6)((np.zeros(2), 0.0))
    with_floor = dp.stepper(method, sets_in, 2.0, tolerance=1e-6, floor=1.0)
    np.testing.assert_allclose(with_floor((np.zeros(2), 0.0))[0], 1.47, rtol=1e-5)


@pytest.mark.parametrize("method", ["rk4", "backward_euler"])
def test_a_rate_that_writes_into_the_state_is_named_when_only_params_are_traced(method):
    def rate(u, p):
        u *= p
        return u

    message = "the rate changes the state in place; write u = u + du instead of u += du, or work on a copy"
    step = dp.stepper(method, rate, 0.1)
    for last in (lambda p: sum(step(U, p)), lambda p: sum(dp.rollout(step, U, p, 2))):
        with pytest.raises(ValueError, match=re.escape(message)):
            dp.value_and_grad(last)(1.0)


def fastest(op):
    return float(np.min(np.linalg.eigvals(op.matrix.toarray()).real))


@pytest.mark.parametrize("method", ["backward_euler", "crank_nicolson", "tr_bdf2", "imex"])
@pytest.mark.parametrize(
    "grid",
    [
        dp.Grid((9, 8), size=1.0),
        dp.Grid((9, 8), size=1.0, periodic=True),
        dp.Grid((6, 5), spacing=[np.linspace(0.1, 0.3, 6), np.linspace(0.2, 0.1, 5)]),
    ],
    ids=["even", "around", "uneven"],
)
def test_an_operator_of_the_wrong_sign_is_refused(method, grid):
    """Where steps with it would turn signs and grow; with L itself, and in steps that can follow, all is well."""
    L = dp.laplacian(grid)
    rate = lambda u, p: 0.0 * u

    def stepped(operator, h):
        with_rate = dict(linear=operator) if method == "imex" else {}
        step = dp.stepper(method, rate if with_rate else operator, h, **with_rate)
        return dp.rollout(step, np.cos(np.arange(np.prod(grid.shape)) ** 2.0).reshape(grid.shape), None, 2)

    with pytest.raises(
        dp.errors.UnstableStepError,
        match="the operator of .* makes fields grow faster than the step can follow, as -laplacian does; change "
        "its sign, or take a smaller time step$",
    ):
        stepped(-L, 0.5)
    with pytest.raises(dp.errors.UnstableStepError):  # the fastest alone is beyond it
        stepped(-L, {"backward_euler": 1.3, "crank_nicolson": 2.6}.get(method, 4.4) / -fastest(L))
    assert np.all(np.isfinite(stepped(L, 0.5))) and np.all(np.isfinite(stepped(-L, 1e-5)))


def test_intended_growth_is_allowed():
    """Swift and Hohenberg's operator, with waves that grow; a growth of its own; one that is not symmetric."""
    grid = dp.Grid(32, size=20.0, periodic=True)
    one = dp.identity(grid.cells)
    L = dp.laplacian(grid)
    pattern = 0.3 * one - (one + L) @ (one + L)
    turned = dp.from_matrix(np.array([[1.0, -10.0], [10.0, -3.0]]))
    for op, h, u in ((pattern, 1.0, np.ones(32)), (0.5 * one, 1.0, np.ones(32)), (turned, 2.0, np.ones(2))):
        assert np.all(np.isfinite(dp.stepper("backward_euler", op, h)(u, None)))
    with pytest.raises(dp.errors.UnstableStepError):
        dp.stepper("backward_euler", 2.0 * one, 1.0)(np.ones(32), None)


def test_a_stage_without_a_root_says_what_to_change():
    """x = -(1 + x^2) has no real root."""
    step = dp.stepper("backward_euler", lambda u, p: -1.0 - u**2, 1.0)
    with pytest.raises(dp.errors.ConvergenceError, match=r"; take a smaller dt, or give stepper a tolerance$"):
        step(np.zeros(2))


@pytest.mark.parametrize(
    "make, message",
    [
        (
            lambda: dp.stepper("rk4", lambda u, p: -u, 0.5, tolerence=1e-10),
            "rk4 does not use tolerence; write 'tolerance'",
        ),
        (lambda: dp.stepper("rk4", lambda u, p: -u, 0.5, t_events=[]), "rk4 does not use t_events; write 'events'"),
        (lambda: dp.stepper("tr_bdf2", lambda u, p: -u, 0.5, tolerence=1e-10), "method auto takes the options"),
        (
            lambda: dp.stepper("rk4", lambda u, p: -u, 0.5, jacobian=lambda u, p: L),
            "rk4 does not use jacobian; leave it out",
        ),
        (lambda: dp.stepper("euler", lambda u, p: -u, 0.5, cycle="V"), "euler does not use cycle; leave it out"),
        (lambda: dp.implicit(lambda x: x, foo=1), "method auto takes the options .*, got 'foo'"),
        (lambda: dp.elliptic_solver(dp.divergence(dp.Grid(4)), dp.gradient(dp.Grid(4)), foo=1), "got 'foo'"),
        (
            lambda: dp.matrix_solver(np.eye(2), "direct", foo=1),
            "method direct takes the options rtol, maxiter, nullspace, precision, got 'foo'",
        ),
        (lambda: dp.projection(dp.Grid(4), foo=1), "got 'foo'"),
    ],
)
def test_an_unused_option_is_refused(make, message):
    with pytest.raises(TypeError, match=message):
        make()
