"""Radau IIA of order 5 with error control, for small stiff systems: dense, and one rule on the tape for an interval.

A step of length h from u has three stages, with f_i = f(u + z_i, t + c_i h) and c_3 = 1,

    z_i = h sum_j a_ij f_j,          and the new state is u + z_3.

It is L-stable: what is stiff dies out at any h. Of smooth problems the order is 5, of stiff ones whose data move at
least 3, where that of Rosenbrock methods (Rodas) falls to less; and the discrete adjoint needs first derivatives of f
alone, where theirs needs those of the Jacobian. Newton's method takes one Jacobian J of f for all stages, and for as
many steps as it serves: in the basis of the eigenvectors of A^-1 its system of 3 n unknowns is a real and a complex one
of n. The error of a step is that of an embedded formula of order 3, filtered by the real matrix,

    e = (g/h - J)^-1 (f(u, t) + sum_i e_i z_i / h),          g the real eigenvalue of A^-1.

Source: Hairer and Wanner, Solving Ordinary Differential Equations II (1996), IV.8; lengths: see adaptive.py.

Derivatives are those of the steps taken, by the implicit function theorem for each, never through the iterations. With
J_i, P_i, q_i the derivatives of f_i in the state, the params and the time,

    K dz = h A (J_i du + P_i dp + q_i (dt + c_i dh)) + z/h dh,          K = 1 - h A J_i   (3 n unknowns),

and the backward pass is the transpose of that. Lengths move with the state, dh = d, and the derivative is judged by two
shadows, as adaptive.py says and for its reasons. Two things differ: the first shadow has the derivative of
u + z_3 + EPSILON e, and the last step gives the sum of all d back: the rate at its end would not do, since errors of
stiff parts are large in it.
"""

from collections import deque
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.sparse as sp

from sparsedp.constants import constant
from sparsedp.derivative import backward_each, linearised
from sparsedp.errors import ConvergenceError, DerivativeError, NonFiniteError, ShapeError, UnstableStepError
from sparsedp.integrators.adaptive import EPSILON, WINDOW, Adaptive, Moving, Taken, flat, relative
from sparsedp.integrators.problem import combine, later, like, untraced
from sparsedp.integrators.runge_kutta import Scheme
from sparsedp.operator import Operator
from sparsedp.solvers.direct import dense_lu
from sparsedp.solvers.newton import Layout
from sparsedp.tape import dtype_of, is_variable, isbox, linear, traces_of
from sparsedp.tree import leaves, mapped

__all__ = ["Radau"]

ROOT = 6**0.5
C = np.array([(4 - ROOT) / 10, (4 + ROOT) / 10, 1.0])
POWERS = np.arange(3)
A = (C[:, None] ** (POWERS + 1) / (POWERS + 1)) @ np.linalg.inv(C[:, None] ** POWERS)  # collocation at the nodes
E = np.array([-13 - 7 * ROOT, -13 + 7 * ROOT, -1]) / 3  # e_i of the embedded formula
_values, _vectors = np.linalg.eig(np.linalg.inv(A))
_real, _upper = np.argmin(np.abs(_values.imag)), np.argmax(_values.imag)
REAL, COMPLEX = float(_values[_real].real), complex(_values[_upper].conj())  # eigenvalues of A^-1
BASIS = np.array([_vectors[:, _real].real, _vectors[:, _upper].real, _vectors[:, _upper].imag]).T
BACK = np.linalg.inv(BASIS)
CUBIC = np.linalg.inv(np.vander([0.0, *C], increasing=True))  # values at 0, c_1, c_2, c_3 -> coefficients

UNKNOWNS = 500  # most; with more, sparse solves are faster
EMBEDDED = 3  # order of the embedded formula
NEWTON = 1e-3  # error of Newton's method in units of the tolerance: at 0.03 HIRES is 10 to 100 times less accurate
ROUNDING = 1e-15  # relative correction that no iteration is asked to go below
STALLED = 1e-11  # relative correction that is taken for rounding where it does not shrink
ITERATIONS = 10  # of Newton's method in a step with error control
FAST = 0.03  # share of a correction that is left after an iteration, up to which the Jacobian serves the next step


