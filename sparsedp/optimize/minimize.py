"""minimize(): checks of the arguments, and the loop around the methods."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields
from inspect import signature
from math import inf
from typing import TYPE_CHECKING, Any

from sparsedp._utils.calls import advice_near, foreign_keyword_advice
from sparsedp._utils.progress import shown_steps
from sparsedp._utils.pytree import leaves
from sparsedp._utils.validation import check_choice, check_function, check_number, check_whole, is_number
from sparsedp.autodiff.backend import backend_of, collectively
from sparsedp.autodiff.flattening import Packing
from sparsedp.optimize.admm import ADMM
from sparsedp.optimize.batches import Batches
from sparsedp.optimize.box import Box
from sparsedp.optimize.checkpoint import Checkpoint
from sparsedp.optimize.first_order import Adam, GradientDescent
from sparsedp.optimize.lbfgs import LBFGS
from sparsedp.optimize.least_squares import GaussNewton, HalfInverse, LevenbergMarquardt
from sparsedp.optimize.monitor import Monitor
from sparsedp.optimize.newton_cg import NewtonCG
from sparsedp.optimize.objective import Objective
from sparsedp.optimize.physical_gradient import PhysicalGradient
from sparsedp.optimize.projection import Projection
from sparsedp.optimize.result import NO_RESIDUALS, Minimum, NoStepFound, Record

if TYPE_CHECKING:
    import os

    from sparsedp.optimize.method import Method

__all__ = ["METHODS", "minimize"]

INTERRUPTED = "minimize was interrupted; call it again, with start=best.x"
METHODS: dict[str, type[Method] | type[ADMM]] = {
    method.name: method
    for method in (
        LBFGS,
        GradientDescent,
        Adam,
        NewtonCG,
        GaussNewton,
        LevenbergMarquardt,
        HalfInverse,
        PhysicalGradient,
        ADMM,
    )
}


def minimize(
    loss: Callable[..., Any],
    start: Any,
    method: str = "lbfgs",
    maxiter: int = 100,
    tolerance: float | Callable[[Record, Record], Any] = 1e-8,
    callback: Callable[[Record, Any], Any] | None = None,
    progress: bool | str = False,
    gradient: Callable[..., Any] | None = None,
    bounds: Any = None,
    project: Callable[[Any], Any] | None = None,
    batches: Sequence[Any] | Callable[[int], Any] | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    **options: Any,
) -> Minimum:
    """Minimize a loss of any nesting of arrays; the result has the nesting of the start.

    Parameters
    ----------
    loss : callable
        ``loss(x)``, a real scalar; with batches ``loss(x, batch)``. For gauss_newton, levenberg_marquardt and
        half_inverse it returns residuals, an array, and half the sum of their squares is minimized. For
        physical_gradient it is a function of the end state ``physics(x)``.
    start : array, number, or any nesting of them in tuples, lists and dicts
        Not modified. Leaves that are not floating are kept. Where a leaf is a field on ranks, PETSc's TAO minimizes,
        by lbfgs, with bounds that are numbers, and without the other options.
    method : str
        "lbfgs", "gd", "adam", "newton_cg", "gauss_newton", "levenberg_marquardt", "half_inverse",
        "physical_gradient"; or "admm", which adds weight |K x|_1 to the loss, for results with few entries or jumps.
    maxiter : int
        Most iterations; with 0 the start is evaluated and returned.
    tolerance : float or callable
        Converged when the Euclidean norm of the gradient has fallen to `tolerance` times its value at the
        start; nothing in the test is absolute. A callable ``tolerance(record, first_record)`` returns whether the run
        has converged; `certified` also chooses the accuracy of the solves in the loss.
    callback : callable, optional
        ``callback(record, x)`` is called after every iteration; a true result stops the run.
    progress : bool or str
        A progress bar on standard error, a string is its label; needs the extra `plot`.
    gradient : callable, optional
        ``gradient(x)``, with the structure of x; entries of dicts are paired by key. Default: reverse mode.
    bounds : (lower, upper), optional
        Each a number, None for none, or a tree like start, in which a number or None may stand for a whole branch;
        entries of dicts are paired by key. Points are moved onto the box. half_inverse compares
        no losses and may converge to another point of the box than the other methods.
    project : callable, optional
        ``project(x)``, a differentiable projection onto a linear or affine space, such as dp.projection(grid): the
        loss of project(x) is minimized, and the result is project(x). The map is tested at the start and at the
        result: one that is not affine, such as np.clip, or not idempotent is refused. Not together with bounds.
    batches : sequence or callable, optional
        The loss of iteration i is ``loss(x, batches[i % len(batches)])``, or ``loss(x, batches(i))``. For gd with a
        rate, adam and half_inverse; the result is the last point, not the best one. Converged when the gradient has
        been small in as many successive iterations as there are batches, 10 for a function.
    checkpoint : path, optional
        A folder that keeps the last two states. If the run was killed, interrupted, or stopped by its callback or by
        maxiter, the same call continues from the last state, to the same bits. A new problem needs a new folder.
    **options
        Of the method, see the table; any other option is refused.

        ===================  ==============  ============  =============================================================
        method               option          default       meaning
        ===================  ==============  ============  =============================================================
        lbfgs                memory          10            steps from which the curvature is estimated
        lbfgs                line_search     20            most trial points in one line search
        gd                   rate            None          step per gradient; None: found by backtracking
        gd                   momentum        0.0           share of the last step that is added, 0 <= momentum < 1
        gd                   line_search     None          "backtracking": halve the step until the loss falls
        adam                 rate            1e-3          size of a step in every entry
        adam                 betas           (0.9, 0.999)  memory of the mean of the gradient and of its square
        adam                 epsilon         1e-8          least root mean square, relative to the first gradient
        newton_cg            inner           200           most products with the Hessian in one iteration
        gauss_newton         apart           False         whether residuals along axis 0 are samples, see below
        gauss_newton         dense           None          whether the Jacobian is formed; None: if it is small
        gauss_newton         absolute_sigma  False         whether residuals are in standard deviations, see below
        levenberg_marquardt  damping         1e-3          at the start, relative to the largest diagonal entry of J^T J
        levenberg_marquardt  apart, dense    same          as for gauss_newton
        levenberg_marquardt  absolute_sigma  False         as for gauss_newton
        half_inverse         rate            1.0           factor of the step
        half_inverse         power           0.75          p of the step J^T (J J^T)^-p r
        half_inverse         truncation      1e-10         see `update_direction`
        half_inverse         rank            None          see `update_direction`
        half_inverse         apart           False         as for gauss_newton
        half_inverse         form            "auto"        "dense", "krylov"; "auto" forms the Jacobian if it is small
        half_inverse         absolute_sigma  False         as for gauss_newton
        physical_gradient    physics         required      the simulator, as for `physical_gradient`
        physical_gradient    inverse         required      its inverse
        physical_gradient    rate            1.0           factor of the step
        admm                 weight          required      of the sum of absolute entries (not of an integral)
        admm                 operator        None          K, linear, from x to an array; None: x itself, one array
        admm                 rho             None          first penalty; None: chosen from the data
        admm                 inner           10            steps of lbfgs in a round, or a function, see below
        admm                 prox            None          ``prox(v, t)`` in place of the soft threshold
        ===================  ==============  ============  =============================================================

        apart=True is the fast form for samples: the loss takes every leaf of x with a leading axis of copies, one for
        each sample, and a few products give the whole Jacobian.
        absolute_sigma: whether the residuals are divided by their standard deviations; it selects the formula of
        `covariance`, as in scipy.optimize.curve_fit.
        weight: for few jumps on a uniform grid write operator=dp.gradient(grid) and a weight times the volume
        of a cell. inner: ``inner(target, rho, x)`` returns the x that minimizes loss(x) plus rho / 2 times the sum of
        (K x - target)^2; then without bounds. With prox the values are those of the loss alone. Iterations of admm are
        rounds, and a tolerance of 1e-4 is usual.

    Returns
    -------
    Minimum
        `.x`, `.value`, `.history` (a record for each iteration), `.message`, `.converged`,
        `.evaluations`; str() is a table. `.x` is the best point seen. `.covariance` of a least-squares problem:
        s^2 (J^T J)^(-1) with s^2 = |r|^2 / (m - n), or (J^T J)^(-1) with absolute_sigma=True.
        Ctrl-C ends the run with the best point so far and the message "interrupted"; a second Ctrl-C stops at once.

    Raises
    ------
    ShapeError
        If a side of the bounds, or what `project` returns, has another structure than start; DerivativeError for
        `gradient`. The message gives the path of the entry.
    ValueError
        If the method is not known, or maxiter, tolerance, bounds or an option is out of range, or the checkpoint
        folder holds a run with another method, options, bounds, start (static leaves too), loss or batches.
    KeyboardInterrupt
        If Ctrl-C comes before the loss is known at the start, or a second time.
    TypeError
        If the method has no such option, or an argument that must be a number is something else.
    UnstableStepError, ConvergenceError, NonFiniteError
        If the loss raises one of them, or is NaN or infinite, at the start. At a trial point the same
        counts as an infinite loss: the method tries a nearer point, and the record of the iteration lists it.
    ImportError
        If `progress` is given and tqdm is not installed.

    See Also
    --------
    value_and_grad, update_direction, physical_gradient, smoothness, total_variation, certified, convergence, flatten,
    ensemble

    Notes
    -----
    Complex numbers: see docs/guides/complex_numbers.md.

    Examples
    --------
    >>> import autograd.numpy as anp
    >>> import numpy as np
    >>> best = minimize(lambda x: anp.sum((x["a"] - 3.0) ** 2), {"a": np.zeros(2), "n": 7})
    >>> best.x
    {'a': array([3., 3.]), 'n': 7}
    >>> best.converged
    True
    """
    check_function("minimize", loss, "lambda x: np.sum(x**2)")
    if callback is not None:
        check_function("callback of minimize", callback, "lambda record, x: False")
    chosen = _method(method, options)
    maxiter = check_whole("maxiter of minimize", maxiter, 0, "; the default is 100")
    _check_tolerance(tolerance)
    other_arguments = {
        "progress": progress,
        "gradient": gradient,
        "project": project,
        "batches": batches,
        "checkpoint": checkpoint,
    }
    implementation = backend_of(leaves(start)).implementation(minimize)
    if implementation is not minimize:
        other_arguments = {**options, **other_arguments}
        return implementation(loss, start, method, maxiter, tolerance, callback, bounds, other_arguments)
    if isinstance(chosen, ADMM):
        _check_unused("admm", {**other_arguments, "tolerance": callable(tolerance)})
        return chosen.minimize(loss, start, maxiter, tolerance, callback, bounds, minimize)
    if hasattr(tolerance, "inside"):
        loss, gradient = _certified(loss, gradient, tolerance, checkpoint)
    batches_by_iteration = _batches(batches, method, chosen)
    packing = Packing(start, "start")
    box = Box(bounds, packing)
    loss = chosen.composed(loss)
    projection = None
    if project is not None:
        projection = _projection(project, box, packing, start)
        loss = projection.loss(loss)
        if gradient is not None:
            gradient = projection.gradient(gradient)
    residual_options = chosen if chosen.uses_residuals else None
    objective = Objective(loss, gradient, packing, box, batches_by_iteration, residual_options)
    settings = {
        "method": method,
        "set of options": sorted(options.items()),
        "pair of bounds": (box.lower, box.upper),
        "start": start,
    }
    checkpoints = Checkpoint(checkpoint, settings)
    monitor = Monitor(objective, packing, tolerance, callback)
    steps = shown_steps(progress, range(maxiter), "minimize")
    covariance: Any = INTERRUPTED if chosen.uses_residuals else NO_RESIDUALS
    try:
        first_point = box.nearest(packing.pack(start))
        collectively("minimize", (start,), _run, chosen, objective, monitor, checkpoints, first_point, steps)
        covariance = objective.covariance(objective.best)
    except KeyboardInterrupt:
        if not monitor.history:
            raise
        monitor.message = monitor.message or "interrupted"
    finally:
        checkpoints.write(monitor.history)
    if projection is None:
        x = packing.unpack(objective.best.point)
    else:
        x = projection.result(objective.best.point)
    return monitor.minimum(x, method, checkpoints.resumed, covariance)


def _run(method, objective, monitor, checkpoints, first_point, steps):
    """Begin or resume a run, and iterate until the steps are used up, the monitor stops it or no step is found."""
    state = method.begin(objective.evaluate_start(first_point))
    resumed_state = checkpoints.resume(state, objective, monitor)
    if resumed_state is None:
        monitor(state.current)
    else:
        state = resumed_state
    for _ in steps:
        if monitor.message or monitor.iteration >= len(steps):
            return
        objective.iteration = monitor.iteration + 1  # selects the batch of new points
        try:
            state = method.advance(state, objective)
        except NoStepFound as error:
            monitor.stop(error)
            return
        monitor(state.current)
        checkpoints.save(state, objective, monitor)
        if not isinstance(steps, range):  # a progress bar
            steps.set_postfix_str(monitor.history[-1].summary())


def _method(name, options):
    """Return the method with its options."""
    check_choice("method", name, METHODS)
    method_class: Any = METHODS[name]
    _check_names(name, options, [field.name for field in fields(method_class)])
    return method_class(**options)


def _certified(loss, gradient, tolerance, checkpoint):
    """Return the loss and the gradient with the solves that a tolerance of `certified` chooses."""
    if checkpoint is not None:
        raise ValueError(
            "checkpoint cannot be used with a tolerance of dp.certified, whose solutions are not saved; leave "
            "checkpoint out, or write a number as tolerance"
        )
    return tolerance.inside(loss, gradient)


def _batches(batches, name, method):
    """Return the batches by iteration; refuse them for a method that compares losses."""
    by_iteration = Batches(batches)
    if by_iteration.varied and method.compares_losses:
        raise ValueError(f"{name} compares losses and cannot use batches; write method='adam', or give gd a rate")
    return by_iteration


def _projection(project, box, packing, start):
    """Return the projection of the unknowns; refuse it together with bounds."""
    if box.bounded:
        raise ValueError(
            "project and bounds cannot be used together: a projected point may be outside of the bounds; leave one "
            "of them out"
        )
    return Projection(project, packing, start)


def _check_unused(method, arguments):
    """Refuse arguments that a method does not use."""
    for name, value in arguments.items():
        if value:
            raise TypeError(f"{method} does not use {name}; leave it out")


def _check_names(method, options, names):
    """Refuse options that a method does not have."""
    parameters = [parameter for parameter in signature(minimize).parameters if parameter != "options"]
    for option in options:
        if option in names:
            continue
        advice = foreign_keyword_advice(option, parameters)
        if advice:
            advice = f"; write {advice}"
        else:
            advice = advice_near(option, [*names, *parameters])
        raise TypeError(f"{method} has no option {option!r}; it has {', '.join(names)}{advice}")


def _check_tolerance(tolerance):
    """Refuse a tolerance that is neither a function nor a number >= 0; infinity accepts any gradient."""
    infinite = is_number(tolerance) and tolerance == inf
    if not callable(tolerance) and not infinite:
        check_number("tolerance of minimize", tolerance, ">= 0", "; the default is 1e-8")
