"""Diffusive terms whose coefficient varies: in space, or as a function of params, of scalars or of the shear rate.

    div(k (E u + W walls)) / rho,

with the slopes E, the divergence div, and the contribution W of the values on walls. For a velocity see
`viscous_stress`; for a scalar E is the gradient, and k on faces is the harmonic average of the cells. If the
coefficient is one number, the term is k (L u + B) / rho, with the Laplacian L, as in `diffusion`.

Implicit terms are advanced by the trapezoidal rule with k and rho at half the step:

    (2 rho / dt - div k E) u_next = 2 rho / dt u_explicit + div(k (E u + W (walls + walls_next))).

If k depends on the field, as a viscosity on the shear rate does, it is computed from the field u_half, which is
extrapolated to half the step from this and the previous one. The trapezoidal rule would then amplify short waves where
dt k is large and k increases with the slopes. Instead the term is computed from u + u_next - u_half, which is of second
order too:

    (rho / dt - div k E) u_next = rho / dt u_explicit + div(k (E (u - u_half) + W (walls + walls_next) / 2)).

Let r = (g / k) dk/dg for the shear rate g: -1 for a plastic fluid, 1 for Smagorinsky's model without other viscosity.
The amplification factors of a short wave tend to the roots of z^2 + z + (r - 1) (3/2 z - 1/2) = 0, which do not exceed
1 in absolute value for r from -1 to 1.

A batch of flows may have a coefficient for each of them, along the same leading axes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.pytree import mapped
from sparsedp._utils.validation import check_in_range, check_kind, check_on
from sparsedp.autodiff.program_trace import check_values, sample
from sparsedp.autodiff.tape import cast, dtype_of, isbox, real_dtype
from sparsedp.autodiff.tape_constants import frozen
from sparsedp.flow.diffusion import check_stable, implicit_step, spectral_bound
from sparsedp.flow.fluid_cells import FluidPart
from sparsedp.flow.settings import needs_fields
from sparsedp.solvers.parametric import EllipticSolver, elliptic_solver

if TYPE_CHECKING:
    from sparsedp.flow.settings import FlowSettings
    from sparsedp.operators.operator import Operator

__all__ = [
    "Coefficient",
    "DiffusionForm",
    "VariableDiffusion",
    "as_array",
    "in_precision_of",
    "is_constant",
    "solved_in_batch",
]


class DiffusionForm:
    """The factors of div(k (E u + W walls)).

    Attributes
    ----------
    slopes, wall_slopes : Operator
        E and W.
    divergence : Operator
    at_sites : callable
        ``at_sites(k)`` returns the coefficient where the slopes are, from one value for each cell.
    """

    slopes: Operator
    wall_slopes: Operator
    divergence: Operator
    at_sites: Callable[[Any], Any]

    def flux_divergence(self, k: Any, u: Any, walls: Any = None) -> Any:
        """Return div(k (E u + W walls)) for k on the sites; None as walls stands for 0."""
        slopes = self.slopes(u)
        if walls is not None:
            slopes = slopes + self.wall_slopes(cast(walls, dtype_of(u)))
        return self.divergence(k * slopes)

    @cached_property
    def solver(self) -> EllipticSolver:
        """The solver of (shift - div k E) u = b."""
        return elliptic_solver(self.divergence, self.slopes)

    def largest_row_sum(self, k: Any, density: Any) -> float:
        """Return an upper bound of the eigenvalues of div k E / density, for plain arrays or batches of them."""
        slopes = self._magnitudes[1](np.ones(self.slopes.domain.size))
        densities = np.asarray(density, float).reshape(-1, self.slopes.domain.size if np.ndim(density) else 1)
        coefficients = np.asarray(k, float).reshape(-1, slopes.size)
        largest = 0.0
        for entry in range(max(len(coefficients), len(densities))):
            flows = coefficients[entry % len(coefficients)] * slopes
            row_sums = self._magnitudes[0](flows) / densities[entry % len(densities)]
            largest = max(largest, float(np.max(row_sums, initial=0.0)))
        return largest

    @cached_property
    def _magnitudes(self) -> tuple[Any, Any]:
        return self.divergence.structure.magnitude(), self.slopes.structure.magnitude()


class Coefficient:
    """A coefficient of a flow: a number, one value for each cell, or a function that returns them.

    Parameters
    ----------
    name : str
        Name in error messages, such as "viscosity".
    coefficient : number, array or callable
        A function is called with the params, or with the fields and the params; see `needs_fields`.
    settings : FlowSettings
    needs : str
        The range of valid numbers: ">= 0" or "> 0".

    Attributes
    ----------
    fluid : FluidPart
        The cells whose values have an effect. Solid cells get the value of one of them.
    needs_fields : bool
        Whether it is a function of fields.
    """

    def __init__(self, name: str, coefficient: Any, settings: FlowSettings, needs: str) -> None:
        self.name = name
        self._cells = settings.grid.cells
        self._needs = needs
        self.fluid = FluidPart.of_cells(settings.grid, settings.solid)
        argument = name.split()[0]
        self.needs_fields = needs_fields(argument, coefficient, settings.fields_of(argument))
        if not callable(coefficient):
            coefficient = self._checked(coefficient)
        self._coefficient = coefficient

    def __call__(self, fields: Callable[[], tuple], params: Any, dtype: np.dtype, batch: tuple[int, ...] = ()) -> Any:
        """Return the coefficient, a number or one value for each cell.

        Parameters
        ----------
        fields : callable
            ``fields()`` returns the first arguments of a function of fields.
        params : tree
        dtype : dtype
            Dtype of the flow. The result of a function, and an array, have the same precision.
        batch : tuple of int
            The leading axes of the flow, which a function of fields may return too.
        """
        value = self._coefficient
        if callable(value):
            if self.needs_fields:
                value = value(*mapped(frozen, fields()), params)
            else:
                value = value(params)
            value = self._checked(value, batch)
        elif np.ndim(value) == 0:
            return value
        return cast(value, real_dtype(dtype))

    def _checked(self, value: Any, batch: tuple[int, ...] = ()) -> Any:
        """Return a valid value, with the values of solid cells replaced; raise an error for other values.

        Where there is no fluid, the value has no effect and is 1.
        """
        value = as_array(value)
        if np.shape(sample(value)) == ():
            check_values(self._check_range, value)
            return value
        if np.shape(sample(value)) != (*batch, *self._cells.shape):
            check_on(f"flow_step, as {self.name},", sample(value), self._cells, "; write one number for each cell")
        check_kind(f"{self.name} of flow_step", dtype_of(value), "real numbers", "; write its .real")
        check_values(self._check_range, value)
        if self.fluid.empty:
            return 1.0
        return self.fluid.filled(value)

    def _check_range(self, value: Any) -> None:
        """Raise an error for values in the fluid that are not finite, or out of range."""
        if np.ndim(value) > 0:
            value = self.fluid.with_ones(value)
        check_in_range(f"{self.name} of flow_step", value, self._needs)


def as_array(value: Any) -> Any:
    """Return a value that is neither traced nor a number as an array."""
    if isbox(value) or np.ndim(value) == 0:
        return value
    return np.asarray(value)


def in_precision_of(value: Any, dtype: np.dtype) -> Any:
    """Return a value of a user's function in the precision of a field; a complex value stays complex."""
    kind = dtype_of(value).kind
    if kind == "c":
        return cast(value, np.result_type(dtype, np.complex64))
    return cast(value, real_dtype(dtype))


