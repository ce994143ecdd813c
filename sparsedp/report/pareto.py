"""The Pareto set of two costs."""

__all__ = ["unbeaten"]


def unbeaten(things, costs=lambda point: point):
    """Things that no other one beats in both costs, in the order of the first cost.

    Parameters
    ----------
    things : iterable
    costs : callable
        ``costs(thing) -> (first, second)``; default: the things are the pairs.

    Returns
    -------
    list
        The second cost falls from each to the next.

    Examples
    --------
    >>> unbeaten([(3, 1), (1, 5), (2, 6), (2, 2)])
    [(1, 5), (2, 2), (3, 1)]
    """
    kept: list = []
    for thing in sorted(things, key=costs):
        if not kept or costs(thing)[1] < costs(kept[-1])[1]:
            kept.append(thing)
    return kept
