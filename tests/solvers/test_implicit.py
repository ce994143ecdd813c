"""implicit: roots against dense formulas, derivatives of both orders, Jacobians by colours, and honest failures."""

import autograd.numpy as anp
import numpy as np
import pytest
import scipy.sparse as sp
from residuals import PROBLEMS, diffusion, directions, dot, moved, rate

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp._utils.pytree import leaves
from sparsedp.autodiff.derivative import pullback, pushforward, value_and_grad
from sparsedp.autodiff.tape import isbox, plain
from sparsedp.errors import ConvergenceError, DerivativeError
from sparsedp.solvers import jacobian, sparsity
from sparsedp.solvers.jacobian import Jacobians, Linearisation
from sparsedp.solvers.newton import Equation
from sparsedp.solvers.roots import implicit


def flat(tree):
    return np.concatenate([np.ravel(leaf) for leaf in leaves(tree) if leaf is not None])


def dense_gradient(problem, x, g):
    """-F_p^T J^-T g with J from one pullback for each row of the residual."""
    rows = pullback(lambda x: problem.residual(x, problem.params), x)[1]
    value, of_params = pullback(lambda p: problem.residual(x, p), problem.params)
    if isinstance(value, tuple):
        raise TypeError("one field only")
    units = np.eye(value.size).reshape(-1, *value.shape)
    J = np.array([flat(rows(unit)) for unit in units])
    return of_params(-np.linalg.solve(J.T, flat(g)).reshape(value.shape))


@pytest.fixture(params=PROBLEMS, scope="module")
def problem(request):
    return PROBLEMS[request.param]()


# ---- first and second derivatives --------------------------------------------------------------------------------


def test_the_residual_is_zero_at_the_root(problem):
    x = implicit(problem.residual)(problem.guess, problem.params)
    assert np.max(np.abs(flat(problem.residual(x, problem.params)))) <= 1e-10 * problem.scale


def test_taylor_rates(problem):
    """Order 2 with the gradient and 3 with the Hessian; order 1 and 2 without them."""
    loss = problem.loss(implicit(problem.residual))
    p = problem.params
    d = directions(p)
    value, g = value_and_grad(loss)(p)
    slope = dot(g, d)
    curvature = dot(pushforward(lambda p: value_and_grad(loss)(p)[1], p, d)[1], d)
    change = lambda h: loss(moved(p, h, d)) - value
    assert rate(lambda h: change(h)) == pytest.approx(1.0, abs=0.1)
    assert rate(lambda h: change(h) - h * slope) >= 1.95
    assert rate(lambda h: change(h) - h * slope - h**2 / 2 * curvature) >= 2.9


def test_every_mode_of_second_order_agrees(problem):
    loss = problem.loss(implicit(problem.residual))
    p = problem.params
    d = directions(p)
    slope = lambda p: value_and_grad(loss)(p)[1]
    along = lambda p: pushforward(loss, p, d)[1]
    wanted = pushforward(slope, p, d)[1]
    for found in (value_and_grad(lambda p: dot(slope(p), d))(p)[1], value_and_grad(along)(p)[1]):
        np.testing.assert_allclose(flat(found), flat(wanted), rtol=1e-10, atol=1e-12 * np.max(np.abs(flat(wanted))))
    assert pushforward(along, p, d)[1] == pytest.approx(float(dot(wanted, d)), rel=1e-10)
    assert along(p) == pytest.approx(float(dot(slope(p), d)), rel=1e-11)


@pytest.mark.parametrize("name", ["diffusion 1-D", "advection 1-D", "backward Euler", "fields in one array"])
def test_gradient_is_the_dense_formula(name):
    problem = PROBLEMS[name]()
    root = implicit(problem.residual)
    x, pull = pullback(lambda p: root(problem.guess, p), problem.params)
    g = np.cos(np.arange(x.size)).reshape(x.shape)
    np.testing.assert_allclose(flat(pull(g)), flat(dense_gradient(problem, x, g)), rtol=1e-11)


