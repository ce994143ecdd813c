"""A backward pass from several results at once."""

from sparsedp.tape import backward

__all__ = ["pull_ends"]


class Ends:
    """Stands for the last node of a graph with several results: hands each its cotangent."""

    __slots__ = ("_cotangents", "parents")

    def __init__(self, nodes, cotangents):
        self.parents, self._cotangents = nodes, cotangents

    def vjp(self, g):
        """The cotangents, in the order of the results."""
        return self._cotangents


def pull_ends(nodes, cotangents, roots):
    """Nodes of results and their cotangents -> cotangent of each root, None where there is none."""
    if not nodes:
        return [None] * len(roots)
    found = backward(Ends(nodes, cotangents), None)
    return [found.get(root) for root in roots]
