"""Fields on ranks: one process without MPI, and the scripts of tests/ranks/ if MPI and PETSc are installed."""

import sys
from functools import cache

import numpy as np
import pytest
from launch import COUNTS, on_ranks, printed
from pages import blocks
from sources import ROOT

import sparsedp as dp

PARTS = 6  # of the table of transport
pytestmark = pytest.mark.xdist_group("ranks")  # several processes at a time are enough
run = cache(printed)  # a run serves several tests
FUNCTIONS = "cannot be applied to fields on ranks, because its rows are not known"


def test_one_process_keeps_its_grid_and_imports_nothing(monkeypatch):
    monkeypatch.delitem(sys.modules, "mpi4py.MPI", raising=False)
    grid = dp.Grid((3, 2))
    u = np.ones(4)
    assert dp.distribute(grid) is grid and dp.gather(u) is u
    assert "mpi4py.MPI" not in sys.modules


# ------------------------------------------------------------ on ranks


@on_ranks
@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("what", ["fields", "solves", "flow", "steps", "transport", "explain", "ensemble", "newton"])
def test_as_on_one_process(what, count):
    assert run(f"{what}_on_ranks.py", count).endswith("all agree\n")


@on_ranks
@pytest.mark.whole
@pytest.mark.parametrize("part", [0, 1, *(pytest.param(k, marks=pytest.mark.slow) for k in range(2, PARTS))])
def test_every_transport(part):
    assert printed("transport_on_ranks.py", 2 + part % 3, str(part), str(PARTS)).endswith("all agree\n")


@on_ranks
@pytest.mark.whole
def test_products_with_jacobians_have_the_same_bits():
    assert len({run("newton_on_ranks.py", *how).splitlines()[0] for how in ((1,), (2,), (3, "bits"), (4,))}) == 1


@on_ranks
@pytest.mark.parametrize("count", COUNTS)
def test_minimize(count):
    assert printed("minimize_on_ranks.py", count).endswith("all agree\n")


@on_ranks
@pytest.mark.whole
def test_the_blocks_of_the_readme():
    assert printed("readme_blocks.py", 2).endswith("all agree\n")


@on_ranks
@pytest.mark.whole
def test_the_program_of_the_guide(tmp_path):
    """It prints once, with the loss and the gradient of one process."""
    page = blocks((ROOT / "docs" / "guides" / "ranks_and_ensembles.md").read_text(encoding="utf-8"))
    numbers = [number for number, block in enumerate(page) if "is_first" in block.text]
    (tmp_path / "scene.py").write_text("\n".join(page[number].text for number in numbers), encoding="utf-8")
    expected = "".join(f"{page[number + 1].text}\n" for number in numbers)
    assert len(numbers) == 2 and printed(tmp_path / "scene.py", 2) == expected


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


@on_ranks
@pytest.mark.whole
def test_set_ups_leave_no_memory_behind():
    assert printed("memory.py", 2).endswith("all agree\n")


OTHERS = [pytest.param(*pair, marks=pytest.mark.whole) for pair in ((1, 2), (2, 4), (4, 2), (2, 2))]


@on_ranks
@pytest.mark.parametrize("first, then", [(2, 1), *OTHERS])
def test_a_run_goes_on_where_another_number_of_ranks_left_it(tmp_path, first, then):
    """minimize by its folder, to rounding; steps of a rollout by a file of NumPy, on ranks to the same bits."""
    kept = tmp_path / "kept"
    whole = tmp_path / "whole"
    for folder in (kept, whole):
        folder.mkdir()
    runs = [(first, kept, 3), (then, kept, 6), (then, whole, 6), (then, whole, 6)]
    _, resumed, once, again = [
        [line.split(None, 3) for line in printed("resumes.py", n, str(f), str(k)).splitlines()] for n, f, k in runs
    ]
    for there, here in zip(resumed, [*once[:2], again[2]], strict=True):
        assert float(there[1]) == pytest.approx(float(here[1]), rel=1e-6)
        assert there[2] == here[2] or first != then and (there[0] != "steps" or 1 in (first, then))
    assert [line[3] for line in resumed[:2]] == ["resumed from iteration 3"] * 2
    assert once[2] != again[2]
