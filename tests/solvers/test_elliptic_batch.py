"""elliptic_solver with a batch of coefficients: the solves and the derivatives of a loop over its entries."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.errors import ConvergenceError, IncompatibleError, NonFiniteError, ShapeError

GRID = dp.Grid((4, 3), size=1.0)
BATCH = 3
RNG = np.random.default_rng(0)
FACES = RNG.uniform(0.5, 1.5, (BATCH, GRID.faces.size))
SHIFTS = RNG.uniform(0.5, 1.5, (BATCH, *GRID.shape))
RIGHT = RNG.random((BATCH, *GRID.shape))
TENSORS = np.eye(2)[:, :, None, None] * RNG.uniform(1, 2, (BATCH, 1, 1, *GRID.shape)) + 0.1
# For each argument: its value, and the function that takes the value of one entry of the batch.
COEFFICIENTS = {
    "faces": (FACES, lambda k, i: k[i]),
    "numbers": (FACES[:, :1], lambda k, i: k[i, 0]),
    "tensors": (TENSORS, lambda k, i: k[i]),
    "one field": (FACES[0], lambda k, i: k),
    "one number": (2.0, lambda k, i: k),
    "one tensor": (TENSORS[0], lambda k, i: k),
}
REACTIONS = {
    "fields": (SHIFTS, lambda s, i: s[i]),
    "numbers": (SHIFTS[:, :1, :1], lambda s, i: s[i, 0, 0]),
    "one field": (SHIFTS[0], lambda s, i: s),
    "one number": (0.3, lambda s, i: s),
}
SIDES = {"fields": (RIGHT, lambda b, i: b[i]), "one field": (RIGHT[0], lambda b, i: b)}


def solver(boundary=dp.neumann, *args, **options):
    return dp.elliptic_solver(dp.divergence(GRID), dp.gradient(GRID, boundary), *args, **options)


def relative_gap(found, wanted):
    return np.max(np.abs(np.asarray(found) - np.asarray(wanted))) / np.max(np.abs(wanted))


@pytest.mark.whole
@pytest.mark.parametrize("right", SIDES)
@pytest.mark.parametrize("reaction", REACTIONS)
@pytest.mark.parametrize("coefficient", COEFFICIENTS)
def test_every_batch_is_a_loop(coefficient, reaction, right):
    if coefficient.startswith("one") and reaction.startswith("one"):
        pytest.skip("no batch of coefficients")
    compare_with_loop(coefficient, reaction, right)


@pytest.mark.parametrize(
    ("coefficient", "reaction", "right"),
    [("faces", "one number", "fields"), ("one field", "fields", "one field"), ("tensors", "numbers", "one field")],
)
def test_a_batch_is_a_loop(coefficient, reaction, right):
    compare_with_loop(coefficient, reaction, right)


def compare_with_loop(coefficient, reaction, right):
    """Compare values, gradients and products with the Hessian."""
    (k, k_of), (s, s_of), (b, b_of) = COEFFICIENTS[coefficient], REACTIONS[reaction], SIDES[right]
    solve = solver()

    def loss(x):
        return anp.sum(anp.sin(3.0 * solve(*x)))

    def by_loop(x):
        k, b, s = x
        return sum(anp.sum(anp.sin(3.0 * solve(k_of(k, i), b_of(b, i), s_of(s, i)))) for i in range(BATCH))

    x = (k, b, s)
    wanted = np.stack([solve(k_of(k, i), b_of(b, i), s_of(s, i)) for i in range(BATCH)])
    assert relative_gap(solve(*x), wanted) < 1e-13
    tangent = tuple(np.random.default_rng(1).standard_normal(np.shape(value)) for value in x)
    for found, exact in zip(dp.grad(loss)(x), dp.grad(by_loop)(x)):
        assert relative_gap(found, exact) < 1e-11
    for found, exact in zip(dp.hvp(loss, x, tangent), dp.hvp(by_loop, x, tangent)):
        assert relative_gap(found, exact) < 1e-9
    assert dp.jvp(loss, x, tangent)[1] == pytest.approx(dp.jvp(by_loop, x, tangent)[1], rel=1e-11)


def test_gradients_beside_finite_differences():
    solve = solver(dp.dirichlet)
    loss = lambda x: anp.sum(solve(*x) ** 2)
    assert dp.check.gradient(loss, (FACES, RIGHT[0], SHIFTS[:, :1, :1]), quick=True).verdict == "agrees"


def test_one_set_up_for_each_entry(monkeypatch):
    solve = solver(dp.dirichlet)
    built = []
    new_inverse = solve._new_inverse
    monkeypatch.setattr(solve, "_new_inverse", lambda k, shift: built.append(1) or new_inverse(k, shift))
    for _ in range(2):
        dp.grad(lambda k: anp.sum(solve(k, RIGHT)))(FACES)
    assert len(built) == BATCH


def test_kinds_of_numbers():
    solve = solver(dp.dirichlet)
    assert solve(FACES, RIGHT.astype(np.float32)).dtype == np.float32
    waves = solve(FACES + 0.1j, RIGHT)
    assert waves.dtype == complex
    assert relative_gap(waves[1], solve(FACES[1] + 0.1j, RIGHT[1])) < 1e-14
    assert solve(FACES[:0], RIGHT[:0]).shape == (0, *GRID.shape)
    assert solve(FACES[:1], RIGHT[0]).shape == (1, *GRID.shape)
    assert solve(FACES[:0], RIGHT[0]).shape == (0, *GRID.shape)
    single = RIGHT[0].astype(np.float32)
    assert solve(FACES[:0] + 0.1j, single).dtype == solve(FACES + 0.1j, single).dtype == np.complex64
    assert solve(1.0, RIGHT[0], np.zeros((0, *GRID.shape), complex)).dtype == complex


def test_one_dimension_and_one_cell():
    for cells in (1, 3):
        line = dp.Grid(cells)
        solve = dp.elliptic_solver(dp.divergence(line), dp.gradient(line, dp.dirichlet))
        k = RNG.uniform(0.5, 1.5, (cells, cells + 1))
        wanted = [solve(row, np.ones(cells)) for row in k]
        assert np.allclose(solve(k, np.ones(cells)), wanted, rtol=1e-14)


def test_a_jitted_loss():
    solve = solver(dp.dirichlet)
    loss = lambda k: anp.sum(solve(k, RIGHT) ** 2)
    jitted = dp.value_and_grad(dp.jit(loss))
    for scale in (1.0, 1.5):
        value, slope = dp.value_and_grad(loss)(scale * FACES)
        other, gradient = jitted(scale * FACES)
        assert value == other and relative_gap(gradient, slope) < 1e-14


def test_a_field_with_an_axis_too_many_is_no_batch():
    """(faces, 1), as a network returns it, would be a batch of one number for each face."""
    line = dp.Grid(4, size=1.0)
    solve = dp.elliptic_solver(dp.divergence(line), dp.gradient(line, dp.dirichlet))
    b = np.ones(4)
    with pytest.raises(
        ShapeError,
        match=r"k of shape \(5, 1\) may be a batch of 5 numbers, or a field on faces\(4\) of shape \(5,\) with an "
        r"axis too many; write k\[:, 0\] for the field, or k \* np\.ones\(\(1, 5\)\) for the batch",
    ):
        solve(np.ones((5, 1)), b)
    with pytest.raises(ShapeError, match=r"shift of shape \(4, 1\) may be a batch of 4 numbers, or a field on cells"):
        solve(1.0, b, np.ones((4, 1)))
    numbers = np.arange(1.0, 6.0)[:, None]
    expected = [solve(number, b) for number in numbers[:, 0]]
    np.testing.assert_allclose(solve(numbers * np.ones((1, 5)), b), expected, rtol=1e-13)
    np.testing.assert_allclose(solve(numbers[:4], b), expected[:4], rtol=1e-13)


def test_fluxes_of_a_batch():
    solve = solver(dp.dirichlet)
    slopes = solve.G(RIGHT)
    assert np.array_equal(solve.flux(FACES, slopes)[1], solve.flux(FACES[1], slopes[1]))
    assert np.allclose(solve.flux(TENSORS, slopes)[1], solve.flux(TENSORS[1], slopes[1]), rtol=1e-14)


def test_errors():
    solve = solver(dp.dirichlet)
    with pytest.raises(
        ShapeError,
        match=r"elliptic_solver needs one batch size, got 3 of k, 2 of b; give each the same leading axis, or none",
    ):
        solve(FACES, RIGHT[:2])
    with pytest.raises(
        ShapeError,
        match=r"b takes a field on cells\(4, 3\), or one for each entry of the batch of coefficients, got an array of "
        r"shape \(2, 3, 4, 3\)",
    ):
        solve(FACES, np.ones((2, *RIGHT.shape)))
    with pytest.raises(
        ShapeError,
        match="elliptic_solver.operator takes one k, got a batch of 3; call it for each entry along the first axis",
    ):
        solve.operator(FACES)
    with pytest.raises(ValueError, match=r"k must be >= 0, got -1 at \(2, 5\)"):
        solve(np.where(np.arange(FACES.size).reshape(FACES.shape) == 2 * GRID.faces.size + 5, -1.0, FACES), RIGHT)
    with pytest.raises(
        NonFiniteError, match=r"k must be finite, got 93 that are NaN or infinite, the first at \(0, 0\)"
    ):
        solve(FACES * np.nan, RIGHT)
    with pytest.raises(ValueError, match=r"k\[1\] must be positive definite in every cell"):
        solve(TENSORS * np.array([1.0, -1.0, 1.0]).reshape(3, 1, 1, 1, 1), RIGHT)
    with pytest.raises(ShapeError, match="write harmonic_average"):
        solve(np.ones(GRID.shape), RIGHT)
    strip = dp.Grid((5, 1))  # its cells have the shape of a batch of numbers
    with pytest.raises(ShapeError, match=r"got an array of shape \(5, 1\); write harmonic_average"):
        dp.elliptic_solver(dp.divergence(strip), dp.gradient(strip, dp.dirichlet))(np.ones((5, 1)), np.ones((5, 1)))
    singular = solver(dp.neumann)
    with pytest.raises(IncompatibleError, match="entry 0 of the batch: elliptic_solver is singular"):
        singular(FACES, RIGHT)
    slow = solver(dp.dirichlet, "krylov", maxiter=1, preconditioner=None)
    with pytest.raises(ConvergenceError, match="entry 0 of the batch: "):
        slow(FACES, RIGHT)
