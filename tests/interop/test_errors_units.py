"""Every message of with_units, printed once."""

import pytest

import sparsedp as dp
from sparsedp.errors import DerivativeError

pint = pytest.importorskip("pint")
Q = pint.get_application_registry().Quantity
with_units = dp.interop.with_units


def area(a, b):
    return a * b


AREA = with_units(area, ("m", "m"), "m^2")
TABLE = [
    (
        lambda: with_units(3, ("m",), "s"),
        TypeError,
        "with_units takes a function, got int; write dp.interop.with_units(lambda x: ..., ('m',), 's')",
    ),
    (
        lambda: with_units(area, "m", "s"),
        TypeError,
        "arguments of with_units must be a tuple with the units of each argument, got str; write ('m', 's')",
    ),
    (
        lambda: with_units(area, ({"a": "m"}, {"b": "furlongs per wibble"}), "s"),
        ValueError,
        "arguments[1]['b']: 'furlongs per wibble' is no unit that pint knows; write for example 'W/m^2'",
    ),
    (
        lambda: with_units(area, ("m", "m"), "degC"),
        ValueError,
        "result: 'degC' has an offset, so that it has no multiples; write 'K'",
    ),
    (
        lambda: with_units(area, ("dB", "m"), "m"),
        ValueError,
        "arguments[0]: 'dB' is logarithmic, so that it has no multiples; convert the level to a ratio, and write ''",
    ),
    (
        lambda: with_units(area, ("5 m", "m"), "m"),
        ValueError,
        "arguments[0]: '5 m' is a quantity, not a unit; write 'meter', and give the number with the argument or the "
        "result",
    ),
    (
        lambda: with_units(area, ("m", "m"), 2),
        ValueError,
        "result: 2 is a quantity, not a unit; write '', and give the number with the argument or the result",
    ),
    (lambda: AREA(Q(1.0, "m")), TypeError, "with_units(area) takes 2 arguments, got 1"),
    (
        lambda: AREA(Q(1.0, "m"), 2.0),
        TypeError,
        "argument 1 of with_units(area) must be a Quantity with a unit like m, got float; write "
        "pint.Quantity(value, 'm')",
    ),
    (
        lambda: AREA(Q(1.0, "m"), Q(2.0, "s")),
        ValueError,
        "argument 1 of with_units(area) must have the dimension of m, got second; give such a quantity, or declare "
        "another unit",
    ),
    (
        lambda: with_units(area, ("m", None), "m")(Q(1.0, "m"), Q(2, "s")),
        TypeError,
        "argument 1 of with_units(area) must have no unit, as declared by None, got second; declare its unit, or give "
        "its magnitude",
    ),
    (
        lambda: with_units(lambda p: p["a"], ({"a": "m", "b": "m"},), "m")({"a": Q(1.0, "m")}),
        TypeError,
        "units of argument 0: unknown key 'b'; expected 'a'",
    ),
    (
        lambda: with_units(lambda a: a, ("m",), "m").check(Q(float("nan"), "m")),
        dp.errors.NonFiniteError,
        "result of with_units(<lambda>) must be finite, got nan; write a finite number",
    ),
    (
        lambda: with_units(area, ("m", "m"), None).value_and_grad(Q(1.0, "m"), Q(1.0, "m")),
        DerivativeError,
        "with_units(area) needs one number with one unit as its result, to have a gradient",
    ),
    (
        lambda: AREA.value_and_grad(Q(1.0, "m"), Q(1.0, "m"), argnum=-1),
        ValueError,
        "argnum must be a whole number >= 0, got -1; write the number of an argument of with_units(area)",
    ),
    (
        lambda: AREA.value_and_grad(Q(1.0, "m"), Q(1.0, "m"), argnum=2),
        ValueError,
        "argnum of with_units(area) must be below 2, got 2; 0 is the first",
    ),
    (
        lambda: AREA.check(Q(1.0, "m"), Q(1.0, "m"), rtol=2.0),
        ValueError,
        "rtol must be between 0 and 1, got 2; the default is 1e-6",
    ),
]


@pytest.mark.parametrize(("call", "error", "message"), TABLE, ids=range(len(TABLE)))
def test_message(call, error, message):
    with pytest.raises(error) as found:
        call()
    assert str(found.value) == message
