"""Boundary conditions of fields and flows, one for each end of each bounded axis.

All conditions of fields have the form a u + b du/dn = value at the wall, where n is the outward normal: (a, b) is
(1, 0) for dirichlet, (0, 1) for neumann, and arbitrary for robin(a, b). Let u_c be the value in the cell next to the
wall and h the width of that cell. The wall value u_w and the slope then follow from (u_w - u_c) / (h / 2) = du/dn:

    du/dn = (value - a u_c) / (a h / 2 + b),        u_w = (b u_c + value h / 2) / (a h / 2 + b).

A FlowCondition describes a fluid at a wall. It consists of a condition for the tangential velocity and one for the
pressure.

A Patch is a condition on part of a wall and another one on the other faces of this wall. `resolve` converts it to a
MixedWall, which has one boolean array of faces for each condition. A function that does not support mixed walls gets an
error from `resolve`, so that no function can ignore a patch.
"""

from __future__ import annotations

from functools import cached_property
from math import prod
from typing import TYPE_CHECKING, Any, NoReturn

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.base_classes import Value
from sparsedp._utils.validation import check_kind, check_number, check_type
from sparsedp.autodiff.tape import dtype_of, isbox, sample
from sparsedp.errors import DerivativeError, NonFiniteError, ShapeError
from sparsedp.grid.grid import AXES, Grid

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

__all__ = [
    "Condition",
    "FlowCondition",
    "SIDES",
    "MixedWall",
    "Patch",
    "check_condition",
    "conditions_of",
    "describe_patches",
    "dirichlet",
    "free_slip",
    "inflow",
    "mapped_wall",
    "mixed_wall",
    "neumann",
    "no_slip",
    "occurring",
    "outflow",
    "patch",
    "points_touching",
    "resolve",
    "robin",
    "walls_of",
]

EXAMPLE = "; write for example robin(1.0, 0.5)"
ON_END = 1e-9  # a face centre within this share of its width from the end of an interval lies on this end
SIDES = ("lower", "upper")


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
    neumann, robin, patch, gradient, laplacian, lift, transport

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
    dirichlet, robin, patch, gradient, laplacian, lift, transport

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
    dirichlet, neumann, patch, gradient, laplacian, lift

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
    free_slip, inflow, outflow, patch, projection, flow_step, face_lift

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
    no_slip, inflow, outflow, patch, projection, flow_step, conservation_law

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
    no_slip, free_slip, outflow, patch, projection, flow_step, face_lift, conservation_law

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
    no_slip, free_slip, inflow, patch, projection, flow_step, conservation_law

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


