"""An inverse in use: its record, kinds of arrays, derivatives of every order, counts."""

import gc
import pickle
import re
import weakref

import autograd.numpy as anp
import numpy as np
import pytest
from journeys import check_journey
from test_solvers import ALL, EVERY, GENERAL, PROBLEMS, stretched

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp.autodiff.derivative import pullback, pushforward, value_and_grad

BOX = np.arange(21 * 26).reshape(21, 26) % 3 > 0

# ---------------------------------------------------------------- records


def test_the_record_of_a_solve():
    inv = dp.inverse(PROBLEMS["dirichlet"](), "multigrid")
    log = inv.info
    assert log is inv.T.info and log.forward is None and log.adjoint is None and log.setup_seconds > 0
    assert "levels" in log.hierarchy and "setup_seconds" in repr(log)
    inv(np.ones((26, 22)))
    assert log.adjoint is None and log.forward.iterations > 0 and log.forward.seconds > 0
    assert log.forward.residual <= 1e-10 and log.forward.backward_error < log.forward.residual
    inv.T(np.ones((26, 22)))
    assert log.adjoint.status == "converged"


def test_the_description_of_an_inverse():
    inv = dp.inverse(PROBLEMS["dirichlet"](), "multigrid")
    text = str(inv)
    for word in ("multigrid: as asked", "572 of 572", "1e-10", "0 singular components", "levels", "complexity"):
        assert word in text
    assert repr(inv) == "<inverse(-divergence @ gradient): cells(26, 22) -> cells(26, 22), multigrid>"


def test_the_transpose_of_a_transpose_is_the_same_object():
    inv = dp.inverse(PROBLEMS["wind"]())
    b = np.ones((24, 25))
    assert inv.T is inv.T and inv.T.T.T is inv.T
    assert np.array_equal(inv.T.T(b), inv(b)) and inv.domain == inv.T.codomain
    again = pickle.loads(pickle.dumps(inv))
    assert np.array_equal(again(b), inv(b)) and np.array_equal(again.T(b), inv.T(b))


# ---------------------------------------------------------------- kinds of arrays


@EVERY
def test_dtype_and_memory_layout_of_the_data(method, rng):
    op = PROBLEMS["dirichlet"]()
    inv = dp.inverse(op, method)
    b = np.round(8 * rng.standard_normal(op.domain.shape))
    wide = np.empty((52, 44))
    wide[::2, ::-2] = b
    frozen = b.copy()
    frozen.flags.writeable = False
    for twin in (b.astype(int), np.asfortranarray(b), wide[::2, ::-2], frozen, b.astype(np.int8), b.astype(">f8")):
        before = twin.copy()
        x = inv(twin)
        assert x.dtype == np.float64 and np.array_equal(x, inv(b)) and np.array_equal(twin, before)
    assert np.array_equal(inv(b > 0), inv((b > 0).astype(float)))
    assert np.array_equal(inv(np.broadcast_to(2.0, b.shape)), inv(np.full(b.shape, 2.0)))
    single = inv(b.astype(np.float32))
    assert single.dtype == np.float32 and np.array_equal(single, inv(b).astype(np.float32))


@EVERY
def test_complex_data(method, rng):
    op = ALL["stretched neumann"]()
    inv = dp.inverse(op, method, nullspace="project")
    b, c = rng.standard_normal((2, *op.domain.shape))
    for solve in (inv, inv.T):
        x = solve(b + 1j * c)
        assert x.dtype == complex and np.array_equal(x, solve(b) + 1j * solve(c))
    assert inv(b + 0j).imag.any() == 0 and inv.info.forward.status == "converged"


