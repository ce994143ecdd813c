"""stress: a scene driven through stiff and extreme cases, one word for each."""

import math
from collections import Counter

from sparsedp.check.findings import table
from sparsedp.fields import check_function
from sparsedp.report.hardships import GROUPS, cases
from sparsedp.report.maps import stability_map
from sparsedp.report.rows import csv_text
from sparsedp.report.scene import Scene
from sparsedp.report.trial import DEGRADED, FAILED, PASSED, REFUSED

__all__ = ["Stress", "stress"]

COLUMNS = ("group", "parameter", "case", "outcome", "figure", "note")
REASONS = {
    "scaling": "every parameter is 0, or its range leaves no room",
    "legal range": "no ranges were given; write ranges={'name': (low, high)}",
    "zeros and signs": "outside the legal ranges",
    "jumps": "no array of positive numbers without a range (arrays with a range jump between its ends)",
    "constant added": "no array that is not 0",
    "not finite": "the loss depends on no parameter",
    "kinds of arrays": "no arrays",
    "time step and viscosity": "no parameter has such a name; write time_step='name', viscosity='name'",
}
ELSEWHERE = (
    "isolated regions, solid cells, 1 cell, prime sizes, anisotropic cells: a loss keeps its grid; stress each",
    "10^4 steps: a loss keeps its number of steps",
)


def stress(loss, x, ranges=None, step=None, time_step=None, viscosity=None, only=None):
    """Scene -> what happens to it in stiff and extreme cases: passed, refused correctly, degraded, FAILED.

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
        `.rows`, `.counts`, `.failures`, `.left_out`, `.map` (time step against viscosity, or None), `.to_dict()`,
        `.markdown()`, `.csv()`, `.plot(ax)`; str() is the table; true when nothing FAILED.

    Raises
    ------
    ValueError
        If a name is unknown, or a range is not two finite numbers.
    DerivativeError
        If x has no floating leaf.

    Notes
    -----
    passed: finite, and the gradient agrees with differences to 1e-5, or the bits are those of the plain case.
    refused correctly: a typed error. degraded: a finite answer with a gap, shown as the figure; numbers that
    overflow far outside any stated range; a foreign error. FAILED: within the scene's own values or stated ranges
    a number that is not finite, without an error; another gradient than that of the differences; NaN in, finite
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
    known = [make.__name__.strip("_").replace("_", " ") for make in GROUPS]
    for group in only or ():
        if group not in known:
            raise ValueError(f"stress has no cases {group!r}; write some of {', '.join(known)}")
    scene = Scene(loss, x, ranges, step, time_step, viscosity)
    rows, left_out = [], []
    for group, name, case, test in cases(scene):
        if only is None or group in only:
            word, figure, note = test()
            if word is None:
                left_out.append(f"{case}: {note}")
            else:
                rows.append(dict(zip(COLUMNS, (group, name, case, word, float(figure), note), strict=True)))
    ran = {row["group"] for row in rows}
    chosen = known if only is None else only
    left_out += [f"{group}: {REASONS[group]}" for group in chosen if group in REASONS and group not in ran]
    left_out += [f"{group}: not asked for" for group in known if group not in chosen]
    drawn = stability_map(scene) if only is None or "time step and viscosity" in only else None
    return Stress(rows, [*left_out, *ELSEWHERE], drawn)


class Stress:
    """The result of `stress`.

    Attributes
    ----------
    rows : list of dict
        group, parameter, case, outcome, figure (a gap, relative, or a growth factor), note.
    left_out : list of str
        Cases that do not apply, with the reason.
    map : StabilityMap or None
    """

    def __init__(self, rows, left_out, drawn):
        self.rows, self.left_out, self.map = rows, left_out, drawn

    @property
    def counts(self):
        """Number of rows by outcome."""
        found = Counter(row["outcome"] for row in self.rows)
        return {word: found[word] for word in (PASSED, REFUSED, DEGRADED, FAILED)}

    @property
    def failures(self):
        """The rows that FAILED."""
        return [row for row in self.rows if row["outcome"] == FAILED]

    def __bool__(self):
        return not self.failures

    def to_dict(self):
        """Everything as plain numbers, strings, lists and dicts."""
        drawn = None if self.map is None else self.map.to_dict()
        return {"counts": self.counts, "rows": [dict(r) for r in self.rows], "left_out": self.left_out, "map": drawn}

    def markdown(self):
        """The table in Markdown, the map and what was left out."""
        lines = [f"| {' | '.join(COLUMNS)} |", f"|{'---|' * len(COLUMNS)}"]
        lines += [f"| {' | '.join(cell.replace('|', '/') for cell in _cells(row))} |" for row in self.rows]
        drawn = [] if self.map is None else ["", "Growth factor of a step:", "", "```text", str(self.map), "```"]
        left = [f"- left out: {sentence}" for sentence in self.left_out]
        return "\n".join([self.summary, "", *lines, *drawn, "", *left]) + "\n"

    def csv(self):
        """The rows as CSV."""
        return csv_text(self.rows, COLUMNS)

    def plot(self, ax=None):
        """Stability map -> picture: growth factor of a step, time step against viscosity.

        Parameters
        ----------
        ax : matplotlib Axes, optional

        Returns
        -------
        matplotlib Axes

        Raises
        ------
        ValueError
            If the scene has no stability map.
        """
        from sparsedp.report import charts, plots

        if self.map is None:
            raise ValueError("this scene has no stability map; it needs a rollout, a time step and a viscosity by name")
        return charts.stability(self.map, plots.figure().add_subplot() if ax is None else ax)

    @property
    def summary(self):
        """One line."""
        return "stress: " + ", ".join(f"{many} {word}" for word, many in self.counts.items())

    def __str__(self):
        lines = [_cells(row, 70) for row in self.rows]
        drawn = [] if self.map is None else ["growth factor of a step:", str(self.map)]
        left = [f"  left out: {sentence}" for sentence in self.left_out]
        return "\n".join([table(lines, COLUMNS), *drawn, *left, self.summary])

    __repr__ = __str__


def _cells(row, most=None):
    figure = "" if math.isnan(row["figure"]) else f"{row['figure']:.2g}"
    note = row["note"] if most is None or len(row["note"]) <= most else row["note"][: most - 3] + "..."
    return row["group"], row["parameter"], row["case"], row["outcome"], figure, note