class Patch(Value):
    """A condition on part of a wall, and another condition on the other faces of this wall; see `patch`.

    Parameters
    ----------
    where : tuple of intervals, or bool array
        The part of the wall. An interval is a pair of coordinates, or None for the whole length of its axis.
    condition : Condition or FlowCondition
    elsewhere : Condition, FlowCondition or Patch
        Condition of the same type, or another patch of the same wall.
    """

    where: Any
    condition: Any
    elsewhere: Any

    def __init__(self, where: Any, condition: Any, elsewhere: Any) -> None:
        super().__init__(where=where, condition=condition, elsewhere=elsewhere)

    @property
    def _key(self):
        where = self.where
        if isinstance(where, np.ndarray):
            where = where.shape, where.tobytes()
        return where, self.condition, self.elsewhere

    def values(self, grid: Grid, axis: int | str, inside: Any, elsewhere: Any = 0.0) -> Any:
        """Return the wall values that are `inside` on the faces of the patch. Differentiable in both values.

        Parameters
        ----------
        grid : Grid
        axis : int or "x", "y", "z"
            Axis across the wall.
        inside : number, or array with one entry for each face of the wall
            Its entries on other faces are not used.
        elsewhere : number, or array with one entry for each face of the wall, optional
            The values on the other faces of the wall, such as those of another patch.

        Returns
        -------
        array, in the shape of the wall without its axis
            An argument of ``join`` on the domain of `lift`.

        Raises
        ------
        ShapeError
            If an array has another shape than the wall.
        ValueError
            If the patch covers no face.
        TypeError
            If a value holds no numbers.

        Examples
        --------
        >>> import sparsedp as dp
        >>> heated = dp.patch((1.0, 3.0), dp.dirichlet)
        >>> heated.values(dp.Grid((5, 4)), "x", 20.0)
        array([ 0., 20., 20.,  0.])
        """
        number = grid.axis(axis)
        faces = _faces_of(grid, number, f"the wall of {grid.axes[number]}", self)
        for name, value in (("inside", inside), ("elsewhere", elsewhere)):
            check_kind(f"{name} of patch.values", np.asarray(sample(value)).dtype, "numbers")
            if np.shape(value) not in ((), faces.shape):
                raise ShapeError(
                    f"values of a patch takes {name} as a number or an array of shape {faces.shape}, one entry for "
                    f"each face of the wall, got shape {np.shape(value)}"
                )
        return anp.where(faces, _spread(inside, faces.shape), _spread(elsewhere, faces.shape))

    def __call__(self, value: Any) -> NoReturn:
        """Raise TypeError, because a condition takes no value; boundary values are arguments of `lift`."""
        raise TypeError("a patch takes no value here; write G(u) + B(values), B = dp.lift(grid, boundary)")

    def __repr__(self) -> str:
        if isinstance(self.where, np.ndarray):
            where = f"<mask of {np.count_nonzero(self.where)} faces>"
        elif len(self.where) == 1:
            where = repr(self.where[0])
        else:
            where = repr(self.where)
        return f"patch({where}, {self.condition!r}, elsewhere={self.elsewhere!r})"


