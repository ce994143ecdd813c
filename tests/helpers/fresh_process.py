"""Python programs in processes that are forked from one that has imported the libraries, but not this package.

A fork takes milliseconds, a start of Python and the imports of NumPy, SciPy and matplotlib a second. The package itself
is imported anew in each process, from the folders of PYTHONPATH.
"""

import multiprocessing
import os
import runpy
import subprocess
import sys
import tempfile
from pathlib import Path

from sources import ROOT

LIBRARIES = ["numpy", "scipy.fft", "scipy.linalg", "scipy.sparse.linalg", "autograd.numpy", "pyamg", "pytest"]
FOR_EXAMPLES = ["matplotlib.pyplot", "numba"]


def run_python(program, arguments, folder, environment, timeout=1800):
    """Run a script, or a module as python -m does, and return a CompletedProcess with what it printed.

    Parameters
    ----------
    program : str
        The path of a script, or the name of a module.
    arguments : list of str
        Its command line.
    folder : Path
        The working directory.
    environment : dict
        All environment variables of the process.
    timeout : float
        Seconds after which the process is killed and TimeoutError is raised.
    """
    is_script = program.endswith(".py")
    if "forkserver" not in multiprocessing.get_all_start_methods():  # as on Windows
        command = [sys.executable, program] if is_script else [sys.executable, "-m", program]
        options = {"cwd": folder, "env": environment, "capture_output": True, "text": True, "timeout": timeout}
        return subprocess.run([*command, *arguments], check=False, **options)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([*LIBRARIES, *FOR_EXAMPLES, __name__])
    with tempfile.TemporaryDirectory() as logs:
        output = Path(logs, "stdout")
        errors = Path(logs, "stderr")
        description = (program, is_script, arguments, folder, environment, output, errors)
        process = context.Process(target=_run, args=description, daemon=False)
        process.start()
        process.join(timeout)
        if process.exitcode is None:
            process.kill()
            raise TimeoutError(f"{program} {' '.join(arguments)} has not ended after {timeout} s")
        return subprocess.CompletedProcess(
            [program, *arguments],
            process.exitcode,
            output.read_text(encoding="utf-8"),
            errors.read_text(encoding="utf-8"),
        )


def _run(program, is_script, arguments, folder, environment, output, errors):
    for stream, path in ((1, output), (2, errors)):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), stream)
    multiprocessing.set_start_method(None, force=True)  # it was set to that of this process
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    sys.dont_write_bytecode = "PYTHONDONTWRITEBYTECODE" in environment
    first = [str(Path(program).parent) if is_script else str(folder), *environment["PYTHONPATH"].split(os.pathsep)]
    sys.path[:] = [*first, *(path for path in sys.path if not _is_of_this_checkout(path))]
    for name, module in [*sys.modules.items()]:  # with ROOT, the tests of a copy would test this checkout
        if _is_of_this_checkout(getattr(module, "__file__", None) or os.sep):
            del sys.modules[name]
    sys.argv = [program, *arguments]
    if is_script:
        runpy.run_path(program, run_name="__main__")
    else:
        runpy.run_module(program, run_name="__main__", alter_sys=True)


def _is_of_this_checkout(path):
    """Return whether a path belongs to this package or its tests; an environment inside the checkout does not."""
    path = Path(path).resolve()
    return path.is_relative_to(ROOT) and not path.is_relative_to(Path(sys.prefix).resolve())
