"""How the pages in this folder are made: `make docs` writes them to out/docs."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_extensions"))

import orthocal

project = "orthocal"
author = "The orthocal developers"
copyright = "the orthocal developers"
release = version = orthocal.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "mathematics",  # formulas as MathML: pages need no network
]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_typehints = "none"
napoleon_use_rtype = False
exclude_patterns = ["_extensions"]

html_theme = "furo"
html_title = "orthocal"
html_show_sourcelink = False
html_show_sphinx = False
html_static_path = ["_static"]
html_css_files = ["pages.css"]


def _begin_with_a_line(app, what, name, obj, options, lines):  # noqa: ANN001, ANN202 - Sphinx's
    """A colon in the first line of a field's description begins no type."""
    if what in ("attribute", "property", "data"):
        lines.insert(0, "")


def setup(app):  # noqa: ANN001, ANN201 - Sphinx's
    """Before docstrings are read as Google's."""
    app.connect("autodoc-process-docstring", _begin_with_a_line, priority=400)
