"""Boundary conditions of fields and flows, one for each end of each bounded axis.

All conditions of fields have the form a u + b du/dn = value at the wall, where n is the outward normal: (a, b) is
(1, 0) for dirichlet, (0, 1) for neumann, and arbitrary for robin(a, b). Let u_c be the value in the cell next to the
wall and h the width of that cell. The wall value u_w and the slope then follow from (u_w - u_c) / (h / 2) = du/dn:

    du/dn = (value - a u_c) / (a h / 2 + b),        u_w = (b u_c + value h / 2) / (a h / 2 + b).

A FlowCondition describes a fluid at a wall. It consists of a condition for the tangential velocity and one for the
pressure.
"""

from __future__ import annotations

from typing import Any, NoReturn

from sparsedp._utils.base_classes import Value
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
    """A boundary condition of a field, a u + b du/dn = value, where n is the outward normal.

    dirichlet stands for u = value, neumann for du/dn = value, and robin(a, b) for all other conditions. An argument
    `boundary` is either one condition for all walls, or a dict such as {"x": condition} or {"x": (lower, upper)}. Axes
    that are missing in the dict get neumann. Periodic axes have no walls and must not be named. Operators use the value
    0; add other values by `lift`. Conditions are immutable, and two conditions with the same a and b are equal.

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
        """Raise TypeError, because a condition takes no value; boundary values are arguments of `lift`."""
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

    Let u_c be the value in the cell next to the wall, h the width of this cell, and n the outward normal. Then::

        u_wall = value
        du/dn  = (value - u_c) / (h / 2)

    Operators use the value 0; add other values by `lift`. In `transport`, where the velocity points inwards, the value
    is the argument `inflow`. Use this condition in the argument ``boundary=`` of `gradient`, `laplacian`, `upwind`,
    `average`, `lift` and `transport`, alone (for all walls) or in a dict, and in ``solid_boundary=`` for the surfaces
    of obstacles.

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
    """Fix the slope of a field at a wall, du/dn = value, where n is the outward normal.

    Let u_c be the value in the cell next to the wall and h the width of this cell. Then::

        u_wall = u_c + value h / 2
        du/dn  = value

    Operators use the slope 0, as for an insulated or impermeable wall; add other slopes by `lift`. neumann is the
    default for axes that a dict of conditions does not name. In `transport`, where the velocity points inwards, the
    value that flows in is the value of the cell at the wall. Use this condition in the argument ``boundary=`` of
    `gradient`, `laplacian`, `upwind`, `average`, `lift` and `transport`, alone (for all walls) or in a dict, and in
    ``solid_boundary=`` for the surfaces of obstacles.

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
    """Return the boundary condition a u + b du/dn = value, where n is the outward normal.

    Let u_c be the value in the cell next to the wall and h the width of this cell. Then::

        u_wall = (b u_c + value h / 2) / (a h / 2 + b)
        du/dn  = (value - a u_c) / (a h / 2 + b)

    Operators use the value 0; add other values by `lift`. For example, a wall with heat transfer coefficient c and
    conductivity k, in surroundings of temperature T, has the condition robin(c, k) with the value c T. Use robin in the
    argument ``boundary=`` of `gradient`, `laplacian`, `upwind`, `average` and `lift`, alone (for all walls) or in a
    dict, and in ``solid_boundary=`` for the surfaces of obstacles. `transport` does not accept it.

    Parameters
    ----------
    a, b : float
        Finite, >= 0, not both 0. The unit of `b` is the unit of `a` times [length].

    Returns
    -------
    Condition

    Raises
    ------
    ValueError
        If `a` or `b` is negative or not finite, or if both are 0.
    TypeError
        If `a` or `b` is not a real number.

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
    """A boundary condition of a flow: no_slip, free_slip, inflow or outflow.

    An argument `boundary` is either one condition for all walls, or a dict such as {"x": condition} or
    {"x": (lower, upper)}. Axes that are missing in the dict get no_slip. Conditions are immutable and compared by
    value.

    Parameters
    ----------
    name : str
    closed : bool
        True if no fluid passes through the wall.
    along : Condition
        Condition of the velocity components parallel to the wall.
    pressure : Condition
        Condition of the pressure.
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
    """Let the fluid have the velocity of the wall at the wall.

    Let v be the velocity component normal to the wall, w a tangential component, w_c its value at the distance h / 2
    from the wall, where h is the cell width, p the pressure and n the outward normal. Then::

        v = 0,   w_wall = velocity of the wall,   dw/dn = (w_wall - w_c) / (h / 2),   dp/dn = 0

    Walls are at rest unless a tangential velocity is given by `face_lift` or by the argument ``walls=`` of `flow_step`
    (as for a driven cavity). no_slip is the default for axes that a dict of conditions does not name. Use this
    condition in the argument ``boundary=`` of `projection`, `flow_step`, `face_laplacian`, `face_lift`, `convection`
    and `forces`, and in ``solid_boundary=`` for obstacles.

    See Also
    --------
    free_slip, inflow, outflow, projection, flow_step, face_lift

    Examples
    --------
    A uniform flow between two walls is decelerated in the cells next to them:

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
    """Let the fluid slide along a closed wall without friction.

    Let v be the velocity component normal to the wall, w a tangential component, p the pressure and n the outward
    normal. Then::

        v = 0,   dw/dn = 0,   dp/dn = 0

    A plane of symmetry has the same condition. Use this condition in the argument ``boundary=`` of `projection`,
    `flow_step`, `face_laplacian`, `face_lift`, `convection` and `forces`, and in ``solid_boundary=`` for obstacles. In
    `conservation_law` it is a reflecting wall: the ghost cells are mirror images of the cells at the wall, and
    ``momentum=`` names the field whose sign is reversed.

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
    """Prescribe the velocity of the fluid on a boundary.

    Let v be the velocity component normal to the boundary, w a tangential component, w_side its value on the boundary,
    w_c its value at the distance h / 2 from it, where h is the cell width, p the pressure and n the outward normal.
    Then::

        v = prescribed,   w_side = prescribed,   dw/dn = (w_side - w_c) / (h / 2),   dp/dn = 0

    The value of v is read from the boundary faces of the velocity field, which `projection` does not change: set it in
    the initial state, or by ``inflow=`` of `flow_step`. w_side is 0 unless it is given by `face_lift` or by ``walls=``
    of `flow_step`. A domain with an inflow also needs an outflow. Use this condition in the argument ``boundary=`` of
    `projection`, `flow_step`, `face_laplacian`, `face_lift`, `convection` and `forces`. In `conservation_law` the state
    outside the boundary is given by the argument ``inflow=``.

    See Also
    --------
    no_slip, free_slip, outflow, projection, flow_step, face_lift, conservation_law

    Examples
    --------
    The flow through a channel is the same at all cross-sections:

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
    """Let the fluid leave through an open boundary, on which the pressure is 0.

    Let w be a tangential velocity component, p the pressure, p_side its value on the boundary, p_c its value in the
    cell next to the boundary, h the width of this cell and n the outward normal. Then::

        p_side = 0,   dp/dn = -p_c / (h / 2),   dw/dn = 0

    The normal velocity is computed so that the divergence is 0 in each cell; it may also point inwards. Use this
    condition in the argument ``boundary=`` of `projection`, `flow_step`, `face_laplacian`, `face_lift`, `convection`
    and `forces`. In `conservation_law` it is the default: the ghost cells are copies of the last cell, so that waves
    leave the domain.

    See Also
    --------
    no_slip, free_slip, inflow, projection, flow_step, conservation_law

    Examples
    --------
    The flow that enters a channel leaves it through the outflow boundary:

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
    """Convert an argument `boundary` to one pair of conditions (lower, upper) for each axis.

    Parameters
    ----------
    grid : Grid
    boundary : condition or dict
        One condition for all walls, or a dict with keys "x", "y", "z" whose values are conditions or pairs
        (lower, upper). On a 1-D grid a pair may be given without a dict.
    default : Condition or FlowCondition
        Condition of the axes that the dict does not name. All conditions must have the same type as `default`.

    Returns
    -------
    tuple
        For each axis (lower, upper), or None if the axis is periodic.

    Raises
    ------
    ValueError
        If the dict names a periodic axis, or an axis that the grid does not have.
    TypeError
        If an entry is not a condition of the type of `default`, if a pair is given without an axis on a grid of more
        than one axis, or if `grid` is not a Grid.

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
            f"boundary on {axis} needs {kind.choices} or a pair of them, got {entry!r}{_advice(sides, kind)}"
        )
    return tuple(sides)


def _advice(sides, kind):
    """Return advice for an entry that is not a condition of type `kind`; an empty string if there is none."""
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
