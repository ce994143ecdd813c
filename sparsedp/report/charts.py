"""Charts of checks and measurements."""

import numpy as np

from sparsedp.report.pareto import unbeaten
from sparsedp.report.plots import axes_or_current

__all__ = ["convergence", "curves", "stability", "v_curve"]


def curves(lines, ax, x_label, y_label):
    """Named curves -> one log-log picture; the best points reached at any time are marked.

    Parameters
    ----------
    lines : dict
        Name -> (x, y), two sequences of positive numbers.
    ax : matplotlib Axes
    x_label, y_label : str
    """
    best = unbeaten([point for x, y in lines.values() for point in zip(x, y, strict=True)])
    ax.plot(*zip(*best, strict=True), color="0.8", linewidth=6, solid_capstyle="round", label="best so far")
    for name, (x, y) in lines.items():
        ax.plot(x, y, marker=".", markersize=4, linewidth=1, label=name)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel(x_label)
    ax.set_ylabel(y_label)
    ax.grid(visible=True, which="both", color="0.93")
    ax.legend(frameon=False)


def convergence(best, ax=None, against="iteration"):
    """Result of `minimise` -> picture of the loss and the gradient norm over iterations, seconds or solves.

    Parameters
    ----------
    best : Minimum
        From `minimise`.
    ax : matplotlib Axes, optional
        Default: the current axes of pyplot.
    against : "iteration", "seconds", "evaluations" or "solves"
        What runs across.

    Returns
    -------
    matplotlib Axes
        Logarithmic upwards; a loss that is not positive everywhere is drawn as its distance from the least one.

    Raises
    ------
    ValueError
        If `against` is another word.
    ImportError
        If matplotlib is not installed.

    Examples
    --------
    >>> import autograd.numpy as anp
    >>> import numpy as np
    >>> from sparsedp import minimise
    >>> from sparsedp.report.plots import figure
    >>> best = minimise(lambda x: anp.sum((x - 1.0) ** 4), np.zeros(2), maxiter=5)
    >>> convergence(best, figure().add_subplot()).get_xlabel()
    'iteration'
    """
    if against not in ("iteration", "seconds", "evaluations", "solves"):
        raise ValueError(f"convergence is drawn against iteration, seconds, evaluations or solves, got {against!r}")
    ax = axes_or_current(ax)
    across = [getattr(record, against) for record in best.history]
    values = np.array([record.value for record in best.history])
    label = "loss" if np.all(values > 0) else "loss - least loss"
    values = values if np.all(values > 0) else values - values.min()
    for name, heights in ((label, values), ("gradient norm", [record.gradient_norm for record in best.history])):
        # A height of 0 has no logarithm and leaves a gap.
        ax.plot(across, np.where(np.asarray(heights) > 0, heights, np.nan), marker=".", linewidth=1, label=name)
    ax.set_yscale("log")
    ax.set_xlabel(against)
    ax.set_title(f"{best.method}: {best.message.split(':')[0]}")
    ax.grid(visible=True, which="major", color="0.93")
    ax.legend(frameon=False)
    return ax


def v_curve(audit, ax=None):
    """Audit of a gradient -> picture of |difference - gradient| over the step, one curve for each direction.

    A right gradient gives a V: the error of the differences falls with the step until rounding lifts it. A
    wrong one gives a plateau.

    Parameters
    ----------
    audit : Audit
        From `check.gradient`.
    ax : matplotlib Axes, optional
        Default: the current axes of pyplot.

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    ImportError
        If matplotlib is not installed.

    Examples
    --------
    >>> import numpy as np
    >>> from sparsedp import check
    >>> from sparsedp.report.plots import figure
    >>> result = check.gradient(lambda u: np.sum(u**3), np.array([1.0, 2.0]), gradient=lambda u: 3 * u**2)
    >>> v_curve(result, figure().add_subplot()).get_xlabel()
    'step'
    """
    ax = axes_or_current(ax)
    for name in dict.fromkeys(row["direction"] for row in audit.rows):
        rows = [row for row in audit.rows if row["direction"] == name and not row["note"] and row["gap"]]
        ax.plot([row["step"] for row in rows], [abs(row["gap"]) for row in rows], marker=".", linewidth=1, label=name)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel("step")
    ax.set_ylabel("|difference - gradient| / |derivative|")
    ax.set_title(f"{audit.verdict}{f': {audit.culprit}' if audit.culprit else ''}")
    ax.grid(visible=True, which="major", color="0.93")
    ax.legend(frameon=False, fontsize="small")
    return ax


def stability(found, ax):
    """Stability map -> picture: growth factor over viscosity (across) and time step (up); refused steps are grey.

    Parameters
    ----------
    found : StabilityMap
    ax : matplotlib Axes

    Returns
    -------
    matplotlib Axes
    """
    ax.set_facecolor("0.75")
    values = np.ma.masked_invalid(np.clip(found.factors, 0.0, 2.0))
    image = ax.pcolormesh(
        found.viscosities, found.time_steps, values, vmin=0, vmax=2, cmap="coolwarm", shading="nearest"
    )
    ax.figure.colorbar(image, ax=ax, label="growth factor of a step (2 and more: red)")
    ax.plot(found.here[1], found.here[0], marker="*", color="black", markersize=12)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel(found.names[1])
    ax.set_ylabel(found.names[0])
    ax.set_title("stable: blue; grows: red; refused: grey")
    return ax
