"""Adjoint examples of SUNDIALS, PETSc and SciML, beside the numbers that they publish.

Each case is what a user of this library writes: an integral over time is one more entry of the state, a Hessian is a
column of `hvp` or a difference of gradients, least-squares shadowing is a solve with a sparse matrix. The numbers are
those of the files of expected output in the sources of SUNDIALS 7.4 (examples/cvodes, idas and arkode), PETSc
(src/ts/tutorials/output) and SciMLSensitivity (docs and tests).

Columns: case; quantity; published number; ours; relative difference; its bound; seconds of all numbers of the case;
verdict of a quick `check.gradient` on the loss of the case. A bound is half a unit of the last published digit, or it
is given with the case, because the published number has an error of its own. Rows with `!` are published numbers that
are known to be wrong: their difference is larger than the bound of the right ones.

Run ``python -m benchmarks.suites [name ...] [--quick]`` in the root of the repository; a name is a part of the name of
a case. ``--quick`` leaves the verdicts out.
"""

import argparse
from dataclasses import dataclass
from time import process_time

import autograd.numpy as np
import scipy.sparse as sparse

import sparsedp as dp
from benchmarks.stiff import robertson

ROBERTSON = np.array([0.04, 1e4, 3e7])
LOTKA_VOLTERRA = np.array([1.0, 1.0, 1.5, 1.0, 3.0, 1.0])  # two initial values, four parameters
LORENZ = np.array([10.0, 28.0, 8.0 / 3.0])
WRONG_HESSIAN = "1.1093e-01"  # of SUNDIALS before 2.7: an index was wrong in its second adjoint problem


@dataclass(frozen=True)
class Number:
    """A published number and ours."""

    quantity: str
    published: str
    ours: float
    bound: float
    wrong: bool = False  # the published number is known to be wrong

    @property
    def difference(self):
        """Return the relative difference."""
        return abs(self.ours / float(self.published) - 1)

    @property
    def holds(self):
        """Return whether the difference is within the bound, or beyond it for a wrong number."""
        return self.difference > self.bound if self.wrong else self.difference <= self.bound


def rounding(published):
    """Return half a unit of the last digit, relative to the number."""
    mantissa, _, exponent = published.lower().partition("e")
    unit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    return unit / 2 / abs(float(published)) * (1 + 1e-9)


def numbers(quantities, published, ours, bound=None, wrong=False):
    """Return one Number for each of the quantities.

    Parameters
    ----------
    quantities, published : str
        Names separated by commas, numbers separated by spaces.
    ours : sequence of float
    bound : float, optional
        Default: the rounding of each published number.
    wrong : bool
    """
    rows = zip(quantities.split(", "), published.split(), np.ravel(ours), strict=True)
    return [Number(name, text, float(value), bound or rounding(text), wrong) for name, text, value in rows]


def with_integral(rate, integrand):
    """Return the rate of a state that has the integral of the integrand as its last entry."""
    return lambda u, p: np.concatenate([rate(u[:-1], p), np.array([integrand(u[:-1])])])


# SUNDIALS


def robertson_integral(end, floor, tolerance=1e-6):
    """Return the integral of y3 as a function of the start and of the parameters in units of their values."""
    rate = with_integral(robertson, lambda u: u[2])
    step = dp.stepper("radau", rate, end, tolerance=tolerance, floor=np.array(floor))

    def integral(z):
        start = np.concatenate([z[:3], np.zeros(1)])
        return step(start, z[3:] * ROBERTSON)[3]

    return integral, np.array([1.0, 0.0, 0.0, 1.0, 1.0, 1.0])


def robertson_50():
    """Adjoint of Robertson's kinetics until 50, as cvsRoberts_ASAi_dns (relative tolerance 1e-6)."""
    integral, z = robertson_integral(50.0, [1e-3, 1e-7, 1e-3, 1.0])
    _, slopes = dp.value_and_grad(integral)(z)
    found = numbers("lambda1, lambda2, lambda3", "8.4190e+00 1.6097e+01 1.6097e+01", slopes[:3], 3e-5)
    found += numbers("dG/dp1, dG/dp2, dG/dp3", "1.7341e+02 -5.0590e-04 8.4321e-08", slopes[3:] / ROBERTSON, 5e-5)
    return found, lambda q: integral(np.concatenate([z[:3], q])), z[3:]


