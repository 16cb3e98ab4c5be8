"""A scene as a page of its own, or as a part of one: self-contained, so that it works from a file
and asks nothing of anybody.

The front end is plain modules of JavaScript (`static/`) that know each other by name: an import map
leads from the names to `/static/` where the service gives them, and to copies within the page where
it is a file.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping
from functools import cache
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

from topoloc.apps.viewer.document import to_script_json
from topoloc.plugin import write_text

MODULES = {
    "three": "three.js",
    "topoloc/geometry": "geometry.js",
    "topoloc/objects": "objects.js",
    "topoloc/stage": "stage.js",
    "topoloc/apps/viewer": "viewer.js",
    "topoloc/words": "words.js",
}
"""The scene's modules by the names by which they import each other."""


@cache
def static_text(name: str) -> str:
    """A file of the front end."""
    return (
        resources.files("topoloc.apps.viewer").joinpath("static", name).read_text(encoding="utf-8")
    )


def import_map(address: Callable[[str], str], modules: Mapping[str, str] = MODULES) -> str:
    """The element that says where each module is; `address` is that of a file of `static/`."""
    places = {name: address(file) for name, file in modules.items()}
    return f'<script type="importmap">{json.dumps({"imports": places})}</script>'


def embedded_head() -> str:
    """What the head of a page with scenes needs beside its own style."""
    return f"<style>\n{static_text('viewer.css')}</style>\n{import_map(_data_address)}"


def embedded_scene(document: Mapping[str, Any], name: str = "scene") -> str:
    """A scene within the body of such a page, well-formed; `name` is its id on the page."""
    return (
        f'<div data-scene="{name}"><noscript>The scene in 3-D needs JavaScript.</noscript></div>'
        f'<script type="application/json" id="{name}">{to_script_json(document)}</script>'
        '<script type="module">import { showAll } from "topoloc/apps/viewer"; showAll();</script>'
    )


def scene_page(document: Mapping[str, Any]) -> str:
    """A page that is the scene."""
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    )
    title = f"<title>{escape(str(document['name']))}</title>"
    style = f"<style>\n{static_text('theme.css')}</style>"
    body = embedded_scene(document).replace("<div data-scene", '<div class="whole" data-scene', 1)
    return (
        "<!DOCTYPE html>\n<html"
        f' lang="en"><head>{head}\n{title}\n{style}\n{embedded_head()}</head><body>\n{body}\n</body></html>\n'  # noqa: E501
    )


def write_scene_page(path: Path, document: Mapping[str, Any]) -> None:
    """Write the page, at once or not at all. Raises TopolocError where the file cannot be
    written."""
    write_text(path, scene_page(document))


@cache
def _data_address(file: str) -> str:
    return "data:text/javascript;base64," + base64.b64encode(static_text(file).encode()).decode(
        "ascii"
    )
