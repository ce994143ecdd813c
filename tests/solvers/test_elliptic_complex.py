"""A shift for each cell, complex shifts and coefficients, waves: beside dense twins in autograd.numpy."""

import re

import autograd.numpy as anp
import numpy as np
import pytest
import scipy.sparse as sp
from test_elliptic import dense, stretched

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp.autodiff.derivative import pullback, pushforward, value_and_grad
from sparsedp.autodiff.tape import plain
from sparsedp.errors import ConvergenceError
from sparsedp.solvers import direct
from sparsedp.solvers.choose_method import COMPLEX_UP_TO
from sparsedp.solvers.preconditioners import shifted_laplace
from sparsedp.solvers.system import System

KINDS = ["real field", "complex number", "complex field", "complex k", "complex number for k", "all complex"]
EACH = pytest.mark.parametrize("kind", KINDS)
METHODS = pytest.mark.parametrize("method", ["direct", "krylov"])


def setting(kind, method="direct", boundary=dp.dirichlet, shape=(7, 5), **options):
    """A solver, its arguments and a direction for each."""
    grid = stretched(*shape)
    rng = np.random.default_rng(4)
    draw = lambda shape: rng.uniform(0.5, 1.5, shape)
    mixed = lambda shape: draw(shape) - 1j * draw(shape)
    k = draw(grid.faces.size)
    b = rng.standard_normal(grid.shape)
    shift = draw(grid.shape)
    if kind == "complex number":
        shift = -0.4 + 0.3j
    if kind in ("complex field", "all complex"):
        shift = -mixed(grid.shape)
    if kind in ("complex k", "all complex"):
        k = mixed(grid.faces.size)
    if kind == "complex number for k":
        k = 1.2 - 0.4j
    if kind == "all complex":
        b = b + 1j * draw(grid.shape)
    point = k, b, shift
    direction = tuple((mixed if np.iscomplexobj(value) else draw)(np.shape(value)) for value in point)
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, boundary), method, rtol=1e-12, **options)
    return solve, point, tuple(d.item() if np.ndim(d) == 0 else d for d in map(np.asarray, direction))


def twin(solve):
    """The same by autograd's own solve with a dense matrix."""
    D, G = (op.matrix.toarray() for op in (solve.D, solve.G))

    def act(k, b, shift):
        matrix = anp.diag(shift * np.ones(D.shape[0]) if np.ndim(shift) == 0 else anp.reshape(shift, -1))
        matrix = matrix - anp.dot(D * k, G)
        b = b * np.ones((), plain(matrix).dtype)  # autograd's solve gives a real b no real cotangent
        return anp.reshape(anp.linalg.solve(matrix, anp.reshape(b, -1)), np.shape(b))

    return act


def loss_of(act):
    weights = np.random.default_rng(5).standard_normal((7, 5))

    def loss(point):
        x = act(*point)
        return anp.sum(weights * anp.sin(anp.real(x)) + anp.imag(x) ** 2 + anp.real(x) * anp.imag(x))

    return loss


def close(one, other, rel=1e-8):
    assert np.shape(one) == np.shape(other) and np.iscomplexobj(one) == np.iscomplexobj(other)
    assert np.max(np.abs(np.asarray(one) - other)) <= rel * np.max(np.abs(other))


@METHODS
@EACH
def test_value_gradient_and_second_order_are_those_of_the_dense_twin(kind, method):
    solve, point, direction = setting(kind, method)
    close(solve(*point), twin(solve)(*point))
    one, other = (value_and_grad(loss_of(act)) for act in (solve, twin(solve)))
    for mine, theirs in zip(one(point)[1], other(point)[1]):
        close(mine, theirs)

    def slope(both):
        return lambda point: sum(anp.sum(anp.real(g * d)) for g, d in zip(both(point)[1], direction))

    for mine, theirs in zip(value_and_grad(slope(one))(point)[1], value_and_grad(slope(other))(point)[1]):
        close(mine, theirs, 1e-7)