def robertson_4e7():
    """Adjoint of Robertson's kinetics until 4e7, as cvsRoberts_ASAi_dns, and with its constraints at looser rtol."""
    integral, z = robertson_integral(4e7, [1e-6, 1e-11, 1e-2, 1e3])
    value, slopes = dp.value_and_grad(integral)(z)
    in_p = slopes[3:] / ROBERTSON
    found = numbers("G", "3.9983e+07", [value], 2e-5)
    found += numbers("lambda1, lambda2, lambda3", "3.9967e+07 3.9967e+07 3.9967e+07", slopes[:3])
    found += numbers("dG/dp1, dG/dp2, dG/dp3", "7.6842e+05 -3.0691e+00 5.1144e-04", in_p, 1e-4)
    quantities = "dG/dp1 with constraints, dG/dp2 with constraints, dG/dp3 with constraints"
    found += numbers(quantities, "1.1166e+06 -4.4617e+00 7.4511e-04", in_p, 0.1, wrong=True)
    return found, lambda q: integral(np.concatenate([z[:3], q])), z[3:]


def robertson_4e10():
    """Adjoint of Robertson's kinetics until 4e10, as idasRoberts_ASAi_dns (a DAE: y3 = 1 - y1 - y2)."""
    integral, z = robertson_integral(4e10, [1e-9, 1e-14, 1e-2, 1e6])
    value, slopes = dp.value_and_grad(lambda q: integral(np.concatenate([z[:3], q])))(z[3:])
    found = numbers("G", "4.0000e+10", [value])
    found += numbers("dG/dp1, dG/dp2, dG/dp3", "1.4878e+06 -5.9467e+00 9.9112e-04", slopes / ROBERTSON, 1e-3)
    return found, lambda q: integral(np.concatenate([z[:3], q])), z[3:]


FORWARD = """
4e-1  2e-4   9.8517e-01  3.3864e-05  1.4794e-02 -3.5595e-01  3.9025e-04  3.5556e-01
             9.5431e-08 -2.1309e-10 -9.5218e-08 -1.5833e-11 -5.2900e-13  1.6362e-11
4e0   2e-4   9.0552e-01  2.2405e-05  9.4459e-02 -1.8761e+00  1.7922e-04  1.8759e+00
             2.9614e-06 -5.8305e-10 -2.9608e-06 -4.9334e-10 -2.7626e-13  4.9362e-10
4e1   2e-4   7.1583e-01  9.1856e-06  2.8416e-01 -4.2475e+00  4.5913e-05  4.2475e+00
             1.3731e-05 -2.3573e-10 -1.3730e-05 -2.2883e-09 -1.1380e-13  2.2884e-09
4e2   2e-4   4.5052e-01  3.2229e-06  5.4947e-01 -5.9584e+00  3.5431e-06  5.9584e+00
             2.2738e-05 -2.2605e-11 -2.2738e-05 -3.7896e-09 -4.9948e-14  3.7897e-09
4e3   2e-4   1.8320e-01  8.9423e-07  8.1680e-01 -4.7501e+00 -5.9938e-06  4.7501e+00
             1.8809e-05  2.3126e-11 -1.8809e-05 -3.1348e-09 -1.8758e-14  3.1348e-09
4e4   4e-4   3.8977e-02  1.6215e-07  9.6102e-01 -1.5748e+00 -2.7619e-06  1.5748e+00
             6.2870e-06  1.1002e-11 -6.2870e-06 -1.0478e-09 -4.5362e-15  1.0478e-09
4e5   4e-4   4.9394e-03  1.9854e-08  9.9506e-01 -2.3640e-01 -4.5856e-07  2.3640e-01
             9.4530e-07  1.8331e-12 -9.4530e-07 -1.5753e-10 -6.3637e-16  1.5753e-10
4e6   4e-4   5.1681e-04  2.0683e-09  9.9948e-01 -2.5663e-02 -5.1050e-08  2.5663e-02
             1.0265e-07  2.0418e-13 -1.0265e-07 -1.7110e-11 -6.8509e-17  1.7110e-11
4e7   4e-4   5.2039e-05  2.0817e-10  9.9995e-01 -2.5997e-03 -5.1956e-09  2.5997e-03
             1.0399e-08  2.0782e-14 -1.0399e-08 -1.7330e-12 -6.9328e-18  1.7330e-12
4e8   2e-3   5.2092e-06  2.0837e-11  9.9999e-01 -2.6049e-04 -5.2122e-10  2.6049e-04
             1.0419e-09  2.0849e-15 -1.0419e-09 -1.7362e-13 -6.9448e-19  1.7362e-13
4e9   1e-2   5.1691e-07  2.0676e-12  1.0000e+00 -2.5902e-05 -5.1894e-11  2.5902e-05
             1.0361e-10  2.0757e-16 -1.0361e-10 -1.7230e-14 -6.8920e-20  1.7230e-14
4e10  0.1    5.5845e-08  2.2338e-13  1.0000e+00 -2.6510e-06 -4.9641e-12  2.6510e-06
             1.0604e-11  1.9856e-17 -1.0604e-11 -1.8615e-15 -7.4460e-21  1.8615e-15
"""  # end and bound, then y1 y2 y3 and their derivatives in p1, in p2 and in p3


