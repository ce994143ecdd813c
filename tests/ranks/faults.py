"""Errors planted on one rank: each is raised on all ranks, with the same type and message.

    mpirun -n 2 python -m mpi4py tests/ranks/faults.py
    mpirun -n 2 python -m mpi4py tests/ranks/faults.py kill

With a word the last rank is killed, finds no file, or fails where the others wait for a message of the user's own:
the job must end.
"""

import gc
import os
import signal
import sys
from contextlib import contextmanager

import autograd.numpy as anp
import numpy as np
from mpi4py import MPI

import sparsedp as dp
from sparsedp.parallel import cut, solve

COMM = MPI.COMM_WORLD
LAST = COMM.rank == COMM.size - 1 and COMM.size > 1  # where faults are planted
PLAIN = dp.Grid((12, 10), size=1.0)
GRID = dp.distribute(PLAIN, COMM)
U = np.random.default_rng(0).standard_normal(PLAIN.shape)
RUNS = np.random.default_rng(None if LAST else 1)  # a generator without a seed, on the last rank


@contextmanager
def planted(owner, name, error):
    """A method that raises on the last rank."""
    kept = getattr(owner, name)

    def fault(*args, **options):
        if LAST:
            raise error
        return kept(*args, **options)

    setattr(owner, name, fault)
    try:
        yield
    finally:
        setattr(owner, name, kept)


def with_planted_fault(owner, name, error, act):
    """A case: the action, while a method raises on the last rank."""

    def case():
        with planted(owner, name, error):
            act()

    return case


def fail_on_last_rank(error=None):
    """Raise an error of the user's own code on the last rank."""
    if LAST:
        raise error or ZeroDivisionError("of one rank")
    return 0.0


def on_last_rank(usual, on_the_last):
    """Return another value on the last rank."""
    if LAST:
        return on_the_last
    return usual


class ErrorOfTwoArguments(Exception):
    """An error whose constructor takes other arguments than a message."""

    def __init__(self, one, two):
        super().__init__(f"{one} and {two}")


def laplacian():
    """Return a new operator, not yet restricted to blocks."""
    return dp.laplacian(GRID, dp.dirichlet)


def misfit(u):
    """Return a loss that applies operators."""
    return anp.sum(anp.sin(laplacian()(u)) ** 2)


def loss_that_catches_an_error(u):
    """Return another loss if the first raises an error."""
    try:
        return misfit(u)
    except MemoryError:
        return anp.sum(u)


def with_last_entry(value):
    """Return the field with another number in its last cell, which is in the block of the last rank."""
    u = U.copy()
    u[-1, -1] = value
    return dp.identity(GRID.cells)(u)


def rollout(step, u=None):
    """Nine steps from a field on ranks."""
    return dp.rollout(step, with_last_entry(1.0) if u is None else u, 0.7, 9)


def heat(u, k):
    """One step."""
    return u + 1e-3 * k * laplacian()(u)


FIELD = with_last_entry(1.0)
STEP = dp.identity(GRID.cells) - 0.3 * dp.laplacian(GRID)
WALL = -dp.laplacian(GRID)

