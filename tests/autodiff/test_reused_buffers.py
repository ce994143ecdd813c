"""Functions of users that write into one array and return it every time: each result counts as it was when returned.

What is compared with stands in NumPy, or is the same function with fresh results.
"""

from functools import wraps

import autograd.numpy as anp
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import LinearOperator

import sparsedp as dp
from sparsedp._utils.pytree import leaves
from sparsedp.autodiff.derivative import pullback, pushforward
from sparsedp.autodiff.tape import isbox

N = 30


def reusing(f):
    """f as foreign code is written: one array for its results; traced calls, where nothing can be written, apart."""
    arrays: dict = {}

    @wraps(f)
    def act(*args):
        y = f(*args)
        if any(map(isbox, leaves((args, y)))):
            return y
        y = np.asarray(y)
        room = arrays.setdefault((y.shape, y.dtype), np.empty_like(y))
        room[...] = y
        return room

    return act


def steep(x):
    return np.sin(x) * np.roll(x, 1)


def steep_matrix(x):
    return np.diag(np.cos(x) * np.roll(x, 1)) + np.sin(x)[:, None] * np.roll(np.eye(N), -1, 1)


@pytest.mark.parametrize("derivative", ["auto", "complex", "difference"])
def test_adopted_code(rng, derivative):
    x, g = rng.standard_normal((2, N))
    f = dp.from_blackbox(reusing(steep), derivative=derivative)
    y, pull = pullback(f, x)
    assert np.allclose(pull(g), steep_matrix(x).T @ g, rtol=1e-7)
    assert np.array_equal(y, steep(x)) and np.allclose(pushforward(f, x, g)[1], steep_matrix(x) @ g, rtol=1e-7)


def test_adopted_code_that_works_in_its_argument(rng):
    """And returns a view of it."""

    def inside(x):
        x[1:] += x[:-1] ** 2
        return x[::-1]

    x = rng.standard_normal(N)
    f = dp.from_blackbox(inside)
    known = (np.eye(N) + np.diag(2 * x[:-1], -1))[::-1]
    assert np.allclose(f.jacobian(x).toarray(), known, rtol=1e-12)
    two = f(x), f(2 * x)
    assert np.array_equal(two[0], (x + np.append(0.0, x[:-1] ** 2))[::-1]) and not np.may_share_memory(*two)


def test_rules_of_users(rng):
    """Value, VJP and JVP, each with an array of its own; the rule is called twice in one loss."""
    push = reusing(lambda t, x: np.cos(x) * t)
    back = reusing(lambda g, x: np.cos(x) * g)
    rule = dp.differentiable(
        "sine",
        reusing(np.sin),
        lambda nums, y, x: lambda g: (back(g, x),),
        lambda nums, tangents, y, x: push(tangents[0], x),
    )
    x, v = rng.standard_normal((2, N))
    loss = lambda x, np=anp, sin=rule: np.sum(sin(x) * sin(2 * x) + sin(x + 1) ** 2)
    slope = np.cos(x) * np.sin(2 * x) + 2 * np.sin(x) * np.cos(2 * x) + 2 * np.sin(x + 1) * np.cos(x + 1)
    value, found = dp.value_and_grad(loss)(x)
    assert value == pytest.approx(loss(x, np, np.sin), rel=1e-14)
    assert loss(x) == pytest.approx(value, rel=1e-14)
    assert np.allclose(found, slope, rtol=1e-13)
    assert pushforward(loss, x, v)[1] == pytest.approx(slope @ v, rel=1e-12)
    assert dp.check.gradient(loss, x).verdict == "agrees"


@pytest.mark.parametrize("part", ["forward", "pull", "vjp", "jvp"])
def test_rules_of_users_cannot_write_into_what_they_are_given(part):
    """The tape needs it: a cotangent goes to both terms of a sum, a tangent to all that its value is used for."""

    def act(x, name):
        if name == part:
            x[0] = 0.0
        return x

    def vjp(nums, ans, x):
        act(x, "vjp")
        return lambda g: (act(g, "pull"),)

    rule = dp.differentiable("change", lambda x: act(x, "forward"), vjp, lambda nums, ts, ans, x: act(ts[0], "jvp"))
    x = np.arange(1.0, 4.0)
    t = np.ones(3)
    with pytest.raises(ValueError, match="read-only"):
        dp.jvp(rule, x, t) if part == "jvp" else dp.grad(lambda x: anp.sum(x * x + rule(x)))(x)
    assert np.array_equal(x, [1, 2, 3]) and np.array_equal(t, [1, 1, 1])


