"""Transport on ranks compared with one process: values, derivatives to second order, rollouts, refusals, messages.

mpirun -n 4 python -m mpi4py tests/ranks/transport_on_ranks.py          # or: ... 0 6, a sixth of all there is
"""

import sys
from itertools import product

import autograd.numpy as anp
import numpy as np
from fields_on_ranks import close
from mpi4py import MPI

import sparsedp as dp
from sparsedp._utils.counters import recording

COMM = MPI.COMM_WORLD
LINE = dp.Grid(13, spacing=0.5, periodic=True)
PLANE = dp.Grid((9, 7), size=(1.0, 2.0), periodic=(True, False))
UNEVEN = dp.Grid((8, 9), spacing=[np.linspace(1, 2, 8), np.linspace(2, 1, 9)], periodic=(False, True))
BOX = dp.Grid((5, 4, 6), size=1.0, periodic=(False, True, False))
SQUARE = dp.Grid((33, 33), size=1.0)
SIDES = {"x": (dp.dirichlet, dp.neumann), "y": (dp.neumann, dp.dirichlet), "z": dp.dirichlet}
SCHEMES = [
    *(dict(scheme=scheme, form=form) for scheme in ("upwind", "van_leer") for form in ("flux", "advective")),
    dict(scheme="semi_lagrangian"),
    dict(scheme="semi_lagrangian", interpolation="cubic", backtrace="midpoint"),
    dict(scheme="maccormack", backtrace="midpoint"),
    dict(scheme="maccormack", interpolation="cubic", clamp=False),
]
PLACES = "cells", "faces"
ALL = [*product((LINE, PLANE, UNEVEN, BOX), SCHEMES, PLACES, PLACES, (False, True))]
SOME = [(LINE, SCHEMES[0], "cells", "cells", False), (PLANE, SCHEMES[1], "faces", "faces", True)]
SOME += [(UNEVEN, SCHEMES[0], "faces", "faces", False), (BOX, SCHEMES[0], "faces", "cells", False)]
SOME += [(UNEVEN, SCHEMES[2], "faces", "faces", False), (PLANE, SCHEMES[3], "cells", "cells", True)]
SOME += [(PLANE, SCHEMES[4], "faces", "cells", True), (UNEVEN, SCHEMES[5], "cells", "faces", False)]
SOME += [(PLANE, SCHEMES[6], "faces", "faces", False), (LINE, SCHEMES[7], "cells", "cells", True)]


def on_ranks(space, grid):
    """Return a plain array as a field of this kind on a grid on ranks."""
    return dp.identity(getattr(grid, space.kind))


class Case:
    """A step of transport on a grid, what goes in, and a direction; drawn from a seed."""

    def __init__(self, number, grid, options, velocity, of, solid):
        rng = np.random.default_rng(number)
        self.options = dict(options, velocity=velocity, of=of)
        self.options["boundary"] = {name: SIDES[name] for name, wraps in zip(grid.axes, grid.periodic) if not wraps}
        if solid:
            self.options["solid"] = rng.random(grid.shape) < 0.3
        move = dp.transport(grid, **self.options)
        shape = grid.faces.shape if velocity == "faces" else (grid.dim, *grid.shape)
        shapes = move.space.shape, shape, (), move.walls.shape
        u, v, self.weights, inflow = (rng.uniform(-1, 1, some) for some in (*shapes[:2], shapes[0], shapes[3]))
        courant = 0.1 if "form" in options else 2.7
        self.given = u, v, courant * min(float(h.min()) for h in grid.widths), inflow
        self.along = tuple(rng.uniform(-0.1, 0.1, some) for some in shapes)
        self.along = *self.along[:2], float(self.along[2]), self.along[3]

    def loss(self, grid):
        """A loss of (u, v, dt, inflow), for a step on a grid."""
        move = dp.transport(grid, **self.options)
        return lambda given: anp.sum(self.weights * anp.sin(2.0 * move(*given)))