# name: (type, part of the message, call). Where the message names no rank, all ranks raise the error themselves.
FAULTS = {
    "NaN in one block": (
        dp.errors.NonFiniteError,
        "the first at (11, 9)",
        lambda: dp.inverse(STEP)(with_last_entry(np.nan)),
    ),
    "NaN in one block of a state": (
        dp.errors.NonFiniteError,
        "rollout",
        lambda: rollout(heat, with_last_entry(np.nan)),
    ),
    "singular": (dp.errors.IncompatibleError, "is singular", lambda: dp.inverse(WALL)(1.0 + U)),
    "no convergence": (
        dp.errors.ConvergenceError,
        "petsc on",
        lambda: dp.inverse(-laplacian(), rtol=1e-13, maxiter=1)(U),
    ),
    "shape": (dp.errors.ShapeError, "on rank", lambda: laplacian()(on_last_rank(U, np.zeros(3)))),
    "dtype": (TypeError, "on rank", lambda: laplacian()(on_last_rank(U, U.astype(str)))),
    "cutting": (
        OverflowError,
        "on rank",
        with_planted_fault(cut, "_entries", OverflowError("too large"), lambda: laplacian()(U)),
    ),
    "matrix": (
        MemoryError,
        "on rank",
        with_planted_fault(cut.KroneckerOfBoxes, "explicit", MemoryError(), lambda: dp.inverse(STEP)),
    ),
    "kernel": (
        MemoryError,
        "on rank",
        with_planted_fault(cut.KroneckerOfBoxes, "product", MemoryError(), lambda: laplacian()(FIELD)),
    ),
    "kernel in a product": (
        FloatingPointError,
        "overflow",
        with_planted_fault(
            cut.KroneckerOfBoxes, "product", FloatingPointError("overflow"), lambda: (laplacian() @ STEP)(FIELD)
        ),
    ),
    "kernel in a gradient": (
        MemoryError,
        "no room",
        with_planted_fault(cut.KroneckerOfBoxes, "product", MemoryError("no room"), lambda: dp.grad(misfit)(FIELD)),
    ),
    "engine": (
        RuntimeError,
        "no",
        with_planted_fault(solve.PetscEngine, "solve", RuntimeError("no"), lambda: dp.inverse(STEP)(U)),
    ),
    "adjoint": (
        RuntimeError,
        "no",
        with_planted_fault(solve.PetscEngine, "solve", RuntimeError("no"), lambda: dp.inverse(STEP).T(U)),
    ),
    "set-up": (
        MemoryError,
        "PETSc",
        with_planted_fault(solve, "assembled", MemoryError("PETSc"), lambda: dp.inverse(STEP)),
    ),
    "loss": (
        ZeroDivisionError,
        "of one rank",
        lambda: dp.value_and_grad(lambda u: fail_on_last_rank() + misfit(u))(FIELD),
    ),
    "loss, at its end": (
        ZeroDivisionError,
        "one",
        lambda: dp.value_and_grad(lambda u: misfit(u) + fail_on_last_rank())(FIELD),
    ),
    "tangent": (
        ZeroDivisionError,
        "of one rank",
        lambda: dp.jvp(lambda u: fail_on_last_rank() + misfit(u), FIELD, FIELD),
    ),
    "product with the Hessian": (
        ZeroDivisionError,
        "one",
        lambda: dp.hvp(lambda u: fail_on_last_rank() + misfit(u), FIELD, FIELD),
    ),
    "step": (ZeroDivisionError, "of one rank", lambda: rollout(lambda u, k: heat(u, k) + fail_on_last_rank())),
    "step, before": (
        Exception,
        "1 and 2",
        lambda: rollout(lambda u, k: fail_on_last_rank(ErrorOfTwoArguments(1, 2)) + heat(u, k)),
    ),
    "step, its gradient": (
        KeyError,
        "of one rank",
        lambda: dp.grad(
            lambda u: anp.sum(rollout(lambda u, k: heat(u, k) + fail_on_last_rank(KeyError("of one rank")), u))
        )(FIELD),
    ),
    "callback": (
        ZeroDivisionError,
        "of one rank",
        lambda: dp.minimize(misfit, U, maxiter=3, callback=lambda *_: fail_on_last_rank()),
    ),
    "loss of minimize, later": (
        ZeroDivisionError,
        "of one rank",
        lambda: dp.minimize(counted(lambda u, n: misfit(u) + (fail_on_last_rank() if n > 2 else 0.0)), U, maxiter=5),
    ),
    "argument": (
        ValueError,
        "argument 0['k'] of the loss is not the same",
        lambda: value_of_loss({"k": on_last_rank(0.5, 0.7)}),
    ),
    "argument, one entry": (
        ValueError,
        "argument 0['k'] of the loss is not the same on rank",
        lambda: value_of_loss({"k": np.where(U == U[3, 3], on_last_rank(0.0, 1.0), U)}),
    ),
    "random numbers": (
        ValueError,
        "an array of shape (12, 10) combined with a field on ranks is not the same",
        lambda: dp.value_and_grad(lambda u: misfit(u + RUNS.standard_normal(PLAIN.shape)))(FIELD),
    ),
    "a random number": (
        ValueError,
        "a number combined with a field on ranks is not the same on rank",
        lambda: np.sum(FIELD * RUNS.random()),
    ),
    "loss of one rank": (
        ValueError,
        "the result[0] of the loss is not the same on rank",
        lambda: dp.value_and_grad(lambda u: misfit(u) + RUNS.random())(FIELD),
    ),
    "operator of one rank": (
        ValueError,
        "is not the same on rank",
        lambda: dp.diagonal(GRID.cells, RUNS.random(PLAIN.shape))(FIELD),
    ),
    "kernel, caught by its rank": (
        ValueError,
        "has an error in laplacian, rank",
        with_planted_fault(
            cut.KroneckerOfBoxes, "product", MemoryError(), lambda: dp.grad(loss_that_catches_an_error)(FIELD)
        ),
    ),
    "clock": (TypeError, "measures times", lambda: dp.work_precision(lambda: (misfit, U), [{}])),
    "another way": (
        ValueError,
        "write no branches that depend on the number of the rank",
        lambda: on_last_rank(np.sum, np.max)(FIELD),
    ),
}


