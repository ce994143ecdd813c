"""Newton's method with a line search on flat unknowns, judged in a way that no scaling of the residual changes.

With F and J at the last iterate, b = J x - F is the right-hand side of the linearised system J y = b. As
for linear systems (see solve.py), x is accepted when

    |F| <= rtol |b|,    or    |F| <= 8 eps (|J| |x| + |b|)    (converged_at_roundoff).

|J| |x| is taken entry by entry: unknowns of different sizes (species of 1 and 1e-10 with rates of 1e7)
would else be accepted with errors that add up over many steps. Of a tree of fields each is judged by itself, for
pressures of 1e6 would hide a temperature that is no solution; a step lowers the sum of all in these units.

A Jacobian serves further steps (simplified Newton) while they leave at most a tenth of the residual and the rest
of the way is short. Such steps gain digits at a fixed rate, where a Newton step doubles them and most often ends
far below the tolerance; they go on to rtol / 1000, so that roots found either way are as good.

Where no step lowers the residual any more, F may be rounding of terms that cancel (the 1 in exp(x) - 1).
It is taken for that, and x for converged_at_roundoff, when |F| <= 64 eps (|J| |x| + |b| + the largest |F|
met + |F_p p|) and J is right about F a thousand steps further: then neither J nor a kink is to blame.

Where Newton steps stall, far from a root, the solve starts again from the guess in **pseudo-time**: implicit Euler
steps of x' = -F / sign(D), linearised once each, in units of the time in which each unknown relaxes by itself,

    (J + D / tau) s = -F,        tau <- tau |F| / |F_next|      (switched evolution relaxation).

It follows a flow from the guess to its steady state, on which the residual
may rise for a while. An equation without a rate of its own, as div v = 0 for a pressure, has D = 0. From the longest
steps on it is Newton's method again.
Source: Kelley and Keyes, SIAM J. Numer. Anal. 35 (1998); Coffey, Kelley and Keyes, SIAM J. Sci. Comput. 25 (2003).
"""

from typing import Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.counters import note
from sparsedp._utils.pytree import flatten, keys, leaves, paired, placed
from sparsedp._utils.validation import check_finite, check_leaves, check_plain, check_precision, number_beside
from sparsedp.autodiff.backend import as_field, backend_of, replicated
from sparsedp.autodiff.derivative import pullback, push
from sparsedp.autodiff.tape import cast, dtype_of, is_variable, isbox, plain
from sparsedp.autodiff.tape_constants import constant
from sparsedp.errors import ConvergenceError, DerivativeError, NonFiniteError, ShapeError, UnstableStepError
from sparsedp.grid.space import Space
from sparsedp.solvers.direct import DENSE_UP_TO
from sparsedp.solvers.nullspace import ROUNDING
from sparsedp.solvers.scaling import length

__all__ = ["Equation", "Layout", "Newton"]

KINDS = "biuf"  # of numbers that unknowns and residuals may hold
HALVINGS = 30
DECREASE = 1e-4  # share of the decrease a linear residual would show that a step must reach
SLOW = 0.25  # a residual that falls by less makes a Jacobian suspect
FAR = 1024.0  # Newton steps: where rounding is no longer seen
LOOSEST = 1e-2  # relative residual of the linear solve of a first step
KEPT, MOST_KEPT = 0.1, 8  # a Jacobian is kept while a step leaves less, and for as many steps to the end
FURTHER = 1e-3  # of the tolerance, for steps with a Jacobian that was kept
STALLED, STALLS = 0.9, 2  # so many Newton steps on end that leave more of the residual: pseudo-time
SHORTEST, FIRST, LONGEST = 1e-3, 10.0, 1e4  # pseudo-time steps; of 1, 10, 100 at first, 10 takes the fewest in cavities
GROWTH = 10.0  # of a pseudo-time step, at most. A rule that grows 1.5 times faster loses the cavity at Re 1000
RISE = 2.0  # times the residual at the guess: a step to more is not taken, but a quarter of it in time
NEAR_FROM = 10_000  # unknowns: the LU factors of a smaller Jacobian are no gain for the next one
TINY = 1e-8  # an iterate that is smaller than the last one by this share may be on its way to 0


# ---- the residual as a function of flat unknowns ---------------------------------------------------------------------


