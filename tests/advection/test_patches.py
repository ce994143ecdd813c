"""Inflow through part of a wall, against lines of cells with one condition each."""

import pickle

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

ROWS = 5
BOX = dp.Grid((6, ROWS), spacing=[[0.2, 0.1, 0.15, 0.2, 0.1, 0.25], 0.2])
LINE = dp.Grid(6, spacing=BOX.widths[0])
HERE = np.array([False, True, True, False, True])
SIDES = {"x": (dp.patch(HERE, dp.dirichlet), dp.patch(~HERE, dp.dirichlet))}
SCHEMES = {
    "upwind": dict(),
    "van_leer": dict(),
    "upwind, advective": dict(velocity="cells"),
    "semi_lagrangian": dict(backtrace="midpoint"),
    "maccormack": dict(interpolation="cubic", clamp=False),  # a clamp takes its bounds from four cells
}


def scheme_of(name):
    return name.split(",")[0]


@pytest.mark.parametrize("name", SCHEMES)
def test_each_row_of_a_flow_along_x_has_its_own_condition(name, rng):
    """Also the derivatives in the field, the velocity, the inflow."""
    options = SCHEMES[name]
    on_cells = "velocity" in options
    move = dp.transport(BOX, scheme_of(name), SIDES, **options)
    u = rng.standard_normal(BOX.shape)
    along = 0.5 * rng.standard_normal(BOX.shape if on_cells else BOX.face_shape(0))  # enters and leaves at both walls
    inflow = rng.standard_normal((2, ROWS))
    weights = rng.standard_normal(BOX.shape)

    def of_box(u, along, inflow):
        v = anp.stack([along, 0.0 * along]) if on_cells else BOX.join(along, 0.0)
        return move(u, v, 0.02, move.walls.join(inflow[0], inflow[1], 0.0, 0.0))

    def of_rows(u, along, inflow):
        results = []
        for row in range(ROWS):
            pair = (dp.dirichlet, dp.neumann) if HERE[row] else (dp.neumann, dp.dirichlet)
            line = dp.transport(LINE, scheme_of(name), pair, **options)
            results.append(line(u[:, row], along[:, row], 0.02, inflow[:, row]))
        return anp.stack(results, axis=1)

    np.testing.assert_allclose(of_box(u, along, inflow), of_rows(u, along, inflow), rtol=1e-13, atol=1e-14)
    gradients = [
        dp.grad(lambda p, step=step: anp.sum(weights * step(*p)))((u, along, inflow)) for step in (of_box, of_rows)
    ]
    for ours, wanted in zip(*gradients, strict=True):
        np.testing.assert_allclose(ours, wanted, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("scheme", ["upwind", "van_leer", "semi_lagrangian"])
def test_each_row_of_a_face_field_has_its_own_condition(scheme, rng):
    """Points between two faces of the wall have inflow if one of the faces has it."""
    move = dp.transport(BOX, scheme, SIDES, of="faces")
    speed = 0.5 * rng.standard_normal(7)
    u = rng.standard_normal(BOX.faces.size)
    inflow = rng.standard_normal(move.walls.size)
    x_part, y_part = BOX.split(move(u, BOX.join(speed[:, None], 0.0), 0.02, inflow))
    walls = move.walls.split(inflow)
    has_inflow = {"lower": HERE, "upper": ~HERE}

    def condition(flags):
        return dp.dirichlet if np.any(flags) else dp.neumann

    for row in range(ROWS):  # x-faces: the half control volumes at the walls
        pair = tuple(condition(has_inflow[side][row]) for side in ("lower", "upper"))
        line = dp.transport(LINE, scheme, pair, of="faces")
        values = np.array([walls[0][0, row], walls[1][0, row]]) if dp.dirichlet in pair else 0.0
        wanted = line(BOX.split(u)[0][:, row], speed, 0.02, values)
        np.testing.assert_allclose(x_part[:, row], wanted, rtol=1e-12, atol=1e-13)
    for row in range(ROWS + 1):  # y-faces: between two faces of the walls
        touched = slice(max(row - 1, 0), row + 1)
        pair = tuple(condition(has_inflow[side][touched]) for side in ("lower", "upper"))
        values = np.array([walls[4][0, row], walls[5][0, row]])
        wanted = dp.transport(LINE, scheme, pair)(BOX.split(u)[1][:, row], speed, 0.02, values)
        np.testing.assert_allclose(y_part[:, row], wanted, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("scheme", ["upwind", "van_leer"])
def test_loops_and_matrices_agree_at_corners_with_patches_of_two_walls(scheme, rng):
    sides = {"x": SIDES["x"], "y": dp.patch(np.arange(6) < 3, dp.dirichlet)}
    move = dp.transport(BOX, scheme, sides)
    method = move.method
    u, v, inflow, g = (rng.standard_normal(n) for n in (30, BOX.faces.size, move.walls.size, 30))
    np.testing.assert_allclose(
        method.forward(u, v, 0.01, inflow), method.reference.step(u, v, 0.01, inflow), rtol=1e-12, atol=1e-13
    )
    ours, _ = method.vjp((0, 1, 3), g, u, v, 0.01, inflow)
    for cotangent, wanted in zip(ours, method.reference.vjp((0, 1, 3), g, u, v, 0.01, inflow), strict=True):
        np.testing.assert_allclose(cotangent, wanted, rtol=1e-11, atol=1e-12)
    if scheme == "upwind":
        op = move.operator(v, 0.01)
        assert dp.check.operator(op)
        np.testing.assert_allclose(
            op(u.reshape(BOX.shape)), move(u.reshape(BOX.shape), v, 0.01), rtol=1e-13, atol=1e-14
        )


@pytest.mark.parametrize("scheme", ["upwind", "van_leer", "semi_lagrangian"])
def test_recorded_steps_are_the_same(scheme, rng):
    """Steps of a program are bound to the form of their arguments."""
    move = dp.transport(BOX, scheme, SIDES)
    v = 0.5 * rng.standard_normal(BOX.faces.size)
    inflow = rng.standard_normal(move.walls.size)

    def loss(fields):
        u, v = fields
        return anp.sum(move(move(u, v, 0.02, inflow), v, 0.02, inflow) ** 3)

    u = rng.standard_normal(BOX.shape)
    recorded = dp.jit(loss)
    for _ in range(2):  # the program is compared with the function in the first call
        value, gradient = dp.value_and_grad(recorded)((u, v))
    wanted_value, wanted = dp.value_and_grad(loss)((u, v))
    assert value == wanted_value
    for ours, other in zip(gradient, wanted, strict=True):
        np.testing.assert_allclose(ours, other, rtol=1e-12, atol=1e-13)


def test_mass_enters_through_the_patch_only():
    move = dp.transport(BOX, boundary=SIDES)
    u = np.zeros(BOX.shape)
    v = BOX.join(1.0, 0.0)
    for _ in range(5):
        u = move(u, v, 0.02, move.walls.join(2.0, 7.0, 0.0, 0.0))  # the value 7 is at the outlet and not used
    assert np.all(u[:, ~HERE] == 0)
    assert abs(np.sum(BOX.volumes * u) - 5 * 0.02 * 2.0 * 0.2 * np.count_nonzero(HERE)) <= 1e-14


def test_inflow_that_varies_in_time_and_along_a_patch(rng):
    """Rows of `inputs`, one for each step, equal steps by hand; and the gradient in all of them."""
    move = dp.transport(BOX, boundary=SIDES)
    wall = SIDES["x"][0]
    v = BOX.join(0.5, 0.0)
    rows = rng.standard_normal((4, ROWS))

    def step(u, scale, row):
        return move(u, v, 0.02, move.walls.join(wall.values(BOX, "x", scale * row), 0.0, 0.0, 0.0))

    def end(rows):
        return dp.rollout(step, np.zeros(BOX.shape), 2.0, 4, inputs=rows)

    u = np.zeros(BOX.shape)
    for row in rows:
        u = step(u, 2.0, row)
    np.testing.assert_array_equal(end(rows), u)
    derivative = dp.grad(lambda rows: anp.sum(end(rows)))(rows)
    entering = 2.0 * 0.02 * 0.5 / BOX.widths[0][0]
    np.testing.assert_allclose(derivative[-1], entering * HERE, rtol=1e-12)
    assert np.all(derivative[:, ~HERE] == 0) and np.all(derivative[:, HERE] > 0)


def test_patches_of_transport_travel_and_have_names():
    move = dp.transport(BOX, boundary=SIDES)
    assert "x-lower: dirichlet on 3 of 5 faces, neumann elsewhere" in repr(move)
    u, v = np.ones(BOX.shape), BOX.join(0.5, 0.0)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(move))(u, v, 0.02), move(u, v, 0.02))


def test_a_patch_without_inflow_takes_no_inflow():
    full = dp.transport(BOX, boundary={"x": dp.patch((0.0, 1.0), dp.neumann)})
    with pytest.raises(ValueError, match="uses inflow values at sides of dp.dirichlet only"):
        full(np.ones(BOX.shape), BOX.join(0.5, 0.0), 0.02, 1.0)
    with pytest.raises(
        ValueError, match=r"transport takes dirichlet \(inflow values\) or neumann \(outflow\), got robin"
    ):
        dp.transport(BOX, boundary={"x": dp.patch(HERE, dp.robin(1.0, 2.0))})
