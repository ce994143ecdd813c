"""The command line: ``python -m sparsedp`` with demo, check, report, compile or ranks.

Exit codes of check and report: 0 agrees, 1 disagrees, 3 inconclusive, 2 the input was refused or a file cannot be
written, 130 interrupted.
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

REFUSED = 2  # exit code of a bad input, the same as argparse's
INTERRUPTED = 130  # exit code after Ctrl-C, the same as a shell's
LONGEST_WORD = 200  # letters of a name that a message shows
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
        Default: those of the process.

    Returns
    -------
    int
        Exit code: 0 done or agrees, 1 failed or disagrees, 2 the input was refused or a file cannot be written,
        3 inconclusive, 130 interrupted.
    """
    try:
        options = _parser().parse_args(arguments)
        code = options.run(options)
        print(end="", flush=True)  # an output that cannot be written must be known before the exit code
        return code
    except KeyboardInterrupt:
        return refuse("interrupted; there is no result", INTERRUPTED)
    except (OSError, UnicodeEncodeError) as error:
        return _refuse_output(error)
    except (ValueError, ImportError) as error:  # the message says what is wrong with the input
        return refuse(error)


def _refuse_output(error: OSError | UnicodeEncodeError) -> int:
    """Say that a file or the output cannot be written."""
    place = getattr(error, "filename", None)
    reason = getattr(error, "strerror", None)
    if place is None:
        sys.stdout = open(os.devnull, "w")  # Python flushes again at its end, which would change the exit code
    advice = "" if "; " in (reason or "") else "; make room, or write elsewhere"
    return refuse(f"{place or 'the output'} cannot be written: {reason or error}{advice}")


class Parser(argparse.ArgumentParser):
    """An ArgumentParser that answers a wrong command line with one sentence."""

    def error(self, message: str) -> NoReturn:
        """Print the message and exit."""
        self.exit(refuse(f"{message}; see {self.prog} --help"))


def refuse(reason: object, code: int = REFUSED) -> int:
    """Print a reason on one line of stderr and return the exit code."""
    words = []
    for word in str(reason).split():
        words.append(word if len(word) <= LONGEST_WORD else f"{word[: LONGEST_WORD // 2]}...")
    with contextlib.suppress(OSError):  # if stderr is broken too, the exit code has to suffice
        print("sparsedp:", *words, file=sys.stderr)
    return code


def _parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(prog="python -m sparsedp", description="Sparse differentiable physics.")
    subparsers = parser.add_subparsers(required=True, metavar="command")
    for name, command in COMMANDS.items():
        subparser = subparsers.add_parser(name, help=command.description, description=command.description)
        for argument in command.arguments:
            subparser.add_argument(argument, **ARGUMENTS[argument])
        subparser.set_defaults(run=command.run)
    return parser


# ---------------------------------------------------------------- commands: options to exit code
# Modules are imported inside, so that --help and a wrong command line load nothing.


def run_check(options: argparse.Namespace) -> int:
    """Audit the gradient of a loss in a file."""
    from sparsedp.check.gradient_check import gradient
    from sparsedp.report.scene_file import guarded, load_scene

    scene = load_scene(options.scene)
    with guarded(options.scene):
        audit = gradient(scene.loss, scene.x, quick=options.quick)
    print(audit)
    return EXIT_CODES[audit.verdict]


def run_report(options: argparse.Namespace) -> int:
    """Write the report on a loss in a file."""
    from sparsedp.report.scene_file import free_folder, load_scene
    from sparsedp.report.scene_report import PAGES, write_report

    folder = options.out or free_folder(Path("sparsedp-report"), PAGES, options.force)
    verdict, lines = write_report(load_scene(options.scene), folder, options.force)
    print(*lines, f"{verdict}; see {folder / 'report.html'}", sep="\n")
    return EXIT_CODES[verdict]


def run_compile(_: argparse.Namespace) -> int:
    """Compile all loops; the exit code is 1 if one does not compile."""
    from sparsedp import kernels
    from sparsedp._utils.progress import bar
    from sparsedp.kernels import team

    if not kernels.compiled():
        return refuse("there is nothing to compile: numba is not installed or switched off; install sparsedp[fast]")
    for name in COMPILED_MODULES:
        importlib.import_module(name)
    print(f"compiling {len(team.loops)} loops, those that are not on disk yet", flush=True)
    start = time.perf_counter()
    loops = bar(team.loops, needed=False, unit="loop", leave=False, disable=None)  # None: a bar on a terminal only
    if not all(loop.compiled is not None for loop in loops):
        print("these loops do not work here; NumPy is used")
        return 1
    print(f"done in {time.perf_counter() - start:.1f} s")
    return 0


def run_ranks(_: argparse.Namespace) -> int:
    """Print what of MPI and PETSc is installed; the exit code is 1 if fields cannot lie on several processes."""
    from sparsedp.parallel.selftest import report

    line = ""
    for line in report():
        print(line or "ranks do not work here", flush=True)
    return 0 if line else 1


def run_demo(options: argparse.Namespace) -> int:
    """Run the demo."""
    from sparsedp.report.demo import story, terrain
    from sparsedp.report.scene_file import claim_folder, free_folder

    ground = terrain.load(options.input)
    grids = story.grids_for(ground, options.size)
    folder = options.out or free_folder(Path("sparsedp-demo"), story.FILES, options.force)
    claim_folder(folder, story.FILES, options.force)
    is_right = story.tell(story.prepare(ground, grids), folder, options.force)
    return 0 if is_right else 1


class Command(NamedTuple):
    """A command: what it runs, its description, and the names of its arguments."""

    run: Callable[[argparse.Namespace], int]
    description: str
    arguments: tuple[str, ...] = ()


ARGUMENTS: dict[str, Any] = {
    "scene": {"help": "FILE.py, FILE.py:loss or FILE.py:loss:start; by default the names are loss, and start or x"},
    "--input": {"type": Path, "metavar": "FILE", "help": "a 2-D field as .npy, .npz or .png (default: terrain)"},
    "--size": {"type": int, "default": 64, "metavar": "N", "help": "cells along the longest side (default: 64)"},
    "--out": {"type": Path, "metavar": "DIR", "help": "where the results go (default: a new folder sparsedp-...)"},
    "--force": {"action": "store_true", "help": "overwrite results of an earlier run"},
    "--quick": {"action": "store_true", "help": "two directions only, for a loss that takes minutes"},
}
COMMANDS = {
    "demo": Command(
        run_demo,
        "find the hidden ground under a real terrain from well readings, by adjoint optimization",
        ("--input", "--size", "--out", "--force"),
    ),
    "check": Command(
        run_check,
        "audit the gradient of a loss in a file. Exit code: 0 agrees, 1 disagrees, 3 inconclusive, 2 refused, "
        "130 interrupted",
        ("scene", "--quick"),
    ),
    "report": Command(
        run_report,
        "audit, plan, certificate, error against run time and stress of a loss in a file, in one folder; the file may "
        "hold dicts of arguments, work_precision_options and stress_options. Exit code as check",
        ("scene", "--out", "--force"),
    ),
    "compile": Command(run_compile, "compile all loops for this machine now, not at their first use"),
    "ranks": Command(
        run_ranks, "what of MPI and PETSc is here, and a test by two processes. Exit code: 0 works, 1 does not"
    ),
}


if __name__ == "__main__":
    sys.exit(main())
