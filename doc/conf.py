"""Sphinx configuration: Markdown pages, NumPy docstrings, catalogues generated from the package itself."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

from lsst.fringe_sim import __version__

project = "lsst.fringe_sim"
author = "the lsst.fringe_sim developers"
copyright = author
version = release = __version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "numpydoc", "catalogues", "mathml"]
suppress_warnings = ["myst.header"]  # a page may leave out a level of headings
source_suffix = {".md": "myst-nb"}
exclude_patterns = ["_build", "changes"]
root_doc = "index"

myst_enable_extensions = ["deflist", "dollarmath", "fieldlist"]
myst_heading_anchors = 3

# Pages of doc/notebooks are executed whenever they are built; what they write is thrown away.
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 300

smartquotes = False  # two hyphens begin an option
# Docstrings put names in single backquotes; those that are documented here become links.
default_role = "py:obj"
autosummary_generate = False
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints = "none"  # types stand in the docstrings, with shapes and units
numpydoc_show_class_members = False
numpydoc_attributes_as_param_list = True

# Nothing is fetched from elsewhere, neither when the pages are built nor when they are read.
html_theme = "alabaster"
html_static_path = ["_static"]
html_css_files = ["fringe_sim.css"]
html_title = f"lsst.fringe_sim {release}"
html_show_sourcelink = False
html_show_copyright = False
html_math_renderer = "mathml"
html_sidebars = {"**": ["about.html", "searchfield.html", "navigation.html", "relations.html"]}
html_theme_options = {
    "description": "Fringing in CCDs: model, thickness, night sky, templates.",
    "fixed_sidebar": True,
    "page_width": "70rem",
    "sidebar_width": "16rem",
    "body_max_width": "none",
}
