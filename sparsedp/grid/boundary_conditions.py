"""Boundary conditions: one for each side of each bounded axis, of a field or of a flow.

All conditions are one form, a u + b du/dn = value at the wall, n pointing outwards:
dirichlet is (1, 0), neumann is (0, 1), robin(a, b) the rest. With u_c the value in the cell next
to the wall and h its width, the wall value and the slope follow from (u_w - u_c) / (h / 2) = du/dn:

    du/dn = (value - a u_c) / (a h / 2 + b),        u_w = (b u_c + value h / 2) / (a h / 2 + b).

What a fluid does at a wall implies conditions of its velocity along the wall and of the pressure: FlowCondition.
"""

from dataclasses import dataclass, field

from sparsedp._utils.reconstruction import Value
from sparsedp._utils.validation import check_number, check_type
from sparsedp.grid.grid import AXES, Grid

__all__ = [
    "Condition", "FlowCondition", "check_condition", "dirichlet", "free_slip", "inflow", "neumann", "no_slip",
    "outflow", "resolve", "robin",
]  # fmt: skip

EXAMPLE = "; write for example robin(1.0, 0.5)"


class Condition(Value):
    """What holds at a wall: a u + b du/dn = value, n pointing outwards. Frozen, equal by value.

    dirichlet: u = value. neumann: du/dn = value. robin(a, b): the rest. Write one condition for all walls, or a dict
    with the axes: for each a condition, or a pair (lower, upper). Axes that are not named are neumann, periodic ones
    have no walls. The value is 0 in an operator; `lift` brings in others.

    Examples
    --------
    >>> import sparsedp as dp
    >>> grid = dp.Grid((4, 3), size=1.0)
    >>> L = dp.laplacian(grid, dp.dirichlet)
    >>> L = dp.laplacian(grid, {"x": (dp.dirichlet, dp.neumann), "y": dp.robin(1.0, 0.5)})
    """

    choices = "dirichlet, neumann, robin(a, b)"
    a: float
    b: float

    def __init__(self, a, b, description=None):
        documented = {} if description is None else {"__doc__": description}
        super().__init__(a=a, b=b, **documented)

    @property
    def _key(self):
        return self.a, self.b

    def __call__(self, value):
        raise TypeError(f"{self} takes no value here; write G(u) + B(values), B = dp.lift(grid, dp.{self})")

    def __repr__(self):
        return {(1.0, 0.0): "dirichlet", (0.0, 1.0): "neumann"}.get(self._key, f"robin({self.a:g}, {self.b:g})")


dirichlet = Condition(
    1.0,
    0.0,
    """Fix the value at a wall: u = value.

    In an operator the value is 0; `lift` brings in others. In `transport` it is what the wind brings in. The field is
    odd across the wall: the slope there is (value - u) / (h / 2), with u in the cell next to the wall and h its width.

    Examples
    --------
    >>> import numpy as np
    >>> import sparsedp as dp
    >>> dp.gradient(dp.Grid(2), dp.dirichlet)(np.ones(2))
    array([ 2.,  0., -2.])
    """,
)
neumann = Condition(
    0.0,
    1.0,
    """Fix the slope at a wall: du/dn = value, n pointing outwards.

    In an operator the slope is 0, a tight or insulated wall; `lift` brings in others. It is the condition of walls that
    are not named.

    Examples
    --------
    >>> import numpy as np
    >>> import sparsedp as dp
    >>> dp.gradient(dp.Grid(2), dp.neumann)(np.array([1.0, 3.0]))
    array([0., 2., 0.])
    """,
)


def robin(a, b):
    """Two weights -> the condition a u + b du/dn = value, n outwards.

    Parameters
    ----------
    a, b : float
        Finite, >= 0, not both 0; `b` carries [length] relative to `a`.

    Returns
    -------
    Condition

    Raises
    ------
    ValueError
        If a weight is negative or not finite, or both are 0: the problem would not be well posed.
    TypeError
        If a weight is not a real number.

    Examples
    --------
    >>> robin(2, 1)
    robin(2, 1)
    >>> robin(1, 0)
    dirichlet
    """
    a, b = (check_number(f"{name} of robin", weight, ">= 0", EXAMPLE, EXAMPLE) for name, weight in (("a", a), ("b", b)))
    if a == b == 0:
        raise ValueError(f"a and b of robin must not both be 0{EXAMPLE}")
    return Condition(a, b)


@dataclass(frozen=True)
class FlowCondition:
    """What a fluid does at a wall: no_slip (sticks), free_slip (glides), inflow (given), outflow (open).

    Write one for all walls, or a dict with the axes, as for other conditions: axes that are not named are no_slip.

    Parameters
    ----------
    name : str
    closed : bool
        Whether nothing passes.
    along : Condition
        Of the velocity along the wall.
    pressure : Condition

    Examples
    --------
    >>> import sparsedp as dp
    >>> grid = dp.Grid((4, 3), size=1.0)
    >>> P = dp.projection(grid, boundary={"x": (dp.inflow, dp.outflow)})
    """

    name: str
    closed: bool
    along: Condition
    pressure: Condition
    description: str = field(default="", repr=False, compare=False)
    choices = "no_slip, free_slip, inflow, outflow"  # no annotation: the same for all

    def __post_init__(self):
        if self.description:
            object.__setattr__(self, "__doc__", self.description)

    def __repr__(self):
        return self.name


