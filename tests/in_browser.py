"""Open pages in a headless Chromium, driven by Playwright. If either is missing, tests skip
with a reason."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

WIDTHS = (1300, 400)
_SOFTWARE_3D = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
# Contrast ratio of each visible text and its background, the lowest first (WCAG 2.2, 1.4.3).
CONTRASTS = """() => {
  const numbers = (colour) => (colour.match(/[\\d.]+/g) ?? []).map(Number);
  const luminance = (rgb) => rgb.slice(0, 3).map((c) => c / 255).map((c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4))
    .reduce((sum, c, i) => sum + c * [0.2126, 0.7152, 0.0722][i], 0);
  const behind = (element) => {
    for (let one = element; one; one = one.parentElement) {
      const colour = numbers(getComputedStyle(one).backgroundColor);
      if (colour.length === 3 || colour[3] === 1) return colour;
    }
    return [255, 255, 255];
  };
  const found = [];
  for (const element of document.body.querySelectorAll("*")) {
    const text = [...element.childNodes].filter((node) => node.nodeType === 3).map((node) => node.textContent.trim()).join("");
    if (!text || !element.checkVisibility() || element.closest("svg, script, style, noscript, option")) continue;
    const [a, b] = [numbers(getComputedStyle(element).color), behind(element)].map(luminance).sort((x, y) => y - x);
    found.push([(a + 0.05) / (b + 0.05), text.slice(0, 40)]);
  }
  return found.sort((x, y) => x[0] - y[0]);
}"""  # noqa: E501
# Controls for the keyboard without an accessible name.
UNNAMED = """() => [...document.querySelectorAll("button, input:not([hidden]), select, canvas[tabindex], textarea")].filter((element) => {
  const named = element.ariaLabel || element.title || element.textContent.trim() || element.labels?.[0]?.textContent.trim();
  return element.checkVisibility() && !named;
}).map((element) => element.outerHTML)"""  # noqa: E501


@contextmanager
def chromium(*options: str) -> Iterator[Any]:
    """Yield the browser as Playwright's `Browser`."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    program = next(
        (
            path
            for name in ("chromium", "chromium-browser", "google-chrome")
            if (path := shutil.which(name))
        ),
        None,
    )
    if program is None:
        pytest.skip("no Chromium is installed")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=program, args=["--no-sandbox", *_SOFTWARE_3D, *options]
        )
        yield browser
        browser.close()


@contextmanager
def opened(browser: Any, address: str, width: int, dark: bool = False) -> Iterator[Any]:
    """Open the page in a window of this width in pixels. Any error or warning on its console
    fails the test."""
    page = browser.new_page(
        viewport={"width": width, "height": 800}, color_scheme="dark" if dark else "light"
    )
    errors = list[str]()
    page.on(
        "console",
        lambda message: (
            errors.append(message.text) if message.type in ("error", "warning") else None
        ),
    )
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on(
        "request",
        lambda request: errors.append(request.url) if _is_elsewhere(request.url, address) else None,
    )
    page.goto(address)
    yield page
    assert [error for error in errors if "GPU stall" not in error] == [], errors
    page.close()


def _is_elsewhere(url: str, address: str) -> bool:
    """Whether a page loads something that is neither in itself nor of its service."""
    if address.startswith("file:"):
        return url.partition("#")[0] != address.partition("#")[0] and not url.startswith(
            ("data:", "blob:")
        )
    return not url.startswith(
        ("data:", "blob:", address.split("/", 3)[0] + "//" + address.split("/", 3)[2])
    )
