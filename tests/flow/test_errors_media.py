"""Messages for a viscosity, diffusivity, density and step length of flow_step that vary."""

import re

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.errors import ShapeError


def media(**given):
    """Run one step in a box of 4 x 4 cells."""
    grid = dp.Grid((4, 4), size=4.0)
    s = {"c": np.ones((4, 4))} if "scalars" in given else None
    step = dp.flow_step(grid, **{"dt": 0.1, **given})
    return step(step.start(np.zeros(40), 1.0, s), 1.0)


NEGATIVE = -np.eye(4)
REFUSED = [
    ({"viscosity": NEGATIVE}, ValueError, "viscosity of flow_step must be >= 0, got -1 in cell (0, 0)"),
    ({"viscosity": lambda p: NEGATIVE}, ValueError, "viscosity of flow_step must be >= 0, got -1 in cell (0, 0)"),
    ({"density": np.eye(4)}, ValueError, "density of flow_step must be > 0, got 0 in cell (0, 1)"),
    ({"density": 0.0}, ValueError, "density of flow_step must be > 0, got 0"),
    ({"density": lambda p: 0 * p}, ValueError, "density of flow_step must be > 0, got 0"),
    (
        {"viscosity": np.ones(3)},
        dp.errors.ShapeError,
        "flow_step, as viscosity, takes a field on cells(4, 4), got an array of shape (3,); write one "
        "number for each cell",
    ),
    (
        {"density": lambda p: np.ones(3)},
        dp.errors.ShapeError,
        "flow_step, as density, takes a field on cells(4, 4), got an array of shape (3,); write one "
        "number for each cell",
    ),
    (
        {"scalars": {"c": {"diffusivity": np.ones(3)}}},
        dp.errors.ShapeError,
        "flow_step, as diffusivity of 'c', takes a field on cells(4, 4), got an array of shape (3,); write one "
        "number for each cell",
    ),
    (
        {"viscosity": np.full((4, 4), 1j)},
        TypeError,
        "viscosity of flow_step must hold real numbers, got dtype complex128; write its .real",
    ),
    (
        {"density": np.full((4, 4), np.nan)},
        dp.errors.NonFiniteError,
        "density of flow_step must be finite, got 16 that are NaN or infinite, the first at (0, 0)",
    ),
    ({"dt": lambda p: -p}, ValueError, "dt of flow_step must be > 0, got -1"),
    (
        {"viscosity": lambda rate, p: 0.1 + rate, "walls": np.zeros(40)},
        ValueError,
        "flow_step takes walls= as a function beside a viscosity that depends on the shear rate; write "
        "walls=lambda params: values, with values on face_lift(grid, boundary).domain",
    ),
    (
        {"viscosity": lambda rate, p: rate, "scalars": {"c": {}}},
        TypeError,
        "flow_step calls viscosity with 1 or 3 arguments, got a function of (rate, p); write viscosity=lambda params: "
        "... or viscosity=lambda shear_rate, s, params: ...",
    ),
    (
        {"viscosity": lambda rate, s, p: rate},
        TypeError,
        "flow_step calls viscosity with 1 or 2 arguments, got a function of (rate, s, p); write viscosity=lambda "
        "params: ... or viscosity=lambda shear_rate, params: ...",
    ),
    (
        {"viscosity": lambda rate, p=None: rate},
        TypeError,
        "flow_step calls viscosity with 1 or 2 arguments, got a function that accepts both; write viscosity=lambda "
        "params: ... or viscosity=lambda shear_rate, params: ..., without default values",
    ),
    (
        {"density": lambda v, s, p: 1.0},
        TypeError,
        "flow_step calls density with 1 or 2 arguments, got a function of (v, s, p); write density=lambda params: ... "
        "or density=lambda s, params: ...",
    ),
    (
        {"density": lambda s, p: 1.0},
        ValueError,
        "density of flow_step is a function of scalars, and there are none; write density=lambda params: ...",
    ),
    (
        {"dt": lambda s, p: 1.0},
        TypeError,
        "flow_step calls dt with 1 argument, got a function of (s, p); write dt=lambda params: ...",
    ),
    (
        {"viscosity": np.full((4, 4), 2.0)},
        dp.errors.UnstableStepError,
        "flow_step is unstable for the largest viscosity = 2 with dt = 0.1: the largest stable dt is 0.03125; take "
        "smaller steps or write implicit=True",
    ),
    (
        {"viscosity": 2.0, "density": 0.5},
        dp.errors.UnstableStepError,
        "flow_step is unstable for viscosity = 2 with dt = 0.1: the largest stable dt is 0.03125; take smaller steps "
        "or write implicit=True",
    ),
]


