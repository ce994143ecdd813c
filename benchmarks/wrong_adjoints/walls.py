"""Wrong derivatives at walls: signs, corners of masks, data on boundaries."""

import numpy as np

from benchmarks.wrong_adjoints.cases import wrong


def insulated_laplacian(u):
    """Return the sum of the differences to all neighbours; nothing passes the walls. The matrix is symmetric."""
    total = np.zeros_like(u)
    for axis in range(u.ndim):
        padded = np.pad(u, [(int(axis == other), int(axis == other)) for other in range(u.ndim)], mode="edge")
        total = total + np.diff(padded, n=2, axis=axis)
    return total


@wrong("wall sign", entries=np.s_[[0, -1]])
def cold_walls():
    """One explicit step of heat conduction in a rod between walls of temperature 0."""

    def f(u):
        ghosts = np.concatenate([-u[:1], u, -u[-1:]])
        return u + 0.2 * np.diff(ghosts, 2)

    def vjp(u, g):
        ghosts = np.concatenate([g[:1], g, g[-1:]])  # fault: the values beyond the walls are -g
        return g + 0.2 * np.diff(ghosts, 2)

    return f, vjp, np.linspace(1.0, 2.0, 12)


@wrong("dropped wall term", entries=np.s_[0, :], diagnosis="the same cotangent at x and beside x")
def cooled_plate():
    """One explicit step of a plate that loses heat to the air at one of its walls."""

    def f(u):
        new = u + 0.1 * insulated_laplacian(u)
        new[0] -= 0.3 * u[0] ** 2
        return new

    def vjp(u, g):
        return g + 0.1 * insulated_laplacian(g)  # fault: without the term -0.6 u g in row 0

    return f, vjp, 1.5 + np.sin(np.arange(30.0)).reshape(6, 5)


@wrong("boundary data", entries={"inflow": ...})
def inflow():
    """One upwind step of a concentration with a given value at the inlet."""

    def f(x):
        upstream = np.append(x["inflow"], x["u"][:-1])
        return x["u"] - 0.4 * (x["u"] - upstream)

    def vjp(x, g):
        of_u = 0.6 * g
        of_u[:-1] += 0.4 * g[1:]
        return {"u": of_u, "inflow": 0.0 * x["inflow"]}  # fault: 0.4 g[0]

    return f, vjp, {"u": np.linspace(1.0, 2.0, 8), "inflow": np.array(3.0)}


@wrong("mask", entries=np.s_[2:4, 1:4])
def obstacle():
    """One explicit step of heat conduction around two solid cells that no heat enters."""
    fluid = np.ones((6, 5))
    fluid[2:4, 2] = 0.0
    open_x = fluid[1:] * fluid[:-1]
    open_y = fluid[:, 1:] * fluid[:, :-1]

    def step(u, open_x, open_y):
        flux_x = np.pad(open_x * np.diff(u, axis=0), ((1, 1), (0, 0)))
        flux_y = np.pad(open_y * np.diff(u, axis=1), ((0, 0), (1, 1)))
        return u + 0.2 * (np.diff(flux_x, axis=0) + np.diff(flux_y, axis=1))

    def f(u):
        return step(u, open_x, open_y)

    def vjp(u, g):
        return step(g, open_x, 1.0)  # fault: the faces in y are closed too

    return f, vjp, np.cos(np.arange(30.0)).reshape(6, 5)
