"""matrix_solver: solves differentiable in the entries of a sparse matrix, on its pattern only."""

import pickle
import re
import tracemalloc

import autograd.numpy as anp
import numpy as np
import pytest
import scipy.sparse as sp
from residuals import rate

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp.autodiff.derivative import pullback, pushforward, value_and_grad
from sparsedp.autodiff.tape import isbox
from sparsedp.errors import ConvergenceError, IncompatibleError, NonFiniteError, ShapeError
from sparsedp.solvers.parametric import matrix_solver


def system(rng, n=30, many=4):
    """A pattern that is not symmetric, entries that make it regular, and data."""
    pattern = sp.csr_array(rng.random((n, n)) < many / n) + sp.eye_array(n)
    solve = matrix_solver(pattern)
    data = rng.uniform(-1, 1, solve.rows.size)
    data[solve.rows == solve.columns] += 4.0
    return solve, data, rng.standard_normal(n)


def dense(solve, data):
    A = np.zeros((solve.domain.size,) * 2)
    A[solve.rows, solve.columns] = data
    return A


def test_solution_and_gradients_are_the_dense_formulas(rng):
    solve, data, b = system(rng)
    A = dense(solve, data)
    g = rng.standard_normal(b.size)
    x, pull = pullback(lambda p: solve(*p), (data, b))
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-12)
    y = np.linalg.solve(A.T, g)
    of_data, of_b = pull(g)
    np.testing.assert_allclose(of_b, y, rtol=1e-12)
    np.testing.assert_allclose(of_data, -np.outer(y, x)[solve.rows, solve.columns], rtol=1e-11)


@pytest.mark.whole
def test_planted_errors_are_detected(rng, monkeypatch):
    """A for its transpose in the adjoint; rows for columns in the cotangent."""
    solve, data, b = system(rng)
    loss = lambda p: anp.sum(solve(*p) ** 2)
    assert dp.check.gradient(loss, (data, b), quick=True).verdict == "agrees"
    with monkeypatch.context() as patch:
        solved = solve._solve
        patch.setattr(solve, "_solve", lambda transposed, *rest: solved(False, *rest))
        assert dp.check.gradient(loss, (data, b), directions=1).verdict == "disagrees"
    wrong = matrix_solver(dense(solve, data))
    wrong.rows = solve.columns
    wrong.columns = solve.rows
    wrong.D, wrong.G = -wrong.G.T, -wrong.D.T
    assert dp.check.gradient(lambda p: anp.sum(wrong(*p) ** 2), (data, b), directions=1).verdict == "disagrees"


def test_taylor_rates_and_every_mode_of_second_order(rng):
    solve, data, b = system(rng, 12)
    w = rng.standard_normal(b.size)
    p = (data, b)
    d = (0.5 * rng.standard_normal(data.size), rng.standard_normal(b.size))
    loss = lambda p: anp.sum(w * solve(*p) ** 3)
    dot = lambda one, other: sum(anp.sum(a * c) for a, c in zip(one, other))
    slope = lambda p: value_and_grad(loss)(p)[1]
    along = lambda p: pushforward(loss, p, d)[1]
    value = loss(p)
    first = dot(slope(p), d)
    hessian = pushforward(slope, p, d)[1]
    for found in (value_and_grad(lambda p: dot(slope(p), d))(p)[1], value_and_grad(along)(p)[1]):
        for one, other in zip(found, hessian):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12 * np.max(np.abs(other)))
    assert pushforward(along, p, d)[1] == pytest.approx(float(dot(hessian, d)), rel=1e-10)
    change = lambda h: loss((data + h * d[0], b + h * d[1])) - value
    assert rate(lambda h: change(h) - h * first) >= 1.95
    assert rate(lambda h: change(h) - h * first - h**2 / 2 * dot(hessian, d)) >= 2.9


def test_one_adjoint_solve_one_set_up_and_none_without_a_gradient(rng):
    solve, data, b = system(rng)
    with recording() as calls:
        value_and_grad(lambda p: anp.sum(solve(*p)))((data, b))
    name = solve.name
    assert (calls[name, "setup"], calls[name, "solve"], calls[name, "adjoint"]) == (1, 1, 1)
    with recording() as calls:
        for factor in (1.0, 2.0, 1.0, 2.0):  # two alternating sets of data
            value_and_grad(lambda b: anp.sum(solve(factor * data, b)))(b)
    assert calls[name, "setup"] == 1
    with recording() as calls:
        solve(data, b)
        value_and_grad(lambda b: anp.sum(b) + 0.0 * np.sum(solve(data, np.ones(b.size))))(b)
    assert calls[name, "adjoint"] == calls[name, "setup"] == 0


def test_data_that_change_in_place_get_a_new_set_up(rng):
    solve, data, b = system(rng)
    solve(data, b)
    data *= 2.0
    np.testing.assert_allclose(dense(solve, data) @ solve(data, b), b, rtol=1e-11)