@pytest.mark.slow
def test_check_gradient_agrees_and_detects_planted_errors(monkeypatch):
    """J for its transpose, and a second derivative that holds x still."""
    problem = PROBLEMS["advection 1-D"]()
    loss = problem.loss(implicit(problem.residual))
    p = problem.params
    assert dp.check.gradient(loss, p, quick=True).verdict == "agrees"
    d = directions(p)
    curvature = lambda: dot(pushforward(lambda p: value_and_grad(loss)(p)[1], p, d)[1], d)
    wanted = curvature()
    with monkeypatch.context() as patch:
        right = Linearisation.solve
        patch.setattr(Linearisation, "solve", lambda self, b, transposed: right(self, b, False))
        assert dp.check.gradient(loss, p).verdict == "disagrees"
    right_transposed = Equation.transposed
    monkeypatch.setattr(Equation, "transposed", lambda self, x, values: right_transposed(self, plain(x), values))
    assert abs(curvature() / wanted - 1) > 1e-3


def test_a_wrong_guess_of_a_stencil_is_not_used_for_products(monkeypatch):
    """A random matrix with few entries in the probed columns: neither a stencil nor sparse enough to colour."""
    monkeypatch.setattr(jacobian, "FULL_AT_MOST", 200)
    monkeypatch.setattr(sparsity, "ONE_BY_ONE_UP_TO", 200)
    rng, size = np.random.default_rng(0), 300
    matrix = sp.random_array((size, size), density=0.1, rng=rng) + 40.0 * sp.eye_array(size)
    op = dp.from_matrix(matrix)
    root = implicit(lambda x, p: op(x) + 0.1 * x**3 - p)
    x = root(np.zeros(size), np.ones(size))
    assert "products only" in str(root) and "300 products" not in str(root)
    assert "only products with the operator are known" in str(root)
    np.testing.assert_allclose(matrix @ x + 0.1 * x**3, 1.0, rtol=1e-9)


# ---- how often ---------------------------------------------------------------------------------------------------


def test_one_adjoint_solve_for_all_parameters_and_none_without_a_gradient():
    problem = PROBLEMS["diffusion 1-D"]()
    root = implicit(problem.residual)
    linear = f"{root.name}.jacobian"
    with recording() as calls:
        value_and_grad(problem.loss(root))(problem.params)
    assert calls[root.name, "forward"] == calls[f"{root.name}.T", "forward"] == calls[linear, "adjoint"] == 1
    assert calls[linear, "solve"] == root.info.forward.iterations
    with recording() as calls:
        root(problem.guess, problem.params)
        value, start = value_and_grad(lambda u: anp.sum(root(u, problem.params)) + anp.sum(u))(problem.guess)
        value_and_grad(lambda p: 0.0 * anp.sum(p["f"] * root(plain(problem.guess), problem.params)))(problem.params)
    assert calls[f"{root.name}.T", "forward"] == calls[linear, "adjoint"] == 0
    np.testing.assert_array_equal(start, 1.0)


def test_a_residual_that_is_linear_is_set_up_once():
    op = dp.laplacian(dp.Grid(30, size=1.0), dp.dirichlet)
    root = implicit(lambda u, b: b - op(u))
    with recording() as calls:
        for number in range(3):
            value_and_grad(lambda b: anp.sum(root(np.zeros(30), b) ** 2))(np.ones(30) * (number + 1))
    linear = f"{root.name}.jacobian"
    assert calls[linear, "setup"] == 1 and calls[linear, "solve"] == 3 and calls[linear, "adjoint"] == 3
    assert root.info.forward.iterations == 1


def test_two_alternating_linear_residuals_are_set_up_once_each():
    op = dp.laplacian(dp.Grid(100, size=1.0), dp.dirichlet)
    root = implicit(lambda u, k: k * op(u) - 1.0)
    with recording() as calls:
        for k in (1.0, 2.0, 1.0, 2.0, 1.0, 2.0):
            root(np.zeros(100), k)
    assert calls[f"{root.name}.jacobian", "setup"] == 2


def test_the_adjoint_uses_the_jacobian_at_the_root_not_the_last_one(monkeypatch):
    """With a loose tolerance the last Jacobian of the forward solve is visibly another one."""
    problem = PROBLEMS["advection 1-D"]()

    def gap():
        root = implicit(problem.residual, rtol=1e-2)
        x, pull = pullback(lambda p: root(problem.guess, p), problem.params)
        assert root.info.forward.residual > 1e-6
        wanted = flat(dense_gradient(problem, x, np.ones(x.shape)))
        # The tolerance of the adjoint solve is 1e-2 as well, but LU does not stop there.
        return np.max(np.abs(flat(pull(np.ones(x.shape))) - wanted)) / np.max(np.abs(wanted))

    assert gap() <= 1e-12
    monkeypatch.setattr(Jacobians, "cached", lambda self, *point: self._points.last)
    assert gap() > 1e-4


