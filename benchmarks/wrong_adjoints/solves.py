"""Wrong derivatives of equations that are solved: tolerances, null spaces, Newton, fixed points, matrices as data."""

import numpy as np
from scipy.sparse.linalg import cg

from benchmarks.wrong_adjoints.cases import chained, wrong


def difference_matrix(n):
    """Return the matrix of negative second differences in a rod with cold walls."""
    return 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)


@wrong("loose tolerance", culprit="conduction")
def loose_adjoint_solve():
    """The temperatures of a rod with a heat source, squared; the adjoint solve ends at a tolerance of 1e-3."""
    matrix = difference_matrix(40) + 0.1 * np.eye(40)

    def conduction(source):
        return np.linalg.solve(matrix, source)

    def conduction_vjp(source, g):
        return cg(matrix, g, rtol=1e-3, atol=0.0)[0]  # fault: rtol=1e-10

    def square(u):
        return u**2

    def square_vjp(u, g):
        return 2 * u * g

    return chained(1.5 + np.sin(np.arange(40.0)), (conduction, conduction_vjp), (square, square_vjp))


@wrong("null space", culprit="conduction")
def insulated_rod():
    """The temperature differences from the mean in an insulated rod, whose matrix is singular, for a heater."""
    n = 8
    matrix = difference_matrix(n)
    matrix[0, 0] = matrix[-1, -1] = 1.0

    def heater(current):
        return current**2

    def heater_vjp(current, g):
        return 2 * current * g

    def solve(source):
        u = np.zeros_like(source)
        u[1:] = np.linalg.solve(matrix[1:, 1:], source[1:])
        return u - np.mean(u)

    def conduction(source):
        return solve(source - np.mean(source))

    def conduction_vjp(source, g):
        return solve(g)  # fault: solve(g - np.mean(g)), the mean of g has no solution

    return chained(1.5 + np.sin(np.arange(8.0)), (heater, heater_vjp), (conduction, conduction_vjp))


def ring_differences(n):
    """Return the differences along both axes of a periodic grid of n by n cells, as matrices."""
    one = np.roll(np.eye(n), 1, axis=1) - np.eye(n)
    return np.kron(one, np.eye(n)), np.kron(np.eye(n), one)


@wrong("dropped component", entries=np.s_[1], culprit="project")
def flow_step():
    """One step of a flow in two dimensions: friction, and the projection that makes it incompressible."""
    x, y = ring_differences(4)
    gradient = np.concatenate([x, y])
    projection = np.eye(32) - gradient @ np.linalg.pinv(gradient)

    def friction(u):
        return u - 0.1 * u**3

    def friction_vjp(u, g):
        return (1 - 0.3 * u**2) * g

    def project(u):
        return (projection @ u.ravel()).reshape(u.shape)

    def project_vjp(u, g):
        out = g.copy()
        out[0] = project(g)[0]  # fault: both components
        return out

    start = np.sin(np.arange(32.0) ** 2).reshape(2, 4, 4)
    return chained(start, (friction, friction_vjp), (project, project_vjp))


@wrong("derivative at the first iterate")
def newton_iteration():
    """The solution u of u^3 + u = b by Newton's method."""

    def f(b):
        u = b
        for _ in range(30):
            u = u - (u**3 + u - b) / (3 * u**2 + 1)
        return u

    def vjp(b, g):
        return g / (3 * b**2 + 1)  # fault: at the solution u = f(b), not at the start u = b

    return f, vjp, np.linspace(0.5, 3.0, 6)


@wrong("too few iterations")
def fixed_point_iteration():
    """The fixed point u = tanh(W u) / 2 + b of a small network."""
    W = np.sin(np.arange(25.0) ** 2).reshape(5, 5) / 2

    def f(b):
        u = b
        for _ in range(80):
            u = np.tanh(W @ u) / 2 + b
        return u

    def vjp(b, g):
        slope = (1 - np.tanh(W @ f(b)) ** 2) / 2
        out = g
        for _ in range(2):  # fault: 80, as in f
            out = W.T @ (slope * out) + g
        return out

    return f, vjp, np.linspace(-1.0, 1.0, 5)


@wrong("dropped term")
def least_squares_fit():
    """The coefficients of a least squares fit as a function of its matrix."""
    data = np.array([1.0, 3.0, 2.0, 5.0, 4.0])

    def f(A):
        return np.linalg.solve(A.T @ A, A.T @ data)

    def vjp(A, g):
        fit = f(A)
        adjoint = np.linalg.solve(A.T @ A, g)
        return -np.outer(A @ adjoint, fit)  # fault: + np.outer(data - A @ fit, adjoint)

    return f, vjp, np.stack([np.ones(5), np.array([0.5, 1.0, 2.5, 3.0, 4.5])], axis=1)


@wrong("exchanged factors", entries={"matrix": ~np.eye(4, dtype=bool)})
def matrix_as_data():
    """The solution of a linear system as a function of its matrix and of its right-hand side."""

    def f(x):
        return np.linalg.solve(x["matrix"], x["rhs"])

    def vjp(x, g):
        adjoint = np.linalg.solve(x["matrix"].T, g)
        return {"matrix": -np.outer(f(x), adjoint), "rhs": adjoint}  # fault: -np.outer(adjoint, f(x))

    return f, vjp, {"matrix": difference_matrix(4) + np.eye(4, k=1) / 2, "rhs": np.linspace(1.0, 2.0, 4)}
