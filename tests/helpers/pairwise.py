"""Samples of cross products: in the rows that are chosen every pair of values occurs that occurs in any row.

A test with the mark `sampled` runs on such rows of its parameters; the other rows have the marker `whole`. With
`sampled(1)` every value occurs, not every pair: for two long lists. Faults that three parameters make together are left
to the whole product, which .ci/run goes through.
"""

import random
from itertools import combinations

SEED = 14


def chosen(rows, ways=2, name=""):
    """Numbers of the rows of a sample: tuples of n values each, found greedily in a shuffled order.

    The order depends on the name: tests of the same product run on other rows of it.
    """
    order = random.Random(f"{SEED} {name}").sample(range(len(rows)), len(rows))
    columns = [list(enumerate(row)) for row in rows]
    pairs = [set(combinations(values, min(ways, len(values)))) for values in columns]
    missing = set().union(*pairs)
    found = []
    while missing:
        found.append(max(order, key=lambda n: len(pairs[n] & missing)))
        missing -= pairs[found[-1]]
    return sorted(found)


def numbered(values):
    """Values as numbers, in the order in which they come first; what cannot be hashed is known by its text."""
    numbers = {}
    return tuple(numbers.setdefault(repr(value), len(numbers)) for value in values)


def sample(rows, ways=2):
    """The rows of a sample, each a tuple of values."""
    return [rows[n] for n in chosen(list(zip(*map(numbered, zip(*rows)))), ways)]


def left_out(items):
    """Collected tests whose function has the mark `sampled` and whose parameters are not in the sample.

    What has the marker `whole` already, for one of its parameters, is no part of the product.
    """
    functions = {}
    for item in items:
        if (mark := item.get_closest_marker("sampled")) and not item.get_closest_marker("whole"):
            functions.setdefault(item.nodeid.split("[")[0], (mark, []))[1].append(item)
    for function, (mark, members) in functions.items():
        rows = zip(*(numbered(item.callspec.params[name] for item in members) for name in members[0].callspec.params))
        inside = chosen(list(rows), *mark.args, name=function.split("::")[-1])
        yield from (item for number, item in enumerate(members) if number not in inside)