def test_physical_gradient(rng):
    physics = reusing(lambda x: 2 * x)
    inverse = reusing(lambda y, x: y / 2)
    f = dp.physical_gradient(physics, inverse)
    x = rng.standard_normal(N)
    value, g = dp.value_and_grad(lambda x: anp.sum(f(x) * f(x + 1)))(x)
    assert value == pytest.approx(np.sum(2 * x * 2 * (x + 1)), rel=1e-14)
    assert np.allclose(g, 2 * (x + 1) / 2 + 2 * x / 2)  # x - inverse(y - g) = g / 2 of each call


@pytest.mark.parametrize("kind", ["functions", "linear operator"])
def test_operators_of_users(rng, kind):
    A = rng.standard_normal((N, N))
    forward = reusing(lambda u: A @ u)
    backward = reusing(lambda g: A.T @ g)
    op = dp.from_functions(forward, backward, N, N)
    if kind == "linear operator":
        op = dp.from_linear_operator(LinearOperator((N, N), matvec=forward, rmatvec=backward, dtype=float))
    u = rng.standard_normal(N)
    assert not np.may_share_memory(op(u), op(2 * u))
    loss = lambda u: anp.sum(op(u) * op(u * u)) + anp.sum(op.T(u) ** 2)
    slope = A.T @ (A @ (u * u)) + 2 * u * (A.T @ (A @ u)) + 2 * A @ (A.T @ u)
    assert np.allclose(dp.value_and_grad(loss)(u)[1], slope, rtol=1e-12)
    assert np.allclose((op @ op + op).matrix.toarray(), A @ A + A)
    assert dp.check.operator(op).verdict == "agrees" if hasattr(dp.check.operator(op), "verdict") else True


@pytest.mark.parametrize("form", ["dense", "sparse", "none"])
@pytest.mark.parametrize("size", [3, 100])
def test_residuals_and_jacobians(rng, form, size):
    """x^3 + x = b, by a residual and a Jacobian in arrays of their own."""
    residual = reusing(lambda x, b: x**3 + x - b)
    stored = sp.eye_array(size, format="csr")

    def sparse(x, b):
        stored.data[:] = 3 * x**2 + 1
        return stored

    jacobian = {"dense": reusing(lambda x, b: np.diag(3 * x**2 + 1)), "sparse": sparse, "none": None}[form]
    root = dp.implicit(residual, jacobian)
    guess = np.zeros(size)
    one, other, g = rng.standard_normal((3, size))
    x, pull = pullback(lambda b: root(guess, b), one)
    y, pull_other = pullback(lambda b: root(guess, b), other)
    for z, b, back in ((x, one, pull), (y, other, pull_other)):
        assert np.allclose(z**3 + z, b, atol=1e-9)
        assert np.allclose(back(g), g / (3 * z**2 + 1), rtol=1e-7)


METHODS = ["euler", "heun", "ssprk3", "rk4", "backward_euler", "crank_nicolson", "tr_bdf2"]


@pytest.mark.sampled(0)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("tolerance", [None, 1e-4])
def test_rates(rng, method, tolerance):
    """The rates of all stages in one array."""
    rate = lambda u, params: -params * u * u + anp.roll(u, 1)
    u = 1 + rng.random(N)
    fresh, reused = (dp.stepper(method, f, 0.1, tolerance=tolerance) for f in (rate, reusing(rate)))
    wanted = fresh(u, 0.7)
    assert np.array_equal(reused(u, 0.7), wanted)
    if method == "rk4" and tolerance is None:  # by hand
        k1 = rate(u, 0.7)
        k2 = rate(u + 0.05 * k1, 0.7)
        k3 = rate(u + 0.05 * k2, 0.7)
        k4 = rate(u + 0.1 * k3, 0.7)
        assert np.allclose(wanted, u + 0.1 / 6 * (k1 + 2 * k2 + 2 * k3 + k4), rtol=1e-15)
    trees = [dp.stepper(method, f, 0.1) for f in (lambda u, p: {"a": rate(u["a"], p)}, _in_tree(rate))]
    assert np.array_equal(*(step({"a": u}, 0.7)["a"] for step in trees))