def robertson_forward():
    """Forward sensitivities of Robertson's kinetics by `jvp`, as cvsRoberts_FSA_dns (relative tolerance 1e-4)."""
    quantities = "y1, y2, y3, " + ", ".join(f"dy{i}/dp{k}" for k in (1, 2, 3) for i in (1, 2, 3))
    found = []
    time = 0.0
    state = np.array([1.0, 0.0, 0.0])
    slopes = np.zeros((3, 3))
    for end, bound, *published in np.reshape(FORWARD.split(), (12, 14)):
        floor = np.minimum(state / 10 + 1e-13, [1e-3, 1e-6, 1e-3])
        step = dp.stepper("radau", robertson, float(end) - time, tolerance=1e-5, floor=floor)
        last = lambda z, step=step: step(z[:3], z[3:])
        z = np.concatenate([state, ROBERTSON])
        tangents = (np.concatenate([slope, unit]) for slope, unit in zip(slopes, np.eye(3), strict=True))
        results = [dp.jvp(last, z, tangent) for tangent in tangents]
        state = results[0][0]
        slopes = np.array([slope for _, slope in results])
        time = float(end)
        names = ", ".join(f"{name} at {end}" for name in quantities.split(", "))
        found += numbers(names, " ".join(published), [*state, *slopes.ravel()], float(bound))
    step = dp.stepper("radau", robertson, 40.0, tolerance=1e-9, floor=np.array([1e-3, 1e-6, 1e-3]))
    return found, lambda q: step(np.array([1.0, 0.0, 0.0]), q * ROBERTSON)[2], np.ones(3)


def robertson_hessian():
    """Hessian of Robertson's kinetics in two parameters, as idasHessian_ASA_FSA (relative tolerance 1e-8)."""
    rate = with_integral(robertson, lambda u: np.sum(u**2) / 2)
    step = dp.stepper("radau", rate, 80.0, tolerance=1e-7, floor=np.array([1e-3, 1e-7, 1e-3, 1.0]))
    start = np.array([1.0, 0.0, 0.0, 0.0])
    scale = ROBERTSON[:2]
    integral = lambda q: step(start, np.concatenate([q * scale, ROBERTSON[2:]]))[3]
    q = np.ones(2)
    value, slopes = dp.value_and_grad(integral)(q)
    hessian = differences(dp.grad(integral), q, 1e-4) / np.outer(scale, scale)
    found = numbers("G", "2.5042e+01", [value])
    found += numbers("dG/dp1, dG/dp2", "-1.3753e+02 4.1552e-04", slopes / scale, 4e-5)
    published = "4.4243e+03 -2.7779e-03 -2.7779e-03 -2.4173e-08"
    found += numbers("H11, H12, H21, H22", published, hessian, 1e-4)
    return found, integral, q


def differences(gradient, x, size):
    """Return the derivative of a gradient by central differences."""
    shifts = size * np.eye(x.size)
    return np.array([gradient(x + shift) - gradient(x - shift) for shift in shifts]) / (2 * size)


