"""Flow conditions on part of a wall, against sums over the sides of control volumes that are written as loops."""

import pickle

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

BOX = dp.Grid((4, 5), spacing=[[0.5, 0.3, 0.2, 0.4], [0.1, 0.4, 0.3, 0.2, 0.3]])
INLET = dp.patch([False, True, True, False, False], dp.inflow)
OUTLET = dp.patch([True, True, False, False, False], dp.outflow)
CEILING = dp.patch([False, False, True, False], dp.outflow, elsewhere=dp.free_slip)
SIDES = {"x": (INLET, OUTLET), "y": (dp.no_slip, CEILING)}
CLOSED_IN_PART = dp.patch([True, False, False, True], dp.inflow, elsewhere=dp.free_slip)
CLOSED_OR_OPEN = dp.patch([False, True, True, False, False], dp.outflow, elsewhere=dp.free_slip)
INLET_POINTS = np.array([0.0, 0.3, 0.5, 0.4, 0.0, 0.0])  # tangential velocities on the wall with the inlet
# The condition of each face of each wall: i inflow, o outflow, n no_slip, f free_slip.
WALLS = {(0, 0): "niinn", (0, 1): "oonnn", (1, 0): "nnnn", (1, 1): "ffof"}


def condition_at(axis, side, position, count):
    """Whether a tangential velocity is given at a point of a wall: if one of the faces that it touches is i or n."""
    faces = WALLS[axis, side]
    return any(faces[f] in "in" for f in (position - 1, position) if 0 <= f < count)


def is_free(axis, i, j):
    """Whether the velocity on a face is unknown: inside, and on outflow faces."""
    n = BOX.shape[axis]
    along, across = (i, j) if axis == 0 else (j, i)
    if 0 < along < n:
        return True
    return WALLS[axis, int(along == n)][across] == "o"


def wall_value(walls, axis, side, position):
    """The tangential velocity at a point of a wall, given as {(axis, side): array}."""
    return walls[axis, side][position]


def values_across(v, component, position):
    """Return the function from a centre across the direction of a component to its value at a node along it."""

    def value(centre):
        return v[component][(position, centre) if component == 0 else (centre, position)]

    return value


def at_edge(v, walls, component, i, j):
    """Return the value of a component at the edge of cells, node (i, j), from both sides or from the wall."""
    across = 1 - component  # the component has its points on nodes along its own axis and on centres across it
    h = BOX.widths[across]
    node = (i, j)[across]
    position = (i, j)[component]
    value = values_across(v, component, position)
    if 0 < node < h.size:
        return (h[node] * value(node - 1) + h[node - 1] * value(node)) / (h[node] + h[node - 1])
    side = int(node == h.size)
    if condition_at(across, side, position, BOX.shape[component]):
        return wall_value(walls, across, side, position)
    return value(node - side)


def slope_at_edge(v, walls, component, i, j):
    """Return the derivative of a component across its direction, at the edge (i, j)."""
    across = 1 - component
    h = BOX.widths[across]
    node = (i, j)[across]
    position = (i, j)[component]
    value = values_across(v, component, position)
    if 0 < node < h.size:
        return (value(node) - value(node - 1)) / ((h[node] + h[node - 1]) / 2)
    side = int(node == h.size)
    if not condition_at(across, side, position, BOX.shape[component]):
        return 0.0
    wall = wall_value(walls, across, side, position)
    if side:
        return (wall - value(node - 1)) / (h[-1] / 2)
    return (value(0) - wall) / (h[0] / 2)


