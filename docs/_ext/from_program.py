"""What of these pages is generated from the program: the help of every command, and fields as their
own words describe them."""

from __future__ import annotations

import contextlib
import io
import os

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective


class CommandHelp(SphinxDirective):
    """What every command prints for `--help`, a section each: the reference that no hand writes."""

    def run(self) -> list[nodes.Node]:
        from topoloc.apps.cli import all_commands

        os.environ["COLUMNS"] = "82"  # as wide as a page
        sections: list[nodes.Node] = []
        for command in all_commands():
            section = nodes.section(ids=[f"topoloc-{command}"])
            section += nodes.title("", f"topoloc {command}")
            text = _printed([command, "--help"])
            section += nodes.literal_block(text, text, language="text")
            sections.append(section)
        return sections


def _printed(args: list[str]) -> str:
    from topoloc.apps.cli import main

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        main(args)
    return printed.getvalue().strip()


class WordsOfFields:
    """Keeps Napoleon off what is said of a field: there it takes the words before a colon for a
    type."""

    def __init__(self) -> None:
        self.kept: list[str] = []

    def hide(
        self, app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]
    ) -> None:
        if what == "attribute":
            self.kept, lines[:] = lines[:], ["hidden"]

    def show(
        self, app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]
    ) -> None:
        if what == "attribute":
            lines[:] = self.kept


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("topoloc-help", CommandHelp)
    words = WordsOfFields()
    app.connect("autodoc-process-docstring", words.hide, priority=400)  # Napoleon's is 500
    app.connect("autodoc-process-docstring", words.show, priority=600)
    return {"parallel_read_safe": False, "parallel_write_safe": True}
