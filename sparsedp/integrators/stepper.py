"""stepper() builds a time step from a rate of change and a method."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from sparsedp._utils.base_classes import Reconstructible
from sparsedp._utils.calls import advice_near, public
from sparsedp._utils.pytree import copied, flatten, labels, leaves
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
from sparsedp.autodiff.program_trace import check_values, finiteness_check, opaque, open_traces, recording_trace, sample
from sparsedp.autodiff.tape import is_variable, plain
from sparsedp.errors import JitError, NonFiniteError, UnstableStepError
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

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from sparsedp.integrators.adaptive import Adaptive
    from sparsedp.solvers.choose_method import SolveSettings

__all__ = ["METHODS", "Step", "stepper"]

# The arguments that each method does not use. Only the methods of WITH_OPTIONS take further options.
UNUSED = {
    **dict.fromkeys(EXPLICIT, ("jacobian", "damping")),
    **dict.fromkeys((*IMPLICIT, "radau", "rodas5p"), ("damping",)),
    "etdrk4": ("jacobian", "damping"),
    "leapfrog": ("linear", "source", "timed", "tolerance", "max_step", "breaks", "events", "jacobian"),
}
METHODS = tuple(UNUSED)
WITH_OPTIONS = (*IMPLICIT, "rodas5p")  # methods that take options of `inverse` or `implicit`
KEPT = 2  # number of cached set-ups of linear solves, one for each step length
KEPT_WITH_TOLERANCE = 12  # the same with error control, where step lengths vary
ROUNDING = 1e-12  # relative tolerance of the stability limit, so that a dt equal to it is accepted despite rounding


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
    """Return a time step: a function that advances a state by dt, differentiable in state, params and dt.

    Parameters
    ----------
    method : str
        ======================= ===== ==============================================================
        euler heun ssprk3 rk4   1-4   explicit: the cheapest methods for problems that are not stiff
        backward_euler          1     L-stable: stable for any dt, and stiff components decay
        crank_nicolson          2     stable for any dt, but stiff components keep their size and change sign each step
        tr_bdf2                 2     L-stable, two stages that share one factorisation
        imex                    2     `linear` and source implicit (L-stable), the rate explicit
        radau                   5     L-stable, dense LU: for stiff systems of up to 500 unknowns, best with a tolerance
        rodas5p                 5     L-stable, sparse LU: for stiff systems of many unknowns, as reactions on grids
        etdrk4                  4     `linear` exact by transforms (separable operators), the rate explicit
        leapfrog                2     waves: two staggered fields, the rate of each depends on the other; reversible
        ======================= ===== ==============================================================
    rate : callable or Operator
        The rate of change of the state: u' = ``rate(u, params)``, or ``rate(u, params, t)`` if it depends on the time;
        the state is then the pair (u, t). Write it with autograd.numpy, Operators and other rules; u is an array or a
        tree of arrays. An Operator L stands for u' = c L u, where params is the number c >= 0 (None: c = 1). Pass
        values that change from call to call in params, because implicit methods evaluate the rate again in the
        backward pass.
        leapfrog takes a pair of rates, p' = ``f(q, params)`` and q' = ``g(p, params)``, for the state (p, q). p is
        given and returned at the times of the steps, q half a step earlier.
    dt : float, traced number, or function of params
        Length of a step [time], > 0. To differentiate with respect to dt inside a loop write
        ``lambda params: params["dt"]``.
    linear : Operator or (Operator, coefficient), or a tree of these like the state, optional
        A stiff term c L u that is added to the rate; `coefficient` is the number c >= 0 or a function of params that
        returns it. In a state that is a tree, each field has its own term, or None (or 0) for no term:
        ``{"u": (L, 0.1), "v": (L, lambda p: p["D"]), "w": None}``. A pair of an Operator and a number is one term. So
        for a state of two fields, of which the second has no term, write ``[L, None]``. L may also be
        ``-1.0 * L @ L``, a `matrix_function` of an operator, or a `diagonal`. Fields with the same L and c share the
        set-up of the solver.
    source : callable, optional
        ``source(params)`` or ``source(params, t)``: a term that does not depend on u and is added to the rate, such as
        nu D(B(values)) for moving walls, where B is a `lift`. All implicit methods, imex and etdrk4 keep their order
        with it. A problem with only an operator and a source is linear: one set-up of the solver for each value of
        c dt is used by all stages, steps and adjoint solves.
    timed : bool, optional
        Whether rate or source takes the time; default: decided by its number of arguments.
    tolerance : float, optional
        Turns on error control: dt becomes an interval, which is divided into steps whose relative errors stay below the
        tolerance; `step.taken` lists the steps. The error of a derivative is also estimated: the derivative is correct
        to about the tolerance, or a DerivativeError is raised. Jumps of the rate are detected; the values of a step
        across a jump meet the tolerance, but its derivative raises a DerivativeError unless the jump is given by
        `breaks` or `events`.
    floor : number or tree like u, optional
        Errors are relative to |u| + floor. Default: a tenth of the largest entry of each array. With the default an
        array that decays to zero is resolved to the same relative error however small it is, which takes many steps;
        to avoid this give the size below which its values do not matter. If entries of very different size matter
        (species with values of 1 and 1e-5), give an array with a floor for each. An array that is 0 until its rate
        becomes nonzero needs a floor, or the time of this change in `breaks`. In a tree, entries of dicts are paired
        by key, and a number or None may stand for a whole branch.
    max_step : float, optional
        Longest step that error control may take. Reduce it if a short pulse or spike of the rate could lie between two
        evaluations of the rate and thus be missed.
    breaks : sequence of float, or callable, optional
        Times at which the rate, or its derivative, jumps; or a function ``breaks(params)`` that returns such times.
        Steps end at these times. The rate is evaluated at the last floating-point time before a break and at the first
        one after it, so that ``np.where(t < params["off"], 1.0, 0.0)`` has the intended value on both sides. The state
        is differentiated with respect to times that a function returns. The times may be in any order; times outside
        the interval (t, t + dt] and repeated constants are ignored. Needs a tolerance. The state is the pair (u, t).
    events : callable, pair (callable, jump), or list of these, optional
        Functions ``event(u, params)`` or ``event(u, params, t)``. A zero of such a function in the interval is located,
        and a step ends there. The integration then continues from the state that ``jump(u, params)`` or
        ``jump(u, params, t)`` returns. Without a jump it continues from the same state; this is for a rate that has a
        jump where the event function is 0. As in SciPy's `solve_ivp` the function may have two attributes. With
        ``event.terminal = True`` the interval ends at the event, and the time returned with the state is the time of
        the event. With ``event.direction`` > 0 (< 0) only zeros from negative to positive (from positive to negative)
        are used. Needs a tolerance. The state is the pair (u, t).
    unstable : "raise" or "allow"
        Whether a dt beyond the stability limit raises an UnstableStepError. The limit is known for explicit steps of an
        Operator that has a matrix, and for leapfrog, where it is estimated once for each dt and params. It is exact for
        grid operators without obstacles or varying coefficients, and has an error below 0.5 % for other matrices.
        Euler's and Heun's method are unstable for every dt if L moves waves without damping them, as centred
        differences do; take ssprk3 or rk4.
    jacobian : callable, optional
        ``jacobian(u, params)`` or ``jacobian(u, params, t)``: the derivative of the rate with respect to u, for
        implicit steps of a nonlinear rate. By default it is computed by automatic differentiation, with a colouring of
        its sparsity pattern. radau computes it from one tape by default, and uses it only in Newton's method. That of
        rodas5p must be exact: its order depends on it.
    damping : pair, optional
        For leapfrog: the decay rates [1 / time] of the two fields, for example the pair that `sponge` returns, or
        ``matched_layer(...).damping`` for the state ((p_x, p_y, ...), v). Default: no damping.
    solver, rtol, maxiter, **options
        `method`, tolerance and options of `inverse` (linear problems) or `implicit` (nonlinear problems).

    Returns
    -------
    Step
        ``step(state, params=None)``. In a `rollout` with inputs it is called as ``step(state, params, input)``, and the
        rate then gets the pair (params, input) as its params. `step.info` holds the records of its solves.

    Raises
    ------
    ValueError
        If the method or a setting is unknown, dt <= 0, or a coefficient is negative.
    TypeError
        If rate, linear or source has a wrong type; when the step is called, if `linear` is not a tree like the state.
    NonFiniteError
        If dt, state, params or the new state contains NaN or infinity.
    UnstableStepError
        When the step is called: if dt exceeds the stability limit of an explicit step or of leapfrog, or if the
        operator of an implicit step makes fields grow too fast for this dt, as -laplacian does.
    ConvergenceError
        When the step is called: if a solve does not converge, if no step length meets the tolerance, or if an event
        occurs again and again at the same time.
    DerivativeError
        When a derivative is computed: if the tolerance is too coarse for it; if the rate has a jump that is given
        neither by a break nor by an event, or changes faster than the steps resolve; if the solution only touches the
        surface of an event, so that the time of the event has no derivative; if two differentiated breaks coincide.

    See Also
    --------
    implicit, matrix_exponential, conservation_law, sponge, matched_layer, rollout

    Notes
    -----
    The table lists which methods accept an argument. Other methods raise a TypeError for it.

    ==================================  ===========  ================================================================
    arguments                           default      methods
    ==================================  ===========  ================================================================
    linear, source, timed, tolerance    None         all but leapfrog; imex and etdrk4 need `linear`
    max_step, breaks, events            None         all but leapfrog; they need a tolerance
    floor                               None         all; it has an effect with a tolerance
    unstable                            "raise"      all; it has an effect on euler, heun, ssprk3, rk4, leapfrog
    jacobian                            None         all but euler, heun, ssprk3, rk4, etdrk4, leapfrog; unused by imex
    damping                             None         leapfrog
    solver                              "auto"       all; radau accepts only "auto" and "direct"
    rtol, maxiter                       1e-10, None  all; they have an effect on solves
    options of `inverse` or `implicit`  none         backward_euler, crank_nicolson, tr_bdf2, imex, rodas5p
    ==================================  ===========  ================================================================

    Derivatives are those of the discrete step. A linear stage solves (1 - z L) x = b with z = c dt. Its cotangents are
    b_bar = y and z_bar = y . L x, where (1 - z L)^T y = g. A nonlinear stage is a root, see `implicit`.
    If a coefficient is 0, the stiff term leaves the state unchanged bit for bit, without set-up or solve.

    Error control: each step is extrapolated from two half steps and a whole step (not crank_nicolson). The derivatives
    of the step lengths take into account that fast changes of a continuous rate occur at times that depend on params.
    The rate is also evaluated at both ends and in the middle of each step and, if it depends on the time, at about 200
    more times in an interval at most; steps across a jump or a pulse are shortened. The derivative is that of these
    steps. The contribution of the extrapolation to it, relative to the params and to its largest entry, must be less
    than 6 tolerance^(p / (p + 1)) with the order p (crank_nicolson: less than 10 tolerance); otherwise a
    DerivativeError is raised. This may also happen for a derivative that is small because terms cancel. radau and
    rodas5p use an embedded formula instead of the extrapolation (p = 3 and p = 4 in the bound, and three
    times the bound for rodas5p). For each order above the first their bound is ten times larger.

    Cost: n linear steps and their gradient take one set-up and 2 n solves (tr_bdf2: 4 n). With a tolerance a gradient
    takes about six times the steps of its value, and three times the time of a gradient without the error estimate.
    radau evaluates three Jacobians for the derivative of a step, batches them over many steps, and records one rule on
    the tape for an interval; a gradient takes 1.5 to 3.2 times as long as the value, and 3 to 5 times if the rate is
    vectorized. For derivatives of higher order radau records each step: a Hessian product of two parameters takes 50
    times as long as a gradient. A step of rodas5p takes one Jacobian, one factorisation and eight solves; the gradient
    takes 24 transposed solves for each step, with the factorisations of the last steps (up to 0.5 GB) and new ones.
    On grids with 1e4 unknowns it takes 1.7 to 2.9 times the time of the value, for a few unknowns ten times (take radau
    there).

    Breaks and events: du/db = f_- - f_+ just after a break b, where f_- and f_+ are the rates before and after it. The
    derivative of the time of an event g = 0 follows from the implicit function theorem,
    -(g_u du + g_p dp + g_t dt) / (g_u f + g_t), applied to the step that ends at the event. This step is located by
    Brent's method to rounding (implicit methods: to `rtol`). Derivatives of all orders are available, also in rollouts
    with any `memory`. If an event function has two zeros within one step, they are
    found if the values at the start, the middle and the end of the step indicate an extremum between them. After a
    terminal event the next step of a rollout starts from the returned state and time. `step.t_events` lists the times
    of events in the last interval as constants. To differentiate the time of an event, use the time that a terminal
    event returns, or write the time into the state by a jump.

    Ranks: all methods except radau, rodas5p and etdrk4 accept distributed fields (see `distribute`). Nonlinear implicit
    steps then have the limits of `implicit`, for example no `sparsity`.

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

    Integrate a source that is switched off at a time, and compute the time at which a ball from a height h lands:

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
        if method not in WITH_OPTIONS:
            near = advice_near(word, [name for name in arguments if name not in ("options", *UNUSED[method])])
            raise TypeError(f"{method} does not use {word}{near or '; leave it out'}")
    settings = _solver_settings(solver, rtol, maxiter, arguments["options"])
    unused = [word for word in UNUSED[method] if arguments[word] is not None]
    if method == "radau" and solver not in ("auto", "direct"):
        unused.append("solver")  # radau always solves its systems by LU
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
        from sparsedp.integrators.stability import largest_step

        limits = [(term, largest_step(term.op, EXPLICIT[method])) for term in scheme.problem.stiff]
    return Step(method, dt, scheme, limits, arguments)


