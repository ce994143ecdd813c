"""Messages of .nc and .zarr files and of arrays of xarray, in full."""

import numpy as np
import pytest

import sparsedp as dp

LIBRARY = 'is not installed: python -m pip install -e ".[files]"'
for library in ("xarray", "h5netcdf", "h5py", "zarr"):
    pytest.importorskip(library, reason=f"{library} {LIBRARY}")

LINE = dp.Grid((3, 2), size=(3.0, 1.0))

# ---- refusals before a file is written -------------------------------------------------------------------------------

REFUSED = {
    "a name that is a coordinate": (
        ValueError,
        "save would store x as x, which exists; write another name",
        lambda path: dp.save(path, LINE, x=np.ones(LINE.shape)),
    ),
    "a name that is a component": (
        ValueError,
        "save would store v_y as v_y, which exists; write another name",
        lambda path: dp.save(path, LINE, v=np.ones(LINE.faces.shape), v_y=np.ones(LINE.shape)),
    ),
    "no name of a variable": (
        ValueError,
        "save takes Python identifiers as names of fields, got 'a/b'; write another name",
        lambda path: dp.save(path, LINE, **{"a/b": np.ones(LINE.shape)}),
    ),
    "attributes of nothing": (
        ValueError,
        "save takes attrs as a dict with keys from ['u', 'x', 'y', 'times'], got ['p', 'z']; leave them out",
        lambda path: dp.save(path, LINE, u=np.ones(LINE.shape), attrs={"p": {}, "z": {}}),
    ),
    "attributes that are no dict": (
        ValueError,
        "save takes attrs as a dict with keys from ['u', 'x', 'y', 'times'], got ['u']; leave them out",
        lambda path: dp.save(path, LINE, u=np.ones(LINE.shape), attrs=["u"]),
    ),
    "units that are a number": (
        TypeError,
        "save takes units as a str, or a dict of str, numbers and arrays, in attrs, got 3 for u; write {'u': 'm'}",
        lambda path: dp.save(path, LINE, u=np.ones(LINE.shape), attrs={"u": 3}),
    ),
    "an attribute that is none": (
        TypeError,
        "save takes units as a str, or a dict of str, numbers and arrays, in attrs, got {'a': None} for u; "
        "write {'u': 'm'}",
        lambda path: dp.save(path, LINE, u=np.ones(LINE.shape), attrs={"u": {"a": None}}),
    ),
    "an attribute of ragged lists": (
        TypeError,
        "save takes units as a str, or a dict of str, numbers and arrays, in attrs, got {'a': [[1], [2, 3]]} for u; "
        "write {'u': 'm'}",
        lambda path: dp.save(path, LINE, u=np.ones(LINE.shape), attrs={"u": {"a": [[1], [2, 3]]}}),
    ),
    "an attribute without a name": (
        TypeError,
        "save takes units as a str, or a dict of str, numbers and arrays, in attrs, got {'': 1} for u; "
        "write {'u': 'm'}",
        lambda path: dp.save(path, LINE, u=np.ones(LINE.shape), attrs={"u": {"": 1}}),
    ),
    "half precision": (
        TypeError,
        "u has dtype float16, which such a file does not hold; write u.astype(float)",
        lambda path: dp.save(path, LINE, u=np.ones(LINE.shape, "float16")),
    ),
}


@pytest.mark.parametrize("suffix", [".nc", ".zarr"])
@pytest.mark.parametrize("case", REFUSED)
def test_refused_without_a_file(case, suffix, tmp_path):
    kind, message, act = REFUSED[case]
    with pytest.raises(kind) as caught:
        act(tmp_path / f"a{suffix}")
    assert str(caught.value) == message and not list(tmp_path.iterdir())


FIELD = dp.interop.to_xarray(LINE, u=np.ones(LINE.shape)).u
MISPLACED = {
    "a Dataset": (
        TypeError,
        "from_xarray takes a DataArray, got Dataset; write dataset['u']",
        FIELD.to_dataset(),
    ),
    "other names": (
        ValueError,
        "from_xarray takes dimensions ('x', 'y') and no coordinates but theirs, got ('lon', 'y') and ['lon']; "
        "write u.rename(lon='x') or u.drop_vars('time')",
        FIELD.rename(x="lon"),
    ),
    "a coordinate that would be lost": (
        ValueError,
        "from_xarray takes dimensions ('x', 'y') and no coordinates but theirs, got ('x', 'y') and ['time']; "
        "write u.rename(lon='x') or u.drop_vars('time')",
        FIELD.assign_coords(time=3.0),
    ),
    "another order": (
        dp.errors.ShapeError,
        "from_xarray takes x at the 3 centres of Grid(3 x 2 cells, size 3 x 1), got 3 from [2.5] to [0.5]; "
        "write another Grid, or u.sortby('x')",
        FIELD[::-1],
    ),
    "another grid": (
        dp.errors.ShapeError,
        "from_xarray takes x at the 3 centres of Grid(3 x 2 cells, size 3 x 1), got 2 from [0.5] to [1.5]; "
        "write another Grid, or u.sortby('x')",
        FIELD[:2],
    ),
    "moved a little": (
        dp.errors.ShapeError,
        "from_xarray takes y at the 2 centres of Grid(3 x 2 cells, size 3 x 1), got 2 from [0.251] to [0.751]; "
        "write another Grid, or u.sortby('y')",
        FIELD.assign_coords(y=FIELD.y + 0.001),
    ),
}


@pytest.mark.parametrize("case", MISPLACED)
def test_arrays_that_are_not_on_the_grid(case):
    kind, message, array = MISPLACED[case]
    with pytest.raises(kind) as caught:
        dp.interop.from_xarray(LINE, array)
    assert str(caught.value) == message


def test_a_time_that_is_not_on_the_grid():
    with pytest.raises(TypeError, match="^from_xarray takes a Grid, got DataArray; write dp.Grid"):
        dp.interop.from_xarray(FIELD, LINE)
    with pytest.raises(ValueError, match="^to_xarray takes attrs as a dict with keys from"):
        dp.interop.to_xarray(LINE, attrs={"v": {}}, u=np.ones(LINE.shape))


@pytest.mark.parametrize("suffix", [".nc", ".zarr"])
@pytest.mark.parametrize("error", [PermissionError(13, "Permission denied"), MemoryError("no room")])
def test_a_reader_that_may_not_or_cannot_read_says_so(suffix, error, tmp_path, monkeypatch):
    path = tmp_path / f"a{suffix}"
    dp.save(path, LINE, u=np.ones(LINE.shape))

    def refuse(*arguments, **options):
        raise error

    monkeypatch.setattr("xarray.open_dataset", refuse)
    with pytest.raises(type(error)) as caught:
        dp.load(path)
    assert caught.value is error


@pytest.mark.parametrize("suffix", [".nc", ".zarr"])
def test_a_file_that_may_not_be_read_is_not_damaged(suffix, tmp_path, monkeypatch):
    """Root may read everything: the right is taken from the functions that open."""
    path = tmp_path / f"a{suffix}"
    dp.save(path, LINE, u=np.ones(LINE.shape))

    def refuse(*arguments):
        raise PermissionError(13, "Permission denied", str(path))

    with monkeypatch.context() as rights:
        rights.setattr("builtins.open" if suffix == ".nc" else "os.scandir", refuse)
        with pytest.raises(PermissionError) as caught:
            dp.load(path)
    assert str(caught.value) == f"[Errno 13] Permission denied: '{path}'"