@METHODS
@EACH
def test_tangents_are_those_of_the_formula(kind, method):
    solve, point, direction = setting(kind, method)
    (k, _, shift), (dk, db, dshift) = point, direction
    matrix = dense(solve, k, np.ravel(shift))
    x, tangent = pushforward(lambda t: solve(*t), point, direction)
    change = db - dshift * x + solve.D(dk * solve.G(x))
    close(tangent, np.linalg.solve(matrix, change.ravel()).reshape(x.shape))
    # forward over reverse is reverse over reverse
    slope = lambda p: sum(anp.sum(anp.real(g * d)) for g, d in zip(value_and_grad(loss_of(solve))(p)[1], direction))
    reverse = value_and_grad(slope)(point)[1]
    along = sum(np.sum(np.real(g * d)) for g, d in zip(reverse, direction))
    assert pushforward(slope, point, direction)[1] == pytest.approx(along, rel=1e-8)


@METHODS
@EACH
def test_the_adjoint_identity(kind, method):
    """The plain transpose, as autograd's convention asks: no conjugate."""
    solve, (k, b, shift), _ = setting(kind, method)
    g = np.random.default_rng(1).standard_normal((2, *b.shape))
    g = g[0] + 1j * g[1] if np.iscomplexobj(solve(k, b, shift)) else g[0]
    x, pull = pullback(lambda b: solve(k, b, shift), b + 0 * g)
    assert abs(np.sum(x * g) - np.sum(b * pull(g))) <= 1e-10 * np.linalg.norm(x) * np.linalg.norm(g)


def test_batches_and_one_adjoint_solve_for_all():
    solve, (k, b, shift), _ = setting("all complex", "krylov")
    many = np.stack([b, 2j * b, b.conj()])
    assert np.array_equal(solve(k, many, shift)[1], solve(k, many[1], shift))
    loss = lambda k, b, shift: anp.sum(anp.abs(solve(k, b, shift)) ** 2)
    whole = value_and_grad(lambda t: loss(*t))((k, many, shift))[1]
    parts = [value_and_grad(lambda t: loss(*t))((k, one, shift))[1] for one in many]
    for place in (0, 2):
        close(whole[place], sum(part[place] for part in parts))
    with recording() as calls:
        value_and_grad(lambda t: loss(*t))((k, b, shift))
    assert [calls["elliptic_solver", word] for word in ("solve", "adjoint", "setup")] == [1, 1, 0]


def test_set_ups_are_cached_by_the_content_of_the_shift():
    solve, (k, b, shift), _ = setting("real field")
    shift = shift.copy()

    def setups():
        with recording() as calls:
            x = solve(k, b, shift)
        assert np.array_equal(x, setting("real field")[0](k, b, shift.copy()))
        return calls["elliptic_solver", "setup"]

    assert setups() == 1 and setups() == 0
    shift[3, 2] += 0.1  # the same array, another content
    assert setups() == 1 and setups() == 0


# ---------------------------------------------------------------- the methods


def test_a_field_as_shift_goes_to_the_method_that_takes_it():
    grid = dp.Grid((80, 70), size=1.0)
    rng = np.random.default_rng(0)
    make = lambda method: dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet), method)
    auto = make("auto")
    direct = make("direct")
    b = rng.standard_normal(grid.shape)
    waves = -np.full(grid.shape, 2e3)
    reacts = 100 * rng.random(grid.shape)
    for shift, words in (
        (reacts, ("structured", "direct: 5600")),
        (waves, ("direct: 5600",)),
        (1j * waves, ("direct",)),
    ):
        assert auto(1.0, b, shift) == pytest.approx(direct(1.0, b, shift), rel=1e-7)
        assert any(f"method      {word}" in str(auto) for word in words)
    assert auto(1.0, b, np.full(grid.shape, 3.0)) == pytest.approx(auto(1.0, b, 3.0), rel=1e-8)
    separable = make("separable")
    with pytest.raises(ValueError, match="separable needs a sum of 1-D factors"):
        separable(1.0, b, reacts)
    with pytest.raises(
        ValueError, match=r"separable takes real operators, <.*> is complex; write method='direct' or 'krylov'"
    ):
        separable(1.0, b, 1j)


