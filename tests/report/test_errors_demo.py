"""What the demo cannot use is refused in one sentence, with exit code 2, before anything is computed or written."""

import io
import os
import pickle
import re
import struct
import sys
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from test_demo import demo, relief

import sparsedp as dp
from sparsedp.__main__ import main
from sparsedp.kernels.team import NOTICE
from sparsedp.report.demo import story, terrain
from sparsedp.report.scene_file import claim_folder


def header(shape, descr="<f8"):
    """A .npy header that promises what it likes."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": descr, "fortran_order": False, "shape": shape})
    return stream.getvalue()


def saved(field):
    def write(path):
        np.save(path, field)

    return write


def raw(content):
    def write(path):
        path.write_bytes(content)

    return write


def zipped(**arrays):
    def write(path):
        np.savez(path, **arrays)

    return write


def member(name, content):
    def write(path):
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(name, content)

    return write


def sparse_file(path):
    """101 million values that take no room on the disk."""
    promise = header((101, 10**6), "|b1")
    with path.open("wb") as stream:
        stream.write(promise)
        stream.truncate(len(promise) + 101 * 10**6)


def with_nan(field):
    field = field.copy()
    field[3, 5] = field[4, 1] = np.nan
    return field


def png(width, height):
    """A picture of that size, so it says, without what is in it."""
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)),
        (b"IDAT", zlib.compress(b"")),
        (b"IEND", b""),
    )
    sums = (struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks)
    parts = [struct.pack(">I", len(data)) + kind + data + end for (kind, data), end in zip(chunks, sums)]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def case(name, write, match):
    return pytest.param(name, write, match, id=f"{name} {match[:40]}")


BAD = [
    case("a.npy", None, match=r"a\.npy is not there or is no plain file; give the path of a .npy, .npz or .png file"),
    case("a.npy", Path.mkdir, match=r"a\.npy is not there or is no plain file; give the path of a .npy"),
    case("a.tif", raw(b"II"), match=r"a\.tif is not a .npy, .npz or .png file; save the field with numpy.save"),
    case(
        "a.npy",
        saved(np.arange(30.0)),
        match=r"a\.npy needs a 2-D array, 4 values or more along each axis, got shape \(30,\)",
    ),
    case(
        "a.npy",
        saved(np.zeros((4, 4, 4))),
        match=r"a\.npy needs a 2-D array, 4 values or more along each axis, got shape \(4, 4, 4\)",
    ),
    case(
        "a.npy",
        saved(np.float64(3.0)),
        match=r"a\.npy needs a 2-D array, 4 values or more along each axis, got shape \(\)",
    ),
    case(
        "a.npy",
        saved(with_nan(relief())),
        match=r"a\.npy needs finite values, got 2 that are NaN or infinite, the first at \(3, 5\)",
    ),
    case("a.npy", saved(np.full((9, 9), np.inf)), match=r"needs finite values, got 81 that are NaN or inf"),
    case(
        "a.npy",
        saved(np.full((9, 9), 7.0)),
        match=r"your file .*a\.npy is constant once averaged over Grid.*; give a field with larger features",
    ),
    case("a.npy", saved(np.zeros((9, 9))), match=r"a\.npy is constant once averaged over Grid"),
    case(
        "a.npy",
        lambda path: np.save(path, np.array([[1, None], [2, 3]], dtype=object), allow_pickle=True),
        match=r"a\.npy cannot be read \(.*objects.*\); save the field with numpy.save",
    ),
    case(
        "a.npy",
        raw(pickle.dumps(relief())),
        match=r"a\.npy cannot be read \(.*\); save the field with numpy.save",
    ),
    case("a.npy", raw(b""), match=r"a\.npy cannot be read"),
    case("a.npy", raw(header((9, 9))[:40]), match=r"a\.npy cannot be read"),
    case("a.npy", raw(header((-3, -3)) + bytes(800)), match=r"a\.npy cannot be read"),
    case("a.npy", raw(header((10**30, 2))), match=r"a\.npy cannot be read"),
    case(
        "a.npy",
        raw(header((10**9, 10**6)) + bytes(800)),
        match=r"a\.npy cannot be read \(.*greater than file size",
    ),
    case("a.npy", raw(header((20, 20)) + bytes(3199)), match=r"a\.npy cannot be read \(.*greater than file size"),
    case("a.npy", sparse_file, match=r"a\.npy holds 101000000 values, at most 100000000 are taken; thin it out first"),
    case("a.npy", saved(relief() + 0j), match=r"a\.npy needs real numbers, got dtype complex128; save it as floats"),
    case("a.npy", saved(np.full((9, 9), "x")), match=r"a\.npy needs real numbers, got dtype <U1; save it as floats"),
    case("a.npy", saved(np.zeros((9, 9), [("a", float)])), match=r"a\.npy needs real numbers, got dtype \[\('a'"),
    case(
        "a.npy",
        saved(np.zeros((0, 9))),
        match=r"a\.npy needs a 2-D array, 4 values or more along each axis, got shape \(0, 9\)",
    ),
    case(
        "a.npy",
        saved(np.eye(3)),
        match=r"a\.npy needs a 2-D array, 4 values or more along each axis, got shape \(3, 3\)",
    ),
    case("a.npy", saved(np.indices((192, 192)).sum(axis=0) % 2), match=r"is constant once averaged over Grid"),
    case(
        "a.npz",
        zipped(one=relief(), two=relief(), three=np.zeros(3)),
        match=r"a\.npz cannot be read \(it needs exactly one 2-D array, got 2 among 3: one, two\)",
    ),
    case("a.npz", zipped(line=np.zeros(9)), match=r"it needs exactly one 2-D array, got 0 among 1: line\)"),
    case("a.npz", member("notes.txt", b"none"), match=r"exactly one 2-D array, got 0 among 1: notes.txt\)"),
    case("a.npz", raw(b"PK\x03\x04 cut"), match=r"a\.npz cannot be read \(.*\); save the field with numpy.save"),
    case("a.npz", member("u.npy", header((9, 9), "|O")), match=r"a\.npz cannot be read \(Object arrays"),
    case("a.npz", member("u.npy", header((10**5, 10**5)) + bytes(999)), match=r"a\.npz cannot be read"),
    case("a.npz", member("u.npy", b"\x80\x04K\x01."), match=r"a\.npz (cannot be read|needs exactly one)"),
    case("a.png", raw(b"GIF89a" + bytes(40)), match=r"a\.png cannot be read"),
    case("a.png", raw(png(10**5, 10**5)), match=r"a\.png cannot be read \(Image size .* exceeds limit"),
]


@pytest.mark.parametrize(("name", "write", "match"), BAD)
def test_bad_input(tmp_path, capsys, name, write, match):
    if write is not None:
        write(tmp_path / name)
    out = tmp_path / "out"
    assert main(["demo", "--input", str(tmp_path / name), "--size", "12", "--out", str(out)]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    said = printed.err.replace(NOTICE, "")  # the first one to use a loop says that it is compiled
    assert re.fullmatch(r"sparsedp: [^\n]*\n", said) and re.search(match, said)
    assert not out.exists() or not any(out.iterdir())


def test_bad_input_on_the_command_line(tmp_path):
    done = demo(tmp_path, "--input", "nowhere.npy")
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(r"sparsedp: nowhere\.npy is not there [^\n]*\n", done.stderr)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (["demo", "--size", "5"], r"--size needs a whole number from 12 to 512, got 5"),
        (["demo", "--size", "-1"], r"--size needs a whole number"),
        (["demo", "--size", "100000"], r"--size needs a whole number from 12 to 512, got 100000"),
    ],
)
def test_bad_size(tmp_path, monkeypatch, capsys, arguments, match):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert re.search(match, capsys.readouterr().err)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("arguments", [[], ["demo", "--size", "many"], ["demo", "--nonsense"], ["dance"]])
def test_bad_command_line(capsys, arguments):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert re.fullmatch(r"sparsedp: [^\n]*; see python -m sparsedp( demo)? --help\n", capsys.readouterr().err)


def test_refused_sizes_and_grounds():
    with pytest.raises(ValueError, match="--size needs a whole number from 12 to 512, got 5"):
        story.grids_for(terrain.Terrain(relief(), "field"), 5)
    with pytest.raises(ValueError, match=r"field is constant once averaged over .*; give a field with larger features"):
        terrain.hidden_ground(dp.Grid((12, 12)), terrain.Terrain(np.indices((192, 192)).sum(axis=0) % 2, "field"))


def test_folder_that_cannot_be(tmp_path):
    (tmp_path / "file").write_text("here first")
    with pytest.raises(ValueError, match=r"file cannot be created: File exists; name another with --out"):
        claim_folder(tmp_path / "file", [], False)
    with pytest.raises(ValueError, match=r"file/out cannot be created: Not a directory; name another with --out"):
        claim_folder(tmp_path / "file" / "out", [], False)


def test_folder_that_cannot_be_written(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(ValueError, match=r".* cannot be written to; name another with --out"):
        claim_folder(tmp_path, ["table.csv"], False)


def test_a_link_into_nowhere_is_not_followed(tmp_path):
    (tmp_path / "table.csv").symlink_to(tmp_path / "elsewhere.csv")
    with pytest.raises(ValueError, match=r".* is there already; name another folder with --out, or write --force"):
        claim_folder(tmp_path, ["table.csv"], False)


def test_file_that_cannot_be_opened(tmp_path, monkeypatch):
    np.save(tmp_path / "a.npy", relief())

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(np, "load", refuse)
    with pytest.raises(ValueError, match=r"a\.npy cannot be read \(Permission denied\)"):
        terrain.read_field(tmp_path / "a.npy")


def test_archive_that_lies_about_its_length(tmp_path, capsys):
    path = tmp_path / "a.npz"
    member("u.npy", header((40, 40)) + bytes(12800))(path)
    content = bytearray(path.read_bytes())
    where = content.rfind(b"PK\x01\x02")  # the entry of the directory, which NumPy believes
    content[where + 24 : where + 28] = struct.pack("<I", 2**31)
    path.write_bytes(content)
    assert main(["demo", "--input", str(path), "--size", "12", "--out", str(tmp_path / "out")]) == 2
    assert "a.npz" in capsys.readouterr().err


# ---- pictures ------------------------------------------------------------------------------------------------------


@pytest.fixture
def image():
    return pytest.importorskip("matplotlib.image")


def test_picture_is_turned(tmp_path, image):
    rows = np.linspace(0.0, 1.0, 30).reshape(5, 6)
    image.imsave(tmp_path / "a.png", rows, cmap="gray")
    field = terrain.read_field(tmp_path / "a.png")
    assert field.shape == (6, 5)  # axis 0 is x: the columns of the picture
    assert field[0, 0] > field[0, -1]  # the last row of the picture is the lowest y
    assert field[-1, 0] == field.max()


def test_broken_picture(tmp_path, image):
    image.imsave(tmp_path / "a.png", relief())
    content = (tmp_path / "a.png").read_bytes()
    (tmp_path / "a.png").write_bytes(content[:200])
    with pytest.raises(ValueError, match=r"a\.png cannot be read"):
        terrain.read_field(tmp_path / "a.png")


def test_picture_without_the_extra(tmp_path, monkeypatch, capsys):
    (tmp_path / "a.png").write_bytes(png(9, 9))
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert main(["demo", "--input", str(tmp_path / "a.png"), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.startswith("sparsedp: pictures need matplotlib; install the extra: pip install ")
