"""The projection of face fields on ranks, composed of operators: no rank has a whole field for compiled passes."""

from __future__ import annotations

from functools import cached_property
from typing import Any

from sparsedp.flow.projection_setup import ProjectionSetup
from sparsedp.operators.masks_and_lift import diagonal
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Structure
from sparsedp.solvers.inverse import build

__all__ = ["RanksProjectionSetup"]


class RanksProjectionSetup(ProjectionSetup):
    """See `ProjectionSetup`. It has no passes."""

    def _pressure_inverse(self, op: Operator) -> Any:
        return build(op, self.settings, "pressure solve")

    def _set_up_passes(self) -> None:
        pass

    @cached_property
    def _open_faces(self) -> Operator:
        """K. Because 0 times NaN is NaN, the solve detects NaN on closed faces too."""
        return diagonal(self._gradient.codomain, self.open)

    @cached_property
    def _unscaled_pressure(self) -> Operator:
        """The map from a face field to p on the grid of the operators."""
        return self.inverse @ self._divergence @ self._open_faces

    def structure(self) -> Structure:
        """Return the linear map P on flat face fields."""
        P = self._open_faces + self._gradient @ self._unscaled_pressure
        if self.nothing_flows:
            P = 0.0 * P
        return P.structure

    def pressure_structure(self) -> Structure:
        """Return the linear map from flat face fields to the pressure."""
        return (2.0**self.exponent * self._unscaled_pressure).structure
