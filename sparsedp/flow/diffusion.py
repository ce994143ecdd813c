"""Diffusive terms of a flow step with a constant coefficient, and the amplification of waves by a step.

The terms are explicit, or implicit by the trapezoidal rule; `variable_diffusion` has those whose coefficient varies.
The second-order Adams-Bashforth method is stable for an explicit term nu L u if dt nu |lambda| <= 1 for all eigenvalues
lambda of L. For a wave with the Courant number c and the damping d = dt nu k^2 in a step, the amplification factor of
the step is the largest absolute value |z| of the roots of

    z^2 - z = (3/2 z - 1/2) (i c - d),      or, with implicit damping,  (z^2 - z) + d z (z + 1) / 2 = (3/2 z - 1/2) i c.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.validation import number_beside, rounded_down
from sparsedp.autodiff.tape import dtype_of
from sparsedp.errors import UnstableStepError
from sparsedp.operators.masks_and_lift import identity
from sparsedp.solvers.inverse import inverse

if TYPE_CHECKING:
    from sparsedp.flow.settings import FlowSettings
    from sparsedp.operators.operator import Operator

__all__ = ["Diffusion", "check_stable", "implicit_step", "spectral_bound", "wave_growth"]

ROUNDING = 1e-12  # tolerance: a step exactly at the stability limit may exceed it by a rounding error


class Diffusion:
    """A term nu (L u + contribution of walls) of a flow step. For nu = 0 no operator is built.

    Parameters
    ----------
    name : str
        Name of nu in error messages.
    coefficient : float
        nu.
    build_operator : callable
        ``build_operator()`` returns L.
    settings : FlowSettings

    Attributes
    ----------
    op : Operator or None
        L; None if nu is 0.
    solve : Operator or None
        The inverse of I - dt nu L / 2 if the term is implicit, else None.
    damping : float
        dt nu |L|, with the largest absolute row sum as |L|.
    """

    varies = False
    op: Any
    solve: Any

    def __init__(
        self,
        name: str,
        coefficient: float,
        build_operator: Callable[[], Operator],
        settings: FlowSettings,
    ) -> None:
        self.name = name
        self.coefficient = coefficient
        self.settings = settings
        if coefficient:
            self.op = build_operator()
        else:
            self.op = None
        self.solve = None
        self.damping = 0.0
        if self.op is None:
            return
        self.damping = settings.dt * coefficient * spectral_bound(self.op)
        if settings.implicit:
            self.solve = inverse(identity(self.op.domain) - (0.5 * settings.dt * coefficient) * self.op)
        else:
            check_stable(name, coefficient, settings.dt, coefficient * spectral_bound(self.op), settings)

    @property
    def implicit(self) -> bool:
        """Whether the term is implicit and not 0."""
        return self.solve is not None

    def add_explicit(self, rate: Any, u: Any, wall_part: Callable[[], Any]) -> Any:
        """Return the rate plus this term if the term is explicit; return the rate itself if it is implicit.

        Parameters
        ----------
        rate, u : array
        wall_part : callable
            ``wall_part()`` returns the contribution of walls to L u, or None if it is 0.
        """
        if self.op is None or self.solve is not None:
            return rate
        return rate + self.coefficient * self._laplacian(u, wall_part())

    def step_implicit(self, explicit: Any, u: Any, wall_part: Any) -> Any:
        """Return the field at the end of the step, by the trapezoidal rule.

        Parameters
        ----------
        explicit : array
            The field after the step with all terms except this one.
        u : array
            The field at the beginning of the step.
        wall_part : array or None
            Contribution of walls to L u at the beginning of the step, plus their contribution at its end.
        """
        half_step = 0.5 * self.settings.dt * self.coefficient
        return implicit_step(explicit, self._laplacian(u, wall_part), half_step, self.solve)

    def _laplacian(self, u: Any, wall_part: Any) -> Any:
        if wall_part is None:
            return self.op(u)
        return self.op(u) + wall_part


def implicit_step(explicit: Any, rate: Any, length: Any, solve: Callable[[Any], Any]) -> Any:
    """Return the field w at the end of a step with a linear implicit term A: w = explicit + length (rate + A w).

    Parameters
    ----------
    explicit : array
        The field after the step with all other terms.
    rate : array
        For the trapezoidal rule, A u of the field u at the beginning of the step; with the contributions of walls.
    length : number or array
        For the trapezoidal rule, half the length of the step.
    solve : callable
        ``solve(b)`` returns the solution of w - length A w = b.
    """
    return solve(explicit + length * rate)


def spectral_bound(op: Operator) -> float:
    """Return an upper bound of the absolute eigenvalues of an operator: its largest absolute row sum."""
    row_sums = op.structure.magnitude()(np.ones(op.domain.size))
    return float(np.max(row_sums, initial=0.0))


def check_stable(name: str, coefficient: float, dt: float, rate: float, settings: FlowSettings) -> None:
    """Raise UnstableStepError if an explicit term with eigenvalues up to `rate` is unstable, unless that is allowed."""
    tolerance = max(ROUNDING, 2 * float(np.finfo(dtype_of(dt)).eps))
    if not settings.strict or not float(dt) * rate > 1 + tolerance:
        return
    largest = rounded_down(1 / rate)
    if settings.may_be_implicit:
        advice = "take smaller steps or write implicit=True"
    else:
        advice = "take smaller steps, or write unstable='allow'"
    raise UnstableStepError(
        f"flow_step is unstable for {name} = {coefficient:.6g} with "
        f"dt = {number_beside(dt, float(largest), digits=12)}: the largest stable dt is {largest}; {advice}"
    )


def wave_growth(courant: float, damping: float, implicit: bool) -> float:
    """Return the largest amplification factor of a wave in one step, by the equations of the module docstring.

    Parameters
    ----------
    courant : float
        Courant number of the flow.
    damping : float
        dt nu |L| of the damping term.
    implicit : bool
        Whether the damping term is implicit.
    """
    angle = np.linspace(0.0, np.pi, 65)
    advance = 1j * courant * np.sin(angle)
    decay = damping * np.sin(angle / 2) ** 2
    # Coefficients of the quadratic equation a z^2 - b z + e = 0 for z.
    if implicit:
        a: Any = 1 + decay / 2
        b = 1 - decay / 2 + 1.5 * advance
        e = 0.5 * advance
    else:
        a = 1.0
        b = 1 + 1.5 * (advance - decay)
        e = 0.5 * (advance - decay)
    root = np.sqrt(b**2 - 4 * a * e)
    return float(np.max(np.maximum(np.abs(b + root), np.abs(b - root)) / (2 * a)))
