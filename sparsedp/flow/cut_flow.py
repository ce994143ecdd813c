"""cut_flow: steady viscous flow around a body whose curved wall cuts the cells of the grid.

Finite volumes on the fluid part of the control volumes, with the velocity on faces and the pressure in cells. The
unknown of a face is the mean velocity through its open part. With the apertures A of the faces, their areas S and the
volumes V of whole cells,

    mass of a cell:       sum over its faces of (+-) A S v = 0,
    momentum of a face:   -(sum of momentum fluxes) + nu (sum of stresses + stress at the wall) + A S (p_L - p_R) = 0.

The mass is exact, the gradient of the pressure is the transpose of the divergence, and the momentum fluxes are those
of `convection` for the velocity A v. The stress on a side is the difference of two velocities. Along the axis of the
component the centres of two cut faces are not on a line across the side: each value is moved to this line with the
slope at the wall. The stress at the wall is computed by `wall_fit`. A closed face whose control volume holds fluid has
an unknown too, the continuation of the velocity, which no mass follows: otherwise the equations would jump when it
opens.

What the fluid loses at the walls is the force on the body. Its sum equals the balance over any control volume around
the body, because all fluxes are conservative. Where the wall cuts cells, the truncation error is of first order or
worse, but the errors of velocity and force are of second order.

Small cells do no harm, because the solve is implicit: no equation divides by the volume of the fluid.
"""

from __future__ import annotations

from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from sparsedp._utils.base_classes import Reconstructible
from sparsedp._utils.pytree import copied, mapped
from sparsedp._utils.validation import check_choice, check_finite, check_kind, check_number, check_on, check_plain
from sparsedp.autodiff.program_trace import check_values
from sparsedp.autodiff.tape import dtype_of, sample
from sparsedp.errors import IncompatibleError, ShapeError
from sparsedp.flow.cut_faces import cut_faces
from sparsedp.flow.momentum import (
    MomentumFluxes,
    check_walls,
    conditions_along,
    free_face_mask,
    wall_sides,
    wall_velocities,
)
from sparsedp.flow.wall_fit import wall_fit
from sparsedp.grid.boundary_conditions import no_slip, resolve
from sparsedp.grid.grid import Grid, check_grid
from sparsedp.operators.cut_geometry import level_at_nodes, protect, sum_at_places
from sparsedp.operators.difference import divergence, gradient
from sparsedp.operators.given import from_matrix
from sparsedp.solvers.inverse import inverse
from sparsedp.solvers.roots import implicit

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray


__all__ = ["CutFlow", "cut_flow"]

SHORTEST = 1e-3  # distance of two faces below which their difference is not divided by it, in the smallest cell width
FARTHEST = 8.0  # largest value of the level far from the wall, relative to those next to it
LARGEST_IMBALANCE = 1e-6  # relative imbalance of the given velocities around a region without an outflow
LARGEST_NORMAL_SHARE = 0.25  # of the velocity of the body, on a wall that is a polygon
NOT_TANGENTIAL = (
    "solid_velocity of cut_flow must be tangential to the wall of the body; the fluid would flow through it"
)
LARGEST_WALL_IMBALANCE = 0.1  # the same of the velocity of the body, on a wall that is a polygon


