"""minimize(): the loop around every method."""

import inspect
from math import inf

from sparsedp._utils.calls import advice_near, foreign_keyword_advice
from sparsedp._utils.progress import shown_steps
from sparsedp._utils.pytree import leaves
from sparsedp._utils.validation import check_choice, check_function, check_number, check_whole, is_number
from sparsedp.autodiff.fast_derivatives import ELSEWHERE, together
from sparsedp.autodiff.flattening import Packing
from sparsedp.optimize.batches import Batches
from sparsedp.optimize.box import Box
from sparsedp.optimize.checkpoint import Checkpoint
from sparsedp.optimize.first_order import Adam, Descent
from sparsedp.optimize.least_squares import GaussNewton, HalfInverse, LevenbergMarquardt
from sparsedp.optimize.newton import NewtonCG
from sparsedp.optimize.physical import PhysicalGradient
from sparsedp.optimize.projection import Projection
from sparsedp.optimize.quasi_newton import Quasi
from sparsedp.optimize.result import NO_RESIDUALS, Stuck
from sparsedp.optimize.sparse_terms import admm
from sparsedp.optimize.trials import Trials
from sparsedp.optimize.watch import Watch

__all__ = ["minimize"]

INTERRUPTED = "minimize was interrupted; call it once more, with start=best.x"
METHODS = {
    "lbfgs": Quasi,
    "gd": Descent,
    "adam": Adam,
    "newton_cg": NewtonCG,
    "gauss_newton": GaussNewton,
    "levenberg_marquardt": LevenbergMarquardt,
    "half_inverse": HalfInverse,
    "physical_gradient": PhysicalGradient,
}


