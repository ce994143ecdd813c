"""Files when the disk is full, a run is killed, or a file stands there already: whole, or as they were."""

import ast
import io
import os
import signal
import stat
import subprocess
import sys
import time

import numpy as np
import pytest
from sources import ROOT, called, modules

import sparsedp as dp
from sparsedp.__main__ import main
from sparsedp.io.atomic_files import write_file
from sparsedp.report.demo import story

resource = pytest.importorskip("resource")  # limits of a process: POSIX only

SCENE = """
import autograd.numpy as np
start = np.linspace(0.5, 1.5, 40)
loss = lambda u: np.sum(u**3)
problem = lambda power: (lambda s: s**power, 1.0)
work_precision_options = dict(problem=problem, methods={"a": {}}, over={"power": [2, 3]}, repeats=1)
"""
LIMITED = """
import resource, signal, sys
import numpy as np
import sparsedp as dp
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # a write beyond the limit is an OSError, as on a full disk
limit = lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
"""


def process(code, *arguments, **options):
    """Python code in a process of its own, on the plain kernels: they write no file of their own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "SPARSEDP_NUMBA": "0", "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", code, *map(str, arguments)]
    options = {"capture_output": True, "text": True, "timeout": 300, **options}
    return subprocess.run(command, env=environment, check=False, **options)


def contents(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# ---- one function writes every file --------------------------------------------------------------------------------


def test_no_other_file_opens_one_for_writing():
    """Every file of the package that writes calls `write_file`; the command line opens the null device."""
    calls = [(module.place, node) for module in modules() for node in module.nodes(ast.Call)]
    modes = [
        (place, next((a.value for a in [*node.args, *(k.value for k in node.keywords)] if is_mode(a)), "r"))
        for place, node in calls
        if called(node) in ("open", "fdopen")
    ]
    assert {place for place, mode in modes if set(mode) & set("wax+")} == {"io/atomic_files.py", "__main__.py"}
    assert not [place for place, node in calls if called(node) in ("write_text", "write_bytes")]


def is_mode(node):
    return isinstance(node, ast.Constant) and isinstance(node.value, str) and set(node.value) <= set("rwaxbt+")


def test_a_write_that_fails_in_the_middle_leaves_what_was_there(tmp_path):
    path = tmp_path / "table.csv"

    def half(stream):
        stream.write(b"half")
        raise OSError(28, "No space left on device")

    for before in (None, b"whole"):
        if before:
            path.write_bytes(before)
        known = contents(tmp_path)
        with pytest.raises(OSError, match="No space left on device: .*table.csv"):
            write_file(path, half)
        with pytest.raises(KeyboardInterrupt):
            write_file(path, lambda stream: signal.raise_signal(signal.SIGINT))
        assert contents(tmp_path) == known


def test_what_a_new_file_keeps_of_the_old_one(tmp_path):
    """Its mode, and the link that leads to it; a pipe is written into, not replaced."""
    path = tmp_path / "net.npz"
    link = tmp_path / "link.npz"
    path.write_bytes(b"old")
    path.chmod(0o600)
    link.symlink_to(path)
    write_file(link, "new ü")
    assert link.is_symlink() and path.read_text(encoding="utf-8") == "new ü"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    write_file(tmp_path / "pipe", b"into it")
    assert os.read(reader, 99) == b"into it" and stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode)
    os.close(reader)
    with pytest.raises(IsADirectoryError):
        write_file(tmp_path, b"")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        write_file(tmp_path / "nowhere" / "a", b"")
    with pytest.raises(OSError, match="File name too long"):
        write_file(tmp_path / ("a" * 5000), b"")
    write_file(tmp_path / ("a" * 255), b"longest")  # the name that it has until it is whole is no longer
    assert set(contents(tmp_path)) == {"net.npz", "link.npz", "a" * 255}


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere")
def test_a_file_that_may_not_be_changed_is_not_replaced(tmp_path):
    path = tmp_path / "net.npz"
    path.write_bytes(b"old")
    path.chmod(0o400)
    with pytest.raises(PermissionError):
        write_file(path, b"new")
    assert path.read_bytes() == b"old"


def test_a_killed_process_leaves_one_content_or_the_other(tmp_path):
    path = tmp_path / "net.npz"
    code = """
import sys
from sparsedp.io.atomic_files import write_file
number = 0
while True:
    write_file(sys.argv[1], bytes([number % 256]) * 4_000_000)
    number += 1
    print(flush=True)
