"""Wrong derivatives by the handling of arrays: values overwritten in place, state of other calls, order, precision."""

import numpy as np

from benchmarks.wrong_adjoints.cases import wrong


@wrong("overwritten in place")
def states_of_one_array():
    """A field after six explicit steps; the backward loop stores the states of the forward loop."""

    def f(u):
        for _ in range(6):
            u = u - 0.1 * u**3
        return u

    def vjp(u, g):
        state = u.copy()
        states = []
        for _ in range(6):
            states.append(state)  # fault: state.copy(), the next line changes all stored states
            state -= 0.1 * state**3
        for state in reversed(states):
            g = (1 - 0.3 * state**2) * g
        return g

    return f, vjp, np.linspace(0.5, 1.5, 6)


@wrong("cotangent changed in place", entries=())
def borrowed_cotangent():
    """A signal with half of its successor added; the VJP has the right value, and changes its argument."""

    def f(u):
        y = u.copy()
        y[:-1] += 0.5 * u[1:]
        return y

    def vjp(u, g):
        out = g  # fault: g.copy(), the caller may need g again
        out[1:] += 0.5 * g[:-1].copy()
        return out

    return f, vjp, np.linspace(1.0, 2.0, 8)


@wrong("state of another run")
def values_of_the_last_run():
    """A growth law; its derivative uses the result of the last run, whatever the point of that run was."""
    last = {}

    def f(u):
        last["y"] = np.exp(0.5 * u)
        return last["y"]

    def vjp(u, g):
        return 0.5 * last["y"] * g  # fault: np.exp(0.5 * u)

    return f, vjp, np.linspace(0.5, 2.0, 6)


@wrong("buffer not cleared", entries=np.s_[[0, 2, 5]])
def accumulated_gradient():
    """The squares of readings of sensors; the derivative adds to a buffer that is never set to zero."""
    sensors = np.array([0, 2, 2, 5])
    buffer = np.zeros(6)

    def f(u):
        return u[sensors] ** 2

    def vjp(u, g):
        np.add.at(buffer, sensors, 2 * u[sensors] * g)  # fault: buffer.fill(0) before
        return buffer.copy()

    return f, vjp, np.linspace(1.0, 2.0, 6)


@wrong("order of entries", entries=~np.eye(3, dtype=bool))
def columns_first():
    """Measurements of a square plate by a matrix that takes its cells row by row."""
    matrix = np.sin(np.arange(45.0) ** 2).reshape(5, 9)

    def f(u):
        return matrix @ u.ravel()

    def vjp(u, g):
        return (matrix.T @ g).reshape(u.shape, order="F")  # fault: order="C"

    return f, vjp, np.cos(np.arange(9.0)).reshape(3, 3)


@wrong("integer buffer", entries=np.s_[[1, 3, 4, 6]])
def cells_at_sensors():
    """The values of a field in the cells of four sensors."""
    cells = np.array([4, 1, 6, 3])

    def f(u):
        return 10 * u[cells]

    def vjp(u, g):
        out = np.zeros(u.size, dtype=cells.dtype)  # fault: dtype=u.dtype, integers drop the digits after the point
        for cell, weight in zip(cells, 10 * g):
            out[cell] += weight
        return out.astype(float)

    return f, vjp, np.linspace(1.0, 2.0, 8)


@wrong("single precision")
def checkpoints_in_single_precision():
    """Particles far from the origin in a periodic potential; the backward loop reads states with seven digits."""

    def trajectory(u):
        states = [u]
        for _ in range(10):
            states.append(states[-1] + 0.1 * np.sin(states[-1]))
        return states

    def f(u):
        return trajectory(u)[-1]

    def vjp(u, g):
        stored = [state.astype(np.float32) for state in trajectory(u)]  # fault: in double precision
        for state in reversed(stored[:-1]):
            g = (1 + 0.1 * np.cos(state)) * g
        return g

    return f, vjp, np.linspace(1000.0, 1004.0, 6)


@wrong("single precision")
def cotangent_in_single_precision():
    """The pressure drops in a network of pipes; the derivative passes through a library in single precision."""
    matrix = np.sin(np.arange(30.0) ** 2).reshape(5, 6)

    def f(flow):
        return matrix @ flow**3

    def vjp(flow, g):
        slopes = 3 * flow**2 * (matrix.T @ g)
        return slopes.astype(np.float32).astype(float)  # fault: errors of 1e-8 to 6e-8

    return f, vjp, np.linspace(1.0, 2.0, 6)
