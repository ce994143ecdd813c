"""Radau IIA of order 5 with error control, for small stiff systems: dense, and one rule on the tape for an interval.

A step of length h from u has three stages, with f_i = f(u + z_i, t + c_i h) and c_3 = 1,

    z_i = h sum_j a_ij f_j,          and the new state is u + z_3.

It is L-stable: what is stiff dies out at any h. Of smooth problems the order is 5, of stiff ones whose data move at
least 3, where that of Rosenbrock methods (Rodas) falls to less; and the discrete adjoint needs first derivatives of f
alone, where theirs needs those of the Jacobian. Newton's method takes one Jacobian J of f for all stages, and for as
many steps as it serves: in the basis of the eigenvectors of A^-1 its system of 3 n unknowns is a real and a complex one
of n. The error of a step is that of an embedded formula of order 3, filtered by the real matrix,

    e = (g/h - J)^-1 (f(u, t) + sum_i e_i z_i / h),          g the real eigenvalue of A^-1.

In a second trial from a state, where it is too large, f(u + e, t) takes the place of f(u, t) once: an error in u that
dies out at any length would stay in e until h is as short as that takes, 72 trials in a row in u' = -1e6 (u - cos t).

Source: Hairer and Wanner, Solving Ordinary Differential Equations II (1996), IV.8; lengths: see adaptive.py.

Derivatives are those of the steps taken, by the implicit function theorem for each, never through the iterations. With
J_i, P_i, q_i the derivatives of f_i in the state, the params and the time,

    K dz = h A (J_i du + P_i dp + q_i (dt + c_i dh)) + z/h dh,          K = 1 - h A J_i   (3 n unknowns),

and the backward pass is the transpose of that. Lengths move with the state, dh = d, and the derivative is judged by two
shadows, as adaptive.py says and for its reasons. Two things differ: the first shadow has the derivative of
u + z_3 + EPSILON e, and the last step gives the sum of all d back: the rate at its end would not do, since errors of
stiff parts are large in it.
"""

from copy import copy
from typing import Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.pytree import leaves
from sparsedp._utils.validation import check_shape
from sparsedp.autodiff.backend import require_arrays
from sparsedp.autodiff.tape import cast, dtype_of, is_variable, isbox, linear, plain, traces_of
from sparsedp.autodiff.tape_constants import constant
from sparsedp.errors import ConvergenceError, DerivativeError, NonFiniteError, ShapeError, UnstableStepError
from sparsedp.integrators.adaptive import LESS, WINDOW, Adaptive, Moving, Taken, relative
from sparsedp.integrators.discontinuities import Inspector
from sparsedp.integrators.jacobians import jacobians_of
from sparsedp.integrators.problem import Sided, combine, like, unsided, untraced
from sparsedp.integrators.runge_kutta import Scheme, as_matrix
from sparsedp.solvers.direct import dense_lu
from sparsedp.solvers.newton import Unknowns

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
REFUSALS = UnstableStepError, NonFiniteError, ConvergenceError  # of a rate that is given a state too far away
TOGETHER, ENTRIES = 32, 2**20  # steps whose derivatives are taken at once; entries of an array of them
FAST = 0.03  # share of a correction that is left after an iteration, up to which the Jacobian serves the next step


class Flat:
    """A problem on flat unknowns, and its derivatives.

    Parameters
    ----------
    problem : Problem
    u : tree
        The shapes of its leaves count.
    name : str
        For messages.
    """

    def __init__(self, problem, u, name):
        require_arrays(name, map(plain, leaves(u)))
        self.problem, self.timed, self.layout = problem, problem.timed, Unknowns(u, name)
        self.size = self.layout.size
        if self.size > UNKNOWNS:
            raise ShapeError(
                f"{name} solves full systems of at most {UNKNOWNS} unknowns, got {self.size}; take tr_bdf2"
            )
        self.whole = self.layout.shapes == [(self.size,)]

    def state(self, v):
        """Flat -> tree."""
        return v if self.whole else self.layout.split(v)

    def __call__(self, v, params, t):
        """The flat rate."""
        rate = self.problem(self.state(v), params, t)
        return rate if self.whole else self.layout.flat(rate)

    def rows(self, points, params, moving):
        """At points (v, t) the rates, and their derivatives in the state, the params that move, and the time."""
        trees = [(self.state(v), params, t) for v, t in points]
        return jacobians_of(lambda tree: self.problem(*tree), trees, [*[True] * len(self.layout.shapes), *moving, True])