def test_the_set_up_is_reused_where_the_guess_is_the_root():
    problem = PROBLEMS["diffusion 1-D"]()
    root = implicit(problem.residual)
    x = root(problem.guess, problem.params)
    with recording() as calls:
        value_and_grad(lambda p: anp.sum(root(x, p)))(problem.params)
    assert root.info.forward.iterations == 0
    assert calls[f"{root.name}.jacobian", "setup"] == 1 and calls[f"{root.name}.jacobian", "vjp"] == 3


def test_the_cache_holds_no_traced_values():
    problem = PROBLEMS["diffusion 1-D"]()
    root = implicit(problem.residual)
    loss = problem.loss(root)
    slope = lambda p: value_and_grad(loss)(p)[1]
    first = pushforward(slope, problem.params, directions(problem.params))[1]
    for key, known in root._default_jacobians._points._entries:
        equation, x, values = known.point
        assert not any(map(isbox, (*key, x, *values, *equation.parameters.statics, *leaves(equation.params(values)))))
    second = pushforward(slope, problem.params, directions(problem.params))[1]
    np.testing.assert_array_equal(flat(first), flat(second))


# ---- Jacobians ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("shape", "colours"), [((60,), 3), ((9, 8), 5), ((4, 5, 4), 7)])
def test_colours_on_a_grid(shape, colours):
    problem = diffusion(shape)
    root = implicit(problem.residual)
    root(problem.guess, problem.params)
    with recording() as calls:
        root(problem.guess, problem.params)
    setups = calls[f"{root.name}.jacobian", "setup"]
    assert calls[f"{root.name}.jacobian", "vjp"] == colours * setups and 1 <= setups <= root.info.forward.iterations
    assert (f"{root.name}.pattern", "jvp") not in calls and f"{colours} products" in str(root)


N = 40


def chain(x, p):
    return x + 0.1 * anp.roll(x, 1) ** 2 - p


def with_a_full_row(x, p):
    return anp.concatenate([chain(x, p)[:-1], anp.reshape(anp.sum(x) - 0.9 * N, (1,))])


def full(x, p):
    return chain(x, p) + 0.01 * anp.sum(x**2)


@pytest.mark.parametrize(("residual", "kind", "most"), [(with_a_full_row, "vjp", 5), (full, "vjp", N)])
def test_a_full_row_is_coloured_by_rows_and_a_full_jacobian_by_columns(residual, kind, most):
    root = implicit(residual)
    p = np.ones(N)
    d = np.cos(np.arange(N))
    loss = lambda p: anp.sum(root(np.ones(N), p) ** 2)
    value, slope = value_and_grad(loss)(p)
    with recording() as calls:
        root(np.ones(N), p)
    assert 0 < calls[f"{root.name}.jacobian", kind] <= most * root.info.forward.iterations
    assert rate(lambda h: loss(p + h * d) - value - h * (slope @ d)) >= 1.95


def test_entries_missed_by_probing_are_added():
    """With p = 0 the pattern has no upper diagonal; the next call has one."""
    residual = lambda x, p: 2 * x + x**3 / 10 + p * anp.roll(x, -1) - 1.0
    root = implicit(residual)
    fresh = implicit(residual)
    root(np.zeros(30), 0.0)
    assert "1 products" in str(root)
    for p in (0.5, 1.5):
        assert root(np.zeros(30), p) == pytest.approx(fresh(np.zeros(30), p), rel=1e-10)
        slopes = [value_and_grad(lambda p, r: anp.sum(r(np.zeros(30), p)[:3]))(p, r)[1] for r in (root, fresh)]
        assert slopes[0] == pytest.approx(slopes[1], rel=1e-12)


def test_probing_finds_both_sides_of_an_upwind_switch():
    """Each side of the switch is an entry, whatever the sign at the guess."""

    def residual(u, f):
        back = u - anp.roll(u, 1)
        ahead = anp.roll(u, -1) - u
        return u + 0.3 * (anp.maximum(u, 0.0) * back + anp.minimum(u, 0.0) * ahead) - f

    f = np.sin(np.arange(50) / 3.0 + 0.2)
    d = np.cos(np.arange(50))
    root = implicit(residual)
    loss = lambda f: anp.sum(root(np.zeros(50), f) ** 2)
    value, slope = value_and_grad(loss)(f)
    assert rate(lambda h: loss(f + h * d) - value - h * (slope @ d)) >= 1.95
    ((coloured, _),) = root._default_jacobians._patterns.values()
    assert coloured.pattern.nnz == 150


