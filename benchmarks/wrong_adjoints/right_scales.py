"""Right derivatives of badly scaled programs: many decades, offsets, cancellation, steep and flat functions."""

import numpy as np

from benchmarks.wrong_adjoints.cases import right


@right("entries from 1e-12 to 1e12")
def concentrations_of_many_decades():
    """The rates of reactions that saturate, at concentrations from 1e-12 to 1e12."""
    half = 2 * np.logspace(-12, 12, 9)

    def f(c):
        return c / (half + c)

    def vjp(c, g):
        return half / (half + c) ** 2 * g

    return f, vjp, np.logspace(-12, 12, 9)


@right("results from 1e-12 to 1e12")
def results_of_many_decades():
    """The readings of instruments whose units differ by 24 decades."""
    units = np.logspace(-12, 12, 9)
    matrix = np.sin(np.arange(45.0) ** 2).reshape(9, 5)

    def f(u):
        return units * np.exp(matrix @ u)

    def vjp(u, g):
        return matrix.T @ (units * np.exp(matrix @ u) * g)

    return f, vjp, np.linspace(0.5, 1.0, 5)


@right("units of x differ by 1e8")
def pressure_and_gap():
    """The flow through narrow gaps, from pressures in Pa and gaps in metres."""

    def f(x):
        return x["pascal"] * x["metres"] ** 3 / 12e-3

    def vjp(x, g):
        of_gap = 3 * x["pascal"] * x["metres"] ** 2 / 12e-3 * g
        return {"pascal": x["metres"] ** 3 / 12e-3 * g, "metres": of_gap}

    return f, vjp, {"pascal": np.linspace(1e5, 2e5, 4), "metres": np.linspace(1e-3, 2e-3, 4)}


@right("offset 1e8")
def large_offset():
    """The levels of small waves, counted from a point 1e8 below."""

    def f(u):
        return 1e8 + np.sin(u)

    def vjp(u, g):
        return np.cos(u) * g

    return f, vjp, np.linspace(0.1, 1.3, 6)


@right("nearly cancelling terms", undecidable="f cancels digits: its noise of 1e-10 leaves too few of the derivative")
def nearly_cancelling_terms():
    """The curvature of a cosine near 0 by a formula that cancels six digits."""

    def f(u):
        return (1 - np.cos(u)) / u**2

    def vjp(u, g):
        return u * (-1 / 12 + u**2 / 180 - u**4 / 6720) * g  # a series: the formula cancels

    return f, vjp, np.linspace(1e-3, 3e-3, 5)


@right("values of 1e-200")
def tiny_values():
    """A probability of 1e-200, with a gradient of the same size."""

    def f(u):
        return 1e-200 * np.exp(u)

    def vjp(u, g):
        return 1e-200 * np.exp(u) * g

    return f, vjp, np.linspace(-1.0, 1.0, 5)


@right("saturated", undecidable="the derivative is below the rounding error of f")
def saturated_layer():
    """A layer of a network that is saturated at 1 to all digits."""

    def f(u):
        return np.tanh(u)

    def vjp(u, g):
        return g / np.cosh(u) ** 2

    return f, vjp, np.linspace(25.0, 30.0, 5)


@right("zero derivative")
def minimum():
    """The squared distances from the best design, at the best design."""
    best = np.linspace(1.0, 2.0, 6)

    def f(u):
        return (u - best) ** 2

    def vjp(u, g):
        return 2 * (u - best) * g

    return f, vjp, best.copy()


@right("constant", undecidable="f is constant, and so is a loss whose changes are below rounding")
def constant_result():
    """The mass of a closed box does not depend on how the substance is stirred."""

    def f(u):
        return np.full(3, 2.5)

    def vjp(u, g):
        return np.zeros_like(u)

    return f, vjp, np.linspace(1.0, 2.0, 6)


@right("steep exponential")
def diode():
    """The current through a diode: a factor e every 26 mV."""

    def f(volts):
        return 1e-12 * (np.exp(volts / 0.026) - 1)

    def vjp(volts, g):
        return 1e-12 / 0.026 * np.exp(volts / 0.026) * g

    return f, vjp, np.linspace(0.4, 0.7, 5)


@right("x is zero")
def start_at_zero():
    """The response of a network to an input of zeros."""
    W = np.cos(np.arange(20.0) ** 2).reshape(4, 5)

    def f(u):
        return np.exp(W @ u)

    def vjp(u, g):
        return W.T @ (np.exp(W @ u) * g)

    return f, vjp, np.zeros(5)


@right("one entry dominates")
def dominant_entry():
    """A loss with one parameter that is 1e10 times as important as the others."""
    importance = np.array([1e-3, 1e-2, 1e7, 1e-3, 1e-2])

    def f(u):
        return np.sum(importance * np.sin(u))

    def vjp(u, g):
        return importance * np.cos(u) * g

    return f, vjp, np.linspace(0.5, 1.0, 5)
