"""The documentation's site, which `make docs` builds into docs/_build/html; nothing is fetched
for it.
"""

import html
import inspect
import os
import pydoc
import re
import sys
from importlib.metadata import version as installed_version
from pathlib import Path

import numpydoc.xref

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "_extensions"))
os.environ.setdefault("PYVISTA_OFF_SCREEN", "true")
os.environ.setdefault("MPLBACKEND", "agg")
os.environ["PYVISTA_BUILDING_GALLERY"] = "true"  # before pyvista is loaded

project = "tetopt"
author = "The tetopt developers"
copyright = "2026, the tetopt developers; BSD-3-Clause"
version = release = installed_version("tetopt")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "numpydoc",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "mathml",
    "command_pages",
    "schema_pages",
]
exclude_patterns = ["_build", "_extensions", "_templates", "examples/GALLERY_HEADER.rst"]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
nitpicky = False
default_role = "py:obj"  # names in docstrings are links where they are public
templates_path = ["_templates"]
numpydoc_show_class_members = False
numpydoc_xref_param_type = True
# Records that functions return stand with their modules on the page.
API_PAGE = (Path(__file__).parent / "reference" / "api" / "index.md").read_text(encoding="utf-8")
numpydoc_xref_aliases = {
    name.rpartition(".")[2]: f"tetopt.{name}"
    for name in re.findall(r"^   ~?([\w.]+)$", API_PAGE, re.M)
    if inspect.isclass(pydoc.locate(f"tetopt.{name}"))
}
numpydoc_xref_ignore = "all"  # words of types that are not ours
numpydoc.xref.DEFAULT_LINKS.clear()  # to Python's own pages, which are not fetched
autodoc_typehints = "none"  # the docstrings say types, shapes and units
autodoc_member_order = "bysource"
python_maximum_signature_line_length = 72  # longer ones have a line for each parameter
# Names that differ by case alone would be one file on Windows and macOS.
autosummary_filename_map = {
    f"tetopt.{name}": f"tetopt.{name}_record" for name in ("Content", "Quality")
}
copybutton_exclude = ".linenos, .gp, .go"

sphinx_gallery_conf = {
    "examples_dirs": "examples",
    "gallery_dirs": "gallery",
    "filename_pattern": r"\.py$",
    "within_subsection_order": "gallery_order.position",
    "image_scrapers": ("matplotlib", "pyvista"),
    "remove_config_comments": True,
    "abort_on_example_error": True,
    "show_memory": False,
    "download_all_examples": False,
    "min_reported_time": 1_000_000,  # seconds of this machine are no news of the examples
    "write_computation_times": False,
}

html_theme = "pydata_sphinx_theme"
html_title = f"tetopt {release}"
html_static_path = ["_static"]
html_css_files = ["tetopt.css"]
html_favicon = "_static/favicon.svg"
html_copy_source = False
html_show_sourcelink = False
html_theme_options = {
    "navbar_align": "left",
    "header_links_before_dropdown": 9,
    "navbar_end": ["theme-switcher"],
    "show_prev_next": True,
    "show_toc_level": 2,
    "footer_start": ["copyright"],
    "footer_end": [],
    "secondary_sidebar_items": ["page-toc"],
}


def described(app, doctree):
    """The gallery's pictures say in their alt text what the paragraph before them says."""
    text = ""
    for node in doctree.findall():
        if node.tagname == "paragraph":
            text = node.astext().replace("\n", " ")
        elif node.tagname == "imgsgnode" and text:
            # else the program's own name
            titles = "" if node["alt"].startswith("plot ") else f" {node['alt']}"
            node["alt"] = html.escape(text) + titles  # sphinx-gallery escapes nothing


def setup(app):
    """Fields of records are in their docstring; what Python says of them ("Alias for field
    number 0") is left out.
    """
    app.connect("doctree-read", described)
    app.connect(
        "autodoc-skip-member",
        lambda app, what, name, value, skip, options: (
            True if type(value).__name__ == "_tuplegetter" else None
        ),
    )
