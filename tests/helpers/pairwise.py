"""Samples of cross products of parameters in which every pair of values occurs.

A test with the mark `sampled` runs by default on such a sample of its parameters; the other cases have the marker
`whole`, and .ci/run runs them. With ``sampled(1)`` every value occurs, not every pair: for two long lists. With
``sampled(0)`` one case runs: for cases that take the same path through the code. Faults that need three values together
may show only in the whole product.
"""

import random
from itertools import combinations

SEED = 14


def sampled_rows(rows, ways=2, name=""):
    """Return the numbers of the rows of a sample, found greedily in a shuffled order.

    Parameters
    ----------
    rows : list of tuple
    ways : int
        Size of the groups of values that must occur: 2 for pairs.
    name : str
        Seeds the order: two tests with the same product run on different rows.
    """
    order = random.Random(f"{SEED} {name}").sample(range(len(rows)), len(rows))
    columns = [list(enumerate(row)) for row in rows]
    groups = [set(combinations(values, min(ways, len(values)))) for values in columns]
    missing = set().union(*groups)
    selected = []
    while missing:
        best = max(order, key=lambda number: len(groups[number] & missing))
        selected.append(best)
        missing -= groups[best]
    return sorted(selected)


def numbered(values):
    """Return values as numbers, in the order of their first occurrence; values are compared by their text."""
    numbers = {}
    return tuple(numbers.setdefault(repr(value), len(numbers)) for value in values)


def sample(rows, ways=2):
    """Return the rows of a sample, each a tuple of values."""
    columns = [numbered(column) for column in zip(*rows)]
    return [rows[number] for number in sampled_rows(list(zip(*columns)), ways)]


def skipped_items(items):
    """Yield the collected tests whose function has the mark `sampled` and whose parameters are not in the sample.

    Tests that have the marker `whole` for one of their parameters are not part of the product.
    """
    cases_by_function = {}
    for item in items:
        mark = item.get_closest_marker("sampled")
        if mark and not item.get_closest_marker("whole"):
            function = item.nodeid.split("[")[0]
            cases_by_function.setdefault(function, (mark, []))[1].append(item)
    for function, (mark, cases) in cases_by_function.items():
        parameters = cases[0].callspec.params
        columns = [numbered(case.callspec.params[name] for case in cases) for name in parameters]
        selected = set(sampled_rows(list(zip(*columns)), *mark.args, name=function.split("::")[-1]))
        for number, case in enumerate(cases):
            if number not in selected:
                yield case
