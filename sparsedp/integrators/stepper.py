"""stepper(): a rate of change and a method -> a step for time loops; and how large an explicit one may be."""

import numpy as np
from scipy.sparse.linalg import ArpackError, eigsh

from sparsedp._utils.calls import advice_near, public
from sparsedp._utils.pytree import copied, labels, leaves
from sparsedp._utils.reconstruction import Remade
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

__all__ = ["METHODS", "Step", "stepper"]

# Of each method the arguments that it does not use; options are for those that are IMPLICIT.
UNUSED = {
    **dict.fromkeys(EXPLICIT, ("jacobian", "damping")),
    **dict.fromkeys((*IMPLICIT, "radau"), ("damping",)),
    "etdrk4": ("jacobian", "damping"),
    "leapfrog": ("linear", "source", "timed", "tolerance", "max_step", "breaks", "events", "jacobian"),
}
METHODS = tuple(UNUSED)
KEPT = {False: 2, True: 12}  # set-ups of linear steps, without and with error control
ROUNDING = 1e-12  # a step at the limit may lie beyond it by rounding
DENSE_UP_TO = 64


def stepper(
    method,
    rate=None,
    dt=None,
    *,
    linear=None,
    source=None,
    timed=None,
    tolerance=None,
    floor=None,
    max_step=None,
    breaks=None,
    events=None,
    unstable="raise",
    jacobian=None,
    damping=None,
    solver="auto",
    rtol=1e-10,
    maxiter=None,
    **options,
):
    """Rate of change -> step(state, params): the state after a time dt, differentiable in everything.

    Parameters
    ----------
    method : str
        ======================= ===== ==============================================================
        euler heun ssprk3 rk4   1-4   explicit: cheap where nothing is stiff
        backward_euler          1     L-stable: any dt, what is stiff dies out
        crank_nicolson          2     any dt, but what is stiff keeps its size and changes sign (it rings)
        tr_bdf2                 2     L-stable, two stages with one factor
        imex                    2     `linear` and source implicit (L-stable), the rate explicit
        radau                   5     L-stable, full LU: for stiff systems of up to 500 unknowns, best with a tolerance
        etdrk4                  4     `linear` exact by transforms (what is made of a box), the rate explicit
        leapfrog                2     waves: two fields, each moved by the other, half a step apart; reversible
        ======================= ===== ==============================================================
    rate : callable or Operator
        u' = ``rate(u, params)``, or ``rate(u, params, t)``: then the state is the pair (u, t). Written with
        autograd.numpy, Operators and other rules; u an array or a tree of arrays. An Operator L means
        u' = c L u, with the number c >= 0 as params (None: 1). What changes from call to call belongs into params:
        implicit methods run the rate again on the way back.
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
        Errors are relative to |u| + floor. Default: a tenth of the largest entry of each array. What dies out with
        all of its array is then followed down to nothing, in many steps: give the size below which it no longer
        matters. Where entries of very different size matter (species of 1 and 1e-5), give one for each. An array that
        stays 0 until its rate sets in needs a floor, or that time in `breaks`. In a tree
        entries of dicts are paired by key, and a number or None may stand for a whole branch.
    max_step : float, optional
        Longest step that error control may take. Shorten it where something brief (a pulse, a spike of the rate) could
        fall between two evaluations of the rate.
    breaks : sequence of float, or callable, optional
        Times at which the rate, or its derivative, jumps; or ``breaks(params)``, which returns such times. Steps end
        there, and the rate is evaluated at the last time before a break and at the first one after it, so that
        ``np.where(t < params["off"], 1.0, 0.0)`` is meant as it stands. Times returned by a function are
        differentiated. Any order; times outside of the interval (t, t + dt] and repeated constants are ignored. Needs
        a tolerance. The state is the pair (u, t).
    events : callable, pair (callable, jump), or list of these, optional
        Functions ``event(u, params)`` or ``event(u, params, t)`` whose zeros are located, and stop a step. The step
        then goes on with the state that ``jump(u, params)`` or ``jump(u, params, t)`` returns, and without a jump with
        the state as it is: for a rate that switches where the event is 0. Two attributes of the function, as of
        SciPy's `solve_ivp`: ``event.terminal = True`` ends the interval there, so that the time returned beside
        the state is that of the event; ``event.direction`` > 0 (< 0) has only zeros from negative to positive (from
        positive to negative) count. Needs a tolerance. The state is the pair (u, t).
    unstable : "raise" or "allow"
        Explicit steps of an Operator whose spectrum is known, and leapfrog, for which it is estimated once for each
        content of dt and params: refuse a dt beyond the stable limit, or take it.
    jacobian : callable, optional
        ``jacobian(u, params)`` (or with t): the derivative of the rate in u, for implicit steps of a
        nonlinear rate. Default: found by colouring; by radau from one tape, for Newton's method alone.
    damping : pair, optional
        Of leapfrog: the rates at which both fields die out [1 / time], such as `sponge` makes; None for none.
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
        If rate, linear or source is not what it should be; on use, if `linear` is not like the state.
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

    Notes
    -----
    Formula: derivatives are those of the discrete step. A linear stage x of (1 - z L) x = b, z = c dt, has
    b_bar = y, z_bar = y . L x with (1 - z L)^T y = g; a nonlinear one is a root, see `implicit`.
    A coefficient of 0 leaves the state as it is, bit for bit, without set-up or solve.
    With a tolerance each step is extrapolated from two half steps and a whole one (not crank_nicolson), and its length
    follows fast changes of a continuous rate whose time moves with the params. The rate is also evaluated at the ends
    and in the middle of each step, and if it takes the time, at about 200 times in an interval at most: a step across a
    jump or a pulse is shortened. The derivative is that of these steps; what extrapolation takes
    away from it, relative to the params and to its largest entry, must stay below 6 tolerance^(p / (p + 1)), p the
    order (crank_nicolson: below 10 tolerance). Derivatives that are small because terms cancel may be refused, too.
    radau compares with an embedded formula instead (p = 3 in that bound), and has first derivatives only.
    Cost: n linear steps and their gradient take one set-up and 2 n solves (tr_bdf2: 4 n). With a tolerance a gradient
    takes about six times the steps of its value: three times as long as without the judgement. radau takes three
    Jacobians for the derivative of a step, those of many steps together, and one rule on the tape for an interval: a
    gradient takes 1.5 to 3.2 times the time of its value, and 3 to 5 times where the rate is written for vectors.
    Breaks and events: with f_- and f_+ the rates before and after a break b, du/db = f_- - f_+ there. The time of an
    event g = 0 has the derivative of the implicit function theorem, -(g_u du + g_p dp + g_t dt) / (g_u f + g_t), of
    the step that ends there, located by Brent's method to rounding (implicit methods: to `rtol`). All orders, and in
    rollouts under any memory; radau: first derivatives. Zeros that an event has twice within a step are found where
    the values at the start, the middle and the end of the step show a dip. After a terminal event the next step of a
    rollout goes on from the state and time returned. `step.t_events` lists the times of the last interval, constants:
    a time with a derivative is that of a terminal event, or one that a jump writes into the state.
    Ranks: fields in blocks too (`distribute`), not by radau and etdrk4; nonlinear implicit steps within the limits of
    `implicit`: no `sparsity`.
    Source: runge_kutta.py and radau.py name the papers.

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
    given = copied(locals())  # the caller may reuse the arrays
    check_choice("method", method, METHODS, "; write stepper('rk4', rate, dt)" if callable(method) else "")
    check_choice("unstable", unstable, ("raise", "allow"))
    known = {word: value for word, value in options.items() if word != "sparsity"}  # which `implicit` takes
    for word in options:
        if method not in IMPLICIT:
            near = advice_near(word, [name for name in given if name not in ("options", *UNUSED[method])])
            raise TypeError(f"{method} does not use {word}{near or '; leave it out'}")
    settings = check_settings(solver, rtol, maxiter, "raise", known) | dict(options=given["options"])
    unused = [word for word in UNUSED[method] if given[word] is not None]
    if method == "radau" and solver not in ("auto", "direct"):
        unused.append("solver")  # full systems are solved by LU
    if unused:
        raise TypeError(f"{method} does not use {', '.join(unused)}; leave it out")
    _check_interruptions(given)
    if tolerance is not None:
        check_number("tolerance of stepper", tolerance, "between 0 and 1", "; write for example 1e-6")
    if not all(map(_is_floor, leaves(floor))):
        raise ValueError(f"floor must hold finite numbers >= 0, in the units of u, got {floor!r}; write 1e-3")
    dt = dt if callable(dt) else real_number(dt, "dt", "> 0")
    scheme, limits = _scheme(method, given, settings), []
    if method in EXPLICIT and tolerance is None and unstable == "raise":
        limits = [(term, largest_step(term.op, EXPLICIT[method].reach)) for term in scheme.problem.stiff]
    return Step(method, dt, scheme, limits, given)


def _check_interruptions(given):
    """Refuse options of error control without it, and a longest step that is none."""
    for word in ("max_step", "breaks", "events"):
        if given[word] is not None and given["tolerance"] is None:
            raise TypeError(f"{word} needs steps with error control; write tolerance=1e-6")
    if given["max_step"] is not None:
        check_number("max_step of stepper", given["max_step"], "> 0", "; write the longest step, in the units of dt")
    for word in ("breaks", "events"):
        if given[word] is not None and given["timed"] is False:
            raise TypeError(f"{word} needs the time in the state; leave timed out, and give the state (u, t)")


def _is_floor(leaf):
    """Whether a leaf of the floor is a number, or numbers, that sizes are added to; None: the default."""
    if leaf is None:
        return True
    known = np.asarray(leaf)
    return known.dtype.kind in "fiu" and bool(np.all((known >= 0) & (known < np.inf)))


def _remade(given):
    return stepper(**{word: value for word, value in given.items() if word != "options"}, **given["options"])


def _scheme(method, given, settings):
    """What makes the steps; what few of them need is imported by those."""
    if method == "leapfrog":
        from sparsedp.integrators.leapfrog import Leapfrog

        return Leapfrog(given["rate"], given["damping"])
    interrupted = given["breaks"] is not None or given["events"] is not None
    timed = True if interrupted else given["timed"]
    problem = Problem(given["rate"], given["linear"], given["source"], timed)
    jacobian, tolerance, floor = given["jacobian"], given["tolerance"], given["floor"]
    max_step = given["max_step"]
    if method == "radau":
        from sparsedp.integrators.radau import Radau

        return _interrupted(Radau(problem, jacobian, tolerance, floor, settings, max_step), given)
    if method in ("imex", "etdrk4") and not problem.stiff:
        raise TypeError(f"{method} needs the stiff linear term: write linear=L or linear=(L, coefficient)")
    scheme: Scheme
    if method in EXPLICIT:
        plain = (
            problem.linear and problem.source is None and all(term.op.backend.whole_fields for term in problem.stiff)
        )
        scheme = (Polynomial if plain else Explicit)(problem, method)
    elif method == "etdrk4":
        from sparsedp.integrators.exponential import Exponential

        scheme = Exponential(problem)
    elif method == "imex" or problem.linear:
        scheme = Linear(problem, method, settings, KEPT[tolerance is not None])
    else:
        scheme = Nonlinear(problem, method, jacobian, settings)
    if tolerance is None:
        return scheme
    from sparsedp.integrators.adaptive import Adaptive

    return _interrupted(Adaptive(scheme, float(tolerance), floor, max_step), given)


def _interrupted(scheme, given):
    """A scheme with error control that stops at breaks and events, where there are any."""
    breaks, events = given["breaks"], given["events"]
    if breaks is None and events is None:
        return scheme
    from sparsedp.integrators.events import break_times, event_list
    from sparsedp.integrators.interruptions import Interrupted

    breaks = break_times(() if breaks is None else breaks)
    return Interrupted(scheme, breaks, event_list([] if events is None else events))


class Step(Remade):
    """step(state, params): the state after a time dt. Made by `stepper`.

    Parameters
    ----------
    method : str
    dt : number, traced number, or function of params
    scheme : Scheme
        ``scheme(u, params, t, h)``: the state after a step h.
    limits : list of pairs
        A term c L, and the largest stable h c of an explicit step.
    given : dict
        The arguments of `stepper`.

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

    def __init__(self, method, dt, scheme, limits, given):
        self.method, self.problem, self.dt, self.scheme, self.limits = method, scheme.problem, dt, scheme, limits
        self.name, self.given, self.order, self.info = f"stepper({method})", given, scheme.order, scheme.info
        self.interrupted = given["breaks"] is not None or given["events"] is not None
        self.made = _remade, (given,)

    @property
    def taken(self):
        return getattr(self.scheme, "taken", [1.0])

    @property
    def t_events(self):
        return getattr(self.scheme, "t_events", [])

    @public("dp.stepper(method, rate, dt)")
    def __call__(self, state, params=None, *inputs):
        """One step.

        Parameters
        ----------
        state : array or tree u, or the pair (u, t) where the rate takes a time
        params : tree
        *inputs : tree, optional
            Of this step; the rate then gets the pair (params, input) as its params.

        Returns
        -------
        state, like the one given
        """
        known, params = params, (params, *inputs) if inputs else params
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
            if self.interrupted:
                new, end = new
            new = like(new, u)
        except NonFiniteError as error:  # a solver on the way may have met it: name the argument
            self._blame(state, params)
            # What a solve was given is a rate or a stage of this step: the state that the step was given is finite.
            if str(error).startswith(f"{self.name} takes finite numbers"):
                raise NonFiniteError(self._overflow(h)) from error
            raise
        except TypeError as error:
            advise(error, params, "step(state, params)")
            raise
        if not all(is_finite(leaf) for leaf in leaves(new) if is_variable(leaf)):
            self._blame(state, params)
            raise NonFiniteError(self._overflow(h))
        if self.method == "leapfrog" and self.given["unstable"] == "raise":
            self.scheme.check_stable(u, params, h, known)
        if not self.problem.timed:
            return new
        return new, end if self.interrupted else t + h

    def back(self, state, params=None, *inputs):
        """The state before a step of leapfrog without damping: the step turned round, to rounding.

        Parameters
        ----------
        state, params, *inputs
            As for the step itself; `state` is what it returned.
        """
        self.check_reversible()
        params = (params, *inputs) if inputs else params
        return like(self.scheme.back(state, params, self._length(params)), state)

    def _overflow(self, h):
        return (
            f"{self.name} got NaN or infinity from a finite state with dt = {float(plain(h)):.6g}; "
            "take smaller steps or an implicit method"
        )

    def _length(self, params):
        return real_number(self.dt(params), "dt", "> 0") if callable(self.dt) else self.dt

    def check_reversible(self):
        """Refuse a step that `back` cannot turn round."""
        if self.method != "leapfrog":
            raise ValueError(f"{self.name} cannot be reversed; write 'leapfrog'")
        self.scheme.check_reversible()

    def _check_stable(self, h, c, name, largest):
        """Refuse a step that would grow without bound."""
        if h * c > largest * (1 + ROUNDING):
            most = rounded_down(largest / c)
            given = number_beside(h, float(most), digits=12)
            raise UnstableStepError(
                f"{self.method} is unstable for {name} with dt = {given}: the largest stable dt is "
                f"{most}; take smaller steps or an implicit method, or write unstable='allow'"
            )

    def _parts(self, state):
        if not self.problem.timed:
            return state, None
        return check_pair(f"the state of {self.name}, whose rate takes a time,", state, "(u, t)")

    def _blame(self, state, params):
        """Refuse arguments that are not finite."""
        for what, tree in (("state", state), ("params", params)):
            for place, leaf in zip(labels(tree, what), leaves(tree), strict=True):
                if is_variable(leaf):
                    check_finite(f"{place} of {self.name}", np.asarray(plain(leaf)))

    def __repr__(self):
        length = "given by the params" if callable(self.dt) else f"{float(plain(self.dt)):g}"
        return f"<{self.name}: order {self.order}, dt {length}>"


def largest_step(op, reach):
    """The largest stable h c of an explicit step for u' = c L u; `reach`: of the method on the negative real axis.

    From the eigenvalues of a sum of 1-D factors, else, where L has symmetric entries, from its least
    eigenvalue. Of other operators nothing is known, and any step is taken.
    """
    least = least_eigenvalue(op)
    return reach / -least if least is not None and least < 0 else np.inf


def least_eigenvalue(op):
    """The most negative eigenvalue of an operator with real ones, or None when that is not known."""
    if op.dtype.kind == "c":
        return None
    found = compute_spectrum(op.structure) if op.separable else None
    if found is not None:
        return float(np.min(found.eigenvalues))
    if not op.structure.has_entries:
        return None
    matrix, n = op.matrix, op.shape[0]
    if n and abs(matrix - matrix.T).max() > 1e-14 * abs(matrix).max():
        return None
    if n <= DENSE_UP_TO:
        return float(np.min(np.linalg.eigvalsh(matrix.toarray()), initial=0.0))
    start = np.random.default_rng(0).standard_normal(n)  # the same bits in every run
    try:
        return float(eigsh(matrix, 1, which="SA", v0=start, tol=1e-3, return_eigenvectors=False)[0])
    except ArpackError:
        return None