def patch(where: Any, condition: Any, elsewhere: Any = None) -> Patch:
    """Return a boundary condition that holds on part of a wall; another condition holds on the rest of this wall.

    Write the patch in the argument ``boundary=``, in the place of the condition of one wall.

    Parameters
    ----------
    where : pair of float, tuple of pairs, or bool array
        The part of the wall.

        - In 2-D an interval ``(start, stop)`` of the coordinate along the wall [length], which includes the origin of
          the grid.
        - In 3-D a box, one interval for each of the two other axes in their order. None instead of an interval stands
          for the whole axis.
        - In any dimension a boolean array with one entry for each face of the wall: shape ``(ny,)`` for a wall of x in
          2-D, and ``(ny, nz)`` in 3-D.
    condition : Condition or FlowCondition
        dirichlet, neumann or robin(a, b) for fields; no_slip, free_slip, inflow or outflow for flows.
    elsewhere : Condition, FlowCondition or Patch, optional
        Condition of the same type on the other faces of the wall. Another patch adds a second part of the same wall;
        the two must not overlap. Default: neumann for fields, no_slip for flows.

    Returns
    -------
    Patch

    Raises
    ------
    TypeError
        If `condition` or `elsewhere` is not a condition, if they are conditions of different types, or if `where` is
        neither intervals nor a boolean array.
    ValueError
        If an interval is empty or reversed. When the patch is used: if it covers no face, if it extends beyond the
        wall, or if two patches overlap.
    NonFiniteError
        If a coordinate is NaN or infinite.
    ShapeError
        When the patch is used, if `where` does not fit the wall.
    DerivativeError
        If autograd traces `where`.

    See Also
    --------
    dirichlet, neumann, robin, no_slip, free_slip, inflow, outflow, lift, gradient, laplacian, transport, projection

    Notes
    -----
    A face belongs to an interval if its centre c satisfies start <= c < stop. The patch is a union of whole faces, so
    the ends of an interval are moved to the nearest ends of faces, an error of order h in the position of the patch. To
    avoid this error, choose a grid with faces that end there.

    Where dirichlet and neumann meet at the end of a patch, the exact solution is in general singular: it contains the
    square root of the distance to this end. Its error is then of order 1/2 there and of order 1 elsewhere. Solutions
    without this singularity keep order 2.

    A patch that covers all faces of a wall is the same as its condition. The values of `lift` have one entry for each
    face of a wall; each is the value of the condition that holds on this face: a temperature on the faces with
    dirichlet, a slope on those with neumann. A number for the whole wall is refused, unless it is 0.
    ``heated.values(grid, "x", 20.0)`` returns an array that is 20 on the faces of the patch `heated`, and 0 on the
    others.

    These functions accept patches: `gradient`, `laplacian`, `lift`, `average` and `upwind`, and with them `inverse` and
    `elliptic_solver`; `transport`; for flows `projection`, `flow_step`, `face_laplacian`, `face_lift`,
    `convection` and `forces`. All others refuse them, and so do distributed grids. Operators with patches are not sums
    of 1-D operators: `inverse` uses sparse factors or multigrid for them, and method "separable" does not apply.

    Examples
    --------
    >>> import numpy as np
    >>> import sparsedp as dp
    >>> grid = dp.Grid((2, 4), size=1.0)
    >>> heated = dp.patch((0.25, 0.75), dp.dirichlet, elsewhere=dp.neumann)
    >>> G = dp.gradient(grid, {"x": (heated, dp.neumann)})
    >>> grid.split(G(np.ones((2, 4))))[0][0]  # slopes at the lower wall of x
    array([0., 4., 4., 0.])

    The slopes that the value 5 on the patch adds:

    >>> B = dp.lift(grid, {"x": (heated, dp.neumann)})
    >>> slopes = B(B.domain.join(heated.values(grid, "x", 5.0), 0.0, 0.0, 0.0))
    >>> grid.split(slopes)[0][0]
    array([  0., -20., -20.,   0.])
    """
    kinds = (Condition, FlowCondition)
    if not isinstance(condition, kinds):
        raise TypeError(
            f"patch needs a condition such as dp.dirichlet or dp.outflow, got {condition!r}; write "
            "dp.patch((0.2, 0.4), dp.dirichlet, elsewhere=dp.neumann)"
        )
    kind = type(condition)
    if elsewhere is None:
        elsewhere = neumann if kind is Condition else no_slip
    base = elsewhere
    while isinstance(base, Patch):
        base = base.elsewhere
    if not isinstance(base, kind):
        raise TypeError(f"patch of {condition} needs {kind.choices} or a patch of them as elsewhere=, got {base!r}")
    return Patch(_checked_where(where), condition, elsewhere)


def _spread(value, shape):
    """Return a traced number as an array, because autograd's where does not add up the gradient of a number."""
    if isbox(value) and np.shape(value) == ():
        return value * np.ones(shape, dtype_of(value))
    return value


