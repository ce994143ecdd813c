"""Radau IIA of order 5 with error control for small stiff systems, with dense matrices.

An interval with all its steps is one rule on the tape. A step of length h from u has three stages, with
f_i = f(u + z_i, t + c_i h) and c_3 = 1,

    z_i = h sum_j a_ij f_j,          and the new state is u + z_3.

The method is L-stable: stiff components decay for any h. The order is 5 for smooth problems and at least 3 for stiff
problems with time-dependent data, where Rosenbrock methods such as Rodas have a lower order. The discrete adjoint needs
only first derivatives of f, while the derivative of a Rosenbrock step needs derivatives of the Jacobian. Newton's
method uses one Jacobian J of f for all stages, and for further steps as long as it converges with this J. In the basis
of the eigenvectors of A^-1 its linear system of 3 n unknowns splits into a real and a complex system of n unknowns
each. The error of a step is estimated by an embedded formula of order 3, multiplied by the inverse of the real matrix,

    e = (g/h - J)^-1 (f(u, t) + sum_i e_i z_i / h),          g the real eigenvalue of A^-1.

If e is too large in a second trial from the same state, e is computed again with f(u + e, t) in place of f(u, t).
Otherwise an error in u, which decays in a step of any length, would make e too large until h is very small: for
u' = -1e6 (u - cos t) 72 successive trials were rejected. Step lengths are chosen as in adaptive.py.

Derivatives are those of the accepted steps. They are computed by the implicit function theorem for each step, not by
differentiation of Newton's iterations. Let J_i, P_i, q_i be the derivatives of f_i with respect to the state, the
params and the time. Then

    K dz = h A (J_i du + P_i dp + q_i (dt + c_i dh)) + z/h dh,          K = 1 - h A J_i   (3 n unknowns),

and the backward pass is the transpose of this map. Step lengths and perturbed solutions are those of embedded.py.

For derivatives of higher order the tape records each step separately. Its stages are the known values z*, improved by
iterations of Newton's method with the constant matrix K*,

    z <- z - K*^-1 (r(z) - r*),          r(z) = z - h A f(u + z),

where r* is the value of r(z), a constant. The value of z does not change, and each iteration makes the derivatives of
one more order exact.

References
----------
E. Hairer, G. Wanner, Solving Ordinary Differential Equations II (1996), IV.8.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.pytree import leaves
from sparsedp._utils.validation import check_shape
from sparsedp.autodiff.tape import linear, plain, traces_of
from sparsedp.errors import ConvergenceError
from sparsedp.integrators.adaptive import (
    WEIGHT_REDUCTIONS,
    AcceptedStep,
    FlatDeviation,
)
from sparsedp.integrators.embedded import EVALUATION_ERRORS, Embedded, RecordedStep, norm
from sparsedp.integrators.jacobians import jacobians_of
from sparsedp.integrators.problem import SidedParams, without_side
from sparsedp.integrators.runge_kutta import as_matrix
from sparsedp.solvers.direct import dense_lu

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from sparsedp.integrators.discontinuities import RateInspector
    from sparsedp.integrators.events import Event
    from sparsedp.integrators.problem import Problem
    from sparsedp.solvers.choose_method import SolveSettings

__all__ = ["Radau"]

ROOT = 6**0.5
C = np.array([(4 - ROOT) / 10, (4 + ROOT) / 10, 1.0])
POWERS = np.arange(3)
A = (C[:, None] ** (POWERS + 1) / (POWERS + 1)) @ np.linalg.inv(C[:, None] ** POWERS)  # collocation at the nodes
E = np.array([-13 - 7 * ROOT, -13 + 7 * ROOT, -1]) / 3  # e_i of the embedded formula
_values, _vectors = np.linalg.eig(np.linalg.inv(A))
_real = np.argmin(np.abs(_values.imag))
_upper = np.argmax(_values.imag)
# Eigenvalues of A^-1, and its eigenvectors in real form.
REAL = float(_values[_real].real)
COMPLEX = complex(_values[_upper].conj())
BASIS = np.array([_vectors[:, _real].real, _vectors[:, _upper].real, _vectors[:, _upper].imag]).T
BASIS_INVERSE = np.linalg.inv(BASIS)
CUBIC = np.linalg.inv(np.vander([0.0, *C], increasing=True))  # values at 0, c_1, c_2, c_3 -> coefficients

UNKNOWNS = 500  # largest number of unknowns; for larger systems sparse solves are faster
EMBEDDED = 3  # order of the embedded formula
NEWTON = 1e-3  # error of Newton's method in units of the tolerance; 0.03 made HIRES 10 to 100 times less accurate
ROUNDING = 1e-15  # smallest tolerance of the relative correction in Newton's method
STALLED = 1e-11  # a relative correction below this that does not decrease any more is regarded as rounding
ITERATIONS = 10  # largest number of iterations of Newton's method in a step with error control
BATCH_STEPS = 32  # largest number of steps whose derivatives are computed in one batch
ENTRIES = 2**20  # largest number of entries of an array in such a batch
FAST = 0.03  # keep the Jacobian for the next step if the ratio of successive corrections is below this


class Radau(Embedded):
    """Steps of Radau IIA, for states that are trees of real arrays with few entries, and their derivatives.

    Parameters
    ----------
    problem : Problem
    jacobian : callable or None
        Used in Newton's method only; derivatives are computed from the rate.
    tolerance : float or None
        See `Adaptive`; None: one step without error control.
    floor : None, number, or tree like the state
        See `Adaptive`.
    settings : SolveSettings
        Its rtol and maxiter are those of Newton's method without error control.

    Attributes
    ----------
    v : flat array or None
        The state at the start of the step.
    f : flat array
        The rate at `v`.
    J : array or None
        The current Jacobian.
    factored_length : float or None
        The step length for which the matrices of Newton's method are factored.
    real, complex : callable
        Solve with the factored real and complex matrix.
    guess : tuple or None
        State, length and interpolating cubic of the last step, to extrapolate a first guess of the stages.
    is_fresh, is_slow : bool
        Whether the Jacobian was computed at the current state, and whether Newton's method was slow in the last step.
    """

    largest_size = UNKNOWNS
    quadrature = tuple(C), tuple(A[2])
    v: Any = None
    J: Any = None
    factored_length: Any = None
    guess: Any = None
    is_fresh = False
    is_slow = False

    def __init__(
        self,
        problem: Problem,
        jacobian: Callable | None,
        tolerance: Any,
        floor: Any,
        settings: SolveSettings,
        max_step: float | None = None,
    ) -> None:
        super().__init__(problem, "radau", 5, EMBEDDED, tolerance, floor, max_step)
        self.user_jacobian = jacobian
        if tolerance:
            self.newton_tolerance = NEWTON * tolerance
        else:
            self.newton_tolerance = settings.rtol
        if tolerance:
            self.max_iterations = ITERATIONS
        else:
            self.max_iterations = settings.maxiter or 50

    def partial_step(self, step: AcceptedStep, arguments: tuple, length: float) -> AcceptedStep | None:
        """Repeat a step with another length, with stages converged to rounding; return None if the trial fails."""
        newton_tolerance = self.newton_tolerance
        max_iterations = self.max_iterations
        self.newton_tolerance = ROUNDING
        self.max_iterations = 2 * ITERATIONS
        try:
            return super().partial_step(step, (arguments[0], self.params, *arguments[2:]), length)
        finally:
            self.newton_tolerance = newton_tolerance
            self.max_iterations = max_iterations

    def inner_state(self, step: AcceptedStep) -> tuple[Any, float]:
        """Return the state at the second stage, and its position as a fraction of the step."""
        return step.u + step.middle[1], C[1]

    def _steps(
        self, v: Any, params: Any, t: Any, h: Any, inspector: RateInspector | None = None
    ) -> Iterable[AcceptedStep]:
        if self.tolerance is not None:
            return super()._steps(v, self.params, t, h, inspector)
        self._first_length(v, self.params, t, h)  # raise an error for a rate that is not finite
        with np.errstate(all="ignore"):
            z = self.stages(v, t, h)
        if z is None:
            raise ConvergenceError(
                f"{self.name}: Newton's method does not converge in a step of {h:.3g}; "
                "take a smaller dt, or give stepper a tolerance"
            )
        return [AcceptedStep(1.0, 0.0, v, z, v + z[2])]

    def _trial(
        self, v: Any, params: Any, t: Any, length: float, h: Any, inspector: RateInspector | None = None
    ) -> tuple[Any, Any, float]:
        """Return the stages, the new state, and the error of the embedded formula in units of the tolerance."""
        h = length * h
        is_second_trial = v is self.v
        with np.errstate(all="ignore"):  # overflow in a step that is too long leads to its rejection
            z = self.stages(v, t, h)
            if z is None:
                return None, None, np.inf
            units = self.units(v, v + z[2]) * self.tolerance
            e = E @ z / h
            error = self.real(self.f + e, False)
            if is_second_trial and norm(error / units) > 1:
                try:
                    error = self.real(self.problem(v + error, params, t) + e, False)
                except EVALUATION_ERRORS:
                    pass  # the step is too long
            ratio = norm(error / units)
        return z, v + z[2], ratio if np.isfinite(ratio) else np.inf

    # ------------------------------------------------------------ Newton's method

    def stages(self, v: Any, t: Any, h: Any) -> np.ndarray | None:
        """Return the stages z of a step, or None if Newton's method does not converge."""
        try:
            if v is not self.v:
                self.f = self.problem(v, self.params, t)
                self.v = v
                self.is_fresh = False
                if self.is_slow:
                    self.J = None
            if self.J is not None:
                z = self._newton(v, t, h)
            else:
                z = None
            if z is None and not self.is_fresh:
                self.is_fresh = True
                self.factored_length = None
                self.J = self.jacobian(v, t)
                z = self._newton(v, t, h)
        except EVALUATION_ERRORS:
            return None
        if z is not None:
            self.guess = v, h, CUBIC @ np.vstack([v, v + z])
        return z

    def jacobian(self, v: Any, t: Any) -> np.ndarray:
        """Return df/du for Newton's method."""
        n = self.problem.size
        if self.user_jacobian is None:
            return self.problem.rows([(v, t)], self.params, [False] * len(self.moving))[1][0, :, :n]
        u = self.problem.state(v)
        if type(self.params) is SidedParams:
            u, t = self.params.side.inside(u, self.params.params, t)
        arguments = (u, without_side(self.params), t)
        J = as_matrix(self.user_jacobian(*arguments[: 2 + self.problem.timed])).toarray()
        check_shape(f"the jacobian of {self.name}", J, (n, n))
        return J

    def _newton(self, v: Any, t: Any, h: Any) -> np.ndarray | None:
        """Run Newton's method for the stages with the current Jacobian; return None if it does not converge."""
        h = float(h)  # complex division is rounded differently in Python and in NumPy
        if self.factored_length != h:
            self.real = dense_lu(REAL / h * np.eye(v.size) - self.J)[0]
            self.complex = dense_lu(COMPLEX / h * np.eye(v.size) - self.J)[0]
            self.factored_length = h
        z = np.zeros((3, v.size))
        if self.guess is not None:  # extrapolate the cubic through the last stages, also in a second trial
            start, length, cubic = self.guess
            z = np.vander(C * h / length + (start is not v), 4, increasing=True) @ cubic - v
        w = BASIS_INVERSE @ z
        last = 0.0  # size of the last correction
        ratio = 0.0
        for iteration in range(1, self.max_iterations + 1):
            rates = [self.problem(v + part, self.params, t + c * h) for part, c in zip(z, C, strict=True)]
            f = BASIS_INVERSE @ np.array(rates)
            one = self.real(f[0] - REAL / h * w[0], False)
            pair = self.complex(f[1] + 1j * f[2] - COMPLEX / h * (w[1] + 1j * w[2]), False)
            correction = np.array([one, pair.real, pair.imag])
            w = w + correction
            correction = BASIS @ correction
            z = z + correction
            if iteration == 1:
                size = self.units(v, v + z[2])
            moved = norm(correction / size)
            if last:
                ratio = moved / last
            else:
                ratio = 0.0
            if ratio < 1:
                error = moved * ratio / (1 - ratio)
            else:
                error = np.inf
            if moved == 0.0 or (last and error <= max(self.newton_tolerance, ROUNDING)):
                break
            rest = self.max_iterations - iteration
            if not (np.isfinite(error) and ratio ** (rest - 1) * error <= self.newton_tolerance):
                if moved <= STALLED:
                    return z
                return None
            last = moved
        self.is_slow = ratio > FAST and iteration > 2
        return z

    # ------------------------------------------------------------ the derivative of the accepted steps

    def _deviations_at_end(
        self,
        path: list,
        arguments: tuple,
        start: FlatDeviation,
        end: FlatDeviation,
        initial_deviations: Any,
        event: Event | None = None,
    ) -> Any:
        """Return the deviations at the end, a linear map of the initial deviations of (u, moving params, t, h).

        The vectors inside this function also contain the sum of all d so far, between u and the params. If an event
        ends the path, the deviation of its time is the deviation of t plus the sum of all d.
        """
        if len(traces_of([initial_deviations])) > 1:
            return self._recorded_deviations(path, arguments, start, end, initial_deviations, event)
        *_, t, h = arguments
        n = self.problem.size
        error_weights = np.array(WEIGHT_REDUCTIONS[: len(initial_deviations)])
        end_units = np.concatenate([*map(np.ravel, end.units)])
        start_units = np.concatenate([*map(np.ravel, start.units)])
        n_together = int(np.clip(ENTRIES / (9 * n * start_units.size), 1, BATCH_STEPS))
        groups = [path[first : first + n_together] for first in range(0, len(path), n_together)]

        def tangent(x: np.ndarray) -> np.ndarray:
            """Return the tangents at the end for tangents at the start, both divided by the units of deviations."""
            y = np.insert(x * start_units, n, 0.0, axis=1).T
            if x.any():  # the value that the tape records is 0 and needs no work
                for group in groups:
                    for step, correction in self._linearised(group, path[-1], t, h, event):
                        y[: n + 1] = step @ y + error_weights * (correction @ y)
            if event:
                y[n] += y[-2]  # its time: the start, and all d
            return y[: end_units.size].T / end_units

        def cotangent(g: np.ndarray) -> np.ndarray:
            """Apply the transpose."""
            y = np.zeros((start_units.size + 1, len(g)))
            y[: end_units.size] = (g / end_units).T
            if event:
                of_time = y[n].copy()
            else:
                of_time = 0.0
            for group in reversed(groups):
                for step, correction in self._linearised(group, path[-1], t, h, event)[::-1]:
                    head = y[: n + 1].copy()
                    y[: n + 1] = 0.0
                    y += step.T @ head + correction.T @ (error_weights * head)
            y[-2] += of_time
            return np.delete(y, n, 0).T * start_units

        return linear(f"{self.name}.steps", tangent, cotangent)[0](initial_deviations)

    def _linearised(
        self, steps: list[AcceptedStep], end: AcceptedStep, t: float, h: float, event: Event | None
    ) -> np.ndarray:
        """Return the Jacobians of (u, sum of all d) after each step, and the corrections of the perturbed solution.

        Parameters
        ----------
        steps : list of AcceptedStep
        end : AcceptedStep
            The last step of the interval.
        t, h : float
            Start and length of the interval.
        event : Event or None
            The event that ends the interval.

        Returns
        -------
        array, shape (number of steps, 2, n + 1, k)
            For each step the Jacobian (index 0) and, for the first perturbed solution, its change per unit of
            `WEIGHT_REDUCTIONS` (index 1), with respect to the k entries of (u, sum of all d, moving params, t, h)
            before the step.
        """
        n = self.problem.size
        m = len(steps)
        one = np.eye(n)
        length, done, u, z, new = (np.array(part) for part in zip(*steps, strict=True))
        places = [(u, done), (new[-1:], done[-1:] + length[-1:])]
        places += [(u + z[:, i], done + C[i] * length) for i in (0, 1)]
        states, shares = (np.concatenate(part) for part in zip(*places, strict=True))
        points = [*zip(states, t + shares * h, strict=True)]
        rates, rows = self.problem.rows(points, self.params, self.moving)
        # The points are the starts of the steps, the end of the last step, the first stages, and the second stages.
        first = rows[:m]
        rows = np.stack([rows[m + 1 : -m], rows[-m:], rows[1 : m + 1]], 1)
        is_last = np.array([step is end for step in steps])
        sections = [self.section(*row)[0][0] for row in zip(u, rates[:m, None], length * h)]
        section = np.where(is_last[:, None], 0.0, sections)
        if event:
            gives_back = np.zeros(m, bool)
        else:
            gives_back = is_last
        lengths = (length * h)[:, None, None]
        length = length[:, None, None]
        done = done[:, None, None]
        last = gives_back[:, None, None]
        hA = lengths * A
        K = np.eye(3 * n) - np.einsum("sab,sbij->saibj", hA, rows[..., :n]).reshape(m, 3 * n, 3 * n)
        by_input = np.einsum("sab,sbij->saij", hA, rows)
        by_length = z / lengths + (hA * C) @ rows[..., -1]
        b = np.concatenate([by_input, by_length[..., None]], -1)
        dz = solved(K, b.reshape(m, 3 * n, -1)).reshape(b.shape)
        error = (
            np.concatenate([first, -np.swapaxes(E[None] @ z / lengths / lengths, 1, 2)], 2)
            + np.tensordot(E, dz, (0, 1)) / lengths
        )
        M = np.stack([dz[:, 2] + np.eye(n, b.shape[-1]), solved(REAL / lengths * one - first[..., :n], error)], 1)
        stretch = M[..., -1].copy()  # derivative of the new state with respect to the step length
        M[..., -1] = done * M[..., -2] + length * stretch
        M = np.insert(M, n, M[..., -2] - last * stretch, axis=3)  # the last step subtracts the sum of all d
        M[..., :n] += stretch[..., None] * section[:, None, None]
        shift = np.zeros((m, 2, 1, M.shape[3]))
        shift[:, 0, 0, : n + 1] = np.insert(section, n, ~gives_back, axis=1)
        if event and is_last[-1]:
            start = t + end.done * h
            self._end_at_event(event, end, start, end.length * h, M[-1], shift[-1, :, 0], stretch[-1])
        return np.concatenate([M, shift], 2)

    def _end_at_event(
        self,
        event: Event,
        step: AcceptedStep,
        t: float,
        length: float,
        M: np.ndarray,
        shift: np.ndarray,
        stretch: np.ndarray,
    ) -> None:
        """Determine d of the last step from the condition that the event function stays 0; update `M` and `shift`.

        With the new state M x + stretch d and the time S + t + d, where S is the sum of all earlier d,

            d = -(g_u M x + g_p p + g_t (S + t)) / (g_u stretch + g_t).
        """
        n = self.problem.size
        params = without_side(self.params)
        point = self.problem.state(step.new), params, t + length
        moving = [*[True] * len(self.problem.unknowns.shapes), *self.moving[: len(leaves(params))], True]
        _, rows = jacobians_of(lambda point: event.value(point[0], without_side(point[1]), point[2]), [point], moving)
        of_state, of_params, of_time = np.split(rows[0, 0], [n, rows.shape[2] - 1])
        change = float(of_state @ stretch[0] + of_time[0])
        self._check_transversal(event, step, (None, self.params, t), change, length)
        constant_part = np.zeros(M.shape[2])
        constant_part[n + 1 : -2] = of_params
        constant_part[[n, -2]] = of_time[0]
        first = -(of_state @ M[0] + constant_part) / change
        M[0] += np.outer(stretch[0], first)
        M[1] += np.outer(stretch[1], first)
        second = -(of_state @ M[1]) / change
        M[1] += np.outer(stretch[0], second)
        shift[0] += first
        shift[1] += second

    # ------------------------------------------------------------ derivatives of higher order

    def record(self, step: AcceptedStep, t: float, h: float) -> _RecordedStep:
        """Return the record of an accepted step: see `Embedded`."""
        return _RecordedStep(self, step, t, h)


