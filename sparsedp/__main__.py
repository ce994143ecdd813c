"""The command line: ``python -m sparsedp demo``, ``check FILE.py:loss``, ``report FILE.py --out DIR``, ``compile`` and
``ranks``.

Exit codes of check and report: 0 agrees, 1 disagrees, 3 inconclusive, 2 the input was refused or a file cannot be
written, 130 interrupted.
"""

import argparse
import contextlib
import importlib
import os
import sys
import time
from pathlib import Path
from typing import Any

REFUSED = 2  # exit code of a bad input, the same as argparse's
INTERRUPTED = 130  # exit code of what Ctrl-C ends, the same as a shell's
LONGEST = 200  # letters of a name that a sentence shows
CODES = {"agrees": 0, "disagrees": 1, "inconclusive": 3}
LOOPS = [  # where loops are defined
    "sparsedp.kernels.elimination",
    "sparsedp.kernels.fluxes",
    "sparsedp.kernels.interpolation",
    "sparsedp.kernels.projection",
    "sparsedp.kernels.stencil",
    "sparsedp.kernels.substitution",
    "sparsedp.solvers.multigrid.loops",
]


def main(arguments=None):
    """Command line -> exit code.

    0 done or agrees, 1 failed or disagrees, 2 the input was refused or a file cannot be written, 3 inconclusive,
    130 interrupted.
    """
    try:
        options = _parser().parse_args(arguments)
        code = options.run(options)
        print(end="", flush=True)  # what cannot be printed has to be known before the verdict is told
        return code
    except KeyboardInterrupt:
        return refuse("interrupted; there is no result", INTERRUPTED)
    except (OSError, UnicodeEncodeError) as error:
        place, why = getattr(error, "filename", None), getattr(error, "strerror", None)
        if place is None:
            sys.stdout = open(os.devnull, "w")  # or Python tries once more at its end, and changes the exit code
        advice = "" if "; " in (why or "") else "; make room, or write elsewhere"
        return refuse(f"{place or 'the output'} cannot be written: {why or error}{advice}")
    except (ValueError, ImportError) as error:  # the scene, its loss, the field or the folder: what is wrong with it
        return refuse(error)


class Parser(argparse.ArgumentParser):
    """An ArgumentParser that answers a wrong command line with one sentence."""

    def error(self, message):
        self.exit(refuse(f"{message}; see {self.prog} --help"))


def refuse(reason, code=REFUSED):
    """Print why on one line of stderr -> exit code."""
    words = [word if len(word) <= LONGEST else f"{word[: LONGEST // 2]}..." for word in str(reason).split()]
    with contextlib.suppress(OSError):  # where stderr is broken too, the exit code says it alone
        print("sparsedp:", *words, file=sys.stderr)
    return code


def _parser():
    parser = Parser(prog="python -m sparsedp", description="Sparse differentiable physics.")
    rooms = parser.add_subparsers(required=True, metavar="command")
    for name, (run, words, arguments) in COMMANDS.items():
        room = rooms.add_parser(name, help=words, description=words)
        for argument in arguments.split():
            room.add_argument(argument, **ARGUMENTS[argument])
        room.set_defaults(run=run)
    return parser


def run_check(options):
    """Options of the command `check` -> exit code."""
    from sparsedp.check.gradient_check import gradient
    from sparsedp.report.scene_report import audited, load

    source = load(options.scene)
    with audited(options.scene):
        audit = gradient(source.loss, source.x, quick=options.quick)
    print(audit)
    return CODES[audit.verdict]


def run_report(options):
    """Options of the command `report` -> exit code."""
    from sparsedp.report.scene_report import PAGES, free_folder, load, write_report

    out = options.out or free_folder(Path("sparsedp-report"), PAGES, options.force)
    verdict, lines = write_report(load(options.scene), out, options.force)
    print(*lines, f"{verdict}; see {out / 'report.html'}", sep="\n")
    return CODES[verdict]


def run_compile(_):
    """The command `compile` -> exit code: 1 where a loop does not compile."""
    from sparsedp import kernels
    from sparsedp._utils.progress import bar
    from sparsedp.kernels import team

    if not kernels.compiled():
        return refuse("there is nothing to compile: numba is not installed or switched off; install sparsedp[fast]")
    for name in LOOPS:
        importlib.import_module(name)
    print(f"compiling {len(team.loops)} loops, those that are not on disk yet", flush=True)
    start = time.perf_counter()
    watched = bar(team.loops, needed=False, unit="loop", leave=False, disable=None)  # None: where someone watches
    works = all(loop.compiled is not None for loop in watched)
    print(f"done in {time.perf_counter() - start:.1f} s" if works else "these loops do not work here; NumPy is used")
    return 0 if works else 1


def run_ranks(_):
    """The command `ranks` -> exit code: 1 where fields cannot lie on several processes."""
    from sparsedp.parallel.selftest import report

    line = ""
    for line in report():
        print(line or "ranks do not work here", flush=True)
    return 0 if line else 1


def run_demo(options):
    """Options of the command `demo` -> exit code."""
    # Here and not at the top: --help and a wrong command line load nothing.
    from sparsedp.report.demo import story, terrain
    from sparsedp.report.scene_report import claim, free_folder

    ground = terrain.load(options.input)
    grids = story.grids_for(ground, options.size)
    out = options.out or free_folder(Path("sparsedp-demo"), story.FILES, options.force)
    claim(out, story.FILES, options.force)
    return 0 if story.tell(story.prepare(ground, grids), out, options.force) else 1


ARGUMENTS: dict[str, Any] = {
    "scene": {"help": "FILE.py, FILE.py:loss or FILE.py:loss:start; by default the names are loss, and start or x"},
    "--input": {"type": Path, "metavar": "FILE", "help": "a 2-D field as .npy, .npz or .png (default: terrain)"},
    "--size": {"type": int, "default": 64, "metavar": "N", "help": "cells along the longest side (default: 64)"},
    "--out": {"type": Path, "metavar": "DIR", "help": "where the results go (default: a new folder sparsedp-...)"},
    "--force": {"action": "store_true", "help": "overwrite results of an earlier run"},
    "--quick": {"action": "store_true", "help": "two directions only, for a loss that takes minutes"},
}
COMMANDS = {  # what it runs, what it says of itself, its arguments
    "demo": (run_demo, "find the hidden ground under a real terrain from well readings, by adjoint optimization",
             "--input --size --out --force"),
    "check": (run_check, "audit the gradient of a loss in a file. Exit code: 0 agrees, 1 disagrees, 3 inconclusive, "
              "2 refused, 130 interrupted", "scene --quick"),
    "report": (run_report, "audit, plan, certificate, error against run time and stress of a loss in a file, in one "
               "folder; the file may hold dicts of arguments, work_precision_options and stress_options. "
               "Exit code as check",
               "scene --out --force"),
    "compile": (run_compile, "compile all loops for this machine now, not at their first use", ""),
    "ranks": (run_ranks, "what of MPI and PETSc is here, and a test by two processes. Exit code: 0 works, 1 not", ""),
}  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
