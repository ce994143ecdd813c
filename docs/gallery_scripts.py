"""The gallery: every example is run when the pages are made, and shown with what it printed and drew.

Sphinx-Gallery does the work. Here stands what it has to know of the examples: the title of each, the order, the
size that each is run with, and where its pictures are.
"""

import ast
import json
import re
import shutil
import sys
import textwrap
from importlib.util import find_spec
from multiprocessing import spawn
from pathlib import Path

import autograd.numpy as np
import docstrings
from matplotlib import pyplot
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from PIL import Image
from sphinx_gallery.scrapers import figure_rst

import sparsedp as dp

ROOT = Path(__file__).parent.parent
STAGE = Path(__file__).parent / "_build" / "examples"  # the scripts with a title; Sphinx-Gallery runs these
DRAWN = Path(__file__).parent / "_build" / "drawn"  # what they write with --out
CARDS = Path(__file__).parent / "_build" / "cards"  # one panel of each picture, at the size of a card of the gallery
CARD_SIZE = (4.0, 2.8)  # in inches: text of 10 points is readable on a card
CARD_DPI = 150
WIDE = 1.6  # width over height
PANELS = {"obstacle": 1, "plume": 1}  # the panel for the card, where it is not the first one
HEADER = "GALLERY_HEADER.rst"
INTRODUCTION = """Gallery
=======

Each example is one script, run when these pages were made. What it printed and drew stands below its code.
Times are those of that run. Sizes are smaller than the defaults of some scripts, so that all run in about ten minutes.
The first ten are a course. The others stand by topic.
"""


def size(name):
    """The size that the tests run an example with."""
    tree = ast.parse((ROOT / "tests" / "helpers" / "scripts.py").read_text(encoding="utf-8"))
    [small] = [ast.literal_eval(n.value) for n in tree.body if isinstance(n, ast.Assign) and n.targets[0].id == "SMALL"]
    return small.get(name, "16")


def sections():
    """The parts of examples/README.md that have a table: title, paragraph, {name of an example: what it shows}."""
    text = (ROOT / "examples" / "README.md").read_text(encoding="utf-8")
    for part in text.split("\n## ")[1:]:
        rows = dict(re.findall(r"^\| \d+ \| `(\w+\.py)` \| \d+ \| (.*) \|$", part, re.MULTILINE))
        title, _, rest = part.partition("\n")
        if rows:
            yield title, rest.partition("| order")[0].strip(), rows


def table():
    """Name of each example -> what it shows, in the order of examples/README.md."""
    return {name: shows for _, _, rows in sections() for name, shows in rows.items()}


def folder(title):
    """Where the examples of a section are, and their pages."""
    return re.sub(r"\W+", "_", title.lower())


def titled(text, shows):
    """A script whose docstring begins with a title as Sphinx-Gallery wants it; one that has it stays as it is."""
    doc = ast.get_docstring(ast.parse(text))
    if re.search(r"^=+$", doc, re.MULTILINE):
        return text
    first, _, rest = doc.partition("\n")
    title, _, command = first.partition(" Run: ")
    rest = docstrings.plain(re.sub(r"(?<!`)`([^`]+)`(?!`)", r"``\1``", rest.strip()))
    title = title.rstrip(".")
    paragraphs = [title + "\n" + "=" * len(title), shows[0].upper() + shows[1:] + ".", rest, f"Run: ``{command}``"]
    body = text[text.index('"""', 3) + 3 :]
    return 'r"""' + "\n\n".join(filter(None, paragraphs)) + '\n"""' + body


def stage():
    """Write the scripts that Sphinx-Gallery runs, where they changed."""
    DRAWN.mkdir(parents=True, exist_ok=True)
    texts = {Path(HEADER): INTRODUCTION}
    for title, paragraph, rows in sections():
        place = Path(folder(title))
        paragraph = re.sub(r"`docs/(\w+)\.md`", r":doc:`/\1`", paragraph)
        texts[place / HEADER] = f"{title}\n{'-' * len(title)}\n\n{paragraph}\n"
        for name, shows in rows.items():
            texts[place / name] = titled((ROOT / "examples" / name).read_text(encoding="utf-8"), shows)
    for old in [path for kind in ("*.py", HEADER) for path in STAGE.rglob(kind)]:
        if old.relative_to(STAGE) not in texts:
            old.unlink()
    for place, text in texts.items():
        (STAGE / place).parent.mkdir(parents=True, exist_ok=True)
        (STAGE / place).write_text(text, encoding="utf-8")


def runnable():
    """A pattern of the scripts that need no library which is not here."""
    missing = [name for name in ("jax", "optax", "pylops", "skfem", "torch") if find_spec(name) is None]
    imports = rf"^import ({'|'.join(missing)})$"
    if find_spec("nlopt") is None:
        missing.append("nlopt")
        imports += '|"mma"'  # the method of `minimize` imports it
    needs = re.compile(imports, re.MULTILINE)
    scripts = [path for path in (ROOT / "examples").glob("*.py") if missing and needs.search(path.read_text())]
    return r"/(?!({})\.py$)[^/]*$".format("|".join(path.stem for path in scripts)) if scripts else ".*"


def order(name):
    """Sort key: the place of an example in the table."""
    return list(table()).index(Path(name).name)


def section_order(path):
    """Sort key: the place of a section in examples/README.md."""
    return [folder(title) for title, *_ in sections()].index(Path(path).name)


def arguments(gallery_conf, script_vars):
    """What an example is called with."""
    script = Path(script_vars["src_file"])
    out = DRAWN / script.stem
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    draws = "--out" in script.read_text(encoding="utf-8")
    return [size(script.name), *(["--out", str(out)] if draws else [])]