def is_constant(coefficient: Any, settings: FlowSettings) -> bool:
    """Return whether a coefficient is one number, and the step length too, so that no operator ever changes."""
    return not callable(coefficient) and np.ndim(coefficient) == 0 and not callable(settings.dt)


class VariableDiffusion:
    """A term div(k (E u + W walls)) / rho of a flow step.

    Parameters
    ----------
    name : str
        Name of k in error messages.
    coefficient : number, array or callable
    settings : FlowSettings
    build_form : callable
        ``build_form()`` returns the DiffusionForm.
    build_laplacian : callable
        ``build_laplacian()`` returns L.

    Attributes
    ----------
    coefficient : Coefficient
    damping : float
        0: the damping is unknown before the step.
    """

    varies = True
    damping = 0.0

    def __init__(
        self,
        name: str,
        coefficient: Any,
        settings: FlowSettings,
        build_form: Callable[[], Any],
        build_laplacian: Callable[[], Operator],
    ) -> None:
        self.name = name
        self.coefficient = Coefficient(name, coefficient, settings, ">= 0")
        self.settings = settings
        self.implicit = settings.implicit
        self._build_form = build_form
        self._build_laplacian = build_laplacian

    @cached_property
    def form(self) -> Any:
        """The DiffusionForm, which is built at the first use."""
        return self._build_form()

    @cached_property
    def op(self) -> Operator:
        """The Laplacian L, which is built at the first use."""
        return self._build_laplacian()

    @cached_property
    def _spectral_bound(self) -> float:
        return spectral_bound(self.op)

    def add_explicit(
        self, rate: Any, u: Any, k: Any, wall_part: Callable[[], Any], walls: Callable[[], Any], density: Any, dt: Any
    ) -> Any:
        """Return the rate plus this term if the term is explicit; return the rate itself if it is implicit.

        Parameters
        ----------
        rate, u : array
        k : number or array on cells
        wall_part : callable
            ``wall_part()`` returns the contribution of walls to L u, or None if it is 0; it is called if k is a number.
        walls : callable
            ``walls()`` returns the values on walls, or None if they are 0; it is called if k is an array.
        density : array like u, or None
            None stands for 1.
        dt : number
        """
        if self.implicit:
            return rate
        if np.shape(sample(k)) == ():
            check_values(self._check_number, k, dt, 1.0 if density is None else density)
            part = wall_part()
            laplacian_of_u = self.op(u)
            if part is not None:
                laplacian_of_u = laplacian_of_u + part
            term = k * laplacian_of_u
        else:
            at_sites = cast(self.form.at_sites(k), dtype_of(k))
            check_values(self._check_field, k, at_sites, dt, 1.0 if density is None else density)
            term = self.form.flux_divergence(at_sites, u, walls())
        if density is not None:
            term = term / density
        return rate + term

    def step_implicit(
        self,
        explicit: Any,
        u: Any,
        k: Any,
        wall_part: Callable[[], Any],
        walls: Callable[[], Any],
        density: Any,
        dt: Any,
        middle: Any = None,
    ) -> Any:
        """Return the field at the end of the step.

        Parameters
        ----------
        explicit : array
            The field after the step with all terms except this one.
        u : array
            The field at the beginning of the step.
        k : number or array on cells
        wall_part : callable
            ``wall_part()`` returns the sum of the contributions of walls to L u at the beginning and at the end of the
            step, or None if it is 0; it is called if k is a number.
        walls : callable
            ``walls()`` returns the sum of the values on walls at the beginning and at the end of the step, or None if
            they are 0; it is called if k is an array.
        density : array like u, or None
        dt : number
        middle : array or None
            The field from which k was computed, extrapolated to half the step; None if k does not depend on it.
        """
        if middle is None:
            step = 0.5 * dt
            share_of_walls = 1.0
        else:
            step = dt
            share_of_walls = 0.5
            u = u - middle
        if np.shape(sample(k)) == ():
            number = k
            k = self.form.at_sites(k * np.ones(self.settings.grid.shape, dtype_of(u)))
            change = self.form.flux_divergence(k, u)
            part = wall_part()
            if part is not None:
                change = change + share_of_walls * (number * part)
        else:
            k = self.form.at_sites(k)
            at_walls = walls()
            if at_walls is not None:
                at_walls = share_of_walls * at_walls
            change = self.form.flux_divergence(k, u, at_walls)
        if density is not None:
            step = step / density
        solve = partial(self._solve, k, 1.0 / step)
        return implicit_step(explicit, cast(change, dtype_of(u)), step, solve)

    def _solve(self, k: Any, shift: Any, b: Any) -> Any:
        """Return w of (I - div k E / shift) w = b."""
        return solved_in_batch(self.form.solver, k, shift * b, shift)

    def _check_number(self, k: Any, dt: Any, density: Any) -> None:
        """Raise UnstableStepError if the explicit term is unstable for one number as coefficient."""
        rate = float(k) * self._spectral_bound / float(np.min(density, initial=np.inf))
        check_stable(self.name, float(k), dt, rate, self.settings)

    def _check_field(self, k: Any, at_sites: Any, dt: Any, density: Any) -> None:
        """Raise UnstableStepError if the explicit term is unstable for a coefficient that varies in space."""
        if self.settings.strict:
            rate = self.form.largest_row_sum(at_sites, density)
            check_stable(f"the largest {self.name}", float(np.max(k, initial=0.0)), dt, rate, self.settings)


def solved_in_batch(solver: EllipticSolver, k: Any, b: Any, shift: Any = 0.0) -> Any:
    """Return ``solver(k, b, shift)`` for arguments with any number of leading axes, which an EllipticSolver has one of.

    Parameters
    ----------
    solver : EllipticSolver
    k, shift : array
        With the leading axes of b, or without.
    b : array
    """
    k_shape = solver.D.domain.shape
    shape = solver.D.codomain.shape
    batch = np.shape(b)[: np.ndim(b) - len(shape)]
    if len(batch) < 2:
        return solver(k, b, shift)
    if np.ndim(k) > len(k_shape):
        k = anp.reshape(k, (-1, *k_shape))
    if np.ndim(shift) > len(shape):
        shift = anp.reshape(shift, (-1, *shape))
    return anp.reshape(solver(k, anp.reshape(b, (-1, *shape)), shift), (*batch, *shape))
