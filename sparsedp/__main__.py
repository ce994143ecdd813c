"""The command line: ``python -m sparsedp`` with the commands demo, check, report, compile and ranks.

Exit codes of check and report: 0 the gradient agrees, 1 it disagrees, 3 the result is inconclusive, 2 the input is
invalid or a file cannot be written, 130 the command was interrupted.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

REFUSED = 2  # exit code for invalid input, the same as that of argparse
INTERRUPTED = 130  # exit code after Ctrl-C, the same as that of a shell
LONGEST_WORD = 200  # longer words, such as paths, are shortened in messages
EXIT_CODES = {"agrees": 0, "disagrees": 1, "inconclusive": 3}
COMPILED_MODULES = [
    "sparsedp.kernels.elimination",
    "sparsedp.kernels.fluxes",
    "sparsedp.kernels.interpolation",
    "sparsedp.kernels.projection",
    "sparsedp.kernels.stencil",
    "sparsedp.kernels.substitution",
    "sparsedp.solvers.structured_multigrid.loops",
]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    arguments : sequence of str, optional
        Command-line arguments. Default: those of the process.

    Returns
    -------
    int
        Exit code: 0 success or "agrees", 1 failure or "disagrees", 2 invalid input or a file that cannot be written,
        3 "inconclusive", 130 interrupted.
    """
    try:
        options = _parser().parse_args(arguments)
        code = options.run(options)
        print(end="", flush=True)  # flush: a failure to write must be raised before the exit code is returned
        return code
    except KeyboardInterrupt:
        return refuse("interrupted; there is no result", INTERRUPTED)
    except (OSError, UnicodeEncodeError) as error:
        return _refuse_output(error)
    except (ValueError, ImportError) as error:  # raised for invalid input; the message explains it
        return refuse(error)


def _refuse_output(error: OSError | UnicodeEncodeError) -> int:
    """Print that a file or the standard output cannot be written, and return the exit code."""
    place = getattr(error, "filename", None)
    reason = getattr(error, "strerror", None)
    if place is None:
        sys.stdout = open(os.devnull, "w")  # the flush at exit would fail and change the exit code
    advice = "" if "; " in (reason or "") else "; make room, or write elsewhere"
    return refuse(f"{place or 'the output'} cannot be written: {reason or error}{advice}")


class Parser(argparse.ArgumentParser):
    """An ArgumentParser that prints one sentence for an invalid command line, without the usage text."""

    def error(self, message: str) -> NoReturn:
        """Print the message, refer to --help, and exit."""
        self.exit(refuse(f"{message}; see {self.prog} --help"))


def refuse(reason: object, code: int = REFUSED) -> int:
    """Print an error message on one line of stderr and return the exit code."""
    words = []
    for word in str(reason).split():
        words.append(word if len(word) <= LONGEST_WORD else f"{word[: LONGEST_WORD // 2]}...")
    with contextlib.suppress(OSError):  # if stderr cannot be written either, only the exit code reports the error
        print("sparsedp:", *words, file=sys.stderr)
    return code


def _parser() -> Parser:
    """Return the parser of command-line arguments."""
    parser = Parser(prog="python -m sparsedp", description="Sparse differentiable physics.")
    subparsers = parser.add_subparsers(required=True, metavar="command")
    for name, command in COMMANDS.items():
        subparser = subparsers.add_parser(name, help=command.description, description=command.description)
        for argument in command.arguments:
            subparser.add_argument(argument, **ARGUMENTS[argument])
        subparser.set_defaults(run=command.run)
    return parser


# ---------------------------------------------------------------- commands
# Each takes the options and returns an exit code. It imports the modules that it needs itself, so that --help and an
# invalid command line load none.


def run_check(options: argparse.Namespace) -> int:
    """Check the derivative of a function that is defined in a file or a module."""
    from sparsedp.check.choice import DERIVATIVES, check_derivative
    from sparsedp.report.scene_file import errors_as_value_error, load_scene

    names = {kind: getattr(options, kind) for kind in DERIVATIVES if getattr(options, kind) is not None}
    scene = load_scene(options.scene, names)
    with errors_as_value_error(options.scene):
        chosen = {} if options.convention is None else {"convention": options.convention}
        audit = check_derivative(scene.loss, scene.x, quick=options.quick, **scene.derivatives, **chosen)
    print(audit)
    return EXIT_CODES[audit.verdict]


def run_report(options: argparse.Namespace) -> int:
    """Write the report on a loss that is defined in a file."""
    from sparsedp.report.scene_file import free_folder, load_scene
    from sparsedp.report.scene_report import PAGES, write_report

    folder = options.out or free_folder(Path("sparsedp-report"), PAGES, options.force)
    verdict, lines = write_report(load_scene(options.scene), folder, options.force)
    print(*lines, f"{verdict}; see {folder / 'report.html'}", sep="\n")
    return EXIT_CODES[verdict]