def let_processes_in():
    """Processes that an example starts read it from its file; the __main__ of Sphinx-Gallery seems to have none."""
    prepare = spawn.get_preparation_data

    def from_file(name):
        main = sys.modules["__main__"]
        if main.__spec__ is not None and main.__spec__.loader is None:
            [script] = STAGE.rglob(Path(sys.argv[0]).name)
            main.__spec__, main.__file__ = None, str(script)
        return prepare(name)

    spawn.get_preparation_data = from_file


def pictures(block, block_vars, gallery_conf):
    """The pictures and films that a script wrote with --out, for its page. The first one, no film, is the thumbnail."""
    paths = block_vars["image_path_iterator"]
    drawn = (DRAWN / Path(block_vars["src_file"]).stem).glob("*.[pg][ni][gf]")
    found = sorted(drawn, key=lambda path: (path.suffix == ".gif", path))
    names = []
    for path in found:
        names.append(str(Path(next(paths)).with_suffix(path.suffix)))
        shutil.move(path, names[-1])
    if names:
        draw_card(Path(block_vars["src_file"]).stem)
        pyplot.close("all")  # what was saved is not shown twice
    shown = figure_rst(names, gallery_conf["src_dir"])
    if len(names) == 1 and is_wide(names[0]):
        shown = ".. container:: wide-picture\n" + textwrap.indent(shown, "   ")  # scrolls on a phone
    return shown


def is_wide(path):
    """Whether panels of a picture lie side by side, too small to read at the width of a phone."""
    width, height = Image.open(path).size
    return width > WIDE * height


def draw_card(name):
    """Draw one panel of the first open figure of an example for its card: a whole figure would be too small to read."""
    if not pyplot.get_fignums():
        return
    figure = pyplot.figure(pyplot.get_fignums()[0])
    panels = [ax for ax in figure.axes if ax.get_label() != "<colorbar>"]
    panel = panels[PANELS.get(name, 0)]
    for ax in figure.axes:
        if ax is not panel:
            ax.remove()
    figure.set_size_inches(CARD_SIZE)
    panel.set_subplotspec(figure.add_gridspec(1, 1)[0])
    figure.suptitle("")
    panel.set_title("")  # the card has a title
    panel.set_anchor("C")
    legend = panel.get_legend()
    if legend:
        legend.set_frame_on(True)  # text on lines would be hard to read
        legend.get_frame().set(alpha=0.8, edgecolor="none")
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_minor_formatter(NullFormatter())  # labels between the decades would overlap
    CARDS.mkdir(parents=True, exist_ok=True)
    figure.savefig(CARDS / f"{name}.png", dpi=CARD_DPI)


def thumbnails(app):
    """The cards: one panel of the picture of an example or, without a picture, what it printed or shows."""
    gallery = Path(app.srcdir) / "gallery"
    pages = {
        gallery / folder(title) / f"{Path(name).stem}.rst": shows
        for title, _, rows in sections()
        for name, shows in rows.items()
    }
    for page, shows in pages.items():
        text = page.read_text(encoding="utf-8")
        card = page.parent / "images" / "thumb" / f"sphx_glr_{page.stem}_thumb.png"
        if (CARDS / f"{page.stem}.png").exists():
            shutil.copy(CARDS / f"{page.stem}.png", card)
        if ".. image-sg::" in text:
            continue
        printed = re.search(r"rst-class:: sphx-glr-script-out\s+\.\. code-block:: none\n\n(.*?)\n\n\n", text, re.DOTALL)
        lines = textwrap.dedent(printed[1]).splitlines()[:12] if printed else textwrap.wrap(shows, 38)
        figure = Figure(figsize=CARD_SIZE, facecolor="#f3f4f5")
        figure.text(0.04, 0.94, "\n".join(line[:38] for line in lines), va="top", family="monospace", size=9)
        figure.savefig(card, dpi=CARD_DPI)


def membrane(method, cells):
    """A point of a membrane under an even load, and its slope in the load; the exact value is known."""
    grid = dp.Grid((cells, cells), size=1.0)
    solve, middle = dp.inverse(-dp.laplacian(grid, dp.dirichlet), method), dp.sample(grid, [[0.5, 0.5]])
    return lambda load: middle(solve(load * np.ones(grid.shape)))[0], 1.0


def measured(app):
    """Picture and table of numbers.md: error against run time of every solver, on this machine."""
    home = Path(app.srcdir)
    if (home / "_build" / "error_against_time.md").exists():
        return
    methods = {name: {"method": name} for name in ("direct", "separable", "structured", "multigrid", "krylov")}
    exact = 0.07367135328151
    for method in methods:
        membrane(method, 16)[0](1.0)  # compiling is no part of a set-up
    table = dp.work_precision(membrane, methods, over={"cells": [32, 64, 128, 256]}, reference=(exact, exact))
    lines = ["| method | cells | error of the gradient | set-up | forward | adjoint | iterations |", "|" + "---|" * 7]
    for row in table.rows:
        times = (f"{1e3 * row[f'seconds_{part}']:.3g} ms" for part in ("setup", "forward", "backward"))
        ends = f"{row['gradient_error']:.1e}", *times, f"{row['iterations']}"
        lines.append(f"| {row['method']} | {json.loads(row['settings'])['cells']}^2 | " + " | ".join(ends) + " |")
    (home / "_build" / "error_against_time.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    table.plot(figure.subplots())
    (home / "gallery" / "images").mkdir(exist_ok=True)
    figure.savefig(home / "gallery" / "images" / "error_against_time.png", dpi=120)