class MixedWall(Value):
    """The conditions of a wall on which they differ from face to face.

    Parameters
    ----------
    regions : tuple of pairs (condition, bool array)
        The arrays have the shape of the wall without the axis across it. Each face is True in exactly one of them.
    """

    regions: tuple[tuple[Any, Any], ...]

    def __init__(self, regions: tuple[tuple[Any, Any], ...]) -> None:
        for _, faces in regions:
            faces.flags.writeable = False
        super().__init__(regions=regions)

    @property
    def _key(self):
        return tuple((condition, faces.shape, faces.tobytes()) for condition, faces in self.regions)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the wall without the axis across it."""
        return self.regions[0][1].shape

    def map(self, change: Callable[[Any], Any]) -> Any:
        """Return the wall with the conditions ``change(condition)``: one condition if they are all equal."""
        return mixed_wall([(change(condition), faces) for condition, faces in self.regions])

    def faces_with(self, accepts: Callable[[Any], bool]) -> NDArray[np.bool_]:
        """Return the faces whose condition the function `accepts`, as a new boolean array."""
        chosen = np.zeros(self.shape, bool)
        for condition, faces in self.regions:
            if accepts(condition):
                chosen |= faces
        return chosen

    @cached_property
    def description(self) -> str:
        """The conditions with their numbers of faces, in words."""
        total = prod(self.shape)
        words = [f"{condition} on {np.count_nonzero(faces)}" for condition, faces in self.regions[:-1]]
        return f"{', '.join(words)} of {total} faces, {self.regions[-1][0]} elsewhere"

    def __repr__(self) -> str:
        return f"<{self.description}>"


def mixed_wall(regions: Sequence[tuple[Any, NDArray[np.bool_]]]) -> Any:
    """Return a MixedWall of pairs (condition, faces), or a condition if only one occurs; equal ones are merged."""
    merged: dict = {}
    for condition, faces in regions:
        if faces.any():
            merged[condition] = faces | merged[condition] if condition in merged else faces.copy()
    if len(merged) == 1:
        return next(iter(merged))
    return MixedWall(tuple(merged.items()))


def walls_of(sides: tuple) -> Iterator[tuple[int, int, Any]]:
    """Yield (axis, side, condition or MixedWall) for each wall, given the result of `resolve`; side 0 is the lower."""
    for axis, pair in enumerate(sides):
        for side, condition in enumerate(pair or ()):
            yield axis, side, condition


def conditions_of(wall: Any) -> tuple[Any, ...]:
    """Return the conditions that occur on a wall."""
    if isinstance(wall, MixedWall):
        return tuple(condition for condition, _ in wall.regions)
    return (wall,)


def points_touching(
    grid: Grid, wall: MixedWall, axis: int, component: int, accepts: Callable[[Any], bool]
) -> NDArray[np.bool_]:
    """Return the points of a component of a face field at a wall that touch a face whose condition is accepted.

    Along its own axis, the points of the component lie between two faces of the wall.

    Parameters
    ----------
    grid : Grid
    wall : MixedWall
    axis : int
        Axis across the wall.
    component : int
        Another axis.
    accepts : callable
        ``accepts(condition)`` returns a bool.

    Returns
    -------
    bool array
        In the shape of the component, without the axis across the wall.
    """
    faces = wall.faces_with(accepts)
    position = component if component < axis else component - 1
    if grid.periodic[component]:
        return faces | np.roll(faces, 1, position)
    width = [(0, 0)] * faces.ndim
    width[position] = (1, 1)
    padded = np.moveaxis(np.pad(faces, width), position, 0)
    return np.moveaxis(padded[:-1] | padded[1:], 0, position)


def occurring(sides: tuple) -> set:
    """Return the conditions that occur on the walls, given the result of `resolve`."""
    return {condition for _, _, wall in walls_of(sides) for condition in conditions_of(wall)}


def mapped_wall(wall: Any, change: Callable[[Any], Any]) -> Any:
    """Return ``change(condition)`` for a condition, or a MixedWall with the results for its conditions."""
    if isinstance(wall, MixedWall):
        return wall.map(change)
    return change(wall)


def describe_patches(sides: tuple) -> str:
    """Return the walls with several conditions in words, in brackets; an empty string if there are none."""
    words = []
    for axis, side, wall in walls_of(sides):
        if isinstance(wall, MixedWall):
            words.append(f"{AXES[axis]}-{SIDES[side]}: {wall.description}")
    if not words:
        return ""
    return f"[{'; '.join(words)}]"


def resolve(
    grid: Grid,
    boundary: Any,
    default: Condition | FlowCondition = neumann,
    patches: bool = False,
    name: str = "this function",
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
    patches : bool
        Whether the caller supports walls with several conditions.
    name : str
        Name of the caller, for the error message that refuses patches.

    Returns
    -------
    tuple
        For each axis (lower, upper), or None if the axis is periodic. A wall with several conditions is a MixedWall; a
        patch that covers all faces, or none of another condition, is replaced by its condition.

    Raises
    ------
    ValueError
        If the dict names a periodic axis, or an axis that the grid does not have, or if a patch does not fit its wall.
    TypeError
        If an entry is not a condition of the type of `default`, if a pair is given without an axis on a grid of more
        than one axis, if `grid` is not a Grid, or if a wall has several conditions and `patches` is False.

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
    if any(isinstance(wall, (Patch, MixedWall)) for _, _, wall in walls_of(tuple(conditions))):
        return _with_patches(grid, conditions, patches, name)
    return tuple(conditions)


def _with_patches(grid, conditions, accepted, name):
    """Return pairs of conditions in which a MixedWall, or the only condition of its wall, replaces each Patch."""
    grid.backend.check("a patch of a wall")
    resolved: list = []
    for axis, pair in enumerate(conditions):
        if pair is not None:
            pair = tuple(_wall(grid, axis, side, wall) for side, wall in enumerate(pair))
        resolved.append(pair)
    if not accepted:
        for axis, side, wall in walls_of(tuple(resolved)):
            if isinstance(wall, MixedWall):
                raise TypeError(
                    f"{name} takes one condition for each wall, but {grid.axes[axis]}-{SIDES[side]} has a patch; write "
                    f"one condition, such as dp.{wall.regions[0][0]}"
                )
    return tuple(resolved)


def _wall(grid, axis, side, wall):
    """Return the conditions of a wall as one condition, or as a MixedWall."""
    place = f"{grid.axes[axis]}-{SIDES[side]}"
    shape = tuple(n for a, n in enumerate(grid.shape) if a != axis)
    if isinstance(wall, MixedWall) and wall.shape != shape:
        raise ShapeError(f"{place} of {grid} has faces of shape {shape}, but the conditions are for {wall.shape}")
    if not isinstance(wall, Patch):
        return wall
    regions = []
    uncovered = np.ones(shape, bool)
    while isinstance(wall, Patch):
        faces = _faces_of(grid, axis, place, wall)
        overlap = np.count_nonzero(faces & ~uncovered)
        if overlap:
            raise ValueError(f"two patches overlap on {overlap} faces of {place}; give each face to one patch")
        uncovered &= ~faces
        regions.append((wall.condition, faces))
        wall = wall.elsewhere
    return mixed_wall([*regions, (wall, uncovered)])


def _faces_of(grid, axis, place, patch):
    """Return the faces of a wall that belong to a patch, a boolean array; raise if there are none."""
    others = [a for a in range(grid.dim) if a != axis]
    shape = tuple(grid.shape[a] for a in others)
    where = patch.where
    if isinstance(where, np.ndarray):
        with_axis = grid.shape[:axis] + (1,) + grid.shape[axis + 1 :]
        if where.shape not in (shape, with_axis):
            raise ShapeError(
                f"{place} has faces of shape {shape}, but the mask of {patch} has shape {where.shape}; give one entry "
                "for each face"
            )
        faces = where.reshape(shape)
    else:
        if len(where) != len(others):
            names = " and ".join(grid.axes[a] for a in others)
            needed = f"one interval for each of {names}" if others else "a mask of one entry, because it is one face"
            raise ShapeError(f"{place} of a grid in {grid.dim}-D takes {needed}, got {patch}")
        faces = np.ones(shape, bool)
        for number, (a, interval) in enumerate(zip(others, where, strict=True)):
            inside = _centres_in(grid, a, interval, place)
            faces &= inside.reshape([-1 if n == number else 1 for n in range(len(others))])
    if not faces.any():
        raise ValueError(
            f"{patch} covers no face of {place}; a face belongs to a patch if its centre lies inside, so make the "
            "patch larger or the cells smaller"
        )
    return faces


def _centres_in(grid, axis, interval, place):
    """Return for each cell of an axis whether its centre lies in an interval; the upper end does not belong to it."""
    if interval is None:
        return np.ones(grid.shape[axis], bool)
    start, stop = interval
    ends = grid.coordinates(axis, "ends")
    widths = grid.widths[axis]
    slack = ON_END * (ends[-1] - ends[0])
    if start < ends[0] - slack or stop > ends[-1] + slack:
        raise ValueError(
            f"a patch of {place} reaches from {start:g} to {stop:g} along {grid.axes[axis]}, but the wall from "
            f"{ends[0]:g} to {ends[-1]:g}; give coordinates on the wall"
        )
    centres = grid.coordinates(axis)
    return (centres >= start - ON_END * widths) & (centres < stop - ON_END * widths)


def _checked_where(where):
    """Return the argument `where` of `patch` as a boolean array, or as a tuple of intervals (start, stop) and None."""
    parts = where if isinstance(where, (tuple, list)) else (where,)
    if isbox(where) or any(map(isbox, parts)):
        raise DerivativeError("where of patch must be constant, not traced; the values of lift on it have derivatives")
    if isinstance(where, np.ndarray) and where.dtype != bool:
        where = where.tolist()
    if isinstance(where, (tuple, list)) and not _are_flags(where):
        if len(where) == 2 and all(map(_is_coordinate, where)):
            where = (where,)
        return tuple(map(_checked_interval, where))
    flags = np.asarray(where)
    if flags.dtype != bool:
        raise TypeError(f"where of patch needs (start, stop) or a bool array, got {where!r}; write (0.2, 0.4)")
    flags = flags.copy()
    flags.flags.writeable = False
    return flags


def _are_flags(entries):
    """Return whether a list or tuple, or one nested in it, holds booleans only."""
    return len(entries) > 0 and all(
        _are_flags(entry) if isinstance(entry, (tuple, list)) else isinstance(entry, (bool, np.bool_))
        for entry in entries
    )


def _is_coordinate(entry):
    """Return whether an entry is one number."""
    return np.ndim(entry) == 0 and entry is not None


def _checked_interval(interval):
    """Return an interval as a pair of floats, or None."""
    if interval is None:
        return None
    if (
        not isinstance(interval, (tuple, list, np.ndarray))
        or len(interval) != 2
        or not all(map(_is_coordinate, interval))
    ):
        raise TypeError(f"an interval of patch needs (start, stop), got {interval!r}; write for example (0.2, 0.4)")
    ends = np.asarray(interval)
    if ends.dtype.kind not in "iuf":
        raise TypeError(f"an interval of patch needs two real numbers, got {interval!r}; write for example (0.2, 0.4)")
    start, stop = map(float, ends)
    if not np.all(np.isfinite(ends)):
        raise NonFiniteError(f"an interval of patch needs finite coordinates, got ({start:g}, {stop:g})")
    if start >= stop:
        raise ValueError(f"an interval of patch needs start < stop, got ({start:g}, {stop:g})")
    return start, stop


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
    if _is_condition(entry, kind):
        return entry, entry
    sides = entry
    if not (isinstance(sides, (tuple, list)) and len(sides) == 2 and all(_is_condition(s, kind) for s in sides)):
        raise TypeError(
            f"boundary on {axis} needs {kind.choices} or a pair of them, got {entry!r}{_advice(sides, kind)}"
        )
    return tuple(sides)


def _is_condition(entry, kind):
    """Return whether an entry is a condition of type `kind`, or a patch of such conditions."""
    if isinstance(entry, Patch):
        return isinstance(entry.condition, kind)
    if isinstance(entry, MixedWall):
        return isinstance(entry.regions[0][0], kind)
    return isinstance(entry, kind)


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
    if isinstance(first, Patch):
        first = first.condition
    if isinstance(first, FlowCondition):
        return f"; {first} belongs to dp.projection and dp.flow_step, write dp.{first.along} here"
    if getattr(first, "__name__", "") == "robin":
        return EXAMPLE
    return ""
