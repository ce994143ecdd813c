"""Boundary conditions: one for each side of each bounded axis, of a field or of a flow.

All conditions have one form, a u + b du/dn = value at the wall, with n pointing outwards:
dirichlet is (1, 0), neumann is (0, 1), robin(a, b) any other. With u_c the value in the cell next
to the wall and h its width, the wall value and the slope follow from (u_w - u_c) / (h / 2) = du/dn:

    du/dn = (value - a u_c) / (a h / 2 + b),        u_w = (b u_c + value h / 2) / (a h / 2 + b).

A FlowCondition is the behaviour of a fluid at a wall: it implies conditions of the tangential velocity and of the
pressure.
"""

from __future__ import annotations

from typing import Any, NoReturn

from sparsedp._utils.reconstruction import Value
from sparsedp._utils.validation import check_number, check_type
from sparsedp.grid.grid import AXES, Grid

__all__ = [
    "Condition",
    "FlowCondition",
    "check_condition",
    "dirichlet",
    "free_slip",
    "inflow",
    "neumann",
    "no_slip",
    "outflow",
    "resolve",
    "robin",
]

EXAMPLE = "; write for example robin(1.0, 0.5)"


class Condition(Value):
    """A boundary condition of a field: a u + b du/dn = value, n pointing outwards. Frozen, equal by value.

    dirichlet: u = value. neumann: du/dn = value. robin(a, b): any other. Write one condition for all walls, or a dict
    whose keys are axes: for each a condition, or a pair (lower, upper). Axes that are not named are neumann, periodic
    ones have no walls. The value is 0 in an operator; `lift` adds other values.

    Parameters
    ----------
    a, b : float
    description : str, optional
        Docstring of the instance.

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

    def __init__(self, a: float, b: float, description: str | None = None) -> None:
        values: dict[str, Any] = {"a": a, "b": b}
        if description is not None:
            values["__doc__"] = description
        super().__init__(**values)

    @property
    def _key(self):
        return self.a, self.b

    def __call__(self, value: Any) -> NoReturn:
        """Refuse a value: those of walls are arguments of `lift`."""
        raise TypeError(f"{self} takes no value here; write G(u) + B(values), B = dp.lift(grid, dp.{self})")

    def __repr__(self) -> str:
        if self._key == (1.0, 0.0):
            return "dirichlet"
        if self._key == (0.0, 1.0):
            return "neumann"
        return f"robin({self.a:g}, {self.b:g})"


dirichlet = Condition(
    1.0,
    0.0,
    """Fix the value of a field at a wall, u = value.

    With u_c in the cell beside the wall, h the width of this cell and n pointing outwards::

        u_wall = value
        du/dn  = (value - u_c) / (h / 2)

    In an operator the value is 0; `lift` adds other values. In `transport` it is the value `inflow`, where the velocity
    points inwards. An argument ``boundary=`` of `gradient`, `laplacian`, `upwind`, `average`, `lift` and `transport`
    takes it, alone for all walls or as an entry of a dict; ``solid_boundary=`` takes it for the walls of obstacles.

    See Also
    --------
    neumann, robin, gradient, laplacian, lift, transport

    Examples
    --------
    >>> import numpy as np
    >>> import sparsedp as dp
    >>> grid = dp.Grid(2)
    >>> slopes = dp.gradient(grid, dp.dirichlet)(np.ones(2))
    >>> slopes
    array([ 2.,  0., -2.])

    With the values 1 and 3 at the two walls:

    >>> slopes + dp.lift(grid, dp.dirichlet)(np.array([1.0, 3.0]))
    array([0., 0., 4.])
    """,
)
neumann = Condition(
    0.0,
    1.0,
    """Fix the slope of a field at a wall, du/dn = value, with n pointing outwards.

    With u_c in the cell beside the wall and h the width of this cell::

        u_wall = u_c + value h / 2
        du/dn  = value

    In an operator the slope is 0, an insulated or impermeable wall; `lift` adds other slopes. It is the condition of
    axes that are not named. In `transport` a velocity that points inwards brings in the value of the cell at the wall.
    An argument ``boundary=`` of `gradient`, `laplacian`, `upwind`, `average`, `lift` and `transport` takes it, alone
    for all walls or as an entry of a dict; ``solid_boundary=`` takes it for the walls of obstacles.

    See Also
    --------
    dirichlet, robin, gradient, laplacian, lift, transport

    Examples
    --------
    >>> import numpy as np
    >>> import sparsedp as dp
    >>> grid = dp.Grid(2)
    >>> slopes = dp.gradient(grid, dp.neumann)(np.array([1.0, 3.0]))
    >>> slopes
    array([0., 2., 0.])

    With the outward slopes 5 and 7 at the two walls:

    >>> slopes + dp.lift(grid, dp.neumann)(np.array([5.0, 7.0]))
    array([-5.,  2.,  7.])
    """,
)


def robin(a: float, b: float) -> Condition:
    """Return the condition a u + b du/dn = value, with n pointing outwards.

    With u_c in the cell beside the wall and h the width of this cell::

        u_wall = (b u_c + value h / 2) / (a h / 2 + b)
        du/dn  = (value - a u_c) / (a h / 2 + b)

    In an operator the value is 0; `lift` adds other values. A wall that exchanges heat with surroundings of the
    temperature T is robin(h, k) with the value h T, for a heat transfer coefficient h and a conductivity k. An argument
    ``boundary=`` of `gradient`, `laplacian`, `upwind`, `average` and `lift` takes it, alone for all walls or as an
    entry of a dict; ``solid_boundary=`` takes it for the walls of obstacles. `transport` does not.

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
        If a weight is negative or not finite, or both are 0: the problem is not well posed.
    TypeError
        If a weight is not a real number.

    See Also
    --------
    dirichlet, neumann, gradient, laplacian, lift

    Examples
    --------
    >>> robin(2, 1)
    robin(2, 1)
    >>> robin(1, 0)
    dirichlet
    >>> import numpy as np
    >>> import sparsedp as dp
    >>> dp.gradient(dp.Grid(2), dp.robin(1.0, 0.5))(np.ones(2))
    array([ 1.,  0., -1.])
    """
    a = check_number("a of robin", a, ">= 0", EXAMPLE, EXAMPLE)
    b = check_number("b of robin", b, ">= 0", EXAMPLE, EXAMPLE)
    if a == b == 0:
        raise ValueError(f"a and b of robin must not both be 0{EXAMPLE}")
    return Condition(a, b)


class FlowCondition(Value):
    """The behaviour of a fluid at a wall: no_slip, free_slip, inflow or outflow. Frozen, equal by value.

    Write one for all walls, or a dict whose keys are axes, as for other conditions: axes that are not named are
    no_slip.

    Parameters
    ----------
    name : str
    closed : bool
        Whether nothing passes.
    along : Condition
        Of the velocity along the wall.
    pressure : Condition
        Of the pressure.
    description : str, optional
        Docstring of the instance.

    Examples
    --------
    >>> import sparsedp as dp
    >>> grid = dp.Grid((4, 3), size=1.0)
    >>> P = dp.projection(grid, boundary={"x": (dp.inflow, dp.outflow)})
    """

    choices = "no_slip, free_slip, inflow, outflow"
    name: str
    closed: bool
    along: Condition
    pressure: Condition

    def __init__(
        self, name: str, closed: bool, along: Condition, pressure: Condition, description: str | None = None
    ) -> None:
        values: dict[str, Any] = {"name": name, "closed": closed, "along": along, "pressure": pressure}
        if description is not None:
            values["__doc__"] = description
        super().__init__(**values)

    @property
    def _key(self):
        return self.name, self.closed, self.along, self.pressure

    def __repr__(self) -> str:
        return self.name


no_slip = FlowCondition(
    "no_slip",
    True,
    dirichlet,
    neumann,
    """Make a fluid stick to a wall, where it has the velocity of the wall.

    With v the component of the velocity across the wall, w one along it (w_c half a cell of width h away from the
    wall), p the pressure and n pointing outwards::

        v = 0,   w_wall = velocity of the wall,   dw/dn = (w_wall - w_c) / (h / 2),   dp/dn = 0

    A wall is at rest, unless `face_lift` or the argument ``walls=`` of `flow_step` moves it along itself (a lid). It is
    the condition of flow on axes that are not named. An argument ``boundary=`` of `projection`, `flow_step`,
    `face_laplacian`, `face_lift`, `convection` and `forces` takes it; ``solid_boundary=`` takes it for obstacles.

    See Also
    --------
    free_slip, inflow, outflow, projection, flow_step, face_lift

    Examples
    --------
    A uniform flow between two walls is slowed down in the cells beside them:

    >>> import sparsedp as dp
    >>> channel = dp.Grid((1, 3), periodic=(True, False))
    >>> dp.face_laplacian(channel, dp.no_slip)(channel.join(1.0, 0.0))[:3]
    array([-2.,  0., -2.])
    """,
)
free_slip = FlowCondition(
    "free_slip",
    True,
    neumann,
    neumann,
    """Let a fluid slip along a wall that nothing passes, without friction.

    With v the component of the velocity across the wall, w one along it, p the pressure and n pointing outwards::

        v = 0,   dw/dn = 0,   dp/dn = 0

    This is also a plane of symmetry. An argument ``boundary=`` of `projection`, `flow_step`, `face_laplacian`,
    `face_lift`, `convection` and `forces` takes it; ``solid_boundary=`` takes it for obstacles. In `conservation_law`
    it is a wall that reflects waves: the cells are mirrored, and ``momentum=`` names the field that changes its sign.

    See Also
    --------
    no_slip, inflow, outflow, projection, flow_step, conservation_law

    Examples
    --------
    A uniform flow between two walls is not slowed down:

    >>> import sparsedp as dp
    >>> channel = dp.Grid((1, 3), periodic=(True, False))
    >>> dp.face_laplacian(channel, dp.free_slip)(channel.join(1.0, 0.0))[:3]
    array([0., 0., 0.])
    """,
)
inflow = FlowCondition(
    "inflow",
    False,
    dirichlet,
    neumann,
    """Prescribe the velocity of a fluid on a side, as the faces of the side hold it.

    With v the component of the velocity across the side, w one along it (w_c half a cell of width h away from the
    side), p the pressure and n pointing outwards::

        v = value on the faces,   w_side = given,   dw/dn = (w_side - w_c) / (h / 2),   dp/dn = 0

    A `projection` does not change v on these faces: set it in the first state, or by ``inflow=`` of `flow_step`. w_side
    is 0, unless `face_lift` or ``walls=`` of `flow_step` gives it. A region with an inflow needs an outflow. An
    argument ``boundary=`` of `projection`, `flow_step`, `face_laplacian`, `face_lift`, `convection` and `forces` takes
    it. In `conservation_law` the state beyond the side is its argument ``inflow=``.

    See Also
    --------
    no_slip, free_slip, outflow, projection, flow_step, face_lift, conservation_law

    Examples
    --------
    What enters a channel passes all of it:

    >>> import numpy as np
    >>> import sparsedp as dp
    >>> grid = dp.Grid((3, 1))
    >>> P = dp.projection(grid, boundary={"x": (dp.inflow, dp.outflow)})
    >>> v = grid.join(np.array([[2.0], [0.0], [0.0], [0.0]]), 0.0)
    >>> grid.split(P(v))[0].ravel()
    array([2., 2., 2., 2.])
    """,
)
outflow = FlowCondition(
    "outflow",
    False,
    neumann,
    dirichlet,
    """Open a side to a fluid, with the pressure 0 there and a flow that is computed.

    With w a component of the velocity along the side, p the pressure (p_c in the cell beside the side, h the width of
    this cell) and n pointing outwards::

        p_side = 0,   dp/dn = -p_c / (h / 2),   dw/dn = 0

    The component across the side follows from the divergence, which is 0 in each cell; it may also point inwards. An
    argument ``boundary=`` of `projection`, `flow_step`, `face_laplacian`, `face_lift`, `convection` and `forces` takes
    it. In `conservation_law`, where it is the default, the last cell is repeated beyond the side, and waves leave.

    See Also
    --------
    no_slip, free_slip, inflow, projection, flow_step, conservation_law

    Examples
    --------
    What enters a channel leaves it at its open end:

    >>> import numpy as np
    >>> import sparsedp as dp
    >>> grid = dp.Grid((3, 1))
    >>> P = dp.projection(grid, boundary={"x": (dp.inflow, dp.outflow)})
    >>> v = grid.join(np.array([[2.0], [0.0], [0.0], [0.0]]), 0.0)
    >>> grid.split(P(v))[0][-1]
    array([2.])
    """,
)


def resolve(
    grid: Grid, boundary: Any, default: Condition | FlowCondition = neumann
) -> tuple[tuple[Any, Any] | None, ...]:
    """Return the conditions of both sides of each axis, from an argument `boundary`.

    Parameters
    ----------
    grid : Grid
    boundary : condition or dict
        One condition for all bounded sides, or a dict with keys "x", "y", "z", each a condition
        or a pair (lower, upper). On a grid of one axis a pair needs no dict.
    default : Condition or FlowCondition
        Condition of the axes that are not named; its type is the type of all conditions.

    Returns
    -------
    tuple
        For each axis (lower, upper), or None if the axis is periodic.

    Raises
    ------
    ValueError
        If a periodic axis or an axis the grid does not have is named.
    TypeError
        If an entry is not a condition of the type of `default`, if a pair is given without an axis, or if `grid` is no
        Grid.

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
    conditions: list[tuple[Any, Any] | None] = []
    for axis, periodic in zip(grid.axes, grid.periodic, strict=True):
        if periodic:
            conditions.append(None)
        else:
            conditions.append(_sides(axis, boundary.get(axis, default), type(default)))
    return tuple(conditions)


