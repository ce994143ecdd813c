"""The report as one self-contained HTML page, which needs no other file and no network."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path

from sparsedp._utils.html import cell, curves, folded_list
from sparsedp.check.summary import Result

__all__ = ["page", "section"]

STYLE = """
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 0 auto; padding: 1rem; }
h1 { margin-bottom: 0; }
.verdict { border-left: 0.5rem solid; padding: 0.5rem 1rem; font-size: 1.2rem; }
.agrees { border-color: #009e73; } .disagrees { border-color: #d55e00; } .inconclusive { border-color: #e69f00; }
table { display: block; overflow-x: auto; width: max-content; max-width: 100%;
  background: linear-gradient(to left, Canvas 40%, transparent) right / 3rem 100% no-repeat local,
    linear-gradient(to left, #888a, transparent) right / 0.8rem 100% no-repeat scroll;
  border-collapse: collapse; margin: 1rem 0; font-size: 0.85rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.15rem 0.6rem; text-align: left; vertical-align: top; border-bottom: 1px solid #8884; }
td { min-width: 3rem; } td:not([nowrap]) { min-width: 11rem; }
td:last-child:not([nowrap]) { min-width: min(18rem, 75vw); }
:is(th, td):first-child { position: sticky; left: 0; background: Canvas; min-width: 0; }
th { cursor: pointer; white-space: nowrap; }
th[aria-sort=ascending]::after { content: " \\2191"; } th[aria-sort=descending]::after { content: " \\2193"; }
figure { margin: 1rem 0; } img, svg { max-width: 100%; height: auto; } img { background: white; width: 44rem; }
figcaption { font-size: 0.9rem; }
"""

# A click on the header of a column sorts the table by this column. Empty cells are sorted last.
SORTING = """
for (const table of document.querySelectorAll("table")) {
  table.querySelectorAll("th").forEach((head, column) => {
    head.tabIndex = 0;
    const sort = () => {
      const up = head.ariaSort !== "ascending";
      const key = row => row.cells[column].textContent.trim();
      const order = (a, b) => {
        if (!a || !b) return !a - !b;
        const numbers = !isNaN(a) && !isNaN(b);
        return (up ? 1 : -1) * (numbers ? a - b : a.localeCompare(b));
      };
      const rows = [...table.tBodies[0].rows].sort((one, other) => order(key(one), key(other)));
      table.tBodies[0].append(...rows);
      table.querySelectorAll("th").forEach(other => other.removeAttribute("aria-sort"));
      head.ariaSort = up ? "ascending" : "descending";
    };
    head.addEventListener("click", sort);
    head.addEventListener("keydown", event => { if (event.key === "Enter") sort(); });
  });
}
"""


def section(title: str, result: Result, files: Sequence[Path], caption: str) -> str:
    """Return a result as HTML with a caption and a picture: the PNG among its files, or else a simple SVG."""
    picture = ""
    for path in files:
        if path.suffix == ".png":
            data = base64.b64encode(path.read_bytes()).decode()
            picture += f'<img alt="{cell(title)}" src="data:image/png;base64,{data}">'
    if not picture:
        picture = curves(*result.curves(), log=(True, True))
    if picture:
        figure = f"<figure>{picture}<figcaption>{cell(caption)}</figcaption></figure>"
    else:
        figure = ""
    return f"<section><h2>{cell(title)}</h2>{figure}{result.html()}</section>"


def page(title: str, verdict: str, meaning: str, sections: Sequence[str], skipped: Sequence[str]) -> str:
    """Return the page of a report.

    Parameters
    ----------
    title, verdict, meaning : str
        `meaning` is a sentence that explains the verdict.
    sections : sequence of str
        Results of `section`.
    skipped : sequence of str
        Sentences about what was skipped.
    """
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{cell(title)}: {verdict}</title>
<style>{STYLE}</style>
</head>
<body>
<h1>{cell(title)}</h1>
<p class="verdict {verdict}"><strong>{verdict}</strong>. {cell(meaning)}</p>
{"".join(sections)}
{folded_list("What this report skipped", skipped)}
<script>{SORTING}</script>
</body>
</html>
"""