class Layout:
    """How the unknowns, an array or a tree of arrays, lie in one flat float64 array, or field on ranks.

    Parameters
    ----------
    guess : number, array, or tree of arrays
        Its shapes and dtypes count, and where it is traced, nothing else of the trace.
    name : str
        For messages.

    Attributes
    ----------
    backend : Backend
        Where the unknowns are stored.
    space : Space
        One component for each array of the tree.
    """

    def __init__(self, guess, name):
        found, rebuild = flatten(guess)
        found = [plain(leaf) for leaf in found]
        for leaf in found:
            _check_unknown(leaf, name)
        # Rebuilt without values: a kept layout must not hold a trace or a large array.
        self.tree = rebuild([None] * len(found))
        _, self.rebuild = flatten(self.tree)
        self.shapes = [np.shape(leaf) for leaf in found]
        kinds = [dtype_of(leaf) for leaf in found]
        self.dtypes = [kind if kind.kind == "f" else np.dtype(float) for kind in kinds]
        self.scalar = isinstance(guess, (int, float)) and not isinstance(guess, np.generic)
        self.backend = backend_of(found)
        self.space = self.backend.implementation(space_of_unknowns)(name, found)
        self.size = self.space.size

    def flat(self, guess):
        """The numbers of the guess, without a trace, as one fresh float64 array."""
        found = [plain(leaf) for leaf in leaves(guess)]
        return self.backend.join(self.space, found).astype(float)

    def split(self, x):
        """Flat unknowns, traced or not -> the tree of unknowns."""
        return self.rebuild(self._fields(x))

    def _fields(self, x):
        return self.backend.split(self.space, x)

    def norms(self, x):
        """The norm of each field of plain flat unknowns."""
        return np.array([length(self.backend.flat(field)) for field in self._fields(x)])

    def spread(self, numbers):
        """A number for each field -> the same for all of its unknowns."""
        return self.backend.join(self.space, numbers)

    def laid(self, x):
        """A flat array that every rank has -> as the unknowns lie."""
        return self.backend.field(self.space, x)

    def tried(self, act, *args):
        """act(*args), where the caller goes on in another way if it fails: then all ranks do."""
        return self.backend.attempt(act, *args)

    def rounded(self, x):
        """The tree of unknowns in the dtypes of the guess; copies, for the rules go on using x."""
        if self.scalar and not isbox(x):
            return float(x[0])
        take = np.array if type(x) is np.ndarray else cast
        return self.rebuild(map(take, self._fields(x), self.dtypes))


def space_of_unknowns(name, fields):
    """Return the space of some arrays one after the other."""
    return Space(None, "unknowns", None, [np.shape(field) for field in fields])


def _check_unknown(leaf, name):
    check_plain(name, leaf)
    check_precision(f"the guess of {name}", leaf)
    kind = dtype_of(leaf).kind
    if kind == "c":
        raise TypeError(f"{name} solves for real unknowns; give real and imaginary part as two fields")
    if kind not in KINDS:
        raise TypeError(f"{name} takes a guess of numbers, got {type(leaf).__name__}")