def _in_tree(rate):
    inner = reusing(rate)
    return lambda u, p: {"a": inner(u["a"], p)}


@pytest.mark.parametrize("method", ["imex", "etdrk4"])
@pytest.mark.parametrize("tolerance", [None, 1e-4])
def test_split_rates_and_sources(rng, method, tolerance):
    L = dp.laplacian(dp.Grid(N, size=1.0))
    u = rng.standard_normal(N)
    rate = lambda u, p, t: anp.sin(u) * p
    source = lambda p, t: anp.cos(t + p) * np.ones(N)
    make = lambda f, s: dp.stepper(method, f, 0.01, linear=(L, 0.1), source=s, tolerance=tolerance)
    wanted, found = (make(*pair)((u, 0.3), 0.5) for pair in ((rate, source), (reusing(rate), reusing(source))))
    assert np.array_equal(wanted[0], found[0])


@pytest.mark.parametrize("method", METHODS)
def test_sources_of_linear_problems(rng, method):
    L = 1e-3 * dp.laplacian(dp.Grid(N, size=1.0))
    u = rng.standard_normal(N)
    source = lambda p, t: anp.cos(t + p) * np.ones(N)
    wanted, found = (dp.stepper(method, L, 0.01, source=s)((u, 0.3), 0.5) for s in (source, reusing(source)))
    assert np.array_equal(wanted[0], found[0])


def test_rates_in_float32_and_of_numbers():
    rate = lambda u, p: -u * p
    for u in (np.ones(5, np.float32), np.array(2.0), 2.0):
        wanted, found = (dp.stepper("rk4", f, 0.1)(u, 0.5) for f in (rate, reusing(rate)))
        assert np.array_equal(wanted, found) and np.asarray(found).dtype == np.asarray(wanted).dtype


@pytest.mark.parametrize("convective", [True, False])
def test_forces_and_viscosities(rng, convective):
    grid = dp.Grid((6, 5), size=1.0)
    force = lambda v, p: -p * v
    viscosity = lambda p: 0.01 * p
    v = rng.standard_normal(grid.faces.size)
    held = np.arange(grid.faces.size)
    friction = lambda p: p * held
    for f, nu, drag in ((force, viscosity, friction), tuple(map(reusing, (force, viscosity, friction)))):
        step = dp.flow_step(grid, 1e-3, viscosity=nu, force=f, convective=convective, friction=drag)
        run = lambda v, p, step=step: dp.rollout(step, step.start(v, p), p, 3)["v"]
        found = run(v, 0.5), *dp.value_and_grad(lambda p, run=run: anp.sum(run(v, p) ** 2))(0.5)
        if f is force:
            wanted = found
    assert np.array_equal(found[0], wanted[0]) and found[1:] == wanted[1:]


def march(u, p):
    """A step that is not the same when it writes over what it reads."""
    new = u.copy() if not isbox(u) else u
    for _ in range(2):
        new = new + p * (anp.roll(new, 1) - new) * new
    return new


def over(u, p):
    """The same in place, place by place, in the array that is returned."""
    if isbox(u) or isbox(p):
        return march(u, p)
    ROOM[:] = u
    for _ in range(2):
        before = ROOM.copy()
        for i in range(N):
            ROOM[i] = before[i] + p * (before[i - 1] - before[i]) * before[i]
    return ROOM


ROOM = np.empty(N)