@pytest.mark.parametrize("adjoint", [False, True])
def test_complex_data_have_one_record_of_both_solves(adjoint, rng):
    op = PROBLEMS["dirichlet"]()
    inv = dp.inverse(op, "krylov")
    solve = inv.T if adjoint else inv
    record = lambda: inv.info.adjoint if adjoint else inv.info.forward
    b = rng.standard_normal(op.domain.shape)
    c = np.ones(op.domain.shape)
    none = np.zeros(op.domain.shape)
    solve(b)
    one = record()
    solve(c)
    other = record()
    for data in (1j * b, b + 0j):
        solve(data)
        assert (record().status, record().iterations) == ("converged", one.iterations) and one.iterations > 0
        assert (record().residual, record().backward_error) == (one.residual, one.backward_error)
    solve(b + 1j * c)
    both = record()
    assert both.status == "converged" and both.iterations == one.iterations + other.iterations
    assert both.residual == max(one.residual, other.residual) and both.seconds > 0
    assert both.backward_error == max(one.backward_error, other.backward_error)
    solve(none + 0j)
    assert (record().status, record().iterations, record().residual) == ("exact_zero_rhs", 0, 0.0)
    assert (inv.info.forward if adjoint else inv.info.adjoint) is None


@pytest.mark.parametrize("part", [1.0, 1j])
def test_complex_data_have_the_record_of_the_part_that_failed(part, rng):
    inv = dp.inverse(PROBLEMS["dirichlet"](), "krylov", maxiter=1)
    with pytest.raises(dp.errors.ConvergenceError):
        inv(part * rng.standard_normal((26, 22)) + 0j)
    assert (inv.info.forward.status, inv.info.forward.iterations) == ("max_iterations", 1)


def test_complex_operators_take_the_direct_method_or_gmres(rng):
    matrix = rng.standard_normal((80, 80)) + 1j * rng.standard_normal((80, 80))
    op = dp.from_matrix(matrix + 20 * np.eye(80))
    b = rng.standard_normal(80)
    inv = dp.inverse(op)
    assert inv.method == "direct"
    assert inv(b) == pytest.approx(np.linalg.solve(op.matrix.toarray(), b))
    assert inv.T(b * 1j) == pytest.approx(np.linalg.solve(op.matrix.toarray().T, b * 1j))
    krylov = dp.inverse(op, "krylov")
    for solve, twin in ((krylov, inv), (krylov.T, inv.T)):
        assert solve(b) == pytest.approx(twin(b), rel=1e-8) and solve(b * 1j) == pytest.approx(twin(b * 1j), rel=1e-8)
    bare = dp.inverse(dp.from_functions(op, op.T, 80, 80, dtype=complex))
    assert bare.method == "krylov" and bare(b) == pytest.approx(inv(b), rel=1e-8)
    with pytest.raises(ValueError, match=r"structured takes real operators, <.*> is complex; write method='direct' or"):
        dp.inverse(op, "structured")


@pytest.mark.parametrize("options", [{}, {"diff": "unrolled"}])
def test_a_start_is_checked_by_name(options):
    inv = dp.inverse(PROBLEMS["dirichlet"](), "krylov", **options)
    b = np.ones((26, 22))
    start = np.zeros((26, 22))
    start[3, 4] = np.nan
    name = re.escape(f"the start of {inv.name} must be finite, got 1 that are NaN or infinite, the first at (3, 4)")
    with pytest.raises(dp.errors.NonFiniteError, match=f"^{name}$"):
        inv(b, start=start)
    name = re.escape(f"{inv.name}, as start, takes a field on {inv.codomain}, got an array of shape (22,)")
    with pytest.raises(dp.errors.ShapeError, match=f"^{name}$"):
        inv(b, start=np.zeros(22))
    assert inv(b, start=np.zeros((26, 22))) == pytest.approx(inv(b))


def test_wrong_shapes():
    inv = dp.inverse(PROBLEMS["dirichlet"]())
    for wrong in (np.ones(572), np.ones((22, 26)), 1.0):
        with pytest.raises(dp.errors.ShapeError, match="takes a field on cells"):
            inv(wrong)
    with pytest.raises(
        dp.errors.ShapeError, match=r".*, as start, takes a field on cells\(26, 22\), got an array of shape \(3,\)"
    ):
        inv(np.ones((26, 22)), start=np.ones(3))


# ---------------------------------------------------------------- derivatives


