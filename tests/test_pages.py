"""The pages in docs/: their code runs, every public name is on them, and what Sphinx makes of them is sound.

Made with warnings as errors; every link leads somewhere, no page asks the network, and in a browser every page loads
without an error, at the widths of a phone and of a desk, with its formulas and pictures; search works from disk.
"""

import functools
import importlib.util
import inspect
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from html.parser import HTMLParser
from urllib.parse import unquote, urlsplit

import pytest
from pages import SHELL, blocks, check_install, commands, run_blocks
from sources import ROOT
from test_docstrings import names_with_a_page, see_also

import sparsedp
from sparsedp.__main__ import main

DOCS = ROOT / "docs"
GUIDES = sorted(path.relative_to(DOCS).as_posix() for path in DOCS.glob("guides/*.md"))
PAGES = [*sorted(path.name for path in DOCS.glob("*.md")), *GUIDES]
RUN = [name for name in PAGES if "```python" in (DOCS / name).read_text(encoding="utf-8")]
QUICK = "/(ensemble|heat_rod|new_operator|plan|update_directions|velocity_recovery)"  # examples that are run here
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
WIDTHS = {"desk": (1280, 900), "phone": (390, 844)}


# ---- the sources -----------------------------------------------------------------------------------------------------


@pytest.mark.whole
@pytest.mark.parametrize("name", RUN)
def test_python_blocks(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_blocks(DOCS / name)


def test_every_public_name_is_on_the_page_of_the_api():
    listed = re.findall(r"^   (\w[\w.]*)$", (DOCS / "api.rst").read_text(encoding="utf-8"), re.MULTILINE)
    public = [name for name in dir(sparsedp) if not name.startswith("__")]
    rooms = {room: getattr(sparsedp, room).__all__ for room in sparsedp._PUBLIC_PACKAGES}
    rooms["report"] = [name for name in rooms["report"] if name not in public]  # these stand in the window as well
    assert sorted(listed) == sorted([*public, *(f"{room}.{name}" for room in rooms for name in rooms[room])])


def test_pages_that_docstrings_name_exist():
    sources = [path.read_text(encoding="utf-8") for path in (ROOT / "sparsedp").rglob("*.py")]
    named = {page for text in sources for page in re.findall(r"\bdocs/[\w/]+\.md\b", text)}
    assert "docs/guides/complex_numbers.md" in named
    assert [page for page in sorted(named) if not (ROOT / page).is_file()] == []


def test_fractions_have_braces():
    r"""Sphinx's MathML takes \frac12 x for twelve over x."""
    for path in [*DOCS.glob("*.md"), *DOCS.glob("*.rst"), *(ROOT / "examples").glob("*.py")]:
        assert not re.search(r"\\[dt]?frac[^{]", path.read_text(encoding="utf-8")), path.name


def test_commands_of_the_pages():
    found = [
        words
        for name in PAGES
        for block in blocks((DOCS / name).read_text(encoding="utf-8"))
        if block.language in SHELL
        for words in commands(block.text)
    ]
    assert found
    for words in found:
        if words[0] == "../trial/bin/python":  # of the new environment in release.md
            words[0] = "python"
        if words[:3] == ["python", "-m", "pip"]:
            check_install(words[3:])
        elif words[:3] == ["python", "-m", "pytest"]:
            assert (ROOT / words[-1]).exists() or words[3:] in (["-m", "slow"], ["-m", "campaign"])
        elif words[0] == "python" and words[1].startswith("examples/"):
            assert (ROOT / words[1]).exists()
        elif words[0] == "python" and words[1].startswith("docs/"):
            assert (ROOT / words[1]).exists()
        elif words[:3] in (["python", "-m", "build"], ["python", "-m", "twine"], ["python", "-m", "venv"]):
            assert words[3] in ("../sparsedp-release", "check", "upload", "../trial")
        elif words[0] == "git":
            assert words[1] in ("clone", "tag", "push")
        else:
            assert words[:4] in (["python", "-m", "sparsedp", "demo"], ["python", "-m", "sphinx", "-W"], [".ci/run"])


def test_what_becomes_of_a_docstring(monkeypatch):
    """Public names are links where they are no arguments; code, tables and examples stay."""
    monkeypatch.syspath_prepend(DOCS)
    docstrings = importlib.import_module("docstrings")

    def inverse(lift):
        pass

    lines = """Solve with `inverse` and `laplacian`, |x|.

    See Also
    --------
    check.order, lift

    Notes
    -----
    Apply `lift` with ``transport(inflow=0.0)``; `inflow` is no `flow_step`.
    Cost: two::

        `laplacian` | 2

    ======== ====
    `upwind` 1
    ======== ====

    >>> `upwind` * 2
    """
    found = inspect.cleandoc(lines).splitlines()
    docstrings.rewrite(None, "function", "sparsedp.inverse", inverse, None, found)
    lift = inspect.getdoc(sparsedp.lift).splitlines()[0]
    order = inspect.getdoc(sparsedp.check.order).splitlines()[0]
    wanted = f"""Solve with `inverse` and :obj:`laplacian <sparsedp.laplacian>`, \\|x\\|.

    See Also
    --------
    check.order : {order}
    lift : {lift}

    Notes
    -----
    Apply `lift` with ``transport(inflow=0.0)``; `inflow` is no :obj:`flow_step <sparsedp.flow_step>`.

    Cost: two::

        `laplacian` | 2

    ======== ====
    `upwind` 1
    ======== ====

    >>> `upwind` * 2
    """
    assert found == inspect.cleandoc(wanted).splitlines()
    value = ["Mode: how it is solved."]
    docstrings.rewrite(None, "property", "sparsedp.Operator.mode", None, None, value)
    assert value == ["\\ ", "Mode: how it is solved."]


# ---- what Sphinx makes of them ---------------------------------------------------------------------------------------


class Page(HTMLParser):
    """What a page links to, and where in it one can link to."""

    def __init__(self, path):
        super().__init__()
        self.links, self.places, self.formulas = [], set(), 0
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.formulas += tag == "math"
        self.places |= {given[key] for key in ("id", "name") if given.get(key)}
        self.links += [given[key] for key in ("href", "src") if given.get(key)]


@pytest.fixture(scope="session")
def site(tmp_path_factory):
    """The pages, made in a copy; only the quickest examples are run."""
    for module in ("sphinx", "myst_parser", "sphinx_gallery", "sphinx_design", "sphinx_copybutton"):
        if importlib.util.find_spec(module) is None:
            pytest.skip(f'{module} is not installed: python -m pip install -e ".[docs]"')
    copy = tmp_path_factory.mktemp("site")
    shutil.copytree(DOCS, copy / "docs", ignore=shutil.ignore_patterns("_build", "gallery", "api", "__pycache__"))
    shutil.copytree(ROOT / "examples", copy / "examples")
    shutil.copytree(ROOT / "benchmarks" / "wrong_adjoints", copy / "benchmarks" / "wrong_adjoints")
    (copy / "tests" / "helpers").mkdir(parents=True)
    shutil.copy(ROOT / "tests" / "helpers" / "scripts.py", copy / "tests" / "helpers")
    options = ["-W", "--keep-going", "-q", "-D", f"sphinx_gallery_conf.filename_pattern={QUICK}"]
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *options, str(copy / "docs"), str(copy / "html")],
        env={**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"},
        capture_output=True,
        text=True,
        timeout=570,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return copy / "html"


def pages(site):
    return sorted(path for path in site.rglob("*.html") if "_static" not in path.relative_to(site).parts)


def dead_links(site):
    """Links of all pages that lead to no file, to no place in it, or to another site; and how many were followed."""
    read = functools.cache(Page)
    dead = set()
    followed = 0
    for path in pages(site):
        for link in read(path).links:
            parts = urlsplit(link)
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            target = target / "index.html" if target.is_dir() else target
            place = unquote(parts.fragment) if target.suffix == ".html" else ""
            followed += 1
            if parts.scheme == "data":
                continue
            if parts.scheme or parts.netloc or not target.exists() or (place and place not in read(target).places):
                dead.add(f"{path.relative_to(site)}: {link}")
    return sorted(dead), followed


@pytest.mark.slow
def test_links(site):
    dead, followed = dead_links(site)
    assert not dead, "\n".join(dead)
    assert followed > 1000 and Page(site / "ideas.html").formulas > 20


def test_pictures_of_the_readme():
    """docs/readme_pictures.py draws all of them, README.md and the front page show them, and they are small files."""
    pictures = sorted((DOCS / "pictures").iterdir())
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert re.findall(r"\]\(docs/pictures/(\w+)\.png\)", text) == ["recovery"]
    drawn = re.search(r"^NAMES = (.*)$", (DOCS / "readme_pictures.py").read_text(encoding="utf-8"), re.MULTILINE)[1]
    assert [f'"{path.stem}"' for path in pictures] == sorted(drawn.split(", "))
    shown = re.findall(r" pictures/(\w+)\.png$", (DOCS / "index.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert shown == [name.strip('"') for name in drawn.split(", ")]
    assert sum(path.stat().st_size for path in pictures) <= 300_000


def test_dead_links_are_seen(tmp_path):
    (tmp_path / "b.html").write_text('<p id="here"></p>', encoding="utf-8")
    links = ["b.html#here", "b.html", "data:,x", "b.html#there", "c.html", "https://example.org", "#nowhere"]
    text = "".join(f'<a href="{link}"></a>' for link in links)
    (tmp_path / "a.html").write_text(text, encoding="utf-8")
    assert dead_links(tmp_path) == (sorted(f"a.html: {link}" for link in links[3:]), len(links))


@pytest.mark.slow
def test_every_example_and_name_has_a_page(site):
    examples = {path.stem for path in (ROOT / "examples").glob("*.py")}
    assert examples <= {path.stem for path in (site / "gallery").rglob("*.html")}
    assert {f"sparsedp.{name}" for name in sparsedp.__all__} <= {path.stem for path in (site / "api").glob("*.html")}
    thumbnails = {path.name for path in (site / "_images").glob("sphx_glr_*_thumb.png")}
    assert len(thumbnails) >= len(examples)


@pytest.mark.slow
def test_related_names_are_links_with_summaries(site):
    for name, value in names_with_a_page().items():
        text = (site / "api" / f"sparsedp.{name}.html").read_text(encoding="utf-8")
        box = text.partition('class="admonition seealso"')[2].partition("</div>")[0]
        pages = re.findall(r'<dt><a class="reference internal" href="sparsedp\.([\w.]+)\.html#', box)
        assert pages == see_also(inspect.getdoc(value)) and box.count("<dd><p>") == len(pages), name


@pytest.mark.whole
def test_a_card_is_one_panel_of_readable_size(tmp_path, monkeypatch):
    """With its labels, without the panels beside it and their colour bars."""
    for module in ("sphinx_gallery", "matplotlib"):
        pytest.importorskip(module)
    from matplotlib import pyplot
    from PIL import Image

    monkeypatch.syspath_prepend(DOCS)
    gallery_scripts = importlib.import_module("gallery_scripts")
    monkeypatch.setattr(gallery_scripts, "CARDS", tmp_path)
    monkeypatch.setattr(gallery_scripts, "PANELS", {"second": 1})
    for panel, name in enumerate(("first", "second")):
        figure, places = pyplot.subplots(1, 2, figsize=(13, 3), layout="constrained")
        places[0].loglog([1.0, 10.0], [1.0, 2.0])
        figure.colorbar(places[1].imshow([[0.0, 1.0]]), ax=places[1])
        gallery_scripts.draw_card(name)
        assert figure.axes == [places[panel]] and tuple(figure.get_size_inches()) == gallery_scripts.CARD_SIZE
        box = figure.axes[0].get_tightbbox()
        assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= figure.bbox.x1 and box.y1 <= figure.bbox.y1
        pyplot.close("all")
        assert Image.open(tmp_path / f"{name}.png").size == (600, 420)


@pytest.mark.slow
def test_pages_of_the_course_offer_their_notebooks(site):
    """Pages link to the notebook with the audit, also in the archive; notebooks of examples that run have outputs."""
    course = [path for path in pages(site) if path.parent.name == "a_course" and path.name != "index.html"]
    offered = {}
    for path in course:
        links = [path.parent / unquote(link) for link in Page(path).links if link.endswith((".ipynb", ".zip"))]
        [file], [archive] = [[link for link in links if link.suffix == kind] for kind in (".ipynb", ".zip")]
        text = file.read_text(encoding="utf-8")
        assert "## Audit" in text and "parse_args" not in text
        assert zipfile.ZipFile(archive).read(file.name).decode() == text
        offered[path.stem] = json.loads(text)["cells"]
    executed = [name for name, cells in offered.items() if any(cell.get("outputs") for cell in cells)]
    assert len(offered) == 10 and executed == ["heat_rod"]
    assert sum(link.endswith(".ipynb") for link in Page(site / "course.html").links) == 10


@pytest.fixture(scope="session")
def browser():
    if CHROMIUM is None or importlib.util.find_spec("playwright") is None:
        pytest.skip("Chromium or playwright is not installed")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as api:
        running = api.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield running
        running.close()


def opened(browser, width):
    """A page of the browser, and the list that its errors, and what it asks of the network, go to."""
    tab = browser.new_page(viewport=dict(zip(("width", "height"), WIDTHS[width])))
    wrong = []
    tab.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
    tab.on("pageerror", lambda error: wrong.append(str(error)))
    tab.on("requestfailed", lambda request: wrong.append(f"failed {request.url}"))
    tab.on("request", lambda request: None if request.url.startswith(("file:", "data:")) else wrong.append(request.url))
    return tab, wrong


LOOK = """() => {
    const scrolls = element => ["auto", "scroll"].includes(getComputedStyle(element).overflowX);
    const inner = element => element.parentElement.closest("article *");
    const scrollable = element => element && (scrolls(element) || scrollable(inner(element)));
    const text = element => element.tagName + " " + element.textContent.slice(0, 60);
    const output = element => element.closest(".sphx-glr-script-out");
    return {
        over: document.documentElement.scrollWidth - document.documentElement.clientWidth,
        broken: [...document.images].filter(i => i.complete && !i.naturalWidth).map(i => i.src),
        flat: [...document.querySelectorAll("article math")].filter(m => m.getBoundingClientRect().height < 5).length,
        cut: [...document.querySelectorAll("article .highlight pre")]
            .filter(e => e.scrollWidth > e.clientWidth + 1 && !(output(e) && scrolls(e))).map(text),
        beyond: [...document.querySelectorAll("article :is(p, li, dd, dt, pre, table, img, h1, h2, h3)")]
            .filter(e => e.getBoundingClientRect().right > innerWidth + 1 && !scrollable(inner(e))).map(text),
    };
}"""


@pytest.mark.slow
@pytest.mark.parametrize("width", WIDTHS)
def test_in_a_browser(site, browser, width):
    """No error, no picture missing, no formula without a height, no code cut, nothing wider than the window.

    Tables and what an example printed scroll in their own box.
    """
    tab, wrong = opened(browser, width)
    found = []
    for path in pages(site):
        tab.goto(path.as_uri())
        seen = tab.evaluate(LOOK)
        found += [
            f"{path.relative_to(site)}: {what}" for what in (*wrong, *seen["broken"], *seen["cut"], *seen["beyond"])
        ]
        found += [f"{path.relative_to(site)}: {key} {seen[key]}" for key in ("over", "flat") if seen[key] > 0]
        wrong.clear()
    tab.close()
    assert not found, "\n".join(found)


@pytest.mark.slow
def test_search_from_disk(site, browser):
    tab, wrong = opened(browser, "desk")
    tab.goto((site / "search.html").as_uri() + "?q=checkpoint")
    tab.wait_for_selector("#search-results li a", timeout=10_000)
    tab.wait_for_timeout(500)
    titles = tab.locator("#search-results li").all_inner_texts()
    tab.close()
    assert any("ideas" in title.lower() for title in titles) and not wrong, (titles, wrong)


SCENE = """
import autograd.numpy as np
import sparsedp as dp

solve = dp.inverse(dp.identity(dp.Grid(12).cells) - dp.laplacian(dp.Grid(12)))
loss, start = lambda u: np.sum(solve(u) ** 3), np.linspace(1.0, 2.0, 12)
"""


TABLES = """() => [...document.querySelectorAll("table")].map(table => {
    const wide = table.scrollWidth > table.clientWidth + 1;
    table.scrollLeft = 10000;
    const [box, first, last] = [table, ...["first", "last"].map(end => table.querySelector(`tr > :${end}-child`))]
        .map(element => element.getBoundingClientRect());
    table.scrollLeft = 0;
    return {
        wide: wide,
        scrolls: getComputedStyle(table).overflowX === "auto",
        inside: box.left >= 0 && box.right <= innerWidth && first.left >= box.left - 1 && last.right <= box.right + 1,
    };
})"""


@pytest.mark.slow
@pytest.mark.parametrize("width", WIDTHS)
def test_the_report_in_a_browser(tmp_path, browser, width):
    """It opens from disk without network, fits the window, and its tables sort by a click on a name, or by a key."""
    (tmp_path / "scene.py").write_text(SCENE, encoding="utf-8")
    assert main(["report", str(tmp_path / "scene.py"), "--out", str(tmp_path)]) == 0
    tab, wrong = opened(browser, width)
    tab.goto((tmp_path / "report.html").as_uri())
    seen = tab.evaluate(LOOK)
    assert seen["over"] <= 0 and not seen["broken"] and not seen["cut"] and not wrong, (seen, wrong)
    tables = tab.evaluate(TABLES)  # a wide one scrolls in its own box, beside its first column
    assert len(tables) > 3 and all(table["inside"] and (table["scrolls"] or not table["wide"]) for table in tables)
    assert any(table["wide"] for table in tables) == (width == "phone")
    assert tab.locator("body > *").nth(1).inner_text().startswith("agrees")
    assert not tab.locator("details li").first.is_visible()
    tab.locator("summary").first.click()
    assert tab.locator("details li").first.is_visible()
    head = tab.locator("th").first
    column = tab.locator("table").first.locator("td:first-child")
    head.click()
    rising = list(map(float, column.all_inner_texts()))
    head.press("Enter")
    falling = list(map(float, column.all_inner_texts()))
    tab.close()
    assert rising == sorted(rising) == falling[::-1] and len(set(rising)) > 5
