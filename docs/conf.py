"""Sphinx: `make docs` builds these pages into docs/_build. The pages themselves are Markdown and read well without it."""

from __future__ import annotations

import contextlib
import io
import logging
import os
from importlib.metadata import version as version_of

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

project = "topoloc"
author = "the topoloc contributors"
copyright = author
release = version = version_of("topoloc")

logging.getLogger("faiss.loader").setLevel(logging.WARNING)  # else it tells what it did not find

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]
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


class CommandHelp(SphinxDirective):
    """What every command prints for `--help`, a section each: the reference that no hand writes."""

    def run(self) -> list[nodes.Node]:
        from topoloc.cli import COMMANDS

        os.environ["COLUMNS"] = "82"  # as wide as a page
        sections: list[nodes.Node] = []
        for command in COMMANDS:
            section = nodes.section(ids=[f"topoloc-{command}"])
            section += nodes.title("", f"topoloc {command}")
            text = _printed([command, "--help"])
            section += nodes.literal_block(text, text, language="text")
            sections.append(section)
        return sections


def _printed(args: list[str]) -> str:
    from topoloc.cli import main

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        main(args)
    return printed.getvalue().strip()


class WordsOfFields:
    """Keeps Napoleon off what is said of a field: there it takes the words before a colon for a type."""

    def __init__(self) -> None:
        self.kept: list[str] = []

    def hide(self, app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
        if what == "attribute":
            self.kept, lines[:] = lines[:], ["hidden"]

    def show(self, app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
        if what == "attribute":
            lines[:] = self.kept


def setup(app: Sphinx) -> None:
    app.add_directive("topoloc-help", CommandHelp)
    words = WordsOfFields()
    app.connect("autodoc-process-docstring", words.hide, priority=400)  # Napoleon's is 500
    app.connect("autodoc-process-docstring", words.show, priority=600)
