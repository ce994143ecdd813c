"""Every message of eigenpairs, printed once."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.derivative import grad
from sparsedp.solvers import eigen_rules, eigensolver, general_eigenpairs

SHAPE = dp.errors.ShapeError
TYPE = TypeError
VALUE = ValueError
FINITE = dp.errors.NonFiniteError
DERIVATIVE = dp.errors.DerivativeError
FAILED = dp.errors.ConvergenceError
GRID = dp.Grid((5, 5), size=1.0)
SOLVE = dp.elliptic_solver(dp.divergence(GRID), dp.gradient(GRID, dp.dirichlet))
L = -dp.laplacian(GRID, dp.dirichlet)
TWO = dp.from_matrix(np.eye(2), name="one")
WIND = dp.from_matrix([[1.0, 2.0], [0.0, 1.0]], name="wind")
REGULAR = dp.from_matrix([[1.0, 2.0], [0.5, 3.0]])
DOUBLE = dp.from_matrix(2 * np.eye(3))
HERMITIAN = dp.from_matrix([[2.0, 1j], [-1j, 2.0]], name="hermitian")
LINE = dp.from_functions(lambda u: 2 * u, lambda u: 2 * u, 600, 600, name="line")
LONG = dp.upwind(dp.Grid(40, periodic=True), 0, 1)
FACES = np.ones(GRID.faces.shape)
ENTRIES = dp.matrix_solver.from_coo([0, 0, 1, 1], [0, 1, 0, 1])
HALF = dp.from_matrix(np.diag([0.0, 1.0, 1.0, 1.0, 1.0, -1.0]))  # neither positive nor regular
DISC = dp.cut_cells(GRID, np.ones((6, 6)), dp.dirichlet, dp.dirichlet)
LIGHT = np.where(np.arange(25) == 12, 1e-12, 1.0).reshape(5, 5)
HEAVY = np.where(np.arange(25) == 12, 1e20, 1.0).reshape(5, 5)


def pairs(*args, **options):
    return lambda: dp.eigenpairs(*args, **options)


def slope(of_pairs, count, **options):
    return lambda: grad(lambda k: of_pairs(dp.eigenpairs(SOLVE, count, coefficients=k, **options)))(FACES)


TABLE = [
    (pairs(np.eye(2)), TYPE, "eigenpairs takes an Operator, got ndarray; write dp.from_matrix(...) first"),
    (
        pairs(len),
        TYPE,
        "eigenpairs, as op, takes an Operator, got builtin_function_or_method; write dp.from_functions(f, f, n, n), "
        "the solver of dp.elliptic_solver with coefficients=, or symmetric=False for the Jacobian of a residual",
    ),
    (
        pairs(dp.from_matrix(np.ones((2, 3)))),
        SHAPE,
        "eigenpairs takes a square operator, got one from space(3) to space(2); write op.T @ op",
    ),
    (
        pairs(WIND),
        TYPE,
        "eigenpairs takes a symmetric operator, and wind is not; write symmetric=False for its eigenvalues, or "
        "0.5 * (A + A.T) for its symmetric part",
    ),
    (
        pairs(TWO, mass=WIND),
        TYPE,
        "eigenpairs takes a symmetric operator, and the mass is not; write symmetric=False for its eigenvalues, or "
        "0.5 * (A + A.T) for its symmetric part",
    ),
    (
        pairs(SOLVE, coefficients=(1.0 + 1j) * FACES),
        TYPE,
        "eigenpairs takes complex operators that are equal to their conjugate transpose, and 0 - divergence @ diag(k) "
        "@ gradient is not; write symmetric=False for eigenvalues",
    ),
    (
        pairs(ENTRIES, coefficients=np.arange(4.0)),
        TYPE,
        "eigenpairs takes a symmetric operator, and matrix of 4 entries is not; write symmetric=False for its "
        "eigenvalues",
    ),
    (
        pairs(L, 3, mass=HEAVY, method="lobpcg"),
        FAILED,
        "eigenpairs found vectors that are parallel up to rounding errors; the mass varies by a factor of 1e+20, so "
        "that rounding errors of the largest eigenvalues are large beside this one; write which='smallest' with "
        "method='arpack', a mass that varies less, or a larger rtol",
    ),
    (
        pairs(dp.from_matrix(np.diag(np.logspace(-12, 12, 30))), 4, method="lobpcg"),
        FAILED,
        "eigenpairs by lobpcg missed 8 eigenvalues below 0.00126896; write method='arpack'",
    ),
    (pairs(TWO, 3), VALUE, "eigenpairs got k=3, but one has 2 unknowns; write a smaller k"),
    (pairs(TWO, 0), VALUE, "k of eigenpairs must be a whole number >= 1, got 0"),
    (
        pairs(TWO, 1, "SM"),
        VALUE,
        "which must be one of smallest, largest, got 'SM'; write 'smallest', 'largest' or a number near to them",
    ),
    (pairs(TWO, 1, np.inf), FINITE, "which must be finite, got inf"),
    (
        pairs(TWO, 1, 1j),
        TYPE,
        "the eigenvalues of a symmetric operator are real, got which=1j; write a real number",
    ),
    (
        pairs(SOLVE),
        TYPE,
        "eigenpairs needs the coefficients of <elliptic_solver: shift - divergence @ diag(k) @ gradient on "
        "cells(5, 5)>, got none; write coefficients=...",
    ),
    (
        pairs(SOLVE, coefficients=(1.0, 2.0, 3.0)),
        TYPE,
        "<elliptic_solver: shift - divergence @ diag(k) @ gradient on cells(5, 5)> has up to 2 coefficients, got 3; "
        "write coefficients=...",
    ),
    (
        pairs(SOLVE, coefficients=np.array([FACES, FACES])),
        SHAPE,
        "eigenpairs takes one coefficient k, got a batch of 2; call it for each entry along the first axis",
    ),
    (
        pairs(TWO, coefficients=1.0),
        TYPE,
        "coefficients belong to a solver, got an Operator <one: space(2) -> space(2), explicit>; write "
        "eigenpairs(solve, coefficients=...)",
    ),
    (pairs(TWO, mass=L), SHAPE, "the mass of eigenpairs acts on cells(5, 5), but the operator on space(2)"),
    (
        pairs(TWO, mass=np.ones(3)),
        SHAPE,
        "the mass of eigenpairs is a number or a field on space(2), got an array of shape (3,)",
    ),
    (pairs(TWO, mass=1j), TYPE, "the mass of eigenpairs must hold real numbers, got dtype complex128"),
    (pairs(TWO, mass=np.nan), FINITE, "the mass of eigenpairs must be finite, got nan; write a finite number"),
    (pairs(TWO, mass=np.array([1.0, -1.0])), VALUE, "the mass of eigenpairs must be > 0, got -1 at 1"),
    (
        pairs(dp.laplacian(dp.Grid((2, 3), size=1.0)), mass=np.array([[1.0, 2.0, 1.0], [1.0, 1.0, -1.0]])),
        VALUE,
        "the mass of eigenpairs must be > 0, got -1 at (1, 2)",
    ),
    (
        pairs(TWO, mass=dp.from_matrix([[1.0, 2.0], [2.0, 1.0]])),
        VALUE,
        "mass must be positive definite, and the one given is not; write a mass > 0 in all unknowns",
    ),
    (pairs(TWO, method="qr"), VALUE, "method of eigenpairs must be one of auto, dense, arpack, lobpcg, got 'qr'"),
    (
        pairs(dp.identity(dp.Space(20_001)), method="dense"),
        VALUE,
        "method dense takes up to 20000 unknowns, got 20001; write method='arpack'",
    ),
    (
        pairs(L, 1, "largest", method="lobpcg"),
        VALUE,
        "method lobpcg takes which='smallest', got 'largest'; write method='arpack'",
    ),
    (
        pairs(L, 5, method="lobpcg"),
        VALUE,
        "method lobpcg takes k up to a fifth of the 25 unknowns, got 5; write method='dense'",
    ),
    (
        pairs(TWO, 2, method="arpack"),
        VALUE,
        "method arpack takes k < 1 for 2 unknowns, got 2; write method='dense'",
    ),
    (
        pairs(LINE, 1, 1.0),
        VALUE,
        "line has no entries, so that eigenpairs takes which='smallest' or 'largest' and a mass that is a number or a "
        "field; write dp.from_matrix(A) of its matrix for the others",
    ),
    (
        pairs(WIND, method="lobpcg", symmetric=False),
        VALUE,
        "method lobpcg takes symmetric operators; write method='arpack'",
    ),
    (
        pairs(LONG, mass=2.0, method="arpack", symmetric=False),
        VALUE,
        "method arpack for an operator that is not symmetric, with a mass, needs a shift, got which='smallest'; write "
        "a number as which",
    ),
    (
        pairs(LONG, 3, method="arpack", symmetric=False, maxiter=1),
        FAILED,
        "eigenpairs found 0 of 3 pairs; increase maxiter, or write a number near them as which",
    ),
    (
        lambda: grad(lambda m: anp.real(dp.eigenpairs(REGULAR, mass=m, symmetric=False).vectors[0, 0]))(1.0),
        DERIVATIVE,
        "the vectors of eigenpairs with symmetric=False have no derivatives; differentiate functions of pairs.values",
    ),
    (
        lambda: grad(grad(grad(lambda m: anp.real(dp.eigenpairs(REGULAR, mass=m, symmetric=False).values[0]))))(1.0),
        DERIVATIVE,
        "eigenvalues of eigenpairs with symmetric=False have first and second derivatives, no third ones",
    ),
    (
        pairs(dp.from_matrix(np.diag([1.0, 0.0])), which=0.5, mass=np.array([1.0, 0.0]), symmetric=False),
        VALUE,
        "eigenpairs of matrix with this mass are not defined: A - lambda M is singular for every lambda; remove the "
        "unknowns on which neither A nor M acts, or give them a mass",
    ),
    (
        pairs(
            dp.from_matrix(np.diag(np.r_[1.0:30.0, 0.0]), name="A"),
            which=0.5,
            mass=np.r_[np.ones(29), 0.0],
            symmetric=False,
            method="arpack",
        ),
        VALUE,
        "eigenpairs of A with this mass are not defined: A - lambda M is singular for every lambda; remove the "
        "unknowns on which neither A nor M acts, or give them a mass",
    ),
    (
        pairs(dp.elliptic_solver(dp.divergence(GRID), DISC), coefficients=(np.ones(25), FACES), symmetric=False),
        TYPE,
        "eigenpairs takes no solver with a body of cut_cells, got <elliptic_solver: <cut_cells: 25 of 25 cells hold "
        "fluid, 0 are cut, dirichlet on the wall>>; represent the body by solid cells of the grid, or write the matrix "
        "as an Operator",
    ),
    (
        lambda: dp.eigenpairs(REGULAR, symmetric=False, mass=np.array([1.0, 0.0])),
        VALUE,
        "a singular mass needs a shift, got which='smallest'; write a number as which",
    ),
    (
        lambda: dp.eigenpairs(REGULAR, 2, 1.5, symmetric=False, mass=np.array([1.0, 0.0])),
        VALUE,
        "eigenpairs got k=2, but matrix with this mass has 1 finite eigenvalues near the number given as "
        "which; write a smaller k",
    ),
    (
        lambda: dp.eigenpairs(lambda x: x, symmetric=False, coefficients=(np.ones(2),), mass=np.ones(3)),
        SHAPE,
        "the mass of eigenpairs is a number or an array like the state, of shape (2,), got one of shape (3,)",
    ),
    (
        lambda: dp.eigenpairs(lambda x, p: p * x, symmetric=False, coefficients=np.ones(2)),
        TypeError,
        "eigenpairs of a residual needs the state and the parameters of its Jacobian, got ndarray; write "
        "coefficients=(x, *params)",
    ),
    (
        lambda: grad(lambda m: anp.real(dp.eigenpairs(WIND, mass=m, symmetric=False).values[0]))(1.0),
        DERIVATIVE,
        "eigenvalue 0 of eigenpairs, 1+0j, has no derivative: it is a multiple one, or another one is at a distance of "
        "0.0e+00",
    ),
    (
        lambda: grad(lambda m: dp.eigenpairs(HERMITIAN, mass=m).values[0])(1.0),
        DERIVATIVE,
        "eigenpairs of complex operators have no derivatives; write the real symmetric operator of real and imaginary "
        "parts",
    ),
    (
        lambda: dp.jit(lambda m: dp.eigenpairs(TWO, mass=m).values[0])(1.0),
        dp.errors.JitError,
        "dp.jit cannot record eigenpairs, which decides by values; call the function without dp.jit",
    ),
    (
        lambda: dp.eigenpairs(TWO, 2)[0:1],
        TYPE,
        "pairs[i] takes an integer, got slice(0, 1, None); write pairs.values[i] and pairs.vectors[i]",
    ),
    (
        pairs(SOLVE, coefficients=[FACES, 0.1]),
        TYPE,
        "coefficients must be an array or a tuple (k, shift), got a list of arrays",
    ),
    (
        pairs(TWO, mass=1e-320),
        FINITE,
        "eigenvalues of one must be finite, got 1 that are NaN or infinite, the first at 0; write the operator and the "
        "mass in units near 1",
    ),
    (
        pairs(dp.from_matrix(np.diag(np.arange(-2.0, 4.0))), mass=HALF, method="arpack"),
        VALUE,
        "mass must be positive definite, and the one given is not; write a mass > 0 in all unknowns",
    ),
    (lambda: dp.eigenpairs(TWO, 2)[2], IndexError, "there is no pair 2 among 2 eigenpairs; write 0 to 1"),
    (
        lambda: dp.eigenpairs(TWO, 2).sum(1, 1),
        VALUE,
        "start=1 and stop=1 are not a range of 2 eigenpairs; write 0 <= start < stop <= 2",
    ),
    (
        lambda: dp.eigenpairs(TWO, 2).sum(0, 9),
        VALUE,
        "start=0 and stop=9 are not a range of 2 eigenpairs; write 0 <= start < stop <= 2",
    ),
    (
        lambda: dp.eigenpairs(TWO, 2).project(np.ones(2), 2),
        VALUE,
        "start=2 and stop=2 are not a range of 2 eigenpairs; write 0 <= start < stop <= 2",
    ),
    (
        lambda: dp.eigenpairs(TWO, 2).project(np.ones(2), -1),
        VALUE,
        "start must be a whole number >= 0, got -1; write 0 <= start < stop <= 2",
    ),
    (
        lambda: dp.eigenpairs(TWO, 2).sum(0, -1),
        VALUE,
        "stop must be a whole number >= 0, got -1; write 0 <= start < stop <= 2",
    ),
    (
        lambda: dp.eigenpairs(TWO, 2).project(np.ones(3)),
        SHAPE,
        "project takes a field on space(2), got an array of shape (3,)",
    ),
]


@pytest.mark.parametrize(("call", "error", "message"), TABLE, ids=[row[2][:50] for row in TABLE])
def test_message(call, error, message):
    with pytest.raises(error) as caught:
        call()
    assert str(caught.value) == message


def test_messages_of_clusters():
    message = (
        "pairs 1 to 2 of eigenpairs have no derivatives one by one: their eigenvalues .* to .* form a cluster with "
        r"gaps up to .*; write pairs.sum\(.*, .*\) or pairs.project\(u, .*, .*\)"
    )
    with pytest.raises(DERIVATIVE, match=message):
        slope(lambda pairs: pairs.values[1], 3)()
    message = (
        "pair 1 of eigenpairs has no derivative: its eigenvalue .* differs by .* from .* of the next pair, which was "
        "not computed; write another k, so that no cluster is cut"
    )
    with pytest.raises(DERIVATIVE, match=message):
        slope(lambda pairs: pairs.values[1], 2)()


def test_messages_of_failures(monkeypatch):
    biharmonic = L @ L
    monkeypatch.setattr(eigensolver, "INERTIA_UP_TO", 10)
    message = (
        "eigenpairs cannot find the end of the spectrum of .*, whose rows do not show that it has no negative "
        "eigenvalue; write a number below or near the wanted eigenvalues, such as which=-1.0"
    )
    with pytest.raises(FAILED, match=message):
        dp.eigenpairs(biharmonic, method="arpack")
    monkeypatch.setattr(eigensolver, "AT_ROUNDOFF", 0.0)
    message = (
        "pair 0 of eigenpairs has a relative residual of .*, more than .*; write a number near it as which, or "
        "increase maxiter"
    )
    with pytest.raises(FAILED, match=message):
        dp.eigenpairs(L, rtol=1e-20)
    message = (
        "pair 0 of eigenpairs has a relative residual of .*, more than .*; write method='arpack', or a larger rtol"
    )
    with pytest.raises(FAILED, match=message):
        dp.eigenpairs(L, 25, rtol=1e-20)
    monkeypatch.undo()
    message = (
        r"pair 0 of eigenpairs has a relative residual of .*, more than .*; the mass varies by a factor of 1e\+12, "
        "so that rounding errors of the largest eigenvalues are large beside this one; write which='smallest' with "
        "method='arpack', a mass that varies less, or a larger rtol"
    )
    with pytest.raises(FAILED, match=message):
        dp.eigenpairs(L, 3, "largest", mass=LIGHT)
    monkeypatch.setattr(eigen_rules, "BORDERED_LU_UP_TO", 0)
    monkeypatch.setattr(eigen_rules, "MOST_ITERATIONS", 1)
    message = (
        "the adjoint solve of eigenpairs ended with a relative residual of .*; increase k, so that the gap behind "
        "the last pair is larger"
    )
    with pytest.raises(FAILED, match=message):
        slope(lambda pairs: anp.sum(pairs.vectors[0] ** 3), 1)()


def test_vectors_that_are_not_found(monkeypatch):
    monkeypatch.setattr(general_eigenpairs, "_eigenspace", lambda *args: [])
    message = "eigenpairs found no vectors for eigenvalue 0: the matrix is singular; write a number near it as which"
    with pytest.raises(FAILED) as caught:
        dp.eigenpairs(DOUBLE, symmetric=False, which=2.0).vectors
    assert str(caught.value) == message