def test_the_cache_holds_no_traced_values(rng):
    solve, data, b = system(rng)
    slope = lambda p: value_and_grad(lambda p: anp.sum(solve(*p) ** 2))(p)[1]
    first = pushforward(slope, (data, b), (data, b))[1]
    assert not any(isbox(part) for key, _ in solve._cache._entries for part in key)
    for one, other in zip(first, pushforward(slope, (data, b), (data, b))[1]):
        np.testing.assert_array_equal(one, other)


def test_no_outer_product_is_formed():
    n = 4000
    ones = np.ones(n)
    solve = matrix_solver(sp.diags_array([ones[1:], ones, ones[1:]], offsets=(-1, 0, 1)))
    data = np.where(solve.rows == solve.columns, 2.5, -1.0)
    tracemalloc.start()
    try:
        value_and_grad(lambda p: anp.sum(solve(*p) ** 2))((data, ones))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 0.1 * 8 * n * n


def test_scales_of_data_and_cotangent_do_not_change_a_bit(rng):
    solve, data, b = system(rng)
    x, pull = pullback(lambda p: solve(*p), (data, b))
    wanted = pull(np.ones(b.size))
    for power in (-900, -1, 900):
        np.testing.assert_array_equal(np.ldexp(solve(np.ldexp(data, power), b), power), x)
        for found, one in zip(pull(np.ldexp(np.ones(b.size), power)), wanted):
            np.testing.assert_array_equal(np.ldexp(found, -power), one)


def graph_laplacian(weights, ends, n):
    """Return a pattern of edges, and the map from their weights to its entries; row sums are 0."""
    i, j = ends
    places = sp.csr_array((np.ones(2 * i.size), (np.r_[i, j], np.r_[j, i])), shape=(n, n)) + sp.eye_array(n)
    solve = matrix_solver(places, nullspace="project")
    where = {place: entry for entry, place in enumerate(zip(solve.rows.tolist(), solve.columns.tolist()))}
    rows = np.zeros((solve.rows.size, i.size))
    for edge, (a, b) in enumerate(zip(i.tolist(), j.tolist())):
        for row, column, value in ((a, b, -1), (b, a, -1), (a, a, 1), (b, b, 1)):
            rows[where[row, column], edge] += value
    return places, dp.from_matrix(rows)


def test_singular_systems_follow_the_null_space_contract(rng):
    n = 9  # two islands
    ends = (np.array([0, 1, 2, 3, 0, 5, 6, 7]), np.array([1, 2, 3, 4, 2, 6, 7, 8]))
    weights = rng.uniform(1, 2, 8)
    b = rng.standard_normal(n)
    places, entries = graph_laplacian(weights, ends, n)
    refusing, projecting = (matrix_solver(places, nullspace=word) for word in ("raise", "project"))
    with pytest.raises(IncompatibleError, match="subtract the weighted mean or write nullspace='project'"):
        refusing(entries(weights), b)
    x = projecting(entries(weights), b)
    assert abs(x[:5].sum()) < 1e-14 and abs(x[5:].sum()) < 1e-14
    np.testing.assert_allclose(x, np.linalg.pinv(dense(projecting, entries(weights))) @ b, atol=1e-13)
    loss = lambda p: anp.sum(anp.arange(n) * projecting(entries(p[0]), p[1]) ** 2)
    assert dp.check.gradient(loss, (weights, b), quick=True).verdict == "agrees"
    compatible = b - np.r_[np.full(5, b[:5].mean()), np.full(4, b[5:].mean())]
    value_and_grad(lambda w: anp.sum(refusing(entries(w), compatible)))(weights)  # cotangent of ones: not refused


def test_a_singular_matrix_without_a_known_null_space_is_refused():
    with pytest.raises(ConvergenceError, match="singular"):
        matrix_solver(np.ones((2, 2)))(np.array([1.0, 2.0, 2.0, 4.0]), np.ones(2))


def test_fields_on_a_grid_stored_zeros_and_other_methods(rng):
    grid = dp.Grid((6, 7), size=1.0)
    op = -dp.laplacian(grid, dp.dirichlet).explicit()
    b = rng.standard_normal(grid.shape)
    for method in ("direct", "krylov", "multigrid"):
        solve = matrix_solver(op.matrix, method, domain=grid.cells)
        x = solve(op.matrix.data, b)
        np.testing.assert_allclose(x, dp.inverse(op)(b), rtol=1e-7)
        assert solve.info.forward.residual <= 1e-10 and solve.info.adjoint is None
    pattern = sp.csr_array((np.array([1.0, 0.0, 1.0]), (np.array([0, 0, 1]), np.array([0, 1, 1]))), shape=(2, 2))
    assert matrix_solver(pattern).rows.tolist() == [0, 0, 1]
    assert "2 of 2 set-ups kept" not in str(solve) and "1 of 2 set-ups kept" in str(solve)


