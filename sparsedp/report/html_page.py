"""The report as one page of HTML: it needs no other file and no network."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path

from sparsedp._utils.html import cell, curves, folded
from sparsedp.check.summary import Result

__all__ = ["page", "section"]

STYLE = """
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 0 auto; padding: 1rem; }
h1 { margin-bottom: 0; }
.verdict { border-left: 0.5rem solid; padding: 0.5rem 1rem; font-size: 1.2rem; }
.agrees { border-color: #009e73; } .disagrees { border-color: #d55e00; } .inconclusive { border-color: #e69f00; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; margin: 1rem 0; font-size: 0.85rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.15rem 0.6rem; text-align: left; border-bottom: 1px solid #8884; }
th { cursor: pointer; white-space: nowrap; }
th[aria-sort=ascending]::after { content: " \\2191"; } th[aria-sort=descending]::after { content: " \\2193"; }
figure { margin: 1rem 0; } img, svg { max-width: 100%; height: auto; } img { background: white; width: 44rem; }
figcaption { font-size: 0.9rem; }
.stacked thead tr { display: flex; flex-wrap: wrap; }
.stacked tbody tr { display: block; padding: 0.5rem 0; border-bottom: 1px solid #8884; }
.stacked td { display: flex; border: 0; white-space: normal; overflow-wrap: anywhere; }
.stacked td::before { content: attr(data-name); flex: 0 0 35%; padding-right: 0.6rem; opacity: 0.75; }
.stacked td:empty { display: none; }
.stacked, .stacked tbody { display: block; }
"""

# A click on the name of a column sorts its table by it: numbers by size, words by letters, what is empty last. Tables
# that are too wide for the window are stacked.
SORTING = """
for (const table of document.querySelectorAll("table")) {
  const names = [...table.querySelectorAll("th")].map(head => head.textContent);
  for (const row of table.tBodies[0].rows) {
    [...row.cells].forEach((cell, column) => { cell.dataset.name = names[column] || ""; });
  }
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
// A table that is wider than the window has its cells below each other.
const fit = () => {
  for (const box of document.querySelectorAll(".wide")) {
    for (const table of box.querySelectorAll("table")) {
      table.classList.remove("stacked");
      table.classList.toggle("stacked", table.scrollWidth > box.clientWidth);
    }
  }
};
window.addEventListener("resize", fit);
fit();
"""


def section(title: str, result: Result, files: Sequence[Path], caption: str) -> str:
    """Return a result as HTML with its picture, the PNG among its files or a plainer one, and a caption."""
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
    return f'<section><h2>{cell(title)}</h2>{figure}<div class="wide">{result.html()}</div></section>'


def page(title: str, verdict: str, meaning: str, sections: Sequence[str], skipped: Sequence[str]) -> str:
    """Return the page of a report.

    Parameters
    ----------
    title, verdict, meaning : str
        The meaning is a sentence about the verdict.
    sections : sequence of str
        From `section`.
    skipped : sequence of str
        Sentences about what was left out.
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
{folded("What was left out", skipped)}
<script>{SORTING}</script>
</body>
</html>
"""