def decay(u, p):
    """Return the rate of the Hessian example (Ozyurt and Barton, SIAM J. Sci. Comput. 26, 2005)."""
    return np.array([-p[0] * u[0] ** 2 - u[2], -u[1], -(p[1] ** 2) * u[1] * u[2]])


def hessian():
    """Gradient and Hessian of an integral, as cvsHessian_ASA_FSA (relative tolerance 1e-8)."""
    rate = with_integral(decay, lambda u: np.sum(u**2) / 2)
    step = dp.stepper("rk4", rate, 0.02)
    last = lambda p: dp.rollout(step, np.array([1.0, 1.0, 1.0, 0.0]), p, 100)
    integral = lambda p: last(p)[3]
    p = np.array([1.0, 2.0])
    columns = [dp.hvp(integral, p, unit) for unit in np.eye(2)]
    shifts = [0.01 * unit for unit in np.eye(2)]
    seconds = [(integral(p + h) - 2 * integral(p) + integral(p - h)) / 1e-4 for h in shifts]
    found = numbers("y1, y2, y3, G", "2.2732e-01 1.3534e-01 3.1472e-02 5.3088e-01", last(p))
    tangents = [dp.jvp(last, p, unit)[1] for unit in np.eye(2)]
    sensitivities = [*tangents[0][:1], *tangents[1][[0, 2]]]
    found += numbers("dy1/dp1, dy1/dp2, dy3/dp2", "-1.6714e-01 2.1339e-01 -1.0885e-01", sensitivities, 5e-5)
    quantities = "dG/dp1 forward, dG/dp2 forward, dG/dp1 adjoint, dG/dp2 adjoint"
    slopes = [*(tangent[3] for tangent in tangents), *dp.grad(integral)(p)]
    found += numbers(quantities, "-1.2838e-01 1.8037e-02 -1.2838e-01 1.8036e-02", slopes, 6e-5)
    found += numbers("H11, H12, H21, H22", "1.5628e-01 -7.8678e-02 -7.8678e-02 8.9814e-02", columns, 2e-5)
    found += numbers("H22 until 2012", WRONG_HESSIAN, [columns[1][1]], 0.1, wrong=True)
    # Their values have errors of 1e-8, and a second difference divides these by 1e-4.
    quantities = "H11 by differences of G, H22 by differences of G"
    found += numbers(quantities, "1.5594e-01 8.9483e-02", seconds, 5e-3)
    return found, integral, p


def predator_prey(u, p):
    """Return the rate of Lotka and Volterra."""
    return np.array([p[0] * u[0] - p[1] * u[0] * u[1], p[3] * u[0] * u[1] - p[2] * u[1]])


def lotka_volterra():
    """Adjoint of the equations of Lotka and Volterra, as cvsLotkaVolterra_ASA and ark_lotka_volterra_ASA."""
    step = dp.jit(dp.stepper("rk4", predator_prey, 0.01))
    last = lambda z: dp.rollout(step, z[:2], z[2:], 1000)
    loss = lambda z: np.sum((1 - last(z)) ** 2) / 2
    u = last(LOTKA_VOLTERRA)
    slopes = dp.grad(loss)(LOTKA_VOLTERRA)
    found = numbers("u1, u2", "1.026344801589377e+00 9.096910639243128e-01", u, 1e-6)
    found += numbers("u1 of ARKODE, u2 of ARKODE", "1.026344767571517e+00 9.096910781383605e-01", u, 1e-7)
    found += numbers("dg/du1, dg/du2", "2.634480158937702e-02 -9.030893607568724e-02", u - 1, 1e-5)
    quantities = "lambda1, lambda2, dg/dp1, dg/dp2, dg/dp3, dg/dp4"
    published = "2.995996056786226e-01 -1.415181416922305e-02 6.219617362820864e-01 "
    published += "6.800142032161892e-02 1.691765074712130e-01 2.725607529639176e-01"
    found += numbers(quantities, published, slopes, 2e-5)
    quantities = ", ".join(f"{name} of ARKODE" for name in quantities.split(", "))
    published = "2.989185860384022e-01 -1.386129599278254e-02 6.206008900347868e-01 "
    published += "6.815765856067170e-02 1.689489159532799e-01 2.720135769624489e-01"
    found += numbers(quantities, published, slopes, 1e-3, wrong=True)
    return found, loss, LOTKA_VOLTERRA


