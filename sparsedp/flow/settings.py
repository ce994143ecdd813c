"""The settings of a step of incompressible flow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sparsedp.grid.grid import Grid

__all__ = ["FlowSettings"]


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