def cut_flow(
    grid: Grid,
    level: Any,
    boundary: Any = no_slip,
    solid_velocity: Any = 0.0,
    convection: bool = True,
    **options: Any,
) -> CutFlow:
    """Return the steady incompressible flow around a body of any shape, whose wall cuts the cells, with its force.

    Parameters
    ----------
    grid : Grid
        In 2-D.
    level : array, shape `grid.nodes.shape`, or callable
        A level set at the nodes [any unit]: > 0 in the fluid, <= 0 in the body, ideally the signed distance to the
        wall. A callable is a function of the coordinates of the nodes, such as ``lambda x, y: ...``.
    boundary : flow condition or dict
        As for `face_laplacian`.
    solid_velocity : 0, or callable
        Velocity of the wall of the body: a function of the coordinates that returns both components, such as
        ``lambda x, y: (-omega * y, omega * x)`` for a rotating cylinder. Nothing flows through the wall: the velocity
        must be tangential to it. Default: 0, at rest.
    convection : bool
        False: Stokes flow, without inertia.
    **options
        As in `implicit`: method, rtol, maxiter.

    Returns
    -------
    CutFlow
        ``flow.steady(viscosity, v)`` is the steady flow, and ``flow.force(x, viscosity)`` the force on the body.

    Raises
    ------
    ShapeError
        If the grid is not in 2-D or has no cells, or the level does not have the shape of the nodes.
    TypeError
        If the level does not hold real numbers, or `boundary` is not a flow condition.
    NonFiniteError
        If the level holds NaN or infinity.
    IncompatibleError
        If the velocity of the body would change the volume of a region without an outflow.
    JitError
        If `dp.jit` records the level: which cells are cut depends on its values.

    See Also
    --------
    cut_cells, brinkman, flow_step, forces, implicit

    Notes
    -----
    **Derivatives.** In the viscosity, the given velocities, the level and the velocity of the body, forward and
    reverse, to every order: the derivative of the force in the shape of the body. Where the wall passes a node or a
    centre of the grid, the derivative in the level is one-sided. The force jumps there, because other faces are open:
    by about 1e-4 of it where the wall passes one node, but where a whole edge lies on faces by up to the error of the
    force. For a square in a channel with 4 cells along each edge (Reynolds number 20), this is 12 %; with 8 and 16
    cells, 2 % and 0.2 %. Do not place straight walls on the lines of the grid if you differentiate in the level.

    **Resolution.** Parts of a body that are thinner than a cell, and gaps that are narrower than two, are not resolved.

    **Order.** 2 for the velocity and the force. The pressure in cut cells has order 1; the force has its sum only.

    **Cost.** Newton's method with a sparse LU factorization of the Jacobian in each step; a gradient solves once with
    the transpose.

    References
    ----------
    Y. Cheny, O. Botella, J. Comput. Phys. 229 (2010) 1043-1076.

    Examples
    --------
    The drag of a cylinder in a channel:

    >>> import numpy as np
    >>> from sparsedp import Grid, inflow, outflow
    >>> grid = Grid((24, 16), size=(3.0, 2.0))
    >>> flow = cut_flow(grid, lambda x, y: np.hypot(x - 1.0, y - 1.0) - 0.3, {"x": (inflow, outflow)})
    >>> y = grid.face_centres(0)[1]
    >>> x = flow.steady(0.1, grid.join(1.5 * y * (2.0 - y), 0.0))
    >>> drag, lift = flow.force(x, 0.1)
    >>> print(f"drag {drag:.2f}, lift {abs(lift):.2f}")
    drag 4.49, lift 0.00
    """
    check_grid("cut_flow", grid)
    return CutFlow(grid, level, boundary, solid_velocity, convection, options)


