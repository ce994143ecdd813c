"""The free tests: every operator of the catalogue x boundary x dimension x spacing x form."""

import autograd.numpy as anp
import numpy as np
import pairwise
import pytest
from catalogue import CATALOGUE, LABELS, SHAPES, boundaries, grids
from fields import Field, grid_of

import sparsedp as dp
from sparsedp.autodiff.derivative import pullback, pushforward, value_and_grad

EPS = 10 * np.finfo(float).eps


@pytest.fixture(scope="module", params=CATALOGUE, ids=LABELS)
def entry(request):
    return request.param


@pytest.fixture(scope="module")
def made(entry, drawn):
    """Operators of one entry by shape, as made, explicit and matrix-free: every three parameters, or a sample."""
    rng = np.random.default_rng(1)
    scenes = {}
    found = {}
    for shape in (shape for shape in SHAPES if len(shape) >= entry.least_dim):
        for number, grid in enumerate(grids(shape, rng)):
            for place, boundary in enumerate(entry.conditions(boundaries(grid))):
                sides = (*grid.periodic, None, None)[:3]  # each axis is a parameter of its own
                scenes[(shape, *sides, number % 2, place)] = grid, boundary  # number: uniform or stretched
    rows = list(scenes)
    for shape, *others in pairwise.sample(rows, 3) if drawn is list else drawn(rows):
        op = entry.make(*scenes[(shape, *others)])
        found.setdefault(shape, []).append((op, op.explicit(), op.matrix_free()))
    return found


def some(made, *shapes):
    return [operators for shape in shapes for operators in made.get(shape, ())]


def random_field(rng, space, dtype):
    values = rng.standard_normal(space.shape)
    if np.dtype(dtype).kind == "c":
        values = values + 1j * rng.standard_normal(space.shape)
    return values.astype(dtype)


def test_transpose_and_twin_in_every_dtype(made, drawn, rng):
    """Dot test and explicit against matrix-free, in the scaling of the gates: both at most 10."""
    worst = 0.0  # in double precision
    others = [np.float32, np.complex128, np.complex64]
    for number, (op, explicit, free) in enumerate(some(made, *SHAPES)):
        if drawn is list:
            kinds = [np.float64, np.float64, *others]
        else:
            kinds = [np.float64, others[number % 3]]
        matrix = explicit.matrix
        assert matrix.indices.dtype == matrix.indptr.dtype == np.int32
        sizes = abs(matrix)
        size = np.sqrt(sizes.sum(0).max(initial=0) * sizes.sum(1).max(initial=0))
        for dtype in kinds:
            u = random_field(rng, op.domain, dtype)
            v = random_field(rng, op.codomain, dtype)
            one = explicit(u)
            other = free(u)
            assert one.dtype == other.dtype == u.dtype
            assert one.shape == other.shape == op.codomain.shape
            eps = np.finfo(dtype).eps
            scale = (sizes @ abs(u.astype(complex)).ravel()).reshape(one.shape)
            gap = np.max(abs(one - other) / np.where(scale > 0, scale, 1), initial=0) / eps
            assert not np.any(one[scale == 0]) and not np.any(other[scale == 0])
            for form in (explicit, free):
                left = np.sum(form(u) * v, dtype=complex)
                right = np.sum(u * form.T(v), dtype=complex)
                bound = eps * size * np.linalg.norm(u) * np.linalg.norm(v)
                assert abs(left - right) <= 10 * bound, (op, dtype)
            worst = max(worst, gap)
    assert worst <= 10


def test_transposed_matrix_entry_by_entry(made):
    for op, explicit, _ in some(made, (9,), (6, 4), (2, 2), (4, 3, 5)):
        wanted = explicit.matrix.T
        assert not (explicit.T.matrix - wanted).count_nonzero()
        assert not (op.T.matrix - wanted).count_nonzero()


