"""The cycle: what is done on each level, and in which order. It is its own transpose."""

import numpy as np

from sparsedp.kernels.team import SERIAL
from sparsedp.solvers.multigrid import loops
from sparsedp.solvers.multigrid.coarsest import dense_inverse
from sparsedp.solvers.multigrid.interpolation import Transfer
from sparsedp.solvers.multigrid.layout import Layout
from sparsedp.solvers.multigrid.loops import AGAIN, COLLECT, NATURAL, PROLONG, RELAX, RESIDUAL, SWEEP
from sparsedp.solvers.multigrid.smoother import chess_board

__all__ = ["Coarse", "Coarsest", "Finest"]

TWICE = {2: 2, 3: 0}  # in 2-D a second visit to a sixteenth of the cells takes a fifth of the iterations off


class Visited:
    """A level with one below: links, vectors, and the weights to the next one, scaled to a unit diagonal.

    Parameters
    ----------
    level : Level
    colours : list
        Those that take a correction from below.
    dtype : float32 or float64
        Type of the cycle.
    threads : int
    """

    links: np.ndarray
    x: np.ndarray
    b: np.ndarray
    r: np.ndarray
    natural: np.ndarray

    def __init__(self, level, colours, dtype, threads):
        self.layout, self.colours, self.dtype, self.threads = level.layout, colours, dtype, threads
        self.near, self.ends = level.near, level.ends
        self.above, self.prolong = self.layout, np.array([(PROLONG, q) for q in range(len(colours))])

    def connect(self, level, weights, below, stretch):
        """Keep the weights of the level, and the next one."""
        self.transfer, self.below = Transfer(self.layout, self.colours), below
        self.weights = self.transfer.scaled(weights, level, below.scale, stretch, self.dtype)

    def run(self, loop, *arguments):
        """A loop in the precision of the cycle, on all planes."""
        loop = loop.single if self.dtype == np.float32 else loop
        loop.run(self.layout.halves[0], 4 * self.x.size, self.threads, *arguments)

    def visit(self, tasks):
        """Do tasks: all at once, or one after the other by a team of threads."""
        below, transfer = self.below, self.transfer
        arrays = self.links, self.x, self.b, self.r, self.weights, below.natural, below.b, self.natural
        tables = self.near, self.ends, transfer.down, transfer.up, transfer.ends
        sizes = self.layout.sizes, below.layout.sizes, self.above.sizes
        for some in [tasks] if self.threads == 1 or 4 * self.x.size < SERIAL else tasks[:, None]:
            self.run(loops.visit, some, *arrays, *tables, *sizes)


class Finest(Visited):
    """The finest level: links of the red cells in all directions, in double precision and in that of the cycle.

    Attributes
    ----------
    x : array
        What the cycle starts from: `over` r, with ghost cells.
    """

    over = 1.2  # of a sweep; 1 takes up to one iteration more

    def __init__(self, level, dtype, threads):
        self.red, self.black = chess_board(level.layout)
        super().__init__(level, self.red, dtype, threads)
        layout, many = self.layout, 2 * self.layout.dim
        self.double = layout.zeros(len(self.red) * many)
        self.to_red, self.to_black = (np.zeros((len(self.red), many, 4), np.int64) for _ in range(2))
        numbers = {}
        for one, q in enumerate(self.red):
            for m, at in enumerate(range(*level.ends[q][::2])):
                number = numbers[q, level.steps[at]] = one * many + m
                layout.body(self.double[number])[:] = level.coupling(q, at)
                self.to_red[one, m] = number, 0, self.black.index(level.near[at, 2]), level.near[at, 3]
        for one, q in enumerate(self.black):
            for m, at in enumerate(range(*level.ends[q][::2])):
                other, far = level.near[at, 2:]
                number = numbers[other, tuple(-d for d in level.steps[at])]
                self.to_black[one, m] = number, far, self.red.index(other), far
        layout.wrap(self.double)
        self.links = self.double.astype(dtype, copy=False)
        self.x, self.r = (layout.zeros(len(self.red), dtype=dtype) for _ in range(2))
        self.b, self.natural = self.x, self.r  # not used
        self.collect = np.array([(COLLECT, 0)])

    def precondition(self, r, z, sums):
        """z = what the cycle makes of r; r . z to sums."""
        tables, sizes = (self.to_black, self.to_red), self.layout.sizes
        over = self.over
        self.run(loops.smooth, self.links, self.x, r, self.r, *tables, sizes, sums, 1.0 / over - 1.0, 1.0, 0.0)
        self.visit(self.collect)
        self.below.cycle(TWICE[self.layout.dim])
        self.visit(self.prolong)
        self.run(loops.smooth, self.links, self.x, r, z, *tables, sizes, sums, 1.0 - over, over, over)


class Coarse(Visited):
    """A coarse level.

    Attributes
    ----------
    natural : array
        x in natural order, in the layout of the level above.
    """

    def __init__(self, level, above, dtype, threads):
        count = len(level.layout.colours)
        super().__init__(level, range(count - 1), dtype, threads)
        layout, self.above = self.layout, above
        self.links = layout.zeros(len(level.links) - count, dtype=dtype)
        for q, (first, _, last) in enumerate(level.ends):
            for at in range(first, last):
                link, shift = level.near[at, :2]
                if shift == 0 and link % count == q:
                    layout.body(self.links[link])[:] = level.coupling(q, at)
        layout.wrap(self.links)
        self.x, self.b, self.r, self.kept = (layout.zeros(count, dtype=dtype) for _ in range(4))
        self.natural, self.scale = above.zeros(1, dtype=dtype), above.zeros()
        layout.merge(level.scale, range(count), above.cells(self.scale, 0))
        above.wrap(self.scale)
        residuals = [(RESIDUAL, q) for q in range(count - 1)]
        self.down = np.array([(SWEEP, q) for q in range(count)] + residuals + [(COLLECT, 0)])
        self.up = np.array([*self.prolong, *((RELAX, q) for q in reversed(range(count))), (NATURAL, 0)])
        self.again, self.order = np.array([(AGAIN, q) for q in range(count)]), self.up[-1:]

    def cycle(self, twice):
        """b -> the correction, in natural order. A V-cycle; if twice is 1 with two visits, if 2 on the next level."""
        self.visit(self.down)
        self.below.cycle(max(twice - 1, 0))
        self.visit(self.up)
        if twice == 1:
            self.visit(self.again)
            self.x, self.kept = self.kept, self.x
            self.cycle(0)
            self.x += self.kept
            self.visit(self.order)


class Coarsest:
    """The level that is solved by a dense matrix."""

    def __init__(self, natural, above, dtype):
        self.layout = layout = Layout(natural.shape, natural.periodic)
        self.above, self.natural, self.scale = above, above.zeros(1, dtype=dtype), above.zeros()
        self.b, self.places = layout.zeros(len(layout.colours), dtype=dtype), np.empty(natural.shape, int)
        layout.merge(np.arange(self.b.size).reshape(self.b.shape), range(len(self.b)), self.places)
        self.order = above.cells(np.arange(above.size), 0).reshape(-1)
        self.matrix, above.cells(self.scale, 0)[...] = dense_inverse(natural)
        above.wrap(self.scale)

    def cycle(self, twice):
        """b -> the solution, in natural order."""
        vector = self.b.reshape(-1)[self.places.reshape(-1)]
        self.natural[0, self.order] = (self.matrix * vector).sum(axis=1)
        self.above.wrap(self.natural)
