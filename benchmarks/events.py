"""Errors of value, gradient and Hessian product beside the tolerance, across a break and an event.

Break: u' = 1 - u/2 until t = off, then -u/2, in off. Event: y' = -p y until v = p t is 0.5, then +p y, in p; the value
is exp(p - 1). Both have closed forms. Errors are relative. crank_nicolson, which does not extrapolate,
may refuse a derivative: such cells say so.

Run ``python -m benchmarks.events [--quick]`` in the root of the repository.
"""

import argparse

import autograd.numpy as anp
import numpy as np

import sparsedp as dp

METHODS = {  # the tolerances of each
    "heun": (1e-3, 1e-4),
    "ssprk3": (1e-3, 1e-5),
    "rk4": (1e-3, 1e-5),
    "euler": (1e-2, 1e-3),
    "backward_euler": (1e-2, 1e-3),
    "tr_bdf2": (1e-2, 1e-3),
    "crank_nicolson": (1e-2, 1e-3),
    "radau": (1e-4, 1e-6),
}


def heating(u, off, t):
    """A source that is switched off."""
    return anp.where(t < off, 1.0, 0.0) - 0.5 * u


def switching(u, p, t):
    """Decay until the second entry is 0.5, then growth."""
    return anp.array([anp.where(u[1] > 0.5, 1.0, -1.0) * p * u[0], p])


def scenes(method, tolerance):
    """(name, function of a number, the number, its exact value and two derivatives)."""
    heat = dp.stepper(method, heating, 2.0, tolerance=tolerance, breaks=lambda off: [off])
    switch = dp.stepper(method, switching, 1.0, tolerance=tolerance, events=lambda u, p: u[1] - 0.5)
    decay = np.exp(-0.51)
    grown = np.exp(-0.2)
    yield "break", lambda off: heat((np.zeros(1), 0.0), off)[0][0], 0.98, (2 * (decay - np.exp(-1.0)), decay, decay / 2)
    yield "event", lambda p: switch((np.array([1.0, 0.0]), 0.0), p)[0][0], 0.8, (grown, grown, grown)


def errors(loss, x, exact):
    """Relative errors of value, gradient and Hessian product; None where there is none."""
    found = []
    for act, wanted in zip([loss, dp.grad(loss), lambda x: dp.hvp(loss, x, 1.0)], exact, strict=True):
        try:
            found.append(abs(act(x) / wanted - 1))
        except dp.errors.DerivativeError:
            found.append(None)
    return found


def table(methods):
    """Rows (scene, method, tolerance, errors)."""
    for method, tolerances in methods.items():
        for tolerance in tolerances:
            for name, loss, x, exact in scenes(method, tolerance):
                yield name, method, tolerance, errors(loss, x, exact)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="the coarser tolerance of each method")
    quick = parser.parse_args().quick
    print(f"{'scene':8}{'method':16}{'tolerance':>10}{'value':>10}{'gradient':>10}{'Hessian':>10}")
    for name, method, tolerance, found in table({m: t[: 1 if quick else 2] for m, t in METHODS.items()}):
        cells = "".join(f"{'refused' if error is None else f'{error:.1e}':>10}" for error in found)
        print(f"{name:8}{method:16}{tolerance:10.0e}{cells}", flush=True)
