"""Fields in files: what is saved comes back, what is refused says why."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

GRIDS = {
    "line": dp.Grid(5),
    "periodic": dp.Grid((4, 3), size=(0.1, 0.3), periodic=(True, False)),
    "stretched": dp.Grid((3, 2), spacing=(np.array([0.1, 0.2, 0.7]), 1 / 3), origin=(-1.0, 1e-3)),
    "box": dp.Grid((2, 3, 4), size=1 / 7, periodic=(False, False, True)),
    "empty": dp.Grid((0, 3)),
}
GRID = GRIDS["periodic"]


def same(a, b):
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


@pytest.mark.parametrize("name", GRIDS)
@pytest.mark.parametrize("dtype", ["float64", "float32", "complex128", "complex64", "int16", "bool", ">f8"])
def test_round_trip(name, dtype, tmp_path):
    grid = GRIDS[name]
    rng = np.random.default_rng(0)
    fields = {}
    for kind in ("cells", "faces", "nodes", "edges"):
        fields[kind] = (4 * rng.standard_normal(getattr(grid, kind).shape)).astype(dtype)
    fields["path"] = np.asfortranarray(rng.standard_normal((2, *grid.shape)).astype(dtype))  # a batch
    dp.save(tmp_path / "a.npz", grid, **fields)
    again, loaded = dp.load(tmp_path / "a.npz")
    assert again == grid and again.periodic == grid.periodic and again.origin == grid.origin
    assert all(same(a, b) for a, b in zip(again.widths, grid.widths, strict=True))
    assert list(loaded) == list(fields) and all(same(loaded[key], fields[key]) for key in fields)


def test_nan_infinity_and_signed_zero(tmp_path):
    u = np.full(GRID.shape, -0.0)
    u[0, 0], u[1, 1], u[2, 2] = np.nan, -np.inf, -np.nan
    dp.save(tmp_path / "a.NPZ", GRID, u=u)
    assert same(dp.load(tmp_path / "a.NPZ")[1]["u"], u)


def test_series_goes_round_twice(tmp_path):
    states = np.arange(36.0).reshape(3, 4, 3)
    dp.save(str(tmp_path / "a.npz"), GRID, times=[0, 1, 2.5], u=states)
    grid, fields = dp.load(str(tmp_path / "a.npz"))
    assert same(fields["times"], np.array([0, 1, 2.5])) and same(fields["u"], states)
    dp.save(tmp_path / "b.npz", grid, **fields)
    assert (tmp_path / "b.npz").read_bytes() == (tmp_path / "a.npz").read_bytes()


def test_grid_alone_and_nothing_left_behind(tmp_path):
    dp.save(tmp_path / "a.npz", GRID, u=np.ones(GRID.shape))
    dp.save(tmp_path / "a.npz", GRID)  # replaces
    grid, fields = dp.load(tmp_path / "a.npz")
    assert grid == GRID and fields == {} and len(list(tmp_path.iterdir())) == 1


REFUSED = {
    "suffix": (
        lambda p: dp.save(p / "a.txt", GRID),
        ValueError,
        "save takes a path that ends in .npz, .nc, .zarr, .vti, .vtr or .pvd, got 'a.txt'",
    ),
    "no suffix": (
        lambda p: dp.load(p / "a"),
        ValueError,
        "load takes a path that ends in .npz, .nc or .zarr, got 'a'; write ",
    ),
    "no grid": (lambda p: dp.save(p / "a.npz", 3), TypeError, "save takes a Grid, got int; write dp.Grid"),
    "shape": (
        lambda p: dp.save(p / "a.npz", GRID, u=np.ones(5)),
        dp.errors.ShapeError,
        "u has shape .5,., which is no field on cells, .* of Grid.*; those on cells have .4, 3.",
    ),
    "scalar": (lambda p: dp.save(p / "a.npz", GRID, u=1.0), dp.errors.ShapeError, "u has shape .., which is no field"),
    "times": (
        lambda p: dp.save(p / "a.npz", GRID, times=[0.0, 1.0], u=np.ones((3, 4, 3))),
        dp.errors.ShapeError,
        "u has shape .3, 4, 3., and there are 2 times; write np.stack",
    ),
    "time": (lambda p: dp.save(p / "a.npz", GRID, times=0.0), dp.errors.ShapeError, "save takes times of shape "),
    "strings": (
        lambda p: dp.save(p / "a.npz", GRID, u=np.full((4, 3), "a")),
        TypeError,
        "save takes arrays of numbers, u is of type ndarray; write np.asarray.u., or dp.gather.u. for a distributed fi",
    ),
    "masked": (
        lambda p: dp.save(p / "a.npz", GRID, u=np.ma.ones((4, 3))),
        TypeError,
        "save takes plain arrays, got a masked",
    ),
    "function": (
        lambda p: dp.save(p / "a.npz", GRID, u=np.sin),
        TypeError,
        "save takes arrays of numbers, u is of type uf",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_without_a_file(case, tmp_path):
    act, error, message = REFUSED[case]
    with pytest.raises(error, match=f"^{message}"):
        act(tmp_path)
    assert not list(tmp_path.iterdir())


def test_value_on_a_tape_is_refused(tmp_path):
    def loss(u):
        dp.save(tmp_path / "a.npz", GRID, u=u)
        return anp.sum(u)

    with pytest.raises(TypeError, match=r"save takes arrays of numbers, u is of type ArrayBox"):
        dp.grad(loss)(np.ones(GRID.shape))


def test_files_that_are_none(tmp_path):
    path = tmp_path / "a.npz"
    with pytest.raises(FileNotFoundError, match=r"a\.npz"):
        dp.load(path)
    with pytest.raises(FileNotFoundError, match=r"missing"):
        dp.save(tmp_path / "missing" / "a.npz", GRID)
    np.savez(path, u=np.ones(3))
    with pytest.raises(ValueError, match=r"^load takes a file that dp.save wrote, .*a\.npz is another one or damaged"):
        dp.load(path)
    dp.save(path, GRID, u=np.ones(GRID.shape))
    whole = path.read_bytes()
    for damaged in (whole[: len(whole) // 2], b"", whole[:300] + b"\xff" * 200 + whole[500:]):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match="or damaged"):
            dp.load(path)


def test_image_axes_and_shades(tmp_path):
    image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
    grey = np.array([[0, 51, 255], [102, 0, 0]], np.uint8)  # two rows, the upper one first
    image.fromarray(grey).save(tmp_path / "a.png")
    u = dp.from_image(tmp_path / "a.png")
    assert u.shape == (3, 2) and u[1, 1] == 0.2 and u[2, 1] == 1.0 and u[0, 0] == 0.4
    image.fromarray(grey.astype(np.uint16) * 257).save(tmp_path / "b.png")
    assert np.array_equal(dp.from_image(tmp_path / "b.png"), u)
    colour = np.stack([grey, 255 - grey, 0 * grey], axis=-1)
    image.fromarray(colour).save(tmp_path / "c.png")
    assert np.array_equal(dp.from_image(tmp_path / "c.png"), [u, (255 - grey)[::-1].T / 255, 0 * u])
    image.fromarray(grey > 60).save(tmp_path / "d.png")
    assert np.array_equal(dp.from_image(tmp_path / "d.png"), [[1, 0], [0, 0], [0, 1]])
    image.fromarray(np.zeros((2, 3, 4), np.uint8)).save(tmp_path / "e.png")
    with pytest.raises(ValueError, match=r"^from_image takes grey or RGB pictures without transparency, .* mode RGBA"):
        dp.from_image(tmp_path / "e.png")
    with pytest.raises(OSError, match="not_there"):
        dp.from_image(tmp_path / "not_there.png")


def test_array_of_xarray_is_refused():
    kind = type("DataArray", (), {"__module__": "xarray.core.dataarray"})  # the name is what is looked at
    message = r"^laplacian needs arrays of NumPy, got a DataArray of xarray, whose coordinates would be lost; write"
    with pytest.raises(TypeError, match=message):
        dp.laplacian(GRID)(kind())


def test_array_of_the_real_xarray_is_refused():
    xarray = pytest.importorskip("xarray", reason="xarray is not installed")
    with pytest.raises(TypeError, match="whose coordinates would be lost"):
        dp.laplacian(GRID)(xarray.DataArray(np.ones((3, 4)), dims=("y", "x")))
