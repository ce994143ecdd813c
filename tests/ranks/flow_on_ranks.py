"""Flow on ranks compared with one process: projections, a plume, a cavity, moving walls, and their gradients.

mpirun -n 2 python -m mpi4py tests/ranks/flow_on_ranks.py
"""

import warnings

import autograd.numpy as anp
import numpy as np
from mpi4py import MPI

import sparsedp as dp

COMM = MPI.COMM_WORLD
SOLID = np.zeros((12, 10), dtype=bool)
SOLID[4:7, 3:5] = SOLID[9] = True  # a block, and a wall that divides the box
BLOCK = np.zeros((16, 12), dtype=bool)
BLOCK[6:9, 5:8] = True


def close(value, expected, tol, name):
    """Compare with the expected value, and between ranks."""
    value = np.asarray(dp.gather(value))
    expected = np.asarray(expected)
    assert len(set(COMM.allgather(value.tobytes()))) == 1, name
    error = np.max(np.abs(value - expected), initial=0.0) / np.max(np.abs(expected), initial=1e-300)
    assert value.shape == expected.shape and error <= tol, (name, error)


def derivatives(loss, x, along):
    """Value, gradient, tangent and Hessian product."""
    return *dp.value_and_grad(loss)(x), dp.jvp(loss, x, along)[1], dp.hvp(loss, x, along)


def as_array(space, u):
    """Return a field that every rank holds."""
    return u


def in_blocks(space, u):
    """Return the same field in blocks."""
    return dp.identity(space)(u)


def on_both(name, plain, compute, tol=1e-10, fields=(as_array, in_blocks)):
    """Compare ``compute(grid, field)`` on one process and on ranks, for arrays and for fields in blocks."""
    grid = dp.distribute(plain, COMM)
    expected = compute(plain, as_array)
    for field in fields:
        for number, pair in enumerate(zip(compute(grid, field), expected, strict=True)):
            close(*pair, tol, f"{name} on {plain}, number {number}")


def projections():
    """P, its transpose, its pressure and derivatives: obstacles, regions, open sides, stretched grids, closed lines."""
    uneven = dp.Grid((12, 10), spacing=[np.linspace(1, 2, 12), np.linspace(2, 1, 10)])
    cases = [
        (dp.Grid((12, 10), size=(1.0, 2.0)), {}),
        (dp.Grid((12, 10), size=1.0, periodic=(True, False)), {}),
        (dp.Grid((12, 10), size=1e-3), {"solid": SOLID}),
        (uneven, {"boundary": {"x": (dp.inflow, dp.outflow)}}),
        (uneven, {"boundary": {"y": dp.outflow}, "solid": SOLID}),
        (dp.Grid((6, 4, 5), size=1.0), {"boundary": {"z": dp.outflow}}),
        (dp.Grid((12, 1)), {}),
        (
            dp.Grid((3,), spacing=0.37, periodic=True),
            {},
        ),  # one level, whose matrix is singular
    ]
    rng = np.random.default_rng(0)
    for plain, options in cases:
        v, t = rng.standard_normal((2, plain.faces.size))
        g = rng.standard_normal(plain.shape)

        def compute(grid, field, v=v, t=t, g=g, options=options):
            P = dp.projection(grid, rtol=1e-13, **options)
            loss = lambda v: anp.sum(anp.sin(P(v * v)) ** 2) + anp.sum(anp.cos(P.pressure(v)))
            x = field(grid.faces, v)
            along = field(grid.faces, t)
            maps = P(x), P.T(x), P.pressure(x), P.pressure.T(field(grid.cells, g)), P(1e-200 * x)
            assert P.info.forward.status.startswith(("converged", "exact"))
            return *maps, *derivatives(loss, x, along)

        on_both("projection", plain, compute)


def plume():
    """Compare smoke that rises around an obstacle: a rollout of 20 steps, each with a projection."""
    plain = dp.Grid((16, 12), size=1.0)
    x, y = plain.centres()
    smoke = np.exp(-((x - 0.3) ** 2 + (y - 0.5) ** 2) / 0.02)
    along = np.sin(3 * x + y)

    def compute(grid, field):
        P = dp.projection(grid, BLOCK, rtol=1e-13)
        D = dp.divergence(grid)
        A = dp.average(grid)
        lift = dp.component(grid, 0).T @ dp.component(grid, 0)

        def step(state, buoyancy):
            s, v = state
            v = P(v + 0.02 * buoyancy * lift(A(s)))
            return s - 0.02 * D(v * A(s)), v

        def loss(start, memory=None):
            still = np.zeros(grid.faces.size)
            s, v = dp.rollout(step, (start["s"], still), start["b"], 20, memory=memory)
            return anp.sum((s - 0.1) ** 2) + anp.sum(v * v)

        start = {"s": field(grid.cells, smoke), "b": 1.5}
        value, slope, tangent, bent = derivatives(loss, start, {"s": field(grid.cells, along), "b": -0.2})
        again = dp.value_and_grad(lambda start: loss(start, "30 kB"))(start)
        return value, *slope.values(), tangent, *bent.values(), again[0], *again[1].values()

    on_both("plume", plain, compute)


