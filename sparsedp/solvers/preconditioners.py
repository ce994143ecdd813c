"""Preconditioners of Krylov methods, and the engine of method "krylov".

Waves: A = L - w with L the discrete -div(k grad) and w the squares of wave numbers has eigenvalues of both signs, on
which multigrid fails. On L - (1 + i d) w, where waves are damped, it works, and the damped inverse moves the
eigenvalues of A into a disc in which GMRES converges.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import csr_array, diags_array

from sparsedp._utils.validation import check_choice, check_whole
from sparsedp.operators.given import from_matrix
from sparsedp.operators.operator import Operator
from sparsedp.solvers.algebraic_multigrid import Hierarchy, Level, ruge_stueben
from sparsedp.solvers.direct import direct_engine
from sparsedp.solvers.engine import Engine
from sparsedp.solvers.krylov import Krylov
from sparsedp.solvers.scaling import exponent_of, inverted
from sparsedp.solvers.system import System

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import DTypeLike

    Precondition = Callable[[np.ndarray, bool], np.ndarray]  # precondition(r, transposed)

__all__ = ["NearbyFactorization", "krylov_engine", "shifted_laplace"]

# The d above. Erlangga and others (2004) take 0.5, for sweeps on every level; here they end where waves are of few
# cells, and less damping is enough. Measured at 10 cells a wavelength, 512^2, to 1e-10: 206 iterations with 0.5, 134
# with 0.2, and hardly fewer with 0.1.
DAMPING = 0.2
# Largest ratio of wave numbers to links of a cell on a level that is smoothed, (kh)^2 / 4 on a 5-point stencil: sweeps
# of Gauss and Seidel amplify waves of few cells. Measured with 10 cells a wavelength, 512^2: with 0.1 and 0.2, on the
# first two levels, GMRES converges; with the third level (0.8) smoothed as well it does not.
LARGEST_RATIO = 0.4
# Iterations with the LU of a matrix nearby: a third of the time of LU. With 20 a cavity at Re 1000 is slower.
MOST_ITERATIONS = 12


class NearbyFactorization(Engine):
    """The engine that preconditions with kept LU factors of a matrix nearby, and factors its own matrix if that fails.

    Parameters
    ----------
    system : System
    lu : Direct
        Of the matrix nearby.
    """

    method = "direct"
    hierarchy = "sparse LU of a matrix nearby, until that no longer converges"
    iterative = True

    def __init__(self, system: System, lu: Engine) -> None:
        self.system = system
        self.lu = lu

        def precondition(r: np.ndarray, transposed: bool) -> np.ndarray:
            x, _, _ = lu.solve(r, 0.0, transposed)
            return x

        self.krylov: Krylov | None = Krylov(system, precondition, MOST_ITERATIONS)

    def solve(self, b: np.ndarray, goal: float, transposed: bool) -> tuple[np.ndarray, int, str]:
        """Iterate; once that fails, factor, and solve directly from then on."""
        if self.krylov is not None:
            x, iterations, status = self.krylov.solve(b, goal, transposed)
            if not status:
                return x, iterations, status
            self.lu = direct_engine(self.system)
            self.krylov = None
        return self.lu.solve(b, goal, transposed)


def krylov_engine(
    system: System, *, preconditioner: Any = None, diff: str = "implicit", iterations: int | None = None
) -> Krylov:
    """Build conjugate gradients when the operator is symmetric and definite, else GMRES.

    Parameters
    ----------
    system : System
    preconditioner : "jacobi", "shifted_laplace", Operator, or callable on fields, optional
        Approximates the inverse of the operator; symmetric when the operator is. "shifted_laplace" is for waves, whose
        operator has negative sums of rows: see `shifted_laplace`.
    diff : "implicit" or "unrolled"
        How derivatives are computed: by one adjoint solve, or through the iterations themselves. The
        latter costs memory and time for each iteration; it is for comparison, and for training `start`.
    iterations : int, optional
        Number of iterations. No tolerance is tested, there is no refinement, and a large residual raises no error.
        The engine stops earlier only if the residual is 0 or no longer decreases.

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
    precondition, dtype, description = _preconditioner(system, preconditioner)
    engine = Krylov(system, precondition, iterations=iterations, dtype=dtype)
    engine.hierarchy = engine.hierarchy + description
    engine.hierarchical = bool(description)
    if diff == "unrolled":
        if system.complex or system.weights is None or preconditioner is not None:
            raise ValueError("diff='unrolled' needs a symmetric operator and no preconditioner; write diff='implicit'")
        engine.unrolled = True
    return engine


