"""flow_step with a friction on faces."""

import pickle
import re

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

SIDES = {"x": (dp.inflow, dp.outflow), "y": dp.no_slip}


def scene(shape=(8, 6), **given):
    """Return a grid, the distance from its centre on its faces, and the friction of a disk of any radius."""
    grid = dp.Grid(shape, size=(1.0, 0.75), **given)
    x, y = (grid.join(*(grid.face_centres(axis)[a] for axis in (0, 1))) for a in (0, 1))
    distance = np.hypot(x - 0.4, y - 0.4)
    drag = dp.brinkman(grid)
    return grid, distance, lambda radius: 0.05 * drag(distance - radius)


def twin(grid, dt, v, f, n):
    """Return the same steps with the previous velocity, as in the head of flow_step.py."""
    project = dp.projection(grid)
    slope = dp.gradient(grid)
    viscous = dp.face_laplacian(grid)
    convect = dp.convection(grid)
    rate = lambda v: 0.05 * viscous(v) - convect(v, v)
    v = older = project(v)
    p = np.zeros(grid.shape)
    a = rate(v)
    for _ in range(n):
        before = a
        a = rate(v)
        ahead = v + dt * (1.5 * a - 0.5 * before - slope(p)) + 0.5 * dt * f * (v - older)
        ahead = ahead / (1 + dt * f)
        q = project.pressure(ahead)
        v, older, p = ahead + slope(q), v, p - q / dt
    return v


def test_steps_and_gradient_agree_with_the_reference():
    grid, _, friction = scene()
    f = np.minimum(friction(0.2), 500.0)
    start = 0.1 * np.sin(np.arange(grid.faces.size))
    step = dp.flow_step(grid, 0.01, 0.05, friction=lambda f: f)
    runs = [
        lambda f: anp.sum(dp.rollout(step, step.start(start, f), f, 6)["v"] ** 3),
        lambda f: anp.sum(twin(grid, 0.01, start, f, 6) ** 3),
    ]
    (value, slope), (value_too, slope_too) = (dp.value_and_grad(run)(f) for run in runs)
    assert value == pytest.approx(value_too, rel=1e-12)
    np.testing.assert_allclose(slope, slope_too, rtol=0, atol=1e-9 * np.max(np.abs(slope_too)))


def test_derivatives_in_the_radius_of_an_obstacle():
    grid, _, friction = scene()
    step = dp.flow_step(grid, 0.02, 0.05, boundary=SIDES, friction=friction)
    wind = grid.join(1.0, 0.0)

    def loss(radius):
        return anp.sum(dp.rollout(step, step.start(wind, radius), radius, 5)["v"] ** 2)

    assert dp.check.gradient(loss, 0.17, quick=True).verdict == "agrees"
    slope = dp.grad(loss)
    h = 1e-5
    assert dp.jvp(loss, 0.17, 1.0)[1] == pytest.approx(slope(0.17), rel=1e-9)
    assert dp.hvp(loss, 0.17, 1.0) == pytest.approx((slope(0.17 + h) - slope(0.17 - h)) / (2 * h), rel=1e-5)


def test_order_two_in_time():
    grid, distance, _ = scene((10, 8))
    friction = 30 * np.exp(-20 * distance**2)
    end = 0.16
    x, y = np.meshgrid(*(grid.coordinates(a, "nodes") for a in (0, 1)), indexing="ij")
    start = dp.curl(grid)((np.sin(np.pi * x) * np.sin(np.pi * y / 0.75)) ** 2)
    answers = []
    for steps in (16, 32, 64):
        step = dp.flow_step(grid, end / steps, 0.05, friction=friction)
        answers.append(dp.rollout(step, step.start(start), None, steps)["v"])
    coarse, fine = (np.max(np.abs(a - b)) for a, b in zip(answers, answers[1:]))
    assert 1.8 < np.log2(coarse / fine) < 2.3


@pytest.mark.parametrize("large", [1e3, 1e12])
def test_stable_for_any_friction(large):
    """The velocity decays inside the obstacle, and finally in the whole fluid."""
    grid, distance, _ = scene()
    step = dp.flow_step(grid, 0.02, 0.05, convective=False, friction=large * (distance < 0.2))
    state = step.start(np.sin(np.arange(grid.faces.size) ** 2))
    first = np.max(np.abs(state["v"]))
    sizes = []
    for _ in range(300):
        state = step(state)
        sizes.append(np.max(np.abs(state["v"])))
    assert max(sizes) < first and sizes[-1] < 1e-6 * first


