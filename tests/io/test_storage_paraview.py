"""Files for ParaView: read back by a reader of a few lines, and by VTK's own where it is installed."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest
from test_storage import GRIDS

import sparsedp as dp

pytest.importorskip("pyevtk", reason='pyevtk is not installed: python -m pip install -e ".[files]"')

FLAT = dp.Grid((4, 3), size=(0.1, 0.3), origin=(1.0, -2.0), periodic=(True, False))
BOX = dp.Grid((2, 3, 4), spacing=(0.5, [0.1, 0.2, 0.3], 1.0), periodic=(False, False, True))
TYPES = {"Int": "i", "UInt": "u", "Float": "f"}


def read(path):
    """Return the attributes of the grid in a VTK file with raw data, and {part: {name: array, components first}}."""
    text, _, data = path.read_bytes().partition(b'<AppendedData encoding="raw">\n_')
    root = ElementTree.fromstring(text + b"</VTKFile>")
    parts: dict = {"Coordinates": {}, "PointData": {}, "CellData": {}}
    for part, arrays in parts.items():
        for node in root.iterfind(f".//{part}/DataArray"):
            kind, bits = re.fullmatch(r"(\D+)(\d+)", node.get("type")).groups()
            start = int(node.get("offset"))
            size = int(np.frombuffer(data, np.uint64, 1, start)[0]) // (int(bits) // 8)
            flat = np.frombuffer(data, f"{TYPES[kind]}{int(bits) // 8}", size, start + 8)
            arrays[node.get("Name")] = flat.reshape(-1, int(node.get("NumberOfComponents"))).T
    return root[0].attrib, parts


def shaped(array, *shape):
    return array.reshape(*array.shape[:-1], *shape, order="F")[0 if len(array) == 1 else slice(None)]


def sample(grid, kind, dtype=float, *lead):
    return (4 * np.random.default_rng(1).standard_normal((*lead, *getattr(grid, kind).shape))).astype(dtype)


@pytest.mark.parametrize("suffix", [".vti", ".vtr"])
def test_numbers_of_a_flat_grid(suffix, tmp_path):
    fields = {"c": sample(FLAT, "cells"), "n": sample(FLAT, "nodes", "int32"), "v": sample(FLAT, "faces")}
    dp.save(tmp_path / f"a{suffix}", FLAT, at={"n": "nodes"}, **fields)
    about, parts = read(tmp_path / f"a{suffix}")
    assert about["WholeExtent"] == "0 4 0 3 0 1"
    h = float(FLAT.widths[0][0])
    if suffix == ".vti":
        assert list(map(float, about["Origin"].split())) == [1.0, -2.0, 0.0]
        assert list(map(float, about["Spacing"].split())) == [h, float(FLAT.widths[1][0]), h]
    else:
        lines = [parts["Coordinates"][f"{axis}_coordinates"][0] for axis in "xyz"]
        assert np.array_equal(lines[0], FLAT.coordinates(0, "ends")) and list(lines[2]) == [0.0, h]
    assert np.array_equal(shaped(parts["CellData"]["c"], 4, 3), fields["c"])
    nodes = shaped(parts["PointData"]["n"], 5, 4, 2)  # the periodic axis ends where it starts
    assert nodes.dtype == np.int32 and np.array_equal(nodes[:-1, :, 0], fields["n"])
    assert np.array_equal(nodes[-1], nodes[0]) and np.array_equal(nodes[..., 1], nodes[..., 0])
    x, y = FLAT.split(fields["v"])
    vectors = shaped(parts["CellData"]["v"], 4, 3)
    assert np.allclose(vectors[0], 0.5 * (x + np.roll(x, -1, 0)), rtol=1e-15)
    assert np.allclose(vectors[1], 0.5 * (y[:, :-1] + y[:, 1:]), rtol=1e-15) and not np.any(vectors[2])


def test_numbers_of_a_stretched_box(tmp_path):
    fields = {"v": sample(BOX, "faces", "float32"), "e": sample(BOX, "edges"), "b": sample(BOX, "cells", "uint8", 2, 2)}
    dp.save(tmp_path / "a.vtr", BOX, **fields)
    about, parts = read(tmp_path / "a.vtr")
    assert about["WholeExtent"] == "0 2 0 3 0 4"
    assert np.allclose(parts["Coordinates"]["y_coordinates"], [0.0, 0.1, 0.3, 0.6])
    for index in np.ndindex(2, 2):
        entry = shaped(parts["CellData"]["b_{}_{}".format(*index)], 2, 3, 4)
        assert entry.dtype == np.uint8 and np.array_equal(entry, fields["b"][index])
    vectors, (x, y, z) = shaped(parts["CellData"]["v"], 2, 3, 4), BOX.split(fields["v"])
    assert vectors.dtype == np.float32 and np.allclose(vectors[2], 0.5 * (z + np.roll(z, -1, 2)))
    assert np.allclose(vectors[0], 0.5 * (x[1:] + x[:-1])) and np.allclose(vectors[1], 0.5 * (y[:, 1:] + y[:, :-1]))
    vectors, (x, y, z) = shaped(parts["CellData"]["e"], 2, 3, 4), BOX.edges.split(fields["e"])
    assert np.allclose(vectors[2], 0.25 * (z[1:, 1:] + z[:-1, 1:] + z[1:, :-1] + z[:-1, :-1]))
    x = x[:, 1:] + x[:, :-1]
    assert np.allclose(vectors[0], 0.25 * (x + np.roll(x, -1, 2)))


@pytest.mark.parametrize("name", GRIDS)
def test_every_grid(name, tmp_path):
    grid = GRIDS[name]
    fields = {kind: sample(grid, kind, "int16") for kind in ("cells", "faces", "nodes", "edges")}
    dp.save(tmp_path / "a.VTR", grid, at={kind: kind for kind in fields}, **fields)
    parts = read(tmp_path / "a.VTR")[1]
    assert list(parts["CellData"]) == ["cells", "faces", "edges"] and list(parts["PointData"]) == ["nodes"]
    assert all(array.shape[1] == grid.cells.size for array in parts["CellData"].values())
    assert len(list(tmp_path.iterdir())) == 1


def test_a_series(tmp_path):
    path = tmp_path / "a & b.pvd"
    u = sample(FLAT, "cells", float, 3)
    dp.save(path, FLAT, times=[0.0, 0.1, 2], u=u, w=sample(FLAT, "faces", float, 3))
    entries = ElementTree.parse(path).getroot().findall("./Collection/DataSet")
    assert [float(entry.get("timestep")) for entry in entries] == [0.0, 0.1, 2.0]
    for number, entry in enumerate(entries):
        parts = read(tmp_path / entry.get("file"))[1]
        assert np.array_equal(shaped(parts["CellData"]["u"], 4, 3), u[number]) and len(parts["CellData"]["w"]) == 3
    assert sorted(one.name for one in (tmp_path / "a & b").iterdir()) == ["0000.vtr", "0001.vtr", "0002.vtr"]


def test_a_shorter_series_leaves_no_file_of_the_longer_one(tmp_path):
    path = tmp_path / "a.pvd"
    u = sample(FLAT, "cells", float, 3)
    dp.save(path, FLAT, times=[0.0, 0.1, 0.2], u=u)
    (tmp_path / "a" / "mine.vtr").write_text("mine")
    dp.save(path, FLAT, times=[0.0], u=u[:1])
    assert sorted(one.name for one in (tmp_path / "a").iterdir()) == ["0000.vtr", "mine.vtr"]
    path = tmp_path / "missing" / "a.pvd"
    with pytest.raises(FileNotFoundError) as caught:
        dp.save(path, FLAT, times=[0.0], u=u[:1])
    assert str(caught.value) == f"[Errno 2] No such file or directory; create the folder first: '{path}'"


@pytest.mark.parametrize("suffix", [".vti", ".vtr"])
@pytest.mark.parametrize("grid", [dp.Grid(5), FLAT, dp.Grid((2, 3, 4), size=1 / 7, periodic=(False, False, True))])
def test_vtk_reads_the_same(grid, suffix, tmp_path):
    vtk = pytest.importorskip("vtk", reason="vtk is not installed")
    support = pytest.importorskip("vtk.util.numpy_support")
    fields = {"c": sample(grid, "cells"), "v": sample(grid, "faces"), "n": sample(grid, "nodes")}
    dp.save(tmp_path / f"a{suffix}", grid, at={"v": "faces", "n": "nodes"}, **fields)
    reader = vtk.vtkXMLImageDataReader() if suffix == ".vti" else vtk.vtkXMLRectilinearGridReader()
    reader.SetFileName(str(tmp_path / f"a{suffix}"))
    reader.Update()
    cells = reader.GetOutput().GetCellData()
    points = reader.GetOutput().GetPointData()
    assert reader.GetOutput().GetNumberOfCells() == grid.cells.size
    bounds = reader.GetOutput().GetBounds()
    ends = [line[place] for axis in range(grid.dim) for line in [grid.coordinates(axis, "ends")] for place in (0, -1)]
    assert np.allclose(bounds[: 2 * grid.dim], ends, rtol=1e-14)
    parts = read(tmp_path / f"a{suffix}")[1]
    assert np.array_equal(support.vtk_to_numpy(cells.GetArray("c")), fields["c"].ravel(order="F"))
    assert np.array_equal(support.vtk_to_numpy(cells.GetArray("v")).T, parts["CellData"]["v"])
    assert np.array_equal(support.vtk_to_numpy(points.GetArray("n")), parts["PointData"]["n"][0])
