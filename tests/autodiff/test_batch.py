"""Leading axes are a batch: the same as one field after the other, in values and in derivatives."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

GRID = dp.Grid((5, 4), size=1.0)
CELLS = GRID.cells
FACES = GRID.faces
G = dp.gradient(GRID, dp.dirichlet)
D = dp.divergence(GRID)
LAPLACIAN = D @ G
OPERATORS = {
    "explicit": LAPLACIAN.explicit(),
    "matrix-free": LAPLACIAN.matrix_free(),
    "gradient": G,
    "scaled": 2j * LAPLACIAN,
    "component": dp.component(GRID, 0),
    "given": dp.from_functions(np.cumsum, lambda g: np.cumsum(g[::-1])[::-1], 7, 7),
    "inverse": dp.inverse(-LAPLACIAN),
    "direct": dp.inverse(-LAPLACIAN, method="direct"),
    "projection": dp.projection(GRID),
    "flux": dp.flux(GRID, (slice(1, 4), slice(1, 3))),
}


def one_by_one(function, batch, shape):
    flat = [function(u) for u in batch.reshape(-1, *shape)]
    return np.array(flat).reshape(*batch.shape[: batch.ndim - len(shape)], *np.shape(flat[0]))


@pytest.mark.parametrize("name", OPERATORS)
@pytest.mark.parametrize("lead", [(3,), (2, 3), (0,), (1,)])
@pytest.mark.parametrize("turned", [False, True])
def test_a_batch_through_an_operator(name, lead, turned, rng):
    op = OPERATORS[name].T if turned else OPERATORS[name]
    batch = rng.normal(size=(*lead, *op.domain.shape))
    result = op(batch)
    assert result.shape == (*lead, *op.codomain.shape)
    if batch.size:
        assert np.array_equal(result, one_by_one(op, batch, op.domain.shape))
    out = np.empty_like(result)
    assert op.apply(batch, out=out) is out and np.array_equal(out, result)
    assert op(batch.astype("f")).dtype.itemsize == result.dtype.itemsize // 2


@pytest.mark.parametrize("name", ["explicit", "matrix-free", "inverse", "projection", "flux"])
def test_derivatives_of_a_batch(name, rng):
    op = OPERATORS[name]
    batch = rng.normal(size=(2, 3, *op.domain.shape))
    direction = rng.normal(size=(2, 3, *op.domain.shape))
    weights = rng.normal(size=(2, 3, *op.codomain.shape))
    gradient = dp.grad(lambda u: anp.sum(weights * op(u)))(batch)
    assert np.array_equal(gradient, one_by_one(op.T, weights, op.codomain.shape))
    _, tangent = dp.jvp(op, batch, direction)
    assert np.array_equal(tangent, one_by_one(op, direction, op.domain.shape))
    assert dp.check.gradient(lambda u: anp.sum(weights * op(u) ** 2), batch, quick=True).verdict == "agrees"


@pytest.mark.parametrize("lead", [(3,), (2, 3), (0,)])
def test_second_order_of_a_batch_of_numbers(lead, rng):
    """The codomain of `flux` is 0-d: each entry of its batch is one number."""
    op = OPERATORS["flux"]
    row = op.matrix.toarray()[0]
    u, direction = rng.normal(size=(2, *lead, FACES.size))
    twin = lambda u: anp.sum(anp.sum(row * u, -1) ** 4)
    loss = lambda u: anp.sum(op(u) ** 4)
    assert np.allclose(dp.grad(loss)(u), dp.grad(twin)(u), rtol=1e-12)
    assert np.allclose(dp.hvp(loss, u, direction), dp.hvp(twin, u, direction), rtol=1e-12)
    numbers = rng.normal(size=lead)
    assert np.allclose(op.T(numbers), numbers[..., None] * row, rtol=1e-14)
    back = lambda s: anp.sum((op.T(s)) ** 4)
    assert np.allclose(dp.grad(back)(numbers), 4 * numbers**3 * np.sum(row**4), rtol=1e-12)
    product = op @ op.T
    assert np.allclose(dp.inverse(product)(product(numbers)), numbers, rtol=1e-12)


@pytest.mark.parametrize("k", [0.7, np.linspace(0.5, 2.0, FACES.size)])
def test_many_right_hand_sides_of_one_coefficient(k, rng):
    solve = dp.elliptic_solver(D, G)
    batch = rng.normal(size=(4, *GRID.shape))
    assert np.array_equal(solve(k, batch, 0.3), one_by_one(lambda b: solve(k, b, 0.3), batch, GRID.shape))

    def loss(some):
        k, b, shift = some
        return anp.sum(solve(k, b, shift) ** 2)

    def loss_one_by_one(some):
        k, b, shift = some
        return sum(anp.sum(solve(k, b[n], shift) ** 2) for n in range(len(batch)))

    for found, wanted in zip(dp.grad(loss)((k, batch, 0.3)), dp.grad(loss_one_by_one)((k, batch, 0.3)), strict=True):
        assert np.allclose(found, wanted, rtol=1e-12)
    assert dp.check.gradient(loss, (k, batch, 0.3), quick=True).verdict == "agrees"
    tangents = 0.1 * np.ones_like(k), np.ones_like(batch), -0.2
    tangents = (float(tangents[0]), *tangents[1:]) if np.ndim(k) == 0 else tangents
    slope = dp.jvp(loss, (k, batch, 0.3), tangents)[1]
    assert np.isclose(slope, dp.jvp(loss_one_by_one, (k, batch, 0.3), tangents)[1], rtol=1e-12)


def test_many_right_hand_sides_of_one_matrix(rng):
    solve = dp.matrix_solver(LAPLACIAN.matrix, domain=CELLS)
    data = LAPLACIAN.matrix.data * rng.uniform(0.9, 1.1, LAPLACIAN.matrix.nnz)
    batch = rng.normal(size=(3, *GRID.shape))
    assert np.array_equal(solve(data, batch), one_by_one(lambda b: solve(data, b), batch, GRID.shape))

    def loss(some):
        return anp.sum(solve(*some) ** 2)

    def loss_one_by_one(some):
        return sum(anp.sum(solve(some[0], some[1][n]) ** 2) for n in range(len(batch)))

    for found, wanted in zip(dp.grad(loss)((data, batch)), dp.grad(loss_one_by_one)((data, batch)), strict=True):
        assert np.allclose(found, wanted, rtol=1e-10)
    assert dp.check.gradient(loss, (data, batch), quick=True).verdict == "agrees"


def test_a_batch_inside_a_rollout_agrees_with_single_runs(rng):
    batch = rng.normal(size=(3, *GRID.shape))

    def run(u):
        return dp.rollout(lambda u, _: u + 1e-3 * LAPLACIAN(u), u, None, 4)

    assert np.allclose(run(batch), one_by_one(run, batch, GRID.shape), rtol=1e-14)


@pytest.mark.parametrize("shape", [(4, 5), (3, 4, 5), (5, 4, 3), (20,), (4,), ()])
def test_other_shapes_are_refused(shape):
    with pytest.raises(dp.errors.ShapeError, match=r"takes a field on cells\(5, 4\), got an array of shape"):
        LAPLACIAN(np.ones(shape))


@pytest.mark.parametrize("solid", [False, True])
@pytest.mark.parametrize("boundary", [dp.neumann, dp.dirichlet])
@pytest.mark.parametrize("method", ["backward_euler", "crank_nicolson", "tr_bdf2", "imex", "rk4"])
def test_a_batch_of_states_is_stepped_field_by_field(method, boundary, solid, rng):
    """Also where L leaves the mean as it is, which is split off before a solve: each field has its own."""
    obstacle = np.zeros(GRID.shape, bool)
    obstacle[1, 1:3] = solid
    L = dp.laplacian(GRID, boundary, obstacle if solid else None)
    rate = {"imex": (lambda u, p: p * u,), "rk4": (lambda u, p: p * L(u),)}.get(method, (L,))
    step = dp.stepper(method, *rate, 1e-3, **({"linear": L} if method == "imex" else {}))
    batch = rng.normal(size=(3, *GRID.shape)) + np.arange(3.0)[:, None, None]
    assert np.allclose(step(batch, 1.0), one_by_one(lambda u: step(u, 1.0), batch, GRID.shape), rtol=1e-12, atol=1e-13)
    weights = rng.normal(size=batch.shape)
    slope = dp.grad(lambda u: anp.sum(weights * step(u, 1.0)))(batch)
    for n in range(3):
        single = dp.grad(lambda u, n=n: anp.sum(weights[n] * step(u, 1.0)))(batch[n])
        assert np.allclose(slope[n], single, rtol=1e-11, atol=1e-12)


def test_a_start_is_for_one_field():
    with pytest.raises(dp.errors.ShapeError, match="takes a field on"):
        OPERATORS["inverse"](np.ones((2, *GRID.shape)), start=np.zeros(GRID.shape))


def test_unrolled_solves_of_a_batch_take_steps_of_their_own(rng):
    unrolled = dp.inverse(-LAPLACIAN, method="krylov", diff="unrolled")
    batch = rng.normal(size=(3, *GRID.shape))
    assert np.array_equal(unrolled(batch), one_by_one(unrolled, batch, GRID.shape))
    assert dp.check.gradient(lambda b: anp.sum(unrolled(b) ** 2), batch, quick=True).verdict == "agrees"
