"""stepper(): a step for time loops from a rate of change and a method; and the largest stable explicit step."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse.linalg import ArpackError, eigsh

from sparsedp._utils.calls import advice_near, public
from sparsedp._utils.pytree import copied, labels, leaves
from sparsedp._utils.reconstruction import Reconstructible
from sparsedp._utils.validation import (
    advise,
    check_choice,
    check_finite,
    check_leaves,
    check_number,
    number_beside,
    rounded_down,
)
from sparsedp.autodiff.derivative import is_finite
from sparsedp.autodiff.tape import is_variable, plain
from sparsedp.errors import NonFiniteError, UnstableStepError
from sparsedp.integrators.problem import Problem, check_pair, like, real_number
from sparsedp.integrators.runge_kutta import (
    EXPLICIT,
    IMPLICIT,
    Explicit,
    Linear,
    Nonlinear,
    Polynomial,
    Scheme,
)
from sparsedp.solvers.choose_method import check_settings
from sparsedp.solvers.separable import compute_spectrum

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from sparsedp.integrators.adaptive import Adaptive
    from sparsedp.solvers.choose_method import SolveSettings

__all__ = ["METHODS", "Step", "stepper"]

# The arguments that each method does not use; further options are for the methods of IMPLICIT.
UNUSED = {
    **dict.fromkeys(EXPLICIT, ("jacobian", "damping")),
    **dict.fromkeys((*IMPLICIT, "radau"), ("damping",)),
    "etdrk4": ("jacobian", "damping"),
    "leapfrog": ("linear", "source", "timed", "tolerance", "max_step", "breaks", "events", "jacobian"),
}
METHODS = tuple(UNUSED)
KEPT = 2  # set-ups of linear steps
KEPT_WITH_TOLERANCE = 12  # with error control
ROUNDING = 1e-12  # a step at the limit may lie beyond it by rounding
DENSE_UP_TO = 64


def stepper(
    method: str,
    rate: Any = None,
    dt: Any = None,
    *,
    linear: Any = None,
    source: Callable | None = None,
    timed: bool | None = None,
    tolerance: float | None = None,
    floor: Any = None,
    max_step: float | None = None,
    breaks: Sequence[float] | Callable[[Any], Any] | None = None,
    events: Any = None,
    unstable: str = "raise",
    jacobian: Callable | None = None,
    damping: Any = None,
    solver: str = "auto",
    rtol: float = 1e-10,
    maxiter: int | None = None,
    **options: Any,
) -> Step:
    """Return a step for time loops: the state after a time dt, differentiable in state, params and dt.

    Parameters
    ----------
    method : str
        ======================= ===== ==============================================================
        euler heun ssprk3 rk4   1-4   explicit: cheap where nothing is stiff
        backward_euler          1     L-stable: any dt, stiff components decay
        crank_nicolson          2     any dt, but stiff components keep their size and change sign (they ring)
        tr_bdf2                 2     L-stable, two stages with one factor
        imex                    2     `linear` and source implicit (L-stable), the rate explicit
        radau                   5     L-stable, full LU: for stiff systems of up to 500 unknowns, best with a tolerance
        etdrk4                  4     `linear` exact by transforms (separable operators), the rate explicit
        leapfrog                2     waves: two fields, each moved by the other, half a step apart; reversible
        ======================= ===== ==============================================================
    rate : callable or Operator
        u' = ``rate(u, params)``, or ``rate(u, params, t)``: then the state is the pair (u, t). Written with
        autograd.numpy, Operators and other rules; u an array or a tree of arrays. An Operator L means
        u' = c L u, with the number c >= 0 as params (None: 1). Values that change from call to call belong into
        params: implicit methods run the rate again in the backward pass.
        leapfrog: a pair of rates, p' = ``f(q, params)`` and q' = ``g(p, params)``, for the state (p, q): p at the
        times of the steps, q half a step before, on entry and on return.
    dt : float, traced number, or function of params
        Length of a step [time], > 0. To differentiate in dt inside a loop write ``lambda params: params["dt"]``.
    linear : Operator or (Operator, coefficient), or a tree of these like the state, optional
        A term c L u beside the rate; `coefficient` is a number >= 0 or a function of params. Each field of a tree has
        its own, or None (or 0): ``{"u": (L, 0.1), "v": (L, lambda p: p["D"]), "w": None}``. A pair with a number is one
        term, so for a state of two fields, the second without one, write ``[L, None]``. Also L may be ``-1.0 * L @ L``,
        a `function` of an operator, or a `diagonal`. Set-ups are shared by fields with the same L and c.
    source : callable, optional
        ``source(params)`` or ``source(params, t)``: a term that does not depend on u, such as nu D(B(values)) of walls
        that move, with B a `lift`; implicit methods keep their order with it, imex and etdrk4 too. A problem of
        operator and source only is linear: one set-up for each c dt serves all stages, steps and adjoint solves.
    timed : bool, optional
        Whether rate or source takes the time; default: by its number of arguments.
    tolerance : float, optional
        Error control: dt is an interval, crossed in as many steps as keep the relative error of each below
        this; `step.taken` lists them. Derivatives are controlled too: right to about this, or refused. Jumps of the
        rate are looked for; values across them meet the tolerance, and derivatives are refused without `breaks` or
        `events`.
    floor : number or tree like u, optional
        Errors are relative to |u| + floor. Default: a tenth of the largest entry of each array. An array that
        decays to zero is then resolved at every size, in many steps: give the size below which it no longer
        matters. Where entries of very different size matter (species of 1 and 1e-5), give one for each. An array that
        stays 0 until its rate sets in needs a floor, or that time in `breaks`. In a tree
        entries of dicts are paired by key, and a number or None may stand for a whole branch.
    max_step : float, optional
        Longest step that error control may take. Shorten it where something brief (a pulse, a spike of the rate) could
        fall between two evaluations of the rate.
    breaks : sequence of float, or callable, optional
        Times at which the rate, or its derivative, jumps; or ``breaks(params)``, which returns such times. Steps end
        there, and the rate is evaluated at the last time before a break and at the first one after it, so that
        ``np.where(t < params["off"], 1.0, 0.0)`` has the intended value on both sides. Times returned by a function are
        differentiated. Any order; times outside of the interval (t, t + dt] and repeated constants are ignored. Needs
        a tolerance. The state is the pair (u, t).
    events : callable, pair (callable, jump), or list of these, optional
        Functions ``event(u, params)`` or ``event(u, params, t)`` whose zeros are located, and stop a step. The step
        then goes on with the state that ``jump(u, params)`` or ``jump(u, params, t)`` returns, and without a jump with
        the state as it is: for a rate that switches where the event is 0. Two attributes of the function, as of
        SciPy's `solve_ivp`: ``event.terminal = True`` ends the interval there, so that the time returned beside
        the state is the time of the event; with ``event.direction`` > 0 (< 0) only zeros from negative to positive
        (from positive to negative) count. Needs a tolerance. The state is the pair (u, t).
    unstable : "raise" or "allow"
        Explicit steps of an Operator whose spectrum is known, and leapfrog, for which it is estimated once for each
        content of dt and params: refuse a dt beyond the stable limit, or take it.
    jacobian : callable, optional
        ``jacobian(u, params)`` (or with t): the derivative of the rate in u, for implicit steps of a
        nonlinear rate. Default: found by colouring; by radau from one tape, for Newton's method alone.
    damping : pair, optional
        Of leapfrog: the rates at which both fields decay [1 / time], such as `sponge` returns; None for none.
    solver, rtol, maxiter, **options
        `method`, tolerance and options of `inverse` (linear problems) or `implicit` (nonlinear ones).

    Returns
    -------
    Step
        ``step(state, params=None)``; with an input of `rollout`, ``step(state, params, input)``: the rate gets
        the pair (params, input) as params. `step.info` holds the records of its solves.

    Raises
    ------
    ValueError
        If the method or a setting is unknown, dt <= 0, or a coefficient is negative.
    TypeError
        If rate, linear or source has another type; on use, if `linear` is not a tree like the state.
    NonFiniteError
        If dt, state or params holds NaN or infinity, or the new state would.
    UnstableStepError
        On use, if an explicit step is beyond the stable limit of the operator, or one of leapfrog beyond its own; or if
        the operator of an implicit one makes fields grow faster than the step can follow, as -laplacian does.
    ConvergenceError
        On use, if a solve fails, or no step meets the tolerance, or an event occurs again and again at one time.
    DerivativeError
        On use of a derivative, if the tolerance is too coarse for it; if the rate jumps where there is neither a break
        nor an event, or changes faster than the steps resolve; if an event grazes its surface, so that its time
        has no derivative; if two differentiated breaks coincide.

    See Also
    --------
    implicit, matrix_exponential, conservation_law, sponge, rollout

    Notes
    -----
    Arguments by method. One that the method does not use is refused.

    ==================================  ===========  ================================================================
    arguments                           default      methods
    ==================================  ===========  ================================================================
    linear, source, timed, tolerance    None         all but leapfrog; imex and etdrk4 need `linear`
    max_step, breaks, events            None         all but leapfrog; they need a tolerance
    floor                               None         all; it has an effect with a tolerance
    unstable                            "raise"      all; it has an effect on euler, heun, ssprk3, rk4, leapfrog
    jacobian                            None         backward_euler, crank_nicolson, tr_bdf2, radau; no effect on imex
    damping                             None         leapfrog
    solver                              "auto"       all; radau takes "auto" and "direct" alone
    rtol, maxiter                       1e-10, None  all; they have an effect on solves
    options of `inverse` or `implicit`  none         backward_euler, crank_nicolson, tr_bdf2, imex
    ==================================  ===========  ================================================================

    Formula: derivatives are those of the discrete step. A linear stage x of (1 - z L) x = b, z = c dt, has
    b_bar = y, z_bar = y . L x with (1 - z L)^T y = g; a nonlinear one is a root, see `implicit`.
    A coefficient of 0 leaves the state as it is, bit for bit, without set-up or solve.
    With a tolerance each step is extrapolated from two half steps and a whole one (not crank_nicolson), and its length
    follows fast changes of a continuous rate whose time moves with the params. The rate is also evaluated at the ends
    and in the middle of each step, and if it takes the time, at about 200 times in an interval at most: a step across a
    jump or a pulse is shortened. The derivative belongs to these steps; the contribution of the extrapolation to
    it, relative to the params and to its largest entry, must stay below 6 tolerance^(p / (p + 1)), p the
    order (crank_nicolson: below 10 tolerance). Derivatives that are small because terms cancel may be refused, too.
    radau compares with an embedded formula instead (p = 3 in that bound), and has first derivatives only.
    Cost: n linear steps and their gradient take one set-up and 2 n solves (tr_bdf2: 4 n). With a tolerance a gradient
    takes about six times the steps of its value: three times as long as without this check. radau takes three
    Jacobians for the derivative of a step, those of many steps together, and one rule on the tape for an interval: a
    gradient takes 1.5 to 3.2 times the time of its value, and 3 to 5 times where the rate is written for vectors.
    Breaks and events: with f_- and f_+ the rates before and after a break b, du/db = f_- - f_+ there. The time of an
    event g = 0 has the derivative of the implicit function theorem, -(g_u du + g_p dp + g_t dt) / (g_u f + g_t), of
    the step that ends there, located by Brent's method to rounding (implicit methods: to `rtol`). All orders, and in
    rollouts under any memory; radau: first derivatives. Zeros that an event has twice within a step are found where
    the values at the start, the middle and the end of the step show a dip. After a terminal event the next step of a
    rollout goes on from the state and time returned. `step.t_events` lists the times of the last interval, constants:
    a time has a derivative if a terminal event returns it, or a jump writes it into the state.
    Ranks: fields in blocks too (`distribute`), not by radau and etdrk4; nonlinear implicit steps within the limits of
    `implicit`: no `sparsity`.

    References
    ----------
    E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I (1993); E. Hairer, G. Wanner, Solving
    Ordinary Differential Equations II (1996). The modules of this package name the papers of each method.

    Examples
    --------
    >>> import numpy as np
    >>> from sparsedp import Grid, dirichlet, laplacian, value_and_grad
    >>> step = stepper("backward_euler", laplacian(Grid(2), dirichlet), 0.25)  # eigenvalue -2 of (1, 1)
    >>> value_and_grad(lambda nu: step(np.array([3.0, 3.0]), nu)[0])(2.0)
    (1.5, -0.375)

    A source that is switched off at a time; a ball from a height h, and when it lands:

    >>> import autograd.numpy as anp
    >>> heating = lambda u, off, t: anp.where(t < off, 1.0, 0.0)
    >>> step = stepper("rk4", heating, 2.0, tolerance=1e-6, breaks=lambda off: [off])
    >>> u, slope = value_and_grad(lambda off: step((0.0, 0.0), off)[0])(0.5)
    >>> round(u, 12), round(slope, 12)
    (0.5, 1.0)
    >>> ground = lambda u, g, t: u[0]
    >>> ground.terminal = True
    >>> fall = stepper("rk4", lambda u, g, t: anp.array([u[1], -g]), 9.0, tolerance=1e-6, events=ground)
    >>> t, slope = value_and_grad(lambda h: fall((anp.array([h, 0.0]), 0.0), 10.0)[1])(5.0)
    >>> round(t, 12), round(slope, 12)
    (1.0, 0.1)
    """
    arguments = copied(locals())  # the caller may reuse the arrays
    check_choice("method", method, METHODS, "; write stepper('rk4', rate, dt)" if callable(method) else "")
    check_choice("unstable", unstable, ("raise", "allow"))
    for word in options:
        if method not in IMPLICIT:
            near = advice_near(word, [name for name in arguments if name not in ("options", *UNUSED[method])])
            raise TypeError(f"{method} does not use {word}{near or '; leave it out'}")
    settings = _solver_settings(solver, rtol, maxiter, arguments["options"])
    unused = [word for word in UNUSED[method] if arguments[word] is not None]
    if method == "radau" and solver not in ("auto", "direct"):
        unused.append("solver")  # full systems are solved by LU
    if unused:
        raise TypeError(f"{method} does not use {', '.join(unused)}; leave it out")
    _check_interruptions(arguments)
    if tolerance is not None:
        check_number("tolerance of stepper", tolerance, "between 0 and 1", "; write for example 1e-6")
    if not all(map(_is_floor, leaves(floor))):
        raise ValueError(f"floor must hold finite numbers >= 0, in the units of u, got {floor!r}; write 1e-3")
    if not callable(dt):
        dt = real_number(dt, "dt", "> 0")
    scheme = _scheme(method, arguments, settings)
    limits = []
    if method in EXPLICIT and tolerance is None and unstable == "raise":
        limits = [(term, largest_step(term.op, EXPLICIT[method].reach)) for term in scheme.problem.stiff]
    return Step(method, dt, scheme, limits, arguments)


def _solver_settings(solver: str, rtol: float, maxiter: int | None, options: dict) -> SolveSettings:
    """Return the settings of solves; `implicit` alone takes the option sparsity."""
    checked = {word: value for word, value in options.items() if word != "sparsity"}
    return replace(check_settings(solver, rtol, maxiter, "raise", checked), options=options)


def _check_interruptions(arguments: dict) -> None:
    """Refuse options of error control without a tolerance, and a longest step that is not positive."""
    for word in ("max_step", "breaks", "events"):
        if arguments[word] is not None and arguments["tolerance"] is None:
            raise TypeError(f"{word} needs steps with error control; write tolerance=1e-6")
    if arguments["max_step"] is not None:
        advice = "; write the longest step, in the units of dt"
        check_number("max_step of stepper", arguments["max_step"], "> 0", advice)
    for word in ("breaks", "events"):
        if arguments[word] is not None and arguments["timed"] is False:
            raise TypeError(f"{word} needs the time in the state; leave timed out, and give the state (u, t)")


def _is_floor(leaf: Any) -> bool:
    """Whether a leaf of the floor is None, the default, or holds finite numbers >= 0."""
    if leaf is None:
        return True
    value = np.asarray(leaf)
    return value.dtype.kind in "fiu" and bool(np.all((value >= 0) & (value < np.inf)))


def _rebuilt(arguments: dict) -> Step:
    """Return the step of the arguments of `stepper`."""
    named = {word: value for word, value in arguments.items() if word != "options"}
    return stepper(**named, **arguments["options"])


def _scheme(method: str, arguments: dict, settings: SolveSettings) -> Any:
    """Return the scheme of a method; modules that only some methods need are imported for those alone."""
    if method == "leapfrog":
        from sparsedp.integrators.leapfrog import Leapfrog

        return Leapfrog(arguments["rate"], arguments["damping"])
    timed = arguments["timed"]
    if arguments["breaks"] is not None or arguments["events"] is not None:
        timed = True
    problem = Problem(arguments["rate"], arguments["linear"], arguments["source"], timed)
    tolerance = arguments["tolerance"]
    floor = arguments["floor"]
    max_step = arguments["max_step"]
    if method == "radau":
        from sparsedp.integrators.radau import Radau

        radau = Radau(problem, arguments["jacobian"], tolerance, floor, settings, max_step)
        return _with_interruptions(radau, arguments)
    scheme = _fixed_scheme(method, problem, arguments["jacobian"], settings, tolerance is not None)
    if tolerance is None:
        return scheme
    from sparsedp.integrators.adaptive import Adaptive

    return _with_interruptions(Adaptive(scheme, float(tolerance), floor, max_step), arguments)


def _fixed_scheme(
    method: str, problem: Problem, jacobian: Callable | None, settings: SolveSettings, has_tolerance: bool
) -> Scheme:
    """Return a scheme without error control."""
    if method in ("imex", "etdrk4") and not problem.stiff:
        raise TypeError(f"{method} needs the stiff linear term: write linear=L or linear=(L, coefficient)")
    if method in EXPLICIT:
        scheme: Any = Explicit
        if problem.linear and problem.source is None:
            scheme = Polynomial
            for term in problem.stiff:
                scheme = term.op.backend.implementation(scheme)
        return scheme(problem, method)
    if method == "etdrk4":
        from sparsedp.integrators.exponential import Exponential

        return Exponential(problem)
    if method == "imex" or problem.linear:
        return Linear(problem, method, settings, KEPT_WITH_TOLERANCE if has_tolerance else KEPT)
    return Nonlinear(problem, method, jacobian, settings)


def _with_interruptions(scheme: Adaptive, arguments: dict) -> Any:
    """Return a scheme with error control that stops at breaks and events, where there are any."""
    breaks = arguments["breaks"]
    events = arguments["events"]
    if breaks is None and events is None:
        return scheme
    from sparsedp.integrators.events import break_times, event_list
    from sparsedp.integrators.interruptions import Interrupted

    times = break_times(() if breaks is None else breaks)
    return Interrupted(scheme, times, event_list([] if events is None else events))


class Step(Reconstructible):
    """A time step, as `stepper` returns it: ``step(state, params)`` is the state after a time dt.

    Parameters
    ----------
    method : str
    dt : number, traced number, or function of params
    scheme : Scheme
        ``scheme(u, params, t, h)``: the state after a step h.
    limits : list of pairs
        A term c L, and the largest stable h c of an explicit step.
    arguments : dict
        Of `stepper`.

    Attributes
    ----------
    order : int
        Of accuracy in time.
    info : SolveLog or None
        Records of the last solves and set-up.
    taken : list of float
        With error control: the accepted lengths of the last interval, as shares of it.
    t_events : list of arrays
        With events: for each one its times in the last interval, without a derivative.
    """

    def __init__(self, method: str, dt: Any, scheme: Any, limits: Sequence, arguments: dict) -> None:
        self.method = method
        self.dt = dt
        self.scheme = scheme
        self.problem = scheme.problem
        self.limits = limits
        self.arguments = arguments
        self.name = f"stepper({method})"
        self.order: int = scheme.order
        self.info = scheme.info
        self.is_interrupted = arguments["breaks"] is not None or arguments["events"] is not None
        self.made = _rebuilt, (arguments,)

    @property
    def taken(self) -> list[float]:
        """Return the accepted lengths of the last interval, as shares of it."""
        return getattr(self.scheme, "taken", [1.0])

    @property
    def t_events(self) -> list[np.ndarray]:
        """Return the times of each event in the last interval."""
        return getattr(self.scheme, "t_events", [])

    @public("dp.stepper(method, rate, dt)")
    def __call__(self, state: Any, params: Any = None, *inputs: Any) -> Any:
        """Take one step.

        Parameters
        ----------
        state : array or tree u, or the pair (u, t) where the rate takes a time
        params : tree
        *inputs : tree, optional
            Of this step; the rate then gets the pair (params, input) as its params.

        Returns
        -------
        tree
            The new state, in the form of the old one.
        """
        first_params = params
        if inputs:
            params = (params, *inputs)
        u, t = self._parts(state)
        check_leaves(f"state of {self.name}", u, containers=False)
        check_leaves(f"params of {self.name}", params, containers=False)
        h = self._length(params)
        if self.problem.stiff:
            self.problem.terms(u)  # refuses another tree before anything is solved
        for term, largest in self.limits:
            self._check_stable(float(plain(h)), float(plain(term.coefficient(params))), term.op.name, largest)
        end = None
        try:
            new = self.scheme(u, params, t, h)
            if self.is_interrupted:
                new, end = new
            new = like(new, u)
        except NonFiniteError as error:  # perhaps from a solver: name the argument
            self._refuse_nonfinite(state, params)
            # The argument of a solve is a rate or a stage of this step: the state of the step itself is finite.
            if str(error).startswith(f"{self.name} takes finite numbers"):
                raise NonFiniteError(self._overflow(h)) from error
            raise
        except TypeError as error:
            advise(error, params, "step(state, params)")
            raise
        if not all(is_finite(leaf) for leaf in leaves(new) if is_variable(leaf)):
            self._refuse_nonfinite(state, params)
            raise NonFiniteError(self._overflow(h))
        if self.method == "leapfrog" and self.arguments["unstable"] == "raise":
            self.scheme.check_stable(u, params, h, first_params)
        if not self.problem.timed:
            return new
        return new, end if self.is_interrupted else t + h

    def back(self, state: Any, params: Any = None, *inputs: Any) -> Any:
        """Return the state before a step of leapfrog without damping, to rounding.

        Parameters
        ----------
        state, params, *inputs
            As for the step itself; `state` is what it returned.
        """
        self.check_reversible()
        if inputs:
            params = (params, *inputs)
        return like(self.scheme.back(state, params, self._length(params)), state)

    def _overflow(self, h: Any) -> str:
        return (
            f"{self.name} got NaN or infinity from a finite state with dt = {float(plain(h)):.6g}; "
            "take smaller steps or an implicit method"
        )

    def _length(self, params: Any) -> Any:
        if callable(self.dt):
            return real_number(self.dt(params), "dt", "> 0")
        return self.dt

    def check_reversible(self) -> None:
        """Refuse a step that `back` cannot reverse."""
        if self.method != "leapfrog":
            raise ValueError(f"{self.name} cannot be reversed; write 'leapfrog'")
        self.scheme.check_reversible()

    def _check_stable(self, h: float, c: float, name: str, largest: float) -> None:
        """Refuse a step that would grow without bound."""
        if h * c > largest * (1 + ROUNDING):
            most = rounded_down(largest / c)
            shown = number_beside(h, float(most), digits=12)
            raise UnstableStepError(
                f"{self.method} is unstable for {name} with dt = {shown}: the largest stable dt is "
                f"{most}; take smaller steps or an implicit method, or write unstable='allow'"
            )

    def _parts(self, state: Any) -> Any:
        """Return u and the time t, which is None where nothing depends on it."""
        if not self.problem.timed:
            return state, None
        return check_pair(f"the state of {self.name}, whose rate takes a time,", state, "(u, t)")

    def _refuse_nonfinite(self, state: Any, params: Any) -> None:
        """Refuse arguments that are not finite."""
        for what, tree in (("state", state), ("params", params)):
            for place, leaf in zip(labels(tree, what), leaves(tree), strict=True):
                if is_variable(leaf):
                    check_finite(f"{place} of {self.name}", np.asarray(plain(leaf)))

    def __repr__(self) -> str:
        if callable(self.dt):
            length = "given by the params"
        else:
            length = f"{float(plain(self.dt)):g}"
        return f"<{self.name}: order {self.order}, dt {length}>"


def largest_step(op: Any, reach: float) -> float:
    """Return the largest stable h c of an explicit step for u' = c L u.

    It comes from the eigenvalues of a sum of 1-D factors, else, where L has symmetric entries, from its least
    eigenvalue. Of other operators nothing is known, and any step is allowed.

    Parameters
    ----------
    op : Operator
        L.
    reach : float
        Length of the stable interval of the method on the negative real axis.
    """
    least = least_eigenvalue(op)
    if least is not None and least < 0:
        return reach / -least
    return np.inf


def least_eigenvalue(op: Any) -> float | None:
    """Return the most negative eigenvalue of an operator with real ones, or None if it is not known."""
    if op.dtype.kind == "c":
        return None
    if op.separable:
        factors = compute_spectrum(op.structure)
        if factors is not None:
            return float(np.min(factors.eigenvalues))
    if not op.structure.has_entries:
        return None
    matrix = op.matrix
    n = op.shape[0]
    if n and abs(matrix - matrix.T).max() > 1e-14 * abs(matrix).max():
        return None
    if n <= DENSE_UP_TO:
        return float(np.min(np.linalg.eigvalsh(matrix.toarray()), initial=0.0))
    start = np.random.default_rng(0).standard_normal(n)  # the same bits in every run
    try:
        return float(eigsh(matrix, 1, which="SA", v0=start, tol=1e-3, return_eigenvectors=False)[0])
    except ArpackError:
        return None
