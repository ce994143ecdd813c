"""Pictures: axis 0 is x, lengths are to scale, and what cannot be drawn is refused in one sentence."""

import io
import re
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

import sparsedp as dp

pytest.importorskip("matplotlib")

from sparsedp.report import plots


@pytest.fixture
def ax():
    return plots.figure().add_subplot()


def mesh(ax):
    """The numbers of the map in a picture, as an array [row along y, column along x]."""
    return ax.collections[0].get_array()


def drawn(ax):
    """The picture as it is written."""
    with tempfile.TemporaryDirectory() as folder:
        plots.write_picture(Path(folder, "a.png"), lambda _: ax)
        return Path(folder, "a.png").read_bytes()


def test_axis_0_is_x(ax):
    grid = dp.Grid((5, 3), size=(10.0, 3.0), origin=(1.0, 2.0))
    u = np.arange(15.0).reshape(5, 3)
    found = dp.plot(grid, u, ax=ax, title="heat", label="T [K]")
    assert found is ax
    assert np.array_equal(mesh(ax), u.T)
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.get_title()) == ("x", "y", "heat")
    assert ax.get_xlim() == (1.0, 11.0) and ax.get_ylim() == (2.0, 5.0)
    assert ax.get_aspect() == 1.0
    assert ax.child_axes[0].get_ylabel() == "T [K]"
    assert drawn(ax).startswith(b"\x89PNG")


def test_stretched_cells_are_drawn_to_scale(ax):
    grid = dp.Grid((3, 2), spacing=(np.array([1.0, 2.0, 4.0]), 1.0))
    dp.plot(grid, np.ones(grid.shape), ax=ax)
    corners = ax.collections[0].get_coordinates()
    assert np.array_equal(corners[0, :, 0], [0.0, 1.0, 3.0, 7.0])


def test_same_limits_for_two_pictures(ax):
    grid = dp.Grid((4, 4))
    dp.plot(grid, np.zeros(grid.shape), ax=ax, limits=(-1.0, 2.0))
    assert ax.collections[0].get_clim() == (-1.0, 2.0)


def test_holes_do_not_spoil_the_colours(ax):
    u = np.array([[1.0, np.nan], [3.0, 2.0]])
    dp.plot(dp.Grid((2, 2)), u, ax=ax)
    assert ax.collections[0].get_clim() == (1.0, 3.0)


@pytest.mark.parametrize("periodic", [False, True])
def test_line(ax, periodic):
    grid = dp.Grid(4, size=2.0, periodic=periodic)
    dp.plot(grid, np.arange(4.0), ax=ax, label="u")
    x, y = ax.lines[0].get_data()
    assert np.array_equal(x, [0.25, 0.75, 1.25, 1.75]) and np.array_equal(y, np.arange(4.0))
    assert ax.get_ylabel() == "u"


def test_line_of_faces(ax):
    grid = dp.Grid(2)
    dp.plot(grid, np.arange(3.0), ax=ax)
    assert np.array_equal(ax.lines[0].get_xdata(), [0.0, 1.0, 2.0])


@pytest.mark.parametrize("periodic", [False, True])
def test_face_field_is_drawn_at_the_centres(ax, periodic):
    grid = dp.Grid((4, 3), periodic=periodic)
    v = grid.join(np.full(grid.face_shape(0), 3.0), np.full(grid.face_shape(1), 4.0))
    dp.plot(grid, v, ax=ax)
    assert np.allclose(mesh(ax), 5.0) and mesh(ax).shape == (3, 4)
    arrows = ax.collections[1]
    assert np.allclose(arrows.U, 3.0) and np.allclose(arrows.V, 4.0)


def test_arrows_are_thinned(ax):
    grid = dp.Grid((200, 60))
    dp.plot(grid, np.ones(grid.faces.size), ax=ax)
    assert ax.collections[1].U.size <= plots.MOST_ARROWS**2