def waves(n, method="krylov", cells=10, **options):
    """(solve, shift, b): a point source among walls that absorb, in a medium of two speeds, `cells` a wavelength."""
    grid = dp.Grid((n, n), size=1.0)
    x, y = grid.centres()
    speed = 1.0 + 0.5 * ((x - 0.4) ** 2 + (y - 0.6) ** 2 < 0.04)
    wall = np.maximum(1 - np.minimum(np.minimum(x, 1 - x), np.minimum(y, 1 - y)) * n / (2 * cells), 0)
    shift = -((2 * np.pi * n / cells / speed) ** 2) * (1 + 1j * wall**2)
    if method == "krylov":
        options = {"preconditioner": "shifted_laplace", **options}
    b = np.zeros(grid.shape)
    b[n // 2, n // 3] = n * n
    return dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet), method, **options), shift, b


def test_multigrid_refuses_waves():
    grid = dp.Grid((140, 120), size=1.0)
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
    message = r"multigrid on <shift - .*>: .* wanted 1e-10 \(indefinite_operator\); write method='direct'"
    with pytest.raises(dp.errors.ConvergenceError, match=message):
        solve(1.0, np.ones(grid.shape), np.full(grid.shape, -4e3))


def test_shifted_laplace_preconditions_waves_and_their_adjoint():
    solve, shift, b = waves(96)
    exact = waves(96, "direct")[0]
    close(solve(1.0, b, shift), exact(1.0, b, shift), 1e-8)
    loss = lambda solve: lambda s: anp.sum(anp.abs(solve(1.0, b, s)[20:30]) ** 2)
    close(value_and_grad(loss(solve))(shift)[1], value_and_grad(loss(exact))(shift)[1], 1e-8)
    assert solve.info.forward.iterations <= 40 and solve.info.adjoint.iterations <= 40
    with recording() as calls:
        waves(32)[0](1.0, b[:32, :32], shift[:32, :32])
    assert calls["elliptic_solver", "hierarchy"] == 1
    assert "GMRES, restarted after 30 iterations; shifted Laplace: 3 levels, unknowns 9216 >" in str(solve)
    with pytest.raises(ValueError, match="diff='unrolled' needs a symmetric operator and no preconditioner"):
        dp.inverse(1j * dp.laplacian(dp.Grid((3, 3)), dp.dirichlet), "krylov", diff="unrolled")
    alone = waves(96, preconditioner=None, maxiter=500)[0]
    with pytest.raises(dp.errors.ConvergenceError, match="krylov on <shift - divergence"):
        alone(1.0, b, shift)


def test_auto_avoids_lu_that_exceeds_the_memory(monkeypatch):
    monkeypatch.setitem(COMPLEX_UP_TO, 2, 2000)
    for n, word in ((40, "direct: complex entries"), (50, "krylov: 2500 complex unknowns in 2-D: LU would not fit")):
        solve, shift, b = waves(n, "auto")
        close(solve(1.0, b, shift), waves(n, "direct")[0](1.0, b, shift))
        assert f"method      {word}" in str(solve)


def test_the_cycle_of_shifted_laplace_has_an_exact_transpose():
    grid = stretched(40, 30)
    rng = np.random.default_rng(0)
    op = dp.diagonal(grid.cells, -0.3 - 0.2j * rng.random(grid.shape)) - dp.laplacian(grid, dp.dirichlet)
    hierarchy, unit = shifted_laplace(System(op))
    assert len(hierarchy.levels) > 1
    b, g = rng.standard_normal((2, grid.cells.size)) + 1j * rng.standard_normal((2, grid.cells.size))
    x = hierarchy.cycle(b)
    y = hierarchy.T.cycle(g)
    assert abs(np.sum(x * g) - np.sum(b * y)) <= 1e-13 * np.linalg.norm(x) * np.linalg.norm(g)


