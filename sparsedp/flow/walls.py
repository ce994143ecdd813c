"""What happens to a velocity at each side of the box: one word for each side of each bounded axis.

no_slip     a wall: nothing passes, the fluid sticks to it (moving walls enter by `face_lift`)
free_slip   a wall: nothing passes, the fluid glides along it
inflow      what passes is given: by the values the face field already has there
outflow     open: what passes is found, the pressure is 0
"""

from sparsedp.conditions import dirichlet, neumann
from sparsedp.spacing import AXES

__all__ = ["CLOSED", "WORDS", "flow_sides", "pressure_conditions"]

WORDS = ("no_slip", "free_slip", "inflow", "outflow")
CLOSED = ("no_slip", "free_slip")


def flow_sides(grid, boundary):
    """Boundary argument of a flow -> for each axis two words (lower, upper), or None where it is periodic.

    Parameters
    ----------
    grid : Grid
    boundary : str or dict
        One word for all bounded sides, or a dict with keys "x", "y", "z", each a word or a pair
        (lower, upper). Axes that are not named are no_slip.

    Returns
    -------
    tuple

    Raises
    ------
    ValueError
        If a word is none of WORDS, or an axis is named that is periodic or that the grid does not have.

    Examples
    --------
    >>> from sparsedp.grid import Grid
    >>> flow_sides(Grid((2, 2), periodic=(True, False)), {"y": ("no_slip", "free_slip")})
    (None, ('no_slip', 'free_slip'))
    """
    named = boundary if isinstance(boundary, dict) else dict.fromkeys(AXES, boundary)
    for name in named if isinstance(boundary, dict) else ():
        if name not in grid.axes:
            raise ValueError(f"the flow names axis {name!r}, but {grid} has {', '.join(grid.axes)}; leave it out")
        if grid.periodic[AXES.index(name)]:
            raise ValueError(f"axis {name} is periodic, so the flow has no wall there; leave it out")
    return tuple(
        None if periodic else _pair(axis, named.get(axis, "no_slip"))
        for axis, periodic in zip(AXES, grid.periodic, strict=False)
    )


def pressure_conditions(sides):
    """Words -> conditions of the pressure: 0 at an outflow, no slope elsewhere."""
    named = {axis: tuple(map(_of_pressure, pair)) for axis, pair in zip(AXES, sides, strict=False) if pair}
    return named or neumann


def _of_pressure(word):
    return dirichlet if word == "outflow" else neumann


def _pair(axis, entry):
    words = (entry, entry) if isinstance(entry, str) else entry
    if not (isinstance(words, (tuple, list)) and len(words) == 2 and all(word in WORDS for word in words)):
        raise ValueError(f"the flow on {axis} needs {', '.join(WORDS)} or a pair of them, got {entry!r}")
    return tuple(words)
