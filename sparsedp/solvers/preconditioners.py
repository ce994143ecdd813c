"""krylov: its engine, and what preconditions it.

Waves: A = L - w with L the discrete -div(k grad) and w the squares of wave numbers has eigenvalues of both signs, on
which multigrid fails. On L - (1 + i d) w, where waves are damped, it works, and the damped inverse moves the
eigenvalues of A into a disc in which GMRES converges.
"""

from typing import Any

import numpy as np
from scipy.sparse import csr_array, diags_array

from sparsedp._utils.validation import check_choice, check_whole
from sparsedp.operators.given import from_matrix
from sparsedp.operators.operator import Operator
from sparsedp.solvers.amg import Hierarchy, Level, ruge_stueben
from sparsedp.solvers.direct import direct_engine
from sparsedp.solvers.engine import Engine
from sparsedp.solvers.krylov import Krylov
from sparsedp.solvers.scaling import exponent_of, inverted
from sparsedp.solvers.system import System

__all__ = ["Near", "krylov_engine", "shifted_laplace"]

# The d above. Erlangga and others (2004) take 0.5, for sweeps on every level; here they end where waves are of few
# cells, and less damping will do. Measured at 10 cells a wavelength, 512^2, to 1e-10: 206 iterations with 0.5, 134 with
# 0.2, and hardly fewer with 0.1.
DAMPED = 0.2
# Largest ratio of wave numbers to links of a cell on a level that is smoothed, (kh)^2 / 4 on a 5-point stencil: sweeps
# of Gauss and Seidel amplify waves of few cells. Measured with 10 cells a wavelength, 512^2: 0.1 and 0.2 on the first
# two levels converge; with the third (0.8) smoothed as well nothing does.
RESOLVED = 0.4
MOST = 12  # iterations with the LU of a matrix nearby: a third of the time of LU. With 20 a cavity at Re 1000 is slower


class Near(Engine):
    """The engine that solves with kept LU factors of a matrix nearby, and factors its own where those do not do.

    Parameters
    ----------
    system : System
    lu : Direct
    """

    method, hierarchy = "direct", "sparse LU, of a matrix nearby while that will do"
    iterative = True

    def __init__(self, system, lu):
        self.system, self.lu = system, lu
        self.krylov: Any = Krylov(system, lambda r, transposed: lu.solve(r, 0.0, transposed)[0], MOST)

    def solve(self, b, goal, transposed):
        """A few iterations, or LU from then on."""
        if self.krylov:
            found = self.krylov.solve(b, goal, transposed)
            if not found[2]:
                return found
            self.lu, self.krylov = direct_engine(self.system), None
        return self.lu.solve(b, goal, transposed)


def krylov_engine(system, *, preconditioner=None, diff="implicit", iterations=None):
    """System -> Krylov: conjugate gradients when the operator is symmetric and definite, else GMRES.

    Parameters
    ----------
    system : System
    preconditioner : None, "jacobi", "shifted_laplace", Operator, or callable on fields, optional
        Approximates the inverse of the operator; symmetric when the operator is. "shifted_laplace" is for waves, whose
        operator has negative sums of rows: see `shifted_laplace`.
    diff : "implicit" or "unrolled"
        How derivatives are made: by one adjoint solve, or through the iterations themselves. The
        latter costs memory and time for each iteration; it is there to compare, and to train `start`.
    iterations : int, optional
        Exactly this many iterations, whatever the residual: then nothing is refined and nothing raised.

    Returns
    -------
    Krylov

    Raises
    ------
    ValueError
        If an option is out of range, or an unrolled solve is asked of an operator that is not symmetric.
    """
    check_choice("diff", diff, ("implicit", "unrolled"))
    if iterations is not None:
        iterations = check_whole("iterations", iterations, 1, "; None leaves it to the tolerance")
    precondition, dtype, words = _preconditioner(system, preconditioner)
    engine = Krylov(system, precondition, iterations=iterations, dtype=dtype)
    engine.hierarchy, engine.hierarchical = engine.hierarchy + words, bool(words)
    if diff == "unrolled":
        if system.complex or system.weights is None or preconditioner is not None:
            raise ValueError("diff='unrolled' needs a symmetric operator and no preconditioner; write diff='implicit'")
        engine.unrolled = True
    return engine


def _preconditioner(system, given):
    """The option -> (precondition(r, transposed) on flat arrays or None, the dtype that it makes, words)."""
    if given is None:
        return None, float, ""
    if isinstance(given, str) and given == "jacobi" and system.sign:
        inverse = inverted(system.diagonal)
        return (lambda r, transposed: r * inverse), float, ""
    if isinstance(given, str) and given == "shifted_laplace" and system.op.structure.has_entries:
        hierarchy, unit = shifted_laplace(system)
        precondition = lambda r, transposed: (hierarchy.T if transposed else hierarchy).cycle(unit * r)
        return precondition, complex, f"; shifted Laplace: {hierarchy.words}"
    if isinstance(given, Operator):
        scale = 2.0**system.exponent
        return (lambda r, transposed: scale * (given.T if transposed else given)._flat.apply(r)), given.dtype, ""
    if callable(given):
        shape, dtype = system.op.domain.shape, system.op.dtype
        # A copy: the function may return one array of its own again and again.
        act = lambda r: np.asarray(given(r.reshape(shape))).astype(dtype, casting="same_kind").reshape(-1)
        return (lambda r, transposed: act(r)), float, ""
    raise ValueError(
        "preconditioner must be None, 'jacobi' (for a diagonal of one sign), 'shifted_laplace' (for an operator with "
        f"entries), an Operator or a function, got {given!r}"
    )


def shifted_laplace(system):
    """System with entries -> (Hierarchy, unit): a cycle on unit * r nearly solves A z = r with damped wave numbers.

    The sum of a row, of negative real part, is minus the square of a wave number. Prolongations are those of the links
    alone; the first level on which waves are of few cells is solved by sparse LU. The transpose is exact.

    Notes
    -----
    Source: Erlangga, Vuik and Oosterlee, On a class of preconditioners for solving the Helmholtz equation, Applied
    Numerical Mathematics 50 (2004) 409-425.
    """
    A = system.matrix
    size, rows = abs(A), A @ np.ones(system.size)
    sums = size @ np.ones(system.size)
    unit = 2.0 ** -exponent_of(np.max(sums))
    links = csr_array(diags_array(sums + np.maximum(rows.real, 0.0)) - size)  # the matrix as if it had no waves
    turn = -1.0 if np.sum(rows.imag) > 0 else 1.0  # damped further to the side on which they are damped
    waves = (rows.real < 0) | (turn * rows.imag < 0)
    A, levels = csr_array(unit * (A + diags_array(np.where(waves, 1j * turn * DAMPED * rows, 0.0)))), []
    for level in ruge_stueben(csr_array(unit * links), 0.25, 25):
        if level.P is None or not _resolved(A):
            break
        levels.append(Level(A, level.P, level.R))
        A = csr_array(level.R @ A @ level.P)
    coarse = direct_engine(System(from_matrix(A, name="the coarsest level")))
    solve = lambda b, transposed: coarse.solve(b, 0.0, transposed)[0]
    return Hierarchy([*levels, Level(A)], 1, ("forward",), ("backward",), solve), unit


def _resolved(A):
    """Whether no wave is of few cells."""
    ones = np.ones(A.shape[0])
    links = abs(A) @ ones - abs(A.diagonal())
    return not np.any((links > 0) & (-(A @ ones).real > RESOLVED * links))
