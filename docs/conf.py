"""Sphinx: the site is built from these pages, the docstrings and the code; ``python3 dev.py nox -s docs`` runs it."""

from __future__ import annotations

import os
import sys
from importlib.metadata import files
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE / "_extensions"), str(HERE.parent / "src")]

from piga import __version__ as release  # noqa: E402

project = "piga"
copyright = "The piga developers, Apache-2.0"  # noqa: A001
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "generated_pages",
]
exclude_patterns = ["_*", "Thumbs.db", "reference/examples/*"]
highlight_language = "none"

nb_execution_mode = "cache"
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_execution_timeout = 170
nb_output_stderr = "remove"
nb_execution_excludepatterns = ["reference/generated/*"]
os.environ["PYTHONPATH"] = str(HERE.parent / "src")  # for the kernels of the notebooks

myst_enable_extensions = ["dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
myst_dmath_double_inline = False
math_number_all = False
math_eqref_format = "({number})"

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True

html_theme = "furo"
html_title = f"piga {release}"
formulas = next(path for path in files("sphinx-mathjax-offline") or () if path.name == "tex-svg.js")
templates_path = ["_templates"]
html_static_path = [
    "_static",
    str(formulas.locate()),
]  # MathJax in one file, letters as outlines: no font, no network
mathjax_path = "tex-svg.js"
html_css_files = ["piga.css"]
html_js_files = ["piga.js"]
html_copy_source = False
html_show_sourcelink = False
