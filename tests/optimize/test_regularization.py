"""total_variation, smoothness and admm: values against loops, walls and obstacles, optimality conditions."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

GRIDS = [
    dp.Grid(7, spacing=[np.linspace(0.5, 2.0, 7)]),
    dp.Grid((5, 6), size=(1.0, 3.0), periodic=(False, True)),
    dp.Grid((3, 4, 2), size=1.0),
]


@pytest.mark.parametrize("grid", GRIDS)
def test_a_ramp_counts_the_same_everywhere(grid):
    x = grid.centres()[0]
    slope = 3.0
    volume = np.sum(grid.volumes)
    assert dp.total_variation(grid, 1e-9)(slope * x) == pytest.approx(slope * volume, rel=1e-8)
    assert dp.smoothness(grid)(slope * x) == pytest.approx(0.5 * slope**2 * volume, rel=1e-12)
    assert dp.total_variation(grid, 1.0)(5.0 + 0 * x) == 0


def by_hand(grid, u, eps, solid):
    """Return the sum over cells by loops, for unit cells in 2-D."""
    total = smooth = 0.0
    n, m = u.shape
    for i in range(n):
        for j in range(m):
            square = 0.0
            for neighbours in (((i - 1, j), (i + 1, j)), ((i, j - 1), (i, j + 1))):
                jumps = [(u[p] - u[i, j]) ** 2 for p in neighbours if 0 <= p[0] < n and 0 <= p[1] < m and not solid[p]]
                square += sum(jumps) / max(len(jumps), 1)
            if not solid[i, j]:
                total = total + np.sqrt(square + eps**2) - eps
                smooth = smooth + 0.5 * square
    return total, smooth


def test_obstacles_are_excluded():
    grid = dp.Grid((5, 4))
    rng = np.random.default_rng(0)
    solid = np.zeros(grid.shape, bool)
    solid[1:3, 2] = solid[4, 0] = True
    u = rng.standard_normal(grid.shape)
    tv = dp.total_variation(grid, 0.1, solid)
    h1 = dp.smoothness(grid, solid)
    assert (tv(u), h1(u)) == pytest.approx(by_hand(grid, u, 0.1, solid), rel=1e-13)
    other = np.where(solid, 1e6, u)
    assert (tv(other), h1(other)) == pytest.approx((tv(u), h1(u)), rel=1e-12)
    solid[:] = True
    assert dp.smoothness(grid, solid)(u) == 0


@pytest.mark.parametrize("make", [lambda grid: dp.total_variation(grid, 5.0), dp.smoothness])
@pytest.mark.parametrize("grid", GRIDS[1:])
def test_derivatives(grid, make):
    term = make(grid)
    u = np.random.default_rng(0).standard_normal(grid.shape)
    report = dp.check.gradient(lambda u: term(u) + anp.sum(u**2), u)  # of a constant it sees rounding alone
    assert report.verdict == "agrees" and report.hessian == "agrees"


def test_refused_numbers():
    for eps in (0.0, -1.0, np.nan, np.inf, "1"):
        with pytest.raises(ValueError, match="total_variation needs eps > 0, a slope that counts as small, got"):
            dp.total_variation(GRIDS[0], eps)
    with pytest.raises(TypeError, match="smoothness takes a Grid"):
        dp.smoothness(3)


@pytest.mark.parametrize("exponent", [-480, -200, 200, 480])
@pytest.mark.parametrize("share", [2.0**-30, 1.0, 2.0**30])
def test_total_variation_of_slopes_of_any_magnitude(exponent, share, rng):
    """It scales with the slopes and eps, also where squares of slopes underflow or overflow."""
    grid = dp.Grid((5, 4), size=1.0)
    factor = 2.0**exponent
    u, v = share * rng.normal(size=(2, *grid.shape))
    tv = dp.total_variation(grid, 1e-3)
    scaled = dp.total_variation(grid, 1e-3 * factor)
    assert scaled(factor * u) == factor * tv(u)
    assert np.array_equal(dp.grad(scaled)(factor * u), dp.grad(tv)(u))
    assert np.allclose(dp.hvp(scaled, factor * u, factor * v), dp.hvp(tv, u, v), rtol=1e-12, atol=0)


def test_total_variation_of_slopes_far_from_eps(rng):
    """For slopes far above eps it is their integral, far below the integral of their squares over 2 eps."""
    grid = dp.Grid((5, 4), size=1.0)
    u = rng.normal(size=grid.shape)
    steep = dp.total_variation(grid, 1.0)(1e200 * u)
    assert np.isclose(steep, 1e200 * dp.total_variation(grid, 1e-14)(u), rtol=1e-12)
    flat = dp.total_variation(grid, 1e-140)(1e-170 * u)
    assert np.isclose(flat, 1e-200 * dp.smoothness(grid)(u), rtol=1e-12)


# ---- admm ----


def test_admm_soft_thresholds():
    """|x - y|^2 / 2 + weight |x|_1 has its minimum at the soft threshold of y."""
    y = np.array([3.0, -0.2, 0.5, -2.0, 0.0])
    best = dp.minimize(lambda x: 0.5 * anp.sum((x - y) ** 2), 0 * y, "admm", tolerance=1e-9, weight=0.5)
    np.testing.assert_allclose(best.x, np.sign(y) * np.maximum(abs(y) - 0.5, 0), atol=1e-7)
    assert best.converged and best.method == "admm" and "both residuals" in str(best)
    assert best.value == pytest.approx(0.5 * np.sum((best.x - y) ** 2) + 0.5 * np.sum(np.abs(best.x)), rel=1e-9)


@pytest.mark.parametrize("inner", [10, "exact"])
def test_admm_is_optimal_for_jumps(inner):
    """Subgradient: K^T s = -grad / weight with |s| <= 1, and s = sign(K x) where K x is not 0."""
    n = 12 if inner == 10 else 40
    grid = dp.Grid(n)
    rng = np.random.default_rng(0)
    G = dp.interior(grid) @ dp.gradient(grid)
    y = np.where(grid.centres()[0] < n / 3, 1.0, -0.5) + 0.1 * rng.standard_normal(n)
    if inner == "exact":
        one = np.eye(n)
        matrix = G.matrix.toarray()
        inner = lambda target, rho, x: np.linalg.solve(one + rho * matrix.T @ matrix, y + rho * matrix.T @ target)
    loss = lambda x: 0.5 * anp.sum((x - y) ** 2)
    tolerance = 1e-5 if inner == 10 else 1e-7
    best = dp.minimize(loss, 0 * y, "admm", maxiter=2000, tolerance=tolerance, weight=0.3, operator=G, inner=inner)
    assert best.converged
    s = np.cumsum(best.x - y) / 0.3  # on the inner faces
    jumps = G(best.x)[1:-1]
    assert np.max(np.abs(s)) < 1 + 1e-3
    steep = np.abs(jumps) > 1e-4
    assert 1 <= np.count_nonzero(steep) < 6
    np.testing.assert_allclose(s[:-1][steep], np.sign(jumps[steep]), atol=1e-2)


def test_admm_with_bounds_and_with_another_prox():
    y = np.array([3.0, -0.2, 0.5, -2.0])
    loss = lambda x: 0.5 * anp.sum((x - y) ** 2)
    best = dp.minimize(loss, 0 * y, "admm", tolerance=1e-8, weight=0.1, bounds=(0.0, 2.0))
    np.testing.assert_allclose(best.x, [2.0, 0.0, 0.4, 0.0], atol=1e-5)
    best = dp.minimize(loss, 0 * y, "admm", tolerance=1e-8, weight=0.1, prox=lambda v, t: np.maximum(v, 0))
    np.testing.assert_allclose(best.x, np.maximum(y, 0), atol=1e-6)


@pytest.mark.whole
def test_admm_of_complex_unknowns(rng):
    """At the minimum the gradient is -weight x / |x|, and of magnitude <= weight where x is 0."""
    matrix = rng.normal(size=(6, 5)) + 1j * rng.normal(size=(6, 5))
    data = rng.normal(size=6) + 1j * rng.normal(size=6)
    for weight in (1.0, 12.0):
        best = dp.minimize(
            lambda x: 0.5 * anp.sum(anp.abs(anp.dot(matrix, x) - data) ** 2),
            np.zeros(5, complex),
            "admm",
            weight=weight,
            tolerance=1e-6,
            maxiter=500,
        )
        slope = matrix.conj().T @ (matrix @ best.x - data)
        zero = np.abs(best.x) < 1e-6
        assert best.converged
        assert np.allclose(slope[~zero], -weight * (best.x / np.abs(best.x))[~zero], atol=1e-5)
        assert np.all(np.abs(slope[zero]) <= weight * (1 + 1e-6))


def test_admm_of_a_complex_operator(rng):
    """The transpose of a complex operator needs conjugates; this one changes phases and no magnitudes."""
    phases = np.exp(1j * rng.uniform(0, 6, 5))
    goal = rng.normal(size=5) + 1j * rng.normal(size=5)
    misfit = lambda x: 0.5 * anp.sum(anp.abs(x - goal) ** 2)
    turned = dp.minimize(
        misfit, np.zeros(5, complex), "admm", weight=0.5, tolerance=1e-9, maxiter=500, operator=lambda x: phases * x
    )
    size = np.abs(goal)
    assert turned.converged and np.allclose(turned.x, goal / size * np.maximum(size - 0.5, 0.0), atol=1e-7)


def test_admm_converges_to_zero():
    """K x and z both go to 0, but their difference relative to their size does not."""
    best = dp.minimize(lambda x: 0.5 * anp.sum((x - 1.0) ** 2), np.full(3, 5.0), "admm", weight=3.0, tolerance=1e-6)
    assert best.converged and np.allclose(best.x, 0.0, atol=1e-6)


@pytest.mark.parametrize("size", [1e-170, 1e170])
def test_admm_refuses_a_penalty_that_is_no_float(size):
    with pytest.raises(ValueError, match="rho of admm, the weight divided by the size of K x"):
        dp.minimize(lambda x: anp.sum((x / size - 1.0) ** 2), np.full(2, size), "admm", weight=1.0 / size)


def test_admm_stops_at_maxiter_and_by_its_callback():
    loss = lambda x: anp.sum((x - 1) ** 2)
    seen = []
    best = dp.minimize(loss, np.zeros(3), "admm", maxiter=3, tolerance=0.0, weight=0.1)
    assert len(best.history) == 4 and best.message == "stopped after 3 iterations, the limit maxiter"
    call = lambda record, x: seen.append(record) or len(seen) == 2
    best = dp.minimize(loss, np.zeros(3), "admm", tolerance=0.0, callback=call, weight=0.1)
    assert len(best.history) == 3 and best.message == "stopped by the callback"


def test_an_interrupted_round_of_admm_ends_the_run():
    """The interrupted inner minimization returns its best point; the iterations must end too."""
    calls = []

    def loss(x):
        calls.append(1)
        if len(calls) == 40:
            raise KeyboardInterrupt
        return anp.sum((x[1:] - x[:-1] - 1.0) ** 4) + anp.sum(x**2)

    best = dp.minimize(loss, np.ones(3), "admm", maxiter=50, tolerance=0.0, weight=0.1)
    assert len(calls) == 40 and best.message == "interrupted" and not best.converged
    assert 1 <= best.history[-1].iteration < 49 and best.value == best.history[-1].value


def test_admm_refuses():
    loss = lambda x: anp.sum(x**2)
    with pytest.raises(ValueError, match="weight of admm must be > 0, got -1"):
        dp.minimize(loss, np.ones(2), "admm", weight=-1)
    with pytest.raises(TypeError, match="admm has no option 'weights'; it has weight, operator, rho, inner, prox"):
        dp.minimize(loss, np.ones(2), "admm", weights=1)
    with pytest.raises(TypeError, match="admm does not use batches; leave it out"):
        dp.minimize(loss, np.ones(2), "admm", batches=[1], weight=1.0)
    with pytest.raises(TypeError, match="weight"):
        dp.minimize(loss, np.ones(2), "admm")


@pytest.mark.parametrize("scale", [1e-3, 1e-9, 1e-100])
def test_total_variation_of_small_slopes_is_accurate(scale):
    """Slopes far below eps enter by their square."""
    u = np.random.default_rng(0).standard_normal(GRIDS[1].shape)
    tv = dp.total_variation(GRIDS[1], 1.0)
    h1 = dp.smoothness(GRIDS[1])
    assert tv(scale * u) == pytest.approx(h1(scale * u), rel=50 * scale**2 + 1e-13, abs=0)


def test_refused_regularization():
    for eps in (1e-170, 1e170):
        with pytest.raises(ValueError, match="total_variation needs eps > 0, a slope that counts as small"):
            dp.total_variation(GRIDS[0], eps)
    for term in (dp.total_variation(GRIDS[0], 1.0), dp.smoothness(GRIDS[0])):
        with pytest.raises(TypeError, match="must hold real numbers, got dtype complex128; add the values of u.real"):
            term(np.ones(7, complex))


def test_values_of_admm_with_another_prox_are_those_of_the_loss():
    loss = lambda x: 0.5 * anp.sum((x - 3.0) ** 2)
    best = dp.minimize(loss, np.ones(4), "admm", weight=1.0, prox=lambda v, t: v / (1 + 2 * t))
    assert best.x == pytest.approx(np.ones(4), rel=1e-3) and best.value == loss(best.x)


def test_admm_refuses_bounds_beside_a_user_defined_inner_step():
    inner = lambda target, rho, x: (3.0 + rho * target) / (1 + rho)
    with pytest.raises(TypeError, match="admm with a function as inner does not use bounds; leave them out, or apply"):
        dp.minimize(lambda x: 0.5 * anp.sum((x - 3.0) ** 2), np.ones(4), "admm", weight=1.0, inner=inner, bounds=(0, 1))