@pytest.mark.parametrize("memory", [None, 3000])
@pytest.mark.parametrize("keep", ["last", "all", "each"])
def test_steps(rng, memory, keep):
    u = 0.1 + rng.random(N)
    g = rng.standard_normal(N)
    kept = (lambda i, state: state) if keep == "each" else keep
    total = lambda made: sum(anp.sum(g * (one + one**2)) for one in ([made] if keep == "last" else made))
    states = [u]
    for _ in range(7):
        states.append(march(states[-1], 0.1))
    wanted = total(states[-1] if keep == "last" else states)
    run = lambda u, p, f=over: total(dp.rollout(f, u, p, 7, memory=memory, keep=kept))
    assert run(u, 0.1) == pytest.approx(wanted, rel=1e-12)
    value, slope = dp.value_and_grad(lambda x: run(*x))((u, 0.1))
    known = dp.value_and_grad(lambda x: run(*x, march))((u, 0.1))[1]
    assert value == pytest.approx(wanted, rel=1e-12)
    assert np.allclose(slope[0], known[0], rtol=1e-9) and slope[1] == pytest.approx(known[1], rel=1e-9)


def test_what_keep_returns(rng):
    u = rng.random(N)
    keep = reusing(lambda i, u: i * u)
    made = dp.rollout(lambda u, p: 0.5 * u, u, None, 4, keep=keep)
    assert all(np.array_equal(one, i * u * 0.5**i) for i, one in enumerate(made))
    whole = dp.rollout(lambda u, p: 0.5 * u, u, None, 4, keep=reusing(lambda i, u: np.full(2, i)))
    assert [int(one[0]) for one in whole] == [0, 1, 2, 3, 4]  # whole numbers are no variables, and no less kept


def rosenbrock(x):
    return np.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)


def rosenbrock_slope(x):
    g = np.zeros_like(x)
    g[1:] += 200 * (x[1:] - x[:-1] ** 2)
    g[:-1] -= 400 * x[:-1] * (x[1:] - x[:-1] ** 2) + 2 * (1 - x[:-1])
    return g


@pytest.mark.parametrize("method", ["lbfgs", "gd", "adam"])
def test_gradients_for_minimize(method):
    start = np.full(4, 0.5)
    options = dict(method=method, maxiter=30)
    wanted = dp.minimize(rosenbrock, start, gradient=rosenbrock_slope, **options)
    found = dp.minimize(reusing(rosenbrock), start, gradient=reusing(rosenbrock_slope), **options)
    assert np.array_equal(found.x, wanted.x) and found.value == wanted.value
    assert [one.value for one in found.history] == [one.value for one in wanted.history]


def test_batches_for_minimize():
    data = np.arange(12.0).reshape(4, 3)
    loss = lambda x, batch: anp.sum((x - batch) ** 2)
    room = np.empty(3)

    def batches(i):
        room[:] = data[i % 4]
        return room

    options = dict(method="adam", maxiter=9)
    wanted, found = (dp.minimize(loss, np.zeros(3), batches=b, **options) for b in (list(data), batches))
    assert np.array_equal(wanted.x, found.x)
    linear = lambda x, batch: x - batch
    options = dict(method="half_inverse", maxiter=9)
    wanted, found = (dp.minimize(linear, np.zeros(3), batches=b, **options) for b in (list(data), batches))
    assert np.array_equal(wanted.x, found.x)


def test_checks_of_reused_losses(rng):
    x = rng.standard_normal(5)
    loss = reusing(lambda x: np.sum(x**3))
    slope = reusing(lambda x: 3 * x**2)
    assert dp.check.gradient(loss, x, gradient=slope).verdict == "agrees"
    assert dp.check.gradient(loss, x, gradient=reusing(lambda x: 3.001 * x**2)).verdict == "disagrees"
    assert dp.check.order(reusing(lambda n: 1 / n**2), expected=2).verdict == "agrees"


def test_a_reused_preconditioner(rng):
    A = np.diag(2 + rng.random(60)) + np.diag(0.5 * np.ones(59), 1)
    b = rng.standard_normal(60)
    scale = 1 / np.diag(A)
    op = dp.from_matrix(A)
    solve = dp.inverse(op, "krylov", preconditioner=reusing(lambda r: scale * r))
    assert np.allclose(solve(b), np.linalg.solve(A, b)) and np.allclose(solve.T(b), np.linalg.solve(A.T, b))
