"""Files of xarray: what comes back, what other programs see, what is refused; and arrays of xarray as fields."""

import json
import os
import shutil

import numpy as np
import pytest
from test_errors_files import LIMITED, process
from test_storage import GRID, GRIDS, same

import sparsedp as dp

xarray = pytest.importorskip("xarray", reason='xarray is not installed: python -m pip install -e ".[files]"')
for library in ("h5netcdf", "h5py", "zarr"):
    pytest.importorskip(library, reason=f'{library} is not installed: python -m pip install -e ".[files]"')

SUFFIXES = (".nc", ".zarr")
KINDS = ("cells", "faces", "nodes", "edges")
LINE = dp.Grid((3, 2), size=(3.0, 1.0))


def opened(path):
    engine = "zarr" if path.suffix == ".zarr" else "h5netcdf"
    with xarray.open_dataset(path, engine=engine, decode_times=False) as stored:
        return stored.load()


def numbers(grid, kind, dtype, *lead):
    rng = np.random.default_rng(0)
    return (4 * rng.standard_normal((*lead, *getattr(grid, kind).shape))).astype(dtype)


# ---- round trips -----------------------------------------------------------------------------------------------------


@pytest.mark.sampled
@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("name", GRIDS)
@pytest.mark.parametrize("dtype", ["float64", "float32", "complex128", "complex64", "int64", "uint8", "bool"])
@pytest.mark.parametrize("times", [None, np.array([0.0, 0.1]), np.arange(3), np.zeros(0, "float32")])
def test_round_trip(suffix, name, dtype, times, tmp_path):
    grid = GRIDS[name]
    lead = () if times is None else times.shape
    fields = {kind: numbers(grid, kind, dtype, *lead) for kind in KINDS}
    fields["batch"] = np.asfortranarray(numbers(grid, "cells", dtype, *lead, 2))
    fields["flows"] = numbers(grid, "faces", dtype, *lead, 1, 2)
    at = {"nodes": "nodes", "edges": "edges"}
    dp.save(tmp_path / f"a{suffix}", grid, times=times, at=at, **fields)
    again, loaded = dp.load(tmp_path / f"a{suffix}")
    assert again == grid and again.periodic == grid.periodic and again.origin == grid.origin
    assert all(same(a, b) for a, b in zip(again.widths, grid.widths, strict=True))
    if times is not None:
        assert same(loaded.pop("times"), times)
    assert list(loaded) == list(fields) and all(same(loaded[key], fields[key]) for key in fields)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_bits_that_comparisons_do_not_see(suffix, tmp_path):
    """Whole arrays of what equals the number that stands for nothing, too."""
    odd = np.full(GRID.shape, np.nan)
    odd.view(np.uint64)[:] = 0x7FF8000000000123  # a NaN with a payload
    mixed = np.zeros(GRID.shape)
    mixed[0, 0], mixed[1, 1], mixed[2, 2], mixed[3, 0] = np.nan, -np.inf, -np.nan, -0.0
    fields = {
        "zero": np.full(GRID.shape, -0.0),
        "odd": odd,
        "mixed": mixed,
        "c": np.full(GRID.shape, complex(0.0, -0.0)),
    }
    dp.save(tmp_path / f"a{suffix}", GRID, **fields)
    loaded = dp.load(tmp_path / f"a{suffix}")[1]
    assert all(same(loaded[name], fields[name]) for name in fields)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_bytes_in_another_order_come_back_in_that_of_the_machine(suffix, tmp_path):
    u = numbers(GRID, "cells", ">f8")
    dp.save(tmp_path / f"a{suffix}", GRID, u=u, v=u.astype(np.longlong))
    loaded = dp.load(tmp_path / f"a{suffix}")[1]
    assert same(loaded["u"], u.astype(float)) and same(loaded["v"], u.astype("int64"))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_was_there_is_replaced_by_the_whole_or_stays(suffix, tmp_path, monkeypatch):
    path = tmp_path / f"a{suffix}"
    dp.save(path, GRID, u=np.zeros(GRID.shape))
    dp.save(path, GRID, v=np.ones(GRID.shape))
    assert list(dp.load(path)[1]) == ["v"]
    before = sorted(tmp_path.iterdir())

    def full(source, target):
        raise OSError(28, "No space left on device", str(source))

    with monkeypatch.context() as disk:
        disk.setattr("os.replace", full)
        with pytest.raises(OSError, match=f"No space left on device: '{path}'"):
            dp.save(path, GRID, u=np.ones(GRID.shape))
    assert list(dp.load(path)[1]) == ["v"] and sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("kind", [OSError, KeyboardInterrupt])