# PETSc


def van_der_pol(u, mu):
    """Return the rate of van der Pol's oscillator, in the form of PETSc."""
    return np.array([u[1], mu * ((1 - u[0] ** 2) * u[1] - u[0])])


def slow_start(mu):
    """Return a start near the slow curve of van der Pol's oscillator."""
    return np.array([2.0, -2 / 3 + 10 / (81 * mu) - 292 / (2187 * mu**2)])


def van_der_pol_adjoint(published, steps):
    """Adjoint of van der Pol's oscillator by the trapezoidal rule, mu = 1e5, as ex20adj."""
    step = dp.stepper("crank_nicolson", van_der_pol, 0.001)
    last = lambda u, mu: dp.rollout(step, u, mu, steps)
    mu = 1e5
    _, pullback = dp.vjp(last, slow_start(mu), mu)
    _, start_pullback = dp.vjp(slow_start, mu)
    pairs = [pullback(unit) for unit in np.eye(2)]
    found = []
    for name, text, (in_start, in_mu) in zip("yz", published, pairs, strict=True):
        quantities = f"d{name}/dy0, d{name}/dz0, d{name}/dmu"
        found += numbers(quantities, text, [*in_start, in_mu + start_pullback(in_start)])
    return found, lambda mu: last(slow_start(mu), mu)[1], mu


def van_der_pol_500():
    """500 steps: ex20adj, test 1."""
    return van_der_pol_adjoint(("1.54557 4.80704e-06 -2.13118e-11", "2.28429 0.000244399 -1.29769e-10"), 500)


def van_der_pol_15():
    """15 steps: ex20adj, test 2."""
    return van_der_pol_adjoint(("1.00844 5.74982e-06 -1.89784e-13", "1.03128 -0.828692 -1.29657e-11"), 15)


def van_der_pol_forward():
    """Sensitivities of van der Pol's oscillator, mu = 1e6, as ex20fwd: sixteen published digits."""
    step = dp.stepper("crank_nicolson", van_der_pol, 1 / 1024, rtol=1e-13)
    last = lambda z: dp.rollout(step, z[:2], z[2], 512)
    z = np.array([2.0, -0.66666654321, 1e6])
    state, pullback = dp.vjp(last, z)
    found = numbers("y, z", "1.59677 -1.03039", state)
    published = "1.5455887737005489e+00 8.2964526164656577e-08 -2.1313140253978350e-13 "
    published += "1.8662857233939536e+00 7.5288629604219237e-01 -1.2048891982961686e-12"
    quantities = "dy/dy0, dy/dz0, dy/dmu, dz/dy0, dz/dz0, dz/dmu"
    found += numbers(quantities, published, [pullback(unit) for unit in np.eye(2)], 1e-7)
    return found, lambda q: last(z * q)[1], np.ones(3)


def bogacki_shampine(dt):
    """Return a step of third order: PETSc's default explicit method."""

    def step(u, mu):
        first = van_der_pol(u, mu)
        second = van_der_pol(u + dt / 2 * first, mu)
        third = van_der_pol(u + 3 * dt / 4 * second, mu)
        return u + dt / 9 * (2 * first + 3 * second + 4 * third)

    return step


def fit_mu(step, mu, dt, published, bound):
    """Objective, gradient and optimum of the fit of mu: ex20opt_p."""
    last = lambda mu: dp.rollout(step, slow_start(mu), mu, round(0.5 / dt))
    wanted = last(mu)
    loss = lambda mu: np.sum((last(mu) - wanted) ** 2)
    value, slope = dp.value_and_grad(loss)(1.2)
    best = dp.minimize(lambda mu: last(mu) - wanted, 1.2, "gauss_newton", tolerance=1e-8).x
    *first, optimum = published.split()
    found = numbers("objective, norm of the gradient", " ".join(first), [value, abs(slope)])
    return found + numbers("mu found", optimum, [best], bound), loss, 1.2


def fit_mu_coarse():
    """Bogacki-Shampine, mu = 10, dt = 0.1: ex20opt_p, test 1."""
    return fit_mu(bogacki_shampine(0.1), 10.0, 0.1, "0.0305641 0.0140536 9.99998", 3e-6)


