"""Scenes whose arguments and results have units, by pint. Only this module imports pint (extra `units`).

Arguments are converted to coherent base units (SI), the scene runs on plain arrays, and the result gets its unit: units
cost nothing inside. A scene is right in every coherent system of units only if it is dimensionally homogeneous. If the
unit of a dimension (length, say) is divided by c, each argument and each result is multiplied by c^e, with the exponent
e of this dimension in its unit. `check` runs the scene in such a system for each dimension, and compares. A number
inside the scene that has a dimension, such as 9.81 or the size of a grid, makes them differ.

References
----------
P. W. Bridgman, Dimensional Analysis (1922), chapter 2.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pint

from sparsedp._utils.base_classes import Reconstructible
from sparsedp._utils.pytree import flatten, labels, leaves, paired
from sparsedp._utils.validation import check_finite, check_function, check_number, check_whole
from sparsedp.autodiff.derivative import value_and_grad
from sparsedp.autodiff.tape import is_variable
from sparsedp.errors import DerivativeError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

__all__ = ["DimensionCheck", "ScaledRun", "SceneWithUnits", "with_units"]

FACTOR = 4.0  # c: a power of two with an exact square root, so that products and roots are scaled without rounding


def with_units(function: Callable, arguments: Sequence[Any], result: Any) -> SceneWithUnits:
    """Return a scene that takes and returns pint Quantities, for a function of arrays.

    Parameters
    ----------
    function : callable
        ``function(*args)`` returns an array, a number, or a tree of these. It computes in SI base units (m, kg, s, A,
        K, mol, cd).
    arguments : tuple
        For each argument its unit, such as "W/m^2", or a tree of units like the argument. A unit may stand for all
        entries of a branch. None stands for values without units, such as numbers of cells, and "" for numbers that may
        be differentiated.
    result : str, None, or tree of these
        Units of the result.

    Returns
    -------
    SceneWithUnits
        ``scene(*args)`` takes Quantities of the dimensions declared, in any unit, and returns Quantities in the units
        of `result`. ``scene.value_and_grad(*args)`` also returns the gradient, in units of result / argument, and
        ``scene.check(*args)`` tests whether the function is right in other units too.

    Raises
    ------
    TypeError
        If `function` is not callable, or `arguments` is not a tuple or list. On use, if an argument is missing, has no
        unit, or has one that is declared as None.
    ValueError
        If pint does not know a unit, or it has an offset. On use, if the dimension of an argument is another one.

    See Also
    --------
    interop.to_xarray

    Examples
    --------
    >>> import pint
    >>> fall = with_units(lambda h, g: (2 * h / g) ** 0.5, ("m", "m/s^2"), "s")
    >>> unit = pint.get_application_registry()
    >>> print(fall(unit.Quantity(20.0, "feet"), unit.Quantity(9.81, "m/s^2")).round(3))
    1.115 second
    >>> fall.check(unit.Quantity(20.0, "feet"), unit.Quantity(9.81, "m/s^2")).passed
    True
    """
    return SceneWithUnits(function, arguments, result)


class Unit(NamedTuple):
    """A unit: its name, its size in base units, the base units, and the exponent of each dimension."""

    name: str
    size: float
    base: Any
    exponents: dict[str, float]

    @property
    def is_one(self) -> bool:
        """Whether a number without a unit is in this unit; one of degrees or per cent could be in radians or 1."""
        return not self.exponents and self.size == 1


class ScaledRun(NamedTuple):
    """The comparison of one entry of the result in two systems of units.

    Attributes
    ----------
    dimension : str
        The dimension whose unit differs.
    place : str
        The entry of the result.
    expected, found : float
        The exponent of the dimension in the unit declared, and the one that both values show. NaN for values of 0.
    deviation : float
        The largest difference, relative to the largest entry.
    failure : str
        The error that the scene raised in the other system.
    """

    dimension: str
    place: str
    expected: float
    found: float
    deviation: float
    failure: str = ""


@dataclass(frozen=True)
class DimensionCheck:
    """The result of `SceneWithUnits.check`.

    Attributes
    ----------
    runs : list of ScaledRun
    rtol : float
    gaps : list of str
        What the runs do not show, such as an argument of 0, which is the same in all units.
    """

    runs: list[ScaledRun]
    rtol: float
    gaps: list[str]

    @property
    def passed(self) -> bool:
        """Return whether the scene gives the same result in all systems of units."""
        return self.verdict == "homogeneous"

    @property
    def verdict(self) -> str:
        """Return "homogeneous", "not homogeneous", or "inconclusive" if there are gaps."""
        if any(self._differs(run) for run in self.runs):
            return "not homogeneous"
        if self.gaps:
            return "inconclusive"
        return "homogeneous"

    def _differs(self, run: ScaledRun) -> bool:
        return bool(run.failure) or not run.deviation <= self.rtol

    def __str__(self) -> str:
        lines = ["dimension        result            declared  found  deviation"]
        for run in self.runs:
            line = f"{run.dimension:16} {run.place:16} {run.expected:9.3g} {run.found:6.3g} {run.deviation:10.1e}"
            lines.append(f"{line}  {run.failure}".rstrip())
        wrong = sorted({run.dimension for run in self.runs if self._differs(run)})
        lines.append(f"verdict: {self.verdict}")
        if wrong:
            lines.append(
                f"a number inside the scene has the dimension {', '.join(wrong)}, or a unit is declared wrongly: make "
                "the number an argument with a unit"
            )
        lines += self.gaps
        return "\n".join(lines)


class SceneWithUnits(Reconstructible):
    """A function of arrays as a function of Quantities, as returned by `with_units`.

    Parameters
    ----------
    function, arguments, result
        As in `with_units`.
    """

    def __init__(self, function: Callable, arguments: Sequence[Any], result: Any) -> None:
        check_function("with_units", function, "dp.interop.with_units(lambda x: ..., ('m',), 's')")
        if not isinstance(arguments, (tuple, list)):
            raise TypeError(
                f"arguments of with_units must be a tuple with the units of each argument, got "
                f"{type(arguments).__name__}; write ('m', 's')"
            )
        self.function = function
        self.arguments = tuple(arguments)
        self.result = result
        self.name = f"with_units({getattr(function, '__name__', type(function).__name__)})"
        self.constructor_call = SceneWithUnits, (function, arguments, result)
        self._registry = pint.get_application_registry()
        self._units: dict[str, Unit] = {}
        for what, tree in (("arguments", self.arguments), ("result", result)):
            for place, name in zip(labels(tree, what), leaves(tree), strict=True):
                self._declare(place, name)

    def __call__(self, *args: Any) -> Any:
        """Return the result as Quantities in the units declared, for arguments that are Quantities."""
        return self._with_units(self.function(*self._magnitudes(args)))

    def value_and_grad(self, *args: Any, argnum: int = 0) -> tuple[Any, Any]:
        """Return the value of a scene with one number as its result, and its gradient with respect to one argument.

        Parameters
        ----------
        *args : trees of Quantities
        argnum : int
            Number of the argument.

        Returns
        -------
        value : Quantity
        gradient : tree of Quantities
            Like the argument, in the unit of the result divided by the unit declared for the argument.

        Raises
        ------
        TypeError
            If the number of arguments is another one, or an argument has no unit, or one that is not declared.
        ValueError
            If an argument has another dimension than declared, or there is no argument `argnum`.
        DerivativeError
            If the result declared is not one number with one unit.
        ShapeError
            If the result is an array and not a number.

        See Also
        --------
        check
        """
        argnum = check_whole("argnum", argnum, 0, f"; write the number of an argument of {self.name}")
        if argnum >= len(self.arguments):
            raise ValueError(f"argnum of {self.name} must be below {len(self.arguments)}, got {argnum}; 0 is the first")
        if not isinstance(self.result, str):
            raise DerivativeError(f"{self.name} needs one number with one unit as its result, to have a gradient")
        magnitudes = self._magnitudes(args)
        value, gradient = value_and_grad(self.function, argnum)(*magnitudes)
        result = self._units[self.result]
        slopes, rebuild = flatten(gradient)
        names = self._names(args[argnum], argnum)
        pairs = zip(names, slopes, strict=True)
        return self._with_units(value), rebuild([self._slope(result, name, slope) for name, slope in pairs])

    def check(self, *args: Any, rtol: float = 1e-6) -> DimensionCheck:
        """Run the scene in other systems of units, and compare the results.

        Parameters
        ----------
        *args : trees of Quantities
        rtol : float
            Largest relative deviation of a result. Solves have errors of their tolerance, which depend on the units.

        Returns
        -------
        DimensionCheck
            ``print(report)`` shows a row for each dimension; `report.passed` says whether all agree. An error of the
            scene in another system of units is part of the report.

        Raises
        ------
        TypeError
            If the number of arguments is another one, an argument has no unit, or one that is not declared, or the
            result is another tree than the units declared for it.
        ValueError
            If an argument has another dimension than declared, or rtol is out of range.
        NonFiniteError
            If the result holds NaN or infinity.

        Notes
        -----
        Floating-point results declared as None must be the same in all systems, like those declared as "". The check
        is inconclusive if no unit has a dimension, and if an argument with a dimension, or a result, is 0 everywhere:
        0 is 0 in every unit. Give other values, and leave out results that are always 0.
        """
        rtol = check_number("rtol", rtol, "between 0 and 1", "; the default is 1e-6")
        magnitudes = self._magnitudes(args)
        value = self.function(*magnitudes)
        names = self._names_of_result(value)
        for place, leaf in zip(labels(value, "result"), leaves(value), strict=True):
            if is_variable(leaf):
                check_finite(f"{place} of {self.name}", leaf)
        dimensions = sorted({dimension for unit in self._units.values() for dimension in unit.exponents})
        gaps = self._gaps(args, magnitudes, value)
        if not dimensions:
            gaps.append("no argument and no result has a unit with a dimension: there is nothing to compare")
        runs: list[ScaledRun] = []
        for dimension in dimensions:
            scaled = [self._scaled(arg, number, dimension) for number, arg in enumerate(magnitudes)]
            places = labels(value, "result")
            try:
                others = leaves(self.function(*scaled))
            except Exception as error:
                runs.append(ScaledRun(dimension, "result", np.nan, np.nan, np.inf, f"{type(error).__name__}: {error}"))
                continue
            for place, name, one, other in zip(places, names, leaves(value), others, strict=True):
                if name is not None or is_variable(one):
                    runs.append(_compared(dimension, place, self._exponent(name, dimension), one, other))
        if not runs and not gaps:
            gaps.append("the result has no floating-point numbers: there is nothing to compare")
        return DimensionCheck(runs, rtol, gaps)

    def _gaps(self, args: tuple, magnitudes: list, value: Any) -> list[str]:
        """Return a sentence for each argument with a dimension, and for each result, that is 0 everywhere."""
        gaps = []
        for number, (argument, magnitude) in enumerate(zip(args, magnitudes, strict=True)):
            places = labels(argument, f"argument {number}")
            for place, name, leaf in zip(places, self._names(argument, number), leaves(magnitude), strict=True):
                if leaf is not None and name is not None and self._units[name].exponents and not np.any(leaf):
                    gaps.append(f"{place} is 0, which is the same in all units: give another value")
        names = self._names_of_result(value)
        for place, name, leaf in zip(labels(value, "result"), names, leaves(value), strict=True):
            if leaf is not None and (name is not None or is_variable(leaf)) and not np.any(leaf):
                gaps.append(f"{place} is 0, which is the same in all units: give other arguments")
        return gaps

    # ------------------------------------------------------------ units

    def _declare(self, place: str, name: Any) -> None:
        """Store a unit; raise an error for a name that is no unit."""
        if name is None:
            return
        offset = f"{place}: {name!r} has an offset, so that it has no multiples; write 'K'"
        try:
            unit = self._registry.Unit(name)
            base = self._registry.Quantity(1.0, unit).to_base_units()
            zero, two = (self._registry.Quantity(number, unit).to_base_units().magnitude for number in (0.0, 2.0))
        except pint.OffsetUnitCalculusError:
            raise ValueError(offset) from None
        except Exception:  # pint raises errors of many types for texts that are no units
            number = self._number_in(name)
            if number is not None:
                unit = str(number.units).replace("dimensionless", "")
                raise ValueError(
                    f"{place}: {name!r} is a quantity, not a unit; write {unit!r}, and give the number with the "
                    "argument or the result"
                ) from None
            raise ValueError(f"{place}: {name!r} is no unit that pint knows; write for example 'W/m^2'") from None
        if zero != 0:
            if np.isclose(two - base.magnitude, base.magnitude - zero):
                raise ValueError(offset)
            raise ValueError(
                f"{place}: {name!r} is logarithmic, so that it has no multiples; convert the level to a ratio, and "
                "write ''"
            )
        self._units[name] = Unit(name, float(base.magnitude), base.units, _exponents(unit))

    def _number_in(self, name: Any) -> Any:
        """Return the Quantity that a text such as "5 m" stands for, or None."""
        with suppress(Exception):  # pint raises errors of many types for texts that are no quantities
            return self._registry.Quantity(str(name))
        return None

    def _exponent(self, name: str | None, dimension: str) -> float:
        if name is None:
            return 0.0
        return self._units[name].exponents.get(dimension, 0.0)

    def _names(self, argument: Any, number: int) -> list:
        """Return the unit of each leaf of an argument."""
        place = f"units of argument {number}"
        return paired(self.arguments[number], argument, place, prefix=_is_unit, error=TypeError)

    def _names_of_result(self, value: Any) -> list:
        return paired(self.result, value, "units of the result", prefix=_is_unit, error=TypeError)

    def _magnitudes(self, args: tuple) -> list:
        """Return the arguments as plain arrays in base units."""
        if len(args) != len(self.arguments):
            raise TypeError(f"{self.name} takes {len(self.arguments)} arguments, got {len(args)}")
        magnitudes = []
        for number, argument in enumerate(args):
            entries, rebuild = flatten(argument)
            names = self._names(argument, number)
            rows = zip(labels(argument, f"argument {number}"), names, entries, strict=True)
            magnitudes.append(rebuild([self._magnitude(*row) for row in rows]))
        return magnitudes

    def _magnitude(self, place: str, name: str | None, leaf: Any) -> Any:
        """Return a value in base units."""
        if not hasattr(leaf, "dimensionality"):
            if name is None or leaf is None or self._units[name].is_one:
                return leaf
            raise TypeError(
                f"{place} of {self.name} must be a Quantity with a unit like {name}, got {type(leaf).__name__}; write "
                f"pint.Quantity(value, {name!r})"
            )
        units = type(leaf.units._units)(dict(leaf.unit_items()))  # as text, an exponent of 1/3 would be rounded
        quantity = self._registry.Quantity(leaf.magnitude, units)  # it may belong to another registry
        if name is None:
            raise TypeError(
                f"{place} of {self.name} must have no unit, as declared by None, got {quantity.units}; declare its "
                "unit, or give its magnitude"
            )
        unit = self._units[name]
        if _exponents(quantity) != unit.exponents:
            raise ValueError(
                f"{place} of {self.name} must have the dimension of {unit.name}, got {quantity.units}; give such a "
                "quantity, or declare another unit"
            )
        value = quantity.to(unit.base).magnitude
        if np.asarray(value).dtype.kind in "iu":
            value = np.multiply(value, 1.0)
        return value

    def _with_units(self, value: Any) -> Any:
        """Return a result with the units declared."""
        entries, rebuild = flatten(value)
        results = []
        for name, leaf in zip(self._names_of_result(value), entries, strict=True):
            if name is None or leaf is None:
                results.append(leaf)
            else:
                results.append(self._registry.Quantity(leaf / self._units[name].size, name))
        return rebuild(results)

    def _slope(self, result: Unit, name: str | None, slope: Any) -> Any:
        """Return a derivative in the unit of the result divided by that of the argument."""
        if slope is None:
            return None
        size = 1.0
        unit = self._registry.Unit(result.name)
        if name is not None:
            size = self._units[name].size
            unit = unit / self._registry.Unit(name)
        return self._registry.Quantity(slope * (size / result.size), unit)

    def _scaled(self, argument: Any, number: int, dimension: str) -> Any:
        """Return an argument in the system in which the unit of a dimension is `FACTOR` times smaller."""
        entries, rebuild = flatten(argument)
        scaled = []
        for name, leaf in zip(self._names(argument, number), entries, strict=True):
            exponent = self._exponent(name, dimension)
            scaled.append(leaf * FACTOR**exponent if exponent else leaf)
        return rebuild(scaled)

    def __repr__(self) -> str:
        return f"<{self.name}: {self.arguments} -> {self.result}>"


def _exponents(unit: Any) -> dict[str, float]:
    """Return the exponent of each dimension in a unit or in the unit of a Quantity."""
    return {dimension.strip("[]"): float(power) for dimension, power in unit.dimensionality.items()}


def _is_unit(entry: Any) -> bool:
    """Return whether an entry of a declaration may stand for a whole branch."""
    return entry is None or isinstance(entry, str)


def _compared(dimension: str, place: str, expected: float, one: Any, other: Any) -> ScaledRun:
    """Compare an entry of the result with that in the other system of units."""
    expected_result = np.asarray(one) * FACTOR**expected
    result = np.asarray(other)
    if expected_result.shape != result.shape:
        return ScaledRun(
            dimension, place, expected, np.nan, np.inf, f"shape {result.shape} for {expected_result.shape}"
        )
    size = float(np.max(np.abs(expected_result), initial=0.0))
    length = float(np.linalg.norm(one))
    other_length = float(np.linalg.norm(other))
    exponent = np.nan
    if length and other_length:
        exponent = float(np.log(other_length / length) / np.log(FACTOR))
    deviation = float(np.max(np.abs(result - expected_result), initial=0.0))
    if size:
        deviation = deviation / size
    return ScaledRun(dimension, place, expected, exponent, deviation)
