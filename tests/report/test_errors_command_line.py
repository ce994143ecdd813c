"""`python -m sparsedp check` and `report`: verdicts, exit codes, the folder, and refusals in one sentence."""

import csv
import importlib.util
import os
import re
import signal
import subprocess
import sys

import pytest
from sources import ROOT

from sparsedp.__main__ import main

SCENE = """
import sys

import autograd.numpy as np

import sparsedp as dp

print("arguments:", sys.argv[1:])
grid = dp.Grid((8, 8), size=1.0)
solve = dp.inverse(-dp.laplacian(grid, dp.dirichlet), "krylov", rtol=1e-8)
x, _ = grid.centres()
start = np.sin(3 * x)
cube = dp.differentiable("cube", lambda u: u**3, lambda nums, ans, u: lambda g: (3.003 * u**2 * g,))


def loss(b):
    return np.sum(solve(b) ** 2)


def wrong(b):
    return np.sum(cube(solve(b)))


def kinked(b):
    return np.sum(np.abs(b - start[4, 4]))


def broken(b):
    raise LookupError("no such well")


def point_load(method, cells):
    box = dp.Grid((cells, cells), size=1.0)
    deflection, centre = dp.inverse(-dp.laplacian(box, dp.dirichlet), method), dp.sample(box, [[0.5, 0.5]])
    return lambda s: centre(deflection(s * np.ones(box.shape)))[0], 1.0


stress_options = {"ranges": (-2.0, 2.0), "only": ["as given", "not finite"]}
work_precision_options = dict(
    problem=point_load, methods={"direct": {"method": "direct"}}, over={"cells": [8, 16]},
    reference=(0.07367135328151, 0.07367135328151), repeats=1,
)
"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "poisson.py"
    path.write_text(SCENE, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "name, code, word", [("loss", 0, "agrees"), ("wrong", 1, "disagrees"), ("kinked", 3, "inconclusive")]
)
def test_check(scene, capsys, name, code, word):
    assert main(["check", f"{scene}:{name}"]) == code
    printed = capsys.readouterr()
    assert f"verdict: {word}" in printed.out
    assert "arguments: []" in printed.err  # what the file prints stays out of the table


def test_check_at_another_point(scene, capsys):
    assert main(["check", f"{scene}:loss:x"]) == 0
    assert main(["check", str(scene)]) == 0


STRANGERS = {
    "without a guard": (
        "grid = dp.Grid(9, size=1.0)\nstart = np.ones(9)\nL = dp.laplacian(grid, dp.dirichlet)\n"
        "loss = lambda u: np.sum(L(u) ** 2)\nprint(dp.minimize(loss, start, maxiter=2))",
        "",
        0,
        "agrees",
    ),
    "a tuple as the point": ("start = (np.ones(3), 2.0)\nloss = lambda p: np.sum(p[0] ** 3) * p[1]", "", 0, "agrees"),
    "two arguments": ("x = (np.ones(3), 2.0)\ndef energy(u, k):\n    return k * np.sum(u**3)", ":energy", 0, "agrees"),
    "one that prints": ("x = np.ones(3)\ndef loss(u):\n    print('here')\n    return np.sum(u**3)", "", 0, "agrees"),
    "a constant": ("x = np.ones(3)\nloss = lambda u: 0 * np.sum(u)", "", 3, "constant to rounding"),
    "no function": ("x = np.ones(3)", "", 2, ""),
    "no Python": ("def loss(x)\n    return x", "", 2, ""),
}


@pytest.mark.parametrize("kind", STRANGERS)
def test_files_as_strangers_write_them(tmp_path, monkeypatch, capsys, kind):
    """What the file or the loss prints goes to stderr; a refusal is one line."""
    text, name, code, word = STRANGERS[kind]
    (tmp_path / "scene.py").write_text("import autograd.numpy as np\nimport sparsedp as dp\n" + text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert main(["check", f"scene.py{name}"]) == code
    printed = capsys.readouterr()
    assert word in printed.out and "here" not in printed.out and "Minimum" not in printed.out
    assert code != 2 or (printed.out == "" and len(printed.err.splitlines()) == 1)


@pytest.mark.whole
def test_the_report(scene, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["report", str(scene), "--out", str(out)]) == 0
    page = (out / "report.md").read_text(encoding="utf-8")
    assert page.startswith("# poisson: agrees")
    assert "fastest at a gradient error of 1 %: direct" in page
    assert "skipped: multigrid hierarchy" in page and "skipped: 10^4 steps" in page
    assert "may stop at" in page
    assert (
        "of 1 %: direct (cells=16, method=direct), " in page and "no method reaches a gradient error of 0.1 %" in page
    )
    places = "## Which method for which error?", "fastest at", "## Work of one gradient", "skipped: multigrid"
    assert sorted(places, key=page.index) == list(places)  # each sentence stands under its question
    assert "[audit.md](audit.md)" in page and "[point_load.csv](point_load.csv)" in page
    table = (out / "point_load.md").read_text(encoding="utf-8")
    assert "| method | cells | unknowns |" in table and "| * |" in table  # the settings that tell rows apart
    names = {path.name for path in out.iterdir()}
    assert names >= {
        f"{name}.{kind}" for name in ("audit", "plan", "certificate", "stress", "point_load") for kind in ("md", "csv")
    }
    drawn = {"audit.png", "point_load.png"} if importlib.util.find_spec("matplotlib") else set()
    assert {path.name for path in out.glob("*.png")} == drawn
    for path in out.glob("*.csv"):
        with path.open(encoding="utf-8", newline="") as stream:
            assert list(csv.DictReader(stream)), path
    whole = (out / "report.html").read_text(encoding="utf-8")
    places = "<h1>poisson</h1>", "<strong>agrees</strong>", "Is the gradient right?", "V. For a wrong one", "fastest at"
    assert sorted(places, key=whole.index) == list(places)
    assert whole.count('src="data:image/png;base64,') == len(drawn) and ("<polyline" in whole) == (not drawn)
    assert not re.search(r"https?:|@import|url\(|<link|src=\"(?!data:)", whole)  # one file, no network
    assert whole.count("<section>") == 5 and "<tbody>\n</tbody>" not in whole
    assert "<li>multigrid hierarchy" in whole.partition("<summary>What was skipped</summary>")[2]
    assert main(["report", str(scene), "--out", str(out)]) == 2
    assert "is there already; name another folder with --out, or write --force" in capsys.readouterr().err
    assert main(["report", f"{scene}:wrong", "--out", str(out), "--force"]) == 1
    page = (out / "report.md").read_text(encoding="utf-8")
    assert page.startswith("# poisson-wrong: disagrees") and "culprit: cube" in page


def test_what_a_report_leaves_out_and_what_is_degraded(tmp_path, capsys):
    (tmp_path / "cool.py").write_text(
        "import autograd.numpy as np\n\nloss, x = lambda nu: np.exp(-3.0 * nu), 0.5\n", encoding="utf-8"
    )
    main(["report", str(tmp_path / "cool.py"), "--out", str(tmp_path / "out")])
    printed = capsys.readouterr().out
    line = "error against run time: not measured, the file gives no work_precision_options (problem, methods, over)"
    assert line in printed.splitlines()
    degraded = int(re.search(r"(\d+) degraded", printed)[1])
    page = (tmp_path / "out" / "report.md").read_text(encoding="utf-8")
    cases = "case is" if degraded == 1 else "cases are"
    assert (f"{degraded} stiff or extreme {cases} degraded, see below." in page) == (degraded > 0)


@pytest.mark.whole
def test_a_report_of_a_loss_that_does_not_run(scene, tmp_path, capsys):
    assert main(["report", f"{scene}:broken", "--out", str(tmp_path / "out")]) == 3
    assert "gradient: not audited, LookupError: no such well" in capsys.readouterr().out
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "<li>gradient: not audited, LookupError: no such well</li>" in page and "Is the gradient right?" not in page


def test_as_a_command(scene):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "sparsedp", "check", "poisson.py:kinked"]
    done = subprocess.run(command, cwd=scene.parent, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 3 and "verdict: inconclusive" in done.stdout


FOREIGN = """
import numpy as np


