"""Test the report in a real browser: the 3-D scene, a narrow screen, and light and dark colours."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hand_made import MAP_INFO, answer, elsewhere, lost, two_nodes
from in_browser import CONTRASTS, UNNAMED, chromium, opened
from topoloc.apps.report.page_template import STYLE
from topoloc.apps.report.report import write_report
from topoloc.evaluation.metrics import summarize

ANSWERS = [
    *(answer(f"good{i}", 0.1 * i, error_m=0.001 * (i + 1), error_deg=0.1) for i in range(4)),
    lost("lost", 0.4),
]
ANSWERS += [
    answer("far", 0.5, 40.0, 2.0, node_id=1),
    elsewhere("moon", True),
    elsewhere("mars", False),
]
# Text of tables that lies outside of the window, and cannot be scrolled to within a box of its own.
CUT = """() => [...document.querySelectorAll("td, th")].filter((cell) => {
  const box = cell.getBoundingClientRect();
  return cell.checkVisibility() && (box.right > innerWidth + 1 || box.left < 0);
}).map((cell) => cell.textContent)"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(path, summarize(ANSWERS) | {"map": MAP_INFO}, ANSWERS, two_nodes())
    return path


@pytest.mark.parametrize(
    ("width", "dark"),
    [(1300, False), (400, False), (400, True)],
    ids=["wide", "phone", "phone, dark"],
)
def test_nothing_is_cut_off_and_all_can_be_read(browser: Any, report: Path, width: int, dark: bool):
    with opened(browser, report.as_uri(), width, dark) as page:
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.evaluate(CUT) == []
        assert page.evaluate(UNNAMED) == []
        lowest = page.evaluate(CONTRASTS)[0]
        assert lowest[0] >= 4.5, lowest


def test_text_of_plots_has_nine_pixels_on_a_phone(browser: Any, report: Path):
    assert STYLE["font.size"] >= 9.0  # points; no other size of a figure is smaller
    scales = """() => [...document.querySelectorAll("svg[role=img]")].map(
      (figure) => figure.getBoundingClientRect().width / figure.viewBox.baseVal.width)"""
    with opened(browser, report.as_uri(), 400) as page:
        found = page.evaluate(scales)
        assert len(found) >= 4
        assert min(found) >= 0.99, found


def test_the_scene_holds_every_answer(browser: Any, report: Path):
    with opened(browser, report.as_uri(), 1300) as page:
        shown = page.locator("[data-part=list] option").all_inner_texts()
        assert {
            "good0",
            "good3",
            "lost (not localized)",
            "far",
            "moon",
            "mars (not localized)",
        } <= set(shown)
        page.get_by_label("Go to").select_option("far")
        assert "Wrong pose" in page.inner_text("[data-part=details]")
        page.get_by_label("Go to").select_option("moon")
        assert "this pose is false" in page.inner_text("[data-part=details]")


def test_the_page_scrolls_over_the_scene(browser: Any, report: Path):
    """The mouse wheel scrolls the page until the scene has the focus."""
    stage = "document.querySelector('[data-scene]').viewer.stage"
    distance = f"{stage}.camera.position.distanceTo({stage}.controls.target)"
    with opened(browser, report.as_uri(), 1300) as page:
        canvas = page.locator("[data-scene] canvas")
        canvas.scroll_into_view_if_needed()
        box, before = canvas.bounding_box(), page.evaluate(distance)
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        page.mouse.wheel(0, 300)
        page.wait_for_timeout(300)
        assert page.evaluate(distance) == before
        canvas.focus()
        page.mouse.wheel(0, 100)
        page.wait_for_timeout(300)
        assert page.evaluate(distance) != before
