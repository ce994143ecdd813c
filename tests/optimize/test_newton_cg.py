"""newton_cg of minimize."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff import tape
from sparsedp.errors import UnstableStepError


def valley(x):
    return anp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)


@pytest.mark.parametrize("start", [[-1.2, 1.0], [0.5, 1.0] * 4, [0.0] * 6])
def test_newton_cg_converges(start):
    best = dp.minimize(valley, np.array(start), "newton_cg", maxiter=200)
    assert best.converged and np.allclose(best.x, 1, atol=1e-6)


@pytest.mark.parametrize("scale", [2.0**-600, 1e-9, 1e9, 2.0**600])
def test_newton_cg_is_invariant_to_the_scale_of_the_loss(scale):
    plain, scaled = (
        dp.minimize(lambda x, s=s: s * valley(x), np.array([-1.2, 1.0]), "newton_cg", maxiter=8) for s in (1.0, scale)
    )
    assert np.allclose(plain.x, scaled.x, rtol=1e-6)


def test_newton_cg_on_a_quadratic_and_past_refused_points(rng):
    matrix = rng.standard_normal((8, 8))
    matrix = matrix @ matrix.T + np.eye(8)
    best = dp.minimize(lambda x: 0.5 * anp.sum(x * (matrix @ x)) - anp.sum(x), np.zeros(8), "newton_cg", tolerance=1e-9)
    assert np.allclose(best.x, np.linalg.solve(matrix, np.ones(8))) and len(best.history) < 12

    def walled(x):
        if abs(tape.plain(x)[0]) > 1.05:
            raise UnstableStepError("beyond")
        return valley(x)

    assert np.allclose(dp.minimize(walled, np.zeros(2), "newton_cg").x, 1, atol=1e-5)


def test_newton_cg_leaves_a_saddle_point():
    best = dp.minimize(lambda x: (x[0] ** 2 - 1) ** 2 + x[1] ** 2, np.array([1e-3, 1.0]), "newton_cg")
    assert abs(best.x[0]) == pytest.approx(1) and best.value < 1e-10