class CutFlow(Reconstructible):
    """Steady flow around a body with a curved wall, as `cut_flow` returns it.

    A flow is ``{"v": faces, "p": cells}``: the mean velocity through the open part of each face, and the pressure
    divided by the density. On closed faces next to the fluid, v is the smooth continuation of the velocity;
    elsewhere in the body, velocity and pressure are 0.

    Parameters
    ----------
    grid, level, boundary, solid_velocity, convection, options
        As `cut_flow` takes them; the options as a dict.

    Attributes
    ----------
    apertures : array, shape (faces.size,)
        Fluid fraction of each face.
    face_positions : tuple of arrays, shape (faces.size,)
        Coordinates of the centre of the open part of each face, to which its velocity belongs; of closed faces, of the
        place that opens first.
    is_free : bool array, shape (faces.size,)
        Whether the velocity of a face is an unknown. On other faces it is prescribed, or 0 in the body.
    """

    def __init__(
        self, grid: Grid, level: Any, boundary: Any, solid_velocity: Any, convection: bool, options: dict
    ) -> None:
        if grid.dim != 2 or not grid.cells.size:
            raise ShapeError(f"cut_flow takes a 2-D grid with cells, got {grid}")
        self._sides = resolve(grid, boundary, no_slip, patches=True)
        check_choice("convection of cut_flow", convection, (True, False))
        level = level_at_nodes("cut_flow", grid, level)
        self._arguments = copied((grid, level, boundary, solid_velocity, convection, options))
        self.grid = grid
        self._convection = convection
        self._root = implicit(
            partial(self._rates, self._convection), partial(self._jacobian, self._convection), **options
        )

        self._has_walls = [(entry.axis, entry.side, entry.component) for entry in wall_sides(grid, self._sides)]
        self._walls_space = wall_velocities(grid, self._sides)
        geometries, walls = cut_faces(grid, _of_order_one(grid, level))
        apertures = [
            anp.reshape(anp.transpose(g.apertures) if c else g.apertures, (-1,)) for c, g in enumerate(geometries)
        ]
        self.apertures = anp.concatenate(apertures)
        is_open = np.asarray(sample(self.apertures)) > 0
        self._has_fluid = [_has_fluid(grid, c, geometries[c]) for c in (0, 1)]
        has_fluid = np.concatenate(self._has_fluid)
        self.is_free: NDArray[np.bool_] = free_face_mask(grid, self._sides, None).reshape(-1) & has_fluid
        self._is_open = is_open

        parts = [self._component(c, geometries[c], apertures[c]) for c in (0, 1)]
        lines = [grid.face_centres(c)[c].reshape(-1) for c in (0, 1)]
        self.face_positions = (
            anp.concatenate([lines[0], parts[1]["centres"]]),
            anp.concatenate([parts[0]["centres"], lines[1]]),
        )
        self._assemble(parts)
        self._solid = _velocity_at_walls(grid, solid_velocity, geometries)
        self._operators()
        self._solid["outflow"] = self._outflow_through_walls(solid_velocity, walls)
        self._check_uniform_flows()
        protect(self.apertures, *self.face_positions, self.is_free)

    def recipe(self) -> tuple[type[CutFlow], tuple[Any, ...]]:
        """Return the call that constructs an equal object, without its set-ups."""
        return CutFlow, self._arguments

    @property
    def info(self) -> Any:
        """Records of the last solves."""
        return self._root.info

    # ------------------------------------------------------------ flows

    def steady(self, viscosity: Any, v: Any = 0.0, walls: Any = None, guess: Any = None) -> dict:
        """Return the steady flow.

        Parameters
        ----------
        viscosity : number
            Kinematic viscosity [length^2 / time], > 0.
        v : number or array, a field on the faces
            The velocity on inflow boundaries, and the normal velocity of walls; other faces are not used.
        walls : array, optional
            Tangential velocities of walls and inflow boundaries, on ``face_lift(grid, boundary).domain``. Default: 0.
        guess : dict, optional
            A flow, where Newton's method starts. Default: the flow without inertia.

        Returns
        -------
        dict
            ``{"v": faces, "p": cells}``. Without an outflow, the pressure is 0 in one cell of each region.

        Raises
        ------
        IncompatibleError
            If inflow and outflow of a region without an outflow boundary differ.
        ConvergenceError
            If Newton's method does not find a steady flow; a `guess` for a larger viscosity may help.

        Notes
        -----
        Differentiable in the viscosity, v, walls, the level and the velocity of the body, by the implicit function
        theorem: one solve with the transposed Jacobian. `guess` has no derivative.
        """
        parameters = self._parameters(viscosity, v, walls)
        self._check_balance(parameters[3])
        if guess is None:
            guess = self._stokes_flow(*mapped(lambda leaf: np.asarray(sample(leaf)), parameters))
        else:
            self._check_flow("guess", guess)
        return self._root(guess, *parameters)

    def _stokes_flow(self, *parameters):
        """Return the flow without inertia for plain parameters."""
        faces = self.grid.faces.size
        rest = {"v": np.zeros(faces), "p": np.zeros(self.grid.shape)}
        if not self._convection:
            return rest
        rates = self._rates(False, rest, *parameters)
        jacobian = from_matrix(self._jacobian(False, rest, *parameters), name="cut_flow without inertia")
        change = inverse(jacobian, "direct")(-np.append(rates["v"], rates["p"]))
        return {"v": change[:faces], "p": change[faces:].reshape(self.grid.shape)}

    def residual(self, x: dict, viscosity: Any, v: Any = 0.0, walls: Any = None) -> dict:
        """Return the rates of change of a flow, which are 0 for a steady flow; for `implicit` and `continuation`.

        Parameters
        ----------
        x : dict
            A flow.
        viscosity, v, walls
            As for `steady`.

        Returns
        -------
        dict
            "v": rate of the velocity on free faces, difference from the given velocity on all others. "p": the
            divergence.
        """
        self._check_flow("x", x)
        return self._rates(self._convection, x, *self._parameters(viscosity, v, walls))

    def jacobian(self, x: dict, viscosity: Any, v: Any = 0.0, walls: Any = None) -> sp.csr_array:
        """Return the derivative of `residual` in the flow as a sparse matrix.

        For ``implicit(flow.residual, flow.jacobian)``.

        Parameters
        ----------
        x : dict
            A flow, not traced.
        viscosity, v, walls
            As for `steady`.

        Returns
        -------
        sparse array
        """
        self._check_flow("x", x)
        return self._jacobian(self._convection, x, *self._parameters(viscosity, v, walls))

    def force(self, x: dict, viscosity: Any) -> Any:
        """Return the force of the fluid on the body, divided by the density: stresses and pressure at the wall.

        Parameters
        ----------
        x : dict
            A flow.
        viscosity : number

        Returns
        -------
        array, shape (2,)
            Both components [length^3 / time^2 in 2-D].
        """
        check_values(_check_viscosity, viscosity)
        self._check_flow("x", x)
        v = x["v"]
        at_wall = self._at_wall(self._wall_terms(self._weights, v, self._solid))
        pressure = self._sum_of_components(self.apertures * self._pressure_force(x["p"]))
        # What enters control volumes of closed faces without an equation is taken by the body, too.
        entering = viscosity * self._stress(self._weights, v, self._solid, np.zeros(self._walls_space.size))
        if self._convection:
            gain = self._gain(self._fluxes.carried(v) * self._fluxes.carrier(self.apertures * v))
            entering = entering - self.grid.faces.volumes * gain
        entering = self._sum_of_components((~self._is_open & ~self.is_free) * entering)
        return entering - viscosity * at_wall - pressure

    # ------------------------------------------------------------ the equations

    def _parameters(self, viscosity, v, walls):
        """Return the parameters of the equations behind the flow."""
        check_values(_check_viscosity, viscosity)
        v = self._field("v", v)
        if walls is None:
            walls = np.zeros(self._walls_space.size)
        else:
            check_walls("cut_flow", walls, self._walls_space)
            self._check_numbers("walls", walls)
        return self._weights, self._solid, viscosity, v, walls

    def _rates(self, convection, x, weights, solid, viscosity, boundary_velocity, walls):
        """Return the residual; `weights` is the dict of all numbers that depend on the level."""
        v = x["v"]
        apertures = weights["apertures"]
        rate = viscosity * self._stress(weights, v, solid, walls)
        rate = rate + apertures * self._pressure_force(x["p"])
        rate = self._per_volume * rate
        if convection:
            rate = rate - self._gain(self._fluxes.carried(v, walls) * self._fluxes.carrier(apertures * v))
        outflow = self._divergence(apertures * v) + solid["outflow"]
        return {
            "v": self.is_free * rate + ~self.is_free * (self._is_open * boundary_velocity - v),
            "p": outflow + self._pin * x["p"],
        }

    def _stress(self, weights, v, solid, walls):
        """Return the integral of the Laplacian over the control volume of each face."""
        through = weights["conductances"] * self._difference(v)
        at_sides = weights["sides"] * (self._walls_at_sides(walls) - self._faces_at_sides(v))
        terms = self._wall_terms(weights, v, solid)
        return self._faces_at_sides.T(at_sides) - self._difference.T(through) + self._sum_of_terms(terms)

    def _wall_terms(self, weights, v, solid):
        """Return the terms with the gradient at the wall: its normal part by the fit, its tangential part given."""
        pairs = weights["slopes"] * (self._faces_of_pairs(v) - self._walls_of_pairs(solid["values"]))
        slopes = self._walls_of_terms(self._walls_of_pairs.T(pairs))
        return weights["factors"] * slopes + weights["tangential"] * self._walls_of_terms(solid["slopes"])

    def _jacobian(self, convection, x, weights, solid, viscosity, boundary_velocity, walls):
        """Return the derivative of the residual in the flow."""
        numbers = {name: np.asarray(sample(value)) for name, value in weights.items()}
        v = np.asarray(sample(x["v"]))
        viscosity = float(sample(viscosity))
        apertures = sp.diags_array(numbers["apertures"])
        slopes = sp.diags_array(numbers["slopes"]) @ self._faces_of_pairs.matrix
        terms = (
            sp.diags_array(numbers["factors"]) @ self._walls_of_terms.matrix @ self._walls_of_pairs.matrix.T @ slopes
        )
        difference, sides = self._difference.matrix, self._faces_at_sides.matrix
        stress = self._sum_of_terms.matrix @ terms
        stress = stress - difference.T @ sp.diags_array(numbers["conductances"]) @ difference
        stress = stress - sides.T @ sp.diags_array(numbers["sides"]) @ sides
        free = sp.diags_array(self.is_free.astype(float))
        momentum = viscosity * (sp.diags_array(self._per_volume) @ stress)
        if convection:
            carried, carrier = self._fluxes.matrices
            carrier = carrier @ apertures
            carried_now = self._fluxes.carried(v, np.asarray(sample(walls)))
            fluxes = sp.diags_array(carried_now) @ carrier + sp.diags_array(carrier @ v) @ carried
            momentum = momentum - self._gain.matrix @ fluxes
        momentum = free @ momentum - sp.diags_array((~self.is_free).astype(float))
        pressure = free @ sp.diags_array(self._per_volume) @ apertures @ self._pressure_force.matrix
        outflow = self._divergence.matrix @ apertures
        return sp.block_array([[momentum, pressure], [outflow, sp.diags_array(self._pin.reshape(-1))]], format="csr")

    # ------------------------------------------------------------ set-up

    def _component(self, component, geometry, apertures):
        """Return the places and weights of the stresses of one component."""
        grid = self.grid
        other = 1 - component
        shape = grid.face_shape(component)
        numbers = np.moveaxis(np.arange(apertures.size).reshape(shape), component, 0)  # of the faces, own axis first
        flat = np.argsort(numbers.reshape(-1))
        is_open = self._has_fluid[component]
        centres = anp.reshape(geometry.centres, (-1,))[flat]
        walls = geometry.walls
        fit = wall_fit(grid, component, walls, apertures, centres)
        wall_of = np.full(apertures.size, -1)
        wall_of[walls.places] = np.arange(walls.places.size)
        own = np.flatnonzero(is_open[walls.places])
        shortest = min(float(np.min(widths)) for widths in grid.widths)
        terms = [(walls.places[own], own, walls.areas[own], np.zeros(own.size))]
        tangent = (-walls.normals[1], walls.normals[0])
        corrections = []
        lowers, uppers, conductances = [], [], []

        for axis in (component, other):
            lower, upper, areas, distances, side_centres = self._pairs(component, axis, geometry, numbers, centres)
            has_area = np.asarray(sample(areas)) > 0
            both = np.flatnonzero(is_open[lower] & is_open[upper] & has_area)
            conductance = areas[both] / anp.maximum(distances[both], SHORTEST * shortest)
            lowers.append(lower[both])
            uppers.append(upper[both])
            conductances.append(conductance)
            if axis == component:
                for faces, sign in ((lower[both], -1.0), (upper[both], 1.0)):
                    cut = np.flatnonzero(wall_of[faces] >= 0)
                    wall = wall_of[faces[cut]]
                    shift = side_centres[both[cut]] - centres[faces[cut]]
                    moved = sign * conductance[cut] * shift
                    by_slope = -moved * walls.normals[other][wall]
                    by_tangent = moved * tangent[other][wall]
                    corrections.append((lower[both[cut]], wall, by_slope, by_tangent))
                    corrections.append((upper[both[cut]], wall, -by_slope, -by_tangent))

        return {
            "lower": np.concatenate(lowers),
            "upper": np.concatenate(uppers),
            "conductances": anp.concatenate(conductances),
            "sides": self._sides_on_walls(component, geometry, numbers, is_open),
            "terms": _joined_terms(terms),
            "corrections": _joined_terms(corrections),
            "fit": fit,
            "centres": centres,
            "walls": walls.places.size,
            "faces": apertures.size,
        }

    def _pairs(self, component, axis, geometry, numbers, centres):
        """Return the faces below and above each side across an axis, its open area, their distance and its centre."""
        grid = self.grid
        is_periodic = grid.periodic[axis]
        if axis == component:
            count = grid.shape[axis]
            lower = numbers[:count].reshape(-1)
            upper = np.roll(numbers, -1, 0)[:count].reshape(-1)
            distances = np.repeat(grid.widths[axis], numbers.shape[1])
            areas = anp.reshape(geometry.middle_areas, (-1,))
            return lower, upper, areas, distances, anp.reshape(geometry.middle_centres, (-1,))
        if is_periodic:
            upper_columns = np.arange(grid.shape[axis])
        else:
            upper_columns = np.arange(1, grid.shape[axis])
        lower = numbers[:, upper_columns - 1].reshape(-1)
        upper = numbers[:, upper_columns].reshape(-1)
        turns = np.broadcast_to(upper_columns == 0, (numbers.shape[0], upper_columns.size)).reshape(-1)
        distances = centres[upper] - centres[lower] + turns * grid.size[axis]
        return lower, upper, anp.reshape(geometry.outer_areas[:, upper_columns], (-1,)), distances, None

    def _sides_on_walls(self, component, geometry, numbers, is_open):
        """Return faces, places in the wall velocities (-1: none) and conductances of the sides on walls of the grid."""
        grid = self.grid
        axis = 1 - component
        faces, places, conductances = [np.zeros(0, int)], [np.zeros(0, int)], [np.zeros(0)]
        if grid.periodic[axis]:
            return faces[0], places[0], conductances[0]
        slopes = _slopes_at_walls(grid, self._sides, component)
        offsets = self._walls_space.offsets
        for side in (0, 1):
            touching = numbers[:, -side]
            of_slope = slopes[side]
            chosen = np.flatnonzero(is_open[touching] & (of_slope > 0))
            faces.append(touching[chosen])
            conductances.append((geometry.outer_areas[:, -side] * of_slope)[chosen])
            first = -1
            if (axis, side, component) in self._has_walls:
                first = offsets[self._has_walls.index((axis, side, component))]
            places.append(first + (first >= 0) * chosen)
        return np.concatenate(faces), np.concatenate(places), anp.concatenate(conductances)

    def _assemble(self, parts):
        """Store the weights and the places of both components, one after the other."""
        size = self.grid.faces.size
        first_face = np.array([0, parts[0]["faces"]])
        first_wall = np.array([0, parts[0]["walls"]])
        wall_count = parts[0]["walls"] + parts[1]["walls"]

        def joined(name, first):
            return np.concatenate([part[name] + offset for part, offset in zip(parts, first, strict=True)])

        lower = joined("lower", first_face)
        upper = joined("upper", first_face)
        self._difference = from_matrix(_selection(upper, size) - _selection(lower, size), name="difference")
        side_faces = np.concatenate([part["sides"][0] + first for part, first in zip(parts, first_face, strict=True)])
        side_places = np.concatenate([part["sides"][1] for part in parts])
        self._faces_at_sides = from_matrix(_selection(side_faces, size), name="faces at walls")
        self._walls_at_sides = from_matrix(_selection(side_places, self._walls_space.size), name="walls at faces")

        fits = [part["fit"] for part in parts]
        pair_faces = np.concatenate([fit.faces + first for fit, first in zip(fits, first_face, strict=True)])
        pair_walls = np.concatenate([fit.walls + first for fit, first in zip(fits, first_wall, strict=True)])
        self._faces_of_pairs = from_matrix(_selection(pair_faces, size), name="faces of pairs")
        self._walls_of_pairs = from_matrix(_selection(pair_walls, wall_count), name="walls of pairs")

        # First the terms that are stresses at the wall, whose sum is a force, then those between two faces.
        rows, walls, factors, tangential, components, is_wall = [], [], [], [], [], []
        for name in ("terms", "corrections"):
            for component, part in enumerate(parts):
                faces, numbers, of_slope, of_tangent = part[name]
                rows.append(faces + first_face[component])
                walls.append(numbers + first_wall[component])
                factors.append(of_slope)
                tangential.append(of_tangent)
                components.append(np.full(faces.size, component))
                is_wall.append(np.full(faces.size, name == "terms"))
        row = np.concatenate(rows)
        self._sum_of_terms = sum_at_places(row, size)
        self._walls_of_terms = from_matrix(_selection(np.concatenate(walls), wall_count), name="walls of terms")
        at_wall = _selection(np.concatenate(components), 2).T @ sp.diags_array(np.concatenate(is_wall).astype(float))
        self._at_wall = from_matrix(at_wall, name="sum at wall")
        self._weights = {
            "apertures": self.apertures,
            "conductances": anp.concatenate([part["conductances"] for part in parts]),
            "sides": anp.concatenate([part["sides"][2] for part in parts]),
            "slopes": anp.concatenate([fit.weights for fit in fits]),
            "factors": anp.concatenate(factors),
            "tangential": anp.concatenate(tangential),
        }

    def _operators(self):
        """Store the operators that do not depend on the level, and where the pressure is pinned."""
        grid = self.grid
        volumes = grid.faces.volumes
        self._per_volume = np.divide(1.0, volumes, out=np.zeros_like(volumes), where=volumes > 0)
        self._divergence = divergence(grid)
        outflow = sp.csr_array(sp.diags_array(grid.volumes.reshape(-1)) @ self._divergence.matrix)
        self._pressure_force = from_matrix(outflow.T, grid.cells, grid.faces, "force of the pressure")
        self._fluxes = MomentumFluxes(grid, self._sides)
        self._gain = self._fluxes.gain
        component = np.repeat([0, 1], [int(np.prod(part)) for part in grid.faces.parts])
        self._sum_of_components = from_matrix(_selection(component, 2).T, name="sum of components")

        through = self.is_free & self._is_open
        touching = abs(outflow) @ sp.diags_array(through.astype(float))
        count, region = connected_components(touching @ touching.T, directed=False)
        through_ends = np.flatnonzero(through & (np.asarray((touching > 0).sum(axis=0)).reshape(-1) == 1))
        has_end = np.zeros(count, bool)
        has_end[region[(touching[:, through_ends]).nonzero()[0]]] = True
        pin = np.zeros(grid.cells.size)
        _, first = np.unique(region, return_index=True)
        pin[first[~has_end]] = 1.0
        self._pin = pin.reshape(grid.shape)
        closed = np.where(has_end[region], -1, region)
        self._closed_regions = _selection(closed, count).T @ sp.diags_array(grid.volumes.reshape(-1))

    def _outflow_through_walls(self, solid_velocity, walls):
        """Return the outflow of each cell through the wall of the body, divided by the volume of the cell.

        The wall is a polygon, so that the outflow is not 0 for a velocity that is tangential to a curved wall. The sum
        over a region without an outflow would be of second order: it is set to 0.
        """
        grid = self.grid
        velocity = _wall_velocity(solid_velocity, walls.centroids)
        _check_tangential(velocity, walls)
        rates = np.zeros(walls.places.size)
        sizes = np.zeros(walls.places.size)
        for axis in (0, 1):
            constant = grid.join(*(float(a == axis) for a in (0, 1)))
            closing = anp.reshape(self._divergence(self.apertures * constant), (-1,))[walls.places]
            rates = rates - velocity[axis] * closing
            sizes = sizes + np.abs(np.asarray(sample(velocity[axis] * closing)))
        outflow = sum_at_places(walls.places, grid.cells.size)(rates)

        totals = self._closed_regions @ np.asarray(sample(outflow))
        bound = self._closed_regions @ np.bincount(walls.places, sizes, grid.cells.size)
        if np.any(abs(totals) > LARGEST_WALL_IMBALANCE * bound):
            raise IncompatibleError(NOT_TANGENTIAL)
        volumes = grid.volumes.reshape(-1)
        areas = anp.reshape(sum_at_places(walls.places, grid.cells.size)(walls.areas), (-1,))
        regions = from_matrix(self._closed_regions)
        all_areas = regions(areas / volumes)
        excess = regions(outflow) / anp.where(np.asarray(sample(all_areas)) > 0, all_areas, 1.0)
        return anp.reshape(outflow - areas / volumes**2 * regions.T(excess), grid.shape)

    def _check_balance(self, velocity):
        """Raise IncompatibleError if more enters a closed region than leaves it."""
        prescribed = np.asarray(sample(self.apertures)) * ~self.is_free * np.asarray(sample(velocity))
        excess = self._closed_regions @ (self._divergence.matrix @ prescribed)
        size = self._closed_regions @ (abs(self._divergence.matrix) @ abs(prescribed))
        if np.any(abs(excess) > LARGEST_IMBALANCE * size):
            raise IncompatibleError(
                "cut_flow: inflow and outflow through the walls of a region differ; make the given velocity balance, "
                "or open a wall with dp.outflow"
            )

    def _field(self, name, value):
        """Return an argument as a field on the faces; a number is repeated."""
        check_plain("cut_flow", value)
        shape = np.shape(sample(value))
        space = self.grid.faces
        if shape not in ((), space.shape):
            raise ShapeError(f"{name} of cut_flow takes a number or a field on {space}, got an array of shape {shape}")
        self._check_numbers(name, value)
        return value * np.ones(space.shape) if shape == () else value

    def _check_flow(self, name, x):
        """Raise an error unless x is a dict with a velocity and a pressure: real, finite, and of the right shapes."""
        parts = {"v": self.grid.faces, "p": self.grid.cells}
        is_dict = isinstance(sample(x), dict)
        if not is_dict or set(x) != set(parts):
            described = f"a dict with the keys {sorted(x)}" if is_dict else type(sample(x)).__name__
            raise TypeError(
                f'{name} of cut_flow must be a flow {{"v": faces, "p": cells}}, such as steady returns, got {described}'
            )
        for key, space in parts.items():
            check_on(f"x[{key!r}] of cut_flow", x[key], space)
            self._check_numbers(f"x[{key!r}]", x[key])

    def _check_numbers(self, name, value):
        """Raise an error unless an argument, traced or not, holds finite real numbers."""
        name = f"{name} of cut_flow"
        check_kind(name, dtype_of(value), "real numbers")
        check_values(partial(check_finite, name), value)

    def _check_uniform_flows(self):
        """Raise an error if a uniform velocity can be added to every flow, so that none is determined."""
        rest = mapped(np.zeros_like, mapped(lambda leaf: np.asarray(sample(leaf)), self._solid))
        for axis in (0, 1):
            uniform = self.grid.join(*(float(a == axis) for a in (0, 1)))
            stress = self._stress(self._weights, uniform, rest, np.zeros(self._walls_space.size))
            if np.all(self.is_free[uniform > 0]) and not np.any(np.asarray(sample(stress))):
                raise IncompatibleError(
                    f"cut_flow: no wall, inflow or body determines the velocity along {'xy'[axis]}; give the level a "
                    "body, or another boundary"
                )

    def __repr__(self) -> str:
        counts = f"{np.count_nonzero(self._is_open)} of {self._is_open.size} faces are open"
        return f"<cut_flow: {counts}, {self._walls_of_pairs.domain.size} control volumes are cut>"


