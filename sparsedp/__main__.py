"""The command line: ``python -m sparsedp demo``."""

import argparse
import sys
from pathlib import Path

REFUSED = 2  # exit code of a bad input, the same as argparse's


def main(arguments=None):
    """Command line -> exit code: 0 done, 1 the demo failed, 2 the input was refused."""
    options = _parser().parse_args(arguments)
    return options.run(options)


class Parser(argparse.ArgumentParser):
    """An ArgumentParser that answers a wrong command line with one sentence."""

    def error(self, message):
        self.exit(refuse(f"{message}; see {self.prog} --help"))


def refuse(reason):
    """Print why on one line of stderr -> exit code."""
    print("sparsedp:", *str(reason).split(), file=sys.stderr)
    return REFUSED


def _parser():
    parser = Parser(prog="python -m sparsedp", description="Sparse differentiable physics.")
    rooms = parser.add_subparsers(required=True, metavar="command")
    demo = rooms.add_parser(
        "demo",
        help="find the hidden ground under a real terrain from well readings",
        description="Recover a hidden field from sensor readings by adjoint optimisation, and check the gradient.",
    )
    demo.add_argument("--input", type=Path, metavar="FILE", help="a 2-D field as .npy, .npz or .png (default: terrain)")
    demo.add_argument("--size", type=int, default=64, metavar="N", help="cells along the longest side (default: 64)")
    demo.add_argument("--out", type=Path, default=Path("sparsedp-demo"), metavar="DIR", help="where the results go")
    demo.add_argument("--force", action="store_true", help="overwrite results of an earlier run")
    demo.set_defaults(run=run_demo)
    return parser


def run_demo(options):
    """Options of the command `demo` -> exit code."""
    # Here and not at the top: --help and a wrong command line load nothing.
    from sparsedp.report.demo import outputs, story, study, terrain

    try:
        ground = terrain.load(options.input)
        grids = study.grids_for(ground, options.size)
        outputs.claim(options.out, options.force)
        hidden = study.prepare(ground, grids)
    except (ValueError, OSError, ImportError) as error:
        return refuse(error)
    return 0 if story.tell(hidden, options.out, options.force) else 1


if __name__ == "__main__":
    sys.exit(main())
