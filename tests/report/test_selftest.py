"""`python -m sparsedp ranks`: what it says where something is missing or does not work, and where all is well."""

import sys
from sysconfig import get_path

import pytest
from launch import SETTINGS, on_ranks

from sparsedp.__main__ import main
from sparsedp.parallel import selftest

ROOT_USER = "mpirun has detected an attempt to run as root."
NUMPY = "ValueError: numpy.dtype size changed, may indicate binary incompatibility. Expected 96, got 88 from PyObject"
OTHER_MPI = (
    "RuntimeError: 2 processes were started, but mpi4py belongs to another MPI and finds one; reinstall it for this MPI"
)


def no_module(name):
    return f"ModuleNotFoundError: No module named '{name}'"


@pytest.mark.parametrize(
    "wrong, told",
    [
        (no_module("mpi4py"), "python -m pip install mpi4py"),
        (
            no_module("petsc4py"),
            "apt-get install -y --no-install-recommends python3-petsc4py && ls -d /usr/lib/petscdir/*/"
            f"*-real/lib/python3/dist-packages > {get_path('purelib')}/petsc.pth (not on Debian: conda install "
            "-c conda-forge petsc4py)",
        ),
        ("No such file or directory: 'mpirun'", "apt-get install -y --no-install-recommends openmpi-bin"),
        (ROOT_USER, "export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1"),
        (NUMPY, 'python -m pip install "numpy<2"'),
        (OTHER_MPI, "python -m pip install --force-reinstall --no-binary mpi4py mpi4py"),
    ],
)
def test_what_is_missing_or_wrong_is_named_with_a_command(wrong, told, monkeypatch, capsys):
    monkeypatch.setattr(selftest, "run", lambda command: (["found"], wrong))
    assert main(["ranks"]) == 1
    assert capsys.readouterr().out.splitlines() == ["found", f"{wrong}; write {told}", "ranks do not work here"]


@pytest.mark.parametrize(
    "said, told",
    [
        (f"-----\n{ROOT_USER}\n\nRunning as root is discouraged", ROOT_USER),
        (f"Traceback\n  File numpy.py\n{NUMPY}\n--\nMPI_ABORT", NUMPY),
        ("", "exit code 1"),
    ],
)
def test_failures_are_reported_in_one_line(said, told):
    script = f"import sys; print('Python'); sys.stderr.write({said!r}); sys.exit(1)"
    assert selftest.run([sys.executable, "-c", script]) == (["Python"], told)


def test_what_cannot_be_started_or_does_not_end(monkeypatch):
    monkeypatch.setattr(selftest, "TIMEOUT", 0.1)
    assert selftest.run(["/nowhere/mpirun"]) == ([], "[Errno 2] No such file or directory: '/nowhere/mpirun'")
    assert selftest.run([sys.executable, "-c", "import time; time.sleep(9)"])[1].endswith("timed out after 0.1 seconds")


@on_ranks
def test_two_processes(monkeypatch, capsys):
    for name, value in SETTINGS.items():
        monkeypatch.setenv(name, value)
    assert main(["ranks"]) == 0
    versions, mpi, petsc, solve, end = capsys.readouterr().out.splitlines()
    assert versions.startswith("Python 3.") and mpi.startswith("mpi4py ") and petsc.endswith(" for float64, with hypre")
    assert solve.startswith("Poisson's equation on 2 processes: value and gradient within ")
    assert end == "ranks work; write mpirun -n 2 python -m mpi4py scene.py"


@on_ranks
def test_a_wrong_gradient_is_reported(monkeypatch):
    monkeypatch.setattr(selftest, "TOLERANCE", -1.0)
    with pytest.raises(
        ArithmeticError, match=r"^a gradient differs by 0.0e\+00 \(relative\) from that of one process$"
    ):
        next(selftest.compare())