def test_absorbing_layers_reflect_less_than_a_thousandth():
    """A sponge by a complex shift; a perfectly matched layer by a complex coefficient too, on a line and in 2-D."""
    cells = 10
    grid = dp.Grid(200)
    k = 2 * np.pi / cells
    ends = lambda x: np.maximum(1 - np.minimum(x, 200 - x) / (2 * cells), 0) ** 3
    (x,), (face,) = grid.centres(), grid.face_centres(0)
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
    phase = np.arccos(1 - k**2 / 2) * np.arange(120)
    matched = 1 / (1 - 2j * ends(face)), -(k**2) * (1 - 2j * ends(x))
    for (coefficient, shift), limit in (((1.0, -(k**2) * (1 + 3j * ends(x))), 1e-3), (matched, 2e-6)):
        u = solve(coefficient, np.eye(200)[40], shift)[50:170]
        back, there = np.sort(np.abs(np.linalg.lstsq(np.exp(np.outer(phase, [1j, -1j])), u, rcond=None)[0]))
        assert back <= limit * there
    grid = dp.Grid((80, 60))
    ends = [lambda x, n=n: 1 - 2j * np.maximum(1 - np.minimum(x, n - x) / (2 * cells), 0) ** 3 for n in grid.shape]
    (fx, y), (x, fy) = grid.face_centres(0), grid.face_centres(1)
    coefficient = grid.join(ends[1](y) / ends[0](fx), ends[0](x) / ends[1](fy))
    shift = -(k**2) * np.outer(ends[0](x[:, 0]), ends[1](y[0]))
    b = np.eye(80)[:60].T
    D = dp.divergence(grid)
    G = dp.gradient(grid, dp.dirichlet)
    waves = dp.elliptic_solver(D, G, "krylov", preconditioner="shifted_laplace")
    close(waves(coefficient, b, shift), dp.elliptic_solver(D, G)(coefficient, b, shift), 1e-8)
    assert waves.info.forward.iterations <= 60


def test_waves_without_damping_have_a_real_solution():
    """A real operator of both signs: complex iterations, and the real part of what they give."""
    grid = dp.Grid((24, 24), size=1.0)
    D = dp.divergence(grid)
    G = dp.gradient(grid, dp.dirichlet)
    b = np.sin(np.arange(576.0)).reshape(24, 24)
    solve = dp.elliptic_solver(D, G, "krylov", preconditioner="shifted_laplace")
    x = solve(1.0, b, -150.0)
    close(x, dp.elliptic_solver(D, G, "direct")(1.0, b, -150.0), 1e-7)
    assert solve(1.0, b * (1 + 2j), -150.0) == pytest.approx((1 + 2j) * x)


def entries(solve):
    """Entries in the factors of the last set-up, in each precision."""
    return {words: int(number) for words, number in re.findall(r"(LU.*?), (\d+) entries in", str(solve))}


def test_factors_of_waves_have_few_entries():
    """Pivots stay on the diagonal; columns ordered alone leave more than 1.6 times as many."""
    solve, shift, b = waves(96, "direct")
    solve(1.0, b, shift)
    assert entries(solve)["LU"] <= 45 * b.size


@pytest.mark.parametrize("damped", [1.0, 0.0], ids=["complex", "real"])
def test_factors_in_single_precision_meet_the_same_tolerance(damped):
    (solve, shift, b), double = waves(96, "direct", precision="single"), waves(96, "direct", precision="double")[0]
    shift = shift if damped else shift.real - 1e3
    for size in (1.0, 1e-300, 1e200):
        close(solve(1.0, size * b, shift), double(1.0, size * b, shift), 1e-8)
    assert solve.info.forward.residual <= 1e-10 and "LU in single precision" in entries(solve)
    loss = lambda solve: lambda s: anp.sum(anp.abs(solve(1.0, b, s)[20:30]) ** 2)
    close(value_and_grad(loss(solve))(shift)[1], value_and_grad(loss(double))(shift)[1], 1e-8)
    assert solve.info.adjoint.residual <= 1e-10


def test_single_precision_is_abandoned_where_refinement_would_not_converge():
    """Next to an eigenvalue, and where entries leave its range."""
    grid = dp.Grid((12, 12))
    b = np.cos(np.arange(144.0)).reshape(12, 12)
    op = dp.laplacian(grid, dp.dirichlet)
    lowest = -8 * np.sin(np.pi / 24) ** 2
    tiny = dp.diagonal(grid.cells, np.where(np.arange(144).reshape(12, 12) % 2, 1.0, 1e-60))
    for near in (op - (lowest + 1e-9) * dp.identity(grid.cells), tiny @ op):
        inv = dp.inverse(near, "direct", precision="single")
        assert "single" not in inv.info.hierarchy
        assert np.array_equal(inv(near(b)), dp.inverse(near, "direct", precision="double")(near(b)))