def start():
    return np.linspace(1.0, 2.0, 5)


def cube(u):
    return u**3


def cube_vjp(u, g):
    return 3 * u**2 * g


def cube_jvp(u, t):
    return 3 * u * t


def jacobian(u):
    return np.diag(3 * u**2)


def total(u):
    return float(np.sum(u**3))


def slope(u):
    return 3 * u**2


def bend(u, v):
    return 6 * u * v


class Simulator:
    apply = staticmethod(cube)
    vjp = staticmethod(cube_vjp)


simulator = Simulator()
"""
FOREIGN_CHECKS = [
    ("cube --vjp cube_vjp", "agrees"),
    ("cube --jvp cube_jvp", "disagrees"),
    ("cube --vjp cube_vjp --jvp cube_jvp", "disagrees"),
    ("cube --jacobian jacobian", "agrees"),
    ("total --gradient slope --quick", "agrees"),
    ("total --hessian bend --gradient slope", "agrees"),
    ("simulator", "agrees"),
]


@pytest.mark.parametrize("words, verdict", FOREIGN_CHECKS)
def test_derivatives_of_functions_of_a_module(tmp_path, monkeypatch, capsys, words, verdict):
    (tmp_path / "some_model.py").write_text(FOREIGN, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "some_model", raising=False)
    name, *options = words.split()
    assert main(["check", f"some_model:{name}", *options]) == {"agrees": 0, "disagrees": 1}[verdict]
    assert f"verdict: {verdict}" in capsys.readouterr().out
    assert main(["check", f"some_model.py:{name}", *options]) == {"agrees": 0, "disagrees": 1}[verdict]


def test_a_derivative_that_is_not_there(tmp_path, monkeypatch, capsys):
    (tmp_path / "some_model.py").write_text(FOREIGN, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert main(["check", "some_model.py:cube", "--vjp", "pull"]) == 2
    assert "some_model.py has no 'pull'; write --vjp NAME with a name that it defines" in capsys.readouterr().err
    assert main(["check", "no_model:cube"]) == 2
    assert "no_model does not run: ModuleNotFoundError: No module named 'no_model'" in capsys.readouterr().err
    assert main(["check", "some_model.py:cube", "--vjp", "cube_vjp", "--gradient", "slope"]) == 2
    assert "one derivative is checked at a time, got gradient and vjp" in capsys.readouterr().err


def test_the_convention_of_complex_cotangents(tmp_path, monkeypatch, capsys):
    text = (
        "import numpy as np\n\nx = np.exp(1j * np.arange(4.0))\n\n\ndef square(z):\n    return z**2\n\n\n"
        "def adjoint(z, g):\n    return np.conj(2 * z) * g\n"
    )
    (tmp_path / "waves.py").write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert main(["check", "waves.py:square", "--vjp", "adjoint"]) == 1
    assert "write convention='adjoint'" in capsys.readouterr().out
    assert main(["check", "waves.py:square", "--vjp", "adjoint", "--convention", "adjoint"]) == 0


def test_a_report_of_an_object(tmp_path, monkeypatch, capsys):
    (tmp_path / "some_model.py").write_text(FOREIGN, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert main(["report", "some_model.py:simulator"]) == 2
    message = (
        "a report is on a function that returns one number, got an object of the class Simulator; "
        "write python -m sparsedp check for its derivative"
    )
    assert message in capsys.readouterr().err and not (tmp_path / "sparsedp-report").exists()
    text = "import numpy as np\n\nx = np.ones(4)\n\n\ndef loss(u):\n    return np.sum(np.pad(u, 1)[2:] * u)\n"
    (tmp_path / "plain.py").write_text(text, encoding="utf-8")
    assert main(["report", "plain.py"]) == 2
    message = (
        "its code is for NumPy arrays only, and a report is on gradients by reverse mode; write it with "
        "autograd.numpy, or write python -m sparsedp check with --gradient NAME"
    )
    assert f"plain cannot be audited: ValueError: {message}" in capsys.readouterr().err


REFUSALS = [
    ("poisson", "'poisson' names no function; write FILE.py:NAME, FILE.py:NAME:POINT, or MODULE:NAME"),
    ("none.py", "there is no file none.py; name one that is there"),
    ("poisson.py:nothing", "poisson.py has no function 'nothing'; write poisson.py:NAME of the function to examine"),
    ("poisson.py:start", "poisson.py has no function 'start'; write poisson.py:NAME of the function to examine"),
    ("poisson.py:loss:y", "poisson.py has no 'y', the point; write poisson.py:loss:NAME"),
    ("bare.py", "bare.py has no 'start or x', the point; write bare.py:loss:NAME"),
    ("ends.py", "ends.py does not run: line 2: ZeroDivisionError: division by zero"),
    ("typo.py", "typo.py does not run: line 1: SyntaxError: "),
    ("imports.py", "imports.py does not run: line 2: SyntaxError: "),
    ("options.py", "stress_options in options.py must be a dict of arguments, got int"),
    ("poisson.py:broken", "poisson.py:broken cannot be audited: LookupError: no such well"),
    ("poisson.py:grid", "poisson.py has no function 'grid'; write poisson.py:NAME of the function to examine"),
]


@pytest.mark.parametrize("target, sentence", REFUSALS)
def test_refusals(scene, monkeypatch, capsys, target, sentence):
    monkeypatch.chdir(scene.parent)
    for name, text in {
        "bare.py": "loss = abs",
        "ends.py": "y = 0\n1 / y",
        "typo.py": "a b",
        "imports.py": "\nimport typo",
        "options.py": "loss, x, stress_options = abs, 1.0, 3",
    }.items():
        (scene.parent / name).write_text(text, encoding="utf-8")
    assert main(["check", target]) == 2
    assert sentence in capsys.readouterr().err


def test_a_folder_that_cannot_be(scene, tmp_path, capsys):
    assert main(["report", str(scene), "--out", str(scene)]) == 2
    assert "cannot be created: File exists; name another with --out" in capsys.readouterr().err


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_is_closed(scene, tmp_path, capsys):
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o500)
    assert main(["report", str(scene), "--out", str(closed)]) == 2
    assert "closed cannot be written to; name another with --out" in capsys.readouterr().err


# ---- a loss that ends the program ----------------------------------------------------------------------------------

ENDS = {
    "sys.exit(0)": "SystemExit: 0",
    "sys.exit()": "SystemExit: ",
    "sys.exit('all is well')": "SystemExit: all is well",
    "exit(0)": "SystemExit: 0",
    "quit()": "SystemExit: None",
    "os._exit(0)": "SystemExit: os._exit(0)",
    "raise GeneratorExit": "GeneratorExit: ",
    "raise asyncio.CancelledError('late')": "CancelledError: late",
    "raise Odd(0)": "Odd: 0",
}
ERRORS = {
    "raise OSError(28, 'No space left', 'data.npy')": "OSError: [Errno 28] No space left: 'data.npy'",
    "open('nowhere.npy')": "FileNotFoundError: [Errno 2] No such file or directory: 'nowhere.npy'",
    "assert False": "AssertionError: ",
    "nonsense": "NameError: name 'nonsense' is not defined",
    "raise MemoryError('too large')": "MemoryError: too large",
    "raise TimeoutError": "TimeoutError: ",
    "raise StopIteration": "StopIteration",  # a generator on its way turns it into a RuntimeError that names it
    "raise Exception('odd')": "Exception: odd",
}
ENDING = """
import asyncio, os, sys
import autograd.numpy as np
class Odd(BaseException): pass
start, calls = np.linspace(0.5, 1.5, 4), []
{top}
def loss(u):
    calls.append(1)
    if len(calls) > {after}:
        {end}
    return np.sum(u**3)
