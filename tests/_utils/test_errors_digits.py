"""A message that compares a number with a limit shows enough digits to tell them apart."""

import re

import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils.validation import check_number, number_beside
from sparsedp.check.summary import Row, Summary
from sparsedp.errors import ConvergenceError, UnstableStepError

BOX = dp.Grid((4, 3), size=1.0)
LINE = dp.Grid(4, size=1.0)


@pytest.mark.parametrize("limit", [0.0, 1.0, 1 / 3, 0.1, 1e-10, 5.0, 123456.7])
@pytest.mark.parametrize("style", ["g", "e"])
def test_the_text_is_on_the_side_of_the_number(limit, style):
    rng = np.random.default_rng(0)
    for exponent in range(-16, 3):
        for sign in (-1, 1):
            number = limit + sign * rng.uniform(0.5, 1.0) * 10.0**exponent * (limit or 1.0)
            text = number_beside(number, limit, style=style, digits=2)
            shown = float(text)
            assert np.sign(shown - limit) == np.sign(number - limit)
            assert number == limit or shown != float(f"{limit:g}")


def test_no_more_digits_than_needed():
    assert number_beside(1.5, 0.0, 1.0) == "1.5"
    assert number_beside(2.0, 2.0) == "2"
    assert number_beside(0.1 + 1e-7, 0.1) == "0.1000001"
    assert number_beside(np.nan, 0.0) == "nan" and number_beside(np.inf, 1.0) == "inf"


@pytest.mark.parametrize(
    ("needs", "number", "text"),
    [
        ("from 0 to 1", 1 + 1e-12, "1.000000000001"),
        ("between 0 and 1", 1.0, "1"),
        ("from 0 to 1", np.nextafter(1, 2), "1.0000000000000002"),
        (">= 0", -1e-300, "-1e-300"),
    ],
)
def test_numbers_out_of_range(needs, number, text):
    with pytest.raises(ValueError, match=re.escape(f"x must be {needs}, got {text}") + "$"):
        check_number("x", number, needs)


def test_points_just_outside():
    with pytest.raises(ValueError, match=re.escape("points need x from 0 to 1, got x = 1.000000000001") + "$"):
        dp.sample(BOX, [[1 + 1e-12, 0.5]])
    with pytest.raises(ValueError, match=re.escape("points need y from 0 to 1, got y = -1e-12") + "$"):
        dp.sample(BOX, [[0.5, -1e-12]])


def test_a_residual_just_above_its_tolerance():
    op = -dp.laplacian(dp.Grid((16, 16), size=1.0), dp.dirichlet)
    b = np.random.default_rng(0).standard_normal((16, 16))
    with pytest.raises(ConvergenceError) as first:
        dp.inverse(op, "krylov", rtol=1e-12, maxiter=2)(b)
    tolerance = float(f"{first.value.info.residual * (1 - 1e-3):.3g}")
    with pytest.raises(ConvergenceError) as second:
        dp.inverse(op, "krylov", rtol=tolerance, maxiter=2)(b)
    reached, wanted = re.search(r"relative residual (\S+) after .*, wanted (\S+) ", str(second.value)).groups()
    assert float(reached) > float(wanted)


def steps_just_too_long(beyond):
    """Return calls with a step that is too long by a share, by name of the scheme."""
    u = np.ones(4)
    wind = np.ones(5)
    decay = dp.stepper("heun", dp.diagonal(LINE.cells, np.full(4, -8.0)), 0.25 * (1 + beyond))
    return {
        "transport": lambda: dp.transport(LINE)(u, wind, 0.25 * (1 + beyond)),
        "heun": lambda: decay(u),
    }


@pytest.mark.parametrize("name", ["transport", "heun"])
def test_a_step_just_too_long(name):
    with pytest.raises(UnstableStepError) as caught:
        steps_just_too_long(1.5e-12)[name]()
    given, largest = re.search(r"dt = (\S+)(?: is|:).* the largest stable dt is ([\d.e-]+)", str(caught.value)).groups()
    assert float(given) > float(largest)


def test_a_step_of_a_flow_just_too_long():
    with pytest.raises(UnstableStepError) as caught:
        dp.flow_step(dp.Grid((8, 8), size=1.0), 0.0625 * (1 + 1.5e-12), viscosity=0.03125)
    given, largest = re.search(r"dt = (\S+): the largest stable dt is ([\d.e-]+)", str(caught.value)).groups()
    assert float(given) > float(largest)


def test_a_ratio_of_distances_just_too_large():
    grid = dp.Grid(4, spacing=[[1.0, 1.0, 9.001, 9.001]])
    with pytest.raises(ValueError, match=r"a factor of 5 from one to the next, got 5\.0005; write"):
        dp.transport(grid, "semi_lagrangian", interpolation="cubic")


def test_an_order_just_outside():
    result = dp.check.order(lambda n: n**-2.1001, expected=2.0)
    assert result.verdict == "disagrees" and result.reason == "expected 1.9 to 2.1, got 2.1001"


def test_a_figure_of_a_check_just_above_its_limit():
    result = Summary("a check", [Row("linearity", 10.004, 10.0, False), Row("transpose", 9.99, 10.0, True)])
    assert re.search(r"linearity +10\.004 +<= 10 +FAILS", str(result))
