"""Eigenvalues of pencils that are not symmetric: vectors, derivatives, singular masses, the stability of flows."""

import autograd
import autograd.numpy as anp
import numpy as np
import pytest
import scipy.linalg as la

import sparsedp as dp
from sparsedp.errors import DerivativeError

ENTRIES = dp.matrix_solver.from_coo([0, 0, 1, 1], [0, 1, 0, 1])
N = 8
FULL = dp.matrix_solver.from_coo(*np.divmod(np.arange(N * N), N))


def random_pencil():
    rng = np.random.default_rng(0)
    return rng.standard_normal(N * N), rng.uniform(1.0, 2.0, N)


def test_vectors_are_right_and_left_ones():
    a, m = random_pencil()
    pairs = dp.eigenpairs(FULL, N, 0.3 + 0.2j, coefficients=a, mass=m, symmetric=False)
    A = a.reshape(N, N)
    expected = la.eigvals(A, np.diag(m))
    np.testing.assert_allclose(np.sort_complex(pairs.values.round(9)), np.sort_complex(expected.round(9)), atol=2e-9)
    V, W = pairs.vectors, pairs.left_vectors
    np.testing.assert_allclose(V @ A.T, pairs.values[:, None] * m * V, atol=1e-12)
    np.testing.assert_allclose(W.conj() @ A, pairs.values[:, None] * m * W.conj(), atol=1e-12)
    np.testing.assert_allclose(W.conj() @ np.diag(m) @ V.T, np.eye(N), atol=1e-11)
    np.testing.assert_allclose(np.linalg.norm(V, axis=1), 1.0)
    assert len(pairs) == N
    assert repr(pairs) == "<8 eigenvalues>"


def of_two(a):
    """The eigenvalues of a matrix [[a, b], [c, d]], real or a conjugate pair, in our order."""
    half = 0.5 * (a[0] + a[3])
    root = anp.sqrt((0.5 * (a[0] - a[3])) ** 2 + a[1] * a[2] + 0j)
    return anp.array([half - root, half + root])


@pytest.mark.parametrize("a", [[1.0, 2.0, 0.5, 3.0], [1.0, 2.0, -3.0, 1.5]], ids=["real", "complex"])
def test_derivatives_are_those_of_the_formula(a):
    """Of two eigenvalues: first and second derivatives beside autograd."""
    a = np.array(a)

    def values(a):
        return dp.eigenpairs(ENTRIES, 2, coefficients=a, symmetric=False).values

    def loss(function):
        return lambda a: anp.sum(anp.real(function(a)) ** 3) + anp.sum(anp.array([1.0, 2.0]) * anp.imag(function(a)))

    np.testing.assert_allclose(values(a), of_two(a), rtol=1e-13)
    np.testing.assert_allclose(dp.grad(loss(values))(a), autograd.grad(loss(of_two))(a), rtol=1e-11, atol=1e-12)
    direction = np.array([0.3, -1.0, 0.7, 0.2])
    slope = autograd.grad(loss(of_two))(a) @ direction
    assert dp.jvp(loss(values), a, direction)[1] == pytest.approx(slope, rel=1e-11)
    curvature = autograd.hessian(loss(of_two))(a)
    np.testing.assert_allclose(dp.hvp(loss(values), a, direction), curvature @ direction, rtol=1e-9, atol=1e-11)
    twice = dp.grad(lambda a: anp.sum(dp.grad(loss(values))(a) * direction))(a)
    np.testing.assert_allclose(twice, curvature @ direction, rtol=1e-9, atol=1e-11)


def test_derivatives_in_the_entries_and_the_mass():
    def loss(x):
        values = dp.eigenpairs(FULL, 3, 0.3 + 0.2j, coefficients=x[0], mass=x[1], symmetric=False).values
        return anp.sum(anp.real(values) ** 2 + 2 * anp.imag(values)) + anp.real(values[0]) * anp.imag(values[1])

    x = random_pencil()
    assert dp.check.gradient(loss, x).verdict == "agrees"
    rng = np.random.default_rng(1)
    tangent = rng.standard_normal(N * N), rng.standard_normal(N)
    gradient = dp.grad(loss)(x)
    slope = np.vdot(gradient[0], tangent[0]) + np.vdot(gradient[1], tangent[1])
    assert dp.jvp(loss, x, tangent)[1] == pytest.approx(slope, rel=1e-12)
    curvature = dp.hvp(loss, x, tangent)
    h = 1e-5
    above, below = (dp.grad(loss)((x[0] + s * tangent[0], x[1] + s * tangent[1])) for s in (h, -h))
    for one, other, exact in zip(above, below, curvature, strict=True):
        np.testing.assert_allclose((one - other) / (2 * h), exact, rtol=0, atol=1e-7 * np.max(np.abs(exact)))