def fit_mu_fine():
    """Bogacki-Shampine, mu = 10, dt = 0.01: ex20opt_p, test 2."""
    return fit_mu(bogacki_shampine(0.01), 10.0, 0.01, "0.0310898 0.0141971 10.", 1e-6)


def fit_mu_stiff():
    """The trapezoidal rule, mu = 100: ex20opt_p, tests 3 and 4; test 3 stops early, where the gradient is 8e-9."""
    step = dp.stepper("crank_nicolson", van_der_pol, 0.01)
    found, loss, mu = fit_mu(step, 100.0, 0.01, "0.0636039 0.0203472 99.99", 2e-4)
    return found + numbers("mu found in test 3", "99.7009", [found[-1].ours], 4e-3), loss, mu


def fit_start(method, mu, dt, published):
    """Objective and norm of the gradient of the fit of the start: ex20opt_ic."""
    step = dp.stepper(method, van_der_pol, dt)
    last = lambda u: dp.rollout(step, u, mu, round(0.5 / dt))
    wanted = last(slow_start(mu))
    loss = lambda u: np.sum((last(u) - wanted) ** 2)
    start = np.array([2.2, -0.7])
    value, slopes = dp.value_and_grad(loss)(start)
    pair = [value, np.linalg.norm(slopes)]
    return numbers("objective, norm of the gradient", published, pair), loss, start


def fit_start_1000():
    """The trapezoidal rule, mu = 1000: ex20opt_ic, test 1."""
    return fit_start("crank_nicolson", 1e3, 0.03125, "0.112365 0.988583")


def fit_start_euler():
    """Backward Euler, mu = 100: ex20opt_ic, test 2."""
    return fit_start("backward_euler", 1e2, 0.01, "0.155766 1.23421")


def fit_start_100():
    """The trapezoidal rule, mu = 100: ex20opt_ic, test 3."""
    return fit_start("crank_nicolson", 1e2, 0.01, "0.153666 1.22223")


# SciML


def bouncing_ball():
    """The coefficient of restitution of a ball that is at a height of 20 after 15 seconds."""
    ground = lambda u, p, t: u[0]
    ground.direction = -1
    bounce = lambda u, p, t: np.array([0.0, -p * u[1]])
    fall = lambda u, p, t: np.array([u[1], -9.8])
    step = dp.stepper("rk4", fall, 15.0, tolerance=1e-9, events=(ground, bounce))
    loss = lambda p: (step((np.array([50.0, 0.0]), 0.0), p)[0][0] - 20.0) ** 2
    best = dp.minimize(loss, 0.8, tolerance=1e-6).x
    return numbers("restitution", "0.866554105436901", [best], 1e-8), loss, 0.8


def lorenz(u, p):
    """Return the rate of Lorenz' equations."""
    return np.array([p[0] * (u[1] - u[0]), u[0] * (p[1] - u[2]) - u[1], u[0] * u[1] - p[2] * u[2]])


def shadowing(start, steps=2000, dt=0.01, dilation=10.0):
    """Return the derivative of the mean of z along a direction of the parameters, by least-squares shadowing.

    A trajectory near the given one, v in distance and with its time stretched by 1 + s, follows the equations with
    changed parameters: v' = J v + df/dp q + s f. Of all these the least |v|^2 + dilation^2 |s|^2 has no growing part
    (Wang, Hu, Blonigan, J. Comput. Phys. 267, 2014). The equations at the midpoints, B v - C s = df/dp q, give
    v = B^T w and s = -C^T w / dilation^2, where w solves a sparse system.
    """
    step = dp.jit(dp.stepper("rk4", lorenz, dt / 4))
    u = dp.rollout(step, np.array(start), LORENZ, 4 * steps, keep="all")[::4]
    middle = ((u[1:] + u[:-1]) / 2).T
    column = lambda k: dp.jvp(lambda u: lorenz(u, LORENZ), middle, np.eye(3)[k, :, None] * np.ones(steps))[1]
    jacobians = np.array([column(k) for k in range(3)]).T
    in_p = np.array([dp.jvp(lambda p: lorenz(middle, p), LORENZ, unit)[1].T.ravel() for unit in np.eye(3)])
    before, after = (sparse.kron(sparse.eye(steps, steps + 1, k), sparse.eye(3)) for k in (0, 1))
    J = sparse.block_diag(list(jacobians))
    B = dp.from_matrix(sparse.csr_matrix((after - before) / dt - J @ (before + after) / 2))
    C = dp.from_matrix(sparse.csr_matrix(sparse.block_diag([rate[:, None] for rate in (u[1:] - u[:-1]) / dt])))
    solve = dp.inverse(B @ B.T + C @ C.T / dilation**2)

    def slope(q):
        w = solve(np.dot(q, in_p))
        v = np.reshape(B.T(w), (steps + 1, 3))
        stretch = -C.T(w) / dilation**2
        return np.mean(v[:, 2]) + np.mean(stretch * (middle[2] - np.mean(middle[2])))

    return slope