@pytest.mark.parametrize("given, error, message", REFUSED)
def test_refused_media(given, error, message):
    with pytest.raises(error) as caught:
        media(**given)
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("argument", "build"),
    [
        ("viscosity", lambda grid, x: dp.flow_step(grid, 0.1, x)),
        ("density", lambda grid, x: dp.flow_step(grid, 0.1, density=x)),
        ("diffusivity", lambda grid, x: dp.flow_step(grid, 0.1, scalars={"c": {"diffusivity": x}})),
        ("dt", lambda grid, x: dp.flow_step(grid, x[0, 0])),
    ],
)
def test_traced_media_are_functions(argument, build):
    words = rf"flow_step needs a constant {argument}.*, got a traced one; a derivative in the {argument} takes "
    with pytest.raises(dp.errors.DerivativeError, match=f"{words}{argument}=lambda params: ..."):
        dp.grad(lambda x: anp.sum(build(dp.Grid((4, 4)), x).start(np.zeros(40))["v"]))(np.ones((4, 4)))


PROJECTION = [
    (
        np.ones(5),
        dp.errors.ShapeError,
        "projection takes a density that is a number or a field on cells(4, 4) or faces(4, 4), got an array of shape "
        "(5,)",
    ),
    (0.0, ValueError, "density of projection must be > 0, got 0"),
    (NEGATIVE, ValueError, "density of projection must be > 0, got -1 in cell (0, 0)"),
    (1j, TypeError, "density of projection must hold real numbers, got dtype complex128; write its .real"),
    (np.nan, dp.errors.NonFiniteError, "density of projection must be finite, got nan"),
    (
        1e-320,
        dp.errors.NonFiniteError,
        "the density and its reciprocal must be finite in float64, got a density of 9.99989e-321; write the density in "
        "other units",
    ),
]


@pytest.mark.parametrize("density, error, message", PROJECTION)
def test_refused_densities(density, error, message):
    with pytest.raises(error) as caught:
        dp.projection(dp.Grid((4, 4)))(np.ones(40), density)
    assert str(caught.value) == message


RANKS = {
    "a viscosity that varies in flow_step": lambda: media(viscosity=lambda rate, p: 0.1 * rate),
    "a diffusivity that varies in flow_step": lambda: media(scalars={"c": {"diffusivity": lambda s, p: 0.1 * s["c"]}}),
    "density in flow_step": lambda: media(density=2.0),
    "density in projection": lambda: dp.projection(dp.Grid((4, 4)))(np.ones(40), 2.0),
}


@pytest.mark.parametrize("name", RANKS)
def test_what_is_refused_on_ranks(name, monkeypatch):
    """These ask the backend of the grid, which refuses their names on ranks."""

    def check(self, asked):
        if asked == name:
            raise TypeError(f"{asked} does not work on ranks yet")

    monkeypatch.setattr(type(dp.Grid((4, 4)).backend), "check", check)
    with pytest.raises(TypeError, match=name):
        RANKS[name]()


def test_batches_of_velocities_and_densities():
    grid = dp.Grid((4, 3))
    message = (
        "projection needs one size of the batch, got 3 velocities and 2 densities; give both the same leading axis, or "
        "only one of them"
    )
    for space in (grid.cells, grid.faces):
        with pytest.raises(ShapeError, match=f"^{re.escape(message)}$"):
            dp.projection(grid)(np.ones((3, grid.faces.size)), np.ones((2, *space.shape)))