def derivatives_are_those_of_one_process(cases):
    """Value, gradients in field, velocity, step and inflow, tangents, Hessian products where there are any."""
    for number, (plain, *rest) in enumerate(cases):
        case = Case(number, plain, *rest)
        one, loss = (case.loss(grid) for grid in (plain, dp.distribute(plain, COMM)))
        acts = [
            lambda f, case=case: dp.value_and_grad(f)(case.given),
            lambda f, case=case: dp.jvp(f, case.given, case.along),
        ]
        acts += [lambda f, case=case: dp.hvp(f, case.given, case.along)] * (case.options["scheme"] == "upwind")
        for act in acts:
            for pair in zip(flat(act(loss)), flat(act(one)), strict=True):
                close(*pair, 1e-12)


def flat(results):
    """Numbers and arrays in tuples, one by one."""
    if isinstance(results, tuple):
        return [leaf for one in results for leaf in flat(one)]
    return [results]


def steps_of_one_process():
    """Fields, not arrays, in every dtype; numbers as inflow; velocities that reach beyond the next block; bits."""
    for plain, scheme, velocity in product((PLANE, UNEVEN), ("upwind", "van_leer", "semi_lagrangian"), PLACES):
        case = Case(0, plain, {"scheme": scheme}, velocity, "cells", False)
        grid = dp.distribute(plain, COMM)
        u, v, dt, _ = case.given
        dt *= 9 if scheme == "semi_lagrangian" else 0.05
        one, move = (dp.transport(some, **case.options) for some in (plain, grid))
        on = [dp.identity(grid.cells), dp.identity(grid.faces) if velocity == "faces" else lambda v: v]
        tol = 1e-13 if scheme == "semi_lagrangian" else 0.0
        close(move(on[0](u), on[1](v), dt, 0.7), one(u, v, dt, 0.7), tol)
        close(move(on[0](u).astype(np.float32), v, dt, 0.7), one(u.astype(np.float32), v, dt, 0.7), 1e-6)
        close(move((9 * u).astype(int), v, dt), one((9 * u).astype(int), v, dt), tol)
    one, move = (dp.transport(grid, "maccormack") for grid in (LINE, dp.distribute(LINE, COMM)))
    u = np.sin(np.arange(13.0))  # on one of two ranks alone
    fast = np.where(np.arange(13) < 6, 0.1, -3.0)
    for v in (fast, -fast):
        close(move(u, v, 0.5), one(u, v, 0.5), 1e-13)


def wind_of_a_rollout():
    """50 upwind steps on unequal blocks: the gradient of one process, the same bits for every memory."""
    grid = dp.distribute(SQUARE, COMM)
    actual = set()
    start = np.exp(-20 * sum((x - 0.4) ** 2 for x in SQUARE.centres()))
    wind = np.sin(np.arange(SQUARE.faces.size))

    def gradient(grid, field, memory=None):
        move = dp.transport(grid)
        inside = dp.interior(grid)
        end = lambda v: dp.rollout(lambda u, v: move(u, v, 0.01), field(start), v, 50, memory=memory)
        return dp.value_and_grad(lambda v: anp.sum((end(inside(v)) - 0.3) ** 2))(wind)

    expected = gradient(SQUARE, np.array)
    for memory in (None, 400_000, 250_000):
        results = gradient(grid, dp.identity(grid.cells), memory)
        for pair in zip(results, expected):
            close(*pair, 1e-13)
        actual.add(b"".join(np.asarray(result).tobytes() for result in results))
    assert len(actual) == 1