def _of_order_one(grid, level):
    """Return the level, clipped far from the wall, and divided by a power of two.

    Jumps far from the wall would appear as bodies where the level is interpolated. Products of the levels of some nodes
    do not overflow.
    """
    values = np.asarray(sample(level))
    padded = values > 0
    for axis, is_periodic in enumerate(grid.periodic):
        padding = [(int(a == axis),) * 2 for a in range(grid.dim)]
        padded = np.pad(padded, padding, mode="wrap" if is_periodic else "edge")
    is_near = np.zeros(values.shape, bool)
    for step in product((0, 1, 2), repeat=grid.dim):
        neighbours = tuple(slice(first, first + n) for first, n in zip(step, values.shape, strict=True))
        is_near |= (values > 0) != padded[neighbours]
    sizes = np.where(is_near, np.abs(values), 0.0) if is_near.any() else np.abs(values)
    place = int(np.argmax(sizes))
    largest = float(sizes.reshape(-1)[place])

    beyond = min(2.0 * FARTHEST * largest, float(np.finfo(float).max))  # larger values may overflow below
    clipped = anp.minimum(anp.maximum(level, -beyond), beyond)
    exponent = int(np.frexp(largest)[1])
    half = exponent // 2  # 2^-exponent alone overflows for the smallest numbers
    scaled = 2.0**-half * clipped * 2.0 ** (half - exponent)
    limit = FARTHEST * anp.abs(anp.reshape(scaled, (-1,))[place])
    return anp.minimum(anp.maximum(scaled, -limit), limit)