class _RecordedStep(RecordedStep):
    """Records an accepted step on the tape: see `RecordedStep`."""

    def __init__(self, parent: Radau, step: AcceptedStep, t: float, h: float) -> None:
        super().__init__(parent, step, t, h)
        n = parent.problem.size
        start = t + step.done * h
        length = step.length * h
        stages = zip(step.u + step.middle, start + C * length, strict=True)
        fixed = [False] * len(parent.moving)
        rates, rows = parent.problem.rows([(step.u, start), *stages], parent.params, fixed)
        jacobians = rows[..., :n]
        K = np.eye(3 * n) - np.einsum("ab,bij->aibj", length * A, jacobians[1:]).reshape(3 * n, 3 * n)
        self._stage_solve = _constant_solve(f"{parent.name}.stages", K)
        self._error_solve = _constant_solve(f"{parent.name}.error", REAL / length * np.eye(n) - jacobians[0])
        self.section = parent.section(step.u, rates[:1], length)[0][0]

    def stages(self, v: Any, params: Any, t: Any, h: Any) -> Any:
        """Return the stages of the step: see `RecordedStep`."""
        problem = self.parent.problem
        z: Any = self.step.middle
        for _ in traces_of([v, *leaves(params), t, h]):
            rates = anp.array([problem(v + z[i], params, t + C[i] * h) for i in range(3)])
            residual = z - h * anp.dot(A, rates)
            residual = anp.ravel(residual - plain(residual))
            z = z - anp.reshape(self._stage_solve(residual), z.shape)
        return z

    def new_state(self, v: Any, stages: Any) -> Any:
        """Return the state after the step: see `RecordedStep`."""
        return v + stages[2]

    def embedded_error(self, v: Any, params: Any, t: Any, h: Any, stages: Any) -> Any:
        """Return the error of the embedded formula: see `RecordedStep`."""
        return self._error_solve(self.parent.problem(v, params, t) + anp.dot(E, stages) / h)


def _constant_solve(name: str, matrix: np.ndarray) -> Callable:
    """Return the rule that solves a system with a constant matrix."""
    solve = dense_lu(matrix)[0]
    return linear(name, lambda b: solve(b, False), lambda g: solve(g, True))[0]


def solved(matrices: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Solve a linear system with several right-hand sides for each matrix."""
    return np.array([dense_lu(matrix)[0](part, False) for matrix, part in zip(matrices, b, strict=True)])