@pytest.mark.sampled(0)
@EVERY
@pytest.mark.parametrize("problem", ["wind", "stretched neumann"])
def test_derivatives_of_every_order(problem, method, rng):
    """Only primal data must be in the range: no cotangent or tangent of any order is refused."""
    op = ALL[problem]()
    inv, free = (dp.inverse(op, method, nullspace=word) for word in ("raise", "project"))
    b = op(rng.standard_normal(op.domain.shape))
    d, e = rng.standard_normal((2, *op.domain.shape))

    def loss(b):
        return anp.sum(inv(b) ** 3)

    x = inv(b)
    gradient = value_and_grad(loss)(b)[1]
    assert gradient == pytest.approx(inv.T(3 * x**2), rel=1e-12)
    assert pushforward(inv, b, d)[1] == pytest.approx(free(d), rel=1e-12)
    wanted = np.sum(6 * x * free(d) * free(e))
    for reverse in (True, False):
        slope = lambda b: anp.sum(value_and_grad(loss)(b)[1] * d)
        found = np.sum(value_and_grad(slope)(b)[1] * e) if reverse else pushforward(slope, b, e)[1]
        assert found == pytest.approx(wanted, rel=1e-7)


@pytest.mark.parametrize(
    "wrap", [lambda inv: 2 * inv, lambda inv: inv + inv, lambda inv: dp.mask(inv.domain, BOX) @ inv]
)
def test_products_and_sums_with_an_inverse_refuse_no_cotangent(wrap, rng):
    """The transpose of a transpose refuses no data, also inside scalings, sums and chains."""
    op = ALL["stretched neumann"]()
    strict, free = (wrap(dp.inverse(op, nullspace=word)) for word in ("raise", "project"))
    b = op(rng.standard_normal(op.domain.shape))
    d, e = rng.standard_normal((2, *op.domain.shape))
    slope = lambda b: anp.sum(value_and_grad(lambda b: anp.sum(strict(b) ** 3))(b)[1] * d)
    wanted = np.sum(6 * strict(b) * free(d) * free(e))
    assert np.sum(value_and_grad(slope)(b)[1] * e) == pytest.approx(wanted, rel=1e-8)
    with pytest.raises(dp.errors.IncompatibleError):
        strict(d)


def test_projection_in_a_chain_has_second_derivatives(rng):
    """Divergences are in the range; the cotangents inside are projected, never refused."""
    grid = stretched(6, 5)
    G = dp.gradient(grid)
    D = dp.divergence(grid)
    keep = dp.interior(grid)
    chain = G @ dp.inverse(D @ G) @ D @ keep
    v, d = rng.standard_normal((2, grid.faces.size))
    gradient = lambda v: value_and_grad(lambda v: anp.sum(chain(v) ** 3))(v)[1]
    _, second = pushforward(gradient, v, d)
    h = 1e-5
    assert second == pytest.approx((gradient(v + h * d) - gradient(v - h * d)) / (2 * h), rel=1e-5, abs=1e-6)
    assert chain(chain(v)) == pytest.approx(chain(v), rel=1e-9, abs=1e-10)


def used(method):
    """Set up and differentiate solves; return weak references to all set-ups."""
    op = ALL["wind"]()
    grid = stretched(20, 19)
    inv = dp.inverse(op, method)
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet), method)
    b = op(np.ones((24, 25)))
    k = np.ones(grid.faces.size)
    value_and_grad(lambda b: anp.sum(inv(b, start=0 * b) ** 2 + inv(b)))(b)
    value_and_grad(lambda k: anp.sum(solve(k, grid.volumes)))(k + 1e-3 * np.arange(k.size))
    kept = (inv, inv.solver.engine, inv.solver.system, solve, solve._cache.last)
    return [weakref.ref(thing) for thing in kept]


@GENERAL
def test_an_inverse_is_freed_at_once(method):
    """Factors and hierarchies are large: no reference cycle may keep them until the collector runs."""
    gc.disable()
    try:
        assert [thing() for thing in used(method)] == [None] * 5
    finally:
        gc.enable()