class Radau(Adaptive):
    """Steps of a problem with few unknowns, any tree of real arrays, and the derivative of those taken.

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

    Attributes
    ----------
    params, moving : tree, list of bool
        Of an interval, plain, and which leaves are traced. Each interval has a copy of the scheme.
    f : flat array
        The rate at the start of the step.
    real, complex : callable
        Solves of Newton's method.
    """

    window = 10 * WINDOW  # a jump at a fine tolerance takes thousands of steps, of little cost
    params: Any
    moving: Any
    v: Any = None
    J: Any = None
    held: Any = None
    guess: Any = None
    fresh = slow = False

    def __init__(self, problem, jacobian, tolerance, floor, settings, max_step=None):
        super().__init__(Scheme(problem, "radau", 5), tolerance, floor, max_step)
        self.given, self.taken = jacobian, [1.0]
        self.goal = NEWTON * tolerance if tolerance else settings["rtol"]
        self.most = ITERATIONS if tolerance else settings["maxiter"] or 50
        self.compared, self.ratio, self.weight = EMBEDDED, 1.0, 1.0

    def __call__(self, u, params, t, h):
        """The state after the interval h."""
        run, given = self.interval(u, params, t, h)
        if not run.problem.size:
            return u
        new = run._crossed(given, is_variable)
        self.taken = run.taken
        return run.rounded(new)

    def interval(self, u, params, t, h):
        """A copy for an interval, and what it is given: flat unknowns, the params that move, time and length."""
        run = copy(self)
        run.problem, run.params = Flat(self.problem, u, self.name), constant(untraced(params))
        run.moving = [isbox(leaf) for leaf in leaves(params)]
        v = run.problem.layout.space.join(*(cast(leaf, float) for leaf in leaves(u)))
        if v.size:
            run.check(u, params, t, h)
        moving = [leaf for leaf in leaves(params) if isbox(leaf)]
        return run, (v, moving, 0.0 if t is None else t + 0.0, h)

    def rerun(self, path, given, event):
        runs, starts = zip(*(self.interval(*start) for start in given), strict=True)
        run, known = runs[0], untraced(starts[0])
        start = Moving(starts[0], is_variable, [*run.sizes(path[0].u), *map(relative, leaves(known[1:]))])
        sizes = run.sizes(path[0].u, path[-1].new)
        time = None
        if event:
            time = known[2] + (path[-1].done + path[-1].length) * known[3]
            sizes = [*sizes, known[3]]
        end = Moving((path[-1].new, time), is_variable, sizes if event else [*sizes, 1.0])
        entered = anp.array([start.off(one) for one in starts])
        ends = run._runs(path, known, start, end, entered, event)
        return [(run.rounded(new), time) for new, time in (end.at(ends[k]) for k in range(len(given)))]

    def tree(self, v):
        return self.problem.state(v)

    def rounded(self, v):
        return self.problem.layout.rounded(v)

    def partial(self, step, known, length):
        goal, most, self.goal, self.most = self.goal, self.most, ROUNDING, 2 * ITERATIONS
        try:
            return super().partial(step, (known[0], self.params, *known[2:]), length)
        finally:
            self.goal, self.most = goal, most

    def check(self, *given):
        """Refuse a state, a rate, or derivatives that it cannot serve."""
        u, _, t, h = untraced(given)
        rate = self.problem.problem(u, self.params, t)
        require_arrays(self.name, leaves(rate))
        like(combine(u, (0.0, rate)), u)  # refuses other shapes, and complex
        if any(map(isbox, leaves(rate))):
            raise DerivativeError(
                f"the rate of {self.name} uses a traced value that is not an argument; put it into params"
            )
        traced = [leaf for leaf in leaves(given) if isbox(leaf)]
        if len(traces_of(traced)) > 1:  # the rule below is linear: its own derivative would miss that of the steps
            raise DerivativeError(
                f"{self.name} has first derivatives only, got one inside another; take tr_bdf2 for second ones"
            )
        if any(dtype_of(leaf).kind == "c" for leaf in traced):
            raise DerivativeError(f"{self.name} has derivatives in real params; give real and imaginary part as two")
        if self.tolerance is not None:
            self.check_tolerance(u)

    follows_path = False
    quadrature = tuple(C), tuple(A[2])

    def inspector(self, known):
        """As of `Adaptive`; with the params of the interval."""
        if self.tolerance is None or self.problem.problem.rate is None and not self.problem.problem.moving:
            return None
        return Inspector(self, self.params, *known[2:])

    def inner_state(self, step):
        """Return the second stage, and the share of the step at which it is."""
        return step.u + step.middle[1], C[1]

    def _steps(self, v, params, t, h, inspector=None):
        if self.tolerance is not None:
            return super()._steps(v, self.params, t, h, inspector)
        self._first(v, self.params, t, h)  # refuses what is not finite
        with np.errstate(all="ignore"):
            z = self.stages(v, t, h)
        if z is None:
            raise ConvergenceError(
                f"{self.name}: Newton's method does not converge in a step of {h:.3g}; "
                "take a smaller dt, or give stepper a tolerance"
            )
        return [Taken(1.0, 0.0, v, z, v + z[2])]

    def _trial(self, v, params, t, length, h, inspector=None):
        """The stages, the new state, and the error of the embedded formula in units of the tolerance."""
        h, again = length * h, v is self.v
        with np.errstate(all="ignore"):  # a step that is too long is refused, whatever it gave
            z = self.stages(v, t, h)
            if z is None:
                return None, None, np.inf
            units, e = self.units(v, v + z[2]) * self.tolerance, E @ z / h
            error = self.real(self.f + e, False)
            if again and norm(error / units) > 1:
                try:
                    error = self.real(self.problem(v + error, params, t) + e, False)
                except REFUSALS:
                    pass  # the step is too long
            ratio = norm(error / units)
        return z, v + z[2], ratio if np.isfinite(ratio) else np.inf

    def sizes(self, *states):
        return [np.concatenate([*map(np.ravel, super().sizes(*map(self.problem.state, states)))])]

    def units(self, v, w):
        """|v| + floor, to which errors are compared, the larger of two states."""
        (size,) = self.sizes(v, w)
        return np.where(size > 0, size, 1.0)

    # ------------------------------------------------------------ Newton's method

    def stages(self, v, t, h):
        """The stages z of a step, or None where Newton's method does not converge."""
        try:
            if v is not self.v:
                self.f, self.J = self.problem(v, self.params, t), None if self.slow else self.J
                self.v, self.fresh = v, False
            z = self._newton(v, t, h) if self.J is not None else None
            if z is None and not self.fresh:
                self.fresh, self.held = True, None
                self.J = self.jacobian(v, t)
                z = self._newton(v, t, h)
        except REFUSALS:
            return None
        if z is not None:
            self.guess = v, h, CUBIC @ np.vstack([v, v + z])
        return z

    def jacobian(self, v, t):
        """df/du for Newton's method."""
        n = self.problem.size
        if self.given is None:
            return self.problem.rows([(v, t)], self.params, [False] * len(self.moving))[1][0, :, :n]
        u = self.problem.state(v)
        if type(self.params) is Sided:
            u, t = self.params.side.inside(u, self.params.params, t)
        args = (u, unsided(self.params), t)
        J = as_matrix(self.given(*args[: 2 + self.problem.timed])).toarray()
        check_shape(f"the jacobian of {self.name}", J, (n, n))
        return J

    def _newton(self, v, t, h):
        h = float(h)  # complex numbers of Python and of NumPy divide with other roundings
        if self.held != h:
            solves = (dense_lu(value / h * np.eye(v.size) - self.J)[0] for value in (REAL, COMPLEX))
            self.held, (self.real, self.complex) = h, solves
        z, last, left = np.zeros((3, v.size)), 0.0, 0.0
        if self.guess is not None:  # the cubic through the last stages; from there, or again from the same state
            start, before, cubic = self.guess
            z = np.vander(C * h / before + (start is not v), 4, increasing=True) @ cubic - v
        w = BACK @ z
        for iteration in range(1, self.most + 1):
            rates = [self.problem(v + part, self.params, t + c * h) for part, c in zip(z, C, strict=True)]
            f = BACK @ np.array(rates)
            one = self.real(f[0] - REAL / h * w[0], False)
            pair = self.complex(f[1] + 1j * f[2] - COMPLEX / h * (w[1] + 1j * w[2]), False)
            step = np.array([one, pair.real, pair.imag])
            w, step = w + step, BASIS @ step
            z = z + step
            if iteration == 1:
                size = self.units(v, v + z[2])
            moved = norm(step / size)
            left = moved / last if last else 0.0
            error = moved * left / (1 - left) if left < 1 else np.inf
            if moved == 0.0 or last and error <= max(self.goal, ROUNDING):
                break
            if not (np.isfinite(error) and left ** (self.most - iteration - 1) * error <= self.goal):
                return z if moved <= STALLED else None
            last = moved
        self.slow = left > FAST and iteration > 2
        return z

    # ------------------------------------------------------------ the derivative of the steps taken

    def doors(self, count):
        return super().doors(count) if self.tolerance else (lambda x: x[None], lambda x: x[0])

    def _runs(self, path, known, start, end, entered, event=None):
        """As a linear map of (u, params that move, t, h); all d so far stand between the first two.

        Where an event ends the path, its time is that of the steps and all d.
        """
        *_, t, h = known
        n, less = self.problem.size, np.array(LESS[: len(entered)])
        size, scales = np.concatenate([*map(np.ravel, end.units)]), np.concatenate([*map(np.ravel, start.units)])
        many = int(np.clip(ENTRIES / (9 * n * scales.size), 1, TOGETHER))
        parts = [path[first : first + many] for first in range(0, len(path), many)]

        def tangent(x):
            """Tangents of what goes in -> of the states at the end, both in units of their sizes."""
            y = np.insert(x * scales, n, 0.0, axis=1).T
            if x.any():  # else it is the value that goes on the tape
                for part in parts:
                    for step, shadow in self._linearised(part, path[-1], t, h, event):
                        y[: n + 1] = step @ y + less * (shadow @ y)
            if event:
                y[n] += y[-2]  # its time: that of the start, and all d
            return y[: size.size].T / size

        def cotangent(g):
            """The transpose."""
            y = np.zeros((scales.size + 1, len(g)))
            y[: size.size] = (g / size).T
            of_time = y[n].copy() if event else 0.0
            for part in reversed(parts):
                for step, shadow in self._linearised(part, path[-1], t, h, event)[::-1]:
                    head = y[: n + 1].copy()
                    y[: n + 1] = 0.0
                    y += step.T @ head + shadow.T @ (less * head)
            y[-2] += of_time
            return np.delete(y, n, 0).T * scales

        return linear(f"{self.name}.steps", tangent, cotangent)[0](entered)

    def _linearised(self, steps, end, t, h, event):
        """Of some steps the derivatives of (u, all d) after each, and what the shadow adds; `end`: the last one of all.

        Array (steps, 2, n + 1, numbers that go in and all d).
        """
        ends = event and steps[-1] is end
        n, one = self.problem.size, np.eye(self.problem.size)
        length, done, u, z, new = (np.array(part) for part in zip(*steps, strict=True))
        places = [(u, done), (new[-1:], done[-1:] + length[-1:])]
        places += [(u + z[:, i], done + C[i] * length) for i in (0, 1)]
        states, shares = (np.concatenate(part) for part in zip(*places, strict=True))
        rates, rows = self.problem.rows([*zip(states, t + shares * h, strict=True)], self.params, self.moving)
        m, last = len(steps), np.array([step is end for step in steps])
        first, rows = rows[:m], np.stack([rows[m + 1 : -m], rows[-m:], rows[1 : m + 1]], 1)
        sections = [self.section(*row)[0][0] for row in zip(u, rates[:m, None], length * h)]
        section = np.where(last[:, None], 0.0, sections)
        if event:
            last = np.zeros(m, bool)
        interval = h
        length, done, last, h = (part[:, None, None] for part in (length, done, last, length * h))
        hA = h * A
        K = np.eye(3 * n) - np.einsum("sab,sbij->saibj", hA, rows[..., :n]).reshape(m, 3 * n, 3 * n)
        b = np.concatenate([np.einsum("sab,sbij->saij", hA, rows), (z / h + (hA * C) @ rows[..., -1])[..., None]], -1)
        dz = solved(K, b.reshape(m, 3 * n, -1)).reshape(b.shape)
        error = np.concatenate([first, -np.swapaxes(E[None] @ z / h / h, 1, 2)], 2) + np.tensordot(E, dz, (0, 1)) / h
        M = np.stack([dz[:, 2] + np.eye(n, b.shape[-1]), solved(REAL / h * one - first[..., :n], error)], 1)
        stretch = M[..., -1].copy()  # of the new state with the length
        M[..., -1] = done * M[..., -2] + length * stretch
        M = np.insert(M, n, M[..., -2] - last * stretch, axis=3)  # the last step gives all d back
        M[..., :n] += stretch[..., None] * section[:, None, None]
        shift = np.zeros((m, 2, 1, M.shape[3]))
        shift[:, 0, 0, : n + 1] = np.insert(section, n, ~last[:, 0, 0], axis=1)
        if ends:
            start = t + end.done * interval
            self._end_at(event, end, start, end.length * interval, M[-1], shift[-1, :, 0], stretch[-1])
        return np.concatenate([M, shift], 2)

    def _end_at(self, event, step, t, length, M, shift, stretch):
        """Let d of the last step be that with which the event stays 0; `M` and `shift` are written into.

        With the new state M x + stretch d and the time S + t + d, S all d before,

            d = -(g_u M x + g_p p + g_t (S + t)) / (g_u stretch + g_t).
        """
        n, params = self.problem.size, unsided(self.params)
        u = self.problem.state(step.new)
        moving = [*[True] * len(self.problem.layout.shapes), *self.moving[: len(leaves(params))], True]
        _, rows = jacobians_of(
            lambda point: event.value(point[0], unsided(point[1]), point[2]), [(u, params, t + length)], moving
        )
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


def solved(matrices, b):
    """Of each matrix the solution for its right-hand sides."""
    return np.array([dense_lu(matrix)[0](part, False) for matrix, part in zip(matrices, b, strict=True)])


def norm(x):
    """Root mean square; of three stages the root of the sum of theirs."""
    return float(np.sqrt(np.vdot(x, x) / x.shape[-1]))