def test_complex_entries_and_dtypes(rng):
    solve, data, b = system(rng, 8)
    turned = data * np.exp(0.3j)
    np.testing.assert_allclose(solve(turned, b), np.linalg.solve(dense(solve, data) * np.exp(0.3j), b), rtol=1e-12)
    loss = lambda p: anp.real(anp.sum(solve(p[0] * np.exp(0.3j), p[1]) ** 2))
    assert dp.check.gradient(loss, (data, b), quick=True).verdict == "agrees"
    single = value_and_grad(lambda p: anp.sum(solve(*p)))((data.astype(np.float32), b.astype(np.float32)))[1]
    assert single[0].dtype == single[1].dtype == np.float32
    assert solve(np.where(solve.rows == solve.columns, 2, 0), np.ones(8, int)).tolist() == [0.5] * 8


def test_invalid_arguments_raise(rng):
    solve, data, b = system(rng, 8)
    wrong = data.copy()
    wrong[3] = np.nan
    place = f"row {solve.rows[3]}, column {solve.columns[3]}"
    for arguments, error, message in (
        ((data[1:], b), ShapeError, f"data must have shape {re.escape(str(data.shape))}, got"),
        ((data, b[1:]), ShapeError, r"matrix_solver takes a field on space\(8\), got an array of shape \(7,\)"),
        ((wrong, b), NonFiniteError, f"data must be finite, got 1 that are NaN or infinite, the first at {place}"),
        ((data, b * np.inf), NonFiniteError, "takes finite numbers"),
        ((data.astype(str), b), TypeError, "data must hold numbers"),
    ):
        with pytest.raises(error, match=message):
            solve(*arguments)
    with pytest.raises(ShapeError, match=r"^the pattern of matrix_solver must have shape \(2, 2\), got \(2, 3\)$"):
        matrix_solver(np.ones((2, 3)))
    with pytest.raises(ShapeError, match="^matrix_solver takes a 2-D pattern"):
        matrix_solver(np.ones(3))
    with pytest.raises(ValueError, match="^method must be"):
        matrix_solver(np.eye(2), "magic")


# ---- places in any order, some many times ----------------------------------------------------------------------------


def test_values_at_one_place_are_summed_and_differentiable(rng):
    n = 6
    many = 40
    rows = rng.integers(0, n, many)
    columns = rng.integers(0, n, many)
    rows = np.append(rows, np.arange(n))
    columns = np.append(columns, np.arange(n))
    values = np.append(rng.standard_normal(many), np.full(n, 30.0))
    b = rng.standard_normal(n)
    solve = matrix_solver.from_coo(rows, columns)
    A = sp.coo_array((values, (rows, columns)), shape=(n, n)).toarray()
    x, pull = pullback(lambda p: solve(*p), (values, b))
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-11)
    g = rng.standard_normal(n)
    y = np.linalg.solve(A.T, g)
    of_values, of_b = pull(g)
    np.testing.assert_allclose(of_values, -y[rows] * x[columns], rtol=1e-10)
    np.testing.assert_allclose(of_b, y, rtol=1e-10)
    loss = lambda p: anp.sum(solve(*p) ** 2)
    assert dp.check.gradient(loss, (values, b), quick=True).verdict == "agrees"
    again = pickle.loads(pickle.dumps(solve))
    assert np.array_equal(again(values, b), x)
    turned = values * np.exp(0.3j)
    np.testing.assert_allclose(solve(turned, b), np.linalg.solve(A * np.exp(0.3j), b), rtol=1e-11)


def test_a_domain_of_a_grid_takes_flat_places(rng):
    grid = dp.Grid((4, 3))
    places = -dp.laplacian(grid, dp.dirichlet).matrix.tocoo()
    b = rng.standard_normal(grid.shape)
    solve = dp.matrix_solver.from_coo(places.row, places.col, domain=grid.cells)
    np.testing.assert_allclose(solve(places.data, b), dp.inverse(-dp.laplacian(grid, dp.dirichlet))(b), rtol=1e-9)


@pytest.mark.parametrize(
    ("rows", "columns", "options", "error", "message"),
    [
        ([0, 1], [0], {}, ShapeError, r"^from_coo takes flat rows and columns, got shapes \(2,\) and \(1,\)$"),
        ([0.0], [0], {}, TypeError, "^rows and columns must hold integers, got dtype float64$"),
        ([-1], [0], {}, ShapeError, "^from_coo takes rows and columns from 0 to 0, one place at least; give others$"),
        ([3], [0], {"domain": 3}, ShapeError, "^from_coo takes rows and columns from 0 to 2, one place at least"),
        (np.zeros(0, int), np.zeros(0, int), {}, ShapeError, "one place at least; give others$"),
    ],
)
def test_invalid_places_raise(rows, columns, options, error, message):
    with pytest.raises(error, match=message):
        matrix_solver.from_coo(rows, columns, **options)


def test_one_value_for_each_place_given():
    with pytest.raises(ShapeError, match=r"^sum of entries takes a field on space\(3\), got an array of shape \(2,\)$"):
        matrix_solver.from_coo([0, 1, 0], [0, 1, 0])(np.ones(2), np.ones(2))
