"""Write pages: explain, view, report. Each must open in a browser without an error."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

from .figures import Figure
from .places import FIT
from .workplace import SkippedError, Workplace, need_module

MIN_BYTES = 10_000
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
CHECK = """
import json, sys
from playwright.sync_api import sync_playwright
errors = []
with sync_playwright() as playwright:
    browser = playwright.chromium.launch(
        executable_path=sys.argv[1],
        args=["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
    )
    for path in sys.argv[2:]:
        page = browser.new_page(viewport={"width": 1300, "height": 800})
        page.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(path, wait_until="load")
        page.wait_for_timeout(1500)
        page.close()
    browser.close()
print(json.dumps(errors))
"""


def pages(work: Workplace) -> Iterator[Figure]:
    """Write the pages of the ZED lab and check them."""
    zed, session = work.map("zed"), work.data("zed_lab/session2@0:99:10")
    image = Path(work.data("zed_lab/session2")) / "image_0" / "000010.jpg"
    image = next(iter(sorted(image.parent.glob("000010.*"))))
    report, why, scene = (work.folder / f"{name}.html" for name in ("report", "why", "scene"))
    fit = ("--map-from-truth", work.data(FIT))
    work.topoloc("evaluate", zed, session, *fit, "--report", report)
    work.topoloc("explain", zed, image, "--camera", "map", "--out", why)
    work.topoloc("view", zed, "--out", scene)
    certified, promise = work.own_map("zed"), work.folder / "promise.html"
    found = work.answer("certify", certified, "--walk", session, *fit, "--report", promise)
    wrong = sum(one["num_wrong"] for one in found["conditions"])
    yield Figure("certify: wrong answers", wrong, "at most")
    for path in (report, why, scene, promise):
        yield Figure(f"{path.stem}.html is not empty", int(path.stat().st_size > MIN_BYTES))
    work.topoloc("info", zed, "--check")
    yield Figure("info --check", 1, "at least")
    yield from _in_browser(work, zed, [report, why, scene, promise])


def _in_browser(work: Workplace, zed: Path, paths: list[Path]) -> Iterator[Figure]:
    name = "errors on the console of 4 pages"
    program = next((path for browser in BROWSERS if (path := shutil.which(browser))), None)
    try:
        need_module("playwright")
        if program is None:
            raise SkippedError("no Chromium is installed")
    except SkippedError as missing:
        yield Figure(name, None, skipped=str(missing))
        yield Figure("view --screenshot is not empty", None, skipped=str(missing))
        return
    script = work.folder / "in_browser.py"
    script.write_text(CHECK)
    errors = json.loads(work.python(script, program, *(path.as_uri() for path in paths)))
    yield Figure(name, len(errors), "at most")
    picture = work.folder / "scene.png"
    work.topoloc("view", zed, "--screenshot", picture)
    yield Figure("view --screenshot is not empty", int(picture.stat().st_size > MIN_BYTES))
