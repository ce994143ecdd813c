"""minimize of fields that lie on ranks: the loop is that of PETSc's TAO, all else that of one process.

The unknowns are a vector of PETSc: of a field its blocks, of what every rank knows rank 0 holds all.
"""

import numpy as np
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
from sparsedp.optimize.result import Evaluation, NoStepFound, RoundingReached
from sparsedp.parallel.fields import DistributedField

__all__ = ["minimized"]

MANY = 2**31 - 1  # evaluations: iterations are counted
FAR = PETSc.NINFINITY, PETSc.INFINITY  # bounds that are none
FLAT = 1e-6  # share of the gradient at the start, below which a search that ends has come to rounding


class Blocks:
    """What this rank holds of a tree of unknowns, and the tree again."""

    def __init__(self, comm, start):
        self.comm, self.start = comm, start

    def of(self, tree):
        """Tree -> that of the blocks; what every rank knows is on rank 0."""
        return mapped(self._block, tree)

    def _block(self, leaf):
        if isinstance(leaf, DistributedField):
            return leaf.flat
        return np.zeros(0) if is_variable(leaf) and self.comm.rank else leaf

    def tree(self, blocks):
        """The tree of the blocks -> fields, and what every rank knows."""
        return mapped(self._whole, self.start, blocks)

    def _whole(self, leaf, block):
        if isinstance(leaf, DistributedField):
            return leaf.like(block.copy())
        return self.comm.bcast(block) if is_variable(leaf) else leaf


class Spread(Objective):
    """The loss on what the ranks hold; its gradient comes with it, and is judged by all of them together."""

    def __init__(self, loss, blocks, packing, box):
        super().__init__(loss, None, packing, box, Batches(None))
        self.blocks = blocks

    def _value_and_gradient(self, vector):
        with unwarned():  # a gradient that is not finite is refused below
            value, slopes = value_and_grad(self._loss)(self.blocks.tree(self._packing.unpack(vector)))
        for name, g, x in zip(labels(self.blocks.start, "start"), leaves(slopes), leaves(self.blocks.start)):
            if is_variable(x):
                check_finite(f"the gradient of {name}", g, FINITE)
        return float(value), self._packing.pack_gradient(self.blocks.of(slopes))

    def projected_gradient(self, evaluation):
        """The gradient as fields, 0 where the bounds hold an unknown."""
        blocks = self._packing.unpack(super().projected_gradient(evaluation))
        return [*filter(is_variable, leaves(self.blocks.tree(blocks)))]


def minimized(comm, loss, start, method, maxiter, tolerance, callback, bounds, more):
    """See `minimize`; `more`: what else was given."""
    given = [name for name, value in more.items() if value not in (None, False)]
    given += ["certified"] * hasattr(tolerance, "inside")
    if any(np.ndim(side) for sides in bounds or () for side in leaves(sides)):
        given.append("bounds of arrays")
    if method != "lbfgs" or given:
        raise TypeError(
            "minimize of fields on ranks takes lbfgs, bounds of numbers and a callback, "
            f"got {', '.join([method, *given])}; leave the rest out, or start from dp.gather(u)"
        )
    blocks = Blocks(comm, start)
    packing = Packing(blocks.of(start), "start")
    trials = Spread(loss, blocks, packing, Box(bounds, packing))
    watch = Monitor(trials, packing, tolerance, callback and (lambda record, x: callback(record, blocks.tree(x))))
    _search(comm, trials, watch, trials.box.nearest(packing.pack(blocks.of(start))), int(maxiter))
    return watch.minimum(blocks.tree(packing.unpack(trials.best.point)), method)


def _search(comm, trials, watch, x, maxiter):
    """TAO from x until the watch stops it; inside the bounds, by a quasi-Newton method of limited memory."""
    evaluated = [trials.evaluate_start(x)]  # where TAO begins
    highest = [max(evaluated[0].value, 1.0)]

    def objective(tao, x, g):
        trial = evaluated.pop() if evaluated else trials(x.array.copy())
        g.setArray(np.zeros(x.local_size) if trial.refused else trial.gradient)
        if trial.refused:  # TAO goes back from what is high, not from what is infinite
            return 2 * highest[0]
        highest[0] = max(highest[0], trial.value)
        return trial.value

    def judge(tao):
        watch(Evaluation(tao.solution.array.copy(), tao.function, tao.gradient.array.copy()))
        if watch.message or watch.iteration >= maxiter:
            tao.setConvergedReason(PETSc.TAO.Reason.CONVERGED_USER)

    PETSc.garbage_cleanup(comm)  # what Python has dropped is freed here, on all ranks together
    sides = [np.clip(np.broadcast_to(side, x.shape), *FAR) for side in (trials.box.lower, trials.box.upper)]
    solution, gradient, *bounds = (PETSc.Vec().createWithArray(part, comm=comm) for part in (x, 0.0 * x, *sides))
    tao = PETSc.TAO().create(comm)
    tao.setType("blmvm")
    tao.setObjectiveGradient(objective, gradient)
    tao.setVariableBounds(bounds)
    tao.setConvergenceTest(judge)
    tao.setTolerances(0.0, 0.0, 0.0)
    tao.setMaximumIterations(maxiter)
    tao.setMaximumFunctionEvaluations(MANY)
    tao.solve(solution)
    if tao.getConvergedReason() < 0 and not watch.message and watch.iteration < maxiter:
        flat = watch.history[-1].gradient_norm <= FLAT * watch.history[0].gradient_norm
        error = RoundingReached if flat else NoStepFound
        watch.stop(error("the line search found no lower point"))