"""
    for pause in (0.0, 0.004, 0.013):
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        with subprocess.Popen([sys.executable, "-c", code, path], env=environment, stdout=subprocess.PIPE) as running:
            running.stdout.readline()
            time.sleep(pause)
            running.kill()
        content = path.read_bytes()
        assert len(content) == 4_000_000 and len(set(content)) == 1


# ---- what the library writes, with no room for it ------------------------------------------------------------------

WRITERS = {
    "network.save": "dp.network.save(path, {'w': np.arange(size) * 1.0})",
    "table.save": "dp.work_precision(lambda n: (lambda s: s**n, 1.0), {'a' * (size // 2): {}}, {'n': [2]}, repeats=1,"
    " scene='path').save(folder)",
    "work_precision(file)": "dp.work_precision(lambda n: (lambda s: s**n, 1.0), {'a' * (size // 8): {}},"
    " {'n': [2, 3, 4]}, repeats=1, file=path)",
    "checkpoint": "dp.minimize(lambda x: (x**2).sum(), np.linspace(-1, 1, size), 'gd', maxiter=3, rate=0.1,"
    " tolerance=0, checkpoint=folder)",
    "animate": "dp.animate(dp.Grid((size // 20, 9)), [np.eye(size // 20, 9)] * 3, path)",
}


ALIKE = {"table.save", "animate", "work_precision(file)"}  # what they write goes the way of the others


@pytest.mark.sampled(0)
@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.whole] if n in ALIKE else []) for n in WRITERS])
def test_no_room(tmp_path, name):
    """The second, larger write fails: the files of the first one stand there, and nothing else."""
    if name == "animate":
        pytest.importorskip("matplotlib")
    code = LIMITED + (
        f"folder, path, write = sys.argv[1], sys.argv[1] + '/path', lambda size: {WRITERS[name]}\n"
        "write(80 if 'animate' in sys.argv[2] else 8)\n"
        "print('first', flush=True)\n"
        "sys.stdin.readline()\n"
        "limit(3000)\n"
        "write(20000 if 'animate' not in sys.argv[2] else 600)\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "SPARSEDP_NUMBA": "0"}
    options = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", code, tmp_path, name], env=environment, **options) as running:
        assert running.stdout.readline() == "first\n"
        before = contents(tmp_path)
        if name == "checkpoint":  # another start is another run: it takes an empty folder
            before = {}
            for path in tmp_path.iterdir():
                path.unlink()
        _, printed = running.communicate("go\n", timeout=300)
    after = contents(tmp_path)
    assert running.returncode == 1 and "OSError: [Errno 27] File too large: " in printed.splitlines()[-1]
    assert before or name == "checkpoint"
    if name == "work_precision(file)":  # each row is a write of its own: those that found room are there, whole
        rows = after.pop("path")
        assert rows.startswith(before.pop("path")) and rows.endswith(b"\n") and len(rows) < 3000
    assert after == before


@pytest.mark.whole
@pytest.mark.parametrize("room", [150, *(pytest.param(room, marks=pytest.mark.whole) for room in (5000, 12000))])
def test_a_report_without_room(tmp_path, room):
    (tmp_path / "scene.py").write_text(SCENE, encoding="utf-8")
    code = LIMITED + (
        "from sparsedp.__main__ import main\n"
        f"limit({room})\n"
        "sys.exit(main(['report', sys.argv[1] + '/scene.py', '--out', sys.argv[1] + '/out']))"
    )
    done = process(code, tmp_path)
    assert done.returncode == 2 and done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert "cannot be written: File too large; make room, or write elsewhere" in done.stderr
    written = contents(tmp_path / "out")
    assert all(len(content) < room and not name.endswith(".part") for name, content in written.items())
    assert "report.md" not in written


UNCHECKED = """
class Verdict:
    verdict, lines = "agrees", ()