"""


@pytest.fixture
def ending(tmp_path, monkeypatch):
    """Write a file with a statement in its loss, from the evaluation after n others on, or at the top."""
    monkeypatch.chdir(tmp_path)

    def write(end="pass", after=0, top=""):
        (tmp_path / "ends.py").write_text(ENDING.format(end=end, after=after, top=top), encoding="utf-8")

    return write


@pytest.mark.parametrize("after", [0, 7])
@pytest.mark.parametrize("end", ENDS)
def test_a_loss_that_ends_the_program_is_no_verdict(ending, capsys, end, after):
    ending(end, after)
    for command in (["check", "ends.py"], ["report", "ends.py"]):
        assert main(command) == 2
        printed = capsys.readouterr()
        assert printed.out == "" and re.fullmatch(r"sparsedp: ends(\.py)? cannot be audited: [^\n]*\n", printed.err)
        assert f"{ENDS[end]}; it ended the program, let it return its value" in printed.err
    assert not list(os.scandir("sparsedp-report"))


@pytest.mark.parametrize("end", ENDS)
def test_a_file_that_ends_the_program_is_no_verdict(ending, capsys, end):
    ending(top=end)
    for command in ("check", "report"):
        assert main([command, "ends.py"]) == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert printed.err.startswith(f"sparsedp: ends.py does not run: line 6: {ENDS[end]}".strip())


@pytest.mark.parametrize("after", [0, 7])
@pytest.mark.parametrize("end", ERRORS)
def test_a_loss_that_raises_is_no_verdict(ending, capsys, end, after):
    """`check` refuses; `report` writes what there is, and is inconclusive, never the 1 of a traceback."""
    ending(end, after)
    codes = main(["check", "ends.py"]), main(["report", "ends.py"])
    printed = capsys.readouterr()
    assert codes == (2, 3)
    for text, place in ((printed.err, "ends.py cannot be audited: "), (printed.out, "gradient: not audited, ")):
        assert place in text and ERRORS[end].strip() in text


@pytest.mark.whole
@pytest.mark.parametrize("end", [pytest.param("sys.exit(0)", marks=pytest.mark.whole), "os._exit(0)"])
def test_an_exit_as_a_command(ending, tmp_path, end):
    ending(end)
    arguments = [sys.executable, "-m", "sparsedp", "report", "ends.py"]
    options = {"env": {**os.environ, "PYTHONPATH": str(ROOT)}, "capture_output": True, "text": True, "check": False}
    done = subprocess.run(arguments, cwd=tmp_path, **options)
    assert done.returncode == 2 and done.stdout == "" and f"cannot be audited: {ENDS[end]}" in done.stderr


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes do not fork here")
def test_a_child_process_may_end_as_it_likes(ending, capsys):
    """Child processes of multiprocessing end in this way."""
    ending(
        top="if not (child := os.fork()): os._exit(7)\nassert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7"
    )
    end = os._exit
    assert main(["check", "ends.py"]) == 0
    assert os._exit is end and "verdict: agrees" in capsys.readouterr().out


@pytest.mark.whole
def test_a_wrong_gradient_behind_a_rollout_is_a_verdict(tmp_path, capsys):
    """Exit code 1 of both commands; the search for the culprit raises nothing."""
    (tmp_path / "run.py").write_text(
        "import autograd.numpy as np\nimport sparsedp as dp\nx = np.linspace(1.0, 2.0, 4)\n"
        "cube = dp.differentiable('cube', lambda u: u**3, lambda nums, ans, u: lambda g: (3.003 * u**2 * g,))\n"
        "stress_options = {'only': ['as given']}\n"
        "def loss(u):\n    return np.sum(cube(dp.rollout(lambda v, p: 0.9 * v, u, None, 3)))\n",
        encoding="utf-8",
    )
    assert main(["check", str(tmp_path / "run.py"), "--quick"]) == 1
    assert "culprit: cube, its VJP is off by" in capsys.readouterr().out
    assert main(["report", str(tmp_path / "run.py"), "--out", str(tmp_path / "out")]) == 1
    assert "culprit: cube" in (tmp_path / "out" / "report.md").read_text(encoding="utf-8")


# ---- Ctrl-C, and names that are too long ---------------------------------------------------------------------------

WAITING = """
import sys, time
import autograd.numpy as np
start = np.ones(3)
def wait():
    print("now", file=sys.stderr, flush=True)
    time.sleep(60)
{top}
def loss(u):
    wait()
    return np.sum(u**3)