class Radau(Adaptive):
    """Steps of a problem with few unknowns: any tree of real arrays.

    Parameters
    ----------
    problem : Problem
    jacobian : callable or None
        For Newton's method alone; derivatives are made from the rate.
    tolerance : float or None
        As `Adaptive`; None: one step.
    floor : None, number, or tree like the state
        As `Adaptive`.
    settings : dict
        rtol and maxiter, of Newton's method where there is no error control.
    """

    dyadic, window = False, 10 * WINDOW  # a jump at a fine tolerance takes thousands of steps, of little cost

    def __init__(self, problem, jacobian, tolerance, floor, settings):
        Scheme.__init__(self, problem, "stepper(radau)", 5)
        self.jacobian, self.tolerance, self.floors = jacobian, tolerance, leaves(constant(floor))
        self.compared, self.ratio, self.weight, self.taken = EMBEDDED, 1.0, 1.0, [1.0]
        self.goal = NEWTON * tolerance if tolerance else settings["rtol"]
        self.most = ITERATIONS if tolerance else settings["maxiter"] or 50

    def __call__(self, *given):
        """(u, params, t, h) -> the state after the interval h."""
        u, params, t, h = untraced(given)
        if any(map(isbox, leaves(given))):  # the caller may write into its arrays before the way back
            u, params = constant((u, params))
        rates = Rates(self, u, params, list(map(isbox, leaves(given[1]))))
        if rates.size == 0:
            return given[0]
        traced = [leaf for leaf in leaves(given) if isbox(leaf)]
        path = deque(self._path(rates, u, t, float(h)), None if traced else 1)
        new = rates.layout.rounded(path[-1].new)
        if not traced:
            return new
        if len(traces_of(traced)) > 1:  # the rule below is linear: its own derivative would miss that of the steps
            raise DerivativeError(
                f"{self.name} has first derivatives only, got one inside another; take tr_bdf2 for second ones"
            )
        if any(dtype_of(leaf).kind == "c" for leaf in traced):
            raise DerivativeError(f"{self.name} has derivatives in real params; give real and imaginary part as two")
        return Variation(self, rates, path, given).of(new)

    def _path(self, rates, u, t, h):
        v = rates.layout.flat(u)
        state = rates.state(v)
        rate = self.problem(state, rates.params, t)
        like(combine(state, (0.0, rate)), state)  # refuses other shapes, and complex
        if any(map(isbox, leaves(rate))):
            raise DerivativeError(
                f"the rate of {self.name} uses a traced value that is not an argument; put it into params"
            )
        self._first(v, rates, t, h)  # refuses what is not finite
        if self.tolerance is not None:
            self._check_tolerance(u)
            return self._steps(v, rates, t, h)
        with np.errstate(all="ignore"):
            z = rates.stages(v, t, h)
        if z is None:
            raise ConvergenceError(
                f"{self.name}: Newton's method does not converge in a step of {h:.3g}; "
                "take a smaller dt, or give stepper a tolerance"
            )
        return [Taken(1.0, 0.0, v, z, v + z[2])]

    def _first(self, v, rates, t, h):
        return super()._first(rates.state(v), rates.params, t, h)

    def _trial(self, v, rates, t, length, h):
        """The stages, the new state, and the error of the embedded formula in units of the tolerance."""
        h = length * h
        with np.errstate(all="ignore"):  # a step that is too long is refused, whatever it gave
            z = rates.stages(v, t, h)
            if z is None:
                return None, None, np.inf
            rest, size = E @ z / h, rates.sizes(v, v + z[2])
            error = rates.real(rates.f + rest, False)
            ratio = norm(error / size) / self.tolerance
        return z, v + z[2], ratio if np.isfinite(ratio) else np.inf


