"""What can be known about a structure without listing its entries: magnitudes, diagonal, components.

A structure may answer for itself with a method ``magnitude()``, which returns a function
x -> an upper bound of |A| x for x >= 0. Everything else is found from the factors, from the entries,
or, for bare functions, by probing.
"""

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from sparsedp.grid import Grid
from sparsedp.structure.base import Scaled
from sparsedp.structure.factor import Factor
from sparsedp.structure.kronecker import Kronecker, Term
from sparsedp.structure.lazy import Chain, Diagonal, Sum

__all__ = [
    "components_of_entries",
    "components_of_factors",
    "diagonal_of_factors",
    "is_sum_of_factors",
    "magnitude",
    "probes",
    "rescaled",
]

PROBES = 3  # random vectors with which a map without entries is examined


def magnitude(structure):
    """Structure -> function x -> upper bound of |A| x, entry by entry, for x >= 0."""
    if hasattr(structure, "magnitude"):
        return structure.magnitude()
    if isinstance(structure, Kronecker):
        return _absolute_kronecker(structure).product
    if isinstance(structure, Diagonal):
        return lambda x: np.abs(structure.values) * x
    if isinstance(structure, Scaled):
        inner = magnitude(structure.inner)
        return lambda x: abs(structure.factor) * inner(x)
    if isinstance(structure, Chain):
        members = [magnitude(member) for member in structure.members]
        return lambda x: _in_turn(members, x)
    if isinstance(structure, Sum):
        members = [magnitude(member) for member in structure.members]
        return lambda x: sum(member(x) for member in members)
    if structure.has_entries:
        return abs(structure.explicit()).dot
    return _probed_magnitude(structure)


def _in_turn(members, x):
    for member in reversed(members):
        x = member(x)
    return x


def _absolute_kronecker(structure):
    return Kronecker(
        structure.out_parts,
        structure.in_parts,
        {key: tuple(map(_absolute_term, terms)) for key, terms in structure.blocks.items()},
    )


def _absolute_term(term):
    return Term(abs(term.scale), tuple(factor and Factor(abs(factor.matrix)) for factor in term.factors))


def _probed_magnitude(structure):
    """A map that only acts: the largest response to random signs stands for every row."""
    largest = max((np.max(np.abs(structure.product(x)), initial=0.0) for x in probes(structure.shape[1])), default=0.0)
    return lambda x: np.full(structure.shape[0], largest * np.max(np.abs(x), initial=0.0))


def probes(size):
    """The same few vectors of random signs in every run."""
    generator = np.random.default_rng(0)
    return [generator.choice([-1.0, 1.0], size) for _ in range(PROBES)]


def rescaled(grid):
    """The grid with its lengths divided by powers of two, so that volumes are near 1, and so are their squares."""
    widths = [np.ldexp(h, -int(np.frexp(np.max(h, initial=0.0))[1])) for h in grid.widths]
    return Grid(grid.shape, spacing=widths, periodic=grid.periodic)


def is_sum_of_factors(structure):
    """Whether the map is a Kronecker sum: one 1-D factor for each term."""
    return isinstance(structure, Kronecker) and structure.separable


def diagonal_of_factors(structure):
    """Diagonal of a Kronecker sum."""
    shape = structure.out_parts[0]
    total = np.zeros(shape)
    for term in structure.blocks.get((0, 0), ()):
        if not term.axes:
            total += term.scale
        for axis in term.axes:
            line = term.scale * term.factors[axis].matrix.diagonal()
            total += line.reshape([-1 if a == axis else 1 for a in range(len(shape))])
    return total.reshape(-1)


def components_of_entries(matrix, active):
    """Matrix -> (labels, count): which unknowns are linked by entries that are not 0.

    What is not active is linked to nothing (None: all are). Labels None: one component, everywhere.
    """
    links = matrix.tocoo()
    keep = links.data != 0
    if active is not None:
        keep &= active[links.row] & active[links.col]
    pattern = csr_array((np.ones(np.count_nonzero(keep)), (links.row[keep], links.col[keep])), shape=matrix.shape)
    count, labels = connected_components(pattern, directed=False)
    return (None, 1) if count == 1 else (labels, count)


def components_of_factors(structure):
    """Components of a Kronecker sum are the products of the components along the axes."""
    shape = structure.out_parts[0]
    labels, count = np.zeros(shape, dtype=np.int64), 1
    factors = {axis: term.factors[axis] for term in structure.blocks.get((0, 0), ()) for axis in term.axes}
    for axis, n in enumerate(shape):
        here, line = n, np.arange(n)
        if axis in factors:
            here, line = connected_components(factors[axis].matrix, directed=False)
        labels = labels * here + line.reshape([-1 if a == axis else 1 for a in range(len(shape))])
        count *= here
    return (None, 1) if count == 1 else (labels.reshape(-1), count)