def counted(loss):
    """Return a loss that gets the number of earlier calls."""
    calls = []

    def counts(u):
        calls.append(None)
        return loss(u, len(calls) - 1)

    return counts


def value_of_loss(x):
    """Value and gradient of a loss of a number or a field that every rank has."""
    return dp.value_and_grad(lambda x: anp.sum(anp.exp(x["k"] * FIELD)))(x)


def all_ranks_raise_the_same_error():
    """Every fault on all ranks; after each, all go on together. They drop what they hold at different times."""
    gc.disable()
    for name, (kind, words, act) in FAULTS.items():
        try:
            act()
            message = "nothing"
        except Exception as error:
            message = f"{type(error).__name__}: {error}"
            assert isinstance(error, kind) and words in str(error), (name, message)
        assert len(set(COMM.allgather(message))) == 1, (name, COMM.allgather(message))
        assert message != "nothing", name
        assert np.sum(GRID.volumes) > 0.99, name
        if LAST:
            gc.collect()
        if COMM.rank == 0:
            print(f"{name}: {message}")


def a_point_that_one_rank_refuses_is_refused():
    """All ranks shorten the step, and the history holds the reason."""
    loss = counted(
        lambda u, n: (fail_on_last_rank(dp.errors.NonFiniteError("of one rank")) if n == 1 else 0.0) + misfit(u)
    )
    best = dp.minimize(loss, U, maxiter=2)
    [failure] = best.history[1].failed
    assert failure.message.startswith(f"of one rank (on rank {COMM.size - 1}, whose block begins at cell (")
    assert len(set(COMM.allgather(best.x.tobytes()))) == 1


def no_rank_waits(how):
    """End the last rank in another way: killed, or by an error that it cannot send to the others."""
    if how == "kill" and LAST:
        os.kill(os.getpid(), signal.SIGKILL)
    if how == "file" and LAST:
        np.load("/nowhere/rank.npy")
    if how == "waits":
        dp.value_and_grad(lambda u: misfit(u) + (fail_on_last_rank() if LAST else COMM.recv(source=COMM.size - 1)))(
            FIELD
        )
    while True:
        np.sum(FIELD)


if __name__ == "__main__":
    if sys.argv[1:]:
        no_rank_waits(sys.argv[1])
    all_ranks_raise_the_same_error()
    a_point_that_one_rank_refuses_is_refused()
    if COMM.rank == 0:
        print("all agree")