def test_derivatives_of_every_order(made, rng):
    """JVP is the operator, VJP the transpose, and a Hessian product is A^T A, in both forms."""
    for op, *forms in some(made, (9,), (6, 4), (4, 3, 5)):
        u = random_field(rng, op.domain, float)
        du = random_field(rng, op.domain, float)
        g = random_field(rng, op.codomain, float)
        for form in forms:
            np.testing.assert_array_equal(pushforward(form, u, du)[1], form(du))
            np.testing.assert_array_equal(pullback(form, u)[1](g), form.T(g))
            slope = value_and_grad(lambda u, form=form: 0.5 * anp.sum(form(u) ** 2))
            _, product = pushforward(lambda u, slope=slope: slope(u)[1], u, du)
            np.testing.assert_allclose(product, form.T(form(du)), rtol=1e-12, atol=1e-12 * abs(product).max(initial=0))


def test_linear_and_fresh_and_untouched(made, rng):
    for op, *forms in some(made, (9,), (6, 4)):
        for form in forms:
            u = random_field(rng, op.domain, float)
            v = random_field(rng, op.domain, float)
            kept = u.copy()
            result = form(u)
            np.testing.assert_array_equal(u, kept)
            assert not np.shares_memory(result, u)
            both = form(2.0 * u - v)
            bound = 1e-13 * (abs(both).max(initial=1) + abs(result).max(initial=1))
            np.testing.assert_allclose(both, 2.0 * result - form(v), rtol=1e-12, atol=bound)
            out = np.empty(op.codomain.shape)
            assert form.apply(u, out=out) is out
            np.testing.assert_array_equal(out, result)


def test_refuses_what_does_not_fit(made):
    op = made[6, 4][0][0]
    for wrong in (np.zeros(op.domain.size + 1), np.zeros((*op.domain.shape, 1)), 1.0):
        with pytest.raises(dp.errors.ShapeError, match="takes a field on .*, got an array of shape"):
            op(wrong)
    with pytest.raises(TypeError, match="takes float or complex numbers, got dtype"):
        op(np.full(op.domain.shape, "a"))


ORDER = [(entry, label) for entry, label in zip(CATALOGUE, LABELS) if entry.exact is not None]


def conditions_for(periodic):
    if periodic:
        return [dp.neumann]
    return [dp.neumann, dp.dirichlet, dp.robin(1.0, 0.7), {"x": (dp.dirichlet, dp.neumann)}]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("stretched", [False, True], ids=["uniform", "stretched"])
@pytest.mark.parametrize("periodic", [False, True], ids=["bounded", "periodic"])
@pytest.mark.parametrize("entry", [entry for entry, _ in ORDER], ids=[label for _, label in ORDER])
def test_interior_order(entry, periodic, stretched):
    """Slope of the last three refinements, two cells off the walls, max norm."""
    wanted = (0.9, 1.1) if entry.builder == "upwind" else (1.9, 2.2)
    for dim in range(entry.least_dim, 3 if entry.builder == "upwind" else 4):
        sizes = {1: (128, 256, 512), 2: (64, 128, 256), 3: (32, 64, 96)}[dim]
        if entry.builder == "upwind":
            sizes = [4 * n for n in sizes]  # first order needs more cells to show its slope
        for boundary in entry.conditions(conditions_for(periodic))[: 1 if dim == 3 else None]:
            errors = [interior_error(entry, n, dim, periodic, stretched, boundary) for n in sizes]
            slope = np.polyfit(np.log(sizes), np.log(errors), 1)[0]
            assert wanted[0] <= -slope <= wanted[1], (dim, boundary, errors)


def interior_error(entry, n, dim, periodic, stretched, boundary):
    grid = grid_of(n, dim, periodic, stretched)
    field = Field(periodic)
    op = entry.make(grid, boundary)
    values, wanted = entry.exact(field, grid, boundary)
    error = abs(op(values) - wanted)
    parts = op.codomain.split(error)
    inner = (slice(2, -2),) * dim
    return max(np.max(part[inner] if part.ndim == dim and part.size > 4 else part) for part in parts)