dp.check.gradient = lambda *_, **options: Verdict()
"""


@pytest.mark.whole
def test_a_demo_without_room(tmp_path):
    code = (
        LIMITED
        + UNCHECKED
        + (
            "from sparsedp.__main__ import main\n"
            "from sparsedp.report.demo import story\n"
            "story.ITERATIONS = 2\n"
            "limit(200)\n"
            "sys.exit(main(['demo', '--size', '12', '--out', sys.argv[1]]))"
        )
    )
    done = process(code, tmp_path)
    assert done.returncode == 2, done.stderr
    assert done.stderr.splitlines()[-1].endswith("cannot be written: File too large; make room, or write elsewhere")
    assert not contents(tmp_path)


COMMAND = "import sys\nfrom sparsedp.__main__ import main\nsys.exit(main(sys.argv[1:]))"


@pytest.mark.whole
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="this system has no full device")
@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_a_verdict_that_cannot_be_printed_is_none(tmp_path, stream):
    """The exit code is 2, and not the one of the verdict; nor Python's own for a stream that fails at the end."""
    (tmp_path / "scene.py").write_text(SCENE, encoding="utf-8")
    broken = SCENE.replace("loss = ", "print('words ' * 9999)\nloss = ")
    (tmp_path / "talks.py").write_text(broken, encoding="utf-8")
    name = "scene.py" if stream == "stdout" else "talks.py"
    with open("/dev/full", "w") as full:
        options = {"capture_output": False, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, stream: full}
        done = process(COMMAND, "check", tmp_path / name, **options)
    assert done.returncode == 2
    if stream == "stdout":
        sentence = "the output cannot be written: No space left on device; make room, or write elsewhere"
        assert done.stderr == f"sparsedp: {sentence}\n"


@pytest.mark.whole
def test_a_reader_that_goes_away(tmp_path):
    (tmp_path / "scene.py").write_text(SCENE, encoding="utf-8")
    reader, writer = os.pipe()
    os.close(reader)
    options = {"capture_output": False, "stdout": writer, "stderr": subprocess.PIPE}
    done = process(COMMAND, "check", tmp_path / "scene.py", **options)
    os.close(writer)
    assert done.returncode == 2 and "the output cannot be written: Broken pipe" in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.whole
def test_a_name_that_cannot_be_printed(tmp_path, monkeypatch, capsys):
    """A folder with a name that is no text: the report is there, the last line cannot be shown."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.py").write_text(SCENE, encoding="utf-8")
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding="ascii", write_through=True))
    assert main(["report", "scene.py", "--out", "Ausgabe-ü"]) == 2
    assert "the output cannot be written: 'ascii' codec can't encode" in capsys.readouterr().err


@pytest.mark.whole
def test_a_file_that_came_during_the_demo_is_not_overwritten(tmp_path, monkeypatch, capsys):
    class Verdict:
        verdict = "agrees"
        lines = ()

    def slow(*_, **options):
        (tmp_path / "table.csv").write_text("mine")
        return Verdict()

    monkeypatch.setattr(story, "ITERATIONS", 1)
    monkeypatch.setattr(dp.check, "gradient", slow)
    monkeypatch.setitem(sys.modules, "matplotlib", None)  # pictures take longest
    assert main(["demo", "--size", "12", "--out", str(tmp_path)]) == 2
    assert "table.csv is there already; name another folder with --out, or write --force" in capsys.readouterr().err
    assert contents(tmp_path) == {"table.csv": b"mine"}
    assert main(["demo", "--size", "12", "--out", str(tmp_path), "--force"]) == 0
    assert contents(tmp_path)["table.csv"].startswith(b"grid,iterations")


def test_a_run_goes_on_from_the_state_before_the_disk_was_full(tmp_path, monkeypatch):
    """The state that found no room is not there, and the one before it takes the run to the same bits."""
    monkeypatch.setattr("sparsedp.optimize.checkpoint.SHARE", np.inf)
    loss = lambda x: ((x - 1) ** 4).sum()
    start = np.linspace(-1, 1, 9)
    whole = dp.minimize(loss, start, maxiter=8, tolerance=0)
    fsync = os.fsync
    room = [11]

    def full(handle):
        room[0] -= 1
        if room[0] < 0:
            raise OSError(28, "No space left on device")
        return fsync(handle)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left on device: .*state-"):
        dp.minimize(loss, start, maxiter=8, tolerance=0, checkpoint=tmp_path)
    monkeypatch.setattr(os, "fsync", fsync)
    assert not list(tmp_path.glob("*.part"))
    best = dp.minimize(loss, start, maxiter=8, tolerance=0, checkpoint=tmp_path)
    assert best.resumed.startswith("resumed from iteration ") and "skipped" not in best.resumed
    assert np.array_equal(best.x, whole.x) and best.evaluations == whole.evaluations
