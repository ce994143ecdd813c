"""stress: evaluate a loss for stiff and extreme values of its parameters, and grade each case."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sparsedp._utils.validation import check_choice, check_function
from sparsedp.autodiff.derivative import unwarned
from sparsedp.check.summary import Result
from sparsedp.check.table import Table, table_of
from sparsedp.report import plots
from sparsedp.report.stability import stability_map
from sparsedp.report.stress_cases import FAILED, GROUPS, WORDS, Scene, cases

__all__ = ["Stress", "stress"]

COLUMNS = ("group", "parameter", "case", "outcome", "figure", "note")
NEVER_RUN = (
    "isolated regions, solid cells, 1 cell, prime sizes, anisotropic cells: a loss keeps its grid; stress each",
    "10^4 steps: a loss keeps its number of steps",
)
WITH_MAP = "time step and viscosity"


def stress(
    loss: Callable[[Any], Any],
    x: Any,
    ranges: Any = None,
    step: Callable[[Any], Any] | None = None,
    time_step: str | None = None,
    viscosity: str | None = None,
    only: Sequence[str] | None = None,
) -> Stress:
    """Evaluate a loss and its gradient for stiff and extreme values of its parameters, and grade each case.

    The grades are "passed", "refused correctly", "degraded" and "FAILED"; see Notes.

    Parameters
    ----------
    loss : callable
        ``loss(x) -> real scalar``.
    x : array, number, or any nesting of them in tuples, lists and dicts
        The parameters. Entries of a dict are named by their keys. `x` is not modified.
    ranges : dict, optional
        Legal range (low, high) of each parameter, by name. If `x` is a single array or number: its range (low, high).
    step : callable, optional
        ``step(x)`` returns (advance, state): the function that advances a state by one time step, and an initial
        state. Their growth factor is measured. Default: the time step of the first rollout in the loss.
    time_step, viscosity : str, optional
        Names of the parameters that are the time step and the viscosity. Default: a parameter called dt, time_step or
        tau; and one called nu, viscosity, diffusivity, kappa or mu.
    only : sequence of str, optional
        Groups of cases to run: "as given", "scaling", "legal range", "zeros and signs", "jumps", "constant added",
        "not finite", "kinds of arrays", "time step and viscosity". Default: all groups.

    Returns
    -------
    Stress
        It has the attributes `.rows`, `.counts`, `.failures`, `.skipped` and `.map` (the stability map over time step
        and viscosity, or None), and the methods `.to_dict()`, `.markdown()`, `.csv()` and `.plot(ax)`. str() returns
        the table. bool(result) is True if no case FAILED.

    Raises
    ------
    ValueError
        If a name is unknown, or a range is not two finite numbers.
    DerivativeError
        If `x` has no floating leaf.

    See Also
    --------
    check.gradient

    Notes
    -----
    **passed**: value and gradient are finite, and the gradient agrees with finite differences to 1e-5. The directions
    are a random direction in each leaf (one in all leaves together if there are more than eight leaves) and the
    gradient itself. At `x` itself, and if a direction does not agree, the gradient is examined as by `check.gradient`,
    with its detection limits. Cases that must not change the result pass if value and gradient have the same bits as at
    `x`.

    **refused correctly**: the loss raises an exception of this library, ValueError or TypeError.

    **degraded**: the result is finite, but differs from the expected one; the figure is the difference. Also: values
    overflow outside the given ranges, or an exception of another type is raised.

    **FAILED**: at `x` or within the given ranges, value or gradient is not finite and no exception is raised; the
    gradient differs from finite differences; a parameter is NaN, but the result is finite; the result changes by more
    than 1e-5 if `x` changes by rounding; or a time step is unstable although the physics is not (the fastest growing
    mode changes its sign from step to step, or there is no such growth with a smaller step).

    Examples
    --------
    >>> import autograd.numpy as np
    >>> from sparsedp import Grid, laplacian, rollout
    >>> L = laplacian(Grid(16))
    >>> def heat(p):
    ...     return np.sum(rollout(lambda u, p: u + p["dt"] * L(u), np.eye(16)[3], p, 20) ** 2)
    >>> stress(heat, {"dt": 0.4}, only=["as given"]).counts["FAILED"]
    0
    >>> stress(heat, {"dt": 0.6}, only=["as given"]).failures[0]["note"]
    'grows and changes its sign from step to step: the step is too large'
    """
    check_function("stress", loss, "lambda x: np.sum(x**2)")
    for group in only or ():
        check_choice("a group of stress cases", group, GROUPS)
    chosen = [name for name in GROUPS if only is None or name in only]
    rows = []
    growth_map = None
    with np.errstate(all="ignore"), unwarned(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the row of a case shows its result
        scene = Scene(loss, x, ranges, step, time_step, viscosity)
        for group, parameter, case, grade in cases(scene, chosen):
            rows.append(dict(zip(COLUMNS, (group, parameter, case, *grade()))))
        if WITH_MAP in chosen:
            growth_map = stability_map(scene)
    skipped = _skipped_groups(rows, chosen)
    if scene.growth is None:
        skipped.append("growth in one step: no rollout in the loss; give step=lambda x: (advance, state)")
    counts = {word: sum(row["outcome"] == word for row in rows) for word in WORDS}
    return Stress(
        rows=rows,
        counts=counts,
        failures=[row for row in rows if row["outcome"] == FAILED],
        map=growth_map,
        verdict="disagrees" if counts[FAILED] else "agrees",
        skipped=[*skipped, *NEVER_RUN],
        summary=f"stress: {', '.join(f'{count} {word}' for word, count in counts.items())}",
    )


def _skipped_groups(rows: list[dict[str, Any]], chosen: list[str]) -> list[str]:
    """Return a sentence about each group in which no case was run."""
    groups_with_rows = {row["group"] for row in rows}
    sentences = []
    for name, group in GROUPS.items():
        if name not in groups_with_rows:
            sentences.append(f"{name}: {group.reason if name in chosen else 'not asked for'}")
    return sentences


def _failure(row: dict[str, Any]) -> str:
    """Return a row that FAILED as one line with parameter, case and note."""
    case = " ".join(filter(None, (row["parameter"], row["case"])))
    return ": ".join(filter(None, (FAILED, case, row["note"])))


class Stress(Result):
    """The result of `stress`.

    Attributes
    ----------
    rows : list of dict
        One dict for each case: group, parameter, case, outcome, figure (a relative difference or a growth factor) and
        note.
    counts : dict
        Number of rows by outcome.
    failures : list of dict
        The rows that FAILED.
    verdict : "disagrees" if a case FAILED, else "agrees"
    summary : str
        The counts in one line.
    skipped : list of str
        Sentences about cases that were not run, with the reasons.
    map : StabilityMap or None
        Growth factors over time step and viscosity.
    """

    _plain = ("counts", "rows", "skipped", "map")

    def parts(self) -> list[str | Table]:
        """Return the table of cases, the skipped cases, the stability map, the failures, and the counts."""
        if self.map:
            growth = self.map.parts()
        else:
            growth = []
        failures = [_failure(row) for row in self.failures]
        return ["stress", table_of(self.rows, COLUMNS), *self.omissions(), *growth, *failures, self.summary]

    def plot(self, ax: Any = None) -> Any:
        """Plot the stability map: the growth factor of a time step over viscosity and time step.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Default: the current axes of pyplot.

        Returns
        -------
        matplotlib Axes

        Raises
        ------
        ValueError
            If there is no stability map.
        """
        if self.map is None:
            raise ValueError("this scene has no stability map; it needs a rollout, a time step and a viscosity by name")
        return plots.stability_chart(self.map, plots.current(ax))