def shadowing_30():
    """Least-squares shadowing of Lorenz' equations over 20 time units, as the test of ForwardLSS and AdjointLSS."""
    slope = shadowing([-2.259143724332269, -2.47457604992522, 18.939914218990612])
    rho = np.array([0.0, 1.0, 0.0])
    pair = [slope(rho), dp.grad(slope)(np.ones(3))[1]]
    return numbers("d<z>/drho forward, d<z>/drho adjoint", "1 1", pair, 0.05), slope, np.ones(3)


def shadowing_100():
    """The same from the start of the test of NILSS."""
    slope = shadowing([-12.038017474165937, -16.65487590141079, 25.677002089734806])
    return numbers("d<z>/drho adjoint", "1", [dp.grad(slope)(np.ones(3))[1]], 0.05), slope, np.ones(3)


CASES = {
    "Robertson to 50": robertson_50,
    "Robertson to 4e7": robertson_4e7,
    "Robertson to 4e10": robertson_4e10,
    "Robertson, forward": robertson_forward,
    "Robertson, Hessian": robertson_hessian,
    "Hessian": hessian,
    "Lotka-Volterra": lotka_volterra,
    "van der Pol, 500 steps": van_der_pol_500,
    "van der Pol, 15 steps": van_der_pol_15,
    "van der Pol, forward": van_der_pol_forward,
    "van der Pol, fit of mu, dt 0.1": fit_mu_coarse,
    "van der Pol, fit of mu, dt 0.01": fit_mu_fine,
    "van der Pol, fit of mu, stiff": fit_mu_stiff,
    "van der Pol, fit of the start, mu 1000": fit_start_1000,
    "van der Pol, fit of the start, Euler": fit_start_euler,
    "van der Pol, fit of the start, mu 100": fit_start_100,
    "bouncing ball": bouncing_ball,
    "shadowing from 30": shadowing_30,
    "shadowing from 100": shadowing_100,
}


def row(name, verdict=True):
    """Return (numbers, seconds, verdict) of a case."""
    clock = process_time()
    found, loss, point = CASES[name]()
    seconds = process_time() - clock
    return found, seconds, dp.check.gradient(loss, point, quick=True).verdict if verdict else ""


HEAD = f"{'case':40} {'quantity':24} {'published':>23} {'ours':>23} {'difference':>10} {'bound':>8}    seconds verdict"


def lines(name, verdict=True):
    """Yield one line of text for each number of a case; the first one has the seconds and the verdict."""
    found, seconds, word = row(name, verdict)
    tail = f"{seconds:10.2f} {word}"
    for one in found:
        digits = max(6, len(one.published.lower().partition("e")[0].strip("-").replace(".", "")))
        ours = f"{one.ours:.{digits - 1}e}"
        mark = ("!" if one.wrong else " ") if one.holds else "FAILS"
        cells = f"{one.published:>23} {ours:>23} {one.difference:10.1e} {one.bound:8.1e} {mark}"
        yield f"{name:40} {one.quantity:24} {cells}{tail}"
        name = tail = ""


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="parts of names of cases; default: all cases")
    parser.add_argument("--quick", action="store_true", help="without the verdicts")
    given = parser.parse_args()
    print(HEAD)
    for name in CASES:
        if not given.names or any(part in name for part in given.names):
            for line in lines(name, not given.quick):
                print(line.rstrip(), flush=True)