no_slip = FlowCondition(
    "no_slip",
    True,
    dirichlet,
    neumann,
    """Let the fluid stick to a wall: nothing passes, and the velocity along the wall is that of the wall.

    A wall moves with the values of `face_lift` (a lid), else it rests. It is the condition of flow on walls that are
    not named. The pressure has slope 0 there.

    Examples
    --------
    >>> import sparsedp as dp
    >>> box = dp.projection(dp.Grid((4, 3), size=1.0), boundary=dp.no_slip)
    """,
)
free_slip = FlowCondition(
    "free_slip",
    True,
    neumann,
    neumann,
    """Let the fluid glide along a wall: nothing passes, and the wall exerts no friction.

    The slope of the velocity along the wall is 0, as in a plane of symmetry. The pressure has slope 0 there.

    Examples
    --------
    >>> import sparsedp as dp
    >>> L = dp.face_laplacian(dp.Grid((4, 3), size=1.0), {"y": (dp.no_slip, dp.free_slip)})
    """,
)
inflow = FlowCondition(
    "inflow",
    False,
    dirichlet,
    neumann,
    """Prescribe what passes a side: the velocity across it is what the face field holds there.

    A projection leaves these entries as they are, so set them in the start. The velocity along the side is that of
    `face_lift`, by default 0. The pressure has slope 0 there. A region with an inflow needs an outflow.

    Examples
    --------
    >>> import sparsedp as dp
    >>> channel = dp.projection(dp.Grid((4, 3), size=1.0), boundary={"x": (dp.inflow, dp.outflow)})
    """,
)
outflow = FlowCondition(
    "outflow",
    False,
    neumann,
    dirichlet,
    """Open a side: what passes is found, and the pressure is 0 there.

    The slope of the velocity along the side is 0. Flow may also enter through it.

    Examples
    --------
    >>> import sparsedp as dp
    >>> channel = dp.projection(dp.Grid((4, 3), size=1.0), boundary={"x": (dp.inflow, dp.outflow)})
    """,
)


def resolve(grid, boundary, default=neumann):
    """Boundary argument -> for each axis (lower, upper), or None where the axis is periodic.

    Parameters
    ----------
    grid : Grid
    boundary : condition or dict
        One condition for all bounded sides, or a dict with keys "x", "y", "z", each a condition
        or a pair (lower, upper). On a grid of one axis a pair needs no dict.
    default : Condition or FlowCondition
        That of the axes that are not named; says which kind of conditions is meant.

    Returns
    -------
    tuple

    Raises
    ------
    ValueError
        If a periodic axis or an axis the grid does not have is named.
    TypeError
        If an entry is not a condition of that kind, a pair of them has no axis, or the grid is not a grid.

    Examples
    --------
    >>> from sparsedp.grid.grid import Grid
    >>> resolve(Grid((2, 2), periodic=(True, False)), {"y": (dirichlet, neumann)})
    (None, (dirichlet, neumann))
    """
    check_type("an operator, as its first argument,", grid, Grid, "a Grid", "dp.Grid((8, 6), size=1.0)")
    if isinstance(boundary, dict):
        _check_names(grid, boundary)
    else:
        if isinstance(boundary, (tuple, list)) and grid.dim > 1:
            raise TypeError(f"a pair of conditions belongs to one axis of {grid}; name it: {{'x': {boundary!r}}}")
        boundary = dict.fromkeys(AXES, boundary)
    return tuple(
        None if periodic else _sides(axis, boundary.get(axis, default), type(default))
        for axis, periodic in zip(AXES, grid.periodic, strict=False)
    )


def check_condition(name, given):
    """Refuse what is not one condition."""
    if not isinstance(given, Condition):
        raise TypeError(f"{name} needs one condition, dirichlet, neumann or robin(a, b), got {given!r}")


def _check_names(grid, boundary):
    for name in boundary:
        if name not in grid.axes:
            raise ValueError(
                f"boundary names axis {name!r}, but {grid} has {', '.join(grid.axes)}; give the two sides of an "
                "axis as {'x': (lower, upper)}"
            )
        if grid.periodic[AXES.index(name)]:
            raise ValueError(f"axis {name} is periodic and takes no boundary condition; leave it out")


def _sides(axis, entry, kind):
    sides = (entry, entry) if isinstance(entry, kind) else entry
    if not (isinstance(sides, (tuple, list)) and len(sides) == 2 and all(isinstance(s, kind) for s in sides)):
        raise TypeError(
            f"boundary on {axis} needs {kind.choices} or a pair of them, got {entry!r}{_instead(sides, kind)}"
        )
    return tuple(sides)


def _instead(sides, kind):
    """Return advice for what is not a condition of a kind; empty if there is none."""
    first = sides[0] if isinstance(sides, (tuple, list)) and sides else sides
    if isinstance(first, str):
        if first in kind.choices.split(", "):
            return f"; write dp.{first}"
        if first == "periodic":
            return "; write dp.Grid(shape, periodic=True) and no condition"
        return ""
    if isinstance(first, FlowCondition):
        return f"; {first} belongs to dp.projection and dp.flow_step, write dp.{first.along} here"
    return EXAMPLE if "function robin" in repr(first) else ""
