"""Blocks of README.md with ``dp.distribute`` put around their grids: they print what README shows, on every rank.

mpirun -n 2 python -m mpi4py tests/ranks/readme_blocks.py
"""

import io
import re
from contextlib import redirect_stdout
from pathlib import Path

from mpi4py import MPI

from sparsedp.parallel.layout import SUPPORTED

COMM = MPI.COMM_WORLD
README = Path(__file__).parents[2] / "README.md"
# What tells a block: the solve and its check, coefficients and minimize, ink, stiff steps, smoke.
WORDS = "u in the middle: ", "pressure fitted", "derivatives through 100 steps", "mass at t = 1", "dp.projection(room)"


def blocks():
    """(code, what it prints) of the blocks that are run, in their order; each goes on from those before."""
    found = re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    chosen = [(code, output) for code, output in found if any(word in code for word in WORDS)]
    assert len(chosen) == len(WORDS), [code for code, _ in chosen]
    return chosen


def distributed(code):
    """The code with every grid on ranks."""
    return re.sub(r"dp\.Grid\(\((.*?)\), size=1\.0\)", r"dp.distribute(dp.Grid((\1), size=1.0))", code)


def main():
    """Run them; those that need transport as soon as that works on ranks."""
    names: dict = {}
    for code, output in blocks():
        if "dp.transport" in code and "transport" not in SUPPORTED:
            continue
        assert ("dp.Grid(" in code) == ("dp.distribute(" in distributed(code))
        printed = io.StringIO()
        with redirect_stdout(printed):
            exec(distributed(code), names)
        assert printed.getvalue() == output, (printed.getvalue(), output)
    assert names["grid"].layout is not None


if __name__ == "__main__":
    main()
    COMM.Barrier()
    if COMM.rank == 0:
        print("all agree")
