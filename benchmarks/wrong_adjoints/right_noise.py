"""Right derivatives of programs with few digits: noise, single precision, iterations that stop early."""

import zlib

import numpy as np
from scipy.sparse.linalg import cg

from benchmarks.wrong_adjoints.cases import right


@right("noise of 1e-6", undecidable="noise of 1e-6 leaves too few digits")
def noisy_simulator():
    """A simulator whose result has a relative error of 1e-6 that is new at every point."""

    def f(u):
        noise = zlib.crc32(u.tobytes()) / 2**31 - 1
        return u**2 * (1 + 1e-6 * noise)

    def vjp(u, g):
        return 2 * u * g

    return f, vjp, np.linspace(1.0, 2.0, 5)


@right("single precision", undecidable="along some directions, single precision leaves too few digits")
def diffusion_in_single_precision():
    """Ten steps of nonlinear diffusion in single precision."""
    r = np.float32(0.1)

    def lap(u):
        return np.roll(u, 1) - 2 * u + np.roll(u, -1)

    def trajectory(u):
        states = [u]
        for _ in range(10):
            states.append(states[-1] + r * lap(states[-1] ** 2))
        return states

    def f(u):
        return trajectory(u)[-1]

    def vjp(u, g):
        for state in reversed(trajectory(u)[:-1]):
            g = g + 2 * r * state * lap(g)
        return g

    return f, vjp, (1.5 + np.sin(np.arange(8.0))).astype(np.float32)


@right("single precision inside", undecidable="results in single precision leave too few digits")
def single_precision_inside():
    """A program in double precision that calls a library in single precision."""

    def f(u):
        return np.exp(u.astype(np.float32)).astype(float)

    def vjp(u, g):
        return np.exp(u) * g

    return f, vjp, np.linspace(0.1, 1.0, 5)


@right("result of nine digits", undecidable="nine decimal places leave too few digits")
def printed_digits():
    """The result of an external program, read from a file with nine decimal places."""

    def f(u):
        return np.round(np.sin(u), 9)

    def vjp(u, g):
        return np.cos(u) * g

    return f, vjp, np.linspace(0.2, 1.2, 6)


def stiffness(n):
    """Return the matrix of a chain of springs between walls."""
    return 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)


@right("iterative solve at 1e-8", undecidable="a solve at 1e-8 leaves too few digits")
def conjugate_gradients():
    """The displacements of a chain of springs, by conjugate gradients that stop at 1e-8."""
    matrix = stiffness(30) + np.diag(np.linspace(0.0, 0.5, 30))

    def f(force):
        return cg(matrix, force**2, rtol=1e-8, atol=0.0)[0]

    def vjp(force, g):
        return 2 * force * cg(matrix, g, rtol=1e-8, atol=0.0)[0]

    return f, vjp, 1.5 + np.sin(np.arange(30.0))


@right("Newton's method at 1e-8")
def keplers_equation():
    """Kepler's equation by Newton's method that stops at a step of 1e-8."""

    def f(anomaly):
        e = anomaly
        step = 1.0
        while np.max(np.abs(step)) > 1e-8:
            step = (e - 0.6 * np.sin(e) - anomaly) / (1 - 0.6 * np.cos(e))
            e = e - step
        return e

    def vjp(anomaly, g):
        return g / (1 - 0.6 * np.cos(f(anomaly)))

    return f, vjp, np.linspace(0.3, 2.5, 6)


@right("fixed point at 1e-8", undecidable="a fixed point at 1e-8 leaves too few digits")
def contraction():
    """The fixed point of a contraction; forward and adjoint iterations stop at a change of 1e-8."""

    def solved(update, u):
        while True:
            new = update(u)
            if np.max(np.abs(new - u)) <= 1e-8 * np.max(np.abs(new)):
                return new
            u = new

    def f(b):
        return solved(lambda u: 0.7 * np.cos(u) + b, b)

    def vjp(b, g):
        slope = -0.7 * np.sin(f(b))
        return solved(lambda adjoint: slope * adjoint + g, g)

    return f, vjp, np.linspace(0.1, 1.0, 5)


@right("bisection at 1e-8", undecidable="a bisection at 1e-8 leaves too few digits")
def gas_law_by_bisection():
    """The volume of a gas at a pressure, by bisection to 1e-8."""

    def f(pressure):
        low = np.zeros_like(pressure)
        high = np.full_like(pressure, 4.0)
        for _ in range(28):
            middle = (low + high) / 2
            is_low = middle + middle**3 < pressure
            low = np.where(is_low, middle, low)
            high = np.where(is_low, high, middle)
        return (low + high) / 2

    def vjp(pressure, g):
        return g / (1 + 3 * f(pressure) ** 2)

    return f, vjp, np.linspace(1.0, 9.0, 5)


@right("random numbers")
def monte_carlo():
    """The price of an option by a thousand paths that are drawn with a fixed seed."""

    def payoffs(x):
        paths = np.random.default_rng(0).normal(size=1000)
        return np.exp(x[0] + x[1] * paths), paths

    def f(x):
        end, _ = payoffs(x)
        return np.mean(np.log1p(end))

    def vjp(x, g):
        end, paths = payoffs(x)
        slope = end / (1 + end) * g
        return np.array([np.mean(slope), np.mean(slope * paths)])

    return f, vjp, np.array([0.1, 0.4])