def minimize(
    loss,
    start,
    method="lbfgs",
    maxiter=100,
    tolerance=1e-8,
    callback=None,
    progress=False,
    gradient=None,
    bounds=None,
    project=None,
    batches=None,
    checkpoint=None,
    **options,
):
    """Loss and start -> the best point found: any nesting of arrays in, the same nesting out.

    Parameters
    ----------
    loss : callable
        ``loss(x) -> real scalar``; with batches ``loss(x, batch)``. For gauss_newton, levenberg_marquardt and
        half_inverse it returns residuals, an array, and half the sum of their squares is minimized. For
        physical_gradient it is a function of the end state ``physics(x)``.
    start : array, number, or any nesting of them in tuples, lists and dicts
        Not modified. Leaves that are not floating stay as they are. Where one is a field on ranks, PETSc's TAO does
        the search, by lbfgs, with bounds that are numbers, and without the other options.
    method : str
        "lbfgs", "gd", "adam", "newton_cg", "gauss_newton", "levenberg_marquardt", "half_inverse",
        "physical_gradient"; or "admm", which adds weight |K x|_1 to the loss: few entries, few jumps.
    maxiter : int
        Most iterations; 0 evaluates the start and returns it.
    tolerance : float or callable
        Converged when the Euclidean norm of the gradient has fallen to `tolerance` times its value at the
        start; nothing in the test is absolute. A callable is asked ``tolerance(record, first_record)``; one
        such as `certified` also chooses how far the solves of the loss go.
    callback : callable, optional
        ``callback(record, x)`` after every iteration; a true answer stops the run.
    progress : bool or str
        A progress bar on standard error, a string is its label; needs the extra `plot`.
    gradient : callable, optional
        ``gradient(x)``, with the structure of x; entries of dicts are paired by key. Default: reverse mode.
    bounds : (lower, upper), optional
        Each a number, None for none, or a tree like start, in which a number or None may stand for a whole branch;
        entries of dicts are paired by key. Points are moved onto the box. half_inverse compares
        no losses and may settle elsewhere on the box than the others.
    project : callable, optional
        ``project(x)``, a differentiable projection onto a linear or affine space, such as dp.projection(grid): the
        loss is that of project(x), and the result is project(x). The map is tested at the start and at the result:
        one that is not affine, as np.clip, or not idempotent is refused. Not together with bounds.
    batches : sequence or callable, optional
        The loss of iteration i is ``loss(x, batches[i % len(batches)])``, or ``loss(x, batches(i))``. For gd with a
        rate, adam and half_inverse; the result is the last point, not the best one. Converged when the gradient has
        been small in as many iterations on end as there are batches, 10 for a function.
    checkpoint : path, optional
        A folder that keeps the last two states. The same call goes on from the last one, to the same bits, when the
        run was killed, interrupted, stopped by its callback or by maxiter; a new problem needs a new folder.
    **options
        Of the method; any other option is refused.

        ===================  ==============  ============  =============================================================
        method               option          default       meaning
        ===================  ==============  ============  =============================================================
        lbfgs                memory          10            steps that the curvature is taken from
        lbfgs                line_search     20            most trial points in one line search
        gd                   rate            None          step per gradient; None: found by backtracking
        gd                   momentum        0.0           share of the last step that is added, from 0 to below 1
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
        admm                 rho             None          first penalty; None: found from the data
        admm                 inner           10            steps of lbfgs in a round, or a function, see below
        admm                 prox            None          ``prox(v, t)`` in place of the soft threshold
        ===================  ==============  ============  =============================================================

        apart=True is the fast way for samples: the loss takes every leaf of x with a leading axis of copies, one for
        each sample, and a few products give the whole Jacobian.
        absolute_sigma: whether the residuals are divided by their standard deviations; it decides what `covariance` is,
        as in scipy.optimize.curve_fit.
        weight: few jumps on a uniform grid are asked for by operator=dp.gradient(grid) and a weight times the volume
        of a cell. inner: ``inner(target, rho, x)`` returns the x that minimizes loss(x) plus rho / 2 times the sum of
        (K x - target)^2; then without bounds. With prox the values are those of the loss alone. Iterations of admm are
        rounds, and a tolerance of 1e-4 is usual.

    Returns
    -------
    Minimum
        `.x`, `.value`, `.history` (a record for each iteration), `.message`, `.converged`,
        `.evaluations`; str() is a table. `.x` is the best point seen. `.covariance` of a least-squares problem:
        s^2 (J^T J)^(-1) with s^2 = |r|^2 / (m - n), or (J^T J)^(-1) with absolute_sigma=True.
        Ctrl-C ends the run with the best point so far and the message "interrupted"; a second one stops at once.

    Raises
    ------
    ShapeError
        If a side of the bounds, or what `project` returns, has another structure than start; DerivativeError for
        `gradient`. The message gives the path of the entry.
    ValueError
        If the method is not known, or maxiter, tolerance, bounds or an option is out of range, or the checkpoint
        folder holds another run: another method, options, bounds, start (static leaves too), loss or batches.
    KeyboardInterrupt
        If Ctrl-C comes before the loss is known at the start, or a second time.
    TypeError
        If the method has no such option, or what must be a number is none.
    UnstableStepError, ConvergenceError, NonFiniteError
        If the loss raises one of them, or is NaN or infinite, at the start. At a trial point the same
        counts as an infinite loss: the search goes back, and the record of the iteration lists it.
    ImportError
        If a progress bar is wanted and tqdm is not installed.

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
    stepper = _stepper(method, options) if method != "admm" else None
    maxiter = check_whole("maxiter of minimize", maxiter, 0, "; the default is 100")
    if not callable(tolerance) and not (is_number(tolerance) and tolerance == inf):  # inf: any gradient will do
        check_number("tolerance of minimize", tolerance, ">= 0", "; the default is 1e-8")
    unused = dict(progress=progress, gradient=gradient, project=project, batches=batches, checkpoint=checkpoint)
    for leaf in leaves(start):
        if type(leaf) in ELSEWHERE:
            return leaf.layout.minimize(loss, start, method, maxiter, tolerance, callback, bounds, options | unused)
    if stepper is None:
        for name, given in {**unused, "tolerance": callable(tolerance)}.items():
            if given:
                raise TypeError(f"admm does not use {name}; leave it out")
        _check_options(method, options, list(inspect.signature(admm).parameters)[7:])
        if "weight" not in options:
            raise TypeError("admm needs the weight of the sum of absolute values; write weight=0.1")
        return admm(minimize, loss, start, maxiter, tolerance, callback, bounds, **options)
    if hasattr(tolerance, "inside"):  # it takes part in the evaluations
        if checkpoint is not None:
            raise ValueError(
                "certified keeps answers that a checkpoint does not hold; leave checkpoint out, or give tolerance a "
                "number"
            )
        loss, gradient = tolerance.inside(loss, gradient)
    packing, batches = Packing(start, "start"), Batches(batches)
    if batches.varied and stepper.searches:
        raise ValueError(f"{method} compares losses and cannot use batches; write method='adam', or give gd a rate")
    if getattr(stepper, "rule", None) is not None:
        loss = _composed(loss, stepper.rule)
    box = Box(bounds, packing)
    if project is not None:
        if box.bounded:
            raise ValueError(
                "project and bounds cannot be used together: a projected point may be outside of the bounds; leave one "
                "of them out"
            )
        project = Projection(project, packing, start)
        loss, gradient = project.loss(loss), gradient and project.gradient(gradient)
    trials = Trials(loss, gradient, packing, box, batches, stepper if stepper.residuals else None)
    settings = {
        "method": method, "set of options": sorted(options.items()), "pair of bounds": (box.lower, box.upper),
        "start": start,
    }  # fmt: skip
    kept = Checkpoint(checkpoint, settings)
    covariance = INTERRUPTED if stepper.residuals else NO_RESIDUALS
    watch = Watch(trials, packing, tolerance, callback)
    steps = shown_steps(progress, range(maxiter), "minimize")
    try:
        begin = box.inside(packing.pack(start))
        together("minimize", (start,), _run, stepper, trials, watch, kept, begin, steps)
        covariance = trials.covariance(trials.best)
    except KeyboardInterrupt:
        if not watch.history:
            raise
        watch.message = watch.message or "interrupted"
    finally:
        kept.write(watch.history)
    x = packing.unpack(trials.best.vector)
    if project is not None:
        x = project.result(trials.best.vector)
    return watch.minimum(x, method, resumed=kept.resumed, _covariance=covariance)


def _run(stepper, trials, watch, kept, start, steps):
    """Begin or resume, and advance until the steps are over, the watch stops it or it is stuck."""
    state = stepper.begin(trials.first(start))
    resumed = kept.resume(state, trials, watch)
    if resumed is None:
        watch(state.trial)
    else:
        state = resumed
    for _ in steps:
        if watch.message or watch.iteration >= len(steps):
            return
        trials.iteration = watch.iteration + 1  # a new point is seen by the next batch
        try:
            state = stepper.advance(state, trials)
        except Stuck as reason:
            watch.give_up(str(reason))
            return
        watch(state.trial)
        kept.save(state, trials, watch)
        if not isinstance(steps, range):
            steps.set_postfix_str(watch.history[-1].summary())


def _composed(loss, inner):
    return lambda x, *rest: loss(inner(x), *rest)


def _stepper(method, options):
    check_choice("method", method, (*METHODS, "admm"))
    _check_options(method, options, list(inspect.signature(METHODS[method]).parameters))
    return METHODS[method](**options)


def _check_options(method, options, names):
    """Refuse options that a method does not have."""
    parameters = [parameter for parameter in inspect.signature(minimize).parameters if parameter != "options"]
    for name in options:
        if name in names:
            continue
        advice = foreign_keyword_advice(name, parameters)
        if advice:
            advice = f"; write {advice}"
        else:
            advice = advice_near(name, [*names, *parameters])
        raise TypeError(f"{method} has no option {name!r}; it has {', '.join(names)}{advice}")