def _has_fluid(grid, component, geometry):
    """Return the mask of the faces, flat, that are open or whose control volume has an open side."""
    middle = np.asarray(sample(geometry.middle_areas)) > 0
    outer = np.asarray(sample(geometry.outer_areas)) > 0
    if grid.periodic[component]:
        at_middle = middle | np.roll(middle, 1, 0)
    else:
        none = np.zeros((1, middle.shape[1]), bool)
        at_middle = np.concatenate([middle, none]) | np.concatenate([none, middle])
    upper = np.roll(outer, -1, 1) if grid.periodic[1 - component] else outer[:, 1:]
    at_outer = outer[:, : upper.shape[1]] | upper
    has_fluid = (np.asarray(sample(geometry.apertures)) > 0) | at_middle | at_outer
    return (has_fluid.T if component else has_fluid).reshape(-1)


def _check_viscosity(viscosity):
    check_number("the viscosity of cut_flow", viscosity, "> 0")


def _selection(places: NDArray, size: int) -> sp.csr_array:
    """Return the matrix that takes entries of a flat array; a negative place gives 0."""
    rows = np.flatnonzero(places >= 0)
    return sp.csr_array((np.ones(rows.size), (rows, places[rows])), shape=(places.size, size))


def _joined_terms(terms):
    """Return faces, walls and both factors of terms, one after the other."""
    faces, walls, factors, tangential = zip(*terms, strict=True)
    return np.concatenate(faces), np.concatenate(walls), anp.concatenate(factors), anp.concatenate(tangential)


