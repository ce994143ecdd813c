"""Fields on ranks: what a user is told in one process, and, where PETSc is installed, the scripts of tests/ranks/."""

import sys

import numpy as np
import pytest
from launch import COUNTS, on_ranks, printed

import sparsedp as dp

pytestmark = pytest.mark.xdist_group("ranks")  # several processes at a time are enough
FUNCTIONS = "cannot be cut for ranks, for no rank knows its rows; make it of operators of the grid or of a matrix"


def test_one_process_keeps_its_grid_and_imports_nothing(monkeypatch):
    monkeypatch.delitem(sys.modules, "mpi4py.MPI", raising=False)
    grid, u = dp.Grid((3, 2)), np.ones(4)
    assert dp.distribute(grid) is grid and dp.gather(u) is u
    assert "mpi4py.MPI" not in sys.modules


# ------------------------------------------------------------ on ranks


@on_ranks
@pytest.mark.parametrize("count", COUNTS)
def test_fields(count):
    assert printed("fields_on_ranks.py", count).endswith("all agree\n")


@on_ranks
@pytest.mark.parametrize("count", COUNTS)
def test_solves(count):
    assert printed("solves_on_ranks.py", count).endswith("all agree\n")


@on_ranks
@pytest.mark.whole
def test_every_operator_of_the_catalogue():
    """Within 4e-16 of one process, dot tests within 1e-15, and the same bits on 1, 2, 3 and 4 ranks."""
    runs = [[line.split(None, 2) for line in printed("catalogue_scan.py", k).splitlines()] for k in (1, 2, 3, 4)]
    assert len({len(run) for run in runs}) == 1 and len(runs[0]) > 150
    for lines in zip(*runs, strict=True):
        assert len({tuple(line[:2]) for line in lines}) == 1
        if "from_functions" in lines[0][1] or "from_linear_operator" in lines[0][1]:
            assert all(FUNCTIONS in line[2] for line in lines), lines
            continue
        figures = [line[2].split() for line in lines]
        assert all(float(error) <= 4e-16 and float(dot) <= 1e-15 for error, dot, _ in figures), lines
        assert len({digest for _, _, digest in figures}) == 1, lines