"""


@pytest.mark.whole
@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize(
    "command, top",
    [
        ("check", "wait()"),
        ("report", ""),
        pytest.param("check", "", marks=pytest.mark.whole),
        pytest.param("report", "wait()", marks=pytest.mark.whole),
    ],
)
def test_ctrl_c(tmp_path, command, top):
    (tmp_path / "waits.py").write_text(WAITING.format(top=top), encoding="utf-8")
    assert interrupted(tmp_path, "now", command, "waits.py") == (130, "", "sparsedp: interrupted; there is no result\n")
    assert not list(tmp_path.glob("sparsedp-report/*"))


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_ctrl_c_in_the_demo(tmp_path):
    """While the optimizer runs: it may keep its best point, but the demo ends, and no file is written."""
    code, _, told = interrupted(tmp_path, "3", "demo", "--size", "24")
    assert code == 130 and told.splitlines()[-1] == "sparsedp: interrupted; there is no result"
    assert not list(tmp_path.glob("sparsedp-demo/*"))


def interrupted(folder, word, *arguments):
    """Send Ctrl-C to a command once a line begins with a word; return (exit code, stdout, stderr)."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    command = [sys.executable, "-m", "sparsedp", *arguments]
    stream = "stdout" if arguments[0] == "demo" else "stderr"
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=folder, env=environment, **options) as running:
        for line in getattr(running, stream):
            if line.split()[:1] == [word]:
                break
        running.send_signal(signal.SIGINT)
        printed, told = running.communicate(timeout=60)
    return running.returncode, printed, told