def cavity():
    """The flow under a lid, 20 steps of `flow_step` in a rollout: in the viscosity, the lid and the first velocity."""
    plain = dp.Grid((32, 32), size=1.0)
    v, along = 0.05 * np.random.default_rng(0).standard_normal((2, plain.faces.size))

    def compute(grid, field):
        lift = dp.face_lift(grid)
        lid = lift(lift.domain.join(0.0, 0.0, 0.0, 1.0))
        step = dp.flow_step(grid, 0.01, lambda p: p["nu"], lambda v, p: p["nu"] * p["lid"] * lid)

        def loss(x, memory=None):
            state = dp.rollout(step, step.start(x["v"], x), x, 20, memory=memory)
            return anp.sum((state["v"] - 0.1) ** 2) + anp.mean(anp.sin(state["p"]))

        start = {"v": field(grid.faces, v), "nu": 0.01, "lid": 1.5}
        value, slope, tangent, bent = derivatives(
            loss, start, {"v": field(grid.faces, along), "nu": 0.002, "lid": -0.3}
        )
        again = dp.value_and_grad(lambda x: loss(x, "300 kB"))(start)
        return value, *slope.values(), tangent, *bent.values(), again[0], *again[1].values()

    on_both("cavity", plain, compute)


def flows():
    """Every part that `flow_step` takes: obstacles, openings, heat, implicit viscosity, friction, three axes."""
    box = dp.Grid((12, 10), size=1.0)
    room = dp.Grid((6, 4, 5), size=1.0, periodic=(False, True, False))
    mild = 0.02 * SOLID
    x = {"x": (dp.inflow, dp.outflow)}
    hot = {"diffusivity": 0.01, "boundary": {"x": dp.dirichlet}, "source": lambda s, p: p * s["heat"] - s["dye"]}
    scalars = {"heat": hot | {"values": np.linspace(0.5, 1.0, 44)}, "dye": {}}
    push = lambda v, s, p: p * anp.mean(s["heat"]) * v
    drag = lambda p: p * np.arange(262.0)
    cases = [
        (box, {"viscosity": 0.01, "implicit": True, "solid": BLOCK[:12, :10]}),
        (box, {"viscosity": 0.01, "boundary": x, "convective": False, "walls": np.linspace(0, 1, 262)}),
        (box, {"viscosity": 0.01, "scalars": scalars, "force": push}),
        (box, {"scalars": scalars, "solid": mild > 0, "implicit": True, "viscosity": 0.1}),
        (box, {"viscosity": lambda p: 0.01 * p, "friction": drag}),
        (room, {"viscosity": 0.001, "friction": 0.5 + np.zeros(room.faces.size)}),
    ]
    for plain, options in cases:
        v, t = 0.05 * np.random.default_rng(0).standard_normal((2, plain.faces.size))
        s, r = np.random.default_rng(1).random((2, *plain.shape))

        def compute(grid, field, v=v, t=t, s=s, r=r, options=options):
            step = dp.flow_step(grid, 0.02, **options)

            def loss(x):
                scalars = {"heat": x["s"], "dye": 1.0 - x["s"]} if "scalars" in options else None
                end = dp.rollout(step, step.start(x["v"], x["p"], scalars), x["p"], 3)
                carried = anp.sum(end["s"]["heat"] ** 2) if scalars else 0.0
                return anp.sum(anp.sin(1.0 + end["v"])) + anp.sum(end["p"] ** 2) + carried

            start = {"v": field(grid.faces, v), "s": field(grid.cells, s), "p": 0.3}
            value, slope, tangent, bent = derivatives(loss, start, {"v": field(grid.faces, t), "s": r, "p": 0.1})
            return value, *slope.values(), tangent, *bent.values()

        on_both(f"flow_step {sorted(options)}", plain, compute, 1e-9)  # its solves are good to 1e-10


