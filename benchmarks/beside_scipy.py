"""Nonlinear implicit steps beside plain SciPy: Allen-Cahn, Burgers and chemical kinetics, value and gradient.

Fields: the same backward Euler steps by a Newton method of a few lines, with the exact Jacobian written out by hand
and ``splu`` for each Newton step; its adjoint solves with kept factors of the Jacobians at the ends of the steps.
Kinetics: ``solve_ivp`` (Radau and BDF, orders 5 and up to 5), its gradient by the sensitivity equations, which
double to quadruple the unknowns. Ours takes any rate, and order 2. Errors stand beside every time.
"""

from time import perf_counter

import autograd.numpy as anp
import numpy as np
import scipy.sparse as sp
from scipy.integrate import solve_ivp
from scipy.sparse.linalg import splu

import sparsedp as dp

__all__ = ["fields", "kinetics", "species", "stages"]

RATES = np.array([0.04, 1e4, 3e7])
EXACT = 10.948648481, np.array([1.734140891e2, -5.059191406e-4, 8.432346465e-8])  # integral of C to 50, derivative
START = np.array([1.0, 0.0, 0.0, 0.0])


# ------------------------------------------------------------ fields


def allen_cahn(n):
    """(rate, rate by hand, its Jacobian, its derivative in nu, start)."""
    grid = dp.Grid((n, n), size=1.0)
    op, matrix = dp.laplacian(grid), dp.laplacian(grid).matrix
    x, y = grid.centres()
    u = 0.4 * np.cos(np.pi * x) * np.cos(2 * np.pi * y) + 0.1
    return (
        lambda u, nu: nu * op(u) + u - u**3,
        lambda u, nu: nu * (matrix @ u) + u - u**3,
        lambda u, nu: nu * matrix + sp.diags_array(1 - 3 * u**2),
        lambda u: matrix @ u,
        u,
    )


def burgers(n):
    """The same for u' = nu lap u - div(u^2/2), central, periodic."""
    grid = dp.Grid((n, n), size=1.0, periodic=True)
    op, out, mean = dp.laplacian(grid), dp.divergence(grid), dp.average(grid)
    matrix, D, A = (part.matrix for part in (op, out, mean))
    x, y = grid.centres()
    u = np.sin(2 * np.pi * x) * np.cos(2 * np.pi * y) + 0.5
    return (
        lambda u, nu: nu * op(u) - out(0.5 * mean(u) ** 2),
        lambda u, nu: nu * (matrix @ u) - D @ (0.5 * (A @ u) ** 2),
        lambda u, nu: nu * matrix - D @ (sp.diags_array(A @ u) @ A),
        lambda u: matrix @ u,
        u,
    )


def by_hand(scene, nu, h, steps):
    """(sum of u^2/2 at the end, its derivative in nu, seconds forward, seconds of both)."""
    _, rate, jacobian, of_nu, start = scene
    clock, u, kept = perf_counter(), start.reshape(-1), []
    eye = sp.eye_array(u.size)
    for _ in range(steps):
        old = u
        for _ in range(20):
            F = u - old - h * rate(u, nu)
            factors = splu(sp.csc_array(eye - h * jacobian(u, nu)), permc_spec="MMD_AT_PLUS_A")
            if np.linalg.norm(F) <= 1e-13 * np.linalg.norm(u):
                break
            u = u - factors.solve(F)
        kept.append((u, factors))
    forward = perf_counter() - clock
    g, slope = u, 0.0
    for u, factors in reversed(kept):
        g = factors.solve(g, trans="T")
        slope += h * (g @ of_nu(u))
    return np.sum(kept[-1][0] ** 2) / 2, slope, forward, perf_counter() - clock


def ours(scene, method, nu, h, steps):
    step = dp.stepper(method, scene[0], h)
    run = lambda nu: dp.rollout(step, scene[4], nu, steps)
    run(nu)  # patterns and compiled kernels
    clock = perf_counter()
    run(nu)
    forward = perf_counter() - clock
    clock = perf_counter()
    value, slope = dp.value_and_grad(lambda nu: anp.sum(run(nu) ** 2) / 2)(nu)
    return value, slope, forward, perf_counter() - clock


