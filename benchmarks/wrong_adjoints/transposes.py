"""Wrong derivatives of linear maps: a matrix in place of its transpose, reversed kernels, repeated indices."""

import numpy as np

from benchmarks.wrong_adjoints.cases import wrong


@wrong("missing transpose", diagnosis="instead of its transpose")
def upwind_step():
    """One upwind step of a concentration in a ring."""

    def f(u):
        return u - 0.4 * (u - np.roll(u, 1))

    def vjp(u, g):
        return g - 0.4 * (g - np.roll(g, 1))  # fault: the transpose rolls by -1

    return f, vjp, np.sin(np.arange(10.0))


@wrong("missing transpose", entries=np.s_[:, :2], diagnosis="instead of its transpose")
def rotated_coordinates():
    """Positions of points in a coordinate system that is rotated about the vertical axis."""
    c, s = np.cos(0.3), np.sin(0.3)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def f(points):
        return points @ rotation.T

    def vjp(points, g):
        return g @ rotation.T  # fault: g @ rotation

    return f, vjp, np.sin(np.arange(12.0)).reshape(4, 3)


@wrong("kernel not reversed", diagnosis="instead of its transpose")
def blurred_signal():
    """The convolution of a periodic signal with a kernel that is not symmetric."""
    kernel = (0.5, 0.3, 0.2)

    def f(u):
        return sum(k * np.roll(u, shift) for shift, k in enumerate(kernel))

    def vjp(u, g):
        return sum(k * np.roll(g, shift) for shift, k in enumerate(kernel))  # fault: np.roll(g, -shift)

    return f, vjp, np.sin(np.arange(12.0))


@wrong("repeated indices", entries=np.s_[1:-1])
def means_of_elements():
    """The mean of a field over each finite element, from its values at the two nodes of the element."""
    nodes = np.stack([np.arange(7), np.arange(1, 8)], axis=1)

    def f(u):
        return u[nodes].mean(axis=1)

    def vjp(u, g):
        out = np.zeros_like(u)
        out[nodes] += 0.5 * g[:, None]  # fault: adds once for each node; np.add.at(out, nodes, ...)
        return out

    return f, vjp, np.linspace(1.0, 2.0, 8) ** 2


@wrong("exchanged axes")
def slope_in_x():
    """The slope of a periodic field along its first axis."""

    def f(u):
        return np.roll(u, -1, axis=0) - u

    def vjp(u, g):
        return np.roll(g, 1, axis=1) - g  # fault: axis=0

    return f, vjp, np.sin(np.arange(25.0) ** 2).reshape(5, 5)


@wrong("wrap at the seam", entries=np.s_[[0, -2, -1]])
def shifted_ring():
    """A periodic field that is moved by one and a half cells, with linear interpolation."""
    cells = np.arange(9)

    def f(u):
        return 0.5 * (u[(cells - 1) % 9] + u[(cells - 2) % 9])

    def vjp(u, g):
        out = np.zeros_like(u)
        np.add.at(out, np.maximum(cells - 1, 0), 0.5 * g)  # fault: (cells - 1) % 9
        np.add.at(out, np.maximum(cells - 2, 0), 0.5 * g)  # fault: (cells - 2) % 9
        return out

    return f, vjp, np.cos(np.arange(9.0))