def moving_walls():
    """Tangential velocities of walls and inflows: functions of the parameters, arrays and fields, and derivatives."""
    box = dp.Grid((12, 10), size=1.0)
    uneven = dp.Grid((12, 10), spacing=[np.linspace(1, 2, 12) / 18, np.linspace(2, 1, 10) / 15])
    room = dp.Grid((6, 4, 5), size=1.0, periodic=(False, True, False))
    oblique = {"x": (dp.inflow, dp.outflow), "y": (dp.no_slip, dp.free_slip)}
    cases = [
        (box, {"viscosity": 0.01}),
        (box, {"viscosity": 0.1, "implicit": True, "solid": BLOCK[:12, :10]}),
        (uneven, {"viscosity": 0.01, "boundary": oblique}),
        (room, {"viscosity": 0.05, "implicit": True, "boundary": {"z": (dp.inflow, dp.outflow)}}),
    ]
    for plain, options in cases:
        boundary = options.get("boundary", dp.no_slip)
        rng = np.random.default_rng(0)
        v, t = 0.05 * rng.standard_normal((2, plain.faces.size))
        w, s = 0.1 * rng.standard_normal((2, dp.face_lift(plain, boundary).domain.size))

        def compute(grid, field, options=options, boundary=boundary, v=v, t=t, w=w, s=s):
            space = dp.face_lift(grid, boundary).domain
            step = dp.flow_step(grid, 0.02, walls=lambda p: p["walls"] * anp.cos(p["angle"]), **options)

            def loss(x):
                end = dp.rollout(step, step.start(x["v"], x), x, 2)
                return anp.sum(anp.sin(1.0 + end["v"])) + anp.sum(end["p"] ** 2) + anp.sum(end["walls"] ** 3)

            x = {"v": field(grid.faces, v), "walls": field(space, w), "angle": 0.3}
            along = {"v": field(grid.faces, t), "walls": field(space, s), "angle": -0.2}
            value, slope, tangent, bent = derivatives(loss, x, along)
            return value, *slope.values(), tangent, *bent.values()

        on_both(f"moving walls, {sorted(options)}", plain, compute, 1e-9)

    one_wall = {"x": (dp.inflow, dp.outflow), "y": dp.free_slip}
    for plain, boundary in ((box, dp.no_slip), (uneven, one_wall)):
        v = 0.05 * np.random.default_rng(0).standard_normal(plain.faces.size)

        def compute_with_constant_walls(grid, field, boundary=boundary, v=v):
            lift = dp.face_lift(grid, boundary)
            lifted = lift(field(lift.domain, np.linspace(0.1, 0.5, lift.domain.size)))
            step = dp.flow_step(grid, 0.02, 0.01, boundary=boundary, walls=lifted)
            end = dp.rollout(step, step.start(field(grid.faces, v)), None, 3)
            return end["v"], end["p"]

        on_both(f"constant walls, {boundary}", plain, compute_with_constant_walls, 1e-9)
    grid = dp.distribute(room, COMM)
    meeting = {"z": (dp.inflow, dp.outflow)}
    lift = dp.face_lift(grid, meeting)
    lifted = lift(dp.identity(lift.domain)(np.ones(lift.domain.size)))
    words = "the velocities of walls that meet are summed"
    refused(ValueError, words, lambda: dp.flow_step(grid, 0.02, 0.01, boundary=meeting, walls=lifted))


def refused(kind, words, act):
    """An error with the same words on all ranks."""
    try:
        act()
    except kind as error:
        messages = COMM.allgather(str(error))
        assert len(set(messages)) == 1 and words in messages[0], messages
    else:
        raise AssertionError(words)


def errors_are_the_same_on_all_ranks():
    """An inflow that cannot leave, a step that is too long, a velocity that is not finite."""
    grid = dp.distribute(dp.Grid((12, 10)), COMM)
    words = "the inflow on the lower x side enters a region without an outflow"
    refused(ValueError, words, lambda: dp.projection(grid, SOLID, {"x": (dp.inflow, dp.no_slip)}))
    v = np.zeros(grid.faces.size)
    step = dp.flow_step(grid, 0.1)
    v[grid.faces.size // 4] = 20.0
    state = {"v": dp.identity(grid.faces)(v), "p": np.zeros(grid.shape), "a": 0.0 * v}
    refused(dp.errors.UnstableStepError, "waves grow by", lambda: step(state))
    rest = dp.identity(grid.faces)(np.zeros(grid.faces.size))
    words = "density in flow_step does not work on ranks yet"
    refused(TypeError, words, lambda: dp.flow_step(grid, 0.1, density=2.0))
    words = "a viscosity that varies in flow_step does not work on ranks yet"
    refused(TypeError, words, lambda: dp.flow_step(grid, 0.1, lambda rate, params: rate).start(rest))
    v[0] = np.nan  # in a wall
    refused(dp.errors.NonFiniteError, "takes finite numbers, got 1 that", lambda: dp.projection(grid)(v))


if __name__ == "__main__":
    warnings.simplefilter("error", RuntimeWarning)
    projections()
    plume()
    cavity()
    flows()
    moving_walls()
    errors_are_the_same_on_all_ranks()
    if COMM.rank == 0:
        print("all agree")