def test_auto_keeps_factors_of_many_complex_unknowns_in_single_precision(monkeypatch):
    monkeypatch.setattr(direct, "SINGLE_FROM", 1600)
    for n, words in ((39, "LU"), (40, "LU in single precision")):
        solve, shift, b = waves(n, "auto")
        solve(1.0, b, shift)
        assert list(entries(solve)) == [words]


def test_single_precision_takes_as_many_rounds_as_an_eigenvalue_close_by_needs():
    """Each leaves a third of the residual; and where rows of far different size leave it all, it says what to write."""
    n = np.arange(108.0)
    chain = sp.diags_array([np.ones(107), np.full(108, -2.0), np.ones(107)], offsets=[-1, 0, 1])
    near = dp.from_matrix(sp.csr_array(chain + (2 - 2 * np.cos(np.pi * 2 / 109) + 3e-7) * sp.eye_array(108)))
    inv = dp.inverse(near, "direct", precision="single")
    assert "LU in single precision" in inv.info.hierarchy
    x = np.sin(2 * np.pi * (n + 1) / 109)
    for solve in (inv, inv.T):
        assert np.linalg.norm(near(solve(x)) - x) <= 1e-8 * np.linalg.norm(x)  # what rounding leaves
    uneven = dp.from_matrix(sp.csr_array(sp.diags_array(10.0 ** (4 * np.sin(3 * n))) @ chain))
    with pytest.raises(ConvergenceError, match=r"\(stagnated\); write precision='double'"):
        dp.inverse(uneven, "direct", precision="single")(np.cos(n))
    dp.inverse(uneven, "direct", precision="double")(np.cos(n))


def test_single_precision_rescales_faint_regions_of_complex_operators():
    block = sp.diags_array([np.ones(39), np.full(40, 3.0 + 1j), np.ones(39)], offsets=[-1, 0, 1])
    op = dp.from_matrix(sp.csr_array(sp.block_diag([block, block])))
    b = np.cos(np.arange(80.0)) * np.repeat([1.0, 1e-30], 40) * (1 + 2j)
    x = dp.inverse(op, "direct", precision="single")(b)
    close(x[40:], np.linalg.solve(block.toarray(), b[40:]), 1e-9)


def test_an_unknown_precision_raises():
    with pytest.raises(ValueError, match="precision must be one of auto, single, double, got 'half'"):
        dp.inverse(dp.identity(dp.Grid(3).cells), "direct", precision="half")


@pytest.mark.slow
def test_a_million_unknowns_at_ten_cells_a_wavelength():
    """Value and gradient, in 2.2 GB."""
    solve, shift, b = waves(1024, "auto")
    part = (slice(500, 520), slice(600, 620))
    loss = lambda s: anp.sum(anp.abs(solve(1.0, b, s)[part]) ** 2)
    value, slope = value_and_grad(loss)(shift)
    assert max(solve.info.forward.residual, solve.info.adjoint.residual) <= 1e-10
    along = np.zeros(shift.shape)
    along[400:600, 400:600] = -shift[0, 0].real
    h = 1e-6
    close((loss(shift + h * along) - loss(shift - h * along)) / (2 * h), np.sum(slope * along).real, 1e-5)


# ---------------------------------------------------------------- extremes


@pytest.mark.parametrize("turn", [1.0, 1.0 - 0.5j])
def test_coefficients_over_24_decades(turn):
    grid = dp.Grid((16, 16), size=1.0)
    rng = np.random.default_rng(3)
    k = turn * 10.0 ** rng.uniform(-12, 12, grid.faces.size)
    b = rng.standard_normal(grid.shape)
    shift = turn * 10.0 ** rng.uniform(-6, 6, grid.shape)
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
    solve(k, b, shift)
    assert solve.info.forward.backward_error <= 1e-12
    assert all(np.all(np.isfinite(g)) for g in value_and_grad(lambda t: anp.sum(anp.real(solve(*t))))((k, b, shift))[1])


