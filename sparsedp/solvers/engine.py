"""Engine: the interface between the solve contract and a method that solves linear systems."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["EmptySystem", "Engine"]


class Engine:
    """A method with its set-up. The contract in solve.py calls `solve`, and refines with further calls on the residual.

    A subclass defines `solve` and sets the attributes in which it differs. The function that builds it takes a System
    (system.py) and the options of the method as keyword-only arguments.

    Attributes
    ----------
    method : str
        What a user writes for it, such as "direct".
    unit : str
        What an iteration is called in messages: "iterations" or "cycles".
    hierarchy : str
        Size of the set-up in one line: levels, unknowns, entries.
    iterative : bool
        Whether the residual that it leaves depends on the tolerance.
    hierarchical : bool
        Whether its set-up is a multigrid hierarchy.
    refines : bool
        False: one call, without refinement and without an error (a fixed number of iterations).
    most_refinements : int
    reduction : float
        Each refinement must reduce the residual to this share of it or less.
    advice : str
        End of the message of a solve that does not meet the tolerance.
    unrolled : bool
        Whether derivatives go through its iterations, by `unroll`.
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
            float64, or complex128 if the operator is complex. It is in the range of the operator, 0 where there is no
            unknown, of a norm between 2^-255 and 2^200, and must not be changed.
        goal : float
            Stop when |b - A x| <= goal (2-norm) or when |b - A x| is at the level of rounding.
        transposed : bool

        Returns
        -------
        x : array, shape (n,)
            A fresh array. Its component along the null space, and its values where there is no unknown, do not matter.
        iterations : int
        status : str
            "" if it stopped as described, else one of STATUS_WORDS.

        Notes
        -----
        An engine is homogeneous: scaling b by a power of two scales x by it, so there are no absolute thresholds.
        """
        raise TypeError(f"{type(self).__name__} defines no solve")

    def unroll(self, b: Any, goal: float, transposed: bool) -> tuple[Any, int, str]:
        """Solve as `solve` does, where b may be traced: the iterations are recorded."""
        raise TypeError(f"{type(self).__name__} defines no unroll")


class EmptySystem(Engine):
    """The engine of a system without unknowns; its solve is never called."""

    method = "none"
    hierarchy = "no unknowns"
