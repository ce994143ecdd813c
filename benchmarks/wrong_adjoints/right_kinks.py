"""Right derivatives with kinks near by, piecewise and periodic functions, and powers near 0."""

import numpy as np

from benchmarks.wrong_adjoints.cases import right


@right("kinks at a distance of 1e-3")
def absolute_values():
    """Absolute errors of a prediction, some of them small."""
    data = np.linspace(1.0, 2.0, 6)

    def f(u):
        return np.abs(u - data)

    def vjp(u, g):
        return np.sign(u - data) * g

    return f, vjp, data + np.array([1e-3, -2e-3, 0.5, -0.4, 3e-3, 0.2])


@right("at a kink", undecidable="at a kink each value between the two slopes is right")
def absolute_values_at_zero():
    """Absolute errors of a prediction that is exact in two points; the derivative there is 0."""
    data = np.linspace(1.0, 2.0, 5)

    def f(u):
        return np.abs(u - data) + u

    def vjp(u, g):
        return (np.sign(u - data) + 1) * g

    return f, vjp, data + np.array([0.3, 0.0, -0.2, 0.0, 0.4])


@right("limiter near its switch")
def minmod_near_its_switch():
    """Slopes by the minmod limiter, where two differences are nearly equal."""

    def f(u):
        d = np.diff(u)
        smaller = np.where(np.abs(d[:-1]) < np.abs(d[1:]), d[:-1], d[1:])
        return np.where(d[:-1] * d[1:] > 0, smaller, 0.0)

    def vjp(u, g):
        d = np.diff(u)
        g = np.where(d[:-1] * d[1:] > 0, g, 0.0)
        takes_left = np.abs(d[:-1]) < np.abs(d[1:])
        of_d = np.append(np.where(takes_left, g, 0.0), 0.0) + np.append(0.0, np.where(takes_left, 0.0, g))
        return np.append(0.0, of_d) - np.append(of_d, 0.0)

    return f, vjp, np.array([0.0, 1.0, 2.002, 3.0, 3.5, 2.0, 1.0])


@right("many kinks")
def relu_network():
    """A network of two layers with ReLU."""
    rng = np.random.default_rng(3)
    V = rng.normal(size=(20, 6))
    W = rng.normal(size=(3, 20))

    def f(u):
        return W @ np.maximum(V @ u, 0.0)

    def vjp(u, g):
        return V.T @ ((V @ u > 0) * (W.T @ g))

    return f, vjp, rng.normal(size=6)


@right("second largest value near by")
def largest_stress():
    """The largest stress in a structure, with another one that is smaller by 1e-4."""

    def f(u):
        return np.max(u**2)

    def vjp(u, g):
        out = np.zeros_like(u)
        n = np.argmax(u**2)
        out[n] = 2 * u[n] * g
        return out

    return f, vjp, np.array([1.0, 2.0, 1.9999, -1.5, 0.5])


@right("piecewise linear")
def table_of_properties():
    """Values from a table with linear interpolation; one point is 1e-3 intervals from a node of the table."""
    table = np.sin(np.arange(11.0))

    def f(x):
        cell = np.clip(np.floor(x).astype(int), 0, 9)
        return table[cell] + (x - cell) * (table[cell + 1] - table[cell])

    def vjp(x, g):
        cell = np.clip(np.floor(x).astype(int), 0, 9)
        return (table[cell + 1] - table[cell]) * g

    return f, vjp, np.array([1.3, 4.001, 6.5, 8.7])


@right("velocities change sign")
def upwind_near_stagnation():
    """Upwind fluxes of a velocity that is 1e-3 at a stagnation point."""

    def f(u):
        return np.maximum(u, 0.0) * u + np.minimum(u, 0.0) * np.roll(u, -1)

    def vjp(u, g):
        negative = np.minimum(u, 0.0)
        own = np.maximum(u, 0.0) + (u > 0) * u + (u < 0) * np.roll(u, -1)
        return own * g + np.roll(negative * g, 1)

    return f, vjp, np.array([0.8, 0.3, 1e-3, -0.4, -0.9, -2e-3, 0.5])


@right("clipped, derivative 0")
def closed_valves():
    """Valves of which most are fully open or closed."""

    def f(u):
        return np.minimum(np.maximum(u, 0.0), 1.0) ** 2

    def vjp(u, g):
        return 2 * u * ((u > 0) & (u < 1)) * g

    return f, vjp, np.array([-0.5, -0.3, 0.4, 1.6, 2.0])


@right("power 1.5 near 0")
def friction_law():
    """The drag of small and large particles, a power of 1.5 of their velocity."""

    def f(u):
        return u**1.5

    def vjp(u, g):
        return 1.5 * np.sqrt(u) * g

    return f, vjp, np.array([1e-6, 1e-3, 0.1, 1.0])


@right("periodic, jump near by")
def angles():
    """Angles in the range from 0 to 2 pi, one of them 1e-3 from the jump, and a smooth function of them."""

    def f(u):
        wrapped = np.mod(u, 2 * np.pi)
        return wrapped + np.sin(wrapped)

    def vjp(u, g):
        return (1 + np.cos(u)) * g

    return f, vjp, np.array([0.5, 2.0, 2 * np.pi - 1e-3, 9.0])


@right("periodic, steep")
def phases():
    """The signal of an interferometer with 200 fringes."""

    def f(u):
        return np.sin(200 * u)

    def vjp(u, g):
        return 200 * np.cos(200 * u) * g

    return f, vjp, np.linspace(0.5, 1.5, 5)