@pytest.mark.parametrize("moment", ["before", "after"])
def test_a_folder_that_cannot_take_its_name_leaves_the_old_one_or_is_whole(kind, moment, tmp_path, monkeypatch):
    """An error or Ctrl-C at each rename: of the old folder out of the way, and of the new one onto its name."""
    path = tmp_path / "a.zarr"
    rename = os.replace
    for failing in (1, 2):
        dp.save(path, GRID, v=np.ones(GRID.shape))
        calls = []

        def fail(source, target, failing=failing, calls=calls):
            if path not in (source, target):  # one of the library's own, in another thread
                return rename(source, target)
            calls.append(target)
            if moment == "after" or len(calls) != failing:
                rename(source, target)
            if len(calls) == failing:
                raise kind(5, "Input/output error", str(source))
            return None

        with monkeypatch.context() as disk:
            disk.setattr("os.replace", fail)
            with pytest.raises(kind) as caught:
                dp.save(path, GRID, u=np.ones(GRID.shape))
        if kind is OSError:
            assert str(caught.value) == f"[Errno 5] Input/output error: '{path}'"
        assert len(calls) >= failing and (failing == 1 or calls[1] == path)
        assert list(dp.load(path)[1]) == (["u"] if (failing, moment) == (2, "after") else ["v"])
        assert list(tmp_path.iterdir()) == [path]


@pytest.mark.whole
@pytest.mark.parametrize("suffix", [*SUFFIXES, ".vtr"])
def test_no_room(suffix, tmp_path):
    """The process goes on: HDF5 ends it when it finds no room itself."""
    if suffix == ".vtr":
        pytest.importorskip("pyevtk", reason="pyevtk is not installed")
    code = """
def write(n):
    dp.save(sys.argv[1], dp.Grid((n, n)), u=np.random.default_rng(0).random((n, n)))
write(3)
limit(3000)
try:
    write(100)
except OSError as error:
    limit(resource.RLIM_INFINITY)
    print(error)
    if not sys.argv[1].endswith("vtr"):
        print(dp.load(sys.argv[1])[0])
"""
    done = process(LIMITED + code, tmp_path / f"a{suffix}")
    assert done.returncode == 0, done.stderr
    printed = [f"[Errno 27] File too large: '{tmp_path / f'a{suffix}'}'"]
    assert done.stdout.splitlines() == printed + ["Grid(3 x 3 cells, size 3 x 3)"] * (suffix != ".vtr")
    assert [path.name for path in tmp_path.iterdir()] == [f"a{suffix}"]


# ---- what other programs see -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_coordinates_and_attributes(suffix, tmp_path):
    grid = GRIDS["stretched"]
    fields = {"u": numbers(grid, "cells", float, 2), "wind": numbers(grid, "faces", float, 2)}
    attrs = {"wind": {"units": "m/s", "long_name": "wind"}, "x": "m", "times": "s"}
    dp.save(tmp_path / f"a{suffix}", grid, times=[0.0, 60.0], attrs=attrs, **fields)
    dataset = opened(tmp_path / f"a{suffix}")
    assert dataset.u.dims == ("time", "x", "y") and dataset.wind_x.dims == ("time", "x_nodes", "y")
    assert dataset.wind_y.dims == ("time", "x", "y_nodes") and dataset.wind_y.attrs["long_name"] == "wind"
    assert same(dataset.x.values, grid.coordinates(0)) and same(dataset.y_nodes.values, grid.coordinates(1, "nodes"))
    assert same(dataset.x_widths.values, grid.widths[0]) and same(dataset.time.values, np.array([0.0, 60.0]))
    assert (
        dataset.x.units == dataset.x_nodes.units == "m" and dataset.time.units == "s" and "units" not in dataset.y.attrs
    )
    for number, part in enumerate(grid.split(fields["wind"][1])):
        assert same(dataset[f"wind_{'xy'[number]}"].values[1], np.ascontiguousarray(part))
    notes = json.loads(dataset.attrs["sparsedp"])
    assert notes["origin"] == list(grid.origin) and notes["periodic"] == [False, False]
    assert notes["fields"] == {"u": ["cells", ["u"]], "wind": ["faces", ["wind_x", "wind_y"]]}