def by_hand(v, w, walls):
    """Return the Laplacian of v, and div(w v), by the sum over the four sides of each control volume."""
    laplacian = [np.zeros(BOX.face_shape(a)) for a in range(2)]
    convection = [np.zeros(BOX.face_shape(a)) for a in range(2)]
    at_rest = {key: np.zeros(len(faces) + 1) for key, faces in WALLS.items()}
    for c in range(2):
        h = BOX.widths[c]
        across = 1 - c
        for i, j in np.ndindex(BOX.face_shape(c)):
            if not is_free(c, i, j):
                continue
            node, centre = (i, j) if c == 0 else (j, i)

            def on(u, node, centre=centre, c=c):
                return u[c][(node, centre) if c == 0 else (centre, node)]

            stress = flux = 0.0
            length = 0.0
            for sign, cell in ((1, node), (-1, node - 1)):
                if 0 <= cell < h.size:
                    stress += sign * (on(v, cell + 1) - on(v, cell)) / h[cell]
                    mean = (on(v, cell) + on(v, cell + 1)) / 2 * (on(w, cell) + on(w, cell + 1)) / 2
                    flux += sign * mean
                    length += h[cell] / 2
                else:  # beyond a face of the outflow, no stress acts, and the velocity equals the velocity of the face
                    flux += sign * on(v, node) * on(w, node)
            laplacian[c][i, j] = stress / length
            convection[c][i, j] = flux / length
            for sign in (1, -1):
                edge = (i, j + (sign > 0)) if c == 0 else (i + (sign > 0), j)
                width = BOX.widths[across][centre]
                carried = at_edge(v, walls, c, *edge)
                carrier = at_edge(w, at_rest, across, *edge)
                laplacian[c][i, j] += sign * slope_at_edge(v, walls, c, *edge) / width
                convection[c][i, j] += sign * carried * carrier / width
    return BOX.join(*laplacian), BOX.join(*convection)


def wall_velocities(rng):
    """Return random tangential velocities as a dict of walls, and as a field on the domain of face_lift."""
    walls = {key: rng.standard_normal(len(faces) + 1) for key, faces in WALLS.items()}
    domain = dp.face_lift(BOX, SIDES).domain
    return walls, domain.join(*(walls[key] for key in ((0, 0), (0, 1), (1, 0))))


def test_viscosity_and_convection_are_those_of_the_control_volumes(rng):
    walls, flat = wall_velocities(rng)
    v, w = rng.standard_normal((2, BOX.faces.size))
    laplacian, convection = by_hand(BOX.split(v), BOX.split(w), walls)
    L, B = dp.face_laplacian(BOX, SIDES), dp.face_lift(BOX, SIDES)
    for form in (L.explicit(), L.matrix_free()):
        np.testing.assert_allclose(form(v) + B(flat), laplacian, rtol=1e-12, atol=1e-11)
    np.testing.assert_allclose(dp.convection(BOX, SIDES)(v, w, flat), convection, rtol=1e-12, atol=1e-11)
    nowhere = np.zeros(BOX.shape, bool)
    np.testing.assert_allclose(dp.face_laplacian(BOX, SIDES, nowhere)(v), L(v), rtol=1e-12, atol=1e-11)


def dense_projection():
    """Return K and G p: the mask of open faces, and the gradient of a pressure of 0 on outflow faces, by loops."""
    keep = np.zeros(BOX.faces.size)
    G = np.zeros((BOX.faces.size, BOX.cells.size))
    cell = np.arange(BOX.cells.size).reshape(BOX.shape)
    for axis in range(2):
        h = BOX.widths[axis]
        for i, j in np.ndindex(BOX.face_shape(axis)):
            row = BOX.faces.offsets[axis] + np.ravel_multi_index((i, j), BOX.face_shape(axis))
            node, across = (i, j) if axis == 0 else (j, i)
            at = (lambda k, across=across: cell[k, across]) if axis == 0 else (lambda k, across=across: cell[across, k])
            if 0 < node < h.size:
                keep[row] = 1.0
                G[row, at(node)] += 2 / (h[node] + h[node - 1])
                G[row, at(node - 1)] -= 2 / (h[node] + h[node - 1])
                continue
            side = int(node == h.size)
            letter = WALLS[axis, side][across]
            keep[row] = letter in "io"
            if letter == "o":
                G[row, at(node - side)] = (1 - 2 * side) * 2 / h[node - side]
    return keep, G