def test_a_symmetric_operator_has_the_same_derivatives():
    grid = dp.Grid((6, 5), size=(1.0, 0.8))
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet))
    k = np.linspace(1.0, 2.0, grid.faces.size)
    slopes = [
        dp.grad(lambda k, s=s: anp.real(dp.eigenpairs(solve, 2, 30.0, coefficients=k, symmetric=s).values[1]))(k)
        for s in (True, False)
    ]
    np.testing.assert_allclose(slopes[1], slopes[0], rtol=1e-9, atol=1e-12)


def reaction(x, p):
    return {"u": x["w"] - p * x["u"] ** 2, "w": -x["u"] * p + 0.3 * x["w"] ** 3 - x["w"] * x["u"]}


def test_the_jacobian_of_a_residual():
    """Its state and its parameters have derivatives; J is diagonal in blocks [[-2 p u, 1], [-p - w, 0.9 w^2 - u]]."""
    state = {"u": np.array([1.0, 2.0]), "w": np.array([0.3, 0.4])}

    def twin(state, p, mass):
        u, w = state["u"][0], state["w"][0]
        return of_two(anp.array([-2 * p * u / mass, 1 / mass, -p - w, 0.9 * w**2 - u]))[1]

    def ours(state, p, mass):
        masses = {"u": mass, "w": np.ones(2)}
        return dp.eigenpairs(reaction, 1, -1.1 + 1.2j, masses, (state, p), symmetric=False).values[0]

    point = state, 1.7, 1.3
    assert ours(*point) == pytest.approx(twin(*point), rel=1e-12)
    for part in (anp.real, anp.imag):
        slopes = dp.grad(lambda x, part=part: part(ours(*x)))(point)
        expected = dp.grad(lambda x, part=part: part(twin(*x)))(point)
        for one, other in zip([*slopes[0].values(), *slopes[1:]], [*expected[0].values(), *expected[1:]], strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-13)
    pairs = dp.eigenpairs(dp.implicit(reaction), 4, 0.0, coefficients=(state, 1.7), symmetric=False)
    assert pairs.vectors["u"].shape == (4, 2)
    assert pairs.left_vectors["w"].shape == (4, 2)


# ---- flows -----------------------------------------------------------------------------------------------------------


class Layer:
    """A fluid layer heated from below, half a wavelength long: perturbations of the conducting state."""

    def __init__(self, n, wavenumber=3.117):
        self.grid = grid = dp.Grid((n, n), size=(np.pi / wavenumber, 1.0))
        flow = {"x": dp.free_slip, "y": dp.no_slip}
        heat = {"x": dp.neumann, "y": dp.dirichlet}
        self.D, self.G, self.L = dp.divergence(grid), dp.gradient(grid), dp.face_laplacian(grid, flow)
        self.conduct, self.to_faces = dp.laplacian(grid, heat), dp.average(grid, heat)
        self.free = dp.free_faces(grid, flow)
        self.up = grid.join(0.0, 1.0)
        self.pin = (np.arange(n * n) == 0.0).reshape(grid.shape)
        zero = np.zeros(grid.shape)
        self.rest = {"v": np.zeros(grid.faces.size), "p": zero, "T": zero}
        self.root = dp.implicit(self)
        self.mass = {"v": self.free(np.ones(grid.faces.size)), "p": 0.0, "T": 1.0}

    def __call__(self, x, rayleigh):
        v, p, T = x["v"], x["p"], x["T"]
        momentum = self.L(v) + rayleigh * self.up * self.to_faces(T) - self.G(p)
        _, upward = self.grid.split(v)
        return {
            "v": self.free(momentum) + v - self.free(v),
            "p": self.D(v) + self.pin * p,
            "T": self.conduct(T) - self.D(v * self.to_faces(T)) + 0.5 * (upward[:, 1:] + upward[:, :-1]),
        }

    def growth(self, rayleigh, **options):
        pairs = dp.eigenpairs(self.root, 1, 1.0, self.mass, (self.rest, rayleigh), symmetric=False, **options)
        return anp.real(pairs.values[0])


