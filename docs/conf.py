"""How the pages are built: sphinx-build -W -b html docs docs/_build/html; -b doctest runs every example."""

import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
os.environ.setdefault("OMP_NUM_THREADS", "1")

import torchreg

project = "torchreg"
author = "the torchreg authors"
copyright = author
version = release = torchreg.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.doctest",
    "sphinx-mathjax-offline",
    "sphinx.ext.napoleon",
]
templates_path = ["_templates"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"torchreg {release}"
html_static_path = ["_static"]
html_css_files = ["pages.css"]

myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3

# Names in single backticks in docstrings are those of Python; they link where there is a page.
default_role = "py:obj"
autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "show-inheritance": True, "inherited-members": False}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_custom_sections = [("Warns", "Raises")]
napoleon_use_ivar = True

doctest_test_doctest_blocks = ""
doctest_global_setup = """
import os, tempfile, torch
torch.set_num_threads(1)
os.chdir(tempfile.mkdtemp())
"""
