"""Block triangular systems: substitution before and after the coupled unknowns, forward and transposed."""

import pickle
from time import process_time

import autograd.numpy as anp
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve_triangular

import sparsedp as dp
from sparsedp import kernels
from sparsedp.errors import ConvergenceError, IncompatibleError, NonFiniteError
from sparsedp.solvers import algebraic_multigrid, substitution
from sparsedp.solvers.substitution import split
from sparsedp.solvers.system import System

SIDES = {1: (dp.dirichlet, dp.neumann), -1: (dp.neumann, dp.dirichlet)}  # a held value where the wind enters


def random_entries(rng, shape, density):
    """A sparse matrix with random entries; SciPy's own takes its generator by another name in older versions."""
    return sp.csr_array(np.where(rng.random(shape) < density, rng.random(shape), 0.0))


def sweep(shape, signs):
    """The sum of v . slope with unit winds of these signs along the axes: it is triangular in some order."""
    grid = dp.Grid(shape, size=1.0)
    terms = [sign * dp.upwind(grid, axis, sign, {"xyz"[axis]: SIDES[sign]}) for axis, sign in enumerate(signs)]
    return sum(terms[1:], terms[0])


def chain(size, factor=-0.9):
    return sp.diags_array([np.ones(size), np.full(size - 1, factor)], offsets=[0, -1]).tocsr()


def blocks(rng, dtype=float):
    """Chains into two cycles and out of them, with a chain between the cycles; rows in random order."""
    size = 40
    matrix = np.tril(rng.uniform(-0.3, 0.3, (size, size)) * (rng.random((size, size)) < 0.1), -1)
    matrix[np.arange(size), np.arange(size)] = rng.choice([-1.0, 1.0], size) * rng.uniform(1, 2, size)
    for first, last in ((10, 15), (22, 25)):
        matrix[first, last], matrix[np.arange(first + 1, last + 1), np.arange(first, last)] = 0.4, 0.3
    matrix[17, 15] = matrix[22, 17] = 0.2  # number 17 lies between the cycles
    if dtype is complex:
        matrix = matrix * np.exp(1j * rng.uniform(-0.5, 0.5, matrix.shape))
    order = rng.permutation(size)
    return sp.csr_array(matrix[order][:, order])


def removed(matrix, links):
    """Return the unknowns that are removed one after the other, each of which uses only those removed before."""
    found = set()
    size = matrix.shape[0]
    while True:
        new = {i for i in range(size) if i not in found and set(np.flatnonzero(links[i])) - {i} <= found}
        if not new:
            return found
        found |= new


@pytest.fixture(params=[True, False], ids=["compiled", "plain"])
def both(request, monkeypatch):
    """With and without compiled loops."""
    if request.param and not kernels.compiled():
        pytest.skip("numba is not installed")
    monkeypatch.setattr(kernels, "compiled", lambda: request.param)


@pytest.mark.parametrize("dtype", [float, complex])
@pytest.mark.parametrize("seed", range(4))
def test_the_unknowns_found_by_substitution_are_those_of_repeated_removal(seed, dtype):
    matrix = blocks(np.random.default_rng(seed), dtype)
    links = matrix.toarray() != 0
    found = split(matrix, None)
    first = removed(matrix, links)
    assert set(found.first.tolist()) == first
    assert set(found.last.tolist()) == removed(matrix, links.T) - first
    assert np.count_nonzero(found.coupled) == 40 - found.size >= 11 and found.first.size > 5 and found.last.size > 5
    assert split(sp.csr_array(np.ones((5, 5))), None) is None


