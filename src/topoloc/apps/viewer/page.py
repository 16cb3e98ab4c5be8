"""A scene as a self-contained page, as a part of a page, or as a screenshot.

The front end consists of JavaScript modules in `static/`. An import map leads from their names to
`/static/` of the service, or to copies within a page file.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

from topoloc import TopolocError, TopoMetricMap
from topoloc.apps.viewer.document import create_document, to_script_json
from topoloc.apps.viewer.result_files import read_results
from topoloc.plugin import write_bytes, write_text

MODULES = {
    "three": "three.js",
    "topoloc/geometry": "geometry.js",
    "topoloc/measure": "measure.js",
    "topoloc/objects": "objects.js",
    "topoloc/overlay": "overlay.js",
    "topoloc/plan": "plan.js",
    "topoloc/stage": "stage.js",
    "topoloc/apps/viewer": "viewer.js",
    "topoloc/words": "words.js",
}
"""The modules of the scene by their import names."""
BROWSERS = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
    "microsoft-edge",
)
_BROWSER_OPTIONS = (
    "--headless=new",
    "--no-first-run",
    "--disable-background-networking",
    "--host-resolver-rules=MAP * ~NOTFOUND",  # it would look up its maker's services
    "--hide-scrollbars",
    "--use-angle=swiftshader",  # WebGL without a graphics card
    "--enable-unsafe-swiftshader",
)
_BROWSER_FOLDERS = ("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME")
_TIMEOUT_S, _VIRTUAL_MS = 120.0, 3_000


def view(path: str | Path, out: str | Path, results: Sequence[str | Path] = ()) -> None:
    """Write a self-contained HTML page that shows a map in 3-D.

    Args:
        path: the map file.
        out: the page to write.
        results: result files of `topoloc localize` or `topoloc evaluate` (JSON), and trajectories
            (TUM, KITTI), that are shown in the map.

    Raises:
        MapError: the map cannot be read.
        TopolocError: a result file cannot be read, or the page cannot be written.
    """
    shown = [one for file in results for one in read_results(Path(file))]
    with TopoMetricMap.load(path) as topomap:
        write_scene_page(Path(out), create_document(topomap, Path(path).stem, shown))


@cache
def static_text(name: str) -> str:
    """Return a file of the front end."""
    file = resources.files("topoloc.apps.viewer").joinpath("static", name)
    return file.read_text(encoding="utf-8")


def import_map(address: Callable[[str], str], modules: Mapping[str, str] = MODULES) -> str:
    """Return the import map element. `address` returns the URL of a file of `static/`."""
    places = {name: address(file) for name, file in modules.items()}
    return f'<script type="importmap">{json.dumps({"imports": places})}</script>'


def embedded_head() -> str:
    """Return the part of a page's head that scenes need."""
    return f"<style>\n{static_text('viewer.css')}</style>\n{import_map(_data_address)}"


def embedded_scene(document: Mapping[str, Any]) -> str:
    """Return a scene as well-formed HTML for such a page."""
    return (
        '<div data-scene="scene"><noscript>The scene in 3-D needs JavaScript.</noscript></div>'
        f'<script type="application/json" id="scene">{to_script_json(document)}</script>'
        '<script type="module">import { showAll } from "topoloc/apps/viewer"; showAll();</script>'
    )


def scene_page(document: Mapping[str, Any]) -> str:
    """Return a page that shows only the scene."""
    body = embedded_scene(document).replace("<div data-scene", '<div class="whole" data-scene', 1)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><meta name="viewport"'
        ' content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(str(document['name']))}</title>\n"
        f"<style>\n{static_text('theme.css')}</style>\n{embedded_head()}</head><body>\n{body}\n"
        "</body></html>\n"
    )


def write_scene_page(path: Path, document: Mapping[str, Any]) -> None:
    """Write the page atomically. Raises TopolocError if the file cannot be written."""
    write_text(path, scene_page(document))


@cache
def _data_address(file: str) -> str:
    data = base64.b64encode(static_text(file).encode()).decode("ascii")
    return f"data:text/javascript;base64,{data}"


def find_browser() -> str:
    """Return the path of a Chromium or Chrome. Raises TopolocError if none is installed."""
    found = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if found is None:
        raise TopolocError(
            f"a screenshot needs one of {', '.join(BROWSERS[:3])}, and none is installed"
        )
    return found


def write_screenshot(page: Path, out: Path) -> None:
    """Write a PNG of the page in a window of 1300 x 850 pixels. Raises TopolocError: there is no
    browser, it fails, or the file cannot be written."""
    browser = find_browser()
    with tempfile.TemporaryDirectory(prefix="topoloc-view-") as profile:
        picture = Path(profile) / "page.png"
        is_root = hasattr(os, "geteuid") and os.geteuid() == 0
        command = [
            browser,
            *_BROWSER_OPTIONS,
            *(["--no-sandbox"] if is_root else []),  # Chromium's sandbox refuses root
            f"--user-data-dir={profile}",
            f"--virtual-time-budget={_VIRTUAL_MS}",
            "--window-size=1300,850",
            f"--screenshot={picture}",
            page.resolve().as_uri(),
        ]
        try:
            done = subprocess.run(
                command,
                capture_output=True,
                timeout=_TIMEOUT_S,
                check=False,
                cwd=profile,  # a long path of TMPDIR is too long for the browser's sockets
                env=os.environ | dict.fromkeys(_BROWSER_FOLDERS, profile) | {"TMPDIR": "."},
            )
        except subprocess.TimeoutExpired:
            raise TopolocError(f"{browser} made no screenshot within {_TIMEOUT_S:g} s") from None
        if done.returncode or not picture.is_file():
            lines = done.stderr.decode(errors="replace").strip().splitlines()
            reason = lines[-1][:200] if lines else f"exit status {done.returncode}"
            raise TopolocError(f"{browser} made no screenshot: {reason}")
        write_bytes(out, picture.read_bytes())