def check_condition(name: str, condition: Any) -> None:
    """Raise TypeError if an argument is not one Condition."""
    if not isinstance(condition, Condition):
        raise TypeError(f"{name} needs one condition, dirichlet, neumann or robin(a, b), got {condition!r}")


def _check_names(grid, boundary):
    """Raise ValueError if a dict of conditions names an axis that has no walls."""
    for name in boundary:
        if name not in grid.axes:
            raise ValueError(
                f"boundary names axis {name!r}, but {grid} has {', '.join(grid.axes)}; give the two sides of an "
                "axis as {'x': (lower, upper)}"
            )
        if grid.periodic[AXES.index(name)]:
            raise ValueError(f"axis {name} is periodic and takes no boundary condition; leave it out")


def _sides(axis, entry, kind):
    """Return the conditions (lower, upper) of an axis, given one condition or a pair."""
    if isinstance(entry, kind):
        return entry, entry
    sides = entry
    if not (isinstance(sides, (tuple, list)) and len(sides) == 2 and all(isinstance(s, kind) for s in sides)):
        raise TypeError(
            f"boundary on {axis} needs {kind.choices} or a pair of them, got {entry!r}{_instead(sides, kind)}"
        )
    return tuple(sides)


def _instead(sides, kind):
    """Return advice for an entry that is not a condition of a kind; empty if there is none."""
    first = sides
    if isinstance(sides, (tuple, list)) and sides:
        first = sides[0]
    if isinstance(first, str):
        if first in kind.choices.split(", "):
            return f"; write dp.{first}"
        if first == "periodic":
            return "; write dp.Grid(shape, periodic=True) and no condition"
        return ""
    if isinstance(first, FlowCondition):
        return f"; {first} belongs to dp.projection and dp.flow_step, write dp.{first.along} here"
    if getattr(first, "__name__", "") == "robin":
        return EXAMPLE
    return ""