@pytest.mark.parametrize("method", ["auto", pytest.param("multigrid", marks=pytest.mark.whole)])
def test_projection_is_the_dense_one(method, rng):
    P = dp.projection(BOX, boundary=SIDES, method=method)
    keep, G = dense_projection()
    D = dp.divergence(BOX).matrix.toarray()
    x = rng.standard_normal((2, BOX.faces.size))
    p = np.linalg.solve(-D @ G, D @ np.diag(keep) @ x.T)
    np.testing.assert_allclose(P(x), (np.diag(keep) @ x.T + G @ p).T, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(P.pressure(x).reshape(2, -1), p.T, rtol=1e-9, atol=1e-9)
    assert dp.check.operator(P)


def test_projection_by_transforms_knows_where_a_wall_is_open(rng):
    """An inflow has the pressure condition of a closed wall, so that the pressure is found by transforms."""
    P = dp.projection(BOX, boundary={"x": (INLET, dp.outflow), "y": (dp.no_slip, CLOSED_IN_PART)})
    assert P.method == "separable"
    v = rng.standard_normal(BOX.faces.size)
    solid = np.zeros(BOX.shape, bool)  # the same by factors of the matrix
    other = dp.projection(BOX, solid, {"x": (INLET, dp.outflow), "y": (dp.no_slip, CLOSED_IN_PART)}, method="direct")
    np.testing.assert_allclose(P(v), other(v), rtol=1e-10, atol=1e-10)
    assert np.max(np.abs(dp.divergence(BOX)(P(v)))) <= 1e-11
    assert dp.check.operator(P)


def test_mass_that_enters_leaves_through_the_opening(rng):
    v = dp.projection(BOX, boundary=SIDES)(rng.standard_normal(BOX.faces.size))
    left, right = (BOX.split(v)[0][i] for i in (0, -1))
    ceiling = BOX.split(v)[1][:, -1]
    assert np.all(left[[0, 3, 4]] == 0) and np.all(right[2:] == 0) and np.all(ceiling[[0, 1, 3]] == 0)
    hx, hy = BOX.widths
    assert abs(hy @ left - hy @ right - hx @ ceiling) <= 1e-13
    assert np.max(np.abs(dp.divergence(BOX)(v))) <= 1e-12


def test_a_full_patch_is_the_plain_flow_condition(rng):
    plain = {"x": (dp.inflow, dp.outflow)}
    full = {"x": (dp.patch((0.0, 1.3), dp.inflow), dp.patch([True] * 5, dp.outflow))}
    v = rng.standard_normal(BOX.faces.size)
    for build in (dp.face_laplacian, dp.projection, dp.convection):
        one, other = ((dp.projection(BOX, None, b) if build is dp.projection else build(BOX, b)) for b in (plain, full))
        arguments = (v, v) if build is dp.convection else (v,)
        np.testing.assert_array_equal(one(*arguments), other(*arguments))


def test_rules_for_openings():
    with pytest.raises(ValueError, match="the inflow on the lower x side enters a region without an outflow"):
        dp.projection(BOX, boundary={"x": (INLET, dp.no_slip)})
    wall = np.zeros(BOX.shape, bool)
    wall[1] = True  # the inlet and the outlet are in different parts
    with pytest.raises(ValueError, match="the inflow on the lower x side enters a region without an outflow"):
        dp.projection(BOX, wall, SIDES)
    wall[:, -1] = False  # now both are connected above the wall
    dp.projection(BOX, wall, SIDES)
    pocket = np.zeros(BOX.shape, bool)
    pocket[0, 3] = pocket[1, 4] = True  # the cell (0, 4) is closed off, at the closed part of the wall with the inlet
    dp.projection(BOX, pocket, SIDES)
    with pytest.raises(ValueError, match="boundary= has no such side"):
        dp.flow_step(BOX, 0.1, 0.01, boundary={"x": CLOSED_OR_OPEN, "y": dp.free_slip}, walls=np.ones(BOX.faces.size))


ROOM = dp.Grid((6, 6), size=1.0)
ROOM_SIDES = {"x": (dp.patch((0.5, 0.85), dp.inflow), dp.patch((0.0, 0.35), dp.outflow))}
HEATER = dp.patch((0.3, 0.7), dp.dirichlet)
HEAT_WALLS = {"x": (dp.patch((0.5, 0.85), dp.dirichlet), dp.neumann), "y": (HEATER, dp.neumann)}


def room(profile, heat, steps):
    """Return the final state of a flow through two openings over a heated strip of the floor."""
    lift = dp.lift(ROOM, HEAT_WALLS)
    values = lift.domain.join(0.0, 0.0, HEATER.values(ROOM, "y", heat), 0.0)
    inlet = ROOM.join(ROOM_SIDES["x"][0].values(ROOM, "x", profile)[None] * (ROOM.face_centres(0)[0] == 0), 0.0)
    step = dp.flow_step(
        ROOM,
        0.05,
        0.02,
        boundary=ROOM_SIDES,
        inflow=lambda p: inlet,
        scalars={"heat": {"diffusivity": 0.02, "boundary": HEAT_WALLS, "values": values}},
    )
    state = step.start(np.zeros(ROOM.faces.size), None, {"heat": np.zeros(ROOM.shape)})
    for _ in range(steps):
        state = step(state)
    return state


def test_a_room_keeps_its_mass_and_gains_the_heat_that_enters():
    state = room(np.ones(6), 1.0, 600)
    u, w = ROOM.split(state["v"])
    assert np.sum(u[0]) == 2.0 and abs(np.sum(u[-1]) - 2.0) <= 1e-12
    assert np.all(u[0, [0, 1, 2, 5]] == 0) and np.all(u[-1, 2:] == 0) and np.all(w[:, [0, -1]] == 0)
    assert np.max(np.abs(dp.divergence(ROOM)(state["v"]))) <= 1e-12
    heat = state["s"]["heat"]
    # Steady: what the strip and the cold inlet conduct is what the outlet carries away.
    h = 1 / 6
    conducted = 0.02 * np.sum((1.0 - heat[2:4, 0]) / (h / 2) * h) - 0.02 * np.sum(heat[0, 3:5] / (h / 2) * h)
    carried = np.sum(u[-1] * heat[-1]) * h
    assert conducted > 0.01 and abs(carried - conducted) <= 1e-3 * conducted


def loss_of_room(p):
    """A loss of the velocity at an inlet and of the heat of a strip."""
    state = room(p["profile"], p["heat"], 2)
    return anp.sum(state["s"]["heat"] ** 2) + anp.sum(state["v"] ** 2)


POINT = {"profile": np.linspace(0.5, 1.0, 6), "heat": np.array(0.7)}


def test_gradient_in_the_data_of_openings_and_patches(rng):
    _, gradient = dp.value_and_grad(loss_of_room)(POINT)
    direction = {"profile": rng.standard_normal(6), "heat": rng.standard_normal(())}
    values = [loss_of_room({name: POINT[name] + t * direction[name] for name in POINT}) for t in (1e-4, -1e-4)]
    slope = sum(np.sum(gradient[name] * direction[name]) for name in POINT)
    assert abs((values[0] - values[1]) / 2e-4 - slope) <= 1e-7 * abs(slope)
    assert np.all(gradient["profile"][[0, 1, 2, 5]] == 0)


@pytest.mark.whole
def test_gradient_in_the_data_of_openings_and_patches_to_second_order():
    audit = dp.check.gradient(loss_of_room, POINT)
    assert audit.verdict == audit.hessian == "agrees"


def test_tangential_velocities_at_an_inlet_are_read_from_both_forms(rng):
    """A flow that enters a part of a wall at an angle: walls= as a function, and as the result of face_lift."""
    B = dp.face_lift(BOX, SIDES)
    slanted = B.domain.join(INLET_POINTS, 0.0, 0.0)
    v = dp.projection(BOX, boundary=SIDES)(rng.standard_normal(BOX.faces.size))
    results = []
    for walls in (B(slanted), lambda params: slanted):
        step = dp.flow_step(BOX, 0.01, 0.01, boundary=SIDES, walls=walls)
        results.append(step(step.start(v))["v"])
    np.testing.assert_allclose(*results, rtol=1e-12, atol=1e-13)
    at_rest = dp.flow_step(BOX, 0.01, 0.01, boundary=SIDES)
    assert np.max(np.abs(at_rest(at_rest.start(v))["v"] - results[0])) > 1e-4


def test_the_force_on_all_cells_is_the_momentum_that_enters_through_the_walls(rng):
    v, p = rng.standard_normal(BOX.faces.size), rng.standard_normal(BOX.shape)
    parts = BOX.split(v)
    at_rest = {key: np.zeros(len(faces) + 1) for key, faces in WALLS.items()}
    wanted = [0.0, 0.0]
    for c in range(2):
        n, across = BOX.shape[c], BOX.shape[1 - c]
        for node, side in np.ndindex(n + 1, 2):
            edge = (node, side * across) if c == 0 else (side * across, node)
            stress = 0.3 * slope_at_edge(parts, at_rest, c, *edge)
            flux = at_edge(parts, at_rest, c, *edge) * at_edge(parts, at_rest, 1 - c, *edge)
            wanted[c] += (2 * side - 1) * BOX.spacings(c)[node] * (stress - flux)
        for k, h in enumerate(BOX.widths[1 - c]):
            for side in range(2):
                face = (side * n, k) if c == 0 else (k, side * n)
                cell = (side * (n - 1), k) if c == 0 else (k, side * (n - 1))
                pressure = 0.0 if WALLS[c, side][k] == "o" else p[cell]
                wanted[c] -= (2 * side - 1) * h * (parts[c][face] ** 2 + pressure)
    on = dp.forces(BOX, boundary=SIDES, cells=(slice(0, 4), slice(0, 5)))
    np.testing.assert_allclose(on(v, p, 0.3)[:2], wanted, rtol=1e-11, atol=1e-11)


def operators_in_3d(grid, boundary, v, w):
    """Return the results of viscosity, convection and projection."""
    return [
        dp.face_laplacian(grid, boundary)(v),
        dp.convection(grid, boundary)(v, w),
        dp.projection(grid, boundary=boundary)(v),
        dp.face_lift(grid, boundary).T(v),
    ]


def test_openings_in_3d_that_do_not_depend_on_z_are_those_in_2d(rng):
    deep = dp.Grid((*BOX.shape, 2), spacing=[*BOX.widths, 1.0], periodic=(False, False, True))
    strips = {name: tuple(as_strip(wall) for wall in pair) for name, pair in SIDES.items()}
    v, w = ([*BOX.split(u), np.zeros(BOX.shape)] for u in rng.standard_normal((2, BOX.faces.size)))
    deep_v, deep_w = (deep.join(*(np.repeat(part[..., None], 2, axis=2) for part in parts)) for parts in (v, w))
    flat = operators_in_3d(BOX, SIDES, BOX.join(*v[:2]), BOX.join(*w[:2]))
    for ours, wanted in zip(operators_in_3d(deep, strips, deep_v, deep_w)[:3], flat[:3], strict=True):
        x, y, z = deep.split(ours)
        np.testing.assert_allclose(x[..., 1], BOX.split(wanted)[0], rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(y[..., 1], BOX.split(wanted)[1], rtol=1e-11, atol=1e-11)
        assert np.max(np.abs(z)) <= 1e-11


def as_strip(wall):
    """Return a patch of a wall in 2-D as one of a wall in 3-D that does not depend on z."""
    if not isinstance(wall, type(INLET)):
        return wall
    return dp.patch(np.repeat(wall.where[:, None], 2, axis=1), wall.condition, wall.elsewhere)


@pytest.mark.parametrize("order", [(1, 2, 0), (2, 1, 0), (0, 2, 1)])
def test_openings_in_3d_do_not_depend_on_the_order_of_the_axes(order, rng):
    """The same room with its axes in another order; openings with corners, in two walls."""
    shape = (3, 4, 3)
    window = np.zeros((4, 3), bool)
    window[1:3, 1:] = True
    hatch = np.zeros((3, 4), bool)
    hatch[0, :2] = True
    walls = [(dp.patch(window, dp.inflow), dp.no_slip), (dp.free_slip, dp.no_slip)]
    walls.append((dp.no_slip, dp.patch(hatch, dp.outflow, elsewhere=dp.free_slip)))
    widths = [0.1 + rng.random(n) for n in shape]
    grid = dp.Grid(shape, spacing=widths)
    v, w = rng.standard_normal((2, grid.faces.size))

    turned_grid = dp.Grid([shape[a] for a in order], spacing=[widths[a] for a in order])
    turned_walls = {}
    for name, a in zip("xyz", order, strict=True):
        others = [b for b in range(3) if b != a]
        axes = [others.index(b) for b in order if b != a]
        turned_walls[name] = tuple(turned_patch(wall, axes) for wall in walls[a])

    def turned(u):
        return turned_grid.join(*(np.transpose(grid.split(u)[a], order) for a in order))

    ours = operators_in_3d(turned_grid, turned_walls, turned(v), turned(w))
    wanted = operators_in_3d(grid, dict(zip("xyz", walls, strict=True)), v, w)
    for one, other in zip(ours[:3], wanted[:3], strict=True):
        np.testing.assert_allclose(one, turned(other), rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(np.sort(ours[3]), np.sort(wanted[3]), rtol=1e-11, atol=1e-11)


def turned_patch(wall, axes):
    """Return a condition of a wall whose axes are in another order."""
    if not isinstance(wall, type(INLET)):
        return wall
    return dp.patch(np.transpose(wall.where, axes), wall.condition, wall.elsewhere)


def test_openings_travel_and_have_names():
    P = dp.projection(BOX, boundary=SIDES)
    v = np.linspace(0.0, 1.0, BOX.faces.size)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(P))(v), P(v))
    inlet = "x-lower: inflow on 2 of 5 faces, no_slip elsewhere; x-upper: outflow on 2 of 5 faces, no_slip elsewhere"
    for op in (P, dp.face_laplacian(BOX, SIDES), dp.face_lift(BOX, SIDES)):
        assert inlet in op.name
