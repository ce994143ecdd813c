"""4D-Var of a linear model beside the Kalman smoother, computed with dense matrices."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

N = 12
STEPS = 3
NOISE = 0.2
RING = dp.Grid(N, size=1.0, periodic=True)
HELMHOLTZ = dp.identity(RING.cells) - 0.02 * dp.laplacian(RING)
ROOTS = {"start": dp.matrix_power(HELMHOLTZ, -1.0), "pushes": 0.3 * dp.matrix_power(HELMHOLTZ, -0.5)}
COVARIANCES = {name: root @ root for name, root in ROOTS.items()}
SENSORS = dp.sample(RING, np.array([[0.1], [0.35], [0.8]]))
MOVE = dp.transport(RING, "upwind")
SPREAD = dp.matrix_exponential(dp.laplacian(RING), 2e-3)


def step(state, params, push):
    return SPREAD(MOVE(state, np.ones(N), 0.05)) + push


def states(x):
    return dp.rollout(step, x["start"], None, STEPS, x["pushes"], keep="all")


def dense(op):
    return op.to_scipy() @ np.eye(op.shape[1])


def smoother(background, data, push_covariance):
    """Return the means of all states, and the covariance of the first one (Rauch, Tung and Striebel)."""
    model = np.array([step(unit, None, np.zeros(N)) for unit in np.eye(N)]).T
    H = dense(SENSORS)
    mean = background
    covariance = dense(COVARIANCES["start"])
    predicted = []
    filtered = [(mean, covariance)]
    for readings in data:
        mean = model @ mean
        covariance = model @ covariance @ model.T + push_covariance
        predicted.append((mean, covariance))
        gain = covariance @ H.T @ np.linalg.inv(H @ covariance @ H.T + NOISE**2 * np.eye(len(H)))
        mean = mean + gain @ (readings - H @ mean)
        covariance = covariance - gain @ H @ covariance
        filtered.append((mean, covariance))
    means = [mean]
    for (mean_before, covariance_before), (mean_after, covariance_after) in zip(filtered[-2::-1], predicted[::-1]):
        gain = covariance_before @ model.T @ np.linalg.inv(covariance_after)
        mean = mean_before + gain @ (mean - mean_after)
        covariance = covariance_before + gain @ (covariance - covariance_after) @ gain.T
        means.append(mean)
    return np.array(means[::-1]), covariance


@pytest.fixture
def scene(rng):
    """The background, and the data of a truth whose model has errors."""
    background = np.sin(2 * np.pi * RING.centres()[0])
    whitened = {"start": rng.standard_normal(N), "pushes": rng.standard_normal((STEPS, N))}
    errors = {name: ROOTS[name](z) for name, z in whitened.items()}
    truth = states({"start": background + errors["start"], "pushes": errors["pushes"]})
    return background, SENSORS(truth[1:]) + NOISE * rng.standard_normal((STEPS, 3))


def misfit(x, data):
    return anp.reshape((SENSORS(states(x)[1:]) - data) / NOISE, (-1,))


@pytest.mark.whole
def test_the_weak_constraint_is_the_kalman_smoother(scene):
    background, data = scene
    means, covariance = smoother(background, data, dense(COVARIANCES["pushes"]))

    def field(z):
        return {"start": background + ROOTS["start"](z["start"]), "pushes": ROOTS["pushes"](z["pushes"])}

    def residuals(z):
        return anp.concatenate([misfit(field(z), data), z["start"], anp.reshape(z["pushes"], (-1,))])

    start = {"start": np.zeros(N), "pushes": np.zeros((STEPS, N))}
    for options in ({"maxiter": 1}, {"dense": False, "accuracy": 0.1, "tolerance": 1e-9}):
        best = dp.minimize(residuals, start, "gauss_newton", **options)
        assert np.allclose(states(field(best.x)), means, atol=1e-7)
    posterior = dp.laplace(lambda z: misfit(field(z), data), best.x, prior=1.0)
    deviation = posterior.std_of(lambda z: field(z)["start"][4])
    assert deviation == pytest.approx(np.sqrt(covariance[4, 4]), rel=1e-6)


@pytest.mark.whole
@pytest.mark.parametrize("method", ["lbfgs", "newton_cg"])
def test_the_precision_as_metric(scene, method):
    """A metric for each leaf; the pushes of all steps have the same one."""
    background, data = scene
    means, _ = smoother(background, data, dense(COVARIANCES["pushes"]))
    precisions = {name: dp.inverse(covariance) for name, covariance in COVARIANCES.items()}

    def cost(x):
        deviation = x["start"] - background
        prior = anp.sum(deviation * precisions["start"](deviation))
        prior = prior + anp.sum(x["pushes"] * precisions["pushes"](x["pushes"]))
        return 0.5 * prior + 0.5 * anp.sum(misfit(x, data) ** 2)

    start = {"start": background, "pushes": np.zeros((STEPS, N))}
    best = dp.minimize(cost, start, method, tolerance=1e-8, metric=precisions)
    assert best.converged and np.allclose(states(best.x), means, atol=1e-6)


@pytest.mark.whole
def test_the_strong_constraint_is_the_best_linear_estimate(scene):
    background, data = scene
    none = np.zeros((STEPS, N))
    best = dp.minimize(
        lambda z: anp.concatenate([misfit({"start": background + ROOTS["start"](z), "pushes": none}, data), z]),
        np.zeros(N),
        "gauss_newton",
        maxiter=1,
    )
    readings = lambda x: anp.reshape(SENSORS(states({"start": x, "pushes": none})[1:]), (-1,))
    G = np.array([readings(unit) for unit in np.eye(N)]).T
    B = dense(COVARIANCES["start"])
    gain = B @ G.T @ np.linalg.inv(G @ B @ G.T + NOISE**2 * np.eye(len(G)))
    expected = background + gain @ (np.ravel(data) - G @ background)
    assert np.allclose(background + ROOTS["start"](best.x), expected)
    assert np.allclose(expected, smoother(background, data, 0.0)[0][0])


def test_a_covariance_by_its_root():
    """Transforms solve with root @ root.T if the root is symmetric. On a stretched grid it is not."""
    stretched = dp.Grid(5, spacing=np.array([1.0, 2.0, 1.0, 3.0, 1.0]))
    for grid, method in ((RING, "separable"), (stretched, "krylov")):
        root = dp.matrix_power(dp.identity(grid.cells) - 0.02 * dp.laplacian(grid), -1.5)
        precision = dp.inverse(2.0 * root @ root.T)
        assert precision.method == method
        b = np.cos(np.arange(float(grid.cells.size)))
        assert np.allclose(precision(b), np.linalg.solve(2.0 * dense(root) @ dense(root).T, b))
