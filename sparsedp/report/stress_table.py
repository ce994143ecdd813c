"""stress: a scene driven through stiff and extreme cases, one word for each."""

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
    """Run a scene through stiff and extreme cases: each has passed, was refused correctly, is degraded, or FAILED.

    Parameters
    ----------
    loss : callable
        ``loss(x) -> real scalar``.
    x : array, number, or any nesting of them in tuples, lists and dicts
        The parameters. Entries of a dict are called by their key. Never modified.
    ranges : dict, optional
        Name of a parameter -> (low, high), its legal range. A parameter that stands alone: (low, high).
    step : callable, optional
        ``step(x) -> (advance, state)``: one time step and where it starts, for the growth factor. Default: the
        first rollout in the loss.
    time_step, viscosity : str, optional
        Names of these parameters. Default: those called dt, time_step, tau; nu, viscosity, diffusivity, kappa, mu.
    only : sequence of str, optional
        Groups of cases to run: "as given", "scaling", "legal range", "zeros and signs", "jumps", "constant added",
        "not finite", "kinds of arrays", "time step and viscosity". Default: all that apply.

    Returns
    -------
    Stress
        `.rows`, `.counts`, `.failures`, `.skipped`, `.map` (time step against viscosity, or None), `.to_dict()`,
        `.markdown()`, `.csv()`, `.plot(ax)`; str() is the table; true when nothing FAILED.

    Raises
    ------
    ValueError
        If a name is unknown, or a range is not two finite numbers.
    DerivativeError
        If x has no floating leaf.

    See Also
    --------
    check.gradient

    Notes
    -----
    passed: finite, and the gradient agrees with differences to 1e-5 along a random direction in each leaf (in all
    together of more than eight) and along itself, or the bits are those of the plain case. At x itself, and where a
    direction does not agree, all evidence is gathered and weighed as by `check.gradient`, with its detection limits.
    refused correctly: a typed error. degraded: a finite answer with a gap, shown as the figure; numbers that
    overflow far outside any stated range; a foreign error. FAILED: within the scene's own values or stated ranges
    a number that is not finite, without an error; a gradient that differs from the differences; NaN in, finite
    out; an answer that changes by more than 1e-5 when x changes by rounding; a step that grows where the
    physics does not (its fastest mode flips its sign from step to step, or its growth falls with the step).

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
        warnings.simplefilter("ignore")  # the rows say what became of a case
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
    """Return sentences about the groups without a case."""
    groups_with_rows = {row["group"] for row in rows}
    sentences = []
    for name, group in GROUPS.items():
        if name not in groups_with_rows:
            sentences.append(f"{name}: {group.reason if name in chosen else 'not asked for'}")
    return sentences


def _failure(row: dict[str, Any]) -> str:
    """Return a row that FAILED as one line: parameter and case, and the note."""
    case = " ".join(filter(None, (row["parameter"], row["case"])))
    return ": ".join(filter(None, (FAILED, case, row["note"])))


class Stress(Result):
    """The result of `stress`.

    Attributes
    ----------
    rows : list of dict
        group, parameter, case, outcome, figure (a gap, relative, or a growth factor), note.
    counts : dict
        Number of rows by outcome.
    failures : list of dict
        The rows that FAILED.
    verdict : "disagrees" when something FAILED, else "agrees"
    summary : str
        One line.
    skipped : list of str
        Cases that do not apply, with the reason.
    map : StabilityMap or None
    """

    _plain = ("counts", "rows", "skipped", "map")

    def parts(self) -> list[str | Table]:
        """Return all cases, what was skipped, the map, the failures, and the counts."""
        if self.map:
            growth = self.map.parts()
        else:
            growth = []
        failures = [_failure(row) for row in self.failures]
        return ["stress", table_of(self.rows, COLUMNS), *self.omissions(), *growth, *failures, self.summary]

    def plot(self, ax: Any = None) -> Any:
        """Draw the stability map: growth factor of a step, time step against viscosity.

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
            If the scene has no stability map.
        """
        if self.map is None:
            raise ValueError("this scene has no stability map; it needs a rollout, a time step and a viscosity by name")
        return plots.stability_chart(self.map, plots.current(ax))