@pytest.mark.parametrize("dtype", [float, complex])
@pytest.mark.parametrize("seed", range(3))
def test_solutions_and_adjoint_solutions_are_those_of_dense_algebra(seed, dtype, both):
    rng = np.random.default_rng(seed)
    matrix = blocks(rng, dtype)
    b = rng.standard_normal((3, 40)).astype(dtype)
    inv = dp.inverse(dp.from_matrix(matrix))
    np.testing.assert_allclose(inv(b), np.linalg.solve(matrix.toarray(), b.T).T, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(inv.T(b), np.linalg.solve(matrix.toarray().T, b.T).T, rtol=1e-12, atol=1e-13)
    assert "found by substitution" in str(inv) and "coupled" in inv.reason + "coupled" * (dtype is complex)


@pytest.mark.parametrize("method", ["auto", "direct", "multigrid", "krylov"])
def test_every_method_solves_the_coupled_unknowns(method, rng):
    ring = dp.Grid((6, 7), size=1.0, periodic=(True, False))
    op = dp.upwind(ring, "x") + dp.upwind(ring, "y", 1, {"y": SIDES[1]})  # rings, one after the other
    matrix = sp.block_array([[chain(9), None], [random_entries(rng, (42, 9), 0.1), op.matrix]])
    inv = dp.inverse(dp.from_matrix(matrix), method, rtol=1e-12, maxiter=5000)
    b = rng.standard_normal(51)
    np.testing.assert_allclose(inv(b), np.linalg.solve(matrix.toarray(), b), rtol=1e-8)
    np.testing.assert_allclose(inv.T(b), np.linalg.solve(matrix.toarray().T, b), rtol=1e-8)


@pytest.mark.whole
def test_a_long_chain(both):
    """A recursion with one call for each unknown would raise RecursionError."""
    size = 1_000_000 if kernels.compiled() else 52_000
    inv = dp.inverse(dp.from_matrix(chain(size)))
    assert inv(np.ones(size))[-1] == pytest.approx(10.0, rel=1e-14)
    assert inv.T(np.ones(size))[0] == pytest.approx(10.0, rel=1e-14)
    assert inv.info.forward.residual <= 1e-15 and inv.info.adjoint.residual <= 1e-15
    assert inv.method == "direct" and "the system is triangular" in str(inv)


WINDS = [
    ((30, 31), (1, 1)),
    ((30, 31), (-1, -1)),
    ((30, 31), (1, -1)),
    ((9, 8, 7), (1, 1, 1)),
    ((9, 8, 7), (-1, 1, -1)),
]


@pytest.mark.parametrize("method", ["auto", "direct", "multigrid", "structured"])
@pytest.mark.parametrize("shape, signs", WINDS)
def test_upwind_sweeps(shape, signs, method, rng, both):
    """Steady and in an implicit step, for winds in all directions."""
    op = sweep(shape, signs)
    x = rng.standard_normal(shape)
    for A in (op, dp.identity(op.domain) + 0.3 * op):
        inv = dp.inverse(A, method)
        np.testing.assert_allclose(inv(A(x)), x, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(inv.T(A.T(x)), x, rtol=1e-11, atol=1e-11)
        assert inv.info.hierarchy.startswith(f"substitution, {x.size} unknowns")
        assert f"{x.size} of {x.size}, {x.size} of them found by substitution" in str(inv)


@pytest.mark.parametrize("shape", [(256, 256), (32, 32, 32)])
def test_a_sweep_takes_no_longer_than_that_of_scipy(shape):
    """At most three times the CPU time of `spsolve_triangular`, the minimum of a few alternating runs."""
    op = sweep(shape, (1,) * len(shape))
    matrix = op.matrix
    b = np.ones(shape)
    inv = dp.inverse(op)
    flat = b.reshape(-1)
    ours = []
    theirs = []
    adjoint = []
    for _ in range(4):
        for seconds, act in (
            (ours, lambda: inv(b)),
            (theirs, lambda: spsolve_triangular(matrix, flat)),
            (adjoint, lambda: inv.T(b)),
        ):
            start = process_time()
            act()
            seconds.append(process_time() - start)
    assert min(ours) <= 3 * min(theirs) and min(adjoint) <= 3 * min(theirs)


@pytest.mark.whole
def test_a_long_pipe_in_an_implicit_step():
    pipe = dp.Grid((2200, 3, 3), size=(10.0, 0.1, 0.1))
    wind = dp.upwind(pipe, "x", 1, {"x": SIDES[1]})
    u = dp.stepper("backward_euler", lambda u, s: -s * wind(u), 0.01)(np.ones(pipe.shape), 1.0)
    matrix = np.eye(2200) + 2.2 * (np.eye(2200) - np.eye(2200, k=-1))
    matrix[0, 0] += 2.2  # the wall is half a cell away
    line = np.linalg.solve(matrix, np.ones(2200))
    np.testing.assert_allclose(u, line[:, None, None] * np.ones(pipe.shape), rtol=1e-9)


# ---------------------------------------------------------------- derivatives


@pytest.mark.parametrize("signs", [(1, 1), (-1, 1)])
def test_derivatives_in_the_entries(signs, rng):
    """Values, first and second derivatives of a sweep given by its entries, compared with dense algebra."""
    matrix = sp.coo_array(sweep((4, 5), signs).matrix)
    solve = dp.matrix_solver.from_coo(matrix.row, matrix.col)
    data = matrix.data
    b = rng.standard_normal(20)
    v = rng.standard_normal(matrix.nnz)
    places = np.eye(400)[matrix.row * 20 + matrix.col]

    def twin(data):
        return anp.sum(anp.sin(anp.linalg.solve(anp.reshape(anp.dot(data, places), (20, 20)), b)))

    def loss(data):
        return anp.sum(anp.sin(solve(data, b)))

    value, slope = dp.value_and_grad(loss)(data)
    assert value == pytest.approx(twin(data), rel=1e-11)
    wanted = dp.grad(twin)(data)
    np.testing.assert_allclose(slope, wanted, rtol=1e-9, atol=1e-11 * np.max(np.abs(wanted)))
    assert dp.jvp(loss, data, v)[1] == pytest.approx(wanted @ v, rel=1e-9)
    curvature = dp.hvp(twin, data, v)
    np.testing.assert_allclose(dp.hvp(loss, data, v), curvature, rtol=1e-8, atol=1e-9 * np.max(np.abs(curvature)))
    assert "substitution" in solve.info.hierarchy


@pytest.mark.parametrize("scheme", ["backward_euler", "tr_bdf2"])
@pytest.mark.parametrize("sign", [1, -1])
def test_derivatives_in_the_wind(scheme, sign, rng):
    """Of an implicit step, compared with a dense one of the same scheme."""
    grid = dp.Grid((5, 4), size=1.0)
    x, y = (dp.upwind(grid, axis, sign, {axis: SIDES[sign]}) for axis in "xy")
    dense_x = x.matrix.toarray()
    dense_y = y.matrix.toarray()
    u = rng.standard_normal(grid.shape)
    step = dp.stepper(scheme, lambda u, wind: -wind[0] * x(u) - wind[1] * y(u), 0.05)

    def loss(wind):
        return anp.sum(anp.sin(step(u, wind)))

    def twin(wind):
        A = wind[0] * dense_x + wind[1] * dense_y
        one = np.eye(20)
        flat = u.reshape(-1)
        if scheme == "backward_euler":
            return anp.sum(anp.sin(anp.linalg.solve(one + 0.05 * A, flat)))
        g = 2 - np.sqrt(2.0)
        d = 0.05 * g / 2
        middle = anp.linalg.solve(one + d * A, flat - d * anp.dot(A, flat))
        last = (middle - (1 - g) ** 2 * flat) / (g * (2 - g))
        return anp.sum(anp.sin(anp.linalg.solve(one + d * A, last)))

    wind = sign * np.array([1.0, 0.7])
    v = np.array([0.3, -0.2])
    assert loss(wind) == pytest.approx(twin(wind), rel=1e-9)
    np.testing.assert_allclose(dp.grad(loss)(wind), dp.grad(twin)(wind), rtol=1e-7)
    assert dp.jvp(loss, wind, v)[1] == pytest.approx(dp.grad(twin)(wind) @ v, rel=1e-7)
    np.testing.assert_allclose(dp.hvp(loss, wind, v), dp.hvp(twin, wind, v), rtol=1e-6)


# ---------------------------------------------------------------- singular systems


def network():
    """A chain of reservoirs that drains into a closed pair, and a gauge that uses the levels of the pair."""
    matrix = np.array(
        [
            [2.0, 0.0, 0.0, 0.0, 0.0],
            [-1.0, 1.0, 0.0, 0.0, 0.0],
            [0.0, -1.0, 1.0, -1.0, 0.0],
            [-1.0, 0.0, -1.0, 1.0, 0.0],
            [0.0, 0.0, -0.5, 0.0, 1.0],
        ]
    )
    return matrix, np.array([0.0, 0.0, 1.0, 1.0, 0.5]), np.array([1.0, 1.0, 1.0, 1.0, 0.0])


def test_null_vectors_extend_into_the_triangular_parts(both, rng):
    matrix, right, left = network()
    space = System(dp.from_matrix(matrix)).null_space
    assert space.count == 1
    np.testing.assert_allclose(space.right / space.right[2], right, atol=1e-15)
    np.testing.assert_allclose(space.left / space.left[2], left, atol=1e-15)
    inv = dp.inverse(dp.from_matrix(matrix))
    b = rng.standard_normal(5)
    for solve, A, r, l in ((inv, matrix, right, left), (inv.T, matrix.T, left, right)):
        data = b - r * (l @ b) / (l @ r)
        x = solve(data)
        np.testing.assert_allclose(A @ x, data, atol=1e-13)
        assert l @ x == pytest.approx(0.0, abs=1e-13)
    with pytest.raises(IncompatibleError, match="is singular and the right-hand side is not in its range"):
        inv(left)
    assert np.all(np.isfinite(dp.inverse(dp.from_matrix(matrix), nullspace="project")(b)))


def test_two_singular_components_that_feed_each_other_are_refused():
    matrix = sp.block_diag([network()[0][2:4, 2:4], network()[0][2:4, 2:4], np.eye(1)]).toarray()
    assert dp.inverse(dp.from_matrix(matrix)).solver.system.null_space.count == 2
    matrix[4, 0] = matrix[4, 2] = -1.0
    with pytest.raises(ConvergenceError, match="an unknown is linked to two singular components"):
        dp.inverse(dp.from_matrix(matrix))


def test_a_missing_pivot_is_named():
    matrix = chain(2000).tolil()
    matrix[700, 700] = 0.0
    with pytest.raises(ArithmeticError, match="row 700 has no entry on the diagonal and is not part of a cycle"):
        split(matrix.tocsr(), None)
    for method in ("auto", "direct", "multigrid"):
        with pytest.raises(ConvergenceError, match="singular.*row 700 has no entry on the diagonal and is not part of"):
            dp.inverse(dp.from_matrix(matrix.tocsr()), method)


@pytest.mark.parametrize("matrix", [chain(3000, -1.1), chain(99) - sp.diags_array((np.arange(99) == 50) * (1 - 1e-15))])
def test_triangular_parts_without_a_correct_digit_are_refused(matrix):
    with pytest.raises(
        ConvergenceError,
        match="<matrix: .*> is singular, or its condition number is beyond 1e14: in its triangular part a pivot is too "
        "small for its row, or the solution grows from row to row; add a shift, or remove rows that depend on others",
    ) as caught:
        dp.inverse(dp.from_matrix(matrix))
    assert caught.value.info.status == "setup_failed"


def test_extreme_triangular_systems():
    one = dp.inverse(dp.from_matrix([[4.0]]))
    assert one(np.array([2.0])) == 0.5 and one.T(np.array([2.0])) == 0.5
    assert dp.inverse(dp.from_matrix(np.zeros((0, 0))))(np.zeros(0)).size == 0
    inv = dp.inverse(dp.from_matrix(chain(50)))
    assert np.array_equal(inv(np.zeros(50)), np.zeros(50)) and inv.info.forward.status == "exact_zero_rhs"
    for exponent in (-900, 900):
        assert np.array_equal(inv(np.full(50, 2.0**exponent)), inv(np.ones(50)) * 2.0**exponent)
        far = dp.inverse(dp.from_matrix(chain(50) * 2.0**exponent))
        assert np.array_equal(far(np.full(50, 2.0**exponent)), inv(np.ones(50)))
    with pytest.raises(NonFiniteError, match="NaN"):
        inv(np.full(50, np.nan))
    with pytest.raises(ConvergenceError, match="row 3 of .* has no entries"):
        dp.inverse(dp.from_matrix(chain(9) @ sp.diags_array(1.0 * (np.arange(9) != 3)) + sp.csr_array(chain(9) * 0)).T)
    assert np.array_equal(pickle.loads(pickle.dumps(inv))(np.ones(50)), inv(np.ones(50)))


def test_coupled_unknowns_of_another_magnitude(rng):
    """The norm of the whole does not hide the scale of the coupled unknowns."""
    cycle = 1e-100 * np.array([[2.0, 1.0], [1.0, 3.0]])
    matrix = np.block([[cycle, np.zeros((2, 2))], [1e-100 * np.ones((2, 2)), np.diag([1.0, 4.0])]])
    inv = dp.inverse(dp.from_matrix(matrix))
    x = np.array([1.0, -2.0, 3.0, 0.5])
    np.testing.assert_allclose(inv(np.r_[matrix[:2] @ x, 0.0, 0.0])[:2], x[:2], rtol=1e-12)


def test_components_in_another_numbering_are_not_split(monkeypatch):
    """SciPy numbers components in topological order, but does not promise it: then nothing is found by substitution."""
    given = substitution.connected_components

    def mixed(*args, **options):
        count, labels = given(*args, **options)
        return count, np.random.default_rng(0).permutation(count)[labels]

    monkeypatch.setattr(substitution, "connected_components", mixed)
    inv = dp.inverse(dp.from_matrix(chain(200)))
    assert "substitution" not in str(inv)
    assert inv(np.ones(200))[-1] == pytest.approx(10.0, rel=1e-8)


# ---------------------------------------------------------------- decisions and limits


def test_the_choice_depends_on_the_coupled_unknowns():
    """A ring of 30 cells with a long inlet and a long outlet: 30 unknowns are factored."""
    size = 30_060
    matrix = chain(30_060).tolil()
    matrix[15_015, 15_044] = -0.5
    inv = dp.inverse(dp.from_matrix(matrix.tocsr()))
    assert "30 coupled unknowns without a grid, 30030 others by substitution; up to 50000" in inv.reason
    assert "dense LU, 30 rows" in inv.info.hierarchy and "substitution, 30030 unknowns" in inv.info.hierarchy
    assert f"{size} of {size}, 30030 of them found by substitution" in inv._repr_html_()
    x = inv(np.ones(size))
    np.testing.assert_allclose(matrix.tocsr() @ x, np.ones(size), rtol=1e-12)
    plan = str(dp.explain(lambda b: anp.sum(inv(b)), np.ones(size)))
    assert "30 coupled unknowns" in plan


def test_refusals_name_the_operator_that_was_given():
    """They do not name the part of it that is solved."""
    matrix = sp.block_diag([chain(3), np.array([[2.0, 1.0], [1.0, -2.0]])])
    with pytest.raises(
        ValueError, match="of one sign; <matrix: space.5. -> space.5., explicit> has -2.0e.00 and 2.0e.00"
    ):
        dp.inverse(dp.from_matrix(matrix), "multigrid")


def test_options_are_checked_for_triangular_systems():
    op = dp.from_matrix(chain(5))
    with pytest.raises(ValueError, match="precision must be one of auto, single, double, got 'half'"):
        dp.inverse(op, "direct", precision="half")
    with pytest.raises(ValueError, match="strength must be from 0 to below 1"):
        dp.inverse(op, "multigrid", strength=2.0)
    assert dp.inverse(op, "multigrid", strength=0.5).method == "direct"


def test_a_large_coarsest_level_is_refused():
    """Its dense matrix would take 8 n^2 bytes."""
    op = -dp.laplacian(dp.Grid((60, 60)), dp.dirichlet)
    with pytest.raises(
        ConvergenceError,
        match="multigrid on <-laplacian: .*> ends at a level of 3600 unknowns, after 1 of 1 levels; it may "
        "have 2000; write method='direct' or 'krylov', or raise levels",
    ):
        dp.inverse(op, "multigrid", levels=1)


def test_auto_takes_lu_where_multigrid_does_not_coarsen(monkeypatch):
    monkeypatch.setattr(algebraic_multigrid, "DENSE_UP_TO", 10)
    ring = dp.Grid((1600, 3, 3), size=1.0, periodic=True)
    op = dp.identity(ring.cells) + 0.01 * sum((dp.upwind(ring, axis) for axis in "yz"), dp.upwind(ring, "x"))
    inv = dp.inverse(op)
    assert inv.method == "direct" and "multigrid does not coarsen it" in inv.reason


# ---------------------------------------------------------------- blocks


def two_fields(shape, signs):
    """Two fields in the same winds that react with each other: blocks of two unknowns."""
    flow = sweep(shape, signs).matrix
    one = sp.eye_array(flow.shape[0])
    return sp.csr_array(sp.block_array([[flow + one, -0.5 * one], [-0.4 * one, flow + 2 * one]]))


def lines(n):
    """Rings of n cells; each ring uses the one before it."""
    grid = dp.Grid((9, n), size=1.0, periodic=(False, True))
    return (dp.upwind(grid, "x", 1, {"x": SIDES[1]}) + dp.upwind(grid, "y") + dp.identity(grid.cells)).matrix


def between(rng):
    """Two large cycles and a sweep between them."""
    cycle = sp.csr_array(2 * np.eye(70) + 0.5 * np.roll(np.eye(70), 1, 0))
    flow = sweep((6, 7), (1, -1)).matrix
    into, out = (random_entries(rng, shape, 0.05) for shape in ((42, 70), (70, 42)))
    return sp.csr_array(sp.block_array([[cycle, None, None], [into, flow, None], [None, out, cycle]]))


@pytest.mark.parametrize("dtype", [float, complex])
@pytest.mark.parametrize("kind", ["two fields", "rings", "sweep between cycles"])
def test_blocks_are_factored_one_by_one(kind, dtype, rng):
    """There is no fill-in between blocks, forward and transposed, in any numbering."""
    matrix = {"two fields": two_fields((9, 8), (1, -1)), "rings": lines(80), "sweep between cycles": between(rng)}[kind]
    matrix = (matrix * (1 + 0.3j) if dtype is complex else matrix).tocsr()
    order = rng.permutation(matrix.shape[0])
    matrix = sp.csr_array(matrix[order][:, order])
    b = rng.standard_normal(order.size).astype(dtype)
    inv = dp.inverse(dp.from_matrix(matrix), "direct")
    np.testing.assert_allclose(inv(b), np.linalg.solve(matrix.toarray(), b), rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(inv.T(b), np.linalg.solve(matrix.toarray().T, b), rtol=1e-11, atol=1e-12)
    blocks = {"two fields": "LU in block", "rings": "of 9 blocks", "sweep between cycles": "of 3 blocks"}[kind]
    assert blocks in inv.info.hierarchy and "in block triangular order" in inv.info.hierarchy
    entries = int(inv.info.hierarchy.split("order, ")[1].split(" entries")[0])
    assert entries <= 3 * matrix.nnz


def test_a_singular_block_is_refused(rng):
    matrix = between(rng).tolil()
    matrix[151, :] = matrix[150, :] + matrix[152, :]
    with pytest.raises(ConvergenceError, match="its null space is neither the constants nor the volumes"):
        dp.inverse(dp.from_matrix(matrix.tocsr()), "direct")


def test_auto_takes_lu_for_many_small_blocks():
    """The limits apply to the largest block."""
    matrix = two_fields((160, 161), (1, -1))
    inv = dp.inverse(dp.from_matrix(matrix))
    assert inv.method == "direct" and "51520 unknowns without a grid, in blocks of at most 2, one after" in inv.reason
    x = np.cos(np.arange(51520.0))
    np.testing.assert_allclose(inv(matrix @ x), x, atol=1e-10)
    np.testing.assert_allclose(inv.T(matrix.T @ x), x, atol=1e-10)
