"""Sphinx: `make docs` builds these pages into docs/_build. The pages themselves are Markdown and
read well without it."""

from __future__ import annotations

import logging
import sys
from importlib.metadata import version as version_of
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "topoloc"
author = "the topoloc contributors"
copyright = author
release = version = version_of("topoloc")

logging.getLogger("faiss.loader").setLevel(logging.WARNING)  # else it tells what it did not find

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "from_program",
    "source_pages",
]
exclude_patterns = ["_build", "_ext", "journal"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True}
python_maximum_signature_line_length = 100
add_module_names = False

html_theme = "furo"
html_title = f"topoloc {release}"
html_static_path = ["_static"]
html_css_files = ["tables.css"]
html_show_copyright = False
html_copy_source = False
