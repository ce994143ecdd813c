"""Stiff kinetics and what each rate changes. Run: python examples/stiff_chemistry.py [end time] [--out FOLDER]"""

import sys
from pathlib import Path
from time import perf_counter

import autograd.numpy as np

import sparsedp as dp
from sparsedp.derivative import pushforward

words = sys.argv[1:]
end = float(words[0]) if words and words[0] != "--out" else 50.0  # s
RATES = np.array([0.04, 1e4, 3e7])
KNOWN = 10.948648481, np.array([1.734140891e2, -5.059191406e-4, 8.432346465e-8])  # G and dG/dp for the end at 50 s


def robertson(u, p):
    """A -> B, B + C -> A + C, 2 B -> B + C (Robertson 1966), and the integral of C."""
    slow, back, fast = p[0] * u[0], p[1] * u[1] * u[2], p[2] * u[1] ** 2
    return np.array([back - slow, slow - back - fast, fast, u[2]])


start = np.array([1.0, 0.0, 0.0, 0.0])
print(f"G = integral of C over {end:g} s, and its derivative in the logarithm of each rate\n")
print("tolerance  steps          G  dG/dlog p1  dG/dlog p2  dG/dlog p3  error of G    of dG/dp  seconds")
for tolerance in (1e-3, 1e-4, 1e-5):
    step = dp.stepper("radau", robertson, end, tolerance=tolerance)
    clock = perf_counter()
    value, g = dp.value_and_grad(lambda p: step(start, p)[3])(RATES)  # the adjoint follows the steps taken
    seconds = perf_counter() - clock
    errors = (value / KNOWN[0] - 1, g / KNOWN[1] - 1) if end == 50.0 else (np.nan, np.nan)
    figures = "  ".join(f"{share:10.4f}" for share in g * RATES)
    figures += "".join(f"  {np.max(np.abs(error)):10.1e}" for error in errors)
    print(f"{tolerance:9.0e} {len(step.taken):6} {value:10.6f}  {figures} {seconds:8.1f}")

small = dict(tolerance=1e-4, floor=1e-6)  # B is 4e-5: its errors have to be less
explicit, implicit = (dp.stepper(method, robertson, end / 50, **small) for method in ("rk4", "radau"))
explicit(start, RATES), implicit(start, RATES)
print(f"\nThe first {end / 50:g} s: rk4 takes {len(explicit.taken)} steps, radau {len(implicit.taken)}.")

times = end * np.logspace(-3, 0, 10)
reach = dp.stepper("radau", lambda u, p: robertson(u, p[0]), lambda p: p[1], tolerance=1e-3)
run = lambda logs: dp.rollout(reach, start, RATES * np.exp(logs), 10, inputs=np.diff(times, prepend=0.0), keep="all")
moves = [pushforward(run, np.zeros(3), direction) for direction in np.eye(3)]  # forward mode, once for each rate
states, slopes = moves[0][0], [move[1:, 2] for _, move in moves]
print(f"C at the end: {states[-1, 2]:.4f}; in log p1, p2, p3: {' '.join(f'{slope[-1]:.4f}' for slope in slopes)}")
if "--out" in words:
    from matplotlib.figure import Figure

    picture = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = picture.subplots(1, 2)
    left.semilogx(times, states[1:, :3] * [1, 1e4, 1], ".-", label=["A", "10000 B", "C"])
    right.semilogx(times, np.array(slopes).T, ".-", label=["p1", "p2", "p3"])
    for ax, title in ((left, "concentrations"), (right, "derivative of C in the logarithm of a rate")):
        ax.set(xlabel="time [s]", title=title)
        ax.legend(frameon=False)
    Path(words[-1]).mkdir(exist_ok=True)
    picture.savefig(Path(words[-1]) / "stiff_chemistry.png", dpi=150)