def _slopes_at_walls(grid, sides, component):
    """Return the factor from the velocity on faces of a component to its slope at the two walls of the other axis."""
    axis = 1 - component
    shape = grid.face_shape(component)
    spacing = [np.ones(n) if a == component else grid.widths[a] for a, n in enumerate(shape)]
    lattice = Grid(shape, spacing=spacing, periodic=grid.periodic)
    slope = gradient(lattice, {grid.axes[axis]: conditions_along(grid, sides, axis, component)})
    size = np.asarray(abs(slope.matrix).sum(axis=1)).reshape(-1)
    lines = np.moveaxis(lattice.split(size)[axis], axis, 0)
    return lines[0], lines[-1]


def _wall_velocity(solid_velocity: Callable | float, coordinates: Sequence) -> tuple[Any, Any]:
    """Return both components of the velocity of the body at some points; raise an error for an invalid result."""
    name = "solid_velocity of cut_flow"
    if not callable(solid_velocity):
        check_values(partial(check_number, name), solid_velocity)
        return solid_velocity, solid_velocity
    velocity = solid_velocity(*coordinates)
    is_pair = isinstance(velocity, (tuple, list)) and len(velocity) == 2
    if not is_pair:
        raise ShapeError(f"{name} must return a pair of components; write lambda x, y: (-omega * y, omega * x)")
    for component in velocity:
        shape = np.shape(sample(component))
        if shape not in ((), np.shape(coordinates[0])):
            raise ShapeError(f"{name} must return numbers or arrays of the shape of x, got an array of shape {shape}")
        check_kind(name, dtype_of(component), "real numbers", "; write its .real")
        check_values(partial(check_finite, name), component)
    return velocity[0], velocity[1]


