"""Grid, Space and boundary conditions: shapes, volumes, split and join, values and refusals."""

import pickle

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.derivative import value_and_grad


@pytest.mark.parametrize(
    ("shape", "periodic", "faces", "nodes", "edges"),
    [
        ((4,), False, 5, (5,), 4),
        ((4,), True, 4, (4,), 4),
        ((3, 2), False, 4 * 2 + 3 * 3, (4, 3), 3 * 3 + 4 * 2),
        ((3, 2), (True, False), 3 * 2 + 3 * 3, (3, 3), 3 * 3 + 3 * 2),
        ((2, 3, 4), False, 3 * 12 + 2 * 16 + 6 * 5, (3, 4, 5), 2 * 20 + 3 * 3 * 5 + 3 * 4 * 4),
        ((0,), False, 1, (1,), 0),
        ((0, 3), True, 0, (0, 3), 0),
    ],
)
def test_spaces(shape, periodic, faces, nodes, edges):
    grid = dp.Grid(shape, periodic=periodic)
    assert (grid.cells.shape, grid.faces.shape, grid.nodes.shape, grid.edges.shape) == (
        shape,
        (faces,),
        nodes,
        (edges,),
    )
    assert grid.volumes.shape == shape and not grid.volumes.flags.writeable


@pytest.mark.parametrize("periodic", [False, True, (True, False)])
def test_volumes_fill_the_box(periodic):
    rng = np.random.default_rng(0)
    grid = dp.Grid((4, 5), spacing=[rng.random(4) + 0.1, rng.random(5) + 0.1], periodic=periodic)
    box = np.prod(grid.size)
    np.testing.assert_allclose([grid.volumes.sum(), grid.nodes.volumes.sum()], box)
    np.testing.assert_allclose([v.sum() for v in grid.faces.split(grid.faces.volumes)], [box, box])
    np.testing.assert_allclose([v.sum() for v in grid.edges.split(grid.edges.volumes)], [box, box])


def test_coordinates():
    grid = dp.Grid((2, 3), spacing=[np.array([1.0, 3.0]), 2.0], origin=(10.0, 0.0))
    x, y = grid.centres()
    np.testing.assert_array_equal(x[:, 0], [10.5, 12.5])
    np.testing.assert_array_equal(y[0], [1, 3, 5])
    x, y = grid.face_centres("y")
    assert x.shape == grid.face_shape(1) == (2, 4)
    np.testing.assert_array_equal(y[1], [0, 2, 4, 6])
    (line,) = dp.Grid(3).centres()
    assert line.shape == (3,)
    np.testing.assert_array_equal(dp.Grid(3, periodic=True).face_centres(0)[0], [0, 1, 2])
    np.testing.assert_array_equal(dp.Grid(2, size=1.0).coordinates(0, "nodes"), [0, 0.5, 1])


def test_split_and_join_are_inverse_and_differentiable():
    for grid in (dp.Grid(4), dp.Grid((3, 2)), dp.Grid((2, 3, 4), periodic=(False, True, False))):
        for space in (grid.faces, grid.edges):
            v = np.random.default_rng(1).standard_normal(space.size)
            np.testing.assert_array_equal(space.join(*space.split(v)), v)
            weights = np.arange(space.size)
            loss = lambda v, s=space, w=weights: anp.sum(w * s.join(*(p**2 for p in s.split(v))))
            np.testing.assert_allclose(value_and_grad(loss)(v)[1], 2 * weights * v)


def test_join_takes_broadcast_and_read_only_arrays():
    grid = dp.Grid((3, 2))
    x_faces = np.broadcast_to(np.arange(2.0), (4, 2))
    v = grid.join(x_faces, 7.0)
    np.testing.assert_array_equal(v, [0, 1] * 4 + [7] * 9)
    slope = value_and_grad(lambda a: anp.sum(grid.join(a, a)))(2.0)[1]
    assert slope == 17.0
    three = dp.Grid((2, 2, 2))
    assert [part.shape for part in three.split(np.zeros(three.edges.size))] == list(three.edges.parts)


def test_equal_by_value_hashable_and_picklable():
    one, other = (dp.Grid((2, 3), spacing=[np.array([1.0, 2.0]), 0.5], periodic=(False, True)) for _ in range(2))
    assert one == other and hash(one) == hash(other) and one.faces == other.faces and one.cells != one.nodes
    assert one != dp.Grid((2, 3)) and one.faces != other.edges and one != 3 and one.cells != 3
    again = pickle.loads(pickle.dumps(one))
    assert again == one and again.faces == one.faces
    assert pickle.loads(pickle.dumps(dp.robin(1, 2))) == dp.robin(1, 2) != dp.dirichlet
    used = dp.laplacian(one)
    used.T(used(np.ones((2, 3))))
    op = pickle.loads(pickle.dumps(used))
    np.testing.assert_array_equal(op(np.ones((2, 3))), dp.laplacian(one)(np.ones((2, 3))))


def test_prints_itself():
    assert repr(dp.Grid((4, 3), size=(2, 3))) == "Grid(4 x 3 cells, size 2 x 3)"
    grid = dp.Grid(2, spacing=np.array([1.0, 2.0]), origin=1.0)
    assert str(grid) == "Grid(2 cells, size 3, origin 1, stretched in x)"
    assert str(dp.Grid((2, 2), periodic=(False, True))) == "Grid(2 x 2 cells, size 2 x 2, periodic in y)"
    assert str(grid.faces) == "faces(2)" and str(dp.Space((2, 3))) == "space(2, 3)"
    assert repr(dp.robin(2, 3)) == "robin(2, 3)" and repr(dp.robin(0, 1)) == "neumann"


def test_volumes_that_overflow_are_refused():
    with pytest.raises(
        dp.errors.NonFiniteError,
        match="volumes of a grid must be finite, got .*; its spacing is too large, rescale its lengths",
    ):
        dp.Grid((2, 2, 2), spacing=2.0**450).volumes


def test_one_component_of_faces_has_its_volumes():
    grid = dp.Grid((9, 8), spacing=0.5)
    for axis, volumes in enumerate(grid.split(grid.faces.volumes)):
        assert np.array_equal(dp.component(grid, axis).codomain.volumes, volumes)
