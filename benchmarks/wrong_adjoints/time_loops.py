"""Wrong derivatives of time loops: off by one, dropped stages, wrong checkpoints, cotangents that are not added."""

import numpy as np

from benchmarks.wrong_adjoints.cases import wrong


def rates(u):
    """Return the rates of change of predators and prey."""
    prey, predators = u
    return np.array([prey * (1 - predators), predators * (prey - 1)])


def rates_transposed(u, g):
    """Return the product of g with the Jacobian of the rates."""
    prey, predators = u
    return np.array([(1 - predators) * g[0] + predators * g[1], -prey * g[0] + (prey - 1) * g[1]])


def euler_states(u, dt, steps):
    """Return the states of explicit Euler steps, with the first one."""
    states = [u]
    for _ in range(steps):
        states.append(states[-1] + dt * rates(states[-1]))
    return states


@wrong("off by one in time")
def predators_and_prey():
    """Predators and prey after ten explicit Euler steps."""
    dt = 0.05
    steps = 10

    def f(u):
        return euler_states(u, dt, steps)[-1]

    def vjp(u, g):
        states = euler_states(u, dt, steps)
        for n in reversed(range(steps)):
            g = g + dt * rates_transposed(states[n + 1], g)  # fault: the step starts at states[n]
        return g

    return f, vjp, np.array([1.5, 0.8])


@wrong("order of operations")
def pendulum():
    """A pendulum (angle, velocity) after five steps of the leapfrog method."""
    dt = 0.2

    def trajectory(x):
        states = [x]
        for _ in range(5):
            angle, velocity = states[-1]
            velocity = velocity - dt * np.sin(angle)
            states.append(np.array([angle + dt * velocity, velocity]))
        return states

    def f(x):
        return trajectory(x)[-1]

    def vjp(x, g):
        for angle, _ in reversed(trajectory(x)[:-1]):
            of_angle = g[0] - dt * np.cos(angle) * g[1]  # fault: the velocity comes last in a step, first in its VJP
            g = np.array([of_angle, g[1] + dt * of_angle])
        return g

    return f, vjp, np.array([1.0, 0.5])


@wrong("wrong checkpoint")
def checkpoints():
    """Predators and prey after twelve steps; every fourth state is stored, the others are computed again."""
    dt = 0.05

    def f(u):
        return euler_states(u, dt, 12)[-1]

    def vjp(u, g):
        stored = euler_states(u, dt, 12)[::4]
        for segment in (2, 1, 0):
            start = stored[max(segment - 1, 0)]  # fault: stored[segment]
            for state in reversed(euler_states(start, dt, 4)[:-1]):
                g = g + dt * rates_transposed(state, g)
        return g

    return f, vjp, np.array([1.5, 0.8])


@wrong("off by one in time")
def heating_schedule():
    """The final temperature of an oven as a function of the heating power in each time step."""

    def f(power):
        temperature = 0.0
        for heat in power:
            temperature = 0.8 * temperature + heat
        return temperature**2

    def vjp(power, g):
        temperature = np.polyval(power, 0.8)
        g = 2 * temperature * g
        out = np.zeros_like(power)
        for n in reversed(range(power.size)):
            g = 0.8 * g  # fault: this line belongs after the next one
            out[n] = g
        return out

    return f, vjp, np.linspace(1.0, 2.0, 8)


@wrong("cotangents not added")
def observed_trajectory():
    """All states of a decaying field, as an observer sees them."""

    def f(u):
        states = [u]
        for _ in range(4):
            states.append(states[-1] - 0.1 * states[-1] ** 2)
        return np.stack(states)

    def vjp(u, g):
        total = g[-1]  # fault: total + g[n] in each step, as all states are observed
        for state in reversed(f(u)[:-1]):
            total = (1 - 0.2 * state) * total
        return total

    return f, vjp, np.linspace(0.5, 1.5, 6)


@wrong("dropped history", entries=np.s_[:-1])
def delayed_feedback():
    """A control loop with a delay: the state depends on the history before time 0."""
    delay = 4
    dt = 0.1
    steps = 7

    def f(history):
        u = list(history)
        for _ in range(steps):
            u.append(u[-1] - dt * u[-1 - delay])
        return np.array(u[-3:])

    def vjp(history, g):
        of_u = np.zeros(history.size + steps)
        of_u[-3:] = g
        for n in reversed(range(history.size, of_u.size)):
            of_u[n - 1] += of_u[n]
            of_u[n - 1 - delay] -= dt * of_u[n]
        out = np.zeros_like(history)
        out[-1] = of_u[history.size - 1]  # fault: out = of_u[: history.size]
        return out

    return f, vjp, np.linspace(1.0, 2.0, 5)


@wrong("dropped steps", entries={"dt": ...})
def size_of_the_time_step():
    """A growing population as a function of its start and of the size of the time steps."""

    def trajectory(x):
        states = [x["u"]]
        for _ in range(5):
            states.append(states[-1] + x["dt"] * states[-1] * (2 - states[-1]))
        return states

    def f(x):
        return trajectory(x)[-1]

    def vjp(x, g):
        for state in reversed(trajectory(x)[:-1]):
            of_dt = np.sum(g * state * (2 - state))  # fault: add the shares of all steps
            g = g + x["dt"] * (2 - 2 * state) * g
        return {"u": g, "dt": of_dt}

    return f, vjp, {"u": np.linspace(0.5, 1.5, 4), "dt": np.array(0.1)}