def messages_of_a_step():
    """On two ranks a step reads one row of cells; with its gradient it reads two, and sends back two."""
    grid = dp.distribute(dp.Grid((8, 6)), COMM)
    move = dp.transport(grid)
    u = dp.identity(grid.cells)(np.ones((8, 6)))
    v = np.full(110, 0.1)
    v = dp.identity(grid.faces)(v)
    loss = lambda v, n: anp.sum(dp.rollout(lambda u, v: move(u, v, 0.1), u, v, n))
    messages_per_step = []
    for act in (loss, dp.grad(loss)):
        act(v, 5)
        counts = [counted(act, v, n) for n in (5, 8)]
        messages_per_step.append([(more - less) / 3 for less, more in zip(*counts)])
    row = 2 * 6 * 8
    of_v = (6 * 2 + 7 + 6 + 7) * 8
    if COMM.size == 2:
        assert messages_per_step == [[1, row, 0], [4, 3 * row + of_v, 0]], messages_per_step
    else:
        assert [line[0] for line in messages_per_step] == ([0, 0] if COMM.size == 1 else [1, 4]), messages_per_step


def counted(act, *args):
    """What an act sends: exchanges, their bytes on all ranks, reductions."""
    with recording() as calls:
        act(*args)
    return [calls["ranks", word] for word in ("exchange", "sent", "reduction")]


def told_by(act):
    """The error of an act, as on every rank."""
    try:
        act()
    except (ArithmeticError, TypeError, ValueError) as error:
        message = f"{type(error).__name__}: {error}"
        assert set(COMM.allgather(message)) == {message}
        return message
    raise AssertionError("nothing was refused")


def refusals_are_those_of_one_process():
    """The same words on every rank, also where the fault lies on one of them, and none for what is beyond a block."""
    road = dp.Grid(13, spacing=0.5)
    u = np.linspace(0, 1, 13)
    v = np.ones(14)
    bad, fast = (np.where(np.arange(14) == 9, value, 1.0) for value in (np.nan, 9.0))
    wrong = [(bad[1:], v, 0.1), (u, bad, 0.1), (u, v, 0.1, np.inf), (u[:5], v, 0.1), (u, v, -1.0), (u, fast, 0.4)]
    for scheme, args in [
        *product(("upwind", "semi_lagrangian"), wrong[:5]),
        ("upwind", wrong[5]),
        ("van_leer", wrong[5]),
    ]:
        one, move = (dp.transport(some, scheme, dp.dirichlet) for some in (road, dp.distribute(road, COMM)))
        assert told_by(lambda args=args, move=move: move(*args)) == told_by(lambda args=args, one=one: one(*args))
    acts = [lambda act=act: dp.rollout(lambda u, v: act(u, v, 0.4), u, fast, 3) for act in (move, one)]
    assert told_by(acts[0]) == told_by(acts[1])  # within a call that ranks make together
    grid = dp.distribute(LINE, COMM)
    v = v[1:]
    one, move = (dp.transport(some, "upwind", of="faces") for some in (LINE, grid))
    close(move(u, v, 0.45), one(u, v, 0.45), 1e-15)  # half a cell at the end of a block would be too small
    for fast in range(13):  # at the end of one block alone
        v = np.where(np.arange(13) == fast, 1.0, 0.05)
        end = lambda u, move, v=v: dp.rollout(lambda u, v: move(u, v, 0.45), u, v, 3)
        slopes = [dp.grad(lambda u, act=act: anp.sum(end(u, act) ** 2))(u) for act in (move, one)]
        close(*slopes, 1e-14)
    one, move = (dp.transport(some, "van_leer") for some in (LINE, grid))
    twice = [lambda f=f: dp.hvp(lambda u: anp.sum(f(u, v, 0.1) ** 3), u, u) for f in (one, move)]
    assert told_by(twice[0]) == told_by(twice[1])


if __name__ == "__main__":
    if part := [*map(int, sys.argv[1:])]:
        derivatives_are_those_of_one_process(ALL[part[0] :: part[1]])
    else:
        derivatives_are_those_of_one_process(SOME)
        steps_of_one_process()
        wind_of_a_rollout()
        messages_of_a_step()
        refusals_are_those_of_one_process()
    if COMM.rank == 0:
        print("all agree")