def fields(sizes, steps=4):
    """Print backward Euler by hand and by `stepper`."""
    print("\nBackward Euler with Newton's method, 4 steps; by hand: exact Jacobian and splu for each Newton step")
    print(f"{'scene':12} {'size':>9} {'by hand s':>16} {'stepper s':>16} {'ratio':>12} {'value':>9} {'gradient':>9}")
    for name, make, nu, h in (("Allen-Cahn", allen_cahn, 0.01, 0.1), ("Burgers", burgers, 0.02, 0.02)):
        for n in sizes:
            scene = make(n)
            hand, mine = by_hand(scene, nu, h, steps), ours(scene, "backward_euler", nu, h, steps)
            apart = [abs(a / b - 1) for a, b in zip(mine[:2], hand[:2])]
            pairs = [f"{a:7.3f} {b:8.3f}" for a, b in (hand[2:], mine[2:])]
            ratio = f"{hand[2] / mine[2]:5.1f} {hand[3] / mine[3]:5.1f}"
            print(f"{name:12} {n:4} x {n:<4} {pairs[0]} {pairs[1]} {ratio:>12} {apart[0]:9.1e} {apart[1]:9.1e}")


# ------------------------------------------------------------ kinetics


def robertson(u, p):
    """A -> B, B + C -> A + C, 2 B -> B + C, and the integral of C."""
    slow, back, fast = p[0] * u[0], p[1] * u[1] * u[2], p[2] * u[1] ** 2
    return anp.array([back - slow, slow - back - fast, fast, u[2]])


def sensitivities(t, y):
    """The rate of u and of du/dp, written out by hand."""
    u, S, p = y[:4], y[4:].reshape(4, 3), RATES
    J = np.zeros((4, 4))
    J[:2, 0] = -p[0], p[0]
    J[:2, 1] = p[1] * u[2], -p[1] * u[2] - 2 * p[2] * u[1]
    J[:2, 2] = p[1] * u[1], -p[1] * u[1]
    J[2, 1], J[3, 2] = 2 * p[2] * u[1], 1.0
    of_p = np.array([[-u[0], u[1] * u[2], 0], [u[0], -u[1] * u[2], -(u[1] ** 2)], [0, 0, u[1] ** 2], [0, 0, 0]])
    return np.append(np.asarray(robertson(u, p)), (J @ S + of_p).reshape(-1))


def solved(method, rtol):
    """Error of G and of its gradient, steps, seconds of the value, seconds of both."""
    scale = rtol * np.array([1.0, 1e-4, 1.0, 1.0])
    clock = perf_counter()
    alone = solve_ivp(lambda t, y: robertson(y, RATES), (0, 50), START, method=method, rtol=rtol, atol=scale)
    middle = perf_counter()
    both = np.append(scale, np.outer(scale, 1 / RATES))
    found = solve_ivp(sensitivities, (0, 50), np.append(START, np.zeros(12)), method=method, rtol=rtol, atol=both)
    errors = alone.y[3, -1] / EXACT[0] - 1, np.max(np.abs(found.y[13:, -1] / EXACT[1] - 1))
    return abs(errors[0]), errors[1], len(alone.t), middle - clock, perf_counter() - middle


def stepped(method, tolerance):
    """The same by `stepper`."""
    step = dp.stepper(method, robertson, 50.0, tolerance=tolerance)
    clock = perf_counter()
    step(START, RATES)
    middle = perf_counter()
    value, g = dp.value_and_grad(lambda p: step(START, p)[3])(RATES)
    errors = abs(value / EXACT[0] - 1), np.max(np.abs(g / EXACT[1] - 1))
    return *errors, 2 * len(step.taken), middle - clock, perf_counter() - middle


def kinetics(quick):
    """Print Robertson's problem to t = 50: error against run time."""
    print("\nRobertson to t = 50, G = integral of C: errors of G and of dG/dp, seconds of G, seconds with dG/dp")
    print(f"{'method':24} {'steps':>6} {'of G':>9} {'of dG/dp':>9} {'value s':>9} {'with gradient s':>16}")
    tries = [(solved, "Radau", r) for r in (1e-3, 1e-5)] + [(solved, "BDF", r) for r in (1e-3, 1e-5)]
    tries += [(stepped, "tr_bdf2", r) for r in ((1e-3,) if quick else (1e-3, 1e-4, 1e-5))]
    for run, method, tolerance in tries:
        error, of_gradient, steps, value, both = run(method, tolerance)
        name = f"{method}, {tolerance:g}"
        print(f"{name:24} {steps:6} {error:9.1e} {of_gradient:9.1e} {value:9.3f} {both:16.3f}")


