"""Store the fields of a grid on the ranks of a communicator (`distribute`), and collect them (`gather`)."""

from __future__ import annotations

import atexit
import os
import sys
from typing import Any

import numpy as np

from sparsedp.errors import ShapeError
from sparsedp.grid.grid import Grid, check_grid

__all__ = ["distribute", "gather"]

SIZE_VARIABLES = "OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "MV2_COMM_WORLD_SIZE"  # set by launchers: the number of processes


def distribute(grid: Grid, comm: Any = None) -> Grid:
    """Return a grid whose fields are stored in blocks by the processes that run this program.

    Parameters
    ----------
    grid : Grid
    comm : mpi4py.MPI.Comm, optional
        Default: all processes that ``mpirun -n 64 python -m mpi4py scene.py`` has started.

    Returns
    -------
    Grid
        With one process, the grid itself, and nothing is imported. Otherwise every rank holds a block of each field:
        arithmetic is local; sums, means, maxima and norms are computed over the whole field, with the same bits on
        every rank; all other functions raise TypeError. A plain array of the whole shape is a field that every rank
        holds, and so is its gradient.

    Raises
    ------
    ImportError
        If there are several processes, and mpi4py or petsc4py is missing.
    RuntimeError
        If mpi4py belongs to another MPI than the one that started the processes.
    TypeError
        If `comm` is not a communicator.

    See Also
    --------
    Grid, ensemble, gather

    Examples
    --------
    >>> from sparsedp import Grid
    >>> distribute(Grid((4, 3)))
    Grid(4 x 3 cells, size 4 x 3)
    """
    check_grid("distribute", grid)
    started = max(int(os.environ.get(name, "1")) for name in SIZE_VARIABLES)
    if comm is None and started == 1 and "mpi4py.MPI" not in sys.modules:
        return grid
    try:
        from mpi4py import MPI

        if comm is None and started == MPI.COMM_WORLD.size == 1:
            return grid
        from sparsedp.parallel.agreement import end_all_after_error
        from sparsedp.parallel.layout import grid_on_ranks
    except ImportError as error:
        raise ImportError(
            f"distribute on several processes needs mpi4py and petsc4py ({error}); install them, or start one process"
        ) from error
    if not isinstance(comm, (MPI.Comm, type(None))):
        raise TypeError(f"distribute takes a communicator, got {type(comm).__name__}; write mpi4py.MPI.COMM_WORLD")
    if started > 1 and MPI.COMM_WORLD.size == 1:
        raise RuntimeError(
            f"{started} processes were started, but mpi4py belongs to another MPI and finds one; reinstall it for "
            "this MPI"
        )
    if MPI.COMM_WORLD.size > 1:
        atexit.unregister(end_all_after_error)  # of an earlier call
        atexit.register(end_all_after_error)
    if comm is None:
        comm = MPI.COMM_WORLD
    return grid_on_ranks(grid, comm)


def gather(u: Any) -> np.ndarray:
    """Return a field, on ranks or not, as one plain array that every rank holds: for pictures and small files.

    Parameters
    ----------
    u : field

    Returns
    -------
    array
        `u` itself where it is a plain array.

    Raises
    ------
    ShapeError
        If `u` is neither a field nor an array.

    See Also
    --------
    distribute

    Examples
    --------
    >>> gather(np.array([1.0, 2.0]))
    array([1., 2.])
    """
    if hasattr(u, "gather"):
        return u.gather()
    try:
        return np.asarray(u)
    except ValueError:
        raise ShapeError(f"gather takes one field, got {type(u).__name__}; gather them one by one") from None
