"""Right derivatives of long, stiff and chaotic runs, and of runs with checkpoints."""

import numpy as np

from benchmarks.wrong_adjoints.cases import right


def lorenz(x):
    """Return the rates of the Lorenz system."""
    return np.array([10 * (x[1] - x[0]), x[0] * (28 - x[2]) - x[1], x[0] * x[1] - 8 / 3 * x[2]])


def lorenz_jacobian(x):
    """Return the Jacobian of the Lorenz system."""
    return np.array([[-10.0, 10.0, 0.0], [28 - x[2], -1.0, -x[0]], [x[1], x[0], -8 / 3]])


@right("chaotic, short horizon")
def lorenz_system():
    """The Lorenz system after 300 Euler steps, in which errors grow by a factor of about 30."""
    dt = 0.005

    def trajectory(x):
        states = [x]
        for _ in range(300):
            states.append(states[-1] + dt * lorenz(states[-1]))
        return states

    def f(x):
        return trajectory(x)[-1]

    def vjp(x, g):
        for state in reversed(trajectory(x)[:-1]):
            g = g + dt * lorenz_jacobian(state).T @ g
        return g

    return f, vjp, np.array([1.0, 1.0, 20.0])


@right("chaotic, errors grow by 1e4")
def logistic_map():
    """A population after fourteen generations of the chaotic logistic map."""

    def trajectory(u):
        states = [u]
        for _ in range(14):
            states.append(3.9 * states[-1] * (1 - states[-1]))
        return states

    def f(u):
        return trajectory(u)[-1]

    def vjp(u, g):
        for state in reversed(trajectory(u)[:-1]):
            g = 3.9 * (1 - 2 * state) * g
        return g

    return f, vjp, np.array([0.31, 0.42, 0.57])


@right("chain of 500 steps")
def long_chain():
    """Oscillators with weak friction after 500 steps."""
    dt = 0.01

    def trajectory(x):
        states = [x]
        for _ in range(500):
            u, v = states[-1]
            v = v - dt * (u + 0.1 * v**3)
            states.append(np.stack([u + dt * v, v]))
        return states

    def f(x):
        return trajectory(x)[-1]

    def vjp(x, g):
        for _, v in reversed(trajectory(x)[:-1]):
            of_v = g[1] + dt * g[0]
            g = np.stack([g[0] - dt * of_v, of_v * (1 - 0.3 * dt * v**2)])
        return g

    return f, vjp, np.stack([np.linspace(1.0, 2.0, 3), np.zeros(3)])


@right("stiff, nonlinear")
def van_der_pol():
    """A stiff van der Pol oscillator after ten implicit steps, each solved by Newton's method."""
    dt = 0.05
    mu = 100.0

    def rates(x):
        return np.array([x[1], mu * (1 - x[0] ** 2) * x[1] - x[0]])

    def jacobian(x):
        return np.array([[0.0, 1.0], [-2 * mu * x[0] * x[1] - 1, mu * (1 - x[0] ** 2)]])

    def trajectory(x):
        states = [x]
        for _ in range(10):
            new = states[-1]
            for _ in range(15):
                residual = new - states[-1] - dt * rates(new)
                new = new - np.linalg.solve(np.eye(2) - dt * jacobian(new), residual)
            states.append(new)
        return states

    def f(x):
        return trajectory(x)[-1]

    def vjp(x, g):
        for state in reversed(trajectory(x)[1:]):
            g = np.linalg.solve((np.eye(2) - dt * jacobian(state)).T, g)
        return g

    return f, vjp, np.array([2.0, -0.6])


@right("checkpoints")
def right_checkpoints():
    """A spreading epidemic after 32 steps; every eighth state is stored, the others are computed again."""
    dt = 0.2

    def run(x, steps):
        states = [x]
        for _ in range(steps):
            s, i = states[-1]
            states.append(np.stack([s - dt * s * i, i + dt * (s * i - 0.3 * i)]))
        return states

    def f(x):
        return run(x, 32)[-1]

    def vjp(x, g):
        for start in reversed(run(x, 32)[:-1:8]):
            for s, i in reversed(run(start, 8)[:-1]):
                exchange = dt * (g[1] - g[0])
                g = np.stack([g[0] + exchange * i, g[1] + exchange * s - 0.3 * dt * g[1]])
        return g

    return f, vjp, np.array([[0.9, 0.8], [0.01, 0.02]])


@right("events")
def bouncing_ball():
    """The heights of balls after two seconds, with one impact each."""

    def f(height):
        impact = np.sqrt(2 * height / 9.81)
        speed = 0.8 * 9.81 * impact
        after = 1.0 - impact
        return speed * after - 9.81 / 2 * after**2

    def vjp(height, g):
        impact = np.sqrt(2 * height / 9.81)
        after = 1.0 - impact
        of_impact = 0.8 * 9.81 * after - 0.8 * 9.81 * impact + 9.81 * after
        return of_impact / (9.81 * impact) * g

    return f, vjp, np.linspace(2.0, 3.5, 4)