def test_where_a_field_lives():
    u = np.ones(5)
    line = dp.Grid(5, periodic=True)
    where = {kind: dp.interop.to_xarray(line, at={"u": kind}, u=u) for kind in KINDS}
    assert where["cells"].u.dims == ("x",) and where["nodes"].u.dims == ("x_nodes",)
    assert where["faces"].u_x.dims == ("x_nodes",) and where["edges"].u_x.dims == ("x",)
    assert dp.interop.to_xarray(line, u=u).identical(where["cells"])
    box = dp.Grid((2, 3, 4))
    edges = dp.interop.to_xarray(box, at={"u": "edges"}, u=np.ones((2, *box.edges.shape)))
    assert edges.u_y.dims == ("u_batch_0", "x_nodes", "y", "z_nodes")


def test_netcdf_of_the_c_library_reads_it(tmp_path):
    pytest.importorskip("netCDF4", reason="netCDF4 is not installed")
    dp.save(tmp_path / "a.nc", GRID, u=numbers(GRID, "cells", float), b=numbers(GRID, "cells", bool))
    with xarray.open_dataset(tmp_path / "a.nc", engine="netcdf4") as stored:
        assert same(stored.u.values, numbers(GRID, "cells", float)) and stored.b.dtype == bool


# ---- files that are none ---------------------------------------------------------------------------------------------


def refused(path):
    with pytest.raises(ValueError) as caught:
        dp.load(path)
    assert str(caught.value) == (
        f"load takes a file that dp.save wrote, {path} is another one or damaged; write xarray.open_dataset(path)"
    )


def test_damaged_netcdf(tmp_path):
    path = tmp_path / "a.nc"
    with pytest.raises(FileNotFoundError, match=r"a\.nc"):
        dp.load(path)
    with pytest.raises(FileNotFoundError, match="missing"):
        dp.save(tmp_path / "missing" / "a.nc", GRID)
    u = numbers(GRID, "cells", float)
    dp.save(path, GRID, u=u)
    whole = path.read_bytes()
    place = whole.index(u.tobytes())
    flipped = whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :]  # the last bit of one number
    for damaged in (whole[: len(whole) // 2], b"", b"text", flipped):
        path.write_bytes(damaged)
        refused(path)
    path.write_bytes(whole)
    changed = opened(path)
    changed["u"] = changed.u + 1.0
    changed.to_netcdf(path, engine="h5netcdf")
    refused(path)
    xarray.Dataset({"u": (("x", "y"), u)}).to_netcdf(path, engine="h5netcdf")
    refused(path)


def test_damaged_zarr(tmp_path):
    path = tmp_path / "a.zarr"
    copy = tmp_path / "copy.zarr"
    with pytest.raises(FileNotFoundError, match=r"a\.zarr"):
        dp.load(path)
    dp.save(path, GRID, u=numbers(GRID, "cells", float))
    chunks = [place for place in path.rglob("*") if place.is_file() and place.name[0] != "."]
    assert len(chunks) == 7  # of u, and of two coordinates and the widths of each axis
    for place in chunks:
        shutil.copytree(path, copy)
        (copy / place.relative_to(path)).unlink()  # then it is read as zeros
        refused(copy)
        shutil.rmtree(copy)
    dp.save(copy, GRID, u=2 * numbers(GRID, "cells", float))
    shutil.copy(copy / "u" / "0.0", path / "u" / "0.0")
    refused(path)


# ---- arrays of xarray ------------------------------------------------------------------------------------------------


def test_dimensions_are_found_by_name():
    u = np.arange(6.0).reshape(3, 2)
    array = dp.interop.to_xarray(LINE, u=u).u
    for turned in (array, array.T, array.drop_vars("x"), array.astype("float32").assign_coords(x=np.float32(array.x))):
        back = dp.interop.from_xarray(LINE, turned)
        assert np.array_equal(back, u) and back.flags.c_contiguous and back.dtype == turned.dtype
    back[:] = 0.0
    assert np.array_equal(array, u)
    series = xarray.concat([array, 2 * array], "time").transpose("y", "time", "x")
    assert np.array_equal(dp.interop.from_xarray(LINE, series), [u, 2 * u])