def _check_tangential(velocity, walls):
    """Raise IncompatibleError if the velocity of the body has a large part along the normals of its wall."""
    u, v = (np.asarray(sample(component)) for component in velocity)
    n_x, n_y = (np.asarray(sample(normal)) for normal in walls.normals)
    areas = np.asarray(sample(walls.areas))
    if np.sum(areas * np.abs(u * n_x + v * n_y)) > LARGEST_NORMAL_SHARE * np.sum(areas * np.hypot(u, v)):
        raise IncompatibleError(NOT_TANGENTIAL)


def _velocity_at_walls(grid: Grid, solid_velocity: Callable | float, geometries: list) -> dict:
    """Return the velocity of the body at all walls and its slope along them, one component after the other."""
    step = 0.25 * min(float(np.min(widths)) for widths in grid.widths)
    values, slopes = [], []
    for component, geometry in enumerate(geometries):
        walls = geometry.walls
        ones = np.ones(walls.places.size)
        tangent = (-walls.normals[1], walls.normals[0])
        at_wall, ahead, behind = (
            _wall_velocity(solid_velocity, [x + shift * t for x, t in zip(walls.centroids, tangent, strict=True)])[
                component
            ]
            * ones
            for shift in (0.0, step, -step)
        )
        values.append(at_wall)
        slopes.append((ahead - behind) / (2 * step))
    return {"values": anp.concatenate(values), "slopes": anp.concatenate(slopes)}