WALLS = {  # least orders of gradient and laplacian over the whole field, L2: the wall truncation is of lower order
    "neumann": (dp.neumann, 1.9, 1.4),
    "dirichlet": (dp.dirichlet, 1.4, 0.4),
    "robin": (dp.robin(1.0, 0.7), 1.4, 0.4),
    "mixed": ({"x": (dp.dirichlet, dp.robin(2.0, 1.0))}, 1.4, 0.4),
}


@pytest.mark.sampled
@pytest.mark.parametrize("stretched", [False, True], ids=["uniform", "stretched"])
@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("kind", WALLS)
def test_order_up_to_the_wall(kind, dim, stretched):
    """Boundary data by lift: the wall truncation is there, and no more."""
    boundary, least_slope, least_laplacian = WALLS[kind]
    errors = []
    sizes = (16, 24, 32) if dim == 3 else (32, 64, 128)
    field = Field(False)
    for n in sizes:
        grid = grid_of(n, dim, False, stretched)
        slopes = dp.gradient(grid, boundary)(field(grid.centres()))
        slopes = slopes + dp.lift(grid, boundary)(field.wall_values(grid, boundary))
        gaps = slopes - field.on_faces(grid, 1)
        curvature = dp.divergence(grid)(slopes) - field.laplacian(grid, boundary)[1]
        errors.append([np.sqrt(np.sum(grid.faces.volumes * gaps**2)), np.sqrt(np.sum(grid.volumes * curvature**2))])
    rates = -np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    assert rates[0] >= least_slope and rates[1] >= least_laplacian, rates


@pytest.mark.parametrize("shape", SHAPES)
def test_discrete_identities(shape):
    """V D I = -(W G I)^T, zero row sums, constants and linears, D @ curl = 0."""
    rng = np.random.default_rng(3)
    for grid in grids(shape, rng):
        volumes = dp.diagonal(grid.cells, grid.volumes)
        areas = dp.diagonal(grid.faces, grid.faces.volumes)
        divergence = dp.divergence(grid)
        inner = dp.interior(grid)
        left = (volumes @ divergence @ inner).matrix
        keep = inner.matrix
        for boundary in boundaries(grid):
            slope = dp.gradient(grid, boundary)
            right = (areas @ slope).matrix.T @ keep
            assert abs((left + right).toarray()).max() <= EPS * abs(left.toarray()).max()
        ones = np.ones(grid.shape)
        pure = dp.laplacian(grid)
        assert abs(pure(ones)).max(initial=0) <= EPS * (abs(pure.matrix) @ ones.ravel()).max(initial=0)
        np.testing.assert_allclose(dp.average(grid)(ones), 1.0, rtol=1e-15)
        np.testing.assert_allclose(dp.sample(grid, [np.array(grid.size) / 2 + grid.origin])(ones), 1.0, rtol=1e-15)
        flow = rng.standard_normal(grid.faces.size)
        total = np.sum(grid.volumes * divergence(inner(flow)))
        assert abs(total) <= EPS * np.sum(abs(grid.volumes * divergence(inner(flow))))
        if grid.dim > 1:
            assert not (divergence @ dp.curl(grid)).matrix.count_nonzero()


def test_linear_fields_are_exact():
    rng = np.random.default_rng(4)
    grid = dp.Grid((6, 5), spacing=[rng.uniform(0.5, 2, 6), rng.uniform(0.5, 2, 5)], origin=(1.0, -2.0))
    x, y = grid.centres()
    u = 2 * x - 3 * y + 1
    inner = dp.interior(grid)
    slopes = grid.join(np.full(grid.face_shape(0), 2.0), np.full(grid.face_shape(1), -3.0))
    np.testing.assert_allclose(inner(dp.gradient(grid)(u)), inner(slopes), rtol=1e-12)
    on_faces = grid.join(*(2 * a - 3 * b + 1 for a, b in map(grid.face_centres, (0, 1))))
    np.testing.assert_allclose(inner(dp.average(grid)(u)), inner(on_faces), rtol=1e-12)
    places = np.array(grid.origin) + rng.random((20, 2)) * np.array(grid.size)
    np.testing.assert_allclose(dp.sample(grid, places)(u), 2 * places[:, 0] - 3 * places[:, 1] + 1, rtol=1e-12)