class Equation:
    """The residual as a function of the flat unknowns and the floating leaves of the parameters.

    Parameters
    ----------
    residual : callable
        ``residual(x, *params)``.
    layout : Layout
    params : tuple of trees
        What is not floating (int, bool, None, str) is part of the equation.
    name : str

    Attributes
    ----------
    statics : list
        The leaves of the parameters, None in place of those that are floating.
    left : float or None
        Norm of the residual at the root, once Newton's method has found it.
    """

    left: Any = None

    def __init__(self, residual, layout, params, name):
        self.residual, self.layout, self.name = residual, layout, name
        check_leaves(f"parameters of {name}", params, containers=False)
        found, rebuild = flatten(params)
        self._places = [place for place, leaf in enumerate(found) if is_variable(leaf)]
        self.statics = [None if is_variable(leaf) else constant(leaf) for leaf in found]
        _, self._rebuild = flatten(rebuild(self.statics))  # of what is not traced only: equations are kept

    @property
    def size(self):
        """Number of unknowns."""
        return self.layout.size

    def variables(self, params):
        """The floating leaves of parameters of this structure, traced or not."""
        found = leaves(params)
        return [found[place] for place in self._places]

    def check_finite(self, values):
        """Refuse NaN and infinity in plain parameters."""
        for number, param in enumerate(self.params(values)):
            for leaf in leaves(param):
                if is_variable(leaf):
                    check_finite(f"parameter {number + 1} of {self.name}", as_field(leaf))

    def params(self, values):
        """Floating leaves -> the tuple of parameters."""
        return self._rebuild(placed(self.statics, self._places, values))

    def __call__(self, x, *values):
        """The flat residual; differentiable in x and the leaves."""
        return self._flat(self.residual(self.layout.split(x), *self.params(values)))

    def value(self, x, values):
        """The flat residual of plain values."""
        with np.errstate(all="ignore"):
            result = self(x, *values)
        if isbox(result):
            raise DerivativeError(
                f"the residual of {self.name} uses a traced value that is not an argument; "
                "make it a parameter of the residual and pass it to the root"
            )
        return result

    def _parts(self, result):
        """The leaves of a residual, those of dicts and named tuples in the order of the unknowns.

        Equations that are no tree like the unknowns, such as one array or a list, are taken as they come.
        """
        unknowns = self.layout.tree
        if keys(result) is None or keys(unknowns) is None or isinstance(result, dict) != isinstance(unknowns, dict):
            return leaves(result)
        if not isinstance(result, dict) and len(result) != len(unknowns):
            return leaves(result)
        return paired(result, unknowns, "residual", f" of {self.name}", "; return a tree like x")

    def _flat(self, result):
        parts = self._parts(result)
        size = sum(int(np.size(plain(part))) for part in parts)
        if size != self.size:
            raise ShapeError(f"the residual of {self.name} must hold {self.size} numbers, as many as x, got {size}")
        if any(dtype_of(part).kind not in KINDS for part in parts):
            raise TypeError(f"the residual of {self.name} must be real; give real and imaginary part as two fields")
        if not self.layout.backend.whole_fields:
            return cast(self.layout.backend.join(self.layout.space, parts), np.float64)
        lines = [anp.reshape(replicated(part), (-1,)) for part in parts]
        flat = lines[0] if len(lines) == 1 else anp.concatenate(lines) if lines else np.zeros(0)
        return cast(flat, np.float64)

    # ------------------------------------------------------------ products with J = dF/dx

    def tangent(self, x, values):
        """The function v -> J v."""
        return lambda v: push(lambda y: self(y, *values), x, [v])[1]

    def transposed(self, x, values):
        """The function g -> J^T g."""
        return pullback(lambda y: self(y, *values), x)[1]


# ---- the method ------------------------------------------------------------------------------------------------------


