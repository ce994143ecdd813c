"""Engine: the base class of all linear solvers, which `Solver` in solve.py calls."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["EmptySystem", "Engine"]


class Engine:
    """Base class of linear solvers: one method, set up for one matrix.

    `Solver` in solve.py calls `solve` with the right-hand side, and again with the residual for iterative refinement.
    A subclass defines `solve` and overrides the attributes whose defaults do not fit. The function that builds it takes
    a System (system.py), and the options of the method as keyword-only arguments.

    Attributes
    ----------
    method : str
        Name of the method, as users write it in ``inverse(op, method=...)``, such as "direct".
    unit : str
        Word for iterations in error messages: "iterations" or "cycles".
    hierarchy : str
        Description of the set-up in one line: levels, unknowns, matrix entries.
    iterative : bool
        Whether the residual after one call of `solve` depends on the tolerance.
    hierarchical : bool
        Whether the set-up is a multigrid hierarchy.
    refines : bool
        If False, `solve` is called once, and no error is raised if the residual does not meet the tolerance. This is
        for a fixed number of iterations.
    most_refinements : int
        Largest number of calls of `solve` for one right-hand side.
    reduction : float
        Refinement stops when a call does not reduce the residual norm to this fraction of the previous one.
    advice : str
        Text at the end of the error message of a solve that does not meet the tolerance.
    unrolled : bool
        Whether derivatives are computed by differentiating the iterations, which `unroll` records.
    """

    method: str = "engine"
    unit: str = "iterations"
    hierarchy: str = ""
    iterative: bool = False
    hierarchical: bool = False
    refines: bool = True
    most_refinements: int = 8
    reduction: float = 0.5
    advice: str = ""
    unrolled: bool = False

    def solve(self, b: np.ndarray, goal: float, transposed: bool) -> tuple[np.ndarray, int, str]:
        """Solve A x = b, or A^T x = b, approximately.

        Parameters
        ----------
        b : array, shape (n,)
            float64, or complex128 if the operator is complex. It lies in the range of the operator, is 0 where there
            is no unknown, and has a norm between 2^-255 and 2^200. It must not be modified.
        goal : float
            Stop when |b - A x| <= goal (2-norm), or when |b - A x| is at the level of rounding errors.
        transposed : bool

        Returns
        -------
        x : array, shape (n,)
            A new array. The caller removes its component along the null space and its values where there is no unknown.
        iterations : int
        status : str
            "" if the solve stopped by one of the criteria of `goal`, else one of STATUS_WORDS.

        Notes
        -----
        The method must be homogeneous: if b and `goal` are multiplied by a power of two, x is multiplied by the same
        power. Therefore it must not use absolute thresholds.
        """
        raise TypeError(f"{type(self).__name__} defines no solve")

    def unroll(self, b: Any, goal: float, transposed: bool) -> tuple[Any, int, str]:
        """Solve as `solve` does, but with operations that autograd can record: b may be traced."""
        raise TypeError(f"{type(self).__name__} defines no unroll")


class EmptySystem(Engine):
    """The solver of a system without unknowns; its `solve` is never called."""

    method = "none"
    hierarchy = "no unknowns"
