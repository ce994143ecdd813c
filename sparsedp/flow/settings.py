"""The settings of a step of incompressible flow."""

from __future__ import annotations

from dataclasses import dataclass, replace
from inspect import Signature, signature
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from sparsedp.grid.grid import Grid

__all__ = ["FlowSettings", "needs_fields"]


@dataclass(frozen=True, eq=False)
class FlowSettings:
    """The arguments of `flow_step`, which documents them."""

    grid: Grid
    dt: Any
    viscosity: Any
    force: Any
    boundary: Any
    solid: Any
    implicit: bool
    convective: bool
    walls: Any
    solid_boundary: Any
    scalars: dict[str, dict[str, Any]] | None
    unstable: str
    friction: Any
    inflow: Any
    density: Any

    def with_plain_numbers(self) -> FlowSettings:
        """Return the same settings with Python numbers in place of NumPy numbers.

        The product of a NumPy number in double precision and a field in single precision is in double precision.
        """
        scalars = self.scalars
        if scalars is not None:
            scalars = {name: dict(entries) for name, entries in scalars.items()}
            for entries in scalars.values():
                if "diffusivity" in entries:
                    entries["diffusivity"] = _plain_number(entries["diffusivity"])
        return replace(
            self,
            dt=_plain_number(self.dt),
            viscosity=_plain_number(self.viscosity),
            density=_plain_number(self.density),
            scalars=scalars,
        )

    @property
    def strict(self) -> bool:
        """Whether an error is raised if dt is too large for stability."""
        return self.unstable == "raise"

    @property
    def may_be_implicit(self) -> bool:
        """Whether `implicit=True` is allowed: no friction is given."""
        return self.friction is None

    def fields_of(self, argument: str) -> tuple[str, ...]:
        """Return the names of the fields that a function of fields gets before the params."""
        if argument != "viscosity":
            return ("s",)
        if self.scalars:
            return "shear_rate", "s"
        return ("shear_rate",)


def needs_fields(argument: str, argument_value: Any, fields: tuple[str, ...]) -> bool:
    """Return whether an argument of `flow_step` is a function of fields and params, and not of params alone.

    This depends on how many positional arguments it accepts, by its signature: one, or one more than there are fields.
    The rule is the same for functions, methods, functools.partial and objects with ``__call__``.

    Parameters
    ----------
    argument : str
        Name of the argument.
    argument_value : Any
    fields : tuple of str
        The names of the fields; empty if the argument may be a function of params alone.

    Raises
    ------
    TypeError
        If it is a function that accepts neither number of arguments, or both.
    """
    if not callable(argument_value):
        return False
    examples = {1: f"{argument}=lambda params: ..."}
    if fields:
        examples[1 + len(fields)] = f"{argument}=lambda {', '.join(fields)}, params: ..."
    expected = _signature(argument_value)
    if expected is None and not fields:
        return False
    accepted = [count for count in examples if expected is None or _accepts(expected, count)]
    if len(accepted) == 1:
        return accepted[0] > 1
    counts = f"{' or '.join(map(str, examples))} argument{'s'[: len(examples) - 1]}"
    advice = " or ".join(examples.values())
    if accepted:
        raise TypeError(
            f"flow_step calls {argument} with {counts}, got a function that accepts both; write {advice}, "
            "without default values"
        )
    raise TypeError(f"flow_step calls {argument} with {counts}, got a function of {expected}; write {advice}")


def _plain_number(value: Any) -> Any:
    """Return a Python number for a NumPy number or an array without axes, and any other value as it is."""
    if isinstance(value, (np.generic, np.ndarray)) and value.ndim == 0:
        return float(value)
    return value


def _signature(function: Any) -> Signature | None:
    """Return the signature of a callable, None if it has none."""
    try:
        return signature(function)
    except ValueError:
        return None


def _accepts(expected, count):
    """Return whether a signature accepts a number of positional arguments."""
    try:
        expected.bind(*range(count))
    except TypeError:
        return False
    return True
