"""Recursion over data: deep operators, deep trees and long loops work, or are refused in words."""

import copy
import pickle

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

GRID = dp.Grid((6, 5), size=1.0)
LAPLACIAN = dp.laplacian(GRID, dp.dirichlet)
WEIGHTS = dp.diagonal(GRID.cells, np.linspace(0.5, 1.0, 30).reshape(6, 5))
ONE = dp.identity(GRID.cells)


def horner(depth, base=ONE):
    """A polynomial whose products and sums are nested: each step adds two levels."""
    op = base
    for _ in range(depth):
        op = 1e-3 * (op @ LAPLACIAN @ WEIGHTS) + ONE
    return op


@pytest.mark.whole
def test_the_deepest_operators_work_in_every_way():
    op = horner(99)
    u = np.ones(GRID.shape)
    v = u
    for _ in range(99):
        v = 1e-3 * LAPLACIAN(WEIGHTS(v)) + u  # each power of the product commutes with it
    np.testing.assert_allclose(op(u), v, rtol=1e-12)
    np.testing.assert_allclose(op.matrix @ u.reshape(-1), v.reshape(-1), rtol=1e-12)
    np.testing.assert_allclose(dp.grad(lambda u: anp.sum(op(u)))(u), op.T(u), rtol=1e-12)
    for twin in (copy.deepcopy(op), copy.copy(op), pickle.loads(pickle.dumps(op))):
        assert np.array_equal(twin(u), op(u))
    assert op.name in str(op)


@pytest.mark.whole
def test_sums_and_products_of_many_operators_are_not_nested():
    many_terms = LAPLACIAN
    many_factors = ONE
    for _ in range(300):
        many_terms = many_terms + LAPLACIAN @ WEIGHTS
        many_factors = many_factors @ WEIGHTS @ LAPLACIAN * 1e-3
    u = np.ones(GRID.shape)
    np.testing.assert_allclose(many_terms(u), LAPLACIAN(u + 300 * WEIGHTS(u)), rtol=1e-10, atol=1e-6)
    assert np.all(np.isfinite(many_factors.T(u)))


@pytest.mark.whole
def test_deeper_operators_are_refused():
    with pytest.raises(
        ValueError,
        match="an operator nests sums and products of operators more than 200 deep; apply the operators one after the "
        r"other, as in v = A\(v\) \+ u, or assemble a part of it: dp.from_matrix\(part.matrix\)",
    ):
        horner(101)
    half = horner(90)
    part = dp.from_matrix(half.matrix, half.domain, half.codomain)
    assert horner(90, part)(np.ones(GRID.shape)).shape == GRID.shape


def test_a_solver_inside_an_operator_is_copied_with_it():
    inv = dp.inverse(ONE - LAPLACIAN)
    op = inv @ WEIGHTS + ONE
    twin = copy.deepcopy(op)
    inv(np.ones(GRID.shape))
    before = inv.info.forward
    twin(2.0 + np.zeros(GRID.shape))
    assert inv.info.forward is before


@pytest.mark.parametrize("kind", ["deep", "cycle"])
def test_trees_that_are_too_deep_are_refused(kind):
    tree = [np.ones(2)]
    if kind == "cycle":
        tree.append(tree)
    for _ in range(200):
        tree = [tree]
    for use in (
        lambda: dp.grad(lambda t: 1.0)(tree),
        lambda: dp.rollout(lambda t, _: t, tree, None, 2),
        lambda: dp.minimize(lambda t: 1.0, tree),
    ):
        with pytest.raises(
            ValueError, match="a tree has containers nested more than 100 deep, or one that contains itself; flatten it"
        ):
            use()


def test_a_tree_of_ninety_levels():
    tree = [np.array([3.0])]
    for _ in range(90):
        tree = [tree]

    def loss(tree):
        while isinstance(tree, list):
            tree = tree[0]
        return anp.sum(tree**2)

    slope = dp.grad(loss)(tree)
    while isinstance(slope, list):
        slope = slope[0]
    assert slope == 6.0


def test_a_loop_of_many_steps():
    """Tapes are walked through in a loop."""

    def loss(u):
        for _ in range(4000):
            u = u + 1e-4 * u
        return anp.sum(u)

    assert dp.grad(loss)(np.ones(2)) == pytest.approx(1.0001**4000)