def test_a_singular_mass_is_that_of_the_constrained_system():
    """The finite eigenvalues are the eigenvalues of the projection on the fields without divergence."""
    layer = Layer(4)

    def flat(x):
        return np.concatenate([np.ravel(x[name]) for name in ("v", "p", "T")])

    sizes = [layer.grid.faces.size, layer.grid.cells.size, layer.grid.cells.size]
    size = sum(sizes)

    def tree(x):
        v, p, T = np.split(x, np.cumsum(sizes)[:-1])
        return {"v": v, "p": p.reshape(layer.grid.shape), "T": T.reshape(layer.grid.shape)}

    J = np.array([flat(dp.jvp(lambda x: layer(x, 100.0), layer.rest, tree(unit))[1]) for unit in np.eye(size)]).T
    has_mass = flat({name: layer.mass[name] + 0 * field for name, field in layer.rest.items()}) != 0
    is_moving = has_mass | (np.arange(size) // sizes[0] == 0)
    basis = la.null_space(np.concatenate([J[~has_mass]])[:, is_moving])
    projected = basis[has_mass[is_moving]]
    small = np.linalg.pinv(projected) @ J[np.ix_(has_mass, is_moving)] @ basis
    expected = np.sort(la.eigvals(small).real)[-3:]
    for method in ("dense", "arpack"):
        values = dp.eigenpairs(layer, 3, 1.0, layer.mass, (layer.rest, 100.0), symmetric=False, method=method).values
        np.testing.assert_allclose(values, expected, rtol=1e-8)


def test_the_onset_of_convection():
    """Rigid walls, wavenumber 3.117: the critical Rayleigh number is 1707.762 (Chandrasekhar 1961), order 2."""
    critical = []
    for n in (8, 16):
        layer = Layer(n)
        rayleigh = 1650.0
        for _ in range(3):
            value, slope = dp.value_and_grad(layer.growth)(rayleigh)
            rayleigh = rayleigh - value / slope
        critical.append(rayleigh)
    errors = 1707.762 - np.array(critical)
    assert np.log2(errors[0] / errors[1]) == pytest.approx(1.9, abs=0.15)
    assert (4 * critical[1] - critical[0]) / 3 == pytest.approx(1707.762, rel=4e-3)


@pytest.mark.whole
def test_the_gradient_of_a_growth_rate_agrees():
    layer = Layer(4)
    slope = dp.grad(layer.growth)(1500.0)
    assert slope == pytest.approx((layer.growth(1500.1) - layer.growth(1499.9)) / 0.2, rel=1e-7)
    assert dp.jvp(layer.growth, 1500.0, 1.0)[1] == pytest.approx(slope, rel=1e-10)
    curvature = dp.grad(dp.grad(layer.growth))(1500.0)
    above, below = dp.grad(layer.growth)(1501.0), dp.grad(layer.growth)(1499.0)
    assert curvature == pytest.approx((above - below) / 2, rel=1e-5)


def test_a_mass_of_both_signs():
    a, m = random_pencil()
    m = np.where(np.arange(N) % 2, m, -m)
    pairs = dp.eigenpairs(FULL, 3, 0.5, coefficients=a, mass=m, symmetric=False)
    expected = la.eigvals(a.reshape(N, N) / m[:, None])
    for value in pairs.values:
        assert np.min(np.abs(expected - value)) < 1e-12
    opposite = dp.eigenpairs(FULL, 3, -0.5, coefficients=a, mass=-m, symmetric=False)
    for value in opposite.values:
        assert np.min(np.abs(pairs.values + value)) < 1e-12


@pytest.mark.parametrize(("of_matrix", "of_mass"), [(2.0**300, 1.0), (2.0**-300, 2.0**200), (1.0, 2.0**-300)])
def test_units_do_not_matter(of_matrix, of_mass):
    def slope(s, t):
        def loss(a):
            pairs = dp.eigenpairs(FULL, 2, (0.3 + 0.5j) * s / t, m * t, a, symmetric=False)
            return anp.imag(pairs.values[0])

        return dp.grad(loss)(a * s)

    a, m = random_pencil()
    np.testing.assert_allclose(slope(of_matrix, of_mass) * of_mass, slope(1.0, 1.0), rtol=1e-11, atol=1e-14)


# ---- multiple eigenvalues --------------------------------------------------------------------------------------------


def similar(blocks):
    """S D S^-1 for a matrix D of blocks on the diagonal and a random S."""
    D = la.block_diag(*blocks)
    S = np.random.default_rng(2).standard_normal(D.shape)
    return S @ D @ np.linalg.inv(S)


TURN = np.array([[1.0, 2.0], [-2.0, 1.0]])


@pytest.mark.parametrize(
    "matrix",
    [
        np.eye(3),
        np.diag([2.0, 3.0, 2.0]),
        np.zeros((2, 2)),
        similar([1.0, 1.0, 1.0, 2.0, 2.0, 5.0]),
        similar([TURN] * 3),
    ],
    ids=["identity", "diagonal", "zero", "similar", "complex"],
)
@pytest.mark.parametrize("unit", [1.0, 2.0**300])
def test_semisimple_eigenvalues_have_dual_bases(matrix, unit):
    n = len(matrix)
    mass = np.linspace(1.0, 2.0, n)
    A = mass[:, None] * matrix * unit
    for k in (1, n):
        pairs = dp.eigenpairs(dp.from_matrix(A), k, mass=mass, symmetric=False)
        values, V, W = pairs.values, pairs.vectors, pairs.left_vectors
        size = np.max(np.abs(A))
        np.testing.assert_allclose(V @ A.T, values[:, None] * mass * V, rtol=0, atol=1e-13 * size)
        left_size = max(1.0, np.max(np.abs(W)))
        np.testing.assert_allclose(
            W.conj() @ A, values[:, None] * mass * W.conj(), rtol=0, atol=1e-13 * left_size * size
        )
        np.testing.assert_allclose(W.conj() @ (mass * V).T, np.eye(k), rtol=0, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(V, axis=1), 1.0, rtol=1e-14)
        sizes = np.linalg.norm(W, axis=1) * np.linalg.norm(mass * V, axis=1)
        np.testing.assert_allclose(pairs.condition_numbers, sizes, rtol=1e-12)
    assert np.linalg.matrix_rank(V, 1e-3) == n


def test_all_copies_of_an_eigenvalue_on_a_periodic_grid():
    grid = dp.Grid((8, 8), periodic=True)
    L = -dp.laplacian(grid)
    for method in ("dense", "arpack"):
        pairs = dp.eigenpairs(L, 4, 0.6, symmetric=False, method=method)
        V = pairs.vectors.reshape(4, -1)
        np.testing.assert_allclose(pairs.values, 4 * np.sin(np.pi / 8) ** 2, rtol=1e-12)
        np.testing.assert_allclose(pairs.left_vectors.reshape(4, -1).conj() @ V.T, np.eye(4), atol=1e-12)
        np.testing.assert_allclose(
            [L(v.real) for v in pairs.vectors], pairs.values.real[:, None, None] * pairs.vectors.real, atol=1e-12
        )


def test_a_defective_eigenvalue_has_left_vectors_of_norm_one():
    """As scipy.linalg.eig: of a Jordan block, the right vector is e_1 and the left one e_n, which are perpendicular."""
    for n, mass in ((2, 1.0), (3, 1e200)):
        pairs = dp.eigenpairs(dp.from_matrix(np.eye(n) + np.eye(n, k=1)), n, mass=mass, symmetric=False)
        np.testing.assert_allclose(np.abs(pairs.vectors), np.tile(np.eye(n)[0], (n, 1)), atol=1e-12)
        np.testing.assert_allclose(np.abs(pairs.left_vectors), np.tile(np.eye(n)[-1], (n, 1)), atol=1e-12)
        assert np.all(pairs.condition_numbers == np.inf)
    block = la.block_diag([[1.0, 1.0], [0.0, 1.0]], 1.0)
    pairs = dp.eigenpairs(dp.from_matrix(block), 3, symmetric=False)
    assert sorted(np.unique(pairs.condition_numbers)) == pytest.approx([1.0, np.inf])
    np.testing.assert_allclose(pairs.vectors @ block.T, pairs.vectors, atol=1e-14)
    np.testing.assert_allclose(pairs.left_vectors @ block, pairs.left_vectors, atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(pairs.left_vectors, axis=1), 1.0)


@pytest.mark.parametrize("sizes", [(2,), (3,), (2, 1), (2, 2)])
@pytest.mark.parametrize("unit", [1.0, 2.0**-300])
def test_defective_eigenvalues_that_rounding_splits_have_infinite_condition_numbers(sizes, unit):
    """Rounding splits a Jordan block of size m into eigenvalues at distances of about eps^(1/m)."""
    rng = np.random.default_rng(0)
    count = sum(sizes)
    blocks = la.block_diag(*[np.eye(size) + np.eye(size, k=1) for size in sizes], np.diag(np.arange(2.0, 10 - count)))
    n = len(blocks)
    for _ in range(4):
        Q = rng.standard_normal((n, n))
        pairs = dp.eigenpairs(dp.from_matrix(unit * Q @ blocks @ np.linalg.inv(Q)), count, symmetric=False)
        norms = np.linalg.norm(pairs.left_vectors, axis=1)
        is_infinite = np.isinf(pairs.condition_numbers)
        assert np.any(is_infinite)
        assert np.any(~is_infinite) == (1 in sizes)
        np.testing.assert_allclose(norms[is_infinite], 1.0, rtol=1e-12)
        np.testing.assert_allclose(norms[~is_infinite], pairs.condition_numbers[~is_infinite], rtol=1e-6)
        assert np.all(norms < 1e3)


def test_vectors_where_the_first_shift_of_inverse_iteration_is_an_eigenvalue():
    """1 + 2e-9 is the shift for the eigenvalue 1 of this matrix, whose mean row is 2."""
    matrix = np.diag([1.0, 1 + 2e-9, 3.0, 3.0 - 2e-9])
    pairs = dp.eigenpairs(dp.from_matrix(matrix), 2, symmetric=False)
    np.testing.assert_allclose(np.abs(pairs.vectors), np.eye(2, 4), atol=1e-6)


def test_condition_numbers_are_those_of_scipy():
    """The second matrix has simple eigenvalues 1, 2, ..., 12 with condition numbers up to 1e8."""
    for matrix in (np.array([[1.0, 1.0], [1e-6, 1.0]]), np.diag(np.arange(1.0, 13.0)) + 12 * np.eye(12, k=1)):
        n = len(matrix)
        pairs = dp.eigenpairs(dp.from_matrix(matrix), n, symmetric=False)
        values, left, right = la.eig(matrix, left=True)
        expected = 1 / np.abs(np.sum(left.conj() * right, axis=0))[np.argsort(values.real)]
        np.testing.assert_allclose(pairs.condition_numbers, expected, rtol=1e-6)
        products = np.sum(pairs.left_vectors.conj() * pairs.vectors, axis=1)
        np.testing.assert_allclose(products, 1.0, rtol=1e-6)


# ---- what has no derivative ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "matrix",
    [np.diag([1.0, 1.0, 3.0]), [[1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 3.0]], np.diag([1.0, 1.0 + 1e-8, 3.0])],
    ids=["double", "defective", "close"],
)
@pytest.mark.parametrize("k", [1, 3])
def test_multiple_eigenvalues_are_refused(matrix, k):
    solve = dp.matrix_solver.from_coo(*np.divmod(np.arange(9), 3))
    entries = np.ravel(matrix)

    def value(a, number):
        return anp.real(dp.eigenpairs(solve, k, 0.9, coefficients=a, symmetric=False).values[number])

    with pytest.raises(
        DerivativeError,
        match=r"eigenvalue 0 of eigenpairs, 1.*, has no derivative: it is a multiple one, or another one is at a "
        "distance of .*",
    ):
        dp.grad(value)(entries, 0)
    with pytest.raises(DerivativeError):
        dp.jvp(lambda a: value(a, 0), entries, np.ones(9))
    if k == 3:
        np.testing.assert_allclose(dp.grad(value)(entries, 2), np.eye(9)[8], atol=1e-12)


@pytest.mark.parametrize("which, exact", [(2.0, [1.0, 2.0]), (5.0, [3.0, 4.0, 5.0, 6.0])])
def test_values_near_a_shift_that_is_an_eigenvalue(which, exact):
    matrix = np.diag(np.arange(1.0, 30.0)) + np.eye(29, k=1)
    pairs = dp.eigenpairs(dp.from_matrix(matrix), len(exact), which, symmetric=False, method="arpack")
    assert pairs.values == pytest.approx(exact, rel=1e-10)
