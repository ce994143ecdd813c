"""How the pages are made; building.md says what to type. Sphinx reads this file."""

import sys
from importlib.util import find_spec
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent)]

import course_notebooks
import docstrings
import gallery_scripts
from docutils import nodes

import sparsedp

project, author, copyright = "sparsedp", "sparsedp contributors", "sparsedp contributors, MIT licence"
release = version = sparsedp.__version__
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "formulas",
]
exclude_patterns = ["_build", "**/GALLERY_HEADER.rst"]
templates_path = ["_templates"]

# Pages are Markdown; code blocks in them are run by tests/test_pages.py.
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "tasklist"]
myst_heading_anchors = 3
html_math_renderer = "mathml"  # formulas.py: no script, no fonts to fetch

# The API, from docstrings.
default_role = "code"
smartquotes_action = "D"  # dashes alone: quotes in tables of options are code
# The bridges have pages without their libraries. One that is installed is imported: other libraries look at it.
autodoc_mock_imports = [name for name in ("jax", "pint", "torch", "xarray") if find_spec(name) is None]
autodoc_member_order = "bysource"
autodoc_typehints = "none"
napoleon_use_rtype = False
napoleon_use_ivar = True
add_module_names = False

sphinx_gallery_conf = {
    "examples_dirs": [str(gallery_scripts.STAGE)],
    "gallery_dirs": ["gallery"],
    # All are run whose libraries are here; -D sphinx_gallery_conf.filename_pattern=heat_rod runs one.
    "filename_pattern": gallery_scripts.runnable(),
    "subsection_order": "gallery_scripts.section_order",
    "within_subsection_order": "gallery_scripts.order",
    "reset_argv": "gallery_scripts.arguments",
    "image_scrapers": ("gallery_scripts.pictures", "matplotlib"),
    "abort_on_example_error": True,
    "backreferences_dir": "gallery/uses",
    "doc_module": ("sparsedp",),
    "inspect_global_variables": False,
    "show_signature": False,
    "write_computation_times": False,
    "download_all_examples": False,
    "first_notebook_cell": "import sys\n\nsys.argv = sys.argv[:1]  # Jupyter has arguments, the script its defaults",
    "thumbnail_size": (400, 280),
}

html_context = {"default_mode": "auto"}
html_title = "sparsedp"
html_theme = "pydata_sphinx_theme"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_copy_source = False
html_show_sourcelink = False
html_show_search_summary = False  # a page that is opened from disk may not fetch others
WITHOUT_SIDEBAR = (
    "index",
    "start",
    "ideas",
    "numbers",
    "compare",
    "where",
    "decisions",
    "building",
    "course",
    "teaching",
    "gallery/**",
)
html_sidebars = {page: [] for page in WITHOUT_SIDEBAR}
html_theme_options = {
    "navbar_align": "left",
    "show_prev_next": False,
    "secondary_sidebar_items": {"*": ["page-toc"], "gallery/**": [], "api/**": []},  # code and tables need the width
    "footer_start": ["copyright"],
    "footer_end": [],
    "header_links_before_dropdown": 7,
    "pygments_light_style": "a11y-high-contrast-light",
}


def mark_tables_of_options(app, doctree):
    """Give tables of options a class: on a phone, site.css puts the meaning below the name of the option."""
    for table in doctree.findall(nodes.table):
        head = [entry.astext() for row in table.findall(nodes.thead) for entry in row.findall(nodes.entry)]
        if head == ["method", "option", "default", "meaning"]:
            table["classes"].append("options")


def setup(app):
    gallery_scripts.stage()
    gallery_scripts.let_processes_in()
    app.connect("autodoc-process-docstring", docstrings.rewrite, priority=400)  # before napoleon
    app.connect("autodoc-process-docstring", docstrings.link, priority=600)  # after it
    app.connect("viewcode-follow-imported", docstrings.defined_in)
    app.connect("doctree-read", mark_tables_of_options)
    app.connect("builder-inited", gallery_scripts.thumbnails, priority=900)  # after sphinx-gallery has run the examples
    app.connect("builder-inited", gallery_scripts.measured, priority=910)
    app.connect("builder-inited", course_notebooks.offer, priority=920)
