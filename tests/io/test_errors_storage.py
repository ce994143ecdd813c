"""Messages of files, pictures and of a matrix from coordinates, in full."""

import re
import sys

import numpy as np
import pytest

import sparsedp as dp
from sparsedp.io import archive

GRID = dp.Grid((3, 2))
LABELLED = type("DataArray", (), {"__module__": "xarray.core.dataarray"})()
from_coo = dp.matrix_solver.from_coo

CASES = {
    "op DataArray": (
        TypeError,
        "gradient needs arrays of NumPy, got a DataArray of xarray, whose coordinates would be lost; "
        "write dp.interop.from_xarray(grid, u)",
        lambda: dp.gradient(GRID)(LABELLED),
    ),
    "from_coo shapes": (
        ValueError,
        "from_coo takes flat rows and columns, got shapes (2,) and (1,)",
        lambda: from_coo([0, 1], [0]),
    ),
    "from_coo dtypes": (
        TypeError,
        "rows and columns must hold integers, got dtype float64",
        lambda: from_coo([0.0], [0]),
    ),
    "from_coo places": (
        ValueError,
        "from_coo takes rows and columns from 0 to 1, one place at least; give others",
        lambda: from_coo([0, 2], [0, 1], domain=2),
    ),
    "times": (
        ValueError,
        "save takes times of shape (n,), got (); write np.atleast_1d(times)",
        lambda: dp.save("u.npz", GRID, times=0.0),
    ),
    "suffix": (
        ValueError,
        "save takes a path that ends in .npz, .nc, .zarr, .vti, .vtr or .pvd, got 'u.txt'; write 'fields.npz'",
        lambda: dp.save("u.txt", GRID),
    ),
    "numbers": (
        TypeError,
        "save takes arrays of numbers, u is of type str; write np.asarray(u), or dp.gather(u) for a distributed field",
        lambda: dp.save("u.npz", GRID, u="hot"),
    ),
    "series": (
        ValueError,
        "u has shape (3, 2), and there are 2 times; write np.stack(states)",
        lambda: dp.save("u.npz", GRID, times=[0.0, 1.0], u=np.zeros((3, 2))),
    ),
    "at an unknown field": (
        ValueError,
        "save takes at as a dict with keys from ['u'], got ['w']; leave them out",
        lambda: dp.save("u.npz", GRID, at={"w": "cells"}, u=np.zeros((3, 2))),
    ),
    "at an unknown place": (
        ValueError,
        "u has shape (3, 2), which is no field on corners of Grid(3 x 2 cells, size 3 x 2); those on cells have (3, 2)",
        lambda: dp.save("u.npz", GRID, at={"u": "corners"}, u=np.zeros((3, 2))),
    ),
    "attributes": (
        ValueError,
        "save keeps attrs in .nc and .zarr files, got 'u.npz'; write 'fields.nc'",
        lambda: dp.save("u.npz", GRID, attrs={"u": {"units": "K"}}, u=np.zeros((3, 2))),
    ),
    "ParaView and back": (
        ValueError,
        "load takes a path that ends in .npz, .nc or .zarr, got 'u.vti'; save the fields as .npz too",
        lambda: dp.load("u.vti"),
    ),
    "ParaView, complex": (
        TypeError,
        "u has dtype complex128, which such a file does not hold; write u.real and u.imag",
        lambda: dp.save("u.vtr", GRID, u=np.zeros((3, 2), complex)),
    ),
    "ParaView, bool": (
        TypeError,
        "u has dtype bool, which such a file does not hold; write u.astype(float)",
        lambda: dp.save("u.vti", GRID, u=np.zeros((3, 2), bool)),
    ),
    "ParaView, stretched": (
        ValueError,
        "save puts fields on uniform grids into .vti, got 1 on Grid(2 cells, size 3, stretched in x); "
        "write 'fields.vtr'",
        lambda: dp.save("u.vti", dp.Grid(2, spacing=np.array([1.0, 2.0])), u=np.zeros(2)),
    ),
    "ParaView, nothing": (
        ValueError,
        "save puts fields on uniform grids into .vti, got 0 on Grid(3 x 2 cells, size 3 x 2); write 'fields.vtr'",
        lambda: dp.save("u.vti", GRID),
    ),
    "ParaView, a series in one file": (
        ValueError,
        "save puts one state into .vti or .vtr, and a series with times into .pvd, got .vti",
        lambda: dp.save("u.vti", GRID, times=[0.0], u=np.zeros((1, 3, 2))),
    ),
    "ParaView, a time that is none": (
        dp.errors.NonFiniteError,
        "times of save must be finite, got 1 that are NaN or infinite, the first at 1",
        lambda: dp.save("u.pvd", GRID, times=[0.0, np.nan], u=np.zeros((2, 3, 2))),
    ),
    "ParaView, one state in a series": (
        ValueError,
        "save puts one state into .vti or .vtr, and a series with times into .pvd, got .pvd",
        lambda: dp.save("u.pvd", GRID, u=np.zeros((3, 2))),
    ),
    "place": (
        ValueError,
        "u has shape (4,), which is no field on cells, faces, nodes or edges of Grid(3 x 2 cells, size 3 x 2); "
        "those on cells have (3, 2)",
        lambda: dp.save("u.npz", GRID, u=np.zeros(4)),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_message(name):
    kind, message, act = CASES[name]
    with pytest.raises(kind) as caught:
        act()
    assert str(caught.value) == message


def test_a_file_that_is_none_of_ours(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.savez("other.npz", u=np.zeros(3))
    with pytest.raises(ValueError) as caught:
        dp.load("other.npz")
    assert str(caught.value) == (
        "load takes a file that dp.save wrote, other.npz is another one or damaged; write np.load(path)"
    )


def test_pictures(tmp_path, monkeypatch):
    image = pytest.importorskip("PIL.Image", reason="Pillow reads pictures")
    monkeypatch.chdir(tmp_path)
    image.new("RGBA", (2, 2)).save("clear.png")
    with pytest.raises(ValueError) as caught:
        dp.from_image("clear.png")
    assert str(caught.value) == (
        "from_image takes grey or RGB pictures without transparency, clear.png has mode RGBA; save it as RGB"
    )


def test_pictures_without_pillow(monkeypatch):
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(ImportError) as caught:
        dp.from_image("any.png")
    assert str(caught.value) == "from_image needs Pillow; install sparsedp[plot]"


MISSING = {
    "xarray": "save needs xarray for .nc files; install sparsedp[files]",
    "h5netcdf": "save needs h5netcdf for .nc files; install sparsedp[files]",
    "h5py": "save needs h5py for .nc files; install sparsedp[files]",
    "zarr": "save needs zarr for .zarr files; install sparsedp[files]",
    "pyevtk": "save needs pyevtk for .vti files; install sparsedp[files]",
}


@pytest.mark.parametrize("library", MISSING)
def test_files_without_their_library(library, tmp_path, monkeypatch):
    monkeypatch.setattr(archive, "find_spec", lambda name: None if name == library else True)
    path = tmp_path / f"a{re.search(r'[.][a-z]+', MISSING[library])[0]}"
    with pytest.raises(ImportError) as caught:
        dp.save(path, GRID, u=np.zeros((3, 2)))
    assert str(caught.value) == MISSING[library] and not list(tmp_path.iterdir())
    if library != "pyevtk":
        with pytest.raises(ImportError) as caught:
            dp.load(path)
        assert str(caught.value) == MISSING[library].replace("save", "load")
