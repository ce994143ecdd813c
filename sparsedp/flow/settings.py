"""The settings of a step of incompressible flow."""

from __future__ import annotations

from dataclasses import dataclass
from types import FunctionType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sparsedp.grid.grid import Grid

__all__ = ["FlowSettings", "takes_params_alone"]


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

    @property
    def strict(self) -> bool:
        """Whether an error is raised if dt is too large for stability."""
        return self.unstable == "raise"

    @property
    def may_be_implicit(self) -> bool:
        """Whether `implicit=True` is allowed: no friction is given, and no diffusivity is a function of scalars."""
        diffusivities = [entries.get("diffusivity") for entries in (self.scalars or {}).values()]
        return self.friction is None and all(map(takes_params_alone, diffusivities))


def takes_params_alone(given: Any) -> bool:
    """Return whether an argument is not a function, or a function with one argument that has no default value."""
    if type(given) is not FunctionType:
        return True
    return given.__code__.co_argcount - len(given.__defaults__ or ()) <= 1