def test_the_border_to_scipy_conjugates(rng):
    """rmatvec is the adjoint, .T the plain transpose."""
    matrix = random_field(rng, dp.Grid((4, 3)).cells, complex)
    op = dp.from_matrix(matrix)
    x = matrix[0].copy()
    y = matrix[:, 1].copy()
    for border in (op, op.to_scipy()):
        np.testing.assert_allclose(border.matvec(x), matrix @ x, rtol=1e-14)
        np.testing.assert_allclose(border.rmatvec(y), matrix.conj().T @ y, rtol=1e-14)
    np.testing.assert_allclose(op.T @ y, matrix.T @ y, rtol=1e-14)


@pytest.mark.parametrize("builder", [dp.gradient, dp.laplacian])
def test_products_and_sums_stay_factor_defined(builder):
    grid = dp.Grid((5, 4), spacing=0.5)
    product = -dp.divergence(grid) @ dp.gradient(grid) + 3 * dp.identity(grid.cells)
    assert product.separable and not (dp.divergence(grid) @ dp.interior(grid) @ dp.gradient(grid)).separable
    assert len(dp.laplacian(grid).structure.blocks[0, 0]) == grid.dim
    assert dp.laplacian(grid, dp.dirichlet).T.separable
    turned = builder(grid).T.T
    np.testing.assert_array_equal(turned(np.ones(grid.shape)), builder(grid)(np.ones(grid.shape)))


def test_whole_numbers_of_any_size_scale_an_operator():
    """NumPy holds none beyond 64 bits."""
    op = dp.laplacian(dp.Grid(3))
    u = np.array([1.0, 2.0, 4.0])
    assert np.array_equal((2**70 * op)(u), 2.0**70 * op(u))


@pytest.mark.parametrize("number", [3, -0.7, 2**70, 1e308, np.float32(0.3), np.array(7.0), 2 - 3j, np.complex64(1j)])
def test_divided_by_a_number(number):
    """Of 1 / 1e308 digits are lost, of the quotient none."""
    op = dp.laplacian(dp.Grid(4, spacing=0.3))
    u = 1e300 * np.array([1.0, 2.0, 4.0, -3.0])
    np.testing.assert_allclose((op / number)(u), op(u) / number, rtol=2e-15)
    np.testing.assert_allclose((op / number).T(u), op.T(u) / number, rtol=2e-15)
    assert (op / number).name == f"laplacian / {number:g}" or np.iscomplexobj(number)


def test_divided_by_a_subnormal_number():
    op = 2.0**-500 * dp.laplacian(dp.Grid(4))
    u = np.array([1.0, 2.0, 4.0, -3.0])
    np.testing.assert_allclose((op / 2.0**-1030)(u), np.ldexp(op(u), 1030), rtol=2e-15)


def test_divided_by_what_is_no_number():
    op = dp.laplacian(dp.Grid(3))
    assert op.__truediv__("2") is op.__truediv__(op) is NotImplemented


@pytest.mark.parametrize("seed", range(8))
def test_magnitudes_of_large_matrices_are_computed_in_blocks_of_rows(monkeypatch, seed):
    """Without a copy of the matrix; with empty rows, empty matrices and rows longer than a block."""
    rng = np.random.default_rng(seed)
    shape = (rng.integers(0, 12), rng.integers(1, 9))
    dense = np.where(rng.random(shape) < rng.random(), rng.normal(size=shape), 0.0)
    structure = dp.from_matrix(dense).structure
    x = rng.random(shape[1])
    expected = structure.magnitude()(x)
    monkeypatch.setattr("sparsedp.operators.structure.base.MOST_MAGNITUDES", 3)
    assert np.array_equal(structure.magnitude()(x), expected)
    assert np.allclose(expected, np.abs(dense) @ x, rtol=1e-14)
