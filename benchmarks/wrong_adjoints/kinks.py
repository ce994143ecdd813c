"""Wrong derivatives of piecewise functions: the other branch, all branches, the order of a sort."""

import numpy as np

from benchmarks.wrong_adjoints.cases import chained, wrong


@wrong("other branch", entries=np.s_[:5], culprit="slopes")
def limited_slopes():
    """Values at faces by the minmod limiter: the smaller one of two differences, or 0 at an extremum."""

    def slopes(u):
        d = np.diff(u)
        smaller = np.where(np.abs(d[:-1]) < np.abs(d[1:]), d[:-1], d[1:])
        return np.where(d[:-1] * d[1:] > 0, smaller, 0.0)

    def slopes_vjp(u, g):
        d = np.diff(u)
        g = np.where(d[:-1] * d[1:] > 0, g, 0.0)
        takes_left = np.abs(d[:-1]) > np.abs(d[1:])  # fault: <
        of_d = np.append(np.where(takes_left, g, 0.0), 0.0) + np.append(0.0, np.where(takes_left, 0.0, g))
        return np.append(0.0, of_d) - np.append(of_d, 0.0)

    def fluxes(slope):
        return slope + slope**2 / 2

    def fluxes_vjp(slope, g):
        return (1 + slope) * g

    start = np.array([0.0, 1.0, 3.0, 4.5, 5.0, 3.0, 4.0])
    return chained(start, (slopes, slopes_vjp), (fluxes, fluxes_vjp))


@wrong("bounds ignored", entries=np.s_[[0, 1, 6, 7]])
def valve_positions():
    """The flows through valves whose positions are limited to the range from 0 to 1."""

    def f(u):
        return np.minimum(np.maximum(u, 0.0), 1.0) ** 2 + u

    def vjp(u, g):
        return (2 * np.clip(u, 0, 1) * 1.0 + 1 + 2 * (u < 0)) * g  # fault: 1 where u is out of the range

    return f, vjp, np.linspace(-0.6, 1.6, 8)


@wrong("outside of the slopes at a kink", entries=np.s_[[0, 3]])
def friction():
    """The energy lost to friction by bodies of which two are at rest: the slopes there are -1 and 1."""

    def f(velocity):
        return np.abs(velocity) + velocity**2

    def vjp(velocity, g):
        slope = np.where(np.abs(velocity) < 0.01, 2.0, np.sign(velocity))  # fault: bodies at rest have slopes up to 1
        return (slope + 2 * velocity) * g

    return f, vjp, np.array([0.0, 1.0, -0.5, 0.0, 2.0])


@wrong("inverse permutation", entries=np.s_[:4])
def sorted_values():
    """The values of a sample in ascending order."""

    def f(u):
        return np.sort(u) ** 2

    def vjp(u, g):
        order = np.argsort(u)
        return (2 * np.sort(u) * g)[order]  # fault: out[order] = ..., the inverse permutation

    return f, vjp, np.array([2.0, 4.0, 1.0, 3.0, 5.0])
