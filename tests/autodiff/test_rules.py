"""Rules of the catalogue: values, Taylor rates of order 1 to 3, edges, an autograd twin."""

import autograd.numpy as anp
import numpy as np
import pytest
from catalogue import RULES, SHAPES, grids

import sparsedp as dp
from sparsedp.autodiff.derivative import pullback, pushforward, value_and_grad


@pytest.mark.parametrize(("name", "builder"), RULES)
def test_derivatives(name, builder):
    """JVP against central differences, VJP against JVP, Hessian products against differences of gradients."""
    rng = np.random.default_rng(0)
    for shape in SHAPES:
        for grid in grids(shape, rng):
            rule = builder(grid)
            k = rng.uniform(0.5, 2, shape)
            dk = rng.standard_normal(shape)
            value, tangent = pushforward(rule, k, dk)
            assert value.shape == grid.faces.shape
            difference = (rule(k + 1e-5 * dk) - rule(k - 1e-5 * dk)) / 2e-5
            np.testing.assert_allclose(tangent, difference, rtol=1e-8, atol=1e-8)
            g = rng.standard_normal(grid.faces.size)
            np.testing.assert_allclose(
                np.sum(pullback(rule, k)[1](g) * dk), np.sum(g * tangent), rtol=1e-12, atol=1e-12
            )
            slope = value_and_grad(lambda k, rule=rule: anp.sum(rule(k) ** 3))
            product = pushforward(lambda k, slope=slope: slope(k)[1], k, dk)[1]
            wanted = (slope(k + 1e-5 * dk)[1] - slope(k - 1e-5 * dk)[1]) / 2e-5
            np.testing.assert_allclose(product, wanted, rtol=1e-7, atol=1e-7)


def test_harmonic_average_is_two_layers_in_series():
    grid = dp.Grid(2, spacing=np.array([1.0, 3.0]))
    average = dp.harmonic_average(grid)
    np.testing.assert_allclose(average(np.array([2.0, 6.0])), [2.0, 4.0 / (1.0 / 2.0 + 3.0 / 6.0), 6.0])
    np.testing.assert_array_equal(average(np.array([0.0, 6.0])), [0.0, 0.0, 6.0])


@pytest.mark.parametrize("k", [[0.0, 3.0], [3.0, 0.0], [0.0, 0.0], [1e-300, 1e300], [1e200, 1e-200]])
def test_harmonic_average_has_finite_derivatives_at_the_edges(k):
    k = np.array(k)
    average = dp.harmonic_average(dp.Grid(2))
    gradient = value_and_grad(lambda k: average(k)[1])(k)[1]
    small = np.min(k) / np.max(k) if np.max(k) else 1.0
    share = lambda ratio: 0.5 / (0.5 + 0.5 * ratio) ** 2  # d/dk_l at k_l / k_r = ratio
    wanted = (
        [share(1.0)] * 2
        if k[0] == k[1]
        else [share(small), share(np.inf)]
        if k[0] < k[1]
        else [share(np.inf), share(small)]
    )
    np.testing.assert_allclose(gradient, wanted, rtol=1e-12)


def test_harmonic_average_matches_its_autograd_twin():
    grid = dp.Grid((3, 4), periodic=(True, False))
    k = np.random.default_rng(1).uniform(0.1, 5, grid.shape)

    def twin(k):
        x = 2 / (1 / k + 1 / anp.roll(k, 1, 0))
        y = 2 / (1 / k[:, 1:] + 1 / k[:, :-1])
        return grid.join(x, anp.concatenate([k[:, :1], y, k[:, -1:]], axis=1))

    weights = np.arange(grid.faces.size)
    ours = value_and_grad(lambda k: anp.sum(weights * dp.harmonic_average(grid)(k)))(k)
    theirs = value_and_grad(lambda k: anp.sum(weights * twin(k)))(k)
    np.testing.assert_allclose(ours[0], theirs[0], rtol=1e-14)
    np.testing.assert_allclose(ours[1], theirs[1], rtol=1e-13)
