"""Rodas5P: a Rosenbrock method of order 5 with error control, for stiff systems with sparse Jacobians.

A step of length h from u has eight stages U_i. With the Jacobian J of the rate f at (u, t) and W = 1/(g h) - J,

    W U_i = f(u + sum_j a_ij U_j, t + c_i h) + sum_j C_ij U_j / h + d_i h f_t,      the new state is u + sum_i b_i U_i,

where the sums run over j < i and f_t is the derivative of f with respect to the time at (u, t). There is no iteration:
a step takes one Jacobian, one factorisation of W and eight solves with it. The method is L-stable and stiffly accurate:
the last three stages are evaluated at the end of the step, and stiff components decay for any h. It has order 5.
For u' = -k (u - s(t)) + s'(t) with a large k (Prothero and Robinson) the error is of the size h^3 / k, where the error
of many Rosenbrock methods does not fall with k. The last stage U_8 is the difference to a formula of order 4, and
estimates the error.
J is assembled from products with a colouring of its sparsity pattern, and solvers/jacobian.py chooses the solver.

Derivatives are those of the accepted steps. With the adjoint y_i of a stage, W^T y_i = g_i, the contribution of the
stage to the gradient is

    y_i . d f(u + sum_j a_ij U_j, t + c_i h) + d h d_i y_i . f_t + y_i . (dJ) U_i + ...,

so that the derivative of J is applied to a pair of vectors, by a second derivative of f. The adjoints of all stages
take one factorisation: the one of the forward step, or a new one if too many steps lie between. One recording of each
rate serves the solution and both perturbed solutions of embedded.py.

References
----------
G. Steinebach, Construction of Rosenbrock-Wanner method Rodas5P and numerical benchmarks within the Julia Differential
Equations package, BIT Numerical Mathematics 63:27 (2023). E. Hairer, G. Wanner, Solving Ordinary Differential Equations
II (1996), IV.7.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from math import prod
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from sparsedp._utils.pytree import leaves
from sparsedp.autodiff.derivative import push, taped
from sparsedp.autodiff.tape import linear, traces_of
from sparsedp.errors import ConvergenceError
from sparsedp.integrators.adaptive import WEIGHT_REDUCTIONS, AcceptedStep, FlatDeviation
from sparsedp.integrators.embedded import EVALUATION_ERRORS, Embedded, RecordedStep, norm
from sparsedp.integrators.problem import SidedParams, combine, without_side
from sparsedp.integrators.runge_kutta import as_matrix
from sparsedp.solvers.adjoint import solve_rule
from sparsedp.solvers.cache import Cache
from sparsedp.solvers.jacobian import Jacobians
from sparsedp.solvers.newton import Equation
from sparsedp.solvers.records import SolveLog
from sparsedp.solvers.roots import negative_gradient, product_with
from sparsedp.solvers.scaling import length

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from sparsedp.integrators.discontinuities import RateInspector
    from sparsedp.integrators.events import Event
    from sparsedp.integrators.problem import Problem
    from sparsedp.solvers.choose_method import SolveSettings
    from sparsedp.solvers.jacobian import Linearisation

__all__ = ["Rosenbrock"]

# The coefficients of Rodas5P.
GAMMA = 0.21193756319429014
SIXTH = (-7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256, 0.030198172008377946)
A = (
    (),
    (3.0,),
    (2.849394379747939, 0.45842242204463923),
    (-6.954028509809101, 2.489845061869568, -10.358996098473584),
    (2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641),
    SIXTH,
    (*SIXTH, 1.0),
    (*SIXTH, 1.0, 1.0),
)
B = (*SIXTH, 1.0, 1.0, 1.0)
C = (
    (),
    (-14.155112264123755,),
    (-17.97296035885952, -2.859693295451294),
    (147.12150275711716, -1.41221402718213, 71.68940251302358),
    (165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306),
    (24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125, -0.6610691825249471),
    (
        30.91273214028599,
        -3.1208243349937974,
        77.79954646070892,
        34.28646028294783,
        -19.097331116725623,
        -28.087943162872662,
    ),
    (
        37.80277123390563,
        -3.2571969029072276,
        112.26918849496327,
        66.9347231244047,
        -40.06618937091002,
        -54.66780262877968,
        -9.48861652309627,
    ),
)
NODES = (0.0, 0.6358126895828704, 0.4095798393397535, 0.9769306725060716, 0.4288403609558664, 1.0, 1.0, 1.0)
D = (GAMMA, -0.42387512638858027, -0.3384627126235924, 1.8046452872882734, 2.325825639765069, 0.0, 0.0, 0.0)
# Continuous output: with k = DENSE U, u(s) = (1 - s) u_0 + s (u_1 + (1 - s) (k_1 + s (k_2 + s k_3))).
DENSE = np.array(
    [
        [
            25.948786856663858,
            -2.5579724845846235,
            10.433815404888879,
            -2.3679251022685204,
            0.524948541321073,
            1.1241088310450404,
            0.4272876194431874,
            -0.17202221070155493,
        ],
        [
            -9.91568850695171,
            -0.9689944594115154,
            3.0438037242978453,
            -24.495224566215796,
            20.176138334709044,
            15.98066361424651,
            -6.789040303419874,
            -6.710236069923372,
        ],
        [
            11.419903575922262,
            2.8879645146136994,
            72.92137995996029,
            80.12511834622643,
            -52.072871366152654,
            -59.78993625266729,
            -0.15582684282751913,
            4.883087185713722,
        ],
    ]
)
EMBEDDED = 4  # order of the embedded formula
# Factorisations of the last steps are kept for the backward pass, up to this number of bytes by an estimate.
KEPT_BYTES = 2**29
LARGEST_AMPLIFICATION = 1e2  # by (g h W)^-1 of a first stage; without growth it is at most 1 in a suitable norm
BYTES = 320  # of the factors, for each entry of W: 12 in each of 20 to 30 entries on square grids


def _quadrature() -> tuple[tuple, tuple]:
    """Return nodes and weights of the formula that a step is for a rate that depends on the time only."""
    lower = np.zeros((8, 8))
    for i, row in enumerate(C):
        lower[i, : len(row)] = row
    weights = np.linalg.solve((np.eye(8) / GAMMA - lower).T, B)
    return (*NODES[:5], 1.0), (*weights[:5], np.sum(weights[5:]))


class Rosenbrock(Embedded):
    """Steps of Rodas5P, for states that are trees of real arrays, and their derivatives.

    Parameters
    ----------
    problem : Problem
    jacobian : callable or None
        ``jacobian(u, params)`` or ``jacobian(u, params, t)``: df/du, which must be exact.
    tolerance : float or None
        See `Adaptive`; None: one step without error control.
    floor : None, number, or tree like the state
        See `Adaptive`.
    settings : SolveSettings
        Of the linear solves; the option `sparsity` is the pattern of df/du.
    max_step : float, optional

    Attributes
    ----------
    equation : Equation
        W x - f, whose Jacobian is W, with the parameters (h, params, t). Of one interval.
    kept : Cache
        Jacobians of the last steps, with their factors. Of one interval.
    keeps_factors : bool
        Whether a backward pass will need them.
    """

    quadrature = _quadrature()
    # Estimates of the errors of derivatives were 10 to 30 times the errors, in reactions on grids.
    overestimate = 3.0
    equation: Any
    kept: Any
    keeps_factors = False

    def __init__(
        self,
        problem: Problem,
        jacobian: Callable | None,
        tolerance: Any,
        floor: Any,
        settings: SolveSettings,
        max_step: float | None = None,
    ) -> None:
        super().__init__(problem, "rodas5p", 5, EMBEDDED, tolerance, floor, max_step)
        self.info = SolveLog()
        options = {word: value for word, value in settings.options.items() if word != "sparsity"}
        of_residual = None
        if jacobian is not None:
            of_residual = partial(_residual_jacobian, jacobian, bool(problem.timed))
        sparsity = settings.options.get("sparsity")
        self.jacobians = Jacobians(self.name, of_residual, sparsity, replace(settings, options=options))

    def interval(self, u: Any, params: Any, t: Any, h: Any) -> tuple[Any, tuple]:
        """Return a copy of this object for one time interval: see `Embedded`."""
        run, arguments = super().interval(u, params, t, h)
        problem = run.problem.problem

        def residual(x: Any, h: Any, params: Any, t: Any) -> Any:
            rate = problem(x, params, t)
            return combine(x, (1.0 / (GAMMA * h) - 1.0, x), (-1.0, rate))

        run.kept = Cache(1)
        run.equation = Equation(residual, run.problem.unknowns, (1.0, run.params, 0.0), self.name)
        return run, arguments

    # ------------------------------------------------------------ steps

    def steps_over(
        self, arguments: tuple, keeps_all: bool, detector: Any = None
    ) -> tuple[list[AcceptedStep], Event | None, list[float]]:
        """Run the steps over an interval: see `Adaptive`."""
        self.keeps_factors = keeps_all
        return super().steps_over(arguments, keeps_all, detector)

    def _steps(
        self, v: Any, params: Any, t: Any, h: Any, inspector: RateInspector | None = None
    ) -> Iterable[AcceptedStep]:
        if self.tolerance is not None:
            return super()._steps(v, self.params, t, h, inspector)
        self._first_length(v, self.params, t, h)  # raise an error for a rate that is not finite
        with np.errstate(all="ignore"):
            stages = self.stages(v, self.params, t, h)
            self._check_regular(stages[0], v, t, h)
        return [AcceptedStep(1.0, 0.0, v, np.array(stages), combined(v, B, stages))]

    def _check_regular(self, stage, v, t, h):
        """Raise ConvergenceError if W is nearly singular, for a step whose error is not estimated.

        Each stage is divided by the distance of g h J from the eigenvalue 1; a step multiplies by its seventh power.
        """
        variables = self.equation.variables((h, self.params, t))
        amplified = self._solved(False, stage / (GAMMA * h), self.equation, v, variables)
        if not length(amplified) <= LARGEST_AMPLIFICATION * length(stage):
            raise self._singular()

    def _singular(self):
        return ConvergenceError(
            f"{self.name}: the matrix of a step is singular or nearly so, as the Jacobian of the rate has an "
            "eigenvalue near 1 / (0.212 dt); take a smaller dt, or give stepper a tolerance"
        )

    def _trial(
        self, v: Any, params: Any, t: Any, length: float, h: Any, inspector: RateInspector | None = None
    ) -> tuple[Any, Any, float]:
        """Return the stages, the new state, and the error of the embedded formula in units of the tolerance."""
        try:
            with np.errstate(all="ignore"):  # overflow in a step that is too long leads to its rejection
                stages = self.stages(v, self.params, t, length * h)
                new = combined(v, B, stages)
                ratio = norm(stages[-1] / self.units(v, new)) / self.tolerance
        except EVALUATION_ERRORS:
            return None, None, np.inf
        return np.array(stages), new, ratio if np.isfinite(ratio) else np.inf

    def inner_state(self, step: AcceptedStep) -> tuple[Any, float]:
        """Return the state in the middle of a step, by the continuous output."""
        first, second, third = DENSE @ step.middle
        return 0.5 * (step.u + step.new) + 0.25 * (first + 0.5 * (second + 0.5 * third)), 0.5

    def stages(self, v: Any, params: Any, t: Any, h: Any, solutions: np.ndarray | None = None) -> list:
        """Return the stages of a step, as functions of all arguments.

        Parameters
        ----------
        v, params, t, h : traced or not
        solutions : array, shape (8, n), optional
            The values of the stages.
        """
        variables = self.equation.variables((h, params, t))
        slope: Any = None  # of the rate, with respect to the time
        if self.takes_time:
            slope = push(lambda time: self.problem(v, params, time), t, [1.0])[1]
        stages: list = []
        for i in range(len(B)):
            b = self.problem(combined(v, A[i], stages), params, t + NODES[i] * h)
            b = combined(b, [weight / h for weight in C[i]], stages)
            if slope is not None and D[i]:
                b = b + D[i] * h * slope
            value = None if solutions is None else solutions[i]
            solve = solve_rule(f"{self.name}.solve", partial(self._solve, value), negative_gradient, product_with)
            stages.append(solve(b, self.equation, v, *variables))
        return stages

    def _solve(
        self, solution: Any, transposed: bool, checked: bool, b: Any, equation: Equation, v: Any, *variables: Any
    ) -> Any:
        """Return the solution of W x = b, or of W^T x = b; `solution` is the one of the first solve of a rule."""
        if checked and solution is not None:
            return solution
        return self._solved(transposed, b, equation, v, variables)

    def solve_transposed(self, g: np.ndarray, v: np.ndarray, variables: Sequence) -> np.ndarray:
        """Return the solution of W^T y = g for the Jacobian at a state."""
        return self._solved(True, g, self.equation, v, variables)

    def _linearisation(self, equation: Equation, v: Any, variables: Sequence) -> Linearisation:
        """Return the Jacobian W at a state, from the kept ones or new."""
        key = (v, *variables)
        linearisation = self.kept.find(key)
        if linearisation is None:
            linearisation = self.jacobians.cached(equation, v, variables)
            op = linearisation.solver.system.unscaled
            if self.keeps_factors and op.form == "explicit":
                self.kept.most = max(1, KEPT_BYTES // (BYTES * max(op.matrix.nnz, 1)))
            self.kept.put(key, linearisation)
        return linearisation

    def _solved(self, transposed: bool, b: Any, equation: Equation, v: Any, variables: Sequence) -> Any:
        linearisation = self._linearisation(equation, v, variables)
        if linearisation.singular:
            raise self._singular()
        x, info = linearisation.solve(b, transposed)
        if info is not None:
            self.info.note(info, transposed)
        return x

    # ------------------------------------------------------------ the derivative of the accepted steps

    def record(self, step: AcceptedStep, t: float, h: float) -> _RecordedStep:
        """Return the record of an accepted step: see `Embedded`."""
        return _RecordedStep(self, step, t, h)

    def _deviations_at_end(
        self,
        path: list,
        arguments: tuple,
        start: FlatDeviation,
        end: FlatDeviation,
        initial_deviations: Any,
        event: Event | None = None,
    ) -> Any:
        """Return the deviations at the end, a linear map of the initial deviations of (u, moving params, t, h)."""
        if len(traces_of([initial_deviations])) > 1:
            return self._recorded_deviations(path, arguments, start, end, initial_deviations, event)
        _, moving, t, h = arguments
        start_units = np.concatenate([*map(np.ravel, start.units)])
        end_units = np.concatenate([*map(np.ravel, end.units)])
        records = [self.record(step, t, h) for step in path]
        reductions = WEIGHT_REDUCTIONS[: len(initial_deviations)]

        def end_of(record: _RecordedStep, error_weight: float) -> Callable:
            """Return the function of (u, moving, t, h, sum of all d) for a step: see `RecordedStep`."""
            if record is not records[-1]:
                return partial(record.after, error_weight=error_weight)
            if event:
                return partial(record.until_event, event, error_weight)
            return partial(record.after_last, error_weight=error_weight)

        def tangent(x: np.ndarray) -> np.ndarray:
            """Return the tangents at the end for tangents at the start, both divided by the units of deviations."""
            ends = np.zeros((len(reductions), end_units.size))
            if not x.any():  # the value that the tape records is 0 and needs no work
                return ends
            for number, error_weight in enumerate(reductions):
                of_state, *others = start.space.split(x[number] * start_units)
                second: Any = 0.0  # of the sum of all d, at an event of the time
                for record in records:
                    point = record.step.u, moving, t, h, 0.0
                    of_state, second = push(end_of(record, error_weight), point, [of_state, *others, second])[1]
                parts = [of_state, second] if event else [of_state]
                ends[number] = np.concatenate([*map(np.ravel, parts)]) / end_units
            return ends

        def cotangent(g: np.ndarray) -> np.ndarray:
            """Apply the transpose."""
            n = self.problem.size
            ends = g / end_units
            sums = Cotangents(ends[:, :n], np.zeros(len(ends)), np.zeros((len(ends), start_units.size - n)))
            for record in reversed(records):
                if event and record is records[-1]:
                    record.pull_event(sums, end_of, ends[:, n], moving, t, h)
                else:
                    record.pull(sums, reductions, moving, t, h, record is records[-1])
            return np.concatenate([sums.state, sums.rest], 1) * start_units

        return linear(f"{self.name}.steps", tangent, cotangent)[0](initial_deviations)


class _RecordedStep(RecordedStep):
    """Records an accepted step on the tape: see `RecordedStep`; and transposes it."""

    def __init__(self, parent: Rosenbrock, step: AcceptedStep, t: float, h: float) -> None:
        super().__init__(parent, step, t, h)
        rate = parent.problem(step.u, parent.params, t + step.done * h)
        self.section = parent.section(step.u, [rate], step.length * h)[0][0]

    def stages(self, v: Any, params: Any, t: Any, h: Any) -> list:
        """Return the stages of the step: see `RecordedStep`."""
        return self.parent.stages(v, params, t, h, self.step.middle)

    def new_state(self, v: Any, stages: list) -> Any:
        """Return the state after the step: see `RecordedStep`."""
        return combined(v, B, stages)

    def embedded_error(self, v: Any, params: Any, t: Any, h: Any, stages: list) -> Any:
        """Return the last stage: see `RecordedStep`."""
        return stages[-1]

    # ------------------------------------------------------------ the transpose of a step

    def pull(self, sums: Cotangents, reductions: Sequence, moving: list, t: float, h: float, is_last: bool) -> None:
        """Replace cotangents after the step by those before it, with one factorisation and one recording of each rate.

        The tape would record about a hundred nodes for each step, and each of them for three solutions.
        """
        parent = self.parent
        start = t + self.step.done * h
        length = self.step.length * h
        stages = self.step.middle
        variables = parent.equation.variables((length, parent.params, start))
        slope = np.zeros_like(self.step.u)
        if parent.takes_time:
            slope = push(lambda time: parent.problem(self.step.u, parent.params, time), start, [1.0])[1]

        # Points hold the tree of the state: slices of a flat array would take a third of the time.
        state = parent.problem.state
        split = parent.problem.unknowns.space.split
        base = state(self.step.u), moving, start
        is_differentiated = [True] * len(leaves(base))

        def rate(point: tuple) -> Any:
            u, moving, t = point
            return parent.problem.problem(u, parent.with_moving(moving), t)

        def along_stages(point: tuple) -> list:
            """Return for each stage J applied to the stage, and the time derivative of the rate."""
            tangents = []
            for stage, weight in zip(stages, D, strict=True):
                of_time = weight * length if parent.takes_time and weight else None
                tangents.append(push(rate, point, [*split(stage), *[None] * len(moving), of_time])[1])
            return tangents

        new = sums.state
        of_stages = np.multiply.outer(B, new)
        of_stages[-1] += np.array(reductions)[:, None] * new
        of_point = np.zeros((len(new), sums.state.shape[1] + sums.rest.shape[1] - 1))  # of (u, moving params, start)
        of_point[:, : new.shape[1]] = new
        of_length = np.zeros(len(new))
        adjoints: list = [None] * len(B)
        for i in reversed(range(len(B))):
            ys = np.array([parent.solve_transposed(g, self.step.u, variables) for g in of_stages[i]])
            adjoints[i] = ys
            point = state(combined(self.step.u, A[i], stages)), moving, start + NODES[i] * length
            tape = taped(rate, point, is_differentiated)
            of_stage = joined([tape.pull(split(y)) for y in ys], point)
            of_point += of_stage
            earlier = combined(np.zeros_like(slope), C[i], stages)
            of_length += NODES[i] * of_stage[:, -1]
            of_length += ys @ (D[i] * slope + (stages[i] / GAMMA - earlier) / length**2)
            for j in range(i):
                of_stages[j] += A[i][j] * of_stage[:, : new.shape[1]] + (C[i][j] / length) * ys
        # The derivatives of J and of the time derivative: one recording of all tangents for all adjoints, as a tangent
        # recorded for reverse mode takes half the time of a backward pass in forward mode.
        tape = taped(along_stages, base, is_differentiated)
        of_point += joined([tape.pull([part for y in ys for part in split(y)]) for ys in zip(*adjoints)], base)
        of_start = of_point[:, -1]
        sums.state = of_point[:, : new.shape[1]]
        if is_last:
            sums.shift = of_start - of_length
        else:
            sums.state = sums.state + np.outer(of_length + sums.shift, self.section)
            sums.shift = sums.shift + of_start
        sums.rest[:, :-1] += of_point[:, new.shape[1] :]
        sums.rest[:, -1] += self.step.done * of_start + self.step.length * of_length

    def pull_event(
        self, sums: Cotangents, end_of: Callable, of_times: np.ndarray, moving: list, t: float, h: float
    ) -> None:
        """Replace cotangents of state and time at an event by those before the last step."""
        point = self.step.u, moving, t, h, 0.0
        rows = []
        for error_weight, of_state, of_time in zip(WEIGHT_REDUCTIONS, sums.state, of_times):
            tape = taped(end_of(self, error_weight), point, [True] * (len(moving) + 4))
            rows.append(tape.pull([of_state, of_time]))
        parts = joined(rows, point)
        n = self.step.u.size
        sums.state = parts[:, :n]
        sums.shift = parts[:, -1]
        sums.rest += parts[:, n:-1]


@dataclass
class Cotangents:
    """Cotangents of several solutions, along the first axis.

    Attributes
    ----------
    state : array
    shift : array
        Of the sum of all d.
    rest : array
        Of the moving params, the start and the length of the interval: sums over the steps.
    """

    state: np.ndarray
    shift: np.ndarray
    rest: np.ndarray


def joined(rows: Sequence, point: Any) -> np.ndarray:
    """Return the derivatives of the leaves of a point as one row for each solution; None stands for zeros."""
    shapes = [np.shape(leaf) for leaf in leaves(point)]
    stops = np.cumsum([0, *map(prod, shapes)])
    table = np.zeros((len(rows), stops[-1]))
    for joined_row, row in zip(table, rows, strict=True):
        for part, first, stop in zip(row, stops, stops[1:]):
            if part is not None:
                joined_row[first:stop] = np.ravel(part)
    return table


def combined(v: Any, weights: Sequence, stages: Sequence) -> Any:
    """Return v plus the weighted sum of the stages."""
    for weight, stage in zip(weights, stages):
        v = v + weight * stage
    return v


def _residual_jacobian(jacobian: Callable, timed: bool, x: Any, h: Any, params: Any, t: Any) -> Any:
    """Return W, given the user's df/du."""
    if type(params) is SidedParams:
        x, t = params.side.inside(x, params.params, t)
    arguments = (x, without_side(params), t)
    J = as_matrix(jacobian(*arguments[: 2 + timed]))
    return sp.eye_array(J.shape[0]) / (GAMMA * h) - J
