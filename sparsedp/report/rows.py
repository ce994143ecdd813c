"""Rows of error against run time: as a table, a CSV file that can be continued, and a picture."""

import csv
import io
import json
import math
from functools import partial
from pathlib import Path

from sparsedp.check.findings import table
from sparsedp.files import write_file
from sparsedp.report.pareto import unbeaten

__all__ = ["COLUMNS", "Rows", "cell", "csv_text", "kept_rows", "settings_of", "write_row"]

COLUMNS = (
    "scene", "method", "unknowns", "steps", "tolerance", "forward_error", "gradient_error", "seconds_setup",
    "seconds_forward", "seconds_backward", "peak_bytes", "solves_forward", "solves_adjoint", "iterations", "status",
    "seed", "versions", "settings", "reference_error", "seconds_forward_median", "seconds_forward_max",
    "seconds_backward_median", "seconds_backward_max",
)  # fmt: skip
TEXTS = ("scene", "method", "status", "seed", "versions", "settings")
SHOWN = (
    "method", "unknowns", "steps", "tolerance", "forward_error", "gradient_error", "seconds_setup", "seconds_forward",
    "seconds_backward", "peak_bytes", "solves_forward", "solves_adjoint", "iterations", "status",
)  # fmt: skip


class Rows:
    """Error against run time. Made by `workprec`.

    Attributes
    ----------
    scene : str
    rows : list of dict
        Keys are COLUMNS; NaN where a figure does not exist.
    left_out : list of str
        Runs that were not made, with the reason.
    """

    def __init__(self, scene, rows, left_out):
        self.scene, self.rows, self.left_out = scene, rows, left_out

    @property
    def stem(self):
        """What the files of `save` are called."""
        return self.scene.replace("/", "-")

    def seconds(self, row, error="gradient_error"):
        """The run time that belongs to an error: of the value, or of value and gradient."""
        return row["seconds_forward"] + (row["seconds_backward"] if error == "gradient_error" else 0.0)

    def pareto(self, error="gradient_error"):
        """Rows that no other row beats in both time and error, the fastest first."""
        usable = [row for row in self.rows if row["status"] == "ok" and self._known(row, error)]
        return unbeaten(usable, lambda row: (self.seconds(row, error), row[error]))

    def _known(self, row, error):
        return math.isfinite(row[error]) and math.isfinite(self.seconds(row, error))

    def best(self, error, which="gradient_error"):
        """The fastest row whose error is at most `error`, or None."""
        return next((row for row in self.pareto(which) if row[which] <= error), None)

    def markdown(self):
        """The table in Markdown, with what was left out; a star marks the Pareto set of the gradient."""
        stars = [id(row) for row in [*self.pareto(), *self.pareto("forward_error")]]
        used, cells_of = self._shown()
        lines = [f"| {' | '.join(used)} | best |", f"|{'---|' * (len(used) + 1)}"]
        for row, cells in zip(self.rows, cells_of, strict=True):
            lines.append(f"| {' | '.join(map(cell, cells))} | {'*' if id(row) in stars else ''} |")
        lines += ["", "A star: no other row is both faster and more exact (the Pareto set, in gradient or value)."]
        errors = [row["reference_error"] for row in self.rows if not _empty(row["reference_error"])]
        stated = [f"\nError of the reference: {max(errors):.1e}."] if errors else []
        left = [f"- left out: {sentence}" for sentence in self.left_out]
        return "\n".join([f"### {self.scene}", "", *lines, *stated, *([""] if left else []), *left]) + "\n"

    def _shown(self):
        """Names of the columns for readers, settings that tell the rows of a method apart among them; their texts."""
        settings = [json.loads(row["settings"]) for row in self.rows]
        seen: dict = {}
        for row, own in zip(self.rows, settings, strict=True):
            for name, value in own.items():
                seen.setdefault((name, row["method"]), set()).add(str(value))
        told = dict.fromkeys(name for (name, _), values in seen.items() if len(values) > 1 and name not in SHOWN)
        used = [name for name in SHOWN if any(not _empty(row[name]) for row in self.rows)]
        lines = [
            [row["method"], *(str(own.get(name, "")) for name in told), *(_text(row[name]) for name in used[1:])]
            for row, own in zip(self.rows, settings, strict=True)
        ]
        return (*used[:1], *told, *used[1:]), lines

    def csv(self):
        """All columns as CSV."""
        return csv_text(self.rows, COLUMNS)

    def plot(self, ax=None, error="gradient_error"):
        """Log-log picture: run time across, error up, one curve for each method, the Pareto set marked.

        Parameters
        ----------
        ax : matplotlib Axes, optional
        error : "gradient_error" or "forward_error"

        Returns
        -------
        matplotlib Axes
        """
        from sparsedp.report import charts, plots

        lines: dict = {}
        for row in self.rows:
            if row["status"] == "ok" and self._known(row, error) and row[error] > 0:
                lines.setdefault(row["method"], []).append((self.seconds(row, error), row[error]))
        ax = plots.figure().add_subplot() if ax is None else ax
        curves = {name: tuple(zip(*sorted(points), strict=True)) for name, points in lines.items()}
        if curves:
            charts.curves(curves, ax, "run time [s]", error.replace("_", " "))
        ax.set_title(self.scene)
        return ax

    def save(self, folder):
        """Write scene.md, scene.csv and, where matplotlib is installed, scene.png into a folder -> list of paths.

        A scene may have a name that is no name of a file: "/" becomes "-". A file that cannot be written is an
        OSError.
        """
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        paths = [folder / f"{self.stem}.{kind}" for kind in ("md", "csv")]
        for path, text in zip(paths, (self.markdown(), self.csv()), strict=True):
            write_file(path, text)
        try:
            from sparsedp.report import plots

            gradient = any(not _empty(row["gradient_error"]) for row in self.rows)
            ax = self.plot(plots.figure().add_subplot(), "gradient_error" if gradient else "forward_error")
            write_file(folder / f"{self.stem}.png", partial(plots.save, ax.figure))
        except ImportError:
            return paths
        return [*paths, folder / f"{self.stem}.png"]

    def __str__(self):
        used, lines = self._shown()
        left = [f"  left out: {sentence}" for sentence in self.left_out]
        return "\n".join([f"{self.scene}: error against run time", table(lines, used), *left])

    __repr__ = __str__


