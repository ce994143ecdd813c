"""Samples of cross products contain every pair, are small, and are the same in every run."""

from itertools import combinations, product

import pairwise
import pytest


def pairs(rows, ways=2):
    return {values for row in rows for values in combinations(enumerate(row), ways)}


@pytest.mark.parametrize("ways", [1, 2, 3])
def test_every_pair_occurs_in_few_rows(ways):
    rows = [row for row in product("abcdef", "ghi", "jklm", "no") if row[0] != "a" or row[3] == "n"]
    found = [rows[n] for n in pairwise.sampled_rows(rows, ways)]
    assert pairs(found, ways) == pairs(rows, ways)
    assert len(found) <= {1: 6, 2: 30, 3: 85}[ways]
    assert pairwise.sampled_rows(rows, ways) == pairwise.sampled_rows(rows, ways)


def test_short_lists():
    assert pairwise.sample([]) == []
    assert pairwise.sample([("a",), ("b",)]) == [("a",), ("b",)]
    assert pairwise.sampled_rows([(0, 1), (0, 1)]) != []


@pytest.mark.sampled
@pytest.mark.parametrize("c", range(4))
@pytest.mark.parametrize("a, b", [(0, 1), (2, 3)])
@pytest.mark.parametrize("d", range(4))
def test_a_marked_test_is_sampled(a, b, c, d, request):
    """Each pair occurs in two of 32 cases, so that 16 are in the sample; the others have the marker `whole`."""
    name = request.node.originalname
    of_this = [item for item in request.session.items if getattr(item, "originalname", None) == name]
    inside = {
        tuple(item.callspec.params[name] for name in "acd") for item in of_this if not item.get_closest_marker("whole")
    }
    assert len(of_this) < 32 or len(pairs(inside)) == 8 + 8 + 16
