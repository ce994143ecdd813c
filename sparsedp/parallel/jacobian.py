"""Jacobians of residuals whose unknowns are distributed fields. Each rank assembles the rows of its own block."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sparsedp.grid.space import Space
from sparsedp.operators.given import from_matrix
from sparsedp.operators.operator import Operator
from sparsedp.parallel.cut import storage
from sparsedp.parallel.stencil import Stencil, find_stencil
from sparsedp.solvers.jacobian import Jacobians, KnownPattern, probing_points
from sparsedp.solvers.newton import Equation

__all__ = ["RanksJacobians"]


class RanksJacobians(Jacobians):
    """Computes the Jacobians of one residual of distributed fields. Their sparsity pattern is a `Stencil`."""

    can_relax = False  # relaxation would need all rows, but each rank has only its own

    def _solver(self, op, near):
        return self._build(op, near)

    def _assembled(self, pattern, product, unknowns):
        return pattern.coloured.operator(product, self.solver_name), False

    def _on_unknowns(self, op: Operator, space: Space) -> Operator:
        if storage(op.domain) == storage(op.codomain) == storage(space):
            return op
        return from_matrix(op.matrix, space, space, op.name)

    def _find_pattern(self, equation, x, leaves):
        return self._find_stencil(equation, probing_points(equation, x, leaves), leaves, None)

    def _enlarge_pattern(self, linearisation, row):
        equation, x, leaves = linearisation.point
        structure: Any = linearisation.solver.system.unscaled.structure
        self._find_stencil(equation, [x], leaves, structure.stencil)

    def _find_stencil(
        self, equation: Equation, points: Sequence[Any], leaves: Sequence[Any], incomplete: Stencil | None
    ) -> KnownPattern:
        """Find and store the stencil of the unknowns; it includes the entries of `incomplete` if that is given."""
        unknowns = equation.unknowns
        self.description = f"the rows of each rank, {unknowns.backend}"
        if self.sparsity is not None:
            raise TypeError(f"{self.name} takes no sparsity for fields on ranks; leave it out")
        products = self._pattern_products(equation, points, leaves, by_rows=False)
        stencil = find_stencil(self.name, unknowns.space, products, incomplete)
        return self._store(unknowns.space, KnownPattern(stencil, None))
