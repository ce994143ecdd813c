"""Distribute the fields of a grid over MPI ranks (`distribute`), and collect a field on every rank (`gather`)."""

from __future__ import annotations

import atexit
import os
import sys
from typing import Any

import numpy as np

from sparsedp.errors import ShapeError
from sparsedp.grid.grid import Grid, check_grid

__all__ = ["distribute", "gather"]

# Environment variables in which the launchers of MPI store the number of processes.
SIZE_VARIABLES = "OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "MV2_COMM_WORLD_SIZE"


def distribute(grid: Grid, comm: Any = None) -> Grid:
    """Return a copy of a grid whose fields are distributed over MPI ranks.

    Parameters
    ----------
    grid : Grid
    comm : mpi4py.MPI.Comm, optional
        Default: all processes of the program, such as those started by ``mpirun -n 64 python -m mpi4py scene.py``.

    Returns
    -------
    Grid
        On one process, `grid` itself; mpi4py and petsc4py are then not imported. On several processes, each rank stores
        a block of every field. Elementwise arithmetic needs no communication. Sums, means, maxima and norms are
        computed over the whole field and give bitwise the same result on every rank. NumPy functions that need other
        entries than those of the block raise TypeError. A NumPy array of the whole shape can be combined with such
        fields; it must be the same on every rank, and its gradient is again a whole array on every rank.

    Raises
    ------
    ImportError
        If there are several processes, and mpi4py or petsc4py is not installed.
    RuntimeError
        If mpi4py was built with another MPI library than the one that started the processes.
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
        atexit.unregister(end_all_after_error)  # an earlier call may have registered it
        atexit.register(end_all_after_error)
    if comm is None:
        comm = MPI.COMM_WORLD
    return grid_on_ranks(grid, comm)


def gather(u: Any) -> np.ndarray:
    """Return the whole field as a NumPy array on every rank, for plots and small files. All ranks must call it.

    Parameters
    ----------
    u : field
        A distributed field, or an array.

    Returns
    -------
    array
        `u` itself if it is a NumPy array.

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
