"""The function minimize(): validation of its arguments, and the iteration that calls the selected method."""

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
from sparsedp.optimize.augmented_lagrangian import AugmentedLagrangian
from sparsedp.optimize.batches import Batches
from sparsedp.optimize.box import Box, pair_of_bounds
from sparsedp.optimize.checkpoint import Checkpoint
from sparsedp.optimize.constrained_run import ConstrainedMethod, minimize_constrained
from sparsedp.optimize.first_order import Adam, GradientDescent
from sparsedp.optimize.ipopt import Ipopt
from sparsedp.optimize.lbfgs import LBFGS
from sparsedp.optimize.least_squares import GaussNewton, HalfInverse, LevenbergMarquardt
from sparsedp.optimize.metric import Metric
from sparsedp.optimize.mma import MMA
from sparsedp.optimize.monitor import Monitor
from sparsedp.optimize.newton_cg import NewtonCG
from sparsedp.optimize.objective import Objective
from sparsedp.optimize.physical_gradient import PhysicalGradient
from sparsedp.optimize.projection import Projection
from sparsedp.optimize.result import NO_RESIDUALS, Minimum, NoStepFound, Record
from sparsedp.optimize.slsqp import SLSQP
from sparsedp.optimize.trust_constr import TrustConstr

if TYPE_CHECKING:
    import os

    from sparsedp.optimize.method import Method

__all__ = ["METHODS", "minimize"]