def test_damping_by_friction_alone():
    """A uniform flow on a periodic line with uniform friction; an array and a function give the same bits."""
    grid = dp.Grid(4, periodic=True)
    dt = 0.5
    m = 2.0
    step = dp.flow_step(grid, dt, friction=np.full(4, m / dt))
    other = pickle.loads(pickle.dumps(dp.flow_step(grid, dt, friction=np.full(4, m / dt))))
    third = dp.flow_step(grid, dt, friction=lambda f: f * np.ones(4))
    v = [1.0, 1.0]
    for _ in range(4):
        v.append((v[-1] + m / 2 * (v[-1] - v[-2])) / (1 + m))
    ends = []
    for one, params in ((step, None), (other, None), (third, m / dt)):
        ends.append(dp.rollout(one, one.start(np.ones(4), params), params, 4)["v"])
    np.testing.assert_allclose(ends[0], v[-1], rtol=1e-12)
    np.testing.assert_array_equal(ends[0], ends[1])
    np.testing.assert_array_equal(ends[0], ends[2])


def test_friction_has_no_effect_on_walls_and_inflows():
    grid, _, _ = scene()
    inflows = grid.join(1.0, 0.0)
    step = dp.flow_step(grid, 0.02, 0.05, boundary=SIDES, friction=np.full(grid.faces.size, 7.0))
    start = step.start(inflows)
    state = step(step(start))
    np.testing.assert_array_equal(grid.split(state["v"])[0][0], np.ones(6))
    assert repr(step).endswith("pressure, convection, viscosity, friction>")


@pytest.mark.parametrize("friction", [False, True])
@pytest.mark.parametrize("term", ["number", "function", "diffusivity", "diffusivity of scalars"])
def test_advice_for_a_step_that_is_too_long(term, friction):
    """Implicit viscosity is refused with a friction."""
    grid = dp.Grid((4, 4))
    given = {"friction": np.ones(grid.faces.size)} if friction else {}
    s = None
    if term.startswith("diffusivity"):
        given |= {"scalars": {"heat": {"diffusivity": 3.0 if term == "diffusivity" else lambda s, params: 3.0}}}
        s = {"heat": np.zeros((4, 4))}
    else:
        given["viscosity"] = 3.0 if term == "number" else lambda params: 3.0
    run = lambda **more: dp.flow_step(grid, 0.5, **given, **more).start(np.zeros(grid.faces.size), None, s)
    with pytest.raises(
        dp.errors.UnstableStepError, match="unstable for (viscosity|diffusivity of 'heat') = 3 "
    ) as caught:
        run()
    assert ("implicit=True" in str(caught.value)) == (not friction)
    if not friction:
        run(implicit=True)
    else:
        assert str(caught.value).endswith("take smaller steps, or write unstable='allow'")
        run(unstable="allow")
        with pytest.raises(ValueError, match="write implicit=False"):
            run(implicit=True)


def test_refused_frictions():
    grid = dp.Grid((2, 2))
    wrong = [
        (
            np.ones(4),
            dp.errors.ShapeError,
            "flow_step, as friction, takes a field on faces(2, 2) of shape (12,), got an array of "
            "shape (4,); write one number for each face",
        ),
        (0.1, dp.errors.ShapeError, "got an array of shape (); write one number for each face"),
        (np.full(12, 1j), ValueError, "flow_step takes a friction >= 0, got 1j; write abs(friction)"),
        (
            np.where(np.arange(12) == 3, np.nan, 0.0),
            dp.errors.NonFiniteError,
            "flow_step takes a finite friction, got 1 that are NaN or infinite, the first at 3",
        ),
    ]
    for friction, kind, words in wrong:
        for given, params in ((friction, None), (lambda f: f, friction)):
            with pytest.raises(kind, match=re.escape(words)):
                dp.flow_step(grid, 0.1, friction=given).start(np.zeros(12), params)
    with pytest.raises(ValueError, match="flow_step takes no friction beside implicit viscosity; write implicit=False"):
        dp.flow_step(grid, 0.1, 0.1, implicit=True, friction=np.ones(12))
    with pytest.raises(ValueError, match=re.escape("flow_step takes a friction >= 0, got -2.0; write abs(friction)")):
        dp.flow_step(grid, 0.1, friction=np.linspace(-2, 1, 12)).start(np.zeros(12))