def forms_of_jacobian():
    problem = PROBLEMS["advection 1-D"]()

    def jacobian(u, p):
        rows = pullback(lambda x: problem.residual(x, p), u)[1]
        return np.array([rows(unit) for unit in np.eye(u.size)])

    return problem, {
        "array": jacobian,
        "sparse": lambda u, p: sp.coo_array(jacobian(u, p)),
        "Operator": lambda u, p: dp.from_matrix(jacobian(u, p)),
        "functions": lambda u, p: dp.from_linear_operator(dp.from_matrix(jacobian(u, p)).to_scipy()),
    }


@pytest.mark.parametrize("form", ["array", "sparse", "Operator", "functions"])
def test_a_supplied_jacobian_is_used(form):
    problem, given = forms_of_jacobian()
    root = implicit(problem.residual, given[form])
    wanted = implicit(problem.residual)
    with recording() as calls:
        slope = value_and_grad(problem.loss(root))(problem.params)[1]
    assert ("implicit(residual).jacobian", "jvp") not in calls
    np.testing.assert_allclose(flat(slope), flat(value_and_grad(problem.loss(wanted))(problem.params)[1]), rtol=1e-8)


def test_a_wrong_supplied_jacobian_raises():
    problem, given = forms_of_jacobian()
    right = given["array"]
    simpler = implicit(problem.residual, lambda u, p: 1.25 * right(u, p))
    x = implicit(problem.residual)(problem.guess, problem.params)
    np.testing.assert_allclose(simpler(problem.guess, problem.params), x, rtol=1e-8)
    with pytest.raises(DerivativeError, match=r"^the jacobian given for implicit\(residual\) differs .* by 2.0e-01"):
        value_and_grad(problem.loss(simpler))(problem.params)
    turned = implicit(problem.residual, lambda u, p: -right(u, p))
    with pytest.raises(ConvergenceError, match=r"the jacobian given differs from .* by 2.0e\+00") as caught:
        turned(problem.guess, problem.params)
    assert caught.value.info.status == "stagnated"


def test_one_wrong_entry_of_a_supplied_jacobian_raises():
    exact = np.diag(np.full(12, 3.0)) - np.diag(np.ones(11), 1)
    wrong = exact.copy()
    wrong[5, 6] *= 1.001
    op = dp.from_matrix(exact)
    root = implicit(lambda u, f: op(u) - f, lambda u, f: wrong)
    with pytest.raises(DerivativeError, match="in row 5; correct it or leave it out$"):
        value_and_grad(lambda f: anp.sum(root(0 * f, f)))(np.ones(12))


def test_supplied_sparsity_is_used():
    problem = PROBLEMS["advection 1-D"]()
    n = problem.guess.size
    band = sp.diags_array([np.ones(n - abs(k)) for k in (-1, 0, 1)], offsets=(-1, 0, 1))
    root = implicit(problem.residual, sparsity=band)
    with recording() as calls:
        slope = value_and_grad(problem.loss(root))(problem.params)[1]
    wanted = value_and_grad(problem.loss(implicit(problem.residual)))(problem.params)[1]
    np.testing.assert_allclose(flat(slope), flat(wanted), rtol=1e-12)
    assert (f"{root.name}.pattern", "jvp") not in calls
    lacking = implicit(problem.residual, sparsity=sp.eye_array(n))
    with pytest.raises(DerivativeError, match=r"^the sparsity given for implicit\(residual\) lacks entries in row"):
        lacking(problem.guess, problem.params)


@pytest.mark.parametrize("guess", [[1.0, 1.0], [2.0, 1.0], [1.0, 1e10]])
def test_a_root_is_tested_beside_its_own_terms(guess):
    """The first step takes x_1 from 1 to 1e-20; its rounding errors are small beside the terms at the guess only."""
    root = dp.implicit(lambda x: anp.array([1e20 * x[0] * x[1] - 1.0, x[0] - 1.0]))
    np.testing.assert_allclose(root(np.array(guess)), [1.0, 1e-20], rtol=1e-9)
    root = dp.implicit(lambda x: anp.array([x[0] - x[1] * anp.exp(x[0]), x[0] - 369.8]))
    np.testing.assert_allclose(root(np.array([369.8, -1e-142])), [369.8, 369.8 * np.exp(-369.8)], rtol=1e-9)
