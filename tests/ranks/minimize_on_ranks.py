"""minimize of fields on ranks, by PETSc's TAO, compared with one process.

mpirun -n 2 python -m mpi4py tests/ranks/minimize_on_ranks.py
"""

import autograd.numpy as anp
import numpy as np
from flow_on_ranks import COMM, close, refused

import sparsedp as dp

PLAIN = dp.Grid((9, 8), size=1.0)


def problem(grid, u):
    """A loss of a field, a number and a whole array, that is refused where the field is large; its start."""
    L, (x, y) = dp.laplacian(grid, dp.dirichlet), grid.centres()

    def loss(tree):
        if np.max(getattr(tree["u"], "_value", tree["u"])) > 2.0:
            raise dp.errors.NonFiniteError("beyond what the loss takes")
        gap = 0.01 * L(tree["u"]) + tree["k"] * anp.sin(3 * x) * y
        return anp.sum(gap**2) + (tree["k"] - 2.0) ** 2 + anp.sum((tree["w"] - 1.0) ** 2) + anp.sum(tree["u"] ** 2)

    return loss, {"u": u, "k": 0.1, "n": 3, "w": np.array([0.5, 2.0])}


def minima():
    """The same minimum as on one process, with bounds and without; whole unknowns take the search of one process."""
    for bounds in (None, (-0.1, 1.2)):
        results = []
        for grid, field in ((PLAIN, None), (dp.distribute(PLAIN, COMM), dp.identity(dp.distribute(PLAIN, COMM).cells))):
            zero = np.zeros(PLAIN.shape)
            loss, start = problem(grid, zero if field is None else field(zero))
            best = dp.minimize(loss, start, maxiter=200, bounds=bounds, tolerance=1e-7)
            assert best.converged and best.x["n"] == 3 and type(best.x["k"]) is float, best
            assert best.history[-1].evaluations <= best.evaluations and best.history[0].gradient_norm > 0
            results.append((best.value, best.x["u"], best.x["k"], best.x["w"]))
        for actual, expected, tol in zip(*reversed(results), (1e-10, 1e-5, 1e-5, 1e-5)):
            close(actual, expected, tol, f"minimize with {bounds}")
    grid = dp.distribute(PLAIN, COMM)
    both = [dp.minimize(*problem(one, np.zeros(PLAIN.shape)), maxiter=9) for one in (PLAIN, grid)]
    close(both[1].x["u"], both[0].x["u"], 1e-9, "minimize of what all know")
    assert both[0].evaluations == both[1].evaluations


def barrier(u):
    """A loss that is refused from u = 1 on."""
    if np.max(getattr(u, "_value", u)) >= 1.0:
        raise dp.errors.UnstableStepError("beyond the barrier")
    return -anp.sum(anp.log(1.0 - u)) - 10.0 * anp.sum(u)


def ends():
    """A callback, maxiter, trial points that are refused, options that TAO does not take, a gradient of NaN."""
    grid = dp.distribute(PLAIN, COMM)
    loss, start = problem(grid, dp.identity(grid.cells)(np.zeros(PLAIN.shape)))
    seen = []
    best = dp.minimize(loss, start, callback=lambda record, x: seen.append(x["w"][0]) or record.iteration == 2)
    assert best.message == "stopped by the callback" and len(best.history) == 3 and len(seen) == 2
    best = dp.minimize(loss, start, maxiter=0)
    assert best.message == "stopped after 0 iterations, the limit maxiter" and len(best.history) == 1
    wall = dp.minimize(barrier, start["u"], tolerance=1e-6)  # its minimum is where u = 0.9, and it ends at 1
    close(wall.x, np.full(PLAIN.shape, 0.9), 1e-6, "barrier")
    assert any(record.failed for record in wall.history), wall
    words = (
        "minimize of fields on ranks takes lbfgs, bounds of numbers and a callback, got adam, rate; "
        "leave the rest out, or start from dp.gather(u)"
    )
    refused(TypeError, words, lambda: dp.minimize(loss, start, "adam", rate=0.1))
    refused(TypeError, "got lbfgs, bounds of arrays;", lambda: dp.minimize(loss, start, bounds=(None, start)))
    root = lambda x: anp.sum(anp.sqrt(x))
    with np.errstate(all="ignore"):
        words = "the gradient of start must be finite"
        refused(dp.errors.NonFiniteError, words, lambda: dp.minimize(root, 0.0 * grid.volumes))


if __name__ == "__main__":
    minima()
    ends()
    if COMM.rank == 0:
        print("all agree")