LONG = "a" * 5000


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (["check", LONG], r"'a+\.\.\. names no function; write FILE.py:NAME, FILE.py:NAME:POINT, or MODULE:NAME"),
        (["check", f"{LONG}.py"], r"there is no file a+\.\.\. name one that is there"),
        (["check", f"scene.py:{LONG}"], r"scene.py has no function 'a+\.\.\. write scene.py:NAME of the function to e"),
        (["check", f"scene.py:loss:{LONG}"], r"scene.py has no 'a+\.\.\. the point; write scene.py:loss:NAME"),
        (["report", f"{LONG}/{LONG}.py"], r"there is no file a+\.\.\. name one that is there"),
        (
            ["report", "scene.py", "--out", LONG],
            r"a+\.\.\. cannot be created: File name too long; name another ",
        ),
        pytest.param(
            ["report", f"scene.py:{'b' * 255}"],
            r".*b+\.\.\. cannot be written: File name too long; shorten the name, most file systems take up to 255 b",
            marks=pytest.mark.whole,
        ),
        (
            ["demo", "--out", LONG],
            r"a+\.\.\. cannot be created: File name too long; name another with --out",
        ),
        (["demo", "--input", f"{LONG}.npy"], r"a+\.\.\. is not there or is no plain file; give the path of a .npy, "),
        (["demo", "--size", LONG], r"argument --size: invalid int value: 'a+\.\.\. see python -m sparsedp demo --help"),
        ([LONG], r"argument command: invalid choice: 'a+\.\.\. \(choose from .*; see python -m sparsedp --help"),
    ],
)
def test_a_name_of_5000_letters(tmp_path, monkeypatch, capsys, arguments, sentence):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.py").write_text(
        f"import autograd.numpy as np\nstart = np.ones(3)\nloss = {'b' * 255} = lambda u: np.sum(u**2)\n"
        f"work_precision_options = dict(problem=lambda n: (loss, start), methods={{'a': {{'n': 1}}}}, scene='b' * 255)"
    )
    try:
        code = main(arguments)
    except SystemExit as ended:
        code = ended.code
    printed = capsys.readouterr()
    assert code == 2 and printed.out == ""
    assert re.match(f"sparsedp: {sentence}", printed.err) and len(printed.err) < 500
    assert len(printed.err.splitlines()) == 1
