"""Compiling at the first use: what is said, and the command that does all of it."""

import ast
import os
import subprocess
import sys

import pytest
from sources import PACKAGE

from sparsedp import __main__, kernels

NOTICE = "compiling loops and storing them for later runs; `python -m sparsedp compile` compiles all loops"
APPLY = """
import numpy as np, sparsedp as dp
op = dp.laplacian(dp.Grid((300, 400))).matrix_free()
print(op(np.ones((300, 400))).sum())
"""


def _python(folder, *words, **environment):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder), **environment}
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, env=environment, check=False)


@pytest.mark.slow
@pytest.mark.skipif(not kernels.compiled(), reason="needs numba")
def test_compilation_is_announced_once(tmp_path):
    first = _python(tmp_path, "-c", APPLY)
    assert first.stderr.count(NOTICE) == 1
    again = _python(tmp_path, "-c", APPLY)
    assert (again.stderr, again.stdout) == ("", first.stdout)


@pytest.mark.slow
@pytest.mark.skipif(not kernels.compiled(), reason="needs numba")
def test_compile_command_compiles_all_loops(tmp_path):
    done = _python(tmp_path, "-m", "sparsedp", "compile")
    assert done.returncode == 0, done.stderr
    assert "done in" in done.stdout
    assert _python(tmp_path, "-c", APPLY).stderr == ""


def test_compile_command_without_numba(tmp_path):
    answer = _python(tmp_path, "-m", "sparsedp", "compile", SPARSEDP_NUMBA="0")
    assert answer.returncode == 2
    assert "there is nothing to compile: numba is not installed or switched off" in answer.stderr


@pytest.mark.whole
def test_compile_command_lists_every_file_with_loops():
    def defines(path):
        functions = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef)]
        return any(
            isinstance(mark, ast.Call) and isinstance(mark.func, ast.Name) and mark.func.id == "kernel"
            for function in functions
            for mark in function.decorator_list
        )

    files = sorted(path for path in PACKAGE.rglob("*.py") if defines(path))
    assert sorted(__main__.COMPILED_MODULES) == [
        ".".join(("sparsedp", *path.relative_to(PACKAGE).with_suffix("").parts)) for path in files
    ]
