"""Scenes with units: conversion, dimensions, gradients, and the check that no number inside has a unit."""

import copy
import pickle

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

pint = pytest.importorskip("pint")
Q = pint.get_application_registry().Quantity


def fallen(p, steps):
    """Return height and speed after a time, by steps of the midpoint rule, which are exact."""
    dt = p["t"] / steps
    h, v = p["h"], 0.0
    for _ in range(steps):
        h, v = h + dt * (v - 0.5 * dt * p["g"]), v - dt * p["g"]
    return {"height": h, "speed": v}


FALL = dp.interop.with_units(fallen, ({"h": "m", "g": "m/s^2", "t": "s"}, None), {"speed": "km/hour", "height": "inch"})
START = {"h": Q(100.0, "feet"), "g": Q(981.0, "cm/s^2"), "t": Q(0.02, "minute")}


def energy(m, u):
    return 0.5 * m * anp.sum(u**2)


def test_units_are_converted_at_the_border():
    end = FALL(START, 4)
    assert end["height"].to("m").magnitude == pytest.approx(30.48 - 0.5 * 9.81 * 1.2**2, rel=1e-12)
    assert str(end["height"].units) == "inch" and str(end["speed"].units) == "kilometer / hour"
    assert end["speed"].magnitude == pytest.approx(-9.81 * 1.2 * 3.6, rel=1e-12)
    warm = dp.interop.with_units(lambda T: T, ("K",), "K")
    assert warm(Q(20.0, "degC")).magnitude == pytest.approx(293.15)
    for other in (copy.copy(FALL), copy.deepcopy(FALL)):
        assert other(START, 4) == end
    scene = dp.interop.with_units(energy, ("kg", "m/s"), "J")
    assert pickle.loads(pickle.dumps(scene))(Q(2, "g"), Q([3, 4], "m/s")).to("mJ").magnitude == pytest.approx(25.0)


@pytest.mark.parametrize("dtype", [np.float32, float])
def test_gradients_have_units(dtype):
    scene = dp.interop.with_units(energy, ("kg", "m/s"), "kJ")
    u = np.array([3.0, 4.0], dtype)
    value, of_u = scene.value_and_grad(Q(2.0, "tonne"), Q(u, "km/s"), argnum=1)
    assert value.magnitude == pytest.approx(2.5e7) and str(value.units) == "kilojoule"
    assert of_u.to("kg m/s").magnitude == pytest.approx(2e3 * 1e3 * u, rel=1e-6)
    assert str(of_u.units) == "kilojoule * second / meter" and of_u.magnitude.dtype == dtype
    _, slopes = dp.interop.with_units(lambda p: p["h"] * p["g"], ({"h": "m", "g": "m/s^2"},), "m^2/s^2").value_and_grad(
        {"h": Q(1.0, "m"), "g": Q(2.0, "m/s^2")}
    )
    assert slopes["h"] == Q(2.0, "m/s^2") and slopes["g"] == Q(1.0, "m")


def test_a_homogeneous_scene():
    report = FALL.check(START, 4)
    assert report.passed and report.verdict == "homogeneous" and len(report.runs) == 4
    assert all(run.deviation <= 1e-14 for run in report.runs)
    row = next(run for run in report.runs if (run.dimension, run.place) == ("time", "result['speed']"))
    assert row.expected == -1.0 and row.found == pytest.approx(-1.0)


def test_a_number_with_a_dimension_is_found():
    scene = dp.interop.with_units(lambda h: anp.sqrt(2 * h / 9.81), ("m",), "s")
    report = scene.check(Q(3.0, "m"))
    wrong = {run.dimension: run.found for run in report.runs if run.deviation > 1e-6}
    assert wrong == pytest.approx({"length": 0.5, "time": 0.0}) and not report.passed
    assert "a number inside the scene has the dimension length, time, or a unit is declared wrongly" in str(report)
    declared = dp.interop.with_units(energy, ("kg", "m/s"), "N")
    assert not declared.check(Q(1.0, "kg"), Q([1.0], "m/s")).passed

    def limited(h):
        if h > 5.0:
            raise ValueError("too high")
        return h

    report = dp.interop.with_units(limited, ("m",), "m").check(Q(3.0, "m"))
    assert report.runs[0].failure == "ValueError: too high" and not report.passed