def _solver_settings(solver: str, rtol: float, maxiter: int | None, options: dict) -> SolveSettings:
    """Return the checked settings of solves; the option `sparsity` is not checked here but by `implicit`."""
    checked = {word: value for word, value in options.items() if word != "sparsity"}
    settings = check_settings(solver, rtol, maxiter, "raise", checked, common=("rtol", "maxiter", "sparsity"))
    return replace(settings, options=options)


def _check_interruptions(arguments: dict) -> None:
    """Raise an error for options of error control without a tolerance, and for a max_step that is not positive."""
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
    """Return True if a leaf of the floor is None (the default) or contains finite numbers >= 0 only."""
    if leaf is None:
        return True
    value = np.asarray(leaf)
    return value.dtype.kind in "fiu" and bool(np.all((value >= 0) & (value < np.inf)))


def _reconstruct_step(arguments: dict) -> Step:
    """Construct a step again from the arguments of `stepper`, for copies and pickles."""
    named = {word: value for word, value in arguments.items() if word != "options"}
    return stepper(**named, **arguments["options"])


def _scheme(method: str, arguments: dict, settings: SolveSettings) -> Any:
    """Return the scheme of a method. Modules that only some methods need are imported here, when they are used."""
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
    if method == "rodas5p":
        from sparsedp.integrators.rosenbrock import Rosenbrock

        rosenbrock = Rosenbrock(problem, arguments["jacobian"], tolerance, floor, settings, max_step)
        return _with_interruptions(rosenbrock, arguments)
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
    """Extend a scheme with error control by breaks and events; return it unchanged if there are none."""
    breaks = arguments["breaks"]
    events = arguments["events"]
    if breaks is None and events is None:
        return scheme
    from sparsedp.integrators.events import break_times, event_list
    from sparsedp.integrators.interruptions import Interrupted

    times = break_times(() if breaks is None else breaks)
    return Interrupted(scheme, times, event_list([] if events is None else events))


