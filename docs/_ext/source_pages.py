"""Links to programs of this repository lead to pages that show them, instead of to a download."""

from __future__ import annotations

import posixpath
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx

ROOT = Path(__file__).parents[2]
FOLDER = "_files"


def lead_to_pages(app: Sphinx, doctree: nodes.document, page: str) -> None:
    """Turns every link to a Python file into one to its page, which it notes down."""
    if app.builder.format != "html":
        return
    here = Path(app.srcdir) / posixpath.dirname(page)
    for link in list(doctree.findall(addnodes.download_reference)):
        path = (here / link["reftarget"]).resolve()
        if path.suffix != ".py" or not path.is_relative_to(ROOT):
            continue
        name = path.relative_to(ROOT).as_posix()
        app.env.topoloc_files.add(name)
        uri = app.builder.get_relative_uri(page, f"{FOLDER}/{name}")
        link.replace_self(nodes.reference("", "", *link.children, refuri=uri, internal=True))


def collect_pages(app: Sphinx) -> Iterator[tuple[str, dict[str, Any], str]]:
    for name in sorted(app.env.topoloc_files):
        text = (ROOT / name).read_text(encoding="utf-8")
        body = app.builder.highlighter.highlight_block(text, "python", linenos=False)
        yield (
            f"{FOLDER}/{name}",
            {"title": name, "body": f"<h1>{name}</h1>{body}", "parents": []},
            "page.html",
        )


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("builder-inited", lambda app: setattr(app.env, "topoloc_files", set()))
    app.connect("doctree-resolved", lead_to_pages)
    app.connect("html-collect-pages", collect_pages)
    return {"parallel_read_safe": False, "parallel_write_safe": False}