def test_solves_are_counted():
    inv = dp.inverse(PROBLEMS["dirichlet"]())
    b = np.ones((26, 22))
    with recording() as calls:
        value, pull = pullback(lambda b: anp.sum(inv(b) ** 2), b)
    assert calls[inv.name, "solve"] == 1 and calls[inv.name, "adjoint"] == 0
    with recording() as calls:
        pull(1.0)
    assert calls[inv.name, "adjoint"] == 1 and calls[inv.name, "solve"] == 0
    with recording() as calls:
        dp.inverse(PROBLEMS["dirichlet"]())
    assert calls[inv.name, "setup"] == 1


def test_fixed_iterations_give_the_last_iterate_in_both_forms(rng):
    """Not the best one: early residual norms of conjugate gradients can exceed the first."""
    grid = dp.Grid((24, 24), size=1.0)
    op = -dp.laplacian(grid, dp.dirichlet)
    x, y = grid.centres()
    b = np.exp(-20 * ((x - 0.4) ** 2 + (y - 0.6) ** 2)) + 0.3 * x
    for k in (1, 5, 20):
        mine = dp.inverse(op, "krylov", iterations=k)(b)
        tape = dp.inverse(op, "krylov", iterations=k, diff="unrolled")(b)
        assert np.max(np.abs(mine)) > 0 and mine == pytest.approx(tape, rel=1e-8, abs=1e-14)


def test_unrolled_solves_are_recorded(rng):
    op = PROBLEMS["negative"]()
    inv = dp.inverse(op, "krylov", diff="unrolled")
    b = rng.standard_normal(op.domain.shape)
    value_and_grad(lambda b: anp.sum(inv(b)))(b)
    record = inv.info.forward
    assert record.status == "converged" and record.iterations > 5 and record.residual <= 1e-10
    assert record.backward_error <= record.residual and inv.info.adjoint is None  # its derivative is no solve
    inv.T(b)
    assert inv.info.adjoint.status == "converged"
    few = dp.inverse(op, "krylov", diff="unrolled", iterations=4)
    few(b)
    assert few.info.forward.status == "max_iterations" and few.info.forward.iterations == 4
    few(0 * b, start=b)
    assert few.info.forward.residual == 0 and few.info.forward.backward_error > 0
    inv(0 * b)
    assert inv.info.forward.status == "exact_zero_rhs"
    short = dp.inverse(op, "krylov", diff="unrolled", maxiter=2)
    with pytest.raises(dp.errors.ConvergenceError, match="unrolled krylov on "):
        short(b)
    assert short.info.forward.status == "max_iterations"


@pytest.mark.parametrize("method", ["krylov", "multigrid"])
@pytest.mark.parametrize("exponent", [-30, -150, 150])
def test_a_small_right_hand_side_gives_the_same_bits(method, exponent):
    """The tolerance is relative, whatever the size of the data."""
    grid = dp.Grid((12, 11), size=1.0)
    b = np.cos(np.arange(132.0)).reshape(12, 11)
    solve = dp.inverse(-dp.laplacian(grid, dp.dirichlet), method, rtol=1e-8)
    for act in (solve, solve.T):
        assert np.array_equal(act(b * 2.0**exponent), act(b) * 2.0**exponent)


def test_a_coefficient_may_be_reused_before_the_pullback():
    grid = dp.Grid((6, 5), size=1.0)
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
    k = 1.0 + np.arange(float(grid.faces.size)) / 9
    b = np.cos(np.arange(30.0)).reshape(6, 5)
    wanted = pullback(lambda b: solve(k, b), b)[1](b)
    pull = pullback(lambda b: solve(k, b), b)[1]
    k *= 5.0
    assert np.array_equal(pull(b), wanted)


# ---------------------------------------------------------------- structure


def test_a_direct_solve_and_its_gradient_enter_few_functions():
    """A reader who follows `inv(b)` sees the whole solve in at most 15 functions of 6 files."""
    grid = dp.Grid((20, 21), size=1.0)
    inv = dp.inverse(-dp.laplacian(grid, dp.dirichlet), "direct")
    b = np.ones(grid.shape)
    gradient = dp.value_and_grad(lambda b: anp.sum(inv(b) ** 2))
    check_journey(lambda: inv(b), functions=15, files=6)
    check_journey(lambda: gradient(b), functions=76, files=16)
