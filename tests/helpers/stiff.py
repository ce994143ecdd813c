"""Three stiff problems with sensitivities by SciPy.

Run: python tests/helpers/stiff.py (two minutes) prints the numbers below.

Each is integrated together with its variational equation S' = f_u S + f_p p, S = du/dlog p, by SciPy's Radau with
rtol 1e-10 (LSODA with 1e-12 agrees to 1e-6 except for the longest run): nothing of this library takes part.
"""

import autograd.numpy as anp
import numpy as np
from scipy.integrate import solve_ivp


def van_der_pol(u, p):
    """A relaxation oscillation: slow for a time of mu, and a jump in 1 / mu (van der Pol 1926)."""
    return anp.array([u[1], p[0] * (1 - u[0] ** 2) * u[1] - u[0]])


def of_van_der_pol(u, p):
    """The derivatives of the rate in u and p."""
    return np.array([[0, 1], [-2 * p[0] * u[0] * u[1] - 1, p[0] * (1 - u[0] ** 2)]]), np.array(
        [[0.0], [(1 - u[0] ** 2) * u[1]]]
    )


def robertson(u, p):
    """Return the rates of Robertson's three reactions (1966).

    A -> B, B + C -> A + C, 2 B -> B + C
    """
    slow = p[0] * u[0]
    back = p[1] * u[1] * u[2]
    fast = p[2] * u[1] ** 2
    return anp.array([back - slow, slow - back - fast, fast])


def of_robertson(u, p):
    """The derivatives of the rate in u and p."""
    slow = np.array([p[0], 0, 0])
    back = np.array([0, p[1] * u[2], p[1] * u[1]])
    fast = np.array([0, 2 * p[2] * u[1], 0])
    of_p = np.array([[-u[0], u[1] * u[2], 0], [u[0], -u[1] * u[2], -(u[1] ** 2)], [0, 0, u[1] ** 2]])
    return np.array([back - slow, slow - back - fast, fast]), of_p


# HIRES, high irradiance responses of photomorphogenesis (Schaefer 1975): (species, rate, source species, sign)
REACTIONS = (
    (0, 0, 0, -1),
    (0, 1, 1, 1),
    (0, 2, 2, 1),
    (1, 0, 0, 1),
    (1, 4, 1, -1),
    (2, 5, 2, -1),
    (2, 1, 3, 1),
    (2, 6, 4, 1),
    (3, 2, 1, 1),
    (3, 0, 2, 1),
    (3, 7, 3, -1),
    (4, 8, 4, -1),
    (4, 1, 5, 1),
    (4, 1, 6, 1),
    (5, 10, 3, 1),
    (5, 0, 4, 1),
    (5, 1, 5, -1),
    (5, 10, 6, 1),
    (6, 11, 6, -1),
    (7, 11, 6, 1),
)
SPECIES, RATES, SOURCES, SIGNS = np.array(REACTIONS).T
GAINS = np.zeros((8, len(REACTIONS)))
GAINS[SPECIES, np.arange(len(REACTIONS))] = SIGNS
LAST = np.array([0.0, 0, 0, 0, 0, -1, 1, -1])
SUPPLY = np.eye(8)[0]


def hires(u, p):
    """Eight species, twelve rates."""
    return anp.dot(GAINS, p[RATES] * u[SOURCES]) + SUPPLY * p[3] + LAST * p[9] * u[5] * u[7]


def of_hires(u, p):
    """The derivatives of the rate in u and p."""
    of_u = GAINS * p[RATES] @ np.eye(8)[SOURCES]
    of_u += p[9] * np.outer(LAST, u[7] * np.eye(8)[5] + u[5] * np.eye(8)[7])
    of_p = GAINS * u[SOURCES] @ np.eye(12)[RATES]
    return of_u, of_p + np.outer(SUPPLY, np.eye(12)[3]) + np.outer(LAST * u[5] * u[7], np.eye(12)[9])


OF_HIRES = [1.71, 0.43, 8.32, 0.0007, 8.75, 10.03, 0.035, 1.12, 1.745, 280.0, 0.69, 1.81]
SCENES = {  # name: rate, its derivatives, start, params, end, number of the state that is looked at
    "van der Pol, 20": (van_der_pol, of_van_der_pol, [2.0, 0.0], [20.0], 20.0, 0),
    "van der Pol, 100": (van_der_pol, of_van_der_pol, [2.0, 0.0], [100.0], 100.0, 0),
    "van der Pol, 1000": (van_der_pol, of_van_der_pol, [2.0, 0.0], [1000.0], 2000.0, 0),
    "Robertson": (robertson, of_robertson, [1.0, 0.0, 0.0], [0.04, 1e4, 3e7], 4e7, 2),
    "HIRES": (hires, of_hires, [1.0, 0, 0, 0, 0, 0, 0, 0.0057], OF_HIRES, 321.8122, 5),
}


def by_scipy(rate, derivatives, start, params, end, number, rtol=1e-10):
    """(state, derivative of the number looked at in the logarithm of each parameter) at the end."""
    p = np.array(params)
    n = len(start)
    m = len(params)

    def both(t, z):
        u = z[:n]
        S = z[n:].reshape(n, m)
        of_u, of_p = derivatives(u, p)
        return np.concatenate([rate(u, p), (of_u @ S + of_p * p).ravel()])

    atol = np.repeat([1e-14, 1e-12], [n, n * m])
    run = solve_ivp(both, (0, end), [*start, *[0.0] * (n * m)], "Radau", rtol=rtol, atol=atol, t_eval=[end])
    return run.y[:n, -1], run.y[n:, -1].reshape(n, m)[number]


if __name__ == "__main__":
    for name, scene in SCENES.items():
        print(f'    "{name}": {tuple(part.tolist() for part in by_scipy(*scene))},', flush=True)