def ring(u, k):
    """20 species, each made from the one before: u_i' = k_(i-1) f(u_(i-1)) - k_i f(u_i), f(u) = u (1 + u)."""
    flow = k * u * (1.0 + u)
    return anp.concatenate([flow[-1:], flow[:-1]]) - flow


def species(quick):
    """Print the ring of 20 species to t = 10: the last one, and its derivative in all rates."""
    k = 10.0 ** np.random.default_rng(0).permutation(np.linspace(-1, 4, 20))
    start = np.full(20, 0.05)

    def plain(k, method, rtol):
        return solve_ivp(lambda t, u: ring(u, k), (0, 10), start, method=method, rtol=rtol, atol=1e-3 * rtol)

    def differences(method, rtol):
        """The value, and one more solve for each rate."""
        clock = perf_counter()
        found = plain(k, method, rtol)
        middle = perf_counter()
        h = np.sqrt(rtol) * k
        g = [(plain(k + h * e, method, rtol).y[-1, -1] - found.y[-1, -1]) / (h @ e) for e in np.eye(20)]
        return found.y[-1, -1], np.array(g), len(found.t), middle - clock, perf_counter() - clock

    def adjoint(method, tolerance):
        step = dp.stepper(method, ring, 10.0, tolerance=tolerance)
        step(start, k)  # the pattern
        clock = perf_counter()
        step(start, k)
        middle = perf_counter()
        value, g = dp.value_and_grad(lambda k: step(start, k)[-1])(k)
        return value, g, 2 * len(step.taken), middle - clock, perf_counter() - middle

    exact, of_exact, *_ = differences("Radau", 1e-9)
    print("\n20 species to t = 10, the last one and its derivative in the 20 rates (SciPy: by 20 more solves)")
    print(f"{'method':24} {'steps':>6} {'error':>9} {'gradient':>9} {'value s':>9} {'with gradient s':>16}")
    tries = [(differences, "Radau", 1e-4), (differences, "BDF", 1e-4), (differences, "BDF", 1e-6)]
    for run, method, tolerance in [*tries, *((adjoint, "tr_bdf2", r) for r in ((1e-3,) if quick else (1e-3, 1e-5)))]:
        value, g, steps, one, both = run(method, tolerance)
        apart = abs(value / exact - 1), np.linalg.norm(k * (g - of_exact)) / np.linalg.norm(k * of_exact)
        print(f"{f'{method}, {tolerance:g}':24} {steps:6} {apart[0]:9.1e} {apart[1]:9.1e} {one:9.3f} {both:16.3f}")


# ------------------------------------------------------------ explicit steps


def stages(cells=128, steps=200):
    """Print what a stage of rk4 costs beside the same formula written out in the loss."""
    op = dp.laplacian(dp.Grid(cells, size=1.0, periodic=True))
    u, h = np.sin(2 * np.pi * (np.arange(cells) + 0.5) / cells), 1e-5
    rate = lambda u, nu: nu * op(u) - u**3

    def written(u, nu):
        a = rate(u, nu)
        b = rate(u + 0.5 * h * a, nu)
        c = rate(u + 0.5 * h * b, nu)
        return u + h / 6 * a + h / 3 * b + h / 3 * c + h / 6 * rate(u + h * c, nu)

    print(f"\nrk4, {cells} cells, {steps} steps in a rollout, microseconds for each stage: value, value and gradient")
    tasks = {}
    for name, step in (("written out", written), ("stepper", dp.stepper("rk4", rate, h))):
        run = lambda nu, step=step: dp.rollout(step, u, nu, steps)
        tasks[name] = run, dp.value_and_grad(lambda nu, run=run: anp.sum(run(nu) ** 2))
    best = {name: [np.inf, np.inf] for name in tasks}
    for name in [*tasks] * 5:
        for place, task in enumerate(tasks[name]):
            clock = perf_counter()
            task(0.01)
            best[name][place] = min(best[name][place], (perf_counter() - clock) / (4 * steps) * 1e6)
    for name, figures in best.items():
        print(f"{name:12} {figures[0]:8.1f} {figures[1]:8.1f}")