def settings_of(row):
    """The settings of a row in words."""
    return ", ".join(f"{name}={value}" for name, value in json.loads(row["settings"]).items()) or "no settings"


def csv_text(rows, columns):
    """Rows (dicts) -> CSV with a line of names."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


def cell(text):
    """A text as it may stand in a table of Markdown."""
    return " ".join(text.split()).replace("|", "\\|")


def _empty(value):
    return isinstance(value, float) and math.isnan(value)


def _text(value):
    if isinstance(value, str):
        return value
    return "" if _empty(value) else f"{value:.2g}" if isinstance(value, float) else str(value)


# ------------------------------------------------------------ a file that can be continued


def write_row(file, row):
    """Add a finished row to a CSV file."""
    path = Path(file)
    before = path.read_bytes() if path.exists() else b""
    torn = b"" if before.endswith(b"\n") or not before else b"\n"  # somebody cut its last line off
    header, line = csv_text([row], COLUMNS).encode().split(b"\n", 1)
    write_file(path, before + torn + line if before else header + b"\n" + line)


def kept_rows(file, versions):
    """CSV file -> (finished rows of these versions by key, what is left out)."""
    path = Path(file)
    if not path.exists() or not path.stat().st_size:
        return {}, []
    with path.open(encoding="utf-8", newline="") as stream:
        reader = csv.DictReader(stream)
        if tuple(reader.fieldnames or ()) != COLUMNS:
            raise ValueError(f"{path.name} is no table of workprec; give another file name")
        rows = [row for row in reader if row["versions"] and row["seconds_backward_max"] is not None]
    same = [_typed(row) for row in rows if row["versions"] == versions]
    other = len(rows) - len(same)
    left = [f"{other} rows of {path.name} from other versions: run again"] if other else []
    return {tuple(row[name] for name in ("scene", "method", "settings", "seed")): row for row in same}, left


def _typed(row):
    return {name: text if name in TEXTS else _number(text) for name, text in row.items()}


def _number(text):
    value = float(text or "nan")
    return int(value) if value.is_integer() and "." not in text and "e" not in text else value