def run_compile(_: argparse.Namespace) -> int:
    """Compile all loops; return 1 if a loop cannot be compiled."""
    from sparsedp import kernels
    from sparsedp._utils.progress import bar
    from sparsedp.kernels import team

    if not kernels.compiled():
        return refuse("there is nothing to compile: numba is not installed or switched off; install sparsedp[fast]")
    for name in COMPILED_MODULES:
        importlib.import_module(name)
    print(f"compiling {len(team.loops)} loops, those that are not on disk yet", flush=True)
    start = time.perf_counter()
    loops = bar(team.loops, needed=False, unit="loop", leave=False, disable=None)  # None: only on a terminal
    if not all(loop.compiled is not None for loop in loops):
        print("these loops do not work here; NumPy is used")
        return 1
    print(f"done in {time.perf_counter() - start:.1f} s")
    return 0


def run_ranks(_: argparse.Namespace) -> int:
    """Print whether MPI and PETSc are installed; return 1 if fields cannot be distributed over several processes."""
    from sparsedp.parallel.selftest import report

    line = ""
    for line in report():
        print(line or "ranks do not work here", flush=True)
    return 0 if line else 1


def run_demo(options: argparse.Namespace) -> int:
    """Run the demo; return 1 if a result is wrong."""
    from sparsedp.report.demo import story, terrain
    from sparsedp.report.scene_file import claim_folder, free_folder

    ground = terrain.load(options.input)
    grids = story.grids_for(ground, options.size)
    folder = options.out or free_folder(Path("sparsedp-demo"), story.FILES, options.force)
    claim_folder(folder, story.FILES, options.force)
    is_right = story.run(story.prepare(ground, grids), folder, options.force)
    return 0 if is_right else 1


class Command(NamedTuple):
    """A command: the function that runs it, its description, and the names of its arguments."""

    run: Callable[[argparse.Namespace], int]
    description: str
    arguments: tuple[str, ...] = ()


ARGUMENTS: dict[str, Any] = {
    "scene": {
        "help": "FILE.py:NAME, FILE.py:NAME:POINT or MODULE:NAME; default names: loss, and start or x for the point"
    },
    "--input": {"type": Path, "metavar": "FILE", "help": "a 2-D field as .npy, .npz or .png (default: terrain)"},
    "--size": {"type": int, "default": 64, "metavar": "N", "help": "cells along the longest side (default: 64)"},
    "--out": {"type": Path, "metavar": "DIR", "help": "folder for the results (default: a new folder sparsedp-...)"},
    "--force": {"action": "store_true", "help": "overwrite results of an earlier run"},
    "--gradient": {"metavar": "NAME", "help": "gradient(x) of the loss, if it is not differentiated by this library"},
    "--vjp": {"metavar": "NAME", "help": "vjp(x, g): the function may have results of any shape"},
    "--jvp": {"metavar": "NAME", "help": "jvp(x, t)"},
    "--jacobian": {"metavar": "NAME", "help": "the Jacobian matrix, or a function J(x) that returns it"},
    "--hessian": {"metavar": "NAME", "help": "the Hessian of the loss: a matrix, H(x) or H(x, v)"},
    "--convention": {
        "choices": ("transpose", "adjoint"),
        "help": "inner product of complex cotangents, for --vjp (default: that of the library of the function)",
    },
    "--quick": {"action": "store_true", "help": "examine fewer directions: 40 to 60 runs if the derivative is right"},
}
COMMANDS = {
    "demo": Command(
        run_demo,
        "recover an unknown ground, whose field is a real terrain, from well readings by adjoint optimization",
        ("--input", "--size", "--out", "--force"),
    ),
    "check": Command(
        run_check,
        "check the gradient of a loss in a file or a module, or another derivative of any function. "
        "Exit code: 0 agrees, 1 disagrees, 3 inconclusive, 2 invalid input, 130 interrupted",
        ("scene", "--gradient", "--vjp", "--jvp", "--jacobian", "--hessian", "--convention", "--quick"),
    ),
    "report": Command(
        run_report,
        "write a report on a loss in a file into a folder: gradient check, plan, certificate, error against run time, "
        "stress tests; the file may define dicts of arguments, work_precision_options and stress_options. Exit code as "
        "check",
        ("scene", "--out", "--force"),
    ),
    "compile": Command(run_compile, "compile all loops for this machine now instead of at their first use"),
    "ranks": Command(
        run_ranks,
        "print whether MPI and PETSc are installed, and test them with two processes. Exit code: 0 works, 1 does not",
    ),
}


if __name__ == "__main__":
    sys.exit(main())