@pytest.mark.parametrize("exponent", [-900, 900])
def test_bits_do_not_depend_on_units(exponent):
    solve, (k, b, shift), _ = setting("all complex")
    scaled = lambda u: u * 2.0 ** (exponent // 2) * 2.0 ** (exponent // 2)
    x = solve(k, b, shift)
    assert np.array_equal(solve(k, scaled(b), shift), scaled(x))
    assert np.array_equal(solve(scaled(k), scaled(b), scaled(shift)), x)


@pytest.mark.parametrize("turn", [1.0, 1.0 + 0j])
@pytest.mark.parametrize("field", [False, True])
def test_a_shift_that_is_an_eigenvalue_raises(turn, field):
    grid = dp.Grid((6, 5), size=1.0)
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
    values = np.linalg.eigvalsh(-(solve.D @ solve.G).matrix.toarray())
    shift = -values[3] * turn * (np.ones(grid.shape) if field else 1.0)
    with pytest.raises(dp.errors.ConvergenceError, match="is singular and its null space is neither"):
        solve(1.0, np.ones(grid.shape), shift)


def test_single_precision_one_cell_and_no_cells():
    solve, (k, b, shift), _ = setting("all complex")
    assert solve(k, b.astype(np.complex64), shift).dtype == np.complex64
    assert solve(k, b.real.astype(np.float32), shift).dtype == np.complex64
    g = value_and_grad(lambda s: anp.sum(anp.abs(solve(k, b, s)) ** 2))(shift.astype(np.complex64))[1]
    assert g.dtype == np.complex64
    one = dp.Grid(1)
    solve = dp.elliptic_solver(dp.divergence(one), dp.gradient(one, dp.dirichlet))
    assert solve(1.0, np.array([2.0]), np.array([-2j]))[0] == pytest.approx(2 / (4 - 2j))
    with pytest.raises(dp.errors.ConvergenceError, match="elliptic_solver is singular"):
        solve(1.0, np.array([2.0]), np.array([-4.0 + 0j]))
    none = dp.Grid((0, 3))
    solve = dp.elliptic_solver(dp.divergence(none), dp.gradient(none, dp.dirichlet))
    assert solve(1j, np.zeros((0, 3)), np.zeros((0, 3), complex)).shape == (0, 3)


@pytest.mark.parametrize("options", [{}, {"preconditioner": "shifted_laplace"}], ids=str)
def test_singular_systems_and_solids_in_complex_numbers(options):
    grid = stretched(9, 8)
    rng = np.random.default_rng(0)
    D = dp.divergence(grid)
    b = rng.standard_normal(grid.shape)
    k = rng.uniform(0.5, 1.5, grid.faces.size) * (1 - 0.4j)
    even = b - np.sum(b * grid.volumes) / np.sum(grid.volumes)
    exact, solve = (dp.elliptic_solver(D, dp.gradient(grid), m, **o) for m, o in (("direct", {}), ("krylov", options)))
    close(solve(k, even), exact(k, even), 1e-7)
    assert abs(np.sum(solve(k, even) * grid.volumes)) <= 1e-11
    losses = [lambda k, act=act: anp.sum(anp.abs(act(k, even)) ** 2) for act in (solve, exact)]
    close(*(value_and_grad(loss)(k)[1] for loss in losses), 1e-7)
    with pytest.raises(dp.errors.IncompatibleError, match="elliptic_solver is singular"):
        solve(k, b + 1)
    solid = np.zeros(grid.shape, dtype=bool)
    solid[3:5, 2:4] = True
    G = dp.gradient(grid, dp.dirichlet, solid)
    b = np.where(solid, 0.0, b)
    shift = -0.3 * (1 + 0.2j) * ~solid
    x = dp.elliptic_solver(D, G, "krylov", **options)(k, b, shift)
    assert not np.any(x[solid])
    close(x, dp.elliptic_solver(D, G, "direct")(k, b, shift), 1e-8)


def test_a_complex_number_as_shift():
    """It is an array without axes."""
    solve = dp.elliptic_solver(dp.divergence(dp.Grid(1)), dp.gradient(dp.Grid(1), dp.dirichlet))
    k = np.ones(2)
    assert solve(k, np.array([2.0]), -1 - 0.5j)[0] == pytest.approx(2 / (3 - 0.5j))
    assert solve(k, np.array([2.0]), np.asarray(-1e-300j))[0] == pytest.approx(0.5)