def test_periodic_faces_are_averaged_round_the_end(ax):
    grid = dp.Grid((3, 1), periodic=True)
    dp.plot(grid, grid.join(np.array([[1.0], [2.0], [4.0]]), np.zeros((3, 1))), ax=ax)
    assert np.allclose(mesh(ax), [[1.5, 3.0, 2.5]])


def test_node_field(ax):
    grid = dp.Grid((3, 2))
    u = np.arange(12.0).reshape(4, 3)
    dp.plot(grid, u, ax=ax)
    assert np.array_equal(mesh(ax), u.T)


def test_the_place_can_be_named(ax):
    grid = dp.Grid((3, 2), periodic=True)  # cells and nodes have one shape
    dp.plot(grid, np.zeros((3, 2)), ax=ax, at="nodes")
    corners = ax.collections[0].get_coordinates()
    assert corners[0, 0, 0] == -0.5  # node 0 is in the middle of its patch


@pytest.mark.whole
@pytest.mark.parametrize(
    "kind", ["faces", *(pytest.param(kind, marks=pytest.mark.whole) for kind in ("cells", "nodes"))]
)
def test_three_middle_slices(ax, kind):
    grid = dp.Grid((4, 3, 2))
    dp.plot(grid, np.ones(getattr(grid, kind).shape), ax=ax, title="box")
    titles = [child.get_title() for child in ax.child_axes[:3]]
    assert [title[0] for title in titles] == ["z", "y", "x"]
    assert drawn(ax)


def test_one_cell(ax):
    dp.plot(dp.Grid((1, 1)), np.ones((1, 1)), ax=ax)
    assert drawn(ax)


def test_without_axes_pyplot_is_used():
    pyplot = pytest.importorskip("matplotlib.pyplot")
    found = dp.plot(dp.Grid((2, 2)), np.eye(2))
    assert found is pyplot.gca()
    pyplot.close("all")


def test_a_second_picture_gets_a_new_figure():
    pyplot = pytest.importorskip("matplotlib.pyplot")
    for grid in (dp.Grid(3), dp.Grid((2, 2)), dp.Grid((2, 2, 2))):
        figure, empty_axes = pyplot.subplots()
        one, other = (dp.plot(grid, np.ones(grid.shape)) for _ in range(2))
        assert one is empty_axes and other.figure is not figure and other is pyplot.gca()
        assert len(one.lines) + len(one.collections) + len(one.child_axes) <= 4
    pyplot.close("all")


@pytest.mark.parametrize(
    "shape", [(8, 2), pytest.param((2, 8), marks=pytest.mark.whole), pytest.param((2, 3, 4), marks=pytest.mark.whole)]
)
def test_the_labels_of_the_colour_bar_are_inside_the_figure(shape):
    """On axes of the user, in figures without a layout engine, and on axes that plot makes."""
    pyplot = pytest.importorskip("matplotlib.pyplot")
    grid = dp.Grid(shape)
    u = np.linspace(-1.0, 1.0, grid.cells.size).reshape(shape)
    for ax in (pyplot.subplots()[1], pyplot.subplots(1, 2, figsize=(9, 4))[1][1], None):
        figure = dp.plot(grid, u, ax, label="T [K]").figure
        figure.canvas.draw()
        bounds = figure.get_tightbbox()
        assert bounds.x0 >= 0 and bounds.x1 <= figure.get_figwidth(), (bounds, figure.get_figwidth())
    pyplot.close("all")


def test_a_path_in_place_of_axes_is_refused(tmp_path):
    with pytest.raises(
        TypeError,
        match=re.escape(
            "ax must be matplotlib Axes, got the path 'a.png'; write dp.plot(grid, u).figure.savefig('a.png')"
        ),
    ):
        dp.plot(dp.Grid(2), np.ones(2), "a.png")
    with pytest.raises(TypeError, match="ax must be matplotlib Axes, got the path '.*'; write .*savefig"):
        dp.plot(dp.Grid(2), np.ones(2), tmp_path / "a.png")
    with pytest.raises(TypeError, match="ax takes matplotlib Axes, got Figure; write ax=figure.add_subplot"):
        dp.plot(dp.Grid(2), np.ones(2), plots.figure())


