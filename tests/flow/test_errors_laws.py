"""Every message of conservation_law and shallow_water about states and functions, printed once."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.errors import NonFiniteError, ShapeError, UnstableStepError

LINE = dp.Grid(3)
PLANE = dp.Grid((3, 3))
WATER = np.array([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
LEFT = {"x": (dp.inflow, dp.outflow)}
TOP = {"y": (dp.outflow, dp.inflow)}


def flux(u, params, axis):
    return anp.stack([u[1], u[1] ** 2 / u[0] + u[0] ** 2])


def speed(u, params, axis):
    return anp.abs(u[1]) + anp.abs(u[0]) ** 0.5


def speed_of_depth(u, params, axis):
    return anp.sqrt(u[0])


def carried(u, params, axis):
    return u


def law(**options):
    return dp.conservation_law(LINE, flux, options.pop("speed", speed), **options)


POSITIVE = {"density": lambda u, params: u[0]}
BELOW = np.array([[1.0, -3.0, 1.0], [0.0, 0.0, 0.0]])
TABLE = [
    (
        lambda: dp.shallow_water(LINE, [0.0, 1.0]),
        ShapeError,
        "the bathymetry of a shallow_water must have shape (3,), got (2,)",
    ),
    (
        lambda: dp.shallow_water(LINE, "deep"),
        TypeError,
        "the bathymetry of a shallow_water must hold real numbers, got dtype <U4; write a number or an array",
    ),
    (
        lambda: dp.shallow_water(LINE)(np.ones(3)),
        ShapeError,
        "shallow_water needs u of shape (2, 3), the depth and a discharge for each axis, got u of shape (3,)",
    ),
    (
        lambda: dp.shallow_water(PLANE)(np.ones((2, 3, 3))),
        ShapeError,
        "shallow_water needs u of shape (3, 3, 3), the depth and a discharge for each axis, got u of shape (2, 3, 3)",
    ),
    (
        lambda: law(boundary=dp.free_slip, momentum=1)(np.ones((1, 3))),
        ShapeError,
        "conservation_law needs a field for each number in momentum=(1,), got u of shape (1, 3)",
    ),
    (
        lambda: dp.shallow_water(LINE, boundary=LEFT, inflow=[-1.0, 0.0])(WATER),
        UnstableStepError,
        "the depth of the inflow of a shallow_water at the lower end of x must be >= 0, got -1; change inflow=",
    ),
    (
        lambda: dp.shallow_water(PLANE, boundary=TOP, inflow=[-1.0, 0.0, 0.0])(np.ones((3, 3, 3))),
        UnstableStepError,
        "the depth of the inflow of a shallow_water at the upper end of y must be >= 0, got -1; change inflow=",
    ),
    (
        lambda: law(boundary=LEFT, inflow=[0.0, 0.0], positive=POSITIVE)(WATER),
        UnstableStepError,
        "the density of the inflow of a conservation_law at the lower end of x must be > 0, got 0; change inflow=",
    ),
    (
        lambda: law(equilibrium=BELOW, positive=POSITIVE)(WATER),
        UnstableStepError,
        "the density of the equilibrium of a conservation_law must be > 0, got -3; change equilibrium=",
    ),
    (
        lambda: dp.conservation_law(LINE, carried, speed_of_depth, equilibrium=BELOW)(WATER),
        NonFiniteError,
        "the speed of the equilibrium of a conservation_law along x must be finite, got 4 that are NaN or infinite, "
        "the first at 1; change equilibrium=",
    ),
    (
        lambda: dp.shallow_water(LINE, manning=[0.03, 0.02]),
        ShapeError,
        "the manning of a shallow_water must have shape (3,), got (2,)",
    ),
    (
        lambda: dp.shallow_water(LINE, manning=-0.03),
        ValueError,
        "manning of shallow_water must be >= 0, got -0.03; write manning=0.03",
    ),
    (
        lambda: dp.shallow_water(LINE, manning=0.03).stepper(0.0),
        ValueError,
        "dt of a step of shallow_water must be > 0, got 0; take law.time_step(u, params)",
    ),
    (
        lambda: dp.shallow_water(LINE, manning=0.03).stepper(0.1)(BELOW),
        UnstableStepError,
        "the depth of a shallow_water must be >= 0, got -3 in cell 1; give a state without such cells, or take smaller "
        "steps, dt <= law.time_step(u, params); with friction, take those of law.stepper(dt)",
    ),
    (
        lambda: law(positive={1: lambda u, params: u[0]}),
        TypeError,
        'the names in positive of conservation_law must be str, got int; write {"density": lambda u, params: u[0]}',
    ),
    (
        lambda: law(speed=lambda u, params, axis: [1.0, 1.0])(WATER),
        ShapeError,
        "the speed of a conservation_law must have shape (8,), got (2,)",
    ),
]


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("call, kind, message", TABLE, ids=[message[:44] for *_, message in TABLE])
def test_message(call, kind, message):
    with pytest.raises(kind) as caught:
        call()
    assert str(caught.value) == message
    assert type(caught.value) is kind


def test_lists_are_arrays():
    ground = [0.0, 1.0, 2]
    expected = dp.shallow_water(LINE, np.array(ground))(WATER)
    assert np.array_equal(dp.shallow_water(LINE, ground)(WATER), expected)
    deep = dp.shallow_water(LINE, lambda depth: [0.0, depth, 2.0])
    assert np.array_equal(deep(WATER, 1.0), expected)
    assert np.isfinite(dp.grad(lambda depth: anp.sum(deep(WATER, depth) ** 2))(1.0))
    lake = WATER + 1.0
    for equilibrium in (WATER.tolist(), lambda params: WATER.tolist()):
        assert np.array_equal(law(equilibrium=equilibrium)(lake), law(equilibrium=WATER)(lake))
    listed = dp.conservation_law(LINE, lambda *args: list(flux(*args)), lambda *args: list(speed(*args)))
    assert np.array_equal(listed(BELOW), law()(BELOW))