class Newton:
    """One solve of equation(x, *leaves) = 0.

    Parameters
    ----------
    equation : Equation
    leaves : tuple of plain arrays
    jacobians : Jacobians
    rtol : float
    maxiter : int
    run : Run
        Its figures are filled in.
    steps : bool
        Whether it is one of many solves of steps in time. Then the guess, the state before, is only taken for the
        root where it is one to rounding: what little changes in each of many short steps adds up. And a Jacobian
        may serve several Newton steps; of larger systems it always may.
    """

    def __init__(self, equation, leaves, jacobians, rtol, maxiter, run, steps=False):
        self.equation, self.leaves, self.jacobians = equation, leaves, jacobians
        self.rtol, self.maxiter, self.run = rtol, maxiter, run
        self.x: np.ndarray
        self.F: Any = None
        self.size = 0.0  # |F|, of several fields each in units of the terms that it is the sum of
        self.units: Any = 1.0  # of each number of F
        self.steps, self.keeps = steps, steps or equation.size > DENSE_UP_TO
        self.J: Any = None
        self.stale = False  # whether J is that of an earlier iterate
        self.largest: Any = 0.0  # residual met, of each field
        self.stalls = 0  # Newton steps on end that left nearly all of the residual
        self.near: Any = None  # the engine of the last Jacobian, where its LU is worth another try
        # Whether pseudo-time may be tried: once, and where one process knows all rows of the Jacobian.
        self.evolves = equation.layout.backend.whole_fields and not steps

    def solve(self, guess, known=None):
        """From a guess to a root, the first steps with the Jacobian `known` where there is one.

        Raises ConvergenceError with the best iterate.
        """
        self.x, self.F = self.start = guess, self._first(guess)
        self.size = self._measure(self.F)
        word, forcing = "" if np.any(self.F) else "converged", LOOSEST
        if not word:
            if known is None:
                self._linearise()
            else:
                self.J, self.stale = known, True
            word = self._accepted(0.0 if self.steps else 1.0)
        while not word:
            before = self.size
            if self.run.iterations == self.maxiter:
                self._fail("max_iterations")
            step = self._step(forcing)
            if self._moved(step):
                self.run.iterations += 1
                word, forcing = self._after(self.size / before, forcing)
            elif self.stale or self.jacobians.suspected(self.J):
                self._linearise()
            else:
                word = self._rounding(step)
                if not word and not self._evolved():
                    self._fail("stagnated")
                word = word or self._accepted()
        self.run.status = word
        return self.x

    def _after(self, ratio, forcing):
        """The status word after a step that left the share `ratio`, and how closely the next one is solved for."""
        fresh, self.stale = not self.stale, True
        word = self._accepted(1.0 if fresh else FURTHER)
        if word or self._keeps(ratio):
            return word, LOOSEST
        if ratio > SLOW and fresh:
            self.jacobians.suspected(self.J)
        self.stalls = self.stalls + 1 if ratio > STALLED and fresh else 0
        if self.stalls >= STALLS and self._evolved():
            return self._accepted(), LOOSEST
        self._linearise()
        return "", float(np.clip(0.9 * ratio**2, self.rtol, LOOSEST)) if fresh else LOOSEST

    def _keeps(self, ratio):
        """Whether the Jacobian is good enough for the rest of the way."""
        if not self.keeps or ratio > KEPT or not self.run.residual > 0:
            return False
        left = np.log(FURTHER * self.rtol / self.run.residual) / np.log(ratio)
        return bool(left <= MOST_KEPT)

    def _first(self, guess):
        name = self.equation.name
        try:
            check_finite(f"the guess of {name}", guess)
            self.equation.check_finite(self.leaves)
            F = self.equation.layout.tried(self.equation.value, guess, self.leaves)
            check_finite(f"the residual of {name} at the guess", F)
        except NonFiniteError:
            self.run.status = "nonfinite_input"
            raise
        return F

    # ------------------------------------------------------------ one step

    def _lean(self, solver):
        """Jacobians to come shall try the LU of this one."""
        factored = getattr(solver.engine, "inner", solver.engine) is not None  # else substitution solves all of it
        if factored and solver.system.size >= NEAR_FROM and solver.engine.method == "direct" and not self.steps:
            self.near = solver.engine

    def _linearise(self):
        try:
            self.J, self.stale = self.jacobians.fresh(self.equation, self.x, self.leaves, self.near), False
            self._lean(self.J.solver)
            self._weigh()
        except ConvergenceError as error:
            self._fail(
                "setup_failed",
                f"its Jacobian has no inverse there: {error}; start from another guess, or fix a constant "
                "that is free (of a pressure p: add pin * p, pin 1 in one cell, to its equation)",
            )

    def _weigh(self):
        """Units for the residual of several fields: the sizes of the terms of each, at this Jacobian."""
        if len(self.equation.layout.shapes) > 1:
            sizes = self._sizes()[2]
            sizes[sizes == 0] = np.max(sizes) or 1.0  # a field that is 0 and solved: in the units of the others
            self.units = self.equation.layout.spread(1 / sizes)
            self.size = self._measure(self.F)

    def _measure(self, F):
        return length(F * self.units)

    def _step(self, forcing):
        try:
            return self.J.step(self.F, forcing)
        except ConvergenceError as error:
            self._fail("setup_failed", f"its Newton step cannot be found: {error}")

    def _moved(self, step):
        """Go along the step, half of it, a quarter ... until the residual falls. False: it never does."""
        share = 1.0
        for _ in range(HALVINGS):
            x = self.x + share * step
            if np.array_equal(x, self.x):
                return False
            F = self._value(x)
            size = np.inf if F is None else self._measure(F)
            if F is not None and size <= (1 - DECREASE * share) * self.size:
                self.x, self.F, self.size = self._at_zero(x, F, size)
                return True
            share /= 2
        return False

    def _at_zero(self, x, F, size):
        """Iterates that shrink to 0 have no scale of their own: 0 itself is tried."""
        if size and length(x) <= TINY * length(self.x):
            at_zero = self._value(np.zeros_like(x))
            if at_zero is not None and not np.any(at_zero):
                return np.zeros_like(x), at_zero, 0.0
        return x, F, size

    def _value(self, x):
        """The residual at a trial point, or None where there is none."""
        try:
            F = self.equation.layout.tried(self.equation.value, x, self.leaves)
        except (UnstableStepError, NonFiniteError, ConvergenceError):
            return None
        return F if np.all(np.isfinite(F)) else None

    # ------------------------------------------------------------ pseudo-time

    def _evolved(self):
        """Steps in pseudo-time from the guess, once. False: they lead nowhere, and x is left as it was."""
        if not self.evolves:
            return False
        before = self.x, self.F, self.size
        (self.x, self.F), self.evolves, pace = self.start, False, FIRST
        note(self.equation.name, "method", "pseudo-time, as Newton steps stalled")
        self.size = first = self._measure(self.F)
        while SHORTEST <= pace <= LONGEST and self.run.iterations < self.maxiter:
            self.run.iterations += 1
            pace *= self._flow(pace, RISE * first)
        if pace > LONGEST:
            self._linearise()
            return True
        self.x, self.F, self.size = before
        return False

    def _flow(self, pace, most):
        """One step in pseudo-time -> by how much the next one should be longer; 0: there can be none."""
        try:
            solver = self.jacobians.relaxed(self.equation, self.x, self.leaves, pace, self.near)
            if solver is None:
                return 0.0
            self._lean(solver)
            x = self.x + solver.approximate(-self.F, LOOSEST)
        except ConvergenceError:
            return 0.25
        F = self._value(x)
        if F is None or not self._measure(F) <= most:
            return 0.25
        self.x, self.F, before, self.size = x, F, self.size, self._measure(F)
        return GROWTH if before >= GROWTH * self.size else max(before / self.size, 0.5)

    # ------------------------------------------------------------ the verdict

    def _accepted(self, share=1.0):
        """The status word, or "" while x is not accepted; `share` of the tolerance."""
        if not self.size:
            self.run.residual = self.run.backward_error = 0.0
            return "converged"
        residual, data, size = self._sizes()
        whole = length(data)
        self.run.residual = length(residual) / whole if whole else 1.0
        self.run.backward_error = length(residual) / length(size)
        self.largest = np.maximum(self.largest, residual)
        if not np.all(np.isfinite(size)):
            return ""
        enough = residual <= share * self.rtol * data
        if enough.all():
            return "converged"
        return "converged_at_roundoff" if np.all(enough | (residual <= ROUNDING * size)) else ""

    def _sizes(self):
        """|F|, |b| and |J| |x| + |b| of each field."""
        with np.errstate(over="ignore", invalid="ignore"):
            norms, J = self.equation.layout.norms, self.J
            data = norms(J.product(self.x) - self.F)
            return norms(self.F), data, norms(J.magnitude(np.abs(self.x))) + data

    def _rounding(self, step):
        """The status word when what is left of F is rounding, else ""."""
        residual, _, size = self._sizes()
        size = size + self.largest + self.equation.layout.norms(self._terms())
        far = self._value(self.x + FAR * step)
        if far is None or not np.all(residual <= 8 * ROUNDING * size):
            return ""
        predicted = (1 - FAR) * self.F
        if length(far - predicted) > 0.05 * length(predicted):
            return ""
        self.run.backward_error = length(residual) / length(size)
        return "converged_at_roundoff"

    def _terms(self):
        """F_p p: the sum of the terms of F in its parameters, each as often as its degree."""
        if not self.leaves:
            return np.zeros_like(self.x)
        return push(lambda leaves: self.equation(self.x, *leaves), list(self.leaves), self.leaves)[1]

    def _fail(self, word, reason=""):
        run, name = self.run, self.equation.name
        run.status = word
        residual = number_beside(run.residual, self.rtol, digits=1, style="e")
        reached = f"relative residual {residual}, wanted {self.rtol:g} ({word})"
        hint = self.jacobians.hint(self.J) if self.J is not None else ""
        if word == "stagnated" and self.J.singular:
            hint += "; its Jacobian is singular there, start from another guess or fix what is free by a constant"
        elif not (reason or hint or self.steps):
            hint = "; start from the solution for nearby parameters, or raise maxiter"
        raise ConvergenceError(
            f"{name} after {run.iterations} Newton steps: {reason or reached}{hint}",
            info=run.info(),
            best=self.equation.layout.rounded(self.x),
        ) from None
