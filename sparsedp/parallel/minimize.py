"""minimize() for distributed fields, by PETSc's optimizer TAO.

The unknowns form a distributed PETSc vector. Each rank contributes its blocks of the distributed fields. Unknowns that
exist on every rank, such as numbers and NumPy arrays, are stored in the part of rank 0 only. Evaluations, the history
and the convergence test use the same code as on one process.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from sparsedp._utils.pytree import labels, leaves, mapped
from sparsedp._utils.validation import check_finite
from sparsedp.autodiff.derivative import unwarned, value_and_grad
from sparsedp.autodiff.flattening import FINITE, Packing
from sparsedp.autodiff.tape import is_variable
from sparsedp.optimize.batches import Batches
from sparsedp.optimize.box import Box
from sparsedp.optimize.monitor import Monitor
from sparsedp.optimize.objective import Objective
from sparsedp.optimize.result import Evaluation, Minimum, NoStepFound, RoundingReached
from sparsedp.parallel.fields import DistributedField

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["minimize_on_ranks"]

MOST_EVALUATIONS = 2**31 - 1  # disables TAO's limit of evaluations; only iterations are limited
LARGEST_BOUNDS = PETSc.NINFINITY, PETSc.INFINITY  # TAO ignores bounds with these values
STATIONARY = 1e-6  # a failed line search is attributed to rounding if the relative gradient is below this


class LocalUnknowns:
    """The part of a tree of unknowns that this rank contributes to the distributed vector.

    Parameters
    ----------
    comm : mpi4py.MPI.Comm
    start : tree
    """

    def __init__(self, comm: MPI.Comm, start: Any) -> None:
        self.comm = comm
        self.start = start

    def blocks(self, tree: Any) -> Any:
        """Return the tree of local blocks. Unknowns that exist on every rank are empty arrays except on rank 0."""

        def block(leaf):
            if isinstance(leaf, DistributedField):
                return leaf.flat
            if is_variable(leaf) and self.comm.rank > 0:
                return np.zeros(0)
            return leaf

        return mapped(block, tree)

    def tree(self, blocks: Any) -> Any:
        """Return the tree of unknowns, given the tree of local blocks. All ranks must call it together."""

        def unknown(leaf, block):
            if isinstance(leaf, DistributedField):
                return leaf.like(block.copy())
            if is_variable(leaf):
                return self.comm.bcast(block)
            return leaf

        return mapped(unknown, self.start, blocks)


class DistributedObjective(Objective):
    """The loss as a function of the distributed vector of unknowns.

    Parameters
    ----------
    loss : callable
    unknowns : LocalUnknowns
    packing : Packing
        The map between the tree of local blocks and flat vectors.
    box : Box
    """

    def __init__(self, loss: Callable[[Any], Any], unknowns: LocalUnknowns, packing: Packing, box: Box) -> None:
        super().__init__(loss, None, packing, box, Batches(None))
        self.unknowns = unknowns

    def _value_and_gradient(self, vector):
        """Return the loss and the local part of its gradient; raise on all ranks if the gradient is not finite."""
        with unwarned():  # a gradient that is not finite raises NonFiniteError below
            value, gradient = value_and_grad(self._loss)(self.unknowns.tree(self._packing.unpack(vector)))
        start = self.unknowns.start
        for name, g, x in zip(labels(start, "start"), leaves(gradient), leaves(start)):
            if is_variable(x):
                check_finite(f"the gradient of {name}", g, FINITE)
        return float(value), self._packing.pack_gradient(self.unknowns.blocks(gradient))

    def projected_gradient(self, evaluation: Evaluation) -> list[Any]:
        """Return the projected gradient (see `Objective`) as a list of distributed fields and arrays."""
        blocks = self._packing.unpack(super().projected_gradient(evaluation))
        return [leaf for leaf in leaves(self.unknowns.tree(blocks)) if is_variable(leaf)]


def minimize_on_ranks(
    comm: MPI.Comm,
    loss: Callable[[Any], Any],
    start: Any,
    method: str,
    maxiter: int,
    tolerance: Any,
    callback: Callable[..., Any] | None,
    bounds: Any,
    other_arguments: dict[str, Any],
) -> Minimum:
    """Minimize a loss whose argument contains distributed fields. All ranks must call it together.

    Parameters
    ----------
    comm : mpi4py.MPI.Comm
    loss, start, method, maxiter, tolerance, callback, bounds
        As for `minimize`.
    other_arguments : dict
        The other arguments of `minimize` and the options of the method. All of them must be None or False.

    Returns
    -------
    Minimum

    Raises
    ------
    TypeError
        If the method is not lbfgs, a bound is an array, the tolerance is one of `certified`, or another argument is
        given.
    """
    _check_arguments(method, tolerance, bounds, other_arguments)
    unknowns = LocalUnknowns(comm, start)
    blocks = unknowns.blocks(start)
    packing = Packing(blocks, "start")
    objective = DistributedObjective(loss, unknowns, packing, Box(bounds, packing))

    callback_of_blocks = None
    if callback is not None:

        def callback_of_blocks(record, local_blocks):
            return callback(record, unknowns.tree(local_blocks))

    monitor = Monitor(objective, packing, tolerance, callback_of_blocks)
    _run(comm, objective, monitor, objective.box.nearest(packing.pack(blocks)), int(maxiter))
    return monitor.minimum(unknowns.tree(packing.unpack(objective.best.point)), method)


def _check_arguments(method, tolerance, bounds, other_arguments):
    """Raise TypeError for arguments that are not supported with TAO."""
    unsupported = [name for name, value in other_arguments.items() if value not in (None, False)]
    if hasattr(tolerance, "inside"):
        unsupported.append("certified")
    if any(np.ndim(leaf) for side in bounds or () for leaf in leaves(side)):
        unsupported.append("bounds of arrays")
    if method != "lbfgs" or unsupported:
        raise TypeError(
            "minimize of fields on ranks takes lbfgs, bounds of numbers and a callback, "
            f"got {', '.join([method, *unsupported])}; leave the rest out, or start from dp.gather(u)"
        )


def _run(
    comm: MPI.Comm, objective: DistributedObjective, monitor: Monitor, x: NDArray[np.float64], maxiter: int
) -> None:
    """Run TAO's limited-memory quasi-Newton method with bounds, from x, until the monitor stops it."""
    first = objective.evaluate_start(x)
    unused_evaluations = [first]  # TAO evaluates the start too: reuse this evaluation
    highest_value = max(first.value, 1.0)

    def value_and_gradient(tao, solution, gradient):
        nonlocal highest_value
        if unused_evaluations:
            evaluation = unused_evaluations.pop()
        else:
            evaluation = objective(solution.array.copy())
        if evaluation.refused:  # return a large finite value: TAO then shortens the step, but fails for infinity
            gradient.setArray(np.zeros(solution.local_size))
            return 2 * highest_value
        gradient.setArray(evaluation.gradient)
        highest_value = max(highest_value, evaluation.value)
        return evaluation.value

    def test_convergence(tao):
        monitor(Evaluation(tao.solution.array.copy(), tao.function, tao.gradient.array.copy()))
        if monitor.message or monitor.iteration >= maxiter:
            tao.setConvergedReason(PETSc.TAO.Reason.CONVERGED_USER)

    def vector(array):
        return PETSc.Vec().createWithArray(array, comm=comm)

    PETSc.garbage_cleanup(comm)  # frees PETSc objects without references, a collective operation
    solution = vector(x)
    lower = vector(np.clip(np.broadcast_to(objective.box.lower, x.shape), *LARGEST_BOUNDS))
    upper = vector(np.clip(np.broadcast_to(objective.box.upper, x.shape), *LARGEST_BOUNDS))
    tao = PETSc.TAO().create(comm)
    tao.setType("blmvm")
    tao.setObjectiveGradient(value_and_gradient, vector(0.0 * x))
    tao.setVariableBounds([lower, upper])
    tao.setConvergenceTest(test_convergence)
    tao.setTolerances(0.0, 0.0, 0.0)
    tao.setMaximumIterations(maxiter)
    tao.setMaximumFunctionEvaluations(MOST_EVALUATIONS)
    tao.solve(solution)
    stopped_by_tao = not monitor.message and monitor.iteration < maxiter
    if tao.getConvergedReason() < 0 and stopped_by_tao:
        message = "the line search found no lower point"
        if monitor.history[-1].gradient_norm <= STATIONARY * monitor.history[0].gradient_norm:
            monitor.stop(RoundingReached(message))
        else:
            monitor.stop(NoStepFound(message))