def test_input_is_not_modified(ax):
    grid = dp.Grid((3, 3))
    u = np.random.default_rng(0).random((3, 3))
    u.flags.writeable = False
    dp.plot(grid, u, ax=ax)


def test_traced_fields_can_be_drawn(ax):
    grid = dp.Grid((2, 2))

    def loss(u):
        dp.plot(grid, u, ax=ax)
        return (u**2).sum()

    assert np.array_equal(dp.value_and_grad(loss)(np.eye(2))[1], 2 * np.eye(2))


def test_curves_mark_the_best_so_far(ax):
    plots.curves({"a": [(1.0, 3.0), (4.0, 1.0)], "b": [(2.0, 2.0), (3.0, 5.0)]}, ax, "s", "error")
    x, y = ax.lines[0].get_data()
    assert np.array_equal(x, [1.0, 2.0, 4.0]) and np.array_equal(y, [3.0, 2.0, 1.0])


@pytest.mark.whole
def test_labels_of_a_narrow_audit_do_not_overlap():
    """Beside two others, as in examples/audit.py."""
    picture = plots.figure()
    picture.set_size_inches(13, 3.8)
    ax = picture.subplots(1, 3)[0]
    dp.v_curve(dp.check.gradient(lambda u: np.sum(u**3), np.ones(3), gradient=lambda u: 3 * u**2), ax)
    picture.canvas.draw()
    low, high = ax.get_xlim()
    labels = [label for label, place in zip(ax.get_xticklabels(), ax.get_xticks()) if low <= place <= high]
    boxes = [label.get_window_extent() for label in labels]
    assert len(boxes) >= 3 and all(left.x1 + 2 < right.x0 for left, right in zip(boxes, boxes[1:]))


def test_an_audit_names_no_curve_that_is_not_drawn(ax):
    """Where difference and gradient are equal in all digits at every step, a logarithmic axis has no point."""
    audit = dp.check.gradient(lambda u: u[0] + 0.0 * u[1], np.zeros(2), gradient=lambda u: np.array([1.0, 0.0]))
    drawn = [name for name, points in audit.curves()[0].items() if any(gap > 0 for _, gap in points)]
    dp.v_curve(audit, ax)
    assert len(drawn) < len(audit.lines)
    assert [line.get_label() for line in ax.lines] == drawn
    assert (ax.get_legend() is None) == (not drawn)


def test_wrong_shape(ax):
    with pytest.raises(
        dp.errors.ShapeError,
        match=r"plot takes a field on the cells, faces or nodes of Grid\(2 x 3 .*\), got an array of shape \(5,\)",
    ):
        dp.plot(dp.Grid((2, 3)), np.zeros(5), ax=ax)
    with pytest.raises(dp.errors.ShapeError, match="plot takes a field on the nodes of "):
        dp.plot(dp.Grid((2, 3)), np.zeros((2, 3)), ax=ax, at="nodes")
    with pytest.raises(dp.errors.ShapeError, match="got an array of shape"):
        dp.plot(dp.Grid((2, 3)), np.zeros((3, 2)), ax=ax)


def test_complex(ax):
    with pytest.raises(
        TypeError,
        match="u of plot must hold real numbers, got dtype complex128; plot its real part or its absolute value",
    ):
        dp.plot(dp.Grid(3), np.zeros(3, dtype=complex), ax=ax)


def test_without_matplotlib(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(
        ImportError, match=re.escape('pictures need matplotlib; install the extra: pip install "sparsedp[plot]"')
    ):
        dp.plot(dp.Grid(3), np.zeros(3))


def test_a_film_of_a_face_field_shares_the_range_of_its_magnitude(monkeypatch):
    grid = dp.Grid((3, 3))
    seen = []
    monkeypatch.setattr(plots, "plot", lambda *args, **options: seen.append(options["limits"]))
    film = io.BytesIO()
    dp.animate(grid, [grid.join(-3.0, 4.0), grid.join(0.0, 0.0)], film)
    assert seen == [(0.0, 5.0)] * 2
    assert film.getvalue().startswith(b"GIF")