def test_a_result_of_zero_shows_nothing():
    scene = dp.interop.with_units(lambda h: {"fall": h, "rise": 0.0 * h}, ("m",), "m")
    report = scene.check(Q(3.0, "m"))
    assert report.verdict == "inconclusive" and not report.passed
    assert report.gaps == ["result['rise'] is 0, which is the same in all units: give other arguments"]
    assert str(report).endswith(f"verdict: inconclusive\n{report.gaps[0]}")


def test_an_argument_of_zero_shows_nothing():
    """9.81 has a unit, but is multiplied by 0."""
    scene = dp.interop.with_units(lambda h, s: h + 9.81 * anp.sum(s["t"]), ("m", {"t": "s", "n": None}), "m")
    report = scene.check(Q(3.0, "m"), {"t": Q(np.zeros(2), "s"), "n": 0})
    assert report.verdict == "inconclusive"
    assert report.gaps == ["argument 1['t'] is 0, which is the same in all units: give another value"]
    assert scene.check(Q(3.0, "m"), {"t": Q(np.array([0.0, 1.0]), "s"), "n": 0}).verdict == "not homogeneous"


def test_results_declared_as_none_are_compared():
    weight = dp.interop.with_units(lambda m: 9.81 * m, ("kg",), None)
    report = weight.check(Q(2.0, "kg"))
    assert report.verdict == "not homogeneous" and report.runs[0].expected == 0.0 and report.runs[0].found == 1.0
    counted = dp.interop.with_units(
        lambda m: {"mass": m, "ratio": m / m, "count": 3}, ("kg",), {"mass": "kg", "ratio": None, "count": None}
    )
    assert counted.check(Q(2.0, "kg")).passed


def test_a_scene_without_dimensions_shows_nothing():
    for scene in (
        dp.interop.with_units(lambda x: 9.81 * x, ("",), ""),
        dp.interop.with_units(lambda x: x, (None,), None),
    ):
        report = scene.check(2.0)
        assert report.verdict == "inconclusive"
        assert report.gaps == ["no argument and no result has a unit with a dimension: there is nothing to compare"]


def test_scenes_on_a_grid():
    """Solves and steps are homogeneous if their sizes are arguments; a fixed floor of error control is not."""

    def decayed(size, p):
        grid = dp.Grid(6, size=size)
        step = dp.stepper("backward_euler", dp.laplacian(grid, dp.dirichlet), p["dt"])
        return dp.rollout(step, p["u"], p["nu"], 2)

    scene = dp.interop.with_units(decayed, ("m", {"dt": "s", "nu": "m^2/s", "u": "K"}), "K")
    p = {"dt": Q(1.0, "ms"), "nu": Q(3.0, "cm^2/s"), "u": Q(np.linspace(1.0, 2.0, 6), "K")}
    assert scene.check(Q(2.0, "mm"), p).passed

    def controlled(p):
        step = dp.stepper("heun", lambda u, k: -k * u, p["t"], tolerance=1e-3, floor=1.0)
        return step(p["u"], p["k"])

    scene = dp.interop.with_units(controlled, ({"t": "s", "k": "1/s", "u": "m"},), "m")
    report = scene.check({"t": Q(1.0, "s"), "k": Q(3.0, "1/s"), "u": Q(np.ones(2), "m")})
    assert {run.dimension for run in report.runs if run.deviation > 1e-6} == {"length"}


def test_a_number_without_a_unit_is_not_taken_for_degrees():
    scene = dp.interop.with_units(np.sin, ("degree",), "")
    with pytest.raises(TypeError, match=r"^argument 0 of with_units\(sin\) must be a Quantity with a unit like degree"):
        scene(90.0)


def test_a_count_declared_without_a_unit_is_inconclusive():
    scene = dp.interop.with_units(lambda h: int(np.sum(h > 1.0)), ("m",), None)
    report = scene.check(Q(np.linspace(0.5, 1.5, 11), "m"))
    assert report.verdict == "inconclusive" and "no floating-point numbers" in str(report)


def test_units_with_a_broken_exponent():
    scene = dp.interop.with_units(lambda n: 2.0 * n, ("s/m^(1/3)",), "s/m^(1/3)")
    assert scene(Q(0.03, "s/m**(1/3)")).magnitude == 0.06