class Rates:
    """The rate on flat unknowns, its derivatives, and Newton's method for the stages of one step after the other.

    Parameters
    ----------
    scheme : Radau
    u, params : trees
        Plain.
    moving : list of bool
        For each leaf of the params, whether derivatives in it are asked for.

    Attributes
    ----------
    f : flat array
        At the start of the step.
    real, complex : callable
        Solves of Newton's method.
    """

    def __init__(self, scheme, u, params, moving):
        self.scheme, self.problem, self.params, self.moving = scheme, scheme.problem, params, moving
        self.layout = Layout(u, scheme.name)
        self.size = self.layout.size
        if self.size > UNKNOWNS:
            raise ShapeError(
                f"{scheme.name} solves full systems of at most {UNKNOWNS} unknowns, got {self.size}; take tr_bdf2"
            )
        self.whole = self.layout.shapes == [(self.size,)]
        self.spans = [slice(*pair) for pair in pairwise(self.layout.space.offsets)]
        self.still = np.zeros((0 if self.problem.timed else 1, self.size))  # in a time that nothing takes
        self.v = self.J = self.held = self.guess = None
        self.fresh = self.slow = False

    def state(self, v):
        """Flat -> tree."""
        return v if self.whole else self.layout.split(v)

    def __call__(self, v, t):
        """The flat rate."""
        rate = self.problem(self.state(v), self.params, t)
        return rate if self.whole else self.layout.flat(rate)

    def sizes(self, v, w):
        """|v| + floor, to which errors are compared, the larger of two states."""
        size = flat(self.scheme.sizes(self.state(v), self.state(w)))
        return np.where(size > 0, size, 1.0)

    # ------------------------------------------------------------ derivatives

    def rows(self, v, t, moving):
        """The derivatives in the state, the params that move, and the time: one row for each unknown."""
        problem, tree = self.problem, (self.state(v), self.params, t)
        moving = [True] * len(self.spans) + moving + [problem.timed]
        values, _, pull = linearised(lambda tree: problem(*tree), tree, moving)
        n, units = self.size, np.eye(self.size)
        pairs = zip(self.spans, values, strict=True)
        backs = pull([units[span].reshape(*np.shape(value), n) for span, value in pairs], backward_each)
        found = [pair for *pair, moves in zip(backs, leaves(tree), moving, strict=True) if moves]
        parts = [np.zeros((np.size(leaf), n)) if back is None else back.reshape(-1, n) for back, leaf in found]
        return np.concatenate([*parts, self.still]).T

    def jacobian(self, v, t):
        """df/du for Newton's method."""
        if self.scheme.jacobian is None:
            return self.rows(v, t, [False] * len(self.moving))[:, : self.size]
        J = self.scheme.jacobian(self.state(v), self.params, *([t] if self.problem.timed else []))
        J = J.matrix if isinstance(J, Operator) else J
        J = J.toarray() if sp.issparse(J) else np.asarray(J, float)
        if J.shape != (self.size, self.size):
            raise ShapeError(f"the jacobian of {self.scheme.name} must have shape {(self.size,) * 2}, got {J.shape}")
        return J

    # ------------------------------------------------------------ Newton's method

    def stages(self, v, t, h):
        """The stages z of a step, or None where Newton's method does not converge."""
        try:
            if v is not self.v:
                self.f, self.J = self(v, t), None if self.slow else self.J
                self.v, self.fresh = v, False
            z = self._newton(t, h) if self.J is not None else None
            if z is None and not self.fresh:
                self.fresh, self.held = True, None
                self.J = self.jacobian(v, t)
                z = self._newton(t, h)
        except (UnstableStepError, NonFiniteError, ConvergenceError):
            return None
        if z is not None:
            self.guess = v, h, CUBIC @ np.vstack([v, v + z])
        return z

    def _newton(self, t, h):
        v = self.v
        if self.held != h:
            solves = (dense_lu(value / h * np.eye(self.size) - self.J)[0] for value in (REAL, COMPLEX))
            self.held, (self.real, self.complex) = h, solves
        z, last, left = np.zeros((3, self.size)), 0.0, 0.0
        if self.guess is not None:  # the cubic through the last stages; from there, or again from the same state
            start, before, cubic = self.guess
            z = np.vander(C * h / before + (start is not v), 4, increasing=True) @ cubic - v
        w = BACK @ z
        for iteration in range(1, self.scheme.most + 1):
            f = BACK @ np.array([self(v + part, later(t, c * h)) for part, c in zip(z, C, strict=True)])
            one = self.real(f[0] - REAL / h * w[0], False)
            pair = self.complex(f[1] + 1j * f[2] - COMPLEX / h * (w[1] + 1j * w[2]), False)
            step = np.array([one, pair.real, pair.imag])
            w, step = w + step, BASIS @ step
            z = z + step
            if iteration == 1:
                size = self.sizes(v, v + z[2])
            moved = norm(step / size)
            left = moved / last if last else 0.0
            error = moved * left / (1 - left) if left < 1 else np.inf
            if moved == 0.0 or last and error <= max(self.scheme.goal, ROUNDING):
                break
            if not (np.isfinite(error) and left ** (self.scheme.most - iteration - 1) * error <= self.scheme.goal):
                return z if moved <= STALLED else None
            last = moved
        self.slow = left > FAST and iteration > 2
        return z


def norm(x):
    """Root mean square; of three stages the root of the sum of theirs."""
    return float(np.sqrt(np.vdot(x, x) / x.shape[-1]))