class Step(Reconstructible):
    """A time step, as returned by `stepper`: ``step(state, params)`` returns the state after a time dt.

    Parameters
    ----------
    method : str
    dt : number, traced number, or function of params
    scheme : Scheme
        ``scheme(u, params, t, h)``: the state after a step h.
    limits : list of pairs
        Terms c L, each with the largest stable value of h c for an explicit step of length h.
    arguments : dict
        The arguments of `stepper`.

    Attributes
    ----------
    order : int
        Order of accuracy in time.
    info : SolveLog or None
        Records of the last solves and set-up.
    taken : list of float
        With error control: the lengths of the accepted steps in the last interval, as fractions of the interval.
    t_events : list of arrays
        With events: for each event its times in the last interval, without a derivative.
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
        self._is_recorded = False  # whether the last call was recorded by dp.jit
        # Whether values decide about the computation, as in error control and Newton's method.
        self.decides = (
            arguments["tolerance"] is not None or method in ("radau", "rodas5p") or isinstance(scheme, Nonlinear)
        )
        self.is_interrupted = arguments["breaks"] is not None or arguments["events"] is not None
        self.constructor_call = _reconstruct_step, (arguments,)

    @property
    def taken(self) -> list[float]:
        """Return the lengths of the accepted steps in the last interval, as fractions of the interval."""
        self._check_known("taken")
        return getattr(self.scheme, "taken", [1.0])

    @property
    def t_events(self) -> list[np.ndarray]:
        """Return the times of each event in the last interval."""
        self._check_known("t_events")
        return getattr(self.scheme, "t_events", [])

    def _check_known(self, word: str) -> None:
        """Raise JitError for an attribute of the last step if this step is a call of a program."""
        if self._is_recorded:
            raise JitError(
                f"dp.jit cannot record {word} of {self.name}, which differs from call to call and is not traced; read "
                "it outside of the jitted function"
            )

    @public("dp.stepper(method, rate, dt)")
    def __call__(self, state: Any, params: Any = None, *inputs: Any) -> Any:
        """Take one step.

        Parameters
        ----------
        state : array or tree u, or the pair (u, t) if the rate takes the time
        params : tree
        *inputs : tree, optional
            An input for this step; the rate then gets the pair (params, input) as its params.

        Returns
        -------
        tree
            The new state, with the structure, shapes and dtypes of the old one.
        """
        if open_traces and self.decides:
            new = opaque(self._advance)(state, params, *inputs)
            self._is_recorded = recording_trace(leaves(new)) is not None
            return new
        return self._advance(state, params, *inputs)

    def _advance(self, state: Any, params: Any, *inputs: Any) -> Any:
        """Take one step."""
        self._is_recorded = False
        first_params = params
        if inputs:
            params = (params, *inputs)
        u, t = self._parts(state)
        check_leaves(f"state of {self.name}", u, containers=False)
        check_leaves(f"params of {self.name}", params, containers=False)
        h = self._length(params)
        if self.problem.stiff:
            self.problem.terms(u)  # raise an error for a state of another structure before anything is solved
        for term, largest in self.limits:
            check = partial(self._check_stable, term.op.name, largest)
            check_values(check, h, term.coefficient(params))
        end = None
        try:
            new = self.scheme(u, params, t, h)
            if self.is_interrupted:
                new, end = new
            new = like(new, u)
        except NonFiniteError as error:  # a solver may have raised it: name an argument of the step that is not finite
            self._refuse_nonfinite(state, params)
            # State and params are finite, so that a rate or a stage of this step has overflowed.
            if str(error).startswith(f"{self.name} takes finite numbers"):
                raise NonFiniteError(self._overflow(h)) from error
            raise
        except TypeError as error:
            advise(error, params, "step(state, params)")
            raise
        ends = [leaf for leaf in leaves(new) if is_variable(leaf)]
        if recording_trace(ends) is not None:
            names, values = self._named_variables(state, params)
            check_values(partial(self._check_finite_ends, len(ends), names), h, *ends, *values)
        elif not all(map(is_finite, ends)):
            self._refuse_nonfinite(state, params)
            raise NonFiniteError(self._overflow(h))
        if self.method == "leapfrog" and self.arguments["unstable"] == "raise":
            if open_traces:
                entries, rebuild = flatten((u, params, h, first_params))
                check_values(lambda *values: self.scheme.check_stable(*rebuild(values)), *entries)
            else:
                self.scheme.check_stable(u, params, h, first_params)
        if not self.problem.timed:
            return new
        return new, end if self.is_interrupted else t + h

    def back(self, state: Any, params: Any = None, *inputs: Any) -> Any:
        """Reverse a step of leapfrog without damping: return the state before it, up to rounding.

        Parameters
        ----------
        state : pair
            The state that the step returned.
        params, *inputs
            The other arguments of the step.
        """
        self.check_reversible()
        if inputs:
            params = (params, *inputs)
        return like(self.scheme.back(state, params, self._length(params)), state)

    def _overflow(self, h: Any) -> str:
        return (
            f"{self.name} got NaN or infinity from a finite state with dt = {float(sample(h)):.6g}; "
            "take smaller steps or an implicit method"
        )

    def _length(self, params: Any) -> Any:
        if callable(self.dt):
            return real_number(self.dt(params), "dt", "> 0")
        return self.dt

    def check_reversible(self) -> None:
        """Raise ValueError if `back` cannot reverse the step."""
        if self.method != "leapfrog":
            raise ValueError(f"{self.name} cannot be reversed; write 'leapfrog'")
        self.scheme.check_reversible()

    def _check_stable(self, name: str, largest: float, h: Any, c: Any) -> None:
        """Raise UnstableStepError if repeated steps of length h would grow without bound."""
        h = float(h)
        c = float(c)
        if h * c > largest * (1 + ROUNDING):
            most = rounded_down(largest / c)
            shown = number_beside(h, float(most), digits=12)
            raise UnstableStepError(
                f"{self.method} is unstable for {name} with dt = {shown}: the largest stable dt is "
                f"{most}; take smaller steps or an implicit method, or write unstable='allow'"
            )

    def _parts(self, state: Any) -> Any:
        """Return u and the time t, which is None if rate and source do not depend on it."""
        if not self.problem.timed:
            return state, None
        return check_pair(f"the state of {self.name}, whose rate takes a time,", state, "(u, t)")

    def _named_variables(self, state: Any, params: Any) -> tuple[list[str], list[Any]]:
        """Return the names and the values of the floating leaves of state and params."""
        names = []
        values = []
        for what, tree in (("state", state), ("params", params)):
            for place, leaf in zip(labels(tree, what), leaves(tree), strict=True):
                if is_variable(leaf):
                    names.append(place)
                    values.append(leaf)
        return names, values

    def _refuse_nonfinite(self, state: Any, params: Any) -> None:
        """Raise NonFiniteError for a leaf of state or params that is not finite."""
        for name, value in zip(*self._named_variables(state, params), strict=True):
            check_finite(f"{name} of {self.name}", np.asarray(sample(value)))

    @finiteness_check
    def _check_finite_ends(self, n_ends: int, names: Sequence[str], h: Any, *values: Any) -> None:
        """Raise NonFiniteError if one of the first `n_ends` values, those of the new state, is not finite.

        The other values are those of state and params, with their names. If one of them is not finite, it is named.
        """
        if all(map(is_finite, values[:n_ends])):
            return
        for name, value in zip(names, values[n_ends:], strict=True):
            check_finite(f"{name} of {self.name}", np.asarray(value))
        raise NonFiniteError(self._overflow(h))

    def __repr__(self) -> str:
        if callable(self.dt):
            length = "given by the params"
        else:
            length = f"{float(plain(self.dt)):g}"
        return f"<{self.name}: order {self.order}, dt {length}>"