def _preconditioner(system: System, option: Any) -> tuple[Precondition | None, DTypeLike, str]:
    """Return the function of an option on flat arrays or None, the dtype of its results, and a description."""
    if option is None:
        return None, float, ""
    if isinstance(option, str):
        if option == "jacobi" and system.sign:
            return _jacobi(system), float, ""
        if option == "shifted_laplace" and system.op.structure.has_entries:
            return _shifted_laplace_cycle(system)
    elif isinstance(option, Operator):
        return _by_operator(system, option), option.dtype, ""
    elif callable(option):
        return _by_function(system, option), float, ""
    raise ValueError(
        "preconditioner must be None, 'jacobi' (for a diagonal of one sign), 'shifted_laplace' (for an operator with "
        f"entries), an Operator or a function, got {option!r}"
    )


def _jacobi(system: System) -> Precondition:
    """Return the product with the inverse of the diagonal."""
    diagonal: Any = system.diagonal
    inverse = inverted(diagonal)

    def precondition(r: np.ndarray, transposed: bool) -> np.ndarray:
        return r * inverse

    return precondition


def _shifted_laplace_cycle(system: System) -> tuple[Precondition, DTypeLike, str]:
    """Return a multigrid cycle on the damped operator, its dtype and a description."""
    hierarchy, unit = shifted_laplace(system)

    def precondition(r: np.ndarray, transposed: bool) -> np.ndarray:
        cycle = hierarchy.T.cycle if transposed else hierarchy.cycle
        return cycle(unit * r)

    return precondition, complex, f"; shifted Laplace: {hierarchy.words}"


def _by_operator(system: System, op: Operator) -> Precondition:
    """Return the application of an operator that approximates the inverse of the unscaled one."""
    scale = 2.0**system.exponent

    def precondition(r: np.ndarray, transposed: bool) -> np.ndarray:
        acting = op.T if transposed else op
        return scale * acting._flat.apply(r)

    return precondition


def _by_function(system: System, function: Callable) -> Precondition:
    """Return a function on fields as one on flat arrays."""
    shape = system.op.domain.shape
    dtype = system.op.dtype

    def precondition(r: np.ndarray, transposed: bool) -> np.ndarray:
        z = np.asarray(function(r.reshape(shape)))
        # A copy: the function may return the same array each time.
        return z.astype(dtype, casting="same_kind").reshape(-1)

    return precondition


def shifted_laplace(system: System) -> tuple[Hierarchy, float]:
    """Build a multigrid cycle that nearly inverts a system with damped wave numbers.

    The sum of a row, of negative real part, is minus the square of a wave number. Prolongations are those of the links
    alone; the first level on which waves are of few cells is solved by sparse LU. The transpose is exact.

    Parameters
    ----------
    system : System
        With entries.

    Returns
    -------
    hierarchy : Hierarchy
    unit : float
        A cycle on unit * r nearly solves A z = r.

    References
    ----------
    Erlangga, Vuik and Oosterlee, On a class of preconditioners for solving the Helmholtz equation, Applied
    Numerical Mathematics 50 (2004) 409-425.
    """
    matrix = system.matrix
    sizes = abs(matrix)
    ones = np.ones(system.size)
    row_sums = matrix @ ones
    row_sizes = sizes @ ones
    unit = 2.0 ** -exponent_of(np.max(row_sizes))
    links = csr_array(diags_array(row_sizes + np.maximum(row_sums.real, 0.0)) - sizes)  # the matrix without waves
    turn = -1.0 if np.sum(row_sums.imag) > 0 else 1.0  # damp further to the side on which they are damped
    is_wave = (row_sums.real < 0) | (turn * row_sums.imag < 0)
    damping = np.where(is_wave, 1j * turn * DAMPING * row_sums, 0.0)
    A = csr_array(unit * (matrix + diags_array(damping)))
    levels = []
    for level in ruge_stueben(csr_array(unit * links), 0.25, 25):
        if level.P is None or not _waves_are_resolved(A):
            break
        levels.append(Level(A, level.P, level.R))
        A = csr_array(level.R @ A @ level.P)
    coarsest = direct_engine(System(from_matrix(A, name="the coarsest level")))

    def solve(b: np.ndarray, transposed: bool) -> np.ndarray:
        x, _, _ = coarsest.solve(b, 0.0, transposed)
        return x

    return Hierarchy([*levels, Level(A)], 1, ("forward",), ("backward",), solve), unit


def _waves_are_resolved(A: csr_array) -> bool:
    """Return whether no wave is of few cells."""
    ones = np.ones(A.shape[0])
    links = abs(A) @ ones - abs(A.diagonal())
    return not np.any((links > 0) & (-(A @ ones).real > LARGEST_RATIO * links))