class Variation:
    """The derivative of the steps taken, as a linear map: tangents forward, cotangents backward, both judged.

    Columns are those of (u, shift, params that move, t, h), with the sum of all d as the shift.

    Parameters
    ----------
    scheme : Radau
    rates : Rates
    path : list of Taken
    given : (u, params, t, h)
        Traced.
    """

    def __init__(self, scheme, rates, path, given):
        u, params, t, h = given
        u = mapped(lambda leaf: leaf if is_variable(leaf) else np.asarray(leaf, float), u)
        self.tree = u, [leaf for leaf in leaves(params) if isbox(leaf)], 0.0 if t is None else t + 0.0, h
        *_, self.t, self.h = untraced(self.tree)
        self.scheme, self.rates, self.path, self.n = scheme, rates, path, rates.size
        split, first, last = rates.layout.space.split, path[0].u, path[-1]
        sizes = [*split(rates.sizes(first, first)), *map(relative, leaves(untraced(self.tree[1:])))]
        self.start, self.scales = Moving(self.tree, is_variable, sizes), np.concatenate([*map(np.ravel, sizes)])
        self.sizes = rates.sizes(last.u, last.new)
        self.judged = scheme.tolerance is not None
        self.shadow = np.array([0.0, EPSILON, 0.0]) if self.judged else np.zeros(1)
        self.spread: Any
        self.judge: Any
        self.spread, self.judge = scheme.doors(len(path)) if self.judged else (lambda x: x[None], lambda x: x[0])

    def of(self, new):
        """The state at the end, on the tape."""
        forward, _ = linear(f"{self.scheme.name}.variation", self.tangent, self.cotangent)
        end = Moving(new, is_variable, self.rates.layout.space.split(self.sizes))
        return end.at(forward(self.start.off(self.tree)))

    def tangent(self, x):
        """Tangent of what goes in -> of the state at the end, both in units of their sizes."""
        if not x.any():  # the value that goes on the tape
            return np.zeros(self.n)
        n, y = self.n, np.insert(self.spread(x) * self.scales, self.n, 0.0, axis=1).T
        for step, shadow in self._matrices(range(len(self.path))):
            y[: n + 1] = step @ y + self.shadow * (shadow @ y)
        return self.judge(y[:n].T / self.sizes)

    def cotangent(self, g):
        """The transpose."""
        n, y = self.n, np.zeros((self.scales.size + 1, self.shadow.size))
        y[:n] = (self.spread(g) / self.sizes).T
        for step, shadow in self._matrices(range(len(self.path) - 1, -1, -1)):
            head = y[: n + 1].copy()
            y[: n + 1] = 0.0
            y += step.T @ head + shadow.T @ (self.shadow * head)
        return self.judge(np.delete(y, n, 0).T * self.scales)

    def _time(self, share):
        return self.t + share * self.h if self.rates.problem.timed else None

    def _rows(self, number, stage):
        """The derivatives at a stage of a step; the start of a step is the last stage of the one before."""
        step = self.path[max(number, 0)]
        v, share = (step.u, 0.0) if number < 0 else (step.u + step.middle[stage], step.done + C[stage] * step.length)
        return self.rates.rows(v, self._time(share), self.rates.moving)

    def _matrices(self, numbers):
        """For each step the derivatives of (u, shift) after it, and what the first shadow adds to them."""
        ends = lru_cache(3)(lambda number: self._rows(number, 2))  # in either direction the one that is met twice
        for number in numbers:
            first = ends(number - 1)
            rows = np.array([self._rows(number, 0), self._rows(number, 1), ends(number)])
            yield self._linearised(self.path[number], rows, first)

    def _linearised(self, step, rows, first):
        n, h, z, one = self.n, step.length * self.h, step.middle, np.eye(self.n)
        K = np.eye(3 * n) - h * np.einsum("ab,bij->aibj", A, rows[:, :, :n]).reshape(3 * n, 3 * n)
        of_length = z / h + h * np.einsum("ab,b,bi->ai", A, C, rows[:, :, -1])
        b = np.dstack([h * np.einsum("ab,bij->aij", A, rows), of_length])
        dz = dense_lu(K)[0](b.reshape(3 * n, -1), False).reshape(b.shape)
        new, error, section = dz[2] + np.eye(n, b.shape[2]), np.zeros_like(dz[2]), np.zeros(n)
        if self.judged:
            error = np.tensordot(E, dz, 1) / h + np.column_stack([first, -E @ z / h**2])
            error, section = dense_lu(REAL / h * one - first[:, :n])[0](error, False), self._section(step, h)
        M = np.array([new, error])
        u, params, t, length = M[:, :, :n], M[:, :, n:-2], M[:, :, -2:-1], M[:, :, -1:]
        last = step is self.path[-1]  # it gives the shift back
        shift = t - length if last else t
        M = np.dstack([u + length * section * (not last), shift, params, t, step.done * t + step.length * length])
        M = np.pad(M, ((0, 0), (0, 1), (0, 0)))
        M[0, n, : n + 1] = 0.0 if last else [*section, 1.0]
        return M

    def _section(self, step, h):
        """The derivative of d in the state."""
        rates = self.rates
        return flat(self.scheme.section(rates.state(step.u), rates.params, self._time(step.done), h)[0])