INTERRUPTED = "minimize was interrupted; call it again, with start=best.x"
METHODS: dict[str, type[Method] | type[ADMM] | type[ConstrainedMethod]] = {
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
        AugmentedLagrangian,
        MMA,
        SLSQP,
        TrustConstr,
        Ipopt,
    )
}
CONSTRAINED = [name for name, method in METHODS.items() if issubclass(method, ConstrainedMethod)]
WITH_METRIC = [name for name, method in METHODS.items() if getattr(method, "uses_metric", False)]


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
    constraints: Any = None,
    metric: Any = None,
    **options: Any,
) -> Minimum:
    """Minimize a loss whose argument is an array or a nested structure (pytree) of arrays.

    Parameters
    ----------
    loss : callable
        ``loss(x)``, or ``loss(x, batch)`` if `batches` is given, returns a real scalar. For gauss_newton,
        levenberg_marquardt and half_inverse it returns an array of residuals, and half the sum of their squares is
        minimized. For physical_gradient it is called with ``physics(x)`` in place of x.
    start : array, number, or any nesting of them in tuples, lists and dicts
        The initial x. Not modified. Leaves that are not floating-point are constants and stay unchanged. If a leaf is a
        field distributed over MPI ranks, PETSc/TAO performs the minimization. Then only method="lbfgs", maxiter,
        tolerance, callback and bounds that are numbers can be used.
    method : str
        "lbfgs", "gd", "adam", "newton_cg", "gauss_newton", "levenberg_marquardt", "half_inverse",
        "physical_gradient", or "admm". The method "admm" adds weight |K x|_1 to the loss; use it for results that are
        sparse or piecewise constant. Methods for `constraints`: "augmented_lagrangian" (many unknowns), "mma" (many
        unknowns and few inequalities; requires the extra `design`), "slsqp" and "trust_constr" (up to about 1000
        unknowns), "ipopt" (requires cyipopt).
    maxiter : int
        Maximum number of iterations. With 0 the loss is evaluated at the start, and the start is returned.
    tolerance : float or callable
        The run has converged when the norm of the gradient is at most `tolerance` times its value at the start. The
        norm is Euclidean, or with a `metric` M that of the search direction, sqrt(g.M^-1 g). There is no absolute
        tolerance. A function ``tolerance(record, first_record)`` returns True if the run
        has converged. With `certified` as tolerance, minimize also chooses the accuracy of the linear solves in the
        loss.
    callback : callable, optional
        ``callback(record, x)`` is called after every iteration. The run stops if it returns a true value.
    progress : bool or str
        Show a progress bar on standard error; a string is used as its label. Requires the extra `plot`.
    gradient : callable, optional
        ``gradient(x)`` returns the gradient, a tree with the structure of x; entries of dicts are matched by key.
        Default: reverse-mode differentiation of the loss.
    bounds : (lower, upper) or scipy.optimize.Bounds, optional
        Each of the two is a number, None (no bound), or a tree like start. In a tree, a number or None may replace a
        subtree and then applies to all of its entries; entries of dicts are matched by key. An array may replace a
        tuple or a list, with one bound for each entry. SciPy's sequence of one pair for each unknown is refused: write
        ``tuple(map(np.array, zip(*pairs)))``. Points outside the bounds are clipped. half_inverse with a rate does not
        compare losses, so with bounds it may converge to another point than the other methods.
    project : callable, optional
        ``project(x)``, a differentiable projection onto a linear or affine space, such as dp.projection(grid).
        loss(project(x)) is minimized, and the returned x is a projected one. At the start and at the result, test
        points check that the map is affine and idempotent; otherwise, as for np.clip, ValueError is raised. Cannot be
        used together with bounds, and not with the methods for constraints.
    batches : sequence or callable, optional
        In iteration i the loss is ``loss(x, batches[i % len(batches)])``, or ``loss(x, batches(i))`` for a function.
        Available for gd with a rate, adam, half_inverse and physical_gradient. The result is the last point, not the
        best one. The run has converged when the gradient has met the tolerance in len(batches) successive iterations
        (10 for a function).
    checkpoint : path, optional
        Folder in which the last two states of the run are stored. If the run was killed, interrupted, or stopped by
        its callback or by maxiter, the same call continues from the last stored state and gives bitwise the same
        result as a run without interruption. A new problem needs a new folder. Not available for mma, slsqp,
        trust_constr and ipopt.
    constraints : callable, or a list, tuple or dict of callables, optional
        Each function ``g(x)`` returns a number or an array that is <= 0 at a feasible point; `equal` of a function
        stands for g(x) == 0. A NonlinearConstraint or LinearConstraint of SciPy is used with its limits lb and ub; its
        function takes the flat vector of unknowns, and its `jac` is used if it is a function. The start may violate the
        constraints. If the sign of a function is wrong, the opposite set is feasible.
    metric : Operator, or tree of Operators and None, optional
        The inner product of the unknowns, for lbfgs, gd and newton_cg: a symmetric positive definite operator M with
        <u, v> = u.M v. For a tree, each array of start has its own operator; None stands for u.v. Search directions are
        then those of M^-1 g, so that the number of iterations does not grow with the number of cells, see the notes. M
        may be an `inverse`; its operator is then applied instead of a solve. With bounds M must be diagonal.
    **options
        Options of the method, listed in the table below. Any other option raises TypeError.

        ===================  ==============  ============  =============================================================
        method               option          default       meaning
        ===================  ==============  ============  =============================================================
        lbfgs                memory          10            number of past steps that define the Hessian approximation
        lbfgs                line_search     20            maximum number of trial points in one line search
        gd                   rate            None          learning rate; None: found by backtracking
        gd                   momentum        0.0           factor of the previous step that is added, in [0, 1)
        gd                   line_search     None          "backtracking": halve the step until the loss decreases
        adam                 rate            1e-3          size of a step in every entry, or a function, see below
        adam                 betas           (0.9, 0.999)  decay rates of the two running means
        adam                 epsilon         1e-8          added to the denominator, relative to the first gradient
        adam                 max_norm        None          norm to which longer gradients are scaled, see below
        newton_cg            inner           200           maximum number of Hessian products in one iteration
        gauss_newton         apart           False         True: residuals along axis 0 are samples, see below
        gauss_newton         dense           None          True: form the Jacobian; None: form it if it is small
        gauss_newton         absolute_sigma  False         True: residuals have unit variance, see below
        gauss_newton         accuracy        1e-10         relative tolerance of a step if the Jacobian is not formed
        levenberg_marquardt  damping         1e-3          initial damping, relative to the largest entry of diag(J^T J)
        levenberg_marquardt  apart, dense    same          as for gauss_newton
        levenberg_marquardt  absolute_sigma  False         as for gauss_newton
        levenberg_marquardt  accuracy        1e-10         as for gauss_newton
        half_inverse         rate            None          factor of the step; None: found by backtracking, see below
        half_inverse         power           0.75          the exponent p in the step J^T (J J^T)^-p r
        half_inverse         truncation      1e-6          see `update_direction`
        half_inverse         rank            None          see `update_direction`
        half_inverse         apart           False         as for gauss_newton
        half_inverse         form            "auto"        "dense", "krylov"; "auto" forms the Jacobian if it is small
        half_inverse         absolute_sigma  False         as for gauss_newton
        physical_gradient    physics         required      the simulator, as for `physical_gradient`
        physical_gradient    inverse         required      the inverse simulator, as for `physical_gradient`
        physical_gradient    rate            1.0           factor of the step
        admm                 weight          required      factor of the sum of absolute entries of K x
        admm                 operator        None          the linear map K from x to an array; None: the identity
        admm                 rho             None          initial penalty parameter; None: chosen from the start
        admm                 inner           10            L-BFGS iterations in each iteration, or a function, see below
        admm                 prox            None          proximal map ``prox(v, t)`` that replaces the soft threshold
        ===================  ==============  ============  =============================================================

        apart=True computes the Jacobian faster if the residuals along axis 0 belong to independent samples. The loss
        must then accept every leaf of x with an additional leading axis, which holds one copy of x for each sample. The
        number of vector-Jacobian products is the number of residuals of one sample.
        A function ``rate(step)`` is a schedule of adam: it returns the rate of step 0, 1, ... Schedules of optax can be
        used. max_norm, as in optax.clip_by_global_norm, limits the Euclidean norm of the gradient over all leaves of x.
        half_inverse without a rate begins with s^(2 p - 2), where s is the largest singular value of J: the length of a
        Gauss-Newton step. Its first step is not longer than x, unless x is 0. With batches losses are not compared; the
        rate is then the smaller of s^(2 p - 2) and 2 / m for a batch with m samples along axis 0 of the residuals.
        absolute_sigma=True states that the residuals were divided by their standard deviations. It selects the formula
        of `covariance`, as in scipy.optimize.curve_fit.
        weight is not multiplied by cell volumes. For a piecewise constant result on a uniform grid write
        operator=dp.gradient(grid), and multiply the weight by the volume of a cell.
        inner may be a function ``inner(target, rho, x)`` that returns the minimizer of loss(x) plus rho / 2 times the
        sum of (K x - target)^2; bounds cannot be used with it. With prox the reported values contain the loss only.
        For admm a tolerance of about 1e-4 is usual.

        The options of the methods for constraints:

        ====================  ===================  =======  ==========================================================
        method                option               default  meaning
        ====================  ===================  =======  ==========================================================
        augmented_lagrangian  penalty              1.0      initial penalty parameter, in units of loss / constraint^2
        augmented_lagrangian  growth               10.0     its factor if the violation has not fallen enough
        augmented_lagrangian  multipliers          None     initial multipliers, such as best.multipliers of another run
        augmented_lagrangian  inner                50       maximum number of steps between updates of the multipliers
        augmented_lagrangian  memory, line_search  same     as for lbfgs
        mma                   model                "mma"    "mma" (NLopt's LD_MMA), or "quadratic" (LD_CCSAQ)
        trust_constr          radius               1.0      initial trust radius, in units of x
        trust_constr          barrier              0.1      initial barrier parameter of inequalities and bounds
        ipopt                 settings             None     dict of options of Ipopt
        ====================  ===================  =======  ==========================================================

        With constraints, the run has converged when both the feasibility and the optimality of `Minimum` are at most
        `tolerance`. With a function as tolerance, the feasibility must be at most 1e-6 as well. The methods work with
        scaled numbers: each leaf of x is divided by the root mean square of its entries at the start (by the largest
        finite bound if they are 0), the loss by the norm of its gradient with respect to the scaled x, and the values
        of each constraint function by one unit (see `Minimum`). Put constraints of different size into different
        functions. The units are powers of two. For mma a tolerance of about 1e-6 is usual.

    Returns
    -------
    Minimum
        The result, with the attributes `x` (the best point found), `value`, `history` (one record for each iteration),
        `message`, `converged` and `evaluations`. For least-squares problems, `covariance` is s^2 (J^T J)^(-1) with
        s^2 = |r|^2 / (m - n), or (J^T J)^(-1) with absolute_sigma=True. str() of the result is a table of the history.
        Ctrl-C ends the run; the best point so far is returned, with the message "interrupted". A second Ctrl-C raises
        KeyboardInterrupt at once. With constraints, `multipliers`, `constraint_values`, `feasibility` and `optimality`
        belong to x. The best point is then the one that met the tolerance; without such a point, among the points with
        a feasibility of at most 1e-6 the one with the lowest loss, and if there is none, the one with the smallest
        violation. If there is none, the sum of the squares of the violations is minimized from there; if a point that
        violates the constraints is a minimum of this sum, it is returned, and the message begins with "infeasible".

    Raises
    ------
    ShapeError
        If the lower or upper bounds, or the result of `project`, have another tree structure than start. The message
        gives the path of the entry.
    DerivativeError
        If the result of `gradient` has another tree structure than start.
    ValueError
        If the method is unknown, or takes no constraints or no equalities; if maxiter, tolerance, bounds or an option
        is out of range; if the metric is not symmetric, not positive definite or singular; or if the checkpoint folder
        contains a run with another method, options, bounds, metric, start (constant leaves included), loss or batches.
    KeyboardInterrupt
        If Ctrl-C is pressed before the loss has been evaluated at the start, or a second time.
    TypeError
        If the method has no such option, or an argument that must be a number is something else.
    UnstableStepError, ConvergenceError, NonFiniteError
        If the loss raises one of them at the start, or is NaN or infinite there. At a trial point these cases count as
        an infinite loss: the method tries a point closer to the current one, and the record of the iteration lists the
        rejected point.
    ImportError
        If `progress` is given and tqdm is not installed, or if the library of the method is not installed.

    See Also
    --------
    equal, value_and_grad, update_direction, physical_gradient, smoothness, total_variation, certified, convergence,
    flatten, ensemble, laplace

    Notes
    -----
    For complex unknowns see docs/guides/complex_numbers.md.
    Metric: the gradient g is a list of derivatives. The direction of steepest descent in the inner product of M is
    -M^-1 g (M^-1 g is the Riesz representer of the derivative). With ``L2 = dp.diagonal(grid.cells, grid.volumes)``
    the inner product of L2 has the metric L2, and that of H1 ``L2 @ (dp.identity(grid.cells) - dp.laplacian(grid))``.
    gd steps along -M^-1 g, lbfgs begins its recursion with M^-1, and newton_cg preconditions its conjugate gradients
    with M^-1 and measures steps in the norm of M. A factor of M does not change the run, except for gd with a rate. The
    inverse of M is set up once, by `inverse`. gd needs one solve with M in an iteration, lbfgs up to three, newton_cg
    one for each Hessian product. Test vectors check that M is symmetric and positive definite.
    With `project` the search directions are those of M^-1 times the gradient of loss(project(x)).
    Constraints: at a solution the Lagrangian loss + sum(y * c) of the constraints c and the multipliers y has the
    gradient 0 in the unknowns that no bound holds, with y >= 0 and y * c = 0 for inequalities (Karush-Kuhn-Tucker
    conditions). Its gradient is g + J^T y with the Jacobian J of the constraints. One backward pass of each function,
    with its part of y as cotangent, gives J^T y: augmented_lagrangian forms no Jacobian. The other methods compute J by
    one backward pass for each entry of a constraint, or by one forward pass for each unknown if these are fewer.

    References
    ----------
    J. Nocedal, S. J. Wright, Numerical Optimization, Springer, 2006: L-BFGS (chapter 7), least squares (10), conditions
    of optimality (12), augmented Lagrangian methods (17), sequential quadratic programming (18).

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
    if metric is not None and not getattr(chosen, "uses_metric", False):
        raise TypeError(f"{method} takes no metric; leave it out, or write method= one of {', '.join(WITH_METRIC)}")
    maxiter = check_whole("maxiter of minimize", maxiter, 0, "; the default is 100")
    _check_tolerance(tolerance)
    bounds = pair_of_bounds(bounds)
    other_arguments = {
        "progress": progress,
        "gradient": gradient,
        "project": project,
        "batches": batches,
        "checkpoint": checkpoint,
        "constraints": constraints,
        "metric": metric,
    }
    implementation = backend_of(leaves(start)).implementation(minimize)
    if implementation is not minimize:
        other_arguments = {**options, **other_arguments}
        return implementation(loss, start, method, maxiter, tolerance, callback, bounds, other_arguments)
    if isinstance(chosen, ConstrainedMethod):
        arguments = loss, start, chosen, maxiter, tolerance, callback, bounds
        return minimize_constrained(*arguments, other_arguments)
    if constraints is not None:
        raise ValueError(f"{method} takes no constraints; write method= one of {', '.join(CONSTRAINED)}")
    if isinstance(chosen, ADMM):
        _check_unused("admm", {**other_arguments, "tolerance": callable(tolerance)})
        return chosen.minimize(loss, start, maxiter, tolerance, callback, bounds, minimize)
    if hasattr(tolerance, "inside"):
        loss, gradient = _certified(loss, gradient, tolerance, checkpoint)
    batches_by_iteration = _batches(batches, method, chosen)
    packing = Packing(start, "start")
    box = Box(bounds, packing)
    if metric is not None:
        chosen.metric = _metric(metric, box, packing)
    loss = chosen.composed(loss)
    projection = None
    if project is not None:
        projection = _projection(project, box, packing, start)
        loss = projection.loss(loss)
        if gradient is not None:
            gradient = projection.gradient(gradient)
    residual_options = chosen if chosen.uses_residuals else None
    objective = Objective(loss, gradient, packing, box, batches_by_iteration, residual_options, chosen.metric)
    settings = {
        "method": method,
        "set of options": sorted(options.items()),
        "pair of bounds": (box.lower, box.upper),
        "start": start,
    }
    if metric is not None:
        settings["metric"] = chosen.metric.fingerprint
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
    """Start or resume a run. Iterate until maxiter is reached, the monitor ends the run, or no step is found."""
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
    """Return an instance of the named method with the given options; raise if a name is unknown."""
    check_choice("method", name, METHODS)
    method_class: Any = METHODS[name]
    _check_names(name, options, [field.name for field in fields(method_class)])
    return method_class(**options)


def _certified(loss, gradient, tolerance, checkpoint):
    """Return the loss and the gradient, wrapped so that `certified` sets the accuracy of their linear solves."""
    if checkpoint is not None:
        raise ValueError(
            "checkpoint cannot be used with a tolerance of dp.certified, whose solutions are not saved; leave "
            "checkpoint out, or write a number as tolerance"
        )
    return tolerance.inside(loss, gradient)


def _batches(batches, name, method):
    """Return the batches; raise ValueError if the method compares losses, because those of two batches differ."""
    by_iteration = Batches(batches)
    if by_iteration.varied and method.compares_losses:
        raise ValueError(f"{name} compares losses and cannot use batches; write method='adam', or give gd a rate")
    return by_iteration


def _projection(project, box, packing, start):
    """Return the projection of the unknowns; raise ValueError if there are bounds too."""
    if box.bounded:
        raise ValueError(
            "project and bounds cannot be used together: a projected point may be outside of the bounds; leave one "
            "of them out"
        )
    return Projection(project, packing, start)


def _metric(metric, box, packing):
    """Return the inner product of the unknowns; raise ValueError if it cannot be used with the bounds."""
    inner_product = Metric(metric, packing)
    if box.bounded and not inner_product.diagonal:
        raise ValueError(
            "with bounds the metric must be diagonal, such as dp.diagonal(grid.cells, grid.volumes): the direction of "
            "another one leads out of them; leave bounds or metric out"
        )
    return inner_product


def _check_unused(method, arguments):
    """Raise TypeError if an argument that the method does not use was given."""
    for name, value in arguments.items():
        if value:
            raise TypeError(f"{method} does not use {name}; leave it out")


def _check_names(method, options, names):
    """Raise TypeError for an option that the method does not have, with advice on similar names."""
    parameters = [parameter for parameter in signature(minimize).parameters if parameter != "options"]
    for option in options:
        if option in names:
            continue
        advice = foreign_keyword_advice(option, parameters)
        if advice:
            advice = f"; write {advice}"
        else:
            advice = advice_near(option, [*names, *parameters])
        raise TypeError(f"{method} has no option {option!r}; it has {', '.join(names) or 'none'}{advice}")


def _check_tolerance(tolerance):
    """Raise unless the tolerance is a function, a number >= 0, or infinity, which accepts any gradient."""
    infinite = is_number(tolerance) and tolerance == inf
    if not callable(tolerance) and not infinite:
        check_number("tolerance of minimize", tolerance, ">= 0", "; the default is 1e-8")
